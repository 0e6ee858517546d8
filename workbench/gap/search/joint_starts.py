"""Joint fits with nominal errors from start values that lead to the global minimum."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from workbench.gap.effects.effect import Effect, apply_all, can_be, from_other_starts, nearest_possible
from workbench.gap.effects.nominal import JUST_LATE, in_group, nominal_errors
from workbench.gap.effects.ports import SENSOR_DELAY, SENSOR_LAG
from workbench.gap.search.fit import Chord, Fit, fit, slopes
from workbench.gap.search.jointly import JointFit, fit_jointly, loss
from workbench.gap.search.search import Search
from workbench.gap.search.settings import JOINT, STEPWISE

TIMING = (SENSOR_DELAY, SENSOR_LAG)  # kinds that delay the readings of a sensor


def fitted_to_quick(search: Search, sets: Sequence[tuple[Effect, ...]], step: JointFit) -> list[JointFit]:
    """The physically possible ones of some sets, fitted to the two most informative records.

    The nominal errors start as those of a step, with the sensitivities to them.
    """
    if not sets:
        return []
    known = slopes(search.rig, (step.errors,), search.quick, step.effects, search.workers)[1]
    return search.workers.map(
        lambda effects: fit_jointly(search, effects, step.errors, rounds=2, known=known),
        [effects for effects in sets if can_be(search.rig, (*effects, step.errors))],
    )


def fitted_to_all(search: Search, step: JointFit) -> JointFit:
    """The effects of a step fitted to all records.

    Nominal errors fitted without an effect have absorbed part of it and may be in another local minimum, so they start
    from zero; they also start from their values if that does not explain the records.
    """
    fresh = fit_from_zero(search, step.effects)
    if fresh.explains:
        return fresh
    return min(fresh, fit_jointly(search, step.effects, step.errors, rounds=2), key=lambda s: s.fit.cost)


def fit_from_zero(search: Search, effects: Sequence[Effect]) -> JointFit:
    """The effects and nominal errors that start from zero, fitted jointly to all records; the best of other starts."""
    sets = (effects, *from_other_starts(effects, search.rig))
    return min((_fitted_from_zero(search, each) for each in sets), key=partial(loss, search))


def _fitted_from_zero(search: Search, effects: Sequence[Effect]) -> JointFit:
    """The effects from their start values, with nominal errors from zero.

    With wrong frequencies, a simulation drifts out of phase over a record, so one-step-ahead predictions are fitted
    first.
    """
    zero_errors = nominal_errors(search.rig, search.prior)
    effects = nearest_possible(search.rig, effects, (zero_errors,))  # with nominal errors they could be larger
    zero_errors = with_reading_sides(search, zero_errors, effects)
    ahead = _fitted_ahead(search, effects, zero_errors)
    *others, errors = ahead.effects
    # with corrected frequencies, the sides of the accelerometers are clearer
    reassigned = with_reading_sides(search, replace(errors, target=replace(errors.target, late=(), early=())), others)
    if reassigned.target.late != zero_errors.target.late:
        ahead = min(ahead, _fitted_ahead(search, others, reassigned), key=lambda each: each.cost)
    interpolated = _interpolated(search, ahead)
    if interpolated is not ahead:
        ahead, zero_errors = interpolated, nominal_errors(search.rig, replace(search.prior, interpolated=True))
    found = fit_jointly(search, ahead.effects[:-1], ahead.effects[-1])
    if search.by_mode or found.excess(found.noise_power) < STEPWISE.astray * float(search.nominal.mean()):
        return found
    return min(found, fit_jointly(search, effects, zero_errors), key=lambda s: s.fit.cost)


def _interpolated(search: Search, ahead: Fit) -> Fit:
    """The one-step-ahead fit, or one with delays by linear interpolation of the readings if its cost is lower."""
    *effects, errors = ahead.effects
    delays = in_group(errors.values, "delay")
    is_late = any(effect.kind in TIMING for effect in effects)
    may_be_late = is_late or max(map(abs, delays.values()), default=0.0) > JOINT.surely_late
    if not may_be_late and (effects or ahead.cost < JOINT.straight):
        return ahead
    prior = replace(search.prior, interpolated=True)
    interpolated = _fitted_ahead(search, effects, nominal_errors(search.rig, prior, delays))
    return min(ahead, interpolated, key=lambda each: each.cost)


def _fitted_ahead(search: Search, effects: Sequence[Effect], errors: Effect) -> Fit:
    """Effects and nominal errors fitted to one-step-ahead predictions.

    The sensitivities are kept during a fit, and taken anew as long as the cost falls.
    """

    def on(sets: Sequence[Effect]) -> Fit:
        return fit(search.rig, sets, search.ahead, iterations=JOINT.iterations, workers=search.workers, chord=Chord())

    found = on((*effects, errors))
    for _ in range(JOINT.anew - 1):
        if found.falling < JOINT.still:
            break
        found = on(found.effects)
    return found


def surely_late(errors: Effect) -> Effect:
    """The nominal errors with no accelerometer assigned to a side of the input steps, except the clearly late ones."""
    late = tuple(name for name in errors.target.late if errors.values[f"delay_{name}"] > JOINT.surely_late)
    return replace(errors, target=replace(errors.target, late=late, early=()))


def with_reading_sides(search: Search, errors: Effect, effects: Sequence[Effect] = ()) -> Effect:
    """The nominal errors with each accelerometer assigned to the side of the input steps that it reads.

    With held inputs, acceleration jumps at the samples: a late sensor reads the value before the jump, others the one
    after. Sensors known to be late stay so. One-step-ahead predictions decide, since over whole records a wrong
    frequency looks like a delay.
    """
    known_late = errors.target.late
    accelerometers = tuple(
        s.name for s in search.rig.sensors if s.quantity == "acceleration" and s.name not in known_late
    )
    if not accelerometers or not errors.target.delay or errors.target.interpolated:
        return errors
    zero_delays = {**errors.values, **{f"delay_{name}": 0.0 for name in accelerometers}}

    def residual_with(delay: float) -> np.ndarray:
        tried = nominal_errors(search.rig, replace(errors.target, late=known_late, early=()), zero_delays)
        tried = replace(tried, values={**tried.values, **{f"delay_{name}": delay for name in accelerometers}})
        return search.ahead.residual(apply_all(search.rig, (*effects, tried)))

    # if the motion changes much between samples, a reading well before a jump differs from one just before
    delays = np.array([*(-delay for delay in JOINT.delays), 0.0, JUST_LATE, *JOINT.delays])
    residuals = {float(delay): residual_with(float(delay)) for delay in delays}
    before, at, after = residual_with(-JUST_LATE), residuals[0.0], residuals[JUST_LATE]
    with np.errstate(invalid="ignore"):  # of a diverging simulation nothing is late
        step, smooth = (search.ahead.by_channel(b - a).sum(axis=0) for a, b in ((at, after), (before, at)))
    powers = np.array([search.ahead.by_channel(residual).sum(axis=0) for residual in residuals.values()])
    rows = [
        j for j, s in enumerate(search.rig.sensors) if s.name in accelerometers and step[j] > JOINT.jump * smooth[j]
    ]
    best_delays = {search.rig.sensors[j].name: float(delays[powers[:, j].argmin()]) for j in rows}
    late = (*known_late, *(name for name, delay in best_delays.items() if delay > 0))
    early = tuple(name for name, delay in best_delays.items() if delay <= 0)
    starts = {**errors.values, **{f"delay_{name}": delay for name, delay in best_delays.items()}}
    return nominal_errors(search.rig, replace(errors.target, late=late, early=early), starts)
