"""Is stiffness lost over a part of the structure, and where?

Two explanations of the same modes compete: mass and stiffness that vary smoothly, in as many terms as it takes, and
the same with a share δ of the stiffness lost between two places. Each is fitted to the measured frequencies and shapes
in units of their standard errors. A loss is reported where it lowers

    χ² + n_terms ln n_data

below that of the undamaged explanation by more than noise would lower χ² anywhere along the structure, but for the
probability of a false alarm. No measurement of the undamaged structure is needed.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_distribution

from workbench.identification.signal.modal_estimates import Refined
from workbench.identification.updating.distributions import Basis
from workbench.identification.updating.sensitivity import LocalLoss, SeriesStructure
from workbench.identification.updating.structure_fit import MOST_TERMS, choose, with_spare_terms
from workbench.identification.updating.structure_problem import PROBLEM, Problem
from workbench.identification.updating.structure_task import LACKING, FittedStructure, Task, unexplained
from workbench.renamed import Renamed
from workbench.structure.member import Bar, Beam
from workbench.structure.printed import Printed, warns_of_remarks
from workbench.structure.supports import PointMass
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class LossSettings:
    """Constants of the search for a local loss."""

    places: int = 60  # along the structure, where one is looked for
    typical_width: float = 0.1  # of the length: so many independent places noise has to imitate a loss at
    # of the length: a search finds a loss from half and from twice its width, not from any
    widths: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4)
    most_starts: int = 2  # of each width
    most_looks: int = 4  # after the first
    first_terms: int = 3  # of mass and stiffness, that the first look is taken with
    fewer_terms: int = 2  # by which terms are fewer in the next look: many imitate a loss so well
    draws: int = 20_000  # of a loss as likely as the one found, for intervals
    # χ² / degrees of freedom up to which standard errors may be too small, here twofold, and a loss is told; true
    # losses of the study leave 1.8 at most, a mass of 1 % of the whole that the nominal structure lacks 40
    errors_wrong: float = 4.0
    mass_places: int = 40  # along the structure, where a point mass is looked for
    first_mass: float = 1e-3  # of the whole, that its effect is found by


LOSS = LossSettings()
FALSE_ALARM = 0.01


@dataclass(frozen=True, eq=False, repr=False)
class LocatedDamage(Printed):
    """What the modes say of a local loss of stiffness.

    Attributes:
        undamaged: the best explanation without one, or, where no number of terms comes near, that of most terms.
        damaged: the best with one, whether or not it is significant.
        statistic: of the test: what the loss lowers χ² + n_terms ln n_data by; in units of χ² / degrees of freedom
            where `damaged` does not explain the modes either.
        threshold: what noise lowers it by with the probability of a false alarm.
        with_mass: the best without a loss, but with a point mass that the nominal structure lacks, the last of its
            attachments; its bands take that mass for known. None where it was not looked for: where smooth
            distributions explain the modes.
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
        """Whether there is a loss: one that stands out of the noise, accounts for what the modes differ by, and does so
        better than a point mass."""
        return self.statistic > self.threshold and self._accounts(self.damaged) and not self._is_mass

    @property
    def _is_mass(self) -> bool:
        """Whether a point mass accounts for the modes, and better than a loss."""
        mass = self.with_mass
        return mass is not None and mass.criterion < self.damaged.criterion and self._accounts(mass)

    @staticmethod
    def _accounts(fit: FittedStructure) -> bool:
        """Whether a structure explains the modes, or would if their standard errors were somewhat larger."""
        return fit.explains or fit.chi2 <= LOSS.errors_wrong * fit.degrees_of_freedom

    @property
    def loss(self) -> LocalLoss | None:
        """Share, centre and width; None where there is none."""
        return self.damaged.loss if self.detected else None

    @property
    def best(self) -> FittedStructure:
        """The explanation to take."""
        sound = self.with_mass if self.with_mass is not None and self._is_mass else self.undamaged
        return self.damaged if self.detected else sound

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        test = f"statistic {self.statistic:.3g}, threshold {self.threshold:.3g}"
        if not self.detected:
            known = "no loss of stiffness is detected" if self.best.explains else "whether stiffness is lost is unknown"
            return f"{known} ({test})", (), (), self.remarks
        found = zip(("share", "centre [m]", "width [m]"), self.damaged.parameters[-3:], self.interval(), strict=True)
        rows = [(name, f"{value:.4g}", f"{low:.4g} to {high:.4g}") for name, value, (low, high) in found]
        return f"a loss of stiffness is detected ({test})", ("loss", "value", "95 % interval"), rows, self.remarks

    @property
    def remarks(self) -> tuple[str, ...]:
        """What else explains the modes, and whether anything does."""
        remarks, loss, lossy = [], self.damaged.loss, self.damaged.chi2
        assert loss is not None, "damaged is an explanation with a loss"
        if self.with_mass is not None and self._is_mass:
            part = self.with_mass.structure.attachments[-1]
            remarks.append(
                f"a point mass of {part.pair[0]:.3g} kg at {part.at:.4g} m, which the nominal structure lacks,"
                f" accounts for the modes better than a loss: χ² {self.with_mass.chi2:.4g}, {lossy:.4g} with the loss"
            )
        if not self.best.explains:
            place = f"{100 * loss.share:.2g} % at {loss.centre:.4g} m"
            told = f"; with a loss of {place} it is {lossy:.4g}: no proof of damage"
            remarks.append(f"{unexplained(self.best)}{'' if self.detected else told}. {LACKING}")
        return tuple(remarks)

    def interval(self, level: float = 0.95) -> np.ndarray:
        """Confidence intervals of share, centre and width, (3, 2); what of a loss passes an end does not count."""
        likely, length = self.damaged.parameters[-3:], self.damaged.structure.length
        rng, covariance = np.random.default_rng(0), self.damaged.covariance[-3:, -3:]
        share, centre, width = rng.multivariate_normal(likely, covariance, LOSS.draws, method="eigh").T
        begin, end = np.clip([centre - 0.5 * width, centre + 0.5 * width], 0.0, length)
        tail = 0.5 * (1.0 - level)
        return np.asarray(np.quantile([share, 0.5 * (begin + end), end - begin], [tail, 1.0 - tail], axis=1).T)


@warns_of_remarks
@one_blas_thread
def locate_damage(
    measured: Refined,
    nominal: Bar | Beam,
    *,
    basis: Callable[[int], Basis] | None = None,
    mass_terms: Iterable[int] = range(1, MOST_TERMS + 1),
    stiffness_terms: Iterable[int] = range(1, MOST_TERMS + 1),
    false_alarm: float = FALSE_ALARM,
    **known: Any,
) -> LocatedDamage:
    """Whether and where stiffness is lost over a part of the structure, from its modes alone.

    Args:
        measured, nominal, basis, mass_terms, stiffness_terms: as `choose_structure`.
        false_alarm: chance that an undamaged structure is reported.
        known: `known_mass`, `known_stiffness`, priors and `numbers` of `fit_structure`.

    Raises:
        ValueError: as `fit_structure`.
        UserWarning: nothing explains the modes, or a point mass does better than a loss.
    """
    task = Task.of(measured, nominal, **known)
    basis = basis or partial(Basis.legendre, length=nominal.length)
    terms = sorted(mass_terms), sorted(stiffness_terms)
    if not (terms[0] and terms[1]):
        raise ValueError("no number of terms was given for mass or stiffness; give at least one, 0 to keep the nominal")
    first = _from_anywhere(Problem.of(task, *(basis(few[: LOSS.first_terms][-1]) for few in terms)), None)
    damaged = choose(task, basis, *terms, _near_the_last, near=first, exhaust=False)
    fewer = 0
    for _ in range(LOSS.most_looks):
        if damaged.explains or fewer >= max(damaged.n_terms):
            break
        at_least = (max(n - fewer, few[0]) for n, few in zip(damaged.n_terms, terms, strict=True))
        again = _from_anywhere(Problem.of(task, *(basis(n) for n in at_least)), damaged)
        if again.criterion < damaged.criterion - 1.0:
            damaged, fewer = choose(task, basis, *terms, partial(_near_either, again), near=again), 0
        else:
            fewer += LOSS.fewer_terms  # many terms imitate a loss so well that few starts lead to it
    # three parameters, sought over as many places as stand apart
    limit = float(chi2_distribution.isf(false_alarm * LOSS.typical_width, 3))
    undamaged = _undamaged(task, basis, terms, damaged, limit)
    statistic = _statistic(task, undamaged, damaged)
    if statistic <= limit:
        # few terms may have led to a false place: look once more, beside what explains the modes without a loss
        again = _from_anywhere(Problem.of(task, *(basis(n) for n in undamaged.n_terms)), damaged)
        if again.criterion < damaged.criterion - 1.0:
            damaged = choose(task, basis, *terms, partial(_near_either, again), near=again)
            undamaged = _undamaged(task, basis, terms, damaged, limit)
            statistic = _statistic(task, undamaged, damaged)
    # modes that not even a loss explains err by more than their standard errors, and count for less
    return LocatedDamage(
        undamaged,
        damaged,
        statistic if damaged.explains else statistic * damaged.degrees_of_freedom / damaged.chi2,
        limit,
        None if undamaged.explains else _with_a_mass(task, basis, terms, damaged),
    )


def _statistic(task: Task, undamaged: FittedStructure, damaged: FittedStructure) -> float:
    """What a loss lowers the criterion by, its own three parameters not counted: its limit allows for them."""
    return undamaged.criterion - damaged.criterion + _price(task)


def _price(task: Task) -> float:
    """What the three parameters of a loss add to the criterion."""
    return 3.0 * float(np.log(task.n_data))


def _undamaged(
    task: Task,
    basis: Callable[[int], Basis],
    terms: tuple[list[int], list[int]],
    damaged: FittedStructure,
    limit: float,
) -> FittedStructure:
    """The best explanation without a loss; where one fit settles that it wins or cannot win, that one."""

    def alike(*n_terms: int) -> FittedStructure | None:
        try:
            return Problem.of(task, *(basis(n) for n in n_terms)).fit(damaged)
        except ValueError:
            return None

    same = alike(*damaged.n_terms)
    if same is not None and same.chi2 - damaged.chi2 <= limit:
        return with_spare_terms(same, task, basis)
    most = alike(terms[0][-1], terms[1][-1])
    if most is not None and most.chi2 - damaged.criterion + _price(task) > limit:
        return most
    return choose(task, basis, terms[0], terms[1], lambda problem, near: problem.fit(near))


def _with_a_mass(
    task: Task, basis: Callable[[int], Basis], terms: tuple[list[int], list[int]], damaged: FittedStructure
) -> FittedStructure | None:
    """The best explanation without a loss but with one more point mass; None where none is found."""
    best: FittedStructure | None = None
    for n_terms in {tuple(few[: LOSS.first_terms][-1] for few in terms): None, damaged.n_terms: None}:
        problem = Problem.of(task, *(basis(n) for n in n_terms))
        starts = [(whole, part) for whole in _without_loss(problem) for part in _likely_masses(problem, whole)]
        if best is not None:
            starts.append((best, cast(PointMass, best.structure.attachments[-1])))
        for near, part in starts:
            try:
                found = _near_a_mass(problem, near, part)
            except ValueError:
                continue
            if best is None or found.criterion < best.criterion:
                best = found
    return best


def _having(problem: Problem, at: float, mass: float) -> Problem:
    """The same with a point mass (kg) at a place (m)."""
    nominal, series = problem.task.nominal, problem.series
    heavier = replace(nominal, attachments=(*nominal.attachments, PointMass(at, mass)))
    return replace(
        problem,
        task=replace(problem.task, nominal=heavier),
        series=SeriesStructure(heavier, series.mass, series.stiffness, series.positions),
    )


def _whole_mass(problem: Problem) -> float:
    x = np.linspace(0.0, problem.task.nominal.length, 101)
    return float(problem.task.nominal.length * problem.task.nominal.mass_per_length(x).mean())


def _likely_masses(problem: Problem, whole: FittedStructure) -> list[PointMass]:
    """Those at the peaks of what a small one would lower χ² by, to first order."""
    z, little = problem.free_near(whole), LOSS.first_mass * _whole_mass(problem)
    missed, slopes = problem.misses(z)
    own = np.linalg.qr(slopes)[0]
    places = np.linspace(0.0, problem.task.nominal.length, LOSS.mass_places)
    effects = np.stack([(_having(problem, at, little).misses(z)[0] - missed) / little for at in places])
    effects -= (effects @ own) @ own.T
    size = np.maximum((effects**2).sum(axis=1), 1e-300)
    masses = -(effects @ missed) / size
    gain = np.where(masses > 0.0, masses**2 * size, 0.0)
    peaks = np.flatnonzero(np.r_[True, gain[1:] >= gain[:-1]] & np.r_[gain[:-1] >= gain[1:], True] & (gain > 0.0))
    best = sorted(peaks, key=lambda i: -gain[i])[: LOSS.most_starts]
    return [PointMass(float(places[i]), float(min(masses[i], _whole_mass(problem)))) for i in best]


def _near_a_mass(problem: Problem, near: FittedStructure, part: PointMass) -> FittedStructure:
    """The most likely structure with a point mass, searched from one near this."""
    scale = np.array([problem.task.nominal.length, _whole_mass(problem)])
    steps = 1e-5 * np.eye(2)

    def misses(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _having(problem, *(z[-2:] * scale)).misses(z[:-2])

    def slopes(z: np.ndarray) -> np.ndarray:
        own = z[-2:]
        moved = [(np.clip(own - step, 0.0, [1.0, np.inf]), np.clip(own + step, 0.0, [1.0, np.inf])) for step in steps]
        columns = [
            (misses(np.r_[z[:-2], after])[0] - misses(np.r_[z[:-2], before])[0]) / (after - before).sum()
            for before, after in moved
        ]
        return np.column_stack([misses(z)[1], *columns])

    n_free = problem.n_free
    start = np.r_[problem.free_near(near), np.clip([part.at, part.pair[0]] / scale, 1e-4, [1.0 - 1e-4, np.inf])]
    bounds = np.r_[np.full(n_free, -np.inf), 0.0, 0.0], np.r_[np.full(n_free, np.inf), 1.0, np.inf]
    found = least_squares(
        lambda z: misses(z)[0], start, slopes, bounds=bounds, x_scale="jac", ftol=1e-5, max_nfev=PROBLEM.most_steps
    )
    fit = _having(problem, *(found.x[-2:] * scale)).report(found.x[:-2])
    return replace(
        fit,
        degrees_of_freedom=fit.degrees_of_freedom - 2,
        criterion=fit.criterion + 2.0 * float(np.log(problem.task.n_data)),
    )


def _near_the_last(problem: Problem, near: FittedStructure | None) -> FittedStructure:
    """The most likely structure with a loss near the one found before."""
    assert near is not None, "a search along the structure comes first"
    return problem.fit(near, near.loss)


def _near_either(other: FittedStructure, problem: Problem, near: FittedStructure | None) -> FittedStructure:
    """The likelier of two searches, for a loss of few terms may end beside that of many."""
    return _likeliest(problem, [(start, start.loss) for start in (near, other) if start is not None])


def _from_anywhere(problem: Problem, near: FittedStructure | None) -> FittedStructure:
    """The most likely structure with a loss, from the likeliest places and from what was found before."""
    starts = [(whole, loss) for whole in _without_loss(problem) for loss in _likely_losses(problem, whole)]
    return _likeliest(problem, starts if near is None else [*starts, (near, near.loss)])


def _without_loss(problem: Problem) -> list[FittedStructure]:
    """Where to look from: the nominal structure, and the most likely, which may have bent itself to imitate a loss."""
    found = []
    for whole in (problem.nominal, problem.fit):
        try:
            found.append(whole())
        except ValueError:
            continue
    return found


def _likeliest(problem: Problem, starts: Sequence[tuple[FittedStructure, LocalLoss | None]]) -> FittedStructure:
    """The most likely of what searches from several starts find; one that ends at no structure is passed over."""
    found, reason = [], "no structure of so many terms could be fitted, so no loss can be located; use fewer terms"
    for near, loss in starts:
        try:
            found.append(problem.fit(near, loss))
        except ValueError as error:
            reason = str(error)
    if not found:
        raise ValueError(reason)
    return min(found, key=lambda fit: fit.chi2)


def _likely_losses(problem: Problem, whole: FittedStructure) -> list[LocalLoss]:
    """Those that would lower χ² most, of each width the local peaks of `scan`; none where none would."""
    length = problem.task.nominal.length
    places, all_gains = scan(problem, whole)
    likely = []
    for width, gain in zip(LOSS.widths, all_gains, strict=True):
        peaks = np.flatnonzero(np.r_[True, gain[1:] >= gain[:-1]] & np.r_[gain[:-1] >= gain[1:], True] & (gain > 0.0))
        best = sorted(peaks, key=lambda i: -gain[i])[: LOSS.most_starts]
        likely += [LocalLoss(0.1, float(places[i]), width * length) for i in best]
    return likely


def scan(problem: Problem, undamaged: FittedStructure) -> tuple[np.ndarray, np.ndarray]:
    """Places along the structure (n_places,) and what a small loss of each of `LOSS.widths` there would lower χ² by, to
    first order, (n_widths, n_places)."""
    task, series = problem.task, problem.series
    length = task.nominal.length
    places = (np.arange(LOSS.places) + 0.5) / LOSS.places * length
    d, e = np.split(undamaged.parameters, [undamaged.n_terms[0]])

    def with_losses(x: np.ndarray) -> np.ndarray:
        own = series.stiffness.functions(x)
        near = np.maximum(1.0 - np.abs(x[:, None] - places) * LOSS.places / length, 0.0)
        return np.hstack([own, -(1.0 + own @ e)[:, None] * near])

    breaks = tuple(np.linspace(0.0, length, 11))
    wider = Basis(with_losses, e.size + LOSS.places, (*series.stiffness.breaks, *breaks))
    particular, free = problem.stiffness_held
    held = np.r_[particular, np.zeros(LOSS.places)], block_diag(free, np.eye(LOSS.places))
    trial = replace(
        problem, series=SeriesStructure(task.nominal, series.mass, wider, series.positions), stiffness_held=held
    )
    missed, slopes = trial.misses(np.r_[problem.free_of(d, e), np.zeros(LOSS.places)])
    # what the smooth series cannot make good
    own = np.linalg.qr(slopes[:, : -LOSS.places])[0]
    narrow = slopes[:, -LOSS.places :] - own @ (own.T @ slopes[:, -LOSS.places :])
    apart = np.abs(places[:, None] - places) / length
    gains = []
    for width in LOSS.widths:
        losses = narrow @ (apart < 0.5 * width)
        gains.append(np.maximum(-losses.T @ missed, 0.0) ** 2 / np.maximum((losses**2).sum(axis=0), 1e-300))
    return places, np.array(gains)
