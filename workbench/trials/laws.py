"""Hidden force laws at a point: the force, its parameters in a label, and the draw of these.

A new law needs a code, a line in `law_force`, and an entry in `POINT_LAWS`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

DAMPER, CUBIC, CLEARANCE, STOP, FRICTION, BOUC_WEN, QUADRATIC, QUINTIC, CUBIC_DAMPER, SQUEEZE, MAGNET = range(11)
SLIDING, QUADRATIC_DAMPER = range(11, 13)
BOTH_WAYS = ("force_forward", "force_backward")


@njit(cache=True)
def law_force(code: int, p: np.ndarray, w: float, v: float, z: float) -> Any:
    """Force of a law at a point, from displacement, velocity and hysteretic variable there."""
    if code == DAMPER:
        return -p[0] * v
    if code == CUBIC:
        return -p[0] * w**3
    if code == CLEARANCE:
        return -p[0] * (max(w - p[1], 0.0) + min(w + p[1], 0.0))
    if code == STOP:
        return -p[0] * max(w - p[1], 0.0)
    if code == FRICTION:
        return -p[0] * np.tanh(v / p[1])
    if code == BOUC_WEN:
        return -p[0] * z
    if code == QUADRATIC:
        return -p[0] * w * abs(w)
    if code == QUINTIC:
        return -p[0] * w**5
    if code == CUBIC_DAMPER:
        return -p[0] * v**3
    if code == SQUEEZE:
        return -p[0] * w * w * v
    if code == SLIDING:
        return -0.5 * (p[0] + p[1]) * np.tanh(v / p[2]) - 0.5 * (p[0] - p[1])
    if code == QUADRATIC_DAMPER:
        return -p[0] * abs(v) * v
    return p[0] * w / (1.0 + (w / p[1]) ** 2) ** 2


@dataclass(frozen=True)
class PointSizes:
    """Typical sizes at a point: a stiffness (N/m), rms displacement (m) and velocity (m/s), and a force (N)."""

    stiffness: float
    displacement: float
    velocity: float
    force: float


Strengths = Callable[[float], dict[str, float]]
Label = dict[str, Any]
Draw = Callable[[PointSizes, np.random.Generator], Strengths]


@dataclass(frozen=True)
class PointLaw:
    """A law at a point.

    Attributes:
        code: of `law_force`.
        parameters: names in a label, in the order of `law_force`.
        draw: (sizes, rng) -> function from a strength near 1 to the parameters; None if `draws` draws the law itself.
        outside: whether the law is outside every catalogue of the diagnosis: the right verdict is then "unknown".
        limit: effect -> its limiting case, the right answer if no record shows the difference; None for a law that is
            drawn far from any limiting case.
    """

    code: int
    parameters: tuple[str, ...]
    draw: Draw | None = None
    outside: bool = False
    limit: Callable[[Label], Label] | None = None


def _clearance(p: PointSizes, rng: np.random.Generator) -> Strengths:
    gap = float(rng.uniform(0.3, 0.8)) * 1.5 * p.displacement
    return lambda s: {"stiffness": s * p.stiffness, "gap": gap}


def _friction(p: PointSizes, rng: np.random.Generator) -> Strengths:
    speed = float(rng.uniform(0.01, 0.05)) * p.velocity
    return lambda s: {"force": 0.02 * s * p.force, "smoothing_speed": speed}


def _two_way_friction(p: PointSizes, rng: np.random.Generator) -> Strengths:
    speed, ratio = float(rng.uniform(0.01, 0.05)) * p.velocity, float(rng.uniform(0.3, 0.8))
    stronger, weaker = BOTH_WAYS if rng.random() < 0.5 else BOTH_WAYS[::-1]
    return lambda s: {stronger: 0.02 * s * p.force, weaker: ratio * (0.02 * s * p.force), "smoothing_speed": speed}


def _same_both_ways(e: Label) -> Label:
    """Friction with the mean of both forces; it differs from two-way friction by a constant force."""
    rest = {name: value for name, value in e.items() if name not in BOTH_WAYS}
    return {**rest, "kind": "coulomb_friction", "force": 0.5 * sum(e[name] for name in BOTH_WAYS)}


def _bouc_wen(p: PointSizes, rng: np.random.Generator) -> Strengths:
    limit = float(rng.uniform(0.2, 0.8)) * p.displacement
    return lambda s: {"stiffness": 0.1 * s * p.stiffness, "yield_displacement": limit}


def _magnet(p: PointSizes, rng: np.random.Generator) -> Strengths:
    reach = float(rng.uniform(0.5, 1.0)) * p.displacement
    return lambda s: {"stiffness": 0.1 * s * p.stiffness, "reach": reach}


def _power(name: str, share: float, of_displacement: float, of_velocity: float = 0.0) -> Draw:
    """The draw of one coefficient: at the typical motion the force is this share of that of the typical spring."""

    def draw(p: PointSizes, rng: np.random.Generator) -> Strengths:
        force = share * p.stiffness * p.displacement
        motion = p.displacement**of_displacement * p.velocity**of_velocity
        return lambda s: {name: s * force / motion}

    return draw


POINT_LAWS: dict[str, PointLaw] = {
    "point_damper": PointLaw(DAMPER, ("coefficient",)),
    "cubic_spring": PointLaw(CUBIC, ("stiffness",), _power("stiffness", 0.1, 3)),
    "clearance": PointLaw(CLEARANCE, ("stiffness", "gap"), _clearance),
    "one_sided_stop": PointLaw(STOP, ("stiffness", "gap"), _clearance),
    "coulomb_friction": PointLaw(FRICTION, ("force", "smoothing_speed"), _friction),
    "bouc_wen": PointLaw(BOUC_WEN, ("stiffness", "yield_displacement"), _bouc_wen),
    "two_way_friction": PointLaw(SLIDING, (*BOTH_WAYS, "smoothing_speed"), _two_way_friction, limit=_same_both_ways),
    "quadratic_damper": PointLaw(QUADRATIC_DAMPER, ("coefficient",), _power("coefficient", 0.05, 0, 2)),
    "quadratic_spring": PointLaw(QUADRATIC, ("stiffness",), _power("stiffness", 0.1, 2), outside=True),
    "quintic_spring": PointLaw(QUINTIC, ("stiffness",), _power("stiffness", 0.05, 5), outside=True),
    "cubic_damper": PointLaw(CUBIC_DAMPER, ("coefficient",), _power("coefficient", 0.05, 0, 3), outside=True),
    "squeeze_film": PointLaw(SQUEEZE, ("coefficient",), _power("coefficient", 0.1, 2, 1), outside=True),
    "magnet": PointLaw(MAGNET, ("stiffness", "reach"), _magnet, outside=True),
}
