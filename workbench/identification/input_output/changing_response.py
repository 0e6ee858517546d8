"""A time- or amplitude-dependent mode against several close linear modes, for one input and one output.

    z' = (λ + Σ_k c_k g_k) z + l u,      g = t, t², t³,  or  r^p, r = |z| over its maximum,

with a few powers p, those of a free decay (`backbone`). The forcing from sample to sample is that of the constant
mode; the remaining change of the rate is integrated by Heun's method, and its derivatives by the unknowns with it. The
changing mode has no more parameters than the linear modes. For those that it has less, linear modes must be likelier by
the threshold of a further mode; of equally many, the likelier model is preferred. All are compared in the lines of the
cosine transform about the modes.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.optimize import least_squares

from workbench.arrays import Floats
from workbench.identification.input_output.competing_models import COMPETING, bases_with_changes, beyond_linear
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit
from workbench.identification.input_output.noise_spectrum import lines_of
from workbench.identification.signal.searches import TimeLimit, diverged, projected_residual


@dataclass(frozen=True)
class ChangingResponseSettings:
    """Constants of the fit of one changing mode to records with known inputs."""

    max_evaluations: int = 40  # evaluations of a fit
    min_sensitivity: float = 1e-4  # of the largest column of the Jacobian: an unknown of a smaller one is held
    # standard deviations of time about the mean time of the energy, beyond which the rate is held
    max_time_deviations: float = 16.0
    min_amplitude: float = 1e-3  # of the largest amplitude: below it the rate is held
    min_forcing: float = 1e-12  # forcing over the largest amplitude, below which the mode is in free decay, or at rest
    max_decay_step: float = 0.005  # time constants: largest step of a free decay
    max_amplitude_ratio: float = 1e3  # times the amplitude of the constant mode: beyond this a motion diverges
    # logarithm of the squares beyond those that the linear modes leave, from which a law is given up after its first
    # step. Of laws that were right in the end it was 1 at most, of two linear modes in place of one it is 4 to 9
    max_first_excess: float = 2.5
    # the same of the law of time, from which no other law is tried. It was 3.5 at most where one of amplitude was right
    max_time_excess: float = 5.0
    # evaluations within which the same must fall, by a share of what is left or by the least that counts. Laws that
    # were right in the end halved it by each, until it was none by the third; wrong ones fell slowly for 15 to 40
    stall_evaluations: int = 2
    min_decrease_share: float = 0.5
    pole_tolerance: float = 0.1  # decay rates, by which the poles of a cluster that is not tried again may have moved
    min_decrease: float = 1e-3  # the standard error of the logarithm of the squares of some thousand lines is larger


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


@dataclass(eq=False)
class _GivenUp(Exception):
    """A law is far off after its first step or falls no more, or the time is spent."""

    least: float  # logarithm of the squares beyond the threshold


def in_place_of(
    data: KnownInputs,
    fit: Fit,
    cluster: np.ndarray,
    rows: Floats,
    limit: float,
    time_limit: TimeLimit,
    linear: list[np.ndarray],
) -> tuple[KnownInputs, complex] | None:
    """`in_place_of_clusters`, for one cluster: the records beside the changing mode, and its pole.

    From the `regressors` of the fit. `linear` are the poles of each cluster that no law replaced with an earlier
    estimate of the noise, added to. They are not tried again: about a few modes it weights all lines much alike,
    whichever the model.
    """
    poles = fit.poles[cluster]
    same = -RESPONSE.pole_tolerance * poles.real
    if any(each.size == poles.size and (np.abs(each - poles) < same).all() for each in linear):
        return None
    response = _Response(data, fit, cluster, rows)
    squares, n_excitations = float(np.log(response.linear_squares())), fit.participation.shape[1]
    n_coefficients = cluster.size * (n_excitations + 1) - n_excitations
    given_up: set[Law] = set()
    for law in LAWS:
        if time_limit.spent(CHANGE_CHECK):
            break
        by_time, powers = law
        parts = {other for other in LAWS if other[0] == by_time and set(other[1]) < set(powers)}
        if len(powers) + 1 > n_coefficients or (parts and parts <= given_up):
            continue
        fewer = (n_coefficients - len(powers) - 1) / (n_excitations + 1)  # unknowns, in those of a mode
        try:
            changing = response.fitted(law, squares + limit * fewer / response.values.size, time_limit)
        except _GivenUp as end:
            given_up.add(law)
            if by_time and end.least > RESPONSE.max_time_excess:
                break
        else:
            if changing is not None:
                return changing
    linear.append(poles)
    return None


def _squares(residual: Floats) -> float:
    return float((residual**2).sum()) + 1e-300


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
    size = abs(x.real) + abs(x.imag)
    if size > 0.01:
        return complex(np.exp(x))
    series = 1.0 + x / 4
    if size > 0.001:
        series += x * x / 20 * (1.0 + x / 6)
    return complex(1.0 + x * (1.0 + x / 2 * (1.0 + x / 3 * series)))


@njit(cache=True, nogil=True, error_model="numpy")
def _simulated(
    start: np.ndarray, drive: np.ndarray, change: np.ndarray, powers: Floats, by_time: bool, step: complex,
    scale: float, least: float, largest: float, dt: float, middle: float, width: float, faded: float,
    driven: int, many: int, undriven: float, slopes: bool,
) -> np.ndarray:  # fmt: skip
    """z of a mode at the samples, (n, 1), beside its derivatives by the unknowns where these are asked for.

    They are the real, then the imaginary parts of the coefficients of the rate and of the further drives. Where z
    diverges, the last row is NaN.

    Args:
        start: (1 + n_further,) at the first sample, then its derivatives by factors of further drives.
        drive: (n - 1, 1 + n_further) forcing of the constant mode from each sample to the next, then its derivatives.
        change: (1 + n_powers,) coefficients c_0, c_1, ... of the rate.
        step: e^{λΔt}.
        scale: largest amplitude of the constant mode.
        middle, width: mean and standard deviation of the time of the energy, as shares of the record.
        driven: number of samples after which there is no forcing.
        many: samples of a step from there on, within which the rate varies linearly.
        undriven: share of the largest amplitude below which motion and forcing are none.
        slopes: whether derivatives are asked for.
    """
    n, n_rates = drive.shape[0] + 1, change.size
    n_unknowns = n_rates + drive.shape[1] - 1 if slopes else 0
    units = np.repeat(np.array([1.0 + 0.0j, 1.0j]), n_unknowns)
    z = np.zeros((n, 1 + units.size), np.complex128)
    z[0, 0] = start[0]
    for u in range(units.size):
        if u % n_unknowns >= n_rates:
            z[0, 1 + u] = units[u] * start[1 + u % n_unknowns - n_rates]
    first_slopes, moved, terms = np.zeros_like(units), np.zeros_like(units), np.ones(n_rates)
    inverse, none, k = 1.0 / scale, (undriven * scale) ** 2, 0
    while k < n - 1:
        if z[k, 0].real ** 2 + z[k, 0].imag ** 2 < none and drive[k, 0].real ** 2 + drive[k, 0].imag ** 2 < none:
            k += 1  # at rest until the next impact
            continue
        n_steps = 1 if k < driven else min(many, n - 1 - k)
        propagated, half_time = step if n_steps == 1 else step**n_steps, 0.5 * n_steps * dt
        constant, force = propagated * z[k, 0], drive[k, 0] if k < driven else 0j
        first, rate, predicted = 0j, 0j, z[k, 0]
        for stage in range(2):
            base, along = predicted, 0j
            length = np.sqrt(base.real**2 + base.imag**2)
            size = max(length * inverse, least)
            if by_time:
                size = min(((k + stage * n_steps) / (n - 1) - middle) / width, faded)
            change_rate = change[0]
            for p in range(powers.size):
                terms[p + 1] = _power(size, powers[p])
                change_rate += change[p + 1] * terms[p + 1]
                along += change[p + 1] * powers[p] * terms[p + 1]
            # change of the rate with the motion, per unit of its component along itself
            along = 0j if by_time or length * inverse <= least else along / (length * length)
            if stage == 0:
                first = change_rate
            rate = 0.5 * (first + change_rate)
            half = by_rate = 1.0 + 0.0j
            if stage == 1 or not by_time:
                half = _exponential(rate * half_time)  # a force acts in steps of one sample only
                predicted = half * (half * constant + force)
                by_rate = half_time * half * (2.0 * half * constant + force)
            for u in range(units.size):
                at = u % n_unknowns
                of_motion = z[k, 1 + u] if stage == 0 else moved[u]
                slope = along * (base.real * of_motion.real + base.imag * of_motion.imag)
                pushed = 0j
                if at < n_rates:
                    slope += units[u] * terms[at]
                elif k < driven:
                    pushed = units[u] * drive[k, 1 + at - n_rates]
                if stage == 0:
                    first_slopes[u] = slope
                    if by_time:
                        continue
                slope = 0.5 * (first_slopes[u] + slope)
                moved[u] = by_rate * slope + half * (half * propagated * z[k, 1 + u] + pushed)
                if stage == 1:
                    first_slopes[u], z[k + n_steps, 1 + u] = slope - first_slopes[u], first_slopes[u]
        if n_steps > 1:
            rate_slope = (rate - first) * 2.0 * dt / n_steps
            factor, factor_step, ratio = step * np.exp(first * dt + 0.5 * rate_slope), np.exp(rate_slope), 1.0 + 0.0j
            for j in range(1, n_steps):
                ratio *= factor
                factor *= factor_step
                z[k + j, 0] = ratio * z[k, 0]
                for u in range(units.size):
                    growth = j * dt * (z[k + n_steps, 1 + u] + j / n_steps * first_slopes[u])
                    z[k + j, 1 + u] = ratio * z[k, 1 + u] + z[k + j, 0] * growth
        k += n_steps
        z[k, 0], z[k, 1:] = predicted, moved
        if not predicted.real**2 + predicted.imag**2 < (largest * scale) ** 2:
            z[-1] = np.nan
            return z
    return z


class _Response:
    """The fit of laws about a cluster of modes by variable projection of the amplitudes.

    The poles of the other modes may change to first order.
    """

    def __init__(self, data: KnownInputs, fit: Fit, cluster: np.ndarray, rows: Floats) -> None:
        self.data, self.fit, self.cluster, poles = data, fit, cluster, fit.poles[cluster]
        rates = np.maximum(-poles.real, COMPETING.min_rate * data.resolution)
        power = np.abs(fit.amplitudes[:, cluster] / fit.noise[:, None]).max(axis=0) ** 2 / rates
        self.pole = complex(np.average(-rates + 1j * poles.imag, weights=power))
        self.rate, self.participation = -self.pole.real, fit.participation[cluster[0]]
        margin = max(COMPETING.band_margin * self.rate, COMPETING.min_margin_lines * data.resolution)
        self.low, self.high = poles.imag.min() - margin, poles.imag.max() + margin
        self.coordinates = self._coordinates(self.pole)
        norms = np.sqrt(sum((np.abs(z) ** 2).sum(axis=0) for z in self.coordinates))
        self.held = int(np.argmax(norms * np.abs(self.participation)))
        self.participation = self.participation / self.participation[self.held]
        self.others = np.delete(np.arange(norms.size), self.held)
        self.units = norms[self.held] / np.maximum(norms[self.others], 1e-300)
        self.scale = max(max(float(np.abs(z @ self.participation).max()) for z in self.coordinates), 1e-300)
        energy = np.concatenate([np.abs(z @ self.participation) ** 2 for z in self.coordinates]) + 1e-300
        share = np.concatenate([np.linspace(0.0, 1.0, len(z)) for z in self.coordinates])
        self.middle = float(np.average(share, weights=energy))
        self.width = float(np.sqrt(np.average((share - self.middle) ** 2, weights=energy)))
        self.weight = np.ones((1, 1))
        if data.weights is not None:
            self.weight = np.vstack([self._about(data.weights[part]) for part in data.rows])
        self.regressors = self._lines(rows)
        others = np.setdiff1d(np.arange(fit.poles.size), cluster)
        (self.basis,) = bases_with_changes(self.regressors, fit, others, [self.weight])
        self.values = self._beyond(self.basis, self._lines(data.values))[:, 0]
        self.linear_motions = list(self._motions_of_linear())

    def _coordinates(self, pole: complex) -> list[np.ndarray]:
        """Response of a pole to each excitation at the samples of each record, (n_samples, n_excitations) each."""
        real, imaginary = (self.data.as_samples(part) for part in self.data.responses(pole))
        return [x + 1j * y for x, y in zip(real, imaginary, strict=True)]

    def linear_squares(self) -> float:
        """Squares of the residual of the linear modes in the lines about the cluster, all re-fitted to first order."""
        every_mode = np.arange(self.fit.poles.size)
        (basis,) = bases_with_changes(self.regressors, self.fit, every_mode, [self.weight], poles_only=False)
        return _squares(self._beyond(basis, self._lines(self.fit.residual)))

    def _beyond(self, basis: Floats, rows: Floats) -> Floats:
        """What a basis does not explain of rows (n_lines, k), in units of the noise."""
        scaled = rows / self.fit.noise
        return np.asarray(scaled - basis @ (basis.T @ scaled))

    def fitted(self, law: Law, threshold: float, time_limit: TimeLimit) -> tuple[KnownInputs, complex] | None:
        """The records beside the changing mode of a law, and its pole; None where it leaves too large a residual.

        The threshold is the largest logarithm of its squares. _GivenUp where the first step leaves far more, the fit
        stalls above the threshold, or the time is spent.
        """
        start = self._start(law)
        best = np.r_[start.real, start.imag]
        unknowns, at_start = best.copy(), self._residual(best, law, True)
        sensitivity = np.linalg.norm(at_start[1], axis=0)
        # After an impact, an initial state excites a mode as the input does.
        active = sensitivity > RESPONSE.min_sensitivity * sensitivity.max()
        if not active.any():
            return None
        beyond: list[float] = []

        def residual_of(x: Floats) -> Floats:
            if time_limit.spent(CHANGE_CHECK):
                raise _GivenUp(min(beyond, default=0.0))
            unknowns[active] = x
            residual = self._residual(unknowns, law)[0] if beyond else at_start[0]
            least, before = min(beyond, default=np.inf), min(beyond[: -RESPONSE.stall_evaluations + 1], default=np.inf)
            beyond.append(float(np.log(_squares(residual))) - threshold)
            if beyond[-1] < least:
                best[:], least = unknowns, beyond[-1]
            given_up = len(beyond) == 2 and least > RESPONSE.max_first_excess
            if given_up or before - least < max(RESPONSE.min_decrease_share * least, RESPONSE.min_decrease):
                raise _GivenUp(least)
            return residual

        def jacobian_of(x: Floats) -> Floats:
            jacobian = at_start[1] if len(beyond) == 1 else self._residual(unknowns, law, True)[1]
            return jacobian[:, active]

        try:
            least_squares(residual_of, best[active], jacobian_of, x_scale="jac", max_nfev=RESPONSE.max_evaluations)
        except _GivenUp:
            if time_limit.is_past or min(beyond) > 0.0:
                raise
        if min(beyond) > 0.0:
            return None
        rows = self.data.rows_of([np.hstack([z.real, z.imag]) for z in self._motions(best, law, True)])
        further, pole = beyond_linear(self.data, rows, self.pole, self.participation)
        return self.data.with_columns(further, (pole,)), pole

    def _start(self, law: Law) -> np.ndarray:
        """Starting coefficients of a law: regression on the sum of the linear modes, from sample to sample."""
        (by_time, powers), size = law, 1 + len(law[1])
        each = []
        for z, rate in self.linear_motions:
            time = np.minimum((np.arange(z.size) / z.size - self.middle) / self.width, RESPONSE.max_time_deviations)
            along = time if by_time else np.maximum(np.abs(z) / self.scale, RESPONSE.min_amplitude)
            each.append(np.column_stack([z, *(along**power * z for power in powers), rate]))
        rows = np.vstack(each)
        products = rows[:, :size].conj().T @ rows
        coefficients = np.linalg.lstsq(products[:, :size], products[:, size], rcond=None)[0]
        return np.asarray(np.r_[coefficients, self.linear_factors])

    def _motions_of_linear(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """The sum of the linear modes in each record, and its rate beyond that of the constant mode times it, over the
        rate of decay, (n_samples - 1,) each."""
        fit, dt = self.fit, self.data.dt
        poles, participation = fit.poles[self.cluster], fit.participation[self.cluster]
        strength = (fit.amplitudes[:, self.cluster[0]] / fit.noise**2).conj() @ fit.amplitudes[:, self.cluster]
        factors = strength @ participation
        unit = factors[self.held]
        self.linear_factors = (factors[self.others] / unit - self.participation[self.others]) / self.units
        for of_record in zip(*(self._coordinates(pole) for pole in poles), strict=True):
            each = zip(strength / unit, of_record, participation, strict=True)
            modes = [a * (z[:-1] @ l_r) for a, z, l_r in each]
            z = np.sum(modes, axis=0)
            propagated = np.exp((poles - self.pole) * dt) @ modes
            yield z, (propagated - z) / dt / self.rate

    def _motions(self, unknowns: Floats, law: Law, slopes: bool = False) -> list[np.ndarray]:
        """z of each record, beside its derivatives by the unknowns where these are asked for, (n_samples, k)."""
        (by_time, powers), half = law, unknowns.size // 2
        coefficients = unknowns[:half] + 1j * unknowns[half:]
        size = 1 + len(powers)
        participation = self.participation.copy()
        participation[self.others] += coefficients[size:] * self.units
        dt, motions = self.data.dt, []
        step = np.exp(self.pole * dt)
        for z in self.coordinates:
            constant = np.column_stack([z @ participation, z[:, self.others] * self.units])
            drive = constant[1:] - step * constant[:-1]
            driven_samples = np.flatnonzero(np.abs(drive).max(axis=1) > RESPONSE.min_forcing * self.scale)
            simulated = _simulated(
                constant[0], drive, self.rate * coefficients[:size], np.array(powers), by_time, step, self.scale,
                RESPONSE.min_amplitude, RESPONSE.max_amplitude_ratio, dt, self.middle, self.width,
                RESPONSE.max_time_deviations, int(driven_samples[-1]) + 1 if driven_samples.size else 0,
                max(int(RESPONSE.max_decay_step / (self.rate * dt)), 1), RESPONSE.min_forcing, slopes,
            )  # fmt: skip
            if slopes:
                simulated[:, 1 : 1 + size] *= self.rate
                simulated[:, 1 + half : 1 + half + size] *= self.rate
            motions.append(simulated)
        return motions

    def _residual(self, unknowns: Floats, law: Law, slopes: bool = False) -> tuple[Floats, Floats]:
        """Residual (n,) with the shape of the motion projected out, and its Jacobian (n, n_unknowns) where asked for,
        that of Kaufman (1975)."""
        motions = self._motions(unknowns, law, slopes)
        if not all(np.isfinite(z[-1]).all() for z in motions):
            return diverged(self.values, unknowns.size)

        def tangents_of(coefficients: Floats) -> Floats:
            if not slopes:
                return np.zeros((self.values.size, 0))
            a, b = coefficients
            return self._beyond_others([a * z[:, 1:].real + b * z[:, 1:].imag for z in motions])

        columns = self._beyond_others([np.column_stack([z[:, 0].real, z[:, 0].imag]) for z in motions])
        return projected_residual(self.values, columns, tangents_of)

    def _beyond_others(self, samples: Sequence[Floats]) -> Floats:
        """What the other modes do not explain of columns (n_samples, k) of each record, in the lines that count."""
        return self._beyond(self.basis, self.weight * np.vstack([self._about(lines_of(each)) for each in samples]))

    def _lines(self, rows: Floats) -> Floats:
        """Lines about the cluster, from rows of the fit."""
        parts = [rows[part] for part in self.data.rows]
        return np.vstack([self._about(x if self.data.rows_are_lines else lines_of(x)) for x in parts])

    def _about(self, lines: Floats) -> Floats:
        """Those of the lines of one record that lie about the cluster."""
        line = np.pi / self.data.dt / len(lines)
        return lines[max(int(self.low / line), 0) : min(int(self.high / line) + 2, len(lines))]
