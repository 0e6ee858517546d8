"""Signals that hold nothing beyond half of their sample rate, as behind an anti-alias filter, between their samples.

Samples determine such a signal (Shannon); it is the trigonometric polynomial through them over one period. A record is
none: beyond its ends the signal is carried on by its reflection, each end into the other.
"""

import numpy as np
from scipy.fft import fft, ifft, next_fast_len

from workbench.arrays import Complexes, Floats

BEYOND = 256  # samples, at most, on which a record is carried on from its end to its start


def spectrum_of(signals: Floats) -> Complexes:
    """Transform of each signal and what joins its end to its start, (n_signals, size), size odd.

    Args:
        signals: (n_signals, n_samples).
    """
    n = signals.shape[1]
    if n == 1:
        return np.asarray(signals, complex)
    size = next_fast_len(n + min(BEYOND, n - 1))
    while size % 2 == 0:  # no line at half of the sample rate, whose phase the samples do not tell
        size = next_fast_len(size + 1)
    far = np.arange(1, size - n + 1)
    share = np.cos(0.5 * np.pi * far / (size - n + 1)) ** 2
    after = 2.0 * signals[:, -1:] - signals[:, np.maximum(n - 1 - far, 0)]
    before = 2.0 * signals[:, :1] - signals[:, np.minimum(far[::-1], n - 1)]
    return np.asarray(fft(np.hstack([signals, share * after + (1.0 - share) * before]), axis=1))


def angles(size: int) -> Floats:
    """Of the lines of a transform, rad a sample, (size,)."""
    return np.asarray(2.0 * np.pi * np.fft.fftfreq(size), float)


def later(signals: Floats, delays: Floats) -> Floats:
    """Each signal (n_signals, n_samples) delayed by so many samples (n_signals,), any fraction."""
    spectrum = spectrum_of(signals)
    turned = spectrum * np.exp(-1j * np.outer(delays, angles(spectrum.shape[1])))
    return np.asarray(ifft(turned, axis=1).real[:, : signals.shape[1]])


def finer(signals: Floats, times: int) -> Floats:
    """So many times as many samples of each signal (n_signals, n_samples)."""
    spectrum = spectrum_of(signals)
    size = spectrum.shape[1]
    fine = np.zeros((len(signals), size * times), complex)
    half = (size + 1) // 2
    fine[:, :half] = spectrum[:, :half]
    fine[:, fine.shape[1] - (size - half) :] = spectrum[:, half:]
    return np.asarray(times * ifft(fine, axis=1).real[:, : signals.shape[1] * times])


def response_of_pole(spectrum: Complexes, pole: complex, n: int) -> tuple[Complexes, Complexes]:
    """z of z' = λ z + u at n samples, zero at the first, and its derivative by λ, (n_signals, n) each.

    Line by line, U/(iω - λ) is the motion of the same period; what decays from the first sample takes z to zero there.

    Args:
        spectrum: of `spectrum_of`.
        pole: λ times the sample time.

    Returns:
        In units of the sample time, and of its square.
    """
    denominator = 1j * angles(spectrum.shape[1]) - pole
    close = np.abs(denominator) < 1e-12  # undamped, on a line
    denominator[close] = 1e-12
    lines = spectrum / denominator
    steady, slope = (ifft(each, axis=1)[:, :n] for each in (lines, lines / denominator))
    time = np.arange(n)
    decay = np.exp(pole * time)
    z = steady - steady[:, :1] * decay
    return z, slope - (slope[:, :1] + steady[:, :1] * time) * decay
