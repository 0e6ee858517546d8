"""Which modes a long record of many sensors holds, at a cost that grows with its samples and no faster.

As `order` decides it, but many at a time. What the modes so far leave of the record, weighted by its noise, is compared
with decaying swings e^{λt} by fast transforms, each rate of decay with as many samples as it lives,

    χ²(λ) = 2 Σ_j |Σ_t e^{λ* t} r_j(t)|² / (s_j² Σ_t |e^{λt}|² (1 - o)),    o what the modes so far share of the swing,

and every peak enters that rises above the noise about it and above what stronger peaks leak to its place,

    |<e^{λt}, e^{κt}>|² / (‖e^{λt}‖² ‖e^{κt}‖²) = 4 σ_λ σ_κ / ((σ_λ + σ_κ)² + (ω_λ - ω_κ)²).

All poles are then fitted together, on the whole record, and those go out again that are no modes. What was hidden
beneath the strong ones shows in the next round; it ends when no peak is higher than noise makes it.
"""

import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.fft import next_fast_len, rfft
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2

from workbench.identification.free_decay.coloured_noise import in_its_noise
from workbench.identification.free_decay.identified import FALSE_ALARM, MOST_DAMPED, Identified, no_modes, unshaped
from workbench.identification.free_decay.refinement import MOST_STEPS, as_refined, noise_level, search
from workbench.identification.signal.projection import Projection
from workbench.records.record import Record
from workbench.structure.modes import frozen

# Rates of decay to look for: the slowest over the record, and how each follows from the one before.
SLOWEST, RATIO = 0.7, 4.0
# A swing is looked at while it lives, so many times as long as it takes to fall to 1/e.
LIFE = 8.0
AT_ONCE = 16  # outputs transformed together
# Cells on either side from which the noise about a peak is taken, by what half of them and nine in ten stay below: what
# is left about a mode that shifts as it decays is not smooth.
BESIDE, SHARES = 64, (0.5, 0.9)
LEAKED = 2.0  # a peak must be so many times what stronger ones may leak to its place
LEAST_APART, OVERLAPS, LIKE = 0.05, 0.5, 1e-10
STEPS, MOST_ROUNDS = 6, 60
# A peak refused so often where it stood is noise; once may be for poles that were not settled. Rounds that leave no
# more modes than before: where noise is not white, or modes shift as they decay, there may be no end of them.
MOST_REFUSALS, MOST_FRUITLESS = 2, 3


def identify_long(records: Sequence[Record], *, most_modes: int, false_alarm: float = FALSE_ALARM) -> Identified | None:
    """The modes of long records, as many as there are; None where none rises above the noise.

    Args:
        records: free decay in white noise, of the same sensors at one rate; each output may hold a constant.
        most_modes: where to stop at the latest.
        false_alarm: chance that noise alone is taken for a mode.
    """
    peeled, fruitless = _Peeled(records, false_alarm), 0
    for _ in range(MOST_ROUNDS):
        before = peeled.poles.size
        peaks = peeled.peaks()[: max(most_modes - before, 0)] if fruitless < MOST_FRUITLESS else np.zeros(0)
        if peaks.size:
            peeled.take_in(peaks)
            peeled.prune()
            fruitless = 0 if peeled.poles.size > before else fruitless + 1
        else:
            peeled.settle(peeled.poles, MOST_STEPS)
            if not peeled.prune(thoroughly=True):
                break
    return peeled.report() if peeled.poles.size else None


class _Peeled:
    """Poles so far, what they leave of the records, and what was refused."""

    def __init__(self, records: Sequence[Record], false_alarm: float) -> None:
        self.records = records
        self.dt, self.longest = records[0].sample_time, max(r.n_samples for r in records)
        self.span = self.longest * self.dt
        self.bin_width = 2.0 * np.pi / self.span
        count = 1 + int(np.log(max(0.1 * np.pi * self.longest / SLOWEST, 1.0)) / np.log(RATIO))
        self.rates = SLOWEST / self.span * RATIO ** np.arange(count)
        self.signals = 2 * sum(r.n_outputs for r in records)
        self.white = chi2.ppf(SHARES, self.signals)
        cells = sum(self._size(rate)[1] // 2 for rate in self.rates)
        self.enter = float(chi2.isf(min(20.0 * false_alarm, 0.5) / cells, self.signals))
        # A mode is two amplitudes a signal and its pole, chosen among all cells.
        self.limit = float(chi2.isf(false_alarm / cells, self.signals + 2))
        # Sums over so many samples are no more exact than this.
        self.floor = 1e-11 * np.sqrt(np.mean([(r.outputs**2).mean() for r in records]))
        # Swings as they stood out, of the modes and of what was refused.
        self.origins = np.zeros(0, complex)
        self.refused: list[tuple[complex, float]] = []
        self.weights = np.ones((len(records), records[0].n_outputs))
        self.fine = np.zeros(1)
        self.settle(np.zeros(0, complex), 0)

    def take_in(self, peaks: np.ndarray) -> None:
        self.origins = np.append(self.origins, peaks)
        self.settle(np.append(self.poles, peaks), STEPS)

    def settle(self, poles: np.ndarray, most_steps: int) -> None:
        """All poles fitted together, outputs weighted by what was left of them before."""
        self.converged, self.steps = True, 0
        if poles.size:
            poles, fits, self.converged, self.steps = search(
                self.records, poles, self.weights, True, most_steps, many=True
            )
        else:
            fits = [_nothing(record) for record in self.records]
        self.poles, self.fits = poles, fits
        self.noise = np.maximum(noise_level(self.records, fits, self.weights), self.floor)
        self.weights = 1.0 / self.noise

    def peaks(self) -> np.ndarray:
        """Poles of the swings that stand out of what is left, strongest first."""
        strengths = [self._strengths(rate) for rate in self.rates]
        self.fine = strengths[0]
        found = [self._peaks(rate, each) for rate, each in zip(self.rates, strengths, strict=True)]
        height, poles = np.concatenate([h for h, _ in found]), np.concatenate([p for _, p in found])
        taken, heights = np.zeros(0, complex), np.zeros(0)
        for r in np.argsort(-height):
            leaked = np.sqrt(heights * self._overlap(taken, poles[r])).sum() ** 2
            if height[r] > LEAKED * leaked and height[r] > self.enter * self._colour(poles[r]):
                taken, heights = np.append(taken, poles[r]), np.append(heights, height[r])
        return taken

    def prune(self, thoroughly: bool = False) -> bool:
        """Put out what is no mode, and, thoroughly, what its neighbours can stand for; whether any went."""
        if self.poles.size == 0:
            return False
        evidence = self.evidence()
        limit = self.limit * np.array([self._colour(pole) for pole in self.poles])
        out = no_modes(self.poles, self._shapes, evidence, self.bin_width) | (evidence < limit)
        if thoroughly:
            for r in map(int, np.flatnonzero(~out)):
                near = np.flatnonzero(self._overlap(self.poles, self.poles[r]) > OVERLAPS)
                if near.size > 1 and self._alone(r, near) < limit[r]:
                    evidence[r] = self._missed(r, near)
                    out[r] = evidence[r] < limit[r]
        for r in map(int, np.flatnonzero(out)):
            # Of two that overlap the weaker goes first: the other may then stand.
            rivals = out & (evidence < evidence[r]) & (self._overlap(self.poles, self.poles[r]) > OVERLAPS)
            out[r] = not rivals.any()
        if out.any():
            self.refused += [(complex(pole), e) for pole, e in zip(self.origins[out], evidence[out], strict=True)]
            self.origins = self.origins[~out]
            self.settle(self.poles[~out], 2)
        return bool(out.any())

    @property
    def _shapes(self) -> np.ndarray:
        """Amplitudes over the noise, (n_signals, n_modes), of one record below the other."""
        return np.vstack([f.complex_amplitudes * w[:, None] for f, w in zip(self.fits, self.weights, strict=True)])

    def evidence(self) -> np.ndarray:
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

    def _alone(self, r: int, near: np.ndarray) -> float:
        """χ² of mode r in what its neighbours cannot stand for: combinations of the outputs that see none of them."""
        shapes = np.hstack(np.split(self._shapes[:, near[near != r]], len(self.fits)))
        return self._strength(r, np.linalg.qr(np.hstack([shapes.real, shapes.imag]))[0])

    def report(self) -> Identified:
        found = self.records, self.poles, self.fits, self.noise
        refined = as_refined(*found, converged=self.converged, steps=self.steps)
        evidence = self.evidence()[np.argsort(np.abs(self.poles))]
        refused = sorted(self.refused, key=lambda pair: abs(pair[0]))
        noise = unshaped(np.array([pole for pole, _ in refused], complex), self.records[0])
        refined, tried = in_its_noise(refined, self.records), frozen([strength for _, strength in refused])
        return Identified(refined, frozen(evidence), self.limit, noise, tried)

    def _size(self, rate: float) -> tuple[int, int]:
        """Samples over which a swing lives, and the length of the transform that tells frequencies finely enough."""
        n = min(self.longest, int(np.ceil(LIFE / (rate * self.dt))))
        return n, next_fast_len(n if rate * n * self.dt > 0.5 * LIFE else 2 * n, real=True)

    def _strengths(self, rate: float) -> np.ndarray:
        """χ² of the swings of one rate at every frequency of its transform, as if no mode stood near."""
        lives, size = self._size(rate)
        found = np.zeros(size // 2 + 1, np.float32)
        for fit, weights in zip(self.fits, self.weights, strict=True):
            n = min(lives, len(fit.residual))
            decay = np.exp(-rate * self.dt * np.arange(n))
            scale = np.sqrt(2.0 / np.sum(decay**2)) * weights
            for first in range(0, weights.size, AT_ONCE):
                some = slice(first, first + AT_ONCE)
                left = (fit.residual[:n, some] * scale[some]).T.astype(np.float32) * decay.astype(np.float32)
                spectrum = rfft(left, size, axis=1, workers=os.cpu_count())
                found += (spectrum.real**2 + spectrum.imag**2).sum(axis=0)
        return found

    def _colour(self, pole: complex) -> float:
        """Noise about a swing over white noise, where it is larger, as the last search saw it; 1 if white."""
        step = np.pi / (self.fine.size * self.dt)
        at, half = round(pole.imag / step), max(int(abs(pole.real) / step), BESIDE)
        beside = self.fine[max(at - half, 0) : at + half + 1]
        return max(1.0, float((np.quantile(beside, SHARES) / self.white).max()))

    def _peaks(self, rate: float, strengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Strengths and poles of one rate's local maxima that stand out of white noise."""
        step = 2.0 * np.pi / (self._size(rate)[1] * self.dt)
        omega = step * np.arange(strengths.size)
        inside = (omega > max(rate / MOST_DAMPED, 1.5 * self.bin_width)) & (omega < np.pi / self.dt - self.bin_width)
        highest = np.r_[False, (strengths[1:-1] > strengths[:-2]) & (strengths[1:-1] >= strengths[2:]), False]
        at = np.flatnonzero(inside & highest & (strengths > LEAST_APART * self.enter))
        poles = -rate + 1j * omega[at]
        refused = np.zeros(at.size, int)
        for pole, _ in self.refused:
            refused += np.abs(poles.imag - pole.imag) < 2.0 * max(self.bin_width, 0.5 * abs(pole.real))
        at, poles = at[refused < MOST_REFUSALS], poles[refused < MOST_REFUSALS]
        apart = self._apart(poles)
        full = strengths[at] / np.maximum(apart, LEAST_APART)
        good = (apart > LEAST_APART) & (full > self.enter)
        return full[good], poles[good]

    def _apart(self, swings: np.ndarray) -> np.ndarray:
        """Shares of swings, sorted by frequency, that lie outside the modes there already."""
        apart = np.ones(swings.size)
        reach = 3.0 * (2.0 * self.bin_width + np.abs(self.poles.real))
        for first in range(0, swings.size, BESIDE):
            some = slice(first, first + BESIDE)
            w = swings[some]
            wide = reach + 3.0 * np.abs(w[0].real)
            near = self.poles[(self.poles.imag > w[0].imag - wide) & (self.poles.imag < w[-1].imag + wide)]
            if near.size:
                both = self._products(near, w)
                gram = self._products(near, near)
                factor = cho_factor(gram + LIKE * np.diag(np.diag(gram)))
                shared = (both.conj() * cho_solve(factor, both)).sum(axis=0).real
                apart[some] = 1.0 - shared / np.diag(self._products(w[:1], w[:1])).real
        return apart

    def _products(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Σ_t (e^{a t})* e^{b t} over the longest record, (a.size, b.size)."""
        rate = (np.add.outer(a.conj(), b)) * self.dt
        small = np.abs(rate) < 1e-12
        return np.where(small, self.longest, np.expm1(rate * self.longest) / np.where(small, 1.0, np.expm1(rate)))

    def _overlap(self, poles: np.ndarray, pole: complex) -> np.ndarray:
        """Of the energies of swings, what they share; none is narrower than the record can tell."""
        a, b = np.abs(poles.real) + 1.0 / self.span, abs(pole.real) + 1.0 / self.span
        return 4.0 * a * b / ((a + b) ** 2 + (poles.imag - pole.imag) ** 2)

    def _missed(self, r: int, near: np.ndarray) -> float:
        """χ² by which the record is less likely without mode r, the poles near it fitted anew.

        Seen along the shapes of these modes alone: no other combination of the outputs tells of them.
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
        _, with_it, *_ = search(seen, self.poles[near], alone, False, 12)
        _, without, *_ = search(seen, self.poles[near[near != r]], alone, False, 12)
        return float(sum((a.residual**2).sum() - (b.residual**2).sum() for a, b in zip(without, with_it, strict=True)))


def _nothing(record: Record) -> Projection:
    """A record of which nothing but its constants is explained."""
    level, none = record.outputs.mean(axis=1), np.zeros((0, 0))
    power = ((record.outputs - level[:, None]) ** 2).sum(axis=1)
    return Projection(record, np.zeros(0, complex), power, 0.0, level[None], none, none, none, none)
