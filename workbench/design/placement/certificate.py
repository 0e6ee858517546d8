"""How far an optimum of placement can be from the best there is: branch and bound over all places.

On a cell of places about x, h to each side, s = √W_R = ‖Y‖/√2 with Y_r = φ_rᵀ B⁻¹ T_r. A norm is convex and Y
is linear but for a remainder, so

    s(x + δ) >= s(x) - Σ_i |∂s/∂x_i| h - R(h),

R bounded by Neumann's series of B⁻¹ about x and the largest slopes and curvatures of the shapes. Effort, peak force and
condition of B are bounded likewise. Cells that break a limit or cannot beat the optimum are dropped, the others halved.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from workbench.design.laws.law import DesignError
from workbench.design.placement.limits import Limits
from workbench.design.placement.scan import scan
from workbench.design.placement.task import SINGULAR_SHARE, Placement, PlacementTask
from workbench.structure.modes import frozen
from workbench.threads import one_blas_thread

MOST_ACTUATORS = 4
BATCH = 4_000
TRIED = 50
INSTANTS = 48


@dataclass(frozen=True, eq=False)
class Certificate:
    """What is proven of a placement.

    Attributes:
        placement: that was put to the test.
        lower_bound: no placement under the limits has a smaller W_R.
        cells: examined.
        complete: whether the search ended; if not, the bound holds none the less.
        better: (n_actuators,) places met on the way that beat the placement by more than the gap; None where none do.
    """

    placement: Placement
    lower_bound: float
    cells: int
    complete: bool
    better: np.ndarray | None = None

    @property
    def gap(self) -> float:
        """By what share W_R could at most be lower."""
        return 1.0 - self.lower_bound / self.placement.residual_work


@one_blas_thread
def certify(
    task: PlacementTask,
    placement: Placement,
    *,
    effort_limit: float = np.inf,
    spacing: float = 0.0,
    margin: float = 0.0,
    peak_limit: float = np.inf,
    condition_limit: float = np.inf,
    forbidden: Iterable[tuple[float, float]] = (),
    candidates: ArrayLike | None = None,
    gap: float = 0.01,
    most_cells: int = 20_000_000,
) -> Certificate:
    """Show that no placement under the limits beats this one by more than a gap.

    Args:
        placement: from `place` or `scan` under the same limits.
        effort_limit, peak_limit, condition_limit, spacing, margin, forbidden: see `Limits`.
        candidates: (n_candidates,) the only places there are, m: every choice of them is looked at.
        gap: share of W_R to be proven.
        most_cells: after which the search stops with the bound reached.

    Raises:
        DesignError: more than four actuators, or none of the limits that keep B from being singular.
    """
    limits = Limits(effort_limit, peak_limit, condition_limit, spacing, margin, tuple(forbidden))
    n, length = task.n_controlled, task.modes.length
    if candidates is not None:
        best, tried = scan(
            task,
            effort_limit=effort_limit,
            spacing=spacing,
            margin=margin,
            peak_limit=peak_limit,
            condition_limit=condition_limit,
            forbidden=limits.forbidden,
            candidates=candidates,
        )
        found = best.positions if best.residual_work < placement.residual_work * (1.0 - gap) else None
        return Certificate(placement, min(best.residual_work, placement.residual_work), tried, True, found)
    if n > MOST_ACTUATORS:
        raise DesignError(f"a certificate is to be had up to {MOST_ACTUATORS} actuators; there are {n}")
    if not np.isfinite([effort_limit, peak_limit, condition_limit]).any():
        raise DesignError(
            "without a limit B may come as near to singular as it likes; give one of effort, peak force or condition"
        )
    stretches = np.array(limits.room(n, length))
    bounds = _Bounds(task, limits)
    wanted = np.sqrt(placement.residual_work * (1.0 - gap))
    half = 0.5 * (length - 2 * margin) / 8
    axis = margin + half * (2 * np.arange(8) + 1)
    centres = np.stack(np.meshgrid(*[axis] * n, indexing="ij"), -1).reshape(-1, n)
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * n, indexing="ij")).reshape(n, -1).T
    cells, least, complete = 0, np.inf, True
    # depth first: a stack of batches keeps the memory small
    stack = [(half, batch) for batch in np.array_split(centres, max(1, len(centres) // BATCH))]
    while stack:
        half, centres = stack.pop()
        # in order, no closer than the spacing anywhere in the cell, and each interval with a place to stand
        centres = centres[(np.diff(centres, axis=1) + 2 * half >= spacing).all(axis=1)]
        centres = centres[_within(centres, stretches, half)]
        if not len(centres):
            continue
        cells += len(centres)
        lower, possible, work = bounds(centres, half)
        for i in np.argsort(work)[:TRIED]:
            if not work[i] < wanted:
                break
            rival = task.placed(centres[i], "")
            if _within(centres[i][None], stretches)[0] and limits.kept(rival):
                return Certificate(placement, 0.0, cells, False, frozen(centres[i]))
        open_ = possible & (lower < wanted)
        if cells > most_cells:
            least, complete = min([least, *lower[open_]]), False
            continue
        children = (centres[open_][:, None, :] + half * corners).reshape(-1, n)
        stack += [
            (0.5 * half, batch) for batch in np.array_split(children, max(1, len(children) // BATCH)) if len(batch)
        ]
    return Certificate(placement, float(min(least, wanted) ** 2), cells, complete)


def _within(centres: np.ndarray, stretches: np.ndarray, half: float = 0.0) -> np.ndarray:
    """Of cells (n_cells, n): whether every actuator may stand somewhere in its interval."""
    low, high = stretches.T
    return ((centres[..., None] + half >= low) & (centres[..., None] - half <= high)).any(axis=2).all(axis=1)


class _Bounds:
    """On cells: lower bounds of √W_R, whether any place may keep the limits, and √W_R in the middle where that may."""

    def __init__(self, task: PlacementTask, limits: Limits) -> None:
        self._task, self._limits = task, limits
        n, modes = task.n_controlled, task.modes
        grid = np.linspace(0.0, modes.length, 400 + 40 * modes.n_modes)
        step = grid[1] - grid[0]
        first, second, third = (np.abs(modes.phi(grid, d)) for d in (1, 2, 3))
        # largest anywhere: on the grid, and by the next derivative between its points
        self._curvature = (second.max(0) + 0.5 * step * third.max(0))[n:]
        self._column_slope = _largest_row(first[:, :n]) + 0.5 * step * np.linalg.norm(second[:, :n].max(0))
        self._column_curvature = _largest_row(second[:, :n]) + 0.5 * step * np.linalg.norm(third[:, :n].max(0))
        # what is limited, as tr(B⁻¹ G B⁻ᵀ) <= L²: the effort; n times the square of the peak, above any mean of the
        # forces' squares; and the condition, L = limit / ‖B‖
        self._forces = task.forces[:, :: max(1, task.forces.shape[1] // INSTANTS)]
        squares = []
        if np.isfinite(limits.effort):
            squares.append((task.force_gramian, np.sqrt(limits.effort)))
        if np.isfinite(limits.peak_force):
            weight = 1.0 / np.maximum((self._forces**2).sum(axis=0), 1e-12 * (self._forces**2).sum(axis=0).max())
            spread = (self._forces * weight / weight.sum()) @ self._forces.T
            squares.append((spread, np.sqrt(n) * limits.peak_force))
        if np.isfinite(limits.condition):
            squares.append((np.eye(n), np.inf))
        self._squares = []
        for matrix, limit in squares:
            values, vectors = np.linalg.eigh(matrix)
            unscale = vectors / np.sqrt(np.maximum(values, 1e-300))
            slope = _largest_row(modes.phi(grid, 1)[:, :n] @ unscale)
            slope += 0.5 * step * _largest_row(modes.phi(grid, 2)[:, :n] @ unscale)
            self._squares.append((vectors * np.sqrt(np.maximum(values, 0.0)), unscale, slope, limit))

    def __call__(self, centres: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n, root_n = self._task.n_controlled, np.sqrt(self._task.n_controlled)
        shapes = self._task.shapes(centres)
        # no place in the cell has a ‖B‖ below this
        frame = np.maximum(np.linalg.norm(shapes[:, :, :n], axis=(1, 2)) - root_n * self._column_slope * half, 0.0)
        limits = [np.full(len(centres), limit) for *_, limit in self._squares]
        if np.isfinite(self._limits.condition):
            with np.errstate(divide="ignore"):
                limits[-1] = self._limits.condition / frame
        possible = np.ones(len(centres), bool)
        for (_, unscale, slope, _), limit in zip(self._squares, limits):
            # tr(B⁻¹ G B⁻ᵀ) = Σ 1/σ_i², σ of G^-½ B, and singular values move no further than the matrix does
            sigma = np.linalg.svd(shapes[:, :, :n] @ unscale, compute_uv=False) + root_n * slope * half
            possible &= np.sqrt((sigma**-2.0).sum(axis=1)) <= limit
        lower, reached = np.zeros(len(centres)), np.full(len(centres), np.inf)
        b = shapes[:, :, :n].transpose(0, 2, 1)
        # about a singular B nothing is known but that the work is not negative
        regular = np.abs(np.linalg.det(b)) > SINGULAR_SHARE * np.linalg.norm(b, axis=2).prod(axis=1)
        known = np.flatnonzero(possible & regular)
        if not known.size:
            return lower, possible, reached
        shapes, slopes, b = shapes[known], self._task.shapes(centres[known], 1), b[known]
        inverse = np.linalg.inv(b)
        size = np.linalg.norm(inverse, axis=(1, 2), ord=2)
        columns = inverse @ slopes[:, :, :n].transpose(0, 2, 1)  # B⁻¹ φ'(x_i), one column an actuator
        # B(x + δ)⁻¹ = (I + E)⁻¹ B⁻¹, E = B⁻¹ ΔB: its part linear in δ, and what the curvature adds
        curved = 0.5 * size * self._column_curvature * root_n * half**2
        theta = half * np.linalg.norm(columns, axis=(1, 2)) + curved
        with np.errstate(divide="ignore", invalid="ignore"):
            neumann = np.where(theta < 1, theta / (1 - theta), np.inf)
        remainder = theta * neumann + curved

        kept = np.ones(known.size, bool)
        for (root, *_), limit in zip(self._squares, limits):
            weighed = inverse @ root
            energy = np.linalg.norm(weighed, axis=(1, 2))
            gradient = np.einsum("pij,pji->pi", weighed @ weighed.transpose(0, 2, 1), columns) / energy[:, None]
            kept &= ~(energy * (1 - remainder) - half * np.abs(gradient).sum(axis=1) > limit[known])
        if np.isfinite(self._limits.peak_force):
            forces = inverse @ self._forces
            moved = half * np.abs(columns) @ np.abs(forces)
            rest = np.linalg.norm(forces, axis=1) * remainder[:, None]
            kept &= ~((np.abs(forces) - moved - rest[:, None]).max(axis=(1, 2)) > self._limits.peak_force)
        possible[known] = kept

        force = np.einsum("pij,rjk->prik", inverse, self._task.roots, optimize=True)
        high, high_slopes = shapes[:, :, n:].transpose(0, 2, 1), slopes[:, :, n:].transpose(0, 2, 1)
        y = np.einsum("pri,prik->prk", high, force)
        work = np.sqrt(0.5 * (y**2).sum(axis=(1, 2)))
        relative = high_slopes - (high @ inverse) @ slopes[:, :, :n].transpose(0, 2, 1)
        gradient = 0.5 * np.einsum("prk,prik,pri->pi", y, force, relative, optimize=True) / work[:, None]
        strength = np.linalg.norm(force, axis=(2, 3))
        bent = 0.5 * root_n * half**2 * self._curvature
        with np.errstate(invalid="ignore", over="ignore"):
            rest = strength * (
                np.linalg.norm(high, axis=2) * remainder[:, None]
                + (half * np.linalg.norm(high_slopes, axis=2) + bent) * neumann[:, None]
                + bent
            )
            rest = np.sqrt(0.5 * (rest**2).sum(axis=1))
            least_work = work - half * np.abs(gradient).sum(axis=1) - rest
        lower[known] = np.nan_to_num(np.maximum(least_work, 0.0), nan=0.0)
        reached[known] = np.where(kept, work, np.inf)
        return lower, possible, reached


def _largest_row(rows: np.ndarray) -> float:
    return float(np.linalg.norm(rows, axis=1).max())
