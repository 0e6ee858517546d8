"""Model order selection for free decays: the modes of a record, by stepwise selection.

The residual r_j of output j, left by the modes of the current model, is correlated with damped exponentials e^{λt} on a
grid of λ:

    χ²(λ) = Σ_j |Q^T r_j|² / s_j²,     Q an orthonormal basis of (I - Φ Φ^+) [Re e^{λt}, Im e^{λt}],

which has a chi-square distribution of two degrees of freedom per output where the residual is white noise of standard
deviation s_j. The strongest candidate enters the model, and a likelihood ratio test (`signal/searches`) decides whether
it stays. Rejected candidates are reported as noise. The search ends when the strongest candidate of the grid is no
stronger than the strongest of so many in noise, or after some that were rejected or only split a mode.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.fft import rfft

from workbench.arrays import Complexes, Floats
from workbench.identification.free_decay.assumptions import amplitude_dependence
from workbench.identification.free_decay.backbone import are_two, band_about
from workbench.identification.free_decay.long_records import identify_long
from workbench.identification.free_decay.preparation import decay_start, decays
from workbench.identification.free_decay.refinement import (
    amplitude_statistic,
    fitted_poles,
    identified,
    in_coloured_noise,
    over_noise,
    refine,
    thresholds,
    unshaped,
)
from workbench.identification.signal.data_quality import check_data_quality, of_same_sensors, steps
from workbench.identification.signal.modal_estimates import IdentifiedModes
from workbench.identification.signal.projection import (
    Projection,
    differ,
    local_noise_ratio,
    project,
    variances,
    whitened,
)
from workbench.identification.signal.searches import (
    FALSE_ALARM,
    FIT,
    SECONDS,
    SELECTION,
    STOPPED,
    OrderSelection,
    Progress,
    TimeLimit,
    check_count,
    overdamped,
    spurious_modes,
)
from workbench.records.record import Record
from workbench.renamed import former_arguments
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class OrderSettings:
    """Constants of the selection of modes of a free decay, in addition to those of `searches.SELECTION`."""

    long_record_values: int = 100_000  # above which in total many modes enter at a time
    max_modes: int = 40  # unless given: a joint fit of more takes minutes
    whitening_rounds: int = 2  # alternations between noise spectrum and modes
    # Modes that whitening removed are true, and stay, if they reduce the energy of the residual to this share or less;
    # modes fitted to coloured noise reduce it by a part only.
    max_restored_ratio: float = 0.1
    # consecutive candidates below the threshold, and candidates that split a mode, after which the search ends
    max_weak: int = 2
    max_splits: int = 6
    # of a decay rate to the frequency step of its transform: the exponential has decayed to e^-25 at the end of the
    # transform
    min_rate_ratio: float = 4.0
    min_independent_share: float = 1e-7  # of a candidate, outside the span of the model, to be distinguishable
    min_eigenvalue_ratio: float = 1e-13  # to the largest of a Gram matrix, below which a direction is round-off
    # bandwidths by which a mode selected in whitened records may move when refined in the records as measured
    max_shift: float = 5.0
    max_residual_share: float = 0.5  # of a record's energy, in the residual of modes that explain it
    min_input_ratio: float = 0.01  # rms of an input that acts after the start of the decay, over its largest value
    # bandwidths that two poles may move before the test for one nonlinear mode is repeated
    pole_tolerance: float = 0.05


ORDER = OrderSettings()
# Results of the test for one nonlinear mode: the poles of two modes and their neighbours, and whether the two are two.
Verdicts = list[tuple[Complexes, bool]]


@former_arguments(most_modes="max_modes")
@one_blas_thread
def identify(
    records: Record | Sequence[Record],
    *,
    max_modes: int | None = None,
    false_alarm: float = FALSE_ALARM,
    seconds: float | None = SECONDS,
    progress: Progress | None = None,
) -> IdentifiedModes:
    """The modes of a free decay, their number selected, each with its standard error.

    In records of more than 100,000 values in all many modes enter at a time (`long_records`).

    Args:
        records: free decay in noise, of the same sensors at one rate; each output may hold a constant.
        max_modes: largest number of modes; 40 unless given, and 400 in long records.
        false_alarm: probability that noise alone is taken for a mode; 0.001 unless given.
        seconds: of processor time, 30 unless given, after which the best so far is returned, with a remark; None for no
            limit.
        progress: called with the search under way and the share of the time that is spent.

    Raises:
        ValueError: no mode rises above the noise; a faulty channel (`check_data_quality`); records that differ in
            sensors or rate; too few samples.
    """
    check_count("max_modes", max_modes)
    records = of_same_sensors(records)
    time_limit = TimeLimit(seconds, progress)
    result = identify_within(records, time_limit, max_modes=max_modes, false_alarm=false_alarm)
    result = result.without_artefacts(np.pi / records[0].sample_time)
    start_remarks = tuple(remark for record in records for remark in (*_driven(record), *_starts_later(record)))
    by_amplitude = amplitude_dependence(records, result.refined, time_limit=time_limit)
    other_remarks = tuple(remark for remark in result.remarks if not remark.startswith(STOPPED))
    return replace(result, remarks=(*start_remarks, *other_remarks, *time_limit.remarks, *by_amplitude.remarks))


def _driven(record: Record) -> tuple[str, ...]:
    """A remark where inputs vary after the start of the decay and the outputs do not decay.

    The channel of a hammer is noise after the impact; that of a constant force does not vary.
    """
    if not record.inputs.any():
        return ()
    after = record.between(decay_start(record)).inputs.std(axis=1)
    acts = after > ORDER.min_input_ratio * np.abs(record.inputs).max(axis=1)
    if not acts.any() or decays(record):
        return ()
    each = zip(record.input_channels, after, acts, strict=True)
    found = ", ".join(f"{one.name!r} (rms {rms:.3g} {one.unit}".rstrip() + ")" for one, rms, act in each if act)
    return (
        f"record {record.name!r} is driven by input {found}: what is found in it is no free decay; use identify_driven,"
        " or cut the record to where nothing drives it",
    )


def _starts_later(record: Record) -> tuple[str, ...]:
    """A remark where the record has samples before its free decay."""
    start = decay_start(record)
    if start == record.start_time:
        return ()
    return (
        f"record {record.name!r} is free decay from {start:.6g} s on only: samples before it would be read as modes;"
        f" cut it, `record.between({start:.6g})`, or give it to `ring_down`",
    )


def identify_within(
    records: Sequence[Record], time_limit: TimeLimit, *, max_modes: int | None = None, false_alarm: float = FALSE_ALARM
) -> IdentifiedModes:
    """`identify` within the time left of `time_limit`, artefacts included."""
    for record in records:
        check_data_quality(record)
    shortest = min(records, key=lambda record: record.n_samples)
    most = (shortest.n_samples - 4) // 3
    if most < 1:
        raise ValueError(f"record {shortest.name!r} has {shortest.n_samples} samples; a mode needs 7: measure longer")
    is_long = sum(r.outputs.size for r in records) > ORDER.long_record_values
    most = min(max_modes or (10 if is_long else 1) * ORDER.max_modes, most)
    select = identify_long if is_long else _identify_stepwise
    found = select(records, max_modes=most, false_alarm=false_alarm, time_limit=time_limit)
    if found is None:
        raise ValueError(
            f"record {records[0].name!r} holds no mode that rises above its noise: is it a free decay? Cut it to the"
            " decay, measure longer or excite harder"
        )
    return found


def _identify_stepwise(
    records: Sequence[Record], *, max_modes: int, false_alarm: float, time_limit: TimeLimit
) -> IdentifiedModes | None:
    """The modes by stepwise selection, in the records as measured and then whitened; None where none is significant."""
    search_time = time_limit.share(SELECTION.search_share)
    verdicts: Verdicts = []

    def selected(some: Sequence[Record]) -> tuple[_FreeDecay, _Model]:
        problem = _FreeDecay(some, false_alarm, records, search_time, verdicts)
        selection = OrderSelection(
            problem, max_modes, ORDER.max_weak, ORDER.max_splits, forgets=False, time_limit=search_time, alone=True
        )
        model = selection.select(problem.nothing)
        problem.rejected = selection.rejected
        return problem, model

    problem, model = selected(records)
    explained = problem.explains(model)
    for _ in range(ORDER.whitening_rounds):
        # After an unfinished search the residual still holds modes.
        if search_time.unfinished or search_time.spent("whitening of the noise"):
            break
        white = whitened(records, problem.oscillating(model))
        if white is None:
            break
        other, fewer = selected(white)
        # The residual of a mode that depends on amplitude or time is not noise: whitening by it removes modes.
        if not fewer.poles.size and explained:
            break
        all_modes = np.append(fewer.poles, model.poles[other.lost(model.poles, fewer.poles)])
        if explained:
            share, share_of_fewer = (_residual_share(records, poles) for poles in (all_modes, fewer.poles))
            if share < ORDER.max_restored_ratio * share_of_fewer:
                fewer = other.fitted(all_modes, fewer.weights)
        problem, model = other, fewer
    problem.time_limit = time_limit
    return problem.refined(model) if model.poles.size else None


@dataclass(frozen=True, eq=False)
class _Model:
    """The modes of the current model and their fit."""

    poles: np.ndarray  # (n_modes,) rad/s
    weights: np.ndarray  # (n_records, n_outputs) 1 / standard deviation of the noise
    fits: list[Projection]  # one per record

    @property
    def residuals(self) -> list[Floats]:
        """Residual (n_samples, n_outputs) of each record."""
        return [fit.residual for fit in self.fits]

    @property
    def statistic(self) -> np.ndarray:
        """χ² of the amplitudes of each mode at fixed poles, (n_modes,)."""
        return np.array([amplitude_statistic(self.fits, self.weights, r) for r in range(self.poles.size)])

    @cached_property
    def residual_power(self) -> Floats:
        """Power spectrum of the residual of the first record, mean over the outputs in units of their noise."""
        lines = rfft(self.residuals[0] * self.weights[0], axis=0)[1:]
        power: Floats = (lines.real**2 + lines.imag**2).mean(axis=1)
        return power


class _FreeDecay:
    """The `searches.Selection` of free decays, whitened or as measured: a candidate is a pole of the grid.

    Attributes:
        measured: the records as measured, for the test of one nonlinear mode.
        enter: χ² from which on a candidate is tried.
        limit: gain from which on it stays, in white noise.
        split_off: candidates rejected for splitting a mode, with their gain.
        nothing: the model without modes.
    """

    def __init__(
        self,
        records: Sequence[Record],
        false_alarm: float,
        measured: Sequence[Record],
        time_limit: TimeLimit,
        verdicts: Verdicts,
    ) -> None:
        longest = max(record.n_samples for record in records)
        self.records, self.measured, self.time_limit = records, measured, time_limit
        self.grids = [_Grid(record, longest) for record in records]
        # Residuals at round-off level do not show how noise differs between sensors.
        self.round_off = FIT.round_off * np.array([(record.outputs**2).sum(axis=1) for record in records]) + 1e-300
        self.round_off = np.maximum(self.round_off, [m.n_samples * steps(m) ** 2 / 12.0 for m in measured])
        n_signals = sum(r.n_outputs for r in records)
        self.enter, self.limit = thresholds(false_alarm, self.grids[0].n_cells, n_signals)
        # With several records the test for two modes needs no correction for the choice among all cells.
        self.two_modes_threshold = self.limit if len(records) == 1 else thresholds(false_alarm, 1, n_signals)[1]
        self.verdicts = verdicts
        self.split_off: list[tuple[complex, float]] = []
        self.rejected: list[tuple[complex, float]] = []
        self.nothing = self.fitted(np.zeros(0, complex), np.ones((len(records), records[0].n_outputs)))

    def n_modes(self, model: _Model) -> int:
        return model.poles.size

    def strongest(self, model: _Model, rejected: list[tuple[complex, float]]) -> complex | None:
        # In round-off any candidate may seem strongest.
        if (_squares(model.residuals) <= self.round_off).all():
            return None
        each = zip(self.grids, model.residuals, model.weights, strict=True)
        strengths = np.sum([grid.strengths(residual, weights, model.poles) for grid, residual, weights in each], axis=0)
        grid = self.grids[0]
        for pole, _ in rejected:
            strengths[:, np.abs(grid.omega - pole.imag) < 2.0 * max(grid.bin_width, 0.5 * abs(pole.real))] = 0.0
        elsewhere = np.where(self._tried(model, rejected), 0.0, strengths)
        candidate = self._significant(model, elsewhere)
        return self._significant(model, strengths) if candidate is None else candidate

    def _significant(self, model: _Model, strengths: np.ndarray) -> complex | None:
        """The pole of the largest of `strengths` (n_rates, n_frequencies); None where noise explains it."""
        grid, best = self.grids[0], np.unravel_index(int(np.argmax(strengths)), strengths.shape)
        pole = complex(-grid.rates[best[0]], grid.omega[best[1]])
        return None if strengths[best] < self.enter * self._noise_ratio(model, pole) else pole

    def _tried(self, model: _Model, rejected: list[tuple[complex, float]]) -> np.ndarray:
        """Which candidates overlap with a mode that a rejected candidate overlaps with too, (n_rates, n_frequencies).

        A candidate that splits a mode on one side would split it on the other side too; it is tried last.
        """
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
        return self.fitted(np.append(model.poles, candidate), model.weights, decide=True)

    def gain(self, smaller: _Model, larger: _Model) -> float:
        """Twice the log-likelihood ratio, noise unknown: Σ_ij N_i log(s²_smaller / s²_larger), records i, sensors j."""
        n = np.array([residual.shape[0] for residual in larger.residuals])
        before, after = (_squares(model.residuals) + self.round_off for model in (smaller, larger))
        differing = differ(after, n)
        return float((n @ np.log(variances(before, n, differing) / variances(after, n, differing))).sum())

    def threshold(self, model: _Model, pole: complex) -> float:
        return self.limit * self._noise_ratio(model, pole)

    def splits(self, model: _Model, trial: _Model) -> bool:
        # It does not count if modes were spurious before, or become so without moving or overlapping with the new one.
        before, after = (self._spurious(each, model) for each in (model, trial))
        old, new, width = trial.poles[:-1], trial.poles[-1], self.grids[0].bin_width
        band = np.abs(old.real) + width
        unmoved = np.abs(old - model.poles) < band
        separate = np.abs(old.imag - new.imag) > band + abs(new.real)
        after[:-1] &= before | ~(unmoved & separate)
        splits = bool(after.sum() > before.sum())
        if splits:
            self.split_off.append((complex(new), self.gain(model, trial)))
        return splits

    def settled(self, model: _Model) -> _Model:
        return self.fitted(self._reconsidered(model).poles, model.weights)

    def _reconsidered(self, model: _Model) -> _Model:
        """The model with candidates rejected for splitting a mode, if they are not spurious now.

        A candidate may seem to split a mode only because other modes are missing from the model. The strongest
        candidate of each mode is tried again, all of them together.
        """
        strongest: dict[int, complex] = {}
        for pole, _ in sorted(self.split_off, key=lambda candidate: -candidate[1]):
            strongest.setdefault(int(np.argmin(np.abs(model.poles.imag - pole.imag))), pole)
        self.split_off.clear()
        n, trial = model.poles.size, model
        with suppress(np.linalg.LinAlgError):
            spurious = np.zeros(0, bool)
            trial = self.fitted(np.append(model.poles, [*strongest.values()]), model.weights, decide=True)
            while trial.poles.size > n and (spurious := self._spurious(trial, trial)).any():
                trial = self.fitted(trial.poles[~spurious], trial.weights, decide=True)
        return trial if trial.poles.size > n else model

    def suspects(self, model: _Model) -> Iterator[tuple[complex, _Model, bool]]:
        """Modes to leave out on trial: the weakest spurious one, or else those that are weak or close to another."""
        statistic, spurious = model.statistic, self._spurious(model, model)
        if spurious.any():
            r = int(np.argmin(np.where(spurious, statistic, np.inf)))
            yield complex(model.poles[r]), self._without(model, r), True
            return
        for r, (pole, strength) in enumerate(zip(model.poles, statistic, strict=True)):
            distance = np.abs(np.delete(model.poles, r) - pole).min(initial=np.inf)
            weak = strength < SELECTION.weak_ratio * self.threshold(model, pole)
            if weak or distance < SELECTION.close_bandwidths * abs(pole.real):
                yield complex(pole), self._without(model, r), False

    def explains(self, model: _Model) -> bool:
        """Whether the modes explain most of the energy of every record."""
        energy = [record.n_samples * record.outputs.var(axis=1).sum() for record in self.records]
        return bool((_squares(model.residuals).sum(axis=1) < ORDER.max_residual_share * np.array(energy)).all())

    def oscillating(self, model: _Model) -> Complexes:
        """The poles that oscillate within a record and do not grow, rad/s; others may be coloured noise."""
        poles: Complexes = model.poles
        span = max(record.n_samples * record.sample_time for record in self.records)
        return poles[(poles.real * span < SELECTION.max_growth) & (np.abs(poles) * span > 2.0 * np.pi)]

    def refined(self, model: _Model) -> IdentifiedModes:
        """The modes refined in the records as measured: whitening filters lose the first samples, the strongest."""
        poles, records = model.poles, self.measured
        if self.time_limit.unfinished:  # perhaps before all modes were tested
            spurious = self._spurious(model, model)
            poles = poles[~spurious] if not spurious.all() else poles
            self.rejected += [(complex(pole), 0.0) for pole in model.poles if pole not in poles]
        refined = refine(records, unshaped(poles, records[0]), offset=True, time_limit=self.time_limit)
        while (lost := self._lost_in_refinement(poles, refined.modes.poles)).any() and not lost.all():
            poles = poles[~lost]
            refined = refine(records, unshaped(poles, records[0]), offset=True, time_limit=self.time_limit)
        statistic = replace(model, poles=poles, fits=self._projected(poles)).statistic[np.argsort(np.abs(poles))]
        refined = in_coloured_noise(refined, records)
        return identified(refined, statistic, self.limit, self.rejected, records[0], self.time_limit.remarks)

    def _lost_in_refinement(self, poles: np.ndarray, refined: np.ndarray) -> np.ndarray:
        """Which modes moved away or became overdamped in the refinement, fitted to a part of the record that is no
        mode, (n_modes,)."""
        distance = np.abs(np.subtract.outer(poles, refined))
        return np.asarray(overdamped(refined)[distance.argmin(axis=1)] | self.lost(poles, refined))

    def lost(self, poles: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Which poles have none of the others within a few of their bandwidths, (n_poles,)."""
        distance = np.abs(np.subtract.outer(poles, others)).min(axis=1, initial=np.inf)
        return np.asarray(distance > ORDER.max_shift * (np.abs(poles.real) + self.grids[0].bin_width))

    def fitted(self, poles: np.ndarray, weights: np.ndarray, *, decide: bool = False) -> _Model:
        """The model of refined poles, weighted by the noise of each sensor in each record.

        With `decide` only as precisely as a decision on a mode needs it.
        """
        trial = SELECTION.trial_steps, SELECTION.trial_tolerance
        most_steps, enough = trial if decide else (FIT.max_steps, FIT.cost_tolerance)
        if poles.size:
            poles, fits, *_ = fitted_poles(
                self.records, poles, weights, True, most_steps, enough=enough, time_limit=self.time_limit
            )
        else:
            fits = self._projected(poles)
        n, squares = np.array([r.n_samples for r in self.records]), _squares([fit.residual for fit in fits])
        return _Model(poles, 1.0 / np.sqrt(variances(np.maximum(squares, self.round_off), n)), fits)

    def _projected(self, poles: np.ndarray) -> list[Projection]:
        return [project(record, poles, True) for record in self.records]

    def _without(self, model: _Model, r: int) -> _Model:
        return self.fitted(np.delete(model.poles, r), model.weights, decide=True)

    def _spurious(self, tested: _Model, model: _Model) -> np.ndarray:
        """Which modes of a tested model are spurious, (n_modes,), in the noise of another model."""
        poles, shapes = tested.poles, over_noise(tested.fits, model.weights)
        strength = np.linalg.norm(shapes, axis=0)
        if self.records[0].n_outputs == 1:  # one sensor shows no shape, however many records there are
            shapes = strength[None]
        width = self.grids[0].bin_width
        return spurious_modes(poles, shapes, strength, width, lambda r, s: self._distinct(poles, r, s))

    def _distinct(self, poles: np.ndarray, r: int, s: int) -> bool:
        """Whether a single sensor shows two linear modes r and s, rather than one nonlinear mode.

        The records as measured decide: whitening by the residual of one mode removes most of the evidence.
        """
        width = self.grids[0].bin_width
        pair, others = poles[[r, s]], np.delete(poles, [r, s])
        middle, half = band_about(pair, width)
        group = np.r_[pair, np.sort_complex(others[np.abs(others.imag - middle) < half])]
        for known, verdict in self.verdicts:
            tolerance = ORDER.pole_tolerance * (np.abs(group.real) + width)
            if known.size == group.size and (np.abs(known - group) < tolerance).all():
                return verdict
        verdict = False
        with suppress(np.linalg.LinAlgError):
            verdict = are_two(self.measured, poles, r, s, self.two_modes_threshold)
        self.verdicts.append((group, verdict))
        return verdict

    def _noise_ratio(self, model: _Model, pole: complex) -> float:
        """Noise about a frequency over its mean, 1 or more: by the median of the residual's spectrum there."""
        nearest = round((pole.imag - self.grids[0].bin_width) / self.grids[0].bin_width)
        return local_noise_ratio(model.residual_power, nearest, SELECTION.noise_bins)


class _Grid:
    """A grid of damped exponentials e^{λt} by decay rate and frequency, rad/s, with which residuals are correlated.

    The transform of each decay rate is as short as the exponential allows, so that its frequencies are a subset.
    """

    def __init__(self, record: Record, n: int) -> None:
        self.record, dt = record, record.sample_time
        self.size = 1 << int(np.ceil(np.log2(2 * n)))
        omega = 2.0 * np.pi * np.fft.rfftfreq(self.size, dt)
        span = n * dt
        self.bin_width = 2.0 * np.pi / span
        fastest = 0.1 * np.pi / dt
        n_rates = max(int(np.log(fastest * span)) + 1, 2)
        self.rates = np.r_[0.0, np.geomspace(1.0 / span, max(fastest, 2.0 / span), n_rates)]
        inside = (omega > np.pi / span) & (omega < np.pi / dt - np.pi / span)
        columns, self.omega = np.flatnonzero(inside), omega[inside]
        self.n_cells = sum(int((rate < SELECTION.max_damping * self.omega).sum()) for rate in self.rates)
        step = 2.0 * np.pi / (self.size * dt)
        self.strides = [1 << int(np.log2(max(rate / (ORDER.min_rate_ratio * step), 1.0))) for rate in self.rates]
        # For each rate: the indices of its frequencies in `omega`, and in its own transform.
        self.cells = [np.flatnonzero(columns % stride == 0) for stride in self.strides]
        self.columns = [columns[at] // stride for at, stride in zip(self.cells, self.strides, strict=True)]

    @cached_property
    def _tables(self) -> list[tuple[Floats, float, Complexes, Complexes, Complexes]]:
        """For each rate, over n samples: its decay, Σ|w|^2t, and w = e^{λΔt}, Σ w*^2t and w^n at its frequencies."""
        n, dt, tables = self.record.n_samples, self.record.sample_time, []
        step, last = np.exp(1j * dt * self.omega), np.exp(1j * n * dt * self.omega)
        for rate, cells, stride in zip(self.rates, self.cells, self.strides, strict=True):
            decay = np.exp(-rate * dt * np.arange(min(n, self.size // stride)))
            w, ends = np.exp(-rate * dt) * step[cells], np.exp(-rate * dt * n) * last[cells]
            double = (1.0 - ends.conj() ** 2) / (1.0 - w.conj() ** 2)
            tables.append((decay, float(decay @ decay), w, double, ends))
        return tables

    def strengths(self, residual: np.ndarray, weights: np.ndarray, poles: np.ndarray) -> np.ndarray:
        """χ² of each candidate, (n_rates, n_frequencies); 0 where the modes of the model are indistinguishable from it.

        From the residual (n_samples, n_outputs), 1 / noise (n_outputs,), and the poles of the model, rad/s.
        """
        weighted = residual * weights
        chi_square = np.zeros((self.rates.size, self.omega.size))
        modes = _Span(np.exp(poles * self.record.sample_time), self.record.n_samples)
        for k, (decay, energy, w, double, ends) in enumerate(self._tables):
            rate, cells = self.rates[k], self.cells[k]
            allowed = rate < SELECTION.max_damping * self.omega[cells]
            decayed = weighted[: decay.size] * decay[:, None]
            spectrum = np.fft.rfft(decayed, self.size // self.strides[k], axis=0)[self.columns[k]]
            power = (np.abs(spectrum) ** 2).sum(axis=1)
            conjugate_power = (spectrum.conj() ** 2).sum(axis=1)
            p, q = np.full(power.shape, energy), double.copy()
            at = self._overlapping(poles, k) & allowed
            if at.any():
                dp, dq = modes.shared(w[at], ends[at])
                p[at] -= dp
                q[at] -= dq
            det = p**2 - np.abs(q) ** 2
            good = allowed & (det > ORDER.min_independent_share * energy**2) & (p > 0)
            top = 2.0 * p * power - 2.0 * (q * conjugate_power).real
            chi_square[k, cells] = np.where(good, top / np.where(good, det, 1.0), 0.0)
        return chi_square

    def _overlapping(self, poles: np.ndarray, k: int) -> np.ndarray:
        """Which frequencies of rate k overlap with a mode of the model."""
        omega = self.omega[self.cells[k]]
        overlaps = np.zeros(omega.size, bool)
        for pole in poles:
            reach = 3.0 * (2.0 * self.bin_width + abs(pole.real) + self.rates[k])
            overlaps[slice(*np.searchsorted(omega, [pole.imag - reach, pole.imag + reach]))] = True
        return overlaps


class _Span:
    """The span of Re z^t and Im z^t over n samples, z = e^{λΔt} of the modes of the model."""

    def __init__(self, z: np.ndarray, n: int) -> None:
        self.n, self.both = n, np.r_[z, z.conj()]
        same, turned = np.split(_geometric(self.both, z, n, z**n), 2)
        gram = np.block([[(turned + same).real, (same + turned).imag], [(same - turned).imag, (turned - same).real]])
        scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
        values, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
        kept = values > ORDER.min_eigenvalue_ratio * values.max(initial=0.0)
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


def _residual_share(records: Sequence[Record], poles: np.ndarray) -> float:
    """Share of an output's energy in the residual of modes, mean over outputs and records."""
    each = ((r.outputs.var(axis=1), project(r, poles, True).residual.var(axis=0)) for r in records)
    return float(np.mean([left / np.maximum(whole, 1e-300) for whole, left in each]))


def _squares(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Sum of squares of the residual of each output in each record, (n_records, n_outputs)."""
    return np.array([(left**2).sum(axis=0) for left in residuals])
