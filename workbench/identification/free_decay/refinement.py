"""Maximum likelihood refinement: modes as accurate as the record allows, with standard errors that are true.

In white noise the maximum likelihood modes minimise the squares of the residual y_j(t) - Re Σ_r a_jr e^{λ_r t}. For
given poles the amplitudes are linear and drop out (variable projection, Golub & Pereyra 1973), so only the 2 n_modes
numbers σ_r, ω_dr of λ = -σ + iω_d are searched, however many sensors there are. With columns
Φ = [e^{-σt} cos ω_d t, e^{-σt} sin ω_d t] all derivatives of Φ lie in the span of tΦ, so one matrix

    G = (tΦ)^T (I - Φ Φ^+) (tΦ)                                       (2 n_modes, 2 n_modes)

gives the whole Gauss-Newton matrix H, and s² H^-1 is at the same time the Cramér-Rao bound of the poles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workbench.identification.free_decay.refined import Refined, as_refined, normal_equations
from workbench.identification.signal.budget import Budget
from workbench.identification.signal.data_quality import check_same_sensors
from workbench.identification.signal.least_squares import minimise
from workbench.identification.signal.noise import variances
from workbench.identification.signal.projection import Projection, project
from workbench.identification.signal.synthesis import time_derivatives
from workbench.records.record import Record
from workbench.structure.modes import SampledModes
from workbench.threads import one_blas_thread

MOST_STEPS = 60
# A step is negligible once it moves the estimate by less than a thousandth of its standard error, squared.
NEGLIGIBLE = 1e-6
# Of the residual, relative to the record.
ROUND_OFF = 1e-13
# Growth e^20 over a record, and decay e^-1 within one sample: no pole is searched beyond.
MOST_GROWTH, FASTEST_DECAY = 20.0, 1.0


@one_blas_thread
def refine(
    records: Record | Sequence[Record], start: SampledModes, *, offset: bool = False, budget: Budget | None = None
) -> Refined:
    """The maximum likelihood modes near `start`, with the Cramér-Rao covariance of frequencies, damping and shapes.

    Sensors are weighted by the noise that each turns out to have in each record. Records share poles, not amplitudes.

    Args:
        records: free decay in white noise, of the same sensors at one rate.
        start: from `stacked_delays`; its shapes are not used.
        offset: whether each output may also hold a constant.
        budget: of time; none unless given.

    Returns:
        `Refined`; look at `converged`: a start with modes that the record does not hold may not converge.

    Raises:
        ValueError: fewer samples than unknowns; no modes to start from.
    """
    records = [records] if isinstance(records, Record) else list(records)
    check_same_sensors(records)
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
        poles, fit, converged, taken = search(records, poles, weights, offset, budget=budget)
        steps += taken
        noise = noise_level(records, fit, weights)
        weights = 1.0 / noise
    return as_refined(records, poles, fit, noise, converged=converged, steps=steps)


def cramer_rao_bound(modes: SampledModes, record: Record, *, noise_std: float | Sequence[float]) -> Refined:
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


def modal_amplitudes(record: Record, modes: SampledModes, *, at: float = 0.0, offset: bool = False) -> SampledModes:
    """The same modes with shapes of displacement that carry amplitude and phase at the time `at`, by least squares.

    Args:
        record: free decay.
        modes: poles are used.
        at: s on the record's clock; after an impulse, the time it acted.
        offset: whether each output may also hold a constant.

    Returns:
        `SampledModes` with y = d^k/dt^k Re Σ s_r e^{λ_r (t - at)}, k the derivative each sensor measures.
    """
    fit = project(record, modes.poles, offset)
    lag = np.exp(modes.poles * (at - record.start_time))
    derivative = time_derivatives(record.output_channels)
    return replace(modes, shapes=fit.complex_amplitudes * lag / modes.poles ** derivative[:, None])


def search(
    records: Sequence[Record],
    poles: np.ndarray,
    weights: np.ndarray,
    offset: bool,
    most_steps: int = MOST_STEPS,
    *,
    hold: bool = False,
    budget: Budget | None = None,
) -> tuple[np.ndarray, list[Projection], bool, int]:
    """Least squares over (σ, ω_d): poles, projections, whether it converged, steps taken.

    Where a pole would leave what is admissible the step is made shorter; or, with `hold`, that pole stays for this step
    and keeps no other from moving, unless it comes back as the mirror image that samples cannot distinguish from it.
    """
    problem = _Poles(records, weights, offset, hold)
    start = _Fitted(poles, [project(record, poles, offset) for record in records])
    found = minimise(problem, start, most_steps=most_steps, round_off=problem.start_from(start), budget=budget)
    return found.state.poles, found.state.fits, found.converged, found.steps


@dataclass(frozen=True, eq=False)
class _Fitted:
    poles: np.ndarray
    fits: list[Projection]


class _Poles:
    """The `least_squares.Problem` of free decays."""

    def __init__(self, records: Sequence[Record], weights: np.ndarray, offset: bool, hold: bool) -> None:
        self.records, self.weights, self.offset, self.hold = records, weights, offset, hold

    def start_from(self, start: _Fitted) -> float:
        """Round-off of the cost."""
        coefficients = sum(fit.coefficients.size for fit in start.fits)
        self.free = sum(r.outputs.size for r in self.records) - 2 * start.poles.size - coefficients
        self.signal = float((self.weights**2 * _squares(self.records)).sum())
        self.round_off = max(fit.round_off for fit in start.fits) * self.signal
        return self.round_off

    def cost(self, state: _Fitted) -> float:
        each = zip(state.fits, self.weights, strict=True)
        return float(sum(weight**2 @ fit.squares for fit, weight in each))

    def normal_equations(self, state: _Fitted) -> tuple[np.ndarray, np.ndarray]:
        return normal_equations(state.fits, self.weights)

    def moved(self, state: _Fitted, step: np.ndarray) -> tuple[_Fitted | None, np.ndarray]:
        n = state.poles.size
        trial = state.poles - step[:n] + 1j * step[n:]
        if self.hold:
            trial, step = _folded(trial, self.records[0].sample_time), step.copy()
            held = _inadmissible(trial, self.records)
            trial[held], step[np.tile(held, 2)] = state.poles[held], 0.0
        if _inadmissible(trial, self.records).any():
            return None, step
        try:
            return _Fitted(trial, [project(record, trial, self.offset) for record in self.records]), step
        except np.linalg.LinAlgError:
            return None, step

    def negligible(self, decrease: float, cost: float) -> bool:
        return decrease <= max(NEGLIGIBLE * cost / self.free, ROUND_OFF**2 * self.signal, 1e-4 * self.round_off)


def _folded(poles: np.ndarray, sample_time: float) -> np.ndarray:
    """The same poles below the Nyquist frequency: real samples see no difference."""
    turn = np.abs(poles.imag) * sample_time
    return np.asarray(poles.real + 1j * np.minimum(turn, 2.0 * np.pi - turn) / sample_time)


def _inadmissible(poles: np.ndarray, records: Sequence[Record]) -> np.ndarray:
    """Which poles do not oscillate, pass the Nyquist frequency, grow too much over a record, or decay at once."""
    dt, longest = records[0].sample_time, max(r.n_samples * r.sample_time for r in records)
    turn = poles.imag * dt
    growing, gone = poles.real * longest >= MOST_GROWTH, -poles.real * dt > FASTEST_DECAY
    return np.asarray((turn <= 0) | (turn >= np.pi) | growing | gone)


def _squares(records: Sequence[Record]) -> np.ndarray:
    """Sums of those of every output, (n_records, n_outputs)."""
    return np.array([np.einsum("jt,jt->j", r.outputs, r.outputs) for r in records])


def noise_level(records: Sequence[Record], fits: Sequence[Projection], weights: np.ndarray) -> np.ndarray:
    """Standard deviation of the residual of each output in each record, (n_records, n_outputs).

    The degrees of freedom that the fit took are made good: the poles take theirs where they are learnt.
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
    return np.asarray(
        np.sqrt(variances(np.maximum(squares, floor), np.maximum(free - lost / records[0].n_outputs, 1.0)))
    )
