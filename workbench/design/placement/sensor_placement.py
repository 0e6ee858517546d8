"""Where the sensors of a modal filter should stand: least error of the modal coordinates it gives.

A filter makes q̂ = T q of all modes, T = (n_controlled, n_modes); perfect is T = (I 0). With mode r moving with mean
square e_r, the error is Σ_i Σ_r (T_ir - δ_ir)² e_r: what it misses of the controlled modes, and observation spillover.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from workbench.design.estimation.modal_filter import displacement_filter
from workbench.design.laws.law import DesignError, controlled_indices
from workbench.structure.modes import Modes, frozen
from workbench.structure.profile import ProfileLike
from workbench.threads import one_blas_thread


@dataclass(frozen=True, eq=False)
class SensorPlacement:
    """Places of the sensors and how well the filter then reads.

    Attributes:
        positions: (n_sensors,) m, increasing.
        error: root of Σ (T - I)² e over Σ e of the controlled modes.
        even_error: the same of evenly spaced sensors.
        exhaustive: whether every choice of the candidates was tried; else the best is local, from several starts.
    """

    positions: np.ndarray
    error: float
    even_error: float
    exhaustive: bool

    def __post_init__(self) -> None:
        object.__setattr__(self, "positions", frozen(self.positions))


def filter_error(
    modes: Modes, controlled: Sequence[int], positions: ArrayLike, mass_per_length: ProfileLike, mean_squares: ArrayLike
) -> float:
    """Relative error of a displacement filter's modal coordinates, modes moving with given mean squares (n_modes,)."""
    index, e = list(controlled), np.asarray(mean_squares, float)
    seen = displacement_filter(modes.select(index), positions, mass_per_length).seen(modes)
    seen[np.arange(len(index)), index] -= 1.0
    return float(np.sqrt((seen**2 @ e).sum() / e[index].sum()))


@one_blas_thread
def place_sensors(
    modes: Modes,
    controlled: int | Sequence[int],
    count: int,
    mass_per_length: ProfileLike,
    *,
    mean_squares: ArrayLike,
    candidates: ArrayLike | None = None,
    starts: int = 3,
    most_tried: int = 2000,
    seed: int = 0,
) -> SensorPlacement:
    """Places of `count` displacement sensors among candidates for the least error of the filter.

    Every choice is tried where there are at most `most_tried`; else sensors are exchanged one by one from even places
    and random ones until no exchange helps, and where no candidates were given moved freely from there.

    Args:
        modes: all, controlled and residual.
        controlled: how many of the lowest, or which.
        mean_squares: (n_modes,) of the modal coordinates.
        candidates: (n_candidates,) m; 39 even places unless given.

    Raises:
        DesignError: fewer candidates than sensors, or mean squares that are none.
    """
    index = controlled_indices(modes, controlled)
    e = np.asarray(mean_squares, float)
    if e.shape != (modes.n_modes,) or (e < 0).any() or not e[list(index)].sum() > 0:
        raise DesignError(f"mean squares are needed of all {modes.n_modes} modes, none negative; got {e}")
    grid = modes.length * np.arange(1, 40) / 40 if candidates is None else np.unique(np.asarray(candidates, float))
    if not 1 <= count <= grid.size:
        raise DesignError(f"{count} sensors cannot stand at {grid.size} candidate places; allow more")

    known: dict[tuple[int, ...], float] = {}

    def error(choice: tuple[int, ...]) -> float:
        if choice not in known:
            known[choice] = filter_error(modes, index, grid[list(choice)], mass_per_length, e)
        return known[choice]

    even = filter_error(modes, index, modes.length * np.arange(1, count + 1) / (count + 1), mass_per_length, e)
    exhaustive = comb(grid.size, count) <= most_tried
    if exhaustive:
        best = min(combinations(range(grid.size), count), key=error)
        return SensorPlacement(grid[list(best)], error(best), even, True)
    rng = np.random.default_rng(seed)
    first = np.unique(np.round(np.linspace(0, grid.size - 1, count + 2)[1:-1]).astype(int))
    choices = [tuple(first)] if first.size == count else []
    choices += [tuple(sorted(rng.choice(grid.size, count, replace=False))) for _ in range(starts)]
    best = min((_exchanged(tuple(map(int, choice)), grid.size, error) for choice in choices), key=error)
    if candidates is not None:
        return SensorPlacement(grid[list(best)], error(best), even, False)

    def anywhere(x: np.ndarray) -> float:
        inside = 0 < x.min() and x.max() < modes.length and (np.diff(x) > 1e-3 * modes.length).all()
        return filter_error(modes, index, x, mass_per_length, e) if inside else np.inf

    # between the candidates: from the best of them and from even places
    starts_at = grid[list(best)], modes.length * np.arange(1, count + 1) / (count + 1)
    found = [minimize(anywhere, x, method="Nelder-Mead", options={"maxfev": 60 * count}) for x in starts_at]
    polished = min(found, key=lambda result: result.fun)
    return SensorPlacement(polished.x, float(polished.fun), even, False)


def _exchanged(choice: tuple[int, ...], size: int, error: Callable[[tuple[int, ...]], float]) -> tuple[int, ...]:
    """The choice after every exchange of one sensor that helps."""
    while True:
        better = choice
        for i in range(len(choice)):
            kept = better[:i] + better[i + 1 :]
            options = [tuple(sorted((*kept, k))) for k in range(size) if k not in kept]
            better = min(options, key=error)
            if better == choice:
                continue
        if error(better) >= error(choice):
            return choice
        choice = better
