"""Forces of actuators over the substeps of a sample: straight lines, and what delays and lags leave beside them.

A held force that is late, or fades into what it becomes, is not straight over a substep. The line of the same mean and
first moment stands for it where laws are solved; what it does to each mode beyond that line is known in closed form.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import factorial
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from workbench.arrays import Complexes, Flags, Floats
from workbench.records.band_limited import finer
from workbench.rig import elements, stepping
from workbench.rig.actuators import Actuator
from workbench.rig.linear import shifted, whole_samples

DRIVES_KEPT, MOST_KEPT = 16, 2**18  # forces on substeps that are remembered, and the most values of one
ROUND_OFF = 1e-9  # of the largest force
ALIKE = 1e-5  # over a substep: nearer, the two poles of a mode are taken for as far apart


def actuator_force(actuator: Actuator, command: np.ndarray) -> np.ndarray:
    """The force that an actuator heads for: hysteresis, gain, dead zone, saturation, before what takes its time."""
    if actuator.hysteresis_share:
        share = actuator.hysteresis_share
        followed = stepping.hysteresis(np.r_[0.0, command], actuator.hysteresis_width)[1:]
        command = (1.0 - share) * command + share * followed
    force = command if actuator.gain == 1 else actuator.gain * command
    if actuator.dead_zone > 0:
        force = np.sign(force) * np.maximum(np.abs(force) - actuator.dead_zone, 0.0)
    if np.isfinite(actuator.limit):
        force = np.clip(force, -actuator.limit, actuator.limit)
    return force


class Piece(NamedTuple):
    """A force size t^power e^(-rate t) from a time t = 0 within a substep on.

    Attributes:
        begins: s, after the start of the substep.
        rate: 1/s; 0 for one that does not fade.
        size: N, or N/s.
        power: 0, or 1 for one that rises, which does not fade.
    """

    begins: float
    rate: float
    size: float
    power: int = 0


Course = tuple[Piece, ...]  # of a force over a substep, the sum of these


def _straightened(course: Course, h: float) -> tuple[float, float]:
    """Mean over a substep, and half the rise of the straight line of the same first moment."""
    mean = moment = 0.0
    for begins, rate, size, power in course:
        lasts = h - begins
        area, first = lasts ** (power + 1) / (power + 1), lasts ** (power + 2) / (power + 2)
        if rate:
            faded = np.exp(-rate * lasts)
            area = (1.0 - faded) / rate
            first = (area - lasts * faded) / rate
        mean += size * area / h
        moment += size * (first + (begins - 0.5 * h) * area) / h**2
    return mean, 6.0 * moment


def beyond_straight(course: Course, omega: Floats, damping: Floats, h: float) -> Floats:
    """What a course does to q and q' of each mode by the end of a substep, (2, n_modes), beyond its straight line."""
    straight = np.empty((2, 4, omega.size))
    stepping.propagators(omega, damping, h, straight)
    root = np.sqrt((0.5 * damping) ** 2 - omega**2 + 0j)
    root[np.abs(root) * h < ALIKE] = ALIKE / h
    poles = -0.5 * damping + np.array([1.0, -1.0])[:, None] * root
    mean, rise = _straightened(course, h)
    response = np.zeros_like(poles)
    for begins, rate, size, power in course:
        lasts = h - begins
        response += size * lasts ** (power + 1) * _grown(poles * lasts, rate * lasts, power)
    both = np.array([response[0] - response[1], poles[0] * response[0] - poles[1] * response[1]]) / (2.0 * root)
    return np.asarray(both.real - straight[:, 2] * (mean - rise) - straight[:, 3] * (mean + rise))


def _grown(pole: Complexes, rate: float, power: int) -> Complexes:
    """∫ t^power e^(-rate t) e^(pole (1 - t)) dt from 0 to 1; of a power the rate is 0."""
    x = pole + rate
    near = np.abs(x) < 0.5  # where the difference of what is all but alike says nothing, by its series
    series = np.exp(-rate) * sum(np.where(near, x, 0.0) ** k / factorial(k + power + 1) for k in range(16))
    x = np.where(near, 1.0, x)
    return np.where(near, series, (np.exp(pole) - 1.0 - pole) / x**2 if power else (np.exp(pole) - np.exp(-rate)) / x)


@dataclass(frozen=True, eq=False)
class Drives:
    """Forces of the actuators on substeps.

    Attributes:
        driven: (n_actuators,) which of them are ever at work.
        starts, ends: (n_driven, n_samples * substeps) of what runs straight over each substep as their forces do.
        at_samples: (n_actuators, n_samples) all forces.
        courses: (actuator, course) of what is not straight in them, delayed or lagged.
        sizes: (n_courses, n_samples * substeps) of these in each substep.
    """

    driven: Flags
    starts: Floats
    ends: Floats
    at_samples: Floats
    courses: tuple[tuple[int, Course], ...]
    sizes: Floats


class _Signals:
    """Signals that never change, as a key: the array itself, not its values."""

    def __init__(self, values: Floats) -> None:
        self.values = values

    def __hash__(self) -> int:
        return id(self.values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Signals) and self.values is other.values


def drives(
    actuators: tuple[Actuator, ...], inputs: Floats, sample_time: float, substeps: int, input_hold: str
) -> Drives:
    """Remembered for the inputs of a record, which nobody can write to: structure and sensors change more often."""
    is_lasting = inputs.base is None and not inputs.flags.writeable
    known = _known_drives if is_lasting and inputs.size * substeps <= MOST_KEPT else _known_drives.__wrapped__
    return known(actuators, _Signals(inputs), sample_time, substeps, input_hold)


@lru_cache(maxsize=DRIVES_KEPT)
def _known_drives(
    actuators: tuple[Actuator, ...], inputs: _Signals, sample_time: float, substeps: int, input_hold: str
) -> Drives:
    lines, at_samples, crooked = _forces_on_substeps(actuators, inputs.values, sample_time, substeps, input_hold)
    (starts, ends), h = lines, sample_time / substeps
    driven = np.logical_or(starts.any(axis=1), ends.any(axis=1))
    least = ROUND_OFF * max(np.abs(starts).max(initial=0.0), np.abs(ends).max(initial=0.0))
    crooked = [
        (j, course, size) for j, course, size in crooked if np.abs(size).max(initial=0.0) * h ** course[0].power > least
    ]
    sizes = np.array([size for *_, size in crooked]).reshape(len(crooked), starts.shape[1])
    courses = tuple((j, course) for j, course, _ in crooked)
    return Drives(driven, starts[driven], ends[driven], at_samples, courses, sizes)


def _forces_on_substeps(
    actuators: tuple[Actuator, ...], inputs: Floats, sample_time: float, substeps: int, input_hold: str
) -> tuple[tuple[Floats, Floats], Floats, list[tuple[int, Course, Floats]]]:
    """What runs straight over each substep as each actuator's force does, start and end, and the force at each sample.

    It has the mean and the first moment of the force over the substep. What a delayed or lagged force does beyond that
    is the last: the actuator, what the force does per unit, and its size in each substep.
    """
    mean = np.empty((inputs.shape[0], inputs.shape[1] * substeps))
    rise = np.zeros_like(mean)  # half of it, over a substep
    now = np.empty_like(inputs)
    crooked = []
    h = sample_time / substeps
    for j, actuator in enumerate(actuators):
        given = finer(inputs[j : j + 1], substeps)[0] if input_hold == "band-limited" else inputs[j]
        force = actuator_force(actuator, given)
        if input_hold == "zero":
            mean[j] = start = np.repeat(force, substeps)
            if np.isfinite(actuator.rate_limit):
                most = actuator.rate_limit * h
                mean[j], start = stepping.ramped(start, most)
                change = np.diff(np.r_[start, 2.0 * mean[j, -1] - start[-1]])
                share = np.minimum(np.abs(change) / most, 1.0)  # of the substep, until the ramp ends
                rise[j] = change * share * (1.5 - share)
        else:  # straight from sample to sample, or from substep to substep; after the last it stays
            every = mean.shape[1] // force.size
            edges = np.interp(np.arange(mean.shape[1] + 1), every * np.arange(force.size), force)
            if np.isfinite(actuator.rate_limit):
                _, edges = stepping.ramped(np.r_[edges[1:], edges[-1]], actuator.rate_limit * h)
            start = edges[:-1]
            mean[j], rise[j] = 0.5 * (start + edges[1:]), 0.5 * np.diff(edges)
        if actuator.delay or actuator.time_constant:
            mean[j], rise[j], start, courses = _delayed_and_lagged(mean[j], rise[j], start, actuator, h)
            for course, size in courses:
                straight, half = _straightened(course, h)
                mean[j] += straight * size
                rise[j] += half * size
                crooked.append((j, course, size))
        mean[j] += actuator.bias
        now[j] = start[::substeps] + actuator.bias
    return (mean - rise, mean + rise), now, crooked


def _delayed_and_lagged(
    mean: Floats, rise: Floats, start: Floats, actuator: Actuator, h: float
) -> tuple[Floats, Floats, Floats, list[tuple[Course, Floats]]]:
    """Forces that are straight over substeps, as delay and lag leave them.

    Args:
        mean, rise: of each substep, half the rise.
        start: force at the start of each, where a ramp that ends within it is not straight.

    Returns:
        Mean and half the rise of what is straight; the force at each start; and courses per unit beside it, with sizes.
    """
    shift, late = whole_samples(actuator.delay, h)
    old_mean, old_rise = (shifted(each, shift + 1) for each in (mean, rise))
    mean, rise, start = (shifted(each, shift) for each in (mean, rise, start))
    courses: list[tuple[Course, Floats]] = []
    if late:  # the substep before goes on until then
        before, until = old_mean + old_rise * (1.0 - 2.0 * late / h), old_mean + old_rise
        jump, bend = mean - rise - until, 2.0 * (rise - old_rise) / h
        courses = [((Piece(late, 0.0, 1.0),), jump), ((Piece(late, 0.0, 1.0, 1),), bend)]
        mean, rise, start = before + old_rise, old_rise, before
    lag = actuator.time_constant
    if lag == 0:
        return mean, rise, start, courses
    # y + T y' = u: each part of u settles, and what it lags by fades
    slope = 2.0 * rise / h
    settled, fade = mean - rise - lag * slope, np.exp(-h / lag)
    new = settled * (1.0 - fade) + 2.0 * rise
    if late:
        left, came = h - late, np.exp(-(h - late) / lag)
        new = new + jump * (1.0 - came) + bend * (left - lag * (1.0 - came))
        courses = [
            ((Piece(late, 0.0, 1.0), Piece(late, 1.0 / lag, -1.0)), jump),
            ((Piece(late, 0.0, 1.0, 1), Piece(late, 0.0, -lag), Piece(late, 1.0 / lag, lag)), bend),
        ]
    acting = np.r_[0.0, lfilter([1.0], [1.0, -fade], new)[:-1]]
    courses.append(((Piece(0.0, 1.0 / lag, 1.0),), acting - settled))
    return mean - lag * slope, rise, acting, courses


def sinusoid_on_substeps(
    element: elements.PeriodicForce, n_samples: int, sample_time: float, substeps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start and end of what runs straight over each substep, of the same mean and first moment, and at the samples."""
    omega, h = 2 * np.pi * element.frequency_hz, sample_time / substeps
    edges = omega * h * np.arange(n_samples * substeps + 1) + element.phase
    middle, half = 0.5 * (edges[:-1] + edges[1:]), 0.5 * omega * h
    mean = element.amplitude * np.sinc(half / np.pi) * np.sin(middle)
    share = 3.0 * (np.sinc(half / np.pi) - np.cos(half)) / half if half > ALIKE else half
    rise = element.amplitude * share * np.cos(middle)
    return mean - rise, mean + rise, element.amplitude * np.sin(edges[:-1:substeps])
