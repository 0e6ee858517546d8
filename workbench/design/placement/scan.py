"""Exhaustive search of placements on a grid or on candidate places, and search by exchange where they are too many."""

from itertools import combinations, islice
from math import comb

import numpy as np

from workbench.design.laws.law import DesignError
from workbench.design.placement.limits import TOLERANCE, Limits, conflict, takes_former_limits
from workbench.design.placement.places import as_places, coordinates, free_places, least_distances
from workbench.design.placement.task import Placement, PlacementTask, batch_costs
from workbench.structure.domain import Interval, NamedPoints
from workbench.threads import one_blas_thread

BATCH = 20_000
MOST_TRIED = 5_000_000
DRAWN, STARTS = 2000, 12  # random choices, and how many of the best are starts of the exchange


@takes_former_limits
@one_blas_thread
def scan(task: PlacementTask, limits: Limits, *, n_places: int = 60) -> tuple[Placement, int]:
    """The best of all placements on the limits' candidate places, or on a grid, and the number of placements tried.

    Args:
        task, limits: as for `place_actuators`.
        n_places: of the grid, along the longer side, where the limits name no candidates.

    Raises:
        DesignError: fewer places than actuators, too many choices, or limits that no placement meets; the message
            names the conflict.
    """
    n, domain = task.n_controlled, task.modes.domain
    grid = allowed_places(task, limits, n_places)
    if comb(len(grid), n) > MOST_TRIED:
        raise DesignError(
            f"{n} actuators at {len(grid)} places make {comb(len(grid), n):.2g} choices; at most {MOST_TRIED:.0e} are"
            " tried: name fewer candidates, or allow any place"
        )
    shapes, at = task.shapes(grid), coordinates(domain, grid)
    best, best_at, tried = np.inf, None, 0
    every = combinations(range(len(grid)), n)
    while batch := list(islice(every, BATCH)):
        index = np.array(batch)
        index = index[least_distances(at[index]) >= limits.spacing - 1e-12]
        if not index.size:
            continue
        tried += len(index)
        work = rated(task, limits, shapes, at, index)
        # batch costs sample the forces in time; the best must meet the limit of the peak between samples too
        while work[i := int(np.argmin(work))] < best:
            if limits.satisfied_by(task.placed(grid[index[i]], "")):
                best, best_at = work[i], grid[index[i]]
            work[i] = np.inf
    if best_at is None:
        raise DesignError(conflict(task, limits, grid))
    return task.placed(best_at, f"best of {tried} placements"), tried


def best_of_candidates(task: PlacementTask, limits: Limits) -> Placement:
    """The best of all choices of candidate places; where there are too many, the best found by exchange."""
    grid = allowed_places(task, limits, 0)
    n = task.n_controlled
    if comb(len(grid), n) <= MOST_TRIED:
        return scan(task, limits)[0]
    shapes, at = task.shapes(grid), coordinates(task.modes.domain, grid)
    rng = np.random.default_rng(0)
    drawn = np.sort(rng.random((DRAWN, len(grid))).argpartition(n, axis=1)[:, :n], axis=1)
    first = drawn[np.argsort(rated(task, limits, shapes, at, drawn), kind="stable")[:STARTS]]
    improved = [_exchanged(task, limits, shapes, at, choice) for choice in first]
    for rating, choice in sorted(improved, key=lambda pair: pair[0]):
        placement = task.placed(grid[choice], f"best of exchanges from {STARTS} choices")
        if np.isfinite(rating) and limits.satisfied_by(placement):
            return placement
    raise DesignError(conflict(task, limits, grid))


def rated(task: PlacementTask, limits: Limits, shapes: np.ndarray, at: np.ndarray, index: np.ndarray) -> np.ndarray:
    """W_R of choices (n_choices, n) of places; inf where a limit is exceeded or B singular."""
    costs = batch_costs(task, shapes[index])
    met = np.all([excess <= TOLERANCE for excess in limits.violations(at[index], costs).values()], axis=0)
    return np.asarray(np.where(met, costs.work, np.inf))


def _exchanged(
    task: PlacementTask, limits: Limits, shapes: np.ndarray, at: np.ndarray, choice: np.ndarray
) -> tuple[float, np.ndarray]:
    """W_R and the choice of places after exchanging single places, the best exchange first, until none improves W_R."""
    best = float(rated(task, limits, shapes, at, choice[None])[0])
    while True:
        others = np.setdiff1d(np.arange(len(shapes)), choice)
        tried = np.repeat(choice[None], choice.size * others.size, axis=0)
        for i in range(choice.size):
            tried[i * others.size : (i + 1) * others.size, i] = others
        rating = rated(task, limits, shapes, at, tried)
        i = int(np.argmin(rating))
        if not rating[i] < best:
            return best, np.sort(choice)
        best, choice = float(rating[i]), tried[i]


def allowed_places(task: PlacementTask, limits: Limits, n_places: int) -> np.ndarray:
    """The limits' candidate places, or a grid, without those in forbidden zones: (n_places,) or (n_places, 2)."""
    n, domain = task.n_controlled, task.modes.domain
    boxes = limits.boxes(task)
    if limits.candidates is not None:
        domain.locate(list(limits.candidates))
        grid = as_places(domain, list(limits.candidates))
    elif isinstance(domain, Interval):
        edge = max(limits.edge_distance, task.reach[0], domain.length / n_places / 2)
        grid = np.linspace(edge, domain.length - edge, n_places)
    elif isinstance(domain, NamedPoints):
        grid = as_places(domain, domain.rotations() if task.actuator.quantity == "moment" else domain.grid())
    else:
        grid = as_places(domain, domain.grid(n_places))
    allowed: np.ndarray = grid[free_places(domain, grid, boxes)]
    if len(allowed) < n:
        raise DesignError(f"{n} actuators need as many places; the limits allow {len(allowed)}: allow more")
    return allowed
