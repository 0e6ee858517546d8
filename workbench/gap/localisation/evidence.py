"""An unmodelled force, before any effect is assumed: its place, the force itself, and the motion there."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from workbench.arrays import Floats
from workbench.gap.effects.effect import ForceAndMotion
from workbench.gap.localisation.force_lines import Lines, lines_of, screened
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
from workbench.renamed import Renamed
from workbench.rig.motion import Motion
from workbench.rig.rig import Rig
from workbench.structure.domain import Between, Domain, Interval, NamedPoints, Rectangle, Where
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class EvidenceSettings:
    """Constants of the localisation of an unmodelled force by a Kalman filter."""

    levels: tuple[float, ...] = (1e-3, 1e-2, 1e-1, 1.0)  # rms of an unmodelled force over that of the inputs
    memories: tuple[float, ...] = (10.0, 1000.0)  # its correlation time, in samples
    most_peaks: int = 3  # of the likelihood that are kept
    one_rate: float = 1e-6  # relative difference of the sample times of two records that are taken for one
    places: int = 40  # of the grid along an interval
    beside: float = 0.95  # of the grid spacing: range about a peak in which it is refined
    resolved: float = 2e-3  # of the grid spacing: tolerance of the refinement
    still: float = 1e-6  # of the largest mode shape: a point, or a pair of points, that no force moves
    broad: float = 0.1  # of a rectangle's diagonal: least distance between peaks
    narrow: float = 0.03  # likewise, after refinement
    finer: int = 5  # subdivisions of the grid of a rectangle, for the refinement
    points_tried: int = 4  # named points that are candidates
    pairs_tried: int = 12  # pairs of them, likewise
    alike: float = 1e-4  # 1 - cos² of the angle between the mode shapes of two pairs: below, they are one place
    many_points: int = 12  # named points up to which all are candidates


@dataclass(frozen=True)
class LocalisationSettings:
    """Constants of the localisation of one force."""

    valleys: int = 3  # local minima of the misfit that are refined
    rounds: int = 3  # alternations between the place and the weights of the lines
    beside: float = 0.95  # of the grid spacing: range about a minimum in which it is refined
    resolved: float = 1e-3  # of the grid spacing: tolerance of the refinement
    pairs_shown: int = 12  # of named points
    two_sigma: float = 4.0  # rise of the misfit at two standard errors
    noise: float = 0.1  # of the noise power: largest excess of the residual given one force
    all_but: float = 1e-5  # of the gap, likewise
    chance: float = 3.0  # standard deviations of a sum of squares
    edge: float = 1e-4  # of the length: least distance of a place from the ends
    near: float = 0.02  # of a rectangle's size: first simplex about a peak
    tolerance: float = 1e-2  # of the misfit, in units of the noise variance
    evaluations: int = 60  # of the simplex search
    curved_over: float = 0.1  # of that simplex: step of the second difference of the misfit
    bisections: int = 6  # of the distance at which the misfit has risen


EVIDENCE = EvidenceSettings()
LOCALISATION = LocalisationSettings()
FEWER_PLACES = 20  # of the grid, when some effects are given


@dataclass(frozen=True, eq=False)
class Evidence:
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
    n_places: int = EVIDENCE.places
    given_places: tuple[Where, ...] = ()
    given_size: tuple[float, float] | None = None
    workers: Workers = ALONE
    absorbed: bool = False

    @classmethod
    def of(
        cls,
        rig: Rig,
        data: FitData,
        n_places: int = EVIDENCE.places,
        workers: Workers = ALONE,
        *,
        absorbed: bool = False,
    ) -> "Evidence":
        """The evidence of a rig, simulated on the fit records."""
        motions = data.motions(rig)
        return cls(rig, data, motions, tuple(data.differences(rig)), n_places, workers=workers, absorbed=absorbed)

    def of_rig(self, rig: Rig) -> "Evidence":
        """The evidence of another rig on the same records, given the size of the force."""
        return replace(Evidence.of(rig, self.data, workers=self.workers), given_size=self.size)

    def without(self, names: Collection[str]) -> "Evidence":
        """The same evidence without some of the sensors, unless none would be left."""
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

    def of_force_at(self, *places: Where) -> "Evidence":
        """The same evidence of a force at known places."""
        return replace(self, given_places=places, given_size=self.size)

    @property
    def domain(self) -> Domain:
        """Of places on the structure."""
        return self.rig.modes.domain

    @cached_property
    def sample_times(self) -> tuple[float, ...]:
        """Of each record, s; those of clocks that agree to a millionth are one."""
        found: list[float] = []
        for dt in (record.sample_time for record in self.data.counted):
            found.append(next((known for known in found if np.isclose(known, dt, EVIDENCE.one_rate, 0.0)), dt))
        return tuple(found)

    @property
    def has_several_rates(self) -> bool:
        """Whether the records differ in sample rate."""
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

    def filters_at(self, where: Where, size: tuple[float, float]) -> dict[float, ForceFilter]:
        """The filter for an unknown force at a place, by sample time.

        Args:
            where: the place.
            size: rms of the force, N, and its correlation time, in samples of the first record.
        """
        modes, (rms, memory) = self.rig.modes, size
        time, shape = memory * self.sample_times[0], modes.phi_at(where)
        each = self.models.items()
        return {dt: wandering_force_filter(modes, model, shape, rms, time, dt) for dt, model in each}

    def _log_likelihood(self, where: Where, size: tuple[float, float], n_records: int | None = None) -> float:
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
            return tuple(where for where, size in zip(places, moved, strict=True) if size > EVIDENCE.still * max(moved))
        return self.domain.grid(self._along)

    @cached_property
    def places_to_try(self) -> Sequence[Any]:
        """Fewer places, spread out, at which linear effects are always tried; of many named points, the likeliest."""
        if isinstance(self.domain, Interval):
            return [float(x) for x in self.places[::2]]
        if isinstance(self.domain, NamedPoints):
            many = len(self.domain.names) > EVIDENCE.many_points
            return [p for p in self.peaks if not isinstance(p, Between)] if many else self.domain.grid()
        return self.domain.grid(6)

    @cached_property
    def size(self) -> tuple[float, float]:
        """Rms, N, and correlation time, in samples, of the unmodelled force: the likeliest of a coarse grid."""
        if self.given_size is not None:
            return self.given_size
        quick = max(2, len(self.residuals) - 2)
        sizes = [(share * self.data.force_rms, memory) for memory in EVIDENCE.memories for share in EVIDENCE.levels]

        coarse = self._coarse_places

        def likelihood(size: tuple[float, float]) -> float:
            return max(self._log_likelihood(x, size, quick) for x in coarse)

        return max(zip(self.workers.map(likelihood, sizes), sizes, strict=True), key=lambda each: each[0])[1]

    @property
    def _coarse_places(self) -> Sequence[Any]:
        """A few places, close enough to any other to estimate the size of the force."""
        if isinstance(self.domain, Interval):
            every_fifth: Sequence[Any] = self.places[::5]
            return every_fifth
        if isinstance(self.domain, NamedPoints) and len(self.domain.names) <= EVIDENCE.many_points:
            return self.domain.grid()
        return self._likeliest_places[: EVIDENCE.most_peaks]

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

    def informative(self, where: Where) -> list[Lines]:
        """The lines, weighted by the share of their power that is due to a force at a place."""
        shape = self.rig.modes.phi_at(where)
        return [each.weighted(each.force_share(shape)) for each in self.lines]

    def misfit(self, where: Where, lines: Sequence[Lines] | None = None) -> float:
        """Residual sum of squares given one force of any law at a place, transients included, in units of the noise.

        Args:
            where: the place.
            lines: weighted ones; None for all, with equal weights.
        """
        shape = self.rig.modes.phi_at(where)
        return float(sum(each.misfit(shape) for each in (self.lines if lines is None else lines)))

    def misfits(self, places: Sequence[Any], lines: Sequence[Lines]) -> Floats:
        """The misfit at each of the places."""
        return np.array(self.workers.map(lambda where: self.misfit(where, lines), places))

    def screened(self, places: Sequence[Any], lines: Sequence[Lines] | None = None) -> Floats:
        """The approximate misfit at each of many places, without transients."""
        shapes = np.array([self.rig.modes.phi_at(where) for where in places])
        misfits: Floats = np.sum([screened(each, shapes) for each in (self.lines if lines is None else lines)], axis=0)
        return misfits

    @cached_property
    def _likeliest_places(self) -> tuple[Any, ...]:
        """The likeliest of `places`, best first: peaks over a rectangle, or some named points and pairs of them."""
        order = np.argsort(-self.profile, kind="stable")
        ranked = [self.places[i] for i in order]
        if isinstance(self.domain, Rectangle):
            return self._peaks_over(self.domain, ranked)
        pairs = [i for i, where in enumerate(ranked) if isinstance(where, Between)]
        points = [i for i, where in enumerate(ranked) if not isinstance(where, Between)]
        most = len(points) if len(points) <= EVIDENCE.many_points else EVIDENCE.points_tried
        return tuple(ranked[i] for i in sorted((*points[:most], *self._distinct_pairs(ranked, pairs))))

    def _distinct_pairs(self, ranked: Sequence[Any], pairs: Sequence[int]) -> list[int]:
        """The first few pairs with different mode shapes: pairs across a stiff floor, say, count as one place."""
        kept: list[int] = []
        shapes: list[np.ndarray] = []
        for i in pairs:
            shape = self.rig.modes.phi_at(ranked[i])
            shape = shape / max(float(np.linalg.norm(shape)), 1e-300)
            if all((shape @ other) ** 2 < 1.0 - EVIDENCE.alike for other in shapes):
                kept.append(i)
                shapes.append(shape)
            if len(kept) == EVIDENCE.pairs_tried:
                break
        return kept

    @property
    def _along(self) -> int:
        """Number of grid spacings along the longer side of a rectangle."""
        return max(self.n_places // 2, 16)

    def _peaks_over(self, rectangle: Rectangle, ranked: Sequence[Any]) -> tuple[tuple[float, float], ...]:
        """Refined peaks over a rectangle, best first; mirrored places are tried too, as a plate is nearly symmetric."""
        (a, b), peaks_found = rectangle.length, _spaced(ranked, rectangle, EVIDENCE.broad, EVIDENCE.most_peaks)
        mirrored = [image for x, y in peaks_found for image in ((x, y), (a - x, y), (x, b - y), (a - x, b - y))]
        offsets = max(a, b) / self._along * np.arange(-EVIDENCE.finer, EVIDENCE.finer + 1) / EVIDENCE.finer
        around = [
            [(float(np.clip(x + dx, 0.0, a)), float(np.clip(y + dy, 0.0, b))) for dx in offsets for dy in offsets]
            for x, y in mirrored
        ]
        misfits = self.screened([where for places in around for where in places]).reshape(len(around), -1)
        refined = [places[int(np.argmin(row))] for places, row in zip(around, misfits, strict=True)]
        misfits_there = self.workers.map(self.misfit, refined)
        order = np.argsort(misfits_there, kind="stable")
        return tuple(_spaced([refined[i] for i in order], rectangle, EVIDENCE.narrow, EVIDENCE.most_peaks))

    @cached_property
    def peaks(self) -> tuple[Any, ...]:
        """The likeliest places of an unmodelled force, best first, refined between the grid points."""
        if self.given_places:
            return self.given_places
        if not isinstance(self.domain, Interval):
            return self._likeliest_places
        peaks_found = self.places[_minima(-self.profile)[: EVIDENCE.most_peaks]]
        refined = self.workers.map(self._refined_peak, peaks_found)
        return tuple(at for at, _ in sorted(refined, key=lambda top: -top[1]))

    def _refined_peak(self, at: float) -> tuple[float, float]:
        """The peak of the log-likelihood near a place of the grid: position and height."""
        spacing = self.places[1] - self.places[0]
        found = minimize_scalar(
            lambda x: -self._log_likelihood(x, self.size),
            bounds=(at - EVIDENCE.beside * spacing, at + EVIDENCE.beside * spacing),
            method="bounded",
            options={"xatol": EVIDENCE.resolved * spacing},
        )
        return float(found.x), -float(found.fun)

    @cached_property
    def at_peaks(self) -> tuple[ForceAndMotion, ...]:
        """The unmodelled force and the motion at the likeliest places."""
        _ = self.size  # computed once, before processes are forked
        return tuple(self.workers.map(self.place, self.peaks))

    def place(self, where: Where) -> ForceAndMotion:
        """The smoothed unmodelled force at a place, and the motion there."""
        filters = self.filters_at(where, self.size)
        n, shape = self.rig.modes.n_modes, self.rig.modes.phi_at(where)
        pieces = []
        for dt, motion, residual in zip(self.sample_times, self.motions, self.residuals, strict=True):
            states = smoothed_states(filters[dt], residual)
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
        force, w, v, a = (np.concatenate(series) for series in zip(*pieces, strict=True))
        return ForceAndMotion(where, force, w, v, a, self.absorbed)


def _spaced(
    ranked: Sequence[tuple[float, float]], rectangle: Rectangle, share: float, most: int
) -> list[tuple[float, float]]:
    """The first few places, best first, that are farther than a share of the diagonal from those before them."""
    peaks_found: list[tuple[float, float]] = []
    for where in ranked:
        if all(rectangle.separation(where, other) > share for other in peaks_found):
            peaks_found.append(where)
        if len(peaks_found) == most:
            break
    return peaks_found


def _minima(values: Floats) -> np.ndarray:
    """Indices of the local minima of a series, deepest first."""
    padded = np.r_[np.inf, values, np.inf]
    bottoms = np.flatnonzero((values <= padded[:-2]) & (values <= padded[2:]))
    return bottoms[np.argsort(values[bottoms])]


@dataclass(frozen=True, eq=False)
class ForceLocation:
    """Likelihood of one force of any law at each place, and the likeliest place.

    Attributes:
        places: (n_places,) on the structure.
        profile: (n_places,) log-likelihood, relative to that of the likeliest place.
        at: the likeliest place.
        at_std: standard error of the place, m, from a quarter of the 2-sigma interval, inflated by the residual above
            the noise; on a rectangle along the longer axis of the region; 0 for named places.
        share: of the gap's power above the noise that one force there explains.
        is_single_force: whether one force reduces the gap to noise, or to a negligible share; None if that cannot be
            tested: no gap, one sensor, or records too short.
    """

    places: Sequence[Any]
    profile: np.ndarray
    at: Any
    at_std: float
    share: float
    is_single_force: bool | None

    holds = Renamed("is_single_force")


@one_blas_thread
def locate_force(evidence: Evidence) -> ForceLocation:
    """Locate the one force, of any law, that best explains the gap.

    One sensor locates nothing, since a force anywhere explains its readings. Sensors with a lag are left out.
    """
    evidence = evidence.without([sensor.name for sensor in evidence.rig.sensors if sensor.time_constant > 0])
    domain, places = evidence.domain, evidence.places
    at: Any = evidence.peaks[0]
    if len(evidence.rig.sensors) < 2:
        std = 0.0 if isinstance(domain, NamedPoints) else domain.size / np.sqrt(12.0)
        return ForceLocation(places, np.zeros(len(places)), at, std, 0.0, None)
    informative = evidence.informative(at)
    if isinstance(domain, Interval):
        valleys = places[_minima(evidence.misfits(places, informative))[: LOCALISATION.valleys]]
        # minima are compared by equal weights: each one's own would favour it
        at = min(evidence.workers.map(partial(_refined, evidence), valleys), key=evidence.misfit)
        informative = evidence.informative(at)
        profile, std = evidence.misfits(places, informative), _deviation(evidence, informative, at)
    elif isinstance(domain, Rectangle):
        refined = [_refined_over(evidence, domain, peak) for peak in evidence.peaks]
        at, std = min(refined, key=lambda each: evidence.misfit(each[0]))
        informative = evidence.informative(at)
        profile = evidence.screened(places, informative)
    else:
        ranked = [places[i] for i in np.argsort(-evidence.profile, kind="stable") if isinstance(places[i], Between)]
        points = [where for where in places if not isinstance(where, Between)]
        places = [*points, *ranked[: LOCALISATION.pairs_shown]]
        profile = evidence.misfits(places, informative)
        at, std = places[int(np.argmin(profile))], 0.0
    lowest = min(evidence.misfit(at, informative), profile.min())
    degrees_of_freedom = sum(each.degrees_of_freedom for each in evidence.lines)
    left = evidence.misfit(at) / max(degrees_of_freedom, 1) - 1.0
    std *= np.sqrt(max(left, 0.0) + 1.0)
    return ForceLocation(places, -0.5 * (profile - lowest), at, std, *_explained(evidence, degrees_of_freedom, left))


def _explained(evidence: Evidence, degrees_of_freedom: int, left: float) -> tuple[float, bool | None]:
    """Share of the gap's power that one force explains, and whether that is all of it; None if it cannot be tested.

    Args:
        evidence: of the nominal rig.
        degrees_of_freedom: of the residual given the force.
        left: its power above the noise, in units of the noise power.
    """
    values = 2 * sum(each.left.size for each in evidence.lines)
    gap = sum(each.power for each in evidence.lines) - values
    if degrees_of_freedom == 0 or gap < LOCALISATION.chance * np.sqrt(2.0 * values):
        return 0.0, None
    chance = LOCALISATION.chance * np.sqrt(2.0 / degrees_of_freedom)
    share = float(np.clip(1.0 - left * degrees_of_freedom / gap, 0.0, 1.0))
    return share, bool(left < LOCALISATION.noise + chance or share > 1.0 - LOCALISATION.all_but)


def _refined_over(
    evidence: Evidence, rectangle: Rectangle, top: tuple[float, float]
) -> tuple[tuple[float, float], float]:
    """The local minimum of the misfit on a rectangle, and its standard error along the longer axis, m."""
    informative, extent = evidence.informative(top), np.array(rectangle.length)

    def inside(xy: Floats) -> tuple[float, float]:
        x, y = np.clip(xy, LOCALISATION.edge * extent, (1.0 - LOCALISATION.edge) * extent)
        return float(x), float(y)

    def misfit(xy: Floats) -> float:
        return evidence.misfit(inside(xy), informative)

    reach = LOCALISATION.near * rectangle.size
    options = {
        "initial_simplex": np.array(top) + reach * np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]),
        "xatol": LOCALISATION.resolved * reach,
        "fatol": LOCALISATION.tolerance,
        "maxfev": LOCALISATION.evaluations,
    }
    found = minimize(misfit, top, method="Nelder-Mead", options=options)
    at, step = inside(found.x), LOCALISATION.curved_over * reach
    curvatures = [misfit(at + h) + misfit(at - h) - 2.0 * found.fun for h in step * np.array([(1, 0), (0, 1)])]
    flattest = max(min(curvatures), 1e-12)  # of |r|², twice the log-likelihood ratio
    return at, float(min(step * np.sqrt(2.0 / flattest), rectangle.size))


def _refined(evidence: Evidence, top: float) -> float:
    """The local minimum of the misfit along an interval."""
    at, informative = float(top), evidence.informative(top)
    length, spacing = evidence.domain.size, evidence.places[1] - evidence.places[0]
    edge, beside = LOCALISATION.edge * length, LOCALISATION.beside * spacing
    for _ in range(LOCALISATION.rounds):
        found = minimize_scalar(
            evidence.misfit,
            bounds=(max(at - beside, edge), min(at + beside, length - edge)),
            args=(informative,),
            method="bounded",
            options={"xatol": LOCALISATION.resolved * spacing},
        )
        moved, at = abs(found.x - at), float(found.x)
        informative = evidence.informative(at)
        if moved < LOCALISATION.resolved * spacing:
            break
    return at


def _deviation(evidence: Evidence, lines: Sequence[Lines], at: float) -> float:
    """Standard error of a place along an interval, m: a quarter of that in which the misfit rises by less than 4."""
    length, level = evidence.domain.size, evidence.misfit(at, lines) + LOCALISATION.two_sigma

    def is_outside(x: float) -> bool:
        return not 0 < x < length or evidence.misfit(x, lines) > level

    def distance(side: float) -> float:
        inside, outside = 0.0, 1e-5 * length
        while outside < length and not is_outside(at + side * outside):
            inside, outside = outside, 2.0 * outside
        for _ in range(LOCALISATION.bisections):
            middle = 0.5 * (inside + outside)
            inside, outside = (inside, middle) if is_outside(at + side * middle) else (middle, outside)
        return outside

    return (distance(-1.0) + distance(1.0)) / 4.0
