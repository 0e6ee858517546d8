"""Search for pairs of effects, both at once and one after the other, or for three, until a set explains the records."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.gap.effects.effect import Effect, each_left_out
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.search.finish import finished, plainest, ranked, relocated, simplest, simplified
from workbench.gap.search.fit import Fit, cost_of
from workbench.gap.search.screening import Screening, fitted_ahead, on_whole_records, one_more
from workbench.gap.search.search import Decision, Search, best_of_each, in_one_minimum, unexplained
from workbench.gap.search.settings import PAIRS, RANDOM, SEARCH, SELECTION
from workbench.structure.domain import Between


@dataclass(eq=False)
class Pairs:
    """State of a search for pairs of effects; a copy proceeds by itself.

    Attributes:
        ahead: pairs fitted to one-step-ahead predictions, best first.
        continued: those of them that were fitted to whole records too.
        found: pairs fitted to whole records, best first.
        ended: pairs that were refined, before and after.
        given: single effects for which a second one was searched.
        near_misses: pairs of which either half was kept and the other searched again.
        relocated_pairs: pairs that were tried from other places.
        explain: whether a pair of the first screening explains the records.
    """

    search: Search
    ahead: Sequence[Fit] = ()
    continued: Sequence[Fit] = ()
    found: Sequence[Fit] = ()
    ended: Sequence[Fit] = ()
    given: Sequence[Effect] = ()
    near_misses: Sequence[Fit] = ()
    relocated_pairs: Sequence[Fit] = ()
    explain: bool = False

    @classmethod
    def at_once(cls, search: Search, screened: Screening) -> "Pairs":
        """The likeliest of all pairs, by a screening with no effect given."""
        pairs = cls(search)
        if not search.is_over:
            search.progress("all pairs at once", 0.4)
            pairs.explain = pairs._add_and_check(
                fitted_ahead(search, screened.likeliest_pairs(SELECTION.fits_to_one_record))
            )
        return pairs

    def with_a_third(self) -> bool:
        """Whether the best pair and a third effect explain the records; tried if the pair's residual allows for one."""
        search, found = self.search, self.found
        if (
            not found
            or not search.near(found[0], PAIRS.max_residual_share)
            or search.near(found[0], SEARCH.negligible_share)
        ):
            return False
        search.progress("the best pair and a third effect", 0.45)
        pair = found[0].effects
        if self._explained_with_one_more(pair):
            return True
        best = self.found[0]
        if len(best.effects) <= len(pair) or not search.near(best, PAIRS.near_share):
            return False
        # given the third effect, one of the two may have to be replaced
        return self._explained_with_one_more(tuple(_by_contribution(search, best)[:-1]))

    def with_a_third_ahead(self, single: float) -> bool:
        """Whether the best pair one step ahead and a third effect explain the records.

        Two of three strong effects may be far from the records as a whole. One step ahead each must remove half of what
        the others leave; two of them may leave as little as the three. Else each is sought again beside the two others:
        a pair found without the third effect may have a wrong law or place.

        Args:
            single: cost of the best single effect, one step ahead.
        """
        search = self.search
        if self.explain or not self.ahead or search.is_over:
            return False
        pair = self.ahead[0]
        most = min(PAIRS.max_residual_share * (search.nominal_ahead - 1.0), SEARCH.halved * (single - 1.0))
        if pair.cost - 1.0 > most:
            return False
        search.progress("three effects at once", 0.45)
        three = one_more(search, pair.effects, search.reconstruction_with(pair.effects))
        if not three or three[0].cost - 1.0 > SEARCH.halved * (pair.cost - 1.0):
            return False
        twos = list(each_left_out(three[0].effects))
        pairs = fitted_ahead(search, twos)
        if pairs and pairs[0].cost < three[0].cost + SEARCH.alternative_margin and self._add_and_check(pairs):
            return True
        for two in twos:
            # beside nearly the pair from which the third was sought, it would be found again
            if not all(any(_are_nearly_equal(one, other) for other in pair.effects) for one in two):
                three = [*three, *one_more(search, two, search.reconstruction_with(two))]
        return self._add_and_check(sorted(three, key=lambda f: f.cost))

    def _explained_with_one_more(self, given: tuple[Effect, ...]) -> bool:
        """Whether these effects with one more explain the records."""
        if self.search.is_over:
            return False
        return self._add_and_check(one_more(self.search, given, self.search.reconstruction_with(given)))

    def by_exchange(self) -> bool:
        """Whether a pair with either half of the best one-step-ahead pair explains the records.

        A strong effect is found together with a wrong second one; its residual then locates the right one.
        """
        for _ in range(PAIRS.exchanges):
            if not self.ahead:
                return False
            best = self.ahead[0]
            if self.with_any(_by_contribution(self.search, best)):
                return True
            if self.ahead[0].cost > SEARCH.halved * best.cost:
                break
        return self._from_other_places()

    def with_any(self, halves: Sequence[Effect]) -> bool:
        """Whether a pair with one of these effects explains the records; effects tried before are skipped."""
        return any(self._with_effect(h) for h in halves if not any(_are_nearly_equal(h, other) for other in self.given))

    def _with_effect(self, effect: Effect) -> bool:
        """Whether a pair with this effect explains the records."""
        if self.search.is_over:
            return False
        self.search.progress(f"{effect.kind.words} and a second effect", 0.55 + 0.05 * min(len(self.given), 8))
        self.given = [*self.given, effect]
        return self._add_and_check(one_more(self.search, (effect,), _reconstruction_with(self.search, effect)))

    def decision(self, start: Fit) -> Decision:
        """The decision based on the pairs; `start` is the fit without effects."""
        likeliest = best_of_each(self.found or [start])[: PAIRS.max_sets]
        explaining = [f for f in likeliest if self.search.explains(f)]
        if explaining:
            plain = plainest(self.search, explaining)
            best, alternatives = ranked(self.search, self.search.in_parallel(simplest, plain))
            return Decision("explained", best, alternatives=alternatives)
        best, alternatives = ranked(self.search, likeliest)
        return unexplained(start, best, alternatives)

    def _add_and_check(self, ahead: Sequence[Fit]) -> bool:
        """Fit the best one-step-ahead pairs to whole records and refine them; whether one explains the records."""
        self.ahead = sorted((*self.ahead, *ahead), key=lambda f: f.cost)
        domain = self.search.rig.modes.domain
        enough = max(SELECTION.max_residual_ahead, SELECTION.max_share_ahead * self.search.nominal_ahead)
        promising = [f for f in ahead if f.cost < enough]
        fresh = [f for f in promising if not any(in_one_minimum(f, other, domain) for other in self.continued)]
        most = SEARCH.few_finalists if self.found else SEARCH.finalists
        self.continued = [*self.continued, *fresh[:most]]
        self._add(on_whole_records(self.search, fresh, most))
        near = [pair for pair in self.found[: SEARCH.few_finalists] if not _was_finished(pair, self.ended)]
        taken = _finished(self.search, near)
        self.ended = [*self.ended, *near, *taken]
        self._add(taken)
        return any(self.search.explains(pair) for pair in taken)

    def _from_other_places(self) -> bool:
        """Whether one of the best pairs, fitted from other places, explains the records, or a pair with either half."""
        search = self.search
        if search.is_over:
            return False
        likeliest = best_of_each(self.found)[: SEARCH.few_finalists]
        fresh = [
            f for f in likeliest if search.near(f, PAIRS.near_share) and not _was_finished(f, self.relocated_pairs)
        ]
        elsewhere = search.in_parallel(relocated, fresh)
        self.relocated_pairs = [*self.relocated_pairs, *fresh, *elsewhere]
        self._add(elsewhere)
        if any(search.explains(pair) for pair in elsewhere):
            return True
        if not self.found or not search.near(self.found[0], RANDOM.max_residual_share):
            return False
        best = self.found[0]
        if not all(best.cost - 1.0 < SEARCH.halved * (miss.cost - 1.0) for miss in self.near_misses):
            return False
        self.near_misses = [*self.near_misses, best]
        return self.with_any(best.effects[::-1])

    def _add(self, pairs: Sequence[Fit]) -> None:
        """Merge pairs into those found, best first."""
        self.found = sorted((*pairs, *self.found), key=lambda f: f.cost)


def _reconstruction_with(search: Search, effect: Effect) -> ForceReconstruction:
    """The force reconstructed with the effect, or without it if the simulation diverges with this effect alone."""
    astray = cost_of(search.rig, (effect,), search.data) > PAIRS.diverged_cost * search.nominal.mean()
    return search.reconstruction_with(() if astray else (effect,))


def _by_contribution(search: Search, found: Fit) -> list[Effect]:
    """The effects of a set, first the one whose removal increases the one-step-ahead cost most."""

    def cost_without(effect: Effect) -> float:
        return cost_of(search.rig, (*(e for e in found.effects if e is not effect), *search.held), search.ahead)

    return sorted(found.effects, key=cost_without, reverse=True)


def _are_nearly_equal(one: Effect, other: Effect) -> bool:
    """Whether two effects are the same, with nearly equal parameters."""
    if one.label != other.label or (isinstance(one.at, str | Between) and one.at != other.at):
        return False
    numbers = [name for name, value in one.values.items() if isinstance(value, float)]
    return all(np.isclose(one.values[n], other.values[n], rtol=PAIRS.parameter_change) for n in numbers)


def _was_finished(pair: Fit, ended: Sequence[Fit]) -> bool:
    """Whether the same set was refined before from nearly the same cost."""
    return any(
        pair.key == other.key and other.cost - 1.0 < PAIRS.same_minimum_ratio * (pair.cost - 1.0) for other in ended
    )


def _finished(search: Search, pairs: Sequence[Fit]) -> list[Fit]:
    """The pairs refined, and near misses in simpler forms too if none explains the records."""
    ended = search.in_parallel(finished, pairs)
    if any(search.explains(pair) for pair in ended):
        return ended
    near = [pair for pair in ended if search.near(pair, PAIRS.near_share)]
    return [*search.in_parallel(simplified, near), *(pair for pair in ended if pair not in near)]
