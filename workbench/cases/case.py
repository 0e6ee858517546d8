"""A case folder: a nominal model, and records measured on the real structure."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from workbench.cases.nominal import rig_of
from workbench.cases.tables import CaseError, check_keys, inside, number, one_of, shown, table_of, tables, text
from workbench.records.files import read_record
from workbench.records.limits import RecordFileError, check_file
from workbench.records.npz_file import arrays as load_arrays
from workbench.records.record import HOLDS, Channel, Record
from workbench.records.units import SI, Units
from workbench.rig.rig import Rig
from workbench.structure.printed import Printed

MOST_SAMPLES = 5_000_000
LEAST_SAMPLES = 16
# The keys of each table; any other key is refused as a misspelling.
UNITS = ("length", "mass", "time", "force")
RECORD = ("name", "file", "sample_time", "use", "input_hold")


@dataclass(frozen=True, eq=False, repr=False)
class Case(Printed):
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

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line = f"case {self.name!r}: {self.rig}".splitlines()[0]
        rows = [
            (record.name, use, str(record.n_samples), f"{record.sample_rate_hz:.6g}")
            for use, records in (("fit", self.fit), ("validate", self.validation))
            for record in records
        ]
        return line, ("record", "use", "samples", self.units.named("sample rate [Hz]")), rows, ()


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
    rig = rig_of(table, path)
    hold, units, renamed = _hold(table, str(path)), _units(table, path), _renamed(table, path, rig)
    records = [
        (_read_record(folder, {"input_hold": hold, **entry}, rig, path, units, renamed), _use(entry, path))
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
    """The units that a TOML file of the case format names, in which results are reported; SI if it names none."""
    return _units(table_of(Path(path)), Path(path))


def _renamed(table: dict[str, Any], path: Path, rig: Rig) -> dict[str, str]:
    """The input or output of each channel that a file calls by another name."""
    entries, where = table.get("channels", {}), f"{path}: [channels]"
    if not isinstance(entries, dict):
        raise CaseError(f'{where} must be a table of "name in a file" = "input or output"; got {shown(entries)}')
    known = [*(actuator.name for actuator in rig.actuators), *(sensor.name for sensor in rig.sensors)]
    renamed = {name: one_of(entries, name, known, where) for name in entries}
    for name in renamed:
        if name in ("t", *known):
            raise CaseError(f"{where}: {name} is the name of an input, an output or time; it cannot be another's")
    return renamed


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


def _read_record(
    folder: Path, entry: dict[str, Any], rig: Rig, path: Path, units: Units, renamed: Mapping[str, str]
) -> Record:
    name = entry["name"]
    where = f"{path}: record {name!r}"
    check_keys(entry, RECORD, where)
    sample_time = number(entry, "sample_time", where)
    if sample_time <= 0:
        raise CaseError(f"{where}: sample_time must be positive; got {sample_time:g}")
    file = inside(folder, text(entry, "file", where), where)
    arrays, stated = _arrays(file, where, units, renamed)
    _check_channels(file, arrays, rig)
    _check_instants(file, arrays["t"], sample_time, rig, units.time)
    for sensor in rig.sensors:
        if np.ptp(arrays[sensor.name]) == 0:
            level = arrays[sensor.name][0]
            raise CaseError(
                f"{file}: output {sensor.name!r} is flat at {level:g}: check the sensor and its cable, or leave it out"
            )
    inputs, outputs = (np.array([arrays[part.name] for part in parts]) for parts in (rig.actuators, rig.sensors))
    record = rig.record(inputs, outputs, sample_time=sample_time, name=name, input_hold=_hold(entry, where))
    record = replace(
        record,
        input_channels=in_units(record.input_channels, units),
        output_channels=in_units(record.output_channels, units),
    )
    check_units(file, [known for _, known, _ in record.signals()], stated)
    return record


def check_units(file: Path, channels: Sequence[Channel], stated: Mapping[str, str]) -> None:
    """Refuse a file whose header states a unit, by channel, other than that of the case, by a `CaseError`."""
    for known in channels:
        unit = stated.get(known.name, "")
        if unit not in ("", known.unit):
            raise CaseError(
                f"{file}: channel {known.name!r} is in {unit} by its header, in the units of the case, and in"
                f" {known.unit} by case.toml: correct one of them"
            )


def _check_channels(file: Path, arrays: dict[str, np.ndarray], rig: Rig) -> None:
    """Refuse channels that are missing, unknown, of unequal length, or not finite."""
    names = {a.name for a in rig.actuators} | {s.name for s in rig.sensors}
    missing, extra = sorted(names - arrays.keys()), sorted(arrays.keys() - names - {"t"})
    if missing:
        unknown = [name for name in extra if name.startswith((f"{missing[0]} [", f"{missing[0]} ("))]
        unit = f", where the unit of {shown(unknown[0])} is not known" if unknown else ""
        remedy = "" if unit or not extra else f"; where {shown(extra[0])} is that channel, say so in [channels]"
        raise CaseError(
            f"{file}: channel {missing[0]!r} of case.toml is missing; the file has"
            f" {shown(sorted(arrays))}{unit}{remedy}"
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


def _check_instants(file: Path, t: np.ndarray, sample_time: float, rig: Rig, unit: str) -> None:
    """Refuse sample instants that are not a sample time apart, or span less than a period of the first mode."""
    steps = np.diff(t)
    if t.size < LEAST_SAMPLES or np.abs(steps - sample_time).max() > 0.01 * sample_time:
        is_in_ms = steps.size and np.abs(1e-3 * steps - sample_time).max() < 0.01 * sample_time
        in_ms = "; if it is in ms, name it 't [ms]'" if is_in_ms else ""
        step = float(f"{np.median(steps):.6g}") if t.size >= LEAST_SAMPLES else 0.0
        if step > 0.0 and np.abs(steps - step).max() < 0.01 * step:
            remedy = in_ms or f": write sample_time = {step:g}"
            raise CaseError(f"{file}: sample_time = {sample_time:g} {unit}, but t steps by {step:g}{remedy}")
        raise CaseError(
            f"{file}: t must rise by sample_time = {sample_time:g} over at least {LEAST_SAMPLES} samples;"
            f" it has {t.size} and steps from {steps.min() if steps.size else np.nan:g} to"
            f" {steps.max() if steps.size else np.nan:g}{in_ms}"
        )
    elastic = rig.modes.omega[rig.modes.omega > 0]
    if elastic.size and t.size * sample_time < 2.0 * np.pi / elastic[0]:
        raise CaseError(
            f"{file} lasts {t.size * sample_time:g} s, less than a period of the first mode"
            f" ({2.0 * np.pi / elastic[0]:g} s); take a longer record"
        )


def signals_of(record: Record) -> dict[str, np.ndarray]:
    """The time t and the channels of a record, by name."""
    return {"t": record.time, **{channel.name: row for _, channel, row in record.signals()}}


def _arrays(
    file: Path, where: str, units: Units, renamed: Mapping[str, str]
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The arrays of a file by their name in the case, and the units that it states."""
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
    named = {name: renamed.get(name, name) for name in arrays}
    count = Counter(named.values())
    for name, values in arrays.items():
        if values.dtype.kind not in "fiu" or values.size > MOST_SAMPLES:
            raise CaseError(f"{file}: array {name!r} must hold at most {MOST_SAMPLES} real numbers")
        if count[named[name]] > 1:
            raise CaseError(f"{file}: two channels are {named[name]!r} by [channels] of case.toml")
    stated = {named[name]: unit for name, unit in stated.items()}
    return {named[name]: values.astype(float) for name, values in arrays.items()}, stated
