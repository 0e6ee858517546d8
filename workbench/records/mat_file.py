"""MAT files: one vector per signal, `t` or `time` for the instants, or one struct of these; version 7.3 is HDF5."""

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, savemat, whosmat

from workbench.records import hdf5_file
from workbench.records.confined import load_confined
from workbench.records.limits import ReadLimits, check_counts
from workbench.records.named_arrays import HEADER, check_struct, numbered

NUMERIC = ("double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
arrays = partial(load_confined, __name__)  # (path, limits) -> arrays by name, by `load` in a separate process


def load(path: Path, limits: ReadLimits) -> dict[str, np.ndarray]:
    """The arrays of numbers and texts in the file, sizes checked first; to be called in a separate process."""
    if hdf5_file.is_hdf5(path):
        return hdf5_file.load(path, limits)
    held = whosmat(path, appendmat=False)
    wanted = [name for name, _, kind in held if kind in (*NUMERIC, "char")]
    structs = [name for name, _, kind in held if kind == "struct"]
    check_counts(path, len(wanted), sum(int(np.prod(shape, dtype=object)) for _, shape, _ in held), limits)
    found = {name: values for name, values in loadmat(path, appendmat=False, variable_names=wanted).items()
             if not name.startswith("__")}  # fmt: skip
    if not structs or any(values.dtype.kind in "fiubc" and values.size > 1 for values in found.values()):
        return found
    return _fields(path, structs, limits) | found


def _fields(path: Path, names: list[str], limits: ReadLimits) -> dict[str, np.ndarray]:
    """The numbers and texts in the one struct of a file; its size is known only once it is read."""
    structs = loadmat(path, appendmat=False, variable_names=names)
    only = structs[names[0]]
    fields = {name: only[name].flat[0] for name in only.dtype.names or () if only.size == 1}
    fields = {name: values for name, values in fields.items() if values.dtype.kind in "fiubcU"}
    check_struct(path, {name: structs[name].dtype.names or () for name in names}, fields)
    check_counts(path, len(fields), sum(values.size for values in fields.values()), limits)
    return fields


def write(path: Path, time: np.ndarray, signals: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> None:
    """Write numbered vectors and the header as text: names in a MAT file are identifiers."""
    savemat(path, {"t": time, **numbered(signals), HEADER: json.dumps(header)}, appendmat=False)
