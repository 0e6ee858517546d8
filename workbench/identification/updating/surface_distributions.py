"""Mass and bending stiffness over a plate, from modes alone and the mass at a point (Ch. 4, in two dimensions).

Modes are orthogonal with respect to the mass and to the strain energy, whatever their scale:

    ∫∫ m φ_r φ_s dA = a_r² δ_rs,   ∫∫ D [φ_r, φ_s] dA = a_r² ω_r² δ_rs,
    [φ_r, φ_s] = ½(1+ν) ∇²φ_r ∇²φ_s + ½(1-ν) (φ_r,xx - φ_r,yy)(φ_s,xx - φ_s,yy) + 2(1-ν) φ_r,xy φ_s,xy

which are linear in m, D and a_r², as along an interval (`distributions`): the relations r ≠ s find the mass but for its
size, all of them then the stiffness. No edge may do work: springs along edges and masses on the plate are not known.

Errors dφ and dω unbalance the relations by ρ, to first order ∫∫ m (dφ_r φ_s + φ_r dφ_s) dA, and likewise of D. The
coefficients of the series U c then move by dc = -U⁺ ρ, which gives those of D a covariance. The mean of the second
order, ∫∫ D [dφ_r, dφ_r] dA, is added to it squared.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.linalg import null_space

from workbench.identification.shapes.mode_pairing import subspace_mac
from workbench.identification.shapes.surface_spline import SurfaceErrors
from workbench.identification.updating.distributions import mass_series, stiffness_series
from workbench.identification.updating.self_check import SelfCheck
from workbench.structure.domain import Rectangle
from workbench.structure.modes import Modes, frozen
from workbench.structure.plate import Plate, bending_squares, check_poisson_ratio
from workbench.structure.profile import Field, FieldLike, as_field
from workbench.structure.supports import Edge
from workbench.threads import one_blas_thread

QUADRATURE = 144  # modes that the points of integration would serve: what squares of second derivatives take
QUADRATURE_OF_ERRORS = 16  # likewise, to a per cent of a standard error
DERIVATIVES = ((0, 0), (2, 0), (0, 2), (1, 1))  # of shapes, in the relations
PER_SIDE = 21  # points each way where shapes are compared


@dataclass(frozen=True, eq=False)
class SurfaceBasis:
    """Known functions over a rectangle whose sum, with coefficients to be found, is a distribution.

    Attributes:
        functions: x, y (n_points,) each -> (n_points, n_terms).
        n_terms: how many.
    """

    functions: Callable[[np.ndarray, np.ndarray], np.ndarray] = field(repr=False)
    n_terms: int

    @classmethod
    def legendre(cls, n_x: int, n_y: int, *, length: tuple[float, float]) -> "SurfaceBasis":
        """Products of Legendre polynomials, n_x along x and n_y along y, each from edge to edge.

        Raises:
            ValueError: no polynomial along a side.
        """
        a, b = length
        if min(n_x, n_y) < 1:
            raise ValueError(f"a series takes one polynomial or more along each side; got {n_x} along x, {n_y} along y")

        def functions(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            along_x = legvander(2.0 * np.asarray(x, float) / a - 1.0, n_x - 1)
            along_y = legvander(2.0 * np.asarray(y, float) / b - 1.0, n_y - 1)
            return np.asarray(np.einsum("pi,pj->pij", along_x, along_y).reshape(len(along_x), -1))

        return cls(functions, n_x * n_y)


@dataclass(frozen=True, eq=False)
class SurfaceDistribution:
    """An identified mass or stiffness over a plate: a prior estimate (zero if none) plus a series.

    Attributes:
        coefficients: (n_terms,).
        basis: the functions they multiply.
        prior: m_0 or D_0.
        misfit: root mean square of the relations left over, relative to the terms in them; 0 for a perfect fit.
        covariance: (n_terms, n_terms) of the coefficients of a stiffness; None where the errors of the modes are not
            known, and of a mass.
    """

    coefficients: np.ndarray
    basis: SurfaceBasis
    prior: Field
    misfit: float
    covariance: np.ndarray | None = None

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Values at (x, y), in the shape that x and y have together."""
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        series = self.basis.functions(x.ravel(), y.ravel()) @ self.coefficients
        return np.asarray(self.prior(x, y) + series.reshape(x.shape))

    def std(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Standard errors at (x, y), in the shape that x and y have together.

        They hold the errors of the modes, not that the series may have too few terms.

        Raises:
            ValueError: no covariance: the errors of the modes were not given, or it is a mass.
        """
        if self.covariance is None:
            raise ValueError(
                "a stiffness has standard errors where plate_mass_and_stiffness(errors=...) is given; a mass has none"
            )
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        rows = self.basis.functions(x.ravel(), y.ravel())
        return np.asarray(np.sqrt(np.einsum("pi,ij,pj->p", rows, self.covariance, rows)).reshape(x.shape))

    @property
    def field(self) -> Field:
        """The same as a `Field`, to build a plate with."""
        return Field(self.__call__, self.prior.x_breaks, self.prior.y_breaks)


@dataclass(frozen=True, eq=False)
class SurfaceDistributions:
    """The mass and stiffness of one plate, and the scale of its modes found with them.

    Attributes:
        mass: kg/m².
        stiffness: D, N m.
        scales: (n_modes,) a_r = (∫∫ m φ_r² dA)^½; φ_r / a_r is mass-normalised.
    """

    mass: SurfaceDistribution
    stiffness: SurfaceDistribution
    scales: np.ndarray


@one_blas_thread
def plate_mass_and_stiffness(
    modes: Modes,
    *,
    poisson_ratio: float,
    mass_basis: SurfaceBasis,
    stiffness_basis: SurfaceBasis,
    known_mass: Sequence[tuple[tuple[float, float], float]],
    prior_mass: FieldLike = 0.0,
    prior_stiffness: FieldLike = 0.0,
    errors: SurfaceErrors | None = None,
) -> SurfaceDistributions:
    """Series for m(x, y) and D(x, y) from the orthogonality of modes of any scale over a rectangle.

    Args:
        modes: identified or computed; frequencies and shapes are used, and second derivatives of these.
        poisson_ratio: ν.
        mass_basis, stiffness_basis: functions of the series.
        known_mass: (((x, y), kg/m²), ...), at least one place; held exactly.
        prior_mass, prior_stiffness: first estimates, kg/m² and N m; the series then corrects them.
        errors: of these modes, as `surface_errors` gives them; the stiffness then has standard errors.

    Raises:
        ValueError: modes of another domain, errors of another number of modes, no known mass, one that is not positive
            or off the plate, more terms than relations, known values that the series cannot take, a mass so negative
            that a mode has no scale.
    """
    if not isinstance(modes.domain, Rectangle):
        raise ValueError(f"m(x, y) and D(x, y) are those of a plate; these modes are on {modes.domain}")
    check_poisson_ratio(poisson_ratio)
    if errors is not None and errors.roughness.size != modes.n_modes:
        raise ValueError(f"errors are of {errors.roughness.size} modes, not of these {modes.n_modes}; select the same")
    prior_mass, prior_stiffness = as_field(prior_mass), as_field(prior_stiffness)
    at, weights = modes.domain.quadrature(QUADRATURE)
    x, y = at.T
    shapes = modes.phi(at)
    size = np.sqrt((shapes**2).mean(axis=0))
    shapes = shapes / size
    if not known_mass:
        raise ValueError("orthogonality determines the mass only up to a factor; give the mass at one point or more")
    places = np.vstack([modes.domain.locate(place) for place, _ in known_mass])
    values = np.array([value for _, value in known_mass], float)
    if not (np.isfinite(values) & (values > 0)).all():
        raise ValueError(f"a known mass must be positive and finite, kg/m²; got {values}")
    coefficients, misfit = mass_series(
        shapes,
        weights,
        mass_basis.functions(x, y),
        prior_mass(x, y),
        mass_basis.functions(*places.T),
        values - prior_mass(*places.T),
    )
    mass = SurfaceDistribution(frozen(coefficients), mass_basis, prior_mass, misfit)
    a_squared = (weights * mass(x, y)) @ shapes**2
    if (a_squared <= 0).any():
        raise ValueError(
            "the identified mass is negative over so much of the plate that a mode has no positive scale; use fewer"
            " terms, more sensors, or a prior estimate"
        )
    strains = [
        (square.weight(x, y), sum(factor * modes.phi(at, (i, j)) for factor, i, j in square.parts) / size)
        for square in bending_squares(Field.constant(1.0), poisson_ratio)
    ]
    coefficients, misfit = stiffness_series(
        strains, weights, stiffness_basis.functions(x, y), prior_stiffness(x, y), a_squared, modes.omega
    )
    stiffness = SurfaceDistribution(frozen(coefficients), stiffness_basis, prior_stiffness, misfit)
    if errors is not None:
        # not that of the mass: near a free edge splines err alike in all modes, and the mass by twice as much
        covariance = _stiffness_covariance(
            modes, errors, mass, stiffness, poisson_ratio, mass_basis.functions(*places.T)
        )
        stiffness = replace(stiffness, covariance=frozen(covariance))
    return SurfaceDistributions(mass, stiffness, frozen(size * np.sqrt(a_squared)))


def _stiffness_covariance(
    modes: Modes,
    errors: SurfaceErrors,
    mass: SurfaceDistribution,
    stiffness: SurfaceDistribution,
    poisson_ratio: float,
    known: np.ndarray,
) -> np.ndarray:
    """Of the coefficients of the stiffness, (n_terms, n_terms), from the errors of the modes.

    Args:
        known: (n_known, n_terms) functions of the mass where it is held.
    """
    assert isinstance(modes.domain, Rectangle)
    at, weights = modes.domain.quadrature(QUADRATURE_OF_ERRORS)
    x, y = at.T
    n, omega = modes.n_modes, modes.omega
    fields = np.stack([modes.phi(at, d) for d in DERIVATIVES])  # (n_derivatives, n_at, n_modes)
    size = np.sqrt((fields[0] ** 2).mean(axis=0))
    fields = fields / size
    # errors are of shapes whose largest entry is 1
    drawn = errors.spline.matrix(at) @ errors.values
    scale = (fields[0] * drawn).sum(axis=0) / (drawn**2).sum(axis=0)
    # the density of an energy is Σ ab form[a, b] φ^(a) φ^(b), of the kinetic one and of that of bending
    bending = np.zeros((4, 4))
    for square in bending_squares(Field.constant(1.0), poisson_ratio):
        factors = np.zeros(4)
        for factor, i, j in square.parts:
            factors[DERIVATIVES.index((i, j))] = factor
        bending += float(square.weight(x[:1], y[:1])[0]) * np.outer(factors, factors)
    inertia = np.diag([1.0, 0.0, 0.0, 0.0])
    off, both = np.triu_indices(n, 1), np.triu_indices(n)
    own = np.flatnonzero(both[0] == both[1])
    m, d = weights * mass(x, y), weights * stiffness(x, y)
    weigh = 1.0 / np.maximum(omega[both[0]] * omega[both[1]], 1e-12 * omega.max() ** 2)

    def unbalanced(form: np.ndarray, density: np.ndarray, pairs: tuple[np.ndarray, ...]) -> np.ndarray:
        """(n_modes, n_pairs, n_derivatives n_at): what an error of each mode's shape does to each relation."""
        away = np.einsum("ab,bpr,p->rap", form, fields, density).reshape(n, -1)
        rows = np.zeros((n, pairs[0].size, away.shape[1]))
        for k, (r, s) in enumerate(zip(*pairs)):
            rows[r, k] += away[s]
            rows[s, k] += away[r]
        return rows

    def series(form: np.ndarray, basis: SurfaceBasis, pairs: tuple[np.ndarray, ...]) -> np.ndarray:
        """(n_pairs, n_terms) of the relations."""
        functions = weights[:, None] * basis.functions(x, y)
        return np.asarray(
            np.einsum("ab,apk,bpk,pj->kj", form, fields[:, :, pairs[0]], fields[:, :, pairs[1]], functions)
        )

    free = null_space(known)
    of_mass = -free @ np.linalg.pinv(series(inertia, mass.basis, off) @ free)
    of_stiffness = -np.linalg.pinv(weigh[:, None] * series(bending, stiffness.basis, both)) * weigh
    # the scale a_r² stands in one relation of the stiffness, and moves with the shape and with the mass
    alone = (np.arange(n), np.arange(n))
    by_mass = np.zeros((both[0].size, mass.basis.n_terms))
    by_mass[own] = -(omega**2)[:, None] * series(inertia, mass.basis, alone)
    by_shape = unbalanced(bending, d, both)
    by_shape[:, own] -= (omega**2)[:, None] * unbalanced(inertia, m, alone)
    by_omega = np.zeros((both[0].size, n))
    by_omega[own] = -np.diag(2.0 * omega * (m @ fields[0] ** 2))
    in_mass = of_mass @ unbalanced(inertia, m, off)
    moved = of_stiffness @ (by_shape + by_mass @ in_mass)
    through = np.stack([errors.spline.matrix(at, d) for d in DERIVATIVES])
    noise = scale[:, None, None] ** 2 * errors.value_covariance
    missed, rough = errors.spline.error(at, DERIVATIVES), scale**2 * errors.roughness
    by_noise = moved @ through.reshape(-1, through.shape[2])
    covariance = (by_noise @ noise @ by_noise.swapaxes(1, 2)).sum(axis=0)
    covariance += np.einsum("r,rij->ij", rough, moved @ missed @ moved.swapaxes(1, 2))
    # what errors have of energy themselves adds up over the modes, and is as large where curvatures are poor
    here = np.einsum("apbp->pab", missed.reshape(4, len(at), 4, len(at)))
    energies = [
        (
            np.einsum("ab,p,api,rij,bpj->r", form, density, through, noise, through, optimize=True),
            rough * np.einsum("ab,p,pab->", form, density, here),
        )
        for form, density in ((bending, d), (inertia, m))
    ]
    second = np.array(energies[0]) - omega**2 * np.array(energies[1])  # by noise, and between the sensors
    by_energy, by_frequency = of_stiffness[:, own] @ second.T, of_stiffness @ by_omega
    covariance += by_energy @ by_energy.T + by_frequency @ errors.omega_covariance @ by_frequency.T
    return np.asarray(covariance)


@one_blas_thread
def check_plate(
    found: SurfaceDistributions,
    measured: Modes,
    *,
    poisson_ratio: float,
    edges: str | Edge | Mapping[str, str | Edge],
    first_mode: int = 0,
    tolerance: float = 1e-4,
) -> SelfCheck:
    """Solve the eigenproblem of what was identified and compare it with what was measured, as `self_check` does.

    Frequencies say little of D where the plate hardly bends, at a free edge say: it may be further off there.

    Args:
        found: mass and stiffness.
        measured: the modes that they were found from, consecutive.
        poisson_ratio, edges: of the plate.
        first_mode: index of the first measured mode among all modes of the plate; 3 leaves out rigid-body modes.
        tolerance: of the frequencies of the eigenproblem.

    Raises:
        ValueError: modes of another domain, edges or a Poisson's ratio that no plate has.
    """
    if not isinstance(measured.domain, Rectangle):
        raise ValueError(f"m(x, y) and D(x, y) are those of a plate; these modes are on {measured.domain}")
    n = measured.n_modes
    plate = Plate(
        length=measured.domain.length,
        mass_per_area=1.0,
        bending_stiffness=1.0,
        poisson_ratio=poisson_ratio,
        edges=edges,
    )
    try:
        plate = replace(plate, mass_per_area=found.mass.field, bending_stiffness=found.stiffness.field)
        again = plate.modes(first_mode + n, tolerance=tolerance).select(slice(first_mode, None))
    except ValueError as error:
        return SelfCheck(np.full(n, np.inf), np.zeros(n), str(error))
    share = np.linspace(0.0, 1.0, PER_SIDE)
    grid = np.stack(np.meshgrid(*(side * share for side in measured.domain.length), indexing="ij"), axis=-1)
    agreement = subspace_mac(measured.phi(grid.reshape(-1, 2)), again.phi(grid.reshape(-1, 2)), again.omega)
    return SelfCheck(again.omega / measured.omega - 1.0, np.diag(agreement))
