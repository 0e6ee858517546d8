"""Damage detection and localisation: whether stiffness is lost over a part of the structure, and where.

Two models of the same modes are compared: mass and stiffness that vary smoothly, in as many terms as needed, and the
same with a share δ of the stiffness lost between two places. Each is fitted to the measured frequencies and shapes in
units of their standard errors. A loss is detected where it lowers

    χ² + n_terms ln n_data

below that of the undamaged model by more than noise would lower χ² anywhere along the structure, at the given
probability of a false alarm. No measurement of the undamaged structure is needed.
"""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2 as chi2_distribution

from workbench.identification.signal.modal_estimates import RefinedModes
from workbench.identification.signal.searches import CachedResidual
from workbench.identification.updating.distributions import Basis
from workbench.identification.updating.sensitivity import LocalLoss
from workbench.identification.updating.structure_fit import (
    LACKING,
    STRUCTURE,
    Candidates,
    FittedStructure,
    fitted,
    free_near,
    report,
    unexplained,
)
from workbench.identification.updating.structure_problem import PROBLEM, Problem, Task
from workbench.renamed import Renamed
from workbench.structure.member import Bar, Beam
from workbench.structure.printed import Printed, warns_of_remarks
from workbench.structure.supports import PointMass
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class LossSettings:
    """Constants of the search for a local loss."""

    trial_places: int = 60  # along the structure, at which losses are tried
    typical_width: float = 0.1  # of the length: its inverse is the number of independent places that are tested
    # of the length: a search converges from half to twice the width
    trial_widths: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4)
    starts_per_width: int = 2  # at most
    max_further_searches: int = 4  # along the structure after the first
    first_terms: int = 3  # of mass and stiffness in the first search, at most
    term_reduction: int = 2  # in the next search: many terms imitate a loss well
    draws: int = 20_000  # Monte Carlo samples of a loss, for intervals
    # χ² / degrees of freedom up to which standard errors may be too small, here twofold, and a loss is detected; true
    # losses of the study leave 1.8 at most, a mass of 1 % of the whole that the nominal structure lacks 40
    max_misfit_ratio: float = 4.0
    mass_places: int = 40  # along the structure, at which point masses are tried
    mass_step: float = 1e-3  # of the whole mass, by which the effect of a point mass is computed


LOSS = LossSettings()
FALSE_ALARM = 0.01


@dataclass(frozen=True, eq=False, repr=False)
class LocatedDamage(Printed):
    """The result of damage detection from modes.

    Attributes:
        undamaged: the best fit without a loss, or, where no number of terms comes near, that of the most terms.
        damaged: the best fit with a loss, whether or not it is significant.
        statistic: of the test: decrease of χ² + n_terms ln n_data by the loss, over χ² / degrees of freedom where
            `damaged` does not explain the modes either.
        threshold: of the statistic, exceeded by noise with the probability of a false alarm.
        with_mass: the best fit without a loss but with a point mass that the nominal structure lacks, the last of its
            attachments; its bands take that mass as known. None where it was not searched, as smooth distributions
            explain the modes.
    """

    undamaged: FittedStructure
    damaged: FittedStructure
    statistic: float
    threshold: float
    with_mass: FittedStructure | None = None

    smooth, lossy, evidence = Renamed("undamaged"), Renamed("damaged"), Renamed("statistic")
    limit, found = Renamed("threshold"), Renamed("detected")

    @property
    def detected(self) -> bool:
        """Whether a loss is detected: it is significant, explains the modes, and does so better than a point mass."""
        return self.statistic > self.threshold and self._explains_roughly(self.damaged) and self._by_mass is None

    @property
    def _by_mass(self) -> FittedStructure | None:
        """The fit with a point mass where it explains the modes, and better than a loss."""
        mass = self.with_mass
        better = mass is not None and mass.criterion < self.damaged.criterion and self._explains_roughly(mass)
        return mass if better else None

    @staticmethod
    def _explains_roughly(fit: FittedStructure) -> bool:
        """Whether a structure explains the modes, or would with standard errors up to twice as large."""
        return fit.explains or fit.chi2 <= LOSS.max_misfit_ratio * fit.degrees_of_freedom

    @property
    def loss(self) -> LocalLoss | None:
        """The detected loss: share, centre and width; None where none is detected."""
        return self.damaged.loss if self.detected else None

    @property
    def best(self) -> FittedStructure:
        """The fit to use."""
        return self.damaged if self.detected else self._by_mass or self.undamaged

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        test = f"statistic {self.statistic:.3g}, threshold {self.threshold:.3g}"
        if not self.detected:
            text = "no loss of stiffness is detected" if self.best.explains else "whether stiffness is lost is unknown"
            return f"{text} ({test})", (), (), self.remarks
        loss = zip(("share", "centre [m]", "width [m]"), self.damaged.parameters[-3:], self.interval(), strict=True)
        rows = [(name, f"{value:.4g}", f"{low:.4g} to {high:.4g}") for name, value, (low, high) in loss]
        return f"a loss of stiffness is detected ({test})", ("loss", "value", "95 % interval"), rows, self.remarks

    @property
    def remarks(self) -> tuple[str, ...]:
        """Other explanations of the modes, and whether the modes are explained at all."""
        remarks, loss, chi2_with_loss, mass = [], self.damaged.loss, self.damaged.chi2, self._by_mass
        assert loss is not None, "damaged is an explanation with a loss"
        if mass is not None:
            part = mass.structure.attachments[-1]
            remarks.append(
                f"a point mass of {part.pair[0]:.3g} kg at {part.at:.4g} m, which the nominal structure lacks,"
                f" explains the modes better than a loss: χ² {mass.chi2:.4g}, {chi2_with_loss:.4g} with the loss"
            )
        if not self.best.explains:
            place = f"{100 * loss.share:.2g} % at {loss.centre:.4g} m"
            text = f"; with a loss of {place} it is {chi2_with_loss:.4g}: no proof of damage"
            remarks.append(f"{unexplained(self.best)}{'' if self.detected else text}. {LACKING}")
        return tuple(remarks)

    def interval(self, level: float = 0.95) -> np.ndarray:
        """Confidence intervals of share, centre and width of the loss within the structure, (3, 2)."""
        estimate, length = self.damaged.parameters[-3:], self.damaged.structure.length
        rng, covariance = np.random.default_rng(0), self.damaged.covariance[-3:, -3:]
        share, centre, width = rng.multivariate_normal(estimate, covariance, LOSS.draws, method="eigh").T
        begin, end = np.clip([centre - 0.5 * width, centre + 0.5 * width], 0.0, length)
        tail = 0.5 * (1.0 - level)
        return np.asarray(np.quantile([share, 0.5 * (begin + end), end - begin], [tail, 1.0 - tail], axis=1).T)


@warns_of_remarks
@one_blas_thread
def locate_damage(
    measured: RefinedModes,
    nominal: Bar | Beam,
    *,
    basis: Callable[[int], Basis] | None = None,
    mass_terms: Iterable[int] = range(1, STRUCTURE.max_terms + 1),
    stiffness_terms: Iterable[int] = range(1, STRUCTURE.max_terms + 1),
    false_alarm: float = FALSE_ALARM,
    **known: Any,
) -> LocatedDamage:
    """Whether stiffness is lost over a part of the structure, and where, from its modes alone.

    Args:
        measured, nominal, basis, mass_terms, stiffness_terms: as `choose_structure`.
        false_alarm: chance that an undamaged structure is reported.
        known: `known_mass`, `known_stiffness`, priors and `numbers` of `fit_structure`.

    Raises:
        ValueError: as `fit_structure`.
        UserWarning: nothing explains the modes, or a point mass explains them better than a loss.
    """
    candidates = Candidates.of(Task.of(measured, nominal, **known), basis, mass_terms, stiffness_terms)
    # three parameters of a loss, tested at 1 / typical_width independent places
    threshold = float(chi2_distribution.isf(false_alarm * LOSS.typical_width, 3))
    damaged = _damaged(candidates)
    undamaged = _undamaged(candidates, damaged, threshold)
    if _statistic(candidates, undamaged, damaged) <= threshold:
        # too few terms may have led to a false place: search again with the terms of the undamaged fit
        other = _from_scan(candidates.problem(*undamaged.n_terms), damaged)
        if other.criterion < damaged.criterion - 1.0:
            damaged = _best_beside(candidates, other)
            undamaged = _undamaged(candidates, damaged, threshold)
    statistic = _statistic(candidates, undamaged, damaged)
    if not damaged.explains:  # not even a loss explains the modes: their standard errors are too small
        statistic = statistic * damaged.degrees_of_freedom / damaged.chi2
    with_mass = None if undamaged.explains else _with_mass(candidates, damaged)
    return LocatedDamage(undamaged, damaged, statistic, threshold, with_mass)


def _statistic(candidates: Candidates, undamaged: FittedStructure, damaged: FittedStructure) -> float:
    """Decrease of the criterion by a loss, without the penalty of its parameters, which the threshold accounts for."""
    return undamaged.criterion - damaged.criterion + 3.0 * candidates.task.penalty


def _first_terms(candidates: Candidates) -> tuple[int, int]:
    """Numbers of terms of mass and stiffness in a first search: many terms imitate a loss well."""
    return candidates.mass_terms[: LOSS.first_terms][-1], candidates.stiffness_terms[: LOSS.first_terms][-1]


def _damaged(candidates: Candidates) -> FittedStructure:
    """The best fit with a loss."""

    def continued(problem: Problem, near: FittedStructure | None) -> FittedStructure:
        assert near is not None, "a search along the structure comes first"
        return fitted(problem, near, near.loss)

    first = _from_scan(candidates.problem(*_first_terms(candidates)))
    damaged, n_fewer = candidates.best(continued, near=first, exhaust=False), 0
    for _ in range(LOSS.max_further_searches):
        if damaged.explains or n_fewer >= max(damaged.n_terms):
            break
        least = candidates.mass_terms[0], candidates.stiffness_terms[0]
        fewer = (max(n - n_fewer, fewest) for n, fewest in zip(damaged.n_terms, least, strict=True))
        other = _from_scan(candidates.problem(*fewer), damaged)
        if other.criterion < damaged.criterion - 1.0:
            damaged, n_fewer = _best_beside(candidates, other), 0
        else:
            n_fewer += LOSS.term_reduction
    return damaged


def _best_beside(candidates: Candidates, other: FittedStructure) -> FittedStructure:
    """The best fit with a loss, searched from the best so far and from `other`: more terms may move the loss."""

    def likelier(problem: Problem, near: FittedStructure | None) -> FittedStructure:
        return _likeliest(problem, [(start, start.loss) for start in (near, other) if start is not None])

    return candidates.best(likelier, near=other)


def _undamaged(candidates: Candidates, damaged: FittedStructure, threshold: float) -> FittedStructure:
    """The best fit without a loss; a single fit where it suffices to decide the test."""

    def fit_of(*n_terms: int) -> FittedStructure | None:
        with suppress(ValueError):
            return fitted(candidates.problem(*n_terms), damaged)
        return None

    equal_terms = fit_of(*damaged.n_terms)
    if equal_terms is not None and equal_terms.chi2 - damaged.chi2 <= threshold:
        return candidates.with_spare_terms(equal_terms)
    most_terms = fit_of(candidates.mass_terms[-1], candidates.stiffness_terms[-1])
    if most_terms is not None and most_terms.chi2 - damaged.criterion + 3.0 * candidates.task.penalty > threshold:
        return most_terms
    return candidates.best()


def _with_mass(candidates: Candidates, damaged: FittedStructure) -> FittedStructure | None:
    """The best fit without a loss but with one more point mass; None where no fit converges."""
    best: FittedStructure | None = None
    for n_terms in dict.fromkeys((_first_terms(candidates), damaged.n_terms)):
        problem = candidates.problem(*n_terms)
        starts = [(intact, part) for intact in _without_loss(problem) for part in _likely_masses(problem, intact)]
        if best is not None:
            starts.append((best, cast(PointMass, best.structure.attachments[-1])))
        for near, part in starts:
            with suppress(ValueError):
                fit = _fit_near_mass(problem, near, part)
                if best is None or fit.criterion < best.criterion:
                    best = fit
    return best


def _from_scan(problem: Problem, near: FittedStructure | None = None) -> FittedStructure:
    """The maximum likelihood structure with a loss, searched from the likeliest places and from an earlier fit."""
    starts = [(intact, loss) for intact in _without_loss(problem) for loss in _likely_losses(problem, intact)]
    return _likeliest(problem, starts if near is None else [*starts, (near, near.loss)])


def _without_loss(problem: Problem) -> list[FittedStructure]:
    """Structures from which losses are searched: the nominal one, and the fitted one, which may imitate a loss."""
    structures = []
    with suppress(ValueError):
        structures.append(report(problem, problem.start()))
    with suppress(ValueError):
        structures.append(fitted(problem))
    return structures


def _likeliest(problem: Problem, starts: Sequence[tuple[FittedStructure, LocalLoss | None]]) -> FittedStructure:
    """The likeliest result of searches from several starts; those that fail are skipped."""
    fits, reason = [], "no structure of so many terms could be fitted, so no loss can be located; use fewer terms"
    for near, loss in starts:
        try:
            fits.append(fitted(problem, near, loss))
        except ValueError as error:
            reason = str(error)
    if not fits:
        raise ValueError(reason)
    return min(fits, key=lambda fit: fit.chi2)


def _likely_losses(problem: Problem, intact: FittedStructure) -> list[LocalLoss]:
    """Losses at the peaks of `scan`, for each width; none where no loss lowers χ²."""
    places, gains = scan(problem, intact)
    widths = zip(LOSS.trial_widths, gains, strict=True)
    length = problem.series.nominal.length
    return [LocalLoss(0.1, float(places[i]), width * length) for width, gain in widths for i in _highest_peaks(gain)]


def _highest_peaks(gain: np.ndarray) -> list[int]:
    """Indices of the highest local maxima of a gain along the structure, at most `LOSS.starts_per_width`."""
    peaks = np.flatnonzero(np.r_[True, gain[1:] >= gain[:-1]] & np.r_[gain[:-1] >= gain[1:], True] & (gain > 0.0))
    return sorted(peaks.tolist(), key=lambda i: -gain[i])[: LOSS.starts_per_width]


def scan(problem: Problem, undamaged: FittedStructure) -> tuple[np.ndarray, np.ndarray]:
    """First-order decrease of χ² by a loss of each of `LOSS.trial_widths` at places along the structure.

    Returns:
        places (n_places,), m; decrease (n_widths, n_places).
    """
    length, stiffness = problem.series.nominal.length, problem.series.stiffness
    places = (np.arange(LOSS.trial_places) + 0.5) / LOSS.trial_places * length
    e = undamaged.parameters[undamaged.n_terms[0] :]

    def with_losses(x: np.ndarray) -> np.ndarray:
        terms = stiffness.functions(x)
        hats = np.maximum(1.0 - np.abs(x[:, None] - places) * LOSS.trial_places / length, 0.0)
        return np.hstack([terms, -(1.0 + terms @ e)[:, None] * hats])

    breaks = tuple(np.linspace(0.0, length, 11))
    with_hats = Basis(with_losses, e.size + LOSS.trial_places, (*stiffness.breaks, *breaks))
    mass_held, (particular, free) = problem.held
    stiffness_held = np.r_[particular, np.zeros(LOSS.trial_places)], block_diag(free, np.eye(LOSS.trial_places))
    trial = replace(problem, series=replace(problem.series, stiffness=with_hats), held=(mass_held, stiffness_held))
    residuals, slopes = trial.residuals(np.r_[problem.free_of(undamaged.parameters), np.zeros(LOSS.trial_places)])
    # the part of each effect orthogonal to the smooth series
    smooth = np.linalg.qr(slopes[:, : -LOSS.trial_places])[0]
    effects = slopes[:, -LOSS.trial_places :] - smooth @ (smooth.T @ slopes[:, -LOSS.trial_places :])
    distance = np.abs(places[:, None] - places) / length
    gains = []
    for width in LOSS.trial_widths:
        losses = effects @ (distance < 0.5 * width)
        gains.append(np.maximum(-losses.T @ residuals, 0.0) ** 2 / np.maximum((losses**2).sum(axis=0), 1e-300))
    return places, np.array(gains)


def _with_point_mass(problem: Problem, at: float, mass: float) -> Problem:
    """The problem with a further point mass (kg) at a place (m)."""
    nominal = problem.series.nominal
    heavier = replace(nominal, attachments=(*nominal.attachments, PointMass(at, mass)))
    return replace(problem, series=replace(problem.series, nominal=heavier))


def _whole_mass(problem: Problem) -> float:
    """Mass of the nominal structure without attachments, kg."""
    nominal = problem.series.nominal
    return float(nominal.length * nominal.mass_per_length(np.linspace(0.0, nominal.length, 101)).mean())


def _likely_masses(problem: Problem, intact: FittedStructure) -> list[PointMass]:
    """Point masses at the peaks of the first-order decrease of χ² along the structure."""
    z, whole = free_near(problem, intact), _whole_mass(problem)
    step = LOSS.mass_step * whole
    residuals, slopes = problem.residuals(z)
    smooth = np.linalg.qr(slopes)[0]
    places = np.linspace(0.0, problem.series.nominal.length, LOSS.mass_places)
    effects = np.stack([(_with_point_mass(problem, at, step).residuals(z)[0] - residuals) / step for at in places])
    effects -= (effects @ smooth) @ smooth.T
    squares = np.maximum((effects**2).sum(axis=1), 1e-300)
    masses = -(effects @ residuals) / squares
    gain = np.where(masses > 0.0, masses**2 * squares, 0.0)
    return [PointMass(float(places[i]), float(min(masses[i], whole))) for i in _highest_peaks(gain)]


def _fit_near_mass(problem: Problem, near: FittedStructure, part: PointMass) -> FittedStructure:
    """The maximum likelihood structure with a point mass, searched from `near` and `part`."""
    scale = np.array([problem.series.nominal.length, _whole_mass(problem)])
    n_free, least, most = problem.n_free, np.zeros(2), np.array([1.0, np.inf])

    def residuals(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _with_point_mass(problem, *(z[-2:] * scale)).residuals(z[:-2])

    def fit(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows, slopes = residuals(z)
        columns = []
        for step in 1e-5 * np.eye(2):
            before, after = np.clip(z[-2:] - step, least, most), np.clip(z[-2:] + step, least, most)
            change = residuals(np.r_[z[:-2], after])[0] - residuals(np.r_[z[:-2], before])[0]
            columns.append(change / (after - before).sum())
        return rows, np.column_stack([slopes, *columns])

    start = np.r_[free_near(problem, near), np.clip([part.at, part.pair[0]] / scale, 1e-4, [1.0 - 1e-4, np.inf])]
    bounds = np.r_[np.full(n_free, -np.inf), least], np.r_[np.full(n_free, np.inf), most]
    z = CachedResidual(fit).least(start, PROBLEM.max_steps, bounds=bounds, ftol=1e-5)
    found = report(_with_point_mass(problem, *(z[-2:] * scale)), z[:-2])
    penalised = found.criterion + 2.0 * problem.task.penalty
    return replace(found, degrees_of_freedom=found.degrees_of_freedom - 2, criterion=penalised)
