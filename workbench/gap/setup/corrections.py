"""Faults of the test set-up, and what corrects each of rig and records."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

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
            "frequency", "copied channel" or "repeated record".
        sentence: what is wrong, and the correction.
        closes: share of the closable power of the gap that the correction takes away on the channels that it concerns;
            nan where no prediction was needed to see the fault.
        correction: (rig, records) -> (rig, records) without the fault.
        records: names of those that show it and are corrected; empty where the rig, or a channel of every record, is.
        factor: of units, by which measured and predicted signals differ; 1 for any other fault.
        certain: False for a factor that may be one of units, where a gain near it explains far more, as an error of
            calibration does, or another one in each record, as of an amplifier that saturates. It is said and not
            corrected.
    """

    kind: str
    sentence: str
    closes: float
    correction: Correction
    certain: bool = True
    records: tuple[str, ...] = ()
    factor: float = 1.0


def without_faults(faults: Iterable[SetupFault], rig: Rig, records: Sequence[Record]) -> tuple[Rig, tuple[Record, ...]]:
    """The rig without the faults that are certain, and the records without those that they show."""
    kept = tuple(records)
    for fault in faults:
        if fault.certain:
            each = [
                (r,) if fault.records and r.name not in fault.records else fault.correction(rig, (r,))[1] for r in kept
            ]
            kept = tuple(record for one in each for record in one)
            rig, _ = fault.correction(rig, ())
    return rig, kept


def records_alone(correction: Correction, rig: Rig, records: Sequence[Record]) -> Corrected:
    """The rig as it is."""
    return rig, correction(rig, records)[1]


def without_record(name: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    return rig, tuple(record for record in records if record.name != name)


def without_output(name: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    sensors = tuple(sensor for sensor in rig.sensors if sensor.name != name)
    return replace(rig, sensors=sensors), tuple(r.select_outputs([s.name for s in sensors]) for r in records)


def outputs_times(factors: dict[str, float], rig: Rig, records: Sequence[Record]) -> Corrected:
    by = np.array([factors.get(sensor.name, 1.0) for sensor in rig.sensors])
    sensors = tuple(replace(s, noise_std=abs(f) * s.noise_std) for s, f in zip(rig.sensors, by, strict=True))
    return replace(rig, sensors=sensors), tuple(replace(r, outputs=by[:, None] * r.outputs) for r in records)


def inputs_times(factors: dict[str, float], rig: Rig, records: Sequence[Record]) -> Corrected:
    by = np.array([factors.get(actuator.name, 1.0) for actuator in rig.actuators])
    return rig, tuple(replace(record, inputs=by[:, None] * record.inputs) for record in records)


def exchanged(side: str, one: str, other: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    """Two "inputs" or two "outputs"."""
    names = [port.name for port in (rig.actuators if side == "inputs" else rig.sensors)]
    order = list(range(len(names)))
    i, j = names.index(one), names.index(other)
    order[i], order[j] = j, i
    return rig, tuple(replace(record, **{side: getattr(record, side)[order]}) for record in records)


def relabelled(rig: Rig, names: Iterable[str], quantity: str) -> Rig:
    named = set(names)
    return replace(rig, sensors=tuple(replace(s, quantity=quantity) if s.name in named else s for s in rig.sensors))


def quantity_set(names: frozenset[str], quantity: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    return relabelled(rig, names, quantity), tuple(records)


def rate_times(factor: float, rig: Rig, records: Sequence[Record]) -> Corrected:
    return rig, tuple(replace(r, sample_time=r.sample_time / factor) for r in records)


def modes_times(omega: float, zeta: float, rig: Rig, records: Sequence[Record]) -> Corrected:
    modes = replace(rig.modes, omega=omega * rig.modes.omega, damping=omega * zeta * rig.modes.damping)
    structure = rig.structure
    if structure is not None and isinstance(structure.damping, ModalDamping):
        structure = replace(structure, damping=ModalDamping(zeta * np.asarray(structure.damping.zeta, float)))
    return replace(rig, modes=modes, structure=structure), tuple(records)
