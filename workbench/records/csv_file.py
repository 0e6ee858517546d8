"""CSV: a header line of names, one row a sample; the first column is time where it is called so."""

import csv
import json
from pathlib import Path

import numpy as np

from workbench.records.file_error import RecordFileError

MARK = "# record "
TIME_NAMES = ("t", "time", "time [s]", "t [s]", "time_s")


def read(path: Path):
    """(time or None, signals by name, header text or None)."""
    header_text = None
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = []
        for number, line in enumerate(file, start=1):
            if line.startswith(MARK):
                header_text = line[len(MARK) :]
            elif line.strip() and not line.startswith("#"):
                lines.append((number, line))
    if not lines:
        raise RecordFileError(f"{path} holds no rows")
    delimiter = "," if "," in lines[0][1] else ";" if ";" in lines[0][1] else "\t" if "\t" in lines[0][1] else " "
    rows = list(csv.reader((line for _, line in lines), delimiter=delimiter, skipinitialspace=True))
    rows = [[cell for cell in row if cell] if delimiter == " " else row for row in rows]
    names = [name.strip() for name in rows[0]]
    if all(_is_number(name) for name in names):
        raise RecordFileError(f"{path}, row {lines[0][0]}: a header line of names is needed before the numbers")
    if len(set(names)) != len(names) or not all(names):
        raise RecordFileError(f"{path}: the names of the header must differ and not be empty; got {names}")
    values = np.empty((len(rows) - 1, len(names)))
    for i, row in enumerate(rows[1:]):
        number = lines[i + 1][0]
        if len(row) != len(names):
            raise RecordFileError(f"{path}, row {number} has {len(row)} fields; the header has {len(names)}")
        for j, cell in enumerate(row):
            try:
                values[i, j] = float(cell)
            except ValueError:
                raise RecordFileError(f"{path}, channel {names[j]!r}, row {number}: {cell!r} is not a number") from None
    signals = dict(zip(names, values.T, strict=True))
    timed = names[0].lower() in TIME_NAMES
    return (signals.pop(names[0]) if timed else None), signals, header_text


def write(path: Path, time: np.ndarray, signals: dict, header: dict) -> None:
    """Write with all digits, so that reading gives the same numbers."""
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(MARK + json.dumps(header) + "\n")
        writer = csv.writer(file)
        writer.writerow(["time", *signals])
        writer.writerows(zip(*(map(repr, map(float, column)) for column in (time, *signals.values())), strict=True))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
