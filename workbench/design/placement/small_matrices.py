"""Compiled inverses and products of small matrices, for which a call of BLAS takes longer than the operation.

Plain loops, because array expressions take the compiler ten times as long.
"""

from numba import njit

from workbench.arrays import Floats


@njit(cache=True, nogil=True)
def inverse_of(matrix: Floats, inverse: Floats, least: float) -> bool:
    """Write the inverse by Gauss-Jordan elimination; False where a pivot is not above `least`. Destroys the matrix."""
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
def multiply(a: Floats, b: Floats, product: Floats) -> None:
    """Write A B into `product`."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            product[i, j] = total


@njit(cache=True, nogil=True)
def multiply_transposed(a: Floats, b: Floats, product: Floats) -> None:
    """Write Aᵀ B into `product`; numba would compile `multiply` and its callers again for a transposed view."""
    for i in range(a.shape[1]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[0]):
                total += a[k, i] * b[k, j]
            product[i, j] = total


@njit(cache=True, nogil=True)
def inner(a: Floats, b: Floats) -> float:
    """Inner product Σ A_ij B_ij."""
    total = 0.0
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            total += a[i, j] * b[i, j]
    return total
