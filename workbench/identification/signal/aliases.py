"""Aliases of a mode: the frequencies that agree with its samples, one for each branch k of the logarithm (3.23)."""

from dataclasses import dataclass

import numpy as np

from workbench.renamed import former_arguments
from workbench.structure.modes import SampledModes, frozen


@dataclass(frozen=True, eq=False)
class Aliases:
    """Possible true frequencies and damping ratios of modes identified below half the sample rate.

    Every row gives the same samples: λ + 2πi j f_s, or its conjugate + 2πi j f_s, has the same e^{λΔt}.

    Attributes:
        branches: (n_branches,) k: the frequency lies between k and k + 1 times half the sample rate.
        frequencies_hz: (n_branches, n_modes) undamped natural frequencies, Hz.
        zeta: (n_branches, n_modes): the decay is the same, so the ratio falls as the frequency rises.
        sample_rate_hz: of the record.
    """

    branches: np.ndarray
    frequencies_hz: np.ndarray
    zeta: np.ndarray
    sample_rate_hz: float

    def deciding_rate_hz(self, mode: int) -> float:
        """The sample rate within a tenth of this one that separates the aliases of a mode best, Hz.

        A second record at that rate decides: only the true frequency is an alias in both records.
        """
        f = self.frequencies_hz[:, mode]
        rates = self.sample_rate_hz * np.r_[np.linspace(0.9, 0.99, 46), np.linspace(1.01, 1.1, 46)]
        folded = np.abs(f[:, None] - rates * np.round(f[:, None] / rates))
        apart = np.abs(folded[:, None] - folded[None]) + np.where(np.eye(f.size, dtype=bool), np.inf, 0.0)[:, :, None]
        return float(rates[apart.min(axis=(0, 1)).argmax()])


@former_arguments(most="n_branches")
def aliases(modes: SampledModes, *, sample_rate_hz: float, n_branches: int = 4) -> Aliases:
    """The frequencies beyond half the sample rate with the same samples as the modes: f_s - f, f_s + f, 2 f_s - f, ...

    Samples do not determine the branch. It follows from an anti-alias filter (k = 0), a record at another rate
    (`Aliases.deciding_rate_hz`), or a model that predicts the frequency; pass it to `stacked_delays(branch=k)`.

    Args:
        modes: identified below half the sample rate (branch 0).
        sample_rate_hz: of the record.
        n_branches: number of branches, from k = 0.

    Raises:
        ValueError: modes beyond half the sample rate, or fewer than one branch.
    """
    poles, half = modes.poles, 0.5 * sample_rate_hz
    if n_branches < 1:
        raise ValueError(f"at least one branch must be asked for; got {n_branches}")
    if (poles.imag > 2.0 * np.pi * half).any():
        worst = poles.imag.max() / (2.0 * np.pi)
        raise ValueError(
            f"a mode at {worst:g} Hz lies beyond half the sample rate, {half:g} Hz; give those of branch 0"
        )
    k = np.arange(n_branches)[:, None]
    turns = 2.0 * np.pi * sample_rate_hz * ((k + 1) // 2)
    damped = turns + np.where(k % 2 == 0, 1.0, -1.0) * poles.imag
    omega = np.hypot(poles.real, damped)
    return Aliases(frozen(k[:, 0], int), frozen(omega / (2.0 * np.pi)), frozen(-poles.real / omega), sample_rate_hz)
