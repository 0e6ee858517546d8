"""The modes of records with known inputs, the delay of each input, and its course between samples.

Whole samples are those of an ARX model, the fraction of a sample follows from the modes.

In the one-step prediction of y from its own past and from inputs, y_k = Σ_m A_m y_k-m + Σ_m B_m u_k-m, the
coefficients B_m of an input are zero up to its delay, whatever the modes (Ljung, System Identification, 2nd ed.,
section 10.3). A further fraction f of a sample multiplies each participation factor by e^{-λfΔt} and adds columns
u_k and u_k-1 to the modes (`known_inputs`), whose coefficients determine f. With a zero-order hold and a direct term
these do not depend on f; f is then the one that makes the modes most nearly real.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from workbench.arrays import Floats
from workbench.identification.input_output.excitation import n_moving
from workbench.identification.input_output.fit_errors import fixed_std, statistic_of_each
from workbench.identification.input_output.known_inputs import KnownInputs, sources
from workbench.identification.input_output.modal_fit import Fit, projected, settled
from workbench.identification.input_output.model_order import ORDER, SelectedModes, SelectionOptions
from workbench.identification.input_output.selection import select, select_strongest, subspace_start
from workbench.identification.signal.modal_estimates import time_derivatives
from workbench.identification.signal.searches import FALSE_ALARM, SELECTION, TimeLimit
from workbench.records.record import HOLDS, Record


@dataclass(frozen=True)
class DelaysSettings:
    """Constants of the estimation of delays."""

    rounds: int = 4  # of delays of band-limited inputs and the modes of a subspace model
    max_lags: int = 60  # of the ARX model
    row_ratio: int = 8  # rows for each of its coefficients, at least
    block_rows: int = 4096  # of the data matrix held at once
    round_off: float = 1e-8  # of the ratio of an output to an input
    phase_weight: float = 1.0  # of the phase of the modes beside the χ² of the columns
    half_weight_statistic: float = 100.0  # χ² of a mode at which it has half of that weight


DELAYS = DelaysSettings()
DELAY_SEARCH = "search for delays of the inputs"
FRACTIONS = np.linspace(0.0, 1.0, 401)  # of a sample
HOLD_IN_WORDS = {
    "zero": "held between samples",
    "first": "linear between samples",
    "band-limited": "band-limited, as behind an anti-alias filter",
}


def select_with_delays(
    data: KnownInputs, options: SelectionOptions, strongest: SelectedModes | None
) -> tuple[KnownInputs, SelectedModes]:
    """The data with estimated input delays, and the modes.

    A delay by a fraction of a sample is estimated where the first response to an input is later than without delay, or
    where the input a sample earlier explains part of the residual.
    """
    time_limit, first = options.time_limit, _first_lags(data.records)
    if data.hold == "band-limited":
        return _select_with_band_limited_delays(data, first, options, strongest)
    if data.hold == "zero" and not first.any():
        return select(data, options, strongest)
    whole = np.maximum(first - (0 if data.hold == "first" else 1), 0)
    without_delay: tuple[KnownInputs, SelectedModes] | None = None
    delayed = data.delayed_by(whole, any_fraction=True)
    strongest = select_strongest(delayed, options)
    if not whole.any():
        if strongest.fit.poles.size == 0:
            return select(data, options)
        if not _act_later(delayed, strongest.fit).any():
            without_delay = undelayed, selected = select(data, options, select_strongest(data, options, strongest.fit))
            if selected.fit.poles.size <= strongest.fit.poles.size:
                return without_delay
            with_fraction = _with_free_fraction(undelayed, selected.fit, undelayed.delays, time_limit)
            if not _act_later(*with_fraction).any() or time_limit.spent(DELAY_SEARCH):
                return without_delay
    undelayed = data
    data, selected = select(delayed, options, strongest)
    fit = selected.fit
    if fit.poles.size == 0:
        return without_delay if without_delay is not None else (data.delayed_by(whole), selected)
    whole, fraction = _whole_and_fraction(data, fit, whole, time_limit)
    if not whole.any() and not fraction.any() and not time_limit.spent(DELAY_SEARCH):
        if without_delay is not None:
            return without_delay
        return select(undelayed, options, select_strongest(undelayed, options, fit))
    delayed = data.delayed_by(whole + fraction)
    return delayed, selected.refitted(settled(delayed, _for_other_delays(delayed, data, fit), time_limit=time_limit))


def _select_with_band_limited_delays(
    data: KnownInputs, first: Floats, options: SelectionOptions, strongest: SelectedModes | None
) -> tuple[KnownInputs, SelectedModes]:
    """The data with estimated delays of band-limited inputs, and the modes.

    The fraction of a sample is a parameter of its own here: no pair of fixed columns can represent it.
    """
    delayed = data.delayed_by(first) if first.any() else data
    for _ in range(DELAYS.rounds):  # so that no mode is fitted to the effect of a delay
        few, before = subspace_start(delayed, options), delayed
        if few.poles.size:
            delayed, _ = _with_best_delays(delayed, few, options.time_limit)
        if delayed is before:
            break
    delayed, selected = select(delayed, options, strongest if delayed is data else None)
    if not selected.fit.poles.size:
        return delayed, selected
    improved, fit = _with_best_delays(delayed, selected.fit, options.time_limit)
    if improved is delayed:
        return delayed, selected
    return improved, selected.refitted(settled(improved, fit, time_limit=options.time_limit))


def _with_best_delays(data: KnownInputs, fit: Fit, time_limit: TimeLimit) -> tuple[KnownInputs, Fit]:
    """The data with the maximum likelihood delays of band-limited inputs, and the fit with participation factors to
    match; a delay is 0 where it is not significantly different."""

    def cost(i: int, delay: float) -> float:
        """Twice the negative log-likelihood of a delay of input i, scaled to the same number of rows."""
        other = data.delayed_by(np.where(np.arange(delays.size) == i, delay, delays))
        moved = _for_other_delays(other, data, fit)
        phases, weight_of_phase = _phases(other, moved)
        real_modes = DELAYS.phase_weight * float((weight_of_phase * np.cos(2.0 * phases)).sum())
        return other.cost(moved) * len(fit.residual) / len(moved.residual) - real_modes

    delays = data.delays.copy()
    limit = chi2.isf(FALSE_ALARM / delays.size, 1)
    for i in range(delays.size):
        at = partial(cost, i)
        # interpolation spreads a band-limited input ahead of its delay, so the first lag is too early
        whole = max(float(delays[i]), 0.0)
        middle_cost, after = at(whole), at(whole + 1.0)
        while after < middle_cost and whole < DELAYS.max_lags and not time_limit.spent(DELAY_SEARCH):
            whole, middle_cost, after = whole + 1.0, after, at(whole + 2.0)
        lowest = max(whole - 1.0, 0.0)
        best = minimize_scalar(at, bounds=(lowest, whole + 1.0), method="bounded", options={"xatol": 1e-3})
        without_delay = at(0.0) if lowest == 0.0 else np.inf
        delays[i] = best.x if best.fun < without_delay - limit else 0.0
    if (delays == data.delays).all():
        return data, fit
    other = data.delayed_by(delays)
    return other, _for_other_delays(other, data, fit)


def _whole_and_fraction(data: KnownInputs, fit: Fit, whole: Floats, time_limit: TimeLimit) -> tuple[Floats, Floats]:
    """Delay of each input: whole samples, and the fraction of a sample, (n_inputs,) each, from a fit with any fraction.

    The first response detected is a sample late where the response before it was below the noise.
    """
    fraction = _fractions(data, fit)
    doubtful = (whole > 0) & (fraction == 0)
    while doubtful.any() and not time_limit.spent(DELAY_SEARCH):
        data, fit = _with_free_fraction(data, fit, whole - doubtful, time_limit)
        fraction_before = _fractions(data, fit)
        reduced = doubtful & (fraction_before < 1.0)
        whole, fraction = whole - reduced, np.where(reduced, fraction_before, fraction)
        doubtful = reduced & (whole > 0) & (fraction == 0)
    return whole, fraction


def _first_lags(records: Sequence[Record]) -> np.ndarray:
    """Lag in samples of the first significant response to each input, (n_inputs,); 0 where records are too short."""
    m, q = records[0].n_outputs, records[0].n_inputs
    rows = sum(record.n_samples for record in records)
    moved = n_moving(records)  # impulses are too short to show lags
    shortest = min(record.n_samples for record in records)
    lags = min(DELAYS.max_lags, rows // (DELAYS.row_ratio * (m + q)), moved // DELAYS.row_ratio, shortest // 4)
    if lags < 3:
        return np.zeros(q, int)
    size = lags * m + (lags + 1) * q
    gram, moment, squares = np.zeros((size, size)), np.zeros((size, m)), np.zeros((m, m))
    for record in records:
        y = record.outputs - record.outputs.mean(axis=1, keepdims=True)
        for first in range(lags, record.n_samples, DELAYS.block_rows):
            at = np.arange(first, min(first + DELAYS.block_rows, record.n_samples))
            past = [y[:, at - k] for k in range(1, lags + 1)] + [record.inputs[:, at - k] for k in range(lags + 1)]
            x, present = np.vstack(past), y[:, at]
            gram += x @ x.T
            moment += x @ present.T
            squares += present @ present.T
    gram[np.diag_indices_from(gram)] += ORDER.noise_floor**2 * np.diag(gram) + 1e-300
    scale = 1.0 / np.sqrt(np.diag(gram))
    factor = cho_factor(gram * np.outer(scale, scale))
    coefficients = scale[:, None] * cho_solve(factor, scale[:, None] * moment)
    residual_squares = squares - coefficients.T @ moment + ORDER.noise_floor**2 * np.diag(np.diag(squares))
    variance = np.diag(cho_solve(factor, np.eye(size))) * scale**2
    b, free = coefficients[lags * m :], max(rows - lags * len(records) - size, 1)
    statistic = np.einsum("kj,kj->k", b, np.linalg.solve(residual_squares / free, b.T).T) / variance[lags * m :]
    significant = statistic.reshape(lags + 1, q) > chi2.isf(FALSE_ALARM / (lags * q), m)
    return np.where(significant.any(axis=0), np.argmax(significant, axis=0), 0)


def _act_later(data: KnownInputs, fit: Fit) -> np.ndarray:
    """Whether each input acts later than in `data`, of `any_fraction`, (n_inputs,): its column u_k-1 is significant."""
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


def _fractions(data: KnownInputs, fit: Fit) -> Floats:
    """Fraction of a sample by which each input acts later than in `data`, of `any_fraction`, (n_inputs,)."""
    q = data.n_inputs
    columns, noise = _column_coefficients(data, fit)
    phase, weight_of_phase = _phases(data, fit)
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
        cost[k] -= DELAYS.phase_weight * (weight_of_phase * np.cos(phases)).sum(axis=0)
    return np.where(_act_later(data, fit), FRACTIONS[np.argmin(cost, axis=0)], 0.0)


def _phases(data: KnownInputs, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Phase of each participation factor relative to that of a real mode, and its weight, (n_modes, n_inputs) each."""
    q = data.n_inputs
    displacements = fit.amplitudes / fit.poles ** time_derivatives(data.records[0].output_channels)[:, None]
    mean_phase = np.exp(-0.5j * np.angle((displacements**2).sum(axis=0)))
    statistic = statistic_of_each(fit)
    size = np.abs(fit.participation[:, :q]) ** 2
    weight = (statistic / (statistic + DELAYS.half_weight_statistic))[:, None] * size / size.sum(axis=1, keepdims=True)
    return np.angle(1j * fit.participation[:, :q] / mean_phase[:, None]), weight


def _direct_coefficients(pole: complex, dt: float, fraction: float, hold: str) -> tuple[complex, complex]:
    """Coefficients of u_k and u_k-1 in the delayed response of a pole, beyond e^{-λfΔt} times that without delay."""
    h, f = (1.0 - fraction) * dt, fraction
    (c_0, c_1), _ = sources(pole, dt, hold)
    (of_0, of_1), _ = sources(pole, h, hold)
    factor = np.exp(-pole * f * dt)
    return of_1 * (1.0 - f) - factor * c_1, of_0 + of_1 * f - factor * c_0


def _with_free_fraction(data: KnownInputs, fit: Fit, delays: Floats, time_limit: TimeLimit) -> tuple[KnownInputs, Fit]:
    """The data with inputs delayed by whole samples and any fraction, and a fit just precise enough for decisions."""
    other = data.delayed_by(delays, any_fraction=True)
    return other, settled(
        other, _for_other_delays(other, data, fit), SELECTION.trial_steps, time_limit, SELECTION.trial_tolerance
    )


def _for_other_delays(other: KnownInputs, data: KnownInputs, fit: Fit) -> Fit:
    """The fit to `data` with participation factors changed to the input delays of `other`."""
    turned = fit.participation.copy()
    turned[:, : data.n_inputs] *= np.exp(np.outer(fit.poles, other.delays - data.delays) * data.dt)
    return projected(other, fit.poles, turned)


def delay_remarks(data: KnownInputs) -> tuple[str, ...]:
    """A remark on the inputs that act late."""
    names = data.records[0].input_names
    late = [f"{names[i]} {d:.2f} samples ({d * data.dt:.3g} s)" for i, d in enumerate(data.delays) if d > 0]
    return (f"inputs act late, by {', '.join(late)}: the model has these delays",) if late else ()


def hold_remarks(data: KnownInputs, fit: Fit, threshold: float, time_limit: TimeLimit) -> tuple[str, ...]:
    """A remark where another course of the inputs between samples is likelier, by the threshold of twice the
    log-likelihood ratio.

    The same modes are fitted with the same noise spectrum and as many parameters for each hold. With a direct term,
    zero- and first-order hold give the same outputs with other residues, so these two cannot be distinguished. The
    error of the residues by a false hold does not depend on the noise: a band-limited input taken for a first-order
    hold gives each residue 1/sinc²(f Δt) times its true size.
    """
    costs: dict[str, float] = {}
    for hold in HOLDS:
        if hold == data.hold or (data.has_direct and "band-limited" not in (hold, data.hold)):
            continue
        # the delay may be an artefact of the false hold
        whole = np.floor(data.delays)
        for delays in np.unique([data.delays, whole, np.maximum(whole - 1.0, 0.0)], axis=0):
            if time_limit.spent("check of how inputs run between samples"):
                return ()
            other = replace(data, hold=hold).delayed_by(delays)
            try:
                start = projected(other, fit.poles, fit.participation)
                refitted = settled(other, start, SELECTION.trial_steps, time_limit, SELECTION.trial_tolerance)
            except np.linalg.LinAlgError:
                continue
            # a fractional delay has a row fewer
            cost = other.cost(refitted) * len(fit.residual) / len(refitted.residual)
            costs[hold] = min(cost, costs.get(hold, np.inf))
    best = min(costs, key=lambda hold: costs[hold], default=data.hold)
    if best == data.hold or costs[best] > data.cost(fit) - threshold:
        return ()
    return (
        f"the records show inputs {HOLD_IN_WORDS[best]}, not {HOLD_IN_WORDS[data.hold]} as input_hold={data.hold!r}"
        f" says: residues and modal masses are wrong, the more the higher the mode; give input_hold={best!r}",
    )
