"""Attribution of the gap to the set of effects that the search decides for, with intervals and significance."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from workbench.arrays import Floats
from workbench.deadline import NEVER, Deadline
from workbench.gap.effects.effect import Effect, Kind, apply_all, each_left_out, merged_sets, simpler_forms
from workbench.gap.effects.nominal import NOMINAL_ERRORS, IdentifiedPrior, nominal_errors
from workbench.gap.effects.transducers import (
    SENSOR_CLIPPING,
    SENSOR_DELAY,
    SENSOR_QUANTISATION,
    clipped_level,
    exchanged_last,
    step_of,
)
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.noise import LEAST_LOGGED, logging_noise, shows_input_noise
from workbench.gap.prediction.random_force import RandomForceFit
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import Workers
from workbench.gap.search.errors_as_effects import (
    may_be_small_error,
    uniform_as_nominal_errors,
    with_delay_as_error,
)
from workbench.gap.search.finish import ranked, widened
from workbench.gap.search.fit import Chord, Fit, cost_of, fit
from workbench.gap.search.intervals import with_intervals
from workbench.gap.search.jointly import fit_jointly, with_all_errors
from workbench.gap.search.screening import on_whole_records, one_more
from workbench.gap.search.search import Alternatives, Search, best_of_each, best_of_each_kind, most_informative
from workbench.gap.search.settings import ATTRIBUTION, FIT, SEARCH, SELECTION
from workbench.gap.search.stages import Stages
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.threads import one_blas_thread


@dataclass(frozen=True, eq=False)
class Attribution:
    """Result of the search on the fit records.

    Attributes:
        outcome: "none", "explained", "part" or "unknown".
        best: the selected set of effects, fitted; empty for "none"; for "part" and "unknown" the set with the smallest
            residual, which may hold a law beyond the catalogue.
        random: statistics of a random disturbance, if the set has one.
        alternatives: other sets, best first, with their probabilities against the best.
        nominal_cost: mean square of the nominal residual, in units of the noise.
        tried: single effects fitted to whole records, with the random disturbance if there is one.
        ahead: the best fit of each kind alone to one-step-ahead predictions.
        reconstruction: of the nominal rig.
        search: records (with the noise of rounded sensors), rig and candidate kinds of the search.
        whitened: the records that the best set was fitted to, whitened for input noise if there is some.
        noise: (n_outputs,) estimated standard deviation of each sensor's noise, in its unit.
        logged: input noise estimated from the residual, as a share of the inputs' rms.
        seen: effects that show in the readings themselves, which no fit alters.
        is_cut: whether the search reached its deadline and ended with the best so far.
        missing: modes that the rig of `search` has beside those of the nominal rig.
        given: exchanges of channels and missing modes; `search`, `tried` and `ahead` are of the rig with them.
    """

    outcome: str
    best: Fit
    random: RandomForceFit | None
    alternatives: Alternatives
    nominal_cost: float
    tried: tuple[Fit, ...]
    ahead: tuple[Fit, ...]
    reconstruction: ForceReconstruction
    search: Search
    whitened: FitData
    noise: np.ndarray
    logged: float
    seen: tuple[Effect, ...] = ()
    is_cut: bool = False
    missing: tuple[Effect, ...] = ()
    given: tuple[Effect, ...] = ()

    @property
    def noise_ratio(self) -> float:
        """Estimated over stated noise, median of all sensors."""
        return float(np.median(self.noise / self.search.data.noise))

    @property
    def fitted_with(self) -> str:
        """What each of `singles` was fitted jointly with, in words."""
        modes = sum(effect.kind.adds_modes for effect in self.given)
        given = ["the exchange"] * (len(self.given) > modes) + ["the missing modes"] * (modes > 0)
        return f"with {' and '.join(given)}" if given else "alone"

    def without(self, *effects: Effect) -> "Attribution":
        """The attribution without some effects; the others are refitted, with new intervals."""
        search = self.search
        others = [e for e in self.best.effects if e not in effects and not e.is_in_readings]
        best = _refitted(search, others, self.whitened)
        best = with_intervals(search.rig, best, self.whitened, search.workers, logged=self.logged)
        best = replace(best, effects=(*self.seen, *best.effects))
        return replace(self, best=best, noise=search.noise_with(best))

    def with_given(self, given: tuple[Effect, ...], nominal: ForceReconstruction) -> "Attribution":
        """The attribution to the nominal rig, of one to that rig with channels exchanged or more modes.

        Args:
            given: exchanges of two channels each, and missing modes.
            nominal: the force reconstructed with the rig without them.
        """
        return replace(
            self,
            outcome="explained" if self.outcome == "none" else self.outcome,
            best=_with_given(self.best, given),
            alternatives=tuple((_with_given(found, given), p) for found, p in self.alternatives),
            nominal_cost=cost_of(nominal.rig, (), nominal.data),
            reconstruction=nominal,
            given=given,
        )

    @cached_property
    def singles(self) -> tuple[Fit, ...]:
        """The best effect of each likely kind alone, on whole records, best first; missing ones are fitted now.

        What was given comes first, and is beside each of the others.
        """
        kinds = {f.effects[0].kind for f in self.tried if f.effects}
        others = [f for f in best_of_each_kind(self.ahead) if f.effects[0].kind not in kinds][
            : ATTRIBUTION.shown_singles
        ]

        def on_all(candidate: Fit) -> Fit:
            return fit(
                self.search.rig, candidate.effects, self.search.data, iterations=5, tolerance=ATTRIBUTION.cost_tolerance
            )

        fitted = one_blas_thread(self.search.workers.map)(on_all, others)
        alone = best_of_each(sorted((*self.tried, *fitted), key=lambda f: f.cost))
        if not self.given:
            return tuple(alone)
        each = (self.search.without_effects(), *alone)
        return tuple(_with_given(found, self.given) for found in each)


def _with_given(found: Fit, given: tuple[Effect, ...]) -> Fit:
    """The fit, of a rig with these effects, as one of the rig without."""
    return replace(found, effects=exchanged_last((*given, *found.effects)))


def baseline(
    rig: Rig,
    records: Sequence[Record],
    *,
    transient: float,
    guessed: frozenset[str],
    workers: Workers,
    deadline: Deadline,
) -> tuple[tuple[Effect, ...], ForceReconstruction, ForceReconstruction]:
    """Effects that show in the readings; the force reconstructed with the nominal rig, and with the rig with these.

    Args:
        rig: nominal.
        records: fit records; no validation records.
        transient: seconds at the start of each record that are simulated but not counted.
        guessed: names of the sensors without a stated noise.
        workers: processes that share the work.
        deadline: of the search that follows.
    """
    noise = np.array([sensor.noise_std for sensor in rig.sensors])
    if not (noise > 0).all():
        name = rig.sensors[int(np.argmin(noise))].name
        raise ValueError(f"sensor {name} has no noise_std; the diagnosis weights every residual by it")
    seen, heard = _seen_in_readings(rig, records, noise)
    data = FitData(tuple(records), heard, transient=transient, guessed=guessed, deadline=deadline)
    reconstruction = ForceReconstruction.of(apply_all(rig, seen), data, workers=workers)
    _ = reconstruction.at_peaks  # computed once, before processes are forked
    if not seen:
        return seen, reconstruction, reconstruction
    nominal = reconstruction.of_rig(rig)
    _ = nominal.at_peaks
    return seen, nominal, reconstruction


def _seen_in_readings(rig: Rig, records: Sequence[Record], noise: Floats) -> tuple[tuple[Effect, ...], Floats]:
    """Rounding and clipping seen in the readings, and the noise (n_outputs,) with that of rounding added."""
    seen, noise = [], noise.copy()
    for j, sensor in enumerate(rig.sensors):
        readings = [record.outputs[j] for record in records]
        step = step_of(np.concatenate(readings))
        if step is not None and step**2 / 12.0 > 0.02 * sensor.noise_std**2:
            seen.append(Effect(SENSOR_QUANTISATION, sensor.name, {"step": step}, {"step": 0.0}))
            noise[j] = np.hypot(noise[j], step / np.sqrt(12.0))
        elif step is None:
            level = clipped_level(readings)
            if level is not None:
                seen.append(Effect(SENSOR_CLIPPING, sensor.name, {"limit": level}, {"limit": 0.0}))
    return tuple(seen), noise


def attribute(
    seen: tuple[Effect, ...],
    nominal: ForceReconstruction,
    reconstruction: ForceReconstruction,
    *,
    catalogue: tuple[Kind, ...],
    progress: Callable[[str, float], None],
    uncertain_nominal: bool,
    tolerance: float,
    identified: IdentifiedPrior | None,
) -> Attribution:
    """Find the effects that reduce the residual of a rig on its fit records to noise.

    The stages of `stages.STAGES` follow one another, from one effect to several beside small errors of the model. A
    decision says "explained" where the residual is at the noise floor or a negligible share of the gap; an effect that
    has no significant parameter then makes it "unknown".

    Args:
        seen, nominal, reconstruction: of `baseline`.
        catalogue: kinds of effects to try.
        progress: called with (what, share done) as the search proceeds.
        uncertain_nominal: fit nominal errors jointly with every effect from the first, for a model known to be
            inexact; otherwise only if no single effect explains the records.
        tolerance: of the signal's rms: a smaller gap above the noise is not searched for causes.
        identified: errors of a nominal rig that was itself identified.
    """
    rig, data, workers = reconstruction.rig, reconstruction.data, reconstruction.workers
    of_nominal = data.by_channel(data.residual(nominal.rig))
    start = Fit(seen, cost_of(rig, (), data), data.by_channel(data.residual(rig)), 0)
    quick, first = most_informative(data, start.cost_by_channel)
    search = Search(rig, data, quick, first, catalogue, progress, workers, of_nominal, tolerance=tolerance)
    stages = Stages(search, start, reconstruction, nominal, uncertain_nominal)
    outcome, best, random, alternatives, noise, own_search = stages.decision()
    missing, stages = stages.missing, stages.beside_missing or stages
    search = stages.search
    is_cut = search.is_over
    final_search = own_search or search
    if seen and outcome == "unknown" and start.cost - 1.0 < SEARCH.explained_share * (of_nominal.mean() - 1.0):
        outcome, best, alternatives, noise = "explained", start, (), None  # nothing explains the little that is left
    best = uniform_as_nominal_errors(search, best, alone=random is not None)
    if outcome == "explained" and random is None:
        best = _with_one_for_two(final_search, widened(final_search, best))
        best, alternatives = _merged(final_search, best, alternatives)
    if seen:
        best = replace(best, effects=(*seen, *(e for e in best.effects if not e.is_in_readings)))
        outcome = "explained" if outcome == "none" else outcome
    best = replace(best, effects=exchanged_last(best.effects))
    identified_prior = (
        identified if random is None and not any(effect.kind.applied_first for effect in best.effects) else None
    )
    if identified_prior is not None:
        best = with_identified_errors(final_search, best, identified_prior, seen)
    logged = final_search.logged
    if random is None:
        logged = logged or _input_noise_of(search, best, search.noise_with(best) if noise is None else noise)
        if outcome == "explained":
            best = with_all_errors(final_search, best)
        best = with_intervals(
            search.rig, best, final_search.data, workers, wide=identified_prior is not None, logged=logged
        )
        best = _without_negligible_parameters(search, best)
        if outcome == "explained":
            best = _significant(final_search, best, seen, logged)
            best = _without_small_errors(final_search, best, seen, logged)
            named = [e for e in best.effects if not e.kind.applied_first]
            # an effect without any significant parameter only shows that there is a gap
            is_insignificant = any(not e.stands_out(search.rig) for e in named if not e.is_in_readings)
            outcome = "none" if not named else "unknown" if is_insignificant else outcome
    if noise is None:
        noise = search.noise_with(best) if random is None else search.data.noise
    progress("done", 1.0)
    return Attribution(
        outcome=outcome,
        best=best,
        random=random,
        alternatives=alternatives,
        nominal_cost=float(of_nominal.mean()),
        tried=tuple(stages.singles),
        ahead=tuple(stages.ahead),
        reconstruction=nominal,
        search=search,
        whitened=final_search.data,
        noise=noise,
        logged=logged,
        seen=seen,
        is_cut=is_cut,
        missing=missing,
    )


def _with_one_for_two(search: Search, best: Fit) -> Fit:
    """The fit with two linear effects of the structure replaced by one, if that explains the records as well.

    A loss of stiffness and an error of all stiffness approximate a spring to ground.
    """
    kinds = tuple(kind for kind in search.catalogue if kind.path == "structure" and not kind.nonlinear)
    linear = [effect for effect in best.effects if effect.kind in kinds]
    if len(linear) < 2 or any(effect.kind is NOMINAL_ERRORS for effect in best.effects):
        return best
    narrow = replace(search, catalogue=kinds)
    here = cost_of(search.rig, best.effects, search.data.finely(SELECTION.substeps))
    for two in combinations(linear, 2):
        rest = tuple(effect for effect in best.effects if effect not in two)
        ahead = one_more(narrow, rest, search.reconstruction_with(rest))
        for fewer in on_whole_records(narrow, ahead, SEARCH.few_finalists):
            extra = max(best.n_parameters - fewer.n_parameters, 0)
            if search.explains(fewer) and not search.distinguishes(here, fewer.cost, extra):
                return fewer
    return best


def _merged(search: Search, best: Fit, alternatives: Alternatives) -> tuple[Fit, Alternatives]:
    """The fit and its alternatives, or that with two effects replaced by the one that both may be, if that is likelier.

    Friction and a constant force of an actuator beside it are nearly friction that differs between the directions.
    """
    sets = list(merged_sets(best.effects))
    if not sets:
        return best, alternatives
    merged = [fit for fit in (_refitted(search, effects, search.data) for effects in sets) if search.explains(fit)]
    likeliest, others = ranked(search, [_refitted(search, best.effects, search.data), *merged])
    return (best, alternatives) if likeliest.key == best.key else (likeliest, others)


def _refitted(search: Search, effects: Sequence[Effect], data: FitData) -> Fit:
    """The effects refitted to all records from good start values, whether or not the deadline is past."""
    finely = replace(data.finely(SELECTION.substeps), deadline=NEVER)
    return fit(search.rig, effects, finely, iterations=FIT.iterations, workers=search.workers, chord=Chord())


def _significant(search: Search, best: Fit, seen: Sequence[Effect], logged: float) -> Fit:
    """The fit without effects that have an insignificant parameter, and with limiting cases that fit as well.

    An effect stays if the records need it: they may determine only a combination of its parameters. A limiting case
    is, for example, a damper for friction far below its smoothing speed, or one force of friction for two directions.
    """
    data, rig = search.data.finely(SELECTION.substeps), search.rig

    for effect in best.effects:
        if effect.is_in_readings or effect.kind.applied_first:
            continue
        is_sure = effect.stands_out(rig) and effect.is_sure(rig)
        others = [e for e in best.effects if not (e is effect or e.is_in_readings)]
        sets = [others] * (not is_sure) + [(*others, form) for form in simpler_forms(effect, rig)]
        if not sets:
            continue
        here = cost_of(rig, best.effects, data)
        simpler = [_refitted(search, each, search.data) for each in sets]
        for fewer in sorted(simpler, key=lambda f: f.n_parameters):
            if not search.distinguishes(here, fewer.cost, max(best.n_parameters - fewer.n_parameters, 0)):
                fewer = with_intervals(rig, fewer, search.data, search.workers, logged=logged)
                settled = _without_negligible_parameters(search, fewer).effects
                return _significant(search, replace(fewer, effects=(*seen, *settled)), seen, logged)
    return best


def _without_small_errors(search: Search, best: Fit, seen: Sequence[Effect], logged: float) -> Fit:
    """The fit without effects beside nominal errors that may be such errors themselves, if the rest explains as much.

    A gain of 0.95 +- 0.01 is no sure fault where the other gains are off by 2 %.
    """
    errors = next((e for e in best.effects if e.kind is NOMINAL_ERRORS), None)
    if errors is None:
        return best
    named = [e for e in best.effects if not (e is errors or e.is_in_readings)]
    for effect in named:
        if not may_be_small_error(effect, errors, search):
            continue
        others = [e for e in named if e is not effect]
        start = with_delay_as_error(search, errors, effect) if effect.kind is SENSOR_DELAY else errors
        step = fit_jointly(search, others, start, until_convergence=True)
        if step.explains:
            fewer = with_all_errors(search, step.fit)
            fewer = with_intervals(search.rig, fewer, search.data, search.workers, logged=logged)
            return _without_small_errors(search, replace(fewer, effects=(*seen, *fewer.effects)), seen, logged)
    return best


def _without_negligible_parameters(search: Search, best: Fit) -> Fit:
    """The fit with parameters near zero set to zero, where the cost is the same.

    The standard error at one point of a stiff law does not show that.
    """
    data = search.data.finely(SELECTION.substeps)
    for effect in best.effects:
        settled = effect.kind.without_negligible(effect)
        if settled is effect:
            continue
        effects = tuple(settled if e is effect else e for e in best.effects)
        here, there = (cost_of(search.rig, each, data) for each in (best.effects, effects))
        if not search.distinguishes(here, there, 1):
            best = replace(best, effects=effects)
    return best


def with_identified_errors(search: Search, best: Fit, identified: IdentifiedPrior, seen: Sequence[Effect]) -> Fit:
    """The set refitted jointly with errors of the identified rig; the effects `seen` in the readings stay.

    An effect that these errors make unnecessary is left out, if another remains.
    """
    others = [effect for effect in best.effects if not effect.is_in_readings]
    if not others:
        return best

    def fitted_with(effects: Sequence[Effect], errors: Effect) -> Fit:
        return fit(search.rig, (*effects, errors), search.data, iterations=FIT.iterations, workers=search.workers)

    found = fitted_with(others, nominal_errors(search.rig, identified))
    while len(found.effects) > 2:
        *effects, errors = found.effects
        fewer = min((fitted_with(some, errors) for some in each_left_out(effects)), key=lambda f: f.cost)
        if search.distinguishes(found.cost, fewer.cost, found.n_parameters - fewer.n_parameters):
            break
        found = fewer
    return replace(found, effects=(*seen, *found.effects))


def _input_noise_of(search: Search, best: Fit, noise: np.ndarray) -> float:
    """Input noise, as a share of the inputs' rms, from the residual of a set above the sensor noise (n_outputs,).

    A small excess of the residual counts only if its spectrum is that of input noise, by likelihood.
    """
    rig = apply_all(search.rig, best.effects)
    residual_power = search.data.by_channel(search.data.residual(rig))
    sensor_noise = (noise / search.data.noise) ** 2
    share = logging_noise(residual_power, sensor_noise, search.logging_noise)
    is_small = (residual_power.mean(axis=1) < (1.0 + ATTRIBUTION.tenth_louder) * sensor_noise.mean()).all()
    if not is_small:
        return share
    data = search.data.with_noise(noise)
    is_shown = share > LEAST_LOGGED and shows_input_noise(rig, data, data.differences(rig), share)
    return share if is_shown else 0.0
