"""Text tables: one row per sample, one column per signal; the first column is time where its name says so.

Written as CSV; read in the layouts of many instruments (`table_layout.py`). Numbers are parsed in blocks of lines, so
that a long file needs the memory of its numbers and of one block.
"""

import csv
import json
import os
import re
from collections.abc import Iterator, Mapping
from functools import partial
from io import TextIOWrapper
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from workbench.records.assembly import Signals
from workbench.records.instants import in_seconds
from workbench.records.limits import DEFAULT, Deadline, ReadLimits, RecordFileError, check_counts
from workbench.records.table_layout import (
    FORTRAN,
    LONGEST_LINE,
    MARK,
    Layout,
    check_length,
    check_row,
    decided,
    encoding_of,
    layout_of,
)
from workbench.records.time_stamps import Clock
from workbench.records.units import split_unit, time_base, time_factor

BLOCK = 2**21  # characters
# a run of lines is one match without backtracking, so that 300 MB of them take seconds
BLANK_LINES = re.compile(r"\n[ \t\n]+(?<=\n)")
COMMENT_LINES = re.compile(r"^(?:#.*+\n?+)++", re.MULTILINE)
SAME = 1e-9  # of the record's length: tolerance of two equal columns of instants
COUNTERS = ("sample", "samples", "index", "n", "no", "no.", "nr", "nr.", "#", "scan", "point", "row")  # before the time


def read(path: Path, limits: ReadLimits = DEFAULT) -> Signals:
    """The signals of a table, with units in brackets after the names."""
    with path.open(encoding=encoding_of(path), newline=None) as file:
        layout = layout_of(path, file)
        blocks = [*_blocks(path, file, layout, limits)] if layout.first[1] else []
    n_columns = len(layout.names) + layout.stamped
    columns = [np.concatenate([block[:, i] for block in blocks]) if blocks else np.empty(0) for i in range(n_columns)]
    del blocks
    names = [f"{name} [{unit}]" if unit and not split_unit(name)[1] else name
             for name, unit in zip_longest(layout.names, layout.units)]  # fmt: skip
    signals = dict(zip(names, columns[layout.stamped :]))
    contents = Signals(None, signals, layout.header, row_of=partial(_row_in_file, path, layout))
    if layout.stamped:
        return contents._replace(time=columns[0])
    if layout.sampling is not None:
        start, step = layout.sampling
        return contents._replace(time=start + step * np.arange(columns[0].size))
    unnamed = signals.pop("", None)
    if unnamed is not None and not (np.diff(unnamed) == 1.0).all():
        raise RecordFileError(f"{path}: its first column has no name; give it one, as time [s]")
    numbered = () if unnamed is None else ("the first column, without a name, counts the rows: left out",)
    if not signals:
        return contents
    first, *others = signals
    if first.lower() in COUNTERS and others and time_factor(others[0]) is not None:
        first = others[0]
    if time_factor(first) is None:
        return contents._replace(remarks=numbered)
    time, remarks = in_seconds(first, signals.pop(first))
    for name in [name for name in signals if time_base(name) == time_base(first)]:
        # some programs write a time column for each channel, which must all be equal
        if not np.allclose(in_seconds(name, signals.pop(name))[0], time, rtol=1e-9, atol=SAME * np.ptp(time)):
            raise RecordFileError(
                f"{path}: channels have different sample instants, {first!r} and {name!r}; export them with one rate"
                " and start"
            )
    return contents._replace(time=time, remarks=() if layout.header else (*numbered, *remarks))


def write(path: Path, time: np.ndarray, signals: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> None:
    """Write a record with all digits, so that reading gives the same numbers."""
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(MARK + json.dumps(header) + "\n")
        writer = csv.writer(file)
        writer.writerow(["time", *signals])
        writer.writerows(zip(*(map(repr, map(float, column)) for column in (time, *signals.values())), strict=True))


def _blocks(path: Path, file: TextIOWrapper, layout: Layout, limits: ReadLimits) -> Iterator[np.ndarray]:
    """The numbers of the table in blocks (n_rows, n_columns), time stamps as seconds since the first."""
    deadline, clock = Deadline(path, limits), Clock(path)
    number, rest = layout.first[0], layout.first[1] + "\n"
    size = path.stat().st_size
    n_numbers, n_columns = 0, len(layout.names) + layout.stamped
    while True:
        text = file.read(BLOCK)
        block = rest + text
        end = block.rfind("\n") + 1 if text else len(block)
        block, rest = block[:end], block[end:]
        check_length(path, number + block.count("\n"), rest)
        lines = _lines(path, block)
        n_numbers += n_columns * len(lines)
        share = min(os.lseek(file.fileno(), 0, os.SEEK_CUR) / size, 1.0)
        check_counts(path, n_columns, n_numbers, limits, share)
        if lines:
            layout = decided(path, layout, block, lines)
            yield _numbers(path, layout, number, block, lines, clock)
        if not text:
            return
        number += block.count("\n")
        deadline.check(share)


def _lines(path: Path, block: str) -> list[str]:
    """The lines of a block without comments and blank lines."""
    if "#" in block:
        if f"\n{MARK}" in f"\n{block}":
            raise RecordFileError(f"{path} is damaged: the description of its channels stands below its numbers")
        block = COMMENT_LINES.sub("", block)
    if "\n\n" in block or "\n " in block or "\n\t" in block:
        block = BLANK_LINES.sub("\n", f"\n{block}")
    return [line for line in block.split("\n") if line and not line.isspace()]


def _numbers(path: Path, layout: Layout, number: int, block: str, lines: list[str], clock: "Clock") -> np.ndarray:
    delimiter = None if layout.delimiter == " " else layout.delimiter
    tails = lines = [*map(layout.parted, lines)] if layout.has_complex else lines
    if layout.n_front:
        split = [line.split(delimiter, layout.n_front) for line in lines]
        tails = [parts[-1] for parts in split]
    if layout.trailing:
        tails = [line.rstrip(" ").removesuffix(layout.delimiter) for line in tails]
    if FORTRAN.search(tails[0]):
        tails = [FORTRAN.sub("e", line) for line in tails]
    commas = [line.replace(",", ".") for line in tails] if layout.decimal_comma else tails
    try:
        if any(map(LONGEST_LINE.__le__, map(len, lines))) or (layout.decimal_comma and any("." in t for t in tails)):
            raise ValueError
        numbers = np.loadtxt(commas, delimiter=delimiter, comments=None, quotechar='"', ndmin=2)
        if numbers.shape != (len(lines), len(layout.names)):
            raise ValueError
    except ValueError:  # line by line, to name the faulty row and field
        numbers = np.array([*_row_by_row(path, layout, number, block)])
    if not layout.stamped:
        return numbers
    times = clock.seconds([" ".join(parts[: layout.n_front]) for parts in split])
    return np.column_stack([times, numbers])


def _row_by_row(path: Path, layout: Layout, number: int, block: str) -> Iterator[list[float]]:
    for row, line in enumerate(block.split("\n"), start=number):
        check_length(path, row, line)
        if line and not line.isspace() and not line.startswith("#"):
            yield check_row(path, layout, row, line)


def _row_in_file(path: Path, layout: Layout, sample: int) -> int:
    """The number of the line of the file with a sample, which a message names; blank lines and comments count too."""
    with path.open(encoding=encoding_of(path), newline=None) as file:
        lines = islice(enumerate(file, 1), layout.first[0] - 1, None)
        rows = (number for number, line in lines if not line.isspace() and not line.startswith("#"))
        return next(islice(rows, sample, None))
