"""A record out of the signals, times and description that a file held."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from workbench.records.checksum import KEY, checksum
from workbench.records.file_error import RecordFileError
from workbench.records.record import Channel, Record

UNIFORM = 1e-3
KINDS = ("input", "output")


@dataclass(frozen=True)
class Description:
    """What a file says of its signals.

    Attributes:
        channels: by signal: kind, name, quantity, unit, at, noise_std, as far as told.
        name: of the record; None where only channels are described.
        sampling: (start, step), s; None where the times alone tell.
    """

    channels: Mapping[str, Mapping]
    name: str | None = None
    sampling: tuple[float, float] | None = None


def record_of(
    path: Path,
    time: np.ndarray | None,
    signals: Mapping[str, np.ndarray],
    header: str | None,
    *,
    sample_rate_hz: float | None,
    inputs: Sequence[str],
) -> Record:
    """The record that a file held.

    Args:
        path: of the file, for messages.
        time: (n_samples,) instants, s, where the file tells them.
        signals: (n_samples,) each; a name may begin with its kind, `input:` or `output:`.
        header: the description as a JSON text.
        sample_rate_hz: where the file tells no time.
        inputs: names of signals that went in, where the file does not say.

    Raises:
        RecordFileError: naming the file, channel and row, and what would be right.
    """
    if not signals:
        raise RecordFileError(f"{path} holds no signals")
    told = Description({}) if header is None else _description(path, header, signals)
    n_samples = _n_samples(path, time, signals)
    for key, values in signals.items():
        bad = ~np.isfinite(values)
        if bad.any():
            row = int(np.argmax(bad))
            raise RecordFileError(f"{path}, channel {_name(key)!r}, row {row + 1}: {values[row]} is not a number")
    start, step = _sampling(path, time, n_samples, told, sample_rate_hz)
    names = [_name(key) for key in signals]
    for name in inputs:
        if name not in names:
            raise RecordFileError(f"{path} has no channel {name!r} to be an input; it has {', '.join(names)}")
    kinds = {key: "input" if _name(key) in inputs else _kind(key, told) for key in signals}
    keys = {kind: [key for key in signals if kinds[key] == kind] for kind in KINDS}
    if not keys["output"]:
        raise RecordFileError(f"{path} holds inputs only; at least one output is needed")
    rows = {kind: np.array([signals[key] for key in keys[kind]]) for kind in KINDS}
    channels = {kind: tuple(_channel(path, key, told) for key in keys[kind]) for kind in KINDS}
    try:
        return Record(
            sample_time=step,
            outputs=rows["output"],
            output_channels=channels["output"],
            inputs=rows["input"],
            input_channels=channels["input"],
            start_time=start,
            name=told.name or path.stem,
        )
    except ValueError as error:
        raise RecordFileError(f"{path}: {error}") from error


def _description(path: Path, header: str, signals: Mapping[str, np.ndarray]) -> Description:
    try:
        table = json.loads(header)
        channels = {f"{c['kind']}:{c['name']}": c for c in table["channels"]}
        if "sample_time" not in table and KEY not in table:
            return Description(channels)
        told = Description(channels, str(table["name"]), (float(table["start_time"]), float(table["sample_time"])))
        whole = table[KEY] == checksum(table, [signals[key] for key in channels]) and len(signals) == len(channels)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise RecordFileError(f"{path}: its description of the channels is damaged: {error}") from error
    if not whole:
        raise RecordFileError(
            f"{path} is not as it was written: its checksum tells of a change. If that was meant, take the description"
            " out, and name the inputs anew"
        )
    return told


def _n_samples(path: Path, time: np.ndarray | None, signals: Mapping[str, np.ndarray]) -> int:
    lengths = [values.size for values in signals.values()]
    most = time.size if time is not None else max(set(lengths), key=lengths.count)
    for key, length in zip(signals, lengths):
        if length != most:
            raise RecordFileError(f"{path}, channel {_name(key)!r} has {length} samples; the others have {most}")
    if most < 2:
        raise RecordFileError(f"{path} holds {most} samples a channel; a record needs at least two")
    return most


def _name(key: str) -> str:
    return key.split(":", 1)[1] if key.startswith(("input:", "output:")) else key


def _kind(key: str, told: Description) -> str:
    kind = told.channels.get(key, {}).get("kind") or key.split(":", 1)[0]
    return kind if kind in KINDS else "output"


def legible(path: Path, name: str) -> str:
    """The name of a channel, where a line of text can show it.

    Raises:
        RecordFileError: control characters in it.
    """
    if not name.isprintable():
        raise RecordFileError(f"{path}: the name {name!r} holds control characters; rename the channel")
    return name


def _channel(path: Path, key: str, told: Description) -> Channel:
    name, facts = legible(path, _name(key)), told.channels.get(key, {})
    try:
        return Channel(name, facts.get("quantity", ""), facts.get("unit", ""), facts.get("at"), facts.get("noise_std"))
    except (TypeError, ValueError) as error:
        raise RecordFileError(f"{path}, channel {name!r}: {error}") from error


def _sampling(
    path: Path, time: np.ndarray | None, n_samples: int, told: Description, sample_rate_hz: float | None
) -> tuple[float, float]:
    if sample_rate_hz is not None and not 0 < sample_rate_hz < np.inf:
        raise RecordFileError(f"{path}: sample_rate_hz must be positive; got {sample_rate_hz}")
    if time is None:
        if sample_rate_hz is None:
            raise RecordFileError(f"{path} tells no time; give sample_rate_hz")
        return 0.0, 1.0 / sample_rate_hz
    if not np.isfinite(time).all():
        raise RecordFileError(f"{path}, time, row {int(np.argmax(~np.isfinite(time))) + 1}: not a number")
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.diff(time)
        step = float(np.median(steps))
        even = np.abs(steps - step) <= UNIFORM * abs(step)
    if not (0 < step < np.inf and even.all()):
        row = int(np.argmin(even)) + 2
        raise RecordFileError(
            f"{path} is not uniformly sampled: row {row} comes {steps[row - 2]:g} s after the one before, the others"
            f" {step:g} s; resample it first"
        )
    if sample_rate_hz is not None and abs(sample_rate_hz * step - 1.0) > UNIFORM:
        raise RecordFileError(f"{path} is sampled at {1 / step:g} Hz, not at {sample_rate_hz:g} Hz")
    if told.sampling is None:
        return float(time[0]), float((time[-1] - time[0]) / (n_samples - 1))
    start, said = told.sampling
    if not (abs(said - step) <= UNIFORM * step and abs(start - time[0]) <= UNIFORM * step):
        raise RecordFileError(
            f"{path}: its description says a start at {start:g} s and steps of {said:g} s, its times {time[0]:g} s and"
            f" {step:g} s; mend or remove the description"
        )
    return start, said
