"""Few effects in place of many nominal errors that fit the records equally well."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from workbench.gap.effects.effect import Effect, contained, each_left_out, simpler_sets
from workbench.gap.effects.nominal import NOMINAL_ERRORS, NominalPrior, in_group
from workbench.gap.effects.transducers import SENSOR_DELAY
from workbench.gap.prediction.residuals import FitData
from workbench.gap.search.errors_as_effects import (
    DELAYS_OF_ALL,
    NO_UNIFORM_ERROR,
    UNIFORM,
    common_delays,
    delay_effects,
    delay_of,
    is_linear_structural,
    is_plausible_error,
)
from workbench.gap.search.finish import finished, other_places, ranked
from workbench.gap.search.fit import Fit, cost_of, fit
from workbench.gap.search.intervals import with_intervals
from workbench.gap.search.jointly import JointFit, surely_late, with_reading_sides
from workbench.gap.search.screening import Screening, on_whole_records, one_more
from workbench.gap.search.search import Alternatives, Search, first_of_each, promise
from workbench.gap.search.settings import ERRORS, FIT, PLAIN, SEARCH, SELECTION, STEPWISE
from workbench.rig.rig import Rig


def in_place_of_nominal_errors(
    search: Search, step: JointFit, alternatives: Sequence[tuple[Effect, ...]] = ()
) -> Fit | None:
    """A set of few effects that explains the records with no nominal errors but uniform ones and those of transducers.

    Such a set needs fewer parameters than nominal errors of every mode or wave. None if there is none, or if the
    records surely prefer plausible nominal errors.

    Args:
        search: with the noise estimated jointly with the nominal errors.
        step: effects and nominal errors fitted jointly; the delays of sensors are kept, and the gains and places of
            transducers where nothing explains the records without.
        alternatives: other sets that explain the records with nominal errors, which can hide a wrong place or law.
    """
    if step.errors.target.record:  # no effect varies from record to record
        return None
    candidates = (_with_transducer_errors(search, step, alternatives, kept) for kept in _at_transducers(step.errors))
    return next((found for found in candidates if found is not None), None)


def _with_transducer_errors(
    search: Search, step: JointFit, alternatives: Sequence[tuple[Effect, ...]], kept: tuple[Effect, ...]
) -> Fit | None:
    """The same as `in_place_of_nominal_errors`, given the errors of transducers (`kept`) that stay."""
    effects = step.effects
    named = {effect.kind for effect in effects}
    common = tuple(effect for effect in NO_UNIFORM_ERROR if effect.kind not in named)
    at_transducers = [
        transducers
        for transducers in _with_common_causes(search.rig, kept)
        if named.isdisjoint(e.kind for e in transducers)
    ]
    if not effects:
        both = _simplest_explaining(search, [(*common, *transducers) for transducers in at_transducers], step)
        if both is not None and {SENSOR_DELAY, *DELAYS_OF_ALL} & {effect.kind for effect in both.effects}:
            return both  # a delay of one sensor, or of all, is an effect even with uniform errors
        # with input noise that an effect made seem louder, uniform errors may explain too much
        if both is None or search.logged:
            found = _with_one_linear_effect(search, (*common, *kept), (), step)
            if found is not None or both is None:
                return found
        return _one_uniform_error(search, common, kept, both, step)
    sets = [(*given, *some) for given in (effects, *alternatives) for some in _subsets(common)]
    if len(effects) > 1:  # without nominal errors, an effect may be unnecessary or a limiting case suffice
        fewer = list(each_left_out(effects))
        sets += [*fewer, *(s for given in (effects, *fewer) for s in simpler_sets(given, search.rig))]
    found = _simplest_explaining(search, [(*s, *transducers) for s in sets for transducers in at_transducers], step)
    return found or _with_one_linear_effect(search, (*effects, *kept), common, step)


def _one_uniform_error(
    search: Search, common: tuple[Effect, ...], kept: tuple[Effect, ...], both: Fit, step: JointFit
) -> Fit | None:
    """One uniform error as the only effect, if the records do not show the other; else None.

    An imperfect model has both, so they are no effect.
    """
    most = both.cost + PLAIN.likelihood_ratio / search.data.n_values
    alone = [
        found for one in common if (found := _simplest_explaining(search, [(one, *kept)], step)) and found.cost < most
    ]
    return min(alone, key=lambda f: f.cost, default=None)


def _at_transducers(errors: Effect) -> Iterator[tuple[Effect, ...]]:
    """The nominal errors restricted to sensor delays, then to delays, gains and places; empty if there are none."""
    prior = errors.target
    sides = {"late": prior.late, "early": prior.early, "interpolated": prior.interpolated}
    timing = NominalPrior(sample_time=prior.sample_time, waves=prior.waves, **sides)
    if prior.delay > ERRORS.min_delay or prior.late:
        timing = replace(timing, delay=prior.delay)
    for kept in dict.fromkeys((timing, replace(timing, gain=prior.gain, place=prior.place))):
        values = in_group(errors.values, *kept.groups)
        yield (replace(errors, target=kept, values=values),) if values else ()


def _with_common_causes(rig: Rig, kept: tuple[Effect, ...]) -> Iterator[tuple[Effect, ...]]:
    """The errors of transducers, then each single effect that may be the common cause of all their delays."""
    yield kept
    if len(kept) == 1 and kept[0].target.groups == ("delay",):
        yield from ((effect,) for effect in delay_effects(rig, kept[0]) if effect.kind in DELAYS_OF_ALL)


def _simplest_explaining(search: Search, sets: Sequence[tuple[Effect, ...]], step: JointFit) -> Fit | None:
    """The simplest set that explains the records, or a larger one that is surely likelier; else None.

    A set is rejected if the records surely prefer the nominal errors of the step, or if it contains the best so far.
    """

    def briefly(effects: Sequence[Effect]) -> Fit:
        found = fit(search.rig, effects, search.quick, iterations=PLAIN.first_iterations)
        extra = FIT.iterations - PLAIN.first_iterations
        if not found.falling or promise(found, extra) > SEARCH.near_noise:
            return found
        return fit(search.rig, found.effects, search.quick, iterations=extra)

    on_quick = search.workers.map(briefly, list(sets))
    promising = [
        f for f in on_quick if f.cost < SEARCH.near_noise and not _is_surely_worse(search, f, step, search.quick)
    ]
    fine_data, best = search.data.finely(SELECTION.substeps), None
    for candidate in sorted(promising, key=lambda f: f.n_parameters):
        if best is not None and set(best.labels) <= set(candidate.labels):
            continue
        effects = _with_reading_sides(search, candidate.effects)
        found = fit(search.rig, effects, fine_data, iterations=FIT.iterations)
        extra = 0 if best is None else found.n_parameters - best.n_parameters
        explains = search.explains(found) and not _is_surely_worse(search, found, step, fine_data)
        if explains and (best is None or search.surely_better(found, best.cost, extra)):
            best = found
    return None if best is None else _with_delay_as_effect(search, finished(search, best))


def _is_surely_worse(search: Search, found: Fit, step: JointFit, data: FitData) -> bool:
    """Whether the records surely prefer a step with plausible nominal errors to a fit without them."""
    if not step.is_plausible:
        return False
    gain = float(np.log(found.cost / cost_of(search.rig, step.fit.effects, data)))
    extra = max(step.fit.n_parameters - found.n_parameters, 0)
    return search.is_justified(gain, extra, data.n_values)


def _with_reading_sides(search: Search, effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """The effects, nominal errors among them, with accelerometers assigned anew to a side of the input steps."""
    others = tuple(effect for effect in effects if effect.kind is not NOMINAL_ERRORS)
    late = (with_reading_sides(search, surely_late(e), others) for e in effects if e.kind is NOMINAL_ERRORS)
    return (*others, *late)


def _with_delay_as_effect(search: Search, found: Fit) -> Fit:
    """The fit with the delay of one sensor, or an equal delay of all, as an effect instead of nominal errors."""
    delays = next((e for e in found.effects if e.kind is NOMINAL_ERRORS), None)
    if delays is None or delays.target.groups != ("delay",):
        return found
    explaining = _explaining_instead(search, found, delays, delay_effects(search.rig, delays))
    return min(explaining, key=lambda f: f.cost, default=found)


def other_delay_causes(search: Search, found: Fit) -> Alternatives:
    """Other common causes of the delay of all sensors that explain the records as well, with their probabilities."""
    late = next(
        (e for e in found.effects if e.kind in DELAYS_OF_ALL and e.target == e.kind.targets(search.rig)[0]), None
    )
    if late is None:
        return ()
    causes = [e for e in common_delays(search.rig, delay_of(late)) if e.kind is not late.kind]
    best, alternatives = ranked(search, [found, *_explaining_instead(search, found, late, causes)])
    return alternatives if best is found else ()


def _explaining_instead(search: Search, found: Fit, effect: Effect, causes: Sequence[Effect]) -> list[Fit]:
    """The fits, with an effect replaced by each of some causes, that explain the records."""
    others, fine_data = [e for e in found.effects if e is not effect], search.data.finely(SELECTION.substeps)
    fits = search.workers.map(lambda cause: fit(search.rig, (*others, cause), fine_data), causes)
    return [f for f in fits if search.explains(f)]


def few_with_uniform_errors(search: Search, step: JointFit, most: int) -> Fit | None:
    """At most `most` effects that explain the records, added one by one to uniform stiffness and damping errors.

    None if an effect does not halve the residual, on whole records or one step ahead, or is a plausible error of a
    transducer. Nominal errors of every mode or wave would absorb strong effects still missing, and cost more time.

    Args:
        step: nominal errors that do not explain the records, or are implausible.
    """
    best = fit(search.rig, NO_UNIFORM_ERROR, search.data)
    for _ in range(most):
        if search.is_over:
            return None
        ahead = one_more(search, best.effects, search.reconstruction_with(best.effects))
        fits = on_whole_records(search, ahead, SEARCH.few_finalists)
        if not fits:
            return None
        is_better = fits[0].cost - 1.0 < SEARCH.halved * (best.cost - 1.0)
        if not (is_better or ahead[0].cost < SEARCH.halved * cost_of(search.rig, best.effects, search.ahead)):
            return None
        limiting_cases, cost_limit = (
            contained(fits[0].effects, search.rig),
            (1.0 + SEARCH.significant_gain) * fits[0].cost,
        )
        best = next((f for f in fits if f.key in limiting_cases and f.cost < cost_limit), fits[0])
        named = [effect for effect in best.effects if effect.kind not in UNIFORM]
        if any(is_plausible_error(effect, search) for effect in named):
            return None
        if best.cost < SEARCH.near_noise and search.explains(finished(search, best)):
            fewer = (named, *each_left_out(named), *simpler_sets(named, search.rig))
            sets = [(*s, *some) for s in fewer for some in _subsets(NO_UNIFORM_ERROR)]
            found = _simplest_explaining(search, [s for s in sets if s], step)
            return None if found is None else with_intervals(search.rig, found, search.data, search.workers)
    return None


def _subsets(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """Every subset, the empty one first."""
    for n in range(len(effects) + 1):
        yield from combinations(effects, n)


def _with_one_linear_effect(
    search: Search, effects: tuple[Effect, ...], common: tuple[Effect, ...], step: JointFit
) -> Fit | None:
    """The effects and one linear structural effect in place of the nominal errors of every mode or wave, or None."""
    linear_kinds = tuple(kind for kind in search.catalogue if is_linear_structural(kind))
    if not linear_kinds:
        return None
    start = fit(search.rig, effects, search.quick, iterations=FIT.iterations)
    # the residual is too small for another effect; with input noise it is weighted down, so its size does not decide
    if not search.logged and start.cost < 1.0 + STEPWISE.noise_excess:
        return None
    given = start.effects
    screened = Screening.of(
        replace(search, catalogue=linear_kinds), given, search.reconstruction_with(given)
    ).likeliest()
    likeliest = first_of_each(screened, lambda effect: effect.kind)[: SEARCH.finalists]
    beside = tuple(dict.fromkeys(((), common)))
    sets = [(*given, effect, *some) for effect in likeliest for some in beside]
    found = _simplest_explaining(search, sets, step)
    if found is None:  # what is given may have absorbed part of the effect, which then seems to act elsewhere
        places = _elsewhere(search, [(*given, effect) for effect in likeliest], start)
        found = _simplest_explaining(search, [(*given, effect, *some) for effect in places for some in beside], step)
    if found is None:
        return None
    others = [e for e in found.effects if e.kind in UNIFORM or any(e.label == other.label for other in given)]
    without = fit(search.rig, others, search.data.finely(SELECTION.substeps), iterations=FIT.iterations)
    extra = found.n_parameters - without.n_parameters
    is_justified = without.cost - found.cost > SEARCH.significant_gain and search.surely_better(
        found, without.cost, extra
    )
    return found if is_justified else None


def _elsewhere(search: Search, sets: Sequence[tuple[Effect, ...]], start: Fit) -> list[Effect]:
    """The last effect of the best set at other places; none unless it leaves little of what the start does."""
    fits = search.workers.map(lambda s: fit(search.rig, s, search.quick, iterations=FIT.iterations), sets)
    best = min(fits, key=lambda f: f.cost, default=start)
    if best is start or best.cost - 1.0 > SEARCH.halved * (start.cost - 1.0):
        return []
    effect = best.effects[-1]
    if effect.at is None:
        return []
    return [effect.moved_to(where) for where in other_places(effect, search.rig.modes.domain)]
