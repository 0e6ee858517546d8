"""Maximum likelihood refinement: modes as accurate as the record allows, with standard errors that are true.

In white noise the most likely modes minimise the squares of what y_j(t) = Re Σ_r a_jr e^{λ_r t} leaves of the record.
For given poles the amplitudes are linear and drop out (variable projection, Golub & Pereyra 1973), so only the
2 n_modes numbers σ_r, ω_dr of λ = -σ + iω_d are searched, however many sensors there are. With columns
Φ = [e^{-σt} cos ω_d t, e^{-σt} sin ω_d t] all derivatives of Φ lie in the span of tΦ, so one matrix

    G = (tΦ)^T (I - Φ Φ^+) (tΦ)                                       (2 n_modes, 2 n_modes)

gives the whole Gauss-Newton matrix H, and s² H^-1 is at the same time the Cramér-Rao bound of the poles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import ndtri

from workbench.identification.free_decay.agreed_shapes import agreed_shapes
from workbench.identification.free_decay.ibrahim import check_alike, normalised_shapes
from workbench.identification.signal.noise_levels import variances
from workbench.identification.signal.projection import Projection, project
from workbench.identification.signal.standard_errors import StandardErrors
from workbench.identification.signal.synthesis import time_derivatives
from workbench.records.record import Record
from workbench.structure.modes import SampledModes, frozen
from workbench.threads import one_blas_thread

MOST_STEPS = 60
# A step is small once it moves the estimate by less than a thousandth of its standard error.
SETTLED = 1e-6
ROUND_OFF = 1e-13


@dataclass(frozen=True, eq=False)
class Refined(StandardErrors):
    """Most likely modes of a record, and how far each figure is to be trusted.

    Attributes:
        modes: refined; shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ), the Cramér-Rao bound at the estimate.
        amplitudes: one (n_outputs, n_modes) complex a record: y = Re Σ a_r e^{λ_r (t - t_first)}, in its own units.
        shape_covariance: (n_modes, n_outputs, n_outputs) of the real parts of the shapes, relative to each one's
            largest entry (which is 1 and so without error).
        noise: (n_records, n_outputs) standard deviation of what the modes leave over, in the unit of each output.
        converged: whether the search ended because the step was small.
        steps: taken.
    """

    modes: SampledModes
    covariance: np.ndarray
    amplitudes: tuple[np.ndarray, ...] = field(repr=False)
    shape_covariance: np.ndarray = field(repr=False)
    noise: np.ndarray
    converged: bool
    steps: int

    @property
    def noise_std(self) -> np.ndarray:
        """Of each output (n_outputs,), root mean square over the records."""
        return np.sqrt((self.noise**2).mean(axis=0))

    @property
    def shape_std(self) -> np.ndarray:
        """Standard error of the real part of each shape (n_outputs, n_modes)."""
        return np.sqrt(np.einsum("rjj->jr", self.shape_covariance))

    def interval(self, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Confidence intervals of ω and of ζ, (2, n_modes) each: lower row, upper row."""
        return self._within(float(ndtri(0.5 * (1.0 + level))))


@one_blas_thread
def refine(records: Record | Sequence[Record], start: SampledModes, *, offset: bool = False) -> Refined:
    """The most likely modes near `start`, with the Cramér-Rao covariance of frequencies, damping and shapes.

    Sensors are weighted by the noise that each turns out to have in each record. Records share poles, not amplitudes.

    Args:
        records: free decay in white noise, of the same sensors at one rate.
        start: from `stacked_delays`; its shapes are not used.
        offset: whether each output may also hold a constant.

    Returns:
        `Refined`; look at `converged`: a start with modes that the record does not hold may not settle.

    Raises:
        ValueError: fewer samples than unknowns; no modes to start from.
    """
    records = [records] if isinstance(records, Record) else list(records)
    check_alike(records)
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
        # Noise differs from sensor to sensor and from record to record: it is measured at the first optimum.
        poles, fit, converged, taken = search(records, poles, weights, offset)
        steps += taken
        noise = noise_level(records, fit, weights)
        weights = 1.0 / noise
    return as_refined(records, poles, fit, noise, converged=converged, steps=steps)


def bound(modes: SampledModes, record: Record, *, noise_std: float | Sequence[float]) -> Refined:
    """The Cramér-Rao bound of a free decay known without noise: what no unbiased estimate can beat.

    Args:
        modes: true; shapes s_jr carry amplitude and phase at time 0, as `free_decay` takes them.
        record: for its sample times and quantities; its values do not count.
        noise_std: of the white noise of all outputs, or of each (n_outputs,), in their units.

    Returns:
        `Refined` with the true modes and the standard errors of an efficient estimate.
    """
    derivative = time_derivatives(record.output_channels)[:, None]
    amplitude = modes.shapes * modes.poles**derivative
    clean = replace(record, outputs=(amplitude @ np.exp(modes.poles[:, None] * record.time)).real)
    noise = np.broadcast_to(np.asarray(noise_std, float), (1, record.n_outputs))
    fits = [project(clean, modes.poles, False)]
    return as_refined([clean], modes.poles, fits, noise, converged=True, steps=0)


def amplitudes(record: Record, modes: SampledModes, *, at: float = 0.0, offset: bool = False) -> SampledModes:
    """The same modes with shapes of displacement that carry amplitude and phase at the time `at`, by least squares.

    Args:
        record: free decay.
        modes: poles are used.
        at: s on the record's clock; for a blow, the time it was struck.
        offset: whether each output may also hold a constant.

    Returns:
        `SampledModes` with y = d^k/dt^k Re Σ s_r e^{λ_r (t - at)}, k the derivative each sensor measures.
    """
    fit = project(record, modes.poles, offset)
    lag = np.exp(modes.poles * (at - record.start_time))
    derivative = time_derivatives(record.output_channels)
    return replace(modes, shapes=fit.complex_amplitudes * lag / modes.poles ** derivative[:, None])


def _normal(fits: Sequence[Projection], weights: np.ndarray, heard=1.0) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton matrix H and right-hand side, over all records, outputs weighted by 1 / noise.

    `heard`, (n_records, n_modes, n_outputs), makes it what noise louder by so much about a mode brings in.
    """
    size = fits[0].gram.shape[0]
    n = size // 2
    h, g = np.zeros((size, size)), np.zeros(size)
    heard = np.broadcast_to(heard, (len(fits), n, weights.shape[1]))
    for fit, weight, loud in zip(fits, weights, heard, strict=True):
        a, b = fit.coefficients[:n] * weight * loud, fit.coefficients[n : 2 * n] * weight * loud
        aa, ab, bb = a @ a.T, a @ b.T, b @ b.T
        (cc, cs), (sc, ss) = fit.gram.reshape(2, n, 2, n).transpose(0, 2, 1, 3)
        h[:n, :n] += aa * cc + ab * cs + ab.T * sc + bb * ss
        h[n:, n:] += bb * cc - ab.T * cs - ab * sc + aa * ss
        cross = -(ab * cc) + aa * cs - bb * sc + ab.T * ss
        h[:n, n:] += cross
        h[n:, :n] += cross.T
        x, y = fit.slopes[:n] * weight, fit.slopes[n:] * weight
        g[:n] += -(a * x + b * y).sum(axis=1)
        g[n:] += (b * x - a * y).sum(axis=1)
    return h, g


def search(records, poles: np.ndarray, weights: np.ndarray, offset: bool, most_steps: int = MOST_STEPS, many=False):
    """Levenberg-Marquardt over (σ, ω_d): poles, projections, whether it settled, steps taken.

    Where a pole would leave what is allowed the step is made shorter; or, of `many`, that pole stays for this step and
    keeps no other from moving, unless it comes back as the mirror image that samples cannot tell from it.
    """
    n = poles.size
    fits = [project(record, poles, offset) for record in records]
    cost = _cost(fits, weights)
    free = sum(r.outputs.size for r in records) - 2 * n - sum(f.coefficients.size for f in fits)
    signal = float((weights**2 * _squares(records)).sum())
    blur = max(fit.round_off for fit in fits) * signal
    damping = 1e-3
    for step in range(1, most_steps + 1):
        h, g = _normal(fits, weights)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(h), 1e-300))
        while True:
            matrix = h * np.outer(scale, scale) + damping * np.eye(2 * n)
            try:
                move = scale * cho_solve(cho_factor(matrix), scale * g)
            except np.linalg.LinAlgError:
                damping = max(8.0 * damping, 1e-9)
                continue
            trial = poles - move[:n] + 1j * move[n:]
            if many:
                trial = _folded(trial, records[0].sample_time)
                held = _beyond(trial, records)
                trial[held], move[np.tile(held, 2)] = poles[held], 0.0
            gain = float(move @ g)
            small = gain <= max(SETTLED * cost / free, ROUND_OFF**2 * signal, 1e-4 * blur)
            fits_there = _tried(records, trial, offset)
            cost_there = np.inf if fits_there is None else _cost(fits_there, weights)
            if cost_there <= cost + blur or small or damping > 1e8:
                break
            damping *= 8.0
        if fits_there is not None and cost_there <= cost + blur:
            poles, fits, cost = trial, fits_there, cost_there
        damping = max(0.1 * damping, 1e-12)
        if small or damping > 1e6:
            return poles, fits, small, step
    return poles, fits, False, most_steps


def _folded(poles: np.ndarray, sample_time: float) -> np.ndarray:
    """The same poles within half the sample rate: real samples see no difference."""
    turn = np.abs(poles.imag) * sample_time
    return poles.real + 1j * np.minimum(turn, 2.0 * np.pi - turn) / sample_time


def _beyond(poles: np.ndarray, records) -> np.ndarray:
    """Which modes no longer swing, pass half the sample rate, grow by more than e^20 over a record, or decay faster
    than e^-1 a sample."""
    dt, longest = records[0].sample_time, max(r.n_samples * r.sample_time for r in records)
    turn = poles.imag * dt
    return (turn <= 0) | (turn >= np.pi) | (poles.real * longest >= 20.0) | (-poles.real * dt > 1.0)


def _tried(records, poles: np.ndarray, offset: bool) -> list[Projection] | None:
    """Projections; None where a mode is beyond what a search allows or cannot be told from another."""
    if _beyond(poles, records).any():
        return None
    try:
        return [project(record, poles, offset) for record in records]
    except np.linalg.LinAlgError:
        return None


def _cost(fits, weights: np.ndarray) -> float:
    return float(sum(weight**2 @ fit.squares for fit, weight in zip(fits, weights, strict=True)))


def _squares(records) -> np.ndarray:
    """Sums of those of every output, (n_records, n_outputs)."""
    return np.array([np.einsum("jt,jt->j", r.outputs, r.outputs) for r in records])


def noise_level(records, fits, weights: np.ndarray) -> np.ndarray:
    """Standard deviation of the residual of each output in each record, (n_records, n_outputs), the degrees of freedom
    the fit took away made good: the poles take theirs where they are learnt."""
    n_poles = fits[0].gram.shape[0]
    lost = np.full(len(fits), n_poles / len(fits))
    if len(fits) > 1 and n_poles:
        each = np.array([_normal([fit], weight[None])[0] for fit, weight in zip(fits, weights, strict=True)])
        scale = 1.0 / np.sqrt(np.maximum(np.diag(each.sum(axis=0)), 1e-300))
        each *= np.outer(scale, scale)
        lost = np.trace(np.linalg.pinv(each.sum(axis=0), hermitian=True) @ each, axis1=1, axis2=2)
    free = np.array([r.n_samples - f.coefficients.shape[0] for r, f in zip(records, fits, strict=True)])
    squares = np.array([np.einsum("tj,tj->j", f.residual, f.residual) for f in fits])
    signal = _squares(records)
    floor = np.maximum(1e-32 * signal, 1e-32 * signal.max() + 1e-300)
    return np.sqrt(variances(np.maximum(squares, floor), np.maximum(free - lost / records[0].n_outputs, 1.0)))


def as_refined(records, poles, fits, noise, *, converged: bool, steps: int, heard=None) -> Refined:
    """What a search ended with, with the covariance that follows from it.

    Args:
        noise: (n_records, n_outputs) standard deviations.
        heard: (n_records, n_outputs, n_modes) variance of the noise about each mode over that; 1 unless given. The
            search has weighted all noise as white, so that its errors are H^-1 M H^-1 (White, Econometrica 48, 1980).
    """
    n = poles.size
    h, _ = _normal(fits, 1.0 / noise)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(h), 1e-300))
    covariance = np.linalg.pinv(h * np.outer(scale, scale), rcond=1e-14, hermitian=True) * np.outer(scale, scale)
    if heard is not None:
        covariance = covariance @ _normal(fits, 1.0 / noise, np.sqrt(heard).swapaxes(1, 2))[0] @ covariance
    omega = np.abs(poles)
    sigma, omega_d = -poles.real, poles.imag
    # ω² = σ² + ω_d² and ζ = σ/ω carry the covariance of (σ, ω_d) to that of (ω, ζ).
    jacobian = np.block(
        [
            [np.diag(sigma / omega), np.diag(omega_d / omega)],
            [np.diag(omega_d**2 / omega**3), np.diag(-sigma * omega_d / omega**3)],
        ]
    )
    order = np.argsort(omega)
    both = np.r_[order, order + n]
    variance = noise[:, :, None] ** 2 * np.ones(n) * (1.0 if heard is None else heard)
    derivative = time_derivatives(records[0].output_channels)
    shapes, shape_covariance = agreed_shapes(fits, derivative, covariance, variance)
    return Refined(
        modes=SampledModes(
            omega[order], (sigma / omega)[order], normalised_shapes(shapes)[:, order], records[0].positions
        ),
        covariance=frozen((jacobian @ covariance @ jacobian.T)[np.ix_(both, both)]),
        amplitudes=tuple(frozen(fit.complex_amplitudes[:, order], complex) for fit in fits),
        shape_covariance=frozen(shape_covariance[order]),
        noise=frozen(noise),
        converged=bool(converged),
        steps=steps,
    )
