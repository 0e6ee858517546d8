"""Standard errors and intervals of frequencies and damping ratios, from their covariance."""

import numpy as np

from workbench.structure.modes import SampledModes


class StandardErrors:
    """What modes with a covariance of (ω_1..ω_n, ζ_1..ζ_n), (2 n_modes, 2 n_modes), say of their errors."""

    modes: SampledModes
    covariance: np.ndarray

    @property
    def omega_std(self) -> np.ndarray:
        """Standard error of each frequency (n_modes,), rad/s."""
        return np.sqrt(np.diag(self.covariance)[: self.modes.n_modes])

    @property
    def zeta_std(self) -> np.ndarray:
        """Standard error of each damping ratio (n_modes,)."""
        return np.sqrt(np.diag(self.covariance)[self.modes.n_modes :])

    def _within(self, width: float) -> tuple[np.ndarray, np.ndarray]:
        """ω and ζ less and plus so many standard errors, (2, n_modes) each."""
        both = ((self.modes.omega, self.omega_std), (self.modes.zeta, self.zeta_std))
        omega, zeta = (np.stack([value - width * std, value + width * std]) for value, std in both)
        return omega, zeta
