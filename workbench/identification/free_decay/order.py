"""Which modes a free decay holds, by stepwise selection.

What the modes so far leave of the record, r_j for output j, is compared with damped exponentials e^{λt} on a grid of λ:

    χ²(λ) = Σ_j |Q^T r_j|² / s_j²,     Q an orthonormal basis of (I - Φ Φ^+) [Re e^{λt}, Im e^{λt}],

which is chi-square with two degrees of freedom an output where only white noise s_j is left. The strongest enters, and
`signal/searches` decides whether it stays. What is tried and rejected is reported as noise. The search ends when
the strongest candidate is no stronger than the strongest of so many in noise.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
from scipy.fft import rfft
from scipy.stats import chi2

from workbench.arrays import Complexes, Floats
from workbench.identification.free_decay.assumptions import amplitude_dependence
from workbench.identification.free_decay.backbone import are_two, band_about
from workbench.identification.free_decay.long_records import identify_long
from workbench.identification.free_decay.preparation import decay_start
from workbench.identification.free_decay.refinement import identified, in_coloured_noise, refine, search, unshaped
from workbench.identification.signal.data_quality import check_data_quality, of_same_sensors, steps
from workbench.identification.signal.modal_estimates import Identified
from workbench.identification.signal.projection import Projection, differ, project, variances, whitened
from workbench.identification.signal.searches import (
    FALSE_ALARM,
    FIT,
    SECONDS,
    SELECTION,
    STOPPED,
    Budget,
    Progress,
    Stepwise,
    check_count,
    overdamped,
    spurious_modes,
)
from workbench.records.record import Record
from workbench.renamed import former_arguments
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class OrderSettings:
    """Constants of the selection of modes of a free decay, beside those of every selection (`searches.SELECTION`)."""

    long: int = 100_000  # values in all from which modes are taken in many at a time
    max_modes: int = 40  # unless the call says more: fits of more at once take minutes
    whitened: int = 2  # times that coloured noise is learnt from the residual, and the modes from it in turn
    # of the energy that is left, up to which modes no more selected in whitened records leave it if they stay, and are
    # modes: those that were fitted to coloured noise take a part of it
    whitened_away: float = 0.1
    # candidates below the limit one after the other, and candidates that split a mode, after which the search ends
    most_weak: int = 2
    most_splits: int = 6
    # times the frequency step of the transform, by which rates of decay go on that need no step finer than a quarter
    # of theirs: what they leave after the shorter transform is e^-25
    coarser: float = 4.0
    decided: float = 0.1  # χ² that a step promises, below which a fit that only decides has decided
    least_independent: float = 1e-7  # share of a candidate outside the modes so far, to be distinguished from them
    resolved: float = 1e-13  # share of the largest eigenvalue of a Gram matrix, below which a direction is round-off
    # bandwidths that a mode selected in whitened records may move when refined in the records as measured
    lost: float = 5.0
    most_left: float = 0.5  # share of a record beside modes that explain it
    same: float = 0.05  # bandwidths that poles may move before it is asked anew whether they are two


ORDER = OrderSettings()
# Poles of two modes and of those beside them, and whether the two are two; of records as measured.
Verdicts = list[tuple[Complexes, bool]]
DECIDES: Mapping[str, Any] = {"most_steps": SELECTION.few_steps, "enough": ORDER.decided}
FULLY: Mapping[str, Any] = {}


@former_arguments(most_modes="max_modes")
@one_blas_thread
def identify(
    records: Record | Sequence[Record],
    *,
    max_modes: int | None = None,
    false_alarm: float = FALSE_ALARM,
    seconds: float | None = SECONDS,
    progress: Progress | None = None,
) -> Identified:
    """The modes of a free decay, their number selected, each with its standard error.

    Records of more than 100,000 values in all are searched many modes at a time, as in `long_records`.

    Args:
        records: free decay in noise, of the same sensors at one rate; each output may hold a constant.
        max_modes: where to stop at the latest; 40 unless given, and 400 in long records.
        false_alarm: chance that noise alone is taken for a mode; 0.001 unless given.
        seconds: of processor time, 30 unless given, after which the best so far is returned, with a remark; None for no
            limit.
        progress: called with the search under way and the share of the time that is spent.

    Raises:
        ValueError: no mode rises above the noise; a faulty channel (`check_data_quality`); records that differ in
            sensors or rate; too few samples.
    """
    check_count("max_modes", max_modes)
    records = of_same_sensors(records)
    budget = Budget(seconds, progress)
    found = identify_within(records, budget, max_modes=max_modes, false_alarm=false_alarm)
    found = found.without_artefacts(np.pi / records[0].sample_time)
    begun = tuple(remark for record in records for remark in _begins_later(record))
    by_amplitude = amplitude_dependence(records, found.refined, budget=budget)
    said = tuple(remark for remark in found.remarks if not remark.startswith(STOPPED))
    return replace(found, remarks=(*begun, *said, *budget.remarks, *by_amplitude.remarks))


def _begins_later(record: Record) -> tuple[str, ...]:
    """A remark where samples before the free decay were taken for part of it."""
    start = decay_start(record)
    if start == record.start_time:
        return ()
    return (
        f"record {record.name!r} is free decay from {start:.6g} s on only: what comes before would be read as modes;"
        f" cut it, `record.between({start:.6g})`, or give it to `ring_down`",
    )


def identify_within(
    records: Sequence[Record], budget: Budget, *, max_modes: int | None = None, false_alarm: float = FALSE_ALARM
) -> Identified:
    """`identify`, on a budget that others share, artefacts included."""
    for record in records:
        check_data_quality(record)
    shortest = min(records, key=lambda record: record.n_samples)
    fit_in = (shortest.n_samples - 4) // 3
    if fit_in < 1:
        raise ValueError(f"record {shortest.name!r} has {shortest.n_samples} samples; a mode needs 7: measure longer")
    if sum(r.outputs.size for r in records) > ORDER.long:
        most = min(max_modes or 10 * ORDER.max_modes, fit_in)
        found = identify_long(records, max_modes=most, false_alarm=false_alarm, budget=budget)
        return found if found is not None else _refuse(records)
    most = min(max_modes or ORDER.max_modes, fit_in)
    search_time = budget.share(SELECTION.search_share)
    verdicts: Verdicts = []
    problem, model = _selected(records, most, false_alarm, search_time, records, verdicts)
    explained = problem.explains(model)
    for _ in range(ORDER.whitened):
        # While modes are left the residual is no noise.
        if search_time.unfinished or search_time.spent("whitening of the noise"):
            break
        white = whitened(records, problem.oscillating(model))
        if white is None:
            break
        again, fewer = _selected(white, most, false_alarm, search_time, records, verdicts)
        # What a mode that depends on amplitude or time leaves is no noise either, and whitens modes away.
        if not fewer.poles.size and explained:
            break
        all_modes = np.append(fewer.poles, model.poles[again.lost(model.poles, fewer.poles)])
        if explained and _left(records, all_modes) < ORDER.whitened_away * _left(records, fewer.poles):
            fewer = again.fitted(all_modes, fewer.weights)
        problem, model = again, fewer
    problem.budget = budget
    return problem.report(model, records) if model.poles.size else _refuse(records)


def _selected(
    records: Sequence[Record],
    max_modes: int,
    false_alarm: float,
    budget: Budget,
    measured: Sequence[Record],
    verdicts: "Verdicts",
) -> tuple["_FreeDecay", "_Model"]:
    problem = _FreeDecay(records, false_alarm, measured, budget, verdicts)
    selection = Stepwise(problem, max_modes, ORDER.most_weak, ORDER.most_splits, False, budget, alone=True)
    model = selection.select(problem.nothing)
    problem.rejected = selection.rejected
    return problem, model


def _refuse(records: Sequence[Record]) -> NoReturn:
    raise ValueError(
        f"record {records[0].name!r} holds no mode that rises above its noise: is it a free decay? Cut it to the"
        " decay, measure longer or excite harder"
    )


@dataclass(frozen=True, eq=False)
class _Model:
    """Modes so far.

    Attributes:
        poles: (n_modes,) rad/s.
        weights: (n_records, n_outputs) 1 / noise.
        fits: projections of the records on these.
    """

    poles: np.ndarray
    weights: np.ndarray
    fits: list[Projection]

    @property
    def residuals(self) -> list[Floats]:
        """One (n_samples, n_outputs) a record."""
        return [fit.residual for fit in self.fits]

    @cached_property
    def left(self) -> Floats:
        """Mean power of what is left of the outputs of the first record, in units of their noise, at its lines."""
        lines = rfft(self.residuals[0] * self.weights[0], axis=0)[1:]
        power: Floats = (lines.real**2 + lines.imag**2).mean(axis=1)
        return power


class _FreeDecay:
    """The `searches.Selection` of free decays."""

    def __init__(
        self,
        records: Sequence[Record],
        false_alarm: float,
        measured: Sequence[Record],
        budget: Budget,
        verdicts: "Verdicts | None" = None,
    ) -> None:
        longest = max(record.n_samples for record in records)
        self.records, self.measured, self.budget = records, measured, budget
        self.grids = [_Grid(record, longest) for record in records]
        # Residuals of round-off say nothing of one sensor beside another.
        self.round_off = FIT.round_off * np.array([(record.outputs**2).sum(axis=1) for record in records]) + 1e-300
        self.round_off = np.maximum(self.round_off, [m.n_samples * steps(m) ** 2 / 12.0 for m in measured])
        cells = self.grids[0].n_cells
        signals = 2 * sum(r.n_outputs for r in records)
        self.enter = float(chi2.isf(min(20.0 * false_alarm, 0.5) / cells, signals))
        # A mode is two amplitudes a signal and its pole, chosen among all cells of the grid.
        self.limit = float(chi2.isf(false_alarm / cells, signals + 2))
        # Of several records, where two are asked about they are not chosen any more.
        self.two = self.limit if len(records) == 1 else float(chi2.isf(false_alarm, signals + 2))
        self.verdicts = [] if verdicts is None else verdicts
        self.halves: list[tuple[complex, float]] = []
        self.rejected: list[tuple[complex, float]] = []
        self.nothing = self.fitted(np.zeros(0, complex), np.ones((len(records), records[0].n_outputs)))

    def n_modes(self, model: _Model) -> int:
        return model.poles.size

    def strongest(self, model: _Model, rejected: list[tuple[complex, float]]) -> complex | None:
        # of round-off every candidate would make something else
        if (_squares(model.residuals) <= self.round_off).all():
            return None
        each = zip(self.grids, model.residuals, model.weights, strict=True)
        strengths = np.sum([grid.strengths(left, weights, model.poles) for grid, left, weights in each], axis=0)
        grid = self.grids[0]
        for pole, _ in rejected:
            strengths[:, grid.near(pole, 2.0)] = 0.0
        elsewhere = np.where(self._tried(model, rejected), 0.0, strengths)
        found = self._risen(model, elsewhere)
        return self._risen(model, strengths) if found is None else found

    def _risen(self, model: _Model, strengths: np.ndarray) -> complex | None:
        """The strongest, if it rises above the noise."""
        grid, best = self.grids[0], np.unravel_index(int(np.argmax(strengths)), strengths.shape)
        pole = complex(-grid.rates[best[0]], grid.omega[best[1]])
        return None if strengths[best] < self.enter * self._noise_ratio(model, pole) else pole

    def _tried(self, model: _Model, rejected: list[tuple[complex, float]]) -> np.ndarray:
        """Which candidates overlap with a mode that a rejected one overlaps with too, (n_rates, n_frequencies): what
        splits a mode from one side does so from the other, and waits until no other mode is left."""
        grid = self.grids[0]
        tried = np.zeros((grid.rates.size, grid.omega.size), bool)
        for mode in model.poles:
            band = abs(mode.real) + grid.bin_width
            if any(abs(pole.imag - mode.imag) < band + abs(pole.real) for pole, _ in rejected):
                tried |= np.abs(grid.omega - mode.imag) < band + grid.rates[:, None]
        return tried

    def pole_of(self, candidate: complex) -> complex:
        return candidate

    def extended(self, model: _Model, candidate: complex) -> _Model:
        return self.fitted(np.append(model.poles, candidate), model.weights, DECIDES)

    def gain(self, smaller: _Model, larger: _Model) -> float:
        """Noise unknown: Σ_ij N_i log(s²_smaller / s²_larger), records i, sensors j."""
        n = np.array([residual.shape[0] for residual in larger.residuals])
        first, second = (_squares(model.residuals) + self.round_off for model in (smaller, larger))
        apart = differ(second, n)
        return float((n @ np.log(variances(first, n, apart) / variances(second, n, apart))).sum())

    def threshold(self, model: _Model, pole: complex) -> float:
        return self.limit * self._noise_ratio(model, pole)

    def splits(self, model: _Model, trial: _Model) -> bool:
        # One that splits another already, on its way or to be left out, is not the new one's fault; nor is one that
        # stays where it is, away from the new one, and only now is found to split another.
        before, after = (self._spurious(each, model) for each in (model, trial))
        old, new, width = trial.poles[:-1], trial.poles[-1], self.grids[0].bin_width
        band = np.abs(old.real) + width
        stays = np.abs(old - model.poles) < band
        away = np.abs(old.imag - new.imag) > band + abs(new.real)
        after[:-1] &= before | ~(stays & away)
        splits = bool(after.sum() > before.sum())
        if splits:
            self.halves.append((complex(new), self.gain(model, trial)))
        return splits

    def settled(self, model: _Model) -> _Model:
        return self.fitted(self._reconsidered(model).poles, model.weights)

    def _reconsidered(self, model: _Model) -> _Model:
        """With what seemed to split a mode while others were missing, each judged beside all the others of its kind."""
        taken: list[int] = []
        found: list[complex] = []
        for pole, _ in sorted(self.halves, key=lambda half: -half[1]):
            splits = int(np.argmin(np.abs(model.poles.imag - pole.imag)))
            if splits not in taken:
                taken, found = [*taken, splits], [*found, pole]
        self.halves.clear()
        n, trial = model.poles.size, model
        with suppress(np.linalg.LinAlgError):
            spurious = np.zeros(0, bool)
            trial = self.fitted(np.append(model.poles, found), model.weights, DECIDES)
            while trial.poles.size > n and (spurious := self._spurious(trial, trial)).any():
                trial = self.fitted(trial.poles[~spurious], trial.weights, DECIDES)
        return trial if trial.poles.size > n else model

    def suspects(self, model: _Model) -> Iterator[tuple[complex, _Model, bool]]:
        """The weakest that is spurious, or else the modes whose amplitudes are weak or that stand close to another."""
        statistic, spurious = self.statistic(model), self._spurious(model, model)
        if spurious.any():
            r = int(np.argmin(np.where(spurious, statistic, np.inf)))
            yield complex(model.poles[r]), self._without(model, r), True
            return
        for r, (pole, strength) in enumerate(zip(model.poles, statistic, strict=True)):
            near = np.abs(np.delete(model.poles, r) - pole).min(initial=np.inf)
            if strength < SELECTION.weak * self.threshold(model, pole) or near < SELECTION.close * abs(pole.real):
                yield complex(pole), self._without(model, r), False

    def explains(self, model: _Model) -> bool:
        """Whether the modes are most of every record."""
        left = _squares(model.residuals).sum(axis=1)
        return bool((left < ORDER.most_left * _squares([grid.nothing for grid in self.grids]).sum(axis=1)).all())

    def oscillating(self, model: _Model) -> Complexes:
        """The poles that oscillate within a record and hardly grow; others may be noise that is not white."""
        poles: Complexes = model.poles
        span = max(record.n_samples * record.sample_time for record in self.records)
        return poles[(poles.real * span < SELECTION.most_growth) & (np.abs(poles) * span > 2.0 * np.pi)]

    def statistic(self, model: _Model) -> np.ndarray:
        """χ² of each mode's amplitudes, poles held, (n_modes,)."""
        n, strength = model.poles.size, np.zeros(model.poles.size)
        for fit, weights in zip(model.fits, model.weights, strict=True):
            for r in range(n):
                both = [r, n + r]
                a = fit.coefficients[both] * weights
                strength[r] += float(np.sum(a * np.linalg.solve(fit.spread[np.ix_(both, both)], a)))
        return strength

    def report(self, model: _Model, records: Sequence[Record]) -> Identified:
        """The modes refined in the records as measured: filters cost the first samples, the strongest."""
        poles = model.poles
        if self.budget.unfinished:  # perhaps before each mode was checked
            spurious = self._spurious(model, model)
            poles = poles[~spurious] if not spurious.all() else poles
            self.rejected += [(complex(pole), 0.0) for pole in model.poles if pole not in poles]
        refined = refine(records, unshaped(poles, records[0]), offset=True, budget=self.budget)
        while (lost := self._lost(poles, refined.modes.poles)).any() and not lost.all():
            poles = poles[~lost]
            refined = refine(records, unshaped(poles, records[0]), offset=True, budget=self.budget)
        statistic = self.statistic(replace(model, poles=poles, fits=self._projected(poles)))[np.argsort(np.abs(poles))]
        found = identified(in_coloured_noise(refined, records), statistic, self.limit, self.rejected, records[0])
        return replace(found, remarks=self.budget.remarks)

    def _lost(self, poles: np.ndarray, refined: np.ndarray) -> np.ndarray:
        """Which modes are no more where they were selected: what else is in a record than modes has drawn them off,
        or damps them too much to ring."""
        away = np.abs(np.subtract.outer(poles, refined))
        return np.asarray(overdamped(refined)[away.argmin(axis=1)] | self.lost(poles, refined))

    def lost(self, poles: np.ndarray, found: np.ndarray) -> np.ndarray:
        """Which poles have none of those found within a few of their bandwidths."""
        away = np.abs(np.subtract.outer(poles, found)).min(axis=1, initial=np.inf)
        return np.asarray(away > ORDER.lost * (np.abs(poles.real) + self.grids[0].bin_width))

    def fitted(self, poles: np.ndarray, weights: np.ndarray, how: Mapping[str, Any] = FULLY) -> _Model:
        """Poles after a search, sensors then weighted by the noise found in each record."""
        if poles.size == 0:
            fits = self._projected(poles)
        else:
            poles, fits, *_ = search(self.records, poles, weights, True, budget=self.budget, **how)
        n, squares = np.array([r.n_samples for r in self.records]), _squares([fit.residual for fit in fits])
        return _Model(poles, 1.0 / np.sqrt(variances(np.maximum(squares, self.round_off), n)), fits)

    def _projected(self, poles: np.ndarray) -> list[Projection]:
        return [project(record, poles, True) for record in self.records]

    def _without(self, model: _Model, r: int) -> _Model:
        return self.fitted(np.delete(model.poles, r), model.weights, DECIDES)

    def _spurious(self, of: _Model, model: _Model) -> np.ndarray:
        """Which modes of one model are spurious, in the noise that another leaves."""
        poles = of.poles
        shapes = np.vstack([f.complex_amplitudes * w[:, None] for f, w in zip(of.fits, model.weights, strict=True)])
        strength = np.linalg.norm(shapes, axis=0)
        if self.records[0].n_outputs == 1:  # the modes of one sensor have no shape, in however many records
            shapes = strength[None]

        def distinct(r: int, s: int) -> bool:
            return self._distinct(model, poles, r, s)

        return spurious_modes(poles, shapes, strength, self.grids[0].bin_width, distinct)

    def _distinct(self, model: _Model, poles: np.ndarray, r: int, s: int) -> bool:
        """Whether one sensor that sees a beat of modes r and s is likelier to see both than a single nonlinear mode.

        In the records as measured: a filter that whitens the residual of one mode removes most of its statistic.
        """
        width = self.grids[0].bin_width
        pair, others = poles[[r, s]], np.delete(poles, [r, s])
        middle, half = band_about(pair, width)
        asked = np.r_[pair, np.sort_complex(others[np.abs(others.imag - middle) < half])]
        for known, verdict in self.verdicts:
            if known.size == asked.size and (np.abs(known - asked) < ORDER.same * (np.abs(asked.real) + width)).all():
                return verdict
        verdict = False
        with suppress(np.linalg.LinAlgError):
            verdict = are_two(self.measured, poles, r, s, self.two)
        self.verdicts.append((asked, verdict))
        return verdict

    def _noise_ratio(self, model: _Model, pole: complex) -> float:
        """Noise about a frequency over its mean, where it is larger: median of the residual's spectrum, 1 if white."""
        grid = self.grids[0]
        left = model.left
        at = round((pole.imag - grid.lowest) / grid.bin_width)
        beside = left[max(at - SELECTION.noise_bins, 0) : at + SELECTION.noise_bins + 1]
        return max(1.0, float(np.median(beside)) / float(left.mean())) if beside.size else 1.0


class _Grid:
    """Damped exponentials e^{λt} to compare a residual with, by rate of decay and frequency."""

    def __init__(self, record: Record, n: int) -> None:
        self.record, dt = record, record.sample_time
        self.nothing = (record.outputs - record.outputs.mean(axis=1, keepdims=True)).T
        self.size = 1 << int(np.ceil(np.log2(2 * n)))
        omega = 2.0 * np.pi * np.fft.rfftfreq(self.size, dt)
        span = n * dt
        self.bin_width = self.lowest = 2.0 * np.pi / span
        fastest = 0.1 * np.pi / dt
        self.rates = np.r_[
            0.0, np.geomspace(1.0 / span, max(fastest, 2.0 / span), max(int(np.log(fastest * span)) + 1, 2))
        ]
        inside = (omega > np.pi / span) & (omega < np.pi / dt - np.pi / span)
        columns, self.omega = np.flatnonzero(inside), omega[inside]
        self.n_cells = sum(int((rate < SELECTION.most_damped * self.omega).sum()) for rate in self.rates)
        step = 2.0 * np.pi / (self.size * dt)
        self.strides = [1 << int(np.log2(max(rate / (ORDER.coarser * step), 1.0))) for rate in self.rates]
        # Of each rate: its frequencies among all, and where its transform has them.
        self.cells = [np.flatnonzero(columns % stride == 0) for stride in self.strides]
        self.columns = [columns[at] // stride for at, stride in zip(self.cells, self.strides, strict=True)]
        self._sums: dict[int, list[tuple[Floats, float, Complexes, Complexes, Complexes]]] = {}

    def _of_length(self, n: int) -> list[tuple[Floats, float, Complexes, Complexes, Complexes]]:
        """Of n samples and each rate: its decay, Σ|w|^2t, and w, Σ w*^2t and w^n at its frequencies."""
        if n not in self._sums:
            dt, found = self.record.sample_time, []
            once, end = np.exp(1j * dt * self.omega), np.exp(1j * n * dt * self.omega)
            for rate, cells, stride in zip(self.rates, self.cells, self.strides, strict=True):
                decay = np.exp(-rate * dt * np.arange(min(n, self.size // stride)))
                w, ends = np.exp(-rate * dt) * once[cells], np.exp(-rate * dt * n) * end[cells]
                double = (1.0 - ends.conj() ** 2) / (1.0 - w.conj() ** 2)
                found.append((decay, float(decay @ decay), w, double, ends))
            self._sums[n] = found
        return self._sums[n]

    def near(self, pole: complex, bins: float) -> np.ndarray:
        """Frequencies within so many bins, or half as many rates of decay, of a pole's."""
        return np.asarray(np.abs(self.omega - pole.imag) < bins * max(self.bin_width, 0.5 * abs(pole.real)))

    def strengths(self, residual: np.ndarray, weights: np.ndarray, poles: np.ndarray) -> np.ndarray:
        """χ² of each, (n_rates, n_frequencies); 0 where it cannot be distinguished from the modes so far."""
        dt, n = self.record.sample_time, residual.shape[0]
        weighted = residual * weights
        found = np.zeros((self.rates.size, self.omega.size))
        modes = _Span(np.exp(poles * dt), n)
        for k, (decay, whole, w, double, ends) in enumerate(self._of_length(n)):
            rate, cells = self.rates[k], self.cells[k]
            allowed = rate < SELECTION.most_damped * self.omega[cells]
            decayed = weighted[: decay.size] * decay[:, None]
            spectrum = np.fft.rfft(decayed, self.size // self.strides[k], axis=0)[self.columns[k]]
            own = (np.abs(spectrum) ** 2).sum(axis=1)
            turned = (spectrum.conj() ** 2).sum(axis=1)
            p, q = np.full(own.shape, whole), double.copy()
            at = self._beside(poles, k) & allowed
            if at.any():
                dp, dq = modes.shared(w[at], ends[at])
                p[at] -= dp
                q[at] -= dq
            det = p**2 - np.abs(q) ** 2
            good = allowed & (det > ORDER.least_independent * whole**2) & (p > 0)
            top = 2.0 * p * own - 2.0 * (q * turned).real
            found[k, cells] = np.where(good, top / np.where(good, det, 1.0), 0.0)
        return found

    def _beside(self, poles: np.ndarray, k: int) -> np.ndarray:
        """Which frequencies of a rate overlap with a mode so far."""
        omega = self.omega[self.cells[k]]
        near = np.zeros(omega.size, bool)
        for pole in poles:
            reach = 3.0 * (2.0 * self.bin_width + abs(pole.real) + self.rates[k])
            near[slice(*np.searchsorted(omega, [pole.imag - reach, pole.imag + reach]))] = True
        return near


class _Span:
    """The span of Re z^t and Im z^t over n samples, z of the modes so far."""

    def __init__(self, z: np.ndarray, n: int) -> None:
        self.n, self.both = n, np.r_[z, z.conj()]
        same, turned = np.split(_geometric(self.both, z, n, z**n), 2)
        gram = np.block([[(turned + same).real, (same + turned).imag], [(same - turned).imag, (turned - same).real]])
        scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
        values, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
        kept = values > ORDER.resolved * values.max(initial=0.0)
        self.to_basis = vectors[:, kept].T * scale / np.sqrt(2.0 * values[kept, None])

    def shared(self, w: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The part of the Gram matrix [[p, q], [q*, p]] of (w^t, w*^t), w^n = end, in this span.

        With c = Q^T w^t, Q a real orthonormal basis, p = Σ |c|² and q = Σ c*².
        """
        one, other = np.split(_geometric(self.both, w, self.n, end), 2)
        along = np.vstack([one + other, -1j * (one - other)])
        c = (self.to_basis @ along.view(float)).view(complex)
        return (c.real**2 + c.imag**2).sum(axis=0), (c.conj() ** 2).sum(axis=0)


def _geometric(a: np.ndarray, b: np.ndarray, n: int, end: np.ndarray) -> np.ndarray:
    """Σ_{t<n} (a_i b_k)^t, (a.size, b.size), with b^n given as `end`."""
    gap = 1.0 - np.outer(a, b)
    whole = np.abs(gap) < 1e-12
    gap[whole] = 1.0
    sums = (1.0 - np.outer(a**n, end)) / gap
    sums[whole] = n
    return np.asarray(sums)


def _left(records: Sequence[Record], poles: np.ndarray) -> float:
    """Mean share of the energy of an output that modes leave."""
    each = ((r.outputs.var(axis=1), project(r, poles, True).residual.var(axis=0)) for r in records)
    return float(np.mean([left / np.maximum(whole, 1e-300) for whole, left in each]))


def _squares(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Sums of those of each output in each record, (n_records, n_outputs)."""
    return np.array([(left**2).sum(axis=0) for left in residuals])
