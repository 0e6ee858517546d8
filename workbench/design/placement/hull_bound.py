"""Exclusion of a cell of places without a better placement, by convex hulls of the modal shapes on its intervals.

With f_j the rows of B⁻¹, any linear T = Σ_j f_j w(x_j) is G / D for D = det B and G = d/dε det(B + εW) at ε = 0. Both
are affine in the column of each actuator. If each column (b(x_j), w(x_j)) stays in the convex hull of a few points, G
and D are at every place the same mean of their values G_k, D_k at all choices k of one point per actuator, so

    G_k >= t |D_k| for every k   implies   |T| >= t at every place where B is regular,

even if B is singular in the cell. T = α ⟨V, Y⟩ + β ⟨A, B⁻¹ S^½⟩ with V and A of unit norm is at most α ‖Y‖ + β L under
a limit ‖B⁻¹ S^½‖ <= L. With t = α y + β L, no placement within the limit has a ‖Y‖ below y. This includes how the
forces change over the cell, where duality (`dual_bound.py`) allows any forces within the limit, and needs no convergent
series (`cell_bounds.py`).

On an interval the shapes differ from the cubic through the Chebyshev points by at most h⁴/192 max |φ''''|, and a cubic
lies in the hull of its four Bernstein points. The remainders e of the columns b and e_w of w - Λᵀb change T by at most

    L ‖S^-½ (e_w - Λᵀe)‖ + L η / (1 - η) ‖S^-½ (w - Λᵀb)‖,   η = L ‖S^-½ e‖ < 1,

for any Λ, with ‖a‖² = Σ_j max_x ‖a(x_j)‖². Here Λ makes w - Λᵀb vanish at the centre. The test holds for any V and A;
those used separate the values of (Y, B⁻¹ S^½) at the choices from those within the limits, by the Frank-Wolfe method.
"""

import numpy as np
from numba import njit

from workbench.arrays import Floats, Integers
from workbench.design.placement.small_matrices import inner, inverse_of, multiply
from workbench.design.placement.task import PlacementTask

STEPS = 4  # of the Frank-Wolfe method: sixteen exclude no more cells
SINGULAR = 1e-9  # least pivot over the largest entry of B for reliable determinants
ROUND_OFF = 1e-6  # of ratios of such determinants
LINE = 12  # steps of the line search

HullTables = tuple[Floats, Floats, Floats, Floats, Floats, Floats, Floats, Floats, float]


def hull_tables(
    task: PlacementTask,
    table: tuple[Floats, Floats, Floats],
    roots: Floats,
    inverses: Floats,
    limits: Floats,
    condition: float,
) -> HullTables:
    """The tables of `raise_to`, from the shapes on the intervals.

    Args:
        task: of the placement.
        table: centre and half-width (n_intervals,), largest fourth derivative (n_intervals, n_modes).
        roots, inverses, limits: S^½ and S^-½ (n_limits, n, n) and L (n_limits,), inf for that of the condition.
        condition: limit of the condition of B.
    """
    centre, half, most_fourth = table
    n = task.n_controlled
    angles = np.pi * np.array([7, 5, 3, 1]) / 8.0
    values = np.array([task.shapes(centre + s * half) for s in np.cos(angles)])
    a = [np.tensordot(np.cos(k * angles), values, 1) * (0.5 if k else 0.25) for k in range(4)]
    remainder = most_fourth * (half[:, None] ** 4 / 192.0)
    c = a[0] - a[2], a[1] - 3.0 * a[3], 2.0 * a[2], 4.0 * a[3]  # c_0 + c_1 s + c_2 s² + c_3 s³
    inner, outer = (c[0] - c[2] / 3.0, c[1] / 3.0 - c[3]), (c[0] + c[2], c[1] + c[3])
    points = np.stack([p + side * q for p, q in (outer, inner) for side in (-1.0, 1.0)], axis=1)
    # of the columns of B on each interval: the least norm, and the remainder weighted by each S^-½
    variation = np.abs(a[1]) + 2.0 * np.abs(a[2]) + np.abs(a[3]) + remainder
    norms = np.linalg.norm(c[0][:, :n], axis=1) - np.linalg.norm(variation[:, :n], axis=1)
    errors = remainder[:, :n] @ np.abs(inverses).transpose(0, 2, 1)
    squared_norms, squared_errors = np.maximum(norms, 0.0) ** 2, (errors**2).sum(axis=2)
    transforms = np.array(task.roots, order="C")
    return points, remainder, squared_norms, squared_errors, transforms, roots, inverses, limits, float(condition)


@njit(cache=True, nogil=True)
def raise_to(wanted: float, cells: Integers, tables: HullTables, lower: Floats) -> None:
    """Raise lower bounds (n_cells,) of √W_R of cells (n_cells, n_actuators) of intervals to `wanted` where proven."""
    points, remainder, squared_norms, squared_errors, transforms, roots, inverses, limits, condition = tables
    n = cells.shape[1]
    for cell in range(len(cells)):
        node = cells[cell]
        tried = lower[cell] < wanted
        for j in range(1, n):  # with two actuators in one interval, B is singular at the centre
            tried = tried and node[j] != node[j - 1]
        if not tried:
            continue
        for s in range(len(roots)):
            limit, norm, error = limits[s], 0.0, 0.0
            for j in range(n):
                norm += squared_norms[node[j]]
                error += squared_errors[s, node[j]]
            if np.isinf(limit) and norm > 0.0:
                limit = condition / np.sqrt(norm)
            eta = limit * np.sqrt(error)
            least = np.sqrt(2.0) * wanted
            if eta < 1.0 and is_excluded(node, points, remainder, transforms, roots[s], inverses[s], limit, eta, least):
                lower[cell] = wanted
                break


@njit(cache=True, nogil=True)
def least_ratio(
    b: Floats, w: Floats, n_points: int, sign: float, stop: float, singular: float, chosen: Integers
) -> tuple[float, float]:
    """The least sign G_k / |D_k| over all choices of one point per actuator, and the sign of D_k of that choice.

    By Gaussian elimination in dual numbers, column by column, so that choices share their common columns.

    Args:
        b, w: (n, n_points or more, n) columns of B and of W.
        n_points: points per actuator, the first ones.
        sign: of D at the centre.
        stop: the search ends at the first ratio below.
        singular: the search ends with -inf at a first pivot of this size or less; the threshold of later pivots grows
            as the round-off does.
        chosen: (n,) set to the choice.
    """
    n = len(b)
    bs, ws = np.empty((n, n, n_points, n)), np.empty((n, n, n_points, n))
    for j in range(n):
        for k in range(n_points):
            for i in range(n):
                bs[0, j, k, i], ws[0, j, k, i] = b[j, k, i], w[j, k, i]
    d, g, least_pivot = np.ones(n), np.zeros(n), np.full(n, singular)
    at = np.full(n, -1)
    least, of_least = np.inf, 1.0
    depth = 0
    while depth >= 0:
        at[depth] += 1
        if at[depth] == n_points:
            depth -= 1
            continue
        own = at[depth]
        if depth == n - 2:  # the last two columns together, as most choices differ in these alone
            first, second = bs[depth, depth, own, n - 2], bs[depth, depth, own, n - 1]
            first_w, second_w = ws[depth, depth, own, n - 2], ws[depth, depth, own, n - 1]
            pivot = max(abs(first), abs(second))
            if not pivot > least_pivot[depth]:
                return -np.inf, 0.0
            for k in range(n_points):
                last, end = bs[depth, n - 1, k, n - 2], bs[depth, n - 1, k, n - 1]
                det = first * end - second * last
                if not abs(det) > least_pivot[depth] * (pivot + max(abs(last), abs(end))):
                    return -np.inf, 0.0
                change = first * ws[depth, n - 1, k, n - 1] - second * ws[depth, n - 1, k, n - 2]
                change += first_w * end - second_w * last
                change = sign * (g[depth] * det + d[depth] * change)
                det *= d[depth]
                if change < least * abs(det):
                    least, of_least = change / abs(det), np.sign(det)
                    for j in range(n - 1):
                        chosen[j] = at[j]
                    chosen[n - 1] = k
                    if least < stop:
                        return least, of_least
            continue
        p = depth
        for i in range(depth + 1, n):
            if abs(bs[depth, depth, own, i]) > abs(bs[depth, depth, own, p]):
                p = i
        pivot, pivot_w = bs[depth, depth, own, p], ws[depth, depth, own, p]
        if not abs(pivot) > least_pivot[depth]:
            return -np.inf, 0.0
        parity = 1.0 if p == depth else -1.0
        d[depth + 1] = parity * d[depth] * pivot
        g[depth + 1] = parity * (g[depth] * pivot + d[depth] * pivot_w)
        most = 0.0
        for j in range(depth + 1, n):
            for k in range(n_points):
                factor = bs[depth, j, k, p] / pivot
                most = max(most, abs(factor))
                factor_w = (ws[depth, j, k, p] - factor * pivot_w) / pivot
                for i in range(depth + 1, n):
                    row = depth if i == p else i
                    column, other = bs[depth, depth, own, row], ws[depth, depth, own, row]
                    bs[depth + 1, j, k, i] = bs[depth, j, k, row] - factor * column
                    ws[depth + 1, j, k, i] = ws[depth, j, k, row] - factor * other - factor_w * column
        least_pivot[depth + 1] = (1.0 + most) * least_pivot[depth]  # grows as the round-off
        depth += 1
        at[depth] = -1
    return least, of_least


@njit(cache=True, nogil=True)
def _squared_excess(a: float, b: float, c: float, t: float, limit: float) -> float:
    """Squared relative excess of ‖(1 - t) u + t v‖ over a limit, from a = ‖u‖², b = ⟨u, v⟩, c = ‖v‖²."""
    s = 1.0 - t
    size = np.sqrt(max(s * s * a + 2.0 * s * t * b + t * t * c, 0.0)) / limit
    return float(max(size - 1.0, 0.0) ** 2)


@njit(cache=True, nogil=True)
def _step(y: Floats, new_y: Floats, f: Floats, new_f: Floats, least: float, limit: float) -> float:
    """The step in (0, 1) to the new point (new_y, new_f) of least excess over both limits."""
    a, b, c = inner(y, y), inner(y, new_y), inner(new_y, new_y)
    p, q, r = inner(f, f), inner(f, new_f), inner(new_f, new_f)
    low, high = 0.0, 1.0
    for _ in range(LINE):
        first, second = low + (high - low) * 0.4, low + (high - low) * 0.6
        at_first = _squared_excess(a, b, c, first, least) + _squared_excess(p, q, r, first, limit)
        at_second = _squared_excess(a, b, c, second, least) + _squared_excess(p, q, r, second, limit)
        if at_first < at_second:
            high = second
        else:
            low = first
    return 0.5 * (low + high)


@njit(cache=True, nogil=True)
def _evaluate(
    columns: Floats,
    transforms: Floats,
    root: Floats,
    sign: float,
    singular: float,
    inverse: Floats,
    y: Floats,
    f: Floats,
) -> bool:
    """Fill B⁻¹, ±Y (n_residual, n_columns) and ±B⁻¹ S^½ of columns (n, n_modes); False where B is singular."""
    n_residual, n, n_columns = transforms.shape
    matrix = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            matrix[i, j] = columns[j, i]
    if not inverse_of(matrix, inverse, singular):
        return False
    multiply(inverse, root, f)
    for i in range(n):
        for j in range(n):
            f[i, j] *= sign
    for r in range(n_residual):
        for q in range(n_columns):
            y[r, q] = 0.0
        for i in range(n):
            z = 0.0
            for j in range(n):
                z += columns[j, n + r] * inverse[j, i]
            for q in range(n_columns):
                y[r, q] += sign * z * transforms[r, i, q]
    return True


@njit(cache=True, nogil=True)
def _residuals(
    node: Integers,
    points: Floats,
    remainder: Floats,
    inverse_root: Floats,
    w: Floats,
    weights: Floats,
    multiplier: Floats,
) -> tuple[float, float]:
    """Norms of S^-½ (w - Λᵀ b) at the points, and of S^-½ (e_w - Λᵀ e), for Λ the multiplier."""
    n, n_points, n_residual = len(node), points.shape[1], len(weights)
    v, at_points, of_remainder = np.empty(n), 0.0, 0.0
    for j in range(n):
        largest = 0.0
        for k in range(n_points):
            for c in range(n):
                v[c] = w[j, k, c]
                for i in range(n):
                    v[c] -= points[node[j], k, i] * multiplier[i, c]
            size = 0.0
            for e in range(n):
                total = 0.0
                for c in range(n):
                    total += inverse_root[e, c] * v[c]
                size += total**2
            largest = max(largest, size)
        at_points += largest
        for c in range(n):
            v[c] = 0.0
            for i in range(n):
                v[c] += remainder[node[j], i] * abs(multiplier[i, c])
            for r in range(n_residual):
                v[c] += remainder[node[j], n + r] * abs(weights[r, c])
        for e in range(n):
            total = 0.0
            for c in range(n):
                total += abs(inverse_root[e, c]) * v[c]
            of_remainder += total**2
    return float(np.sqrt(at_points)), float(np.sqrt(of_remainder))


@njit(cache=True, nogil=True)
def is_excluded(
    node: Integers,
    points: Floats,
    remainder: Floats,
    transforms: Floats,
    root: Floats,
    inverse_root: Floats,
    limit: float,
    eta: float,
    least: float,
) -> bool:
    """Whether no placement in the cell within the limit has a ‖Y‖ below `least`.

    Args:
        points: (n_intervals, 4, n_modes) Bernstein points of the cubics.
        remainder: (n_intervals, n_modes) largest difference of the shapes from the cubics.
        root, inverse_root, limit, eta: S^½ and S^-½ (n, n), L, and η < 1.
        least: y.
    """
    n_points, n_modes = points.shape[1:]
    n_residual, n, n_columns = transforms.shape
    centre, choice = np.empty((n, n_modes)), np.empty((n, n_modes))
    b, middle = np.empty((n, n_points, n)), np.empty((n, 1, n))
    largest = 0.0
    for j in range(n):
        own = points[node[j]]
        for i in range(n_modes):
            centre[j, i] = 0.125 * (own[0, i] + own[1, i]) + 0.375 * (own[2, i] + own[3, i])
        for i in range(n):
            middle[j, 0, i] = centre[j, i]
            largest = max(largest, abs(centre[j, i]))
            for k in range(n_points):
                b[j, k, i] = own[k, i]
    singular = SINGULAR * largest
    y, f = np.empty((n_residual, n_columns)), np.empty((n, n))
    new_y, new_f = np.empty((n_residual, n_columns)), np.empty((n, n))
    inverse, ignored = np.empty((n, n)), np.empty((n, n))
    if not _evaluate(centre, transforms, root, 1.0, singular, inverse, y, f):
        return False
    chosen, w = np.zeros(n, np.int64), np.empty((n, n_points, n))
    weights, constant, at_centre = np.empty((n_residual, n)), np.empty((n, n)), np.empty(n)
    _, sign = least_ratio(middle, middle, middle.shape[1], 1.0, -np.inf, singular, chosen)
    for _ in range(STEPS):
        size_y, size_f = np.sqrt(inner(y, y)), np.sqrt(inner(f, f))
        alpha, beta = max(size_y / least - 1.0, 0.0) / least, max(size_f / limit - 1.0, 0.0) / limit
        if alpha == 0.0 and beta == 0.0:
            return False  # a mean of choices is within both limits, so the cell cannot be excluded
        for r in range(n_residual):
            for i in range(n):
                weights[r, i] = 0.0
                for q in range(n_columns):
                    if alpha > 0.0:
                        weights[r, i] += alpha / size_y * transforms[r, i, q] * y[r, q]
        for j in range(n):
            for c in range(n):
                constant[j, c] = 0.0
                for i in range(n):
                    if beta > 0.0:
                        constant[j, c] += beta / size_f * f[j, i] * root[c, i]
                for k in range(n_points):
                    w[j, k, c] = constant[j, c]
                    for r in range(n_residual):
                        w[j, k, c] += points[node[j], k, n + r] * weights[r, c]
        needed = (1.0 + ROUND_OFF) * (alpha * least + beta * limit)
        # first with the first half of the points alone, the ends of the intervals, which is cheap
        ratio, of_choice = least_ratio(b, w, n_points // 2, sign, -np.inf, singular, chosen)
        if ratio >= needed:
            multiplier = np.zeros((n, n))
            for j in range(n):
                for c in range(n):
                    at_centre[c] = constant[j, c]
                    for r in range(n_residual):
                        at_centre[c] += centre[j, n + r] * weights[r, c]
                for i in range(n):
                    for c in range(n):
                        multiplier[i, c] += inverse[j, i] * at_centre[c]
            at_points, of_remainder = _residuals(node, points, remainder, inverse_root, w, weights, multiplier)
            needed += limit * (of_remainder + eta / (1.0 - eta) * at_points)
            ratio, of_choice = least_ratio(b, w, n_points, sign, needed, singular, chosen)
            if ratio >= needed:
                return True
        for j in range(n):
            for i in range(n_modes):
                choice[j, i] = points[node[j], chosen[j], i]
        sign_there = sign * of_choice
        if np.isinf(ratio) or not _evaluate(choice, transforms, root, sign_there, singular, ignored, new_y, new_f):
            return False
        t = _step(y, new_y, f, new_f, least, limit)
        for r in range(n_residual):
            for q in range(n_columns):
                y[r, q] = (1.0 - t) * y[r, q] + t * new_y[r, q]
        for i in range(n):
            for c in range(n):
                f[i, c] = (1.0 - t) * f[i, c] + t * new_f[i, c]
    return False
