"""Band-limited interpolation of signals without content above the Nyquist frequency, as after an anti-alias filter.

Such a signal is determined by its samples (Shannon): over one period it is the trigonometric polynomial through them. A
record is not periodic; it is continued from its end to its start by reflections of both ends, blended together.
"""

import numpy as np
from scipy.fft import fft, ifft, next_fast_len
from scipy.signal import czt

from workbench.arrays import Complexes, Floats

BEYOND = 256  # samples, at most, of the continuation from the end to the start


def spectrum_of(signals: Floats) -> Complexes:
    """DFT (n_signals, size) of each of the signals (n_signals, n_samples) with its continuation, size odd."""
    n = signals.shape[1]
    if n == 1:
        return np.asarray(signals, complex)
    size = next_fast_len(n + min(BEYOND, n - 1))
    while size % 2 == 0:  # odd, to have no line at the Nyquist frequency, whose phase is not determined
        size = next_fast_len(size + 1)
    far = np.arange(1, size - n + 1)
    share = np.cos(0.5 * np.pi * far / (size - n + 1)) ** 2
    after = 2.0 * signals[:, -1:] - signals[:, np.maximum(n - 1 - far, 0)]
    before = 2.0 * signals[:, :1] - signals[:, np.minimum(far[::-1], n - 1)]
    return np.asarray(fft(np.hstack([signals, share * after + (1.0 - share) * before]), axis=1))


def angles(size: int) -> Floats:
    """Angular frequencies (size,) of the lines of a DFT, rad per sample."""
    return np.asarray(2.0 * np.pi * np.fft.fftfreq(size), float)


def later(signals: Floats, delays: Floats) -> Floats:
    """The signals (n_signals, n_samples), each delayed by a number of samples (n_signals,), fractions included."""
    spectrum = spectrum_of(signals)
    shifted = spectrum * np.exp(-1j * np.outer(delays, angles(spectrum.shape[1])))
    return np.asarray(ifft(shifted, axis=1).real[:, : signals.shape[1]])


def finer(signals: Floats, times: int) -> Floats:
    """The signals (n_signals, n_samples) interpolated to `times` as many samples."""
    spectrum = spectrum_of(signals)
    size = spectrum.shape[1]
    fine, half = np.zeros((len(signals), size * times), complex), (size + 1) // 2
    fine[:, :half] = spectrum[:, :half]
    fine[:, fine.shape[1] - (size - half) :] = spectrum[:, half:]
    return np.asarray(times * ifft(fine, axis=1).real[:, : signals.shape[1] * times])


def spaced(signals: Floats, spacing: float, n: int) -> Floats:
    """The signals (n_signals, n_samples) at n instants `spacing` samples apart, the first at the first sample."""
    spectrum = spectrum_of(signals)
    size = spectrum.shape[1]
    one_sided = spectrum[:, : (size + 1) // 2]
    one_sided[:, 1:] *= 2.0
    return np.asarray(czt(one_sided, n, np.exp(2j * np.pi * spacing / size), axis=1).real / size)


def derivative_of(signals: Floats) -> Floats:
    """The derivative of the signals (n_signals, n_samples) at their samples, per sample."""
    spectrum = spectrum_of(signals)
    return np.asarray(ifft(1j * angles(spectrum.shape[1]) * spectrum, axis=1).real[:, : signals.shape[1]])


def response_of_pole(spectrum: Complexes, pole: complex, n: int) -> tuple[Complexes, Complexes]:
    """z of z' = λ z + u at n samples with z = 0 at the first, and its derivative by λ, (n_signals, n) each.

    The periodic solution is U/(iω - λ) at each line; a free decay makes z zero at the first sample. `pole` is λ times
    the sample time, z in units of the sample time, and its derivative in units of the square.
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
