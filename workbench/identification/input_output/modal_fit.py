"""Maximum likelihood estimates of poles, shapes and participation factors, in time or over frequency.

Each mode has one complex modal coordinate z_r, which every output measures in proportion to its shape,

    y_j = Re Σ_r a_jr z_r + Σ_f d_jf v_f,      z_r = Σ_p l_rp x_p(λ_r),

x_p(λ) the response of a pole λ to the p-th excitation and v_f columns known beforehand. For given poles and
participation factors l the outputs are linear in a and d, which are eliminated (variable projection, Golub & Pereyra
1973). z_r is analytic in λ_r and l_rp, so one matrix of tangents T = ∂z_r/∂(λ_r, l_rp), orthogonal to all columns,
gives the Gauss-Newton matrix H; H^-1 in the noise of the outputs is the Cramér-Rao bound. One participation factor of
each mode is held at 1: the shape carries its scale.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.linalg import qr, solve_triangular

from workbench.arrays import Floats
from workbench.identification.signal.modal_estimates import normalised_shapes
from workbench.identification.signal.projection import pole_blocks
from workbench.identification.signal.searches import FIT, TimeLimit, minimise
from workbench.threads import at_once

Pair = tuple[np.ndarray, np.ndarray]
# From this many rows on, the Gram matrix is that of the tangents less that of their projections: to form the projected
# tangents takes three times as long, and the rounding error of the difference is below the noise of so many rows
MANY_ROWS = 5000
BLOCK_ROWS = 8192  # rows at a time: these stay in the processor's cache, and are as many tasks for its cores
# Length of a unit column orthogonal to the others, below which Cholesky factors lose it in rounding
MIN_ORTHOGONAL_LENGTH = 1e-5
# The same where only products of the columns are known, whose rounding error grows with its inverse square
MIN_LENGTH_OF_PRODUCTS = 1e-3


class Measurement(Protocol):
    """A measurement to which modes are fitted."""

    values: np.ndarray  # (n_rows, n_outputs) real readings, divided by their relative noise where `weights` is given
    fixed: np.ndarray  # (n_rows, n_fixed) columns v_f
    weights: np.ndarray | None  # (n_rows, n_outputs) inverse relative noise; None where all rows have the same
    resolution: float  # 2π over the duration, rad/s
    highest: float  # rad/s, beyond which no pole is searched
    nyquist: float  # rad/s, half of the sample rate; inf of response functions
    n_inputs: int  # number of excitations that are inputs; the others are initial states
    cells: int  # number of poles that could be distinguished, for the chance of a false alarm
    distorted: tuple[complex, ...]  # poles of nonlinear modes; no further mode is searched near these
    free: tuple[complex, ...]  # poles of a free decay within the record, given where some of them are distorted

    def responses(self, pole: complex) -> Pair:
        """Real and imaginary parts of x_p(λ), (n_rows, n_excitations) each."""

    def slopes(self, pole: complex, participation: np.ndarray) -> Pair:
        """∂/∂λ of Σ_p l_p x_p(λ), (n_rows,) each."""

    def tangents(self, pole: complex, participation: np.ndarray, real: np.ndarray, imaginary: np.ndarray) -> None:
        """Write `slopes`, then `responses`, into columns (n_rows, 1 + n_excitations)."""

    def candidates(self, residual: np.ndarray) -> np.ndarray:
        """Poles to try, (n_candidates,), from the residual in units of the noise."""

    def noise_ratio(self, residual: np.ndarray, pole: complex) -> float:
        """Noise power about a pole over its mean, at least 1."""


@dataclass(frozen=True, eq=False)
class Part:
    """The least-squares projection of outputs that share the same weighted columns."""

    residual: np.ndarray  # (n_rows, n_outputs)
    coefficients: np.ndarray  # (n_columns, n_outputs)
    gram: np.ndarray  # T^T (I - Φ Φ^+) T
    slopes: np.ndarray  # T^T residual
    spread: np.ndarray  # (Φ^T Φ)^-1
    tilt: np.ndarray  # Φ^+ T
    sizes: np.ndarray  # (n_tangents,) norms of T


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted modes: poles (n_modes,), participation factors (n_modes, n_excitations), and the projections on them."""

    poles: np.ndarray
    participation: np.ndarray
    parts: tuple[Part, ...]
    converged: bool = False
    steps: int = 0

    @property
    def residual(self) -> np.ndarray:
        return np.hstack([part.residual for part in self.parts])

    @property
    def coefficients(self) -> np.ndarray:
        return np.hstack([part.coefficients for part in self.parts])

    @property
    def amplitudes(self) -> np.ndarray:
        """a_jr, (n_outputs, n_modes)."""
        n = self.poles.size
        return (self.coefficients[:n] - 1j * self.coefficients[n : 2 * n]).T

    @property
    def noise(self) -> np.ndarray:
        """Standard deviation of the residual of each output, (n_outputs,)."""
        residual = self.residual
        free = max(residual.shape[0] - self.coefficients.shape[0] - free_parameters(self).size / residual.shape[1], 1.0)
        squares = (residual**2).sum(axis=0)
        return np.asarray(np.sqrt(np.maximum(squares, 1e-28 * squares.max() + 1e-300) / free))

    def outputs(self) -> Iterator[tuple[Part, slice]]:
        """Each part, with the slice of the outputs it holds."""
        first = 0
        for part in self.parts:
            yield part, slice(first, first + part.residual.shape[1])
            first += part.residual.shape[1]


def projected(data: Measurement, poles: np.ndarray, participation: np.ndarray, into: np.ndarray | None = None) -> Fit:
    """The fit with given poles and participation factors; shapes by least squares.

    Args:
        into: overwritten with the `regressors`; new memory for each trial step takes an eighth of its time.
    """
    x, combined = regressors(data, poles, participation, into), combinations(participation, data.fixed.shape[1])
    if len(x) >= MANY_ROWS:
        try:
            return Fit(poles, participation, tuple(_parts_by_products(data, x, combined)))
        except np.linalg.LinAlgError:
            pass  # columns that are nearly dependent
    phi, t = x @ combined, x[:, : x.shape[1] - data.fixed.shape[1]]
    if data.weights is None:
        return Fit(poles, participation, (_part(phi, t, data.values),))
    return Fit(poles, participation, tuple(_part(w * phi, w * t, y) for w, y in weighted_outputs(data)))


def weighted_outputs(data: Measurement) -> Iterator[Pair]:
    """Weights (n_rows, 1) and readings (n_rows, 1) of each output; 1 and those of all where rows have equal weight."""
    if data.weights is None:
        yield np.ones((1, 1)), data.values
    else:
        yield from zip(data.weights.T[:, :, None], data.values.T[:, :, None], strict=True)


def row_weights(data: Measurement, rows: slice | None = None) -> Floats:
    """Weights of all rows, or of some, (n_rows, n_outputs); ones (1, n_outputs) where all have equal weight."""
    if data.weights is None:
        return np.ones((1, data.values.shape[1]))
    return data.weights if rows is None else data.weights[rows]


def modal_coordinate(response: Pair, l_r: np.ndarray) -> Pair:
    """Real and imaginary part of z_r, (n_rows,) each, from `Measurement.responses` and participation factors."""
    real, imaginary = response
    return real @ l_r.real - imaginary @ l_r.imag, real @ l_r.imag + imaginary @ l_r.real


def columns(data: Measurement, poles: np.ndarray, participation: np.ndarray) -> Pair:
    """Modal coordinates and fixed columns, Φ (n_rows, n_columns), and tangents T (n_rows, n_tangents), not weighted."""
    x, n_fixed = regressors(data, poles, participation), data.fixed.shape[1]
    return x @ combinations(participation, n_fixed), x[:, : x.shape[1] - n_fixed]


def regressors(
    data: Measurement, poles: np.ndarray, participation: np.ndarray, into: np.ndarray | None = None
) -> np.ndarray:
    """Tangents T and fixed columns V, [T, V] (n_rows, n_tangents + n_fixed), not weighted.

    T holds of each mode its slope and its responses, real parts, then imaginary ones.
    """
    n, q, (n_rows, n_fixed) = poles.size, participation.shape[1] + 1, data.fixed.shape
    x = np.empty((n_rows, 2 * n * q + n_fixed), order="F") if into is None else into
    x[:, 2 * n * q :] = data.fixed
    real, imaginary = x[:, : n * q], x[:, n * q : 2 * n * q]

    def write(r: int) -> None:
        of_mode = slice(r * q, (r + 1) * q)
        data.tangents(poles[r], participation[r], real[:, of_mode], imaginary[:, of_mode])

    at_once(write, range(n), long=n_rows >= MANY_ROWS)
    return x


def changes_of(a: np.ndarray, tangents: Pair) -> np.ndarray:
    """Changes of an output by the real, then by the imaginary parts of changes of unknowns, (n_rows, 2 n_unknowns).

    From the amplitude (n_unknowns,) at the output of the mode of each unknown, and ∂z by each, (n_rows, n_unknowns).
    """
    real, imaginary = tangents
    return np.hstack([a.real * real - a.imag * imaginary, -a.imag * real - a.real * imaginary])


def combinations(participation: np.ndarray, n_fixed: int) -> np.ndarray:
    """K of Φ = [T, V] K, (n_tangents + n_fixed, n_columns): modal coordinates are combinations of responses."""
    n, q = participation.shape[0], participation.shape[1] + 1
    k = np.zeros((2 * n * q + n_fixed, 2 * n + n_fixed))
    k[2 * n * q :, 2 * n :] = np.eye(n_fixed)
    for r, l_r in enumerate(participation):
        real, imaginary = (slice((part * n + r) * q + 1, (part * n + r + 1) * q) for part in (0, 1))
        k[real, r], k[real, n + r] = l_r.real, l_r.imag
        k[imaginary, r], k[imaginary, n + r] = -l_r.imag, l_r.real
    return k


def _parts_by_products(data: Measurement, x: np.ndarray, combined: np.ndarray) -> Iterator[Part]:
    """The projections from the products of X = [T, V]; Φ = X K. LinAlgError where columns are too nearly dependent."""
    t = slice(0, x.shape[1] - data.fixed.shape[1])
    for weight, y in weighted_outputs(data):
        products, moments = products_of(x, weight, y)
        with_columns = combined.T @ products
        of_columns = with_columns @ combined
        size = np.maximum(np.sqrt(np.diag(of_columns)), 1e-300)
        factor = np.linalg.cholesky(of_columns / np.outer(size, size)).T
        if factor.size and np.diag(factor).min() < MIN_LENGTH_OF_PRODUCTS:
            raise np.linalg.LinAlgError("columns that are nearly dependent")
        inverse = solve_triangular(factor, np.eye(size.size)) / size[:, None]
        qt, qy = inverse.T @ with_columns[:, t], inverse.T @ (combined.T @ moments)
        coefficients = inverse @ qy
        residual, slopes = _left(x, weight, y, combined @ coefficients)
        gram, sizes = products[t, t], np.sqrt(np.diag(products)[t])
        yield Part(residual, coefficients, gram - qt.T @ qt, slopes[t], inverse @ inverse.T, inverse @ qt, sizes)


def products_of(x: Floats, weight: Floats, y: Floats) -> tuple[Floats, Floats]:
    """X^T W² X of columns X (n_rows, n_columns), and X^T W y of weighted readings (n_rows, n_outputs); weights are
    (n_rows, 1), or (1, 1) for rows of equal weight."""

    def of_rows(rows: slice) -> tuple[Floats, Floats]:
        block = x[rows] if len(weight) == 1 else weight[rows] * x[rows]
        return block.T @ block, block.T @ y[rows]

    scale = weight[0, 0] if len(weight) == 1 else 1.0
    each = at_once(of_rows, blocks(len(x)))
    products, moments = (np.sum(parts, axis=0) for parts in zip(*each, strict=True))
    return scale**2 * products, scale * moments


def _left(x: Floats, weight: Floats, y: Floats, coefficients: Floats) -> tuple[Floats, Floats]:
    """The residual of weighted readings (n_rows, n_outputs) beside columns X, and its products with W X."""
    residual = np.empty_like(y)

    def of_rows(rows: slice) -> Floats:
        w = weight if len(weight) == 1 else weight[rows]
        residual[rows] = y[rows] - w * (x[rows] @ coefficients)
        return np.asarray(x[rows].T @ (w * residual[rows]))

    slopes = sum(at_once(of_rows, blocks(len(x))))
    return residual, np.asarray(slopes)


def blocks(n_rows: int) -> list[slice]:
    """Rows at a time."""
    return [slice(first, min(first + BLOCK_ROWS, n_rows)) for first in range(0, n_rows, BLOCK_ROWS)]


def added_misfit(fewer: Fit, more: Fit, noise: np.ndarray) -> float:
    """Increase of χ² from the fit `more` to the fit `fewer`, outputs in units of `noise`."""
    return float((((fewer.residual**2).sum(axis=0) - (more.residual**2).sum(axis=0)) / noise**2).sum())


def _part(phi: np.ndarray, t: np.ndarray, y: np.ndarray) -> Part:
    size = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    q, r = orthonormal(phi / size)
    if phi.shape[1] and np.abs(np.diag(r)).min() < 1e-13:
        raise np.linalg.LinAlgError("modes that cannot be distinguished")
    qy, qt = q.T @ y, q.T @ t
    residual = y - q @ qy
    inverse = solve_triangular(r, np.eye(r.shape[0])) / size[:, None]
    if len(phi) < MANY_ROWS:
        orthogonal = t - q @ qt
        gram, slopes = orthogonal.T @ orthogonal, orthogonal.T @ residual
    else:
        gram, slopes = t.T @ t - qt.T @ qt, t.T @ residual
    return Part(residual, inverse @ qy, gram, slopes, inverse @ inverse.T, inverse @ qt, column_norms(t))


def column_norms(columns: np.ndarray) -> np.ndarray:
    """Norm of each column, without a further table of their size."""
    return np.asarray(np.sqrt(np.einsum("kc,kc->c", columns, columns)))


def normalised_columns(rows: np.ndarray) -> np.ndarray:
    """Columns scaled to unit length."""
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300))


def orthonormal(columns: np.ndarray) -> Pair:
    """Q and R of columns: by two Cholesky factorisations where well conditioned, else by Householder reflections.

    As accurate there as reflections, in a fraction of the time (Yamamoto et al., ETNA 44 (2015) 306).
    """
    q, r_total = columns, np.eye(columns.shape[1])
    try:
        for _ in range(2):
            r = np.linalg.cholesky(q.T @ q).T
            if r.size and np.diag(r).min() < MIN_ORTHOGONAL_LENGTH:
                raise np.linalg.LinAlgError("columns that are nearly dependent")
            q, r_total = q @ solve_triangular(r, np.eye(r.shape[0])), r @ r_total
    except np.linalg.LinAlgError:
        q, r_total = qr(columns, mode="economic", check_finite=False)
    return q, r_total


def normalised_basis(columns: np.ndarray) -> np.ndarray:
    """Orthonormal basis of columns scaled to unit length, (n_rows, n_columns)."""
    return orthonormal(normalised_columns(columns))[0]


def scaled_vectors(fit: Fit, kept: np.ndarray, derivative: np.ndarray) -> Pair:
    """Shapes of displacement, (n_outputs, n_kept), largest entry 1, and participation factors, (n_kept, n_excitations).

    y = Re Σ a z and H = Σ a l / 2 (s - λ) + conjugate: the participation factors take up the scale of the shape.
    `derivative` (n_outputs, 1) is the order of the time derivative of displacement that each output measures.
    """
    displacements = fit.amplitudes[:, kept] / fit.poles[kept] ** derivative
    shapes = normalised_shapes(displacements) if kept.size else displacements
    largest = np.abs(displacements).argmax(axis=0), np.arange(kept.size)
    return shapes, fit.participation[kept] * (0.5 * displacements[largest] / shapes[largest])[:, None]


def free_parameters(fit: Fit) -> np.ndarray:
    """Indices of the free unknowns, real parts first: pole and participation factors of each mode but the held one."""
    n, p = fit.participation.shape
    free = np.ones((n, p + 1), bool)
    free[np.arange(n), 1 + np.argmin(np.abs(fit.participation - 1.0), axis=1)] = False
    return np.flatnonzero(np.r_[free.ravel(), free.ravel()])


def tangent_weights(fit: Fit, part: Part) -> np.ndarray:
    """Coefficients of the tangents in the change of each output of one part with each unknown, (n_tangents, n_unknowns,
    n_outputs)."""
    n, q = fit.poles.size, fit.participation.shape[1] + 1
    alpha = np.repeat(part.coefficients[:n], q, axis=0)
    beta = np.repeat(part.coefficients[n : 2 * n], q, axis=0)
    k, size = np.arange(n * q), n * q
    changes = np.zeros((2 * size, 2 * size, alpha.shape[1]))
    changes[k, k], changes[size + k, k] = alpha, beta
    changes[k, size + k], changes[size + k, size + k] = beta, -alpha
    return changes


def normal_equations(fit: Fit, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton matrix and right-hand side of the free unknowns, outputs in units of their noise."""
    n, q = fit.poles.size, fit.participation.shape[1] + 1
    size = n * q
    h, g = np.zeros((2 * size, 2 * size)), np.zeros(2 * size)
    for part, outputs in fit.outputs():
        w = 1.0 / noise[outputs]
        a = np.repeat(part.coefficients[:n] * w, q, axis=0)
        b = np.repeat(part.coefficients[n : 2 * n] * w, q, axis=0)
        matrix, right = pole_blocks(a, b, part.gram, part.slopes[:size] * w, part.slopes[size:] * w)
        h += matrix
        g += right
    free = free_parameters(fit)
    return h[np.ix_(free, free)], g[free]


def search(
    data: Measurement,
    fit: Fit,
    noise: np.ndarray,
    most_steps: int = FIT.max_steps,
    time_limit: TimeLimit | None = None,
    negligible: float = FIT.cost_tolerance,
    is_vain: Callable[[Fit], bool] = lambda fit: False,
) -> Fit:
    """Least-squares fit over poles and participation factors, outputs in units of `noise`, from a fit of the same data.

    It ends where the expected decrease of χ² per value is negligible, or a fit `is_vain`.
    """
    held = fit.participation[np.arange(fit.poles.size), np.argmax(_strength(fit), axis=1)]
    if (held != 1.0).any():
        fit = projected(data, fit.poles, fit.participation / held[:, None])
    problem = _OutputError(data, noise, negligible)
    minimum = minimise(problem, fit, most_steps=most_steps, time_limit=time_limit, is_vain=is_vain)
    return replace(minimum.state, converged=minimum.converged, steps=minimum.steps)


def _strength(fit: Fit) -> np.ndarray:
    """Norm of the response of each mode to each excitation, (n_modes, n_excitations)."""
    squares = np.sum([part.sizes**2 for part in fit.parts], axis=0).reshape(2, fit.poles.size, -1).sum(axis=0)
    return np.asarray(np.abs(fit.participation) * np.sqrt(squares[:, 1:]))


class _OutputError:
    """The output-error problem of a measurement, as `searches.LeastSquares`."""

    def __init__(self, data: Measurement, noise: np.ndarray, least_decrease: float) -> None:
        self.data, self.noise, self.least_decrease = data, noise, least_decrease
        self.signal = float(((data.values / noise) ** 2).sum())
        self.into: np.ndarray | None = None

    def cost(self, state: Fit) -> float:
        return float(((state.residual / self.noise) ** 2).sum())

    def normal_equations(self, state: Fit) -> tuple[np.ndarray, np.ndarray]:
        return normal_equations(state, self.noise)

    def moved(self, state: Fit, step: np.ndarray) -> tuple[Fit | None, np.ndarray]:
        n, p = state.participation.shape
        full = np.zeros(2 * n * (p + 1))
        full[free_parameters(state)] = step
        change = (full[: full.size // 2] + 1j * full[full.size // 2 :]).reshape(n, p + 1)
        poles, participation = state.poles + change[:, 0], state.participation + change[:, 1:]
        highest, fastest_decay = self.data.highest, self.data.highest / np.pi
        growing = poles.real > FIT.max_growth * self.data.resolution / (2.0 * np.pi)
        if ((poles.imag <= 0) | (poles.imag >= highest) | (-poles.real > fastest_decay) | growing).any():
            return None, step
        if not (np.abs(participation) < FIT.max_participation_ratio).all():
            return None, step
        try:
            if self.into is None:
                self.into = np.empty((len(self.data.values), full.size + self.data.fixed.shape[1]), order="F")
            return projected(self.data, poles, participation, self.into), step
        except np.linalg.LinAlgError:
            return None, step

    def negligible(self, decrease: float, cost: float) -> bool:
        return decrease <= max(self.least_decrease * cost / self.data.values.size, FIT.round_off * self.signal)


def only(data: Measurement, fit: Fit, kept: np.ndarray) -> Fit:
    """The fit with some of its modes, in this order, by index or by flag; poles and participation factors unchanged."""
    return projected(data, fit.poles[kept], fit.participation[kept])


def settled(
    data: Measurement,
    fit: Fit,
    most_steps: int = FIT.max_steps,
    time_limit: TimeLimit | None = None,
    negligible: float = FIT.cost_tolerance,
) -> Fit:
    """The fit searched, reweighted by the noise it estimates, and searched again; unchanged where the time is up.

    A single output has no other to be weighted against.
    """
    for _ in range(2):
        if fit.poles.size == 0 or (time_limit is not None and time_limit.spent("refinement")):
            break
        noise = fit.noise
        fit = search(data, fit, noise, most_steps, time_limit, negligible)
        if fit.converged and noise.size == 1:
            break
    return fit
