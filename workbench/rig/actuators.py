"""Actuators: where a command becomes a force or a moment, and what it loses on the way."""

from dataclasses import dataclass

import numpy as np

from workbench.structure.domain import Between, Where, same_place


@dataclass(frozen=True)
class Actuator:
    """A point force or moment commanded through an actuator.

    On its way a command u passes hysteresis, gain, dead zone, saturation, rate limit, delay, lag, bias, in that order.

    Attributes:
        name: of the input.
        at: its place on the structure: x (m), (x, y), the name of a point, or `Between` two of these, where it acts
            on the first and, opposite, on the second.
        kind: "force" (N) or "moment" (N m).
        hysteresis_share: of u that goes through z: (1 - share) u + share z, z' = u' - (|u'| z + u' |z|) / (2 width).
        hysteresis_width: the z that large commands come to.
        gain: force per command.
        dead_zone: command (after the gain) below which nothing happens; sign(u) max(|u| - width, 0).
        limit: the force cannot exceed ± this.
        rate_limit: the force cannot change faster than ± this, N/s.
        delay: s.
        time_constant: of a first-order lag, s.
        bias: constant force beside, N.
        direct: a measured force applied without an actuator, such as a hammer; changes of the drive leave it alone.
        direction: of the force, or the axis of the moment, where the structure has more than one at a place.
    """

    name: str
    at: Where
    kind: str = "force"
    gain: float = 1.0
    dead_zone: float = 0.0
    limit: float = np.inf
    delay: float = 0.0
    time_constant: float = 0.0
    direct: bool = False
    hysteresis_share: float = 0.0
    hysteresis_width: float = 1.0
    rate_limit: float = np.inf
    bias: float = 0.0
    direction: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "at", same_place(self.at))
        if self.kind not in ("force", "moment"):
            raise ValueError(f"actuator {self.name}: kind is force or moment; got {self.kind!r}")
        for quantity in ("dead_zone", "delay", "time_constant"):
            if not (np.isfinite(getattr(self, quantity)) and getattr(self, quantity) >= 0):
                raise ValueError(f"actuator {self.name}: {quantity} must be 0 or more; got {getattr(self, quantity)}")
        for quantity in ("limit", "rate_limit", "hysteresis_width"):
            if not getattr(self, quantity) > 0:
                raise ValueError(f"actuator {self.name}: {quantity} must be positive; got {getattr(self, quantity)}")

    @property
    def linear(self) -> bool:
        """Whether the force is a linear function of the command (a delay is not a finite state)."""
        unbounded = np.isinf(self.limit) and np.isinf(self.rate_limit)
        return bool(unbounded and not (self.dead_zone or self.delay or self.hysteresis_share or self.bias))


def piezo_patch(name: str, at: float, *, length: float, gain: float = 1.0) -> Actuator:
    """A piezo patch on a beam: the pair of opposite moments ± gain u at its ends, x = at ± length/2.

    The modal force is gain u (φ_r'(at + length/2) - φ_r'(at - length/2)); Crawley & de Luis, AIAA J. 25 (1987) 1373.

    Args:
        at: its middle, m.
        length: m.
        gain: moment per command, N m/V where the command is a voltage.

    Raises:
        ValueError: a length that is not positive.
    """
    if not (np.isfinite(length) and length > 0):
        raise ValueError(f"piezo patch {name}: its length must be positive; got {length}")
    return Actuator(name, Between(at + 0.5 * length, at - 0.5 * length), kind="moment", gain=gain)
