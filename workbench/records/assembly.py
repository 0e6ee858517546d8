"""Assembly of a record from the signals, times and description in a file.

Files of other programs are converted to SI units and to equal time steps, with a remark for each change.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from workbench.records.limits import RecordFileError
from workbench.records.record import Channel, Record
from workbench.records.units import SI, Unit, Units, split_unit, unit_named

UNIFORM = 1e-3  # of the time step
PART = 2**20  # steps checked together
# Steps between half and twice the median are resampled; a longer one is a gap.
SHORTEST, LONGEST = 0.5, 2.0
FINEST_ROUNDING = 10  # decimals of a second
FEWEST_ODD = 3  # least number of unequal steps if instants were rounded
KINDS = ("input", "output")
KEY = "crc32"  # of the checksum that detects changes of a file written here


def checksum(description: Mapping[str, Any], signals: Iterable[np.ndarray]) -> int:
    """CRC-32 of a record's description, without the sum itself, and of its signals."""
    text = json.dumps({key: value for key, value in description.items() if key != KEY}, sort_keys=True)
    total = crc32(text.encode())
    for values in signals:
        total = crc32(np.ascontiguousarray(values, "<f8").tobytes(), total)
    return total


@dataclass(frozen=True, eq=False)
class Sampling:
    """The sampling of a record.

    Attributes:
        start, step: of equal steps, s.
        times: (n_samples,) unequal instants, from which the signals are to be resampled; else None.
        remarks: on assumptions and changes.
    """

    start: float
    step: float
    times: np.ndarray | None = None
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Description:
    """The description of the signals in a file.

    Attributes:
        channels: by signal: kind, name, quantity, unit, at, noise_std, as far as given.
        name: of the record; None where only channels are described.
        sampling: (start, step), s; None where the file has times alone.
        input_hold: "zero", "first" or "band-limited".
    """

    channels: Mapping[str, Mapping[str, Any]]
    name: str | None = None
    sampling: tuple[float, float] | None = None
    input_hold: str = "zero"


def record_of(
    path: Path,
    time: np.ndarray | None,
    signals: Mapping[str, np.ndarray],
    header: str | None,
    *,
    sample_rate_hz: float | None,
    inputs: Sequence[str],
    into: Units = SI,
) -> Record:
    """The record of a file's contents.

    Args:
        path: of the file, for messages.
        time: (n_samples,) instants, s, where the file has them.
        signals: (n_samples,) each; a name may begin with its kind, `input:` or `output:`.
        header: the description as a JSON text.
        sample_rate_hz: where the file has no time.
        inputs: names of the input signals, where the file does not say.
        into: the units into which stated units are converted.

    Raises:
        RecordFileError: the message names the file, channel and row, and the remedy.
    """
    if not signals:
        raise RecordFileError(f"{path} holds no signals")
    described = Description({}) if header is None else _description(path, header, signals)
    n_samples = _n_samples(path, time, signals)
    for key, values in signals.items():
        bad = ~np.isfinite(values)
        if bad.any():
            row = int(np.argmax(bad))
            raise RecordFileError(f"{path}, channel {_name(key)!r}, row {row + 1}: {values[row]} is not a number")
    sampling = _sampling(path, time, n_samples, described, sample_rate_hz)
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
    rows = {kind: _rows([signals[key] for key in keys[kind]], [units.get(key) for key in keys[kind]], sampling)
            for kind in KINDS}  # fmt: skip
    channels = {
        kind: tuple(_channel(path, names[key], described.channels.get(key, {}), units.get(key)) for key in keys[kind])
        for kind in KINDS
    }
    written: dict[tuple[str, Unit], list[str]] = {}
    for key, unit in units.items():
        written.setdefault((split_unit(_name(key))[1], unit), []).append(names[key])
    remarks = [unit_remark(", ".join(alike), text, unit) for (text, unit), alike in written.items()]
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
            remarks=(*filter(None, remarks), *sampling.remarks),
        )
    except ValueError as error:
        raise RecordFileError(f"{path}: {error}") from error


def _description(path: Path, header: str, signals: Mapping[str, np.ndarray]) -> Description:
    try:
        table = json.loads(header)
        channels = {f"{c['kind']}:{c['name']}": c for c in table["channels"]}
        if "sample_time" not in table and KEY not in table:
            return Description(channels)
        sampling = (float(table["start_time"]), float(table["sample_time"]))
        # descriptions of earlier versions have no hold; their inputs are held ("zero")
        described = Description(channels, str(table["name"]), sampling, table.get("input_hold", "zero"))
        whole = table[KEY] == checksum(table, [signals[key] for key in channels]) and len(signals) == len(channels)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise RecordFileError(f"{path}: its description of the channels is damaged: {error}") from error
    if not whole:
        raise RecordFileError(
            f"{path} was changed after it was written: its checksum does not match. If that was meant, delete the"
            " description in it, and name the inputs again"
        )
    return described


def _n_samples(path: Path, time: np.ndarray | None, signals: Mapping[str, np.ndarray]) -> int:
    lengths = [values.size for values in signals.values()]
    most = time.size if time is not None else Counter(lengths).most_common(1)[0][0]
    for key, length in zip(signals, lengths):
        if length != most:
            raise RecordFileError(f"{path}, channel {_name(key)!r} has {length} samples; the others have {most}")
    if most < 2:
        raise RecordFileError(f"{path} holds {most} samples per channel; a record needs at least two")
    return most


def _name(key: str) -> str:
    return key.split(":", 1)[1] if key.startswith(("input:", "output:")) else key


def _kind(key: str, described: Description) -> str:
    kind = described.channels.get(key, {}).get("kind") or key.split(":", 1)[0]
    return kind if kind in KINDS else "output"


def legible(path: Path, name: str) -> str:
    """The name of a channel, checked to be printable.

    Raises:
        RecordFileError: control characters in the name.
    """
    if not name.isprintable():
        raise RecordFileError(f"{path}: the name {name!r} holds control characters; rename the channel")
    return name


def _channel(path: Path, name: str, facts: Mapping[str, Any], unit: Unit | None) -> Channel:
    if unit is not None:
        return Channel(legible(path, name), unit.quantity, unit.si)
    quantity, symbol, at, noise = (facts.get(fact) for fact in ("quantity", "unit", "at", "noise_std"))
    try:
        if not all(text is None or isinstance(text, str) for text in (quantity, symbol)):
            raise TypeError(f"quantity and unit are words; got {quantity!r} and {symbol!r}")
        if not all(number is None or isinstance(number, int | float) for number in (noise,)):
            raise TypeError(f"noise_std is a number; got {noise!r}")
        return Channel(legible(path, name), quantity or "", symbol or "", at, noise)
    except (TypeError, ValueError) as error:
        raise RecordFileError(f"{path}, channel {name!r}: {error}") from error


def _units(path: Path, keys: Iterable[str], into: Units) -> dict[str, Unit]:
    """The units at the end of signal names; none for names that would be equal without them."""
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


def _sampling(
    path: Path, time: np.ndarray | None, n_samples: int, described: Description, sample_rate_hz: float | None
) -> Sampling:
    if sample_rate_hz is not None and not 0 < sample_rate_hz < np.inf:
        raise RecordFileError(f"{path}: sample_rate_hz must be positive; got {sample_rate_hz}")
    if time is None:
        if sample_rate_hz is None:
            raise RecordFileError(f"{path} has no sample instants; give sample_rate_hz")
        return Sampling(0.0, 1.0 / sample_rate_hz)
    if not np.isfinite(time).all():
        raise RecordFileError(f"{path}, time, row {int(np.argmax(~np.isfinite(time))) + 1}: not a number")
    sampling = _of_times(path, time, correct=described.sampling is None)
    if sample_rate_hz is not None and abs(sample_rate_hz * sampling.step - 1.0) > UNIFORM:
        raise RecordFileError(f"{path} is sampled at {1 / sampling.step:g} Hz, not at {sample_rate_hz:g} Hz")
    if described.sampling is None:
        return sampling
    start, stated = described.sampling
    step = sampling.step
    if not (abs(stated - step) <= UNIFORM * step and abs(start - time[0]) <= UNIFORM * step):
        raise RecordFileError(
            f"{path}: its description states a start at {start:g} s and steps of {stated:g} s, its times {time[0]:g} s"
            f" and {step:g} s; correct or remove the description"
        )
    return replace(sampling, start=start, step=stated)


def _of_times(path: Path, time: np.ndarray, *, correct: bool) -> Sampling:
    """Start and step of sample instants; if `correct`, rounded instants are recognised, and unequal ones resampled."""
    start, n_samples = float(time[0]), time.size
    with np.errstate(over="ignore", invalid="ignore"):
        mean = float((time[-1] - time[0]) / (n_samples - 1))
        if 0 < mean < np.inf and _is_steady(time, mean):
            return Sampling(start, mean)
        steps = np.diff(time)
        median = float(np.median(steps))
        even = np.abs(steps - median) <= UNIFORM * abs(median)
    if 0 < median < np.inf and even.all():
        return Sampling(start, mean)
    shortest, longest = float(steps.min()), float(steps.max())
    if correct and 0 < mean < np.inf and shortest >= 0:
        rounded = _rounded(time, steps)
        if rounded is not None:
            return rounded
        if SHORTEST * median <= shortest and longest <= LONGEST * median and shortest > 0:
            remark = f"unequal time steps, {shortest:g} to {longest:g} s: resampled every {mean:g} s by cubic splines"
            return Sampling(start, mean, time, (remark,))
    with np.errstate(over="ignore", invalid="ignore"):  # times near the largest number, whose differences are infinite
        relative = np.nan_to_num(steps / median if median else steps, posinf=1e300, neginf=-1e300)
    row = int(np.argmax(np.abs(relative - 1.0)))
    raise RecordFileError(
        f"{path} is not uniformly sampled: row {row + 2} comes {steps[row]:g} s after the one before, the others"
        f" {median:g} s; fill the gap, or cut the record there"
    )


def _is_steady(time: np.ndarray, step: float) -> bool:
    """Whether all steps are near one value, and so near their median; checked in parts, without copying the record."""
    parts = (time[first : first + PART + 1] for first in range(0, time.size - 1, PART))
    return all((np.abs(np.diff(part) - step) <= 0.4 * UNIFORM * step).all() for part in parts)


def _rounded(time: np.ndarray, steps: np.ndarray) -> Sampling | None:
    """The sampling of equal steps whose instants were rounded to a power of ten; None for other instants."""
    rounding = next((r for r in (10.0**-d for d in range(FINEST_ROUNDING)) if _are_multiples(time, r)), None)
    if rounding is None:
        return None
    wholes = np.round(steps / rounding)
    index = np.arange(time.size)
    step, start = np.polyfit(index, time, 1)
    # one or two unequal steps are missing samples, not rounding
    odd = wholes.size - Counter(wholes.tolist()).most_common(1)[0][1]
    if odd < FEWEST_ODD or np.abs(time - (start + step * index)).max() > 0.6 * rounding:
        return None
    remark = f"times rounded to {rounding:g} s: taken as evenly sampled at {1 / step:.6g} Hz"
    return Sampling(float(start), float(step), remarks=(remark,))


def _are_multiples(time: np.ndarray, unit: float) -> bool:
    scaled = time / unit
    return bool(np.abs(scaled - np.round(scaled)).max() <= 1e-9 * max(np.abs(scaled).max(), 1.0))
