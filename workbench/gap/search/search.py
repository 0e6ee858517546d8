"""The data that every step of a search for effects shares, and its criteria of what explains the records."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any, NamedTuple, TypeVar

import numpy as np

from workbench.gap.effects.effect import Effect, Kind, apply_all, can_be
from workbench.gap.effects.nominal import STIFFNESS, NominalPrior
from workbench.gap.localisation.force_reconstruction import FEWER_PLACES, ForceReconstruction
from workbench.gap.prediction.innovations import PROCESS_NOISE, Observer
from workbench.gap.prediction.noise import input_filters, logging_noise_power, noise_found
from workbench.gap.prediction.random_force import RandomForceFit
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import ForceFilter
from workbench.gap.prediction.workers import Workers
from workbench.gap.search.fit import DIVERGED, Fit, cost_of, finite_residual, sensitivity
from workbench.gap.search.settings import SEARCH
from workbench.rig.rig import Rig
from workbench.structure.domain import Domain, NamedPoints
from workbench.structure.member import Structure

Candidate = TypeVar("Candidate")
Found = TypeVar("Found")
Alternatives = tuple[tuple[Fit, float], ...]  # other sets with their probabilities, most probable first


@dataclass(frozen=True, eq=False)
class Search:
    """Records, nominal rig and candidate kinds of a search for effects.

    Attributes:
        rig: nominal, with the effects that show in the readings themselves (rounding, clipping).
        data: all fit records.
        quick: the two most informative records.
        first: the most informative record.
        catalogue: kinds of effects to try.
        progress: called with (what, share done).
        workers: processes that share the work.
        nominal: (n_records, n_outputs) mean square residuals of the nominal rig, in units of the noise.
        held: fixed effects that are added to every candidate.
        logged: input noise, as a share of the inputs' rms, that the residuals are whitened for; 0 for none.
        differs: the nominal parameter that varies from record to record; empty for none.
        by_mode: whether nominal errors are those of each mode (its frequency, its shape at every transducer) instead of
            smooth variations of mass and stiffness.
        tolerance: of the signal's rms: neither a gap nor an effect that is smaller in every record counts.
        process_noise: process noise of the observer that predicts one step ahead, of the inputs' rms.
    """

    rig: Rig
    data: FitData
    quick: FitData
    first: FitData
    catalogue: tuple[Kind, ...]
    progress: Callable[[str, float], None]
    workers: Workers
    nominal: np.ndarray
    held: tuple[Effect, ...] = ()
    logged: float = 0.0
    differs: str = ""
    by_mode: bool = False
    tolerance: float = 0.0
    process_noise: float = PROCESS_NOISE

    @property
    def is_over(self) -> bool:
        """Whether the deadline is past: no further step starts, and fits end with the best that they have."""
        return self.data.deadline.is_past

    @property
    def nats_per_parameter(self) -> float:
        """Description length, nats, of one parameter: half the logarithm of the number of values."""
        return 0.5 * float(np.log(self.data.n_values))

    def without_effects(self) -> Fit:
        """The fit of no effects."""
        left = self.data.by_channel(self.data.residual(self.rig))
        return Fit((), float(left.mean()), left, 0)

    def explains(self, candidate: Fit) -> bool:
        """Whether the residual of a fit is at the noise floor in every record, up to the integration error.

        False for effects that cluster at one place: they approximate a law that the catalogue lacks.
        """
        if self.clustered(candidate.effects):
            return False
        residual_power = candidate.cost_by_channel.mean(axis=1)
        per_record = self.data.counted[0].outputs.size
        slack = (
            SEARCH.noise_tolerance
            + 5.0 * np.sqrt(2.0 / per_record)
            + SEARCH.integration_error * self.nominal.mean(axis=1)
        )
        slack = slack + candidate.stepping
        return bool(
            (residual_power < 1.0 + slack).all()
            and residual_power.mean() < self.cost_limit + np.mean(candidate.stepping)
        )

    @property
    def cost_limit(self) -> float:
        """Largest cost of a set that explains the records."""
        slack = max(SEARCH.noise_tolerance, SEARCH.noise_deviations * np.sqrt(2.0 / self.data.n_values))
        return float(1.0 + slack + SEARCH.integration_error * self.nominal.mean())

    def clustered(self, effects: Sequence[Effect]) -> bool:
        """Whether nonlinear effects cluster at one place: two of one kind, or three of any."""
        point = [effect for effect in effects if effect.kind.nonlinear and effect.at is not None]

        def at_one_place(some: Sequence[Effect]) -> bool:
            return not any(apart(one, other, self.rig.modes.domain) for one, other in combinations(some, 2))

        alike = any(one.kind is other.kind and at_one_place((one, other)) for one, other in combinations(point, 2))
        return alike or any(at_one_place(three) for three in combinations(point, 3))

    def surely_better(self, candidate: Fit, than: float, extra: int) -> bool:
        """Whether the gain in likelihood justifies `extra` more parameters."""
        n = self.data.n_values
        return bool(n * (than - candidate.cost) > SEARCH.likelihood_ratio + extra * np.log(n))

    def significant(self, candidate: Fit, than: float) -> bool:
        """Whether a fit improves on a cost surely, and by more than the imperfection of any model."""
        return (
            self.surely_better(candidate, than, candidate.n_parameters)
            and than - candidate.cost > SEARCH.significant_gain
        )

    def distinguishes(self, better: float, cost: float, extra: int) -> bool:
        """Whether the lower of two costs is surely and not negligibly better, given `extra` more parameters."""
        return self.is_justified(float(np.log(cost / better)), extra)

    def is_justified(self, gain: float, extra: int, n_values: int | None = None) -> bool:
        """Whether a gain justifies `extra` more parameters, and is not negligible.

        Args:
            gain: twice the log-likelihood ratio per measured value.
            extra: parameters.
            n_values: number of measured values; None for those of all records.
        """
        n = self.data.n_values if n_values is None else n_values
        return gain > SEARCH.least_gain and n * gain > SEARCH.likelihood_ratio + extra * np.log(n)

    def near(self, candidate: Fit, share: float) -> bool:
        """Whether the residual power of a fit above the noise is below this share of the gap's."""
        return candidate.cost - 1.0 < share * float(self.nominal.mean() - 1.0)

    def noticeable(self, effects: Sequence[Effect], beside: Sequence[Effect]) -> tuple[Effect, ...]:
        """Those of the effects that alter the readings of some record by more than the tolerance.

        Args:
            effects: some of `beside`.
            beside: the whole set.
        """
        scales = [record.outputs.std(axis=1, keepdims=True) for record in self.data.counted]
        whole = self.data.predictions(apply_all(self.rig, beside))

        def altered(effect: Effect) -> float:
            others = [e for e in beside if e is not effect]
            if not can_be(self.rig, others):  # the others cannot exist without this effect
                return np.inf
            without = self.data.predictions(apply_all(self.rig, others))
            each = zip(whole, without, scales, strict=True)
            with np.errstate(over="ignore", invalid="ignore"):  # without the effect the simulation may diverge
                powers = [float((((a - b) / scale) ** 2).mean()) for a, b, scale in each]
            return max(np.sqrt(power) if np.isfinite(power) else np.inf for power in powers)

        return tuple(effect for effect in effects if altered(effect) > self.tolerance)

    def are_noticeable(self, effects: Sequence[Effect], beside: Sequence[Effect]) -> bool:
        """Whether all of the effects are `noticeable`."""
        return len(self.noticeable(effects, beside)) == len(effects)

    def with_noise(self, noise: np.ndarray) -> "Search":
        """The same search with other standard deviations of sensor noise (n_outputs,)."""
        nominal = self.nominal * (self.data.noise / noise) ** 2
        return replace(self._with_data(lambda data: data.with_noise(noise)), nominal=nominal)

    def through(self, whitener: ForceFilter, observer: Observer) -> "Search":
        """The same search with residuals whitened for a random force."""
        return self._with_data(lambda data: data.through(whitener, observer))

    def with_input_noise(self, rig: Rig, share: float) -> "Search":
        """The same search with residuals whitened for input noise.

        Args:
            rig: with the modes that the noise excites.
            share: standard deviation of the noise, over the inputs' rms.
        """
        filters = input_filters(rig, self.data, share)
        whitened = self._with_data(lambda data: data.with_input_noise(filters))
        return replace(whitened, nominal=whitened.data.by_channel(whitened.data.residual(self.rig)), logged=share)

    def _with_data(self, changed: Callable[[FitData], FitData]) -> "Search":
        """The same search with each of its selections of records changed."""
        return replace(self, data=changed(self.data), quick=changed(self.quick), first=changed(self.first))

    def reconstruction_with(self, effects: Sequence[Effect]) -> ForceReconstruction:
        """The force that the rig with effects lacks."""
        return ForceReconstruction.of(apply_all(self.rig, effects), self.data, FEWER_PLACES, self.workers)

    def without_clipped(self) -> "Search":
        """The same search without sensors that clip or round coarsely, whose errors would pass for a force."""
        kept = [
            j for j, s in enumerate(self.rig.sensors) if np.isinf(s.limit) and s.step < SEARCH.coarse_step * s.noise_std
        ]
        if not kept or len(kept) == len(self.rig.sensors):
            return self
        sensors = tuple(self.rig.sensors[j] for j in kept)
        names = tuple(sensor.name for sensor in sensors)
        rig = replace(self.rig, sensors=sensors)
        return replace(self._with_data(lambda data: data.of_outputs(names)), rig=rig, nominal=self.nominal[:, kept])

    def with_nominal_errors(self, errors: Effect) -> "Search":
        """The same search with nominal errors that are re-estimated with every candidate, to first order."""
        data = self.data.with_nuisance(sensitivity(self.rig, (errors,), self.data, self.workers))
        return replace(self, data=data, held=(errors,))

    def noise_with(self, found: Fit) -> np.ndarray:
        """Standard deviation of each sensor's noise (n_outputs,), estimated from the residual of a set of effects.

        A residual within the stated noise is all noise: coloured noise has peaks, which an estimate from the quiet
        bands misses, and differs between records.
        """
        residuals = self.data.differences(apply_all(self.rig, found.effects))
        rms = np.sqrt(np.mean([(residual**2).mean(axis=1) for residual in residuals], axis=0))
        noise: np.ndarray = np.maximum(noise_found(residuals), np.minimum(rms, self.data.noise))
        return noise

    @property
    def prior(self) -> NominalPrior:
        """Prior standard deviations of the nominal errors, before any record is seen."""
        structured, by_mode = isinstance(self.rig.structure, Structure), self.by_mode
        return NominalPrior(
            stiffness=0.02 if structured and not by_mode else 0.0,
            mass=0.0 if by_mode else 0.02,
            frequency=0.0 if structured and not by_mode else 0.005,
            coupling=0.0 if structured else 0.01,
            damping=0.2,
            delay=0.1,
            # with one actuator and one sensor, an error of the mass is the same
            gain=0.01 if len(self.rig.actuators) + len(self.rig.sensors) > 2 else 0.0,
            place=0.0 if isinstance(self.rig.modes.domain, NamedPoints) else 0.001,
            # with one mode, errors of gains and mass are the same
            shape=0.01 if (by_mode or self.rig.structure is None) and self.rig.modes.n_modes > 1 else 0.0,
            record=0.005 if self.differs else 0.0,
            sample_time=self.data.records[0].sample_time,
            records=tuple(record.name for record in self.data.records) if self.differs else (),
            parameter=self.differs or STIFFNESS,
            by_mode=by_mode,
        )

    @cached_property
    def logging_noise(self) -> np.ndarray:
        """Residual power due to input noise (n_records, n_outputs); see `logging_noise_power`."""
        return logging_noise_power(self.rig, self.data)

    @cached_property
    def ahead(self) -> FitData:
        """One-step-ahead predictions (innovations) of the two most informative records."""
        return self._ahead(self.quick)

    @cached_property
    def first_ahead(self) -> FitData:
        """One-step-ahead predictions of the most informative record."""
        return self._ahead(self.first)

    @cached_property
    def nominal_ahead(self) -> float:
        """Mean square of the nominal rig's one-step-ahead residual, in units of the noise."""
        return cost_of(self.rig, self.held, self.ahead)

    def _ahead(self, data: FitData) -> FitData:
        data = data.one_step_ahead(self.rig, self.process_noise)
        if not self.held or finite_residual(self.rig, self.held, data) is None:  # the predictions diverge
            return data
        return data.with_nuisance(sensitivity(self.rig, self.held, data, self.workers))

    def in_parallel(
        self, function: Callable[["Search", Candidate], Found], candidates: Iterable[Candidate]
    ) -> list[Found]:
        """`function(search, candidate)` of each candidate, computed in parallel, in their order."""
        return self.workers.map(lambda candidate: function(self, candidate), candidates)


def most_informative(data: FitData, by_channel: np.ndarray) -> tuple[FitData, FitData]:
    """The two most informative records, and the first of them.

    The first has the largest residual over the noise, the other the largest residual over the signal.

    Args:
        data: records.
        by_channel: (n_records, n_outputs) mean square residuals, in units of the noise.
    """
    by_record = by_channel.mean(axis=1)
    scale = np.array([np.mean((r.outputs.std(axis=1) / data.noise) ** 2) for r in data.counted])
    scale = np.maximum(scale, 1e-12)  # of readings that are constant
    order = [int(np.argmax(by_record)), *np.argsort(-(by_record - 1.0) / scale)]
    names = [data.records[i].name for i in list(dict.fromkeys(int(i) for i in order))[:2]]
    return data.only(tuple(names)).stepped(2), data.only((names[0],)).stepped(2)


def best_of_each_kind(fits: Sequence[Fit]) -> list[Fit]:
    """The first fit for each kind of its last effect, in the order of the fits; failed ones are left out."""
    return first_of_each((f for f in fits if f.cost < DIVERGED), lambda f: f.effects[-1].kind.name)


def best_of_each(fits: Iterable[Fit]) -> list[Fit]:
    """The first fit of every set, in the order of the fits."""
    return first_of_each(fits, lambda f: f.key)


def first_of_each(items: Iterable[Candidate], key: Callable[[Candidate], Hashable]) -> list[Candidate]:
    """The first item of every key, in the order of the items."""
    chosen: dict[Hashable, Candidate] = {}
    for item in items:
        chosen.setdefault(key(item), item)
    return list(chosen.values())


def apart(one: Effect, other: Effect, domain: Domain) -> bool:
    """Whether two effects are far enough apart for different local minima; those without a place always are."""
    return one.at is None or domain.separation(one.at, other.at) > SEARCH.distinct_distance


def in_one_minimum(one: Fit, other: Fit, domain: Domain) -> bool:
    """Whether two fits are of one set and so close in place that they converge to the same local minimum."""

    def in_order(candidate: Fit) -> list[Effect]:
        return sorted(candidate.effects, key=lambda effect: (effect.label, _sort_key(effect.at)))

    if one.key != other.key:
        return False
    both = ((here.at, there.at) for here, there in zip(in_order(one), in_order(other), strict=True))
    return all(here is None or domain.separation(here, there) < SEARCH.same_distance for here, there in both)


def _sort_key(where: Any) -> tuple[Any, ...]:
    """A place of any type as a sort key."""
    return where if isinstance(where, tuple) else () if where is None else (where,)


def promise(candidate: Fit, iterations: int = 1) -> float:
    """The cost after so many more iterations that each decrease it as the last one did."""
    return candidate.cost * (1.0 - candidate.falling) ** iterations


class Decision(NamedTuple):
    """The verdict of a search; see `Attribution` for the other attributes.

    Attributes:
        beside: the search that it is based on, if that has input noise or finer substeps.
    """

    outcome: str
    best: Fit
    random: RandomForceFit | None = None
    alternatives: Alternatives = ()
    noise: np.ndarray | None = None
    beside: Search | None = None


def unexplained(start: Fit, best: Fit, alternatives: Alternatives) -> Decision:
    """The verdict where no set reaches the noise floor: explained in part (half of the gap's rms), or unknown.

    Args:
        start: the fit without effects.
        best: the set with the smallest residual.
        alternatives: other sets with their probabilities.
    """
    share_closed = 1.0 - np.sqrt(max(best.cost - 1.0, 0.0) / max(start.cost - 1.0, 1e-12))
    return Decision("part" if share_closed > 0.5 else "unknown", best, alternatives=alternatives)


def nearest(search: Search, start: Fit, decision: Decision, fits: Sequence[Fit]) -> Decision:
    """The decision, or that for the best of these fits if the decision does not explain the gap and costs more.

    A search cut short by its deadline may have found a better set before it tried nominal errors.
    """
    best = min(fits, key=lambda f: f.cost, default=start)
    is_open = decision.outcome in ("part", "unknown")
    is_nearer = is_open and best.cost < cost_of(search.rig, decision.best.effects, search.data)
    return unexplained(start, best, ()) if is_nearer else decision
