"""Effects of the structure that depend on level: contacts, friction, hysteresis, large motion, air."""

from dataclasses import replace

import numpy as np
from numba import njit

from workbench.gap.effects.effect import Kind, Parameter, place_of, place_parameters, place_values
from workbench.rig.elements import (
    AirDrag,
    BoucWen,
    Clearance,
    CoulombFriction,
    CubicSpring,
    MidplaneStretching,
    OneSidedStop,
)
from workbench.rig.rig import Rig
from workbench.rig.stepping import yield_update
from workbench.structure.member import Structure


def with_element(rig: Rig, element) -> Rig:
    """The rig with one more element."""
    return replace(rig, elements=(*rig.elements, element))


def strength_along(force: np.ndarray, basis: np.ndarray) -> float:
    """The k for which -k basis is nearest to a force."""
    return float(-np.dot(force, basis) / max(np.dot(basis, basis), 1e-300))


def _stiffness(name: str, typical: float = 1.0) -> Parameter:
    return Parameter(name, "N/m", 1e-9 * typical, 1e12 * typical, logarithmic=True)


# --- cubic_spring


def _cubic_starts(evidence, _):
    for place in evidence.at_peaks:
        k = strength_along(place.force, place.displacement**3)
        for share in (0.3, 1.0, 3.0):
            yield {**place_values(place.at), "stiffness": share * k}
            if share == 1.0:
                yield {**place_values(place.at), "stiffness": -share * k}


def _cubic_parameters(rig: Rig, _):
    return (*place_parameters(rig), Parameter("stiffness", "N/m^3", -1e15, 1e15, scale=1.0))


CUBIC_SPRING = Kind(
    name="cubic_spring",
    path="structure",
    parameters=_cubic_parameters,
    apply=lambda rig, _, v: with_element(rig, CubicSpring(place_of(v), v["stiffness"])),
    starts=_cubic_starts,
    nonlinear=True,
    phrase="a cubic spring",
)


# --- midplane_stretching


def _stretching_starts(evidence, _):
    modes = evidence.rig.modes
    points, weights = np.polynomial.legendre.leggauss(40)
    x, w = 0.5 * modes.length * (points + 1), 0.5 * modes.length * weights
    slopes = modes.phi(x, 1)
    motion = max(evidence.motions, key=lambda m: np.mean(m.displacement[0] ** 2))
    stretch = float(np.mean(w @ (slopes @ motion.displacement[:, ::7]) ** 2))
    first = int(np.argmax(modes.omega > 0))
    tension = modes.omega[first] ** 2 / float(w @ slopes[:, first] ** 2)
    return [{"coefficient": s * tension / max(stretch, 1e-300)} for s in np.geomspace(1e-3, 30.0, 14)]


MIDPLANE_STRETCHING = Kind(
    name="midplane_stretching",
    path="structure",
    parameters=lambda rig, _: (Parameter("coefficient", "N/m", 1e-12, 1e15, logarithmic=True),),
    apply=lambda rig, _, v: with_element(rig, MidplaneStretching(v["coefficient"])),
    starts=_stretching_starts,
    targets=lambda rig: (None,) if isinstance(rig.structure, Structure) else (),
    nonlinear=True,
    phrase="stretching of the midplane",
)


# --- air_drag


def _drag_starts(evidence, _):
    modes = evidence.rig.modes
    x = modes.length * np.linspace(0.05, 0.95, 19)
    speeds = [np.sqrt(np.mean((modes.phi(x) @ m.velocity[:, ::5]) ** 2)) for m in evidence.motions]
    mass = 1.0 / float(np.mean(modes.phi(x)[:, 0] ** 2)) / modes.length
    first = int(np.argmax(modes.omega > 0))
    viscous = 2 * 0.01 * modes.omega[first] * mass
    return [{"coefficient": s * viscous / max(max(speeds), 1e-300)} for s in np.geomspace(0.02, 50.0, 12)]


AIR_DRAG = Kind(
    name="air_drag",
    path="structure",
    parameters=lambda rig, _: (Parameter("coefficient", "N s^2/m^3", 1e-12, 1e12, logarithmic=True),),
    apply=lambda rig, _, v: with_element(rig, AirDrag(v["coefficient"])),
    starts=_drag_starts,
    targets=lambda rig: (None,) if isinstance(rig.structure, Structure) else (),
    nonlinear=True,
    phrase="air drag",
)


# --- clearance and one_sided_stop


def _contact_parameters(rig: Rig, _):
    return (
        *place_parameters(rig),
        _stiffness("stiffness"),
        Parameter("gap", "m", 1e-12, 1e6, logarithmic=True),
    )


def _contact_starts(two_sided: bool):
    def starts(evidence, _):
        for place in evidence.at_peaks:
            reach = np.abs(place.displacement) if two_sided else place.displacement
            levels = np.quantile(reach[reach > 0], (0.3, 0.5, 0.65, 0.8, 0.9, 0.96, 0.99))
            for gap in levels:
                over = np.maximum(reach - gap, 0.0) * np.sign(place.displacement)
                k = strength_along(place.force, over)
                if k > 0:
                    yield {**place_values(place.at), "stiffness": k, "gap": float(gap)}
                    yield {**place_values(place.at), "stiffness": 4 * k, "gap": float(gap)}

    return starts


CLEARANCE = Kind(
    name="clearance",
    path="structure",
    parameters=_contact_parameters,
    apply=lambda rig, _, v: with_element(rig, Clearance(place_of(v), v["stiffness"], v["gap"])),
    starts=_contact_starts(True),
    nonlinear=True,
    phrase="a clearance closed on both sides by springs",
)

ONE_SIDED_STOP = Kind(
    name="one_sided_stop",
    path="structure",
    parameters=_contact_parameters,
    apply=lambda rig, _, v: with_element(rig, OneSidedStop(place_of(v), v["stiffness"], v["gap"])),
    starts=_contact_starts(False),
    nonlinear=True,
    phrase="a one-sided stop",
)


# --- coulomb_friction


def _friction_starts(evidence, _):
    for place in evidence.at_peaks:
        speed = float(np.sqrt(np.mean(place.velocity**2)))
        for share in (0.02, 0.1, 0.3):
            force = strength_along(place.force, np.tanh(place.velocity / (share * speed)))
            if force > 0:
                yield {**place_values(place.at), "force": force, "smoothing_speed": share * speed}
                yield {**place_values(place.at), "force": 2 * force, "smoothing_speed": share * speed}


COULOMB_FRICTION = Kind(
    name="coulomb_friction",
    path="structure",
    parameters=lambda rig, _: (
        *place_parameters(rig),
        Parameter("force", "N", 1e-12, 1e9, logarithmic=True),
        Parameter("smoothing_speed", "m/s", 1e-9, 1e6, logarithmic=True),
    ),
    apply=lambda rig, _, v: with_element(rig, CoulombFriction(place_of(v), v["force"], v["smoothing_speed"])),
    starts=_friction_starts,
    nonlinear=True,
    phrase="a friction force",
)


# --- bouc_wen


@njit(cache=True, nogil=True)
def _hysteresis(displacement: np.ndarray, limit: float) -> np.ndarray:
    """z of a Bouc-Wen spring along a path of displacements."""
    z = np.zeros_like(displacement)
    for k in range(1, displacement.size):
        z[k], _ = yield_update(z[k - 1], displacement[k] - displacement[k - 1], limit)
    return z


def _bouc_wen_starts(evidence, _):
    for place in evidence.at_peaks[:2]:
        size = float(np.sqrt(np.mean(place.displacement**2)))
        for share in (0.03, 0.1, 0.3, 1.0, 3.0):
            k = strength_along(place.force, _hysteresis(place.displacement, share * size))
            if k > 0:
                yield {**place_values(place.at), "stiffness": k, "yield_displacement": share * size}
                yield {**place_values(place.at), "stiffness": 2 * k, "yield_displacement": share * size}


BOUC_WEN = Kind(
    name="bouc_wen",
    path="structure",
    parameters=lambda rig, _: (
        *place_parameters(rig),
        _stiffness("stiffness"),
        Parameter("yield_displacement", "m", 1e-12, 1e6, logarithmic=True),
    ),
    apply=lambda rig, _, v: with_element(rig, BoucWen(place_of(v), v["stiffness"], v["yield_displacement"])),
    starts=_bouc_wen_starts,
    nonlinear=True,
    phrase="a hysteretic spring",
)

KINDS = (
    CUBIC_SPRING,
    MIDPLANE_STRETCHING,
    AIR_DRAG,
    CLEARANCE,
    ONE_SIDED_STOP,
    COULOMB_FRICTION,
    BOUC_WEN,
)
