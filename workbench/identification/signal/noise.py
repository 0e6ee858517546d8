"""Noise of each output in each record: its variance, whether it is white, its whitening, and its power about a mode.

Whitening: the residual of an output is modelled as y_k = Σ_i a_i y_k-i + e_k (Yule & Walker), and the record filtered
by 1 - Σ_i a_i z^-i. A free decay stays a free decay of the same poles.

Variance: residuals of one day have one noise, and short records know it better together. Bartlett's statistic tests
that (Proc. R. Soc. A 160, 1937): with ν_i degrees of freedom behind the variance v_i of record i, and v of all,

    B = (ν ln v - Σ ν_i ln v_i) / (1 + (Σ 1/ν_i - 1/ν) / (3 (n_records - 1))),     chi-square of n_records - 1.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter
from scipy.stats import chi2

from workbench.identification.signal.projection import project
from workbench.records.record import Record

# Chance that records of one noise are each given their own, which costs little.
SPLIT = 0.05
# Chance that white noise is taken for coloured, and the least number of bins over which a spectrum is averaged.
FALSE_ALARM, LEAST_BINS = 1e-3, 6
# Order of the autoregressive model, and samples for each of its coefficients.
ORDER, SAMPLES_EACH = 12, 40
# Residual of records without noise, relative.
ROUNDING = 1e-9


def whitened(records: Sequence[Record], poles: np.ndarray, *, offset: bool = True) -> list[Record] | None:
    """The records behind filters, one an output, that whiten the residual of `poles`; None where it may be white.

    Args:
        records: free decays, of the same outputs.
        poles: (n_modes,) of their modes, rad/s.
        offset: whether each output may also hold a constant.
    """
    left = [project(record, poles, offset).residual.T for record in records]
    powers = [np.abs(np.fft.rfft(each, axis=1)[:, 1:].T) ** 2 for each in left]
    order = min(ORDER, sum(each.shape[1] for each in left) // SAMPLES_EACH)
    squares = sum((each**2).sum(axis=1) for each in left)
    whole = sum((record.outputs**2).sum(axis=1) for record in records)
    rounding = (squares < ROUNDING**2 * whole).any()
    if order == 0 or rounding or all(white(power, poles.size).all() for power in powers):
        return None
    filters = []
    for rows in zip(*left, strict=True):
        # Records of one spectrum may differ in variance.
        row = [each * np.sqrt(each.size) / max(float(np.linalg.norm(each)), 1e-300) for each in rows]
        lags = [sum(float(each[k:] @ each[: each.size - k]) for each in row) for k in range(order + 1)]
        filters.append(np.r_[1.0, -solve_toeplitz(lags[:-1], lags[1:])] if lags[0] > 0 else np.r_[1.0, np.zeros(order)])
    return [
        replace(
            record,
            outputs=np.array([lfilter(b, [1.0], row)[order:] for b, row in zip(filters, record.outputs, strict=True)]),
            inputs=record.inputs[:, order:],
            start_time=record.start_time + order * record.sample_time,
        )
        for record in records
    ]


def noise_near(poles: np.ndarray, residual: np.ndarray, sample_time: float) -> np.ndarray:
    """κ, the noise about each mode over its mean, (n_outputs, n_modes); 1 for an output whose noise may be white.

    Args:
        poles: (n_modes,) of the modes taken out, rad/s.
        residual: (n_samples, n_outputs) over its standard deviation.
        sample_time: s.
    """
    n, m = residual.shape
    power = np.abs(np.fft.rfft(residual, axis=0)[1:]) ** 2 / n
    omega = 2.0 * np.pi / (n * sample_time) * np.arange(1, len(power) + 1)
    factors = np.ones((m, poles.size))
    coloured = ~white(power, poles.size)
    for r, pole in enumerate(poles):
        width = max(abs(pole.real), LEAST_BINS * omega[0])
        weight = _bandwidth_weight((omega - pole.imag) / width)
        # Each mode took the noise of one bin.
        left = max(weight.sum() - _bandwidth_weight((poles.imag - pole.imag) / width).sum(), 1.0)
        factors[coloured, r] = weight @ power[:, coloured] / left
    return factors


def noise_along(signals: np.ndarray, residual: np.ndarray, n_modes: int) -> np.ndarray:
    """κ, noise over its mean along each signal, (n_signals, n_outputs); 1 where it may be white.

    Args:
        signals: (n_samples, n_signals).
        residual: (n_samples, n_outputs) of a fit, over its standard deviation.
        n_modes: taken out of it.
    """
    power, weight = (
        np.abs(np.fft.rfft(each, axis=0)[1:]) ** 2 for each in (residual / np.sqrt(len(residual)), signals)
    )
    whole = weight.sum(axis=0)
    along = (weight / np.where(whole > 0, whole, 1.0)).T @ power
    # A constant is disturbed by noise about zero frequency.
    along[whole <= 1e-20 * len(signals)] = power[: 2 * LEAST_BINS].mean(axis=0)
    return np.where(white(power, n_modes), 1.0, along)


def _bandwidth_weight(away: np.ndarray) -> np.ndarray:
    """Power of t e^{λt}, over that at its own frequency."""
    return (1.0 + away**2) ** -2.0


def white(power: np.ndarray, n_modes: int) -> np.ndarray:
    """Outputs (n_outputs,) whose spectrum may be flat: its sum runs along a straight line (Bartlett; Kolmogorov)."""
    bins, m = power.shape
    whole = power.sum(axis=0)
    summed = np.cumsum(power, axis=0) / np.where(whole > 0, whole, 1.0)
    apart = np.abs(summed - np.arange(1, bins + 1)[:, None] / bins).max(axis=0)
    # The bins that the modes took are not coloured noise.
    return np.asarray(apart < np.sqrt(0.5 * np.log(2.0 * m / FALSE_ALARM) / bins) + (n_modes + 1) / bins)


def variances(squares: np.ndarray, free: np.ndarray, apart: np.ndarray | None = None) -> np.ndarray:
    """Variance of the noise, (n_records, n_outputs).

    Args:
        squares: (n_records, n_outputs) sums of squares of the residual, positive.
        free: (n_records,) or (n_records, n_outputs) degrees of freedom, at least 1.
        apart: (n_outputs,) whose records differ; by `differ` unless given.
    """
    free = _each(free, squares)
    apart = differ(squares, free) if apart is None else apart
    return np.asarray(np.where(apart, squares / free, squares.sum(axis=0) / free.sum(axis=0)))


def differ(squares: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Outputs (n_outputs,) whose noise is not the same in all records."""
    n, free = len(squares), _each(free, squares)
    if n == 1:
        return np.zeros(squares.shape[1], bool)
    whole = free.sum(axis=0)
    apart = whole * np.log(squares.sum(axis=0) / whole) - (free * np.log(squares / free)).sum(axis=0)
    return np.asarray(
        apart / (1.0 + ((1.0 / free).sum(axis=0) - 1.0 / whole) / (3.0 * (n - 1))) > chi2.isf(SPLIT, n - 1)
    )


def _each(free: np.ndarray, squares: np.ndarray) -> np.ndarray:
    return np.broadcast_to(free[:, None] if free.ndim == 1 else free, squares.shape)
