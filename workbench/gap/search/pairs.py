"""Pairs of effects, sought at once and one after the other, until one explains the records."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.search.finish import best_of_each, finished, plainest, ranked, relocated, simplest, simplified
from workbench.gap.search.fit import Fit, cost_of
from workbench.gap.search.screening import Screening, fitted_ahead, on_whole_records, one_more
from workbench.gap.search.search import Decision, Search, in_one_minimum, unexplained
from workbench.gap.search.settings import PAIRS, RANDOM, SELECTION
from workbench.structure.domain import Between


@dataclass(eq=False)
class Pairs:
    """What a search for pairs has found so far; filled in as it goes.

    Attributes:
        search: what it works on.
        ahead: pairs fitted one sample ahead, best first.
        followed: those of them that were fitted to whole records too.
        found: pairs fitted to whole records, best first.
        ended: those taken to their ends, before and after.
        given: single effects that a second one was looked for beside.
        missed: near misses of which each half was kept and the other sought anew.
        moved: those tried from other places.
        explain: whether one of those that are likeliest at first sight explains the records.
    """

    search: Search
    ahead: list[Fit] = field(default_factory=list)
    followed: list[Fit] = field(default_factory=list)
    found: list[Fit] = field(default_factory=list)
    ended: list[Fit] = field(default_factory=list)
    given: list[Effect] = field(default_factory=list)
    missed: list[Fit] = field(default_factory=list)
    moved: list[Fit] = field(default_factory=list)
    explain: bool = False

    @classmethod
    def at_once(cls, search: Search, screened: Screening) -> "Pairs":
        """The pairs that are likeliest at first sight.

        Args:
            search: what they are sought in.
            screened: what may be there, with nothing given.
        """
        pairs = cls(search)
        if not search.is_over:
            search.report("all pairs at once", 0.4)
            pairs.explain = pairs._explained_by(fitted_ahead(search, screened.likeliest_pairs(SELECTION.tried)))
        return pairs

    def further(self) -> "Pairs":
        """The same, to go on from."""
        both = Pairs(self.search, explain=self.explain)
        for name, value in vars(self).items():
            if isinstance(value, list):
                setattr(both, name, list(value))
        return both

    def with_a_third(self) -> bool:
        """Whether the best pair and one more effect explain the records, where the pair leaves enough for one."""
        search = self.search
        if not self.found or not search.near(self.found[0], PAIRS.most) or search.near(self.found[0], PAIRS.least):
            return False
        search.report("the best pair and another", 0.45)
        pair = self.found[0].effects
        if self._and_another(pair):
            return True
        best = self.found[0]
        if len(best.effects) <= len(pair) or not search.near(best, PAIRS.very_near):
            return False
        # with a third beside them, one of the two may have stood in for another
        return self._and_another(tuple(_weightiest_first(search, best)[:-1]))

    def _and_another(self, given: tuple[Effect, ...]) -> bool:
        """Whether these effects with one more explain the records."""
        if self.search.is_over:
            return False
        evidence = self.search.evidence_of(apply_all(self.search.rig, given))
        return self._explained_by(one_more(self.search, given, evidence))

    def by_exchange(self) -> bool:
        """Whether a pair with either half of the best one sample ahead explains the records.

        A strong effect is found beside whatever stands in for the other; what it leaves tells the other's place.
        """
        for _ in range(PAIRS.exchanges):
            if not self.ahead:
                return False
            best = self.ahead[0]
            if self.beside_any(_weightiest_first(self.search, best)):
                return True
            if self.ahead[0].cost > PAIRS.nearer * best.cost:
                break
        return self._from_elsewhere()

    def beside(self, effect: Effect) -> bool:
        """Whether a pair with this effect explains the records."""
        if self.search.is_over:
            return False
        self.search.report(f"{effect.kind.words} and another", 0.55 + 0.05 * min(len(self.given), 8))
        self.given.append(effect)
        return self._explained_by(one_more(self.search, (effect,), _evidence(self.search, effect)))

    def decision(self, start: Fit) -> Decision:
        """What the pairs say.

        Args:
            start: what is there with no effect.
        """
        likeliest = best_of_each(self.found or [start])[: PAIRS.named]
        explaining = [f for f in likeliest if self.search.explains(f)]
        if explaining:
            plain = plainest(self.search, explaining)
            best, rivals = ranked(self.search, self.search.side_by_side(simplest, plain))
            return Decision("explained", best, rivals=rivals)
        best, rivals = ranked(self.search, likeliest)
        return unexplained(start, best, rivals)

    def _near(self) -> bool:
        return bool(self.found) and self.search.near(self.found[0], RANDOM.near)

    def _explained_by(self, ahead: Sequence[Fit]) -> bool:
        self.ahead = sorted((*self.ahead, *ahead), key=lambda f: f.cost)
        domain = self.search.rig.modes.domain
        enough = max(SELECTION.promising, SELECTION.promising_share * self.search.nominal_ahead)
        promising = [f for f in ahead if f.cost < enough]
        fresh = [f for f in promising if not any(in_one_minimum(f, other, domain) for other in self.followed)]
        most = PAIRS.more if self.found else PAIRS.finalists
        self.followed += fresh[:most]
        self._add(on_whole_records(self.search, fresh, most))
        near = [pair for pair in self.found[: PAIRS.tried_further] if not _done(pair, self.ended)]
        taken = _to_their_ends(self.search, near)
        self.ended += [*near, *taken]
        self._add(taken)
        return any(self.search.explains(pair) for pair in taken)

    def _by_halves(self) -> bool:
        """Whether a pair with either half of the best on whole records explains them."""
        self.missed.append(self.found[0])
        return self.beside_any(self.found[0].effects[::-1])

    def beside_any(self, halves: Sequence[Effect]) -> bool:
        """Whether a pair with one of these effects explains the records; those given before are not tried again."""
        return any(self.beside(h) for h in halves if not any(_unmoved(h, other) for other in self.given))

    def _from_elsewhere(self) -> bool:
        """Whether one of the best pairs explains the records with other places, or leads to one that does."""
        search = self.search
        if search.is_over:
            return False
        likeliest = best_of_each(self.found)[: PAIRS.tried_further]
        fresh = [f for f in likeliest if search.near(f, PAIRS.very_near) and not _done(f, self.moved)]
        elsewhere = search.side_by_side(relocated, fresh)
        self.moved += [*fresh, *elsewhere]
        self._add(elsewhere)
        if any(search.explains(pair) for pair in elsewhere):
            return True
        nearer = all(self.found[0].cost - 1.0 < PAIRS.nearer * (missed.cost - 1.0) for missed in self.missed)
        return self._near() and nearer and self._by_halves()

    def _add(self, pairs: Sequence[Fit]) -> None:
        self.found = sorted((*pairs, *self.found), key=lambda f: f.cost)


def _evidence(search: Search, effect: Effect) -> Evidence:
    """Of the rig with the effect; without it where the motion of whole records would run away with it alone."""
    astray = cost_of(search.rig, (effect,), search.data) > PAIRS.astray * search.nominal.mean()
    rig = search.rig if astray else apply_all(search.rig, (effect,))
    return search.evidence_of(rig)


def _weightiest_first(search: Search, found: Fit) -> list[Effect]:
    """The effects of a set, first the one that most is left without."""

    def left_without(effect: Effect) -> float:
        return cost_of(search.rig, (*(e for e in found.effects if e is not effect), *search.held), search.ahead)

    return sorted(found.effects, key=left_without, reverse=True)


def _unmoved(one: Effect, other: Effect) -> bool:
    """Whether two effects are the same, with nearly the same numbers."""
    if one.label != other.label or (isinstance(one.at, str | Between) and one.at != other.at):
        return False
    numbers = [name for name, value in one.values.items() if isinstance(value, float)]
    return all(np.isclose(one.values[n], other.values[n], rtol=PAIRS.moved) for n in numbers)


def _done(pair: Fit, ended: Sequence[Fit]) -> bool:
    """Whether the same set was taken to its end before, from hardly another place."""
    return any(pair.key == other.key and other.cost - 1.0 < PAIRS.same * (pair.cost - 1.0) for other in ended)


def _to_their_ends(search: Search, pairs: Sequence[Fit]) -> list[Fit]:
    """The pairs, and where none explains the records yet, in simpler forms."""
    ended = search.side_by_side(finished, pairs)
    if any(search.explains(pair) for pair in ended):
        return ended
    near = [pair for pair in ended if search.near(pair, PAIRS.very_near)]
    return [*search.side_by_side(simplified, near), *(pair for pair in ended if pair not in near)]
