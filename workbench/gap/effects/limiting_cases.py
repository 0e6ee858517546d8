"""Which effects contain another as a limit: the simpler one is meant where the records cannot tell them apart."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

from workbench.gap.effects.effect import COORDINATES, Effect, key_of, place_values
from workbench.gap.effects.nonlinear import BOUC_WEN, CLEARANCE, COULOMB_FRICTION
from workbench.gap.effects.structural import (
    GROUND_SPRING,
    POINT_DAMPER,
    SUPPORT_ROTATION,
    TRUNCATED_MODES,
)
from workbench.rig.rig import Rig
from workbench.structure.member import Structure

BESIDE = 0.1  # of the length: farther out a spring does not turn the hinge, it holds the beam


def simpler_forms(effect: Effect, rig: Rig) -> tuple[Effect, ...]:
    """Effects that this one turns into at a bound of its parameters, with values to start a fit from.

    A clearance of no gap and a hysteretic spring that never yields are springs; friction far below its smoothing
    speed is a viscous damper; a hysteretic spring that always slides is friction; a spring beside a hinge is a hinge
    that resists turning, by k a²; one mode fewer is fewer.
    """
    v = effect.values
    if effect.kind is COULOMB_FRICTION:
        coefficient = v["force"] / v["smoothing_speed"]
        return (Effect(POINT_DAMPER, None, {**place_values(effect.at), "coefficient": coefficient}),)
    if effect.kind is CLEARANCE:
        return (Effect(GROUND_SPRING, None, {**place_values(effect.at), "stiffness": v["stiffness"]}),)
    if effect.kind is BOUC_WEN:
        return (Effect(GROUND_SPRING, None, {**place_values(effect.at), "stiffness": v["stiffness"]}),)
    if effect.kind is GROUND_SPRING:
        return _turned_by(effect, rig)
    if effect.kind is TRUNCATED_MODES and isinstance(effect.target, int) and effect.target - 1 > rig.modes.n_modes:
        return (Effect(TRUNCATED_MODES, effect.target - 1, {}),)
    return ()


def _turned_by(spring: Effect, rig: Rig) -> tuple[Effect, ...]:
    if not isinstance(rig.structure, Structure):
        return ()
    length, v = rig.structure.length, spring.values
    end, arm = ("left", v["at"]) if v["at"] < 0.5 * length else ("right", length - v["at"])
    if arm > BESIDE * length or end not in SUPPORT_ROTATION.targets(rig):
        return ()
    return (Effect(SUPPORT_ROTATION, end, {"rotational_stiffness": v["stiffness"] * arm**2}),)


def fewer(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The set with two effects of one kind made one, with values to start a fit from: two springs may stand for one."""
    for one, other in combinations(effects, 2):
        if one.kind is other.kind and one.target == other.target and one.at is not None:
            rest = [effect for effect in effects if effect is not one and effect is not other]
            yield (*rest, one)
            yield (*rest, one.moved_to(other.at))
            names = [name for name in COORDINATES if isinstance(one.values.get(name), float)]
            if names:
                middle = {name: 0.5 * (one.values[name] + other.values[name]) for name in names}
                yield (*rest, replace(one, values={**one.values, **middle}))


def with_one_simpler(effects: Sequence[Effect], rig: Rig) -> Iterator[tuple[Effect, ...]]:
    """The set with one of its effects as what it turns into at a bound."""
    for i, effect in enumerate(effects):
        for simpler in simpler_forms(effect, rig):
            yield (*effects[:i], simpler, *effects[i + 1 :])


def simpler_sets(effects: Sequence[Effect], rig: Rig) -> Iterator[tuple[Effect, ...]]:
    """The sets that this one comes to at a bound of one effect, or with two as one."""
    yield from fewer(effects)
    yield from with_one_simpler(effects, rig)


def contained(effects: Sequence[Effect], rig: Rig) -> set[tuple[str, ...]]:
    """The keys of all sets that this one comes to at bounds of its parameters."""
    found: set[tuple[str, ...]] = set()
    for simpler in simpler_sets(effects, rig):
        if key_of(simpler) not in found:
            found |= {key_of(simpler)} | contained(simpler, rig)
    return found
