"""The types of arrays in annotations, np.ndarray where numbers may be real or complex; the root of a matrix."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]


def symmetric_root(matrix: np.ndarray) -> Floats:
    """R with R Rᵀ = matrix, a covariance say, which rounding or close modes may have made singular."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
