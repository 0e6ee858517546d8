"""A controller as the full plant meets it: from the readings of sensors to the forces of actuators.

    z' = A_z z + B_z y,   u = C_z z + D_z y,   y = R x

A law through a modal filter has no state z; an observer has one. Both close the same loop.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from workbench.design.estimation.modal_filter import ModalFilter
from workbench.design.laws.law import Law, linear
from workbench.rig.sensors import MEASURED, Sensor
from workbench.rig.statespace import output_matrix
from workbench.structure.domain import Place
from workbench.structure.modes import Modes, freeze
from workbench.structure.printed import Printed, counted, place_text


@dataclass(frozen=True, eq=False, repr=False)
class Controller(Printed):
    """A law with what it knows of the state.

    Attributes:
        law: whose forces it commands.
        sensors: that it reads, one per channel: displacement, slope, velocity or angular velocity.
        state: (n_states, n_states) A_z, 1/s; empty for a filter.
        reads: (n_states, n_channels) B_z.
        commands: (n_actuators, n_states) C_z.
        direct: (n_actuators, n_channels) D_z.
        name: for tables and plots.
        estimator: (2 n_controlled, n_channels) L of an observer; of a filter, x̂ = estimator y; None where not known.
        designed_by: designs it anew with the settings that it has, from modes, a law and sensors; None where not known.
    """

    law: Law
    sensors: tuple[Sensor, ...]
    state: np.ndarray
    reads: np.ndarray
    commands: np.ndarray
    direct: np.ndarray
    name: str
    estimator: np.ndarray | None = None
    designed_by: Callable[[Modes, Law, Sequence[Sensor]], "Controller"] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensors", tuple(self.sensors))
        freeze(self, "state", "reads", "commands", "direct")
        if self.estimator is not None:
            freeze(self, "estimator")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line = f"{self.name}: {counted(len(self.sensors), 'channel')} to {counted(len(self.law.actuators), 'actuator')}"
        rows = [(sensor.name, sensor.quantity, place_text(sensor.at)) for sensor in self.sensors]
        rows += [(actuator.name, actuator.kind, place_text(actuator.at)) for actuator in self.law.actuators]
        return f"{line}, {counted(len(self.state), 'state')}", ("name", "quantity", "at"), rows, ()

    @property
    def places(self) -> tuple[Place, ...]:
        """Distinct places of the sensors, in order."""
        return tuple(sorted({sensor.at for sensor in self.sensors}))


def check_readable(sensors: Sequence[Sensor]) -> None:
    """Refuse what is not a function of the state alone.

    Raises:
        ValueError: an accelerometer.
    """
    for sensor in sensors:
        if MEASURED[sensor.quantity][1] > 1:
            raise ValueError(
                f"sensor {sensor.name} reads {sensor.quantity}; a controller here reads displacement or velocity"
            )


def reading(modes: Modes, sensors: Sequence[Sensor]) -> np.ndarray:
    """R (n_channels, 2 n_modes), from the state (q, q') to the readings, lags and delays left out.

    Raises:
        ValueError: an accelerometer.
    """
    check_readable(sensors)
    shapes = output_matrix(modes, sensors)
    rates = np.array([MEASURED[sensor.quantity][1] for sensor in sensors])[:, None]
    return np.hstack([np.where(rates == 0, shapes, 0.0), np.where(rates == 1, shapes, 0.0)])


def filtered(law: Law, filter_: ModalFilter) -> Controller:
    """A law through a modal filter: displacements and velocities at its places, slopes and theirs where it has any.

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
    weights, kinds = [filter_.displacement], [("displacement", "velocity", "")]
    if filter_.slope.size:
        weights.append(filter_.slope)
        kinds.append(("slope", "angular velocity", "s"))
    sensors = [
        Sensor(f"{'yv'[order]}{kind[2]}{i + 1}", place, kind[order])
        for order in (0, 1)
        for kind in kinds
        for i, place in enumerate(filter_.places)
    ]
    estimator = np.kron(np.eye(2), np.hstack(weights))
    empty = np.zeros((0, 0)), np.zeros((0, estimator.shape[1])), np.zeros((len(law.actuators), 0))
    again = None if filter_.designed_by is None else partial(_filtered_anew, filter_.designed_by)
    name = f"{law.name} through a modal filter"
    return Controller(law, tuple(sensors), *empty, -law.gain @ estimator, name, estimator, again)


def _filtered_anew(
    design: Callable[[Modes, Sequence[int]], ModalFilter], modes: Modes, law: Law, sensors: Sequence[Sensor]
) -> Controller:
    """The law through the same filter of other modes; its sensors stand where the filter has them."""
    return filtered(law, design(modes, law.controlled))
