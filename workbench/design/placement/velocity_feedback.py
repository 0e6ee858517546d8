"""Placement of collocated pairs of actuator and rate sensor for direct velocity feedback, with a proof of optimality.

The force u = -H y is fed back from the rates y = Bᵀ q' of the pairs, so that the damping of the modes is
C(x) = C + B(x) H B(x)ᵀ. From an initial state x_0, E(x) = ∫ Σ (q_r'² + ω_r² q_r²) dt = x_0ᵀ P x_0, Aᵀ P + P A = -Q.

A lower bound on a cell of places: for S = P_0 + Σ_j δ_j P_j - η P_0, with P_j the derivatives of P at the centre,
A(x)ᵀ S + S A(x) + Q is η Q plus terms of second order in δ; if it is positive semidefinite, E(x) >= x_0ᵀ S x_0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from workbench.arrays import Floats
from workbench.design.laws.law import DesignError
from workbench.design.placement.task import participation_along, reach_along
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes, freeze, frozen
from workbench.structure.printed import Printed

GRID = 4_001  # places at which derivatives of the participation are evaluated
BATCH = 2_000  # cells bounded at once
MOST_CELLS = 2_000_000  # after which the proof stops with the bound reached
TOLERANCE = 1e-9  # of the length: tolerance of the spacing


@dataclass(frozen=True, eq=False)
class FeedbackTask:
    """The task of placing pairs of actuator and rate sensor along a structure.

    Attributes:
        modes: all of them controlled, with their damping.
        actuator: of a pair; its own place and name do not matter.
        gain: (n_pairs, n_pairs) H, force per rate; it adds no negative damping if its symmetric part is
            positive definite.
        state: (2 n_modes,) x_0.
        spacing: least distance between the middles of neighbours, m.
    """

    modes: Modes
    actuator: Actuator
    gain: np.ndarray
    state: np.ndarray
    spacing: float

    def __post_init__(self) -> None:
        freeze(self, "gain", "state")
        gain, state, n = self.gain.shape, self.state.shape, self.modes.n_modes
        if len(gain) != 2 or gain[0] != gain[1]:
            raise DesignError(f"the feedback gain must be square, one row per pair; got shape {gain}")
        if state != (2 * n,):
            raise DesignError(f"the state has {2 * n} entries for {n} modes; got {state}")
        if not (self.modes.omega > 0).all():
            raise DesignError("a rigid-body mode keeps its displacement under rate feedback; select the elastic modes")
        first, last = self.reach
        if first + (self.n_pairs - 1) * self.spacing > last:
            raise DesignError(
                f"{self.n_pairs} pairs {self.spacing:g} m apart do not fit on {self.modes.length:g} m;"
                " lower the spacing"
            )

    @property
    def n_pairs(self) -> int:
        return len(self.gain)

    @property
    def reach(self) -> tuple[float, float]:
        """Range of the middle of a pair, (from, to) m."""
        return reach_along(self.modes, self.actuator)

    @cached_property
    def _derivatives(self) -> tuple[Floats, Floats, Floats]:
        """Places (n,), and of the participation of a pair there: the largest second derivative (n_modes,), and the
        cumulative sum of the jumps of its slope (n, n_modes)."""
        grid = np.linspace(*self.reach, GRID)
        slope, curvature = (participation_along(self.modes, self.actuator, grid, order) for order in (1, 2))
        varied, half_step = np.abs(np.diff(curvature, axis=0)), 0.5 * (grid[1] - grid[0])
        jumps = np.abs(np.diff(slope, axis=0) - half_step * (curvature[:-1] + curvature[1:])) + half_step * varied
        total_jumps = np.concatenate([np.zeros((1, self.modes.n_modes)), np.cumsum(jumps, axis=0)])
        return grid, np.abs(curvature).max(axis=0) + varied.max(axis=0), total_jumps

    def tangent_error(self, centres: Floats, halves: Floats) -> Floats:
        """Largest difference (..., n_modes) of the participation from its tangent at `centres` (...,), m.

        It bounds the difference within `halves` (...,) m, with the jumps of a patch's slope at steps of the stiffness.
        """
        grid, curvature, total_jumps = self._derivatives
        first, last = grid.searchsorted(centres - halves, "right"), grid.searchsorted(centres + halves)
        jumps = total_jumps[np.minimum(last, grid.size - 1)] - total_jumps[np.maximum(first - 1, 0)]
        return halves[..., None] * (0.5 * halves[..., None] * curvature + jumps)

    def index(self, positions: ArrayLike) -> np.ndarray:
        """E (...) of pairs at the places (..., n_pairs), m; inf where the loop is unstable."""
        places = np.asarray(positions, float)
        shape = places.shape[:-1]
        expansions = _Expansion(self, places.reshape(-1, self.n_pairs))
        return np.where(expansions.stable, expansions.index, np.inf).reshape(shape)


@dataclass(frozen=True, eq=False, repr=False)
class FeedbackPlacement(Printed):
    """Pairs placed for direct velocity feedback, with a proven bound of their performance index E.

    Attributes:
        positions: (n_pairs,) of the middles, m, in the order of the gain.
        index: E.
        lower_bound: of E over all placements.
        cells: number examined for the proof.
    """

    positions: np.ndarray
    index: float
    lower_bound: float
    cells: int

    @property
    def gap(self) -> float:
        """Optimality gap: the largest share of E by which another placement may be better."""
        return 1.0 - self.lower_bound / self.index

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line = f"{self.positions.size} collocated pair(s): E = {self.index:.6g}"
        rows = [(str(i + 1), f"{x:.5g}") for i, x in enumerate(self.positions)]
        remark = f"no placement is better by more than {self.gap:.2%} ({self.cells} cells)"
        return line, ("pair", "x [m]"), rows, (remark,)


def place_pairs(task: FeedbackTask, *, gap: float = 0.01, starts: int = 12, seed: int = 0) -> FeedbackPlacement:
    """The pairs, in order along the structure, of least E, by SLSQP from many starts, with a proof by branch and bound.

    Args:
        task: the pairs to place.
        gap: share of E to be proven.
        starts: number of random starts.
        seed: of the starts.

    Raises:
        DesignError: no start ended at a stable loop, or branch and bound met a better placement.
    """
    n, (first, last) = task.n_pairs, task.reach
    rng = np.random.default_rng(seed)
    free = last - first - (n - 1) * task.spacing
    spaced = [{"type": "ineq", "fun": lambda x: np.diff(x) - task.spacing}] if n > 1 else []
    best, least = None, np.inf
    for _ in range(starts):
        start = first + np.sort(rng.uniform(0.0, free, n)) + task.spacing * np.arange(n)
        settings = {"bounds": [(first, last)] * n, "constraints": spaced, "options": {"ftol": 1e-12}}
        result = minimize(lambda x: float(task.index(x)), start, method="SLSQP", **settings)
        feasible = n == 1 or np.diff(result.x).min() >= task.spacing - TOLERANCE * task.modes.length
        if feasible and result.fun < least:
            best, least = result.x, float(result.fun)
    if best is None:
        raise DesignError("no places of these pairs make a stable loop; change the gain")
    bound, cells, better = _proven(task, least * (1.0 - gap))
    if better is not None:
        raise DesignError(f"the search missed a better placement, pairs at {better}; take more starts")
    return FeedbackPlacement(frozen(best), least, bound, cells)


def _proven(task: FeedbackTask, wanted: float) -> tuple[float, int, np.ndarray | None]:
    """A lower bound of E, at most `wanted`, the number of cells examined, and places with a lower E if any are met."""
    n, (first, last) = task.n_pairs, task.reach
    half = np.full(n, (last - first) / 16)
    axis = first + half[0] * (2 * np.arange(8) + 1)
    cells = np.array(list(combinations_with_replacement(axis, n)))
    halves = np.broadcast_to(half, cells.shape).copy()
    count, bound = 0, np.inf
    while len(cells):
        feasible = (np.diff(cells, axis=1) + halves[:, 1:] + halves[:, :-1] >= task.spacing).all(axis=1)
        cells, halves = cells[feasible], halves[feasible]
        parts = max(1, len(cells) // BATCH)
        bounds = []
        for centre, h in zip(np.array_split(cells, parts), np.array_split(halves, parts)):
            expansion = _Expansion(task, centre)
            bounds.append((*expansion.lower(h), np.where(expansion.stable, expansion.index, np.inf)))
        count += len(cells)
        lower, weight, index = (np.concatenate(part) for part in zip(*bounds))
        spaced = (np.diff(cells, axis=1) >= task.spacing).all(axis=1)
        below = np.flatnonzero(spaced & (index < wanted))
        if below.size:
            return 0.0, count, cells[below[0]]
        open_ = lower < wanted
        if count > MOST_CELLS:
            bound = min(bound, float(lower[open_].min(initial=np.inf)))
            break
        # halve the axis along which the bound is loosest
        cells, halves, widest = cells[open_], halves[open_].copy(), weight[open_].argmax(axis=1)
        each = np.arange(len(cells))
        halves[each, widest] *= 0.5
        step = np.zeros_like(cells)
        step[each, widest] = halves[each, widest]
        cells, halves = np.concatenate([cells - step, cells + step]), np.concatenate([halves, halves])
    return max(0.0, min(bound, wanted)), count, None


class _Expansion:
    """E and its derivatives at centres (n_cells, n_pairs), by Lyapunov equations solved together."""

    def __init__(self, task: FeedbackTask, centres: np.ndarray) -> None:
        self._task, self._centres = task, centres
        modes, h = task.modes, task.gain
        n = modes.n_modes
        b, slope = (participation_along(modes, task.actuator, centres, derivative) for derivative in (0, 1))
        self._b, self._slope = b, slope
        damping = modes.damping + np.einsum("ij,pir,pjs->prs", h, b, b)
        # states ω q and q', so that Q is the identity
        omega = np.diag(modes.omega)
        a = np.zeros((len(centres), 2 * n, 2 * n))
        a[:, :n, n:], a[:, n:, :n], a[:, n:, n:] = omega, -omega, -damping
        self.stable = np.linalg.eigvals(a).real.max(axis=1) < 0
        eye = np.eye(2 * n)
        # P → Aᵀ P + P A as a matrix on the 4n² entries of P
        self._operator = (np.einsum("pki,jl->pijkl", a, eye) + np.einsum("plj,ik->pijkl", a, eye)).reshape(
            len(centres), 4 * n * n, 4 * n * n
        )
        self._start = np.r_[modes.omega * task.state[:n], task.state[n:]]
        self._p = self._solved(np.broadcast_to(-eye, a.shape)[:, None])[:, 0]
        self.index = np.einsum("i,pij,j->p", self._start, self._p, self._start)

    def _solved(self, right: np.ndarray) -> np.ndarray:
        """P (n_cells, n_right, 2n, 2n) with Aᵀ P + P A = right."""
        count, n_right, size, _ = right.shape
        flat = right.reshape(count, n_right, size * size).transpose(0, 2, 1)
        return np.linalg.solve(self._operator, flat).transpose(0, 2, 1).reshape(right.shape)

    def lower(self, halves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower bounds of E (n_cells,) on cells of half-widths (n_cells, n_pairs), and their looseness by axis."""
        task, n = self._task, self._task.modes.n_modes
        gain, b, slope = task.gain, self._b, self._slope
        # A depends on the place of pair j through C: ∂C/∂x_j
        each = np.einsum("jk,pjr,pks->pjrs", gain, slope, b) + np.einsum("kj,pkr,pjs->pjrs", gain, b, slope)
        first = np.einsum("pai,pjis->pjas", self._p[:, :, n:], each)
        right = np.zeros((*first.shape[:2], 2 * n, 2 * n))
        right[..., n:] = first
        right = right + right.swapaxes(2, 3)
        derivatives = self._solved(right)
        gradient = np.einsum("i,pjik,k->pj", self._start, derivatives, self._start)
        error = task.tangent_error(self._centres, halves)
        moved = np.abs(slope) * halves[:, :, None] + error
        size, strength = np.abs(b), np.abs(gain)

        def products(one: Floats, other: Floats) -> Floats:
            return np.asarray(np.einsum("ij,pir,pjs->prs", strength, one, other))

        second = products(error, size) + products(size, error) + products(moved, moved)
        change = products(moved, size) + products(size, moved) + products(moved, moved)

        def norm(p: Floats, c: Floats) -> Floats:
            """Upper bound of the norm of ΔAᵀ P + P ΔA for |ΔC| <= c."""
            size: Floats = np.linalg.norm(np.abs(p[..., n:]) @ c, axis=(-2, -1))
            return 2.0 * size

        by_axis = halves * norm(derivatives, change[:, None])
        rest = norm(self._p, second) + by_axis.sum(axis=1)
        share = norm(self._p, change)
        with np.errstate(divide="ignore", invalid="ignore"):
            eta = np.where(share < 1.0, rest / (1.0 - share), np.inf)
            lower = self.index * (1.0 - eta) - (np.abs(gradient) * halves).sum(axis=1)
        lower = np.where(self.stable & np.isfinite(lower), np.maximum(lower, 0.0), 0.0)
        loose = self.index[:, None] * (by_axis + moved.max(axis=2) / np.maximum(size.max(axis=(1, 2)), 1e-300)[:, None])
        return lower, np.abs(gradient) * halves + np.maximum(loose, 1e-12 * halves)
