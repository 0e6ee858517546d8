"""The tree of branch and bound: places along an interval, or candidate places in groups of similar modal shapes."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from workbench.design.placement.cell_bounds import LEVELS, Intervals
from workbench.design.placement.limits import Limits
from workbench.design.placement.places import as_places, coordinates, least_distances
from workbench.design.placement.scan import allowed_places, rated
from workbench.design.placement.task import PlacementTask
from workbench.structure.modes import frozen

LEAST_LEVELS = 3  # halvings of candidates at least


@dataclass(frozen=True, eq=False)
class CellTree:
    """Nodes of a binary tree of places; node i halves into 2i + 1 and 2i + 2.

    Attributes:
        table: the modal shapes on every node.
        low, high: (n_nodes,) first and last place of each: m, or the numbers of its first and last candidate.
        apart: least distance from the first place of an actuator's node to the last place of the next actuator's.
        stands: (n_nodes,) whether a node contains an allowed place.
        levels: below the root.
        places: the places of the actuators of a cell (n_actuators,) of nodes, in the middle of each; None where one of
            them is not allowed.
        kept: W_R of cells (n_cells, n_actuators) of single candidates, inf where a limit is exceeded; None along an
            interval, where a cell is never a single place.
    """

    table: Intervals
    low: np.ndarray
    high: np.ndarray
    apart: float
    stands: np.ndarray
    levels: int
    places: Callable[[np.ndarray], np.ndarray | None]
    kept: Callable[[np.ndarray], np.ndarray] | None = None

    @classmethod
    def of(cls, task: PlacementTask, limits: Limits) -> "CellTree":
        """The tree of the candidates where the limits name them, else of the interval.

        Raises:
            DesignError: no room for all actuators.
        """
        return _of_candidates(task, limits) if limits.candidates is not None else _of_interval(task, limits)


def _of_interval(task: PlacementTask, limits: Limits) -> CellTree:
    table = Intervals.of(task)
    stretches = np.array(limits.intervals(task.n_controlled, task.modes.length, task.reach[0]))
    low, high = table.centre - table.half, table.centre + table.half
    stands = ((high[:, None] >= stretches[:, 0]) & (low[:, None] <= stretches[:, 1])).any(axis=1)

    def places(cell: np.ndarray) -> np.ndarray | None:
        x = table.centre[cell]
        inside = ((x[:, None] >= stretches[:, 0]) & (x[:, None] <= stretches[:, 1])).any(axis=1)
        return x if inside.all() else None

    return CellTree(table, low, high, limits.spacing, stands, LEVELS, places)


def _of_candidates(task: PlacementTask, limits: Limits) -> CellTree:
    """Candidates halved along the scaled shape that varies most within a node, down to single candidates."""
    grid = allowed_places(task, limits, 0)
    shapes = task.shapes(grid)
    scaled = shapes / np.maximum(np.abs(shapes).max(axis=0), 1e-300)
    levels = max(LEAST_LEVELS, int(np.ceil(np.log2(len(grid)))))
    members: list[np.ndarray] = [np.arange(len(grid))]
    for _ in range(2**levels - 1):
        node = members[(len(members) - 1) // 2]
        axis = int(np.argmax(np.ptp(scaled[node], axis=0))) if node.size else 0
        order = node[np.argsort(scaled[node, axis], kind="stable")]
        half = -(-node.size // 2)
        members += [order[:half], order[half:]]
    sizes = np.array([node.size for node in members])
    # number the candidates in the order of the leaves, so that every node holds consecutive ones
    leaves = np.concatenate(members[2**levels - 1 :])
    number = np.argsort(leaves)
    n_nodes, n_modes = len(members), task.modes.n_modes
    middle, radius = np.zeros((n_nodes, n_modes)), np.zeros((n_nodes, n_modes))
    first, last = np.full(n_nodes, -np.inf), np.full(n_nodes, -np.inf)
    nearest = np.zeros(n_nodes, int)  # candidate whose shapes are nearest to the middle
    for i in np.flatnonzero(sizes):
        own = shapes[members[i]]
        least, most = own.min(axis=0), own.max(axis=0)
        middle[i], radius[i] = 0.5 * (least + most), 0.5 * (most - least)
        first[i], last[i] = number[members[i]].min(), number[members[i]].max()
        nearest[i] = members[i][np.argmin(np.linalg.norm(own - middle[i], axis=1))]
    zero = frozen(np.zeros((n_nodes, n_modes)))
    # φ'' is chosen so that ½ h² |φ''| with h = 1 is the largest difference of a node's shapes from their middle
    half_width = np.where(sizes > 1, 1.0, 0.0)
    bend = frozen(2.0 * radius)
    table = Intervals(frozen(first), frozen(half_width), frozen(middle), zero, zero, bend, bend)
    at = coordinates(task.modes.domain, grid)

    def places(cell: np.ndarray) -> np.ndarray | None:
        chosen = np.sort(nearest[cell])
        return as_places(task.modes.domain, grid[chosen]) if (np.diff(chosen) > 0).all() else None

    def kept(cells: np.ndarray) -> np.ndarray:
        index = np.sort(nearest[cells], axis=1)
        distant = least_distances(at[index]) >= limits.spacing - 1e-12
        return np.where(distant, rated(task, limits, shapes, at, index), np.inf)

    return CellTree(table, first, last, 1.0, sizes > 0, levels, places, kept)
