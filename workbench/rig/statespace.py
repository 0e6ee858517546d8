"""Modes with actuators and sensors as python-control's `StateSpace`."""

from collections.abc import Iterable, Sequence

import control
import numpy as np

from workbench.arrays import Floats
from workbench.rig.actuators import Actuator
from workbench.rig.rig import shape_of
from workbench.rig.sensors import MEASURED, Sensor
from workbench.structure.modes import Modes


def input_matrix(modes: Modes, actuators: Sequence[Actuator]) -> np.ndarray:
    """Modal forces per unit command, B_rj = φ_r at its place, or the slope there for a moment: (n_modes, n_actuators).

    Raises:
        ValueError: an actuator on a support, where it can do no work.
    """
    columns = []
    for actuator in actuators:
        shape = shape_of(modes, actuator)
        if modes.is_held(actuator.at, int(actuator.kind == "moment"), direction=actuator.direction):
            raise ValueError(
                f"actuator {actuator.name} stands on the support at {modes.domain.text(actuator.at)}, where it moves"
                " no mode; move it inside"
            )
        columns.append(actuator.gain * shape)
    return np.array(columns).reshape(len(columns), modes.n_modes).T


def output_matrix(modes: Modes, sensors: Sequence[Sensor]) -> np.ndarray:
    """Mode shapes (or their slopes) at the sensors, times gain: (n_sensors, n_modes)."""
    rows = [sensor.gain * shape_of(modes, sensor) for sensor in sensors]
    return np.array(rows).reshape(len(rows), modes.n_modes)


def state_space(modes: Modes, actuators: Sequence[Actuator], sensors: Sequence[Sensor]) -> control.StateSpace:
    """The linear model from commands to sensor outputs, states (q_1..q_n, q_1'..q_n'), named signals.

    x' = [0 I; -Ω² -C] x + [0; B] u, and y a displacement, slope, velocity, angular velocity or acceleration; an
    acceleration feels the force directly, so D is then not zero. A lag of an actuator or a sensor adds a state each,
    after the modal ones (actuators first).

    Raises:
        ValueError: an actuator or sensor that is not linear (delay, dead zone, limit, bias, rounding).
    """
    parts: tuple[Actuator | Sensor, ...] = (*actuators, *sensors)
    for part in parts:
        if not part.linear:
            raise ValueError(f"{part} is not linear, so the rig has no StateSpace; simulate it instead")
    n = modes.n_modes
    b = input_matrix(modes, actuators)
    shapes = output_matrix(modes, sensors)
    a = modes.state_matrix
    bb = np.vstack([np.zeros_like(b), b])
    c = np.zeros((len(sensors), 2 * n))
    d = np.zeros((len(sensors), len(actuators)))
    for j, sensor in enumerate(sensors):
        order = MEASURED[sensor.quantity][1]
        if order < 2:
            c[j, order * n : (order + 1) * n] = shapes[j]
        else:
            c[j] = shapes[j] @ a[n:]
            d[j] = shapes[j] @ b
    states = [f"q{r + 1}" for r in range(n)] + [f"dq{r + 1}" for r in range(n)]
    a, bb, c, d, states = _with_actuator_lags(a, bb, c, d, states, actuators)
    a, bb, c, d, states = _with_sensor_lags(a, bb, c, d, states, sensors)
    return control.ss(
        a,
        bb,
        c,
        d,
        inputs=signal_names(x.name for x in actuators),
        outputs=signal_names(y.name for y in sensors),
        states=signal_names(states),
        name="rig",
    )


def signal_names(names: Iterable[str]) -> list[str]:
    """Names of signals as python-control allows them: a point, which it keeps for subsystems, becomes a line below."""
    return [name.replace(".", "_") for name in names]


def _with_actuator_lags(
    a: Floats, b: Floats, c: Floats, d: Floats, states: list[str], actuators: Sequence[Actuator]
) -> tuple[Floats, Floats, Floats, Floats, list[str]]:
    for j, actuator in enumerate(actuators):
        if actuator.time_constant > 0:
            rate = 1.0 / actuator.time_constant
            size = a.shape[0]
            a = np.block([[a, b[:, [j]]], [np.zeros((1, size)), np.array([[-rate]])]])
            c = np.hstack([c, d[:, [j]]])
            b = np.vstack([b, np.zeros((1, b.shape[1]))])
            b[:, j] = 0.0
            b[-1, j] = rate
            d = d.copy()
            d[:, j] = 0.0
            states = [*states, f"{actuator.name}_lag"]
    return a, b, c, d, states


def _with_sensor_lags(
    a: Floats, b: Floats, c: Floats, d: Floats, states: list[str], sensors: Sequence[Sensor]
) -> tuple[Floats, Floats, Floats, Floats, list[str]]:
    for j, sensor in enumerate(sensors):
        if sensor.time_constant > 0:
            rate = 1.0 / sensor.time_constant
            size = a.shape[0]
            a = np.block([[a, np.zeros((size, 1))], [rate * c[[j]], np.array([[-rate]])]])
            b = np.vstack([b, rate * d[[j]]])
            c = np.hstack([c, np.zeros((c.shape[0], 1))])
            c[j] = 0.0
            c[j, -1] = 1.0
            d = d.copy()
            d[j] = 0.0
            states = [*states, f"{sensor.name}_lag"]
    return a, b, c, d, states
