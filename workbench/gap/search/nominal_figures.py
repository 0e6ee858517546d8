"""Nominal figures that are off in a way of their own: of one mode, or of one record."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workbench.arrays import Floats
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import differing, figures_of
from workbench.gap.search.fit import finite_residual
from workbench.gap.search.jointly import Step, too_large
from workbench.gap.search.plain import PORT_GROUPS
from workbench.gap.search.search import Search
from workbench.gap.search.settings import RECORDS, STEPWISE
from workbench.gap.search.stepwise import Stepwise


@dataclass(frozen=True, eq=False)
class Deviations:
    """What one figure would deviate by in each record, all else as it is.

    Attributes:
        figure: of `figures_of`.
        values, spread: (n_records,) about their mean, and their standard deviations.
        left: mean square that records leave with them, in units of the noise.
        in_common: likewise with one deviation common to all records.
    """

    figure: str
    values: Floats
    spread: Floats
    left: float
    in_common: float

    @property
    def is_sure(self) -> bool:
        """Whether the two records that are farthest apart differ by more than chance."""
        i, j = int(self.values.argmin()), int(self.values.argmax())
        return bool(self.values[j] - self.values[i] > RECORDS.sure * np.hypot(self.spread[i], self.spread[j]))


def deviations(search: Search, effects: Sequence[Effect], figure: str) -> Deviations | None:
    """The deviation of each record that leaves least of it, of a few that are tried and a parabola between them.

    None where the structure cannot have one of them: a beam that is free at both ends bears no compression.

    Its standard deviation is that of a linear fit, from the scatter of its gradient over blocks of the record.

    Args:
        effects: errors of the nominal model among them.
        figure: of `figures_of`.
    """
    rig, data = apply_all(search.rig, effects), search.data
    names = [record.name for record in data.records]
    ends = np.cumsum([record.outputs.size for record in data.counted])[:-1]
    residuals = []  # by deviation tried, by record
    for deviation in RECORDS.tried:
        residual = finite_residual(differing(rig, figure, dict.fromkeys(names, deviation)), (), data)
        if residual is None:
            return None
        residuals.append(np.split(residual, ends))
    costs = np.array([[float(r @ r) / r.size for r in each] for each in residuals])
    least = [_least(cost) for cost in costs.T]
    values = np.array([at for at, _ in least])
    return Deviations(
        figure=figure,
        values=values - values.mean(),
        spread=np.array([_spread([each[i] for each in residuals], data.noise.size) for i in range(len(names))]),
        left=float(np.mean([cost for _, cost in least])),
        in_common=_least(costs.mean(axis=1))[1],
    )


def _least(costs: Floats) -> tuple[float, float]:
    """Where a parabola through the least of the costs at deviations tried, and its neighbours, is least; how small."""
    tried = np.array(RECORDS.tried)
    i = int(np.clip(costs.argmin(), 1, tried.size - 2))
    x = tried[i - 1 : i + 2]
    curve = np.polyfit(x, costs[i - 1 : i + 2], 2)
    at = float(np.clip(-0.5 * curve[1] / curve[0], *tried[[0, -1]])) if curve[0] > 0 else float(tried[costs.argmin()])
    return at, float(np.clip(np.polyval(curve, at), 0.0, costs.min()))


def _spread(residuals: Sequence[Floats], n_outputs: int) -> float:
    """Standard deviation of a record's deviation, by its residuals (n_values,) at each deviation tried."""
    i = int(np.clip(np.argmin([r @ r for r in residuals]), 1, len(RECORDS.tried) - 2))
    along = (residuals[i + 1] - residuals[i - 1]) / (RECORDS.tried[i + 1] - RECORDS.tried[i - 1])
    # by time, all sensors together
    gradient = (along * residuals[i]).reshape(n_outputs, -1).sum(axis=0)
    blocks = np.array([block.sum() for block in np.array_split(gradient, RECORDS.blocks)])
    return float(np.sqrt(((blocks - blocks.mean()) ** 2).sum()) / max(float(along @ along), 1e-300))


def likeliest(search: Search, step: Step) -> Deviations | None:
    """The figure whose deviations from record to record take much of what a step leaves above the noise, surely.

    None where no figure does, or there is one record.
    """
    if len(search.data.records) < 2:
        return None
    noise = float(step.noise_power.mean())
    found = [deviations(search, step.fit.effects, figure) for figure in figures_of(search.rig)]
    sure = [d for d in found if d is not None and d.is_sure]
    promising = [d for d in sure if d.in_common - d.left > RECORDS.enough * (d.in_common - noise)]
    return min(promising, key=lambda d: d.left * (RECORDS.clearly if d is found[0] else 1.0), default=None)


def beside_records(before: Stepwise) -> Stepwise | None:
    """What holds beside a figure of the nominal model that differs from record to record.

    What effects explain without is theirs: a law of the motion, too, makes records of other levels look stiffer. None
    where the records do not ask for such a figure, or it does not halve what they leave.

    Args:
        before: what holds without, its likeliest single effects tried; where a figure is asked for, it is run.
    """
    search, nearest = before.at_first, before.nearest
    asked = likeliest(search, nearest)
    if asked is None:
        return None
    before.run()
    if before.decision().outcome == "explained":
        return before
    search.report(f"{asked.figure} that differs from record to record", 0.5)
    varied = replace(search, differs=asked.figure)
    beside = Stepwise(varied, before.tolerance, before.ahead)
    if not (beside.is_believed or search.prior.shape):  # a profile bends to shapes that are off by themselves
        by_mode = Stepwise(replace(varied, by_mode=True), before.tolerance, before.ahead)
        # no effect of the structure hides among errors of ports and of records
        if by_mode.is_quiet and set(too_large(by_mode.last.errors)) <= {"damping", "record", *PORT_GROUPS}:
            by_mode.run(most=0)
            return by_mode
    noise = nearest.noise_power
    if beside.is_enough or beside.by_singles() or beside.nearest.excess(noise) < RECORDS.half * nearest.excess(noise):
        beside.run()
        return beside
    return None


def beside_modes(before: Stepwise) -> Stepwise | None:
    """What holds beside errors of each mode, in frequency and in shape: nothing, or effects; None where none does.

    Errors of a structure that is a little off everywhere are fewer and come first; those of its modes take linear
    effects for their own, so one effect more beside the few is asked for first. Where only errors larger than a careful
    model's leave nothing, an effect beside which they are such may be what is missing.

    Args:
        before: what holds without, its likeliest single effects tried.
    """
    nearest = before.nearest
    if before.at_first.prior.shape:  # asked from the start
        return None
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
