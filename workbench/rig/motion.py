"""Modal motion of a rig at the samples and, for the readings of delayed sensors, between them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from workbench.arrays import Floats
from workbench.rig.linear import propagators

SETTLED = 1e-6  # of the trace: regularisation of forces that hardly move a mode over a sample


@dataclass(frozen=True, eq=False)
class Step:
    """A step of the modal forces within every sample interval, delayed and lagged.

    Attributes:
        late: delay after the sample, s.
        time_constant: of the first-order lag, s; 0 for none.
        forces: (n_modes, n_samples) size of the step.
    """

    late: float
    time_constant: float
    forces: Floats

    def response(self, omega: Floats, damping: Floats, time: float) -> Floats:
        """(3, n_modes): q, q' and q'' at a time after the sample, by a unit step of the modal force."""
        span = time - self.late
        motion = _propagators(omega, damping, span)
        response, force = motion[:, 2:].sum(axis=1), 1.0
        if self.time_constant:
            # the lag subtracts exp(-t / T): its particular solution, and a free motion for zero initial conditions
            fade, rate = np.exp(-span / self.time_constant), 1.0 / self.time_constant
            particular = 1.0 / (rate**2 - damping * rate + omega**2)
            free = motion[:, 0] * particular - motion[:, 1] * rate * particular
            response = response - (np.array([[1.0], [-rate]]) * particular * fade - free)
            force -= fade
        return np.vstack([response, force - omega**2 * response[0] - damping * response[1]])


@dataclass(frozen=True, eq=False)
class Motion:
    """Modal motion of a rig at the sample instants.

    Attributes:
        displacement, velocity: (n_modes, n_samples) of the modal coordinates.
        forces: (n_modes, n_samples) modal forces without those of stiffness and damping.
        stiffness: (n_modes, 1) of each mode, or (n_modes, n_samples) where it changes.
        damping: (n_modes, n_modes).
        sample_time: s.
        steps: of the forces within each interval.
        held: (n_modes, n_samples) the part of the forces that is constant over each interval but for the steps.
        finer: function that recomputes the motion with more samples, where forces change within an interval in another
            way; None where not needed.
        delayed: function of a delay, s, that recomputes the motion so much later, at the same instants; None where
            there is none.
    """

    displacement: Floats
    velocity: Floats
    forces: Floats
    stiffness: Floats
    damping: Floats
    sample_time: float
    steps: tuple[Step, ...] = ()
    held: Floats | float = 0.0
    finer: "Callable[[], Motion] | None" = None
    delayed: "Callable[[float], Motion] | None" = None

    @cached_property
    def acceleration(self) -> Floats:
        """Modal accelerations (n_modes, n_samples)."""
        return self.forces - self.stiffness * self.displacement - self.damping @ self.velocity

    @cached_property
    def finely(self) -> "Motion":
        """The motion with more samples, by `finer`; itself where that is None."""
        return self if self.finer is None else self.finer()

    @cached_property
    def between_samples(self) -> "BetweenSamples":
        """The motion at any time; cached, as `finely`, since sensors of many delays may read one motion."""
        return BetweenSamples(self)

    def after(self, lead: int) -> "Motion":
        """The motion without its first `lead` samples."""
        if lead == 0:
            return self
        delayed = self.delayed
        return replace(
            self,
            displacement=self.displacement[:, lead:],
            velocity=self.velocity[:, lead:],
            forces=self.forces[:, lead:],
            stiffness=self.stiffness[:, lead:] if self.stiffness.shape[1] > 1 else self.stiffness,
            steps=tuple(replace(step, forces=step.forces[:, lead:]) for step in self.steps),
            held=self.held[:, lead:] if isinstance(self.held, np.ndarray) else self.held,
            finer=None if self.finer is None else lambda: self.finely.after(self.times_finer * lead),
            delayed=None if delayed is None else lambda delay: delayed(delay).after(lead),
        )

    @property
    def times_finer(self) -> int:
        """How many times as many samples `finely` has."""
        return round(self.sample_time / self.finely.sample_time)


class BetweenSamples:
    """Modal motion at any time, by exact propagation of each mode within a sample interval under a linear force.

    In [0, Δt] q'' + c q' + ω² q = p_0 + (p_1 - p_0) t / Δt plus known steps of force, with p_0 and p_1 such that q and
    q' agree with the given motion at both ends. This is exact for inputs held over each sample, also delayed or lagged,
    and of second order for forces of nonlinear laws. p_0 and p_1 are linear in the motion at both ends, so that a
    reading at any time is a weighted sum of the motion. For accelerations the given forces at both ends are
    interpolated instead, since p_0 and p_1 give the mean force alone. With nonlinear laws an accelerometer therefore
    reads a motion of more samples (`Motion.finely`).
    """

    def __init__(self, motion: Motion) -> None:
        q, v, residual = motion.displacement, motion.velocity, motion.forces
        self.sample_time, self.steps = motion.sample_time, motion.steps
        self.omega, self.damping = np.sqrt(motion.stiffness.mean(axis=1)), np.diag(motion.damping).copy()
        self.rests = not (q[:, 0].any() or v[:, 0].any())  # begins at rest
        # coupling by damping and changes of stiffness count as forces
        coupled = motion.damping - np.diag(self.damping)
        if motion.stiffness.shape[1] > 1:
            residual = residual - (motion.stiffness - self.omega[:, None] ** 2) * q
        if coupled.any():
            residual = residual - coupled @ v
        # change of the forces over each interval, (n_modes, n_samples), without held ones; None where all are held
        self.changes: Floats | None = None
        if residual is not motion.held:
            changes = np.diff(residual - motion.held, axis=1, append=0.0)
            changes[:, -1] = 0.0  # the force is held after the last sample
            self.changes = changes if changes.any() else None
        # (2, 5, n_modes) p_0 and p_1 by q, q' and force at the start of an interval, and q and q' at its end
        held = self.changes is None
        self.ends = _held(self.omega.size) if held else _ends(self.omega, self.damping, self.sample_time)
        self.series = np.concatenate([q, v, residual])  # (3 n_modes, n_samples)
        # (2 n_modes, n_samples - 1) q and q' at the end of each interval, without the response to steps within it
        self.arrivals = self.series[: 2 * self.omega.size, 1:]
        for step in self.steps:
            added = step.response(self.omega, self.damping, self.sample_time)
            self.arrivals = self.arrivals - np.concatenate([row[:, None] * step.forces[:, :-1] for row in added[:2]])

    def delayed(self, order: int, shapes: Floats, delays: Floats) -> Floats:
        """Readings (n_sensors, n_samples) after delays (n_sensors,), s, negative ones too; zero before a start at rest.

        They are displacements (order 0), velocities (1) or accelerations (2) at shapes (n_sensors, n_modes).
        """
        in_samples = [delay / self.sample_time for delay in delays]
        # samples back to the start of each one's interval, and time within it, rounded: a tiny one would be a divisor
        whole = [int(np.ceil(round(samples, 9))) for samples in in_samples]
        within = [self.sample_time * round(n - samples, 9) for n, samples in zip(whole, in_samples, strict=True)]
        read = self._read(order, shapes, within)
        for step in self.steps:
            for j in (j for j, time in enumerate(within) if time > step.late):
                response = step.response(self.omega, self.damping, within[j])
                read[j] += (shapes[j] * response[order]) @ step.forces
        n_samples = read.shape[1]
        readings = np.zeros_like(read)
        for j, n in enumerate(whole):
            ahead = max(-n, 0)
            readings[j, max(n, 0) : n_samples - ahead] = read[j, ahead : max(n_samples - n, 0)]
            for k in range(ahead):  # the force is held after the last sample
                time = within[j] + self.sample_time * (k + 1)
                readings[j, k - ahead] = self._read(order, shapes[j : j + 1], [time], slice(-1, None))[0, 0]
            for k in range(0 if self.rests else min(n, n_samples)):  # extrapolation of the first interval
                time = within[j] + self.sample_time * (k - n)
                readings[j, k] = self._read(order, shapes[j : j + 1], [time], slice(0, 2))[0, 0]
        return readings

    def _read(self, order: int, shapes: Floats, times: Sequence[float], samples: slice = slice(None)) -> Floats:
        """Readings (n_sensors, n_samples), each sensor at its own time after the start of each interval."""
        n_modes, series, arrivals = self.omega.size, self.series[:, samples], self.arrivals[:, samples]
        by_time = {time: self._rows(order, time) for time in set(times)}
        rows = np.array([by_time[time] for time in times])

        def weights(ends: Floats) -> Floats:
            by_motion = np.einsum("jfm,fsm->jsm", rows[:, 2:], ends)
            by_motion[:, :2] += rows[:, :2]
            each: Floats = shapes[:, None] * by_motion
            return each.reshape(len(shapes), -1)

        by_motion = weights(self.ends)
        read: Floats = by_motion[:, : 3 * n_modes] @ series
        if self.changes is not None:  # with held forces alone the motion at the end of an interval is not needed
            read[:, :-1] += by_motion[:, 3 * n_modes :] @ arrivals[:, : series.shape[1] - 1]
            # the force is held after the last sample
            read[:, -1] = weights(_held(n_modes))[:, : 3 * n_modes] @ series[:, -1]
        if order == 2:
            shares = np.array(times)[:, None] / self.sample_time
            read += shapes @ series[2 * n_modes :]
            if self.changes is not None:
                read += shares * (shapes @ self.changes[:, samples])
        return read

    def _rows(self, order: int, time: float) -> Floats:
        """Coefficients (4, n_modes) of q, q', p_0 and p_1 in a reading at a time after the start of an interval.

        For an acceleration without the direct term of the forces.
        """
        motion = _propagators(self.omega, self.damping, self.sample_time, time)
        return np.asarray(motion[order] if order < 2 else -(self.omega**2) * motion[0] - self.damping * motion[1])


def _held(n_modes: int) -> Floats:
    """`BetweenSamples.ends` of forces held from the start of the interval."""
    ends = np.zeros((2, 5, n_modes))
    ends[:, 2] = 1.0
    return ends


def _ends(omega: Floats, damping: Floats, sample_time: float) -> Floats:
    """`BetweenSamples.ends` of the forces nearest to that at the start that give the motion at the end."""
    step = _propagators(omega, damping, sample_time)
    weight = np.array([1.0, sample_time])[:, None, None]
    by_force = np.moveaxis(weight * step[:, 2:], 2, 0)  # (n_modes, 2 motions, 2 forces)
    gram = by_force @ np.swapaxes(by_force, 1, 2)
    gram += SETTLED * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2)
    change = np.swapaxes(by_force, 1, 2) @ np.linalg.solve(gram, np.eye(2) * weight[:, 0])  # of forces, by motion
    missing = np.zeros((2, 5, omega.size))  # motion at the end less that under the held force
    missing[:, :2], missing[:, 2] = -step[:, :2], -(step[:, 2] + step[:, 3])
    missing[0, 3] = missing[1, 4] = 1.0
    ends: Floats = np.einsum("mfd,dsm->fsm", change, missing)
    ends[:, 2] += 1.0
    return ends


def _propagators(omega: Floats, damping: Floats, span: float, time: float | None = None) -> Floats:
    """(2, 4, n_modes): q and q' at `time` from q, q', p_0 and p_1, with a force linear over the span."""
    time = span if time is None else time
    out = np.zeros((2, 4, omega.size))
    if time == 0:
        out[0, 0] = out[1, 1] = 1.0
    else:
        propagators(omega, damping, time, out)
        # the force at `time` is interpolated between p_0 and p_1
        share = time / span
        out[:, 2] += (1.0 - share) * out[:, 3]
        out[:, 3] *= share
    return out
