"""χ² of a candidate structure, whose mass and stiffness are series, given modes with their covariance.

Orthogonality (4.6) needs curvatures, and second derivatives of noisy shapes are inaccurate. Here the eigenfunctions are
those of the candidate structure itself: the coefficients d, e of

    m = m_0 (1 + Σ d_j M_j),   k = k_0 (1 + Σ e_j K_j)

minimise χ², the sum of squares of the residuals of the candidate's frequencies and shapes, in units of their standard
errors, by Gauss-Newton steps with exact sensitivities. The criterion is thus the self-check of section 4.3.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import linear_sum_assignment

from workbench.arrays import Floats, scaled_inverse
from workbench.identification.shapes.eigenfunctions import check_along
from workbench.identification.signal.modal_estimates import RefinedModes, normalised_shapes
from workbench.identification.updating.distributions import Basis, held_exactly, known_values
from workbench.identification.updating.sensitivity import LocalLoss, SeriesStructure
from workbench.structure.domain import Interval
from workbench.structure.member import Bar, Beam
from workbench.structure.modes import mac


@dataclass(frozen=True)
class ProblemSettings:
    """Constants of the data and of the fit of a structure."""

    model_error: float = 1e-8  # relative error of the model, below which no standard error counts
    min_mac: float = 0.6  # of a measured mode with the nominal structure's mode paired with it
    min_loss_width: float = 0.02  # of the length: a narrower loss is a crack
    max_loss_width: float = 0.5  # of the length: a wider loss is not local
    max_loss: float = 0.95  # of the stiffness
    max_steps: int = 25  # of least squares


PROBLEM = ProblemSettings()
INDISTINCT = 1e-12  # relative eigenvalue of the normal equations of parameters that the data do not determine
FROM_EDGES = np.array([[0.5, 0.5], [-1.0, 1.0]])  # centre and width of a loss, from its edges
NOT_POSITIVE = 1e8  # residuals where mass or stiffness is not positive, so that the step is rejected


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

    def root(self, basis: Basis, length: float) -> Floats:
        """R such that |R c|² is the prior's χ² of coefficients c."""
        x = (np.arange(200) + 0.5) / 200 * length
        projection = np.linalg.pinv(basis.functions(x))
        kernel = self.std**2 * np.exp(-0.5 * ((x[:, None] - x) / self.correlation) ** 2)
        return _whitening_matrix(projection @ kernel @ projection.T, 1e-8)


@dataclass(frozen=True, eq=False)
class Task:
    """The measured modes, in units of their standard errors, and what is known beforehand of mass and stiffness."""

    measured: RefinedModes
    nominal: Bar | Beam
    known: tuple[tuple[np.ndarray, Floats], tuple[np.ndarray, Floats]]  # of mass, of stiffness: places and values
    priors: tuple[GaussianPrior | None, GaussianPrior | None]  # of mass, of stiffness
    which: np.ndarray  # (n_modes,) elastic mode of the structure, from 0, of each measured one
    reference: np.ndarray  # (n_modes,) the sensor where each shape is 1
    shapes: np.ndarray  # (n_sensors, n_modes) real
    unit_omega: np.ndarray  # (n_modes, n_modes) whitening matrix of the errors of ω
    unit_shapes: tuple[np.ndarray, ...]  # likewise of the shape of each mode at all sensors but its reference

    @classmethod
    def of(
        cls,
        measured: RefinedModes,
        nominal: Bar | Beam,
        known_mass: Sequence[tuple[float, float]] = (),
        known_stiffness: Sequence[tuple[float, float]] = (),
        mass_prior: GaussianPrior | None = None,
        stiffness_prior: GaussianPrior | None = None,
        numbers: Sequence[int] | None = None,
    ) -> "Task":
        """The task of `fit_structure`."""
        modes = measured.modes
        check_along(modes)
        n, m = modes.n_modes, modes.n_outputs
        if m < 2:
            raise ValueError("one sensor shows no shape; use two or more")
        # The entry that a shape is normalised by has no error.
        reference = np.argmin(measured.shape_std, axis=0)
        unit_shapes = []
        for covariance, k in zip(measured.shape_covariance, reference, strict=True):
            others = np.delete(np.delete(covariance, k, axis=0), k, axis=1)
            unit_shapes.append(_whitening_matrix(others + PROBLEM.model_error**2 * np.eye(m - 1)))
        omega_covariance = measured.covariance[:n, :n] + np.diag((PROBLEM.model_error * modes.omega) ** 2)
        domain = Interval(nominal.length)
        which = _paired(measured, nominal) if numbers is None else np.asarray(numbers, int) - 1
        if which.shape != (n,) or (which < 0).any() or np.unique(which).size < n:
            raise ValueError(f"numbers must name {n} different modes from 1 on; got {numbers}")
        return cls(
            measured=measured,
            nominal=nominal,
            known=(known_values(domain, known_mass, "mass"), known_values(domain, known_stiffness, "stiffness")),
            priors=(mass_prior, stiffness_prior),
            which=which,
            reference=reference,
            shapes=(modes.shapes / modes.shapes[reference, np.arange(n)]).real,
            unit_omega=_whitening_matrix(omega_covariance),
            unit_shapes=tuple(unit_shapes),
        )

    @property
    def n_data(self) -> int:
        """Number of frequencies and of shape entries, less one per shape for its scale."""
        return self.shapes.size

    @property
    def penalty(self) -> float:
        """ln n_data, by which each parameter raises the criterion."""
        return float(np.log(self.n_data))


def _paired(measured: RefinedModes, nominal: Bar | Beam) -> np.ndarray:
    """Index of the nominal structure's elastic mode paired with each measured one by shape, (n_modes,), from 0."""
    modes, none = measured.modes, Basis.polynomial(0)
    n = modes.n_modes + 4
    solved = SeriesStructure(nominal, none, none, modes.positions, n).solve(np.zeros(0), np.zeros(0))
    assert solved is not None, "a nominal structure has positive mass and stiffness"
    agreement = mac(normalised_shapes(modes.shapes).real, solved.modes(np.arange(n))[1])
    pairs = linear_sum_assignment(-agreement)[1]
    worst = int(np.argmin(agreement[np.arange(modes.n_modes), pairs]))
    if agreement[worst, pairs[worst]] < PROBLEM.min_mac:
        raise ValueError(
            f"measured mode {worst + 1} at {modes.frequencies_hz[worst]:.4g} Hz resembles no mode of the nominal"
            f" structure (best MAC {agreement[worst].max():.2f}); leave it out, correct the ends, or give numbers"
        )
    return np.asarray(pairs)


def _whitening_matrix(covariance: np.ndarray, least: float = 1e-12) -> Floats:
    """Whitening matrix W, W^T W the inverse of a covariance whose eigenvalues are at least a share of the largest."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors / np.sqrt(np.maximum(values, least * values.max()))).T)


def cramer_rao_bound(slopes: np.ndarray) -> Floats:
    """Covariance of parameters, from the Jacobian (n_rows, n_parameters) of residuals in standard errors."""
    return scaled_inverse(slopes.T @ slopes, INDISTINCT)


@dataclass(frozen=True, eq=False)
class Problem:
    """χ² of a structure of given terms, as a function of its free parameters z.

    z are the coefficients that the known values leave free, and share, centre and width of a loss if there is one.
    """

    task: Task
    series: SeriesStructure
    # of mass, of stiffness: c_0 and F of their coefficients c_0 + F z, which have the known values
    held: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

    @classmethod
    def of(cls, task: Task, mass: Basis, stiffness: Basis) -> "Problem":
        """The problem of a task with given series."""
        is_known = any(x.size for x, _ in task.known) or task.priors != (None, None)
        if mass.n_terms and stiffness.n_terms and not is_known:
            raise ValueError(
                "modes determine mass and stiffness only up to a common factor; give known_mass at a point,"
                " known_stiffness, or a prior"
            )
        positions = task.measured.modes.positions
        series = SeriesStructure(task.nominal, mass, stiffness, positions, int(task.which.max()) + 1)
        held, names = [], ("masses", "stiffnesses")
        for basis, nominal, (x, values), what in zip(
            series.bases, series.nominal_profiles, task.known, names, strict=True
        ):
            if basis.n_terms and x.size:
                ratios = values / nominal(x) - 1.0
                size = max(np.abs(ratios).max(), 1.0)
                held.append(held_exactly(basis.functions(x), ratios, f"{what} over the nominal", size))
            else:
                held.append((np.zeros(basis.n_terms), np.eye(basis.n_terms)))
        problem = cls(task, series, (held[0], held[1]))
        if problem.n_free > task.n_data:
            raise ValueError(
                f"{problem.n_free} terms cannot be found from {task.n_data} data of {task.which.size} modes at"
                f" {task.shapes.shape[0]} sensors; use fewer terms"
            )
        return problem

    @property
    def n_free(self) -> int:
        """Number of free parameters without a loss."""
        return sum(free.shape[1] for _, free in self.held)

    @cached_property
    def places(self) -> Floats:
        """Places (n_places,), m, at which series are compared."""
        return np.asarray((np.arange(100) + 0.5) / 100 * self.series.nominal.length)

    @cached_property
    def _prior_roots(self) -> list[tuple[Floats, slice]]:
        """`GaussianPrior.root` of each prior, and the place of its coefficients among d, e."""
        n, m = (basis.n_terms for basis in self.series.bases)
        each = zip(self.task.priors, self.series.bases, (slice(0, n), slice(n, n + m)), strict=True)
        return [
            (prior.root(basis, self.series.nominal.length), columns)
            for prior, basis, columns in each
            if prior is not None and basis.n_terms
        ]

    def parts(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, LocalLoss | None]:
        """Coefficients d, e and the loss, from the free parameters."""
        (d0, d_free), (e0, e_free) = self.held
        n, m = d_free.shape[1], self.n_free
        loss = LocalLoss(*(float(value) for value in z[m:])) if z.size > m else None
        return d0 + d_free @ z[:n], e0 + e_free @ z[n:m], loss

    def free_of(self, coefficients: np.ndarray) -> Floats:
        """The free parameters of coefficients (d, e) that have the known values."""
        (d0, d_free), (e0, e_free) = self.held
        d, e = np.split(coefficients, [d0.size])
        return np.concatenate([d_free.T @ (d - d0), e_free.T @ (e - e0)])

    def coefficient_jacobian(self, z: np.ndarray) -> np.ndarray:
        """∂(d, e, loss)/∂z."""
        return np.asarray(block_diag(*(free for _, free in self.held), np.eye(z.size - self.n_free)))

    def residuals(self, z: np.ndarray) -> tuple[Floats, Floats]:
        """Residuals of frequencies, shapes and priors in standard errors, (n_rows,), and their Jacobian by z."""
        task = self.task
        d, e, loss = self.parts(z)
        solved = self.series.solve(d, e, loss)
        if solved is None:
            n_rows = task.n_data + sum(len(root) for root, _ in self._prior_roots)
            return np.full(n_rows, NOT_POSITIVE), np.zeros((n_rows, z.size))
        computed = solved.sensitivity(task.which)
        rows = [task.unit_omega @ (computed.omega - task.measured.modes.omega)]
        slopes = [task.unit_omega @ computed.omega_by]
        for r, (k, unit) in enumerate(zip(task.reference, task.unit_shapes, strict=True)):
            shape, shape_slopes = computed.shapes[:, r], computed.shapes_by[:, r]
            ratio = shape / shape[k]
            rows.append(unit @ np.delete(ratio - task.shapes[:, r], k))
            ratio_slopes = (shape_slopes - ratio[:, None] * shape_slopes[k]) / shape[k]
            slopes.append(unit @ np.delete(ratio_slopes, k, axis=0))
        coefficients = np.r_[d, e]
        for root, columns in self._prior_roots:
            rows.append(root @ coefficients[columns])
            slopes.append(np.zeros((len(root), slopes[0].shape[1])))
            slopes[-1][:, columns] = root
        return np.concatenate(rows), np.vstack(slopes) @ self.coefficient_jacobian(z)

    def start(self) -> Floats:
        """Free parameters of the nominal structure, scaled to the known values and the measured frequencies."""
        known = zip(self.task.known, self.series.nominal_profiles, strict=True)
        mass, stiffness = (float(np.mean(values / nominal(x))) if x.size else 1.0 for (x, values), nominal in known)
        z = self.nearest(mass, stiffness)
        solved = self.series.solve(*self.parts(z))
        if solved is None:
            return z
        lowest = solved.eigenvalues[solved.n_rigid + self.task.which]
        ratio = float(np.median(self.task.measured.modes.omega**2 / lowest))
        (_, free), (known_at, _) = self.held[1], self.task.known[1]
        if free.shape[1] and not known_at.size:  # the stiffness is free to be scaled
            return self.nearest(mass, stiffness * ratio)
        return self.nearest(mass / ratio, stiffness)

    def nearest(self, mass: np.ndarray | float, stiffness: np.ndarray | float) -> Floats:
        """Free parameters of the series nearest to given ratios to the nominal mass and stiffness at `places`."""
        z = []
        for basis, ratio, (particular, free) in zip(self.series.bases, (mass, stiffness), self.held, strict=True):
            terms = basis.functions(self.places)
            z.append(np.linalg.lstsq(terms @ free, ratio - 1.0 - terms @ particular, rcond=None)[0])
        return np.concatenate(z)

    def covariance(self, z: np.ndarray) -> Floats:
        """Covariance of the free parameters, the Cramér-Rao bound.

        χ² does not depend on an edge of a loss beyond an end, and hardly on one just before it: the standard error of
        such an edge is that of an edge one standard error inside.
        """
        if z.size == self.n_free:
            return cramer_rao_bound(self.residuals(z)[1])
        from_edges = block_diag(np.eye(z.size - 2), FROM_EDGES)
        return np.asarray(from_edges @ self._edge_covariance(self.edges_inside(z)) @ from_edges.T)

    def _edge_covariance(self, z: np.ndarray) -> Floats:
        """The Cramér-Rao bound with the edges of the loss in place of centre and width."""
        slopes = self.residuals(z)[1]
        return cramer_rao_bound(np.hstack([slopes[:, :-2], slopes[:, -2:] @ FROM_EDGES]))

    def edges_inside(self, z: np.ndarray) -> np.ndarray:
        """z with each edge of the loss at least one standard error inside the ends; z itself where they are."""
        return self._edge_inside(self._edge_inside(z, 0, 1.0), 1, -1.0)

    def _edge_inside(self, z: np.ndarray, edge: int, inward: float) -> np.ndarray:
        width, length = z[-1], self.series.nominal.length
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
