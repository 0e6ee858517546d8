"""Robustness of a design to errors of identification: the share of perturbed models that stay stable.

Frequencies and damping ratios are drawn from their covariance. Shapes are drawn from their covariance at the sensors;
the modes themselves interpolate the error, φ_r + Σ_s e_rs φ_s.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from workbench.arrays import symmetric_root
from workbench.design.estimation.controller import Controller
from workbench.design.laws.law import DesignError, Law
from workbench.design.loop.closed_loop import close_with
from workbench.design.spillover.spillover import finite_spillover
from workbench.renamed import former_fields
from workbench.structure.modes import Modes, freeze
from workbench.threads import one_blas_thread

LEAST_OMEGA = 1e-3  # of the frequency: lower bound of a drawn one


@former_fields(margins="decay_rates")
@dataclass(frozen=True, eq=False)
class Robustness:
    """Decay rates and spillover of a design on many perturbed models.

    Attributes:
        decay_rates: (n_draws,) of the slowest pole of each, 1/s; negative where unstable, ± rounding where marginally
            stable.
        work: (n_draws,) W_R up to the final time; nan where unstable.
    """

    decay_rates: np.ndarray
    work: np.ndarray

    def __post_init__(self) -> None:
        freeze(self, "decay_rates", "work")

    @property
    def share(self) -> float:
        """Share of the perturbed models on which no pole of the loop of all modes is unstable."""
        return float(np.mean(np.isfinite(self.work)))

    @property
    def standard_error(self) -> float:
        """Standard error of the share, for the number of draws."""
        return float(np.sqrt(self.share * (1 - self.share) / self.decay_rates.size))

    def spread(self, level: float = 0.9) -> tuple[float, float, float]:
        """W_R of the stable draws: lower end of the central interval, median, upper end; nan where none is stable."""
        stable = self.work[np.isfinite(self.work)]
        if not stable.size:
            return np.nan, np.nan, np.nan
        low, median, high = np.quantile(stable, (0.5 - 0.5 * level, 0.5, 0.5 + 0.5 * level))
        return float(low), float(median), float(high)


def draw_modes(
    modes: Modes,
    count: int,
    *,
    seed: int | np.random.Generator = 0,
    scale: float = 1.0,
    shape_covariance: ArrayLike | None = None,
    positions: ArrayLike | None = None,
) -> list[Modes]:
    """Models drawn from the identified modes and their covariance.

    Args:
        modes: identified, with the covariance of (ω, ζ).
        count: number of draws.
        seed: of the draws.
        scale: factor of all standard errors.
        shape_covariance: (n_modes, n_sensors, n_sensors) of the shapes, relative to the largest entry of each.
        positions: (n_sensors,) of the sensors, m.

    Raises:
        DesignError: modes without covariance, or shapes without positions.
    """
    if modes.covariance is None:
        raise DesignError("these modes carry no covariance; identify them with `refine` and `eigenfunctions`")
    if (shape_covariance is None) != (positions is None):
        raise DesignError("errors of shape need both their covariance and the positions of the sensors")
    rng = np.random.default_rng(seed)
    n = modes.n_modes
    centre = np.r_[modes.omega, modes.zeta]
    drawn = centre + scale * rng.standard_normal((count, 2 * n)) @ symmetric_root(modes.covariance).T
    mixing = np.zeros((count, n, n))
    if shape_covariance is not None and positions is not None:
        at = modes.phi(positions)
        inverse = np.linalg.pinv(at)
        for r, covariance in enumerate(np.asarray(shape_covariance, float)):
            largest = np.abs(at[:, r]).max()
            error = largest * rng.standard_normal((count, len(at))) @ symmetric_root(covariance).T
            mixing[:, :, r] = scale * error @ inverse.T
    return [_perturbed(modes, row, mix) for row, mix in zip(drawn, mixing, strict=True)]


def _perturbed(modes: Modes, values: np.ndarray, mixing: np.ndarray) -> Modes:
    """Modes of given ω and ζ, `values` (2 n_modes,), and the shapes φ (I + mixing), mixing (n_modes, n_modes).

    Damping that couples the modes is kept.
    """
    n = modes.n_modes
    omega = np.maximum(values[:n], LEAST_OMEGA * modes.omega)
    c = np.diag(2.0 * values[n:] * omega)
    if not modes.proportional:
        c += modes.damping - np.diag(np.diag(modes.damping))
    blend = np.eye(n) + mixing
    return Modes(omega, c, lambda x, d: modes.shapes(x, d) @ blend, modes.domain, modes.essential, masses=modes.masses)


def perturbed_modes(modes: Modes, error: float, *, count: int = 100, seed: int = 0) -> list[Modes]:
    """Models perturbed by a relative standard error, where no identification gives their covariance.

    The error is that of each frequency and damping ratio, and the root mean square of all modes mixed into a shape.

    Raises:
        DesignError: an error that is no share between 0 and 1.
    """
    if not 0 < error <= 1:
        raise DesignError(f"the relative error of the models is a share between 0 and 1, 0.05 for 5 %; got {error:g}")
    rng, n = np.random.default_rng(seed), modes.n_modes
    centre = np.r_[modes.omega, modes.zeta]
    drawn = centre * (1.0 + error * rng.standard_normal((count, 2 * n)))
    mixing = error / np.sqrt(n) * rng.standard_normal((count, n, n))
    return [_perturbed(modes, row, mix) for row, mix in zip(drawn, mixing, strict=True)]


def stable_share(possible: list[Modes], design: Controller | Law) -> float:
    """Share of the models on which a design is stable."""
    return float(np.mean([not close_with(modes, design).unstable_poles.size for modes in possible]))


@one_blas_thread
def robustness(
    possible: list[Modes], designs: Mapping[str, Controller | Law], *, state: np.ndarray, final_time: float
) -> dict[str, Robustness]:
    """The robustness of each design, evaluated on each of the models.

    Args:
        possible: from `draw_modes`.
        designs: by name.
        state: (2 n_modes,) at t = 0.
        final_time: s, of W_R.
    """
    results = {}
    for name, controller in designs.items():
        rates, work = np.empty(len(possible)), np.full(len(possible), np.nan)
        for i, modes in enumerate(possible):
            loop = close_with(modes, controller)
            rates[i] = loop.decay_rate
            if not loop.unstable_poles.size:
                work[i] = finite_spillover(loop, state, final_time).residual_work
        results[name] = Robustness(rates, work)
    return results
