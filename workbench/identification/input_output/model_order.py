"""Which modes a measurement holds, whatever excites them, by stepwise selection."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from workbench.arrays import scaled_inverse
from workbench.identification.input_output.fit_errors import covariance
from workbench.identification.input_output.modal_fit import (
    Fit,
    Measurement,
    free_parameters,
    modal_coordinate,
    moves,
    only,
    projected,
    search,
    settled,
)
from workbench.identification.signal.searches import FALSE_ALARM, SELECTION, Budget, Stepwise, overdamped
from workbench.structure.modes import mac


@dataclass(frozen=True)
class OrderSettings:
    """Constants of the selection of modes of a measurement, beside those of every selection (`searches.SELECTION`)."""

    most_weak: int = 3  # candidates below the threshold, one after the other, after which only noise is left
    steps: int = 20  # of the fit by which a mode enters
    decided: float = 0.1  # χ² that a step promises, each output, below which such a fit has decided
    enter: float = 0.5  # of the threshold, by which a candidate, its participation not yet fitted, is tried
    distinct: float = 10.0  # times the threshold, from which on two modes close to one another are two
    floor: float = 1e-5  # of each output, taken for noise in any case: -100 dB
    collinear: float = 1e-10  # of the energy of each column, lest poles that are one be singular
    # distorted_rates, distorted_share: decay rates, and share of the frequency, to either side of a mode that is more
    # than a linear one, within which no further mode is looked for: a spring that hardens by 3 % fills five bandwidths
    distorted_rates: float = 10.0
    distorted_share: float = 0.03


ORDER = OrderSettings()


@dataclass(frozen=True, eq=False)
class Selected:
    """Modes selected.

    Attributes:
        fit: of them all.
        statistic: (n_modes,) χ² of each.
        limit: what noise alone exceeds by false alarm.
        full: whether more might be there, the most modes being taken.
        distorted: poles about which further modes were left out, as they predict nothing.
    """

    fit: Fit
    statistic: np.ndarray
    limit: float
    full: bool
    distorted: tuple[complex, ...] = ()

    def refitted(self, fit: Fit) -> "Selected":
        """The modes of another fit, with their statistic in it."""
        return replace(self, fit=fit, statistic=statistic_of_each(fit))


def select_modes(
    data: Measurement,
    *,
    max_modes: int,
    false_alarm: float = FALSE_ALARM,
    budget: Budget | None = None,
    start: Fit | None = None,
) -> Selected:
    """The modes whose likelihood ratio is more than noise would give, taken in one by one and each tried again.

    Args:
        data: the measurement.
        max_modes: where to stop at the latest.
        false_alarm: chance that noise alone is taken for a mode.
        budget: of time; none unless given.
        start: modes to start from, of whatever fit; none unless given.
    """
    budget = Budget() if budget is None else budget
    problem = _Modes(data, false_alarm, budget)
    selection = Stepwise(problem, max_modes, ORDER.most_weak, None, forgets=True, budget=budget)
    fit = projected(data, np.zeros(0, complex), np.zeros((0, problem.excitations), complex))
    if start is not None and start.poles.size:
        try:
            fit = selection.backward(problem.started(projected(data, start.poles, start.participation)))
        except np.linalg.LinAlgError:
            pass  # modes that cannot be distinguished: without a start
    fit = selection.select(fit)
    order = np.argsort(np.abs(fit.poles))
    ordered = replace(only(data, fit, order), converged=fit.converged, steps=fit.steps)
    return Selected(ordered, statistic_of_each(fit)[order], problem.limit, selection.full)


def fit_of_poles(data: Measurement, poles: np.ndarray, false_alarm: float = FALSE_ALARM) -> Fit:
    """Those of given poles that the measurement holds, with the participation that suits each best; none is moved.

    All residues are fitted at once, of any rank, and the pole that explains least is left out until none explains as
    little as noise would.
    """
    poles = poles[_can_ring(data, poles) & (poles.real < data.resolution / (2.0 * np.pi))]
    size = 2 * data.responses((-0.1 + 0.5j) * data.highest)[0].shape[1]
    x = np.hstack([*(np.hstack(data.responses(pole)) for pole in poles), data.fixed])
    scale = np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    together = [data.values] if data.weights is None else np.hsplit(data.values, data.values.shape[1])
    spreads: list[np.ndarray] = []
    coefficients: list[np.ndarray] = []
    variances: list[np.ndarray] = []
    for weights, y in zip(weights_of(data), together, strict=True):
        weighted = weights * x / scale
        gram = weighted.T @ weighted
        gram[np.diag_indices_from(gram)] *= 1.0 + ORDER.collinear
        spreads.append(np.linalg.inv(gram))
        coefficients.append(spreads[-1] @ (weighted.T @ y))
        left = ((y - weighted @ coefficients[-1]) ** 2).sum(axis=0)
        variances.append(np.maximum(left / max(len(x) - x.shape[1], 1), ORDER.floor**2 * (y**2).mean(axis=0)))
    limit = chi2.isf(false_alarm / data.cells, size * data.values.shape[1])
    while poles.size:
        blocks = np.arange(poles.size * size).reshape(poles.size, size)
        statistic = np.zeros(poles.size)
        for spread, c, variance in zip(spreads, coefficients, variances, strict=True):
            own = c[blocks]
            inner = spread[blocks[:, :, None], blocks[:, None, :]]
            statistic += (own * np.linalg.solve(inner, own) / variance).sum(axis=(1, 2))
        weakest = int(np.argmin(statistic))
        if statistic[weakest] >= limit:
            break
        out, rest = blocks[weakest], np.delete(np.arange(len(scale)), blocks[weakest])
        for k, spread in enumerate(spreads):
            taken = np.linalg.solve(spread[np.ix_(out, out)], np.column_stack([spread[out], coefficients[k][out]]))
            spreads[k] = (spread - spread[:, out] @ taken[:, : len(scale)])[np.ix_(rest, rest)]
            coefficients[k] = (coefficients[k] - spread[:, out] @ taken[:, len(scale) :])[rest]
        poles, scale = np.delete(poles, weakest), scale[rest]
    of_poles = slice(poles.size * size)
    residues = (np.hstack(coefficients) / scale[:, None])[of_poles].reshape(poles.size, size, data.values.shape[1])
    norms = scale[of_poles].reshape(poles.size, size)
    participation = [_of_rank_one(each, norm) for each, norm in zip(residues, norms, strict=True)]
    return projected(data, poles, np.array(participation, complex).reshape(poles.size, size // 2))


def sure_modes(data: Measurement, start: Fit, false_alarm: float, budget: Budget) -> Fit:
    """The modes of a start that noise of any smooth spectrum hardly makes, fitted."""
    return _Modes(data, false_alarm, budget).started(start, SELECTION.weak)


def _of_rank_one(residues: np.ndarray, norm: np.ndarray) -> np.ndarray:
    """Participation (n_excitations,) of the outer product nearest to residues (2 n_excitations, n_outputs).

    Args:
        residues: real parts, then imaginary parts with their sign turned.
        norm: (2 n_excitations,) of the columns they belong to.
    """
    half = len(residues) // 2
    size = np.maximum(np.hypot(norm[:half], norm[half:]), 1e-300)
    return np.asarray(np.linalg.svd((residues[:half] - 1j * residues[half:]) * size[:, None])[0][:, 0] / size)


class _Modes:
    """The `searches.Selection` of a measurement; a candidate is a pole and its participation."""

    def __init__(self, data: Measurement, false_alarm: float, budget: Budget) -> None:
        self.data, self.budget = data, budget
        self.excitations = data.responses((-0.1 + 0.5j) * data.highest)[0].shape[1]
        self._scored: tuple[Fit, list[tuple[float, np.ndarray, complex]]] | None = None
        self.limit = float(chi2.isf(false_alarm / data.cells, 2 * (data.values.shape[1] + self.excitations)))

    def n_modes(self, model: Fit) -> int:
        return model.poles.size

    def pole_of(self, candidate: tuple[complex, np.ndarray]) -> complex:
        return candidate[0]

    def strongest(self, model: Fit, rejected: list[tuple[complex, float]]) -> tuple[complex, np.ndarray] | None:
        if self._scored is None or self._scored[0] is not model:
            bases, left = bases_of(self.data, model), model.residual / model.noise
            self._scored = model, [(*_added(self.data, bases, left, p), p) for p in _to_try(self.data, model)]
        left_over = [item for item in self._scored[1] if not self._near(item[2], rejected)]
        if not left_over:
            return None
        strength, participation, pole = max(left_over, key=lambda item: item[0])
        return None if strength < ORDER.enter * self.threshold(model, pole) else (pole, participation)

    def extended(self, model: Fit, candidate: tuple[complex, np.ndarray]) -> Fit:
        poles = np.append(model.poles, candidate[0])
        participation = np.vstack([model.participation, candidate[1]])
        return search(self.data, poles, participation, model.noise, ORDER.steps, self.budget, ORDER.decided)

    def gain(self, smaller: Fit, larger: Fit) -> float:
        """The noise of each output unknown."""
        n = self.data.values.shape[0]
        first, second = ((fit.residual**2).sum(axis=0) for fit in (smaller, larger))
        floor = 1e-24 * (self.data.values**2).sum(axis=0) + 1e-300
        return float(n * np.log((first + floor) / (second + floor)).sum())

    def threshold(self, model: Fit, pole: complex) -> float:
        return self.limit * self.data.noise_ratio(model.residual / model.noise, pole)

    def splits(self, model: Fit, trial: Fit) -> bool:
        return bool(_spurious(self.data, trial).any() or is_about_distorted(self.data, trial.poles[-1:]).any())

    def settled(self, model: Fit) -> Fit:
        return settled(self.data, model, budget=self.budget)

    def started(self, start: Fit, times: float = 1.0) -> Fit:
        """A start fitted, without the modes that are spurious or that the others may take over.

        The weaker half of them goes, then half of those that are left; one that goes in error is found again.

        Args:
            times: the threshold, which a mode must exceed.
        """
        model = settled(self.data, start, SELECTION.few_steps, self.budget, ORDER.decided)
        while model.poles.size and not self.budget.spent("check of each mode"):
            statistic = np.where(_spurious(self.data, model), 0.0, whole_statistic_of(model))
            is_weak = statistic < [times * self.threshold(model, pole) for pole in model.poles]
            weak = np.flatnonzero(is_weak & ~_changes(self.data, model.poles))
            if not weak.size:
                break
            out = weak[np.argsort(statistic[weak])[: (weak.size + 1) // 2]]
            rest = np.delete(np.arange(model.poles.size), out)
            model = settled(self.data, only(self.data, model, rest), SELECTION.few_steps, self.budget, ORDER.decided)
        return self.settled(model)

    def suspects(self, model: Fit) -> Iterator[tuple[complex, Fit, bool]]:
        """Those that are spurious, weak, or close to another."""
        spurious, whole_statistic = _spurious(self.data, model), whole_statistic_of(model)
        changes = _changes(self.data, model.poles)
        for r, pole in enumerate(model.poles):
            if changes[r]:
                continue
            near = np.abs(np.delete(model.poles, r) - pole).min(initial=np.inf) < SELECTION.close * abs(pole.real)
            threshold = self.threshold(model, pole)
            doubtful = near and whole_statistic[r] < ORDER.distinct * threshold
            if spurious[r] or doubtful or statistic_of(model, r) < SELECTION.weak * threshold:
                without = only(self.data, model, np.delete(np.arange(model.poles.size), r))
                without = settled(self.data, without, SELECTION.few_steps, self.budget, ORDER.decided)
                yield complex(pole), without, bool(spurious[r])

    def _near(self, pole: complex, rejected: list[tuple[complex, float]]) -> bool:
        return any(abs(pole.imag - o.imag) < max(self.data.resolution, 0.5 * abs(o.real)) for o, _ in rejected)


def _to_try(data: Measurement, fit: Fit) -> np.ndarray:
    """Peaks of the residual, and poles beside the modes so far, which may mask others."""
    width = np.maximum(np.abs(fit.poles.real), 0.5 * data.resolution)
    beside = [fit.poles + 1j * k * width for k in (-4.0, -2.0, -1.0, 1.0, 2.0, 4.0)]
    tries = np.concatenate([data.candidates(fit.residual / fit.noise), *beside])
    return np.asarray(tries[_can_ring(data, tries) & ~is_about_distorted(data, tries)])


def is_about_distorted(data: Measurement, poles: np.ndarray) -> np.ndarray:
    """Which poles stand about modes that are more than linear, or beside such ring on through the record.

    What else a nonlinear structure does is seen as lines here and there, which rise far above noise of the sensors;
    what a free decay holds is none of it.
    """
    out = (-poles.real < 0.5 * data.resolution) & bool(data.distorted)
    for pole in data.free:
        out &= np.abs(poles.imag - pole.imag) > ORDER.distorted_share * pole.imag
    for pole in data.distorted:
        about = max(ORDER.distorted_rates * abs(pole.real), ORDER.distorted_share * pole.imag)
        out |= np.abs(poles.imag - pole.imag) < about
    return np.asarray(out)


def _changes(data: Measurement, poles: np.ndarray) -> np.ndarray:
    """Which poles are those of modes that are more than linear: in what else these do, nothing is left of them."""
    out = np.zeros(poles.size, bool)
    for pole in data.distorted:
        out[np.argmin(np.abs(poles - pole))] = True
    return out


def _can_ring(data: Measurement, poles: np.ndarray) -> np.ndarray:
    """Which poles are of a frequency that the measurement holds, and not damped too much to ring."""
    held = (poles.imag > 0) & (poles.imag < data.highest)
    return np.asarray(held & ~overdamped(poles) & ~_reaches_nyquist(data, poles))


def _reaches_nyquist(data: Measurement, poles: np.ndarray) -> np.ndarray:
    """Whose band reaches half of the sample rate: no oscillation, but how inputs run between samples."""
    return np.asarray(poles.imag > data.nyquist - np.maximum(np.abs(poles.real), data.resolution))


def _added(data: Measurement, bases: list[np.ndarray], left: np.ndarray, pole: complex) -> tuple[float, np.ndarray]:
    """χ² by which one more pole lowers the misfit, residues unconstrained, and the best participation of rank one.

    Only the part of its response outside the basis of the columns so far counts.
    """
    real, imaginary = data.responses(pole)
    columns, strength, wanted = np.hstack([real, imaginary]), 0.0, []
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    together = [left] if data.weights is None else np.hsplit(left, left.shape[1])
    for weights, basis, rest in zip(weights_of(data), bases, together, strict=True):
        weighted = weights * columns / scale
        inside = basis.T @ weighted
        squares, directions = np.linalg.eigh(weighted.T @ weighted - inside.T @ inside)
        sizes = np.sqrt(np.maximum(squares, 0.0))
        good = sizes > 1e-4 * max(sizes[-1], 1e-3)
        apart = directions[:, good] / sizes[good]
        seen = apart.T @ (weighted.T @ rest)  # what is left has no part in the basis
        wanted.append(apart @ seen / scale[:, None])
        strength += float((seen**2).sum())
    residues = np.hstack(wanted)
    return strength, _of_rank_one(residues, scale)


def bases_of(data: Measurement, fit: Fit) -> list[np.ndarray]:
    """Of `basis_of`: one for each output, or one for all of equal weights."""
    return [basis_of(data, fit, weights) for weights in weights_of(data)]


def weights_of(data: Measurement) -> list[np.ndarray]:
    """Of each output (n_rows, 1), in units of their mean; of all together where they are the same in all rows."""
    if data.weights is None:
        return [np.ones((1, 1))]
    return list((data.weights / np.sqrt((data.weights**2).mean(axis=0))).T[:, :, None])


def basis_of(data: Measurement, fit: Fit, weights: np.ndarray | float = 1.0) -> np.ndarray:
    """Orthonormal basis (n_rows, n_columns) of the modal coordinates of a fit and the fixed columns, weighted."""
    each = zip(fit.poles, fit.participation)
    coordinates = [part for pole, l_r in each for part in modal_coordinate(data.responses(pole), l_r)]
    phi = weights * (np.column_stack([*coordinates, data.fixed]) if coordinates else data.fixed)
    return np.linalg.qr(phi / np.maximum(np.linalg.norm(phi, axis=0), 1e-300))[0]


def _spurious(data: Measurement, fit: Fit) -> np.ndarray:
    """Which are damped too much to ring, reach half of the sample rate, or split another mode.

    One splits another that has its shape, participation and band.
    """
    poles = fit.poles
    shapes = fit.amplitudes / fit.noise[:, None]
    strength = statistic_of_each(fit)
    band = np.abs(poles.real)[:, None] + np.abs(poles.real) + data.resolution
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < band
    alike = mac(shapes, shapes) * mac(fit.participation.T, fit.participation.T)
    one = shapes.shape[0] * data.n_inputs == 1  # which has no shape; how a record begins is none
    split = near & (alike > SELECTION.same_shape) & (strength[:, None] < strength) & (not one)
    return np.asarray(split.any(axis=1) | overdamped(poles) | _reaches_nyquist(data, poles))


def statistic_of(fit: Fit, r: int) -> float:
    """χ² of a mode's shape in the noise, poles and participation held."""
    both, noise, found = [r, fit.poles.size + r], fit.noise, 0.0
    for part, outputs in fit.outputs():
        c = part.coefficients[both] / noise[outputs]
        # a pole at Nyquist turns by half a turn a sample: no imaginary part
        found += float(np.einsum("ij,ik,kj->", c, scaled_inverse(part.spread[np.ix_(both, both)]), c))
    return found


def statistic_of_each(fit: Fit) -> np.ndarray:
    """`statistic_of` each mode, (n_modes,)."""
    return np.array([statistic_of(fit, r) for r in range(fit.poles.size)])


def whole_statistic_of(fit: Fit) -> np.ndarray:
    """χ² of each mode's shape in the noise, (n_modes,), poles and participation of all modes unknown."""
    n, bound, free = fit.poles.size, covariance(fit), free_parameters(fit)
    found = np.zeros(n)
    if n == 0:
        return found
    amplitudes = fit.coefficients[: 2 * n].reshape(2, n, -1)
    drift = [np.einsum("ct,tkj->cjk", part.tilt[: 2 * n], moves(fit, part)[:, free]) for part in fit.parts]
    for r in range(n):
        both = [r, n + r]
        drifts = np.concatenate([each[both] for each in drift], axis=1)
        size = 2 * drifts.shape[1]
        spread = drifts.reshape(size, -1) @ bound @ drifts.reshape(size, -1).T
        spread = spread.reshape(2, size // 2, 2, size // 2)
        for part, outputs in fit.outputs():
            own = part.spread[np.ix_(both, both)]
            for j in range(outputs.start, outputs.stop):
                spread[:, j, :, j] += own * fit.noise[j] ** 2
        c = amplitudes[:, r].ravel()
        spread = spread.reshape(size, size)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(spread), 1e-300))
        # Modes that are all but alike leave it singular.
        found[r] = c * scale @ np.linalg.pinv(spread * np.outer(scale, scale), hermitian=True) @ (c * scale)
    return found
