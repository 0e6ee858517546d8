"""Harmonic excitation, which looks like a mode of next to no damping: mains hum, a machine that turns.

The response of a mode to random forces is normal: of its envelope |z| the mean of |z|⁴ is twice the square of that of
|z|². Of a sine it is once that square (Jacobsen, Andersen & Brincker, IOMAC 2007, by the kurtosis of the signal).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Complexes
from workbench.records.record import Record


@dataclass(frozen=True)
class HarmonicSettings:
    """Constants of the test for harmonic excitation."""

    # of the mean of |z|⁴ over the square of that of |z|²; of random motion over six times the decay time of a mode it
    # is below 1.42 in one of a thousand, of a sine with a tenth of its power in random motion about it 1.17
    steady: float = 1.3
    lines: int = 8  # to either side, at least, that the envelope is made of


HARMONICS = HarmonicSettings()


def steady_modes(records: Sequence[Record], poles: Complexes) -> list[int]:
    """The modes about whose frequencies the motion of every record has an envelope that stays the same, from 0.

    Args:
        records: motion that is driven all along.
        poles: (n_modes,) rad/s.
    """
    return [r for r, pole in enumerate(poles) if all(_is_steady(record, complex(pole)) for record in records)]


def _is_steady(record: Record, pole: complex) -> bool:
    """Whether the envelope stays the same in the output that holds most of what is about this frequency."""
    n, dt = record.n_samples, record.sample_time
    bin_width = 2.0 * np.pi / (n * dt)
    half = max(2.0 * abs(pole.real), HARMONICS.lines * bin_width)
    first, last = (round((pole.imag + side * half) / bin_width) for side in (-1.0, 1.0))
    if first < 1 or last > n // 2:
        return False
    about = record.outputs - record.outputs.mean(axis=1, keepdims=True)
    lines = np.fft.rfft(about)[:, first : last + 1]
    share = (np.abs(lines) ** 2).sum(axis=1) / np.maximum((about**2).sum(axis=1), 1e-300)
    power = np.abs(np.fft.ifft(lines[np.argmax(share)], 4 * lines.shape[1])) ** 2
    return bool((power**2).mean() < HARMONICS.steady * power.mean() ** 2)


def harmonic_remark(poles: Complexes, which: Sequence[int]) -> tuple[str, ...]:
    """A remark on the modes that may be harmonic excitation; none of none."""
    if not which:
        return ()
    modes = ", ".join(f"mode {r + 1} ({abs(poles[r]) / (2.0 * np.pi):.4g} Hz)" for r in which)
    return (
        f"harmonic excitation? the motion about {modes} has a constant amplitude, as mains hum and turning machines"
        " make it; then it is no mode, and its standard errors do not hold",
    )
