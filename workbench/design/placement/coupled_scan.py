"""Every placement on a grid for coupled LQR, each a new design, and how much less could be spilled between them."""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from workbench.arrays import Floats, Integers
from workbench.design.laws.law import DesignError
from workbench.design.placement.coupled_placement import coupled_batch, coupled_costs
from workbench.design.placement.limits import Limits
from workbench.design.placement.task import Placement
from workbench.structure.modes import Modes
from workbench.threads import one_blas_thread

BATCH = 2_000


@dataclass(frozen=True, eq=False)
class CoupledScan:
    """All placements on a grid.

    Attributes:
        best: of those that keep the limits.
        tried: how many.
        lower_bound: of W_R anywhere, where √W_R and the root of the effort change no faster between the grid's
            placements than from each to its neighbours: an estimate, not a proof.
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
    """The best of all placements on an even grid over the length for coupled LQR.

    Args:
        modes, n_controlled, n_actuators, impulse_at, weight, limits: as for `place_coupled`.
        n_places: of the grid; placements grow as its power n_actuators.

    Raises:
        DesignError: limits that no placement on the grid meets.
    """
    length, asked = modes.length, {"impulse_at": impulse_at, "weight": weight}
    stretches = np.array(limits.intervals(n_actuators, length))
    step = length / n_places
    grid = step * (0.5 + np.arange(n_places))
    index = np.array(list(combinations_with_replacement(range(n_places), n_actuators)))
    figures = [
        coupled_batch(modes, n_controlled, grid[part], **asked)
        for part in np.array_split(index, max(1, len(index) // BATCH))
    ]
    work, effort = (np.concatenate(parts) for parts in zip(*figures))
    low, high = stretches.T
    at = grid[index]
    gaps = np.diff(at, axis=1).min(axis=1, initial=np.inf)
    standing = ((at[..., None] >= low) & (at[..., None] <= high)).any(axis=2).all(axis=1) & (gaps >= limits.spacing)
    best = None
    for i in np.argsort(np.where(standing & (effort <= limits.effort), work, np.inf)):
        if not (standing[i] and effort[i] <= limits.effort and np.isfinite(work[i])):
            break
        found = coupled_costs(modes, n_controlled, at[i], **asked)
        if limits.satisfied_by(found):
            best = found
            break
    if best is None:
        raise DesignError(f"none of {standing.sum()} placements on the grid keeps the limits; raise them")
    near = ((at[..., None] + step / 2 >= low) & (at[..., None] - step / 2 <= high)).any(axis=2).all(axis=1)
    near &= gaps + step >= limits.spacing
    near &= _least(index, np.sqrt(effort), n_places) <= np.sqrt(limits.effort)
    bound = np.maximum(_least(index, np.sqrt(work), n_places), 0.0)[near].min() ** 2
    return CoupledScan(best, int(standing.sum()), float(min(bound, best.residual_work)))


def _least(index: Integers, values: Floats, n_places: int) -> Floats:
    """What each may fall to half-way to its neighbours, all actuators moved at once."""
    field = np.full((n_places,) * index.shape[1], np.nan)
    field[tuple(index.T)] = np.where(np.isfinite(values), values, np.nan)
    fall = np.zeros(field.shape)
    for axis in range(field.ndim):
        change = np.nan_to_num(np.abs(np.diff(field, axis=axis)))
        edge = [(0, 0)] * field.ndim
        before, after = edge.copy(), edge.copy()
        before[axis], after[axis] = (1, 0), (0, 1)
        fall += 0.5 * np.maximum(np.pad(change, before), np.pad(change, after))
    return np.asarray(values - fall[tuple(index.T)])
