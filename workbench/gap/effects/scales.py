"""The sizes that a rig has of itself: bounds and starts of effects are relative to them, whatever the units."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from workbench.rig.rig import Rig
from workbench.structure.domain import NamedPoints
from workbench.structure.member import Structure
from workbench.structure.modes import Modes


@dataclass(frozen=True)
class Scales:
    """Length (m), mass (kg) and time (s) of a rig: its extent, its mass, and 1 / ω of its lowest elastic mode.

    Points whose positions are not known have an extent of 1; modes that are all rigid have the time of their damping.
    """

    length: float
    mass: float
    time: float

    @classmethod
    def of(cls, rig: Rig) -> "Scales":
        return _scales(rig.modes, rig.structure)

    @property
    def stiffness(self) -> float:
        """N/m."""
        return self.mass / self.time**2

    @property
    def damping(self) -> float:
        """N s/m."""
        return self.mass / self.time

    @property
    def speed(self) -> float:
        """m/s."""
        return self.length / self.time

    @property
    def force(self) -> float:
        """N."""
        return self.stiffness * self.length


@lru_cache(maxsize=64)
def _scales(modes: Modes, structure: object) -> Scales:
    elastic = modes.omega[modes.omega > 0]
    rate = float(elastic.min()) if elastic.size else float(np.diag(modes.damping).max())
    domain = modes.domain
    placed = not isinstance(domain, NamedPoints) or domain.positions is not None
    return Scales((domain.size if placed else 0.0) or 1.0, _mass(modes, structure), 1.0 / (rate or 1.0))


def _mass(modes: Modes, structure: object) -> float:
    if isinstance(structure, Structure):
        x = (np.arange(50) + 0.5) / 50 * structure.length
        return float(np.mean(structure.mass_per_length(x)) * structure.length)
    elastic = int(np.argmax(modes.omega > 0))
    return 1.0 / float(np.mean(modes.phi(modes.domain.grid(12))[:, elastic] ** 2))
