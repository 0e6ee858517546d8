"""Estimation of an unmodelled force at a point, without any assumption on its law.

The residual of the nominal model obeys the model's own equations, driven by the unmodelled force. A Kalman filter with
an unknown force at x (a first-order random process) gives the likelihood of that place; its smoother gives the force
and the motion there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.linalg import expm, solve_triangular

from workbench.arrays import Floats
from workbench.rig.lanes import on_lanes, row_times
from workbench.rig.linear import integrated
from workbench.rig.sensors import MEASURED, Sensor
from workbench.structure.modes import Modes

MAX_INNOVATION = 1e100  # innovations, in any unit
WHITE = np.zeros((1, 1))  # colour of a force that is uncorrelated from sample to sample
RIGID_FREQUENCY = 1e-4  # radians a sample: frequency given to rigid modes
MAX_DOUBLINGS = 40  # of the number of samples of a sum or of a steady state, at most


@dataclass(frozen=True, eq=False)
class SampledModel:
    """The modal equations over one sample interval, with held modal forces.

    Attributes:
        transition: (2n, 2n) of the state (q, q').
        growth: (2n, n) response of the state to modal forces held over the interval.
        output: (n_sensors, 2n) of the state.
        feedthrough: (n_sensors, n) of modal forces.
        before: (n_sensors, n) of the modal forces of the interval before, which late sensors still read.
        noise_variance: (n_sensors,).
    """

    transition: np.ndarray
    growth: np.ndarray
    output: np.ndarray
    feedthrough: np.ndarray
    before: np.ndarray
    noise_variance: np.ndarray


def _without_zero_frequencies(modes: Modes, sample_time: float) -> Modes:
    """The modes with rigid ones on a very soft spring, as velocity sensors do not observe their displacement."""
    if modes.omega.all():
        return modes
    return replace(
        modes, omega=np.where(modes.omega > 0, modes.omega, RIGID_FREQUENCY / sample_time), damping=modes.damping
    )


def sampled_model(modes: Modes, sensors: tuple[Sensor, ...], noise: np.ndarray, sample_time: float) -> SampledModel:
    """The modes, discretised, with sensors of noise standard deviations `noise` (n_sensors,).

    For a sensor that is late by more than a sample, forces are taken as held over the delay.
    """
    n = modes.n_modes
    own = _without_zero_frequencies(modes, sample_time).state_matrix
    a = np.zeros((3 * n, 3 * n))
    a[: 2 * n, : 2 * n] = own
    a[n : 2 * n, 2 * n :] = np.eye(n)
    step = expm(a * sample_time)
    output = np.zeros((len(sensors), 2 * n))
    feedthrough, before = np.zeros((2, len(sensors), n))
    for j, sensor in enumerate(sensors):
        derivative, order = MEASURED[sensor.quantity]
        shape = sensor.gain * modes.phi_at(sensor.at, derivative, direction=sensor.direction)
        if order < 2:
            output[j, order * n : (order + 1) * n] = shape
        else:
            output[j] = shape @ own[n:]
            feedthrough[j] = shape
        if sensor.delay:
            shifted = np.r_[output[j], feedthrough[j]] @ expm(-sensor.delay * a)
            output[j], feedthrough[j] = shifted[: 2 * n], shifted[2 * n :]
            if sensor.delay > 0:
                before[j], feedthrough[j] = feedthrough[j], 0.0
    return SampledModel(step[: 2 * n, : 2 * n], step[: 2 * n, 2 * n :], output, feedthrough, before, noise**2)


@dataclass(frozen=True, eq=False)
class ForceFilter:
    """A steady-state Kalman filter of the state (q, q', g_1..g_m) with m unknown forces.

    Attributes:
        a, h: transition and output of the augmented state.
        covariance: (n_states, n_states) of the predicted state.
        gain: (n_states, n_sensors), predictor form.
        innovation: (n_sensors, n_sensors) covariance S.
    """

    a: np.ndarray
    h: np.ndarray
    covariance: np.ndarray
    gain: np.ndarray
    innovation: np.ndarray


def force_filter(
    model: SampledModel, patterns: np.ndarray, variances: np.ndarray, colour: Floats = WHITE
) -> ForceFilter:
    """The filter for forces along `patterns` (n_modes, n_forces) with the given process variances.

    colour: (n_stages, n_stages) transition of each force's shaping filter, from the force itself to the last stage,
    which white noise drives; see `colour_of`.
    """
    n_state, m = model.transition.shape[0], patterns.shape[1]
    forces = n_state + len(colour) * m
    late = m if model.before.any() else 0
    size = forces + late
    a = np.zeros((size, size))
    a[:n_state, :n_state] = model.transition
    a[:n_state, n_state : n_state + m] = model.growth @ patterns
    a[n_state:forces, n_state:forces] = np.kron(colour, np.eye(m))
    a[forces:, n_state : n_state + late] = np.eye(late)
    h = np.zeros((model.output.shape[0], size))
    h[:, :n_state], h[:, n_state : n_state + m] = model.output, model.feedthrough @ patterns
    h[:, forces:] = (model.before @ patterns)[:, :late]
    q = np.zeros_like(a)
    q[forces - m : forces, forces - m : forces] = np.diag(variances)
    return _steady_state(a, h, q, model.noise_variance)


def colour_of(memory: float, stages: int, *, flat: bool = False) -> Floats:
    """Transition matrix (stages, stages) of a shaping filter that makes a coloured force of white noise.

    Args:
        memory: pole of each stage: 0 for white, near 1 for a random walk.
        stages: first-order filters in series, each of which makes the force smoother.
        flat: Butterworth poles instead of equal real ones: a flat spectrum up to a corner, as of band-limited noise.
    """
    angles = np.pi * (1.0 - (2.0 * np.arange(stages) + 1.0) / stages) / 2.0 if flat else np.zeros(stages)
    poles = max(memory, 1e-12) ** np.exp(1j * angles)
    # first- and second-order sections: the polynomial of all poles loses digits where they are near 1
    colour = np.diag(np.where(np.abs(poles.imag) < 1e-12, poles.real, 0.0)) + np.eye(stages, k=1)
    for k, pole in enumerate(np.sort_complex(poles[poles.imag > 1e-12])):
        i = 2 * k
        colour[i : i + 2, i : i + 2] = [[2.0 * pole.real, 1.0], [-(abs(pole) ** 2), 0.0]]
    if stages % 2 and flat:
        colour[-1, -1] = memory
    return colour


def gauss_markov_force_filter(
    modes: Modes, model: SampledModel, shape: np.ndarray, rms: float, correlation_time: float, sample_time: float
) -> ForceFilter:
    """The filter for one force that is a first-order Gauss-Markov process, discretised exactly.

    Forces of contact and friction vary within a sample too. shape: (n_modes,) at the force; rms, N; times, s.
    """
    n = modes.n_modes
    size = 2 * n + 1
    a = np.zeros((size, size))
    modes = _without_zero_frequencies(modes, sample_time)
    a[: 2 * n, : 2 * n] = modes.state_matrix
    a[n : 2 * n, -1] = shape
    a[-1, -1] = -1.0 / correlation_time
    # displacements scaled as velocities, so that the norm of the matrix is about the highest frequency
    scale = np.r_[np.maximum(modes.omega, 0.1 * modes.omega[-1]), np.ones(n + 1)]
    a = a * scale[:, None] / scale
    drive = np.zeros((size, size))
    drive[-1, -1] = 2.0 * rms**2 / correlation_time
    halvings = max(0, int(np.ceil(np.log2(2.0 * np.abs(a).sum(axis=1).max() * sample_time))))
    transition, noise = integrated(a, drive, sample_time, halvings)
    transition = transition / scale[:, None] * scale
    noise = 0.5 * (noise + noise.T) / scale[:, None] / scale
    h = np.hstack([model.output, (model.feedthrough + model.before) @ shape[:, None]])
    return _steady_state(transition, h, noise, model.noise_variance)


def _steady_state(a: np.ndarray, h: np.ndarray, q: np.ndarray, noise_variance: np.ndarray) -> ForceFilter:
    """The steady-state filter of a transition, an output and a process noise covariance, by doubling.

    Chu, Fan, Lin & Wang, Int. J. Control 77 (2004) 767: it preserves the structure; about fifteen doublings are needed.
    """
    ak, gk, hk = a.T.copy(), h.T @ (h / noise_variance[:, None]), q.copy()
    eye = np.eye(a.shape[0])
    for _ in range(MAX_DOUBLINGS):
        inverse = np.linalg.inv(eye + gk @ hk)
        forward = ak @ inverse
        change = ak.T @ hk @ inverse @ ak
        gk = gk + forward @ gk @ ak.T
        ak = forward @ ak
        hk = hk + change
        if np.abs(change).max() <= 1e-10 * np.abs(hk).max():
            break
    covariance = 0.5 * (hk + hk.T)
    s = h @ covariance @ h.T + np.diag(noise_variance)
    gain = np.linalg.solve(s, h @ covariance @ a.T).T
    return ForceFilter(a, h, covariance, gain, s)


def accumulated(a: Floats, q: Floats) -> Floats:
    """Σ Aᵏ Q (Aᵏ)ᵀ, (n, n), of a stable A, by doubling: Smith, SIAM J. Appl. Math. 16 (1968) 198.

    A linear solution is inaccurate for badly scaled states, or several stages near a random walk.
    """
    whole, step = q, a
    for _ in range(MAX_DOUBLINGS):
        more = whole + step @ whole @ step.T
        if np.array_equal(more, whole):
            break
        whole, step = more, step @ step
    return whole


@njit(cache=True, nogil=True)
def _propagate(a: Floats, x: Floats) -> None:
    """Add a x_k to x_k+1, row after row of x (n_samples + 1, n_lanes); a (n_states, n_lanes)."""
    for k in range(x.shape[0] - 1):
        now = x[k]
        for i in range(a.shape[0]):
            x[k + 1, i] += row_times(a, i, now)


def driven(a: Floats, drive: Floats) -> Floats:
    """States x_k+1 = a x_k + drive_k from rest: (n_states, n_samples + 1) of a drive (n_states, n_samples)."""
    states = on_lanes(np.pad(drive, ((0, 0), (1, 0))).T)
    _propagate(on_lanes(a), states)
    return states[:, : len(a)].T


def innovations(filter_: ForceFilter, residual: Floats) -> Floats:
    """One-step prediction errors (n_sensors, n_samples) of a residual, from rest."""
    closed = filter_.a - filter_.gain @ filter_.h
    return residual - filter_.h @ driven(closed, filter_.gain @ residual)[:, :-1]


def log_likelihood(filter_: ForceFilter, residuals: Sequence[Floats]) -> float:
    """Gaussian log-likelihood of residual records under the filter, constants left out.

    -∞ if the innovations diverge, or if the covariance is not positive by rounding, as with absurdly large readings.
    """
    found = 0.0
    for residual in residuals:
        e = innovations(filter_, residual)
        if not np.abs(e).max() < MAX_INNOVATION:
            return -np.inf
        try:
            white = _of_unit_covariance(filter_, e)
        except np.linalg.LinAlgError:
            return -np.inf
        squares = np.einsum("jk,jk->k", white, white)
        found += float((-0.5 * (squares + float(np.linalg.slogdet(filter_.innovation)[1]))).sum())
    return found


def whiten(filter_: ForceFilter, residual: Floats) -> Floats:
    """Innovations of unit covariance (n_sensors, n_samples)."""
    return _of_unit_covariance(filter_, innovations(filter_, residual))


def _of_unit_covariance(filter_: ForceFilter, errors: Floats) -> Floats:
    """Innovations (n_sensors, n_samples) scaled to unit covariance."""
    # innovations that have diverged may be nan, and stay so
    root = np.linalg.cholesky(filter_.innovation)
    return np.asarray(solve_triangular(root, errors, lower=True, check_finite=False))


def smoothed_states(filter_: ForceFilter, residual: Floats) -> Floats:
    """Smoothed augmented states (2n + m, n_samples): the error of the simulated motion, and the unmodelled forces.

    Bryson-Frazier form: the adjoint, integrated backwards, avoids the inverse of a covariance.
    """
    e = innovations(filter_, residual)
    weighted = filter_.h.T @ np.linalg.solve(filter_.innovation, e)
    closed = filter_.a - filter_.gain @ filter_.h
    predicted = driven(filter_.a, filter_.gain @ e)[:, :-1]
    adjoint = driven(closed.T, weighted[:, ::-1])[:, :0:-1]
    return predicted + filter_.covariance @ adjoint


def smoothed_covariance(filter_: ForceFilter) -> Floats:
    """Covariance (n_states, n_states) of the error of smoothed states, far from the ends of a record.

    P - P Λ P, with Λ the covariance of the adjoint: Λ = (A - K H)ᵀ Λ (A - K H) + Hᵀ S⁻¹ H.
    """
    h, p = filter_.h, filter_.covariance
    closed = filter_.a - filter_.gain @ h
    adjoint = accumulated(closed.T, h.T @ np.linalg.solve(filter_.innovation, h))
    return np.asarray(p - p @ adjoint @ p)
