"""The boundary between errors of a careful model and effects: effects that are as small, errors that are too large."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from workbench.gap.effects.effect import Effect, Kind, place_values
from workbench.gap.effects.nominal import NOMINAL_ERRORS, NominalPrior, group_of, in_group, nominal_errors
from workbench.gap.effects.structural import MODAL_DAMPING, MODULUS_ERROR
from workbench.gap.effects.transducers import (
    ACTUATOR_DELAY,
    ACTUATOR_GAIN,
    ACTUATOR_LAG,
    ACTUATOR_MISPLACEMENT,
    SENSOR_DELAY,
    SENSOR_GAIN,
    SENSOR_LAG,
    SENSOR_MISPLACEMENT,
)
from workbench.gap.search.fit import Fit, cost_of
from workbench.gap.search.jointly import (
    TIMING,
    JointFit,
    evaluated,
    fit_from_zero,
    fit_jointly,
    is_likelier,
    size_of,
    with_all_groups,
)
from workbench.gap.search.search import Search
from workbench.gap.search.settings import ERRORS, JOINT, SEARCH
from workbench.rig.rig import Rig
from workbench.structure.domain import middle
from workbench.structure.member import Structure

UNIFORM = (MODULUS_ERROR, MODAL_DAMPING)  # one factor of all stiffness or all damping, which nominal errors include
NO_UNIFORM_ERROR = tuple(Effect(kind, None, {"factor": 1.0}) for kind in UNIFORM)  # start values
TRANSDUCER_GROUPS = ("delay", "gain", "place")  # groups of nominal errors of actuators and sensors
DELAYS_OF_ALL = (SENSOR_LAG, ACTUATOR_LAG, ACTUATOR_DELAY)  # kinds that delay all sensors equally


def are_uniform_errors(effects: Sequence[Effect]) -> bool:
    """Whether the effects are just the two uniform errors (stiffness, damping), each small enough for a model's."""
    return {effect.kind for effect in effects} == set(UNIFORM) and all(
        abs(np.log(effect.values["factor"])) < dict(ERRORS.max_uniform)[effect.kind.name] for effect in effects
    )


def is_linear_structural(kind: Kind) -> bool:
    """Whether a kind is linear and acts in the structure, but is no uniform error: nominal errors can mimic it."""
    return kind.path == "structure" and not kind.nonlinear and kind not in UNIFORM


def is_plausible_error(effect: Effect, search: Search) -> bool:
    """Whether an effect at a transducer is a plausible error of a careful model: a small delay, gain or shift."""
    return is_plausible_delay(effect, search) or is_plausible_gain_or_place(effect, search.rig)


def may_be_small_error(effect: Effect, errors: Effect, search: Search) -> bool:
    """Whether a fitted effect may be one of the small errors beside it: its interval reaches those of a careful model.

    Args:
        effect: with standard errors.
        errors: nominal errors, fitted jointly. A delay is no effect unless it is longer than those among them.
        search: of both.
    """
    numbers = {p.name: p.neutral for p in effect.parameters(search.rig) if p.neutral is not None}
    reach = {name: ERRORS.interval_width * effect.std.get(name, 0.0) for name in numbers}
    nearer = {
        name: float(np.clip(neutral, effect.values[name] - reach[name], effect.values[name] + reach[name]))
        for name, neutral in numbers.items()
    }
    smallest = replace(effect, values={**effect.values, **nearer})
    if effect.kind in UNIFORM:
        return bool(abs(np.log(smallest.values["factor"])) < dict(ERRORS.max_uniform_alone)[effect.kind.name])
    if is_linear_structural(effect.kind):
        return any(nearer[name] == neutral for name, neutral in numbers.items())
    if smallest.values.get("gain", 1.0) <= 0.0:  # wired the wrong way round
        return False
    is_late = effect.kind is SENSOR_DELAY and is_plausible_delay(smallest, search, errors)
    return is_late or is_plausible_error(smallest, search)


def is_plausible_delay(effect: Effect, search: Search, errors: Effect | None = None) -> bool:
    """Whether an effect is a delay that a careful laboratory may have, or no outlier among delays (`errors`)."""
    among_others = 0.0 if errors is None else ERRORS.outlier_ratio * size_of(errors, "delay")
    return delay_of(effect) < max(dict(JOINT.max_prior_std)["delay"], among_others) * search.data.records[0].sample_time


def delay_of(effect: Effect) -> float:
    """Delay or time constant of an effect, s; inf for an effect that has none."""
    return float(next((effect.values[name] for name in ("delay", "time_constant") if name in effect.values), np.inf))


def is_plausible_gain_or_place(effect: Effect, rig: Rig) -> bool:
    """Whether an effect is a gain error or a shift of place within the accuracy of calibration and tape measure."""
    if "gain" in effect.values:
        return bool(abs(np.log(abs(effect.values["gain"]))) < ERRORS.max_gain)
    places = [a.at for a in rig.actuators if a.name == effect.target]
    places += [s.at for s in rig.sensors if s.name == effect.target]
    if effect.at is None or not places:
        return False
    return rig.modes.domain.separation(effect.at, middle(places[0])) < ERRORS.max_misplacement


def may_be_transducer_errors(search: Search, effects: Sequence[Effect]) -> bool:
    """Whether one of the effects may be a plausible error of a transducer, which the nominal errors include already."""
    return is_timing(search, effects) or any(is_plausible_gain_or_place(effect, search.rig) for effect in effects)


def is_timing(search: Search, effects: Sequence[Effect], kinds: Collection[Kind] = (SENSOR_DELAY,)) -> bool:
    """Whether one of the effects is of these kinds, and a plausible error of a sensor's timing: a small delay."""
    return any(is_plausible_delay(effect, search) for effect in effects if effect.kind in kinds)


def uniform_as_nominal_errors(search: Search, found: Fit, *, alone: bool = False) -> Fit:
    """The fit with small uniform errors of stiffness and damping as nominal errors, if it has other effects too.

    An imperfect model has both errors; one of them alone is an effect.

    Args:
        alone: convert one alone too, as a random force may mask the other.
    """
    uniform = {e.kind.name: float(np.log(e.values["factor"])) for e in found.effects if e.kind in UNIFORM}
    others = [e for e in found.effects if e.kind not in UNIFORM]
    transducer_errors = next((e for e in others if e.kind is NOMINAL_ERRORS), None)
    named = [e for e in others if e is not transducer_errors]
    if not named or len(uniform) < (1 if alone else len(UNIFORM)):
        return found
    largest = dict(ERRORS.max_uniform_alone if len(uniform) == 1 else ERRORS.max_uniform)
    if any(abs(size) >= largest[name] for name, size in uniform.items()):
        return found
    if transducer_errors is not None and not set(transducer_errors.target.groups) <= set(TRANSDUCER_GROUPS):
        return found
    stiffness, damping = (uniform.get(kind.name, 0.0) for kind in UNIFORM)
    if isinstance(search.rig.structure, Structure):
        sizes = {"stiffness": stiffness, "damping": damping}
    else:  # without known profiles, all frequencies have the same error
        sizes = {"frequency": 0.5 * stiffness, "damping": damping}
    prior = (
        NominalPrior(sample_time=search.data.records[0].sample_time)
        if transducer_errors is None
        else transducer_errors.target
    )
    errors = nominal_errors(search.rig, replace(prior, **{name: abs(size) for name, size in sizes.items()}, waves=1))
    values = {name: sizes.get(group_of(name), 0.0) for name in errors.values}
    values.update({} if transducer_errors is None else transducer_errors.values)
    return replace(found, effects=(*named, replace(errors, values=values)), covariance=None)


def delay_effects(rig: Rig, errors: Effect) -> tuple[Effect, ...]:
    """The single effects that may cause the sensor delays among the nominal errors; empty if none does.

    If one of several sensors is late, its own delay or lag is the cause. If all are equally late, beyond chance, the
    cause is a lag of the sensors or of the actuators, or a delay of the actuators.
    """
    delays = {name.removeprefix("delay_"): float(delay) for name, delay in in_group(errors.values, "delay").items()}
    uncertainty = {name: ERRORS.standard_errors * errors.std.get(f"delay_{name}", 0.0) for name in delays}
    late = [name for name, delay in delays.items() if abs(delay) > max(ERRORS.min_delay, uncertainty[name])]
    sample_time = errors.target.sample_time
    if len(delays) >= ERRORS.several_sensors and len(late) == 1 and delays[late[0]] > 0:
        delay = delays[late[0]] * sample_time
        return Effect(SENSOR_DELAY, late[0], {"delay": delay}), Effect(SENSOR_LAG, late[0], {"time_constant": delay})
    if len(delays) < 2 or len(late) < len(delays) or min(delays.values()) < 0:
        return ()
    mean = float(np.mean([*delays.values()]))
    largest_difference = max(max(abs(delay - mean), uncertainty[name]) for name, delay in delays.items())
    probability = (2.0 * largest_difference / mean) ** (len(delays) - 1)  # that independent delays agree as closely
    if probability > ERRORS.coincidence_probability:
        return ()
    return common_delays(rig, mean * sample_time)


def common_delays(rig: Rig, late: float) -> tuple[Effect, ...]:
    """Every effect that delays all sensors by a time `late`, s."""
    kinds = ((kind, targets[0]) for kind in DELAYS_OF_ALL if (targets := kind.targets(rig)))
    return tuple(Effect(kind, all_, {kind.parameters(rig, all_)[0].name: late}) for kind, all_ in kinds)


def with_common_delay(found: Fit) -> Fit:
    """The fit, an effect that delays all sensors taking the mean of the delays among the nominal errors, the last.

    Both delay alike, and the records determine only their sum.
    """
    *others, late, errors = found.effects
    delays = in_group(errors.values, "delay")
    mean = float(np.mean([*delays.values()])) if delays else 0.0
    delay = delay_of(late) + mean * errors.target.sample_time
    if late.kind not in DELAYS_OF_ALL or not mean or delay <= 0.0:
        return found
    (name,) = late.values
    rest = {name: value - mean for name, value in delays.items()}
    late = replace(late, values={name: delay})
    return replace(found, effects=(*others, late, replace(errors, values={**errors.values, **rest})))


def with_late_accelerometer(search: Search, step: JointFit, tried: Sequence[JointFit]) -> JointFit | None:
    """The step with an accelerometer that reads before the input steps, if the best candidate delays it.

    The acceleration jumps with a held input, so the cost jumps at zero delay and no gradient leads across.
    """
    best = min(tried, key=lambda s: s.fit.cost)
    prior, late = step.errors.target, best.effects[-1]
    if late.kind not in TIMING or prior.interpolated or not is_plausible_delay(late, search, step.errors):
        return None
    accelerometers = {sensor.name for sensor in search.rig.sensors if sensor.quantity == "acceleration"}
    if late.target not in accelerometers.difference(prior.late):
        return None
    refitted = fit_jointly(search, step.effects, with_delay_as_error(search, step.errors, late))
    return refitted if refitted.fit.cost < step.fit.cost else None


def with_delay_as_error(search: Search, errors: Effect, late: Effect) -> Effect:
    """The nominal errors with the delay or lag of one sensor among them; an accelerometer reads after the steps."""
    errors = with_all_groups(search, errors)
    prior = errors.target
    if any(sensor.name == late.target and sensor.quantity == "acceleration" for sensor in search.rig.sensors):
        early = tuple(name for name in prior.early if name != late.target)
        prior = replace(prior, late=tuple(dict.fromkeys((*prior.late, late.target))), early=early)
    values = {**errors.values, f"delay_{late.target}": delay_of(late) / prior.sample_time}
    return nominal_errors(search.rig, prior, values)


def with_wrong_transducers(search: Search, step: JointFit) -> JointFit:
    """The step with errors of gain and place as effects, each too large for a careful laboratory and outlying."""
    for _ in range(ERRORS.max_wrong_transducers):
        suspect = max(_suspects(search, step), key=lambda s: s.size, default=None)
        if suspect is None:
            break
        effect = suspect.effect
        others = [e for e in step.effects if (e.kind, e.target) != (effect.kind, effect.target)]
        found = fit_from_zero(search, (*others, effect))  # other nominal errors have absorbed part of it
        group, limit = ("gain", ERRORS.max_gain) if "gain" in effect.values else ("place", ERRORS.max_misplacement)
        is_wrong = _size(search.rig, found.effects[-1]) >= max(
            limit, ERRORS.outlier_ratio * size_of(found.errors, group)
        )
        is_as_near = found.explains or found.fit.cost < SEARCH.max_cost_ratio * step.fit.cost
        if not (is_wrong and is_as_near and search.are_noticeable(found.effects, found.fit.effects)):
            break
        step = found
    return step


class _Suspect(NamedTuple):
    """An effect of a transducer in place of its nominal error, and the size of the error over the limit of effects."""

    effect: Effect
    size: float


def _suspects(search: Search, step: JointFit) -> Iterator[_Suspect]:
    """The nominal errors of gain and place that may be effects."""
    rig, off = search.rig, step.errors.apply(search.rig)
    actuators, sensors = zip(rig.actuators, off.actuators, strict=True), zip(rig.sensors, off.sensors, strict=True)
    sides = ((ACTUATOR_GAIN, ACTUATOR_MISPLACEMENT, actuators), (SENSOR_GAIN, SENSOR_MISPLACEMENT, sensors))
    named = {(effect.kind, effect.target): effect for effect in step.effects}
    for of_gain, of_place, transducers in sides:
        for nominal, transducer in transducers:
            known = named.get((of_gain, nominal.name))
            gain = transducer.gain / nominal.gain if nominal.gain else 1.0
            size = abs(float(np.log(gain))) / ERRORS.max_gain
            if of_gain in search.catalogue and size > ERRORS.tested_share:
                gain *= 1.0 if known is None else known.values["gain"]
                yield _Suspect(Effect(of_gain, nominal.name, {"gain": gain}), size)
            if of_place in search.catalogue and step.errors.target.place and (of_place, nominal.name) not in named:
                effect = Effect(of_place, nominal.name, place_values(middle(transducer.at)))
                size = _size(rig, effect) / ERRORS.max_misplacement
                if size > ERRORS.tested_share:
                    yield _Suspect(effect, size)


def _size(rig: Rig, effect: Effect) -> float:
    """Size of an error of gain (its logarithm) or of place (of the extent) of a transducer, as an effect."""
    if "gain" in effect.values:
        gain = effect.values["gain"]
        return abs(float(np.log(gain))) if gain > 0.0 else 0.0  # a gain that passed zero: the fit has gone astray
    transducers = rig.actuators if effect.kind.path == "actuator" else rig.sensors
    nominal = next(transducer.at for transducer in transducers if transducer.name == effect.target)
    return rig.modes.domain.separation(effect.at, middle(nominal))


def with_uniform_effects(search: Search, step: JointFit) -> JointFit:
    """The step with uniform stiffness and damping errors as effects, if too large for nominal errors."""
    values, dampings = step.errors.values, in_group(step.errors.values, "damping")
    damping = float(np.mean([*dampings.values()] or [0.0]))
    stiffness = values.get("stiffness_0", 0.0) - values.get("mass_0", 0.0)
    named = {effect.kind for effect in step.effects}
    added, reset, largest = [], dict(values), dict(ERRORS.max_uniform)
    if abs(damping) > largest["modal_damping"] and MODAL_DAMPING not in named:
        added.append(Effect(MODAL_DAMPING, None, {"factor": float(np.exp(damping))}))
        reset.update({name: value - damping for name, value in dampings.items()})
    if abs(stiffness) > largest["modulus_error"] and MODULUS_ERROR not in named:
        added.append(Effect(MODULUS_ERROR, None, {"factor": float(np.exp(stiffness))}))
        reset.update({"stiffness_0": 0.0, "mass_0": 0.0})
    if not added:
        return step
    return fit_jointly(search, (*step.effects, *added), replace(step.errors, values=reset), rounds=2)


def with_delay_as_effect(search: Search, step: JointFit, least: float) -> JointFit:
    """The step with sensor delays of one common cause as that effect, if it fits as well.

    Args:
        step: effects and nominal errors, fitted jointly.
        least: residual power, in units of the noise, that delays must account for; otherwise they stay nominal errors.
    """
    target, named = step.errors.target, {effect.kind for effect in step.effects}
    late = [effect for effect in delay_effects(search.rig, step.errors) if effect.kind not in named]
    late = [effect for effect in late if search.are_noticeable([effect], [*step.effects, effect])]
    if not late:
        return step
    without_delays = {**step.errors.values, **dict.fromkeys(in_group(step.errors.values, "delay"), 0.0)}
    errors = nominal_errors(search.rig, replace(target, late=(), early=(), interpolated=False), without_delays)
    each = search.workers.map(lambda e: fit_jointly(search, (*step.effects, e), errors, rounds=2), late)
    each = [evaluated(search, with_common_delay(s.fit)) for s in each]
    best, *others = sorted(each, key=lambda s: s.fit.cost)
    effect = best.effects[-1]
    if is_likelier(search, step, best) or not effect.stands_out(search.rig):
        return step
    power = cost_of(search.rig, (*step.effects, errors), search.data) - best.fit.cost
    if power < least or not search.are_noticeable([effect], best.effects):
        return step
    return replace(best, others=(best, *others))
