"""Bounds of the spillover work on cells of places by duality; B may be singular in the cell.

With f_j the rows of F = B⁻¹, b_j = b(x_j) the columns of B, Σ_j b_j f_j = I. A limit is Σ_j ‖f_j S^½‖² <= L². For V of
unit norm and any Λ, with g(x) = Σ_r φ_r(x) V_rᵀ T_rᵀ,

    ‖Y‖ >= ⟨V, Y⟩ = tr Λ + Σ_j f_j (g(x_j) - Λᵀ b(x_j)) >= tr Λ - L (Σ_j max_x ‖S^-½ (g(x) - Λᵀ b(x))‖²)^½

(a semi-infinite Lagrange dual), where each maximum is over one interval alone. With g = 0 it follows that a cell in
which tr Λ > L (...)^½ holds no placement within the limit. If no force acts in some direction, as of two rigid modes
moved alike, S and every T_r vanish there; S^-½ is then the pseudo-inverse, and the rows of Λ too have no part there.

The bound holds for any V and Λ. Those used here are optimal if each interval is replaced by its two ends: with c the
shapes at the centres above their changes to the ends, D = cᵀ c and T = tr D⁻¹ S, the least value of the limited square,
Λ = D⁻¹ cᵀ g + t D⁻¹ S with t² (L² - T) = ‖(g - c D⁻¹ cᵀ g) S^-½‖². V is along the Y of least norm of all F within the
limit, by the Frank-Wolfe method.
"""

import numpy as np
from numba import njit

from workbench.arrays import Floats, Integers
from workbench.design.placement.small_matrices import inner, inverse_of, multiply, multiply_transposed

STEPS = 4  # of the Frank-Wolfe method
BARELY = 1e-6  # of L²: least value of L² - T, so that t stays finite
ROUND_OFF = 1e-8  # of g: a smaller residual g - c D⁻¹ cᵀ g is round-off, as in a cell of one place

# value, slope, curvature, most curvature and most rate, (n_nodes, n_modes)
Tables = tuple[Floats, Floats, Floats, Floats, Floats]

# Arguments of the compiled functions of cell bounds: node and h, (n,) the intervals of a cell and their half-widths;
# tables of the shapes on all intervals; transforms, T (n_residual, n, n_columns); score, (n,) set to how much the width
# of each interval weakens the bound.


@njit(cache=True, nogil=True)
def expanded(weights: Floats, node: int, h: float, tables: Tables) -> tuple[float, float, float]:
    """Value and slope of Σ_i w_i φ_i(x) at the centre of an interval, and its largest distance from the tangent there.

    The weights w may be those of the first modes alone.
    """
    value, slope, curvature, most_curvature, most_rate = tables
    at, steep, curved, rate, most = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(weights.size):
        at += weights[i] * value[node, i]
        steep += weights[i] * slope[node, i]
        curved += weights[i] * curvature[node, i]
        rate += abs(weights[i]) * most_rate[node, i]
        most += abs(weights[i]) * most_curvature[node, i]
    return at, steep, 0.5 * h**2 * min(abs(curved) + h * rate, most)


@njit(cache=True, nogil=True)
def _responses(residual: Floats, transforms: Floats, forces: Floats, y: Floats) -> None:
    """Write Y_r = T_rᵀ Σ_j φ_r(x_j) f_j of each residual mode into `y`, (n_residual, n_columns)."""
    n_residual, n, n_columns = transforms.shape
    for r in range(n_residual):
        for q in range(n_columns):
            y[r, q] = 0.0
        for i in range(n):
            total = 0.0
            for k in range(residual.shape[0]):
                total += residual[k, r] * forces[k, i]
            for q in range(n_columns):
                y[r, q] += transforms[r, i, q] * total


@njit(cache=True, nogil=True)
def _largest_residual(node: Integers, h: Floats, tables: Tables, both: Floats, root: Floats, score: Floats) -> float:
    """An upper bound of (Σ_j max_x ‖S^-½ (g(x) - Λᵀ b(x))‖²)^½ over the cell, where g(x) - Λᵀ b(x) = φ(x) `both`.

    Args:
        both: (n_modes, n) -Λ above the weights V_rᵀ T_rᵀ.
        root: (n, n) S^-½.
    """
    n_modes, n = both.shape
    weighted = np.empty((n, n_modes))
    for c in range(n):
        for i in range(n_modes):
            weighted[c, i] = 0.0
            for k in range(n):
                weighted[c, i] += both[i, k] * root[c, k]
    total = 0.0
    for j in range(n):
        at, low, high, beyond = 0.0, 0.0, 0.0, 0.0
        for c in range(n):
            centre, steep, rest = expanded(weighted[c], node[j], h[j], tables)
            at += centre**2
            low += (centre - h[j] * steep) ** 2
            high += (centre + h[j] * steep) ** 2
            beyond += rest**2
        # the linear part is largest at an end, since a norm is convex
        largest = (np.sqrt(max(low, high)) + np.sqrt(beyond)) ** 2
        score[j] = largest - at
        total += largest
    return float(np.sqrt(total))


@njit(cache=True, nogil=True)
def dual_bound(
    node: Integers,
    h: Floats,
    tables: Tables,
    transforms: Floats,
    square: Floats,
    root: Floats,
    limit: float,
    singular: float,
    score: Floats,
) -> float:
    """Lower bound of √W_R in a cell under one limit; inf if no placement meets the limit, -inf if no bound is found.

    Args:
        square, root, limit: S (n, n), S^-½ and L.
        singular: least pivot of D over its largest entry.
    """
    value, slope = tables[0], tables[1]
    n, n_modes = h.size, value.shape[1]
    n_residual, _, n_columns = transforms.shape
    c, residual = np.empty((2 * n, n)), np.empty((2 * n, n_residual))
    for j in range(n):
        for k in range(n):
            c[j, k], c[n + j, k] = value[node[j], k], h[j] * slope[node[j], k]
        for r in range(n_residual):
            residual[j, r], residual[n + j, r] = value[node[j], n + r], h[j] * slope[node[j], n + r]
    gram, d, least = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    multiply_transposed(c, c, gram)
    pivot = 0.0
    for i in range(n):
        pivot = max(pivot, singular * gram[i, i])  # the largest entry of a Gramian is on the diagonal
    exact = inverse_of(gram.copy(), d, pivot)
    if not exact:  # singular to round-off, as beside a support: a ridge is added, since any D may exclude a cell
        for i in range(n):
            gram[i, i] += 2.0 * pivot
        if not inverse_of(gram, d, pivot):
            return -np.inf
    multiply(d, square, least)
    both, t = np.zeros((n_modes, n)), 0.0
    for i in range(n):
        t += least[i, i]
        for k in range(n):
            both[i, k] = -least[i, k]
    if t >= limit**2 and t > limit * _largest_residual(node, h, tables, both, root, score):
        return np.inf
    if not exact:
        return -np.inf
    left = np.sqrt(max(limit**2 - t, BARELY * limit**2))
    forces, pushed, other = np.empty((2 * n, n)), np.empty((2 * n, n)), np.empty((n, n))
    g, rest, weighted = np.empty((2 * n, n)), np.empty((2 * n, n)), np.empty((2 * n, n))
    weights, projected, multiplier = np.empty((n_residual, n)), np.empty((n, n)), np.empty((n, n))
    y, change = np.empty((n_residual, n_columns)), np.empty((n_residual, n_columns))
    multiply(c, d, forces)
    multiply_transposed(root, root, other)
    _responses(residual, transforms, forces, y)
    outside = 0.0
    for step in range(STEPS + 1):
        size = np.sqrt(inner(y, y))
        if size == 0.0:
            return -np.inf
        for r in range(n_residual):
            for i in range(n):
                weights[r, i] = 0.0
                for q in range(n_columns):
                    weights[r, i] += transforms[r, i, q] * y[r, q] / size
        multiply(residual, weights, g)
        multiply_transposed(c, g, projected)
        multiply(d, projected, multiplier)
        multiply(c, multiplier, rest)
        for j in range(2 * n):
            for i in range(n):
                rest[j, i] = g[j, i] - rest[j, i]
        multiply(g, other, weighted)
        of_all = np.sqrt(inner(g, weighted))
        multiply(rest, other, weighted)
        outside = np.sqrt(max(inner(rest, weighted), 0.0))
        if step == STEPS or outside <= ROUND_OFF * of_all:
            break
        for j in range(2 * n):
            for i in range(n):
                pushed[j, i] = forces[j, i] - left / outside * weighted[j, i]
        _responses(residual, transforms, pushed, change)
        for r in range(n_residual):
            for q in range(n_columns):
                change[r, q] -= y[r, q]
        a = inner(change, change)
        if a == 0.0:
            break
        share = min(max(-inner(y, change) / a, 0.0), 1.0)
        for r in range(n_residual):
            for q in range(n_columns):
                y[r, q] += share * change[r, q]
    trace = 0.0
    for i in range(n):
        for k in range(n):
            both[i, k] = -(multiplier[i, k] + outside / left * least[i, k])
        trace -= both[i, i]
    for r in range(n_residual):
        for i in range(n):
            both[n + r, i] = weights[r, i]
    return float((trace - limit * _largest_residual(node, h, tables, both, root, score)) / np.sqrt(2.0))
