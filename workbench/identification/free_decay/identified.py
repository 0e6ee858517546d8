"""What the decision of how many modes a record holds comes to, and the rules it keeps to."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from workbench.identification.free_decay.refinement import Refined
from workbench.records.record import Record
from workbench.structure.modes import SampledModes, mac

# Chance that a record of nothing but noise yields a mode.
FALSE_ALARM = 1e-3
MOST_DAMPED = 0.3
SAME_SHAPE = 0.95
# Chance that shapes of three signals agree so far, (1 - MAC)^(n_signals - 1); fewer must agree better to say as much.
BY_CHANCE = (1.0 - SAME_SHAPE) ** 2


@dataclass(frozen=True, eq=False)
class Identified:
    """The modes of a record, and what was taken for noise.

    Attributes:
        refined: the modes, with covariance.
        evidence: (n_modes,) χ² of each mode's amplitudes in the noise, 2 degrees of freedom a signal.
        limit: what the strongest mode fitted to white noise alone exceeds with the chance `false_alarm`.
        noise_modes: tried and refused, each with an evidence below the limit or no underdamped decay.
        noise_evidence: (n_noise,) theirs.
    """

    refined: Refined
    evidence: np.ndarray
    limit: float
    noise_modes: SampledModes = field(repr=False)
    noise_evidence: np.ndarray = field(repr=False)

    @property
    def modes(self) -> SampledModes:
        return self.refined.modes


def no_modes(
    poles: np.ndarray,
    shapes: np.ndarray,
    strength: np.ndarray,
    bin_width: float,
    two: Callable[[int, int], bool] | None = None,
) -> np.ndarray:
    """Which poles are damped beyond what rings, or split a stronger mode that has their shape and their band.

    Args:
        poles: (n_modes,).
        shapes: (n_signals, n_modes) amplitudes over the noise, complex.
        strength: (n_modes,) of two alike the weaker splits the other.
        bin_width: rad/s that the length of the record can tell apart.
        two: whether modes r and s, which one signal sees alike, are two all the same.
    """
    band = np.abs(poles.real)[:, None] + np.abs(poles.real) + bin_width
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < band
    damped = -poles.real > MOST_DAMPED * np.abs(poles)
    # One damped beyond what rings has every band; it is split itself.
    # One signal has no shape, and a mode that shifts as it decays looks like two there.
    others = len(shapes) - 1
    alike = max(SAME_SHAPE, 1.0 - BY_CHANCE ** (1.0 / others)) if others else SAME_SHAPE
    split = near & (mac(shapes, shapes) > alike) & (strength[:, None] < strength) & ~damped
    if two is not None and others == 0:
        for r, s in np.argwhere(split):
            split[r, s] = not two(r, s)
    return split.any(axis=1) | damped


def unshaped(poles: np.ndarray, record: Record) -> SampledModes:
    """Modes of which only the poles are known, by rising frequency: a start for `refine`."""
    omega = np.abs(poles)
    order = np.argsort(omega)
    shapes = np.ones((record.n_outputs, poles.size))
    return SampledModes(omega[order], (-poles.real / omega)[order], shapes, record.positions)
