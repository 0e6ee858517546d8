"""Modes of outputs under unknown forces: canonical variate analysis over model orders and sampling rates.

Past p_t = (y_{t-1}, ..., y_{t-k}) and future f_t = (y_t, ..., y_{t+k-1}) of a process of order n have n canonical
correlations. With R_pp = L L^T and the right singular vectors V of R_ff^-½ R_fp L^-T (Larimore 1990; Van Overschee &
De Moor 1996, chapter 3),

    x_t = V_n^T L^-1 p_t,   E x x^T = I,   A_n = E x_{t+1} x_t^T,   C_n = E y_t x_t^T

are the models of all orders n at once, from covariances R(k) = E y_{t+k} y_t^T alone: the matrices of a lower order are
the leading blocks of those of the highest. The weights make the estimates asymptotically as accurate as maximum
likelihood (Bauer 2005); covariance-driven identification without weights is less accurate. Modes far below the sampling
rate need a longer past, so the outputs are analysed at reduced rates too.

Standard errors come from the block jackknife, which leaves out each block of the record in turn (Künsch 1989).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import next_fast_len
from scipy.linalg import solve_triangular
from scipy.signal import resample_poly
from scipy.stats import t as student

from workbench.identification.signal.searches import TimeLimit
from workbench.structure.modes import mac


@dataclass(frozen=True)
class SubspaceSettings:
    """Constants of canonical variate analysis over orders and rates."""

    past: int = 40  # samples of the past, and of the future
    min_order: int = 8  # lower and upper limit of the highest model order
    max_order: int = 40
    rate_ratio: int = 4  # of each sampling rate to the next
    max_decimation: int = 16  # ratio of the record's sampling rate to the lowest
    min_samples: int = 400  # that must remain at a reduced rate: ten times the past
    passband_share: float = 0.7  # of the Nyquist frequency, up to which the decimation filter does not affect modes
    regularisation: float = 1e-9  # of the variance of each output, so that outputs without noise are not singular
    min_periods: float = 1.0  # of a mode within the past, unless there is no lower rate
    max_damping: float = 0.25  # ratio above which a pole is no mode
    pole_tolerance: float = 0.02  # relative distance of a mode from order to order
    min_mac: float = 0.7  # of a mode from order to order
    min_presence: float = 0.4  # share of all orders at which a mode is found
    min_persistence: float = 0.75  # share of the orders from the first at which it is found
    max_jackknifed: int = 10  # orders at which a mode's errors are estimated
    averaged_orders: int = 3  # of least error, over which a pole is averaged
    jackknife_blocks: int = 12
    min_blocks: int = 4  # that are evaluated whatever the time


SUBSPACE = SubspaceSettings()


@dataclass(frozen=True, eq=False)
class StablePole:
    """A mode that is stable over the model orders."""

    pole: complex  # λ, rad/s
    shape: np.ndarray  # (n_outputs,) complex, in the quantities of the outputs
    presence: float  # share of the orders at which it was found
    statistic: float  # twice the log-likelihood ratio, by one-step prediction, with and without the mode
    orders: tuple[int, ...]  # at which it was found
    poles: tuple[complex, ...]  # at each of these
    decimation: int  # ratio of the record's sampling rate to the one at which it was found
    variance: np.ndarray  # (2, 2) of Re λ and Im λ; nan until estimated


class Subspace:
    """State-space models of outputs (n_outputs, n_samples) at all model orders and sampling rates."""

    def __init__(self, outputs: np.ndarray, sample_time: float) -> None:
        self.sample_time = sample_time
        self.n_outputs, self.n_samples = outputs.shape
        values, decimation = outputs - outputs.mean(axis=1, keepdims=True), 1
        self._outputs: dict[int, np.ndarray] = {}
        while decimation == 1 or (values.shape[1] >= SUBSPACE.min_samples and decimation <= SUBSPACE.max_decimation):
            self._outputs[decimation] = values
            values, decimation = resample_poly(values, 1, SUBSPACE.rate_ratio, axis=1), SUBSPACE.rate_ratio * decimation

    def stable(self) -> list[StablePole]:
        """The poles that are stable over the orders, each from the sampling rate of its largest presence."""
        candidates = [mode for decimation in self._outputs for mode in self._at_one_rate(decimation)]
        distinct: list[StablePole] = []
        for mode in sorted(candidates, key=lambda mode: -mode.presence):
            if not any(_same(mode, other) for other in distinct):
                distinct.append(mode)
        return distinct

    def with_errors(self, modes: Sequence[StablePole], time_limit: TimeLimit) -> list[StablePole]:
        """The modes with their variance by the jackknife, from as many blocks as the time allows, four at least.

        The variance is scaled so that a normal interval of 95 % is that of Student's t with n_blocks - 1 degrees of
        freedom, and by the correlation between blocks that are not much longer than the decay time of a mode.
        """
        if not modes:
            return []
        jackknife: list[list[np.ndarray]] = []
        for b in range(SUBSPACE.jackknife_blocks):
            if b >= SUBSPACE.min_blocks and time_limit.spent("standard errors"):
                break
            jackknife.append(self._poles_without(b, modes))
        n = len(jackknife)
        scale = (student.ppf(0.975, n - 1) / student.ppf(0.975, np.inf)) ** 2 * (SUBSPACE.jackknife_blocks - 1) / n
        estimates = []
        for r, mode in enumerate(modes):
            replicates = np.array([one[r] for one in jackknife])
            deviation = replicates - replicates.mean(axis=0)
            # A low order has bias, a high order variance by over-fitting.
            error = scale * (np.abs(deviation) ** 2).sum(axis=0) + np.abs(np.array(mode.poles) - mode.pole) ** 2
            best = np.argsort(error)[: SUBSPACE.averaged_orders]
            deviation = deviation[:, best].mean(axis=1)
            parts = np.stack([deviation.real, deviation.imag])
            pole = complex(np.array(mode.poles)[best].mean())
            block = 2.0 * abs(pole.real) * self.n_samples * self.sample_time / SUBSPACE.jackknife_blocks
            variance = scale / (1.0 - (1.0 - np.exp(-block)) / block) * parts @ parts.T
            estimates.append(replace(mode, pole=pole, variance=variance))
        return estimates

    def _poles_without(self, block: int, modes: Sequence[StablePole]) -> list[np.ndarray]:
        """The poles of each mode at its orders, (n_orders,) each, from the record without one block."""
        poles = [np.zeros(0)] * len(modes)
        for decimation in {mode.decimation for mode in modes}:
            remaining, dt = self._outputs[decimation].copy(), decimation * self.sample_time
            first, last = (remaining.shape[1] * b // SUBSPACE.jackknife_blocks for b in (block, block + 1))
            remaining[:, first:last] = 0.0
            model = Model(_covariances(remaining, 2 * SUBSPACE.past + 1))
            of_rate = [r for r, mode in enumerate(modes) if mode.decimation == decimation]
            poles_by_order = {n: model.poles(n)[0] / dt for n in {n for r in of_rate for n in modes[r].orders}}
            for r in of_rate:
                targets = zip(modes[r].orders, modes[r].poles, strict=True)
                poles[r] = np.array([_nearest(poles_by_order[n], pole) for n, pole in targets])
        return poles

    def _at_one_rate(self, decimation: int) -> list[StablePole]:
        """The poles that are stable over the orders at one sampling rate."""
        dt = decimation * self.sample_time
        top = np.pi * (1.0 if decimation == 1 else SUBSPACE.passband_share) / dt
        low = 0.0 if decimation == max(self._outputs) else 2.0 * np.pi * SUBSPACE.min_periods / (SUBSPACE.past * dt)
        model = Model(_covariances(self._outputs[decimation], 2 * SUBSPACE.past + 1))
        groups: list[list[StablePole]] = []
        orders = range(2, model.highest_order(self._outputs[decimation].shape[1]) + 1, 2)
        for order in reversed(orders):
            log_mu, shapes, gains = model.poles(order, statistic=True)
            for pole, shape, gain in zip(log_mu / dt, shapes.T, gains, strict=True):
                if not (0 < -pole.real < SUBSPACE.max_damping * abs(pole) and low < abs(pole) < top):
                    continue
                gain *= self.n_samples / decimation
                found = complex(pole)
                mode = StablePole(found, shape, 0.0, gain, (order,), (found,), decimation, np.full((2, 2), np.nan))
                others = [group for group in groups if group[-1].orders[0] != order]
                distances = [_distance(mode, group[-1]) for group in others]
                if min(distances, default=np.inf) < SUBSPACE.pole_tolerance:
                    others[int(np.argmin(distances))].append(mode)
                else:
                    groups.append([mode])
        return [_median_mode(group, orders) for group in groups if _is_stable(group, orders)]


def _nearest(poles: np.ndarray, pole: complex) -> complex:
    """The one of `poles` nearest to a pole; 0, which counts as a large error, where there is none."""
    return complex(poles[np.argmin(np.abs(poles - pole))]) if poles.size else 0j


def _is_stable(group: Sequence[StablePole], orders: range) -> bool:
    """Whether the poles of a group are present at enough of the model orders."""
    possible = sum(order >= group[-1].orders[0] for order in orders)
    return len(group) >= max(SUBSPACE.min_presence * len(orders), SUBSPACE.min_persistence * possible)


def _median_mode(group: Sequence[StablePole], orders: range) -> StablePole:
    """The mode nearest the median of a group, with the orders and poles for its errors."""
    poles = np.array([mode.pole for mode in group])
    nearest = int(np.argmin(np.abs(poles - np.median(poles.real) - 1j * np.median(poles.imag))))
    taken = group[:: 1 + len(group) // SUBSPACE.max_jackknifed]
    orders_taken, poles_taken = zip(*((mode.orders[0], mode.pole) for mode in taken))
    return replace(group[nearest], presence=len(group) / len(orders), orders=orders_taken, poles=poles_taken)


class Model:
    """State-space models of all orders from covariances R(k) (n_lags, n_outputs, n_outputs)."""

    def __init__(self, lags: np.ndarray) -> None:
        m = lags.shape[1]
        lags = lags.copy()
        lags[0] += SUBSPACE.regularisation * np.diag(np.diag(lags[0]))
        both = np.concatenate([lags[:0:-1].transpose(0, 2, 1), lags])
        i, j = np.indices((SUBSPACE.past, SUBSPACE.past))
        past, future, between = (
            both[at + len(lags) - 1].transpose(0, 2, 1, 3).reshape(m * SUBSPACE.past, m * SUBSPACE.past)
            for at in (j - i, i - j, i + j + 1)
        )
        root, future_root = np.linalg.cholesky(past), np.linalg.cholesky(future)
        whitened = solve_triangular(future_root, between, lower=True)
        _, self._correlations, canonical = np.linalg.svd(solve_triangular(root, whitened.T, lower=True).T)
        state = solve_triangular(root.T, canonical[: SUBSPACE.max_order].T, lower=False).T
        self._covariance, self._c = lags[0], between[:m] @ state.T
        self._a = state @ np.vstack([between[:m], past[:-m]]) @ state.T

    def highest_order(self, n_samples: int) -> int:
        """Twice the number of canonical correlations above those of noise (Johnstone 2001), within limits."""
        noise = 2.0 * np.sqrt(self._c.shape[0] * SUBSPACE.past / n_samples)
        return int(np.clip(2 * np.sum(self._correlations > noise), SUBSPACE.min_order, SUBSPACE.max_order))

    def poles(self, order: int, statistic: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The poles of a model in the upper half plane, as ln μ (n_poles,) of the discrete poles μ.

        With their shapes (n_outputs, n_poles) and the test statistic of each per sample (n_poles,), if asked for.
        """
        c = self._c[:, :order]
        mu, vectors = np.linalg.eig(self._a[:order, :order])
        up = np.flatnonzero(mu.imag > 0)
        gains = np.zeros(up.size)
        if statistic:
            log_det = np.linalg.slogdet(self._covariance - c @ c.T)[1]
            for k, r in enumerate(up):
                # Without the mode the state is restricted to the complement of its two left eigenvectors.
                removed = np.linalg.qr(np.linalg.inv(vectors)[r][:, None].view(float).reshape(order, 2))[0]
                part = c @ removed
                gains[k] = np.linalg.slogdet(self._covariance - c @ c.T + part @ part.T)[1] - log_det
        return np.log(mu[up]), c @ vectors[:, up], gains


def _distance(one: StablePole, other: StablePole) -> float:
    """Relative distance of two poles; infinite where their shapes differ."""
    if mac(one.shape[:, None], other.shape[:, None])[0, 0] < SUBSPACE.min_mac:
        return np.inf
    return abs(one.pole - other.pole) / abs(other.pole)


def _same(one: StablePole, other: StablePole) -> bool:
    """Whether poles of two sampling rates are the same mode, to within half a bandwidth."""
    half_widths = 0.5 * (abs(one.pole.real) + abs(other.pole.real)) / abs(other.pole)
    return _distance(one, other) < 0.25 * SUBSPACE.pole_tolerance + half_widths


def _covariances(outputs: np.ndarray, n_lags: int) -> np.ndarray:
    """Covariances R(k) = Σ y(t + k) y(t)^T / n for k ≥ 0, (n_lags, n_outputs, n_outputs).

    The biased estimate is positive definite.
    """
    n = outputs.shape[1]
    size = next_fast_len(n + n_lags, real=True)
    lines = np.fft.rfft(outputs, size)
    covariances = np.fft.irfft(lines[:, None] * lines.conj(), size)
    return np.ascontiguousarray(covariances[..., :n_lags].transpose(2, 0, 1) / n)
