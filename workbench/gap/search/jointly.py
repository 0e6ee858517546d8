"""Effects fitted jointly with nominal errors or input noise, whose variances are estimated from the records."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from workbench.arrays import Floats, scaled_inverse
from workbench.gap.effects.effect import Effect, apply_all, can_be, from_other_starts, nearest_possible
from workbench.gap.effects.nominal import JUST_LATE, NominalPrior, group_of, in_group, nominal_errors, weight_of
from workbench.gap.effects.transducers import SENSOR_DELAY, SENSOR_LAG
from workbench.gap.prediction.noise import (
    LEAST_LOGGED,
    are_coloured,
    is_noise_alone,
    likeliest_share,
    logging_noise,
    noise_found,
)
from workbench.gap.prediction.residuals import FitData
from workbench.gap.search.fit import Chord, Fit, fit, parameters_of, slopes
from workbench.gap.search.search import Search
from workbench.gap.search.settings import FIT, INPUTS, JOINT, SEARCH, SELECTION, STEPWISE
from workbench.rig.rig import Rig
from workbench.structure.domain import Between, NamedPoints

TIMING = (SENSOR_DELAY, SENSOR_LAG)  # kinds that delay the readings of a sensor


def are_plausible(errors: Effect, *, damping: bool = True) -> bool:
    """Whether nominal errors are as small as in a careful laboratory; those of damping count if `damping`."""
    return not [group for group in too_large(errors) if damping or group != "damping"]


def too_large(errors: Effect, *, share: float = JOINT.plausible_share) -> list[str]:
    """Groups of nominal errors that are larger than this share of the largest plausible ones."""
    return [group for group, size in _largest_plausible(errors.target) if size_of(errors, group) >= share * size]


def size_of(errors: Effect, group: str) -> float:
    """Posterior rms of a group of nominal errors, estimates and their variances together."""
    values, spread = _scaled_errors(errors, group)
    return float(np.sqrt(np.mean(values**2 + spread**2))) if values.size else 0.0


def _largest_plausible(prior: NominalPrior) -> list[tuple[str, float]]:
    """(group, largest plausible standard deviation); with errors of each mode, damping ratios are mere guesses."""
    return [
        (g, JOINT.max_guessed_damping if g == "damping" and prior.by_mode else size) for g, size in JOINT.max_prior_std
    ]


@dataclass(frozen=True, eq=False)
class JointFit:
    """A set of effects fitted jointly with nominal errors.

    Attributes:
        fit: of the effects and the nominal errors, which come last.
        sensor_noise: (n_outputs,) estimated noise power of each sensor over the stated one.
        logged: input noise, as a share of the inputs' rms.
        noise_power: (n_records, n_outputs) power of sensor and input noise over the stated power of sensor noise.
        others: the candidates that this set was selected from, fitted to all records.
    """

    fit: Fit
    sensor_noise: np.ndarray
    logged: float
    noise_power: np.ndarray
    others: "tuple[JointFit, ...]" = ()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects without the nominal errors."""
        return self.fit.effects[:-1]

    @property
    def errors(self) -> Effect:
        """The nominal errors."""
        return self.fit.effects[-1]

    @property
    def is_plausible(self) -> bool:
        """Whether the nominal errors are as small as in a careful laboratory."""
        return are_plausible(self.errors)

    @property
    def explains(self) -> bool:
        """Whether the residual is at the noise floor of the sensors."""
        return self.is_near(self.sensor_noise, STEPWISE.noise_excess)

    def is_near(self, noise_power: np.ndarray, share: float) -> bool:
        """Whether the residual power exceeds a noise power by less than this share of it."""
        return self.excess(noise_power) < share * float(noise_power.mean())

    def description(self, noise_power: np.ndarray, *, of_errors_alone: bool = False) -> float:
        """Description length, nats, of the nominal errors, and of the residual above noise unless `of_errors_alone`."""
        left = 0.0
        if not of_errors_alone:
            left = JOINT.residual_nats * np.log1p(self.excess(noise_power) / float(noise_power.mean()))
        for group, small in JOINT.negligible_std:
            left += len(in_group(self.errors.values, group)) * np.log(max(size_of(self.errors, group), small) / small)
        return float(left)

    def excess(self, noise_power: np.ndarray) -> float:
        """Residual power above a noise power (n_records, n_outputs), mean of all channels, in units of the stated."""
        return float(np.maximum(self.fit.cost_by_channel - noise_power, 0.0).mean())


def loss(search: Search, step: JointFit) -> float:
    """The cost of a step; with input noise minus the log-likelihood, each step with the level that fits its residual.

    Input noise is loud where it masks an effect.
    """
    if not search.logged:
        return step.fit.cost
    rig = apply_all(search.rig, step.fit.effects)
    return likeliest_share(rig, search.data, search.data.differences(rig)).loss


def _gain(search: Search, best: JointFit, step: JointFit) -> float:
    """Twice the log-likelihood ratio of one step over another, per measured value."""
    if not search.logged:
        return float(np.log(step.fit.cost / best.fit.cost))
    return 2.0 * (loss(search, step) - loss(search, best)) / search.data.n_values


def is_likelier(search: Search, best: JointFit, step: JointFit, least: float = SEARCH.significant_gain) -> bool:
    """Whether the likelihood surely prefers a set to a smaller one, beyond the imperfection of any model."""
    extra, gain = max(best.fit.n_parameters - step.fit.n_parameters, 1), _gain(search, best, step)
    return gain > least and search.is_justified(gain, extra)


def surely_prefers(search: Search, best: JointFit, simpler: JointFit) -> bool:
    """Whether the best step explains the records and its likelihood is surely higher than that of a simpler one."""
    extra, gain = best.fit.n_parameters - simpler.fit.n_parameters, _gain(search, best, simpler)
    return best.explains and search.is_justified(gain, extra)


def fit_jointly(
    search: Search,
    effects: Sequence[Effect],
    errors: Effect,
    *,
    rounds: int | None = None,
    known: np.ndarray | None = None,
    until_convergence: bool = False,
) -> JointFit:
    """Effects and nominal errors fitted jointly, with prior variances of the errors by evidence maximisation.

    The most probable variances follow MacKay, Neural Computation 4 (1992) 415: s² = Σ a² / Σ (1 - v / s²) over the
    errors a of a group and their posterior variances v. In each round the residual of the last counts as noise, so that
    the nominal errors do not over-fit an effect that is still missing.

    Args:
        effects: with start values.
        errors: nominal errors, with start values.
        rounds: updates of the prior variances; None for `JOINT.rounds`.
        known: (n_values, n_errors) sensitivities to the nominal errors on the two most informative records, in units
            of the stated noise; if given, only these records are fitted.
        until_convergence: fit until the cost is stationary, with fine substeps.
    """
    rounds = JOINT.rounds if rounds is None else rounds
    whole, before = search.data.finely(SELECTION.substeps) if until_convergence else search.data, np.inf
    if until_convergence:
        errors = replace(errors, target=replace(errors.target, waves=JOINT.final_waves))
    if known is None:
        errors = with_all_groups(search, errors)
    n_counted, chord = 0, Chord(known)
    for i in range(JOINT.max_rounds):
        # the two most informative records come first
        on_quick = known is not None or (i == 0 and not until_convergence)
        data = search.quick.stepped(whole.substeps) if on_quick else whole
        power = _residual_level(search.rig, (*effects, errors), data)
        if power > (1.0 - (JOINT.final_round_tolerance if until_convergence else JOINT.round_tolerance)) * before:
            break
        fell, is_first = power < JOINT.large_decrease * before, not np.isfinite(before)
        n_counted += not fell or is_first
        # new sensitivities: of other records, far from the last ones, in the final fit, or if there are few
        if known is None and (fell or is_first or until_convergence or len(errors.values) < JOINT.few_errors):
            chord = Chord()
        before = power if known is not None or not on_quick else np.inf
        found = _fit_at_level(search, (*effects, errors), data, power, chord, is_last=until_convergence)
        *effects, errors = found.effects
        errors = _with_prior_stds(errors, _next_prior_stds(errors))
        if n_counted == rounds:
            break
    updated = replace(found, effects=(*effects, errors))
    if until_convergence:
        return evaluated(search, updated, whole.substeps)
    last = evaluated(search, _without_negligible_groups(updated), whole.substeps)
    # far above the noise floor, the prior variances mean little
    if known is not None or not last.is_near(last.noise_power, JOINT.fixed_point_residual):
        return last
    at_limit = _at_fixed_point(search, found, whole, chord)
    if at_limit is found:
        return last
    limit = evaluated(search, _without_negligible_groups(at_limit), whole.substeps)
    # large nominal errors at the fixed point have fitted something else
    return min((limit, last), key=lambda step: step.description(limit.noise_power))


def _at_fixed_point(search: Search, found: Fit, data: FitData, chord: Chord) -> Fit:
    """The fit with the prior standard deviations of the nominal errors at the fixed point of MacKay's update.

    The update alone converges slowly where the records hardly distinguish the errors; the cost is then flat.
    """
    for _ in range(JOINT.fixed_point_fits):
        errors = found.effects[-1]
        sizes = _limit_of_prior_stds(search, found)
        changes = [abs(np.log(size / getattr(errors.target, group))) for group, size in sizes.items()]
        if max(changes, default=0.0) < JOINT.prior_change:
            break
        effects = (*found.effects[:-1], _with_prior_stds(errors, sizes))
        kept = Chord() if len(effects[-1].values) < JOINT.few_errors else chord
        power = _residual_level(search.rig, effects, data)
        found = _fit_at_level(search, effects, data, power, kept, damping=JOINT.fixed_point_damping)
    return found


def _fit_at_level(
    search: Search,
    effects: Sequence[Effect],
    data: FitData,
    power: float,
    chord: Chord,
    *,
    is_last: bool = False,
    damping: float = FIT.damping,
) -> Fit:
    """A fit in which a residual of that power counts as noise, by the settings of a round or of the last fit."""
    return fit(
        search.rig,
        effects,
        data.tempered(power),
        iterations=JOINT.final_iterations if is_last else JOINT.iterations,
        tolerance=JOINT.final_tolerance if is_last else JOINT.tolerance,
        workers=search.workers,
        chord=chord,
        damping=damping,
    )


def _residual_level(rig: Rig, effects: Sequence[Effect], data: FitData) -> float:
    """Residual power of effects and nominal errors, in units of the noise power; at least 1."""
    left = data.residual(apply_all(rig, effects))
    with np.errstate(over="ignore"):  # the simulation may diverge
        return max(float(left @ left) / left.size, 1.0)


def _with_prior_stds(errors: Effect, sizes: dict[str, float]) -> Effect:
    """The nominal errors with other prior standard deviations, by group."""
    return replace(errors, target=replace(errors.target, **sizes))


def evaluated(search: Search, found: Fit, substeps: int | None = None) -> JointFit:
    """A fit of effects and nominal errors (last) with its residual and noise evaluated on all records of a search.

    Args:
        substeps: of a sample; None for those of the search.
    """
    data, rig = search.data.stepped(substeps or search.data.substeps), apply_all(search.rig, found.effects)
    if data.whiteners:
        by_channel = data.by_channel(data.residual(rig))
        of_noise = np.ones_like(by_channel)
        step = replace(found, cost=float(by_channel.mean()), cost_by_channel=by_channel)
        return JointFit(step, of_noise[0], search.logged, of_noise)
    residuals = data.differences(rig)
    with np.errstate(over="ignore", invalid="ignore"):
        by_channel = np.array([((r / data.noise[:, None]) ** 2).mean(axis=1) for r in residuals])
    if not np.isfinite(by_channel).all():  # the simulation diverged, so its residual shows no noise
        by_channel = np.full_like(by_channel, np.inf)
        step = replace(found, cost=np.inf, cost_by_channel=by_channel)
        return JointFit(step, np.ones(data.noise.size), 0.0, np.ones_like(by_channel))
    with np.errstate(over="ignore", invalid="ignore"):  # powers of its prewhitened residual may overflow
        coloured = are_coloured(residuals)
        credible = np.inf if is_noise_alone(residuals, data.counted, coloured) else _largest_noise_ratio(data, coloured)
        sensor_noise = np.minimum(noise_found(residuals, coloured) / data.noise, credible) ** 2
    step = replace(found, cost=float(by_channel.mean()), cost_by_channel=by_channel)
    per_unit = search.logging_noise
    logged = logging_noise(by_channel, sensor_noise, per_unit)
    return JointFit(step, sensor_noise, logged, sensor_noise + logged**2 * per_unit)


def _largest_noise_ratio(data: FitData, coloured: np.ndarray) -> Floats:
    """Largest credible ratio of estimated to stated noise, by sensor (n_outputs,)."""
    guessed = np.array([name in data.guessed for name in data.records[0].output_names])
    return np.where(guessed & coloured, JOINT.credible_guessed_noise, JOINT.credible_noise)


def _next_prior_stds(errors: Effect) -> dict[str, float]:
    """Prior standard deviation of each group of nominal errors after one of MacKay's updates."""
    prior = errors.target
    return {
        g: _next_prior_std(_scaled_errors(errors, g), getattr(prior, g), widest)
        for g, widest in _largest_plausible(prior)
        if g in prior.groups
    }


def _next_prior_std(scaled: Floats, size: float, widest: float) -> float:
    """Prior standard deviation of a group after one of MacKay's updates.

    Args:
        scaled: (2, n_errors) the errors and their posterior standard deviations.
        size: prior standard deviation before.
        widest: the largest plausible one.
    """
    values, spread = scaled
    n_determined = np.clip(1.0 - (spread / size) ** 2, 0.0, 1.0).sum()
    return float(np.clip(np.sqrt((values**2).sum() / max(n_determined, 1e-3)), JOINT.min_prior_share * widest, widest))


def _limit_of_prior_stds(search: Search, found: Fit) -> dict[str, float]:
    """Fixed point of `_next_prior_stds`, by group, with errors and effects re-estimated to first order.

    No simulation is needed: where the records hardly distinguish the errors, the cost is flat.
    """
    errors, prior = found.effects[-1], found.effects[-1].target
    each = [parameter for _, parameter in parameters_of(search.rig, found.effects)]
    own = each[len(each) - len(errors.values) :]
    of_errors = np.arange(len(each) - len(own), len(each))
    free = np.array([parameter.to_free(errors.values[parameter.name]) for parameter in own])
    groups = np.array([group_of(parameter.name) for parameter in own])
    sizes = {group: float(getattr(prior, group)) for group in prior.groups}
    unit = np.array([parameter.prior_std for parameter in own], float) / [sizes[g] for g in groups]
    widest = dict(_largest_plausible(prior))

    def precision() -> Floats:
        diagonal: Floats = np.zeros(len(each))
        diagonal[of_errors] = 1.0 / (unit * [sizes[g] for g in groups]) ** 2
        return diagonal

    assert found.normal is not None
    start = precision()
    for _ in range(JOINT.fixed_point_updates):
        now, before = precision(), dict(sizes)
        inverse = scaled_inverse(found.normal + np.diag(now - start))
        change = inverse[of_errors][:, of_errors] @ ((start - now)[of_errors] * free)
        scaled = np.array([free + change, np.sqrt(np.maximum(np.diag(inverse)[of_errors], 0.0))]) / unit
        for group in sizes:
            sizes[group] = _next_prior_std(scaled[:, groups == group], sizes[group], widest[group])
        if all(abs(np.log(sizes[g] / before[g])) < 0.1 * JOINT.prior_change for g in sizes):
            break
    return sizes


def _scaled_errors(errors: Effect, group: str) -> Floats:
    """Nominal errors of a group and their posterior standard deviations, each over its weight: (2, n_errors)."""
    names = list(in_group(errors.values, group))
    weights = [weight_of(name, errors.target) for name in names]
    each = [[found.get(name, 0.0) for name in names] for found in (errors.values, errors.std)]
    scaled: Floats = np.array(each).reshape(2, len(names)) / np.array(weights)
    return scaled


def _without_negligible_groups(found: Fit) -> Fit:
    """The fit without the groups of nominal errors whose prior standard deviation has fallen to its lower bound."""
    *effects, errors = found.effects
    none = [
        g
        for g, widest in _largest_plausible(errors.target)
        if getattr(errors.target, g) <= 1.01 * JOINT.min_prior_share * widest
    ]
    none = [group for group in none if group != "delay" or not errors.target.late]
    kept = {name: value for name, value in errors.values.items() if group_of(name) not in none}
    deviations = {name: errors.std[name] for name in kept if name in errors.std}
    target = replace(errors.target, **dict.fromkeys(none, 0.0))
    return replace(found, effects=(*effects, replace(errors, target=target, values=kept, std=deviations)))


def with_all_groups(search: Search, errors: Effect) -> Effect:
    """The nominal errors with all groups; those that were dropped start from zero with their original priors."""
    before = search.prior
    closed = {g: getattr(before, g) for g, _ in JOINT.max_prior_std if not getattr(errors.target, g)}
    return nominal_errors(search.rig, replace(errors.target, **closed), errors.values)


def with_all_errors(search: Search, found: Fit) -> Fit:
    """The fit with nominal errors of every group, so that intervals allow for each.

    Groups that were dropped get the smallest prior standard deviation. The mode shapes have errors at the named points
    of the effects too: a factor common to all modes there scales an effect, which no record shows. Where the
    transducers have errors of their shapes, all are fitted again together.
    """
    errors = next((e for e in found.effects if isinstance(e.target, NominalPrior)), None)
    if errors is None:
        return found
    points, groups = _points_of(search.rig, found.effects), replace(search, by_mode=errors.target.by_mode).prior.groups
    closed = {
        g: JOINT.min_prior_share * size
        for g, size in JOINT.max_prior_std
        if g in set(groups) - set(errors.target.groups)
    }
    target = replace(errors.target, waves=JOINT.final_waves, points=points, **closed)
    all_errors = nominal_errors(search.rig, target, errors.values)
    effects = tuple(all_errors if e is errors else e for e in found.effects)
    if not errors.target.shape or not points:
        return replace(found, effects=effects)
    data = search.data.finely(SELECTION.substeps)
    power = _residual_level(search.rig, effects, data)
    fitted = _fit_at_level(search, effects, data, power, Chord(), is_last=True)
    return evaluated(search, fitted, data.substeps).fit


def _points_of(rig: Rig, effects: Sequence[Effect]) -> tuple[str, ...]:
    """The named points at which effects act; none of a structure that is known all over."""
    if not isinstance(rig.modes.domain, NamedPoints):
        return ()
    each = (e.at if isinstance(e.at, Between) else (e.at,) for e in effects if e.at is not None)
    return tuple(dict.fromkeys(str(point) for points in each for point in points))


def with_input_noise(search: Search, fitted: Fit, sensor_noise: np.ndarray) -> Search | None:
    """The search with input noise of the likeliest level given a fit, or None if that does not whiten the residual.

    None also if most records would need more noise than any logger has: a missing law grows with the level too.

    Args:
        search: without input noise.
        fitted: effects and nominal errors.
        sensor_noise: (n_outputs,) noise power of each sensor estimated without input noise, over the stated one.
    """
    rig = apply_all(search.rig, fitted.effects)
    residuals, found = search.data.differences(rig), search.with_noise(np.sqrt(sensor_noise) * search.data.noise)
    # input noise inflates the estimate of sensor noise, so the stated sensor noise is tried as well
    shares = [likeliest_share(rig, s.data, residuals) for s in (search, found)]
    (share, _, is_beyond), best = min(zip(shares, (search, found), strict=True), key=lambda each: each[0].loss)
    if share < LEAST_LOGGED or is_beyond:
        return None
    noisy = best.with_input_noise(rig, share)
    white = evaluated(noisy, fitted).fit
    if SEARCH.near_noise < white.cost < INPUTS.over_fitted_share * fitted.cost:
        fitted = white = fit_jointly(noisy, fitted.effects[:-1], fitted.effects[-1]).fit
        rig = apply_all(search.rig, fitted.effects)
        residuals = search.data.differences(rig)
    if white.cost > SEARCH.near_noise:
        return None
    for _ in range(INPUTS.noise_updates):  # sensor noise from the power of the innovations
        best = best.with_noise(best.data.noise * np.sqrt(white.cost_by_channel.mean(axis=0)))
        noisy = best.with_input_noise(rig, likeliest_share(rig, best.data, residuals).share)
        white = evaluated(noisy, fitted).fit
    return noisy


# Start values that lead to the global minimum


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
    if search.by_mode or found.excess(found.noise_power) < STEPWISE.diverged_share * float(search.nominal.mean()):
        return found
    return min(found, fit_jointly(search, effects, zero_errors), key=lambda s: s.fit.cost)


def _interpolated(search: Search, ahead: Fit) -> Fit:
    """The one-step-ahead fit, or one with delays by linear interpolation of the readings if its cost is lower."""
    *effects, errors = ahead.effects
    delays = in_group(errors.values, "delay")
    is_late = any(effect.kind in TIMING for effect in effects)
    may_be_late = is_late or max(map(abs, delays.values()), default=0.0) > JOINT.certain_delay
    if not may_be_late and (effects or ahead.cost < SEARCH.near_noise):
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
    for _ in range(JOINT.max_fits_ahead - 1):
        if found.falling < JOINT.least_decrease_ahead:
            break
        found = on(found.effects)
    return found


def surely_late(errors: Effect) -> Effect:
    """The nominal errors with no accelerometer assigned to a side of the input steps, except the clearly late ones."""
    late = tuple(name for name in errors.target.late if errors.values[f"delay_{name}"] > JOINT.certain_delay)
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
        j
        for j, s in enumerate(search.rig.sensors)
        if s.name in accelerometers and step[j] > JOINT.jump_ratio * smooth[j]
    ]
    best_delays = {search.rig.sensors[j].name: float(delays[powers[:, j].argmin()]) for j in rows}
    late = (*known_late, *(name for name, delay in best_delays.items() if delay > 0))
    early = tuple(name for name, delay in best_delays.items() if delay <= 0)
    starts = {**errors.values, **{f"delay_{name}": delay for name, delay in best_delays.items()}}
    return nominal_errors(search.rig, replace(errors.target, late=late, early=early), starts)
