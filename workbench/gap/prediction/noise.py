"""The noise of each sensor, found from what a fitted model leaves of several records."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from workbench.arrays import Floats
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import predict


@dataclass(frozen=True)
class NoiseSettings:
    """Constants of the estimate of a sensor's noise."""

    lines: int = 20  # of the periodogram in a band, so that its mean scatters by a quarter
    reach: int = 5  # bands to either side
    quiet: float = 0.25  # quantile of them: modes leave a quarter of them free of peaks
    lower: float = 0.67  # deviations by which that quantile lies below the mean
    alike: float = 1.3  # times the power of the quietest record: noise as strong in two records
    same: float = 1.1  # likewise: what differs from it by chance alone
    loud: float = 0.5  # of the mean square: peaks that hold less are not worth leaving out
    # quantile of all bands: what is left of a gap is least between and beyond the modes; and the share of white noise's
    # power that it is, by the chi-square distribution of so many lines
    least: float = 0.05
    of_least: float = 0.66
    louder: float = 2.0  # times the power of the quietest record: another level
    flat: float = 0.6  # likewise, of a spectrum that has none: 0.8 and more of white noise in 1400 samples


NOISE = NoiseSettings()


def noise_found(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Standard deviation of each sensor's noise (n_outputs,), in the sensors' units.

    Noise is as strong in every record, while what a model lacks goes with the level; so the noise is at most the least
    of all records; and errors of a model make peaks about its modes, so the noise is at most what lies under them in
    a spectrum that is smooth otherwise, white or coloured.

    Args:
        residuals: (n_outputs, n_samples) measured less predicted, one per record.
    """
    whole = np.sort([(residual**2).mean(axis=1) for residual in residuals], axis=0)
    under = np.min([_under_peaks(residual) for residual in residuals], axis=0)
    # what is as strong in two records of unequal level is noise, of whatever colour
    alike = whole[1] < NOISE.alike * whole[0] if len(residuals) > 1 else np.zeros(under.size, bool)
    same = whole < NOISE.same * whole[0]
    noise = np.where(same, whole, 0.0).sum(axis=0) / same.sum(axis=0)
    power: Floats = np.where(alike | (under > NOISE.loud * whole[0]), noise, under)
    return np.sqrt(power)


def is_noise_alone(residuals: Sequence[np.ndarray], records: Sequence[Record]) -> bool:
    """Whether what is left is noise, however loud: without peaks, and as strong in records of other levels.

    Args:
        residuals: (n_outputs, n_samples) measured less predicted, one per record.
        records: what was measured.
    """
    levels = [(record.outputs**2).mean() for record in records]
    power = np.array([(residual**2).mean(axis=1) for residual in residuals])
    if max(levels) <= NOISE.louder * min(levels) or (power.max(axis=0) >= NOISE.alike * power.min(axis=0)).any():
        return False
    return all((_under_peaks(left) > NOISE.flat * own).all() for left, own in zip(residuals, power, strict=True))


def noise_guessed(rig: Rig, records: Sequence[Record]) -> np.ndarray:
    """Standard deviation of each sensor's white noise (n_outputs,) before anything is known of the gap.

    By the quietest bands of what was measured, and of what the rig leaves of that.
    """
    left = [record.outputs - predict(rig, record) for record in records]
    bands = [_band_means(series) for series in (*left, *(record.outputs for record in records))]
    least = np.min([np.quantile(means, NOISE.least, axis=1) for means in bands], axis=0)
    guess: Floats = np.sqrt(least / NOISE.of_least)
    return guess


def _band_means(residual: Floats) -> Floats:
    """Means of the periodogram over bands of so many lines: (n_outputs, n_bands)."""
    n_outputs, n_samples = residual.shape
    window = np.hanning(n_samples)
    spectrum = np.abs(np.fft.rfft(residual * window, axis=1)[:, 1:]) ** 2 / (n_samples * np.mean(window**2))
    bands = max(spectrum.shape[1] // NOISE.lines, 1)
    means: Floats = spectrum[:, : bands * (spectrum.shape[1] // bands)].reshape(n_outputs, bands, -1).mean(axis=2)
    return means


def _under_peaks(residual: Floats) -> Floats:
    """Mean square (n_outputs,) under the peaks of the spectrum."""
    means = _band_means(residual)
    reach = min(NOISE.reach, (means.shape[1] - 1) // 2)
    around = sliding_window_view(np.pad(means, ((0, 0), (reach, reach)), mode="reflect"), 2 * reach + 1, axis=1)
    floor = np.quantile(around, NOISE.quiet, axis=2) * (1.0 + NOISE.lower / np.sqrt(NOISE.lines))
    under: Floats = np.minimum(means, floor).mean(axis=1)
    return under
