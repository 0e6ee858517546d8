"""MAT files up to version 7.2: one vector a signal, `t` or `time` for the instants."""

import json
from pathlib import Path

import numpy as np
from scipy.io import loadmat, savemat

from workbench.records.confined import load_confined
from workbench.records.named_arrays import HEADER, numbered


def arrays(path: Path) -> dict[str, np.ndarray]:
    """What the file holds, by name."""
    return load_confined(__name__, path)


def load(path: Path) -> dict[str, np.ndarray]:
    """The arrays of the file; to be called in a process of its own."""
    return {name: values for name, values in loadmat(path, appendmat=False).items() if not name.startswith("__")}


def write(path: Path, time: np.ndarray, signals: dict, header: dict) -> None:
    """Write numbered vectors and the header as text: names in a MAT file are identifiers."""
    savemat(path, {"t": time, **numbered(signals), HEADER: json.dumps(header)}, appendmat=False)
