"""Writing a case folder."""

from pathlib import Path
from typing import Any

import numpy as np

from workbench.cases.case import Case
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam, Structure
from workbench.structure.profile import Profile
from workbench.structure.supports import NAMED_ENDS, End


def write_case(case: Case, folder: str | Path) -> Path:
    """Write a case as a folder, case.toml and records/NAME.npz, that `read_case` reads back.

    Raises:
        ValueError: what the format cannot say: a rig without its structure, profiles that are not linear between
            their breaks, attachments, ends without a name, damping that differs from mode to mode.
    """
    folder = Path(folder)
    (folder / "records").mkdir(parents=True, exist_ok=True)
    blocks = [f"title = {_text(case.name)}", _structure(case.rig), *_ports(case.rig)]
    for record, use in [*((r, "fit") for r in case.fit), *((r, "validate") for r in case.validation)]:
        file = f"records/{record.name}.npz"
        arrays: dict[str, Any] = {"t": record.time, **_arrays(record)}
        np.savez_compressed(folder / file, **arrays)
        blocks.append(_table("[[record]]", name=record.name, file=file, sample_time=record.sample_time, use=use))
    path = folder / "case.toml"
    path.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")
    return path


def _arrays(record: Record) -> dict[str, np.ndarray]:
    return {
        **dict(zip(record.input_names, record.inputs, strict=True)),
        **dict(zip(record.output_names, record.outputs, strict=True)),
    }


def _structure(rig: Rig) -> str:
    member = rig.structure
    if member is None:
        raise ValueError("a rig without its structure cannot be written; a case folder tells a beam or a rod")
    if not isinstance(member, Structure):
        raise ValueError("a plate or a finite-element model cannot be written yet; a case folder tells a beam or a rod")
    if member.attachments:
        raise ValueError(f"the case format knows no attachments; take {member.attachments[0]} out of the nominal model")
    damping = np.unique(np.asarray(getattr(member.damping, "zeta", np.nan)))
    if not isinstance(member.damping, ModalDamping) or damping.size != 1:
        raise ValueError("the case format knows one damping ratio for all modes; use ModalDamping(ratio)")
    beam = isinstance(member, Beam)
    stiffness = "bending_stiffness" if beam else "axial_stiffness"
    profiles = {"mass_per_length": member.mass_per_length, stiffness: getattr(member, stiffness)}
    return _table(
        "[structure]",
        kind="beam" if beam else "rod",
        length=member.length,
        **{name: _profile(profile, member.length, name) for name, profile in profiles.items()},
        left=_end(member.left, beam),
        right=_end(member.right, beam),
        damping_ratio=float(damping[0]),
        **({"tension": member.tension} if isinstance(member, Beam) and member.tension else {}),
        modes=rig.modes.n_modes,
    )


def _profile(profile: Profile, length: float, name: str) -> float | dict[str, list[float]]:
    x = np.unique([0.0, *(b for b in profile.breaks if 0 < b < length), length])
    value = profile(x)
    fine = np.linspace(0.0, length, 1001)
    if np.abs(profile(fine) - np.interp(fine, x, value)).max() > 1e-9 * np.abs(value).max():
        raise ValueError(f"{name} is not linear between its breaks; the case format holds points with straight lines")
    return float(value[0]) if np.ptp(value) == 0 else {"x": x.tolist(), "value": value.tolist()}


def _end(end: End, beam: bool) -> str:
    for name in ("hinged", "clamped", "free", "sliding") if beam else ("fixed", "free"):
        if NAMED_ENDS[name] == end:
            return name
    raise ValueError(f"the case format has no name for {end}; use hinged, clamped, free, sliding or fixed")


def _ports(rig: Rig) -> list[str]:
    inputs = [
        _table("[[input]]", name=a.name, kind="hammer" if a.direct else "actuator", at=a.at) for a in rig.actuators
    ]
    outputs = [
        _table("[[output]]", name=s.name, quantity=s.quantity, at=s.at, noise_std=s.noise_std) for s in rig.sensors
    ]
    return [*inputs, *outputs]


def _table(header: str, **entries: object) -> str:
    return "\n".join([header, *(f"{key} = {_value(value)}" for key, value in entries.items())])


def _value(value: Any) -> str:
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return repr(value) if isinstance(value, int) else repr(float(value))


def _text(text: str) -> str:
    kept = "".join(c if c.isprintable() else " " for c in text)
    return '"' + kept.replace("\\", "\\\\").replace('"', '\\"') + '"'
