"""Modes of a structure that unknown broadband forces drive: correlation functions are free decays.

Under forces that are white over the band of the modes, the correlation of two outputs at a lag τ > 0 decays as the
structure does when let go (NExT: James, Carne & Lauffer, SAND92-1666),

    R_ij(τ) = E y_i(t + τ) y_j(t) = Re Σ_r φ_ir c_jr e^{λ_r τ},

so that all that reads free decays reads them. Their errors are neither white nor independent of lag, so they only say
where to look: how many modes there are, and how large they are, the likelihood of the spectrum decides (`whittle`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri
from scipy.stats import chi2

from workbench.identification.free_decay.ibrahim import normalised_shapes, stacked_delays
from workbench.identification.free_decay.identified import FALSE_ALARM, MOST_DAMPED, SAME_SHAPE
from workbench.identification.free_decay.stabilisation import real_modes, stabilise
from workbench.identification.output_only.whittle import Spectrum, Swing, bands, fit_band, fit_bands, started
from workbench.identification.signal.projection import project
from workbench.identification.signal.standard_errors import StandardErrors
from workbench.identification.signal.synthesis import time_derivatives
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes, frozen, mac
from workbench.threads import one_blas_thread

MOST_REFERENCES = 4
# A record is so many times as long as its longest lag, twice.
BLOCKS = 20
HIGHEST_ORDER = 20
# Combinations of outputs whose spectrum is looked at.
MOST_DIRECTIONS = 4
# Of a search without a mode: one that ends too soon says that the mode is missed more than it is.
FEW_STEPS = 15
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
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ), the Cramér-Rao bound at the estimate.
        evidence: (n_modes,) twice the log likelihood ratio of the record with and without each mode.
        limit: what a mode fitted to noise alone exceeds with the chance of a false alarm.
        decays: the correlation functions where they were looked for, one record a reference.
    """

    modes: SampledModes
    covariance: np.ndarray
    evidence: np.ndarray
    limit: float
    decays: tuple[Record, ...]

    def interval(self, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Confidence intervals of ω and of ζ, (2, n_modes) each."""
        return self._within(float(ndtri(0.5 * (1.0 + level))))


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


@one_blas_thread
def identify_ambient(
    record: Record,
    *,
    n_modes: int | None = None,
    longest: float | None = None,
    references: Sequence[str] | None = None,
    false_alarm: float = FALSE_ALARM,
) -> AmbientModes:
    """The modes of a structure under unknown broadband forces, each with its standard error.

    Args:
        record: long: each twentieth of it is to be much longer than a mode takes to decay.
        n_modes: unless given, those that the likelihood misses and whose frequency is sure to 1 %.
        longest: lag, s, as in `ambient_decays`.
        references: names of outputs, as in `ambient_decays`.
        false_alarm: chance that noise alone is taken for a mode.

    Raises:
        ValueError: as `ambient_decays`, or no mode found.
    """
    lags, rows = _lags(record, longest, references)
    most = lags if longest is not None else record.n_samples // (2 * BLOCKS)
    sums = _correlations(record, most, rows, 1)[0] / record.n_samples
    decays = _as_records(record, sums[:, :, :lags], rows)
    if n_modes is None:
        starts = [_that_stay(decays)]
        if most > lags:
            longer = _that_stay(_as_records(record, sums, rows))
            away = np.abs(np.subtract.outer(longer.poles.imag, starts[0].poles.imag))
            new = (away > np.abs(starts[0].poles.real)).all(axis=1)
            starts.append(longer.select(list(np.flatnonzero(new))))
        search = _Search(record, starts, false_alarm)
        search.grow()
        while search.poles.size and search.prune():
            pass
    else:
        search = _Search(record, [stacked_delays(decays, n_modes=n_modes)], false_alarm)
        search.settle(search.tries)
    if search.poles.size == 0:
        raise ValueError(f"record {record.name!r} holds no mode that rises above its noise; measure longer")
    return search.report(decays)


def _that_stay(decays: Sequence[Record]) -> SampledModes:
    """What stays in a stabilisation diagram: of long lags, which show weak modes; of short ones, which show damped."""
    return real_modes(stabilise(decays, orders=range(2, min(HIGHEST_ORDER, decays[0].n_samples // 8) + 1))).modes


class _Search:
    """Modes so far, by the bands of the spectrum that they are fitted in."""

    def __init__(self, record: Record, starts: Sequence[SampledModes], false_alarm: float) -> None:
        self.record, size = record, record.outputs.std(axis=1)[:, None]
        spectrum = Spectrum.of(record.outputs / size, record.sample_time)
        derivative = time_derivatives(record.output_channels)[:, None]
        poles = np.concatenate([start.poles for start in starts])
        seen = np.hstack([start.shapes * start.poles**derivative / size for start in starts])
        seen = seen / np.linalg.norm(seen, axis=0)
        directions = np.linalg.svd(np.hstack([seen.real, seen.imag]))[0][:, :MOST_DIRECTIONS]
        self.spectrum = spectrum.along(directions)
        # A mode is its pole and two vectors, of which one has no scale, chosen among all lines.
        self.limit = float(chi2.isf(false_alarm / spectrum.values.shape[1], 4 * directions.shape[1]))
        self.tries = [started(self.spectrum, *pair) for pair in zip(poles, (directions.T @ seen).T, strict=True)]
        self.settle([])

    def grow(self) -> None:
        """Take in what makes the record more likely than noise would, the strongest first."""
        swings: list[Swing] = []
        for swing in sorted(self.tries, key=lambda swing: -swing.height):
            group = next(g for g in bands(self.spectrum, [s.pole for s in [*swings, swing]]) if len(swings) in g)
            known, others = [swings[r] for r in group if r < len(swings)], np.setdiff1d(np.arange(len(swings)), group)
            beside = [swings[r] for r in others]
            try:
                found = fit_band(self.spectrum, [*known, swing], beside)
                without = fit_band(self.spectrum, known, beside, [*known, swing], FEW_STEPS)
            except np.linalg.LinAlgError:
                continue
            if 2.0 * (without.cost - found.cost) > self.limit:
                swings = [*beside, *found.swings]
        self.settle(swings)

    def settle(self, swings: list[Swing]) -> None:
        """All bands fitted, and how much less likely the record is without each mode."""
        self.swings, fitted = list(swings), fit_bands(self.spectrum, swings) if swings else []
        self.variance, self.evidence = np.zeros((2, len(swings), 2, len(swings))), np.zeros(len(swings))
        for group, band in fitted:
            for r, swing in zip(group, band.swings, strict=True):
                self.swings[r] = swing
        for group, band in fitted:
            n, others = len(group), [swing for r, swing in enumerate(self.swings) if r not in group]
            self.variance[np.ix_([0, 1], group, [0, 1], group)] = band.covariance.reshape(2, n, 2, n)
            for k, r in enumerate(group):
                rest = [swing for i, swing in enumerate(band.swings) if i != k]
                without = fit_band(self.spectrum, rest, others, band.swings, FEW_STEPS)
                self.evidence[r] = 2.0 * (without.cost - band.cost)

    @property
    def poles(self) -> np.ndarray:
        return np.array([swing.pole for swing in self.swings])

    def covariance(self) -> np.ndarray:
        """Of (ω, ζ): with λ = x + iy, dω = (x dx + y dy)/ω, dζ = -(y² dx - x y dy)/ω³."""
        x, y, omega = self.poles.real, self.poles.imag, np.abs(self.poles)
        by_omega = np.hstack([np.diag(x / omega), np.diag(y / omega)])
        by_zeta = np.hstack([np.diag(-(y**2) / omega**3), np.diag(x * y / omega**3)])
        jacobian = np.vstack([by_omega, by_zeta])
        return jacobian @ self.variance.reshape(2 * omega.size, -1) @ jacobian.T

    def prune(self) -> bool:
        """Put out what is no mode, the least likely first; whether any went."""
        n, omega = self.poles.size, np.abs(self.poles)
        std = np.sqrt(np.diag(self.covariance())[:n])
        out = (self.evidence < self.limit) | (std > LEAST_SURE * omega) | (-self.poles.real > MOST_DAMPED * omega)
        out |= self._split(std)
        if not out.any():
            return False
        worst = int(np.argmin(np.where(out, self.evidence, np.inf)))
        self.settle([swing for r, swing in enumerate(self.swings) if r != worst])
        return True

    def _split(self, std: np.ndarray) -> np.ndarray:
        """Which modes have the shape of a more likely one and its band, as far as that is known."""
        shapes = np.array([swing.shape for swing in self.swings]).T
        band = np.abs(self.poles.real) + 3.0 * std
        near = np.abs(np.subtract.outer(self.poles.imag, self.poles.imag)) < band[:, None] + band
        alike = mac(shapes, shapes) > SAME_SHAPE
        return (near & alike & (self.evidence[:, None] < self.evidence)).any(axis=1)

    def report(self, decays: tuple[Record, ...]) -> AmbientModes:
        order = np.argsort(np.abs(self.poles))
        poles, both = self.poles[order], np.r_[order, order + order.size]
        omega = np.abs(poles)
        modes = SampledModes(omega, -poles.real / omega, _shapes(decays, poles), self.record.positions)
        covariance = frozen(self.covariance()[np.ix_(both, both)])
        return AmbientModes(modes, covariance, frozen(self.evidence[order]), self.limit, decays)


def _shapes(decays: Sequence[Record], poles: np.ndarray) -> np.ndarray:
    """Shapes (n_outputs, n_modes) that all references agree on best: one of them may stand at a node."""
    both = np.stack([project(decay, poles, False).complex_amplitudes for decay in decays])
    shapes = np.stack([np.linalg.svd(both[:, :, r].T)[0][:, 0] for r in range(poles.size)], axis=1)
    return normalised_shapes(shapes / poles ** time_derivatives(decays[0].output_channels)[:, None])


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
