"""Normal modes at nodes in universal files: data sets 55 or 2414, with the nodes of 15 or 2411, by pyuff.

Data set 164 states how many of the file's units a metre and a newton are. Shapes are ratios of displacements and are
not converted; coordinates are converted to m, rotations to rad per metre, and modal masses to kg.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from workbench.records.confined import load_confined
from workbench.records.limits import ReadLimits, RecordFileError
from workbench.records.uff_file import data_sets

NORMAL_MODE = 2  # analysis_type of both formats
AT_NODES = 1  # dataset_location of 2414
COMPLEX = (5, 6)  # data_type of both formats
MOTIONS = (0, 1, 8)  # kinds of result that are shapes: unknown, general, displacement; others are forces, stresses, ...
ALIKE = 1e-4  # of the coordinates: tolerance, as data set 15 has six digits and 2411 sixteen
DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
arrays = partial(load_confined, __name__)  # (path, limits) -> arrays by name, by `load` in a separate process


def load(path: Path, limits: ReadLimits) -> dict[str, np.ndarray]:
    """Frequencies, damping, modal masses and shapes at nodes; to be called in a separate process."""
    sets = data_sets(path)
    modes = [_of_55(s) if s["type"] == 55 else _of_2414(s) for s in sets if _is_mode(path, s)]
    if not modes:
        raise RecordFileError(
            f"{path} holds no displacements of normal modes at nodes (data sets 55 or 2414, analysis type 2, specific"
            " data type 8)"
        )
    nodes, width = modes[0]["nodes"], modes[0]["shape"].shape[1]
    for number, mode in enumerate(modes, start=1):
        if mode["shape"].shape[1] != width or not np.array_equal(mode["nodes"], nodes):
            raise RecordFileError(f"{path}, mode {number} is given at other nodes or directions than the first")
    shapes = np.stack([mode["shape"].reshape(-1) for mode in modes], axis=1)
    metre, newton = next(((s["length"], s["force"]) for s in sets if s["type"] == 164), (1.0, 1.0))
    shapes[np.tile(np.arange(width) >= 3, nodes.size)] *= metre  # rotations to rad per metre
    moving = (shapes != 0).any(axis=1)  # three directions are written even where one was measured
    found = {
        "shapes": shapes[moving],
        "nodes": np.repeat(nodes, width)[moving].astype(str),
        "directions": np.tile(DIRECTIONS[:width], nodes.size)[moving],
    }
    for name in ("frequencies_hz", "damping_ratios", "modal_mass"):
        found[name] = np.array([mode[name] for mode in modes], float)
    found["modal_mass"] *= metre / newton
    positions = _positions(path, sets)
    if positions:
        missing = [node for node in nodes if node not in positions]
        if missing:
            raise RecordFileError(f"{path}: node {missing[0]} has a shape and no coordinates in data sets 15 or 2411")
        found["positions"] = np.repeat([positions[node] for node in nodes], width, axis=0)[moving] / metre
    return found


def _is_mode(path: Path, entry: dict[str, Any]) -> bool:
    if entry["type"] not in (55, 2414) or (entry["type"] == 2414 and entry["dataset_location"] != AT_NODES):
        return False
    if entry["spec_data_type" if entry["type"] == 55 else "result_type"] not in MOTIONS:
        return False
    if entry["analysis_type"] in (3, 7):
        raise RecordFileError(f"{path} holds complex modes, which have no modal mass; export normal modes (type 2)")
    return bool(entry["analysis_type"] == NORMAL_MODE)


def _of_55(entry: dict[str, Any]) -> dict[str, Any]:
    columns = [np.asarray(entry[f"r{i}"]) for i in range(1, 7) if f"r{i}" in entry]
    return {
        "nodes": np.asarray(entry["node_nums"], int),
        "shape": np.stack(columns, axis=1),
        "frequencies_hz": entry["freq"],
        "damping_ratios": entry.get("modal_damp_vis") or 0.5 * (entry.get("modal_damp_his") or 0.0),
        "modal_mass": entry.get("modal_m") or np.nan,
    }


def _of_2414(entry: dict[str, Any]) -> dict[str, Any]:
    # record 12: time, frequency, eigenvalue, modal mass, viscous and hysteretic damping
    _, frequency, _, mass, viscous, hysteretic = (entry.get(f"record12_field{i}") or 0.0 for i in range(1, 7))
    shape = np.stack(entry["data_at_node"])
    return {
        "nodes": np.asarray(entry["node_nums"], int),
        "shape": shape[:, ::2] + 1j * shape[:, 1::2] if entry["data_type"] in COMPLEX else shape,
        "frequencies_hz": frequency,
        "damping_ratios": viscous or 0.5 * hysteretic,
        "modal_mass": mass or np.nan,
    }


def _positions(path: Path, sets: list[dict[str, Any]]) -> dict[int, tuple[float, float, float]]:
    """Coordinates of each node, in the units of the file."""
    found: dict[int, tuple[float, float, float]] = {}
    for entry in sets:
        if entry["type"] in (15, 2411):
            for node, x, y, z in zip(entry["node_nums"], entry["x"], entry["y"], entry["z"]):
                place = found.setdefault(int(node), (float(x), float(y), float(z)))
                if not np.allclose(place, (x, y, z), rtol=ALIKE, atol=ALIKE * max(map(abs, place))):
                    raise RecordFileError(f"{path}: node {int(node)} has two positions, {place} and {(x, y, z)}")
    return found
