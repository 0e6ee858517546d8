"""Model comparison for one sensor: two overlapping linear modes, or one mode that depends on amplitude.

The envelope r and phase θ of the amplitude-dependent mode follow a backbone curve (Nayfeh & Mook 1979, 2.3),

    r' = -σ(r) r,   θ' = ω(r),   -σ + iω = Σ_k λ_k r^p_k,      y = Re A exp(Σ_k λ_k ∫ r^p_k dt),   r(0) = 1

with powers p of 0, 1, 2 (stiffness and damping that rise or fall), 0, ½, 1 (joints that slip) or -1, 0, 1 (friction).
With A these are eight parameters, as many as of two linear modes, so that the likelier model is preferred.

In several records two linear modes have the same poles in all. One mode has a backbone common to all records, with
λ_k a_i^p_k in the record of initial amplitude a_i; or a pole or a backbone of its own in each record, because clamping,
temperature and load history differ from test to test. Schwarz's criterion accounts for the number of parameters.

The models are compared in the Fourier lines about the two modes. There all other modes, known or not, contribute only a
polynomial of low degree, as z in Σ_t z^t e^-iωt = (1 - z^n) / (1 - z e^-iω) is far from e^iω. The same holds for the
error of summing over every D-th sample of a long record: by the Euler-Maclaurin formula it consists of end terms,
derivatives of the motion times powers of D.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.fft import fft, rfft

from workbench.arrays import Complexes, Floats
from workbench.identification.signal.projection import project
from workbench.identification.signal.searches import FIT, CachedResidual, diverged, projected_residual
from workbench.records.record import Record


@dataclass(frozen=True)
class BackboneSettings:
    """Constants of the comparison."""

    envelope_steps: int = 150  # of the integration of the envelope
    linear_nepers: float = 7.0  # of decay, from which on frequency and damping are constant
    max_nepers: float = 60.0  # to which the envelope is limited
    first_steps: int = 20  # evaluations of the fit from each start
    max_steps: int = 40  # evaluations from the best of these
    min_decrease: float = 1e-4  # relative, of the sum of squares at which a fit ends
    record_nepers: float = 14.0  # of the slower mode, at which a record is cut: e^-14 is 1e-6
    samples_per_mode: int = 20  # that remain, at least
    difference_step: float = 1e-5  # of finite differences, relative to the decay rate
    max_slope: float = 1e100  # of a motion by an unknown, above which it diverges
    margin_lines: float = 10.0  # half width of the band of comparison beyond the two modes
    margin_bandwidths: float = 4.0  # and in addition to that, in half bandwidths
    background_coefficients: int = 4  # of the polynomial for modes outside the band
    min_samples: int = 1000  # of a decimated motion
    max_phase_step: float = 0.25  # rad from the centre to the edge of the band: an error of 1e-8 of a sample
    # half width over frequency up to which the mirror image of the motion is such a polynomial too
    narrow_band_ratio: float = 0.1


BACKBONE = BackboneSettings()
POWERS = ((0.0, 1.0, 2.0), (0.0, 0.5, 1.0), (0.0, -1.0, 1.0))


def are_two(records: Sequence[Record], poles: Complexes, r: int, s: int, threshold: float) -> bool:
    """Whether two linear modes r and s are likelier than one amplitude-dependent mode, in free decays of one output.

    Args:
        poles: (n_modes,) of a fit with both, rad/s.
        threshold: of twice the log-likelihood ratio, between models of equally many parameters.
    """
    pair, others = poles[[r, s]], np.delete(poles, [r, s])
    bands = [_Band(record, pair, others) for record in records]
    size = np.array([band.size for band in bands])
    round_off = np.array([band.round_off for band in bands])
    two_modes = _modes_misfit(bands, pair)

    def gains(single: Floats) -> Floats:
        return np.asarray(size * np.log((single + round_off) / (two_modes + round_off)))

    # In n records two modes have 4 + 4 n parameters; one mode has 4 n with a pole per record, 8 n with a backbone per
    # record, and 5 + 3 n with a common backbone.
    penalty = float(np.log(size.sum())) if len(records) > 1 else 0.0
    best_single = np.array([_modes_misfit([band], pair[[np.argmax(np.abs(band.amplitudes))]])[0] for band in bands])
    gain = gains(best_single) - 4.0 * penalty / len(records)
    decisive = two_modes * np.exp((threshold - 4.0 * penalty * (1.0 - 1.0 / len(records))) / size)
    for i in np.argsort(-gain):
        if gain.sum() <= threshold:
            return False
        best_single[i] = backbone_misfit(bands[i], pair, enough=float(decisive[i]))
        gain[i] = min(gain[i], gains(best_single)[i] + 4.0 * penalty * (1.0 - 1.0 / len(records)))
    if gain.sum() <= threshold:
        return False
    if len(records) == 1:
        return True
    common = common_backbone_misfit(bands, np.sqrt(size / (two_modes + round_off)), pair)
    return float(gains(common).sum()) > (len(records) - 1) * penalty


def band_about(pair: Complexes, bin_width: float) -> tuple[float, float]:
    """Centre and half width, rad/s, of the band in which two modes of poles `pair` are compared."""
    low, high = float(pair.imag.min()), float(pair.imag.max())
    wide = BACKBONE.margin_bandwidths * float(np.abs(pair.real).sum()) + BACKBONE.margin_lines * bin_width
    return 0.5 * (low + high), 0.5 * (high - low) + wide


class _Band:
    """The Fourier lines of a record about two modes, without the contribution of other modes.

    Attributes:
        time: (n_times,) s, of the samples at which motions are evaluated: all, or every `step`-th.
        y: (2 n_lines,) real and imaginary parts of the lines, with the noise variance of a sample.
        amplitudes: (2,) complex, of the two modes.
        size: degrees of freedom of y.
        round_off: of a sum of squares.
    """

    def __init__(self, record: Record, pair: Complexes, others: Complexes) -> None:
        dt = record.sample_time
        # The record is cut to where the two modes have decayed.
        last = BACKBONE.record_nepers / max(float(-pair.real.max()) * dt, 1e-300)
        last = int(max(last, BACKBONE.samples_per_mode * (pair.size + others.size)))
        if last < record.n_samples - 1:
            record = record.between(record.start_time, record.start_time + last * dt)
        half = band_about(pair, 2.0 * np.pi / (record.n_samples * dt))[1]
        self.step = max(int(min(record.n_samples / BACKBONE.min_samples, BACKBONE.max_phase_step / (half * dt))), 1)
        if half > BACKBONE.narrow_band_ratio * float(pair.imag.min()):
            self.step = 1
        n = record.n_samples // self.step * self.step
        y, time = record.outputs[0, :n], dt * np.arange(n, dtype=float)
        self.time: Floats = time[:: self.step]
        middle, half = band_about(pair, 2.0 * np.pi / (n * dt))
        first, last = (int(np.ceil((middle + side * half) * n * dt / (2.0 * np.pi))) for side in (-1.0, 1.0))
        self.lines = np.arange(max(first, 1), max(min(last, (n + 1) // 2), 2))
        amplitudes = project(record, np.append(pair, others), True).complex_amplitudes[0]
        self.amplitudes = amplitudes[:2]
        within = np.abs(others.imag - middle) < half + np.abs(others.real)
        elsewhere = (amplitudes[2:][~within] @ np.exp(np.outer(others[~within], time))).real
        others_basis = np.hstack(self.lines_of(np.exp(np.outer(others[within], self.time))))
        smooth = np.linspace(-1.0, 1.0, self.lines.size)[:, None] ** np.arange(BACKBONE.background_coefficients)
        others_basis = np.hstack([others_basis, np.kron(np.eye(2), smooth)])
        self.others_basis = np.linalg.qr(others_basis / np.maximum(np.linalg.norm(others_basis, axis=0), 1e-300))[0]
        lines = rfft(y - elsewhere)[self.lines] / np.sqrt(0.5 * n)
        self.y = self.without_others(np.r_[lines.real, lines.imag])
        self.size = max(self.y.size - others_basis.shape[1], 1)
        self.round_off = FIT.round_off * float(y @ y) + 1e-300

    def lines_of(self, motions: np.ndarray) -> tuple[Floats, Floats]:
        """Fourier lines of the real, and of the imaginary parts of motions (n_motions, n_times), (2 n_lines, n_motions)
        each."""
        m = self.time.size
        spectra = fft(motions, axis=1) * np.sqrt(self.step / (0.5 * m))
        positive, negative = spectra[:, self.lines % m].T, np.zeros(())
        if self.step == 1:
            negative = spectra[:, -self.lines].conj().T
        real, imaginary = 0.5 * (positive + negative), -0.5j * (positive - negative)
        return np.vstack([real.real, real.imag]), np.vstack([imaginary.real, imaginary.imag])

    def without_others(self, columns: Floats) -> Floats:
        """Columns (2 n_lines, n) projected orthogonally to the contribution of other modes."""
        return np.asarray(columns - self.others_basis @ (self.others_basis.T @ columns))

    def residual(self, motions: Complexes, slopes: Complexes, which: Sequence[int]) -> tuple[Floats, Floats]:
        """Residual (2 n_lines,) of a fit of motions, with A eliminated (Kaufman 1975), and its Jacobian.

        From motions (n_motions, n_times) of free amplitudes A, and the derivatives (n_unknowns, n_times) of the motions
        `which` (n_unknowns,) by each unknown.
        """
        if not (np.abs(slopes) < BACKBONE.max_slope).all():
            return diverged(self.y, len(slopes))
        real, imaginary = self.lines_of(np.vstack([motions, slopes]))
        p = len(motions)

        def tangents_of(coefficients: Floats) -> Floats:
            a, b = coefficients.reshape(2, p)[:, list(which)]
            return self.without_others(real[:, p:] * a + imaginary[:, p:] * b)

        columns = self.without_others(np.hstack([real[:, :p], imaginary[:, :p]]))
        return projected_residual(self.y, columns, tangents_of)


def _modes_misfit(bands: Sequence[_Band], poles: Complexes) -> Floats:
    """Residual sum of squares of each record, (n_records,), at the most likely linear modes near some poles."""
    weights: Floats = np.ones(len(bands))

    def residuals(unknowns: Floats) -> list[tuple[Floats, Floats]]:
        """Residual of each record and its Jacobian by the real and imaginary parts of the poles, without weights."""
        real, imaginary = np.split(unknowns, 2)
        results = []
        for band in bands:
            with np.errstate(over="ignore", invalid="ignore"):
                motions = np.exp(np.outer(real + 1j * imaginary, band.time))
                slopes = band.time * motions
                results.append(band.residual(motions, np.vstack([slopes, 1j * slopes]), [*range(real.size)] * 2))
        return results

    def weighted(unknowns: Floats) -> tuple[Floats, Floats]:
        each = list(zip(weights, residuals(unknowns), strict=True))
        return np.concatenate([w * e for w, (e, _) in each]), np.vstack([w * slopes for w, (_, slopes) in each])

    def squares(unknowns: Floats) -> Floats:
        return np.array([float(e @ e) for e, _ in residuals(unknowns)])

    start = np.r_[poles.real, poles.imag]
    if len(bands) > 1:
        weights = np.sqrt([band.size for band in bands] / (squares(start) + [band.round_off for band in bands]))
    return squares(CachedResidual(weighted).least(start, BACKBONE.max_steps, ftol=BACKBONE.min_decrease))


def backbone_misfit(band: _Band, pair: Complexes, *, enough: float = 0.0) -> float:
    """Least residual sum of squares of one mode on a backbone, in place of two linear modes of poles `pair`, rad/s.

    The search ends at the sum of squares `enough`.
    """
    tried: list[tuple[float, _Backbone, Floats]] = []
    for powers in POWERS:
        model = _Backbone(band, np.array(powers))
        for start in model.starts(pair):
            at = model.once.least(start, BACKBONE.first_steps, ftol=BACKBONE.min_decrease)
            tried.append((float((model.once(at)[0] ** 2).sum()), model, at))
            if tried[-1][0] <= enough:
                return tried[-1][0]
    _, model, at = min(tried, key=lambda each: each[0])
    at = model.once.least(at, BACKBONE.max_steps, ftol=BACKBONE.min_decrease)
    return float((model.once(at)[0] ** 2).sum())


def common_backbone_misfit(bands: Sequence[_Band], weights: Floats, pair: Complexes) -> Floats:
    """Residual sum of squares of each record, (n_records,), of one mode on a backbone common to all records.

    In place of two linear modes of poles `pair`, rad/s; weights (n_records,) are 1 / noise.
    """
    models = [_Common([_Backbone(band, np.array(powers)) for band in bands], weights) for powers in POWERS]
    first = [model.once.least(model.start(pair), BACKBONE.first_steps, ftol=BACKBONE.min_decrease) for model in models]
    best = int(np.argmin([(model.once(at)[0] ** 2).sum() for model, at in zip(models, first, strict=True)]))
    return models[best].squares(models[best].once.least(first[best], BACKBONE.max_steps, ftol=BACKBONE.min_decrease))


@njit(cache=True, nogil=True)
def _rate(u: float, real: Floats, powers: Floats, faded: float) -> float:
    """u' of u = -ln r for real parts of λ_k (3,) and powers p_k (3,)."""
    return -float(np.sum(real * np.exp(-min(max(u, -1.0), faded) * powers)))


@njit(cache=True, nogil=True)
def _envelopes(real: Floats, powers: Floats, t: Floats, faded: float, died: float) -> tuple[Floats, Floats]:
    """u = -ln r and u' at the times t, (n_times, n_rows) each, for each row of Re λ (n_rows, 3), after Runge-Kutta."""
    h, u, rates = t[1], np.zeros((t.size, len(real))), np.zeros((t.size, len(real)))
    for j in range(len(real)):
        row = real[j]
        for k in range(t.size):
            at = u[k, j]
            rates[k, j] = a = _rate(at, row, powers, faded)
            if k + 1 < t.size:
                b = _rate(at + 0.5 * h * a, row, powers, faded)
                c = _rate(at + 0.5 * h * b, row, powers, faded)
                d = _rate(at + h * c, row, powers, faded)
                u[k + 1, j] = min(max(at + h / 6.0 * (a + 2.0 * b + 2.0 * c + d), -1.0), died)
    return u, rates


@njit(cache=True, nogil=True)
def _integrals(u: Floats, rates: Floats, powers: Floats, time: Floats, h: float, faded: float) -> Floats:
    """∫ r^p_k dt at samples, (n_rows, n, 3), of u and u' (n_rows, n_times), by cubic Hermite interpolation."""
    n_rows, n_times = u.shape
    integrals = np.empty((n_rows, time.size, powers.size))
    value, slope, integral_to = np.empty(n_times), np.empty(n_times), np.empty(n_times)
    for i in range(n_rows):
        for k in range(powers.size):
            for j in range(n_times):
                value[j] = np.exp(-min(max(u[i, j], -1.0), faded) * powers[k])
                slope[j] = -powers[k] * value[j] * rates[i, j] * h if u[i, j] < faded else 0.0
            integral_to[0] = 0.0
            for j in range(n_times - 1):
                integral_to[j + 1] = integral_to[j] + h * (
                    0.5 * (value[j] + value[j + 1]) + (slope[j] - slope[j + 1]) / 12.0
                )
            for m in range(time.size):
                j = min(int(time[m] / h), n_times - 2)
                x = time[m] / h - j
                rise = value[j + 1] - value[j]
                square, cube = 3.0 * rise - 2.0 * slope[j] - slope[j + 1], slope[j] + slope[j + 1] - 2.0 * rise
                integrals[i, m, k] = integral_to[j] + h * x * (
                    value[j] + x * (slope[j] / 2.0 + x * (square / 3.0 + x * cube / 4.0))
                )
    return integrals


def backbone_integrals(real: np.ndarray, powers: np.ndarray, time: np.ndarray) -> list[Floats]:
    """∫ r^p_k dt from 0 to each time, (n, n_powers), for each row of Re λ (n_rows, n_powers)."""
    t = np.linspace(0.0, time[-1], BACKBONE.envelope_steps + 1)
    u, rates = _envelopes(real, powers, t, BACKBONE.linear_nepers, BACKBONE.max_nepers)
    return list(_integrals(u.T.copy(), rates.T.copy(), powers, time, t[1], BACKBONE.linear_nepers))


class _Backbone:
    """The fit of one mode on a backbone of given powers to a record, linear parameters eliminated."""

    def __init__(self, band: _Band, powers: np.ndarray) -> None:
        self.band, self.time, self.powers = band, band.time, powers
        self.once = CachedResidual(self.fitted)

    def starts(self, pair: np.ndarray) -> Iterator[Floats]:
        """Starts of the fit: the backbone of the sum z of two linear modes, z'/z by |z|; the stronger mode alone."""
        columns, slope, _ = self.start_equations(pair)
        backbone = np.linalg.lstsq(columns, slope, rcond=None)[0]
        for start in (backbone, np.array([pair[np.argmax(np.abs(self.band.amplitudes))], 0.0, 0.0])):
            yield np.r_[start.real, start.imag]

    def start_equations(self, pair: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Columns |z|^p_k z (n_times, 3), z' (n_times,) and |z(0)| of the sum z of two linear modes.

        |z| in the columns is relative to its initial value.
        """
        each = self.band.amplitudes * np.exp(np.outer(self.time, pair))
        z, slope = each.sum(axis=1), (each * pair).sum(axis=1)
        initial = max(abs(z[0]), 1e-3 * np.abs(z).max())
        by_power = np.maximum(np.abs(z) / initial, np.exp(-BACKBONE.linear_nepers))[:, None] ** self.powers
        return z[:, None] * by_power, slope, float(initial)

    def fitted(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residual (2 n_lines,) and its Jacobian by Re λ and Im λ, (2 n_lines, 6)."""
        real, turn = unknowns[:3], 1j * unknowns[3:]
        step = BACKBONE.difference_step * max(abs(real[0]), 1e-3 / self.time[-1])
        held, *moved = backbone_integrals(np.vstack([real, real + step * np.eye(3)]), self.powers, self.time)
        with np.errstate(over="ignore", invalid="ignore"):
            motion = np.exp(held @ (real + turn))
            by_real = [motion * ((h - held) @ (real + turn) / step + h[:, k]) for k, h in enumerate(moved)]
            return self.band.residual(motion[None], np.vstack([by_real, 1j * motion * held.T]), [0] * 6)


class _Common:
    """The fit of one mode on a common backbone to several records: λ, and ln a_i of all but the strongest record."""

    def __init__(self, each: Sequence[_Backbone], weights: Floats) -> None:
        self.each, self.weights, self.powers = each, weights, each[0].powers
        self.once = CachedResidual(self.fitted)

    def start(self, pair: np.ndarray) -> Floats:
        """The start of the fit: the common backbone of the sums of two linear modes in all records."""
        columns, slopes, initial = zip(*(one.start_equations(pair) for one in self.each), strict=True)
        level = np.log(np.maximum(initial, 1e-9 * max(initial) + 1e-300))
        self.free = np.delete(np.arange(level.size), np.argmax(level))
        level -= level.max()
        scaled = [w * c * np.exp(a * self.powers) for w, c, a in zip(self.weights, columns, level, strict=True)]
        known = np.concatenate([w * slope for w, slope in zip(self.weights, slopes, strict=True)])
        start = np.linalg.lstsq(np.vstack(scaled), known, rcond=None)[0]
        return np.concatenate([start.real, start.imag, level[self.free]])

    def squares(self, unknowns: Floats) -> Floats:
        """Residual sum of squares of each record, (n_records,)."""
        return np.array([float(residual @ residual) for residual, *_ in self._parts(unknowns)])

    def fitted(self, unknowns: Floats) -> tuple[Floats, Floats]:
        """Weighted residual of all records and its Jacobian by the unknowns."""
        residuals, columns = [], []
        for i, (w, (residual, slopes, own, by)) in enumerate(zip(self.weights, self._parts(unknowns), strict=True)):
            by_amplitude = slopes @ (np.tile(self.powers, 2) * own)
            residuals.append(w * residual)
            columns.append(w * np.column_stack([slopes * by, np.outer(by_amplitude, self.free == i)]))
        return np.concatenate(residuals), np.vstack(columns)

    def _parts(self, unknowns: Floats) -> Iterator[tuple[Floats, Floats, Floats, Floats]]:
        """For each record: residual, its Jacobian, its own six unknowns, and their ratios to the common ones."""
        level = np.zeros(len(self.each))
        level[self.free] = np.clip(unknowns[6:], -BACKBONE.max_nepers, BACKBONE.max_nepers)
        for one, a in zip(self.each, level, strict=True):
            by = np.tile(np.exp(a * self.powers), 2)
            yield *one.once(by * unknowns[:6]), by * unknowns[:6], by
