"""The loop of all modes under a controller that runs once a sample, exact from sample to sample.

With the plant x' = A x + B u, y = C x and a command held over each sample that acts τ = m T + r late,

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

MOST_PAST = 400  # commands under way at a time


def sampled_loop(
    modes: Modes,
    actuators: Sequence[Actuator],
    sensors: Sequence[Sensor],
    controller: DigitalController,
    computing_delay: float = 0.0,
) -> np.ndarray:
    """The matrix (n_states, n_states) of the loop: plant, commands that are still under way, then controller.

    Args:
        modes: controlled and residual.
        actuators: in the order of the commands; their gains, lags and delays count, limits and dead zones do not.
        sensors: in the order of the readings, likewise.
        controller: its linear part, limits left out.
        computing_delay: from a reading to the command's first effect, beside the actuators' own delays, s.

    Raises:
        DesignError: a sensor that is late by itself, or a negative delay.
    """
    late = [sensor.name for sensor in sensors if sensor.delay or sensor.crosstalk]
    if late:
        raise DesignError(f"sensor {late[0]} is late or reads others too; count its delay as computing delay")
    if not (np.isfinite(computing_delay) and computing_delay >= 0):
        raise DesignError(f"the computing delay must be 0 s or more; got {computing_delay:g} s")
    a, b, c = linear_plant(modes, actuators, sensors)
    delays = np.array([computing_delay + actuator.delay for actuator in actuators])
    stepped, into = held(a, b, controller.sample_time, delays)
    reads = np.hstack([c, np.zeros((len(c), len(stepped) - len(a)))])
    return closed_by(stepped, into, reads, controller)[0]


def held(a: np.ndarray, b: np.ndarray, period: float, delays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and B from sample to sample; the states are x, then each actuator's commands under way, newest first.

    Args:
        a: (n, n); b: (n, n_actuators).
        period: s.
        delays: (n_actuators,) until a command acts, s.

    Raises:
        DesignError: too many commands under way.
    """
    parts = [whole_samples(float(delay), period) for delay in delays]
    past = [whole + (rest > 0) for whole, rest in parts]
    if max(past, default=0) > MOST_PAST:
        raise DesignError(
            f"{max(past)} samples pass until a command acts, more than {MOST_PAST}; sample slower, or shorten the"
            " delays"
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
    """The loop z ← A z, what errors of the readings add to it, and the readings: A, B, C; relays switched off."""
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
    """A, B and C of the structure, its actuators and sensors, as far as they are linear; delays left out."""
    drives = [
        replace(a, delay=0.0, dead_zone=0.0, limit=np.inf, rate_limit=np.inf, hysteresis_share=0.0, bias=0.0)
        for a in actuators
    ]
    known = [replace(s, bias=0.0, drift=0.0, limit=np.inf, step=0.0) for s in sensors]
    plant = state_space(modes, drives, known)
    return np.asarray(plant.A), np.asarray(plant.B), np.asarray(plant.C)


def _integral(a: np.ndarray, span: float) -> np.ndarray:
    """∫_0^span e^{At} dt, also where A is singular."""
    n = a.shape[0]
    return np.asarray(expm(span * np.block([[a, np.eye(n)], [np.zeros((n, 2 * n))]]))[:n, n:])
