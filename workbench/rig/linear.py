"""Exact propagation of a linear rig: held inputs, delays, lags and sinusoids in closed form, pole by pole."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import expm

from workbench.arrays import Complexes, Floats
from workbench.structure.modes import modal_state_matrix

CLOSE = 1e-9  # of a lag's rate: least distance of a pole from it, to avoid 0/0
EVEN = 1e-9  # of a sample: a delay nearer to a whole number of samples is rounded to it


@dataclass(frozen=True, eq=False)
class ModalPoles:
    """The modal equations in the coordinates of their poles: s' = λ s + W p, q = Re(Q s), q' = Re(Q Λ s).

    Attributes:
        poles: (n_poles,) complex λ, one of each conjugate pair.
        weights: (n_poles, n_modes) W, how the modal forces p drive each pole.
        shapes: (n_modes, n_poles) Q, with a factor 2 for each conjugate pair.
        uncoupled: whether each mode has its own pole pair; Q is then twice the identity.
    """

    poles: np.ndarray
    weights: np.ndarray
    shapes: np.ndarray
    uncoupled: bool = False


def modal_poles(omega: np.ndarray, damping: np.ndarray) -> ModalPoles:
    """Poles of q'' + C q' + Ω² q = p, coupled or not.

    An undamped rigid-body mode has a double pole at zero, without a diagonal form: its frequency is set to a millionth
    of the lowest elastic one, with an error below 1e-8 over ten periods of that.
    """
    elastic = omega[omega > 0]
    tiny = 1e-6 * (elastic.min() if elastic.size else 1.0)
    omega = np.maximum(omega, tiny)
    diagonal = np.diag(damping)
    if np.abs(damping - np.diag(diagonal)).max() == 0 and (diagonal < 2 * omega).all():
        poles = -0.5 * diagonal + 1j * np.sqrt(omega**2 - 0.25 * diagonal**2)
        return ModalPoles(poles, np.diag(1.0 / (2j * poles.imag)), 2.0 * np.eye(omega.size), uncoupled=True)
    n = omega.size
    values, vectors = np.linalg.eig(modal_state_matrix(omega**2, damping))
    inverse = np.linalg.inv(vectors)
    keep = values.imag >= 0
    twice = np.where(values.imag > 0, 2.0, 1.0)
    return ModalPoles(values[keep], inverse[keep][:, n:], (vectors[:n] * twice)[:, keep])


def integrated(a: Floats, q: Floats, time: float, halvings: int) -> tuple[Floats, Floats]:
    """e^(A t) and ∫_0^t e^(A s) Q e^(Aᵀ s) ds, by one block exponential over t / 2^halvings and repeated doubling.

    Van Loan, IEEE Trans. Automatic Control 23 (1978) 395.
    """
    size = len(a)
    short = expm(np.block([[-a, q], [np.zeros_like(a), a.T]]) * time / 2**halvings)
    transition: Floats = short[size:, size:].T
    integral: Floats = transition @ short[:size, size:]
    for _ in range(halvings):
        integral = integral + transition @ integral @ transition.T
        transition = transition @ transition
    return transition, integral


@njit(cache=True, nogil=True)
def _recursion(decay: Complexes, drive: Complexes, out: Complexes) -> None:
    """Fill out[i, k + 1] = decay[i] out[i, k] + drive[i, k] from a given out[:, 0]."""
    for i in range(drive.shape[0]):
        s = out[i, 0]
        d = decay[i]
        for k in range(drive.shape[1] - 1):
            s = d * s + drive[i, k]
            out[i, k + 1] = s


@njit(cache=True, nogil=True)
def _driven(
    decay: Complexes, newly: Complexes, newer: Floats, before: Complexes, older: Floats, out: Complexes
) -> None:
    """Fill out[i, k + 1] = decay[i] out[i, k] + newly[i] newer[i, k] + before[i] older[i, k]; `older` may be empty."""
    for i in range(out.shape[0]):
        s = out[i, 0]
        d, a, b = decay[i], newly[i], before[i]
        for k in range(out.shape[1] - 1):
            s = d * s + a * newer[i, k]
            if older.shape[1]:
                s += b * older[i, k]
            out[i, k + 1] = s


@njit(cache=True, nogil=True)
def _real_motion(poles: Complexes, response: Complexes, displacement: Floats, velocity: Floats) -> None:
    """Fill displacements 2 Re s and velocities 2 Re λs from the coordinates s of uncoupled poles λ."""
    for i in range(response.shape[0]):
        sigma, omega = poles[i].real, poles[i].imag
        for k in range(response.shape[1]):
            s = response[i, k]
            displacement[i, k] = 2.0 * s.real
            velocity[i, k] = 2.0 * (sigma * s.real - omega * s.imag)


def whole_samples(delay: float, period: float) -> tuple[int, float]:
    """The whole samples of a delay, and the remainder, s."""
    whole = int(delay / period + EVEN)
    rest = delay - whole * period
    return whole, rest if rest > EVEN * period else 0.0


def held_response(
    system: ModalPoles,
    forces: np.ndarray,
    participation: np.ndarray,
    sample_time: float,
    *,
    delay: float = 0.0,
    time_constant: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Pole coordinates under inputs held over each sample, delayed and lagged.

    Args:
        system: the poles.
        forces: (n_inputs, n_samples) values held from t_k to t_k+1.
        participation: (n_modes, n_inputs) modal forces per unit input.
        sample_time, delay, time_constant: s, the delay common to these inputs, before the first-order lag.

    Returns:
        s (n_poles, n_samples), and the forces that act at the sample instants (n_inputs, n_samples).
    """
    poles, weights = system.poles, system.weights @ participation
    n_samples = forces.shape[1]
    shift, rest = whole_samples(delay, sample_time)
    older = shifted(forces, shift + 1)
    newer = shifted(forces, shift)
    response = np.zeros((poles.size, n_samples), complex)
    decay = np.exp(poles * sample_time)
    if time_constant == 0:
        over_sample, over_newer = _growth(poles, sample_time), _growth(poles, sample_time - rest)
        if system.uncoupled:
            own = np.diag(system.weights)
            before = participation @ older if rest > 0 else np.zeros((poles.size, 0))
            _driven(decay, own * over_newer, participation @ newer, own * (over_sample - over_newer), before, response)
        else:
            drive = over_newer[:, None] * (weights @ newer)
            if rest > 0:
                drive += (over_sample - over_newer)[:, None] * (weights @ older)
            _recursion(decay, drive, response)
        return response, newer if rest == 0 else older
    rate = 1.0 / time_constant
    acting = np.zeros_like(forces)
    fade = np.exp(-rate * (sample_time - rest))
    command_drive = (1.0 - fade) * newer + fade * (1.0 - np.exp(-rate * rest)) * older
    _recursion(np.full(forces.shape[0], np.exp(-rate * sample_time)), command_drive, acting)
    # over [0, rest) the command is `older`, then `newer`; the force approaches each exponentially
    second = sample_time - rest
    middle = older + (acting - older) * np.exp(-rate * rest)
    drive = np.exp(poles * second)[:, None] * (
        _growth(poles, rest)[:, None] * (weights @ older)
        + _faded_growth(poles, rate, rest)[:, None] * (weights @ (acting - older))
    )
    drive += _growth(poles, second)[:, None] * (weights @ newer)
    drive += _faded_growth(poles, rate, second)[:, None] * (weights @ (middle - newer))
    _recursion(decay, drive, response)
    return response, acting


def first_order_hold_response(
    system: ModalPoles,
    forces: np.ndarray,
    participation: np.ndarray,
    sample_time: float,
    *,
    delay: float = 0.0,
    time_constant: float = 0.0,
    every: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Pole coordinates under inputs that are linear between samples and zero before the first (first-order hold).

    With the response R_λ of a pole to the inputs, the response to inputs with a lag T is (R_λ - R_{-1/T}) / (1 + λ T).

    Args:
        system, forces, participation, sample_time, delay, time_constant: as of `held_response`.
        every: results are of every so many samples; n_samples is a multiple of it.

    Returns:
        As `held_response`.
    """
    poles, weights = system.poles, system.weights @ participation
    n_inputs, n_samples = forces.shape
    late, rest = whole_samples(delay, sample_time)
    remaining = sample_time - rest
    # of each step: the delayed samples within it, one before and one after it
    padded = np.concatenate([np.zeros((n_inputs, late + 1)), forces, forces[:, -1:]], axis=1)[:, : n_samples + 2]
    strided = sliding_window_view(padded, every + 2, axis=1)[:, ::every].transpose(0, 2, 1)
    windows = np.ascontiguousarray(strided)  # (n_inputs, every + 2, n_steps)
    share = remaining / (rest + remaining)  # of the next sample in the value at a sample, once delayed

    def responses(poles: Complexes) -> Iterator[Complexes]:
        """Coordinates (n_poles, n_steps) of the poles that each input alone drives."""
        before, after = _ends_of_ramp(poles, rest), _ends_of_ramp(poles, remaining)
        fade = np.exp(poles * remaining)
        # weights of the last, this and the next delayed sample in one interval, two linear pieces
        to_this, to_next = fade * (share * before[0] + before[1]), share * after[1]
        of_samples = fade * (1.0 - share) * before[0], to_this + after[0] + (1.0 - share) * after[1], to_next
        decay = np.exp(np.outer(poles, (rest + remaining) * np.arange(every - 1, -1, -1)))
        weights = np.zeros((poles.size, every + 2), complex)
        for i, weight in enumerate(of_samples):
            weights[:, i : i + every] += weight[:, None] * decay
        for window, first in zip(windows, forces[:, 0], strict=True):
            # two real products: one of complex by real numbers takes four
            drive = weights.real @ window + 1j * (weights.imag @ window)
            # no ramp from the zero before to the first sample, where the inputs begin with a step
            for interval, ramp in ((late - 1, to_next), (late, to_this)):
                step, sample = divmod(interval, every)
                if 0 <= step < drive.shape[1]:
                    drive[:, step] -= first * ramp * decay[:, sample]
            response = np.zeros(drive.shape, complex)
            _recursion(np.exp(poles * (rest + remaining) * every), drive, response)
            yield response

    response = np.zeros((poles.size, n_samples // every), complex)
    for weight, own in zip(weights.T, responses(poles), strict=True):
        response += weight[:, None] * own
    if time_constant == 0:
        at_steps = (1.0 - share) * windows[:, 0] + share * windows[:, 1]
        step, sample = divmod(late, every)
        if rest > 0 and sample == 0 and step < at_steps.shape[1]:
            at_steps[:, step] = 0.0
        return response, at_steps
    denominator = 1.0 + poles * time_constant
    denominator = np.where(np.abs(denominator) < CLOSE, CLOSE, denominator)
    of_lag = responses(np.array([-1.0 / time_constant], complex))
    lagging = np.reshape([own[0].real for own in of_lag], (n_inputs, -1))
    return (response - weights @ lagging) / denominator[:, None], lagging / time_constant


def sinusoid_response(
    system: ModalPoles, participation: np.ndarray, omega: float, phasor: complex, sample_time: float, n_samples: int
) -> np.ndarray:
    """Pole coordinates (n_poles, n_samples) under the modal force participation · Im(phasor e^{iωt}), from rest."""
    weights = system.weights @ participation
    rotation = np.exp(1j * omega * sample_time * np.arange(n_samples))
    positive = weights * (phasor / 2j) / (1j * omega - system.poles)
    negative = weights * (-np.conj(phasor) / 2j) / (-1j * omega - system.poles)
    # the steady response, plus a free motion for zero initial conditions
    response = np.empty((system.poles.size, n_samples), complex)
    response[:, 0] = -(positive + negative)
    _recursion(np.exp(system.poles * sample_time), np.zeros_like(response), response)
    return response + np.outer(positive, rotation) + np.outer(negative, rotation.conj())


def modal_motion(system: ModalPoles, response: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Modal displacements and velocities (n_modes, n_samples) from pole coordinates."""
    if system.uncoupled:
        displacement, velocity = np.empty(response.shape), np.empty(response.shape)
        _real_motion(system.poles, response, displacement, velocity)
        return displacement, velocity
    rates = system.shapes * system.poles
    return _real_product(system.shapes, response), _real_product(rates, response)


def _real_product(a: np.ndarray, b: np.ndarray) -> Floats:
    product: Floats = a.real @ np.ascontiguousarray(b.real)
    if np.iscomplexobj(a):
        product = product - a.imag @ np.ascontiguousarray(b.imag)
    return product


def _growth(poles: np.ndarray, span: float) -> np.ndarray:
    """∫_0^span e^{λ t} dt."""
    z = poles * span
    zero = z == 0  # of a rigid mode, also by underflow
    return span * np.where(zero, 1.0, np.expm1(z) / np.where(zero, 1.0, z))


def _ramp_growth(poles: np.ndarray, span: float) -> np.ndarray:
    """∫_0^span e^{λ (span - t)} t/span dt."""
    z = poles * span
    small = np.abs(z) < 0.1
    x = np.where(small, z, 0.0)
    series = 1.0 / 2 + x * (1.0 / 6 + x * (1.0 / 24 + x * (1.0 / 120 + x * (1.0 / 720 + x / 5040.0))))
    return span * np.where(small, series, (np.expm1(z) - z) / np.where(small, 1.0, z) ** 2)


def _ends_of_ramp(poles: Complexes, span: float) -> tuple[Complexes, Complexes]:
    """Weights of the values at both ends of a linear force over a span in the coordinates at its end."""
    rise = _ramp_growth(poles, span)
    return _growth(poles, span) - rise, rise


def _faded_growth(poles: Complexes, rate: float, span: float) -> Complexes:
    """∫_0^span e^{λ (span - t)} e^{-rate t} dt."""
    total = (poles + rate) * span
    near = np.abs(total) < 1.0
    difference = np.exp(poles * span) - np.exp(-rate * span)
    grown: Complexes = np.where(near, np.exp(-rate * span) * np.expm1(np.where(near, total, 0.0)), difference)
    return grown / (poles + rate)


def shifted(values: np.ndarray, samples: int) -> np.ndarray:
    """Values (..., n_samples) delayed by a number of samples, zero before the first."""
    if samples == 0:
        return values
    later = np.zeros_like(values)
    if samples < values.shape[-1]:
        later[..., samples:] = values[..., : values.shape[-1] - samples]
    return later


@njit(cache=True, nogil=True)
def propagators(omega: Floats, c: Floats, h: float, out: Floats) -> None:
    """Fill out (2, 4, n_modes): q and q' after h from (q, q', force at start, force at end), force linear between."""
    for r in range(omega.size):
        w = omega[r]
        half = 0.5 * c[r]
        root = np.sqrt(complex(half * half - w * w, 0.0))
        if abs(root) * h < 1e-7:
            root = complex(1e-7 / h, 0.0)
        l1, l2 = -half + root, -half - root
        spread = l1 - l2
        e1, e2 = np.exp(l1 * h), np.exp(l2 * h)
        out[0, 0, r] = ((l1 * e2 - l2 * e1) / spread).real
        out[0, 1, r] = ((e1 - e2) / spread).real
        out[1, 0, r] = (l1 * l2 * (e2 - e1) / spread).real
        out[1, 1, r] = ((l1 * e1 - l2 * e2) / spread).real
        # p_k = ∫ e^{λ(h-s)} ds and m_k = ∫ e^{λ(h-s)} s/h ds
        p1, m1 = _moments(l1, h, e1)
        p2, m2 = _moments(l2, h, e2)
        out[0, 2, r] = ((p1 - m1 - p2 + m2) / spread).real
        out[0, 3, r] = ((m1 - m2) / spread).real
        out[1, 2, r] = ((l1 * (p1 - m1) - l2 * (p2 - m2)) / spread).real
        out[1, 3, r] = ((l1 * m1 - l2 * m2) / spread).real


@njit(cache=True, nogil=True)
def _moments(pole: complex, h: float, e: complex) -> tuple[complex, complex]:
    z = pole * h
    if abs(z) < 0.05:
        p = h * (1 + z / 2 * (1 + z / 3 * (1 + z / 4 * (1 + z / 5 * (1 + z / 6 * (1 + z / 7))))))
        m = h * (0.5 + z / 6 * (1 + z / 4 * (1 + z / 5 * (1 + z / 6 * (1 + z / 7 * (1 + z / 8))))))
        return p, m
    p = (e - 1.0) / pole
    return p, (p / h - 1.0) / pole
