"""HDF5: one dataset a signal at the top of the file, `t` or `time` for the instants."""

import json
from pathlib import Path

import h5py
import numpy as np

from workbench.records.npz_file import HEADER, named_signals


def read(path: Path):
    """(time or None, signals by name, header text or None)."""
    with h5py.File(path, "r") as file:
        arrays = {name: item[()] for name, item in file.items() if isinstance(item, h5py.Dataset)}
        header = file.attrs.get(HEADER)
    if header is not None:
        header = json.loads(header)
        keys = [f"{c['kind']}:{c['name']}" for c in header["channels"]]
        arrays = {("t" if name == "t" else keys[int(name.removeprefix("channel_"))]): v for name, v in arrays.items()}
        arrays = {name: arrays[name] for name in ["t", *keys]}
    return *named_signals(path, arrays), header


def write(path: Path, time: np.ndarray, signals: dict, header: dict) -> None:
    """Write datasets channel_0, channel_1, ...; the header is an attribute of the file."""
    with h5py.File(path, "w") as file:
        file.create_dataset("t", data=time)
        for i, (name, values) in enumerate(signals.items()):
            dataset = file.create_dataset(f"channel_{i}", data=np.asarray(values))
            dataset.attrs["name"] = name
        file.attrs[HEADER] = json.dumps(header)
