"""Boundary conditions of a structure, and masses, springs and dampers attached to it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from workbench.structure.domain import Location, same_place

HELD = np.inf


@dataclass(frozen=True)
class _Support:
    translation: float
    rotation: float = 0.0

    def __post_init__(self) -> None:
        for name in ("translation", "rotation"):
            if not getattr(self, name) >= 0:
                what = type(self).__name__.lower()
                raise ValueError(f"the {name} stiffness of an {what} must be 0 or more; got {getattr(self, name)}")


@dataclass(frozen=True)
class End(_Support):
    """An end of a structure: stiffness against translation (N/m) and rotation (N m/rad); 0 is free, inf is held."""


NAMED_ENDS = {
    "hinged": End(HELD, 0.0),
    "clamped": End(HELD, HELD),
    "free": End(0.0, 0.0),
    "sliding": End(0.0, HELD),
    "fixed": End(HELD, 0.0),
}


@dataclass(frozen=True)
class Edge(_Support):
    """An edge of a plate: stiffness against displacement (N/m per m) and rotation about it (N m/rad per m).

    0 is free, inf is held.
    """


NAMED_EDGES = {
    "simply supported": Edge(HELD, 0.0),
    "clamped": Edge(HELD, HELD),
    "free": Edge(0.0, 0.0),
    "guided": Edge(0.0, HELD),
    "fixed": Edge(HELD, 0.0),
}
SIDES = ("left", "right", "bottom", "top")
Support = TypeVar("Support", End, Edge)


def as_end(end: str | End, *, allowed: tuple[str, ...]) -> End:
    """An `End` from its name, or itself; a name that the structure does not have is refused by a `ValueError`."""
    return end if isinstance(end, End) else _named(end, NAMED_ENDS, allowed, "an end")


def as_edges(edges: str | Edge | Mapping[str, str | Edge], *, allowed: tuple[str, ...]) -> dict[str, Edge]:
    """Left (x = 0), right, bottom (y = 0) and top edge, from one for all four or from a mapping of the four."""
    each = dict(edges) if isinstance(edges, Mapping) else dict.fromkeys(SIDES, edges)
    if set(each) != set(SIDES):
        got = ", ".join(map(str, each)) or "none"
        raise ValueError(f"edges are given for {', '.join(SIDES)}, or one for all; got {got}")
    return {
        side: edge if isinstance(edge := each[side], Edge) else _named(edge, NAMED_EDGES, allowed, f"the {side} edge")
        for side in SIDES
    }


def _named(name: str, named: Mapping[str, Support], allowed: tuple[str, ...], what: str) -> Support:
    if name not in allowed:
        kind = type(named["free"]).__name__
        raise ValueError(f"{what} is one of {', '.join(allowed)} or an {kind}(translation, rotation); got {name!r}")
    return named[name]


def support_text(support: End | Edge, allowed: tuple[str, ...]) -> str:
    """Text of an end or an edge: its name, those that the structure has first, or its stiffnesses."""
    named, *units = (NAMED_EDGES, "N/m²", "N") if isinstance(support, Edge) else (NAMED_ENDS, "N/m", "N m")
    springs = f"on springs of {support.translation:g} {units[0]} and {support.rotation:g} {units[1]}"
    return next((name for name in (*allowed, *named) if named[name] == support), springs)


@dataclass(frozen=True)
class AtPlace:
    """A part at a place, or between two; the place is stored in the form of `same_place`."""

    at: Location

    def __post_init__(self) -> None:
        object.__setattr__(self, "at", same_place(self.at))


class _Attached(AtPlace):
    """An attachment of a structure; a coefficient that is not finite is refused by a `ValueError`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in vars(self).items():
            if name != "at" and not np.isfinite(value):
                raise ValueError(f"the {name.replace('_', ' ')} of a {type(self).__name__} must be finite; got {value}")

    @property
    def pair(self) -> tuple[float, float]:
        """The coefficients of displacement and of rotation."""
        _, linear, angular = vars(self).values()
        return linear, angular


@dataclass(frozen=True)
class PointMass(_Attached):
    """A rigid body attached at a point: mass (kg) and rotary inertia (kg m²) about that point."""

    mass: float
    rotary_inertia: float = 0.0


@dataclass(frozen=True)
class PointSpring(_Attached):
    """A linear spring from a point to ground: against translation (N/m) and rotation (N m/rad)."""

    stiffness: float
    rotational_stiffness: float = 0.0


@dataclass(frozen=True)
class PointDamper(_Attached):
    """A viscous damper from a point to ground: against translation (N s/m) and rotation (N m s/rad)."""

    coefficient: float
    rotational_coefficient: float = 0.0


Attachment = PointMass | PointSpring | PointDamper


def masses_among(attachments: Iterable[Attachment]) -> tuple[PointMass, ...]:
    """The masses among the attachments."""
    return tuple(part for part in attachments if isinstance(part, PointMass))
