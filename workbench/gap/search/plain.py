"""Few effects that say the same as many small errors of the nominal model."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.limiting_cases import simpler_sets
from workbench.gap.effects.nominal import NOMINAL_ERRORS, NominalPrior, group_of, nominal_errors
from workbench.gap.effects.structural import MODAL_DAMPING, MODULUS_ERROR
from workbench.gap.search.fit import Fit, fit
from workbench.gap.search.pursuit import FINE, one_more
from workbench.gap.search.search import Search, spread_over_kinds
from workbench.structure.member import Structure

COMMON = (MODULUS_ERROR, MODAL_DAMPING)  # errors of all along, or of all modes: the nominal errors hold them too
MOST_COMMON = {"modulus_error": 0.05, "modal_damping": 0.5}  # logarithms: more is an effect of its own
MOST_ALONE = {"modulus_error": 0.015, "modal_damping": 0.25}  # likewise, where only one of them is there
PLAINLY = 8  # iterations without errors
NEAR = 2.0  # times the noise power that a fit may leave of the quick records, to be fitted to all
LIKELIEST = 4  # kinds of the one more that are tried


def are_common(effects: Sequence[Effect]) -> bool:
    """Whether effects are the errors common to all modes and all along, each no larger than errors may be."""
    most = {kind.name: MOST_COMMON[kind.name] for kind in COMMON}
    return {effect.kind for effect in effects} == set(COMMON) and all(
        abs(np.log(effect.values["factor"])) < most[effect.kind.name] for effect in effects
    )


def common_as_errors(search: Search, found: Fit) -> Fit:
    """The fit with common errors, small and beside an effect, as errors of the nominal model."""
    common = [e for e in found.effects if e.kind in COMMON]
    most = MOST_ALONE if len(common) == 1 else MOST_COMMON
    others = [e for e in found.effects if e.kind not in COMMON]
    large = any(abs(np.log(e.values["factor"])) >= most[e.kind.name] for e in common)
    if not common or not others or large or any(e.kind is NOMINAL_ERRORS for e in others):
        return found
    if not isinstance(search.rig.structure, Structure):
        return found
    logarithm = {e.kind.name: float(np.log(e.values["factor"])) for e in common}
    stiffness, damping = (logarithm.get(kind.name, 0.0) for kind in COMMON)
    prior = NominalPrior(
        stiffness=abs(stiffness), damping=abs(damping), sample_time=search.data.records[0].sample_time, waves=1
    )
    errors = nominal_errors(search.rig, prior)
    values = {name: stiffness if group_of(name) == "stiffness" else damping for name in errors.values}
    return replace(found, effects=(*others, replace(errors, values=values)), covariance=None)


def in_place_of_errors(search: Search, effects: tuple[Effect, ...]) -> Fit | None:
    """The effects, or one more, that leave only noise without errors of the nominal model, or with common ones alone.

    They say the same with fewer numbers than errors of their own for every mode and wave.

    Args:
        search: with the noise found beside the errors.
        effects: that were found beside the errors.
    """
    named = {effect.kind for effect in effects}
    common = tuple(Effect(kind, None, {"factor": 1.0}) for kind in COMMON if kind not in named)
    if not effects:
        return None if _explaining(search, [common]) else _one_more(search, common, ())  # None: errors they are
    sets = [effects, *((*effects, effect) for effect in common), (*effects, *common)]
    if len(effects) > 1:  # what stood in for errors, or bent to them, may be needless or simpler without
        fewer = [tuple(other for other in effects if other is not effect) for effect in effects]
        sets += [*fewer, *(s for given in (effects, *fewer) for s in simpler_sets(given, search.rig))]
    return _explaining(search, sets) or _one_more(search, effects, common)


def _explaining(search: Search, sets: Sequence[tuple[Effect, ...]]) -> Fit | None:
    """The simplest of sets that leaves only noise."""
    quickly = search.workers.map(lambda s: fit(search.rig, s, search.quick, iterations=PLAINLY), list(sets))
    for candidate in sorted((f for f in quickly if f.cost < NEAR), key=lambda f: f.n_parameters):
        found = fit(search.rig, candidate.effects, search.data.stepped(FINE), iterations=PLAINLY)
        if search.explains(found):
            return found
    return None


def _one_more(search: Search, effects: tuple[Effect, ...], common: tuple[Effect, ...]) -> Fit | None:
    """The effects and another, linear as errors are, that stands for those of every mode and wave."""
    linear = tuple(kind for kind in search.catalogue if not kind.nonlinear)
    search = replace(search, catalogue=linear)
    given = fit(search.rig, effects, search.quick, iterations=PLAINLY).effects
    evidence = search.evidence_of(apply_all(search.rig, given))
    ahead = [f.effects for f in spread_over_kinds(one_more(search, given, evidence), 1)][:LIKELIEST]
    return _explaining(search, [set_ for more in ahead for set_ in dict.fromkeys((more, (*more, *common)))])
