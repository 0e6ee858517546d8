"""Pole assignment of a multivariable system by the Sylvester equation, at the cost of one linear solve.

With X Λ - A X = B G and Λ the wanted poles, K = -G X⁻¹ gives (A - B K) X = X Λ (Bhattacharyya & de Souza, Systems &
Control Letters 1 (1982) 261). G is free. Each column is the input that acts best on one mode, so that the eigenvector
of its pole holds little of the other modes: X stays well conditioned and K small.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from workbench.design.laws.law import DesignError

ILL_CONDITIONED = 1e12  # condition number of X above which the poles count as not assignable
COINCIDES = 1e-12  # of the pole: nearer to an open-loop pole it coincides with it, nearer to the real axis it is real


def assign(a: np.ndarray, b: np.ndarray, poles: ArrayLike, directions: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Gain K (n_inputs, 2n) that gives A - B K the poles and their conjugates.

    Args:
        a: (2n, 2n) real, states (q_1..q_n, q_1'..q_n').
        b: (2n, n_inputs) real.
        poles: (n,) one of each conjugate pair, rad/s, off the real axis; the r-th replaces that of the r-th mode.
        directions: (n_inputs, n) complex, the input that acts best on each mode.
        names: of the modes, for refusals.
    """
    n = a.shape[0] // 2
    poles = np.asarray(poles, complex)
    if poles.shape != (n,):
        raise DesignError(f"one pole per mode is needed, ({n},); got {poles.shape}")
    for pole, name in zip(poles, names, strict=True):
        if not pole.real < 0:
            raise DesignError(f"pole {pole:.4g} of {name} is not stable: its real part must be negative")
        if abs(pole.imag) <= COINCIDES * abs(pole):
            raise DesignError(
                f"pole {pole.real:.4g} of {name} is real; give one of a conjugate pair, off the real axis"
            )
    inputs = np.array(directions, complex)
    vectors, determinants = _resolvents(a, poles, b @ inputs)
    coincides = np.abs(determinants) <= COINCIDES * np.abs(poles) ** 2
    for r, mode in zip(*np.nonzero(coincides.T), strict=True):
        if r != mode:
            raise DesignError(
                f"pole {poles[r]:.4g} of {names[r]} is the open-loop pole of {names[mode]}; shift it a little"
            )
        # a pole left at its open-loop value needs no input: its eigenvector is the mode's own
        upper = np.zeros(n, complex)
        upper[r] = 1.0
        vectors[:, r], inputs[:, r] = np.r_[upper, (poles[r] - a[r, r]) / (a[r, n + r] or 1.0) * upper], 0.0
    size = np.linalg.norm(vectors, axis=0)
    vectors, inputs = vectors / size, inputs / size
    x, g = np.hstack([vectors.real, vectors.imag]), np.hstack([inputs.real, inputs.imag])
    if not np.linalg.cond(x) < ILL_CONDITIONED:
        raise DesignError(
            f"{b.shape[1]} input(s) cannot assign {n} pairs of poles so close together; space them out, move an"
            " actuator (for an observer, a sensor) or add one"
        )
    return -np.linalg.solve(x.T, g.T).T


def _resolvents(a: np.ndarray, poles: np.ndarray, forcing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(p_r - A)⁻¹ forcing_r for each pole, and det(p_r - A) mode by mode (n_modes, n_poles)."""
    n = a.shape[0] // 2
    qq, qv, vq, vv = (np.diag(block)[:, None] for block in (a[:n, :n], a[:n, n:], a[n:, :n], a[n:, n:]))
    determinants = (poles - qq) * (poles - vv) - qv * vq
    if not any((block - np.diag(np.diag(block))).any() for block in (a[n:, n:], a[n:, :n])):  # uncoupled modes
        upper, lower = forcing[:n], forcing[n:]
        with np.errstate(divide="ignore", invalid="ignore"):
            q = ((poles - vv) * upper + qv * lower) / determinants
            v = ((poles - qq) * lower + vq * upper) / determinants
        return np.vstack([q, v]), determinants
    eye = np.eye(2 * n)
    return np.array([np.linalg.solve(p * eye - a, f) for p, f in zip(poles, forcing.T, strict=True)]).T, determinants
