"""Standard errors of a `modal_fit`, in noise of any smooth spectrum, and the χ² of its modes.

A mode is affected by the noise near its own frequency. Where output j has κ_jr times its mean noise power there, a fit
that assumes white noise has the covariance H^-1 M H^-1, M as H with the share of each mode in output j times κ_jr^½
(White, Econometrica 48, 1980); amplitudes likewise. κ = 1 gives the Cramér-Rao bound.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from workbench.arrays import Floats, scaled_inverse, symmetric_root
from workbench.identification.input_output.modal_fit import (
    Fit,
    free_parameters,
    normal_equations,
    scaled_vectors,
    tangent_weights,
)
from workbench.identification.signal.modal_estimates import by_poles

Functions = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def covariance(fit: Fit, noise_ratio: np.ndarray | float = 1.0) -> np.ndarray:
    """Covariance of the free unknowns; `noise_ratio` is κ, (n_outputs, n_modes)."""
    bound = scaled_inverse(normal_equations(fit, fit.noise)[0])
    if np.all(noise_ratio == 1.0):
        return bound
    ratios = np.broadcast_to(noise_ratio, (fit.noise.size, fit.poles.size))
    n = 2 * fit.poles.size
    rescaled = tuple(
        replace(part, coefficients=part.coefficients[:n] * np.tile(np.sqrt(ratios[outputs]).T, (2, 1)))
        for part, outputs in fit.outputs()
    )
    return np.asarray(bound @ normal_equations(replace(fit, parts=rescaled), fit.noise)[0] @ bound)


def pole_covariance(fit: Fit, noise_ratio: np.ndarray | float = 1.0, further: Floats | None = None) -> np.ndarray:
    """Covariance of (ω, ζ), (2 n_modes, 2 n_modes); `further` as in `propagated_covariance`."""
    n, q = fit.poles.size, fit.participation.shape[1] + 1
    free = free_parameters(fit)
    pole_indices = np.searchsorted(free, np.r_[q * np.arange(n), q * n + q * np.arange(n)])
    jacobian = by_poles(fit.poles)
    pole_part = covariance(fit, noise_ratio)[np.ix_(pole_indices, pole_indices)]
    if further is not None:
        pole_part = pole_part + further[np.ix_(pole_indices, pole_indices)]
    return np.asarray(jacobian @ pole_part @ jacobian.T)


def propagated_covariance(
    fit: Fit, functions: Functions, noise_ratio: np.ndarray, further: Floats | None = None
) -> np.ndarray:
    """Covariance of functions of poles, participation factors and amplitudes, by first-order error propagation.

    Args:
        functions: analytic up to conjugation, real (k,) of poles (n,), participation (n, n_excitations) and amplitudes
            (n_outputs, n).
        noise_ratio: κ, (n_outputs, n_modes).
        further: covariance that is added, of the free unknowns, then of the coefficients of each output.
    """
    n, p = fit.participation.shape
    free, size, estimate = free_parameters(fit), n * (p + 1), (fit.poles, fit.participation, fit.amplitudes)
    effect = np.concatenate(
        [-np.einsum("ct,tkj->ckj", part.tilt, tangent_weights(fit, part)) for part in fit.parts], axis=2
    )
    directions = []

    def add(unknowns: Floats, c: Floats | None = None) -> None:
        """Add a change of the free unknowns and of the coefficients, by default those that follow by least squares."""
        all_unknowns = np.zeros(2 * size)
        all_unknowns[free] = unknowns
        step = (all_unknowns[:size] + 1j * all_unknowns[size:]).reshape(n, p + 1)
        c = np.einsum("ckj,k->cj", effect, all_unknowns) if c is None else c
        directions.append((step[:, 0], step[:, 1:], (c[:n] - 1j * c[n : 2 * n]).T))

    for column in scaled_root(covariance(fit, noise_ratio)).T:
        add(column)
    if further is not None:
        for column in scaled_root(further).T:
            add(column[: free.size], column[free.size :].reshape(fit.noise.size, -1).T)
    for part, outputs in fit.outputs():
        spread = scaled_root(part.spread[: 2 * n, : 2 * n])
        for output in range(outputs.start, outputs.stop):
            for column in (np.tile(np.sqrt(noise_ratio[output]), 2)[:, None] * spread).T:
                a = np.zeros_like(fit.amplitudes)
                a[output] = fit.noise[output] * (column[:n] - 1j * column[n:])
                directions.append((np.zeros_like(fit.poles), np.zeros_like(fit.participation), a))
    derivatives = []
    for change in directions:
        # Central differences along one direction of the error ellipsoid, at a thousandth of its length.
        above, below = (functions(*(x + h * d for x, d in zip(estimate, change, strict=True))) for h in (1e-3, -1e-3))
        derivatives.append((above - below) / 2e-3)
    jacobian = np.array(derivatives)
    return jacobian.T @ jacobian


def vector_covariance(
    fit: Fit,
    noise_ratio: np.ndarray,
    derivative: np.ndarray,
    kept: np.ndarray,
    n_inputs: int,
    further: Floats | None = None,
) -> np.ndarray:
    """Covariance of each mode's relative shape and participation factors, (n_kept, k, k), k = n_outputs + 2 n_inputs.

    The shape is over its largest entry, real part; then real and imaginary parts of the participation factors.

    Args:
        noise_ratio: κ, (n_outputs, n_modes).
        derivative: (n_outputs, 1) order of the time derivative of displacement that each output measures.
        kept: (n_kept,) indices of the modes that are reported.
        n_inputs: number of excitations, the first ones, that are inputs.
        further: as in `propagated_covariance`.
    """
    k = len(fit.amplitudes) + 2 * n_inputs
    if not kept.size:
        return np.zeros((0, k, k))
    largest = np.abs(fit.amplitudes[:, kept] / fit.poles[kept] ** derivative).argmax(axis=0)
    modes = np.arange(kept.size)
    scale = scaled_vectors(fit, kept, derivative)[0][largest, modes]

    def functions(poles: np.ndarray, participation: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        displacements = amplitudes[:, kept] / poles[kept] ** derivative
        relative = displacements / displacements[largest, modes]
        driven = participation[kept, :n_inputs] * (0.5 * displacements[largest, modes] / scale)[:, None]
        return np.concatenate([relative.real.T, driven.real, driven.imag], axis=1).ravel()

    covariance_of_all = propagated_covariance(fit, functions, noise_ratio, further)
    blocks = covariance_of_all.reshape(kept.size, k, kept.size, k)[modes, :, modes]
    blocks[modes, largest], blocks[modes, :, largest] = 0.0, 0.0  # one by definition
    return blocks


def fixed_std(fit: Fit, noise_ratio: np.ndarray, fixed: np.ndarray, further: Floats | None = None) -> np.ndarray:
    """Standard errors of the coefficients of the fixed columns, (n_fixed, n_outputs).

    From κ (n_outputs, n_modes), and `fixed`, that of each fixed column and output. `further` as in
    `propagated_covariance`.
    """
    bound, free, n, variances = covariance(fit, noise_ratio), free_parameters(fit), 2 * fit.poles.size, []
    for part, outputs in fit.outputs():
        effect = np.einsum("ct,tkj->ckj", part.tilt[n:], tangent_weights(fit, part)[:, free])
        column_variance = np.diag(part.spread)[n:, None] * fit.noise[outputs] ** 2 * fixed[:, outputs]
        variances.append(column_variance + np.einsum("ckj,kl,clj->cj", effect, bound, effect))
    variance = np.hstack(variances)
    if further is not None:
        variance += np.diag(further)[free.size :].reshape(fit.noise.size, -1).T[n:]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))  # rounding error of nearly collinear columns may be negative


def statistic_of(fit: Fit, r: int) -> float:
    """χ² of the shape of mode r in the noise, its pole and participation factors fixed."""
    pair, noise, statistic = [r, fit.poles.size + r], fit.noise, 0.0
    for part, outputs in fit.outputs():
        c = part.coefficients[pair] / noise[outputs]
        # a pole at Nyquist has no imaginary part at the samples: singular
        statistic += float(np.einsum("ij,ik,kj->", c, scaled_inverse(part.spread[np.ix_(pair, pair)]), c))
    return statistic


def statistic_of_each(fit: Fit) -> np.ndarray:
    """`statistic_of` each mode, (n_modes,)."""
    return np.array([statistic_of(fit, r) for r in range(fit.poles.size)])


def marginal_statistics_of(fit: Fit) -> np.ndarray:
    """χ² of each mode's shape in the noise, (n_modes,), poles and participation factors of all modes unknown."""
    n, bound, free = fit.poles.size, covariance(fit), free_parameters(fit)
    statistics = np.zeros(n)
    if n == 0:
        return statistics
    amplitudes = fit.coefficients[: 2 * n].reshape(2, n, -1)
    effect = [np.einsum("ct,tkj->cjk", part.tilt[: 2 * n], tangent_weights(fit, part)[:, free]) for part in fit.parts]
    for r in range(n):
        pair = [r, n + r]
        effects = np.concatenate([each[pair] for each in effect], axis=1)
        size = 2 * effects.shape[1]
        spread = effects.reshape(size, -1) @ bound @ effects.reshape(size, -1).T
        spread = spread.reshape(2, size // 2, 2, size // 2)
        for part, outputs in fit.outputs():
            shape_covariance = part.spread[np.ix_(pair, pair)]
            for j in range(outputs.start, outputs.stop):
                spread[:, j, :, j] += shape_covariance * fit.noise[j] ** 2
        c = amplitudes[:, r].ravel()
        spread = spread.reshape(size, size)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(spread), 1e-300))
        # Nearly identical modes make it singular.
        statistics[r] = c * scale @ np.linalg.pinv(spread * np.outer(scale, scale), hermitian=True) @ (c * scale)
    return statistics


def scaled_root(matrix: np.ndarray) -> np.ndarray:
    """R with R R^T = matrix, also of a matrix that close modes make singular."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return size[:, None] * symmetric_root(matrix / np.outer(size, size))
