"""Placement of actuators: the nodes of mode n+1, and the minimum of the spillover work W_R by CasADi and IPOPT.

W_R alone has no useful minimum: the optimiser drives the outer actuators onto the supports, where B is singular and the
forces grow without bound. Placements are therefore optimised under limits of effort, peak force or condition.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.optimize import brentq

from workbench.design.laws.law import DesignError
from workbench.design.placement.limits import Limits, conflict, takes_former_limits
from workbench.design.placement.places import Box
from workbench.design.placement.scan import best_of_candidates, scan
from workbench.design.placement.task import Placement, PlacementTask, batch_costs, placement_task
from workbench.structure.domain import Interval, NamedPoints, Rectangle, reach
from workbench.structure.modes import Modes
from workbench.threads import one_blas_thread

__all__ = ["Limits", "Placement", "PlacementTask", "nodes_of_mode", "place_actuators", "placement_task", "scan"]

Solver = Callable[[np.ndarray, Sequence[Box], float], tuple[np.ndarray, str]]

SPLINE_DEGREE = 7
PEAK_ROUNDS = 4  # of lowering the limit of the sampled forces
DRAWN = 4000  # random placements on a surface, of which the best are starts
MOVES = 4  # of actuators from box to box around forbidden zones
SAME = 1e-4  # of the size: optima nearer to each other are one
INSIDE = 0.02  # of the length: least distance of random starts from the ends of their range
POINTS = 40  # per half wave, to bracket nodes
SPLINE_POINTS = {"interval": (15, 120), "side": (10, 30)}  # of the shapes' splines: per mode or half wave, and added
DIRECTIONS = 400  # per modal force, to select the instants of possible peaks
IPOPT = {"ipopt.max_iter": 200, "ipopt.tol": 1e-9}
IPOPT_SAYS = {
    "Solve_Succeeded": "converged",
    "Solved_To_Acceptable_Level": "converged, to IPOPT's acceptable tolerance",
}
OFF_ENDS = 1e-3  # of a side: least distance of IPOPT's places from the ends
ON_EDGE = 1e-6  # of a side: an actuator nearer to the edge of its box is on the edge


def nodes_of_mode(modes: Modes, mode: int) -> np.ndarray:
    """Interior nodes (n_nodes,) of a mode (zero-based), m: zeros of its shape away from the held ends (5.6).

    Raises:
        DesignError: an index without a mode.
    """
    if mode >= modes.n_modes:
        raise DesignError(f"the nodes of mode {mode + 1} are not known from {modes.n_modes} modes; ask for more modes")
    x = np.linspace(0.0, modes.length, POINTS * (mode + 2) + 1)[1:-1]
    values = modes.phi(x)[:, mode]
    crossings = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    roots = [brentq(lambda at: modes.phi(at)[0, mode], x[i], x[i + 1], xtol=1e-14 * modes.length) for i in crossings]
    return np.array([*roots, *x[values == 0.0]]).round(14)


@takes_former_limits
@one_blas_thread
def place_actuators(task: PlacementTask, limits: Limits, *, starts: int = 12, seed: int = 0) -> Placement:
    """The placement of least spillover work W_R under limits, by CasADi and IPOPT from many starts.

    Among candidate places, and at named points, every choice is evaluated instead. If choices are too many, single
    places are exchanged until no exchange improves W_R; `certify` then bounds the optimality gap.

    Args:
        task: from `placement_task`.
        limits: of the placement.
        starts: random starts, in addition to evenly spaced places and the nodes of mode n+1; on a surface the best of
            many random placements.
        seed: of the random starts.

    Raises:
        DesignError: limits that no start meets; the message names the conflict.
    """
    domain = task.modes.domain
    if limits.candidates is not None or isinstance(domain, NamedPoints):
        return best_of_candidates(task, limits)
    boxes = limits.boxes(task)
    solver = _solver(task, limits)
    rng = np.random.default_rng(seed)
    guesses = _guesses(task, limits, boxes, starts, rng)
    size = domain.size
    optima: list[tuple[np.ndarray, float]] = []
    status = "no start converged to a feasible point"
    for guess in guesses:
        # each actuator stays in the box nearest to its start; one that ends on the edge moves to the adjacent box
        homes = [min(boxes, key=partial(_distance_to_box, x)) for x in guess]
        positions, message, placement = _solved(task, limits, solver, guess, homes)
        for _ in range(MOVES if len(boxes) > 1 and isinstance(domain, Rectangle) else 0):
            moved = _next_homes(positions, homes, boxes, size)
            if moved is None:
                break
            homes = moved
            candidate = _solved(task, limits, solver, positions, homes)
            if not (limits.satisfied_by(candidate[2]) and candidate[2].residual_work < placement.residual_work):
                break
            positions, message, placement = candidate
        if not np.isfinite(placement.residual_work) or not limits.satisfied_by(placement):
            continue
        positions = placement.positions
        if not any(np.abs(positions - p).max() < SAME * size for p, _ in optima):
            if placement.residual_work <= min((work for _, work in optima), default=np.inf):
                status = message
            optima.append((positions, placement.residual_work))
    if not optima:
        raise DesignError(conflict(task, limits))
    optima.sort(key=lambda optimum: optimum[1])
    return task.placed(optima[0][0], status, optima)


def _guesses(
    task: PlacementTask, limits: Limits, boxes: Sequence[Box], starts: int, rng: np.random.Generator
) -> list[np.ndarray]:
    """Starts of the optimisation, (n_actuators, n_coordinates) m each.

    Along an interval: evenly spaced places, nodes and random ones; on a surface: the best of many random placements.
    """
    n, domain = task.n_controlled, task.modes.domain
    if not isinstance(domain, Interval):
        share = np.array([np.prod(high - low) for low, high in boxes])
        share = share / share.sum() if share.any() else np.full(len(boxes), 1.0 / len(boxes))
        low, high = (np.array([box[i] for box in boxes]) for i in (0, 1))
        box = rng.choice(len(boxes), (DRAWN, n), p=share)
        drawn = low[box] + (high[box] - low[box]) * rng.random((DRAWN, n, 2))
        costs = batch_costs(task, task.shapes(drawn))
        excess = np.maximum(np.max(list(limits.violations(drawn, costs).values()), axis=0), 0.0)
        order = np.lexsort((costs.work, excess))
        return [_in_order(drawn[i]) for i in order[: starts + 2]]
    length, margin = domain.length, max(limits.edge_distance, task.reach[0])
    guesses = [_evenly_spaced(task)]
    nodes = nodes_of_mode(task.modes, n)
    if nodes.size == n:
        guesses.append(np.sort(nodes))
    first, last = margin + INSIDE * length, length - margin - INSIDE * length
    guesses += [np.sort(rng.uniform(first, last, n)) for _ in range(starts)]
    return [guess[:, None] for guess in guesses]


def _evenly_spaced(task: PlacementTask) -> np.ndarray:
    """Places (n_actuators,) along an interval, m."""
    (first, last), n = task.reach, task.n_controlled
    return np.asarray(first + (last - first) * (np.arange(n) + 1) / (n + 1))


def _solved(
    task: PlacementTask, limits: Limits, solver: Solver, guess: np.ndarray, homes: Sequence[Box]
) -> tuple[np.ndarray, str, Placement]:
    """IPOPT's result from a start; the limit of the sampled forces is lowered until the true peak meets the limit."""
    share = 1.0
    for _ in range(PEAK_ROUNDS):
        positions, message = solver(guess, homes, share)
        one_coordinate = isinstance(task.modes.domain, Interval)
        placement = task.placed(positions[:, 0] if one_coordinate else _in_order(positions), message)
        if not limits.peak_force < placement.peak_force < np.inf:
            break
        guess, share = positions, share * limits.peak_force / placement.peak_force
    return positions, message, placement


def _in_order(pairs: np.ndarray) -> np.ndarray:
    """Places of identical actuators on a surface, from left to right."""
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _distance_to_box(at: np.ndarray, box: Box) -> float:
    return float(np.maximum(np.maximum(box[0] - at, at - box[1]), 0.0).max())


def _next_homes(positions: np.ndarray, homes: Sequence[Box], boxes: Sequence[Box], size: float) -> list[Box] | None:
    """The boxes of the actuators; one on the edge of its box gets another that contains it. None without a change."""

    def room(at: np.ndarray, box: Box) -> float:
        return float(np.minimum(at - box[0], box[1] - at).min())

    edge, next_homes = ON_EDGE * size, []
    for at, home in zip(positions, homes, strict=True):
        widest = max(boxes, key=partial(room, at))
        next_homes.append(widest if room(at, home) < edge < room(at, widest) else home)
    changed = any(one is not other for one, other in zip(next_homes, homes, strict=True))
    return next_homes if changed else None


def symbolic_work(task: PlacementTask) -> ca.Function:
    """CasADi function positions -> (W_R, effort, B⁻¹, ‖B‖²) with exact derivatives; shapes are splines of degree seven.

    Positions are x_1, ..., x_n along an interval; x_1, y_1, ..., x_n, y_n on a rectangle.
    """
    n, n_coordinates = task.n_controlled, len(task.modes.domain.coordinates)
    knots, coefficients = _spline(task)
    degrees = [SPLINE_DEGREE] * n_coordinates
    x = ca.MX.sym("x", n * n_coordinates)
    columns = [
        ca.bspline(x[n_coordinates * i : n_coordinates * (i + 1)], coefficients, knots, degrees, task.modes.n_modes, {})
        for i in range(n)
    ]
    shapes = ca.horzcat(*columns)
    inverse = ca.inv(shapes[:n, :])
    residual = shapes[n:, :] @ inverse
    work = 0.5 * sum(ca.sumsqr(ca.sum2(residual * ca.DM(task.roots[:, :, j]))) for j in range(task.roots.shape[2]))
    effort = ca.trace(inverse @ ca.DM(task.force_gramian) @ inverse.T)
    outputs = [work, effort, inverse, ca.sumsqr(shapes[:n, :])]
    return ca.Function("work", [x], outputs, ["positions"], ["work", "effort", "inverse", "size"])


def _spline(task: PlacementTask) -> tuple[list[list[float]], ca.DM]:
    """Knots along each coordinate, and coefficients in CasADi's order: modes first, then x, then y."""
    modes, domain = task.modes, task.modes.domain
    if isinstance(domain, Rectangle):
        waves = np.sqrt(modes.n_modes) * np.array(domain.length) / np.sqrt(np.prod(domain.length))
        per_wave, added = SPLINE_POINTS["side"]
        grids = [
            np.linspace(low, high, round(per_wave * n) + added)
            for low, high, n in zip(*reach(domain, task.actuator.at), waves, strict=True)
        ]
        values = task.shapes(np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1))
        along_x = make_interp_spline(grids[0], values, k=SPLINE_DEGREE, axis=0)
        along_y = make_interp_spline(grids[1], along_x.c, k=SPLINE_DEGREE, axis=1)
        knots = [list(along_x.t), list(along_y.t)]
        # SciPy puts the axis of the last interpolation first: y, then x, then the modes
        return knots, ca.DM(along_y.c.ravel())
    per_mode, added = SPLINE_POINTS["interval"]
    grid = np.linspace(*task.reach, per_mode * modes.n_modes + added)
    spline = make_interp_spline(grid, task.shapes(grid), k=SPLINE_DEGREE)
    return [list(spline.t)], ca.DM(spline.c.ravel())


def _solver(task: PlacementTask, limits: Limits) -> Solver:
    """IPOPT on the task: (start, box of each actuator, factor of the peak force limit) → (positions, status)."""
    n, domain = task.n_controlled, task.modes.domain
    sides = np.atleast_1d(np.asarray(domain.length, float))  # type: ignore[union-attr]
    units = np.tile(sides, n)
    function = symbolic_work(task)

    # variables: positions in units of the sides
    z = ca.MX.sym("z", units.size)
    work, effort, inverse, size = function(ca.DM(units) * z)

    # objective and constraints, each of order one; those without a limit are left out
    scale = _typical_work(task)
    bounded = [effort / float(limits.effort)] if np.isfinite(limits.effort) else []
    is_force = [False] * len(bounded)
    if np.isfinite(limits.peak_force):
        forces = ca.reshape(inverse @ ca.DM(_extreme_instants(task.forces)), -1, 1) / float(limits.peak_force)
        bounded += [forces, -forces]
        is_force += [True] * (2 * forces.shape[0])
    if np.isfinite(limits.condition):
        bounded.append(ca.sumsqr(inverse) * size / float(limits.condition) ** 2)
        is_force.append(False)
    limited = ca.vertcat(*bounded) if bounded else ca.MX(0, 1)
    gaps, least_gap = _gaps(z, sides, limits.spacing)
    problem: dict[str, ca.MX] = {"x": z, "f": ca.log(work / scale + 1e-300), "g": ca.vertcat(limited, gaps)}
    options: dict[str, Any] = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", **IPOPT}
    solver = ca.nlpsol("placement", "ipopt", problem, options)
    count, n_gaps = len(is_force), gaps.shape[0]

    def solve(guess: np.ndarray, homes: Sequence[Box], share: float) -> tuple[np.ndarray, str]:
        low, high = (
            np.clip(np.concatenate([home[i] for home in homes]) / units, OFF_ENDS, 1.0 - OFF_ENDS) for i in (0, 1)
        )
        result = solver(
            x0=np.clip(np.ravel(guess) / units, low, high),
            lbx=low,
            ubx=high,
            lbg=np.r_[np.full(count, -np.inf), np.full(n_gaps, least_gap)],
            ubg=np.r_[np.where(is_force, share, 1.0), np.full(n_gaps, np.inf)],
        )
        # IPOPT may exceed its bounds by 1e-8 of their size
        positions = units * np.clip(result["x"].full().ravel(), low, high)
        status = str(solver.stats()["return_status"])
        return positions.reshape(n, sides.size), IPOPT_SAYS.get(status, status.replace("_", " ").lower())

    return solve


def _gaps(z: ca.MX, sides: np.ndarray, spacing: float) -> tuple[ca.MX, float]:
    """The constraint of spacing: expressions, and their least value.

    Along an interval these are distances of neighbours over the length; else squared distances over spacing², of pairs.

    Args:
        z: coordinates of the actuators, one after another, in units of the sides.
    """
    if sides.size == 1:
        return ca.reshape(z[1:] - z[:-1], -1, 1) if z.shape[0] > 1 else ca.MX(0, 1), spacing / sides[0]
    at = ca.reshape(z, sides.size, -1)
    pairs = combinations(range(at.shape[1]), 2) if spacing > 0 else ()
    squares = [ca.sumsqr((at[:, i] - at[:, j]) * ca.DM(sides / spacing)) for i, j in pairs]
    return ca.vertcat(*squares) if squares else ca.MX(0, 1), 1.0


def _typical_work(task: PlacementTask) -> float:
    """W_R that scales the objective: of evenly spaced places along an interval, or the median of random ones."""
    domain = task.modes.domain
    if isinstance(domain, Interval):
        places = _evenly_spaced(task)[None]
    else:
        low, high = reach(domain, task.actuator.at)  # type: ignore[arg-type]
        places = low + (high - low) * np.random.default_rng(0).random((101, task.n_controlled, 2))
    work = batch_costs(task, task.shapes(places)).work
    reference = float(np.median(work[np.isfinite(work)])) if np.isfinite(work).any() else 0.0
    return reference if reference > 0 else 1.0


def _extreme_instants(forces: np.ndarray) -> np.ndarray:
    """The forces at instants that can be the peak of a combination B⁻¹f: the hull of ±f, found by random directions.

    Args:
        forces: (n, n_instants).
    """
    directions = np.random.default_rng(0).standard_normal((DIRECTIONS * forces.shape[0], forces.shape[0]))
    return forces[:, np.unique(np.abs(directions @ forces).argmax(axis=1))]
