"""Bounds of the spillover work on cells of places, from intervals of the modal shapes.

A cell is an interval of half-width h_j about c_j for each actuator. Let b(x) be the participation of the controlled
modes in a force at x, M = B⁻¹ at the centre and z_r = φ_rᵀ M. The root Y_r of the work in mode r is, exactly,

    Y_r(x) = Y_r(c) + Σ_j d_rj(x_j) F_rj(x),   d_rj(x) = φ_r(x) - z_rᵀ b(x),   F_r(x) = B(x)⁻¹ T_r,

where d_rj is zero at c_j, so that an error of the forces F has an effect of second order. With E = M ΔB, |E| <= Ē on
the cell, |F - F(c)| <= (I - Ē)⁻¹ Ē |F(c)| where the spectral radius of Ē is below 1 (Neumann series, entry by entry).
W_R is ½ ‖Y‖², and ‖Y‖ >= vᵀ Y for any unit vector v. Here v is along Y(c). Of modal forces f at an instant, the forces
are u = B(x)⁻¹ f, so that M f = (I + E) u: where |M f|_i > (1 + Σ_j Ē_ij) P, none of the cell keeps a limit P of the
peak force, whether the series converges or not.

Duality bounds ‖Y‖ under each limit, also where B is singular (`dual_bound.py`); the larger bound counts. A cell that
neither bounds as wanted may still be excluded by determinants (`hull_bound.py`).
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from workbench.arrays import Floats, Integers
from workbench.design.placement.dual_bound import Tables, dual_bound, expanded
from workbench.design.placement.hull_bound import HullTables, hull_tables, raise_to
from workbench.design.placement.limits import Limits
from workbench.design.placement.small_matrices import inverse_of, multiply
from workbench.design.placement.task import PlacementTask
from workbench.structure.modes import frozen

LEVELS = 12  # halvings of the length of the structure: the smallest half-width is 1/8192 of it
INSTANTS = 48  # of the modal forces, for their peak
SINGULAR = 1e-13  # pivot of B over its largest entry, below which B counts as singular
OF_JUMP = 26.0  # times h J / 192: largest error of a cubic at a jump J of the slope
NO_FORCE = 1e-15  # of the largest eigenvalue of S: one below is zero to round-off, as of two rigid modes moved alike
FLAT = 1e-12  # of the same: with an eigenvalue between, S^-½ is not reliable, and the limit is left out

# half-widths, tables, T, S and S^-½ and L of the limits, the limit of the condition, f, P
Arguments = tuple[Floats, Tables, Floats, Floats, Floats, Floats, float, Floats, float]


@dataclass(frozen=True, eq=False)
class Intervals:
    """The modal shapes on a binary tree of intervals; interval i halves into 2i + 1 and 2i + 2.

    Attributes:
        centre, half: (n_intervals,) m.
        value, slope, curvature: (n_intervals, n_modes) φ, φ' and φ'' at the centre.
        most_curvature, most_rate: (n_intervals, n_modes) largest |φ''| and |φ'''| on the interval; where φ'' jumps, as
            at a step of a beam's stiffness, the second alone is far too large.
        most_fourth: (n_intervals, n_modes) largest |φ''''|, increased where a lower derivative jumps so that it bounds
            a cubic's error there too; None where the nodes are groups of candidates.
    """

    centre: np.ndarray
    half: np.ndarray
    value: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray
    most_curvature: np.ndarray
    most_rate: np.ndarray
    most_fourth: np.ndarray | None = None

    @classmethod
    def of(cls, task: PlacementTask) -> "Intervals":
        """Intervals of a task's length, from a grid that contains every centre; derivatives by finite differences."""
        first, last = task.reach
        leaves = 2**LEVELS
        grid = np.linspace(first, last, 2 * leaves + 1)
        step = grid[1] - grid[0]
        value, slope, curvature = (task.shapes(grid, derivative) for derivative in (0, 1, 2))
        third = np.diff(curvature, axis=0) / step
        fourth = np.diff(third, axis=0, prepend=third[:1], append=third[-1:]) / step
        fourth = np.maximum(np.abs(fourth[:-1]), np.abs(fourth[1:])) + 3.0 * np.abs(np.diff(fourth, axis=0))
        rate = np.abs(third)
        varied = np.abs(np.diff(rate, axis=0, prepend=rate[:1], append=rate[-1:]))
        rate = rate + np.maximum(varied[:-1], varied[1:])
        steep = np.maximum(np.abs(curvature[:-1]), np.abs(curvature[1:])) + 0.5 * step * rate
        # jumps of the slope, as at a step of a bar's stiffness: its change less the integral of φ''
        jump = np.abs(np.diff(slope, axis=0) - 0.5 * step * (curvature[:-1] + curvature[1:]))
        h, levels = step, []
        for _ in range(LEVELS + 1):
            steep, rate, fourth = (np.maximum(part[::2], part[1::2]) for part in (steep, rate, fourth))
            jump = jump[::2] + jump[1::2]
            levels.append((steep + 2.0 * jump / h, rate + 2.0 * jump / h**2, fourth + OF_JUMP * jump / h**3))
            h *= 2.0
        at = np.concatenate([(2 * np.arange(2**k) + 1) * 2 ** (LEVELS - k) for k in range(LEVELS + 1)])
        half = np.concatenate([np.full(2**k, 0.5 * (last - first) / 2**k) for k in range(LEVELS + 1)])
        most = (np.concatenate([level[i] for level in reversed(levels)]) for i in range(3))
        return cls(*(frozen(part) for part in (grid[at], half, value[at], slope[at], curvature[at], *most)))


class CellBounds:
    """Lower bounds of √W_R of cells (n_cells, n_actuators) of intervals; inf where no placement meets the limits.

    Attributes:
        intervals: the tree of intervals.
        wanted: √W_R to be proven as a lower bound; 0 for none, which leaves out the test by determinants.
    """

    def __init__(
        self, task: PlacementTask, limits: Limits, intervals: Intervals | None = None, wanted: float = 0.0
    ) -> None:
        n, self.wanted = task.n_controlled, wanted
        self.intervals = table = Intervals.of(task) if intervals is None else intervals
        forces = task.forces[:, :: max(1, task.forces.shape[1] // INSTANTS)]
        # the limits as tr(B⁻¹ S B⁻ᵀ) <= L²: of the effort; of the peak, since n times its square is above any mean of
        # the squared forces; and of the condition, L = limit / ‖B‖
        squares: list[tuple[np.ndarray, float]] = []
        if np.isfinite(limits.effort):
            squares.append((task.force_gramian, np.sqrt(limits.effort)))
        if np.isfinite(limits.peak_force):
            weight = 1.0 / np.maximum((forces**2).sum(axis=0), 1e-12 * (forces**2).sum(axis=0).max())
            squares.append(((forces * weight / weight.sum()) @ forces.T, np.sqrt(n) * limits.peak_force))
        if np.isfinite(limits.condition):
            squares.append((np.eye(n), np.inf))
        kept, regular = [], []  # limits with a root of S and its (pseudo-)inverse, and which inverses are whole
        for matrix, limit in squares:
            values, vectors = np.linalg.eigh(matrix)
            acting = values > NO_FORCE * values[-1]
            if (values[acting] > FLAT * values[-1]).all():
                root = np.sqrt(np.maximum(values, 0.0))
                inverse = np.divide(vectors, root, out=np.zeros((n, n)), where=acting).T
                kept.append((matrix, vectors * root, inverse, limit))
                regular.append(acting.all())
        matrices, roots, inverses = (np.array([part[i] for part in kept]).reshape(-1, n, n) for i in range(3))
        bounded = np.array([part[3] for part in kept])
        self._arguments: Arguments = (
            table.half,
            (table.value, table.slope, table.curvature, table.most_curvature, table.most_rate),
            np.array(task.roots, order="C"),  # a writeable copy: numba would compile again for a read-only array
            matrices,
            inverses,
            bounded,
            float(limits.condition),
            np.array(forces if np.isfinite(limits.peak_force) else forces[:, :0], order="C"),
            float(limits.peak_force),
        )
        self._hull: HullTables | None = None  # it needs a limit of all of B⁻¹
        if n > 1 and table.most_fourth is not None:
            whole = roots[regular], inverses[regular], bounded[regular]
            self._hull = hull_tables(task, (table.centre, table.half, table.most_fourth), *whole, limits.condition)

    def __call__(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower bounds of √W_R (inf: no placement meets the limits), √W_R at the centres, and the axes to halve."""
        lower, work = np.empty(len(cells)), np.empty(len(cells))
        axis = np.empty(len(cells), np.int64)
        _bounds(cells, self._arguments, lower, work, axis)
        for j in reversed(range(cells.shape[1] - 1)):  # halve an interval of two actuators first, to separate them
            axis[cells[:, j] == cells[:, j + 1]] = j
        if self._hull is not None and self.wanted > 0:
            raise_to(self.wanted, cells, self._hull, lower)
        return lower, work, axis


@njit(cache=True, nogil=True)
def _bounds(cells: Integers, arguments: Arguments, lower: Floats, work: Floats, axis: Integers) -> None:
    halves, tables, transforms, squares, inverses, limits, condition, forces, peak = arguments
    value, slope, _, most_curvature, _ = tables
    n_cells, n = cells.shape
    h, score = np.empty(n), np.empty(n)
    for cell in range(n_cells):
        node = cells[cell]
        frame, change = 0.0, 0.0
        for j in range(n):
            h[j], of_column = halves[node[j]], 0.0
            for k in range(n):
                frame += value[node[j], k] ** 2
                of_column += (abs(slope[node[j], k]) + h[j] * most_curvature[node[j], k]) ** 2
            change += h[j] * np.sqrt(of_column)
        least_frame = np.sqrt(frame) - change  # a lower bound of ‖B‖ in the cell
        nearest = -np.inf
        for s in range(len(limits)):
            limit = limits[s]
            if np.isinf(limit) and least_frame > 0:
                limit = condition / least_frame
            if np.isfinite(limit):
                bound = dual_bound(node, h, tables, transforms, squares[s], inverses[s], limit, SINGULAR, score)
                if bound > nearest:
                    nearest, axis[cell] = bound, np.argmax(score)
        lower[cell], work[cell] = max(nearest, 0.0), np.inf
        if np.isinf(lower[cell]):
            continue
        bound, work[cell] = _series_bound(node, h, tables, transforms, forces, peak, score)
        if bound > lower[cell] or nearest == -np.inf:
            axis[cell] = np.argmax(score)
        lower[cell] = max(lower[cell], bound)


@njit(cache=True, nogil=True)
def _series_bound(
    node: Integers, h: Floats, tables: Tables, transforms: Floats, forces: Floats, peak: float, score: Floats
) -> tuple[float, float]:
    """Lower bound of √W_R in a cell and its value at the centre; -inf and inf where Neumann's series may diverge.

    The bound is inf where no placement keeps the limit P of the peak force under the modal forces f (n, n_instants).
    """
    value = tables[0]
    n_residual, n, n_columns = transforms.shape
    matrix, m, change = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    neumann, error, most = np.empty((n, n)), np.empty((n, n)), np.ones(n)
    largest = 0.0
    for j in range(n):
        score[j] = h[j]
        for k in range(n):
            matrix[k, j] = value[node[j], k]
            largest = max(largest, abs(matrix[k, j]))
    if not inverse_of(matrix, m, SINGULAR * largest):
        return -np.inf, np.inf

    # change of the forces over the cell: E = M ΔB
    for j in range(n):
        score[j] = 0.0
        for i in range(n):
            _, steep, rest = expanded(m[i], node[j], h[j], tables)
            change[i, j] = abs(steep) * h[j] + rest
            matrix[i, j] = (1.0 if i == j else 0.0) - change[i, j]
            score[j] += change[i, j]
            most[i] += change[i, j]
    for t in range(forces.shape[1]):
        for i in range(n):
            total = 0.0
            for k in range(n):
                total += m[i, k] * forces[k, t]
            if abs(total) > peak * most[i]:
                return np.inf, np.inf
    # the series converges if (I - Ē) w = 1 has w > 0, since I - Ē is then an M-matrix
    if not inverse_of(matrix, neumann, 1e-12):
        return -np.inf, np.inf
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += neumann[i, j]
            if neumann[i, j] < 0.0:
                return -np.inf, np.inf
        if total < 1.0:
            return -np.inf, np.inf
    multiply(neumann, change, error)

    # ‖Y‖ vᵀ Y is ‖Y‖² at the centre, plus a linear function of the places, plus a remainder
    weights, steep_of, rest_of, force = np.zeros(n + n_residual), np.empty(n), np.empty(n), np.empty(n)
    linear, remainder, squared = np.zeros(n), np.zeros(n), 0.0
    for r in range(n_residual):
        for k in range(n):
            weights[k] = 0.0
            for i in range(n):
                weights[k] -= value[node[i], n + r] * m[i, k]
        weights[n + r] = 1.0
        for j in range(n):
            _, steep_of[j], rest_of[j] = expanded(weights, node[j], h[j], tables)
        weights[n + r] = 0.0
        for q in range(n_columns):
            y = 0.0
            for i in range(n):
                force[i] = 0.0
                for k in range(n):
                    force[i] += m[i, k] * transforms[r, k, q]
                y += value[node[i], n + r] * force[i]
            squared += y**2
            for i in range(n):
                changed = 0.0
                for j in range(n):
                    changed += error[i, j] * abs(force[j])
                linear[i] += y * steep_of[i] * force[i]
                remainder[i] += abs(y) * (rest_of[i] * abs(force[i]) + (h[i] * abs(steep_of[i]) + rest_of[i]) * changed)
    if squared == 0.0:
        return 0.0, 0.0
    lost = 0.0
    for j in range(n):
        lost += abs(linear[j]) * h[j] + remainder[j]
        score[j] = (abs(linear[j]) * h[j] + 2.0 * remainder[j]) * (1.0 + score[j])
    return float((squared - lost) / np.sqrt(2.0 * squared)), float(np.sqrt(0.5 * squared))
