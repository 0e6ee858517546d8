"""Noise of the logged inputs: what it leaves, how loud it is, and the filter that makes it white."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from workbench.arrays import Floats
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import ForceFilter, force_filter, log_likelihood, sampled_model
from workbench.records.record import Record
from workbench.rig.rig import Rig, shape_of
from workbench.rig.simulate import predict


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
    if best in (0, len(SHARES) - 1):
        return LikeliestShare(SHARES[best], float(losses[best]), beyond)
    before, at, after = losses[best - 1 : best + 2]
    turn = 0.5 * (before - after) / (before - 2.0 * at + after)
    return LikeliestShare(float(SHARES[best] * 0.5**turn), float(at), beyond)
