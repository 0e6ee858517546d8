"""Boundary condition check: whether measured shapes contradict an end as stated.

Splines that do not assume the boundary condition extrapolate the derivatives t that it sets to zero. Their covariance
is that of the sensors' noise and of the interpolation error, its roughness τ² at its upper limit. Over all modes and
all conditions of one end, Σ t^T Cov^-1 t is chi-square where the end is as stated.
"""

from typing import Any

import numpy as np
from scipy.stats import chi2

from workbench.identification.free_decay.refined import Refined
from workbench.identification.shapes.eigenfunctions import KnownEnds, interpolating_spline
from workbench.identification.shapes.interpolation_error import LeaveOneOut, peano_kernel
from workbench.identification.signal.modal_estimates import normalised_shapes

# Splines of higher degree extrapolate further from fewer sensors, and err more where a mode is short for its sensors.
DEGREES = (5, 3)
# Share of the variance of each derivative that is independent of the others: K knows their ratio no better.
OF_ITS_OWN = 0.01
# Chance that a correct end is refused.
UNLIKELY = 1e-4
DERIVATIVES = ("value", "slope", "curvature", "change of curvature")


def check_ends(refined: Refined, ends: KnownEnds, *, length: float) -> None:
    """Refuse an end that the shapes contradict; of fewer than five sensors or so none is.

    Args:
        refined: shapes at placed sensors, with their covariance.
        ends: as stated.
        length: m.

    Raises:
        ValueError: a boundary condition that the shapes contradict.
    """
    values, positions = normalised_shapes(refined.modes.shapes).real, refined.modes.positions
    for name, at in (("left", 0.0), ("right", length)):
        conditions = [d for x, d in ends.zeros if abs(x - at) <= 1e-9 * length]
        others = KnownEnds(tuple(zero for zero in ends.zeros if abs(zero[0] - at) > 1e-9 * length))
        extrapolated = _extrapolated(positions, others, at, conditions, length) if conditions else None
        if extrapolated is None:
            continue
        rows, error, leave_one_out = extrapolated
        away, std, against = np.zeros((3, values.shape[1], len(conditions)))
        for r, (v, noise) in enumerate(zip(values.T, refined.shape_covariance, strict=True)):
            covariance = rows @ noise @ rows.T + leave_one_out.roughest(v, noise) * error @ error.T
            known = np.linalg.inv(covariance + OF_ITS_OWN * np.diag(np.diag(covariance)))
            # Each conditional on the others.
            std[r] = 1.0 / np.sqrt(np.diag(known))
            away[r] = known @ rows @ v * std[r] ** 2
            against[r] = rows @ v * (known @ rows @ v)
        chance = float(chi2.sf(against.sum(), against.size))
        if chance < UNLIKELY:
            r, k = divmod(int(np.argmax(np.abs(away / std))), len(conditions))
            rest = ", given the rest" if len(conditions) > 1 else ""
            zero = " and ".join(DERIVATIVES[d] for d in conditions)
            raise ValueError(
                f"the {name} end is stated to have zero {zero}, and the shapes contradict it"
                f" (p = {max(chance, 1e-99):.1g}): of its largest entry, along the length, mode {r + 1} has a"
                f" {DERIVATIVES[conditions[k]]} of {away[r, k]:.3g} ± {std[r, k]:.2g} there{rest}; correct the end, or"
                " leave it out"
            )


def _extrapolated(
    positions: np.ndarray, others: KnownEnds, at: float, conditions: list[int], length: float
) -> tuple[np.ndarray, np.ndarray, LeaveOneOut] | None:
    """The derivatives stated to be zero by the sensors, (n_conditions, n_sensors), and their interpolation error,
    (n_conditions, n_cells), the length as unit; and how such splines predict the sensors. None where sensors are too
    few."""
    where: dict[str, Any] = {"length": length, "ends": others}
    x = np.array([at])
    for degree in DEGREES:
        try:
            spline = interpolating_spline(positions, degree=degree, **where)
            leave_one_out = LeaveOneOut(positions, degree=degree, **where)
        except ValueError:
            continue
        rows = [spline.matrix(x, d) * length**d for d in conditions]
        error = [peano_kernel(spline, x, positions, length, d) * length**d for d in conditions]
        return np.vstack(rows), np.vstack(error), leave_one_out
    return None
