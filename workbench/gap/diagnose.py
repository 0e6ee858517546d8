"""The diagnosis: from rig and records to a verdict."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.deadline import Deadline
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.effect import Effect, Kind, apply_all, can_be, names_in
from workbench.gap.effects.nominal import NOMINAL_ERRORS, IdentifiedPrior, NominalPrior
from workbench.gap.effects.nonlinear import any_beyond
from workbench.gap.localisation.breakdown import break_down
from workbench.gap.localisation.force_location import locate_force
from workbench.gap.prediction.noise import LOGGED, noise_guessed
from workbench.gap.prediction.residuals import lead_of
from workbench.gap.prediction.workers import Workers
from workbench.gap.report.budget import (
    Budget,
    Shrinkage,
    are_small,
    budget_of,
    measure,
    noise_power,
    power_of_inputs,
    residual_powers,
    signal_power,
    sizes_of,
    with_held_out,
)
from workbench.gap.report.experiment import Experiment, detectability, next_experiment
from workbench.gap.report.notes import notes_of
from workbench.gap.report.verdict import NEAR, Verdict
from workbench.gap.search.attribute import Attribution, attribute, baseline
from workbench.gap.search.finish import with_equals
from workbench.gap.search.jointly import too_large
from workbench.gap.search.settings import JOINT
from workbench.gap.setup.faults import exchanges, setup_faults
from workbench.gap.setup.record_checks import check_modes, check_records
from workbench.gap.setup.records import check_disjoint
from workbench.records.record import Record, as_records
from workbench.records.units import SI, Units
from workbench.renamed import former_arguments
from workbench.rig.rig import Rig
from workbench.rig.simulate import simulate_record
from workbench.threads import one_blas_thread

LIKELY = 0.01  # probability from which an alternative deserves an experiment
TOLERANCE = 0.01  # of the signal: a smaller gap is not explained
WORTH = 0.02  # of the residual power of held-out records: an effect that acts there must remove more to be named
LEAST_SHARE = 0.0005  # of the gap's power there: likewise
DECISIVE = 10.0  # times the residual with it: an effect without which more is left there is not refitted without
LEAST_CLOSED = 0.9  # share of the gap to be closed on held-out records
LARGEST_LEFT = 0.1  # of the noise power there: a larger residual above the noise is significant
LEAST_CLOSED_WITH_ERRORS = 0.8  # like LEAST_CLOSED, with nominal errors: 4 % of the gap's power may be left
UNEXPLAINED = 0.05  # of the gap: a set that leaves more explains it in part
CHANCE = 5.0  # standard deviations of the mean square of white noise: a larger excess is significant
SECONDS = 120.0  # of processor time of this process and one beside it: twice what cases of a laboratory take at most
SEARCH_SHARE = 0.8  # of that time; the rest is for intervals, budget and the next experiment


@former_arguments(free_nominal="uncertain_nominal", report="progress", settle="transient")
@one_blas_thread
def diagnose(
    rig: Rig,
    records: Record | Iterable[Record],
    *,
    validation: Record | Iterable[Record] = (),
    catalogue: tuple[Kind, ...] = CATALOGUE,
    name: str = "case",
    progress: Callable[[str, float], None] = lambda text, share: None,
    workers: int | None = None,
    seconds: float | None = SECONDS,
    transient: float = 0.0,
    uncertain_nominal: bool = False,
    tolerance: float = TOLERANCE,
    identified: IdentifiedPrior | None = None,
    units: Units = SI,
) -> Verdict:
    """Locate the gap between a rig and records of the real structure, and identify the missing effects.

    The search sees `records` alone; `validation` is used once, after the last fit, to measure the shrinkage.

    Args:
        rig: nominal; the noise of a sensor without noise_std is estimated from the quietest bands of its spectrum.
        records: one or several, with the rig's inputs and outputs, in its order.
        validation: kept out of every fit.
        catalogue: kinds of effects to try.
        name: of the case.
        progress: called with (what, share done) as the search proceeds.
        workers: processes that share the work, this one included; None for one per core.
        seconds: of processor time of this process, doubled if it works alone, after which the search ends with the best
            set so far, and the verdict says so; None for no limit. Compilation is not counted.
        transient: seconds at the start of each record simulated but not compared, as it does not start at rest.
        uncertain_nominal: fit nominal errors jointly with every effect from the first.
        tolerance: of the signal's rms: a gap above the noise that is smaller in every record, or below a tenth of the
            noise, is reported but not explained. A residual of an explained gap below it is noted, if above the noise.
        identified: errors of a nominal rig that was itself identified; they are fitted with the effects at the end, so
            that intervals allow for them. None for those of the rig's modes, if their covariance is known.
        units: names of the units of the rig and the records, in which the verdict states its numbers.

    Raises:
        ValueError: arguments out of their ranges; records that do not fit the rig or cannot be of it, two of one name,
            a validation record that repeats one to be fitted; modes that are not those of the structure.
    """
    records, validation = (tuple(as_records(each)) for each in (records, validation))
    if not 0.0 <= tolerance < 1.0:
        raise ValueError(f"tolerance is a share of the signal's rms, from 0 to below 1; got {tolerance}")
    if not catalogue or not all(isinstance(kind, Kind) for kind in catalogue):
        raise ValueError(
            f"catalogue holds kinds of effects, such as kind_named('cubic_spring'), one or more; got {catalogue}"
        )
    if seconds is not None and not seconds > 0:
        raise ValueError(f"a search needs time: seconds must be positive; got {seconds:g}")
    sharing = Workers.at_hand() if workers is None else Workers(workers)
    deadline = Deadline(None if seconds is None else SEARCH_SHARE * seconds * (2.0 if sharing.number == 1 else 1.0))
    if not records:
        raise ValueError("a diagnosis needs at least one record to fit; got none")
    shortest = min(record.n_samples * record.sample_time for record in (*records, *validation))
    if not 0.0 <= transient < shortest:
        raise ValueError(
            f"transient must be 0 or more and less than the shortest record, {shortest:g} s; got {transient:g} s"
        )
    check_modes(rig)
    check_records(rig, records, validation, transient=transient)
    check_disjoint(records, validation)
    without_noise = frozenset(sensor.name for sensor in rig.sensors if not sensor.noise_std)
    if without_noise:
        each = zip(rig.sensors, noise_guessed(rig, records), strict=True)
        rig = replace(rig, sensors=tuple(replace(s, noise_std=s.noise_std or float(guess)) for s, guess in each))
    faults = setup_faults(rig, records, validation, transient=transient)
    progress("locating the unmodelled force", 0.02)
    exchanged = tuple(e for e in exchanges(faults, (*records, *validation)) if e.kind in catalogue)
    wired = apply_all(rig, exchanged)
    seen, as_wired, reconstruction = baseline(
        wired, records, transient=transient, guessed=without_noise, workers=sharing, deadline=deadline
    )
    nominal, given, added = reconstruction.of_rig(rig) if exchanged else as_wired, (*exchanged, *seen), exchanged
    with (
        sharing.in_background(lambda: locate_force(nominal.without(_faulty(given)))) as place,
        sharing.in_background(lambda: detectability(nominal, catalogue=catalogue)) as ready,
    ):
        attribution = attribute(
            seen,
            as_wired,
            reconstruction,
            catalogue=catalogue,
            progress=progress,
            uncertain_nominal=uncertain_nominal,
            tolerance=tolerance,
            identified=identified or IdentifiedPrior.of_modes(rig),
        )
        if attribution.missing:
            wired, added = apply_all(wired, attribution.missing), (*exchanged, *attribution.missing)
            reconstruction = reconstruction.of_rig(apply_all(reconstruction.rig, attribution.missing))
        if attribution.outcome == "explained" and attribution.random is None:
            # alternatives are fitted to the same whitened records as the best set
            alike, search = ready().indistinguishable, replace(attribution.search, data=attribution.whitened)
            alternatives = with_equals(search, attribution.best, attribution.alternatives, reconstruction, alike)
            attribution = replace(attribution, alternatives=alternatives)
        attribution = _validated(wired, attribution, validation, transient)
        if added:
            attribution = attribution.with_given(added, nominal)
        corrected = apply_all(rig, attribution.best.effects)
        shrinkage = measure(rig, corrected, validation, transient=transient)
        accounted = with_held_out(rig, attribution.best.effects, validation, transient=transient)
        beyond = _power_beyond_effects(rig, attribution, validation, transient, accounted)
        if _leaves_far_more_than_noise(attribution, shrinkage, beyond):
            attribution = replace(attribution, outcome="part")
        disagreeing = _disagreeing(attribution, shrinkage, validation, transient, tolerance, beyond)
        outcome = _outcome(attribution, shrinkage, beyond, disagreeing)
        errors = next((e for e in accounted if e.kind is NOMINAL_ERRORS), None)
        effects = tuple(e for e in accounted if e is not errors) if outcome in ("none", "explained") else ()
        measured = validation or records
        how: Any = {"noise_found": attribution.noise, "transient": transient}
        budget = budget_of(rig, effects, errors, measured, logged=_input_noise(attribution, outcome), **how)
        power = _residual_power(rig, (), measured, transient) / len(measured)
        if outcome == "explained" and _leaves_unexplained(budget, power, tolerance):
            attribution = replace(attribution, outcome="part")
            outcome, effects = _outcome(attribution, shrinkage, beyond, disagreeing), ()
            budget = budget_of(rig, effects, errors, measured, logged=_input_noise(attribution, outcome), **how)
        faulty = _faulty(attribution.best.effects)
        located = place() if faulty == _faulty(given) else locate_force(nominal.without(faulty))
        verdict = Verdict(
            case=name,
            outcome=outcome,
            disagreeing=disagreeing,
            effects=attribution.best.effects,
            alternatives=tuple((fit.named, probability) for fit, probability in attribution.alternatives),
            where=break_down(nominal, effects, located),
            shrinkage=shrinkage,
            corrected=corrected,
            nominal=rig,
            attribution=attribution,
            detectability=ready(),
            budget=budget,
            experiment=_next_experiment(rig, attribution, sharing, units),
            tolerance=tolerance,
            units=units,
        )
        notes = notes_of(
            verdict, records, validation, faults, errors=errors, power=power, transient=transient, seconds=seconds
        )
        return replace(verdict, notes=notes)


def _faulty(effects: Sequence[Effect]) -> set[str]:
    """Names of faulty sensors, which are left out of the localisation of a force."""
    return {name for effect in effects if effect.kind.path == "sensor" for name in names_in(effect.target)}


def _validated(rig: Rig, found: Attribution, held_out: Sequence[Record], transient: float) -> Attribution:
    """The attribution without effects that act on held-out records but do not reduce their residual.

    Any law fits some of the residual of the fitted records. An effect stays if only implausibly large nominal errors
    would make it unnecessary. Of a set that explains the gap in part, effects that enlarge the residual are dropped,
    and those without any parameter beyond its standard deviation.
    """
    effects = found.best.effects
    if found.outcome in ("part", "unknown") and not _unpredictable(found):
        with_none = _residual_power(rig, found.seen, held_out, transient)
        kept = tuple(e for e in effects if e.is_in_readings or e.stands_out(rig))
        while len(kept) > len(found.seen) and _residual_power(rig, kept, held_out, transient) > with_none:
            fewer = [tuple(e for e in kept if e is not one) for one in kept if not one.is_in_readings]
            kept = min(fewer, key=lambda rest: _residual_power(rig, rest, held_out, transient))
        dropped = [e for e in effects if e not in kept]
        return _validated(rig, found.without(*dropped), held_out, transient) if dropped else found
    named = [e for e in effects if not e.kind.applied_first and not e.is_in_readings]
    if found.outcome != "explained" or len(named) < 2 or not held_out or _unpredictable(found):
        return found
    after = _residual_power(rig, effects, held_out, transient)
    least = max(WORTH * after, LEAST_SHARE * _residual_power(rig, (), held_out, transient))
    for effect in named:
        rest = [e for e in effects if e is not effect]
        if _power_of_difference(rig, effects, rest, held_out, transient) < WORTH * after:
            continue
        # most effects count decisively even with the others unchanged; else the others are refitted
        if _residual_power(rig, rest, held_out, transient) < DECISIVE * (after + least):
            without = found.without(effect)
            if _errors_are_plausible(effects) and not _errors_are_plausible(without.best.effects):
                continue
            if _residual_power(rig, without.best.effects, held_out, transient) < after + least:
                return _validated(rig, without, held_out, transient)
    return found


def _errors_are_plausible(effects: Sequence[Effect]) -> bool:
    """Whether the nominal errors among effects are plausible: larger ones may have absorbed an effect left out."""
    return not any(too_large(effect) for effect in effects if isinstance(effect.target, NominalPrior))


def _residual_power(rig: Rig, effects: Sequence[Effect], held_out: Sequence[Record], transient: float) -> float:
    """Mean square residual of a rig with effects, summed over records, each sensor scaled by its standard deviation."""
    return float(sum(residual_powers(rig, effects, held_out, transient)))


def _power_of_difference(
    rig: Rig, effects: Sequence[Effect], others: Sequence[Effect], held_out: Sequence[Record], transient: float
) -> float:
    """Mean square difference of the readings between two sets of effects, in the units of `_residual_power`."""
    if not can_be(rig, others):
        return np.inf
    one, other = apply_all(rig, effects), apply_all(rig, others)
    with np.errstate(over="ignore", invalid="ignore"):  # without one of two effects in balance, a response may diverge
        differences = [(record, simulate_record(one, record) - simulate_record(other, record)) for record in held_out]
        return sum(signal_power(record, difference, transient) for record, difference in differences)


def _outcome(found: Attribution, shrinkage: Shrinkage | None, beyond: np.ndarray, disagreeing: Sequence[str]) -> str:
    """The outcome, after the test on held-out records.

    A gap is explained in part only by a nearest set that closes some of it there, as `Verdict.sentence` states it.
    """
    if disagreeing:
        return "unknown"
    if found.outcome == "explained" and _over_fits(found, shrinkage, beyond):
        return "part"
    closes = shrinkage is None or shrinkage.overall >= NEAR or _unpredictable(found)
    return "unknown" if found.outcome == "part" and not (found.best.effects and closes) else found.outcome


def _input_noise(found: Attribution, outcome: str) -> float:
    """Noise of the logged inputs, as a share of their rms; 0 where it is at its bound and the gap is unexplained.

    Whatever is missing then fills it.
    """
    return 0.0 if found.logged >= LOGGED.max_share and outcome in ("part", "unknown") else found.logged


def _leaves_unexplained(budget: Budget, power: float, tolerance: float) -> bool:
    """Whether a set leaves more of the gap unexplained than an explanation may, and more than the tolerance.

    power: mean square of the gap.
    """
    least = max(UNEXPLAINED, LARGEST_LEFT * budget.noise)
    return budget.unexplained > least and budget.unexplained * power > tolerance**2


def _leaves_far_more_than_noise(found: Attribution, shrinkage: Shrinkage | None, beyond: np.ndarray) -> bool:
    """Whether effects with implausibly large nominal errors leave a residual far above the noise of held-out records.

    Such errors over-fit whatever is missing, so the residual is not just more noise than stated.
    """
    errors = next((e for e in found.best.effects if e.kind is NOMINAL_ERRORS), None)
    if found.outcome != "explained" or shrinkage is None or are_small(sizes_of(errors)) or _unpredictable(found):
        return False
    _, after, floor = _powers(shrinkage)
    return bool((after > JOINT.credible_noise**2 * floor + beyond).any())


def _power_beyond_effects(
    rig: Rig, found: Attribution, held_out: Sequence[Record], transient: float, accounted: Sequence[Effect]
) -> np.ndarray:
    """Mean square residual (n_records,) due to input noise and to parameters that vary from record to record.

    No set of effects removes it from held-out records.
    """
    beyond = np.zeros(len(held_out))
    if found.logged and held_out:
        beyond = found.logged**2 * power_of_inputs(rig, held_out, transient)
    if any(effect not in found.best.effects for effect in accounted):
        common, own = (residual_powers(rig, each, held_out, transient) for each in (found.best.effects, accounted))
        beyond = beyond + common - own
    return beyond


def _powers(shrinkage: Shrinkage) -> Iterator[np.ndarray]:
    """Mean squares (n_records,) of the gap before and after, and of the stated noise."""
    return (np.array([*by_name.values()]) ** 2 for by_name in (shrinkage.before, shrinkage.after, shrinkage.floor))


def _disagreeing(
    found: Attribution,
    shrinkage: Shrinkage | None,
    held_out: Sequence[Record],
    transient: float,
    tolerance: float,
    beyond: np.ndarray,
) -> tuple[str, ...]:
    """Names of the held-out records that have a gap although the fitted records have none.

    The gap must exceed the tolerance, chance, and the residual that fitted nominal errors may leave.
    """
    if found.outcome != "none" or shrinkage is None:
        return ()
    before, after, _ = _powers(shrinkage)
    noise = beyond + [noise_power(record, found.noise, transient) for record in held_out]
    chance = [CHANCE * np.sqrt(2.0 / (r.n_outputs * (r.n_samples - lead_of(r, transient)))) for r in held_out]
    tolerated = (1.0 - LEAST_CLOSED_WITH_ERRORS) ** 2 if found.best.effects else 0.0
    least = np.maximum((LARGEST_LEFT + np.array(chance)) * noise, tolerated * (before - noise)).clip(tolerance**2)
    return tuple(record.name for record, is_gap in zip(held_out, after - noise > least, strict=True) if is_gap)


def _over_fits(found: Attribution, shrinkage: Shrinkage | None, beyond: float | Floats = 0.0) -> bool:
    """Whether a set that explains the fitted records leaves much of the gap of held-out records: over-fitting.

    beyond: (n_records,) of `_power_beyond_effects`.
    """
    if shrinkage is None or _unpredictable(found):
        return False
    before, after, floor = _powers(shrinkage)
    floor = max(found.noise_ratio, 1.0) ** 2 * floor + beyond
    left, closable = (np.maximum(power - floor, 0.0).sum() for power in (after, before))
    closed = max(shrinkage.overall, 1.0 - float(np.sqrt(left / max(closable, 1e-300))))
    has_errors = any(effect.kind is NOMINAL_ERRORS for effect in found.best.effects)
    least = LEAST_CLOSED_WITH_ERRORS if has_errors else LEAST_CLOSED
    return bool((after > (1.0 + LARGEST_LEFT) * floor).any()) and closed < least


def _unpredictable(found: Attribution) -> bool:
    """Whether no model can predict a part of the response."""
    return any(effect.kind.unpredictable for effect in found.best.effects)


def _next_experiment(rig: Rig, found: Attribution, workers: Workers, units: Units) -> Experiment | None:
    """The experiment that would separate the best set from its likeliest alternative."""
    explained = found.outcome == "explained" or any_beyond(found.best.effects)
    for other, probability in found.alternatives:
        if explained and probability > LIKELY:
            return replace(next_experiment(rig, found.best, other, found.search.data, workers), time=units.time)
    return None
