"""Interpolation error between and beyond the sensors, estimated by leaving one sensor out at a time.

A linear rule S that is exact for polynomials of degree below p has for any function f the error (Peano)

    f(x) - S f(x) = ∫ K(x, u) f^(p)(u) du,     K(x, u) = [(x - u)_+^(p-1) - S (· - u)_+^(p-1)] / (p - 1)!

and p = 4 suits a beam: a point mass or a spring is an impulse in φ''''. Taken as white of strength τ² along the
structure, φ'''' gives S the mean square error τ² ∫ K² du at x, nothing at a sensor and most beyond the last. τ² is the
upper limit of what the errors of splines through the other sensors allow, beside that sensor's and their noise.
"""

from math import factorial

import numpy as np
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import chi2

from workbench.identification.shapes.eigenfunctions import KnownEnds, Spline, interpolating_spline

ORDER, CELLS = 4, 400
# Chance that noise alone is taken for interpolation error, and that τ² is larger than its limit.
UNLIKELY = 0.05


def peano_kernel(
    spline: Spline, x: np.ndarray, positions: np.ndarray, length: float, derivative: int = 0
) -> np.ndarray:
    """K(x, u) √du on a grid of u, (n_points, n_cells): the squares of a row add up to the mean square error for τ² = 1.

    Args:
        spline: through the sensors at `positions`.
        x: (n_points,) m.
        positions: (n_sensors,) m.
        length: m.
        derivative: of K by x.
    """
    order = min(ORDER, spline.degree + 1)
    u = (np.arange(CELLS) + 0.5) * length / CELLS
    held = [_power(np.array([at]), u, order, d)[0] for at, d in spline.conditions]
    along = spline.matrix(x, derivative) @ _power(positions, u, order)
    if held:
        along = along + spline.of_held(x, derivative) @ np.array(held)
    return np.asarray((_power(x, u, order, derivative) - along) * np.sqrt(length / CELLS))


class LeaveOneOut:
    """How splines of one degree through the other sensors predict each sensor."""

    def __init__(self, positions: np.ndarray, *, length: float, ends: KnownEnds, degree: int) -> None:
        n = positions.size
        self.rule, kernels = np.zeros((n, n)), []
        for j in range(n):
            others = np.arange(n) != j
            try:
                spline = interpolating_spline(positions[others], length=length, ends=ends, degree=degree)
            except ValueError as error:
                raise ValueError(f"{n} sensors leave none to judge a spline of degree {degree} by: {error}") from error
            self.rule[j, j] = 1.0
            self.rule[j, others] = -spline.matrix(positions[j])[0]
            kernels.append(peano_kernel(spline, positions[j : j + 1], positions[others], length)[0])
        self.kernel = np.array(kernels)

    def roughness(self, values: np.ndarray, covariance: np.ndarray) -> float:
        """τ² of a shape (n_sensors,) of known covariance, the upper end of its interval; 0 where it may be noise."""
        error, noise, _ = self._errors(values, covariance)
        by_noise = np.diag(noise)
        together = np.sum(noise**2 / np.outer(by_noise, by_noise)) / error.size  # χ² of size / together, stretched
        if (error**2 / by_noise).sum() < together * chi2.isf(UNLIKELY, error.size / together):
            return 0.0
        return self.roughest(values, covariance)

    def roughest(self, values: np.ndarray, covariance: np.ndarray) -> float:
        """The upper end of the interval of τ², noise or not."""
        error, noise, by_rough = self._errors(values, covariance)
        by_noise = np.diag(noise)

        def unlikely(log_strength: float) -> float:
            power = by_noise + np.exp(log_strength) * by_rough
            return float((np.log(power) + error**2 / power).sum())

        highest = np.log((np.maximum(error**2, by_noise) / by_rough).max())
        best = minimize_scalar(unlikely, bounds=(highest - 20.0, highest), method="bounded")
        limit = best.fun + chi2.isf(2.0 * UNLIKELY, 1)
        return float(np.exp(brentq(lambda strength: unlikely(strength) - limit, best.x, highest + 20.0)))

    def _errors(self, values: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The prediction error of each sensor, the covariance of its noise, and its mean square for τ² = 1."""
        error = self.rule @ values
        noise = self.rule @ covariance @ self.rule.T + 1e-30 * (values**2).max() * np.eye(values.size)
        by_rough = (self.kernel**2).sum(axis=1)
        tested = by_rough > 1e-12 * by_rough.max()  # a fixed end predicts the sensor on it
        return error[tested], noise[np.ix_(tested, tested)], by_rough[tested]


def _power(x: np.ndarray, u: np.ndarray, order: int, derivative: int = 0) -> np.ndarray:
    """(x - u)_+^k / k! with k = order - 1 - derivative, (n_points, n_cells)."""
    k, apart = order - 1 - derivative, x[:, None] - u
    return np.where(apart > 0, np.abs(apart) ** k / factorial(k), 0.0)
