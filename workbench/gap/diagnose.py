"""The diagnosis from end to end: rig and records in, verdict out."""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.cases.case import Case
from workbench.deadline import Deadline
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.effect import Effect, Kind, apply_all, can_be, names_in
from workbench.gap.effects.nominal import NOMINAL_ERRORS, IdentifiedPrior, NominalPrior, deviations_of
from workbench.gap.effects.nonlinear import any_beyond
from workbench.gap.localisation.where import Where, locate, locate_force
from workbench.gap.prediction.noise import noise_guessed
from workbench.gap.prediction.residuals import lead_of
from workbench.gap.prediction.workers import Workers
from workbench.gap.report.budget import (
    PLURAL,
    Budget,
    Shrinkage,
    are_small,
    budget_of,
    left_with,
    mean_square,
    measure,
    noise_power,
    power_in,
    power_of_inputs,
    sizes_of,
    with_held_out,
)
from workbench.gap.report.data_faults import data_faults
from workbench.gap.report.experiment import Experiment, next_experiment
from workbench.gap.report.levels import steady_remainder
from workbench.gap.report.record_checks import check_modes, check_records, detectability
from workbench.gap.report.verdict import Verdict
from workbench.gap.search.attribute import Attribution, attribute, baseline
from workbench.gap.search.finish import with_equals
from workbench.gap.search.jointly import too_large
from workbench.gap.search.settings import JOINT
from workbench.gap.setup.faults import setup_faults
from workbench.gap.setup.repeats import check_disjoint
from workbench.records.record import Record, as_records
from workbench.records.units import SI, Units
from workbench.renamed import former_arguments
from workbench.rig.rig import Rig
from workbench.rig.simulate import predict
from workbench.structure.printed import joined_in_words
from workbench.threads import one_blas_thread

LIKELY = 0.01  # probability from which an alternative is worth an experiment
TOLERANCE = 0.01  # of the signal: a gap that is worth no cause
PAID = 0.02  # of what is left of records held out: what an effect that acts there must take away, to be named
TRIFLE = 0.0005  # of the gap there: likewise
CLEAR = 10.0  # times that: what is left there without an effect that counts beyond doubt
HELD_OUT, LEFT = 0.9, 0.1  # share to close on records not fitted; power left beyond the noise that is no chance
UNEXPLAINED = 0.05  # of the gap: a set that leaves more explains it in part
CHANCE = 5.0  # standard deviations of the mean square of white noise: more than that is left of a record by no chance
SECONDS = 120.0  # of processor time of this process and one beside it: twice what cases of a laboratory take at most
SEARCH_SHARE = 0.8  # of that time; the rest is for intervals, budget and the next experiment
ABOVE = 0.2  # of the gap, above the last mode of the model, from which on that is remarked
BESIDE_ERRORS = 0.8  # likewise where the model itself is a little off: 4 % of the gap's power may be left


OVER_FITTING = "The nearest set explains the records it was fitted to, but not the validation records: over-fitting."


@former_arguments(free_nominal="uncertain_nominal", report="progress")
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
    settle: float = 0.0,
    uncertain_nominal: bool = False,
    tolerance: float = TOLERANCE,
    identified: IdentifiedPrior | None = None,
    units: Units = SI,
) -> Verdict:
    """Where a rig and records of the real structure disagree, which effect is missing, how far the gap then shrinks.

    The search sees `records` alone; `validation` is opened once, after the last fit, to measure the shrinkage.

    Args:
        rig: nominal; for a sensor without noise_std, what the quietest bands of its spectrum hold is taken.
        records: one or several, with the rig's inputs and outputs, in its order.
        validation: kept out of every fit.
        catalogue: kinds of effects to try.
        name: of the case.
        progress: called with (what, share done) as the search proceeds.
        workers: processes that share the work, this one included; None for one per core.
        seconds: of processor time of this process, twice as many where it works alone, after which the search ends with
            the best that it has, and the verdict says so; None for no limit. What compiling takes is not counted.
        settle: seconds at the start of each record that are simulated but not counted, where a record does not start
            at rest.
        uncertain_nominal: fit errors of the nominal model beside every effect from the first.
        tolerance: of the signal's rms: a gap beyond the noise that is smaller in every record is reported, and not
            explained; nor is one below a tenth of the noise. What an explained gap leaves below it is not searched
            either, and noted where it is more than the noise.
        identified: errors that the nominal rig has because it was itself identified: they are fitted beside the effects
            in the end, so that intervals allow for them. Those of a rig's modes where their covariance is known.
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
    if seconds is not None and sharing.number == 1:
        seconds *= 2.0
    deadline = Deadline(None if seconds is None else SEARCH_SHARE * seconds)
    for record in (*records, *validation):
        _check(rig, record)
    if not records:
        raise ValueError("a diagnosis needs at least one record to fit; got none")
    shortest = min(record.n_samples * record.sample_time for record in (*records, *validation))
    if not 0.0 <= settle < shortest:
        raise ValueError(
            f"settle must be 0 or more and less than the shortest record, {shortest:g} s; got {settle:g} s"
        )
    check_modes(rig)
    check_records(rig, records, validation, settle=settle)
    check_disjoint(records, validation)
    silent = frozenset(sensor.name for sensor in rig.sensors if not sensor.noise_std)
    if silent:
        each = zip(rig.sensors, noise_guessed(rig, records), strict=True)
        rig = replace(rig, sensors=tuple(replace(s, noise_std=s.noise_std or float(guess)) for s, guess in each))
    faults = setup_faults(rig, records, validation, settle=settle)
    progress("looking for the unmodelled force", 0.02)
    seen, nominal, evidence = baseline(rig, records, settle=settle, guessed=silent, workers=sharing, deadline=deadline)
    with (
        sharing.in_background(lambda: locate_force(nominal.without(_faulty(seen)))) as place,
        sharing.in_background(lambda: detectability(nominal, catalogue=catalogue)) as ready,
    ):
        attribution = attribute(
            seen,
            nominal,
            evidence,
            catalogue=catalogue,
            report=progress,
            uncertain_nominal=uncertain_nominal,
            tolerance=tolerance,
            identified=identified or IdentifiedPrior.of_modes(rig),
        )
        if attribution.outcome == "explained" and attribution.random is None:
            # rivals are fitted to the records as the best set was, which is else at a disadvantage
            alike, search = ready().indistinguishable, replace(attribution.search, data=attribution.weighed)
            rivals = with_equals(search, attribution.best, attribution.alternatives, evidence, alike)
            attribution = replace(attribution, alternatives=rivals)
        attribution = _paid_for(rig, attribution, validation, settle)
        corrected = apply_all(rig, attribution.best.effects)
        shrinkage = measure(rig, corrected, validation, settle=settle)
        accounted = with_held_out(rig, attribution.best.effects, validation, settle=settle)
        beyond = _beyond_models(rig, attribution, validation, settle, accounted)
        if _leaves_much(attribution, shrinkage, beyond):
            attribution = replace(attribution, outcome="part")
        disagreeing = _disagreeing(attribution, shrinkage, validation, settle, tolerance, beyond)
        outcome = _outcome(attribution, shrinkage, beyond, disagreeing)
        errors = next((e for e in accounted if e.kind is NOMINAL_ERRORS), None)
        named = tuple(e for e in accounted if e is not errors)
        effects = named if outcome in ("none", "explained") else ()
        faulty = _faulty(attribution.best.effects)
        as_seen = faulty == _faulty(seen)
        taken_apart = partial(
            budget_of,
            rig,
            errors=errors,
            records=validation or records,
            noise_found=attribution.noise,
            logged=attribution.logged,
            settle=settle,
        )
        budget = taken_apart(effects)
        power = _left_of(rig, (), validation or records, settle) / len(validation or records)
        if outcome == "explained" and _is_much(budget, power, tolerance):
            outcome, effects, attribution = "part", (), replace(attribution, outcome="part")
            budget = taken_apart(effects)
        sound = outcome in ("none", "explained")
        in_records = () if sound else data_faults(rig, records, settle=settle)
        in_unseen = () if sound else data_faults(rig, validation, settle=settle)
        where = locate(nominal, effects, place() if as_seen else locate_force(nominal.without(faulty)))
        of_setup = any(record.name in fault.records for fault in faults for record in validation)
        return Verdict(
            case=name,
            outcome=outcome,
            disagreeing=disagreeing,
            effects=attribution.best.effects,
            alternatives=tuple((fit.named, probability) for fit, probability in attribution.alternatives),
            where=where,
            shrinkage=shrinkage,
            corrected=corrected,
            nominal=rig,
            attribution=attribution,
            detectability=ready(),
            budget=budget,
            experiment=_next(rig, attribution, sharing, units),
            tolerance=tolerance,
            units=units,
            notes=(
                *(fault.sentence for fault in faults),
                *in_records,
                *in_unseen,
                *([OVER_FITTING] if outcome == "part" != attribution.outcome and not (in_unseen or of_setup) else []),
                *([] if sound or disagreeing else _of_gap(outcome, where, budget, rig, units)),
                *([] if sound else filter(None, [steady_remainder(corrected, (*records, *validation), settle=settle)])),
                *(_of_rest(budget, power, tolerance) if sound and attribution.best.effects else ()),
                *_notes(attribution, budget, seconds, silent, sound),
                *_fitted_to_unseen(errors, attribution, validation),
                *(_hiding(errors) if outcome == "explained" else ()),
            ),
        )


def diagnose_case(case: Case, **options: Any) -> Verdict:
    """`diagnose` of what a case holds, stated in its units.

    Args:
        case: rig and records.
        options: of `diagnose`.
    """
    return diagnose(case.rig, case.fit, validation=case.validation, name=case.name, units=case.units, **options)


def _faulty(effects: Sequence[Effect]) -> set[str]:
    """Sensors at fault, which one force at a point would have to explain too."""
    return {name for effect in effects if effect.kind.path == "sensor" for name in names_in(effect.target)}


def _paid_for(rig: Rig, found: Attribution, unseen: Sequence[Record], settle: float) -> Attribution:
    """What was found, without effects that act on records held out and take nothing away there.

    A trifle that is left of a measured gap bends to any law, on the records that were fitted; and what makes
    the gap of others larger, in a nearest set, corrects nothing. What only errors that no careful model has would
    do without stays.
    """
    effects = found.best.effects
    if found.outcome in ("part", "unknown") and not _unpredictable(found):
        with_none, kept = _left_of(rig, found.seen, unseen, settle), effects
        while len(kept) > len(found.seen) and _left_of(rig, kept, unseen, settle) > with_none:
            fewer = [tuple(e for e in kept if e is not one) for one in kept if one not in found.seen]
            kept = min(fewer, key=lambda rest: _left_of(rig, rest, unseen, settle))
        dropped = [e for e in effects if e not in kept]
        return _paid_for(rig, found.without(*dropped), unseen, settle) if dropped else found
    named = [e for e in effects if not e.kind.applied_first and e not in found.seen]
    if found.outcome != "explained" or len(named) < 2 or _unpredictable(found):
        return found
    after = _left_of(rig, effects, unseen, settle)
    trifle = max(PAID * after, TRIFLE * _left_of(rig, (), unseen, settle))
    for effect in named:
        rest = [e for e in effects if e is not effect]
        if _acts(rig, effects, rest, unseen, settle) < PAID * after:
            continue
        # beside others that are fitted anew; first as they are, which shows of most effects that they count
        if _left_of(rig, rest, unseen, settle) < CLEAR * (after + trifle):
            without = found.without(effect)
            if _errors_believed(effects) and not _errors_believed(without.best.effects):
                continue
            if _left_of(rig, without.best.effects, unseen, settle) < after + trifle:
                return _paid_for(rig, without, unseen, settle)
    return found


def _errors_believed(effects: Sequence[Effect]) -> bool:
    """Whether the errors beside effects are those of a careful model: larger ones stand in for what is left out."""
    return not any(too_large(effect) for effect in effects if isinstance(effect.target, NominalPrior))


def _left_of(rig: Rig, effects: Sequence[Effect], unseen: Sequence[Record], settle: float) -> float:
    """Mean square that a rig with effects leaves of records, each sensor by the standard deviation of its readings."""
    return sum(left_with(rig, effects, record, settle) for record in unseen)


def _acts(
    rig: Rig, effects: Sequence[Effect], others: Sequence[Effect], unseen: Sequence[Record], settle: float
) -> float:
    """Mean square by which the readings of records differ between two sets of effects, in the same measure."""
    if not can_be(rig, others):
        return np.inf
    one, other = apply_all(rig, effects), apply_all(rig, others)
    return sum(power_in(record, predict(one, record) - predict(other, record), settle) for record in unseen)


def _outcome(found: Attribution, shrinkage: Shrinkage | None, beyond: np.ndarray, disagreeing: Sequence[str]) -> str:
    if disagreeing:
        return "unknown"
    fails = found.outcome == "explained" and _fails_unseen(found, shrinkage, beyond)
    return "part" if fails else found.outcome


def _is_much(budget: Budget, power: float, tolerance: float) -> bool:
    """Whether a set leaves too much of a gap unexplained to be called its explanation; power: mean square of the gap.

    What is below the tolerance is not searched for.
    """
    least = max(UNEXPLAINED, LEFT * budget.noise)
    return budget.unexplained > least and budget.unexplained * power > tolerance**2


def _leaves_much(found: Attribution, shrinkage: Shrinkage | None, beyond: np.ndarray) -> bool:
    """Whether errors that no model has, and effects beside them, leave far more than noise of records held out.

    Such errors bend to whatever is missing, and what they leave is no louder noise.
    """
    errors = next((e for e in found.best.effects if e.kind is NOMINAL_ERRORS), None)
    if found.outcome != "explained" or shrinkage is None or are_small(sizes_of(errors)) or _unpredictable(found):
        return False
    _, after, floor = _powers(shrinkage)
    return bool((after > JOINT.credible**2 * floor + beyond).any())


def _beyond_models(
    rig: Rig, found: Attribution, unseen: Sequence[Record], settle: float, accounted: Sequence[Effect]
) -> np.ndarray:
    """Mean square (n_records,) that noise of the logged inputs, and a figure's own value in a record, leave there.

    No set closes it.
    """
    beyond = np.zeros(len(unseen))
    if found.logged and unseen:
        beyond = found.logged**2 * power_of_inputs(rig, unseen, settle)
    if any(effect not in found.best.effects for effect in accounted):
        rigs = [apply_all(rig, effects) for effects in (found.best.effects, accounted)]
        common, own = (np.array([mean_square(r, record, settle) for record in unseen]) for r in rigs)
        beyond = beyond + common - own
    return beyond


def _powers(shrinkage: Shrinkage) -> Iterator[np.ndarray]:
    """Mean squares (n_records,) of the gap before and after, and of the noise that was stated."""
    return (np.array([*by_name.values()]) ** 2 for by_name in (shrinkage.before, shrinkage.after, shrinkage.floor))


def _disagreeing(
    found: Attribution,
    shrinkage: Shrinkage | None,
    unseen: Sequence[Record],
    settle: float,
    tolerance: float,
    beyond: np.ndarray,
) -> tuple[str, ...]:
    """Names of the records held out that have a gap, where those that were fitted have none.

    It is larger than the tolerance, than chance, and than what errors of the model may leave where these were fitted.
    """
    if found.outcome != "none" or shrinkage is None:
        return ()
    before, after, _ = _powers(shrinkage)
    noise = beyond + [noise_power(record, found.noise, settle) for record in unseen]
    chance = [CHANCE * np.sqrt(2.0 / (r.n_outputs * (r.n_samples - lead_of(r, settle)))) for r in unseen]
    may_leave = (1.0 - BESIDE_ERRORS) ** 2 if found.best.effects else 0.0
    least = np.max(
        [np.full(len(unseen), tolerance**2), (LEFT + np.array(chance)) * noise, may_leave * (before - noise)], axis=0
    )
    return tuple(record.name for record, is_gap in zip(unseen, after - noise > least, strict=True) if is_gap)


def _fails_unseen(found: Attribution, shrinkage: Shrinkage | None, beyond: float | Floats = 0.0) -> bool:
    """Whether the set leaves much of a gap that it should close on records that it was not fitted to.

    Enough effects of the wrong kind over-fit the records: they do not predict others.

    Args:
        beyond: (n_records,) of `_beyond_models`.
    """
    if shrinkage is None or _unpredictable(found):
        return False
    before, after, floor = _powers(shrinkage)
    floor = max(found.noise_ratio, 1.0) ** 2 * floor + beyond
    left, closable = (np.maximum(power - floor, 0.0).sum() for power in (after, before))
    closed = max(shrinkage.overall, 1.0 - float(np.sqrt(left / max(closable, 1e-300))))
    beside = any(effect.kind is NOMINAL_ERRORS for effect in found.best.effects)
    return bool((after > (1.0 + LEFT) * floor).any()) and closed < (BESIDE_ERRORS if beside else HELD_OUT)


def _unpredictable(found: Attribution) -> list[str]:
    """What the effects leave that no model can predict."""
    return list(dict.fromkeys(effect.kind.unpredictable for effect in found.best.effects if effect.kind.unpredictable))


def _check(rig: Rig, record: Record) -> None:
    for kind, parts, names in (
        ("input", rig.actuators, record.input_names),
        ("output", rig.sensors, record.output_names),
    ):
        expected = tuple(part.name for part in parts)
        if names != expected:
            raise ValueError(
                f"record {record.name!r}: its {kind}s are {', '.join(names) or 'none'}; the rig has"
                f" {', '.join(expected)}, in that order"
            )


def _next(rig: Rig, found: Attribution, workers: Workers, units: Units) -> Experiment | None:
    """The experiment that would separate the best set from its likeliest alternative."""
    explained = found.outcome == "explained" or any_beyond(found.best.effects)
    for other, probability in found.alternatives:
        if explained and probability > LIKELY:
            return replace(next_experiment(rig, found.best, other, found.search.data, workers), time=units.time)
    return None


def _hiding(errors: Effect | None) -> tuple[str, ...]:
    """A note where errors of the model are so large that an effect may be among them."""
    if errors is None or not isinstance(errors.target, NominalPrior):
        return ()
    large = [PLURAL[group] for group in too_large(errors) if group in PLURAL]
    if not large:
        return ()
    return (
        f"The errors of the model in {joined_in_words(large)} are larger than those of a careful test: a linear effect,"
        " such as a damper or a mass, may be hidden among them.",
    )


def _of_gap(outcome: str, where: Where, budget: Budget, rig: Rig, units: Units) -> Iterator[str]:
    """What is said of a gap that is not explained."""
    if where.share_above > ABOVE:
        last = f"{rig.modes.frequencies_hz[-1]:.4g} {'Hz' if units.time == 's' else f'1/{units.time}'}"
        yield (
            f"{100.0 * where.share_above:.0f} % of the gap lies above the last mode of the model ({last}): add modes to"
            " the model, or excite and compare below that."
        )
    if where.is_distorted:
        i, j = np.unravel_index(where.distortions.argmax(), where.distortions.shape)
        yield (
            f"Record {where.record_names[i]!r}: on {('odd', 'even')[j]} lines that the inputs do not have, the gap is"
            f" {10.0 * np.log10(where.distortions[i, j]):.0f} dB above the noise: something there is nonlinear."
        )
    if outcome == "unknown" and budget.is_open and budget.errors:
        yield "Most of the gap is unexplained: sizes of errors of the model, fitted beside it, are no findings."


def _fitted_to_unseen(errors: Effect | None, found: Attribution, unseen: Sequence[Record]) -> Iterator[str]:
    """A note that a figure which differs from record to record was fitted to records held out."""
    fitted = set(deviations_of(errors.values)) if errors is not None else set()
    own = [record.name for record in unseen if record.name in fitted - {r.name for r in found.search.data.records}]
    if errors is not None and own and deviations_of(errors.values)[own[0]]:
        yield (
            f"The {errors.target.figure} of record{'s' if len(own) > 1 else ''} {joined_in_words(own)} was fitted to"
            " the record itself for the budget; the share of the gap that closes is without it, as a prediction is."
        )


def _of_rest(budget: Budget, power: float, tolerance: float) -> Iterator[str]:
    """What is said of more than noise that an explained gap leaves; power: mean square of the gap."""
    if budget.leaves_more_than_noise:
        rest, times = np.sqrt(budget.unexplained * power), np.sqrt(budget.unexplained / budget.noise)
        below = rest < tolerance
        why = (
            f"below the tolerance of {100 * tolerance:g} %, no cause of it was sought"
            if below
            else "something is missed"
        )
        yield f"Beyond the noise, {100 * rest:.2g} % of the signal is left, {times:.2g} times the noise: {why}."


def _notes(
    found: Attribution, budget: Budget, seconds: float | None, silent: Collection[str], sound: bool
) -> tuple[str, ...]:
    """What is said beside the sentence; `silent` are the sensors whose noise was not stated."""
    names = [sensor.name for sensor in found.search.rig.sensors if sensor.name in silent]
    taken = f"noise_std of {', '.join(names)} is not stated; it was taken from the records."
    cut = f"The search reached its limit of {seconds} s of processor time with this best set; allow more by `seconds`."
    notes = (
        *([taken] if silent else []),
        *([cut] if found.is_cut else []),
        budget.noise_remark if sound and not silent else "",  # else more than noise is left
        *_unpredictable(found),
    )
    return tuple(note for note in notes if note)
