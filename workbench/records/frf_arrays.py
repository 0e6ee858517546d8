"""FRFs from the arrays of a file, or from the columns of a table."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from workbench.records.assembly import damaged, legible, unit_remark
from workbench.records.frequency_responses import FrequencyResponses
from workbench.records.limits import RecordFileError
from workbench.records.record import Channel
from workbench.records.units import BRACKETED, split_unit, unit_named

# Names, in small letters, that programs use for the lines, the sample rate, and the places of the points.
HERTZ = ("f", "freq", "freqs", "frequency", "frequencies", "hz", "f_hz", "freq_hz", "frequency_hz", "frequencies_hz",
         "frequency [hz]", "f [hz]")  # fmt: skip
RADIANS = ("w", "omega", "w_rad_s", "omega_rad_s", "frequency_rad_s", "frequencies_rad_s",
           "frequency [rad/s]", "omega [rad/s]")  # fmt: skip
SURE_RATES = ("fs", "sample_rate", "sample_rate_hz")
LIKELY_RATES = ("freq", "frequency", "rate")  # with a number of samples too
SAMPLES = ("npts", "nfft", "n_samples")
PLACES = ("positions", "at")
# names of columns with parts of complex numbers, with or without the name of a channel
COLUMN = re.compile(
    r"(?:(.+?)[ ._]+)?(?:(re|real)|(im|imag|imaginary)|(mag|magnitude|amplitude)|(phase))", re.IGNORECASE
)
COHERENCE = re.compile(r"(?:.*[ ._])?(?:coh|coherence|γ²|gamma\^?2)(?:[ ._\d].*)?", re.IGNORECASE)
DECIBEL = re.compile(r"(.+?)\s*[\[(]\s*dB\s*[\])]", re.IGNORECASE)
DESCRIPTION = "frf_header"
TURN = 2.0 * np.pi * (1.0 + 1e-6)  # rad: a larger phase without a unit is in degrees
REAL = 1e-6  # largest relative imaginary part of a real line


def holds_frfs(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether an array is complex, so that the file has FRFs and not a record."""
    return any(values.dtype.kind == "c" and values.size > 1 for values in arrays.values())


def complex_columns(path: Path, signals: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Lines and complex columns of a table that begins with frequencies; empty for other tables.

    Columns are real and imaginary parts, or magnitude (also in dB) and phase (in rad or degrees). Values are converted
    to SI by a known unit after the name or the part, as in `a [g/N] real`.
    """
    names = list(signals)
    base, text = split_unit(names[0]) if names else ("", "")
    unit = unit_named(text)
    in_unit = unit is not None and unit.quantity in ("frequency", "angular velocity")
    if not names or not ((in_unit and base.lower() in (*HERTZ, *RADIANS)) or names[0].lower() in (*HERTZ, *RADIANS)):
        return {}
    left_out = [name for name in names if COHERENCE.fullmatch(name)]
    names = [name for name in names if name not in left_out]
    parts: dict[str, dict[int, np.ndarray]] = {}
    outputs: dict[str, dict[str, str]] = {}
    remarks: dict[str, None] = {f"{name}: left out": None for name in left_out}
    for name in names[1:]:
        values, decibel = signals[name], DECIBEL.fullmatch(name)
        bare, *behind = _split_ratio(decibel[1] if decibel else name)
        column = COLUMN.fullmatch(bare)
        if column is None:
            break
        which = column.lastindex or 0
        output, *before = _split_ratio(column[1] or "H")
        scaled = 10.0 ** (values / 20.0) if decibel else values
        if column[5]:
            angle = unit_named(behind[0])
            if not behind[0] and np.abs(values).max(initial=0.0) > TURN:
                angle = unit_named("deg")
                remarks[f"{name}: beyond ±2π, so taken as degrees; else call it {name} [rad]"] = None
            scaled = scaled * (angle.factor if angle else 1.0)
        else:
            written = behind if any(behind) else before
            top, bottom = map(unit_named, written)
            scaled = scaled * (top.factor if top else 1.0) / (bottom.factor if bottom else 1.0)
            outputs[output] = {"quantity": top.quantity if top else "", "unit": top.si if top else ""}
            remarks |= {unit_remark(output, text, one): None for text, one in zip(written, (top, bottom)) if one}
        parts.setdefault(output, {})[which] = scaled
    pairs = [sorted(part) for part in parts.values()]
    if sum(map(len, pairs)) != len(names) - 1 or not all(pair in ([2, 3], [4, 5]) for pair in pairs):
        raise RecordFileError(
            f"{path} begins with frequencies, {names[0]!r}, and is no record; FRFs need two columns each,"
            f" NAME real and NAME imag, or NAME magnitude and NAME phase [deg]; got {', '.join(names[1:7])}"
        )
    lines = signals[names[0]]
    if in_unit and unit is not None:
        lines = lines * (unit.factor / (2.0 * np.pi if unit.quantity == "angular velocity" else 1.0))
    both = {name: part[2] + 1j * part[3] if 2 in part else part[4] * np.exp(1j * part[5])
            for name, part in parts.items()}  # fmt: skip
    arrays = {"f" if in_unit else names[0]: lines, **both}
    if not remarks and not any(facts["unit"] for facts in outputs.values()):
        return arrays
    return arrays | description({name: outputs[name] for name in both}, ["input 1"], remarks)


def description(
    outputs: Mapping[str, Mapping[str, str]], references: Sequence[str], remarks: Iterable[str]
) -> dict[str, np.ndarray]:
    """Quantity and unit of each output, the names of the inputs, and remarks, as a text beside the arrays."""
    facts = [{"name": name, **facts} for name, facts in outputs.items()]
    table = {"outputs": facts, "references": references, "remarks": [*filter(None, remarks)]}
    return {DESCRIPTION: np.array(json.dumps(table))}


def _split_ratio(name: str) -> tuple[str, str, str]:
    """A column's name without its unit, and the units above and below as written: `a [g/N]` gives (a, g, N)."""
    bare, text = split_unit(name)
    found = BRACKETED.fullmatch(name.strip())
    if text or not found:
        return bare, text, ""
    top, _, bottom = next(group for group in found.groups()[1:] if group is not None).rpartition("/")
    top, bottom = top.strip("() "), bottom.strip("() ")
    return (found[1], top, bottom) if unit_named(top) and unit_named(bottom) else (name, "", "")


def frfs_of(path: Path, arrays: Mapping[str, np.ndarray], *, sample_rate_hz: float | None) -> FrequencyResponses:
    """The FRFs in the arrays of a file.

    Args:
        path: of the file, for messages.
        arrays: complex ones, with an axis of lines, the others of points (and references); the lines under a name of
            `HERTZ` or `RADIANS`, or a sample rate.
        sample_rate_hz: where the file has neither; the lines are then from zero to the Nyquist frequency.
    """
    found = {name: _squeezed(v) for name, v in arrays.items() if v.dtype.kind == "c" and v.size > 1}
    lines, assumed = _lines(path, arrays, found, sample_rate_hz)
    spectra = {name: _frequency_last(path, name, values, lines.size) for name, values in found.items()}
    if len(spectra) > 1 and any(values.ndim > 1 for values in spectra.values()):
        shapes = ", ".join(f"{name} {values.shape}" for name, values in found.items())
        raise RecordFileError(f"{path} holds several complex arrays, {shapes}: keep one, or a vector for each point")
    name, values = next(iter(spectra.items()))
    if values.ndim < 3:
        values = np.array([*spectra.values()]).reshape(-1, 1, lines.size)
    points = list(spectra) if len(spectra) > 1 else [f"{name} {i + 1}" for i in range(len(values))]
    channels, references, remarks = _points(path, arrays, points, values.shape[1])
    try:
        return FrequencyResponses(values, lines, channels, references, path.stem, (*remarks, *assumed))
    except ValueError as error:
        raise RecordFileError(f"{path}: {error}") from error


def _squeezed(values: np.ndarray) -> np.ndarray:
    """Values without axes of length 1, but three axes where one output or one reference has several of the other."""
    squeezed = np.squeeze(values)
    return values if (values.ndim, squeezed.ndim) == (3, 2) else squeezed


def _lines(
    path: Path, arrays: Mapping[str, Any], found: Mapping[str, Any], sample_rate_hz: float | None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """The lines (n_frequencies,), Hz, and remarks on assumptions."""
    real = {name: np.ravel(v) for name, v in arrays.items()
            if v.dtype.kind in "fiu" and max(v.shape, default=1) == v.size}  # fmt: skip
    names = [name for name, values in real.items() if name.lower() in (*HERTZ, *RADIANS) and values.size > 1]
    if not names:
        return _lines_of_rate(path, real, found, sample_rate_hz)
    if len(names) > 1:
        raise RecordFileError(f"{path} holds two arrays of frequencies, {' and '.join(names)}; leave one out")
    if sample_rate_hz is not None:
        raise RecordFileError(f"{path} holds its frequencies, {names[0]!r}; leave the sample rate out")
    return real[names[0]].astype(float) / (2.0 * np.pi if names[0].lower() in RADIANS else 1.0), ()


def _lines_of_rate(
    path: Path, real: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray], sample_rate_hz: float | None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """The lines (n_frequencies,), Hz, of a DFT whose sample rate is given or in the file, and the assumption made.

    The sample rate or the number of samples may be among `real`, the vectors and single values of the file.
    """
    scalars = {name.lower(): float(values[0]) for name, values in real.items() if values.size == 1}
    longest = max(max(values.shape) for values in found.values())
    likely = (2 * longest - 2, 2 * longest - 1, 2 * longest)
    stated = next((scalars[name] for name in SAMPLES if scalars.get(name) in likely), None)
    rates = [scalars[name] for name in (*SURE_RATES, *(LIKELY_RATES if stated else ())) if name in scalars]
    rate = sample_rate_hz if sample_rate_hz is not None else rates[0] if rates else None
    if rate is None:
        name = next(iter(found))
        raise RecordFileError(
            f"{path}, {name!r} is complex: FRFs? The file has no lines; add them as an array 'frequency_hz', or give"
            " the sample rate if they go from zero to half of it"
        )
    if not 0 < rate < np.inf:
        raise RecordFileError(f"{path}: the sample rate must be positive; got {rate:g}")
    for name, values in real.items():
        if values.size == longest and (np.diff(values.astype(float)) > 0).all():
            raise RecordFileError(
                f"{path} holds a sample rate, and {name!r}, which increases as frequencies do; if it is the lines, call"
                " it 'frequency_hz' or 'omega', else leave it out"
            )
    ends = np.concatenate([np.moveaxis(v, v.shape.index(longest), -1)[..., [0, -1]].reshape(-1, 2)
                           for v in found.values() if longest in v.shape])  # fmt: skip
    is_real = (np.abs(ends.imag) <= REAL * np.abs(ends)).all(axis=0)
    if is_real[1] and not is_real[0] and stated in (None, 2 * longest):  # all lines of a DFT except that at 0 Hz
        lines = rate / (2 * longest) * np.arange(1, longest + 1)
        return lines, (
            f"no frequencies beside a sample rate of {rate:g} Hz: the {longest} lines taken from {lines[0]:g} to"
            f" {lines[-1]:g} Hz, as the last is real and the first is not; else add them as 'frequency_hz'",
        )
    # a power of two, and the last line not real: all lines of a DFT except that at the Nyquist frequency
    short = stated is None and longest & (longest - 1) == 0 and not is_real[1]
    n_samples = stated if stated is not None else 2 * longest if short else 2 * longest - 2
    doubt = "" if is_real[0] else "; but the first is not real, as that at 0 Hz is"
    lines = rate / n_samples * np.arange(longest)
    return lines, (
        f"no frequencies beside a sample rate of {rate:g} Hz: the {longest} lines taken from 0 to {lines[-1]:g} Hz"
        f"{doubt}; else add them as 'frequency_hz'",
    )


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
) -> tuple[tuple[Channel, ...], tuple[str, ...], tuple[str, ...]]:
    """Channels and references, named by the file or numbered, and the remarks of reading."""
    if DESCRIPTION in arrays:
        with damaged(path, "points"):
            described = json.loads(str(arrays[DESCRIPTION]))
            outputs = [[str(c[fact]) for fact in ("name", "quantity", "unit")] for c in described["outputs"]]
            channels = tuple(Channel(legible(path, name), quantity, unit) for name, quantity, unit in outputs)
            references, remarks = (map(str, described[key]) for key in ("references", "remarks"))
            return channels, tuple(legible(path, name) for name in references), tuple(remarks)
    at = [np.ravel(arrays[name]) for name in PLACES if name in arrays]
    if at and at[0].shape != (len(names),):
        raise RecordFileError(f"{path} gives {at[0].size} places of {len(names)} points; give each its own")
    if at and at[0].dtype.kind not in "fiu":
        text = str(at[0][0])[:40]
        raise RecordFileError(f"{path} gives places that are no numbers, {text!r} among them; give metres")
    places = [float(x) for x in at[0]] if at else [None] * len(names)
    channels = tuple(Channel(legible(path, name), at=x) for name, x in zip(names, places, strict=True))
    return channels, tuple(f"input {i + 1}" for i in range(n_references)), ()
