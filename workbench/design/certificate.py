"""How far an optimum of placement can be from the best there is: branch and bound over all places.

On a cell of places about x, h to each side, s = √W_R = ‖Y‖/√2 with Y_r = φ_rᵀ B⁻¹ T_r. A norm is convex and Y
is linear but for a remainder, so

    s(x + δ) >= s(x) - Σ_i |∂s/∂x_i| h - R(h),

R bounded by Neumann's series of B⁻¹ about x and the largest slopes and curvatures of the shapes. The square root of the
effort is bounded likewise. Cells that break a limit or cannot beat the optimum are dropped, the others are halved.
"""

from dataclasses import dataclass

import numpy as np

from workbench.design.law import DesignError
from workbench.design.placement_task import SINGULAR_SHARE, Placement, PlacementTask
from workbench.structure.modes import frozen

MOST_ACTUATORS = 4
BATCH = 20_000


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


def certify(
    task: PlacementTask,
    placement: Placement,
    *,
    effort_limit: float,
    spacing: float = 0.0,
    margin: float = 0.0,
    gap: float = 0.01,
    most_cells: int = 20_000_000,
) -> Certificate:
    """Show that no placement under limits of effort, spacing and margin beats this one by more than a gap.

    Args:
        placement: from `place` under the same limits.
        gap: share of W_R to be proven.
        most_cells: after which the search stops with the bound reached.

    Raises:
        DesignError: more than four actuators, or no limit of effort.
    """
    n, length = task.n_controlled, task.modes.length
    if n > MOST_ACTUATORS:
        raise DesignError(f"a certificate is to be had up to {MOST_ACTUATORS} actuators; there are {n}")
    if not np.isfinite(effort_limit):
        raise DesignError("without a limit of effort B may come as near to singular as it likes; give one")
    bounds = _Bounds(task, effort_limit)
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
        # in order, and no closer than the spacing anywhere in the cell
        centres = centres[(np.diff(centres, axis=1) + 2 * half >= spacing).all(axis=1)]
        if not len(centres):
            continue
        cells += len(centres)
        lower, possible, work = bounds(centres, half)
        if np.min(work, initial=np.inf) < wanted and (np.diff(centres[work.argmin()]) >= spacing).all():
            return Certificate(placement, 0.0, cells, False, frozen(centres[work.argmin()]))
        open_ = possible & (lower < wanted)
        if cells > most_cells:
            least, complete = min([least, *lower[open_]]), False
            continue
        children = (centres[open_][:, None, :] + half * corners).reshape(-1, n)
        stack += [
            (0.5 * half, batch) for batch in np.array_split(children, max(1, len(children) // BATCH)) if len(batch)
        ]
    return Certificate(placement, float(min(least, wanted) ** 2), cells, complete)


class _Bounds:
    """On cells: lower bounds of √W_R, whether any place may keep the effort, and √W_R in the middle where that does."""

    def __init__(self, task: PlacementTask, effort_limit: float) -> None:
        self._task, self._limit = task, np.sqrt(effort_limit)
        n, modes = task.n_controlled, task.modes
        grid = np.linspace(0.0, modes.length, 400 + 40 * modes.n_modes)
        step = grid[1] - grid[0]
        first, second, third = (np.abs(modes.phi(grid, d)) for d in (1, 2, 3))
        # largest anywhere: on the grid, and by the next derivative between its points
        slopes, curvatures = first.max(0) + 0.5 * step * second.max(0), second.max(0) + 0.5 * step * third.max(0)
        self._slope, self._curvature = slopes[n:], curvatures[n:]
        self._column_slope = np.linalg.norm(first[:, :n], axis=1).max() + 0.5 * step * np.linalg.norm(
            second[:, :n].max(0)
        )
        self._column_curvature = np.linalg.norm(curvatures[:n])
        values, vectors = np.linalg.eigh(task.force_gramian)
        self._root = vectors * np.sqrt(np.maximum(values, 0.0))
        self._roots = task.roots
        inverse = vectors / np.sqrt(np.maximum(values, 1e-300))
        scaled = modes.phi(grid, 1)[:, :n] @ inverse, modes.phi(grid, 2)[:, :n] @ inverse
        self._scaled_slope = (
            np.linalg.norm(scaled[0], axis=1).max() + 0.5 * step * np.linalg.norm(scaled[1], axis=1).max()
        )
        self._unscale = inverse

    def __call__(self, centres: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n, root_n = self._task.n_controlled, np.sqrt(self._task.n_controlled)
        shapes = self._task.shapes(centres)
        # effort = Σ 1/σ_i², σ of G^-½ B, and singular values move no further than the matrix does
        sigma = np.linalg.svd(shapes[:, :, :n] @ self._unscale, compute_uv=False) + root_n * self._scaled_slope * half
        possible = (sigma**-2.0).sum(axis=1) <= self._limit**2
        lower, reached = np.zeros(len(centres)), np.full(len(centres), np.inf)
        if not possible.any():
            return lower, possible, reached
        shapes, slopes = shapes[possible], self._task.shapes(centres[possible], 1)
        b = shapes[:, :, :n].transpose(0, 2, 1)
        # about a singular B nothing is known but that the work is not negative
        regular = np.abs(np.linalg.det(b)) > SINGULAR_SHARE * np.linalg.norm(b, axis=2).prod(axis=1)
        known = np.flatnonzero(possible)[regular]
        if not known.size:
            return lower, possible, reached
        shapes, slopes, b = shapes[regular], slopes[regular], b[regular]
        inverse = np.linalg.inv(b)
        size = np.linalg.norm(inverse, axis=(1, 2), ord=2)
        theta = size * root_n * self._column_slope * half
        with np.errstate(divide="ignore", invalid="ignore"):
            neumann = np.where(theta < 1, theta / (1 - theta), np.inf)
        remainder = theta * neumann + 0.5 * size * self._column_curvature * root_n * half**2

        weighed = inverse @ self._root
        energy = np.linalg.norm(weighed, axis=(1, 2))
        columns = inverse @ slopes[:, :, :n].transpose(0, 2, 1)  # B⁻¹ φ'(x_i), one column an actuator
        gradient = -np.einsum("pij,pji->pi", weighed @ weighed.transpose(0, 2, 1), columns) / energy[:, None]
        least_effort = energy - half * np.abs(gradient).sum(axis=1) - energy * remainder

        force = np.einsum("pij,rjk->prik", inverse, self._roots, optimize=True)
        high, high_slopes = shapes[:, :, n:].transpose(0, 2, 1), slopes[:, :, n:].transpose(0, 2, 1)
        y = np.einsum("pri,prik->prk", high, force)
        work = np.sqrt(0.5 * (y**2).sum(axis=(1, 2)))
        relative = high_slopes - (high @ inverse) @ slopes[:, :, :n].transpose(0, 2, 1)
        gradient = 0.5 * np.einsum("prk,prik,pri->pi", y, force, relative, optimize=True) / work[:, None]
        strength = np.linalg.norm(force, axis=(2, 3))
        with np.errstate(invalid="ignore", over="ignore"):
            rest = strength * (
                np.linalg.norm(high, axis=2) * remainder[:, None]
                + root_n * half * self._slope * neumann[:, None]
                + 0.5 * root_n * half**2 * self._curvature * (1 + neumann[:, None])
            )
            rest = np.sqrt(0.5 * (rest**2).sum(axis=1))
            least_work = work - half * np.abs(gradient).sum(axis=1) - rest
        lower[known] = np.nan_to_num(np.maximum(least_work, 0.0), nan=0.0)
        reached[known] = np.where(energy <= self._limit, work, np.inf)
        possible[known] = ~(least_effort > self._limit)
        return lower, possible, reached
