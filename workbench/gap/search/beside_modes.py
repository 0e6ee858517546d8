"""Nominal modes that are off one by one, tried where smooth errors of mass and stiffness do not do."""

from dataclasses import replace

from workbench.gap.search.settings import STEPWISE
from workbench.gap.search.stepwise import Stepwise


def beside_modes(before: Stepwise) -> Stepwise | None:
    """What holds beside errors of each mode, in frequency and in shape: nothing, or effects; None where none does.

    Errors of a structure that is a little off everywhere are fewer and come first; those of its modes take linear
    effects for their own, so where they alone would do, one effect beside the few is asked for once more.

    Args:
        before: what holds without, its likeliest single effects tried.
    """
    nearest = before.nearest
    if nearest.excess(nearest.noise_power) > STEPWISE.of_modes * float(before.search.nominal.mean()):
        return None
    before.search.report("errors of each mode", 0.5)
    beside = Stepwise(replace(before.at_first, by_mode=True), before.tolerance, before.ahead)
    if beside.is_quiet and beside.is_believed:
        before.run(most=1)
        if before.is_believed and (before.plain or (before.last.effects and before.is_quiet)):
            return before
        beside.run(most=0)
        return beside
    again = beside.afresh(nearest.effects)
    if again.excess(again.noise_power) > STEPWISE.halved * nearest.excess(nearest.noise_power):
        return None
    if not beside.by_singles():
        return None
    beside.run()
    return beside if beside.is_closed and beside.is_believed else None
