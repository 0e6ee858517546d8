"""Simpler sets of effects that fit as well beside nominal errors: limiting cases, and backward elimination."""

from collections.abc import Sequence
from functools import partial

from workbench.gap.effects.effect import contained, each_left_out, key_of, merged_sets, simpler_sets, with_one_simpler
from workbench.gap.search.errors_as_effects import may_be_transducer_errors
from workbench.gap.search.fit import Fit, parameters_of
from workbench.gap.search.jointly import (
    JointFit,
    fit_jointly,
    fitted_to_all,
    fitted_to_quick,
    surely_prefers,
    too_large,
)
from workbench.gap.search.search import Search, best_of_each_kind
from workbench.gap.search.settings import JOINT, SEARCH, STEPWISE


def size_of_set(search: Search, step: JointFit) -> tuple[int, int]:
    """Number of parameters and of effects: of as many parameters, one effect is simpler than two."""
    return len(parameters_of(search.rig, step.effects)), len(step.effects)


def simplest_step(
    search: Search, best: JointFit, tried: Sequence[JointFit], ahead: Sequence[Fit], gap: float
) -> JointFit:
    """The best step, or a simpler set (a limiting case, or fewer effects) that fits almost as well.

    Args:
        best: fitted to all records.
        tried: other sets, likewise.
        ahead: fits of single effects to one-step-ahead predictions, best first.
        gap: power of the nominal residual above the noise, in units of the stated noise.
    """
    as_good = [s for s in (best, *tried) if len(s.effects) > 1 and not surely_prefers(search, best, s)]
    simpler = [
        *simpler_sets(best.effects, search.rig),
        *merged_sets(best.effects),
        *(fewer for s in as_good for fewer in each_left_out(s.effects)),
    ]
    on_quick = fitted_to_quick(search, simpler, best)
    sets = [*tried, *_refitted_to_all(search, on_quick, best, gap), *_simpler_singles(search, best, ahead)]
    # implausible nominal errors may have absorbed the effect that is left out
    sets = [s for s in sets if s.is_plausible or not best.is_plausible]
    size = partial(size_of_set, search)
    # a set of as many parameters may fit better: friction, for a hysteretic spring that always slides
    best = min((best, *(s for s in sets if size(s) == size(best))), key=lambda s: s.fit.cost)
    excess_limit = (1.0 + STEPWISE.simpler_increase) * max(best.excess(best.sensor_noise), STEPWISE.simpler_increase)
    limiting_cases = contained(best.effects, search.rig)
    fewer = [
        step
        for step in sets
        if (size(step) < size(best) or key_of(step.effects) in limiting_cases)
        and step.excess(best.sensor_noise) < excess_limit
        and not surely_prefers(search, best, step)
    ]
    return min(fewer, key=lambda s: (size(s), s.fit.cost)) if fewer else best


def _refitted_to_all(search: Search, on_quick: Sequence[JointFit], best: JointFit, gap: float) -> Sequence[JointFit]:
    """The steps; those that may be as good as `best`, which was fitted to all records, are refitted to all."""
    if not best.explains:
        return on_quick
    cost_limit = max(SEARCH.max_cost_ratio * best.fit.cost, SEARCH.negligible_share * gap)
    return search.workers.map(
        lambda s: fit_jointly(search, s.effects, s.errors, rounds=2) if s.fit.cost < cost_limit else s, on_quick
    )


def _simpler_singles(search: Search, best: JointFit, ahead: Sequence[Fit]) -> list[JointFit]:
    """Single effects of fewer parameters that fit almost as well as a single effect, fitted to all records."""
    if len(best.effects) != 1 or not ahead:
        return []
    size, nominal = size_of_set(search, best)[0], search.nominal_ahead
    good = nominal - STEPWISE.equal_gain_share * (nominal - ahead[0].cost)
    likely = [f.effects for f in best_of_each_kind(ahead) if f.cost <= good and f.n_parameters < size]
    on_quick = fitted_to_quick(search, likely, best)
    near = [step for step in on_quick if step.fit.cost < SEARCH.max_cost_ratio * best.fit.cost]
    fitted = [fitted_to_all(search, step) for step in near]
    return [step for step in fitted if not may_be_transducer_errors(search, step.effects)]


def limiting_case(search: Search, step: JointFit, gap: float) -> JointFit:
    """The step with effects replaced by limiting cases that fit as well, if no set explains the records.

    Any law fits some of the residual of a measured gap, so a slightly smaller residual justifies no wider law.
    """
    if step.explains:
        return step
    limits = fitted_to_quick(search, list(with_one_simpler(step.effects, search.rig)), step)
    as_good = [s for s in search.in_parallel(fitted_to_all, limits) if is_as_good(s, step, gap)]
    return limiting_case(search, min(as_good, key=lambda s: s.fit.cost), gap) if as_good else step


def is_as_good(step: JointFit, best: JointFit, gap: float, *, share: float = JOINT.plausible_share) -> bool:
    """Whether a step with plausible nominal errors fits almost as well as the best, which does not explain the gap.

    Implausible nominal errors do not count: they may have absorbed an effect.

    Args:
        share: of the largest plausible errors: larger ones are implausible.
    """
    more = step.excess(best.sensor_noise) - best.excess(best.sensor_noise)
    return not (too_large(step.errors, share=share) or best.explains) and more < SEARCH.negligible_share * gap


def backward_eliminated(search: Search, step: JointFit) -> JointFit:
    """The step after backward elimination: without effects that later ones have made unnecessary."""
    fewer = fitted_to_quick(search, list(each_left_out(step.effects)), step) if step.effects else []
    if not fewer:  # no effect can act without the others
        return step
    best = min(fewer, key=lambda s: s.fit.cost)
    excess_limit = (1.0 + STEPWISE.smaller_increase) * max(step.excess(step.sensor_noise), STEPWISE.simpler_increase)
    is_needless = best.excess(step.sensor_noise) < excess_limit and (best.is_plausible or not step.is_plausible)
    return backward_eliminated(search, best) if is_needless else step


def without_inactive(search: Search, step: JointFit) -> JointFit:
    """The step without effects that no longer alter the readings, because another has replaced them."""
    kept = search.noticeable(step.effects, step.fit.effects)
    if len(kept) in (0, len(step.effects)):
        return step
    return without_inactive(search, fit_jointly(search, kept, step.errors, rounds=2))
