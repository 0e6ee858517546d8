"""The types of arrays in annotations; np.ndarray where numbers may be real or complex."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]
