"""Mass and stiffness along the structure, from modes alone and the mass at a point, and their check (Ch. 4).

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

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.interpolate import BSpline
from scipy.linalg import null_space

from workbench.arrays import Floats
from workbench.identification.shapes.mode_pairing import subspace_mac
from workbench.identification.signal.modal_estimates import rounded
from workbench.structure.domain import Domain, gauss_between
from workbench.structure.member import Bar, Beam
from workbench.structure.modes import Modes, frozen
from workbench.structure.plate import Plate
from workbench.structure.printed import Printed, counted, warns_of_remarks
from workbench.structure.profile import Profile, ProfileLike, as_profile
from workbench.structure.supports import End
from workbench.threads import one_blas_thread

KNOWN_TOLERANCE = 1e-8
# Largest mean standard error over mean value of a reliable distribution, and largest orthogonality error of modes
# (Ewins, Modal Testing)
RELIABLE = 0.1
PRINTED = 11  # number of places at which distributions are printed
COMPARED = 101  # number of places at which shapes are compared


@dataclass(frozen=True, eq=False)
class Basis:
    """Functions of x whose linear combination is a distribution.

    Attributes:
        functions: x (n_points,) -> (n_points, n_terms).
        n_terms: number of functions, 0 or more.
        breaks: places where they are not smooth, m.
    """

    functions: Callable[[np.ndarray], np.ndarray] = field(repr=False)
    n_terms: int
    breaks: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.n_terms < 0:
            raise ValueError(f"a series has 0 terms or more; got {self.n_terms}")

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
        """B-splines on equal intervals, degree + 1 or more: local functions, each zero over most of the structure."""
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
        series = self.basis.functions(x.ravel()) @ self.coefficients
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
        mass, stiffness = (counted(each.basis.n_terms, "term") for each in (self.mass, self.stiffness))
        line = (
            f"mass in {mass}, stiffness in {stiffness} from {counted(self.scales.size, 'mode')}, orthogonal to"
            f" within {self.orthogonality:.2g}"
        )
        rows = printed_rows(self.length, self.mass, self.stiffness)
        return line, ("x [m]", "mass [kg/m]", "±", "stiffness", "±"), rows, self.remarks

    @property
    def remarks(self) -> tuple[str, ...]:
        """Which distribution is unreliable, and the remedies."""
        x, remarks = np.linspace(0.0, self.length, 101), []
        for what, distribution in (("mass", self.mass), ("stiffness", self.stiffness)):
            error = distribution.std(x).mean() / np.abs(distribution(x)).mean()
            if np.isnan(error):
                remarks.append(
                    f"the {what} has no standard error, as no mode can be left out: use more modes, fewer terms, or"
                    " choose_structure"
                )
            elif error > RELIABLE:
                remarks.append(
                    f"the {what} is uncertain by {100 * error:.2g} %, as single modes left out show; up to"
                    f" {100 * RELIABLE:g} % it is reliable. Derivatives of noisy shapes are poor: use more sensors,"
                    " fewer terms, or choose_structure"
                )
        if self.orthogonality > RELIABLE:
            remarks.append(
                f"two modes are orthogonal only to within {self.orthogonality:.2g}, at most {RELIABLE:g} where mass and"
                " shapes agree: the mass needs other terms, or something is attached that the relations do not contain,"
                " as a point mass; use choose_structure with what is attached in the nominal structure"
            )
        return tuple(remarks)


def printed_rows(length: float, *distributions: Any) -> list[tuple[str, ...]]:
    """Rows of printed distributions with a `std`: a place, then value and standard error of each."""
    x = np.linspace(0.0, length, PRINTED)
    numbers = zip(x, *(zip(each(x), each.std(x), strict=True) for each in distributions), strict=True)
    return [(f"{at:.4g}", *(text for pair in pairs for text in rounded(*pair))) for at, *pairs in numbers]


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
    return _distributions(modes, kind, (mass_basis, stiffness_basis), known_mass, (prior_mass, prior_stiffness))


def _distributions(
    modes: Modes,
    kind: str,
    bases: tuple[Basis, Basis],
    known: Sequence[tuple[float, float]],
    priors: tuple[ProfileLike, ProfileLike],
) -> Distributions:
    """`mass_and_stiffness` without its warnings; `bases` and `priors` are of mass and of stiffness."""
    if kind not in ("bar", "beam"):
        raise ValueError(f"mass and stiffness are those of a bar or a beam; got {kind!r}")
    order = 1 if kind == "bar" else 2
    m0, k0 = map(as_profile, priors)
    # Of shapes with mean square 1 all relations have equal weight.
    x = (np.arange(2000) + 0.5) / 2000 * modes.length
    scale = 1.0 / np.sqrt((modes.phi(x) ** 2).mean(axis=0))
    unit = replace(modes, shapes=lambda x, derivative: modes.shapes(x, derivative) * scale)

    def identified(some: Modes) -> tuple[Distribution, Distribution, Floats]:
        """Mass, stiffness, and ∫ m φ_r φ_s dx (n_modes, n_modes)."""
        x, weights = _quadrature(some, (*bases[0].breaks, *m0.breaks))
        places, values = known_masses(some.domain, known)
        held = bases[0].functions(places), values - m0(places)
        c, misfit, gram = mass_series(some.phi(x), weights, bases[0].functions(x), m0(x), *held)
        mass = Distribution(frozen(c), bases[0], m0, misfit)
        x, weights = _quadrature(some, (*bases[1].breaks, *k0.breaks))
        strains = [(1.0, some.phi(x, order))]
        c, misfit = stiffness_series(strains, weights, bases[1].functions(x), k0(x), np.diag(gram), some.omega)
        return mass, Distribution(frozen(c), bases[1], k0, misfit), gram

    mass, stiffness, gram = identified(unit)
    scales = np.sqrt(np.diag(gram))
    orthogonality = float(np.abs(gram / np.outer(scales, scales) - np.eye(scales.size)).max())
    try:
        others = [identified(unit.select([s for s in range(modes.n_modes) if s != r])) for r in range(modes.n_modes)]
        mass = replace(mass, left_out=frozen([other[0].coefficients for other in others]))
        stiffness = replace(stiffness, left_out=frozen([other[1].coefficients for other in others]))
    except ValueError:
        pass  # too few relations without one of the modes
    return Distributions(mass, stiffness, frozen(scales / scale), modes.length, orthogonality)


def _quadrature(modes: Modes, breaks: Sequence[float]) -> tuple[Floats, Floats]:
    """Points and weights of a Gauss rule for products of two shapes, split at the breaks."""
    n_pieces = 16 * (1 + modes.n_modes // 4)
    nodes = np.unique(np.r_[np.linspace(0.0, modes.length, n_pieces + 1), [b for b in breaks if 0 < b < modes.length]])
    return gauss_between(nodes, 12)


def known_masses(domain: Domain, known: Sequence[tuple[Any, float]]) -> tuple[np.ndarray, Floats]:
    """`known_values` of a mass, at least one."""
    if len(known) == 0:
        raise ValueError("orthogonality determines the mass only up to a factor; give the mass at one point or more")
    return known_values(domain, known, "mass")


def known_values(domain: Domain, known: Sequence[tuple[Any, float]], what: str) -> tuple[np.ndarray, Floats]:
    """Places, as `domain.locate` returns them, and the positive values (n_known,) of a distribution there."""
    places, values = domain.locate([place for place, _ in known]), np.array([value for _, value in known], float)
    for (place, _), value in zip(known, values, strict=True):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"a known {what} must be positive and finite; got {value:g} at {domain.text(place)}")
    return places, values


def mass_series(
    shapes: np.ndarray,
    weights: np.ndarray,
    functions: np.ndarray,
    prior: np.ndarray,
    rows: np.ndarray,
    known: np.ndarray,
) -> tuple[Floats, float, Floats]:
    """The mass from the relations r ≠ s of (4.6).

    Args:
        shapes: (n_points, n_modes) at integration points, of equal scale.
        weights: (n_points,) of integration.
        functions, prior: (n_points, n_terms) and (n_points,) at these points.
        rows, known: (n_known, n_terms) functions where the mass is known, and its value less the prior.

    Returns:
        coefficients (n_terms,), misfit of the relations, and ∫ m φ_r φ_s dx (n_modes, n_modes).
    """
    n_modes = shapes.shape[1]
    _check_terms("mass", functions.shape[1], n_modes * (n_modes - 1) // 2 + known.size, n_modes)
    r, s = np.triu_indices(n_modes, 1)
    products = weights[:, None] * shapes[:, r] * shapes[:, s]
    u, u0 = products.T @ functions, products.T @ prior  # U_rsj of (4.8), U_rs0 of (4.23)
    particular, free = held_exactly(rows, known, "masses", max(np.abs(known).max(), 1e-300))
    coefficients = particular + free @ np.linalg.lstsq(u @ free, -u0 - u @ particular, rcond=None)[0]
    gram = (shapes.T * (weights * (prior + functions @ coefficients))) @ shapes
    if (np.diag(gram) <= 0).any():
        raise ValueError(
            "the identified mass is negative over so much of the structure that a mode has no positive scale; use"
            " fewer terms, more sensors, or a prior estimate"
        )
    return coefficients, _misfit(u @ coefficients + u0, u, coefficients, u0), gram


def stiffness_series(
    strains: Sequence[tuple[np.ndarray | float, np.ndarray]],
    weights: np.ndarray,
    functions: np.ndarray,
    prior: np.ndarray,
    a_squared: np.ndarray,
    omega: np.ndarray,
) -> tuple[Floats, float]:
    """Coefficients (n_terms,) of the stiffness from all relations of (4.6), and their misfit.

    Args:
        strains: (factor, (n_points, n_modes)): the strain energy density at unit stiffness is the sum of factor times
            square.
        weights, functions, prior: as `mass_series` takes them.
        a_squared, omega: (n_modes,) scales and frequencies.
    """
    r, s = np.triu_indices(omega.size)
    _check_terms("stiffness", functions.shape[1], r.size, omega.size)
    products = sum((weights * factor)[:, None] * strain[:, r] * strain[:, s] for factor, strain in strains)
    v, v0 = np.asarray(products).T @ functions, np.asarray(products).T @ prior
    targets = np.where(r == s, a_squared[r] * omega[r] ** 2, 0.0)
    weight = relation_weights(omega)
    coefficients = np.linalg.lstsq(weight[:, None] * v, weight * (targets - v0), rcond=None)[0]
    residual = weight * (v @ coefficients + v0 - targets)
    return coefficients, _misfit(residual, weight[:, None] * v, coefficients, weight * v0)


def relation_weights(omega: np.ndarray) -> Floats:
    """Weights of the stiffness relations r ≤ s, which grow with their errors as ω_r ω_s."""
    r, s = np.triu_indices(omega.size)
    return np.asarray(1.0 / np.maximum(omega[r] * omega[s], 1e-12 * omega.max() ** 2))


def _check_terms(what: str, n_terms: int, n_relations: int, n_modes: int) -> None:
    if n_terms > n_relations:
        raise ValueError(
            f"{n_terms} terms of {what} cannot be found from {n_relations} relations of {n_modes} modes; use more modes"
            " or fewer terms"
        )


def held_exactly(rows: np.ndarray, values: np.ndarray, what: str, size: float) -> tuple[np.ndarray, np.ndarray]:
    """A particular solution c of rows @ c = values (`what`, of scale `size`), and the null space (n_terms, n_free)."""
    particular = np.linalg.lstsq(rows, values, rcond=None)[0]
    error = np.abs(rows @ particular - values).max()
    if error > KNOWN_TOLERANCE * size:
        raise ValueError(
            f"the series with {rows.shape[1]} terms cannot take the {rows.shape[0]} known {what} (off by {error:.3g});"
            " use more terms or fewer known places"
        )
    return particular, null_space(rows)


def _misfit(residual: np.ndarray, matrix: np.ndarray, coefficients: np.ndarray, offset: np.ndarray) -> float:
    terms = np.sqrt(np.mean((np.abs(matrix) @ np.abs(coefficients) + np.abs(offset)) ** 2)) if residual.size else 0.0
    return float(np.sqrt(np.mean(residual**2)) / terms) if terms else 0.0


@dataclass(frozen=True, eq=False, repr=False)
class SelfCheck(Printed):
    """The eigensolution of an identified structure compared with the measurement (4.3).

    Attributes:
        frequency_errors: (n_modes,) relative, of the identified structure; infinite where it has no such mode.
        mac: (n_modes,) of each shape.
        refusal: why the identified distributions are no structure; empty if they are.
    """

    frequency_errors: np.ndarray
    mac: np.ndarray
    refusal: str = ""

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        if self.refusal:
            return f"identified structure against measurement: {self.refusal}", (), (), ()
        each = enumerate(zip(self.frequency_errors, self.mac, strict=True))
        rows = [(str(r + 1), f"{100 * error:.3g}", f"{agreement:.4f}") for r, (error, agreement) in each]
        line = f"identified structure against measurement: largest frequency error {100 * self.worst:.3g} %"
        return line, ("mode", "frequency [%]", "MAC"), rows, ()

    @property
    def worst(self) -> float:
        """Largest relative frequency error, by which identifications are compared."""
        return float(np.abs(self.frequency_errors).max())


@one_blas_thread
def self_check(
    found: Distributions, measured: Modes, *, kind: str, left: str | End, right: str | End, first_mode: int = 0
) -> SelfCheck:
    """The eigensolution of an identified structure compared with the measurement.

    Args:
        found: mass and stiffness.
        measured: the modes they were identified from, consecutive.
        kind: "bar" or "beam".
        left, right: its ends.
        first_mode: index of the first measured mode among all modes of the structure; 2 leaves out the rigid-body
            modes of a free-free beam.
    """
    common: dict[str, Any] = {"length": measured.length, "left": left, "right": right}

    def built() -> Bar | Beam:
        if kind == "bar":
            return Bar(axial_stiffness=found.stiffness.profile, mass_per_length=found.mass.profile, **common)
        return Beam(bending_stiffness=found.stiffness.profile, mass_per_length=found.mass.profile, **common)

    return compared(built, measured, first_mode, 1e-6, np.linspace(0.0, measured.length, COMPARED))


def compared(
    build: Callable[[], Bar | Beam | Plate], measured: Modes, first_mode: int, tolerance: float, places: np.ndarray
) -> SelfCheck:
    """The `SelfCheck` of a structure that `build` returns, or refuses; shapes are compared at `places`."""
    n = measured.n_modes
    try:
        computed = build().modes(first_mode + n, tolerance=tolerance).select(slice(first_mode, None))
    except ValueError as error:
        return SelfCheck(np.full(n, np.inf), np.zeros(n), str(error))
    agreement = subspace_mac(measured.phi(places), computed.phi(places), computed.omega)
    return SelfCheck(computed.omega / measured.omega - 1.0, np.diag(agreement))


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiedStructure(Printed):
    """A structure identified with the number of terms of the best self-check.

    Attributes:
        distributions: mass and stiffness.
        n_terms: of mass, of stiffness.
        check: of these.
        tried: numbers of terms of mass and stiffness, and the largest frequency error, of every pair tried.
    """

    distributions: Distributions
    n_terms: tuple[int, int]
    check: SelfCheck
    tried: tuple[tuple[int, int, float], ...] = ()

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line, headings, rows, remarks = self.distributions._printed()
        return line, headings, rows, [self.check._printed()[0], *remarks]

    @property
    def remarks(self) -> tuple[str, ...]:
        """The remarks of the distributions."""
        return self.distributions.remarks


@warns_of_remarks
def choose_terms(
    measured: Modes,
    *,
    kind: str,
    left: str | End,
    right: str | End,
    known_mass: Sequence[tuple[float, float]],
    terms: Iterable[int] = range(1, 7),
    basis: Callable[[int], Basis] = Basis.polynomial,
    first_mode: int = 0,
    prior_mass: ProfileLike = 0.0,
    prior_stiffness: ProfileLike = 0.0,
) -> IdentifiedStructure:
    """The identified structure of the numbers of terms whose modes agree best with the measured ones.

    A pair of more terms must halve the largest frequency error to be preferred, and none is once this is below the
    standard error of the measured frequencies: further terms would over-fit.

    Args:
        measured: as `mass_and_stiffness`.
        kind, left, right, first_mode: as `self_check`.
        known_mass: ((x, kg/m), ...).
        terms: numbers of terms to try, for mass and stiffness alike.
        basis: number of terms -> `Basis`.
        prior_mass, prior_stiffness: as `mass_and_stiffness`.

    Raises:
        ValueError: no pair of numbers gives a structure; the last reason is given.
        UserWarning: as `mass_and_stiffness`.
    """
    best: IdentifiedStructure | None = None
    tried, reason, numbers = [], "no number of terms was given", tuple(terms)
    measurement_error = 1e-9  # of modes that were computed
    if measured.covariance is not None:
        std = np.sqrt(np.diag(measured.covariance)[: measured.n_modes])
        measurement_error = float((std / measured.omega).max())
    for pair in sorted(((a, b) for a in numbers for b in numbers), key=lambda pair: (sum(pair), pair)):
        try:
            bases = basis(pair[0]), basis(pair[1])
            found = _distributions(measured, kind, bases, known_mass, (prior_mass, prior_stiffness))
        except ValueError as error:
            reason = str(error)
            continue
        check = self_check(found, measured, kind=kind, left=left, right=right, first_mode=first_mode)
        reason = check.refusal or reason
        tried.append((*pair, check.worst))
        if np.isfinite(check.worst) and (
            best is None or (measurement_error < best.check.worst and check.worst < 0.5 * best.check.worst)
        ):
            best = IdentifiedStructure(found, pair, check)
    if best is None:
        raise ValueError(f"no number of terms gives a structure: {reason}")
    return replace(best, tried=tuple(tried))
