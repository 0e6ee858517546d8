"""What touches the structure, at a point or all along: springs, dampers, friction, stops, air, stretching.

A force is positive in the direction of positive displacement w; v is the velocity there.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class LinearSpring:
    """-k w at x, k in N/m; in the rig rather than in the structure, so the modes stay what they are."""

    at: float
    stiffness: float


@dataclass(frozen=True)
class LinearDamper:
    """-c v at x, c in N s/m."""

    at: float
    coefficient: float


@dataclass(frozen=True)
class CubicSpring:
    """-k w³ at x, k in N/m³; negative softens."""

    at: float
    stiffness: float


@dataclass(frozen=True)
class PowerSpring:
    """-F |w / w_r|^p in the direction of w, at x: F (N), negative to soften, at the displacement w_r (m); p ≥ 1."""

    at: float
    force: float
    reference: float
    exponent: float


@dataclass(frozen=True)
class EvenSpring:
    """-F |w / w_r|^p to one side, whichever way w points, at x: F (N) at the displacement w_r (m), p at least 1."""

    at: float
    force: float
    reference: float
    exponent: float


@dataclass(frozen=True)
class PowerDamper:
    """-F |v / v_r|^p in the direction of v, at x: F (N) at the velocity v_r (m/s), p at least 1."""

    at: float
    force: float
    reference: float
    exponent: float


@dataclass(frozen=True)
class Clearance:
    """Springs k (N/m) that touch at w > gap and at w < -gap (m)."""

    at: float
    stiffness: float
    gap: float


@dataclass(frozen=True)
class OneSidedStop:
    """A spring k (N/m) that touches at w > gap (m)."""

    at: float
    stiffness: float
    gap: float


@dataclass(frozen=True)
class CoulombFriction:
    """-F tanh(v / v_s) at x: force F in N, smoothing speed v_s in m/s."""

    at: float
    force: float
    smoothing_speed: float


@dataclass(frozen=True)
class BoucWen:
    """A hysteretic spring -k z at x, z' = v - (|v| z + v |z|) / (2 z_y): k in N/m, yield displacement z_y in m."""

    at: float
    stiffness: float
    yield_displacement: float


@dataclass(frozen=True)
class UserLaw:
    """A force law of the user's own at x.

    Attributes:
        at: m.
        law: force(w, v, parameters) -> N, in plain arithmetic and `math`: it is compiled by numba.
        parameters: up to three numbers handed to it.
    """

    at: float
    law: object
    parameters: tuple[float, ...] = ()


@dataclass(frozen=True)
class AirDrag:
    """-c |v| v per length all along, c in N s²/m³."""

    coefficient: float


@dataclass(frozen=True)
class MidplaneStretching:
    """A tension k ∫ w'² dx, k in N/m, from ends held apart."""

    coefficient: float


@dataclass(frozen=True)
class PeriodicForce:
    """amplitude sin(2π f t + phase) at x, t from the start of the record: N, Hz, rad."""

    at: float
    frequency_hz: float
    amplitude: float
    phase: float


@dataclass(frozen=True)
class RandomForce:
    """An unmeasured random force at x: rms in N. No prediction can hold it, only its statistics."""

    at: float
    rms: float


PointElement = (
    LinearSpring
    | LinearDamper
    | CubicSpring
    | PowerSpring
    | EvenSpring
    | PowerDamper
    | Clearance
    | OneSidedStop
    | CoulombFriction
    | BoucWen
    | UserLaw
)
Element = PointElement | AirDrag | MidplaneStretching | PeriodicForce | RandomForce
