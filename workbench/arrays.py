"""The types of arrays in annotations, np.ndarray where numbers may be real or complex; root and inverse of a matrix."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]


def symmetric_root(matrix: np.ndarray) -> Floats:
    """R with R Rᵀ = matrix (..., n, n), a covariance say, which rounding or close modes may have made singular."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def scaled_inverse(matrix: np.ndarray, rcond: float = 1e-15) -> Floats:
    """Pseudo-inverse of normal equations, a symmetric matrix, each unknown in units of its own diagonal entry's root.

    Eigenvalues of the scaled matrix below `rcond` times the largest, negative ones among them, count as zero.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    kept = values > rcond * np.abs(values).max(initial=0.0)
    found = scale[:, None] * vectors[:, kept]
    return np.asarray(found / values[kept] @ found.T)
