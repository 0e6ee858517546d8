"""Modes of a structure that unknown broadband forces drive, from the covariances of its outputs.

Poles, shapes and their standard errors come from canonical variate analysis (`output_only/subspace.py`). Shapes are
read off the correlation functions: under forces that are white over the band of the modes, the correlation of two
outputs at a lag τ > 0 decays as the structure does when let go (NExT: James, Carne & Lauffer, SAND92-1666),

    R_ij(τ) = E y_i(t + τ) y_j(t) = Re Σ_r φ_ir c_jr e^{λ_r τ}.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from workbench.identification.output_only.subspace import StablePole, Subspace
from workbench.identification.signal.harmonics import harmonic_remarks
from workbench.identification.signal.modal_estimates import (
    ModalEstimates,
    by_poles,
    normalised_shapes,
    time_derivatives,
)
from workbench.identification.signal.projection import project
from workbench.identification.signal.searches import FALSE_ALARM, SECONDS, Budget, Progress, check_count
from workbench.records.record import Channel, Record
from workbench.renamed import Renamed, former_arguments
from workbench.structure.modes import SampledModes, frozen
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class AmbientSettings:
    """Constants of the identification under unknown forces."""

    most_references: int = 4
    blocks: int = 20  # twice so many times its longest lag a record is long, at least
    most_directions: int = 6  # combinations of outputs that modes are identified from
    above_errors: float = 4.0  # times that of the errors, that the energy of a lag must be to be kept
    least_lags: int = 64
    # standard error of a frequency up to which a mode counts as found, over √(ζω/T) of a mode alone without noise:
    # poles that only fit noise are not as sure
    least_sure: float = 5.0
    level_parts: int = 60  # of a record, of which the level is compared
    uneven: float = 3.5  # rms of the strongest over the median of them, that steady forces do not come to


AMBIENT = AmbientSettings()


@dataclass(frozen=True, eq=False, repr=False)
class AmbientModes(ModalEstimates):
    """Modes of a structure under unknown forces, with their standard errors.

    Attributes:
        modes: shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ), by leaving out parts of the record; zero between modes.
        statistic: (n_modes,) twice the log likelihood ratio of the record, predicted by one step, with and without each
            mode.
        threshold: what a mode fitted to noise alone exceeds with the chance of a false alarm.
        correlations: functions that the shapes are read off, one record a reference.
        remarks: on what may be harmonic excitation, and on what was left undone where the time was up.
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

    Lag 0 is left out: white noise of the sensors is in it alone.

    Args:
        record: driven by broadband forces all along.
        max_lag: longest lag, s; by default as long as the functions stand out of their errors.
        references: names of outputs; all unless given, or the four that move most.

    Returns:
        One record a reference, all outputs in each, for `stacked_delays`, `stabilise` or `refine` together; their
        standard errors are not those of white noise: take `identify_ambient`.

    Raises:
        ValueError: an unknown reference; a record shorter than forty times `max_lag`.
    """
    lags, rows = _lags(record, max_lag, references)
    blocks = _correlations(record, lags, rows, 1)
    return _as_records(record, blocks.sum(axis=0) / record.n_samples, rows)


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
        record: long: each twelfth of it is to be longer than a mode takes to decay.
        n_modes: that many, those of the highest test statistic; unless given, those that rise above the noise and whose
            frequency is as sure as that of a mode.
        max_lag: longest lag, s, as in `correlation_functions`.
        references: names of outputs, as in `correlation_functions`.
        false_alarm: chance that noise alone is taken for a mode; 0.001 unless given.
        seconds: of processor time, 30 unless given, after which standard errors come from fewer parts of the record,
            with a remark; None for no limit.
        progress: called with the search under way and the share of the time that is spent.

    Raises:
        ValueError: as `correlation_functions`; no mode found, or fewer than asked for.
    """
    check_count("n_modes", n_modes)
    budget = Budget(seconds, progress)
    lags, rows = _lags(record, max_lag, references)
    decays = _as_records(record, _correlations(record, lags, rows, 1)[0] / record.n_samples, rows)
    subspace = Subspace(_directions(record), record.sample_time)
    stable = subspace.stable()
    # A mode is its pole, its shape and its excitation, of which one has no scale, at one of so many frequencies.
    limit = float(chi2.isf(false_alarm / record.n_samples, 4 * subspace.n_outputs))
    if n_modes is None:
        modes = subspace.with_errors([mode for mode in stable if mode.statistic > limit], budget)
        least = 1.0 / (record.n_samples * record.sample_time)
        modes = [mode for mode in modes if mode.variance[1, 1] < AMBIENT.least_sure**2 * least * abs(mode.pole.real)]
    else:
        modes = subspace.with_errors(sorted(stable, key=lambda mode: -mode.statistic)[:n_modes], budget)
    if not modes or len(modes) < (n_modes or 0):
        many = "no mode that rises" if n_modes is None else f"{len(modes)} stable modes, not {n_modes}, that rise"
        raise ValueError(f"record {record.name!r} holds {many} above its noise; measure longer")
    return _report(record, sorted(modes, key=lambda mode: abs(mode.pole)), limit, decays, budget)


def _directions(record: Record) -> np.ndarray:
    """The outputs, or as many combinations of them as hold most of what they share, each of unit variance."""
    outputs = np.asarray(record.outputs / record.outputs.std(axis=1, keepdims=True))
    if record.n_outputs <= AMBIENT.most_directions:
        return outputs
    about = outputs - outputs.mean(axis=1, keepdims=True)
    vectors = np.linalg.eigh(about @ about.T)[1][:, -AMBIENT.most_directions :]
    return np.asarray(vectors.T @ about)


def _report(
    record: Record, found: Sequence[StablePole], limit: float, decays: tuple[Record, ...], budget: Budget
) -> AmbientModes:
    poles = np.array([mode.pole for mode in found])
    n = poles.size
    modes = SampledModes.of_poles(poles, _shapes(decays, poles), record.positions)
    covariance = np.zeros((2 * n, 2 * n))
    for r, mode in enumerate(found):
        jacobian = by_poles(poles[[r]])
        covariance[np.ix_([r, n + r], [r, n + r])] = jacobian @ mode.variance @ jacobian.T
    statistic = np.array([mode.statistic for mode in found])
    remarks = (*_uneven_level(record), *harmonic_remarks([record], poles, range(n)), *budget.remarks)
    return AmbientModes(modes, frozen(covariance), frozen(statistic), limit, decays, remarks)


def _uneven_level(record: Record) -> tuple[str, ...]:
    """A remark where the motion is much stronger in some parts of a record: then a few gusts make the estimates."""
    about = record.outputs - record.outputs.mean(axis=1, keepdims=True)
    parts = np.array_split(about / about.std(axis=1, keepdims=True), AMBIENT.level_parts, axis=1)
    rms = np.sqrt([float((part**2).mean()) for part in parts])
    ratio = float(rms.max() / np.median(rms))
    if ratio < AMBIENT.uneven:
        return ()
    return (
        f"the motion is {ratio:.2g} times as strong in some parts of the record as it mostly is: modes may be missing,"
        " and standard errors too small; measure while the forces are steady, or longer",
    )


def _shapes(decays: Sequence[Record], poles: np.ndarray) -> np.ndarray:
    """Shapes (n_outputs, n_modes) that all references agree on best: one of them may stand at a node."""
    both = np.stack([project(decay, poles, False).complex_amplitudes for decay in decays])
    shapes = np.stack([np.linalg.svd(both[:, :, r].T)[0][:, 0] for r in range(poles.size)], axis=1)
    return normalised_shapes(shapes / poles ** time_derivatives(decays[0].output_channels)[:, None])


def _lags(record: Record, max_lag: float | None, references: Sequence[str] | None) -> tuple[int, list[int]]:
    """How many lags, and the rows of the references."""
    if references is None:
        strongest = np.argsort(-record.outputs.std(axis=1))[: AMBIENT.most_references]
        rows = sorted(int(j) for j in strongest)
    else:
        rows = [record.output_names.index(name) for name in record.select_outputs(references).output_names]
    most, least = record.n_samples // (2 * AMBIENT.blocks), AMBIENT.least_lags // 4
    if most < least:
        raise ValueError(
            f"record {record.name!r} has {record.n_samples} samples; modes of random vibration take at least"
            f" {2 * AMBIENT.blocks * least}: measure longer"
        )
    lags = most if max_lag is None else round(max_lag / record.sample_time)
    if not least <= lags <= most:
        raise ValueError(
            f"record {record.name!r} has {record.n_samples} samples, enough for lags from"
            f" {least * record.sample_time:g} to {most * record.sample_time:g} s;"
            f" {lags * record.sample_time:g} s were asked for: measure longer, or ask for others"
        )
    if max_lag is None:
        found = _correlations(record, 4 * lags, rows, 1)[0]
        energy = (found / found.std(axis=2, keepdims=True)) ** 2
        windows = (
            energy.sum(axis=(0, 1))[: 4 * lags // AMBIENT.least_lags * AMBIENT.least_lags]
            .reshape(-1, AMBIENT.least_lags)
            .mean(axis=1)
        )
        errors = np.median(windows[windows.size // 2 :])
        lags = min(
            lags, AMBIENT.least_lags * max(1, int(np.argmax(np.r_[windows, 0.0] < AMBIENT.above_errors * errors)))
        )
    return lags, rows


def _correlations(record: Record, lags: int, rows: list[int], n_blocks: int) -> np.ndarray:
    """Sums over t of y_i(t + τ) y_j(t), τ from Δt on, by block of t: (n_blocks, n_references, n_outputs, lags)."""
    about = record.outputs - record.outputs.mean(axis=1, keepdims=True)
    edges = np.linspace(0, record.n_samples, n_blocks + 1).astype(int)
    sums = np.empty((n_blocks, len(rows), record.n_outputs, lags))
    for found, first, last in zip(sums, edges, edges[1:], strict=False):
        ahead = about[:, first : last + lags]
        size = 2 ** int(np.ceil(np.log2(ahead.shape[1] + lags)))
        forward, here = np.fft.rfft(ahead, size), np.fft.rfft(about[rows, first:last], size)
        found[:] = np.fft.irfft(here.conj()[:, None] * forward, size)[..., 1 : lags + 1]
    return sums


def _as_records(record: Record, correlations: np.ndarray, rows: list[int]) -> tuple[Record, ...]:
    """One a reference, in units of its standard deviation, so that all weigh alike."""
    size = record.outputs.std(axis=1)
    return tuple(
        Record(
            record.sample_time,
            found / size[j],
            tuple(Channel(c.name, c.quantity, c.unit, c.at) for c in record.output_channels),
            start_time=record.sample_time,
            name=f"{record.name} with {record.output_names[j]}",
        )
        for j, found in zip(rows, correlations, strict=True)
    )
