"""The maximum likelihood mass and stiffness of a structure as series, given modes with their covariance.

Orthogonality (4.6) needs curvatures, and second derivatives of noisy shapes are inaccurate. Here the eigenfunctions are
those of the candidate structure itself: the coefficients d, e of

    m = m_0 (1 + Σ d_j M_j),   k = k_0 (1 + Σ e_j K_j)

minimise χ², the sum of squares of the residuals of the candidate's frequencies and shapes, in units of their standard
errors, by Gauss-Newton steps with exact sensitivities. The criterion is thus the self-check of section 4.3.
"""

from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import chi2 as chi2_distribution

from workbench.arrays import Floats, scaled_inverse, symmetric_root
from workbench.identification.signal.searches import Once
from workbench.identification.updating.distributions import Basis, SelfCheck, held_exactly
from workbench.identification.updating.sensitivity import LocalLoss, SeriesStructure
from workbench.identification.updating.structure_task import TASK, FittedStructure, Task, UncertainProfile
from workbench.structure.member import Beam
from workbench.structure.modes import frozen, mac
from workbench.structure.profile import Profile


@dataclass(frozen=True)
class ProblemSettings:
    """Constants of the fit of a structure."""

    narrowest: float = 0.02  # of the length: a narrower loss is a crack
    widest: float = 0.5  # of the length: a wider loss is not local
    most_lost: float = 0.95  # of the stiffness
    draws: int = 1000  # Monte Carlo samples of the structure, for confidence bands
    most_steps: int = 25  # of least squares


PROBLEM = ProblemSettings()
INDISTINCT = 1e-12  # relative eigenvalue of the normal equations of parameters that the data do not determine
FROM_EDGES = np.array([[0.5, 0.5], [-1.0, 1.0]])  # centre and width of a loss, from its edges


@dataclass(frozen=True, eq=False)
class Problem:
    """χ² of a structure of given terms, as a function of its free parameters z.

    z are the coefficients that the known values leave free, and share, centre and width of a loss if there is one.
    """

    task: Task
    series: SeriesStructure
    mass_held: tuple[np.ndarray, np.ndarray]  # (particular, free): d = particular + free @ z
    stiffness_held: tuple[np.ndarray, np.ndarray]

    @classmethod
    def of(cls, task: Task, mass: Basis, stiffness: Basis) -> "Problem":
        """The problem of a task with given series.

        Raises:
            ValueError: common factor unknown, more terms than data, known values the series cannot take.
        """
        if mass.n_terms and stiffness.n_terms and not (len(task.known_mass) or len(task.known_stiffness)):
            if task.mass_prior is None and task.stiffness_prior is None:
                raise ValueError(
                    "modes determine mass and stiffness only up to a common factor; give known_mass at a point,"
                    " known_stiffness, or a prior"
                )
        series = SeriesStructure(
            task.nominal, mass, stiffness, task.measured.modes.positions, int(task.which.max()) + 1
        )
        known = (
            (mass, task.known_mass, task.nominal.mass_per_length, "masses"),
            (stiffness, task.known_stiffness, series.nominal_stiffness, "stiffnesses"),
        )
        problem = cls(task, series, *(_held(*constraint) for constraint in known))
        if problem.n_free > task.n_data:
            raise ValueError(
                f"{problem.n_free} terms cannot be found from {task.n_data} data of {task.which.size} modes at"
                f" {task.shapes.shape[0]} sensors; use fewer terms"
            )
        return problem

    @property
    def n_free(self) -> int:
        """Number of free parameters without a loss."""
        return int(self.mass_held[1].shape[1] + self.stiffness_held[1].shape[1])

    def fit(self, near: FittedStructure | None = None, loss: LocalLoss | None = None) -> FittedStructure:
        """The maximum likelihood structure, searched from an earlier fit, and with a loss from `loss` if given."""
        length = self.task.nominal.length
        z = self._start() if near is None else self.free_near(near)[: self.n_free]
        low, high = np.full(z.size, -np.inf), np.full(z.size, np.inf)
        if loss is not None:
            z = np.r_[z, loss.share, loss.centre, loss.width]
            low = np.r_[low, 0.0, 0.0, PROBLEM.narrowest * length]
            high = np.r_[high, PROBLEM.most_lost, length, PROBLEM.widest * length]
            z[-3:] = np.clip(z[-3:], *(0.999 * low[-3:] + 0.001 * high[-3:], 0.001 * low[-3:] + 0.999 * high[-3:]))
        if z.size == 0:
            return self.report(z)
        if near is not None and not self.residuals(z)[1].any():
            z[: self.n_free] = self._start()  # with other terms the earlier fit may not be positive
        residuals_at = Once(self.residuals)

        def search(z: np.ndarray) -> OptimizeResult:
            tolerances = {"ftol": 1e-5, "xtol": 1e-9, "gtol": 1e-9, "max_nfev": PROBLEM.most_steps}
            return least_squares(
                lambda z: residuals_at(z)[0],
                z,
                lambda z: residuals_at(z)[1],
                bounds=(low, high),
                x_scale="jac",
                **tolerances,
            )

        solution = search(z)
        if loss is not None:
            # χ² does not depend on an edge beyond an end
            inside = self._edges_inside(solution.x)
            if inside is not solution.x:
                solution = min(solution, search(np.clip(inside, low, high)), key=lambda result: result.cost)
        return self.report(solution.x)

    def nominal(self) -> FittedStructure:
        """The nominal structure, scaled to the known values and the measured frequencies."""
        return self.report(self._start())

    def parts(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, LocalLoss | None]:
        """Coefficients d, e and the loss, from the free parameters."""
        (d0, d_free), (e0, e_free) = self.mass_held, self.stiffness_held
        n, m = d_free.shape[1], self.n_free
        loss = LocalLoss(*(float(value) for value in z[m:])) if z.size > m else None
        return d0 + d_free @ z[:n], e0 + e_free @ z[n:m], loss

    def free_of(self, d: np.ndarray, e: np.ndarray) -> np.ndarray:
        """The free parameters of coefficients that satisfy the known values."""
        both = zip((d, e), (self.mass_held, self.stiffness_held), strict=True)
        return np.concatenate([free.T @ (value - particular) for value, (particular, free) in both])

    def coefficient_jacobian(self, z: np.ndarray) -> np.ndarray:
        """∂(d, e, loss)/∂z."""
        return np.asarray(block_diag(self.mass_held[1], self.stiffness_held[1], np.eye(z.size - self.n_free)))

    def residuals(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals of frequencies, shapes and priors in standard errors, (n_rows,), and their Jacobian by z."""
        task = self.task
        d, e, loss = self.parts(z)
        solved = self.series.solve(d, e, loss)
        coefficient_jacobian = self.coefficient_jacobian(z)
        priors = [
            (task.mass_prior, self.series.mass, d, slice(0, d.size)),
            (task.stiffness_prior, self.series.stiffness, e, slice(d.size, d.size + e.size)),
        ]
        n_prior = sum(value.size for prior, _, value, _ in priors if prior is not None)
        if solved is None:
            # not positive: large residuals, so that the step is rejected
            return np.full(task.n_data + n_prior, 1e8), np.zeros((task.n_data + n_prior, z.size))
        computed = solved.sensitivity(task.which)
        rows = [task.unit_omega @ (computed.omega - task.measured.modes.omega)]
        slopes = [task.unit_omega @ computed.omega_by]
        for r, (k, unit) in enumerate(zip(task.reference, task.unit_shapes, strict=True)):
            others = np.arange(task.shapes.shape[0]) != k
            shape, shape_slopes = computed.shapes[:, r], computed.shapes_by[:, r]
            ratio = shape / shape[k]
            rows.append(unit @ (ratio - task.shapes[:, r])[others])
            slopes.append(unit @ ((shape_slopes - ratio[:, None] * shape_slopes[k]) / shape[k])[others])
        for prior, basis, value, columns in priors:
            if prior is not None and value.size:
                root = prior.root(basis, task.nominal.length)
                rows.append(root @ value)
                slope = np.zeros((value.size, coefficient_jacobian.shape[0]))
                slope[:, columns] = root
                slopes.append(slope)
        return np.concatenate(rows), np.vstack(slopes) @ coefficient_jacobian

    def report(self, z: np.ndarray) -> FittedStructure:
        """The structure of free parameters z, with its covariance and confidence bands."""
        task, series = self.task, self.series
        if z.size > self.n_free:
            z = np.r_[z[: self.n_free], astuple(LocalLoss(*z[self.n_free :]).within(task.nominal.length))]
        rows = self.residuals(z)[0]
        chi2 = float(rows @ rows)
        degrees_of_freedom = rows.size - z.size
        d, e, loss = self.parts(z)
        parameters = np.r_[d, e, z[self.n_free :]]
        coefficient_jacobian = self.coefficient_jacobian(z)
        covariance = coefficient_jacobian @ self._covariance(z) @ coefficient_jacobian.T
        if degrees_of_freedom > 0 and chi2 > chi2_distribution.isf(TASK.unlikely, degrees_of_freedom):
            covariance = covariance * chi2 / degrees_of_freedom
        std = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        root = symmetric_root(covariance / np.outer(std, std))
        standard_normal = np.random.default_rng(0).standard_normal((PROBLEM.draws, parameters.size))
        draws = parameters + std * (standard_normal @ root.T)
        n, m = d.size, d.size + e.size
        length = task.nominal.length
        mass = _uncertain(task.nominal.mass_per_length, series.mass, d, draws[:, :n], length=length)
        stiffness = _uncertain(
            series.nominal_stiffness, series.stiffness, e, draws[:, n:m], loss, draws[:, m:], length=length
        )
        name = "bending_stiffness" if isinstance(task.nominal, Beam) else "axial_stiffness"
        changes: dict[str, Any] = {"mass_per_length": mass.profile, name: stiffness.profile}
        solved = series.solve(d, e, loss)
        if solved is None:
            raise ValueError(
                "no positive mass and stiffness of this many terms were found; use fewer terms, a prior, or a nominal"
                " structure nearer to the real one"
            )
        computed = solved.sensitivity(task.which)
        agreement = np.diag(mac(computed.shapes, task.shapes))
        try:
            structure = replace(task.nominal, **changes)
        except ValueError as error:
            raise ValueError(
                f"{error}; use fewer terms, a prior, or a nominal structure nearer to the real one"
            ) from None
        return FittedStructure(
            structure=structure,
            mass=mass,
            stiffness=stiffness,
            n_terms=(n, e.size),
            loss=loss,
            chi2=chi2,
            degrees_of_freedom=degrees_of_freedom,
            criterion=chi2 + z.size * float(np.log(task.n_data)),
            parameters=frozen(parameters),
            covariance=frozen(covariance),
            numbers=task.which + 1,
            check=SelfCheck(computed.omega / task.measured.modes.omega - 1.0, agreement),
        )

    def _covariance(self, z: np.ndarray) -> np.ndarray:
        """Covariance of the free parameters, the Cramér-Rao bound.

        χ² does not depend on an edge of a loss beyond an end, and hardly on one just before it: the standard error of
        such an edge is that of an edge one standard error inside.
        """
        if z.size == self.n_free:
            slopes = self.residuals(z)[1]
            return scaled_inverse(slopes.T @ slopes, INDISTINCT)
        from_edges = block_diag(np.eye(z.size - 2), FROM_EDGES)
        return np.asarray(from_edges @ self._edge_covariance(self._edges_inside(z)) @ from_edges.T)

    def _edge_covariance(self, z: np.ndarray) -> np.ndarray:
        """The Cramér-Rao bound with the edges of the loss in place of centre and width."""
        slopes = self.residuals(z)[1]
        slopes = np.hstack([slopes[:, :-2], slopes[:, -2:] @ FROM_EDGES])
        return scaled_inverse(slopes.T @ slopes, INDISTINCT)

    def _edges_inside(self, z: np.ndarray) -> np.ndarray:
        """z with each edge of the loss at least one standard error inside the ends; z itself where they are."""
        return self._edge_inside(self._edge_inside(z, 0, 1.0), 1, -1.0)

    def _edge_inside(self, z: np.ndarray, edge: int, inward: float) -> np.ndarray:
        width, length = z[-1], self.task.nominal.length
        depth = np.linalg.solve(FROM_EDGES, z[-2:])[edge]
        depth = depth if inward > 0 else length - depth

        def shifted(new_depth: float) -> np.ndarray:
            return np.asarray(np.r_[z[:-2], z[-2:] + inward * (new_depth - depth) * FROM_EDGES[:, edge]])

        def is_within_error(new_depth: float) -> bool:
            return bool(self._edge_covariance(shifted(new_depth))[edge - 2, edge - 2] > new_depth**2)

        least_depth = 1e-5 * length
        if depth > width or (depth > least_depth and not is_within_error(depth)):
            return z
        low, high = max(depth, least_depth), depth + 0.9 * width
        while high > 1.1 * low:
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if is_within_error(middle) else (low, middle)
        return shifted(high)

    def free_near(self, fit: FittedStructure) -> np.ndarray:
        """Free parameters, with those of a loss, of the series nearest to a structure fitted with other terms."""
        nominal, length = self.task.nominal, self.task.nominal.length
        x = (np.arange(100) + 0.5) / 100 * length
        mass = fit.mass(x) / nominal.mass_per_length(x)
        stiffness = fit.stiffness(x) / self.series.nominal_stiffness(x)
        if fit.loss is None:
            return self._nearest(x, mass, stiffness)
        intact = stiffness / fit.loss.of(Profile.constant(1.0), length)(x)
        return np.asarray(np.r_[self._nearest(x, mass, intact), fit.parameters[-3:]])

    def _start(self) -> np.ndarray:
        """Free parameters of the nominal structure, scaled to the known values and the measured frequencies."""
        task, series = self.task, self.series
        x = (np.arange(100) + 0.5) / 100 * task.nominal.length
        scale = np.ones(2)
        for i, (pairs, nominal) in enumerate(
            ((task.known_mass, task.nominal.mass_per_length), (task.known_stiffness, series.nominal_stiffness))
        ):
            if len(pairs):
                scale[i] = np.mean(pairs[:, 1] / nominal(pairs[:, 0]))
        z = self._nearest(x, np.full(x.size, scale[0]), np.full(x.size, scale[1]))
        d, e, _ = self.parts(z)
        solved = series.solve(d, e)
        if solved is None:
            return z
        ratio = np.median(task.measured.modes.omega**2 / solved.eigenvalues[solved.n_rigid + task.which])
        if self.stiffness_held[1].shape[1] and not len(task.known_stiffness):
            return self._nearest(x, np.full(x.size, scale[0]), np.full(x.size, scale[1] * ratio))
        return self._nearest(x, np.full(x.size, scale[0] / ratio), np.full(x.size, scale[1]))

    def _nearest(self, x: np.ndarray, mass: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        """Free parameters of the series nearest to given ratios to the nominal mass and stiffness at x."""
        z = []
        for basis, ratio, (particular, free) in (
            (self.series.mass, mass, self.mass_held),
            (self.series.stiffness, stiffness, self.stiffness_held),
        ):
            terms = basis.functions(x)
            z.append(np.linalg.lstsq(terms @ free, ratio - 1.0 - terms @ particular, rcond=None)[0])
        return np.concatenate(z)


def _held(basis: Basis, known: np.ndarray, nominal: Profile, what: str) -> tuple[np.ndarray, np.ndarray]:
    """A particular solution of the known values, and the null space of their rows (n_terms, n_free)."""
    if basis.n_terms == 0 or len(known) == 0:
        return np.zeros(basis.n_terms), np.eye(basis.n_terms)
    rows, values = basis.functions(known[:, 0]), known[:, 1] / nominal(known[:, 0]) - 1.0
    return held_exactly(rows, values, f"{what} over the nominal", max(np.abs(values).max(), 1.0))


def _uncertain(
    nominal: Profile,
    basis: Basis,
    coefficients: np.ndarray,
    draws: np.ndarray,
    loss: LocalLoss | None = None,
    loss_draws: np.ndarray | None = None,
    *,
    length: float,
) -> UncertainProfile:
    """The distribution nominal (1 + series) (1 - loss), with its Monte Carlo samples."""

    def values(x: Floats, coefficients: Floats, losses: Floats | None) -> Floats:
        series: Floats = nominal(x) * (1.0 + coefficients @ basis.functions(x).T)
        if losses is None:
            return series
        share, centre, width = losses[:, :, None].transpose(1, 0, 2)
        inside = np.abs(x - centre) < 0.5 * np.maximum(width, 0.0)
        return np.where(inside, 1.0 - share, 1.0) * series

    smooth = Profile(
        lambda x: values(np.ravel(x), coefficients, None).reshape(np.shape(x)),
        tuple(sorted({*nominal.breaks, *basis.breaks})),
    )
    profile = smooth if loss is None else loss.of(smooth, length)
    return UncertainProfile(profile, lambda x: values(x, draws, None if loss is None else loss_draws), length)
