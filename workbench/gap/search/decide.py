"""What the search may claim without a second effect: no gap, or one effect that explains it."""

from collections.abc import Sequence

from workbench.gap.effects.effect import apply_all
from workbench.gap.search.finish import finished, ranked, relocated, simplest
from workbench.gap.search.fit import Fit
from workbench.gap.search.outcome import Decision
from workbench.gap.search.search import Search, promise
from workbench.gap.search.settings import DECISION, RANDOM, SEARCH
from workbench.rig.simulate import is_stepped


def decide(search: Search, start: Fit, singles: list[Fit]) -> Decision | None:
    """What needs no second effect; None where nothing alone explains the records."""
    good = [f for f in singles if search.worthwhile(f, start.cost)]
    if search.explains(start) and not good:
        return Decision("none", start)
    ended = _ended(search, good[:4])
    explaining = [f for f in ended if search.explains(f)]
    if not explaining:
        near = [f for f in ended[:2] if search.near(f, RANDOM.near)]
        explaining = [f for f in search.side_by_side(relocated, near) if search.explains(f)]
    if explaining:
        best, rivals = ranked(search, [simplest(search, f) for f in explaining])
        return Decision("explained", best, rivals=rivals)
    if search.explains(start):
        return Decision("none", start)
    return None


def _ended(search: Search, fits: Sequence[Fit]) -> list[Fit]:
    """The fits, best first; those that more or finer steps may bring to the noise floor are taken to their end."""
    hopeful = [f for f in fits if f.cost < DECISION.far_behind * fits[0].cost]
    if fits and search.explains(fits[0]):
        near = fits[0].cost + SEARCH.rival
        hopeful = [
            f for f in hopeful if promise(f, SEARCH.further) < near or is_stepped(apply_all(search.rig, f.effects))
        ]
    return [*search.side_by_side(finished, hopeful), *(f for f in fits if f not in hopeful)]
