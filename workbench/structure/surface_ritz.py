"""The Rayleigh-Ritz method over a rectangle: modes of a plate or membrane, refined until they stand.

Where the solution is singular, polynomials alone converge slowly. Towards a corner between a clamped and a free edge
the segments shrink geometrically, and the frequencies converge exponentially all the same (Szabó & Babuška, Finite
Element Analysis, 1991, sections 10.3 and 10.4). Beside a point mass or spring a plate moves as r² ln r; there the
static response to a force at the point, solved once on segments that shrink towards it, joins the polynomials as one
more function (residual attachment modes; Craig & Chang, AIAA J. 15, 1977).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, eigh

from workbench.structure.surface_basis import (
    Axis,
    Functions,
    SurfaceProblem,
    Weight,
    assemble,
    axes_of,
    common_grid,
    edge_matrix,
    mass_square,
    point_row,
    products,
    weights_on,
)

WORTH = 4  # functions for each further mode that they give well enough
MOST_FUNCTIONS = 3000  # of the eigenvalue problem: so many take ten seconds
MOST_STATIC = 5000  # of a static response: a Cholesky factor only
RIGID = 1e-12  # of the scale of ω²: below it a mode moves as a rigid body
REPEATED = 1e-9  # relative difference of ω² below which modes count as repeated
UNSTABLE = "the tension compresses the surface beyond buckling: an eigenvalue ω² is negative; lower its magnitude"


@dataclass(frozen=True, eq=False)
class SurfaceModes:
    """Solved modes, mass-normalised.

    Attributes:
        omega: (n_modes,) rad/s, not decreasing.
        parts: functions (k of them) and their shares (k, n_modes) in the modes.
        error: of the frequencies, relative, by their change at the last refinements.
    """

    omega: np.ndarray
    parts: tuple[tuple[Functions, np.ndarray], ...]
    error: float

    def shapes(self, places: np.ndarray, derivatives: tuple[int, int] = (0, 0)) -> np.ndarray:
        """(n_places, n_modes) ∂_x^i ∂_y^j φ at places (n_places, 2), with (i, j) = derivatives."""
        total = np.zeros((places.shape[0], self.omega.size))
        for functions, shares in self.parts:
            total += functions.at(places, derivatives) @ shares
        return total

    def products(self, weight: Weight, derivatives: tuple[int, int] = (0, 0)) -> np.ndarray:
        """(n_modes, n_modes) ∫ weight ∂φ_r ∂φ_s dA."""
        x_axis, y_axis = self.parts[0][0].x_axis, self.parts[0][0].y_axis
        values = np.zeros((1, 1, 1))
        for functions, shares in self.parts:
            values = values + functions.on_grid(x_axis, y_axis, derivatives) @ shares
        shares = weights_on(weight, x_axis, y_axis)
        return np.asarray(np.einsum("qpr,qp,qps->rs", values, shares, values, optimize=True))


def solve(problem: SurfaceProblem, n_modes: int, *, tolerance: float, beyond: int = 0) -> SurfaceModes:
    """The lowest modes, refined until the frequencies are known to `tolerance`, relative.

    Args:
        beyond: so many further ones at most, as the functions have them that give those asked for.

    Raises:
        ValueError: the tolerance is not reached with `MOST_FUNCTIONS` functions, by how much; buckling.
    """
    before, change, error = np.zeros(0), np.inf, np.inf
    for level in range(20):
        axes = axes_of(problem, n_modes, level)
        if axes[0].n * axes[1].n > MOST_FUNCTIONS:
            break
        statics = [_static_response(problem, point.at, level) for point in problem.points]
        if None in statics:
            break
        found = _ritz(problem, axes, tuple(s for s in statics if s is not None), n_modes)
        if before.size:
            elastic = (found.omega > 0) & (before > 0)
            last, change = change, float(np.abs(found.omega[elastic] / before[elastic] - 1.0).max(initial=0.0))
            error = _remaining(change, last)
            if error <= tolerance:
                further = min(beyond, axes[0].n * axes[1].n // WORTH - n_modes)
                if further > 0:
                    found = _ritz(problem, axes, tuple(s for s in statics if s is not None), n_modes + further)
                return replace(found, error=error)
        before = found.omega
    if not np.isfinite(error):
        raise ValueError(
            f"{n_modes} modes need more than {MOST_FUNCTIONS} polynomials for their error to be known; ask for fewer"
        )
    raise ValueError(
        f"the {n_modes} lowest frequencies are known to {error:.1e} only with {MOST_FUNCTIONS} polynomials; the"
        f" tolerance is {tolerance:.1e}: ask for fewer modes, give tolerance={2.0 * error:.0e}, or"
        " name the jumps of a field with Field(function, x_breaks, y_breaks)"
    )


def _remaining(change: float, last: float) -> float:
    """The error of the frequencies after a refinement that changed them by `change`, the one before by `last`.

    They converge geometrically; the ratio is not taken to be better than 0.3.
    """
    ratio = max(change / last, 0.3)
    return change if not np.isfinite(last) or ratio > 0.5 else change * ratio / (1.0 - ratio)


def _static_response(problem: SurfaceProblem, at: tuple[float, float], level: int) -> Functions | None:
    """The response (K + σ M)⁻¹ to a force at a point, of unit energy; None where it needs too many functions."""
    x_axis, y_axis = axes_of(problem, 2, level, near=at)
    if x_axis.n * y_axis.n > MOST_STATIC:
        return None
    matrix = assemble((*problem.squares, mass_square(problem, problem.scale)), x_axis, y_axis)
    matrix += edge_matrix(problem.edges, x_axis, y_axis)
    try:
        factor = cho_factor(matrix, overwrite_a=True, check_finite=False)
    except LinAlgError as error:
        raise ValueError(UNSTABLE) from error
    row = point_row(x_axis, y_axis, at)
    response = cho_solve(factor, row)
    response /= np.sqrt(row @ response)  # of unit energy, so that the matrices stay well scaled
    return Functions(x_axis, y_axis, response.reshape(x_axis.n, y_axis.n, 1))


def _ritz(
    problem: SurfaceProblem, axes: tuple[Axis, Axis], statics: tuple[Functions, ...], n_modes: int
) -> SurfaceModes:
    """Modes in the products of polynomials and the static responses to forces at the points."""
    mass = assemble((mass_square(problem),), *axes)
    stiffness = assemble(problem.squares, *axes) + edge_matrix(problem.edges, *axes) + problem.scale * mass
    n = mass.shape[0]
    if n_modes > n:
        raise ValueError(f"{n_modes} modes asked of {n} functions")
    if statics:
        mass, stiffness = _with_points(problem, axes, statics, mass, stiffness)
    # M v = ν (K + σ M) v: the largest ν are the lowest modes, so that round-off is relative to them
    try:
        inverse, vectors = eigh(mass, stiffness, subset_by_index=[mass.shape[0] - n_modes, mass.shape[0] - 1])
    except LinAlgError as error:
        raise ValueError(UNSTABLE) from error
    inverse, vectors = inverse[::-1], vectors[:, ::-1]
    vectors = vectors / np.sqrt(np.sum(vectors * (mass @ vectors), axis=0))
    # contiguous: products with functions at places would copy them each time
    shares = np.ascontiguousarray(vectors[:n])
    functions = Functions(*axes, shares.reshape(axes[0].n, axes[1].n, n_modes))
    parts = [(functions, np.eye(n_modes)), *((s, vectors[n + i : n + i + 1]) for i, s in enumerate(statics))]
    # from the derivatives themselves, where all functions are polynomials on one grid: no digit is lost
    values = 1.0 / inverse - problem.scale if statics else functions.energies(problem)
    if (values < -1e-7 * problem.scale).any():
        raise ValueError(UNSTABLE)
    values = np.where(values < RIGID * problem.scale, 0.0, values)
    order = np.argsort(values, kind="stable")
    found = _shared(SurfaceModes(np.sqrt(values), tuple(parts), np.inf), np.eye(n_modes)[:, order])
    found = replace(found, omega=np.sqrt(values[order]))
    found = _shared(found, _uncoupling(found, problem))
    return _shared(found, np.diag(_signs(found, problem)))


def _with_points(
    problem: SurfaceProblem,
    axes: tuple[Axis, Axis],
    statics: tuple[Functions, ...],
    mass: np.ndarray,
    stiffness: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """M and K + σ M with the static responses as further functions, and with the masses and springs at the points."""
    grid = common_grid(axes, *((s.x_axis, s.y_axis) for s in statics))
    whole = (*problem.squares, mass_square(problem, problem.scale))
    beside, among = products(problem.edges, whole, axes, statics, grid)
    mass_beside, mass_among = products((), (mass_square(problem),), axes, statics, grid)
    stiffness = np.block([[stiffness, beside], [beside.T, among]])
    mass = np.block([[mass, mass_beside], [mass_beside.T, mass_among]])
    for point in problem.points:
        place = np.array([point.at])
        row = np.r_[point_row(*axes, point.at), np.hstack([s.at(place)[0] for s in statics])]
        mass += point.mass * np.outer(row, row)
        stiffness += (point.stiffness + problem.scale * point.mass) * np.outer(row, row)
    return mass, stiffness


def _shared(found: SurfaceModes, rotation: np.ndarray) -> SurfaceModes:
    return replace(found, parts=tuple((functions, shares @ rotation) for functions, shares in found.parts))


def _uncoupling(found: SurfaceModes, problem: SurfaceProblem) -> np.ndarray:
    """The rotation (n_modes, n_modes) of repeated modes among themselves that makes their slopes orthogonal.

    Any basis of their space is as good; this one does not depend on round-off. Slopes along x count twice those along
    y, so that the rotations of a free plate are apart.
    """
    rotation = np.eye(found.omega.size)
    values = found.omega**2
    joins = np.flatnonzero(np.abs(np.diff(values)) <= REPEATED * values[1:])
    if not joins.size:
        return rotation
    a, b = problem.length
    slopes = found.products(lambda x, y: a**2 + 0 * x * y, (1, 0))
    slopes = slopes + found.products(lambda x, y: 0.5 * b**2 + 0 * x * y, (0, 1))
    for cluster in np.split(joins, np.flatnonzero(np.diff(joins) > 1) + 1):
        index = slice(cluster[0], cluster[-1] + 2)
        rotation[index, index] = eigh(slopes[index, index])[1]
    return rotation


def _signs(found: SurfaceModes, problem: SurfaceProblem) -> np.ndarray:
    """+1 or -1 a mode, so that it is positive where it first moves on a curved way from the corner (0, 0)."""
    share = np.linspace(0.02, 0.98, 49)
    way = np.column_stack([share * problem.length[0], share**1.618 * problem.length[1]])
    values = found.shapes(way)
    moves = np.abs(values) > 0.02 * np.abs(values).max(axis=0)
    return np.where(values[moves.argmax(axis=0), np.arange(values.shape[1])] < 0, -1.0, 1.0)
