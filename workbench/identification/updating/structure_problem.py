"""The most likely mass and stiffness of a structure in so many terms, given modes that are known to within their
covariance.

Orthogonality (4.6) needs curvatures, and second derivatives of noisy shapes are worth little. So the eigenfunctions
are taken from the candidate structure itself: the coefficients d, e of

    m = m_0 (1 + Σ d_j M_j),   k = k_0 (1 + Σ e_j K_j)

minimise χ², the squares of what the candidate's own frequencies and shapes miss of the measured ones, each in units of
its standard error, by Gauss-Newton steps with exact sensitivities. This is the self-check of section 4.3 made the
criterion.
"""

from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import chi2 as chi2_distribution

from workbench.arrays import Floats, scaled_inverse, symmetric_root
from workbench.identification.updating.distributions import Basis, held_exactly
from workbench.identification.updating.self_check import SelfCheck
from workbench.identification.updating.sensitivity import LocalLoss, SeriesStructure
from workbench.identification.updating.structure_task import TASK, FittedStructure, Task, UncertainProfile
from workbench.structure.member import Beam
from workbench.structure.modes import frozen, mac
from workbench.structure.profile import Profile


@dataclass(frozen=True)
class ProblemSettings:
    """Constants of the fit of a structure."""

    narrowest: float = 0.02  # of the length: a loss narrower is a crack
    widest: float = 0.5  # of the length: one wider is no local one
    most_lost: float = 0.95  # of the stiffness
    draws: int = 1000  # of structures as likely as the fit, for bands
    most_steps: int = 25  # of least squares


PROBLEM = ProblemSettings()
INDISTINCT = 1e-12  # of normal equations: directions of the parameters that the data say nothing of
FROM_EDGES = np.array([[0.5, 0.5], [-1.0, 1.0]])  # centre and width of where a loss begins and ends


@dataclass(frozen=True, eq=False)
class Problem:
    """χ² of a structure of so many terms, as a function of its free parameters: those the known values leave, and a
    loss."""

    task: Task
    series: SeriesStructure
    mass_held: tuple[np.ndarray, np.ndarray]  # d = particular + free z
    stiffness_held: tuple[np.ndarray, np.ndarray]

    @classmethod
    def of(cls, task: Task, mass: Basis, stiffness: Basis) -> "Problem":
        """The task with so many terms.

        Raises:
            ValueError: overall size unknown, more terms than data, known values the series cannot take.
        """
        if mass.n_terms and stiffness.n_terms and not (len(task.known_mass) or len(task.known_stiffness)):
            if task.mass_prior is None and task.stiffness_prior is None:
                raise ValueError(
                    "modes determine mass and stiffness only up to a common factor; give known_mass at a point,"
                    " known_stiffness, or a prior"
                )
        series = SeriesStructure(task.nominal, mass, stiffness, task.measured.modes.positions)
        known = (
            (mass, task.known_mass, task.nominal.mass_per_length, "masses"),
            (stiffness, task.known_stiffness, series.nominal_stiffness, "stiffnesses"),
        )
        problem = cls(task, series, *(_held(*one) for one in known))
        if problem.n_free > task.n_data:
            raise ValueError(
                f"{problem.n_free} terms cannot be found from {task.n_data} data of {task.which.size} modes at"
                f" {task.shapes.shape[0]} sensors; use fewer terms"
            )
        return problem

    @property
    def n_free(self) -> int:
        """Free parameters without a loss."""
        return int(self.mass_held[1].shape[1] + self.stiffness_held[1].shape[1])

    def fit(self, near: FittedStructure | None = None, loss: LocalLoss | None = None) -> FittedStructure:
        """The most likely structure, searched from one found before, with a loss near `loss` if there is one."""
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
        if near is not None and not self.misses(z)[1].any():
            z[: self.n_free] = self._start()  # in other terms the one found before may be no structure
        memory: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

        def at(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            key = z.tobytes()
            if key not in memory:
                memory.clear()
                memory[key] = self.misses(z)
            return memory[key]

        def search(z: np.ndarray) -> OptimizeResult:
            tolerances = {"ftol": 1e-5, "xtol": 1e-9, "gtol": 1e-9, "max_nfev": PROBLEM.most_steps}
            return least_squares(
                lambda z: at(z)[0], z, lambda z: at(z)[1], bounds=(low, high), x_scale="jac", **tolerances
            )

        found = search(z)
        if loss is not None:
            # nothing draws back an edge that has passed an end
            inside = self._edges_inside(found.x)
            if inside is not found.x:
                found = min(found, search(np.clip(inside, low, high)), key=lambda ended: ended.cost)
        return self.report(found.x)

    def nominal(self) -> FittedStructure:
        """The nominal structure, scaled to the known values and the measured frequencies."""
        return self.report(self._start())

    def parts(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, LocalLoss | None]:
        """d, e and the loss of free parameters."""
        (d0, d_free), (e0, e_free) = self.mass_held, self.stiffness_held
        n, m = d_free.shape[1], self.n_free
        loss = LocalLoss(*(float(value) for value in z[m:])) if z.size > m else None
        return d0 + d_free @ z[:n], e0 + e_free @ z[n:m], loss

    def free_of(self, d: np.ndarray, e: np.ndarray) -> np.ndarray:
        """The free parameters of coefficients that take the known values."""
        both = zip((d, e), (self.mass_held, self.stiffness_held), strict=True)
        return np.concatenate([free.T @ (value - particular) for value, (particular, free) in both])

    def carry(self, z: np.ndarray) -> np.ndarray:
        """∂(d, e, loss)/∂z."""
        return np.asarray(block_diag(self.mass_held[1], self.stiffness_held[1], np.eye(z.size - self.n_free)))

    def misses(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What frequencies, shapes and prior are missed by, in standard errors, (n_rows,), and how it moves with z."""
        task = self.task
        d, e, loss = self.parts(z)
        solved = self.series.solve(d, e, n_modes=int(task.which.max()) + 1, loss=loss)
        carry = self.carry(z)
        priors = [
            (task.mass_prior, self.series.mass, d, slice(0, d.size)),
            (task.stiffness_prior, self.series.stiffness, e, slice(d.size, d.size + e.size)),
        ]
        n_prior = sum(value.size for prior, _, value, _ in priors if prior is not None)
        if solved is None:
            # No structure: so poor that the step is taken back.
            return np.full(task.n_data + n_prior, 1e8), np.zeros((task.n_data + n_prior, z.size))
        found = solved.sensitivity(task.which)
        rows = [task.unit_omega @ (found.omega - task.measured.modes.omega)]
        slopes = [task.unit_omega @ found.omega_by]
        for r, (k, unit) in enumerate(zip(task.reference, task.unit_shapes, strict=True)):
            others = np.arange(task.shapes.shape[0]) != k
            shape, by = found.shapes[:, r], found.shapes_by[:, r]
            ratio = shape / shape[k]
            rows.append(unit @ (ratio - task.shapes[:, r])[others])
            slopes.append(unit @ ((by - ratio[:, None] * by[k]) / shape[k])[others])
        for prior, basis, value, own in priors:
            if prior is not None and value.size:
                root = prior.root(basis, task.nominal.length)
                rows.append(root @ value)
                slope = np.zeros((value.size, carry.shape[0]))
                slope[:, own] = root
                slopes.append(slope)
        return np.concatenate(rows), np.vstack(slopes) @ carry

    def report(self, z: np.ndarray) -> FittedStructure:
        """The structure of free parameters z, with what the data leave open about it."""
        task, series = self.task, self.series
        if z.size > self.n_free:
            z = np.r_[z[: self.n_free], astuple(LocalLoss(*z[self.n_free :]).within(task.nominal.length))]
        rows = self.misses(z)[0]
        chi2 = float(rows @ rows)
        degrees_of_freedom = rows.size - z.size
        d, e, loss = self.parts(z)
        parameters = np.r_[d, e, z[self.n_free :]]
        carry = self.carry(z)
        covariance = carry @ self._covariance(z) @ carry.T
        if degrees_of_freedom > 0 and chi2 > chi2_distribution.isf(TASK.unlikely, degrees_of_freedom):
            covariance = covariance * chi2 / degrees_of_freedom
        size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        root = symmetric_root(covariance / np.outer(size, size))
        normal = np.random.default_rng(0).standard_normal((PROBLEM.draws, parameters.size))
        draws = parameters + size * (normal @ root.T)
        n, m = d.size, d.size + e.size
        length = task.nominal.length
        mass = _uncertain(task.nominal.mass_per_length, series.mass, d, draws[:, :n], length=length)
        stiffness = _uncertain(
            series.nominal_stiffness, series.stiffness, e, draws[:, n:m], loss, draws[:, m:], length=length
        )
        name = "bending_stiffness" if isinstance(task.nominal, Beam) else "axial_stiffness"
        changes: dict[str, Any] = {"mass_per_length": mass.profile, name: stiffness.profile}
        solved = series.solve(d, e, n_modes=int(task.which.max()) + 1, loss=loss)
        if solved is None:
            raise ValueError(
                "no positive mass and stiffness of this many terms were found; use fewer terms, a prior, or a nominal"
                " structure nearer to the real one"
            )
        found = solved.sensitivity(task.which)
        agreement = np.diag(mac(found.shapes, task.shapes))
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
            check=SelfCheck(found.omega / task.measured.modes.omega - 1.0, agreement),
        )

    def _covariance(self, z: np.ndarray) -> np.ndarray:
        """Of the free parameters, the Cramér-Rao bound.

        Nothing changes where an edge of a loss passes an end, and little just before it: such an edge is taken to be
        as uncertain as it would be one standard error inside.
        """
        if z.size == self.n_free:
            slopes = self.misses(z)[1]
            return scaled_inverse(slopes.T @ slopes, INDISTINCT)
        carry = block_diag(np.eye(z.size - 2), FROM_EDGES)
        return np.asarray(carry @ self._by_edges(self._edges_inside(z)) @ carry.T)

    def _by_edges(self, z: np.ndarray) -> np.ndarray:
        """The bound with the edges of the loss in place of centre and width."""
        slopes = self.misses(z)[1]
        slopes = np.hstack([slopes[:, :-2], slopes[:, -2:] @ FROM_EDGES])
        return scaled_inverse(slopes.T @ slopes, INDISTINCT)

    def _edges_inside(self, z: np.ndarray) -> np.ndarray:
        """The same with each edge of the loss at least one standard error inside; itself where they are."""
        return self._edge_inside(self._edge_inside(z, 0, 1.0), 1, -1.0)

    def _edge_inside(self, z: np.ndarray, edge: int, inward: float) -> np.ndarray:
        width, length = z[-1], self.task.nominal.length
        depth = np.linalg.solve(FROM_EDGES, z[-2:])[edge]
        depth = depth if inward > 0 else length - depth

        def moved(to: float) -> np.ndarray:
            return np.asarray(np.r_[z[:-2], z[-2:] + inward * (to - depth) * FROM_EDGES[:, edge]])

        def too_near(to: float) -> bool:
            return bool(self._by_edges(moved(to))[edge - 2, edge - 2] > to**2)

        least = 1e-5 * length
        if depth > width or (depth > least and not too_near(depth)):
            return z
        low, high = max(depth, least), depth + 0.9 * width
        while high > 1.1 * low:
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if too_near(middle) else (low, middle)
        return moved(high)

    def free_near(self, found: FittedStructure) -> np.ndarray:
        """Free parameters, a loss with them, of the series nearest to a structure found with other terms."""
        nominal, length = self.task.nominal, self.task.nominal.length
        x = (np.arange(100) + 0.5) / 100 * length
        mass = found.mass(x) / nominal.mass_per_length(x)
        stiffness = found.stiffness(x) / self.series.nominal_stiffness(x)
        if found.loss is None:
            return self._nearest(x, mass, stiffness)
        whole = stiffness / found.loss.of(Profile.constant(1.0), length)(x)
        return np.asarray(np.r_[self._nearest(x, mass, whole), found.parameters[-3:]])

    def _start(self) -> np.ndarray:
        """Free parameters of the nominal structure, scaled to the known values and the measured frequencies."""
        task, series = self.task, self.series
        x = (np.arange(100) + 0.5) / 100 * task.nominal.length
        size = np.ones(2)
        for i, (pairs, nominal) in enumerate(
            ((task.known_mass, task.nominal.mass_per_length), (task.known_stiffness, series.nominal_stiffness))
        ):
            if len(pairs):
                size[i] = np.mean(pairs[:, 1] / nominal(pairs[:, 0]))
        z = self._nearest(x, np.full(x.size, size[0]), np.full(x.size, size[1]))
        d, e, _ = self.parts(z)
        solved = series.solve(d, e, n_modes=int(task.which.max()) + 1)
        if solved is None:
            return z
        ratio = np.median(task.measured.modes.omega**2 / solved.eigenvalues[solved.n_rigid + task.which])
        if self.stiffness_held[1].shape[1] and not len(task.known_stiffness):
            return self._nearest(x, np.full(x.size, size[0]), np.full(x.size, size[1] * ratio))
        return self._nearest(x, np.full(x.size, size[0] / ratio), np.full(x.size, size[1]))

    def _nearest(self, x: np.ndarray, mass: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        """Free parameters of the series nearest to these multiples of the nominal mass and stiffness at x."""
        z = []
        for basis, ratio, (particular, free) in (
            (self.series.mass, mass, self.mass_held),
            (self.series.stiffness, stiffness, self.stiffness_held),
        ):
            terms = basis.functions(x)
            z.append(np.linalg.lstsq(terms @ free, ratio - 1.0 - terms @ particular, rcond=None)[0])
        return np.concatenate(z)


def _held(basis: Basis, known: np.ndarray, nominal: Profile, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients that take the known values, and the directions that keep them."""
    if basis.n_terms == 0 or len(known) == 0:
        return np.zeros(basis.n_terms), np.eye(basis.n_terms)
    rows, wanted = basis.functions(known[:, 0]), known[:, 1] / nominal(known[:, 0]) - 1.0
    return held_exactly(rows, wanted, f"{what} over the nominal", max(np.abs(wanted).max(), 1.0))


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
    """nominal (1 + series) (1 - loss), and as many others as there are draws."""

    def values(x: Floats, coefficients: Floats, losses: Floats | None) -> Floats:
        series: Floats = nominal(x) * (1.0 + coefficients @ basis.functions(x).T)
        if losses is None:
            return series
        share, centre, width = losses[:, :, None].transpose(1, 0, 2)
        within = np.abs(x - centre) < 0.5 * np.maximum(width, 0.0)
        return np.where(within, 1.0 - share, 1.0) * series

    smooth = Profile(
        lambda x: values(np.ravel(x), coefficients, None).reshape(np.shape(x)),
        tuple(sorted({*nominal.breaks, *basis.breaks})),
    )
    profile = smooth if loss is None else loss.of(smooth, length)
    return UncertainProfile(profile, lambda x: values(x, draws, None if loss is None else loss_draws), length)
