"""Overtones: spurious poles due to distortion of a stronger mode, at multiples and combinations of frequencies."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Floats
from workbench.structure.printed import mode_text


@dataclass(frozen=True)
class OvertoneSettings:
    """Constants of the search for overtones."""

    highest: int = 9  # order of an overtone
    at_most: float = 0.03  # largest amplitude of an overtone, relative to its base
    within: float = 2e-3  # relative tolerance of its frequency
    scatters: float = 2.0  # further tolerance of its frequency, in rms scatters of the base's frequency times the order
    sure: float = 3.0  # further tolerance of frequency and decay rate, in standard errors
    damping: float = 0.2  # relative tolerance of its decay rate


OVERTONES = OvertoneSettings()


def multiple_of(frequencies: Floats, size: Floats, r: int) -> tuple[int | None, int]:
    """The far stronger base mode of which mode r may be an overtone, and the order of the overtone; None and 0 if none.

    Args:
        frequencies: (n_modes,) in any unit.
        size: (n_modes,) amplitudes.
        r: index of the mode.
    """
    for base in np.argsort(-size):
        times = round(frequencies[r] / frequencies[base])
        near = abs(frequencies[r] / frequencies[base] - times) < OVERTONES.within * times
        if 2 <= times <= OVERTONES.highest and near and size[r] < OVERTONES.at_most * size[base]:
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
        bases = [base for base in np.flatnonzero(scatter) if size[r] < OVERTONES.at_most * size[base]]
        for base in sorted(bases, key=lambda k: -size[k]):
            sums = _sums(poles, size, int(base), r)
            words = next((w for w, pole, n in sums if _agrees(poles[r], pole, n * scatter[base], deviation[r])), None)
            if words is not None:
                overtones.append(f"{mode_text(r, poles[r].imag / (2.0 * np.pi))} lies at {words}")
                base_modes.add(int(base) + 1)
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
    for other in np.flatnonzero(OVERTONES.at_most * size > size[r]):
        for times in (1, 2) if other != base else ():
            for sign in (1.0, -1.0):
                rate = times * own.real + poles[other].real
                of_base = f"{times} × mode {base + 1}" if times > 1 else f"mode {base + 1}"
                words = f"mode {other + 1} {'plus' if sign > 0 else 'less'} {of_base}"
                yield words, complex(rate, abs(poles[other].imag + sign * times * own.imag)), times


def _agrees(pole: complex, overtone: complex, scatter: float, deviation: complex) -> bool:
    """Whether a pole agrees with that of an overtone in frequency and in decay rate."""
    frequency = OVERTONES.within * overtone.imag + OVERTONES.scatters * scatter + OVERTONES.sure * deviation.imag
    decay = OVERTONES.damping * abs(overtone.real) + OVERTONES.sure * deviation.real
    return abs(pole.imag - overtone.imag) < frequency and abs(pole.real - overtone.real) < decay
