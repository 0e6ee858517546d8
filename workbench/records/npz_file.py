"""NPZ: one array per signal, `t` or `time` for the instants; never a pickle."""

import json
import zipfile
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from workbench.records.limits import DEFAULT, Deadline, ReadLimits, RecordFileError, check_counts, reading
from workbench.records.named_arrays import HEADER

ENDING = ".npy"
LONGEST_TEXT = 2**22  # characters


def arrays(path: Path, limits: ReadLimits = DEFAULT) -> dict[str, np.ndarray]:
    """The arrays of an archive, read after a check of the sizes that their headers declare; never a pickle."""
    deadline = Deadline(path, limits)
    with reading(path), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        names = [member.filename.removesuffix(ENDING) for member in members]
        if len(set(names)) != len(names):
            raise RecordFileError(f"{path} is damaged: it holds an array twice")
        check_counts(path, len(members), 0, limits)
        n_numbers = 0
        for member in members:
            with archive.open(member) as file:
                n_numbers += _declared(path, member, file)
            check_counts(path, len(members), n_numbers, limits)
            deadline.check()
        found = {}
        for name, member in zip(names, members):
            with archive.open(member) as file:
                found[name] = npy.read_array(file, allow_pickle=False)
            deadline.check()
        return found


def write(path: Path, time: np.ndarray, signals: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> None:
    """Write all arrays and the header as text."""
    held: dict[str, Any] = {"t": time, **signals, HEADER: np.array(json.dumps(header))}
    with path.open("wb") as file:
        np.savez(file, **held)


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays of any names, compressed; to `np.savez` some, such as `file`, are its own arguments."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}{ENDING}", "w", force_zip64=True) as file:
                npy.write_array(file, values, allow_pickle=False)


def _declared(path: Path, member: zipfile.ZipInfo, file: IO[bytes]) -> int:
    """Size that an array's header declares, in numbers of eight bytes; 0 for a text."""
    read = npy.read_array_header_1_0 if npy.read_magic(file) == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(file)
    size = prod(shape)
    if size < 0 or size * dtype.itemsize > member.file_size:
        raise RecordFileError(f"{path} is damaged: {member.filename} holds fewer numbers than it declares")
    if dtype.kind not in "US":
        return size * max(1, -(-dtype.itemsize // 8))
    if size * dtype.itemsize > 4 * LONGEST_TEXT:
        raise RecordFileError(f"{path}: {member.filename} is a text of more than {LONGEST_TEXT} characters")
    return 0
