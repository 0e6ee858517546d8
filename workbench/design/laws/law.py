"""A control law on the modal state of the controlled modes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from workbench.arguments import whole
from workbench.arrays import Floats, Integers
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.rig.statespace import input_matrix
from workbench.structure.domain import Between, NamedPoints, Patch, Rectangle, reach
from workbench.structure.modes import Modes, freeze
from workbench.structure.printed import Printed, counted, place_text

SINGULAR = 1e8  # condition number of B above which it counts as singular
UNMOVED = 1e-9  # of an actuator's largest participation in a mode: below, it does not move the mode
PER_SIDE = 24  # grid points along the longer side of a plate, for an actuator's largest participation


class DesignError(ValueError):
    """A design task without a solution: what conflicts, and the remedy."""


@dataclass(frozen=True, eq=False, repr=False)
class Law(Printed):
    """u = -K x, x = (q_1..q_n, q_1'..q_n') of the controlled modes.

    Attributes:
        gain: (n_actuators, 2 n_controlled) K.
        controlled: (n_controlled,) zero-based indices of the controlled modes among all modes.
        actuators: (n_actuators,) driven by the law.
        name: for tables and plots.
        designed_by: repeats the design with the same settings for other modes, controlled modes and actuators; None
            for a gain given by hand.

    Raises:
        TypeError: a controlled mode that is no number.
        ValueError: a gain of another shape or not finite, or controlled modes that are not distinct whole numbers.
    """

    gain: np.ndarray
    controlled: tuple[int, ...]
    actuators: tuple[Actuator, ...]
    name: str = "law"
    designed_by: Callable[[Modes, Sequence[int], Sequence[Actuator]], "Law"] | None = None

    def __post_init__(self) -> None:
        freeze(self, "gain")
        index = tuple(whole(r, "each of Law.controlled, a mode counted from zero,") for r in self.controlled)
        object.__setattr__(self, "controlled", index)
        object.__setattr__(self, "actuators", tuple(self.actuators))
        shape, expected = self.gain.shape, (len(self.actuators), 2 * len(self.controlled))
        if shape != expected:
            raise ValueError(f"Law.gain must have shape (n_actuators, 2 n_controlled) = {expected}; got {shape}")
        if not np.isfinite(self.gain).all():
            raise ValueError(f"Law.gain must be finite; got {self.gain[~np.isfinite(self.gain)][0]}")
        if not index or len(set(index)) != len(index):
            raise DesignError(f"Law.controlled names one mode or more, each once; got {list(index)}")

    @property
    def n_controlled(self) -> int:
        return len(self.controlled)

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line = f"{self.name}, u = -K x: mode{'s' * (self.n_controlled > 1)} {numbered(self.controlled)} by"
        line += f" {counted(len(self.actuators), 'actuator')}"
        modes = [str(r + 1) for r in self.controlled]
        place = "at" if isinstance(self.actuators[0].at, str) else "position [m]"
        headings = ["actuator", place, *(f"q{r}" for r in modes), *(f"q{r}'" for r in modes)]
        rows = [
            [a.name, place_text(a.at), *(f"{k:.4g}" for k in gains)]
            for a, gains in zip(self.actuators, self.gain, strict=True)
        ]
        return line, headings, rows, ()


def linear(law: object) -> Law:
    """The law, checked to have a gain K, which on-off control does not."""
    if not isinstance(law, Law):
        raise DesignError(
            f"a law u = -K x is needed here, from imsc, imsc_poles, coupled_lqr or coupled_poles; got"
            f" {getattr(law, 'name', type(law).__name__)}, which has no gain K"
        )
    return law


def positive_definite(value: ArrayLike, size: int, what: str) -> np.ndarray:
    """A number, a diagonal (size,) or a matrix (size, size), `what` in words, as a positive definite matrix."""
    given = np.asarray(value, float)
    matrix = given * np.eye(size) if given.ndim == 0 else np.diag(given) if given.ndim == 1 else given
    fits = matrix.shape == (size, size) and np.isfinite(matrix).all()
    if not fits or not np.allclose(matrix, matrix.T) or not (np.linalg.eigvalsh(matrix) > 0).all():
        several = f", {size} positive numbers or a symmetric positive definite {size} x {size} matrix" * (size > 1)
        raise DesignError(f"{what} must be a positive number{several}; got {given}")
    return matrix


def controlled_indices(modes: Modes, controlled: int | Sequence[int]) -> tuple[int, ...]:
    """Zero-based indices from a count of lowest modes or a list, checked to be distinct modes of the structure."""
    n = modes.n_modes
    if isinstance(controlled, int | np.integer):
        if not 1 <= controlled <= n:
            raise DesignError(f"the number of controlled modes is 1 to {n}, those of the model; got {controlled}")
        return tuple(range(controlled))
    index = tuple(map(int, controlled))
    if not index or len(set(index)) != len(index) or min(index) < 0 or max(index) >= n:
        raise DesignError(f"controlled modes {list(index)} are not distinct modes of the {n} at hand (from 0)")
    return index


def weighed_states(omega: Floats) -> Integers:
    """Indices of the states (q_1..q_n, q_1'..q_n') that carry energy: all but the displacements of rigid modes.

    A law that minimises energies does not act on such a displacement, which is therefore no state of the closed loop.
    """
    return np.flatnonzero(np.r_[omega > 0, np.full(omega.size, True)])


def participation(modes: Modes, controlled: Sequence[int], actuators: Sequence[Actuator]) -> np.ndarray:
    """B of the controlled modes, (n_controlled, n_actuators), checked to be of full row rank."""
    actuators = tuple(actuators)
    if len(controlled) > len(actuators):
        raise DesignError(
            f"{len(controlled)} controlled modes need as many actuators; there are {len(actuators)}:"
            " control fewer modes or add actuators"
        )
    b, relative = _inputs(modes, controlled, actuators)
    condition = np.linalg.cond(relative)
    if condition <= SINGULAR:
        return b
    text = modes.domain.text
    for first, second in combinations(actuators, 2):
        alike = (first.quantity, first.direction) == (second.quantity, second.direction)
        if alike and separation(modes, first, second) <= 1e-6:
            raise DesignError(
                f"actuators {first.name} and {second.name} are both at {text(first.at)}, so B is singular;"
                " move one by more than 1e-6 of the length"
            )
    raise DesignError(
        f"B of the controlled modes is singular (condition {condition:.2g}): the actuators at"
        f" {', '.join(text(a.at) for a in actuators)} cannot control modes {[r + 1 for r in controlled]}"
        " independently; move them apart or off a node"
    )


def separation(modes: Modes, first: Actuator | Sensor, second: Actuator | Sensor) -> float:
    """Distance between two actuators or two sensors over the size of the structure."""
    ends = [a.at if isinstance(a.at, Between) else (a.at,) for a in (first, second)]
    if len(ends[0]) != len(ends[1]):
        return 1.0
    return max(modes.domain.separation(one, other) for one, other in zip(*ends))


def controllable_input(modes: Modes, controlled: Sequence[int], actuators: Sequence[Actuator]) -> np.ndarray:
    """B of the controlled modes, (n_controlled, n_actuators), checked that some actuator moves each."""
    return _inputs(modes, controlled, actuators)[0]


def _inputs(modes: Modes, controlled: Sequence[int], actuators: Sequence[Actuator]) -> tuple[Floats, Floats]:
    """B of the controlled modes (n_controlled, n_actuators), and B with each column scaled.

    A column is divided by the actuator's largest participation at any place, so that the condition number does not
    depend on the units of the commands.
    """
    if not actuators:
        raise DesignError("there are no actuators to control with; add one")
    index = list(controlled)
    b = input_matrix(modes, actuators)[index]
    possible = np.array([_largest_participation(modes, actuator)[index] for actuator in actuators]).T
    unit = np.maximum(possible.max(axis=0, initial=0.0), np.finfo(float).tiny)
    relative, possible = b / unit, possible / unit
    for row, most, r in zip(relative, possible, controlled, strict=True):
        if np.abs(row).max() < UNMOVED * most.max():
            raise DesignError(f"mode {r + 1} is uncontrollable: all actuators are at its nodes; move one")
    return b, relative


def _largest_participation(modes: Modes, actuator: Actuator) -> Floats:
    """The largest participation of each mode (n_modes,) in an actuator's command, over all places."""
    domain, moment = modes.domain, actuator.quantity == "moment"
    if isinstance(domain, NamedPoints):
        shapes = modes.phi(domain.rotations() if moment else domain.grid())
    elif isinstance(domain, Rectangle) and isinstance(actuator.at, Patch):
        middles = np.clip(domain.grid(PER_SIDE), *reach(domain, actuator.at))
        patches = np.hstack([middles, np.broadcast_to(actuator.at[2:], middles.shape)])
        shapes = modes.edge_slopes(patches, direction=actuator.direction)
    elif isinstance(domain, Rectangle):
        shapes = modes.phi(domain.grid(PER_SIDE), int(moment), direction=actuator.direction)
    else:
        shapes = modes.phi(np.linspace(0.0, modes.length, 8 * modes.n_modes + 9), int(moment))
    return np.asarray(abs(actuator.gain) * np.abs(shapes).max(axis=0))


def numbered(indices: Sequence[int]) -> str:
    """Text of zero-based modes, counted from one: "1 to 4", or "1, 2, 5"."""
    if len(indices) > 2 and list(indices) == list(range(indices[0], indices[-1] + 1)):
        return f"{indices[0] + 1} to {indices[-1] + 1}"
    return ", ".join(str(r + 1) for r in indices)
