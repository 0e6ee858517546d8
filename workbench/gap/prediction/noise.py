"""Noise, found from what a fitted model leaves of records: of each sensor, and of the logged inputs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import detrend

from workbench.arrays import Floats
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import ForceFilter, force_filter, log_likelihood, sampled_model
from workbench.records.record import Record
from workbench.rig.rig import Rig, shape_of
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
    peak: float = 4.0  # times what its neighbours say that a band would hold: noise has none in 16,000 samples
    together: float = 0.2  # correlation of two sensors' noise: chance alone makes 0.15 in 600 samples
    offset: float = 4.0  # standard deviations of a mean of noise
    bands: int = 50  # in which peaks are looked for, at most, so that one is narrower than its neighbourhood


NOISE = NoiseSettings()


def noise_found(residuals: Sequence[np.ndarray], coloured: np.ndarray | None = None) -> np.ndarray:
    """Standard deviation of each sensor's noise (n_outputs,), in the sensors' units.

    Noise is as strong in every record, while what a model lacks goes with the level; so the noise is at most the least
    of all records; and errors of a model make peaks about its modes, so the noise is at most what lies under them in
    a spectrum that is smooth otherwise, white or coloured.

    Args:
        residuals: (n_outputs, n_samples) measured less predicted, one per record.
        coloured: (n_outputs,) of `are_coloured`, where that is known.
    """
    coloured = are_coloured(residuals) if coloured is None else coloured
    whole = np.sort([(residual**2).mean(axis=1) for residual in residuals], axis=0)
    under = np.min([_under_peaks(residual) for residual in residuals], axis=0)
    # what is as strong in two records of unequal level is noise, of whatever colour
    alike = whole[1] < NOISE.alike * whole[0] if len(residuals) > 1 else np.zeros(under.size, bool)
    same = whole < NOISE.same * whole[0]
    noise = np.where(same, whole, 0.0).sum(axis=0) / same.sum(axis=0)
    power: Floats = np.where(alike | (under > NOISE.loud * whole[0]) | coloured, noise, under)
    return np.sqrt(power)


def are_coloured(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Whether what is left at each sensor (n_outputs,) is noise of a first-order spectrum, however loud.

    Such noise has no peaks but that slope, and goes its own way at every sensor; what a structure answers to a force
    that a model lacks has the peaks of its modes, or moves all sensors together, and no offset or
    drift is noise. Of one sensor nobody can tell, nor of a record too short for its bands to have neighbours.

    Args:
        residuals: (n_outputs, n_samples) measured less predicted, one per record.
    """
    if len(residuals[0]) < 2:
        return np.zeros(1, bool)
    coloured: np.ndarray = np.all([_is_coloured(left) for left in _levelled(residuals)], axis=0)
    return coloured


def _is_coloured(levelled: Floats) -> np.ndarray:
    n_outputs, n_samples = levelled.shape
    means = _band_means(levelled, max(NOISE.lines, n_samples // (2 * NOISE.bands)))
    if means.shape[1] <= 2 * NOISE.reach or not levelled.any(axis=1).all():
        return np.zeros(n_outputs, bool)
    together = np.abs(np.corrcoef(levelled) - np.eye(n_outputs)).max(axis=1)
    # means of both halves, which an offset or a drift moves, in standard deviations of those of noise
    halves = np.array([half.mean(axis=1) for half in np.array_split(levelled, 2, axis=1)])
    apart = np.abs(halves).max(axis=0) / levelled.std(axis=1) * np.sqrt(n_samples / 2.0)
    has_no_peak = (means < NOISE.peak * _floor(means)).all(axis=1)
    return np.asarray(has_no_peak & (together < NOISE.together) & (apart < NOISE.offset))


def _levelled(residuals: Sequence[np.ndarray]) -> list[Floats]:
    """r_n - ρ r_{n-1}, with the correlation ρ over one sample of what swings at each sensor in all records."""
    swings = [detrend(r) for r in residuals]
    power = sum((r**2).sum(axis=1) for r in swings)
    after = sum((r[:, 1:] * r[:, :-1]).sum(axis=1) for r in swings)
    correlation = np.divide(after, power, out=np.zeros_like(power), where=power > 0)[:, None]
    return [r[:, 1:] - correlation * r[:, :-1] for r in residuals]


def is_noise_alone(
    residuals: Sequence[np.ndarray], records: Sequence[Record], coloured: np.ndarray | None = None
) -> bool:
    """Whether what is left is noise, however loud: without peaks, and as strong in records of other levels.

    Args:
        residuals: (n_outputs, n_samples) measured less predicted, one per record.
        records: what was measured.
        coloured: (n_outputs,) of `are_coloured`, where that is known.
    """
    levels = [(record.outputs**2).mean() for record in records]
    if max(levels) <= NOISE.louder * min(levels):
        return False
    has_colour = bool((are_coloured(residuals) if coloured is None else coloured).all())
    # without its colour, a record holds as many samples of it as of white noise
    power = np.array([(left**2).mean(axis=1) for left in (_levelled(residuals) if has_colour else residuals)])
    if (power.max(axis=0) >= NOISE.alike * power.min(axis=0)).any():
        return False
    each = zip(residuals, power, strict=True)
    return has_colour or all((_under_peaks(left) > NOISE.flat * own).all() for left, own in each)


def noise_guessed(rig: Rig, records: Sequence[Record]) -> np.ndarray:
    """Standard deviation of each sensor's white noise (n_outputs,) before anything is known of the gap.

    By the quietest bands of what was measured, and of what the rig leaves of that.
    """
    left = [record.outputs - predict(rig, record) for record in records]
    bands = [_band_means(series) for series in (*left, *(record.outputs for record in records))]
    least = np.min([np.quantile(means, NOISE.least, axis=1) for means in bands], axis=0)
    guess: Floats = np.sqrt(least / NOISE.of_least)
    return guess


def _band_means(residual: Floats, lines: int = NOISE.lines) -> Floats:
    """Means of the periodogram over bands of so many lines: (n_outputs, n_bands)."""
    n_outputs, n_samples = residual.shape
    window = np.hanning(n_samples)
    spectrum = np.abs(np.fft.rfft(residual * window, axis=1)[:, 1:]) ** 2 / (n_samples * np.mean(window**2))
    bands = max(spectrum.shape[1] // lines, 1)
    means: Floats = spectrum[:, : bands * (spectrum.shape[1] // bands)].reshape(n_outputs, bands, -1).mean(axis=2)
    return means


def _under_peaks(residual: Floats) -> Floats:
    """Mean square (n_outputs,) under the peaks of the spectrum."""
    means = _band_means(residual)
    under: Floats = np.minimum(means, _floor(means)).mean(axis=1)
    return under


def _floor(means: Floats) -> Floats:
    """What each band of a spectrum (n_outputs, n_bands) would hold by the quieter of its neighbours."""
    reach = min(NOISE.reach, (means.shape[1] - 1) // 2)
    around = sliding_window_view(np.pad(means, ((0, 0), (reach, reach)), mode="reflect"), 2 * reach + 1, axis=1)
    floor: Floats = np.quantile(around, NOISE.quiet, axis=2) * (1.0 + NOISE.lower / np.sqrt(NOISE.lines))
    return floor


@dataclass(frozen=True)
class LoggedSettings:
    """Constants of the search for noise of the logged inputs."""

    draws: int = 12  # of that noise, of which the loudest is what chance may leave
    quietest: float = 1e-12  # of the loudest force: none at all would leave the filter nothing to estimate
    most: float = 0.02  # of the rms of an input: what a logger adds at most
    # likewise: a record to which this is likelier than what a logger adds is left something else
    beyond: float = 0.04


LOGGED = LoggedSettings()
LEAST_LOGGED = 1e-3  # of the rms of an input: no record distinguishes less from none
# That are tried; between them the likeliest is interpolated.
SHARES = tuple(LOGGED.most * 0.5**k for k in range(5))


def logging_noise_power(rig: Rig, data: FitData) -> np.ndarray:
    """Mean squares (n_records, n_outputs) to expect of noise of the logged inputs, in units of the sensors' noise.

    For white noise of each input, as strong as the input itself; inputs at rest have none. That of variance σ² at one
    input leaves σ² Σ h_k² of sample n, over k ≤ n of the answer h to a pulse of one sample.

    Args:
        rig: nominal.
        data: fit records.
    """
    longest = max(data.counted, key=lambda record: record.n_samples)
    pulses = np.eye(len(rig.actuators))[:, :, None] * (np.arange(longest.n_samples) == 0)
    linear = replace(rig, elements=())
    answers = np.array([predict(linear, replace(longest, inputs=pulse)) for pulse in pulses])
    so_far = (answers**2).cumsum(axis=2)  # (n_inputs, n_outputs, n_samples)
    by_input = [so_far[:, :, : record.n_samples].mean(axis=2) for record in data.counted]
    each = zip(data.counted, by_input, strict=True)
    expected: Floats = np.array([(record.inputs**2).mean(axis=1) @ power for record, power in each]) / data.noise**2
    return expected


def loudest_logging_noise(rig: Rig, data: FitData) -> np.ndarray:
    """The same mean squares of the loudest of a dozen draws: a structure of little damping answers each otherwise."""
    rng = np.random.default_rng(0)
    linear = replace(rig, elements=())

    def power(record: Record) -> Floats:
        response = predict(linear, replace(record, inputs=noise_of_inputs(record, rng)))
        mean_square: Floats = (response**2).mean(axis=1) / data.noise**2
        return mean_square

    draws = np.array([[power(record) for record in data.counted] for _ in range(LOGGED.draws)])
    loudest = draws.mean(axis=2).argmax(axis=0)
    return np.array([draws[draw, i] for i, draw in enumerate(loudest)])


def noise_of_inputs(record: Record, rng: np.random.Generator) -> Floats:
    """A draw of white noise of each input (n_inputs, n_samples), as strong as the input itself, N."""
    rms = np.sqrt((record.inputs**2).mean(axis=1, keepdims=True))
    noise: Floats = rms * rng.standard_normal(record.inputs.shape)
    return noise


def logging_noise(by_channel: np.ndarray, sensor_noise: np.ndarray, per_unit: np.ndarray) -> float:
    """Noise of the logged inputs as a share of their rms.

    It accounts for the median of what is left beyond what the record with the weakest inputs leaves.

    Args:
        by_channel: (n_records, n_outputs) mean squares of what is left, in units of the stated noise.
        sensor_noise: (n_outputs,) power of the sensors' noise, likewise.
        per_unit: of `logging_noise_power`.
    """
    rows = np.arange(len(by_channel)) != np.argmin(per_unit.sum(axis=1))
    beyond, per = by_channel - sensor_noise, per_unit
    if rows.any():  # the record with the weakest inputs shows the noise of the sensors itself
        beyond, per = by_channel[rows] - by_channel[~rows], per_unit[rows] - per_unit[~rows]
    share = np.median(np.maximum(beyond, 0.0) / np.maximum(per, 1e-300))
    return float(min(np.sqrt(share), LOGGED.most))


def input_filters(rig: Rig, data: FitData, share: float) -> dict[str, ForceFilter]:
    """Filters, by record, that make white what noise of the logged inputs and of the sensors leaves.

    The noise is white at every input that is not at rest, a share of its rms; the structure answers linearly.

    Args:
        rig: with the modes that answer; its laws and what its actuators lose on the way are left out.
        data: records, with the noise of the sensors.
        share: of the inputs' rms.
    """
    model = sampled_model(rig.modes, rig.sensors, data.noise, data.records[0].sample_time)
    patterns = np.column_stack([a.gain * shape_of(rig.modes, a) for a in rig.actuators])
    return {r.name: force_filter(model, patterns, _variances(r, share)) for r in data.records}


def _variances(record: Record, share: float) -> Floats:
    power: Floats = share**2 * (record.inputs**2).mean(axis=1)
    return np.maximum(power, max(LOGGED.quietest * power.max(), 1e-300))


class LikeliestShare(NamedTuple):
    """Noise of the logged inputs as what is left shows it.

    Attributes:
        share: of their rms.
        loss: minus the log-likelihood of what is left beside it.
        is_beyond: whether most records would have it louder than any logger's.
    """

    share: float
    loss: float
    is_beyond: bool


def likeliest_share(rig: Rig, data: FitData, residuals: Sequence[np.ndarray]) -> LikeliestShare:
    """Noise of the logged inputs by maximum likelihood of what is left.

    Args:
        rig: whose modes answer to it.
        data: records, with the noise of the sensors.
        residuals: (n_outputs, n_samples) measured less predicted, one per record.
    """

    def losses_of(share: float) -> list[float]:
        filters = input_filters(rig, data, share)
        return [-log_likelihood(filters[r.name], [left]) for r, left in zip(data.records, residuals, strict=True)]

    by_record = np.array([losses_of(share) for share in (LOGGED.beyond, *SHARES)])
    beyond = bool(np.median(by_record.argmin(axis=0)) < 1.0)
    losses = by_record[1:].sum(axis=1)
    best = int(np.argmin(losses))
    if best in (0, len(SHARES) - 1) or not np.isfinite(losses[best - 1 : best + 2]).all():
        return LikeliestShare(SHARES[best], float(losses[best]), beyond)
    before, at, after = losses[best - 1 : best + 2]
    turn = 0.5 * (before - after) / (before - 2.0 * at + after)
    return LikeliestShare(float(SHARES[best] * 0.5**turn), float(at), beyond)
