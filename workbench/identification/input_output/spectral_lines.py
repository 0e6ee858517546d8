"""Lines of measured transfer functions, as a `modal_fit.Measurement`, and their noise."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.optimize import least_squares
from scipy.special import hyp2f1
from scipy.stats import chi2, f, kruskal, spearmanr

from workbench.identification.input_output.modal_fit import Fit
from workbench.identification.input_output.model_order import bases_of, weights_of
from workbench.identification.signal.searches import SELECTION


@dataclass(frozen=True)
class LinesSettings:
    """Constants of the search among lines."""

    most_candidates: int = 600  # lines, the strongest, where poles are tried
    rates: int = 6  # of decay
    beside: int = 25  # lines on either side from which the noise about a pole is taken
    peaks_a_rate: int = 10  # candidates of each rate of decay
    louder: float = 0.01  # chance that noise of one level is taken for louder about a mode
    uneven: float = 1e-4  # chance that even noise is taken for uneven
    smoothed: int = 5  # lines of a running median
    lags: int = 3  # lines, over which noise that was windowed is seen to be correlated
    instants: int = 2000  # of a record, by which that is reckoned
    windowed: float = 5.0  # standard errors of one output's correlation from which on there was a window
    explained: float = 0.3  # of what differs from noise without a window, at most left by the best one
    degree: int = 3  # of the polynomial of log ω that noise follows along frequency


LINES = LinesSettings()
DETUNED = np.array([-4.0, -3.0, -2.0, 2.0, 3.0, 4.0])  # half-power bandwidths beside a mode
WINDOWS = np.r_[0.0, np.geomspace(0.1, 30.0, 60)]  # length of a record, in time constants of its window
SHARES = np.geomspace(1e-3, 1e3, 61)  # b |H| / a at the median line, from nothing to all


class Lines:
    """Rows are real, then imaginary parts, reference by reference.

    Args:
        h: (n_outputs, n_references, n_lines).
        omega: (n_lines,) rad/s.
        powers: of s, in the residual terms.
        noise: of each line, as `h`; the same for all unless given.
        guessed: whether it is known but for its size.
        beside: (n_rows, n_columns) fixed columns beside those of the residual terms.
        changing: of the modes that move along these, their pole and by how much their frequency scatters, rad/s.
        window_rate: 1/τ of an exponential window, as far as noise shows one.
    """

    def __init__(
        self,
        h: np.ndarray,
        omega: np.ndarray,
        powers: list[int],
        noise: np.ndarray | None,
        guessed: bool = False,
        beside: np.ndarray | None = None,
        changing: tuple[tuple[complex, float], ...] = (),
        window_rate: float = 0.0,
    ) -> None:
        self.window_rate = window_rate
        self.h, self.powers, self.stated = h, powers, noise
        self.distorted: tuple[complex, ...] = ()
        self.free: tuple[complex, ...] = ()
        self.guessed, self.beside, self.changing = guessed, beside, changing
        self.omega, (_, self.refs, self.lines) = omega, h.shape
        self.n_inputs = self.refs
        self.weights = None if noise is None else 1.0 / self._stacked(noise * (1 + 1j))
        self.values = self._stacked(h) * (1.0 if self.weights is None else self.weights)
        s = 1j * omega / omega[-1]
        self.fixed = self._stacked(np.array([self._of(i, s**p) for i in range(self.refs) for p in powers]))
        if beside is not None:
            self.fixed = np.hstack([self.fixed, beside])
        self.resolution = float(np.diff(omega).min())
        # A pole may leave the band: one close beyond it is no constant there. Such poles are residual terms.
        self.highest, self.nyquist = 2.0 * float(omega[-1]), np.inf
        span = omega[-1] - omega[0]
        self.rates = np.geomspace(0.3 * self.resolution, max(0.03 * span, self.resolution), LINES.rates)
        self.cells = LINES.rates * self.lines

    def of(self, h: np.ndarray) -> "Lines":
        """The same lines of other outputs, their noise not known."""
        return Lines(h, self.omega, self.powers, None, False, self.beside, self.changing, self.window_rate)

    def weighted_by(self, guessed: np.ndarray) -> "Lines":
        """The same lines with their noise known but for its size."""
        return Lines(self.h, self.omega, self.powers, guessed, True, self.beside, self.changing, self.window_rate)

    def with_columns(self, columns: np.ndarray, changing: tuple[complex, float]) -> "Lines":
        """The same lines with further fixed columns, those of a mode that changes."""
        beside = columns if self.beside is None else np.hstack([self.beside, columns])
        changed = (*self.changing, changing)
        return Lines(self.h, self.omega, self.powers, self.stated, self.guessed, beside, changed, self.window_rate)

    def without_columns(self) -> "Lines":
        """The same lines without what modes that change move."""
        return Lines(self.h, self.omega, self.powers, self.stated, self.guessed, window_rate=self.window_rate)

    def only(self, which: np.ndarray, smooth: int) -> "Lines":
        """Some lines (n_lines,), beside polynomials up to a degree as well."""
        omega = self.omega[which]
        middle = 0.5 * (omega[0] + omega[-1])
        at = (omega - middle) / max(omega[-1] - middle, 1e-300)
        noise = None if self.stated is None else self.stated[..., which]
        found = Lines(self.h[..., which], omega, self.powers, noise, self.guessed, window_rate=self.window_rate)
        further = [factor * at**k for k in range(smooth + 1) for factor in (1.0, 1j)]
        polynomials = found._stacked(np.array([found._of(i, x) for i in range(self.refs) for x in further]))
        beside = [] if self.beside is None else [self.beside[np.tile(which, 2 * self.refs)]]
        found.fixed = np.hstack([found.fixed, polynomials, *beside])
        return found

    def _stacked(self, values: np.ndarray) -> np.ndarray:
        rows = values.reshape(values.shape[0], -1).T
        return np.vstack([rows.real, rows.imag])

    def _of(self, reference: int, values: np.ndarray) -> np.ndarray:
        found = np.zeros((self.refs, self.lines), complex)
        found[reference] = values
        return found

    def unstacked(self, rows: np.ndarray) -> np.ndarray:
        real, imaginary = np.split(rows, 2)
        return (real + 1j * imaginary).T.reshape(-1, self.refs, self.lines)

    def responses(self, pole: complex) -> tuple[np.ndarray, np.ndarray]:
        s = 1j * self.omega
        above, below = 1.0 / (s - pole), 1.0 / (s - pole.conjugate())
        pair = (0.5 * (above + below), -0.5j * (above - below))
        real, imaginary = (self._stacked(np.array([self._of(i, x) for i in range(self.refs)])) for x in pair)
        return real, imaginary

    def slopes(self, pole: complex, participation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = 1j * self.omega
        above = participation[:, None] / (s - pole) ** 2
        below = participation.conj()[:, None] / (s - pole.conjugate()) ** 2
        return self.stacked_pair(above, below)

    def stacked_pair(self, above: np.ndarray, below: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (n_rows,) of the real and of the imaginary part of a factor of a pair, (n_references, n_lines) each."""
        pair = (0.5 * (above + below), -0.5j * (above - below))
        real, imaginary = (self._stacked(x[None])[:, 0] for x in pair)
        return real, imaginary

    def candidates(self, residual: np.ndarray) -> np.ndarray:
        left = self.unstacked(residual if self.weights is None else residual * self.weights).reshape(-1, self.lines)
        weight = 1.0 if self.weights is None else (np.abs(self.unstacked(self.weights)) ** 2).mean(axis=(0, 1)) / 2.0
        power = (np.abs(left) ** 2).sum(axis=0)
        at = np.sort(np.argsort(power)[-LINES.most_candidates :])
        found, strength = [], []
        for rate in self.rates:
            x = 1.0 / (1j * (self.omega - self.omega[at, None]) + rate)
            score = (np.abs(left @ x.conj().T) ** 2).sum(axis=0) / (np.abs(x) ** 2 * weight).sum(axis=1)
            score[rate > SELECTION.most_damped * self.omega[at]] = 0.0
            best = np.argsort(score)[-LINES.peaks_a_rate :]
            found.append(-rate + 1j * self.omega[at[best]])
            strength.append(score[best])
        order = np.argsort(np.concatenate(strength))[::-1]
        beyond = np.r_[0.6 * self.omega[0], 0.9 * self.omega[0], np.array([1.05, 1.2, 1.5]) * self.omega[-1]]
        return np.asarray(np.r_[np.concatenate(found)[order[: 3 * LINES.peaks_a_rate]], (-0.01 + 1j) * beyond])

    def fitted(self, fit: Fit) -> np.ndarray:
        """The model at the lines, (n_outputs, n_references, n_frequencies)."""
        return self.unstacked((self.values - fit.residual) / (1.0 if self.weights is None else self.weights))

    def left(self, fit: Fit) -> np.ndarray:
        """The residual at the lines, (n_outputs, n_references, n_frequencies)."""
        return self.unstacked(fit.residual / (1.0 if self.weights is None else self.weights))

    def misfit(self, fit: Fit) -> np.ndarray:
        """Rms of the residual of each output, (n_outputs,), in units of the noise where that was stated."""
        if not self.guessed:
            return fit.noise
        raw = fit.residual / self.weights
        return np.asarray(fit.noise * np.sqrt((raw**2).sum(axis=0) / (fit.residual**2).sum(axis=0)))

    def noise_ratio_near(self, fit: Fit) -> np.ndarray:
        """κ, the power of the residual about each mode over the mean of all lines, (n_modes,).

        It is measured by poles a few half-power bandwidths beside the mode, outputs weighted by their amplitude. 1
        where the noise may be the same at all lines.
        """
        residual, noise = fit.residual / fit.noise, fit.noise
        found = np.ones(fit.poles.size)
        if self.weights is not None and not self.guessed:
            return found
        bases, weights = bases_of(self, fit), weights_of(self)
        for r, pole in enumerate(fit.poles):
            shown = (np.abs(fit.amplitudes[:, r]) / noise) ** 2
            width = max(abs(pole.real), 0.5 * self.resolution)
            noise_ratio = []
            for beside in pole.imag + width * DETUNED:
                if self.omega[0] < beside < self.omega[-1]:
                    columns = np.hstack(self.responses(-width + 1j * beside))
                    power = []
                    for basis, weight, rest in zip(bases, weights, np.split(residual, len(bases), axis=1), strict=True):
                        # The amplitudes took the noise along the basis.
                        x = weight * columns - basis @ (basis.T @ (weight * columns))
                        power.append((x.T @ rest) ** 2 / (x**2).sum(axis=0)[:, None])
                    noise_ratio.append(np.hstack(power))
            if not noise_ratio:
                continue
            power = np.mean(noise_ratio, axis=(0, 1)) @ shown / shown.sum()
            degrees = np.size(noise_ratio) / shown.size * shown.sum() ** 2 / (shown**2).sum()
            found[r] = power if power > chi2.isf(LINES.louder, degrees) / degrees else 1.0
        return found

    def noise_ratio(self, residual: np.ndarray, pole: complex) -> float:
        power = (np.abs(self.unstacked(residual)) ** 2).mean(axis=(0, 1))
        at = int(np.argmin(np.abs(self.omega - pole.imag)))
        beside = power[max(at - LINES.beside, 0) : at + LINES.beside + 1]
        # The median of a power of two degrees of freedom and more is at most its mean.
        return max(1.0, float(np.median(beside) / power.mean())) * self._early(-pole.real)

    def _early(self, rate: float) -> float:
        """Power of windowed noise in the impulse response of a pole over that of noise that no window shortens."""
        length = 2.0 * np.pi / self.resolution
        window, own = 2.0 * self.window_rate * length, 2.0 * rate * length
        return float(_mean_of_decay(window + own) / (_mean_of_decay(window) * _mean_of_decay(own)))


def _mean_of_decay(total: float) -> float:
    """Of e^(-at) over a record at the end of which it is e^(-total)."""
    return float(-np.expm1(-total) / total) if abs(total) > 1e-9 else 1.0


def window_rate(left: np.ndarray, omega: np.ndarray) -> float:
    """1/τ of the exponential window exp(-t/τ) that correlates the noise of neighbouring lines, rad/s; 0 if none.

    Second differences of the lines, which leave nothing of what is smooth, are noise that over the time t of the
    impulse response has the power exp(-2t/τ) (2 - 2 cos(2πt/T))², and so are correlated as that transforms. Only their
    phases count, so that a few loud lines do not; of normal z and w of the correlation r the mean of the product of
    their phasors is π/4 r F(1/2, 1/2; 2; |r|²) (Middleton, Introduction to Statistical Communication Theory, ch. 9).

    Args:
        left: the residual in units of its noise, complex, lines last.
        omega: (n_lines,).
    """
    step = np.diff(omega)
    if np.ptp(step) > 1e-6 * step.max():
        return 0.0
    rough = np.diff(left, 2).reshape(-1, omega.size - 2)
    phasors = rough / np.maximum(np.abs(rough), 1e-300)
    lags = np.arange(1, LINES.lags + 1)
    seen = np.array([(phasors[:, m:] * phasors[:, :-m].conj()).mean() for m in lags])
    at = (np.arange(LINES.instants) + 0.5) / LINES.instants
    power = np.exp(-2.0 * np.outer(WINDOWS, at)) * (2.0 - 2.0 * np.cos(2.0 * np.pi * at)) ** 2
    r = power @ np.exp(-2j * np.pi * np.outer(at, lags)) / power.sum(axis=1, keepdims=True)
    off = np.linalg.norm(seen - np.pi / 4.0 * r * hyp2f1(0.5, 0.5, 2.0, np.abs(r) ** 2), axis=1)
    best = int(np.argmin(off))
    sure = off[0] - off[best] > LINES.windowed / np.sqrt(omega.size) and off[best] < LINES.explained * off[0]
    return float(WINDOWS[best] * step.mean() / (2.0 * np.pi)) if sure else 0.0


def relative_noise(left: np.ndarray, fitted: np.ndarray, omega: np.ndarray) -> np.ndarray | None:
    """Relative noise of every line, (n_outputs, n_references, n_lines); None where it may be the same at all.

    s = c g(ω) (a² + b² |H|²)^½: c of each output and reference, as far as references differ; g, of all of them, smooth
    along frequency, as of accelerations that were integrated or of a force that falls; a the sensor's own noise, b of
    each output, that of the force or of too few averages. What a fit has not yet found is smooth from line to line,
    noise is not: where lines are evenly spaced, r_k less the mean of r_k-1 and r_k+1 is noise alone, 3/2 s² of it. H is
    the fit's own, for a measured H goes with its noise; where a mode is not yet found it is the running median of the
    measured. Of the orders in which g and b are found, that counts which leaves less.

    Args:
        left: the residual, complex, of that shape.
        fitted: the fit, of that shape.
        omega: (n_lines,) rad/s.
    """
    inner = np.arange(1, left.shape[-1] - 1, 3)  # every third: no line counts twice
    rough = np.abs(left[..., inner] - 0.5 * (left[..., inner - 1] + left[..., inner + 1]))
    seen = median_filter(np.abs(fitted + left), (1, 1, LINES.smoothed))
    size = np.maximum(np.abs(fitted), seen)
    live = np.median(rough, axis=(1, 2)) > 0.0  # an output of zeros has no noise
    if not live.any():
        return None
    if not live.all():
        whole = np.ones(left.shape)
        of_live = relative_noise(left[live], fitted[live], omega)
        whole[live] = 1.0 if of_live is None else of_live
        return None if of_live is None else whole
    logs = np.log(np.maximum(rough, 1e-3 * np.median(rough, axis=-1, keepdims=True) + 1e-300))
    levels = _of_references(logs)[..., None] * np.ones(left.shape[-1])
    found, least = levels, np.inf
    for order in ((_along, _with_size), (_with_size, _along)):
        trial = levels
        for part in order:
            trial = trial + part(logs - trial[..., inner], size, omega, inner)
        error = logs - trial[..., inner]
        if (misfit := np.abs(error - np.median(error, axis=(1, 2), keepdims=True)).sum()) < least:
            found, least = trial, misfit
    return np.exp(found) if found.any() else None


def _of_references(logs: np.ndarray) -> np.ndarray:
    """Log of the level of each reference in that of its output, (n_outputs, n_references); 0 where they may be one."""
    levels = np.median(logs, axis=-1)
    levels -= levels.mean(axis=1, keepdims=True)
    differ = [len(rows) > 1 and kruskal(*rows).pvalue < LINES.uneven for rows in logs]
    return np.where(np.array(differ)[:, None], levels, 0.0)


def _along(logs: np.ndarray, size: np.ndarray, omega: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """Log of the level along frequency, (n_lines,), a polynomial of log ω; 0 where it may be one."""
    x = 2.0 * np.log(omega / omega[0]) / np.log(omega[-1] / omega[0]) - 1.0
    y = np.mean(logs - np.median(logs, axis=-1, keepdims=True), axis=(0, 1))  # of outputs that may share their noise
    powers, free = np.vander(x, LINES.degree + 1), inner.size - LINES.degree - 1
    if free < 1:
        return np.zeros(omega.size)
    fit = least_squares(lambda c: powers[inner] @ c - y, np.zeros(LINES.degree + 1), loss="soft_l1", f_scale=y.std())
    trend = powers @ fit.x
    between, within = np.var(trend[inner]), np.var(y - trend[inner])
    if f.sf(between / LINES.degree * free / max(within, 1e-300), LINES.degree, free) > LINES.uneven:
        return np.zeros(omega.size)
    return np.asarray(trend - trend.mean())


def _with_size(logs: np.ndarray, size: np.ndarray, omega: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """Log of the level that goes with the size of the lines, of the shape of `size`; 0 where it may be one."""
    found = np.zeros(size.shape)
    for j, (each, of) in enumerate(zip(logs, size[..., inner], strict=True)):
        typical = float(np.median(of))
        if spearmanr(each.ravel(), of.ravel(), alternative="greater").pvalue > LINES.uneven:
            continue
        # Least absolute errors of log s: the few lines of a mode not yet found count little.
        rest = [each - 0.5 * np.log1p((share * of / typical) ** 2) for share in SHARES]
        errors = [np.abs(log - np.median(log)).sum() for log in rest]
        found[j] = 0.5 * np.log1p((SHARES[int(np.argmin(errors))] * size[j] / typical) ** 2)
    return found
