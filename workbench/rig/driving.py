"""Forces of actuators over the substeps of a sample: straight lines, and what delays and lags leave beside them.

A held force that is late, or fades into what it becomes, is not straight over a substep. The line of the same mean and
first moment stands for it where laws are solved; what it does to each mode beyond that line is known in closed form.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from workbench.arrays import Flags, Floats
from workbench.rig import elements, stepping
from workbench.rig.actuators import Actuator

DRIVES_KEPT, MOST_KEPT = 16, 2**18  # forces on substeps that are remembered, and the most values of one
ROUND_OFF = 1e-9  # of a substep
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


class Fading(NamedTuple):
    """A force that begins within a substep and fades.

    Attributes:
        begins: s, after the start of the substep.
        rate: of its fading, 1/s; 0 for one that stays.
        size: N.
    """

    begins: float
    rate: float
    size: float


Course = tuple[Fading, ...]  # of a force over a substep, the sum of these


def _straightened(course: Course, h: float) -> tuple[float, float]:
    """Mean over a substep, and half the rise of the straight line of the same first moment."""
    mean = moment = 0.0
    for begins, rate, size in course:
        lasts = h - begins
        faded = np.exp(-rate * lasts)
        area = (1.0 - faded) / rate if rate else lasts
        first = (area - lasts * faded) / rate if rate else 0.5 * lasts**2
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
    for begins, rate, size in course:
        lasts, x = h - begins, (poles + rate) * (h - begins)
        near = np.abs(x) < 0.5
        slight = np.where(near & (x != 0), x, 1.0)  # where the difference of two that are all but one says nothing
        grown = np.exp(-rate * lasts) * np.where(x == 0, 1.0, np.expm1(slight) / slight)
        apart = (np.exp(poles * lasts) - np.exp(-rate * lasts)) / np.where(near, 1.0, x)
        response += size * lasts * np.where(near, grown, apart)
    both = np.array([response[0] - response[1], poles[0] * response[0] - poles[1] * response[1]]) / (2.0 * root)
    return np.asarray(both.real - straight[:, 2] * (mean - rise) - straight[:, 3] * (mean + rise))


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
    courses: list[tuple[int, Course]] = []
    sizes = [np.zeros((0, inputs.values.shape[1] * substeps))]
    if input_hold == "zero":
        starts, ends, at_samples, crooked = _forces_on_substeps(actuators, inputs.values, sample_time, substeps)
        for j, course, size in crooked:
            if size.any():
                courses.append((j, course))
                sizes.append(size[None])
    else:
        starts, ends, at_samples = _straight_forces_on_substeps(actuators, inputs.values, sample_time, substeps)
    driven = np.logical_or(starts.any(axis=1), ends.any(axis=1))
    return Drives(driven, starts[driven], ends[driven], at_samples, tuple(courses), np.concatenate(sizes))


def _forces_on_substeps(
    actuators: tuple[Actuator, ...], inputs: np.ndarray, sample_time: float, substeps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[tuple[int, Course, np.ndarray]]]:
    """What runs straight over each substep as each actuator's force does, start and end, and the force at each sample.

    It has the mean and the first moment of the force over the substep. What a delayed or lagged force does beyond that
    is the last: the actuator, what the force does per unit, and its size in each substep.
    """
    fine = np.empty((inputs.shape[0], inputs.shape[1] * substeps))
    rise = np.zeros_like(fine)  # half of it, over a substep
    now = np.empty_like(inputs)
    crooked = []
    h = sample_time / substeps
    for j, actuator in enumerate(actuators):
        held = np.repeat(actuator_force(actuator, inputs[j]), substeps)
        start = held
        if np.isfinite(actuator.rate_limit):
            held, start = stepping.ramped(held, actuator.rate_limit * h)
            if actuator.delay == 0 and actuator.time_constant == 0:
                change = np.diff(np.r_[start, 2.0 * held[-1] - start[-1]])
                share = np.minimum(np.abs(change) / (actuator.rate_limit * h), 1.0)  # until the ramp ends
                rise[j] = change * share * (1.5 - share)
        if actuator.delay or actuator.time_constant:
            held, start, courses = _delayed_and_lagged(held, start, actuator, h)
            for course, size in courses:
                mean, half = _straightened(course, h)
                held = held + mean * size
                rise[j] += half * size
                crooked.append((j, course, size))
        fine[j] = held + actuator.bias
        now[j] = start[::substeps] + actuator.bias
    return fine - rise, fine + rise, now, crooked


def _straight_forces_on_substeps(
    actuators: tuple[Actuator, ...], inputs: np.ndarray, sample_time: float, substeps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of inputs that run straight from sample to sample; after the last it stays."""
    h, n = sample_time / substeps, inputs.shape[1]
    time = h * np.arange(n * substeps + 1)
    edges = np.empty((inputs.shape[0], time.size))
    for j, actuator in enumerate(actuators):
        force = np.interp(time, sample_time * np.arange(n), actuator_force(actuator, inputs[j]))
        if np.isfinite(actuator.rate_limit):
            _, start = stepping.ramped(np.r_[force[1:], force[-1]], actuator.rate_limit * h)
            force = start
        if actuator.delay:
            force = np.interp(time - actuator.delay, time, force, left=0.0)
        if actuator.time_constant:
            force = lagged(force, actuator.time_constant, h, settled=False)
        edges[j] = force + actuator.bias
    return edges[:, :-1], edges[:, 1:], edges[:, :-1:substeps]


def _delayed_and_lagged(
    held: np.ndarray, at_start: np.ndarray, actuator: Actuator, h: float
) -> tuple[np.ndarray, np.ndarray, list[tuple[Course, np.ndarray]]]:
    """Forces held over substeps, and at their starts, as delay and lag leave them.

    Returns:
        What is held over each substep; the force at its start; and courses per unit beside what is held, with sizes.
    """
    shift = int(actuator.delay / h + ROUND_OFF)
    late = actuator.delay - shift * h if actuator.delay > (shift + ROUND_OFF) * h else 0.0
    older, newer = shifted(held, shift)
    change, lag = newer - older, actuator.time_constant
    if lag == 0:
        start = shifted(at_start, shift)
        return (older, start[0], [((Fading(late, 0.0, 1.0),), change)]) if late else (newer, start[1], [])
    came, fade = np.exp(-(h - late) / lag), np.exp(-h / lag)
    new = (1.0 - came) * newer + (came - fade) * older
    acting = np.r_[0.0, lfilter([1.0], [1.0, -fade], new)[:-1]]
    comes, goes = (Fading(late, 0.0, 1.0), Fading(late, 1.0 / lag, -1.0)), (Fading(0.0, 1.0 / lag, 1.0),)
    return older, acting, [(comes, change), (goes, acting - older)]


def shifted(values: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Values one step more than so many steps later, and so many steps later; zero before the first."""
    padded = np.r_[np.zeros(steps + 1), values][: values.size + 1]
    return padded[:-1], padded[1:]


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


def lagged(truth: np.ndarray, time_constant: float, sample_time: float, *, settled: bool = True) -> np.ndarray:
    """A first-order lag of a signal that is linear between samples, settled at its first value, or at zero."""
    ratio = sample_time / time_constant
    fade = np.exp(-ratio)
    new = 1.0 - (1.0 - fade) / ratio
    old = (1.0 - fade) / ratio - fade
    first = truth[0] if settled else 0.0
    return np.asarray(lfilter([new, old], [1.0, -fade], truth, zi=[first - new * truth[0]])[0])
