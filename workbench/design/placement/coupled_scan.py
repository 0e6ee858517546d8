"""Exhaustive search of placements on a grid for coupled LQR, with an estimated bound of W_R between them."""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from workbench.arrays import Floats, Integers
from workbench.design.laws.law import DesignError
from workbench.design.placement.coupled_placement import coupled_batch, coupled_costs
from workbench.design.placement.limits import Limits
from workbench.design.placement.places import free_places, least_distances
from workbench.design.placement.task import Placement
from workbench.structure.modes import Modes
from workbench.threads import one_blas_thread

BATCH = 2_000


@dataclass(frozen=True, eq=False)
class CoupledScan:
    """All placements on a grid.

    Attributes:
        best: of those that meet the limits.
        tried: number of placements.
        lower_bound: of W_R anywhere if √W_R and √effort change no faster between the grid's placements than from one
            to the next; an estimate, not a proof.
    """

    best: Placement
    tried: int
    lower_bound: float


@one_blas_thread
def scan_coupled(
    modes: Modes,
    n_controlled: int,
    n_actuators: int,
    *,
    impulse_at: float,
    weight: float,
    limits: Limits,
    n_places: int = 60,
) -> CoupledScan:
    """The best of all placements on a uniform grid over the length for coupled LQR.

    Args:
        modes, n_controlled, n_actuators, impulse_at, weight, limits: as for `place_coupled`.
        n_places: of the grid; the number of placements grows as n_places to the power n_actuators.

    Raises:
        DesignError: limits that no placement on the grid meets.
    """
    length, settings = modes.length, {"impulse_at": impulse_at, "weight": weight}
    intervals = limits.intervals(n_actuators, length)
    step = length / n_places
    grid = step * (0.5 + np.arange(n_places))
    index = np.array(list(combinations_with_replacement(range(n_places), n_actuators)))
    costs = [
        coupled_batch(modes, n_controlled, grid[part], **settings)
        for part in np.array_split(index, max(1, len(index) // BATCH))
    ]
    work, effort = (np.concatenate(parts) for parts in zip(*costs))
    at = grid[index]
    gaps = least_distances(at)
    allowed = free_places(modes.domain, grid, intervals)[index].all(axis=1) & (gaps >= limits.spacing)
    rated = np.where(allowed & (effort <= limits.effort), work, np.inf)
    by_work = (i for i in np.argsort(rated) if np.isfinite(rated[i]))
    placements = (coupled_costs(modes, n_controlled, at[i], **settings) for i in by_work)
    best = next(filter(limits.satisfied_by, placements), None)
    if best is None:
        raise DesignError(f"none of {allowed.sum()} placements on the grid meets the limits; raise them")
    widened = [(low - step / 2, high + step / 2) for low, high in intervals]
    near = free_places(modes.domain, grid, widened)[index].all(axis=1)
    near &= gaps + step >= limits.spacing
    near &= _least(index, np.sqrt(effort), n_places) <= np.sqrt(limits.effort)
    bound = np.maximum(_least(index, np.sqrt(work), n_places), 0.0)[near].min() ** 2
    return CoupledScan(best, int(allowed.sum()), float(min(bound, best.residual_work)))


def _least(index: Integers, values: Floats, n_places: int) -> Floats:
    """Extrapolated lower bound of each value half-way to its neighbours, all actuators moved at once."""
    field = np.full((n_places,) * index.shape[1], np.nan)
    field[tuple(index.T)] = np.where(np.isfinite(values), values, np.nan)
    fall = np.zeros(field.shape)
    for axis in range(field.ndim):
        change = np.nan_to_num(np.abs(np.diff(field, axis=axis, prepend=np.nan, append=np.nan)))
        fall += 0.5 * np.maximum(np.delete(change, 0, axis), np.delete(change, -1, axis))
    return np.asarray(values - fall[tuple(index.T)])
