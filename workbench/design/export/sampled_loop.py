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
from workbench.rig.sensors import Sensor
from workbench.rig.statespace import state_space
from workbench.structure.modes import Modes

MOST_PAST = 400  # commands under way at a time
EVEN = 1e-9  # of a sample: a delay so near a whole number of samples is one


def sampled_loop(
    modes: Modes,
    actuators: Sequence[Actuator],
    sensors: Sequence[Sensor],
    controller: DigitalController,
    computing_delay: float = 0.0,
) -> np.ndarray:
    """The matrix (n_states, n_states) of the loop: plant, controller, then the commands that are still under way.

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
    a, b, c = _plant(modes, actuators, sensors)
    period = controller.sample_time
    n, n_actuators = a.shape[0], len(actuators)
    parts = [_whole_and_rest(computing_delay + actuator.delay, period) for actuator in actuators]
    kept = max(whole + (rest > 0) for whole, rest in parts)  # commands of the past that still act
    step = expm(period * a)
    if kept > MOST_PAST:
        raise DesignError(
            f"{kept} samples pass until a command acts, more than {MOST_PAST}; sample slower, or shorten the delays"
        )
    # column block i: of the command i samples ago
    into = np.zeros((n, (kept + 1) * n_actuators))
    for j, (whole, rest) in enumerate(parts):
        first = expm((period - rest) * a)
        into[:, whole * n_actuators + j] += _integral(a, period - rest) @ b[:, j]
        if rest > 0:
            into[:, (whole + 1) * n_actuators + j] += first @ (_integral(a, rest) @ b[:, j])
    command = controller.state_space()
    read = np.hstack([np.asarray(command.D) @ c, np.asarray(command.C)])  # u_k from x_k and z_k
    nz = command.nstates
    past = kept * n_actuators
    matrix = np.zeros((n + nz + past,) * 2)
    matrix[:n, :n] = step
    matrix[:n, : n + nz] += into[:, :n_actuators] @ read
    matrix[:n, n + nz :] = into[:, n_actuators:]
    matrix[n : n + nz, : n + nz] = np.hstack([np.asarray(command.B) @ c, np.asarray(command.A)])
    if past:
        matrix[n + nz : n + nz + n_actuators, : n + nz] = read
        matrix[n + nz + n_actuators :, n + nz : -n_actuators] = np.eye(past - n_actuators)
    return matrix


def _plant(
    modes: Modes, actuators: Sequence[Actuator], sensors: Sequence[Sensor]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and C of the structure, its actuators and sensors, as far as they are linear."""
    drives = [
        replace(a, delay=0.0, dead_zone=0.0, limit=np.inf, rate_limit=np.inf, hysteresis_share=0.0, bias=0.0)
        for a in actuators
    ]
    known = [replace(s, bias=0.0, drift=0.0, limit=np.inf, step=0.0) for s in sensors]
    plant = state_space(modes, drives, known)
    return np.asarray(plant.A), np.asarray(plant.B), np.asarray(plant.C)


def _whole_and_rest(delay: float, period: float) -> tuple[int, float]:
    """Whole samples of a delay, and what is left of it, s."""
    whole, rest = divmod(delay, period)
    if rest > (1 - EVEN) * period:
        whole, rest = whole + 1, 0.0
    return int(whole), 0.0 if rest < EVEN * period else rest


def _integral(a: np.ndarray, span: float) -> np.ndarray:
    """∫_0^span e^{At} dt, also where A is singular."""
    n = a.shape[0]
    return np.asarray(expm(span * np.block([[a, np.eye(n)], [np.zeros((n, 2 * n))]]))[:n, n:])
