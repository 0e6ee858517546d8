"""Maximum likelihood refinement of the modes of free decays, with standard errors at the Cramér-Rao bound.

In white noise the maximum likelihood modes minimise the sum of squares of the residual y_j(t) - Re Σ_r a_jr e^{λ_r t}.
The amplitudes are linear parameters, eliminated by variable projection (Golub & Pereyra 1973). The search is over the
2 n_modes parameters σ_r, ω_dr of λ = -σ + iω_d alone, however many sensors there are. With columns
Φ = [e^{-σt} cos ω_d t, e^{-σt} sin ω_d t] all derivatives of Φ lie in the span of tΦ, so one matrix

    G = (tΦ)^T (I - Φ Φ^+) (tΦ)                                       (2 n_modes, 2 n_modes)

gives the whole Gauss-Newton matrix H, and s² H^-1 is the Cramér-Rao bound of the poles, s² the noise variance.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from workbench.arrays import scaled_inverse, symmetric_root
from workbench.identification.signal.data_quality import of_same_sensors
from workbench.identification.signal.modal_estimates import (
    IdentifiedModes,
    RefinedModes,
    by_poles,
    normalised_shapes,
    time_derivatives,
)
from workbench.identification.signal.projection import (
    Projection,
    correlation,
    disturbed,
    noise_near,
    pole_blocks,
    project,
    variances,
)
from workbench.identification.signal.searches import FIT, TimeLimit, minimise
from workbench.records.record import Record, as_records
from workbench.structure.modes import SampledModes, frozen
from workbench.threads import one_blas_thread

Fits = list[Projection]  # of all records on the same poles


def unshaped(poles: np.ndarray, record: Record) -> SampledModes:
    """Modes of given poles with placeholder shapes of ones, sorted by frequency: a start for `refine`."""
    shapes = np.ones((record.n_outputs, poles.size), complex)
    return SampledModes.of_poles(poles[np.argsort(np.abs(poles))], shapes, record.positions)


def identified(
    refined: RefinedModes,
    statistic: np.ndarray,
    limit: float,
    rejected: Sequence[tuple[complex, float]],
    record: Record,
    remarks: tuple[str, ...],
) -> IdentifiedModes:
    """The result of an identification: refined modes with their test statistics, and the poles rejected as noise.

    From the pole, rad/s, and statistic of each rejected candidate, and a record of the sensors.
    """
    noise = sorted(rejected, key=lambda pair: abs(pair[0]))
    modes = unshaped(np.array([pole for pole, _ in noise], complex), record)
    return IdentifiedModes(
        refined, frozen(statistic), limit, modes, frozen([strength for _, strength in noise]), remarks
    )


def thresholds(false_alarm: float, n_cells: int, n_signals: int) -> tuple[float, float]:
    """χ² from which on the strongest of `n_cells` candidates enters, and from which on it stays, in white noise.

    A mode has two amplitudes per signal, an output of a record, and a pole.
    """
    enter = chi2.isf(min(20.0 * false_alarm, 0.5) / n_cells, 2 * n_signals)
    return float(enter), float(chi2.isf(false_alarm / n_cells, 2 * n_signals + 2))


def over_noise(fits: Sequence[Projection], weights: np.ndarray) -> np.ndarray:
    """Amplitudes over the noise, (n_signals, n_modes), a signal being an output of a record."""
    return np.vstack([fit.complex_amplitudes * weight[:, None] for fit, weight in zip(fits, weights, strict=True)])


def amplitude_statistic(
    fits: Sequence[Projection], weights: np.ndarray, r: int, without: np.ndarray | None = None
) -> float:
    """χ² of the amplitudes of mode r at fixed poles, without those along some directions (n_outputs, n_directions)."""
    strength, rows = 0.0, [r, fits[0].poles.size + r]
    for fit, weight in zip(fits, weights, strict=True):
        a = fit.coefficients[rows] * weight
        if without is not None:
            a = a - (a @ without) @ without.T
        strength += float((a * np.linalg.solve(fit.spread[np.ix_(rows, rows)], a)).sum())
    return strength


def in_coloured_noise(
    refined: RefinedModes, records: Record | Sequence[Record], fits: Sequence[Projection] | None = None
) -> RefinedModes:
    """The modes with standard errors that hold in noise of any smooth spectrum.

    Noise disturbs a mode within the band of the mode only. Where output j has noise of spectrum S_j, a least squares
    fit weighted for white noise s_j² has the covariance H^-1 (Σ_j J_j^T S_j J_j) H^-1 (White, Econometrica 48, 1980).
    The spectrum of each column of the Jacobian J is concentrated about its mode, so that

        J_j^T S_j J_j  ≈  κ_jr^½ κ_js^½ (J_jr^T J_js),     κ_jr = S_j(ω_r) / s_j²,

    for modes r and s. Where white noise is not rejected κ is one: the Cramér-Rao bound. Where the noise of the outputs
    has the correlation matrix C, the variance of a mode of amplitudes a_r, over the noise, is multiplied by
    a_r^H C a_r / a_r^H a_r.

    Args:
        refined: from `refine` with a constant in each output, weighted for white noise.
        records: that it was identified from.
        fits: projections on its poles, in any order, one per record; computed unless given.
    """
    records = as_records(records)
    fits = fits or [project(record, refined.modes.poles, True) for record in records]
    poles = fits[0].poles
    each = zip(records, fits, refined.noise, strict=True)
    ratios = np.array([noise_near(poles, fit.residual, noise, record.sample_time) for record, fit, noise in each])
    output_correlation = correlation([fit.residual.T for fit in fits])
    amplitudes = [fit.complex_amplitudes / noise[:, None] for fit, noise in zip(fits, refined.noise, strict=True)]
    shared = np.array([disturbed(output_correlation, each) for each in amplitudes])
    if (ratios == 1.0).all() and (shared == 1.0).all():
        return refined
    arguments = records, poles, fits, refined.noise
    return as_refined(*arguments, converged=refined.converged, steps=refined.steps, noise_ratio=ratios, shared=shared)


def as_refined(
    records: Sequence[Record],
    poles: np.ndarray,
    fits: Sequence[Projection],
    noise: np.ndarray,
    *,
    converged: bool,
    steps: int,
    noise_ratio: np.ndarray | None = None,
    shared: np.ndarray | float = 1.0,
) -> RefinedModes:
    """The modes of a fit with their covariance.

    Args:
        noise: (n_records, n_outputs) standard deviations.
        noise_ratio: κ (n_records, n_outputs, n_modes), variance of the noise about each mode over its mean; 1 unless
            given.
        shared: (n_records, n_modes) variance of each pole over that in noise without correlation between outputs.
    """
    n = poles.size
    covariance = scaled_inverse(normal_equations(fits, 1.0 / noise)[0], rcond=1e-14)
    if noise_ratio is not None:
        noise_factor = np.sqrt(noise_ratio.swapaxes(1, 2) * np.atleast_2d(shared)[..., None])
        disturbed_normal = normal_equations(fits, 1.0 / noise, noise_factor)[0]
        covariance = covariance @ disturbed_normal @ covariance
    jacobian = by_poles(poles) * np.r_[-np.ones(n), np.ones(n)]  # σ = -Re λ
    order = np.argsort(np.abs(poles))
    both = np.r_[order, order + n]
    variance = noise[:, :, None] ** 2 * np.ones(n) * (1.0 if noise_ratio is None else noise_ratio)
    derivative = time_derivatives(records[0].output_channels)
    shapes, shape_factor, shape_variance = _mean_shapes(fits, derivative, covariance, variance)
    return RefinedModes(
        modes=SampledModes.of_poles(poles[order], normalised_shapes(shapes)[:, order], records[0].positions),
        covariance=frozen((jacobian @ covariance @ jacobian.T)[np.ix_(both, both)]),
        amplitudes=tuple(frozen(fit.complex_amplitudes[:, order], complex) for fit in fits),
        shape_factor=frozen(shape_factor[order]),
        shape_variance=frozen(shape_variance[order]),
        noise=frozen(noise),
        converged=bool(converged),
        steps=steps,
    )


def normal_equations(
    fits: Sequence[Projection], weights: np.ndarray, factor: np.ndarray | float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton matrix and right-hand side of (σ, ω_d), over all records, outputs weighted by 1 / noise.

    `factor` (n_records, n_modes, n_outputs) is of the Jacobian of each mode and output: κ^½ gives J^T S J.
    """
    size = fits[0].gram.shape[0]
    n = size // 2
    h, g = np.zeros((size, size)), np.zeros(size)
    factors = np.broadcast_to(factor, (len(fits), n, weights.shape[1]))
    for fit, weight, by in zip(fits, weights, factors, strict=True):
        a, b = fit.coefficients[:n] * weight * by, fit.coefficients[n : 2 * n] * weight * by
        matrix, right = pole_blocks(a, b, fit.gram, fit.slopes[:n] * weight, fit.slopes[n:] * weight)
        h += matrix
        g += right
    sign = np.r_[-np.ones(n), np.ones(n)]  # σ = -Re λ
    return h * np.outer(sign, sign), g * sign


def _mean_shapes(
    fits: Sequence[Projection], derivative: np.ndarray, pole_covariance: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shapes averaged over records, relative to the largest entry, and the covariance of their real parts.

    Records share shapes but not amplitudes, so that only the ratios ρ_j = s_j / s_k of a record count, k the largest
    entry. The mean over records is weighted by the variance of each ratio: a record that is noisy, or hardly excites a
    mode, counts little.

    Args:
        derivative: (n_outputs,) order of the time derivative each output measures.
        pole_covariance: (2 n_modes, 2 n_modes) of (σ, ω_d).
        variance: (n_records, n_outputs, n_modes) of the noise about each mode.

    Returns:
        shapes (n_outputs, n_modes) complex; F (n_modes, n_outputs, n_factors) and v (n_modes, n_outputs) of the
        covariance F F^T + diag v: F by the errors of the poles and of the reference, v by the noise of each output.
    """
    poles, n = fits[0].poles, fits[0].poles.size
    to_displacement = poles ** -derivative[:, None]
    shapes = np.array([fit.complex_amplitudes * to_displacement for fit in fits])
    spread = np.array([np.diag(fit.spread)[:n] + np.diag(fit.spread)[n : 2 * n] for fit in fits])
    own_variance = variance * np.abs(to_displacement) ** 2 * spread[:, None]
    strongest = (np.abs(shapes) ** 2 / own_variance).sum(axis=1).argmax(axis=0)
    root = symmetric_root(pole_covariance)
    mean, factors = np.empty(shapes.shape[1:], complex), np.zeros((n, len(derivative), 2 * n + 2 * len(fits)))
    own_variances = np.zeros((n, len(derivative)))
    for r in range(n):
        best = shapes[strongest[r], :, r]
        k = int(np.argmax(np.abs(best)))
        size = np.maximum(np.abs(shapes[:, k, r, None]) ** 2, 1e-300)
        weights = size / (own_variance[:, :, r] + np.abs(best / best[k]) ** 2 * own_variance[:, k, r, None])
        weights = weights / weights.sum(axis=0)
        ratios = shapes[:, :, r] / shapes[:, k, r, None]
        mean[:, r] = (weights * ratios).sum(axis=0)
        shared, own_noise, columns = np.zeros((len(derivative), 2 * n)), np.zeros(len(derivative)), []
        for fit, each, weight, ratio, noise in zip(fits, shapes, weights, ratios, variance[:, :, r], strict=True):
            moved = _amplitude_slopes(fit, r) @ root * to_displacement[:, r, None]
            shared += weight[:, None] * ((moved - ratio[:, None] * moved[k]) / each[k, r]).real
            unit = to_displacement[:, r] / each[k, r]
            common, own_part = _ratio_covariance(fit, r, k, unit, ratio, noise)
            columns.append(weight[:, None] * common)
            own_noise += weight**2 * own_part
        factors[r], own_variances[r] = np.hstack([shared, *columns]), own_noise
        factors[r, k], own_variances[r, k] = 0.0, 0.0
    return mean, factors, own_variances


def _amplitude_slopes(fit: Projection, r: int) -> np.ndarray:
    """Derivatives of the amplitudes of mode r by (σ, ω_d) of every mode, -Φ^+ dΦ, (n_outputs, 2 n_modes) complex."""
    n = fit.poles.size
    # The derivative of Φ of mode p is -(α, β) tΦ_p by σ and (β, -α) tΦ_p by ω_d.
    alpha, beta = fit.coefficients[:n], fit.coefficients[n : 2 * n]
    cosine, sine = (np.array([1.0, -1j]) @ fit.tilt[[r, n + r]]).reshape(2, n, 1)
    return np.vstack([cosine * alpha + sine * beta, sine * alpha - cosine * beta]).T


def _ratio_covariance(
    fit: Projection, r: int, k: int, unit: np.ndarray, ratio: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of the real parts of the ratios of mode r to entry k by noise at fixed poles, from (Φ^T Φ)^-1.

    Returns:
        a factor (n_outputs, 2) by the noise of the reference k, and the variance (n_outputs,) by that of each output.
    """
    pair = np.array([1.0, -1j]) @ symmetric_root(fit.spread[np.ix_([r, fit.poles.size + r], [r, fit.poles.size + r])])
    each = np.sqrt(variance)[:, None] * pair * unit[:, None]
    return (ratio[:, None] * each[k]).real, (each.real**2).sum(axis=1)


@one_blas_thread
def refine(
    records: Record | Sequence[Record],
    start: SampledModes,
    *,
    offset: bool = False,
    time_limit: TimeLimit | None = None,
) -> RefinedModes:
    """The maximum likelihood modes near `start`, with the Cramér-Rao covariance of frequencies, damping and shapes.

    Sensors are weighted by their estimated noise in each record. Records share poles, not amplitudes.

    Args:
        records: free decay in white noise, of the same sensors at one rate.
        start: near the modes, such as of `stacked_delays`; its shapes are not used.
        offset: whether each output may also hold a constant.
        time_limit: of processor time; none unless given.

    Returns:
        `RefinedModes`; check `converged`: a start with modes that the record does not hold may not converge.

    Raises:
        ValueError: fewer samples than unknowns; no modes to start from.
    """
    records = of_same_sensors(records)
    if start.n_modes == 0:
        raise ValueError("there is no mode to refine; identify with more modes or a longer record first")
    unknowns = 2 * start.n_modes + int(offset)
    shortest = min(r.n_samples for r in records)
    if shortest <= unknowns + 1:
        raise ValueError(
            f"{start.n_modes} modes are {unknowns} unknowns a sensor; a record has {shortest} samples: measure longer"
        )
    poles, weights = start.poles, np.ones((len(records), records[0].n_outputs))
    steps = 0
    for _ in range(2):
        # Noise differs between sensors and between records: it is estimated at the first optimum.
        poles, fit, converged, taken = fitted_poles(records, poles, weights, offset, time_limit=time_limit)
        steps += taken
        noise = noise_level(records, fit, weights)
        weights = 1.0 / noise
    return as_refined(records, poles, fit, noise, converged=converged, steps=steps)


def cramer_rao_bound(modes: SampledModes, record: Record, *, noise_std: float | Sequence[float]) -> RefinedModes:
    """The Cramér-Rao bound of the modes of a free decay: the least covariance of any unbiased estimate.

    Args:
        modes: true; shapes s_jr carry amplitude and phase at time 0, as in `free_decay`.
        record: for its sample times and quantities; its values do not matter.
        noise_std: of the white noise of all outputs, or of each (n_outputs,), in their units.

    Returns:
        `RefinedModes` with the true modes and the standard errors of an efficient estimate.

    Raises:
        ValueError: noise that is not positive, or of another number of outputs.
    """
    noise = np.asarray(noise_std, float)
    if noise.shape not in ((), (record.n_outputs,)) or not (np.isfinite(noise) & (noise > 0)).all():
        raise ValueError(f"noise_std is positive, one for all outputs or one each, ({record.n_outputs},); got {noise}")
    derivative = time_derivatives(record.output_channels)[:, None]
    amplitude = modes.shapes * modes.poles**derivative
    clean = replace(record, outputs=(amplitude @ np.exp(modes.poles[:, None] * record.time)).real)
    fits = [project(clean, modes.poles, False)]
    each = np.broadcast_to(noise, (1, record.n_outputs))
    return as_refined([clean], modes.poles, fits, each, converged=True, steps=0)


def modal_amplitudes(record: Record, modes: SampledModes) -> SampledModes:
    """The same modes with shapes of displacement that carry amplitude and phase at time 0, by least squares.

    Args:
        record: free decay.
        modes: for their poles.

    Returns:
        `SampledModes` with y = d^k/dt^k Re Σ s_r e^{λ_r t}, k the derivative each sensor measures.
    """
    fit = project(record, modes.poles, False)
    lag = np.exp(-modes.poles * record.start_time)
    derivative = time_derivatives(record.output_channels)
    return replace(modes, shapes=fit.complex_amplitudes * lag / modes.poles ** derivative[:, None])


def fitted_poles(
    records: Sequence[Record],
    poles: np.ndarray,
    weights: np.ndarray,
    offset: bool,
    most_steps: int = FIT.max_steps,
    *,
    hold: bool = False,
    enough: float = FIT.cost_tolerance,
    time_limit: TimeLimit | None = None,
) -> tuple[np.ndarray, list[Projection], bool, int]:
    """Least squares over (σ, ω_d) of all modes.

    A step that would make a pole inadmissible is shortened. With `hold` that pole alone stays where it is for this
    step, and a pole beyond the Nyquist frequency is folded back to its alias.

    Args:
        poles: (n_modes,) start, rad/s.
        weights: (n_records, n_outputs) 1 / noise.
        offset: whether each output may also hold a constant.
        enough: predicted decrease of χ², per value, at which the search ends.

    Returns:
        poles, projections (one per record), whether the search converged, and the number of steps.
    """
    start = [project(record, poles, offset) for record in records]
    problem = _Poles(start, records, weights, offset, hold, enough)
    minimum = minimise(problem, start, most_steps=most_steps, round_off=problem.round_off, time_limit=time_limit)
    return minimum.state[0].poles, minimum.state, minimum.converged, minimum.steps


class _Poles:
    """The `searches.LeastSquares` of free decays; its state is the projection of each record on the poles."""

    def __init__(
        self, start: Fits, records: Sequence[Record], weights: np.ndarray, offset: bool, hold: bool, enough: float
    ) -> None:
        self.records, self.weights, self.offset, self.hold, self.enough = records, weights, offset, hold, enough
        coefficients = sum(fit.coefficients.size for fit in start)
        self.free = sum(r.outputs.size for r in records) - 2 * start[0].poles.size - coefficients
        self.signal = float((weights**2 * _squares(records)).sum())
        self.round_off = max(fit.round_off for fit in start) * self.signal

    def cost(self, state: Fits) -> float:
        return float(sum(weight**2 @ fit.squares for fit, weight in zip(state, self.weights, strict=True)))

    def normal_equations(self, state: Fits) -> tuple[np.ndarray, np.ndarray]:
        return normal_equations(state, self.weights)

    def moved(self, state: Fits, step: np.ndarray) -> tuple[Fits | None, np.ndarray]:
        poles, n = state[0].poles, state[0].poles.size
        trial = poles - step[:n] + 1j * step[n:]
        if self.hold:
            trial, step = _folded(trial, self.records[0].sample_time), step.copy()
            held = _inadmissible(trial, self.records)
            trial[held], step[np.tile(held, 2)] = poles[held], 0.0
        if _inadmissible(trial, self.records).any():
            return None, step
        try:
            return [project(record, trial, self.offset) for record in self.records], step
        except np.linalg.LinAlgError:
            return None, step

    def negligible(self, decrease: float, cost: float) -> bool:
        return decrease <= max(self.enough * cost / self.free, FIT.round_off * self.signal, 1e-4 * self.round_off)


def _folded(poles: np.ndarray, sample_time: float) -> np.ndarray:
    """Poles folded below the Nyquist frequency: real samples do not distinguish aliases."""
    turn = np.abs(poles.imag) * sample_time
    return np.asarray(poles.real + 1j * np.minimum(turn, 2.0 * np.pi - turn) / sample_time)


def _inadmissible(poles: np.ndarray, records: Sequence[Record]) -> np.ndarray:
    """Which poles do not oscillate, exceed the Nyquist frequency, grow too fast over a record, or decay within about
    a sample, (n_modes,)."""
    dt, longest = records[0].sample_time, max(r.n_samples * r.sample_time for r in records)
    turn = poles.imag * dt
    growing, too_fast = poles.real * longest >= FIT.max_growth, -poles.real * dt > FIT.max_decay
    return np.asarray((turn <= 0) | (turn >= np.pi) | growing | too_fast)


def _squares(records: Sequence[Record]) -> np.ndarray:
    """Sum of squares of each output in each record, (n_records, n_outputs)."""
    return np.array([np.einsum("jt,jt->j", r.outputs, r.outputs) for r in records])


def noise_level(records: Sequence[Record], fits: Sequence[Projection], weights: np.ndarray) -> np.ndarray:
    """Standard deviation of the residual of each output in each record, (n_records, n_outputs).

    Sums of squares are divided by degrees of freedom. Those of the poles are shared among the records by the
    information that each contributes.
    """
    n_poles = fits[0].gram.shape[0]
    lost = np.full(len(fits), n_poles / len(fits))
    if len(fits) > 1 and n_poles:
        each = np.array([normal_equations([fit], w[None])[0] for fit, w in zip(fits, weights, strict=True)])
        scale = 1.0 / np.sqrt(np.maximum(np.diag(each.sum(axis=0)), 1e-300))
        each *= np.outer(scale, scale)
        lost = np.trace(np.linalg.pinv(each.sum(axis=0), hermitian=True) @ each, axis1=1, axis2=2)
    free = np.array([r.n_samples - f.coefficients.shape[0] for r, f in zip(records, fits, strict=True)])
    squares = np.array([np.einsum("tj,tj->j", f.residual, f.residual) for f in fits])
    signal = _squares(records)
    floor = np.maximum(1e-32 * signal, 1e-32 * signal.max() + 1e-300)
    free = np.maximum(free - lost / records[0].n_outputs, 1.0)
    return np.asarray(np.sqrt(variances(np.maximum(squares, floor), free)))
