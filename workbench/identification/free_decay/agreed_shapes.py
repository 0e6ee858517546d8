"""Shapes that several records agree on, and their covariance.

Records share shapes but not how each was struck: of record i only ρ_j = s_j / s_k counts, k the largest entry. Each
entry is the mean over the records by their own noise, so that a record that misses a mode, or is noisy, counts little.
"""

from collections.abc import Sequence

import numpy as np

from workbench.identification.signal.projection import Projection


def agreed_shapes(
    fits: Sequence[Projection], derivative: np.ndarray, pole_covariance: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Shapes relative to their largest entry, (n_outputs, n_modes) complex, and the covariance of their real parts,
    (n_modes, n_outputs, n_outputs).

    Args:
        fits: one a record, of the same poles.
        derivative: (n_outputs,) order of the time derivative each output measures.
        pole_covariance: (2 n_modes, 2 n_modes) of (σ, ω_d).
        variance: (n_records, n_outputs, n_modes) of the noise about each mode.
    """
    poles, n = fits[0].poles, fits[0].poles.size
    back = poles ** -derivative[:, None]
    shapes = np.array([fit.complex_amplitudes * back for fit in fits])
    spread = np.array([np.diag(fit.spread)[:n] + np.diag(fit.spread)[n : 2 * n] for fit in fits])
    own = variance * np.abs(back) ** 2 * spread[:, None]
    strongest = (np.abs(shapes) ** 2 / own).sum(axis=1).argmax(axis=0)
    root = _root(pole_covariance)
    agreed, covariance = np.empty(shapes.shape[1:], complex), np.zeros((n, len(derivative), len(derivative)))
    for r in range(n):
        best = shapes[strongest[r], :, r]
        k = int(np.argmax(np.abs(best)))
        size = np.maximum(np.abs(shapes[:, k, r, None]) ** 2, 1e-300)
        weights = size / (own[:, :, r] + np.abs(best / best[k]) ** 2 * own[:, k, r, None])
        weights = weights / weights.sum(axis=0)
        ratios = shapes[:, :, r] / shapes[:, k, r, None]
        agreed[:, r] = (weights * ratios).sum(axis=0)
        shared = np.zeros((len(derivative), 2 * n))
        for fit, each, weight, ratio, noise in zip(fits, shapes, weights, ratios, variance[:, :, r], strict=True):
            moved = _moved(fit, r) @ root * back[:, r, None]
            shared += weight[:, None] * ((moved - ratio[:, None] * moved[k]) / each[k, r]).real
            covariance[r] += np.outer(weight, weight) * _alone(fit, r, k, back[:, r] / each[k, r], ratio, noise)
        covariance[r] += shared @ shared.T
        covariance[r][k] = covariance[r][:, k] = 0.0
    return agreed, covariance


def _moved(fit: Projection, r: int) -> np.ndarray:
    """How the amplitudes of mode r follow σ and ω_d of every mode, by -Φ^+ dΦ, (n_outputs, 2 n_modes) complex."""
    n = fit.poles.size
    # dΦ of mode p is -(α, β) tΦ_p by σ and (β, -α) tΦ_p by ω_d.
    alpha, beta = fit.coefficients[:n], fit.coefficients[n : 2 * n]
    cosine, sine = (np.array([1.0, -1j]) @ fit.tilt[[r, n + r]]).reshape(2, n, 1)
    return np.vstack([cosine * alpha + sine * beta, sine * alpha - cosine * beta]).T


def _alone(fit: Projection, r: int, k: int, unit: np.ndarray, ratio: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Covariance of the real parts by each output's own noise, (Φ^T Φ)^-1, and by that of the reference, poles held."""
    pair = np.array([1.0, -1j]) @ _root(fit.spread[np.ix_([r, fit.poles.size + r], [r, fit.poles.size + r])])
    each = np.sqrt(variance)[:, None] * pair * unit[:, None]
    common = (ratio[:, None] * each[k]).real
    return common @ common.T + np.diag((each.real**2).sum(axis=1))


def _root(matrix: np.ndarray) -> np.ndarray:
    """R with R R^T = matrix, for a matrix that may be singular."""
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.maximum(values, 0.0))
