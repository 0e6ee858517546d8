"""Readings of sensors from the motion of a rig, with all imperfections but noise."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.signal import lfilter

from workbench.arrays import Floats, Integers
from workbench.rig.motion import Motion
from workbench.rig.rig import KEPT, Rig, shapes_at
from workbench.rig.sensors import MEASURED, Sensor, crosstalk_between

DERIVATIVES = ("displacement", "velocity", "acceleration")  # in time, by order


@lru_cache(maxsize=KEPT)
def reading_of(rig: Rig) -> tuple[Floats, Integers]:
    """Output matrix (n_sensors, n_modes) of the sensors, and the order (n_sensors,) of their time derivative.

    The arrays are cached and must not be changed.
    """
    orders = np.array([MEASURED[sensor.quantity][1] for sensor in rig.sensors], np.int64)
    return np.array([sensor.gain for sensor in rig.sensors])[:, None] * _shapes(rig), orders


@lru_cache(maxsize=KEPT)
def _shapes(rig: Rig) -> Floats:
    return shapes_at(rig.modes, rig.sensors)


def read(rig: Rig, motion: Motion) -> Floats:
    """Noise-free readings (n_sensors, n_samples) of a motion, clipped, and with the mean effect of rounding."""
    shapes, crosstalk = _shapes(rig), crosstalk_between(rig.sensors)
    truths = _delayed(rig, motion, rig.sensors, shapes)
    outputs = truths.copy() if crosstalk else truths
    for j, i, share in crosstalk:
        sensor, source = rig.sensors[j], rig.sensors[i]
        as_late = replace(source, delay=sensor.delay, interpolated=sensor.interpolated)
        taken = truths[i] if as_late == source else _delayed(rig, motion, (as_late,), shapes[[i]])[0]
        outputs[j] += share * taken
    for j, sensor in enumerate(rig.sensors):
        outputs[j] = sensor_reading(sensor, outputs[j], motion.sample_time)
    return outputs


def _delayed(rig: Rig, motion: Motion, sensors: Sequence[Sensor], shapes: Floats) -> Floats:
    """Measured quantities (n_sensors, n_samples) of a motion after each sensor's delay, for shapes (n_sensors, n)."""
    delays = np.array([0.0 if sensor.interpolated else sensor.delay for sensor in sensors])
    outputs = np.empty((len(sensors), motion.displacement.shape[1]))
    for quantity in {sensor.quantity for sensor in sensors}:
        order, here = MEASURED[quantity][1], [j for j, s in enumerate(sensors) if s.quantity == quantity]
        prompt, late = [j for j in here if delays[j] == 0], [j for j in here if delays[j] != 0]
        if prompt:
            outputs[prompt] = shapes[prompt] @ getattr(motion, DERIVATIVES[order])
        if late:
            outputs[late] = _read_late(rig, motion, order, shapes[late], delays[late])
    for j, sensor in enumerate(sensors):
        if sensor.delay and sensor.interpolated:
            samples = np.arange(outputs.shape[1])
            outputs[j] = np.interp(samples - sensor.delay / motion.sample_time, samples, outputs[j])
    return outputs


def _read_late(rig: Rig, motion: Motion, order: int, shapes: Floats, delays: Floats) -> Floats:
    """Measured quantities (n_sensors, n_samples) of delayed sensors (n_sensors, n_modes) of one order."""
    if order == 2 and motion.delayed is not None:
        outputs = np.empty((len(shapes), motion.displacement.shape[1]))
        for delay in set(delays):
            here = delays == delay
            outputs[here] = shapes[here] @ motion.delayed(delay).acceleration
        return outputs
    if motion.finer is None or not (order == 2 or rig.is_rate_limited):
        return motion.between_samples.delayed(order, shapes, delays)
    return motion.finely.between_samples.delayed(order, shapes, delays)[:, :: motion.times_finer]


def sensor_reading(sensor: Sensor, truth: np.ndarray, sample_time: float) -> np.ndarray:
    """A sensor's mean reading (n_samples,) of a measured quantity: lag, gain, bias and drift, clipping, rounding."""
    y = truth
    if sensor.time_constant > 0:
        y = _lagged(y, sensor.time_constant, sample_time)
    if sensor.gain != 1:
        y = sensor.gain * y
    if sensor.bias or sensor.drift:
        y = y + sensor.bias + sensor.drift * np.linspace(0.0, 1.0, y.size)
    if np.isfinite(sensor.limit):
        y = np.clip(y, -sensor.limit, sensor.limit)
    if sensor.step > 0:
        y = _mean_rounded(y, sensor.step, sensor.noise_std)
    return y


def _lagged(truth: np.ndarray, time_constant: float, sample_time: float) -> np.ndarray:
    """A first-order lag of a signal that is linear between samples, in steady state at its first value."""
    ratio = sample_time / time_constant
    fade = np.exp(-ratio)
    new = 1.0 - (1.0 - fade) / ratio
    old = (1.0 - fade) / ratio - fade
    return np.asarray(lfilter([new, old], [1.0, -fade], truth, zi=[(1.0 - new) * truth[0]])[0])


def _mean_rounded(y: np.ndarray, step: float, noise_std: float) -> np.ndarray:
    """The mean of a rounded noisy reading, by the Fourier series of the rounding error."""
    sigma = noise_std / step
    if sigma < 0.05:
        return step * np.round(y / step)
    error = np.zeros_like(y)
    for m in range(1, 12):
        weight = np.exp(-2.0 * (np.pi * m * sigma) ** 2)
        if weight < 1e-12:
            break
        error += (-1.0) ** m / (np.pi * m) * weight * np.sin(2.0 * np.pi * m * y / step)
    return y + step * error
