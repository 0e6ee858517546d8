"""Which of two sets of effects fitted with nominal errors the records prefer, and which effects count at all."""

from collections.abc import Collection, Sequence

import numpy as np

from workbench.gap.effects.effect import Effect, Kind, apply_all, can_be
from workbench.gap.effects.ports import SENSOR_DELAY
from workbench.gap.search.fit import parameters_of
from workbench.gap.search.jointly import Step, likeliest_loss
from workbench.gap.search.plain import is_plausible_delay, is_plausible_gain_or_place
from workbench.gap.search.search import Search
from workbench.gap.search.settings import SEARCH


def loss(search: Search, step: Step) -> float:
    """The loss of a step: its cost, or minus the log-likelihood where input noise is modelled."""
    if not search.logged:
        return step.fit.cost
    return likeliest_loss(search, apply_all(search.rig, step.fit.effects))


def is_likelier(search: Search, best: Step, step: Step, least: float = SEARCH.significant) -> bool:
    """Whether the likelihood surely prefers a set to a smaller one, beyond the imperfection of any model."""
    extra, gain = max(best.fit.n_parameters - step.fit.n_parameters, 1), _gain(search, best, step)
    return gain > least and search.pays(gain, extra)


def surely_prefers(search: Search, best: Step, simpler: Step) -> bool:
    """Whether the best step explains the records and its likelihood is surely higher than that of a simpler one."""
    extra, gain = best.fit.n_parameters - simpler.fit.n_parameters, _gain(search, best, simpler)
    return best.explains and search.pays(gain, extra)


def _gain(search: Search, best: Step, step: Step) -> float:
    """Twice the log-likelihood ratio of one step over another, per measured value."""
    if not search.logged:
        return float(np.log(step.fit.cost / best.fit.cost))
    # each step has the input noise that fits its own residual, which is loud where it masks an effect
    return 2.0 * (loss(search, step) - loss(search, best)) / search.data.n_values


def size_of_set(search: Search, step: Step) -> tuple[int, int]:
    """Number of parameters and of effects: of as many parameters, one effect is simpler than two."""
    return len(parameters_of(search.rig, step.effects)), len(step.effects)


def noticeable(
    search: Search, effects: Sequence[Effect], beside: Sequence[Effect], tolerance: float
) -> tuple[Effect, ...]:
    """Those of the effects that alter the readings of some record by more than a tolerance, as a share of their rms.

    Args:
        search: records and nominal rig.
        effects: some of `beside`, which is the whole set.
        beside: the whole set.
        tolerance: of the rms.
    """
    data, rig = search.data, search.rig
    scales = [record.outputs.std(axis=1, keepdims=True) for record in data.counted]
    whole = data.predictions(apply_all(rig, beside))

    def altered(effect: Effect) -> float:
        others = [e for e in beside if e is not effect]
        if not can_be(rig, others):  # the others cannot exist without this effect
            return np.inf
        without = data.predictions(apply_all(rig, others))
        each = zip(whole, without, scales, strict=True)
        return max(float(np.sqrt((((a - b) / scale) ** 2).mean())) for a, b, scale in each)

    return tuple(effect for effect in effects if altered(effect) > tolerance)


def may_be_port_errors(search: Search, step: Step) -> bool:
    """Whether an effect of a step may be a plausible error of a port, which the nominal errors include already."""
    return is_timing(search, step) or any(is_plausible_gain_or_place(effect, search.rig) for effect in step.effects)


def is_timing(search: Search, step: Step, kinds: Collection[Kind] = (SENSOR_DELAY,)) -> bool:
    """Whether an effect of these kinds is a plausible error of a sensor's timing: a small delay."""
    return any(is_plausible_delay(effect, search) for effect in step.effects if effect.kind in kinds)
