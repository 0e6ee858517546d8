"""The data and prior knowledge of a structure to be updated, and the updated structure with its errors."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2 as chi2_distribution

from workbench.identification.shapes.eigenfunctions import check_along
from workbench.identification.signal.modal_estimates import Refined, normalised_shapes
from workbench.identification.updating.distributions import Basis, SelfCheck, columns
from workbench.identification.updating.sensitivity import LocalLoss, SeriesStructure
from workbench.renamed import Renamed
from workbench.structure.member import Bar, Beam
from workbench.structure.modes import mac
from workbench.structure.printed import Printed, counted
from workbench.structure.profile import Profile


@dataclass(frozen=True)
class TaskSettings:
    """Constants of the data of a structure to be updated."""

    trusted: float = 1e-8  # relative error of the model, below which no standard error counts
    same_mode: float = 0.6  # least MAC of a measured mode with the nominal structure's mode paired with it
    unlikely: float = 0.01  # chance that a structure is refused as an explanation of its own modes


TASK = TaskSettings()


@dataclass(frozen=True)
class GaussianPrior:
    """Gaussian prior of the relative deviation of a distribution from its nominal one.

    Attributes:
        std: standard deviation of k / k_0 - 1 (or m / m_0 - 1) at any place.
        correlation: length ℓ of the correlation exp(-Δx² / (2 ℓ²)) between two places, m.
    """

    std: float
    correlation: float

    def __post_init__(self) -> None:
        if not (self.std > 0 and self.correlation > 0):
            raise ValueError(
                f"a prior needs a positive standard deviation and correlation length; got {self.std} and"
                f" {self.correlation}. Keep the nominal distribution, without terms, where it is known exactly"
            )

    def root(self, basis: Basis, length: float) -> np.ndarray:
        """R such that |R c|² is the prior's χ² of coefficients c."""
        x = (np.arange(200) + 0.5) / 200 * length
        projection = np.linalg.pinv(basis.functions(x))
        kernel = self.std**2 * np.exp(-0.5 * ((x[:, None] - x) / self.correlation) ** 2)
        return _whitening_matrix(projection @ kernel @ projection.T, 1e-8)


@dataclass(frozen=True, eq=False)
class Task:
    """The measured modes, in units of their standard errors, and what is known beforehand."""

    measured: Refined
    nominal: Bar | Beam
    known_mass: np.ndarray  # (n_known, 2)
    known_stiffness: np.ndarray
    mass_prior: GaussianPrior | None
    stiffness_prior: GaussianPrior | None
    which: np.ndarray  # elastic modes, from 0
    reference: np.ndarray  # (n_modes,) the sensor where each shape is 1
    shapes: np.ndarray  # (n_sensors, n_modes) real
    unit_omega: np.ndarray  # (n_modes, n_modes) whitening matrix of errors of ω
    unit_shapes: tuple[np.ndarray, ...]  # of the shape of each mode at all sensors but its reference

    @classmethod
    def of(
        cls,
        measured: Refined,
        nominal: Bar | Beam,
        known_mass: Sequence[tuple[float, float]] = (),
        known_stiffness: Sequence[tuple[float, float]] = (),
        mass_prior: GaussianPrior | None = None,
        stiffness_prior: GaussianPrior | None = None,
        numbers: Sequence[int] | None = None,
    ) -> "Task":
        modes = measured.modes
        check_along(modes)
        n, m = modes.n_modes, modes.n_outputs
        if m < 2:
            raise ValueError("one sensor shows no shape; use two or more")
        # The entry that a shape is normalised by has no error.
        reference = np.argmin(measured.shape_std, axis=0)
        shapes = (modes.shapes / modes.shapes[reference, np.arange(n)]).real
        omega_covariance = measured.covariance[:n, :n] + np.diag((TASK.trusted * modes.omega) ** 2)
        whitening = []
        for r in range(n):
            others = np.arange(m) != reference[r]
            whitening.append(
                _whitening_matrix(
                    measured.shape_covariance[r][np.ix_(others, others)] + TASK.trusted**2 * np.eye(m - 1)
                )
            )
        known = [np.array(pairs, float).reshape(-1, 2) for pairs in (known_mass, known_stiffness)]
        for name, pairs in zip(("mass", "stiffness"), known, strict=True):
            outside = (pairs[:, 0] < 0) | (pairs[:, 0] > nominal.length) | ~(pairs[:, 1] > 0)
            if outside.any():
                x, value = pairs[outside][0]
                raise ValueError(
                    f"known {name} {value:g} at x = {x:g}: it must be positive and lie within 0 to {nominal.length:g}"
                )
        which = _paired(measured, nominal) if numbers is None else np.asarray(numbers, int) - 1
        if which.shape != (n,) or (which < 0).any() or np.unique(which).size < n:
            raise ValueError(f"numbers must name {n} different modes from 1 on; got {numbers}")
        return cls(
            measured=measured,
            nominal=nominal,
            known_mass=known[0],
            known_stiffness=known[1],
            mass_prior=mass_prior,
            stiffness_prior=stiffness_prior,
            which=which,
            reference=reference,
            shapes=shapes,
            unit_omega=_whitening_matrix(omega_covariance),
            unit_shapes=tuple(whitening),
        )

    @property
    def n_data(self) -> int:
        """Number of frequencies and of shape entries, less one per shape for its scale."""
        return self.shapes.size


def _paired(measured: Refined, nominal: Bar | Beam) -> np.ndarray:
    """Index of the nominal structure's elastic mode paired with each measured one by shape, (n_modes,), from 0."""
    modes = measured.modes
    none = Basis.polynomial(0)
    n = modes.n_modes + 4
    solved = SeriesStructure(nominal, none, none, modes.positions, n).solve(np.zeros(0), np.zeros(0))
    assert solved is not None, "a nominal structure has positive mass and stiffness"
    shapes = solved.at_sensors[:, solved.n_rigid : solved.n_rigid + n]
    agreement = mac(normalised_shapes(modes.shapes).real, shapes)
    pairs = linear_sum_assignment(-agreement)[1]
    worst = int(np.argmin(agreement[np.arange(modes.n_modes), pairs]))
    if agreement[worst, pairs[worst]] < TASK.same_mode:
        raise ValueError(
            f"measured mode {worst + 1} at {modes.frequencies_hz[worst]:.4g} Hz resembles no mode of the nominal"
            f" structure (best MAC {agreement[worst].max():.2f}); leave it out, correct the ends, or give numbers"
        )
    return np.asarray(pairs)


def _whitening_matrix(covariance: np.ndarray, least: float = 1e-12) -> np.ndarray:
    """Whitening matrix W, W^T W the inverse of a covariance whose eigenvalues are at least a share of the largest."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors / np.sqrt(np.maximum(values, least * values.max()))).T)


@dataclass(frozen=True, eq=False, repr=False)
class UncertainProfile(Printed):
    """A distribution along the structure, with its uncertainty.

    Attributes:
        profile: the maximum likelihood estimate.
        others: x (n_points,) -> (n_draws, n_points), Monte Carlo samples of the distribution.
        length: of the structure, m.
    """

    profile: Profile
    others: Callable[[np.ndarray], np.ndarray]
    length: float

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        low, high = self.extent
        line = f"from {low:.4g} to {high:.4g} over {self.length:.4g} m"
        return line, ("x [m]", "value", "±"), list(zip(*columns(self, self.length))), ()

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
        length = self.structure.length
        rows = list(zip(*columns(self.mass, length), *columns(self.stiffness, length)[1:]))
        return line, ("x [m]", "mass [kg/m]", "±", k, "±"), rows, self.remarks

    @property
    def limit(self) -> float:
        """The 0.99 quantile of `chi2` by noise alone."""
        return float(chi2_distribution.isf(TASK.unlikely, self.degrees_of_freedom))

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
