"""Bounds of the spillover work on cells of places by duality, however near B is to singular in the cell.

With f_j the rows of F = B⁻¹, b_j = b(x_j) the columns of B, Σ_j b_j f_j = I. A limit is Σ_j ‖f_j S^½‖² <= L². For V of
unit size and any Λ, with g(x) = Σ_r φ_r(x) V_rᵀ T_rᵀ,

    ‖Y‖ >= ⟨V, Y⟩ = tr Λ + Σ_j f_j (g(x_j) - Λᵀ b(x_j)) >= tr Λ - L (Σ_j max_x ‖S^-½ (g(x) - Λᵀ b(x))‖²)^½

(a semi-infinite Lagrange dual), where each maximum is over one interval alone. Without g the same says that a cell in
which tr Λ > L (...)^½ holds no placement within the limit.

V and Λ only decide how good the bound is. They are optimal for cells with the two ends of each interval in place of all
of it: with c the shapes at the centres above their changes to the ends, D = cᵀ c and T = tr D⁻¹ S, the least square
that is limited, Λ = D⁻¹ cᵀ g + t D⁻¹ S with t² (L² - T) = ‖(g - c D⁻¹ cᵀ g) S^-½‖². V is Y of the least ‖Y‖ of all F
within the limit, by the method of Frank and Wolfe.
"""

import numpy as np
from numba import njit

from workbench.arrays import Floats

STEPS = 4  # of Frank and Wolfe
BARELY = 1e-6  # share of L² that T leaves at least, for the sake of t
ROUND_OFF = 1e-8  # share of g that no Λ can be said to leave: a cell of one place leaves nothing


@njit(cache=True, nogil=True)
def inverse_of(matrix: Floats, inverse: Floats, least: float) -> bool:
    """Gauss-Jordan with pivots; whether every pivot is above the least. The matrix is destroyed."""
    n = matrix.shape[0]
    for i in range(n):
        for j in range(n):
            inverse[i, j] = 1.0 if i == j else 0.0
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[best, k]):
                best = i
        pivot = matrix[best, k]
        if not abs(pivot) > least:
            return False
        if best != k:
            for j in range(n):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
                inverse[k, j], inverse[best, j] = inverse[best, j], inverse[k, j]
        for j in range(n):
            matrix[k, j] /= pivot
            inverse[k, j] /= pivot
        for i in range(n):
            factor = matrix[i, k]
            if i != k and factor != 0.0:
                for j in range(n):
                    matrix[i, j] -= factor * matrix[k, j]
                    inverse[i, j] -= factor * inverse[k, j]
    return True


@njit(cache=True, nogil=True)
def product(a: Floats, b: Floats) -> Floats:
    """Of two small matrices: a call of BLAS takes longer than their products."""
    found = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                found[i, j] += a[i, k] * b[k, j]
    return found


@njit(cache=True, nogil=True)
def _of_each(matrices: Floats, vectors: Floats) -> Floats:
    """Each matrix (n_residual, n, m) by its vector (n_residual, m), (n_residual, n)."""
    found = np.zeros(matrices.shape[:2])
    for r in range(matrices.shape[0]):
        for i in range(matrices.shape[1]):
            for j in range(matrices.shape[2]):
                found[r, i] += matrices[r, i, j] * vectors[r, j]
    return found


@njit(cache=True, nogil=True)
def _rest_of(
    h: Floats, shapes: tuple[Floats, Floats, Floats, Floats, Floats], both: Floats, root: Floats, score: Floats
) -> float:
    """(Σ_j max_x ‖S^-½ (g(x) - Λᵀ b(x))‖²)^½, for φ(x) over all modes times `both`, (-Λ, then the weights).

    Args:
        h: (n_actuators,).
        shapes: value, slope and bend at the centres, most bend and most rate, each (n_actuators, n_modes).
        both: (n_modes, n).
        root: (n, n) S^-½.
        score: (n_actuators,) set to what each interval adds by its width.
    """
    value, slope, bend, most_bend, most_rate = shapes
    weighted = both @ root.T
    size = np.abs(both) @ np.abs(root.T)
    centre, steep, bent = value @ weighted, slope @ weighted, bend @ weighted
    rate, most = most_rate @ size, most_bend @ size
    total = 0.0
    for j in range(h.size):
        at, low, high, beyond = 0.0, 0.0, 0.0, 0.0
        for c in range(root.shape[0]):
            at += centre[j, c] ** 2
            low += (centre[j, c] - h[j] * steep[j, c]) ** 2
            high += (centre[j, c] + h[j] * steep[j, c]) ** 2
            beyond += min(abs(bent[j, c]) + h[j] * rate[j, c], most[j, c]) ** 2
        # the linear part is largest at an end: a norm is convex
        largest = (np.sqrt(max(low, high)) + 0.5 * h[j] ** 2 * np.sqrt(beyond)) ** 2
        score[j] = largest - at
        total += largest
    return float(np.sqrt(total))


@njit(cache=True, nogil=True)
def dual_bound(
    h: Floats,
    shapes: tuple[Floats, Floats, Floats, Floats, Floats],
    transforms: Floats,
    square: Floats,
    root: Floats,
    limit: float,
    singular: float,
    score: Floats,
) -> float:
    """Lower bound of √W_R in a cell under one limit; inf where none in it keeps the limit, -inf if none is found.

    Args:
        h: (n,) half-widths of the intervals.
        shapes: value, slope and bend at their centres, most bend and most rate in them, each (n, n_modes).
        transforms: T (n_residual, n, n_columns).
        square, root, limit: S (n, n), S^-½ and L.
        singular: pivot of D over its largest entry.
        score: (n,) set to how much each interval weakens the bound.
    """
    n = h.size
    n_modes = shapes[0].shape[1]
    ends = np.empty((2 * n, n_modes))
    for j in range(n):
        for k in range(n_modes):
            ends[j, k] = shapes[0][j, k]
            ends[n + j, k] = h[j] * shapes[1][j, k]
    c, residual = np.ascontiguousarray(ends[:, :n]), np.ascontiguousarray(ends[:, n:])
    gram, d = c.T @ c, np.empty((n, n))
    pivot = singular * np.abs(gram).max()
    exact = inverse_of(gram.copy(), d, pivot)
    # any D refuses a cell: where D⁻¹ is singular to round-off, as beside a support, a ridge makes one
    if not exact and not inverse_of(gram + 2.0 * pivot * np.eye(n), d, pivot):
        return -np.inf
    least = d @ square
    both = np.zeros((n_modes, n))
    t = np.trace(least)
    if t >= limit**2:
        both[:n] = -least
        if t > limit * _rest_of(h, shapes, both, root, score):
            return np.inf
    if not exact:
        return -np.inf
    left = np.sqrt(max(limit**2 - t, BARELY * limit**2))
    forces, other = c @ d, root.T @ root
    of_forces = transforms.transpose(0, 2, 1)
    y = _of_each(of_forces, residual.T @ forces)
    size, outside = 0.0, 0.0
    multiplier, weights = np.zeros((n, n)), np.zeros((n_modes - n, n))
    for step in range(STEPS + 1):
        size = np.sqrt((y**2).sum())
        if size == 0.0:
            return -np.inf
        weights = _of_each(transforms, y / size)
        g = residual @ weights
        multiplier = d @ (c.T @ g)
        rest = g - c @ multiplier
        weighted = rest @ other
        outside = np.sqrt((rest * weighted).sum())
        if step == STEPS or outside <= ROUND_OFF * np.sqrt(((g @ other) * g).sum()):
            break
        change = _of_each(of_forces, residual.T @ (forces - left / outside * weighted)) - y
        a = (change**2).sum()
        if a == 0.0:
            break
        y = y + min(max(-(y * change).sum() / a, 0.0), 1.0) * change
    multiplier = multiplier + outside / left * least
    both[:n] = -multiplier
    both[n:] = weights
    return float((np.trace(multiplier) - limit * _rest_of(h, shapes, both, root, score)) / np.sqrt(2.0))
