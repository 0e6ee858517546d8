"""Most likely modes of whatever drives them: poles, shapes and loads, in time or over frequency.

A mode answers what drives it by one complex swing s_r, which every output sees in proportion to its shape,

    y_j = Re Σ_r a_jr s_r + Σ_f d_jf v_f,      s_r = Σ_p l_rp x_p(λ_r),

x_p(λ) the answer of a pole λ to the p-th drive and v_f columns known beforehand. For given poles and loads the outputs
are linear in a and d, which drop out (variable projection, Golub & Pereyra 1973); s_r is analytic in λ_r and l_rp, so
one matrix of tangents T = ∂s_r/∂(λ_r, l_rp), projected on what the columns leave, gives the Gauss-Newton matrix H, and
H^-1 in the noise of the outputs is the Cramér-Rao bound. One load of each mode is held: the shape carries its scale.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve, qr, solve_triangular
from scipy.stats import chi2

from workbench.structure.modes import mac

FALSE_ALARM = 1e-3
MOST_DAMPED = 0.3
MOST_STEPS = 60
# A step is small once it moves the estimate by less than a thousandth of its standard error.
SETTLED = 1e-6
ROUND_OFF = 1e-26
MOST_REFUSALS = 3
MOST_ROUNDS = 4
SAME_SHAPE = 0.95

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
    answers = [drive.answers(pole) for pole in poles]
    slopes = [drive.slopes(pole, load) for pole, load in zip(poles, loads)]
    swings, tangents = [], []
    for k in (0, 1):  # real parts, imaginary parts
        whole = [a[0] @ load.real - a[1] @ load.imag for a, load in zip(answers, loads)]
        turned = [a[0] @ load.imag + a[1] @ load.real for a, load in zip(answers, loads)]
        swings += turned if k else whole
        tangents += [np.column_stack([s[k], a[k]]) for s, a in zip(slopes, answers)]
    rows = drive.values.shape[0]
    phi = np.column_stack([*swings, drive.fixed]) if swings else drive.fixed
    t = np.hstack(tangents) if tangents else np.zeros((rows, 0))
    if drive.weights is None:
        return Fit(poles, loads, (_part(phi, t, drive.values),))
    each = drive.weights.T[:, :, None]
    parts = [_part(w * phi, w * t, y[:, None]) for w, y in zip(each, drive.values.T)]
    return Fit(poles, loads, tuple(parts))


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


@dataclass(frozen=True, eq=False)
class Told:
    """Modes told from noise: the fit, the evidence of each mode, and the limit noise alone exceeds by false alarm."""

    fit: Fit
    evidence: np.ndarray
    limit: float


def tell(drive: Drive, *, most_modes: int, false_alarm: float = FALSE_ALARM) -> Told:
    """The modes whose likelihood ratio is more than noise would give, taken in one by one and each tried again."""
    outputs, drives = drive.values.shape[1], drive.answers((-0.1 + 0.5j) * drive.highest)[0].shape[1]
    limit = float(chi2.isf(false_alarm / drive.cells, 2 * (outputs + drives)))
    fit = projected(drive, np.zeros(0, complex), np.zeros((0, drives), complex))
    for _ in range(MOST_ROUNDS):
        grown = _grown(drive, fit, limit, most_modes)
        kept = _pruned(drive, settled(drive, grown), limit)
        ended = kept.poles.size <= fit.poles.size or kept.poles.size == grown.poles.size
        fit = kept
        if ended:
            break
    order = np.argsort(np.abs(fit.poles))
    evidence = np.array([_evidence(fit, r) for r in order])
    fit = replace(projected(drive, fit.poles[order], fit.loads[order]), converged=fit.converged, steps=fit.steps)
    return Told(fit, evidence, limit)


def _grown(drive: Drive, fit: Fit, limit: float, most_modes: int) -> Fit:
    refused: list[complex] = []
    while fit.poles.size < most_modes and len(refused) < MOST_REFUSALS:
        tries = [pole for pole in _to_try(drive, fit) if not _near(drive, pole, refused)]
        basis, left = basis_of(drive, fit), fit.residual / fit.noise
        scored = [(*_added(drive, basis, left, pole), pole) for pole in tries]
        if not scored:
            break
        strength, load, pole = max(scored, key=lambda item: item[0])
        colour = drive.colour(fit.residual / fit.noise, pole)
        if strength < 0.5 * limit * colour:
            break
        try:
            trial = search(drive, np.append(fit.poles, pole), np.vstack([fit.loads, load]), fit.noise, 20)
            gain = ratio(drive, fit, trial)
        except np.linalg.LinAlgError:
            gain = 0.0
        if gain < limit * colour or no_modes(drive, trial).any():
            refused.append(pole)
        else:
            fit, refused = trial, []
    return fit


def _to_try(drive: Drive, fit: Fit) -> np.ndarray:
    """What stands out of the residual, and what may hide beside the modes there already."""
    width = np.maximum(np.abs(fit.poles.real), 0.5 * drive.resolution)
    beside = [fit.poles + 1j * k * width for k in (-4.0, -2.0, -1.0, 1.0, 2.0, 4.0)]
    tries = np.concatenate([drive.candidates(fit.residual / fit.noise), *beside])
    return tries[(tries.imag > 0) & (tries.imag < drive.highest) & (-tries.real < MOST_DAMPED * np.abs(tries))]


def _near(drive: Drive, pole: complex, others: Sequence[complex]) -> bool:
    return any(abs(pole.imag - o.imag) < max(drive.resolution, 0.5 * abs(o.real)) for o in others)


def _added(drive: Drive, basis: np.ndarray, left: np.ndarray, pole: complex) -> tuple[float, np.ndarray]:
    """χ² by which one more pole lowers the misfit, each output answering each drive as it likes; the loads it wants.

    Of its answer only what stands off the basis of the columns there already is new.
    """
    real, imaginary = drive.answers(pole)
    columns, size = np.hstack([real, imaginary]), real.shape[1]
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    apart = columns / scale - basis @ (basis.T @ (columns / scale))
    if drive.weights is not None:
        left = left * drive.weights
    u, s, vt = np.linalg.svd(apart, full_matrices=False)
    good = s > 1e-4 * max(s[0], 1e-3)
    seen = u.T[good] @ left
    c = (vt.T[:, good] / s[good]) @ seen / scale[:, None]
    heard = np.hypot(scale[:size], scale[size:])
    load = np.linalg.svd((c[:size] - 1j * c[size:]) * heard[:, None])[0][:, 0] / heard
    return float((seen**2).sum()), load


def basis_of(drive: Drive, fit: Fit) -> np.ndarray:
    """Orthonormal columns (n_rows, n_columns) that span the swings of a fit and what is fixed beside them."""
    swings = []
    for pole, load in zip(fit.poles, fit.loads):
        real, imaginary = drive.answers(pole)
        swings += [real @ load.real - imaginary @ load.imag, real @ load.imag + imaginary @ load.real]
    phi = np.column_stack([*swings, drive.fixed]) if swings else drive.fixed
    return np.linalg.qr(phi / np.maximum(np.linalg.norm(phi, axis=0), 1e-300))[0]


def ratio(drive: Drive, before: Fit, after: Fit) -> float:
    """Twice the log likelihood ratio, the noise of each output unknown."""
    n = drive.values.shape[0]
    first, second = ((fit.residual**2).sum(axis=0) for fit in (before, after))
    floor = 1e-24 * (drive.values**2).sum(axis=0) + 1e-300
    return float(n * np.log((first + floor) / (second + floor)).sum())


def no_modes(drive: Drive, fit: Fit) -> np.ndarray:
    """Which are damped beyond what rings, or split another mode that has their shape and their band."""
    poles = fit.poles
    shapes = fit.amplitudes / fit.noise[:, None]
    strength = np.array([_evidence(fit, r) for r in range(poles.size)])
    band = np.abs(poles.real)[:, None] + np.abs(poles.real) + drive.resolution
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < band
    alike = mac(shapes, shapes) * mac(fit.loads.T, fit.loads.T)
    one = shapes.shape[0] * fit.loads.shape[1] == 1
    split = near & (alike > SAME_SHAPE) & (strength[:, None] < strength) & (not one)
    return split.any(axis=1) | (-poles.real > MOST_DAMPED * np.abs(poles))


def _evidence(fit: Fit, r: int) -> float:
    """χ² of a mode's shape in the noise, poles and loads held."""
    both, noise, found = [r, fit.poles.size + r], fit.noise, 0.0
    first = 0
    for part in fit.parts:
        c = part.coefficients[both] / noise[first : first + part.residual.shape[1]]
        first += c.shape[1]
        found += float((c * np.linalg.solve(part.spread[np.ix_(both, both)], c)).sum())
    return found


def _pruned(drive: Drive, fit: Fit, limit: float) -> Fit:
    """Without the modes that the likelihood does not miss."""
    while fit.poles.size:
        trials = []
        damped = no_modes(drive, fit)
        for r, pole in enumerate(fit.poles):
            near = np.abs(np.delete(fit.poles, r) - pole).min(initial=np.inf) < 2.0 * abs(pole.real)
            need = limit * drive.colour(fit.residual / fit.noise, pole)
            if damped[r] or near or _evidence(fit, r) < 4.0 * need:
                rest = np.delete(np.arange(fit.poles.size), r)
                without = settled(drive, projected(drive, fit.poles[rest], fit.loads[rest]), 12)
                gain = ratio(drive, without, fit)
                if damped[r] or gain < need:
                    trials.append((gain, without))
        if not trials:
            return fit
        fit = min(trials, key=lambda item: item[0])[1]
    return fit


def covariance(fit: Fit) -> np.ndarray:
    """Of the free unknowns, the Cramér-Rao bound at the estimate."""
    h = normal(fit, fit.noise)[0]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(h), 1e-300))
    return np.linalg.pinv(h * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)


def errors(fit: Fit, figures: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Covariance of figures of (poles, loads, amplitudes) by their exact first-order change.

    Args:
        figures: analytic up to conjugation, (poles (n,), loads (n, n_drives), amplitudes (n_outputs, n)) -> real (k,).
    """
    n, p = fit.loads.shape
    free, noise = free_parameters(fit), fit.noise
    root = _root(covariance(fit))
    size = n * (p + 1)
    at = (fit.poles, fit.loads, fit.amplitudes)
    base = figures(*at)
    changes = []
    drift = np.concatenate([-np.einsum("ct,tkj->ckj", part.tilt, moves(fit, part)) for part in fit.parts], axis=2)
    for column in root.T:
        whole = np.zeros(2 * size)
        whole[free] = column
        step = (whole[:size] + 1j * whole[size:]).reshape(n, p + 1)
        c = np.einsum("ckj,k->cj", drift, whole)
        changes.append((step[:, 0], step[:, 1:], (c[:n] - 1j * c[n : 2 * n]).T))
    first = 0
    for part in fit.parts:
        spread = _root(part.spread[: 2 * n, : 2 * n])
        for j in range(part.residual.shape[1]):
            for column in spread.T:
                a = np.zeros_like(fit.amplitudes)
                a[first + j] = noise[first + j] * (column[:n] - 1j * column[n:])
                changes.append((np.zeros_like(fit.poles), np.zeros_like(fit.loads), a))
        first += part.residual.shape[1]
    found = []
    for change in changes:
        # Central differences of a figure along one direction of the error ellipsoid, at a thousandth of its length.
        above, below = (figures(*(x + h * d for x, d in zip(at, change))) for h in (1e-3, -1e-3))
        found.append((above - below) / 2e-3)
    jacobian = np.array(found).reshape(len(changes), base.size)
    return jacobian.T @ jacobian


def _root(matrix: np.ndarray) -> np.ndarray:
    """R with R R^T = matrix, which round-off may have made singular."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    return size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
