"""Whether the excitation of a record repeats, and after how many samples."""

import numpy as np

ALIKE = 0.9  # correlation of the inputs with themselves a period later; that of other lags is far less
APART = 0.5  # correlation that comes in between: below it the inputs are no slow drift
LEAST = 8  # samples of a period


def period_of(inputs: np.ndarray) -> int | None:
    """Samples after which inputs repeat: the lag L of the first peak above 0.9 of their correlation with themselves.

        ρ(L) = Σ_k u(k)·u(k + L) / √(Σ_k |u(k)|² Σ_k |u(k + L)|²)      over k = 0 ... n - L - 1

    Args:
        inputs: (n_inputs, n_samples); at least two periods long.

    Returns:
        The period, or None where the inputs do not repeat.
    """
    u = np.asarray(inputs, float)
    n = u.shape[1]
    most = n // 2
    if most < 2 * LEAST or not np.any(u):
        return None
    spectrum = np.fft.rfft(u, 2 * n, axis=1)
    product = np.fft.irfft((np.abs(spectrum) ** 2).sum(axis=0))[: most + 1]
    sums = np.r_[0.0, np.cumsum((u**2).sum(axis=0))]
    lags = np.arange(most + 1)
    scale = np.sqrt(sums[n - lags] * (sums[n] - sums[lags]))
    alike = product / np.where(scale > 0, scale, np.inf)
    apart = np.flatnonzero(alike[:most] < APART)
    if apart.size == 0:
        return None
    start = max(int(apart[0]), LEAST)
    beside = np.r_[alike, -np.inf]
    peaks = start + np.flatnonzero(
        (beside[start:-1] > ALIKE)
        & (beside[start:-1] >= beside[start - 1 : -2])
        & (beside[start:-1] >= beside[start + 1 :])
    )
    return int(peaks[0]) if peaks.size else None
