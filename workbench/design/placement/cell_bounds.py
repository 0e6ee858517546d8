"""Bounds of the spillover work on cells of places, from intervals of the modal shapes.

A cell is an interval of half-width h_j about c_j for each actuator. Let b(x) be the participation of the controlled
modes in a force at x, M = B⁻¹ at the centre and z_r = φ_rᵀ M. The root Y_r of the work in mode r is, exactly,

    Y_r(x) = Y_r(c) + Σ_j d_rj(x_j) F_rj(x),   d_rj(x) = φ_r(x) - z_rᵀ b(x),   F_r(x) = B(x)⁻¹ T_r,

where d_rj is zero at c_j, so that an error of the forces F has an effect of second order. With E = M ΔB, |E| <= Ē on
the cell, |F - F(c)| <= (I - Ē)⁻¹ Ē |F(c)| where the spectral radius of Ē is below 1 (Neumann series, entry by entry).
W_R is ½ ‖Y‖², and ‖Y‖ >= vᵀ Y for any unit vector v. Here v is along the Y of least norm to first order in the cell.
The linear part is minimised over the cell under each linearised limit (a linear programme of one constraint, solved by
its dual).

Where B is singular or nearly so, duality bounds ‖Y‖ under each limit (`dual_bound.py`); the larger bound counts. A cell
that neither bounds as wanted may still be excluded by determinants (`hull_bound.py`).
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from workbench.arrays import Flags, Floats, Integers
from workbench.design.placement.dual_bound import dual_bound
from workbench.design.placement.hull_bound import HullBound
from workbench.design.placement.limits import Limits
from workbench.design.placement.small_matrices import inverse_of
from workbench.design.placement.task import PlacementTask
from workbench.structure.modes import frozen

LEVELS = 12  # halvings of the length of the structure: the smallest half-width is 1/8192 of it
INSTANTS = 48  # of the modal forces, for their peak
SINGULAR = 1e-13  # pivot of B over its largest entry, below which B counts as singular
SWEEPS = 3  # of the coordinate descent to the least ‖Y‖ to first order
OF_JUMP = 26.0  # times h J / 192: largest error of a cubic at a jump J of the slope
FLAT = 1e-12  # ratio of least to largest eigenvalue, below which a limited quadratic form has no inverse


@dataclass(frozen=True, eq=False)
class Intervals:
    """The modal shapes on a binary tree of intervals; interval i halves into 2i + 1 and 2i + 2.

    Attributes:
        centre, half: (n_intervals,) m.
        value, slope, bend: (n_intervals, n_modes) φ, φ' and φ'' at the centre.
        most_bend, most_rate: (n_intervals, n_modes) largest |φ''| and |φ'''| on the interval.
        most_fourth: (n_intervals, n_modes) largest |φ''''|, increased where a lower derivative jumps so that it bounds
            a cubic's error there too; None where the nodes are groups of candidates.
    """

    centre: np.ndarray
    half: np.ndarray
    value: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    most_bend: np.ndarray
    most_rate: np.ndarray
    most_fourth: np.ndarray | None = None

    @classmethod
    def of(cls, task: PlacementTask) -> "Intervals":
        """Intervals of a task's length, from a grid that contains every centre; derivatives by finite differences."""
        first, last = task.reach
        leaves = 2**LEVELS
        grid = np.linspace(first, last, 2 * leaves + 1)
        step = grid[1] - grid[0]
        value, slope, bend = (task.shapes(grid, derivative) for derivative in (0, 1, 2))
        third = np.diff(bend, axis=0) / step
        fourth = np.diff(third, axis=0, prepend=third[:1], append=third[-1:]) / step
        fourth = np.maximum(np.abs(fourth[:-1]), np.abs(fourth[1:])) + 3.0 * np.abs(np.diff(fourth, axis=0))
        rate = np.abs(third)
        varied = np.abs(np.diff(rate, axis=0, prepend=rate[:1], append=rate[-1:]))
        rate = rate + np.maximum(varied[:-1], varied[1:])
        steep = np.maximum(np.abs(bend[:-1]), np.abs(bend[1:])) + 0.5 * step * rate
        # jumps of the slope, as at a step of a bar's stiffness: its change less the integral of φ''
        jump = np.abs(np.diff(slope, axis=0) - 0.5 * step * (bend[:-1] + bend[1:]))
        h, levels = step, []
        for _ in range(LEVELS + 1):
            steep, rate, fourth = (np.maximum(part[::2], part[1::2]) for part in (steep, rate, fourth))
            jump = jump[::2] + jump[1::2]
            levels.append((steep + 2.0 * jump / h, rate + 2.0 * jump / h**2, fourth + OF_JUMP * jump / h**3))
            h *= 2.0
        at = np.concatenate([(2 * np.arange(2**k) + 1) * 2 ** (LEVELS - k) for k in range(LEVELS + 1)])
        half = np.concatenate([np.full(2**k, 0.5 * (last - first) / 2**k) for k in range(LEVELS + 1)])
        most = (np.concatenate([level[i] for level in reversed(levels)]) for i in range(3))
        return cls(*(frozen(part) for part in (grid[at], half, value[at], slope[at], bend[at], *most)))


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
        roots, inverses = np.zeros((len(squares), n, n)), np.zeros((len(squares), n, n))
        for i, (matrix, _) in enumerate(squares):
            values, vectors = np.linalg.eigh(matrix)
            values = np.maximum(values, 0.0)
            roots[i] = vectors * np.sqrt(values)
            if values[0] > FLAT * values[-1]:
                inverses[i] = (vectors / np.sqrt(values)).T
        self._arguments = (
            table.half,
            table.value,
            table.slope,
            table.bend,
            table.most_bend,
            table.most_rate,
            np.array(task.roots, order="C"),  # a writeable copy: numba would compile again for a read-only array
            roots,
            np.array([matrix for matrix, _ in squares]).reshape(-1, n, n),
            inverses,
            np.asarray(inverses.any(axis=(1, 2))),
            np.array([limit for _, limit in squares]),
            float(limits.condition),
            np.array(forces if np.isfinite(limits.peak_force) else forces[:, :0], order="C"),
            float(limits.peak_force),
        )
        self._hull: HullBound | None = None
        if n > 1 and table.most_fourth is not None:
            kept = inverses.any(axis=(1, 2))
            bounded = np.array([limit for _, limit in squares])[kept]
            measures = (table.centre, table.half, table.most_fourth)
            self._hull = HullBound(task, measures, roots[kept], inverses[kept], bounded, limits.condition)

    def __call__(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower bounds of √W_R (inf: no placement meets the limits), √W_R at the centres, and the axes to halve."""
        lower, work = np.empty(len(cells)), np.empty(len(cells))
        axis = np.empty(len(cells), np.int64)
        _bounds(cells, *self._arguments, lower, work, axis)
        for j in reversed(range(cells.shape[1] - 1)):  # halve an interval of two actuators first, to separate them
            axis[cells[:, j] == cells[:, j + 1]] = j
        if self._hull is not None and self.wanted > 0:
            self._hull.raise_to(self.wanted, cells, lower)
        return lower, work, axis


@njit(cache=True, nogil=True)
def _least_linear(cost: Floats, h: Floats, direction: Floats, slack: float) -> float:
    """min cᵀδ over |δ| <= h with aᵀδ <= slack, by its dual; inf where no δ meets the constraint."""
    n = cost.size
    reach = 0.0
    for j in range(n):
        reach += abs(direction[j]) * h[j]
    if reach < -slack:
        return np.inf
    best = -np.inf
    for k in range(-1, n):
        multiplier = 0.0
        if k >= 0:
            if direction[k] == 0.0:
                continue
            multiplier = -cost[k] / direction[k]
            if multiplier <= 0.0:
                continue
        value = -multiplier * slack
        for j in range(n):
            value -= abs(cost[j] + multiplier * direction[j]) * h[j]
        best = max(best, value)
    return best


@njit(cache=True, nogil=True)
def _largest(score: Floats) -> int:
    """Index of the largest entry, the first of equals (argmax)."""
    largest = 0
    for j in range(1, score.size):
        if score[j] > score[largest]:
            largest = j
    return largest


@njit(cache=True, nogil=True)
def _bounds(
    cells: Integers,
    halves: Floats,
    value: Floats,
    slope: Floats,
    bend: Floats,
    most_bend: Floats,
    most_rate: Floats,
    transforms: Floats,
    roots: Floats,
    squares: Floats,
    inverses: Floats,
    regular: Flags,
    square_limits: Floats,
    condition: float,
    forces: Floats,
    peak: float,
    lower: Floats,
    work: Floats,
    axis: Integers,
) -> None:
    n_cells, n = cells.shape
    n_residual, _, n_columns = transforms.shape
    n_squares, n_instants = roots.shape[0], forces.shape[1]
    h = np.empty(n)
    b, matrix = np.empty((n, n)), np.empty((n, n))
    m, rate, curved, change = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    neumann, error = np.empty((n, n)), np.empty((n, n))
    z, first, second = np.empty((n_residual, n)), np.empty((n_residual, n)), np.empty((n_residual, n))
    p, p_error = np.empty((n, n_columns)), np.empty((n, n_columns))
    y, rest = np.empty((n_residual, n_columns)), np.empty((n_residual, n_columns))
    linear = np.empty((n_residual, n_columns, n))
    rest_by = np.empty((n_residual, n_columns, n))
    least_y, shift, cost, score = np.empty((n_residual, n_columns)), np.empty(n), np.empty(n), np.empty(n)
    directions, slacks = np.empty((n_squares + 1, n)), np.empty(n_squares + 1)
    weighted, u, v, carried = np.empty((n, n)), np.empty(n), np.empty(n), np.empty(n)
    limits, tables = np.empty(n_squares), (value, slope, bend, most_bend, most_rate)
    for cell in range(n_cells):
        node = cells[cell]
        lower[cell], work[cell] = 0.0, np.inf
        widest, largest, frame = 0, 0.0, 0.0
        for j in range(n):
            h[j] = halves[node[j]]
            if h[j] > h[widest]:
                widest = j
            for k in range(n):
                b[k, j] = value[node[j], k]
                matrix[k, j] = b[k, j]
                largest = max(largest, abs(b[k, j]))
                frame += b[k, j] ** 2
        axis[cell] = widest
        frame = np.sqrt(frame)

        # a lower bound of ‖B‖ in the cell
        least_frame = frame
        for j in range(n):
            a = 0.0
            for k in range(n):
                a += (abs(slope[node[j], k]) + h[j] * most_bend[node[j], k]) ** 2
            least_frame -= h[j] * np.sqrt(a)
        for s in range(n_squares):
            limits[s] = square_limits[s]
            if np.isinf(limits[s]) and least_frame > 0:
                limits[s] = condition / least_frame

        # the bound by duality, under each limit
        nearest = -np.inf
        for s in range(n_squares):
            if regular[s] and np.isfinite(limits[s]):
                bound = dual_bound(node, h, tables, transforms, squares[s], inverses[s], limits[s], SINGULAR, score)
                if bound > nearest:
                    nearest, axis[cell] = bound, _largest(score)
        lower[cell] = max(nearest, 0.0)
        if np.isinf(lower[cell]) or not inverse_of(matrix, m, SINGULAR * largest):
            continue

        # change of the forces over the cell: E = M ΔB
        for i in range(n):
            for j in range(n):
                a, c, d, e = 0.0, 0.0, 0.0, 0.0
                for k in range(n):
                    a += m[i, k] * slope[node[j], k]
                    c += m[i, k] * bend[node[j], k]
                    d += abs(m[i, k]) * most_rate[node[j], k]
                    e += abs(m[i, k]) * most_bend[node[j], k]
                rate[i, j] = a
                curved[i, j] = 0.5 * h[j] ** 2 * min(abs(c) + h[j] * d, e)
                change[i, j] = abs(a) * h[j] + curved[i, j]
        if nearest == -np.inf:
            for j in range(n):
                score[j] = 0.0
                for i in range(n):
                    score[j] += change[i, j]
            axis[cell] = _largest(score)

        # the Neumann series converges if (I - Ē) w = 1 has w > 0, since I - Ē is then an M-matrix
        for i in range(n):
            for j in range(n):
                matrix[i, j] = (1.0 if i == j else 0.0) - change[i, j]
        if not inverse_of(matrix, neumann, 1e-12):
            continue
        converges = True
        for i in range(n):
            a = 0.0
            for j in range(n):
                a += neumann[i, j]
                converges = converges and neumann[i, j] >= 0.0
            converges = converges and a >= 1.0
        if not converges:
            continue
        for i in range(n):
            for j in range(n):
                error[i, j] = 0.0
                for k in range(n):
                    error[i, j] += neumann[i, k] * change[k, j]

        # the limits to first order: aᵀδ <= slack
        open_ = True
        for s in range(n_squares):
            energy = 0.0
            for i in range(n):
                for c in range(n):
                    d = 0.0
                    for k in range(n):
                        d += m[i, k] * roots[s, k, c]
                    weighted[i, c] = d
                    energy += d * d
            energy = np.sqrt(energy)
            for j in range(n):
                directions[s, j] = 0.0
            remainder = 0.0
            for c in range(n):
                for k in range(n):
                    carried[k] = 0.0
                    for j in range(n):
                        carried[k] += error[k, j] * abs(weighted[j, c])
                for i in range(n):
                    share = weighted[i, c] / energy
                    for j in range(n):
                        directions[s, j] -= share * rate[i, j] * weighted[j, c]
                        remainder += abs(share) * (curved[i, j] * abs(weighted[j, c]) + change[i, j] * carried[j])
            slacks[s] = limits[s] - energy + remainder
            reach = 0.0
            for j in range(n):
                reach += abs(directions[s, j]) * h[j]
            if reach < -slacks[s]:
                open_ = False
        n_constraints = n_squares
        worst = -np.inf
        for t in range(n_instants):
            for i in range(n):
                a = 0.0
                for k in range(n):
                    a += m[i, k] * forces[k, t]
                u[i] = a
            for k in range(n):
                v[k] = 0.0
                for j in range(n):
                    v[k] += error[k, j] * abs(u[j])
            for i in range(n):
                reach, remainder = 0.0, 0.0
                for j in range(n):
                    reach += abs(rate[i, j] * u[j]) * h[j]
                    remainder += curved[i, j] * abs(u[j]) + change[i, j] * v[j]
                if abs(u[i]) - reach - remainder > peak:
                    open_ = False
                if abs(u[i]) - remainder > worst:
                    worst = abs(u[i]) - remainder
                    n_constraints = n_squares + 1
                    slacks[n_squares] = peak - worst
                    for j in range(n):
                        directions[n_squares, j] = -np.sign(u[i]) * rate[i, j] * u[j]
        if not open_:
            lower[cell] = np.inf
            continue

        # Y as a linear function of the places plus a remainder
        total = 0.0
        for r in range(n_residual):
            for k in range(n):
                a = 0.0
                for i in range(n):
                    a += value[node[i], n + r] * m[i, k]
                z[r, k] = a
            for j in range(n):
                a, c = slope[node[j], n + r], bend[node[j], n + r]
                d, e = most_rate[node[j], n + r], most_bend[node[j], n + r]
                for k in range(n):
                    a -= z[r, k] * slope[node[j], k]
                    c -= z[r, k] * bend[node[j], k]
                    d += abs(z[r, k]) * most_rate[node[j], k]
                    e += abs(z[r, k]) * most_bend[node[j], k]
                first[r, j] = a
                second[r, j] = 0.5 * h[j] ** 2 * min(abs(c) + h[j] * d, e)
            for q in range(n_columns):
                for i in range(n):
                    a = 0.0
                    for k in range(n):
                        a += m[i, k] * transforms[r, k, q]
                    p[i, q] = a
                y[r, q], rest[r, q] = 0.0, 0.0
                for i in range(n):
                    a = 0.0
                    for j in range(n):
                        a += error[i, j] * abs(p[j, q])
                    p_error[i, q] = a
                    y[r, q] += value[node[i], n + r] * p[i, q]
                    linear[r, q, i] = first[r, i] * p[i, q]
                    rest_by[r, q, i] = second[r, i] * abs(p[i, q]) + (h[i] * abs(first[r, i]) + second[r, i]) * a
                    rest[r, q] += rest_by[r, q, i]
                total += y[r, q] ** 2
                least_y[r, q] = y[r, q]
        work[cell] = np.sqrt(0.5 * total)

        # the least ‖Y‖ to first order, by coordinate descent
        for j in range(n):
            shift[j] = 0.0
        for _ in range(SWEEPS):
            for j in range(n):
                a, d = 0.0, 0.0
                for r in range(n_residual):
                    for q in range(n_columns):
                        a += linear[r, q, j] * least_y[r, q]
                        d += linear[r, q, j] ** 2
                if d > 0.0:
                    target = min(max(shift[j] - a / d, -h[j]), h[j])
                    for r in range(n_residual):
                        for q in range(n_columns):
                            least_y[r, q] += linear[r, q, j] * (target - shift[j])
                    shift[j] = target
        found = 0.0
        for attempt in range(2):
            size = 0.0
            for r in range(n_residual):
                for q in range(n_columns):
                    if attempt == 1:
                        least_y[r, q] = y[r, q]
                    size += least_y[r, q] ** 2
            if size == 0.0:
                continue
            size = np.sqrt(size)
            centre, remainder = 0.0, 0.0
            for j in range(n):
                cost[j] = 0.0
            for r in range(n_residual):
                for q in range(n_columns):
                    a = least_y[r, q] / size
                    centre += a * y[r, q]
                    remainder += abs(a) * rest[r, q]
                    for j in range(n):
                        cost[j] += a * linear[r, q, j]
            least = 0.0
            for j in range(n):
                least -= abs(cost[j]) * h[j]
            for s in range(n_constraints):
                least = max(least, _least_linear(cost, h, directions[s], slacks[s]))
            bound = (centre + least - remainder) / np.sqrt(2.0)
            if attempt == 0 or bound > found:
                found = max(found, bound)
                for j in range(n):
                    score[j] = abs(cost[j]) * h[j]
                    for r in range(n_residual):
                        for q in range(n_columns):
                            score[j] += 2.0 * abs(least_y[r, q]) / size * rest_by[r, q, j]
        if found <= lower[cell]:
            continue
        lower[cell] = found
        for j in range(n):
            a = 0.0
            for i in range(n):
                a += change[i, j]
            score[j] *= 1.0 + a
            if score[j] > score[axis[cell]] * 1.0000001:
                axis[cell] = j
