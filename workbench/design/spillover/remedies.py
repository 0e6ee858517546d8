"""The smallest change that stabilises a loop unstable by spillover: a lower gain, a place moved, or added sensors.

Every change is a new design, and every decay rate is that of its loop on the full plant.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from workbench.design.estimation.controller import Controller
from workbench.design.loop.closed_loop import close_with, rounding
from workbench.renamed import former_arguments, former_fields
from workbench.rig.actuators import Actuator
from workbench.structure.domain import (
    Between,
    Domain,
    Interval,
    Location,
    NamedPoints,
    Place,
    Rectangle,
    centred_at,
    middle,
    reach,
    same_place,
)
from workbench.structure.modes import Modes
from workbench.structure.printed import counted
from workbench.threads import one_blas_thread

# redesign(actuators, places of the sensors, factor of the gain) gives a controller
Redesign = Callable[[Sequence[Actuator], Sequence[Any], float], Controller]

STEPS = 50  # of the scan of sizes of a change; also places along a structure where a sensor may be added
HALVINGS = 14  # of the bisection of the smallest size
PER_SIDE = 12  # places along the longer side of a plate where a sensor may be added
APART = 1e-3  # of the size of the structure: least distance of an added sensor from others


@former_fields(margin="decay_rate")
@dataclass(frozen=True, eq=False)
class Remedy:
    """The smallest change of one kind that stabilises the loop.

    Attributes:
        kind: "gain", "actuator", "sensor" or "sensors added".
        change: in words.
        size: relative reduction of the gain, distance moved in m, or number of sensors added.
        decay_rate: of the slowest pole of the loop with the change, 1/s.
        controller: with the change.
    """

    kind: str
    change: str
    size: float
    decay_rate: float
    controller: Controller


@dataclass(frozen=True)
class _Setting:
    """Arguments of a redesign: actuators, places of the sensors, and the factor of the gain."""

    actuators: tuple[Actuator, ...]
    sensors: tuple[Place, ...]
    share: float = 1.0


@former_arguments(most_added="max_added", margin="decay_rate")
@one_blas_thread
def spillover_remedies(
    modes: Modes,
    redesign: Redesign,
    actuators: Sequence[Actuator],
    sensors: Sequence[Place],
    *,
    decay_rate: float = 0.0,
    max_added: int = 6,
) -> tuple[Remedy, ...]:
    """The smallest remedy of each kind, each verified on the full plant; empty where the loop decays as fast already.

    A place is moved along the structure, on a rectangle along one of its sides, and among named points to another point
    of the same direction. Actuators between two points or pairs, and points of unknown position, are not moved.

    Args:
        modes: of the full plant.
        redesign: repeats the design of the controller for other actuators, sensors and gain.
        actuators, sensors: of the design; sensors by place: x or (x, y) in m, or names of points.
        decay_rate: wanted of the slowest pole, 1/s; with 0 marginal stability is enough.
        max_added: largest number of sensors to add.

    Raises:
        PlaceError: a sensor where the structure has no place.
    """
    domain = modes.domain
    for at in sensors:
        domain.locate(at)
    start = _Setting(tuple(actuators), tuple(sorted(same_place(at) for at in sensors)))

    def excess(setting: _Setting) -> float:
        """Decay rate less rounding less the wanted one, 1/s; -inf where the design fails."""
        achieved, tolerance = _decay_rate(modes, redesign, setting)
        return achieved - tolerance - decay_rate

    def remedy(kind: str, change: str, size: float, setting: _Setting) -> Remedy:
        controller = redesign(setting.actuators, setting.sensors, setting.share)
        return Remedy(kind, change, size, close_with(modes, controller).decay_rate, controller)

    # a marginally stable loop needs no remedy where the wanted decay rate is 0
    if sum(_decay_rate(modes, redesign, start)) >= decay_rate:
        return ()
    remedies = []
    reduction = _smallest(lambda size: excess(replace(start, share=1.0 - size)), 1.0)
    if reduction is not None:
        share = 1.0 - reduction
        remedies.append(remedy("gain", f"gain scaled by {share:.3f}", reduction, replace(start, share=share)))
    for kind, movable in (("actuator", _actuators(start)), ("sensor", _sensors(start, domain))):
        best: tuple[str, float, _Setting] | None = None
        for name, where, put in movable:
            least = best[1] if best else np.inf
            moved = _smallest_move(domain, where, lambda at, put=put: excess(put(at)), least)  # type: ignore[misc]
            if moved is not None:
                distance, end = moved
                best = f"{name} moved to {domain.text(middle(end), digits=4)}", distance, put(end)
        if best is not None:
            remedies.append(remedy(kind, *best))
    added = _added(start, excess, domain, max_added)
    if added is not None:
        new = [at for at in added.sensors if at not in start.sensors]
        where = ", ".join(domain.text(at, digits=4) for at in new)
        remedies.append(remedy("sensors added", f"{counted(len(new), 'sensor')} more, at {where}", len(new), added))
    return tuple(remedies)


@former_arguments(most="max_sensors")
def sufficient_sensors(
    modes: Modes, redesign: Redesign, actuators: Sequence[Actuator], *, max_sensors: int = 60
) -> tuple[int | None, np.ndarray]:
    """The least number of evenly spaced sensors that stabilises the loop, and the decay rates of 1, 2, … sensors, 1/s.

    The next three numbers of sensors must stabilise it too. None if no number up to `max_sensors` does.
    """
    rates, tolerances = np.full(max_sensors, -np.inf), np.zeros(max_sensors)
    for k in range(1, max_sensors + 1):
        places = modes.length * np.arange(1, k + 1) / (k + 1)
        rates[k - 1], tolerances[k - 1] = _decay_rate(modes, redesign, _Setting(tuple(actuators), tuple(places)))
        if k > 3 and (rates[k - 4 : k] > tolerances[k - 4 : k]).all():
            return k - 3, rates[:k]
    return None, rates


def _decay_rate(modes: Modes, redesign: Redesign, setting: _Setting) -> tuple[float, float]:
    """The decay rate of a design and its rounding error, 1/s; -inf where the design fails."""
    try:
        loop = close_with(modes, redesign(setting.actuators, setting.sensors, setting.share))
    except ValueError:
        return -np.inf, 0.0
    return loop.decay_rate, rounding(loop.poles)


def _smallest(excess: Callable[[float], float], most: float) -> float | None:
    """The smallest size in (0, most) with a positive excess, by a scan and bisection; None if the scan meets none."""
    below = 0.0
    for step in range(1, STEPS):
        size = most * step / STEPS
        if excess(size) > 0:
            above = size
            for _ in range(HALVINGS):
                middle = 0.5 * (below + above)
                below, above = (below, middle) if excess(middle) > 0 else (middle, above)
            return above
        below = size
    return None


def _smallest_move(
    domain: Domain, where: Location, excess: Callable[[Location], float], most: float
) -> tuple[float, Location] | None:
    """The smallest move of a place with a positive excess: its distance, below `most`, m, and the new place."""
    if isinstance(domain, NamedPoints):
        near = (other for other in _others(domain, where) if other[0] < most)
        return next(((distance, name) for distance, name in near if excess(name) > 0), None)
    best = None
    for room, moved in _directions(domain, where):
        size = _smallest(lambda distance, moved=moved: excess(moved(distance)), min(room, best[0] if best else most))  # type: ignore[misc]
        if size is not None:
            best = size, moved(size)
    return best


def _directions(domain: Interval | Rectangle, where: Location) -> Iterator[tuple[float, Callable[[float], Location]]]:
    """For each direction along each coordinate: the largest distance of a move, m, and the new place by distance."""
    if isinstance(where, Between) and len(domain.coordinates) > 1:
        return
    at, (low, high) = np.atleast_1d(np.asarray(middle(where), float)), reach(domain, where)
    for axis, sign in product(range(at.size), (-1.0, 1.0)):

        def moved(distance: float, axis: int = axis, sign: float = sign) -> Location:
            return centred_at(where, same_place(at + sign * distance * (np.arange(at.size) == axis)))

        yield float(at[axis] - low[axis] if sign < 0 else high[axis] - at[axis]), moved


def _others(domain: NamedPoints, where: Location) -> list[tuple[float, str]]:
    """Distances of the other points of the same direction, m, nearest first, with their names."""
    if domain.positions is None or not isinstance(where, str):
        return []
    (own,) = domain.locate(where)
    distances = np.linalg.norm(domain.positions - domain.positions[own], axis=1)
    parallel = [i for i, way in enumerate(domain.directions) if way == domain.directions[own] and i != own]
    return sorted((float(distances[i]), domain.names[i]) for i in parallel)


def _actuators(start: _Setting) -> Iterator[tuple[str, Location, Callable[[Any], _Setting]]]:
    """Of each actuator: its name, its place, and the setting as a function of another place."""
    for j, actuator in enumerate(start.actuators):

        def put(at: Location, j: int = j, actuator: Actuator = actuator) -> _Setting:
            return replace(start, actuators=(*start.actuators[:j], replace(actuator, at=at), *start.actuators[j + 1 :]))

        yield f"actuator {actuator.name}", actuator.at, put


def _sensors(start: _Setting, domain: Domain) -> Iterator[tuple[str, Location, Callable[[Any], _Setting]]]:
    """Of each sensor: its name, its place, and the setting as a function of another place."""
    for i, at in enumerate(start.sensors):

        def put(there: Place, i: int = i) -> _Setting:
            return replace(start, sensors=tuple(sorted((*start.sensors[:i], there, *start.sensors[i + 1 :]))))

        yield f"sensor at {domain.text(at, digits=4)}", at, put


def _added(start: _Setting, excess: Callable[[_Setting], float], domain: Domain, most: int) -> _Setting | None:
    """The setting with sensors added one by one, each where the decay rate is largest; None where `most` fail."""
    setting = start
    grid = domain.grid(STEPS if len(domain.coordinates) == 1 else PER_SIDE)
    for _ in range(most):
        candidates = [
            replace(setting, sensors=tuple(sorted((*setting.sensors, x))))
            for x in grid
            if x not in setting.sensors
            and (isinstance(x, str) or min((domain.separation(x, at) for at in setting.sensors), default=1.0) > APART)
        ]
        if not candidates:
            return None
        setting = max(candidates, key=excess)
        if excess(setting) > 0:
            return setting
    return None
