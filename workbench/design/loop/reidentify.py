"""From a closed-loop record with known gains back to the structure: the simultaneous problem of Chapter 6.

Modal coordinates read in the loop move as q(t) = Σ_k ψ_k e^{p_k t}. With u = -K x known, every pair gives

    S ψ_k + p_k C ψ_k = -p_k² ψ_k - B K (ψ_k, p_k ψ_k),

linear in the stiffness S (Ω² where the shapes still hold) and the damping C of the controlled modes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from workbench.design.laws.law import DesignError, Law
from workbench.rig.statespace import input_matrix
from workbench.structure.modes import Modes, freeze

ILL_CONDITIONED = 1e10


@dataclass(frozen=True, eq=False)
class Reidentified:
    """Stiffness and damping of the controlled modes, without control.

    Attributes:
        stiffness: (n_controlled, n_controlled) S, 1/s²; diagonal where the shapes still hold.
        damping: (n_controlled, n_controlled) C, 1/s.
    """

    stiffness: np.ndarray
    damping: np.ndarray

    def __post_init__(self) -> None:
        freeze(self, "stiffness", "damping")

    @property
    def omega(self) -> np.ndarray:
        """Natural frequencies (n_controlled,), rad/s, by the order of the controlled modes."""
        return np.sqrt(np.maximum(np.diag(self.stiffness), 0.0))

    @property
    def coupling(self) -> float:
        """Largest stiffness between modes relative to √(S_rr S_ss): how far the shapes no longer hold."""
        size = np.maximum(self.omega, 1e-300)
        off = self.stiffness - np.diag(np.diag(self.stiffness))
        return float(np.abs(off / np.outer(size, size)).max())


def open_loop(modes: Modes, law: Law, poles: ArrayLike, shapes: ArrayLike) -> Reidentified:
    """The structure behind closed-loop poles and shapes.

    Args:
        modes: as they were when the law was designed; their shapes at the actuators are taken to hold.
        law: known, that closed the loop.
        poles: (n_controlled,) closed-loop poles, one of each pair, rad/s.
        shapes: (n_controlled, n_controlled) complex, modal coordinates in rows, one column a pole.

    Raises:
        DesignError: as many poles as controlled modes are needed; shapes too alike to distinguish modes.
    """
    poles, shapes = np.asarray(poles, complex), np.asarray(shapes, complex)
    n = law.n_controlled
    if poles.shape != (n,) or shapes.shape != (n, n):
        raise DesignError(
            f"{n} controlled modes need {n} poles and shapes ({n}, {n}); got {poles.shape}, {shapes.shape}"
        )
    both = np.vstack([shapes, shapes * poles])
    b = input_matrix(modes, law.actuators)[list(law.controlled)]
    right = -shapes * poles**2 - b @ law.gain @ both
    left, right = np.hstack([both.real, both.imag]), np.hstack([right.real, right.imag])
    scale = np.linalg.norm(left, axis=1, keepdims=True)
    if not np.linalg.cond(left / scale) < ILL_CONDITIONED:
        raise DesignError(
            "the closed-loop shapes are too alike to distinguish the modes; read them longer or excite all"
        )
    found = np.linalg.solve((left / scale).T, right.T).T / scale.T
    return Reidentified(found[:, :n], found[:, n:])


def updated(modes: Modes, controlled: Sequence[int], found: Reidentified) -> Modes:
    """The modes with the controlled ones' frequencies and damping as re-identified; all shapes stay."""
    index = list(controlled)
    omega, damping = modes.omega.copy(), modes.damping.copy()
    omega[index] = found.omega
    damping[np.ix_(index, index)] = np.diag(np.diag(found.damping))
    return replace(modes, omega=omega, damping=damping, covariance=None)
