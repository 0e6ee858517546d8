"""Harmonic excitation, which looks like a mode of next to no damping: mains hum, a machine that turns.

The response of a mode to random forces is normal: of its envelope |z| the mean of |z|⁴ is twice the square of that of
|z|². Of a sine it is once that square (Jacobsen, Andersen & Brincker, IOMAC 2007, by the kurtosis of the signal).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Complexes, Floats
from workbench.records.record import Record
from workbench.structure.printed import mode_text


@dataclass(frozen=True)
class HarmonicSettings:
    """Constants of the test for harmonic excitation."""

    # of the mean of |z|⁴ over the square of that of |z|²; of random motion over six times the decay time of a mode it
    # is below 1.42 in one of a thousand, of a sine with a tenth of its power in random motion about it 1.17
    steady: float = 1.3
    lines: int = 8  # to either side, at least, that the envelope is made of
    chance: float = 1e-4  # that a line of random motion is taken for a sine
    peaked: float = 5.0  # power of a mode's peak over the median within four of its half bandwidths: 1 + 2²


HARMONICS = HarmonicSettings()


def harmonic_remarks(
    records: Sequence[Record], poles: Complexes, among: Sequence[int], lasting: Sequence[int] = ()
) -> tuple[str, ...]:
    """A remark on the modes about whose frequencies the motion of every record has an envelope that stays the same.

    Args:
        records: motion that is driven all along.
        poles: (n_modes,) rad/s.
        among: the modes that may be harmonic excitation, from 0.
        lasting: of these, those that are known to go on as they are.
    """
    steady = list(among)
    for record in records if steady else ():
        about = record.outputs - record.outputs.mean(axis=1, keepdims=True)
        lines, power = np.fft.rfft(about), np.maximum((about**2).sum(axis=1), 1e-300)
        bin_width = 2.0 * np.pi / (record.n_samples * record.sample_time)
        steady = [r for r in steady if r in lasting or _is_steady(lines, power, poles[r] / bin_width)]
    if not steady:
        return ()
    modes = ", ".join(mode_text(r, abs(poles[r]) / (2.0 * np.pi)) for r in steady)
    return (
        f"harmonic excitation? the motion about {modes} has a constant amplitude, or one line far above those beside"
        " it, as mains hum and turning machines make it; then it is no mode, and its standard errors do not hold",
    )


def _is_steady(lines: Complexes, power: Floats, pole: complex) -> bool:
    """Whether the envelope stays the same in the output that holds most of what is about a pole, in lines.

    Or, in any output, one line stands out of a broad peak: power of random motion is exponential, its median ln 2 of
    its mean.

    Args:
        lines: (n_outputs, n_lines) of the transform.
        power: (n_outputs,) sum of squares.
    """
    half = max(2.0 * abs(pole.real), HARMONICS.lines)
    first, last = (round(pole.imag + side * half) for side in (-1.0, 1.0))
    if first < 1 or last >= lines.shape[1]:
        return False
    inside = lines[:, first : last + 1]
    strongest = inside[np.argmax((np.abs(inside) ** 2).sum(axis=1) / power)]
    each = np.abs(inside) ** 2
    highest = HARMONICS.peaked * np.log(each.size / HARMONICS.chance) / np.log(2.0)
    if abs(pole.real) >= HARMONICS.lines and (each.max(axis=1) > highest * np.median(each, axis=1)).any():
        return True
    envelope = np.abs(np.fft.ifft(strongest, 4 * strongest.size)) ** 2
    return bool((envelope**2).mean() < HARMONICS.steady * envelope.mean() ** 2)
