"""Which modes a record holds, decided by likelihood.

Modes are taken in one at a time. What the modes so far leave of the record, r_j for output j, is compared with every
decaying swing e^{λt} on a grid of λ:

    χ²(λ) = Σ_j |Q^T r_j|² / s_j²,     Q an orthonormal basis of (I - Φ Φ^+) [Re e^{λt}, Im e^{λt}],

which is chi-square with two degrees of freedom an output where only white noise s_j is left. The strongest swing
enters, all poles are fitted anew, and it stays if the ratio of the likelihoods with and without it is larger than
noise makes it in one record of a thousand. What is tried and falls below is named as noise. It ends when the strongest
swing left is no stronger than the strongest of so many in noise.
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import NoReturn

import numpy as np
from scipy.stats import chi2

from workbench.identification.free_decay.backbone import left_by_backbone
from workbench.identification.free_decay.coloured_noise import in_its_noise, whitened
from workbench.identification.free_decay.ibrahim import check_alike
from workbench.identification.free_decay.identified import FALSE_ALARM, MOST_DAMPED, Identified, no_modes, unshaped
from workbench.identification.free_decay.long_records import identify_long
from workbench.identification.free_decay.refinement import MOST_STEPS, refine, search
from workbench.identification.signal.data_quality import check_fit
from workbench.identification.signal.noise_levels import differ, variances
from workbench.identification.signal.projection import project
from workbench.records.record import Record
from workbench.structure.modes import frozen
from workbench.threads import one_blas_thread

# Values in all from which modes are taken in many at a time.
LONG = 100_000
MOST_MODES = 40
# Noise that is not white is learnt from what the modes leave, and they from it in turn.
WHITENED, MOST_GROWTH = 2, 0.5
# Tries that fall below the limit in a row before the record counts as told.
MOST_REFUSALS = 2
# A record whose noise is not white, or whose modes shift as they decay, may take modes in and put them out for ever.
MOST_ROUNDS = 4
MOST_SPLITS = 6
# A swing whose part outside the modes there already is smaller than this share cannot be told from them.
LEAST_APART = 1e-7
# Widths that a mode told behind filters may move when read without.
GONE = 5.0
# Squares of what is left, over those of the record, that are round-off.
ROUND_OFF = 1e-26
# Bins on either side from which the colour of the noise is taken.
BESIDE = 50


@one_blas_thread
def identify(
    records: Record | Sequence[Record],
    *,
    most_modes: int | None = None,
    false_alarm: float = FALSE_ALARM,
) -> Identified:
    """The modes that a free decay holds, as many as there are, each with its standard error.

    Records of more than 100,000 values in all are told many modes at a time, as in `long_records`.

    Args:
        records: free decay in noise, of the same sensors at one rate; each output may hold a constant.
        most_modes: where to stop at the latest; 40 unless given, and 400 in long records.
        false_alarm: chance that noise alone is taken for a mode.

    Raises:
        ValueError: no mode rises above the noise; a sensor ails (`check_fit`); records that differ in sensors or rate;
            too few samples.
    """
    records = [records] if isinstance(records, Record) else list(records)
    check_alike(records)
    for record in records:
        check_fit(record)
    fit_in = (min(r.n_samples for r in records) - 4) // 3
    if sum(r.outputs.size for r in records) > LONG:
        found = identify_long(records, most_modes=min(most_modes or 10 * MOST_MODES, fit_in), false_alarm=false_alarm)
        return found if found is not None else _refuse(records)
    most_modes = min(most_modes or MOST_MODES, fit_in)
    told = _told(records, most_modes, false_alarm)
    for _ in range(WHITENED):
        white = whitened(records, told.ringing)
        if white is None:
            break
        told = _told(white, most_modes, false_alarm, records)
    return told.report(records) if told.poles.size else _refuse(records)


def _told(
    records: Sequence[Record], most_modes: int, false_alarm: float, measured: Sequence[Record] | None = None
) -> "Told":
    longest = max(record.n_samples for record in records)
    told = Told(records, [_Grid(record, longest) for record in records], false_alarm, measured or records)
    for _ in range(MOST_ROUNDS):
        if not (told.grow(most_modes) and told.prune()):
            break
    return told


def _refuse(records: Sequence[Record]) -> NoReturn:
    raise ValueError(
        f"record {records[0].name!r} holds no mode that rises above its noise: is it a free decay? Cut it to the"
        " decay, measure longer or strike harder"
    )


class Told:
    """The search: poles so far, their fits, and what was refused, each record with the grid of swings to look for."""

    def __init__(
        self, records: Sequence[Record], grids: Sequence, false_alarm: float, measured: Sequence[Record]
    ) -> None:
        self.records, self.grids, self.measured = records, grids, measured
        self.offset = grids[0].offset
        # What is left may be no louder than round-off, which says nothing of one sensor beside another.
        self.round_off = ROUND_OFF * np.array([(record.outputs**2).sum(axis=1) for record in records]) + 1e-300
        cells = grids[0].n_cells
        signals = 2 * sum(r.n_outputs for r in records)
        self.enter = float(chi2.isf(min(20.0 * false_alarm, 0.5) / cells, signals))
        # A mode is two amplitudes a signal and its pole, chosen among all cells of the grid.
        self.limit = float(chi2.isf(false_alarm / cells, signals + 2))
        self.poles = np.zeros(0, complex)
        self.refused: list[tuple[complex, float]] = []
        self.told_two: dict[bytes, bool] = {}
        self.weights, self.fits = self._settled(self.poles)[1:]

    @property
    def ringing(self) -> np.ndarray:
        """The poles that swing within a record and hardly grow; what else came in may be noise that is not white."""
        span = max(record.n_samples * record.sample_time for record in self.records)
        return self.poles[(self.poles.real * span < MOST_GROWTH) & (np.abs(self.poles) * span > 2.0 * np.pi)]

    def grow(self, most_modes: int) -> bool:
        """Take in modes until what is left is noise; whether any came in."""
        grown, refusals, splits = False, 0, 0
        while not self._exact() and self.poles.size < most_modes and refusals < MOST_REFUSALS and splits < MOST_SPLITS:
            swing, strength = self._strongest_swing()
            flagged = self._no_modes(self.poles).sum()
            if strength < self.enter * self._colour(swing):
                break
            try:
                found = self._settled(np.append(self.poles, swing), most_steps=12)
                gain = self._ratio(self.fits, found[2])
            except np.linalg.LinAlgError:
                gain = 0.0
            if gain < self.limit * self._colour(swing):
                refusals += 1
                self.refuse(swing, gain)
                continue
            # One flagged before, on its way or to be put out, is not the new one's fault.
            if self._no_modes(found[0]).sum() > flagged:
                splits += 1
                self.refuse(swing, gain)
                continue
            (self.poles, self.weights, self.fits), grown, refusals = found, True, 0
        return grown

    def refuse(self, pole: complex, evidence: float) -> None:
        self.refused.append((complex(pole), evidence))

    def prune(self) -> bool:
        """Settle, and put out what is no mode; whether any went."""
        self.poles, self.weights, self.fits = self._settled(self.poles)
        pruned = False
        while self.poles.size:
            trials = [(self._ratio(found[2], self.fits), r, found, no_mode) for r, found, no_mode in self._suspects()]
            weak = [t[:3] for t in trials if t[3] or t[0] < self.limit * self._colour(self.poles[t[1]])]
            if not weak:
                return pruned
            gain, r, found = min(weak, key=lambda t: t[0])
            self.refuse(self.poles[r], gain)
            self.poles, self.weights, self.fits = found
            pruned = True
        return pruned

    def _no_modes(self, poles: np.ndarray) -> np.ndarray:
        """Which poles are damped beyond what rings, or split another mode that has their shape and their band."""
        fits = [project(record, poles, self.offset) for record in self.records]
        shapes = np.vstack([f.complex_amplitudes * w[:, None] for f, w in zip(fits, self.weights, strict=True)])

        def two(r: int, s: int) -> bool:
            return self._two(poles, r, s)

        return no_modes(poles, shapes, np.linalg.norm(shapes, axis=0), self.grids[0].bin_width, two)

    def _two(self, poles: np.ndarray, r: int, s: int) -> bool:
        """Whether one sensor that sees modes r and s beat is likelier to see both than one that shifts as it decays."""
        asked = np.round(np.r_[poles[r], poles[s], np.delete(poles, [r, s])] / self.grids[0].bin_width, 1).tobytes()
        if asked not in self.told_two:
            self.told_two[asked] = False
            with suppress(np.linalg.LinAlgError):
                self.told_two[asked] = self._worth_of_two(poles, r, s) > self.limit * self._colour(poles[r])
        return self.told_two[asked]

    def _worth_of_two(self, poles: np.ndarray, r: int, s: int) -> float:
        """Twice the log likelihood ratio of both modes over one on a backbone.

        In the record as measured: a filter that makes white what one mode leaves takes most of what speaks for it.
        """
        [record] = self.measured
        poles, [fit], *_ = search([record], poles, np.ones((1, 1)), self.offset, most_steps=12)
        both, pair, others = float(fit.squares.sum()), poles[[r, s]], np.delete(poles, [r, s])
        one = left_by_backbone(record, pair, others, offset=self.offset, enough=both)
        floor = ROUND_OFF * float((record.outputs**2).sum()) + 1e-300
        return record.n_samples * float(np.log((one + floor) / (both + floor)))

    def report(self, records: Sequence[Record]) -> Identified:
        # Filters cost the first samples, the strongest: modes are counted behind them, and read without.
        refined = refine(records, unshaped(self.poles, records[0]), offset=True)
        while (gone := self._gone(refined.modes.poles)).any() and not gone.all():
            self.poles = self.poles[~gone]
            refined = refine(records, unshaped(self.poles, records[0]), offset=True)
        refined = in_its_noise(refined, records)
        evidence = self._evidence()[np.argsort(np.abs(self.poles))]
        refused = sorted(self.refused, key=lambda pair: abs(pair[0]))
        noise = np.array([pole for pole, _ in refused], complex)
        noise_modes = unshaped(noise, records[0])
        return Identified(
            refined, frozen(evidence), self.limit, noise_modes, frozen([evidence for _, evidence in refused])
        )

    def _gone(self, refined: np.ndarray) -> np.ndarray:
        """Which modes are no more where they were told: what else is in a record than modes has drawn them off."""
        away = np.abs(np.subtract.outer(self.poles, refined)).min(axis=1)
        return away > GONE * (np.abs(self.poles.real) + self.grids[0].bin_width)

    def _settled(self, poles: np.ndarray, most_steps: int = MOST_STEPS):
        """Poles, weights and fits after a search, sensors weighted by the noise found in each record."""
        weights = getattr(self, "weights", np.ones((len(self.records), self.records[0].n_outputs)))
        if poles.size == 0:
            fits = [grid.nothing for grid in self.grids]
            return poles, 1.0 / self._spread(fits), fits
        poles, fits, *_ = search(self.records, poles, weights, self.offset, most_steps)
        return poles, 1.0 / self._spread([fit.residual for fit in fits]), [fit.residual for fit in fits]

    def _without(self, r: int):
        return self._settled(np.delete(self.poles, r), most_steps=12)

    def _evidence(self) -> np.ndarray:
        """χ² of each mode's amplitudes, poles held, (n_modes,)."""
        fits = [project(record, self.poles, self.offset) for record in self.records]
        n, strength = self.poles.size, np.zeros(self.poles.size)
        for fit, weights in zip(fits, self.weights, strict=True):
            for r in range(n):
                both = [r, n + r]
                a = fit.coefficients[both] * weights
                strength[r] += float(np.sum(a * np.linalg.solve(fit.spread[np.ix_(both, both)], a)))
        return strength

    def _suspects(self):
        """The weakest that is no mode, or else the modes whose amplitudes stand out little or that stand close to
        another; each with what the search finds without it, and whether it is no mode."""
        evidence, no_modes = self._evidence(), self._no_modes(self.poles)
        if no_modes.any():
            r = int(np.argmin(np.where(no_modes, evidence, np.inf)))
            yield r, self._without(r), True
            return
        for r, strength in enumerate(evidence):
            near = np.abs(np.delete(self.poles, r) - self.poles[r]).min(initial=np.inf)
            if strength < 4.0 * self.limit * self._colour(self.poles[r]) or near < 2.0 * abs(self.poles[r].real):
                yield r, self._without(r), False

    def _colour(self, pole: complex) -> float:
        """Noise about a frequency over its mean, where it is larger: median of the spectrum left over, 1 if white."""
        grid = self.grids[0]
        left = grid.power(self.fits[0] * self.weights[0]).mean(axis=1)
        at = round((pole.imag - grid.lowest) / grid.bin_width)
        beside = left[max(at - BESIDE, 0) : at + BESIDE + 1]
        return max(1.0, float(np.median(beside)) / float(left.mean())) if beside.size else 1.0

    def _exact(self) -> bool:
        """Whether what is left is round-off, of which every try would make something else."""
        return bool((_squares(self.fits) <= self.round_off).all())

    def _spread(self, residuals: Sequence[np.ndarray]) -> np.ndarray:
        """Of what is left of each output in each record, (n_records, n_outputs)."""
        n = np.array([r.shape[0] for r in residuals])
        return np.sqrt(variances(np.maximum(_squares(residuals), self.round_off), n))

    def _ratio(self, before, after) -> float:
        """Twice the log likelihood ratio, noise unknown: Σ_ij N_i log(s²_before / s²_after), records i, sensors j."""
        n = np.array([residual.shape[0] for residual in after])
        first, second = (_squares(fits) + self.round_off for fits in (before, after))
        apart = differ(second, n)
        return float((n @ np.log(variances(first, n, apart) / variances(second, n, apart))).sum())

    def _strongest_swing(self) -> tuple[complex, float]:
        """The strongest swing left that was not refused before, and its χ²."""
        each = zip(self.grids, self.fits, self.weights, strict=True)
        strengths = np.sum([grid.strengths(left, weights, self.poles) for grid, left, weights in each], axis=0)
        grid = self.grids[0]
        for pole, _ in self.refused:
            strengths[:, grid.near(pole, 2.0)] = 0.0
        best = np.unravel_index(int(np.argmax(strengths)), strengths.shape)
        return complex(grid.poles[best]), float(strengths[best])


class _Grid:
    """Swings e^{λt} to compare a residual with: rates of decay by frequencies, (n_rates, n_frequencies)."""

    offset = True

    def __init__(self, record: Record, n: int) -> None:
        self.record, dt = record, record.sample_time
        self.nothing = (record.outputs - record.outputs.mean(axis=1, keepdims=True)).T
        self.size = 1 << int(np.ceil(np.log2(2 * n)))
        omega = 2.0 * np.pi * np.fft.rfftfreq(self.size, dt)
        span = n * dt
        self.bin_width = self.lowest = 2.0 * np.pi / span
        fastest = 0.1 * np.pi / dt
        rates = np.r_[0.0, np.geomspace(1.0 / span, max(fastest, 2.0 / span), max(int(np.log(fastest * span)) + 1, 2))]
        inside = (omega > np.pi / span) & (omega < np.pi / dt - np.pi / span)
        self.columns = np.flatnonzero(inside)
        self.rates = rates
        self.poles = -rates[:, None] + 1j * omega[inside]
        self.allowed = rates[:, None] < MOST_DAMPED * omega[inside]
        self.n_cells = int(self.allowed.sum())

    def power(self, residual: np.ndarray) -> np.ndarray:
        """Of what is left at each frequency, (n_frequencies, n_outputs)."""
        return np.abs(np.fft.rfft(residual, axis=0)[1:]) ** 2

    def near(self, pole: complex, bins: float) -> np.ndarray:
        """Frequencies within so many bins, or half as many rates of decay, of a pole's."""
        return np.abs(self.poles[0].imag - pole.imag) < bins * max(self.bin_width, 0.5 * abs(pole.real))

    def strengths(self, residual: np.ndarray, weights: np.ndarray, poles: np.ndarray) -> np.ndarray:
        """χ² of each swing, (n_rates, n_frequencies); 0 where it cannot be told from the modes there already."""
        dt, n = self.record.sample_time, residual.shape[0]
        weighted = residual * weights
        found = np.zeros(self.poles.shape)
        near = self._beside(poles)
        for k, rate in enumerate(self.rates):
            decay = np.exp(-rate * dt * np.arange(n))
            spectrum = np.fft.rfft(weighted * decay[:, None], self.size, axis=0)[self.columns]
            own = (np.abs(spectrum) ** 2).sum(axis=1)
            double = (spectrum.conj() ** 2).sum(axis=1)
            w = np.exp(self.poles[k] * dt)
            p = np.full(w.shape, np.sum(decay**2))
            q = _geometric(np.ones(1), w.conj() ** 2, n)[0]
            whole = p.copy()
            at = near[k]
            if at.any():
                dp, dq = self._shared(np.exp(poles * dt), w[at], n)
                p[at] -= dp
                q[at] -= dq
            det = p**2 - np.abs(q) ** 2
            good = self.allowed[k] & (det > LEAST_APART * whole**2) & (p > 0)
            top = 2.0 * p * own - 2.0 * (q * double.conj()).real
            found[k] = np.where(good, top / np.where(good, det, 1.0), 0.0)
        return found

    def _beside(self, poles: np.ndarray) -> np.ndarray:
        """Which swings overlap with a mode there already."""
        near = np.zeros(self.poles.shape, bool)
        for pole in poles:
            near |= np.abs(self.poles.imag - pole.imag) < 3.0 * (
                2.0 * self.bin_width + abs(pole.real) + self.rates[:, None]
            )
        return near

    @staticmethod
    def _shared(z: np.ndarray, w: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """What of the Gram matrix [[p, q], [q*, p]] of (w^t, w*^t) lies in the span of the modes z."""
        basis = np.r_[z, z.conj()].conj()
        gram = _geometric(basis, basis.conj(), n)
        first, second = _geometric(basis, w, n), _geometric(basis, w.conj(), n)
        solved = np.linalg.solve(gram, np.hstack([first, second]))
        a, b = np.split(solved, 2, axis=1)
        return (first.conj() * a).sum(axis=0).real, (first.conj() * b).sum(axis=0)


def _geometric(a: np.ndarray, b: np.ndarray, n: int) -> np.ndarray:
    """Σ_{t<n} (a_i b_k)^t, (a.size, b.size)."""
    gap = 1.0 - np.outer(a, b)
    small = np.abs(gap) < 1e-12
    return np.where(small, n, (1.0 - np.outer(a**n, b**n)) / np.where(small, 1.0, gap))


def _squares(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Sums of those of each output in each record, (n_records, n_outputs)."""
    return np.array([(left**2).sum(axis=0) for left in residuals])
