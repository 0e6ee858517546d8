"""Noise estimated from the residuals of a fitted model: of each sensor, and of the logged inputs."""

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
from workbench.rig.actuators import mixing
from workbench.rig.rig import Rig, shape_of
from workbench.rig.simulate import simulate_record


@dataclass(frozen=True)
class NoiseSettings:
    """Constants of the estimate of a sensor's noise."""

    band_lines: int = 20  # of the periodogram in a band, whose mean then scatters by a quarter
    neighbour_bands: int = 5  # on either side
    floor_quantile: float = 0.25  # of these bands: a quarter of them have no peaks of modes
    floor_deviations: float = 0.67  # standard deviations by which that quantile lies below the mean
    equal_power_ratio: float = 1.3  # times the power of the quietest record: residuals of two records count as equal
    chance_power_ratio: float = 1.1  # likewise: records that differ from it by chance alone
    floor_share: float = 0.5  # of the mean square: with more of it below the peaks, these are not left out
    # quantile of all bands: a gap's residual is least between and beyond the modes; and the ratio of this quantile to
    # the power of white noise, by the chi-square distribution of so many lines
    quietest_quantile: float = 0.05
    quantile_ratio: float = 0.66
    min_level_ratio: float = 2.0  # times the power of the quietest record: another level
    peakless_share: float = 0.6  # of the mean square, below the peaks: without peaks, 1400 samples have over 0.8
    peak_ratio: float = 4.0  # times the noise floor by its neighbours: noise of 16,000 samples has no such band
    max_correlation: float = 0.2  # between two sensors: independent noise reaches 0.15 in 600 samples
    offset_deviations: float = 4.0  # standard errors of a mean of noise
    max_bands: int = 50  # that are searched for peaks, at most, so that a peak is narrower than its neighbourhood


NOISE = NoiseSettings()


def noise_found(residuals: Sequence[np.ndarray], coloured: np.ndarray | None = None) -> np.ndarray:
    """Standard deviation of each sensor's noise (n_outputs,), in the sensors' units.

    Noise is equally strong in every record, while a model error grows with the level: the noise is at most the smallest
    residual (n_outputs, n_samples) of all records. Model errors make peaks at the modes: the noise is at most the
    smooth spectrum, white or coloured, under these peaks. coloured: (n_outputs,) of `are_coloured`, if known.
    """
    coloured = are_coloured(residuals) if coloured is None else coloured
    whole = np.sort([(residual**2).mean(axis=1) for residual in residuals], axis=0)
    under = np.min([_power_under_peaks(residual) for residual in residuals], axis=0)
    # a residual equally strong in two records of different levels is noise of whatever colour
    alike = whole[1] < NOISE.equal_power_ratio * whole[0] if len(residuals) > 1 else np.zeros(under.size, bool)
    same = whole <= NOISE.chance_power_ratio * whole[0]  # the quietest record itself too, if its residual is zero
    noise = np.where(same, whole, 0.0).sum(axis=0) / same.sum(axis=0)
    power: Floats = np.where(alike | (under > NOISE.floor_share * whole[0]) | coloured, noise, under)
    return np.sqrt(power)


def are_coloured(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Whether the residual of each sensor (n_outputs,) is noise of a first-order spectrum, however loud.

    Such noise has no peaks and is uncorrelated between sensors. The response to an unmodelled force has the peaks of
    the modes, or correlates between sensors; an offset or a drift is no noise either. False for a single sensor, and
    for records too short for the test.
    """
    if len(residuals[0]) < 2:
        return np.zeros(1, bool)
    return np.asarray(np.all([_is_coloured(left) for left in _prewhitened(residuals)], axis=0))


def _is_coloured(prewhitened: Floats) -> np.ndarray:
    """Whether a prewhitened residual (n_outputs, n_samples) is white noise, by sensor (n_outputs,)."""
    n_outputs, n_samples = prewhitened.shape
    means = _band_means(prewhitened, max(NOISE.band_lines, n_samples // (2 * NOISE.max_bands)))
    if means.shape[1] <= 2 * NOISE.neighbour_bands or not prewhitened.any(axis=1).all():
        return np.zeros(n_outputs, bool)
    together = np.abs(np.corrcoef(prewhitened) - np.eye(n_outputs)).max(axis=1)
    # means of both halves, over their standard errors: an offset or a drift makes them large
    halves = np.array([half.mean(axis=1) for half in np.array_split(prewhitened, 2, axis=1)])
    apart = np.abs(halves).max(axis=0) / prewhitened.std(axis=1) * np.sqrt(n_samples / 2.0)
    has_no_peak = (means < NOISE.peak_ratio * _noise_floor(means)).all(axis=1)
    return np.asarray(has_no_peak & (together < NOISE.max_correlation) & (apart < NOISE.offset_deviations))


def _prewhitened(residuals: Sequence[np.ndarray]) -> list[Floats]:
    """r_n - ρ r_{n-1}, with the lag-one autocorrelation ρ of the detrended residual of each sensor in all records."""
    detrended = [detrend(r) for r in residuals]
    power = sum((r**2).sum(axis=1) for r in detrended)
    lagged = sum((r[:, 1:] * r[:, :-1]).sum(axis=1) for r in detrended)
    correlation = np.divide(lagged, power, out=np.zeros_like(power), where=power > 0)[:, None]
    return [r[:, 1:] - correlation * r[:, :-1] for r in residuals]


def is_noise_alone(
    residuals: Sequence[np.ndarray], records: Sequence[Record], coloured: np.ndarray | None = None
) -> bool:
    """Whether the residual is noise, however loud: without peaks, and equally strong in records of different levels.

    coloured: (n_outputs,) of `are_coloured`, if known.
    """
    levels = [(record.outputs**2).mean() for record in records]
    if max(levels) <= NOISE.min_level_ratio * min(levels):
        return False
    has_colour = bool((are_coloured(residuals) if coloured is None else coloured).all())
    # prewhitened, coloured noise has as many independent samples as white noise
    power = np.array([(left**2).mean(axis=1) for left in (_prewhitened(residuals) if has_colour else residuals)])
    if (power.max(axis=0) >= NOISE.equal_power_ratio * power.min(axis=0)).any():
        return False
    each = zip(residuals, power, strict=True)
    return has_colour or all((_power_under_peaks(left) > NOISE.peakless_share * own).all() for left, own in each)


def noise_guessed(rig: Rig, records: Sequence[Record]) -> np.ndarray:
    """Standard deviation of each sensor's white noise (n_outputs,), before anything is known of the gap.

    From the quietest bands of the measured outputs and of the nominal residuals.

    Raises:
        ValueError: for a sensor without noise, stated or not, as in records of a simulation.
    """
    left = [record.outputs - simulate_record(rig, record) for record in records]
    bands = [_band_means(series) for series in (*left, *(record.outputs for record in records))]
    least = np.min([np.quantile(means, NOISE.quietest_quantile, axis=1) for means in bands], axis=0)
    for sensor, power in zip(rig.sensors, least, strict=True):
        if not (power or sensor.noise_std):
            raise ValueError(
                f"the records show no noise of sensor {sensor.name}, by which its residual is weighted: state its"
                " noise_std"
            )
    return np.asarray(np.sqrt(least / NOISE.quantile_ratio))


def _band_means(residual: Floats, lines: int = NOISE.band_lines) -> Floats:
    """Means of the periodogram over bands of so many lines: (n_outputs, n_bands)."""
    n_outputs, n_samples = residual.shape
    window = np.hanning(n_samples)
    spectrum = np.abs(np.fft.rfft(residual * window, axis=1)[:, 1:]) ** 2 / (n_samples * np.mean(window**2))
    bands = max(spectrum.shape[1] // lines, 1)
    whole = bands * (spectrum.shape[1] // bands)
    return np.asarray(spectrum[:, :whole].reshape(n_outputs, bands, -1).mean(axis=2))


def _power_under_peaks(residual: Floats) -> Floats:
    """Mean square (n_outputs,) under the peaks of the spectrum."""
    means = _band_means(residual)
    return np.asarray(np.minimum(means, _noise_floor(means)).mean(axis=1))


def _noise_floor(means: Floats) -> Floats:
    """Noise power of each band of a spectrum (n_outputs, n_bands), from the quieter of its neighbours."""
    reach = min(NOISE.neighbour_bands, (means.shape[1] - 1) // 2)
    around = sliding_window_view(np.pad(means, ((0, 0), (reach, reach)), mode="reflect"), 2 * reach + 1, axis=1)
    below_mean = NOISE.floor_deviations / np.sqrt(NOISE.band_lines)
    return np.asarray(np.quantile(around, NOISE.floor_quantile, axis=2) * (1.0 + below_mean))


@dataclass(frozen=True)
class LoggedSettings:
    """Constants of the estimate of input noise (noise of the logged inputs)."""

    draws: int = 12  # of that noise; the loudest is what chance may cause
    # of the power of the loudest input: variances of zero would make the filter singular
    min_power_ratio: float = 1e-12
    max_share: float = 0.02  # of the rms of an input: largest noise of a logger
    # likewise: where this is likelier than any logger's noise, the residual of a record has another cause
    implausible_share: float = 0.04
    # log-likelihood over that of `LEAST_LOGGED`, nats, from which the records show input noise: for one parameter a
    # gain by chance of 6 has a probability of 5e-4
    log_likelihood_gain: float = 6.0


LOGGED = LoggedSettings()
LEAST_LOGGED = 1e-3  # of the rms of an input: less noise cannot be distinguished from none
# Shares of the inputs' rms at which the likelihood is evaluated; its maximum is interpolated.
SHARES = tuple(LOGGED.max_share * 0.5**k for k in range(5))


def logging_noise_power(rig: Rig, data: FitData) -> np.ndarray:
    """Expected mean square response to input noise (n_records, n_outputs), in units of the sensors' noise.

    For white noise on each nonzero input, of the input's own rms. Noise of variance σ² on one input causes a variance
    σ² Σ h_k² at sample n, over k ≤ n of the response h to a pulse of one sample.
    """
    longest = max(data.counted, key=lambda record: record.n_samples)
    pulses = np.eye(len(rig.actuators))[:, :, None] * (np.arange(longest.n_samples) == 0)
    linear = replace(rig, elements=())
    answers = np.array([simulate_record(linear, replace(longest, inputs=pulse)) for pulse in pulses])
    so_far = (answers**2).cumsum(axis=2)  # (n_inputs, n_outputs, n_samples)
    by_input = [so_far[:, :, : record.n_samples].mean(axis=2) for record in data.counted]
    each = zip(data.counted, by_input, strict=True)
    return np.asarray([(record.inputs**2).mean(axis=1) @ power / data.noise**2 for record, power in each])


def loudest_logging_noise(rig: Rig, data: FitData) -> np.ndarray:
    """The same mean squares for the loudest of a dozen draws, which differ much if the damping is low."""
    rng = np.random.default_rng(0)
    linear = replace(rig, elements=())

    def power(record: Record) -> Floats:
        response = simulate_record(linear, replace(record, inputs=noise_of_inputs(record, rng)))
        return np.asarray((response**2).mean(axis=1) / data.noise**2)

    draws = np.array([[power(record) for record in data.counted] for _ in range(LOGGED.draws)])
    loudest = draws.mean(axis=2).argmax(axis=0)
    return np.array([draws[draw, i] for i, draw in enumerate(loudest)])


def noise_of_inputs(record: Record, rng: np.random.Generator) -> Floats:
    """A draw of white noise on each input (n_inputs, n_samples), of the input's own rms, N."""
    rms = np.sqrt((record.inputs**2).mean(axis=1, keepdims=True))
    return np.asarray(rms * rng.standard_normal(record.inputs.shape))


def logging_noise(by_channel: np.ndarray, sensor_noise: np.ndarray, per_unit: np.ndarray) -> float:
    """Input noise, as a share of the inputs' rms, from the median excess of the residual power.

    The excess of mean square residuals (n_records, n_outputs), in units of the stated noise, is that over the record
    with the weakest inputs, or over the sensor noise (n_outputs,) of a single record; per_unit: (n_records, n_outputs)
    of `logging_noise_power`.
    """
    rows = np.arange(len(by_channel)) != np.argmin(per_unit.sum(axis=1))
    beyond, per = by_channel - sensor_noise, per_unit
    if rows.any():  # the record with the weakest inputs shows the sensor noise
        with np.errstate(invalid="ignore"):  # the simulation may diverge
            beyond, per = by_channel[rows] - by_channel[~rows], per_unit[rows] - per_unit[~rows]
    share = np.median(np.fmax(beyond, 0.0) / np.maximum(per, 1e-300))
    return float(min(np.sqrt(share), LOGGED.max_share))


def input_filters(rig: Rig, data: FitData, share: float) -> dict[str, ForceFilter]:
    """Whitening filters, by record, of the response to input noise, a share of each input's rms, plus sensor noise.

    Nonlinear laws and the dynamics of actuators are left out.
    """
    sample_times = {record.sample_time for record in data.records}
    models = {dt: sampled_model(rig.modes, rig.sensors, data.noise, dt) for dt in sample_times}
    patterns = np.column_stack([a.gain * shape_of(rig.modes, a) for a in rig.actuators])
    if any(a.crosstalk for a in rig.actuators):
        patterns = patterns @ mixing(rig.actuators)
    filters = {}
    for record in data.records:
        power = share**2 * (record.inputs**2).mean(axis=1)
        variances = np.maximum(power, max(LOGGED.min_power_ratio * power.max(), 1e-300))  # none of them zero
        filters[record.name] = force_filter(models[record.sample_time], patterns, variances)
    return filters


class LikeliestShare(NamedTuple):
    """Maximum-likelihood estimate of the input noise.

    Attributes:
        share: of the inputs' rms.
        loss: minus the log-likelihood of the residual.
        is_beyond: whether most records ask for more noise than any logger has.
    """

    share: float
    loss: float
    is_beyond: bool


def likeliest_share(rig: Rig, data: FitData, residuals: Sequence[np.ndarray]) -> LikeliestShare:
    """Input noise by maximum likelihood of the residuals (n_outputs, n_samples) of each record."""
    by_record = np.array([_losses(rig, data, residuals, share) for share in (LOGGED.implausible_share, *SHARES)])
    beyond = bool(np.median(by_record.argmin(axis=0)) < 1.0)
    losses = by_record[1:].sum(axis=1)
    best = int(np.argmin(losses))
    if best in (0, len(SHARES) - 1) or not np.isfinite(losses[best - 1 : best + 2]).all():
        return LikeliestShare(SHARES[best], float(losses[best]), beyond)
    before, at, lagged = losses[best - 1 : best + 2]
    turn = 0.5 * (before - lagged) / (before - 2.0 * at + lagged)
    return LikeliestShare(float(SHARES[best] * 0.5**turn), float(at), beyond)


def shows_input_noise(rig: Rig, data: FitData, residuals: Sequence[np.ndarray], share: float) -> bool:
    """Whether the residuals, as of `likeliest_share`, surely show input noise of a share of the inputs' rms."""
    with_noise, without = (sum(_losses(rig, data, residuals, each)) for each in (share, LEAST_LOGGED))
    return without - with_noise > LOGGED.log_likelihood_gain


def _losses(rig: Rig, data: FitData, residuals: Sequence[np.ndarray], share: float) -> list[float]:
    """Minus the log-likelihood of the residual of each record, with input noise of a share of the inputs' rms."""
    filters = input_filters(rig, data, share)
    return [-log_likelihood(filters[r.name], [left]) for r, left in zip(data.records, residuals, strict=True)]
