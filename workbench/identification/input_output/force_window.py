"""The force window of impact tests: between blows there is no force, and what its channel reads is noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import median_abs_deviation

from workbench.arrays import Flags, Floats
from workbench.records.record import Record


@dataclass(frozen=True)
class WindowSettings:
    """Constants of the search for blows in an input."""

    loud: float = 6.0  # standard deviations of what is read between blows: of normal noise, one sample in 5e8 is so
    clear: float = 30.0  # likewise, that a blow rises to
    most: float = 0.1  # share of a record that blows take; what takes more is another excitation
    # correlation of what is read between with an output, at any lag, from which on it is a force: that of a shaker
    # which stays attached. That of noise is 4.5 over the root of the number of samples at most
    follows: float = 0.3


WINDOW = WindowSettings()


def force_window(records: Sequence[Record]) -> tuple[tuple[Record, ...], tuple[str, ...]]:
    """The records with inputs that are blows zero between them, and a remark on each such input.

    Noise of a force channel reads like a force all through the record, whose response the structure never had: it
    makes peaks at each mode, as narrow as the mode (Trethewey & Cafeo, Int. J. Analytical and
    Experimental Modal Analysis 7 (1992)).
    """
    windowed: list[Record] = []
    removed: dict[str, list[float]] = {}
    for record in records:
        inputs = record.inputs.copy()
        for row, name in zip(inputs, record.input_names, strict=True):
            level = np.median(row)
            noise = float(median_abs_deviation(row, scale="normal"))
            blows = _blows(row - level, noise)
            between = np.where(blows, 0.0, row - level)
            if blows.any() and between.any() and not _follows(between, np.where(blows, 0.0, record.outputs)):
                row[:] = np.where(blows, row - level, 0.0)
                removed.setdefault(name, []).append(noise)
        same = np.array_equal(inputs, record.inputs)
        windowed.append(record if same else replace(record, inputs=inputs))
    remarks = tuple(
        f"input {name}: force window, zero between impacts, where it reads"
        f" {np.sqrt(np.mean(np.square(noise))):.2g} rms of noise"
        for name, noise in removed.items()
    )
    return tuple(windowed), remarks


def _blows(force: Floats, noise: float) -> Flags:
    """Which samples (n_samples,) are of blows, as long again on either side; none where it is no impact test."""
    loud = np.abs(force) > WINDOW.loud * noise
    found = np.zeros(force.size, bool)
    if noise == 0.0 or np.abs(force).max() < WINDOW.clear * noise or loud.mean() > WINDOW.most:
        return found
    ends = np.flatnonzero(np.diff(np.concatenate([[False], loud, [False]])))
    for begin, end in zip(ends[::2], ends[1::2], strict=True):
        length = end - begin
        found[max(begin - length, 0) : end + length] = True
    return found


def _follows(force: Floats, outputs: Floats) -> bool:
    """Whether a force (n_samples,) correlates with outputs (n_outputs, n_samples), later or earlier."""
    size = 2 * force.size
    of_force, of_outputs = np.fft.rfft(force, size), np.fft.rfft(outputs, size)
    products = np.abs(np.fft.irfft(of_force * of_outputs.conj(), size)).max(axis=1)
    scale = np.linalg.norm(force) * np.linalg.norm(outputs, axis=1)
    return bool((products > WINDOW.follows * scale).any())
