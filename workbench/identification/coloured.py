"""Noise that is not white: filtered until it is, to count modes, and listened to near each mode, to say their errors.

What is left of an output is taken for e_k of y_k = Σ_i a_i y_k-i + e_k (Yule & Walker), and the record filtered by what
makes it e_k. Free decay stays free decay of the same poles.

A mode listens to noise within its own band only. Where output j has noise of spectrum S_j, a least squares fit made for
white noise s_j² has the covariance H^-1 (Σ_j J_j^T S_j J_j) H^-1 (White, Econometrica 48, 1980), and each column of J
lives where its mode does, so that

    κ_jr = S_j(ω_r) / s_j²,   κ_r = Σ_j κ_jr |a_jr|² / s_j² / Σ_j |a_jr|² / s_j²

are the factors of its variances. Where nothing speaks against white noise they are one: the Cramér-Rao bound.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from workbench.identification.projection import Projection, project
from workbench.identification.refinement import Refined
from workbench.identification.synthesis import time_derivatives
from workbench.records.record import Record
from workbench.structure.modes import frozen

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
    factors = [
        noise_near(refined.modes.poles, fit.residual / refined.noise_std, record.sample_time)
        for record, fit in zip(records, fits, strict=True)
    ]
    if all((each == 1.0).all() for each in factors):
        return refined
    told = np.array([(np.abs(a) / refined.noise_std[:, None]) ** 2 for a in refined.amplitudes])
    near_pole = (told * factors).sum(axis=(0, 1)) / told.sum(axis=(0, 1))
    wider = np.sqrt(np.r_[near_pole, near_pole])
    loudest = int(np.argmax([(fit.coefficients**2).sum() for fit in fits]))
    return replace(
        refined,
        covariance=frozen(refined.covariance * np.outer(wider, wider)),
        shape_covariance=frozen(_shapes(refined, fits[loudest], records[loudest], near_pole, factors[loudest])),
    )


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
    if order == 0 or rounding or all(_white(power, poles.size).all() for power in powers):
        return None
    filters = []
    for row in zip(*left, strict=True):
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
    coloured = ~_white(power, poles.size)
    for r, pole in enumerate(poles):
        width = max(abs(pole.real), LEAST_BINS * omega[0])
        heard = _listens((omega - pole.imag) / width)
        # Each mode has taken the noise of one bin out with it.
        left = max(heard.sum() - _listens((poles.imag - pole.imag) / width).sum(), 1.0)
        factors[coloured, r] = heard @ power[:, coloured] / left
    return factors


def _listens(away: np.ndarray) -> np.ndarray:
    """Power of t e^{λt}, over that at its own frequency."""
    return (1.0 + away**2) ** -2.0


def _white(power: np.ndarray, n_modes: int) -> np.ndarray:
    """Outputs (n_outputs,) whose spectrum may be flat: its sum runs along a straight line (Bartlett; Kolmogorov)."""
    bins, m = power.shape
    whole = power.sum(axis=0)
    summed = np.cumsum(power, axis=0) / np.where(whole > 0, whole, 1.0)
    apart = np.abs(summed - np.arange(1, bins + 1)[:, None] / bins).max(axis=0)
    # What the modes took out of their bins makes no colour.
    return apart < np.sqrt(0.5 * np.log(2.0 * m / FALSE_ALARM) / bins) + (n_modes + 1) / bins


def _shapes(refined: Refined, fit: Projection, record: Record, near_pole: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Covariance of the shapes: what they have of the poles' errors by κ_r, of each output's noise by κ_jr."""
    n, derivative = refined.modes.n_modes, time_derivatives(record.output_channels)
    found = np.zeros_like(refined.shape_covariance)
    for r, pole in enumerate(refined.modes.poles):
        seen = fit.complex_amplitudes[:, r] / pole**derivative
        k = int(np.argmax(np.abs(seen)))
        # What an output's own amplitude, and that of the reference, do to the real part of a shape.
        alone = 1.0 / (pole**derivative * seen[k])
        shared = alone[k] * seen / seen[k]
        spread = fit.spread[np.ix_([r, n + r], [r, n + r])]
        white, own = (_own(alone, shared, k, spread, refined.noise_std**2 * by) for by in (1.0, near[:, r]))
        found[r] = near_pole[r] * (refined.shape_covariance[r] - white) + own
    return found


def _own(alone: np.ndarray, shared: np.ndarray, k: int, spread: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Covariance of Re(alone_j a_j - shared_j a_k), (n_outputs, n_outputs), poles held."""
    a, s = (np.column_stack([c.real, c.imag]) for c in (alone, shared))
    whole = np.diag(variance * np.einsum("ja,ab,jb->j", a, spread, a)) + variance[k] * s @ spread @ s.T
    whole[k], whole[:, k] = 0.0, 0.0
    return whole
