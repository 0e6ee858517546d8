"""An unmodelled force, before any effect is assumed: its place, the force itself, and the motion there."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from workbench.arrays import Floats
from workbench.gap.effects.effect import ForceAndMotion
from workbench.gap.localisation.force_lines import Lines, lines_of, screened
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import (
    ForceFilter,
    SampledModel,
    gauss_markov_force_filter,
    log_likelihood,
    sampled_model,
    smoothed_states,
)
from workbench.gap.prediction.workers import ALONE, Workers
from workbench.rig.motion import Motion
from workbench.rig.rig import Rig
from workbench.structure.domain import Between, Domain, Interval, Location, NamedPoints, Rectangle


@dataclass(frozen=True)
class ReconstructionSettings:
    """Constants of the localisation of an unmodelled force by a Kalman filter."""

    rms_ratios: tuple[float, ...] = (1e-3, 1e-2, 1e-1, 1.0)  # rms of an unmodelled force over that of the inputs
    correlation_times: tuple[float, ...] = (10.0, 1000.0)  # of this force, in samples
    max_peaks: int = 3  # of the likelihood that are kept
    sample_time_tolerance: float = 1e-6  # relative difference of the sample times of two records that are taken for one
    grid_places: int = 40  # of the grid along an interval
    refinement_range: float = 0.95  # of the grid spacing: range about a peak, or a minimum, in which it is refined
    place_tolerance: float = 2e-3  # of the grid spacing, at the refinement
    min_motion_share: float = 1e-6  # of the largest mode shape: a point, or a pair of points, that no force moves
    peak_spacing: float = 0.1  # of a rectangle's diagonal: least distance between peaks
    refined_spacing: float = 0.03  # likewise, after refinement
    subdivisions: int = 5  # of the grid of a rectangle, for the refinement
    points_tried: int = 4  # named points that are candidates
    pairs_tried: int = 12  # pairs of them, likewise
    # 1 - cos² of the angle between the mode shapes of two pairs: below, they are one place
    shape_tolerance: float = 1e-4
    max_points: int = 12  # named points up to which all are candidates


RECONSTRUCTION = ReconstructionSettings()
FEWER_PLACES = 20  # of the grid, when some effects are given


@dataclass(frozen=True, eq=False)
class ForceReconstruction:
    """The residual of a rig on the fit records, and the unmodelled force estimated from it.

    Attributes:
        rig: the rig that was simulated.
        data: fit records with their noise.
        motions: its motion, one per record.
        residuals: (n_sensors, n_samples) a record, in the sensors' units.
        n_places: number of places of the grid.
        given_places: places of the force, if they are known.
        given_size: its rms, N, and correlation time, in samples, if they are known.
        workers: processes that share the work.
        absorbed: whether nominal errors were fitted to the records and may have absorbed linear parts of the force.
    """

    rig: Rig
    data: FitData
    motions: tuple[Motion, ...]
    residuals: tuple[np.ndarray, ...]
    n_places: int = RECONSTRUCTION.grid_places
    given_places: tuple[Location, ...] = ()
    given_size: tuple[float, float] | None = None
    workers: Workers = ALONE
    absorbed: bool = False

    @classmethod
    def of(
        cls,
        rig: Rig,
        data: FitData,
        n_places: int = RECONSTRUCTION.grid_places,
        workers: Workers = ALONE,
        *,
        absorbed: bool = False,
    ) -> "ForceReconstruction":
        """The reconstruction with a rig, simulated on the fit records."""
        motions = data.motions(rig)
        return cls(rig, data, motions, tuple(data.differences(rig)), n_places, workers=workers, absorbed=absorbed)

    def of_rig(self, rig: Rig) -> "ForceReconstruction":
        """The reconstruction with another rig on the same records, given the size of the force."""
        return replace(ForceReconstruction.of(rig, self.data, workers=self.workers), given_size=self.size)

    def without(self, names: Collection[str]) -> "ForceReconstruction":
        """The same reconstruction without some of the sensors, unless none would be left."""
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

    def of_force_at(self, *places: Location) -> "ForceReconstruction":
        """The same reconstruction of a force at known places."""
        return replace(self, given_places=places, given_size=self.size)

    @property
    def domain(self) -> Domain:
        return self.rig.modes.domain

    @cached_property
    def sample_times(self) -> tuple[float, ...]:
        """Of each record, s; those of clocks that agree to a millionth are one."""
        found: list[float] = []
        for dt in (record.sample_time for record in self.data.counted):
            found.append(next((t for t in found if np.isclose(t, dt, RECONSTRUCTION.sample_time_tolerance, 0.0)), dt))
        return tuple(found)

    @property
    def has_several_rates(self) -> bool:
        return len(set(self.sample_times)) > 1

    @cached_property
    def models(self) -> dict[float, SampledModel]:
        """The rig's modes and sensors, discretised, by sample time of the records."""
        modes, sensors, noise = self.rig.modes, self.rig.sensors, self.data.noise
        return {dt: sampled_model(modes, sensors, noise, dt) for dt in dict.fromkeys(self.sample_times)}

    @property
    def model(self) -> SampledModel:
        """That of the first record."""
        return self.models[self.sample_times[0]]

    def filters_at(self, where: Location, size: tuple[float, float]) -> dict[float, ForceFilter]:
        """The filter for an unknown force at a place, by sample time.

        size: rms of the force, N, and its correlation time, in samples of the first record.
        """
        modes, (rms, memory) = self.rig.modes, size
        time, shape = memory * self.sample_times[0], modes.phi_at(where)
        each = self.models.items()
        return {dt: gauss_markov_force_filter(modes, model, shape, rms, time, dt) for dt, model in each}

    def _log_likelihood(self, where: Location, size: tuple[float, float], n_records: int | None = None) -> float:
        """Log-likelihood of an unknown force at a place, of a size as of `filters_at`, in the first or all records."""
        filters = self.filters_at(where, size)
        each = list(zip(self.sample_times, self.residuals, strict=True))[:n_records]
        return sum(log_likelihood(filters[dt], [residual]) for dt, residual in each)

    @cached_property
    def places(self) -> Any:
        """Candidate places of an unmodelled force: a grid over the structure, or named points and pairs of them."""
        if isinstance(self.domain, Interval):
            return self.domain.length * np.arange(1, self.n_places) / self.n_places
        if isinstance(self.domain, NamedPoints):
            places: tuple[Any, ...] = (*self.domain.grid(), *self.domain.pairs())
            moved = [float(np.abs(self.rig.modes.phi_at(where)).max()) for where in places]
            least = RECONSTRUCTION.min_motion_share * max(moved)
            return tuple(where for where, size in zip(places, moved, strict=True) if size > least)
        return self.domain.grid(self._along)

    @cached_property
    def places_to_try(self) -> Sequence[Any]:
        """Fewer places, spread out, at which linear effects are always tried; of many named points, the likeliest."""
        if isinstance(self.domain, Interval):
            return [float(x) for x in self.places[::2]]
        if isinstance(self.domain, NamedPoints):
            many = len(self.domain.names) > RECONSTRUCTION.max_points
            return [p for p in self.peaks if not isinstance(p, Between)] if many else self.domain.grid()
        return self.domain.grid(6)

    @cached_property
    def size(self) -> tuple[float, float]:
        """Rms, N, and correlation time, in samples, of the unmodelled force: the likeliest of a coarse grid."""
        if self.given_size is not None:
            return self.given_size
        quick, memories, rms = max(2, len(self.residuals) - 2), RECONSTRUCTION.correlation_times, self.data.force_rms
        sizes = [(share * rms, memory) for memory in memories for share in RECONSTRUCTION.rms_ratios]
        # a few places, close enough to any other
        if isinstance(self.domain, Interval):
            coarse = self.places[::5]
        elif isinstance(self.domain, NamedPoints) and len(self.domain.names) <= RECONSTRUCTION.max_points:
            coarse = self.domain.grid()
        else:
            coarse = self._likeliest_places[: RECONSTRUCTION.max_peaks]

        def likelihood(size: tuple[float, float]) -> float:
            return max(self._log_likelihood(x, size, quick) for x in coarse)

        return max(zip(self.workers.map(likelihood, sizes), sizes, strict=True), key=lambda each: each[0])[1]

    @cached_property
    def profile(self) -> np.ndarray:
        """Log-likelihood of an unknown force at each of `places`; approximate, except for an interval."""
        if not isinstance(self.domain, Interval):
            return -0.5 * self.screened(self.places)
        size = self.size
        return np.array(self.workers.map(lambda x: self._log_likelihood(x, size), self.places))

    @cached_property
    def lines(self) -> list[Lines]:
        """Spectral lines of every record's residual, record by record of each sample time."""
        each = list(zip(self.sample_times, self.residuals, strict=True))
        return [
            lines
            for dt, model in self.models.items()
            for lines in lines_of(self.rig, model, [residual for own, residual in each if own == dt], dt)
        ]

    def informative(self, where: Location) -> list[Lines]:
        """The lines, weighted by the share of their power that is due to a force at a place."""
        shape = self.rig.modes.phi_at(where)
        return [each.weighted(each.force_share(shape)) for each in self.lines]

    def misfit(self, where: Location, lines: Sequence[Lines] | None = None) -> float:
        """Residual sum of squares given one force of any law at a place, transients included, in units of the noise.

        lines: weighted ones; None for all, with equal weights.
        """
        shape = self.rig.modes.phi_at(where)
        return float(sum(each.misfit(shape) for each in (self.lines if lines is None else lines)))

    def misfits(self, places: Sequence[Any], lines: Sequence[Lines]) -> Floats:
        return np.array(self.workers.map(lambda where: self.misfit(where, lines), places))

    def screened(self, places: Sequence[Any], lines: Sequence[Lines] | None = None) -> Floats:
        """The approximate misfit at each of many places, without transients."""
        shapes = np.array([self.rig.modes.phi_at(where) for where in places])
        chosen = self.lines if lines is None else lines
        return np.asarray(np.sum([screened(each, shapes) for each in chosen], axis=0))

    @cached_property
    def _likeliest_places(self) -> tuple[Any, ...]:
        """The likeliest of `places`, best first: peaks over a rectangle, or some named points and pairs of them."""
        order = np.argsort(-self.profile, kind="stable")
        ranked = [self.places[i] for i in order]
        if isinstance(self.domain, Rectangle):
            return self._peaks_over(self.domain, ranked)
        pairs = [i for i, where in enumerate(ranked) if isinstance(where, Between)]
        points = [i for i, where in enumerate(ranked) if not isinstance(where, Between)]
        most = len(points) if len(points) <= RECONSTRUCTION.max_points else RECONSTRUCTION.points_tried
        return tuple(ranked[i] for i in sorted((*points[:most], *self._distinct_pairs(ranked, pairs))))

    def _distinct_pairs(self, ranked: Sequence[Any], pairs: Sequence[int]) -> list[int]:
        """The first few pairs with different mode shapes: pairs across a stiff floor, say, count as one place."""
        kept: dict[int, Floats] = {}
        for i in pairs:
            shape = self.rig.modes.phi_at(ranked[i])
            shape = shape / max(float(np.linalg.norm(shape)), 1e-300)
            if all((shape @ other) ** 2 < 1.0 - RECONSTRUCTION.shape_tolerance for other in kept.values()):
                kept[i] = shape
            if len(kept) == RECONSTRUCTION.pairs_tried:
                break
        return [*kept]

    @property
    def _along(self) -> int:
        """Number of grid spacings along the longer side of a rectangle."""
        return max(self.n_places // 2, 16)

    def _peaks_over(self, rectangle: Rectangle, ranked: Sequence[Any]) -> tuple[tuple[float, float], ...]:
        """Refined peaks over a rectangle, best first; mirrored places are tried too, as a plate is nearly symmetric."""
        (a, b), finer = rectangle.length, RECONSTRUCTION.subdivisions
        peaks_found = _spaced(ranked, rectangle, RECONSTRUCTION.peak_spacing)
        mirrored = [image for x, y in peaks_found for image in ((x, y), (a - x, y), (x, b - y), (a - x, b - y))]
        offsets = max(a, b) / self._along * np.arange(-finer, finer + 1) / finer
        around = [
            [(float(np.clip(x + dx, 0.0, a)), float(np.clip(y + dy, 0.0, b))) for dx in offsets for dy in offsets]
            for x, y in mirrored
        ]
        misfits = self.screened([where for places in around for where in places]).reshape(len(around), -1)
        refined = [places[int(np.argmin(row))] for places, row in zip(around, misfits, strict=True)]
        order = np.argsort(self.workers.map(self.misfit, refined), kind="stable")
        return tuple(_spaced([refined[i] for i in order], rectangle, RECONSTRUCTION.refined_spacing))

    @cached_property
    def peaks(self) -> tuple[Any, ...]:
        """The likeliest places of an unmodelled force, best first, refined between the grid points."""
        if self.given_places:
            return self.given_places
        if not isinstance(self.domain, Interval):
            return self._likeliest_places
        peaks_found = self.places[minima(-self.profile)[: RECONSTRUCTION.max_peaks]]
        refined = self.workers.map(self._refined_peak, peaks_found)
        return tuple(at for at, _ in sorted(refined, key=lambda top: -top[1]))

    def _refined_peak(self, at: float) -> tuple[float, float]:
        """The peak of the log-likelihood near a place of the grid: position and height."""
        spacing = self.places[1] - self.places[0]
        beside, options = RECONSTRUCTION.refinement_range * spacing, {"xatol": RECONSTRUCTION.place_tolerance * spacing}
        how: Any = {"method": "bounded", "bounds": (at - beside, at + beside), "options": options}
        found = minimize_scalar(lambda x: -self._log_likelihood(x, self.size), **how)
        return float(found.x), -float(found.fun)

    @cached_property
    def at_peaks(self) -> tuple[ForceAndMotion, ...]:
        """The unmodelled force and the motion at the likeliest places."""
        _ = self.size  # computed once, before processes are forked
        return tuple(self.workers.map(self.place, self.peaks))

    def place(self, where: Location) -> ForceAndMotion:
        """The smoothed unmodelled force at a place, and the motion there."""
        filters, modes = self.filters_at(where, self.size), self.rig.modes
        n, shape = modes.n_modes, modes.phi_at(where)
        pieces = []
        for dt, motion, residual in zip(self.sample_times, self.motions, self.residuals, strict=True):
            states = smoothed_states(filters[dt], residual)
            error_q, error_v, force = states[:n], states[n : 2 * n], states[2 * n]
            error_a = -(modes.omega[:, None] ** 2) * error_q - modes.damping @ error_v
            w, v = shape @ (motion.displacement + error_q), shape @ (motion.velocity + error_v)
            pieces.append((force, w, v, shape @ (motion.acceleration + error_a) + shape @ shape * force))
        force, w, v, a = (np.concatenate(series) for series in zip(*pieces, strict=True))
        return ForceAndMotion(where, force, w, v, a, self.absorbed)


def _spaced(ranked: Sequence[tuple[float, float]], rectangle: Rectangle, share: float) -> list[tuple[float, float]]:
    """The first few places, best first, that are farther than a share of the diagonal from those before them."""
    found: list[tuple[float, float]] = []
    for where in ranked:
        if all(rectangle.separation(where, other) > share for other in found):
            found.append(where)
        if len(found) == RECONSTRUCTION.max_peaks:
            break
    return found


def minima(values: Floats) -> np.ndarray:
    """Indices of the local minima of a series, deepest first."""
    padded = np.r_[np.inf, values, np.inf]
    bottoms = np.flatnonzero((values <= padded[:-2]) & (values <= padded[2:]))
    return bottoms[np.argsort(values[bottoms])]
