"""Effects added one after the other, each beside a nominal model that is a little wrong everywhere."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from workbench.gap.effects.effect import (
    Effect,
    Kind,
    apply_all,
    can_be,
    contained,
    each_left_out,
    key_of,
    merged_sets,
    more_general_sets,
    nearest_possible,
    simpler_sets,
    with_one_simpler,
)
from workbench.gap.effects.nominal import NOMINAL_ERRORS, group_of, nominal_errors
from workbench.gap.effects.ports import ACTUATOR_GAIN, SENSOR_DELAY, SENSOR_GAIN, SENSOR_LAG
from workbench.gap.effects.structural import MODAL_DAMPING, MODULUS_ERROR
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.prediction.noise import LEAST_LOGGED
from workbench.gap.search.finish import other_places
from workbench.gap.search.fit import Chord, Fit, cost_of, fit, parameters_of, slopes
from workbench.gap.search.jointly import (
    Step,
    are_plausible,
    beside_inputs,
    fit_jointly,
    likeliest_loss,
    measured,
    on_their_sides,
    opened,
    size_of,
)
from workbench.gap.search.plain import (
    COMMON,
    NO_COMMON,
    few_one_by_one,
    in_place_of_errors,
    is_hardly_late,
    is_like_errors,
    is_slight,
    late_effects,
    lateness,
    other_causes,
)
from workbench.gap.search.screening import fitted_ahead, one_more
from workbench.gap.search.search import Decision, Search, apart, best_of_each_kind, most_informative
from workbench.gap.search.settings import FINISH, JOINT, PLAIN, SEARCH, STEPWISE
from workbench.rig.simulate import is_stepped

TIMING = (SENSOR_DELAY, SENSOR_LAG)  # what makes a sensor late


class Stepwise:
    """Stepwise selection of effects beside nominal errors, with going back.

    Attributes:
        search: what it works on.
        tolerance: of the signal's rms: an effect that alters it by less in every record is not added.
        ahead: effects alone, without errors, fitted to predictions one sample ahead, best first; the first one is
            chosen among them too.
        at_first: the search without noise of the logged inputs.
        steps: the sets found, each with one effect more or one less than the last.
        plain: the effects of the last without errors of the nominal model, where they explain the records as well.
        is_beyond: whether effects cluster about one place, as they do where a law is beyond the catalogue.
        is_tried: whether an effect has been tried beside noise of the logged inputs, which may stand for it.
        is_finer: whether it goes on by finer substeps than it began with.
        is_run: whether effects have been added as long as that pays.
        singles: effects alone that are tried as the first; None for the likeliest one sample ahead.
        known: sets of one effect that were fitted afresh already; none of their kind is again.
    """

    def __init__(self, search: Search, tolerance: float = 0.0, ahead: Sequence[Fit] = ()) -> None:
        self.ahead = ahead
        self.singles: Sequence[tuple[Effect, ...]] | None = None
        self.known: Sequence[Step] = ()
        catalogue = tuple(kind for kind in search.catalogue if kind not in COMMON)
        self.search, self.tolerance = replace(search, catalogue=catalogue or search.catalogue), tolerance
        self.at_first = self.search
        self.is_tried = False
        self.is_finer = False
        self.is_run = False
        self.plain: Fit | None = None
        self.is_beyond = False
        search.report("small errors of the nominal model", 0.4)
        self.steps: list[Step] = []
        self.steps.append(self.afresh(()))
        self._with_input_noise(self.last)

    @property
    def last(self) -> Step:
        return self.steps[-1]

    @property
    def nearest(self) -> Step:
        """The last set, or the likeliest single effect beside errors, whichever leaves less."""
        return min((self.last, *self.alone), key=lambda s: s.fit.cost)

    @cached_property
    def alone(self) -> list[Step]:
        """The likeliest single effects beside errors that start from none, best first."""
        sets = [f.effects for f in self._likeliest_alone()] if self.singles is None else self.singles
        keys = {key_of(step.effects) for step in self.known}
        fresh = self.search.workers.map(self.afresh, [effects for effects in sets if key_of(effects) not in keys])
        found = [s for s in (*self.known, *fresh) if not self._may_be_errors(s)]
        best = sorted(found, key=lambda s: s.fit.cost)
        if not (best and self.explains(best[0]) and (self.search.by_mode or not self.is_believed)):
            return best
        # errors of each mode, or larger ones than a model has, close what any linear effect leaves: the one that they
        # are the least beside is it
        noise, a_number = best[0].noise_power, 0.0 if self.search.by_mode else self._a_number
        return sorted(found, key=lambda s: s.description(noise) + a_number * self._size(s)[0])

    def _likeliest_alone(self) -> list[Fit]:
        """The likeliest single effects one sample ahead, beside errors that give way; none that a simpler equals."""
        search = self.search
        sets = [f.effects for f in self.ahead if f.effects[0].kind not in COMMON]
        beside = replace(search, held=(self.last.errors,))
        without = cost_of(search.rig, beside.held, beside.ahead)
        found = [f for f in fitted_ahead(beside, sets) if beside.surely_better(f, without, f.n_parameters)]
        alike = self._like_errors
        if not (found or self.is_believed):  # errors that no model has are what leaves it nothing to do
            return alike[: STEPWISE.singles]
        chosen: list[Fit] = []
        for single in best_of_each_kind(found):
            comes_to = contained(single.effects, search.rig)
            as_likely = {f.key for f in found if f.cost < (1.0 + SEARCH.significant) * single.cost}
            if not comes_to & as_likely:
                chosen.append(single)
        chosen = [f for f in chosen[: STEPWISE.singles] if f.cost < STEPWISE.near * chosen[0].cost]
        # errors that have bent to an effect leave others to do what is left: the likeliest without them is tried too
        return chosen + [f for f in alike[:1] if f.key not in {other.key for other in chosen}]

    @property
    def _like_errors(self) -> list[Fit]:
        """The likeliest linear effects of the structure one sample ahead without errors, best first."""
        return best_of_each_kind([f for f in self.ahead if is_like_errors(f.effects[0].kind)])

    def without_errors(self) -> bool:
        """Whether few effects explain the records as well as errors of the nominal model that no model has."""
        if not (self.last.effects or self.last.is_plausible or self.search.logged):
            self.plain = self._without_errors(self.last)
            if self.plain is None:
                self._from_common_errors()
        return self.plain is not None

    def _from_common_errors(self) -> None:
        """Errors anew from those common to all along and to all modes, where these lead to smaller ones that do."""
        search = self.search
        errors = nominal_errors(search.rig, search.prior)
        if "stiffness_0" not in errors.values:
            return
        common = fit(search.rig, NO_COMMON, search.data)
        stiffness, damping = (float(np.log(effect.values["factor"])) for effect in common.effects)
        sizes = {name: damping for name in errors.values if group_of(name) == "damping"} | {"stiffness_0": stiffness}
        found = fit_jointly(search, (), nominal_errors(search.rig, search.prior, errors.values | sizes))
        if self.explains(found) and are_plausible(found.errors, damping=False):
            self.steps.append(found)

    def by_singles(self) -> bool:
        """Whether a likeliest single effect beside errors leaves next to nothing: then it is the first step."""
        if not self.alone or self.search.is_over:  # fits that were cut off tell no likeliest
            return False
        best = self.alone[0]
        beside = None if self.explains(best) else self._with_input_noise(best)
        if beside is not None:  # noise as loud may be all that errors leave
            best = beside
            self.steps[-1] = fit_jointly(self.search, self.last.effects, self.last.errors)
        left = best.excess(best.noise_power)
        if not self.explains(best) and left > STEPWISE.further * float(self.search.nominal.mean()):
            return False
        best = replace(self._simplest(best, self.alone[1:]), others=tuple(self.alone))
        if not (best.is_plausible and self._is_worth(best, self.last)):
            return False
        fewer = self._without_needless(best)
        without = None if fewer.effects else fit_jointly(self.search, (), fewer.errors)
        # all that it did was to lead the errors out of a false valley
        if without is not None and are_plausible(without.errors, damping=False):
            self.steps.append(without)
            return self.is_enough
        self.steps.append(best)
        self._with_input_noise(best)
        self.steps.append(self._finely(self.last))
        return True

    def _in_fewer_words(self) -> None:
        """A linear effect beside small errors, where errors that leave only noise without it are much longer to say.

        Only where the records surely prefer it as well: their noise is seldom what it is taken for.
        """
        alone, noise = self.last, self.last.noise_power
        longest = alone.description(noise) - STEPWISE.fewer_words
        if longest < 0.0:
            return
        sets = [f.effects for f in self._like_errors[: STEPWISE.finalists]]
        tried = [s for s in self.search.workers.map(self.afresh, sets) if s.is_plausible and not self._may_be_errors(s)]
        shorter = [s for s in tried if s.description(noise) < longest]
        found = [s for s in shorter if self._is_likelier(s, alone, least=SEARCH.trifle)]
        if found:
            best = min(found, key=lambda s: s.description(noise))
            if self._matter(best.effects, best.fit.effects):
                self.steps.append(replace(best, others=tuple(found)))

    def by_few(self) -> bool:
        """Whether few effects beside both common errors explain the records, where errors alone are not believed."""
        if self.is_believed or self.last.effects or self.search.logged:
            return False
        found = few_one_by_one(self.search, self.last, STEPWISE.most)
        if found is None or not self._matter(found.effects, found.effects):
            return False
        if all(effect.stands_out(self.search.rig) for effect in found.effects):
            self.plain = found
        return self.plain is not None

    def run(self, most: int = STEPWISE.most) -> None:
        """Add effects as long as each takes most of what is left above the noise, at most so many; once."""
        if self.is_run:
            return
        self.is_run = True
        if self.is_quiet and self.last.is_plausible and not (self.last.effects or self.search.by_mode):
            self._in_fewer_words()
        first = self.last
        if first.effects:  # where two hide, the errors may stand for one
            self.plain = self._without_errors(first)
        if self.plain is not None:
            return
        self._add(most)
        if self.calibrate():
            self._add(most)
        limit = self._in_limit(self.last)
        if limit is not self.last:
            self.steps.append(replace(limit, others=self.last.others))
        if not (first.effects and self.last is first):  # asked above
            self.plain = self._without_errors(self.last)
        if self.plain is not None:
            return
        self.steps.append(self._with_late(self._promoted(self.last)))
        if self.last.effects:
            self.steps.append(fit_jointly(self.search, self.last.effects, self.last.errors, rounds=3, to_the_end=True))

    def _add(self, most: int) -> None:
        """Add effects one after the other, at most so many in all."""
        while len(self.last.effects) < most and not (self.is_enough and self._is_spotless):
            if self.search.is_over:
                break
            before = self.last
            step = self._elsewhere(before) or self._with_one_more(before)
            if step is None:
                break
            self.steps.append(step)
            estimated = self.search.logged
            self._with_input_noise(step)
            if estimated and not self.search.logged:  # what stood beside a noise that is none stands anew
                self.steps[-1] = self._chosen_again(replace(self.last, others=step.others))
            self.steps.append(self._finely(self._without_needless(self.last)))
            if len(self.last.effects) <= len(before.effects) and not self._is_worth(self.last, before):
                break

    @property
    def is_enough(self) -> bool:
        """Whether the last set leaves nothing that is worth another effect."""
        left = self.explains(self.last) or (self.last.effects and self.unexplained < STEPWISE.further)
        return bool(left and self.last.is_plausible and (self.is_tried or not self.search.logged))

    @property
    def _is_spotless(self) -> bool:
        """Whether what the last set leaves above the noise is less than any effect would."""
        return self.last.excess(self.last.noise_power) < STEPWISE.spotless * float(self.last.noise_power.mean())

    def _finely(self, step: Step) -> Step:
        """The step by substeps that leave nothing of their own, where all but the noise is explained.

        The search goes on by them: what coarser ones leave calls for another effect.
        """
        rig, noise = apply_all(self.search.rig, step.fit.effects), step.noise_power
        near = step.excess(noise) < STEPWISE.further * self._gap
        if not (step.effects and near and is_stepped(rig)) or self.explains(step):
            return step
        data, substeps = self.search.data, self.search.data.substeps
        left = data.residual(rig)
        while substeps < FINISH.finest:
            finer = data.stepped(2 * substeps).residual(rig)
            moved, left = finer - left, finer
            if float(moved @ moved) < STEPWISE.stepping * moved.size:
                break
            substeps *= 2
        if substeps == data.substeps:
            return step
        self.is_finer = True
        self.search, self.at_first = (
            replace(each, data=each.data.stepped(substeps)) for each in (self.search, self.at_first)
        )
        return replace(fit_jointly(self.search, step.effects, step.errors, rounds=2), others=step.others)

    def _with_input_noise(self, step: Step) -> Step | None:
        """The step beside noise of the logged inputs, where that makes what it leaves all but white; None elsewhere.

        The search goes on beside that noise, as loud as what this step leaves shows it, and so do the steps before;
        without it where this step explains the records.
        """
        search = self.at_first
        plain = fit_jointly(search, step.effects, step.errors) if self.search.logged else measured(search, step.fit)
        loud = plain.excess(plain.sensor_noise) > STEPWISE.loud * float(plain.sensor_noise.mean())
        if plain.logged < LEAST_LOGGED or not loud:
            return self._go_on(search, step, plain) if self.search.logged else None
        beside = beside_inputs(search, step.fit, plain.sensor_noise)
        if beside is None:
            return None
        fitted = fit_jointly(beside, step.effects, step.errors)
        if fitted.fit.cost < STEPWISE.too_white:  # errors had bent to that noise, so it was estimated too loud
            beside = beside_inputs(search, fitted.fit, plain.sensor_noise)
            if beside is None:
                return None
            fitted = fit_jointly(beside, step.effects, fitted.errors)
        if fitted.fit.cost < STEPWISE.too_white:
            return None
        # so loud a noise takes most effects for its own; where one says as much, there is none
        found = None if step.effects or self.search.logged else self._in_place_of_inputs(plain)
        if found is not None:
            self.steps.append(found)
            return None
        return self._go_on(beside, step, fitted)

    def _go_on(self, search: Search, step: Step, fitted: Step) -> Step:
        """The step as it was fitted in another search, which goes on in that."""
        self.search, self.is_tried = search, False
        self.steps = [fitted if s is step else replace(measured(search, s.fit), others=s.others) for s in self.steps]
        return fitted

    def explains(self, step: Step) -> bool:
        """Whether next to nothing is left but noise of the sensors."""
        return step.excess(step.sensor_noise) < STEPWISE.no_gap * float(step.sensor_noise.mean())

    @property
    def unexplained(self) -> float:
        """Share of the nominal gap's power that the last set leaves above noise of sensors and logged inputs."""
        return float(self.last.excess(self.last.noise_power) / self._gap)

    @property
    def _gap(self) -> float:
        return max(float(np.maximum(self.search.nominal - self.last.noise_power, 0.0).mean()), 1e-12)

    @property
    def is_nothing(self) -> bool:
        """Whether errors of the nominal model alone explain the gap."""
        return not self.last.effects and self.is_closed

    @property
    def is_closed(self) -> bool:
        """Whether the last set leaves next to nothing but noise, or next to nothing of the gap."""
        return self.is_quiet or self.unexplained < STEPWISE.explained

    @property
    def is_quiet(self) -> bool:
        """Whether next to nothing is left but noise of sensors and logged inputs."""
        return self.last.excess(self.last.noise_power) < STEPWISE.no_gap * float(self.last.noise_power.mean())

    @property
    def is_believed(self) -> bool:
        """Whether a careful model may have the errors of the last set, those of damping apart: it is hardly known."""
        return self.plain is not None or are_plausible(self.last.errors, damping=False)

    @property
    def is_settled(self) -> bool:
        """Whether nothing is left to look for; what is left, and errors that no model has, may stand for effects."""
        if self.plain is not None:
            return True
        outcome = self.decision().outcome
        return self.is_quiet and (outcome == "none" or (outcome == "explained" and self.last.is_plausible))

    def decision(self) -> Decision:
        """What the effects of the last set explain."""
        beside = self.search if self.search.logged or self.is_finer else None
        if self.plain is not None:
            rivals = self._rivals_of_plain
            return Decision("explained", self.plain, rivals=rivals, noise=self.search.data.noise, beside=beside)
        effects, left = self.last.effects, self.unexplained
        noise = np.sqrt(self.last.sensor_noise) * self.search.data.noise
        closed = self.is_closed or (len(effects) > 1 and left < STEPWISE.in_part)
        if effects and closed and not self.is_beyond:
            return Decision("explained", self.last.fit, rivals=self._rivals(), noise=noise, beside=beside)
        if self.is_nothing:
            return Decision("none", self.last.fit, noise=noise, beside=beside)
        return Decision("part" if left < 0.5 else "unknown", self.last.fit, noise=noise, beside=beside)

    @cached_property
    def _rivals_of_plain(self) -> tuple[tuple[Fit, float], ...]:
        return () if self.plain is None else other_causes(self.search, self.plain)

    def _others(self) -> list[Step]:
        """The set that the effects of the last were chosen as, and other sets that leave only noise, or as little."""
        key = key_of(self.last.effects)
        chosen = next((s for s in reversed(self.steps) if s.others and key_of(s.effects) == key), None)
        if chosen is None:
            return []
        others = [s for s in chosen.others if key_of(s.effects) != key]
        return [chosen, *(s for s in others if self.explains(s) or self._is_alike(s, chosen))]

    def _rivals(self) -> tuple[tuple[Fit, float], ...]:
        """Other sets that leave as little, with their probabilities by description length.

        What differs between sets that all leave more than noise is a trifle, of which no law of chance is known.
        """
        sets = self._others()
        if not sets:
            return ()
        key, rig = key_of(sets[0].effects), self.search.rig
        sets = [s for s in sets if key not in contained(s.effects, rig)]
        noise, alike = sets[0].sensor_noise, not self.explains(sets[0])
        length = [s.description(noise, of_errors_alone=alike) + self._a_number * s.fit.n_parameters for s in sets]
        odds = np.exp(min(length) - np.array(length))
        likely = sorted(zip(sets[1:], odds[1:] / odds.sum(), strict=True), key=lambda each: -each[1])
        return tuple((s.fit, float(p)) for s, p in likely if p > STEPWISE.excluded)

    @property
    def _a_number(self) -> float:
        """Description length, nats, of a number."""
        return 0.5 * float(np.log(self.search.data.n_values))

    def _elsewhere(self, step: Step) -> Step | None:
        """The one linear effect of the structure at another place, where beside errors it leaves less than here.

        Errors of all waves bend to it wherever it is, and to first order they are what it is: it has a valley at every
        wave, and only fits tell which of them is the deepest.
        """
        if len(step.effects) != 1 or not is_like_errors(step.effects[0].kind) or step.effects[0].at is None:
            return None
        (effect,), domain = step.effects, self.search.rig.modes.domain
        self.search.report("the same effect elsewhere", 0.6)
        places = [(effect.moved_to(where),) for where in other_places(effect, domain)]
        here, *others = self._fitted([(effect,), *places], step, self._slopes(step))
        near = [s for s in others if apart(s.effects[0], here.effects[0], domain)]
        best = min(near, key=lambda s: s.fit.cost, default=None)
        if best is None or best.fit.cost > STEPWISE.near * here.fit.cost:
            return None
        found = self._whole(best)
        return found if self._loss(found) < self._loss(step) else None

    def _with_one_more(self, step: Step) -> Step | None:
        """The best set with one more effect, where it takes most of what is left."""
        self.is_tried = True
        tried = self._with_each(step)
        if not tried:
            return None
        sided = self._on_the_other_side(step, tried)
        if sided is not None:
            self.steps[-1] = sided
            return self._with_one_more(sided)
        best = self._best_of(tried, step)
        if not self._is_worth(best, step):
            return None
        self.is_beyond = self.search.clustered(best.effects)
        return None if self.is_beyond else best

    def _with_each(self, step: Step) -> list[Step]:
        """The likeliest sets with one more effect, fitted to the most telling records."""
        quick, first = most_informative(self.search.data, step.fit.cost_by_channel)
        self.search = search = replace(self.search, quick=quick, first=first)
        search.report("another effect beside small errors of the model", 0.5 + 0.1 * len(step.effects))
        # errors fitted to whole records have taken what they can: what they leave tells of an effect that is missing
        beside = search.beside(step.errors)
        rig = apply_all(search.rig, step.fit.effects)
        residual = beside.ahead.residual(rig)
        left = float(residual @ residual) / residual.size
        evidence = Evidence.of(rig, search.data, workers=search.workers, bent=True)
        ahead = one_more(beside, step.effects, evidence)
        if not ahead or ahead[0].cost > (1.0 - STEPWISE.ahead) * left:
            return []
        promising, as_good = (left - share * (left - ahead[0].cost) for share in (STEPWISE.promising, STEPWISE.as_good))
        chosen: list[tuple[Effect, ...]] = []
        for candidate in ahead:
            alike = sum(candidate.effects[-1].kind is others[-1].kind for others in chosen)
            if candidate.cost <= promising and alike < (2 if candidate.cost <= as_good else 1):
                chosen.append(candidate.effects)
        chosen = [*chosen[: STEPWISE.candidates], *more_general_sets(step.effects)]
        return self._fitted(chosen, step, self._slopes(step))

    def _in_place_of_inputs(self, step: Step) -> Step | None:
        """The step with one more effect that leaves only noise of the sensors, as noise of the inputs never does."""
        near = [s for s in self._with_each(step) if s.fit.cost < PLAIN.near and not self._may_be_errors(s)]
        near = sorted(near, key=lambda s: s.fit.cost)[: STEPWISE.finalists]
        whole = self.search.workers.map(self._whole, near)
        found = [s for s in whole if self.explains(s) and s.is_plausible and self._is_worth(s, step)]
        return self._simplest_of(sorted(found, key=lambda s: s.fit.cost)) if found else None

    def _on_the_other_side(self, step: Step, tried: Sequence[Step]) -> Step | None:
        """The step with an accelerometer late that the likeliest set has late; no small delay leads past its jumps."""
        best = min(tried, key=lambda s: s.fit.cost)
        prior, late = step.errors.target, best.effects[-1]
        if late.kind not in TIMING or prior.interpolated or not self._is_timing(best, TIMING):
            return None
        jumping = {sensor.name for sensor in self.search.rig.sensors if sensor.quantity == "acceleration"}
        if late.target not in jumping.difference(prior.late):
            return None
        errors = opened(self.search, step.errors)
        early = tuple(name for name in prior.early if name != late.target)
        target = replace(errors.target, late=(*prior.late, late.target), early=early)
        delay = lateness(late) / prior.sample_time
        values = {**errors.values, f"delay_{late.target}": delay}
        sided = fit_jointly(self.search, step.effects, nominal_errors(self.search.rig, target, values))
        return sided if sided.fit.cost < step.fit.cost else None

    def _best_of(self, tried: Sequence[Step], step: Step) -> Step:
        """The best on whole records of sets fitted to the most telling ones."""
        # and of what was found before errors could bend to it
        alone = [] if step.effects else self.alone
        tried = sorted((s for s in tried if not self._may_be_errors(s)), key=self._loss)
        near = [s for s in tried if s.fit.cost < STEPWISE.near * tried[0].fit.cost][: STEPWISE.finalists]
        whole = self.search.workers.map(lambda s: self._without_idle(self._whole(s)), near)
        whole = sorted((*whole, *alone), key=self._loss)
        return self._simplest_of(whole) if whole else step

    def _simplest_of(self, sets: Sequence[Step]) -> Step:
        """The simplest of sets that are as good as the first of them, the best."""
        return replace(self._simplest(sets[0], sets[1:]), others=tuple(sets))

    def _chosen_again(self, step: Step) -> Step:
        """The best of the sets that a step was chosen from, in another search."""
        others = [s for s in step.others if key_of(s.effects) != key_of(step.effects)]
        others = self.search.workers.map(self._whole, others)
        return self._simplest_of(sorted((step, *others), key=self._loss))

    def _loss(self, step: Step) -> float:
        """What sets of a search are compared by, the less the better."""
        if not self.search.logged:
            return step.fit.cost
        return likeliest_loss(self.search, apply_all(self.search.rig, step.fit.effects))

    def _is_worth(self, best: Step, step: Step) -> bool:
        """Whether a set takes enough of what a smaller one leaves, or makes errors small that were too large."""
        if not self._matter(best.effects, best.fit.effects):
            return False
        # where errors explain the records, late sensors among them, one more that is late is no effect
        asked = self.explains(step) and not self._is_timing(best, TIMING)
        if (self.search.logged or asked) and self._is_likelier(best, step):
            return True
        noise = np.minimum(best.sensor_noise, step.sensor_noise)
        before, after = step.excess(noise), best.excess(noise)
        trifle = bool(step.effects) and before - after < STEPWISE.least * self._gap
        worth = STEPWISE.further_excess if step.effects and not trifle else STEPWISE.excess
        if not self.explains(step) and before - after > worth * before:
            return True
        saved = step.description(noise, of_errors_alone=trifle) - best.description(noise, of_errors_alone=trifle)
        return not step.is_plausible and saved > STEPWISE.shorter

    def _is_likelier(self, best: Step, step: Step, least: float = SEARCH.significant) -> bool:
        """Whether records surely prefer a set to a smaller one, by more than a model is imperfect."""
        more, gain = max(best.fit.n_parameters - step.fit.n_parameters, 1), self._gain(best, step)
        return gain > least and self.search.pays(gain, more)

    def _gain(self, best: Step, step: Step) -> float:
        """Twice the log-likelihood that one step has more than another, a value."""
        if not self.search.logged:
            return float(np.log(step.fit.cost / best.fit.cost))
        # each beside as much noise of the inputs as it leaves: where that stands for an effect it is loud
        losses = [likeliest_loss(self.search, apply_all(self.search.rig, s.fit.effects)) for s in (best, step)]
        return 2.0 * (losses[1] - losses[0]) / self.search.data.n_values

    def _without_idle(self, step: Step) -> Step:
        """The step without effects that alter nothing any more: another stands in their place."""
        kept = self._altering(step.effects, step.fit.effects)
        if len(kept) in (0, len(step.effects)):
            return step
        return self._without_idle(fit_jointly(self.search, kept, step.errors, rounds=2))

    def _matter(self, effects: Sequence[Effect], beside: Sequence[Effect]) -> bool:
        """Whether each of some effects of a set alters the readings."""
        return len(self._altering(effects, beside)) == len(effects)

    def _altering(self, effects: Sequence[Effect], beside: Sequence[Effect]) -> tuple[Effect, ...]:
        """Those effects of a set that alter the readings by more than the tolerance, in some record."""
        data, rig = self.search.data, self.search.rig
        scales = [record.outputs.std(axis=1, keepdims=True) for record in data.counted]
        whole = data.predictions(apply_all(rig, beside))

        def altered(effect: Effect) -> float:
            others = [e for e in beside if e is not effect]
            if not can_be(rig, others):  # what the others need to be at all alters all
                return np.inf
            without = data.predictions(apply_all(rig, others))
            each = zip(whole, without, scales, strict=True)
            return max(float(np.sqrt((((a - b) / scale) ** 2).mean())) for a, b, scale in each)

        return tuple(effect for effect in effects if altered(effect) > self.tolerance)

    def _may_be_errors(self, step: Step) -> bool:
        """Whether an effect of a set is what the model may be off by at a port, which errors beside it are too."""
        return self._is_timing(step) or any(is_slight(effect, self.search.rig) for effect in step.effects)

    def _is_timing(self, step: Step, kinds: Collection[Kind] = (SENSOR_DELAY,)) -> bool:
        """Whether an effect of a set is what the timing of a sensor may be off by: late by less than believed."""
        return any(is_hardly_late(effect, self.search) for effect in step.effects if effect.kind in kinds)

    def _slopes(self, step: Step) -> np.ndarray:
        """Sensitivities (n_values, n_errors) to errors beside the effects of a step, on the most telling records."""
        search = self.search
        return slopes(search.rig, (step.errors,), search.quick, step.effects, search.workers)[1]

    def _fitted(self, sets: Sequence[tuple[Effect, ...]], step: Step, known: np.ndarray) -> list[Step]:
        """Sets that can be, beside errors that start as those of a step, fitted to the most telling records."""
        return self.search.workers.map(
            lambda effects: fit_jointly(self.search, effects, step.errors, rounds=2, known=known),
            [effects for effects in sets if can_be(self.search.rig, (*effects, step.errors))],
        )

    def afresh(self, effects: tuple[Effect, ...]) -> Step:
        """The effects beside errors that start from none, fitted to all records.

        Where frequencies are off, motions of whole records run out of step; predictions one sample ahead show the way.
        """
        search = self.search
        none = nominal_errors(search.rig, search.prior)
        effects = nearest_possible(search.rig, effects, (none,))  # errors that are gone now may have held them
        none = on_their_sides(search, none, effects)
        ahead = self._ahead(effects, none)
        *others, errors = ahead.effects
        # with frequencies set right the sides show better
        again = on_their_sides(search, replace(errors, target=replace(errors.target, late=(), early=())), others)
        if again.target.late != none.target.late:
            ahead = min(ahead, self._ahead(others, again), key=lambda each: each.cost)
        straight = self._interpolated(ahead)
        if straight is not ahead:
            ahead, none = straight, nominal_errors(search.rig, replace(search.prior, interpolated=True))
        found = fit_jointly(search, ahead.effects[:-1], ahead.effects[-1])
        if search.by_mode or found.excess(found.noise_power) < STEPWISE.astray * float(search.nominal.mean()):
            return found
        return min(found, fit_jointly(search, effects, none), key=lambda s: s.fit.cost)

    def _interpolated(self, ahead: Fit) -> Fit:
        """The fit one sample ahead, or that of sensors which are late by straight lines, where it leaves less."""
        *effects, errors = ahead.effects
        delays = {name: value for name, value in errors.values.items() if group_of(name) == "delay"}
        is_late = any(effect.kind in TIMING for effect in effects)
        seen = is_late or max(map(abs, delays.values()), default=0.0) > JOINT.surely_late
        if not seen and (effects or ahead.cost < JOINT.straight):
            return ahead
        prior = replace(self.search.prior, interpolated=True)
        straight = self._ahead(effects, nominal_errors(self.search.rig, prior, delays))
        return min(ahead, straight, key=lambda each: each.cost)

    def _ahead(self, effects: Sequence[Effect], errors: Effect) -> Fit:
        """Effects and errors fitted to predictions one sample ahead, by slopes taken anew as long as the cost falls."""
        search = self.search

        def on(sets: Sequence[Effect]) -> Fit:
            return fit(
                search.rig, sets, search.ahead, iterations=JOINT.iterations, workers=search.workers, chord=Chord()
            )

        found = on((*effects, errors))
        for _ in range(JOINT.anew - 1):
            if found.falling < JOINT.still:
                break
            found = on(found.effects)
        return found

    def _whole(self, step: Step) -> Step:
        """The step fitted to all records.

        Errors that were fitted before an effect was there have bent to it, and may be in another valley, so they start
        from none; and only where that does not explain the records, from what they were, too.
        """
        fresh = self.afresh(step.effects)
        if self.explains(fresh):
            return fresh
        return min(fresh, fit_jointly(self.search, step.effects, step.errors, rounds=2), key=lambda s: s.fit.cost)

    def _simplest(self, best: Step, tried: Sequence[Step]) -> Step:
        """The best, or a set that it comes to at bounds of its parameters, where that leaves hardly more."""
        equals = [s for s in (best, *tried) if len(s.effects) > 1 and not self._tells_apart(best, s)]
        fresh = [
            *simpler_sets(best.effects, self.search.rig),
            *merged_sets(best.effects),
            *(fewer for s in equals for fewer in each_left_out(s.effects)),
        ]
        quickly = self._fitted(fresh, best, self._slopes(best) if fresh else np.zeros((0, 0)))
        sets = [*tried, *self._on_all(quickly, best), *self._simpler_singles(best)]
        # large errors do what the effect did that is left out
        sets = [s for s in sets if s.is_plausible or not best.is_plausible]
        # a form of as many numbers may be the better one: friction, of a hysteretic spring that always slides
        best = min((best, *(s for s in sets if self._size(s) == self._size(best))), key=lambda s: s.fit.cost)
        enough = (1.0 + STEPWISE.simpler) * max(best.excess(best.sensor_noise), STEPWISE.simpler)
        limits = contained(best.effects, self.search.rig)
        fewer = [
            step
            for step in sets
            if (self._size(step) < self._size(best) or key_of(step.effects) in limits)
            and step.excess(best.sensor_noise) < enough
            and not self._tells_apart(best, step)
        ]
        return min(fewer, key=lambda s: (self._size(s), s.fit.cost)) if fewer else best

    def _on_all(self, quickly: Sequence[Step], best: Step) -> list[Step]:
        """The sets, fitted to all records where they may be as good as the best, which was fitted to all of them."""
        if not self.explains(best):
            return list(quickly)
        near = max(STEPWISE.near * best.fit.cost, STEPWISE.least * self._gap)
        return self.search.workers.map(
            lambda s: fit_jointly(self.search, s.effects, s.errors, rounds=2) if s.fit.cost < near else s,
            list(quickly),
        )

    def _in_limit(self, step: Step) -> Step:
        """The set as what it comes to at bounds of its parameters, where what is left for good is more than noise.

        What is left of a measured gap bends to any law: a trifle of it is no reason for a wider one.
        """
        if self.explains(step):
            return step
        sets = list(with_one_simpler(step.effects, self.search.rig))
        limits = self._fitted(sets, step, self._slopes(step)) if sets else []
        alike = [s for s in self.search.workers.map(self._whole, limits) if self._is_alike(s, step)]
        return self._in_limit(min(alike, key=lambda s: s.fit.cost)) if alike else step

    def _is_alike(self, step: Step, best: Step) -> bool:
        """Whether a set leaves more than the best by a trifle of a gap that this does not close, or less.

        Not by errors that no model has: they may stand in for an effect.
        """
        more = step.excess(best.sensor_noise) - best.excess(best.sensor_noise)
        return step.is_plausible and not self.explains(best) and more < STEPWISE.least * self._gap

    def _simpler_singles(self, best: Step) -> list[Step]:
        """Effects of fewer numbers that are all but as good as a set of one, one sample ahead and on whole records."""
        if len(best.effects) != 1 or not self.ahead:
            return []
        size = len(parameters_of(self.search.rig, best.effects))
        nominal = self.search.nominal_ahead
        good = nominal - STEPWISE.as_good * (nominal - self.ahead[0].cost)
        likely = [f.effects for f in best_of_each_kind(self.ahead) if f.cost <= good and f.n_parameters < size]
        quickly = self._fitted(likely, best, self._slopes(best)) if likely else []
        return [self._whole(step) for step in quickly if step.fit.cost < STEPWISE.near * best.fit.cost]

    def _size(self, step: Step) -> tuple[int, int]:
        """How many numbers and effects a set has: of as many numbers, one effect is simpler than two."""
        return len(parameters_of(self.search.rig, step.effects)), len(step.effects)

    def _tells_apart(self, best: Step, simpler: Step) -> bool:
        """Whether, where only noise is left, records surely prefer a set to a simpler one, by more than a trifle."""
        more, gain = best.fit.n_parameters - simpler.fit.n_parameters, self._gain(best, simpler)
        return self.explains(best) and self.search.pays(gain, more)

    def _without_needless(self, step: Step) -> Step:
        """The set without effects that a later one has made needless."""
        if not step.effects:
            return step
        fewer = self._fitted(list(each_left_out(step.effects)), step, self._slopes(step))
        best = min(fewer, key=lambda s: s.fit.cost)
        enough = (1.0 + STEPWISE.needless) * max(step.excess(step.sensor_noise), STEPWISE.simpler)
        needless = best.excess(step.sensor_noise) < enough and (best.is_plausible or not step.is_plausible)
        return self._without_needless(best) if needless else step

    def _without_errors(self, step: Step) -> Fit | None:
        """Few effects that explain the records without errors of the nominal model as well as a step beside them."""
        if not self.is_closed:
            return None
        search = self.search.with_noise(np.sqrt(step.sensor_noise) * self.search.data.noise)
        if step.logged > LEAST_LOGGED and not self.search.logged:
            search = beside_inputs(self.at_first, step.fit, step.sensor_noise) or search
        key, rig = key_of(step.effects), self.search.rig
        rivals = [s.effects for s in self._others()[1:] if key not in contained(s.effects, rig)]
        found = in_place_of_errors(search, step, rivals)
        if found is None:
            return None
        # both common errors are errors of the model; one alone is an effect
        errors = {NOMINAL_ERRORS, *(COMMON if {e.kind for e in found.effects}.issuperset(COMMON) else ())}
        named = [effect for effect in found.effects if effect.kind not in errors]
        if not self._matter(named, found.effects):
            return None
        self.search = search
        return found

    def calibrate(self) -> bool:
        """Take gains that are off by more than any calibration for effects; whether there are any."""
        found = self._with_wrong_gains(self.last)
        if found is self.last:
            return False
        self.steps.append(found)
        return True

    def _with_wrong_gains(self, step: Step, most: int = PLAIN.wrong_gains) -> Step:
        """The set with gains that are off by more than any calibration, each far from the others, as effects."""
        gains = {n: v for n, v in step.errors.values.items() if group_of(n) == "gain"}
        name = max(gains, key=lambda n: abs(gains[n]), default="")
        if not most or abs(gains.get(name, 0.0)) < PLAIN.suspect * PLAIN.most_gain:
            return step
        _, side, port = name.split("_", 2)
        kind = {"of": ACTUATOR_GAIN, "at": SENSOR_GAIN}[side]
        effect = Effect(kind, port, {"gain": float(np.exp(gains[name]))})
        found = self.afresh((*step.effects, effect))  # others have bent to it
        off = abs(float(np.log(found.effects[-1].values["gain"])))
        is_wrong = off >= max(PLAIN.most_gain, PLAIN.outlying * size_of(found.errors, "gain"))
        if not (is_wrong and self._matter(found.effects, found.fit.effects)):
            return step
        return self._with_wrong_gains(found, most - 1)

    def _promoted(self, step: Step) -> Step:
        """The set with errors too large to be small and common to all as effects."""
        values = step.errors.values
        damping = float(np.mean([v for n, v in values.items() if group_of(n) == "damping"] or [0.0]))
        stiffness = values.get("stiffness_0", 0.0) - values.get("mass_0", 0.0)
        named = {effect.kind for effect in step.effects}
        added, reset, most = [], dict(values), dict(PLAIN.most_common)
        if abs(damping) > most["modal_damping"] and MODAL_DAMPING not in named:
            added.append(Effect(MODAL_DAMPING, None, {"factor": float(np.exp(damping))}))
            reset.update({n: v - damping for n, v in values.items() if group_of(n) == "damping"})
        if abs(stiffness) > most["modulus_error"] and MODULUS_ERROR not in named:
            added.append(Effect(MODULUS_ERROR, None, {"factor": float(np.exp(stiffness))}))
            reset.update({"stiffness_0": 0.0, "mass_0": 0.0})
        if not added:
            return step
        return fit_jointly(self.search, (*step.effects, *added), replace(step.errors, values=reset), rounds=2)

    def _with_late(self, step: Step) -> Step:
        """The set with sensors that are late for one cause as that effect, where this leaves no more.

        A trifle of the gap stays an error.
        """
        search, target, named = self.search, step.errors.target, {effect.kind for effect in step.effects}
        late = [effect for effect in late_effects(search.rig, step.errors) if effect.kind not in named]
        late = [effect for effect in late if self._matter([effect], [*step.effects, effect])]
        if not late:
            return step
        punctual = {n: 0.0 if group_of(n) == "delay" else v for n, v in step.errors.values.items()}
        errors = nominal_errors(search.rig, replace(target, late=(), early=(), interpolated=False), punctual)
        each = search.workers.map(lambda e: fit_jointly(search, (*step.effects, e), errors, rounds=2), late)
        best, *others = sorted(each, key=lambda s: s.fit.cost)
        effect = best.effects[-1]
        if self._is_likelier(step, best) or not effect.stands_out(search.rig):
            return step
        share = cost_of(search.rig, (*step.effects, errors), search.data) - best.fit.cost
        if share < STEPWISE.explained * self._gap or not self._matter([effect], best.effects):
            return step
        return replace(best, others=(best, *others))
