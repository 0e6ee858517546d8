"""Stepwise selection of effects, each fitted jointly with small errors of the nominal model."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from workbench.gap.effects.effect import Effect, Kind, apply_all, contained, key_of, more_general_sets
from workbench.gap.effects.nominal import NOMINAL_ERRORS, in_group, nominal_errors
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.noise import LEAST_LOGGED
from workbench.gap.search.elimination import (
    backward_eliminated,
    is_as_good,
    limiting_case,
    simplest_step,
    size_of_set,
    without_inactive,
)
from workbench.gap.search.errors_as_effects import (
    NO_UNIFORM_ERROR,
    UNIFORM,
    is_linear_structural,
    is_timing,
    may_be_transducer_errors,
    with_delay_as_effect,
    with_late_accelerometer,
    with_uniform_effects,
    with_wrong_transducers,
)
from workbench.gap.search.finish import TRANSDUCERS, other_places
from workbench.gap.search.fit import Fit, cost_of, fit
from workbench.gap.search.jointly import (
    TIMING,
    JointFit,
    are_plausible,
    evaluated,
    fit_from_zero,
    fit_jointly,
    fitted_to_all,
    fitted_to_quick,
    is_likelier,
    loss,
    with_input_noise,
    with_reading_sides,
)
from workbench.gap.search.plain import few_with_uniform_errors, in_place_of_nominal_errors, other_delay_causes
from workbench.gap.search.screening import fitted_ahead, one_more
from workbench.gap.search.search import Alternatives, Decision, Search, apart, best_of_each_kind, most_informative
from workbench.gap.search.settings import FINISH, INPUTS, SEARCH, SELECTION, STEPWISE
from workbench.rig.simulate import is_stepped
from workbench.structure.domain import Location


class Stepwise:
    """Stepwise selection of effects, fitted jointly with nominal errors: forward, with backward elimination.

    Attributes:
        ahead: fits of single effects to one-step-ahead predictions without nominal errors, best first; candidates for
            the first effect.
        at_first: the search without input noise.
        steps: the sets of effects selected so far, and their refits; the last one counts.
        plain: the last set without nominal errors, if it explains the records as well.
        shows_unknown_law: whether nonlinear effects cluster at one place: the catalogue lacks the law.
        tried_beside_input_noise: whether an effect has been tried with the current model of input noise, which can
            mask an effect.
        has_finer_substeps: whether the time step was refined during the selection.
        is_complete: whether no further effects are to be added.
        singles: single effects that are tried as the first; None for the likeliest by one-step-ahead prediction.
        known: fits of single effects that are not repeated.
    """

    def __init__(self, search: Search, ahead: Sequence[Fit] = ()) -> None:
        self.ahead = ahead
        self.singles: Sequence[tuple[Effect, ...]] | None = None
        self.known: Sequence[JointFit] = ()
        catalogue = tuple(kind for kind in search.catalogue if kind not in UNIFORM)
        self.search = replace(search, catalogue=catalogue or search.catalogue)
        self.at_first = self.search
        self.tried_beside_input_noise = False
        self.has_finer_substeps = False
        self.is_complete = False
        self.plain: Fit | None = None
        self.shows_unknown_law = False
        search.progress("small errors of the nominal model", 0.4)
        self.steps: list[JointFit] = []
        self.steps.append(fit_from_zero(self.search, ()))
        self._with_input_noise(self.last)

    @property
    def last(self) -> JointFit:
        """The last set."""
        return self.steps[-1]

    @property
    def nearest(self) -> JointFit:
        """The last set or the best single effect with nominal errors, whichever has the smaller residual."""
        return min((self.last, *self.fitted_singles), key=lambda s: s.fit.cost)

    # What the last set shows

    @property
    def unexplained(self) -> float:
        """Residual power of the last set above the noise, as a share of that of the nominal rig."""
        return float(self.last.excess(self.last.noise_power) / self._gap)

    @property
    def _gap(self) -> float:
        """Power of the nominal residual above the noise, in units of the stated noise."""
        return max(float(np.maximum(self.search.nominal - self.last.noise_power, 0.0).mean()), 1e-12)

    @property
    def closes_gap(self) -> bool:
        """Whether the residual of the last set is at the noise floor, or a negligible share of the gap."""
        return self.is_noise_only or self.unexplained < SEARCH.explained_share

    @property
    def is_noise_only(self) -> bool:
        """Whether the residual of the last set is at the noise floor of sensors and inputs."""
        return self.last.is_near(self.last.noise_power, STEPWISE.noise_excess)

    @property
    def _is_exhausted(self) -> bool:
        """Whether the residual of the last set is below what any missing effect would leave."""
        return self.last.is_near(self.last.noise_power, STEPWISE.noise_floor)

    @property
    def needs_no_effect(self) -> bool:
        """Whether nominal errors alone explain the gap."""
        return not self.last.effects and self.closes_gap

    @property
    def has_plausible_errors(self) -> bool:
        """Whether the nominal errors of the last set are plausible; those of damping do not count."""
        return self.plain is not None or are_plausible(self.last.errors, damping=False)

    @property
    def is_sufficient(self) -> bool:
        """Whether the residual of the last set is too small to search for another effect."""
        left = self.last.explains or (self.last.effects and self.unexplained < STEPWISE.further_share)
        return bool(left and self.last.is_plausible and (self.tried_beside_input_noise or not self.search.logged))

    @property
    def is_conclusive(self) -> bool:
        """Whether the search may end: the residual is at the noise floor and the nominal errors are plausible."""
        if self.plain is not None:
            return True
        outcome = self.decision().outcome
        return self.is_noise_only and (outcome == "none" or (outcome == "explained" and self.last.is_plausible))

    # The first effect

    @cached_property
    def fitted_singles(self) -> list[JointFit]:
        """Single effects, each fitted jointly with nominal errors that start from zero, best first."""
        sets = [f.effects for f in self._likeliest_singles()] if self.singles is None else self.singles
        keys = {key_of(step.effects) for step in self.known}
        fresh = self.search.in_parallel(fit_from_zero, [effects for effects in sets if key_of(effects) not in keys])
        found = [s for s in (*self.known, *fresh) if not may_be_transducer_errors(self.search, s.effects)]
        # one step ahead without nominal errors, the true law may come after errors of gain and place
        nearest = min(found, key=lambda s: s.fit.cost, default=None)
        another = nearest and (self._with_another_law(nearest) or self._with_law_elsewhere(nearest))
        found += [] if another is None else [another]
        best = sorted(found, key=lambda s: s.fit.cost)
        if not best or (self.has_plausible_errors and not self.search.by_mode):
            return best
        # nominal errors of each mode, or implausibly large ones, absorb the residual of any linear effect: of effects
        # that leave as little, the one that needs the smallest nominal errors is preferred
        noise, nats_per_parameter = best[0].noise_power, 0.0 if self.search.by_mode else self.search.nats_per_parameter
        little = best[0].excess(noise) + STEPWISE.noise_excess * float(noise.mean())
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
            fits_as_well = {f.key for f in found if f.cost < (1.0 + SEARCH.significant_gain) * single.cost}
            if not limiting_cases & fits_as_well:
                chosen.append(single)
        chosen = [f for f in chosen[: STEPWISE.singles] if f.cost < SEARCH.max_cost_ratio * chosen[0].cost]
        # nominal errors may have absorbed an effect, so the best ones without nominal errors are tried too
        alone = [f for f in self.ahead[:1] if not may_be_transducer_errors(search, f.effects)]
        for single in (*linear[:1], *alone):
            tried = {other.key for other in chosen}
            if single.effects[0].kind not in UNIFORM and not tried & {
                single.key,
                *contained(single.effects, search.rig),
            }:
                chosen.append(single)
        return chosen

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
        sizes = {
            **errors.values,
            **dict.fromkeys(in_group(errors.values, "damping"), damping),
            "stiffness_0": stiffness,
        }
        found = fit_jointly(search, (), nominal_errors(search.rig, search.prior, sizes))
        if found.explains and are_plausible(found.errors, damping=False):
            self.steps.append(found)

    def by_singles(self) -> bool:
        """Whether a single effect with nominal errors explains the records; it is then the first step."""
        if not self.fitted_singles or self.search.is_over:  # the order of unfinished fits means nothing
            return False
        if self._from_errors_of_singles() and (self.is_sufficient or not self.fitted_singles):
            return self.is_sufficient
        best = self.fitted_singles[0]
        with_noise = None if best.explains else self._with_input_noise(best)
        if with_noise is not None:  # the residual of the nominal errors alone may be that input noise
            best = with_noise
            self.steps[-1] = fit_jointly(self.search, self.last.effects, self.last.errors)
        excess = best.excess(best.noise_power)
        # beside errors a linear effect at a wrong place, or of a wrong kind, leaves little, but more than noise
        is_linear = is_linear_structural(best.effects[0].kind)
        if not best.explains and (is_linear or excess > STEPWISE.further_share * float(self.search.nominal.mean())):
            return False
        best = self._simplest(best, self.fitted_singles[1:], self.fitted_singles)
        # quiet noise of the inputs excites weak modes in the prediction alone, which large damping makes up for
        only_damping = not self.has_plausible_errors and are_plausible(best.errors, damping=False)
        if not ((best.is_plausible or only_damping) and self._is_accepted(best, self.last)):
            return False
        reduced = backward_eliminated(self.search, best)
        errors_only = None if reduced.effects else fit_jointly(self.search, (), reduced.errors)
        # the effect only led the nominal errors out of a local minimum
        if errors_only is not None and are_plausible(errors_only.errors, damping=False):
            self.steps.append(errors_only)
            return self.is_sufficient
        self.steps.append(best)
        self._with_input_noise(best)
        self.steps.append(self._with_finer_substeps(self.last))
        return True

    def _from_errors_of_singles(self) -> bool:
        """Whether nominal errors alone are likelier from those of the best single effect; the selection restarts there.

        An effect that does nothing may lead the errors out of a local minimum.
        """
        if self.last.effects:
            return False
        best = min(self.fitted_singles, key=partial(loss, self.search))
        alone = fit_jointly(self.search, (), best.errors)
        if not is_likelier(self.search, alone, self.last):
            return False
        self.steps[-1] = alone
        self._with_input_noise(alone)
        del self.fitted_singles  # those were fitted beside noise of the inputs that the errors left
        return True

    def by_few(self) -> bool:
        """Whether few effects with uniform stiffness and damping errors explain the records; sets `plain`.

        Tried only if the nominal errors alone are implausible.
        """
        if self.has_plausible_errors or self.last.effects or self.search.logged:
            return False
        found = few_with_uniform_errors(self.search, self.last, STEPWISE.max_effects)
        if found is None or not self.search.are_noticeable(found.effects, found.effects):
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
        if not search.near(best, SEARCH.explained_share) or any(effect.kind in UNIFORM for effect in best.effects):
            return False
        errors = with_reading_sides(search, nominal_errors(search.rig, search.prior), best.effects)
        found = fit_jointly(search, best.effects, errors, until_convergence=True)
        if may_be_transducer_errors(search, found.effects) or not found.explains:
            return False
        if not search.are_noticeable(found.effects, found.fit.effects):
            return False
        self.steps.append(found)
        self.is_complete = not found.is_plausible  # errors that are large absorb the effect at any other place too
        return True

    # Further effects

    def run(self, most: int = STEPWISE.max_effects) -> None:
        """Add effects, `most` in all, as long as each removes most of the residual power above the noise; once."""
        if self.is_complete:
            return
        self.is_complete = True
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
        limit = limiting_case(self.search, self.last, self._gap)
        if limit is not self.last:
            self.steps.append(replace(limit, others=self.last.others))
        if not (first.effects and self.last is first):  # otherwise done above
            self.plain = self._without_errors(self.last)
        if self.plain is not None:
            return
        with_uniform = with_uniform_effects(self.search, self.last)
        self.steps.append(with_delay_as_effect(self.search, with_uniform, SEARCH.explained_share * self._gap))
        if self.last.effects:
            self.steps.append(
                fit_jointly(self.search, self.last.effects, self.last.errors, rounds=3, until_convergence=True)
            )

    def _by_shorter_description(self) -> None:
        """Add a linear effect if its description length is well below that of nominal errors alone (MDL).

        The likelihood must prefer it too: the noise is seldom exactly as modelled.
        """
        errors_only, noise = self.last, self.last.noise_power
        length_limit = errors_only.description(noise) - STEPWISE.saved_nats_beside_plausible
        if length_limit < 0.0:
            return
        sets = [f.effects for f in self._linear_singles[: SEARCH.few_finalists]]
        fitted = self.search.in_parallel(fit_from_zero, sets)
        tried = [s for s in fitted if s.is_plausible and not may_be_transducer_errors(self.search, s.effects)]
        shorter = [s for s in tried if s.description(noise) < length_limit]
        if not shorter:
            return
        # iterated as far as the effects, the errors alone may describe the records as briefly
        converged = fit_jointly(self.search, (), errors_only.errors, rounds=3, until_convergence=True)
        shortest = min(step.description(noise) for step in (errors_only, converged))

        def is_found(step: JointFit) -> bool:
            saved = shortest - step.description(noise)
            likelier = partial(is_likelier, self.search, step, least=SEARCH.least_gain)
            # errors iterated that far over-fit: an effect that saves much need not be likelier than those
            return saved > STEPWISE.saved_nats_beside_plausible and (
                likelier(converged) or (saved > STEPWISE.saved_nats_decisive and likelier(errors_only))
            )

        found = [s for s in shorter if is_found(s)]
        if found:
            best = min(found, key=lambda s: s.description(noise))
            if self.search.are_noticeable(best.effects, best.fit.effects):
                self.steps.append(replace(best, others=tuple(found)))

    def _add(self, most: int) -> None:
        """Add effects one after the other, `most` in all, and exchange a single one for a better one."""
        is_moved = False
        while len(self.last.effects) <= most and not (self.is_sufficient and self._is_exhausted):
            if self.search.is_over:
                break
            before = self.last
            step = self._with_another_law(before) or self._with_law_elsewhere(before)
            moved = self._at_another_place(before) if step is None and not is_moved else None
            step, is_moved = step or moved, moved is not None
            if step is None and len(before.effects) < most:
                step = self._with_an_absorbed(before) or self._with_one_more(before)
            if step is None:
                break
            self.steps.append(step)
            estimated = self.search.logged
            self._with_input_noise(step)
            if estimated and not self.search.logged:  # the input noise was none, so the choice is made again
                self.steps[-1] = self._reselected(replace(self.last, others=step.others))
            self.steps.append(self._with_finer_substeps(backward_eliminated(self.search, self.last)))
            is_same_size = len(self.last.effects) <= len(before.effects)
            if is_same_size and not is_moved and not self._is_accepted(self.last, before):
                break

    def _with_another_law(self, step: JointFit) -> JointFit | None:
        """The step with its one nonlinear law replaced by another at the same place, if that removes enough.

        The first effect is searched beside nominal errors that have absorbed part of it, and where those are far off, a
        wrong law at the right place may be the best, or air drag all along the structure for a law at a point. Now that
        the errors are nearly known, the laws compare. More general laws, of which this one is a limiting case, compete
        with two effects (`_with_one_more`).
        """
        effect = _law_of(step)
        if effect is None or step.explains:
            return None
        domain = self.search.rig.modes.domain
        laws = tuple(kind for kind in self.search.catalogue if kind.nonlinear and kind is not effect.kind)
        return self._exchanged(step, laws, effect.at, lambda e: effect.at is None or not apart(e, effect, domain))

    def _with_law_elsewhere(self, step: JointFit) -> JointFit | None:
        """The step with its one nonlinear law at another place, if that is likelier; tried above the stated noise.

        A law at a wrong place may leave no more than a little more noise than stated.
        """
        effect = _law_of(step)
        if effect is None or effect.at is None or not step.explains or self.search.explains(step.fit):
            return None
        domain = self.search.rig.modes.domain
        return self._exchanged(step, (effect.kind,), None, lambda e: apart(e, effect, domain))

    def _exchanged(
        self, step: JointFit, kinds: tuple[Kind, ...], at: Location | None, is_tried: Callable[[Effect], bool]
    ) -> JointFit | None:
        """The step with its one law exchanged for a likelier one at a point, beside its errors, or None.

        Args:
            step: with one effect.
            kinds: of the effects that are tried.
            at: place of the missing force; None if it is not known.
            is_tried: whether an effect of these kinds is among them.
        """
        search = self.search
        search.progress("another law, or the same at other places", 0.6)
        with_errors = replace(search.with_nominal_errors(step.errors), catalogue=kinds)
        reconstruction = ForceReconstruction.of(
            apply_all(search.rig, (step.errors,)), search.data, workers=search.workers, absorbed=True
        )
        ahead = one_more(with_errors, (), reconstruction if at is None else reconstruction.of_force_at(at))
        key = key_of(step.effects)
        others = [
            f
            for f in ahead
            if f.effects[0].at is not None and is_tried(f.effects[0]) and key not in contained(f.effects, search.rig)
        ]
        cost_limit = min((f.cost for f in fitted_ahead(with_errors, [step.effects])), default=np.inf)
        likeliest = [f for f in best_of_each_kind(others) if f.cost < cost_limit][: SEARCH.few_finalists]
        fitted = search.workers.map(lambda f: fit_jointly(search, f.effects, step.errors, rounds=2), likeliest)
        best, *rest = sorted((step, *fitted), key=partial(loss, search))
        return replace(best, others=(best, *rest)) if best is not step and self._is_accepted(best, step) else None

    def _at_another_place(self, step: JointFit) -> JointFit | None:
        """The step with its one linear structural effect moved to another place, if that has a smaller loss.

        Smooth nominal errors approximate such an effect at any place. The cost therefore has a local minimum at every
        wavelength of these errors, and only a fit from each place finds the global one.
        """
        if len(step.effects) != 1 or not is_linear_structural(step.effects[0].kind) or step.effects[0].at is None:
            return None
        (effect,), domain = step.effects, self.search.rig.modes.domain
        self.search.progress("the same effect at other places", 0.6)
        places = [(effect.moved_to(where),) for where in other_places(effect, domain)]
        here, *others = fitted_to_quick(self.search, [(effect,), *places], step)
        elsewhere = [s for s in others if apart(s.effects[0], here.effects[0], domain)]
        near = _finalists(sorted(elsewhere, key=lambda s: s.fit.cost), SEARCH.max_cost_ratio * here.fit.cost)
        whole = self.search.in_parallel(fitted_to_all, near)
        best = min(whole, key=partial(loss, self.search), default=step)
        return best if loss(self.search, best) < loss(self.search, step) else None

    def _with_an_absorbed(self, step: JointFit) -> JointFit | None:
        """The step with one linear effect more that makes its implausible nominal errors much smaller, or None.

        Errors as large as those of the step may have absorbed that effect, and then leave no evidence of it. So the
        best ones without nominal errors are tried, with errors that start from zero.
        """
        if step.is_plausible or not step.effects or self.search.by_mode:
            return None
        self.search.progress("effects that errors of the model have absorbed", 0.6)
        named = {effect.kind for effect in step.effects}
        singles = [f.effects for f in self._linear_singles if f.effects[0].kind not in named][: SEARCH.few_finalists]
        tried = self.search.in_parallel(fit_from_zero, [(*step.effects, *each) for each in singles])
        noise = step.noise_power
        longest = step.description(noise) - STEPWISE.saved_nats
        found = [
            s for s in tried if s.description(noise) < longest and self.search.are_noticeable(s.effects, s.fit.effects)
        ]
        return replace(min(found, key=lambda s: s.description(noise)), others=tuple(found)) if found else None

    def _with_one_more(self, step: JointFit) -> JointFit | None:
        """The best set with one more effect, if it removes enough of the residual; else None."""
        self.tried_beside_input_noise = True
        tried = self._candidates_with_one_more(step)
        if not tried:
            return None
        with_late = with_late_accelerometer(self.search, step, tried)
        if with_late is not None:
            self.steps[-1] = with_late
            return self._with_one_more(with_late)
        best = self._best_of(tried, step)
        if not self._is_accepted(best, step):
            return None
        self.shows_unknown_law = self.search.clustered(best.effects)
        return None if self.shows_unknown_law else best

    def _candidates_with_one_more(self, step: JointFit) -> list[JointFit]:
        """The likeliest sets with one more effect, fitted to the two most informative records."""
        quick, first = most_informative(self.search.data, step.fit.cost_by_channel)
        self.search = search = replace(self.search, quick=quick, first=first)
        search.progress("another effect, with small errors of the model", 0.5 + 0.1 * len(step.effects))
        # the residual beyond nominal errors fitted to whole records is evidence of a missing effect
        with_errors = search.with_nominal_errors(step.errors)
        cost = cost_of(search.rig, step.fit.effects, with_errors.ahead)
        for process_noise in SELECTION.continuation[1:]:  # what grows slowly hides in the noise one step ahead
            if cost > 1.0 + STEPWISE.noise_excess or step.explains:
                break
            with_errors = replace(with_errors, process_noise=process_noise)
            cost = cost_of(search.rig, step.fit.effects, with_errors.ahead)
        rig = apply_all(search.rig, step.fit.effects)
        reconstruction = ForceReconstruction.of(rig, search.data, workers=search.workers, absorbed=True)
        ahead = one_more(with_errors, step.effects, reconstruction)
        if not ahead or ahead[0].cost > (1.0 - STEPWISE.least_gain_ahead) * cost:
            return []
        promising, as_good = (
            cost - share * (cost - ahead[0].cost) for share in (STEPWISE.tried_gain_share, STEPWISE.equal_gain_share)
        )
        chosen: list[tuple[Effect, ...]] = []
        for candidate in ahead:
            same_kind = sum(candidate.effects[-1].kind is others[-1].kind for others in chosen)
            if candidate.cost <= promising and same_kind < (2 if candidate.cost <= as_good else 1):
                chosen.append(candidate.effects)
        chosen = [*chosen[: SEARCH.finalists], *more_general_sets(step.effects)]
        return fitted_to_quick(self.search, chosen, step)

    def _best_of(self, tried: Sequence[JointFit], step: JointFit) -> JointFit:
        """The best set on all records, of candidates fitted to the most informative ones."""
        # the single effects fitted before nominal errors could absorb them compete too
        singles = [] if step.effects else self.fitted_singles
        search = self.search
        tried = sorted((s for s in tried if not may_be_transducer_errors(search, s.effects)), key=partial(loss, search))
        near = _finalists(tried, SEARCH.max_cost_ratio * tried[0].fit.cost) if tried else []
        whole = search.workers.map(lambda s: without_inactive(search, fitted_to_all(search, s)), near)
        # the most informative records overstate some
        whole = [s for s in whole if not may_be_transducer_errors(search, s.effects)]
        whole = sorted((*whole, *singles), key=partial(loss, search))
        return self._simplest(whole[0], whole[1:]) if whole else step

    def _simplest(self, best: JointFit, tried: Sequence[JointFit], others: Sequence[JointFit] = ()) -> JointFit:
        """The best step, or a simpler one that fits almost as well; its competitors are `others`, or those tried."""
        found = simplest_step(self.search, best, tried, self.ahead, self._gap)
        return replace(found, others=tuple(others or (best, *tried)))

    def _reselected(self, step: JointFit) -> JointFit:
        """The best of a step and its competitors (`others`), refitted in the current search."""
        others = [s for s in step.others if key_of(s.effects) != key_of(step.effects)]
        refitted = self.search.in_parallel(fitted_to_all, others)
        best, *rest = sorted((step, *refitted), key=partial(loss, self.search))
        return self._simplest(best, rest)

    def _is_accepted(self, best: JointFit, step: JointFit) -> bool:
        """Whether a set removes enough of the residual of a smaller one, or makes its nominal errors plausible."""
        if not self.search.are_noticeable(best.effects, best.fit.effects):
            return False
        # if nominal errors, sensor delays among them, explain the records, another small delay is no effect
        by_likelihood = step.explains and not is_timing(self.search, best.effects, TIMING)
        if (self.search.logged or by_likelihood) and is_likelier(self.search, best, step):
            return True
        noise = np.minimum(best.sensor_noise, step.sensor_noise)
        before, after = step.excess(noise), best.excess(noise)
        is_negligible = bool(step.effects) and before - after < SEARCH.negligible_share * self._gap
        share = STEPWISE.further_removed_share if step.effects and not is_negligible else STEPWISE.first_removed_share
        if not step.explains and before - after > share * before:
            return True
        longer, shorter = (s.description(noise, of_errors_alone=is_negligible) for s in (step, best))
        return not step.is_plausible and longer - shorter > STEPWISE.saved_nats

    def _without_errors(self, step: JointFit) -> Fit | None:
        """Few effects that explain the records without nominal errors as well as a step with them, or None."""
        if not self.closes_gap:
            return None
        search = self.search.with_noise(np.sqrt(step.sensor_noise) * self.search.data.noise)
        if step.logged > LEAST_LOGGED and not self.search.logged:
            search = with_input_noise(self.at_first, step.fit, step.sensor_noise) or search
        key, rig = key_of(step.effects), self.search.rig
        alternatives = [s.effects for s in self._others()[1:] if key not in contained(s.effects, rig)]
        found = in_place_of_nominal_errors(search, step, alternatives)
        if found is None:
            return None
        # uniform stiffness and damping errors together are nominal errors; one alone is an effect
        errors = {NOMINAL_ERRORS, *(UNIFORM if {e.kind for e in found.effects}.issuperset(UNIFORM) else ())}
        named = [effect for effect in found.effects if effect.kind not in errors]
        if not self.search.are_noticeable(named, found.effects):
            return None
        self.search = search
        return found

    def calibrate(self) -> bool:
        """Turn errors of gain and place too large for a careful laboratory into effects; True if there are any."""
        found = self.last if self.search.is_over else with_wrong_transducers(self.search, self.last)
        if found is self.last:
            return False
        # a lag of all channels weakens what is quick, which a gain may stand for
        late = with_delay_as_effect(self.search, self.last, SEARCH.explained_share * self._gap)
        is_late = late is not self.last and loss(self.search, late) < loss(self.search, found)
        self.steps.append(late if is_late else found)
        return True

    # Input noise and substeps, with which the selection continues

    def _with_input_noise(self, step: JointFit) -> JointFit | None:
        """The step refitted with input noise, if that whitens its residual; else None.

        The selection continues, and the steps before are evaluated, with input noise of the level that the residual
        of this step shows; without input noise if this step explains the records.
        """
        search = self.at_first
        without_noise = (
            fit_jointly(search, step.effects, step.errors) if self.search.logged else evaluated(search, step.fit)
        )
        noise = without_noise.sensor_noise
        is_loud = without_noise.excess(noise) > INPUTS.least_residual * float(noise.mean())
        if without_noise.logged < LEAST_LOGGED or not is_loud:
            return self._continue_in(search, step, without_noise) if self.search.logged else None
        noisy = with_input_noise(search, step.fit, noise)
        if noisy is None:
            return None
        fitted = fit_jointly(noisy, step.effects, step.errors)
        if (
            fitted.fit.cost < INPUTS.min_mean_square
        ):  # nominal errors had fitted the noise, so it was estimated too loud
            noisy = with_input_noise(search, fitted.fit, noise)
            if noisy is None:
                return None
            fitted = fit_jointly(noisy, step.effects, fitted.errors)
        if fitted.fit.cost < INPUTS.min_mean_square:
            return None
        # noise this loud masks most effects; if a single effect explains the residual, there is no input noise
        found = None if step.effects or self.search.logged else self._in_place_of_inputs(without_noise)
        if found is not None:
            self.steps.append(found)
            return None
        return self._continue_in(noisy, step, fitted)

    def _in_place_of_inputs(self, step: JointFit) -> JointFit | None:
        """The step with one more effect that explains the records without input noise, or None."""
        tried = [
            s for s in self._candidates_with_one_more(step) if not may_be_transducer_errors(self.search, s.effects)
        ]
        near = _finalists(sorted(tried, key=lambda s: s.fit.cost), SEARCH.near_noise)
        whole = self.search.in_parallel(fitted_to_all, near)
        found = [s for s in whole if s.explains and s.is_plausible and self._is_accepted(s, step)]
        if not found:
            return None
        best, *rest = sorted(found, key=lambda s: s.fit.cost)
        return self._simplest(best, rest)

    def _continue_in(self, search: Search, step: JointFit, fitted: JointFit) -> JointFit:
        """`fitted`, the step refitted in another search; the selection continues in that search."""
        self.search, self.tried_beside_input_noise = search, False
        self.steps = [fitted if s is step else replace(evaluated(search, s.fit), others=s.others) for s in self.steps]
        return fitted

    def _with_finer_substeps(self, step: JointFit) -> JointFit:
        """The step refitted with substeps fine enough to be exact, if its residual is close to the noise floor.

        The selection continues with these substeps: the error of coarser ones would pass for another effect.
        """
        rig, noise = apply_all(self.search.rig, step.fit.effects), step.noise_power
        is_near_noise = step.excess(noise) < STEPWISE.further_share * self._gap
        if not (step.effects and is_near_noise and is_stepped(rig)) or step.explains:
            return step
        data, substeps = self.search.data, self.search.data.substeps
        residual = data.residual(rig)
        while substeps < FINISH.substeps:
            finer = data.stepped(2 * substeps).residual(rig)
            change, residual = finer - residual, finer
            if float(change @ change) < STEPWISE.noise_floor * change.size:
                break
            substeps *= 2
        if substeps == data.substeps:
            return step
        self.has_finer_substeps = True
        self.search, self.at_first = (
            replace(each, data=each.data.stepped(substeps)) for each in (self.search, self.at_first)
        )
        return replace(fit_jointly(self.search, step.effects, step.errors, rounds=2), others=step.others)

    # The verdict

    def decision(self) -> Decision:
        """The verdict on the last set of effects."""
        beside = self.search if self.search.logged or self.has_finer_substeps else None
        if self.plain is not None:
            alternatives = self._alternatives_to_plain
            return Decision(
                "explained", self.plain, alternatives=alternatives, noise=self.search.data.noise, beside=beside
            )
        effects, left = self.last.effects, self.unexplained
        noise = np.sqrt(self.last.sensor_noise) * self.search.data.noise
        closed = self.closes_gap or (len(effects) > 1 and left < STEPWISE.several_effects_share)
        if effects and closed and not self.shows_unknown_law:
            return Decision("explained", self.last.fit, alternatives=self._alternatives(), noise=noise, beside=beside)
        if self.needs_no_effect:
            return Decision("none", self.last.fit, noise=noise, beside=beside)
        return Decision("part" if left < 0.5 else "unknown", self.last.fit, noise=noise, beside=beside)

    @cached_property
    def _alternatives_to_plain(self) -> Alternatives:
        """Other causes that explain the records as well as `plain`, with their probabilities."""
        return () if self.plain is None else other_delay_causes(self.search, self.plain)

    def _alternatives(self) -> Alternatives:
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
        return tuple((s.fit, float(p)) for s, p in likely if p > STEPWISE.min_probability)

    def _others(self) -> list[JointFit]:
        """The last set as it was selected, then the other candidates that explain the records or fit as well."""
        key = key_of(self.last.effects)
        chosen = next((s for s in reversed(self.steps) if s.others and key_of(s.effects) == key), None)
        if chosen is None:
            return []
        others = [s for s in chosen.others if key_of(s.effects) != key]
        # an alternative may have errors at the very bound of what is plausible
        return [chosen, *(s for s in others if s.explains or is_as_good(s, chosen, self._gap, share=1.0))]


def _law_of(step: JointFit) -> Effect | None:
    """The nonlinear law of the structure that is the one effect of a step, or None."""
    effect = step.effects[0] if len(step.effects) == 1 else None
    return effect if effect is not None and effect.kind.nonlinear and effect.kind.path not in TRANSDUCERS else None


def _finalists(steps: Sequence[JointFit], cost_limit: float) -> list[JointFit]:
    """The first of some steps that cost less than a limit on the most informative records."""
    return [step for step in steps if step.fit.cost < cost_limit][: SEARCH.few_finalists]
