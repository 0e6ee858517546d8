"""What the search may claim: no gap, effects that explain it, or that none does."""

from collections.abc import Sequence

import numpy as np

from workbench.gap.beside_random import NEAR, decide_with_random
from workbench.gap.effects.effect import apply_all
from workbench.gap.evidence import Evidence
from workbench.gap.finish import finished, ranked, relocated, simplest
from workbench.gap.fit import Fit
from workbench.gap.outcome import Decision
from workbench.gap.search import Search, one_more, spread_over_kinds

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
    """The best few single effects, each with a second one or a random disturbance, until a pair explains."""
    firsts = spread_over_kinds(singles, 2)[:5]
    pairs: list[Fit] = []
    ended: list[Fit] = []
    for i, first in enumerate(firsts):
        begin = 0.5 + 0.4 * i / len(firsts)
        evidence = Evidence.of(apply_all(search.rig, first.effects), search.data, 20)
        beside = decide_with_random(search, first, evidence)
        if beside is not None:
            return beside
        step = 0.4 / len(firsts)
        pairs += one_more(search, first.effects, evidence, begin, begin + step, finalists=3 if i else 5)
        pairs.sort(key=lambda f: f.cost)
        fresh = [pair for pair in pairs[:TRIED_FURTHER] if pair not in ended]
        taken = _to_their_ends(search, fresh)
        ended += [*fresh, *taken]
        pairs = sorted((*taken, *pairs), key=lambda f: f.cost)
        if any(search.explains(pair) for pair in taken):
            return _of_pairs(search, start, pairs, ended)
    return _of_pairs(search, start, _exchanged(search, pairs), ended)


def _to_their_ends(search: Search, pairs: Sequence[Fit]) -> list[Fit]:
    """The pairs with finer steps, and from other places where little is left and none explains the records yet."""
    ended = search.side_by_side(finished, pairs)
    if any(search.explains(pair) for pair in ended):
        return ended
    near = [pair for pair in ended if search.near(pair, 0.2 * NEAR)]
    return [*search.side_by_side(relocated, near), *(pair for pair in ended if pair not in near)]


def _exchanged(search: Search, pairs: list[Fit]) -> list[Fit]:
    """The pairs, and those that come of keeping one half of a near miss and looking for the other half anew.

    In a near miss the right half has nearly its right numbers, better ones than it had alone.
    """
    best = pairs[0]
    if not search.near(best, NEAR):
        return pairs
    for i in range(len(best.effects)):
        kept = best.effects[:i] + best.effects[i + 1 :]
        evidence = Evidence.of(apply_all(search.rig, kept), search.data, 20)
        pairs = pairs + one_more(search, kept, evidence, 0.9, 0.94, finalists=4)
    return sorted(pairs, key=lambda f: f.cost)


def unexplained(start: Fit, best: Fit, rivals) -> Decision:
    """What is said where no set reaches the noise floor: in part, or not at all."""
    closed = 1.0 - np.sqrt(max(best.cost - 1.0, 0.0) / max(start.cost - 1.0, 1e-12))
    return Decision("part" if closed > 0.5 else "unknown", best, rivals=rivals)


def _of_pairs(search: Search, start: Fit, pairs: list[Fit], done: list[Fit]) -> Decision:
    """What the pairs say; those that are done with need no other places."""
    distinct: dict[tuple, Fit] = {}
    for candidate in pairs:
        distinct.setdefault(candidate.key, candidate)
    ended = sorted(_ended(search, list(distinct.values())[:4]), key=lambda f: f.cost)
    explaining = [f for f in ended if search.explains(f)]
    if not explaining:
        fresh = [f for f in ended[:2] if f not in done]
        ended = [*search.side_by_side(relocated, fresh), *(f for f in ended if f not in fresh)]
        explaining = [f for f in ended if search.explains(f)]
    if explaining:
        best, rivals = ranked(search, [simplest(search, f) for f in explaining])
        return Decision("explained", best, rivals=rivals)
    best, rivals = ranked(search, ended)
    return unexplained(start, best, rivals)
