"""The header of a LabVIEW measurement file: units and sampling of its channels."""

import re
from collections.abc import Sequence
from pathlib import Path

from workbench.records.limits import RecordFileError

WITHOUT_X = re.compile(r"X_Columns\W+No\W*", re.IGNORECASE)  # the line that says that no instants are written
END = "***End_of_Header***"


def labview_header(path: Path, lines: Sequence[Sequence[str]]) -> tuple[tuple[str, ...], tuple[float, float] | None]:
    """The units of the channels and the sampling in the lines above the numbers (split into fields).

    Returns:
        Units, one per channel as written, none for files of other programs; and (start, step), s, where the instants
        are not written.

    Raises:
        RecordFileError: spectra, or channels without instants that differ in start or rate.
    """
    rows = {fields[0].strip(): [text.strip() for text in fields[1:]] for fields in lines if fields}
    if END not in rows:
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
