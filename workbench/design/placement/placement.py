"""Where actuators should stand: the nodes of mode n+1, and CasADi against the spillover work W_R.

W_R alone has no useful minimum: the optimiser drives the outer actuators onto the supports, where B is singular and the
forces grow without bound. So a placement here is sought under limits on what the actuators must do.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.optimize import brentq

from workbench.design.laws.law import DesignError
from workbench.design.placement.limits import Limits, conflict, takes_former_limits
from workbench.design.placement.scan import scan
from workbench.design.placement.task import Placement, PlacementTask, batch_costs, placement_task
from workbench.structure.modes import Modes
from workbench.threads import one_blas_thread

__all__ = ["Limits", "Placement", "PlacementTask", "nodes_of_mode", "place", "placement_task", "scan"]

Solver = Callable[[np.ndarray, Sequence[tuple[float, float]], float], tuple[np.ndarray, str]]

SPLINE_DEGREE = 7
PEAK_ROUNDS = 4


def nodes_of_mode(modes: Modes, mode: int) -> np.ndarray:
    """Interior nodes (n_nodes,) of a mode (zero-based), m: zeros of its shape away from the held ends (5.6)."""
    x = np.linspace(0.0, modes.length, 40 * (mode + 2) + 1)[1:-1]
    values = modes.phi(x)[:, mode]
    crossings = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    roots = [brentq(lambda at: modes.phi(at)[0, mode], x[i], x[i + 1], xtol=1e-14 * modes.length) for i in crossings]
    return np.array([*roots, *x[values == 0.0]]).round(14)


@takes_former_limits
@one_blas_thread
def place(task: PlacementTask, limits: Limits, *, starts: int = 12, seed: int = 0) -> Placement:
    """The law with its actuators where they spill the least W_R under limits, by CasADi and IPOPT from many starts.

    Where the limits name candidate places, every choice of these is evaluated instead.

    Args:
        task: from `placement_task`.
        limits: to keep.
        starts: random starts besides the evenly spaced places and the nodes of mode n+1.
        seed: of the random starts.

    Raises:
        DesignError: limits that no start can meet, with the one that conflicts.
    """
    if limits.candidates is not None:
        return scan(task, limits)[0]
    n, length, (first, last) = task.n_controlled, task.modes.length, task.reach
    intervals = limits.intervals(n, length, first)
    margin = max(limits.margin, first)
    solver = _solver(task, limits)
    rng = np.random.default_rng(seed)
    guesses = [first + (last - first) * (np.arange(n) + 1) / (n + 1)]
    nodes = nodes_of_mode(task.modes, n)
    if nodes.size == n:
        guesses.append(np.sort(nodes))
    guesses += [np.sort(rng.uniform(margin + 0.02 * length, length - margin - 0.02 * length, n)) for _ in range(starts)]
    optima: list[tuple[np.ndarray, float]] = []
    status = "no start ended inside the limits"
    for guess in guesses:
        # each actuator keeps to the interval nearest its start
        homes = [min(intervals, key=partial(_apart, x)) for x in guess]
        positions, message, found = _solved(task, limits, solver, guess, homes)
        if not np.isfinite(found.residual_work) or not limits.satisfied_by(found):
            continue
        if not any(np.abs(positions - p).max() < 1e-4 * length for p, _ in optima):
            optima.append((positions, found.residual_work))
            status = message
    if not optima:
        raise DesignError(conflict(task, limits))
    optima.sort(key=lambda optimum: optimum[1])
    return task.placed(optima[0][0], status, optima)


def _solved(
    task: PlacementTask, limits: Limits, solver: Solver, guess: np.ndarray, homes: Sequence[tuple[float, float]]
) -> tuple[np.ndarray, str, Placement]:
    """IPOPT from a guess, its sampled forces held lower by what the peak rises between the samples."""
    share = 1.0
    for _ in range(PEAK_ROUNDS):
        positions, message = solver(guess, homes, share)
        found = task.placed(positions, message)
        if not limits.peak_force < found.peak_force < np.inf:
            break
        guess, share = positions, share * limits.peak_force / found.peak_force
    return np.sort(positions), message, found


def _apart(x: float, interval: tuple[float, float]) -> float:
    return max(interval[0] - x, x - interval[1], 0.0)


# --- CasADi


def symbolic_work(task: PlacementTask) -> ca.Function:
    """CasADi function positions -> (W_R, effort, B⁻¹, ‖B‖²), derivatives exact: shapes as splines of degree seven."""
    n, modes = task.n_controlled, task.modes
    grid = np.linspace(*task.reach, 60 * modes.n_modes // 4 + 120)
    spline = make_interp_spline(grid, task.shapes(grid), k=SPLINE_DEGREE)
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


def _solver(task: PlacementTask, limits: Limits) -> Solver:
    n, length = task.n_controlled, task.modes.length
    function = symbolic_work(task)

    # variables: positions in units of the length
    z = ca.MX.sym("z", n)
    work, effort, inverse, size = function(float(length) * z)

    # objective and constraints, each of order one; those without a limit are left out
    first, last = task.reach
    even = first + (last - first) * (np.arange(n) + 1) / (n + 1)
    reference = float(batch_costs(task, task.shapes(even[None])).work[0])
    scale = float(reference) if np.isfinite(reference) and reference > 0 else 1.0
    bounded = [effort / float(limits.effort)] if np.isfinite(limits.effort) else []
    first_force = len(bounded)
    if np.isfinite(limits.peak_force):
        forces = ca.reshape(inverse @ ca.DM(_extreme_instants(task.forces)), -1, 1) / float(limits.peak_force)
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
    n_forces = sum(part.shape[0] for part in bounded[first_force:]) - bool(np.isfinite(limits.condition))
    is_force = (np.arange(count) >= first_force) & (np.arange(count) < first_force + n_forces)

    def solve(guess: np.ndarray, homes: Sequence[tuple[float, float]], share: float) -> tuple[np.ndarray, str]:
        low, high = np.clip(np.array(homes).T / length, 1e-3, 1.0 - 1e-3)
        result = solver(
            x0=np.clip(np.asarray(guess) / length, low, high),
            lbx=low,
            ubx=high,
            lbg=np.r_[np.full(count, -np.inf), np.full(n - 1, limits.spacing / length)],
            ubg=np.r_[np.where(is_force, share, 1.0), np.full(n - 1, np.inf)],
        )
        # IPOPT keeps its bounds but for 1e-8 of their size
        return length * np.clip(result["x"].full().ravel(), low, high), solver.stats()["return_status"]

    return solve


def _extreme_instants(forces: np.ndarray) -> np.ndarray:
    """The instants that can decide the peak of any combination B⁻¹f: those on the hull of ±f, as directions see it."""
    directions = np.random.default_rng(0).standard_normal((400 * forces.shape[0], forces.shape[0]))
    return forces[:, np.unique(np.abs(directions @ forces).argmax(axis=1))]
