"""Records on disk: CSV, NPZ, MAT, HDF5 and UFF 58, through one door each way.

What a format has no room for (places, noise, which signals are inputs) travels as a JSON text: in a comment of a CSV,
an entry of an NPZ or MAT, an attribute of HDF5, the description lines of a UFF. Files of other programs have none of
it: their signals are then all outputs, named as the file names them.
"""

import json
from pathlib import Path

import numpy as np

from workbench.records import csv_file, hdf5_file, mat_file, npz_file, uff_file
from workbench.records.file_error import RecordFileError
from workbench.records.record import Channel, Record

FORMATS = {
    ".csv": csv_file,
    ".txt": csv_file,
    ".npz": npz_file,
    ".mat": mat_file,
    ".h5": hdf5_file,
    ".hdf5": hdf5_file,
    ".uff": uff_file,
    ".unv": uff_file,
}
UNIFORM = 1e-3


def read_record(path: str | Path, *, sample_rate_hz: float | None = None, inputs: tuple[str, ...] = ()) -> Record:
    """Read a record; the format goes by the file's ending.

    Args:
        path: of a .csv, .txt, .npz, .mat, .h5, .hdf5, .uff or .unv file.
        sample_rate_hz: where the file itself tells no time.
        inputs: names of the signals that went in, where the file does not say.

    Raises:
        RecordFileError: naming file, channel and row, and what would be right.
    """
    path = Path(path)
    module = _format(path)
    if not path.is_file():
        raise RecordFileError(f"{path}: there is no such file")
    if path.stat().st_size == 0:
        raise RecordFileError(f"{path} is empty")
    try:
        time, signals, header = module.read(path)
    except RecordFileError:
        raise
    except Exception as error:  # every reader of another's file has its own ways to fail
        raise RecordFileError(f"{path} cannot be read as {path.suffix[1:].upper()}: {error}") from error
    return _assembled(path, time, signals, header, sample_rate_hz, inputs)


def write_record(record: Record, path: str | Path) -> Path:
    """Write a record; the format goes by the file's ending. Reading it back gives the same record.

    UFF 58 stores single channels with their own headers; the others hold all signals side by side.

    Raises:
        RecordFileError: an ending that names no format.
    """
    path = Path(path)
    module = _format(path)
    signals = {_key(kind, channel.name): row for kind, channel, row in _rows(record)}
    header = {
        "name": record.name,
        "sample_time": record.sample_time,
        "start_time": record.start_time,
        "channels": [
            {"kind": kind, "name": c.name, "quantity": c.quantity, "unit": c.unit, "at": c.at, "noise_std": c.noise_std}
            for kind, c, _ in _rows(record)
        ],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    module.write(path, record.time, signals, header)
    return path


def _format(path: Path):
    if path.suffix.lower() not in FORMATS:
        raise RecordFileError(f"{path}: the ending {path.suffix!r} names no format; use one of {', '.join(FORMATS)}")
    return FORMATS[path.suffix.lower()]


def _rows(record: Record):
    for channel, row in zip(record.input_channels, record.inputs, strict=True):
        yield "input", channel, row
    for channel, row in zip(record.output_channels, record.outputs, strict=True):
        yield "output", channel, row


def _key(kind: str, name: str) -> str:
    return f"{kind}:{name}"


def _assembled(path, time, signals, header, sample_rate_hz, inputs) -> Record:
    if not signals:
        raise RecordFileError(f"{path} holds no signals")
    known = {}
    if header is not None:
        try:
            header = json.loads(header) if isinstance(header, str) else header
            known = {_key(c["kind"], c["name"]): c for c in header["channels"]}
            header = {"name": str(header["name"])} | {k: float(header[k]) for k in ("start_time", "sample_time")}
        except (ValueError, KeyError, TypeError) as error:
            raise RecordFileError(f"{path}: its description of the channels is damaged: {error}") from error
    lengths = {name: np.size(values) for name, values in signals.items()}
    most = np.size(time) if time is not None else max(set(lengths.values()), key=list(lengths.values()).count)
    for name, length in lengths.items():
        if length != most:
            raise RecordFileError(f"{path}, channel {_plain(name)!r} has {length} samples; the others have {most}")
    if most < 2:
        raise RecordFileError(f"{path} holds {most} samples a channel; a record needs at least two")
    for name, values in signals.items():
        bad = ~np.isfinite(values)
        if bad.any():
            row = int(np.argmax(bad))
            raise RecordFileError(f"{path}, channel {_plain(name)!r}, row {row + 1}: {values[row]} is not a number")
    start, step = _sampling(path, time, most, header, sample_rate_hz)
    missing = [name for name in inputs if name not in {_plain(key) for key in signals}]
    if missing:
        raise RecordFileError(
            f"{path} has no channel {missing[0]!r} to be an input; it has {', '.join(_plain(key) for key in signals)}"
        )
    channels, rows = {"input": [], "output": []}, {"input": [], "output": []}
    for key, values in signals.items():
        facts = known.get(key, {})
        kind = facts.get("kind") or ("input" if _plain(key) in inputs else "output")
        channels[kind].append(_channel(path, _plain(key), facts))
        rows[kind].append(np.asarray(values, float))
    if not rows["output"]:
        raise RecordFileError(f"{path} holds inputs only; at least one output is needed")
    return Record(
        sample_time=step,
        outputs=np.array(rows["output"]),
        output_channels=tuple(channels["output"]),
        inputs=np.array(rows["input"]) if rows["input"] else np.zeros((0, 0)),
        input_channels=tuple(channels["input"]),
        start_time=start,
        name=(header or {}).get("name", path.stem),
    )


def _channel(path, name: str, facts: dict) -> Channel:
    try:
        return Channel(name, facts.get("quantity", ""), facts.get("unit", ""), facts.get("at"), facts.get("noise_std"))
    except (TypeError, ValueError) as error:
        raise RecordFileError(f"{path}, channel {name!r}: {error}") from error


def _plain(key: str) -> str:
    return key.split(":", 1)[1] if key.startswith(("input:", "output:")) else key


def _sampling(path, time, n_samples: int, header, sample_rate_hz) -> tuple[float, float]:
    if time is None:
        if sample_rate_hz is None:
            raise RecordFileError(f"{path} tells no time; give sample_rate_hz")
        if not sample_rate_hz > 0:
            raise RecordFileError(f"{path}: sample_rate_hz must be positive; got {sample_rate_hz}")
        return 0.0, 1.0 / sample_rate_hz
    time = np.asarray(time, float)
    if time.size != n_samples:
        raise RecordFileError(f"{path}: {time.size} times and {n_samples} samples a channel")
    if not np.isfinite(time).all():
        raise RecordFileError(f"{path}, time, row {int(np.argmax(~np.isfinite(time))) + 1}: not a number")
    steps = np.diff(time)
    step = float(np.median(steps))
    off = np.abs(steps - step) > UNIFORM * abs(step)
    if step <= 0 or off.any():
        row = int(np.argmax(off)) + 2
        raise RecordFileError(
            f"{path} is not uniformly sampled: row {row} comes {steps[row - 2]:g} s after the one before, the others"
            f" {step:g} s; resample it first"
        )
    if sample_rate_hz is not None and abs(sample_rate_hz * step - 1.0) > UNIFORM:
        raise RecordFileError(f"{path} is sampled at {1 / step:g} Hz, not at {sample_rate_hz:g} Hz")
    if header is None:
        return float(time[0]), float((time[-1] - time[0]) / (n_samples - 1))
    start, told = header["start_time"], header["sample_time"]
    if not (abs(told - step) <= UNIFORM * step and abs(start - time[0]) <= UNIFORM * step):
        raise RecordFileError(
            f"{path}: its description says a start at {start:g} s and steps of {told:g} s, its times {time[0]:g} s and"
            f" {step:g} s; mend or remove the description"
        )
    return start, told
