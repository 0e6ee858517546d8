"""What every step of a search for effects works on, and what it may call an explanation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from workbench.gap.effects.effect import Effect, Kind
from workbench.gap.effects.nominal import STIFFNESS, NominalPrior
from workbench.gap.localisation.evidence import FEWER_PLACES, Evidence
from workbench.gap.prediction.innovations import Observer
from workbench.gap.prediction.noise import input_filters, logging_noise_power
from workbench.gap.prediction.random_force import RandomForceFit
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import ForceFilter
from workbench.gap.prediction.workers import Workers
from workbench.gap.search.fit import HOPELESS, Fit, cost_of, finite_residual, sensitivity
from workbench.gap.search.settings import SEARCH
from workbench.rig.rig import Rig
from workbench.structure.domain import Domain, NamedPoints
from workbench.structure.member import Structure


@dataclass(frozen=True, eq=False)
class Search:
    """What every step of a search works on.

    Attributes:
        rig: nominal, with what shows in the readings themselves.
        data: all records to fit.
        quick: the two most telling of them.
        first: the most telling one.
        catalogue: kinds of effects to try.
        report: called with (what, share done).
        workers: processes that share the work.
        nominal: (n_records, n_outputs) mean squares that the nominal rig leaves, in noise units.
        held: effects that every candidate stands beside, as they are.
        logged: noise of the logged inputs, as a share of their rms, beside which residuals are seen.
        differs: the figure of the nominal model that may differ from record to record; empty for none.
        by_mode: whether frequencies and shapes of the nominal modes are off by themselves, the latter at every port,
            not by smooth variations of mass and stiffness.
    """

    rig: Rig
    data: FitData
    quick: FitData
    first: FitData
    catalogue: tuple[Kind, ...]
    report: Callable[[str, float], None]
    workers: Workers
    nominal: np.ndarray
    held: tuple[Effect, ...] = ()
    logged: float = 0.0
    differs: str = ""
    by_mode: bool = False

    @property
    def is_over(self) -> bool:
        """Whether its time is spent: what is sought next is not, and fits end with what they have."""
        return self.data.deadline.is_past

    def explains(self, candidate: Fit) -> bool:
        """Whether what is left is noise, in every record, up to the error of integration.

        Effects that cluster about one place stand for one law that the catalogue does not hold.
        """
        if self.clustered(candidate.effects):
            return False
        left = candidate.cost_by_channel.mean(axis=1)
        per_record = self.data.counted[0].outputs.size
        slack = SEARCH.slack + 5.0 * np.sqrt(2.0 / per_record) + SEARCH.integration_share * self.nominal.mean(axis=1)
        slack = slack + candidate.stepping
        return bool((left < 1.0 + slack).all() and left.mean() < self.enough + np.mean(candidate.stepping))

    @property
    def enough(self) -> float:
        """The cost of a set that explains the records, at most."""
        slack = max(SEARCH.slack, SEARCH.chance * np.sqrt(2.0 / self.data.n_values))
        return float(1.0 + slack + SEARCH.integration_share * self.nominal.mean())

    def clustered(self, effects: Sequence[Effect]) -> bool:
        """Whether nonlinear effects stand for one law: two of a kind, or three of any, side by side."""
        point = [effect for effect in effects if effect.kind.nonlinear and effect.at is not None]

        def side_by_side(some: Sequence[Effect]) -> bool:
            return not any(apart(one, other, self.rig.modes.domain) for one, other in combinations(some, 2))

        alike = any(one.kind is other.kind and side_by_side((one, other)) for one, other in combinations(point, 2))
        return alike or any(side_by_side(three) for three in combinations(point, 3))

    def surely_better(self, candidate: Fit, than: float, extra: int) -> bool:
        """Whether the gain in likelihood pays for `extra` more numbers."""
        n = self.data.n_values
        return bool(n * (than - candidate.cost) > SEARCH.sure + extra * np.log(n))

    def significant(self, candidate: Fit, than: float) -> bool:
        """Whether the gain is sure and large enough to be an effect rather than an imperfect model."""
        return (
            self.surely_better(candidate, than, candidate.n_parameters) and than - candidate.cost > SEARCH.significant
        )

    def tells_apart(self, better: float, cost: float, extra: int) -> bool:
        """Whether records surely prefer the lower of two costs, for `extra` more numbers, and by more than a trifle."""
        return self.pays(float(np.log(cost / better)), extra)

    def pays(self, gain: float, extra: int, n_values: int | None = None) -> bool:
        """The same of a gain: twice the log-likelihood, a value, of all records unless their number is given."""
        n = self.data.n_values if n_values is None else n_values
        return gain > SEARCH.trifle and n * gain > SEARCH.sure + extra * np.log(n)

    def near(self, candidate: Fit, share: float) -> bool:
        """Whether at most this share of the gap's power is left."""
        return candidate.cost - 1.0 < share * float(self.nominal.mean() - 1.0)

    def with_noise(self, noise: np.ndarray) -> "Search":
        """The same search with other standard deviations of the sensors' noise (n_outputs,)."""
        nominal = self.nominal * (self.data.noise / noise) ** 2
        return replace(self._in(lambda data: data.with_noise(noise)), nominal=nominal)

    def through(self, whitener: ForceFilter, observer: Observer) -> "Search":
        """The same search beside a random force."""
        return self._in(lambda data: data.through(whitener, observer))

    def beside_inputs(self, rig: Rig, share: float) -> "Search":
        """The same search beside noise of the logged inputs.

        Args:
            rig: whose modes answer to it.
            share: of the inputs' rms.
        """
        filters = input_filters(rig, self.data, share)
        beside = self._in(lambda data: data.beside_inputs(filters))
        return replace(beside, nominal=beside.data.by_channel(beside.data.residual(self.rig)), logged=share)

    def _in(self, changed: Callable[[FitData], FitData]) -> "Search":
        """The same search in its records once changed."""
        return replace(self, data=changed(self.data), quick=changed(self.quick), first=changed(self.first))

    def evidence_of(self, rig: Rig) -> Evidence:
        """What the records say of an unmodelled force beside what a rig has."""
        return Evidence.of(rig, self.data, FEWER_PLACES, self.workers)

    def without_clipped(self) -> "Search":
        """The same search without sensors that clip or round coarsely: what they do not show would pass for a force."""
        kept = [j for j, s in enumerate(self.rig.sensors) if np.isinf(s.limit) and s.step < SEARCH.coarse * s.noise_std]
        if not kept or len(kept) == len(self.rig.sensors):
            return self
        sensors = tuple(self.rig.sensors[j] for j in kept)
        names = tuple(sensor.name for sensor in sensors)
        rig = replace(self.rig, sensors=sensors)
        return replace(self._in(lambda data: data.of_outputs(names)), rig=rig, nominal=self.nominal[:, kept])

    def beside(self, figures: Effect) -> "Search":
        """The same search beside believed figures, which give way to every candidate to first order."""
        data = self.data.giving_way(sensitivity(self.rig, (figures,), self.data, self.workers))
        return replace(self, data=data, held=(figures,))

    @property
    def prior(self) -> NominalPrior:
        """What the nominal model may be off by before any record is seen."""
        structured, by_mode = isinstance(self.rig.structure, Structure), self.by_mode
        return NominalPrior(
            stiffness=0.02 if structured and not by_mode else 0.0,
            mass=0.0 if by_mode else 0.02,
            frequency=0.0 if structured and not by_mode else 0.005,
            coupling=0.0 if structured else 0.01,
            damping=0.2,
            delay=0.1,
            gain=0.01 if len(self.rig.actuators) + len(self.rig.sensors) > 2 else 0.0,  # of one each: the mass says it
            place=0.0 if isinstance(self.rig.modes.domain, NamedPoints) else 0.001,
            # of one mode, gains and the mass say it
            shape=0.01 if (by_mode or self.rig.structure is None) and self.rig.modes.n_modes > 1 else 0.0,
            record=0.005 if self.differs else 0.0,
            sample_time=self.data.records[0].sample_time,
            records=tuple(record.name for record in self.data.records) if self.differs else (),
            figure=self.differs or STIFFNESS,
            by_mode=by_mode,
        )

    @cached_property
    def logging_noise(self) -> np.ndarray:
        """Power that noise of the logged inputs leaves (n_records, n_outputs); see `logging_noise_power`."""
        return logging_noise_power(self.rig, self.data)

    @cached_property
    def ahead(self) -> FitData:
        """The two most telling records, by predictions one sample ahead."""
        return self._ahead(self.quick)

    @cached_property
    def first_ahead(self) -> FitData:
        """The most telling record, likewise."""
        return self._ahead(self.first)

    @cached_property
    def nominal_ahead(self) -> float:
        """What the nominal rig leaves of predictions one sample ahead, per value, in units of the noise."""
        return cost_of(self.rig, self.held, self.ahead)

    def _ahead(self, data: FitData) -> FitData:
        data = data.one_step_ahead(self.rig)
        if not self.held or finite_residual(self.rig, self.held, data) is None:  # predictions run away beside errors
            return data
        return data.giving_way(sensitivity(self.rig, self.held, data, self.workers))

    def side_by_side(self, function: Callable[..., Fit], candidates: Sequence[Fit]) -> list[Fit]:
        """`function(search, candidate)` of each, in their order."""
        return self.workers.map(lambda candidate: function(self, candidate), candidates)


def most_informative(data: FitData, by_channel: np.ndarray) -> tuple[FitData, FitData]:
    """The two records that say most, and the first of them: largest against the noise, and against the signal.

    Args:
        by_channel: (n_records, n_outputs) mean squares of what is left, in units of the noise.
    """
    by_record = by_channel.mean(axis=1)
    scale = np.array([np.mean((r.outputs.std(axis=1) / data.noise) ** 2) for r in data.counted])
    order = [int(np.argmax(by_record)), *np.argsort(-(by_record - 1.0) / scale)]
    names = [data.records[i].name for i in list(dict.fromkeys(int(i) for i in order))[:2]]
    return data.only(tuple(names)).stepped(2), data.only((names[0],)).stepped(2)


def best_of_each_kind(fits: Sequence[Fit]) -> list[Fit]:
    """The first fit of every kind that its last effect is of, in the order of the fits, but for hopeless ones."""
    chosen: dict[str, Fit] = {}
    for candidate in fits:
        if candidate.cost < HOPELESS:
            chosen.setdefault(candidate.effects[-1].kind.name, candidate)
    return list(chosen.values())


def apart(one: Effect, other: Effect, domain: Domain) -> bool:
    """Whether two effects stand far enough apart to be in different valleys; those of no place always do."""
    return one.at is None or domain.separation(one.at, other.at) > SEARCH.elsewhere


def in_one_valley(one: Fit, other: Fit, domain: Domain) -> bool:
    """Whether two fits are of one set, with places so near that they go on to the same end."""

    def in_order(candidate: Fit) -> list[Effect]:
        return sorted(candidate.effects, key=lambda effect: (effect.label, _sorted_by(effect.at)))

    if one.key != other.key:
        return False
    both = ((here.at, there.at) for here, there in zip(in_order(one), in_order(other), strict=True))
    return all(here is None or domain.separation(here, there) < SEARCH.same_place for here, there in both)


def _sorted_by(where: Any) -> tuple[Any, ...]:
    """What places are sorted by, whatever they are."""
    return where if isinstance(where, tuple) else () if where is None else (where,)


def promise(candidate: Fit, iterations: int = 1) -> float:
    """The cost that one more iteration like the last would come to, or so many more."""
    return candidate.cost * (1.0 - candidate.falling) ** iterations


class Decision(NamedTuple):
    """What is claimed; see `Attribution` for its parts.

    Attributes:
        beside: the search that it was found in, where that was beside noise of the logged inputs.
    """

    outcome: str
    best: Fit
    random: RandomForceFit | None = None
    rivals: tuple[tuple[Fit, float], ...] = ()
    noise: np.ndarray | None = None
    beside: Search | None = None


def unexplained(start: Fit, best: Fit, rivals: tuple[tuple[Fit, float], ...]) -> Decision:
    """What is said where no set reaches the noise floor: in part, or not at all.

    Args:
        start: what is there with no effect.
        best: the nearest set.
        rivals: others, with their probabilities.
    """
    closed = 1.0 - np.sqrt(max(best.cost - 1.0, 0.0) / max(start.cost - 1.0, 1e-12))
    return Decision("part" if closed > 0.5 else "unknown", best, rivals=rivals)


def nearest(search: Search, start: Fit, decision: Decision, fits: Sequence[Fit]) -> Decision:
    """The decision, or what is said of one of these fits where it is nearer than a set that does not explain the gap.

    A search that its time has cut short may have found its nearest set before it looked beside errors of the model.
    """
    best = min(fits, key=lambda f: f.cost, default=start)
    is_open = decision.outcome in ("part", "unknown")
    is_nearer = is_open and best.cost < cost_of(search.rig, decision.best.effects, search.data)
    return unexplained(start, best, ()) if is_nearer else decision
