"""The notes of a verdict: remarks on the records, the gap and the search, a sentence each."""

from collections.abc import Iterator, Sequence

import numpy as np

from workbench.gap.effects.effect import Effect
from workbench.gap.effects.nominal import NominalPrior, deviations_of
from workbench.gap.localisation.breakdown import BREAKDOWN
from workbench.gap.prediction.residuals import lead_of
from workbench.gap.report.budget import PERCENT, Budget, block_length
from workbench.gap.report.verdict import Verdict
from workbench.gap.search.attribute import Attribution
from workbench.gap.search.jointly import too_large
from workbench.gap.setup.corrections import SetupFault
from workbench.gap.setup.records import data_faults
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import simulate_record
from workbench.structure.printed import joined_in_words

ABOVE = 0.2  # of the gap: a larger share above the last mode is remarked
STEADY = 0.5  # exponent of the level: residuals of constant size have a smaller one; errors of a linear model have 1
SURE = 2.0  # standard errors of that exponent

OVER_FITTING = "The best set explains the records that it was fitted to, but not the validation records: over-fitting."


def notes_of(
    verdict: Verdict,
    records: Sequence[Record],
    validation: Sequence[Record],
    faults: Sequence[SetupFault],
    *,
    errors: Effect | None,
    power: float,
    transient: float,
    seconds: float | None,
) -> tuple[str, ...]:
    """The notes, in the order in which they are stated.

    errors: of the nominal model, those of held-out records included; power: mean square of the gap, each sensor scaled
    by the standard deviation of its readings; seconds: limit of the search.
    """
    found, budget, outcome = verdict.attribution, verdict.budget, verdict.outcome
    notes = [fault.sentence for fault in faults]
    if verdict.is_decided:
        if found.best.effects:
            notes += _of_residual(budget, power, verdict.tolerance)
    else:
        in_validation = data_faults(verdict.nominal, validation, transient=transient)
        notes += [*data_faults(verdict.nominal, records, transient=transient), *in_validation]
        is_faulty = in_validation or any(record.name in fault.records for fault in faults for record in validation)
        if outcome == "part" != found.outcome and not is_faulty:
            notes.append(OVER_FITTING)
        if not verdict.disagreeing:
            notes += _of_gap(verdict)
        notes += filter(None, [steady_remainder(verdict.corrected, (*records, *validation), transient=transient)])
    guessed = [sensor.name for sensor in verdict.nominal.sensors if sensor.name in found.search.data.guessed]
    if guessed:
        notes.append(f"noise_std of {', '.join(guessed)} is not stated; it was estimated from the records.")
    if found.is_cut and seconds is not None:
        notes.append(f"The search reached its limit of time, `seconds` {seconds:g}; a larger one lets it continue.")
    if verdict.is_decided and not guessed and budget.noise_remark:  # otherwise the residual is not only noise
        notes.append(budget.noise_remark)
    notes += dict.fromkeys(effect.kind.unpredictable for effect in verdict.effects if effect.kind.unpredictable)
    notes += _of_record_deviations(errors, found, validation)
    return (*notes, *(_of_large_errors(errors) if outcome == "explained" else ()))


def _of_gap(verdict: Verdict) -> Iterator[str]:
    """Notes on a gap that is not explained."""
    where, time = verdict.where, verdict.units.time
    if where.share_above > ABOVE:
        last = f"{verdict.nominal.modes.frequencies_hz[-1]:.4g} {'Hz' if time == 's' else f'1/{time}'}"
        yield (
            f"{100.0 * where.share_above:.0f} % of the gap lies above the last mode of the model ({last}): add modes to"
            " the model, or excite and compare below that."
        )
    if where.is_distorted:
        i, j = np.unravel_index(where.distortions.argmax(), where.distortions.shape)
        yield (
            f"Record {where.record_names[i]!r}: on {('odd', 'even')[j]} lines that the inputs do not excite, the gap is"
            f" {10.0 * np.log10(where.distortions[i, j]):.0f} dB above the noise: a nonlinearity is present."
        )
    if verdict.attribution.reconstruction.has_several_rates:
        yield "The records have several sample rates, so no random force was searched for: resample them to one rate."
    if verdict.outcome == "unknown" and verdict.budget.is_mostly_unexplained and verdict.budget.errors:
        yield "Most of the gap is unexplained, so the fitted sizes of the model's errors are not meaningful."


def steady_remainder(rig: Rig, records: Sequence[Record], *, transient: float = 0.0) -> str | None:
    """A remark if the residual above the noise is of the same size at all levels of the inputs; else None.

    Its rms is fitted by a power of the level; the standard error of the exponent follows from the scatter over blocks
    of a record. Records without inputs or with a residual at the noise floor are ignored.
    """
    noise = np.array([sensor.noise_std for sensor in rig.sensors])[:, None]
    by_level = []
    for record in records:
        level = np.sqrt(np.mean(record.inputs**2))
        lead = lead_of(record, transient)
        power = (((record.outputs - simulate_record(rig, record))[:, lead:] / noise) ** 2).mean(axis=0)
        if level > 0 and power.mean() > (1.0 + BREAKDOWN.noise_margin) ** 2:
            blocks = np.array_split(power, power.size // block_length(rig, power.size, record.sample_time))
            means = np.array([block.mean() for block in blocks])
            scatter = means.std(ddof=1) / np.sqrt(means.size)
            by_level.append((level, power.mean() - 1.0, scatter / (power.mean() - 1.0), record.name))
    by_level.sort()
    if len(by_level) < 2 or by_level[-1][0] < BREAKDOWN.level_ratio * by_level[0][0]:
        return None
    levels, powers, scatters = np.array([each[:3] for each in by_level]).T
    weights = 4.0 / scatters**2  # inverse variances of the logarithm of the rms
    x, y = np.log(levels), 0.5 * np.log(powers)
    x, y = x - np.average(x, weights=weights), y - np.average(y, weights=weights)
    spread = (weights * x**2).sum()
    exponent = (weights * x * y).sum() / spread
    if abs(exponent) + SURE / np.sqrt(spread) > STEADY:
        return None
    (low, _, _, quiet), (high, _, _, loud) = by_level[0], by_level[-1]
    rms = np.sqrt(powers)
    return (
        f"The residual does not grow with the inputs: it is {rms[0]:.3g} times the noise in record {quiet!r} and"
        f" {rms[-1]:.3g} times in {loud!r}, whose inputs are {high / low:.2g} times as large. Possible causes are an"
        " excitation that is not measured (measure it, or keep it away), noise above that stated, and a force"
        " of constant size, such as dry friction or play."
    )


def _of_residual(budget: Budget, power: float, tolerance: float) -> Iterator[str]:
    """A note on the residual of an explained gap above the noise; power: mean square of the gap."""
    if budget.has_unexplained_residual:
        rest, times = np.sqrt(budget.unexplained * power), np.sqrt(budget.unexplained / budget.noise)
        below = f"below the tolerance of {100 * tolerance:g} %, so its cause was not searched for"
        why = below if rest < tolerance else "an effect is missing"
        yield f"The residual above the noise is {100 * rest:.2g} % of the signal, {times:.2g} times the noise: {why}."


def _of_record_deviations(errors: Effect | None, found: Attribution, held_out: Sequence[Record]) -> Iterator[str]:
    """A note that the deviation of a parameter that varies from record to record was fitted to held-out records."""
    fitted = set(deviations_of(errors.values)) if errors is not None else set()
    own = [record.name for record in held_out if record.name in fitted - {r.name for r in found.search.data.records}]
    if errors is not None and own and deviations_of(errors.values)[own[0]]:
        yield (
            f"The {errors.target.parameter} of record{'s' if len(own) > 1 else ''} {joined_in_words(own)} was fitted to"
            " the record itself for the budget; the share of the gap that closes is computed without it."
        )


def _of_large_errors(errors: Effect | None) -> Iterator[str]:
    """A note that nominal errors are so large that they may include an effect."""
    if errors is None or not isinstance(errors.target, NominalPrior):
        return
    large = [PERCENT[group][0] for group in too_large(errors) if group in PERCENT]
    if large:
        yield (
            f"The errors of the model in {joined_in_words(large)} are larger than those of a careful test: a linear"
            " effect, such as a damper or a mass, may be hidden among them."
        )
