"""The noise spectrum of each output, estimated from the residual of a fit, to weight each line by its noise.

In the cosine transform of a record of n samples, noise of spectrum S is independent from line to line, line k of
variance S(πk / nΔt), even where S falls steeply, since the transform has no jump between a record's ends (Ahmed,
Natarajan & Rao, IEEE Trans. Comput. C-23, 1974). S is that of an autoregressive model y_k = Σ_i a_i y_k-i + e_k, by
Burg's recursion, of the order p that minimises n ln var(e) + p ln n. Before, each line is corrected for its leverage,
the share of its noise that the fit absorbs.
"""

from collections.abc import Sequence

import numpy as np
from scipy.fft import dct, idct

from workbench.identification.signal.projection import PROJECTION, differ, variances, white


def lines_of(samples: np.ndarray) -> np.ndarray:
    """Orthonormal cosine transform of each column, (n_samples, n_columns)."""
    return np.asarray(dct(samples, axis=0, norm="ortho"))


def samples_of(lines: np.ndarray) -> np.ndarray:
    """Samples of each column of lines, the inverse of `lines_of`."""
    return np.asarray(idct(lines, axis=0, norm="ortho"))


def noise_spectrum(
    residuals: Sequence[np.ndarray],
    outputs: Sequence[np.ndarray],
    leverage: Sequence[np.ndarray],
    n_modes: int,
    free: np.ndarray,
) -> list[np.ndarray] | None:
    """Standard deviation of the noise at each line of each record, (n_samples, n_outputs) each, over their rms; None
    where the noise may be white and of equal level in all records, or is rounding error.

    Args:
        residuals: of each record, (n_samples, n_outputs).
        outputs: of each record, the measured outputs.
        leverage: of each line of each record, (n_samples, n_outputs), for which the residual is corrected.
        n_modes: of the fit.
        free: (n_records,) degrees of freedom of the residual.
    """
    squares = np.array([(each**2).sum(axis=0) for each in residuals])
    measured = np.array([(each**2).sum(axis=0) for each in outputs])
    if (squares.sum(axis=0) <= PROJECTION.noise_free_ratio**2 * measured.sum(axis=0)).any():
        return None
    levels = np.sqrt(variances(squares, free))
    power = [np.abs(np.fft.rfft(each, axis=0)[1:]) ** 2 for each in residuals]
    flat = np.all([white(each, n_modes) for each in power], axis=0)
    if flat.all() and not differ(squares, free).any():
        return None
    corrected = [
        samples_of(lines_of(each) / np.sqrt(1.0 - np.clip(share, 0.0, PROJECTION.max_leverage)))
        for each, share in zip(residuals, leverage, strict=True)
    ]
    std = [np.tile(row, (len(each), 1)) for row, each in zip(levels, residuals, strict=True)]
    for j in np.flatnonzero(~flat):
        filter_, _ = autoregression([each[:, j] / row[j] for each, row in zip(corrected, levels, strict=True)])
        for each in std:
            phasors = np.exp(-1j * np.pi / len(each) * np.arange(len(each)))
            each[:, j] /= np.abs(np.polyval(filter_[::-1], phasors))
    rms = np.sqrt(np.vstack([each**2 for each in std]).mean(axis=0))
    return [each / rms for each in std]


def alike(one: Sequence[np.ndarray] | None, other: Sequence[np.ndarray] | None) -> bool:
    """Whether two noise spectra are the same."""
    if one is None or other is None:
        return one is other
    log_ratios = np.log(np.vstack(one) / np.vstack(other))
    return bool(np.sqrt((log_ratios**2).mean(axis=0)).max() < PROJECTION.spectrum_tolerance)


def autoregression(rows: Sequence[np.ndarray], most: int = PROJECTION.max_ar_order) -> tuple[np.ndarray, float]:
    """The prediction error filter [1, -a_1, ...] of records (n_samples,) of one noise (Burg 1967), and the BIC of its
    order, least up to the order `most`."""
    n = sum(row.size for row in rows)
    forward, backward = list(rows), list(rows)
    best = coefficients = np.ones(1)
    variance = sum(float(row @ row) for row in rows) / n
    least_criterion = n * np.log(variance)
    for order in range(1, min(most, n // PROJECTION.samples_per_parameter) + 1):
        forward, backward = [f[1:] for f in forward], [b[:-1] for b in backward]
        cross = sum(float(f @ b) for f, b in zip(forward, backward, strict=True))
        k = -2.0 * cross / sum(float(f @ f + b @ b) for f, b in zip(forward, backward, strict=True))
        both = list(zip(forward, backward, strict=True))
        forward, backward = [f + k * b for f, b in both], [b + k * f for f, b in both]
        coefficients = np.r_[coefficients, 0.0] + k * np.r_[0.0, coefficients[::-1]]
        variance *= 1.0 - k**2
        if n * np.log(variance) + order * np.log(n) < least_criterion:
            best, least_criterion = coefficients, n * np.log(variance) + order * np.log(n)
    return best, float(least_criterion)
