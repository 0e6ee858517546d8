"""Model order of series for mass and stiffness: the fewest terms whose modes agree with the measured ones.

By the Bayesian information criterion χ² + n_terms ln n_data (Schwarz, Ann. Statist. 6, 1978), which an unneeded term
does not lower.
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
SPARE = 2  # further terms that are free in the confidence bands


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
    """Mass and stiffness as series of given terms, with the covariance that the measured modes give.

    Frequencies and shapes of any scale do not determine a common factor of mass and stiffness: either must be known
    somewhere, or be nominal (no terms), or have a prior.

    Args:
        measured: of `refine` or `identify`; sensors must be placed.
        nominal: ends, attachments, and the nominal m_0 and k_0; uniform where nothing is known of them.
        mass, stiffness: functions of the relative changes; `Basis.polynomial(0)` keeps the nominal ones.
        known_mass, known_stiffness: ((x, value), ...), held exactly.
        mass_prior, stiffness_prior: deviation expected from the nominal ones; no prior unless given.
        numbers: of the structure's elastic modes, from 1, that were measured; paired by their shapes unless given.

    Raises:
        ValueError: common factor unknown, more terms than data, known values the series cannot take, unplaced sensors,
            a measured mode that resembles no mode of the nominal structure.
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
    """The fit of the least criterion over the numbers of terms.

    From the fewest terms up, as long as one or two more terms of mass or stiffness lower the criterion; over all
    numbers, with `exhaust`, where that leaves the modes unexplained. Each fit starts from the best so far, or from
    `near`.
    """
    basis = basis or partial(Basis.legendre, length=task.nominal.length)
    tried: dict[tuple[int, int], FittedStructure | None] = {}
    best: FittedStructure | None = None
    start, n_ahead, exhausted, reason = (0, 0), 3, False, "no number of terms was given"
    while True:
        for i in range(start[0], min(start[0] + n_ahead, len(mass_terms))):
            for j in range(start[1], min(start[1] + n_ahead, len(stiffness_terms))):
                if (i, j) in tried:
                    continue
                starts_from_near = best is None or (near is not None and near.criterion < best.criterion)
                try:
                    tried[i, j] = fit(
                        Problem.of(task, basis(mass_terms[i]), basis(stiffness_terms[j])),
                        near if starts_from_near else best,
                    )
                except ValueError as error:
                    tried[i, j], reason = None, str(error)
        fits = {pair: result for pair, result in tried.items() if result is not None}
        if not fits:
            raise ValueError(reason)
        least = min(fits, key=lambda pair: fits[pair].criterion)
        better, best, start = fits[least] is not best, fits[least], least
        if better:
            continue
        if best.explains or exhausted or not exhaust:
            return with_spare_terms(best, task, basis)
        n_ahead, exhausted = len(mass_terms) + len(stiffness_terms), True


def with_spare_terms(chosen: FittedStructure, task: Task, basis: Callable[[int], Basis]) -> FittedStructure:
    """The chosen structure, with confidence bands in which the next `SPARE` terms are free as well.

    These terms are below the noise but not zero: without them the bands would be too narrow (undersmoothing, Hall, Ann.
    Statist. 20, 1992).
    """
    try:
        problem = Problem.of(task, *(basis(n + SPARE if n else 0) for n in chosen.n_terms))
        wider = problem.report(problem.free_near(chosen))
    except ValueError:
        return chosen
    if wider.chi2 > chosen.chi2 + 1.0:  # a basis that does not contain the smaller one
        return chosen
    kept = ("n_terms", "chi2", "degrees_of_freedom", "criterion")
    return replace(wider, **{name: getattr(chosen, name) for name in kept})
