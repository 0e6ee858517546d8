"""Faults of the test set-up, and the corrections of rig and records."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from workbench.records.band_limited import later
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.structure.damping import ModalDamping

Corrected = tuple[Rig, tuple[Record, ...]]
Correction = Callable[[Rig, Sequence[Record]], Corrected]


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


def without_faults(faults: Iterable[SetupFault], rig: Rig, records: Sequence[Record]) -> tuple[Rig, tuple[Record, ...]]:
    """The rig and the records with all certain faults corrected, each in the records that have it."""
    corrected = tuple(records)
    for fault in faults:
        if fault.certain:
            each = [
                (r,) if fault.records and r.name not in fault.records else fault.correction(rig, (r,))[1]
                for r in corrected
            ]
            corrected = tuple(record for one in each for record in one)
            rig, _ = fault.correction(rig, ())
    return rig, corrected


def records_alone(correction: Correction, rig: Rig, records: Sequence[Record]) -> Corrected:
    """The records corrected, and the rig unchanged."""
    return rig, correction(rig, records)[1]


def without_record(name: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    """One record left out."""
    return rig, tuple(record for record in records if record.name != name)


def without_output(name: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    """One output left out of rig and records."""
    sensors = tuple(sensor for sensor in rig.sensors if sensor.name != name)
    return replace(rig, sensors=sensors), tuple(r.select_outputs([s.name for s in sensors]) for r in records)


def outputs_times(factors: dict[str, float], rig: Rig, records: Sequence[Record]) -> Corrected:
    """Outputs, and the stated noise of their sensors, multiplied by factors."""
    by = np.array([factors.get(sensor.name, 1.0) for sensor in rig.sensors])
    sensors = tuple(replace(s, noise_std=abs(f) * s.noise_std) for s, f in zip(rig.sensors, by, strict=True))
    return replace(rig, sensors=sensors), tuple(replace(r, outputs=by[:, None] * r.outputs) for r in records)


def inputs_times(factors: dict[str, float], rig: Rig, records: Sequence[Record]) -> Corrected:
    """Inputs of the records multiplied by factors."""
    by = np.array([factors.get(actuator.name, 1.0) for actuator in rig.actuators])
    return rig, tuple(replace(record, inputs=by[:, None] * record.inputs) for record in records)


def exchanged(side: str, one: str, other: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    """Two channels of the records exchanged; side: "inputs" or "outputs"."""
    names = [port.name for port in (rig.actuators if side == "inputs" else rig.sensors)]
    order = list(range(len(names)))
    i, j = names.index(one), names.index(other)
    order[i], order[j] = j, i
    return rig, tuple(replace(record, **{side: getattr(record, side)[order]}) for record in records)


def relabelled(rig: Rig, names: Iterable[str], quantity: str) -> Rig:
    """The rig with another quantity stated for some of its sensors."""
    named = set(names)
    return replace(rig, sensors=tuple(replace(s, quantity=quantity) if s.name in named else s for s in rig.sensors))


def quantity_set(names: frozenset[str], quantity: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    """Another quantity stated for some sensors, and the records unchanged."""
    return relabelled(rig, names, quantity), tuple(records)


def rate_times(factor: float, rig: Rig, records: Sequence[Record]) -> Corrected:
    """The sampling rates of the records multiplied by a factor."""
    return rig, tuple(replace(r, sample_time=r.sample_time / factor) for r in records)


def outputs_earlier(samples: float, rig: Rig, records: Sequence[Record]) -> Corrected:
    """All outputs of the records shifted by a number of samples, later if it is negative; ends without both are cut."""
    whole = round(samples)
    part, before, after = samples - whole, max(whole, 0), max(-whole, 0)
    corrected = []
    for record in records:
        n, outputs = record.n_samples, record.outputs
        moved = later(outputs, np.full(len(outputs), -part)) if part else outputs
        corrected.append(
            replace(record, outputs=moved[:, before : n - after], inputs=record.inputs[:, after : n - before])
        )
    return rig, tuple(corrected)


def modes_times(omega: float, zeta: float, rig: Rig, records: Sequence[Record]) -> Corrected:
    """All natural frequencies and damping ratios of the rig multiplied by factors, and the records unchanged."""
    modes = replace(rig.modes, omega=omega * rig.modes.omega, damping=omega * zeta * rig.modes.damping)
    structure = rig.structure
    if structure is not None and isinstance(structure.damping, ModalDamping):
        structure = replace(structure, damping=ModalDamping(zeta * np.asarray(structure.damping.zeta, float)))
    return replace(rig, modes=modes, structure=structure), tuple(records)
