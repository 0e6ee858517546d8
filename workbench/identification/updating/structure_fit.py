"""How many terms of mass and stiffness the modes of a structure call for: the fewest whose modes cannot be
distinguished from the measured.

Schwarz's criterion χ² + n_terms ln n_data (Ann. Statist. 6, 1978) is not lowered by a term that is not needed.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from workbench.identification.signal.modal_estimates import Refined
from workbench.identification.updating.distributions import Basis
from workbench.identification.updating.structure_problem import Problem
from workbench.identification.updating.structure_task import FittedStructure, GaussianPrior, Task
from workbench.structure.member import Bar, Beam
from workbench.structure.printed import warns_of_remarks
from workbench.threads import one_blas_thread

MOST_TERMS = 8
SPARE = 2  # terms next in line that bands leave free too


@warns_of_remarks
@one_blas_thread
def fit_structure(
    measured: Refined,
    nominal: Bar | Beam,
    *,
    mass: Basis,
    stiffness: Basis,
    known_mass: Sequence[tuple[float, float]] = (),
    known_stiffness: Sequence[tuple[float, float]] = (),
    mass_prior: GaussianPrior | None = None,
    stiffness_prior: GaussianPrior | None = None,
    numbers: Sequence[int] | None = None,
) -> FittedStructure:
    """Mass and stiffness as series of given terms, with the covariance that the modes leave them.

    Frequencies and shapes of any scale say nothing of the overall size: either mass or stiffness must be known
    somewhere, or be nominal (no terms), or have a prior.

    Args:
        measured: of `refine` or `identify`; sensors must be placed.
        nominal: ends, attachments, and the first estimates m_0 and k_0; uniform where nothing is known of them.
        mass, stiffness: functions of the relative changes; `Basis.polynomial(0)` keeps the nominal ones.
        known_mass, known_stiffness: ((x, value), ...), held exactly.
        mass_prior, stiffness_prior: how far the nominal ones are to be trusted; not at all without.
        numbers: of the structure's elastic modes, from 1, that the measured are; paired by their shapes unless given.

    Raises:
        ValueError: overall size unknown, more terms than data, known values the series cannot take, unplaced sensors,
            a measured mode that looks like none of the nominal structure.
        UserWarning: the structure does not explain the modes, so that its distributions may be far from the truth.
    """
    task = Task.of(measured, nominal, known_mass, known_stiffness, mass_prior, stiffness_prior, numbers)
    return Problem.of(task, mass, stiffness).fit()


@warns_of_remarks
@one_blas_thread
def choose_structure(
    measured: Refined,
    nominal: Bar | Beam,
    *,
    basis: Callable[[int], Basis] | None = None,
    mass_terms: Iterable[int] = range(1, MOST_TERMS + 1),
    stiffness_terms: Iterable[int] = range(1, MOST_TERMS + 1),
    **known: Any,
) -> FittedStructure:
    """Mass and stiffness as series, their numbers of terms selected by `FittedStructure.criterion`.

    Args:
        measured, nominal: as `fit_structure`.
        basis: number of terms -> `Basis`; polynomials unless given.
        mass_terms, stiffness_terms: numbers to choose from.
        known: `known_mass`, `known_stiffness`, `mass_prior`, `stiffness_prior`, `numbers` of `fit_structure`.

    Raises:
        ValueError, UserWarning: as `fit_structure`.
    """
    task = Task.of(measured, nominal, **known)
    terms = sorted(mass_terms), sorted(stiffness_terms)
    return choose(task, basis, *terms, lambda problem, near: problem.fit(near))


def choose(
    task: Task,
    basis: Callable[[int], Basis] | None,
    mass_terms: list[int],
    stiffness_terms: list[int],
    fit: Callable[[Problem, FittedStructure | None], FittedStructure],
    *,
    near: FittedStructure | None = None,
    exhaust: bool = True,
) -> FittedStructure:
    """The fit of least criterion, from the fewest terms up as long as one or two more of either lower it; of all
    numbers, with `exhaust`, where that leaves modes unexplained. Each is searched from the best so far, `near` too."""
    basis = basis or partial(Basis.legendre, length=task.nominal.length)
    tried: dict[tuple[int, int], FittedStructure | None] = {}
    best: FittedStructure | None = None
    at, ahead, exhausted, reason = (0, 0), 3, False, "no number of terms was given"
    while True:
        for i in range(at[0], min(at[0] + ahead, len(mass_terms))):
            for j in range(at[1], min(at[1] + ahead, len(stiffness_terms))):
                if (i, j) in tried:
                    continue
                from_near = best is None or (near is not None and near.criterion < best.criterion)
                try:
                    tried[i, j] = fit(
                        Problem.of(task, basis(mass_terms[i]), basis(stiffness_terms[j])), near if from_near else best
                    )
                except ValueError as error:
                    tried[i, j], reason = None, str(error)
        good = {pair: found for pair, found in tried.items() if found is not None}
        if not good:
            raise ValueError(reason)
        least = min(good, key=lambda pair: good[pair].criterion)
        better, best, at = good[least] is not best, good[least], least
        if better:
            continue
        if best.explains or exhausted or not exhaust:
            return with_spare_terms(best, task, basis)
        ahead, exhausted = len(mass_terms) + len(stiffness_terms), True


def with_spare_terms(chosen: FittedStructure, task: Task, basis: Callable[[int], Basis]) -> FittedStructure:
    """The same structure, the terms next in line left free as well in what is said of its errors.

    They are too small to stand out of the noise, not zero: left out, they would be missed by the bands (undersmoothing,
    Hall, Ann. Statist. 20, 1992).
    """
    try:
        problem = Problem.of(task, *(basis(n + SPARE if n else 0) for n in chosen.n_terms))
        wide = problem.report(problem.free_near(chosen))
    except ValueError:
        return chosen
    if wide.chi2 > chosen.chi2 + 1.0:  # a basis that does not hold the smaller one
        return chosen
    kept = ("n_terms", "chi2", "degrees_of_freedom", "criterion")
    return replace(wide, **{name: getattr(chosen, name) for name in kept})
