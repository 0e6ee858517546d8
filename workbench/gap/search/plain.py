"""Few effects that say the same as many small errors of the nominal model."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from workbench.gap.effects.effect import Effect, Kind, apply_all, contained, each_left_out, simpler_sets
from workbench.gap.effects.nominal import NOMINAL_ERRORS, NominalPrior, group_of, nominal_errors
from workbench.gap.effects.ports import ACTUATOR_DELAY, ACTUATOR_LAG, SENSOR_DELAY, SENSOR_LAG
from workbench.gap.effects.structural import MODAL_DAMPING, MODULUS_ERROR
from workbench.gap.prediction.residuals import FitData
from workbench.gap.search.finish import finished, ranked
from workbench.gap.search.fit import Fit, cost_of, fit
from workbench.gap.search.intervals import with_intervals
from workbench.gap.search.jointly import Step, on_their_sides, surely_late
from workbench.gap.search.screening import Screening, on_whole_records, one_more
from workbench.gap.search.search import Search, promise
from workbench.gap.search.settings import JOINT, PAIRS, PLAIN, SEARCH, SELECTION, STEPWISE
from workbench.rig.rig import Rig
from workbench.structure.domain import middle
from workbench.structure.member import Structure

COMMON = (MODULUS_ERROR, MODAL_DAMPING)  # errors of all along, or of all modes: the nominal errors hold them too
NO_COMMON = tuple(Effect(kind, None, {"factor": 1.0}) for kind in COMMON)  # of no size, to be fitted from there
OF_PORTS = ("delay", "gain", "place")  # groups of errors that are no mode's and no wave's
OF_ALL = (SENSOR_LAG, ACTUATOR_LAG, ACTUATOR_DELAY)  # what makes all sensors late by as much


def are_common(effects: Sequence[Effect]) -> bool:
    """Whether effects are the errors common to all modes and all along, each no larger than errors may be."""
    return {effect.kind for effect in effects} == set(COMMON) and all(
        abs(np.log(effect.values["factor"])) < dict(PLAIN.most_common)[effect.kind.name] for effect in effects
    )


def is_like_errors(kind: Kind) -> bool:
    """Whether effects of a kind are in the structure and linear, as errors of all its modes and waves are."""
    return kind.path == "structure" and not kind.nonlinear and kind not in COMMON


def may_be_error(effect: Effect, search: Search) -> bool:
    """Whether a careful model may be off by as much as an effect at a port says: in timing, a gain or a place."""
    return is_hardly_late(effect, search) or is_slight(effect, search.rig)


def is_hardly_late(effect: Effect, search: Search) -> bool:
    """Whether an effect makes ports late by less than is believed of a careful laboratory."""
    return lateness(effect) < dict(JOINT.widest)["delay"] * search.data.records[0].sample_time


def lateness(effect: Effect) -> float:
    """Time that an effect makes ports late by, s; inf where it makes none late."""
    return float(next((effect.values[name] for name in ("delay", "time_constant") if name in effect.values), np.inf))


def is_slight(effect: Effect, rig: Rig) -> bool:
    """Whether an effect is a gain or a place that any calibration and any tape measure may be off by."""
    if "gain" in effect.values:
        return bool(abs(np.log(abs(effect.values["gain"]))) < PLAIN.most_gain)
    standing = [a.at for a in rig.actuators if a.name == effect.target]
    standing += [s.at for s in rig.sensors if s.name == effect.target]
    if effect.at is None or not standing:
        return False
    return rig.modes.domain.separation(effect.at, middle(standing[0])) < PLAIN.most_moved


def common_as_errors(search: Search, found: Fit, *, alone: bool = False) -> Fit:
    """The fit with both common errors, small and beside an effect, as errors of the nominal model.

    A model that is a little off is so in both; one of them alone is an effect.

    Args:
        alone: whether one alone counts too, where a random force hides the other.
    """
    common = {e.kind.name: float(np.log(e.values["factor"])) for e in found.effects if e.kind in COMMON}
    others = [e for e in found.effects if e.kind not in COMMON]
    late = next((e for e in others if e.kind is NOMINAL_ERRORS), None)
    named = [e for e in others if e is not late]
    most = dict(PLAIN.most_alone if len(common) == 1 else PLAIN.most_common)
    if (
        len(common) < (1 if alone else len(COMMON))
        or not named
        or any(abs(size) >= most[name] for name, size in common.items())
    ):
        return found
    if late is not None and not set(late.target.groups) <= set(OF_PORTS):
        return found
    stiffness, damping = (common.get(kind.name, 0.0) for kind in COMMON)
    if isinstance(search.rig.structure, Structure):
        sizes = {"stiffness": stiffness, "damping": damping}
    else:  # no profile is known: each frequency is off by as much
        sizes = {"frequency": 0.5 * stiffness, "damping": damping}
    prior = NominalPrior(sample_time=search.data.records[0].sample_time) if late is None else late.target
    errors = nominal_errors(search.rig, replace(prior, **{name: abs(size) for name, size in sizes.items()}, waves=1))
    values = {name: sizes.get(group_of(name), 0.0) for name in errors.values}
    values.update({} if late is None else late.values)
    return replace(found, effects=(*named, replace(errors, values=values)), covariance=None)


def in_place_of_errors(search: Search, step: Step, rivals: Sequence[tuple[Effect, ...]] = ()) -> Fit | None:
    """The effects, or one more, that leave only noise with no errors of the nominal model but common ones and at ports.

    They say the same with fewer numbers than errors of their own for every mode and wave, and no worse: where the
    records surely prefer errors that a careful model has, these stay.

    Args:
        search: with the noise found beside the errors.
        step: effects and the errors beside which they were found; sensors stay as late as these make them, and read and
            stand as they do where the others do not do without.
        rivals: other sets that explain the records beside errors, which make up for the wrong place or law.
    """
    if step.errors.target.record:  # no effect differs from record to record
        return None
    each = (_in_place(search, step, rivals, kept) for kept in _at_ports(step.errors))
    return next((found for found in each if found is not None), None)


def _in_place(search: Search, step: Step, rivals: Sequence[tuple[Effect, ...]], kept: tuple[Effect, ...]) -> Fit | None:
    """The same beside those errors at the ports."""
    effects = step.effects
    named = {effect.kind for effect in effects}
    common = tuple(effect for effect in NO_COMMON if effect.kind not in named)
    at_ports = [ports for ports in _for_one_cause(search.rig, kept) if named.isdisjoint(e.kind for e in ports)]
    if not effects:
        both = _explaining(search, [(*common, *ports) for ports in at_ports], step)
        if both is not None and {SENSOR_DELAY, *OF_ALL} & {effect.kind for effect in both.effects}:
            return both  # one sensor late alone, or all alike, are an effect beside common errors
        # beside noise of the inputs that an effect made seem louder, common errors may explain what they do not cause
        more = _one_more(search, (*common, *kept), (), step) if both is None or search.logged else None
        return _one_common(search, common, kept, both, step) if more is None and both is not None else more
    sets = [(*given, *some) for given in (effects, *rivals) for some in _some_of(common)]
    if len(effects) > 1:  # what stood in for errors, or bent to them, may be needless or simpler without
        fewer = list(each_left_out(effects))
        sets += [*fewer, *(s for given in (effects, *fewer) for s in simpler_sets(given, search.rig))]
    found = _explaining(search, [(*s, *ports) for s in sets for ports in at_ports], step)
    return found or _one_more(search, (*effects, *kept), common, step)


def _one_common(
    search: Search, common: tuple[Effect, ...], kept: tuple[Effect, ...], both: Fit, step: Step
) -> Fit | None:
    """One error common to all as the one effect, where the records do without the other; None where they show both.

    A model that is a little off is so in both.
    """
    most = both.cost + PLAIN.needless / search.data.n_values
    alone = [found for one in common if (found := _explaining(search, [(one, *kept)], step)) and found.cost < most]
    return min(alone, key=lambda f: f.cost, default=None)


def _at_ports(errors: Effect) -> Iterator[tuple[Effect, ...]]:
    """What the errors say of the timing of the sensors, then of gains and places too, where they say anything of it."""
    prior = errors.target
    sides = {"late": prior.late, "early": prior.early, "interpolated": prior.interpolated}
    timing = NominalPrior(sample_time=prior.sample_time, waves=prior.waves, **sides)
    if prior.delay > PLAIN.punctual or prior.late:
        timing = replace(timing, delay=prior.delay)
    for kept in dict.fromkeys((timing, replace(timing, gain=prior.gain, place=prior.place))):
        values = {name: value for name, value in errors.values.items() if group_of(name) in kept.groups}
        yield (replace(errors, target=kept, values=values),) if values else ()


def _for_one_cause(rig: Rig, kept: tuple[Effect, ...]) -> Iterator[tuple[Effect, ...]]:
    """Errors at the ports, and each effect that all their delays may be of; of one, see `_with_late`."""
    yield kept
    if len(kept) == 1 and kept[0].target.groups == ("delay",):
        yield from ((effect,) for effect in late_effects(rig, kept[0]) if effect.kind in OF_ALL)


def _explaining(search: Search, sets: Sequence[tuple[Effect, ...]], step: Step) -> Fit | None:
    """The simplest of sets that leaves only noise, or another that is surely likelier and no more of the same.

    None that the records surely prefer the errors of the step to.
    """

    def briefly(effects: Sequence[Effect]) -> Fit:
        found = fit(search.rig, effects, search.quick, iterations=PLAIN.briefly)
        more = PLAIN.plainly - PLAIN.briefly
        if not found.falling or promise(found, more) > PLAIN.near:
            return found
        return fit(search.rig, found.effects, search.quick, iterations=more)

    quickly = search.workers.map(briefly, list(sets))
    near = [f for f in quickly if f.cost < PLAIN.near and not _is_worse(search, f, step, search.quick)]
    whole, best = search.data.finely(SELECTION.fine), None
    for candidate in sorted(near, key=lambda f: f.n_parameters):
        if best is not None and _labels(best) <= _labels(candidate):
            continue
        effects = _on_their_sides(search, candidate.effects)
        found = fit(search.rig, effects, whole, iterations=PLAIN.plainly)
        more = 0 if best is None else found.n_parameters - best.n_parameters
        explains = search.explains(found) and not _is_worse(search, found, step, whole)
        if explains and (best is None or search.surely_better(found, best.cost, more)):
            best = found
    return None if best is None else _with_late(search, finished(search, best))


def _is_worse(search: Search, found: Fit, step: Step, data: FitData) -> bool:
    """Whether records surely prefer errors that a careful model has to a fit without them."""
    if not step.is_plausible:
        return False
    gain = float(np.log(found.cost / cost_of(search.rig, step.fit.effects, data)))
    extra = max(step.fit.n_parameters - found.n_parameters, 0)
    return search.pays(gain, extra, data.n_values)


def _labels(found: Fit) -> set[str]:
    """Of the effects of a fit."""
    return {effect.label for effect in found.effects}


def _on_their_sides(search: Search, effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """The effects with accelerometers on the side of the jumps that the records show beside these effects."""
    others = tuple(effect for effect in effects if effect.kind is not NOMINAL_ERRORS)
    late = (on_their_sides(search, surely_late(e), others) for e in effects if e.kind is NOMINAL_ERRORS)
    return (*others, *late)


def _with_late(search: Search, found: Fit) -> Fit:
    """The fit with a delay as the effect that it is where one of several sensors is late alone, or all are alike."""
    late = next((e for e in found.effects if e.kind is NOMINAL_ERRORS), None)
    if late is None or late.target.groups != ("delay",):
        return found
    others, whole = [e for e in found.effects if e is not late], search.data.finely(SELECTION.fine)
    each = search.workers.map(lambda e: fit(search.rig, (*others, e), whole), late_effects(search.rig, late))
    return min((f for f in each if search.explains(f)), key=lambda f: f.cost, default=found)


def other_causes(search: Search, found: Fit) -> tuple[tuple[Fit, float], ...]:
    """What else may make all sensors as late as a set says, with probabilities, where that explains the records too."""
    late = next((e for e in found.effects if e.kind in OF_ALL and e.target == e.kind.targets(search.rig)[0]), None)
    if late is None:
        return ()
    others, whole = [e for e in found.effects if e is not late], search.data.finely(SELECTION.fine)
    causes = [e for e in _common(search.rig, lateness(late)) if e.kind is not late.kind]
    each = search.workers.map(lambda e: fit(search.rig, (*others, e), whole), causes)
    best, rivals = ranked(search, [found, *(f for f in each if search.explains(f))])
    return rivals if best is found else ()


def _common(rig: Rig, late: float) -> tuple[Effect, ...]:
    """Every effect that makes all sensors late by that time, s."""
    kinds = ((kind, targets[0]) for kind in OF_ALL if (targets := kind.targets(rig)))
    return tuple(Effect(kind, all_, {kind.parameters(rig, all_)[0].name: late}) for kind, all_ in kinds)


def late_effects(rig: Rig, errors: Effect) -> tuple[Effect, ...]:
    """What sensors that errors of the nominal model say to be late are instead, each by itself; empty for errors.

    One of several that is late alone is so by a delay of its own. All that are as late as one another, which is hardly
    so by chance, are behind one lag, their own or that of the actuators, or a delay of these.
    """
    delays = {name.removeprefix("delay_"): float(v) for name, v in errors.values.items() if group_of(name) == "delay"}
    doubt = {name: PLAIN.sure * errors.deviations.get(f"delay_{name}", 0.0) for name in delays}
    off = [name for name, delay in delays.items() if abs(delay) > max(PLAIN.punctual, doubt[name])]
    sample_time = errors.target.sample_time
    if len(delays) >= PLAIN.several and len(off) == 1 and delays[off[0]] > 0:
        return (Effect(SENSOR_DELAY, off[0], {"delay": delays[off[0]] * sample_time}),)
    if len(delays) < 2 or len(off) < len(delays) or min(delays.values()) < 0:
        return ()
    common = float(np.mean([*delays.values()]))
    apart = max(max(abs(delay - common), doubt[name]) for name, delay in delays.items())
    if (2.0 * apart / common) ** (len(delays) - 1) > PLAIN.by_chance:  # of sensors that are about as late as these
        return ()
    return _common(rig, common * sample_time)


def few_one_by_one(search: Search, step: Step, most: int) -> Fit | None:
    """At most so many effects, each found beside those before and both common errors, that leave only noise.

    None where one leaves more than half of what was there, on whole records and one sample ahead, or is what a careful
    model may be off by at a port. Errors of their own for every mode and wave stand in for strong effects that are
    still missing, and cost more to ask beside.

    Args:
        search: what they are sought in.
        step: errors of the nominal model that leave more, or that no model has.
        most: effects.
    """
    best = fit(search.rig, NO_COMMON, search.data)
    for _ in range(most):
        if search.is_over:
            return None
        ahead = one_more(search, best.effects, search.evidence_of(apply_all(search.rig, best.effects)))
        fits = on_whole_records(search, ahead, PAIRS.more)
        nearer = bool(fits) and fits[0].cost - 1.0 < PAIRS.nearer * (best.cost - 1.0)
        if not (nearer or (fits and ahead[0].cost < PAIRS.nearer * cost_of(search.rig, best.effects, search.ahead))):
            return None
        comes_to, enough = contained(fits[0].effects, search.rig), (1.0 + SEARCH.significant) * fits[0].cost
        best = next((f for f in fits if f.key in comes_to and f.cost < enough), fits[0])
        named = [effect for effect in best.effects if effect.kind not in COMMON]
        if any(may_be_error(effect, search) for effect in named):
            return None
        if best.cost < PLAIN.near and search.explains(finished(search, best)):
            sets = [(*s, *some) for s in (named, *each_left_out(named)) for some in _some_of(NO_COMMON)]
            found = _explaining(search, [s for s in sets if s], step)
            return None if found is None else with_intervals(search.rig, found, search.data, search.workers)
    return None


def _some_of(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """Every subset, the empty one first."""
    for n in range(len(effects) + 1):
        yield from combinations(effects, n)


def _one_more(search: Search, effects: tuple[Effect, ...], common: tuple[Effect, ...], step: Step) -> Fit | None:
    """The effects and another in the structure, linear as errors are, that stands for those of every mode and wave."""
    alike = tuple(kind for kind in search.catalogue if is_like_errors(kind))
    if not alike:
        return None
    alone = fit(search.rig, effects, search.quick, iterations=PLAIN.plainly)
    # too little for another effect; beside noise of the inputs, what is loud where that noise is counts for little
    if not search.logged and alone.cost < 1.0 + STEPWISE.no_gap:
        return None
    given = alone.effects
    evidence = search.evidence_of(apply_all(search.rig, given))
    screened = Screening.of(replace(search, catalogue=alike), given, evidence).likeliest()
    likeliest = {effect.kind: effect for effect in reversed(screened)}  # the best of each kind
    more = [(*given, effect) for effect in screened if effect is likeliest[effect.kind]][: PLAIN.likeliest]
    found = _explaining(search, [set_ for one in more for set_ in dict.fromkeys((one, (*one, *common)))], step)
    if found is None:
        return None
    rest = [e for e in found.effects if e.kind in COMMON or any(e.label == other.label for other in given)]
    without = fit(search.rig, rest, search.data.finely(SELECTION.fine), iterations=PLAIN.plainly)
    extra = found.n_parameters - without.n_parameters
    worth = without.cost - found.cost > SEARCH.significant and search.surely_better(found, without.cost, extra)
    return found if worth else None
