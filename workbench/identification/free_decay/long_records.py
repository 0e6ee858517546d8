"""Which modes a long record of many sensors holds, at a cost that grows with its samples and no faster.

As `order` decides it, but many at a time. What the modes so far leave of the record, weighted by its noise, is compared
with damped exponentials e^{λt} by fast transforms, each rate of decay over as many samples as it lasts,

    χ²(λ) = 2 Σ_j |Σ_t e^{λ* t} r_j(t)|² / (s_j² Σ_t |e^{λt}|² (1 - o)),    o the share that the modes so far explain,

and every peak enters that rises above the noise about it and above the leakage of stronger peaks,

    |<e^{λt}, e^{κt}>|² / (‖e^{λt}‖² ‖e^{κt}‖²) = 4 σ_λ σ_κ / ((σ_λ + σ_κ)² + (ω_λ - ω_κ)²).

All poles are then fitted together, on the whole record, and those leave again that are no modes. What was masked by
strong ones shows in the next round; the search ends when no peak is higher than noise makes it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import next_fast_len, rfft
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2

from workbench.identification.free_decay.refinement import (
    as_refined,
    identified,
    in_coloured_noise,
    noise_level,
    search,
)
from workbench.identification.signal.modal_estimates import Identified
from workbench.identification.signal.projection import Projection, forget_transforms, independent
from workbench.identification.signal.searches import FALSE_ALARM, FIT, FURTHER, SELECTION, Budget, spurious_modes
from workbench.records.record import Record
from workbench.threads import cores


@dataclass(frozen=True)
class LongSettings:
    """Constants of the search in long records."""

    slowest: float = 0.7  # nepers over the record: the slowest rate of decay that is searched
    ratio: float = 4.0  # of each rate to the one before
    life: float = 8.0  # time constants after which a damped exponential is left out
    at_once: int = 16  # outputs transformed together
    beside: int = 64  # cells on either side from which the noise about a peak is taken
    # its quantiles: the residual about a mode that depends on amplitude is not smooth
    shares: tuple[float, ...] = (0.5, 0.9)
    leaked: float = 2.0  # times the leakage of stronger peaks that a peak must be
    least_independent: float = 0.05  # share of a candidate outside the modes so far
    overlaps: float = 0.5  # share of energy from which two modes overlap
    ridge: float = 1e-10  # of the energy of each mode, lest modes that overlap be singular
    steps: int = 6  # of least squares after peaks entered
    most_rounds: int = 60
    most_rejections: int = 2  # of a peak: one rejected so often is noise, once may be for poles not converged
    # rounds that leave no more modes than before: where noise is not white, or modes depend on amplitude, they would
    # not end
    most_fruitless: int = 3


LONG = LongSettings()


def identify_long(
    records: Sequence[Record], *, max_modes: int, false_alarm: float = FALSE_ALARM, budget: Budget | None = None
) -> Identified | None:
    """The modes of long records, as many as there are; None where none rises above the noise.

    Args:
        records: free decay in white noise, of the same sensors at one rate; each output may hold a constant.
        max_modes: where to stop at the latest.
        false_alarm: chance that noise alone is taken for a mode.
        budget: of time; none unless given.
    """
    measured = _Search(records, false_alarm, budget or Budget())
    measured.run(max_modes)
    apart = independent(records, [fit.residual.T for fit in measured.fits]) if measured.poles.size else None
    if apart is None:
        return measured.report(measured.statistic()) if measured.poles.size else None
    # noise that outputs share makes peaks in all of them
    mixed = _Search(apart[0], false_alarm, measured.budget)
    mixed.origins = measured.origins
    mixed.settle(measured.poles, LONG.steps)
    mixed.run(max_modes)
    measured.rejected += mixed.rejected
    measured.settle(mixed.poles, FIT.most_steps)
    return measured.report(mixed.statistic()) if mixed.poles.size else None


class _Search:
    """Poles so far, their residual, and what was rejected."""

    def __init__(self, records: Sequence[Record], false_alarm: float, budget: Budget) -> None:
        self.records, self.budget = records, budget
        self.dt, self.longest = records[0].sample_time, max(r.n_samples for r in records)
        self.span = self.longest * self.dt
        self.bin_width = 2.0 * np.pi / self.span
        count = 1 + int(np.log(max(0.1 * np.pi * self.longest / LONG.slowest, 1.0)) / np.log(LONG.ratio))
        self.rates = LONG.slowest / self.span * LONG.ratio ** np.arange(count)
        self.signals = 2 * sum(r.n_outputs for r in records)
        self.white = chi2.ppf(LONG.shares, self.signals)
        cells = sum(self._size(rate)[1] // 2 for rate in self.rates)
        self.enter = float(chi2.isf(min(20.0 * false_alarm, 0.5) / cells, self.signals))
        # A mode is two amplitudes a signal and its pole, chosen among all cells.
        self.limit = float(chi2.isf(false_alarm / cells, self.signals + 2))
        # Sums over so many samples are no more exact than this.
        self.floor = 1e-11 * np.sqrt(np.mean([(r.outputs**2).mean() for r in records]))
        # Candidates as they entered, of the modes and of what was rejected.
        self.origins = np.zeros(0, complex)
        self.rejected: list[tuple[complex, float]] = []
        self.weights = np.ones((len(records), records[0].n_outputs))
        self.fine = np.zeros(1)
        self.settle(np.zeros(0, complex), 0)

    def run(self, max_modes: int) -> None:
        """Take in peaks, and leave out what is no mode, until none is higher than noise makes it."""
        fruitless = 0
        for _ in range(LONG.most_rounds):
            before = self.poles.size
            # The first modes are worth the wait.
            ended = fruitless >= LONG.most_fruitless or (before > 0 and self.budget.spent(FURTHER))
            peaks = np.zeros(0) if ended else self.peaks()[: max(max_modes - before, 0)]
            if peaks.size:
                self.take_in(peaks)
                self.prune()
                fruitless = 0 if self.poles.size > before else fruitless + 1
            else:
                self.settle(self.poles, FIT.most_steps)
                if not self.prune(thoroughly=not self.budget.spent("check of each mode")):
                    break

    def take_in(self, peaks: np.ndarray) -> None:
        self.origins = np.append(self.origins, peaks)
        self.settle(np.append(self.poles, peaks), LONG.steps)

    def settle(self, poles: np.ndarray, most_steps: int) -> None:
        """All poles fitted together, outputs weighted by the residual before."""
        self.converged, self.steps = True, 0
        if poles.size:
            poles, fits, self.converged, self.steps = search(
                self.records, poles, self.weights, True, most_steps, hold=True, budget=self.budget
            )
        else:
            fits = [_nothing(record) for record in self.records]
        self.poles, self.fits = poles, fits
        self.noise = np.maximum(noise_level(self.records, fits, self.weights), self.floor)
        self.weights = 1.0 / self.noise

    def peaks(self) -> np.ndarray:
        """Candidates that stand out of the residual, strongest first."""
        self.fine = self._strengths(self.rates[0])
        found = [self._peaks(self.rates[0], self.fine)]
        found += [self._peaks(rate, self._strengths(rate)) for rate in self.rates[1:]]
        height, poles = np.concatenate([h for h, _ in found]), np.concatenate([p for _, p in found])
        taken, heights = np.zeros(0, complex), np.zeros(0)
        for r in np.argsort(-height):
            leaked = np.sqrt(heights * self._overlap(taken, poles[r])).sum() ** 2
            if height[r] > LONG.leaked * leaked and height[r] > self.enter * self._noise_ratio(poles[r]):
                taken, heights = np.append(taken, poles[r]), np.append(heights, height[r])
        return taken

    def prune(self, thoroughly: bool = False) -> bool:
        """Leave out what is no mode and, thoroughly, what its neighbours explain as well; whether any left."""
        if self.poles.size == 0:
            return False
        statistic = self.statistic()
        limit = self.limit * np.array([self._noise_ratio(pole) for pole in self.poles])
        out = spurious_modes(self.poles, self._shapes, statistic, self.bin_width) | (statistic < limit)
        if thoroughly:
            for r in map(int, np.flatnonzero(~out)):
                near = np.flatnonzero(self._overlap(self.poles, self.poles[r]) > LONG.overlaps)
                if near.size > 1 and self._statistic_beside(r, near) < limit[r]:
                    statistic[r] = self._gain(r, near)
                    out[r] = statistic[r] < limit[r]
        for r in map(int, np.flatnonzero(out)):
            # Of two that overlap the weaker goes first: the other may then stand.
            weaker = out & (statistic < statistic[r]) & (self._overlap(self.poles, self.poles[r]) > LONG.overlaps)
            out[r] = not weaker.any()
        if out.any():
            self.rejected += [(complex(pole), e) for pole, e in zip(self.origins[out], statistic[out], strict=True)]
            self.origins = self.origins[~out]
            self.settle(self.poles[~out], 2)
        return bool(out.any())

    @property
    def _shapes(self) -> np.ndarray:
        """Amplitudes over the noise, (n_signals, n_modes), of one record below the other."""
        return np.vstack([f.complex_amplitudes * w[:, None] for f, w in zip(self.fits, self.weights, strict=True)])

    def statistic(self) -> np.ndarray:
        """χ² of each mode's amplitudes, poles held, (n_modes,)."""
        return np.array([self._strength(r, np.zeros((self.weights.shape[1], 0))) for r in range(self.poles.size)])

    def _strength(self, r: int, without: np.ndarray) -> float:
        """χ² of the amplitudes of mode r, less what lies along some directions (n_outputs, n_directions)."""
        strength, both = 0.0, [r, self.poles.size + r]
        for fit, weights in zip(self.fits, self.weights, strict=True):
            a = fit.coefficients[both] * weights
            a = a - (a @ without) @ without.T
            strength += float((a * np.linalg.solve(fit.spread[np.ix_(both, both)], a)).sum())
        return strength

    def _statistic_beside(self, r: int, near: np.ndarray) -> float:
        """χ² of mode r in combinations of the outputs that see none of its neighbours."""
        shapes = np.hstack(np.split(self._shapes[:, near[near != r]], len(self.fits)))
        return self._strength(r, np.linalg.qr(np.hstack([shapes.real, shapes.imag]))[0])

    def report(self, statistic: np.ndarray) -> Identified:
        """The modes with their covariance, and the statistic (n_modes,) of each."""
        found = self.records, self.poles, self.fits, self.noise
        refined = as_refined(*found, converged=self.converged, steps=self.steps)
        refined = in_coloured_noise(refined, self.records, self.fits)
        statistic = statistic[np.argsort(np.abs(self.poles))]
        found_modes = identified(refined, statistic, self.limit, self.rejected, self.records[0])
        return replace(found_modes, remarks=self.budget.remarks)

    def _size(self, rate: float) -> tuple[int, int]:
        """Samples that one of this rate lasts, and the length of a transform that resolves its frequency."""
        n = min(self.longest, int(np.ceil(LONG.life / (rate * self.dt))))
        return n, next_fast_len(n if rate * n * self.dt > 0.5 * LONG.life else 2 * n, real=True)

    def _strengths(self, rate: float) -> np.ndarray:
        """χ² of one rate at every frequency of its transform, as if no mode were near."""
        lives, size = self._size(rate)
        found = np.zeros(size // 2 + 1, np.float32)
        for fit, weights in zip(self.fits, self.weights, strict=True):
            n = min(lives, len(fit.residual))
            energy = np.expm1(-2.0 * rate * self.dt * n) / np.expm1(-2.0 * rate * self.dt)
            scale = (np.sqrt(2.0 / energy) * weights).astype(np.float32)
            for first in range(0, weights.size, LONG.at_once):
                some = slice(first, first + LONG.at_once)
                # In single precision, and in place, as these fill the memory.
                left = np.zeros((scale[some].size, size), np.float32)
                decay = np.arange(n, dtype=np.float32)
                decay *= -rate * self.dt
                np.exp(decay, out=decay)
                left[:, :n] = fit.residual[:n, some].T
                left[:, :n] *= scale[some, None]
                left[:, :n] *= decay
                del decay
                spectrum = rfft(left, axis=1, workers=cores())
                del left
                forget_transforms(n)
                found += np.einsum("jk,jk->k", spectrum.real, spectrum.real)
                found += np.einsum("jk,jk->k", spectrum.imag, spectrum.imag)
        return found

    def _noise_ratio(self, pole: complex) -> float:
        """Noise about a pole over white noise, where it is larger, as the last search saw it; 1 if white."""
        step = np.pi / (self.fine.size * self.dt)
        at, half = round(pole.imag / step), max(int(abs(pole.real) / step), LONG.beside)
        beside = self.fine[max(at - half, 0) : at + half + 1]
        return max(1.0, float((np.quantile(beside, LONG.shares) / self.white).max()))

    def _peaks(self, rate: float, strengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Strengths and poles of one rate's local maxima that stand out of white noise."""
        step = 2.0 * np.pi / (self._size(rate)[1] * self.dt)
        omega = step * np.arange(strengths.size)
        lowest = max(rate / SELECTION.most_damped, 1.5 * self.bin_width)
        inside = (omega > lowest) & (omega < np.pi / self.dt - self.bin_width)
        highest = np.r_[False, (strengths[1:-1] > strengths[:-2]) & (strengths[1:-1] >= strengths[2:]), False]
        at = np.flatnonzero(inside & highest & (strengths > LONG.least_independent * self.enter))
        poles = -rate + 1j * omega[at]
        rejected = np.zeros(at.size, int)
        for pole, _ in self.rejected:
            rejected += np.abs(poles.imag - pole.imag) < 2.0 * max(self.bin_width, 0.5 * abs(pole.real))
        at, poles = at[rejected < LONG.most_rejections], poles[rejected < LONG.most_rejections]
        apart = self._independent(poles)
        full = strengths[at] / np.maximum(apart, LONG.least_independent)
        good = (apart > LONG.least_independent) & (full > self.enter)
        return full[good], poles[good]

    def _independent(self, poles: np.ndarray) -> np.ndarray:
        """Shares of candidates, sorted by frequency, that lie outside the modes so far."""
        apart = np.ones(poles.size)
        reach = 3.0 * (2.0 * self.bin_width + np.abs(self.poles.real))
        for first in range(0, poles.size, LONG.beside):
            some = slice(first, first + LONG.beside)
            w = poles[some]
            wide = reach + 3.0 * np.abs(w[0].real)
            near = self.poles[(self.poles.imag > w[0].imag - wide) & (self.poles.imag < w[-1].imag + wide)]
            if near.size:
                both = self._products(near, w)
                gram = self._products(near, near)
                factor = cho_factor(gram + LONG.ridge * np.diag(np.diag(gram)))
                shared = (both.conj() * cho_solve(factor, both)).sum(axis=0).real
                apart[some] = 1.0 - shared / np.diag(self._products(w[:1], w[:1])).real
        return apart

    def _products(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Σ_t (e^{a t})* e^{b t} over the longest record, (a.size, b.size)."""
        rate = (np.add.outer(a.conj(), b)) * self.dt
        small = np.abs(rate) < 1e-12
        return np.where(small, self.longest, np.expm1(rate * self.longest) / np.where(small, 1.0, np.expm1(rate)))

    def _overlap(self, poles: np.ndarray, pole: complex) -> np.ndarray:
        """Shares of energy in common; none is narrower than the resolution of the record."""
        a, b = np.abs(poles.real) + 1.0 / self.span, abs(pole.real) + 1.0 / self.span
        return np.asarray(4.0 * a * b / ((a + b) ** 2 + (poles.imag - pole.imag) ** 2))

    def _gain(self, r: int, near: np.ndarray) -> float:
        """χ² of mode r, the poles near it fitted anew without it.

        Along the shapes of these modes alone: no other combination of the outputs depends on them.
        """
        shapes = np.hstack(np.split(self._shapes[:, near], len(self.fits)))
        directions = np.linalg.qr(np.hstack([shapes.real, shapes.imag]))[0]
        seen, channels = [], self.records[0].output_channels[: directions.shape[1]]
        for record, fit, weights in zip(self.records, self.fits, self.weights, strict=True):
            left = (fit.residual * weights) @ directions
            a = directions.T @ (fit.complex_amplitudes[:, near] * weights[:, None])
            own = (a @ np.exp(np.outer(self.poles[near], self.dt * np.arange(record.n_samples)))).real
            seen.append(replace(record, outputs=left.T + own, output_channels=channels))
        alone = np.ones((len(seen), directions.shape[1]))
        _, with_it, *_ = search(seen, self.poles[near], alone, False, SELECTION.few_steps)
        _, without, *_ = search(seen, self.poles[near[near != r]], alone, False, SELECTION.few_steps)
        return float(sum((a.residual**2).sum() - (b.residual**2).sum() for a, b in zip(without, with_it, strict=True)))


def _nothing(record: Record) -> Projection:
    """A record of which nothing but its constants is explained."""
    level, none = record.outputs.mean(axis=1), np.zeros((0, 0))
    power = ((record.outputs - level[:, None]) ** 2).sum(axis=1)
    return Projection(record, np.zeros(0, complex), power, 0.0, level[None], none, none, none, none)
