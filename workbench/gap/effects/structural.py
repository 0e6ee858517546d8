"""Linear effects of the structure: stiffness, mass, supports, damping and attachments."""

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any

import numpy as np

from workbench.gap.effects.effect import (
    Effect,
    Kind,
    Parameter,
    Reconstruction,
    Scales,
    at_a_place,
    place_of,
    place_parameters,
    place_values,
    positive,
)
from workbench.rig.rig import Rig
from workbench.structure.damping import ModalDamping, ViscousDamping
from workbench.structure.domain import Between
from workbench.structure.member import Beam, Structure
from workbench.structure.modes import Modes
from workbench.structure.modification import attach
from workbench.structure.plate import Membrane, Plate
from workbench.structure.profile import Field
from workbench.structure.supports import HELD, Attachment, End, PointDamper, PointMass, PointSpring

RESOLUTION, ROUGHLY = 1e-6, 1e-4  # relative tolerance of a frequency; of the highest of many
MODES_CLOSED_FORM = 60  # modes of a plate in closed form, for each that is needed
MODES_SOLVED, EXTRA_MODES = 3, 20  # of other plates: modes solved to a tolerance, and further ones without it
EDGE = 1e-9  # of the length: tolerance at the ends
OTHER_WIDTH = 1.5  # ratio of the width of a local loss to that of its start values, from which a fit may end elsewhere
NEAR_HINGE = 0.1  # of the length: a spring closer to a hinge acts as a rotational spring


def resolved(rig: Rig, structure: Structure | Plate | Membrane) -> Rig:
    """The rig with a changed structure and the modes it then has."""
    return replace(rig, structure=structure, modes=modes_of(structure, rig.modes.n_modes))


def modes_of(structure: Structure | Plate | Membrane, n_modes: int) -> Modes:
    """The modes of a structure, to the accuracy of a search."""
    if isinstance(structure, Plate | Membrane):
        return _modes_of_surface(structure, n_modes)
    return structure.modes(n_modes, tolerance=RESOLUTION)


def _modes_of_surface(surface: Plate | Membrane, n_modes: int, solved_for: int = 0) -> Modes:
    """The modes of a plate or membrane with attachments, from cached modes without them.

    solved_for: number of modes that the cached solution is made for; 0 for `n_modes`.
    """
    facts = {f.name: getattr(surface, f.name) for f in fields(surface) if f.name != "attachments"}
    facts["edges"] = tuple(surface.edges.items())
    base, factor = _base_stiffness(surface)
    if base is not None:  # one solution serves all factors
        facts["bending_stiffness"] = base
    damping = facts["damping"]
    if not isinstance(damping, ViscousDamping):  # modal damping does not affect the undamped modes
        facts["damping"] = None
    kind: Any = type(surface)
    bare = _modes_without_attachments(kind, tuple(facts.items()), solved_for or n_modes)
    if bare.n_modes < n_modes:
        bare = _modes_without_attachments(kind, tuple(facts.items()), n_modes)
    if base is not None:
        bare = _scaled_modes(bare, np.sqrt(factor))
    if not isinstance(damping, ViscousDamping):
        bare = replace(bare, damping=damping.matrix(bare.omega))
    residual = _residual_flexibility(surface, float(bare.omega[-1]))
    return attach(bare, _attachments(surface), n_modes=n_modes, residual_flexibility=residual)


def _residual_flexibility(surface: Plate | Membrane, omega: float) -> float:
    """Flexibility at a point, m/N, of all modes of a plate above a frequency, rad/s: 1 / (4 π √(m D) ω).

    Below ω the mean of Σ φ_r² away from the edges is ω / (4 π √(m D)), whatever these are (the local law of Weyl;
    Courant & Hilbert, Methods of Mathematical Physics 1 (1953), section VI.4), so that Σ φ_r² / ω_r² above it is that.
    """
    if not isinstance(surface, Plate):
        return 0.0
    points, weights = surface.domain.quadrature(4)
    impedance = np.sqrt(surface.mass_per_area(*points.T) * surface.bending_stiffness(*points.T))
    return float(weights.sum() / (4.0 * np.pi * (weights @ impedance) * omega))


def _base_stiffness(surface: Plate | Membrane) -> tuple[Field | None, float]:
    """The bending stiffness that a plate's is a multiple of, and the factor; None if it has other strain energy."""
    if not isinstance(surface, Plate) or surface.bending_stiffness.multiple_of is None:
        return None, 1.0
    supports = [value for edge in surface.edges.values() for value in (edge.translation, edge.rotation)]
    is_bending_only = not any(surface.tension) and all(value in (0.0, HELD) for value in supports)
    return surface.bending_stiffness.multiple_of if is_bending_only else (None, 1.0)


def _attachments(structure: object) -> tuple[Attachment, ...]:
    return getattr(structure, "attachments", ())


@lru_cache(maxsize=16)
def _modes_without_attachments(kind: Any, facts: tuple[tuple[str, Any], ...], n_modes: int) -> Modes:
    """Modes of a plate or membrane without attachments, enough to describe the effect of one on the first `n_modes`."""
    given = dict(facts)
    surface = kind(**{**given, "edges": dict(given["edges"]), "damping": given["damping"] or ModalDamping()})
    if not isinstance(surface, Plate):  # a membrane has no attachments
        return surface.modes(n_modes, tolerance=RESOLUTION)  # type: ignore[no-any-return]
    if surface.is_navier:
        return surface.modes(MODES_CLOSED_FORM * n_modes)
    return surface.modes(MODES_SOLVED * n_modes, tolerance=ROUGHLY, beyond=EXTRA_MODES * n_modes)


def solved_once(change: Callable[[Rig, Any, dict[str, float]], Rig]) -> Callable[[Rig, Any, dict[str, float]], Rig]:
    """A cached change of a structure or of its modes, since a search combines each with many other effects."""

    @lru_cache(maxsize=256)
    def changed(
        structure: Structure | Plate | Membrane | None, modes: Modes, target: Any, values: tuple[tuple[str, Any], ...]
    ) -> Rig:
        return change(Rig(modes, (), (), structure=structure), target, dict(values))

    def apply(rig: Rig, target: Any, values: dict[str, Any]) -> Rig:
        found = changed(rig.structure, rig.modes, target, tuple(values.items()))
        return replace(rig, structure=found.structure, modes=found.modes)

    return apply


def _member(rig: Rig) -> Structure:
    if not isinstance(rig.structure, Structure):
        raise ValueError("plain modal data have no structure to change; describe it as a beam or a rod")
    return rig.structure


def _beam(rig: Rig) -> Beam:
    if not isinstance(rig.structure, Beam):
        raise ValueError("only a beam bends; describe the structure as one")
    return rig.structure


def _with_attachment(rig: Rig, part: Attachment) -> Rig:
    bare = None if isinstance(rig.structure, Membrane) else rig.structure
    structure = bare and replace(bare, attachments=(*bare.attachments, part))
    if structure is None or isinstance(part, PointDamper):  # a damper does not change the undamped modes
        return replace(rig, structure=structure, modes=attach(rig.modes, (part,)))
    return resolved(rig, structure)


# --- modulus_error


def _modulus(rig: Rig, _: object, values: dict[str, float]) -> Rig:
    factor, structure = values["factor"], rig.structure
    if structure is None or isinstance(structure, Membrane):  # all stiffness of a membrane is scaled
        return replace(rig, structure=None, modes=_scaled_modes(rig.modes, np.sqrt(factor)))
    if isinstance(structure, Plate):
        return resolved(rig, replace(structure, bending_stiffness=structure.bending_stiffness.scaled(factor)))
    scaled: dict[str, Any] = {structure.stiffness_name: structure.stiffness.scaled(factor)}
    structure = replace(structure, **scaled)
    supports = [stiffness for end in (structure.left, structure.right) for stiffness in (end.translation, end.rotation)]
    has_tension = isinstance(structure, Beam) and structure.tension
    if structure.attachments or has_tension or any(0 < stiffness < HELD for stiffness in supports):
        return resolved(rig, structure)
    return replace(rig, structure=structure, modes=_scaled_modes(rig.modes, np.sqrt(factor)))


def _scaled_modes(modes: Modes, factor: float) -> Modes:
    """The modes with frequencies times a factor, and the same damping ratios and shapes."""
    return replace(modes, omega=modes.omega * factor, damping=modes.damping * factor)


MODULUS_ERROR = Kind(
    name="modulus_error",
    path="structure",
    parameters=lambda rig, _: (Parameter("factor", "", 0.2, 5.0, logarithmic=True, neutral=1.0),),
    apply=solved_once(_modulus),
    starts=lambda reconstruction, _: [
        {"factor": f} for f in (*np.exp(np.linspace(-0.6, 0.6, 41)), 0.995, 1.005) if abs(f - 1) > 1e-3
    ],
    targets=lambda rig: (None,) if rig.modes.omega.any() else (),
    phrase="an overall stiffness error",
)


# --- attachments at a point


def _point_starts(
    name: str, series: str, unit: str, *, between: bool = True, signed: bool = False
) -> Callable[[Reconstruction, object], Iterator[dict[str, Any]]]:
    def starts(reconstruction: Reconstruction, _: object) -> Iterator[dict[str, Any]]:
        size = getattr(Scales.of(reconstruction.rig), unit)
        for place in reconstruction.at_peaks:
            if isinstance(place.at, Between) and not between:
                continue
            k = replace(place, absorbed=False).strength_along(getattr(place, series))  # a linear force is sought itself
            for share in (0.4, 1.0, 2.0):
                if k > 0 or signed:
                    yield {**place_values(place.at), name: share * k}
        for where in reconstruction.places_to_try:
            for share in (0.004, 0.02, 0.1, 0.4):
                yield {**place_values(where), name: share * size}

    return starts


POINT_MASS = Kind(
    name="point_mass",
    path="structure",
    parameters=at_a_place(lambda scales: positive("mass", "kg", scales.mass, 1e-8, 1e5, neutral=0.0)),
    apply=solved_once(lambda rig, _, v: _with_attachment(rig, PointMass(place_of(v), v["mass"]))),
    starts=_point_starts("mass", "acceleration", "mass", between=False),
    phrase="an added mass",
)


def _spring_stiffness(scales: Scales) -> Parameter:
    bounds = -1e5 * scales.stiffness, 1e5 * scales.stiffness
    return Parameter("stiffness", "N/m", *bounds, logarithmic=True, scale=1e-8 * scales.stiffness, neutral=0.0)


def _as_rotational_spring(spring: Effect, rig: Rig) -> tuple[Effect, ...]:
    """The rotational spring k a² at a hinge that a spring k at a small distance a from it is."""
    if not isinstance(rig.structure, Structure):
        return ()
    length, v = rig.structure.length, spring.values
    end, arm = ("left", v["at"]) if v["at"] < 0.5 * length else ("right", length - v["at"])
    if v["stiffness"] <= 0 or arm > NEAR_HINGE * length or end not in SUPPORT_ROTATION.targets(rig):
        return ()
    return (Effect(SUPPORT_ROTATION, end, {"rotational_stiffness": v["stiffness"] * arm**2}),)


GROUND_SPRING = Kind(
    name="ground_spring",
    path="structure",
    parameters=at_a_place(_spring_stiffness),
    apply=solved_once(lambda rig, _, v: _with_attachment(rig, PointSpring(place_of(v), v["stiffness"]))),
    starts=_point_starts("stiffness", "displacement", "stiffness", signed=True),
    phrase="a spring to ground",
    phrase_between=lambda spring: "a spring" if spring.values["stiffness"] > 0 else "a loss of stiffness",
    simpler=_as_rotational_spring,
    force_laws={"displacement": lambda v, w: -v["stiffness"] * w},
)

POINT_DAMPER = Kind(
    name="point_damper",
    path="structure",
    parameters=at_a_place(lambda scales: positive("coefficient", "N s/m", scales.damping, 1e-8, 1e5, neutral=0.0)),
    apply=solved_once(lambda rig, _, v: _with_attachment(rig, PointDamper(place_of(v), v["coefficient"]))),
    starts=_point_starts("coefficient", "velocity", "damping"),
    phrase="a viscous damper to ground",
    phrase_between=lambda damper: "a viscous damper",
    applied_last=True,
    force_laws={"velocity": lambda v, u: -v["coefficient"] * u},
)


# --- local_stiffness_loss


def _with_loss(rig: Rig, _: object, values: dict[str, float]) -> Rig:
    member = _member(rig)
    length = member.length
    start, stop = values["at"] - 0.5 * values["width"], values["at"] + 0.5 * values["width"]
    if start < -EDGE * length or stop > (1.0 + EDGE) * length:
        # a segment beyond the end has no effect, so place and width could not be distinguished
        raise ValueError(f"the segment from {start:.4g} to {stop:.4g} reaches beyond the structure")
    profile: Any = member.stiffness.scaled(1.0 - values["loss"], max(start, 0.0), min(stop, length))
    return resolved(rig, replace(member, **{member.stiffness_name: profile}))


def _loss_parameters(rig: Rig, _: object) -> tuple[Parameter, ...]:
    length = rig.modes.domain.size
    return (
        *place_parameters(rig),
        Parameter("width", "m", 0.005 * length, 0.2 * length, scale=0.02 * length),
        Parameter("loss", "", 1e-4, 0.95, scale=0.1, neutral=0.0),
    )


def _first_width(place: float, length: float) -> float:
    return min(0.1 * length, 1.5 * place, 1.5 * (length - place))


def _loss_starts(reconstruction: Reconstruction, _: object) -> Iterator[dict[str, Any]]:
    length = reconstruction.domain.size
    for x in (0.04, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.96):
        for loss in (0.003, 0.01, 0.03, 0.12, 0.45):
            yield {"at": x * length, "width": _first_width(x * length, length), "loss": loss}


def _over_first_width(effect: Effect, rig: Rig) -> Iterator[Effect]:
    """The same added compliance over another width: of a narrow loss, records show no more than that compliance."""
    at, width, loss = (effect.values[name] for name in ("at", "width", "loss"))
    other = _first_width(at, rig.modes.domain.size)
    if max(width, other) > OTHER_WIDTH * min(width, other) > 0.0:
        added = loss / (1.0 - loss) * width / other
        yield replace(effect, values={**effect.values, "width": other, "loss": added / (1.0 + added)})


LOCAL_STIFFNESS_LOSS = Kind(
    name="local_stiffness_loss",
    path="structure",
    parameters=_loss_parameters,
    apply=solved_once(_with_loss),
    starts=_loss_starts,
    other_starts=_over_first_width,
    targets=lambda rig: (None,) if isinstance(rig.structure, Structure) else (),
    phrase="a local loss of stiffness",
)


# --- support_rotation


def _ends(rig: Rig) -> tuple[str, ...]:
    if not isinstance(rig.structure, Beam):
        return ()
    ends = (("left", rig.structure.left), ("right", rig.structure.right))
    return tuple(name for name, end in ends if end.translation == HELD and end.rotation in (0.0, HELD))


def _with_rotational_spring(rig: Rig, end: str, values: dict[str, float]) -> Rig:
    support: Any = End(HELD, values["rotational_stiffness"])
    return resolved(rig, replace(_beam(rig), **{end: support}))


def _end_stiffness(rig: Rig) -> float:
    beam = _beam(rig)
    return float(beam.bending_stiffness(0.5 * beam.length)) / beam.length


SUPPORT_ROTATION = Kind(
    name="support_rotation",
    path="structure",
    parameters=lambda rig, _: (positive("rotational_stiffness", "N m/rad", _end_stiffness(rig), 1e-4, 1e5),),
    apply=solved_once(_with_rotational_spring),
    starts=lambda reconstruction, _: [
        {"rotational_stiffness": _end_stiffness(reconstruction.rig) * s} for s in np.geomspace(0.01, 3000.0, 16)
    ],
    targets=_ends,
    phrase="a support of finite rotational stiffness",
    fixed_place=lambda support, rig: (
        0.0 if support.target == "left" else _beam(rig).length,
        f"at the {support.target} end",
    ),
)


# --- axial_load


def buckling_load(rig: Rig) -> float:
    """The buckling load of a rig's beam, N."""
    return _buckling_load(_beam(rig))


@lru_cache(maxsize=64)
def _buckling_load(beam: Beam) -> float:
    return beam.buckling_load()


def _with_tension(rig: Rig, _: object, values: dict[str, float]) -> Rig:
    beam = _beam(rig)
    return resolved(rig, replace(beam, tension=beam.tension + values["tension"]))


# start values, of the buckling load
LOADS = (-0.9, -0.6, -0.4, -0.25, -0.15, -0.08, -0.03, 0.03, 0.08, 0.15, 0.25, 0.4, 0.6, 1.0, 1.5, 2.5, 4.0)


def _load_parameters(rig: Rig, _: object) -> tuple[Parameter, ...]:
    load = buckling_load(rig)
    return (Parameter("tension", "N", -4.0 * load, 200.0 * load, scale=0.05 * load, neutral=0.0),)


AXIAL_LOAD = Kind(
    name="axial_load",
    path="structure",
    parameters=_load_parameters,
    apply=solved_once(_with_tension),
    starts=lambda reconstruction, _: [{"tension": share * buckling_load(reconstruction.rig)} for share in LOADS],
    targets=lambda rig: (None,) if isinstance(rig.structure, Beam) else (),
    phrase="an axial load",
)


# --- truncated_modes: no parameter to fit, one start for each number of modes


def _with_modes(rig: Rig, count: int, _: object) -> Rig:
    if rig.structure is None:
        raise ValueError("plain modal data have no further modes; describe the structure as a beam, a rod or a plate")
    if isinstance(rig.structure, Plate):  # the cached solution for the nominal modes has further ones
        return replace(rig, modes=_modes_of_surface(rig.structure, count, solved_for=rig.modes.n_modes))
    return replace(rig, modes=modes_of(rig.structure, count))


def _with_one_mode_fewer(truncation: Effect, rig: Rig) -> tuple[Effect, ...]:
    fewer = truncation.target - 1
    return (Effect(TRUNCATED_MODES, fewer, {}),) if fewer > rig.modes.n_modes else ()


def _with_more_modes(truncation: Effect) -> tuple[Effect, ...]:
    return tuple(Effect(TRUNCATED_MODES, truncation.target + more, {}) for more in (1, 2, 4))


TRUNCATED_MODES = Kind(
    name="truncated_modes",
    path="structure",
    parameters=lambda rig, _: (),
    apply=solved_once(_with_modes),
    starts=lambda reconstruction, _: [{}],
    targets=lambda rig: () if rig.structure is None else tuple(range(rig.modes.n_modes + 1, rig.modes.n_modes + 17)),
    phrase="truncation of the modal model",
    simpler=_with_one_mode_fewer,
    more_general=_with_more_modes,
    exclusive=True,
    adds_modes=True,
    numbers=lambda truncation, rig: {"kept": rig.modes.n_modes, "needed": truncation.target},
    remark=lambda truncation, rig: f"{truncation.target} modes needed, {rig.modes.n_modes} kept",
)


# --- modal_damping


def _with_scaled_damping(rig: Rig, _: object, values: dict[str, float]) -> Rig:
    factor = values["factor"]
    structure = rig.structure
    if structure is None or not isinstance(structure.damping, ModalDamping):
        return replace(rig, modes=replace(rig.modes, damping=rig.modes.damping * factor))
    changed = replace(structure, damping=ModalDamping(np.asarray(structure.damping.zeta) * factor))
    if any(isinstance(part, PointDamper) for part in _attachments(structure)):
        return resolved(rig, changed)
    return replace(rig, structure=changed, modes=replace(rig.modes, damping=rig.modes.damping * factor))


MODAL_DAMPING = Kind(
    name="modal_damping",
    path="structure",
    parameters=lambda rig, _: (Parameter("factor", "", 1e-3, 100.0, logarithmic=True, neutral=1.0),),
    apply=solved_once(_with_scaled_damping),
    starts=lambda reconstruction, _: [
        {"factor": f} for f in (0.2, 0.4, 0.6, 0.8, 0.9, 1.1, 1.25, 1.6, 2.2, 3.0, 5.0, 8.0)
    ],
    phrase="a damping error common to all modes",
)


# --- stiffness_drift

# relative, over a record: start values of either sign
DRIFTS = np.array([0.02, 0.05, 0.08, 0.12, 0.18, 0.27, 0.4, 0.6])


def _drift_starts(reconstruction: Reconstruction, _: object) -> list[dict[str, float]]:
    longest = max(record.n_samples * record.sample_time for record in reconstruction.data.records)
    return [{"rate": float(share / longest)} for share in (*-DRIFTS[::-1], *DRIFTS)]


STIFFNESS_DRIFT = Kind(
    name="stiffness_drift",
    path="structure",
    parameters=lambda rig, _: (
        Parameter("rate", "1/s", -1.0 / Scales.of(rig).time, 10.0 / Scales.of(rig).time, scale=1e-4, neutral=0.0),
    ),
    apply=lambda rig, _, v: replace(rig, stiffness_rate=v["rate"]),
    starts=_drift_starts,
    phrase="a stiffness drift",
)

KINDS = (
    MODULUS_ERROR,
    POINT_MASS,
    LOCAL_STIFFNESS_LOSS,
    SUPPORT_ROTATION,
    AXIAL_LOAD,
    GROUND_SPRING,
    TRUNCATED_MODES,
    MODAL_DAMPING,
    POINT_DAMPER,
    STIFFNESS_DRIFT,
)
