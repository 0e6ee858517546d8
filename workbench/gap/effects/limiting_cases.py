"""Limiting cases: the simpler effect is meant where the records cannot distinguish it from one that contains it."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, permutations

from workbench.gap.effects.effect import COORDINATES, Effect, key_of
from workbench.rig.rig import Rig


def simpler_forms(effect: Effect, rig: Rig) -> tuple[Effect, ...]:
    """Effects that this one turns into at a bound of its parameters, with values to start a fit from."""
    return tuple(effect.kind.simpler(effect, rig))


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


def each_left_out(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The set without each of its effects in turn."""
    for effect in effects:
        yield tuple(other for other in effects if other is not effect)


def wider_sets(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The sets with one effect as what it is a limiting case of."""
    for i, effect in enumerate(effects):
        for wider in effect.kind.wider(effect):
            yield (*effects[:i], wider, *effects[i + 1 :])


def merged_sets(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The sets with two effects of different kinds as the one that both together may be."""
    for one, other in permutations(effects, 2):
        merged = one.kind.merged(one, other)
        if merged is not None:
            yield (*(effect for effect in effects if effect is not one and effect is not other), merged)


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
