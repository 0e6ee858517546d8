"""Every placement on a grid or on candidate places, the best of them."""

from itertools import combinations, islice
from math import comb

import numpy as np

from workbench.design.laws.law import DesignError
from workbench.design.placement.limits import TOLERANCE, Limits, conflict, takes_former_limits
from workbench.design.placement.task import Placement, PlacementTask, batch_costs
from workbench.threads import one_blas_thread

BATCH = 20_000
MOST_TRIED = 5_000_000


@takes_former_limits
@one_blas_thread
def scan(task: PlacementTask, limits: Limits, *, n_places: int = 60) -> tuple[Placement, int]:
    """The best of all placements on the limits' candidate places, or on a grid, and how many were tried.

    Args:
        n_places: of the grid, where the limits name no candidates.

    Raises:
        DesignError: fewer places than actuators, more choices of them than can be tried, or limits that none meets,
            with the one that conflicts.
    """
    n, length = task.n_controlled, task.modes.length
    intervals = limits.intervals(n, length, task.reach[0])
    if limits.candidates is None:
        edge = max(limits.margin, task.reach[0], length / n_places / 2)
        grid = np.linspace(edge, length - edge, n_places)
    else:
        grid = np.array(limits.candidates)
    grid = grid[np.any([(grid >= low - 1e-12) & (grid <= high + 1e-12) for low, high in intervals], axis=0)]
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
        index = index[(np.diff(grid[index], axis=1) >= limits.spacing - 1e-12).all(axis=1)]
        if not index.size:
            continue
        tried += len(index)
        costs = batch_costs(task, shapes[index])
        violations = limits.violations(grid[index], costs)
        work = np.where(np.all([v <= TOLERANCE for v in violations.values()], axis=0), costs.work, np.inf)
        # the forces of many are sampled in time; what would win must keep its peak between the samples too
        while work[i := int(np.argmin(work))] < best:
            if limits.satisfied_by(task.placed(grid[index[i]], "")):
                best, best_at = work[i], grid[index[i]]
            work[i] = np.inf
    if best_at is None:
        raise DesignError(conflict(task, limits, grid))
    return task.placed(best_at, f"best of {tried} placements"), tried
