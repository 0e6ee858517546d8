"""Motion between the samples, by exact modes: what a sensor that is late reads."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from workbench.arrays import Floats
from workbench.rig.stepping import propagators

SETTLED = 1e-6  # of the largest eigenvalue: directions of force that hardly move a mode over a sample are left alone


@dataclass(frozen=True, eq=False)
class Step:
    """A change of the forces on the modes within every sample interval.

    Attributes:
        late: s after the sample at which it begins.
        time_constant: s, of the first-order lag by which it comes about; 0 at once.
        forces: (n_modes, n_samples) by which they change.
    """

    late: float
    time_constant: float
    forces: Floats

    def answer(self, omega: Floats, damping: Floats, time: float) -> Floats:
        """(3, n_modes): q, q' and q'' that a step of one has brought about a time after the sample."""
        span = time - self.late
        motion = _propagators(omega, damping, span)
        answer, force = motion[:, 2:].sum(axis=1), 1.0
        if self.time_constant:
            # what has not come about yet, exp(-t / T), is answered by a motion like it, which goes free at the start
            fade, rate = np.exp(-span / self.time_constant), 1.0 / self.time_constant
            like = 1.0 / (rate**2 - damping * rate + omega**2)
            free = motion[:, 0] * like - motion[:, 1] * rate * like
            answer = answer - (np.array([[1.0], [-rate]]) * like * fade - free)
            force -= fade
        return np.vstack([answer, force - omega**2 * answer[0] - damping * answer[1]])


@dataclass(frozen=True, eq=False)
class BetweenSamples:
    """Modal motion at any time: in each sample interval every mode moves exactly under a force linear in time.

    q'' + c q' + ω² q = p_0 + (p_1 - p_0) t / Δt in [0, Δt] and steps of force within it that are known, p_0 and p_1
    such that q and q' come out at both ends as they are. So it is exact for inputs held over each sample, delayed or
    lagged too, and of second order for forces that follow laws. p_0 and p_1 are linear in the motion at both ends, so a
    reading at any time is a weighted sum of that. An acceleration has the forces at both ends as they are, straight
    between, in their place: of a force that turns within the interval these tell its mean alone. Beside laws, an
    accelerometer therefore reads a motion of more samples (`Motion.finely`).

    Attributes:
        omega, damping: (n_modes,) of each mode alone.
        series: (3 n_modes, n_samples) displacements, velocities, and forces beside those of stiffness and damping.
        arrivals: (2 n_modes, n_samples - 1) displacements and velocities where each interval ends, less what steps of
            force within it bring about.
        changes: (n_modes, n_samples) of the forces over each interval, but for the jumps of those that are held; None
            where all are.
        steps: of the forces within each interval.
        ends: (2, 5, n_modes) p_0 and p_1, of displacement, velocity and force where an interval begins, displacement
            and velocity where it ends.
        sample_time: s.
        rests: whether the motion begins at rest.
    """

    omega: Floats
    damping: Floats
    series: Floats
    arrivals: Floats
    changes: Floats | None
    steps: tuple[Step, ...]
    ends: Floats
    sample_time: float
    rests: bool

    @classmethod
    def of(
        cls,
        displacement: Floats,
        velocity: Floats,
        forces: Floats,
        stiffness: Floats,
        damping: Floats,
        sample_time: float,
        *,
        steps: tuple[Step, ...] = (),
        held: Floats | float = 0.0,
    ) -> "BetweenSamples":
        """From displacements, velocities and forces (n_modes, n_samples) at the samples.

        Args:
            stiffness: (n_modes, 1) or (n_modes, n_samples).
            damping: (n_modes, n_modes).
            steps: by which they change within each interval.
            held: (n_modes, n_samples) of the forces, what stays as it is from sample to sample but for these.
        """
        omega, own = np.sqrt(stiffness.mean(axis=1)), np.diag(damping).copy()
        # what a mode alone does not have counts as a force
        beside, coupled = forces, damping - np.diag(own)
        if stiffness.shape[1] > 1:
            beside = beside - (stiffness - omega[:, None] ** 2) * displacement
        if coupled.any():
            beside = beside - coupled @ velocity
        changes: Floats | None = None
        if beside is not held:
            changes = np.diff(beside - held, axis=1, append=0.0)
            changes[:, -1] = 0.0  # after the last sample its force is held
        if changes is None or not changes.any():
            changes, ends = None, _held(omega.size)
        else:
            ends = _ends(omega, own, sample_time)
        rests = not (displacement[:, 0].any() or velocity[:, 0].any())
        series = np.concatenate([displacement, velocity, beside])
        arrivals = series[: 2 * omega.size, 1:]
        for step in steps:
            added = step.answer(omega, own, sample_time)
            arrivals = arrivals - np.concatenate([row[:, None] * step.forces[:, :-1] for row in added[:2]])
        return cls(omega, own, series, arrivals, changes, steps, ends, sample_time, rests)

    def earlier(self, order: int, shapes: Floats, delays: Floats) -> Floats:
        """What each sensor reads its delay before each sample, (n_sensors, n_samples), zero before a start at rest.

        Args:
            order: 0 for displacement, 1 for velocity, 2 for acceleration.
            shapes: (n_sensors, n_modes) at the sensors.
            delays: (n_sensors,) s; negative for what is read ahead.
        """
        whole, within = _intervals(tuple(delays.tolist()), self.sample_time)
        read = self._read(order, shapes, within)
        for step in self.steps:
            for j in (j for j, time in enumerate(within) if time > step.late):
                answer = step.answer(self.omega, self.damping, within[j])
                read[j] += (shapes[j] * answer[order]) @ step.forces
        n_samples = read.shape[1]
        found = np.zeros_like(read)
        for j, n in enumerate(whole):
            ahead = max(-n, 0)
            found[j, max(n, 0) : n_samples - ahead] = read[j, ahead : max(n_samples - n, 0)]
            for k in range(ahead):  # beyond the last sample its force is held
                time = within[j] + self.sample_time * (k + 1)
                found[j, k - ahead] = self._read(order, shapes[j : j + 1], [time], slice(-1, None))[0, 0]
            for k in range(0 if self.rests else min(n, n_samples)):  # the first interval drawn on backwards
                time = within[j] + self.sample_time * (k - n)
                found[j, k] = self._read(order, shapes[j : j + 1], [time], slice(0, 2))[0, 0]
        return found

    def _read(self, order: int, shapes: Floats, times: Sequence[float], samples: slice = slice(None)) -> Floats:
        """Readings (n_sensors, n_samples) in each interval, each sensor at its own time after the interval begins."""
        n_modes, series, arrivals = self.omega.size, self.series[:, samples], self.arrivals[:, samples]
        rows = np.array([self._rows(order, time) for time in times])

        def weights(ends: Floats) -> Floats:
            by_motion = np.einsum("jfm,fsm->jsm", rows[:, 2:], ends)
            by_motion[:, :2] += rows[:, :2]
            each: Floats = shapes[:, None] * by_motion
            return each.reshape(len(shapes), -1)

        by_motion = weights(self.ends)
        read: Floats = by_motion[:, : 3 * n_modes] @ series
        if self.changes is not None:  # forces that are held lead to the motion where the interval ends by themselves
            read[:, :-1] += by_motion[:, 3 * n_modes :] @ arrivals[:, : series.shape[1] - 1]
            # after the last sample its force is held
            read[:, -1] = weights(_held(n_modes))[:, : 3 * n_modes] @ series[:, -1]
        if order == 2:
            shares = np.array(times)[:, None] / self.sample_time
            read += shapes @ series[2 * n_modes :]
            if self.changes is not None:
                read += shares * (shapes @ self.changes[:, samples])
        return read

    def _rows(self, order: int, time: float) -> Floats:
        """(4, n_modes): what is read at a time after the beginning of an interval, of q, q', p_0 and p_1.

        Of an acceleration without the forces themselves.
        """
        motion = _propagators(self.omega, self.damping, self.sample_time, time)
        return np.asarray(motion[order] if order < 2 else -(self.omega**2) * motion[0] - self.damping * motion[1])


@lru_cache(maxsize=64)
def _intervals(delays: tuple[float, ...], sample_time: float) -> tuple[list[int], list[float]]:
    """How many samples before each its interval begins that holds what is read, and the times within it, s."""
    back = [delay / sample_time for delay in delays]
    whole = [int(np.ceil(round(samples, 9))) for samples in back]
    # a span of next to nothing would be divided by
    return whole, [sample_time * round(n - samples, 9) for n, samples in zip(whole, back, strict=True)]


def _held(n_modes: int) -> Floats:
    """`ends` of forces that stay as they are where the interval begins."""
    ends = np.zeros((2, 5, n_modes))
    ends[:, 2] = 1.0
    return ends


def _ends(omega: Floats, damping: Floats, sample_time: float) -> Floats:
    """`ends` of forces that lead to the motion where the interval ends, as near to those where it begins as can be."""
    return _known_ends(omega.tobytes(), damping.tobytes(), sample_time)


@lru_cache(maxsize=64)
def _known_ends(frequencies: bytes, dampings: bytes, sample_time: float) -> Floats:
    omega, damping = np.frombuffer(frequencies), np.frombuffer(dampings)
    step = _propagators(omega, damping, sample_time)
    weight = np.array([1.0, sample_time])[:, None, None]
    by_force = np.moveaxis(weight * step[:, 2:], 2, 0)  # (n_modes, 2 motions, 2 forces)
    gram = by_force @ np.swapaxes(by_force, 1, 2)
    gram += SETTLED * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2)
    change = np.swapaxes(by_force, 1, 2) @ np.linalg.solve(gram, np.eye(2) * weight[:, 0])  # of forces, by motion
    missing = np.zeros((2, 5, omega.size))  # what the forces where it begins do not lead to
    missing[:, :2], missing[:, 2] = -step[:, :2], -(step[:, 2] + step[:, 3])
    missing[0, 3] = missing[1, 4] = 1.0
    ends: Floats = np.einsum("mfd,dsm->fsm", change, missing)
    ends[:, 2] += 1.0
    ends.flags.writeable = False
    return ends


def _propagators(omega: Floats, damping: Floats, span: float, time: float | None = None) -> Floats:
    """(2, 4, n_modes): q and q' at `time`, of q, q', p_0 and p_1 at the start of a span, the force linear over it."""
    return _remembered(omega.tobytes(), damping.tobytes(), span, span if time is None else time)


@lru_cache(maxsize=256)  # records of one rig, and sensors that are as late, ask for the same
def _remembered(frequencies: bytes, dampings: bytes, span: float, time: float) -> Floats:
    omega, damping = np.frombuffer(frequencies).copy(), np.frombuffer(dampings).copy()
    out = np.zeros((2, 4, omega.size))
    if time == 0:
        out[0, 0] = out[1, 1] = 1.0
    else:
        propagators(omega, damping, time, out)
        # the force at that time is a share of the way from p_0 to p_1
        share = time / span
        out[:, 2] += (1.0 - share) * out[:, 3]
        out[:, 3] *= share
    out.flags.writeable = False
    return out
