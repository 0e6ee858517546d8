"""Confidence bands of eigenfunctions: the sensors' noise carried along the structure, and the interpolation error.

With values v at the sensors, a spline W(x) v and the scale q = v^T M v, M = ∫ m W^T W dx, the eigenfunction is
φ(x) = W(x) v / √q, and an error dv of the values and the interpolation error e(x) move it by

    dφ(x) = J(x) dv + e(x) / √q - φ(x) ∫ m W v e dx / q,     J(x) = W(x) / √q - φ(x) (M v)^T / q

so that its covariance along the structure is J C J^T plus that of e, from `interpolation_error`. A band that holds the
whole
curve, not each point by itself, is wider: its width is the quantile of the largest |dφ(x)| / std(x) along the
structure, drawn from that covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from warnings import warn

import numpy as np
from scipy.special import ndtri

from workbench.identification.free_decay.refined import Refined
from workbench.identification.shapes.boundary_check import check_ends
from workbench.identification.shapes.eigenfunctions import KnownEnds, Splines, inertia_of, mass_matrix
from workbench.identification.shapes.interpolation_error import LeaveOneOut, peano_kernel
from workbench.identification.signal.modal_estimates import normalised_shapes
from workbench.structure.modes import frozen
from workbench.structure.profile import ProfileLike
from workbench.structure.supports import PointMass
from workbench.threads import one_blas_thread

DRAWS = 4000
# Of the largest standard error; below it an end holds the curve and there is nothing to be unsure of.
HELD = 1e-6


@dataclass(frozen=True, eq=False)
class Bands:
    """Eigenfunctions along a structure, with their uncertainty by noise and by too few sensors.

    Attributes:
        x: (n_points,) places, m.
        phi: (n_points, n_modes) eigenfunctions, scaled as `eigenfunctions` does.
        std: (n_points, n_modes) standard error at each place.
        interpolation_std: (n_points, n_modes) the part of it by interpolation error; 0 where the sensors predict each
            other to within their noise. Where it is most of `std`, more sensors help and longer records do not.
        width: (n_modes,) standard errors either side that hold the whole curve with probability `level`.
        level: of both bands.
    """

    x: np.ndarray
    phi: np.ndarray
    std: np.ndarray
    interpolation_std: np.ndarray
    width: np.ndarray
    level: float

    @property
    def missed(self) -> np.ndarray:
        """Former name of `interpolation_std`."""
        warn("Bands.missed is now Bands.interpolation_std", DeprecationWarning, 2)
        return self.interpolation_std

    @property
    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper edge of the band that holds each whole curve, (n_points, n_modes) each."""
        return self.phi - self.width * self.std, self.phi + self.width * self.std

    @property
    def pointwise(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper edge of the interval at each place by itself, (n_points, n_modes) each."""
        width = float(ndtri(0.5 * (1.0 + self.level)))
        return self.phi - width * self.std, self.phi + width * self.std


@one_blas_thread
def eigenfunction_bands(
    refined: Refined,
    x: Sequence[float] | np.ndarray,
    *,
    length: float,
    mass_per_length: ProfileLike | None = None,
    point_masses: Sequence[PointMass] = (),
    ends: KnownEnds | None = None,
    degree: int | None = None,
    level: float = 0.95,
    seed: int | np.random.Generator = 0,
) -> Bands:
    """Confidence bands of the eigenfunctions that `eigenfunctions` draws through refined shapes.

    They hold what noise does to real shapes, and the interpolation error between and beyond the sensors as far as the
    sensors fail to predict each other. Bands too wide for use, about a point mass or towards an end on springs, narrow
    with more sensors there; the eigenfunctions of `choose_structure(...).structure` know what is attached.

    Args:
        refined: from `refine` or `identify(...).refined`, at placed sensors.
        x: (n_points,) m.
        length, mass_per_length, point_masses, ends, degree: as `eigenfunctions` takes them.
        level: between 0 and 1.
        seed: of the draws that set the width of the band of the whole curve.

    Raises:
        ValueError: a level outside 0..1, places outside the structure, no more sensors than the degree takes, an end
            that the shapes contradict; as `eigenfunctions`.
    """
    x = np.atleast_1d(np.asarray(x, float))
    if not 0.0 < level < 1.0:
        raise ValueError(f"the level of a confidence band lies between 0 and 1; got {level}")
    slack = 1e-9 * length
    if not ((x >= -slack) & (x <= length + slack)).all():
        outside = x[~((x >= -slack) & (x <= length + slack))][0]
        raise ValueError(f"x = {outside:g} lies outside the structure, 0 to {length:g}")
    if ends is not None:
        check_ends(refined, ends, length=length)
    modes, rng = refined.modes, np.random.default_rng(seed)
    where: dict[str, Any] = {"length": length, "ends": ends or KnownEnds()}
    splines = Splines.through(modes, degree=degree, **where)
    inertia = inertia_of(mass_per_length, point_masses, length)
    values = normalised_shapes(modes.shapes).real
    phi, std, interpolation = (np.zeros((x.size, modes.n_modes)) for _ in range(3))
    width = np.zeros(modes.n_modes)
    for spline, those in splines.groups:
        leave_one_out = LeaveOneOut(modes.positions, degree=spline.degree, **where)
        along, mass = spline.matrix(x), mass_matrix(spline, inertia, length)
        for r in those:
            v = values[:, r]
            q = v @ mass @ v
            phi[:, r] = along @ v / np.sqrt(q)
            jacobian = along / np.sqrt(q) - np.outer(phi[:, r], mass @ v / q)
            strengths, directions = np.linalg.eigh(refined.shape_covariance[r])
            root = jacobian @ (directions * np.sqrt(np.maximum(strengths, 0.0)))
            roughness = leave_one_out.roughness(v, refined.shape_covariance[r])
            if roughness > 0.0:
                error = peano_kernel(spline, x, modes.positions, length) / np.sqrt(q)
                for y, weights, derivative in inertia.weighted(spline, length):
                    there = peano_kernel(spline, y, modes.positions, length, derivative)
                    error -= np.outer(phi[:, r], (weights * (spline.matrix(y, derivative) @ v)) @ there / q)
                error *= np.sqrt(roughness)
                interpolation[:, r] = np.linalg.norm(error, axis=1)
                root = np.hstack([root, error])
            std[:, r] = np.linalg.norm(root, axis=1)
            unsure = std[:, r] > HELD * std[:, r].max()
            if unsure.any():
                drawn = (root[unsure] / std[unsure, r, None]) @ rng.standard_normal((root.shape[1], DRAWS))
                width[r] = np.quantile(np.abs(drawn).max(axis=0), level)
    return Bands(frozen(x), frozen(phi), frozen(std), frozen(interpolation), frozen(width), level)
