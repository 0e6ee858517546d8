"""CSV: a header line of names, plain or behind #, one row a sample; the first column is time where it is called so."""

import csv
import json
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from workbench.records.file_error import RecordFileError
from workbench.records.limits import check_counts
from workbench.records.named_arrays import Signals

MARK = "# record "
TIME_NAMES = ("t", "time", "time [s]", "t [s]", "time_s")
LONGEST_LINE = 1_000_000  # characters


def read(path: Path) -> Signals:
    """(time or None, signals by name, header text or None)."""
    header_text: str | None = None
    names: list[str] = []
    comment = ""
    cells = array("d")
    delimiter = ","
    for number, line in _lines(path):
        if line.startswith(MARK):
            header_text = line[len(MARK) :]
            continue
        if not line.strip() or line.startswith("#"):
            comment = line if line.strip() else comment
            continue
        if not names:
            delimiter = next((d for d in ",;\t" if d in line), " ")
            names = _fields(line, delimiter)
            # Programs that put comments before numbers, as numpy's savetxt, put the names into the last of them.
            behind = comment and all(map(_is_number, names))
            told = _fields(comment.lstrip("# "), delimiter) if behind else []
            if len(told) != len(names):
                names = _names(path, number, names)
                continue
            names = _names(path, number, told)
        row = _fields(line, delimiter)
        if len(row) != len(names):
            raise RecordFileError(f"{path}, row {number} has {len(row)} fields; the header has {len(names)}")
        try:
            cells.extend(map(_number, row))
        except ValueError:
            name, cell = next((n, c) for n, c in zip(names, row) if not _is_number(c))
            text = cell if len(cell) < 40 else f"{cell[:40]}..."
            raise RecordFileError(f"{path}, channel {name!r}, row {number}: {text!r} is not a number") from None
        if number % 1000 == 0:
            check_counts(path, len(names), len(cells))
    if not names:
        raise RecordFileError(f"{path} holds no rows")
    check_counts(path, len(names), len(cells))
    columns = np.frombuffer(cells, float).reshape(-1, len(names)).T if cells else np.empty((len(names), 0))
    signals = dict(zip(names, columns))
    timed = names[0].lower() in TIME_NAMES
    return (signals.pop(names[0]) if timed else None), signals, header_text


def write(path: Path, time: np.ndarray, signals: dict, header: dict) -> None:
    """Write with all digits, so that reading gives the same numbers."""
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(MARK + json.dumps(header) + "\n")
        writer = csv.writer(file)
        writer.writerow(["time", *signals])
        writer.writerows(zip(*(map(repr, map(float, column)) for column in (time, *signals.values())), strict=True))


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    with path.open(newline="", encoding="utf-8-sig") as file:
        number = 0
        while line := file.readline(LONGEST_LINE):
            number += 1
            if len(line) == LONGEST_LINE:
                raise RecordFileError(f"{path}, row {number} has more than {LONGEST_LINE} characters: is it a table?")
            yield number, line


def _fields(line: str, delimiter: str) -> list[str]:
    row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True, strict=True))
    return [cell for cell in row if cell] if delimiter == " " else row


def _names(path: Path, number: int, row: list[str]) -> list[str]:
    names = [name.strip() for name in row]
    if all(_is_number(name) for name in names):
        raise RecordFileError(f"{path}, row {number}: a header line of names is needed before the numbers")
    if len(set(names)) != len(names) or not all(names):
        raise RecordFileError(f"{path}: the names of the header must differ and not be empty; got {names}")
    return names


def _number(text: str) -> float:
    if "_" in text:  # Python's, and nobody else's
        raise ValueError
    return float(text)


def _is_number(text: str) -> bool:
    try:
        _number(text)
    except ValueError:
        return False
    return True
