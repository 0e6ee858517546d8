"""The nominal rig that the tables [structure], [[input]] and [[output]] of a file describe."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from workbench.cases.points import read_points
from workbench.cases.tables import (
    CaseError,
    check_keys,
    count,
    inside,
    number,
    numbers,
    one_of,
    profile,
    shown,
    suggesting,
    table_of,
    tables,
    text,
)
from workbench.records.units import split_unit
from workbench.rig.actuators import Actuator, piezo_patch
from workbench.rig.rig import Rig, Transducer, derivative_of
from workbench.rig.sensors import MEASURED, Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints, Place, PlaceError
from workbench.structure.member import Bar, Beam, Structure
from workbench.structure.modes import Modes, PointShapes
from workbench.structure.plate import Plate
from workbench.structure.supports import SIDES

MOST_MODES = 200
PLATE_TOLERANCE = 1e-5  # of frequencies; where a clamped edge meets a free one, 1e-6 may need too many functions

# The keys of each table; any other key is refused as a misspelling.
TABLES = ("title", "input_hold", "units", "channels", "structure", "input", "output", "record")
MEMBER = ("kind", "length", "mass_per_length", "left", "right", "damping_ratio", "modes")
STRUCTURES = {"beam": (*MEMBER, "bending_stiffness", "tension"), "rod": (*MEMBER, "axial_stiffness")}
KINDS = (*STRUCTURES, "plate", "modal")
MODAL = ("kind", "natural_frequencies_hz", "damping_ratios", "rigid_damping", "points")
PLATE = ("kind", "length", "mass_per_area", "bending_stiffness", "poisson_ratio", "edges", "damping_ratio", "modes")
ENDS = {"beam": ("hinged", "clamped", "free", "sliding"), "rod": ("fixed", "free")}
EDGE = ("simply supported", "clamped", "guided", "free")
# What others call ends and edges. A rod has no bending: whatever holds its end fixes it.
PINNED = ("pinned", "simply supported", "supported")
BUILT_IN = ("fixed", "built in")
SYNONYMS: dict[str, dict[str, str]] = {
    "beam": {**dict.fromkeys(PINNED, "hinged"), **dict.fromkeys(BUILT_IN, "clamped"), "guided": "sliding"},
    "rod": dict.fromkeys((*PINNED, *BUILT_IN, "hinged", "clamped"), "fixed"),
    "plate": {
        **dict.fromkeys(("pinned", "supported", "hinged"), "simply supported"),
        **dict.fromkeys(BUILT_IN, "clamped"),
        "sliding": "guided",
    },
}
SINGLE = ("kind", "mass", "damping", "stiffness")
INPUT, OUTPUT = ("name", "kind"), ("name", "quantity", "noise_std")
# Further keys of an input and of an output, for moments, patches and directions, by the kind of structure.
MORE: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "beam": (("quantity", "patch"), ()),
    "rod": ((), ()),
    "plate": (("quantity", "patch", "axis"), ("axis",)),
    "points": (("quantity", "axis", "direction"), ("axis", "direction")),
    "modal": ((), ()),
}
ACTING = ("force", "moment")  # quantities of an input; the first is the default


def read_rig(path: str | Path) -> Rig:
    """A rig from a TOML file with [structure], [[input]] and [[output]] of the case format; records are not read.

    Raises:
        CaseError: naming the file, the key, the value, and what would be right.
    """
    path = Path(path)
    if not path.is_file():
        raise CaseError(f"{path}: there is no such file")
    return rig_of(table_of(path), path)


def rig_of(table: dict[str, Any], path: Path) -> Rig:
    """The rig that the tables of a file describe; see `read_rig`."""
    check_keys(table, TABLES, str(path))
    inputs, outputs = tables(table, "input", path), tables(table, "output", path)
    names = [entry["name"] for entry in (*inputs, *outputs)]
    for name in names:
        if name == "t" or names.count(name) > 1:
            raise CaseError(
                f"{path}: the name {name!r} of an input or output is taken by another or by time; rename it"
            )
        bare, unit = split_unit(name)
        if unit:
            raise CaseError(
                f"{path}: the name {shown(name)} of an input or output ends in a unit, {unit}, which is not converted"
                f" here: name it {shown(bare)}, and state units in the record's file"
            )
    structure = table.get("structure")
    if not isinstance(structure, dict):
        raise CaseError(f"{path}: the table [structure] is missing")
    try:
        if structure.get("kind") == "plate":
            return _plate_rig(structure, inputs, outputs)
        if structure.get("kind") == "modal":
            return _modal_rig(structure, inputs, outputs, path)
        units = table.get("units")
        unit = units.get("length", "m") if isinstance(units, dict) else "m"
        return _member_rig(structure, inputs, outputs, str(unit))
    except (ValueError, TypeError, ArithmeticError) as error:
        raise CaseError(f"{path}: {error}") from error


def _member_rig(table: dict[str, Any], inputs: list[dict[str, Any]], outputs: list[dict[str, Any]], unit: str) -> Rig:
    """The rig of a rod or a beam, whose lengths are in a unit."""
    kind = "rod" if table.get("kind") == "bar" else table.get("kind")  # synonyms
    if not isinstance(kind, str) or kind not in STRUCTURES:
        raise CaseError(f"[structure]: kind is beam, rod, plate or modal; got {suggesting(kind, KINDS)}")
    check_keys(table, STRUCTURES[kind], "[structure]")
    _check_transducers(inputs, outputs, "at", kind)
    common: dict[str, Any] = {
        "length": number(table, "length", "[structure]"),
        "mass_per_length": profile(table, "mass_per_length"),
        **{side: one_of(table, side, ENDS[kind], "[structure]", synonyms=SYNONYMS[kind]) for side in ("left", "right")},
        "damping": ModalDamping(number(table, "damping_ratio", "[structure]", low=0.0)),
    }
    structure: Structure
    if kind == "beam":
        structure = Beam(
            bending_stiffness=profile(table, "bending_stiffness"),
            tension=number(table, "tension", "[structure]") if "tension" in table else 0.0,
            **common,
        )
    else:
        structure = Bar(axial_stiffness=profile(table, "axial_stiffness"), **common)
    modes = structure.modes(count(table, "modes", MOST_MODES), tolerance=1e-9)
    return _rig_of(modes, inputs, outputs, lambda e, where: _place(e, structure.length, unit, where), structure)


def _plate_rig(table: dict[str, Any], inputs: list[dict[str, Any]], outputs: list[dict[str, Any]]) -> Rig:
    check_keys(table, PLATE, "[structure]")
    _check_transducers(inputs, outputs, "at", "plate")
    edges = table.get("edges")
    if not isinstance(edges, dict):
        raise CaseError(f"[structure]: edges must be a table of {', '.join(SIDES)}; got {shown(edges)}")
    check_keys(edges, SIDES, "[structure] edges")
    a, b = numbers(table, "length", "[structure]", 2)
    structure = Plate(
        length=(float(a), float(b)),
        mass_per_area=number(table, "mass_per_area", "[structure]", low=0.0),
        bending_stiffness=number(table, "bending_stiffness", "[structure]", low=0.0),
        poisson_ratio=number(table, "poisson_ratio", "[structure]"),
        edges={side: one_of(edges, side, EDGE, "[structure] edges", synonyms=SYNONYMS["plate"]) for side in SIDES},
        damping=ModalDamping(number(table, "damping_ratio", "[structure]", low=0.0)),
    )
    modes = structure.modes(count(table, "modes", MOST_MODES), tolerance=PLATE_TOLERANCE)
    return _rig_of(modes, inputs, outputs, lambda e, where: tuple(numbers(e, "at", where, 2).tolist()), structure)


def _modal_rig(table: dict[str, Any], inputs: list[dict[str, Any]], outputs: list[dict[str, Any]], path: Path) -> Rig:
    """The rig of modal data, or of a single degree of freedom with mass, damping and stiffness.

    Mode shapes are given at each input and output, or at named points in a CSV table of the case folder.
    """
    at_points = "points" in table
    single = "mass" in table and not at_points
    check_keys(table, SINGLE if single else MODAL, "[structure]")
    _check_transducers(inputs, outputs, "point" if at_points else "shape", "points" if at_points else "modal")
    transducers = [("[[input]]", e) for e in inputs] + [("[[output]]", e) for e in outputs]
    points = NamedPoints(tuple(e["name"] for _, e in transducers))
    if single:
        mass = number(table, "mass", "[structure]", low=1e-300)
        stiffness = number(table, "stiffness", "[structure]", low=0.0)
        omega = np.array([np.sqrt(stiffness / mass)])
        damping = np.array([[number(table, "damping", "[structure]", low=0.0) / mass]])
        for _, entry in transducers:
            if entry.get("shape", [1.0]) != [1.0]:
                raise CaseError(f"{entry['name']!r}: the shape of a single degree of freedom is [1.0]; leave it out")
        values = np.full((len(transducers), 1), 1.0 / np.sqrt(mass))
    else:
        omega = 2.0 * np.pi * numbers(table, "natural_frequencies_hz", "[structure]")
        damping = _modal_damping(table, omega)
        if at_points:
            file = inside(path.parent, text(table, "points", "[structure]"), "[structure] points")
            points, values = read_points(file, omega.size)
        else:
            values = np.array([numbers(e, "shape", f"{key} {e['name']!r}", omega.size) for key, e in transducers])
    modes = Modes(omega=omega, damping=damping, shapes=PointShapes(values), domain=points)
    return _rig_of(modes, inputs, outputs, lambda e, where: text(e, "point", where) if at_points else e["name"])


def _rig_of(
    modes: Modes,
    inputs: list[dict[str, Any]],
    outputs: list[dict[str, Any]],
    place: Callable[[dict[str, Any], str], Place],
    structure: Structure | Plate | None = None,
) -> Rig:
    """The rig with these inputs and outputs; `place` returns the place of an entry."""
    actuators = tuple(_actuator(e, place(e, f"[[input]] {e['name']!r}"), modes) for e in inputs)
    sensors = tuple(_sensor(e, place(e, f"[[output]] {e['name']!r}"), modes) for e in outputs)
    return Rig(modes, actuators, sensors, structure=structure)


def _modal_damping(table: dict[str, Any], omega: np.ndarray) -> np.ndarray:
    """Coefficients c_rs (n_modes, n_modes), 1/s: 2 ζ_r ω_r, and for rigid modes `rigid_damping`, or zero."""
    rates = 2.0 * numbers(table, "damping_ratios", "[structure]", omega.size) * omega
    if "rigid_damping" in table:
        rigid = omega == 0
        if not rigid.any():
            raise CaseError("[structure]: rigid_damping is for modes of 0 Hz, and there are none; leave it out")
        rates[rigid] = numbers(table, "rigid_damping", "[structure]", int(rigid.sum()))
    return np.diag(rates)


def _check_transducers(inputs: list[dict[str, Any]], outputs: list[dict[str, Any]], place: str, kind: str) -> None:
    more = MORE[kind]
    for key, entries, keys in (("input", inputs, (*INPUT, *more[0])), ("output", outputs, (*OUTPUT, *more[1]))):
        for entry in entries:
            check_keys(entry, (*keys, place), f"[[{key}]] {entry['name']!r}")


def _check_place(transducer: Transducer, modes: Modes, where: str) -> None:
    """Refuse a place outside the structure, or a direction or axis that the structure does not have at this place."""
    try:
        modes.phi_at(transducer.at, derivative_of(transducer), direction=transducer.direction)
    except PlaceError as error:
        raise CaseError(f"{where}: {error}") from None


def _direction(entry: dict[str, Any], turning: bool, where: str) -> str | None:
    """The direction of a force or a motion, or the axis of a moment or a rotation; None where none is given."""
    key, other = ("axis", "direction") if turning else ("direction", "axis")
    if other in entry:
        what = "moment, slope or angular velocity" if turning else "force or displacement, velocity or acceleration"
        raise CaseError(f"{where}: a {what} has no {other}; give {key}")
    return text(entry, key, where) if key in entry else None


def _place(entry: dict[str, Any], length: float, unit: str, where: str) -> float:
    at = number(entry, "at", where)
    if not 0 <= at <= length:
        raise CaseError(f"{where}: at = {at:g} {unit} is outside the structure, which runs 0 to {length:g} {unit}")
    return at


def _actuator(entry: dict[str, Any], at: Place, modes: Modes) -> Actuator:
    """An input: a force, a moment, or a piezo patch."""
    kind, where = entry.get("kind"), f"[[input]] {entry['name']!r}"
    if kind not in ("actuator", "hammer"):
        raise CaseError(f"{where}: kind is actuator (a command) or hammer (a measured force); got {shown(kind)}")
    if "patch" in entry:
        actuator = _patch(entry, at, where)
    else:
        quantity = entry.get("quantity", ACTING[0])
        if quantity not in ACTING:
            raise CaseError(f"{where}: quantity is {' or '.join(ACTING)}; got {shown(quantity)}")
        turning = quantity == "moment"
        if turning and kind == "hammer":
            raise CaseError(f"{where}: kind hammer is a measured force; for a moment the kind is actuator")
        direction = _direction(entry, turning, where)
        actuator = Actuator(entry["name"], at, quantity, direct=kind == "hammer", direction=direction)
    _check_place(actuator, modes, where)
    return actuator


def _patch(entry: dict[str, Any], at: Place, where: str) -> Actuator:
    if entry["kind"] == "hammer":
        raise CaseError(f"{where}: the kind of a patch is actuator, not hammer")
    if entry.get("quantity", "moment") != "moment":
        raise CaseError(f"{where}: a patch acts by moments along its edges; leave quantity out")
    on_plate = isinstance(at, tuple)
    length: Any = tuple(numbers(entry, "patch", where, 2).tolist()) if on_plate else number(entry, "patch", where)
    axis = entry.get("axis")
    if axis not in (None, "x", "y"):
        raise CaseError(f"{where}: axis is x or y, or left out for moments about both; got {shown(axis)}")
    try:
        return piezo_patch(entry["name"], at, length=length, direction=axis)
    except ValueError as error:
        raise CaseError(f"{where}: {error}") from error


def _sensor(entry: dict[str, Any], at: Place, modes: Modes) -> Sensor:
    where = f"[[output]] {entry['name']!r}"
    quantity = entry.get("quantity")
    if quantity not in MEASURED:
        raise CaseError(f"{where}: quantity is one of {', '.join(MEASURED)}; got {suggesting(quantity, MEASURED)}")
    noise = number(entry, "noise_std", where, low=0.0) if "noise_std" in entry else 0.0
    if noise == 0 and "noise_std" in entry:
        raise CaseError(f"{where}: noise_std must be positive; leave it out where it is not known")
    direction = _direction(entry, MEASURED[quantity][0] == 1, where)
    sensor = Sensor(entry["name"], at, quantity, noise_std=noise, direction=direction)
    _check_place(sensor, modes, where)
    return sensor
