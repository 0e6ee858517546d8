"""Signals out of named arrays, as NPZ, MAT and HDF5 hold them."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from workbench.records.file_error import RecordFileError
from workbench.records.units import time_factor

HEADER = "record_header"
NUMBERED = "record_channel_"

Signals = tuple[np.ndarray | None, dict[str, np.ndarray], str | None]


def numbered(signals: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The signals under names that every format allows; their own travel in the header."""
    return {f"{NUMBERED}{i}": np.asarray(values) for i, values in enumerate(signals.values())}


def signals_of(path: Path, arrays: Mapping[str, np.ndarray]) -> Signals:
    """Time or None, signals by name, header or None: vectors as they are, single values and texts left out.

    Raises:
        RecordFileError: an array that is no row of samples, two of times, or numbered channels without their header.
    """
    header = str(np.ravel(arrays[HEADER])[0]) if HEADER in arrays and np.size(arrays[HEADER]) else None
    time: np.ndarray | None = None
    signals: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        if values.dtype.kind == "c" and values.size > 1:
            raise RecordFileError(f"{path}, channel {name!r} is complex: is it a transfer function?")
        if values.dtype.kind not in "fiub" or values.size == 1:
            continue
        if values.ndim > 1 and 1 not in values.shape:
            raise RecordFileError(f"{path}, channel {name!r} has shape {values.shape}; one row of samples is needed")
        row = values.reshape(-1).astype(float, copy=False)
        factor = time_factor(name)
        if factor is None:
            signals[name] = row
        elif time is None:
            time, first = (row if factor == 1.0 else factor * row), name
        else:
            raise RecordFileError(f"{path} holds two arrays of times, {first} and {name}; leave one out")
    if any(name.startswith(NUMBERED) for name in signals):
        counted = [f"{NUMBERED}{i}" for i in range(len(signals))]
        if header is None or sorted(signals) != sorted(counted):
            raise RecordFileError(f"{path} is damaged: its channels and their description do not belong together")
        signals = dict(zip(_keys(path, header), (signals[name] for name in counted)))
    return time, signals, header


def _keys(path: Path, header: str) -> list[str]:
    try:
        return [f"{c['kind']}:{c['name']}" for c in json.loads(header)["channels"]]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise RecordFileError(f"{path}: its description of the channels is damaged: {error}") from error
