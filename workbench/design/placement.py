"""Where actuators should stand: the nodes of mode n+1, and CasADi against the spillover work W_R.

W_R alone has no useful minimum: the optimiser drives the outer actuators onto the supports, where B is singular and the
forces grow without bound. So a placement here is sought under limits on what the actuators must do.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, islice
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline
from scipy.optimize import brentq

from workbench.design.imsc import imsc
from workbench.design.law import DesignError, Law
from workbench.design.placement_task import Placement, PlacementTask, batch_figures, placement_task
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes

__all__ = ["Limits", "Placement", "PlacementTask", "law_at", "nodes_of_mode", "place", "placement_task", "scan"]

SPLINE_DEGREE = 7
KEPT = 1e-6
BATCH = 20000


@dataclass(frozen=True)
class Limits:
    """What a placement must keep to.

    Attributes:
        effort: largest ∫ FᵀF dt.
        peak_force: largest force of any actuator.
        condition: of B, largest ‖B‖‖B⁻¹‖ in the Frobenius norm (n where B is orthogonal).
        spacing: least distance between neighbours, m.
        margin: least distance from the ends, m.
        forbidden: stretches (from, to) where no actuator can stand, m.
    """

    effort: float = np.inf
    peak_force: float = np.inf
    condition: float = np.inf
    spacing: float = 0.0
    margin: float = 0.0
    forbidden: tuple[tuple[float, float], ...] = ()

    def allowed(self, length: float) -> list[tuple[float, float]]:
        """Stretches where an actuator may stand, m.

        Raises:
            DesignError: none is left, or a stretch that is none.
        """
        at, stretches = self.margin, []
        for low, high in sorted(self.forbidden):
            if not low < high:
                raise DesignError(f"forbidden stretch ({low:g}, {high:g}) must run from less to more")
            if low > at:
                stretches.append((at, min(low, length - self.margin)))
            at = max(at, high)
        stretches.append((at, length - self.margin))
        stretches = [(low, high) for low, high in stretches if low <= high]
        if not stretches:
            raise DesignError(f"margin {self.margin:g} and the forbidden stretches leave no place of {length:g} m")
        return stretches

    def broken(self, positions: np.ndarray, figures) -> dict[str, np.ndarray]:
        """By name of limit, by how much each of many placements (n_placements, n) breaks it, relative; <= 0 is kept."""
        gaps = np.diff(positions, axis=1).min(axis=1, initial=np.inf)
        return {
            "effort": _excess(figures.effort, self.effort),
            "peak force": _excess(figures.peak_force, self.peak_force),
            "condition": _excess(figures.condition, self.condition),
            "spacing": (self.spacing - gaps) / self.spacing if self.spacing > 0 else np.zeros(len(positions)),
        }


def _apart(x: float, stretch: tuple[float, float]) -> float:
    return max(stretch[0] - x, x - stretch[1], 0.0)


def _excess(values: np.ndarray, limit: float) -> np.ndarray:
    return values / limit - 1.0 if np.isfinite(limit) else np.full(values.shape, -1.0)


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
    effort_limit: float = np.inf,
    spacing: float = 0.0,
    margin: float = 0.0,
    peak_limit: float = np.inf,
    condition_limit: float = np.inf,
    forbidden: Iterable[tuple[float, float]] = (),
    starts: int = 12,
    seed: int = 0,
) -> Placement:
    """Actuator places of least W_R under limits, by CasADi and IPOPT from many starts.

    Args:
        task: from `placement_task`.
        effort_limit, peak_limit, condition_limit, spacing, margin, forbidden: see `Limits`.
        starts: random starts besides the evenly spaced places and the nodes of mode n+1.
        seed: of the random starts.

    Raises:
        DesignError: limits that no start can meet, with the one that conflicts.
    """
    limits = Limits(effort_limit, peak_limit, condition_limit, spacing, margin, tuple(forbidden))
    n, length = task.n_controlled, task.modes.length
    stretches = _checked_room(limits, n, length)
    solver = _solver(task, limits)
    rng = np.random.default_rng(seed)
    guesses = [length * (np.arange(n) + 1) / (n + 1)]
    nodes = nodes_of_mode(task.modes, n)
    if nodes.size == n:
        guesses.append(np.sort(nodes))
    guesses += [np.sort(rng.uniform(margin + 0.02 * length, length - margin - 0.02 * length, n)) for _ in range(starts)]
    optima: list[tuple[np.ndarray, float]] = []
    status = "no start ended inside the limits"
    for guess in guesses:
        # each actuator keeps to the stretch nearest its start
        homes = [min(stretches, key=partial(_apart, x)) for x in guess]
        positions, message = solver(guess, homes)
        positions = np.sort(positions)
        found = task.placed(positions, message)
        if not np.isfinite(found.residual_work) or not _kept(task, limits, positions):
            continue
        if not any(np.abs(positions - p).max() < 1e-4 * length for p, _ in optima):
            optima.append((positions, found.residual_work))
            status = message
    if not optima:
        raise DesignError(conflict(task, limits))
    optima.sort(key=lambda optimum: optimum[1])
    return task.placed(optima[0][0], status, optima)


def scan(
    task: PlacementTask,
    *,
    effort_limit: float = np.inf,
    spacing: float = 0.0,
    margin: float = 0.0,
    peak_limit: float = np.inf,
    condition_limit: float = np.inf,
    forbidden: Iterable[tuple[float, float]] = (),
    n_places: int = 60,
    candidates: ArrayLike | None = None,
) -> tuple[Placement, int]:
    """The best of all placements on a grid or on given candidate places, and how many were tried.

    Args:
        effort_limit, peak_limit, condition_limit, spacing, margin, forbidden: see `Limits`.
        n_places: of the grid.
        candidates: (n_candidates,) places, instead of a grid, m.

    Raises:
        DesignError: fewer places than actuators, or limits that none meets, with the one that conflicts.
    """
    limits = Limits(effort_limit, peak_limit, condition_limit, spacing, margin, tuple(forbidden))
    n, length = task.n_controlled, task.modes.length
    stretches = _checked_room(limits, n, length)
    if candidates is None:
        edge = max(margin, length / n_places / 2)
        grid = np.linspace(edge, length - edge, n_places)
    else:
        grid = np.sort(np.asarray(candidates, float))
    grid = grid[np.any([(grid >= low - 1e-12) & (grid <= high + 1e-12) for low, high in stretches], axis=0)]
    if grid.size < n:
        raise DesignError(f"{n} actuators need as many places; the limits leave {grid.size}: allow more")
    shapes = task.shapes(grid)
    best, best_at, tried = np.inf, None, 0
    every = combinations(range(grid.size), n)
    while batch := list(islice(every, BATCH)):
        index = np.array(batch)
        index = index[(np.diff(grid[index], axis=1) >= spacing - 1e-12).all(axis=1)]
        if not index.size:
            continue
        tried += len(index)
        figures = batch_figures(task, shapes[index])
        broken = limits.broken(grid[index], figures)
        work = np.where(np.all([b <= KEPT for b in broken.values()], axis=0), figures.work, np.inf)
        i = int(np.argmin(work))
        if work[i] < best:
            best, best_at = work[i], grid[index[i]]
    if best_at is None:
        raise DesignError(conflict(task, limits, grid))
    return task.placed(best_at, f"best of {tried} placements"), tried


def conflict(task: PlacementTask, limits: Limits, grid: np.ndarray | None = None) -> str:
    """Which limit cannot be met, or which two not together, and what could be: the words of a refusal."""
    n, length = task.n_controlled, task.modes.length
    if grid is None:
        grid = np.concatenate([np.linspace(*stretch, 40) for stretch in limits.allowed(length)])
    rng = np.random.default_rng(0)
    draws = np.sort(np.array([rng.choice(grid.size, n, replace=False) for _ in range(BATCH)]), axis=1)
    positions = np.sort(grid[draws], axis=1)
    figures = batch_figures(task, task.shapes(positions))
    broken = limits.broken(positions, figures)
    within = {name: excess <= KEPT for name, excess in broken.items()}
    measured = {"effort": figures.effort, "peak force": figures.peak_force, "condition": figures.condition}
    asked = {"effort": limits.effort, "peak force": limits.peak_force, "condition": limits.condition}
    head = f"no placement of {n} actuators meets the limits"
    spaced = within["spacing"]
    if not spaced.any():
        return f"{head}: spacing {limits.spacing:g} leaves no room; lower it"
    for name, values in measured.items():
        if not (within[name] & spaced).any():
            least = values[spaced].min()
            return (
                f"{head}: {name} limit {asked[name]:.4g} with spacing {limits.spacing:g}; the least met was"
                f" {least:.4g}: raise the limit or lower the spacing"
            )
    for one, other in combinations(measured, 2):
        if not (within[one] & within[other] & spaced).any():
            least = measured[other][within[one] & spaced].min()
            return (
                f"{head}: {one} {asked[one]:.4g} and {other} {asked[other]:.4g} conflict; with the first the least"
                f" {other} met was {least:.4g}: raise one of them"
            )
    return f"{head} together, though any two can be met; raise one of them"


def _checked_room(limits: Limits, n: int, length: float) -> list[tuple[float, float]]:
    for name in ("effort", "peak_force", "condition"):
        if not getattr(limits, name) > 0:
            raise DesignError(f"the limit of {name.replace('_', ' ')} must be positive; got {getattr(limits, name):g}")
    if min(limits.spacing, limits.margin) < 0:
        raise DesignError(f"spacing and margin must be 0 or more; got {limits.spacing:g} and {limits.margin:g}")
    if 2 * limits.margin + (n - 1) * limits.spacing > length:
        needed = 2 * limits.margin + (n - 1) * limits.spacing
        raise DesignError(
            f"{n} actuators {limits.spacing:g} apart and {limits.margin:g} from the ends need {needed:g} m; the"
            f" structure has {length:g}: lower spacing or margin"
        )
    return limits.allowed(length)


def _kept(task: PlacementTask, limits: Limits, positions: np.ndarray) -> bool:
    broken = limits.broken(positions[None], batch_figures(task, task.shapes(positions)[None]))
    return all(excess[0] <= 2 * KEPT for excess in broken.values())


def law_at(task: PlacementTask, positions: ArrayLike, *, weight: float) -> Law:
    """The IMSC law with actuators at the given places."""
    actuators = [Actuator(f"F{i + 1}", float(x)) for i, x in enumerate(np.asarray(positions, float))]
    return imsc(task.modes, task.n_controlled, actuators, weight=weight)


# --- CasADi


def symbolic_work(task: PlacementTask):
    """CasADi function positions -> (W_R, effort, B⁻¹, ‖B‖²), derivatives exact: shapes as splines of degree seven."""
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
    work = 0.5 * sum(ca.sumsqr(ca.sum2(residual * ca.DM(task.roots[:, :, j]))) for j in range(task.roots.shape[2]))
    effort = ca.trace(inverse @ ca.DM(task.force_gramian) @ inverse.T)
    outputs = [work, effort, inverse, ca.sumsqr(shapes[:n, :])]
    return ca.Function("work", [x], outputs, ["positions"], ["work", "effort", "inverse", "size"])


def _solver(task: PlacementTask, limits: Limits):
    n, length = task.n_controlled, task.modes.length
    function = symbolic_work(task)

    # variables: positions in units of the length
    z = ca.MX.sym("z", n)
    work, effort, inverse, size = function(float(length) * z)

    # objective and constraints, each of order one; those without a limit are left out
    reference = task.placed(length * (np.arange(n) + 1) / (n + 1), "").residual_work
    scale = float(reference) if np.isfinite(reference) and reference > 0 else 1.0
    bounded = [effort / float(limits.effort)] if np.isfinite(limits.effort) else []
    if np.isfinite(limits.peak_force):
        forces = ca.reshape(inverse @ ca.DM(_telling(task.forces)), -1, 1) / float(limits.peak_force)
        bounded += [forces, -forces]
    if np.isfinite(limits.condition):
        bounded.append(ca.sumsqr(inverse) * size / float(limits.condition) ** 2)
    limited = ca.vertcat(*bounded) if bounded else ca.MX(0, 1)
    gaps = ca.reshape(z[1:] - z[:-1], -1, 1) if n > 1 else ca.MX(0, 1)
    problem: dict[str, ca.MX] = {"x": z, "f": ca.log(work / scale + 1e-300), "g": ca.vertcat(limited, gaps)}
    options: dict[str, Any] = {
        "ipopt.print_level": 0,
        "print_time": 0,
        "ipopt.sb": "yes",
        "ipopt.max_iter": 200,
        "ipopt.tol": 1e-9,
    }
    solver = ca.nlpsol("placement", "ipopt", problem, options)
    count = limited.shape[0]

    def solve(guess: Sequence[float], homes: Sequence[tuple[float, float]]) -> tuple[np.ndarray, str]:
        low, high = np.clip(np.array(homes).T / length, 1e-3, 1.0 - 1e-3)
        result = solver(
            x0=np.clip(np.asarray(guess) / length, low, high),
            lbx=low,
            ubx=high,
            lbg=np.r_[np.full(count, -np.inf), np.full(n - 1, limits.spacing / length)],
            ubg=np.r_[np.ones(count), np.full(n - 1, np.inf)],
        )
        # IPOPT keeps its bounds but for 1e-8 of their size
        return length * np.clip(result["x"].full().ravel(), low, high), solver.stats()["return_status"]

    return solve


def _telling(forces: np.ndarray) -> np.ndarray:
    """The instants that can decide the peak of any combination B⁻¹f: those on the hull of ±f, as directions see it."""
    directions = np.random.default_rng(0).standard_normal((400 * forces.shape[0], forces.shape[0]))
    return forces[:, np.unique(np.abs(directions @ forces).argmax(axis=1))]
