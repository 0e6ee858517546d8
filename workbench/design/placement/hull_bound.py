"""Whether a cell of places can hold a better placement, by the corners of polygons about the modal shapes.

With f_j the rows of B⁻¹, any linear T = Σ_j f_j w(x_j) is G / D for D = det B and G = d/dε det(B + εW) at ε = 0. Both
are affine in the column of each actuator. Where each column (b(x_j), w(x_j)) stays in the convex hull of a few points,
G and D are at every place the same mean of their values G_k, D_k at all choices k of one point an actuator, so

    G_k >= t |D_k| for every k   implies   |T| >= t at every place where B is regular,

though B be singular in the cell. T = α ⟨V, Y⟩ + β ⟨A, B⁻¹ S^½⟩ with V and A of unit size is at most α ‖Y‖ + β L under
a limit ‖B⁻¹ S^½‖ <= L: where t = α y + β L, none that keeps the limit has a ‖Y‖ below y. This follows the true change
of the forces over the cell, where duality (`dual_bound.py`) allows any forces within the limit, and needs no
convergent series (`cell_bounds.py`).

The shapes on an interval are a_0 + a_1 s + a_2 (2s² - 1), |s| <= 1, to within h³/24 max |φ'''|, by interpolation at
Chebyshev's points. The parabola (s, 2s² - 1) lies in the trapezoid of its tangents at s = -1, 0, 1. The remainder e of
the columns b, and e_w of w - Λᵀb, change T by at most

    L ‖S^-½ (e_w - Λᵀe)‖ + L η / (1 - η) ‖S^-½ (w - Λᵀb)‖,   η = L ‖S^-½ e‖ < 1,

for any Λ; that of the centre makes w - Λᵀb vanish there. V and A only decide whether the test succeeds: they separate
the values of (Y, B⁻¹ S^½) at the corners from all that the limits leave, by the method of Frank and Wolfe.
"""

import numpy as np
from numba import njit

from workbench.arrays import Floats, Integers
from workbench.design.placement.dual_bound import inverse_of

STEPS = 4  # of Frank and Wolfe: sixteen prove no more cells
MOST_REMAINDER = 0.5  # η from which a cell is too wide to try
SINGULAR = 1e-13  # pivot over the largest entry of B
LINE = 12  # steps of the search along a line


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
        singular: pivots of this size or less end it too, with -inf.
        chosen: (n,) set to the choice.
    """
    n, n_points, _ = b.shape
    bs, ws = np.empty((n, n, n_points, n)), np.empty((n, n, n_points, n))
    bs[0], ws[0] = b, w
    d, g = np.ones(n), np.zeros(n)
    at = np.full(n, -1)
    least, of_least = np.inf, 1.0
    depth = 0
    while depth >= 0:
        at[depth] += 1
        if at[depth] == n_points:
            depth -= 1
            continue
        column, other = bs[depth, depth, at[depth]], ws[depth, depth, at[depth]]
        if depth == n - 2:  # the last two columns at once: most of the choices differ in these alone
            last, last_w = bs[depth, n - 1], ws[depth, n - 1]
            first, second, first_w, second_w = column[n - 2], column[n - 1], other[n - 2], other[n - 1]
            for k in range(n_points):
                det = first * last[k, n - 1] - second * last[k, n - 2]
                change = first * last_w[k, n - 1] - second * last_w[k, n - 2]
                change += first_w * last[k, n - 1] - second_w * last[k, n - 2]
                change = sign * (g[depth] * det + d[depth] * change)
                det *= d[depth]
                if change < least * abs(det) or (det == 0.0 and change < 0.0):
                    least, of_least = change / abs(det) if det != 0.0 else -np.inf, np.sign(det)
                    chosen[:] = at
                    chosen[n - 1] = k
                    if least < stop:
                        return least, of_least
            continue
        p = depth
        for i in range(depth + 1, n):
            if abs(column[i]) > abs(column[p]):
                p = i
        pivot = column[p]
        if not abs(pivot) > singular:
            return -np.inf, 0.0
        turn = 1.0 if p == depth else -1.0
        d[depth + 1] = turn * d[depth] * pivot
        g[depth + 1] = turn * (g[depth] * pivot + d[depth] * other[p])
        for j in range(depth + 1, n):
            for k in range(n_points):
                source, source_w = bs[depth, j, k], ws[depth, j, k]
                target, target_w = bs[depth + 1, j, k], ws[depth + 1, j, k]
                factor = source[p] / pivot
                factor_w = (source_w[p] - factor * other[p]) / pivot
                for i in range(depth + 1, n):
                    row = depth if i == p else i
                    target[i] = source[row] - factor * column[row]
                    target_w[i] = source_w[row] - factor * other[row] - factor_w * column[row]
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
    columns: Floats, transforms: Floats, root: Floats, sign: float, singular: float, y: Floats, f: Floats
) -> bool:
    """Y (n_residual, n_columns) and B⁻¹ S^½ (n, n) of columns (n, n_modes), each by the sign; whether B is regular."""
    n = columns.shape[0]
    inverse = np.empty((n, n))
    if not inverse_of(np.ascontiguousarray(columns[:, :n].T), inverse, singular):
        return False
    f[:] = sign * (inverse @ root)
    z = sign * (columns[:, n:].T @ inverse)
    for r in range(y.shape[0]):
        y[r] = z[r] @ transforms[r]
    return True


@njit(cache=True, nogil=True)
def is_excluded(
    quadratics: tuple[Floats, Floats, Floats],
    remainder: Floats,
    transforms: Floats,
    root: Floats,
    inverse_root: Floats,
    limit: float,
    least: float,
) -> bool:
    """Whether no placement in the cell that keeps the limit has a ‖Y‖ below the least.

    Args:
        quadratics: a_0, a_1 and a_2, each (n, n_modes).
        remainder: (n, n_modes) by how much the shapes differ from them at most.
        transforms: T (n_residual, n, n_columns).
        root, inverse_root, limit: S^½ and S^-½, (n, n), and L.
    """
    mean, linear, square = quadratics
    n, n_modes = mean.shape
    n_residual, _, n_columns = transforms.shape
    size = np.abs(inverse_root.T)
    eta = limit * np.sqrt(((remainder[:, :n] @ size) ** 2).sum())
    if not eta < MOST_REMAINDER:
        return False
    singular = SINGULAR * np.abs(mean[:, :n]).max()
    corners = np.empty((n, 4, n_modes))
    for j in range(n):
        corners[j, 0] = mean[j] - linear[j] + square[j]
        corners[j, 1] = mean[j] + linear[j] + square[j]
        corners[j, 2] = mean[j] - 0.5 * linear[j] - square[j]
        corners[j, 3] = mean[j] + 0.5 * linear[j] - square[j]
    centre = mean - square
    b = np.ascontiguousarray(corners[:, :, :n])
    w = np.empty((n, 4, n))
    y, f = np.empty((n_residual, n_columns)), np.empty((n, n))
    new_y, new_f = np.empty((n_residual, n_columns)), np.empty((n, n))
    chosen, choice = np.zeros(n, np.int64), np.empty((n, n_modes))
    middle = np.ascontiguousarray(centre[:, :n])
    inverse = np.empty((n, n))
    if not inverse_of(middle.T.copy(), inverse, singular):
        return False
    _, sign = least_ratio(middle.reshape(n, 1, n), middle.reshape(n, 1, n), 1.0, -np.inf, singular, chosen)
    if sign == 0.0 or not _evaluate(centre, transforms, root, 1.0, singular, y, f):
        return False
    for _ in range(STEPS):
        size_y, size_f = np.sqrt((y**2).sum()), np.sqrt((f**2).sum())
        alpha, beta = max(size_y / least - 1.0, 0.0) / least, max(size_f / limit - 1.0, 0.0) / limit
        if alpha == 0.0 and beta == 0.0:
            return False  # a mean of corners is where a better placement might be
        weights = np.zeros((n_residual, n))
        if alpha > 0.0:
            for r in range(n_residual):
                weights[r] = transforms[r] @ (alpha / size_y * y[r])
        constant = (beta / size_f * f) @ root.T
        for j in range(n):
            w[j] = corners[j, :, n:] @ weights + constant[j]
        multiplier = inverse.T @ (centre[:, n:] @ weights + constant)
        rest = remainder[:, n:] @ np.abs(weights) + remainder[:, :n] @ np.abs(multiplier)
        needed = alpha * least + beta * limit + limit * np.sqrt(((rest @ size) ** 2).sum())
        slope = (linear[:, n:] @ weights - linear[:, :n] @ multiplier) @ inverse_root.T
        bend = 2.0 * (square[:, n:] @ weights - square[:, :n] @ multiplier) @ inverse_root.T
        change = np.sqrt(((np.sqrt((slope**2).sum(axis=1)) + np.sqrt((bend**2).sum(axis=1))) ** 2).sum())
        needed += limit * eta / (1.0 - eta) * change
        ratio, of_choice = least_ratio(b[:, :2].copy(), w[:, :2].copy(), sign, -np.inf, singular, chosen)
        if ratio >= needed:
            ratio, of_choice = least_ratio(b, w, sign, needed, singular, chosen)
            if ratio >= needed:
                return True
        for j in range(n):
            choice[j] = corners[j, chosen[j]]
        if np.isinf(ratio) or not _evaluate(choice, transforms, root, sign * of_choice, singular, new_y, new_f):
            return False
        t = _step(y, new_y, f, new_f, least, limit)
        y, f = (1.0 - t) * y + t * new_y, (1.0 - t) * f + t * new_f
    return False
