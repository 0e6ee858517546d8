"""Whether a cell of places can hold a better placement, by the hulls of the modal shapes on its intervals.

With f_j the rows of B⁻¹, any linear T = Σ_j f_j w(x_j) is G / D for D = det B and G = d/dε det(B + εW) at ε = 0. Both
are affine in the column of each actuator. Where each column (b(x_j), w(x_j)) stays in the convex hull of a few points,
G and D are at every place the same mean of their values G_k, D_k at all choices k of one point an actuator, so

    G_k >= t |D_k| for every k   implies   |T| >= t at every place where B is regular,

though B be singular in the cell. T = α ⟨V, Y⟩ + β ⟨A, B⁻¹ S^½⟩ with V and A of unit size is at most α ‖Y‖ + β L under
a limit ‖B⁻¹ S^½‖ <= L: where t = α y + β L, none that keeps the limit has a ‖Y‖ below y. This follows the true change
of the forces over the cell, where duality (`dual_bound.py`) allows any forces within the limit, and needs no
convergent series (`cell_bounds.py`).

On an interval the shapes follow the cubic through Chebyshev's points to within h⁴/192 max |φ''''|, and a cubic lies in
the hull of its four Bernstein points. The remainder e of the columns b, and e_w of w - Λᵀb, change T by at most

    L ‖S^-½ (e_w - Λᵀe)‖ + L η / (1 - η) ‖S^-½ (w - Λᵀb)‖,   η = L ‖S^-½ e‖ < 1,

for any Λ, with ‖a‖² = Σ_j max_x ‖a(x_j)‖²; that of the centre makes w - Λᵀb vanish there. V and A only decide whether
the test succeeds: they separate the values of (Y, B⁻¹ S^½) at the choices from all that the limits leave, by the method
of Frank and Wolfe.
"""

import numpy as np
from numba import njit

from workbench.arrays import Floats, Integers
from workbench.design.placement.dual_bound import inverse_of, product
from workbench.design.placement.task import PlacementTask

STEPS = 4  # of Frank and Wolfe: sixteen prove no more cells
SINGULAR = 1e-9  # pivot over the largest entry of B: below, determinants are not trusted
ROUND_OFF = 1e-6  # of ratios of determinants whose pivots are above
LINE = 12  # steps of the search along a line


class HullBound:
    """Excludes cells (n_cells, n_actuators) of intervals that hold no placement as good as wanted within the limits."""

    def __init__(
        self,
        task: PlacementTask,
        measures: tuple[Floats, Floats, Floats],
        roots: Floats,
        inverses: Floats,
        limits: Floats,
        condition: float,
    ) -> None:
        """Tables of the shapes on intervals.

        Args:
            measures: centre and half-width (n_intervals,), largest fourth derivative (n_intervals, n_modes).
            roots, inverses, limits: S^½ and S^-½ (n_limits, n, n) and L (n_limits,), inf for that of the condition.
        """
        n = task.n_controlled
        centre, half, most_fourth = measures
        angles = np.pi * np.array([7, 5, 3, 1]) / 8.0
        values = np.array([task.shapes(centre + s * half) for s in np.cos(angles)])
        a = [np.tensordot(np.cos(k * angles), values, 1) * (0.5 if k else 0.25) for k in range(4)]
        remainder = most_fourth * (half[:, None] ** 4 / 192.0)
        c = a[0] - a[2], a[1] - 3.0 * a[3], 2.0 * a[2], 4.0 * a[3]  # c_0 + c_1 s + c_2 s² + c_3 s³
        inner, outer = (c[0] - c[2] / 3.0, c[1] / 3.0 - c[3]), (c[0] + c[2], c[1] + c[3])
        points = np.stack([p + side * q for p, q in (outer, inner) for side in (-1.0, 1.0)], axis=1)
        # of the columns of B on each interval: the least size, and the remainder weighted by each S^-½
        spread = np.abs(a[1]) + 2.0 * np.abs(a[2]) + np.abs(a[3]) + remainder
        sizes = np.linalg.norm(c[0][:, :n], axis=1) - np.linalg.norm(spread[:, :n], axis=1)
        doubts = remainder[:, :n] @ np.abs(inverses).transpose(0, 2, 1)
        self._arguments = (
            points,
            remainder,
            np.maximum(sizes, 0.0) ** 2,
            (doubts**2).sum(axis=2),
            np.ascontiguousarray(task.roots),
            roots,
            inverses,
            limits,
            float(condition),
        )

    def raise_to(self, wanted: float, cells: Integers, lower: Floats) -> None:
        """Raise lower bounds (n_cells,) of √W_R that are below to what is wanted, where that is proven."""
        _raise_to(wanted, cells, *self._arguments, lower)


@njit(cache=True, nogil=True)
def _raise_to(
    wanted: float,
    cells: Integers,
    points: Floats,
    remainder: Floats,
    squared_sizes: Floats,
    squared_doubts: Floats,
    transforms: Floats,
    roots: Floats,
    inverses: Floats,
    limits: Floats,
    condition: float,
    lower: Floats,
) -> None:
    n = cells.shape[1]
    for cell in range(len(cells)):
        node = cells[cell]
        tried = lower[cell] < wanted
        for j in range(1, n):  # two in one interval: B is singular at the centre
            tried = tried and node[j] != node[j - 1]
        if not tried:
            continue
        for s in range(len(roots)):
            limit, size, doubt = limits[s], 0.0, 0.0
            for j in range(n):
                size += squared_sizes[node[j]]
                doubt += squared_doubts[s, node[j]]
            if np.isinf(limit) and size > 0.0:
                limit = condition / np.sqrt(size)
            eta = limit * np.sqrt(doubt)
            least = np.sqrt(2.0) * wanted
            if eta < 1.0 and is_excluded(
                points[node], remainder[node], transforms, roots[s], inverses[s], limit, eta, least
            ):
                lower[cell] = wanted
                break


@njit(cache=True, nogil=True)
def least_ratio(
    b: Floats, w: Floats, sign: float, stop: float, singular: float, chosen: Integers
) -> tuple[float, float]:
    """Least sign G_k / |D_k| over all choices of one point an actuator, and the sign of that D_k.

    By Gauss's elimination in dual numbers, a column at a time, so that choices share what they have in common.

    Args:
        b, w: (n, n_points, n) columns of B and of W.
        sign: of D at the centre.
        stop: the first ratio below ends the search.
        singular: a first pivot of this size or less ends it too, with -inf; later ones likewise, by as much more as the
            round-off has grown.
        chosen: (n,) set to the choice.
    """
    n, n_points, _ = b.shape
    bs, ws = np.empty((n, n, n_points, n)), np.empty((n, n, n_points, n))
    bs[0], ws[0] = b, w
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
        if depth == n - 2:  # the last two columns at once: most of the choices differ in these alone
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
                    chosen[:] = at
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
        turn = 1.0 if p == depth else -1.0
        d[depth + 1] = turn * d[depth] * pivot
        g[depth + 1] = turn * (g[depth] * pivot + d[depth] * pivot_w)
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
        least_pivot[depth + 1] = (1.0 + most) * least_pivot[depth]  # as the round-off does
        depth += 1
        at[depth] = -1
    return least, of_least


@njit(cache=True, nogil=True)
def _step(y: Floats, new_y: Floats, f: Floats, new_f: Floats, least: float, limit: float) -> float:
    """Share of the way to the new point at which the distance to what the limits leave is least."""
    a, b, c = (y * y).sum(), (y * new_y).sum(), (new_y * new_y).sum()
    p, q, r = (f * f).sum(), (f * new_f).sum(), (new_f * new_f).sum()
    low, high = 0.0, 1.0
    for _ in range(LINE):
        first, second = low + (high - low) * 0.4, low + (high - low) * 0.6
        distances = np.empty(2)
        for i, t in enumerate((first, second)):
            s = 1.0 - t
            size = np.sqrt(max(s * s * a + 2.0 * s * t * b + t * t * c, 0.0)) / least
            force = np.sqrt(max(s * s * p + 2.0 * s * t * q + t * t * r, 0.0)) / limit
            distances[i] = max(size - 1.0, 0.0) ** 2 + max(force - 1.0, 0.0) ** 2
        if distances[0] < distances[1]:
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
    """B⁻¹ of columns (n, n_modes), and by the sign Y (n_residual, n_columns) and B⁻¹ S^½; whether B is regular."""
    n = columns.shape[0]
    if not inverse_of(columns[:, :n].T.copy(), inverse, singular):
        return False
    f[:] = sign * product(inverse, root)
    z = sign * product(columns[:, n:].T, inverse)
    for r in range(y.shape[0]):
        y[r] = product(z[r : r + 1], transforms[r])[0]
    return True


@njit(cache=True, nogil=True)
def is_excluded(
    points: Floats,
    remainder: Floats,
    transforms: Floats,
    root: Floats,
    inverse_root: Floats,
    limit: float,
    eta: float,
    least: float,
) -> bool:
    """Whether no placement in the cell that keeps the limit has a ‖Y‖ below the least.

    Args:
        points: (n, 4, n_modes) of Bernstein, of the cubics.
        remainder: (n, n_modes) by how much the shapes differ from the cubics at most.
        transforms: T (n_residual, n, n_columns).
        root, inverse_root, limit, eta: S^½ and S^-½ (n, n), L, and η < 1.
    """
    n, n_points, n_modes = points.shape
    n_residual, _, n_columns = transforms.shape
    centre = 0.125 * (points[:, 0] + points[:, 1]) + 0.375 * (points[:, 2] + points[:, 3])
    singular = SINGULAR * np.abs(centre[:, :n]).max()
    y, f = np.empty((n_residual, n_columns)), np.empty((n, n))
    new_y, new_f = np.empty((n_residual, n_columns)), np.empty((n, n))
    inverse, ignored = np.empty((n, n)), np.empty((n, n))
    if not _evaluate(centre, transforms, root, 1.0, singular, inverse, y, f):
        return False
    chosen, choice = np.zeros(n, np.int64), np.empty((n, n_modes))
    b = np.ascontiguousarray(points[:, :, :n])
    ends, every = b[:, :2].copy(), points.reshape(-1, n_modes)
    middle = centre[:, :n].copy().reshape(n, 1, n)
    _, sign = least_ratio(middle, middle, 1.0, -np.inf, singular, chosen)
    for _ in range(STEPS):
        size_y, size_f = np.sqrt((y**2).sum()), np.sqrt((f**2).sum())
        alpha, beta = max(size_y / least - 1.0, 0.0) / least, max(size_f / limit - 1.0, 0.0) / limit
        if alpha == 0.0 and beta == 0.0:
            return False  # a mean of choices is where a better placement might be
        weights = np.zeros((n_residual, n))
        if alpha > 0.0:
            for r in range(n_residual):
                weights[r] = alpha / size_y * product(y[r : r + 1], transforms[r].T)[0]
        constant = beta / size_f * product(f, root.T)
        w = product(every[:, n:], weights).reshape(n, n_points, n) + constant.reshape(n, 1, n)
        needed = (1.0 + ROUND_OFF) * (alpha * least + beta * limit)
        ratio, of_choice = least_ratio(ends, w[:, :2].copy(), sign, -np.inf, singular, chosen)
        if ratio >= needed:  # at the ends of the intervals alone, which takes little time
            multiplier = product(inverse.T, product(centre[:, n:], weights) + constant)
            left = product(w.reshape(-1, n) - product(every[:, :n], multiplier), inverse_root.T)
            change = 0.0
            for j in range(n):
                change += (left[n_points * j : n_points * (j + 1)] ** 2).sum(axis=1).max()
            rest = product(remainder[:, n:], np.abs(weights)) + product(remainder[:, :n], np.abs(multiplier))
            rest = product(rest, np.abs(inverse_root.T))
            needed += limit * (np.sqrt((rest**2).sum()) + eta / (1.0 - eta) * np.sqrt(change))
            ratio, of_choice = least_ratio(b, w, sign, needed, singular, chosen)
            if ratio >= needed:
                return True
        for j in range(n):
            choice[j] = points[j, chosen[j]]
        if np.isinf(ratio) or not _evaluate(
            choice, transforms, root, sign * of_choice, singular, ignored, new_y, new_f
        ):
            return False
        t = _step(y, new_y, f, new_f, least, limit)
        y, f = (1.0 - t) * y + t * new_y, (1.0 - t) * f + t * new_f
    return False
