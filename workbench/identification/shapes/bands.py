"""Confidence bands of eigenfunctions, from noise and interpolation error; the boundary condition check.

With values v at the sensors, a spline W(x) v and the scale q = v^T M v, M = ∫ m W^T W dx, the eigenfunction is
φ(x) = W(x) v / √q. To first order, an error dv of the values and the interpolation error e(x) change it by

    dφ(x) = J(x) dv + e(x) / √q - φ(x) ∫ m W v e dx / q,     J(x) = W(x) / √q - φ(x) (M v)^T / q

so its covariance along the structure is J C J^T, C that of the values, plus that of the terms in e. A simultaneous
band, which contains the whole curve, is wider than a pointwise one: its width is the quantile of the maximum of
|dφ(x)| / std(x) along the structure, by Monte Carlo from that covariance.

Interpolation error. A linear rule S that is exact for polynomials of degree below p has for any function f the error
(Peano)

    f(x) - S f(x) = ∫ K(x, u) f^(p)(u) du,     K(x, u) = [(x - u)_+^(p-1) - S (· - u)_+^(p-1)] / (p - 1)!

and p = 4 suits a beam: a point mass or a spring is an impulse in φ''''. With φ'''' white of strength τ² along the
structure, S has the mean square error τ² ∫ K² du at x, which is zero at a sensor and largest beyond the last. τ² is the
upper confidence limit from the leave-one-out errors of splines through the other sensors, given the sensors' noise.

Boundary condition check. Splines that do not assume the boundary condition extrapolate the derivatives t that the
condition sets to zero. Their covariance is that of the sensors' noise and of the interpolation error, τ² at its upper
limit. Over all modes and all conditions of one end, Σ t^T Cov^-1 t is chi-square where the condition holds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np
from scipy.optimize import brentq, minimize_scalar
from scipy.special import ndtri
from scipy.stats import chi2

from workbench.arrays import symmetric_root
from workbench.identification.shapes.eigenfunctions import (
    BoundaryConditions,
    Spline,
    Splines,
    check_along,
    interpolating_spline,
    mass_quadrature,
)
from workbench.identification.signal.modal_estimates import ShapeEstimates, check_level, normalised_shapes
from workbench.renamed import Renamed
from workbench.structure.modes import frozen
from workbench.structure.printed import Printed, counted
from workbench.structure.profile import ProfileLike
from workbench.structure.supports import PointMass
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class BandsSettings:
    """Constants of bands and of the boundary condition check."""

    draws: int = 4000  # Monte Carlo samples of the largest error: its 0.95 quantile to a hundredth
    min_error_ratio: float = 1e-6  # to the largest standard error: below it a boundary condition fixes the curve
    derivative_order: int = 4  # p, of the derivative taken as white
    kernel_cells: int = 400  # of the structure, on which Peano's kernel is evaluated
    # that noise alone is taken for interpolation error, and that τ² exceeds its upper limit
    error_probability: float = 0.05
    # of the check, in this order: the higher degree extrapolates further from fewer sensors, and has larger errors
    # where a mode is short for its sensors
    spline_degrees: tuple[int, ...] = (5, 3)
    # of the variance of each derivative, added independently: the accuracy of their ratio in the kernel's model
    independent_share: float = 0.01
    refusal_probability: float = 1e-4  # of a correct boundary condition


BANDS = BandsSettings()
DERIVATIVES = ("value", "slope", "curvature", "change of curvature")


def peano_kernel(
    spline: Spline, x: np.ndarray, positions: np.ndarray, length: float, derivative: int = 0
) -> np.ndarray:
    """K(x, u) √du, or a derivative by x, on a grid of u, (n_points, n_cells), of a spline through the sensors.

    The sum of squares of a row is the mean square error for τ² = 1. `x` (n_points,), `positions` (n_sensors,), m.
    """
    order = min(BANDS.derivative_order, spline.degree + 1)
    u = (np.arange(BANDS.kernel_cells) + 0.5) * length / BANDS.kernel_cells
    interpolated = spline.matrix(x, derivative) @ _power(positions, u, order)
    if spline.conditions:
        of_conditions = np.array([_power(np.array([at]), u, order, d)[0] for at, d in spline.conditions])
        interpolated = interpolated + spline.of_held(x, derivative) @ of_conditions
    return np.asarray((_power(x, u, order, derivative) - interpolated) * np.sqrt(length / BANDS.kernel_cells))


class LeaveOneOut:
    """Leave-one-out prediction of each sensor by splines of one degree through the other sensors."""

    def __init__(self, positions: np.ndarray, *, length: float, ends: BoundaryConditions, degree: int) -> None:
        n = positions.size
        self.rule, kernels = np.zeros((n, n)), []
        for j in range(n):
            others = np.arange(n) != j
            try:
                spline = interpolating_spline(positions[others], length=length, ends=ends, degree=degree)
            except ValueError as error:
                few = f"{n} sensors are too few to cross-validate a spline of degree {degree}"
                raise ValueError(f"{few}: {error}") from error
            self.rule[j, j] = 1.0
            self.rule[j, others] = -spline.matrix(positions[j])[0]
            kernels.append(peano_kernel(spline, positions[j : j + 1], positions[others], length)[0])
        self.kernel = np.array(kernels)

    def roughness(self, values: np.ndarray, covariance: np.ndarray) -> float:
        """Upper confidence limit of τ² of a shape (n_sensors,) of known covariance; 0 where its errors may be noise."""
        error, noise, _ = self._errors(values, covariance)
        noise_variance = np.diag(noise)
        # scaled χ² of error.size / scale degrees of freedom (Satterthwaite)
        scale = np.sum(noise**2 / np.outer(noise_variance, noise_variance)) / error.size
        if (error**2 / noise_variance).sum() < scale * chi2.isf(BANDS.error_probability, error.size / scale):
            return 0.0
        return self.roughest(values, covariance)

    def roughest(self, values: np.ndarray, covariance: np.ndarray) -> float:
        """Upper confidence limit of τ², without the test for noise."""
        error, noise, unit_variance = self._errors(values, covariance)
        noise_variance = np.diag(noise)

        def cost(log_strength: float) -> float:
            power = noise_variance + np.exp(log_strength) * unit_variance
            return float((np.log(power) + error**2 / power).sum())

        log_upper = np.log((np.maximum(error**2, noise_variance) / unit_variance).max())
        best = minimize_scalar(cost, bounds=(log_upper - 20.0, log_upper), method="bounded")
        limit = best.fun + chi2.isf(2.0 * BANDS.error_probability, 1)
        return float(np.exp(brentq(lambda log_strength: cost(log_strength) - limit, best.x, log_upper + 20.0)))

    def _errors(self, values: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Prediction error of each sensor, covariance of its noise, and its mean square for τ² = 1."""
        error = self.rule @ values
        noise = self.rule @ covariance @ self.rule.T + 1e-30 * (values**2).max() * np.eye(values.size)
        unit_variance = (self.kernel**2).sum(axis=1)
        tested = unit_variance > 1e-12 * unit_variance.max()  # the value at a fixed end is known without error
        return error[tested], noise[np.ix_(tested, tested)], unit_variance[tested]


def _power(x: np.ndarray, u: np.ndarray, order: int, derivative: int = 0) -> np.ndarray:
    """(x - u)_+^k / k! with k = order - 1 - derivative, (n_points, n_cells)."""
    k, distance = order - 1 - derivative, x[:, None] - u
    return np.where(distance > 0, np.abs(distance) ** k / factorial(k), 0.0)


def check_ends(found: ShapeEstimates, ends: BoundaryConditions, *, length: float) -> None:
    """Refuse, by a ValueError, ends that the shapes contradict; with fewer than about five sensors none is refused."""
    check_along(found.modes)
    values, positions = normalised_shapes(found.modes.shapes).real, found.modes.positions
    for name, end_x in (("left", 0.0), ("right", length)):
        conditions = [d for x, d in ends.zeros if abs(x - end_x) <= 1e-9 * length]
        others = BoundaryConditions(tuple(zero for zero in ends.zeros if abs(zero[0] - end_x) > 1e-9 * length))
        extrapolated = _extrapolated(positions, others, end_x, conditions, length) if conditions else None
        if extrapolated is None:
            continue
        rows, error, leave_one_out = extrapolated
        value, std, statistic = np.zeros((3, values.shape[1], len(conditions)))
        for r, (v, noise) in enumerate(zip(values.T, found.shape_covariance, strict=True)):
            covariance = rows @ noise @ rows.T + leave_one_out.roughest(v, noise) * error @ error.T
            precision = np.linalg.inv(covariance + BANDS.independent_share * np.diag(np.diag(covariance)))
            # Estimate and standard error of each derivative, given that the others are zero.
            std[r] = 1.0 / np.sqrt(np.diag(precision))
            value[r] = precision @ rows @ v * std[r] ** 2
            statistic[r] = rows @ v * (precision @ rows @ v)
        chance = float(chi2.sf(statistic.sum(), statistic.size))
        if chance < BANDS.refusal_probability:
            r, k = divmod(int(np.argmax(np.abs(value / std))), len(conditions))
            rest = ", given the rest" if len(conditions) > 1 else ""
            zero = " and ".join(DERIVATIVES[d] for d in conditions)
            raise ValueError(
                f"the {name} end is stated to have zero {zero}, and the shapes contradict it"
                f" (p = {max(chance, 1e-99):.1g}): relative to its largest entry and the length, mode {r + 1} has a"
                f" {DERIVATIVES[conditions[k]]} of {value[r, k]:.3g} ± {std[r, k]:.2g} there{rest}; correct the end, or"
                " leave it out"
            )


def _extrapolated(
    positions: np.ndarray, others: BoundaryConditions, at: float, conditions: list[int], length: float
) -> tuple[np.ndarray, np.ndarray, LeaveOneOut] | None:
    """Linear rules by which the sensors extrapolate derivatives to an end, (n_conditions, n_sensors); unit the length.

    With their interpolation error (n_conditions, n_cells), and the leave-one-out prediction of the same splines. None
    where the sensors are too few.
    """
    options: dict[str, Any] = {"length": length, "ends": others}
    x = np.array([at])
    for degree in BANDS.spline_degrees:
        try:
            spline = interpolating_spline(positions, degree=degree, **options)
            leave_one_out = LeaveOneOut(positions, degree=degree, **options)
        except ValueError:
            continue
        rows = [spline.matrix(x, d) * length**d for d in conditions]
        kernel = [peano_kernel(spline, x, positions, length, d) * length**d for d in conditions]
        return np.vstack(rows), np.vstack(kernel), leave_one_out
    return None


@dataclass(frozen=True, eq=False, repr=False)
class Bands(Printed):
    """Eigenfunctions along a structure or over a plate, with confidence bands for noise and interpolation error.

    Attributes:
        x: (n_points,) or (n_points, 2) places, m.
        phi: (n_points, n_modes) eigenfunctions, scaled as `eigenfunctions` does.
        std: (n_points, n_modes) standard error at each place.
        interpolation_std: (n_points, n_modes) the part of `std` by interpolation error; 0 where the sensors predict
            each other to within their noise. Where it is most of `std`, more sensors help and longer records do not.
        width: (n_modes,) half width, in standard errors, of the band that contains the whole curve with probability
            `level`.
        level: of both bands.
    """

    x: np.ndarray
    phi: np.ndarray
    std: np.ndarray
    interpolation_std: np.ndarray
    width: np.ndarray
    level: float

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        largest = np.abs(self.phi).max(axis=0)
        shares = self.std.max(axis=0) / largest, self.interpolation_std.max(axis=0) / largest
        each = enumerate(zip(*shares, self.width))
        rows = [(str(r + 1), f"{100 * std:.2g}", f"{100 * part:.2g}", f"{width:.2f}") for r, (std, part, width) in each]
        headings = (
            "mode",
            "standard error [% of largest]",
            "interpolation part [% of largest]",
            "half width [standard errors]",
        )
        line = f"bands of {counted(len(rows), 'eigenfunction')} at {counted(len(self.x), 'place')}, {self.level:.0%}"
        return line, headings, rows, ()

    missed = Renamed("interpolation_std")

    @property
    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limit of the simultaneous band, which contains each whole curve, (n_points, n_modes) each."""
        return self.phi - self.width * self.std, self.phi + self.width * self.std

    @property
    def pointwise(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limit of the pointwise interval at each place, (n_points, n_modes) each."""
        width = float(ndtri(0.5 * (1.0 + self.level)))
        return self.phi - width * self.std, self.phi + width * self.std


def deviation_and_width(root: np.ndarray, level: float, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Standard errors (n_points,) of a curve of error covariance R Rᵀ, by R, and the width of its simultaneous band."""
    std = np.linalg.norm(root, axis=1)
    uncertain = std > BANDS.min_error_ratio * std.max()
    if not uncertain.any():
        return std, 0.0
    samples = (root[uncertain] / std[uncertain, None]) @ rng.standard_normal((root.shape[1], BANDS.draws))
    return std, float(np.quantile(np.abs(samples).max(axis=0), level))


def propagated(
    values: np.ndarray, at: tuple[np.ndarray, ...], inside: tuple[np.ndarray, ...], weights: np.ndarray
) -> tuple[np.ndarray, ...]:
    """A mass-normalised curve φ = W v (n_points,), and its changes W - φ ∫ m φ W dx by errors of any kind.

    `at` is W (n_points, n_sensors), and errors of the curve (n_points, n_errors), which change it alike; `inside` the
    same at (n_places,) inside, each of the mass `weights`. There is a change for each of `at`.
    """
    phi = at[0] @ values
    load = weights * (inside[0] @ values)
    return phi, *(here - np.outer(phi, load @ there) for here, there in zip(at, inside, strict=True))


@one_blas_thread
def eigenfunction_bands(
    found: ShapeEstimates,
    x: Sequence[float] | np.ndarray,
    *,
    length: float,
    mass_per_length: ProfileLike | None = None,
    point_masses: Sequence[PointMass] = (),
    ends: BoundaryConditions | None = None,
    degree: int | None = None,
    level: float = 0.95,
    seed: int | np.random.Generator = 0,
) -> Bands:
    """Confidence bands of the eigenfunctions that `eigenfunctions` draws through refined shapes.

    They account for the noise of real shapes, and for the interpolation error between and beyond the sensors that
    cross-validation of the sensors shows. Where bands are too wide, near a point mass or towards an end on springs, use
    more sensors there, or the eigenfunctions of `choose_structure(...).structure`, which model what is attached.

    Args:
        found: modes and the covariance of their shapes, such as `ring_down` gives, at placed sensors.
        x: (n_points,) m.
        length, mass_per_length, point_masses, ends, degree: as `eigenfunctions` takes them.
        level: between 0 and 1.
        seed: of the Monte Carlo samples for the simultaneous band.

    Raises:
        ValueError: a level outside 0..1, places outside the structure, no more sensors than the degree takes, an end
            that the shapes contradict; as `eigenfunctions`.
    """
    x = np.atleast_1d(np.asarray(x, float))
    check_level(level)
    slack = 1e-9 * length
    outside = ~((x >= -slack) & (x <= length + slack))
    if outside.any():
        raise ValueError(f"x = {x[outside][0]:g} lies outside the structure, 0 to {length:g}")
    if ends is not None:
        check_ends(found, ends, length=length)
    modes, rng = found.modes, np.random.default_rng(seed)
    options: dict[str, Any] = {"length": length, "ends": ends or BoundaryConditions()}
    splines = Splines.through(modes, degree=degree, **options)
    values = normalised_shapes(modes.shapes).real
    phi, std, interpolation = (np.zeros((x.size, modes.n_modes)) for _ in range(3))
    width = np.zeros(modes.n_modes)
    for spline, members in splines.groups:
        leave_one_out = LeaveOneOut(modes.positions, degree=spline.degree, **options)
        weights, rule, places = mass_quadrature(spline, length, mass_per_length, point_masses)
        kernels = [peano_kernel(spline, y, modes.positions, length, derivative) for y, derivative in places]
        at = spline.matrix(x), peano_kernel(spline, x, modes.positions, length)
        inside = rule, np.vstack(kernels)
        for r in members:
            v = values[:, r]
            scale = 1.0 / np.sqrt(weights @ (rule @ v) ** 2)
            phi[:, r], jacobian, error = propagated(v * scale, at, inside, weights)
            root = scale * jacobian @ symmetric_root(found.shape_covariance[r])
            roughness = leave_one_out.roughness(v, found.shape_covariance[r])
            if roughness > 0.0:
                error *= scale * np.sqrt(roughness)
                interpolation[:, r] = np.linalg.norm(error, axis=1)
                root = np.hstack([root, error])
            std[:, r], width[r] = deviation_and_width(root, level, rng)
    return Bands(frozen(x), frozen(phi), frozen(std), frozen(interpolation), frozen(width), level)
