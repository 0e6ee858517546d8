"""Modes of a structure that unknown broadband forces drive: correlation functions are free decays.

Under forces that are white over the band of the modes, the correlation of two outputs at a lag τ > 0 decays as the
structure does when let go (NExT: James, Carne & Lauffer, SAND92-1666),

    R_ij(τ) = E y_i(t + τ) y_j(t) = Re Σ_r φ_ir c_jr e^{λ_r τ},

so that every method for free decays applies. Their errors are neither white nor independent of lag, so they only give
the starting poles: the order and the estimates follow from the likelihood of the spectrum (`output_only/whittle`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi2

from workbench.identification.free_decay.ibrahim import stacked_delays
from workbench.identification.free_decay.stabilisation import stabilise, stable_modes
from workbench.identification.output_only.whittle import (
    SpectralMode,
    Spectrum,
    bands,
    fit_band,
    fit_bands,
    initial_mode,
)
from workbench.identification.signal.budget import SECONDS, Budget
from workbench.identification.signal.modal_estimates import ModalEstimates, normalised_shapes
from workbench.identification.signal.order_selection import FALSE_ALARM, MOST_DAMPED, SAME_SHAPE, Stepwise
from workbench.identification.signal.projection import project
from workbench.identification.signal.synthesis import time_derivatives
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes, frozen, mac
from workbench.threads import one_blas_thread

MOST_REFERENCES = 4
# A record is at least twice so many times as long as its longest lag.
BLOCKS = 20
# Of the stabilisation diagram.
HIGHEST_ORDER = 20
# Combinations of outputs whose spectrum is fitted.
MOST_DIRECTIONS = 4
# Steps of a search without a mode: one that ends too soon overstates the evidence of the mode.
FEW_STEPS = 15
# Lags are kept while their energy is so many times that of the errors.
ABOVE_ERRORS = 4.0
LEAST_LAGS = 64
# Relative standard error of a frequency up to which a mode counts as found.
LEAST_SURE = 0.01


@dataclass(frozen=True, eq=False, repr=False)
class AmbientModes(ModalEstimates):
    """Modes of a structure under unknown forces, with their standard errors.

    Attributes:
        modes: shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ), the Cramér-Rao bound at the estimate.
        evidence: (n_modes,) twice the log likelihood ratio of the record with and without each mode.
        limit: what a mode fitted to noise alone exceeds with the chance of a false alarm.
        decays: the correlation functions that the search started from, one record a reference.
        remarks: what was left undone, where the time was up.
    """

    modes: SampledModes
    covariance: np.ndarray
    evidence: np.ndarray
    limit: float
    decays: tuple[Record, ...]
    remarks: tuple[str, ...] = ()


def correlation_functions(
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
    seconds: float | None = SECONDS,
) -> AmbientModes:
    """The modes of a structure under unknown broadband forces, each with its standard error.

    Args:
        record: long: each twentieth of it is to be much longer than a mode takes to decay.
        n_modes: unless given, those that the likelihood misses and whose frequency is sure to 1 %.
        longest: lag, s, as in `correlation_functions`.
        references: names of outputs, as in `correlation_functions`.
        false_alarm: chance that noise alone is taken for a mode.
        seconds: of processor time, after which the best so far is returned, with a remark; None for no limit.

    Raises:
        ValueError: as `correlation_functions`, or no mode found.
    """
    budget = Budget(seconds)
    lags, rows = _lags(record, longest, references)
    most = lags if longest is not None else record.n_samples // (2 * BLOCKS)
    sums = _correlations(record, most, rows, 1)[0] / record.n_samples
    decays = _as_records(record, sums[:, :, :lags], rows)
    if n_modes is not None:
        problem = _UnknownForces(record, [stacked_delays(decays, n_modes=n_modes)], false_alarm, budget)
        return problem.report(problem.settled(problem.start), decays)
    starts = [_stable(decays)]
    if most > lags:
        longer = _stable(_as_records(record, sums, rows))
        away = np.abs(np.subtract.outer(longer.poles.imag, starts[0].poles.imag))
        new = (away > np.abs(starts[0].poles.real)).all(axis=1)
        starts.append(longer.select(list(np.flatnonzero(new))))
    problem = _UnknownForces(record, starts, false_alarm, budget)
    selection = Stepwise(problem, np.inf, np.inf, None, forgets=False, budget=budget)
    model = selection.select(_Model())
    if not model.modes:
        raise ValueError(f"record {record.name!r} holds no mode that rises above its noise; measure longer")
    return problem.report(model, decays)


def _stable(decays: Sequence[Record]) -> SampledModes:
    """Stable modes of a stabilisation diagram: long lags show weak modes, short ones damped."""
    return stable_modes(stabilise(decays, orders=range(2, min(HIGHEST_ORDER, decays[0].n_samples // 8) + 1))).modes


@dataclass(frozen=True, eq=False)
class _Model:
    """Modes so far.

    Attributes:
        modes: as the spectrum holds them.
        variance: (2, n_modes, 2, n_modes) of Re λ, then Im λ; empty until settled.
        evidence: (n_modes,) twice the log likelihood ratio with and without each; empty until settled.
        origin: the model that it has one mode more than.
        gain: twice the log likelihood ratio of the larger of the two over the smaller.
    """

    modes: tuple[SpectralMode, ...] = ()
    variance: np.ndarray = field(default_factory=lambda: np.zeros((2, 0, 2, 0)))
    evidence: np.ndarray = field(default_factory=lambda: np.zeros(0))
    origin: "_Model | None" = None
    gain: float = 0.0

    @property
    def poles(self) -> np.ndarray:
        return np.array([mode.pole for mode in self.modes])

    @property
    def covariance(self) -> np.ndarray:
        """Of (ω, ζ): with λ = x + iy, dω = (x dx + y dy)/ω, dζ = -(y² dx - x y dy)/ω³."""
        x, y, omega = self.poles.real, self.poles.imag, np.abs(self.poles)
        by_omega = np.hstack([np.diag(x / omega), np.diag(y / omega)])
        by_zeta = np.hstack([np.diag(-(y**2) / omega**3), np.diag(x * y / omega**3)])
        jacobian = np.vstack([by_omega, by_zeta])
        return np.asarray(jacobian @ self.variance.reshape(2 * omega.size, -1) @ jacobian.T)


class _UnknownForces:
    """The `order_selection.Problem` of a spectrum: modes in the bands that they are fitted in."""

    def __init__(self, record: Record, starts: Sequence[SampledModes], false_alarm: float, budget: Budget) -> None:
        self.record, self.budget, size = record, budget, record.outputs.std(axis=1)[:, None]
        spectrum = Spectrum.of(record.outputs / size, record.sample_time)
        derivative = time_derivatives(record.output_channels)[:, None]
        poles = np.concatenate([start.poles for start in starts])
        seen = np.hstack([start.shapes * start.poles**derivative / size for start in starts])
        seen = seen / np.linalg.norm(seen, axis=0)
        directions = np.linalg.svd(np.hstack([seen.real, seen.imag]))[0][:, :MOST_DIRECTIONS]
        self.spectrum = spectrum.along(directions)
        # A mode is its pole and two vectors, of which one has no scale, chosen among all lines.
        self.limit = float(chi2.isf(false_alarm / spectrum.values.shape[1], 4 * directions.shape[1]))
        tries = [initial_mode(self.spectrum, *pair) for pair in zip(poles, (directions.T @ seen).T, strict=True)]
        self.start = _Model(tuple(tries))
        self.candidates = iter(sorted(tries, key=lambda mode: -mode.height))

    def n_modes(self, model: _Model) -> int:
        return len(model.modes)

    def strongest(self, model: _Model, rejected: list[tuple[complex, float]]) -> SpectralMode | None:
        return next(self.candidates, None)

    def pole_of(self, candidate: SpectralMode) -> complex:
        return candidate.pole

    def extended(self, model: _Model, candidate: SpectralMode) -> _Model:
        modes, n = model.modes, len(model.modes)
        group = next(g for g in bands(self.spectrum, [mode.pole for mode in [*modes, candidate]]) if n in g)
        known, beside = [modes[r] for r in group if r < n], [modes[r] for r in np.setdiff1d(np.arange(n), group)]
        found = fit_band(self.spectrum, [*known, candidate], beside, budget=self.budget)
        without = fit_band(self.spectrum, known, beside, [*known, candidate], FEW_STEPS, self.budget)
        return _Model((*beside, *found.modes), origin=model, gain=2.0 * (without.cost - found.cost))

    def gain(self, smaller: _Model, larger: _Model) -> float:
        return larger.gain if larger.origin is smaller else smaller.gain

    def threshold(self, model: _Model, pole: complex) -> float:
        return self.limit

    def splits(self, model: _Model, trial: _Model) -> bool:
        return False

    def settled(self, model: _Model) -> _Model:
        """All bands fitted, and how much less likely the record is without each mode."""
        n_all, modes = len(model.modes), list(model.modes)
        fitted = fit_bands(self.spectrum, modes, self.budget) if modes else []
        variance, evidence = np.zeros((2, n_all, 2, n_all)), np.zeros(n_all)
        for group, band in fitted:
            for r, mode in zip(group, band.modes, strict=True):
                modes[r] = mode
        for group, band in fitted:
            n, others = len(group), [mode for r, mode in enumerate(modes) if r not in group]
            variance[np.ix_([0, 1], group, [0, 1], group)] = band.covariance.reshape(2, n, 2, n)
            for k, r in enumerate(group):
                rest = [mode for i, mode in enumerate(band.modes) if i != k]
                without = fit_band(self.spectrum, rest, others, band.modes, FEW_STEPS, self.budget)
                evidence[r] = 2.0 * (without.cost - band.cost)
        return _Model(tuple(modes), variance, evidence)

    def suspects(self, model: _Model) -> Iterator[tuple[complex, _Model, bool]]:
        """The least likely of those that are no modes."""
        poles, omega = model.poles, np.abs(model.poles)
        std = np.sqrt(np.diag(model.covariance)[: poles.size])
        out = (model.evidence < self.limit) | (std > LEAST_SURE * omega) | (-poles.real > MOST_DAMPED * omega)
        # One that has the shape of a more likely one and its band, as far as that is known, splits it.
        shapes, band = np.array([mode.shape for mode in model.modes]).T, np.abs(poles.real) + 3.0 * std
        near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < band[:, None] + band
        alike = mac(shapes, shapes) > SAME_SHAPE
        out |= (near & alike & (model.evidence[:, None] < model.evidence)).any(axis=1)
        if out.any():
            worst = int(np.argmin(np.where(out, model.evidence, np.inf)))
            rest = _Model(tuple(mode for r, mode in enumerate(model.modes) if r != worst))
            without = replace(self.settled(rest), gain=float(model.evidence[worst]))
            yield complex(poles[worst]), without, True

    def report(self, model: _Model, decays: tuple[Record, ...]) -> AmbientModes:
        order = np.argsort(np.abs(model.poles))
        poles, both = model.poles[order], np.r_[order, order + order.size]
        omega = np.abs(poles)
        modes = SampledModes(omega, -poles.real / omega, _shapes(decays, poles), self.record.positions)
        covariance = frozen(model.covariance[np.ix_(both, both)])
        evidence = frozen(model.evidence[order])
        return AmbientModes(modes, covariance, evidence, self.limit, decays, self.budget.remarks)


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
