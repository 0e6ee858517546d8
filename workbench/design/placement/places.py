"""Places on any domain: as arrays, their least distances, and boxes free of forbidden zones."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from workbench.design.laws.law import DesignError
from workbench.structure.domain import SLACK, Domain, Interval, NamedPoints, Rectangle

Box = tuple[np.ndarray, np.ndarray]


def as_places(domain: Domain, places: Any) -> np.ndarray:
    """Places of a domain as an array: (...,) positions in m, (..., 2) pairs in m, or (...,) names."""
    if isinstance(domain, NamedPoints):
        names = np.atleast_1d(np.asarray(places, object))
        domain.locate(names.ravel())
        return names
    if isinstance(domain, Rectangle):
        pairs = np.atleast_2d(np.asarray(places, float))
        domain.locate(pairs.reshape(-1, pairs.shape[-1]))
        return pairs
    return np.atleast_1d(np.asarray(places, float))


def coordinates(domain: Domain, places: np.ndarray) -> np.ndarray:
    """Coordinates of an array of places, m: positions, pairs, or (..., 3) of named points; zeros where not known."""
    if not isinstance(domain, NamedPoints):
        return places
    if domain.positions is None:
        return np.zeros((*places.shape, 3))
    return np.asarray(domain.positions[domain.locate(places.ravel())].reshape(*places.shape, 3))


def least_distances(at: np.ndarray) -> np.ndarray:
    """The least distance (n_placements,) between two places of each placement, m; inf of a single place.

    Args:
        at: (n_placements, n), increasing, or (n_placements, n, n_coordinates), m.
    """
    if at.ndim == 2:
        return np.asarray(np.diff(at, axis=1).min(axis=1, initial=np.inf))
    first, second = np.triu_indices(at.shape[1], 1)
    return np.asarray(np.linalg.norm(at[:, first] - at[:, second], axis=2).min(axis=1, initial=np.inf))


def free_boxes(domain: Interval | Rectangle, margin: np.ndarray, zones: Sequence[Box]) -> list[Box]:
    """The largest boxes (low, high), m, within the margin of a domain, that overlap no forbidden zone.

    The boxes overlap one another; together they cover every allowed place.

    Args:
        domain: an interval or a rectangle.
        margin: (n_coordinates,) from the ends, or from the edges along x and along y, m.
        zones: forbidden boxes, m.
    """
    slack = SLACK * domain.size
    free: list[Box] = [(margin, np.array(domain.length) - margin)]
    for zone_low, zone_high in zones:
        parts: list[Box] = []
        for low, high in free:
            if (zone_low >= high).any() or (zone_high <= low).any():
                parts.append((low, high))
                continue
            # left and right of the zone, below and above it; strips thinner than slack are none
            for axis in range(margin.size):
                before, after = high.copy(), low.copy()
                before[axis], after[axis] = zone_low[axis], zone_high[axis]
                parts += [part for part in ((low, before), (after, high)) if part[1][axis] - part[0][axis] > slack]
        free = [part for i, part in enumerate(parts) if not any(_inside(part, other) for other in parts[:i])]
        free = [part for i, part in enumerate(free) if not any(_inside(part, other) for other in free[i + 1 :])]
    if not free or not all((low <= high).all() for low, high in free):
        raise DesignError(
            f"{margin.max():g} m from the edges and the forbidden zones leave no place of {domain}; lower it or forbid"
            " less"
        )
    return free


def _inside(one: Box, other: Box) -> bool:
    return bool((one[0] >= other[0]).all() and (one[1] <= other[1]).all())


def free_places(domain: Domain, places: np.ndarray, boxes: Sequence[tuple[Any, Any]]) -> np.ndarray:
    """Mask (n_places,) of the places that lie in one of the boxes (low, high); of named points, all."""
    if isinstance(domain, NamedPoints):
        return np.ones(len(places), bool)
    at = places.reshape(len(places), -1)
    slack = 1e-12 * np.max(domain.length)
    inside = [((at >= low - slack) & (at <= high + slack)).all(axis=1) for low, high in boxes]
    return np.asarray(np.any(inside, axis=0))
