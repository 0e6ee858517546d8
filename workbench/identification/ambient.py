"""Output-only identification: modes of a structure under unknown broadband forces, from covariances of its outputs.

Poles and their standard errors come from canonical variate analysis (`output_only/subspace.py`). Shapes are fitted to
the correlation functions: under forces that are white over the band of the modes, the correlation of two outputs at a
lag τ > 0 is a free decay of the structure (NExT: James, Carne & Lauffer, SAND92-1666),

    R_ij(τ) = E y_i(t + τ) y_j(t) = Re Σ_r φ_ir c_jr e^{λ_r τ}.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from workbench.identification.output_only.subspace import Subspace
from workbench.identification.signal.data_quality import check_outputs_move
from workbench.identification.signal.harmonics import harmonic_remarks
from workbench.identification.signal.modal_estimates import (
    ModalEstimates,
    by_poles,
    normalised_shapes,
    time_derivatives,
)
from workbench.identification.signal.projection import project
from workbench.identification.signal.searches import FALSE_ALARM, SECONDS, Progress, TimeLimit, check_count
from workbench.records.record import Record
from workbench.renamed import Renamed, former_arguments
from workbench.structure.modes import SampledModes, frozen
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class AmbientSettings:
    """Constants of the output-only identification."""

    max_references: int = 4
    min_length: int = 40  # of a record, in longest lags
    max_directions: int = 6  # combinations of outputs that modes are identified from
    min_energy_ratio: float = 4.0  # of the correlation functions at a lag to their errors
    min_lags: int = 64
    # standard error over √(ζω/T), that of a single mode without noise; poles that fit noise have a larger one
    max_frequency_error: float = 5.0
    level_parts: int = 60  # of a record, whose levels are compared
    max_level_ratio: float = 3.5  # rms of the strongest part over the median of all, which steady forces do not reach


AMBIENT = AmbientSettings()


@dataclass(frozen=True, eq=False, repr=False)
class AmbientModes(ModalEstimates):
    """Modes of a structure under unknown forces, with their standard errors.

    Attributes:
        modes: shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ), by the jackknife over blocks of the record; zero between modes.
        statistic: (n_modes,) twice the log-likelihood ratio, by one-step prediction, of the record with and without
            each mode.
        threshold: value that a mode fitted to noise alone exceeds with the probability of a false alarm.
        correlations: correlation functions that the shapes are fitted to, one record per reference.
        remarks: on possible harmonic excitation, and on searches that the time limit ended early.
    """

    modes: SampledModes
    covariance: np.ndarray
    statistic: np.ndarray
    threshold: float
    correlations: tuple[Record, ...]
    remarks: tuple[str, ...] = ()

    evidence, limit, decays = Renamed("statistic"), Renamed("threshold"), Renamed("correlations")


def correlation_functions(
    record: Record, *, max_lag: float | None = None, references: Sequence[str] | None = None
) -> tuple[Record, ...]:
    """Correlation functions of the outputs with each reference, as free decays.

    Lag 0 is left out, the only one that contains white noise of the sensors.

    Args:
        record: of broadband forces that act throughout.
        max_lag: longest lag, s; by default up to where the functions fall below their errors.
        references: names of outputs; all unless given, or the four of largest rms.

    Returns:
        One record per reference, with all outputs, for `stacked_delays`, `stabilise` or `refine` together. Their noise
        is not white, so that standard errors of `refine` are invalid: use `identify_ambient` for these.

    Raises:
        ValueError: an output that never moves; an unknown reference; a record shorter than forty times `max_lag`.
    """
    check_outputs_move([record])
    lags, rows = _lags(record, max_lag, references)
    correlations = _correlations(record, lags, rows) / record.n_samples
    std = record.outputs.std(axis=1)  # for equal weights of the references
    return tuple(
        Record(
            record.sample_time,
            values / std[j],
            tuple(replace(channel, noise_std=None) for channel in record.output_channels),
            start_time=record.sample_time,
            name=f"{record.name} with {record.output_names[j]}",
        )
        for j, values in zip(rows, correlations, strict=True)
    )


@former_arguments(longest="max_lag")
@one_blas_thread
def identify_ambient(
    record: Record,
    *,
    n_modes: int | None = None,
    max_lag: float | None = None,
    references: Sequence[str] | None = None,
    false_alarm: float = FALSE_ALARM,
    seconds: float | None = SECONDS,
    progress: Progress | None = None,
) -> AmbientModes:
    """The modes of a structure under unknown broadband forces, each with its standard error.

    Args:
        record: of such a length that a twelfth of it is longer than the decay time of a mode.
        n_modes: number of modes, those of the highest test statistic; unless given, the significant ones whose
            frequency has the standard error of a mode.
        max_lag: longest lag, s, as in `correlation_functions`.
        references: names of outputs, as in `correlation_functions`.
        false_alarm: probability that noise alone is taken for a mode; 0.001 unless given.
        seconds: of processor time, 30 unless given, after which standard errors come from fewer parts of the record,
            with a remark; None for no limit.
        progress: called with the search under way and the share of the time that is spent.

    Raises:
        ValueError: as `correlation_functions`; no mode found, or fewer than asked for.
    """
    check_count("n_modes", n_modes)
    time_limit = TimeLimit(seconds, progress)
    decays = correlation_functions(record, max_lag=max_lag, references=references)
    subspace = Subspace(_combinations(record), record.sample_time)
    stable = subspace.stable()
    # A mode has a pole, a shape and an excitation, less a scale factor, at one of n_samples frequencies.
    limit = float(chi2.isf(false_alarm / record.n_samples, 4 * subspace.n_outputs))
    if n_modes is None:
        found = subspace.with_errors([mode for mode in stable if mode.statistic > limit], time_limit)
        resolution = 1.0 / (record.n_samples * record.sample_time)
        most_variance = AMBIENT.max_frequency_error**2 * resolution
        found = [mode for mode in found if mode.variance[1, 1] < most_variance * abs(mode.pole.real)]
    else:
        found = subspace.with_errors(sorted(stable, key=lambda mode: -mode.statistic)[:n_modes], time_limit)
    n = len(found)
    if not n or n < (n_modes or 0):
        which = "no mode that rises" if n_modes is None else f"{n} stable modes, not {n_modes}, that rise"
        raise ValueError(f"record {record.name!r} holds {which} above its noise; measure longer")
    found.sort(key=lambda mode: abs(mode.pole))
    poles = np.array([mode.pole for mode in found])
    covariance = np.zeros((2 * n, 2 * n))
    for r, mode in enumerate(found):
        jacobian = by_poles(poles[[r]])
        covariance[np.ix_([r, n + r], [r, n + r])] = jacobian @ mode.variance @ jacobian.T
    modes = SampledModes.of_poles(poles, _shapes(decays, poles), record.positions)
    statistic = frozen([mode.statistic for mode in found])
    remarks = (*_uneven_level(record), *harmonic_remarks([record], poles, range(n)), *time_limit.remarks)
    return AmbientModes(modes, frozen(covariance), statistic, limit, decays, remarks)


def _combinations(record: Record) -> np.ndarray:
    """The outputs scaled to unit variance or, of more than `AMBIENT.max_directions`, their principal components."""
    outputs = np.asarray(record.outputs / record.outputs.std(axis=1, keepdims=True))
    if record.n_outputs <= AMBIENT.max_directions:
        return outputs
    centred = outputs - outputs.mean(axis=1, keepdims=True)
    vectors = np.linalg.eigh(centred @ centred.T)[1][:, -AMBIENT.max_directions :]
    return np.asarray(vectors.T @ centred)


def _uneven_level(record: Record) -> tuple[str, ...]:
    """A remark where the motion is much stronger in some parts of a record: a few gusts then dominate the estimates."""
    centred = record.outputs - record.outputs.mean(axis=1, keepdims=True)
    parts = np.array_split(centred / centred.std(axis=1, keepdims=True), AMBIENT.level_parts, axis=1)
    rms = np.sqrt([float((part**2).mean()) for part in parts])
    ratio = float(rms.max() / np.median(rms))
    if ratio < AMBIENT.max_level_ratio:
        return ()
    return (
        f"the motion is {ratio:.2g} times as strong in some parts of the record as in most: modes may be missing, and"
        " standard errors too small; measure while the forces are steady, or longer",
    )


def _shapes(decays: Sequence[Record], poles: np.ndarray) -> np.ndarray:
    """Shapes (n_outputs, n_modes) common to all references, by the SVD: a single reference may be at a node."""
    amplitudes = np.stack([project(decay, poles, False).complex_amplitudes for decay in decays])
    shapes = np.stack([np.linalg.svd(amplitudes[:, :, r].T)[0][:, 0] for r in range(poles.size)], axis=1)
    return normalised_shapes(shapes / poles ** time_derivatives(decays[0].output_channels)[:, None])


def _lags(record: Record, max_lag: float | None, references: Sequence[str] | None) -> tuple[int, list[int]]:
    """Number of lags, and indices of the references among the outputs."""
    if references is None:
        strongest = np.argsort(-record.outputs.std(axis=1))[: AMBIENT.max_references]
        rows = sorted(int(j) for j in strongest)
    else:
        rows = [record.output_names.index(name) for name in record.select_outputs(references).output_names]
    width = AMBIENT.min_lags
    most, least = record.n_samples // AMBIENT.min_length, width // 4
    if most < least:
        raise ValueError(
            f"record {record.name!r} has {record.n_samples} samples; modes of random vibration take at least"
            f" {AMBIENT.min_length * least}: measure longer"
        )
    lags = most if max_lag is None else round(max_lag / record.sample_time)
    if not least <= lags <= most:
        raise ValueError(
            f"record {record.name!r} has {record.n_samples} samples, enough for lags from"
            f" {least * record.sample_time:g} to {most * record.sample_time:g} s;"
            f" {lags * record.sample_time:g} s were asked for: measure longer, or ask for others"
        )
    if max_lag is None:
        correlations = _correlations(record, 4 * lags, rows)
        energy = (correlations / correlations.std(axis=2, keepdims=True)) ** 2
        windows = energy.sum(axis=(0, 1))[: 4 * lags // width * width].reshape(-1, width).mean(axis=1)
        errors = np.median(windows[windows.size // 2 :])
        lags = min(lags, width * max(1, int(np.argmax(np.r_[windows, 0.0] < AMBIENT.min_energy_ratio * errors))))
    return lags, rows


def _correlations(record: Record, lags: int, rows: list[int]) -> np.ndarray:
    """Sums over t of y_i(t + τ) y_j(t) for τ ≥ Δt, (n_references, n_outputs, lags)."""
    centred = record.outputs - record.outputs.mean(axis=1, keepdims=True)
    size = 2 ** int(np.ceil(np.log2(record.n_samples + lags)))
    outputs, references = np.fft.rfft(centred, size), np.fft.rfft(centred[rows], size)
    return np.ascontiguousarray(np.fft.irfft(references.conj()[:, None] * outputs, size)[..., 1 : lags + 1])
