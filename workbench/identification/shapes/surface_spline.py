"""Eigenfunctions over a rectangle from shapes at scattered sensors: polyharmonic splines and their error.

The spline through values v at places p_i is s(p) = Σ a_i |p - p_i|⁷ + a cubic: of all functions that take the values,
the one with the least energy of a derivative of order 4½ (Duchon 1977). Edge conditions are imposed at points along the
edges. For a function whose derivative is white of strength τ², the spline has the mean square error τ² κ(p), κ the
power function of the kernel (Wendland, Scattered Data Approximation, 2005, chapter 11); τ² is its upper confidence
limit given the values.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import factorial

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import null_space
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import chi2

from workbench.arrays import symmetric_root
from workbench.identification.shapes.bands import BANDS, Bands, deviation_and_width, propagated
from workbench.identification.signal.modal_estimates import ShapeEstimates, check_level, check_placed, normalised_shapes
from workbench.structure.domain import Rectangle
from workbench.structure.modes import Modes, SampledModes, frozen
from workbench.structure.profile import FieldLike, as_field
from workbench.structure.supports import SIDES
from workbench.threads import one_blas_thread

PER_EDGE = 11  # points of an edge at which its conditions are imposed
QUADRATURE = 49  # number of modes for which the integration points over the rectangle suffice
SAME_PLACE = 1e-6  # of the diagonal: sensors closer than this are at one place
POWER = 3.5  # of |p|², the kernel |p|⁷
CUBIC = tuple((i, j) for i in range(4) for j in range(4 - i))  # powers of x and y of zero energy
HELD_BY = {"simply supported": (0,), "clamped": (0, 1), "free": (), "guided": (1,)}

Functional = tuple[np.ndarray, tuple[int, int]]


def _kernel(offset: np.ndarray, derivative: tuple[int, int]) -> np.ndarray:
    """∂^(i+j) of |p|⁷ along x and y at offsets p (..., 2), by the chain rule in s = |p|²."""
    s = (offset**2).sum(axis=-1)
    derivative_values = np.zeros(s.shape)
    for k in range(derivative[0] // 2 + 1):
        for m in range(derivative[1] // 2 + 1):
            order = sum(derivative) - k - m
            factor, falling = np.ones(s.shape), np.prod(POWER - np.arange(order))
            for n, part, axis in ((derivative[0], k, 0), (derivative[1], m, 1)):
                factor = factor * factorial(n) / (factorial(part) * factorial(n - 2 * part))
                factor = factor * (2.0 * offset[..., axis]) ** (n - 2 * part)
            with np.errstate(divide="ignore", invalid="ignore"):
                derivative_values += np.where(s > 0, factor * falling * s ** (POWER - order), 0.0)
    return derivative_values


def _cubics(at: np.ndarray, derivative: tuple[int, int]) -> np.ndarray:
    """A derivative of every cubic monomial at places (n, 2): (n, 10)."""
    columns = np.ones((len(at), len(CUBIC)))
    for k, powers in enumerate(CUBIC):
        for axis, (power, order) in enumerate(zip(powers, derivative, strict=True)):
            below = power - order
            falling = np.prod(np.arange(power, below, -1)) if below >= 0 else 0.0
            columns[:, k] = columns[:, k] * falling * at[:, axis] ** max(below, 0)
    return columns


@dataclass(frozen=True, eq=False)
class SurfaceSpline:
    """The linear map from values at scattered places to a spline over a rectangle.

    Attributes:
        domain: the rectangle, m.
        places: (n_places, 2) of the values, m.
        edges: "simply supported", "clamped", "free" or "guided": one for all, or a mapping of left, right, bottom and
            top. They set the function or its slope to zero; a side that is left out has no condition. A sensor on an
            edge that holds the value at zero is not used.

    Raises:
        ValueError: fewer values and edge points than the ten of a cubic, two coincident places, a place outside.
    """

    domain: Rectangle
    places: np.ndarray
    edges: str | Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "places", frozen(self.domain.locate(self.places)))
        for side, edge in self._edge_of.items():
            if side not in SIDES or edge not in HELD_BY:
                raise ValueError(
                    f"edges are given by side, {', '.join(SIDES)}, as {', '.join(HELD_BY)}; got {side} {edge!r}"
                )
        gaps = np.linalg.norm(self.places[:, None] - self.places, axis=2) + np.eye(len(self.places)) * self.domain.size
        if gaps.min() < SAME_PLACE * self.domain.size:
            i, j = np.unravel_index(int(gaps.argmin()), gaps.shape)
            raise ValueError(f"sensors {i + 1} and {j + 1} are at one place, {self.places[i]} m; keep one of them")
        if np.linalg.matrix_rank(self._equations[:, -len(CUBIC) :]) < len(CUBIC):
            raise ValueError(
                f"{self._used.sum()} sensors and the edges do not determine a cubic over the rectangle, which takes"
                f" {len(CUBIC)} values, not on a line: add sensors, or name the edges that hold it"
            )

    @property
    def _edge_of(self) -> Mapping[str, str]:
        return dict.fromkeys(SIDES, self.edges) if isinstance(self.edges, str) else self.edges

    @cached_property
    def _used(self) -> np.ndarray:
        """Which places are not on an edge that holds the value at zero, (n_places,)."""
        used = np.ones(len(self.places), bool)
        for side in (side for side, edge in self._edge_of.items() if 0 in HELD_BY[edge]):
            axis, far = divmod(SIDES.index(side), 2)
            distance = np.abs(self.places[:, axis] - far * self.domain.length[axis])
            used &= distance > SAME_PLACE * self.domain.size
        return used

    @cached_property
    def _functionals(self) -> list[Functional]:
        """The sensors used, and points along the edges, each with a derivative that is zero there."""
        functionals: list[Functional] = [(self.places[self._used], (0, 0))]
        share = (np.arange(PER_EDGE) + 0.5) / PER_EDGE
        for side, edge in self._edge_of.items():
            axis, far = divmod(SIDES.index(side), 2)
            points = np.empty((PER_EDGE, 2))
            points[:, axis], points[:, 1 - axis] = far * self.domain.length[axis], share * self.domain.length[1 - axis]
            functionals += [(points, (order, 0) if axis == 0 else (0, order)) for order in HELD_BY[edge]]
        return functionals

    def _rows(self, at: np.ndarray, derivative: tuple[int, int]) -> np.ndarray:
        """Of a derivative at places: covariance with every functional for τ² = 1, and cubics, (n_at, n_values + 10).

        The diagonal is the unit of length.
        """
        columns = []
        for places, order in self._functionals:
            total = (derivative[0] + order[0], derivative[1] + order[1])
            offset = (at[:, None] - places) / self.domain.size
            columns.append((-1.0) ** sum(order) * _kernel(offset, total))
        return np.hstack([*columns, _cubics(at / self.domain.size, derivative)])

    @cached_property
    def _equations(self) -> np.ndarray:
        """[K, P]: the rows of all functionals, (n_values, n_values + 10)."""
        return np.vstack([self._rows(at, derivative) for at, derivative in self._functionals])

    @cached_property
    def _system(self) -> np.ndarray:
        """The inverse of [[K, P], [Pᵀ, 0]]."""
        n = len(self._equations)
        below = np.hstack([self._equations[:, n:].T, np.zeros((len(CUBIC),) * 2)])
        return np.linalg.inv(np.vstack([self._equations, below]))

    def matrix(self, at: np.ndarray, derivative: tuple[int, int] = (0, 0)) -> np.ndarray:
        """Values (or derivatives) at places (n_at, 2) per value at each sensor, (n_at, n_places)."""
        at = np.atleast_2d(at)
        rows, scale = self._rows(at, derivative), self.domain.size ** -sum(derivative)
        matrix = np.zeros((len(at), len(self.places)))
        matrix[:, self._used] = scale * (rows @ self._system)[:, : self._used.sum()]
        return matrix

    def error(self, at: np.ndarray, derivatives: Sequence[tuple[int, int]] = ((0, 0),)) -> np.ndarray:
        """Covariance of the interpolation error for τ² = 1, of one derivative after another at places (n_at, 2)."""
        offset = (at[:, None] - at) / self.domain.size
        prior_covariance = np.block([[(-1.0) ** (k + m) * _kernel(offset, (i + k, j + m)) for k, m in derivatives]
                                     for i, j in derivatives])  # fmt: skip
        rows = np.vstack([self._rows(at, d) for d in derivatives])
        scale = np.repeat([self.domain.size ** -sum(d) for d in derivatives], len(at))
        return np.asarray((prior_covariance - rows @ self._system @ rows.T) * np.outer(scale, scale))

    def roughness(self, values: np.ndarray, covariance: np.ndarray) -> float:
        """Upper confidence limit of τ² of values (n_places,) of known covariance; 0 where they may be noise.

        By the likelihood of the contrasts orthogonal to all cubics (restricted maximum likelihood), of which there must
        be one.
        """
        values, covariance = values[self._used], covariance[np.ix_(self._used, self._used)]
        n, size = values.size, len(self._equations)
        contrasts = null_space(self._equations[:, size:].T)
        if contrasts.size == 0:
            raise ValueError(
                f"{n} sensors determine a cubic over the rectangle and nothing beyond, from which its errors could be"
                " estimated: add a sensor"
            )
        noise = np.zeros((size, size))
        noise[:n, :n] = covariance
        scale = float(np.abs(values).max()) ** 2
        unit_covariance = contrasts.T @ self._equations[:, :size] @ contrasts
        noise_covariance = contrasts.T @ noise @ contrasts + 1e-24 * scale * np.eye(contrasts.shape[1])
        contrast_values = contrasts.T @ np.r_[values, np.zeros(size - n)]

        def cost(log_strength: float) -> float:
            total = noise_covariance + np.exp(log_strength) * unit_covariance
            sign, logarithm = np.linalg.slogdet(total)
            return float(logarithm + contrast_values @ np.linalg.solve(total, contrast_values)) if sign > 0 else 1e300

        mean_variance = float(np.trace(unit_covariance)) / len(contrast_values)
        span = np.log(scale / mean_variance) + np.array([-40.0, 25.0])
        best = minimize_scalar(cost, bounds=tuple(span), method="bounded")
        limit = best.fun + chi2.isf(2.0 * BANDS.error_probability, 1)
        if cost(span[0]) < limit:
            return 0.0
        return float(np.exp(brentq(lambda log_strength: cost(log_strength) - limit, best.x, span[1])))


@one_blas_thread
def surface_eigenfunctions(
    sampled: SampledModes,
    *,
    length: tuple[float, float],
    mass_per_area: FieldLike | None = None,
    edges: str | Mapping[str, str] | None = None,
    covariance: np.ndarray | None = None,
) -> Modes:
    """`Modes` over a rectangle from shapes at scattered sensors: real parts, interpolated, with ∫∫ m φ_r² dx dy = 1.

    Args:
        sampled: shapes of displacement, (n_outputs, n_modes), at sensors with places (x, y).
        length: (a, b), m.
        mass_per_area: kg/m², where known; without it the mean square of φ_r is 1.
        edges: edge conditions by side, as `SurfaceSpline` takes them.
        covariance: of (ω, ζ), carried along.

    `surface_bands` gives the error of the shapes between the sensors.

    Raises:
        ValueError: as `SurfaceSpline`; a sensor without a place, or with one of another kind; a negative mass.
    """
    spline, values = _scaled(sampled, length, mass_per_area, edges)
    return Modes(
        omega=sampled.omega,
        damping=sampled.zeta,
        shapes=lambda at, derivative: spline.matrix(at, derivative) @ values,
        domain=spline.domain,
        covariance=covariance,
    )


@dataclass(frozen=True, eq=False)
class SurfaceErrors:
    """Errors of frequencies and of the shapes of `surface_eigenfunctions`: noise and interpolation error.

    Attributes:
        spline: through the sensors.
        values: (n_places, n_modes) of the shapes at the sensors, largest 1.
        value_covariance: (n_modes, n_places, n_places) of these, by mode.
        roughness: (n_modes,) τ².
        omega_covariance: (n_modes, n_modes) of the frequencies, (rad/s)².
    """

    spline: SurfaceSpline
    values: np.ndarray
    value_covariance: np.ndarray
    roughness: np.ndarray
    omega_covariance: np.ndarray

    def select(self, modes: Sequence[int]) -> "SurfaceErrors":
        """The errors of some modes, by zero-based index."""
        index = list(modes)
        return replace(
            self,
            values=self.values[:, index],
            value_covariance=self.value_covariance[index],
            roughness=self.roughness[index],
            omega_covariance=self.omega_covariance[np.ix_(index, index)],
        )


@one_blas_thread
def surface_errors(
    found: ShapeEstimates, *, length: tuple[float, float], edges: str | Mapping[str, str] | None = None
) -> SurfaceErrors:
    """Errors of the eigenfunctions of `surface_eigenfunctions`, from the covariance of identified shapes.

    Args:
        found: modes and the covariances of frequencies and shapes, at sensors with places (x, y).
        length, edges: as `surface_eigenfunctions` takes them.

    Raises:
        ValueError: as `surface_eigenfunctions` and `SurfaceSpline.roughness`.
    """
    spline, _ = _scaled(found.modes, length, None, edges)
    values = normalised_shapes(found.modes.shapes).real
    roughness = [spline.roughness(v, noise) for v, noise in zip(values.T, found.shape_covariance, strict=True)]
    n = found.modes.n_modes
    return SurfaceErrors(
        spline, frozen(values), frozen(found.shape_covariance), frozen(roughness), frozen(found.covariance[:n, :n])
    )


@one_blas_thread
def surface_bands(
    found: ShapeEstimates,
    at: ArrayLike,
    *,
    length: tuple[float, float],
    mass_per_area: FieldLike | None = None,
    edges: str | Mapping[str, str] | None = None,
    level: float = 0.95,
    seed: int | np.random.Generator = 0,
) -> Bands:
    """Confidence bands of the eigenfunctions of `surface_eigenfunctions`, at places (n_points, 2), m.

    Errors of the values and of the interpolation change them as along an interval (`eigenfunction_bands`).

    Args:
        found: modes and the covariance of their shapes, such as `identify_driven` gives, at sensors with places (x, y).
        at: (n_points, 2) m.
        length, mass_per_area, edges: as `surface_eigenfunctions` takes them.
        level: between 0 and 1.
        seed: of the Monte Carlo samples for the simultaneous band.

    Raises:
        ValueError: a level outside 0..1; as `surface_eigenfunctions` and `SurfaceSpline.roughness`.
    """
    check_level(level)
    sampled = found.modes
    spline, scaled = _scaled(sampled, length, mass_per_area, edges)
    at, rng = spline.domain.locate(at), np.random.default_rng(seed)
    x, weights = _weighted(spline.domain, mass_per_area)
    root = _root(spline.error(np.vstack([at, x])))
    here, inside = (spline.matrix(at), root[: len(at)]), (spline.matrix(x), root[len(at) :])
    phi, std, interpolation = (np.zeros((len(at), sampled.n_modes)) for _ in range(3))
    width = np.zeros(sampled.n_modes)
    values = normalised_shapes(sampled.shapes).real
    for r in range(sampled.n_modes):
        factor = scaled[:, r] @ values[:, r] / (values[:, r] @ values[:, r])  # 1 / √q
        value_covariance = found.shape_covariance[r] * factor**2
        phi[:, r], jacobian, error = propagated(scaled[:, r], here, inside, weights)
        error *= np.sqrt(spline.roughness(scaled[:, r], value_covariance))
        interpolation[:, r] = np.linalg.norm(error, axis=1)
        noise = jacobian @ _root(value_covariance)
        std[:, r], width[r] = deviation_and_width(np.hstack([noise, error]), level, rng)
    return Bands(frozen(at), frozen(phi), frozen(std), frozen(interpolation), frozen(width), level)


def _scaled(
    sampled: SampledModes,
    length: tuple[float, float],
    mass_per_area: FieldLike | None,
    edges: str | Mapping[str, str] | None,
) -> tuple[SurfaceSpline, np.ndarray]:
    """The spline, and values (n_outputs, n_modes) at the sensors of mass-normalised shapes."""
    check_placed(sampled)
    if sampled.positions.ndim != 2:
        raise ValueError("eigenfunctions over a rectangle take sensors with places (x, y), m; give their channels `at`")
    spline = SurfaceSpline(Rectangle(length), sampled.positions, edges or {})
    values = normalised_shapes(sampled.shapes).real
    x, weights = _weighted(spline.domain, mass_per_area)
    return spline, frozen(values / np.sqrt(weights @ (spline.matrix(x) @ values) ** 2))


def _weighted(domain: Rectangle, mass_per_area: FieldLike | None) -> tuple[np.ndarray, np.ndarray]:
    """Integration points (n, 2), m, and the mass that each represents."""
    x, weights = domain.quadrature(QUADRATURE)
    density = as_field(1.0 / float(np.prod(domain.length)) if mass_per_area is None else mass_per_area)
    values = density(x[:, 0], x[:, 1])
    negative = ~(values >= 0.0)
    if negative.any():
        at = ", ".join(f"{each:g}" for each in x[negative][0])
        raise ValueError(f"mass_per_area is {values[negative][0]:g} at (x, y) = ({at}); it must be 0 or more")
    return x, weights * values


def _root(covariance: np.ndarray) -> np.ndarray:
    """R with R Rᵀ the covariance, whose eigenvalues rounding may have made slightly negative."""
    return symmetric_root(0.5 * (covariance + covariance.T))
