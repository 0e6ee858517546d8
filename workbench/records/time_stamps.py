"""Dates and times of day in text tables, and the seconds between them."""

import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np

from workbench.records.limits import RecordFileError

DATE = re.compile(r"\d{4}-\d\d-\d\d|\d{4}/\d\d/\d\d|\d{1,2}\.\d{1,2}\.\d{4}|\d{1,2}/\d{1,2}/\d{4}")
CLOCK = re.compile(r"\d{1,2}:\d\d:\d\d(?:[.,]\d+)?(?: ?[AaPp][Mm])?")
STAMP = re.compile(rf"(?:{DATE.pattern})[T ]+(?:{CLOCK.pattern})(?:Z|[-+]\d\d:?\d\d)?")
MOMENT = re.compile(rf"{STAMP.pattern}|{DATE.pattern}|{CLOCK.pattern}")
PARTS = re.compile(
    r"(?:(?P<date>[^\sT]+)[T\s]+)?(?P<hour>\d{1,2})(?P<rest>:\d\d:\d\d(?:[.,]\d+)?)(?: ?(?P<half>[AaPp])[Mm])?"
    r"(?P<zone>Z|[-+]\d\d:?\d\d)?"
)
DAY_OR_MONTH = re.compile(r"\d{1,2}/\d{1,2}/\d{4}")


def n_stamps(fields: Sequence[str]) -> int:
    """The number of fields, at the start of a row, that are a time stamp: 0, 1, or 2 with the date on its own."""
    first, second = (fields[i].strip() if i < len(fields) else "" for i in (0, 1))
    if STAMP.fullmatch(first) or CLOCK.fullmatch(first):
        return 1
    return 2 if DATE.fullmatch(first) and CLOCK.fullmatch(second) else 0


class Clock:
    """Seconds since the first time stamp of a file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._start: np.datetime64 | None = None
        self._last: np.datetime64 | None = None
        self._date, self._days = "", 0  # of the last stamp, and midnights up to it

    def seconds(self, stamps: list[str]) -> np.ndarray:
        """Seconds (n_stamps,) of dates with times of day, or of times of day alone, which may pass midnight."""
        try:
            dates, clocks, zones = zip(*map(_parts, stamps))
            # in 03/05/2024 the month is unknown, and of no account where the date changes at midnight alone
            unsure = any(DAY_OR_MONTH.fullmatch(date) for date in dates)
            known = ["1970-01-01" if unsure or not date else _iso(date) for date in dates]
            times = np.array([f"{date}T{clock}" for date, clock in zip(known, clocks)], "datetime64[ns]")
        except ValueError as error:
            raise RecordFileError(f"{self._path}: a time stamp cannot be read: {error}") from error
        times -= np.array(zones, "timedelta64[m]")
        last = times[0] if self._last is None else self._last
        passed = np.diff(times, prepend=last) < np.timedelta64(0, "ns")
        if unsure and (passed != [x != y for x, y in zip(dates, (self._date or dates[0], *dates))]).any():
            raise RecordFileError(
                f"{self._path}: dates such as {dates[0]} do not say which number is the month, and they change not only"
                " at midnight; write them as 2024-05-03"
            )
        self._date, self._last = dates[-1], times[-1]
        if unsure or not dates[0]:
            days = self._days + np.cumsum(passed)
            self._days = days[-1]
            times = times + days * np.timedelta64(1, "D")
        self._start = times[0] if self._start is None else self._start
        return np.asarray((times - self._start) / np.timedelta64(1, "ns") * 1e-9)


def _parts(stamp: str) -> tuple[str, str, int]:
    """Date (or none), time of day in 24 hours, and minutes east of Greenwich (0 where unstated) of a time stamp."""
    found = PARTS.fullmatch(stamp.replace('"', "").strip())
    if found is None:
        raise ValueError(f"{stamp[:40]!r}")
    hour = int(found["hour"]) if not found["half"] else int(found["hour"]) % 12 + 12 * (found["half"] in "pP")
    zone = found["zone"] or "Z"
    minutes = 0 if zone == "Z" else int(f"{zone[0]}1") * (60 * int(zone[1:3]) + int(zone[-2:]))
    return found["date"] or "", f"{hour:02d}{found['rest'].replace(',', '.')}", minutes


def _iso(date: str) -> str:
    """A date in ISO 8601."""
    form = "%d.%m.%Y" if "." in date else "%Y/%m/%d" if "/" in date else ""
    return datetime.strptime(date, form).date().isoformat() if form else date
