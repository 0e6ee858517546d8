"""Most likely modes of whatever drives them: poles, shapes and loads, in time or over frequency.

A mode answers what drives it by one complex swing s_r, which every output sees in proportion to its shape,

    y_j = Re Σ_r a_jr s_r + Σ_f d_jf v_f,      s_r = Σ_p l_rp x_p(λ_r),

x_p(λ) the answer of a pole λ to the p-th drive and v_f columns known beforehand. For given poles and loads the outputs
are linear in a and d, which drop out (variable projection, Golub & Pereyra 1973); s_r is analytic in λ_r and l_rp, so
one matrix of tangents T = ∂s_r/∂(λ_r, l_rp), projected on what the columns leave, gives the Gauss-Newton matrix H, and
H^-1 in the noise of the outputs is the Cramér-Rao bound. One load of each mode is held: the shape carries its scale.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve, qr, solve_triangular

MOST_STEPS = 60
# A step is small once it moves the estimate by less than a thousandth of its standard error.
SETTLED = 1e-6
ROUND_OFF = 1e-26

Pair = tuple[np.ndarray, np.ndarray]


class Drive(Protocol):
    """What a fit of modes needs to know of a measurement.

    Attributes:
        values: (n_rows, n_outputs) real readings, divided by their relative noise where `weights` is given.
        fixed: (n_rows, n_fixed) columns v_f.
        weights: (n_rows, n_outputs) inverse relative noise, or None where it is the same in all rows of an output.
        resolution: rad/s, what a measurement of this length tells apart.
        highest: rad/s, beyond which no pole is searched.
        cells: number of swings that could be told apart, for the chance of a false alarm.
    """

    values: np.ndarray
    fixed: np.ndarray
    weights: np.ndarray | None
    resolution: float
    highest: float
    cells: int

    def answers(self, pole: complex) -> Pair:
        """Real and imaginary parts of x_p(λ), (n_rows, n_drives) each."""
        ...

    def slopes(self, pole: complex, loads: np.ndarray) -> Pair:
        """∂/∂λ of Σ_p l_p x_p(λ), (n_rows,) each."""
        ...

    def candidates(self, residual: np.ndarray) -> np.ndarray:
        """Poles worth a try, (n_candidates,), residual in units of the noise."""
        ...

    def colour(self, residual: np.ndarray, pole: complex) -> float:
        """Noise power about a pole over its mean, at least 1."""
        ...


@dataclass(frozen=True, eq=False)
class Part:
    """Some outputs projected on the same columns."""

    residual: np.ndarray  # (n_rows, n_outputs)
    coefficients: np.ndarray  # (n_columns, n_outputs)
    gram: np.ndarray  # projected tangents among themselves
    slopes: np.ndarray  # tangents with the residual
    spread: np.ndarray  # (Φ^T Φ)^-1
    tilt: np.ndarray  # Φ^+ T


@dataclass(frozen=True, eq=False)
class Fit:
    """Modes as a fit left them: poles (n_modes,), loads (n_modes, n_drives), and the projections behind them."""

    poles: np.ndarray
    loads: np.ndarray
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
        """Standard deviation of what is left of each output, (n_outputs,)."""
        left = self.residual
        free = max(left.shape[0] - self.coefficients.shape[0] - free_parameters(self).size / left.shape[1], 1.0)
        squares = (left**2).sum(axis=0)
        return np.sqrt(np.maximum(squares, 1e-28 * squares.max() + 1e-300) / free)


def projected(drive: Drive, poles: np.ndarray, loads: np.ndarray) -> Fit:
    """The shapes that belong to given poles and loads, by least squares."""
    phi, t = columns(drive, poles, loads)
    if drive.weights is None:
        return Fit(poles, loads, (_part(phi, t, drive.values),))
    each = drive.weights.T[:, :, None]
    parts = [_part(w * phi, w * t, y[:, None]) for w, y in zip(each, drive.values.T)]
    return Fit(poles, loads, tuple(parts))


def columns(drive: Drive, poles: np.ndarray, loads: np.ndarray) -> Pair:
    """Swings and what is fixed, Φ (n_rows, n_columns), and tangents T (n_rows, n_tangents), not weighted."""
    answers = [drive.answers(pole) for pole in poles]
    slopes = [drive.slopes(pole, load) for pole, load in zip(poles, loads)]
    swings, tangents = [], []
    for k in (0, 1):  # real parts, imaginary parts
        whole = [a[0] @ load.real - a[1] @ load.imag for a, load in zip(answers, loads)]
        turned = [a[0] @ load.imag + a[1] @ load.real for a, load in zip(answers, loads)]
        swings += turned if k else whole
        tangents += [np.column_stack([s[k], a[k]]) for s, a in zip(slopes, answers)]
    phi = np.column_stack([*swings, drive.fixed]) if swings else drive.fixed
    return phi, np.hstack(tangents) if tangents else np.zeros((drive.values.shape[0], 0))


def _part(phi: np.ndarray, t: np.ndarray, y: np.ndarray) -> Part:
    size = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    q, r = qr(phi / size, mode="economic", check_finite=False)
    if phi.shape[1] and np.abs(np.diag(r)).min() < 1e-13:
        raise np.linalg.LinAlgError("modes that cannot be told apart")
    qy, qt = q.T @ y, q.T @ t
    rest = t - q @ qt
    residual = y - q @ qy
    inverse = solve_triangular(r, np.eye(r.shape[0])) / size[:, None]
    return Part(residual, inverse @ qy, rest.T @ rest, rest.T @ residual, inverse @ inverse.T, inverse @ qt)


def free_parameters(fit: Fit) -> np.ndarray:
    """Indices of the unknowns searched, real parts first: pole and loads of each mode but the load that is held."""
    n, p = fit.loads.shape
    free = np.ones((n, p + 1), bool)
    free[np.arange(n), 1 + _held(fit.loads)] = False
    return np.flatnonzero(np.r_[free.ravel(), free.ravel()])


def _held(loads: np.ndarray) -> np.ndarray:
    return np.argmin(np.abs(loads - 1.0), axis=1)


def moves(fit: Fit, part: Part) -> np.ndarray:
    """How each unknown moves the outputs of a part along the tangents, (n_tangents, n_unknowns, n_outputs)."""
    n, q = fit.poles.size, fit.loads.shape[1] + 1
    alpha = np.repeat(part.coefficients[:n], q, axis=0)
    beta = np.repeat(part.coefficients[n : 2 * n], q, axis=0)
    k, size = np.arange(n * q), n * q
    found = np.zeros((2 * size, 2 * size, alpha.shape[1]))
    found[k, k], found[size + k, k] = alpha, beta
    found[k, size + k], found[size + k, size + k] = beta, -alpha
    return found


def normal(fit: Fit, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton matrix and right-hand side of the free unknowns, outputs in units of their noise."""
    n, q = fit.poles.size, fit.loads.shape[1] + 1
    size, first = n * q, 0
    h, g = np.zeros((2 * size, 2 * size)), np.zeros(2 * size)
    for part in fit.parts:
        w = 1.0 / noise[first : first + part.residual.shape[1]]
        first += w.size
        a = np.repeat(part.coefficients[:n] * w, q, axis=0)
        b = np.repeat(part.coefficients[n : 2 * n] * w, q, axis=0)
        aa, ab, bb = a @ a.T, a @ b.T, b @ b.T
        (cc, cs), (sc, ss) = part.gram.reshape(2, size, 2, size).transpose(0, 2, 1, 3)
        h[:size, :size] += aa * cc + ab * cs + ab.T * sc + bb * ss
        h[size:, size:] += bb * cc - ab.T * cs - ab * sc + aa * ss
        cross = ab * cc - aa * cs + bb * sc - ab.T * ss
        h[:size, size:] += cross
        h[size:, :size] += cross.T
        x, y = part.slopes[:size] * w, part.slopes[size:] * w
        g[:size] += (a * x + b * y).sum(axis=1)
        g[size:] += (b * x - a * y).sum(axis=1)
    free = free_parameters(fit)
    return h[np.ix_(free, free)], g[free]


def search(drive: Drive, poles: np.ndarray, loads: np.ndarray, noise: np.ndarray, most_steps: int = MOST_STEPS) -> Fit:
    """Levenberg-Marquardt over poles and loads, outputs in units of `noise`."""
    heard = np.abs(loads) * [np.linalg.norm(np.vstack(drive.answers(pole)), axis=0) for pole in poles]
    loads = loads / loads[np.arange(poles.size), np.argmax(heard, axis=1)][:, None]
    fit = projected(drive, poles, loads)
    cost, damping, small, steps = _cost(fit, noise), 1e-3, False, 0
    signal = float(((drive.values / noise) ** 2).sum())
    while steps < most_steps:
        steps += 1
        h, g = normal(fit, noise)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(h), 1e-300))
        while True:
            try:
                factor = cho_factor(h * np.outer(scale, scale) + damping * np.eye(g.size))
            except np.linalg.LinAlgError:
                damping = max(8.0 * damping, 1e-9)
                continue
            move = scale * cho_solve(factor, scale * g)
            small = float(move @ g) <= max(SETTLED * cost / drive.values.size, ROUND_OFF * signal)
            trial = _moved(drive, fit, move)
            cost_there = np.inf if trial is None else _cost(trial, noise)
            if cost_there <= cost or small or damping > 1e8:
                break
            damping *= 8.0
        if trial is not None and cost_there <= cost:
            fit, cost = trial, cost_there
        damping = max(0.1 * damping, 1e-12)
        if small or damping > 1e6:
            break
    return replace(fit, converged=bool(small), steps=steps)


def _moved(drive: Drive, fit: Fit, move: np.ndarray) -> Fit | None:
    """The fit after a step; None where a pole leaves what is searched or modes cannot be told apart."""
    n, p = fit.loads.shape
    whole = np.zeros(2 * n * (p + 1))
    whole[free_parameters(fit)] = move
    step = (whole[: whole.size // 2] + 1j * whole[whole.size // 2 :]).reshape(n, p + 1)
    poles, loads = fit.poles + step[:, 0], fit.loads + step[:, 1:]
    fastest = drive.highest / np.pi
    if (poles.imag <= 0).any() or (poles.imag >= drive.highest).any() or (-poles.real > fastest).any():
        return None
    if (poles.real > 20.0 * drive.resolution / (2.0 * np.pi)).any():
        return None
    try:
        return projected(drive, poles, loads)
    except np.linalg.LinAlgError:
        return None


def _cost(fit: Fit, noise: np.ndarray) -> float:
    return float(((fit.residual / noise) ** 2).sum())


def settled(drive: Drive, fit: Fit, most_steps: int = MOST_STEPS) -> Fit:
    """Searched, weighted by the noise found, and searched again."""
    if fit.poles.size == 0:
        return fit
    for _ in range(2):
        fit = search(drive, fit.poles, fit.loads, fit.noise, most_steps)
    return fit
