"""Stepwise selection of effects, each fitted jointly with small errors of the nominal model."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from workbench.gap.effects.effect import (
    Effect,
    apply_all,
    contained,
    each_left_out,
    key_of,
    merged_sets,
    more_general_sets,
    simpler_sets,
    with_one_simpler,
)
from workbench.gap.effects.nominal import NOMINAL_ERRORS, group_of, nominal_errors
from workbench.gap.effects.ports import ACTUATOR_GAIN, SENSOR_GAIN
from workbench.gap.effects.structural import MODAL_DAMPING, MODULUS_ERROR
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.prediction.noise import LEAST_LOGGED
from workbench.gap.search.candidates import TIMING, fit_from_zero, fitted_to_all, fitted_to_quick
from workbench.gap.search.finish import other_places
from workbench.gap.search.fit import Fit, cost_of, fit, parameters_of
from workbench.gap.search.jointly import (
    Step,
    are_plausible,
    evaluated,
    fit_jointly,
    size_of,
    with_all_groups,
    with_input_noise,
    with_reading_sides,
)
from workbench.gap.search.plain import (
    NO_UNIFORM_ERROR,
    UNIFORM,
    delay_effects,
    delay_of,
    few_with_uniform_errors,
    in_place_of_nominal_errors,
    is_linear_structural,
    other_delay_causes,
    with_common_delay,
)
from workbench.gap.search.preference import (
    is_likelier,
    is_timing,
    loss,
    may_be_port_errors,
    noticeable,
    size_of_set,
    surely_prefers,
)
from workbench.gap.search.screening import fitted_ahead, one_more
from workbench.gap.search.search import Decision, Search, apart, best_of_each_kind, most_informative
from workbench.gap.search.settings import FINISH, PLAIN, SEARCH, STEPWISE
from workbench.rig.simulate import is_stepped


class Stepwise:
    """Stepwise selection of effects, fitted jointly with nominal errors: forward, with backward elimination.

    Attributes:
        search: records, nominal rig and candidate kinds.
        tolerance: share of the signal's rms; an effect that alters every record by less is not added.
        ahead: fits of single effects to one-step-ahead predictions without nominal errors, best first; candidates for
            the first effect.
        at_first: the search without input noise.
        steps: the sets of effects selected so far; each has one effect more or one less than the one before.
        plain: the last set without nominal errors, if it explains the records as well.
        shows_unknown_law: whether nonlinear effects cluster at one place: the catalogue lacks the law.
        tried_beside_input_noise: whether an effect has been tried with the current model of input noise, which can
            mask an effect.
        has_finer_substeps: whether the time step was refined during the selection.
        is_run: whether `run` was called.
        singles: single effects that are tried as the first; None for the likeliest by one-step-ahead prediction.
        known: fits of single effects that are not repeated.
    """

    def __init__(self, search: Search, tolerance: float = 0.0, ahead: Sequence[Fit] = ()) -> None:
        self.ahead = ahead
        self.singles: Sequence[tuple[Effect, ...]] | None = None
        self.known: Sequence[Step] = ()
        catalogue = tuple(kind for kind in search.catalogue if kind not in UNIFORM)
        self.search, self.tolerance = replace(search, catalogue=catalogue or search.catalogue), tolerance
        self.at_first = self.search
        self.tried_beside_input_noise = False
        self.has_finer_substeps = False
        self.is_run = False
        self.plain: Fit | None = None
        self.shows_unknown_law = False
        search.report("small errors of the nominal model", 0.4)
        self.steps: list[Step] = []
        self.steps.append(fit_from_zero(self.search, ()))
        self._with_input_noise(self.last)

    @property
    def last(self) -> Step:
        """The last set."""
        return self.steps[-1]

    @property
    def nearest(self) -> Step:
        """The last set or the best single effect with nominal errors, whichever has the smaller residual."""
        return min((self.last, *self.fitted_singles), key=lambda s: s.fit.cost)

    @cached_property
    def fitted_singles(self) -> list[Step]:
        """Single effects, each fitted jointly with nominal errors that start from zero, best first."""
        sets = [f.effects for f in self._likeliest_singles()] if self.singles is None else self.singles
        keys = {key_of(step.effects) for step in self.known}
        fresh = self._from_zero([effects for effects in sets if key_of(effects) not in keys])
        found = [s for s in (*self.known, *fresh) if not may_be_port_errors(self.search, s)]
        best = sorted(found, key=lambda s: s.fit.cost)
        if not best or (self.has_plausible_errors and not self.search.by_mode):
            return best
        # nominal errors of each mode, or implausibly large ones, absorb the residual of any linear effect: of effects
        # that leave as little, the one that needs the smallest nominal errors is preferred
        noise, nats_per_parameter = best[0].noise_power, 0.0 if self.search.by_mode else self.search.nats_per_parameter
        little = best[0].excess(noise) + STEPWISE.no_gap * float(noise.mean())
        as_good = found if best[0].explains else [s for s in best if s.excess(noise) < little]
        others = [s for s in best if s not in as_good]
        return [
            *sorted(as_good, key=lambda s: s.description(noise) + nats_per_parameter * size_of_set(self.search, s)[0]),
            *others,
        ]

    def _likeliest_singles(self) -> list[Fit]:
        """The best single effects by one-step-ahead prediction, nominal errors re-estimated to first order.

        An effect is left out if a limiting case of it fits as well.
        """
        search = self.search
        sets = [f.effects for f in self.ahead if f.effects[0].kind not in UNIFORM]
        with_errors = replace(search, held=(self.last.errors,))
        without = cost_of(search.rig, with_errors.held, with_errors.ahead)
        found = [f for f in fitted_ahead(with_errors, sets) if with_errors.surely_better(f, without, f.n_parameters)]
        linear = self._linear_singles
        if not (found or self.has_plausible_errors):  # implausibly large nominal errors have absorbed the effect
            return linear[: STEPWISE.singles]
        chosen: list[Fit] = []
        for single in best_of_each_kind(found):
            limiting_cases = contained(single.effects, search.rig)
            fits_as_well = {f.key for f in found if f.cost < (1.0 + SEARCH.significant) * single.cost}
            if not limiting_cases & fits_as_well:
                chosen.append(single)
        chosen = [f for f in chosen[: STEPWISE.singles] if f.cost < STEPWISE.near * chosen[0].cost]
        # nominal errors may have absorbed an effect, so the best one without nominal errors is tried too
        return chosen + [f for f in linear[:1] if f.key not in {other.key for other in chosen}]

    @property
    def _linear_singles(self) -> list[Fit]:
        """The best linear effect of each structural kind by one-step-ahead prediction without nominal errors."""
        return best_of_each_kind([f for f in self.ahead if is_linear_structural(f.effects[0].kind)])

    def without_errors(self) -> bool:
        """Whether few effects explain the records as well as implausibly large nominal errors; sets `plain`."""
        if not (self.last.effects or self.last.is_plausible or self.search.logged):
            self.plain = self._without_errors(self.last)
            if self.plain is None:
                self._from_common_errors()
        return self.plain is not None

    def _from_common_errors(self) -> None:
        """Refit the nominal errors from uniform errors of stiffness and damping; kept if plausible and explaining."""
        search = self.search
        errors = nominal_errors(search.rig, search.prior)
        if "stiffness_0" not in errors.values:
            return
        uniform = fit(search.rig, NO_UNIFORM_ERROR, search.data)
        stiffness, damping = (float(np.log(effect.values["factor"])) for effect in uniform.effects)
        sizes = {name: damping for name in errors.values if group_of(name) == "damping"} | {"stiffness_0": stiffness}
        found = fit_jointly(search, (), nominal_errors(search.rig, search.prior, errors.values | sizes))
        if found.explains and are_plausible(found.errors, damping=False):
            self.steps.append(found)

    def by_singles(self) -> bool:
        """Whether a single effect with nominal errors explains the records; it is then the first step."""
        if not self.fitted_singles or self.search.is_over:  # the order of unfinished fits means nothing
            return False
        best = self.fitted_singles[0]
        with_noise = None if best.explains else self._with_input_noise(best)
        if with_noise is not None:  # the residual of the nominal errors alone may be that input noise
            best = with_noise
            self.steps[-1] = fit_jointly(self.search, self.last.effects, self.last.errors)
        excess = best.excess(best.noise_power)
        if not best.explains and excess > STEPWISE.further * float(self.search.nominal.mean()):
            return False
        best = replace(self._simplest(best, self.fitted_singles[1:]), others=tuple(self.fitted_singles))
        # quiet noise of the inputs excites weak modes in the prediction alone, which large damping makes up for
        only_damping = not self.has_plausible_errors and are_plausible(best.errors, damping=False)
        if not ((best.is_plausible or only_damping) and self._is_accepted(best, self.last)):
            return False
        reduced = self._backward_eliminated(best)
        errors_only = None if reduced.effects else fit_jointly(self.search, (), reduced.errors)
        # the effect only led the nominal errors out of a local minimum
        if errors_only is not None and are_plausible(errors_only.errors, damping=False):
            self.steps.append(errors_only)
            return self.is_sufficient
        self.steps.append(best)
        self._with_input_noise(best)
        self.steps.append(self._with_finer_substeps(self.last))
        return True

    def _by_shorter_description(self) -> None:
        """Add a linear effect if its description length is well below that of nominal errors alone (MDL).

        The likelihood must prefer it too: the noise is seldom exactly as modelled.
        """
        errors_only, noise = self.last, self.last.noise_power
        length_limit = errors_only.description(noise) - STEPWISE.fewer_words
        if length_limit < 0.0:
            return
        sets = [f.effects for f in self._linear_singles[: STEPWISE.finalists]]
        tried = [s for s in self._from_zero(sets) if s.is_plausible and not may_be_port_errors(self.search, s)]
        shorter = [s for s in tried if s.description(noise) < length_limit]
        if not shorter:
            return
        # iterated as far as the effects, the errors alone may describe the records as briefly
        errors_only = fit_jointly(self.search, (), errors_only.errors, rounds=3, until_convergence=True)
        length_limit = errors_only.description(noise) - STEPWISE.fewer_words
        shorter = [s for s in shorter if s.description(noise) < length_limit]
        found = [s for s in shorter if is_likelier(self.search, s, errors_only, least=SEARCH.trifle)]
        if found:
            best = min(found, key=lambda s: s.description(noise))
            if self._are_noticeable(best.effects, best.fit.effects):
                self.steps.append(replace(best, others=tuple(found)))

    def by_few(self) -> bool:
        """Whether few effects with uniform stiffness and damping errors explain the records; sets `plain`.

        Tried only if the nominal errors alone are implausible.
        """
        if self.has_plausible_errors or self.last.effects or self.search.logged:
            return False
        found = few_with_uniform_errors(self.search, self.last, STEPWISE.most)
        if found is None or not self._are_noticeable(found.effects, found.effects):
            return False
        if all(effect.stands_out(self.search.rig) for effect in found.effects):
            self.plain = found
        return self.plain is not None

    def by_almost_alone(self, singles: Sequence[Fit]) -> bool:
        """Whether one effect closes nearly all of the gap alone, and the rest with nominal errors; it is then a step.

        Tried only if nominal errors alone are implausible, and explain the records or leave more than the effect alone
        does. With the effect they may be as large: those of a few modes of an identified rig make up for its missing
        modes. One effect then replaces errors of all the other modes.

        Args:
            singles: fitted to whole records without nominal errors, best first.
        """
        if self.has_plausible_errors or self.last.effects or not singles:
            return False
        search, best = self.search, singles[0]
        if not (self.is_noise_only or best.cost < self.last.fit.cost):
            return False
        if not search.near(best, STEPWISE.almost) or any(effect.kind in UNIFORM for effect in best.effects):
            return False
        errors = with_reading_sides(search, nominal_errors(search.rig, search.prior), best.effects)
        found = fit_jointly(search, best.effects, errors, until_convergence=True)
        if may_be_port_errors(self.search, found) or not (
            found.explains and self._are_noticeable(found.effects, found.fit.effects)
        ):
            return False
        self.steps.append(found)
        self.is_run = not found.is_plausible  # errors that are large absorb the effect at any other place too
        return True

    def run(self, most: int = STEPWISE.most) -> None:
        """Add effects, `most` in all, as long as each removes most of the residual power above the noise; once."""
        if self.is_run:
            return
        self.is_run = True
        if self.is_noise_only and self.last.is_plausible and not (self.last.effects or self.search.by_mode):
            self._by_shorter_description()
        first = self.last
        if first.effects:  # of two effects, the nominal errors may have absorbed one
            self.plain = self._without_errors(first)
        if self.plain is not None:
            return
        self._add(most)
        if self.calibrate():
            self._add(most)
        limit = self._limiting_case(self.last)
        if limit is not self.last:
            self.steps.append(replace(limit, others=self.last.others))
        if not (first.effects and self.last is first):  # otherwise done above
            self.plain = self._without_errors(self.last)
        if self.plain is not None:
            return
        self.steps.append(self._with_delay_as_effect(self._with_common_effects(self.last)))
        if self.last.effects:
            self.steps.append(
                fit_jointly(self.search, self.last.effects, self.last.errors, rounds=3, until_convergence=True)
            )

    def _add(self, most: int) -> None:
        """Add effects one after the other, `most` in all."""
        while len(self.last.effects) < most and not (self.is_sufficient and self._is_exhausted):
            if self.search.is_over:
                break
            before = self.last
            step = (
                self._with_another_law(before)
                or self._at_another_place(before)
                or self._with_an_absorbed(before)
                or self._with_one_more(before)
            )
            if step is None:
                break
            self.steps.append(step)
            estimated = self.search.logged
            self._with_input_noise(step)
            if estimated and not self.search.logged:  # the input noise was none, so the choice is made again
                self.steps[-1] = self._reselected(replace(self.last, others=step.others))
            self.steps.append(self._with_finer_substeps(self._backward_eliminated(self.last)))
            if len(self.last.effects) <= len(before.effects) and not self._is_accepted(self.last, before):
                break

    @property
    def is_sufficient(self) -> bool:
        """Whether the residual of the last set is too small to search for another effect."""
        left = self.last.explains or (self.last.effects and self.unexplained < STEPWISE.further)
        return bool(left and self.last.is_plausible and (self.tried_beside_input_noise or not self.search.logged))

    @property
    def _is_exhausted(self) -> bool:
        """Whether the residual of the last set is below what any missing effect would leave."""
        return self.last.excess(self.last.noise_power) < STEPWISE.noise_floor * float(self.last.noise_power.mean())

    def _with_finer_substeps(self, step: Step) -> Step:
        """The step refitted with substeps fine enough to be exact, if its residual is close to the noise floor.

        The selection continues with these substeps: the error of coarser ones would pass for another effect.
        """
        rig, noise = apply_all(self.search.rig, step.fit.effects), step.noise_power
        is_near_noise = step.excess(noise) < STEPWISE.further * self._gap
        if not (step.effects and is_near_noise and is_stepped(rig)) or step.explains:
            return step
        data, substeps = self.search.data, self.search.data.substeps
        residual = data.residual(rig)
        while substeps < FINISH.finest:
            finer = data.stepped(2 * substeps).residual(rig)
            change, residual = finer - residual, finer
            if float(change @ change) < STEPWISE.stepping * change.size:
                break
            substeps *= 2
        if substeps == data.substeps:
            return step
        self.has_finer_substeps = True
        self.search, self.at_first = (
            replace(each, data=each.data.stepped(substeps)) for each in (self.search, self.at_first)
        )
        return replace(fit_jointly(self.search, step.effects, step.errors, rounds=2), others=step.others)

    def _with_input_noise(self, step: Step) -> Step | None:
        """The step refitted with input noise, if that whitens its residual; else None.

        The selection continues, and the steps before are evaluated, with input noise of the level that the residual
        of this step shows; without input noise if this step explains the records.
        """
        search = self.at_first
        without_noise = (
            fit_jointly(search, step.effects, step.errors) if self.search.logged else evaluated(search, step.fit)
        )
        is_loud = without_noise.excess(without_noise.sensor_noise) > STEPWISE.loud * float(
            without_noise.sensor_noise.mean()
        )
        if without_noise.logged < LEAST_LOGGED or not is_loud:
            return self._continue_in(search, step, without_noise) if self.search.logged else None
        noisy = with_input_noise(search, step.fit, without_noise.sensor_noise)
        if noisy is None:
            return None
        fitted = fit_jointly(noisy, step.effects, step.errors)
        if fitted.fit.cost < STEPWISE.too_white:  # nominal errors had fitted the noise, so it was estimated too loud
            noisy = with_input_noise(search, fitted.fit, without_noise.sensor_noise)
            if noisy is None:
                return None
            fitted = fit_jointly(noisy, step.effects, fitted.errors)
        if fitted.fit.cost < STEPWISE.too_white:
            return None
        # noise this loud masks most effects; if a single effect explains the residual, there is no input noise
        found = None if step.effects or self.search.logged else self._in_place_of_inputs(without_noise)
        if found is not None:
            self.steps.append(found)
            return None
        return self._continue_in(noisy, step, fitted)

    def _continue_in(self, search: Search, step: Step, fitted: Step) -> Step:
        """`fitted`, the step refitted in another search; the selection continues in that search."""
        self.search, self.tried_beside_input_noise = search, False
        self.steps = [fitted if s is step else replace(evaluated(search, s.fit), others=s.others) for s in self.steps]
        return fitted

    @property
    def unexplained(self) -> float:
        """Residual power of the last set above the noise, as a share of that of the nominal rig."""
        return float(self.last.excess(self.last.noise_power) / self._gap)

    def _from_zero(self, sets: Sequence[tuple[Effect, ...]]) -> list[Step]:
        """Sets of effects, each with nominal errors that start from zero, fitted to all records side by side."""
        return self.search.workers.map(partial(fit_from_zero, self.search), sets)

    def _to_all(self, steps: Sequence[Step]) -> list[Step]:
        """Steps fitted to all records side by side."""
        return self.search.workers.map(partial(fitted_to_all, self.search), steps)

    @property
    def _gap(self) -> float:
        """Power of the nominal residual above the noise, in units of the stated noise."""
        return max(float(np.maximum(self.search.nominal - self.last.noise_power, 0.0).mean()), 1e-12)

    @property
    def needs_no_effect(self) -> bool:
        """Whether nominal errors alone explain the gap."""
        return not self.last.effects and self.closes_gap

    @property
    def closes_gap(self) -> bool:
        """Whether the residual of the last set is at the noise floor, or a negligible share of the gap."""
        return self.is_noise_only or self.unexplained < STEPWISE.explained

    @property
    def is_noise_only(self) -> bool:
        """Whether the residual of the last set is at the noise floor of sensors and inputs."""
        return self.last.excess(self.last.noise_power) < STEPWISE.no_gap * float(self.last.noise_power.mean())

    @property
    def has_plausible_errors(self) -> bool:
        """Whether the nominal errors of the last set are plausible; those of damping do not count."""
        return self.plain is not None or are_plausible(self.last.errors, damping=False)

    @property
    def is_conclusive(self) -> bool:
        """Whether the search may end: the residual is at the noise floor and the nominal errors are plausible."""
        if self.plain is not None:
            return True
        outcome = self.decision().outcome
        return self.is_noise_only and (outcome == "none" or (outcome == "explained" and self.last.is_plausible))

    def decision(self) -> Decision:
        """The verdict on the last set of effects."""
        beside = self.search if self.search.logged or self.has_finer_substeps else None
        if self.plain is not None:
            rivals = self._rivals_of_plain
            return Decision("explained", self.plain, rivals=rivals, noise=self.search.data.noise, beside=beside)
        effects, left = self.last.effects, self.unexplained
        noise = np.sqrt(self.last.sensor_noise) * self.search.data.noise
        closed = self.closes_gap or (len(effects) > 1 and left < STEPWISE.in_part)
        if effects and closed and not self.shows_unknown_law:
            return Decision("explained", self.last.fit, rivals=self._rivals(), noise=noise, beside=beside)
        if self.needs_no_effect:
            return Decision("none", self.last.fit, noise=noise, beside=beside)
        return Decision("part" if left < 0.5 else "unknown", self.last.fit, noise=noise, beside=beside)

    @cached_property
    def _rivals_of_plain(self) -> tuple[tuple[Fit, float], ...]:
        """Other causes that explain the records as well as `plain`, with their probabilities."""
        return () if self.plain is None else other_delay_causes(self.search, self.plain)

    def _others(self) -> list[Step]:
        """The last set as it was selected, then the other candidates that explain the records or fit as well."""
        key = key_of(self.last.effects)
        chosen = next((s for s in reversed(self.steps) if s.others and key_of(s.effects) == key), None)
        if chosen is None:
            return []
        others = [s for s in chosen.others if key_of(s.effects) != key]
        return [chosen, *(s for s in others if s.explains or self._is_as_good(s, chosen))]

    def _rivals(self) -> tuple[tuple[Fit, float], ...]:
        """Other sets that fit as well, with their probabilities by description length.

        If no set reaches the noise floor, only the description lengths of the nominal errors are compared: the
        residuals differ by too little, and have no known distribution.
        """
        sets = self._others()
        if not sets:
            return ()
        key, rig = key_of(sets[0].effects), self.search.rig
        sets = [s for s in sets if key not in contained(s.effects, rig)]
        noise, none_explains = sets[0].sensor_noise, not sets[0].explains
        length = [
            s.description(noise, of_errors_alone=none_explains) + self.search.nats_per_parameter * s.fit.n_parameters
            for s in sets
        ]
        odds = np.exp(min(length) - np.array(length))
        likely = sorted(zip(sets[1:], odds[1:] / odds.sum(), strict=True), key=lambda each: -each[1])
        return tuple((s.fit, float(p)) for s, p in likely if p > STEPWISE.excluded)

    def _at_another_place(self, step: Step) -> Step | None:
        """The step with its one linear structural effect moved to another place, if that has a smaller loss.

        Smooth nominal errors approximate such an effect at any place. The cost therefore has a local minimum at every
        wavelength of these errors, and only a fit from each place finds the global one.
        """
        if len(step.effects) != 1 or not is_linear_structural(step.effects[0].kind) or step.effects[0].at is None:
            return None
        (effect,), domain = step.effects, self.search.rig.modes.domain
        self.search.report("the same effect at other places", 0.6)
        places = [(effect.moved_to(where),) for where in other_places(effect, domain)]
        here, *others = fitted_to_quick(self.search, [(effect,), *places], step)
        elsewhere = [s for s in others if apart(s.effects[0], here.effects[0], domain)]
        near = sorted((s for s in elsewhere if s.fit.cost < STEPWISE.near * here.fit.cost), key=lambda s: s.fit.cost)
        whole = self._to_all(near[: STEPWISE.finalists])
        best = min(whole, key=partial(loss, self.search), default=step)
        return best if loss(self.search, best) < loss(self.search, step) else None

    def _with_another_law(self, step: Step) -> Step | None:
        """The step with its one nonlinear law replaced by another at the same place, if that removes enough.

        The first effect is searched beside nominal errors that have absorbed part of it, and where those are far off, a
        wrong law at the right place may be the best. Now that the errors are nearly known, the laws compare. More
        general laws, of which this one is a limiting case, compete with two effects (`_with_one_more`).
        """
        if len(step.effects) != 1 or not step.effects[0].kind.nonlinear or step.effects[0].at is None or step.explains:
            return None
        (effect,), search = step.effects, self.search
        search.report("another law at the same place", 0.6)
        laws = tuple(kind for kind in search.catalogue if kind.nonlinear and kind is not effect.kind)
        with_errors = replace(search.with_nominal_errors(step.errors), catalogue=laws)
        evidence = Evidence.of(
            apply_all(search.rig, (step.errors,)), search.data, workers=search.workers, absorbed=True
        ).of_force_at(effect.at)
        key, domain = key_of(step.effects), search.rig.modes.domain
        there = [
            f
            for f in one_more(with_errors, (), evidence)
            if f.effects[0].at is not None
            and not apart(f.effects[0], effect, domain)
            and key not in contained(f.effects, search.rig)
        ]
        present = fitted_ahead(with_errors, [step.effects])
        cost_limit = min((f.cost for f in present), default=np.inf)
        likeliest = [f for f in best_of_each_kind(there) if f.cost < cost_limit][: STEPWISE.finalists]
        others = search.workers.map(lambda f: fit_jointly(search, f.effects, step.errors, rounds=2), likeliest)
        best, *rest = sorted((step, *others), key=partial(loss, search))
        return replace(best, others=(best, *rest)) if best is not step and self._is_accepted(best, step) else None

    def _with_an_absorbed(self, step: Step) -> Step | None:
        """The step with one linear effect more that makes its implausible nominal errors much smaller, or None.

        Errors as large as those of the step may have absorbed that effect, and then leave no evidence of it. So the
        best ones without nominal errors are tried, with errors that start from zero.
        """
        if step.is_plausible or not step.effects or self.search.by_mode:
            return None
        self.search.report("effects that errors of the model have absorbed", 0.6)
        named = {effect.kind for effect in step.effects}
        singles = [f.effects for f in self._linear_singles if f.effects[0].kind not in named][: STEPWISE.finalists]
        tried = self._from_zero([(*step.effects, *each) for each in singles])
        noise = step.noise_power
        longest = step.description(noise) - STEPWISE.shorter
        found = [s for s in tried if s.description(noise) < longest and self._are_noticeable(s.effects, s.fit.effects)]
        return replace(min(found, key=lambda s: s.description(noise)), others=tuple(found)) if found else None

    def _with_one_more(self, step: Step) -> Step | None:
        """The best set with one more effect, if it removes enough of the residual; else None."""
        self.tried_beside_input_noise = True
        tried = self._candidates_with_one_more(step)
        if not tried:
            return None
        with_late = self._with_late_accelerometer(step, tried)
        if with_late is not None:
            self.steps[-1] = with_late
            return self._with_one_more(with_late)
        best = self._best_of(tried, step)
        if not self._is_accepted(best, step):
            return None
        self.shows_unknown_law = self.search.clustered(best.effects)
        return None if self.shows_unknown_law else best

    def _candidates_with_one_more(self, step: Step) -> list[Step]:
        """The likeliest sets with one more effect, fitted to the two most informative records."""
        quick, first = most_informative(self.search.data, step.fit.cost_by_channel)
        self.search = search = replace(self.search, quick=quick, first=first)
        search.report("another effect, with small errors of the model", 0.5 + 0.1 * len(step.effects))
        # the residual beyond nominal errors fitted to whole records is evidence of a missing effect
        with_errors = search.with_nominal_errors(step.errors)
        rig = apply_all(search.rig, step.fit.effects)
        residual = with_errors.ahead.residual(rig)
        cost = float(residual @ residual) / residual.size
        evidence = Evidence.of(rig, search.data, workers=search.workers, absorbed=True)
        ahead = one_more(with_errors, step.effects, evidence)
        if not ahead or ahead[0].cost > (1.0 - STEPWISE.ahead) * cost:
            return []
        promising, as_good = (cost - share * (cost - ahead[0].cost) for share in (STEPWISE.promising, STEPWISE.as_good))
        chosen: list[tuple[Effect, ...]] = []
        for candidate in ahead:
            same_kind = sum(candidate.effects[-1].kind is others[-1].kind for others in chosen)
            if candidate.cost <= promising and same_kind < (2 if candidate.cost <= as_good else 1):
                chosen.append(candidate.effects)
        chosen = [*chosen[: STEPWISE.candidates], *more_general_sets(step.effects)]
        return fitted_to_quick(self.search, chosen, step)

    def _in_place_of_inputs(self, step: Step) -> Step | None:
        """The step with one more effect that explains the records without input noise, or None."""
        near = [
            s
            for s in self._candidates_with_one_more(step)
            if s.fit.cost < PLAIN.near and not may_be_port_errors(self.search, s)
        ]
        near = sorted(near, key=lambda s: s.fit.cost)[: STEPWISE.finalists]
        whole = self._to_all(near)
        found = [s for s in whole if s.explains and s.is_plausible and self._is_accepted(s, step)]
        return self._simplest_of_sets(sorted(found, key=lambda s: s.fit.cost)) if found else None

    def _with_late_accelerometer(self, step: Step, tried: Sequence[Step]) -> Step | None:
        """The step with an accelerometer that reads before the input steps, if the best candidate delays it.

        The acceleration jumps with a held input, so the cost jumps at zero delay and no gradient leads across.
        """
        best = min(tried, key=lambda s: s.fit.cost)
        prior, late = step.errors.target, best.effects[-1]
        if late.kind not in TIMING or prior.interpolated or not is_timing(self.search, best, TIMING):
            return None
        accelerometers = {sensor.name for sensor in self.search.rig.sensors if sensor.quantity == "acceleration"}
        if late.target not in accelerometers.difference(prior.late):
            return None
        errors = with_all_groups(self.search, step.errors)
        early = tuple(name for name in prior.early if name != late.target)
        target = replace(errors.target, late=(*prior.late, late.target), early=early)
        delay = delay_of(late) / prior.sample_time
        values = {**errors.values, f"delay_{late.target}": delay}
        refitted = fit_jointly(self.search, step.effects, nominal_errors(self.search.rig, target, values))
        return refitted if refitted.fit.cost < step.fit.cost else None

    def _best_of(self, tried: Sequence[Step], step: Step) -> Step:
        """The best set on all records, of candidates fitted to the most informative ones."""
        # the single effects fitted before nominal errors could absorb them compete too
        singles = [] if step.effects else self.fitted_singles
        tried = sorted((s for s in tried if not may_be_port_errors(self.search, s)), key=partial(loss, self.search))
        close = [s for s in tried if s.fit.cost < STEPWISE.near * tried[0].fit.cost][: STEPWISE.finalists]
        whole = self.search.workers.map(lambda s: self._without_inactive(fitted_to_all(self.search, s)), close)
        # the most informative records overstate some
        whole = [s for s in whole if not may_be_port_errors(self.search, s)]
        whole = sorted((*whole, *singles), key=partial(loss, self.search))
        return self._simplest_of_sets(whole) if whole else step

    def _simplest_of_sets(self, sets: Sequence[Step]) -> Step:
        """The simplest set that is as good as the first of these, which is the best."""
        return replace(self._simplest(sets[0], sets[1:]), others=tuple(sets))

    def _reselected(self, step: Step) -> Step:
        """The best of a step and its competitors (`others`), refitted in the current search."""
        others = [s for s in step.others if key_of(s.effects) != key_of(step.effects)]
        others = self._to_all(others)
        return self._simplest_of_sets(sorted((step, *others), key=partial(loss, self.search)))

    def _are_noticeable(self, effects: Sequence[Effect], beside: Sequence[Effect]) -> bool:
        """Whether each of these effects alters the readings noticeably, `beside` being the whole set."""
        return len(noticeable(self.search, effects, beside, self.tolerance)) == len(effects)

    def _is_accepted(self, best: Step, step: Step) -> bool:
        """Whether a set removes enough of the residual of a smaller one, or makes its nominal errors plausible."""
        if not self._are_noticeable(best.effects, best.fit.effects):
            return False
        # if nominal errors, sensor delays among them, explain the records, another small delay is no effect
        by_likelihood = step.explains and not is_timing(self.search, best, TIMING)
        if (self.search.logged or by_likelihood) and is_likelier(self.search, best, step):
            return True
        noise = np.minimum(best.sensor_noise, step.sensor_noise)
        before, after = step.excess(noise), best.excess(noise)
        is_negligible = bool(step.effects) and before - after < STEPWISE.least * self._gap
        share = STEPWISE.further_excess if step.effects and not is_negligible else STEPWISE.excess
        if not step.explains and before - after > share * before:
            return True
        saved = step.description(noise, of_errors_alone=is_negligible) - best.description(
            noise, of_errors_alone=is_negligible
        )
        return not step.is_plausible and saved > STEPWISE.shorter

    def _without_inactive(self, step: Step) -> Step:
        """The step without effects that no longer alter the readings, because another has replaced them."""
        kept = noticeable(self.search, step.effects, step.fit.effects, self.tolerance)
        if len(kept) in (0, len(step.effects)):
            return step
        return self._without_inactive(fit_jointly(self.search, kept, step.errors, rounds=2))

    def _simplest(self, best: Step, tried: Sequence[Step]) -> Step:
        """The best step, or a simpler set (a limiting case, or fewer effects) that fits almost as well."""
        as_good = [s for s in (best, *tried) if len(s.effects) > 1 and not surely_prefers(self.search, best, s)]
        simpler = [
            *simpler_sets(best.effects, self.search.rig),
            *merged_sets(best.effects),
            *(fewer for s in as_good for fewer in each_left_out(s.effects)),
        ]
        on_quick = fitted_to_quick(self.search, simpler, best)
        sets = [*tried, *self._refitted_to_all(on_quick, best), *self._simpler_singles(best)]
        # implausible nominal errors may have absorbed the effect that is left out
        sets = [s for s in sets if s.is_plausible or not best.is_plausible]
        size = partial(size_of_set, self.search)
        # a set of as many parameters may fit better: friction, for a hysteretic spring that always slides
        best = min((best, *(s for s in sets if size(s) == size(best))), key=lambda s: s.fit.cost)
        excess_limit = (1.0 + STEPWISE.simpler) * max(best.excess(best.sensor_noise), STEPWISE.simpler)
        limiting_cases = contained(best.effects, self.search.rig)
        fewer = [
            step
            for step in sets
            if (size(step) < size(best) or key_of(step.effects) in limiting_cases)
            and step.excess(best.sensor_noise) < excess_limit
            and not surely_prefers(self.search, best, step)
        ]
        return min(fewer, key=lambda s: (size(s), s.fit.cost)) if fewer else best

    def _refitted_to_all(self, on_quick: Sequence[Step], best: Step) -> list[Step]:
        """The steps; those that may be as good as `best`, which was fitted to all records, are refitted to all."""
        if not best.explains:
            return list(on_quick)
        cost_limit = max(STEPWISE.near * best.fit.cost, STEPWISE.least * self._gap)
        return self.search.workers.map(
            lambda s: fit_jointly(self.search, s.effects, s.errors, rounds=2) if s.fit.cost < cost_limit else s,
            list(on_quick),
        )

    def _limiting_case(self, step: Step) -> Step:
        """The step with effects replaced by limiting cases that fit as well, if no set explains the records.

        Any law fits some of the residual of a measured gap, so a slightly smaller residual justifies no wider law.
        """
        if step.explains:
            return step
        sets = list(with_one_simpler(step.effects, self.search.rig))
        limits = fitted_to_quick(self.search, sets, step)
        as_good = [s for s in self._to_all(limits) if self._is_as_good(s, step)]
        return self._limiting_case(min(as_good, key=lambda s: s.fit.cost)) if as_good else step

    def _is_as_good(self, step: Step, best: Step) -> bool:
        """Whether a step with plausible nominal errors fits almost as well as the best, which does not explain the gap.

        Implausible nominal errors do not count: they may have absorbed an effect.
        """
        more = step.excess(best.sensor_noise) - best.excess(best.sensor_noise)
        return step.is_plausible and not best.explains and more < STEPWISE.least * self._gap

    def _simpler_singles(self, best: Step) -> list[Step]:
        """Single effects of fewer parameters that fit almost as well as a single effect, fitted to all records."""
        if len(best.effects) != 1 or not self.ahead:
            return []
        size = len(parameters_of(self.search.rig, best.effects))
        nominal = self.search.nominal_ahead
        good = nominal - STEPWISE.as_good * (nominal - self.ahead[0].cost)
        likely = [f.effects for f in best_of_each_kind(self.ahead) if f.cost <= good and f.n_parameters < size]
        on_quick = fitted_to_quick(self.search, likely, best)
        near = [step for step in on_quick if step.fit.cost < STEPWISE.near * best.fit.cost]
        fitted = [fitted_to_all(self.search, step) for step in near]
        return [step for step in fitted if not may_be_port_errors(self.search, step)]

    def _backward_eliminated(self, step: Step) -> Step:
        """The step after backward elimination: without effects that later ones have made unnecessary."""
        if not step.effects:
            return step
        fewer = fitted_to_quick(self.search, list(each_left_out(step.effects)), step)
        best = min(fewer, key=lambda s: s.fit.cost)
        excess_limit = (1.0 + STEPWISE.needless) * max(step.excess(step.sensor_noise), STEPWISE.simpler)
        is_needless = best.excess(step.sensor_noise) < excess_limit and (best.is_plausible or not step.is_plausible)
        return self._backward_eliminated(best) if is_needless else step

    def _without_errors(self, step: Step) -> Fit | None:
        """Few effects that explain the records without nominal errors as well as a step with them, or None."""
        if not self.closes_gap:
            return None
        search = self.search.with_noise(np.sqrt(step.sensor_noise) * self.search.data.noise)
        if step.logged > LEAST_LOGGED and not self.search.logged:
            search = with_input_noise(self.at_first, step.fit, step.sensor_noise) or search
        key, rig = key_of(step.effects), self.search.rig
        rivals = [s.effects for s in self._others()[1:] if key not in contained(s.effects, rig)]
        found = in_place_of_nominal_errors(search, step, rivals)
        if found is None:
            return None
        # uniform stiffness and damping errors together are nominal errors; one alone is an effect
        errors = {NOMINAL_ERRORS, *(UNIFORM if {e.kind for e in found.effects}.issuperset(UNIFORM) else ())}
        named = [effect for effect in found.effects if effect.kind not in errors]
        if not self._are_noticeable(named, found.effects):
            return None
        self.search = search
        return found

    def calibrate(self) -> bool:
        """Turn gain errors too large for any calibration into effects; True if there are any."""
        found = self._with_wrong_gains(self.last)
        if found is self.last:
            return False
        self.steps.append(found)
        return True

    def _with_wrong_gains(self, step: Step, most: int = PLAIN.wrong_gains) -> Step:
        """The step with gain errors too large for any calibration, and outlying among the gains, as effects."""
        gains = {n: v for n, v in step.errors.values.items() if group_of(n) == "gain"}
        name = max(gains, key=lambda n: abs(gains[n]), default="")
        if not most or abs(gains.get(name, 0.0)) < PLAIN.suspect * PLAIN.most_gain:
            return step
        _, side, port = name.split("_", 2)
        kind = {"of": ACTUATOR_GAIN, "at": SENSOR_GAIN}[side]
        if kind not in self.search.catalogue:
            return step
        effect = Effect(kind, port, {"gain": float(np.exp(gains[name]))})
        found = fit_from_zero(self.search, (*step.effects, effect))  # other nominal errors have absorbed part of it
        gain = found.effects[-1].values["gain"]
        error = abs(float(np.log(gain))) if gain > 0.0 else 0.0  # a gain that passed zero: the fit has gone astray
        is_wrong = error >= max(PLAIN.most_gain, PLAIN.outlying * size_of(found.errors, "gain"))
        if not (is_wrong and self._are_noticeable(found.effects, found.fit.effects)):
            return step
        return self._with_wrong_gains(found, most - 1)

    def _with_common_effects(self, step: Step) -> Step:
        """The step with uniform stiffness and damping errors as effects, if too large for nominal errors."""
        values = step.errors.values
        damping = float(np.mean([v for n, v in values.items() if group_of(n) == "damping"] or [0.0]))
        stiffness = values.get("stiffness_0", 0.0) - values.get("mass_0", 0.0)
        named = {effect.kind for effect in step.effects}
        added, reset, largest = [], dict(values), dict(PLAIN.most_common)
        if abs(damping) > largest["modal_damping"] and MODAL_DAMPING not in named:
            added.append(Effect(MODAL_DAMPING, None, {"factor": float(np.exp(damping))}))
            reset.update({n: v - damping for n, v in values.items() if group_of(n) == "damping"})
        if abs(stiffness) > largest["modulus_error"] and MODULUS_ERROR not in named:
            added.append(Effect(MODULUS_ERROR, None, {"factor": float(np.exp(stiffness))}))
            reset.update({"stiffness_0": 0.0, "mass_0": 0.0})
        if not added:
            return step
        return fit_jointly(self.search, (*step.effects, *added), replace(step.errors, values=reset), rounds=2)

    def _with_delay_as_effect(self, step: Step) -> Step:
        """The step with sensor delays of one common cause as that effect, if it fits as well.

        Delays that account for a negligible share of the gap stay nominal errors.
        """
        search, target, named = self.search, step.errors.target, {effect.kind for effect in step.effects}
        late = [effect for effect in delay_effects(search.rig, step.errors) if effect.kind not in named]
        late = [effect for effect in late if self._are_noticeable([effect], [*step.effects, effect])]
        if not late:
            return step
        without_delays = {n: 0.0 if group_of(n) == "delay" else v for n, v in step.errors.values.items()}
        errors = nominal_errors(search.rig, replace(target, late=(), early=(), interpolated=False), without_delays)
        each = search.workers.map(lambda e: fit_jointly(search, (*step.effects, e), errors, rounds=2), late)
        each = [evaluated(search, with_common_delay(s.fit)) for s in each]
        best, *others = sorted(each, key=lambda s: s.fit.cost)
        effect = best.effects[-1]
        if is_likelier(self.search, step, best) or not effect.stands_out(search.rig):
            return step
        share = cost_of(search.rig, (*step.effects, errors), search.data) - best.fit.cost
        if share < STEPWISE.explained * self._gap or not self._are_noticeable([effect], best.effects):
            return step
        return replace(best, others=(best, *others))
