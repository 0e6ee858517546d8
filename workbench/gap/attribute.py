"""Which effects: every kind of the catalogue tried alone, then in pairs, until the residual is noise."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from workbench.gap.disturbance import RandomForceFit, fit_random_force
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.containment import simpler_forms
from workbench.gap.effects.effect import Effect, Kind, apply_all
from workbench.gap.effects.environment import RANDOM_DISTURBANCE
from workbench.gap.effects.nominal import NOMINAL_FIGURES
from workbench.gap.effects.ports import clipped_level, rounding_step
from workbench.gap.evidence import Evidence
from workbench.gap.fit import HOPELESS, Fit, cost_of, fit
from workbench.gap.prediction import FitData
from workbench.records.record import Record
from workbench.rig.rig import Rig

SLACK = 0.03
INTEGRATION_SHARE = 2e-6
SURE = 30.0
WORTHWHILE = 0.01  # of the noise power: less is within what two good finite-element models differ by
NEAR = 0.1  # of the gap's power left: a set this near may only stand in the wrong valley
TARGETS_A_KIND, JOINED = 2, 10


@dataclass(frozen=True, eq=False)
class Attribution:
    """What the search found on the fit records.

    Attributes:
        outcome: "none", "explained", "part" or "unknown".
        best: the chosen set of effects, fitted; empty for none; for "part" and "unknown" the nearest one.
        random: statistics of a random disturbance, where the set holds one.
        rivals: other sets, best first, with their probabilities against the best.
        nominal_cost: mean square of the nominal residual in noise units.
        singles: every kind's best fit alone, best first.
        evidence: of the nominal rig.
        data: what was fitted, noise of rounded sensors included.
    """

    outcome: str
    best: Fit
    random: RandomForceFit | None
    rivals: tuple[tuple[Fit, float], ...]
    nominal_cost: float
    singles: tuple[Fit, ...]
    evidence: Evidence
    data: FitData


@dataclass(frozen=True, eq=False)
class _Search:
    rig: Rig
    data: FitData
    quick: FitData
    first: FitData
    catalogue: tuple[Kind, ...]
    report: Callable[[str, float], None]
    pool: ThreadPoolExecutor
    nominal: np.ndarray  # (n_records, n_outputs) mean squares

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


def attribute(
    rig: Rig,
    records: Sequence[Record],
    *,
    catalogue: tuple[Kind, ...] = CATALOGUE,
    report: Callable[[str, float], None] = lambda text, share: None,
    workers: int = 2,
    settle: float = 0.0,
    free_nominal: bool = False,
) -> Attribution:
    """Find the effects that turn the residual of a rig on its fit records into noise.

    Each kind is tried alone from many starts; if none alone leaves only noise, the best few are each joined by a
    second. A set counts as an explanation only when every record is left at its noise floor; else the outcome is
    "part" or "unknown".

    Args:
        rig: nominal.
        records: to fit; validation records have no business here.
        catalogue: kinds of effects to try.
        report: told (what, share done) as the search proceeds.
        workers: threads.
        settle: seconds at the start of each record that are simulated but not counted.
        free_nominal: fit the nominal figures along with every candidate from the first, for a model that is known to be
            a little off; otherwise they are freed only where no set explains the records without.
    """
    noise = np.array([sensor.noise_std for sensor in rig.sensors])
    if not (noise > 0).all():
        name = rig.sensors[int(np.argmin(noise))].name
        raise ValueError(f"sensor {name} has no noise_std; the diagnosis weighs every residual by it")
    plain = FitData(tuple(records), noise, lead=round(settle / records[0].sample_time))
    seen, data = _plain_to_see(rig, plain)
    with ThreadPoolExecutor(workers) as pool:
        return _search(rig, seen, data, catalogue, report, pool, free_nominal)


def _plain_to_see(rig: Rig, data: FitData) -> tuple[tuple[Effect, ...], FitData]:
    """Rounding and clipping show in the readings themselves; rounding then adds its own noise to the channel's."""
    evidence = Evidence.of(rig, data)
    kinds = {kind.name: kind for kind in CATALOGUE}
    seen, noise = [], data.noise.copy()
    for j, sensor in enumerate(rig.sensors):
        step = rounding_step(evidence, sensor.name)
        if step is not None and step**2 / 12.0 > 0.02 * sensor.noise_std**2:
            seen.append(Effect(kinds["sensor_quantisation"], sensor.name, {"step": step}, {"step": 0.0}))
            noise[j] = np.hypot(noise[j], step / np.sqrt(12.0))
        elif step is None:
            level = clipped_level(evidence, sensor.name)
            if level is not None:
                seen.append(Effect(kinds["sensor_clipping"], sensor.name, {"limit": level}, {"limit": 0.0}))
    return tuple(seen), replace(data, noise=noise)


def _search(rig, seen, data, catalogue, report, pool, free_nominal) -> Attribution:
    base = apply_all(rig, seen)
    nominal = data.by_channel(data.residual(rig))
    start = Fit(seen, cost_of(base, (), data), data.by_channel(data.residual(base)), 0, "read off the records")
    telling = _telling(data, start)
    quick, first = data.only(telling), data.only(telling[:1]).stepped(2)
    search = _Search(base, data, quick, first, catalogue, report, pool, nominal)
    report("looking for the missing force", 0.02)
    evidence = Evidence.of(base, data)
    if free_nominal:
        start = fit(search.rig, (_figures(search),), search.data, iterations=15)
        evidence = Evidence.of(apply_all(search.rig, start.effects), data)
    singles = _extend(search, start.effects if free_nominal else (), evidence, 0.05, 0.45, finalists=8)
    found = _decide(search, start, singles)
    if found is None and free_nominal:
        best, rivals = _ranked(search, list(search.pool.map(lambda f: _finished(search, f), singles[:3])))
        found = _unexplained(start, best, rivals)
    if found is None:
        pairs = _pairs(search, singles)
        found = _decide_pairs(search, start, singles, pairs)
        if found[0] != "explained":
            found = _with_nominal(search, start) or found
    outcome, best, random, rivals = found
    if seen:
        best = replace(best, effects=(*seen, *(e for e in best.effects if e not in seen)))
        outcome = "explained" if outcome == "none" else outcome
    report("done", 1.0)
    return Attribution(
        outcome=outcome,
        best=best,
        random=random,
        rivals=rivals,
        nominal_cost=float(nominal.mean()),
        singles=tuple(singles),
        evidence=Evidence.of(rig, data) if seen else evidence,
        data=data,
    )


def _telling(data: FitData, start: Fit) -> tuple[str, ...]:
    """The names of the two records that say most: the largest residual against the noise, and against the signal."""
    by_record = start.cost_by_channel.mean(axis=1)
    scale = np.array([np.mean((r.outputs.std(axis=1) / data.noise) ** 2) for r in data.counted])
    order = [int(np.argmax(by_record)), *np.argsort(-(by_record - 1.0) / scale)]
    chosen = list(dict.fromkeys(int(i) for i in order))[:2]
    return tuple(data.records[i].name for i in chosen)


# --- one more effect


def _extend(search: _Search, given: tuple[Effect, ...], evidence: Evidence, begin, end, *, finalists: int) -> list[Fit]:
    """Fits of the given effects with one more, for every kind and target; the best `finalists` on all records."""
    rig = apply_all(search.rig, given)
    left = search.data.by_channel(search.data.residual(rig))
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
        started = _promising(started, TARGETS_A_KIND)
        started = list(search.pool.map(lambda s: _alone(search, rig, s), started))
        started = _promising(started, TARGETS_A_KIND)[:JOINED]
    quick_fits: list[Fit] = []
    for i, candidate in enumerate(search.pool.map(lambda s: _quick_fit(search, given, s), started)):
        search.report(candidate.effects[-1].kind.words, begin + (end - begin) * (0.3 + 0.5 * (i + 1) / len(started)))
        quick_fits.append(candidate)
    quick_fits.sort(key=lambda f: f.cost)
    chosen = _spread_over_kinds(quick_fits, 3)
    close = [f for f in chosen if f.cost < 4.0 * chosen[0].cost]
    chosen = chosen[: max(finalists, min(len(close), 2 * finalists))]
    full = list(search.pool.map(lambda f: fit(search.rig, f.effects, search.data, iterations=5), chosen))
    full.sort(key=lambda f: f.cost)
    running = [f for i, f in enumerate(full) if i < 3 or f.cost < 2.0 * full[0].cost]
    full[: len(running)] = search.pool.map(lambda f: fit(search.rig, f.effects, search.data), running)
    search.report("all records", end)
    return sorted(full, key=lambda f: f.cost)


def _spread_over_kinds(fits: Sequence[Fit], most: int) -> list[Fit]:
    """The fits in their order, at most so many whose last effect is of one kind, none twice."""
    chosen, counts, keys = [], {}, set()
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


def _started(search: _Search, rig: Rig, evidence: Evidence, kind: Kind, target) -> list[tuple[float, Effect]]:
    """The two best starts of a kind on the most telling record, coarsely stepped, with their costs."""
    starts = [Effect(kind, target, dict(values)) for values in kind.starts(evidence, target)]
    costs = [cost_of(rig, (effect,), search.first) for effect in starts]
    order = [i for i in np.argsort(costs) if costs[i] < HOPELESS]
    # a lone start is of an effect that is linear in its number: its cost says nothing yet
    return [(-1.0 if len(starts) == 1 else costs[i], starts[i]) for i in order[:2]]


def _promising(started: list[list[tuple[float, Effect]]], most: int) -> list[list[tuple[float, Effect]]]:
    """The tasks in the order of their costs, at most so many targets of a kind."""
    kept, counts = [], {}
    for task in sorted(started, key=lambda s: s[0][0]):
        name = task[0][1].kind.name
        counts[name] = counts.get(name, 0) + (task[0][0] >= 0)
        if counts[name] <= most:
            kept.append(task)
    return kept


def _alone(search: _Search, rig: Rig, started: list[tuple[float, Effect]]) -> list[tuple[float, Effect]]:
    """The best start, improved a little with the effects found before held fixed."""
    candidate = fit(rig, (started[0][1],), search.quick, iterations=3)
    return [(candidate.cost, candidate.effects[0])]


def _quick_fit(search: _Search, given: tuple[Effect, ...], started: list[tuple[float, Effect]]) -> Fit:
    """The best of a kind's starts, improved a little on the quick records, jointly with the given effects."""
    fits = [fit(search.rig, (*given, effect), search.quick, iterations=4 if given else 7) for _, effect in started]
    return min(fits, key=lambda f: f.cost)


# --- decisions


def _finished(search: _Search, candidate: Fit) -> Fit:
    """The same set on all records with finer substeps, to the end."""
    return fit(search.rig, candidate.effects, search.data.stepped(8), iterations=12, tolerance=1e-7)


def _relocated(search: _Search, candidate: Fit) -> Fit:
    """The set with its places tried elsewhere: a symmetric structure has a twin valley at the mirrored place."""
    length = search.rig.modes.length
    places = [*(length * np.linspace(0.04, 0.96, 13))]
    for i, effect in enumerate(candidate.effects):
        if "at" not in effect.values or effect.kind.path not in ("structure", "environment"):
            continue
        moved = []
        for at in (length - effect.values["at"], *places):
            elsewhere = replace(effect, values={**effect.values, "at": float(at)})
            effects = (*candidate.effects[:i], elsewhere, *candidate.effects[i + 1 :])
            moved.append((cost_of(search.rig, effects, search.quick), effects))
        moved.sort(key=lambda item: item[0])
        # the mirrored place is always worth a fit of its own, whatever its cost before it
        mirrored = (
            *candidate.effects[:i],
            replace(effect, values={**effect.values, "at": length - effect.values["at"]}),
        )
        trials = [moved[0][1], moved[1][1], (*mirrored, *candidate.effects[i + 1 :])]
        for effects in trials:
            started = fit(search.rig, effects, search.quick, iterations=6)
            trial = fit(search.rig, started.effects, search.data, iterations=10)
            if trial.cost < candidate.cost:
                candidate = trial
    return _finished(search, candidate)


def _simplest(search: _Search, candidate: Fit) -> Fit:
    """The set with each effect replaced by one it contains as a limit, where the records cannot tell them apart."""
    improved = True
    while improved:
        improved = False
        for i, effect in enumerate(candidate.effects):
            for simpler in simpler_forms(effect, search.rig):
                effects = (*candidate.effects[:i], simpler, *candidate.effects[i + 1 :])
                trial = fit(search.rig, effects, search.data.stepped(8), iterations=12, tolerance=1e-7)
                extra = max(candidate.n_parameters - trial.n_parameters, 1)
                if search.explains(trial) and not search.surely_better(candidate, trial.cost, extra):
                    candidate, improved = trial, True
                    break
            if improved:
                break
    return candidate


def _ranked(search: _Search, fits: Sequence[Fit]) -> tuple[Fit, tuple[tuple[Fit, float], ...]]:
    """The set of least description length, and the others with their probabilities.

    The likelihood of tens of thousands of values is over-confident of small misfits, so its logarithm counts half.
    """
    n = search.data.n_values
    distinct: dict[tuple, Fit] = {}
    for candidate in sorted(fits, key=lambda f: f.cost):
        distinct.setdefault(candidate.key, candidate)
    fits = list(distinct.values())
    score = np.array([n * f.cost + f.n_parameters * np.log(n) for f in fits])
    order = np.argsort(score)
    weights = np.exp(-0.25 * (score[order] - score[order[0]]))
    weights /= weights.sum()
    rivals = tuple((fits[i], float(w)) for i, w in zip(order[1:], weights[1:], strict=True))
    return fits[order[0]], rivals[:6]


def _decide(search: _Search, start: Fit, singles: list[Fit]):
    """None, or an outcome that needs no second effect."""
    good = [f for f in singles if search.worthwhile(f, start.cost)]
    if search.explains(start) and not good:
        return "none", start, None, ()
    finished = list(search.pool.map(lambda f: _finished(search, f), good[:4]))
    explaining = [f for f in finished if search.explains(f)]
    near = [f for f in finished[:2] if _near(search, f, NEAR)]
    if not explaining and near:
        explaining = [f for f in search.pool.map(lambda f: _relocated(search, f), near) if search.explains(f)]
    if explaining:
        best, rivals = _ranked(search, [_simplest(search, f) for f in explaining])
        return "explained", best, None, rivals
    if search.explains(start):
        return "none", start, None, ()
    random = _random(search, start)
    if random is not None and random[1].holds:
        return "explained", random[0], random[1], ()
    return None


def _random(search: _Search, given: Fit) -> tuple[Fit, RandomForceFit] | None:
    """The given effects and a random disturbance."""
    rig = apply_all(search.rig, [e for e in given.effects if e.kind.name != "sensor_quantisation"])
    evidence = Evidence.of(rig, search.data, 20)
    found = fit_random_force(rig, search.data, evidence.residuals, evidence.peaks[:2], evidence.force_rms)
    effect = Effect(
        RANDOM_DISTURBANCE,
        None,
        {"at": found.at, "rms": found.rms},
        {"at": found.at_std, "rms": found.rms_std},
    )
    combined = Fit(
        (*given.effects, effect), found.cost, given.cost_by_channel, given.n_parameters + 2, "maximum likelihood"
    )
    return combined, found


def _pairs(search: _Search, singles: list[Fit]) -> list[Fit]:
    """The best few single effects, each with a second one; stops at the first pair that explains the records."""
    firsts = _spread_over_kinds(singles, 2)[:5]
    pairs: list[Fit] = []
    for i, first in enumerate(firsts):
        begin = 0.5 + 0.4 * i / len(firsts)
        pairs += _joined(search, first.effects, begin, begin + 0.4 / len(firsts), finalists=3 if i else 5)
        pairs.sort(key=lambda f: f.cost)
        best = _finished(search, pairs[0])
        if not search.explains(best) and _near(search, best, 0.2 * NEAR):
            best = _relocated(search, best)
        if search.explains(best):
            return [best, *pairs]
    return _exchanged(search, pairs)


def _joined(search: _Search, given: tuple[Effect, ...], begin: float, end: float, *, finalists: int) -> list[Fit]:
    evidence = Evidence.of(apply_all(search.rig, given), search.data, 20)
    return _extend(search, given, evidence, begin, end, finalists=finalists)


def _near(search: _Search, candidate: Fit, share: float) -> bool:
    """Whether little of the gap's power is left."""
    return candidate.cost - 1.0 < share * (search.nominal.mean() - 1.0)


def _exchanged(search: _Search, pairs: list[Fit]) -> list[Fit]:
    """The pairs, and those that come of keeping one half of a near miss and looking for the other half anew.

    In a near miss the right half has nearly its right numbers, better ones than it had alone.
    """
    best = pairs[0]
    if not _near(search, best, NEAR):
        return pairs
    for i in range(len(best.effects)):
        kept = best.effects[:i] + best.effects[i + 1 :]
        pairs = pairs + _joined(search, kept, 0.9, 0.94, finalists=4)
    return sorted(pairs, key=lambda f: f.cost)


def _with_nominal(search: _Search, start: Fit):
    """An outcome with the nominal figures freed, alone or with one effect; None if that explains nothing either.

    The nominal figures are trusted first, because freed they can bend to much; they are freed where no set explains
    the records without.
    """
    freed = fit(search.rig, (_figures(search),), search.data, iterations=8)
    if search.explains(freed):
        return "explained", freed, None, ()
    if freed.cost > 0.7 * start.cost:
        return None
    evidence = Evidence.of(apply_all(search.rig, freed.effects), search.data, 20)
    joined = _extend(search, freed.effects, evidence, 0.95, 0.99, finalists=2)
    finished = fit(search.rig, joined[0].effects, search.data.stepped(8), iterations=6)
    return ("explained", finished, None, ()) if search.explains(finished) else None


def _figures(search: _Search) -> Effect:
    """The nominal figures as they were handed in."""
    return Effect(NOMINAL_FIGURES, None, {p.name: 1.0 for p in NOMINAL_FIGURES.parameters(search.rig, None)})


def _unexplained(start: Fit, best: Fit, rivals):
    """The outcome where no set reaches the noise floor: in part, or not at all."""
    closed = 1.0 - np.sqrt(max(best.cost - 1.0, 0.0) / max(start.cost - 1.0, 1e-12))
    return ("part" if closed > 0.5 else "unknown"), best, None, rivals


def _decide_pairs(search: _Search, start: Fit, singles: list[Fit], pairs: list[Fit]):
    distinct: dict[tuple, Fit] = {}
    for candidate in pairs:
        distinct.setdefault(candidate.key, candidate)
    finished = sorted(
        search.pool.map(lambda f: _finished(search, f), list(distinct.values())[:4]), key=lambda f: f.cost
    )
    explaining = [f for f in finished if search.explains(f)]
    if not explaining:
        finished[:2] = search.pool.map(lambda f: _relocated(search, f), finished[:2])
        explaining = [f for f in finished if search.explains(f)]
    if explaining:
        best, rivals = _ranked(search, [_simplest(search, f) for f in explaining])
        return "explained", best, None, rivals
    for first in singles[:3]:
        random = _random(search, first)
        if random is not None and random[1].holds:
            return "explained", random[0], random[1], ()
    best, rivals = _ranked(search, finished or singles[:1])
    return _unexplained(start, best, rivals)
