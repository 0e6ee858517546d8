"""Elements attached to a structure, at a point or distributed: springs, dampers, friction, stops, drag, stretching.

A force is positive in the direction of positive displacement w; v is the velocity. An element acts at a place, or
`Between` two: w is then the displacement of the first minus that of the second, on which the opposite force acts.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from workbench.structure.supports import AtPlace


@dataclass(frozen=True)
class PointElement(AtPlace):
    """An element whose force is a function of the displacement and the velocity at its place."""

    @property
    def parameters(self) -> tuple[float, ...]:
        """The parameters of the force law, in the order of the fields."""
        return tuple(getattr(self, field.name) for field in fields(self)[1:])


@dataclass(frozen=True)
class LinearSpring(PointElement):
    """-k w at x, k in N/m; part of the rig, not of the structure, so that the modes do not change."""

    stiffness: float


@dataclass(frozen=True)
class LinearDamper(PointElement):
    """-c v at x, c in N s/m."""

    coefficient: float


@dataclass(frozen=True)
class CubicSpring(PointElement):
    """-k w³ at x, k in N/m³; negative softens."""

    stiffness: float


@dataclass(frozen=True)
class _PowerLaw(PointElement):
    force: float
    reference: float
    exponent: float


@dataclass(frozen=True)
class PowerSpring(_PowerLaw):
    """-F |w / w_r|^p in the direction of w, at x: F (N), negative to soften, at the displacement w_r (m); p ≥ 1."""


@dataclass(frozen=True)
class EvenSpring(_PowerLaw):
    """-F |w / w_r|^p for either sign of w, at x: F (N) at the displacement w_r (m), p at least 1."""


@dataclass(frozen=True)
class PowerDamper(_PowerLaw):
    """-F |v / v_r|^p in the direction of v, at x: F (N) at the velocity v_r (m/s), p at least 1."""


@dataclass(frozen=True)
class Clearance(PointElement):
    """Springs k (N/m) that touch at w > gap and at w < -gap (m)."""

    stiffness: float
    gap: float


@dataclass(frozen=True)
class OneSidedStop(PointElement):
    """A spring k (N/m) that touches at w > gap (m)."""

    stiffness: float
    gap: float


@dataclass(frozen=True)
class CoulombFriction(PointElement):
    """-F tanh(v / v_s) - F_0 at x: force F and offset F_0 in N, smoothing speed v_s in m/s.

    Asymmetric friction, F_+ forward and F_- backward, has F = (F_+ + F_-) / 2 and F_0 = (F_+ - F_-) / 2.
    """

    force: float
    smoothing_speed: float
    offset: float = 0.0


@dataclass(frozen=True)
class BoucWen(PointElement):
    """A hysteretic spring -k z at x, z' = v - (|v| z + v |z|) / (2 z_y): k in N/m, yield displacement z_y in m."""

    stiffness: float
    yield_displacement: float


@dataclass(frozen=True)
class UserLaw(PointElement):
    """A user-defined force law at x.

    Attributes:
        at: m.
        law: force(w, v, parameters) -> N, in plain arithmetic and `math`, since it is compiled by numba.
        parameters: up to three numbers that are passed to the law.
    """

    law: Callable[[float, float, Any], float]
    parameters: tuple[float, ...] = ()


@dataclass(frozen=True)
class AirDrag:
    """-c |v| v per length along the whole structure, c in N s²/m³."""

    coefficient: float


@dataclass(frozen=True)
class MidplaneStretching:
    """A tension k ∫ w'² dx, k in N/m, from ends held apart."""

    coefficient: float


@dataclass(frozen=True)
class PeriodicForce(AtPlace):
    """amplitude sin(2π f t + phase) at x, t from the start of the record: N, Hz, rad."""

    frequency_hz: float
    amplitude: float
    phase: float


@dataclass(frozen=True)
class RandomForce(AtPlace):
    """An unmeasured random force at x: rms in N. Only its statistics can be predicted."""

    rms: float


Element = PointElement | AirDrag | MidplaneStretching | PeriodicForce | RandomForce
