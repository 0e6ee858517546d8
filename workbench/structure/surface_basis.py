"""Products of piecewise polynomials over a rectangle, and their matrices of a strain energy.

The functions are X_i(x) Y_j(y), with the one-dimensional functions of `Segments` that satisfy the essential boundary
conditions. A strain energy is given as a sum of weighted squares, so that a mode's Rayleigh quotient is a sum of
squares too and does not cancel.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from workbench.structure.domain import gauss_between
from workbench.structure.polynomials import Segments
from workbench.structure.supports import HELD

Weight = Callable[[np.ndarray, np.ndarray], np.ndarray]

GRADING = 0.15  # ratio of neighbouring segments towards a singular place (Szabó & Babuška 1991, section 10.3)
THINNEST = 8e-4  # least segment over the side; bending is lost in round-off below


@dataclass(frozen=True)
class Square:
    """One term ½ ∫ weight (Σ c ∂_x^i ∂_y^j w)² dA of the strain energy, with parts (c, i, j) and weight (x, y)."""

    weight: Weight
    parts: tuple[tuple[float, int, int], ...]


@dataclass(frozen=True)
class EdgeSpring:
    """One term ½ ∫ stiffness (∂_n^derivative w)² ds along an edge.

    Attributes:
        axis: 0 for an edge x = at, 1 for an edge y = at.
        at: m.
        derivative: 0 for the displacement, 1 for the slope normal to the edge.
        stiffness: N/m², or N m/rad per m; `HELD` for an essential condition.
    """

    axis: int
    at: float
    derivative: int
    stiffness: float


@dataclass(frozen=True)
class PointTerm:
    """A mass (kg) and a stiffness to ground (N/m) at one point (x, y)."""

    at: tuple[float, float]
    mass: float = 0.0
    stiffness: float = 0.0


@dataclass(frozen=True, eq=False)
class SurfaceProblem:
    """The eigenvalue problem K v = ω² M v over [0, a] × [0, b].

    Attributes:
        length: (a, b), m.
        continuity: 0 (values shared between segments; membrane) or 1 (slopes too; plate).
        mass: per area, a function of (x, y), kg/m².
        squares: of the strain energy.
        edges: springs along edges, held ones among them.
        points: masses and springs at points.
        breaks: coordinates of jumps, along x and along y, m.
        corners: coordinates of edges that end in a singular corner, along x and along y, m.
        scale: of ω² of the first elastic mode, (rad/s)².
    """

    length: tuple[float, float]
    continuity: int
    mass: Weight
    squares: tuple[Square, ...]
    edges: tuple[EdgeSpring, ...]
    points: tuple[PointTerm, ...]
    breaks: tuple[tuple[float, ...], tuple[float, ...]]
    corners: tuple[tuple[float, ...], tuple[float, ...]]
    scale: float

    @property
    def springs(self) -> tuple[EdgeSpring, ...]:
        """The edges that are not held."""
        return tuple(edge for edge in self.edges if edge.stiffness != HELD)


@dataclass(frozen=True, eq=False)
class Axis:
    """The free one-dimensional functions along x or along y, tabulated at Gauss points.

    Attributes:
        segments: all functions.
        kept: (n_kept,) indices of those that satisfy the essential boundary conditions.
        points, weights: (n_quadrature,) of the quadrature, m.
        tables: values (n_quadrature, n_kept) for each order of derivative.
    """

    segments: Segments
    kept: np.ndarray
    points: np.ndarray
    weights: np.ndarray
    tables: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, segments: Segments, held: tuple[tuple[float, int], ...]) -> "Axis":
        """The axis of segments with essential conditions `held` ((at, derivative), ...) at its ends."""
        nodal = segments.continuity + 1
        last = segments.nodes.size - 1
        dropped = [nodal * (0 if at <= segments.nodes[0] else last) + derivative for at, derivative in held]
        kept = np.setdiff1d(np.arange(segments.n_functions), dropped)
        points, weights, tables = segments.tables(range(nodal + 1))
        return cls(segments, kept, points, weights, tuple(table.take(kept, axis=1) for table in tables))

    @property
    def n(self) -> int:
        return self.kept.size

    def values(self, at: np.ndarray | float, derivative: int = 0) -> np.ndarray:
        """(n_places, n_kept) values, or derivatives, of the functions."""
        return self.segments.evaluation(at, derivative)[:, self.kept]


@dataclass(frozen=True, eq=False)
class Functions:
    """Functions over the rectangle: Σ_ij coefficients_ijk X_i(x) Y_j(y), coefficients (n_x, n_y, n_functions)."""

    x_axis: Axis
    y_axis: Axis
    coefficients: np.ndarray

    def at(self, places: np.ndarray, derivatives: tuple[int, int] = (0, 0)) -> np.ndarray:
        """(n_places, n_functions) ∂_x^i ∂_y^j at places (n_places, 2), with (i, j) = derivatives."""
        x = self.x_axis.values(places[:, 0], derivatives[0])
        y = self.y_axis.values(places[:, 1], derivatives[1])
        return np.asarray(np.einsum("pjr,pj->pr", np.tensordot(x, self.coefficients, axes=(1, 0)), y))

    def on_grid(self, x_axis: Axis, y_axis: Axis, derivatives: tuple[int, int] = (0, 0)) -> np.ndarray:
        """(n_x, n_y, n_functions) at the Gauss points of two axes, its own or others."""
        tables = [
            own.tables[derivative] if own is axis else own.values(axis.points, derivative)
            for own, axis, derivative in zip((self.x_axis, self.y_axis), (x_axis, y_axis), derivatives)
        ]
        along_x = np.tensordot(tables[0], self.coefficients, axes=(1, 0))
        return np.moveaxis(np.tensordot(along_x, tables[1], axes=(1, 1)), 2, 1)

    def energies(self, problem: SurfaceProblem) -> np.ndarray:
        """(n_functions,) twice the strain energy of each function, including the springs along edges."""
        total = np.zeros(self.coefficients.shape[2])
        for square in problem.squares:
            strain = np.zeros((1, 1, 1))
            for coefficient, dx, dy in square.parts:
                strain = strain + coefficient * self.on_grid(self.x_axis, self.y_axis, (dx, dy))
            total += np.einsum("qpr,qp->r", strain**2, weights_on(square.weight, self.x_axis, self.y_axis))
        for edge in problem.springs:
            along = _own_and_other(edge, self.x_axis, self.y_axis)[1]
            total += edge.stiffness * (along.weights @ self.on_edge(edge, along.points) ** 2)
        return total

    def on_edge(self, edge: EdgeSpring, points: np.ndarray) -> np.ndarray:
        """(n_points, n_functions) elongation of a spring along an edge."""
        own, other = _own_and_other(edge, self.x_axis, self.y_axis)
        coefficients = self.coefficients if edge.axis == 0 else np.swapaxes(self.coefficients, 0, 1)
        across = np.tensordot(own.values(edge.at, edge.derivative)[0], coefficients, axes=(0, 0))
        return other.values(points) @ across


def weights_on(weight: Weight, x_axis: Axis, y_axis: Axis) -> np.ndarray:
    """(n_x, n_y) weight times the weights of the quadrature on the grid of two axes."""
    values = weight(x_axis.points[:, None], y_axis.points[None, :])
    return values * np.outer(x_axis.weights, y_axis.weights)


def mass_square(problem: SurfaceProblem, factor: float = 1.0) -> Square:
    """∫ factor m w² dA as a square."""
    return Square(lambda x, y: factor * problem.mass(x, y), ((1.0, 0, 0),))


def assemble(squares: tuple[Square, ...], x_axis: Axis, y_axis: Axis) -> np.ndarray:
    """Σ ∫ weight (Σ c ∂X_i Y_j)(Σ c ∂X_k Y_l) dA, (n, n) with n = n_x n_y, by sum factorisation."""
    nx, ny = x_axis.n, y_axis.n
    total = np.zeros((nx * nx, ny * ny))
    for square in squares:
        shares = weights_on(square.weight, x_axis, y_axis)
        for c1, dx1, dy1 in square.parts:
            for c2, dx2, dy2 in square.parts:
                total += (c1 * c2) * (_products(x_axis, dx1, dx2).T @ shares) @ _products(y_axis, dy1, dy2)
    return total.reshape(nx, nx, ny, ny).transpose(0, 2, 1, 3).reshape(nx * ny, nx * ny)


def edge_matrix(springs: tuple[EdgeSpring, ...], x_axis: Axis, y_axis: Axis) -> np.ndarray:
    """Stiffness (n, n) of the springs along edges."""
    total = np.zeros((x_axis.n * y_axis.n,) * 2)
    for edge in springs:
        own, other = _own_and_other(edge, x_axis, y_axis)
        across = own.values(edge.at, edge.derivative)[0]
        along = other.tables[0].T @ (other.weights[:, None] * other.tables[0])
        pair = (np.outer(across, across), along)
        total += edge.stiffness * np.kron(*(pair if edge.axis == 0 else pair[::-1]))
    return total


def common_grid(*grids: tuple[Axis, Axis]) -> tuple[Axis, Axis]:
    """Gauss points (axes without functions) that integrate products of the functions of all given axes exactly."""

    def joined(axes: tuple[Axis, ...]) -> Axis:
        nodes = np.unique(np.concatenate([axis.segments.nodes for axis in axes]))
        nodes = nodes[np.r_[True, np.diff(nodes) > 1e-9 * nodes[-1]]]
        most = max(max(axis.segments.degrees) for axis in axes)
        segments = Segments(nodes, (most,) * (nodes.size - 1), axes[0].segments.continuity)
        return Axis(segments, np.zeros(0, int), *gauss_between(nodes, most + 3), ())

    return joined(tuple(x for x, _ in grids)), joined(tuple(y for _, y in grids))


def products(
    springs: tuple[EdgeSpring, ...],
    squares: tuple[Square, ...],
    axes: tuple[Axis, Axis],
    others: tuple[Functions, ...],
    grid: tuple[Axis, Axis],
) -> tuple[np.ndarray, np.ndarray]:
    """Energy products of other functions with those of the axes (n, n_others) and with each other (n_others, n_others).

    Each of `others` holds a single function; `grid` is that of the quadrature, see `common_grid`.
    """
    cross = np.zeros((axes[0].n, axes[1].n, len(others)))
    mutual = np.zeros((len(others), len(others)))
    for square in squares:
        strains = [sum(c * other.on_grid(*grid, (dx, dy))[:, :, 0] for c, dx, dy in square.parts) for other in others]
        weighted = [weights_on(square.weight, *grid) * strain for strain in strains]
        mutual += np.array([[np.sum(one * other) for other in strains] for one in weighted])
        for p, load in enumerate(weighted):
            for c, dx, dy in square.parts:
                tables = axes[0].values(grid[0].points, dx), axes[1].values(grid[1].points, dy)
                cross[:, :, p] += c * (tables[0].T @ load @ tables[1])
    for edge in springs:
        own, along = _own_and_other(edge, *axes), _own_and_other(edge, *grid)[1]
        on_edge = [other.on_edge(edge, along.points)[:, 0] for other in others]
        loads = [edge.stiffness * along.weights * values for values in on_edge]
        mutual += np.array([[one @ other for other in on_edge] for one in loads])
        for p, load in enumerate(loads):
            outer = np.outer(own[0].values(edge.at, edge.derivative)[0], own[1].values(along.points).T @ load)
            cross[:, :, p] += outer if edge.axis == 0 else outer.T
    return cross.reshape(-1, len(others)), mutual


def point_row(x_axis: Axis, y_axis: Axis, at: tuple[float, float]) -> np.ndarray:
    """(n_x n_y,) values of all functions at a point."""
    return np.kron(x_axis.values(at[0])[0], y_axis.values(at[1])[0])


def axes_of(
    problem: SurfaceProblem, n_modes: int, level: int, *, near: tuple[float, float] | None = None
) -> tuple[Axis, Axis]:
    """Functions that represent n_modes modes; each level has higher degrees and one more layer at a singular place.

    Segments shrink towards the singular corners, or towards the point `near`.
    """
    along_x, along_y = near or (None, None)
    return _axis(problem, 0, n_modes, level, along_x), _axis(problem, 1, n_modes, level, along_y)


def _axis(problem: SurfaceProblem, axis: int, n_modes: int, level: int, near: float | None) -> Axis:
    length = problem.length[axis]
    slack = THINNEST * length
    singular = problem.corners[axis] if near is None else (near,)
    nodes = [0.0]
    for node in sorted({*problem.breaks[axis], *singular, length}):
        if node - nodes[-1] > slack and (node == length or length - node > slack):
            nodes.append(node)
    graded = {*nodes}
    for i, node in enumerate(nodes):
        if any(abs(node - place) <= slack for place in singular):
            layers = level + (1 if near is None else 2)
            for other in (*nodes[max(i - 1, 0) : i], *nodes[i + 1 : i + 2]):
                steps = (other - node) * GRADING ** np.arange(1, layers + 1)
                graded |= {node + step for step in steps if abs(step) > slack}
    edges = np.array(sorted(graded))
    waves = _half_waves(problem.length, n_modes)[axis] * np.diff(edges) / length
    smooth = len(nodes) == len(edges)
    degrees = np.ceil(0.5 * np.pi * waves + 3.0 * np.cbrt(waves)).astype(int) + (4 + 3 * level if smooth else 3 + level)
    held = tuple((e.at, e.derivative) for e in problem.edges if e.axis == axis and e.stiffness == HELD)
    return Axis.of(Segments(edges, tuple(degrees.tolist()), problem.continuity), held)


def _half_waves(length: tuple[float, float], n_modes: int) -> tuple[float, float]:
    """Upper bounds of the half waves along x and y of the n-th mode, by Weyl's law for held edges."""
    a, b = length
    boundary = (a + b) / (2.0 * np.pi)
    wavenumber = (boundary + np.sqrt(boundary**2 + a * b * n_modes / np.pi)) / (a * b / (2.0 * np.pi))
    return a * wavenumber / np.pi, b * wavenumber / np.pi


def _products(axis: Axis, first: int, second: int) -> np.ndarray:
    """(n_quadrature, n_kept²) products of derivatives of all pairs of functions."""
    pairs: np.ndarray = axis.tables[first][:, :, None] * axis.tables[second][:, None, :]
    return pairs.reshape(axis.points.size, -1)


def _own_and_other(edge: EdgeSpring, x_axis: Axis, y_axis: Axis) -> tuple[Axis, Axis]:
    return (x_axis, y_axis) if edge.axis == 0 else (y_axis, x_axis)
