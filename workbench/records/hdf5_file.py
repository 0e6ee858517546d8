"""HDF5: one dataset a signal at the top of the file, `t` or `time` for the instants."""

import json
from pathlib import Path

import h5py
import numpy as np

from workbench.records.confined import load_confined
from workbench.records.file_error import RecordFileError
from workbench.records.limits import check_counts
from workbench.records.named_arrays import HEADER, numbered


def arrays(path: Path) -> dict[str, np.ndarray]:
    """What the file holds, by name."""
    return load_confined(__name__, path)


def load(path: Path) -> dict[str, np.ndarray]:
    """The datasets of the file itself, and its header; to be called in a process of its own."""
    with h5py.File(path, "r") as file:
        names = [name for name in file if isinstance(file.get(name, getlink=True), h5py.HardLink)]
        found = {name: file[name] for name in names if isinstance(file[name], h5py.Dataset)}
        check_counts(path, len(found), sum(int(dataset.size or 0) for dataset in found.values()))
        for name, dataset in found.items():
            if dataset.is_virtual or dataset.external:
                raise RecordFileError(
                    f"{path}, dataset {name!r} keeps its values in another file; write them into this"
                )
        arrays = {name: np.asarray(dataset[()]) for name, dataset in found.items()}
        header = file.attrs.get(HEADER)
    return arrays if header is None else arrays | {HEADER: np.array(str(header))}


def write(path: Path, time: np.ndarray, signals: dict, header: dict) -> None:
    """Write numbered datasets, each with its name; the header is an attribute of the file."""
    with h5py.File(path, "w") as file:
        file.create_dataset("t", data=time)
        for (number, values), name in zip(numbered(signals).items(), signals, strict=True):
            file.create_dataset(number, data=np.asarray(values)).attrs["name"] = name
        file.attrs[HEADER] = json.dumps(header)
