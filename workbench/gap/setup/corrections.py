"""Faults of the test set-up: their sentences, and the corrections of rig and records."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from workbench.arrays import Floats
from workbench.records.band_limited import later
from workbench.records.record import Record
from workbench.records.units import STANDARD_GRAVITY
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping

Corrected = tuple[Rig, tuple[Record, ...]]
Correction = Callable[[Rig, Sequence[Record]], Corrected]
G, TURN = STANDARD_GRAVITY, 2.0 * np.pi
# measured over predicted amplitude: what is wrong with outputs that have this ratio, and with inputs that cause it
FACTORS = {
    -1.0: ("have the wrong sign", "have the wrong sign"),
    1.0 / G: ("are 9.81 times too small", "are 9.81 times too large"),
    G: ("are 9.81 times too large", "are 9.81 times too small, such as kgf for N"),
    1e3: ("are 1000 times too large, such as mm for m", "are 1000 times too small, such as kN for N"),
    1e-3: ("are 1000 times too small, such as km for m", "are 1000 times too large, such as mN for N"),
    1e6: ("are a million times too large, such as μm for m", "are a million times too small"),
    1e2: ("are 100 times too large, such as cm for m", "are 100 times too small"),
    1e-2: ("are 100 times too small", "are 100 times too large, such as per cent"),
    TURN: ("are 2π times too large", "are 2π times too small"),
    1.0 / TURN: ("are 2π times too small, such as Hz for rad/s", "are 2π times too large"),
}
IN_G = "look like g where m/s² is meant"
RATES = {2.0: "twice", 0.5: "half", 1e3: "1000 times", 1e-3: "a thousandth of"}


@dataclass(frozen=True, eq=False)
class SetupFault:
    """A fault of the test set-up: of wiring, units or bookkeeping.

    Attributes:
        kind: "exchanged inputs", "exchanged outputs", "sign", "unit", "quantity", "sample rate", "damping",
            "frequency", "late record", "copied channel" or "repeated record".
        sentence: what is wrong, and the correction.
        closes: share of the closable power of the gap that the correction removes, on the channels that it concerns;
            NaN for a fault that is found without a prediction.
        correction: (rig, records) -> (rig, records) without the fault.
        records: names of the records that have the fault; empty if it is of the rig, or of a channel in every record.
        factor: of units, by which measured and predicted signals differ; 1 for any other fault.
        pair: names of the two channels that are exchanged; empty for any other fault.
        certain: False for a factor of units if a gain near it explains far more (an error of calibration), or if the
            gain varies between records (an amplifier that saturates). Such a fault is reported and not corrected.
    """

    kind: str
    sentence: str
    closes: float
    correction: Correction
    certain: bool = True
    records: tuple[str, ...] = ()
    factor: float = 1.0
    pair: tuple[str, ...] = ()


def without_faults(faults: Iterable[SetupFault], rig: Rig, records: Sequence[Record]) -> tuple[Rig, tuple[Record, ...]]:
    """The rig and the records with all certain faults corrected, each in the records that have it."""
    corrected = tuple(records)
    for fault in faults:
        if fault.certain:
            others = {r.name for r in corrected if fault.records and r.name not in fault.records}
            each = [(r,) if r.name in others else fault.correction(rig, (r,))[1] for r in corrected]
            corrected = tuple(record for one in each for record in one)
            rig, _ = fault.correction(rig, ())
    return rig, corrected


def subject(what: str, names: Sequence[str]) -> str:
    """The subject of a sentence, such as: The outputs y1, y2 and y3."""
    if len(names) == 1:
        return f"The {what} {names[0]}"
    return f"The {what}s {', '.join(names[:-1])} and {names[-1]}"


def agreeing(sentence: str, names: Sequence[str]) -> str:
    """The sentence with its first verb in the singular if there is one name."""
    if len(names) > 1:
        return sentence
    return _with_first(sentence, {" are ": " is ", " have ": " has ", " look ": " looks "})


def with_may(what: str) -> str:
    """The clause with "may" before its first verb."""
    return _with_first(what, {" look ": " may look ", " looks ": " may look ", " are ": " may be ", " is ": " may be "})


def _with_first(sentence: str, verbs: dict[str, str]) -> str:
    """The sentence with the first of some verbs that it has replaced, once."""
    old = next((verb for verb in verbs if verb in sentence), "")
    return sentence.replace(old, verbs[old], 1) if old else sentence


def doubtful(what: str, off: Floats) -> str:
    """A sentence on a fault of units that is in doubt; off: relative differences of the gains from the factor."""
    differences = ", ".join(dict.fromkeys(f"{100 * share:+.2g} %" for share in off))
    return (
        f"{with_may(what)}; but the gain differs from that by {differences}, more than its uncertainty: treated as an"
        " error of calibration."
    )


def sentence_of_outputs(sensors: Sequence[Sensor], at: Sequence[int], factor: float, off: Floats | None) -> str:
    """What is wrong with outputs, and the correction; if with all outputs, also what the inputs may be instead.

    factor: measured over predicted amplitude, of `FACTORS`; off: relative differences of the gains from it, if it is in
    doubt.
    """
    names = [sensors[j].name for j in at]
    is_all = len(at) == len(sensors)
    what, of_inputs = FACTORS[factor]
    if factor == 1.0 / G and {sensors[j].quantity for j in at} == {"acceleration"}:
        what = IN_G
    outputs = "All outputs" if is_all and len(names) > 1 else subject("output", names)
    alternative = f", or all inputs {of_inputs}" if is_all else ""
    if off is not None:
        return doubtful(f"{outputs} {what}{alternative}", off)
    correction = "multiply by -1" if factor == -1.0 else f"multiply by {1.0 / factor:.6g}"
    clause = agreeing(f"{outputs} {what}", names)
    return f"{clause}{alternative}: {correction}{' (the outputs)' if alternative else ''}."


def sentence_of_inputs(names: Sequence[str], factor: float, off: Floats | None = None) -> str:
    """What is wrong with logged inputs, and the correction; factor, off: as of `sentence_of_outputs`."""
    what = f"{subject('input', names)} {FACTORS[factor][1]}"
    return f"{agreeing(what, names)}: multiply by {factor:.6g}." if off is None else doubtful(what, off)


def records_alone(correction: Correction, rig: Rig, records: Sequence[Record]) -> Corrected:
    """The records corrected, and the rig unchanged."""
    return rig, correction(rig, records)[1]


def without_record(name: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    return rig, tuple(record for record in records if record.name != name)


def without_output(name: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    sensors = tuple(sensor for sensor in rig.sensors if sensor.name != name)
    return replace(rig, sensors=sensors), tuple(r.select_outputs([s.name for s in sensors]) for r in records)


def outputs_times(factors: dict[str, float], rig: Rig, records: Sequence[Record]) -> Corrected:
    """Outputs, and the stated noise of their sensors, multiplied by factors."""
    by = np.array([factors.get(sensor.name, 1.0) for sensor in rig.sensors])
    sensors = tuple(replace(s, noise_std=abs(f) * s.noise_std) for s, f in zip(rig.sensors, by, strict=True))
    return replace(rig, sensors=sensors), tuple(replace(r, outputs=by[:, None] * r.outputs) for r in records)


def inputs_times(factors: dict[str, float], rig: Rig, records: Sequence[Record]) -> Corrected:
    by = np.array([factors.get(actuator.name, 1.0) for actuator in rig.actuators])
    return rig, tuple(replace(record, inputs=by[:, None] * record.inputs) for record in records)


def exchanged(side: str, one: str, other: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    """Two channels of the records exchanged; side: "inputs" or "outputs"."""
    names = [transducer.name for transducer in (rig.actuators if side == "inputs" else rig.sensors)]
    order = [names.index({one: other, other: one}.get(name, name)) for name in names]
    return rig, tuple(replace(record, **{side: getattr(record, side)[order]}) for record in records)


def relabelled(rig: Rig, names: Collection[str], quantity: str) -> Rig:
    return replace(rig, sensors=tuple(replace(s, quantity=quantity) if s.name in names else s for s in rig.sensors))


def quantity_set(names: frozenset[str], quantity: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    return relabelled(rig, names, quantity), tuple(records)


def rate_times(factor: float, rig: Rig, records: Sequence[Record]) -> Corrected:
    return rig, tuple(replace(r, sample_time=r.sample_time / factor) for r in records)


def outputs_earlier(samples: float, rig: Rig, records: Sequence[Record]) -> Corrected:
    """All outputs of the records shifted by a number of samples, later if it is negative; ends without both are cut."""
    whole = round(samples)
    part, before, after = samples - whole, max(whole, 0), max(-whole, 0)
    corrected = []
    for record in records:
        n, outputs = record.n_samples, record.outputs
        moved = later(outputs, np.full(len(outputs), -part)) if part else outputs
        kept, driven = slice(before, n - after), slice(after, n - before)
        corrected.append(replace(record, outputs=moved[:, kept], inputs=record.inputs[:, driven]))
    return rig, tuple(corrected)


def modes_times(omega: float, zeta: float, rig: Rig, records: Sequence[Record]) -> Corrected:
    """All natural frequencies and damping ratios of the rig multiplied by factors, and the records unchanged."""
    modes = replace(rig.modes, omega=omega * rig.modes.omega, damping=omega * zeta * rig.modes.damping)
    structure = rig.structure
    if structure is not None and isinstance(structure.damping, ModalDamping):
        structure = replace(structure, damping=ModalDamping(zeta * np.asarray(structure.damping.zeta, float)))
    return replace(rig, modes=modes, structure=structure), tuple(records)
