"""How late each input acts: whole samples from an ARX model, the fraction of a sample from the modes.

In the one-step prediction of y from its own past and from inputs, y_k = Σ_m A_m y_k-m + Σ_m B_m u_k-m, the
coefficients B_m of an input are zero up to its delay, whatever the modes (Ljung, System Identification, 2nd ed.,
section 10.3). The fraction f of a sample more turns each participation factor by e^{-λfΔt} and leaves two columns, u_k
and u_k-1, beside the modes (`known_inputs`): the columns fitted say what f was. Inputs held between samples, with a
direct term, leave nothing to tell the fraction by; it is then the one that makes the modes most nearly real.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from workbench.arrays import Floats
from workbench.identification.input_output.fit_errors import fixed_std
from workbench.identification.input_output.known_inputs import KnownInputs, sources
from workbench.identification.input_output.modal_fit import Fit
from workbench.identification.input_output.model_order import statistic_of_each
from workbench.identification.signal.searches import FALSE_ALARM, Budget
from workbench.records.record import Record


@dataclass(frozen=True)
class DelaysSettings:
    """Constants of the search for delays."""

    most_lags: int = 60  # of the ARX model
    rows_each: int = 8  # rows for each of its coefficients, at least
    part: int = 4096  # rows of one part of its sums
    floor: float = 1e-5  # of each output, taken for noise in any case: -100 dB
    round_off: float = 1e-8  # of the ratio of an output to an input
    moves: float = 0.01  # of its peak, from which on an input moves
    real_modes: float = 1.0  # weight of real modes beside what the columns say
    known: float = 100.0  # χ² of a mode from which it has half of that weight


DELAYS = DelaysSettings()
TRIED = np.linspace(0.0, 1.0, 401)  # fractions of a sample


def first_lags(records: Sequence[Record]) -> np.ndarray:
    """Lag in samples from which on the outputs respond to each input, (n_inputs,); 0 where too few samples tell it.

    Args:
        records: of the same inputs and outputs at one rate.
    """
    m, q = records[0].n_outputs, records[0].n_inputs
    rows = sum(record.n_samples for record in records)
    moved = n_moving(records)  # impulses are too short to show lags
    shortest = min(record.n_samples for record in records)
    lags = min(DELAYS.most_lags, rows // (DELAYS.rows_each * (m + q)), moved // DELAYS.rows_each, shortest // 4)
    if lags < 3:
        return np.zeros(q, int)
    gram, moment, squares = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2))
    for record in records:
        y = record.outputs - record.outputs.mean(axis=1, keepdims=True)
        for first in range(lags, record.n_samples, DELAYS.part):
            at = np.arange(first, min(first + DELAYS.part, record.n_samples))
            past = [y[:, at - k] for k in range(1, lags + 1)] + [record.inputs[:, at - k] for k in range(lags + 1)]
            x, now = np.vstack(past), y[:, at]
            if gram.shape == (2, 2):
                gram, moment, squares = np.zeros((len(x), len(x))), np.zeros((len(x), m)), np.zeros((m, m))
            gram += x @ x.T
            moment += x @ now.T
            squares += now @ now.T
    gram[np.diag_indices_from(gram)] += DELAYS.floor**2 * np.diag(gram) + 1e-300
    scale = 1.0 / np.sqrt(np.diag(gram))
    factor = cho_factor(gram * np.outer(scale, scale))
    found = scale[:, None] * cho_solve(factor, scale[:, None] * moment)
    left = squares - found.T @ moment + DELAYS.floor**2 * np.diag(np.diag(squares))
    spread = np.diag(cho_solve(factor, np.eye(len(gram)))) * scale**2
    b, free = found[lags * m :], max(rows - lags * len(records) - len(gram), 1)
    statistic = np.einsum("kj,kj->k", b, np.linalg.solve(left / free, b.T).T) / spread[lags * m :]
    acts = statistic.reshape(lags + 1, q) > chi2.isf(FALSE_ALARM / (lags * q), m)
    return np.where(acts.any(axis=0), np.argmax(acts, axis=0), 0)


def n_moving(records: Sequence[Record]) -> int:
    """Samples at which the input that rests longest moves."""
    sizes = np.abs(np.hstack([record.inputs for record in records]))
    return int((sizes > DELAYS.moves * sizes.max(axis=1, keepdims=True)).sum(axis=1).min())


def act_later(data: KnownInputs, fit: Fit) -> np.ndarray:
    """Whether each input acts later than `data` says, (n_inputs,): its column a sample later is not noise.

    Args:
        data: with `any_fraction`.
        fit: to it.
    """
    columns, noise = _columns(data, fit)
    limit = chi2.isf(FALSE_ALARM / data.n_inputs, columns.shape[2])
    return np.asarray(((columns[1] / noise[1]) ** 2).sum(axis=1) > limit)


def _columns(data: KnownInputs, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of u_k and u_k-1, and their standard errors, (2, n_inputs, n_outputs)."""
    n, shape = 2 * fit.poles.size, (2, data.n_inputs, -1)
    noise = fixed_std(fit, *data.noise_ratios(fit))[: 2 * data.n_inputs]
    outputs, inputs = np.sqrt((data.values**2).mean(axis=0)), np.sqrt((data.fixed**2).mean(axis=0))
    least = DELAYS.round_off * outputs / np.maximum(inputs[: 2 * data.n_inputs, None], 1e-300)
    return fit.coefficients[n : n + 2 * data.n_inputs].reshape(shape), np.maximum(noise, least).reshape(shape)


def fractions(data: KnownInputs, fit: Fit, derivative: np.ndarray) -> np.ndarray:
    """Fraction of a sample by which each input acts later than `data` says, (n_inputs,), in [0, 1].

    Args:
        data: with `any_fraction`.
        fit: to it.
        derivative: (n_outputs, 1) of displacement, that each output measures.
    """
    q = data.n_inputs
    columns, noise = _columns(data, fit)
    phase, known = _phases(data, fit, derivative)
    cost = np.zeros((TRIED.size, q))
    for k, f in enumerate(TRIED):
        now, before = np.array([_columns_left(pole, data.dt, f, data.hold) for pole in fit.poles]).T
        l_r = fit.participation[:, :q] * np.exp(fit.poles * f * data.dt)[:, None]
        wanted = [np.real((l_r * of[:, None]).T @ fit.amplitudes.T) for of in (now, before)]
        weight = (1.0 - f, f) if data.hold == "first" else (0.0, 1.0)
        left = columns - wanted
        if data.may_have_feedthrough:  # the direct term takes what goes along its own columns
            across = weight[1] * left[0] - weight[0] * left[1]
            cost[k] = (across**2 / ((weight[1] * noise[0]) ** 2 + (weight[0] * noise[1]) ** 2)).sum(axis=1)
        else:
            cost[k] = ((left / noise) ** 2).sum(axis=(0, 2))
        turned = 2.0 * (phase + fit.poles.imag[:, None] * f * data.dt)
        cost[k] -= DELAYS.real_modes * (known * np.cos(turned)).sum(axis=0)
    return np.asarray(TRIED[np.argmin(cost, axis=0)])


def best_delays(
    start: Floats, moved: Callable[[Floats], tuple[KnownInputs, Fit]], derivative: np.ndarray, budget: Budget
) -> Floats:
    """Samples by which each band-limited input acts late, (n_inputs,); 0 where that is as likely.

    Args:
        start: (n_inputs,) about which to search.
        moved: the inputs at some delays, and the modes turned to them.
        derivative: (n_outputs, 1) of displacement, that each output measures.
    """

    def cost(delays: Floats) -> float:
        data, fit = moved(delays)
        turned, known = _phases(data, fit, derivative)
        # a delay has a few rows fewer
        return data.cost(fit) * n_rows / len(fit.residual) - DELAYS.real_modes * float(
            (known * np.cos(2.0 * turned)).sum()
        )

    found, n_rows = start.astype(float), len(moved(start)[1].residual)
    limit = chi2.isf(FALSE_ALARM / start.size, 1)
    for i in range(start.size):
        unit = np.eye(start.size)[i]

        def at(delay: float, unit: Floats = unit, rest: Floats = found) -> float:
            return cost(np.where(unit > 0, delay, rest))

        # what comes before the delay in a sinc makes the first lag too early
        middle = max(float(found[i]), 0.0)
        middle_cost, after = at(middle), at(middle + 1.0)
        while after < middle_cost and middle < DELAYS.most_lags and not budget.spent("search for delays of the inputs"):
            middle, middle_cost, after = middle + 1.0, after, at(middle + 2.0)
        lowest = max(middle - 1.0, 0.0)
        best = minimize_scalar(at, bounds=(lowest, middle + 1.0), method="bounded", options={"xatol": 1e-3})
        in_time = at(0.0) if lowest == 0.0 else np.inf
        found[i] = best.x if best.fun < in_time - limit else 0.0
    return found


def _phases(data: KnownInputs, fit: Fit, derivative: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Phase of each participation factor beside that of a real mode, and its weight, (n_modes, n_inputs) each."""
    q = data.n_inputs
    seen = fit.amplitudes / fit.poles**derivative
    turn = np.exp(-0.5j * np.angle((seen**2).sum(axis=0)))
    statistic = statistic_of_each(fit)
    size = np.abs(fit.participation[:, :q]) ** 2
    known = (statistic / (statistic + DELAYS.known))[:, None] * size / size.sum(axis=1, keepdims=True)
    return np.angle(1j * fit.participation[:, :q] / turn[:, None]), known


def _columns_left(pole: complex, dt: float, fraction: float, hold: str) -> tuple[complex, complex]:
    """Of u_k and of u_k-1, what the response late by a fraction has beside e^{-λfΔt} times the one in time."""
    h, f = (1.0 - fraction) * dt, fraction
    (c_0, c_1), _ = sources(pole, dt, hold)
    (of_0, of_1), _ = sources(pole, h, hold)
    turned = np.exp(-pole * f * dt)
    return of_1 * (1.0 - f) - turned * c_1, of_0 + of_1 * f - turned * c_0
