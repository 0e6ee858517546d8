"""Motion between the samples, by exact modes: what a sensor that is late reads."""

from dataclasses import dataclass

import numpy as np

from workbench.rig.stepping import propagators

SETTLED = 1e-6  # of the largest eigenvalue: directions of force that hardly move a mode over a sample are left alone


@dataclass(frozen=True, eq=False)
class BetweenSamples:
    """Modal motion at any time: in each sample interval every mode moves exactly under a force linear in time.

    q'' + c q' + ω² q = p_0 + (p_1 - p_0) t / Δt in [0, Δt], p_0 and p_1 such that q and q' come out at both ends as
    they are. So it is exact for inputs held over each sample, and of second order for forces that follow laws.

    Attributes:
        omega, damping: (n_modes,) of each mode alone.
        start: (2, n_modes, n_intervals) displacement and velocity where each interval begins; the last one begins with
            the last sample.
        forces: (2, n_modes, n_intervals) p_0 and p_1.
        sample_time: s.
        rests: whether the motion begins at rest.
    """

    omega: np.ndarray
    damping: np.ndarray
    start: np.ndarray
    forces: np.ndarray
    sample_time: float
    rests: bool

    @classmethod
    def of(
        cls,
        displacement: np.ndarray,
        velocity: np.ndarray,
        forces: np.ndarray,
        stiffness: np.ndarray,
        damping: np.ndarray,
        sample_time: float,
        *,
        held: bool = False,
    ) -> "BetweenSamples":
        """From displacements, velocities and forces (n_modes, n_samples) at the samples.

        Args:
            stiffness: (n_modes, 1) or (n_modes, n_samples).
            damping: (n_modes, n_modes).
            held: whether the forces stay as they are from sample to sample; then they are exact as they are.
        """
        omega, own = np.sqrt(stiffness.mean(axis=1)), np.diag(damping).copy()
        # what a mode alone does not have counts as a force
        beside = forces - (stiffness - omega[:, None] ** 2) * displacement - (damping - np.diag(own)) @ velocity
        start = np.stack([displacement, velocity])
        if held:
            return cls(omega, own, start, np.stack([beside] * 2), sample_time, not start[:, :, 0].any())
        step = _propagators(omega, own, sample_time)
        free = step[:, 0, :, None] * displacement[:, :-1] + step[:, 1, :, None] * velocity[:, :-1]
        moved = np.stack([displacement[:, 1:], velocity[:, 1:]])
        missing = moved - free - (step[:, 2] + step[:, 3])[:, :, None] * beside[:, :-1]
        weight = np.array([1.0, sample_time])[:, None, None]
        by_force = np.moveaxis(weight * step[:, 2:], 2, 0)  # (n_modes, 2 motions, 2 forces)
        gram = by_force @ np.swapaxes(by_force, 1, 2)
        gram += SETTLED * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2)
        change = np.swapaxes(by_force, 1, 2) @ np.linalg.solve(gram, np.moveaxis(weight * missing, 1, 0))
        ends = np.moveaxis(change, 1, 0) + beside[:, :-1]
        # after the last sample its force is held
        ends = np.concatenate([ends, np.stack([beside[:, -1:]] * 2)], axis=2)
        return cls(omega, own, start, ends, sample_time, not start[:, :, 0].any())

    def earlier(self, order: int, shape: np.ndarray, delay: float) -> np.ndarray:
        """What `shape` (n_modes,) reads `delay` seconds before each sample, (n_samples,), zero before a start at rest.

        Args:
            order: 0 for displacement, 1 for velocity, 2 for acceleration.
            delay: s; negative, by less than a sample, for what is read ahead.
        """
        n_intervals = self.start.shape[2]
        back = delay / self.sample_time
        whole = int(np.ceil(round(back, 9)))
        ahead = round(whole - back, 9)  # a span of next to nothing would be divided by
        within = self.sample_time * ahead
        interval = np.arange(n_intervals) - whole
        read = self._at(order, shape, within)[np.clip(interval, 0, n_intervals - 1)]
        early = np.flatnonzero(interval < 0)
        for k in early:  # before the record: at rest, or by the first interval drawn on backwards
            back_there = within + self.sample_time * interval[k]
            read[k] = 0.0 if self.rests else self._at(order, shape, back_there, slice(0, 1))[0]
        return read

    def _at(self, order: int, shape: np.ndarray, time: float, intervals: slice = slice(None)) -> np.ndarray:
        """What is read at a time after the beginning of each interval, (n_intervals,)."""
        motion = _propagators(self.omega, self.damping, self.sample_time, time)
        if order == 2:
            share = time / self.sample_time
            n_modes = self.omega.size
            force = np.stack(
                [np.zeros(n_modes), np.zeros(n_modes), np.full(n_modes, 1.0 - share), np.full(n_modes, share)]
            )
            rows = force - self.omega**2 * motion[0] - self.damping * motion[1]
        else:
            rows = motion[order]
        sources = (*self.start, *self.forces)
        parts = [(shape * row) @ source[:, intervals] for row, source in zip(rows, sources, strict=True)]
        return np.asarray(np.sum(parts, axis=0))


def _propagators(omega: np.ndarray, damping: np.ndarray, span: float, time: float | None = None) -> np.ndarray:
    """(2, 4, n_modes): q and q' at `time`, of q, q', p_0 and p_1 at the start of a span, the force linear over it."""
    time = span if time is None else time
    out = np.zeros((2, 4, omega.size))
    if time == 0:
        out[0, 0] = out[1, 1] = 1.0
        return out
    propagators(omega, damping, time, out)
    # the force at that time is a share of the way from p_0 to p_1
    share = time / span
    out[:, 2] += (1.0 - share) * out[:, 3]
    out[:, 3] *= share
    return out
