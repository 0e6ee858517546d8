"""Mass and stiffness along the structure, from modes alone and the mass at a point (Ch. 4).

Modes are orthogonal with respect to the mass and to the stiffness, whatever their scale:

    ∫ m φ_r φ_s dx = a_r² δ_rs,   ∫ k φ_r^(p) φ_s^(p) dx = a_r² ω_r² δ_rs   (4.6), p = 1 for a bar, 2 for a beam.

With m = m_0 + Σ d_j M_j and k = k_0 + Σ e_j K_j these relations are linear in d, e and a_r². Each a_r² is in one mass
relation only, that with s = r, which defines it; the relations r ≠ s determine d up to a common factor. So the mass
must be known at a point, and is held there exactly. All stiffness relations then determine e.

The stiffness relations follow by integration by parts: no force or moment may do work at an end.

The jackknife gives the standard errors (Efron & Stein, Ann. Statist. 9, 1981): from the scatter of the distributions
with one mode left out at a time. It shows both the noise in second derivatives of shapes and modes that are
inconsistent, as those of a structure with masses or springs that the relations do not contain.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.interpolate import BSpline
from scipy.linalg import null_space

from workbench.identification.signal.modal_estimates import rounded
from workbench.structure.domain import gauss_between
from workbench.structure.modes import Modes, frozen
from workbench.structure.printed import Printed, counted, warns_of_remarks
from workbench.structure.profile import Profile, ProfileLike, as_profile
from workbench.threads import one_blas_thread

KNOWN_TOLERANCE = 1e-8
# Largest mean standard error over mean value of a reliable distribution, and largest orthogonality error of modes
# (Ewins, Modal Testing)
RELIABLE = 0.1
PRINTED = 11  # number of places at which distributions are printed


@dataclass(frozen=True, eq=False)
class Basis:
    """Functions of x whose linear combination is a distribution.

    Attributes:
        functions: x (n_points,) -> (n_points, n_terms).
        n_terms: number of functions.
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
        """Legendre polynomials of 2x / length - 1: the span of 1, x, x², ..., well conditioned for any n_terms."""
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
        misfit: rms residual of the relations, relative to the terms in them; 0 for a perfect fit.
        left_out: (n_modes, n_terms) coefficients estimated without each mode; None where too few modes remain.
    """

    coefficients: np.ndarray
    basis: Basis
    prior: Profile
    misfit: float
    left_out: np.ndarray | None = None

    def std(self, x: np.ndarray) -> np.ndarray:
        """Jackknife standard error at each x (n_points,); nan where no mode can be left out."""
        x = np.atleast_1d(np.asarray(x, float))
        if self.left_out is None:
            return np.full(x.size, np.nan)
        values = self.basis.functions(x) @ self.left_out.T
        return np.asarray(np.sqrt((values.shape[1] - 1) * values.var(axis=1)))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Values at x, in the shape of x."""
        x = np.asarray(x, float)
        series = self.basis.functions(np.atleast_1d(x)) @ self.coefficients
        return np.asarray(self.prior(x) + series.reshape(x.shape))

    @property
    def profile(self) -> Profile:
        """The same as a `Profile`, to build a structure with."""
        return Profile(self.__call__, tuple(sorted({*self.basis.breaks, *self.prior.breaks})))


@dataclass(frozen=True, eq=False, repr=False)
class Distributions(Printed):
    """The mass and stiffness of one structure, and the scale of its modes.

    Attributes:
        mass: kg/m.
        stiffness: EA in N, or EI in N m².
        scales: (n_modes,) a_r = (∫ m φ_r² dx)^½; φ_r / a_r is mass-normalised.
        length: of the structure, m.
        orthogonality: largest |∫ m φ_r φ_s dx| / (a_r a_s) of two modes.
    """

    mass: Distribution
    stiffness: Distribution
    scales: np.ndarray
    length: float
    orthogonality: float

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        terms = (
            f"{what} in {counted(distribution.basis.n_terms, 'term')}"
            for what, distribution in (("mass", self.mass), ("stiffness", self.stiffness))
        )
        rows = zip(*columns(self.mass, self.length), *columns(self.stiffness, self.length)[1:])
        line = f"{', '.join(terms)} from {counted(self.scales.size, 'mode')},"
        line += f" orthogonal to {self.orthogonality:.2g}"
        return line, ("x [m]", "mass [kg/m]", "±", "stiffness", "±"), list(rows), self.remarks

    @property
    def remarks(self) -> tuple[str, ...]:
        """Which distribution is unreliable, and the remedies."""
        x, remarks = np.linspace(0.0, self.length, 101), []
        for what, distribution in (("mass", self.mass), ("stiffness", self.stiffness)):
            error = distribution.std(x).mean() / np.abs(distribution(x)).mean()
            if np.isnan(error):
                text = "has no standard error, as no mode can be left out: use more modes"
            elif error > RELIABLE:
                text = (
                    f"is uncertain by {100 * error:.2g} %, as single modes left out show; up to {100 * RELIABLE:g} %"
                    " it is reliable. Derivatives of noisy shapes are poor: use more sensors"
                )
            else:
                continue
            remarks.append(f"the {what} {text}, fewer terms, or choose_structure")
        if self.orthogonality > RELIABLE:
            remarks.append(
                f"two modes are orthogonal only to {self.orthogonality:.2g}, at most {RELIABLE:g} where mass and"
                " shapes agree: the mass needs other terms, or something is attached that the relations do not contain,"
                " as a point mass; use choose_structure with what is attached in the nominal structure"
            )
        return tuple(remarks)


def columns(of: Any, length: float) -> tuple[Sequence[str], Sequence[str], Sequence[str]]:
    """Columns of a printed distribution with a `std`: places, values and their standard errors."""
    x = np.linspace(0.0, length, PRINTED)
    values, errors = zip(*(rounded(value, error) for value, error in zip(of(x), of.std(x), strict=True)))
    return [f"{at:.4g}" for at in x], values, errors


@warns_of_remarks
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
        prior_mass, prior_stiffness: first estimates, kg/m and N (N m²), which the series corrects.

    Raises:
        ValueError: no known mass, one that is not positive or off the structure, more terms than relations, known
            values that the series cannot take.
        UserWarning: mass or stiffness of a standard error above a tenth or unknown; modes that are not orthogonal.
    """
    return distributions_of(modes, kind, (mass_basis, stiffness_basis), known_mass, (prior_mass, prior_stiffness))


def distributions_of(
    modes: Modes,
    kind: str,
    bases: tuple[Basis, Basis],
    known: Sequence[tuple[float, float]],
    priors: tuple[ProfileLike, ProfileLike],
) -> Distributions:
    """`mass_and_stiffness` without its warnings; `bases` and `priors` are of mass and of stiffness."""
    if kind not in ("bar", "beam"):
        raise ValueError(f"mass and stiffness are those of a bar or a beam; got {kind!r}")
    unit, scale = _unit_mean_square(modes)
    identified = partial(
        _identified,
        order=1 if kind == "bar" else 2,
        bases=bases,
        known=known,
        priors=(as_profile(priors[0]), as_profile(priors[1])),
    )
    mass, stiffness, gram = identified(unit)
    scales = np.sqrt(np.diag(gram))
    orthogonality = float(np.abs(gram / np.outer(scales, scales) - np.eye(scales.size)).max())
    try:
        others = [identified(unit.select([s for s in range(modes.n_modes) if s != r])) for r in range(modes.n_modes)]
        mass = replace(mass, left_out=frozen(np.array([other[0].coefficients for other in others])))
        stiffness = replace(stiffness, left_out=frozen(np.array([other[1].coefficients for other in others])))
    except ValueError:
        pass  # too few relations without one of the modes
    return Distributions(mass, stiffness, frozen(scales / scale), modes.length, orthogonality)


def _identified(
    unit: Modes,
    *,
    order: int,
    bases: tuple[Basis, Basis],
    known: Sequence[tuple[float, float]],
    priors: tuple[Profile, Profile],
) -> tuple[Distribution, Distribution, np.ndarray]:
    """Mass, stiffness, and ∫ m φ_r φ_s dx (n_modes, n_modes), of modes of mean square 1."""
    mass = _mass(unit, bases[0], priors[0], known)
    shapes, weights, x = _sampled(unit, 0, mass.profile.breaks)
    gram = (shapes.T * (weights * mass(x))) @ shapes
    a_squared = np.diag(gram)
    if (a_squared <= 0).any():
        raise ValueError(
            "the identified mass is negative over so much of the structure that a mode has no positive scale; use"
            " fewer terms, more sensors, or a prior estimate"
        )
    return mass, _stiffness(unit, order, a_squared, bases[1], priors[1]), gram


def _mass(modes: Modes, basis: Basis, prior: Profile, known: Sequence[tuple[float, float]]) -> Distribution:
    if len(known) == 0:
        raise ValueError("orthogonality determines the mass only up to a factor; give the mass at one point or more")
    shapes, weights, x = _sampled(modes, 0, (*basis.breaks, *prior.breaks))
    places, values = modes.domain.locate([x for x, _ in known]), np.array([value for _, value in known], float)
    if not (np.isfinite(values) & (values > 0)).all():
        raise ValueError(f"a known mass must be positive and finite, kg/m; got {values}")
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
        shapes: (n_points, n_modes) at integration points, of equal scale.
        weights: (n_points,) of integration.
        functions, prior: (n_points, n_terms) and (n_points,) at these points.
        rows, known: (n_known, n_terms) functions where the mass is known, and its value less the prior.
    """
    if functions.shape[1] > (n_relations := shapes.shape[1] * (shapes.shape[1] - 1) // 2 + known.size):
        raise ValueError(_too_many(functions.shape[1], "mass", n_relations, shapes.shape[1]))
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
        strains: (factor, (n_points, n_modes)): the strain energy density at unit stiffness is the sum of factor times
            square.
        weights, functions, prior: as `mass_series` takes them.
        a_squared, omega: (n_modes,) scales and frequencies.
    """
    if functions.shape[1] > (most := omega.size * (omega.size + 1) // 2):
        raise ValueError(_too_many(functions.shape[1], "stiffness", most, omega.size))
    r, s = np.triu_indices(omega.size)
    products = sum((weights * factor)[:, None] * strain[:, r] * strain[:, s] for factor, strain in strains)
    v, v0 = np.asarray(products).T @ functions, np.asarray(products).T @ prior
    targets = np.where(r == s, a_squared[r] * omega[r] ** 2, 0.0)
    # A relation and its error grow with ω_r ω_s; divided by it, all have equal weight.
    weight = 1.0 / np.maximum(omega[r] * omega[s], 1e-12 * omega.max() ** 2)
    coefficients = np.linalg.lstsq(weight[:, None] * v, weight * (targets - v0), rcond=None)[0]
    residual = weight * (v @ coefficients + v0 - targets)
    return coefficients, _misfit(residual, weight[:, None] * v, coefficients, weight * v0)


def _too_many(n_terms: int, what: str, most: int, n_modes: int) -> str:
    return (
        f"{n_terms} terms of {what} cannot be found from {most} relations of {n_modes} modes; use more modes or fewer"
        " terms"
    )


def _unit_mean_square(modes: Modes) -> tuple[Modes, np.ndarray]:
    """The modes with shapes of mean square 1, so that all relations have equal weight, and the factors applied."""
    x = (np.arange(2000) + 0.5) / 2000 * modes.length
    scale = 1.0 / np.sqrt((modes.phi(x) ** 2).mean(axis=0))
    return replace(modes, shapes=lambda x, derivative: modes.shapes(x, derivative) * scale), scale


def _sampled(modes: Modes, derivative: int, breaks: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shapes (n_points, n_modes), weights and places of a Gauss rule split at the breaks."""
    n_pieces = 16 * (1 + modes.n_modes // 4)
    nodes = np.unique(np.r_[np.linspace(0.0, modes.length, n_pieces + 1), [b for b in breaks if 0 < b < modes.length]])
    x, weights = gauss_between(nodes, 12)
    return modes.phi(x, derivative), weights, x


def held_exactly(rows: np.ndarray, values: np.ndarray, what: str, size: float) -> tuple[np.ndarray, np.ndarray]:
    """A particular solution c of rows @ c = values, and the null space of rows (n_terms, n_free).

    Args:
        what: description of the values.
        size: scale of the values, for the tolerance.

    Raises:
        ValueError: values that no coefficients give.
    """
    particular = np.linalg.lstsq(rows, values, rcond=None)[0]
    error = np.abs(rows @ particular - values).max()
    if error > KNOWN_TOLERANCE * size:
        raise ValueError(
            f"the series with {rows.shape[1]} terms cannot take the {rows.shape[0]} known {what} (off by {error:.3g});"
            " use more terms or fewer known places"
        )
    return particular, null_space(rows)


def _constrained(matrix: np.ndarray, target: np.ndarray, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Least squares solution of matrix @ c = target subject to rows @ c = values."""
    particular, free = held_exactly(rows, values, "masses", max(np.abs(values).max(), 1e-300))
    if free.shape[1] == 0:
        return np.asarray(particular)
    return np.asarray(particular + free @ np.linalg.lstsq(matrix @ free, target - matrix @ particular, rcond=None)[0])


def _misfit(residual: np.ndarray, matrix: np.ndarray, coefficients: np.ndarray, offset: np.ndarray) -> float:
    terms = np.sqrt(np.mean((np.abs(matrix) @ np.abs(coefficients) + np.abs(offset)) ** 2)) if residual.size else 0.0
    return float(np.sqrt(np.mean(residual**2)) / terms) if terms else 0.0
