"""The stages of a search, in their order: from one effect to several beside small errors of the model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nonlinear import BEYOND, any_beyond, in_catalogue
from workbench.gap.localisation.breakdown import of_one_sensor
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.noise import is_noise_alone, noise_found
from workbench.gap.search.errors_as_effects import NO_UNIFORM_ERROR, UNIFORM, are_uniform_errors, is_plausible_error
from workbench.gap.search.finish import finished, ranked, relocated, simplest
from workbench.gap.search.fit import Fit, cost_of, fit
from workbench.gap.search.intervals import with_intervals
from workbench.gap.search.other_errors import with_mode_errors, with_record_deviations
from workbench.gap.search.pairs import Pairs
from workbench.gap.search.screening import Screening, on_whole_records, one_more
from workbench.gap.search.search import Decision, Search, most_informative, nearest, promise
from workbench.gap.search.settings import ATTRIBUTION, FIT, PAIRS, RANDOM, SEARCH, SELECTION, STEPWISE
from workbench.gap.search.stepwise import Stepwise
from workbench.gap.search.with_random_force import decide_on_random, random_with_effects, random_with_nominal_errors
from workbench.rig.simulate import is_stepped


@dataclass(eq=False)
class Stages:
    """A search stage by stage, each of which decides or leaves the decision to those after it.

    The order is that of `BEFORE_SINGLES` and `STAGES`. Simple causes come before those with more parameters, and quick
    stages before slow ones. What several stages need is computed by the first of them.

    Attributes:
        search: records, rig with the effects seen in the readings, and candidate kinds.
        start: the fit without further effects.
        reconstruction: of that rig.
        nominal: the force reconstructed with the nominal rig.
        uncertain_nominal: whether nominal errors are fitted with every effect from the first.
        ahead: single effects fitted to one-step-ahead predictions, best first; empty if a stage before decides.
        singles: single effects on whole records, best first, or sets that were tried with a random disturbance.
        missing, beside_missing: modes without which there is no evidence of what else is there, and the stages of the
            search in the model with them, which decide; none and None where there are no such modes.
    """

    search: Search
    start: Fit
    reconstruction: ForceReconstruction
    nominal: ForceReconstruction
    uncertain_nominal: bool = False
    ahead: list[Fit] = field(default_factory=list)
    singles: list[Fit] = field(default_factory=list)
    missing: tuple[Effect, ...] = ()
    beside_missing: "Stages | None" = None

    def decision(self) -> Decision:
        """The decision of the first stage that comes to one."""
        early = _first_of(BEFORE_SINGLES, self)
        if early is not None:
            return early
        self.ahead = one_more(self.search, (), self.reconstruction, self.screened)
        self.singles = self._singles_on_whole_records()
        found = _first_of(STAGES, self) or self.nearest_set()
        return found if self.missing else nearest(self.search, self.start, found, self.singles)

    # Before single effects

    def within_tolerance(self) -> Decision | None:
        """No gap above noise and tolerance, where no effect shows in the readings themselves."""
        return Decision("none", self.start) if not self.start.effects and self._is_small else None

    def noise_alone(self) -> Decision | None:
        """More noise than stated."""
        residuals = self.reconstruction.residuals
        if self.is_explained_by_none or not is_noise_alone(residuals, self.search.data.counted):
            return None
        return Decision("none", self.start, noise=noise_found(residuals))

    def beside_nominal_errors(self) -> Decision | None:
        """Any effects beside nominal errors, where the model is known to be inexact."""
        if not self.uncertain_nominal or self.is_explained_by_none:
            return None
        stepwise = Stepwise(self.search)
        varied = None if stepwise.is_sufficient else with_record_deviations(stepwise)
        if varied is not None:
            return varied.decision()
        stepwise.run()
        return stepwise.decision()

    def random_disturbance(self) -> Decision | None:
        """A random disturbance of the structure, alone or with few effects."""
        if self.is_explained_by_none or self._is_of_one_sensor:
            return None
        found, self.singles = decide_on_random(self.search, self.reconstruction)
        return found

    # From single effects on

    def single_effect(self) -> Decision | None:
        """At most one effect."""
        found, self.singles = _decide_on_singles(self.search, self.start, self.singles)
        return None if found is None else _unless_other_law(self.search, found, self.reconstruction)

    def random_at_one_sensor(self) -> Decision | None:
        """A random disturbance that only one sensor shows, whose own faults do not explain it."""
        return decide_on_random(self.search, self.reconstruction)[0] if self._is_of_one_sensor else None

    def pair_at_noise_floor(self) -> Decision | None:
        """Two effects, with the stated sensor noise.

        Not if one is a plausible error of the model or has no significant parameter, or if one is a uniform error and
        the other uniform error surely explains more.
        """
        pairs, search = replace(self.screened_pairs), self.search
        near = [effect for f in self.singles[:1] if search.near(f, PAIRS.max_residual_share) for effect in f.effects]
        if not (pairs.explain or pairs.with_any(near)):
            return None
        decision = pairs.decision(self.start)
        effects = decision.best.effects
        if are_uniform_errors(effects) or any(is_plausible_error(effect, search) for effect in effects):
            return None
        missing = [effect for effect in NO_UNIFORM_ERROR if effect.kind not in {e.kind for e in effects}]
        if len(missing) == 1:  # an imperfect model has both uniform errors, and a damper may stand for one of damping
            both = fit(search.rig, (*effects, *missing), search.data, iterations=FIT.iterations)
            if search.surely_better(both, decision.best.cost, 1):
                return None
        return self._if_significant(decision)

    def three_at_noise_floor(self) -> Decision | None:
        """Three strong effects, with the stated sensor noise; none of them an error of the model, as in pairs."""
        pairs, search = replace(self.screened_pairs), self.search
        if not (self.ahead and pairs.with_a_third_ahead(self.ahead[0].cost)):
            return None
        decision = pairs.decision(self.start)
        if any(effect.kind in UNIFORM or is_plausible_error(effect, search) for effect in decision.best.effects):
            return None
        return self._if_significant(decision)

    def single_in_louder_noise(self) -> Decision | None:
        """One effect and more noise than stated: fewer parameters than nominal errors that fit equally well."""
        search, stated, best = self.search, self.search.data.noise, self.singles[0] if self.singles else self.start
        under_errors = np.sqrt(self.stepwise.last.sensor_noise) * stated
        noise = np.clip(search.noise_with(best), stated, (1.0 + ATTRIBUTION.tenth_louder) ** 0.5 * under_errors)
        if np.median(noise / stated) ** 2 < 1.0 + ATTRIBUTION.tenth_louder:
            return None
        louder = search.with_noise(noise)

        def in_louder(candidate: Fit) -> Fit:
            by_channel = candidate.cost_by_channel * (stated / noise) ** 2
            return replace(candidate, cost=float(by_channel.mean()), cost_by_channel=by_channel)

        fits = [in_louder(f) for f in self.singles]
        promising = [f for f in fits if louder.explains(f) or louder.near(f, SEARCH.explained_share)]
        decision = _decide_on_singles(louder, in_louder(self.start), promising)[0] if promising else None
        if decision is None or decision.outcome != "explained":
            return None
        return decision._replace(noise=noise)

    def with_missing_modes(self) -> Decision | None:
        """Effects in the model with the modes that are missing, where these close most of the gap and not all of it."""
        search, best = self.search, self.singles[0] if self.singles else self.start
        missing = tuple(effect for effect in best.effects if effect.kind.adds_modes)
        if not missing or missing != best.effects or not search.near(best, ATTRIBUTION.mode_share):
            return None
        if self.is_explained_by_one_beside_errors:
            return None
        reconstruction = self.reconstruction.of_rig(apply_all(search.rig, missing))
        quick, first = most_informative(search.data, best.cost_by_channel)
        with_them = replace(
            search,
            rig=reconstruction.rig,
            quick=quick,
            first=first,
            catalogue=tuple(kind for kind in search.catalogue if not kind.adds_modes),
            nominal=best.cost_by_channel,
        )
        start = replace(best, effects=(), n_parameters=0)
        self.missing, self.beside_missing = missing, Stages(with_them, start, reconstruction, reconstruction)
        return self.beside_missing.decision()

    def random_beside_effects(self) -> Decision | None:
        """A random disturbance beside stronger effects, or beside small errors of the model."""
        is_at_noise = self.is_explained_beside_errors and self.stepwise.is_noise_only
        is_near_noise = min(f.cost for f in (self.start, *self.singles)) < 1.0 + STEPWISE.noise_excess
        if is_at_noise or is_near_noise or self.search.is_over:
            return None
        random = random_with_effects(self.search, self.singles)
        if random is None and not self.is_explained_beside_errors:
            random = random_with_nominal_errors(self.search, self.stepwise.steps[0])
        return random

    def beside_small_errors(self) -> Decision | None:
        """Few effects beside small errors of the model, smooth along the structure or of each mode."""
        is_explained = self.is_explained_beside_errors
        if is_explained:
            self.stepwise.run()
        is_plain = is_explained and self.stepwise.has_plausible_errors
        by_mode = None if self.search.is_over or is_plain else with_mode_errors(self.stepwise)
        return (by_mode or self.stepwise).decision() if by_mode is not None or is_explained else None

    def other_law(self) -> Decision | None:
        """A force at one point of a law beyond the catalogue: takes a second, where deviations take minutes."""
        law = None if self.search.is_over else _force_of_other_law(self.search, self.reconstruction)
        return None if law is None else _law_or_decision(law, self.search, self.pairs.decision(self.start))

    def record_deviations(self) -> Decision | None:
        """Effects beside a parameter of the model that differs from record to record."""
        varied = None if self.search.is_over else with_record_deviations(self.stepwise)
        return None if varied is None else varied.decision()

    def several_before_pairs(self) -> Decision | None:
        """Several effects beside small errors, where these already explain more than any single effect."""
        last = self.stepwise.last
        # implausible errors show a missing effect, so few effects without errors come first
        if not last.is_plausible or last.fit.cost >= min(f.cost for f in (self.start, *self.singles)):
            return None
        self.stepwise.run()
        return self.stepwise.decision() if self.stepwise.is_conclusive else None

    def pair(self) -> Decision | None:
        """Two or three effects without errors of the model."""
        return self._of_pairs() if self.pairs.explain or self.pairs.with_a_third() else None

    def several(self) -> Decision | None:
        """Several effects beside small errors of the model, then pairs with either half of the best one exchanged."""
        self.stepwise.run()
        is_open = not self.stepwise.is_conclusive and self.stepwise.decision().outcome != "explained"
        found = self._of_pairs() if is_open and self.pairs.by_exchange() else None
        if found is not None:
            return found
        decision = self.nearest_set()
        return decision if decision.outcome in ("explained", "none") or self.search.is_over else None

    def random_at_last(self) -> Decision | None:
        """A random disturbance beside the best pair, or beside small errors where that is not sure."""
        random = random_with_effects(self.search, self.pairs.found[:1])
        return random or random_with_nominal_errors(self.search, self.stepwise.steps[0], surely=False)

    def nearest_set(self) -> Decision:
        """The set that leaves least, where no stage decides."""
        return nearest(self.search, self.start, self.stepwise.decision(), self.pairs.found)

    # What the stages share

    @cached_property
    def is_explained_by_none(self) -> bool:
        """Whether the rig without further effects explains the records."""
        return self.search.explains(self.start)

    @cached_property
    def _is_of_one_sensor(self) -> bool:
        """Whether only one of several sensors disagrees: its own fault is likelier than a random disturbance."""
        excess = np.maximum(self.start.cost_by_channel.mean(axis=0) - 1.0, 0.0)
        return excess.size > 1 and of_one_sensor(excess)

    @property
    def _is_small(self) -> bool:
        """Whether the gap above the noise is within the tolerance, or a tenth of the noise, in every record."""
        for record, residual in zip(self.nominal.data.counted, self.nominal.residuals, strict=True):
            scale = record.outputs.std(axis=1, keepdims=True)
            noise_floor = float(((self.nominal.data.noise[:, None] / scale) ** 2).mean())
            largest = max(self.search.tolerance**2, ATTRIBUTION.tenth_louder * noise_floor)
            if float(((residual / scale) ** 2).mean()) - noise_floor > largest:
                return False
        return self.search.tolerance > 0

    @cached_property
    def screened(self) -> Screening:
        """All kinds of effects, screened with none given."""
        self.search.progress("one effect", 0.1)
        return Screening.of(self.search, (), self.reconstruction)

    def _singles_on_whole_records(self) -> list[Fit]:
        """Single effects on whole records, best first."""
        promising = [f for f in self.ahead if f.cost < SELECTION.max_residual_ahead] or self.ahead[:1]
        self.search.progress("one effect, on whole records", 0.3)
        if not self.is_explained_by_none:
            return on_whole_records(self.search, promising, ATTRIBUTION.finalists)
        # only a significant gain matters, and there may be no effect at all
        to_cost = self.start.cost - SEARCH.significant_gain
        return on_whole_records(
            self.search, promising, ATTRIBUTION.finalists, to_cost=to_cost, at_first=ATTRIBUTION.first_iterations
        )

    @cached_property
    def screened_pairs(self) -> Pairs:
        """All pairs, screened at once."""
        return Pairs.at_once(self.search, self.screened)

    @cached_property
    def pairs(self) -> Pairs:
        """The search for pairs, which goes on from stage to stage."""
        return replace(self.screened_pairs)

    @cached_property
    def stepwise(self) -> Stepwise:
        """The stepwise selection beside small errors of the model, which goes on from stage to stage."""
        return Stepwise(self.search, self.ahead)

    @cached_property
    def is_explained_by_one_beside_errors(self) -> bool:
        """Whether small errors of the model explain the records, alone or with one effect, which is selected."""
        stepwise = self.stepwise
        return bool(stepwise.is_sufficient or stepwise.without_errors() or stepwise.by_singles())

    @cached_property
    def is_explained_beside_errors(self) -> bool:
        """Whether small errors of the model explain the records, alone or with few effects, which are selected."""
        stepwise = self.stepwise
        # damping is hardly known: if only its errors are large, only an effect that makes them smaller is searched for
        return bool(
            self.is_explained_by_one_beside_errors
            or stepwise.by_few()
            or stepwise.by_almost_alone(self.singles)
            or (stepwise.is_noise_only and stepwise.has_plausible_errors)
        )

    def _if_significant(self, decision: Decision) -> Decision | None:
        """The decision, if each of its effects has a significant parameter."""
        search = self.search
        sure = with_intervals(search.rig, decision.best, search.data, search.workers).effects
        return decision if all(effect.stands_out(search.rig) for effect in sure) else None

    def _of_pairs(self) -> Decision | None:
        """The decision for the best pair, unless it is of uniform errors that small errors of the model include."""
        decision = self.pairs.decision(self.start)
        return None if are_uniform_errors(decision.best.effects) and self.stepwise.needs_no_effect else decision


Stage = Callable[[Stages], Decision | None]
BEFORE_SINGLES: tuple[Stage, ...] = (
    Stages.within_tolerance,
    Stages.noise_alone,
    Stages.beside_nominal_errors,
    Stages.random_disturbance,
)
STAGES: tuple[Stage, ...] = (
    Stages.single_effect,
    Stages.random_at_one_sensor,
    Stages.pair_at_noise_floor,
    Stages.three_at_noise_floor,
    Stages.single_in_louder_noise,
    Stages.with_missing_modes,
    Stages.random_beside_effects,
    Stages.beside_small_errors,
    Stages.other_law,
    Stages.record_deviations,
    Stages.several_before_pairs,
    Stages.pair,
    Stages.several,
    Stages.random_at_last,
)


def _first_of(stages: Sequence[Stage], shared: Stages) -> Decision | None:
    """The decision of the first of these stages that comes to one, or None."""
    return next((found for stage in stages if (found := stage(shared)) is not None), None)


def _decide_on_singles(search: Search, start: Fit, singles: list[Fit]) -> tuple[Decision | None, list[Fit]]:
    """The decision if at most one effect explains the records, else None; and the single effects, best first."""
    good = [f for f in singles if search.significant(f, start.cost)]
    if search.explains(start) and not good:
        return Decision("none", start), singles
    ended = _finished_best(search, good[:4])
    explaining = [f for f in ended if search.explains(f)]
    if not explaining:
        near = [f for f in ended[:2] if search.near(f, RANDOM.max_residual_share)]
        moved = search.in_parallel(relocated, near)
        explaining = [f for f in moved if search.explains(f)]
        singles = sorted((*moved, *singles), key=lambda f: f.cost)
    if explaining:
        best, alternatives = ranked(search, [simplest(search, f) for f in explaining])
        return Decision("explained", best, alternatives=alternatives), singles
    if search.explains(start):
        return Decision("none", start), singles
    return None, singles


def _finished_best(search: Search, fits: Sequence[Fit]) -> list[Fit]:
    """The fits; those that more iterations or finer substeps may bring to the noise floor are refined."""
    promising = [f for f in fits if f.cost < SEARCH.max_cost_ratio * fits[0].cost]
    if fits and search.explains(fits[0]):
        near = fits[0].cost + SEARCH.alternative_margin
        promising = [
            f
            for f in promising
            if promise(f, SEARCH.extrapolated_iterations) < near or is_stepped(apply_all(search.rig, f.effects))
        ]
    return [*search.in_parallel(finished, promising), *(f for f in fits if f not in promising)]


def _force_of_other_law(search: Search, reconstruction: ForceReconstruction) -> Fit | None:
    """A force at one point that explains the records alone, with a law beyond the catalogue or a power law in it.

    Two effects at one place can fit many laws, so this comes before pairs are accepted. None if there is none.
    """
    search.progress("one force of a law beyond the catalogue", 0.35)
    fits = _forces_of_other_laws(search, reconstruction, SELECTION.max_residual_ahead)
    return next((f for f in (_as_catalogue_kind(search, f) for f in fits) if search.explains(f)), None)


def _forces_of_other_laws(search: Search, reconstruction: ForceReconstruction, most: float) -> list[Fit]:
    """Forces at one point of a law beyond the catalogue, best first, that cost less than `most` one step ahead."""
    beyond = replace(search, catalogue=BEYOND)
    promising = [f for f in one_more(beyond, (), reconstruction) if f.cost < most]
    return on_whole_records(beyond, promising, SEARCH.few_finalists, to_cost=search.cost_limit)


def _as_catalogue_kind(search: Search, law: Fit) -> Fit:
    """A fit of a force of another law, replaced by the kind of the catalogue that has its power, if there is one."""
    known = in_catalogue(law.effects[0])
    return law if known is None else finished(search, fit(search.rig, (known,), search.data))


def _unless_other_law(search: Search, decision: Decision, reconstruction: ForceReconstruction) -> Decision:
    """The decision, or that for a law beyond the catalogue if the records surely prefer it to one law at a point.

    Args:
        decision: to be compared.
        reconstruction: of the nominal rig.
    """
    best = decision.best
    if decision.outcome != "explained" or len(best.effects) != 1:
        return decision
    (effect,) = best.effects
    if not effect.kind.nonlinear or effect.at is None:
        return decision
    search.progress("one force of a law beyond the catalogue", 0.9)
    as_near = cost_of(search.rig, best.effects, search.ahead) + SEARCH.alternative_margin
    fits = _forces_of_other_laws(search, reconstruction.of_force_at(effect.at), as_near)
    other = [f for f in fits if in_catalogue(f.effects[0]) is None]
    sure = (f for f in other if search.explains(f) and search.surely_better(f, best.cost, best.n_parameters))
    law = next(sure, None)
    return decision if law is None else _law_or_decision(law, search, decision)


def _law_or_decision(law: Fit, search: Search, decision: Decision) -> Decision:
    """The decision for the likelier of a force of another law and the sets of a decision."""
    named = [decision.best, *(f for f, _ in decision.alternatives)] if decision.outcome == "explained" else []
    best, alternatives = ranked(search, [law, *named])
    return Decision("unknown" if any_beyond(best.effects) else "explained", best, alternatives=alternatives)
