"""The smallest change that stabilises a loop that spillover destabilises: a lower gain, a place moved, added sensors.

Every change is a new design, and every margin is that of the new loop on the full plant, recomputed.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from workbench.design.estimation.controller import Controller
from workbench.design.laws.law import DesignError
from workbench.design.loop.closed_loop import close_with
from workbench.renamed import former_arguments
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes
from workbench.threads import one_blas_thread

# redesign(actuators, places of the sensors, share of the gain) gives the controller anew
Redesign = Callable[[Sequence[Actuator], Sequence[float], float], Controller]

STEPS = 50
HALVINGS = 14


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
    sensors: tuple[float, ...]
    share: float = 1.0


@former_arguments(most_added="max_added")
@one_blas_thread
def spillover_remedies(
    modes: Modes,
    redesign: Redesign,
    actuators: Sequence[Actuator],
    sensors: Sequence[float],
    *,
    margin: float = 0.0,
    max_added: int = 6,
) -> tuple[Remedy, ...]:
    """One remedy of each kind that has one, each verified on the full plant.

    Args:
        modes: of the full plant.
        redesign: the way the controller was designed.
        actuators, sensors: as they stand; sensors by place, m.
        margin: wanted of the rightmost pole, 1/s; 0 for stability alone.
        max_added: sensors to try.
    """
    start = _Setting(tuple(actuators), tuple(sorted(float(x) for x in sensors)))

    def met(setting: _Setting) -> float:
        """How far the margin exceeds what is wanted; -inf where there is no such design."""
        try:
            loop = close_with(modes, redesign(setting.actuators, setting.sensors, setting.share))
        except (DesignError, ValueError):
            return -np.inf
        return loop.margin - margin

    def remedy(kind: str, change: str, size: float, setting: _Setting) -> Remedy:
        controller = redesign(setting.actuators, setting.sensors, setting.share)
        return Remedy(kind, change, size, close_with(modes, controller).margin, controller)

    def moved(move: Callable[[float], _Setting], way: float, distance: float) -> float:
        return met(move(way * distance))

    found = []
    given_up = _least(lambda size: met(replace(start, share=1.0 - size)), 1.0)
    if given_up is not None:
        setting = replace(start, share=1.0 - given_up)
        found.append(remedy("gain", f"gain lowered to {setting.share:.3f} of itself", given_up, setting))
    for kind, moves in (("actuator", _moved_actuator(start)), ("sensor", _moved_sensor(start))):
        best = None
        for name, at, move in moves:
            for way in (-1.0, 1.0):
                room = at if way < 0 else modes.length - at
                size = _least(partial(moved, move, way), min(room, best[0] if best else room))
                if size is not None and (best is None or size < best[0]):
                    best = size, name, at + way * size, move(way * size)
        if best is not None:
            found.append(remedy(kind, f"{best[1]} moved to x = {best[2]:.4g}", best[0], best[3]))
    added = _added(start, met, modes.length, max_added)
    if added is not None:
        new = sorted(set(added.sensors) - set(start.sensors))
        where = ", ".join(f"{x:.4g}" for x in new)
        found.append(remedy("sensors added", f"{len(new)} sensor(s) more, at x = {where}", len(new), added))
    return tuple(found)


def sufficient_sensors(
    modes: Modes,
    redesign: Redesign,
    actuators: Sequence[Actuator],
    *,
    margin: float = 0.0,
    most: int = 60,
    lasting: int = 3,
) -> tuple[int | None, np.ndarray]:
    """The least number of evenly spaced sensors from which on the margin is met, and the margin with 1, 2, … sensors.

    Args:
        lasting: further numbers of sensors that must meet it too, lest one count be lucky.
    """
    margins = np.full(most, -np.inf)
    for k in range(1, most + 1):
        places = modes.length * np.arange(1, k + 1) / (k + 1)
        try:
            margins[k - 1] = close_with(modes, redesign(tuple(actuators), tuple(places), 1.0)).margin
        except (DesignError, ValueError):
            continue
        if k > lasting and (margins[k - 1 - lasting : k] > margin).all():
            return k - lasting, margins[:k]
    return None, margins


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


def _moved_actuator(start: _Setting) -> Iterator[tuple[str, Any, Callable[[float], _Setting]]]:
    for j, actuator in enumerate(start.actuators):

        def move(distance: float, j: int = j, actuator: Any = actuator) -> _Setting:
            moved = replace(actuator, at=actuator.at + distance)
            return replace(start, actuators=(*start.actuators[:j], moved, *start.actuators[j + 1 :]))

        yield f"actuator {actuator.name}", actuator.at, move


def _moved_sensor(start: _Setting) -> Iterator[tuple[str, float, Callable[[float], _Setting]]]:
    for i, at in enumerate(start.sensors):

        def move(distance: float, i: int = i, at: float = at) -> _Setting:
            return replace(start, sensors=tuple(sorted((*start.sensors[:i], at + distance, *start.sensors[i + 1 :]))))

        yield f"sensor at x = {at:.4g}", at, move


def _added(start: _Setting, met: Callable[[_Setting], float], length: float, most: int) -> _Setting | None:
    """Sensors added one by one, each where it serves best."""
    setting = start
    for _ in range(most):
        candidates = [
            replace(setting, sensors=tuple(sorted((*setting.sensors, x))))
            for x in length * np.arange(1, STEPS) / STEPS
            if min((abs(x - at) for at in setting.sensors), default=length) > 1e-3 * length
        ]
        setting = max(candidates, key=met)
        if met(setting) > 0:
            return setting
    return None
