"""TDMS files of LabVIEW: one channel per signal, with unit and sampling among its properties."""

import logging
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from workbench.records.confined import load_confined
from workbench.records.limits import ReadLimits, RecordFileError, check_counts

LEAD_IN, BIG_ENDIAN = 28, 1 << 6  # bytes before each segment; the flag in them of its byte order
TOGETHER = 0.01  # of a step: tolerance of the start times of channels
arrays = partial(load_confined, __name__)  # (path, limits) -> arrays by name, by `load` in a separate process


class _Refused(logging.Handler):
    """Warnings of npTDMS as errors: after one it leaves the end of a file out, or returns unscaled numbers."""

    def emit(self, record: logging.LogRecord) -> None:
        if record.name != "nptdms.types":  # texts in another encoding
            raise ValueError(f"it is damaged, was cut short, or is of a kind that is not read: {record.getMessage()}")


def _check_whole(path: Path) -> None:
    """Refuse a file that ends within a segment, by the lengths in their lead-ins; npTDMS overlooks one in a lead-in."""
    size, position = path.stat().st_size, 0
    with path.open("rb") as file:
        while position < size:
            file.seek(position)
            lead_in = file.read(LEAD_IN)
            if position == 0 and lead_in[:4] != b"TDSm":
                return  # no TDMS file at all, as npTDMS says
            order: Literal["big", "little"] = "big" if int.from_bytes(lead_in[4:8], "little") & BIG_ENDIAN else "little"
            position += LEAD_IN + int.from_bytes(lead_in[12:20], order)
    if position > size:
        raise RecordFileError(f"{path} ends within its last segment: it was cut short, or is still being written")


def load(path: Path, limits: ReadLimits) -> dict[str, np.ndarray]:
    """The channels of numbers, with units in brackets after their names, and `t` where the file has sample instants."""
    from nptdms import TdmsFile

    logging.getLogger("nptdms").handlers = [_Refused()]
    _check_whole(path)
    with TdmsFile.open(path) as file:
        channels = [channel for group in file.groups() for channel in group.channels() if len(channel)]
        channels = [channel for channel in channels if channel.dtype.kind in "fiub"]
        check_counts(path, len(channels), sum(map(len, channels)), limits)
        twice = Counter(channel.name for channel in channels)
        found: dict[str, np.ndarray] = {}
        sampling: set[tuple[float, float]] = set()
        starts: dict[str, np.datetime64] = {}
        for channel in channels:
            name = channel.name if twice[channel.name] == 1 else f"{channel.group_name}/{channel.name}"
            unit = str(channel.properties.get("unit_string", "")).strip()
            name = f"{name} [{unit}]" if unit else name
            if name in found:
                raise RecordFileError(f"{path} has two channels {name!r}; rename one of them")
            found[name] = channel[:]
            step = float(channel.properties.get("wf_increment", 0.0))
            if step > 0:
                sampling.add((float(channel.properties.get("wf_start_offset", 0.0)), step))
                if "wf_start_time" in channel.properties:
                    starts[name] = np.datetime64(channel.properties["wf_start_time"])
    if len(sampling) > 1:
        raise RecordFileError(f"{path}: its channels have {len(sampling)} different sample instants; export one rate")
    if starts:
        first, last = min(starts, key=starts.__getitem__), max(starts, key=starts.__getitem__)
        difference = (starts[last] - starts[first]) / np.timedelta64(1, "s")
        if difference > TOGETHER * min(step for _, step in sampling):
            raise RecordFileError(
                f"{path}: channel {last!r} starts {difference:g} s after {first!r}; export channels that start together"
            )
    lengths = {values.size for values in found.values()}
    if sampling and len(lengths) == 1:
        ((start, step),) = sampling
        if not found.keys().isdisjoint(("t", "t [s]")):
            raise RecordFileError(f"{path} has a channel 't' beside the sample instants of its channels; rename it")
        return {"t [s]": start + step * np.arange(lengths.pop()), **found}
    return found
