"""A set of effects brought to its end: finer steps, other places, simpler forms, and its rank among others."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from workbench.gap.effects.containment import simpler_forms
from workbench.gap.fit import Fit, cost_of, fit
from workbench.gap.search import Search


def finished(search: Search, candidate: Fit) -> Fit:
    """The same set on all records with finer substeps, to the end."""
    return fit(search.rig, candidate.effects, search.data.stepped(8), iterations=12, tolerance=1e-7)


def relocated(search: Search, candidate: Fit) -> Fit:
    """The set with its places tried elsewhere: a symmetric structure has a twin valley at the mirrored place."""
    length = search.rig.modes.length
    places = [*(length * np.linspace(0.04, 0.96, 13))]
    for i, effect in enumerate(candidate.effects):
        if "at" not in effect.values or effect.kind.path not in ("structure", "environment"):
            continue
        moved = []
        for at in (length - effect.values["at"], *places):
            elsewhere = replace(effect, values={**effect.values, "at": float(at)})
            effects = (*candidate.effects[:i], elsewhere, *candidate.effects[i + 1 :])
            moved.append((cost_of(search.rig, effects, search.quick), effects))
        moved.sort(key=lambda item: item[0])
        # the mirrored place is always worth a fit of its own, whatever its cost before it
        mirrored = (
            *candidate.effects[:i],
            replace(effect, values={**effect.values, "at": length - effect.values["at"]}),
        )
        trials = [moved[0][1], moved[1][1], (*mirrored, *candidate.effects[i + 1 :])]
        for effects in trials:
            started = fit(search.rig, effects, search.quick, iterations=6)
            trial = fit(search.rig, started.effects, search.data, iterations=10)
            if trial.cost < candidate.cost:
                candidate = trial
    return finished(search, candidate)


def simplest(search: Search, candidate: Fit) -> Fit:
    """The set with each effect replaced by one it contains as a limit, where the records cannot tell them apart."""
    improved = True
    while improved:
        improved = False
        for i, effect in enumerate(candidate.effects):
            for simpler in simpler_forms(effect, search.rig):
                effects = (*candidate.effects[:i], simpler, *candidate.effects[i + 1 :])
                trial = fit(search.rig, effects, search.data.stepped(8), iterations=12, tolerance=1e-7)
                extra = max(candidate.n_parameters - trial.n_parameters, 1)
                if search.explains(trial) and not search.surely_better(candidate, trial.cost, extra):
                    candidate, improved = trial, True
                    break
            if improved:
                break
    return candidate


def ranked(search: Search, fits: Sequence[Fit]) -> tuple[Fit, tuple[tuple[Fit, float], ...]]:
    """The set of least description length, and the others with their probabilities.

    The likelihood of tens of thousands of values is over-confident of small misfits, so its logarithm counts half.
    """
    n = search.data.n_values
    distinct: dict[tuple, Fit] = {}
    for candidate in sorted(fits, key=lambda f: f.cost):
        distinct.setdefault(candidate.key, candidate)
    fits = list(distinct.values())
    score = np.array([n * f.cost + f.n_parameters * np.log(n) for f in fits])
    order = np.argsort(score)
    weights = np.exp(-0.25 * (score[order] - score[order[0]]))
    weights /= weights.sum()
    rivals = tuple((fits[i], float(w)) for i, w in zip(order[1:], weights[1:], strict=True))
    return fits[order[0]], rivals[:6]
