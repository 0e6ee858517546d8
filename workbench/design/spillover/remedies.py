"""The smallest change that stabilises a loop that spillover destabilises: a lower gain, a place moved, added sensors.

Every change is a new design, and every margin is that of the new loop on the full plant, recomputed.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from workbench.design.estimation.controller import Controller
from workbench.design.laws.law import DesignError
from workbench.design.loop.closed_loop import close_with, rounding
from workbench.renamed import former_arguments
from workbench.rig.actuators import Actuator
from workbench.structure.domain import Between, Domain, NamedPoints, Place, Where, centred_at, middle, reach, same_place
from workbench.structure.modes import Modes
from workbench.structure.printed import counted
from workbench.threads import one_blas_thread

# redesign(actuators, places of the sensors, share of the gain) gives the controller anew
Redesign = Callable[[Sequence[Actuator], Sequence[Any], float], Controller]

STEPS = 50
HALVINGS = 14
PER_SIDE = 12  # places along the longer side of a plate where a sensor may be added
APART = 1e-3  # of the size: nearer to another, a sensor reads the same


@dataclass(frozen=True, eq=False)
class Remedy:
    """The smallest change of one kind that stabilises the loop.

    Attributes:
        kind: "gain", "actuator", "sensor" or "sensors added".
        change: in words.
        size: share of the gain given up, m moved, or number of sensors added.
        margin: of the loop with the change, 1/s.
        controller: with the change.
    """

    kind: str
    change: str
    size: float
    margin: float
    controller: Controller


@dataclass(frozen=True)
class _Setting:
    actuators: tuple[Actuator, ...]
    sensors: tuple[Place, ...]
    share: float = 1.0


@former_arguments(most_added="max_added")
@one_blas_thread
def spillover_remedies(
    modes: Modes,
    redesign: Redesign,
    actuators: Sequence[Actuator],
    sensors: Sequence[Place],
    *,
    margin: float = 0.0,
    max_added: int = 6,
) -> tuple[Remedy, ...]:
    """One remedy of each kind that has one, each verified on the full plant; none where the loop needs none.

    A place is moved along the structure, on a rectangle along one of its sides, and among named points to another point
    of its direction. What acts between two points or pairs is not moved, nor is anything where positions are not known.

    Args:
        modes: of the full plant.
        redesign: the way the controller was designed.
        actuators, sensors: as they stand; sensors by place: x or (x, y) in m, or names of points.
        margin: wanted of the rightmost pole, 1/s; 0 for no growth, which a marginally stable loop has too.
        max_added: sensors to try.

    Raises:
        PlaceError: a sensor where the structure has no place.
    """
    domain = modes.domain
    for at in sensors:
        domain.locate(at)
    start = _Setting(tuple(actuators), tuple(sorted(same_place(at) for at in sensors)))

    def met(setting: _Setting) -> float:
        """How far the margin exceeds what is wanted, and more than by rounding; -inf where there is no such design."""
        found, by = _margin(modes, redesign, setting)
        return found - by - margin

    def remedy(kind: str, change: str, size: float, setting: _Setting) -> Remedy:
        controller = redesign(setting.actuators, setting.sensors, setting.share)
        return Remedy(kind, change, size, close_with(modes, controller).margin, controller)

    # a marginally stable loop does not grow: no change of rounding alone is a remedy
    if sum(_margin(modes, redesign, start)) >= margin:
        return ()
    found = []
    given_up = _least(lambda size: met(replace(start, share=1.0 - size)), 1.0)
    if given_up is not None:
        setting = replace(start, share=1.0 - given_up)
        found.append(remedy("gain", f"gain lowered to {setting.share:.3f} of itself", given_up, setting))
    for kind, movable in (("actuator", _actuators(start)), ("sensor", _sensors(start, domain))):
        best: tuple[float, str, _Setting] | None = None
        for name, where, put in movable:

            def met_at(at: Where, put: Callable[[Any], _Setting] = put) -> float:
                return met(put(at))

            moved = _least_move(domain, where, met_at, best[0] if best else np.inf)
            if moved is not None:
                text = domain.text(middle(moved[1]), digits=4)
                best = moved[0], f"{name} moved to {text}", put(moved[1])
        if best is not None:
            found.append(remedy(kind, best[1], best[0], best[2]))
    added = _added(start, met, domain, max_added)
    if added is not None:
        new = [at for at in added.sensors if at not in start.sensors]
        where = ", ".join(domain.text(at, digits=4) for at in new)
        found.append(remedy("sensors added", f"{counted(len(new), 'sensor')} more, at {where}", len(new), added))
    return tuple(found)


def sufficient_sensors(
    modes: Modes,
    redesign: Redesign,
    actuators: Sequence[Actuator],
    *,
    most: int = 60,
) -> tuple[int | None, np.ndarray]:
    """The least number of evenly spaced sensors from which on the loop is stable, and the margin with 1, 2, … sensors.

    Three further numbers of sensors must do too, lest one count be lucky.
    """
    margins, enough = np.full(most, -np.inf), np.zeros(most)
    for k in range(1, most + 1):
        places = modes.length * np.arange(1, k + 1) / (k + 1)
        margins[k - 1], enough[k - 1] = _margin(modes, redesign, _Setting(tuple(actuators), tuple(places)))
        if k > 3 and (margins[k - 4 : k] > enough[k - 4 : k]).all():
            return k - 3, margins[:k]
    return None, margins


def _margin(modes: Modes, redesign: Redesign, setting: _Setting) -> tuple[float, float]:
    """The margin of a design and what rounding may make of it; -inf where there is no such design."""
    try:
        loop = close_with(modes, redesign(setting.actuators, setting.sensors, setting.share))
    except (DesignError, ValueError):
        return -np.inf, 0.0
    return loop.margin, rounding(loop.poles)


def _least(met: Callable[[float], float], most: float) -> float | None:
    """The least size in (0, most) from which on `met` is positive, to a hair: steps outwards, then halvings."""
    below = 0.0
    for step in range(1, STEPS):
        size = most * step / STEPS
        if met(size) > 0:
            above = size
            for _ in range(HALVINGS):
                middle = 0.5 * (below + above)
                below, above = (below, middle) if met(middle) > 0 else (middle, above)
            return above
        below = size
    return None


def _least_move(domain: Domain, where: Where, met: Callable[[Where], float], most: float) -> tuple[float, Where] | None:
    """The least distance, m, less than a bound, by which a place is to be moved, and where it is then."""
    if isinstance(domain, NamedPoints):
        near = (other for other in _others(domain, where) if other[0] < most)
        return next(((distance, name) for distance, name in near if met(name) > 0), None)
    best = None
    for room, moved in _ways(domain, where):
        size = _least(lambda distance, moved=moved: met(moved(distance)), min(room, best[0] if best else most))  # type: ignore[misc]
        if size is not None:
            best = size, moved(size)
    return best


def _ways(domain: Domain, where: Where) -> Iterator[tuple[float, Callable[[float], Where]]]:
    """How far a place can be moved each way along each coordinate, m, and where it is then."""
    if isinstance(domain, NamedPoints) or (isinstance(where, Between) and len(domain.coordinates) > 1):
        return
    at, (low, high) = np.atleast_1d(np.asarray(middle(where), float)), reach(domain, where)
    for axis, way in product(range(at.size), (-1.0, 1.0)):

        def moved(distance: float, axis: int = axis, way: float = way) -> Where:
            return centred_at(where, same_place(at + way * distance * (np.arange(at.size) == axis)))

        yield float(at[axis] - low[axis] if way < 0 else high[axis] - at[axis]), moved


def _others(domain: NamedPoints, where: Where) -> list[tuple[float, str]]:
    """Distances of the other points of the same direction, m, nearest first, with their names."""
    if domain.positions is None or not isinstance(where, str):
        return []
    (own,) = domain.locate(where)
    far = np.linalg.norm(domain.positions - domain.positions[own], axis=1)
    alike = [i for i, way in enumerate(domain.directions) if way == domain.directions[own] and i != own]
    return sorted((float(far[i]), domain.names[i]) for i in alike)


def _actuators(start: _Setting) -> Iterator[tuple[str, Where, Callable[[Any], _Setting]]]:
    """Each actuator, where it stands, and the setting with it elsewhere."""
    for j, actuator in enumerate(start.actuators):

        def put(at: Where, j: int = j, actuator: Actuator = actuator) -> _Setting:
            return replace(start, actuators=(*start.actuators[:j], replace(actuator, at=at), *start.actuators[j + 1 :]))

        yield f"actuator {actuator.name}", actuator.at, put


def _sensors(start: _Setting, domain: Domain) -> Iterator[tuple[str, Where, Callable[[Any], _Setting]]]:
    """The same of each sensor."""
    for i, at in enumerate(start.sensors):

        def put(there: Place, i: int = i) -> _Setting:
            return replace(start, sensors=tuple(sorted((*start.sensors[:i], there, *start.sensors[i + 1 :]))))

        yield f"sensor at {domain.text(at, digits=4)}", at, put


def _added(start: _Setting, met: Callable[[_Setting], float], domain: Domain, most: int) -> _Setting | None:
    """Sensors added one by one, each where it serves best."""
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
        setting = max(candidates, key=met)
        if met(setting) > 0:
            return setting
    return None
