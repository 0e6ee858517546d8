"""Eigenfunctions from shapes at the sensors (3.4), by splines that satisfy the boundary conditions.

An interpolating spline of odd degree d has d - 1 further degrees of freedom, shared by its two ends. The boundary
conditions of an end (zero value and curvature at a hinge, zero curvature and its slope at a free end) take some of
them; the others are removed by leaving out the knots nearest to that end ("not a knot"), which assumes nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast
from warnings import warn

import numpy as np
from scipy.interpolate import BSpline

from workbench.identification.signal.modal_estimates import check_finite, check_placed, normalised_shapes
from workbench.structure.domain import Interval, gauss_between
from workbench.structure.modes import Modes, SampledModes, frozen
from workbench.structure.profile import ProfileLike, as_profile
from workbench.structure.supports import PointMass
from workbench.threads import one_blas_thread

# In section 4.4 each two degrees more divide the error of the lowest eigenfunctions by ten, and increase that of the
# highest, which vary too fast for their sensors, at the ends. So the degree of each mode is chosen by cross-validation
# of the inner sensors.
DEFAULT_DEGREES = (3, 5, 7, 9)

ZERO_AT = {
    ("bar", "fixed"): (0,),
    ("bar", "free"): (1,),
    ("beam", "hinged"): (0, 2),
    ("beam", "clamped"): (0, 1),
    ("beam", "sliding"): (1, 3),
    ("beam", "free"): (2, 3),
}
ESSENTIAL_BELOW = {"bar": 1, "beam": 2}


@dataclass(frozen=True)
class BoundaryConditions:
    """Boundary conditions: where an eigenfunction, or a derivative of it, is zero, ((x, derivative), ...).

    Attributes:
        zeros: all of them.
        essential: those that a support enforces on every motion.
    """

    zeros: tuple[tuple[float, int], ...] = ()
    essential: tuple[tuple[float, int], ...] = ()

    @classmethod
    def of(cls, kind: str, *, length: float, left: str | None = None, right: str | None = None) -> "BoundaryConditions":
        """The conditions of "fixed" or "free" bar ends, or "hinged", "clamped", "sliding" or "free" beam ends.

        An end left as None is unknown. Leave a free end out where the stiffness vanishes there: no condition holds
        then.

        Raises:
            ValueError: an end of unknown name.
        """
        zeros = []
        for at, end in ((0.0, left), (float(length), right)):
            if end is None:
                continue
            if (kind, end) not in ZERO_AT:
                known = ", ".join(f"{e} {k}" for k, e in ZERO_AT)
                raise ValueError(f"no boundary condition of a {kind!r} is called {end!r}; there are {known}")
            zeros += [(at, derivative) for derivative in ZERO_AT[kind, end]]
        return cls(tuple(zeros), tuple((at, d) for at, d in zeros if d < ESSENTIAL_BELOW[kind]))


@dataclass(frozen=True, eq=False)
class Spline:
    """The linear map from values at the sensors to a spline along the structure."""

    knots: np.ndarray  # (n_functions + degree + 1,) of the B-splines, m
    degree: int  # odd
    weights: np.ndarray  # (n_functions, n_sensors): coefficients = weights @ values
    conditions: tuple[tuple[float, int], ...]  # boundary conditions used, (x, derivative) each
    held_weights: np.ndarray  # (n_functions, n_conditions): change of the coefficients per unit value of each condition

    def matrix(self, x: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Values (or derivatives) at x per value at each sensor, (n_points, n_sensors)."""
        if derivative > self.degree:
            return np.zeros((np.size(x), self.weights.shape[1]))
        return np.asarray(BSpline(self.knots, self.weights, self.degree)(np.atleast_1d(x), derivative))

    def of_held(self, x: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Change of the values at x per unit value of each boundary condition, (n_points, n_conditions)."""
        return np.asarray(BSpline(self.knots, self.held_weights, self.degree)(np.atleast_1d(x), derivative))


def interpolating_spline(
    positions: Sequence[float] | np.ndarray,
    *,
    length: float,
    ends: BoundaryConditions = BoundaryConditions(),
    degree: int,
) -> Spline:
    """The spline through values at the sensors that satisfies the boundary conditions.

    Args:
        positions: (n_sensors,) m, all different; a sensor where the value is held at zero is not used.
        length: m.
        ends: boundary conditions; at most (degree - 1) / 2 derivatives an end are used, lowest first.
        degree: 1, 3, 5, ...

    Raises:
        ValueError: an even degree, too few sensors for it, sensors outside, unplaced or at one place, a boundary
            condition that is at no end.
    """
    at_sensors = np.asarray(positions, float)
    _check_places(at_sensors, length, degree)
    slack = 1e-9 * length
    for at, _ in ends.zeros:
        if min(abs(at), abs(at - length)) > slack:
            raise ValueError(
                f"a boundary condition holds at x = {at:g}, which is no end of the structure, 0 to {length:g};"
                " give both the same length"
            )
    conditions = _usable(ends.zeros, degree, length)
    held_places = np.array([at for at, derivative in conditions if derivative == 0])
    used = (np.abs(at_sensors[:, None] - held_places) > slack).all(axis=1)
    sites = np.union1d(at_sensors[used], held_places)
    derivatives = [(at, d) for at, d in conditions if d > 0]
    n_functions = sites.size + len(derivatives)
    if n_functions < degree + 1:
        raise ValueError(
            f"a spline of degree {degree} needs {degree + 1} values or known ends; there are {n_functions}:"
            f" add sensors or take degree {max(1, n_functions - 1 - n_functions % 2)}"
        )
    knots = _knots(sites, derivatives, length, degree)
    basis = BSpline(knots, np.eye(n_functions), degree)
    rows = [basis(at_sensors[used])] + [basis(at, d)[None] * length**d for at, d in conditions]
    inverse = np.linalg.inv(np.vstack(rows))
    weights = np.zeros((n_functions, at_sensors.size))
    weights[:, used] = inverse[:, : used.sum()]
    powers = float(length) ** np.array([d for _, d in conditions])
    return Spline(frozen(knots), degree, frozen(weights), tuple(conditions), frozen(inverse[:, used.sum() :] * powers))


@one_blas_thread
def eigenfunctions(
    sampled: SampledModes,
    *,
    length: float,
    mass_per_length: ProfileLike | None = None,
    point_masses: Sequence[PointMass] = (),
    driven_at: float | None = None,
    ends: BoundaryConditions = BoundaryConditions(),
    degree: int | None = None,
    covariance: np.ndarray | None = None,
) -> Modes:
    """`Modes` from `SampledModes`: real parts of the shapes, interpolated and scaled.

    The scale comes from one of two things. A known mass distribution gives ∫ m φ_r² dx + Σ_k M_k φ_r(x_k)² = 1. A unit
    impulse at x0, with shapes that carry the amplitude s_r of the decay after it (`modal_amplitudes`), gives
    φ_r(x) φ_r(x0) = i s_r(x) ω_dr, so φ_r(x) = i s_r(x) ω_dr / (i s_r(x0) ω_dr)^½ without any knowledge of the mass.

    Args:
        sampled: shapes of displacement, (n_outputs, n_modes).
        length: m.
        mass_per_length: kg/m, where known; without it and without `driven_at` the shapes keep ∫ φ_r² dx = length.
        point_masses: attached masses; a heavy one left out makes the scale of every shape wrong by up to 30 %.
        driven_at: x0 of a unit impulse at t = 0 that caused `sampled`, m.
        ends: boundary conditions, taken as exact. An end on springs has only those that it holds at zero.
        degree: of the splines, odd; chosen mode by mode as in `best_degrees` unless given.
        covariance: of (ω, ζ), carried along where `refine` gave one.

    `eigenfunction_bands` gives the interpolation error of a spline between and beyond its sensors. Where that is too
    large, take the eigenfunctions of `choose_structure(...).structure`, which model springs and masses.

    Raises:
        ValueError: as `interpolating_spline`; both ways of scaling at once; a negative mass; point masses outside, or
            without a mass distribution; an impulse at a node of a mode.
    """
    if mass_per_length is not None and driven_at is not None:
        raise ValueError("modes are scaled by the mass distribution or by a driving point, not by both; give one")
    splines = Splines.through(sampled, length=length, ends=ends, degree=degree)
    if driven_at is None:
        values = normalised_shapes(sampled.shapes).real
        for spline, members in splines.groups:
            weights, rule, _ = mass_quadrature(spline, length, mass_per_length, point_masses)
            values[:, members] /= np.sqrt(weights @ (rule @ values[:, members]) ** 2)
    else:
        values = _scaled_by_impulse(sampled, splines, driven_at)
    values = frozen(values)
    return Modes(
        omega=sampled.omega,
        damping=sampled.zeta,
        shapes=lambda x, derivative: splines(values, x, derivative),
        domain=Interval(length),
        essential=ends.essential,
        covariance=covariance,
        masses=tuple(point_masses),
    )


def best_degrees(
    sampled: SampledModes, *, length: float, ends: BoundaryConditions = BoundaryConditions()
) -> np.ndarray:
    """The spline degree among 3, 5, 7 and 9 that best predicts each inner sensor from the others, (n_modes,)."""
    check_along(sampled)
    values = normalised_shapes(sampled.shapes).real
    order = np.argsort(sampled.positions)
    errors = []
    for degree in DEFAULT_DEGREES:
        squares = np.zeros(sampled.n_modes)
        try:
            for j in order[1:-1]:
                others = np.arange(sampled.n_outputs) != j
                spline = interpolating_spline(sampled.positions[others], length=length, ends=ends, degree=degree)
                squares += (spline.matrix(sampled.positions[j])[0] @ values[others] - values[j]) ** 2
        except ValueError:
            break  # too few sensors for this degree, and so for any higher one
        errors.append(squares)
    best = np.argmin(errors, axis=0) if errors else np.zeros(sampled.n_modes, int)
    return np.asarray(np.array(DEFAULT_DEGREES)[best])


@dataclass(frozen=True, eq=False)
class Splines:
    """The spline of each mode, grouped by degree: [(spline, modes), ...]."""

    groups: tuple[tuple[Spline, np.ndarray], ...]

    @classmethod
    def through(
        cls, sampled: SampledModes, *, length: float, ends: BoundaryConditions, degree: int | None
    ) -> "Splines":
        check_along(sampled)
        options: dict[str, Any] = {"length": length, "ends": ends}
        degrees = best_degrees(sampled, **options) if degree is None else np.full(sampled.n_modes, degree)
        each = [(int(d), np.flatnonzero(degrees == d)) for d in np.unique(degrees)]
        groups = tuple((interpolating_spline(sampled.positions, degree=d, **options), modes) for d, modes in each)
        if not any(spline.weights.any() for spline, _ in groups):
            raise ValueError("all sensors are at ends that hold the value at zero; add one between the ends")
        return cls(groups)

    def __call__(self, values: np.ndarray, x: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Splines through values (n_sensors, n_modes), at x: (n_points, n_modes)."""
        result = np.zeros((np.size(x), values.shape[1]))
        for spline, modes in self.groups:
            result[:, modes] = spline.matrix(x, derivative) @ values[:, modes]
        return result


def mass_quadrature(
    spline: Spline, length: float, mass_per_length: ProfileLike | None, point_masses: Sequence[PointMass]
) -> tuple[np.ndarray, np.ndarray, tuple[tuple[np.ndarray, int], ...]]:
    """∫ m φ² dx + Σ (M_k φ² + J_k φ'²) of splines φ = W v as Σ weights (rule v)²: a sum of squares does not cancel.

    The weights (n_terms,); the rule (n_terms, n_sensors), φ or φ' per value at each sensor; and the places of the
    terms, (n_places,) m, with the order of the derivative, in turn.
    """
    if mass_per_length is None and len(point_masses):
        raise ValueError("point masses are used beside a mass distribution; give mass_per_length too")
    at = np.array([cast(float, point.at) for point in point_masses])
    outside = (at < 0.0) | (at > length)
    if outside.any():
        raise ValueError(f"the point mass at x = {at[outside][0]:g} lies outside the structure, 0 to {length:g}")
    density = as_profile(1.0 / length if mass_per_length is None else mass_per_length)
    breaks = [b for b in density.breaks if 0 < b < length]
    # exact for the product of two splines and a cubic mass
    x, weights = gauss_between(np.unique(np.concatenate([spline.knots, breaks])), spline.degree + 3)
    places = (x, 0), (at, 0), (at, 1)
    rule = np.vstack([spline.matrix(where, derivative) for where, derivative in places])
    masses, inertias = np.reshape([point.pair for point in point_masses], (-1, 2)).T
    values = density(x)
    negative = ~(values >= 0.0)
    if negative.any():
        raise ValueError(f"mass_per_length is {values[negative][0]:g} at x = {x[negative][0]:g}; it must be 0 or more")
    return np.concatenate([weights * values, masses, inertias]), rule, places


def check_along(sampled: SampledModes) -> None:
    """Refuse, by a ValueError, sensors that are not all placed along an interval."""
    check_placed(sampled)
    if not sampled.on_interval:
        raise ValueError(
            "the sensors have no places along a bar or beam; on a plate take `surface_eigenfunctions`, at named points"
            " `rig_from`"
        )


def _check_places(positions: np.ndarray, length: float, degree: int) -> None:
    if degree < 1 or degree % 2 == 0:
        raise ValueError(f"a spline through sensors has an odd degree; got {degree}")
    slack = 1e-9 * length
    outside = ~((positions >= -slack) & (positions <= length + slack))
    if outside.any():
        raise ValueError(f"the sensor at x = {positions[outside][0]:g} lies outside the structure, 0 to {length:g}")
    ordered = np.sort(positions)
    coincident = np.diff(ordered) <= 1e-6 * length
    if coincident.any():
        raise ValueError(f"two sensors are at x = {ordered[:-1][coincident][0]:g}; keep one of them")


def _usable(zeros: Sequence[tuple[float, int]], degree: int, length: float) -> list[tuple[float, int]]:
    """Conditions that a spline can take: of each end the value and the (degree - 1) / 2 lowest derivatives at most."""
    kept = []
    for end in (0.0, length):
        orders = sorted(d for at, d in zeros if abs(at - end) <= 1e-9 * length and d < degree)
        kept += [(end, d) for d in orders[: (degree - 1) // 2 + (0 in orders)]]
    return kept


def _knots(sites: np.ndarray, derivatives: list[tuple[float, int]], length: float, degree: int) -> np.ndarray:
    """Knots at the inner sites, except those nearest to each end that its conditions do not determine."""
    slack = 1e-9 * length
    inner = sites[(sites > slack) & (sites < length - slack)]
    known_left = sum(at == 0.0 for at, _ in derivatives) + int(sites[0] <= slack)
    # An end with its value and (degree - 1) / 2 derivatives known keeps every inner site as a knot.
    left = (degree + 1) // 2 - known_left
    wanted = sites.size + len(derivatives) - degree - 1
    return np.asarray(np.r_[[0.0] * (degree + 1), inner[left : left + wanted], [length] * (degree + 1)])


def _scaled_by_impulse(sampled: SampledModes, splines: Splines, x0: float) -> np.ndarray:
    check_finite(sampled.shapes)
    omega_d = np.abs(sampled.poles.imag)
    products = (1j * sampled.shapes * omega_d).real
    at_impulse = splines(products, np.array([x0]))[0]
    weak = at_impulse <= 1e-3 * np.abs(products).max(axis=0)
    if weak.any():
        raise ValueError(
            f"the impulse at x = {x0:g} hardly excites mode {int(np.argmax(weak)) + 1}"
            f" ({sampled.frequencies_hz[weak][0]:.4g} Hz), so it cannot scale it; scale by the mass instead, or leave"
            " that mode out"
        )
    values = products / np.sqrt(at_impulse)
    first_significant = np.argmax(np.abs(values) > 0.05 * np.abs(values).max(axis=0), axis=0)
    return np.asarray(values * np.sign(values[first_significant, np.arange(values.shape[1])]))


def __getattr__(name: str) -> object:
    if name != "KnownEnds":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    warn("KnownEnds is now BoundaryConditions; the old name goes with the next version", DeprecationWarning, 2)
    return BoundaryConditions
