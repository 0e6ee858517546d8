"""NPZ: one array a signal, `t` or `time` for the instants; never a pickle."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from workbench.records.file_error import RecordFileError, unreadable
from workbench.records.limits import check_counts
from workbench.records.named_arrays import HEADER


def arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an archive, after a look at how large they are.

    Raises:
        RecordFileError: no archive, a damaged one, a pickle, or more than is read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
        names = [member.filename for member in members]
        if len(set(names)) != len(names):
            raise RecordFileError(f"{path} is damaged: it holds an array twice")
        check_counts(path, len(members), sum(member.file_size for member in members) // 8)
        with np.load(path, allow_pickle=False) as held:
            return {name: np.asarray(held[name]) for name in held.files}
    except RecordFileError:
        raise
    except Exception as error:  # damaged archives fail in many ways
        raise unreadable(path, error) from error


def write(path: Path, time: np.ndarray, signals: dict, header: dict) -> None:
    """Write all arrays and the header as text."""
    held: dict[str, Any] = {"t": time, **signals, HEADER: np.array(json.dumps(header))}
    with path.open("wb") as file:
        np.savez(file, **held)
