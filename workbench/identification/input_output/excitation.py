"""What inputs excite: whether they can tell modes at all, and which modes they hardly move."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Complexes
from workbench.records.record import Record
from workbench.structure.printed import mode_text


@dataclass(frozen=True)
class ExcitationSettings:
    """Constants of the look at the spectrum of the inputs."""

    hardly: float = 1e-3  # of the mean power of a line, 3 % of its amplitude: less hardly moves a mode
    about: float = 0.02  # of the frequency of a mode, to either side, in which the lines count
    lines: int = 4  # to either side, at least


EXCITATION = ExcitationSettings()


def check_inputs(records: Sequence[Record]) -> None:
    """Refuse records without inputs, of different ones, and inputs that never move or move alike.

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
    size = np.linalg.norm(inputs, axis=1)
    if (size == 0).any():
        name = first.input_names[int(np.argmin(size))]
        raise ValueError(f"record {first.name!r}: input {name!r} is zero throughout; leave it out, or excite there")
    alike = (inputs / size[:, None]) @ (inputs / size[:, None]).T - np.eye(len(size))
    i, k = np.unravel_index(int(np.argmax(np.abs(alike))), alike.shape)
    if abs(alike[i, k]) > 1.0 - 1e-9:
        raise ValueError(
            f"inputs {first.input_names[i]!r} and {first.input_names[k]!r} are the same signal but for its size, so"
            " what each does cannot be distinguished; excite them one after the other, or by signals of their own"
        )


def unexcited_remarks(records: Sequence[Record], poles: Complexes) -> tuple[str, ...]:
    """A remark on modes where the inputs of no record have power, as beyond an anti-aliasing filter.

    What the course of the inputs between samples is taken for shows most there.

    Args:
        records: driven; those that begin in motion hold modes that no input excites, too.
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
