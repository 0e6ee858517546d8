"""Screening of candidate effects to first order, then fits to one-step-ahead predictions, then to whole records."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from workbench.arrays import Flags, Floats
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.effect import ALL, Effect, Kind, apply_all, contained
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.search.fit import Fit, cost_of, finite_residual, fit, slopes
from workbench.gap.search.search import Search, apart, best_of_each_kind, in_one_minimum, promise
from workbench.gap.search.settings import SCREENING, SEARCH, SELECTION
from workbench.rig.rig import Rig
from workbench.rig.simulate import is_stepped
from workbench.structure.domain import Domain, NamedPoints

RUNAWAY = 1e10  # mean square of a change of the residual, in units of the noise, beyond which a start is unusable
NOTHING = 1e-300  # square of a change that the given effects explain entirely


@dataclass(frozen=True, eq=False)
class Screening:
    """Candidate start values of every kind and target, and the change of the innovations by each.

    An observer keeps the simulated motion close to the measured one, so innovations are nearly linear in the strength
    of an effect, even a stiff one. With r the innovations of the most informative record and m_i their change by start
    i, the minima of |r + a m_i|² and |r + a m_i + b m_j|² over a and b rank single effects and pairs.

    Attributes:
        starts: grouped by kind and target.
        moves: (n_starts, n_values) changes m_i, orthogonal to the sensitivities to the effects that are given.
        left: (n_values,) innovations r, likewise.
        least, most: (n_starts,) bounds of the strength, in units of the start's.
        domain: the places of the structure.
    """

    starts: tuple[Effect, ...]
    moves: np.ndarray
    left: np.ndarray
    least: np.ndarray
    most: np.ndarray
    domain: Domain

    @classmethod
    def of(cls, search: Search, given: tuple[Effect, ...], reconstruction: ForceReconstruction) -> "Screening":
        """Screen all effects that may be present beside the given ones; the reconstruction is with these."""
        data, unprojected = search.first_ahead, search.first_ahead.unprojected
        before = finite_residual(search.rig, (*given, *search.held), unprojected)
        if before is None:
            return cls((), np.zeros((0, 0)), np.zeros(0), np.zeros(0), np.zeros(0), search.rig.modes.domain)
        every = slice(None, None, max(1, before.size // SCREENING.max_values))

        starts = _starts(search, given, reconstruction)
        left = before.copy()
        data.project_out(left)
        left = left[every]
        moves = search.workers.array(len(starts), left.size)  # the one large array

        def moved_by(some: range) -> list[bool]:
            # nuisance parameters are projected out of many starts at once: the projection matrix is large
            moved = np.zeros((len(some), before.size))
            for row, i in zip(moved, some, strict=True):
                there = finite_residual(search.rig, (*given, starts[i], *search.held), unprojected)
                row[:] = 0.0 if there is None else there - before
            data.project_out(moved)
            moves[some] = moved[:, every]
            return [bool(0 < moves[i] @ moves[i] < RUNAWAY * left.size) for i in some]

        for i in {start.kind: i for i, start in enumerate(starts) if start.kind not in CATALOGUE}.values():
            moved_by(range(i, i + 1))  # a law of the user's own is compiled here, not in each process
        at_once = [
            range(i, min(i + SCREENING.batch_size, len(starts))) for i in range(0, len(starts), SCREENING.batch_size)
        ]
        usable_starts = [is_usable for some in search.workers.map(moved_by, at_once) for is_usable in some]
        usable = [i for i, is_usable in enumerate(usable_starts) if is_usable]
        for row, i in enumerate(usable):  # unusable rows are overwritten
            moves[row] = moves[i]
        moves = moves[: len(usable)]
        if given and usable:
            basis, _ = np.linalg.qr(slopes(search.rig, given, data, held=search.held)[1][every])
            left = left - basis @ (basis.T @ left)
            for row in moves:
                row -= basis @ (basis.T @ row)
        least, most = np.array([_bounds(starts[i]) for i in usable]).reshape(-1, 2).T
        return cls(tuple(starts[i] for i in usable), moves, left, least, most, search.rig.modes.domain)

    def likeliest(self) -> list[Effect]:
        """The best start of every kind and target, and the best at another place, by increasing cost."""
        own, along = np.einsum("ij,ij->i", self.moves, self.moves).clip(NOTHING), self.moves @ self.left
        a = (-along / own).clip(self.least, self.most)
        # rounded, so that of identical places the first comes first
        costs = np.round(a * (2.0 * along + a * own) / max(self.left @ self.left, 1e-300), 9)
        chosen: list[Effect] = []
        for i in np.argsort(costs, kind="stable"):
            start = self.starts[i]
            alike = [other for other in chosen if other.label == start.label]
            if not alike or (len(alike) == 1 and apart(start, alike[0], self.domain) and start.at is not None):
                chosen.append(start)
        return chosen

    def likeliest_pairs(self, most: int) -> list[tuple[Effect, Effect]]:
        """The best starts of every two kinds and targets, and the best at other places, by increasing cost."""
        if len(self.starts) < 2:
            return []
        costs = self._pair_costs()
        labels = [start.label for start in self.starts]
        begins = [i for i, label in enumerate(labels) if i == 0 or label != labels[i - 1]]
        blocks = [slice(*ends) for ends in pairwise((*begins, len(labels)))]
        beside = self._share_minimum
        for one in blocks:
            for other in blocks:
                if one.start > other.start or _duplicates(self.starts[one.start], self.starts[other.start]):
                    costs[one, other] = np.inf
            # two effects of one kind at one place are one of the summed strength
            costs[one, one][beside[one, one]] = np.inf
        best = np.minimum.reduceat(np.minimum.reduceat(costs, begins, axis=0), begins, axis=1)
        found = []
        for p, q in zip(*np.unravel_index(np.argsort(best, axis=None)[:most], best.shape), strict=True):
            block = costs[blocks[p], blocks[q]]
            for _ in range(2):
                i, j = np.unravel_index(np.argmin(block), block.shape)
                if np.isfinite(block[i, j]):
                    i, j = begins[p] + i, begins[q] + j
                    found.append((costs[i, j], (self.starts[i], self.starts[j])))
                    block = np.where(beside[i, blocks[p]][:, None] & beside[j, blocks[q]], np.inf, block)
        return [pair for _, pair in sorted(found, key=lambda entry: entry[0])[:most]]

    @property
    def _share_minimum(self) -> np.ndarray:
        """Whether two starts are close enough in place to share a local minimum: (n_starts, n_starts)."""
        if isinstance(self.domain, NamedPoints):
            names = np.array([str(start.at) for start in self.starts])
            alike: Flags = names[:, None] == names
            return alike
        at = np.array([[start.values.get(name, 0.0) for name in self.domain.coordinates] for start in self.starts])
        beside: Flags = np.linalg.norm(at[:, None] - at, axis=2) <= SEARCH.distinct_distance * self.domain.size
        return beside

    def _pair_costs(self) -> np.ndarray:
        """min |left + a m_i + b m_j|² - |left|² over a and b within their bounds: (n_starts, n_starts)."""
        products, along = self.moves @ self.moves.T, self.moves @ self.left
        i, j = along[:, None], along
        own_j = np.diag(products).clip(NOTHING)
        own_i = own_j[:, None]
        least, most = self.least[:, None], self.most[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            a = (j * products - i * own_j) / (own_i * own_j - products**2)
        a = np.nan_to_num(a, nan=1.0).clip(least, most)
        b = (-(j + a * products) / own_j).clip(self.least, self.most)
        a = (-(i + b * products) / own_i).clip(least, most)
        changes: Floats = a * (2.0 * i + a * own_i) + b * (2.0 * j + b * own_j) + 2.0 * a * b * products
        return changes


def _bounds(start: Effect) -> tuple[float, float]:
    """Bounds of the strength of an effect, in units of the start's."""
    if not start.values:
        return 1.0, 1.0
    return (-SCREENING.max_strength if start.kind.signed else SCREENING.min_strength), SCREENING.max_strength


def _starts(search: Search, given: tuple[Effect, ...], reconstruction: ForceReconstruction) -> list[Effect]:
    """Start values of every kind and target that may join the given effects, grouped by kind and target."""
    left = search.data.by_channel(search.data.residual(apply_all(search.rig, (*given, *search.held))))
    starts = [
        Effect(kind, target, dict(values))
        for kind in search.catalogue
        if kind.found_in == "search"
        for target in _plausible_targets(kind, search.rig, left)
        for values in kind.starts(reconstruction, target)
    ]
    return [start for start in starts if not any(_duplicates(start, effect) for effect in given)]


def _plausible_targets(kind: Kind, rig: Rig, left: np.ndarray) -> tuple[Any, ...]:
    """Targets of a kind; for a fault of a sensor, only sensors with a large residual (n_records, n_outputs)."""
    targets = kind.targets(rig)
    if kind.path != "sensor":
        return targets
    by_sensor = left.max(axis=0)
    names = [s.name for s in rig.sensors]
    worst = {names[j] for j in np.argsort(-by_sensor)[:3]}

    def disagrees(target: Any) -> bool:
        name = target[0] if isinstance(target, tuple) else target
        return name == ALL or name in worst or by_sensor[names.index(name)] > 0.2 * by_sensor.max()

    return tuple(target for target in targets if disagrees(target))


def _duplicates(one: Effect, other: Effect) -> bool:
    """Whether two effects have the same parameter of the same target, so that the second adds nothing."""
    kind = one.kind
    if other.kind is not kind or not (kind.path in ("actuator", "sensor") or other.at is None):
        return False
    return one.target == other.target or ALL in (one.target, other.target) or kind.exclusive


def one_more(
    search: Search, given: tuple[Effect, ...], reconstruction: ForceReconstruction, screened: Screening | None = None
) -> list[Fit]:
    """The best fits of the given effects with one more to one-step-ahead predictions, best first.

    Args:
        reconstruction: of the rig with the given effects.
        screened: the screening with these effects given, if it is available.
    """
    screened = Screening.of(search, given, reconstruction) if screened is None else screened
    chosen: list[Effect] = []
    for effect in screened.likeliest():
        if sum(effect.kind is other.kind for other in chosen) < SELECTION.targets_per_kind:
            chosen.append(effect)
    found = fitted_ahead(search, [(*given, effect) for effect in chosen])
    if not (search.held and found):
        return found
    # nuisance parameters absorb a start slightly off its place, so exact places are tried too
    at_likely_places = fitted_ahead(search, [(*given, effect) for effect in _at_likely_places(found, screened)])
    return distinct_minima(search, sorted((*found, *at_likely_places), key=lambda f: f.cost))


def _at_likely_places(found: Sequence[Fit], screened: Screening) -> list[Effect]:
    """Linear structural kinds at the places of the best other ones, and other faults of the likeliest transducer."""

    def is_linear(effect: Effect) -> bool:
        return effect.kind.path == "structure" and not effect.kind.nonlinear and effect.at is not None

    starts, best = screened.likeliest(), found[0].effects[-1]
    of_transducer = [
        e for e in starts if isinstance(e.target, str) and e.target == best.target and e.kind is not best.kind
    ]
    if isinstance(screened.domain, NamedPoints):
        return of_transducer
    likeliest = [f.effects[-1] for f in best_of_each_kind(found) if is_linear(f.effects[-1])][: SEARCH.few_finalists]
    linear = {effect.kind: effect for effect in reversed(starts) if is_linear(effect)}
    there = [e.moved_to(one.at) for one in likeliest for e in linear.values() if e.kind is not one.kind]
    return [*there, *of_transducer]


def fitted_ahead(search: Search, sets: Sequence[tuple[Effect, ...]]) -> list[Fit]:
    """Fits of sets to one-step-ahead predictions, best first: all to the most informative record, the best to two.

    Args:
        sets: of effects, the likeliest first.
    """

    first, both = search.first_ahead, search.ahead  # computed once, before processes are forked

    def ahead(task: tuple[tuple[Effect, ...], bool, int]) -> Fit:
        effects, alone, iterations = task
        data = first if alone else both
        return fit(search.rig, effects, data, held=search.held, iterations=iterations, tolerance=1e-4)

    with search.workers.pool(ahead) as share:
        tried = share([(effects, True, 2) for effects in sets[: SELECTION.fits_to_one_record]])
        likely = sorted(tried, key=promise)[: SELECTION.fits_to_two_records]
        fits = distinct_minima(search, sorted(share([(f.effects, False, 3) for f in likely]), key=promise))
        falling = [
            f
            for f in fits[: SELECTION.fits_until_convergence]
            if f.falling and promise(f) < SELECTION.max_cost_ratio * promise(fits[0])
        ]
        longer = share([(f.effects, False, 8) for f in falling])
    return distinct_minima(search, sorted((*longer, *(f for f in fits if f not in falling)), key=lambda f: f.cost))


def distinct_minima(search: Search, fits: Sequence[Fit]) -> list[Fit]:
    """The fits without those that converged to the local minimum of a better fit of the same set."""
    distinct: list[Fit] = []
    for candidate in fits:
        if not any(in_one_minimum(candidate, other, search.rig.modes.domain) for other in distinct):
            distinct.append(candidate)
    return distinct


def on_whole_records(
    search: Search, ahead: Sequence[Fit], most: int, *, to_cost: float = float("inf"), at_first: int | None = None
) -> list[Fit]:
    """The best one-step-ahead fits, refitted to whole records, best first.

    Args:
        ahead: one-step-ahead fits, best first.
        most: number of fits, at most; those of a much higher cost are left out.
        to_cost: cost that a fit must reach to be useful; fits that will not are stopped early.
        at_first: iterations before that is predicted; None for `SELECTION.first_iterations`.
    """
    at_first = SELECTION.first_iterations if at_first is None else at_first
    close = [f for f in ahead[:most] if f.cost < SEARCH.max_cost_ratio * ahead[0].cost]
    simpler = contained(close[0].effects, search.rig) if close else set()
    first = [f for f in close if f is close[0] or f.key in simpler]
    fits = search.workers.map(lambda f: by_continuation(search, f.effects, at_first), first)
    remaining = [f for f in close if f not in first]
    if any(search.explains(f) for f in fits):
        remaining = [f for f in remaining if f.cost < ahead[0].cost + SEARCH.alternative_margin]
    others = _without_generalisations(search, fits, remaining)
    more = search.workers.map(lambda f: by_continuation(search, f.effects, at_first), others)
    fits = sorted((*fits, *more), key=promise)
    fits = _without_generalisations(search, fits, fits)
    to_cost = min([to_cost, *(f.cost + SEARCH.alternative_margin for f in fits if search.explains(f))])
    running = [f for f in fits if f.falling and promise(f) < SEARCH.max_cost_ratio * promise(fits[0])]
    running = [f for f in running if promise(f, SEARCH.extrapolated_iterations) < to_cost]
    longer = search.workers.map(lambda f: whole(search, f.effects, 25), running)
    return sorted((*longer, *(f for f in fits if f not in running)), key=lambda f: f.cost)


def _without_generalisations(search: Search, fits: Sequence[Fit], others: Sequence[Fit]) -> list[Fit]:
    """The others without those that have a limiting case among the fits at the noise floor."""
    enough = {f.key for f in fits if f.cost < 1.0 + SEARCH.significant_gain and search.explains(f)}
    return [f for f in others if enough.isdisjoint(contained(f.effects, search.rig))]


def by_continuation(search: Search, effects: tuple[Effect, ...], iterations: int) -> Fit:
    """The set fitted to one-step-ahead predictions, then to whole records, by continuation in the observer gain.

    One-step-ahead residuals are smooth in the parameters. With a stiff law, a fit to whole records does not converge
    from half a percent off a place; where even a thousandth of a percent is too far, the observer gain is lowered in
    steps until the residual on whole records is small.

    Args:
        effects: with start values.
        iterations: on whole records, at most.
    """
    rig = apply_all(search.rig, effects)
    if is_stepped(rig) and not search.held and search.data.observer is None:
        for process_noise in SELECTION.continuation:
            data = search.data.one_step_ahead(rig, process_noise).finely(SELECTION.substeps)
            held = fit(search.rig, effects, data, iterations=8, tolerance=1e-4)
            effects = held.effects
            if (
                held.cost > SELECTION.max_residual_ahead
                or cost_of(search.rig, effects, search.data.finely(SELECTION.substeps)) < SELECTION.convergence_residual
            ):
                break
    return whole(search, effects, iterations)


def whole(search: Search, effects: tuple[Effect, ...], iterations: int) -> Fit:
    """The set fitted to whole records, with fine substeps."""
    data = search.data.finely(SELECTION.substeps)
    return fit(search.rig, effects, data, held=search.held, iterations=iterations)
