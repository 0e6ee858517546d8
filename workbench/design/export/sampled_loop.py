"""The discrete-time loop of all modes under a digital controller, exact at the samples.

With the plant x' = A x + B u, y = C x and a command that is held over each sample and delayed by τ = m T + r,

    x_k+1 = e^{AT} x_k + ∫_0^{T-r} e^{At} dt B u_k-m + e^{A(T-r)} ∫_0^r e^{At} dt B u_k-m-1

(Åström & Wittenmark, Computer-Controlled Systems, 3rd ed., section 3.2).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from workbench.design.estimation.digital import DigitalController
from workbench.design.laws.law import DesignError
from workbench.rig.actuators import Actuator
from workbench.rig.linear import whole_samples
from workbench.rig.sensors import Sensor
from workbench.rig.statespace import state_space
from workbench.structure.modes import Modes

MOST_PAST = 400  # delayed commands, in samples


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
        actuators: in the order of the commands; gains, lags and delays count, limits and dead zones do not.
        sensors: in the order of the readings, likewise.
        controller: its linear part counts.
        computing_delay: from a reading to the command's first effect, beside the actuators' own delays, s.

    Raises:
        DesignError: a sensor with a delay or cross-talk, or a negative delay.
    """
    refused = [sensor.name for sensor in sensors if sensor.delay or sensor.crosstalk]
    if refused:
        raise DesignError(
            f"sensor {refused[0]} has a delay or cross-talk; include the delay in the computing delay, leave out"
            " cross-talk"
        )
    if not (np.isfinite(computing_delay) and computing_delay >= 0):
        raise DesignError(f"the computing delay must be 0 s or more; got {computing_delay:g} s")
    a, b, c = linear_plant(modes, actuators, sensors)
    delays = np.array([computing_delay + actuator.delay for actuator in actuators])
    stepped, into = held(a, b, controller.sample_time, delays)
    reads = np.hstack([c, np.zeros((len(c), len(stepped) - len(a)))])
    return closed_by(stepped, into, reads, controller)[0]


def held(a: np.ndarray, b: np.ndarray, period: float, delays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and B of the plant in discrete time; the states are x, then each actuator's delayed commands, newest first.

    Args:
        a: (n, n) of x' = A x + B u.
        b: (n, n_actuators).
        period: s.
        delays: (n_actuators,) of the commands, s.

    Raises:
        DesignError: delays of too many samples.
    """
    parts = [whole_samples(float(delay), period) for delay in delays]
    past = [whole + (rest > 0) for whole, rest in parts]
    if max(past, default=0) > MOST_PAST:
        raise DesignError(
            f"the delay of a command is {max(past)} samples, more than {MOST_PAST}; sample slower, or shorten the delay"
        )
    n, starts = len(a), len(a) + np.r_[0, np.cumsum(past)].astype(int)
    stepped, into = np.zeros((starts[-1],) * 2), np.zeros((starts[-1], len(parts)))
    stepped[:n, :n] = expm(period * a)
    for j, (whole, rest) in enumerate(parts):
        newer = _integral(a, period - rest) @ b[:, j]
        older = expm((period - rest) * a) @ (_integral(a, rest) @ b[:, j]) if rest > 0 else None
        for age, effect in ((whole, newer), (whole + 1, older)):
            if effect is not None and age == 0:
                into[:n, j] += effect
            elif effect is not None:
                stepped[:n, starts[j] + age - 1] += effect
        if past[j]:
            into[starts[j], j] = 1.0
            stepped[starts[j] + 1 : starts[j + 1], starts[j] : starts[j + 1] - 1] = np.eye(past[j] - 1)
    return stepped, into


def closed_by(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, controller: DigitalController
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and C of the closed loop, without relays: z ← A z + B e, reading C z + e, e the error of the readings."""
    n_c, n_u = len(controller.a), len(controller.actuators)
    rows, direct = controller.c, controller.d * controller.scale
    if controller.relays is not None:
        rows, direct = np.zeros((n_u, n_c)), np.zeros((n_u, len(controller.sensors)))
    a_c = controller.a + controller.e @ rows
    b_c = controller.b * controller.scale + controller.e @ direct
    closed = np.block([[a + b @ direct @ c, b @ rows], [b_c @ c, a_c]])
    return closed, np.vstack([b @ direct, b_c]), np.hstack([c, np.zeros((len(c), n_c))])


def linear_plant(
    modes: Modes, actuators: Sequence[Actuator], sensors: Sequence[Sensor]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and C of the structure with the linear part of its actuators and sensors, without delays."""
    linear_actuators = [
        replace(a, delay=0.0, dead_zone=0.0, limit=np.inf, rate_limit=np.inf, hysteresis_share=0.0, bias=0.0)
        for a in actuators
    ]
    linear_sensors = [replace(s, bias=0.0, drift=0.0, limit=np.inf, step=0.0) for s in sensors]
    plant = state_space(modes, linear_actuators, linear_sensors)
    return np.asarray(plant.A), np.asarray(plant.B), np.asarray(plant.C)


def _integral(a: np.ndarray, span: float) -> np.ndarray:
    """∫_0^span e^{At} dt; A may be singular."""
    n = a.shape[0]
    return np.asarray(expm(span * np.block([[a, np.eye(n)], [np.zeros((n, 2 * n))]]))[:n, n:])
