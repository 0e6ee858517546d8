"""Inverses and products of small matrices, compiled: a call of BLAS takes longer than they do.

Plain loops: expressions of whole arrays take the compiler ten times as long.
"""

from numba import njit

from workbench.arrays import Floats


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
def multiply(a: Floats, b: Floats, found: Floats) -> None:
    """A B, into `found`."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            found[i, j] = total


@njit(cache=True, nogil=True)
def multiply_transposed(a: Floats, b: Floats, found: Floats) -> None:
    """Aᵀ B, into `found`; a transposed view would be another type, for which all that takes it is compiled anew."""
    for i in range(a.shape[1]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[0]):
                total += a[k, i] * b[k, j]
            found[i, j] = total


@njit(cache=True, nogil=True)
def inner(a: Floats, b: Floats) -> float:
    """Σ A_ij B_ij."""
    total = 0.0
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            total += a[i, j] * b[i, j]
    return total
