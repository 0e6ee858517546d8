"""Faults of channels: exchanged, turned, in another unit, or of another quantity than is said."""

from collections.abc import Collection, Sequence
from functools import partial
from typing import Any

import numpy as np

from workbench.arrays import Flags, Floats
from workbench.gap.setup.believed import Mend, believed
from workbench.gap.setup.by_band import asked
from workbench.gap.setup.compared import CLOSED, FELT, Compared
from workbench.gap.setup.corrections import SetupFault, exchanged, inputs_times, outputs_times, quantity_set
from workbench.gap.setup.gains import MAY_BE_GAIN, NEAR, factor_near, in_doubt_by_record, is_gain
from workbench.gap.setup.words import G, named, one, sentence_of_inputs, sentence_of_outputs

TEN = 0.01  # relative: where all gains are as near to 10, an amplifier is as likely as g, which is 2 % off


def of_channels(gap: Compared, kinds: Collection[str]) -> list[SetupFault]:
    """The likeliest fault: of all outputs, else of channels that have the same one; else those in doubt."""
    n = len(gap.rig.sensors)
    faults: dict[tuple[str, Any, bool], list[Mend]] = {}
    for mend in believed(gap):
        certain = _is_certain(gap, mend)
        if mend.kind in kinds and certain is not None:
            faults.setdefault((mend.kind, mend.value, certain), []).append(mend)
            if certain and mend.kind == "outputs" and len(mend.at) == n:
                return [in_doubt_by_record(gap, _fault_of(gap, mend.kind, mend.value, mend.at, True))]
    made = [
        in_doubt_by_record(gap, _fault_of(gap, kind, value, sorted({c for mend in mends for c in mend.at}), certain))
        for (kind, value, certain), mends in faults.items()
    ]
    return [fault for fault in made if fault.certain][:1] or made


def _is_certain(gap: Compared, mend: Mend) -> bool | None:
    """Whether a fault is certain, False where a factor may be an error of calibration; None where nobody can tell."""
    if mend.value == 0.0:
        return None
    if mend.kind in ("outputs", "inputs") and _of_one_mode(gap, mend.value, np.abs(mend.left - gap.unlike) > FELT):
        return None
    if mend.value not in MAY_BE_GAIN:
        return True
    if mend.kind == "inputs":  # these are weighed beside one another
        return None
    n, factor = gap.n_samples, float(mend.value)
    if len(mend.at) > 1:
        return bool((np.abs(gap.gains / (10.0 if factor > 1.0 else 0.1) - 1.0) > TEN).any())
    (j,) = mend.at
    if mend.value in (G, 1.0 / G) and gap.rig.sensors[j].quantity != "acceleration":
        return None
    left, freely = (gap.power([by * p for p in gap.predicted]) for by in (factor, gap.gains[:, None]))
    if gap.closed(left)[j] < CLOSED:
        return None
    return not is_gain(float(gap.gains[j]), factor, n * left[j], n * freely[j], n * gap.noise[j], n)


def _of_one_mode(gap: Compared, factor: float, felt: Flags | bool) -> bool:
    """Whether one mode alone, of several, speaks of a factor, where it can do so by itself.

    A resonance that moved past the excitation and a sensor beyond a node turn it, another stiffness gives it any gain.
    """
    n = int((asked(gap.seen) & felt).any(axis=(0, 1)).sum())
    return factor in (-1.0, *MAY_BE_GAIN) and n < min(2, gap.rig.modes.n_modes)


def _fault_of(gap: Compared, kind: str, value: Any, at: Sequence[int], certain: bool) -> SetupFault:
    """What is wrong with some channels, and the correction."""
    rig = gap.rig
    names = [(rig.actuators if "inputs" in kind else rig.sensors)[c].name for c in at]
    called, fault_records = kind, gap.names
    if kind == "outputs":
        sentence = sentence_of_outputs(rig.sensors, at, value, None if certain else gap.gains[list(at)] / value - 1.0)
        correction = partial(outputs_times, dict.fromkeys(names, 1.0 / value))
    elif kind == "inputs":
        sentence = sentence_of_inputs(names, value)
        correction = partial(inputs_times, dict.fromkeys(names, value))
    elif kind == "quantity":
        said, meant = value
        what = one(f"{named('output', names)} are {meant}, not {said}", names)
        sentence = f'{what}: state the quantity "{meant}".'
        correction, fault_records = partial(quantity_set, frozenset(names), meant), ()
    else:
        sentence = f"The {kind.split()[1]} {' and '.join(value)} are exchanged: swap them."
        correction = partial(exchanged, kind.split()[1], *value)
    if kind in ("outputs", "inputs"):
        called = "sign" if value == -1.0 else "unit"
    factor = value if called == "unit" else 1.0
    outputs = np.flatnonzero(gap.wide) if "inputs" in kind else list(at)
    left, was = (np.maximum(each.before - each.noise, 0.0)[outputs] for each in (gap.corrected(correction), gap))
    closes = float(np.median(1.0 - left / np.maximum(was, 1e-300)))  # of the power beyond the noise
    return SetupFault(called, sentence, closes, correction, certain, fault_records, factor)


def scaled_inputs(gap: Compared) -> list[SetupFault]:
    """Inputs that a linear rig would need a known factor larger or smaller, by least squares on their responses."""
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
    known = {p: factor_near(gains[p]) for p in acting}
    if any(known[p] is None and abs(gains[p] - 1.0) > NEAR for p in acting):
        return []
    wrong = {p: factor for p, factor in known.items() if factor is not None}
    if any(_of_one_mode(gap, factor, True) for factor in wrong.values()):
        return []
    if not wrong or len(wrong) == acting.size:  # what all inputs have, all outputs may have
        return []
    correction = partial(inputs_times, {rig.actuators[p].name: factor for p, factor in wrong.items()})
    closes = gap.closes(*correction(rig, gap.records))
    if closes < CLOSED:
        return []
    freely, noise = _squares(target - matrix @ gains), float(gap.noise.sum()) * target.size / gap.noise.size
    faults = []
    for factor in dict.fromkeys(wrong.values()):
        inputs = [p for p in wrong if wrong[p] == factor]
        names = [rig.actuators[p].name for p in inputs]
        stiffly = gains.copy()
        stiffly[inputs] = factor
        left = _squares(target - matrix @ stiffly)
        certain = not all(is_gain(gains[p], factor, left, freely, noise, target.size) for p in inputs)
        sentence = sentence_of_inputs(names, factor, None if certain else gains[inputs] / factor - 1.0)
        kind = "sign" if factor == -1.0 else "unit"
        own = partial(inputs_times, dict.fromkeys(names, factor))
        faults.append(SetupFault(kind, sentence, closes, own, certain, gap.names, abs(factor)))
    return [in_doubt_by_record(gap, fault) for fault in faults]


def _squares(values: Floats) -> float:
    return float(values @ values)
