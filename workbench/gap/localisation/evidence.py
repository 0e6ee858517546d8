"""What the records say before any effect is guessed: the missing force, its place, and the motion there."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize_scalar

from workbench.gap.effects.structural import known_places
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import (
    ForceFilter,
    SampledModel,
    log_likelihood,
    sampled_model,
    smoothed_states,
    wandering_force_filter,
)
from workbench.gap.prediction.workers import ALONE, Workers
from workbench.rig.rig import Rig
from workbench.rig.simulate import Motion

LEVELS = (1e-3, 1e-2, 1e-1, 1.0)  # rms of a missing force over that of the inputs
MEMORIES = (10.0, 1000.0)  # its correlation time, in samples
MOST_PEAKS = 3
PLACES, FEWER_PLACES = 40, 20  # where a force is looked for: the first, and one beside what is given
BESIDE, RESOLVED = 0.95, 2e-3  # of the spacing of places


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
        n_places: where a force is looked for.
        told: places of the force, m, where they are known from elsewhere.
        sized: its rms, N, and correlation time, in samples, likewise.
        workers: processes that share the work.
    """

    rig: Rig
    data: FitData
    motions: tuple[Motion, ...]
    residuals: tuple[np.ndarray, ...]
    n_places: int = PLACES
    told: tuple[float, ...] = ()
    sized: tuple[float, float] | None = None
    workers: Workers = ALONE

    @classmethod
    def of(cls, rig: Rig, data: FitData, n_places: int = PLACES, workers: Workers = ALONE) -> "Evidence":
        """Simulate the rig on the fit records."""
        motions = data.motions(rig)
        predictions = data.predictions(rig)
        residuals = tuple(r.outputs - p for r, p in zip(data.counted, predictions, strict=True))
        return cls(rig, data, motions, residuals, n_places, workers=workers)

    def without(self, names: Collection[str]) -> "Evidence":
        """The same evidence without some of the sensors; with all of them where none would be left."""
        kept = [j for j, sensor in enumerate(self.rig.sensors) if sensor.name not in names]
        if len(kept) in (0, len(self.rig.sensors)):
            return self
        sensors = tuple(self.rig.sensors[j] for j in kept)
        return replace(
            self,
            rig=replace(self.rig, sensors=sensors),
            data=self.data.of_outputs(tuple(sensor.name for sensor in sensors)),
            residuals=tuple(residual[kept] for residual in self.residuals),
        )

    def of_force_at(self, *places: float) -> "Evidence":
        """The same evidence of a force at places that are known, m."""
        return replace(self, told=places, sized=self.size)

    @property
    def length(self) -> float:
        return self.rig.modes.length

    @cached_property
    def model(self) -> SampledModel:
        noise = self.data.noise
        return sampled_model(self.rig.modes, self.rig.sensors, noise, self.data.counted[0].sample_time)

    def filter_at(self, x: float, rms: float, memory: float) -> ForceFilter:
        """The filter for an unknown force at x of that rms, N, and correlation time, in samples."""
        modes, sample_time = self.rig.modes, self.data.counted[0].sample_time
        return wandering_force_filter(modes, self.model, modes.phi(x)[0], rms, memory * sample_time, sample_time)

    @cached_property
    def places(self) -> np.ndarray:
        """Positions along the structure where a missing force is looked for, m."""
        known = known_places(self.rig)
        if known is not None:
            return np.asarray(known, float)
        return self.length * np.arange(1, self.n_places) / self.n_places

    @cached_property
    def size(self) -> tuple[float, float]:
        """Rms, N, and correlation time, in samples, of the missing force: the likeliest of a coarse grid."""
        if self.sized is not None:
            return self.sized
        coarse = self.places[::5] if self.places.size > 8 else self.places
        quick = list(self.residuals[: max(2, len(self.residuals) - 2)])
        sizes = [(share * self.data.force_rms, memory) for memory in MEMORIES for share in LEVELS]

        def likelihood(size: tuple[float, float]) -> float:
            return max(log_likelihood(self.filter_at(x, *size), quick) for x in coarse)

        return max(zip(self.workers.map(likelihood, sizes), sizes, strict=True), key=lambda each: each[0])[1]

    @cached_property
    def profile(self) -> np.ndarray:
        """Log-likelihood of an unknown force at each of `places`."""
        residuals, size = list(self.residuals), self.size
        along = self.workers.map(lambda x: log_likelihood(self.filter_at(x, *size), residuals), self.places)
        return np.array(along)

    @cached_property
    def peaks(self) -> tuple[float, ...]:
        """The likeliest places of a missing force, best first, refined between the grid points."""
        if self.told:
            return self.told
        profile, places = self.profile, self.places
        if known_places(self.rig) is not None:
            return tuple(places[np.argsort(-profile)])
        padded = np.r_[-np.inf, profile, -np.inf]
        tops = np.flatnonzero((profile >= padded[:-2]) & (profile >= padded[2:]))
        refined = self.workers.map(self._refined, places[tops[np.argsort(-profile[tops])][:MOST_PEAKS]])
        return tuple(at for at, _ in sorted(refined, key=lambda top: -top[1]))

    def _refined(self, at: float) -> tuple[float, float]:
        """The top of the log-likelihood beside a place of the grid: where, and how high."""
        spacing, residuals = self.places[1] - self.places[0], list(self.residuals)
        found = minimize_scalar(
            lambda x: -log_likelihood(self.filter_at(x, *self.size), residuals),
            bounds=(at - BESIDE * spacing, at + BESIDE * spacing),
            method="bounded",
            options={"xatol": RESOLVED * spacing},
        )
        return float(found.x), -float(found.fun)

    @cached_property
    def at_peaks(self) -> tuple[Place, ...]:
        """The missing force and the motion at the three likeliest places."""
        _ = self.size  # found once, before the work is shared
        return tuple(self.workers.map(self.place, self.peaks))

    def place(self, x: float) -> Place:
        """The missing force at x and the motion there, smoothed."""
        kalman = self.filter_at(x, *self.size)
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
