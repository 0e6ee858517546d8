"""The excitation of records: whether inputs can distinguish modes, the force window of impact tests, rest before it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import median_abs_deviation

from workbench.arrays import Complexes, Flags, Floats
from workbench.records.record import Record
from workbench.structure.printed import mode_text


@dataclass(frozen=True)
class ExcitationSettings:
    """Constants of the checks of the inputs and of the detection of impacts and of rest."""

    min_power_ratio: float = 1e-3  # of the mean power of a line, 3 % of its amplitude: less hardly excites a mode
    band_margin: float = 0.02  # of the frequency of a mode, to either side, in which the lines count
    min_lines: int = 4  # to either side, at least
    nonzero_share: float = 0.01  # of its peak, above which an input is nonzero
    # standard deviations of the reading between impacts: normal noise exceeds them once in 5e8
    noise_deviations: float = 6.0
    peak_ratio: float = 30.0  # likewise, that the peak of an impact exceeds
    impact_share: float = 0.1  # of a record that impacts take; another excitation takes more
    # correlation, at any lag, of the reading between impacts with an output, above which it is a force: that of an
    # attached shaker. That of noise is at most 4.5 over the root of the number of samples
    max_correlation: float = 0.3
    min_rest_samples: int = 500  # samples before the first force, as before the trigger of an impact test
    # standard errors of the variance of white noise, by which that of the outputs there may exceed the least of all
    # parts as long after it, which of fifty parts is two below the mean
    variance_deviations: float = 4.0


EXCITATION = ExcitationSettings()


def check_inputs(records: Sequence[Record]) -> None:
    """Refuse records without inputs or of different inputs, and inputs that are zero or proportional to each other."""
    first = records[0]
    if first.n_inputs == 0:
        raise ValueError(f"record {first.name!r} has no inputs; use `identify` for a free decay")
    for record in records[1:]:
        if record.input_names != first.input_names:
            raise ValueError(
                f"records identified together must have the same inputs; {first.name!r} has"
                f" {', '.join(first.input_names)} and {record.name!r} has {', '.join(record.input_names)}"
            )
    inputs = np.hstack([record.inputs for record in records])
    norms = np.linalg.norm(inputs, axis=1)
    if (norms == 0).any():
        name = first.input_names[int(np.argmin(norms))]
        raise ValueError(f"record {first.name!r}: input {name!r} is zero throughout; leave it out, or excite there")
    correlation = (inputs / norms[:, None]) @ (inputs / norms[:, None]).T - np.eye(len(norms))
    i, k = np.unravel_index(int(np.argmax(np.abs(correlation))), correlation.shape)
    if abs(correlation[i, k]) > 1.0 - 1e-9:
        raise ValueError(
            f"inputs {first.input_names[i]!r} and {first.input_names[k]!r} are the same signal up to a factor, so"
            " their effects cannot be distinguished; excite them one after the other, or by signals of their own"
        )


def n_moving(records: Sequence[Record]) -> int:
    """Number of samples at which an input is nonzero, the least of all inputs."""
    sizes = np.abs(np.hstack([record.inputs for record in records]))
    return int((sizes > EXCITATION.nonzero_share * sizes.max(axis=1, keepdims=True)).sum(axis=1).min())


def unexcited_remarks(records: Sequence[Record], poles: Complexes) -> tuple[str, ...]:
    """A remark on modes at whose frequency the inputs of no record have power, as beyond an anti-aliasing filter.

    There the assumed course of the inputs between samples matters most. Records not from rest hold modes that no input
    excites, too.
    """
    amplitude = np.zeros(poles.size)
    for record in records:
        power = (np.abs(np.fft.rfft(record.inputs * np.hanning(record.n_samples))) ** 2).sum(axis=0)
        mean, bin_width = power.mean(), 2.0 * np.pi / (record.n_samples * record.sample_time)
        for r, pole in enumerate(poles):
            half = max(2.0 * abs(pole.real), EXCITATION.band_margin * pole.imag, EXCITATION.min_lines * bin_width)
            first = max(int((pole.imag - half) / bin_width), 0)
            about = power[first : int((pole.imag + half) / bin_width) + 2]
            amplitude[r] = max(amplitude[r], np.sqrt(about.mean() / mean)) if about.size else amplitude[r]
    words = [
        mode_text(r, abs(poles[r]) / (2.0 * np.pi), f", {100 * amplitude[r]:.1g} % of their mean amplitude")
        for r in np.flatnonzero(amplitude**2 < EXCITATION.min_power_ratio).tolist()
    ]
    if not words:
        return ()
    return (f"the inputs hardly excite {', '.join(words)}: this may be no mode; excite there, or leave it out",)


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
    loud = np.abs(force) > EXCITATION.noise_deviations * noise
    in_impact = np.zeros(force.size, bool)
    if noise == 0.0 or np.abs(force).max() < EXCITATION.peak_ratio * noise or loud.mean() > EXCITATION.impact_share:
        return in_impact
    ends = np.flatnonzero(np.diff(np.r_[False, loud, False]))
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
    return bool((correlations > EXCITATION.max_correlation * scale).any())


def begin_at_rest(records: Sequence[Record]) -> bool:
    """Whether no record has an initial motion: one that ended before the first force, too, would be loud before it."""
    return all(map(_begins_at_rest, records))


def _begins_at_rest(record: Record) -> bool:
    n = int(np.argmax(record.inputs.any(axis=0)))  # samples before the first force
    if n < EXCITATION.min_rest_samples or record.n_samples < 2 * n:
        return False
    parts = record.outputs[:, : record.n_samples // n * n].reshape(record.n_outputs, -1, n)
    first, *others = parts.var(axis=2).T
    return bool((first <= (1.0 + EXCITATION.variance_deviations * np.sqrt(2.0 / n)) * np.min(others, axis=0)).all())
