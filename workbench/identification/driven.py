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
from workbench.identification.input_output.changing_response import CHANGE_CHECK
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
from workbench.identification.input_output.output_clock import clock_remarks, on_inputs_clock, on_one_clock
from workbench.identification.input_output.peak_shape import overlap_remarks
from workbench.identification.input_output.residual_bursts import burst_remarks
from workbench.identification.input_output.sensor_drift import beside_drift
from workbench.identification.input_output.subspace_poles import subspace_poles
from workbench.identification.input_output.time_variance import beside_changing, change_remarks, joined
from workbench.identification.signal.data_quality import check_outputs_move, input_faults, of_same_sensors
from workbench.identification.signal.harmonics import harmonic_remarks
from workbench.identification.signal.modal_estimates import SURE, ParticipatingModes, credible, time_derivatives
from workbench.identification.signal.projection import correlation, disturbed
from workbench.identification.signal.searches import FALSE_ALARM, SECONDS, SELECTION, Budget, Progress, check_count
from workbench.records.record import HOLDS, Channel, Record
from workbench.renamed import Renamed, former_arguments
from workbench.rig.statespace import signal_names
from workbench.structure.modes import SampledModes, frozen
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class DrivenSettings:
    """Constants of the stages of an identification from known inputs."""

    strongest: int = 8  # modes for the first estimate of the noise
    noise_rounds: int = 4  # alternations between noise and modes
    decorrelation_rounds: int = 2  # selections of modes in combinations of outputs whose noise is uncorrelated
    spare_states: int = 20  # of a subspace model beyond two per mode: these fit noise
    drift_share: float = 0.2  # of the time left, for each selection that decides on a drift
    driven_share: float = 0.3  # share of the motion of a mode due to the inputs, below which they do not drive it
    final_seconds: float = 5.0  # of processor time for the last check of modes, even after the search used up its time


DRIVEN = DrivenSettings()
DELAY_SEARCH = "search for delays of the inputs"


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
        threshold: value that a mode fitted to noise alone exceeds with the probability of a false alarm.
        converged: whether the fit ended because its step was negligible.
        remarks: doubts about modes and data, and searches that the time limit ended early.
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
        """Noise of each output (n_outputs,), root mean square over the records."""
        return np.asarray(np.sqrt((self.noise**2).mean(axis=0)))

    @property
    def _measured_shapes(self) -> np.ndarray:
        return np.asarray(self.modes.shapes * self.modes.poles ** time_derivatives(self.output_channels)[:, None])

    @property
    def state_space(self) -> control.StateSpace:
        """The model from inputs delayed by `delays` to outputs in real modal form, two states per mode.

        With z = re + i im of each mode, A has blocks [[Re λ, -Im λ], [Im λ, Re λ]], and y = Re Σ 2 c z + D u. Inputs
        and outputs have the names of the record's channels.
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
        """Outputs (n_outputs, n_samples) of the model to inputs, delays included, without the constants of the records.

        Args:
            inputs: (n_inputs, n_samples) at the sample time of the records, zero before the first sample.
            record: index of the record whose initial state is taken; from rest unless given.
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
            z = data.modal_coordinate(pole, self.participation[r])[0]
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

    Any excitation of the modes serves: noise, multisine, PRBS, an impulse. A mode is included if it raises the
    likelihood by more than noise would in one record of a thousand. Impact forces are set to zero between the impacts,
    with a remark, as their channels hold only noise there.

    Args:
        records: with the same inputs and outputs at one rate; each output may hold a constant, another in each record.
        at_rest: whether all modes are at rest at the first sample; otherwise each record has its own initial state.
        input_hold: the inputs between samples: "zero" for a zero-order hold, such as the output of a D/A converter;
            "band-limited" for a signal without content above half the sample rate, such as a force behind an anti-alias
            filter; "first" for a first-order hold, linear from sample to sample, close to a force that is slow against
            the sample rate. As stated in the records unless given; a remark says where the data contradict it.
        feedthrough: whether there is a direct term: of accelerations, and of modes beyond the sample rate.
        delays: (n_inputs,) s, delay of each input; estimated unless given, up to 60 samples. For inputs held between
            samples, with a direct term, the response does not determine the fraction of a sample; it is the one that
            makes the modes most nearly real.
        max_modes: largest number of modes.
        false_alarm: probability that noise alone is taken for a mode; 0.001 unless given.
        seconds: of processor time, 30 unless given, after which the best so far is returned, with a remark; None for no
            limit.
        progress: called with the search under way and the share of the time that is spent.
        straight: former name of `input_hold="first"`; it warns.

    Returns:
        `Driven`. Its standard errors hold in noise of any smooth spectrum. They include white noise of the inputs,
        which is detected where two or more modes show it, with a remark.

    Raises:
        ValueError: no inputs, inputs that never move or move alike; an output that never moves; records that differ;
            too few samples; no mode.
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
    check_outputs_move(records)
    clipped = dict.fromkeys(fault.message for record in records for fault in input_faults(record))
    logged = records
    records, windowed = force_window(logged)
    by_amplitude = after_impacts(records, budget)
    data = KnownInputs(
        records,
        at_rest=at_rest,
        hold=hold,
        feedthrough=feedthrough,
        delays=_checked_delays(records, 0.0 if delays is None else delays),
        distorted=by_amplitude.changing,
        free=by_amplitude.poles,
    )
    rows, columns = data.fixed.shape
    if rows < columns + 4 * (data.n_excitations + 2):
        raise ValueError(
            f"record {records[0].name!r}: {rows} samples are too few for {records[0].n_inputs} inputs; measure longer"
        )
    most_modes = min(max_modes, (rows - columns) // 6)
    options = {"max_modes": most_modes, "false_alarm": false_alarm}
    trials: list[Budget] = []

    def selected_in(trial: KnownInputs) -> Selected:
        trials.append(budget.aside(DRIVEN.drift_share))
        return _select_strongest(trial, **options, budget=trials[-1])

    data, strongest, drift = beside_drift(data, selected_in)
    if any(trial.unfinished for trial in trials):
        strongest = None
    search = _select_with_delays if delays is None else _select
    data, selected = search(data, budget, strongest, **options)
    if selected.fit.poles.size == 0:
        raise ValueError(
            f"record {records[0].name!r}: no mode between inputs {', '.join(records[0].input_names)} and outputs"
            f" {', '.join(records[0].output_names)} rises above the noise; excite harder or longer, or check whether"
            " inputs and outputs belong together"
        )
    if data.clock:
        logged, records = ([on_inputs_clock(record, data.clock) for record in each] for each in (logged, records))
    data, selected, changing = _as_time_invariant(data, selected, budget)
    selected = _without_unpredictive(data, selected, Budget(DRIVEN.final_seconds))
    selected, remarks = _without_artefacts(data, selected, budget)
    if delays is None:
        remarks = (*_delay_remarks(data), *remarks)
    fit = joined(data, selected.fit, budget)
    selected = selected if fit is selected.fit else selected.refitted(fit)
    clocks = clock_remarks(data, selected.fit)
    holds = hold_remarks(data, selected.fit, selected.limit, budget)
    bursts = burst_remarks(logged, data.left(fit), fit.noise)
    overlap = overlap_remarks(selected.fit.poles, records[0].n_outputs * records[0].n_inputs)
    out_of_time = budget.spent(CHANGE_CHECK)
    in_decay = by_amplitude.among(fit.poles)
    changes, explained = ((), in_decay) if out_of_time else change_remarks(data, fit, changing, in_decay)
    distorted = (*selected.distorted, *left_about(data, fit))
    unexplained = [pole for pole in distorted if pole not in (*explained, *by_amplitude.changing)]
    changes = (*changes, *unpredictive_remarks(fit, unexplained))
    driven = _report(
        logged,
        records,
        data,
        selected,
        (*clipped, *clocks, *bursts, *windowed, *drift, *holds, *remarks, *overlap, *changes, *budget.remarks),
    )
    deviation = driven.modes.omega * driven.zeta_std + 1j * driven.omega_std
    decays = by_amplitude.remarks(fit.poles, _response_sizes(data, fit), deviation)
    # The response of a mode to the inputs may have a constant amplitude without being harmonic excitation.
    undamped = np.flatnonzero(driven.modes.zeta < SURE * driven.zeta_std).tolist()
    lasting = [r for r in undamped if _is_steady_and_undriven(data, fit, r)]
    doubtful = (*harmonic_remarks(records, fit.poles, undamped, lasting), *unexcited_remarks(records, fit.poles))
    return replace(driven, remarks=(*decays, *doubtful, *driven.remarks))


def _is_steady_and_undriven(data: KnownInputs, fit: Fit, r: int) -> bool:
    """Whether mode r does not decay within a record and the inputs excite only a small share of its motion."""
    pole, l_r = fit.poles[r], fit.participation[r].copy()
    responses = data.responses(pole)
    norm = np.linalg.norm(modal_coordinate(responses, l_r))
    l_r[data.n_inputs :] = 0.0
    by_inputs = np.linalg.norm(modal_coordinate(responses, l_r))
    decays = -pole.real * 2.0 * np.pi / data.resolution
    return bool(decays < 1.0 and by_inputs < DRIVEN.driven_share * norm)


def _response_sizes(data: KnownInputs, fit: Fit) -> Floats:
    """Norm of the response of each mode over all records, outputs in units of their noise, (n_modes,)."""
    each = zip(fit.poles, fit.participation, fit.amplitudes.T, strict=True)
    return np.array(
        [
            np.linalg.norm(a / fit.noise) * np.linalg.norm(np.concatenate(data.modal_coordinate(p, l_r)))
            for p, l_r, a in each
        ]
    )


def _select_with_delays(
    data: KnownInputs, budget: Budget, strongest: Selected | None, **options: Any
) -> tuple[KnownInputs, Selected]:
    """The data with estimated input delays, and the modes.

    A delay by a fraction of a sample is estimated where the first response to an input is later than without delay, or
    where the input a sample earlier explains part of the residual.
    """
    first = first_lags(data.records)
    if data.hold == "band-limited":
        return _select_with_band_limited_delays(data, first, budget, strongest, **options)
    whole = np.maximum(first - (0 if data.hold == "first" else 1), 0)
    without_delay: tuple[KnownInputs, Selected] | None = None
    if data.hold == "zero" and not first.any():
        return _select(data, budget, strongest, **options)
    delayed = data.delayed_by(whole, any_fraction=True)
    strongest = _select_strongest(delayed, budget=budget, **options)
    if not whole.any():
        if strongest.fit.poles.size == 0:
            return _select(data, budget, **options)
        if not act_later(delayed, strongest.fit).any():
            without_delay = undelayed, selected = _select(
                data, budget, _select_strongest(data, strongest.fit, budget=budget, **options), **options
            )
            more_modes = selected.fit.poles.size > strongest.fit.poles.size
            if not (more_modes and _any_acts_later(undelayed, selected, budget)) or budget.spent(DELAY_SEARCH):
                return without_delay
    undelayed = data
    data, selected = _select(delayed, budget, strongest, **options)
    fit = selected.fit
    if fit.poles.size == 0:
        return without_delay if without_delay is not None else (data.delayed_by(whole), selected)
    whole, fraction = _whole_and_fraction(data, fit, whole, budget)
    if not whole.any() and not fraction.any() and not budget.spent(DELAY_SEARCH):
        if without_delay is not None:
            return without_delay
        return _select(undelayed, budget, _select_strongest(undelayed, fit, budget=budget, **options), **options)
    delayed = data.delayed_by(whole + fraction)
    return delayed, selected.refitted(settled(delayed, _for_other_delays(delayed, data, fit), budget=budget))


def _select_with_band_limited_delays(
    data: KnownInputs, first: Floats, budget: Budget, strongest: Selected | None, **options: Any
) -> tuple[KnownInputs, Selected]:
    """The data with estimated delays of band-limited inputs, and the modes.

    The fraction of a sample is a parameter of its own here: no pair of fixed columns can represent it.
    """
    delayed = data.delayed_by(first) if first.any() else data
    for _ in range(DRIVEN.noise_rounds):  # so that no mode is fitted to the effect of a delay
        few, before = _subspace_start(delayed, **options), delayed
        if few.poles.size:
            delayed, _ = _with_best_delays(delayed, few, budget)
        if delayed is before:
            break
    delayed, selected = _select(delayed, budget, strongest if delayed is data else None, **options)
    if not selected.fit.poles.size:
        return delayed, selected
    improved, fit = _with_best_delays(delayed, selected.fit, budget)
    if improved is delayed:
        return delayed, selected
    return improved, selected.refitted(settled(improved, fit, budget=budget))


def _with_best_delays(data: KnownInputs, fit: Fit, budget: Budget) -> tuple[KnownInputs, Fit]:
    """The data with the most likely delays of band-limited inputs, and the fit with participation factors to match."""

    def moved(delays: Floats) -> tuple[KnownInputs, Fit]:
        other = data.delayed_by(delays)
        return other, _for_other_delays(other, data, fit)

    derivative = time_derivatives(data.records[0].output_channels)[:, None]
    delays = best_delays(data.delays, moved, derivative, budget)
    return (data, fit) if (delays == data.delays).all() else moved(delays)


def _whole_and_fraction(data: KnownInputs, fit: Fit, whole: Floats, budget: Budget) -> tuple[Floats, Floats]:
    """Delay of each input: whole samples, and the fraction of a sample, (n_inputs,) each, from a fit with any fraction.

    The first response detected is a sample late where the response before it was below the noise.
    """
    fraction = _fractional_delays(data, fit)
    doubtful = (whole > 0) & (fraction == 0)
    while doubtful.any() and not budget.spent(DELAY_SEARCH):
        data, fit = _with_free_fraction(data, fit, whole - doubtful, budget)
        fraction_before = _fractional_delays(data, fit)
        reduced = doubtful & (fraction_before < 1.0)
        whole, fraction = whole - reduced, np.where(reduced, fraction_before, fraction)
        doubtful = reduced & (whole > 0) & (fraction == 0)
    return whole, fraction


def _fractional_delays(data: KnownInputs, fit: Fit) -> Floats:
    """Fraction of a sample by which each input acts later than in `data`, (n_inputs,); 0 where it does not."""
    derivative = time_derivatives(data.records[0].output_channels)[:, None]
    return np.where(act_later(data, fit), fractions(data, fit, derivative), 0.0)


def _with_free_fraction(data: KnownInputs, fit: Fit, delays: Floats, budget: Budget) -> tuple[KnownInputs, Fit]:
    """The data with inputs delayed by whole samples and any fraction, and a fit just precise enough for decisions."""
    other = data.delayed_by(delays, any_fraction=True)
    return other, settled(other, _for_other_delays(other, data, fit), SELECTION.few_steps, budget, ORDER.decided)


def _for_other_delays(other: KnownInputs, data: KnownInputs, fit: Fit) -> Fit:
    """The fit to `data` with participation factors changed to the input delays of `other`."""
    turned = fit.participation.copy()
    turned[:, : data.n_inputs] *= np.exp(np.outer(fit.poles, other.delays - data.delays) * data.dt)
    return projected(other, fit.poles, turned)


def _any_acts_later(data: KnownInputs, selected: Selected, budget: Budget) -> bool:
    """Whether any input acts later than in `data`, given the selected modes."""
    other, trial = _with_free_fraction(data, selected.fit, data.delays, budget)
    return bool(act_later(other, trial).any())


def _select_strongest(data: KnownInputs, start: Fit | None = None, **options: Any) -> Selected:
    """The modes of `start`, or else of a subspace model, and further ones up to `DRIVEN.strongest`.

    As long as all are sure, as many more are searched: strong modes left out would be taken for noise.
    """
    fit, budget = _subspace_start(data, **options) if start is None else start, options["budget"]
    few = _few_modes(options, fit.poles.size)
    while True:
        selected = _without_unpredictive(data, select_modes(data, start=fit, **few), budget)
        fit, most = selected.fit, few["max_modes"]
        if fit.poles.size < most or most == options["max_modes"]:
            return selected
        # beside the residual about each: noise of the inputs leaves peaks at the modes far above white noise
        if sure_modes(data, fit, options["false_alarm"], budget).poles.size < fit.poles.size:
            return selected
        few = _few_modes(options, most + DRIVEN.strongest)


def _subspace_start(data: KnownInputs, **options: Any) -> Fit:
    """The significant modes of a subspace model, at most `max_modes`."""
    poles = subspace_poles(data.records, data.whole, 2 * options["max_modes"] + DRIVEN.spare_states)
    poles = np.append(poles[~is_about_distorted(data, poles)], data.free)
    fit = fit_of_poles(data, poles, options["false_alarm"])
    if fit.poles.size <= options["max_modes"]:
        return fit
    return only(data, fit, np.argsort(statistic_of_each(fit))[-options["max_modes"] :])


def _without_unpredictive(data: KnownInputs, selected: Selected, budget: Budget) -> Selected:
    """The selected modes without those that make the prediction of held-out data worse.

    These are marked as distorted: no further mode is searched near them.
    """
    fit, distorted = without_unpredictive(data, selected.fit, selected.statistic, budget)
    selected = selected if fit is selected.fit else selected.refitted(fit)
    return replace(selected, distorted=(*data.distorted, *distorted))


def _few_modes(options: dict[str, Any], fewest: int) -> dict[str, Any]:
    """The options with at most `DRIVEN.strongest` modes, or `fewest` where these are more."""
    return {**options, "max_modes": min(max(DRIVEN.strongest, fewest), options["max_modes"])}


def _delay_remarks(data: KnownInputs) -> tuple[str, ...]:
    names = data.records[0].input_names
    late = [f"{names[i]} {d:.2f} samples ({d * data.dt:.3g} s)" for i, d in enumerate(data.delays) if d > 0]
    return (f"inputs act late, by {', '.join(late)}: the model takes the delayed inputs",) if late else ()


def _checked_delays(records: Sequence[Record], delays: ArrayLike) -> np.ndarray:
    """Delay of each input in samples, (n_inputs,), from delays in s.

    Raises:
        ValueError: a delay that is negative or longer than a quarter of the shortest record.
    """
    dt, given = records[0].sample_time, np.broadcast_to(np.asarray(delays, float), (records[0].n_inputs,))
    longest = 0.25 * min(record.n_samples for record in records) * dt
    if not ((given >= 0) & (given <= longest)).all():
        raise ValueError(
            f"delays must lie between 0 and {longest:.3g} s, a quarter of the record, one per input; got {delays!s}"
        )
    whole = np.round(given / dt)
    return np.where(np.abs(given / dt - whole) < 1e-6, whole, given / dt)


def _select(
    data: KnownInputs, budget: Budget, strongest: Selected | None = None, **options: Any
) -> tuple[KnownInputs, Selected]:
    """The modes, estimated with the strongest first; where noise of the outputs is correlated, in combinations without.

    Returns:
        the data, weighted by their noise, and the modes.
    """
    options["budget"] = budget
    start = _subspace_start(data, **options) if strongest is None else strongest.fit
    start = settled(data, start, SELECTION.few_steps, budget, ORDER.decided)  # once for all searches from there
    sure = sure_modes(data, start, options["false_alarm"], budget)

    def sure_of(other: KnownInputs) -> Fit:
        return sure_modes(other, _subspace_start(other, **options), options["false_alarm"], budget)

    on_one = on_one_clock(data, sure, sure_of, budget)
    if on_one is not None:
        (data, sure), strongest = on_one, None
        start = sure
    noise = None if budget.spent("search for noise of the inputs") else input_noise(data, sure)
    if noise is not None:
        (data, start), strongest = with_white_noise(data, sure, noise, options["false_alarm"], budget), None
    if strongest is None:
        strongest = _select_strongest(data, start, **{**options, "budget": budget.share(SELECTION.search_share)})
    data = data.with_distorted(strongest.distorted)
    uncorrelated = data.apart(strongest.fit)
    if uncorrelated is None:
        return _select_weighted(data, strongest, options)
    # Correlated noise makes peaks in all outputs. Modes not found yet add to its estimate, hence the repetition.
    for _ in range(DRIVEN.decorrelation_rounds):
        again = _select_strongest(uncorrelated, strongest.fit, **options)
        uncorrelated, selected = _select_weighted(uncorrelated, again, options)
        further = uncorrelated.apart(selected.fit)
        if further is None or budget.spent("search in outputs of uncorrelated noise"):
            break
        uncorrelated, strongest = further, selected
    data = replace(data, line_std=None, beside=uncorrelated.beside, changing=uncorrelated.changing)
    fit = settled(data, projected(data, selected.fit.poles, selected.fit.participation), budget=budget)
    data = replace(data, line_std=data.noise_spectrum(fit))
    fit = settled(data, only(data, fit, np.argsort(np.abs(fit.poles))), budget=budget)
    return data, selected.refitted(fit)


def _select_weighted(data: KnownInputs, strongest: Selected, options: dict[str, Any]) -> tuple[KnownInputs, Selected]:
    """The modes of outputs of uncorrelated noise, weighted by the spectrum of the residual.

    Coloured noise may be taken for modes. A false mode fits noise at its lines, so that the noise there is
    underestimated and the mode appears significant. The noise is therefore estimated again without all doubtful modes;
    they stay if modes and noise together are less likely without them.
    """
    budget, few = options["budget"], _few_modes(options, strongest.fit.poles.size)
    data, selected = _alternate_with_noise(data, strongest, few, options, budget)
    doubtful = (selected.statistic < SELECTION.weak * selected.limit) | ~_are_oscillatory(data, selected)
    if data.line_std is None or not doubtful.any() or budget.spent("check of doubtful modes"):
        return data, selected
    sure = settled(data, only(data, selected.fit, ~doubtful), budget=budget)
    other = replace(data, line_std=data.noise_spectrum(sure))
    other, fewer = _alternate_with_noise(other, select_modes(other, start=sure, **options), options, options, budget)
    if budget.spent("check of doubtful modes"):
        return data, selected
    threshold = selected.limit * (selected.fit.poles.size - fewer.fit.poles.size)
    less_oscillatory = (~_are_oscillatory(data, selected)).sum() > (~_are_oscillatory(other, fewer)).sum()
    return (
        (other, fewer)
        if less_oscillatory or other.cost(fewer.fit) - data.cost(selected.fit) <= threshold
        else (data, selected)
    )


def _as_time_invariant(
    data: KnownInputs, selected: Selected, budget: Budget
) -> tuple[KnownInputs, Selected, tuple[complex, ...]]:
    """The modes refitted as time-invariant, without the columns of changing modes, and the poles that change.

    Noise, standard errors and responses are then those of the model returned. No mode counts as changing if these
    columns, in addition to all modes, explain no more than they would of noise.
    """
    if not data.changing:
        return data, selected, ()
    plain, before = replace(data, beside=None, changing=()), selected.fit
    fit = settled(plain, projected(plain, before.poles, before.participation), budget=budget)
    decrease = added_misfit(fit, before, before.noise)
    columns = (data.fixed.shape[1] - plain.fixed.shape[1]) * before.noise.size
    changing = data.changing if decrease > chi2.isf(FALSE_ALARM, columns) else ()
    data = replace(plain, line_std=plain.noise_spectrum(fit))
    fit = settled(data, only(data, fit, np.argsort(np.abs(fit.poles))), budget=budget)
    return data, selected.refitted(fit), changing


def _without_artefacts(data: KnownInputs, selected: Selected, budget: Budget) -> tuple[Selected, tuple[str, ...]]:
    """The modes refitted without poles that cannot be modes, and a remark on the poles left out."""
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


def _are_oscillatory(data: KnownInputs, selected: Selected) -> np.ndarray:
    """Whether each mode oscillates within a record and does not grow, (n_modes,); others may be coloured noise."""
    poles, span = selected.fit.poles, 2.0 * np.pi / data.resolution
    return np.asarray((np.abs(poles) > data.resolution) & (poles.real * span < SELECTION.most_growth))


def _alternate_with_noise(
    data: KnownInputs, selected: Selected, first_options: dict[str, Any], options: dict[str, Any], budget: Budget
) -> tuple[KnownInputs, Selected]:
    """Modes and noise spectrum, estimated alternately until both settle.

    Args:
        data: known inputs and outputs.
        selected: the modes to start from.
        first_options: options by which `selected` was selected.
        options: those of the selections that follow.
        budget: of time.
    """
    for _ in range(DRIVEN.noise_rounds):
        for _ in range(DRIVEN.noise_rounds):
            changing = beside_changing(data, selected.fit, selected.limit, budget)
            if changing is None:
                break
            fewer = select_modes(changing[0], start=changing[1], **first_options)
            # Close modes fit better than one changing mode. With one input and output both models were compared before.
            compared = data.values.shape[1] * data.n_inputs == 1
            allowed = selected.limit * max(selected.fit.poles.size - fewer.fit.poles.size, 0) if compared else 0.0
            if changing[0].cost(fewer.fit) >= data.cost(selected.fit) + allowed:
                break
            data, selected = changing[0], fewer
        line_std = data.noise_spectrum(selected.fit)
        if alike(line_std, data.line_std) and not (selected.full and first_options["max_modes"] < options["max_modes"]):
            break
        if budget.spent("estimation of the noise spectrum"):
            break
        weighted = replace(data.with_distorted(selected.distorted), line_std=line_std)
        reselected = _without_unpredictive(weighted, select_modes(weighted, start=selected.fit, **options), budget)
        # A search that the time limit ended early does not replace the one before.
        if budget.spent("estimation of the noise spectrum") and reselected.fit.poles.size < selected.fit.poles.size:
            break
        data, selected, first_options = weighted, reselected, options
    return data, selected


def _report(
    logged: Sequence[Record],
    records: Sequence[Record],
    data: KnownInputs,
    selected: Selected,
    remarks: tuple[str, ...],
) -> Driven:
    fit, n, from_inputs = selected.fit, selected.fit.poles.size, None
    if data.measured is None:
        noise_ratio, fixed_ratio = data.noise_ratios(fit)
        shared_noise = correlation([left.T for left in data.left(fit)])
        shared, std = disturbed(shared_noise, fit.amplitudes / fit.noise[:, None]), blow_noise(logged, records)
        if std.any():
            from_inputs = spread_by_inputs(data, fit, std, [record.inputs != 0.0 for record in records])
    else:
        data = replace(data, records=data.measured, measured=None, line_std=None)
        fit = settled(data, projected(data, fit.poles, fit.participation))
        noise = noise_levels(data, fit, records)
        noise_ratio = (noise.sensors_at(fit.poles.imag * data.dt) / fit.noise[:, None]) ** 2
        own = (noise.sensors_at(np.linspace(0.0, np.pi, data.size)) ** 2).mean(axis=1) / fit.noise**2
        fixed_ratio, shared = np.tile(own, (data.fixed.shape[1], 1)), np.ones(n)
        all_samples = [np.ones(record.inputs.shape, bool) for record in records]
        from_inputs = spread_by_inputs(data, fit, noise.inputs, all_samples)
        remarks = (*noise_remarks(records, noise), *remarks)
    channels, n_inputs = records[0].output_channels, records[0].n_inputs
    derivative = time_derivatives(channels)[:, None]
    shapes, participation = scaled_vectors(fit, np.arange(n), derivative)
    vectors = vector_covariance(fit, noise_ratio, derivative, np.arange(n), shapes, n_inputs, from_inputs)
    direct = np.zeros((len(channels), n_inputs))
    direct_std = np.zeros_like(direct)
    if data.has_direct:
        direct = fit.coefficients[2 * n : 2 * n + n_inputs].T
        direct_std = fixed_std(fit, noise_ratio, fixed_ratio, from_inputs)[:n_inputs].T
    return Driven(
        modes=SampledModes.of_poles(fit.poles, shapes, records[0].positions),
        covariance=frozen(pole_covariance(fit, noise_ratio * shared, from_inputs)),
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
