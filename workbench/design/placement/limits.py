"""Limits of a placement, and the limits in conflict where no placement meets them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from itertools import combinations
from typing import Any, ParamSpec, TypeVar
from warnings import warn

import numpy as np

from workbench.design.laws.law import DesignError
from workbench.design.placement.places import Box, coordinates, free_boxes, least_distances
from workbench.design.placement.task import Placement, PlacementTask, batch_costs
from workbench.renamed import former_fields
from workbench.rig.actuators import command_unit
from workbench.structure.domain import Interval, NamedPoints, Place, Rectangle, position, reach, same_place
from workbench.structure.printed import Constructed, command_headings, in_unit

TOLERANCE = 2e-6  # relative, of a limit
APART = 1e-6  # of the length: least distance of two actuators
DRAWS = 20_000  # random placements, to find which limits conflict
SAMPLES = 40  # places of these in every box

BOUNDED = ("effort", "peak_force", "condition")

Zone = tuple[Place, Place]
P = ParamSpec("P")
R = TypeVar("R")


@former_fields(margin="edge_distance")
@dataclass(frozen=True, repr=False)
class Limits(Constructed):
    """Constraints of a placement.

    Attributes:
        effort: largest ∫ FᵀF dt.
        peak_force: largest force of any actuator.
        condition: of B, largest ‖B‖‖B⁻¹‖ in the Frobenius norm (n where B is orthogonal).
        spacing: least distance between neighbours, m; of the middles of patches, which overlap where it is small.
        edge_distance: least distance from the ends or edges, m.
        forbidden: zones without actuators, m: intervals (from, to), or on a rectangle boxes between two corners
            ((x, y), (x, y)). No part of a patch may overlap them.
        candidates: the only allowed places; None for any place. At named points the default is every displacement
            (for moments, every rotation).
    """

    effort: float = np.inf
    peak_force: float = np.inf
    condition: float = np.inf
    spacing: float = 0.0
    edge_distance: float = 0.0
    forbidden: tuple[Zone, ...] = ()
    candidates: tuple[Place, ...] | None = None

    def __post_init__(self) -> None:
        for name in BOUNDED:
            if not getattr(self, name) > 0:
                raise DesignError(f"the limit of {_words(name)} must be positive; got {getattr(self, name):g}")
        if not (0 <= self.spacing < np.inf and 0 <= self.edge_distance < np.inf):
            raise DesignError(
                f"spacing and edge_distance must be 0 or more; got {self.spacing:g} and {self.edge_distance:g}"
            )
        for low, high in self.forbidden:
            if not np.less(low, high).all():
                raise DesignError(f"forbidden zone ({low}, {high}) must be (lower, upper)")
        zones = tuple((same_place(low), same_place(high)) for low, high in self.forbidden)
        object.__setattr__(self, "forbidden", zones)
        if self.candidates is not None:
            candidates = [same_place(place) for place in self.candidates]
            object.__setattr__(self, "candidates", tuple(sorted(dict.fromkeys(candidates))))

    @property
    def regular(self) -> bool:
        """Whether a limit excludes a singular B."""
        return bool(np.isfinite([getattr(self, name) for name in BOUNDED]).any())

    def allowed(self, length: float, clear: float = 0.0) -> list[tuple[float, float]]:
        """Intervals where the middle of an actuator may stand, m.

        Args:
            length: of the structure, m.
            clear: half the extent of an actuator, m.
        """
        zones = tuple((np.array([position(low)]), np.array([position(high)])) for low, high in self.forbidden)
        boxes = self._free(Interval(length), np.array([clear]), zones)
        return sorted((low.item(), high.item()) for low, high in boxes)

    def boxes(self, task: PlacementTask) -> list[Box]:
        """Allowed boxes (low, high) of coordinates, m, checked to have room for actuators; none for named points."""
        domain = task.modes.domain
        if isinstance(domain, Interval):
            intervals = self.intervals(task.n_controlled, domain.length, task.reach[0])
            return [(np.array([low]), np.array([high])) for low, high in intervals]
        if isinstance(domain, NamedPoints):
            if self.forbidden or self.edge_distance:
                raise DesignError("named points have no zones or edges; give the allowed points as candidates")
            if self.spacing and domain.positions is None:
                raise DesignError("the positions of the points are not known, so no spacing can be kept; give them")
            return []
        half = reach(domain, task.actuator.at)[0]
        zones = tuple((np.atleast_1d(low), np.atleast_1d(high)) for low, high in self.forbidden)
        if any(part.shape != (2,) for zone in zones for part in zone):
            raise DesignError(f"a forbidden zone of a rectangle is ((x, y), (x, y)), m; got {self.forbidden}")
        return self._free(domain, half, zones)

    def _free(self, domain: Interval | Rectangle, half: np.ndarray, zones: Sequence[Box]) -> list[Box]:
        """The boxes free of zones for actuators of half-extent (n_coordinates,), m, on a domain."""
        for low, high in zones:
            if (high <= 0).any() or (low >= domain.length).any():
                raise DesignError(
                    f"forbidden zone {low.tolist()} to {high.tolist()} lies outside the structure, {domain}; give it in"
                    " m, or leave it out"
                )
        widened = [(low - half, high + half) for low, high in zones]
        return free_boxes(domain, np.maximum(self.edge_distance, half), widened)

    def intervals(self, n: int, length: float, clear: float = 0.0) -> list[tuple[float, float]]:
        """The intervals of `allowed`, checked to have room for n actuators."""
        margin = max(self.edge_distance, clear)
        needed = 2 * margin + (n - 1) * self.spacing
        if needed > length:
            raise DesignError(
                f"{n} actuators {self.spacing:g} m apart and {margin:g} m from the ends need {needed:g} m; the"
                f" structure has {length:g} m: lower spacing or edge_distance"
            )
        intervals = self.allowed(length, clear)
        spacing, at, fit = max(self.spacing, APART * length), -np.inf, 0
        for low, high in intervals:
            at = max(low, at + spacing)
            while at <= high * (1 + APART) and fit < n:
                fit, at = fit + 1, at + spacing
            at -= spacing
        if fit < n:
            raise DesignError(
                f"of {n} actuators {self.spacing:g} m apart only {fit} find room on the allowed intervals,"
                f" {', '.join(f'{low:g} to {high:g}' for low, high in intervals)} m: forbid less or lower the spacing"
            )
        return intervals

    def violations(self, at: np.ndarray, costs: Any) -> dict[str, np.ndarray]:
        """Relative excess (n_placements,) over each limit by name; <= 0 where it is met.

        Args:
            at: coordinates of the actuators, (n_placements, n) or (n_placements, n, n_coordinates), m.
            costs: effort, peak_force and condition of the placements, (n_placements,) each.
        """
        return self._exceeded(least_distances(at), costs)

    def _exceeded(self, gaps: Any, costs: Any) -> dict[str, Any]:
        excess = {name: _excess(getattr(costs, name), getattr(self, name)) for name in BOUNDED}
        shape = np.shape(gaps)
        return excess | {"spacing": (self.spacing - gaps) / self.spacing if self.spacing > 0 else np.zeros(shape)}

    def satisfied_by(self, placement: Placement) -> bool:
        """Whether a placement at allowed places meets all limits, with its peak force in continuous time."""
        return all(excess <= TOLERANCE for excess in self._exceeded(placement.spacing, placement).values())


FORMER = {"effort_limit": "effort", "peak_limit": "peak_force", "condition_limit": "condition"}
FORMER |= {"margin": "edge_distance", **{name: name for name in ("spacing", "forbidden", "candidates")}}


def takes_former_limits(function: Callable[P, R]) -> Callable[P, R]:
    """The function of (task, limits) that also accepts its former arguments: limits as keywords, placement second."""

    @wraps(function)
    def with_former(*args: P.args, **kwargs: P.kwargs) -> R:
        former = {new: kwargs.pop(old) for old, new in FORMER.items() if old in kwargs}
        if len(args) > 1 and isinstance(args[1], Placement):
            kwargs["placement"] = args[1]
            args = args[:1]  # type: ignore[assignment]
        if former or not (len(args) > 1 or "limits" in kwargs):
            warn(f"{function.__name__} takes (task, limits), limits as Limits(...)", DeprecationWarning, stacklevel=2)
            former["forbidden"] = tuple(former.get("forbidden", ()))  # type: ignore[arg-type]
            kwargs["limits"] = Limits(**former)  # type: ignore[arg-type]
        return function(*args, **kwargs)

    return with_former


def _excess(values: Any, limit: float) -> Any:
    return values / limit - 1.0 if np.isfinite(limit) else np.full(np.shape(values), -1.0)


def conflict(task: PlacementTask, limits: Limits, grid: np.ndarray | None = None) -> str:
    """The message on limits that cannot be met: the one, or the two in conflict, and the least value found.

    Args:
        grid: places to draw from; by default those that the limits allow.
    """
    n, domain = task.n_controlled, task.modes.domain
    if grid is None:
        per_side = SAMPLES if isinstance(domain, Interval) else round(np.sqrt(SAMPLES))
        grid = np.concatenate([_samples(low, high, per_side) for low, high in limits.boxes(task)])
    rng = np.random.default_rng(0)
    draws = np.sort(rng.random((DRAWS, len(grid))).argsort(axis=1)[:, :n], axis=1)
    costs = batch_costs(task, task.shapes(grid)[draws])
    violations = limits.violations(coordinates(domain, grid)[draws], costs)
    within = {name: excess <= TOLERANCE for name, excess in violations.items()}
    headings = dict(zip(BOUNDED, (*command_headings(command_unit([task.actuator])), ""), strict=True))

    def texts(name: str, kept: np.ndarray) -> tuple[str, str, str]:
        """The name of a cost, its limit, and its least value among the placements kept."""
        values = getattr(limits, name), getattr(costs, name)[kept].min()
        limit, least = (in_unit(value, headings[name]) for value in values)
        return _words(name), limit, least

    head = f"no placement of {n} actuators meets the limits"
    spaced, with_spacing, lower = within["spacing"], "", ""
    if limits.spacing > 0:
        with_spacing, lower = f" with a spacing of {limits.spacing:g} m", " or lower the spacing"
    if not spaced.any():
        return f"{head}: a spacing of {limits.spacing:g} m leaves no room; lower the spacing"
    for name in BOUNDED:
        if not (within[name] & spaced).any():
            words, limit, least = texts(name, spaced)
            return (
                f"{head}: the limit of {words} is {limit}{with_spacing}, and the least found was {least}: raise the"
                f" limit of {words}{lower}"
            )
    for first, second in combinations(BOUNDED, 2):
        if not (within[first] & within[second] & spaced).any():
            (one, limit, _), (other, other_limit, least) = (texts(x, within[first] & spaced) for x in (first, second))
            return (
                f"{head}: the limit of {one}, {limit}, and the limit of {other}, {other_limit}, conflict; with the"
                f" first the least {other.removeprefix('the ')} found was {least}: raise one of them"
            )
    return f"{head} together, though any two can be met; raise one of them"


def _words(name: str) -> str:
    """The name of a limited cost, as in: the limit of peak force."""
    return {"condition": "the condition number"}.get(name, name.replace("_", " "))


def _samples(low: np.ndarray, high: np.ndarray, per_side: int) -> np.ndarray:
    """Uniform places over a box: (n_samples,) along an interval, (n_samples, 2) on a rectangle."""
    along = np.meshgrid(*(np.linspace(*ends, per_side) for ends in zip(low, high, strict=True)), indexing="ij")
    return np.squeeze(np.stack(along, axis=-1).reshape(-1, low.size), axis=1 if low.size == 1 else ())
