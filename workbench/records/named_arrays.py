"""Signals from the named arrays of NPZ, MAT and HDF5 files."""

import json
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from workbench.records.assembly import Signals, damaged
from workbench.records.frf_arrays import SURE_RATES
from workbench.records.instants import in_seconds
from workbench.records.limits import RecordFileError, check_counts
from workbench.records.units import time_factor

HEADER = "record_header"
NUMBERED = "record_channel_"


def numbered(signals: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The signals under numbered names, which every format allows; the header has their own names."""
    return {f"{NUMBERED}{i}": np.asarray(values) for i, values in enumerate(signals.values())}


def check_struct(path: Path, structs: Mapping[str, Collection[str]], read: Collection[str]) -> None:
    """Refuse, by a `RecordFileError`, MATLAB structs, given by their fields, except a single one of signals, `read`."""
    if len(structs) == 1 and read:
        return
    listed = "; ".join(f"{name} with {', '.join(fields) or 'no fields'}" for name, fields in structs.items())
    raise RecordFileError(
        f"{path} holds no signals but in structs: {listed}. A single struct is read, whose fields are signals: write it"
        " alone, as by save('x.mat', '-struct', 'NAME')"
    )


def signals_of(path: Path, arrays: Mapping[str, np.ndarray]) -> Signals:
    """Time or None, signals by name, header or None; single values and texts are left out.

    An array of two axes, one as long as the other signals, becomes several signals, `NAME 1` and so on. A single value
    named `fs`, or another of `SURE_RATES`, gives the time where no array does.
    """
    header = str(np.ravel(arrays[HEADER])[0]) if HEADER in arrays and np.size(arrays[HEADER]) else None
    time: np.ndarray | None = None
    remarks: tuple[str, ...] = ()
    signals: dict[str, np.ndarray] = {}
    numbers = [values for values in arrays.values() if values.dtype.kind in "fiub" and values.size > 1]
    lengths = {values.size for values in numbers if values.size == max(values.shape)}
    for name, values in arrays.items():
        if values.dtype.kind == "c" and values.size > 1:
            raise RecordFileError(f"{path}, channel {name!r} is complex: is it an FRF?")
        if values.dtype.kind not in "fiub" or values.size == 1:
            continue
        if values.ndim > 1 and 1 not in values.shape:
            signals |= {f"{name} {i}": each for i, each in enumerate(_rows(path, name, values, lengths), 1)}
            continue
        row = values.reshape(-1).astype(float, copy=False)
        if time_factor(name) is None:
            signals[name] = row
        elif time is None:
            (time, remarks), first = in_seconds(name, row), name
        else:
            raise RecordFileError(f"{path} holds two arrays of times, {first} and {name}; leave one out")
    if time is None and signals:
        rates = [float(v.item()) for n, v in arrays.items()
                 if n.lower() in SURE_RATES and v.size == 1 and v.dtype.kind in "fiu"]  # fmt: skip
        if len(rates) == 1 and 0.0 < rates[0] < np.inf:
            time = np.arange(max(row.size for row in signals.values())) / rates[0]
    if any(name.startswith(NUMBERED) for name in signals):
        counted = [f"{NUMBERED}{i}" for i in range(len(signals))]
        if header is None or sorted(signals) != sorted(counted):
            raise RecordFileError(f"{path} is damaged: its channels and their description do not belong together")
        with damaged(path, "channels"):
            keys = [f"{c['kind']}:{c['name']}" for c in json.loads(header)["channels"]]
        signals = dict(zip(keys, (signals[name] for name in counted)))
    return Signals(time, signals, header, () if header else remarks)


def _rows(path: Path, name: str, values: np.ndarray, lengths: set[int]) -> np.ndarray:
    """The signals (n_signals, n_samples) of an array of two axes; without other signals the longer axis is time."""
    along = [axis for axis, size in enumerate(values.shape) if size in (lengths or {max(values.shape)})]
    if values.ndim != 2 or len(along) != 1:
        raise RecordFileError(
            f"{path}, channel {name!r} has shape {values.shape}; rows of samples are needed, as long as the other"
            " signals"
        )
    check_counts(path, values.shape[1 - along[0]], 0)
    return np.asarray(np.moveaxis(values, along[0], 1), float)
