"""Faults of channels: exchanged, of the wrong sign, in another unit, or of another quantity than stated."""

from collections.abc import Collection, Sequence
from functools import partial
from typing import Any

import numpy as np

from workbench.arrays import Flags, Floats
from workbench.gap.setup.by_band import compared_bands
from workbench.gap.setup.candidates import Candidate, accepted
from workbench.gap.setup.comparison import AFFECTED, CLOSED, Comparison
from workbench.gap.setup.corrections import SetupFault, exchanged, inputs_times, outputs_times, quantity_set
from workbench.gap.setup.gains import AMBIGUOUS, NEAR, factor_near, is_calibration_error, with_doubt_by_record
from workbench.gap.setup.sentences import G, agreeing, sentence_of_inputs, sentence_of_outputs, subject

NEAR_TEN = 0.01  # relative: if all gains are as near to 10, an amplifier is as likely as g, which differs by 2 %


def channel_faults(gap: Comparison, kinds: Collection[str]) -> list[SetupFault]:
    """The most probable certain fault, of all outputs or of channels that share it; else all that are in doubt.

    Args:
        gap: measured and predicted outputs.
        kinds: kinds of candidates that may be accepted.
    """
    n = len(gap.rig.sensors)
    alike: dict[tuple[str, Any, bool], list[Candidate]] = {}
    for candidate in accepted(gap):
        certain = _is_certain(gap, candidate)
        if candidate.kind in kinds and certain is not None:
            alike.setdefault((candidate.kind, candidate.value, certain), []).append(candidate)
            if certain and candidate.kind == "outputs" and len(candidate.at) == n:
                return [with_doubt_by_record(gap, _fault(gap, candidate.kind, candidate.value, candidate.at, True))]
    faults = [
        with_doubt_by_record(gap, _fault(gap, kind, value, sorted({c for each in same for c in each.at}), certain))
        for (kind, value, certain), same in alike.items()
    ]
    return [fault for fault in faults if fault.certain][:1] or faults


def _is_certain(gap: Comparison, candidate: Candidate) -> bool | None:
    """Whether a fault is certain; False if its factor may be an error of calibration, None if that is undecidable."""
    if candidate.value == 0.0:
        return None
    affected = np.abs(candidate.misfit - gap.misfit) > AFFECTED
    if candidate.kind in ("outputs", "inputs") and _rests_on_one_mode(gap, candidate.value, affected):
        return None
    if candidate.value not in AMBIGUOUS:
        return True
    if candidate.kind == "inputs":  # `scaled_inputs` tests them jointly
        return None
    n, factor = gap.n_samples, float(candidate.value)
    if len(candidate.at) > 1:
        return bool((np.abs(gap.gains / (10.0 if factor > 1.0 else 0.1) - 1.0) > NEAR_TEN).any())
    (j,) = candidate.at
    if candidate.value in (G, 1.0 / G) and gap.rig.sensors[j].quantity != "acceleration":
        return None
    with_factor, with_gain = (
        gap.residual_power([by * p for p in gap.predicted]) for by in (factor, gap.gains[:, None])
    )
    if gap.closed(with_factor)[j] < CLOSED:
        return None
    sums = n * with_factor[j], n * with_gain[j], n * gap.noise[j]
    return not is_calibration_error(float(gap.gains[j]), factor, *sums, n)


def _rests_on_one_mode(gap: Comparison, factor: float, affected: Flags | bool) -> bool:
    """Whether a sign, g or 2π rests on the bands of one mode of several, where a missing effect can imitate it.

    A resonance shifted past the excitation, or a sensor beyond a node, inverts the phase of one mode; another stiffness
    gives it any gain.

    Args:
        gap: measured and predicted outputs.
        factor: of the fault.
        affected: (n_records, n_outputs, n_modes) bands whose misfit the correction changes; True for all.
    """
    n = int((compared_bands(gap.measured_spectra) & affected).any(axis=(0, 1)).sum())
    return factor in (-1.0, *AMBIGUOUS) and n < min(2, gap.rig.modes.n_modes)


def _fault(gap: Comparison, kind: str, value: Any, at: Sequence[int], certain: bool) -> SetupFault:
    """The fault of some channels; kind, value, at: as of `Candidate`."""
    rig = gap.rig
    names = [(rig.actuators if "inputs" in kind else rig.sensors)[c].name for c in at]
    fault_kind, fault_records = kind, gap.record_names
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
        sentence = f"The {kind.split()[1]} {' and '.join(value)} are exchanged: swap them."
        correction = partial(exchanged, kind.split()[1], *value)
    if kind in ("outputs", "inputs"):
        fault_kind = "sign" if value == -1.0 else "unit"
    factor = value if fault_kind == "unit" else 1.0
    outputs = np.flatnonzero(gap.wide) if "inputs" in kind else list(at)
    after, before = (np.maximum(each.before - each.noise, 0.0)[outputs] for each in (gap.corrected(correction), gap))
    closes = float(np.median(1.0 - after / np.maximum(before, 1e-300)))  # of the power beyond the noise
    return SetupFault(fault_kind, sentence, closes, correction, certain, fault_records, factor)


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
    if any(factors[p] is None and abs(gains[p] - 1.0) > NEAR for p in acting):
        return []
    wrong = {p: factor for p, factor in factors.items() if factor is not None}
    if any(_rests_on_one_mode(gap, factor, True) for factor in wrong.values()):
        return []
    if not wrong or len(wrong) == acting.size:  # a factor of all inputs may be one of all outputs
        return []
    correction = partial(inputs_times, {rig.actuators[p].name: factor for p, factor in wrong.items()})
    closes = gap.closes(*correction(rig, gap.records))
    if closes < CLOSED:
        return []
    with_gains, noise = _sum_of_squares(target - matrix @ gains), float(gap.noise.sum()) * target.size / gap.noise.size
    faults = []
    for factor in dict.fromkeys(wrong.values()):
        inputs = [p for p in wrong if wrong[p] == factor]
        names = [rig.actuators[p].name for p in inputs]
        with_factor = gains.copy()
        with_factor[inputs] = factor
        sums = _sum_of_squares(target - matrix @ with_factor), with_gains, noise
        certain = not all(is_calibration_error(gains[p], factor, *sums, target.size) for p in inputs)
        sentence = sentence_of_inputs(names, factor, None if certain else gains[inputs] / factor - 1.0)
        kind = "sign" if factor == -1.0 else "unit"
        own = partial(inputs_times, dict.fromkeys(names, factor))
        faults.append(SetupFault(kind, sentence, closes, own, certain, gap.record_names, abs(factor)))
    return [with_doubt_by_record(gap, fault) for fault in faults]


def _sum_of_squares(values: Floats) -> float:
    return float(values @ values)
