"""Modes from measured frequency response functions (FRFs) at lines of any spacing.

    H_ji(s) = e^{-sτ_j} (Σ_r [c_jr l_ri / (s - λ_r) + conjugate] + s^k (D_ji + E_ji / s²))      at s = iω

for outputs that are the k-th time derivative of a displacement: D is the residual term of the modes above the band, E
of those below it. Each mode has one shape and one participation factor per reference. A delay τ_j, of a filter or a
clock, multiplies the residues of real modes by e^{-λ_r τ_j}: it is estimated from their phases, which grow with
frequency.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from workbench.arrays import Floats
from workbench.identification.input_output.changing_decay import beside_changing
from workbench.identification.input_output.fit_errors import fixed_std, pole_covariance, statistic_of, vector_covariance
from workbench.identification.input_output.modal_fit import Fit, projected, scaled_vectors, settled
from workbench.identification.input_output.model_order import SelectedModes, SelectionOptions, select_modes
from workbench.identification.input_output.peak_shape import PEAKS, overlap_remarks, parts_of, peaks
from workbench.identification.input_output.spectral_lines import Lines, relative_noise, window_rate
from workbench.identification.signal.clocks import CLOCKS, late_outputs
from workbench.identification.signal.harmonics import overtone_remarks
from workbench.identification.signal.modal_estimates import (
    SURE,
    ParticipatingModes,
    repeated_remarks,
    set_up_remarks,
    time_derivatives,
)
from workbench.identification.signal.projection import correlation_of_lines, disturbed, mixing_of
from workbench.identification.signal.searches import FALSE_ALARM, SECONDS, Progress, TimeLimit, check_count
from workbench.records.record import Channel
from workbench.renamed import Renamed, former_arguments
from workbench.rig.sensors import MEASURED
from workbench.structure.domain import place_array
from workbench.structure.modes import SampledModes, frozen
from workbench.structure.printed import mode_text
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class FrfSettings:
    """Constants of the stages of an identification from FRFs."""

    max_lines: int = 1500  # that are fitted together; more are fitted band by band
    band_lines: int = 600
    overlap_lines: int = 75  # added beyond each edge of a band
    lines_per_mode: int = 50  # of a band, at least
    max_frequency_error: float = 0.01  # relative standard error of a mode that is reported
    noise_modes: int = 4  # for the first estimate of the noise
    noise_rounds: int = 2  # estimates of the noise
    min_acausal_ratio: float = 10.0  # of the energy of impulse responses before the impulse to that after it
    min_noise_ratio: float = 1.5  # factor between estimated and stated noise that is remarked
    bandwidth_lines: float = 4.0  # of the half-power bandwidth, above which Hann's window adds under 5 % of damping
    noise_tolerance: float = 0.2  # rms log ratio of two estimates of the noise that agree


FRF = FrfSettings()


@dataclass(frozen=True, eq=False, repr=False)
class FrfModes(ParticipatingModes):
    """Modes of FRFs.

    Attributes:
        modes: shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ), the Cramér-Rao bound at the estimate.
        vector_covariance: (n_modes, k, k) of each mode's shape over its largest entry, real part, then of its
            participation factors, real and imaginary parts; k = n_outputs + 2 n_references.
        participation: (n_modes, n_references) complex l_r, for c_r the shape as the outputs measure it.
        misfit: (n_outputs,) rms of the residual: in units of the stated noise (1 where it is noise alone), or, where
            none was stated, of real and imaginary part each, in the unit of the output.
        statistic: (n_modes,) χ² of each mode in the noise.
        converged: whether the fit ended because its step was negligible.
        cluster_hz: for each mode the other members of its cluster (`peak_shape`), Hz: points measured one after
            another are inconsistent there, or the mode drifts or depends on amplitude.
        scatter_hz: (n_modes,) rms scatter of the frequency of a mode whose peak is not that of one pole
            (`peak_shape`), Hz; else 0. Such a mode drifts, depends on amplitude, or is blurred by a window.
        order_limited_hz: bands (lowest, highest line) in which the search stopped at the largest number of modes: the
            residual is not noise there; modes are missing, or the points are inconsistent.
        fitted: (n_outputs, n_references, n_frequencies) the model at the lines of the band.
        frequencies_hz: (n_frequencies,) those lines.
        lower_residual: (n_outputs, n_references) E, of displacement, 1/kg: rigid-body modes, and elastic modes far
            below the band. 0 where an output has no such term.
        lower_residual_std: (n_outputs, n_references) standard errors.
        upper_residual: (n_outputs, n_references) D, m/N: the flexibility of modes above the band.
        delays: (n_outputs,) s, delay τ of each output relative to the inputs; everything but `fitted` is corrected
            for it.
        remarks: doubts about modes and data, and searches that the time limit ended early.
    """

    misfit: np.ndarray
    statistic: np.ndarray
    converged: bool
    cluster_hz: tuple[tuple[float, ...], ...]
    scatter_hz: np.ndarray
    order_limited_hz: tuple[tuple[float, float], ...]
    fitted: np.ndarray
    frequencies_hz: np.ndarray
    lower_residual: np.ndarray
    lower_residual_std: np.ndarray
    upper_residual: np.ndarray
    delays: np.ndarray
    remarks: tuple[str, ...] = ()

    parts_hz, full_hz = Renamed("cluster_hz"), Renamed("order_limited_hz")
    evidence = Renamed("statistic")


@former_arguments(transfer="frf")
def coherence_noise(frf: ArrayLike, coherence: ArrayLike, *, averages: int) -> np.ndarray:
    """Standard error of real and imaginary part of FRFs, |H| ((1 - γ²) / (2 γ² n))^½.

    Args:
        frf: complex, of any shape.
        coherence: γ², of the same shape, in (0, 1].
        averages: n, number of independent averages.

    Raises:
        ValueError: a coherence outside (0, 1] or of another shape, fewer than two averages.

    Source: Bendat & Piersol, Random Data, 4th ed., section 9.1.
    """
    h, squared = np.asarray(frf), np.asarray(coherence, float)
    if squared.shape != h.shape or not ((squared > 0) & (squared <= 1)).all() or averages < 2:
        raise ValueError(
            f"coherence must have the shape {h.shape} of the FRFs, lie in (0, 1], and rest on two"
            f" averages or more; got shape {squared.shape}, {averages} averages"
        )
    return np.asarray(np.abs(h) * np.sqrt((1.0 - squared) / (2.0 * squared * averages)))


@former_arguments(most_modes="max_modes", transfer="frf")
@one_blas_thread
def identify_frf(
    frf: ArrayLike,
    frequencies_hz: ArrayLike,
    *,
    channels: tuple[Channel, ...],
    band_hz: tuple[float, float] | None = None,
    noise_std: ArrayLike | None = None,
    max_modes: int = 40,
    false_alarm: float = FALSE_ALARM,
    seconds: float | None = SECONDS,
    progress: Progress | None = None,
) -> FrfModes:
    """The modes of measured FRFs, their number selected, each with its standard error.

    More than 1500 lines are fitted band by band, with overlap. Delays of outputs that the phases of the modes show are
    corrected, with a remark.

    Args:
        frf: (n_outputs, n_frequencies), or (n_outputs, n_references, n_frequencies), complex, outputs per unit
            input, for e^(iωt); those for e^(-iωt) are recognised at evenly spaced lines, with a remark. Receptance,
            mobility or accelerance by the quantity of each channel.
        frequencies_hz: (n_frequencies,) increasing, at any spacing.
        channels: one per output; where no quantity is stated, the residual terms are those of any motion.
        band_hz: lowest and highest line to fit; modes outside the band are represented by residual terms.
        noise_std: standard error of real and imaginary part, one or of the shape of `frf`: from repeated
            measurements, or by `coherence_noise`. It sets the relative weights of the lines; its overall level is
            estimated from the residual, with a remark where that disagrees. Without it, noise is taken to be the same
            at all lines of an output, or, where neighbouring lines show it, to depend on reference, frequency and
            modulus of the lines (`relative_noise`). Standard errors then increase with the residual about each mode
            where that is larger than elsewhere.
        max_modes: largest number of modes of a band.
        false_alarm: probability that noise alone is taken for a mode; 0.001 unless given.
        seconds: of processor time, 30 unless given, after which the best so far is returned, with a remark; None for no
            limit.
        progress: called with the search under way and the share of the time that is spent.

    Raises:
        ValueError: shapes that do not fit, values that are not finite, a band with too few lines, no mode.
    """
    check_count("max_modes", max_modes)
    time_limit = TimeLimit(seconds, progress)
    h, f, noise = _checked(frf, frequencies_hz, channels, band_hz, noise_std)
    turned = _is_acausal(h, f)
    h = h.conj() if turned else h
    options = SelectionOptions(max_modes, false_alarm, time_limit)
    estimate, s = _in_bands(h, f, noise, channels, options), 2j * np.pi * f
    for least in (CLOCKS.min_phase, CLOCKS.min_refined_phase):
        late = _output_delays(estimate, channels, least)
        if not late.any() or time_limit.spent("search for delays of the outputs"):
            break
        delays = estimate.delays + late
        estimate = _in_bands(h * np.exp(s * delays[:, None, None]), f, noise, channels, options)
        fitted = frozen(estimate.fitted * np.exp(-s * delays[:, None, None]), complex)
        estimate = replace(estimate, delays=frozen(delays), fitted=fitted)
    overlap = overlap_remarks(estimate.modes.poles, h.shape[0] * h.shape[1])
    deviation = estimate.modes.omega * estimate.zeta_std + 1j * estimate.omega_std
    overtones = overtone_remarks(
        estimate.modes.poles, np.sqrt(estimate.statistic), 2.0 * np.pi * estimate.scatter_hz, deviation
    )
    checks = (
        *_delay_remarks(estimate.delays, channels),
        *repeated_remarks(estimate),
        *set_up_remarks(estimate),
        *([] if noise is None else _noise_remark(estimate.misfit)),
    )
    if turned:
        as_conjugates = "as in FRFs for e^(-iωt): their complex conjugates were identified"
        checks = (f"the impulse responses come before the impulse, {as_conjugates}", *checks)
    estimate = replace(
        estimate,
        remarks=(*checks, *estimate.remarks, *overlap, *_scatter_remark(estimate), *overtones, *time_limit.remarks),
        fitted=frozen(estimate.fitted.conj() if turned else estimate.fitted, complex),
    )
    if estimate.modes.n_modes == 0:
        raise ValueError(
            f"no mode rises above the noise between {f[0]:g} and {f[-1]:g} Hz; widen the band or measure with more"
            " averages"
        )
    return estimate


def _in_bands(
    h: np.ndarray, f: np.ndarray, noise: np.ndarray | None, channels: Sequence[Channel], options: SelectionOptions
) -> FrfModes:
    """The modes of all lines; more than `FRF.max_lines` are fitted band by band."""
    n_bands, lines_a_mode = (1, 3) if f.size <= FRF.max_lines else (-(-f.size // FRF.band_lines), FRF.lines_per_mode)
    share = f.size / n_bands

    def band(k: int, band_budget: TimeLimit) -> FrfModes:
        first, last = round(k * share), round((k + 1) * share)
        inside = slice(max(first - FRF.overlap_lines, 0), last + FRF.overlap_lines)
        edges = f[first] if k else 0.0, f[last] if last < f.size else np.inf
        noise_inside = None if noise is None else noise[..., inside]
        lines = Lines(h[..., inside], 2.0 * np.pi * f[inside], _residual_powers(channels), noise_inside)
        most = min(options.max_modes, lines.omega.size // lines_a_mode)
        selected = _select_in_band(lines, SelectionOptions(most, options.false_alarm / n_bands, band_budget))
        return _modes_of(*selected, channels, edges, f[first:last])

    time_limit, limits, results = options.time_limit, [], []
    for k in range(n_bands):
        limits.append(time_limit.apart(1.0 / (n_bands - k)))
        results.append(band(k, limits[k]))
    # A band of modes that change takes many times its share of the time; other bands hardly use theirs.
    ended = [k for k in range(n_bands) if limits[k].unfinished]
    for remaining, k in zip(range(len(ended), 0, -1), ended, strict=True):
        again = time_limit.apart(1.0 / remaining)
        if (again.seconds or 0.0) > (limits[k].seconds or 0.0):
            results[k], limits[k] = band(k, again), again
        time_limit.counted(limits[k])
    return _joined(results, channels) if n_bands > 1 else results[0]


def _output_delays(estimate: FrfModes, channels: Sequence[Channel], least: float) -> Floats:
    """Delay of each output relative to the inputs, (n_outputs,) s, by `late_outputs`; 0 for outputs of no motion."""
    delays, known = np.zeros(len(channels)), np.array([channel.quantity in MEASURED for channel in channels])
    if known.any() and estimate.modes.n_modes:
        residues = 1j * estimate.modes.shapes.T[:, known, None] * estimate.participation[:, None, :]
        delays[known] = late_outputs(residues, estimate.modes.poles, least)
    return delays


def _delay_remarks(delays: Floats, channels: Sequence[Channel]) -> tuple[str, ...]:
    late = ", ".join(f"{c.name} {d:.3g} s" for c, d in zip(channels, delays, strict=True) if d)
    return (f"outputs are delayed relative to the inputs, by {late}: the modes are corrected for it",) if late else ()


def _select_in_band(lines: Lines, options: SelectionOptions) -> tuple[Lines, SelectedModes]:
    """The lines of a band with weights, and their modes; noise not stated is estimated from the strongest modes."""
    if lines.noise is not None:
        return _select_with_changing(lines, options)
    h, time_limit = lines.h, options.time_limit
    few = replace(options, max_modes=min(FRF.noise_modes, options.max_modes))
    selected = select_modes(lines, few)
    guessed = relative_noise(lines, selected.fit)
    if guessed is None:  # noise proportional to the response would look like modes that change
        lines, selected = _select_with_changing(lines, few, selected)
        guessed = relative_noise(lines, selected.fit)
    residual = lines.left(selected.fit)
    # Correlation of noise is tested in second differences over the lines (Hann's window of the impulse response): they
    # suppress modelling errors, which are smooth over the lines. The residual is scaled first, because a few large
    # lines among small ones would show some correlation in any case.
    scaled = residual if guessed is None else residual / guessed
    lines = replace(lines, window_rate=window_rate(scaled, lines.omega))
    differences = np.diff(scaled, 2)
    mixing = mixing_of(correlation_of_lines([differences.reshape(len(h), -1)]))
    if mixing is None:
        return _select_weighted(lines, selected, options)
    # Correlated noise makes peaks in all outputs; modes are selected in combinations of uncorrelated noise.
    mixed = np.tensordot(mixing / np.sqrt((np.abs(residual) ** 2).mean(axis=(1, 2))), h, 1)
    uncorrelated, selected = _select_weighted(
        *_select_with_changing(replace(lines, h=mixed, noise=None, guessed=False), few), options
    )
    lines = replace(uncorrelated, h=h, noise=None, guessed=False)
    fit = settled(lines, projected(lines, selected.fit.poles, selected.fit.participation), time_limit=time_limit)
    guessed = relative_noise(lines, fit)
    if guessed is not None:
        lines = replace(lines, noise=guessed, guessed=True)
        fit = settled(lines, projected(lines, fit.poles, fit.participation), time_limit=time_limit)
    return lines, selected.refitted(fit)


def _select_with_changing(
    lines: Lines, options: SelectionOptions, selected: SelectedModes | None = None
) -> tuple[Lines, SelectedModes]:
    """The lines with columns for the motion of modes that change, and the modes, one for each that changes."""
    selected = select_modes(lines, options) if selected is None else selected
    while (change := beside_changing(lines, selected.fit, selected.limit, options.time_limit)) is not None:
        lines, start = change
        selected = select_modes(lines, options, start)
    return lines, selected


def _select_weighted(lines: Lines, selected: SelectedModes, options: SelectionOptions) -> tuple[Lines, SelectedModes]:
    """The lines and their modes, with alternating estimates of noise and modes, for outputs of uncorrelated noise."""
    time_limit = options.time_limit
    before: np.ndarray | None = None
    for _ in range(FRF.noise_rounds):
        guessed = relative_noise(lines, selected.fit)
        if guessed is None:
            break
        # the estimates agree up to a factor
        if before is not None and np.log(guessed / before).std(axis=(1, 2)).max() < FRF.noise_tolerance:
            break
        if time_limit.spent("estimation of the noise"):
            return lines, selected
        before = guessed
        weighted = replace(lines, noise=guessed, guessed=True, beside=None, changing=())
        # The selection starts from the modes found: with noise proportional to the response, lines between modes have
        # the largest weights, and the least information.
        weighted, reselected = _select_with_changing(weighted, options, select_modes(weighted, options, selected.fit))
        if time_limit.spent("estimation of the noise") and reselected.fit.poles.size < selected.fit.poles.size:
            return lines, selected
        lines, selected = weighted, reselected
    return (lines, selected) if lines.guessed else _select_with_changing(lines, options)


def _modes_of(
    lines: Lines,
    selected: SelectedModes,
    channels: Sequence[Channel],
    edges_hz: tuple[float, float],
    shown_hz: np.ndarray,
) -> FrfModes:
    """The result for a band, from the lines of the band and its overlap and their modes.

    Modes are reported between `edges_hz`, the fit at the lines `shown_hz` (n_frequencies,).
    """
    fit, cluster_hz = _clustered(lines, selected, channels)
    peak_shapes = peaks(lines, fit)
    scatter = np.where(peak_shapes.uneven, peak_shapes.scatter, 0.0)
    for pole, by in lines.changing:
        r = int(np.argmin(np.abs(fit.poles - pole)))
        scatter[r] = max(scatter[r], by)
    damped_hz = fit.poles.imag / (2.0 * np.pi)
    noise_ratio = np.tile(lines.noise_ratio_near(fit), (len(channels), 1))
    stated = lines.weights is not None and not lines.guessed
    correlation = None if stated else correlation_of_lines([lines.left(fit).reshape(len(channels), -1)])
    covariance = pole_covariance(fit, noise_ratio * disturbed(correlation, fit.amplitudes / fit.noise[:, None]))
    sure = np.sqrt(np.diag(covariance)[: fit.poles.size]) < FRF.max_frequency_error * np.abs(fit.poles)
    sure &= fit.poles.real < SURE * np.sqrt(np.diag(covariance)[fit.poles.size :]) * np.abs(fit.poles)
    within = (fit.poles.imag >= lines.omega[0]) & (fit.poles.imag <= lines.omega[-1])
    within &= (damped_hz >= edges_hz[0]) & (damped_hz < edges_hz[1])
    inside = np.flatnonzero(within & sure)
    unsure = ", ".join(f"{f:.4g}" for f in damped_hz[within & ~sure])
    left_out = [f"poles left out (negative damping or undetermined frequency): {unsure} Hz"] if unsure else []
    derivative, poles = time_derivatives(channels)[:, None], fit.poles[inside]
    shapes, participation = scaled_vectors(fit, inside, derivative)
    vectors = vector_covariance(fit, noise_ratio, derivative, inside, lines.n_inputs)
    kept = np.r_[inside, fit.poles.size + inside]
    at = np.searchsorted(lines.omega, 2.0 * np.pi * shown_hz[0])
    below, below_std, above = _residual_terms(lines, fit, noise_ratio, derivative[:, 0])
    return FrfModes(
        modes=SampledModes.of_poles(poles, shapes, _places(channels)),
        covariance=frozen(covariance[np.ix_(kept, kept)]),
        vector_covariance=frozen(vectors),
        participation=frozen(participation, complex),
        misfit=frozen(lines.misfit(fit)),
        statistic=frozen([statistic_of(fit, int(r)) for r in inside]),
        converged=fit.converged,
        cluster_hz=tuple(cluster_hz[r] for r in inside),
        scatter_hz=frozen(scatter[inside] / (2.0 * np.pi)),
        order_limited_hz=((float(shown_hz[0]), float(shown_hz[-1])),) if selected.full else (),
        fitted=frozen(lines.fitted(fit)[..., at : at + shown_hz.size], complex),
        frequencies_hz=frozen(shown_hz),
        lower_residual=frozen(below),
        lower_residual_std=frozen(below_std),
        upper_residual=frozen(above),
        delays=frozen(np.zeros(len(channels))),
        remarks=(*left_out, *_window_remark(lines.window_rate)),
    )


def _residual_terms(
    lines: Lines, fit: Fit, noise_ratio: Floats, derivative: np.ndarray
) -> tuple[Floats, Floats, Floats]:
    """E, its standard errors, and D, (n_outputs, n_references) each, for outputs of any quantity.

    The acceleration of a mode φ_j φ_i s² / (s² + ω²) is the sum of its pair of poles and of φ_j φ_i, which E of the fit
    includes. A pole below the band, a l / 2 (1/s + λ/s²) and its conjugate at the lines, is part of the residual term.
    """
    n, size = 2 * fit.poles.size, lines.n_inputs * len(lines.powers)
    scale = lines.omega[-1] ** -np.array(lines.powers, float)
    std = fixed_std(fit, noise_ratio, np.ones((fit.coefficients.shape[0] - n, len(derivative))))
    low = fit.poles.imag < lines.omega[0]
    if low.any():  # the error of the sum of these poles and E, as they are not determined separately
        weights = np.ones((len(lines.fixed), 1)) if lines.weights is None else lines.weights
        std = fit.noise / np.sqrt((lines.fixed**2).T @ weights**2)
    both = fit.coefficients[n:], std
    terms, errors = (x[:size].reshape(lines.n_inputs, len(scale), -1) * scale[:, None] for x in both)
    below, below_std, above = (np.zeros((len(derivative), lines.n_inputs)) for _ in range(3))
    # For each derivative: terms in s^(k - 2) of the poles below the band, less those of the poles within it.
    factors = low * fit.poles, low, (low - 1.0) / fit.poles
    pole_terms = np.stack([fit.amplitudes * x for x in factors]) @ fit.participation
    for j, order in enumerate(derivative):
        if order in lines.powers:
            above[j] = terms[:, lines.powers.index(order), j]
        if order - 2 in lines.powers:
            power = lines.powers.index(order - 2)
            below[j], below_std[j] = terms[:, power, j] + pole_terms[order, j].real, errors[:, power, j]
    return below, below_std, above


def _is_acausal(h: np.ndarray, f: np.ndarray) -> bool:
    """Whether impulse responses precede the impulse: FRFs of the opposite sign convention."""
    step = np.diff(f)
    if np.ptp(step) > 1e-6 * step.max():
        return False
    power = (np.abs(np.fft.ifft(h * np.hanning(f.size), axis=-1)) ** 2).sum(axis=(0, 1))
    after, before = power[1 : f.size // 2].sum(), power[-(f.size // 2) + 1 :].sum()
    return bool(before > FRF.min_acausal_ratio * after)


def _window_remark(rate: float) -> tuple[str, ...]:
    """A remark where the noise shows an exponential window of decay rate `rate`, 1/s; 0 for none."""
    if rate == 0.0:
        return ()
    return (
        f"an exponential window of a time constant τ of about {1.0 / rate:.2g} s? It adds 1/τ to the decay rate of"
        " every mode, 1/(τ ω) to its damping ratio: take that off, by the τ that was set",
    )


def _noise_remark(misfit: Floats) -> tuple[str, ...]:
    """A remark where the residual, as the median of all outputs, is not as large as the stated noise."""
    ratio = float(np.median(misfit))
    if 1.0 / FRF.min_noise_ratio < ratio < FRF.min_noise_ratio:
        return ()
    return (f"the residual is {ratio:.2g} times noise_std; standard errors are based on the residual",)


def _scatter_remark(estimate: FrfModes) -> tuple[str, ...]:
    """A remark on modes whose peak in the FRFs is not that of a single pole."""
    hz = estimate.modes.frequencies_hz
    each = enumerate(zip(hz, estimate.scatter_hz, strict=True))
    which = [mode_text(r, f, f", by {scatter:.3g} Hz rms") for r, (f, scatter) in each if scatter > 0]
    if not which:
        return ()
    lines = 2.0 * estimate.modes.zeta * hz / np.diff(estimate.frequencies_hz).min()
    narrow = [str(r + 1) for r in np.flatnonzero((estimate.scatter_hz > 0) & (lines < FRF.bandwidth_lines))]
    leaks = (
        f". Fewer than {FRF.bandwidth_lines:g} lines lie in the half-power bandwidth of mode{'s' * (len(narrow) > 1)}"
        f" {', '.join(narrow)}: if these are averages with a Hann window, its leakage makes that damping too high"
    )
    return (
        f"frequencies scatter in the peaks of {', '.join(which)}: such a mode changes with time or amplitude, or a"
        " window blurs it, and its frequency and damping are means; measure at one level, and longer segments"
        f"{leaks if narrow else ''}",
    )


def _clustered(
    lines: Lines, selected: SelectedModes, channels: Sequence[Channel]
) -> tuple[Fit, list[tuple[float, ...]]]:
    """The fit with one mode per cluster, and for each mode the frequencies of the other members, Hz."""
    fit = selected.fit
    shapes = fit.amplitudes / fit.poles ** time_derivatives(channels)[:, None]
    estimates = SampledModes.of_poles(fit.poles, shapes, _places(channels))
    members = parts_of(fit.poles, estimates.phase_collinearity, selected.statistic)
    kept = np.setdiff1d(np.arange(fit.poles.size), [r for each in members.values() for r in each])
    cluster_hz = [tuple(sorted(fit.poles.imag[members.get(int(r), [])] / (2.0 * np.pi))) for r in kept]
    if not members:
        return fit, cluster_hz
    mean_poles = fit.poles.copy()
    for r, others in members.items():
        cluster = [r, *(k for k in others if np.abs(fit.poles.real[k]) < PEAKS.max_width * np.abs(fit.poles.real[r]))]
        mean_poles[r] = np.average(fit.poles[cluster], weights=selected.statistic[cluster])
    return settled(lines, projected(lines, mean_poles[kept], fit.participation[kept])), cluster_hz


def _joined(bands: Sequence[FrfModes], channels: Sequence[Channel]) -> FrfModes:
    """The results of all bands in one."""
    modes_by_band = [band.modes for band in bands]
    n = [modes.n_modes for modes in modes_by_band]
    covariance = block_diag(*(band.covariance for band in bands))
    first = np.concatenate([np.arange(k) + 2 * sum(n[:i]) for i, k in enumerate(n)]).astype(int)
    kept = np.r_[first, first + np.repeat(n, n)]
    omega, zeta = (np.concatenate([getattr(modes, name) for modes in modes_by_band]) for name in ("omega", "zeta"))
    shapes = np.hstack([modes.shapes for modes in modes_by_band])

    def together(name: str, axis: int = 0, dtype: type = float) -> np.ndarray:
        return frozen(np.concatenate([getattr(band, name) for band in bands], axis), dtype)

    share = np.array([band.frequencies_hz.size for band in bands]) / sum(band.frequencies_hz.size for band in bands)
    return FrfModes(
        modes=SampledModes(omega, zeta, shapes, _places(channels)),
        covariance=frozen(covariance[np.ix_(kept, kept)]),
        vector_covariance=together("vector_covariance"),
        participation=together("participation", dtype=complex),
        misfit=frozen(np.sqrt(share @ np.array([band.misfit for band in bands]) ** 2)),
        statistic=together("statistic"),
        converged=all(band.converged for band in bands),
        cluster_hz=tuple(parts for band in bands for parts in band.cluster_hz),
        scatter_hz=together("scatter_hz"),
        order_limited_hz=tuple(full for band in bands for full in band.order_limited_hz),
        fitted=together("fitted", -1, complex),
        frequencies_hz=together("frequencies_hz"),
        lower_residual=bands[0].lower_residual,
        lower_residual_std=bands[0].lower_residual_std,
        upper_residual=bands[-1].upper_residual,
        delays=bands[0].delays,
        remarks=tuple(dict.fromkeys(remark for band in bands for remark in band.remarks)),
    )


def _residual_powers(channels: Sequence[Channel]) -> list[int]:
    """Powers of s in the residual terms of modes above and below the band."""
    measured = {k for k, c in zip(time_derivatives(channels), channels, strict=True) if c.quantity in MEASURED}
    return sorted({int(power) for k in measured or {0, 2} for power in (k, k - 2)})


def _places(channels: Sequence[Channel]) -> np.ndarray:
    return place_array([channel.at for channel in channels])


def _checked(
    frf: ArrayLike,
    frequencies_hz: ArrayLike,
    channels: Sequence[Channel],
    band_hz: tuple[float, float] | None,
    noise_std: ArrayLike | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    h, f = np.asarray(frf, complex), np.asarray(frequencies_hz, float)
    h = h[:, None] if h.ndim == 2 else h
    if h.ndim != 3 or h.shape[0] != len(channels) or h.shape[1] == 0 or f.shape != h.shape[2:]:
        raise ValueError(
            f"FRFs must have shape ({len(channels)} outputs, [n_references,] {f.size} frequencies); got"
            f" {np.shape(frf)}. Is frequency the last axis?"
        )
    if not np.isfinite(f).all() or (np.diff(f) <= 0).any():
        raise ValueError("FRFs need finite frequencies that increase; sort them, each once")
    noise: np.ndarray | None = None
    if noise_std is not None:
        if np.shape(noise_std) not in ((), np.shape(frf)):
            raise ValueError(f"noise_std must have the shape of frf, {np.shape(frf)}; got {np.shape(noise_std)}")
        noise = np.broadcast_to(np.asarray(noise_std, float), np.shape(frf)).reshape(h.shape)
        if not ((noise > 0) & np.isfinite(noise)).all():
            raise ValueError("noise_std must be positive and finite at every line; give lines without noise a floor")
    low, high = (0.0, np.inf) if band_hz is None else band_hz
    keep = (f >= low) & (f <= high) & (f > 0)
    if keep.sum() < 12:
        raise ValueError(f"{int(keep.sum())} lines lie between {low:g} and {high:g} Hz; a fit needs 12 or more")
    bad = np.argwhere(~np.isfinite(h[:, :, keep]))
    if len(bad):
        j, _, line = bad[0]
        raise ValueError(f"output {channels[j].name!r} is not finite at {f[keep][line]:g} Hz; leave that line out")
    return h[:, :, keep], f[keep], None if noise is None else noise[:, :, keep]
