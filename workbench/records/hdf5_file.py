"""HDF5: one dataset per signal in the root group, `t` or `time` for the instants."""

import json
import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from workbench.records.confined import load_confined
from workbench.records.frf_arrays import PLACES
from workbench.records.limits import BYTES_PER_NUMBER, ReadLimits, RecordFileError, check_counts
from workbench.records.named_arrays import HEADER, check_struct, numbered
from workbench.records.units import time_factor, time_unit, unit_named

UNIT = ("unit", "units")  # attributes
MATLAB_COMPLEX = ("real", "imag")  # fields of MATLAB's complex numbers; those of h5py are numpy's

arrays = partial(load_confined, __name__)  # (path, limits) -> arrays by name, by `load` in a separate process


def load(path: Path, limits: ReadLimits) -> dict[str, np.ndarray]:
    """The numbers and texts in the file and its header, sizes checked first; to be called in a separate process."""
    with h5py.File(path, "r") as file:
        held = _held(file)
        found = {name: each for name, each in held.items() if _is_read(each)}
        structs = {name: _held(each) for name, each in held.items() if each.attrs.get("MATLAB_class") == b"struct"
                   and isinstance(each, h5py.Group)}  # fmt: skip
        if structs and not any(_is_numeric(each) and (each.size or 0) > 1 for each in found.values()):
            fields = {name: each for name, each in next(iter(structs.values())).items() if _is_read(each)}
            check_struct(path, structs, fields)
            found = fields | found
        check_counts(path, len(found), sum(map(_numbers, found.values())), limits)
        for name, dataset in found.items():
            if dataset.is_virtual or dataset.external:
                raise RecordFileError(
                    f"{path}, dataset {name!r} keeps its values in another file; write them into this"
                )
        arrays = dict(_in_units(name, dataset) for name, dataset in found.items())
        header = file.attrs.get(HEADER)
    return arrays if header is None else arrays | {HEADER: np.array(str(header))}


def _in_units(name: str, dataset: Any) -> tuple[str, np.ndarray]:
    """Name and values of a dataset, with the unit of its attributes after the name.

    The unit of instants, lines, places and single values is applied instead.
    """
    if _is_text(dataset):
        return name, np.array(dataset.asstr(errors="replace")[()], str)
    values = np.asarray(dataset[()])
    if values.dtype.names == MATLAB_COMPLEX:
        values = values["real"] + 1j * values["imag"]
    if "MATLAB_class" in dataset.attrs:  # stored column by column, the last axis first
        values = values.T
    text = next((dataset.attrs[key] for key in dataset.attrs if key.lower() in UNIT), "")
    text = text.decode(errors="replace") if isinstance(text, bytes) else text
    text = text.partition(" since ")[0].strip() if isinstance(text, str) else ""  # of dates, as netCDF has them
    unit = unit_named(text)
    if not text or values.dtype.kind == "c" or (values.size == 1 and unit is None):
        return name, values
    if unit is not None and (values.size == 1 or unit.quantity in ("time", "frequency") or name.lower() in PLACES):
        instants = unit.quantity == "time" and time_factor(name) is not None and not time_unit(name)
        return f"{name} [s]" if instants else name, unit.factor * values
    return f"{name} [{text}]", values


def is_hdf5(path: Path) -> bool:
    """Whether the file is HDF5, whatever its suffix."""
    return bool(h5py.is_hdf5(path))


def _held(group: Any) -> dict[str, Any]:
    """The members of a group by name, without soft and external links."""
    return {name: group[name] for name in group if isinstance(group.get(name, getlink=True), h5py.HardLink)}


def _is_numeric(dataset: Any) -> bool:
    return dataset.dtype.base.kind in "fiubc" or dataset.dtype.names == MATLAB_COMPLEX


def _is_text(dataset: Any) -> bool:
    return h5py.check_string_dtype(dataset.dtype) is not None


def _is_read(held: Any) -> bool:
    """Whether a member of a file is a dataset of text, or of numbers that are not MATLAB text or cells."""
    is_matlab_text = held.attrs.get("MATLAB_class") in (b"char", b"cell")
    return isinstance(held, h5py.Dataset) and (_is_text(held) or (_is_numeric(held) and not is_matlab_text))


def _numbers(dataset: Any) -> int:
    """Size of a dataset, or of its chunk if that is larger, in numbers of eight bytes."""
    size = max(int(dataset.size or 0), math.prod(dataset.chunks or (0,)))
    return max(size, -(-size * int(dataset.dtype.itemsize) // (2 * BYTES_PER_NUMBER)))


def write(path: Path, time: np.ndarray, signals: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> None:
    """Write numbered datasets, each with its name; the header is an attribute of the file."""
    with h5py.File(path, "w") as file:
        file.create_dataset("t", data=time)
        for (number, values), name in zip(numbered(signals).items(), signals, strict=True):
            file.create_dataset(number, data=np.asarray(values)).attrs["name"] = name
        file.attrs[HEADER] = json.dumps(header)
