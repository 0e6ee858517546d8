"""What the search may claim: no gap, effects that explain it, or that none does."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from workbench.gap.disturbance import RandomForceFit, fit_random_force, model_filter
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.environment import RANDOM_DISTURBANCE
from workbench.gap.evidence import Evidence
from workbench.gap.finish import finished, ranked, relocated, simplest
from workbench.gap.fit import Fit, fit
from workbench.gap.search import Search, one_more, spread_over_kinds
from workbench.rig.rig import Rig

NEAR = 0.1  # of the gap's power left: a set this near may only stand in the wrong valley


class Decision(NamedTuple):
    """What is claimed; see `Attribution` for its parts."""

    outcome: str
    best: Fit
    random: RandomForceFit | None = None
    rivals: tuple[tuple[Fit, float], ...] = ()


def decide(search: Search, start: Fit, singles: list[Fit]) -> Decision | None:
    """What needs no second effect; None where nothing alone explains the records."""
    good = [f for f in singles if search.worthwhile(f, start.cost)]
    if search.explains(start) and not good:
        return Decision("none", start)
    ended = search.side_by_side(finished, good[:4])
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


def decide_on_random(search: Search, start: Fit, nearest: Fit) -> Decision | None:
    """A random disturbance, alone or beside one effect; None where no such force holds in every record.

    It is looked for beside one effect only where it says far more than the nearest effect alone.
    """
    alone = with_random(search, start)
    if alone[1].holds:
        return Decision("explained", *alone)
    if not search.near(alone[0], NEAR) or search.near(nearest, NEAR):
        return None
    rig = _rig_with(search, start)
    evidence = Evidence.of(rig, search.data, 20)
    beside = search.through(model_filter(evidence.model, rig, alone[1]))
    singles = spread_over_kinds(one_more(beside, start.effects, evidence, 0.45, 0.5, finalists=4), 1)
    return best_with_random(search, singles[:3])


def best_with_random(search: Search, candidates: Sequence[Fit]) -> Decision | None:
    """The likeliest of the candidates beside a random disturbance that holds."""
    tried = [with_random(search, candidate) for candidate in candidates]
    holding = sorted((found for found in tried if found[1].holds), key=lambda found: found[0].cost)
    if not holding:
        return None
    best, rivals = ranked(search, [found[0] for found in holding])
    return Decision("explained", best, next(random for found, random in holding if found is best), rivals)


def with_random(search: Search, given: Fit) -> tuple[Fit, RandomForceFit]:
    """The given effects and a random disturbance, each fitted beside the other."""
    found = _random_beside(search, given)
    if given.effects and not found[1].holds and search.near(found[0], NEAR):
        rig = _rig_with(search, given)
        data = search.data.through(model_filter(Evidence.of(rig, search.data).model, rig, found[1]))
        refitted = fit(search.rig, given.effects, data, iterations=8)
        left = search.data.by_channel(search.data.residual(apply_all(search.rig, refitted.effects)))
        found = _random_beside(search, replace(refitted, cost_by_channel=left))
    return found


def _rig_with(search: Search, given: Fit) -> Rig:
    return apply_all(search.rig, [e for e in given.effects if e.kind.name != "sensor_quantisation"])


def _random_beside(search: Search, given: Fit) -> tuple[Fit, RandomForceFit]:
    rig = _rig_with(search, given)
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


def pairs_of(search: Search, singles: list[Fit]) -> list[Fit]:
    """The best few single effects, each with a second one; stops at the first pair that explains the records."""
    firsts = spread_over_kinds(singles, 2)[:5]
    pairs: list[Fit] = []
    for i, first in enumerate(firsts):
        begin = 0.5 + 0.4 * i / len(firsts)
        pairs += _joined(search, first.effects, begin, begin + 0.4 / len(firsts), finalists=3 if i else 5)
        pairs.sort(key=lambda f: f.cost)
        best = finished(search, pairs[0])
        if not search.explains(best) and search.near(best, 0.2 * NEAR):
            best = relocated(search, best)
        if search.explains(best):
            return [best, *pairs]
    return _exchanged(search, pairs)


def _joined(search: Search, given: tuple[Effect, ...], begin: float, end: float, *, finalists: int) -> list[Fit]:
    evidence = Evidence.of(apply_all(search.rig, given), search.data, 20)
    return one_more(search, given, evidence, begin, end, finalists=finalists)


def _exchanged(search: Search, pairs: list[Fit]) -> list[Fit]:
    """The pairs, and those that come of keeping one half of a near miss and looking for the other half anew.

    In a near miss the right half has nearly its right numbers, better ones than it had alone.
    """
    best = pairs[0]
    if not search.near(best, NEAR):
        return pairs
    for i in range(len(best.effects)):
        kept = best.effects[:i] + best.effects[i + 1 :]
        pairs = pairs + _joined(search, kept, 0.9, 0.94, finalists=4)
    return sorted(pairs, key=lambda f: f.cost)


def unexplained(start: Fit, best: Fit, rivals) -> Decision:
    """What is said where no set reaches the noise floor: in part, or not at all."""
    closed = 1.0 - np.sqrt(max(best.cost - 1.0, 0.0) / max(start.cost - 1.0, 1e-12))
    return Decision("part" if closed > 0.5 else "unknown", best, rivals=rivals)


def decide_on_pairs(search: Search, start: Fit, singles: list[Fit], pairs: list[Fit]) -> Decision:
    """What pairs say, or single effects beside a random disturbance."""
    distinct: dict[tuple, Fit] = {}
    for candidate in pairs:
        distinct.setdefault(candidate.key, candidate)
    ended = sorted(search.side_by_side(finished, list(distinct.values())[:4]), key=lambda f: f.cost)
    explaining = [f for f in ended if search.explains(f)]
    if not explaining:
        ended[:2] = search.side_by_side(relocated, ended[:2])
        explaining = [f for f in ended if search.explains(f)]
    if explaining:
        best, rivals = ranked(search, [simplest(search, f) for f in explaining])
        return Decision("explained", best, rivals=rivals)
    beside = best_with_random(search, singles[:3])
    if beside is not None:
        return beside
    best, rivals = ranked(search, ended or singles[:1])
    return unexplained(start, best, rivals)
