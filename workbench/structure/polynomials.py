"""Piecewise polynomials of high degree along a structure: the basis of its modes (hierarchic p-elements).

On each segment the internal functions are integrals of Legendre polynomials: the second integral for a beam, the
first for a bar. Their highest derivatives are then orthogonal, the stiffness matrix of a uniform segment is the
identity, and round-off stays near machine precision at any degree. With low-order elements the condition number grows
with the fourth power of their number, so that refinement to the same accuracy fails.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike
from scipy.special import eval_legendre

from workbench.arrays import Floats


@cache
def reference_basis(degree: int, continuity: int) -> np.ndarray:
    """Legendre coefficients of the basis on [-1, 1]: (degree + 1 functions, degree + 1 coefficients).

    The first 2 (continuity + 1) functions are those of the values (and slopes, per unit of the local coordinate) at the
    ends, left before right; the others vanish there.
    """
    basis = np.zeros((degree + 1, degree + 1))
    if continuity == 0:
        basis[0, :2], basis[1, :2] = (0.5, -0.5), (0.5, 0.5)
        rows = np.arange(2, degree + 1)
    else:
        basis[0, :4] = legendre.poly2leg([0.5, -0.75, 0.0, 0.25])
        basis[1, :4] = legendre.poly2leg([0.25, -0.25, -0.25, 0.25])
        basis[2, :4] = legendre.poly2leg([0.5, 0.75, 0.0, -0.25])
        basis[3, :4] = legendre.poly2leg([-0.25, -0.25, 0.25, 0.25])
        rows = np.arange(4, degree + 1)
    n = rows - (continuity + 1)  # the row is the integral of the normalised polynomial of this order
    integrals = np.zeros((rows.size, degree + 2 + continuity))
    integrals[np.arange(rows.size), n] = np.sqrt(n + 0.5)
    for _ in range(continuity + 1):
        # the integral of P_n from -1 is (P_n+1 - P_n-1) / (2 n + 1); orders are at least 1 here
        share = integrals / (2.0 * np.arange(integrals.shape[1]) + 1.0)
        integrals = np.zeros_like(integrals)
        integrals[:, 1:] += share[:, :-1]
        integrals[:, :-1] -= share[:, 1:]
    basis[rows] = integrals[:, : degree + 1]
    return basis


@cache
def _derived(degree: int, continuity: int, derivative: int) -> np.ndarray:
    """Legendre coefficients (n_coefficients, degree + 1) of a derivative of the basis functions."""
    basis = reference_basis(degree, continuity).T
    return legendre.legder(basis, derivative) if derivative else basis


@cache
def tabulated_basis(degree: int, continuity: int, n_points: int) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Gauss points and weights on [-1, 1] and the basis with its derivatives there, (n_points, degree + 1) each."""
    points, weights = legendre.leggauss(n_points)
    tables = []
    for order in range(continuity + 2):
        coefficients = _derived(degree, continuity, order)
        tables.append(legendre.legvander(points, coefficients.shape[0] - 1) @ coefficients)
    return points, weights, tables


@dataclass(frozen=True, eq=False)
class Segments:
    """Functions along x that are polynomials on each segment and continuous (with their slope, for a beam).

    Attributes:
        nodes: (n_segments + 1,) ends of the segments, m.
        degrees: of the polynomials, one per segment.
        continuity: 0 (values; bar) or 1 (values and slopes; beam) shared across nodes.
    """

    nodes: np.ndarray
    degrees: tuple[int, ...]
    continuity: int

    @property
    def n_segments(self) -> int:
        return self.nodes.size - 1

    @property
    def n_functions(self) -> int:
        """Number of global functions."""
        return int(self._inner[-1])

    @cached_property
    def _inner(self) -> np.ndarray:
        """Global index (n_segments + 1,) of the first internal function of each segment; last, the total number."""
        nodal = self.continuity + 1
        return nodal * self.nodes.size + np.cumsum([0, *(degree + 1 - 2 * nodal for degree in self.degrees)])

    def indices(self, segment: int) -> np.ndarray:
        """Global indices (degree + 1,) of the functions of one segment, in the order of `reference_basis`."""
        nodal = self.continuity + 1
        inner = np.arange(self._inner[segment], self._inner[segment + 1])
        return np.concatenate([np.arange(nodal * segment, nodal * (segment + 2)), inner])

    def evaluation(self, x: ArrayLike, derivative: int = 0) -> np.ndarray:
        """The matrix (n_points, n_functions) that maps coefficients to values (or derivatives) at x, read-only."""
        x = np.atleast_1d(np.asarray(x, float))
        return _evaluation(self.nodes.tobytes(), self.degrees, self.continuity, x.tobytes(), derivative)

    def tabulated(self, segment: int, derivative: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gauss points of a segment (m), their weights, and a derivative (n_points, degree + 1) of its functions there.

        The rule is exact for squares times a polynomial of the seventh degree.
        """
        ends = float(self.nodes[segment]), float(self.nodes[segment + 1])
        return _tabulated(*ends, self.degrees[segment], self.continuity, derivative)

    def tables(self, derivatives: Iterable[int]) -> tuple[Floats, Floats, list[Floats]]:
        """Gauss points of all segments (n_points,), m, their weights, and derivatives (n_points, n_functions) there."""
        x, weights, found = np.zeros(0), np.zeros(0), []
        for derivative in derivatives:
            parts = [self.tabulated(s, derivative) for s in range(self.n_segments)]
            x, weights = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
            table, row = np.zeros((x.size, self.n_functions)), 0
            for s, (points, _, values) in enumerate(parts):
                table[row : row + points.size, self.indices(s)] = values
                row += points.size
            found.append(table)
        return x, weights, found

    def assemble(self, weight: Callable[[Floats], Floats], derivative: int) -> Floats:
        """Integral of weight(x) times the products of the functions' derivatives: (n_functions, n_functions)."""
        matrix = np.zeros((self.n_functions, self.n_functions))
        for s in range(self.n_segments):
            x, weights, table = self.tabulated(s, derivative)
            indices = self.indices(s)
            matrix[np.ix_(indices, indices)] += table.T @ ((weights * weight(x))[:, None] * table)
        return matrix

    def form(self, weight: Callable[[Floats], Floats], derivative: int, coefficients: Floats) -> Floats:
        """Integral of weight(x) times the squared derivative of each column of coefficients: (n_columns,)."""
        total = np.zeros(coefficients.shape[1])
        for s in range(self.n_segments):
            x, weights, table = self.tabulated(s, derivative)
            total += (weights * weight(x)) @ (table @ coefficients[self.indices(s)]) ** 2
        return total

    def unresolved(self, coefficients: np.ndarray) -> float:
        """Largest ratio of the last two internal coefficients to all; small once the degree is sufficient."""
        nodal = 2 * (self.continuity + 1)
        largest = np.abs(coefficients).max(axis=0)
        tail = [np.abs(coefficients[self.indices(s)[nodal:][-2:]]).max(axis=0) for s in range(self.n_segments)]
        return float((np.max(tail, axis=0) / largest).max())


def _scales(degree: int, continuity: int, width: float) -> Floats:
    """Factors (degree + 1,) that turn slopes in the local coordinate into slopes per metre."""
    factors = np.ones(degree + 1)
    if continuity == 1:
        factors[[1, 3]] = 0.5 * width
    return factors


@lru_cache(maxsize=512)
def _tabulated(
    start: float, end: float, degree: int, continuity: int, derivative: int
) -> tuple[Floats, Floats, Floats]:
    """`Segments.tabulated`, cached, since a slightly changed structure is solved on the same segments."""
    h = end - start
    points, weights, tables = tabulated_basis(degree, continuity, degree + 4)
    table = tables[derivative] * _scales(degree, continuity, h) * (2.0 / h) ** derivative
    arrays = start + 0.5 * h * (points + 1.0), 0.5 * h * weights, table
    for array in arrays:
        array.flags.writeable = False
    return arrays


@lru_cache(maxsize=512)
def _evaluation(nodes: bytes, degrees: tuple[int, ...], continuity: int, places: bytes, derivative: int) -> np.ndarray:
    """`Segments.evaluation`, cached, since sensors and actuators are often at the same places."""
    segments = Segments(np.frombuffer(nodes), degrees, continuity)
    x = np.frombuffer(places)
    matrix = np.zeros((x.size, segments.n_functions))
    segment = np.clip(np.searchsorted(segments.nodes, x, side="right") - 1, 0, segments.n_segments - 1)
    for s in np.unique(segment):
        here = segment == s
        h = segments.nodes[s + 1] - segments.nodes[s]
        local = 2.0 * (x[here] - segments.nodes[s]) / h - 1.0
        coefficients = _derived(degrees[s], continuity, derivative)
        values = eval_legendre(np.arange(coefficients.shape[0]), local[:, None]) @ coefficients
        values = values * _scales(degrees[s], continuity, h) * (2.0 / h) ** derivative
        matrix[np.ix_(np.flatnonzero(here), segments.indices(s))] = values
    matrix.flags.writeable = False
    return matrix
