"""A set of effects brought to its end: finer steps, other places, simpler forms, and its rank among others."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from workbench.gap.effects.effect import (
    COORDINATES,
    Effect,
    apply_all,
    each_left_out,
    key_of,
    more_general_sets,
    place_values,
    simpler_sets,
    with_one_simpler,
)
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.search.fit import Chord, Fit, cost_of, finite_residual, fit
from workbench.gap.search.search import Search, promise
from workbench.gap.search.settings import FINISH, SEARCH, SELECTION
from workbench.rig.simulate import is_stepped
from workbench.structure.domain import Between, Domain, Interval, Rectangle, Where

PORTS = ("actuator", "sensor")  # paths of effects that are not the structure's


def finished(search: Search, candidate: Fit) -> Fit:
    """The same set on all records with finer substeps, to the end; as it is where they bring it no nearer."""
    if candidate.falling == 0 and not search.explains(candidate):
        finely = cost_of(search.rig, candidate.effects, search.data.finely(SELECTION.fine))
        if finely - 1.0 > FINISH.no_nearer * (candidate.cost - 1.0):
            return _by_finest_steps(search, candidate)
    ended = fit(search.rig, candidate.effects, search.data.finely(SELECTION.fine), iterations=25, tolerance=1e-7)
    return _by_finest_steps(search, ended)


def _by_finest_steps(search: Search, ended: Fit) -> Fit:
    """The fit by the finest substeps, where it explains the records but for errors of stepping."""
    near = ended.cost < FINISH.all_but or search.near(ended, FINISH.stepping)
    if search.explains(ended) or not near or not is_stepped(apply_all(search.rig, ended.effects)):
        return ended
    # its numbers have made up for errors of stepping, so its cost by finer steps tells nothing before a fit
    finely = fit(search.rig, ended.effects, search.data.stepped(FINISH.finest), iterations=6, tolerance=1e-5)
    return _with_stepping(search, finely) if finely.cost < ended.cost else ended


def _with_stepping(search: Search, finely: Fit) -> Fit:
    """The fit by the finest substeps with what these may be off by: half as many move the readings by as much.

    Errors of stepping through a law with a corner fall with the first power of the step.
    """
    if search.explains(finely):
        return finely
    fine, half = (
        finite_residual(search.rig, finely.effects, search.data.stepped(n)) for n in (FINISH.finest, FINISH.finest // 2)
    )
    if fine is None or half is None:
        return finely
    return replace(finely, stepping=search.data.by_channel(fine - half).mean(axis=1))


def widened(search: Search, found: Fit) -> Fit:
    """The fit, or one with an effect as what it is a limiting case of, where the records surely prefer that.

    The wider law may make another effect needless: a constant force beside friction stood in for friction that differs
    between the two directions. That is no richer a set, so any sure gain is one.
    """
    sets, kinds = list(more_general_sets(found.effects)), {effect.kind for effect in found.effects}
    if not sets:
        return found
    data = search.data.finely(SELECTION.fine)
    cost = cost_of(search.rig, found.effects, data)

    def anew(effects: Sequence[Effect]) -> Fit:
        return fit(search.rig, effects, data, iterations=FINISH.widening, workers=search.workers, chord=Chord())

    for effects in sets:
        trial = anew(effects)
        extra = trial.n_parameters - found.n_parameters
        # what the fit anew of all other numbers brings, it brings to the plain form too
        if search.tells_apart(trial.cost, cost, extra) and search.tells_apart(
            trial.cost, anew(found.effects).cost, extra
        ):
            return trial
        instead = [anew(fewer) for fewer in each_left_out(trial.effects) if {e.kind for e in fewer} - kinds]
        best = min(instead, key=lambda f: f.cost, default=found)
        if best.n_parameters <= found.n_parameters and search.surely_better(best, cost, 0):
            return best
    return found


def simplified(search: Search, candidate: Fit) -> Fit:
    """A near miss with an effect as what it turns into at a bound, where that comes nearer.

    A hysteretic spring finds its way from where a plain one does not, and then never yields.
    """
    here = cost_of(search.rig, candidate.effects, search.quick)
    for effects in with_one_simpler(candidate.effects, search.rig):
        started = fit(search.rig, effects, search.quick, iterations=6)
        if promise(started) < here:
            trial = finished(search, fit(search.rig, started.effects, search.data, iterations=10))
            if trial.cost < candidate.cost:
                return trial
    return candidate


def relocated(search: Search, candidate: Fit) -> Fit:
    """The set with its places tried elsewhere: a symmetric structure has a twin valley at the mirrored place."""
    for i, effect in enumerate(candidate.effects):
        if effect.at is None or effect.kind.path not in ("structure", "environment"):
            continue
        here = fit(search.rig, candidate.effects, search.quick, iterations=6)
        for moved in _elsewhere(search, candidate.effects, i):
            started = fit(search.rig, moved, search.quick, iterations=6)
            if promise(started) > FINISH.lower * here.cost:
                continue
            trial = fit(search.rig, started.effects, search.data, iterations=10)
            if trial.cost < candidate.cost:
                candidate, here = trial, started
    return finished(search, candidate)


def _elsewhere(search: Search, effects: tuple[Effect, ...], i: int) -> list[tuple[Effect, ...]]:
    """The set with effect i at the two likeliest other places, and mirrored."""
    effect, domain = effects[i], search.rig.modes.domain

    def moved(where: Where, factor: float = 1.0) -> tuple[Effect, ...]:
        values = {**effect.values, **place_values(where)}
        if strength is not None:
            values[strength.name] = float(np.clip(factor * values[strength.name], strength.low, strength.high))
        return (*effects[:i], replace(effect, values=values), *effects[i + 1 :])

    strength = next((p for p in effect.parameters(search.rig) if p.logarithmic and p.name not in COORDINATES), None)
    # where the structure moves less, the same effect takes more strength
    factors = FINISH.factors if strength is not None else (1.0,)
    tried = []
    for where in other_places(effect, domain):
        there = [moved(where, factor) for factor in factors]
        likeliest = min(there, key=lambda s: cost_of(search.rig, s, search.first))
        tried.append(fit(search.rig, likeliest, search.first, iterations=FINISH.tried))
    tried.sort(key=lambda f: f.cost)
    elsewhere = [f for f in tried if domain.separation(f.effects[i].at, effect.at) > FINISH.apart]
    # the mirrored places are always worth a fit of their own, whatever their cost before it
    return [*(f.effects for f in elsewhere[:2]), *map(moved, _mirrored(effect.at, domain))]


def other_places(effect: Effect, domain: Domain) -> Sequence[Where]:
    """Along an interval or over a rectangle some all over it; named points; pairs of them with either point kept."""
    if isinstance(domain, Interval):
        return [float(x) for x in domain.length * np.linspace(0.04, 0.96, 13)]
    if isinstance(domain, Rectangle):
        return domain.grid(6)
    if isinstance(effect.at, Between):
        return [pair for pair in domain.pairs() if pair != effect.at and {*pair} & {*effect.at}]
    return [name for name in domain.grid() if name != effect.at]


def _mirrored(where: Any, domain: Domain) -> list[Where]:
    if isinstance(domain, Interval):
        return [domain.length - where]
    if isinstance(domain, Rectangle):
        (a, b), (x, y) = domain.length, where
        return [(a - x, y), (x, b - y), (a - x, b - y)]
    return []


def plainest(search: Search, fits: Sequence[Fit], *, worth: float = 0.0) -> list[Fit]:
    """The fits without those that come to another of them at a bound, and are no better than it.

    Args:
        worth: of the noise power, what a fit must be better by at least.
    """
    by_key = {candidate.key: candidate for candidate in fits}

    def needless(candidate: Fit) -> bool:
        others = (by_key.get(key_of(form)) for form in simpler_sets(candidate.effects, search.rig))
        simpler = (other for other in others if other is not None and other is not candidate)
        return any(not (_pays(search, candidate, f) and f.cost - candidate.cost > worth) for f in simpler)

    return [candidate for candidate in fits if not needless(candidate)]


def _pays(search: Search, candidate: Fit, simpler: Fit) -> bool:
    return search.tells_apart(candidate.cost, simpler.cost, max(candidate.n_parameters - simpler.n_parameters, 1))


def simplest(search: Search, candidate: Fit) -> Fit:
    """The set with effects replaced by simpler or fewer ones, where the records cannot tell them apart."""
    here = cost_of(search.rig, candidate.effects, search.quick)

    def tried(effects: tuple[Effect, ...]) -> Fit | None:
        if promise(fit(search.rig, effects, search.quick, iterations=FINISH.at_first)) > FINISH.too_far * here:
            return None
        trial = fit(search.rig, effects, search.data.finely(SELECTION.fine), iterations=12, tolerance=1e-7)
        return trial if search.explains(trial) and not _pays(search, candidate, trial) else None

    simpler = next(filter(None, search.workers.map(tried, _simpler_sets(search, candidate))), None)
    return candidate if simpler is None else simplest(search, simpler)


def _simpler_sets(search: Search, candidate: Fit) -> Iterator[tuple[Effect, ...]]:
    for effect in candidate.effects if len(candidate.effects) > 1 else ():
        rest = tuple(other for other in candidate.effects if other is not effect)
        if cost_of(search.rig, rest, search.data) < 1.0 + FINISH.idle:
            yield rest
    yield from simpler_sets(candidate.effects, search.rig)


def ranked(search: Search, fits: Sequence[Fit]) -> tuple[Fit, tuple[tuple[Fit, float], ...]]:
    """The set of least description length, and the others with their probabilities.

    The likelihood of tens of thousands of values is over-confident of small misfits, so its logarithm counts half.
    """
    (best, _), *rivals = _weighted(search, fits)
    return best, tuple(rivals[:6])


def _weighted(search: Search, fits: Sequence[Fit]) -> list[tuple[Fit, float]]:
    """The best fit of every set with its probability, the most likely first."""
    n = search.data.n_values
    fits = best_of_each(sorted(fits, key=lambda f: f.cost))
    score = np.array([n * f.cost + f.n_parameters * np.log(n) for f in fits])
    order = np.argsort(score)
    weights = np.exp(-0.25 * (score[order] - score[order[0]]))
    weights /= weights.sum()
    return [(fits[i], float(w)) for i, w in zip(order, weights, strict=True)]


def with_equals(
    search: Search,
    best: Fit,
    rivals: tuple[tuple[Fit, float], ...],
    evidence: Evidence,
    alike: Sequence[tuple[str, str, float]],
) -> tuple[tuple[Fit, float], ...]:
    """The rivals of a set, and those that have an effect at another actuator or sensor and explain the records as well.

    To one actuator and one sensor it is the same whether the one or the other is wrong. Predictions one sample ahead
    prefer one of them, for they weigh the noise of what is read.

    Args:
        rivals: with their probabilities.
        alike: labels of two effects that the records could not distinguish, and how alike.
    """
    data = search.data.finely(SELECTION.fine)
    known = {best.key, *(f.key for f, _ in rivals)}
    sets = [s for s in _at_other_ports(search, best, evidence, alike) if key_of(s) not in known]
    if not sets:
        return rivals
    here, *each = search.workers.map(lambda s: fit(search.rig, s, data), [best.effects, *sets])
    equals = [f for f in each if f.cost < here.cost + SEARCH.rival]
    if not equals:
        return rivals
    weighted = _weighted(search, [here, *equals])
    # of what sets leave that all leave more than noise no law of chance is known
    if not search.explains(weighted[0][0]):
        weighted = [(f, 1.0 / len(weighted)) for f, _ in weighted]
    own = next(p for f, p in weighted if f is here)
    beside = [(f, p) for f, p in weighted if f is not here]
    return tuple(sorted([*beside, *((f, p * own) for f, p in rivals)], key=lambda each: -each[1]))


def _at_other_ports(
    search: Search, best: Fit, evidence: Evidence, alike: Sequence[tuple[str, str, float]]
) -> Iterator[tuple[Effect, ...]]:
    at_ports = [kind for kind in search.catalogue if kind.path in PORTS]
    labels = {
        Effect(kind, target, {}).label: (kind, target) for kind in at_ports for target in kind.targets(search.rig)
    }
    for effect in best.effects:
        if effect.label in labels:
            likes = dict.fromkeys(label for *pair, _ in alike if effect.label in pair for label in pair)
            for kind, target in (labels[label] for label in likes if label in labels and label != effect.label):
                for values in list(kind.starts(evidence, target))[:1]:
                    other = Effect(kind, target, dict(values))
                    yield tuple(other if e is effect else e for e in best.effects)


def best_of_each(fits: Sequence[Fit]) -> list[Fit]:
    """The first fit of every set, in the order of the fits."""
    distinct: dict[tuple[str, ...], Fit] = {}
    for candidate in fits:
        distinct.setdefault(candidate.key, candidate)
    return list(distinct.values())
