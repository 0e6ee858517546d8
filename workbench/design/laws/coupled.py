"""Coupled control: one law for all controlled modes together, by a Riccati equation or by pole assignment."""

from collections.abc import Sequence
from functools import partial

import control
import numpy as np
from numpy.typing import ArrayLike

from workbench.design.laws.law import (
    DesignError,
    Law,
    controllable_input,
    controlled_indices,
    positive_definite,
    weighed_states,
)
from workbench.design.laws.pole_assignment import assign
from workbench.rig.actuators import Actuator
from workbench.rig.statespace import input_matrix
from workbench.structure.modes import Modes, modal_state_matrix

ON_AXIS = 1e-13  # of the fastest pole: a real part that may be rounding alone; the pole counts as not stabilised


def controlled_plant(
    modes: Modes, controlled: Sequence[int], actuators: Sequence[Actuator]
) -> tuple[np.ndarray, np.ndarray]:
    """A (2n, 2n) and B (2n, n_actuators) of the controlled modes alone."""
    index = list(controlled)
    b = input_matrix(modes, actuators)[index]
    a = modal_state_matrix(modes.omega[index] ** 2, modes.damping[np.ix_(index, index)])
    return a, np.vstack([np.zeros_like(b), b])


def coupled_lqr(
    modes: Modes, controlled: int | Sequence[int], actuators: Sequence[Actuator], *, weight: ArrayLike
) -> Law:
    """The regulator that minimises ∫ (Σ q_r'² + ω_r² q_r² + Fᵀ R F) dt over the actuator forces F.

    The displacement of a rigid mode costs nothing, so its gains are zero, as in `imsc`.

    Args:
        modes, controlled, actuators: as for `imsc`; fewer actuators than modes will do.
        weight: R, scalar, (n_actuators,) or (n_actuators, n_actuators).

    Raises:
        DesignError: a weight that is not positive definite, or modes that the actuators cannot stabilise.
    """
    index = controlled_indices(modes, controlled)
    actuators = tuple(actuators)
    controllable_input(modes, [r for r in index if modes.damping[r, r] <= 0], actuators)
    a, b = controlled_plant(modes, index, actuators)
    omega, size = modes.omega[list(index)], len(actuators)
    states = weighed_states(omega)
    # states ω q and q': their squares are the cost, and they are of one order of magnitude at any frequency
    scale = np.r_[omega, np.ones(omega.size)][states]
    a = a[np.ix_(states, states)] * scale[:, None] / scale
    r = positive_definite(weight, size, "the control weight")
    # commands scaled to equal cost: one in other units would make R look singular
    unit = np.sqrt(np.diag(r).max() / np.diag(r))
    own = f"modes {[r + 1 for r in index]}"
    try:
        scaled_gain, _, poles = control.lqr(a, b[states] * unit, np.eye(len(states)), r * np.outer(unit, unit))
    except (np.linalg.LinAlgError, ValueError, control.ControlSlycot) as error:
        raise DesignError(f"no regulator stabilises {own} from these places: {error}") from error
    if not (np.real(poles) < -ON_AXIS * np.abs(poles).max()).all():
        raise DesignError(f"{own} cannot all be stabilised from these places; move an actuator")
    gain = np.zeros((size, 2 * omega.size))
    gain[:, states] = unit[:, None] * scaled_gain * scale
    return Law(gain, index, actuators, "coupled LQR", partial(coupled_lqr, weight=weight))


def coupled_poles(
    modes: Modes, controlled: int | Sequence[int], actuators: Sequence[Actuator], *, poles: ArrayLike
) -> Law:
    """The law that assigns the poles of all controlled modes together, from any number of actuators.

    Each mode's pole is moved by the forces that act on that mode best, F ∝ b_r (see `assign`), which keeps gains low.

    Args:
        modes, controlled, actuators: as for `imsc`; fewer actuators than modes will do.
        poles: (n_controlled,) one of each conjugate pair per controlled mode, rad/s.

    Raises:
        DesignError: a pole that is not stable, a mode that no actuator moves, poles that cannot be held apart.
    """
    index = controlled_indices(modes, controlled)
    b = controllable_input(modes, index, actuators)
    a, full = controlled_plant(modes, index, actuators)
    gain = assign(a, full, poles, b.T.astype(complex), [f"mode {r + 1}" for r in index])
    return Law(gain, index, tuple(actuators), "coupled poles", partial(coupled_poles, poles=poles))
