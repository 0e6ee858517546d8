"""Assembly of a record from the signals, times and description in a file.

Files of other programs are converted to SI units and to equal time steps, with a remark for each change.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from workbench.records.instants import UNIFORM, Sampling, even_sampling
from workbench.records.limits import RecordFileError
from workbench.records.record import Channel, Record
from workbench.records.units import SI, Unit, Units, contradiction, split_unit, unit_named, unknown_unit
from workbench.structure.domain import Between, Patch

KINDS = ("input", "output")
COMPOUND = {"Between": Between, "Patch": Patch}  # places of several numbers or names
FILL = "delete the column, or fill the samples"  # the remedy of samples that are not there
KEY = "crc32"  # of the checksum that detects changes of a file written here


def checksum(description: Mapping[str, Any], signals: Iterable[np.ndarray]) -> int:
    """CRC-32 of a record's description, without the sum itself, and of its signals."""
    text = json.dumps({key: value for key, value in description.items() if key != KEY}, sort_keys=True)
    total = crc32(text.encode())
    for values in signals:
        total = crc32(np.ascontiguousarray(values, "<f8").tobytes(), total)
    return total


class Signals(NamedTuple):
    """The signals in a file, before they are a record."""

    time: np.ndarray | None  # (n_samples,) instants, s, where the file has them
    signals: dict[str, np.ndarray]  # (n_samples,) each; a name may begin with its kind, `input:` or `output:`
    header: str | None = None  # the description as a JSON text
    remarks: tuple[str, ...] = ()  # on assumptions and changes
    row_of: Callable[[int], int] = (1).__add__  # the number in the file, from 1 on, of the row of a sample, from 0 on


class Description(NamedTuple):
    """The description of the signals in a file."""

    channels: Mapping[str, Mapping[str, Any]]  # by signal: kind, name, quantity, unit, at, noise_std, as far as given
    name: str | None = None  # of the record; None where only channels are described
    sampling: tuple[float, float] | None = None  # (start, step), s; None where the file has times alone
    input_hold: str = "zero"  # "zero", "first" or "band-limited"


def record_of(
    path: Path,
    contents: Signals,
    *,
    sample_rate_hz: float | None,
    inputs: Sequence[str],
    outputs: Sequence[str] = (),
    into: Units = SI,
) -> Record:
    """The record of a file's contents.

    Args:
        path: of the file, for messages.
        contents: of the file.
        sample_rate_hz, inputs, outputs: as `read_measured` takes them.
        into: the units into which stated units are converted.
    """
    time, signals, header, remarked, row_of = contents
    if not signals:
        raise RecordFileError(f"{path} holds no signals")
    described = Description({}) if header is None else _description(path, header, signals)
    _check_lengths(path, time, signals)
    units = _units(path, (key for key in signals if key not in described.channels), into)
    names = {key: split_unit(_name(key))[0] if key in units else _name(key) for key in signals}
    for name in inputs:
        if name not in names.values() and name not in map(_name, signals):
            known = ", ".join(names.values())
            raise RecordFileError(f"{path} has no channel {name!r} to be an input; it has {known}")
    kinds = {key: "input" if names[key] in inputs or _name(key) in inputs else _kind(key, described) for key in signals}
    keys = {kind: [key for key in signals if kinds[key] == kind] for kind in KINDS}
    if not keys["output"]:
        raise RecordFileError(f"{path} holds inputs only; at least one output is needed")
    if outputs:
        there = {names[key]: key for key in keys["output"]}
        missing = [name for name in outputs if name not in there]
        if missing:
            raise RecordFileError(f"{path} has no output {missing[0]!r}; it has {', '.join(there)}")
        keys["output"] = [there[name] for name in outputs]
        kept = {*keys["input"], *keys["output"]}
        signals = {key: values for key, values in signals.items() if key in kept}
    for key, values in signals.items():
        bad = ~np.isfinite(values)
        if bad.any():
            at = int(np.argmax(bad))
            where = f"{path}, channel {_name(key)!r}, row {row_of(at)}"
            raise RecordFileError(f"{where}: {values[at]} is not a number; {FILL}")
    sampling = _sampling(path, contents._replace(signals=signals), described, sample_rate_hz)
    rows = {kind: _rows([signals[key] for key in keys[kind]], [units.get(key) for key in keys[kind]], sampling)
            for kind in KINDS}  # fmt: skip
    channels = {
        kind: tuple(_channel(path, names[key], described.channels.get(key, {}), units.get(key)) for key in keys[kind])
        for kind in KINDS
    }
    written: dict[tuple[str, Unit], list[str]] = {}
    unknown: dict[str, list[str]] = {}
    for key in signals:
        if key in units:
            written.setdefault((split_unit(_name(key))[1], units[key]), []).append(names[key])
        elif key not in described.channels and (text := unknown_unit(_name(key))):
            unknown.setdefault(text, []).append(names[key])
    remarks = [unit_remark(", ".join(alike), text, unit) for (text, unit), alike in written.items()]
    remarks += [f"{', '.join(alike)}: as recorded, as {text} is no known unit" for text, alike in unknown.items()]
    try:
        return Record(
            sample_time=sampling.step,
            outputs=rows["output"],
            output_channels=channels["output"],
            inputs=rows["input"],
            input_channels=channels["input"],
            input_hold=described.input_hold,
            start_time=sampling.start,
            name=described.name or path.stem,
            remarks=(*filter(None, remarks), *remarked, *sampling.remarks),
        )
    except ValueError as error:
        raise RecordFileError(f"{path}: {error}") from error


@contextmanager
def damaged(path: Path, what: str) -> Iterator[None]:
    """A context in which a fault in the description of the channels or points of a file is a `RecordFileError`."""
    try:
        yield
    except RecordFileError:
        raise
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise RecordFileError(f"{path}: its description of the {what} is damaged: {error}") from error


def _description(path: Path, header: str, signals: Mapping[str, np.ndarray]) -> Description:
    with damaged(path, "channels"):
        table = json.loads(header)
        channels = {f"{c['kind']}:{c['name']}": c for c in table["channels"]}
        if "sample_time" not in table and KEY not in table:
            return Description(channels)
        sampling = (float(table["start_time"]), float(table["sample_time"]))
        # descriptions of earlier versions have no hold; their inputs are held ("zero")
        described = Description(channels, str(table["name"]), sampling, table.get("input_hold", "zero"))
        whole = table[KEY] == checksum(table, [signals[key] for key in channels]) and len(signals) == len(channels)
    if not whole:
        raise RecordFileError(
            f"{path} was changed after it was written: its checksum does not match. If that was meant, delete the"
            " description in it, and name the inputs again"
        )
    return described


def _check_lengths(path: Path, time: np.ndarray | None, signals: Mapping[str, np.ndarray]) -> None:
    lengths = [values.size for values in signals.values()]
    most = time.size if time is not None else Counter(lengths).most_common(1)[0][0]
    for key, length in zip(signals, lengths):
        if length != most:
            raise RecordFileError(f"{path}, channel {_name(key)!r} has {length} samples; the others have {most}")
    if most < 2:
        raise RecordFileError(f"{path} holds {most} samples per channel; a record needs at least two")


def _name(key: str) -> str:
    return key.split(":", 1)[1] if key.startswith(("input:", "output:")) else key


def _kind(key: str, described: Description) -> str:
    kind = described.channels.get(key, {}).get("kind") or key.split(":", 1)[0]
    return kind if kind in KINDS else "output"


def legible(path: Path, name: str) -> str:
    """The name of a channel; one with control characters is refused by a `RecordFileError`."""
    if not name.isprintable():
        raise RecordFileError(f"{path}: the name {name!r} holds control characters; rename the channel")
    return name


def facts_of(kind: str, channel: Channel) -> dict[str, Any]:
    """The description of a channel as JSON holds it, a place that is no single one under the name of its type."""
    facts = {name: getattr(channel, name) for name in ("name", "quantity", "unit", "at", "noise_std")}
    if isinstance(channel.at, tuple(COMPOUND.values())):
        facts["at"] = {type(channel.at).__name__: channel.at}
    return {"kind": kind, **facts}


def _channel(path: Path, name: str, facts: Mapping[str, Any], unit: Unit | None) -> Channel:
    if unit is not None:
        return Channel(legible(path, name), unit.quantity, unit.si)
    quantity, symbol, at, noise = (facts.get(fact) for fact in ("quantity", "unit", "at", "noise_std"))
    try:
        if not (isinstance(quantity, str | None) and isinstance(symbol, str | None)):
            raise TypeError(f"quantity and unit are words; got {quantity!r} and {symbol!r}")
        if not isinstance(noise, int | float | None):
            raise TypeError(f"noise_std is a number; got {noise!r}")
        if isinstance(at, dict):
            ((compound, parts),) = at.items()
            at = COMPOUND[compound](*parts)
        return Channel(legible(path, name), quantity or "", symbol or "", at, noise)
    except (KeyError, TypeError, ValueError) as error:
        raise RecordFileError(f"{path}, channel {name!r}: {error}") from error


def _units(path: Path, keys: Iterable[str], into: Units) -> dict[str, Unit]:
    """The units at the end of signal names; none for names that would be equal without them."""
    keys = list(keys)
    for key in keys:
        if (both := contradiction(_name(key))) is not None:
            raise RecordFileError(
                f"{path}, channel {_name(key)!r} states two units, {both[0]} and {both[1]}: leave the one that its"
                " numbers are in"
            )
    split = {key: split_unit(_name(key)) for key in keys}
    counts = Counter(base for base, _ in split.values())
    units = {key: unit_named(text) for key, (base, text) in split.items() if text and counts[base] == 1}
    try:
        return {key: into.taken(unit) for key, unit in units.items() if unit is not None and unit.quantity != "time"}
    except ValueError as error:
        raise RecordFileError(f"{path}: {error}") from None


def unit_remark(name: str, written: str, unit: Unit) -> str:
    """The remark on a signal that was converted to another unit; empty where it was not."""
    if unit.si == "counts":
        return f"{name}: in counts of unstated sensitivity; modes have no scale"
    return "" if unit.factor == 1.0 else f"{name}: {written} taken as {unit.factor:g} {unit.si}"


def _rows(signals: Sequence[np.ndarray], units: Sequence[Unit | None], sampling: Sampling) -> np.ndarray:
    """The signals (n_signals, n_samples) in their units, at equal steps; read-only, so that `Record` does not copy."""
    rows = np.array(signals, float)
    for row, unit in zip(rows, units, strict=True):
        if unit is not None and unit.factor != 1.0:
            row *= unit.factor
        if sampling.times is not None:
            # imported here, as the import takes longer than reading a file
            from scipy.interpolate import CubicSpline

            row[:] = CubicSpline(sampling.times, row)(sampling.start + sampling.step * np.arange(row.size))
    rows.flags.writeable = False
    return rows


def _sampling(path: Path, contents: Signals, described: Description, sample_rate_hz: float | None) -> Sampling:
    time = contents.time
    if sample_rate_hz is not None and not 0 < sample_rate_hz < np.inf:
        raise RecordFileError(f"{path}: sample_rate_hz must be positive; got {sample_rate_hz}")
    if time is None:
        if sample_rate_hz is None:
            name, first = next(iter(contents.signals.items()))
            axis = (np.diff(first) > 0).all()
            which = f", unless {_name(name)!r}, which rises all along, is one: call it time [s] or frequency [Hz]"
            raise RecordFileError(f"{path} has no sample instants; give sample_rate_hz{which if axis else ''}")
        return Sampling(0.0, 1.0 / sample_rate_hz)
    if not np.isfinite(time).all():
        raise RecordFileError(f"{path}, time, row {contents.row_of(int(np.argmax(~np.isfinite(time))))}: not a number")
    if described.sampling is None:
        sampling = even_sampling(path, time, [*contents.signals.values()], sample_rate_hz, contents.row_of)
    else:
        sampling = Sampling(*described.sampling)
        with np.errstate(over="ignore", invalid="ignore"):
            off = np.abs(time - (sampling.start + sampling.step * np.arange(time.size)))
        if not (sampling.step > 0 and (off <= UNIFORM * sampling.step).all()):
            raise RecordFileError(
                f"{path}: its description states a start at {sampling.start:g} s and steps of {sampling.step:g} s, its"
                f" times {time[0]:g} s and {(time[-1] - time[0]) / (time.size - 1):g} s; correct or remove the"
                " description"
            )
    if sample_rate_hz is not None and abs(sample_rate_hz * sampling.step - 1.0) > UNIFORM:
        raise RecordFileError(f"{path} is sampled at {1 / sampling.step:g} Hz, not at {sample_rate_hz:g} Hz")
    return sampling
