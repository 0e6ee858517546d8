"""The delay of each input: whole samples from an ARX model, the fraction of a sample from the modes.

In the one-step prediction of y from its own past and from inputs, y_k = Σ_m A_m y_k-m + Σ_m B_m u_k-m, the
coefficients B_m of an input are zero up to its delay, whatever the modes (Ljung, System Identification, 2nd ed.,
section 10.3). A further fraction f of a sample multiplies each participation factor by e^{-λfΔt} and adds columns
u_k and u_k-1 to the modes (`known_inputs`), whose coefficients determine f. With a zero-order hold and a direct term
these do not depend on f; f is then the one that makes the modes most nearly real.
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
    """Constants of the estimation of delays."""

    most_lags: int = 60  # of the ARX model
    rows_each: int = 8  # rows for each of its coefficients, at least
    part: int = 4096  # rows of the data matrix held at once
    floor: float = 1e-5  # noise floor of each output, relative: -100 dB
    round_off: float = 1e-8  # of the ratio of an output to an input
    moves: float = 0.01  # of its peak, above which an input is nonzero
    real_modes: float = 1.0  # weight of the phase of the modes beside the χ² of the columns
    known: float = 100.0  # χ² of a mode at which it has half of that weight


DELAYS = DelaysSettings()
FRACTIONS = np.linspace(0.0, 1.0, 401)  # of a sample


def first_lags(records: Sequence[Record]) -> np.ndarray:
    """Lag in samples of the first significant response to each input, (n_inputs,); 0 where the records are too short.

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
            x, present = np.vstack(past), y[:, at]
            if gram.shape == (2, 2):
                gram, moment, squares = np.zeros((len(x), len(x))), np.zeros((len(x), m)), np.zeros((m, m))
            gram += x @ x.T
            moment += x @ present.T
            squares += present @ present.T
    gram[np.diag_indices_from(gram)] += DELAYS.floor**2 * np.diag(gram) + 1e-300
    scale = 1.0 / np.sqrt(np.diag(gram))
    factor = cho_factor(gram * np.outer(scale, scale))
    coefficients = scale[:, None] * cho_solve(factor, scale[:, None] * moment)
    residual_squares = squares - coefficients.T @ moment + DELAYS.floor**2 * np.diag(np.diag(squares))
    variance = np.diag(cho_solve(factor, np.eye(len(gram)))) * scale**2
    b, free = coefficients[lags * m :], max(rows - lags * len(records) - len(gram), 1)
    statistic = np.einsum("kj,kj->k", b, np.linalg.solve(residual_squares / free, b.T).T) / variance[lags * m :]
    significant = statistic.reshape(lags + 1, q) > chi2.isf(FALSE_ALARM / (lags * q), m)
    return np.where(significant.any(axis=0), np.argmax(significant, axis=0), 0)


def n_moving(records: Sequence[Record]) -> int:
    """Number of samples at which an input is nonzero, the least of all inputs."""
    sizes = np.abs(np.hstack([record.inputs for record in records]))
    return int((sizes > DELAYS.moves * sizes.max(axis=1, keepdims=True)).sum(axis=1).min())


def act_later(data: KnownInputs, fit: Fit) -> np.ndarray:
    """Whether each input acts later than in `data`, (n_inputs,): its column u_k-1 is significant.

    Args:
        data: with `any_fraction`.
        fit: to it.
    """
    columns, noise = _column_coefficients(data, fit)
    limit = chi2.isf(FALSE_ALARM / data.n_inputs, columns.shape[2])
    return np.asarray(((columns[1] / noise[1]) ** 2).sum(axis=1) > limit)


def _column_coefficients(data: KnownInputs, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of u_k and u_k-1, and their standard errors, (2, n_inputs, n_outputs)."""
    n, shape = 2 * fit.poles.size, (2, data.n_inputs, -1)
    noise = fixed_std(fit, *data.noise_ratios(fit))[: 2 * data.n_inputs]
    outputs, inputs = np.sqrt((data.values**2).mean(axis=0)), np.sqrt((data.fixed**2).mean(axis=0))
    least = DELAYS.round_off * outputs / np.maximum(inputs[: 2 * data.n_inputs, None], 1e-300)
    return fit.coefficients[n : n + 2 * data.n_inputs].reshape(shape), np.maximum(noise, least).reshape(shape)


def fractions(data: KnownInputs, fit: Fit, derivative: np.ndarray) -> np.ndarray:
    """Fraction of a sample by which each input acts later than in `data`, (n_inputs,), in [0, 1].

    Args:
        data: with `any_fraction`.
        fit: to it.
        derivative: (n_outputs, 1) order of the time derivative of displacement that each output measures.
    """
    q = data.n_inputs
    columns, noise = _column_coefficients(data, fit)
    phase, weight_of_phase = _phases(data, fit, derivative)
    cost = np.zeros((FRACTIONS.size, q))
    for k, f in enumerate(FRACTIONS):
        of_u, of_previous = np.array([_direct_coefficients(pole, data.dt, f, data.hold) for pole in fit.poles]).T
        l_r = fit.participation[:, :q] * np.exp(fit.poles * f * data.dt)[:, None]
        expected = [np.real((l_r * factor[:, None]).T @ fit.amplitudes.T) for factor in (of_u, of_previous)]
        weight = (1.0 - f, f) if data.hold == "first" else (0.0, 1.0)
        deviation = columns - expected
        if data.feedthrough:  # the direct term absorbs the component along its own column
            orthogonal = weight[1] * deviation[0] - weight[0] * deviation[1]
            cost[k] = (orthogonal**2 / ((weight[1] * noise[0]) ** 2 + (weight[0] * noise[1]) ** 2)).sum(axis=1)
        else:
            cost[k] = ((deviation / noise) ** 2).sum(axis=(0, 2))
        phases = 2.0 * (phase + fit.poles.imag[:, None] * f * data.dt)
        cost[k] -= DELAYS.real_modes * (weight_of_phase * np.cos(phases)).sum(axis=0)
    return np.asarray(FRACTIONS[np.argmin(cost, axis=0)])


def best_delays(
    start: Floats, delayed: Callable[[Floats], tuple[KnownInputs, Fit]], derivative: np.ndarray, budget: Budget
) -> Floats:
    """Maximum likelihood delay of each band-limited input, (n_inputs,) samples; 0 where not significantly different.

    Args:
        start: (n_inputs,) about which to search.
        delayed: the data with given delays, and its fit.
        derivative: (n_outputs, 1) order of the time derivative of displacement that each output measures.
    """

    def cost(delays: Floats) -> float:
        data, fit = delayed(delays)
        phases, weight_of_phase = _phases(data, fit, derivative)
        # the log-likelihood is scaled to the same number of rows
        return data.cost(fit) * n_rows / len(fit.residual) - DELAYS.real_modes * float(
            (weight_of_phase * np.cos(2.0 * phases)).sum()
        )

    delays_found, n_rows = start.astype(float), len(delayed(start)[1].residual)
    limit = chi2.isf(FALSE_ALARM / start.size, 1)
    for i in range(start.size):
        unit = np.eye(start.size)[i]

        def at(delay: float, unit: Floats = unit, rest: Floats = delays_found) -> float:
            return cost(np.where(unit > 0, delay, rest))

        # interpolation spreads a band-limited input ahead of its delay, so the first lag is too early
        whole = max(float(delays_found[i]), 0.0)
        middle_cost, after = at(whole), at(whole + 1.0)
        while after < middle_cost and whole < DELAYS.most_lags and not budget.spent("search for delays of the inputs"):
            whole, middle_cost, after = whole + 1.0, after, at(whole + 2.0)
        lowest = max(whole - 1.0, 0.0)
        best = minimize_scalar(at, bounds=(lowest, whole + 1.0), method="bounded", options={"xatol": 1e-3})
        without_delay = at(0.0) if lowest == 0.0 else np.inf
        delays_found[i] = best.x if best.fun < without_delay - limit else 0.0
    return delays_found


def _phases(data: KnownInputs, fit: Fit, derivative: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Phase of each participation factor relative to that of a real mode, and its weight, (n_modes, n_inputs) each."""
    q = data.n_inputs
    displacements = fit.amplitudes / fit.poles**derivative
    mean_phase = np.exp(-0.5j * np.angle((displacements**2).sum(axis=0)))
    statistic = statistic_of_each(fit)
    size = np.abs(fit.participation[:, :q]) ** 2
    weight = (statistic / (statistic + DELAYS.known))[:, None] * size / size.sum(axis=1, keepdims=True)
    return np.angle(1j * fit.participation[:, :q] / mean_phase[:, None]), weight


def _direct_coefficients(pole: complex, dt: float, fraction: float, hold: str) -> tuple[complex, complex]:
    """Coefficients of u_k and u_k-1 in the delayed response of a pole, beyond e^{-λfΔt} times that without delay."""
    h, f = (1.0 - fraction) * dt, fraction
    (c_0, c_1), _ = sources(pole, dt, hold)
    (of_0, of_1), _ = sources(pole, h, hold)
    factor = np.exp(-pole * f * dt)
    return of_1 * (1.0 - f) - factor * c_1, of_0 + of_1 * f - factor * c_0
