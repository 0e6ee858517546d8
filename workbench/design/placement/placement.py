"""Where actuators should stand: the nodes of mode n+1, and CasADi against the spillover work W_R.

W_R alone has no useful minimum: the optimiser drives the outer actuators onto the supports, where B is singular and the
forces grow without bound. So a placement here is sought under limits on what the actuators must do.
"""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline
from scipy.optimize import brentq

from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError, Law
from workbench.design.placement.limits import Limits, conflict
from workbench.design.placement.scan import scan
from workbench.design.placement.task import Placement, PlacementTask, placement_task
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes
from workbench.threads import one_blas_thread

__all__ = ["Limits", "Placement", "PlacementTask", "law_at", "nodes_of_mode", "place", "placement_task", "scan"]

SPLINE_DEGREE = 7
PEAK_ROUNDS = 4


def nodes_of_mode(modes: Modes, mode: int) -> np.ndarray:
    """Interior nodes (n_nodes,) of a mode (zero-based), m: zeros of its shape away from the held ends (5.6)."""
    x = np.linspace(0.0, modes.length, 40 * (mode + 2) + 1)[1:-1]
    values = modes.phi(x)[:, mode]
    crossings = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    roots = [brentq(lambda at: modes.phi(at)[0, mode], x[i], x[i + 1], xtol=1e-14 * modes.length) for i in crossings]
    return np.array([*roots, *x[values == 0.0]]).round(14)


@one_blas_thread
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
    stretches = limits.room(n, length)
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
        positions, message, found = _solved(task, limits, solver, guess, homes)
        if not np.isfinite(found.residual_work) or not limits.kept(found):
            continue
        if not any(np.abs(positions - p).max() < 1e-4 * length for p, _ in optima):
            optima.append((positions, found.residual_work))
            status = message
    if not optima:
        raise DesignError(conflict(task, limits))
    optima.sort(key=lambda optimum: optimum[1])
    return task.placed(optima[0][0], status, optima)


def _solved(task: PlacementTask, limits: Limits, solver, guess, homes) -> tuple[np.ndarray, str, Placement]:
    """IPOPT from a guess, its sampled forces held lower by what the peak rises between the samples."""
    share = 1.0
    for _ in range(PEAK_ROUNDS):
        positions, message = solver(guess, homes, share)
        found = task.placed(positions, message)
        if not limits.peak_force < found.peak_force < np.inf:
            break
        guess, share = positions, share * limits.peak_force / found.peak_force
    return np.sort(positions), message, found


def _apart(x: float, stretch: tuple[float, float]) -> float:
    return max(stretch[0] - x, x - stretch[1], 0.0)


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
    first_force = len(bounded)
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
    n_forces = sum(part.shape[0] for part in bounded[first_force:]) - bool(np.isfinite(limits.condition))
    is_force = (np.arange(count) >= first_force) & (np.arange(count) < first_force + n_forces)

    def solve(guess: Sequence[float], homes: Sequence[tuple[float, float]], share: float) -> tuple[np.ndarray, str]:
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


def _telling(forces: np.ndarray) -> np.ndarray:
    """The instants that can decide the peak of any combination B⁻¹f: those on the hull of ±f, as directions see it."""
    directions = np.random.default_rng(0).standard_normal((400 * forces.shape[0], forces.shape[0]))
    return forces[:, np.unique(np.abs(directions @ forces).argmax(axis=1))]
