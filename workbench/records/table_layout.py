"""The layout of a text table: header lines, units, delimiter, time stamps and decimal mark.

Instruments write comments, headers of several lines, a line of units; tabs, semicolons, commas or spaces between the
fields; a date and a time of day instead of seconds. All of this is recognised from the lines down to the first row of
numbers, except the decimal mark, which the first row with one determines.
"""

import csv
import re
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE, getincrementaldecoder
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import TextIOBase
from pathlib import Path

from workbench.records.assembly import FILL, KEY
from workbench.records.limits import RecordFileError
from workbench.records.time_stamps import MOMENT, n_stamps
from workbench.records.units import split_unit, time_factor, unit_named

MARK = "# record "
LONGEST_LINE = 1_000_000  # characters
LONGEST_HEADER = 1000, 4 * LONGEST_LINE  # lines, and characters in all
SNIFFED = 2**20  # bytes, for the encoding
DELIMITERS = "\t", ";", ",", " "
# parts of a description written by this program: a line with one of them is not a header of another program
OURS = (f'"{KEY}":', '"channels":', '"kind":', '"noise_std":')
SMALL = re.compile(r" *[-+]?[1-9]\d{0,2} *")  # a whole number that needs no thousands separator
FORTRAN = re.compile(r"(?<=[\d.])[dD](?=[-+\d])")  # the exponent of a double, as in 1.5D+00
REAL = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
COMPLEX = re.compile(rf"\s*\(?([-+]?{REAL})([-+]{REAL})[ij]\)?\s*")
BETWEEN = re.compile(r"[\s'’]")  # the digits of thousands
THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(?:(?:,\d{3})+(?:\.\d*)?|(?:\.\d{3})+(?:,\d*)?)")
ONE_MARK = "write numbers with one decimal mark and without thousands separators"
MARKS = re.compile("[.,]")
COMMENTS = re.compile(r'[\t;,] *"?comment"?\s*', re.IGNORECASE)  # at the end of a line of names, as in LabVIEW files
NO_UNIT = ("", "-", "–")
LABVIEW_END = "***End_of_Header***"
LABVIEW_SEGMENT = re.compile(r"Channels\W+\d+\W*")  # the first line of the header of a segment
LABVIEW_WITHOUT_X = re.compile(r"X_Columns\W+No\W*", re.IGNORECASE)  # the line that says that no instants are written


@dataclass(frozen=True)
class Layout:
    """The layout of a table."""

    names: tuple[str, ...]  # one per column of numbers
    units: tuple[str, ...]  # one per column of numbers, as written; empty where none are stated
    delimiter: str  # between fields; a blank for any run of white space
    n_front: int = 0  # number of leading columns that are not numbers
    stamped: bool = False  # whether these are a date, a time of day, or both; else they are empty, as in LabVIEW files
    trailing: bool = False  # whether each row ends with a delimiter
    comments: bool = False  # whether texts may follow the numbers
    header: str | None = None  # the description written by this program, as a JSON text
    first: tuple[int, str] = (0, "")  # number in the file, and text, of the first row of numbers
    sampling: tuple[float, float] | None = None  # (start, step), s, where the header states them
    decimal_comma: bool | None = None  # whether the decimal mark is a comma; None until a number has a mark
    has_complex: bool = False  # whether numbers as 1.2+3.4i are two columns, of real and imaginary parts

    def parted(self, line: str) -> str:
        """A row with the real and imaginary parts of complex numbers in fields of their own."""
        return COMPLEX.sub(rf"\1{self.delimiter}\2", line) if self.has_complex else line

    def fields(self, line: str) -> list[str]:
        """The fields of a row that should be numbers."""
        fields = _fields(self.parted(line), self.delimiter, self.trailing)[self.n_front :]
        return fields[: len(self.names)] if self.comments else fields


def decided(path: Path, layout: Layout, block: str, lines: Sequence[str]) -> Layout:
    """The layout with the decimal mark of the first of these rows that has one; unchanged where none has.

    Marks that may be thousands separators, as in a column of 999 and 1,500, are refused.
    """
    signs = '."' if layout.delimiter == "," else ".,"  # without these there are whole numbers alone
    if layout.decimal_comma is not None or not any(sign in block for sign in signs):
        return layout
    mark = next((found[0] for line in lines for found in map(MARKS.search, layout.fields(line)) if found), None)
    if mark is None:
        return layout
    if all(THOUSANDS.fullmatch(field.strip()) for line in lines for field in layout.fields(line) if mark in field):
        for name, column in zip(layout.names, zip(*map(layout.fields, lines))):
            marked = [field for field in column if mark in field]
            if marked and any(map(SMALL.fullmatch, column)):
                raise RecordFileError(
                    f"{path}, channel {name!r}: {marked[0]!r} stands beside numbers without {mark!r}: does it separate"
                    f" thousands? {ONE_MARK[0].upper()}{ONE_MARK[1:]}, decimals in every row"
                )
    return replace(layout, decimal_comma=mark == ",")


def encoding_of(path: Path) -> str:
    """The encoding of a file by its first bytes: UTF-8 or UTF-16, with a mark or without, else Latin-1."""
    with path.open("rb") as file:
        start = file.read(SNIFFED)
    if start.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        return "utf-16"
    high, low = (start[first::2].count(0) for first in (0, 1))
    if max(high, low) > len(start) // 4 and min(high, low) == 0:  # without a mark, of Latin letters
        return "utf-16-be" if high else "utf-16-le"
    try:
        getincrementaldecoder("utf-8")().decode(start.removeprefix(BOM_UTF8))
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def layout_of(path: Path, file: TextIOBase) -> Layout:
    """The layout of a table, recognised from the file down to its first row of numbers."""
    lines: list[tuple[int, str]] = []  # of text, with their rows
    header, comment, characters = None, "", 0
    without_x = comments = False
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
            found = _row_of_numbers(path, number, line, without_x)
            if found is None and comments:
                found = _row_of_numbers(path, number, line.rpartition(_delimiter(line))[0], without_x)
            if found is not None:
                found = replace(found, header=header, first=(number, line), comments=comments)
                return _with_names(path, lines, comment, found)
            without_x = without_x or LABVIEW_WITHOUT_X.fullmatch(line) is not None
            comments = comments or COMMENTS.search(line) is not None
            lines.append((number, line))
    else:
        raise RecordFileError(f"{path}: no row of numbers in its first {LONGEST_HEADER[0]} rows{_obstacle(lines)}")
    if not lines:
        raise RecordFileError(f"{path} holds no rows")
    number, line = lines[0]
    delimiter = _delimiter(line)
    layout = Layout(_names(path, _fields(line, delimiter, False)), (), delimiter, header=header)
    for number, line in lines[1:]:
        check_row(path, layout, number, line)
    return layout


def _obstacle(lines: Sequence[tuple[int, str]]) -> str:
    """What is no number in the row with the most numbers, in words."""
    most, at, what = 0, 0, ""
    for number, line in lines:
        for delimiter in DELIMITERS:
            fields = line.split(delimiter)
            others = [field.strip() for field in fields if not _is_number(field, None)]
            if others and len(fields) - len(others) > most:
                most, at, what = len(fields) - len(others), number, others[0][:40]
    found = f"{what!r} is no number" if what else "a field is empty"
    return f": in row {at} {found}; leave that column out, or write numbers" if most else "; is it a table?"


def check_length(path: Path, number: int, line: str) -> None:
    """Refuse a line of `LONGEST_LINE` characters or more, by a `RecordFileError`."""
    if len(line) >= LONGEST_LINE:
        raise RecordFileError(f"{path}, row {number} has more than {LONGEST_LINE} characters: is it a table?")


def check_row(path: Path, layout: Layout, number: int, line: str) -> list[float]:
    """The numbers of a row; one with too many or too few fields, or a field that is not a number, is refused."""
    if LABVIEW_SEGMENT.fullmatch(line):
        raise RecordFileError(
            f"{path}, row {number}: the header of a further segment; write the LabVIEW file with 'One header only', or"
            " each segment into a file of its own"
        )
    fields = layout.fields(line)
    if len(fields) != len(layout.names):
        raise RecordFileError(f"{path}, row {number} has {len(fields)} fields; the header has {len(layout.names)}")
    numbers = []
    for name, field in zip(layout.names, fields):
        try:
            numbers.append(_number(field, layout.decimal_comma))
        except ValueError:
            text = field if len(field) < 40 else f"{field[:40]}..."
            joined = BETWEEN.sub("", field)
            marked = _is_number(joined, None) or THOUSANDS.fullmatch(joined)
            hint = f" with the decimal mark of this table; {ONE_MARK}" if marked else ""
            hint = hint if text.strip() else f"; {FILL}"
            raise RecordFileError(f"{path}, channel {name!r}, row {number}: {text!r} is not a number{hint}") from None
    return numbers


def _with_names(path: Path, lines: Sequence[tuple[int, str]], comment: str, found: Layout) -> Layout:
    """The layout with the names and units of the header lines with as many fields as the first row of numbers."""
    first, width = found.first[0], len(found.names)
    rows = []
    # in the header of LabVIEW files lines may have as many fields as the table
    below = next((i for i in reversed(range(len(lines))) if lines[i][1].startswith(LABVIEW_END)), -1) + 1
    for number, line in lines[below:]:
        fields = _fields(line, found.delimiter, found.trailing)
        if found.comments and fields and fields[-1].strip().lower() == "comment":
            fields = fields[:-1]
        if len(fields) == found.n_front + width:
            rows.append((number, line, [field.strip() for field in fields[found.n_front :]]))
    titles = [row for row in rows if not any(_is_number(f, None) or MOMENT.fullmatch(f) for f in row[2])]
    if not titles or (len(titles) == 1 and _are_units(titles[0][2], set())):
        # channels may be named by their numbers, as in `Time, 1, 2`
        titles = [row for row in rows if row in titles
                  or (time_factor(row[2][0]) is not None and all(map(str.isdecimal, row[2][1:])))]  # fmt: skip
    channel_units, sampling = _labview_header(path, [_fields(line, found.delimiter, False) for _, line in lines])
    if not titles:  # as numpy's savetxt: behind a comment
        names = _fields(comment, found.delimiter, found.trailing)[found.n_front :]
        if len(names) != width and rows:
            odd = next(f for f in rows[-1][2] if _is_number(f, None) or MOMENT.fullmatch(f))
            raise RecordFileError(
                f"{path}, row {rows[-1][0]}: a header line is needed before the numbers, and {odd[:40]!r} is no name"
                " in one"
            )
        if len(names) != width:
            above = f"; the line above has {len(_fields(lines[-1][1], found.delimiter, False))}" if lines else ""
            raise RecordFileError(
                f"{path}, row {first} has {found.n_front + width} fields{above}: a header line of as many names is"
                " needed before the numbers"
            )
        return _with_parts(replace(found, names=_names(path, names)))
    at, units = _names_and_units([fields for _, _, fields in titles])
    names = _distinct_names([fields for i, (_, _, fields) in enumerate(titles[: at + 1]) if i != units])
    if units is not None:
        column_units = tuple(map(_bare, titles[units][2]))
    else:
        by_name = dict(zip((name for name in names if time_factor(name) is None), channel_units))
        column_units = tuple(by_name.get(name, "") for name in names) if channel_units else ()
    as_written = _fields(titles[at][1], found.delimiter, found.trailing)[found.n_front :]
    names_read = _names(path, names, as_written, found.n_front)
    layout = replace(found, names=names_read, units=column_units, sampling=sampling)
    for row in rows:
        if row[0] > titles[at][0] and row not in titles:
            check_row(path, layout, *row[:2])
    if units is None:
        for number, _, fields in titles[at + 1 :]:
            for name, text in zip(names, fields):
                if unit_named(_bare(text)) is not None or (time_factor(name) is not None and text not in NO_UNIT):
                    raise RecordFileError(
                        f"{path}, row {number}: {text[:40]!r} below {name!r} is neither a number nor one of a line of"
                        " known units; write units in brackets behind the names"
                    )
    return _with_parts(layout)


def _labview_header(path: Path, lines: Sequence[Sequence[str]]) -> tuple[tuple[str, ...], tuple[float, float] | None]:
    """Units of the channels and sampling in the header of a LabVIEW file, from the lines above the numbers (in fields).

    Units are one per channel as written, none for files of other programs; sampling is (start, step), s, where the
    instants are not written.
    """
    rows = {fields[0].strip(): [text.strip() for text in fields[1:]] for fields in lines if fields}
    if LABVIEW_END not in rows:
        return (), None
    over = next((text for text in rows.get("X_Dimension", ()) if text), "Time")
    if over != "Time":
        raise RecordFileError(f"{path}: its X_Dimension is {over}; a record runs over Time")
    units = tuple(rows.get("Y_Unit_Label", ()))
    if rows.get("X_Columns", [""])[0].lower() != "no" or "Delta_X" not in rows:
        return units, None
    starts, steps = ({text.replace(",", ".") for text in rows.get(key, ()) if text} for key in ("X0", "Delta_X"))
    try:
        found = {float(text) for text in starts} or {0.0}, {float(text) for text in steps}
    except ValueError as error:
        raise RecordFileError(f"{path}: its X0 or Delta_X cannot be read: {error}") from None
    if any(len(values) != 1 for values in found):
        raise RecordFileError(f"{path}: its channels differ in X0 or Delta_X; export them at one start and rate")
    (start,), (step,) = found
    return units, (start, step)


def _with_parts(layout: Layout) -> Layout:
    """The layout with a column each for the real and the imaginary part of complex numbers."""
    if not layout.has_complex:
        return layout
    fields = _fields(layout.first[1], layout.delimiter, layout.trailing)[layout.n_front :]
    units, names = layout.units or ("",) * len(layout.names), []
    for name, unit, field in zip(layout.names, units, fields):
        full = f"{name} [{unit}]" if unit else name
        names += [f"{full} real", f"{full} imag"] if COMPLEX.fullmatch(field) else [full]
    return replace(layout, names=tuple(names), units=())


def _names_and_units(titles: Sequence[list[str]]) -> tuple[int, int | None]:
    """Indices of the header lines of names and of units (or None); for names a line that names a time is preferred."""
    timed = [{j for j, field in enumerate(fields) if time_factor(field) is not None} for fields in titles]
    from_below = reversed(range(len(titles))) if len(titles) > 1 else ()
    are_units = (i for i in from_below if _are_units(titles[i], set().union(*timed[:i], *timed[i + 1 :])))
    units = next(are_units, None)
    others = [i for i in range(len(titles)) if i != units]
    nearest = others[-1] if units in (None, 0) else units - 1
    return next((i for i in reversed(others) if timed[i]), nearest), units


def _are_units(fields: Sequence[str], timed: set[int]) -> bool:
    """Whether the fields of a header line are units.

    The unit of a time must be one of time. Without times, all fields must be known units, in brackets or empty, or more
    than half must be known.
    """
    stated = {j: text for j, text in enumerate(fields) if text not in NO_UNIT}
    known = {j: unit for j, text in stated.items() if (unit := unit_named(_bare(text))) is not None}
    times = [j in known and known[j].quantity == "time" for j in timed & stated.keys()]
    if times or not known:
        return bool(known) and all(times)
    return 2 * len(known) > len(stated) or all(j in known or text[0] in "[(" for j, text in stated.items())


def _bare(unit: str) -> str:
    return "" if unit in NO_UNIT else unit.strip(" []()")


def _distinct_names(titles: Sequence[list[str]]) -> list[str]:
    """The names of the last line of titles; equal ones are preceded by the text above them, and times are numbered."""
    names, times = list(titles[-1]), 0
    for j, name in enumerate(names):
        if time_factor(name) is not None and name in names[:j]:
            times += 1
            base, unit = split_unit(name)
            names[j] = f"{base} {times + 1}" + (f" [{unit}]" if unit else "")
    for above in reversed(titles[:-1]):
        names = [f"{more} {name}" if names.count(name) > 1 else name for more, name in zip(above, names)]
    return names


def _row_of_numbers(path: Path, number: int, line: str, without_x: bool) -> Layout | None:
    """The layout of a row of numbers, with leading time stamps or the empty column of LabVIEW; None for other rows."""
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
        stamps = n_stamps(fields)
        n_front = int(not fields[0].strip()) if without_x else stamps
        numbers = fields[n_front:]
        if numbers and any(all(_is_number(field, comma) for field in numbers) for comma in (False, True)):
            return Layout(("",) * len(numbers), (), delimiter, n_front, stamps > 0, trailing)
        if numbers and all(COMPLEX.fullmatch(field) or _is_number(field, False) for field in numbers):
            return Layout(("",) * len(numbers), (), delimiter, n_front, stamps > 0, trailing, has_complex=True)
        if len(numbers) > 1 and all(_is_number(f, None) or THOUSANDS.fullmatch(f.strip()) for f in numbers):
            shown = ", ".join(repr(field) for field in numbers[:10])
            raise RecordFileError(f"{path}, row {number} has points and commas in its numbers, {shown}; {ONE_MARK}")
    return None


def _delimiter(line: str) -> str:
    return next((d for d in DELIMITERS if d in line), ",")


def _fields(line: str, delimiter: str, trailing: bool) -> list[str]:
    if delimiter == " ":
        line = " ".join(line.split())
    row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True, strict=True), [])
    return row[:-1] if trailing and row and not row[-1].strip() else row


def _names(path: Path, fields: Sequence[str], as_written: Sequence[str] = (), n_front: int = 0) -> tuple[str, ...]:
    """The names of columns, without blanks around them, of which all but the first must differ and not be empty.

    For messages, `as_written` are the fields of the header line with their blanks, and `n_front` is the number of
    columns before the first.
    """
    names = tuple(name.strip() for name in fields)
    if all(_is_number(name, False) for name in names):
        raise RecordFileError(f"{path}: a header line of names is needed before the numbers")
    twice = next((name for name, count in Counter(names).items() if name and count > 1), None)
    if twice is not None:
        first, second, *_ = (i for i, name in enumerate(names) if name == twice)
        one, other = ((as_written or fields)[i] for i in (first, second))
        both = f"both called {twice!r}" if one == other else f"called {one!r} and {other!r}, alike but for blanks"
        raise RecordFileError(
            f"{path}: columns {first + n_front + 1} and {second + n_front + 1} are {both}; give them names that differ"
        )
    if not all(names[1:]):  # pandas writes its index without a name
        shown = ", ".join(map(repr, names[:10])) + (", ..." if len(names) > 10 else "")
        raise RecordFileError(f"{path}: the names of the header must differ and not be empty; got {shown}")
    return names


def _number(text: str, decimal_comma: bool | None) -> float:
    """A number with a decimal point, a decimal comma, or, where that is not known, either."""
    # Python alone accepts an underscore; a second mark would be a thousands separator
    if "_" in text or (decimal_comma is not False and "." in text and (decimal_comma or "," in text)):
        raise ValueError
    return float(FORTRAN.sub("e", text if decimal_comma is False else text.replace(",", ".")))


def _is_number(text: str, decimal_comma: bool | None) -> bool:
    try:
        _number(text, decimal_comma)
    except ValueError:
        return False
    return True
