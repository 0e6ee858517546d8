"""What the records say before any effect is guessed: the missing force, its place, and the motion there."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from workbench.gap.missing_force import (
    ForceFilter,
    SampledModel,
    force_filter,
    log_likelihood,
    sampled_model,
    smoothed_states,
)
from workbench.gap.prediction import FitData
from workbench.rig.rig import Rig
from workbench.rig.simulate import Motion


@dataclass(frozen=True, eq=False)
class Place:
    """The missing force at a point and the motion there, one row a record joined end to end.

    Attributes:
        at: m.
        force: (n_total,) N.
        displacement, velocity, acceleration: (n_total,) at x, of the real structure as far as the records tell.
    """

    at: float
    force: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


@dataclass(frozen=True, eq=False)
class Evidence:
    """The residual of a rig on the fit records, and what it says of a missing force.

    Attributes:
        rig: the rig that was simulated.
        data: fit records with their noise.
        motions: its motion, one a record.
        residuals: (n_sensors, n_samples) a record, in the sensors' units.
    """

    rig: Rig
    data: FitData
    motions: tuple[Motion, ...]
    residuals: tuple[np.ndarray, ...]
    n_places: int = field(default=40)

    @classmethod
    def of(cls, rig: Rig, data: FitData, n_places: int = 40) -> "Evidence":
        """Simulate the rig on the fit records."""
        motions = data.motions(rig)
        predictions = data.predictions(rig)
        residuals = tuple(r.outputs - p for r, p in zip(data.counted, predictions, strict=True))
        return cls(rig, data, motions, residuals, n_places)

    @property
    def length(self) -> float:
        return self.rig.modes.length

    @cached_property
    def force_rms(self) -> float:
        """Root mean square of the inputs that are not at rest, N."""
        squares = [row[row != 0] ** 2 for record in self.data.counted for row in record.inputs if np.any(row)]
        return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else 1.0

    @cached_property
    def model(self) -> SampledModel:
        noise = self.data.noise
        return sampled_model(self.rig.modes, self.rig.sensors, noise, self.data.counted[0].sample_time)

    def filter_at(self, x: float, size: float, memory: float) -> ForceFilter:
        """The filter for an unknown force at x of process standard deviation `size`, N."""
        return force_filter(self.model, self.rig.modes.phi(x).T, np.array([size**2]), memory)

    @cached_property
    def places(self) -> np.ndarray:
        """Positions along the structure where a missing force is looked for, m."""
        known = getattr(self.rig.modes.shapes, "places", None)
        if known is not None:
            return np.asarray(known, float)
        return self.length * np.arange(1, self.n_places) / self.n_places

    @cached_property
    def _settings(self) -> tuple[float, float]:
        """Process size and memory of the missing force, by maximum likelihood over a coarse grid."""
        coarse = self.places[::5] if self.places.size > 8 else self.places
        best, settings = -np.inf, (1e-2 * self.force_rms, 0.9)
        quick = self.residuals[: max(2, len(self.residuals) - 2)]
        for memory in (0.0, 0.9, 0.999):
            for share in (1e-3, 1e-2, 1e-1, 1.0):
                size = share * self.force_rms
                likelihood = max(log_likelihood(self.filter_at(x, size, memory), list(quick)) for x in coarse)
                if likelihood > best:
                    best, settings = likelihood, (size, memory)
        return settings

    @cached_property
    def profile(self) -> np.ndarray:
        """Log-likelihood of an unknown force at each of `places`."""
        size, memory = self._settings
        return np.array([log_likelihood(self.filter_at(x, size, memory), list(self.residuals)) for x in self.places])

    @cached_property
    def peaks(self) -> tuple[float, ...]:
        """The most likely places of a missing force, best first, refined between the grid points."""
        profile, places = self.profile, self.places
        if places.size < 5:
            return tuple(places[np.argsort(-profile)])
        padded = np.r_[-np.inf, profile, -np.inf]
        tops = [i for i in range(places.size) if padded[i + 1] >= padded[i] and padded[i + 1] >= padded[i + 2]]
        tops.sort(key=lambda i: -profile[i])
        refined = []
        for i in tops[:3]:
            x = places[i]
            if 0 < i < places.size - 1:
                left, top, right = profile[i - 1 : i + 2]
                bend = left - 2.0 * top + right
                if bend < 0:
                    x += np.clip(0.5 * (left - right) / bend, -1.0, 1.0) * (places[1] - places[0])
            refined.append(float(x))
        return tuple(refined)

    @cached_property
    def at_peaks(self) -> tuple[Place, ...]:
        """The missing force and the motion at the three likeliest places."""
        return tuple(self.place(x) for x in self.peaks)

    def place(self, x: float) -> Place:
        """The missing force at x and the motion there, smoothed."""
        size, memory = self._settings
        kalman = self.filter_at(x, size, memory)
        n, shape = self.rig.modes.n_modes, self.rig.modes.phi(x)[0]
        pieces = []
        for motion, residual in zip(self.motions, self.residuals, strict=True):
            states = smoothed_states(kalman, residual)
            error_q, error_v, force = states[:n], states[n : 2 * n], states[2 * n]
            error_a = -(self.rig.modes.omega[:, None] ** 2) * error_q - self.rig.modes.damping @ error_v
            pieces.append(
                (
                    force,
                    shape @ (motion.displacement + error_q),
                    shape @ (motion.velocity + error_v),
                    shape @ (motion.acceleration + error_a) + shape @ shape * force,
                )
            )
        return Place(x, *(np.concatenate(series) for series in zip(*pieces, strict=True)))
