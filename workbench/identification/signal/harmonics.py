"""Harmonics that look like modes: of the excitation, and of a stronger mode whose response is distorted.

Harmonic excitation, such as mains hum or rotating machines, looks like a mode of hardly any damping. The response of a
mode to random forces is normally distributed: the mean of |z|⁴ of its envelope |z| is twice the square of the mean of
|z|². For a sine both are equal (Jacobsen, Andersen & Brincker, IOMAC 2007, by the kurtosis of the signal).

Overtones are spurious poles due to distortion, at multiples of the frequency of a stronger mode and at its combinations
with those of others.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Complexes, Floats
from workbench.identification.signal.modal_estimates import SURE
from workbench.records.record import Record
from workbench.structure.printed import mode_text


@dataclass(frozen=True)
class HarmonicSettings:
    """Constants of the tests for harmonic excitation and for overtones."""

    # Ratio of the mean of |z|⁴ to the square of the mean of |z|² for a sine. In random motion over six decay times of a
    # mode one in a thousand is below 1.42; a sine with a tenth of its power in random motion has 1.17.
    max_kurtosis: float = 1.3
    min_lines: int = 8  # on either side, that form the envelope
    false_alarm: float = 1e-4  # probability that a line of random motion is taken for a sine
    mode_peak_ratio: float = 5.0  # power at the peak of a mode over its median within two bandwidths: 1 + 2²
    max_overtone_order: int = 9
    max_amplitude: float = 0.03  # of an overtone, relative to its base
    frequency_tolerance: float = 2e-3  # relative
    # further tolerance of the frequency, in rms scatters of the base's frequency times the order
    scatter_tolerance: float = 2.0
    decay_tolerance: float = 0.2  # relative, of the decay rate


HARMONICS = HarmonicSettings()
MAINS_HZ = (50.0, 60.0)


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
        " it, as mains hum and turning machines make it; then it is no mode, and its standard errors are invalid",
    )


def _is_steady(lines: Complexes, power: Floats, pole: complex) -> bool:
    """Whether the motion about a pole, in units of the line spacing, is harmonic.

    Either the envelope is constant in the output of the largest share of power there, or one line of any output stands
    out of a broad peak: the power of random motion has an exponential distribution, whose median is ln 2 of its mean.

    Args:
        lines: (n_outputs, n_lines) Fourier transform of the outputs.
        power: (n_outputs,) sum of squares of the outputs.
    """
    half = max(2.0 * abs(pole.real), HARMONICS.min_lines)
    first, last = (round(pole.imag + side * half) for side in (-1.0, 1.0))
    if first < 1 or last >= lines.shape[1]:
        return False
    inside = lines[:, first : last + 1]
    strongest = inside[np.argmax((np.abs(inside) ** 2).sum(axis=1) / power)]
    line_power = np.abs(inside) ** 2
    ratio = HARMONICS.mode_peak_ratio * np.log(line_power.size / HARMONICS.false_alarm) / np.log(2.0)
    if abs(pole.real) >= HARMONICS.min_lines and (line_power.max(axis=1) > ratio * np.median(line_power, axis=1)).any():
        return True
    envelope = np.abs(np.fft.ifft(strongest, 4 * strongest.size)) ** 2
    return bool((envelope**2).mean() < HARMONICS.max_kurtosis * envelope.mean() ** 2)


def near_mains(frequency_hz: float) -> bool:
    """Whether a frequency is within a hundredth of the mains' of a multiple of it, 50 or 60 Hz."""
    each = ((mains, round(frequency_hz / mains)) for mains in MAINS_HZ)
    return any(times and abs(frequency_hz - times * mains) <= 0.01 * mains for mains, times in each)


def multiple_of(frequencies: Floats, size: Floats, r: int) -> tuple[int | None, int]:
    """The far stronger base mode of which mode r may be an overtone, and the order of the overtone; None and 0 if none.

    From frequencies (n_modes,) in any unit and amplitudes (n_modes,).
    """
    for base in np.argsort(-size):
        times = round(frequencies[r] / frequencies[base])
        near = abs(frequencies[r] / frequencies[base] - times) < HARMONICS.frequency_tolerance * times
        if 2 <= times <= HARMONICS.max_overtone_order and near and size[r] < HARMONICS.max_amplitude * size[base]:
            return int(base), times
    return None, 0


def overtone_remarks(poles: np.ndarray, size: Floats, scatter: Floats, deviation: np.ndarray) -> tuple[str, ...]:
    """A remark on modes that may be quadratic or cubic distortion of a mode whose frequency depends on amplitude.

    A product of free decays e^{λt} has the sum of their poles: 2λ, 3λ, and with the pole λ' of another mode λ' ± λ and
    λ' ± 2λ. A mode must agree in frequency and in damping: a mode of the structure seldom agrees in both.

    Args:
        poles: (n_modes,) of positive frequencies, rad/s.
        size: (n_modes,) amplitudes.
        scatter: (n_modes,) rms variation of the frequency of each mode, rad/s; 0 where it is constant.
        deviation: (n_modes,) standard errors of the poles' real and imaginary parts, as complex numbers.
    """
    overtones, base_modes = [], set()
    for r in range(poles.size):
        bases = [base for base in np.flatnonzero(scatter).tolist() if size[r] < HARMONICS.max_amplitude * size[base]]
        for base in sorted(bases, key=lambda k: -size[k]):
            sums = _sums(poles, size, base, r)
            words = next((w for w, pole, n in sums if _agrees(poles[r], pole, n * scatter[base], deviation[r])), None)
            if words is not None:
                overtones.append(f"{mode_text(r, poles[r].imag / (2.0 * np.pi))} lies at {words}")
                base_modes.add(base + 1)
                break
    if not overtones:
        return ()
    return (
        f"{'; '.join(overtones)}, in frequency and in damping: distortion of mode"
        f" {' and '.join(map(str, sorted(base_modes)))}, which changes, looks like this; it is a mode of the structure"
        " only if lower levels show it too",
    )


def _sums(poles: np.ndarray, size: Floats, base: int, r: int) -> Iterator[tuple[str, complex, int]]:
    """Poles of the distortion of a base mode, alone and with modes far stronger than r.

    Yields:
        description, pole, and the multiple of the base in it.
    """
    own = complex(poles[base])
    for times in (2, 3):
        yield f"{times} × mode {base + 1}", times * own, times
    for other in np.setdiff1d(np.flatnonzero(HARMONICS.max_amplitude * size > size[r]), base):
        for times, of_base in ((1, f"mode {base + 1}"), (2, f"2 × mode {base + 1}")):
            for sign, word in ((1.0, "plus"), (-1.0, "less")):
                frequency = abs(poles[other].imag + sign * times * own.imag)
                rate = times * own.real + poles[other].real
                yield f"mode {other + 1} {word} {of_base}", complex(rate, frequency), times


def _agrees(pole: complex, overtone: complex, scatter: float, deviation: complex) -> bool:
    """Whether a pole agrees with that of an overtone in frequency and in decay rate."""
    frequency = HARMONICS.frequency_tolerance * overtone.imag + HARMONICS.scatter_tolerance * scatter
    frequency += SURE * deviation.imag
    decay = HARMONICS.decay_tolerance * abs(overtone.real) + SURE * deviation.real
    return abs(pole.imag - overtone.imag) < frequency and abs(pole.real - overtone.real) < decay
