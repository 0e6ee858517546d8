"""Lines of measured FRFs, as a `modal_fit.Measurement`, and their noise."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.optimize import least_squares
from scipy.special import hyp2f1
from scipy.stats import chi2, f, kruskal, spearmanr

from workbench.identification.input_output.modal_fit import Fit, Pair, row_weights
from workbench.identification.input_output.model_order import bases_of, weights_of
from workbench.identification.signal.projection import local_noise_ratio
from workbench.identification.signal.searches import SELECTION


@dataclass(frozen=True)
class LinesSettings:
    """Constants of the search among lines and of their noise."""

    max_candidates: int = 600  # lines, the strongest, at which poles are tried
    decay_rates: int = 6  # that are tried
    noise_lines: int = 25  # lines on either side from which the noise about a pole is estimated
    candidates_per_rate: int = 10  # of each decay rate
    louder_probability: float = 0.01  # chance that noise of one level is taken for louder about a mode
    uneven_probability: float = 1e-4  # chance that noise of one level is taken for uneven
    median_lines: int = 5  # lines of a running median
    lags: int = 3  # lines, at which the correlation of windowed noise is estimated
    instants: int = 2000  # of a record, in the numerical integral of that correlation
    window_deviations: float = 5.0  # standard errors of one output's correlation, above which there was a window
    # of the deviation from noise without a window, that remains with the best window at most
    max_deviation_share: float = 0.3
    degree: int = 3  # of the polynomial of log ω that noise follows along frequency


LINES = LinesSettings()
DETUNED = np.array([-4.0, -3.0, -2.0, 2.0, 3.0, 4.0])  # half-power bandwidths beside a mode
WINDOWS = np.r_[0.0, np.geomspace(0.1, 30.0, 60)]  # length of a record, in time constants of its window
SHARES = np.geomspace(1e-3, 1e3, 61)  # b |H| / a at the median line, from nothing to all


@dataclass(eq=False, repr=False)
class Lines:
    """The `modal_fit.Measurement` of FRFs; `dataclasses.replace` gives changed ones.

    Rows are real, then imaginary parts, reference by reference.
    """

    h: np.ndarray  # (n_outputs, n_references, n_lines)
    omega: np.ndarray  # (n_lines,) rad/s
    powers: list[int]  # of s, in the residual terms
    noise: np.ndarray | None  # standard error of each line, as `h`; the same for all unless given
    guessed: bool = False  # whether `noise` is known up to a factor only
    beside: np.ndarray | None = None  # (n_rows, n_columns) fixed columns beside those of the residual terms
    changing: tuple[tuple[complex, float], ...] = ()  # pole and rms scatter of frequency of changing modes, rad/s
    window_rate: float = 0.0  # 1/τ of an exponential window, as far as noise shows one

    def __post_init__(self) -> None:
        omega, (_, self.n_inputs, n_lines) = self.omega, self.h.shape
        self.weights = None if self.noise is None else 1.0 / _rows_of(self.noise * (1 + 1j))
        self.values = _rows_of(self.h) * (1.0 if self.weights is None else self.weights)
        s = 1j * omega / omega[-1]
        self.fixed = _rows_of(self._of_each_reference(np.array([s**p for p in self.powers])))
        if self.beside is not None:
            self.fixed = np.hstack([self.fixed, self.beside])
        self.resolution = float(np.diff(omega).min())
        # A pole close beyond the band is not constant in it, so such poles are searched too, as residual terms.
        self.highest, self.nyquist = 2.0 * float(omega[-1]), np.inf
        span = omega[-1] - omega[0]
        self.rates = np.geomspace(0.3 * self.resolution, max(0.03 * span, self.resolution), LINES.decay_rates)
        self.cells = LINES.decay_rates * n_lines
        self.distorted: tuple[complex, ...] = ()
        self.free: tuple[complex, ...] = ()

    def with_columns(self, columns: np.ndarray, changing: tuple[complex, float]) -> "Lines":
        """The same lines with the fixed columns of a further changing mode."""
        beside = columns if self.beside is None else np.hstack([self.beside, columns])
        return replace(self, beside=beside, changing=(*self.changing, changing))

    def only(self, which: np.ndarray, smooth: int) -> "Lines":
        """Some of the lines, by flag (n_lines,), with polynomials up to a degree as further fixed columns."""
        omega, noise = self.omega[which], None if self.noise is None else self.noise[..., which]
        selected = replace(self, h=self.h[..., which], omega=omega, noise=noise, beside=None, changing=())
        middle = 0.5 * (omega[0] + omega[-1])
        scaled = (omega - middle) / max(omega[-1] - middle, 1e-300)
        polynomials = np.array([factor * scaled**k for k in range(smooth + 1) for factor in (1.0, 1j)])
        beside = [] if self.beside is None else [self.beside[np.tile(which, 2 * self.n_inputs)]]
        selected.fixed = np.hstack([selected.fixed, _rows_of(self._of_each_reference(polynomials)), *beside])
        return selected

    def _of_each_reference(self, values: np.ndarray) -> np.ndarray:
        """Values (k, n_lines) of each reference in turn, 0 for the others, (n_references k, n_references, n_lines)."""
        each = np.zeros((self.n_inputs, len(values), self.n_inputs, values.shape[1]), complex)
        for i in range(self.n_inputs):
            each[i, :, i] = values
        return each.reshape(-1, *each.shape[2:])

    def unstacked(self, rows: np.ndarray) -> np.ndarray:
        """Complex values (n, n_references, n_lines) from rows of the fit, (n_rows, n)."""
        real, imaginary = np.split(rows, 2)
        return (real + 1j * imaginary).T.reshape(-1, self.n_inputs, self.omega.size)

    def responses(self, pole: complex) -> Pair:
        poles = pole, pole.conjugate()
        return rows_of_pair(*(self._of_each_reference(1.0 / (1j * self.omega - p)[None]) for p in poles))

    def slopes(self, pole: complex, participation: np.ndarray) -> Pair:
        return self.power_of_pole(pole, participation, 2)

    def power_of_pole(self, pole: complex, participation: np.ndarray, power: int) -> Pair:
        """Rows (n_rows,) of the real and of the imaginary part of the factor of l / (s - λ)^power."""
        s = 1j * self.omega
        above = participation[:, None] / (s - pole) ** power
        below = participation.conj()[:, None] / (s - pole.conjugate()) ** power
        real, imaginary = rows_of_pair(above[None], below[None])
        return real[:, 0], imaginary[:, 0]

    def tangents(self, pole: complex, participation: np.ndarray, real: np.ndarray, imaginary: np.ndarray) -> None:
        real[:, 0], imaginary[:, 0] = self.slopes(pole, participation)
        real[:, 1:], imaginary[:, 1:] = self.responses(pole)

    def candidates(self, residual: np.ndarray) -> np.ndarray:
        raw = self.unstacked(residual if self.weights is None else residual * self.weights).reshape(-1, self.omega.size)
        weight = 1.0 if self.weights is None else (np.abs(self.unstacked(self.weights)) ** 2).mean(axis=(0, 1)) / 2.0
        power = (np.abs(raw) ** 2).sum(axis=0)
        lines = np.sort(np.argsort(power)[-LINES.max_candidates :])
        poles, strength = [], []
        for rate in self.rates:
            x = 1.0 / (1j * (self.omega - self.omega[lines, None]) + rate)
            score = (np.abs(raw @ x.conj().T) ** 2).sum(axis=0) / (np.abs(x) ** 2 * weight).sum(axis=1)
            score[rate > SELECTION.max_damping * self.omega[lines]] = 0.0
            best = np.argsort(score)[-LINES.candidates_per_rate :]
            poles.append(-rate + 1j * self.omega[lines[best]])
            strength.append(score[best])
        order = np.argsort(np.concatenate(strength))[::-1]
        outside = np.r_[0.6 * self.omega[0], 0.9 * self.omega[0], np.array([1.05, 1.2, 1.5]) * self.omega[-1]]
        return np.asarray(np.r_[np.concatenate(poles)[order[: 3 * LINES.candidates_per_rate]], (-0.01 + 1j) * outside])

    def fitted(self, fit: Fit) -> np.ndarray:
        """The fitted FRFs at the lines, (n_outputs, n_references, n_lines)."""
        return self.unstacked((self.values - fit.residual) / row_weights(self))

    def left(self, fit: Fit) -> np.ndarray:
        """The residual at the lines, (n_outputs, n_references, n_lines)."""
        return self.unstacked(fit.residual / row_weights(self))

    def misfit(self, fit: Fit) -> np.ndarray:
        """Rms of the residual of each output, (n_outputs,), in units of the noise where that was stated."""
        if not self.guessed:
            return fit.noise
        raw = fit.residual / self.weights
        return np.asarray(fit.noise * np.sqrt((raw**2).sum(axis=0) / (fit.residual**2).sum(axis=0)))

    def noise_ratio_near(self, fit: Fit) -> np.ndarray:
        """κ, the power of the residual near each mode over the mean of all lines, (n_modes,).

        It is measured by poles a few half-power bandwidths beside the mode, outputs weighted by their amplitude. 1
        where the noise may be the same at all lines.
        """
        residual, noise = fit.residual / fit.noise, fit.noise
        ratios = np.ones(fit.poles.size)
        if self.weights is not None and not self.guessed:
            return ratios
        bases, weights = bases_of(self, fit), weights_of(self)
        for r, pole in enumerate(fit.poles):
            output_weights = (np.abs(fit.amplitudes[:, r]) / noise) ** 2
            width = max(abs(pole.real), 0.5 * self.resolution)
            noise_ratio = []
            for beside in pole.imag + width * DETUNED:
                if self.omega[0] < beside < self.omega[-1]:
                    columns = np.hstack(self.responses(-width + 1j * beside))
                    power = []
                    for basis, weight, rest in zip(bases, weights, np.split(residual, len(bases), axis=1), strict=True):
                        # The fit absorbed the noise along the basis.
                        orthogonal = weight * columns - basis @ (basis.T @ (weight * columns))
                        power.append((orthogonal.T @ rest) ** 2 / (orthogonal**2).sum(axis=0)[:, None])
                    noise_ratio.append(np.hstack(power))
            if not noise_ratio:
                continue
            power = np.mean(noise_ratio, axis=(0, 1)) @ output_weights / output_weights.sum()
            degrees = np.size(noise_ratio) / output_weights.size * output_weights.sum() ** 2 / (output_weights**2).sum()
            ratios[r] = power if power > chi2.isf(LINES.louder_probability, degrees) / degrees else 1.0
        return ratios

    def noise_ratio(self, residual: np.ndarray, pole: complex) -> float:
        power = (np.abs(self.unstacked(residual)) ** 2).mean(axis=(0, 1))
        nearest = int(np.argmin(np.abs(self.omega - pole.imag)))
        return local_noise_ratio(power, nearest, LINES.noise_lines) * self._window_gain(-pole.real)

    def _window_gain(self, rate: float) -> float:
        """Power of windowed noise in the impulse response of a pole over that of stationary noise."""
        length = 2.0 * np.pi / self.resolution
        window, of_pole = 2.0 * self.window_rate * length, 2.0 * rate * length
        return float(_mean_of_decay(window + of_pole) / (_mean_of_decay(window) * _mean_of_decay(of_pole)))


def rows_of_pair(above: np.ndarray, below: np.ndarray) -> Pair:
    """Rows of the fit (n_rows, n) of the real and of the imaginary part of the factor of pairs of poles, from the terms
    (n, n_references, n_lines) of each pole and of its conjugate."""
    return _rows_of(0.5 * (above + below)), _rows_of(-0.5j * (above - below))


def _rows_of(values: np.ndarray) -> np.ndarray:
    """Rows of the fit, (2 n_references n_lines, n), from complex values (n, n_references, n_lines)."""
    rows = values.reshape(values.shape[0], -1).T
    return np.vstack([rows.real, rows.imag])


def _mean_of_decay(total: float) -> float:
    """Mean of e^(-at) over a record at whose end it is e^(-total)."""
    return float(-np.expm1(-total) / total) if abs(total) > 1e-9 else 1.0


def window_rate(residual: np.ndarray, omega: np.ndarray) -> float:
    """1/τ of the exponential window exp(-t/τ) that correlates the noise of neighbouring lines, rad/s; 0 if none.

    From the residual (..., n_lines), complex, in units of its noise.
    Second differences of the lines remove the smooth response. Over the time t of the impulse response, their noise has
    the power exp(-2t/τ) (2 - 2 cos(2πt/T))², whose transform is its correlation. Only phases are used, so that a few
    loud lines count little: for normal z and w of correlation r, the mean of the product of their phasors is π/4 r
    F(1/2, 1/2; 2; |r|²) (Middleton, Introduction to Statistical Communication Theory, ch. 9).
    """
    step = np.diff(omega)
    if np.ptp(step) > 1e-6 * step.max():
        return 0.0
    differences = np.diff(residual, 2).reshape(-1, omega.size - 2)
    phasors = differences / np.maximum(np.abs(differences), 1e-300)
    lags = np.arange(1, LINES.lags + 1)
    correlation = np.array([(phasors[:, lag:] * phasors[:, :-lag].conj()).mean() for lag in lags])
    instants = (np.arange(LINES.instants) + 0.5) / LINES.instants
    power = np.exp(-2.0 * np.outer(WINDOWS, instants)) * (2.0 - 2.0 * np.cos(2.0 * np.pi * instants)) ** 2
    model = power @ np.exp(-2j * np.pi * np.outer(instants, lags)) / power.sum(axis=1, keepdims=True)
    misfit = np.linalg.norm(correlation - np.pi / 4.0 * model * hyp2f1(0.5, 0.5, 2.0, np.abs(model) ** 2), axis=1)
    best = int(np.argmin(misfit))
    significant = misfit[0] - misfit[best] > LINES.window_deviations / np.sqrt(omega.size)
    is_found = significant and misfit[best] < LINES.max_deviation_share * misfit[0]
    return float(WINDOWS[best] * step.mean() / (2.0 * np.pi)) if is_found else 0.0


def relative_noise(lines: Lines, fit: Fit) -> np.ndarray | None:
    """Relative noise of every line, (n_outputs, n_references, n_lines); None where it may be the same at all.

    s = c g(ω) (a² + b² |H|²)^½. c: level of each output and reference, where references differ. g: common to all,
    smooth along frequency, as of integrated accelerations or of a force that falls. a: the sensor's noise. b: of each
    output, noise in proportion to the response, of the force or of too few averages. The part of the response that is
    not yet fitted is smooth from line to line, noise is not: where lines are evenly spaced, r_k less the mean of r_k-1
    and r_k+1 is noise alone, of variance 3/2 s². H is the fitted one, since a measured H is correlated with its noise;
    where a mode is not yet fitted it is the running median of the measured one. g and b are estimated in both orders,
    and that of the smaller deviation is kept.
    """
    residual, fitted, omega = lines.left(fit), lines.fitted(fit), lines.omega
    inner = np.arange(1, omega.size - 1, 3)  # every third, so that no line is used twice
    differences = np.abs(residual[..., inner] - 0.5 * (residual[..., inner - 1] + residual[..., inner + 1]))
    nonzero = np.median(differences, axis=(1, 2)) > 0.0  # an output of zeros has no noise
    if not nonzero.any():
        return None
    smoothed = median_filter(np.abs(fitted + residual), (1, 1, LINES.median_lines))
    size, differences = np.maximum(np.abs(fitted), smoothed)[nonzero], differences[nonzero]
    logs = np.log(np.maximum(differences, 1e-3 * np.median(differences, axis=-1, keepdims=True) + 1e-300))
    levels = _reference_levels(logs)[..., None] * np.ones(omega.size)
    best, least_misfit = levels, np.inf
    for order in ((_frequency_trend, _response_trend), (_response_trend, _frequency_trend)):
        trial = levels
        for estimate in order:
            trial = trial + estimate(logs - trial[..., inner], size, omega, inner)
        error = logs - trial[..., inner]
        if (misfit := np.abs(error - np.median(error, axis=(1, 2), keepdims=True)).sum()) < least_misfit:
            best, least_misfit = trial, misfit
    if not best.any():
        return None
    noise = np.ones(residual.shape)
    noise[nonzero] = np.exp(best)
    return noise


def _reference_levels(logs: np.ndarray) -> np.ndarray:
    """Log level of each reference relative to its output, (n_outputs, n_references); 0 where levels may be equal."""
    levels = np.median(logs, axis=-1)
    levels -= levels.mean(axis=1, keepdims=True)
    differ = [len(rows) > 1 and kruskal(*rows).pvalue < LINES.uneven_probability for rows in logs]
    return np.where(np.array(differ)[:, None], levels, 0.0)


def _frequency_trend(logs: np.ndarray, size: np.ndarray, omega: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """Log level along frequency, (n_lines,), a polynomial of log ω; 0 where it may be constant."""
    x = 2.0 * np.log(omega / omega[0]) / np.log(omega[-1] / omega[0]) - 1.0
    y = np.mean(logs - np.median(logs, axis=-1, keepdims=True), axis=(0, 1))  # outputs may share their noise
    powers, free = np.vander(x, LINES.degree + 1), inner.size - LINES.degree - 1
    if free < 1:
        return np.zeros(omega.size)
    fit = least_squares(lambda c: powers[inner] @ c - y, np.zeros(LINES.degree + 1), loss="soft_l1", f_scale=y.std())
    trend = powers @ fit.x
    between, within = np.var(trend[inner]), np.var(y - trend[inner])
    if f.sf(between / LINES.degree * free / max(within, 1e-300), LINES.degree, free) > LINES.uneven_probability:
        return np.zeros(omega.size)
    return np.asarray(trend - trend.mean())


def _response_trend(logs: np.ndarray, size: np.ndarray, omega: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """Log level as a function of |H|, of the shape of `size`; 0 where it may be constant."""
    log_levels = np.zeros(size.shape)
    for j, (log_noise, size_of_output) in enumerate(zip(logs, size[..., inner], strict=True)):
        typical = float(np.median(size_of_output))
        ranks = spearmanr(log_noise.ravel(), size_of_output.ravel(), alternative="greater")
        if ranks.pvalue > LINES.uneven_probability:
            continue
        # Least absolute deviations of log s: the few lines of a mode not yet fitted count little.
        remaining = [log_noise - 0.5 * np.log1p((share * size_of_output / typical) ** 2) for share in SHARES]
        errors = [np.abs(log - np.median(log)).sum() for log in remaining]
        log_levels[j] = 0.5 * np.log1p((SHARES[int(np.argmin(errors))] * size[j] / typical) ** 2)
    return log_levels
