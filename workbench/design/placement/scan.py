"""Every placement on a grid or on given places, the best of them."""

from collections.abc import Iterable
from itertools import combinations, islice
from math import comb

import numpy as np
from numpy.typing import ArrayLike

from workbench.design.laws.law import DesignError
from workbench.design.placement.limits import KEPT, Limits, conflict
from workbench.design.placement.task import Placement, PlacementTask, batch_figures
from workbench.threads import one_blas_thread

BATCH = 20_000
MOST_TRIED = 5_000_000


@one_blas_thread
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
        DesignError: fewer places than actuators, more choices of them than can be tried, or limits that none meets,
            with the one that conflicts.
    """
    limits = Limits(effort_limit, peak_limit, condition_limit, spacing, margin, tuple(forbidden))
    n, length = task.n_controlled, task.modes.length
    stretches = limits.room(n, length)
    if candidates is None:
        edge = max(margin, length / n_places / 2)
        grid = np.linspace(edge, length - edge, n_places)
    else:
        grid = np.sort(np.asarray(candidates, float))
    grid = grid[np.any([(grid >= low - 1e-12) & (grid <= high + 1e-12) for low, high in stretches], axis=0)]
    if grid.size < n:
        raise DesignError(f"{n} actuators need as many places; the limits leave {grid.size}: allow more")
    if comb(grid.size, n) > MOST_TRIED:
        raise DesignError(
            f"{n} actuators at {grid.size} places make {comb(grid.size, n):.2g} choices; at most {MOST_TRIED:.0e} are"
            " tried: name fewer places, or let the actuators stand anywhere"
        )
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
        # the forces of many are sampled in time; what would win must keep its peak between the samples too
        while work[i := int(np.argmin(work))] < best:
            if limits.kept(task.placed(grid[index[i]], "")):
                best, best_at = work[i], grid[index[i]]
            work[i] = np.inf
    if best_at is None:
        raise DesignError(conflict(task, limits, grid))
    return task.placed(best_at, f"best of {tried} placements"), tried
