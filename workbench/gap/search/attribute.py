"""Attribution of the gap to effects: each kind alone, then with nominal errors and in pairs, until noise is left."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from workbench.arrays import Floats
from workbench.deadline import NEVER, Deadline
from workbench.gap.effects.effect import Effect, Kind, apply_all, each_left_out, simpler_forms
from workbench.gap.effects.nominal import IdentifiedPrior, nominal_errors
from workbench.gap.effects.nonlinear import BEYOND, any_beyond, in_catalogue
from workbench.gap.effects.ports import SENSOR_CLIPPING, SENSOR_QUANTISATION, clipped_level, exchanged_last, step_of
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.localisation.where import of_one_sensor
from workbench.gap.prediction.noise import (
    LEAST_LOGGED,
    is_noise_alone,
    logging_noise,
    noise_found,
    shows_input_noise,
)
from workbench.gap.prediction.random_force import RandomForceFit
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import Workers
from workbench.gap.search.beside_random import decide_on_random, random_with_effects, random_with_nominal_errors
from workbench.gap.search.finish import best_of_each, finished, ranked, relocated, simplest, widened
from workbench.gap.search.fit import Chord, Fit, cost_of, fit
from workbench.gap.search.intervals import with_intervals
from workbench.gap.search.jointly import with_all_errors
from workbench.gap.search.nominal_figures import with_mode_errors, with_record_deviations
from workbench.gap.search.pairs import Pairs
from workbench.gap.search.plain import (
    NO_UNIFORM_ERROR,
    are_uniform_errors,
    is_plausible_error,
    uniform_as_nominal_errors,
)
from workbench.gap.search.screening import Screening, on_whole_records, one_more
from workbench.gap.search.search import Decision, Search, best_of_each_kind, most_informative, nearest, promise
from workbench.gap.search.settings import ATTRIBUTION, LAW, PAIRS, RANDOM, SEARCH, SELECTION, STEPWISE
from workbench.gap.search.stepwise import Stepwise
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import is_stepped
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
        evidence: of the nominal rig.
        search: records (with the noise of rounded sensors), rig and candidate kinds of the search.
        weighed: the records that the best set was fitted to, whitened for input noise if there is some.
        noise: (n_outputs,) estimated standard deviation of each sensor's noise, in its unit.
        logged: input noise estimated from the residual, as a share of the inputs' rms.
        seen: effects that show in the readings themselves, which no fit alters.
        is_cut: whether the search reached its deadline and ended with the best so far.
        exchanged: exchanges of channels that were given; `search`, `tried` and `ahead` are of the rig with them.
    """

    outcome: str
    best: Fit
    random: RandomForceFit | None
    alternatives: tuple[tuple[Fit, float], ...]
    nominal_cost: float
    tried: tuple[Fit, ...]
    ahead: tuple[Fit, ...]
    evidence: Evidence
    search: Search
    weighed: FitData
    noise: np.ndarray
    logged: float
    seen: tuple[Effect, ...] = ()
    is_cut: bool = False
    exchanged: tuple[Effect, ...] = ()

    @property
    def noise_ratio(self) -> float:
        """Estimated over stated noise, median of all sensors."""
        return float(np.median(self.noise / self.search.data.noise))

    def without(self, *effects: Effect) -> "Attribution":
        """The attribution without some effects; the others are refitted, with new intervals."""
        search = self.search
        others = [e for e in self.best.effects if e not in effects and e not in self.seen]
        best = _refitted(search, others, self.weighed)
        best = with_intervals(search.rig, best, self.weighed, search.workers, logged=self.logged)
        best = replace(best, effects=(*self.seen, *best.effects))
        return replace(self, best=best, noise=noise_of(search, best))

    def with_exchanges(self, exchanges: tuple[Effect, ...], nominal: Evidence) -> "Attribution":
        """The attribution to the nominal rig, of one to that rig with channels exchanged.

        Args:
            exchanges: of two channels each.
            nominal: evidence of the rig without them.
        """
        return replace(
            self,
            outcome="explained" if self.outcome == "none" else self.outcome,
            best=_with_exchanges(self.best, exchanges),
            alternatives=tuple((_with_exchanges(found, exchanges), p) for found, p in self.alternatives),
            nominal_cost=cost_of(nominal.rig, (), nominal.data),
            evidence=nominal,
            exchanged=exchanges,
        )

    @cached_property
    def singles(self) -> tuple[Fit, ...]:
        """The best effect of each likely kind alone, on whole records, best first; missing ones are fitted now.

        Channels that are exchanged come first, and are exchanged with each of the others.
        """
        kinds = {f.effects[0].kind for f in self.tried if f.effects}
        others = [f for f in best_of_each_kind(self.ahead) if f.effects[0].kind not in kinds][: ATTRIBUTION.shown]

        def on_all(candidate: Fit) -> Fit:
            return fit(self.search.rig, candidate.effects, self.search.data, iterations=5, tolerance=ATTRIBUTION.alike)

        fitted = one_blas_thread(self.search.workers.map)(on_all, others)
        alone = best_of_each(sorted((*self.tried, *fitted), key=lambda f: f.cost))
        if not self.exchanged:
            return tuple(alone)
        each = (self.search.without_effects(), *alone)
        return tuple(_with_exchanges(found, self.exchanged) for found in each)


def _with_exchanges(found: Fit, exchanges: tuple[Effect, ...]) -> Fit:
    """The fit, of a rig with channels exchanged, as one of the rig without."""
    return replace(found, effects=exchanged_last((*exchanges, *found.effects)))


def baseline(
    rig: Rig,
    records: Sequence[Record],
    *,
    settle: float,
    guessed: frozenset[str],
    workers: Workers,
    deadline: Deadline,
) -> tuple[tuple[Effect, ...], Evidence, Evidence]:
    """Effects that show in the readings themselves; evidence of the nominal rig, and of the rig with these effects.

    Args:
        rig: nominal.
        records: fit records; no validation records.
        settle: seconds at the start of each record that are simulated but not counted.
        guessed: names of the sensors without a stated noise.
        workers: processes that share the work.
        deadline: of the search that follows.
    """
    noise = np.array([sensor.noise_std for sensor in rig.sensors])
    if not (noise > 0).all():
        name = rig.sensors[int(np.argmin(noise))].name
        raise ValueError(f"sensor {name} has no noise_std; the diagnosis weights every residual by it")
    seen, heard = _seen_in_readings(rig, records, noise)
    data = FitData(tuple(records), heard, settle=settle, guessed=guessed, deadline=deadline)
    evidence = Evidence.of(apply_all(rig, seen), data, workers=workers)
    _ = evidence.at_peaks  # computed once, before processes are forked
    if not seen:
        return seen, evidence, evidence
    nominal = replace(Evidence.of(rig, data, workers=workers), given_size=evidence.size)
    _ = nominal.at_peaks
    return seen, nominal, evidence


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
    nominal: Evidence,
    evidence: Evidence,
    *,
    catalogue: tuple[Kind, ...],
    report: Callable[[str, float], None],
    uncertain_nominal: bool,
    tolerance: float,
    identified: IdentifiedPrior | None,
) -> Attribution:
    """Find the effects that reduce the residual of a rig on its fit records to noise.

    Each kind is tried alone from many starts, then jointly with nominal errors and in pairs. A set explains the gap
    only if the residual of every record is at its noise floor; else the outcome is "part" or "unknown".

    Args:
        seen, nominal, evidence: of `baseline`.
        catalogue: kinds of effects to try.
        report: called with (what, share done) as the search proceeds.
        uncertain_nominal: fit nominal errors jointly with every effect from the first, for a model known to be
            inexact; otherwise only if no single effect explains the records.
        tolerance: of the signal's rms: a smaller gap above the noise is not searched for causes.
        identified: errors of a nominal rig that was itself identified.
    """
    rig, data, workers = evidence.rig, evidence.data, evidence.workers
    of_nominal = data.by_channel(data.residual(nominal.rig))
    start = Fit(seen, cost_of(rig, (), data), data.by_channel(data.residual(rig)), 0)
    search = Search(rig, data, *most_informative(data, start.cost_by_channel), catalogue, report, workers, of_nominal)
    decision: Decision | None = None
    singles: list[Fit] = []
    ahead: list[Fit] = []
    if not seen and _is_small(nominal, tolerance):
        decision = Decision("none", start)
    elif not search.explains(start) and is_noise_alone(evidence.residuals, data.counted):
        decision = Decision("none", start, noise=noise_found(evidence.residuals))
    elif uncertain_nominal and not search.explains(start):
        decision = _decide_with_nominal_errors(search, tolerance)
    elif not search.explains(start) and not _of_one_sensor(start):
        decision, singles = decide_on_random(search, evidence)
    if decision is None:
        report("one effect", 0.1)
        screened = Screening.of(search, (), evidence)
        ahead = one_more(search, (), evidence, screened)
        report("one effect, on whole records", 0.3)
        singles = _single_effects(search, start, ahead)
        alone, singles = _decide_on_singles(search, start, singles)
        decision = unless_other_law(search, alone, evidence) if alone else None
        decision = decision or _random_at_one_sensor(search, start, evidence)
        decision = decision or _decide_beyond_singles(search, start, singles, ahead, screened, evidence, tolerance)
        decision = nearest(search, start, decision, singles)
    outcome, best, random, rivals, noise, own_search = decision
    is_cut = search.is_over
    final_search = own_search or search
    best = uniform_as_nominal_errors(search, best, alone=random is not None)
    if outcome == "explained" and random is None:
        best = widened(final_search, best)
    if seen:
        best = replace(best, effects=(*seen, *(e for e in best.effects if e not in seen)))
        outcome = "explained" if outcome == "none" else outcome
    best = replace(best, effects=exchanged_last(best.effects))
    identified_prior = (
        identified if random is None and not any(effect.kind.applied_first for effect in best.effects) else None
    )
    if identified_prior is not None:
        best = with_identified_errors(final_search, best, identified_prior, seen)
    logged = final_search.logged
    if random is None:
        logged = logged or _input_noise_of(search, best, noise_of(search, best) if noise is None else noise)
        if outcome == "explained":
            best = with_all_errors(final_search, best)
        best = with_intervals(
            search.rig, best, final_search.data, workers, wide=identified_prior is not None, logged=logged
        )
        best = _without_negligible_parameters(search, best)
        if outcome == "explained":
            best = _significant(final_search, best, seen, logged)
            named = [e for e in best.effects if not e.kind.applied_first]
            # an effect without any significant parameter only shows that there is a gap
            is_insignificant = any(not e.stands_out(search.rig) for e in named if e not in seen)
            outcome = "none" if not named else "unknown" if is_insignificant else outcome
    if noise is None:
        noise = noise_of(search, best) if random is None else search.data.noise
    report("done", 1.0)
    return Attribution(
        outcome=outcome,
        best=best,
        random=random,
        alternatives=rivals,
        nominal_cost=float(of_nominal.mean()),
        tried=tuple(singles),
        ahead=tuple(ahead),
        evidence=nominal,
        search=search,
        weighed=final_search.data,
        noise=noise,
        logged=logged,
        seen=seen,
        is_cut=is_cut,
    )


def _refitted(search: Search, effects: Sequence[Effect], data: FitData) -> Fit:
    """The effects refitted to all records from good start values, whether or not the deadline is past."""
    finely = replace(data.finely(SELECTION.fine), deadline=NEVER)
    return fit(search.rig, effects, finely, iterations=ATTRIBUTION.together, workers=search.workers, chord=Chord())


def _significant(search: Search, best: Fit, seen: Sequence[Effect], logged: float) -> Fit:
    """The fit without effects that have an insignificant parameter, or with limiting cases of them.

    An effect stays if the records need it: they may determine only a combination of its parameters. A limiting case
    is, for example, a damper for friction far below its smoothing speed.
    """
    data, rig = search.data.finely(SELECTION.fine), search.rig

    for effect in best.effects:
        if effect in seen or effect.kind.applied_first or (effect.stands_out(rig) and effect.is_sure(rig)):
            continue
        others = [e for e in best.effects if e is not effect and e not in seen]
        here = cost_of(rig, best.effects, data)
        sets = (others, *((*others, form) for form in simpler_forms(effect, rig)))
        simpler = [_refitted(search, each, search.data) for each in sets]
        for fewer in sorted(simpler, key=lambda f: f.n_parameters):
            if not search.tells_apart(here, fewer.cost, max(best.n_parameters - fewer.n_parameters, 0)):
                fewer = with_intervals(rig, fewer, search.data, search.workers, logged=logged)
                settled = _without_negligible_parameters(search, fewer).effects
                return _significant(search, replace(fewer, effects=(*seen, *settled)), seen, logged)
    return best


def _without_negligible_parameters(search: Search, best: Fit) -> Fit:
    """The fit with parameters near zero set to zero, where the cost is the same.

    The standard error at one point of a stiff law does not show that.
    """
    data = search.data.finely(SELECTION.fine)
    for effect in best.effects:
        settled = effect.kind.without_negligible(effect)
        if settled is effect:
            continue
        effects = tuple(settled if e is effect else e for e in best.effects)
        here, there = (cost_of(search.rig, each, data) for each in (best.effects, effects))
        if not search.tells_apart(here, there, 1):
            best = replace(best, effects=effects)
    return best


def with_identified_errors(search: Search, best: Fit, identified: IdentifiedPrior, seen: Sequence[Effect]) -> Fit:
    """The set refitted jointly with errors of the identified rig; the effects `seen` in the readings stay.

    An effect that these errors make unnecessary is left out, if another remains.
    """
    others = [effect for effect in best.effects if effect not in seen]
    if not others:
        return best

    def fitted_with(effects: Sequence[Effect], errors: Effect) -> Fit:
        return fit(search.rig, (*effects, errors), search.data, iterations=ATTRIBUTION.together, workers=search.workers)

    found = fitted_with(others, nominal_errors(search.rig, identified))
    while len(found.effects) > 2:
        *effects, errors = found.effects
        fewer = min((fitted_with(some, errors) for some in each_left_out(effects)), key=lambda f: f.cost)
        if search.tells_apart(found.cost, fewer.cost, found.n_parameters - fewer.n_parameters):
            break
        found = fewer
    return replace(found, effects=(*seen, *found.effects))


def _is_small(nominal: Evidence, tolerance: float) -> bool:
    """Whether the gap above the noise is within a tolerance, or a tenth of the noise, in every record."""
    for record, residual in zip(nominal.data.counted, nominal.residuals, strict=True):
        scale = record.outputs.std(axis=1, keepdims=True)
        noise_floor = float(((nominal.data.noise[:, None] / scale) ** 2).mean())
        if float(((residual / scale) ** 2).mean()) - noise_floor > max(tolerance**2, ATTRIBUTION.a_tenth * noise_floor):
            return False
    return tolerance > 0


def _input_noise_of(search: Search, best: Fit, noise: np.ndarray) -> float:
    """Input noise, as a share of the inputs' rms, from the residual of a set above the sensor noise (n_outputs,).

    A small excess of the residual counts only if its spectrum is that of input noise, by likelihood.
    """
    rig = apply_all(search.rig, best.effects)
    residual_power = search.data.by_channel(search.data.residual(rig))
    sensor_noise = (noise / search.data.noise) ** 2
    share = logging_noise(residual_power, sensor_noise, search.logging_noise)
    is_small = (residual_power.mean(axis=1) < (1.0 + ATTRIBUTION.a_tenth) * sensor_noise.mean()).all()
    if not is_small:
        return share
    data = search.data.with_noise(noise)
    is_shown = share > LEAST_LOGGED and shows_input_noise(rig, data, data.differences(rig), share)
    return share if is_shown else 0.0


def noise_of(search: Search, best: Fit) -> np.ndarray:
    """Standard deviation of each sensor's noise (n_outputs,), estimated from the residual of a set.

    A residual within the stated noise is all noise: coloured noise has peaks, which an estimate from the quiet bands
    misses, and differs between records.
    """
    residuals = search.data.differences(apply_all(search.rig, best.effects))
    rms = np.sqrt(np.mean([(residual**2).mean(axis=1) for residual in residuals], axis=0))
    noise: np.ndarray = np.maximum(noise_found(residuals), np.minimum(rms, search.data.noise))
    return noise


def _single_effects(search: Search, start: Fit, ahead: list[Fit]) -> list[Fit]:
    """Single effects on whole records, best first."""
    promising = [f for f in ahead if f.cost < SELECTION.promising] or ahead[:1]
    if not search.explains(start):
        return on_whole_records(search, promising, ATTRIBUTION.finalists)
    # only a significant gain matters, and there may be no effect at all
    to_cost = start.cost - SEARCH.significant
    return on_whole_records(search, promising, ATTRIBUTION.finalists, to_cost=to_cost, at_first=ATTRIBUTION.briefly)


def _of_one_sensor(start: Fit) -> bool:
    """Whether only one of several sensors disagrees: its own fault is likelier than a random force."""
    excess = np.maximum(start.cost_by_channel.mean(axis=0) - 1.0, 0.0)
    return excess.size > 1 and of_one_sensor(excess)


def _random_at_one_sensor(search: Search, start: Fit, evidence: Evidence) -> Decision | None:
    """The decision for a random disturbance that only one sensor shows, if its own faults do not explain it."""
    return decide_on_random(search, evidence)[0] if _of_one_sensor(start) else None


def _decide_on_singles(search: Search, start: Fit, singles: list[Fit]) -> tuple[Decision | None, list[Fit]]:
    """The decision if at most one effect explains the records, else None; and the single effects, best first."""
    good = [f for f in singles if search.significant(f, start.cost)]
    if search.explains(start) and not good:
        return Decision("none", start), singles
    ended = _finished_best(search, good[:4])
    explaining = [f for f in ended if search.explains(f)]
    if not explaining:
        near = [f for f in ended[:2] if search.near(f, RANDOM.near)]
        moved = search.side_by_side(relocated, near)
        explaining = [f for f in moved if search.explains(f)]
        singles = sorted((*moved, *singles), key=lambda f: f.cost)
    if explaining:
        best, rivals = ranked(search, [simplest(search, f) for f in explaining])
        return Decision("explained", best, rivals=rivals), singles
    if search.explains(start):
        return Decision("none", start), singles
    return None, singles


def _finished_best(search: Search, fits: Sequence[Fit]) -> list[Fit]:
    """The fits; those that more iterations or finer substeps may bring to the noise floor are refined."""
    promising = [f for f in fits if f.cost < ATTRIBUTION.far_behind * fits[0].cost]
    if fits and search.explains(fits[0]):
        near = fits[0].cost + SEARCH.rival
        promising = [
            f for f in promising if promise(f, SEARCH.further) < near or is_stepped(apply_all(search.rig, f.effects))
        ]
    return [*search.side_by_side(finished, promising), *(f for f in fits if f not in promising)]


def _decide_beyond_singles(
    search: Search,
    start: Fit,
    singles: Sequence[Fit],
    ahead: Sequence[Fit],
    screened: Screening,
    evidence: Evidence,
    tolerance: float,
) -> Decision:
    """The decision among nominal errors, several effects, random forces and a law beyond the catalogue."""
    all_pairs = Pairs.at_once(search, screened)
    pair = _pair_at_noise_floor(all_pairs.copy(), start, singles[:1])
    if pair is not None:
        return pair
    stepwise = Stepwise(search, tolerance, ahead)
    alone = _single_in_louder_noise(search, start, singles, stepwise)
    if alone is not None:
        return alone
    is_near_noise = min(f.cost for f in (start, *singles)) < 1.0 + STEPWISE.no_gap
    # damping is hardly known: if only its errors are large, only an effect that makes them smaller is searched for
    is_explained = stepwise.is_sufficient or stepwise.without_errors() or stepwise.by_singles() or stepwise.by_few()
    is_explained = is_explained or stepwise.by_almost_alone(singles)
    is_explained = is_explained or (stepwise.is_noise_only and stepwise.has_plausible_errors)
    if not ((is_explained and stepwise.is_noise_only) or is_near_noise or search.is_over):
        random = random_with_effects(search, singles)
        if random is None and not is_explained:
            random = random_with_nominal_errors(search, stepwise.steps[0])
        if random is not None:
            return random
    if is_explained:
        stepwise.run()
    by_mode = None if search.is_over or (is_explained and stepwise.has_plausible_errors) else with_mode_errors(stepwise)
    if by_mode is not None or is_explained:
        return (by_mode or stepwise).decision()
    # a law at one point is asked for first: it takes a second, and a selection beside deviations minutes
    other_law = None if search.is_over else force_of_other_law(search, evidence)
    varied = None if other_law is not None or search.is_over else with_record_deviations(stepwise)
    if varied is not None:
        return varied.decision()
    pairs = all_pairs.copy()
    # implausible nominal errors show a missing effect, so sets of few effects without nominal errors come first
    is_better = stepwise.last.is_plausible and stepwise.last.fit.cost < min(f.cost for f in (start, *singles))
    if other_law is None and is_better:
        stepwise.run()
        if stepwise.is_conclusive:
            return stepwise.decision()
    explained = pairs.explain or (other_law is None and pairs.with_a_third())
    decision = pairs.decision(start)
    if other_law is not None:
        return law_or_decision(other_law, search, decision)
    if explained and not (are_uniform_errors(decision.best.effects) and stepwise.needs_no_effect):
        return decision
    stepwise.run()
    if not stepwise.is_conclusive and stepwise.decision().outcome != "explained" and pairs.by_exchange():
        decision = pairs.decision(start)
        if not (are_uniform_errors(decision.best.effects) and stepwise.needs_no_effect):
            return decision
    decision = nearest(search, start, stepwise.decision(), pairs.found)
    if decision.outcome in ("explained", "none") or search.is_over:
        return decision
    random = random_with_effects(search, pairs.found[:1])
    return random or random_with_nominal_errors(search, stepwise.steps[0], surely=False) or decision


def _pair_at_noise_floor(pairs: Pairs, start: Fit, singles: Sequence[Fit]) -> Decision | None:
    """Two effects that explain the records with the stated sensor noise, or None.

    None also if one is a plausible error of the model or has no significant parameter, or if one is a uniform error and
    the other uniform error surely explains more. A search with nominal errors takes longer, so these pairs come first.
    """
    search = pairs.search
    near = [effect for f in singles if search.near(f, PAIRS.most) for effect in f.effects]
    if not (pairs.explain or pairs.with_any(near)):
        return None
    decision = pairs.decision(start)
    effects = decision.best.effects
    if are_uniform_errors(effects) or any(is_plausible_error(effect, search) for effect in effects):
        return None
    missing = [effect for effect in NO_UNIFORM_ERROR if effect.kind not in {e.kind for e in effects}]
    if len(missing) == 1:  # an imperfect model has both uniform errors, and a damper may stand for one of damping
        both = fit(search.rig, (*effects, *missing), search.data, iterations=ATTRIBUTION.together)
        if search.surely_better(both, decision.best.cost, 1):
            return None
    sure = with_intervals(search.rig, decision.best, search.data, search.workers).effects
    return decision if all(effect.stands_out(search.rig) for effect in sure) else None


def _single_in_louder_noise(search: Search, start: Fit, singles: Sequence[Fit], stepwise: Stepwise) -> Decision | None:
    """The decision for a single effect that explains the records if the noise is louder than stated, or None.

    One effect has fewer parameters than nominal errors that fit equally well.
    """
    stated, best = search.data.noise, singles[0] if singles else start
    under_errors = np.sqrt(stepwise.last.sensor_noise) * stated
    noise = np.clip(noise_of(search, best), stated, (1.0 + ATTRIBUTION.a_tenth) ** 0.5 * under_errors)
    if np.median(noise / stated) ** 2 < 1.0 + ATTRIBUTION.a_tenth:
        return None
    louder = search.with_noise(noise)

    def in_louder(candidate: Fit) -> Fit:
        by_channel = candidate.cost_by_channel * (stated / noise) ** 2
        return replace(candidate, cost=float(by_channel.mean()), cost_by_channel=by_channel)

    promising = [f for f in map(in_louder, singles) if louder.explains(f) or louder.near(f, ATTRIBUTION.very_near)]
    decision = _decide_on_singles(louder, in_louder(start), promising)[0] if promising else None
    if decision is None or decision.outcome != "explained":
        return None
    return decision._replace(noise=noise)


def _decide_with_nominal_errors(search: Search, tolerance: float) -> Decision:
    """The decision with nominal errors from the first."""
    stepwise = Stepwise(search, tolerance)
    varied = None if stepwise.is_sufficient else with_record_deviations(stepwise)
    if varied is not None:
        return varied.decision()
    stepwise.run()
    return stepwise.decision()


def force_of_other_law(search: Search, evidence: Evidence) -> Fit | None:
    """A force at one point that explains the records alone, with a law beyond the catalogue or a power law in it.

    Two effects at one place can fit many laws, so this comes before pairs are accepted. None if there is none.
    """
    search.report("one force of a law beyond the catalogue", 0.35)
    beyond = replace(search, catalogue=BEYOND)
    promising = [f for f in one_more(beyond, (), evidence) if f.cost < SELECTION.promising]
    fits = on_whole_records(beyond, promising, LAW.tried, to_cost=search.cost_limit)
    return next((f for f in (_as_catalogue_kind(search, f) for f in fits) if search.explains(f)), None)


def _as_catalogue_kind(search: Search, law: Fit) -> Fit:
    """A fit of a force of another law, replaced by the kind of the catalogue that has its power, if there is one."""
    known = in_catalogue(law.effects[0])
    return law if known is None else finished(search, fit(search.rig, (known,), search.data))


def unless_other_law(search: Search, decision: Decision, evidence: Evidence) -> Decision:
    """The decision, or that for a law beyond the catalogue if the records surely prefer it to one law at a point.

    Args:
        search: records and nominal rig.
        decision: to be compared.
        evidence: of the nominal rig.
    """
    best = decision.best
    if decision.outcome != "explained" or len(best.effects) != 1:
        return decision
    (effect,) = best.effects
    if not effect.kind.nonlinear or effect.at is None:
        return decision
    search.report("one force of a law beyond the catalogue", 0.9)
    beyond, there = replace(search, catalogue=BEYOND), evidence.of_force_at(effect.at)
    as_near = cost_of(search.rig, best.effects, search.ahead) + SEARCH.rival
    promising = [f for f in one_more(beyond, (), there) if f.cost < as_near]
    fits = on_whole_records(beyond, promising, LAW.tried, to_cost=search.cost_limit)
    other = [f for f in fits if in_catalogue(f.effects[0]) is None]
    sure = (f for f in other if search.explains(f) and search.surely_better(f, best.cost, best.n_parameters))
    law = next(sure, None)
    return decision if law is None else law_or_decision(law, search, decision)


def law_or_decision(law: Fit, search: Search, decision: Decision) -> Decision:
    """The decision for the likelier of a force of another law and the sets of a decision."""
    named = [decision.best, *(f for f, _ in decision.rivals)] if decision.outcome == "explained" else []
    best, rivals = ranked(search, [law, *named])
    return Decision("unknown" if any_beyond(best.effects) else "explained", best, rivals=rivals)
