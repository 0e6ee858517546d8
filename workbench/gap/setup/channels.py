"""Faults of channels: exchanged, of the wrong sign, in another unit, or of another quantity than stated.

A missing effect changes some bands, up or down; a fault of a channel changes all of its bands alike. So a candidate is
accepted if its correction lowers the misfit of most bands, and by more than any other correction.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from workbench.arrays import Flags, Floats
from workbench.gap.setup.comparison import (
    MAX_INPUTS,
    MIN_CLOSED_SHARE,
    MIN_MISFIT_CHANGE,
    Comparison,
    band_misfit,
    compared_bands,
)
from workbench.gap.setup.corrections import (
    FACTORS,
    TURN,
    G,
    SetupFault,
    agreeing,
    exchanged,
    inputs_times,
    outputs_times,
    quantity_set,
    relabelled,
    sentence_of_inputs,
    sentence_of_outputs,
    subject,
    with_may,
)

# decrease of the mean misfit over affected bands: a factor of 1.8 or more has it, and a wrong sign has 2
MIN_DECREASE = 0.4
MAX_MISFIT_LEFT = 0.9  # mean misfit that may remain there: uncorrelated signals have at least 1
MIN_REMOVED_SHARE = 0.5  # of the mean misfit there, which must go: the changes by a missing effect stay
MIN_BAND_SHARE = 0.8  # share of these bands in which the misfit must decrease
# mean misfit by which it must be better than any alternative, where they differ: 2π and 9.81 differ by 0.44
MISFIT_MARGIN = 0.25
MIN_DIFFERING_SHARE = 0.1  # share of the affected bands in which it must differ from any alternative
QUANTITIES = ("displacement", "velocity", "acceleration")
# largest relative difference of a gain from a factor near it: the smallest ratio of two factors is 1.56
FACTOR_TOLERANCE = 0.15
# of a factor's logarithm: largest difference of the log gains of two records (2π: a factor 1.2 between them)
LOG_GAIN_TOLERANCE = 0.1
# an error of calibration removes a larger share of the residual power beyond the noise that the factor leaves
GAIN_SHARE = 0.5
GAIN_CHI2 = 25.0  # and differs from the factor by five standard errors, in white noise
GAIN_TOLERANCE = 1e-3  # relative: a gain closer to a factor is that factor (9.81 for 9.80665 is 3.4e-4)
# factors that a wrong calibration may reach; others are too far from one
AMBIGUOUS_FACTORS = (G, 1.0 / G, TURN, 1.0 / TURN)
# standard error of a median by the median absolute deviation and the root of the number, if normal
MEDIAN_ERROR_RATIO = 1.858
MAX_LOG_DISTANCE = 0.22  # of the logarithm of a gain: half the smallest ratio of two factors
TEN_TOLERANCE = 0.01  # relative: if all gains are as near to 10, an amplifier is as likely as g, which differs by 2 %


def channel_faults(gap: Comparison, kinds: Collection[str]) -> list[SetupFault]:
    """The most probable certain fault, of all outputs or of channels that share it; else all that are in doubt.

    kinds: of candidates that may be accepted.
    """
    alike: dict[tuple[str, Any, bool], set[int]] = {}
    for candidate in accepted(gap):
        certain = _is_certain(gap, candidate)
        if candidate.kind in kinds and certain is not None:
            alike.setdefault((candidate.kind, candidate.value, certain), set()).update(candidate.at)
            if certain and candidate.kind == "outputs" and len(candidate.at) == len(gap.rig.sensors):
                return [_fault(gap, candidate.kind, candidate.value, candidate.at, True)]
    faults = [_fault(gap, kind, value, sorted(at), certain) for (kind, value, certain), at in alike.items()]
    return [fault for fault in faults if fault.certain][:1] or faults


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate fault of one channel, of two exchanged ones or of all outputs, and the misfit once it is corrected.

    Attributes:
        kind: "outputs" or "inputs" for a factor, "quantity", "exchanged outputs" or "exchanged inputs".
        value: the factor, the stated and the true quantity, or the names of the two channels.
        at: indices of the channels.
        misfit: (n_records, n_outputs, n_modes) after the correction.
    """

    kind: str
    value: Any
    at: tuple[int, ...]
    misfit: Floats


def accepted(gap: Comparison) -> list[Candidate]:
    """The candidates whose correction removes most of the misfit where it acts, more than any alternative; best first.

    An alternative affects at least half of the same bands: a fault elsewhere may be present too. An input without any
    effect is among the alternatives, since an unmodelled effect may have changed its response altogether.
    """
    compared = compared_bands(gap.measured_spectra)
    before = gap.misfit[compared]
    better = [candidate for candidate in _candidates(gap) if candidate.misfit[compared].sum() < before.sum()]
    better.sort(key=lambda candidate: float(candidate.misfit[compared].sum()))
    after = np.array([candidate.misfit[compared] for candidate in better]).reshape(-1, before.size)
    affected = np.abs(after - before) > MIN_MISFIT_CHANGE
    chosen = []
    for i, candidate in enumerate(better):
        at = affected[i]
        if not at.any():
            continue
        decrease = (before - after[i])[at]
        least = max(MIN_DECREASE, MIN_REMOVED_SHARE * before[at].mean(), before[at].mean() - MAX_MISFIT_LEFT)
        if decrease.mean() < least or (decrease > 0).mean() < MIN_BAND_SHARE:
            continue
        alternatives = affected[:, at].mean(axis=1) >= 0.5
        alternatives[i] = False
        differs = np.abs(after[alternatives] - after[i]) > MIN_MISFIT_CHANGE
        margin = np.where(differs, after[alternatives] - after[i], 0.0).sum(axis=1)
        if (margin > MISFIT_MARGIN * np.maximum(differs.sum(axis=1), MIN_DIFFERING_SHARE * at.sum())).all():
            chosen.append(candidate)
    return chosen


def _candidates(gap: Comparison) -> Iterator[Candidate]:
    """Every candidate fault of one input, one output with a wide gap, two exchanged ones, and all outputs alike."""
    rig, measured, simulated = gap.rig, gap.measured_spectra, gap.simulated_spectra
    n, wide = len(rig.sensors), [int(j) for j in np.flatnonzero(gap.wide)]
    for factor in FACTORS:
        misfit = band_misfit(measured, simulated, factor)
        yield Candidate("outputs", factor, tuple(range(n)), misfit)
        for j in wide if n > 1 else ():
            yield Candidate("outputs", factor, (j,), gap.misfit_with((j,), misfit[:, [j]]))
    for i, j in combinations(wide, 2):
        misfit = band_misfit(measured.select((i, j)), simulated.select((j, i)))
        names = rig.sensors[i].name, rig.sensors[j].name
        yield Candidate("exchanged outputs", names, (i, j), gap.misfit_with((i, j), misfit))
    for quantity in QUANTITIES:
        others = [j for j in wide if rig.sensors[j].quantity in set(QUANTITIES) - {quantity}]
        if others:
            with_quantity = relabelled(rig, [rig.sensors[j].name for j in others], quantity)
            misfit = band_misfit(measured, gap.spectra_of(gap.simulated_with(with_quantity, gap.records)))
            for j in others:
                stated_and_true = (rig.sensors[j].quantity, quantity)
                yield Candidate("quantity", stated_and_true, (j,), gap.misfit_with((j,), misfit[:, [j]]))
    for p, alone in enumerate(gap.by_input):
        own = gap.spectra_of(alone)
        for factor in (*FACTORS, 0.0) if any(np.any(lines) for lines in own.lines) else ():
            lines = [every + (factor - 1.0) * part for every, part in zip(simulated.lines, own.lines, strict=True)]
            yield Candidate("inputs", factor, (p,), band_misfit(measured, simulated.with_lines(lines)))
    m = len(rig.actuators)
    for p, q in combinations(range(m), 2):
        if m <= MAX_INPUTS or q == p + 1:
            names = rig.actuators[p].name, rig.actuators[q].name
            crossed = gap.spectra_of(gap.simulated_with(*exchanged("inputs", *names, rig, gap.records)))
            yield Candidate("exchanged inputs", names, (p, q), band_misfit(measured, crossed))


def output_in_other_unit(gap: Comparison) -> list[SetupFault]:
    """The fault of one output of several whose gain beside the others is the same factor of units in every band.

    A missing effect shifts resonances, so it changes the amplitude of a band at all outputs, which may mask a factor.
    An error of calibration near a factor differs from it significantly, and g from ten.
    """
    log_ratios = gap.log_ratios
    found = []
    for j in np.flatnonzero(gap.wide) if log_ratios.shape[1] > 2 else ():
        own, others = log_ratios[:, j], np.moveaxis(np.delete(log_ratios, j, axis=1), 1, 2)
        at = np.isfinite(own) & (np.isfinite(others).sum(axis=2) > 1)
        if np.count_nonzero(at.any(axis=0)) < min(2, gap.rig.modes.n_modes):
            continue
        beside = own[at] - np.nanmedian(others[at], axis=1)
        factor = min((f for f in FACTORS if f > 0), key=lambda f: abs(np.median(beside) - np.log(f)))
        off = beside - np.log(factor)
        error = GAIN_CHI2**0.5 * MEDIAN_ERROR_RATIO * np.median(np.abs(off - np.median(off))) / np.sqrt(off.size)
        from_ten = abs(abs(np.median(beside)) - np.log(10.0))
        is_calibrated = factor not in AMBIGUOUS_FACTORS or abs(np.median(off)) < max(error, GAIN_TOLERANCE) < from_ten
        if (np.abs(off) < MAX_LOG_DISTANCE).all() and is_calibrated:
            found.append(_fault(gap, "outputs", factor, (int(j),), True))
    return found if len(found) == 1 else []


def _is_certain(gap: Comparison, candidate: Candidate) -> bool | None:
    """Whether a fault is certain; False if its factor may be an error of calibration, None if that is undecidable."""
    if candidate.value == 0.0:
        return None
    affected = np.abs(candidate.misfit - gap.misfit) > MIN_MISFIT_CHANGE
    if candidate.kind in ("outputs", "inputs") and _rests_on_one_mode(gap, candidate.value, affected):
        return None
    if candidate.value not in AMBIGUOUS_FACTORS:
        return True
    if candidate.kind == "inputs":  # `scaled_inputs` tests them jointly
        return None
    n, factor = gap.n_samples, float(candidate.value)
    if len(candidate.at) > 1:
        return bool((np.abs(gap.gains / (10.0 if factor > 1.0 else 0.1) - 1.0) > TEN_TOLERANCE).any())
    (j,) = candidate.at
    if candidate.value in (G, 1.0 / G) and gap.rig.sensors[j].quantity != "acceleration":
        return None
    with_factor, with_gain = (gap.residual_power([g * p for p in gap.simulated]) for g in (factor, gap.gains[:, None]))
    if gap.closed(with_factor)[j] < MIN_CLOSED_SHARE:
        return None
    sums = n * with_factor[j], n * with_gain[j], n * gap.noise[j]
    return not is_calibration_error(float(gap.gains[j]), factor, *sums, n)


def _rests_on_one_mode(gap: Comparison, factor: float, affected: Flags | bool) -> bool:
    """Whether a sign, g or 2π rests on the bands of one mode of several, where a missing effect can imitate it.

    A resonance shifted past the excitation, or a sensor beyond a node, inverts the phase of one mode; another stiffness
    gives it any gain. affected: (n_records, n_outputs, n_modes) bands whose misfit the correction changes.
    """
    n = int((compared_bands(gap.measured_spectra) & affected).any(axis=(0, 1)).sum())
    return factor in (-1.0, *AMBIGUOUS_FACTORS) and n < min(2, gap.rig.modes.n_modes)


def _fault(gap: Comparison, kind: str, value: Any, at: Sequence[int], certain: bool) -> SetupFault:
    """The fault of some channels, as of `Candidate`."""
    rig = gap.rig
    names = [(rig.actuators if "inputs" in kind else rig.sensors)[c].name for c in at]
    fault_kind, fault_records, pair = kind, gap.record_names, ()
    if kind == "outputs":
        sentence = sentence_of_outputs(rig.sensors, at, value, None if certain else gap.gains[list(at)] / value - 1.0)
        correction = partial(outputs_times, dict.fromkeys(names, 1.0 / value))
    elif kind == "inputs":
        sentence = sentence_of_inputs(names, value)
        correction = partial(inputs_times, dict.fromkeys(names, value))
    elif kind == "quantity":
        stated, true = value
        what = agreeing(f"{subject('output', names)} are {true}, not {stated}", names)
        sentence = f'{what}: state the quantity "{true}".'
        correction, fault_records = partial(quantity_set, frozenset(names), true), ()
    else:
        pair = value
        sentence = f"The {kind.split()[1]} {' and '.join(pair)} are exchanged: swap them."
        correction = partial(exchanged, kind.split()[1], *pair)
    if kind in ("outputs", "inputs"):
        fault_kind = "sign" if value == -1.0 else "unit"
    factor = value if fault_kind == "unit" else 1.0
    outputs = np.flatnonzero(gap.wide) if "inputs" in kind else list(at)
    after, before = (np.maximum(each.before - each.noise, 0.0)[outputs] for each in (gap.corrected(correction), gap))
    closes = float(np.median(1.0 - after / np.maximum(before, 1e-300)))  # of the power beyond the noise
    fault = SetupFault(fault_kind, sentence, closes, correction, certain, fault_records, factor, pair)
    return _with_doubt_by_record(gap, fault)


def scaled_inputs(gap: Comparison) -> list[SetupFault]:
    """Faults of inputs whose gains, by joint least squares on the responses of a linear rig, are known factors."""
    rig = gap.rig
    if not gap.by_input:
        return []
    weights = 1.0 / np.sqrt(gap.scale)[:, None]
    matrix = np.array([np.concatenate([(weights * part).ravel() for part in parts]) for parts in gap.by_input]).T
    sizes = np.linalg.norm(matrix, axis=0)
    acting = np.flatnonzero(sizes > 1e-9 * sizes.max())
    if acting.size < 2 or not np.isfinite(matrix).all():
        return []
    target = np.concatenate([(weights * y).ravel() for y in gap.measured])
    gains = np.ones(len(rig.actuators))
    gains[acting] = np.linalg.lstsq(matrix[:, acting] / sizes[acting], target, rcond=1e-6)[0] / sizes[acting]
    factors = {p: factor_near(gains[p]) for p in acting}
    if any(factors[p] is None and abs(gains[p] - 1.0) > FACTOR_TOLERANCE for p in acting):
        return []
    wrong = {p: factor for p, factor in factors.items() if factor is not None}
    if any(_rests_on_one_mode(gap, factor, True) for factor in wrong.values()):
        return []
    if not wrong or len(wrong) == acting.size:  # a factor of all inputs may be one of all outputs
        return []
    correction = partial(inputs_times, {rig.actuators[p].name: factor for p, factor in wrong.items()})
    closes = gap.closes(*correction(rig, gap.records))
    if closes < MIN_CLOSED_SHARE:
        return []

    def chi_squared(gains: Floats) -> float:
        residual = target - matrix @ gains
        return float(residual @ residual)

    with_gains, noise, faults = chi_squared(gains), float(gap.noise.sum()) * target.size / gap.noise.size, []
    for factor in dict.fromkeys(wrong.values()):
        inputs = [p for p in wrong if wrong[p] == factor]
        names = [rig.actuators[p].name for p in inputs]
        with_factor = gains.copy()
        with_factor[inputs] = factor
        sums = chi_squared(with_factor), with_gains, noise
        certain = not all(is_calibration_error(gains[p], factor, *sums, target.size) for p in inputs)
        sentence = sentence_of_inputs(names, factor, None if certain else gains[inputs] / factor - 1.0)
        kind = "sign" if factor == -1.0 else "unit"
        own = partial(inputs_times, dict.fromkeys(names, factor))
        faults.append(SetupFault(kind, sentence, closes, own, certain, gap.record_names, abs(factor)))
    return [_with_doubt_by_record(gap, fault) for fault in faults]


def factor_near(gain: float) -> float | None:
    """The factor of `FACTORS` nearest to a gain; None if none is near."""
    near = [factor for factor in FACTORS if gain * factor > 0 and abs(gain / factor - 1.0) < FACTOR_TOLERANCE]
    return min(near, key=lambda factor: abs(gain / factor - 1.0), default=None)


def is_calibration_error(
    gain: float, factor: float, with_factor: float, with_gain: float, noise: float, n_samples: int
) -> bool:
    """Whether a gain is near a factor of units by chance: it differs significantly, and explains far more.

    with_factor, with_gain, noise: sums of squares of both residuals and of the noise, over `n_samples`.
    """
    if factor not in AMBIGUOUS_FACTORS or abs(gain / factor - 1.0) < GAIN_TOLERANCE:
        return False
    removed = with_factor - with_gain
    return bool(removed > GAIN_SHARE * (with_factor - noise) and removed * n_samples > GAIN_CHI2 * with_gain)


def _with_doubt_by_record(gap: Comparison, fault: SetupFault) -> SetupFault:
    """The fault, marked as in doubt if the gains of the records that its correction improves differ.

    A factor of units is the same in all records; the gain of an amplifier that saturates depends on the level.
    """
    if not fault.certain:
        return fault
    improved = []
    for was, gains in zip(gap.log_ratios, log_gains_after(gap, fault), strict=True):
        at = np.isfinite(gains)
        if at.any() and np.median(np.abs(gains[at])) < np.median(np.abs(was[at])):
            improved.append(gains)
    difference = largest_difference(improved)
    if difference <= tolerated_difference(fault):
        return fault
    but = f"from record to record the gain differs by a factor {np.exp(difference):.2g}"
    what = with_may(fault.sentence.split(": multiply")[0])
    return replace(fault, certain=False, sentence=f"{what}; but {but}, as where an amplifier saturates.")


def log_gains_after(gap: Comparison, fault: SetupFault) -> Floats:
    """Log gains (n_records, n_outputs, n_modes) after a correction; NaN in bands that it does not affect."""
    after = gap.corrected(fault.correction).log_ratios
    return np.where(np.abs(after - gap.log_ratios) > MIN_MISFIT_CHANGE, after, np.nan)


def largest_difference(log_gains: Iterable[Floats]) -> float:
    """Largest difference of the log gains of two records, each the median over the bands that both have."""
    differences = [both[np.isfinite(both)] for both in (one - other for one, other in combinations(log_gains, 2))]
    return max((float(abs(np.median(both))) for both in differences if both.size), default=0.0)


def tolerated_difference(fault: SetupFault) -> float:
    """Difference of the log gains of two records that a fault allows; infinite if it is not one of units."""
    return LOG_GAIN_TOLERANCE * abs(np.log(fault.factor)) if fault.factor != 1.0 else np.inf
