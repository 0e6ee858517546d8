"""What no effect, or one, explains beside nominal figures that are a little off."""

from collections.abc import Sequence

from workbench.gap.beside_random import NEAR
from workbench.gap.decide import unexplained
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import NOMINAL_FIGURES
from workbench.gap.evidence import Evidence
from workbench.gap.finish import ranked, simplest
from workbench.gap.fit import Fit, cost_of, fit
from workbench.gap.outcome import Decision
from workbench.gap.search import Search, one_more, spread_over_kinds
from workbench.rig.rig import Rig

WITHIN_REACH = 3.0  # times the noise: the residual is all but linear in the figures, and what four steps leave stays
TELLING = 0.5  # of the gap's power: what freed figures must take away before the catalogue is searched beside them


def figures(rig: Rig) -> Effect:
    """The nominal figures of a rig as they were handed in."""
    return Effect(NOMINAL_FIGURES, None, {p.name: 1.0 for p in NOMINAL_FIGURES.parameters(rig, None)})


def decide_beside_nominal(search: Search, start: Fit, singles: Sequence[Fit]) -> Decision | None:
    """What holds with the nominal figures freed, alone or beside one effect; None where nothing does.

    Freed figures bend to much, so they are trusted as they are until no set of effects explains the records.

    Args:
        start: what is there with no effect.
        singles: every kind's best fit with the figures as they were handed in.
    """
    freed = _freed_beside(search, [start, *spread_over_kinds(singles, 1)[:3]], figures(search.rig))
    holding = [f for f in freed if search.explains(f)]
    if not holding:
        alone = freed_alone(search)
        if alone.cost - 1.0 < (1.0 - TELLING) * (start.cost - 1.0):
            holding = [f for f in each_beside(search, alone) if search.explains(f)]
    if not holding:
        return None
    best, rivals = ranked(search, search.side_by_side(simplest, holding))
    return Decision("explained", best, rivals=rivals)


def decide_with_figures_freed(search: Search, start: Fit) -> tuple[Decision, list[Fit]]:
    """The same where the figures are known to be a little off, and what each kind of effect then comes to."""
    alone = freed_alone(search)
    tried = sorted((alone, *each_beside(search, alone)), key=lambda f: f.cost)
    holding = [f for f in tried if search.explains(f)]
    best, rivals = ranked(search, search.side_by_side(simplest, holding) or tried[:3])
    return Decision("explained", best, rivals=rivals) if holding else unexplained(start, best, rivals), tried


def freed_alone(search: Search) -> Fit:
    """The nominal figures, fitted with no effect beside them."""
    return fit(search.rig, (figures(search.rig),), search.data, iterations=8)


def each_beside(search: Search, alone: Fit) -> list[Fit]:
    """The likeliest kinds, found while the figures give way to every candidate, each then fitted with them."""
    (freed,) = alone.effects
    evidence = Evidence.of(apply_all(search.rig, alone.effects), search.data)
    found = one_more(search.beside(freed), (), evidence, 0.5, 0.6, finalists=4)
    return _freed_beside(search, spread_over_kinds(found, 1)[:4], freed)


def _freed_beside(search: Search, candidates: Sequence[Fit], start: Effect) -> list[Fit]:
    return search.side_by_side(lambda search, f: _freed(search, (*f.effects, start)), candidates)


def _freed(search: Search, effects: tuple[Effect, ...]) -> Fit:
    """The set with all its numbers fitted, the figures among them; given up as soon as that promises nothing."""
    before = cost_of(search.rig, effects, search.quick)
    for iterations in (1, 3):
        trial = fit(search.rig, effects, search.quick, iterations=iterations)
        effects = trial.effects
        if trial.cost - 1.0 > 0.5 * (before - 1.0) and not search.near(trial, NEAR):
            return fit(search.rig, effects, search.data, iterations=0)
    if trial.cost > WITHIN_REACH and trial.falling < 0.5:
        return fit(search.rig, effects, search.data, iterations=0)
    trial = fit(search.rig, effects, search.data, iterations=8)
    return fit(search.rig, trial.effects, search.data.stepped(8), iterations=6) if search.near(trial, NEAR) else trial
