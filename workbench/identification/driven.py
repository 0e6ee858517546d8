"""Modes from measured inputs and outputs, whatever the excitation.

The response of each pole to the inputs is exact at the samples (`input_output/known_inputs.py`); all modes are fitted
at once by output error, maximum likelihood in normal noise of the sensors (`input_output/modal_fit.py`). The spectrum
of that noise is estimated from the residual, and the modes from it in turn (`input_output/noise_spectrum.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from warnings import warn

import control
import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from workbench.arrays import Floats
from workbench.identification.input_output.after_impacts import after_impacts
from workbench.identification.input_output.changing_response import CHANGE_CHECK
from workbench.identification.input_output.excitation import (
    begin_at_rest,
    check_inputs,
    force_window,
    unexcited_remarks,
)
from workbench.identification.input_output.fit_errors import fixed_std, pole_covariance, vector_covariance
from workbench.identification.input_output.held_out import left_about, unpredictive_remarks
from workbench.identification.input_output.input_delays import delay_remarks, hold_remarks, select_with_delays
from workbench.identification.input_output.input_noise import (
    noise_levels,
    noise_outside_impacts,
    noise_remarks,
    spread_by_inputs,
)
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import (
    MANY_ROWS,
    Fit,
    added_misfit,
    modal_coordinate,
    only,
    projected,
    scaled_vectors,
    settled,
)
from workbench.identification.input_output.model_order import SelectedModes, SelectionOptions
from workbench.identification.input_output.output_clock import clock_remarks, on_inputs_clock
from workbench.identification.input_output.peak_shape import overlap_remarks
from workbench.identification.input_output.selection import beside_drift, only_predictive, reweighted, select
from workbench.identification.input_output.time_variance import change_remarks, joined
from workbench.identification.signal.data_quality import (
    burst_remarks,
    check_outputs_move,
    input_faults,
    of_same_sensors,
)
from workbench.identification.signal.harmonics import harmonic_remarks
from workbench.identification.signal.modal_estimates import SURE, ParticipatingModes, credible, time_derivatives
from workbench.identification.signal.projection import correlation, disturbed
from workbench.identification.signal.searches import FALSE_ALARM, SECONDS, SELECTION, Progress, TimeLimit, check_count
from workbench.records.record import HOLDS, Channel, Record
from workbench.renamed import Renamed, former_arguments
from workbench.rig.statespace import signal_names
from workbench.structure.modes import SampledModes, frozen
from workbench.threads import one_blas_thread

DRIVEN_SHARE = 0.3  # share of the motion of a mode due to the inputs, below which they do not drive it
FINAL_SECONDS = 5.0  # of processor time for the last check of modes, even after the search used up its time


@dataclass(frozen=True, eq=False, repr=False)
class DrivenModes(ParticipatingModes):
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
        a = np.kron(np.diag(poles.real), np.eye(2)) + np.kron(np.diag(poles.imag), [[0.0, -1.0], [1.0, 0.0]])
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
) -> DrivenModes:
    """The modes between inputs and outputs, their number selected, with participation factors and standard errors.

    Any excitation of the modes serves: noise, multisine, PRBS, an impulse. A mode is included if it raises the
    likelihood by more than noise would in one record of a thousand. Impact forces are set to zero between the impacts,
    with a remark, as their channels hold only noise there.

    Args:
        records: with the same inputs and outputs at one rate; each output may hold a constant, another in each record.
        at_rest: whether all modes are at rest at the first sample; otherwise each record has its own initial state,
            unless the outputs of long records are as quiet before the first force as anywhere after it.
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
        `DrivenModes`. Its standard errors are valid in noise of any smooth spectrum. They include white noise of the
        inputs, which is detected where two or more modes show it, with a remark.

    Raises:
        ValueError: no inputs, inputs that never move or move alike; an output that never moves; records that differ;
            too few samples; no mode.
    """
    check_count("max_modes", max_modes)
    time_limit = TimeLimit(seconds, progress)
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
    by_amplitude = after_impacts(records, time_limit)
    n_samples = sum(record.n_samples for record in records)
    data = KnownInputs(
        records,
        at_rest=at_rest or (n_samples >= MANY_ROWS and begin_at_rest(records)),
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
    options = SelectionOptions(min(max_modes, (rows - columns) // 6), false_alarm, time_limit)
    data, strongest, drift = beside_drift(data, options)
    data, selected = (select_with_delays if delays is None else select)(data, options, strongest)
    if selected.fit.poles.size == 0:
        raise ValueError(
            f"record {records[0].name!r}: no mode between inputs {', '.join(records[0].input_names)} and outputs"
            f" {', '.join(records[0].output_names)} rises above the noise; excite harder or longer, or check whether"
            " inputs and outputs belong together"
        )
    if data.clock:
        logged, records = ([on_inputs_clock(record, data.clock) for record in each] for each in (logged, records))
    data, selected, changing = _as_time_invariant(data, selected, time_limit)
    selected = only_predictive(data, selected, TimeLimit(FINAL_SECONDS))
    selected, remarks = _without_artefacts(data, selected, time_limit)
    if delays is None:
        remarks = (*delay_remarks(data), *remarks)
    fit = joined(data, selected.fit, time_limit)
    selected = selected.refitted(fit)
    clocks = clock_remarks(data, fit)
    holds = hold_remarks(data, fit, selected.limit, time_limit)
    bursts = burst_remarks(logged, data.left(fit), fit.noise)
    overlap = overlap_remarks(fit.poles, records[0].n_outputs * records[0].n_inputs)
    out_of_time = time_limit.spent(CHANGE_CHECK)
    in_decay = by_amplitude.among(fit.poles)
    changes, explained = ((), in_decay) if out_of_time else change_remarks(data, fit, changing, in_decay)
    distorted = (*selected.distorted, *left_about(data, fit))
    unexplained = [pole for pole in distorted if pole not in (*explained, *by_amplitude.changing)]
    changes = (*changes, *unpredictive_remarks(fit, unexplained))
    doubts = (*clipped, *clocks, *bursts, *windowed, *drift, *holds, *remarks, *overlap, *changes, *time_limit.remarks)
    driven = _report(logged, records, data, selected, doubts)
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
    return bool(decays < 1.0 and by_inputs < DRIVEN_SHARE * norm)


def _response_sizes(data: KnownInputs, fit: Fit) -> Floats:
    """Norm of the response of each mode over all records, outputs in units of their noise, (n_modes,)."""
    coordinates = (np.concatenate(data.modal_coordinate(*each)) for each in zip(fit.poles, fit.participation))
    scaled = fit.amplitudes.T / fit.noise
    return np.array([np.linalg.norm(a) * np.linalg.norm(z) for a, z in zip(scaled, coordinates, strict=True)])


def _checked_delays(records: Sequence[Record], delays: ArrayLike) -> np.ndarray:
    """Delay of each input in samples, (n_inputs,), from delays in s."""
    dt, given = records[0].sample_time, np.broadcast_to(np.asarray(delays, float), (records[0].n_inputs,))
    longest = 0.25 * min(record.n_samples for record in records) * dt
    if not ((given >= 0) & (given <= longest)).all():
        raise ValueError(
            f"delays must lie between 0 and {longest:.3g} s, a quarter of the record, one per input; got {delays!s}"
        )
    whole = np.round(given / dt)
    return np.where(np.abs(given / dt - whole) < 1e-6, whole, given / dt)


def _as_time_invariant(
    data: KnownInputs, selected: SelectedModes, time_limit: TimeLimit
) -> tuple[KnownInputs, SelectedModes, tuple[complex, ...]]:
    """The modes refitted as time-invariant, without the columns of changing modes, and the poles that change.

    Noise, standard errors and responses are then those of the model returned. No mode counts as changing if these
    columns explain no more than they would of noise.
    """
    if not data.changing:
        return data, selected, ()
    plain, before = replace(data, beside=None, changing=()), selected.fit
    fit = settled(plain, projected(plain, before.poles, before.participation), time_limit=time_limit)
    decrease = added_misfit(fit, before, before.noise)
    columns = (data.fixed.shape[1] - plain.fixed.shape[1]) * before.noise.size
    changing = data.changing if decrease > chi2.isf(FALSE_ALARM, columns) else ()
    return *reweighted(plain, selected, fit, time_limit), changing


def _without_artefacts(
    data: KnownInputs, selected: SelectedModes, time_limit: TimeLimit
) -> tuple[SelectedModes, tuple[str, ...]]:
    """The modes refitted without poles that cannot be modes, and a remark on the poles left out."""
    out: list[float] = []
    fit = selected.fit
    while fit.poles.size > 1:
        std = np.sqrt(np.diag(pole_covariance(fit))).reshape(2, -1)
        modes = SampledModes.of_poles(fit.poles, fit.amplitudes, data.places)
        good = credible(modes, std[0], std[1], data.highest) & (modes.zeta <= SELECTION.max_damping)
        if good.all() or not good.any():
            break
        out += list(modes.frequencies_hz[~good])
        fit = settled(data, only(data, fit, good), time_limit=time_limit)
    if not out:
        return selected, ()
    which = ", ".join(f"{f:.4g}" for f in sorted(out))
    remark = (
        f"poles left out (negative damping, damping ratio above {SELECTION.max_damping:g}, undetermined frequency, or"
        f" above the Nyquist frequency): {which} Hz"
    )
    return selected.refitted(fit), (remark,)


def _report(
    logged: Sequence[Record],
    records: Sequence[Record],
    data: KnownInputs,
    selected: SelectedModes,
    remarks: tuple[str, ...],
) -> DrivenModes:
    """The result, with the noise of the inputs, where there is some, in its standard errors.

    `logged` are the records as measured, `records` those with the force window.
    """
    fit, n, from_inputs = selected.fit, selected.fit.poles.size, None
    if data.measured is None:
        noise_ratio, fixed_ratio = data.noise_ratios(fit)
        noise_of_outputs = correlation([left.T for left in data.left(fit)])
        shared = disturbed(noise_of_outputs, fit.amplitudes / fit.noise[:, None])
        std = noise_outside_impacts(logged, records)
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
    vectors = vector_covariance(fit, noise_ratio, derivative, np.arange(n), n_inputs, from_inputs)
    initial = np.zeros((len(records), n)) if data.at_rest else participation[:, n_inputs:].T
    direct = np.zeros((len(channels), n_inputs))
    direct_std = np.zeros_like(direct)
    if data.has_direct:
        direct = fit.coefficients[2 * n : 2 * n + n_inputs].T
        direct_std = fixed_std(fit, noise_ratio, fixed_ratio, from_inputs)[:n_inputs].T
    return DrivenModes(
        modes=SampledModes.of_poles(fit.poles, shapes, records[0].positions),
        covariance=frozen(pole_covariance(fit, noise_ratio * shared, from_inputs)),
        vector_covariance=frozen(vectors),
        participation=frozen(participation[:, :n_inputs], complex),
        feedthrough=frozen(direct),
        feedthrough_std=frozen(direct_std),
        delays=frozen(data.delays * data.dt),
        input_hold=data.hold,
        sample_time=data.dt,
        initial=tuple(frozen(column, complex) for column in initial),
        noise=frozen(data.noise(fit)),
        statistic=frozen(selected.statistic),
        threshold=selected.limit,
        converged=fit.converged,
        remarks=remarks,
        output_channels=channels,
        input_channels=records[0].input_channels,
    )
