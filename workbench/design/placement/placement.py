"""Where actuators should stand: the nodes of mode n+1, and CasADi against the spillover work W_R.

W_R alone has no useful minimum: the optimiser drives the outer actuators onto the supports, where B is singular and the
forces grow without bound. So a placement here is sought under limits on what the actuators must do.
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
PEAK_ROUNDS = 4
DRAWN = 4000  # random placements on a surface, of which the best are starts
MOVES = 4  # of actuators from box to box around forbidden zones
SAME = 1e-4  # of the size: optima that are one
INSIDE = 0.02  # of the length: random starts keep so far from the ends of their reach
POINTS = 40  # a half wave, where nodes are bracketed
SPLINE_POINTS = {"interval": (15, 120), "side": (10, 30)}  # a mode or half wave, and besides: of the shapes' splines
DIRECTIONS = 400  # a force, by which the instants of its peaks are chosen
IPOPT = {"ipopt.max_iter": 200, "ipopt.tol": 1e-9}
IPOPT_SAYS = {
    "Solve_Succeeded": "converged",
    "Solved_To_Acceptable_Level": "converged, to IPOPT's acceptable tolerance",
}
OFF_ENDS = 1e-3  # of a side: IPOPT's places keep so far inside
ON_EDGE = 1e-6  # of a side: so near, an actuator stands on the edge of its box


def nodes_of_mode(modes: Modes, mode: int) -> np.ndarray:
    """Interior nodes (n_nodes,) of a mode (zero-based), m: zeros of its shape away from the held ends (5.6).

    Raises:
        DesignError: a mode that is not at hand.
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
    """The law with its actuators at the places of least spillover work W_R, by CasADi and IPOPT from many starts.

    Where the limits name candidate places, and at named points, every choice of these is evaluated instead; where they
    are too many, one is exchanged for another until that helps no more, and `certify` says how far it is from the best.

    Args:
        task: from `placement_task`.
        limits: to keep.
        starts: random starts besides the evenly spaced places and the nodes of mode n+1; on a surface the best of many
            random placements.
        seed: of the random starts.

    Raises:
        DesignError: limits that no start can meet, with the one that conflicts.
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
    status = "no start ended inside the limits"
    for guess in guesses:
        # each actuator keeps to the box nearest its start, and then goes to one that it leads to
        homes = [min(boxes, key=partial(_apart, x)) for x in guess]
        positions, message, found = _solved(task, limits, solver, guess, homes)
        for _ in range(MOVES if len(boxes) > 1 and isinstance(domain, Rectangle) else 0):
            moved = _next_homes(positions, homes, boxes, size)
            if moved is None:
                break
            homes = moved
            beyond = _solved(task, limits, solver, positions, homes)
            if not (limits.satisfied_by(beyond[2]) and beyond[2].residual_work < found.residual_work):
                break
            positions, message, found = beyond
        if not np.isfinite(found.residual_work) or not limits.satisfied_by(found):
            continue
        positions = found.positions
        if not any(np.abs(positions - p).max() < SAME * size for p, _ in optima):
            if found.residual_work <= min((work for _, work in optima), default=np.inf):
                status = message
            optima.append((positions, found.residual_work))
    if not optima:
        raise DesignError(conflict(task, limits))
    optima.sort(key=lambda optimum: optimum[1])
    return task.placed(optima[0][0], status, optima)


def _guesses(
    task: PlacementTask, limits: Limits, boxes: Sequence[Box], starts: int, rng: np.random.Generator
) -> list[np.ndarray]:
    """Where to start from, (n_actuators, n_coordinates) m each: even places, nodes and random ones along an interval;
    the best of many random ones on a surface."""
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
    length, (first, last) = domain.length, task.reach
    margin = max(limits.edge_distance, first)
    guesses = [first + (last - first) * (np.arange(n) + 1) / (n + 1)]
    nodes = nodes_of_mode(task.modes, n)
    if nodes.size == n:
        guesses.append(np.sort(nodes))
    guesses += [
        np.sort(rng.uniform(margin + INSIDE * length, length - margin - INSIDE * length, n)) for _ in range(starts)
    ]
    return [guess[:, None] for guess in guesses]


def _solved(
    task: PlacementTask, limits: Limits, solver: Solver, guess: np.ndarray, homes: Sequence[Box]
) -> tuple[np.ndarray, str, Placement]:
    """IPOPT from a guess, its sampled forces held lower by what the peak rises between the samples."""
    share = 1.0
    for _ in range(PEAK_ROUNDS):
        positions, message = solver(guess, homes, share)
        alone = isinstance(task.modes.domain, Interval)
        found = task.placed(positions[:, 0] if alone else _in_order(positions), message)
        if not limits.peak_force < found.peak_force < np.inf:
            break
        guess, share = positions, share * limits.peak_force / found.peak_force
    return positions, message, found


def _in_order(pairs: np.ndarray) -> np.ndarray:
    """Actuators are alike: those on a surface from left to right."""
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _apart(at: np.ndarray, box: Box) -> float:
    return float(np.maximum(np.maximum(box[0] - at, at - box[1]), 0.0).max())


def _next_homes(positions: np.ndarray, homes: Sequence[Box], boxes: Sequence[Box], size: float) -> list[Box] | None:
    """The homes with those on whose edge an actuator came to stand left for another that holds it; None where none."""

    def room(at: np.ndarray, box: Box) -> float:
        return float(np.minimum(at - box[0], box[1] - at).min())

    found = []
    for at, home in zip(positions, homes, strict=True):
        widest = max(boxes, key=partial(room, at))
        at_edge = room(at, home) < ON_EDGE * size
        found.append(widest if at_edge and room(at, widest) > ON_EDGE * size else home)
    changed = any(one is not other for one, other in zip(found, homes, strict=True))
    return found if changed else None


# --- CasADi


def symbolic_work(task: PlacementTask) -> ca.Function:
    """CasADi function positions -> (W_R, effort, B⁻¹, ‖B‖²), derivatives exact: shapes as splines of degree seven.

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
    """Knots along each coordinate, and coefficients as CasADi orders them: modes first, then x, then y."""
    modes, domain = task.modes, task.modes.domain
    if isinstance(domain, Rectangle):
        waves = np.sqrt(modes.n_modes) * np.array(domain.length) / np.sqrt(np.prod(domain.length))
        each, besides = SPLINE_POINTS["side"]
        grids = [
            np.linspace(low, high, round(each * n) + besides)
            for low, high, n in zip(*reach(domain, task.actuator.at), waves, strict=True)
        ]
        values = task.shapes(np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1))
        along_x = make_interp_spline(grids[0], values, k=SPLINE_DEGREE, axis=0)
        along_y = make_interp_spline(grids[1], along_x.c, k=SPLINE_DEGREE, axis=1)
        knots = [list(along_x.t), list(along_y.t)]
        # SciPy puts the axis of the last interpolation first: y, then x, then the modes
        return knots, ca.DM(along_y.c.ravel())
    each, besides = SPLINE_POINTS["interval"]
    grid = np.linspace(*task.reach, each * modes.n_modes + besides)
    spline = make_interp_spline(grid, task.shapes(grid), k=SPLINE_DEGREE)
    return [list(spline.t)], ca.DM(spline.c.ravel())


def _solver(task: PlacementTask, limits: Limits) -> Solver:
    n, domain = task.n_controlled, task.modes.domain
    sides = np.atleast_1d(np.asarray(domain.length, float))  # type: ignore[union-attr]
    units = np.tile(sides, n)
    function = symbolic_work(task)

    # variables: positions in units of the sides
    z = ca.MX.sym("z", units.size)
    work, effort, inverse, size = function(ca.DM(units) * z)

    # objective and constraints, each of order one; those without a limit are left out
    scale = _usual_work(task)
    bounded = [effort / float(limits.effort)] if np.isfinite(limits.effort) else []
    first_force = len(bounded)
    if np.isfinite(limits.peak_force):
        forces = ca.reshape(inverse @ ca.DM(_extreme_instants(task.forces)), -1, 1) / float(limits.peak_force)
        bounded += [forces, -forces]
    if np.isfinite(limits.condition):
        bounded.append(ca.sumsqr(inverse) * size / float(limits.condition) ** 2)
    limited = ca.vertcat(*bounded) if bounded else ca.MX(0, 1)
    gaps, least_gap = _gaps(z, sides, limits.spacing)
    problem: dict[str, ca.MX] = {"x": z, "f": ca.log(work / scale + 1e-300), "g": ca.vertcat(limited, gaps)}
    options: dict[str, Any] = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", **IPOPT}
    solver = ca.nlpsol("placement", "ipopt", problem, options)
    count, n_gaps = limited.shape[0], gaps.shape[0]
    n_forces = sum(part.shape[0] for part in bounded[first_force:]) - bool(np.isfinite(limits.condition))
    is_force = (np.arange(count) >= first_force) & (np.arange(count) < first_force + n_forces)

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
        # IPOPT keeps its bounds but for 1e-8 of their size
        found = units * np.clip(result["x"].full().ravel(), low, high)
        status = str(solver.stats()["return_status"])
        return found.reshape(n, sides.size), IPOPT_SAYS.get(status, status.replace("_", " ").lower())

    return solve


def _gaps(z: ca.MX, sides: np.ndarray, spacing: float) -> tuple[ca.MX, float]:
    """What must be at least the number beside it: distances over the length in order, or squared distances of any two.

    Args:
        z: coordinates of the actuators, one after another, in units of the sides.
    """
    if sides.size == 1:
        return ca.reshape(z[1:] - z[:-1], -1, 1) if z.shape[0] > 1 else ca.MX(0, 1), spacing / sides[0]
    at = ca.reshape(z, sides.size, -1)
    pairs = combinations(range(at.shape[1]), 2) if spacing > 0 else ()
    squares = [ca.sumsqr((at[:, i] - at[:, j]) * ca.DM(sides / spacing)) for i, j in pairs]
    return ca.vertcat(*squares) if squares else ca.MX(0, 1), 1.0


def _usual_work(task: PlacementTask) -> float:
    """W_R of even places along an interval, or the median of random ones on a surface: what is of order one."""
    domain = task.modes.domain
    if isinstance(domain, Interval):
        first, last = task.reach
        n = task.n_controlled
        places = (first + (last - first) * (np.arange(n) + 1) / (n + 1))[None]
    else:
        low, high = reach(domain, task.actuator.at)  # type: ignore[arg-type]
        places = low + (high - low) * np.random.default_rng(0).random((101, task.n_controlled, 2))
    work = batch_costs(task, task.shapes(places)).work
    reference = float(np.median(work[np.isfinite(work)])) if np.isfinite(work).any() else 0.0
    return reference if reference > 0 else 1.0


def _extreme_instants(forces: np.ndarray) -> np.ndarray:
    """The instants that can decide the peak of any combination B⁻¹f: those on the hull of ±f, as directions see it."""
    directions = np.random.default_rng(0).standard_normal((DIRECTIONS * forces.shape[0], forces.shape[0]))
    return forces[:, np.unique(np.abs(directions @ forces).argmax(axis=1))]
