"""Transfer functions out of the arrays that a file held."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from workbench.records.assembly import legible
from workbench.records.limits import RecordFileError
from workbench.records.record import Channel
from workbench.records.transfer_functions import TransferFunctions

# Names, in small letters, under which programs keep the lines, the sample rate, and where the points are.
HERTZ = ("f", "freq", "freqs", "frequency", "frequencies", "hz", "f_hz", "freq_hz", "frequency_hz", "frequencies_hz",
         "frequency [hz]", "f [hz]")  # fmt: skip
RADIANS = ("w", "omega", "frequency [rad/s]", "omega [rad/s]")
SURE_RATES = ("fs", "sample_rate", "sample_rate_hz")
LIKELY_RATES = ("freq", "frequency", "rate")  # where the number of samples stands beside it
SAMPLES = ("npts", "nfft", "n_samples")
PLACES = ("positions", "at")
COLUMN = re.compile(r"(.+?)[ ._]+(?:(re|real)|im|imag|imaginary)", re.IGNORECASE)
DESCRIPTION = "transfer_header"


def holds_transfer(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether any array is complex, as no record is."""
    return any(values.dtype.kind == "c" and values.size > 1 for values in arrays.values())


def complex_columns(signals: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns of a table that begins with frequencies, real and imaginary parts put together; else none."""
    names = list(signals)
    if not names or names[0].lower() not in (*HERTZ, *RADIANS):
        return {}
    parts: dict[str, dict[bool, np.ndarray]] = {}
    for name in names[1:]:
        column = COLUMN.fullmatch(name)
        if column:
            parts.setdefault(column[1], {})[column[2] is not None] = signals[name]
    both = {name: part[True] + 1j * part[False] for name, part in parts.items() if len(part) == 2}
    return {names[0]: signals[names[0]], **both} if 2 * len(both) == len(names) - 1 else {}


def transfer_of(
    path: Path, arrays: Mapping[str, np.ndarray], *, sample_rate_hz: float | None = None
) -> TransferFunctions:
    """The transfer functions that a file held.

    Args:
        path: of the file, for messages.
        arrays: complex ones, one axis of each as long as there are lines, the others its points (and references); the
            lines under a name of `HERTZ` or `RADIANS`, or a sample rate.
        sample_rate_hz: where the file has neither; its lines then go from zero to half of it.

    Raises:
        RecordFileError: naming the file and the array, and what would be right.
    """
    found = {name: np.squeeze(v) for name, v in arrays.items() if v.dtype.kind == "c" and v.size > 1}
    lines = _lines(path, arrays, found, sample_rate_hz)
    spectra = {name: _frequency_last(path, name, values, lines.size) for name, values in found.items()}
    if len(spectra) > 1 and any(values.ndim > 1 for values in spectra.values()):
        shapes = ", ".join(f"{name} {values.shape}" for name, values in found.items())
        raise RecordFileError(f"{path} holds several complex arrays, {shapes}: keep one, or a vector for each point")
    name, values = next(iter(spectra.items()))
    if values.ndim < 3:
        values = np.array([*spectra.values()]).reshape(-1, 1, lines.size)
    points = list(spectra) if len(spectra) > 1 else [f"{name} {i + 1}" for i in range(len(values))]
    channels, references = _points(path, arrays, points, values.shape[1])
    try:
        return TransferFunctions(values, lines, channels, references, path.stem)
    except ValueError as error:
        raise RecordFileError(f"{path}: {error}") from error


def _lines(path: Path, arrays: Mapping[str, Any], found: Mapping[str, Any], sample_rate_hz: float | None) -> np.ndarray:
    """Hz."""
    real = {
        name: np.ravel(v) for name, v in arrays.items() if v.dtype.kind in "fiu" and max(v.shape, default=1) == v.size
    }
    vectors = [
        (name, values.astype(float) / (2.0 * np.pi if name.lower() in RADIANS else 1.0))
        for name, values in real.items()
        if name.lower() in (*HERTZ, *RADIANS) and values.size > 1
    ]
    if len(vectors) > 1:
        names = " and ".join(name for name, _ in vectors)
        raise RecordFileError(f"{path} holds two arrays of frequencies, {names}; leave one out")
    if vectors and sample_rate_hz is not None:
        raise RecordFileError(f"{path} holds its frequencies, {vectors[0][0]!r}; leave the sample rate out")
    if vectors:
        return vectors[0][1]
    scalars = {name.lower(): float(values[0]) for name, values in real.items() if values.size == 1}
    longest = max(max(values.shape) for values in found.values())
    whole = any(scalars.get(name) in (2 * longest - 2, 2 * longest - 1) for name in SAMPLES)
    rates = [scalars[name] for name in (*SURE_RATES, *(LIKELY_RATES if whole else ())) if name in scalars]
    rate = sample_rate_hz if sample_rate_hz is not None else rates[0] if rates else None
    if rate is None:
        name = next(iter(found))
        raise RecordFileError(
            f"{path}, {name!r} is complex: transfer functions? No lines stand beside it; add them as an array"
            " 'frequency_hz', or give the sample rate if they go from zero to half of it"
        )
    if not 0 < rate < np.inf:
        raise RecordFileError(f"{path}: the sample rate must be positive; got {rate:g}")
    return np.linspace(0.0, 0.5 * rate, longest)


def _frequency_last(path: Path, name: str, values: np.ndarray, n_lines: int) -> np.ndarray:
    along = [axis for axis, size in enumerate(values.shape) if size == n_lines]
    if len(along) != 1 or values.ndim > 3:
        which = "which axis they run along is not clear" if along else "no axis is as long"
        raise RecordFileError(
            f"{path}, {name!r} has shape {values.shape} for {n_lines} lines: {which}; give (n_outputs, n_frequencies)"
            " or (n_outputs, n_references, n_frequencies)"
        )
    return np.moveaxis(values, along[0], -1)


def _points(
    path: Path, arrays: Mapping[str, Any], names: list[str], n_references: int
) -> tuple[tuple[Channel, ...], tuple[str, ...]]:
    """Channels and references: as the file names them, else numbered."""
    if DESCRIPTION in arrays:
        try:
            described = json.loads(str(arrays[DESCRIPTION]))
            channels = tuple(Channel(legible(path, str(c["name"])), str(c["quantity"])) for c in described["outputs"])
            return channels, tuple(legible(path, str(name)) for name in described["references"])
        except RecordFileError:
            raise
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise RecordFileError(f"{path}: its description of the points is damaged: {error}") from error
    at = [np.ravel(arrays[name]) for name in PLACES if name in arrays]
    if at and at[0].shape != (len(names),):
        raise RecordFileError(f"{path} gives {at[0].size} places of {len(names)} points; give each its own")
    if at and at[0].dtype.kind not in "fiu":
        text = str(at[0][0])[:40]
        raise RecordFileError(f"{path} gives places that are no numbers, {text!r} among them; give metres")
    places = [float(x) for x in at[0]] if at else [None] * len(names)
    channels = tuple(Channel(legible(path, name), at=x) for name, x in zip(names, places, strict=True))
    return channels, tuple(f"input {i + 1}" for i in range(n_references))
