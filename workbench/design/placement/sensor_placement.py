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

from workbench.design.estimation.modal_filter import filter_of_mass
from workbench.design.laws.law import DesignError, controlled_indices
from workbench.design.placement.places import as_places
from workbench.renamed import former_arguments
from workbench.structure.domain import Interval, Place, Rectangle, listed, same_place
from workbench.structure.modes import Modes, freeze
from workbench.structure.printed import Printed, counted, place_text
from workbench.structure.profile import FieldLike, ProfileLike
from workbench.threads import one_blas_thread

Mass = ProfileLike | FieldLike | None
SPACINGS = 40  # from end to end of a structure between candidates
SPACINGS_OVER = 12  # along the longer side of a surface


@dataclass(frozen=True, eq=False, repr=False)
class SensorPlacement(Printed):
    """Places of the sensors and how well the filter then reads.

    Attributes:
        positions: (n_sensors,) m, increasing; on a surface (n_sensors, 2) m; at named points (n_sensors,) names.
        error: root of Σ (T - I)² e over Σ e of the controlled modes.
        even_error: the same of evenly spaced sensors; on a surface and at named points, of every so many candidates.
            Infinite where these make no filter.
        exhaustive: whether every choice of the candidates was tried; else the best is local, from several starts.
        modes: of the structure.
        controlled: indices of those that the filter is for.
        by_mode: (n_modes,) shares Σ_i (T_ir - δ_ir)² e_r / Σ e of the squared error.
    """

    positions: np.ndarray
    error: float
    even_error: float
    exhaustive: bool
    modes: Modes
    controlled: tuple[int, ...]
    by_mode: np.ndarray

    def __post_init__(self) -> None:
        freeze(self, "positions", dtype=None)
        freeze(self, "by_mode")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line = f"{counted(len(self.positions), 'sensor')} placed: error of the filter {self.error:.3g}"
        line += f", of even places {self.even_error:.3g}"
        rows = [(str(i + 1), place_text(place)) for i, place in enumerate(self.places)]
        return line, ("sensor", "place"), rows, () if self.exhaustive else ("the best of several searches, not of all",)

    @property
    def places(self) -> list[Place]:
        """The positions as places: floats, pairs of floats, or names."""
        return [same_place(at) for at in self.positions]


def filter_error(
    modes: Modes, controlled: Sequence[int], positions: ArrayLike, mass: Mass, mean_squares: ArrayLike
) -> float:
    """Relative error of a displacement filter's modal coordinates, modes moving with given mean squares (n_modes,)."""
    return float(np.sqrt(_error_by_mode(modes, controlled, positions, mass, mean_squares).sum()))


def _error_by_mode(
    modes: Modes, controlled: Sequence[int], positions: ArrayLike, mass: Mass, mean_squares: ArrayLike
) -> np.ndarray:
    """(n_modes,) what each mode has of the squared relative error."""
    index, e = list(controlled), np.asarray(mean_squares, float)
    seen = filter_of_mass(mass, modes, index, positions).response_to(modes)
    seen[np.arange(len(index)), index] -= 1.0
    return np.asarray((seen**2).sum(axis=0) * e / e[index].sum())


@former_arguments(mass_per_length="mass", most_tried="max_tried")
@one_blas_thread
def place_sensors(
    modes: Modes,
    controlled: int | Sequence[int],
    count: int,
    mass: Mass = None,
    *,
    mean_squares: ArrayLike,
    candidates: ArrayLike | None = None,
    starts: int = 3,
    max_tried: int = 2000,
    seed: int = 0,
) -> SensorPlacement:
    """Places of `count` displacement sensors among candidates for the least error of the filter.

    Every choice is tried where there are at most `max_tried`; else sensors are exchanged one by one from even places
    and random ones until no exchange helps, and along a structure, where no candidates were given, moved freely from
    there.

    Args:
        modes: all, controlled and residual.
        controlled: how many of the lowest, or which.
        mass: kg/m along a structure, kg/m² over a surface; not needed at named points.
        mean_squares: (n_modes,) of the modal coordinates.
        candidates: places of the domain: (n_candidates,) m, (n_candidates, 2) m or names; unless given, 39 even places,
            a grid over the surface, or every point that is a displacement.

    Raises:
        DesignError: fewer candidates than sensors, candidates of which no choice makes a filter, or mean squares that
            are none.
    """
    index = controlled_indices(modes, controlled)
    e = np.asarray(mean_squares, float)
    if e.shape != (modes.n_modes,) or (e < 0).any() or not e[list(index)].sum() > 0:
        raise DesignError(f"mean squares are needed of all {modes.n_modes} modes, none negative; got {e}")
    grid = _candidates(modes, candidates)
    if not 1 <= count <= len(grid):
        raise DesignError(f"{count} sensors cannot stand at {len(grid)} candidate places; allow more")

    known: dict[tuple[int, ...], float] = {}
    refused: list[str] = []

    def error(choice: tuple[int, ...]) -> float:
        if choice not in known:
            try:
                known[choice] = filter_error(modes, index, grid[list(choice)], mass, e)
            except ValueError as reason:
                refused.append(str(reason))
                known[choice] = np.inf
        return known[choice]

    along = modes.length if isinstance(modes.domain, Interval) else 0.0
    evenly = along * np.arange(1, count + 1) / (count + 1)
    first = np.unique(np.round(np.linspace(0, len(grid) - 1, count + 2)[1:-1]).astype(int))
    spread = [tuple(map(int, first))] if first.size == count else []
    even = filter_error(modes, index, evenly, mass, e) if along else min(map(error, spread), default=np.inf)
    exhaustive = comb(len(grid), count) <= max_tried
    if exhaustive:
        best = min(combinations(range(len(grid)), count), key=error)
    else:
        rng = np.random.default_rng(seed)
        drawn = [sorted(rng.choice(len(grid), count, replace=False)) for _ in range(starts)]
        choices = [*spread, *(tuple(map(int, choice)) for choice in drawn)]
        best = min((_exchanged(choice, len(grid), error) for choice in choices), key=error)
    if np.isinf(error(best)):
        raise DesignError(f"no choice of {count} candidate places makes a filter: {refused[-1]}")

    def placed(at: np.ndarray) -> SensorPlacement:
        by_mode = _error_by_mode(modes, index, at, mass, e)
        return SensorPlacement(at, float(np.sqrt(by_mode.sum())), even, exhaustive, modes, tuple(index), by_mode)

    if exhaustive or candidates is not None or not along:
        return placed(grid[list(best)])

    def anywhere(x: np.ndarray) -> float:
        inside = 0 < x.min() and x.max() < along and (np.diff(x) > 1e-3 * along).all()
        return filter_error(modes, index, x, mass, e) if inside else np.inf

    # between the candidates: from the best of them and from even places
    starts_at = grid[list(best)], evenly
    found = [minimize(anywhere, x, method="Nelder-Mead", options={"maxfev": 60 * count}) for x in starts_at]
    return placed(min(found, key=lambda result: result.fun).x)


def _candidates(modes: Modes, given: ArrayLike | None) -> np.ndarray:
    """Different places (n_candidates, ...) of the domain where sensors may stand."""
    domain = modes.domain
    if isinstance(domain, Interval):
        return np.unique(domain.locate(domain.grid(SPACINGS) if given is None else given))
    places = as_places(domain, domain.grid(SPACINGS_OVER) if given is None else given)
    return np.array(list(dict.fromkeys(listed(places))), float if isinstance(domain, Rectangle) else object)


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
