"""Preparation of a record for identification: whether and since when it is a free decay, spikes, and drift.

A free decay satisfies a backward linear prediction y(t) = Σ_k c_k y(t + kΔt), with the same c_k for every output, for
any modes with constants and drifts. The c_k are estimated from the end of the record backwards, by recursive least
squares with a short memory, and every few samples are predicted from those after them. Where a force acts the
prediction error rises above its level in the samples after. The test is repeated at a quarter, a sixteenth, ... of the
sample rate, behind a low-pass filter (a filtered free decay is a free decay), for changes that are slow against the
sample time.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.polynomial.legendre import leggauss, legvander
from scipy.linalg import block_diag
from scipy.linalg.lapack import dgeqrf, dtrtrs
from scipy.signal import upfirdn
from scipy.signal.windows import blackman
from scipy.stats import chi2

from workbench.identification.free_decay.ibrahim import stacked_delays
from workbench.identification.signal.projection import project
from workbench.identification.signal.searches import FALSE_ALARM
from workbench.records.record import Record
from workbench.structure.modes import frozen


@dataclass(frozen=True)
class StartSettings:
    """Constants of the test for a free decay, of the detection of its start, of spikes, and of exponential settling."""

    predictor_order: int = 32  # of the backward predictor
    update_samples: int = 4  # per update of the predictor
    coefficient_memory: int = 4  # of the predictor, in orders
    level_memory: int = 2  # of the level of its errors, in orders
    max_combinations: int = 8  # of outputs, that the predictor is estimated from
    max_samples: int = 40_000  # per rate; longer records are tested at lower rates only
    max_sensors: int = 256  # that are combined, evenly spaced among all: more take minutes
    rate_ratio: int = 4  # of one rate to the next
    # Squared prediction error over its level that is a break: alone; where the energy of the motion also rises by the
    # factor `energy_rise`; or within `repeated_samples` of another break, for a force that dies away.
    break_ratio: float = 100.0
    rising_ratio: float = 25.0
    energy_rise: float = 4.0
    repeated_ratio: float = 16.0
    repeated_samples: int = 8
    settling_rates: int = 8  # of exponential settling in one round of the search
    settling_rounds: int = 4  # of that search, each about the best rate of the one before
    max_settling_rate: float = 0.1  # per sample
    min_energy_share: float = 0.01  # of the record, after a break from which on the decay begins there
    max_spikes: int = 10  # single samples that are replaced
    interpolation_samples: int = 8  # on either side of a spike
    estimation_samples: int = 200  # on either side, from which the interpolation is estimated
    min_spike_ratio: float = 6.0  # of its interpolation error to the standard deviation of others
    decayed_ratio: float = 0.1  # rms of the last tenth over the largest of any tenth, below which a record has decayed
    falling_tenths: int = 6  # of decreasing level: by chance in 1 of 720 stationary records
    # of the energy, that decaying modes leave of a short free decay: 0.05 where noise is a tenth of the motion. Of 28
    # random vibrations of one to five decay times they leave 0.14 to 0.96, as accelerations; as displacements, one of
    # one decay time may leave less.
    max_residual_share: float = 0.05
    fit_modes: int = 8  # of that fit
    fit_samples: int = 600  # of that fit: fewer than the samples alias frequencies, and leave decays as they are
    fit_outputs: int = 8  # of that fit, evenly spaced among the outputs


START = StartSettings()
HIGHEST_DEGREE = 8  # of a drift; polynomials of higher degree oscillate like modes
PART = 16_384  # most samples of a part of a record in the fit of drifts
# Least number of samples to estimate the predictor and to test it.
SHORTEST = (4 + START.level_memory) * START.predictor_order
UPPER = np.triu(np.ones((START.predictor_order + 1, START.predictor_order + 1)))


def decay_start(record: Record) -> float:
    """The time from which a record is free decay, s, from its outputs alone.

    It is the first sample after the last break of the backward prediction (an impact, a release, a second impact) after
    which at least a hundredth of the motion's energy follows. At a signal-to-noise ratio of 40 dB it is found to within
    half the shortest period; at 30 dB a soft release may go undetected by displacement sensors. A record that is free
    decay throughout, or shorter than two hundred samples, begins with its first sample.

    Args:
        record: outputs that decay to rest at the end, after any motion.
    """
    signals, rounding = _scaled(record)
    n = record.n_samples
    if not signals.any():
        return float(record.start_time)
    energy_after = np.cumsum(np.einsum("jt,jt->t", signals, signals)[::-1])[::-1]
    matters = energy_after >= START.min_energy_share * energy_after[0]
    starts = np.zeros(0, int)
    step = 1
    while n > START.max_samples * step:
        step *= START.rate_ratio
    while n // step >= SHORTEST:
        window = blackman(6 * step, sym=False) if step > 1 else np.ones(1)
        window /= window.sum()
        # Weighted means end with the last sample; zero padding before the first aligns them to every `step`th sample.
        count = (n - window.size) // step + 1
        before = -(n - 1) % step
        means = upfirdn(window, np.pad(signals, ((0, 0), (before, 0))), down=step, axis=1)
        means = means[:, (before + n - 1) // step + 1 - count : (before + n - 1) // step + 1]
        first = n - window.size - step * (means.shape[1] - 1)
        ratio, breaks = _breaks(means, rounding * (window**2).sum())
        broken = first + step * np.flatnonzero(_dying_away(ratio, breaks) if step == 1 else breaks)
        broken = broken[matters[broken]]
        # A break found at a higher rate shows in every window that contains it.
        known = ((starts >= broken[:, None]) & (starts <= broken[:, None] + 2 * window.size)).any(axis=1)
        starts = np.r_[starts, broken[~known] + window.size // 2 + 1]
        step *= START.rate_ratio
    return float(record.start_time + record.sample_time * min(starts.max(initial=0), n - 1))


def decays(record: Record) -> bool:
    """Whether the outputs are a free decay: at rest in the end, falling all the time, or explained by decaying modes.

    The level of a short decay need not fall from tenth to tenth, as these hold few periods.
    """
    about = record.outputs - record.outputs[:, -max(record.n_samples // 10, 1) :].mean(axis=1, keepdims=True)
    tenths = [float((part**2).mean()) for part in np.array_split(about, 10, axis=1) if part.size]
    falling = tenths[int(np.argmax(tenths)) :]
    is_at_rest = tenths[-1] < START.decayed_ratio**2 * max(tenths)
    falls = len(falling) >= START.falling_tenths and (np.diff(falling) < 0).all()
    return bool(is_at_rest or falls or _explained(record))


def _explained(record: Record) -> bool:
    """Whether the record falls from the start of a decay on, and decaying modes leave little of it."""
    after = record.between(decay_start(record))
    stride = -(-after.n_samples // START.fit_samples)
    sensors = slice(None, None, -(-after.n_outputs // START.fit_outputs))
    outputs = after.outputs[sensors, ::stride]
    outputs = outputs - outputs.mean(axis=1, keepdims=True)
    energy = [float((part**2).sum()) for part in np.array_split(outputs, 2, axis=1)]
    if not energy[1] < energy[0]:
        return False
    part = Record(stride * after.sample_time, outputs, after.output_channels[sensors])
    try:
        poles = stacked_delays(part, n_modes=START.fit_modes).poles
    except ValueError:  # too short
        return False
    left = project(part, poles[poles.real < 0], True).residual
    return float((left**2).sum()) < START.max_residual_share * float((outputs**2).sum())


def without_spikes(record: Record) -> tuple[Record, float, tuple[str, ...]]:
    """A record without single wrong samples in its free decay, the start of the decay in s, and remarks.

    The last break of the decay may be a spike. It is replaced by interpolation between its neighbours on both sides,
    y_t = Σ_k c_k (y_{t-k} + y_{t+k}), if the decay then begins earlier. After an impact it does not, because an impact
    changes the motion.
    """
    start, remarks = decay_start(record), []
    for _ in range(START.max_spikes):
        at = round((start - record.start_time) / record.sample_time) - 1
        repaired = record.outputs.copy()
        spiked = [j for j, row in enumerate(repaired) if _repair(row, at)]
        if not spiked:
            break
        repaired_record = replace(record, outputs=repaired)
        earlier = decay_start(repaired_record)
        if earlier > start - START.predictor_order * record.sample_time:
            break
        names = ", ".join(repr(record.output_names[j]) for j in spiked)
        remarks.append(
            f"output {names} has a spike of one sample at {record.time[at]:.6g} s, replaced by interpolation"
        )
        record, start = repaired_record, earlier
    return record, start, tuple(remarks)


def _repair(row: np.ndarray, at: int) -> bool:
    """Whether a sample is a spike; if so it is replaced in place by interpolation between its neighbours."""
    k, near = START.interpolation_samples, START.estimation_samples
    if at < START.predictor_order or at + START.predictor_order >= row.size:
        return False
    part, centre = row[max(at - near, 0) : at + near + 1], min(at, near) - k
    windows = sliding_window_view(part - part.mean(), 2 * k + 1)
    both = windows[:, :k] + windows[:, :k:-1]
    others = np.abs(np.arange(len(windows)) - centre) > k
    c = np.linalg.lstsq(both[others], windows[others, k], rcond=None)[0]
    error = windows[:, k] - both @ c
    if np.abs(error[centre]) <= START.min_spike_ratio * error[others].std():
        return False
    row[at] -= error[centre]
    return True


def _scaled(record: Record) -> tuple[np.ndarray, float]:
    """Strongest combinations of the outputs relative to their final values, (n_signals, n_samples), and the variance
    of their quantisation noise."""
    outputs = record.outputs[:: -(-record.n_outputs // START.max_sensors)]
    end = np.median(outputs[:, -max(record.n_samples // 10, 1) :], axis=1, keepdims=True)
    # Differences scale sensors by their motion rather than by their drift.
    size = np.array([np.linalg.norm(np.diff(row)) for row in outputs]) / np.sqrt(max(record.n_samples - 1, 1))
    moving = size > 0
    if not moving.any():
        return np.zeros((1, record.n_samples)), 0.0
    scaled = outputs[moving] - end[moving]
    scaled /= size[moving, None]
    steps = [np.diff(np.unique(row)).min(initial=np.inf) for row in scaled]
    if len(scaled) > START.max_combinations:
        _, directions = np.linalg.eigh(scaled @ scaled.T)
        scaled = directions[:, -START.max_combinations :].T @ scaled
    return scaled, float(np.mean(np.square(steps)) / 12.0)


def _breaks(y: np.ndarray, rounding: float) -> tuple[np.ndarray, np.ndarray]:
    """Squared backward prediction error over its level, (n_samples,), and which samples are breaks, (n_samples,).

    Of signals y (n_signals, n_samples) with quantisation noise of variance `rounding`.
    """
    m, n = y.shape
    order, block = START.predictor_order, START.update_samples
    forget, forget_level = (np.exp(-block / (k * order)) for k in (START.coefficient_memory, START.level_memory))
    energy = np.r_[np.cumsum((y**2).sum(axis=0)[::-1])[::-1], 0.0]
    ridge = np.sqrt(max(rounding, 1e-24 * energy[0] / n)) * np.eye(order, order + 1)
    factor = np.zeros((0, order + 1))
    ratio, level, weight = np.zeros(n), 0.0, 0.0
    for t in range(n - order, 0, -block):
        at = np.arange(max(t - block, 0), t)
        after = y[:, at[:, None] + np.arange(1, order + 1)].reshape(-1, order)
        here = y[:, at].reshape(-1)
        if n - t >= 3 * order:
            # Quantisation noise enters as a ridge, and as the lower limit of the level.
            r = _triangular(np.vstack([factor, ridge]))
            c = dtrtrs(r[:order, :order], r[:order, order])[0]
            error = ((here - after @ c).reshape(m, -1) ** 2).mean(axis=0)
            if n - t >= (3 + START.level_memory) * order:
                ratio[at] = error / max(level / weight, rounding * (1.0 + c @ c), 1e-300)
            level, weight = forget_level * level + error.mean(), forget_level * weight + 1.0
        rows = np.vstack([np.sqrt(forget) * factor, np.column_stack([after, here])])
        factor = _triangular(rows)
    after = np.arange(1, n + 1)
    width = np.minimum(after, np.minimum(order, n - after))
    rises = energy[after] - energy[after + width] > START.energy_rise * (energy[after - width] - energy[after])
    return ratio, (ratio > START.break_ratio) | ((ratio > START.rising_ratio) & rises)


def _triangular(rows: np.ndarray) -> np.ndarray:
    """R of a QR factorisation, (at most order + 1, order + 1); directly by LAPACK, as it is called very often."""
    factored = dgeqrf(rows)[0][: START.predictor_order + 1]
    return np.asarray(factored * UPPER[: len(factored)])


def _dying_away(ratio: np.ndarray, broken: np.ndarray) -> np.ndarray:
    """Breaks (n_samples,), with lesser breaks that follow closely on another: a force that dies away."""
    broken, last = broken.copy(), -START.repeated_samples - 1
    for t in np.flatnonzero(ratio > START.repeated_ratio).tolist():
        if broken[t] or t - last <= START.repeated_samples:
            broken[t], last = True, t
    return broken


@dataclass(frozen=True, eq=False)
class _Columns:
    """Functions of time whose span is the same after a shift in time: one table serves all parts of a long record."""

    table: np.ndarray  # (at most PART, n_columns) functions of the samples of a part
    # T(s), (n_columns, n_columns), of the first sample s of a part: the columns there are table @ T(s)
    shift: Callable[[int], np.ndarray]

    @staticmethod
    def modes(poles: np.ndarray, n: int) -> "_Columns":
        """Real and imaginary parts of e^{λt} over n samples; poles λ (n_modes,) per sample."""

        def shift(first: int) -> np.ndarray:
            factor = np.exp(first * poles)
            re, im = np.diag(factor.real), np.diag(factor.imag)
            return np.block([[re, im], [-im, re]])

        decay = np.exp(np.outer(np.arange(_part(n)), poles))
        return _Columns(np.hstack([decay.real, decay.imag]), shift)

    @staticmethod
    def settling(rates: np.ndarray, n: int) -> "_Columns":
        """The exponentials e^{-rt} over n samples; rates r (n_rates,) per sample."""
        return _Columns(np.exp(-np.outer(np.arange(_part(n)), rates)), lambda first: np.diag(np.exp(-first * rates)))

    @staticmethod
    def polynomials(degree: int, n: int) -> "_Columns":
        """Legendre polynomials over n samples, to a degree. Those over a part span the same."""
        size = _part(n)
        nodes, weights = leggauss(degree + 1)
        own = legvander(nodes, degree)

        def shift(first: int) -> np.ndarray:
            at = first + (nodes + 1.0) / 2.0 * (size - 1)
            whole = legvander(-1.0 + 2.0 * at / max(n - 1, 1), degree)
            return (np.arange(degree + 1)[:, None] + 0.5) * (own.T * weights) @ whole

        return _Columns(legvander(-1.0 + 2.0 * np.arange(size) / max(size - 1, 1), degree), shift)

    def beside(self, other: "_Columns") -> "_Columns":
        """These columns, then those of another."""
        return _Columns(
            np.hstack([self.table, other.table]), lambda first: block_diag(self.shift(first), other.shift(first))
        )

    def combined(self, part: slice, weights: np.ndarray) -> np.ndarray:
        """(n_outputs, n_part) sums of the columns over a part; weights (n_columns, n_outputs)."""
        return np.asarray((self.table[: part.stop - part.start] @ (self.shift(part.start) @ weights)).T)

    def factored(self, outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R and Q^T y of a QR factorisation of the columns, part by part; outputs y (n_outputs, n_samples)."""
        k = self.table.shape[1]
        found = np.zeros((0, k + len(outputs)))
        q, r = np.linalg.qr(self.table)
        for part in _parts(outputs.shape[1]):
            size = part.stop - part.start
            if size < len(self.table):
                q, r = np.linalg.qr(self.table[:size])
            rows = np.hstack([r @ self.shift(part.start), (outputs[:, part] @ q).T])
            found = np.asarray(np.linalg.qr(np.vstack([found, rows]), mode="r"))
        return found[:k, :k], found[:k, k:]


def _part(n: int) -> int:
    """Samples of each part of n, the last of which may be shorter by fewer than there are parts."""
    return -(-n // -(-n // PART))


def _parts(n: int) -> Iterator[slice]:
    for first in range(0, n, _part(n)):
        yield slice(first, min(first + _part(n), n))


@dataclass(frozen=True, eq=False)
class Drift:
    """A drift slower than any mode, or the exponential settling of sensors with a high-pass."""

    record: Record = field(repr=False)  # without the drift; constants stay
    size: np.ndarray  # (n_outputs,) range of the drift, in the unit of each output; 0 where there is none
    time_constant: float | None = None  # s, of exponential settling; None of a polynomial drift

    @property
    def words(self) -> str:
        """Description for a remark."""
        if self.time_constant is None:
            return "a drift"
        return f"settling (time constant {self.time_constant:.3g} s)"


def without_drift(record: Record, poles: np.ndarray, *, most: int = HIGHEST_DEGREE) -> Drift:
    """A record without its drift, a polynomial in time fitted together with the modes.

        y_j = Re Σ a_jr e^{λ_r t} + Σ_k p_jk P_k(t)

    Schwarz's criterion selects the degree, among those that oscillate no faster than the slowest mode. Nothing is
    removed where noise alone would show as much in one record of a thousand. An exponential e^{-t/τ} common to all
    outputs replaces the polynomial where it is likelier.

    Args:
        poles: (n_modes,) of the modes of the free decay, rad/s; may be empty.
        most: highest degree.
    """
    n, m, dt = record.n_samples, record.n_outputs, record.sample_time
    highest = int(min(most, np.abs(poles).min(initial=np.inf) * n * dt / (2.0 * np.pi), (n - 4) // 4))
    no_drift = Drift(record, frozen(np.zeros(m)))
    if highest < 1:
        return no_drift

    modes = _Columns.modes(dt * poles, n)
    with_constant = modes.beside(_Columns.polynomials(0, n))
    fixed = 1 + 2 * poles.size
    power = (record.outputs**2).sum(axis=1)
    penalty = np.log(n * m)

    def gain(taken: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Twice the log-likelihood ratio, (n_tried,), of columns that reduce the squares of each output by `taken`."""
        before = power - (along[:fixed] ** 2).sum(axis=0)
        before, after = (np.maximum(squares, 1e-26 * power + 1e-300) for squares in (before, before - taken))
        return np.asarray(n * np.log(before / after).sum(axis=1))

    # Each column after those of the constant and the modes adds one degree.
    _, along = modes.beside(_Columns.polynomials(highest, n)).factored(record.outputs)
    ratio = gain(np.vstack([np.zeros(m), along[fixed:] ** 2]).cumsum(axis=0), along)
    degree = int(np.argmax(ratio - penalty * m * np.arange(highest + 1)))
    likely = degree > 0 and ratio[degree] >= chi2.isf(FALSE_ALARM / highest, m * degree)

    rates = np.geomspace(2.0, START.max_settling_rate * n, START.settling_rates) / (n * dt)
    for _ in range(START.settling_rounds):
        decays, tried = with_constant.beside(_Columns.settling(dt * rates, n)).factored(record.outputs)
        drift_part = decays[fixed:, fixed:]
        each = (drift_part.T @ tried[fixed:]) ** 2 / np.maximum((drift_part**2).sum(axis=0), 1e-300)[:, None]
        settles = gain(each, tried)
        best = int(np.argmax(settles))
        rate, settling = rates[best], settles[best]
        rates = np.geomspace(rates[max(best - 1, 0)], rates[min(best + 1, rates.size - 1)], START.settling_rates)
    criterion = settling - penalty * (m + 1)
    of_polynomial = ratio[degree] - penalty * m * degree if likely else 0.0
    time_constant = None
    if criterion > of_polynomial and settling > chi2.isf(FALSE_ALARM / START.settling_rates, m + 1):
        columns, time_constant = with_constant.beside(_Columns.settling(np.array([dt * rate]), n)), 1.0 / float(rate)
    elif likely:
        columns = modes.beside(_Columns.polynomials(degree, n))
    else:
        return no_drift
    weights = np.linalg.solve(*columns.factored(record.outputs))
    weights[:fixed] = 0.0  # the modes and a constant stay
    outputs, extremes = record.outputs.copy(), []
    for part in _parts(n):
        drift = columns.combined(part, weights)
        outputs[:, part] -= drift
        extremes.append((drift.min(axis=1), drift.max(axis=1)))
    return Drift(replace(record, outputs=outputs), frozen(np.ptp(extremes, axis=(0, 1))), time_constant)


def without_polynomial(outputs: np.ndarray) -> np.ndarray:
    """Outputs (n_outputs, n_samples) without the best polynomial of `HIGHEST_DEGREE` in time."""
    n = outputs.shape[1]
    columns = _Columns.polynomials(min(HIGHEST_DEGREE, n - 1), n)
    weights, remainder = np.linalg.solve(*columns.factored(outputs)), outputs.copy()
    for part in _parts(n):
        remainder[:, part] -= columns.combined(part, weights)
    return remainder
