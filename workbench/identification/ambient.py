"""Modes of a structure that unknown broadband forces drive: correlation functions are free decays.

Under forces that are white over the band of the modes, the correlation of two outputs at a lag τ > 0 decays as the
structure does when let go (NExT: James, Carne & Lauffer, SAND92-1666),

    R_ij(τ) = E y_i(t + τ) y_j(t) = Re Σ_r φ_ir c_jr e^{λ_r τ},

so that all that reads free decays reads them. Their errors are neither white nor independent of lag. Standard errors
come from the record itself: R is a mean over blocks of t, and the modes are found anew with each block left out
(delete-one jackknife, Efron & Tibshirani 1993, ch. 11).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from workbench.identification.ibrahim import normalised_shapes, stacked_delays
from workbench.identification.identified import MOST_DAMPED, SAME_SHAPE
from workbench.identification.refinement import Refined, refine
from workbench.identification.stabilisation import real_modes, stabilise
from workbench.identification.standard_errors import StandardErrors
from workbench.identification.synthesis import time_derivatives
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes, frozen, mac

MOST_REFERENCES = 4
BLOCKS = 20
HIGHEST_ORDER = 20
# Lags are kept while their energy is so many times that of the errors.
ABOVE_ERRORS = 4.0
LEAST_LAGS = 64
# Relative standard error of a frequency up to which a mode counts as found.
LEAST_SURE = 0.01


@dataclass(frozen=True, eq=False)
class AmbientModes(StandardErrors):
    """Modes of a driven structure, and how far each figure is to be trusted.

    Attributes:
        modes: shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ), by the jackknife.
        n_blocks: left out one by one.
        decays: the correlation functions they were read from, one record a reference.
    """

    modes: SampledModes
    covariance: np.ndarray
    n_blocks: int
    decays: tuple[Record, ...]

    def interval(self, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Confidence intervals of ω and of ζ, (2, n_modes) each, by Student's t of n_blocks - 1."""
        return self._within(float(student.ppf(0.5 * (1.0 + level), self.n_blocks - 1)))


def ambient_decays(
    record: Record, *, longest: float | None = None, references: Sequence[str] | None = None
) -> tuple[Record, ...]:
    """Correlation functions of the outputs with each reference, as free decays.

    Lag 0 is left out: white noise of the sensors is in it alone.

    Args:
        record: driven by broadband forces all along.
        longest: lag, s; by default as long as the functions stand out of their errors.
        references: names of outputs; all unless given, or the four that move most.

    Returns:
        One record a reference, all outputs in each, for `stacked_delays`, `stabilise` or `refine` together; their
        standard errors are not those of white noise: take `identify_ambient`.

    Raises:
        ValueError: an unknown reference; a record shorter than forty times the longest lag.
    """
    lags, rows = _lags(record, longest, references)
    blocks = _correlations(record, lags, rows, 1)
    return _as_records(record, blocks.sum(axis=0) / record.n_samples, rows)


def identify_ambient(
    record: Record,
    *,
    n_modes: int | None = None,
    longest: float | None = None,
    references: Sequence[str] | None = None,
) -> AmbientModes:
    """The modes of a structure under unknown broadband forces, each with its standard error.

    Args:
        record: long: each twentieth of it is to be much longer than a mode takes to decay.
        n_modes: unless given, those that stay in a stabilisation diagram and whose frequency is sure to 1 %.
        longest: lag, s, as in `ambient_decays`.
        references: names of outputs, as in `ambient_decays`.

    Raises:
        ValueError: as `ambient_decays`, or no mode found.
    """
    lags, rows = _lags(record, longest, references)
    blocks = _correlations(record, lags, rows, BLOCKS)
    whole = blocks.sum(axis=0)
    decays = _as_records(record, whole / record.n_samples, rows)
    if n_modes is None:
        highest = min(HIGHEST_ORDER, lags // 8)
        start = real_modes(stabilise(decays, orders=range(2, highest + 1))).modes
    else:
        start = stacked_delays(decays, n_modes=n_modes)
    if start.n_modes == 0:
        raise ValueError(f"record {record.name!r} holds no mode that stays from order to order; measure longer")
    count = record.n_samples * (BLOCKS - 1) / BLOCKS
    without = [_as_records(record, (whole - block) / count, rows) for block in blocks]
    while True:
        refined = refine(decays, start)
        found = _over_references(refined, record)
        covariance = _jackknife(without, found)
        std = np.sqrt(np.diag(covariance)[: found.n_modes])
        unsure = (std > LEAST_SURE * found.omega) | (found.zeta <= 0) | (found.zeta > MOST_DAMPED)
        unsure |= _split(refined, found, std)
        if n_modes is not None or found.n_modes == 1 or not unsure.any():
            return AmbientModes(found, frozen(covariance), BLOCKS, decays)
        worst = int(np.argmax(np.where(unsure, std / found.omega, 0.0)))
        start = found.select([r for r in range(found.n_modes) if r != worst])


def _over_references(refined: Refined, record: Record) -> SampledModes:
    """The modes, each with the shape that all references agree on best: one of them may stand at a node."""
    both = np.stack(refined.amplitudes)  # (n_references, n_outputs, n_modes)
    shapes = np.stack([np.linalg.svd(both[:, :, r].T)[0][:, 0] for r in range(both.shape[2])], axis=1)
    derivative = time_derivatives(record.output_channels)[:, None]
    return replace(refined.modes, shapes=normalised_shapes(shapes / refined.modes.poles**derivative))


def _split(refined: Refined, found: SampledModes, std: np.ndarray) -> np.ndarray:
    """Which modes have the shape of a stronger one and its band, as far as that is known."""
    size = np.linalg.norm(np.vstack(refined.amplitudes), axis=0)
    poles = found.poles
    band = np.abs(poles.real) + 3.0 * std
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < band[:, None] + band
    alike = mac(found.shapes, found.shapes) > SAME_SHAPE
    return (near & alike & (size[:, None] < size)).any(axis=1)


def _jackknife(without: Sequence[tuple[Record, ...]], found: SampledModes) -> np.ndarray:
    """Covariance of (ω, ζ) from what is found with each block left out.

    Products y(t + τ) y(t) of neighbouring blocks still have something in common: their covariance counts where it adds.
    """
    each = [refine(decays, found).modes for decays in without]
    draws = np.array([np.r_[modes.omega, modes.zeta] for modes in each])
    apart = draws - draws.mean(axis=0)
    alone = (apart**2).sum(axis=0)
    shared = 2.0 * (apart[1:] * apart[:-1]).sum(axis=0)
    more = np.sqrt(1.0 + np.maximum(shared, 0.0) / np.maximum(alone, 1e-300))
    return (len(draws) - 1) / len(draws) * apart.T @ apart * np.outer(more, more)


def _lags(record: Record, longest: float | None, references: Sequence[str] | None) -> tuple[int, list[int]]:
    """How many lags, and the rows of the references."""
    if references is None:
        strongest = np.argsort(-record.outputs.std(axis=1))[:MOST_REFERENCES]
        rows = sorted(int(j) for j in strongest)
    else:
        rows = [record.output_names.index(name) for name in record.only(references).output_names]
    most = record.n_samples // (2 * BLOCKS)
    lags = most if longest is None else round(longest / record.sample_time)
    if not LEAST_LAGS // 4 <= lags <= most:
        raise ValueError(
            f"record {record.name!r} has {record.n_samples} samples, enough for lags up to"
            f" {most * record.sample_time:g} s; {lags * record.sample_time:g} s were asked for: measure longer"
        )
    if longest is None:
        found = _correlations(record, 4 * lags, rows, 1)[0]
        energy = (found / found.std(axis=2, keepdims=True)) ** 2
        windows = energy.sum(axis=(0, 1))[: 4 * lags // LEAST_LAGS * LEAST_LAGS].reshape(-1, LEAST_LAGS).mean(axis=1)
        errors = np.median(windows[windows.size // 2 :])
        lags = min(lags, LEAST_LAGS * max(1, int(np.argmax(np.r_[windows, 0.0] < ABOVE_ERRORS * errors))))
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
