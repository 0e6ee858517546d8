"""A controller: the state-space system from the readings of the sensors to the forces of the actuators.

    z' = A z + B y,   u = C z + D y,   y = R x

z is the state of an observer; a law through a modal filter has none.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import control
import numpy as np

from workbench.design.estimation.modal_filter import ModalFilter
from workbench.design.laws.law import Law, linear
from workbench.renamed import former_fields
from workbench.rig.sensors import MEASURED, Sensor
from workbench.rig.statespace import output_matrix, signal_names
from workbench.structure.domain import Place
from workbench.structure.modes import Modes, freeze
from workbench.structure.printed import Printed, counted, place_text


@former_fields(state="A", reads="B", commands="C", direct="D", estimator="L")
@dataclass(frozen=True, eq=False, repr=False)
class Controller(Printed):
    """A law with its state estimator, a modal filter or an observer.

    Attributes:
        law: u = -K x̂.
        sensors: one per channel: displacement, slope, velocity or angular velocity.
        A: (n_states, n_states), 1/s; empty for a filter.
        B: (n_states, n_channels).
        C: (n_actuators, n_states).
        D: (n_actuators, n_channels).
        name: for tables and plots.
        L: (2 n_controlled, n_channels) gain of an observer; of a modal filter, x̂ = L y; None where not known.
        designed_by: repeats the design with the same settings for other modes, law and sensors; None where not known.
    """

    law: Law
    sensors: tuple[Sensor, ...]
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    name: str
    L: np.ndarray | None = None
    designed_by: Callable[[Modes, Law, Sequence[Sensor]], "Controller"] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensors", tuple(self.sensors))
        freeze(self, *"ABCD")
        if self.L is not None:
            freeze(self, "L")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line = f"{self.name}: {counted(len(self.sensors), 'channel')} to {counted(len(self.law.actuators), 'actuator')}"
        rows = [(sensor.name, sensor.quantity, place_text(sensor.at)) for sensor in self.sensors]
        rows += [(actuator.name, actuator.quantity, place_text(actuator.at)) for actuator in self.law.actuators]
        return f"{line}, {counted(len(self.A), 'state')}", ("name", "quantity", "at"), rows, ()

    @property
    def static(self) -> bool:
        """Whether it has no state, as a law through a modal filter."""
        return self.A.size == 0

    @property
    def places(self) -> tuple[Place, ...]:
        """Distinct places of the sensors, in order."""
        return tuple(sorted({sensor.at for sensor in self.sensors}))

    def state_space(self) -> control.StateSpace:
        """The controller as python-control's `StateSpace` from readings to commands, the sign of u = -K x̂ included."""
        names = {"inputs": signal_names(s.name for s in self.sensors)}
        names["outputs"] = signal_names(a.name for a in self.law.actuators)
        return control.ss(self.A, self.B, self.C, self.D, **names)


def check_readable(sensors: Sequence[Sensor]) -> None:
    """Refuse accelerometers, whose readings are not of the state alone."""
    for sensor in sensors:
        if MEASURED[sensor.quantity][1] > 1:
            raise ValueError(
                f"sensor {sensor.name} reads {sensor.quantity}; a controller here reads displacement or velocity"
            )


def reading(modes: Modes, sensors: Sequence[Sensor]) -> np.ndarray:
    """R (n_channels, 2 n_modes), from the state (q, q') to the readings, lags and delays left out."""
    check_readable(sensors)
    shapes = output_matrix(modes, sensors)
    rates = np.array([MEASURED[sensor.quantity][1] for sensor in sensors])[:, None]
    return np.hstack([np.where(rates == 0, shapes, 0.0), np.where(rates == 1, shapes, 0.0)])


def filtered(law: Law, filter_: ModalFilter) -> Controller:
    """A law through a modal filter, from displacements and velocities, slopes and angular velocities where it has any.

    Raises:
        ValueError: a filter of other modes than the law controls, or a law that has no gain.
    """
    law = linear(law)
    n_filtered = len(filter_.displacement)
    if n_filtered != len(law.controlled):
        raise ValueError(
            f"the filter gives {n_filtered} modal coordinates and the law controls {len(law.controlled)} modes; make"
            " the filter of the controlled modes: modes.select(list(law.controlled))"
        )
    weights, quantities = [filter_.displacement], [("displacement", "velocity", "")]
    if filter_.slope.size:
        weights.append(filter_.slope)
        quantities.append(("slope", "angular velocity", "s"))
    sensors = [
        Sensor(f"{'yv'[order]}{quantity[2]}{i + 1}", place, quantity[order])
        for order in (0, 1)
        for quantity in quantities
        for i, place in enumerate(filter_.places)
    ]
    estimator = np.kron(np.eye(2), np.hstack(weights))
    empty = np.zeros((0, 0)), np.zeros((0, estimator.shape[1])), np.zeros((len(law.actuators), 0))
    again = None if filter_.designed_by is None else partial(_redesigned, filter_.designed_by)
    name = f"{law.name} through a modal filter"
    return Controller(law, tuple(sensors), *empty, -law.gain @ estimator, name, estimator, again)


def _redesigned(
    design: Callable[[Modes, Sequence[int]], ModalFilter], modes: Modes, law: Law, sensors: Sequence[Sensor]
) -> Controller:
    """A law through a filter redesigned for other modes; the filter places the sensors, so `sensors` is not used."""
    return filtered(law, design(modes, law.controlled))
