"""Poles that distortion of a stronger mode makes: at multiples of its frequency, and beside those of another mode."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Floats
from workbench.structure.printed import mode_text


@dataclass(frozen=True)
class OvertoneSettings:
    """Constants of the search for overtones."""

    highest: int = 9
    at_most: float = 0.03  # amplitude of an overtone, relative to its base
    within: float = 2e-3  # of a whole multiple of the base's frequency
    scatters: float = 2.0  # rms scatters of the base's frequency, a multiple, by which that of an overtone may be off
    sure: float = 3.0  # standard errors that either may be off by beyond that
    damping: float = 0.2  # of the decay rate: by how much that of an overtone may be off


OVERTONES = OvertoneSettings()


def multiple_of(frequencies: Floats, size: Floats, r: int) -> tuple[int | None, int]:
    """The far stronger mode at a whole multiple of whose frequency mode r lies, and which multiple; None and 0 of none.

    Args:
        frequencies: (n_modes,) in any unit.
        size: (n_modes,) amplitudes.
    """
    for base in np.argsort(-size):
        times = round(frequencies[r] / frequencies[base])
        near = abs(frequencies[r] / frequencies[base] - times) < OVERTONES.within * times
        if 2 <= times <= OVERTONES.highest and near and size[r] < OVERTONES.at_most * size[base]:
            return int(base), times
    return None, 0


def overtone_remarks(poles: np.ndarray, size: Floats, scatter: Floats, deviation: np.ndarray) -> tuple[str, ...]:
    """A remark on the modes whose poles a law of second or third degree makes of one that changes with amplitude.

    Products of free decays e^{λt} decay by the sum of their poles: 2λ, 3λ, and λ' ± λ, λ' ± 2λ beside another mode's.
    Only frequency and damping together tell: a mode of the structure seldom has both.

    Args:
        poles: (n_modes,) of positive frequencies, rad/s.
        size: (n_modes,) amplitudes.
        scatter: (n_modes,) rms by which the frequency of a mode changes, rad/s; 0 of one that does not.
        deviation: (n_modes,) standard errors of the poles' real and imaginary parts, as complex numbers.
    """
    found, of = [], set()
    for r in range(poles.size):
        makers = [base for base in np.flatnonzero(scatter) if size[r] < OVERTONES.at_most * size[base]]
        for base in sorted(makers, key=lambda k: -size[k]):
            sums = _sums(poles, size, int(base), r)
            how = next((w for w, made, n in sums if _meets(poles[r], made, n * scatter[base], deviation[r])), None)
            if how is not None:
                found.append(f"{mode_text(r, poles[r].imag / (2.0 * np.pi))} lies at {how}")
                of.add(int(base) + 1)
                break
    if not found:
        return ()
    return (
        f"{'; '.join(found)}, in frequency and in damping: distortion of mode {' and '.join(map(str, sorted(of)))},"
        " which changes, looks like this; it is a mode of the structure only if lower levels show it too",
    )


def _sums(poles: np.ndarray, size: Floats, base: int, r: int) -> Iterator[tuple[str, complex, int]]:
    """The poles that a base makes, alone or beside modes far stronger than r: in words, and how often it is in each."""
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


def _meets(pole: complex, made: complex, scatter: float, deviation: complex) -> bool:
    """Whether a pole is one that is made, in frequency and in decay."""
    off = OVERTONES.within * made.imag + OVERTONES.scatters * scatter + OVERTONES.sure * deviation.imag
    damped = OVERTONES.damping * abs(made.real) + OVERTONES.sure * deviation.real
    return abs(pole.imag - made.imag) < off and abs(pole.real - made.real) < damped
