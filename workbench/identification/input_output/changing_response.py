"""A time- or amplitude-dependent mode as the rival model of several close linear modes, for one input and one output.

    z' = (λ + Σ_k c_k g_k) z + l u,      g = t, t², t³,  or  r^p, r = |z| over its maximum,

with a few powers p, those of a free decay (`backbone`). The forcing from sample to sample is that of the constant
mode; the remaining change of the rate is integrated by Heun's method. The changing mode has no more parameters than the
linear modes, so the model of the higher likelihood is preferred. All are compared in the lines of the cosine transform
about the modes.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from workbench.arrays import Floats
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit
from workbench.identification.input_output.noise_spectrum import lines_of
from workbench.identification.input_output.rivals import (
    RIVALS,
    bases_with_changes,
    beyond_linear,
    diverged,
    projected_residual,
)
from workbench.identification.signal.searches import Budget, Once


@dataclass(frozen=True)
class ChangingResponseSettings:
    """Constants of the fit of one changing mode to records with known inputs."""

    most_tries: int = 40  # evaluations of a fit
    insensitive: float = 1e-4  # of the largest column of the Jacobian: an unknown of a smaller one is held
    faded: float = 16.0  # standard deviations of time about the mean time of the energy, beyond which the rate is held
    least: float = 1e-3  # of the largest amplitude: below it the rate is held
    undriven: float = 1e-12  # forcing over the largest amplitude, below which the mode is in free decay
    step: float = 0.005  # time constants: largest step of a free decay
    largest: float = 1e3  # times the amplitude of the constant mode: beyond this a motion diverges
    # logarithm of the squares beyond those that the linear modes leave, from which a law is given up after its first
    # step. Of laws that were right in the end it was 1 at most, of two linear modes in place of one it is 4 to 9
    hopeless: float = 2.5
    # stalled: the same, by which a fit that leaves more than the linear modes must fall within so many evaluations
    stalled: tuple[float, int] = (0.02, 4)


RESPONSE = ChangingResponseSettings()
CHANGE_CHECK = "check of modes that change within the record"  # its name where the time is spent
Law = tuple[bool, tuple[float, ...]]  # whether the rate changes with time, and the powers
# λ is one coefficient more.
LAWS: tuple[Law, ...] = (
    (True, (1.0, 2.0)),
    (False, (1.0, 2.0)),
    (False, (0.5, 1.0)),
    (False, (-1.0, 1.0)),
    (True, (1.0, 2.0, 3.0)),
    (False, (0.5, 1.0, 2.0)),
    (False, (-1.0, 1.0, 2.0)),
)
INVERSES = (1 / 6, 1 / 5, 1 / 4, 1 / 3, 1 / 2, 1.0)  # of the terms of an exponential series, last first


class _GivenUp(Exception):
    """A law is hopeless after its first step or stalls, or the time is spent."""


def in_place_of(
    data: KnownInputs, fit: Fit, cluster: np.ndarray, limit: float, budget: Budget
) -> tuple[KnownInputs, complex] | None:
    """`in_place_of_clusters`, for one cluster: the records beside the changing mode, and its pole."""
    response = _Response(data, fit, cluster)
    linear = response.linear_residual()
    n_excitations, n_outputs = fit.participation.shape[1], fit.noise.size
    threshold = np.log(_squares(linear, n_outputs)).sum() + limit * (cluster.size - 1) / (linear.size // n_outputs)
    n_coefficients = cluster.size * (n_excitations + n_outputs) - (n_excitations - 1 + n_outputs)
    given_up: set[Law] = set()
    for law in LAWS:
        if budget.spent(CHANGE_CHECK):
            break
        by_time, powers = law
        parts = {other for other in LAWS if other[0] == by_time and set(other[1]) < set(powers)}
        if len(powers) + 1 > n_coefficients or (parts and parts <= given_up):
            continue
        try:
            changing = response.fitted(law, threshold, budget)
        except _GivenUp:
            given_up.add(law)
        else:
            if changing is not None:
                return changing
    return None


def _squares(residual: Floats, n_outputs: int) -> Floats:
    squares = (residual.reshape(n_outputs, -1) ** 2).sum(axis=1)
    return np.asarray(squares + 1e-300)


@njit(cache=True, nogil=True)
def _power(size: float, exponent: float) -> float:
    """A power of a size; those of the laws without the general function, which took half of the time."""
    if exponent == 1.0:
        return size
    if exponent == 2.0:
        return size * size
    if exponent == 3.0:
        return size * size * size
    if exponent == 0.5:
        return float(np.sqrt(size))
    if exponent == -1.0:
        return 1.0 / size
    return float(size**exponent)


@njit(cache=True, nogil=True)
def _exponential(x: complex) -> complex:
    """e^x; of a small x by the series, exact to the last bit."""
    if abs(x.real) + abs(x.imag) > 0.01:
        return complex(np.exp(x))
    series = 1.0 + 0.0j
    for factor in INVERSES:
        series = 1.0 + factor * x * series
    return series


@njit(cache=True, nogil=True)
def _simulated(
    start: np.ndarray, drive: np.ndarray, change: np.ndarray, powers: Floats, by_time: bool, step: complex,
    scale: float, least: float, largest: float, dt: float, middle: float, width: float, faded: float,
    driven: int, many: int,
) -> np.ndarray:  # fmt: skip
    """z of a mode at the samples, (n, n_cases), for each row of coefficients c_0, c_1, ... (n_cases, 1 + n_powers).

    Args:
        start: (n_cases,) at the first sample.
        drive: (n - 1, n_cases) forcing of the constant mode from each sample to the next.
        change: (n_cases, 1 + n_powers) coefficients of the rate.
        step: e^{λΔt}.
        scale: largest amplitude of the constant mode.
        middle, width: mean and standard deviation of the time of the energy, as shares of the record.
        driven: number of samples after which there is no forcing.
        many: samples of a step from there on, within which the rate varies linearly.
    """
    n, n_cases = drive.shape[0] + 1, drive.shape[1]
    z = np.zeros((n, n_cases), np.complex128)
    for i in range(n_cases):
        current = start[i]
        z[0, i] = current
        k = 0
        while k < n - 1:
            n_steps = 1 if k < driven else min(many, n - 1 - k)
            propagated = step if n_steps == 1 else step**n_steps
            force = drive[k, i] if k < driven else 0j
            first, predicted = 0j, current
            for stage in range(2):
                size = (
                    min(((k + stage * n_steps) / (n - 1) - middle) / width, faded)
                    if by_time
                    else max(np.sqrt(predicted.real**2 + predicted.imag**2) / scale, least)
                )
                change_rate = change[i, 0]
                for p in range(powers.size):
                    change_rate += change[i, p + 1] * _power(size, powers[p])
                if stage == 0:
                    first = change_rate
                rate = 0.5 * (first + change_rate)
                half = _exponential(0.5 * rate * n_steps * dt)  # a force acts in steps of one sample only
                predicted = half * (propagated * half * current + force)
            if n_steps > 1:
                rate_slope = (rate - first) * 2.0 * dt / n_steps
                factor, factor_step = step * np.exp(first * dt + 0.5 * rate_slope), np.exp(rate_slope)
                for j in range(1, n_steps):
                    z[k + j, i] = z[k + j - 1, i] * factor
                    factor *= factor_step
            current = predicted
            if not abs(current) < largest * scale:
                z[k + 1 :, i] = np.nan
                break
            k += n_steps
            z[k, i] = current
    return z


def _with_neighbours(unknowns: Floats) -> Floats:
    """Unknowns, then those with each slightly larger in turn, (1 + n_unknowns, n_unknowns)."""
    return np.vstack([unknowns, unknowns + RIVALS.slightly * np.eye(unknowns.size)])


class _Response:
    """The fit of laws about a cluster of modes by variable projection of the amplitudes.

    The poles of the other modes may change to first order.
    """

    def __init__(self, data: KnownInputs, fit: Fit, cluster: np.ndarray) -> None:
        self.data, self.fit = data, fit
        poles = fit.poles[cluster]
        rates = np.maximum(-poles.real, RIVALS.slowest * data.resolution)
        power = np.abs(fit.amplitudes[:, cluster] / fit.noise[:, None]).max(axis=0) ** 2 / rates
        self.pole = complex(np.average(-rates + 1j * poles.imag, weights=power))
        self.rate, self.participation = -self.pole.real, fit.participation[cluster[0]]
        self.cluster = cluster
        margin = max(RIVALS.about * self.rate, RIVALS.fewest * data.resolution)
        self.low, self.high = poles.imag.min() - margin, poles.imag.max() + margin
        free = np.eye(self.participation.size)
        each = [data.modal_coordinate(self.pole, excitation) for excitation in free]
        self.coordinates = [np.column_stack(parts) for parts in zip(*each, strict=True)]
        norms = np.sqrt(sum((np.abs(z) ** 2).sum(axis=0) for z in self.coordinates))
        held = int(np.argmax(norms * np.abs(self.participation)))
        self.participation = self.participation / self.participation[held]
        self.held = held
        self.others = np.delete(np.arange(norms.size), held)
        self.units = norms[held] / np.maximum(norms[self.others], 1e-300)
        self.scale = max(max(float(np.abs(z @ self.participation).max()) for z in self.coordinates), 1e-300)
        energy = [np.abs(z @ self.participation) ** 2 for z in self.coordinates]
        share = np.concatenate([np.linspace(0.0, 1.0, each.size) for each in energy])
        self.middle = float(np.average(share, weights=np.concatenate(energy) + 1e-300))
        self.width = float(np.sqrt(np.average((share - self.middle) ** 2, weights=np.concatenate(energy) + 1e-300)))
        self.weights = [np.ones((1, 1))] * fit.noise.size
        if data.weights is not None:
            self.weights = list(np.vstack([self._about(data.weights[part]) for part in data.rows]).T[:, :, None])
        others = np.setdiff1d(np.arange(fit.poles.size), cluster)
        self.bases = bases_with_changes(data, fit, others, self.weights, self._lines)
        self.values = self._beyond(self.bases, self._lines(data.values).T)

    def linear_residual(self) -> Floats:
        """Residual of the linear modes in the lines about the cluster, (n,), all of them re-fitted to first order."""
        every_mode = np.arange(self.fit.poles.size)
        bases = bases_with_changes(self.data, self.fit, every_mode, self.weights, self._lines, poles_only=False)
        return np.concatenate(self._beyond(bases, self._lines(self.fit.residual).T))

    def _beyond(self, bases: Sequence[Floats], outputs: Iterable[Floats]) -> list[Floats]:
        """What bases do not explain of each output, (n_lines,) or (n_lines, k), in units of its noise."""
        scaled = [x / noise for x, noise in zip(outputs, self.fit.noise, strict=True)]
        return [x - basis @ (basis.T @ x) for x, basis in zip(scaled, bases, strict=True)]

    def fitted(self, law: Law, threshold: float, budget: Budget) -> tuple[KnownInputs, complex] | None:
        """The records beside the changing mode of a law, and its pole; None where it leaves too large a residual.

        Args:
            threshold: largest logarithm of the squares of the residual.

        Raises:
            _GivenUp: the first step leaves far more, the fit stalls above the threshold, or the time is spent.
        """
        once = Once(lambda x: self._residual(self._motions(_with_neighbours(x), law)))
        start = self._start(law)
        unknowns = np.r_[start.real, start.imag]
        sensitivity = np.linalg.norm(once(unknowns)[1], axis=0)
        # After an impact, an initial state excites a mode as the input does.
        active = sensitivity > RESPONSE.insensitive * sensitivity.max()
        if not active.any():
            return None

        def beyond_threshold(residual: Floats) -> float:
            return float(np.log(_squares(residual, self.fit.noise.size)).sum() - threshold)

        beyond: list[float] = []

        def among_active(x: Floats) -> tuple[Floats, Floats]:
            unknowns[active] = x
            if len(beyond) == 1:  # without the Jacobian, which takes most of the time
                first = beyond_threshold(self._residual(self._motions(unknowns[None], law))[0])
                if min(*beyond, first) > RESPONSE.hopeless:
                    raise _GivenUp
            if budget.spent(CHANGE_CHECK):
                raise _GivenUp
            residual, jacobian = once(unknowns)
            beyond.append(beyond_threshold(residual))
            fall, within = RESPONSE.stalled
            if 0.0 < min(beyond) and min(beyond[:-within], default=np.inf) < min(beyond) + fall:
                raise _GivenUp
            return residual, jacobian[:, active]

        unknowns[active] = Once(among_active).least(unknowns[active], RESPONSE.most_tries)
        if beyond_threshold(once(unknowns)[0]) > 0.0:
            return None
        motions = self._motions(_with_neighbours(unknowns), law)
        rows = self.data.rows_of([np.hstack([z.real, z.imag]) for z in motions])
        further, pole = beyond_linear(self.data, rows, self.pole, self.participation)
        return self.data.with_columns(further, (pole,)), pole

    def _start(self, law: Law) -> np.ndarray:
        """Starting coefficients of a law: regression on the sum of the linear modes, from sample to sample."""
        fit, dt, (by_time, powers) = self.fit, self.data.dt, law
        weighted_shape = fit.amplitudes[:, self.cluster[0]] / fit.noise**2
        strength = weighted_shape.conj() @ fit.amplitudes[:, self.cluster]
        participation = strength @ fit.participation[self.cluster]
        unit = participation[self.held]
        regressors: list[np.ndarray] = []
        rates: list[np.ndarray] = []
        modes = [
            (a / unit, pole, self.data.modal_coordinate(pole, l_r))
            for a, pole, l_r in zip(strength, fit.poles[self.cluster], fit.participation[self.cluster], strict=True)
        ]
        for k in range(len(self.coordinates)):
            z = sum(a * each[k] for a, _, each in modes)
            propagated = sum(a * np.exp(pole * dt) * each[k][:-1] for a, pole, each in modes)
            n = z.size
            time = np.minimum((np.arange(n - 1) / (n - 1) - self.middle) / self.width, RESPONSE.faded)
            size = time if by_time else np.maximum(np.abs(z[:-1]) / self.scale, RESPONSE.least)
            regressor = np.column_stack([np.ones(n - 1), size[:, None] ** np.array(powers)])
            regressors.append(regressor * z[:-1, None])
            rates.append((propagated * np.exp(-self.pole * dt) - z[:-1]) / dt / self.rate)
        coefficients = np.linalg.lstsq(np.vstack(regressors), np.concatenate(rates), rcond=None)[0]
        held_factors = self.participation[self.others]
        return np.asarray(np.r_[coefficients, (participation[self.others] / unit - held_factors) / self.units])

    def _motions(self, cases: Floats, law: Law) -> list[np.ndarray]:
        """z of each record at the first case, and its change to each other, (n_samples, n_cases) each.

        Args:
            cases: (n_cases, n_unknowns), as `_with_neighbours` gives, or the first of these alone.
        """
        (by_time, powers), half = law, cases.shape[1] // 2
        coefficients = cases[:, :half] + 1j * cases[:, half:]
        size = 1 + len(powers)
        participation = np.tile(self.participation, (len(cases), 1))
        participation[:, self.others] += coefficients[:, size:] * self.units
        step, motions = np.exp(self.pole * self.data.dt), []
        for z in self.coordinates:
            all_cases = z @ participation.T
            drive = all_cases[1:] - step * all_cases[:-1]
            driven_samples = np.flatnonzero(np.abs(drive).max(axis=1) > RESPONSE.undriven * self.scale)
            simulated = _simulated(
                np.ascontiguousarray(all_cases[0]), drive, self.rate * coefficients[:, :size], np.array(powers),
                by_time, step, self.scale, RESPONSE.least, RESPONSE.largest, self.data.dt, self.middle, self.width,
                RESPONSE.faded, int(driven_samples[-1]) + 1 if driven_samples.size else 0,
                max(int(RESPONSE.step / (self.rate * self.data.dt)), 1),
            )  # fmt: skip
            motions.append(np.column_stack([simulated[:, 0], (simulated[:, 1:] - simulated[:, :1]) / RIVALS.slightly]))
        return motions

    def _residual(self, motions: list[np.ndarray]) -> tuple[Floats, Floats]:
        """Residual (n,) and its Jacobian (n, n_unknowns)."""
        if not all(np.isfinite(each).all() for each in motions):
            return diverged(self.values, motions[0].shape[1] - 1)
        rows = np.vstack([self._about(lines_of(np.hstack([z.real, z.imag]))) for z in motions])
        return projected_residual(self.values, self._beyond(self.bases, [weight * rows for weight in self.weights]))

    def _lines(self, rows: Floats) -> Floats:
        """Lines about the cluster, from rows of the fit."""
        parts = [rows[part] for part in self.data.rows]
        return np.vstack([self._about(x if self.data.rows_are_lines else lines_of(x)) for x in parts])

    def _about(self, lines: Floats) -> Floats:
        """Those of the lines of one record that lie about the cluster."""
        line = np.pi / self.data.dt / len(lines)
        return lines[max(int(self.low / line), 0) : int(self.high / line) + 2]
