"""Actuators: from a command to a force or a moment, with their imperfections."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workbench.arrays import Floats
from workbench.renamed import Renamed, former_fields
from workbench.structure.domain import Between, Location, Patch, Place, PlaceError, centred_at, same_place
from workbench.structure.printed import Constructed


@former_fields(kind="quantity")
@dataclass(frozen=True, repr=False)
class Actuator(Constructed):
    """An actuator that exerts a force or a moment.

    A command u passes cross-talk, hysteresis, gain, dead zone, saturation, rate limit, delay, lag and bias, in that
    order.

    Attributes:
        name: of the input.
        at: place on the structure: x (m), (x, y), the name of a point; `Between` two of these, to act on the first and
            in the opposite direction on the second; or a `Patch` of a plate, to act along its edges.
        quantity: "force" (N) or "moment" (N m; of a patch, N m/m).
        hysteresis_share: part of u replaced by z: (1 - share) u + share z, z' = u' - (|u'| z + u' |z|) / (2 width).
        hysteresis_width: limit of |z| for large commands.
        gain: force per command.
        dead_zone: half width of the dead zone, N: force sign(f) max(|f| - dead_zone, 0), f the command times the gain.
        limit: largest |force|.
        rate_limit: largest rate of change of the force, N/s.
        delay: s.
        time_constant: of a first-order lag, s.
        bias: constant force that is added, N.
        direct: a measured force that acts without an actuator between, as of an impact hammer or of a shaker with a
            force transducer; effects on actuators leave it unchanged.
        direction: of the force, or the axis of the moment, where the structure has more than one at a place.
        shape_error: (n_modes,) error of each mode shape, or of its slope, at this place; empty for none.
        crosstalk: (name, share) of other inputs whose commands are added.
    """

    name: str
    at: Location
    quantity: str = "force"
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
    shape_error: tuple[float, ...] = ()
    crosstalk: tuple[tuple[str, float], ...] = ()

    linear = Renamed("has_state_space")

    def __post_init__(self) -> None:
        object.__setattr__(self, "at", same_place(self.at))
        if self.quantity not in ("force", "moment"):
            raise ValueError(f"actuator {self.name}: quantity is force or moment; got {self.quantity!r}")
        if isinstance(self.at, Patch) and self.quantity != "moment":
            raise ValueError(
                f"actuator {self.name} acts by moments along the edges of its patch; give quantity='moment'"
            )
        for name in ("dead_zone", "delay", "time_constant"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"actuator {self.name}: {name} must be 0 or more; got {getattr(self, name)}")
        for name in ("limit", "rate_limit", "hysteresis_width"):
            if not getattr(self, name) > 0:
                raise ValueError(f"actuator {self.name}: {name} must be positive; got {getattr(self, name)}")
        for name, share in self.crosstalk:
            if not np.isfinite(share):
                raise ValueError(
                    f"actuator {self.name}: the share of the command of {name} must be finite; got {share}"
                )
        if self.direct and self.crosstalk:
            raise ValueError(f"actuator {self.name} is a measured force, which takes no share of a command")

    @property
    def has_state_space(self) -> bool:
        """Whether the force is a linear function of the command with finitely many states, so without a delay."""
        unbounded = np.isinf(self.limit) and np.isinf(self.rate_limit)
        return bool(unbounded and not (self.dead_zone or self.delay or self.hysteresis_share or self.bias))


def mixed(actuators: Sequence[Actuator], commands: Floats) -> Floats:
    """Commands (n_actuators, n_samples) with cross-talk; the same array if there is none."""
    if not any(actuator.crosstalk for actuator in actuators):
        return commands
    names, taken = [actuator.name for actuator in actuators], commands.copy()
    for j, actuator in enumerate(actuators):
        for name, share in actuator.crosstalk:
            takes = f"actuator {actuator.name} takes a share of the command of {name!r}, which is"
            if name not in names:
                raise ValueError(f"{takes} no actuator of the rig")
            if actuators[names.index(name)].direct:
                raise ValueError(f"{takes} a measured force without a command")
            taken[j] += share * commands[names.index(name)]
    return taken


def mixing(actuators: Sequence[Actuator]) -> Floats:
    """Cross-talk as a matrix (n_actuators, n_actuators): the command that each actuator takes per command sent."""
    return mixed(actuators, np.eye(len(actuators)))


def linear_actuator(actuator: Actuator) -> Actuator:
    """The actuator with its gain, delay, lag and cross-talk alone."""
    return replace(actuator, dead_zone=0.0, limit=np.inf, rate_limit=np.inf, hysteresis_share=0.0, bias=0.0)


def without_crosstalk(actuators: Sequence[Actuator]) -> tuple[Actuator, ...]:
    """The actuators, each with its own command alone."""
    return tuple(replace(a, crosstalk=()) if a.crosstalk else a for a in actuators)


def force_unit(actuator: Actuator) -> str:
    """Unit of an actuator's force: N, N m, or N m/m of a patch on a plate."""
    return "N" if actuator.quantity == "force" else "N m/m" if isinstance(actuator.at, Patch) else "N m"


def command_unit(actuators: Sequence[Actuator]) -> str:
    """Common unit of the commands: N, N m, or N m/m of patches on a plate; empty if they differ or have gains."""
    units = {"" if a.gain != 1 else force_unit(a) for a in actuators}
    return units.pop() if len(units) == 1 else ""


def piezo_patch(
    name: str, at: Place, *, length: float | tuple[float, float], gain: float = 1.0, direction: str | None = None
) -> Actuator:
    """A piezo patch on a beam or a plate: moments at its ends or along its edges, of opposite sign on opposite sides.

    On a beam ± gain u at x = at ± length/2, and the modal force is gain u (φ_r'(at + length/2) - φ_r'(at - length/2));
    Crawley & de Luis, AIAA J. 25 (1987) 1373. On a plate line moments gain u along its four edges, and the modal force
    is gain u ∮ ∂φ_r/∂n ds, n outward; Dimitriadis, Fuller & Rogers, J. Vib. Acoust. 113 (1991) 100.

    Args:
        name: of the input.
        at: the middle: x, or (x, y) on a plate, m.
        length: m; on a plate (width along x, height along y).
        gain: moment per command, N m/V where the command is a voltage; on a plate moment per length, N m/(m V).
        direction: of a patch on a plate that acts along one pair of edges only: "y" is the axis of the moments on the
            two edges across x, "x" of those on the other two.

    Raises:
        ValueError: a length that is not positive, or one length alone of a patch on a plate.
    """
    sides = np.atleast_1d(np.asarray(length, float))
    on_plate = np.ndim(at) == 1
    if sides.shape != ((2,) if on_plate else (1,)):
        wanted = "a patch on a plate has two, (width, height)" if on_plate else "a patch on a beam has one"
        raise ValueError(f"piezo patch {name}: {wanted}, m; got {length}")
    if not (np.isfinite(sides) & (sides > 0)).all():
        raise ValueError(f"piezo patch {name}: its length must be positive, m; got {length}")
    try:
        x, *y = (float(each) for each in np.atleast_1d(np.asarray(at, float)))
    except (TypeError, ValueError):
        raise PlaceError(
            f"piezo patch {name}: its middle is x along a beam, or (x, y) on a plate; got {at!r}"
        ) from None
    where: Location = Patch(x, *y, *sides.tolist()) if on_plate else centred_at(Between(sides[0], 0.0), x)
    return Actuator(name, where, quantity="moment", gain=gain, direction=direction)
