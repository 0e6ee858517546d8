"""Optimality gap of a placement, proven by branch and bound over all places.

Cells of places, or of candidates, are halved, those of the lowest bound first, until no cell can hold a placement under
the limits that improves on the optimum by more than the gap. Bounds are in `workbench.design.placement.cell_bounds`.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from math import comb

import numpy as np

from workbench.arrays import Floats, Integers
from workbench.design.laws.law import DesignError
from workbench.design.placement.cell_bounds import LEVELS, CellBounds, Intervals
from workbench.design.placement.limits import Limits, takes_former_limits
from workbench.design.placement.placement import place_actuators
from workbench.design.placement.places import as_places, coordinates, free_places
from workbench.design.placement.scan import MOST_TRIED, allowed_places, rated, scan
from workbench.design.placement.task import Placement, PlacementTask
from workbench.renamed import former_arguments
from workbench.structure.domain import NamedPoints, Rectangle, listed
from workbench.structure.modes import frozen
from workbench.structure.printed import places_text
from workbench.threads import cores, one_blas_thread

LEAST_LEVELS = 3  # halvings of candidates at least
START_LEVEL = 3  # halvings of the length before the first bound
BATCH = 50_000  # cells bounded at once
SHELVES = 64  # groups of open cells by their bound; the lowest is halved first
TRIED = 20  # centres of a batch, of the lowest W_R, that are evaluated as placements

# (bound reached, W_R of the placement, cells bounded)
Progress = Callable[[float, float, int], None]


@dataclass(frozen=True, eq=False)
class Certificate:
    """A proven lower bound of the residual work, beside that of a placement.

    Attributes:
        placement: the placement.
        lower_bound: of W_R under the limits.
        cells: number examined.
        complete: whether the requested gap is proven; the bound holds in either case.
        better: places met in the search that improve on the placement by more than the gap; None where there are none.
        cell: (n_actuators, 2) intervals of places (from, to), m, of the cell with the lowest bound; None where the
            proof is complete, and among candidates.
        seconds: computing time.
    """

    placement: Placement
    lower_bound: float
    cells: int
    complete: bool
    better: np.ndarray | None = None
    cell: np.ndarray | None = None
    seconds: float = 0.0

    @property
    def gap(self) -> float:
        """Optimality gap: the largest share of W_R by which another placement may be better."""
        return 1.0 - self.lower_bound / self.placement.residual_work

    def __str__(self) -> str:
        return self.text()

    def text(self, energy: str = "J", length: str = "m") -> str:
        """The certificate in words, with the names of the units."""
        count = f"{self.cells:,} cells, {self.seconds:.0f} s"
        if self.better is not None:
            unit = "" if self.better.dtype == object else f" {length}"
            return f"not the optimum: actuators at {places_text(self.better)}{unit} have less W_R ({count})"
        bound, percent = f"{self.lower_bound:.4g} {energy}", f"{100.0 * self.gap:.2g} %"
        less = "that of the one found" if self.gap <= 0 else f"{percent} under that of the one found"
        text = f"{'certified' if self.complete else 'proven so far'}: no placement within the limits has W_R below"
        text += f" {bound}, {less} ({count})"
        if self.cell is None:
            return text
        where = "; ".join(f"{low:.4g} to {high:.4g}" for low, high in self.cell)
        return f"{text}; the lowest bound is that of actuators at {where} {length}"


@former_arguments(most_cells="max_cells")
@takes_former_limits
@one_blas_thread
def certify(
    task: PlacementTask,
    limits: Limits,
    *,
    placement: Placement | None = None,
    gap: float = 0.01,
    seconds: float = 600.0,
    max_cells: int = 200_000_000,
    progress: Progress | None = None,
) -> Certificate:
    """A certificate that no placement under the limits is better by more than a gap, by branch and bound.

    A limit of the condition alone allows actuators beside the supports, where B vanishes and the bounds fail: give a
    distance from the edges too.

    Args:
        task, limits: as for `place_actuators`.
        placement: by default that of `place_actuators`.
        gap: share of W_R to be proven.
        seconds, max_cells: limits of the search, which then returns the bound reached. The first search on a machine
            compiles for about a minute before, which does not count.
        progress: called with the bound, W_R of the placement and the number of cells bounded so far.

    Raises:
        DesignError: no limit that excludes a singular B, or a gap that is not between 0 and 1.
    """
    if not 0 < gap < 1:
        raise DesignError(f"the gap to be proven is a share between 0 and 1; got {gap:g}")
    domain = task.modes.domain
    if isinstance(domain, NamedPoints) and limits.candidates is None:
        limits = replace(limits, candidates=tuple(listed(allowed_places(task, limits, 0))))
    if limits.candidates is None and not limits.regular:
        raise DesignError(
            "without a limit B may be arbitrarily near to singular; give a limit of effort, peak force or condition"
        )
    if isinstance(domain, Rectangle) and limits.candidates is None:
        raise DesignError("a proof on a rectangle is among candidate places; give limits candidates, on a grid say")
    began = time.monotonic()
    best = place_actuators(task, limits) if placement is None else placement
    if limits.candidates is not None and comb(len(limits.candidates), task.n_controlled) <= MOST_TRIED:
        least, tried = scan(task, limits)
        better = least.positions if least.residual_work < best.residual_work * (1.0 - gap) else None
        bound = min(least.residual_work, best.residual_work)
        return Certificate(best, bound, tried, True, better, seconds=time.monotonic() - began)
    return _Search(task, limits, best, gap).run(seconds, max_cells, progress)


class _Search:
    """Branch and bound, with open cells grouped on shelves by their lower bound of √W_R."""

    def __init__(self, task: PlacementTask, limits: Limits, best: Placement, gap: float) -> None:
        self._task, self._limits, self._best = task, limits, best
        self._wanted = np.sqrt(best.residual_work * (1.0 - gap))
        self._tree = (_of_interval if limits.candidates is None else _of_candidates)(task, limits)
        self._bounds = CellBounds(task, limits, self._tree.table, self._wanted)
        self._shelves: list[list[np.ndarray]] = [[] for _ in range(SHELVES)]
        self._stuck = np.inf  # lowest bound of a cell of the smallest size
        self._stuck_cell: np.ndarray | None = None
        self.cells = 0

    def run(self, seconds: float, max_cells: int, progress: Progress | None) -> Certificate:
        n = self._task.n_controlled
        level = range(2**START_LEVEL - 1, 2 ** (START_LEVEL + 1) - 1)
        cells = np.array(list(combinations_with_replacement(level, n)), np.int64).reshape(-1, n)
        workers = min(cores(), 8)
        self._bounds(cells[:1])  # compiles, the first time on a machine, for half a minute that does not count
        began = time.monotonic()
        with ThreadPoolExecutor(workers) as pool:
            while len(cells):
                better = self._shelve(self._feasible(cells), pool, workers)
                spent = time.monotonic() - began
                if better is not None:
                    return Certificate(self._best, 0.0, self.cells, False, better, seconds=spent)
                if progress is not None:
                    progress(self._lowest()[0] ** 2, self._best.residual_work, self.cells)
                if spent > seconds or self.cells > max_cells:
                    break
                shelf = next((s for s in self._shelves if s), None)
                cells = self._halved(_taken(shelf)) if shelf else cells[:0]
        bound, cell = self._lowest()
        spent = time.monotonic() - began
        if bound >= self._wanted:
            return Certificate(self._best, float(self._wanted**2), self.cells, True, seconds=spent)
        return Certificate(self._best, float(bound**2), self.cells, False, None, cell, spent)

    def _feasible(self, cells: Integers) -> Integers:
        """Cells in which all actuators find allowed places in order, at the least distance or more."""
        tree = self._tree
        room, first = tree.allowed[cells].all(axis=1), np.full(len(cells), -np.inf)
        for node in cells.T:
            first = np.maximum(tree.low[node], first + tree.apart)
            room &= tree.high[node] >= first
        return np.asarray(cells[room])

    def _halved(self, rows: np.ndarray) -> np.ndarray:
        """Both halves of each cell, from rows (n_cells, n_actuators + 2) of nodes, lower bound, and axis to halve."""
        left = rows[:, :-2].astype(np.int64)
        halved = np.arange(len(left)), rows[:, -1].astype(np.int64)
        left[halved] = 2 * left[halved] + 1
        right = left.copy()
        right[halved] += 1
        return np.concatenate([left, right])

    def _shelve(self, cells: np.ndarray, pool: ThreadPoolExecutor, workers: int) -> np.ndarray | None:
        """Bound the cells and shelve the open ones; return places that improve on the placement, where some are met."""
        if not len(cells):
            return None
        self.cells += len(cells)
        parts = np.array_split(cells, min(workers, 1 + len(cells) // 1000))
        lower, work, axis = (np.concatenate(part) for part in zip(*pool.map(self._bounds, parts), strict=True))
        if (better := self._better(cells, work)) is not None:
            return better
        open_ = lower < self._wanted
        cells, lower, axis = cells[open_], lower[open_], axis[open_]
        # where the axis cannot be halved further, halve the widest
        smallest = 2**self._tree.levels - 1
        at_end = cells[np.arange(len(cells)), axis] >= smallest
        axis[at_end] = cells[at_end].argmin(axis=1)
        stuck = cells.min(axis=1) >= smallest
        if stuck.any() and self._tree.kept is not None:  # single candidates, whose W_R is known
            better = self._better(cells[stuck], np.sqrt(self._tree.kept(cells[stuck])))
            if better is not None:
                return better
        elif stuck.any():
            i = int(np.argmin(np.where(stuck, lower, np.inf)))
            if lower[i] < self._stuck:
                self._stuck, self._stuck_cell = float(lower[i]), cells[i]
        rows = np.column_stack([cells, lower, axis])[~stuck]
        shelf = np.minimum((SHELVES * rows[:, -2] / self._wanted).astype(int), SHELVES - 1)
        for i in np.unique(shelf):
            self._shelves[i].append(rows[shelf == i])
        return None

    def _better(self, cells: Integers, work: Floats) -> Floats | None:
        """Places at the centre of a cell that improve on the placement by more than the gap; None where none do."""
        for i in np.argsort(work)[:TRIED]:
            places = self._tree.places(cells[i]) if work[i] < self._wanted else None
            placement = None if places is None else self._task.placed(places, "")
            if placement and placement.residual_work < self._wanted**2 and self._limits.satisfied_by(placement):
                return placement.positions
        return None

    def _lowest(self) -> tuple[float, np.ndarray | None]:
        """The lowest bound of √W_R of any open cell, and the intervals of that cell."""
        bound, cell = min(self._wanted, self._stuck), self._stuck_cell
        shelf = next((s for s in self._shelves if s), [])
        for rows in shelf:
            i = int(np.argmin(rows[:, -2]))
            if rows[i, -2] < bound:
                bound, cell = float(rows[i, -2]), rows[i, :-2].astype(np.int64)
        if cell is None or self._tree.kept is not None:
            return bound, None
        return bound, np.column_stack([self._tree.low[cell], self._tree.high[cell]])


def _taken(shelf: list[np.ndarray]) -> np.ndarray:
    """About a batch of cells from a shelf, last in first out."""
    taken, count = [], 0
    while shelf and count < BATCH:
        rows = shelf.pop()
        if count + len(rows) > 2 * BATCH:
            shelf.append(rows[BATCH:])
            rows = rows[:BATCH]
        taken.append(rows)
        count += len(rows)
    return np.concatenate(taken)


@dataclass(frozen=True, eq=False)
class CellTree:
    """Nodes of a binary tree of places; node i halves into 2i + 1 and 2i + 2.

    Attributes:
        table: the modal shapes on every node.
        low, high: (n_nodes,) first and last place of each: m, or the numbers of its first and last candidate.
        apart: least distance from the first place of an actuator's node to the last place of the next actuator's.
        allowed: (n_nodes,) whether a node contains an allowed place.
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
    allowed: np.ndarray
    levels: int
    places: Callable[[np.ndarray], np.ndarray | None]
    kept: Callable[[np.ndarray], np.ndarray] | None = None


def _of_interval(task: PlacementTask, limits: Limits) -> CellTree:
    table, intervals = Intervals.of(task), limits.intervals(task.n_controlled, task.modes.length, task.reach[0])
    low, high = table.centre - table.half, table.centre + table.half
    allowed = np.any([(high >= first) & (low <= last) for first, last in intervals], axis=0)

    def places(cell: np.ndarray) -> np.ndarray | None:
        x: np.ndarray = table.centre[cell]
        return x if free_places(task.modes.domain, x, intervals).all() else None

    return CellTree(table, low, high, limits.spacing, allowed, LEVELS, places)


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
    curvature = frozen(2.0 * radius)
    table = Intervals(frozen(first), frozen(half_width), frozen(middle), zero, zero, curvature, curvature)
    at = coordinates(task.modes.domain, grid)

    def places(cell: np.ndarray) -> np.ndarray | None:
        chosen = np.sort(nearest[cell])
        return as_places(task.modes.domain, grid[chosen]) if (np.diff(chosen) > 0).all() else None

    def kept(cells: np.ndarray) -> np.ndarray:
        return rated(task, limits, shapes, at, np.sort(nearest[cells], axis=1))

    return CellTree(table, first, last, 1.0, sizes > 0, levels, places, kept)
