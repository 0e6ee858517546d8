"""MAT files up to version 7.2: one vector a signal, `t` or `time` for the instants."""

import json
from pathlib import Path

import numpy as np
from scipy.io import loadmat, savemat

from workbench.records.npz_file import HEADER, named_signals


def read(path: Path):
    """(time or None, signals by name, header text or None)."""
    arrays = {name: values for name, values in loadmat(path).items() if not name.startswith("__")}
    header = None
    if HEADER in arrays:
        header = json.loads(str(np.ravel(arrays.pop(HEADER))[0]))
        # names in a MAT file are identifiers, so the channels' own names travel in the header
        keys = [f"{c['kind']}:{c['name']}" for c in header["channels"]]
        arrays = {("t" if name == "t" else keys[int(name.removeprefix("channel_"))]): v for name, v in arrays.items()}
    return *named_signals(path, arrays), header


def write(path: Path, time: np.ndarray, signals: dict, header: dict) -> None:
    """Write vectors channel_0, channel_1, ... and the header as text."""
    numbered = {f"channel_{i}": values for i, values in enumerate(signals.values())}
    savemat(path, {"t": time, **numbered, HEADER: json.dumps(header)})
