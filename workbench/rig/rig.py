"""A test rig: a structure with its actuators, sensors and attached elements."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np

from workbench.arrays import Floats
from workbench.records.record import QUANTITIES, Channel, Record
from workbench.rig.actuators import Actuator, force_unit
from workbench.rig.elements import AirDrag, Element, MidplaneStretching
from workbench.rig.sensors import MEASURED, Sensor
from workbench.structure.domain import Between, NamedPoints, Patch, PlaceError, check_place
from workbench.structure.member import Structure
from workbench.structure.modes import Modes
from workbench.structure.plate import Membrane, Plate
from workbench.structure.printed import Printed, counted, place_text

WITHOUT_UNIT = ("gain", "hysteresis_share", "hysteresis_width", "direction")  # the width is in the unit of commands
KEPT = 8  # rigs in a cache of arrays that all records share

Transducer = Actuator | Sensor


def derivative_of(transducer: Transducer) -> int:
    """Order of the shapes' spatial derivative at an actuator or sensor: 1 for a moment or a slope, else 0."""
    if isinstance(transducer, Actuator):
        return int(transducer.quantity == "moment")
    return MEASURED[transducer.quantity][0]


def shape_of(modes: Modes, transducer: Transducer) -> Floats:
    """Mode shapes, or their slopes, at an actuator or a sensor: (n_modes,), without its gain, with its `shape_error`.

    A place or direction that the structure does not have is refused by a `PlaceError` that names the transducer.
    """
    try:
        shape = modes.phi_at(transducer.at, derivative_of(transducer), direction=transducer.direction)
    except PlaceError as error:
        raise PlaceError(f"{transducer_text(transducer)}: {error}") from None
    return shape + _shape_error(transducer, modes.n_modes) if transducer.shape_error else shape


def shapes_at(modes: Modes, transducers: Sequence[Transducer]) -> Floats:
    """Mode shapes (n_transducers, n_modes), as of `shape_of`; those of one kind are computed at once."""
    shapes = np.empty((len(transducers), modes.n_modes))
    at_points: dict[tuple[str, str | None], list[int]] = {}
    for j, transducer in enumerate(transducers):
        if isinstance(transducer.at, Between | Patch):
            shapes[j] = modes.phi_at(transducer.at, derivative_of(transducer), direction=transducer.direction)
        else:
            at_points.setdefault((transducer.quantity, transducer.direction), []).append(j)
    for (_, direction), here in at_points.items():
        shapes[here] = modes.phi(
            [transducers[j].at for j in here], derivative_of(transducers[here[0]]), direction=direction
        )
    for j, transducer in enumerate(transducers):
        if transducer.shape_error:
            shapes[j] += _shape_error(transducer, modes.n_modes)
    return shapes


def _shape_error(transducer: Transducer, n_modes: int) -> Floats:
    """Errors (n_modes,) of the mode shapes at a transducer; zero for modes beyond those of its `shape_error`."""
    known = transducer.shape_error[:n_modes]
    return np.pad(known, (0, n_modes - len(known)))


def transducer_text(transducer: Transducer) -> str:
    """Text of an actuator or a sensor, such as "actuator F1"."""
    return f"{'actuator' if isinstance(transducer, Actuator) else 'sensor'} {transducer.name}"


@dataclass(frozen=True, eq=False, repr=False)
class Rig(Printed):
    """A test rig: modes, with actuators, sensors, attached elements and disturbances.

    Attributes:
        modes: of the structure; all that the model includes.
        actuators: one per input, in the order of the inputs.
        sensors: one per output, in the order of the outputs.
        elements: at points or distributed, linear or nonlinear.
        stiffness_rate: relative change of the stiffness per time, 1/s: a factor 1 + rate t, t from the start of a
            record.
        structure: the bar, beam, plate or membrane of the modes, where known; modes are recomputed from it when the
            structure changes.
        by_record: (name, change) of records for which the rig differs; see `in_record`.

    Raises:
        ValueError: two actuators or two sensors with the same name.
        PlaceError: an actuator, sensor or element at a place, or in a direction, that the structure does not have.
    """

    modes: Modes
    actuators: tuple[Actuator, ...]
    sensors: tuple[Sensor, ...]
    elements: tuple[Element, ...] = ()
    stiffness_rate: float = 0.0
    structure: Structure | Plate | Membrane | None = None
    by_record: tuple[tuple[str, "Callable[[Rig], Rig]"], ...] = ()

    def __post_init__(self) -> None:
        for name in ("actuators", "sensors", "elements"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name, parts in (("actuators", self.actuators), ("sensors", self.sensors)):
            names = [part.name for part in parts]
            if len(set(names)) != len(names):
                raise ValueError(f"the {name} of a rig must have different names; got {names}")
        for part in (*self.actuators, *self.sensors, *self.elements):
            try:
                if isinstance(part, Transducer):
                    check_place(self.modes.domain, part.at, derivative_of(part), part.direction)
                elif not isinstance(part, AirDrag | MidplaneStretching):
                    check_place(self.modes.domain, part.at)
            except PlaceError as error:
                what = transducer_text(part) if isinstance(part, Transducer) else f"element {type(part).__name__}"
                raise PlaceError(f"{what}: {error}") from None

    def record(
        self, inputs: Floats, outputs: Floats, *, sample_time: float, name: str, input_hold: str = "zero"
    ) -> Record:
        """The record of commands (n_actuators, n_samples) and readings (n_sensors, n_samples) of the rig."""
        return Record(
            sample_time=sample_time,
            outputs=outputs,
            output_channels=tuple(Channel(s.name, s.quantity, at=s.at, noise_std=s.noise_std) for s in self.sensors),
            inputs=inputs,
            input_channels=tuple(Channel(a.name, a.quantity, at=a.at) for a in self.actuators),
            input_hold=input_hold,
            name=name,
        )

    @property
    def is_rate_limited(self) -> bool:
        """Whether an actuator limits the rate of change of its force."""
        return any(np.isfinite(actuator.rate_limit) for actuator in self.actuators)

    def in_record(self, name: str) -> "Rig":
        """The rig with the changes that apply to the record of that name."""
        if not self.by_record:
            return self
        rig = replace(self, by_record=())
        change = dict(self.by_record).get(name)
        return rig if change is None else change(rig)

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        rows = [(a.name, "actuator", a.quantity, place_text(a.at), _properties(a)) for a in self.actuators]
        rows += [(s.name, "sensor", s.quantity, place_text(s.at), _properties(s)) for s in self.sensors]
        rows += [("", "element", type(e).__name__, place_text(getattr(e, "at", None)), "") for e in self.elements]
        at = "at" if isinstance(self.modes.domain, NamedPoints) else "at [m]"
        headings = ("name", "", "quantity", at, "properties")
        shown = len(headings) - (not any(row[-1] for row in rows))  # all are as by default
        parts = ((self.actuators, "actuator"), (self.sensors, "sensor"), (self.elements, "element"))
        line = ", ".join([counted(self.modes.n_modes, "mode"), *(counted(len(each), word) for each, word in parts)])
        return line, headings[:shown], [row[:shown] for row in rows], ()


def _properties(transducer: Transducer) -> str:
    """The properties of an actuator or a sensor that differ from their defaults: delay 0.004 s, gain 0.3, limit 2 N."""
    unit = force_unit(transducer) if isinstance(transducer, Actuator) else QUANTITIES[transducer.quantity]
    units = {"delay": "s", "time_constant": "s", "rate_limit": f"{unit}/s", **dict.fromkeys(WITHOUT_UNIT, "")}
    texts = []
    for each in fields(transducer):
        value, words = getattr(transducer, each.name), each.name.replace("_", " ")
        if each.name in ("name", "at", "quantity") or value == each.default:
            continue
        if each.name == "crosstalk":
            texts += [f"crosstalk {share:.4g} of {other}" for other, share in value]
        elif each.name == "shape_error" or value is True:
            texts.append(words)
        else:
            text = f"{value:.4g}" if isinstance(value, int | float) else str(value)
            texts.append(f"{words} {text} {units.get(each.name, unit)}".rstrip())
    return ", ".join(texts)


@lru_cache(maxsize=KEPT)
def participation_of(rig: Rig) -> Floats:
    """Participation factors (n_modes, n_actuators) without the actuators' gains, which belong to the drive.

    The array is cached and must not be changed.
    """
    return np.ascontiguousarray(shapes_at(rig.modes, rig.actuators).T)
