"""The likeliest sets of effects, fitted to predictions one sample ahead and then to whole records."""

from collections.abc import Sequence

from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.limiting_cases import contained
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.search.fit import Fit, cost_of, fit
from workbench.gap.search.screening import Screening
from workbench.gap.search.search import Search, in_one_valley, promise, spread_over_kinds
from workbench.gap.search.settings import SEARCH, SELECTION
from workbench.rig.simulate import is_stepped
from workbench.structure.domain import NamedPoints


def one_more(
    search: Search, given: tuple[Effect, ...], evidence: Evidence, screened: Screening | None = None
) -> list[Fit]:
    """The likeliest fits, one sample ahead, of the given effects with one more, best first.

    Args:
        evidence: of the rig with the given effects.
        screened: what may be there beside them, where it is at hand.
    """
    screened = Screening.of(search, given, evidence) if screened is None else screened
    chosen: list[Effect] = []
    for effect in screened.likeliest():
        if sum(effect.kind is other.kind for other in chosen) < SELECTION.targets_a_kind:
            chosen.append(effect)
    found = fitted_ahead(search, [(*given, effect) for effect in chosen])
    if not (search.held and found):
        return found
    # beside errors that give way, a start that stands a little off its place comes to nothing
    there = fitted_ahead(search, [(*given, effect) for effect in _exchanged(found, screened)])
    return distinct_valleys(search, sorted((*found, *there), key=lambda f: f.cost))


def _exchanged(found: Sequence[Fit], screened: Screening) -> list[Effect]:
    """Linear kinds of the structure, each where the likeliest of others stand; other faults of the likeliest port."""

    def is_linear(effect: Effect) -> bool:
        return effect.kind.path == "structure" and not effect.kind.nonlinear and effect.at is not None

    starts, best = screened.likeliest(), found[0].effects[-1]
    of_port = [e for e in starts if isinstance(e.target, str) and e.target == best.target and e.kind is not best.kind]
    if isinstance(screened.domain, NamedPoints):
        return of_port
    likeliest = [f.effects[-1] for f in spread_over_kinds(found, 1) if is_linear(f.effects[-1])][: SELECTION.exchanged]
    linear = {effect.kind: effect for effect in reversed(starts) if is_linear(effect)}
    there = [e.moved_to(one.at) for one in likeliest for e in linear.values() if e.kind is not one.kind]
    return [*there, *of_port]


def pairs_at_once(search: Search, screened: Screening) -> list[Fit]:
    """The likeliest fits, one sample ahead, of any two effects, best first.

    Args:
        screened: with nothing given.
    """
    return fitted_ahead(search, screened.likeliest_pairs(SELECTION.tried))


def is_promising(search: Search, candidate: Fit) -> bool:
    """Whether a fit one sample ahead may explain whole records."""
    return candidate.cost < max(SELECTION.promising, SELECTION.promising_share * search.nominal_ahead)


def fitted_ahead(search: Search, sets: Sequence[tuple[Effect, ...]]) -> list[Fit]:
    """Fits of sets to predictions one sample ahead, best first: all to the most telling record, fewer to another too.

    Args:
        sets: the likeliest first.
    """

    first, both = search.first_ahead, search.ahead  # before helpers are forked, which would each find them

    def ahead(task: tuple[tuple[Effect, ...], bool, int]) -> Fit:
        effects, alone, iterations = task
        data = first if alone else both
        return fit(search.rig, effects, data, held=search.held, iterations=iterations, tolerance=1e-4)

    with search.workers.standing(ahead) as share:
        tried = share([(effects, True, 2) for effects in sets[: SELECTION.tried]])
        likely = sorted(tried, key=promise)[: SELECTION.likely]
        fits = distinct_valleys(search, sorted(share([(f.effects, False, 3) for f in likely]), key=promise))
        falling = [
            f for f in fits[: SELECTION.likeliest] if f.falling and promise(f) < SELECTION.far_behind * promise(fits[0])
        ]
        longer = share([(f.effects, False, 8) for f in falling])
    return distinct_valleys(search, sorted((*longer, *(f for f in fits if f not in falling)), key=lambda f: f.cost))


def distinct_valleys(search: Search, fits: Sequence[Fit]) -> list[Fit]:
    """The fits without those that came to where a better one of the same set came."""
    distinct: list[Fit] = []
    for candidate in fits:
        if not any(in_one_valley(candidate, other, search.rig.modes.domain) for other in distinct):
            distinct.append(candidate)
    return distinct


def on_whole_records(
    search: Search, ahead: Sequence[Fit], most: int, *, to_cost: float = float("inf"), at_first: int | None = None
) -> list[Fit]:
    """The best of fits ahead, fitted to whole records, best first.

    Args:
        ahead: best first.
        most: at most so many, and none that is far behind.
        to_cost: what a fit must come to, to be of use; those on their way to more stay where they are.
        at_first: iterations before that is asked; as the settings have it unless given.
    """
    at_first = SELECTION.at_first if at_first is None else at_first
    close = [f for f in ahead[:most] if f.cost < SELECTION.close * ahead[0].cost]
    simpler = contained(close[0].effects, search.rig) if close else set()
    first = [f for f in close if f is close[0] or f.key in simpler]
    fits = search.workers.map(lambda f: by_continuation(search, f.effects, at_first), first)
    rest = [f for f in close if f not in first]
    if any(search.explains(f) for f in fits):
        rest = [f for f in rest if f.cost < ahead[0].cost + SEARCH.rival]
    others = _none_that_contains(search, fits, rest)
    more = search.workers.map(lambda f: by_continuation(search, f.effects, at_first), others)
    fits = sorted((*fits, *more), key=promise)
    fits = _none_that_contains(search, fits, fits)
    to_cost = min([to_cost, *(f.cost + SEARCH.rival for f in fits if search.explains(f))])
    running = [f for f in fits if f.falling and promise(f) < SELECTION.running * promise(fits[0])]
    running = [f for f in running if promise(f, SEARCH.further) < to_cost]
    longer = search.workers.map(lambda f: whole(search, f.effects, 25), running)
    return sorted((*longer, *(f for f in fits if f not in running)), key=lambda f: f.cost)


def _none_that_contains(search: Search, fits: Sequence[Fit], others: Sequence[Fit]) -> list[Fit]:
    """The others but those that come, at bounds of their numbers, to a fit that leaves nothing worth an effect."""
    enough = {f.key for f in fits if f.cost < 1.0 + SEARCH.significant and search.explains(f)}
    return [f for f in others if enough.isdisjoint(contained(f.effects, search.rig))]


def by_continuation(search: Search, effects: tuple[Effect, ...], iterations: int) -> Fit:
    """The set fitted to predictions one sample ahead, which go smoothly with its numbers, then to whole records.

    Where a stiff law lets motions run apart, half a percent of a place is too far for whole records to tell the way;
    where a thousandth of a percent is, the observer gain is lowered by steps (continuation).

    Args:
        iterations: on whole records, at most.
    """
    rig = apply_all(search.rig, effects)
    if is_stepped(rig) and not search.held and search.data.observer is None:
        for loose in SELECTION.continuation:
            data = search.data.one_step_ahead(rig, loose).finely(SELECTION.fine)
            held = fit(search.rig, effects, data, iterations=8, tolerance=1e-4)
            effects = held.effects
            if (
                held.cost > SELECTION.promising
                or cost_of(search.rig, effects, search.data.finely(SELECTION.fine)) < SELECTION.at_hand
            ):
                break
    return whole(search, effects, iterations)


def whole(search: Search, effects: tuple[Effect, ...], iterations: int) -> Fit:
    """The set fitted to whole records."""
    data = search.data.finely(SELECTION.fine)
    return fit(search.rig, effects, data, held=search.held, iterations=iterations)
