"""A random disturbance: no prediction can hold it, so it is found by what it does to the statistics."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from workbench.gap.missing_force import ForceFilter, force_filter, log_likelihood, sampled_model, whiten
from workbench.gap.prediction import FitData
from workbench.rig.rig import Rig


@dataclass(frozen=True, eq=False)
class RandomForceFit:
    """A white force at x with the same strength in every record.

    Attributes:
        at, rms: m, N.
        at_std, rms_std: standard deviations.
        cost: minus twice the log-likelihood per value, on the scale where a residual of pure sensor noise costs 1.
        chi2_by_record: (n_records,) mean squares of the whitened residual: all near 1 if the model holds.
        whiteness: (n_records,) largest lag-one correlation of a whitened channel.
    """

    at: float
    rms: float
    at_std: float
    rms_std: float
    cost: float
    chi2_by_record: np.ndarray
    whiteness: np.ndarray

    @property
    def holds(self) -> bool:
        """Whether the residual is what a stationary white force at one point leaves: in level, and in colour."""
        level = np.abs(self.chi2_by_record - 1.0).max() < 0.08
        return bool(level and self.whiteness.max() < 0.12)


def random_filter(rig: Rig, data: FitData, at: float, rms: float) -> ForceFilter:
    """The steady Kalman filter of the rig's linear part with a white force at x."""
    model = sampled_model(rig.modes, rig.sensors, data.noise, data.records[0].sample_time)
    return force_filter(model, rig.modes.phi(at).T, np.array([rms**2]), 0.0)


def fit_random_force(
    rig: Rig, data: FitData, residuals: Sequence[np.ndarray], places: Sequence[float], size: float
) -> RandomForceFit:
    """Maximum likelihood of place and strength, from the best of a grid.

    Args:
        residuals: (n_outputs, n_samples) a record, in the sensors' units.
        places: positions to start from, m.
        size: a typical force, N.
    """
    model = sampled_model(rig.modes, rig.sensors, data.noise, data.records[0].sample_time)
    residuals = list(residuals)
    length = rig.modes.length

    def at_point(x: float, log_rms: float) -> ForceFilter:
        return force_filter(model, rig.modes.phi(x).T, np.array([np.exp(2.0 * log_rms)]), 0.0)

    def loss(point: np.ndarray) -> float:
        x = point[0] * length
        if not 0.0 < x < length:
            return 1e300
        value = -2.0 * log_likelihood(at_point(x, point[1]), residuals)
        return value if np.isfinite(value) else 1e300

    grid = [(x / length, np.log(size * share)) for x in places for share in (1e-3, 1e-2, 1e-1, 1.0)]
    best = min(grid, key=lambda point: loss(np.array(point)))
    simplex = np.array([best, (best[0] + 0.02, best[1]), (best[0], best[1] + 0.5)])
    found = minimize(
        loss, best, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 1e-4, "fatol": 0.1, "maxfev": 80}
    )
    x, log_rms = found.x
    kalman = at_point(x * length, log_rms)
    n_values = sum(r.size for r in residuals)
    noise_part = sum(r.shape[1] for r in residuals) * np.sum(np.log(data.noise**2))
    whitened = [whiten(kalman, r) for r in residuals]
    deviations = _deviations(loss, found.x)
    return RandomForceFit(
        at=float(x * length),
        rms=float(np.exp(log_rms)),
        at_std=deviations[0] * length,
        rms_std=deviations[1] * float(np.exp(log_rms)),
        cost=float((found.fun - noise_part) / n_values),
        chi2_by_record=np.array([np.mean(w**2) for w in whitened]),
        whiteness=np.array([np.abs((w[:, 1:] * w[:, :-1]).mean(axis=1) / (w**2).mean(axis=1)).max() for w in whitened]),
    )


def _deviations(loss, point: np.ndarray) -> tuple[float, float]:
    """From the curvature of minus twice the log-likelihood."""
    out = []
    centre = loss(point)
    for j, step in enumerate((2e-3, 2e-2)):
        ahead, behind = point.copy(), point.copy()
        ahead[j] += step
        behind[j] -= step
        curvature = (loss(ahead) - 2.0 * centre + loss(behind)) / step**2
        out.append(float(np.sqrt(2.0 / curvature)) if 0 < curvature < 1e300 else 0.0)
    return out[0], out[1]


