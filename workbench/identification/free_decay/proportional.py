"""Is the damping proportional? The constants g1 and g2 of (3.32), and whether they explain what was measured."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from workbench.identification.free_decay.refinement import Refined
from workbench.structure.damping import ProportionalDamping
from workbench.structure.modes import frozen


@dataclass(frozen=True, eq=False)
class ProportionalFit:
    """The best g1 and g2, and how well they do.

    Attributes:
        damping: g1 in s and g2 in 1/s.
        standard_errors: (2,) of g1 and g2.
        left_over: (n_modes,) ζ_r minus the fit, in standard errors of ζ_r.
        probability: of so bad a fit if the damping is proportional; below 0.01 it hardly is.
    """

    damping: ProportionalDamping
    standard_errors: np.ndarray
    left_over: np.ndarray
    probability: float


def proportional_fit(refined: Refined, only: Sequence[int] | slice = slice(None)) -> ProportionalFit:
    """Weighted least squares of ζ_r = (g1 ω_r + g2 / ω_r) / 2 (3.32), weights from the covariance of ζ.

    Args:
        refined: modes with the errors of their damping.
        only: the modes to fit, from 0; all unless given.

    Raises:
        ValueError: fewer than two modes.
    """
    modes = refined.modes.select(only)
    n = modes.n_modes
    if n < 2:
        raise ValueError(f"g1 and g2 take at least two modes; there are {n}: identify more")
    columns = 0.5 * np.column_stack([modes.omega, 1.0 / modes.omega])
    which = refined.modes.n_modes + np.arange(refined.modes.n_modes)[only]
    covariance = refined.covariance[np.ix_(which, which)]
    root = np.linalg.cholesky(covariance)
    a, b = np.linalg.solve(root, columns), np.linalg.solve(root, modes.zeta)
    g = np.linalg.lstsq(a, b, rcond=None)[0]
    misfit = float(((b - a @ g) ** 2).sum())
    return ProportionalFit(
        damping=ProportionalDamping(float(g[0]), float(g[1])),
        standard_errors=frozen(np.sqrt(np.diag(np.linalg.inv(a.T @ a)))),
        left_over=frozen((modes.zeta - columns @ g) / np.sqrt(np.diag(covariance))),
        probability=float(chi2.sf(misfit, n - 2)) if n > 2 else 1.0,
    )
