"""Last refinement of sets of effects: finer substeps, other places, limiting cases, and their ranking."""

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
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.search.fit import Chord, Fit, cost_of, finite_residual, fit
from workbench.gap.search.search import Alternatives, Search, best_of_each, promise
from workbench.gap.search.settings import FINISH, FIT, SEARCH, SELECTION
from workbench.rig.simulate import is_stepped
from workbench.structure.domain import Between, Domain, Interval, Location, Rectangle

TRANSDUCERS = ("actuator", "sensor")  # paths of effects of actuators and sensors


def finished(search: Search, candidate: Fit) -> Fit:
    """The set refitted to all records with finer substeps until convergence, unless these lower the cost little."""
    if candidate.falling == 0 and not search.explains(candidate):
        fine_cost = cost_of(search.rig, candidate.effects, search.data.finely(SELECTION.substeps))
        if fine_cost - 1.0 > FINISH.integration_share * (candidate.cost - 1.0):
            return _by_finest_steps(search, candidate)
    ended = fit(search.rig, candidate.effects, search.data.finely(SELECTION.substeps), iterations=25, tolerance=1e-7)
    return _by_finest_steps(search, ended)


def _by_finest_steps(search: Search, ended: Fit) -> Fit:
    """The set refitted with the finest substeps, if only the integration error may keep it above the noise floor."""
    is_near = ended.cost < FINISH.refinement_cost or search.near(ended, FINISH.integration_error)
    if search.explains(ended) or not is_near or not is_stepped(apply_all(search.rig, ended.effects)):
        return ended
    # its parameters have absorbed integration errors, so its cost with finer substeps means nothing before a fit
    finely = fit(search.rig, ended.effects, search.data.stepped(FINISH.substeps), iterations=6, tolerance=1e-5)
    return _with_stepping(search, finely) if finely.cost < ended.cost else ended


def _with_stepping(search: Search, finely: Fit) -> Fit:
    """The fit with the finest substeps and their integration error: the difference from half as many substeps.

    The integration error of a law with a corner is proportional to the step, so halving the number doubles it.
    """
    if search.explains(finely):
        return finely
    fine, half = (
        finite_residual(search.rig, finely.effects, search.data.stepped(n))
        for n in (FINISH.substeps, FINISH.substeps // 2)
    )
    if fine is None or half is None:
        return finely
    return replace(finely, stepping=search.data.by_channel(fine - half).mean(axis=1))


def widened(search: Search, found: Fit) -> Fit:
    """The fit, or that of a more general set if its gain in likelihood is sure.

    The more general law may make another effect needless: friction with a constant force approximates friction that
    differs between the two directions. Such a set has no more parameters, so any sure gain suffices.
    """
    sets, kinds = list(more_general_sets(found.effects)), {effect.kind for effect in found.effects}
    if not sets:
        return found
    data = search.data.finely(SELECTION.substeps)
    cost = cost_of(search.rig, found.effects, data)

    def refitted(effects: Sequence[Effect]) -> Fit:
        return fit(search.rig, effects, data, iterations=FIT.iterations, workers=search.workers, chord=Chord())

    for effects in sets:
        trial = refitted(effects)
        extra = trial.n_parameters - found.n_parameters
        # refitting the other parameters lowers the cost of the original set too
        if search.distinguishes(trial.cost, cost, extra) and search.distinguishes(
            trial.cost, refitted(found.effects).cost, extra
        ):
            return trial
        one_less = [refitted(fewer) for fewer in each_left_out(trial.effects) if {e.kind for e in fewer} - kinds]
        best = min(one_less, key=lambda f: f.cost, default=found)
        if best.n_parameters <= found.n_parameters and search.surely_better(best, cost, 0):
            return best
    return found


def simplified(search: Search, candidate: Fit) -> Fit:
    """The set, or one with an effect replaced by its limiting case, if that has the lower cost.

    A fit of a hysteretic spring may converge where that of a linear one does not, to a spring that never yields.
    """
    cost = cost_of(search.rig, candidate.effects, search.quick)
    for effects in with_one_simpler(candidate.effects, search.rig):
        started = fit(search.rig, effects, search.quick, iterations=6)
        if promise(started) < cost:
            trial = finished(search, fit(search.rig, started.effects, search.data, iterations=10))
            if trial.cost < candidate.cost:
                return trial
    return candidate


def relocated(search: Search, candidate: Fit) -> Fit:
    """The best fit with an effect moved elsewhere: a symmetric structure has a local minimum at the mirrored place."""
    for i, effect in enumerate(candidate.effects):
        if effect.at is None or effect.kind.path not in ("structure", "environment"):
            continue
        here = fit(search.rig, candidate.effects, search.quick, iterations=6)
        for moved in _elsewhere(search, candidate.effects, i):
            started = fit(search.rig, moved, search.quick, iterations=6)
            if promise(started) > FINISH.max_place_cost * here.cost:
                continue
            trial = fit(search.rig, started.effects, search.data, iterations=10)
            if trial.cost < candidate.cost:
                candidate, here = trial, started
    return finished(search, candidate)


def _elsewhere(search: Search, effects: tuple[Effect, ...], i: int) -> list[tuple[Effect, ...]]:
    """The set with effect i at the two best other places, and at the mirrored places."""
    effect, domain = effects[i], search.rig.modes.domain

    def moved(where: Location, factor: float = 1.0) -> tuple[Effect, ...]:
        values = {**effect.values, **place_values(where)}
        if strength is not None:
            values[strength.name] = float(np.clip(factor * values[strength.name], strength.low, strength.high))
        return (*effects[:i], replace(effect, values=values), *effects[i + 1 :])

    strength = next((p for p in effect.parameters(search.rig) if p.logarithmic and p.name not in COORDINATES), None)
    # where the structure moves less, an effect must be stronger to do the same
    factors = FINISH.strength_factors if strength is not None else (1.0,)
    tried = []
    for where in other_places(effect, domain):
        strengths = [moved(where, factor) for factor in factors]
        start = min(strengths, key=lambda s: cost_of(search.rig, s, search.first))
        tried.append(fit(search.rig, start, search.first, iterations=FINISH.place_iterations))
    tried.sort(key=lambda f: f.cost)
    elsewhere = [f for f in tried if domain.separation(f.effects[i].at, effect.at) > SEARCH.same_distance]
    # a mirrored place may be the other minimum even if its cost is high before a fit
    return [*(f.effects for f in elsewhere[:2]), *map(moved, _mirrored(effect.at, domain))]


def other_places(effect: Effect, domain: Domain) -> Sequence[Location]:
    """Places to try instead: a grid of an interval or a rectangle, other named points, or pairs that share a point."""
    if isinstance(domain, Interval):
        return [float(x) for x in domain.length * np.linspace(0.04, 0.96, 13)]
    if isinstance(domain, Rectangle):
        return domain.grid(6)
    if isinstance(effect.at, Between):
        return [pair for pair in domain.pairs() if pair != effect.at and {*pair} & {*effect.at}]
    return [name for name in domain.grid() if name != effect.at]


def _mirrored(where: Any, domain: Domain) -> list[Location]:
    """The mirror images of a place; none for named points."""
    if isinstance(domain, Interval):
        return [domain.length - where]
    if isinstance(domain, Rectangle):
        (a, b), (x, y) = domain.length, where
        return [(a - x, y), (x, b - y), (a - x, b - y)]
    return []


def plainest(search: Search, fits: Sequence[Fit], *, worth: float = 0.0) -> list[Fit]:
    """The fits without those that are no better than another fit that is a limiting case of theirs.

    Args:
        worth: of the noise power: least decrease of the cost that a more general set must bring.
    """
    by_key = {candidate.key: candidate for candidate in fits}

    def is_redundant(candidate: Fit) -> bool:
        others = (by_key.get(key_of(simpler)) for simpler in simpler_sets(candidate.effects, search.rig))
        limits = (other for other in others if other is not None and other is not candidate)
        return any(not (_pays(search, candidate, f) and f.cost - candidate.cost > worth) for f in limits)

    return [candidate for candidate in fits if not is_redundant(candidate)]


def _pays(search: Search, candidate: Fit, simpler: Fit) -> bool:
    """Whether the gain of a set over a simpler one justifies its additional parameters, at least one."""
    return search.distinguishes(candidate.cost, simpler.cost, max(candidate.n_parameters - simpler.n_parameters, 1))


def simplest(search: Search, candidate: Fit) -> Fit:
    """The simplest set, by limiting cases or with effects left out, that explains the records as well."""
    cost = cost_of(search.rig, candidate.effects, search.quick)

    def as_good(effects: tuple[Effect, ...]) -> Fit | None:
        if (
            promise(fit(search.rig, effects, search.quick, iterations=FINISH.first_iterations))
            > FINISH.max_cost_ratio * cost
        ):
            return None
        trial = fit(search.rig, effects, search.data.finely(SELECTION.substeps), iterations=12, tolerance=1e-7)
        return trial if search.explains(trial) and not _pays(search, candidate, trial) else None

    simpler = next(filter(None, search.workers.map(as_good, _simpler_sets(search, candidate))), None)
    return candidate if simpler is None else simplest(search, simpler)


def _simpler_sets(search: Search, candidate: Fit) -> Iterator[tuple[Effect, ...]]:
    """The sets without one effect whose cost stays near the noise floor, and the limiting cases of the set."""
    for effect in candidate.effects if len(candidate.effects) > 1 else ():
        rest = tuple(other for other in candidate.effects if other is not effect)
        if cost_of(search.rig, rest, search.data) < 1.0 + FINISH.redundant_gain:
            yield rest
    yield from simpler_sets(candidate.effects, search.rig)


def ranked(search: Search, fits: Sequence[Fit]) -> tuple[Fit, Alternatives]:
    """The set of least description length, and the others with their probabilities.

    The likelihood of tens of thousands of values is over-confident about small misfits, so half its logarithm is used.
    """
    (best, _), *alternatives = _weighted(search, fits)
    return best, tuple(alternatives[:6])


def _weighted(search: Search, fits: Sequence[Fit]) -> list[tuple[Fit, float]]:
    """The best fit of every set with its probability, most probable first."""
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
    alternatives: Alternatives,
    reconstruction: ForceReconstruction,
    alike: Sequence[tuple[str, str, float]],
) -> Alternatives:
    """The alternatives of a set, with the equivalent sets that have an effect at another actuator or sensor.

    With one actuator and one sensor, errors of the one and of the other have the same effect. One-step-ahead
    predictions depend on the sensor noise too, so they prefer one of them.

    Args:
        alternatives: with their probabilities.
        reconstruction: of the nominal rig, for start values.
        alike: labels of two effects that the records cannot distinguish, and their correlation.
    """
    data = search.data.finely(SELECTION.substeps)
    known = {best.key, *(f.key for f, _ in alternatives)}
    sets = [s for s in _at_other_transducers(search, best, reconstruction, alike) if key_of(s) not in known]
    if not sets:
        return alternatives
    here, *each = search.workers.map(lambda s: fit(search.rig, s, data), [best.effects, *sets])
    equals = [f for f in each if f.cost < here.cost + SEARCH.alternative_margin]
    if not equals:
        return alternatives
    weighted = _weighted(search, [here, *equals])
    # if no set reaches the noise floor, their residuals have no known likelihood: equal probabilities
    if not search.explains(weighted[0][0]):
        weighted = [(f, 1.0 / len(weighted)) for f, _ in weighted]
    own = next(p for f, p in weighted if f is here)
    beside = [(f, p) for f, p in weighted if f is not here]
    return tuple(sorted([*beside, *((f, p * own) for f, p in alternatives)], key=lambda each: -each[1]))


def _at_other_transducers(
    search: Search, best: Fit, reconstruction: ForceReconstruction, alike: Sequence[tuple[str, str, float]]
) -> Iterator[tuple[Effect, ...]]:
    """The sets with one effect replaced by an indistinguishable one at another actuator or sensor."""
    at_transducers = [kind for kind in search.catalogue if kind.path in TRANSDUCERS]
    labels = {
        Effect(kind, target, {}).label: (kind, target) for kind in at_transducers for target in kind.targets(search.rig)
    }
    for effect in best.effects:
        if effect.label in labels:
            same = dict.fromkeys(label for *pair, _ in alike if effect.label in pair for label in pair)
            for kind, target in (labels[label] for label in same if label in labels and label != effect.label):
                for values in list(kind.starts(reconstruction, target))[:1]:
                    other = Effect(kind, target, dict(values))
                    yield tuple(other if e is effect else e for e in best.effects)
