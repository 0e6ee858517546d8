"""Nonlinear effects of the structure: contact, friction, hysteresis, large motion, air drag."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.gap.effects.effect import (
    Effect,
    ForceAndMotion,
    Kind,
    Parameter,
    Reconstruction,
    Scales,
    Starts,
    at_a_place,
    place_of,
    place_values,
    positive,
)
from workbench.gap.effects.structural import GROUND_SPRING, POINT_DAMPER
from workbench.gap.effects.transducers import ACTUATOR_BIAS
from workbench.rig.elements import (
    AirDrag,
    BoucWen,
    Clearance,
    CoulombFriction,
    CubicSpring,
    Element,
    EvenSpring,
    LinearSpring,
    MidplaneStretching,
    OneSidedStop,
    PowerDamper,
    PowerSpring,
)
from workbench.rig.force_laws import hysteresis
from workbench.rig.rig import Rig
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.member import Structure

NEGLIGIBLE_SPEED = 0.1  # factor on a smoothing speed that the records cannot distinguish from zero


def with_element(rig: Rig, element: Element) -> Rig:
    return replace(rig, elements=(*rig.elements, element))


def _at_peaks(start: Callable[[ForceAndMotion], Iterable[dict[str, float]]]) -> Starts:
    """Start values at each of the likeliest places, from the unmodelled force and the motion there."""
    return lambda reconstruction, _: (
        {**place_values(place.at), **values} for place in reconstruction.at_peaks for values in start(place)
    )


def _rms(motion: Floats) -> float:
    return float(np.sqrt(np.mean(motion**2)))


# --- cubic_spring


def _cubic_starts(place: ForceAndMotion) -> list[dict[str, float]]:
    k = place.strength_along(place.displacement**3)
    return [{"stiffness": share * k} for share in (0.3, 1.0, -1.0, 3.0)]


def _cubic_stiffness(scales: Scales) -> Parameter:
    unit = scales.stiffness / scales.length**2
    return Parameter("stiffness", "N/m^3", -1e15 * unit, 1e15 * unit, scale=unit, neutral=0.0)


CUBIC_SPRING = Kind(
    name="cubic_spring",
    path="structure",
    parameters=at_a_place(_cubic_stiffness),
    apply=lambda rig, _, v: with_element(rig, CubicSpring(place_of(v), v["stiffness"])),
    starts=_at_peaks(_cubic_starts),
    nonlinear=True,
    force_laws={"displacement": lambda v, w: -v["stiffness"] * w**3},
    phrase="a cubic spring",
)


# --- midplane_stretching


def _stretching_starts(reconstruction: Reconstruction, _: object) -> list[dict[str, float]]:
    modes = reconstruction.rig.modes
    x, w = modes.domain.quadrature(40)
    slopes = modes.phi(x, 1)
    motion = max(reconstruction.motions, key=lambda m: np.mean(m.displacement[0] ** 2))
    stretch = float(np.mean(w @ (slopes @ motion.displacement[:, ::7]) ** 2))
    first = int(np.argmax(modes.omega > 0))
    tension = modes.omega[first] ** 2 / float(w @ slopes[:, first] ** 2)
    return [{"coefficient": s * tension / max(stretch, 1e-300)} for s in np.geomspace(1e-3, 30.0, 14)]


MIDPLANE_STRETCHING = Kind(
    name="midplane_stretching",
    path="structure",
    # tension over a squared slope times length
    parameters=lambda rig, _: (positive("coefficient", "N/m", Scales.of(rig).stiffness, high=1e15, neutral=0.0),),
    apply=lambda rig, _, v: with_element(rig, MidplaneStretching(v["coefficient"])),
    starts=_stretching_starts,
    targets=lambda rig: (None,) if isinstance(rig.structure, Structure) else (),
    nonlinear=True,
    phrase="midplane stretching",
)


# --- air_drag


def _drag_starts(reconstruction: Reconstruction, _: object) -> list[dict[str, float]]:
    modes = reconstruction.rig.modes
    x = modes.length * np.linspace(0.05, 0.95, 19)
    speeds = [np.sqrt(np.mean((modes.phi(x) @ m.velocity[:, ::5]) ** 2)) for m in reconstruction.motions]
    mass = 1.0 / float(np.mean(modes.phi(x)[:, 0] ** 2)) / modes.length
    first = int(np.argmax(modes.omega > 0))
    viscous = 2 * 0.01 * modes.omega[first] * mass
    return [{"coefficient": s * viscous / max(max(speeds), 1e-300)} for s in np.geomspace(0.02, 50.0, 12)]


def _drag_parameters(rig: Rig, _: object) -> tuple[Parameter, ...]:
    scales = Scales.of(rig)
    unit = scales.damping / scales.speed / scales.length
    return (positive("coefficient", "N s^2/m^3", unit, neutral=0.0),)


AIR_DRAG = Kind(
    name="air_drag",
    path="structure",
    parameters=_drag_parameters,
    apply=lambda rig, _, v: with_element(rig, AirDrag(v["coefficient"])),
    starts=_drag_starts,
    targets=lambda rig: (None,) if isinstance(rig.structure, Structure) else (),
    nonlinear=True,
    phrase="air drag",
)


# --- clearance and one_sided_stop


def _stiffness(scales: Scales) -> Parameter:
    return positive("stiffness", "N/m", scales.stiffness, neutral=0.0)


def _smoothing_speed(scales: Scales) -> Parameter:
    return positive("smoothing_speed", "m/s", scales.speed)


def _contact_starts(place: ForceAndMotion, reach: Floats) -> Iterator[dict[str, float]]:
    """Start values of a contact that closes at quantiles of the displacement towards it, `reach` (n_total,)."""
    if not (reach > 0).any():  # the motion stays on the other side, as under a constant force
        return
    for gap in np.quantile(reach[reach > 0], (0.3, 0.5, 0.65, 0.8, 0.9, 0.96, 0.99)):
        k = place.strength_along(np.maximum(reach - gap, 0.0) * np.sign(place.displacement))
        yield from ({"stiffness": share * k, "gap": float(gap)} for share in (1.0, 4.0) if k > 0)


CLEARANCE = Kind(
    name="clearance",
    path="structure",
    parameters=at_a_place(_stiffness, lambda scales: positive("gap", "m", scales.length)),
    apply=lambda rig, _, v: with_element(rig, Clearance(place_of(v), v["stiffness"], v["gap"])),
    starts=_at_peaks(lambda place: _contact_starts(place, np.abs(place.displacement))),
    nonlinear=True,
    simpler=lambda contact, _: (contact.of_kind(GROUND_SPRING, stiffness=contact.values["stiffness"]),),
    force_laws={"displacement": lambda v, w: -v["stiffness"] * np.sign(w) * np.maximum(np.abs(w) - v["gap"], 0.0)},
    phrase="a two-sided clearance",
)

ONE_SIDED_STOP = Kind(
    name="one_sided_stop",
    path="structure",
    parameters=at_a_place(_stiffness, lambda scales: positive("gap", "m", scales.length)),
    apply=lambda rig, _, v: with_element(rig, OneSidedStop(place_of(v), v["stiffness"], v["gap"])),
    starts=_at_peaks(lambda place: _contact_starts(place, place.displacement)),
    nonlinear=True,
    force_laws={"displacement": lambda v, w: -v["stiffness"] * np.maximum(w - v["gap"], 0.0)},
    phrase="a one-sided stop",
)


# --- coulomb_friction


def _friction_starts(place: ForceAndMotion) -> Iterator[dict[str, float]]:
    for speed in np.array([0.02, 0.1, 0.3]) * _rms(place.velocity):
        force = place.strength_along(np.tanh(place.velocity / speed))
        yield from ({"force": part * force, "smoothing_speed": float(speed)} for part in (1.0, 2.0) if force > 0)


def _as_damper(friction: Effect, _: Rig) -> tuple[Effect, ...]:
    """The viscous damper that friction is far below its smoothing speed."""
    coefficient = friction.values["force"] / friction.values["smoothing_speed"]
    return (friction.of_kind(POINT_DAMPER, coefficient=coefficient),)


def _has_negligible_speed(friction: Effect) -> bool:
    """Whether the smoothing speed of friction is too small for the records to distinguish it from zero.

    If it is too large for them instead, the force is as uncertain, since friction is then a damper.
    """
    unsure = {name for name, deviation in friction.std.items() if deviation > friction.values[name]}
    return "smoothing_speed" in unsure and not any(name.startswith("force") for name in unsure)


def _stated_numbers(friction: Effect, _: Rig) -> dict[str, float]:
    """The parameters of friction, without a smoothing speed that cannot be distinguished from zero."""
    left_out = ("smoothing_speed",) if _has_negligible_speed(friction) else ()
    return {name: value for name, value in friction.numbers.items() if name not in left_out}


def _with_negligible_speed(friction: Effect) -> Effect:
    """Friction with a much smaller smoothing speed, whose standard deviation is at least the former value."""
    speed = friction.values["smoothing_speed"]
    unsure = max(friction.std.get("smoothing_speed", 0.0), speed)
    return replace(
        friction,
        values={**friction.values, "smoothing_speed": NEGLIGIBLE_SPEED * speed},
        std={**friction.std, "smoothing_speed": unsure},
    )


def _direction_dependent(friction: Effect, offset: float = 0.0) -> Effect:
    values = _two_way_values(friction.values["force"], offset, friction.values["smoothing_speed"])
    return friction.of_kind(TWO_WAY_FRICTION, **values)


def _merged_with_bias(friction: Effect, other: Effect) -> Effect | None:
    """Friction and a constant force as asymmetric friction, which an offset of a drive looks like."""
    if other.kind is not ACTUATOR_BIAS or abs(other.values["force"]) >= friction.values["force"]:
        return None
    return _direction_dependent(friction, -other.values["force"])


COULOMB_FRICTION = Kind(
    name="coulomb_friction",
    path="structure",
    parameters=at_a_place(lambda scales: positive("force", "N", scales.force, neutral=0.0), _smoothing_speed),
    apply=lambda rig, _, v: with_element(rig, CoulombFriction(place_of(v), v["force"], v["smoothing_speed"])),
    starts=_at_peaks(_friction_starts),
    nonlinear=True,
    more_general=lambda friction: (_direction_dependent(friction),),
    merged=_merged_with_bias,
    simpler=_as_damper,
    force_laws={"velocity": lambda v, u: -v["force"] * np.tanh(u / v["smoothing_speed"])},
    numbers=_stated_numbers,
    without_negligible=_with_negligible_speed,
    phrase="Coulomb friction",
)


# --- bouc_wen


def _bouc_wen_starts(reconstruction: Reconstruction, _: object) -> Iterator[dict[str, Any]]:
    # with named points, the likeliest places need not be close to the right one, which may come third
    most = None if isinstance(reconstruction.rig.modes.domain, NamedPoints) else 2
    for place in reconstruction.at_peaks[:most]:
        size = _rms(place.displacement)
        for share in (0.03, 0.1, 0.3, 1.0, 3.0):
            k = place.strength_along(hysteresis(place.displacement, share * size))
            for part in (1.0, 2.0) if k > 0 else ():
                yield {**place_values(place.at), "stiffness": part * k, "yield_displacement": share * size}


def _as_spring_or_friction(spring: Effect, rig: Rig) -> tuple[Effect, ...]:
    """The spring that a hysteretic spring is if it never yields, and the friction if it always slides.

    Its internal variable z reverses over about twice its largest value.
    """
    stiffness, limit = spring.values["stiffness"], spring.values["yield_displacement"]
    speed = limit / Scales.of(rig).time
    friction = spring.of_kind(COULOMB_FRICTION, force=stiffness * limit, smoothing_speed=speed)
    return (spring.of_kind(GROUND_SPRING, stiffness=stiffness), friction)


BOUC_WEN = Kind(
    name="bouc_wen",
    path="structure",
    parameters=at_a_place(_stiffness, lambda scales: positive("yield_displacement", "m", scales.length)),
    apply=lambda rig, _, v: with_element(rig, BoucWen(place_of(v), v["stiffness"], v["yield_displacement"])),
    starts=_bouc_wen_starts,
    nonlinear=True,
    simpler=_as_spring_or_friction,
    phrase="a hysteretic spring",
)

# --- joint_slip


def _slip_starts(place: ForceAndMotion) -> Iterator[dict[str, float]]:
    for share in (0.03, 0.1, 0.3, 1.0, 3.0) if isinstance(place.at, Between) else ():
        limit = share * _rms(place.displacement)
        k = -place.strength_along(place.displacement - hysteresis(place.displacement, limit))
        yield from ({"stiffness": part * k, "yield_displacement": limit} for part in (0.5, 1.0) if k > 0)


def _with_slip(rig: Rig, _: object, v: dict[str, Any]) -> Rig:
    """The rig with the stiffness force k (w - z) taken from a joint: zero while it sticks, k w when it slips."""
    where, stiffness = place_of(v), v["stiffness"]
    return with_element(
        with_element(rig, LinearSpring(where, -stiffness)), BoucWen(where, stiffness, v["yield_displacement"])
    )


JOINT_SLIP = Kind(
    name="joint_slip",
    path="structure",
    parameters=BOUC_WEN.parameters,
    apply=_with_slip,
    starts=_at_peaks(_slip_starts),
    targets=lambda rig: (None,) if isinstance(rig.modes.domain, NamedPoints) and any(rig.modes.domain.pairs()) else (),
    nonlinear=True,
    simpler=lambda joint, _: (joint.of_kind(GROUND_SPRING, stiffness=-joint.values["stiffness"]),),  # always slipping
    phrase="a joint that slips",
)

# --- two_way_friction


def _two_way_starts(place: ForceAndMotion) -> Iterator[dict[str, float]]:
    for speed in np.array([0.02, 0.1, 0.3]) * _rms(place.velocity):
        basis = np.column_stack([np.tanh(place.velocity / speed), np.ones(place.velocity.size)])
        force, offset = -np.linalg.lstsq(basis, place.force, rcond=None)[0]
        if force > abs(offset):
            yield _two_way_values(force, offset, float(speed))


def _two_way_values(force: float, offset: float, speed: float) -> dict[str, float]:
    """Values of asymmetric friction of a mean force and half the difference of both directions, N."""
    return {"force_forward": force + offset, "force_backward": force - offset, "smoothing_speed": speed}


def _two_way_element(v: Mapping[str, Any]) -> CoulombFriction:
    """Friction of the mean force of both directions, N, with half their difference as an offset."""
    force, offset = (0.5 * (v["force_forward"] + sign * v["force_backward"]) for sign in (1.0, -1.0))
    return CoulombFriction(place_of(v), force, v["smoothing_speed"], offset)


def _two_way_law(v: Mapping[str, Any], u: Floats) -> Floats:
    friction = _two_way_element(v)
    return -friction.force * np.tanh(u / float(friction.smoothing_speed)) - friction.offset


def _as_coulomb_friction(friction: Effect, _: Rig) -> tuple[Effect, ...]:
    mean = _two_way_element(friction.values)
    return (friction.of_kind(COULOMB_FRICTION, force=mean.force, smoothing_speed=mean.smoothing_speed),)


TWO_WAY_FRICTION = Kind(
    name="two_way_friction",
    path="structure",
    parameters=at_a_place(
        lambda scales: positive("force_forward", "N", scales.force, neutral=0.0),
        lambda scales: positive("force_backward", "N", scales.force, neutral=0.0),
        _smoothing_speed,
    ),
    apply=lambda rig, _, v: with_element(rig, _two_way_element(v)),
    starts=_at_peaks(_two_way_starts),
    nonlinear=True,
    simpler=_as_coulomb_friction,
    force_laws={"velocity": _two_way_law},
    numbers=_stated_numbers,
    without_negligible=_with_negligible_speed,
    phrase="asymmetric Coulomb friction",
)


# --- quadratic_damper


def _quadratic_starts(place: ForceAndMotion) -> list[dict[str, float]]:
    c = place.strength_along(np.abs(place.velocity) * place.velocity)
    return [{"coefficient": share * c} for share in (0.4, 1.0, 2.5) if c > 0]


QUADRATIC_DAMPER = Kind(
    name="quadratic_damper",
    path="structure",
    parameters=at_a_place(
        lambda scales: positive("coefficient", "N s^2/m^2", scales.damping / scales.speed, neutral=0.0)
    ),
    apply=lambda rig, _, v: with_element(rig, PowerDamper(place_of(v), v["coefficient"], 1.0, 2.0)),
    starts=_at_peaks(_quadratic_starts),
    nonlinear=True,
    force_laws={"velocity": lambda v, u: -v["coefficient"] * np.abs(u) * u},
    phrase="a quadratic damper",
)

KINDS = (
    CUBIC_SPRING,
    MIDPLANE_STRETCHING,
    AIR_DRAG,
    CLEARANCE,
    ONE_SIDED_STOP,
    COULOMB_FRICTION,
    BOUC_WEN,
    JOINT_SLIP,
    TWO_WAY_FRICTION,
    QUADRATIC_DAMPER,
)


EXPONENTS = (1.5, 2.0, 4.0, 6.0)  # start values
SAME_POWER = 0.05  # an exponent as close as this to that of a kind of the catalogue is the same within small errors


def _power_law(element: type, name: str, motion: str, words: str, *, even: bool = False) -> Kind:
    def power(u: Floats, rms: float, exponent: float) -> Floats:
        """±|u / rms|^p."""
        return np.asarray((1.0 if even else np.sign(u)) * np.abs(u / rms) ** exponent)

    def starts(place: ForceAndMotion) -> Iterator[dict[str, float]]:
        path = getattr(place, motion)
        rms = _rms(path)
        for exponent in EXPONENTS if rms > 0 else ():
            force = place.strength_along(power(path, rms, exponent))
            yield {"force_at_rms": force, "exponent": exponent, "rms": rms}

    return Kind(
        name=name,
        path="structure",
        parameters=at_a_place(
            lambda scales: Parameter("force_at_rms", "N", -1e15 * scales.force, 1e15 * scales.force),
            lambda _: Parameter("exponent", "", 1.0, 9.0),
        ),
        apply=lambda rig, _, v: with_element(rig, element(place_of(v), v["force_at_rms"], v["rms"], v["exponent"])),
        starts=_at_peaks(starts),
        nonlinear=True,
        phrase=words,
        force_laws={motion: lambda v, u: -v["force_at_rms"] * power(u, v["rms"], v["exponent"])},
    )


POWER_SPRING = _power_law(PowerSpring, "power_spring", "displacement", "a power-law spring")
EVEN_SPRING = _power_law(EvenSpring, "even_spring", "displacement", "an even-order power-law spring", even=True)
POWER_DAMPER = _power_law(PowerDamper, "power_damper", "velocity", "a power-law damper")
BEYOND = (POWER_SPRING, EVEN_SPRING, POWER_DAMPER)

POWERS = {
    (POWER_SPRING, 1): (GROUND_SPRING, "stiffness"),
    (POWER_SPRING, 3): (CUBIC_SPRING, "stiffness"),
    (POWER_DAMPER, 1): (POINT_DAMPER, "coefficient"),
    (POWER_DAMPER, 2): (QUADRATIC_DAMPER, "coefficient"),
}


def in_catalogue(law: Effect) -> Effect | None:
    """The effect of the catalogue that has the exponent of a power law; None if there is none."""
    v = law.values
    power = round(v["exponent"])
    if (law.kind, power) not in POWERS or abs(v["exponent"] - power) > SAME_POWER:
        return None
    kind, number = POWERS[law.kind, power]
    return law.of_kind(kind, **{number: v["force_at_rms"] / v["rms"] ** power})


def any_beyond(effects: Iterable[Effect]) -> bool:
    """Whether one of the effects is a law beyond the catalogue."""
    return any(effect.kind in BEYOND for effect in effects)
