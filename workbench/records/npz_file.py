"""NPZ: one array a signal, `t` or `time` for the instants; never a pickle."""

import json
from pathlib import Path

import numpy as np

from workbench.records.file_error import RecordFileError

HEADER = "record_header"


def read(path: Path):
    """(time or None, signals by name, header text or None)."""
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    header = str(arrays.pop(HEADER)) if HEADER in arrays else None
    return *named_signals(path, arrays), header


def named_signals(path: Path, arrays: dict) -> tuple[np.ndarray | None, dict]:
    """Time and signals out of named arrays: vectors as they are, scalars and texts left out."""
    time = None
    signals = {}
    for name, values in arrays.items():
        values = np.asarray(values)
        if values.dtype.kind not in "fiub":
            if values.dtype.kind == "c":
                raise RecordFileError(f"{path}, channel {name!r} is complex: is it a transfer function?")
            continue
        flat = values.reshape(-1) if values.ndim < 2 or 1 in values.shape else None
        if flat is None:
            raise RecordFileError(f"{path}, channel {name!r} has shape {values.shape}; one row of samples is needed")
        if flat.size == 1:
            continue
        if name in ("t", "time") and time is None:
            time = flat.astype(float)
        else:
            signals[name] = flat.astype(float)
    return time, signals


def write(path: Path, time: np.ndarray, signals: dict, header: dict) -> None:
    """Write all arrays and the header as text."""
    np.savez(path, t=time, **signals, **{HEADER: np.array(json.dumps(header))})
