"""The maximum likelihood mass and stiffness of a structure as series, of given terms or of the likeliest numbers.

Numbers of terms are selected by the Bayesian information criterion χ² + n_terms ln n_data (Schwarz, Ann. Statist. 6,
1978), which an unneeded term does not lower.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from workbench.arrays import Floats, symmetric_root
from workbench.identification.signal.modal_estimates import RefinedModes
from workbench.identification.signal.searches import CachedResidual
from workbench.identification.updating.distributions import Basis, SelfCheck, printed_rows
from workbench.identification.updating.sensitivity import LocalLoss
from workbench.identification.updating.structure_problem import PROBLEM, GaussianPrior, Problem, Task
from workbench.renamed import Renamed
from workbench.structure.member import Bar, Beam
from workbench.structure.modes import frozen, mac
from workbench.structure.printed import Printed, counted, warns_of_remarks
from workbench.structure.profile import Profile
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class StructureSettings:
    """Constants of the report and of the selection of terms."""

    refusal_probability: float = 0.01  # of a structure as an explanation of its own modes
    draws: int = 1000  # Monte Carlo samples of the structure, for confidence bands
    max_terms: int = 8  # of mass and of stiffness, unless given
    spare_terms: int = 2  # further terms that are free in the confidence bands


STRUCTURE = StructureSettings()


@dataclass(frozen=True, eq=False, repr=False)
class UncertainProfile(Printed):
    """A distribution along the structure, with its uncertainty."""

    profile: Profile  # the maximum likelihood estimate
    others: Callable[[np.ndarray], np.ndarray]  # x (n_points,) -> (n_draws, n_points), Monte Carlo samples
    length: float  # of the structure, m

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        low, high = self.extent
        line = f"from {low:.4g} to {high:.4g} over {self.length:.4g} m"
        return line, ("x [m]", "value", "±"), printed_rows(self.length, self), ()

    @property
    def extent(self) -> tuple[float, float]:
        """The minimum and the maximum, of 101 places."""
        values = self(np.linspace(0.0, self.length, 101))
        return float(values.min()), float(values.max())

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Values at x, in the shape of x."""
        return self.profile(x)

    def std(self, x: np.ndarray) -> np.ndarray:
        """Standard error at each x (n_points,)."""
        return np.asarray(self.others(np.atleast_1d(np.asarray(x, float))).std(axis=0))

    def band(self, x: np.ndarray, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Pointwise confidence limits at each x (n_points,), lower and upper."""
        tail = 0.5 * (1.0 - level)
        lower, upper = np.quantile(self.others(np.atleast_1d(np.asarray(x, float))), [tail, 1.0 - tail], axis=0)
        return lower, upper


@dataclass(frozen=True, eq=False, repr=False)
class FittedStructure(Printed):
    """The maximum likelihood structure, given measured modes.

    Attributes:
        structure: a `Bar` or `Beam`, with ends and attachments of the nominal one.
        mass: kg/m, with its band.
        stiffness: EA in N or EI in N m², with its band.
        n_terms: of mass, of stiffness.
        loss: of stiffness over a part of the structure, where one was fitted.
        chi2: sum of squares of the residuals of its modes and of the prior, in standard errors.
        degrees_of_freedom: data less parameters; the expected value of `chi2` where the structure explains its modes.
        criterion: χ² + n_parameters ln n_data (BIC), to be minimised over the numbers of terms.
        parameters: d, e and, with a loss, its share, centre and width.
        covariance: of the parameters, the Cramér-Rao bound at the estimate; larger by χ² / `degrees_of_freedom` where
            the structure does not explain its modes.
        numbers: (n_modes,) number of the structure's elastic mode, from 1, paired with each measured one.
        check: frequencies and shapes of the structure compared with the measured ones.
    """

    structure: Bar | Beam
    mass: UncertainProfile
    stiffness: UncertainProfile
    n_terms: tuple[int, int]
    loss: LocalLoss | None
    chi2: float
    degrees_of_freedom: int
    criterion: float
    parameters: np.ndarray
    covariance: np.ndarray
    numbers: np.ndarray
    check: SelfCheck

    freedom = Renamed("degrees_of_freedom")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        verb = "explains" if self.explains else "does not explain"
        line = (
            f"mass in {counted(self.n_terms[0], 'term')} and stiffness in {counted(self.n_terms[1], 'term')}:"
            f" {verb} the {counted(self.numbers.size, 'mode')} measured (χ² {self.chi2:.4g}, at most {self.limit:.4g})"
        )
        k = "EI [N m²]" if isinstance(self.structure, Beam) else "EA [N]"
        rows = printed_rows(self.structure.length, self.mass, self.stiffness)
        return line, ("x [m]", "mass [kg/m]", "±", k, "±"), rows, self.remarks

    @property
    def limit(self) -> float:
        """The 0.99 quantile of `chi2` by noise alone."""
        return float(chi2_distribution.isf(STRUCTURE.refusal_probability, self.degrees_of_freedom))

    @property
    def explains(self) -> bool:
        """Whether the structure explains the measured modes: `chi2` is at most `limit`."""
        return self.chi2 <= self.limit

    @property
    def remarks(self) -> tuple[str, ...]:
        """Why the distributions are unreliable; empty where they explain the modes."""
        if self.explains:
            return ()
        (m, most_m), (k, most_k) = self.mass.extent, self.stiffness.extent
        unit = "N m²" if isinstance(self.structure, Beam) else "N"
        return (
            f"{unexplained(self)}. The distributions compensate for what the model lacks and may be wrong by any"
            f" factor, with standard errors too small: mass {m:.4g} to {most_m:.4g} kg/m,"
            f" stiffness {k:.4g} to {most_k:.4g} {unit}. {LACKING}",
        )


LACKING = (
    "Put point masses, springs and the true ends into the nominal structure, give a basis that jumps where the section"
    " does, or more terms, and check in `numbers` with which modes the measured ones are paired; else the standard"
    " errors of the measured modes are too small"
)


def unexplained(fit: FittedStructure) -> str:
    """The remark that a structure does not explain its modes, with χ² and its limit."""
    return f"the modes are not explained: χ² is {fit.chi2:.4g}, and noise alone gives at most {fit.limit:.4g}"


def fitted(problem: Problem, near: FittedStructure | None = None, loss: LocalLoss | None = None) -> FittedStructure:
    """The maximum likelihood structure, searched from an earlier fit, and with a loss from `loss` if given."""
    length = problem.series.nominal.length
    z = problem.start() if near is None else free_near(problem, near)[: problem.n_free]
    low, high = np.full(z.size, -np.inf), np.full(z.size, np.inf)
    if loss is not None:
        z = np.r_[z, loss.share, loss.centre, loss.width]
        low = np.r_[low, 0.0, 0.0, PROBLEM.min_loss_width * length]
        high = np.r_[high, PROBLEM.max_loss, length, PROBLEM.max_loss_width * length]
        z[-3:] = np.clip(z[-3:], *(0.999 * low[-3:] + 0.001 * high[-3:], 0.001 * low[-3:] + 0.999 * high[-3:]))
    if z.size == 0:
        return report(problem, z)
    if near is not None and not problem.residuals(z)[1].any():
        z[: problem.n_free] = problem.start()  # with other terms the earlier fit may not be positive
    residuals = CachedResidual(problem.residuals)

    def search(z: np.ndarray) -> np.ndarray:
        return residuals.least(z, PROBLEM.max_steps, bounds=(low, high), ftol=1e-5, xtol=1e-9, gtol=1e-9)

    found = search(z)
    if loss is not None:
        # χ² does not depend on an edge beyond an end
        inside = problem.edges_inside(found)
        if inside is not found:
            found = min(found, search(np.clip(inside, low, high)), key=lambda z: residuals(z)[0] @ residuals(z)[0])
    return report(problem, found)


def free_near(problem: Problem, fit: FittedStructure) -> Floats:
    """Free parameters, with those of a loss, of the series nearest to a structure fitted with other terms."""
    x, (m, k) = problem.places, problem.series.nominal_profiles
    mass, stiffness = fit.mass(x) / m(x), fit.stiffness(x) / k(x)
    if fit.loss is None:
        return problem.nearest(mass, stiffness)
    left = fit.loss.of(Profile.constant(1.0), problem.series.nominal.length)(x)
    return np.asarray(np.r_[problem.nearest(mass, stiffness / left), fit.parameters[-3:]])


def report(problem: Problem, z: np.ndarray) -> FittedStructure:
    """The structure of free parameters z, with its covariance and confidence bands."""
    task, series, n_free = problem.task, problem.series, problem.n_free
    nominal, length = series.nominal, series.nominal.length
    if z.size > n_free:
        z = np.r_[z[:n_free], astuple(LocalLoss(*z[n_free:]).within(length))]
    d, e, loss = problem.parts(z)
    advice = "use fewer terms, a prior, or a nominal structure nearer to the real one"
    solved = series.solve(d, e, loss)
    if solved is None:
        raise ValueError(f"no positive mass and stiffness of this many terms were found; {advice}")
    rows = problem.residuals(z)[0]
    chi2, degrees_of_freedom = float(rows @ rows), rows.size - z.size
    parameters = np.r_[d, e, z[n_free:]]
    coefficient_jacobian = problem.coefficient_jacobian(z)
    covariance = coefficient_jacobian @ problem.covariance(z) @ coefficient_jacobian.T
    if degrees_of_freedom > 0 and chi2 > chi2_distribution.isf(STRUCTURE.refusal_probability, degrees_of_freedom):
        covariance = covariance * chi2 / degrees_of_freedom
    std = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    root = symmetric_root(covariance / np.outer(std, std))
    standard_normal = np.random.default_rng(0).standard_normal((STRUCTURE.draws, parameters.size))
    draws = parameters + std * (standard_normal @ root.T)
    m, k = series.nominal_profiles
    mass = _uncertain(m, series.mass, d, draws[:, : d.size], length)
    stiffness = _uncertain(k, series.stiffness, e, draws[:, d.size :], length, loss)
    changes: dict[str, Any] = {"mass_per_length": mass.profile, nominal.stiffness_name: stiffness.profile}
    try:
        structure = replace(nominal, **changes)
    except ValueError as error:
        raise ValueError(f"{error}; {advice}") from None
    omega, shapes = solved.modes(task.which)
    return FittedStructure(
        structure=structure,
        mass=mass,
        stiffness=stiffness,
        n_terms=(d.size, e.size),
        loss=loss,
        chi2=chi2,
        degrees_of_freedom=degrees_of_freedom,
        criterion=chi2 + z.size * task.penalty,
        parameters=frozen(parameters),
        covariance=frozen(covariance),
        numbers=task.which + 1,
        check=SelfCheck(omega / task.measured.modes.omega - 1.0, np.diag(mac(shapes, task.shapes))),
    )


def _uncertain(
    nominal: Profile, basis: Basis, coefficients: Floats, draws: Floats, length: float, loss: LocalLoss | None = None
) -> UncertainProfile:
    """The distribution nominal (1 + series) (1 - loss), with Monte Carlo samples of coefficients and loss."""

    def series(x: Floats, coefficients: Floats) -> Floats:
        return np.asarray(nominal(x) * (1.0 + coefficients @ basis.functions(x).T))

    def samples(x: Floats) -> Floats:
        values = series(x, draws[:, : basis.n_terms])
        if loss is None:
            return values
        share, centre, width = draws[:, basis.n_terms :, None].transpose(1, 0, 2)
        inside = np.abs(x - centre) < 0.5 * np.maximum(width, 0.0)
        return np.where(inside, 1.0 - share, 1.0) * values

    breaks = tuple(sorted({*nominal.breaks, *basis.breaks}))
    smooth = Profile(lambda x: series(np.ravel(x), coefficients).reshape(np.shape(x)), breaks)
    return UncertainProfile(smooth if loss is None else loss.of(smooth, length), samples, length)


@warns_of_remarks
@one_blas_thread
def fit_structure(
    measured: RefinedModes,
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
    return fitted(Problem.of(task, mass, stiffness))


@warns_of_remarks
@one_blas_thread
def choose_structure(
    measured: RefinedModes,
    nominal: Bar | Beam,
    *,
    basis: Callable[[int], Basis] | None = None,
    mass_terms: Iterable[int] = range(1, STRUCTURE.max_terms + 1),
    stiffness_terms: Iterable[int] = range(1, STRUCTURE.max_terms + 1),
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
    return Candidates.of(Task.of(measured, nominal, **known), basis, mass_terms, stiffness_terms).best()


@dataclass(frozen=True, eq=False)
class Candidates:
    """The structures of a task with series of given numbers of terms, in increasing order."""

    task: Task
    basis: Callable[[int], Basis]
    mass_terms: list[int]
    stiffness_terms: list[int]

    @classmethod
    def of(
        cls, task: Task, basis: Callable[[int], Basis] | None, mass_terms: Iterable[int], stiffness_terms: Iterable[int]
    ) -> "Candidates":
        """The arguments as of `choose_structure`."""
        basis = basis or partial(Basis.legendre, length=task.nominal.length)
        candidates = cls(task, basis, sorted(mass_terms), sorted(stiffness_terms))
        if not (candidates.mass_terms and candidates.stiffness_terms):
            raise ValueError(
                "no number of terms was given for mass or stiffness; give at least one, 0 to keep the nominal"
            )
        return candidates

    def problem(self, n_mass: int, n_stiffness: int) -> Problem:
        """The problem with so many terms."""
        return Problem.of(self.task, self.basis(n_mass), self.basis(n_stiffness))

    def best(
        self,
        fit: Callable[[Problem, FittedStructure | None], FittedStructure] = fitted,
        *,
        near: FittedStructure | None = None,
        exhaust: bool = True,
    ) -> FittedStructure:
        """The fit of the least criterion.

        From the fewest terms up, as long as one or two more terms of mass or stiffness lower the criterion; over all
        numbers, with `exhaust`, where that leaves the modes unexplained. Each fit starts from the best so far, or from
        `near` where that is better.
        """
        fits: dict[tuple[int, int], FittedStructure] = {}
        tried: set[tuple[int, int]] = set()
        best: FittedStructure | None = None
        at, n_ahead, reason = (0, 0), 3, ""  # `at`: indices of the numbers of terms of the best fit
        while True:
            for i, j in product(*(range(first, first + n_ahead) for first in at)):
                if (i, j) in tried or i >= len(self.mass_terms) or j >= len(self.stiffness_terms):
                    continue
                tried.add((i, j))
                starts = filter(None, (best, near))
                start = min(starts, key=lambda start: start.criterion, default=None)
                try:
                    fits[i, j] = fit(self.problem(self.mass_terms[i], self.stiffness_terms[j]), start)
                except ValueError as error:
                    reason = str(error)
            if not fits:
                raise ValueError(reason)
            at = min(fits, key=lambda pair: fits[pair].criterion)
            if fits[at] is not best:
                best = fits[at]
            elif best.explains or not exhaust:
                return self.with_spare_terms(best)
            else:
                n_ahead, exhaust = len(self.mass_terms) + len(self.stiffness_terms), False

    def with_spare_terms(self, chosen: FittedStructure) -> FittedStructure:
        """A fit with confidence bands in which the next two terms are free as well.

        These terms are below the noise but not zero: without them the bands would be too narrow (undersmoothing, Hall,
        Ann. Statist. 20, 1992).
        """
        try:
            problem = self.problem(*(n + STRUCTURE.spare_terms if n else 0 for n in chosen.n_terms))
            wider = report(problem, free_near(problem, chosen))
        except ValueError:
            return chosen
        if wider.chi2 > chosen.chi2 + 1.0:  # a basis that does not contain the smaller one
            return chosen
        kept = ("n_terms", "chi2", "degrees_of_freedom", "criterion")
        return replace(wider, **{name: getattr(chosen, name) for name in kept})
