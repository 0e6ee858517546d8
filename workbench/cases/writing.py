"""Writing a case folder."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from workbench.cases.case import Case, signals_of
from workbench.cases.nominal import EDGE, ENDS
from workbench.cases.points import write_points
from workbench.records.npz_file import write_arrays
from workbench.records.units import SI
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig, Transducer, derivative_of
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import Between, NamedPoints, Patch, middle, position
from workbench.structure.member import Beam, Structure
from workbench.structure.modes import Modes
from workbench.structure.plate import Plate
from workbench.structure.profile import Profile
from workbench.structure.supports import NAMED_EDGES, NAMED_ENDS, Support

POINTS = "points.csv"


def write_case(case: Case, folder: str | Path) -> Path:
    """Write a case as a folder, case.toml and records/NAME.npz, that `read_case` reads back.

    The named points of a rig are written to points.csv in the folder.

    Raises:
        ValueError: the format has no key for: profiles that are not linear between their breaks, a plate with varying
            properties, attachments, ends or edges without a name, damping that differs between the modes of a
            structure or couples them, inputs other than ideal point forces, moments and piezo patches, elements.
    """
    folder = Path(folder)
    (folder / "records").mkdir(parents=True, exist_ok=True)
    units = [] if case.units == SI else [_table("[units]", **asdict(case.units))]
    blocks = [f"title = {_value(case.name)}", *units, *_rig(case.rig, folder)]
    for record, use in [*((r, "fit") for r in case.fit), *((r, "validate") for r in case.validation)]:
        name = record.name.replace("%", "%25").replace("/", "%2F").replace("\\", "%5C")  # it names no folder
        file = f"records/{name}.npz"
        write_arrays(folder / file, signals_of(record))
        hold = {} if record.input_hold == "zero" else {"input_hold": record.input_hold}
        entry = {"name": record.name, "file": file, "sample_time": record.sample_time, "use": use, **hold}
        blocks.append(_table("[[record]]", **entry))
    path = folder / "case.toml"
    path.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")
    return path


def _rig(rig: Rig, folder: Path) -> list[str]:
    """The tables [structure], [[input]] and [[output]]; named points are written to a table in the folder."""
    _check_transducers(rig)
    structure, points = rig.structure, rig.modes.domain
    if isinstance(structure, Structure):
        return [_member(structure, rig.modes.n_modes), *_transducers(rig, at=_along)]
    if isinstance(structure, Plate):
        return [_plate(structure, rig.modes.n_modes), *_transducers(rig, at=_over)]
    if not isinstance(points, NamedPoints):
        raise ValueError(
            "a case folder describes a beam, a rod, a plate, or modes at named points; this rig is a membrane, or has"
            " no structure"
        )
    write_points(folder / POINTS, points, rig.modes.phi(points.names))
    return [_modal(rig.modes), *_transducers(rig, at=lambda transducer: {"point": transducer.at})]


def _member(member: Structure, n_modes: int) -> str:
    if any(member.frequency_errors):
        raise ValueError("the case format has no frequency_errors of a structure: its frequencies are computed")
    kind = "beam" if isinstance(member, Beam) else "rod"
    profiles = {"mass_per_length": member.mass_per_length, member.stiffness_name: member.stiffness}
    return _table(
        "[structure]",
        kind=kind,
        length=member.length,
        **{name: _profile(profile, member.length, name) for name, profile in profiles.items()},
        left=_named(member.left, ENDS[kind], NAMED_ENDS),
        right=_named(member.right, ENDS[kind], NAMED_ENDS),
        damping_ratio=_damping_ratio(member),
        **({"tension": member.tension} if isinstance(member, Beam) and member.tension else {}),
        modes=n_modes,
    )


def _plate(plate: Plate, n_modes: int) -> str:
    constants = {"mass_per_area": plate.mass_per_area, "bending_stiffness": plate.bending_stiffness}
    for name, quantity in constants.items():
        if not quantity.is_constant:
            raise ValueError(f"{name} varies over the plate; the case format has one number for the whole plate")
    if any(plate.tension):
        raise ValueError(f"the case format has no tension of a plate; got {plate.tension} N/m")
    return _table(
        "[structure]",
        kind="plate",
        length=list(plate.length),
        **{name: float(quantity(0.0, 0.0)) for name, quantity in constants.items()},
        poisson_ratio=plate.poisson_ratio,
        edges={side: _named(edge, EDGE, NAMED_EDGES) for side, edge in plate.edges.items()},
        damping_ratio=_damping_ratio(plate),
        modes=n_modes,
    )


def _modal(modes: Modes) -> str:
    if not modes.proportional:
        raise ValueError("the case format has no damping that couples modes; keep the diagonal of Modes.damping")
    rigid = modes.omega == 0
    rates = np.diag(modes.damping)[rigid].tolist()
    return _table(
        "[structure]",
        kind="modal",
        natural_frequencies_hz=modes.frequencies_hz.tolist(),
        damping_ratios=modes.zeta.tolist(),
        **({"rigid_damping": rates} if any(rates) else {}),
        points=POINTS,
    )


def _damping_ratio(structure: Structure | Plate) -> float:
    if structure.attachments:
        part = structure.attachments[0]
        raise ValueError(f"the case format has no attachments; take {part} out of the nominal model")
    ratio = np.unique(np.asarray(getattr(structure.damping, "zeta", np.nan)))
    if not isinstance(structure.damping, ModalDamping) or ratio.size != 1:
        raise ValueError("the case format has one damping ratio for all modes; use ModalDamping(ratio)")
    return float(ratio[0])


def _profile(profile: Profile, length: float, name: str) -> float | dict[str, list[float]]:
    at = np.unique([0.0, *(b for b in profile.breaks if 0 < b < length), length])
    left, here, right = (
        profile(np.clip(x, 0.0, length)) for x in (np.nextafter(at, -np.inf), at, np.nextafter(at, np.inf))
    )
    rounding = 1e-9 * np.abs(here).max()
    sides = [(a, b) if abs(b - a) > rounding else (value,) for a, value, b in zip(left, here, right)]
    x, value = np.repeat(at, [len(each) for each in sides]), np.concatenate(sides)  # a jump is two points at one place
    fine = np.setdiff1d(np.linspace(0.0, length, 1001), at)
    if np.abs(profile(fine) - np.interp(fine, x, value)).max() > rounding:
        raise ValueError(f"{name} is not linear between its breaks; the case format interpolates linearly")
    return float(value[0]) if np.ptp(value) == 0 else {"x": x.tolist(), "value": value.tolist()}


def _named(support: Support, names: tuple[str, ...], known: Mapping[str, Support]) -> str:
    for name in names:
        if known[name] == support:
            return name
    raise ValueError(f"the case format has no name for {support}; use {', '.join(names)}")


def _check_transducers(rig: Rig) -> None:
    """Refuse properties of actuators, sensors and elements that a case file cannot describe, by a `ValueError`."""
    if rig.elements:
        raise ValueError(
            f"the case format has no elements of the nominal rig; take {type(rig.elements[0]).__name__} out"
        )
    moments = isinstance(rig.structure, Beam | Plate) or isinstance(rig.modes.domain, NamedPoints)
    described = {"name", "at", "quantity", "direct", "noise_std"}
    described |= set() if isinstance(rig.structure, Structure) else {"direction"}
    transducers: tuple[Transducer, ...] = (*rig.actuators, *rig.sensors)
    for transducer in transducers:
        moment = isinstance(transducer, Actuator) and transducer.quantity == "moment"
        changed = [f.name for f in fields(transducer) if getattr(transducer, f.name) != f.default]
        other = [name for name in changed if name not in described]
        other += ["a moment"] * (moment and not moments)
        if other or (isinstance(transducer.at, Between) and not (moment and isinstance(rig.structure, Beam))):
            raise ValueError(
                f"{transducer.name!r} has {other[0] if other else 'two places'}; the case format describes only ideal"
                " point forces, moments, piezo patches and sensors at one place"
            )


def _transducers(rig: Rig, *, at: Callable[[Transducer], dict[str, Any]]) -> list[str]:
    """Tables of the inputs and outputs; `at` returns the keys and values of a place."""
    blocks = []
    for a in rig.actuators:
        kind = "hammer" if a.direct else "actuator"
        at_point = not isinstance(a.at, Patch | Between)
        quantity = {"quantity": "moment"} if a.quantity == "moment" and at_point else {}
        blocks.append(_table("[[input]]", name=a.name, kind=kind, **quantity, **at(a), **_direction(a)))
    for s in rig.sensors:
        noise = {"noise_std": s.noise_std} if s.noise_std else {}
        blocks.append(_table("[[output]]", name=s.name, quantity=s.quantity, **at(s), **_direction(s), **noise))
    return blocks


def _direction(transducer: Transducer) -> dict[str, str]:
    """The key of the direction of a force or motion, or of the axis of a moment or rotation; none if it has none."""
    turning = derivative_of(transducer) == 1
    across = not turning and not isinstance(transducer.at, str)  # a plate moves along its normal
    if transducer.direction is None or across:
        return {}
    return {"axis" if turning else "direction": transducer.direction}


def _along(transducer: Transducer) -> dict[str, Any]:
    """Keys of a place along a member, and of the length of a patch."""
    if isinstance(transducer.at, Between):
        return {"at": middle(transducer.at), "patch": position(transducer.at.first) - position(transducer.at.second)}
    return {"at": transducer.at}


def _over(transducer: Transducer) -> dict[str, Any]:
    """Keys of a place on a plate, and of the sides of a patch."""
    if isinstance(transducer.at, Patch):
        return {"at": list(transducer.at[:2]), "patch": [transducer.at.width, transducer.at.height]}
    return {"at": list(transducer.at)}  # type: ignore[arg-type]


def _table(header: str, **entries: object) -> str:
    return "\n".join([header, *(f"{key} = {_value(value)}" for key, value in entries.items())])


def _value(value: Any) -> str:
    """A value in TOML, which writes texts, numbers and lists as JSON does."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, str):
        value = "".join(c if c.isprintable() else " " for c in value)
    return json.dumps(value, ensure_ascii=False, allow_nan=False, default=float)
