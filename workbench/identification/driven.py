"""Modes from measured inputs and outputs, whatever the excitation.

The response of each pole to the inputs is exact at the samples (`input_output/known_inputs.py`); all modes are fitted
at once by output error, maximum likelihood in normal noise of the sensors (`input_output/modal_fit.py`). The spectrum
of that noise is estimated from the residual, and the modes from it in turn (`input_output/noise_spectrum.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any
from warnings import warn

import control
import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from workbench.arrays import Floats
from workbench.identification.input_output.after_impacts import after_impacts
from workbench.identification.input_output.excitation import check_inputs, unexcited_remarks
from workbench.identification.input_output.fit_errors import fixed_std, pole_covariance, vector_covariance
from workbench.identification.input_output.force_window import force_window
from workbench.identification.input_output.held_out import left_about, unpredictive_remarks, without_unpredictive
from workbench.identification.input_output.input_delays import act_later, best_delays, first_lags, fractions
from workbench.identification.input_output.input_holds import hold_remarks
from workbench.identification.input_output.input_noise import (
    blow_noise,
    input_noise,
    noise_levels,
    noise_remarks,
    spread_by_inputs,
    with_white_noise,
)
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import (
    Fit,
    added_misfit,
    modal_coordinate,
    only,
    projected,
    scaled_vectors,
    settled,
)
from workbench.identification.input_output.model_order import (
    ORDER,
    Selected,
    fit_of_poles,
    is_about_distorted,
    select_modes,
    statistic_of_each,
    sure_modes,
)
from workbench.identification.input_output.noise_spectrum import alike
from workbench.identification.input_output.peak_shape import overlap_remarks
from workbench.identification.input_output.residual_bursts import burst_remarks
from workbench.identification.input_output.sensor_drift import beside_drift
from workbench.identification.input_output.subspace_poles import subspace_poles
from workbench.identification.input_output.time_variance import beside_changing, change_remarks, joined
from workbench.identification.signal.data_quality import input_faults, of_same_sensors
from workbench.identification.signal.harmonics import harmonic_remarks
from workbench.identification.signal.modal_estimates import SURE, ParticipatingModes, credible, time_derivatives
from workbench.identification.signal.searches import FALSE_ALARM, SECONDS, SELECTION, Budget, Progress, check_count
from workbench.records.record import HOLDS, Channel, Record
from workbench.renamed import Renamed, former_arguments
from workbench.rig.statespace import signal_names
from workbench.structure.modes import SampledModes, frozen
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class DrivenSettings:
    """Constants of the course of an identification from known inputs."""

    strongest: int = 8  # modes for the first estimate of the noise
    learnt: int = 4  # times that noise and modes are estimated in turn
    apart: int = 2  # times that modes are looked for in combinations of outputs that share no noise
    spare: int = 20  # states of a subspace model beyond two for each of the most modes: for noise
    drifting: float = 0.2  # of the time left, for each look at what is a drift
    undriven: float = 0.3  # of the motion of a mode, what the inputs make of it: less is none of theirs
    final: float = 5.0  # s of processor time for the last check of modes, whatever the search has left


DRIVEN = DrivenSettings()


@dataclass(frozen=True, eq=False, repr=False)
class Driven(ParticipatingModes):
    """Modes with their participation factors: H(s) = {D + Σ_r [c_r l_r^T / (s - λ_r) + conjugate]} diag(e^{-sτ_i}).

    Attributes:
        modes: shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ); in white noise the Cramér-Rao bound at the estimate.
        vector_covariance: (n_modes, k, k) of each mode's shape over its largest entry, real part, then of its
            participation factors, real and imaginary parts; k = n_outputs + 2 n_inputs.
        participation: (n_modes, n_inputs) complex l_r, for c_r the shape as the outputs measure it, ψ_r λ_r^k with
            k = 0, 1, 2 for displacement, velocity, acceleration.
        feedthrough: (n_outputs, n_inputs) D: of accelerations, and of the modes above those identified.
        feedthrough_std: (n_outputs, n_inputs).
        delays: (n_inputs,) s, τ by which each input acts late.
        input_hold: "zero", "first" or "band-limited": how inputs run between samples.
        sample_time: s, of the records.
        initial: one (n_modes,) complex a record: z_r at its first sample, where y = Re Σ 2 c_r z_r; zero if at rest.
        noise: (n_records, n_outputs) standard deviation of the residual, in the unit of each output.
        statistic: (n_modes,) χ² of each mode in the noise.
        threshold: what a mode fitted to noise alone exceeds with the chance of a false alarm.
        converged: whether the search ended because the step was small.
        remarks: what is doubtful, and what was left undone where the time was up.
        output_channels, input_channels: of the records.
    """

    feedthrough: np.ndarray
    feedthrough_std: np.ndarray
    delays: np.ndarray
    input_hold: str
    sample_time: float
    initial: tuple[np.ndarray, ...]
    noise: np.ndarray
    statistic: np.ndarray
    threshold: float
    converged: bool
    remarks: tuple[str, ...]
    output_channels: tuple[Channel, ...]
    input_channels: tuple[Channel, ...]

    evidence, limit = Renamed("statistic"), Renamed("threshold")

    @property
    def noise_std(self) -> np.ndarray:
        """Of each output (n_outputs,), root mean square over the records."""
        return np.asarray(np.sqrt((self.noise**2).mean(axis=0)))

    @property
    def _measured_shapes(self) -> np.ndarray:
        return np.asarray(self.modes.shapes * self.modes.poles ** time_derivatives(self.output_channels)[:, None])

    @property
    def state_space(self) -> control.StateSpace:
        """The model from inputs late by `delays` to outputs in real modal form, two states a mode, named as the record.

        z = re + i im of each mode: A has blocks [[Re λ, -Im λ], [Im λ, Re λ]], and y = Re Σ 2 c z + D u.
        """
        n, poles = self.modes.n_modes, self.modes.poles
        a = np.zeros((2 * n, 2 * n))
        even, odd = 2 * np.arange(n), 2 * np.arange(n) + 1
        a[even, even] = a[odd, odd] = poles.real
        a[even, odd], a[odd, even] = -poles.imag, poles.imag
        b = np.stack([self.participation.real, self.participation.imag], axis=1).reshape(2 * n, -1)
        c = 2.0 * self._measured_shapes
        c = np.stack([c.real, -c.imag], axis=2).reshape(c.shape[0], 2 * n)
        return control.ss(
            a,
            b,
            c,
            self.feedthrough,
            inputs=signal_names(channel.name for channel in self.input_channels),
            outputs=signal_names(channel.name for channel in self.output_channels),
            states=[f"{part}{r + 1}" for r in range(n) for part in ("re", "im")],
            name="identified",
        )

    def response(self, inputs: ArrayLike, *, record: int | None = None) -> np.ndarray:
        """Outputs (n_outputs, n_samples) to inputs sampled as the records were, delays included; no constants.

        Args:
            inputs: (n_inputs, n_samples), zero before the first.
            record: that begins as this one did; from rest unless given.
        """
        u = np.atleast_2d(np.asarray(inputs, float))
        if u.ndim != 2 or len(u) != len(self.input_channels):
            raise ValueError(f"inputs must have shape ({len(self.input_channels)}, n_samples); got {np.shape(inputs)}")
        silent = np.zeros((len(self.output_channels), u.shape[1]))
        driven = Record(self.sample_time, silent, self.output_channels, u, self.input_channels)
        delays = _checked_delays([driven], self.delays)
        data = KnownInputs([driven], at_rest=True, hold=self.input_hold, feedthrough=True, delays=delays)
        y = self.feedthrough @ data.direct(0)
        time = self.sample_time * np.arange(u.shape[1])
        for r, pole in enumerate(self.modes.poles):
            real, imaginary = data.responses(pole)
            z = (real + 1j * imaginary) @ self.participation[r]
            if record is not None:
                z += self.initial[record][r] * np.exp(pole * time)
            y += 2.0 * np.real(np.outer(self._measured_shapes[:, r], z))
        return np.asarray(y)

    @property
    def straight(self) -> bool:
        """Former name of `input_hold == "first"`."""
        warn("straight is now input_hold; it goes with the next version", DeprecationWarning, 2)
        return self.input_hold == "first"

    def initial_state(self, record: int = 0) -> np.ndarray:
        """States of `state_space` at the first sample of a record, (2 n_modes,)."""
        z = self.initial[record]
        return np.stack([z.real, z.imag], axis=1).ravel()


@former_arguments(most_modes="max_modes")
@one_blas_thread
def identify_driven(
    records: Record | Sequence[Record],
    *,
    at_rest: bool = False,
    input_hold: str | None = None,
    feedthrough: bool = True,
    delays: ArrayLike | None = None,
    max_modes: int = 40,
    false_alarm: float = FALSE_ALARM,
    seconds: float | None = SECONDS,
    progress: Progress | None = None,
    straight: bool | None = None,
) -> Driven:
    """The modes between inputs and outputs, their number selected, with participation factors and standard errors.

    Any excitation serves that moves the modes: noise, multisine, PRBS, an impulse. Each mode enters if it raises the
    likelihood by more than noise would in one record of a thousand. Inputs that are impacts count as zero between them,
    with a remark: what their channels read there is noise.

    Args:
        records: with the same inputs and outputs at one rate; each output may hold a constant, another in each record.
        at_rest: that nothing moves at the first sample; otherwise each record has an initial state of its own.
        input_hold: how inputs run between samples: "zero" for a zero-order hold, as of the command that a converter
            gives out; "band-limited" for what holds nothing beyond half of the sample rate, as a force measured behind
            the anti-alias filter of a logger; "first" for a first-order hold, straight from sample to sample, as a
            force nearly runs that is slow against the sample rate. As the records say unless given; where these show
            that another is true, a remark says which.
        feedthrough: whether there is a direct term: of accelerations, and of modes beyond the sample rate.
        delays: (n_inputs,) s, by which each input acts late; estimated unless given, up to 60 samples. Of inputs held
            between samples, with a direct term, the fraction of a sample is the one that makes the modes most nearly
            real, for their response is the same whatever it is.
        max_modes: where to stop at the latest.
        false_alarm: chance that noise alone is taken for a mode; 0.001 unless given.
        seconds: of processor time, 30 unless given, after which the best so far is returned, with a remark; None for no
            limit.
        progress: called with the search under way and the share of the time that is spent.
        straight: former name of `input_hold="first"`; it warns.

    Returns:
        `Driven`. Its standard errors hold in noise of any smooth spectrum, and beside white noise of the inputs, which
        is found where two modes or more show it, and remarked.

    Raises:
        ValueError: no inputs, inputs that never move or move alike; records that differ; too few samples; no mode.
    """
    check_count("max_modes", max_modes)
    budget = Budget(seconds, progress)
    records = of_same_sensors(records)
    if straight is not None:
        warn('straight is now input_hold="first"; it goes with the next version', DeprecationWarning, 3)
        input_hold = "first" if straight else "zero"
    hold = records[0].input_hold if input_hold is None else input_hold
    if hold not in HOLDS:
        raise ValueError(f"input_hold is {' or '.join(map(repr, HOLDS))}; got {input_hold!r}")
    check_inputs(records)
    clipped = dict.fromkeys(fault.message for record in records for fault in input_faults(record))
    logged = records
    records, windowed = force_window(logged)
    by_amplitude = after_impacts(records, budget)
    data = KnownInputs(
        records,
        at_rest=at_rest,
        hold=hold,
        feedthrough=feedthrough,
        delays=_checked_delays(records, delays),
        distorted=by_amplitude.changing,
        free=by_amplitude.poles,
    )
    rows, columns = data.fixed.shape
    if rows < columns + 4 * (data.n_excitations + 2):
        raise ValueError(
            f"record {records[0].name!r}: {rows} samples are too few for {records[0].n_inputs} inputs; measure longer"
        )
    most = min(max_modes, (rows - columns) // 6)
    how = {"max_modes": most, "false_alarm": false_alarm}
    looks: list[Budget] = []

    def looked(each: KnownInputs) -> Selected:
        looks.append(budget.aside(DRIVEN.drifting))
        return _strongest(each, **how, budget=looks[-1])

    data, strongest, drift = beside_drift(data, looked)
    if any(look.unfinished for look in looks):
        strongest = None
    search = _with_delays if delays is None else _selected
    data, selected = search(data, budget, strongest, **how)
    if selected.fit.poles.size == 0:
        raise ValueError(
            f"record {records[0].name!r}: no mode between inputs {', '.join(records[0].input_names)} and outputs"
            f" {', '.join(records[0].output_names)} rises above the noise; excite harder or longer, or look whether"
            " inputs and outputs belong together"
        )
    data, selected, changing = _as_constant(data, selected, budget)
    selected = _predictive(data, selected, Budget(DRIVEN.final))
    selected, remarks = _without_artefacts(data, selected, budget)
    if delays is None:
        remarks = (*_late_remarks(data), *remarks)
    fit = joined(data, selected.fit, budget)
    selected = selected if fit is selected.fit else selected.refitted(fit)
    holds = hold_remarks(data, selected.fit, selected.limit, budget)
    bursts = burst_remarks(logged, data.left(fit), fit.noise)
    overlap = overlap_remarks(selected.fit.poles, records[0].n_outputs * records[0].n_inputs)
    late = budget.spent("check of modes that change within the record")
    in_decay = by_amplitude.among(fit.poles)
    changes, named = ((), in_decay) if late else change_remarks(data, fit, changing, in_decay)
    beside = (*selected.distorted, *left_about(data, fit))
    left = [pole for pole in beside if pole not in (*named, *by_amplitude.changing)]
    changes = (*changes, *unpredictive_remarks(fit, left))
    found = _report(
        logged,
        records,
        data,
        selected,
        (*clipped, *bursts, *windowed, *drift, *holds, *remarks, *overlap, *changes, *budget.remarks),
    )
    deviation = found.modes.omega * found.zeta_std + 1j * found.omega_std
    decays = by_amplitude.remarks(fit.poles, _sizes(data, fit), deviation)
    # a response to the inputs may have a constant amplitude too
    undamped = np.flatnonzero(found.modes.zeta < SURE * found.zeta_std).tolist()
    lasting = [r for r in undamped if _goes_on_undriven(data, fit, r)]
    doubtful = (*harmonic_remarks(records, fit.poles, undamped, lasting), *unexcited_remarks(records, fit.poles))
    return replace(found, remarks=(*decays, *doubtful, *found.remarks))


def _goes_on_undriven(data: KnownInputs, fit: Fit, r: int) -> bool:
    """Whether a mode goes on through the records and is not of the inputs, whose response may hide how steady it is."""
    pole, l_r = fit.poles[r], fit.participation[r].copy()
    responses = data.responses(pole)
    whole = np.linalg.norm(modal_coordinate(responses, l_r))
    l_r[data.n_inputs :] = 0.0
    by_inputs = np.linalg.norm(modal_coordinate(responses, l_r))
    decays = -pole.real * 2.0 * np.pi / data.resolution
    return bool(decays < 1.0 and by_inputs < DRIVEN.undriven * whole)


def _sizes(data: KnownInputs, fit: Fit) -> Floats:
    """Of the response of each mode over the records, outputs in units of their noise, (n_modes,)."""
    each = zip(fit.poles, fit.participation, fit.amplitudes.T, strict=True)
    return np.array(
        [
            np.linalg.norm(a / fit.noise) * np.linalg.norm(np.concatenate(data.modal_coordinate(p, l_r)))
            for p, l_r, a in each
        ]
    )


def _with_delays(
    data: KnownInputs, budget: Budget, strongest: Selected | None, **how: Any
) -> tuple[KnownInputs, Selected]:
    """The modes, and how late each input acts.

    Lateness by a fraction of a sample is searched where the first response of an input is later than without delay, or
    where the modes leave what the inputs a sample earlier explain.
    """
    first = first_lags(data.records)
    if data.hold == "band-limited":
        return _with_any_delays(data, first, budget, strongest, **how)
    whole = np.maximum(first - (0 if data.hold == "first" else 1), 0)
    in_time: tuple[KnownInputs, Selected] | None = None
    if data.hold == "zero" and not first.any():
        return _selected(data, budget, strongest, **how)
    late = data.delayed_by(whole, any_fraction=True)
    strongest = _strongest(late, budget=budget, **how)
    if not whole.any():
        if strongest.fit.poles.size == 0:
            return _selected(data, budget, **how)
        if not act_later(late, strongest.fit).any():
            in_time = punctual, selected = _selected(
                data, budget, _strongest(data, strongest.fit, budget=budget, **how), **how
            )
            further = selected.fit.poles.size > strongest.fit.poles.size
            if not (further and _late(punctual, selected, budget)) or budget.spent("search for delays of the inputs"):
                return in_time
    punctual = data
    data, selected = _selected(late, budget, strongest, **how)
    fit = selected.fit
    if fit.poles.size == 0:
        return in_time if in_time is not None else (data.delayed_by(whole), selected)
    whole, fraction = _lateness(data, fit, whole, budget)
    if not whole.any() and not fraction.any() and not budget.spent("search for delays of the inputs"):
        if in_time is not None:
            return in_time
        return _selected(punctual, budget, _strongest(punctual, fit, budget=budget, **how), **how)
    late = data.delayed_by(whole + fraction)
    return late, selected.refitted(settled(late, _moved_to(late, data, fit), budget=budget))


def _with_any_delays(
    data: KnownInputs, first: Floats, budget: Budget, strongest: Selected | None, **how: Any
) -> tuple[KnownInputs, Selected]:
    """The modes, and how late each band-limited input acts, beside which no two columns stand for any fraction."""
    late = data.delayed_by(first) if first.any() else data
    for _ in range(DRIVEN.learnt):  # before any mode is looked for in what the delay makes
        few, before = _start(late, **how), late
        if few.poles.size:
            late, _ = _in_time(late, few, budget)
        if late is before:
            break
    late, selected = _selected(late, budget, strongest if late is data else None, **how)
    if not selected.fit.poles.size:
        return late, selected
    found, fit = _in_time(late, selected.fit, budget)
    return (late, selected) if found is late else (found, selected.refitted(settled(found, fit, budget=budget)))


def _in_time(data: KnownInputs, fit: Fit, budget: Budget) -> tuple[KnownInputs, Fit]:
    """Band-limited inputs late by the delays that are the most likely, and the modes turned to them."""

    def moved(delays: Floats) -> tuple[KnownInputs, Fit]:
        other = data.delayed_by(delays)
        return other, _moved_to(other, data, fit)

    derivative = time_derivatives(data.records[0].output_channels)[:, None]
    delays = best_delays(data.delays, moved, derivative, budget)
    return (data, fit) if (delays == data.delays).all() else moved(delays)


def _lateness(data: KnownInputs, fit: Fit, whole: Floats, budget: Budget) -> tuple[Floats, Floats]:
    """Whole samples and the fraction of one by which each input acts late, from modes beside any fraction.

    The first response seen comes a sample too late where the one before was too faint to be seen.
    """
    fraction = _fraction(data, fit)
    doubtful = (whole > 0) & (fraction == 0)
    while doubtful.any() and not budget.spent("search for delays of the inputs"):
        data, fit = _beside_any_fraction(data, fit, whole - doubtful, budget)
        found = _fraction(data, fit)
        taken = doubtful & (found < 1.0)
        whole, fraction = whole - taken, np.where(taken, found, fraction)
        doubtful = taken & (whole > 0) & (fraction == 0)
    return whole, fraction


def _fraction(data: KnownInputs, fit: Fit) -> Floats:
    """Of a sample by which each input acts later than `data` says, 0 where it does not, (n_inputs,)."""
    derivative = time_derivatives(data.records[0].output_channels)[:, None]
    return np.where(act_later(data, fit), fractions(data, fit, derivative), 0.0)


def _beside_any_fraction(data: KnownInputs, fit: Fit, delays: Floats, budget: Budget) -> tuple[KnownInputs, Fit]:
    """The inputs delayed by whole samples and any fraction, and the modes fitted to these as far as decides."""
    other = data.delayed_by(delays, any_fraction=True)
    return other, settled(other, _moved_to(other, data, fit), SELECTION.few_steps, budget, ORDER.decided)


def _moved_to(other: KnownInputs, data: KnownInputs, fit: Fit) -> Fit:
    """Modes of inputs of one delay, turned to those of another."""
    turned = fit.participation.copy()
    turned[:, : data.n_inputs] *= np.exp(np.outer(fit.poles, other.delays - data.delays) * data.dt)
    return projected(other, fit.poles, turned)


def _late(data: KnownInputs, selected: Selected, budget: Budget) -> bool:
    """Whether these modes leave what the inputs a sample earlier explain."""
    other, trial = _beside_any_fraction(data, selected.fit, data.delays, budget)
    return bool(act_later(other, trial).any())


def _strongest(data: KnownInputs, start: Fit | None = None, **how: Any) -> Selected:
    """Those of a start, or else of a subspace model, and as many more as the first estimate of the noise needs."""
    start = _start(data, **how) if start is None else start
    few = _few(how)
    few["max_modes"] = max(few["max_modes"], start.poles.size)
    return _predictive(data, select_modes(data, start=start, **few), how["budget"])


def _start(data: KnownInputs, **how: Any) -> Fit:
    """The modes of a subspace model."""
    poles = subspace_poles(data.records, data.whole, 2 * how["max_modes"] + DRIVEN.spare)
    poles = np.append(poles[~is_about_distorted(data, poles)], data.free)
    fit = fit_of_poles(data, poles, how["false_alarm"])
    if fit.poles.size <= how["max_modes"]:
        return fit
    return only(data, fit, np.argsort(statistic_of_each(fit))[-how["max_modes"] :])


def _predictive(data: KnownInputs, selected: Selected, budget: Budget) -> Selected:
    """Without modes that make the prediction of what is held out worse; about these no further mode is looked for."""
    fit, distorted = without_unpredictive(data, selected.fit, selected.statistic, budget)
    selected = selected if fit is selected.fit else selected.refitted(fit)
    return replace(selected, distorted=(*data.distorted, *distorted))


def _few(how: dict[str, Any]) -> dict[str, Any]:
    return {**how, "max_modes": min(DRIVEN.strongest, how["max_modes"])}


def _late_remarks(data: KnownInputs) -> tuple[str, ...]:
    names = data.records[0].input_names
    late = [f"{names[i]} {d:.2f} samples ({d * data.dt:.3g} s)" for i, d in enumerate(data.delays) if d > 0]
    return (f"inputs act late, by {', '.join(late)}: the model is of the delayed inputs",) if late else ()


def _checked_delays(records: Sequence[Record], delays: ArrayLike | None) -> np.ndarray | None:
    """Samples by which each input acts late."""
    if delays is None:
        return None
    dt, given = records[0].sample_time, np.broadcast_to(np.asarray(delays, float), (records[0].n_inputs,))
    longest = 0.25 * min(record.n_samples for record in records) * dt
    if not ((given >= 0) & (given <= longest)).all():
        raise ValueError(
            f"delays must lie between 0 and {longest:.3g} s, a quarter of the record, one per input; got {delays!s}"
        )
    near = np.round(given / dt)
    return np.where(np.abs(given / dt - near) < 1e-6, near, given / dt)


def _selected(
    data: KnownInputs, budget: Budget, strongest: Selected | None = None, **how: Any
) -> tuple[KnownInputs, Selected]:
    """The modes, the strongest first; in combinations of the outputs that share no noise where these share some."""
    how["budget"] = budget
    start = _start(data, **how) if strongest is None else strongest.fit
    sure = sure_modes(data, start, how["false_alarm"], budget)
    noise = None if budget.spent("search for noise of the inputs") else input_noise(data, sure)
    if noise is not None:
        (data, start), strongest = with_white_noise(data, sure, noise, how["false_alarm"], budget), None
    if strongest is None:
        strongest = _strongest(data, start, **{**how, "budget": budget.share(SELECTION.search_share)})
    data = data.with_distorted(strongest.distorted)
    apart = data.apart(strongest.fit)
    if apart is None:
        return _in_noise(data, strongest, how)
    # noise that outputs share makes peaks in all of them; what was not found yet may have looked like it
    for _ in range(DRIVEN.apart):
        apart, found = _in_noise(apart, _strongest(apart, strongest.fit, **how), how)
        again = apart.apart(found.fit)
        if again is None or budget.spent("search beside noise that outputs share"):
            break
        apart, strongest = again, found
    data = data.beside_as(apart)
    fit = settled(data, projected(data, found.fit.poles, found.fit.participation), budget=budget)
    data = data.weighted_by(data.noise_spectrum(fit))
    fit = settled(data, only(data, fit, np.argsort(np.abs(fit.poles))), budget=budget)
    return data, found.refitted(fit)


def _in_noise(data: KnownInputs, strongest: Selected, how: dict[str, Any]) -> tuple[KnownInputs, Selected]:
    """The modes of outputs that share no noise, in that of their residual's spectrum: coloured noise passes for modes.

    A false mode explains its lines, so that their noise is underestimated and the mode seems true. The noise is thus
    estimated anew without all doubtful modes; they stay if that makes modes and noise together less likely.
    """
    budget, few = how["budget"], _few(how)
    few["max_modes"] = max(few["max_modes"], strongest.fit.poles.size)
    data, selected = _with_noise(data, strongest, few, how, budget)
    doubtful = (selected.statistic < SELECTION.weak * selected.limit) | ~_oscillate(data, selected)
    if data.line_std is None or not doubtful.any() or budget.spent("check of doubtful modes"):
        return data, selected
    sure = settled(data, only(data, selected.fit, ~doubtful), budget=budget)
    other = data.weighted_by(data.noise_spectrum(sure))
    other, fewer = _with_noise(other, select_modes(other, start=sure, **how), how, how, budget)
    if budget.spent("check of doubtful modes"):
        return data, selected
    worth = selected.limit * (selected.fit.poles.size - fewer.fit.poles.size)
    strange = (~_oscillate(data, selected)).sum() > (~_oscillate(other, fewer)).sum()
    return (other, fewer) if strange or other.cost(fewer.fit) - data.cost(selected.fit) <= worth else (data, selected)


def _as_constant(
    data: KnownInputs, selected: Selected, budget: Budget
) -> tuple[KnownInputs, Selected, tuple[complex, ...]]:
    """The same modes as constant ones, where the motion of modes that change was fitted beside them, and these modes.

    Noise, standard errors and responses are then those of the model returned. No mode changes if, all modes being
    known, that motion explains no more than it would of noise.
    """
    if not data.changing:
        return data, selected, ()
    plain, before = data.without_columns(), selected.fit
    fit = settled(plain, projected(plain, before.poles, before.participation), budget=budget)
    worth = added_misfit(fit, before, before.noise)
    columns = (data.fixed.shape[1] - plain.fixed.shape[1]) * before.noise.size
    changing = data.changing if worth > chi2.isf(FALSE_ALARM, columns) else ()
    data = plain.weighted_by(plain.noise_spectrum(fit))
    fit = settled(data, only(data, fit, np.argsort(np.abs(fit.poles))), budget=budget)
    return data, selected.refitted(fit), changing


def _without_artefacts(data: KnownInputs, selected: Selected, budget: Budget) -> tuple[Selected, tuple[str, ...]]:
    """Without poles that cannot be modes, the others fitted anew, and a remark on them."""
    out: list[float] = []
    fit = selected.fit
    while fit.poles.size > 1:
        std = np.sqrt(np.diag(pole_covariance(fit))).reshape(2, -1)
        modes = SampledModes.of_poles(fit.poles, fit.amplitudes, data.places)
        good = credible(modes, std[0], std[1], data.highest) & (modes.zeta <= SELECTION.most_damped)
        if good.all() or not good.any():
            break
        out += list(modes.frequencies_hz[~good])
        fit = settled(data, only(data, fit, good), budget=budget)
    if not out:
        return selected, ()
    which = ", ".join(f"{f:.4g}" for f in sorted(out))
    remark = (
        f"left out, as damped negatively or by more than {SELECTION.most_damped:g}, of unknown frequency or beyond"
        f" Nyquist: poles at {which} Hz"
    )
    return selected.refitted(fit), (remark,)


def _oscillate(data: KnownInputs, selected: Selected) -> np.ndarray:
    """Which modes oscillate within a record and hardly grow; others may be noise that is not white."""
    poles, span = selected.fit.poles, 2.0 * np.pi / data.resolution
    return np.asarray((np.abs(poles) > data.resolution) & (poles.real * span < SELECTION.most_growth))


def _with_noise(
    data: KnownInputs, selected: Selected, once: dict[str, Any], how: dict[str, Any], budget: Budget
) -> tuple[KnownInputs, Selected]:
    """Modes and noise estimated in turn until both stay the same; `once` is how `selected` was selected."""
    for _ in range(DRIVEN.learnt):
        for _ in range(DRIVEN.learnt):
            changing = beside_changing(data, selected.fit, selected.limit, budget)
            if changing is None:
                break
            fewer = select_modes(changing[0], start=changing[1], **once)
            # Modes that are truly close fit better than one that changes; rivals of one output were compared before.
            rivals = data.values.shape[1] * data.n_inputs == 1
            worth = selected.limit * max(selected.fit.poles.size - fewer.fit.poles.size, 0) if rivals else 0.0
            if changing[0].cost(fewer.fit) >= data.cost(selected.fit) + worth:
                break
            data, selected = changing[0], fewer
        line_std = data.noise_spectrum(selected.fit)
        if alike(line_std, data.line_std) and not (selected.full and once["max_modes"] < how["max_modes"]):
            break
        if budget.spent("estimation of the noise spectrum"):
            break
        weighted = data.with_distorted(selected.distorted).weighted_by(line_std)
        anew = _predictive(weighted, select_modes(weighted, start=selected.fit, **how), budget)
        # A search that was ended early is no better than the one before.
        if budget.spent("estimation of the noise spectrum") and anew.fit.poles.size < selected.fit.poles.size:
            break
        data, selected, once = weighted, anew, how
    return data, selected


def _report(
    logged: Sequence[Record],
    records: Sequence[Record],
    data: KnownInputs,
    selected: Selected,
    remarks: tuple[str, ...],
) -> Driven:
    fit, n, further = selected.fit, selected.fit.poles.size, None
    if data.measured is None:
        noise_ratio, beside = data.noise_ratios(fit)
        shared, std = data.disturbed(fit), blow_noise(logged, records)
        if std.any():
            further = spread_by_inputs(data, fit, std, [record.inputs != 0.0 for record in records])
    else:
        data = data.as_measured()
        fit = settled(data, projected(data, fit.poles, fit.participation))
        noise = noise_levels(data, fit, records)
        own = (noise.outputs / fit.noise)[:, None] ** 2
        noise_ratio, beside, shared = np.tile(own, n), np.tile(own.T, (data.fixed.shape[1], 1)), np.ones(n)
        everywhere = [np.ones(record.inputs.shape, bool) for record in records]
        further = spread_by_inputs(data, fit, noise.inputs, everywhere)
        remarks = (*noise_remarks(records, noise), *remarks)
    channels, n_inputs = records[0].output_channels, records[0].n_inputs
    derivative = time_derivatives(channels)[:, None]
    shapes, participation = scaled_vectors(fit, np.arange(n), derivative)
    vectors = vector_covariance(fit, noise_ratio, derivative, np.arange(n), shapes, n_inputs, further)
    direct = np.zeros((len(channels), n_inputs))
    direct_std = np.zeros_like(direct)
    if data.feedthrough:
        direct = fit.coefficients[2 * n : 2 * n + n_inputs].T
        direct_std = fixed_std(fit, noise_ratio, beside, further)[:n_inputs].T
    return Driven(
        modes=SampledModes.of_poles(fit.poles, shapes, records[0].positions),
        covariance=frozen(pole_covariance(fit, noise_ratio * shared, further)),
        vector_covariance=frozen(vectors),
        participation=frozen(participation[:, :n_inputs], complex),
        feedthrough=frozen(direct),
        feedthrough_std=frozen(direct_std),
        delays=frozen(data.delays * data.dt),
        input_hold=data.hold,
        sample_time=data.dt,
        initial=tuple(
            frozen(np.zeros(n) if data.at_rest else participation[:, n_inputs + k], complex)
            for k in range(len(records))
        ),
        noise=frozen(data.noise(fit)),
        statistic=frozen(selected.statistic),
        threshold=selected.limit,
        converged=fit.converged,
        remarks=remarks,
        output_channels=channels,
        input_channels=records[0].input_channels,
    )
