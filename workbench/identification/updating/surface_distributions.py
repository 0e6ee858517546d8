"""Mass and bending stiffness over a plate, from modes alone and the mass at a point (Ch. 4, in two dimensions).

Modes are orthogonal with respect to the mass and to the strain energy, whatever their scale:

    ∫∫ m φ_r φ_s dA = a_r² δ_rs,   ∫∫ D [φ_r, φ_s] dA = a_r² ω_r² δ_rs,
    [φ_r, φ_s] = ½(1+ν) ∇²φ_r ∇²φ_s + ½(1-ν) (φ_r,xx - φ_r,yy)(φ_s,xx - φ_s,yy) + 2(1-ν) φ_r,xy φ_s,xy

which are linear in m, D and a_r², as along an interval (`distributions`): the relations r ≠ s determine the mass up to
a factor, all relations then the stiffness. No edge may do work: springs along edges and attached masses are excluded.

Errors dφ and dω give the relations the residual ρ, to first order ∫∫ m (dφ_r φ_s + φ_r dφ_s) dA, and likewise for D.
The coefficients c of the series U c change by dc = -U⁺ ρ, which gives those of D a covariance. The square of the mean
of the second-order term, ∫∫ D [dφ_r, dφ_r] dA, is added to it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.linalg import null_space

from workbench.identification.shapes.surface_spline import SurfaceErrors
from workbench.identification.updating.distributions import (
    SelfCheck,
    compared,
    known_masses,
    mass_series,
    relation_weights,
    stiffness_series,
)
from workbench.structure.domain import Rectangle
from workbench.structure.modes import Modes, frozen
from workbench.structure.plate import Plate, bending_squares, check_poisson_ratio
from workbench.structure.profile import Field, FieldLike, as_field
from workbench.structure.supports import Edge
from workbench.threads import one_blas_thread

QUADRATURE = 144  # number of modes for which the integration points suffice: for squares of second derivatives
QUADRATURE_OF_ERRORS = 16  # likewise, for standard errors to one per cent
DERIVATIVES = ((0, 0), (2, 0), (0, 2), (1, 1))  # of shapes, in the relations
PER_SIDE = 21  # points along each side, at which shapes are compared


@dataclass(frozen=True, eq=False)
class SurfaceBasis:
    """Functions over a rectangle whose linear combination is a distribution.

    Attributes:
        functions: x, y (n_points,) each -> (n_points, n_terms).
        n_terms: number of functions.
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
        misfit: rms residual of the relations, relative to the terms in them; 0 for a perfect fit.
        covariance: (n_terms, n_terms) of the coefficients of a stiffness; None where the errors of the modes are not
            known, and of a mass.
    """

    coefficients: np.ndarray
    basis: SurfaceBasis
    prior: Field
    misfit: float
    covariance: np.ndarray | None = None

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Values at (x, y), in the broadcast shape of x and y."""
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        series = self.basis.functions(x.ravel(), y.ravel()) @ self.coefficients
        return np.asarray(self.prior(x, y) + series.reshape(x.shape))

    def std(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Standard errors at (x, y), in the broadcast shape of x and y.

        They account for the errors of the modes, not for too few terms of the series.

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
    """The mass and stiffness of one plate, and the scale of its modes.

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
        prior_mass, prior_stiffness: first estimates, kg/m² and N m, which the series corrects.
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
    places, values = known_masses(modes.domain, known_mass)
    held = mass_basis.functions(*places.T)
    residual = values - prior_mass(*places.T)
    coefficients, misfit, gram = mass_series(
        shapes / size, weights, mass_basis.functions(x, y), prior_mass(x, y), held, residual
    )
    mass, a_squared = SurfaceDistribution(frozen(coefficients), mass_basis, prior_mass, misfit), np.diag(gram)
    strains = [
        (square.weight(x, y), sum(factor * modes.phi(at, (i, j)) for factor, i, j in square.parts) / size)
        for square in bending_squares(Field.constant(1.0), poisson_ratio)
    ]
    coefficients, misfit = stiffness_series(
        strains, weights, stiffness_basis.functions(x, y), prior_stiffness(x, y), a_squared, modes.omega
    )
    stiffness = SurfaceDistribution(frozen(coefficients), stiffness_basis, prior_stiffness, misfit)
    if errors is not None:
        # none for the mass: near a free edge splines have the same error in all modes, and the mass twice that
        covariance = _stiffness_covariance(modes, errors, mass, stiffness, poisson_ratio, held)
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
    """Covariance (n_terms, n_terms) of the coefficients of the stiffness, from the errors of the modes.

    `known` are the functions of the mass at the places where it is held, (n_known, n_terms).
    """
    assert isinstance(modes.domain, Rectangle)
    at, weights = modes.domain.quadrature(QUADRATURE_OF_ERRORS)
    x, y = at.T
    n, omega = modes.n_modes, modes.omega
    fields = np.stack([modes.phi(at, d) for d in DERIVATIVES])  # (n_derivatives, n_at, n_modes)
    size = np.sqrt((fields[0] ** 2).mean(axis=0))
    fields = fields / size
    # the errors are those of shapes whose largest entry is 1
    spline_shapes = errors.spline.matrix(at) @ errors.values
    scale = (fields[0] * spline_shapes).sum(axis=0) / (spline_shapes**2).sum(axis=0)
    # the densities of kinetic and of bending energy are Σ_ab form[a, b] φ^(a) φ^(b)
    bending = np.zeros((4, 4))
    for square in bending_squares(Field.constant(1.0), poisson_ratio):
        factors = np.zeros(4)
        for factor, i, j in square.parts:
            factors[DERIVATIVES.index((i, j))] = factor
        bending += float(square.weight(x[:1], y[:1])[0]) * np.outer(factors, factors)
    inertia = np.diag([1.0, 0.0, 0.0, 0.0])
    different, every = np.triu_indices(n, 1), np.triu_indices(n)
    diagonal = np.flatnonzero(every[0] == every[1])
    m, d = weights * mass(x, y), weights * stiffness(x, y)
    weight = relation_weights(omega)

    def change_of_relations(form: np.ndarray, density: np.ndarray, pairs: tuple[np.ndarray, ...]) -> np.ndarray:
        """Change of each relation per error of each mode's shape, (n_modes, n_pairs, n_derivatives n_at)."""
        change = np.einsum("ab,bpr,p->rap", form, fields, density).reshape(n, -1)
        rows = np.zeros((n, pairs[0].size, change.shape[1]))
        for k, (r, s) in enumerate(zip(*pairs)):
            rows[r, k] += change[s]
            rows[s, k] += change[r]
        return rows

    def series(form: np.ndarray, basis: SurfaceBasis, pairs: tuple[np.ndarray, ...]) -> np.ndarray:
        """Coefficient matrix U of the relations, (n_pairs, n_terms)."""
        functions = weights[:, None] * basis.functions(x, y)
        first, second = (fields[:, :, modes] for modes in pairs)
        return np.asarray(np.einsum("ab,apk,bpk,pj->kj", form, first, second, functions))

    free = null_space(known)
    mass_by_residual = -free @ np.linalg.pinv(series(inertia, mass.basis, different) @ free)
    stiffness_by_residual = -np.linalg.pinv(weight[:, None] * series(bending, stiffness.basis, every)) * weight
    # the scale a_r² is in one stiffness relation, and changes with the shape and with the mass
    same_mode = (np.arange(n), np.arange(n))
    by_mass = np.zeros((every[0].size, mass.basis.n_terms))
    by_mass[diagonal] = -(omega**2)[:, None] * series(inertia, mass.basis, same_mode)
    by_shape = change_of_relations(bending, d, every)
    by_shape[:, diagonal] -= (omega**2)[:, None] * change_of_relations(inertia, m, same_mode)
    by_omega = np.zeros((every[0].size, n))
    by_omega[diagonal] = -np.diag(2.0 * omega * (m @ fields[0] ** 2))
    mass_change = mass_by_residual @ change_of_relations(inertia, m, different)
    stiffness_change = stiffness_by_residual @ (by_shape + by_mass @ mass_change)
    spline_rows = np.stack([errors.spline.matrix(at, d) for d in DERIVATIVES])
    noise = scale[:, None, None] ** 2 * errors.value_covariance
    interpolation_error, roughness = errors.spline.error(at, DERIVATIVES), scale**2 * errors.roughness
    by_noise = stiffness_change @ spline_rows.reshape(-1, spline_rows.shape[2])
    covariance = (by_noise @ noise @ by_noise.swapaxes(1, 2)).sum(axis=0)
    by_interpolation = stiffness_change @ interpolation_error @ stiffness_change.swapaxes(1, 2)
    covariance += np.einsum("r,rij->ij", roughness, by_interpolation)
    # the energy of the errors themselves adds up over the modes, and matters where curvatures are inaccurate
    local_error = np.einsum("apbp->pab", interpolation_error.reshape(4, len(at), 4, len(at)))
    energies = [
        (
            np.einsum("ab,p,api,rij,bpj->r", form, density, spline_rows, noise, spline_rows, optimize=True),
            roughness * np.einsum("ab,p,pab->", form, density, local_error),
        )
        for form, density in ((bending, d), (inertia, m))
    ]
    second = np.array(energies[0]) - omega**2 * np.array(energies[1])  # by noise, and between the sensors
    by_energy, by_frequency = stiffness_by_residual[:, diagonal] @ second.T, stiffness_by_residual @ by_omega
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
    """The eigensolution of an identified plate compared with the measurement, as `self_check` does.

    Frequencies hardly depend on D where the plate hardly bends, as at a free edge: its error may be larger there.

    Args:
        found: mass and stiffness.
        measured: the modes they were identified from, consecutive.
        poisson_ratio, edges: of the plate.
        first_mode: index of the first measured mode among all modes of the plate; 3 leaves out rigid-body modes.
        tolerance: of the frequencies of the eigenproblem.

    Raises:
        ValueError: modes of another domain, edges or a Poisson's ratio that no plate has.
    """
    if not isinstance(measured.domain, Rectangle):
        raise ValueError(f"m(x, y) and D(x, y) are those of a plate; these modes are on {measured.domain}")
    # Edges that no plate has are no fault of what was identified.
    sides = measured.domain.length
    plate = Plate(length=sides, mass_per_area=1.0, bending_stiffness=1.0, poisson_ratio=poisson_ratio, edges=edges)
    share = np.linspace(0.0, 1.0, PER_SIDE)
    grid = np.stack(np.meshgrid(*(side * share for side in sides), indexing="ij"), axis=-1)

    def built() -> Plate:
        return replace(plate, mass_per_area=found.mass.field, bending_stiffness=found.stiffness.field)

    return compared(built, measured, first_mode, tolerance, grid.reshape(-1, 2))
