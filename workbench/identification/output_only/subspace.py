"""Modes of outputs under unknown forces: canonical variate analysis over model orders and sampling rates.

Past p_t = (y_{t-1}, ..., y_{t-k}) and future f_t = (y_t, ..., y_{t+k-1}) of a process of order n have n canonical
correlations. With R_pp = L L^T and the right singular vectors V of R_ff^-½ R_fp L^-T (Larimore 1990; Van Overschee &
De Moor 1996, chapter 3),

    x_t = V_n^T L^-1 p_t,   E x x^T = I,   A_n = E x_{t+1} x_t^T,   C_n = E y_t x_t^T

are the models of all orders n at once, from covariances R(k) = E y_{t+k} y_t^T alone: each lower order is a corner of
the highest. Its weights make it as accurate as maximum likelihood in long records (Bauer 2005), where covariance-driven
identification without weights is not. Modes far below the sampling rate need a longer past, so the outputs are analysed
at slower rates too.

Standard errors come from the record itself: each block of it is left out in turn (the jackknife; Künsch 1989).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import next_fast_len
from scipy.linalg import solve_triangular
from scipy.signal import resample_poly
from scipy.stats import t as student

from workbench.identification.signal.searches import Budget
from workbench.structure.modes import mac


@dataclass(frozen=True)
class SubspaceSettings:
    """Constants of canonical variate analysis over orders and rates."""

    past: int = 40  # samples of past and of future
    least_order: int = 8  # least and most of the highest model order
    most_order: int = 40
    slower: int = 4  # times slower each rate is than the one before
    slowest: int = 16  # times slower the slowest rate is than that of the record
    least_samples: int = 400  # that must be left at a slower rate: ten times the past
    passed: float = 0.7  # of the Nyquist frequency, up to which the filter of a slower rate leaves the modes alone
    regularised: float = 1e-9  # of the variance of each output, lest outputs without noise be singular
    least_periods: float = 1.0  # of a mode that the past must hold, unless there is no slower rate
    most_damped: float = 0.25  # damping ratio above which a pole is no mode
    near: float = 0.02  # relative distance of a mode from order to order
    alike: float = 0.7  # MAC of a mode from order to order
    presence: float = 0.4  # least share of all orders
    stays: float = 0.75  # likewise of those from the first on at which it is found
    most_taken: int = 10  # orders that a mode's errors are estimated at
    averaged: int = 3  # of these, those of the least errors, that it is the mean of
    blocks: int = 12  # of a record that are left out in turn
    least_blocks: int = 4  # that there must be time for


SUBSPACE = SubspaceSettings()


@dataclass(frozen=True, eq=False)
class StablePole:
    """A mode that stays over the orders.

    Attributes:
        pole: λ, rad/s.
        shape: (n_outputs,) complex, as the outputs measure it.
        presence: share of the orders at which it was found.
        statistic: twice the log likelihood ratio of the record with and without it, predicted by one step.
        orders, poles: of the models that it is found in.
        slower: its sampling interval over that of the record.
        variance: (2, 2) of Re λ and Im λ; nan until estimated.
    """

    pole: complex
    shape: np.ndarray
    presence: float
    statistic: float
    orders: tuple[int, ...]
    poles: tuple[complex, ...]
    slower: int
    variance: np.ndarray


class Subspace:
    """The models of all orders, at all rates, of outputs (n_outputs, n_samples)."""

    def __init__(self, outputs: np.ndarray, sample_time: float) -> None:
        self.sample_time = sample_time
        self.n_outputs, self.n_samples = outputs.shape
        values, slower = outputs - outputs.mean(axis=1, keepdims=True), 1
        self._outputs: dict[int, np.ndarray] = {}
        while slower == 1 or (values.shape[1] >= SUBSPACE.least_samples and slower <= SUBSPACE.slowest):
            self._outputs[slower] = values
            values, slower = resample_poly(values, 1, SUBSPACE.slower, axis=1), SUBSPACE.slower * slower

    def stable(self) -> list[StablePole]:
        """Poles that stay over the orders, each once: from the rate at which it is found at most orders."""
        found: list[StablePole] = []
        for slower in self._outputs:
            found += self._at_one_rate(slower)
        each: list[StablePole] = []
        for mode in sorted(found, key=lambda mode: -mode.presence):
            if not any(_same(mode, other) for other in each):
                each.append(mode)
        return each

    def with_errors(self, modes: Sequence[StablePole], budget: Budget | None = None) -> list[StablePole]:
        """The same with their variance; from the blocks that there is time for, and four at least.

        Scaled so that a normal interval of 95 % is Student's, of one degree of freedom less than there are blocks, and
        by what blocks that are not much longer than a mode decays have to do with one another.
        """
        if not modes:
            return []
        without: list[list[np.ndarray]] = []
        for b in range(SUBSPACE.blocks):
            if budget is not None and b >= SUBSPACE.least_blocks and budget.spent("standard errors"):
                break
            without.append(self._without(b, modes))
        n, freedom = len(without), len(without) - 1
        scale = (student.ppf(0.975, freedom) / student.ppf(0.975, np.inf)) ** 2 * (SUBSPACE.blocks - 1) / n
        found = []
        for r, mode in enumerate(modes):
            each = np.array([one[r] for one in without])
            apart = each - each.mean(axis=0)
            # A low order leaves out a little, a high one fits noise.
            error = scale * (np.abs(apart) ** 2).sum(axis=0) + np.abs(np.array(mode.poles) - mode.pole) ** 2
            best = np.argsort(error)[: SUBSPACE.averaged]
            apart = apart[:, best].mean(axis=1)
            both = np.stack([apart.real, apart.imag])
            pole = complex(np.array(mode.poles)[best].mean())
            block = 2.0 * abs(pole.real) * self.n_samples * self.sample_time / SUBSPACE.blocks
            variance = scale / (1.0 - (1.0 - np.exp(-block)) / block) * both @ both.T
            found.append(replace(mode, pole=pole, variance=variance))
        return found

    def _without(self, block: int, modes: Sequence[StablePole]) -> list[np.ndarray]:
        """The poles of modes at each of their orders, without one block of the record."""
        found = [np.zeros(0)] * len(modes)
        for slower in {mode.slower for mode in modes}:
            left, dt = self._outputs[slower].copy(), slower * self.sample_time
            first, last = (left.shape[1] * b // SUBSPACE.blocks for b in (block, block + 1))
            left[:, first:last] = 0.0
            model = Model(_covariances(left, 2 * SUBSPACE.past + 1))
            here = [r for r, mode in enumerate(modes) if mode.slower == slower]
            every = {n: model.poles(n)[0] / dt for n in {n for r in here for n in modes[r].orders}}
            for r in here:
                near = zip(modes[r].orders, modes[r].poles, strict=True)
                found[r] = np.array([_nearest(every[n], pole) for n, pole in near])
        return found

    def _at_one_rate(self, slower: int) -> list[StablePole]:
        dt = slower * self.sample_time
        top = np.pi * (1.0 if slower == 1 else SUBSPACE.passed) / dt
        low = 0.0 if slower == max(self._outputs) else 2.0 * np.pi * SUBSPACE.least_periods / (SUBSPACE.past * dt)
        model = Model(_covariances(self._outputs[slower], 2 * SUBSPACE.past + 1))
        groups: list[list[StablePole]] = []
        orders = range(2, model.highest_order(self._outputs[slower].shape[1]) + 1, 2)
        for order in reversed(orders):
            log_mu, shapes, gains = model.poles(order, statistic=True)
            for pole, shape, gain in zip(log_mu / dt, shapes.T, gains, strict=True):
                if not (0 < -pole.real < SUBSPACE.most_damped * abs(pole) and low < abs(pole) < top):
                    continue
                gain *= self.n_samples / slower
                alone = (order,), (complex(pole),)
                mode = StablePole(complex(pole), shape, 0.0, gain, *alone, slower, np.full((2, 2), np.nan))
                near = [(_apart(mode, group[-1]), group) for group in groups if group[-1].orders[0] != order]
                near = [pair for pair in near if pair[0] < SUBSPACE.near]
                if near:
                    min(near, key=lambda pair: pair[0])[1].append(mode)
                else:
                    groups.append([mode])
        return [_median(group, orders) for group in groups if _stays(group, orders)]


def _nearest(poles: np.ndarray, pole: complex) -> complex:
    """The one of `poles` nearest to a pole; 0, a large error, where a low order has none that oscillates."""
    return complex(poles[np.argmin(np.abs(poles - pole))]) if poles.size else 0j


def _stays(group: Sequence[StablePole], orders: range) -> bool:
    possible = sum(order >= group[-1].orders[0] for order in orders)
    return len(group) >= max(SUBSPACE.presence * len(orders), SUBSPACE.stays * possible)


def _median(group: Sequence[StablePole], orders: range) -> StablePole:
    """The mode nearest the median of a group."""
    poles = np.array([mode.pole for mode in group])
    nearest = int(np.argmin(np.abs(poles - np.median(poles.real) - 1j * np.median(poles.imag))))
    taken, share = group[:: 1 + len(group) // SUBSPACE.most_taken], len(group) / len(orders)
    each = tuple(mode.orders[0] for mode in taken), tuple(mode.pole for mode in taken)
    return replace(group[nearest], presence=share, orders=each[0], poles=each[1])


class Model:
    """Models of all orders of covariances (n_lags, n_outputs, n_outputs)."""

    def __init__(self, lags: np.ndarray) -> None:
        m = lags.shape[1]
        lags = lags.copy()
        lags[0] += SUBSPACE.regularised * np.diag(np.diag(lags[0]))
        both = np.concatenate([lags[:0:-1].transpose(0, 2, 1), lags])
        i, j = np.indices((SUBSPACE.past, SUBSPACE.past))
        past, future, between = (
            both[at + len(lags) - 1].transpose(0, 2, 1, 3).reshape(m * SUBSPACE.past, m * SUBSPACE.past)
            for at in (j - i, i - j, i + j + 1)
        )
        root, ahead = np.linalg.cholesky(past), np.linalg.cholesky(future)
        half = solve_triangular(ahead, between, lower=True)
        _, self._correlations, canonical = np.linalg.svd(solve_triangular(root, half.T, lower=True).T)
        state = solve_triangular(root.T, canonical[: SUBSPACE.most_order].T, lower=False).T
        self._now, self._c = lags[0], between[:m] @ state.T
        self._a = state @ np.vstack([between[:m], past[:-m]]) @ state.T

    def highest_order(self, n_samples: int) -> int:
        """Twice the number of canonical correlations above those of noise (Johnstone 2001), within limits."""
        noise = 2.0 * np.sqrt(self._c.shape[0] * SUBSPACE.past / n_samples)
        return int(np.clip(2 * np.sum(self._correlations > noise), SUBSPACE.least_order, SUBSPACE.most_order))

    def poles(self, order: int, statistic: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """ln μ and shapes (n_outputs, n_poles) of the poles above the real axis, and the statistic of each a sample."""
        c = self._c[:, :order]
        mu, vectors = np.linalg.eig(self._a[:order, :order])
        up = np.flatnonzero(mu.imag > 0)
        gains = np.zeros(up.size)
        if statistic:
            least = np.linalg.slogdet(self._now - c @ c.T)[1]
            for k, r in enumerate(up):
                # The states that are left are those orthogonal to both left eigenvectors of the mode.
                gone = np.linalg.qr(np.linalg.inv(vectors)[r][:, None].view(float).reshape(order, 2))[0]
                part = c @ gone
                gains[k] = np.linalg.slogdet(self._now - c @ c.T + part @ part.T)[1] - least
        return np.log(mu[up]), c @ vectors[:, up], gains


def _apart(one: StablePole, other: StablePole) -> float:
    """Relative distance of two poles, infinite where the shapes differ."""
    if mac(one.shape[:, None], other.shape[:, None])[0, 0] < SUBSPACE.alike:
        return np.inf
    return abs(one.pole - other.pole) / abs(other.pole)


def _same(one: StablePole, other: StablePole) -> bool:
    half_widths = 0.5 * (abs(one.pole.real) + abs(other.pole.real)) / abs(other.pole)
    return _apart(one, other) < 0.25 * SUBSPACE.near + half_widths


def _covariances(outputs: np.ndarray, n_lags: int) -> np.ndarray:
    """R(k) = Σ y(t + k) y(t)^T / n, k from 0 on, (n_lags, n_outputs, n_outputs): biased, so positive definite."""
    n = outputs.shape[1]
    lines = np.fft.rfft(outputs, next_fast_len(n + n_lags, real=True))
    found = np.fft.irfft(lines[:, None] * lines.conj(), next_fast_len(n + n_lags, real=True))
    return np.ascontiguousarray(found[..., :n_lags].transpose(2, 0, 1) / n)
