"""The header of a LabVIEW measurement file: units and sampling of its columns."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from workbench.records.limits import RecordFileError
from workbench.records.units import time_factor

WITHOUT_X = re.compile(r"X_Columns\W+No\W*", re.IGNORECASE)  # the line that says that no instants are written
END = "***End_of_Header***"


@dataclass(frozen=True)
class LabviewHeader:
    """Units and sampling in the header.

    Attributes:
        units: one per channel, as written; empty where none are stated.
        sampling: (start, step), s, where the instants are not written.
    """

    units: tuple[str, ...] = ()
    sampling: tuple[float, float] | None = None

    def of_columns(self, names: Sequence[str]) -> tuple[str, ...]:
        """One unit per column, empty for times."""
        channels = [name for name in names if time_factor(name) is None]
        by_name = dict(zip(channels, self.units))
        return tuple(by_name.get(name, "") for name in names) if self.units else ()


def labview_header(path: Path, lines: Sequence[Sequence[str]]) -> LabviewHeader:
    """The header in the lines above the numbers (split into fields); empty for files of other programs.

    Raises:
        RecordFileError: spectra, or channels without instants that differ in start or rate.
    """
    rows = {fields[0].strip(): [text.strip() for text in fields[1:]] for fields in lines if fields}
    if END not in rows:
        return LabviewHeader()
    over = next((text for text in rows.get("X_Dimension", ()) if text), "Time")
    if over != "Time":
        raise RecordFileError(f"{path}: its X_Dimension is {over}; a record runs over Time")
    units = tuple(rows.get("Y_Unit_Label", ()))
    if rows.get("X_Columns", [""])[0].lower() != "no" or "Delta_X" not in rows:
        return LabviewHeader(units)
    starts, steps = ({text.replace(",", ".") for text in rows.get(key, ()) if text} for key in ("X0", "Delta_X"))
    try:
        found = {float(text) for text in starts} or {0.0}, {float(text) for text in steps}
    except ValueError as error:
        raise RecordFileError(f"{path}: its X0 or Delta_X cannot be read: {error}") from None
    if any(len(values) != 1 for values in found):
        raise RecordFileError(f"{path}: its channels differ in X0 or Delta_X; export them at one start and rate")
    (start,), (step,) = found
    return LabviewHeader(units, (start, step))
