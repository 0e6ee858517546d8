"""Nominal modes that are off one by one, tried where smooth errors of mass and stiffness do not do."""

from dataclasses import replace

from workbench.gap.search.settings import STEPWISE
from workbench.gap.search.stepwise import Stepwise


def beside_modes(before: Stepwise) -> Stepwise | None:
    """What holds beside errors of each mode, in frequency and in shape: nothing, or effects; None where none does.

    Errors of a structure that is a little off everywhere are fewer and come first; those of its modes take linear
    effects for their own, so one effect more beside the few is asked for first. Where only errors larger than a careful
    model's leave nothing, an effect beside which they are such may be what is missing.

    Args:
        before: what holds without, its likeliest single effects tried.
    """
    nearest = before.nearest
    if nearest.excess(nearest.noise_power) > STEPWISE.of_modes * float(before.search.nominal.mean()):
        return None
    before.search.report("errors of each mode", 0.5)
    beside = Stepwise(replace(before.at_first, by_mode=True), before.tolerance, before.ahead)
    if beside.is_quiet:
        found = len(beside.last.effects)
        if not beside.is_believed:
            beside.calibrate()
        if beside.is_believed and beside.is_quiet:
            if _with_one_more(before, found):
                return before
            beside.run(most=0)
            return beside
        beside.singles = [step.effects for step in before.alone]
    else:
        again = beside.afresh(nearest.effects)
        left = nearest.excess(nearest.noise_power)
        if before.is_believed and again.excess(again.noise_power) > STEPWISE.halved * left:
            return None
        beside.known = [again] if len(again.effects) == 1 else []
    if not beside.by_singles():
        # gains that are off by more than any calibration, though the errors beside them are large
        return beside if beside.last.effects and beside.is_quiet and not before.is_closed else None
    beside.run()
    if not (beside.is_closed and beside.is_believed):
        return None
    return before if _with_one_more(before, len(beside.last.effects)) else beside


def _with_one_more(before: Stepwise, found: int) -> bool:
    """Whether one effect more beside the few errors of the structure does what errors of each mode do.

    Args:
        found: effects beside errors of each mode, gains that are off apart.
    """
    before.run(most=found + 1)
    return bool(before.is_believed and (before.plain or (before.last.effects and before.is_quiet)))
