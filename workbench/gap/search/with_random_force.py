"""Search for a random disturbance, alone or with effects: a force that can be whitened but not predicted."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from workbench.arrays import Floats
from workbench.gap.effects.effect import Effect, names_in, place_values
from workbench.gap.effects.environment import RANDOM_DISTURBANCE
from workbench.gap.effects.nominal import NominalPrior
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.innovations import Observer
from workbench.gap.prediction.random_force import (
    MAX_TONAL_SHARE,
    RandomForceFit,
    fit_random_force,
    followed,
    model_filter,
    tonal,
)
from workbench.gap.search.finish import finished, plainest, ranked, simplest
from workbench.gap.search.fit import Fit, cost_of, fit, parameters_of
from workbench.gap.search.jointly import JointFit, fit_jointly
from workbench.gap.search.screening import on_whole_records, one_more
from workbench.gap.search.search import Decision, Search, best_of_each_kind
from workbench.gap.search.settings import INTERVALS, JOINT, RANDOM, SEARCH
from workbench.rig.rig import Rig
from workbench.rig.simulate import is_stepped
from workbench.structure.domain import Between, NamedPoints


class WithRandom(NamedTuple):
    """Effects fitted together with a random force.

    Attributes:
        fit: of the effects and the random disturbance, which comes last.
        random: statistics of the force.
    """

    fit: Fit
    random: RandomForceFit

    @property
    def given(self) -> tuple[Effect, ...]:
        """The effects without the random disturbance."""
        return self.fit.effects[:-1]

    def is_near(self, search: Search) -> bool:
        """Whether the whitened residual is small, and the force no tone, so that a further effect may be missing."""
        return search.near(self.fit, RANDOM.max_residual_share) and not self.random.tonal > MAX_TONAL_SHARE


def looks_random(reconstruction: ForceReconstruction) -> bool:
    """Whether the unmodelled force is equally strong in every record, unrelated to inputs and motion, and no tone.

    False for records of several sample rates: the force varies within a sample, so it has another strength at each.
    """
    if reconstruction.has_several_rates:
        return False
    records, place = reconstruction.data.counted, reconstruction.at_peaks[0]
    forces = np.split(place.force, np.cumsum([record.n_samples for record in records])[:-1])
    elastic = reconstruction.rig.modes.omega[reconstruction.rig.modes.omega > 0] / (2.0 * np.pi)
    slowest = RANDOM.least_frequency * float(elastic[0]) if elastic.size else 0.0
    levels = np.array([_rms_above(slowest, force, records[0].sample_time) for force in forces])
    if len(forces) < 2 or np.ptp(levels) > RANDOM.max_rms_spread * levels.mean():
        return False
    if min(tonal(force, records[0].sample_time) for force in forces) > MAX_TONAL_SHARE:
        return False
    shape = reconstruction.rig.modes.phi_at(place.at)
    motions = [shape @ np.array([motion.displacement, motion.velocity]) for motion in reconstruction.motions]
    each = zip(forces, records, motions, strict=True)
    return max(followed(force, record.inputs, motion) for force, record, motion in each) < RANDOM.max_predicted_share


def _rms_above(frequency: float, force: Floats, sample_time: float) -> float:
    """Rms of the part of a series (n_samples,) at and above a frequency, Hz."""
    spectrum = np.fft.rfft(force)
    spectrum[np.fft.rfftfreq(force.size, sample_time) < frequency] = 0.0
    return float(np.sqrt(np.mean(np.fft.irfft(spectrum, force.size) ** 2)))


def decide_on_random(search: Search, reconstruction: ForceReconstruction) -> tuple[Decision | None, list[Fit]]:
    """The decision for a random disturbance, alone or with a few effects, and all fits that were tried.

    The decision is None if the whitened residual is never white, or if effects explain the records without a random
    disturbance, which over-fits easily.
    """
    search, reconstruction = _without_clipped(search, (), reconstruction)
    reconstruction = _with_laws_on_measured_motion(search, reconstruction)
    if not looks_random(reconstruction):
        return None, []
    alone = _fitted_with_random(search, search.without_effects(), reconstruction)
    if not alone.is_near(search):
        return None, []
    tried = [alone]
    for _ in range(RANDOM.max_effects_beside):
        with_one_more = _with_one_more(search, tried[-1], reconstruction)
        if with_one_more is None:
            return None, []
        tried += with_one_more
        found = _best_decision(search, tried)
        if found is not None or not with_one_more or search.is_over:
            break
        reconstruction = _reconstruction_with(search, tried[-1].given)
    return found, [each.fit for each in tried]


def random_with_effects(search: Search, found: Sequence[Fit]) -> Decision | None:
    """The decision for a random disturbance with stronger effects, whose residual looks random; None if none holds.

    If none holds but one is near, a further effect is tried with it.
    """
    tried, searches = [], []
    for given in best_of_each_kind(found)[: SEARCH.few_finalists]:
        unclipped, reconstruction = _without_clipped(search, given.effects, search.reconstruction_with(given.effects))
        reconstruction = _with_laws_on_measured_motion(unclipped, reconstruction)
        if looks_random(reconstruction):
            by_channel = unclipped.data.by_channel(unclipped.data.residual(reconstruction.rig))
            tried.append(_fitted_with_random(unclipped, replace(given, cost_by_channel=by_channel), reconstruction))
            searches.append(unclipped)
    decision = _best_decision(search, tried)
    if decision is not None or not tried or search.is_over:
        return decision
    best, unclipped = min(zip(tried, searches, strict=True), key=lambda each: each[0].random.cost)
    if not best.is_near(search):
        return None
    reconstruction = _reconstruction_with(unclipped, best.given)
    return _best_decision(search, _with_one_more(unclipped, best, reconstruction) or [])


def _with_one_more(search: Search, best: WithRandom, reconstruction: ForceReconstruction) -> list[WithRandom] | None:
    """Fits of one effect more with a random force, highest cost first; None if one explains the records without it.

    Args:
        best: effects and a random force, whose whitened residual is not white.
        reconstruction: of the rig with these effects.
    """
    search.progress("effects with a random disturbance", 0.2)
    whitener = model_filter(reconstruction.model, reconstruction.rig, best.random)
    whitened = search.through(whitener, _observer(search, reconstruction.rig, best.random))
    gaining = whitened.in_parallel(
        simplest, _improving(search, whitened, best.given, reconstruction)[: RANDOM.joint_fits]
    )
    if any(search.explains(finished(search, candidate)) for candidate in gaining):
        return None
    found = [_fitted_with_random(search, candidate) for candidate in gaining]
    return sorted(found, key=lambda each: each.random.cost, reverse=True)


def random_with_nominal_errors(search: Search, step: JointFit, *, surely: bool = True) -> Decision | None:
    """The decision for a random disturbance with nominal errors and effects; None if none holds.

    The nominal errors and the whitening filter of the force are fitted in turns. Since no model is exact, the residual
    may exceed the noise by a negligible share of the gap, and a force must account for more than that.

    Args:
        step: effects and nominal errors to start from, fitted without the force.
        surely: require that the force at the start looks random already.
    """
    reconstruction = _reconstruction_with(search, step.fit.effects)
    if surely and not looks_random(reconstruction):
        return None
    found, random = _random_given(search, step.fit, reconstruction)
    for _ in range(RANDOM.max_alternations):
        before = random.cost
        whitener = model_filter(reconstruction.model, reconstruction.rig, random)
        whitened = search.through(whitener, _observer(search, search.rig, random))
        step = fit_jointly(whitened, step.effects, step.errors)
        reconstruction = _reconstruction_with(search, step.fit.effects)
        found, random = _random_given(search, step.fit, reconstruction)
        if random.cost > (1.0 - JOINT.round_tolerance) * before:
            break
    cost = cost_of(search.rig, step.fit.effects, search.data)
    is_closed = random.left - 1.0 < SEARCH.explained_share * cost
    is_noticeable = cost - 1.0 > SEARCH.negligible_share * float(search.nominal.mean())
    holds = is_closed and is_noticeable and random.is_steady and looks_random(reconstruction)
    return Decision("explained", found, random) if holds else None


def _reconstruction_with(search: Search, effects: Sequence[Effect]) -> ForceReconstruction:
    """The force reconstructed with the given effects, nonlinear laws acting on the measured motion."""
    return _with_laws_on_measured_motion(search, search.reconstruction_with(effects))


def _improving(
    search: Search, whitened: Search, given: tuple[Effect, ...], reconstruction: ForceReconstruction
) -> list[Fit]:
    """Fits of the given effects and one more that improve on the random force beside the given ones, best first.

    The unmodelled force is located where the random one acts, so all laws are tried again at the best effect's place.

    Args:
        search: without the whitening filter of the force.
        whitened: the search with it.
        reconstruction: of the rig with the given effects.
    """
    cost, n_given = cost_of(whitened.rig, given, whitened.data), len(parameters_of(search.rig, given))

    def fitted(reconstruction: ForceReconstruction) -> list[Fit]:
        fits = on_whole_records(whitened, one_more(whitened, given, reconstruction), SEARCH.finalists)
        return [f for f in fits if whitened.surely_better(f, cost, f.n_parameters - n_given)]

    found = fitted(reconstruction)
    places = [f.effects[-1].at for f in found if f.effects[-1].at is not None]
    if places:
        found = sorted((*found, *fitted(reconstruction.of_force_at(places[0]))), key=lambda f: f.cost)
    alternatives = [f for f in best_of_each_kind(found) if f.cost < found[0].cost + RANDOM.alternative_margin]
    # small errors of gains and places remove a little of what the given effects leave
    before = cost_of(search.rig, given, search.data)
    return [
        f
        for f in alternatives
        if before - cost_of(search.rig, f.effects, search.data) > SEARCH.negligible_share * before
    ]


def _without_clipped(
    search: Search, effects: Sequence[Effect], reconstruction: ForceReconstruction
) -> tuple[Search, ForceReconstruction]:
    """The search and its reconstruction without the sensors that clip, unless an effect is at one of them."""
    unclipped = search.without_clipped()
    clipped = {sensor.name for sensor in search.rig.sensors} - {sensor.name for sensor in unclipped.rig.sensors}
    if not clipped or any(name in clipped for effect in effects for name in names_in(effect.target)):
        return search, reconstruction
    return unclipped, unclipped.reconstruction_with(effects)


def _best_decision(search: Search, tried: Sequence[WithRandom]) -> Decision | None:
    """The decision for the best set whose residual is white; more effects or a wider law must be justified."""
    holding = [found for found in tried if found.random.holds]
    if not holding:
        return None
    fewest = min((found for found, _ in holding), key=lambda found: (len(found.effects), found.cost))

    def is_justified(found: Fit) -> bool:
        extra = found.n_parameters - fewest.n_parameters
        return len(found.effects) == len(fewest.effects) or search.surely_better(found, fewest.cost, extra)

    justified = [found for found, _ in holding if is_justified(found)]
    plain = plainest(search, justified, worth=SEARCH.significant_gain)
    best, alternatives = ranked(search, plain)
    return Decision("explained", best, next(random for found, random in holding if found is best), alternatives)


def _fitted_with_random(search: Search, given: Fit, reconstruction: ForceReconstruction | None = None) -> WithRandom:
    """The given effects and a random disturbance, fitted in turns.

    Args:
        reconstruction: of the rig with the given effects, if available.
    """
    if reconstruction is None:
        reconstruction = _reconstruction_with(search, given.effects)
    found = _random_given(search, given, reconstruction)
    for _ in range(RANDOM.max_alternations if given.effects else 0):
        if found.random.holds or not search.near(found.fit, RANDOM.max_residual_share):
            break
        before = found.random.cost
        observer = _observer(search, reconstruction.rig, found.random)
        data = search.data.through(model_filter(reconstruction.model, reconstruction.rig, found.random), observer)
        refitted = fit(search.rig, given.effects, data, iterations=8)
        reconstruction = search.reconstruction_with(refitted.effects)
        given = replace(refitted, cost_by_channel=search.data.by_channel(search.data.residual(reconstruction.rig)))
        reconstruction = _with_laws_on_measured_motion(search, reconstruction, observer)
        found = _random_given(search, given, reconstruction)
        if found.random.cost > (1.0 - JOINT.round_tolerance) * before:
            break
    return found


def _observer(search: Search, rig: Rig, found: RandomForceFit | None = None) -> Observer:
    """The observer of a rig that a random force acts on."""
    data = search.data
    force, at = (0.0, None) if found is None else (found.rms, found.at)
    return Observer.of(rig, data.noise, data.force_rms, data.sample_times, at=at, rms=force)


def _with_laws_on_measured_motion(
    search: Search, reconstruction: ForceReconstruction, observer: Observer | None = None
) -> ForceReconstruction:
    """The reconstruction from residuals for which nonlinear laws act on the measured motion.

    Acting on the simulated motion, which lacks the force, they would distort its response.
    """
    if not is_stepped(reconstruction.rig):
        return reconstruction
    observer = observer or _observer(search, reconstruction.rig)
    return replace(
        reconstruction, residuals=tuple(search.data.residual_on_measured_motion(reconstruction.rig, observer))
    )


def _random_given(search: Search, given: Fit, reconstruction: ForceReconstruction) -> WithRandom:
    """The given effects with a random force fitted to their residual, and the statistics of that force."""
    domain = reconstruction.domain
    most = RANDOM.start_points if isinstance(domain, NamedPoints) else RANDOM.start_places
    places = [where for where in reconstruction.peaks if not isinstance(where, Between)][:most]
    found = fit_random_force(
        reconstruction.rig, search.data, reconstruction.residuals, places, reconstruction.data.force_rms
    )
    rms, rms_std = found.acting_rms
    # standard errors are no smaller than a residual that is not white allows, nor than two good models differ by
    level = np.sqrt(max(float(found.chi2_by_record.mean()), 1.0))
    least = INTERVALS.model_difference * domain.size if found.at_std else 0.0
    at_std = (max(float(level * std), least) for std in found.at_std)
    spread = dict(zip(domain.coordinates, at_std, strict=True))
    # the force is inferred from its response, so it is as uncertain as mass and stiffness
    priors = (e.target for e in given.effects if isinstance(e.target, NominalPrior))
    model_uncertainty = max(
        (float(np.hypot(prior.mass, prior.stiffness)) for prior in priors), default=INTERVALS.model_difference
    )
    deviations = {**spread, "rms": float(np.hypot(level * rms_std, model_uncertainty * rms))}
    effect = Effect(RANDOM_DISTURBANCE, None, {**place_values(found.at), "rms": rms}, deviations)
    fitted = given.n_parameters + 1 + len(spread)
    combined = Fit((*given.effects, effect), found.cost, given.cost_by_channel, fitted)
    return WithRandom(combined, found)
