"""Second moments ∫ x xᵀ dt of the motion x' = A x from an initial state; cost, effort and work are linear in them.

A is balanced first: displacements and rates differ by the frequency, and their rounding errors by its square.
"""

import numpy as np
from scipy.linalg import matrix_balance, solve_continuous_lyapunov

from workbench.arrays import Floats
from workbench.rig.linear import integrated


def settled_moments(a: Floats, starts: Floats) -> Floats:
    """∫_0^∞ x xᵀ dt (n, n) for a stable A, summed over the initial states `starts`, (n,) or (n, n_starts)."""
    a, (scale, _) = matrix_balance(a, permute=False, separate=True)
    starts = starts.reshape(len(a), -1) / scale[:, None]
    moments: Floats = solve_continuous_lyapunov(a, -starts @ starts.T)
    return np.asarray(scale[:, None] * moments * scale)


def second_moments(a: Floats, state: Floats, final_time: float) -> Floats:
    """∫_0^t x xᵀ dt (n, n), from dM/dt = A M + M Aᵀ + x0 x0ᵀ over a short time that is doubled repeatedly."""
    a, (scale, _) = matrix_balance(a, permute=False, separate=True)
    state = state / scale
    halvings = max(0, int(np.ceil(np.log2(max(np.abs(a).sum(axis=1).max() * final_time, 1.0)))))
    _, moments = integrated(a, np.outer(state, state), final_time, halvings)
    return np.asarray(scale[:, None] * moments * scale)
