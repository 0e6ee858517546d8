"""Noise that is not white: filtered until it is, to count modes, and listened to near each mode, to say their errors.

What is left of an output is taken for e_k of y_k = Σ_i a_i y_k-i + e_k (Yule & Walker), and the record filtered by what
makes it e_k. Free decay stays free decay of the same poles.

A mode listens to noise within its own band only. Where output j has noise of spectrum S_j, a least squares fit made for
white noise s_j² has the covariance H^-1 (Σ_j J_j^T S_j J_j) H^-1 (White, Econometrica 48, 1980), and each column of J
lives where its mode does, so that

    J_j^T S_j J_j  ≈  κ_jr^½ κ_js^½ (J_jr^T J_js),     κ_jr = S_j(ω_r) / s_j²,

for modes r and s. Where nothing speaks against white noise κ is one: the Cramér-Rao bound.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from workbench.identification.free_decay.refinement import Refined, as_refined
from workbench.identification.signal.projection import project
from workbench.records.record import Record

# Chance that white noise is taken for coloured, and the least number of bins over which a spectrum is averaged.
FALSE_ALARM, LEAST_BINS = 1e-3, 6
# Samples before that foretell one of noise, and those it takes to learn the weight of each.
ORDER, SAMPLES_EACH = 12, 40
# What is left of records without noise, over their size.
ROUNDING = 1e-9


def in_its_noise(refined: Refined, records: Record | Sequence[Record], *, offset: bool = True) -> Refined:
    """The same modes with standard errors that hold in noise of any smooth spectrum.

    Args:
        refined: of `refine`, made for white noise.
        records: that it was found in.
        offset: as in `refine`.
    """
    records = [records] if isinstance(records, Record) else list(records)
    fits = [project(record, refined.modes.poles, offset) for record in records]
    factors = np.array(
        [
            noise_near(refined.modes.poles, fit.residual / noise, record.sample_time)
            for record, fit, noise in zip(records, fits, refined.noise, strict=True)
        ]
    )
    if (factors == 1.0).all():
        return refined
    found = records, refined.modes.poles, fits, refined.noise
    return as_refined(*found, converged=refined.converged, steps=refined.steps, heard=factors)


def whitened(records: Sequence[Record], poles: np.ndarray, *, offset: bool = True) -> list[Record] | None:
    """The records behind filters, one an output, that make white what `poles` leave; None where it may be white.

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
        # Records of one colour may differ in loudness.
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
        residual: (n_samples, n_outputs) what they leave, over its standard deviation.
        sample_time: s.
    """
    n, m = residual.shape
    power = np.abs(np.fft.rfft(residual, axis=0)[1:]) ** 2 / n
    omega = 2.0 * np.pi / (n * sample_time) * np.arange(1, len(power) + 1)
    factors = np.ones((m, poles.size))
    coloured = ~white(power, poles.size)
    for r, pole in enumerate(poles):
        width = max(abs(pole.real), LEAST_BINS * omega[0])
        heard = _listens((omega - pole.imag) / width)
        # Each mode has taken the noise of one bin out with it.
        left = max(heard.sum() - _listens((poles.imag - pole.imag) / width).sum(), 1.0)
        factors[coloured, r] = heard @ power[:, coloured] / left
    return factors


def heard_along(signals: np.ndarray, residual: np.ndarray, n_modes: int) -> np.ndarray:
    """Noise over its mean that the coefficient of a signal hears, (n_signals, n_outputs); 1 where it may be white.

    Args:
        signals: (n_samples, n_signals).
        residual: (n_samples, n_outputs) what a fit leaves, over its standard deviation.
        n_modes: taken out of it.
    """
    power, heard = (np.abs(np.fft.rfft(each, axis=0)[1:]) ** 2 for each in (residual / np.sqrt(len(residual)), signals))
    whole = heard.sum(axis=0)
    along = (heard / np.where(whole > 0, whole, 1.0)).T @ power
    # A constant hears what lies about zero.
    along[whole <= 1e-20 * len(signals)] = power[: 2 * LEAST_BINS].mean(axis=0)
    return np.where(white(power, n_modes), 1.0, along)


def _listens(away: np.ndarray) -> np.ndarray:
    """Power of t e^{λt}, over that at its own frequency."""
    return (1.0 + away**2) ** -2.0


def white(power: np.ndarray, n_modes: int) -> np.ndarray:
    """Outputs (n_outputs,) whose spectrum may be flat: its sum runs along a straight line (Bartlett; Kolmogorov)."""
    bins, m = power.shape
    whole = power.sum(axis=0)
    summed = np.cumsum(power, axis=0) / np.where(whole > 0, whole, 1.0)
    apart = np.abs(summed - np.arange(1, bins + 1)[:, None] / bins).max(axis=0)
    # What the modes took out of their bins makes no colour.
    return apart < np.sqrt(0.5 * np.log(2.0 * m / FALSE_ALARM) / bins) + (n_modes + 1) / bins
