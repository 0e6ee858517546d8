"""Independent modal-space control: every mode has its own closed-form law, the actuators share the work.

Meirovitch & Baruh; dissertation section 5.2. Mode r is controlled by the modal force f_r = -g1 q_r - g2 q_r', and the
actuators by F = B⁺ f, B the participation of the controlled modes.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from workbench.arrays import Floats
from workbench.design.laws.law import DesignError, Law, controlled_indices, participation
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes


def riccati_gains(omega: ArrayLike, weight: ArrayLike, damping: ArrayLike = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Gains g1, 1/s², and g2, 1/s, (n_modes,) each, that minimise ∫ (q'² + ω² q² + R f²) dt of each mode.

    g1 = -ω² + sqrt(ω⁴ + ω²/R), g2 = -c + sqrt(c² + 1/R + 2 g1); (5.55), (5.64) corrected, with modal damping c.
    g1 is evaluated as (ω²/R) / (ω² + sqrt(ω⁴ + ω²/R)), which does not cancel.

    Args:
        omega: (n_modes,) natural frequencies, rad/s.
        weight: R, scalar or (n_modes,); positive.
        damping: c_r = 2 ζ_r ω_r, scalar or (n_modes,), 1/s.
    """
    if np.ndim(omega) and np.size(weight) not in (1, np.size(omega)):
        raise DesignError(
            f"the control weight R is one number, or one per mode: {np.size(omega)} modes need as many; got"
            f" {np.size(weight)}"
        )
    omega, weight, c = np.broadcast_arrays(*(np.asarray(each, float) for each in (omega, weight, damping)))
    if not (np.isfinite(weight).all() and (weight > 0).all()):
        raise DesignError(f"the control weight R must be positive; got {weight.min() if weight.size else weight}")
    square, inverse = omega**2, 1.0 / weight
    # a rigid-body mode has no potential energy, so the gain on its displacement is zero
    sums = square + np.sqrt(square**2 + square * inverse)
    g1 = np.where(square > 0, square * inverse / np.maximum(sums, 1e-300), 0.0)
    excess = inverse + 2.0 * g1
    g2 = excess / (c + np.sqrt(c**2 + excess))
    return g1, g2


def riccati_matrices(omega: ArrayLike, weight: ArrayLike, damping: ArrayLike = 0.0) -> np.ndarray:
    """The solutions P (n_modes, 2, 2) of the Riccati equations of `riccati_gains`: J = x0ᵀ P x0 per mode."""
    g1, g2 = riccati_gains(omega, weight, damping)
    square = np.asarray(omega, float) ** 2
    p12, p22 = weight * g1, weight * g2
    p11 = (square + g1) * p22 + np.asarray(damping) * p12
    return np.moveaxis(np.array([[p11, p12], [p12, p22]]), -1, 0)


def pole_gains(omega: ArrayLike, poles: ArrayLike, damping: ArrayLike = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Gains (g1, g2) that put each mode's poles at `poles` (n_modes,), one of each stable conjugate pair, rad/s.

    s² + (c + g2) s + ω² + g1 = (s - p)(s - p*).
    """
    omega, poles = np.asarray(omega, float), np.asarray(poles, complex)
    if poles.shape != omega.shape:
        raise DesignError(f"one pole per mode is needed, {omega.shape}; got {poles.shape}")
    if not (poles.real < 0).all():
        bad = poles[~(poles.real < 0)][0]
        raise DesignError(f"pole {bad:.4g} is not stable: its real part must be negative")
    return np.abs(poles) ** 2 - omega**2, -2.0 * poles.real - np.asarray(damping)


def imsc(modes: Modes, controlled: int | Sequence[int], actuators: Sequence[Actuator], *, weight: ArrayLike) -> Law:
    """The optimal IMSC law: closed-form Riccati gains, one mode at a time; damping that couples modes is left out.

    Args:
        modes: of the structure; those not controlled are residual.
        controlled: number of the lowest modes, or their indices (zero-based).
        actuators: at least as many as controlled modes.
        weight: R, scalar or one per controlled mode.
    """
    index = controlled_indices(modes, controlled)
    c = np.diag(modes.damping)[list(index)]
    g1, g2 = riccati_gains(modes.omega[list(index)], weight, c)
    gain = _shared(modes, index, actuators, np.diag(g1), np.diag(g2))
    return Law(gain, index, tuple(actuators), "IMSC", partial(imsc, weight=weight))


def imsc_poles(
    modes: Modes, controlled: int | Sequence[int], actuators: Sequence[Actuator], *, poles: ArrayLike
) -> Law:
    """The IMSC law with the closed-loop poles given, one of each conjugate pair per controlled mode, rad/s.

    The gains cancel the damping that couples controlled modes, so that each closed loop is independent.
    """
    index = controlled_indices(modes, controlled)
    g1, g2 = pole_gains(modes.omega[list(index)], poles)
    gain = _shared(modes, index, actuators, np.diag(g1), np.diag(g2) - modes.damping[np.ix_(index, index)])
    return Law(gain, index, tuple(actuators), "IMSC poles", partial(imsc_poles, poles=poles))


def _shared(modes: Modes, index: Sequence[int], actuators: Sequence[Actuator], *gains: Floats) -> Floats:
    """K = B⁺ (G1 G2) from modal gains G (n_controlled, n_controlled)."""
    return np.asarray(np.linalg.pinv(participation(modes, index, actuators)) @ np.hstack(gains))
