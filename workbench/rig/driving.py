"""Forces of actuators over the substeps of a sample: linear in time, with exact corrections for delays and lags.

A delayed or lagged force is not linear over a substep. Where nonlinear laws are solved it is replaced by the linear
force of the same mean and first moment; the difference in the motion of each mode is known in closed form.
"""

from collections.abc import Callable
from functools import lru_cache
from math import copysign, factorial
from typing import Concatenate, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numba import njit
from scipy.signal import lfilter

from workbench.arrays import Complexes, Flags, Floats
from workbench.records.band_limited import finer
from workbench.rig.actuators import Actuator, mixed
from workbench.rig.elements import PeriodicForce
from workbench.rig.force_laws import hysteresis
from workbench.rig.linear import propagators, shifted, whole_samples

RECORDS_KEPT, MOST_KEPT = 16, 2**18  # size of a cache for records, and the largest array in it
ROUND_OFF = 1e-9  # of the largest force
ALIKE = 1e-5  # least difference of a mode's two poles, times the substep, to avoid 0/0
P = ParamSpec("P")
R = TypeVar("R")


def actuator_force(actuator: Actuator, command: np.ndarray) -> np.ndarray:
    """The static force (n_samples,) of a command with its cross-talk: hysteresis, gain, dead zone and saturation."""
    if actuator.hysteresis_share:
        share = actuator.hysteresis_share
        hysteretic = hysteresis(np.r_[0.0, command], actuator.hysteresis_width)[1:]
        command = (1.0 - share) * command + share * hysteretic
    force = command if actuator.gain == 1 else actuator.gain * command
    if actuator.dead_zone > 0:
        force = np.sign(force) * np.maximum(np.abs(force) - actuator.dead_zone, 0.0)
    if np.isfinite(actuator.limit):
        force = np.clip(force, -actuator.limit, actuator.limit)
    return force


@njit(cache=True, nogil=True)
def _ramped(targets: Floats, most: float) -> tuple[Floats, Floats]:
    """Mean over each step, and value at its start, of a signal that follows targets by at most `most` per step."""
    mean, start = np.empty_like(targets), np.empty_like(targets)
    value = 0.0
    for k in range(targets.size):
        start[k] = value
        away = targets[k] - value
        if abs(away) >= most:
            value += copysign(most, away)
            mean[k] = 0.5 * (start[k] + value)
        else:
            value = targets[k]
            mean[k] = value - 0.5 * away * abs(away) / most
    return mean, start


class Term(NamedTuple):
    """A force size t^power e^(-rate t), t the time from its beginning within a substep.

    Attributes:
        begins: s, after the start of the substep.
        rate: of decay, 1/s.
        size: N, or N/s for power 1.
        power: 0, or 1 for a ramp, which has rate 0.
    """

    begins: float
    rate: float
    size: float
    power: int = 0


Waveform = tuple[Term, ...]  # a force over a substep, as a sum


def _linearised(waveform: Waveform, h: float) -> tuple[float, float]:
    """Mean and half the rise over a substep of the linear force of the same mean and first moment."""
    mean = moment = 0.0
    for begins, rate, size, power in waveform:
        lasts = h - begins
        area, first = lasts ** (power + 1) / (power + 1), lasts ** (power + 2) / (power + 2)
        if rate:
            faded = np.exp(-rate * lasts)
            area = (1.0 - faded) / rate
            first = (area - lasts * faded) / rate
        mean += size * area / h
        moment += size * (first + (begins - 0.5 * h) * area) / h**2
    return mean, 6.0 * moment


def motion_correction(waveform: Waveform, omega: Floats, damping: Floats, h: float) -> Floats:
    """Difference (2, n_modes) in q and q' at the end of a substep between a force and its linear replacement."""
    linear = np.empty((2, 4, omega.size))
    propagators(omega, damping, h, linear)
    root = np.sqrt((0.5 * damping) ** 2 - omega**2 + 0j)
    root[np.abs(root) * h < ALIKE] = ALIKE / h
    poles = -0.5 * damping + np.array([1.0, -1.0])[:, None] * root
    mean, rise = _linearised(waveform, h)
    response = np.zeros_like(poles)
    for begins, rate, size, power in waveform:
        lasts = h - begins
        response += size * lasts ** (power + 1) * _convolution(poles * lasts, rate * lasts, power)
    both = np.array([response[0] - response[1], poles[0] * response[0] - poles[1] * response[1]]) / (2.0 * root)
    return np.asarray(both.real - linear[:, 2] * (mean - rise) - linear[:, 3] * (mean + rise))


def _convolution(pole: Complexes, rate: float, power: int) -> Complexes:
    """∫_0^1 t^power e^(-rate t) e^(pole (1 - t)) dt, with rate 0 for power 1."""
    x = pole + rate
    near = np.abs(x) < 0.5  # by a series, as the difference would cancel
    series = np.exp(-rate) * sum(np.where(near, x, 0.0) ** k / factorial(k + power + 1) for k in range(16))
    x = np.where(near, 1.0, x)
    return np.where(near, series, (np.exp(pole) - 1.0 - pole) / x**2 if power else (np.exp(pole) - np.exp(-rate)) / x)


class _Inputs:
    """A read-only array as a key of a cache, compared by identity."""

    def __init__(self, values: Floats) -> None:
        self.values = values

    def __hash__(self) -> int:
        return id(self.values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Inputs) and self.values is other.values


def cached_for_records(function: Callable[Concatenate[Floats, int, P], R]) -> Callable[Concatenate[Floats, int, P], R]:
    """A function of inputs and of steps per sample that is cached for the inputs of a record, which are read-only.

    Structure and sensors of a rig change more often.
    """

    @lru_cache(maxsize=RECORDS_KEPT)
    def cached(inputs: _Inputs, steps: int, *args: P.args, **kwargs: P.kwargs) -> R:
        return function(inputs.values, steps, *args, **kwargs)

    def call(inputs: Floats, steps: int, /, *args: P.args, **kwargs: P.kwargs) -> R:
        if inputs.base is None and not inputs.flags.writeable and inputs.size * steps <= MOST_KEPT:
            return cached(_Inputs(inputs), steps, *args, **kwargs)  # type: ignore[arg-type]
        return function(inputs, steps, *args, **kwargs)

    return call


on_finer_steps = cached_for_records(finer)


@cached_for_records
def drives(
    inputs: Floats, substeps: int, actuators: tuple[Actuator, ...], sample_time: float, input_hold: str
) -> tuple[Flags, Floats, Floats, Floats, tuple[tuple[int, Waveform], ...], Floats]:
    """The forces of the actuators over the substeps, for inputs (n_actuators, n_samples).

    Returns:
        Which actuators ever exert a force (n_actuators,); their linear forces at the start and at the end of each
        substep (n_driven, n_samples * substeps); the forces at the samples (n_actuators, n_samples); and (actuator,
        waveform) of unit delayed or lagged forces, which are not linear, with their sizes in each substep.
    """
    h = sample_time / substeps
    mean = np.empty((inputs.shape[0], inputs.shape[1] * substeps))
    rise = np.zeros_like(mean)  # half of it, over a substep
    at_samples = np.empty_like(inputs)
    nonlinear = []
    given = mixed(actuators, finer(inputs, substeps) if input_hold == "band-limited" else inputs)
    for j, actuator in enumerate(actuators):
        force = actuator_force(actuator, given[j])
        if input_hold == "zero":
            mean[j] = start = np.repeat(force, substeps)
            if np.isfinite(actuator.rate_limit):
                most = actuator.rate_limit * h
                mean[j], start = _ramped(start, most)
                change = np.diff(np.r_[start, 2.0 * mean[j, -1] - start[-1]])
                share = np.minimum(np.abs(change) / most, 1.0)  # of the substep, until the ramp ends
                rise[j] = change * share * (1.5 - share)
        else:  # linear from sample to sample, or from substep to substep; held after the last
            every = mean.shape[1] // force.size
            edges = np.interp(np.arange(mean.shape[1] + 1), every * np.arange(force.size), force)
            if np.isfinite(actuator.rate_limit):
                _, edges = _ramped(np.r_[edges[1:], edges[-1]], actuator.rate_limit * h)
            start = edges[:-1]
            mean[j], rise[j] = 0.5 * (start + edges[1:]), 0.5 * np.diff(edges)
        if actuator.delay or actuator.time_constant:
            mean[j], rise[j], start, waveforms = _delayed_and_lagged(mean[j], rise[j], start, actuator, h)
            for waveform, size in waveforms:
                unit_mean, unit_rise = _linearised(waveform, h)
                mean[j] += unit_mean * size
                rise[j] += unit_rise * size
                nonlinear.append((j, waveform, size))
        mean[j] += actuator.bias
        at_samples[j] = start[::substeps] + actuator.bias
    starts, ends = mean - rise, mean + rise
    least = ROUND_OFF * max(np.abs(starts).max(initial=0.0), np.abs(ends).max(initial=0.0))
    acting = [each for each in nonlinear if np.abs(each[2]).max(initial=0.0) * h ** each[1][0].power > least]
    sizes = np.array([size for *_, size in acting]).reshape(len(acting), mean.shape[1])
    driven = np.logical_or(starts.any(axis=1), ends.any(axis=1))
    of_acting = tuple((j, waveform) for j, waveform, _ in acting)
    return driven, starts[driven], ends[driven], at_samples, of_acting, sizes


def _delayed_and_lagged(
    mean: Floats, rise: Floats, start: Floats, actuator: Actuator, h: float
) -> tuple[Floats, Floats, Floats, list[tuple[Waveform, Floats]]]:
    """Forces that are linear over substeps of h, after the delay and the lag of an actuator.

    Each has its mean, half its rise, and its start, which differs from mean - rise where a ramp ends within the
    substep. Returned are those of the linear part, and unit waveforms of the rest, with sizes.
    """
    shift, late = whole_samples(actuator.delay, h)
    old_mean, old_rise = (shifted(each, shift + 1) for each in (mean, rise))
    mean, rise, start = (shifted(each, shift) for each in (mean, rise, start))
    waveforms: list[tuple[Waveform, Floats]] = []
    if late:  # the force of the previous substep continues until the delay has passed
        before, until = old_mean + old_rise * (1.0 - 2.0 * late / h), old_mean + old_rise
        jump, bend = mean - rise - until, 2.0 * (rise - old_rise) / h
        waveforms = [((Term(late, 0.0, 1.0),), jump), ((Term(late, 0.0, 1.0, 1),), bend)]
        mean, rise, start = before + old_rise, old_rise, before
    lag = actuator.time_constant
    if lag == 0:
        return mean, rise, start, waveforms
    # y + T y' = u: the particular solution of each part of u, and an exponential
    slope = 2.0 * rise / h
    settled, fade = mean - rise - lag * slope, np.exp(-h / lag)
    new = settled * (1.0 - fade) + 2.0 * rise
    if late:
        remaining, decay = h - late, np.exp(-(h - late) / lag)
        new = new + jump * (1.0 - decay) + bend * (remaining - lag * (1.0 - decay))
        waveforms = [
            ((Term(late, 0.0, 1.0), Term(late, 1.0 / lag, -1.0)), jump),
            ((Term(late, 0.0, 1.0, 1), Term(late, 0.0, -lag), Term(late, 1.0 / lag, lag)), bend),
        ]
    acting = np.r_[0.0, lfilter([1.0], [1.0, -fade], new)[:-1]]
    waveforms.append(((Term(0.0, 1.0 / lag, 1.0),), acting - settled))
    return mean - lag * slope, rise, acting, waveforms


def sinusoid_on_substeps(
    element: PeriodicForce, n_samples: int, sample_time: float, substeps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Starts and ends (n_samples * substeps,) of a sinusoid's linear replacement, and its values (n_samples,)."""
    omega, h = 2 * np.pi * element.frequency_hz, sample_time / substeps
    edges = omega * h * np.arange(n_samples * substeps + 1) + element.phase
    middle, half = 0.5 * (edges[:-1] + edges[1:]), 0.5 * omega * h
    mean = element.amplitude * np.sinc(half / np.pi) * np.sin(middle)
    share = 3.0 * (np.sinc(half / np.pi) - np.cos(half)) / half if half > ALIKE else half
    rise = element.amplitude * share * np.cos(middle)
    return mean - rise, mean + rise, element.amplitude * np.sin(edges[:-1:substeps])
