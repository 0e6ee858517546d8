"""The stepwise selection with other nominal errors: of each mode, or of a parameter that varies between records."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workbench.arrays import Floats
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import differing, varying_parameters
from workbench.gap.search.errors_as_effects import TRANSDUCER_GROUPS
from workbench.gap.search.fit import finite_residual
from workbench.gap.search.jointly import JointFit, fit_from_zero, too_large
from workbench.gap.search.search import Search
from workbench.gap.search.settings import ERRORS, INTERVALS, RECORDS, SEARCH, STEPWISE
from workbench.gap.search.stepwise import Stepwise


@dataclass(frozen=True, eq=False)
class Deviations:
    """Estimated deviations of one nominal parameter in each record, all else fixed.

    Attributes:
        parameter: the parameter, of `varying_parameters`.
        values, spread: (n_records,) deviations from their mean, and their standard errors.
        left: mean square residual with these deviations, in units of the noise.
        in_common: likewise with one deviation common to all records.
    """

    parameter: str
    values: Floats
    spread: Floats
    left: float
    in_common: float

    @property
    def is_sure(self) -> bool:
        """Whether the two records that are farthest apart differ by more than chance."""
        i, j = int(self.values.argmin()), int(self.values.argmax())
        return bool(self.values[j] - self.values[i] > ERRORS.standard_errors * np.hypot(self.spread[i], self.spread[j]))


def deviations(search: Search, effects: Sequence[Effect], parameter: str) -> Deviations | None:
    """Least-squares deviations of a parameter in each record, by parabolic interpolation of the cost.

    None if the structure cannot have a deviation that is tried: a beam free at both ends bears no compression. The
    standard errors are those of a linear fit, from the scatter of the gradient over blocks of the record.

    Args:
        effects: nominal errors among them.
        parameter: the parameter, of `varying_parameters`.
    """
    rig, data = apply_all(search.rig, effects), search.data
    names = [record.name for record in data.records]
    ends = np.cumsum([record.outputs.size for record in data.counted])[:-1]
    residuals = []  # by deviation tried, by record
    for deviation in RECORDS.deviations:
        residual = finite_residual(differing(rig, parameter, dict.fromkeys(names, deviation)), (), data)
        if residual is None:
            return None
        residuals.append(np.split(residual, ends))
    costs = np.array([[float(r @ r) / r.size for r in each] for each in residuals])
    least = [_parabola_minimum(cost) for cost in costs.T]
    values = np.array([at for at, _ in least])
    return Deviations(
        parameter=parameter,
        values=values - values.mean(),
        spread=np.array([_standard_error([each[i] for each in residuals], data.noise.size) for i in range(len(names))]),
        left=float(np.mean([cost for _, cost in least])),
        in_common=_parabola_minimum(costs.mean(axis=1))[1],
    )


def _parabola_minimum(costs: Floats) -> tuple[float, float]:
    """Minimum (position, value) of the parabola through the least cost at `RECORDS.deviations` and its neighbours."""
    tried = np.array(RECORDS.deviations)
    i = int(np.clip(costs.argmin(), 1, tried.size - 2))
    x = tried[i - 1 : i + 2]
    curve = np.polyfit(x, costs[i - 1 : i + 2], 2)
    at = float(np.clip(-0.5 * curve[1] / curve[0], *tried[[0, -1]])) if curve[0] > 0 else float(tried[costs.argmin()])
    return at, float(np.clip(np.polyval(curve, at), 0.0, costs.min()))


def _standard_error(residuals: Sequence[Floats], n_outputs: int) -> float:
    """Standard error of a record's deviation, from its residuals (n_values,) at each deviation tried."""
    i = int(np.clip(np.argmin([r @ r for r in residuals]), 1, len(RECORDS.deviations) - 2))
    along = (residuals[i + 1] - residuals[i - 1]) / (RECORDS.deviations[i + 1] - RECORDS.deviations[i - 1])
    # by time, all sensors together
    gradient = (along * residuals[i]).reshape(n_outputs, -1).sum(axis=0)
    blocks = np.array([block.sum() for block in np.array_split(gradient, INTERVALS.blocks)])
    return float(np.sqrt(((blocks - blocks.mean()) ** 2).sum()) / max(float(along @ along), 1e-300))


def _varying_parameter(search: Search, step: JointFit) -> Deviations | None:
    """The parameter whose variation from record to record surely removes much of the residual of a step, or None."""
    if len(search.data.records) < 2:
        return None
    noise = float(step.noise_power.mean())
    candidates = [deviations(search, step.fit.effects, parameter) for parameter in varying_parameters(search.rig)]
    sure = [d for d in candidates if d is not None and d.is_sure]
    promising = [d for d in sure if d.in_common - d.left > RECORDS.least_removed_share * (d.in_common - noise)]
    return min(promising, key=lambda d: d.left * (RECORDS.max_ratio if d is candidates[0] else 1.0), default=None)


def with_record_deviations(before: Stepwise) -> Stepwise | None:
    """The stepwise selection with a nominal parameter that varies from record to record.

    Effects that explain the records without it are preferred: a nonlinear law also makes records of other levels look
    stiffer. None if no parameter varies significantly, or if its variation does not halve the residual.

    Args:
        before: the selection without, single effects tried; it is run if a parameter varies.
    """
    search, nearest = before.at_first, before.nearest
    varying = _varying_parameter(search, nearest)
    if varying is None:
        return None
    before.run()
    if before.decision().outcome == "explained":
        return before
    search.progress(f"{varying.parameter} that varies from record to record", 0.5)
    varying_search = replace(search, differs=varying.parameter)
    with_deviations = Stepwise(varying_search, before.ahead)
    # errors of profiles over-fit errors of single shapes
    if not (with_deviations.has_plausible_errors or search.prior.shape):
        by_mode = Stepwise(replace(varying_search, by_mode=True), before.ahead)
        # errors of transducers and records cannot absorb an effect in the structure
        if by_mode.is_noise_only and set(too_large(by_mode.last.errors)) <= {"damping", "record", *TRANSDUCER_GROUPS}:
            by_mode.run(most=0)
            return by_mode
    noise = nearest.noise_power
    if (
        with_deviations.is_sufficient
        or with_deviations.by_singles()
        or with_deviations.nearest.excess(noise) < SEARCH.halved * nearest.excess(noise)
    ):
        with_deviations.run()
        return with_deviations
    return None


def with_mode_errors(before: Stepwise) -> Stepwise | None:
    """The stepwise selection with nominal errors of the frequency and shape of each mode, or None if it fails.

    Errors of each mode absorb linear effects, so one more effect with the fewer errors of profiles is tried first. If
    only implausibly large errors of the modes explain the records, an effect that makes them plausible is searched.

    Args:
        before: the selection with errors of profiles, single effects tried.
    """
    nearest = before.nearest
    if before.at_first.prior.shape:  # errors of each mode were included from the start
        return None
    if nearest.excess(nearest.noise_power) > STEPWISE.mode_error_share * float(before.search.nominal.mean()):
        return None
    before.search.progress("errors of each mode", 0.5)
    with_modes = Stepwise(replace(before.at_first, by_mode=True), before.ahead)
    if with_modes.is_noise_only:
        n_effects = len(with_modes.last.effects)
        if not with_modes.has_plausible_errors:
            with_modes.calibrate()
        if with_modes.has_plausible_errors and with_modes.is_noise_only:
            if _explained_with_one_more(before, n_effects):
                return before
            with_modes.run(most=0)
            return with_modes
        with_modes.singles = [step.effects for step in before.fitted_singles]
    else:
        refitted = fit_from_zero(with_modes.search, nearest.effects)
        excess = nearest.excess(nearest.noise_power)
        if before.has_plausible_errors and refitted.excess(refitted.noise_power) > SEARCH.halved * excess:
            return None
        with_modes.known = [refitted] if len(refitted.effects) == 1 else []
    if not with_modes.by_singles():
        # gain errors too large for any calibration count even with large other errors
        return with_modes if with_modes.last.effects and with_modes.is_noise_only and not before.closes_gap else None
    with_modes.run()
    if not (with_modes.closes_gap and with_modes.has_plausible_errors):
        return None
    return before if _explained_with_one_more(before, len(with_modes.last.effects)) else with_modes


def _explained_with_one_more(before: Stepwise, found: int) -> bool:
    """Whether one more effect with errors of profiles explains the records as well as errors of each mode.

    Args:
        before: the selection with errors of profiles.
        found: number of effects with errors of each mode, wrong gains not counted.
    """
    before.run(most=found + 1)
    return bool(before.has_plausible_errors and (before.plain or (before.last.effects and before.is_noise_only)))
