"""A case folder: a nominal model, and records measured on the real structure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
    table_of,
    tables,
    text,
)
from workbench.records.files import read_record
from workbench.records.limits import RecordFileError, check_file
from workbench.records.npz_file import arrays as load_arrays
from workbench.records.record import HOLDS, Channel, Record
from workbench.records.units import SI, Units, split_unit
from workbench.rig.actuators import Actuator, piezo_patch
from workbench.rig.rig import Rig, derivative_of
from workbench.rig.sensors import MEASURED, Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints, Place, PlaceError
from workbench.structure.member import Bar, Beam, Structure
from workbench.structure.modes import Modes, PointShapes
from workbench.structure.plate import Plate

MOST_SAMPLES = 5_000_000
LEAST_SAMPLES = 16
MOST_MODES = 200
PLATE_TOLERANCE = 1e-5  # of frequencies; where a clamped edge meets a free one, 1e-6 may need too many functions

# The keys of each table; any other key is refused as a misspelling.
TABLES = ("title", "input_hold", "units", "structure", "input", "output", "record")
UNITS = ("length", "mass", "time", "force")
MEMBER = ("kind", "length", "mass_per_length", "left", "right", "damping_ratio", "modes")
STRUCTURES = {"beam": (*MEMBER, "bending_stiffness", "tension"), "rod": (*MEMBER, "axial_stiffness")}
MODAL = ("kind", "natural_frequencies_hz", "damping_ratios", "rigid_damping", "points")
PLATE = ("kind", "length", "mass_per_area", "bending_stiffness", "poisson_ratio", "edges", "damping_ratio", "modes")
EDGES = ("left", "right", "bottom", "top")
ENDS = {"beam": ("hinged", "clamped", "free", "sliding"), "rod": ("fixed", "free")}
EDGE = ("simply supported", "clamped", "guided", "free")
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
RECORD = ("name", "file", "sample_time", "use", "input_hold")


@dataclass(frozen=True, eq=False)
class Case:
    """A nominal model and the records of a test with which it disagrees.

    Attributes:
        name: of the case folder.
        rig: the nominal rig.
        fit: records for fitting.
        validation: records for validation only, on which the reduction of the gap is measured.
        units: the units of the case.
    """

    name: str
    rig: Rig
    fit: tuple[Record, ...]
    validation: tuple[Record, ...]
    units: Units = SI


def read_case(folder: str | Path) -> Case:
    """Read a case folder: case.toml and its records.

    Raises:
        CaseError: naming the file, the key or channel, the value, and what would be right.
    """
    folder = Path(folder)
    path = folder / "case.toml"
    if not folder.is_dir():
        raise CaseError(f"{folder} is not a folder; a case is a folder with case.toml and records")
    if not path.is_file():
        raise CaseError(f"{folder} has no case.toml, so it is not a case folder")
    table = table_of(path)
    rig = _rig(table, path)
    hold, units = _hold(table, str(path)), _units(table, path)
    records = [
        (_read_record(folder, {"input_hold": hold, **entry}, rig, path, units), _use(entry, path))
        for entry in tables(table, "record", path)
    ]
    fit = tuple(record for record, use in records if use == "fit")
    if not fit:
        raise CaseError(f'{path}: no record has use = "fit"; a diagnosis needs at least one')
    return Case(
        name=folder.resolve().name,
        rig=rig,
        fit=fit,
        validation=tuple(record for record, use in records if use == "validate"),
        units=units,
    )


def files_of(folder: str | Path) -> list[Path]:
    """The files that a case reads beside case.toml: mode shapes at points, then the records, each once."""
    path = Path(folder) / "case.toml"
    table = table_of(path)
    named = [table["structure"].get("points"), *(entry.get("file") for entry in tables(table, "record", path))]
    return list(dict.fromkeys(path.parent / file for file in named if isinstance(file, str)))


def _units(table: dict[str, Any], path: Path) -> Units:
    """Units of a case, SI unless given; all four must be given, and the unit of force must be that of the others."""
    if "units" not in table:
        return SI
    units, where = table["units"], f"{path}: [units]"
    if not isinstance(units, dict):
        raise CaseError(f"{where} must be a table of {', '.join(UNITS)}; got {shown(units)}")
    check_keys(units, UNITS, where)
    missing = [name for name in UNITS if name not in units]
    if missing:
        raise CaseError(f"{where}: {missing[0]} is missing; name all of {', '.join(UNITS)}")
    found = Units(**{name: text(units, name, where) for name in UNITS})
    try:
        found.check_known()
    except ValueError as error:
        raise CaseError(f"{where}: {error}") from None
    ratio = found.consistency
    if ratio is not None and abs(ratio - 1.0) > 1e-3:
        product = f"{found.mass} {found.length}/{found.time}^2"
        raise CaseError(
            f"{where} must be consistent: a force of 1 {product} is {ratio:.6g} {found.force}; with m, kg, s it is 1 N,"
            " with mm, t, s too"
        )
    return found


def in_units(channels: Sequence[Channel], units: Units) -> tuple[Channel, ...]:
    """Channels of a rig, whose units are SI, with the unit names of a case."""
    return tuple(replace(channel, unit=units.named(channel.unit)) for channel in channels)


def read_units(path: str | Path) -> Units:
    """The units that a TOML file of the case format names, in which results are reported; SI if it names none.

    Raises:
        CaseError: naming the file, the key, the value, and what would be right.
    """
    return _units(table_of(Path(path)), Path(path))


def read_rig(path: str | Path) -> Rig:
    """A rig from a TOML file with [structure], [[input]] and [[output]] of the case format; records are not read.

    Raises:
        CaseError: naming the file, the key, the value, and what would be right.
    """
    path = Path(path)
    if not path.is_file():
        raise CaseError(f"{path}: there is no such file")
    return _rig(table_of(path), path)


def _rig(table: dict[str, Any], path: Path) -> Rig:
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
        if structure.get("kind") != "modal":
            return _member_rig(structure, inputs, outputs)
        if "points" in structure:
            return _rig_at_points(structure, inputs, outputs, path)
        return _modal_rig(structure, inputs, outputs)
    except (ValueError, TypeError, ArithmeticError) as error:
        raise CaseError(f"{path}: {error}") from error


# --- rigs


def _member_rig(table: dict[str, Any], inputs: list[dict[str, Any]], outputs: list[dict[str, Any]]) -> Rig:
    kind = "rod" if table.get("kind") == "bar" else table.get("kind")  # synonyms
    if not isinstance(kind, str) or kind not in STRUCTURES:
        raise CaseError(f"[structure]: kind is beam, rod, plate or modal; got {shown(kind)}")
    check_keys(table, STRUCTURES[kind], "[structure]")
    _check_ports(inputs, outputs, "at", kind)
    common: dict[str, Any] = {
        "length": number(table, "length", "[structure]"),
        "mass_per_length": profile(table, "mass_per_length"),
        **{side: one_of(table, side, ENDS[kind], "[structure]") for side in ("left", "right")},
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
    return _rig_of(modes, inputs, outputs, lambda e, where: _place(e, structure.length, where), structure)


def _plate_rig(table: dict[str, Any], inputs: list[dict[str, Any]], outputs: list[dict[str, Any]]) -> Rig:
    check_keys(table, PLATE, "[structure]")
    _check_ports(inputs, outputs, "at", "plate")
    edges = table.get("edges")
    if not isinstance(edges, dict):
        raise CaseError(f"[structure]: edges must be a table of {', '.join(EDGES)}; got {shown(edges)}")
    check_keys(edges, EDGES, "[structure] edges")
    a, b = numbers(table, "length", "[structure]", 2)
    structure = Plate(
        length=(float(a), float(b)),
        mass_per_area=number(table, "mass_per_area", "[structure]", low=0.0),
        bending_stiffness=number(table, "bending_stiffness", "[structure]", low=0.0),
        poisson_ratio=number(table, "poisson_ratio", "[structure]"),
        edges={side: one_of(edges, side, EDGE, "[structure] edges") for side in EDGES},
        damping=ModalDamping(number(table, "damping_ratio", "[structure]", low=0.0)),
    )
    modes = structure.modes(count(table, "modes", MOST_MODES), tolerance=PLATE_TOLERANCE)
    return _rig_of(modes, inputs, outputs, lambda e, where: tuple(numbers(e, "at", where, 2).tolist()), structure)


def _modal_rig(table: dict[str, Any], inputs: list[dict[str, Any]], outputs: list[dict[str, Any]]) -> Rig:
    """The rig of modal data in the case file, or of a single degree of freedom with mass, damping and stiffness."""
    single = "mass" in table
    check_keys(table, SINGLE if single else MODAL, "[structure]")
    _check_ports(inputs, outputs, "shape", "modal")
    if single:
        mass = number(table, "mass", "[structure]", low=1e-300)
        stiffness = number(table, "stiffness", "[structure]", low=0.0)
        omega = np.array([np.sqrt(stiffness / mass)])
        damping = np.array([[number(table, "damping", "[structure]", low=0.0) / mass]])
        shape = np.array([1.0 / np.sqrt(mass)])
        for entry in (*inputs, *outputs):
            if entry.get("shape", [1.0]) != [1.0]:
                raise CaseError(f"{entry['name']!r}: the shape of a single degree of freedom is [1.0]; leave it out")
        values = np.tile(shape, (len(inputs) + len(outputs), 1))
    else:
        omega = 2.0 * np.pi * numbers(table, "natural_frequencies_hz", "[structure]")
        damping = _modal_damping(table, omega)
        ports = [("[[input]]", e) for e in inputs] + [("[[output]]", e) for e in outputs]
        values = np.array([numbers(e, "shape", f"{key} {e['name']!r}", omega.size) for key, e in ports])
    points = NamedPoints(tuple(e["name"] for e in (*inputs, *outputs)))
    modes = Modes(omega=omega, damping=damping, shapes=PointShapes(values), domain=points)
    return _rig_of(modes, inputs, outputs, lambda e, _: e["name"])


def _rig_at_points(
    table: dict[str, Any], inputs: list[dict[str, Any]], outputs: list[dict[str, Any]], path: Path
) -> Rig:
    """The rig of modal data at named points; the points and mode shapes are in a CSV table of the case folder."""
    check_keys(table, MODAL, "[structure]")
    _check_ports(inputs, outputs, "point", "points")
    omega = 2.0 * np.pi * numbers(table, "natural_frequencies_hz", "[structure]")
    damping = _modal_damping(table, omega)
    file = inside(path.parent, text(table, "points", "[structure]"), "[structure] points")
    points, values = read_points(file, omega.size)
    modes = Modes(omega=omega, damping=damping, shapes=PointShapes(values), domain=points)
    return _rig_of(modes, inputs, outputs, lambda e, where: text(e, "point", where))


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


def _check_ports(inputs: list[dict[str, Any]], outputs: list[dict[str, Any]], place: str, kind: str) -> None:
    more = MORE[kind]
    for key, entries, keys in (("input", inputs, (*INPUT, *more[0])), ("output", outputs, (*OUTPUT, *more[1]))):
        for entry in entries:
            check_keys(entry, (*keys, place), f"[[{key}]] {entry['name']!r}")


def _check_place(port: Actuator | Sensor, modes: Modes, where: str) -> None:
    """Refuse a place outside the structure, or a direction or axis that the structure does not have at this place."""
    try:
        modes.phi_at(port.at, derivative_of(port), direction=port.direction)
    except PlaceError as error:
        raise CaseError(f"{where}: {error}") from None


def _direction(entry: dict[str, Any], turning: bool, where: str) -> str | None:
    """The direction of a force or a motion, or the axis of a moment or a rotation; None where none is given."""
    key, other = ("axis", "direction") if turning else ("direction", "axis")
    if other in entry:
        what = "moment, slope or angular velocity" if turning else "force or displacement, velocity or acceleration"
        raise CaseError(f"{where}: a {what} has no {other}; give {key}")
    return text(entry, key, where) if key in entry else None


def _place(entry: dict[str, Any], length: float, where: str) -> float:
    at = number(entry, "at", where)
    if not 0 <= at <= length:
        raise CaseError(f"{where}: at = {at:g} is outside the structure, which runs 0 to {length:g}")
    return at


def _actuator(entry: dict[str, Any], at: Place, modes: Modes) -> Actuator:
    """An input: a force, a moment, or a piezo patch."""
    kind, where = entry.get("kind"), f"[[input]] {entry['name']!r}"
    if kind not in ("actuator", "hammer"):
        raise CaseError(f"{where}: kind is actuator or hammer; got {shown(kind)}")
    if "patch" in entry:
        actuator = _patch(entry, at, where)
    else:
        quantity = entry.get("quantity", ACTING[0])
        if quantity not in ACTING:
            raise CaseError(f"{where}: quantity is {' or '.join(ACTING)}; got {shown(quantity)}")
        turning = quantity == "moment"
        if turning and kind == "hammer":
            raise CaseError(f"{where}: a hammer gives a force; for a moment the kind is actuator")
        direction = _direction(entry, turning, where)
        actuator = Actuator(entry["name"], at, quantity, direct=kind == "hammer", direction=direction)
    _check_place(actuator, modes, where)
    return actuator


def _patch(entry: dict[str, Any], at: Place, where: str) -> Actuator:
    if entry["kind"] == "hammer":
        raise CaseError(f"{where}: the kind of a patch is actuator, not hammer")
    if entry.get("quantity", "moment") != "moment":
        raise CaseError(f"{where}: a patch acts by moments along its edges; leave quantity out")
    length: float | tuple[float, float]
    if isinstance(at, tuple):
        width, height = numbers(entry, "patch", where, 2).tolist()
        length = (width, height)
    else:
        length = number(entry, "patch", where)
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
        raise CaseError(f"{where}: quantity is one of {', '.join(MEASURED)}; got {shown(quantity)}")
    noise = number(entry, "noise_std", where, low=0.0) if "noise_std" in entry else 0.0
    if noise == 0 and "noise_std" in entry:
        raise CaseError(f"{where}: noise_std must be positive; leave it out where it is not known")
    direction = _direction(entry, MEASURED[quantity][0] == 1, where)
    sensor = Sensor(entry["name"], at, quantity, noise_std=noise, direction=direction)
    _check_place(sensor, modes, where)
    return sensor


# --- records


def _hold(table: dict[str, Any], where: str) -> str:
    """The hold of the inputs between samples."""
    hold = table.get("input_hold", "zero")
    if hold not in HOLDS:
        raise CaseError(
            f"{where}: input_hold is zero (constant between samples), first (linear between samples) or band-limited"
            f" (after an anti-alias filter); got {shown(hold)}"
        )
    return str(hold)


def _use(entry: dict[str, Any], path: Path) -> str:
    use = entry.get("use")
    if use not in ("fit", "validate"):
        raise CaseError(f"{path}: record {entry['name']!r}: use is fit or validate; got {shown(use)}")
    return str(use)


def _read_record(folder: Path, entry: dict[str, Any], rig: Rig, path: Path, units: Units) -> Record:
    name = entry["name"]
    where = f"{path}: record {name!r}"
    check_keys(entry, RECORD, where)
    sample_time = number(entry, "sample_time", where)
    if sample_time <= 0:
        raise CaseError(f"{where}: sample_time must be positive; got {sample_time:g}")
    file = inside(folder, text(entry, "file", where), where)
    arrays, stated = _arrays(file, where, units)
    names = {a.name for a in rig.actuators} | {s.name for s in rig.sensors}
    missing, extra = sorted(names - arrays.keys()), sorted(arrays.keys() - names - {"t"})
    if missing:
        unknown = [name for name in extra if name.startswith((f"{missing[0]} [", f"{missing[0]} ("))]
        unit = f", where the unit of {shown(unknown[0])} is not known" if unknown else ""
        raise CaseError(
            f"{file}: channel {missing[0]!r} of case.toml is missing; the file has {shown(sorted(arrays))}{unit}"
        )
    if extra:
        raise CaseError(f"{file}: channel {shown(extra[0])} is not named in case.toml; name it there or leave it out")
    if "t" not in arrays:
        raise CaseError(f"{file}: the array t of sample instants is missing")
    n_samples = arrays["t"].size
    for channel, values in arrays.items():
        if values.shape != (n_samples,):
            raise CaseError(f"{file}: channel {channel!r} has shape {values.shape}; t has {n_samples} samples")
        bad = ~np.isfinite(values)
        if bad.any():
            at = int(np.argmax(bad))
            raise CaseError(f"{file}: channel {channel!r}, sample {at} is {values[at]}; fill it, or cut the record")
    steps = np.diff(arrays["t"])
    if n_samples < LEAST_SAMPLES or np.abs(steps - sample_time).max() > 0.01 * sample_time:
        is_in_ms = steps.size and np.abs(1e-3 * steps - sample_time).max() < 0.01 * sample_time
        in_ms = "; if it is in ms, name it 't [ms]'" if is_in_ms else ""
        raise CaseError(
            f"{file}: t must rise by sample_time = {sample_time:g} over at least {LEAST_SAMPLES} samples;"
            f" it has {n_samples} and steps from {steps.min() if steps.size else np.nan:g} to"
            f" {steps.max() if steps.size else np.nan:g}{in_ms}"
        )
    elastic = rig.modes.omega[rig.modes.omega > 0]
    if elastic.size and n_samples * sample_time < 2.0 * np.pi / elastic[0]:
        raise CaseError(
            f"{file} lasts {n_samples * sample_time:g} s, less than a period of the first mode"
            f" ({2.0 * np.pi / elastic[0]:g} s); take a longer record"
        )
    for sensor in rig.sensors:
        if np.ptp(arrays[sensor.name]) == 0:
            level = arrays[sensor.name][0]
            raise CaseError(
                f"{file}: output {sensor.name!r} is flat at {level:g}: check the sensor and its cable, or leave it out"
            )
    inputs, outputs = (np.array([arrays[port.name] for port in ports]) for ports in (rig.actuators, rig.sensors))
    record = rig.record(inputs, outputs, sample_time=sample_time, name=name, input_hold=_hold(entry, where))
    record = replace(
        record,
        input_channels=in_units(record.input_channels, units),
        output_channels=in_units(record.output_channels, units),
    )
    for _, known, _ in record.signals():
        unit = stated.get(known.name, "")
        if unit not in ("", known.unit):
            raise CaseError(
                f"{file}: channel {known.name!r} is in {unit} by its header, in the units of the case, and in"
                f" {known.unit} by case.toml: correct one of them"
            )
    return record


def signals_of(record: Record) -> dict[str, np.ndarray]:
    """The time t and the channels of a record, by name."""
    return {"t": record.time, **{channel.name: row for _, channel, row in record.signals()}}


def _arrays(file: Path, where: str, units: Units) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The arrays of a file by name, and the units that it states."""
    if not file.is_file():
        raise CaseError(f"{where}: there is no file {file}")
    stated: dict[str, str] = {}
    try:
        check_file(file)
        if file.suffix == ".npz":
            arrays = load_arrays(file)
        else:
            record = read_record(file, units=units)
            arrays = signals_of(record)
            stated = {channel.name: channel.unit for _, channel, _ in record.signals()}
    except RecordFileError as error:
        raise CaseError(str(error)) from error
    for name, values in arrays.items():
        if values.dtype.kind not in "fiu" or values.size > MOST_SAMPLES:
            raise CaseError(f"{file}: array {name!r} must hold at most {MOST_SAMPLES} real numbers")
    return {name: values.astype(float) for name, values in arrays.items()}, stated
