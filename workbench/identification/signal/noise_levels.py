"""The noise of each output in each record: its own where records differ, one for all where they may not.

What records of one day leave is one noise, and short ones know it better together. Bartlett's statistic tells them
apart (Proc. R. Soc. A 160, 1937): with ν_i degrees of freedom behind the variance v_i of record i, and v of all,

    B = (ν ln v - Σ ν_i ln v_i) / (1 + (Σ 1/ν_i - 1/ν) / (3 (n_records - 1))),     chi-square of n_records - 1.
"""

import numpy as np
from scipy.stats import chi2

# Chance that records of one noise are each given their own, which then costs no more than what they know it worse by.
SPLIT = 0.05


def variances(squares: np.ndarray, free: np.ndarray, apart: np.ndarray | None = None) -> np.ndarray:
    """Variance of the noise, (n_records, n_outputs).

    Args:
        squares: (n_records, n_outputs) sums of those of what is left, positive.
        free: (n_records,) or (n_records, n_outputs) degrees of freedom, at least 1.
        apart: (n_outputs,) whose records differ; found by `differ` unless given.
    """
    free = _each(free, squares)
    apart = differ(squares, free) if apart is None else apart
    return np.where(apart, squares / free, squares.sum(axis=0) / free.sum(axis=0))


def differ(squares: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Outputs (n_outputs,) whose noise is not the same in all records."""
    n, free = len(squares), _each(free, squares)
    if n == 1:
        return np.zeros(squares.shape[1], bool)
    whole = free.sum(axis=0)
    apart = whole * np.log(squares.sum(axis=0) / whole) - (free * np.log(squares / free)).sum(axis=0)
    return apart / (1.0 + ((1.0 / free).sum(axis=0) - 1.0 / whole) / (3.0 * (n - 1))) > chi2.isf(SPLIT, n - 1)


def _each(free: np.ndarray, squares: np.ndarray) -> np.ndarray:
    return np.broadcast_to(free[:, None] if free.ndim == 1 else free, squares.shape)
