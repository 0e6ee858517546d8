"""Detection of harmonic excitation, such as mains hum or rotating machines, which looks like a mode of hardly any
damping.

The response of a mode to random forces is normally distributed: the mean of |z|⁴ of its envelope |z| is twice the
square of the mean of |z|². For a sine both are equal (Jacobsen, Andersen & Brincker, IOMAC 2007, by the kurtosis of
the signal).
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

    # Largest ratio of the mean of |z|⁴ to the square of the mean of |z|² for a sine. In random motion over six decay
    # times of a mode one in a thousand is below 1.42; a sine with a tenth of its power in random motion has 1.17.
    steady: float = 1.3
    lines: int = 8  # least number of lines on either side that form the envelope
    false_alarm: float = 1e-4  # probability that a line of random motion is taken for a sine
    peaked: float = 5.0  # power at the peak of a mode over its median within two bandwidths: 1 + 2²


HARMONICS = HarmonicSettings()


def harmonic_remarks(
    records: Sequence[Record], poles: Complexes, among: Sequence[int], lasting: Sequence[int] = ()
) -> tuple[str, ...]:
    """A remark on the modes at whose frequencies the motion of every record has a constant envelope.

    Args:
        records: motion under forces that act throughout.
        poles: (n_modes,) rad/s.
        among: the modes that may be harmonic excitation, from 0.
        lasting: those of them that are known to have a constant amplitude.
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
    """Whether the motion about a pole is harmonic.

    Either the envelope is constant in the output of the largest share of power there, or one line of any output stands
    out of a broad peak: the power of random motion has an exponential distribution, whose median is ln 2 of its mean.

    Args:
        lines: (n_outputs, n_lines) Fourier transform of the outputs.
        power: (n_outputs,) sum of squares of the outputs.
        pole: in units of the line spacing.
    """
    half = max(2.0 * abs(pole.real), HARMONICS.lines)
    first, last = (round(pole.imag + side * half) for side in (-1.0, 1.0))
    if first < 1 or last >= lines.shape[1]:
        return False
    inside = lines[:, first : last + 1]
    strongest = inside[np.argmax((np.abs(inside) ** 2).sum(axis=1) / power)]
    line_power = np.abs(inside) ** 2
    ratio = HARMONICS.peaked * np.log(line_power.size / HARMONICS.false_alarm) / np.log(2.0)
    if abs(pole.real) >= HARMONICS.lines and (line_power.max(axis=1) > ratio * np.median(line_power, axis=1)).any():
        return True
    envelope = np.abs(np.fft.ifft(strongest, 4 * strongest.size)) ** 2
    return bool((envelope**2).mean() < HARMONICS.steady * envelope.mean() ** 2)
