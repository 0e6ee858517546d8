"""How a text table is laid out: what stands before its numbers, and how these are separated.

Instruments write comments, headers of several lines, a line of units; tabs, semicolons, commas or spaces between the
fields; a decimal comma; a date and a time of day in place of seconds. All of it shows in the lines down to the first
that holds numbers only.
"""

import csv
import re
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE, getincrementaldecoder
from collections.abc import Sequence
from dataclasses import dataclass
from io import TextIOBase
from pathlib import Path

from workbench.records.assembly import KEY
from workbench.records.limits import RecordFileError
from workbench.records.units import unit_named

MARK = "# record "
LONGEST_LINE = 1_000_000  # characters
LONGEST_HEADER = 1000, 4 * LONGEST_LINE  # lines, and characters in all
SNIFFED = 2**20  # bytes, for the encoding
DELIMITERS = "\t", ";", ",", " "
# of a description that this program writes: a line with one of them is no header of another program
OURS = (f'"{KEY}":', '"channels":', '"kind":', '"noise_std":')
DATE = re.compile(r"\d{4}-\d\d-\d\d|\d{4}/\d\d/\d\d|\d{1,2}\.\d{1,2}\.\d{4}")
CLOCK = re.compile(r"\d{1,2}:\d\d:\d\d(?:[.,]\d+)?")
STAMP = re.compile(rf"(?:{DATE.pattern})[T ]+(?:{CLOCK.pattern})Z?")


@dataclass(frozen=True)
class Layout:
    """How the rows of a table are to be read.

    Attributes:
        names: one a column, without the columns of time stamps.
        units: one a column, as written; none where no line of units stands below the names.
        delimiter: between fields; a blank for any run of white space.
        decimal_comma: whether numbers have a comma for a point.
        n_stamps: columns at the front that hold a date, a time of day, or both in one.
        trailing: whether each row ends in a delimiter.
        header: the description that this program wrote, as a JSON text.
        first: the first row of numbers, and which row of the file it is; None where there is none.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    delimiter: str
    decimal_comma: bool
    n_stamps: int
    trailing: bool
    header: str | None
    first: tuple[int, str] | None

    def fields(self, line: str) -> list[str]:
        """The fields of a row, without its time stamps."""
        return _fields(line, self.delimiter, self.trailing)[self.n_stamps :]

    def number(self, text: str) -> float:
        """The number in a field.

        Raises:
            ValueError: no number.
        """
        return _number(text, self.decimal_comma)


def encoding_of(path: Path) -> str:
    """UTF-8 or UTF-16 by its first bytes; Latin-1 where they are neither."""
    with path.open("rb") as file:
        start = file.read(SNIFFED)
    if start.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        return "utf-16"
    try:
        getincrementaldecoder("utf-8")().decode(start.removeprefix(BOM_UTF8))
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def layout_of(path: Path, file: TextIOBase) -> Layout:
    """The layout of a table, read from the file down to its first row of numbers.

    Raises:
        RecordFileError: no names before the numbers, a row below them that holds something else, or no table at all.
    """
    lines: list[tuple[int, str]] = []  # of text, with their rows
    header, comment, characters = None, "", 0
    for number in range(1, LONGEST_HEADER[0] + 1):
        line = file.readline(LONGEST_LINE)
        characters += len(line)
        if not line or characters > LONGEST_HEADER[1]:
            break
        check_length(path, number, line)
        line = line.rstrip("\n")
        if line.startswith(MARK):
            header = line[len(MARK) :]
        elif any(sign in line for sign in OURS):
            raise RecordFileError(f"{path}, row {number}: its description of the channels is damaged")
        elif line.startswith("#"):
            comment = line.lstrip("# ")
        elif line.strip():
            found = _row_of_numbers(line)
            if found is not None:
                return _with_names(path, lines, comment, header, (number, line), *found)
            lines.append((number, line))
    else:
        raise RecordFileError(f"{path}: no row of numbers in its first {LONGEST_HEADER[0]} rows; is it a table?")
    if not lines:
        raise RecordFileError(f"{path} holds no rows")
    number, line = lines[0]
    delimiter = next((d for d in DELIMITERS if d in line), ",")
    layout = Layout(_names(path, _fields(line, delimiter, False)), (), delimiter, False, 0, False, header, None)
    for number, line in lines[1:]:
        check_row(path, layout, number, line)
    return layout


def check_length(path: Path, number: int, line: str) -> None:
    """Refuse a line that is none.

    Raises:
        RecordFileError: more than `LONGEST_LINE` characters.
    """
    if len(line) >= LONGEST_LINE:
        raise RecordFileError(f"{path}, row {number} has more than {LONGEST_LINE} characters: is it a table?")


def check_row(path: Path, layout: Layout, number: int, line: str) -> list[float]:
    """The numbers of a row.

    Raises:
        RecordFileError: too many or too few of them, or something else.
    """
    fields = layout.fields(line)
    if len(fields) != len(layout.names):
        raise RecordFileError(f"{path}, row {number} has {len(fields)} fields; the header has {len(layout.names)}")
    numbers = []
    for name, field in zip(layout.names, fields):
        try:
            numbers.append(layout.number(field))
        except ValueError:
            text = field if len(field) < 40 else f"{field[:40]}..."
            raise RecordFileError(f"{path}, channel {name!r}, row {number}: {text!r} is not a number") from None
    return numbers


def _with_names(
    path: Path,
    lines: Sequence[tuple[int, str]],
    comment: str,
    header: str | None,
    first: tuple[int, str],
    delimiter: str,
    decimal_comma: bool,
    n_stamps: int,
    trailing: bool,
) -> Layout:
    """The layout whose names stand in the last line of as many fields as the first row of numbers has."""
    fields = _fields(first[1], delimiter, trailing)
    rows = [(number, line, _fields(line, delimiter, trailing)) for number, line in lines]
    rows = [row for row in rows if len(row[2]) == len(fields)]
    titles = [row for row in rows if not any(_is_number(field, decimal_comma) for field in row[2])]
    if not titles and lines:  # of LabVIEW: a column of comments, which rows without any leave out
        *names, last = _fields(lines[-1][1], delimiter, trailing)
        if len(names) == len(fields) and last.strip().lower() == "comment":
            titles = [(*lines[-1], names)]
    units: tuple[str, ...] = ()
    if len(titles) > 1 and any(unit_named(field.strip(" []()")) for field in titles[-1][2]):
        if _are_units(titles[-1][2]):
            units = tuple(field.strip(" []()") for field in titles[-1][2][n_stamps:])
        titles = titles[:-1]
    names = (
        _distinct_names([row[2] for row in titles]) if titles else _fields(comment, delimiter, trailing)
    )  # as numpy's savetxt: behind a comment
    if not titles and len(names) != len(fields):
        if lines:
            names = _fields(lines[0][1], delimiter, False)
            layout = Layout(_names(path, names), (), delimiter, decimal_comma, 0, trailing, header, first)
            for number, line in (*lines[1:], first):
                check_row(path, layout, number, line)
        raise RecordFileError(f"{path}, row {first[0]}: a header line of names is needed before the numbers")
    layout = Layout(_names(path, names[n_stamps:]), units, delimiter, decimal_comma, n_stamps, trailing, header, first)
    for number, line, _ in rows:
        if titles and number > titles[-1][0] and not units:
            check_row(path, layout, number, line)
    return layout


def _distinct_names(titles: Sequence[list[str]]) -> list[str]:
    """The names of the last line of titles; where some are alike, behind what stands above them."""
    names = [name.strip() for name in titles[-1]]
    for above in reversed(titles[:-1]):
        names = [f"{more.strip()} {name}" if names.count(name) > 1 else name for more, name in zip(above, names)]
    return names


def _row_of_numbers(line: str) -> tuple[str, bool, int, bool] | None:
    """Delimiter, decimal comma, columns of time stamps, trailing delimiter: where all else is numbers; else None."""
    for delimiter in DELIMITERS:
        if delimiter not in line and delimiter != ",":
            continue
        trailing = delimiter in ("\t", ";", ",") and line.rstrip(" ").endswith(delimiter)
        try:
            fields = _fields(line, delimiter, trailing)
        except csv.Error:
            continue
        if trailing and len(fields) == 1:
            continue
        n_stamps = _n_stamps(fields)
        numbers = fields[n_stamps:]
        for decimal_comma in (False, True) if delimiter != "," or '"' in line else (False,):
            if numbers and all(_is_number(field, decimal_comma) for field in numbers):
                return delimiter, decimal_comma, n_stamps, trailing
    return None


def _n_stamps(fields: Sequence[str]) -> int:
    first, second = (fields[i].strip() if i < len(fields) else "" for i in (0, 1))
    if STAMP.fullmatch(first) or CLOCK.fullmatch(first):
        return 1
    return 2 if DATE.fullmatch(first) and CLOCK.fullmatch(second) else 0


def _are_units(fields: Sequence[str]) -> bool:
    """Whether all fields are units, known or in brackets, or empty."""
    texts = [field.strip() for field in fields]
    return all(text in ("", "-", "–") or text[0] in "[(" or unit_named(text) is not None for text in texts)


def _fields(line: str, delimiter: str, trailing: bool) -> list[str]:
    if delimiter == " ":
        line = " ".join(line.split())
    row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True, strict=True), [])
    return row[:-1] if trailing and row and not row[-1].strip() else row


def _names(path: Path, fields: Sequence[str]) -> tuple[str, ...]:
    names = tuple(name.strip() for name in fields)
    if all(_is_number(name, False) for name in names):
        raise RecordFileError(f"{path}: a header line of names is needed before the numbers")
    if len(set(names)) != len(names) or not all(names):
        shown = ", ".join(map(repr, names[:10])) + (", ..." if len(names) > 10 else "")
        raise RecordFileError(f"{path}: the names of the header must differ and not be empty; got {shown}")
    return names


def _number(text: str, decimal_comma: bool) -> float:
    if "_" in text:  # Python's, and nobody else's
        raise ValueError
    return float(text.replace(",", ".") if decimal_comma else text)


def _is_number(text: str, decimal_comma: bool) -> bool:
    try:
        _number(text, decimal_comma)
    except ValueError:
        return False
    return True
