"""Observers: the state of the controlled modes from the readings, by a model that knows nothing of the residual ones.

    x̂' = (A - B K - L C) x̂ + L y,   u = -K x̂

What the residual modes add to y is observation spillover (Balas, IEEE Trans. Automatic Control 23 (1978) 673).
"""

from collections.abc import Callable, Sequence
from functools import partial

import control
import numpy as np
from numpy.typing import ArrayLike

from workbench.arrays import Complexes, Floats
from workbench.design.estimation.controller import Controller, reading
from workbench.design.laws.coupled import controlled_plant
from workbench.design.laws.law import DesignError, Law, linear, positive_definite
from workbench.design.laws.pole_assignment import assign
from workbench.rig.sensors import Sensor
from workbench.structure.modes import Modes

UNSEEN = 1e-9
# as fast as the mode that is watched, and damped enough to forget where it started within two periods
USUAL = -0.3 + 1j


def luenberger(modes: Modes, law: Law, sensors: Sequence[Sensor], *, poles: ArrayLike) -> Controller:
    """The law on the state of a Luenberger observer.

    Args:
        modes: at hand; the observer knows the controlled ones.
        law: u = -K x on those.
        sensors: displacement, slope, velocity or angular velocity; one will do.
        poles: (n_controlled,) of the observer's error, one of each conjugate pair a mode, rad/s.

    Raises:
        DesignError: a mode that no sensor sees, or poles that these sensors cannot place.
    """
    a, b, c = observed_plant(modes, law, sensors)
    n = law.n_controlled
    names = [f"mode {r + 1} of the observer" for r in law.controlled]
    # along (q_r, q_r' = λ q_r) the readings see mode r with c_q + λ c_v
    seen = c[:, :n] + 1j * modes.omega[list(law.controlled)] * c[:, n:]
    gain = assign(a.T, c.T, poles, seen.conj(), names).T
    return _controller(law, sensors, a, b, c, gain, "Luenberger observer", partial(luenberger, poles=poles))


def usual_poles(modes: Modes, controlled: Sequence[int]) -> Complexes:
    """Poles (n_controlled,) of an observer's error where none are given, rad/s: (-0.3 + i) ω of each mode.

    Rigid modes have no frequency: theirs are evenly spaced below that of the slowest elastic mode at hand.

    Raises:
        DesignError: rigid modes alone, which set no speed.
    """
    omega = np.array(modes.omega[list(controlled)])
    rigid, elastic = omega == 0, modes.omega[modes.omega > 0]
    if rigid.any() and not elastic.size:
        raise DesignError("rigid modes alone set no speed of an observer; give the poles of luenberger, or take kalman")
    omega[rigid] = elastic[:1] * np.arange(1, rigid.sum() + 1) / (rigid.sum() + 1)
    poles: Complexes = USUAL * omega
    return poles


def kalman(
    modes: Modes, law: Law, sensors: Sequence[Sensor], *, disturbance: ArrayLike, noise: ArrayLike
) -> Controller:
    """The law on the state of a steady Kalman filter (python-control's `lqe`).

    Args:
        modes, law, sensors: as for `luenberger`.
        disturbance: intensity of white modal forces, scalar, (n_controlled,) or (n_controlled, n_controlled).
        noise: intensity of the readings' white noise, scalar, (n_channels,) or (n_channels, n_channels); positive.

    Raises:
        DesignError: a mode that no sensor sees, intensities that are not positive.
    """
    a, b, c = observed_plant(modes, law, sensors)
    n = law.n_controlled
    push = positive_definite(disturbance, n, f"the disturbance intensity must be positive, one number or {n}")
    spread = positive_definite(
        noise, len(sensors), f"the noise intensity must be positive, one number or {len(sensors)}"
    )
    try:
        gain, _, _ = control.lqe(a, np.vstack([np.zeros((n, n)), np.eye(n)]), c, push, spread)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(
            f"the Kalman filter's Riccati equation has no stabilising solution: {error}; move or add a sensor"
        ) from error
    again = partial(kalman, disturbance=disturbance, noise=noise)
    return _controller(law, sensors, a, b, c, np.asarray(gain), "Kalman filter", again)


def observed_plant(modes: Modes, law: Law, sensors: Sequence[Sensor]) -> tuple[Floats, Floats, Floats]:
    """A, B and C of the controlled modes alone, from forces to readings.

    Raises:
        DesignError: a law that has no gain, no sensors, or a mode that none sees.
    """
    law = linear(law)
    index = list(law.controlled)
    own = modes.select(index)
    c = reading(own, sensors)
    if not len(sensors):
        raise DesignError("an observer needs a sensor; there are none")
    grid = np.abs(own.phi(modes.domain.grid(8 * modes.n_modes + 8))).max(axis=0)
    n = len(index)
    for j, r in enumerate(index):
        strength = max(np.abs(c[:, j]).max(), np.abs(c[:, n + j]).max())
        if strength <= UNSEEN * grid[j]:
            raise DesignError(f"mode {r + 1} is unobservable: all sensors stand at its nodes; move or add one")
    # where rigid modes stand is in displacements alone, and of all of them together
    rigid = np.flatnonzero(own.omega == 0)
    told = int(np.linalg.matrix_rank(c[:, rigid] / grid[rigid], tol=UNSEEN)) if rigid.size else 0
    if told < rigid.size:
        raise DesignError(
            f"{rigid.size} rigid-body {'modes need' if rigid.size > 1 else 'mode needs'} as many displacements that"
            f" distinguish them, and the sensors read {told}: velocity alone leaves them unobservable; add a"
            " displacement sensor, at another place"
        )
    a, b = controlled_plant(modes, index, law.actuators)
    return a, b, c


def _controller(
    law: Law,
    sensors: Sequence[Sensor],
    a: Floats,
    b: Floats,
    c: Floats,
    gain: Floats,
    how: str,
    designed_by: Callable[..., Controller],
) -> Controller:
    state = a - b @ law.gain - gain @ c
    direct = np.zeros((len(law.actuators), len(sensors)))
    name = f"{law.name} on a {how}"
    return Controller(law, tuple(sensors), state, gain, -law.gain, direct, name, gain, designed_by)
