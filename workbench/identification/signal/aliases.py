"""Which frequencies a sampled mode may have: the branch k of the logarithm, which samples do not determine (3.23)."""

from dataclasses import dataclass

import numpy as np

from workbench.structure.modes import SampledModes, frozen


@dataclass(frozen=True, eq=False)
class Aliases:
    """What each mode found below half the sample rate may be in truth.

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
        """The sample rate up to a tenth away from this one that sets the branches of a mode farthest apart, Hz.

        A second record at that rate decides: of the candidates of each record only the true one is in both.
        """
        f = self.frequencies_hz[:, mode]
        rates = self.sample_rate_hz * np.r_[np.linspace(0.9, 0.99, 46), np.linspace(1.01, 1.1, 46)]
        folded = np.abs(f[:, None] - rates * np.round(f[:, None] / rates))
        apart = np.abs(folded[:, None] - folded[None]) + np.where(np.eye(f.size, dtype=bool), np.inf, 0.0)[:, :, None]
        return float(rates[apart.min(axis=(0, 1)).argmax()])


def aliases(modes: SampledModes, *, sample_rate_hz: float, most: int = 4) -> Aliases:
    """The frequencies beyond half the sample rate that look like the modes found: f_s - f, f_s + f, 2 f_s - f, ...

    Samples alone do not decide. What does: a filter before the sampling (then k = 0), a record at another rate
    (`Aliases.deciding_rate_hz`), or a model that predicts the frequency; `stacked_delays(branch=k)` then takes it.

    Args:
        modes: found below half the sample rate (branch 0).
        sample_rate_hz: of the record.
        most: number of branches, from k = 0.

    Raises:
        ValueError: modes beyond half the sample rate, or fewer than one branch.
    """
    poles, half = modes.poles, 0.5 * sample_rate_hz
    if most < 1:
        raise ValueError(f"at least one branch must be asked for; got {most}")
    if (poles.imag > 2.0 * np.pi * half).any():
        worst = poles.imag.max() / (2.0 * np.pi)
        raise ValueError(
            f"a mode at {worst:g} Hz lies beyond half the sample rate, {half:g} Hz; give those of branch 0"
        )
    k = np.arange(most)[:, None]
    turns = 2.0 * np.pi * sample_rate_hz * ((k + 1) // 2)
    damped = turns + np.where(k % 2 == 0, 1.0, -1.0) * poles.imag
    omega = np.hypot(poles.real, damped)
    return Aliases(frozen(k[:, 0], int), frozen(omega / (2.0 * np.pi)), frozen(-poles.real / omega), sample_rate_hz)
