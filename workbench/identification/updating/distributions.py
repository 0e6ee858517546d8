"""Mass and stiffness along the structure, from modes alone and the mass at a point (Ch. 4).

Modes are orthogonal with respect to the mass and to the stiffness, whatever their scale:

    ∫ m φ_r φ_s dx = a_r² δ_rs,   ∫ k φ_r^(p) φ_s^(p) dx = a_r² ω_r² δ_rs   (4.6), p = 1 for a bar, 2 for a beam.

With m = m_0 + Σ d_j M_j and k = k_0 + Σ e_j K_j these are linear in d, e and a_r². Each a_r² stands in one mass
relation only, the one with s = r, so these define a_r² and leave the relations r ≠ s to find d. They say nothing of
the overall size: the mass must be known somewhere, and is held there exactly. All relations then serve to find e.

The relations of the stiffness rest on integration by parts: no force or moment may do work at an end.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.interpolate import BSpline
from scipy.linalg import null_space

from workbench.structure.domain import gauss_between
from workbench.structure.modes import Modes, frozen
from workbench.structure.profile import Profile, ProfileLike, as_profile
from workbench.threads import one_blas_thread

KNOWN_TOLERANCE = 1e-8


@dataclass(frozen=True, eq=False)
class Basis:
    """Known functions of x whose sum, with coefficients to be found, is a distribution.

    Attributes:
        functions: x (n_points,) -> (n_points, n_terms).
        n_terms: how many.
        breaks: places where they are not smooth, m.
    """

    functions: Callable[[np.ndarray], np.ndarray] = field(repr=False)
    n_terms: int
    breaks: tuple[float, ...] = ()

    @classmethod
    def polynomial(cls, n_terms: int) -> "Basis":
        """1, x, x², ... (4.32)."""
        return cls(lambda x: np.vander(np.asarray(x, float), n_terms, increasing=True), n_terms)

    @classmethod
    def legendre(cls, n_terms: int, *, length: float) -> "Basis":
        """Legendre polynomials of 2x / length - 1: the same sums as 1, x, x², ..., kept apart by round-off at any
        number of terms."""
        return cls(lambda x: legvander(2.0 * np.asarray(x, float) / length - 1.0, n_terms)[:, :n_terms], n_terms)

    @classmethod
    def splines(cls, n_terms: int, *, length: float, degree: int = 2) -> "Basis":
        """B-splines on equal intervals: local functions, each zero over most of the structure.

        Raises:
            ValueError: fewer terms than degree + 1.
        """
        if n_terms < degree + 1:
            raise ValueError(f"B-splines of degree {degree} are at least {degree + 1}; asked for {n_terms}")
        nodes = np.linspace(0.0, length, n_terms - degree + 1)
        knots = np.r_[[0.0] * degree, nodes, [length] * degree]
        return cls(lambda x: BSpline(knots, np.eye(n_terms), degree)(np.clip(x, 0.0, length)), n_terms, tuple(nodes))


@dataclass(frozen=True, eq=False)
class Distribution:
    """An identified mass or stiffness: a prior estimate (zero if none) plus a series.

    Attributes:
        coefficients: (n_terms,) d_j or e_j.
        basis: the functions they multiply.
        prior: m_0 or k_0.
        misfit: root mean square of the relations left over, relative to the terms in them; 0 for a perfect fit.
    """

    coefficients: np.ndarray
    basis: Basis
    prior: Profile
    misfit: float

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Values at x, in the shape of x."""
        x = np.asarray(x, float)
        series = self.basis.functions(np.atleast_1d(x)) @ self.coefficients
        return np.asarray(self.prior(x) + series.reshape(x.shape))

    @property
    def profile(self) -> Profile:
        """The same as a `Profile`, to build a structure with."""
        return Profile(self.__call__, tuple(sorted({*self.basis.breaks, *self.prior.breaks})))


@dataclass(frozen=True, eq=False)
class Distributions:
    """The mass and stiffness of one structure, and the scale of its modes found with them.

    Attributes:
        mass: kg/m.
        stiffness: EA in N, or EI in N m².
        scales: (n_modes,) a_r = (∫ m φ_r² dx)^½; φ_r / a_r is mass-normalised.
    """

    mass: Distribution
    stiffness: Distribution
    scales: np.ndarray


@one_blas_thread
def mass_and_stiffness(
    modes: Modes,
    *,
    kind: str,
    mass_basis: Basis,
    stiffness_basis: Basis,
    known_mass: Sequence[tuple[float, float]],
    prior_mass: ProfileLike = 0.0,
    prior_stiffness: ProfileLike = 0.0,
) -> Distributions:
    """Series for mass and stiffness from the orthogonality of modes of any scale (4.3-4.24).

    Args:
        modes: identified or computed; frequencies and shapes are used.
        kind: "bar" or "beam".
        mass_basis, stiffness_basis: functions of the series.
        known_mass: ((x, kg/m), ...), at least one place; held exactly.
        prior_mass, prior_stiffness: first estimates, kg/m and N (N m²); the series then corrects them.

    Raises:
        ValueError: no known mass, more terms than relations, known values that the series cannot take.
    """
    if kind not in ("bar", "beam"):
        raise ValueError(f"mass and stiffness are those of a bar or a beam; got {kind!r}")
    prior_mass, prior_stiffness = as_profile(prior_mass), as_profile(prior_stiffness)
    unit, scale = _unit_mean_square(modes)
    mass = _mass(unit, mass_basis, prior_mass, known_mass)
    shapes, weights, x = _sampled(unit, 0, mass.profile.breaks)
    a_squared = (weights * mass(x)) @ shapes**2
    if (a_squared <= 0).any():
        raise ValueError(
            "the identified mass is negative over so much of the structure that a mode has no positive scale; use"
            " fewer terms, more sensors, or a prior estimate"
        )
    order = 1 if kind == "bar" else 2
    stiffness = _stiffness(unit, order, a_squared, stiffness_basis, prior_stiffness)
    return Distributions(mass, stiffness, frozen(np.sqrt(a_squared) / scale))


def _mass(modes: Modes, basis: Basis, prior: Profile, known: Sequence[tuple[float, float]]) -> Distribution:
    if len(known) == 0:
        raise ValueError("orthogonality determines the mass only up to a factor; give the mass at one point or more")
    shapes, weights, x = _sampled(modes, 0, (*basis.breaks, *prior.breaks))
    places, values = np.array(known, float).T
    coefficients, misfit = mass_series(
        shapes, weights, basis.functions(x), prior(x), basis.functions(places), values - prior(places)
    )
    return Distribution(frozen(coefficients), basis, prior, misfit)


def _stiffness(modes: Modes, order: int, a_squared: np.ndarray, basis: Basis, prior: Profile) -> Distribution:
    strain, weights, x = _sampled(modes, order, (*basis.breaks, *prior.breaks))
    strains = [(1.0, strain)]
    coefficients, misfit = stiffness_series(strains, weights, basis.functions(x), prior(x), a_squared, modes.omega)
    return Distribution(frozen(coefficients), basis, prior, misfit)


def mass_series(
    shapes: np.ndarray,
    weights: np.ndarray,
    functions: np.ndarray,
    prior: np.ndarray,
    rows: np.ndarray,
    known: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Coefficients (n_terms,) of the mass from the relations r ≠ s of (4.6), and their misfit.

    Args:
        shapes: (n_points, n_modes) at points of integration, of one size.
        weights: (n_points,) of these.
        functions, prior: (n_points, n_terms) and (n_points,) there.
        rows, known: (n_known, n_terms) functions where the mass is known, and what it is beyond the prior.
    """
    if functions.shape[1] > (most := shapes.shape[1] * (shapes.shape[1] - 1) // 2 + known.size):
        raise ValueError(_too_many(functions.shape[1], "mass", most, shapes.shape[1]))
    r, s = np.triu_indices(shapes.shape[1], 1)
    products = weights[:, None] * shapes[:, r] * shapes[:, s]
    u, u0 = products.T @ functions, products.T @ prior  # U_rsj of (4.8), U_rs0 of (4.23)
    coefficients = _constrained(u, -u0, rows, known)
    return coefficients, _misfit(u @ coefficients + u0, u, coefficients, u0)


def stiffness_series(
    strains: Sequence[tuple[np.ndarray | float, np.ndarray]],
    weights: np.ndarray,
    functions: np.ndarray,
    prior: np.ndarray,
    a_squared: np.ndarray,
    omega: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Coefficients (n_terms,) of the stiffness from all relations of (4.6), and their misfit.

    Args:
        strains: (factor, (n_points, n_modes)): the density of the strain energy of unit stiffness is the sum of factor
            times squares.
        weights, functions, prior: as `mass_series` takes them.
        a_squared, omega: (n_modes,) scales and frequencies.
    """
    if functions.shape[1] > (most := omega.size * (omega.size + 1) // 2):
        raise ValueError(_too_many(functions.shape[1], "stiffness", most, omega.size))
    r, s = np.triu_indices(omega.size)
    products = sum((weights * factor)[:, None] * strain[:, r] * strain[:, s] for factor, strain in strains)
    v, v0 = np.asarray(products).T @ functions, np.asarray(products).T @ prior
    targets = np.where(r == s, a_squared[r] * omega[r] ** 2, 0.0)
    # A relation between high modes is larger by ω_r ω_s, and so is its error; divided by it they weigh alike.
    weight = 1.0 / np.maximum(omega[r] * omega[s], 1e-12 * omega.max() ** 2)
    coefficients = np.linalg.lstsq(weight[:, None] * v, weight * (targets - v0), rcond=None)[0]
    left = weight * (v @ coefficients + v0 - targets)
    return coefficients, _misfit(left, weight[:, None] * v, coefficients, weight * v0)


def _too_many(n_terms: int, what: str, most: int, n_modes: int) -> str:
    return (
        f"{n_terms} terms of {what} cannot be found from {most} relations of {n_modes} modes; use more modes or fewer"
        " terms"
    )


def _unit_mean_square(modes: Modes) -> tuple[Modes, np.ndarray]:
    """The same modes with shapes of mean square 1, so that all relations weigh alike, and the factors applied."""
    x = (np.arange(2000) + 0.5) / 2000 * modes.length
    scale = 1.0 / np.sqrt((modes.phi(x) ** 2).mean(axis=0))
    return replace(modes, shapes=lambda x, derivative: modes.shapes(x, derivative) * scale), scale


def _sampled(modes: Modes, derivative: int, breaks: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shapes (n_points, n_modes), weights and places of a Gauss rule that no break interrupts."""
    n_pieces = 16 * (1 + modes.n_modes // 4)
    nodes = np.unique(np.r_[np.linspace(0.0, modes.length, n_pieces + 1), [b for b in breaks if 0 < b < modes.length]])
    x, weights = gauss_between(nodes, 12)
    return modes.phi(x, derivative), weights, x


def held_exactly(rows: np.ndarray, values: np.ndarray, what: str, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients c with rows @ c = values, and the directions (n_terms, n_free) that keep it.

    Args:
        what: the values are, in words.
        size: of them, that their errors are judged by.

    Raises:
        ValueError: values that no coefficients give.
    """
    particular = np.linalg.lstsq(rows, values, rcond=None)[0]
    left = np.abs(rows @ particular - values).max()
    if left > KNOWN_TOLERANCE * size:
        raise ValueError(
            f"the series with {rows.shape[1]} terms cannot take the {rows.shape[0]} known {what} (off by {left:.3g});"
            " use more terms or fewer known places"
        )
    return particular, null_space(rows)


def _constrained(matrix: np.ndarray, target: np.ndarray, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Least squares of matrix @ c = target with rows @ c = values held exactly."""
    particular, free = held_exactly(rows, values, "masses", max(np.abs(values).max(), 1e-300))
    if free.shape[1] == 0:
        return np.asarray(particular)
    return np.asarray(particular + free @ np.linalg.lstsq(matrix @ free, target - matrix @ particular, rcond=None)[0])


def _misfit(left: np.ndarray, matrix: np.ndarray, coefficients: np.ndarray, offset: np.ndarray) -> float:
    terms = np.sqrt(np.mean((np.abs(matrix) @ np.abs(coefficients) + np.abs(offset)) ** 2)) if left.size else 0.0
    return float(np.sqrt(np.mean(left**2)) / terms) if terms else 0.0
