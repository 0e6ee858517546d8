"""Damping of a structure: the modal coefficients c_rs of (2.10)-(2.11)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from workbench.renamed import former_fields
from workbench.structure.profile import ProfileLike


@dataclass(frozen=True, eq=False)
class ModalDamping:
    """One damping ratio for every mode, or one per mode, lowest first; the last one applies to all higher modes."""

    zeta: ArrayLike = 0.0

    def matrix(self, omega: np.ndarray) -> np.ndarray:
        """c_rs = 2 ζ_r ω_r δ_rs, (n_modes, n_modes)."""
        zeta = np.atleast_1d(np.asarray(self.zeta, float))
        if zeta.size == 0 or not np.isfinite(zeta).all() or (zeta < 0).any():
            raise ValueError(f"damping ratios must be finite and not negative, one at least; got {self.zeta}")
        of_mode = zeta[np.minimum(np.arange(omega.size), zeta.size - 1)]
        return np.diag(2.0 * of_mode * omega)


@former_fields(g1="stiffness", g2="mass")
@dataclass(frozen=True)
class ProportionalDamping:
    """Rayleigh damping C = α M + β K: c_r = α + β ω_r², ζ_r = (α/ω_r + β ω_r)/2; g2 and g1 of (2.13).

    Attributes:
        stiffness: β, s.
        mass: α, 1/s.
    """

    stiffness: float = 0.0
    mass: float = 0.0

    def matrix(self, omega: np.ndarray) -> np.ndarray:
        """c_rs = (α + β ω_r²) δ_rs, (n_modes, n_modes)."""
        return np.diag(self.stiffness * omega**2 + self.mass)


@dataclass(frozen=True, eq=False)
class ViscousDamping:
    """A viscous coefficient per length, N s/m², along x: c_rs = ∫ c φ_r φ_s dx (2.11), in general not diagonal.

    On a plate or membrane it is a coefficient per area, N s/m³: a number, a function of (x, y), or a `Field`.
    """

    coefficient_per_length: ProfileLike


Damping = ModalDamping | ProportionalDamping | ViscousDamping
