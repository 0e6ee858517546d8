"""The Rayleigh-Ritz method over a rectangle: modes of a plate or membrane, refined until their frequencies converge.

Where the solution is singular, polynomials alone converge slowly. Towards a corner between a clamped and a free edge
the segments shrink geometrically, with which the frequencies converge exponentially (Szabó & Babuška, Finite Element
Analysis, 1991, sections 10.3 and 10.4). Near a point mass or spring the deflection of a plate varies as r² ln r. There
the static response to a force at the point, solved once on segments that shrink towards it, is added as a further
function (residual attachment modes; Craig & Chang, AIAA J. 15, 1977).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, eigh

from workbench.structure.profile import Field
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
from workbench.threads import one_blas_thread

WORTH = 4  # functions per further mode of sufficient accuracy
MOST_FUNCTIONS = 3000  # of the eigenvalue problem, which then takes ten seconds
MOST_STATIC = 5000  # of a static response, by a Cholesky factor
RIGID = 1e-12  # of the scale of ω²: a lower value is that of a rigid-body mode
REPEATED = 1e-9  # relative difference of ω² below which modes count as repeated
UNSTABLE = (
    "an eigenvalue ω² of the surface is negative: a tension compresses it beyond buckling, or a spring of negative"
    " stiffness is too strong; lower its magnitude"
)


@dataclass(frozen=True, eq=False)
class SurfaceModes:
    """Solved modes, mass-normalised.

    Attributes:
        omega: (n_modes,) rad/s, not decreasing.
        parts: (functions, coefficients): k functions and their coefficients (k, n_modes) in the modes.
    """

    omega: np.ndarray
    parts: tuple[tuple[Functions, np.ndarray], ...]

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


@one_blas_thread
def solve(problem: SurfaceProblem, n_modes: int, *, tolerance: float, beyond: int = 0) -> SurfaceModes:
    """The lowest modes, refined until the frequencies converge to a relative `tolerance`.

    Up to `beyond` further modes are computed with the same functions. Buckling, and a tolerance that is not reached
    with `MOST_FUNCTIONS` functions, raise a `ValueError`.
    """
    before, change, error = np.zeros(0), np.inf, np.inf
    for level in range(20):
        axes = axes_of(problem, n_modes, level)
        if axes[0].n * axes[1].n > MOST_FUNCTIONS:
            break
        near = [axes_of(problem, 2, level, near=point.at) for point in problem.points]
        if any(x.n * y.n > MOST_STATIC for x, y in near):
            break
        statics = tuple(_static_response(problem, point.at, *each) for point, each in zip(problem.points, near))
        modes = _ritz(problem, axes, statics, n_modes)
        if before.size:
            elastic = (modes.omega > 0) & (before > 0)
            last, change = change, float(np.abs(modes.omega[elastic] / before[elastic] - 1.0).max(initial=0.0))
            error = _remaining(change, last)
            if error <= tolerance:
                further = min(beyond, axes[0].n * axes[1].n // WORTH - n_modes)
                return modes if further <= 0 else _ritz(problem, axes, statics, n_modes + further)
        before = modes.omega
    if not np.isfinite(error):
        raise ValueError(
            f"{n_modes} modes need more than {MOST_FUNCTIONS} polynomials for an estimate of their error; ask for fewer"
        )
    raise ValueError(
        f"the {n_modes} lowest frequencies are known to {error:.1e} only with {MOST_FUNCTIONS} polynomials; the"
        f" tolerance is {tolerance:.1e}: ask for fewer modes, give tolerance={2.0 * error:.0e}, or"
        " name the jumps of a field with Field(function, x_breaks, y_breaks)"
    )


def _remaining(change: float, last: float) -> float:
    """The estimated error of the frequencies after a refinement that changed them by `change`, the previous by `last`.

    Convergence is geometric, with a ratio of 0.3 or more assumed.
    """
    ratio = max(change / last, 0.3)
    return change if not np.isfinite(last) or ratio > 0.5 else change * ratio / (1.0 - ratio)


def _static_response(problem: SurfaceProblem, at: tuple[float, float], x_axis: Axis, y_axis: Axis) -> Functions:
    """The response (K + σ M)⁻¹ to a force at a point, of unit energy."""
    matrix = assemble((*problem.squares, mass_square(problem, problem.scale)), x_axis, y_axis)
    matrix += edge_matrix(problem.springs, x_axis, y_axis)
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
    """Modes in the space of polynomial products and static responses to forces at the points."""
    mass = assemble((mass_square(problem),), *axes)
    stiffness = assemble(problem.squares, *axes) + edge_matrix(problem.springs, *axes) + problem.scale * mass
    n = mass.shape[0]
    if n_modes > n:
        raise ValueError(f"{n_modes} modes requested of {n} functions")
    if statics:
        mass, stiffness = _with_points(problem, axes, statics, mass, stiffness)
    # M v = ν (K + σ M) v: the largest ν are the lowest modes, so that round-off is relative to them
    try:
        inverse, vectors = eigh(mass, stiffness, subset_by_index=[mass.shape[0] - n_modes, mass.shape[0] - 1])
    except LinAlgError as error:
        raise ValueError(UNSTABLE) from error
    inverse, vectors = inverse[::-1], vectors[:, ::-1]
    vectors = vectors / np.sqrt(np.sum(vectors * (mass @ vectors), axis=0))
    # contiguous, as products with functions at places would copy the array each time
    shares = np.ascontiguousarray(vectors[:n])
    functions = Functions(*axes, shares.reshape(axes[0].n, axes[1].n, n_modes))
    parts = [(functions, np.eye(n_modes)), *((s, vectors[n + i : n + i + 1]) for i, s in enumerate(statics))]
    # Rayleigh quotients from the derivatives, without cancellation, where all functions are polynomials on one grid
    values = 1.0 / inverse - problem.scale if statics else functions.energies(problem)
    if (values < -1e-7 * problem.scale).any():
        raise ValueError(UNSTABLE)
    values = np.where(values < RIGID * problem.scale, 0.0, values)
    order = np.argsort(values, kind="stable")
    modes = _rotated(SurfaceModes(np.sqrt(values[order]), tuple(parts)), np.eye(n_modes)[:, order])
    modes = _rotated(modes, _uncoupling(modes, problem))
    return _rotated(modes, np.diag(_signs(modes, problem)))


def _with_points(
    problem: SurfaceProblem,
    axes: tuple[Axis, Axis],
    statics: tuple[Functions, ...],
    mass: np.ndarray,
    stiffness: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """M and K + σ M with the static responses as further functions, and with the masses and springs at the points."""
    grid = common_grid(axes, *((s.x_axis, s.y_axis) for s in statics))
    shifted = (*problem.squares, mass_square(problem, problem.scale))
    cross, mutual = products(problem.springs, shifted, axes, statics, grid)
    mass_cross, mass_mutual = products((), (mass_square(problem),), axes, statics, grid)
    stiffness = np.block([[stiffness, cross], [cross.T, mutual]])
    mass = np.block([[mass, mass_cross], [mass_cross.T, mass_mutual]])
    for point in problem.points:
        place = np.array([point.at])
        row = np.r_[point_row(*axes, point.at), np.hstack([s.at(place)[0] for s in statics])]
        mass += point.mass * np.outer(row, row)
        stiffness += (point.stiffness + problem.scale * point.mass) * np.outer(row, row)
    return mass, stiffness


def _rotated(modes: SurfaceModes, rotation: np.ndarray) -> SurfaceModes:
    """The modes times a matrix (n_modes, n_modes)."""
    return replace(modes, parts=tuple((functions, shares @ rotation) for functions, shares in modes.parts))


def _uncoupling(modes: SurfaceModes, problem: SurfaceProblem) -> np.ndarray:
    """The rotation (n_modes, n_modes) within clusters of repeated modes that makes their slopes orthogonal.

    This basis of their space does not depend on round-off. Slopes along x count twice those along y, which separates
    the rotations of a free plate.
    """
    rotation = np.eye(modes.omega.size)
    values = modes.omega**2
    repeated = np.flatnonzero(np.abs(np.diff(values)) <= REPEATED * values[1:])
    if not repeated.size:
        return rotation
    a, b = problem.length
    slopes = modes.products(Field.constant(a**2), (1, 0)) + modes.products(Field.constant(0.5 * b**2), (0, 1))
    for cluster in np.split(repeated, np.flatnonzero(np.diff(repeated) > 1) + 1):
        index = slice(cluster[0], cluster[-1] + 2)
        rotation[index, index] = eigh(slopes[index, index])[1]
    return rotation


def _signs(modes: SurfaceModes, problem: SurfaceProblem) -> np.ndarray:
    """Signs (n_modes,) that make each mode positive where it first moves along a curve from the corner (0, 0)."""
    share = np.linspace(0.02, 0.98, 49)
    curve = np.column_stack([share * problem.length[0], share**1.618 * problem.length[1]])
    values = modes.shapes(curve)
    moves = np.abs(values) > 0.02 * np.abs(values).max(axis=0)
    return np.where(values[moves.argmax(axis=0), np.arange(values.shape[1])] < 0, -1.0, 1.0)
