"""Whether shapes contradict what was told of an end: splines that do not believe it say what the end would hold.

Derivatives t of such a spline at the end, which are told to be zero, have the covariance of the sensors' noise carried
there, and of what a spline misses (`unseen`), its roughness τ² as large as it may be. Over all modes and all that is
told of one end, Σ t^T Cov^-1 t is chi-square where the end is as told.
"""

from typing import Any

import numpy as np
from scipy.stats import chi2

from workbench.identification.free_decay.ibrahim import normalised_shapes
from workbench.identification.free_decay.refinement import Refined
from workbench.identification.shapes.eigenfunctions import KnownEnds, interpolating_spline
from workbench.identification.shapes.interpolation_error import Foretold, missed_kernel

# Splines of higher degree reach further from less, and err more where a mode swings too fast for its sensors.
DEGREES = (5, 3)
# Of the variance of each derivative, so much is not shared with the others: K knows their ratio no better.
OF_ITS_OWN = 0.01
# Chance that an end as it was told is refused.
UNLIKELY = 1e-4
DERIVATIVES = ("value", "slope", "curvature", "change of curvature")


def check_ends(refined: Refined, ends: KnownEnds, *, length: float) -> None:
    """Refuse an end that the shapes contradict; of fewer than five sensors or so none is.

    Args:
        refined: shapes at placed sensors, with their covariance.
        ends: as told.
        length: m.

    Raises:
        ValueError: what the end is told to hold at zero and does not.
    """
    values, positions = normalised_shapes(refined.modes.shapes).real, refined.modes.positions
    for name, at in (("left", 0.0), ("right", length)):
        told = [d for x, d in ends.zeros if abs(x - at) <= 1e-9 * length]
        others = KnownEnds(tuple(zero for zero in ends.zeros if abs(zero[0] - at) > 1e-9 * length))
        judge = _judge(positions, others, at, told, length) if told else None
        if judge is None:
            continue
        rows, missed, foretold = judge
        away, std, against = np.zeros((3, values.shape[1], len(told)))
        for r, (v, noise) in enumerate(zip(values.T, refined.shape_covariance, strict=True)):
            covariance = rows @ noise @ rows.T + foretold.roughest(v, noise) * missed @ missed.T
            known = np.linalg.inv(covariance + OF_ITS_OWN * np.diag(np.diag(covariance)))
            # Each as it would be were the others as told.
            std[r] = 1.0 / np.sqrt(np.diag(known))
            away[r] = known @ rows @ v * std[r] ** 2
            against[r] = rows @ v * (known @ rows @ v)
        chance = float(chi2.sf(against.sum(), against.size))
        if chance < UNLIKELY:
            r, k = divmod(int(np.argmax(np.abs(away / std))), len(told))
            rest = ", were the rest as told" if len(told) > 1 else ""
            raise ValueError(
                f"the {name} end is told to hold {' and '.join(DERIVATIVES[d] for d in told)} at zero, and the shapes"
                f" contradict it (p = {max(chance, 1e-99):.1g}): of its largest entry, along the length, mode {r + 1}"
                f" has a {DERIVATIVES[told[k]]} of {away[r, k]:.3g} ± {std[r, k]:.2g} there{rest}; tell the end as it"
                " is, or leave it untold"
            )


def _judge(
    positions: np.ndarray, others: KnownEnds, at: float, told: list[int], length: float
) -> tuple[np.ndarray, np.ndarray, Foretold] | None:
    """What is told at zero by the sensors, (n_told, n_sensors), and what a spline misses of it, (n_told, n_cells), the
    length as unit; and how such splines foretell the sensors. None where sensors are too few."""
    where: dict[str, Any] = {"length": length, "ends": others}
    x = np.array([at])
    for degree in DEGREES:
        try:
            spline = interpolating_spline(positions, degree=degree, **where)
            foretold = Foretold(positions, degree=degree, **where)
        except ValueError:
            continue
        rows = [spline.matrix(x, d) * length**d for d in told]
        missed = [missed_kernel(spline, x, positions, length, d) * length**d for d in told]
        return np.vstack(rows), np.vstack(missed), foretold
    return None
