"""The force window of impact tests: between impacts there is no force, and the force channel reads noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import median_abs_deviation

from workbench.arrays import Flags, Floats
from workbench.records.record import Record


@dataclass(frozen=True)
class WindowSettings:
    """Constants of the detection of impacts in an input."""

    loud: float = 6.0  # standard deviations of the reading between impacts: normal noise exceeds them once in 5e8
    clear: float = 30.0  # likewise, that the peak of an impact exceeds
    most: float = 0.1  # share of a record that impacts take; another excitation takes more
    # correlation, at any lag, of the reading between impacts with an output, above which it is a force: that of an
    # attached shaker. That of noise is at most 4.5 over the root of the number of samples
    follows: float = 0.3


WINDOW = WindowSettings()


def force_window(records: Sequence[Record]) -> tuple[tuple[Record, ...], tuple[str, ...]]:
    """The records with each impact input set to zero between impacts, and a remark on each such input.

    Noise of a force channel is read as a force throughout the record, to which the structure does not respond: it makes
    false peaks at each mode, as narrow as the mode (Trethewey & Cafeo, Int. J. Analytical and Experimental Modal
    Analysis 7 (1992)).
    """
    windowed: list[Record] = []
    removed: dict[str, list[float]] = {}
    for record in records:
        inputs = record.inputs.copy()
        for row, name in zip(inputs, record.input_names, strict=True):
            offset = np.median(row)
            noise = float(median_abs_deviation(row, scale="normal"))
            impacts = _in_impacts(row - offset, noise)
            between = np.where(impacts, 0.0, row - offset)
            if impacts.any() and between.any() and not _correlates(between, np.where(impacts, 0.0, record.outputs)):
                row[:] = np.where(impacts, row - offset, 0.0)
                removed.setdefault(name, []).append(noise)
        unchanged = np.array_equal(inputs, record.inputs)
        windowed.append(record if unchanged else replace(record, inputs=inputs))
    remarks = tuple(
        f"input {name}: force window, zero between impacts, where it reads"
        f" {np.sqrt(np.mean(np.square(noise))):.2g} rms of noise"
        for name, noise in removed.items()
    )
    return tuple(windowed), remarks


def _in_impacts(force: Floats, noise: float) -> Flags:
    """Samples (n_samples,) within an impact, or its length before or after it; none where it is no impact test."""
    loud = np.abs(force) > WINDOW.loud * noise
    in_impact = np.zeros(force.size, bool)
    if noise == 0.0 or np.abs(force).max() < WINDOW.clear * noise or loud.mean() > WINDOW.most:
        return in_impact
    ends = np.flatnonzero(np.diff(np.concatenate([[False], loud, [False]])))
    for begin, end in zip(ends[::2], ends[1::2], strict=True):
        length = end - begin
        in_impact[max(begin - length, 0) : end + length] = True
    return in_impact


def _correlates(force: Floats, outputs: Floats) -> bool:
    """Whether a force (n_samples,) correlates with outputs (n_outputs, n_samples), at any lag."""
    size = 2 * force.size
    force_spectrum, output_spectra = np.fft.rfft(force, size), np.fft.rfft(outputs, size)
    correlations = np.abs(np.fft.irfft(force_spectrum * output_spectra.conj(), size)).max(axis=1)
    scale = np.linalg.norm(force) * np.linalg.norm(outputs, axis=1)
    return bool((correlations > WINDOW.follows * scale).any())
