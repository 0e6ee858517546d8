"""Standard errors of a `modal_fit`, in noise of any smooth spectrum.

A mode is disturbed by noise about its own frequency only. Where output j has κ_jr times its mean noise there, a fit for
white noise has errors H^-1 M H^-1, M as H with each mode's share of output j times κ_jr^½ (White, Econometrica 48,
1980); amplitudes likewise. κ = 1 gives the Cramér-Rao bound.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from workbench.arrays import Floats, scaled_inverse, symmetric_root
from workbench.identification.input_output.modal_fit import (
    Fit,
    Part,
    free_parameters,
    normal_equations,
    tangent_weights,
)
from workbench.identification.signal.modal_estimates import by_poles

Figures = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def covariance(fit: Fit, noise_ratio: np.ndarray | float = 1.0) -> np.ndarray:
    """Of the free unknowns; `noise_ratio` is κ, (n_outputs, n_modes)."""
    bound = scaled_inverse(normal_equations(fit, fit.noise)[0])
    if np.all(noise_ratio == 1.0):
        return bound
    each = np.broadcast_to(noise_ratio, (fit.noise.size, fit.poles.size))
    rescaled = tuple(
        replace(part, coefficients=part.coefficients * _by_column(part, each[outputs]))
        for part, outputs in fit.outputs()
    )
    return np.asarray(bound @ normal_equations(replace(fit, parts=rescaled), fit.noise)[0] @ bound)


def pole_covariance(fit: Fit, noise_ratio: np.ndarray | float = 1.0, further: Floats | None = None) -> np.ndarray:
    """Of (ω, ζ), (2 n_modes, 2 n_modes); `further` as in `errors`."""
    n, q = fit.poles.size, fit.participation.shape[1] + 1
    free = free_parameters(fit)
    at = np.searchsorted(free, np.r_[q * np.arange(n), q * n + q * np.arange(n)])
    jacobian = by_poles(fit.poles)
    whole = covariance(fit, noise_ratio)[np.ix_(at, at)]
    if further is not None:
        whole = whole + further[np.ix_(at, at)]
    return np.asarray(jacobian @ whole @ jacobian.T)


def errors(fit: Fit, figures: Figures, noise_ratio: np.ndarray, further: Floats | None = None) -> np.ndarray:
    """Covariance of figures of (poles, participation, amplitudes) by their exact first-order change.

    Args:
        figures: analytic up to conjugation, real (k,) of poles (n,), participation (n, n_excitations) and amplitudes
            (n_outputs, n).
        noise_ratio: κ, (n_outputs, n_modes).
        further: covariance that is added, of the free unknowns, then of the coefficients of each output.
    """
    n, p = fit.participation.shape
    free, size, at = free_parameters(fit), n * (p + 1), (fit.poles, fit.participation, fit.amplitudes)
    drift = np.concatenate(
        [-np.einsum("ct,tkj->ckj", part.tilt, tangent_weights(fit, part)) for part in fit.parts], axis=2
    )
    changes = []

    def add(unknowns: Floats, c: Floats | None = None) -> None:
        """A change of the free unknowns, and of the coefficients, which go along with these unless given."""
        whole = np.zeros(2 * size)
        whole[free] = unknowns
        step = (whole[:size] + 1j * whole[size:]).reshape(n, p + 1)
        c = np.einsum("ckj,k->cj", drift, whole) if c is None else c
        changes.append((step[:, 0], step[:, 1:], (c[:n] - 1j * c[n : 2 * n]).T))

    for column in _root(covariance(fit, noise_ratio)).T:
        add(column)
    if further is not None:
        for column in _root(further).T:
            add(column[: free.size], column[free.size :].reshape(fit.noise.size, -1).T)
    for part, outputs in fit.outputs():
        spread = _root(part.spread[: 2 * n, : 2 * n])
        for output in range(outputs.start, outputs.stop):
            for column in (np.tile(np.sqrt(noise_ratio[output]), 2)[:, None] * spread).T:
                a = np.zeros_like(fit.amplitudes)
                a[output] = fit.noise[output] * (column[:n] - 1j * column[n:])
                changes.append((np.zeros_like(fit.poles), np.zeros_like(fit.participation), a))
    found = []
    for change in changes:
        # Central differences of a figure along one direction of the error ellipsoid, at a thousandth of its length.
        above, below = (figures(*(x + h * d for x, d in zip(at, change, strict=True))) for h in (1e-3, -1e-3))
        found.append((above - below) / 2e-3)
    jacobian = np.array(found)
    return jacobian.T @ jacobian


def vector_covariance(
    fit: Fit,
    noise_ratio: np.ndarray,
    derivative: np.ndarray,
    kept: np.ndarray,
    shapes: np.ndarray,
    n_inputs: int,
    further: Floats | None = None,
) -> np.ndarray:
    """Of each mode's shape over its largest entry, real part, then of its participation factors, real and imaginary.

    Args:
        noise_ratio: κ, (n_outputs, n_modes).
        derivative: (n_outputs, 1) in time, of what each output measures.
        kept: (n_kept,) the modes that are reported.
        shapes: (n_outputs, n_kept) as they are reported, see `scaled_vectors`.
        n_inputs: how many excitations, the first ones, are inputs.
        further: as in `errors`.

    Returns:
        (n_kept, k, k), k = n_outputs + 2 n_inputs.
    """
    k = len(fit.amplitudes) + 2 * n_inputs
    if not kept.size:
        return np.zeros((0, k, k))
    largest = np.abs(fit.amplitudes[:, kept] / fit.poles[kept] ** derivative).argmax(axis=0)
    each = np.arange(kept.size)
    scale = shapes[largest, each]

    def figures(poles: np.ndarray, participation: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        seen = amplitudes[:, kept] / poles[kept] ** derivative
        relative = seen / seen[largest, each]
        driven = participation[kept, :n_inputs] * (0.5 * seen[largest, each] / scale)[:, None]
        return np.concatenate([relative.real.T, driven.real, driven.imag], axis=1).ravel()

    found = errors(fit, figures, noise_ratio, further).reshape(kept.size, k, kept.size, k)[each, :, each]
    found[each, largest], found[each, :, largest] = 0.0, 0.0  # one by definition
    return found


def fixed_std(fit: Fit, noise_ratio: np.ndarray, fixed: np.ndarray, further: Floats | None = None) -> np.ndarray:
    """Standard errors of the coefficients of the fixed columns, (n_fixed, n_outputs).

    Args:
        noise_ratio: κ, (n_outputs, n_modes).
        fixed: κ of each fixed column and output, (n_fixed, n_outputs).
        further: as in `errors`.
    """
    bound, free, n, found = covariance(fit, noise_ratio), free_parameters(fit), 2 * fit.poles.size, []
    for part, outputs in fit.outputs():
        drift = np.einsum("ct,tkj->ckj", part.tilt[n:], tangent_weights(fit, part)[:, free])
        own = np.diag(part.spread)[n:, None] * fit.noise[outputs] ** 2 * fixed[:, outputs]
        found.append(own + np.einsum("ckj,kl,clj->cj", drift, bound, drift))
    variance = np.hstack(found)
    if further is not None:
        variance += np.diag(further)[free.size :].reshape(fit.noise.size, -1).T[n:]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))  # of columns next to alike, round-off may be more


def _by_column(part: Part, rows: np.ndarray) -> np.ndarray:
    """κ^½ of each column of a part, 1 for those that are fixed, (n_columns, n_outputs)."""
    coordinates = np.tile(np.sqrt(rows).T, (2, 1))
    return np.vstack([coordinates, np.ones((part.coefficients.shape[0] - len(coordinates), len(rows)))])


def _root(matrix: np.ndarray) -> np.ndarray:
    """R with R R^T = matrix, which close modes may have made singular."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return size[:, None] * symmetric_root(matrix / np.outer(size, size))
