"""A test by an impulse: its place, size and length, and the modal speeds just after it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from workbench.design.laws.law import DesignError
from workbench.design.loop.rig_loop import LoopTest
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import MEASURED
from workbench.rig.statespace import input_matrix, output_matrix
from workbench.robust.compensation import check_rate
from workbench.structure.domain import Between, Domain, Location, NamedPoints, Patch
from workbench.structure.modes import Modes

PERIODS = 25  # of the lowest controlled mode: the length of a test
MOST_SAMPLES = 6000
UNMOVED, GRID = 1e-9, 33  # a place does not move below this share of the largest displacement; points to find that


def impulse_test(
    rig: Rig,
    controlled: Sequence[int],
    sample_time: float,
    impulse_at: Location | None = None,
    *,
    level: np.ndarray | None = None,
    seed: int | None = 0,
) -> LoopTest:
    """A test by an impulse, with the free motion after it for 25 periods of the lowest controlled mode.

    Args:
        rig: nominal.
        controlled: zero-based modes.
        sample_time: s.
        impulse_at: the place; by default that of a hammer or of the first actuator. If that excites none of the
            controlled modes, as at a clamp turned by a motor, the place where all of them move most.
        level: (n_outputs,) peak readings of the nominal rig without control, to which the impulse is scaled (by the
            median of the sensors); None for a unit impulse.
        seed: of the noise.

    Raises:
        DesignError: rigid modes alone, a sample time too long for the modes, or a place where none of them moves.
        ValueError: a place outside the structure.
    """
    check_rate(rig.modes, controlled, sample_time)
    omega = rig.modes.omega[list(controlled)]
    omega = omega[omega > 0]
    if not omega.size:
        raise DesignError("the controlled modes are all rigid, so they have no period: give the test")
    impulse_at = _impulse_place(rig, controlled, impulse_at)
    shape = rig.modes.phi_at(impulse_at)
    n_samples = int(min(max(PERIODS * 2.0 * np.pi / omega.min() / sample_time, 64), MOST_SAMPLES))
    test = LoopTest(n_samples, sample_time, impulse_at, seed=seed)
    if level is None:
        return test
    damped, speeds = np.exp(-0.5 * np.diag(rig.modes.damping)[:, None] * test.time), shape[:, None]
    omega = np.maximum(rig.modes.omega, 1e-9)[:, None]
    motion = damped * np.sin(omega * test.time) * (speeds / omega), damped * np.cos(omega * test.time) * speeds
    orders, rows = [MEASURED[s.quantity][1] for s in rig.sensors], output_matrix(rig.modes, rig.sensors)
    peaks = [
        reached / max(np.abs(row @ motion[order]).max(), 1e-300)
        for order, row, reached in zip(orders, rows, level, strict=True)
        if order < 2
    ]
    return replace(test, impulse=float(np.median(peaks)) if peaks else 1.0)


def _impulse_place(rig: Rig, controlled: Sequence[int], given: Location | None) -> Location:
    """A place where an impulse moves the controlled modes: the given one, or by default that of `impulse_test`."""
    places = rig.modes.domain.grid(GRID)
    shapes = np.abs(rig.modes.phi(places))
    at = given
    if at is None:
        at = _place_of(rig.modes.domain, next((a for a in rig.actuators if a.direct), rig.actuators[0]))
    patch = isinstance(at, Patch)  # acts by moments along its edges, so that an impulse there is not defined
    if not patch and np.abs(rig.modes.phi_at(at)[list(controlled)]).max() > UNMOVED * shapes.max():
        return at
    if given is not None:
        raise DesignError(
            f"an impulse at {rig.modes.domain.text(at)} excites none of the controlled modes, so it tests no"
            " controller; choose another place"
        )
    moved = shapes[:, list(controlled)]
    most: Location = places[int((moved / np.maximum(moved.max(axis=0), 1e-300)).min(axis=1).argmax())]
    return most


def _place_of(domain: Domain, exciter: Actuator) -> Location:
    """The place of an actuator; of a node with a direction, the point that moves in that direction."""
    if not isinstance(domain, NamedPoints) or exciter.direction is None:
        return exciter.at
    places = exciter.at if isinstance(exciter.at, Between) else (exciter.at,)
    names, _, _ = domain.slope(list(places), int(exciter.quantity == "moment"), exciter.direction)
    return Between(*names) if isinstance(exciter.at, Between) else names[0]


def impulse_speeds(
    modes: Modes, index: Sequence[int], impulse: float, at: Location | None, actuator: Actuator
) -> np.ndarray:
    """|q_r'| (n_index,) just after an impulse, N s, at a place or by the actuator; at least a tenth of the largest."""
    shape = input_matrix(modes, [replace(actuator, gain=1.0, crosstalk=())])[:, 0] if at is None else modes.phi_at(at)
    speeds = np.abs(impulse * shape[list(index)])
    return np.asarray(np.maximum(speeds, 0.1 * speeds.max()))
