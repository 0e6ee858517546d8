"""Closed-loop identification: the open-loop structure from a closed-loop record with known gains (Chapter 6).

Modal coordinates in the closed loop are q(t) = Σ_k ψ_k e^{p_k t}. With u = -K x known, every pair (p_k, ψ_k) gives

    S ψ_k + p_k C ψ_k = -p_k² ψ_k - B K (ψ_k, p_k ψ_k),

linear in the stiffness S (Ω² where the shapes are unchanged) and the damping C of the controlled modes.
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
class OpenLoopEstimate:
    """Stiffness and damping of the controlled modes, without control.

    Attributes:
        stiffness: (n_controlled, n_controlled) S, 1/s²; diagonal where the shapes are unchanged.
        damping: (n_controlled, n_controlled) C, 1/s.
    """

    stiffness: np.ndarray
    damping: np.ndarray

    def __post_init__(self) -> None:
        freeze(self, "stiffness", "damping")

    @property
    def omega(self) -> np.ndarray:
        """Natural frequencies (n_controlled,), rad/s, in the order of the controlled modes."""
        return np.sqrt(np.maximum(np.diag(self.stiffness), 0.0))

    @property
    def coupling(self) -> float:
        """Largest |S_rs| / √(S_rr S_ss) between two modes; zero where the shapes are unchanged."""
        size = np.maximum(self.omega, 1e-300)
        off = self.stiffness - np.diag(np.diag(self.stiffness))
        return float(np.abs(off / np.outer(size, size)).max())


def open_loop(modes: Modes, law: Law, poles: ArrayLike, shapes: ArrayLike) -> OpenLoopEstimate:
    """The open-loop stiffness and damping from closed-loop poles and shapes.

    Args:
        modes: for which the law was designed; their shapes at the actuators count as unchanged.
        law: u = -K x of the record.
        poles: (n_controlled,) closed-loop poles, one of each pair, rad/s.
        shapes: (n_controlled, n_controlled) complex, modal coordinates in rows, one column per pole.

    Raises:
        DesignError: not as many poles as controlled modes, or nearly dependent shapes.
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
            "the closed-loop shapes are nearly dependent, so the modes cannot be distinguished; record longer, or"
            " excite all modes"
        )
    solution = np.linalg.solve((left / scale).T, right.T).T / scale.T
    return OpenLoopEstimate(solution[:, :n], solution[:, n:])


def updated(modes: Modes, controlled: Sequence[int], found: OpenLoopEstimate) -> Modes:
    """The modes with the controlled ones' frequencies and damping as re-identified; all shapes stay."""
    index = list(controlled)
    omega, damping = modes.omega.copy(), modes.damping.copy()
    omega[index] = found.omega
    damping[np.ix_(index, index)] = np.diag(np.diag(found.damping))
    return replace(modes, omega=omega, damping=damping, covariance=None)
