"""The discrete-time loop of all modes under a digital controller, exact at the samples.

With the plant x' = A x + B u, y = C x and a command that is held over each sample and delayed by τ = m T + r,

    x_k+1 = e^{AT} x_k + ∫_0^{T-r} e^{At} dt B u_k-m + e^{A(T-r)} ∫_0^r e^{At} dt B u_k-m-1

(Åström & Wittenmark, Computer-Controlled Systems, 3rd ed., section 3.2).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from workbench.arrays import Floats, Integers
from workbench.design.estimation.digital import DigitalController, zero_order_hold
from workbench.design.laws.law import DesignError
from workbench.rig.actuators import Actuator, linear_actuator, mixing, without_crosstalk
from workbench.rig.sensors import Sensor, linear_sensor
from workbench.rig.statespace import state_space
from workbench.structure.modes import Modes

MOST_PAST = 500  # longest delay of a command, samples


def sampled_loop(
    modes: Modes,
    actuators: Sequence[Actuator],
    sensors: Sequence[Sensor],
    controller: DigitalController,
    computing_delay: float = 0.0,
) -> np.ndarray:
    """The matrix (n_states, n_states) of the loop; the states are the plant, delayed commands, then the controller.

    Args:
        modes: controlled and residual.
        actuators: in the order of the commands; gains, lags, delays and cross-talk count, limits and dead zones do not.
        sensors: in the order of the readings, likewise.
        controller: its linear part counts.
        computing_delay: from a reading to the command's first effect, beside the actuators' own delays, s.
    """
    late = [sensor.name for sensor in sensors if sensor.delay]
    if late:
        raise DesignError(f"sensor {late[0]} has a delay; include it in the computing delay, and set the sensor's to 0")
    if not (np.isfinite(computing_delay) and computing_delay >= 0):
        raise DesignError(f"the computing delay must be 0 s or more; got {computing_delay:g} s")
    a, b, c = linear_plant(modes, actuators, sensors)
    delays = np.array([computing_delay + actuator.delay for actuator in actuators])
    stepped, into = held(a, b, controller.sample_time, delays)
    reads = np.hstack([c, np.zeros((len(c), len(stepped) - len(a)))])
    return closed_by(stepped, into @ mixing(actuators), reads, controller)[0]


def held(a: Floats, b: Floats, period: float, delays: Floats) -> tuple[Floats, Floats]:
    """A and B of the plant in discrete time; the states are x, then each actuator's past commands, newest first.

    Args:
        a: (n, n) of x' = A x + B u.
        b: (n, n_actuators).
        period: s.
        delays: (n_actuators,) of the commands, s.
    """
    past = past_commands(delays, period)
    if past.max(initial=0) > MOST_PAST:
        raise DesignError(
            f"the delay of a command is {past.max()} samples, more than {MOST_PAST}; sample slower, or shorten the"
            " delay"
        )
    transition, by_past, by_new = held_over(a, b, period, delays, period)
    newest, late = np.cumsum(past) - past, np.flatnonzero(past)
    ageing, entering = np.eye(past.sum(), k=-1), np.zeros((past.sum(), len(past)))
    ageing[newest[late]], entering[newest[late], late] = 0.0, 1.0
    older = np.zeros((past.sum(), len(a)))
    return np.block([[transition, by_past], [older, ageing]]), np.vstack([by_new, entering])


def past_commands(delays: Floats, period: float) -> Integers:
    """Number of past commands (n_actuators,) that still act at a sample: the delay in samples, rounded up."""
    return np.asarray(np.ceil(np.round(delays / period, 9)), np.int64)


def held_over(a: Floats, b: Floats, period: float, delays: Floats, horizon: float) -> tuple[Floats, Floats, Floats]:
    """e^{A h}, and the effect on x over a horizon h (s) of the commands, held over each sample and delayed.

    Past commands (n, n_past) are in the order of `held`; of those to be sent (n, n_actuators) the first is kept to the
    horizon. Arguments as of `held`.
    """
    past = past_commands(delays, period)
    by_past, by_new = np.zeros((len(a), past.sum())), np.zeros_like(b)
    for j, (delay, newest) in enumerate(zip(delays, np.cumsum(past) - past, strict=True)):
        changes = (delay + k * period for k in range(-past[j], 2))
        times = sorted({0.0, horizon, *(t for t in changes if 0.0 < t < horizon)})
        for start, end in zip(times, times[1:]):
            age = -int(np.floor(round((0.5 * (start + end) - delay) / period, 9)))
            effect = expm(a * (horizon - end)) @ zero_order_hold(a, b[:, [j]], end - start)[1][:, 0]
            if age > 0:
                by_past[:, newest + age - 1] += effect
            else:
                by_new[:, j] += effect
    return expm(a * horizon), by_past, by_new


def closed_by(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, controller: DigitalController
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and C of the closed loop, without relays: z ← A z + B e, reading C z + e, e the error of the readings."""
    n_c, n_u = len(controller.A), len(controller.actuators)
    rows, direct = controller.C, controller.D * controller.scale
    if controller.relays is not None:
        rows, direct = np.zeros((n_u, n_c)), np.zeros((n_u, len(controller.sensors)))
    a_c = controller.A + controller.E @ rows
    b_c = controller.B * controller.scale + controller.E @ direct
    closed = np.block([[a + b @ direct @ c, b @ rows], [b_c @ c, a_c]])
    return closed, np.vstack([b @ direct, b_c]), np.hstack([c, np.zeros((len(c), n_c))])


def linear_plant(
    modes: Modes, actuators: Sequence[Actuator], sensors: Sequence[Sensor]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and C of the structure with the linear part of its actuators and sensors, without delays.

    Commands come after the cross-talk of the actuators, which precedes their delays.
    """
    linear_actuators = [replace(linear_actuator(a), delay=0.0) for a in without_crosstalk(actuators)]
    linear_sensors = [linear_sensor(s) for s in sensors]
    plant = state_space(modes, linear_actuators, linear_sensors)
    return np.asarray(plant.A), np.asarray(plant.B), np.asarray(plant.C)
