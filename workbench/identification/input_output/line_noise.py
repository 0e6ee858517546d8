"""Whether the noise of transfer functions goes with their size, and by how much, read off what a fit leaves of them.

    s² = a² + b² |H|²      of each output: its sensor's own noise, and that of the force or of too few averages

What a fit has not yet found is smooth from line to line, noise is not: where lines stand about evenly, r_k less the
mean of r_k-1 and r_k+1 holds noise alone, 3/2 s² of it. H is the fit's own, for a measured H goes with its noise; where
a mode is not yet found it is the running median of what was measured.
"""

import numpy as np
from scipy.ndimage import median_filter
from scipy.stats import spearmanr

# Chance that even noise is taken for uneven; and b |H| / a at the median line, from nothing to all.
FALSE_ALARM, SHARES = 1e-4, np.geomspace(1e-3, 1e3, 61)
SMOOTHED = 5  # lines


def noise_with_size(left: np.ndarray, fitted: np.ndarray) -> np.ndarray | None:
    """Relative noise of every line, (n_outputs, n_references, n_lines); None where it may be the same at all.

    Args:
        left: what a fit leaves of the transfer functions, complex, of that shape.
        fitted: the fit, of that shape.
    """
    inner = np.arange(1, left.shape[-1] - 1, 3)  # every third: no line counts twice
    rough = np.abs(left[..., inner] - 0.5 * (left[..., inner - 1] + left[..., inner + 1]))
    seen = median_filter(np.abs(fitted + left), (1, 1, SMOOTHED))
    size, found, uneven = np.maximum(np.abs(fitted), seen), np.ones(left.shape), False
    for j, (each, of) in enumerate(zip(rough, size[..., inner], strict=True)):
        typical = float(np.median(of))
        if typical <= 0.0 or np.median(each) <= 0.0:
            continue
        if spearmanr(each.ravel(), of.ravel(), alternative="greater").pvalue > FALSE_ALARM:
            continue
        # Least absolute errors of log s: what a mode not yet found leaves at its few lines counts little.
        logs = [np.log(each) - 0.5 * np.log1p((share * of / typical) ** 2) for share in SHARES]
        errors = [np.abs(log - np.median(log)).sum() for log in logs]
        found[j] = np.sqrt(1.0 + (SHARES[int(np.argmin(errors))] * size[j] / typical) ** 2)
        uneven = True
    return found if uneven else None
