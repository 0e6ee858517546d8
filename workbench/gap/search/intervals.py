"""Standard deviations of fitted parameters that hold where the model is a little wrong too."""

from dataclasses import replace

import numpy as np

from workbench.gap.effects.effect import COORDINATES, Effect, Parameter
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE, Workers
from workbench.gap.search.fit import Fit, parameters_of, slopes
from workbench.rig.rig import Rig

ALIKE = 1e-4  # of a number, or of the extent: how far two numerical routes to the same records put it apart
BLOCKS = 12  # a record: long beside the correlation of what is left, many enough to scatter


def with_intervals(rig: Rig, found: Fit, data: FitData, workers: Workers = ALONE, *, wide: bool = False) -> Fit:
    """The fit with standard deviations by which 95 % intervals hold although what is left is not white.

    With J the sensitivities, r what is left, in units of the noise, and P the precision of the priors,

        cov = A⁻¹ (Σ_b J_bᵀ r_b r_bᵀ J_b + s² P) A⁻¹,    A = Jᵀ J + s² P,    s² = max(|r|² / n, 1)

    over blocks b of each record (White, Econometrica 48 (1980) 817; blocks after Liang & Zeger, Biometrika 73 (1986)
    13), or s² A⁻¹ where that is larger. The joint covariance is no smaller than either in any direction. Beside errors
    of the nominal model no number of an effect is told to better than a part in ten thousand.

    Args:
        rig: nominal.
        found: effects, and errors of the nominal model where they were fitted too.
        data: fit records.
        workers: processes that share the work.
        wide: as of `slopes`.
    """
    residual, jacobian = slopes(rig, found.effects, data, workers=workers, wide=wide)
    if jacobian.shape[1] == 0:
        return found
    parameters = parameters_of(rig, found.effects)
    least = np.zeros(len(parameters))
    if any(p.prior_std is not None for _, p in parameters):
        least = np.array([_least(found.effects[i], p) for i, p in parameters])
    level = max(float(residual @ residual) / residual.size, 1.0)
    priors = np.array([0.0 if p.prior_std is None else 1.0 / p.prior_std**2 for _, p in parameters])
    scale = np.sqrt(np.maximum((jacobian**2).sum(axis=0) + level * priors, 1e-300))
    jacobian, priors = jacobian / scale, priors / scale**2
    inverse = np.linalg.pinv(jacobian.T @ jacobian + level * np.diag(priors), rcond=1e-12, hermitian=True)
    scores = _scores(residual, jacobian, data)
    scatter = scores.T @ scores + level * np.diag(priors)
    spread = inverse @ scatter @ inverse
    variances = np.maximum(np.diag(spread), level * np.diag(inverse)).clip(0.0)
    deviations: list[dict[str, float]] = [{} for _ in found.effects]
    for (i, parameter), deviation in zip(parameters, np.sqrt(variances / scale**2 + least**2), strict=True):
        value = found.effects[i].values[parameter.name]
        deviations[i][parameter.name] = float(abs(parameter.slope(value)) * deviation)
    effects = (replace(e, deviations={**e.deviations, **d}) for e, d in zip(found.effects, deviations, strict=True))
    joint = _joint(jacobian.T @ jacobian + level * np.diag(priors), scatter, level, len(scores))
    return replace(found, effects=tuple(effects), covariance=joint / np.outer(scale, scale) + np.diag(least**2))


def _least(effect: Effect, parameter: Parameter) -> float:
    """Standard deviation of a free coordinate that two good models of one structure differ by; none of their errors."""
    if parameter.prior_std is not None:
        return 0.0
    if parameter.logarithmic:
        return ALIKE
    value = effect.values[parameter.name]
    size = parameter.high if parameter.name in COORDINATES else abs(value - (parameter.neutral or 0.0))
    return ALIKE * size / parameter.scale


def _joint(information: np.ndarray, scatter: np.ndarray, level: float, n_blocks: int) -> np.ndarray:
    """The least covariance no smaller than A⁻¹ S A⁻¹ or s² A⁻¹ in any direction, with A `information`, S `scatter`.

    Few blocks tell little of many parameters, so S is drawn towards a multiple of s² A, the more the fewer they are.
    """
    values, vectors = np.linalg.eigh(information)
    there = values > 1e-12 * values[-1]
    root = vectors[:, there] / np.sqrt(values[there])
    relative = root.T @ scatter @ root / level
    own = n_blocks / (n_blocks + len(relative))
    relative = own * relative + (1.0 - own) * np.trace(relative) / len(relative) * np.eye(len(relative))
    larger, axes = np.linalg.eigh(relative)
    half = root @ (axes * np.sqrt(level * np.maximum(larger, 1.0)))
    return np.asarray(half @ half.T)


def _scores(residual: np.ndarray, jacobian: np.ndarray, data: FitData) -> np.ndarray:
    """J_bᵀ r_b of every block: (n_blocks, n_parameters)."""
    rows, start = [], 0
    for record in data.counted:
        n_outputs, n_samples = record.outputs.shape
        part = slice(start, start + n_outputs * n_samples)
        products = (residual[part, None] * jacobian[part]).reshape(n_outputs, n_samples, -1).sum(axis=0)
        rows += [block.sum(axis=0) for block in np.array_split(products, min(BLOCKS, n_samples))]
        start = part.stop
    return np.array(rows)
