"""Placement of the sensors of a modal filter, for the least error of its modal coordinates.

A filter gives q̂ = T q, T (n_controlled, n_modes); ideally T = (I 0). With e_r the mean square of q_r, the squared error
is Σ_i Σ_r (T_ir - δ_ir)² e_r: the error in the controlled modes, and observation spillover.
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
from workbench.renamed import Renamed, former_arguments
from workbench.structure.domain import Interval, Place, Rectangle, listed, same_place
from workbench.structure.modes import Modes, freeze
from workbench.structure.printed import Printed, counted, place_text
from workbench.structure.profile import FieldLike, ProfileLike
from workbench.threads import one_blas_thread

Mass = ProfileLike | FieldLike | None
SPACINGS = 40  # of default candidates along a structure
SPACINGS_OVER = 12  # of default candidates along the longer side of a surface


@dataclass(frozen=True, eq=False, repr=False)
class SensorPlacement(Printed):
    """Places of the sensors of a modal filter, and its error.

    Attributes:
        positions: (n_sensors,) m, increasing; on a surface (n_sensors, 2) m; at named points (n_sensors,) names.
        error: relative, root of Σ (T - I)² e over Σ e of the controlled modes.
        evenly_spaced_error: the same of evenly spaced sensors; on a surface and at named points, of evenly numbered
            candidates. Infinite where these make no filter.
        exhaustive: whether every choice of the candidates was tried; else the optimum is local, from several starts.
        modes: of the structure.
        controlled: zero-based indices of the filtered modes.
        by_mode: (n_modes,) shares Σ_i (T_ir - δ_ir)² e_r / Σ e of the squared error.
    """

    positions: np.ndarray
    error: float
    evenly_spaced_error: float
    exhaustive: bool
    modes: Modes
    controlled: tuple[int, ...]
    by_mode: np.ndarray

    even_error = Renamed("evenly_spaced_error")

    def __post_init__(self) -> None:
        freeze(self, "positions", dtype=None)
        freeze(self, "by_mode")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line = f"{counted(len(self.positions), 'sensor')} placed: error of the filter {self.error:.3g}"
        line += f", of evenly spaced ones {self.evenly_spaced_error:.3g}"
        rows = [(str(i + 1), place_text(place)) for i, place in enumerate(self.places)]
        remarks = () if self.exhaustive else ("local optimum, the best of several starts",)
        return line, ("sensor", "place"), rows, remarks

    @property
    def places(self) -> list[Place]:
        """The positions as floats, pairs of floats, or names."""
        return [same_place(at) for at in self.positions]


def filter_error(
    modes: Modes, controlled: Sequence[int], positions: ArrayLike, mass: Mass, mean_squares: ArrayLike
) -> float:
    """Relative error of a displacement filter's modal coordinates, for given mean squares (n_modes,) of the modes."""
    return float(np.sqrt(_error_by_mode(modes, controlled, positions, mass, mean_squares).sum()))


def _error_by_mode(
    modes: Modes, controlled: Sequence[int], positions: ArrayLike, mass: Mass, mean_squares: ArrayLike
) -> np.ndarray:
    """The term (n_modes,) of each mode in the squared relative error."""
    index, e = list(controlled), np.asarray(mean_squares, float)
    deviation = filter_of_mass(mass, modes, index, positions).response_to(modes)
    deviation[np.arange(len(index)), index] -= 1.0
    return np.asarray((deviation**2).sum(axis=0) * e / e[index].sum())


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
    """Places of `count` displacement sensors among candidates for the least error of the modal filter.

    Every choice is tried where there are at most `max_tried`. Otherwise single sensors are exchanged, from evenly
    spaced and random choices, until no exchange improves the error. Along a structure without given candidates, the
    places are then refined continuously.

    Args:
        modes: all, controlled and residual.
        controlled: number of the lowest modes, or their indices (zero-based).
        count: number of sensors.
        mass: kg/m along a structure, kg/m² over a surface; not needed at named points.
        mean_squares: (n_modes,) of the modal coordinates.
        candidates: (n_candidates,) m, (n_candidates, 2) m or names; by default 39 evenly spaced places, a grid over the
            surface, or every displacement among named points.
        starts: random choices from which sensors are exchanged.
        max_tried: largest number of choices for an exhaustive search.
        seed: of the random choices.

    Raises:
        DesignError: fewer candidates than sensors, no choice that makes a filter, or mean squares that are negative or
            zero in all controlled modes.
    """
    index = controlled_indices(modes, controlled)
    e = np.asarray(mean_squares, float)
    if e.shape != (modes.n_modes,) or (e < 0).any() or not e[list(index)].sum() > 0:
        raise DesignError(
            f"mean squares are needed of all {modes.n_modes} modes, none negative and not all of the controlled ones"
            f" zero; got {e}"
        )
    grid = _candidates(modes, candidates)
    if not 1 <= count <= len(grid):
        raise DesignError(
            f"{count} sensors cannot be at {len(grid)} candidate places; place one sensor or more, and give as many"
            " candidates"
        )

    cache: dict[tuple[int, ...], float] = {}
    reasons: list[str] = []

    def error(choice: tuple[int, ...]) -> float:
        if choice not in cache:
            try:
                cache[choice] = filter_error(modes, index, grid[list(choice)], mass, e)
            except ValueError as reason:
                reasons.append(str(reason))
                cache[choice] = np.inf
        return cache[choice]

    length = modes.length if isinstance(modes.domain, Interval) else 0.0
    evenly = length * np.arange(1, count + 1) / (count + 1)
    first = np.unique(np.round(np.linspace(0, len(grid) - 1, count + 2)[1:-1]).astype(int))
    even_choice = [tuple(map(int, first))] if first.size == count else []
    even = filter_error(modes, index, evenly, mass, e) if length else min(map(error, even_choice), default=np.inf)
    exhaustive = comb(len(grid), count) <= max_tried
    if exhaustive:
        best = min(combinations(range(len(grid)), count), key=error)
    else:
        rng = np.random.default_rng(seed)
        drawn = [sorted(rng.choice(len(grid), count, replace=False)) for _ in range(starts)]
        choices = [*even_choice, *(tuple(map(int, choice)) for choice in drawn)]
        best = min((_exchanged(choice, len(grid), error) for choice in choices), key=error)
    if np.isinf(error(best)):
        raise DesignError(f"no choice of {count} candidate places makes a filter: {reasons[-1]}")

    def placed(at: np.ndarray) -> SensorPlacement:
        by_mode = _error_by_mode(modes, index, at, mass, e)
        return SensorPlacement(at, float(np.sqrt(by_mode.sum())), even, exhaustive, modes, tuple(index), by_mode)

    if exhaustive or candidates is not None or not length:
        return placed(grid[list(best)])

    def error_at(x: np.ndarray) -> float:
        inside = 0 < x.min() and x.max() < length and (np.diff(x) > 1e-3 * length).all()
        return filter_error(modes, index, x, mass, e) if inside else np.inf

    # continuous refinement, from the best candidates and from evenly spaced places
    starts_at = grid[list(best)], evenly
    results = [minimize(error_at, x, method="Nelder-Mead", options={"maxfev": 60 * count}) for x in starts_at]
    return placed(min(results, key=lambda result: result.fun).x)


def _candidates(modes: Modes, given: ArrayLike | None) -> np.ndarray:
    """Distinct candidate places (n_candidates, ...) of the sensors."""
    domain = modes.domain
    if isinstance(domain, Interval):
        return np.unique(domain.locate(domain.grid(SPACINGS) if given is None else given))
    places = as_places(domain, domain.grid(SPACINGS_OVER) if given is None else given)
    return np.array(list(dict.fromkeys(listed(places))), float if isinstance(domain, Rectangle) else object)


def _exchanged(choice: tuple[int, ...], size: int, error: Callable[[tuple[int, ...]], float]) -> tuple[int, ...]:
    """The choice of candidates after exchanging single sensors until no exchange reduces the error."""
    while True:
        better = choice
        for i in range(len(choice)):
            kept = better[:i] + better[i + 1 :]
            options = [tuple(sorted((*kept, k))) for k in range(size) if k not in kept]
            better = min(options, key=error)
        if error(better) >= error(choice):
            return choice
        choice = better
