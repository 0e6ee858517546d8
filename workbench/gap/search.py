"""A search through the catalogue: every kind and target as one more effect beside those found before."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from workbench.gap.effects.effect import Effect, Kind, apply_all
from workbench.gap.effects.environment import RANDOM_DISTURBANCE
from workbench.gap.evidence import Evidence
from workbench.gap.fit import HOPELESS, Fit, cost_of, fit, sensitivity
from workbench.gap.missing_force import ForceFilter
from workbench.gap.prediction import FitData
from workbench.rig.rig import Rig

SLACK = 0.03
INTEGRATION_SHARE = 2e-6
SURE = 30.0
WORTHWHILE = 0.01  # of the noise power: less is within what two good finite-element models differ by
TARGETS_A_KIND, LIKELY, JOINED = 2, 16, 10
ELSEWHERE = 0.1  # of the length
CLOSE = 1.5
FEW, MORE = 3, 4  # iterations of a quick fit, and of one that may come first
AT_REST = 5e-3  # share of the cost: a quick fit that falls by less has said what it can
HOPEFUL, FAR = 24, 10.0


@dataclass(frozen=True, eq=False)
class Search:
    """What every step of a search works on.

    Attributes:
        rig: nominal, with what shows in the readings themselves.
        data: all records to fit.
        quick: the two most telling of them.
        first: the most telling one, coarsely stepped.
        catalogue: kinds of effects to try.
        report: told (what, share done).
        pool: threads.
        nominal: (n_records, n_outputs) mean squares that the nominal rig leaves, in noise units.
        held: effects that every candidate stands beside, as they are.
    """

    rig: Rig
    data: FitData
    quick: FitData
    first: FitData
    catalogue: tuple[Kind, ...]
    report: Callable[[str, float], None]
    pool: ThreadPoolExecutor
    nominal: np.ndarray
    held: tuple[Effect, ...] = ()

    def explains(self, candidate: Fit) -> bool:
        """Whether what is left is noise, in every record, up to the error of integration."""
        left = candidate.cost_by_channel.mean(axis=1)
        per_record = self.data.counted[0].outputs.size
        slack = SLACK + 5.0 * np.sqrt(2.0 / per_record) + INTEGRATION_SHARE * self.nominal.mean(axis=1)
        overall = SLACK + INTEGRATION_SHARE * self.nominal.mean()
        return bool((left < 1.0 + slack).all() and left.mean() < 1.0 + overall)

    def surely_better(self, candidate: Fit, than: float, extra: int) -> bool:
        """Whether the gain in likelihood pays for `extra` more numbers."""
        n = self.data.n_values
        return n * (than - candidate.cost) > SURE + extra * np.log(n)

    def worthwhile(self, candidate: Fit, than: float) -> bool:
        """Whether the gain is sure and large enough to be an effect rather than an imperfect model."""
        return self.surely_better(candidate, than, candidate.n_parameters) and than - candidate.cost > WORTHWHILE

    def near(self, candidate: Fit, share: float) -> bool:
        """Whether at most this share of the gap's power is left."""
        return candidate.cost - 1.0 < share * (self.nominal.mean() - 1.0)

    def through(self, whitener: ForceFilter) -> "Search":
        """The same search beside a random force."""
        quick, first = self.quick.through(whitener), self.first.through(whitener)
        return replace(self, data=self.data.through(whitener), quick=quick, first=first)

    def hearing(self) -> "Search":
        """The same search without the sensors that clip: what they do not show would pass for a force."""
        kept = [j for j, sensor in enumerate(self.rig.sensors) if not np.isfinite(sensor.limit)]
        if not kept or len(kept) == len(self.rig.sensors):
            return self
        sensors = tuple(self.rig.sensors[j] for j in kept)
        names = tuple(sensor.name for sensor in sensors)
        data, quick, first = (data.of_outputs(names) for data in (self.data, self.quick, self.first))
        rig = replace(self.rig, sensors=sensors)
        return replace(self, rig=rig, data=data, quick=quick, first=first, nominal=self.nominal[:, kept])

    def beside(self, figures: Effect) -> "Search":
        """The same search beside believed figures, which give way to every candidate to first order."""

        def giving_way(data: FitData) -> FitData:
            return data.giving_way(sensitivity(self.rig, (figures,), data))

        data, quick, first = self.pool.map(giving_way, (self.data, self.quick, self.first))
        return replace(self, data=data, quick=quick, first=first, held=(figures,))

    def side_by_side(self, function: Callable[..., Fit], candidates: Sequence[Fit]) -> list[Fit]:
        """`function(search, candidate)` of each, in their order."""
        return list(self.pool.map(lambda candidate: function(self, candidate), candidates))


def one_more(search: Search, given: tuple[Effect, ...], evidence: Evidence, begin, end, *, finalists: int) -> list[Fit]:
    """Fits of the given effects with one more, for every kind and target; the best `finalists` on all records."""
    rig = apply_all(search.rig, given)
    left = search.data.by_channel(search.data.residual(apply_all(rig, search.held)))
    tasks = [
        (kind, target)
        for kind in search.catalogue
        if kind is not RANDOM_DISTURBANCE and kind.name not in ("sensor_quantisation", "sensor_clipping")
        for target in _worthwhile(kind, rig, left)
        if not _repeats(kind, target, given)
    ]
    _ = evidence.at_peaks
    started = [s for s in search.pool.map(lambda task: _started(search, rig, evidence, *task), tasks) if s]
    search.report("starts", begin + 0.3 * (end - begin))
    if given:
        started = _improved(search, rig, _promising(started, TARGETS_A_KIND))
        started = _promising(started, TARGETS_A_KIND)[:JOINED]
    quick_fits: list[Fit] = []
    for i, candidate in enumerate(search.pool.map(lambda s: _quick_fit(search, given, s), started)):
        search.report(candidate.effects[-1].kind.words, begin + (end - begin) * (0.3 + 0.4 * (i + 1) / len(started)))
        quick_fits.append(candidate)
    quick_fits = _with_more_time(search, quick_fits)
    chosen = spread_over_kinds(quick_fits, 3)
    close = [f for f in chosen if f.cost < 4.0 * chosen[0].cost]
    chosen = chosen[: max(finalists, min(len(close), 2 * finalists))]
    full = sorted(search.pool.map(lambda f: _on_all(search, f, 5), chosen), key=promise)
    running = [f for i, f in enumerate(full) if i < 3 or promise(f) < 2.0 * promise(full[0])]
    full[: len(running)] = search.pool.map(lambda f: _on_all(search, f, 25) if f.falling else f, running)
    search.report("all records", end)
    return sorted(full, key=lambda f: f.cost)


def spread_over_kinds(fits: Sequence[Fit], most: int) -> list[Fit]:
    """The fits in their order, at most so many whose last effect is of one kind, none twice."""
    chosen: list[Fit] = []
    counts: dict[str, int] = {}
    keys = set()
    for candidate in fits:
        name = candidate.effects[-1].kind.name
        if candidate.cost < HOPELESS and counts.get(name, 0) < most and candidate.key not in keys:
            chosen.append(candidate)
            keys.add(candidate.key)
            counts[name] = counts.get(name, 0) + 1
    return chosen


def _worthwhile(kind: Kind, rig: Rig, left: np.ndarray) -> Iterable:
    """Targets of a kind; a fault of one sensor is only looked for where that sensor disagrees."""
    targets = kind.targets(rig)
    if kind.path != "sensor":
        return targets
    by_sensor = left.max(axis=0)
    names = [s.name for s in rig.sensors]
    worst = {names[j] for j in np.argsort(-by_sensor)[:3]}
    return [t for t in targets if t == "all" or t in worst or by_sensor[names.index(t)] > 0.2 * by_sensor.max()]


def _repeats(kind: Kind, target, given: Sequence[Effect]) -> bool:
    """The same figure of the same thing twice says nothing new."""
    for effect in given:
        if effect.kind is kind and (kind.path in ("actuator", "sensor") or "at" not in effect.values):
            if target == effect.target or "all" in (target, effect.target) or kind.name == "truncated_modes":
                return True
    return False


def _started(search: Search, rig: Rig, evidence: Evidence, kind: Kind, target) -> list[tuple[float, Effect]]:
    """The best start of a kind on the most telling record, coarsely stepped, and the best elsewhere, with costs."""
    starts = [Effect(kind, target, dict(values)) for values in kind.starts(evidence, target)]
    costs = [cost_of(rig, (effect, *search.held), search.first) for effect in starts]
    order = [i for i in np.argsort(costs) if costs[i] < HOPELESS]
    # a lone start is of an effect that is linear in its number: its cost says nothing yet
    chosen = order[:1] + [i for i in order[1:] if apart(starts[i], starts[order[0]], rig.modes.length)][:1]
    return [(-1.0 if len(starts) == 1 else costs[i], starts[i]) for i in chosen]


def apart(one: Effect, other: Effect, length: float) -> bool:
    """Whether two effects stand far enough apart to be in different valleys; those of no place always do."""
    return "at" not in one.values or abs(one.values["at"] - other.values["at"]) > ELSEWHERE * length


def _promising(started: list[list[tuple[float, Effect]]], most: int) -> list[list[tuple[float, Effect]]]:
    """The tasks in the order of their costs, at most so many targets of a kind."""
    kept = []
    counts: dict[str, int] = {}
    for task in sorted(started, key=lambda s: s[0][0]):
        name = task[0][1].kind.name
        counts[name] = counts.get(name, 0) + (task[0][0] >= 0)
        if counts[name] <= most:
            kept.append(task)
    return kept


def _improved(search: Search, rig: Rig, started: list[list[tuple[float, Effect]]]) -> list[list[tuple[float, Effect]]]:
    """The likeliest starts improved with the effects found before held fixed: of each task its best, and a rival near.

    One step of every start on the most telling record says which are likely.
    """

    def alone(effect: Effect, data: FitData, steps: int) -> Fit:
        return fit(rig, (effect,), data, held=search.held, iterations=steps)

    starts = [(i, effect) for i, task in enumerate(started) for _, effect in task]
    first = list(search.pool.map(lambda start: alone(start[1], search.first, 1), starts))
    likely = {*np.argsort([f.cost for f in first])[:LIKELY], *np.argsort([promise(f) for f in first])[:LIKELY]}
    chosen = sorted(i for i in likely if first[i].cost < HOPELESS)
    fits = list(search.pool.map(lambda i: alone(first[i].effects[0], search.quick, 2), chosen))
    by_task: dict[int, list[Fit]] = {}
    for i, candidate in zip(chosen, fits, strict=True):
        by_task.setdefault(starts[i][0], []).append(candidate)
    improved = []
    for task in by_task.values():
        best = min(f.cost for f in task)
        improved.append(sorted(((f.cost, f.effects[0]) for f in task if f.cost < CLOSE * best), key=lambda s: s[0]))
    return improved


def _quick_fit(search: Search, given: tuple[Effect, ...], started: list[tuple[float, Effect]]) -> Fit:
    """The most promising of a kind's starts, improved a little on the quick records, jointly with the given effects."""
    return min((_quickly(search, (*given, effect), FEW) for _, effect in started), key=promise)


def _with_more_time(search: Search, fits: Sequence[Fit]) -> list[Fit]:
    """The fits by their costs, those improved further that are still on their way and not far behind."""
    order = sorted(fits, key=promise)
    hopeful = [f for f in order[:HOPEFUL] if f.falling > 0 and promise(f) < FAR * promise(order[0])]
    longer = search.pool.map(lambda f: _quickly(search, f.effects, MORE), hopeful)
    return sorted((*(f for f in fits if f not in hopeful), *longer), key=lambda f: f.cost)


def _quickly(search: Search, effects: tuple[Effect, ...], iterations: int) -> Fit:
    return fit(search.rig, effects, search.quick, held=search.held, iterations=iterations, tolerance=AT_REST)


def promise(candidate: Fit) -> float:
    """The cost that one more iteration like the last would come to."""
    return candidate.cost * (1.0 - candidate.falling)


def _on_all(search: Search, candidate: Fit, iterations: int) -> Fit:
    return fit(search.rig, candidate.effects, search.data, held=search.held, iterations=iterations)
