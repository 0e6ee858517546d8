"""Checks of the inputs: whether they can distinguish modes, how long they act, and which modes they hardly excite."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Complexes
from workbench.records.record import Record
from workbench.structure.printed import mode_text


@dataclass(frozen=True)
class ExcitationSettings:
    """Constants of the check of the input spectra."""

    hardly: float = 1e-3  # of the mean power of a line, 3 % of its amplitude: less hardly excites a mode
    about: float = 0.02  # of the frequency of a mode, to either side, in which the lines count
    lines: int = 4  # to either side, at least
    moves: float = 0.01  # of its peak, above which an input is nonzero


EXCITATION = ExcitationSettings()


def check_inputs(records: Sequence[Record]) -> None:
    """Refuse records without inputs or of different inputs, and inputs that are zero or proportional to each other.

    Raises:
        ValueError: naming the input.
    """
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
    return int((sizes > EXCITATION.moves * sizes.max(axis=1, keepdims=True)).sum(axis=1).min())


def unexcited_remarks(records: Sequence[Record], poles: Complexes) -> tuple[str, ...]:
    """A remark on modes at whose frequency the inputs of no record have power, as beyond an anti-aliasing filter.

    There the assumed course of the inputs between samples matters most.

    Args:
        records: driven; those not from rest hold modes that no input excites, too.
        poles: (n_modes,) rad/s.
    """
    amplitude = np.zeros(poles.size)
    for record in records:
        power = (np.abs(np.fft.rfft(record.inputs * np.hanning(record.n_samples))) ** 2).sum(axis=0)
        mean, bin_width = power.mean(), 2.0 * np.pi / (record.n_samples * record.sample_time)
        for r, pole in enumerate(poles):
            half = max(2.0 * abs(pole.real), EXCITATION.about * pole.imag, EXCITATION.lines * bin_width)
            first = max(int((pole.imag - half) / bin_width), 0)
            about = power[first : int((pole.imag + half) / bin_width) + 2]
            amplitude[r] = max(amplitude[r], np.sqrt(about.mean() / mean)) if about.size else amplitude[r]
    words = [
        mode_text(r, abs(poles[r]) / (2.0 * np.pi), f", {100 * amplitude[r]:.1g} % of their mean amplitude")
        for r in np.flatnonzero(amplitude**2 < EXCITATION.hardly).tolist()
    ]
    if not words:
        return ()
    return (f"the inputs hardly excite {', '.join(words)}: this may be no mode; excite there, or leave it out",)
