"""Where actuators should stand: the nodes of mode n+1, and CasADi against the spillover work W_R.

With IMSC the modal forces do not depend on the places, so W_R = ½ Σ_r |φ_r(x)ᵀ B(x)⁻¹ f̂_r|² with f̂_r = f̂(iω_r) known
once and for all. W_R alone has no useful minimum: the optimiser drives the outer actuators onto the supports, where B
is singular and the forces grow without bound. So a placement here always limits what the actuators must do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline
from scipy.linalg import solve_continuous_lyapunov
from scipy.optimize import brentq

from workbench.design.imsc import imsc, riccati_gains
from workbench.design.law import DesignError, Law
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes, frozen

SPLINE_DEGREE = 7
SINGULAR_SHARE = 1e-14


@dataclass(frozen=True, eq=False)
class Placement:
    """Places of the actuators and what they cost.

    Attributes:
        positions: (n_actuators,) m, increasing.
        residual_work: W_R.
        by_mode: (n_residual,) W_r.
        effort: ∫ FᵀF dt.
        condition: of B.
        status: why the search stopped.
        local_optima: distinct local optima met from all starts, (positions, W_R), best first.
    """

    positions: np.ndarray
    residual_work: float
    by_mode: np.ndarray
    effort: float
    condition: float
    status: str
    local_optima: tuple[tuple[np.ndarray, float], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "positions", frozen(self.positions))
        object.__setattr__(self, "by_mode", frozen(self.by_mode))


@dataclass(frozen=True, eq=False)
class PlacementTask:
    """What is asked of a placement: modes, disturbance and control weight, all that does not depend on the places.

    Attributes:
        modes: controlled first, then residual; undamped or nearly so.
        n_controlled: n; as many actuators are placed.
        transforms: (n_residual, n_controlled) complex f̂(iω_r), modal control forces at the residual frequencies.
        force_gramian: (n_controlled, n_controlled) ∫ f fᵀ dt.
    """

    modes: Modes
    n_controlled: int
    transforms: np.ndarray
    force_gramian: np.ndarray

    def evaluate(self, positions: ArrayLike) -> tuple[float, np.ndarray, float, float]:
        """W_R, W_r (n_residual,), effort and condition of B for actuators at `positions`."""
        shapes = self.modes.phi(np.asarray(positions, float)).T
        b = shapes[: self.n_controlled]
        condition = float(np.linalg.cond(b))
        if not condition < 1e13:
            return np.inf, np.full(self.transforms.shape[0], np.inf), np.inf, np.inf
        inverse = np.linalg.inv(b)
        by_mode = 0.5 * np.abs(np.einsum("rj,jk,rk->r", shapes[self.n_controlled :], inverse, self.transforms)) ** 2
        effort = float(np.trace(inverse @ self.force_gramian @ inverse.T))
        return float(by_mode.sum()), by_mode, effort, condition

    def placed(self, positions: ArrayLike, status: str, optima=()) -> Placement:
        """A `Placement` of given positions."""
        total, by_mode, effort, condition = self.evaluate(positions)
        return Placement(
            np.sort(np.asarray(positions, float)), total, by_mode, effort, condition, status, tuple(optima)
        )


def placement_task(modes: Modes, n_controlled: int, *, impulse_at: float, weight: float, impulse: float = 1.0):
    """The task for an impulse (N s) at a place, IMSC with control weight R; t_f to infinity (5.43).

    Raises:
        DesignError: no residual mode, or a rigid-body mode that no impulse response of this kind settles.
    """
    if not 1 <= n_controlled < modes.n_modes:
        raise DesignError(f"{n_controlled} of {modes.n_modes} modes controlled leaves no residual mode to spill into")
    omega = modes.omega[:n_controlled]
    g1, g2 = riccati_gains(omega, weight)
    rate = impulse * modes.phi(impulse_at)[0, :n_controlled]
    s = 1j * modes.omega[n_controlled:, None]
    displacement = rate / (s**2 + g2 * s + omega**2 + g1)
    transforms = -(g1 + g2 * s) * displacement
    n = n_controlled
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(omega**2 + g1), -np.diag(g2)]])
    start = np.r_[np.zeros(n), rate]
    gramian = solve_continuous_lyapunov(a, -np.outer(start, start))
    gains = np.hstack([np.diag(g1), np.diag(g2)])
    return PlacementTask(modes, n_controlled, frozen(transforms, complex), frozen(gains @ gramian @ gains.T))


def nodes_of_mode(modes: Modes, mode: int) -> np.ndarray:
    """Interior nodes (n_nodes,) of a mode (zero-based), m: zeros of its shape away from the held ends (5.6)."""
    x = np.linspace(0.0, modes.length, 40 * (mode + 2) + 1)[1:-1]
    values = modes.phi(x)[:, mode]
    crossings = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    roots = [brentq(lambda at: modes.phi(at)[0, mode], x[i], x[i + 1], xtol=1e-14 * modes.length) for i in crossings]
    return np.array([*roots, *x[values == 0.0]]).round(14)


def place(
    task: PlacementTask,
    *,
    effort_limit: float,
    spacing: float,
    margin: float = 0.0,
    starts: int = 12,
    seed: int = 0,
) -> Placement:
    """Actuator places of least W_R under limits, by CasADi and IPOPT from many starts.

    Args:
        task: from `placement_task`.
        effort_limit: largest ∫ FᵀF dt allowed.
        spacing: least distance between neighbours, m.
        margin: least distance from the ends, m.
        starts: random starts besides the evenly spaced places and the nodes of mode n+1.
        seed: of the random starts.

    Raises:
        DesignError: limits that no start can meet, with the one that conflicts.
    """
    n, length = task.n_controlled, task.modes.length
    if 2 * margin + (n - 1) * spacing > length:
        raise DesignError(
            f"{n} actuators {spacing:g} apart and {margin:g} from the ends need {2 * margin + (n - 1) * spacing:g} m;"
            f" the structure has {length:g}: lower spacing or margin"
        )
    solver = _solver(task, effort_limit, spacing, margin)
    rng = np.random.default_rng(seed)
    guesses = [margin + (length - 2 * margin) * (np.arange(n) + 1) / (n + 1)]
    nodes = nodes_of_mode(task.modes, n)
    if nodes.size == n:
        guesses.append(np.sort(nodes))
    guesses += [np.sort(rng.uniform(margin + 0.02 * length, length - margin - 0.02 * length, n)) for _ in range(starts)]
    optima: list[tuple[np.ndarray, float]] = []
    status, least_effort = "no start ended inside the limits", np.inf
    for guess in guesses:
        positions, message = solver(guess)
        total, _, effort, _ = task.evaluate(positions)
        least_effort = min(least_effort, effort)
        inside = effort <= effort_limit * (1 + 1e-6) and (np.diff(positions) >= spacing * (1 - 1e-6) - 1e-12).all()
        if inside and np.isfinite(total) and not any(np.abs(positions - p).max() < 1e-4 * length for p, _ in optima):
            optima.append((positions, total))
            status = message
    if not optima:
        raise DesignError(
            f"no placement of {n} actuators meets the effort limit {effort_limit:.4g} with spacing {spacing:g};"
            f" the least effort met was {least_effort:.4g}: raise the limit or lower the spacing"
        )
    optima.sort(key=lambda optimum: optimum[1])
    return task.placed(optima[0][0], status, optima)


def scan(
    task: PlacementTask, *, effort_limit: float, spacing: float, margin: float = 0.0, n_places: int = 60
) -> tuple[Placement, int]:
    """The best of all placements on a grid, and how many were tried: the check that an optimum is global.

    For up to four actuators the grid of `n_places` candidate places is searched whole, in batches.
    """
    n, length = task.n_controlled, task.modes.length
    grid = np.linspace(max(margin, length / n_places / 2), length - max(margin, length / n_places / 2), n_places)
    shapes = task.modes.phi(grid)
    every = np.array(list(combinations(range(n_places), n)))
    every = every[(np.diff(grid[every], axis=1) >= spacing - 1e-12).all(axis=1)]
    best, best_at = np.inf, None
    for batch in np.array_split(every, max(1, len(every) // 20000)):
        work, effort = batch_work(task, shapes[batch])
        work = np.where(effort <= effort_limit, work, np.inf)
        i = int(np.argmin(work)) if work.size else 0
        if work.size and work[i] < best:
            best, best_at = work[i], grid[batch[i]]
    if best_at is None:
        raise DesignError(f"no placement on the grid meets the effort limit {effort_limit:.4g}; raise it")
    return task.placed(best_at, f"best of {len(every)} placements on a grid"), len(every)


def batch_work(task: PlacementTask, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """W_R and effort of many placements at once.

    Args:
        shapes: (n_placements, n_actuators, n_modes) of the modes at the actuators.

    Returns:
        W_R (n_placements,) and effort (n_placements,); inf where B is singular.
    """
    n = task.n_controlled
    b = shapes[:, :, :n].transpose(0, 2, 1)
    # Hadamard: |det B| against the product of its row lengths, so that mass and units do not matter
    singular = np.abs(np.linalg.det(b)) <= SINGULAR_SHARE * np.linalg.norm(b, axis=2).prod(axis=1)
    b = np.where(singular[:, None, None], np.eye(n), b)
    inverse = np.linalg.inv(b)
    spread = shapes[:, :, n:].transpose(0, 2, 1) @ inverse
    real = np.einsum("prk,rk->pr", spread, task.transforms.real)
    imaginary = np.einsum("prk,rk->pr", spread, task.transforms.imag)
    work = 0.5 * (real**2 + imaginary**2).sum(axis=1)
    effort = np.einsum("pik,kl,pil->p", inverse, task.force_gramian, inverse)
    return np.where(singular, np.inf, work), np.where(singular, np.inf, effort)


def law_at(task: PlacementTask, positions: ArrayLike, *, weight: float) -> Law:
    """The IMSC law with actuators at the given places."""
    actuators = [Actuator(f"F{i + 1}", float(x)) for i, x in enumerate(np.asarray(positions, float))]
    return imsc(task.modes, task.n_controlled, actuators, weight=weight)


# --- CasADi


def symbolic_work(task: PlacementTask):
    """CasADi function positions -> (W_R, effort), with exact derivatives: shapes as splines of degree seven."""
    n, modes = task.n_controlled, task.modes
    grid = np.linspace(0.0, modes.length, 60 * modes.n_modes // 4 + 120)
    spline = make_interp_spline(grid, modes.phi(grid), k=SPLINE_DEGREE)
    x = ca.MX.sym("x", n)
    columns = [
        ca.bspline(x[i], ca.DM(spline.c.ravel()), [list(spline.t)], [SPLINE_DEGREE], modes.n_modes, {})
        for i in range(n)
    ]
    shapes = ca.horzcat(*columns)
    inverse = ca.inv(shapes[:n, :])
    residual = shapes[n:, :] @ inverse
    real = ca.sum2(residual * ca.DM(task.transforms.real))
    imaginary = ca.sum2(residual * ca.DM(task.transforms.imag))
    work = 0.5 * ca.sum1(real**2 + imaginary**2)
    effort = ca.trace(inverse @ ca.DM(task.force_gramian) @ inverse.T)
    return ca.Function("work", [x], [work, effort], ["positions"], ["work", "effort"])


def _solver(task: PlacementTask, effort_limit: float, spacing: float, margin: float):
    n, length = task.n_controlled, task.modes.length
    function = symbolic_work(task)

    # variables: positions in units of the length
    z = ca.MX.sym("z", n)
    work, effort = function(length * z)

    # objective and constraints, each of order one
    reference = task.evaluate(length * (np.arange(n) + 1) / (n + 1))[0]
    gaps = z[1:] - z[:-1]
    constraints = ca.vertcat(effort / effort_limit, gaps)
    problem: dict[str, ca.MX] = {"x": z, "f": ca.log(work / max(reference, 1e-300)), "g": constraints}
    options: dict[str, Any] = {
        "ipopt.print_level": 0,
        "print_time": 0,
        "ipopt.sb": "yes",
        "ipopt.max_iter": 200,
        "ipopt.tol": 1e-9,
    }
    solver = ca.nlpsol("placement", "ipopt", problem, options)
    low, high = max(margin / length, 1e-3), 1.0 - max(margin / length, 1e-3)

    def solve(guess: Sequence[float]) -> tuple[np.ndarray, str]:
        result = solver(
            x0=np.asarray(guess) / length,
            lbx=low,
            ubx=high,
            lbg=np.r_[-np.inf, np.full(n - 1, spacing / length)],
            ubg=np.r_[1.0, np.full(n - 1, np.inf)],
        )
        return length * np.asarray(result["x"]).ravel(), solver.stats()["return_status"]

    return solve
