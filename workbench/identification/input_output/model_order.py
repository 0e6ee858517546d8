"""Model order selection for a measurement with any excitation, stepwise by likelihood ratio."""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain

import numpy as np
from scipy.stats import chi2

from workbench.arrays import Floats
from workbench.identification.input_output.fit_errors import marginal_statistics_of, statistic_of, statistic_of_each
from workbench.identification.input_output.modal_fit import (
    MANY_ROWS,
    MIN_LENGTH_OF_PRODUCTS,
    Fit,
    Measurement,
    Part,
    column_norms,
    columns,
    modal_coordinate,
    normalised_basis,
    only,
    products_of,
    projected,
    row_weights,
    search,
    settled,
)
from workbench.identification.signal.searches import FALSE_ALARM, SELECTION, OrderSelection, TimeLimit, overdamped
from workbench.structure.modes import mac
from workbench.threads import at_once


@dataclass(frozen=True)
class OrderSettings:
    """Constants of the model order selection of a measurement, beside those of `searches.SELECTION`."""

    max_weak_candidates: int = 3  # consecutive candidates below the threshold, after which the search ends
    steps: int = 20  # of the fit by which a mode enters
    # of the threshold, at which a candidate is fitted: its participation factors are approximate
    entry_ratio: float = 0.5
    distinct_ratio: float = 10.0  # times the threshold: two close modes, each above it, are not tested for removal
    min_distance: float = 10.0  # decay rates: a candidate nearer to a mode is fitted with it, not alone
    noise_floor: float = 1e-5  # noise floor of each output, relative: -100 dB
    # of the energy of each column, added so that coincident poles leave no singular matrix
    regularisation: float = 1e-10
    # distorted_rates, distorted_share: decay rates, and share of the frequency, to either side of a nonlinear mode,
    # within which no further mode is searched: the distortion of a spring that hardens by 3 % fills five bandwidths
    distorted_rates: float = 10.0
    distorted_share: float = 0.03


ORDER = OrderSettings()


@dataclass(frozen=True)
class SelectionOptions:
    """Options of a selection of modes: the largest number, and the probability that noise alone is taken for one."""

    max_modes: int
    false_alarm: float = FALSE_ALARM
    time_limit: TimeLimit = field(default_factory=TimeLimit)


Scored = tuple[float, np.ndarray, complex]  # gain, participation factors and pole of a candidate


@dataclass(frozen=True, eq=False)
class SelectedModes:
    """The selected modes."""

    fit: Fit
    statistic: np.ndarray  # (n_modes,) χ² of each mode
    limit: float  # threshold of this χ², exceeded by noise alone with the chance of a false alarm
    full: bool  # whether the selection stopped at the maximum number of modes
    distorted: tuple[complex, ...] = ()  # poles near which modes that do not predict held-out data were removed

    def refitted(self, fit: Fit) -> "SelectedModes":
        """The same selection with another fit, and the statistic of each mode in that fit."""
        return self if fit is self.fit else replace(self, fit=fit, statistic=statistic_of_each(fit))


def select_modes(
    data: Measurement, options: SelectionOptions, start: Fit | None = None, *, is_tested: bool = False
) -> SelectedModes:
    """The modes whose likelihood ratio exceeds the threshold for noise, by forward and backward stepwise selection.

    It may start from modes; `is_tested` where each of these was tested in a selection from the same measurement.
    """
    problem = _Modes(data, options)
    selection = OrderSelection(
        problem, options.max_modes, ORDER.max_weak_candidates, None, forgets=True, time_limit=options.time_limit
    )
    fit = projected(data, np.zeros(0, complex), np.zeros((0, problem.excitations), complex))
    if start is not None and is_tested:
        fit = start
    elif start is not None and start.poles.size:
        try:
            fit = selection.backward(problem.started(projected(data, start.poles, start.participation)))
        except np.linalg.LinAlgError:
            pass  # modes that cannot be distinguished: search without a start
    fit = selection.select(fit)
    order = np.argsort(np.abs(fit.poles))
    is_sorted = (np.diff(order) == 1).all()
    ordered = fit if is_sorted else replace(only(data, fit, order), converged=fit.converged, steps=fit.steps)
    return SelectedModes(ordered, statistic_of_each(fit)[order], problem.limit, selection.full)


def fit_of_poles(data: Measurement, poles: np.ndarray, false_alarm: float) -> Fit:
    """The significant ones of given poles, unchanged, with their best participation factors.

    Backward elimination: the residues of all poles are fitted at once, of any rank, and the pole of the smallest χ² is
    removed until every χ² exceeds the threshold for noise.
    """
    poles = poles[_may_be_mode(data, poles) & (poles.real < data.resolution / (2.0 * np.pi))]
    size = 2 * data.responses((-0.1 + 0.5j) * data.highest)[0].shape[1]
    columns = _responses(data, poles, size, data.fixed)
    scale = np.maximum(column_norms(columns), 1e-300)
    together = [data.values] if data.weights is None else np.hsplit(data.values, data.values.shape[1])
    spreads: list[np.ndarray] = []
    coefficients: list[np.ndarray] = []
    variances: list[np.ndarray] = []
    for weights, y in zip(weights_of(data), together, strict=True):
        gram, moments = products_of(columns, weights, y)
        gram /= np.outer(scale, scale)
        gram[np.diag_indices_from(gram)] *= 1.0 + ORDER.regularisation
        spreads.append(np.linalg.inv(gram))
        coefficients.append(spreads[-1] @ (moments / scale[:, None]))
        rss = ((y - weights * (columns @ (coefficients[-1] / scale[:, None]))) ** 2).sum(axis=0)
        variance = rss / max(len(columns) - columns.shape[1], 1)
        variances.append(np.maximum(variance, ORDER.noise_floor**2 * (y**2).mean(axis=0)))
    limit = chi2.isf(false_alarm / data.cells, size * data.values.shape[1])
    while poles.size:
        blocks = np.arange(poles.size * size).reshape(poles.size, size)
        statistic = np.zeros(poles.size)
        for spread, c, variance in zip(spreads, coefficients, variances, strict=True):
            residue = c[blocks]
            inner = spread[blocks[:, :, None], blocks[:, None, :]]
            statistic += (residue * np.linalg.solve(inner, residue) / variance).sum(axis=(1, 2))
        weakest = int(np.argmin(statistic))
        if statistic[weakest] >= limit:
            break
        out, rest = blocks[weakest], np.delete(np.arange(len(scale)), blocks[weakest])
        for k, spread in enumerate(spreads):
            update = np.linalg.solve(spread[np.ix_(out, out)], np.column_stack([spread[out], coefficients[k][out]]))
            spreads[k] = (spread - spread[:, out] @ update[:, : len(scale)])[np.ix_(rest, rest)]
            coefficients[k] = (coefficients[k] - spread[:, out] @ update[:, len(scale) :])[rest]
        poles, scale = np.delete(poles, weakest), scale[rest]
    of_poles = slice(poles.size * size)
    residues = (np.hstack(coefficients) / scale[:, None])[of_poles].reshape(poles.size, size, data.values.shape[1])
    norms = scale[of_poles].reshape(poles.size, size)
    participation = [_rank_one_participation(each, norm) for each, norm in zip(residues, norms, strict=True)]
    return projected(data, poles, np.array(participation, complex).reshape(poles.size, size // 2))


def sure_modes(data: Measurement, start: Fit, options: SelectionOptions, times: float = SELECTION.weak_ratio) -> Fit:
    """The fitted modes of a start that exceed the threshold several times, `SELECTION.weak_ratio` as coloured noise
    hardly does."""
    return _Modes(data, options).started(start, times)


def _responses(data: Measurement, poles: np.ndarray, size: int, further: np.ndarray) -> np.ndarray:
    """Columns of `Measurement.responses` of some poles, `size` of each, real parts first, then further columns."""
    columns = np.empty((len(further), poles.size * size + further.shape[1]), order="F")

    def write(r: int) -> None:
        first, middle, end = size * r, size * r + size // 2, size * (r + 1)
        columns[:, first:middle], columns[:, middle:end] = data.responses(poles[r])

    at_once(write, range(poles.size), long=len(columns) >= MANY_ROWS)
    columns[:, poles.size * size :] = further
    return columns


def _rank_one_participation(residues: np.ndarray, norm: np.ndarray) -> np.ndarray:
    """Participation factors (n_excitations,) of the rank-one approximation of residues (2 n_excitations, n_outputs).

    Of real parts, then negated imaginary parts, and the norms of the columns they belong to. That of the strongest
    response is 1, as `modal_fit` holds it.
    """
    half = len(residues) // 2
    size = np.maximum(np.hypot(norm[:half], norm[half:]), 1e-300)
    direction = np.linalg.svd((residues[:half] - 1j * residues[half:]) * size[:, None])[0][:, 0]
    participation, held = direction / size, int(np.argmax(np.abs(direction)))
    participation = participation / participation[held]
    participation[held] = 1.0
    return np.asarray(participation)


class _Modes:
    """The `searches.Selection` of a measurement; a candidate is a pole and its participation factors."""

    def __init__(self, data: Measurement, options: SelectionOptions) -> None:
        self.data, self.time_limit = data, options.time_limit
        self.excitations = data.responses((-0.1 + 0.5j) * data.highest)[0].shape[1]
        self._scored: tuple[Fit, list[Scored]] | None = None
        self.limit = float(chi2.isf(options.false_alarm / data.cells, 2 * (data.values.shape[1] + self.excitations)))

    def n_modes(self, model: Fit) -> int:
        return model.poles.size

    def pole_of(self, candidate: tuple[complex, np.ndarray]) -> complex:
        return candidate[0]

    def strongest(self, model: Fit, rejected: list[tuple[complex, float]]) -> tuple[complex, np.ndarray] | None:
        if self._scored is None or self._scored[0] is not model:
            clear = None if rejected else self._still_clear(model)
            if clear is not None:
                return clear[2], clear[1]
            poles = _candidates(self.data, model)
            self._scored = model, [(*gain, pole) for gain, pole in zip(self._gains(model, poles), poles, strict=True)]
        candidates = [item for item in self._scored[1] if not self._is_near(item[2], rejected)]
        if not candidates:
            return None
        strength, participation, pole = max(candidates, key=lambda item: item[0])
        return None if strength < ORDER.entry_ratio * self.threshold(model, pole) else (pole, participation)

    def _gains(self, model: Fit, poles: np.ndarray, together: int = 16) -> Iterator[tuple[float, np.ndarray]]:
        """`_candidate_gains`, two times so many poles at a time: a basis is read from memory once for many."""
        bases, scaled = bases_of(self.data, model), model.residual / model.noise
        groups = [poles[first : first + together] for first in range(0, len(poles), together)]
        gains_of = partial(_candidate_gains, self.data, bases, scaled)
        for first in range(0, len(groups), 2):
            yield from chain(*at_once(gains_of, groups[first : first + 2], long=len(scaled) >= MANY_ROWS))

    def _still_clear(self, model: Fit) -> Scored | None:
        """The strongest candidate of a smaller model, where its gain in this one is clear; for long records.

        A further mode lowers the gains of candidates, mostly of those near to it. So these are tried in the order of
        their gains in the smaller model, until the next can no longer exceed the best.
        """
        if self._scored is None or len(self.data.values) < MANY_ROWS:
            return None
        queue, best = sorted(self._scored[1], key=lambda item: -item[0]), (-np.inf, np.zeros(0), 0j)
        self._scored = self._scored[0], queue
        for k, gain in enumerate(self._gains(model, np.array([pole for _, _, pole in queue]), 2)):
            queue[k] = (*gain, queue[k][2])
            best = max(best, queue[k], key=lambda item: item[0])
            if k + 1 < len(queue) and best[0] >= queue[k + 1][0]:
                break
        return best if best[0] > SELECTION.weak_ratio * self.threshold(model, best[2]) else None

    def extended(self, model: Fit, candidate: tuple[complex, np.ndarray]) -> Fit:
        start = self._among_near(model, *candidate)
        enough = SELECTION.trial_tolerance
        return search(self.data, start, model.noise, ORDER.steps, self.time_limit, enough, _is_overdamped)

    def _among_near(self, model: Fit, pole: complex, participation: np.ndarray) -> Fit:
        """A model and a candidate, which in a long record is first fitted to what the modes far from it leave.

        With the modes near it alone: the steps that a coarse candidate takes to its place cost a fraction of those of
        all modes together.
        """
        data, n = self.data, model.poles.size
        poles, factors = np.append(model.poles, pole), np.vstack([model.participation, participation])

        def are_near(pole: complex) -> np.ndarray:
            rates = np.maximum(np.abs(model.poles.real), abs(pole.real))
            return np.asarray(np.abs(model.poles - pole) < ORDER.min_distance * np.maximum(rates, data.resolution))

        near = np.append(np.flatnonzero(are_near(pole)), n)
        if len(data.values) >= MANY_ROWS and near.size <= n:
            left = copy(data)
            phi = columns(data, poles[near[:-1]], factors[near[:-1]])[0][:, : 2 * near.size - 2]
            at_near = np.concatenate([near[:-1], n + near[:-1]])
            left.values = model.residual + (phi @ model.coefficients[at_near]) * row_weights(data)
            start = projected(left, poles[near], factors[near])
            enough = SELECTION.trial_tolerance
            fit = search(left, start, model.noise, ORDER.steps, self.time_limit, enough, _is_overdamped)
            if not _is_overdamped(fit) and not np.delete(are_near(fit.poles[-1]), near[:-1]).any():
                poles[near], factors[near] = fit.poles, fit.participation
        return projected(data, poles, factors)

    def gain(self, smaller: Fit, larger: Fit) -> float:
        """Log-likelihood ratio statistic of two fits, the noise of each output a nuisance parameter."""
        n = self.data.values.shape[0]
        first, second = ((fit.residual**2).sum(axis=0) for fit in (smaller, larger))
        floor = 1e-24 * (self.data.values**2).sum(axis=0) + 1e-300
        return float(n * np.log((first + floor) / (second + floor)).sum())

    def threshold(self, model: Fit, pole: complex) -> float:
        return self.limit * self.data.noise_ratio(model.residual / model.noise, pole)

    def splits(self, model: Fit, trial: Fit) -> bool:
        return bool(_spurious(self.data, trial).any() or is_about_distorted(self.data, trial.poles[-1:]).any())

    def settled(self, model: Fit) -> Fit:
        return settled(self.data, model, time_limit=self.time_limit)

    def started(self, start: Fit, times: float = 1.0) -> Fit:
        """The start fitted, without modes that are spurious or whose χ² is below so many times the threshold.

        Each pass removes the weaker half of these; a mode removed in error is found again by the selection.
        """
        model = settled(self.data, start, SELECTION.trial_steps, self.time_limit, SELECTION.trial_tolerance)
        while model.poles.size and not self.time_limit.spent("check of each mode"):
            statistic = np.where(_spurious(self.data, model), 0.0, marginal_statistics_of(model))
            is_weak = statistic < [times * self.threshold(model, pole) for pole in model.poles]
            removable = np.flatnonzero(is_weak & ~_is_nonlinear(self.data, model.poles))
            if not removable.size:
                break
            removed = removable[np.argsort(statistic[removable])[: (removable.size + 1) // 2]]
            model = self._without(model, removed)
        return self.settled(model)

    def _without(self, model: Fit, modes: int | np.ndarray) -> Fit:
        """The model without some modes, fitted just precisely enough for decisions."""
        rest = only(self.data, model, np.delete(np.arange(model.poles.size), modes))
        return settled(self.data, rest, SELECTION.trial_steps, self.time_limit, SELECTION.trial_tolerance)

    def suspects(self, model: Fit) -> Iterator[tuple[complex, Fit, bool]]:
        """The modes that are spurious, weak or close to another, each with the fit without it."""
        spurious, statistic = _spurious(self.data, model), marginal_statistics_of(model)
        changes = _is_nonlinear(self.data, model.poles)
        for r, pole in enumerate(model.poles):
            if changes[r]:
                continue
            distance = np.abs(np.delete(model.poles, r) - pole).min(initial=np.inf)
            is_close = distance < SELECTION.close_bandwidths * abs(pole.real)
            threshold = self.threshold(model, pole)
            doubtful = is_close and statistic[r] < ORDER.distinct_ratio * threshold
            if spurious[r] or doubtful or statistic_of(model, r) < SELECTION.weak_ratio * threshold:
                yield complex(pole), self._without(model, r), bool(spurious[r])

    def _is_near(self, pole: complex, rejected: list[tuple[complex, float]]) -> bool:
        return any(abs(pole.imag - o.imag) < max(self.data.resolution, 0.5 * abs(o.real)) for o, _ in rejected)


def _is_overdamped(fit: Fit) -> bool:
    """Whether the last mode of a fit, a candidate, is damped too much to oscillate: it seldom returns from there."""
    return bool(overdamped(fit.poles[-1]))


def _candidates(data: Measurement, fit: Fit) -> np.ndarray:
    """Candidate poles: peaks of the residual, and poles close to the modes of the fit, which mask others."""
    width = np.maximum(np.abs(fit.poles.real), 0.5 * data.resolution)
    beside = [fit.poles + 1j * k * width for k in (-4.0, -2.0, -1.0, 1.0, 2.0, 4.0)]
    tries = np.concatenate([data.candidates(fit.residual / fit.noise), *beside])
    return np.asarray(tries[_may_be_mode(data, tries) & ~is_about_distorted(data, tries)])


def is_about_distorted(data: Measurement, poles: np.ndarray) -> np.ndarray:
    """Whether each pole lies near a nonlinear mode, or is an undamped line beside any such mode.

    The distortion of a nonlinear structure appears as isolated lines far above the noise floor. An undamped pole near
    one identified from the free decay is no such line.
    """
    near = (-poles.real < 0.5 * data.resolution) & bool(data.distorted)
    for pole in data.free:
        near &= np.abs(poles.imag - pole.imag) > ORDER.distorted_share * pole.imag
    for pole in data.distorted:
        about = max(ORDER.distorted_rates * abs(pole.real), ORDER.distorted_share * pole.imag)
        near |= np.abs(poles.imag - pole.imag) < about
    return np.asarray(near)


def _is_nonlinear(data: Measurement, poles: np.ndarray) -> np.ndarray:
    """Whether each pole is that of a nonlinear mode: its residual is distortion, so it is not tested for removal."""
    nonlinear = np.zeros(poles.size, bool)
    for pole in data.distorted:
        nonlinear[np.argmin(np.abs(poles - pole))] = True
    return nonlinear


def _may_be_mode(data: Measurement, poles: np.ndarray) -> np.ndarray:
    """Whether each pole lies within the frequency range of the measurement and is not damped too much to oscillate."""
    within = (poles.imag > 0) & (poles.imag < data.highest)
    return np.asarray(within & ~overdamped(poles) & ~_reaches_nyquist(data, poles))


def _reaches_nyquist(data: Measurement, poles: np.ndarray) -> np.ndarray:
    """Whether the band of each pole reaches Nyquist: it models the course of the inputs between samples, not a mode."""
    return np.asarray(poles.imag > data.nyquist - np.maximum(np.abs(poles.real), data.resolution))


def _candidate_gains(
    data: Measurement, bases: list[np.ndarray], residual: np.ndarray, poles: np.ndarray
) -> list[tuple[float, np.ndarray]]:
    """Decrease of χ² by each of some further poles with unconstrained residues, and its best participation factors.

    The factors are those of rank one. Only the part of its response orthogonal to the columns of the fit counts; for
    `bases` see `bases_of`. The residual (n_rows, n_outputs) is in units of the noise.
    """
    size = 2 * data.responses(poles[0])[0].shape[1]
    columns = _responses(data, poles, size, data.fixed[:, :0])
    scale = np.maximum(column_norms(columns), 1e-300)
    each = np.arange(scale.size).reshape(len(poles), -1)
    strengths, blocks = np.zeros(len(poles)), [list[np.ndarray]() for _ in poles]
    together = [residual] if data.weights is None else np.hsplit(residual, residual.shape[1])
    for weights, basis, output in zip(weights_of(data), bases, together, strict=True):
        weighted = columns if len(weights) == 1 else weights * columns
        in_basis = basis.T @ weighted / scale
        moments = weighted.T @ output / scale[:, None]  # the residual is orthogonal to the basis
        for k, at in enumerate(each):
            own = weighted[:, at[0] : at[-1] + 1]
            gram = own.T @ own / np.outer(scale[at], scale[at])
            eigenvalues, directions = np.linalg.eigh(gram - in_basis[:, at].T @ in_basis[:, at])
            singular_values = np.sqrt(np.maximum(eigenvalues, 0.0))
            kept = singular_values > 1e-4 * max(singular_values[-1], 1e-3)
            whitening = directions[:, kept] / singular_values[kept]
            amplitudes = whitening.T @ moments[at]
            blocks[k].append(whitening @ amplitudes / scale[at, None])
            strengths[k] += float((amplitudes**2).sum())
    return [
        (float(strength), _rank_one_participation(np.hstack(block), scale[at]))
        for strength, block, at in zip(strengths, blocks, each, strict=True)
    ]


def bases_of(data: Measurement, fit: Fit) -> list[Floats]:
    """`basis_of` for each output, or one for all outputs of equal weights."""
    phi = _modal_columns(data, fit)
    if data.weights is None:
        return [basis_of(phi, fit.parts[0])]
    return [basis_of(weights[:, None] * phi, part) for weights, part in zip(data.weights.T, fit.parts, strict=True)]


def weights_of(data: Measurement) -> list[np.ndarray]:
    """Weights of each output (n_rows, 1) over their rms; one for all outputs where they are the same in all rows."""
    if data.weights is None:
        return [np.ones((1, 1))]
    return list((data.weights / np.sqrt((data.weights**2).mean(axis=0))).T[:, :, None])


def _modal_columns(data: Measurement, fit: Fit) -> Floats:
    """Modal coordinates and fixed columns Φ (n_rows, n_columns), as `modal_fit.columns`, without their tangents."""
    n = fit.poles.size
    phi = np.empty((len(data.values), 2 * n + data.fixed.shape[1]), order="F")

    def write(r: int) -> None:
        phi[:, r], phi[:, n + r] = modal_coordinate(data.responses(fit.poles[r]), fit.participation[r])

    at_once(write, range(n), long=len(phi) >= MANY_ROWS)
    phi[:, 2 * n :] = data.fixed
    return phi


def basis_of(phi: Floats, part: Part) -> Floats:
    """Orthonormal basis (n_rows, n_columns) of the weighted columns of a fit to outputs of these weights.

    Of many rows by the inverse of their products, which the fit holds, where these are independent enough.
    """
    size = np.sqrt(np.diag(part.spread))
    if len(phi) >= MANY_ROWS:
        try:
            factor = np.linalg.cholesky(part.spread / np.outer(size, size))
            if np.diag(factor).min(initial=1.0) > MIN_LENGTH_OF_PRODUCTS:
                return np.asarray(phi @ (size[:, None] * factor))
        except np.linalg.LinAlgError:
            pass
    return normalised_basis(phi)


def _spurious(data: Measurement, fit: Fit) -> np.ndarray:
    """Whether each mode is damped too much, reaches Nyquist, or splits a stronger mode.

    A split mode overlaps the stronger one and has its shape and participation factors.
    """
    poles = fit.poles
    shapes = fit.amplitudes / fit.noise[:, None]
    strength = statistic_of_each(fit)
    band = np.abs(poles.real)[:, None] + np.abs(poles.real) + data.resolution
    overlapping = np.abs(np.subtract.outer(poles.imag, poles.imag)) < band
    alike = mac(shapes, shapes) * mac(fit.participation.T, fit.participation.T)
    # one output and one input leave no shapes to compare; initial states do not count
    single_channel = shapes.shape[0] * data.n_inputs == 1
    splits = overlapping & (alike > SELECTION.min_split_mac) & (strength[:, None] < strength) & (not single_channel)
    return np.asarray(splits.any(axis=1) | overdamped(poles) | _reaches_nyquist(data, poles))
