"""The table of named points of a case: the position and direction of each, and all mode shapes there."""

import csv
from pathlib import Path
from typing import Any

import numpy as np

from workbench.cases.tables import CaseError, shown, text
from workbench.structure.domain import NamedPoints

MOST_POINTS = 100_000
MOST_BYTES = 2**28
COLUMNS = ("name", "node", "x", "y", "z", "direction")


def read_points(path: Path, n_modes: int) -> tuple[NamedPoints, np.ndarray]:
    """Named points, and mode shapes (n_points, n_modes) there, from a CSV table.

    The columns are name, node, x, y, z (m; empty in all rows if positions are not known), direction (x, y, z, rx, ry
    or rz; empty if not known) and mode_1 to mode_n, mass-normalised.

    Raises:
        CaseError: naming the file, the line and the column, and what would be right.
    """
    if not path.is_file():
        raise CaseError(f"{path}: there is no such file")
    if path.stat().st_size > MOST_BYTES:
        raise CaseError(f"{path} has {path.stat().st_size} bytes; a table of points has at most {MOST_BYTES}")
    columns = (*COLUMNS, *(f"mode_{r + 1}" for r in range(n_modes)))
    try:
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file, restkey="")
            missing = [column for column in columns if column not in (reader.fieldnames or ())]
            if missing:
                raise CaseError(f"{path}: column {missing[0]!r} is missing; the file has {shown(reader.fieldnames)}")
            rows = list(zip(range(MOST_POINTS + 1), reader, strict=False))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CaseError(f"{path} cannot be read as CSV: {error}") from error
    if not 0 < len(rows) <= MOST_POINTS:
        raise CaseError(f"{path} must list 1 to {MOST_POINTS} points")
    known = any(row[c] for _, row in rows for c in "xyz")
    numeric = [*("xyz" if known else ""), *columns[len(COLUMNS) :]]
    values = np.array([[_number(path, i, row, c) for c in numeric] for i, row in rows])
    names, directions, nodes = (
        tuple(
            "" if column == "direction" and row[column] == "" else text(row, column, f"{path}, line {i + 2}")
            for i, row in rows
        )
        for column in ("name", "direction", "node")
    )
    try:
        points = NamedPoints(names, values[:, :3] if known else None, directions, nodes)
    except ValueError as error:
        raise CaseError(f"{path}: {error}") from error
    return points, values[:, -n_modes:]


def write_points(path: Path, points: NamedPoints, values: np.ndarray) -> None:
    """Write the table that `read_points` reads."""
    places = [("", "", "")] * len(points.names) if points.positions is None else points.positions.tolist()
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*COLUMNS, *(f"mode_{r + 1}" for r in range(values.shape[1]))])
        for name, node, at, direction, row in zip(
            points.names, points.nodes, places, points.directions, values, strict=True
        ):
            writer.writerow([name, node, *at, direction, *map(repr, row.tolist())])


def _number(path: Path, line: int, row: dict[str, Any], column: str) -> float:
    try:
        value = float(row[column])
    except (TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        remedy = ""
        if column in "xyz" and not row[column]:
            remedy = "; give the position of the point, m, or leave x, y and z of every point empty"
        raise CaseError(
            f"{path}, line {line + 2}, column {column!r}: expected a finite number; got {shown(row[column])}{remedy}"
        )
    return value
