"""What effects explain beside nominal figures that are a little off."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import NOMINAL_FIGURES
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.search.beside_random import NEAR
from workbench.gap.search.finish import ranked, simplest
from workbench.gap.search.fit import Fit, fit
from workbench.gap.search.outcome import Decision, unexplained
from workbench.gap.search.pairs import Pairs
from workbench.gap.search.pursuit import distinct_valleys, one_more, pairs_at_once, whole
from workbench.gap.search.screening import Weighed
from workbench.gap.search.search import Search, spread_over_kinds
from workbench.rig.rig import Rig

WITHIN_REACH = 3.0  # times the noise one sample ahead: what may come to it on whole records
TRIED, PAIRS_TRIED = 4, 3  # sets of one effect and of two that are fitted with the figures


def figures(rig: Rig) -> Effect:
    """The nominal figures of a rig as they were handed in."""
    return Effect(NOMINAL_FIGURES, None, {p.name: 1.0 for p in NOMINAL_FIGURES.parameters(rig, None)})


def decide_beside_nominal(search: Search, start: Fit, pairs: Pairs) -> Decision | None:
    """What holds with the nominal figures freed, alone or beside one effect; None where nothing does.

    Freed figures bend to much: the same effect and a second one, where that explains the records too, come first.

    Args:
        start: what is there with no effect.
        pairs: what was found of them, to go on with.
    """
    search.report("nominal figures a little off", 0.5)
    holding = [f for f in _Beside(search).singles() if search.explains(f)]
    if not holding:
        return None
    best, rivals = ranked(search, search.side_by_side(simplest, holding))
    if any(pairs.beside(effect) for effect in best.effects if effect.kind is not NOMINAL_FIGURES):
        return pairs.decision(start)
    return Decision("explained", best, rivals=rivals)


def decide_with_figures_freed(search: Search, start: Fit) -> tuple[Decision, list[Fit]]:
    """What holds where the figures are known to be a little off, beside one effect or two, and all that was tried."""
    beside = _Beside(search)
    tried = beside.singles()
    if not any(search.explains(f) for f in tried):
        tried += beside.pairs()
    tried.sort(key=lambda f: f.cost)
    holding = [f for f in tried if search.explains(f)]
    best, rivals = ranked(search, search.side_by_side(simplest, holding) or tried[:3])
    return Decision("explained", best, rivals=rivals) if holding else unexplained(start, best, rivals), tried


class _Beside:
    """A search beside freed figures, which give way to every candidate to first order.

    Predictions one sample ahead stay linear in the figures far beyond where the phases of whole records slip.
    """

    def __init__(self, search: Search):
        self.plain = search
        (self.freed,) = fit(search.rig, (figures(search.rig),), search.ahead, iterations=6).effects
        self.search = search.beside(self.freed)
        self.evidence = Evidence.of(apply_all(search.rig, (self.freed,)), search.data, workers=search.workers)
        self.weighed = Weighed.of(self.search, (), self.evidence)
        self.ahead = one_more(self.search, (), self.evidence, self.weighed)

    def singles(self) -> list[Fit]:
        """The figures alone and beside the likeliest single effects, all numbers fitted."""
        return self._fitted([(), *(f.effects for f in spread_over_kinds(self.ahead, 1)[:TRIED])])

    def pairs(self) -> list[Fit]:
        """The figures beside the likeliest pairs, two at once and one with another, all numbers fitted."""
        found = (*pairs_at_once(self.search, self.weighed), *self._with_the_likeliest())
        likeliest = distinct_valleys(self.search, sorted(found, key=lambda f: f.cost))[:PAIRS_TRIED]
        return self._fitted([f.effects for f in likeliest])

    def _with_the_likeliest(self) -> list[Fit]:
        """The likeliest single effect with another, weighed on the record where it leaves most."""
        given, search = self.ahead[0].effects, self.search
        rig = apply_all(search.rig, (*given, self.freed))
        left = search.ahead.by_channel(search.ahead.residual(rig)).mean(axis=1)
        telling = search.quick.records[int(np.argmax(left))].name
        evidence = self.plain.evidence_of(rig)
        return one_more(replace(search, first=search.quick.only((telling,))), given, evidence)

    def _fitted(self, sets: Sequence[tuple[Effect, ...]]) -> list[Fit]:
        return self.search.workers.map(lambda effects: _freed(self.plain, (*effects, self.freed)), sets)


def _freed(search: Search, effects: tuple[Effect, ...]) -> Fit:
    """The set with all its numbers fitted, the figures among them; given up where that promises nothing."""
    ahead = fit(search.rig, effects, search.ahead, iterations=4)
    trial = fit(search.rig, ahead.effects, search.data, iterations=8 if ahead.cost < WITHIN_REACH else 0)
    return whole(search, trial.effects, 6) if search.near(trial, NEAR) else trial
