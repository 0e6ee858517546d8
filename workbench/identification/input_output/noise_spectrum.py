"""The noise spectrum of each output, estimated from the residual of a fit, to weight every line by its own noise.

In the cosine transform of a record of n samples, noise of spectrum S is independent from line to line, line k of
variance S(πk / nΔt), even where S falls steeply, for the transform sees no jump between a record's ends (Ahmed,
Natarajan & Rao, IEEE Trans. Comput. C-23, 1974). S is that of y_k = Σ_i a_i y_k-i + e_k, by Burg's recursion, as many
terms as lower n ln var(e) + p ln n; before, each line gets back its leverage, the share of its noise that the fit took.
"""

from collections.abc import Sequence

import numpy as np
from scipy.fft import dct, idct

from workbench.identification.signal.projection import PROJECTION, differ, variances, white


def lines_of(samples: np.ndarray) -> np.ndarray:
    """Orthonormal cosine transform of each column, (n_samples, n_columns)."""
    return np.asarray(dct(samples, axis=0, norm="ortho"))


def samples_of(lines: np.ndarray) -> np.ndarray:
    """Columns whose lines these are."""
    return np.asarray(idct(lines, axis=0, norm="ortho"))


def noise_spectrum(
    left: Sequence[np.ndarray], whole: Sequence[np.ndarray], taken: Sequence[np.ndarray], n_modes: int, free: np.ndarray
) -> list[np.ndarray] | None:
    """Standard deviation of the noise at each line of each record, (n_samples, n_outputs) each, over their rms.

    Args:
        left: of each record, (n_samples, n_outputs): the residual.
        whole: of each record, what was measured.
        taken: of each record, (n_samples, n_outputs): share of the noise of each line that the fit took,
            which is made good: about its modes the spectrum of the residual is too low.
        n_modes: of the fit.
        free: (n_records,) degrees of freedom of the residual.

    Returns:
        None where the noise may be white, and of equal level in all records, or is round-off.
    """
    squares = np.array([(each**2).sum(axis=0) for each in left])
    measured = np.array([(each**2).sum(axis=0) for each in whole])
    if (squares.sum(axis=0) <= PROJECTION.rounding**2 * measured.sum(axis=0)).any():
        return None
    levels = np.sqrt(variances(squares, free))
    power = [np.abs(np.fft.rfft(each, axis=0)[1:]) ** 2 for each in left]
    flat = np.all([white(each, n_modes) for each in power], axis=0)
    if flat.all() and not differ(squares, free).any():
        return None
    good = [
        samples_of(lines_of(each) / np.sqrt(1.0 - np.clip(share, 0.0, PROJECTION.most_taken)))
        for each, share in zip(left, taken, strict=True)
    ]
    found = [np.tile(row, (len(each), 1)) for row, each in zip(levels, left, strict=True)]
    for j in np.flatnonzero(~flat):
        filtered = _burg([each[:, j] / row[j] for each, row in zip(good, levels, strict=True)])
        for each in found:
            turns = np.exp(-1j * np.pi / len(each) * np.arange(len(each)))
            each[:, j] /= np.abs(np.polyval(filtered[::-1], turns))
    rms = np.sqrt(np.vstack([each**2 for each in found]).mean(axis=0))
    return [each / rms for each in found]


def alike(one: Sequence[np.ndarray] | None, other: Sequence[np.ndarray] | None) -> bool:
    """Whether two noise spectra are the same."""
    if one is None or other is None:
        return one is other
    return bool(np.sqrt((np.log(np.vstack(one) / np.vstack(other)) ** 2).mean(axis=0)).max() < PROJECTION.spectra_alike)


def _burg(rows: Sequence[np.ndarray]) -> np.ndarray:
    """The filter [1, -a_1, ...] that makes records of one noise white (Burg 1967), order by Schwarz's criterion."""
    n = sum(row.size for row in rows)
    ahead, back = list(rows), list(rows)
    best = found = np.ones(1)
    loss = sum(float(row @ row) for row in rows) / n
    least = n * np.log(loss)
    for order in range(1, min(PROJECTION.order, n // PROJECTION.samples_each) + 1):
        ahead, back = [f[1:] for f in ahead], [b[:-1] for b in back]
        crossed = sum(float(f @ b) for f, b in zip(ahead, back, strict=True))
        k = -2.0 * crossed / sum(float(f @ f + b @ b) for f, b in zip(ahead, back, strict=True))
        both = list(zip(ahead, back, strict=True))
        ahead, back = [f + k * b for f, b in both], [b + k * f for f, b in both]
        found = np.r_[found, 0.0] + k * np.r_[0.0, found[::-1]]
        loss *= 1.0 - k**2
        if n * np.log(loss) + order * np.log(n) < least:
            best, least = found, n * np.log(loss) + order * np.log(n)
    return best
