"""Frequency response functions of records driven by several inputs at once, and their multiple coherence."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import rfft
from scipy.signal import get_window

from workbench.arrays import Flags, Floats
from workbench.records.frequency_responses import FrequencyResponses
from workbench.records.record import Record
from workbench.structure.printed import joined_in_words


@dataclass(frozen=True)
class SpectraSettings:
    """Constants of averaged spectra of several inputs."""

    max_segment_samples: int = 4096
    segments_per_input: int = 4  # without overlap: S_uu of fewer averages than inputs has no inverse
    min_segment_samples: int = 16
    batch_size: int = 64  # segments at once
    # of an input with the others, above which it varies H more than 20-fold, 1 / (1 - γ²)
    max_input_coherence: float = 0.95
    silent_power_ratio: float = 1e-12  # of an input to its largest, below which a line is not excited
    # of an input to its largest, above which a line tells whether inputs are alike
    excited_power_ratio: float = 1e-4
    min_output_coherence: float = 0.5  # of any output at a line that the inputs excite less


SPECTRA = SpectraSettings()


@dataclass(frozen=True, eq=False)
class FrfEstimate:
    """H1 of several inputs with its coherence."""

    frf: FrequencyResponses  # NaN where an input is silent, or like the others, or weak and no output is coherent
    coherence: Floats  # (n_outputs, n_lines) multiple coherence of each output with all inputs, in [0, 1], NaN as above
    averages: int  # number of segments, which overlap by half
    units: tuple[str, ...]  # one per input
    silent: tuple[str, ...]  # names of inputs that are constant throughout, and left out


def frequency_responses(records: Sequence[Record]) -> FrfEstimate:
    """H = S_yu S_uu⁻¹ of all inputs at once, by spectra averaged over Hann windows, and the multiple coherence.

    γ²_j = S_yu S_uu⁻¹ S_uy / S_yy of output j: the share of its power that is linear in the inputs.

    Args:
        records: of the same inputs and outputs at one sample rate; averages are over all.

    Raises:
        ValueError: no input that varies, records too short, or inputs that cannot be distinguished: the two that are
            most alike are named, with their coherence.

    Source: Bendat and Piersol, Random Data, 4th ed., sections 7.3 and 7.4.
    """
    first = records[0]
    active = [i for i in range(first.n_inputs) if any(np.ptp(record.inputs[i]) > 0 for record in records)]
    if not active:
        raise ValueError("every input is constant")
    names = tuple(first.input_names[i] for i in active)
    n, samples = len(active), [record.n_samples for record in records]
    segment = min(SPECTRA.max_segment_samples, sum(samples) // (SPECTRA.segments_per_input * n), min(samples))
    if segment < SPECTRA.min_segment_samples:
        least = SPECTRA.segments_per_input * SPECTRA.min_segment_samples * n
        raise ValueError(f"{sum(samples)} samples are too few to average spectra of {n} inputs: {least} are needed")
    spectra, averages = _averaged(records, active, segment)
    lines = np.fft.rfftfreq(segment, first.sample_time)[1:]
    of_inputs, across = spectra[:n, :n].transpose(2, 0, 1), spectra[n:, :n].transpose(2, 0, 1)
    powers = of_inputs.diagonal(axis1=1, axis2=2).real  # (n_lines, n_inputs)
    nonzero = (powers > SPECTRA.silent_power_ratio * powers.max(axis=0)).all(axis=1)
    scales = np.sqrt(np.where(powers > 0.0, powers, 1.0))
    alike = of_inputs / (scales[:, :, None] * scales[:, None])
    inverse = np.linalg.inv(np.where(nonzero[:, None, None], alike, 0.0) + 1e-12 * np.eye(n))
    with_others: Floats = np.asarray(1.0 - 1.0 / inverse.diagonal(axis1=1, axis2=2).real, np.float64)
    distinct = nonzero & (with_others < SPECTRA.max_input_coherence).all(axis=1)
    excited = nonzero & (powers > SPECTRA.excited_power_ratio * powers.max(axis=0)).all(axis=1)
    _check_apart(names, alike, with_others, excited)
    scaled = (across / scales[:, None]) @ inverse
    outputs = spectra[n:, n:].diagonal().real  # (n_lines, n_outputs)
    explained = np.einsum("fji,fji->fj", scaled, (across / scales[:, None]).conj()).real
    coherence = np.divide(explained, outputs, out=np.full_like(explained, np.nan), where=outputs > 0.0)
    distinct &= excited | (coherence > SPECTRA.min_output_coherence).any(axis=1)
    values = np.where(distinct[:, None, None], scaled / scales[:, None], np.nan)
    found = FrequencyResponses(values.transpose(1, 2, 0), lines, first.output_channels, names, name=first.name)
    coherence = np.where(distinct[:, None], np.clip(coherence, 0.0, 1.0), np.nan).T
    silent = tuple(name for i, name in enumerate(first.input_names) if i not in active)
    units = tuple(first.input_channels[i].unit for i in active)
    return FrfEstimate(found, coherence, averages, units, silent)


def _averaged(records: Sequence[Record], active: Sequence[int], segment: int) -> tuple[np.ndarray, int]:
    """Cross spectra (n_signals, n_signals, n_lines) of inputs, then outputs, without 0 Hz; number of segments."""
    n_signals, step = len(active) + records[0].n_outputs, segment - segment // 2
    window = get_window("hann", segment)
    total, count = np.zeros((n_signals, n_signals, segment // 2), complex), 0
    for record in records:
        signals = np.vstack([record.inputs[active], record.outputs])
        parts = np.lib.stride_tricks.sliding_window_view(signals, segment, axis=1)[:, ::step]
        for at in range(0, parts.shape[1], SPECTRA.batch_size):
            some = parts[:, at : at + SPECTRA.batch_size]
            each = rfft((some - some.mean(axis=2, keepdims=True)) * window)[..., 1:]
            total += np.einsum("ikf,jkf->ijf", each, each.conj(), optimize=True)
            count += each.shape[1]
    return total / count, count


def _check_apart(names: Sequence[str], alike: np.ndarray, with_others: Floats, excited: Flags) -> None:
    """Raise where, at half of the lines that all inputs excite, an input follows from the others."""
    if not excited.any():
        raise ValueError(f"no frequency is excited by all of the inputs {joined_in_words(names)}")
    if np.median(with_others[excited].max(axis=1)) < SPECTRA.max_input_coherence:
        return
    pairs = np.median(np.abs(alike[excited]) ** 2, axis=0)
    i, j = divmod(int(np.argmax(pairs - 2.0 * np.eye(len(names)))), len(names))
    if pairs[i, j] >= SPECTRA.max_input_coherence:
        raise ValueError(
            f"the inputs {names[i]} and {names[j]} are correlated, with a coherence of {pairs[i, j]:.3f} between them;"
            " independent inputs are needed to distinguish the responses"
        )
    worst = int(np.argmax(np.median(with_others[excited], axis=0)))
    raise ValueError(
        f"the input {names[worst]} follows from the others, with a multiple coherence of"
        f" {np.median(with_others[excited, worst]):.3f}; most alike are {names[i]} and {names[j]}, with a coherence of"
        f" {pairs[i, j]:.3f}; independent inputs are needed to distinguish the responses"
    )


def loudest(record: Record, most: int) -> tuple[str, ...]:
    """The names of the outputs of highest level, in falling order: rms over the largest of their quantity."""
    rms = record.outputs.std(axis=1)
    kinds = [channel.quantity for channel in record.output_channels]
    largest = {kind: max(level for level, other in zip(rms, kinds) if other == kind) or 1.0 for kind in kinds}
    order = np.argsort([-level / largest[kind] for level, kind in zip(rms, kinds)], kind="stable")
    return tuple(record.output_names[j] for j in order[:most])
