"""Observers: the state of the controlled modes estimated from the readings, by a model without the residual modes.

    x̂' = (A - B K - L C) x̂ + L y,   u = -K x̂

The part of y due to the residual modes is observation spillover (Balas, IEEE Trans. Automatic Control 23 (1978) 673).
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

UNOBSERVABLE = 1e-9  # of a mode's largest displacement: a smaller reading does not observe the mode
# pole over ω: as fast as the observed mode, and damped enough that the initial error decays within two periods
USUAL = -0.3 + 1j

Plant = tuple[Floats, Floats, Floats]  # A, B, C


def luenberger_controller(modes: Modes, law: Law, sensors: Sequence[Sensor], *, poles: ArrayLike) -> Controller:
    """The controller of a law on the state of a Luenberger observer.

    Args:
        modes: of the structure; the observer models the controlled ones.
        law: u = -K x of the controlled modes.
        sensors: displacement, slope, velocity or angular velocity; one is enough.
        poles: (n_controlled,) of the estimation error, one of each conjugate pair per mode, rad/s.

    Raises:
        DesignError: a mode that no sensor observes, or poles that these sensors cannot assign.
    """
    plant = a, _, c = observed_plant(modes, law, sensors)
    n = law.n_controlled
    names = [f"mode {r + 1} of the observer" for r in law.controlled]
    # of the motion (q_r, q_r' = λ q_r) of mode r the sensors read c_q + λ c_v
    outputs = c[:, :n] + 1j * modes.omega[list(law.controlled)] * c[:, n:]
    gain = assign(a.T, c.T, poles, outputs.conj(), names).T
    return _controller(law, sensors, plant, gain, "Luenberger observer", partial(luenberger_controller, poles=poles))


def usual_poles(modes: Modes, controlled: Sequence[int]) -> Complexes:
    """Default poles (n_controlled,) of an observer's estimation error, rad/s: (-0.3 + i) ω of each mode.

    Rigid modes have no frequency: ω is then evenly spaced below that of the slowest elastic mode.
    """
    omega = np.array(modes.omega[list(controlled)])
    rigid, elastic = omega == 0, modes.omega[modes.omega > 0]
    if rigid.any() and not elastic.size:
        raise DesignError(
            "rigid modes alone have no frequency that sets the observer's poles; give luenberger_controller its"
            " poles, or use kalman_controller"
        )
    omega[rigid] = elastic[:1] * np.arange(1, rigid.sum() + 1) / (rigid.sum() + 1)
    return np.asarray(USUAL * omega)


def kalman_controller(
    modes: Modes, law: Law, sensors: Sequence[Sensor], *, disturbance: ArrayLike, noise: ArrayLike
) -> Controller:
    """The controller of a law on the state of a steady-state Kalman filter (python-control's `lqe`).

    Args:
        modes, law, sensors: as for `luenberger_controller`.
        disturbance: intensity W of white modal forces, E w(t) w(t')ᵀ = W δ(t - t'), in modal force² s, N² s/kg: a
            number, (n_controlled,) or (n_controlled, n_controlled), positive definite.
        noise: intensity of the readings' white noise, in reading² s: a number, (n_channels,) or (n_channels,
            n_channels), positive definite. Noise of standard deviation σ, held over each sample T, has σ² T.

    Raises:
        DesignError: a mode that no sensor observes, intensities that are not positive.
    """
    plant = a, _, c = observed_plant(modes, law, sensors)
    n = law.n_controlled
    process = positive_definite(disturbance, n, "the disturbance intensity")
    measurement = positive_definite(noise, len(sensors), "the noise intensity")
    try:
        gain, _, _ = control.lqe(a, np.vstack([np.zeros((n, n)), np.eye(n)]), c, process, measurement)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(
            f"the Kalman filter's Riccati equation has no stabilising solution: {error}; move or add a sensor"
        ) from error
    again = partial(kalman_controller, disturbance=disturbance, noise=noise)
    return _controller(law, sensors, plant, np.asarray(gain), "Kalman filter", again)


def observed_plant(modes: Modes, law: Law, sensors: Sequence[Sensor]) -> Plant:
    """A, B and C of the controlled modes alone, from forces to readings, checked to be observable."""
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
        if strength <= UNOBSERVABLE * grid[j]:
            raise DesignError(f"mode {r + 1} is unobservable: all sensors are at its nodes; move or add one")
    # rigid modes are observable through displacements alone, and need as many independent ones as there are modes
    rigid = np.flatnonzero(own.omega == 0)
    rank = int(np.linalg.matrix_rank(c[:, rigid] / grid[rigid], tol=UNOBSERVABLE)) if rigid.size else 0
    if rank < rigid.size:
        raise DesignError(
            f"{rigid.size} rigid-body {'modes need' if rigid.size > 1 else 'mode needs'} as many independent"
            f" displacement sensors; there are {rank}: velocity alone leaves rigid modes unobservable; add a"
            " displacement sensor, at another place"
        )
    a, b = controlled_plant(modes, index, law.actuators)
    return a, b, c


def _controller(
    law: Law, sensors: Sequence[Sensor], plant: Plant, gain: Floats, how: str, designed_by: Callable[..., Controller]
) -> Controller:
    a, b, c = plant
    state = a - b @ law.gain - gain @ c
    direct = np.zeros((len(law.actuators), len(sensors)))
    name = f"{law.name} on a {how}"
    return Controller(law, tuple(sensors), state, gain, -law.gain, direct, name, gain, designed_by)
