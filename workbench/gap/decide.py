"""What the search may claim: no gap, effects that explain it, or that none does."""

from collections.abc import Sequence

import numpy as np

from workbench.gap.beside_random import NEAR, decide_with_random
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.evidence import Evidence
from workbench.gap.finish import finished, followed, ranked, relocated, simplest, simplified
from workbench.gap.fit import Fit
from workbench.gap.outcome import Decision
from workbench.gap.search import FAR, Search, apart, one_more, spread_over_kinds

FIRSTS = 5  # single effects that a second one is looked for beside
MOVED = 0.1  # of a number: what makes the half of a pair another one than it was alone
NEARER = 0.5  # of what another near miss leaves: what makes one worth the same search again
SAME = 1.1  # of the gap left by a set: nearer, its fits end alike
VERY_NEAR = 0.2 * NEAR  # what is tried from other places at once; what is near, where nothing else explains the records
TRIED_FURTHER = 2  # pairs, best first, that are tried from other places too
FAR_BEHIND = 2.0  # finer steps bring no set this many times as costly as another to the noise floor before it


def decide(search: Search, start: Fit, singles: list[Fit]) -> Decision | None:
    """What needs no second effect; None where nothing alone explains the records."""
    good = [f for f in singles if search.worthwhile(f, start.cost)]
    if search.explains(start) and not good:
        return Decision("none", start)
    ended = _ended(search, good[:4])
    explaining = [f for f in ended if search.explains(f)]
    if not explaining:
        near = [f for f in ended[:2] if search.near(f, NEAR)]
        explaining = [f for f in search.side_by_side(relocated, near) if search.explains(f)]
    if explaining:
        best, rivals = ranked(search, [simplest(search, f) for f in explaining])
        return Decision("explained", best, rivals=rivals)
    if search.explains(start):
        return Decision("none", start)
    return None


def _ended(search: Search, fits: Sequence[Fit]) -> list[Fit]:
    """The fits, best first; those that finer steps may bring to the noise floor are taken to their end."""
    hopeful = [f for f in fits if f.cost < FAR_BEHIND * fits[0].cost]
    return [*search.side_by_side(finished, hopeful), *fits[len(hopeful) :]]


def decide_on_pairs(search: Search, start: Fit, singles: list[Fit]) -> Decision:
    """The best few single effects, each with a second one or a random disturbance, until a pair explains.

    In a near miss the right half has nearly its right numbers, better ones than it had alone: as soon as there is one,
    the other half is looked for anew beside either.
    """
    pairs: list[Fit] = []
    ended: list[Fit] = []
    given: list[Effect] = []
    missed: list[Fit] = []
    moved: list[Fit] = []

    def explained_beside(effect: Effect, evidence: Evidence, finalists: int) -> bool:
        begin = 0.5 + 0.05 * min(len(given), 8)
        given.append(effect)
        pairs.extend(one_more(search, (effect,), evidence, begin, begin + 0.05, finalists=finalists))
        pairs.sort(key=lambda f: f.cost)
        fresh = [pair for pair in pairs[:TRIED_FURTHER] if not _done(pair, ended)]
        taken = _to_their_ends(search, fresh)
        ended.extend((*fresh, *taken))
        pairs[:] = sorted((*taken, *pairs), key=lambda f: f.cost)
        return any(search.explains(pair) for pair in taken)

    def explained_by_exchange() -> bool:
        missed.append(pairs[0])
        halves = [half for half in pairs[0].effects[::-1] if not any(_unmoved(half, other) for other in given)]
        return any(explained_beside(half, _evidence(search, half), 4) for half in halves)

    def explained_from_elsewhere() -> bool:
        fresh = [f for f in _distinct(pairs)[:TRIED_FURTHER] if search.near(f, NEAR) and not _done(f, moved)]
        fresh = [f for f in fresh if not (search.near(f, VERY_NEAR) and _done(f, ended))]
        found = search.side_by_side(relocated, fresh)
        moved.extend((*fresh, *found))
        pairs[:] = sorted((*found, *pairs), key=lambda f: f.cost)
        if any(search.explains(pair) for pair in found):
            return True
        nearer = all(pairs[0].cost - 1.0 < NEARER * (m.cost - 1.0) for m in missed)
        return search.near(pairs[0], NEAR) and nearer and explained_by_exchange()

    for first in spread_over_kinds(singles, 2)[:FIRSTS]:
        (effect,) = first.effects
        tried = any(_alike(effect, half, search) for pair in missed for half in pair.effects)
        if tried or (missed and first.cost > FAR * singles[0].cost):
            continue
        evidence = _evidence(search, effect)
        beside = decide_with_random(search, first, evidence)
        if beside is not None:
            return beside
        if explained_beside(effect, evidence, 3 if given else 5):
            break
        near = not missed and search.near(pairs[0], NEAR)
        if near and (explained_by_exchange() or explained_from_elsewhere()):
            break
    else:
        explained_from_elsewhere()
    return _of_pairs(search, start, pairs)


def _evidence(search: Search, effect: Effect) -> Evidence:
    return Evidence.of(apply_all(search.rig, (effect,)), search.data, 20)


def _alike(one: Effect, other: Effect, search: Search) -> bool:
    """Whether two effects are the same but for their numbers."""
    if one.label != other.label:
        return False
    return "at" not in one.values or not apart(one, other, search.rig.modes.length)


def _unmoved(one: Effect, other: Effect) -> bool:
    """Whether two effects are the same, with nearly the same numbers."""
    return one.label == other.label and all(np.isclose(one.values[n], other.values[n], rtol=MOVED) for n in one.values)


def _done(pair: Fit, ended: Sequence[Fit]) -> bool:
    """Whether the same set was taken to its end before, from hardly another place."""
    return any(pair.key == other.key and other.cost - 1.0 < SAME * (pair.cost - 1.0) for other in ended)


def _to_their_ends(search: Search, pairs: Sequence[Fit]) -> list[Fit]:
    """The pairs with finer steps, and where none explains the records yet, from elsewhere and in simpler forms."""
    ended = search.side_by_side(finished, pairs)
    if any(search.explains(pair) for pair in ended):
        return ended
    ended = search.side_by_side(followed, ended)
    if any(search.explains(pair) for pair in ended):
        return ended
    near = [pair for pair in ended if search.near(pair, VERY_NEAR)]
    simpler = search.side_by_side(simplified, near)
    if any(search.explains(pair) for pair in simpler):
        return [*simpler, *(pair for pair in ended if pair not in near)]
    return [*search.side_by_side(relocated, near), *(pair for pair in ended if pair not in near)]


def _distinct(pairs: Sequence[Fit]) -> list[Fit]:
    """The best of every set, in the order of the pairs."""
    distinct: dict[tuple, Fit] = {}
    for candidate in pairs:
        distinct.setdefault(candidate.key, candidate)
    return list(distinct.values())


def unexplained(start: Fit, best: Fit, rivals) -> Decision:
    """What is said where no set reaches the noise floor: in part, or not at all."""
    closed = 1.0 - np.sqrt(max(best.cost - 1.0, 0.0) / max(start.cost - 1.0, 1e-12))
    return Decision("part" if closed > 0.5 else "unknown", best, rivals=rivals)


def _of_pairs(search: Search, start: Fit, pairs: list[Fit]) -> Decision:
    """What the pairs say."""
    ended = sorted(_ended(search, _distinct(pairs)[:4]), key=lambda f: f.cost)
    explaining = [f for f in ended if search.explains(f)]
    if explaining:
        best, rivals = ranked(search, [simplest(search, f) for f in explaining])
        return Decision("explained", best, rivals=rivals)
    best, rivals = ranked(search, ended)
    return unexplained(start, best, rivals)
