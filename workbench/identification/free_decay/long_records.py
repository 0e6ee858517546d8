"""Model order selection for long records of many sensors, at a cost proportional to the number of samples.

The tests are those of `order`, but many modes enter at a time. The residual r_j, weighted by its noise s_j, is
correlated with damped exponentials e^{λt} by fast Fourier transforms, for each decay rate over as many samples as the
exponential lasts,

    χ²(λ) = 2 Σ_j |Σ_t e^{λ* t} r_j(t)|² / (s_j² Σ_t |e^{λt}|² (1 - o)),    o the share that current modes explain.

Every peak enters that exceeds the noise about it and the leakage of stronger peaks,

    |<e^{λt}, e^{κt}>|² / (‖e^{λt}‖² ‖e^{κt}‖²) = 4 σ_λ σ_κ / ((σ_λ + σ_κ)² + (ω_λ - ω_κ)²).

All poles are then fitted together to the whole record, and those that fail the tests leave again. Modes masked by
stronger ones show in the next round; the search ends when no peak exceeds the noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import next_fast_len, rfft
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2

from workbench.identification.free_decay.refinement import (
    amplitude_statistic,
    as_refined,
    fitted_poles,
    identified,
    in_coloured_noise,
    noise_level,
    over_noise,
    thresholds,
)
from workbench.identification.signal.modal_estimates import IdentifiedModes
from workbench.identification.signal.projection import forget_transforms, independent, project
from workbench.identification.signal.searches import FALSE_ALARM, FIT, FURTHER, SELECTION, TimeLimit, spurious_modes
from workbench.records.record import Record
from workbench.threads import cores


@dataclass(frozen=True)
class LongSettings:
    """Constants of the search in long records."""

    min_decay_nepers: float = 0.7  # lowest decay rate of the search, over the record
    rate_ratio: float = 4.0  # of each decay rate to the one before
    max_time_constants: float = 8.0  # after which an exponential is cut off
    batch_size: int = 16  # outputs transformed together
    min_half_window: int = 64  # cells on either side of a peak, from which the noise about it is estimated
    # that estimate it: the residual about a mode that depends on amplitude is not smooth
    noise_quantiles: tuple[float, ...] = (0.5, 0.9)
    min_leakage_ratio: float = 2.0  # of a peak to the leakage of stronger peaks
    min_independent_share: float = 0.05  # of a candidate, outside the span of the current modes
    overlap_share: float = 0.5  # least share of common energy of two modes that overlap
    ridge: float = 1e-10  # regularisation for overlapping modes, relative to the energy of each
    entry_steps: int = 6  # of least squares after peaks entered
    max_rounds: int = 60
    max_rejections: int = 2  # of a peak that is tried again: the first may be due to poles that have not converged
    # rounds without a further mode after which the search ends: in coloured noise, or where modes depend on amplitude,
    # it might not end otherwise
    max_fruitless_rounds: int = 3


LONG = LongSettings()


def identify_long(
    records: Sequence[Record], *, max_modes: int, false_alarm: float = FALSE_ALARM, time_limit: TimeLimit | None = None
) -> IdentifiedModes | None:
    """The modes of long records, as of `identify`, their number selected; None where none is significant."""
    measured = _Search(records, false_alarm, time_limit or TimeLimit())
    measured.run(max_modes)
    uncorrelated = independent(records, [fit.residual.T for fit in measured.fits]) if measured.poles.size else None
    if uncorrelated is None:
        return measured.refined(measured.statistic()) if measured.poles.size else None
    # Correlated noise makes peaks in all outputs; combinations of uncorrelated noise do without them.
    mixed = _Search(uncorrelated[0], false_alarm, measured.time_limit)
    mixed.origins = measured.origins
    mixed.settle(measured.poles, LONG.entry_steps)
    mixed.run(max_modes)
    measured.rejected += mixed.rejected
    measured.settle(mixed.poles, FIT.max_steps)
    return measured.refined(mixed.statistic()) if mixed.poles.size else None


class _Search:
    """The state of the search: current poles, their fit and residual, and rejected candidates.

    Attributes:
        enter, limit: χ² from which on a peak enters, and a mode stays, in white noise.
        origins: poles of the modes as they entered, rad/s.
        rejected: poles of rejected candidates as they entered, with their statistic.
        fine: χ² of the lowest decay rate in the residual, by frequency.
    """

    def __init__(self, records: Sequence[Record], false_alarm: float, time_limit: TimeLimit) -> None:
        self.records, self.time_limit = records, time_limit
        self.dt, self.longest = records[0].sample_time, max(r.n_samples for r in records)
        self.span = self.longest * self.dt
        self.bin_width = 2.0 * np.pi / self.span
        count = 1 + int(np.log(max(0.1 * np.pi * self.longest / LONG.min_decay_nepers, 1.0)) / np.log(LONG.rate_ratio))
        self.rates = LONG.min_decay_nepers / self.span * LONG.rate_ratio ** np.arange(count)
        n_signals = sum(r.n_outputs for r in records)
        self.white = chi2.ppf(LONG.noise_quantiles, 2 * n_signals)
        n_cells = sum(self._size(rate)[1] // 2 for rate in self.rates)
        self.enter, self.limit = thresholds(false_alarm, n_cells, n_signals)
        # The round-off level of sums over so many samples.
        self.floor = 1e-11 * np.sqrt(np.mean([(r.outputs**2).mean() for r in records]))
        self.origins = np.zeros(0, complex)
        self.rejected: list[tuple[complex, float]] = []
        self.weights = np.ones((len(records), records[0].n_outputs))
        self.fine = np.zeros(1)
        self.settle(np.zeros(0, complex), 0)

    def run(self, max_modes: int) -> None:
        """Add peaks and remove modes that fail the tests, until no peak exceeds the noise."""
        fruitless = 0
        for _ in range(LONG.max_rounds):
            before = self.poles.size
            # The first modes are searched whatever the time.
            ended = fruitless >= LONG.max_fruitless_rounds or (before > 0 and self.time_limit.spent(FURTHER))
            peaks = np.zeros(0) if ended else self.peaks()[: max(max_modes - before, 0)]
            if peaks.size:
                self.origins = np.append(self.origins, peaks)
                self.settle(np.append(self.poles, peaks), LONG.entry_steps)
                self.remove()
                fruitless = 0 if self.poles.size > before else fruitless + 1
            else:
                self.settle(self.poles, FIT.max_steps)
                if not self.remove(thoroughly=not self.time_limit.spent("check of each mode")):
                    break

    def settle(self, poles: np.ndarray, most_steps: int) -> None:
        """Fit all poles together, outputs weighted by the residual of the fit before."""
        if poles.size:
            self.poles, self.fits, self.converged, self.steps = fitted_poles(
                self.records, poles, self.weights, True, most_steps, hold=True, time_limit=self.time_limit
            )
        else:
            self.poles, self.converged, self.steps = poles, True, 0
            self.fits = [project(record, poles, True) for record in self.records]
        self.noise = np.maximum(noise_level(self.records, self.fits, self.weights), self.floor)
        self.weights = 1.0 / self.noise

    def peaks(self) -> np.ndarray:
        """Poles of the significant peaks of the residual, strongest first."""
        self.fine = self._strengths(self.rates[0])
        by_rate = [self._peaks(self.rates[0], self.fine)]
        by_rate += [self._peaks(rate, self._strengths(rate)) for rate in self.rates[1:]]
        height, poles = np.concatenate([h for h, _ in by_rate]), np.concatenate([p for _, p in by_rate])
        taken, heights = np.zeros(0, complex), np.zeros(0)
        for r in np.argsort(-height):
            leaked = np.sqrt(heights * self._overlap(taken, poles[r])).sum() ** 2
            if height[r] > LONG.min_leakage_ratio * leaked and height[r] > self.enter * self._noise_ratio(poles[r]):
                taken, heights = np.append(taken, poles[r]), np.append(heights, height[r])
        return taken

    def remove(self, thoroughly: bool = False) -> bool:
        """Remove poles that are spurious or insignificant; whether any was.

        With `thoroughly`, also modes that are insignificant once overlapping modes are refitted without them.
        """
        if self.poles.size == 0:
            return False
        statistic, shapes = self.statistic(), over_noise(self.fits, self.weights)
        limit = self.limit * np.array([self._noise_ratio(pole) for pole in self.poles])
        out = spurious_modes(self.poles, shapes, statistic, self.bin_width) | (statistic < limit)
        if thoroughly:
            for r in map(int, np.flatnonzero(~out)):
                near = np.flatnonzero(self._overlap(self.poles, self.poles[r]) > LONG.overlap_share)
                if near.size == 1:
                    continue
                # χ² in combinations of the outputs that are orthogonal to the shapes of the neighbours
                beside = self._directions(near[near != r])
                if amplitude_statistic(self.fits, self.weights, r, beside) < limit[r]:
                    statistic[r] = self._gain(r, near)
                    out[r] = statistic[r] < limit[r]
        for r in map(int, np.flatnonzero(out)):
            # Of two overlapping modes the weaker leaves first: the other may then be significant.
            weaker = out & (statistic < statistic[r]) & (self._overlap(self.poles, self.poles[r]) > LONG.overlap_share)
            out[r] = not weaker.any()
        if out.any():
            self.rejected += [(complex(pole), e) for pole, e in zip(self.origins[out], statistic[out], strict=True)]
            self.origins = self.origins[~out]
            self.settle(self.poles[~out], 2)
        return bool(out.any())

    def statistic(self) -> np.ndarray:
        """χ² of the amplitudes of each mode at fixed poles, (n_modes,)."""
        return np.array([amplitude_statistic(self.fits, self.weights, r) for r in range(self.poles.size)])

    def _directions(self, which: np.ndarray) -> np.ndarray:
        """Orthonormal directions (n_outputs, n_directions) of the shapes of some modes in all records."""
        shapes = np.hstack(np.split(over_noise(self.fits, self.weights)[:, which], len(self.fits)))
        return np.linalg.qr(np.hstack([shapes.real, shapes.imag]))[0]

    def refined(self, statistic: np.ndarray) -> IdentifiedModes:
        """The modes with their covariance, and the statistic (n_modes,) of each."""
        fit = self.records, self.poles, self.fits, self.noise
        refined = as_refined(*fit, converged=self.converged, steps=self.steps)
        refined = in_coloured_noise(refined, self.records, self.fits)
        statistic = statistic[np.argsort(np.abs(self.poles))]
        return identified(refined, statistic, self.limit, self.rejected, self.records[0], self.time_limit.remarks)

    def _size(self, rate: float) -> tuple[int, int]:
        """Samples that an exponential of this decay rate lasts, and the length of a transform that resolves it."""
        n = min(self.longest, int(np.ceil(LONG.max_time_constants / (rate * self.dt))))
        return n, next_fast_len(n if rate * n * self.dt > 0.5 * LONG.max_time_constants else 2 * n, real=True)

    def _strengths(self, rate: float) -> np.ndarray:
        """χ² of one decay rate at every frequency of its transform, (n_frequencies,), without 1 / (1 - o)."""
        lives, size = self._size(rate)
        chi_square = np.zeros(size // 2 + 1, np.float32)
        for fit, weights in zip(self.fits, self.weights, strict=True):
            n = min(lives, len(fit.residual))
            energy = np.expm1(-2.0 * rate * self.dt * n) / np.expm1(-2.0 * rate * self.dt)
            scale = (np.sqrt(2.0 / energy) * weights).astype(np.float32)
            for first in range(0, weights.size, LONG.batch_size):
                some = slice(first, first + LONG.batch_size)
                # In single precision and in place, to save memory.
                decayed = np.zeros((scale[some].size, size), np.float32)
                decay = np.arange(n, dtype=np.float32)
                decay *= -rate * self.dt
                np.exp(decay, out=decay)
                decayed[:, :n] = fit.residual[:n, some].T
                decayed[:, :n] *= scale[some, None]
                decayed[:, :n] *= decay
                del decay
                spectrum = rfft(decayed, axis=1, workers=cores())
                del decayed
                forget_transforms(n)
                chi_square += np.einsum("jk,jk->k", spectrum.real, spectrum.real)
                chi_square += np.einsum("jk,jk->k", spectrum.imag, spectrum.imag)
        return chi_square

    def _noise_ratio(self, pole: complex) -> float:
        """Noise about a pole over white noise, 1 or more, by quantiles of the last χ² of the lowest decay rate."""
        step = np.pi / (self.fine.size * self.dt)
        at, half = round(pole.imag / step), max(int(abs(pole.real) / step), LONG.min_half_window)
        nearby = self.fine[max(at - half, 0) : at + half + 1]
        return max(1.0, float((np.quantile(nearby, LONG.noise_quantiles) / self.white).max()))

    def _peaks(self, rate: float, strengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """χ² and poles of the local maxima of one decay rate that exceed white noise."""
        step = 2.0 * np.pi / (self._size(rate)[1] * self.dt)
        omega = step * np.arange(strengths.size)
        lowest = max(rate / SELECTION.max_damping, 1.5 * self.bin_width)
        inside = (omega > lowest) & (omega < np.pi / self.dt - self.bin_width)
        highest = np.r_[False, (strengths[1:-1] > strengths[:-2]) & (strengths[1:-1] >= strengths[2:]), False]
        at = np.flatnonzero(inside & highest & (strengths > LONG.min_independent_share * self.enter))
        poles = -rate + 1j * omega[at]
        rejected = np.zeros(at.size, int)
        for pole, _ in self.rejected:
            rejected += np.abs(poles.imag - pole.imag) < 2.0 * max(self.bin_width, 0.5 * abs(pole.real))
        at, poles = at[rejected < LONG.max_rejections], poles[rejected < LONG.max_rejections]
        independent_share = self._independent(poles)
        chi_square = strengths[at] / np.maximum(independent_share, LONG.min_independent_share)
        good = (independent_share > LONG.min_independent_share) & (chi_square > self.enter)
        return chi_square[good], poles[good]

    def _independent(self, poles: np.ndarray) -> np.ndarray:
        """Share of each candidate, sorted by frequency, outside the span of the current modes, (n_candidates,)."""
        share = np.ones(poles.size)
        reach = 3.0 * (2.0 * self.bin_width + np.abs(self.poles.real))
        for first in range(0, poles.size, LONG.min_half_window):
            block = slice(first, first + LONG.min_half_window)
            candidates = poles[block]
            wider = reach + 3.0 * np.abs(candidates[0].real)
            near = self.poles[
                (self.poles.imag > candidates[0].imag - wider) & (self.poles.imag < candidates[-1].imag + wider)
            ]
            if near.size:
                products = self._products(near, candidates)
                gram = self._products(near, near)
                factor = cho_factor(gram + LONG.ridge * np.diag(np.diag(gram)))
                shared = (products.conj() * cho_solve(factor, products)).sum(axis=0).real
                share[block] = 1.0 - shared / np.diag(self._products(candidates[:1], candidates[:1])).real
        return share

    def _products(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Σ_t (e^{a t})* e^{b t} over the longest record, (a.size, b.size)."""
        rate = (np.add.outer(a.conj(), b)) * self.dt
        small = np.abs(rate) < 1e-12
        return np.where(small, self.longest, np.expm1(rate * self.longest) / np.where(small, 1.0, np.expm1(rate)))

    def _overlap(self, poles: np.ndarray, pole: complex) -> np.ndarray:
        """Share of energy that a pole has in common with each of `poles`, at the resolution of the record."""
        a, b = np.abs(poles.real) + 1.0 / self.span, abs(pole.real) + 1.0 / self.span
        return np.asarray(4.0 * a * b / ((a + b) ** 2 + (poles.imag - pole.imag) ** 2))

    def _gain(self, r: int, near: np.ndarray) -> float:
        """χ² of mode r, with the poles near it refitted without it.

        Computed in the span of the shapes of these modes: other combinations of the outputs do not contain them.
        """
        directions = self._directions(near)
        projected, channels = [], self.records[0].output_channels[: directions.shape[1]]
        for record, fit, weights in zip(self.records, self.fits, self.weights, strict=True):
            residual = (fit.residual * weights) @ directions
            a = directions.T @ (fit.complex_amplitudes[:, near] * weights[:, None])
            own = (a @ np.exp(np.outer(self.poles[near], self.dt * np.arange(record.n_samples)))).real
            projected.append(replace(record, outputs=residual.T + own, output_channels=channels))
        alone = np.ones((len(projected), directions.shape[1]))
        _, with_it, *_ = fitted_poles(projected, self.poles[near], alone, False, SELECTION.trial_steps)
        _, without, *_ = fitted_poles(projected, self.poles[near[near != r]], alone, False, SELECTION.trial_steps)
        return float(sum((a.residual**2).sum() - (b.residual**2).sum() for a, b in zip(without, with_it, strict=True)))
