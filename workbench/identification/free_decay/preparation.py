"""What a record is before its modes are sought: cut to its free decay, slow drift removed.

Free decay, read backwards, follows from itself: y(t) = Σ_k c_k y(t + kΔt), the same c_k for every output, for any
modes with constants and drifts besides. The c_k are learned from the end of the record on, by recursive least squares
with a short memory, and each few samples are predicted from those after them. A force breaks the rule: the
prediction error rises above its level in the samples after. The same is done at a quarter, a sixteenth, ... of the
sample rate, behind a low-pass filter that leaves free decay one, for what is too slow to be seen from sample to sample.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.linalg.lapack import dgeqrf, dtrtrs
from scipy.signal import upfirdn
from scipy.signal.windows import blackman
from scipy.stats import chi2

from workbench.identification.signal.searches import FALSE_ALARM
from workbench.records.record import Record
from workbench.structure.modes import frozen


@dataclass(frozen=True)
class StartSettings:
    """Constants of the search for the start of a decay, and for what settles in it."""

    order: int = 32  # samples that predict the one before
    block: int = 4  # samples of an update
    memory: int = 4  # orders: of the rule
    level_memory: int = 2  # orders: of the level of its errors
    most_signals: int = 8  # combinations of outputs that the rule is learnt from
    most_samples: int = 40_000  # of them, at one rate: of longer records the rate is lower
    most_sensors: int = 256  # whose combinations are sought, evenly among all: of more they take minutes
    coarser: int = 4  # from one rate to the next
    # squared prediction error over its level that is a break: alone, or where the energy of the motion also rises so
    # many times, or within so many samples of another break, for a force that dies away
    alone: float = 100.0
    rising: float = 25.0
    rise: float = 4.0
    beside: float = 16.0
    near: int = 8
    rates: int = 8  # of exponential settling that are tried at once
    rounds: int = 4  # of them, each about the best of the one before
    fastest: float = 0.1  # of these, times a sample
    least_left: float = 0.01  # of the record's energy, that must follow a break for the decay to begin there
    most_spikes: int = 10  # lone samples that are replaced
    neighbours: int = 8  # on either side, from which they are
    about: int = 200  # samples on either side, from which is learnt how
    leaps: float = 6.0  # times the error of that, of a lone sample that is wrong


START = StartSettings()
HIGHEST_DEGREE = 8  # of a drift: more oscillates as modes do
PART = 65_536  # samples that it is fitted to at once
# Fewer means are too few to learn the rule and to test it.
SHORTEST = (4 + START.level_memory) * START.order
UPPER = np.triu(np.ones((START.order + 1, START.order + 1)))


def decay_start(record: Record) -> float:
    """The time from which a record is free decay, s, from its outputs alone.

    The first sample after the last break of the rule above that a hundredth of the motion's energy follows: an impact,
    a release, a second impact. At 40 dB it is found to half the shortest period; at 30 dB a soft release may go
    undetected by sensors of displacement. A record that is free decay throughout, or shorter than two
    hundred samples, begins with its first sample.

    Args:
        record: outputs that decay to rest at the end; what came before may be anything.
    """
    signals, rounding = _scaled(record)
    n = record.n_samples
    if not signals.any():
        return float(record.start_time)
    left = np.cumsum(np.einsum("jt,jt->t", signals, signals)[::-1])[::-1]
    matters = left >= START.least_left * left[0]
    starts = np.zeros(0, int)
    step = 1
    while n > START.most_samples * step:
        step *= START.coarser
    while n // step >= SHORTEST:
        window = blackman(6 * step, sym=False) if step > 1 else np.ones(1)
        window /= window.sum()
        # Means end with the last sample; zeros before the first put them where every `step`th is.
        count = (n - window.size) // step + 1
        before = -(n - 1) % step
        means = upfirdn(window, np.pad(signals, ((0, 0), (before, 0))), down=step, axis=1)
        means = means[:, (before + n - 1) // step + 1 - count : (before + n - 1) // step + 1]
        first = n - window.size - step * (means.shape[1] - 1)
        ratio, breaks = _breaks(means, rounding * (window**2).sum())
        broken = first + step * np.flatnonzero(_dying_away(ratio, breaks) if step == 1 else breaks)
        broken = broken[matters[broken]]
        # A break known already from more samples is seen by every window that holds it.
        known = ((starts >= broken[:, None]) & (starts <= broken[:, None] + 2 * window.size)).any(axis=1)
        starts = np.r_[starts, broken[~known] + window.size // 2 + 1]
        step *= START.coarser
    return float(record.start_time + record.sample_time * min(starts.max(initial=0), n - 1))


def without_spikes(record: Record) -> tuple[Record, float, tuple[str, ...]]:
    """A record whose free decay goes on about lone samples that are wrong, when it begins in s, and remarks.

    A sample that ends the search for the start is replaced by what its neighbours on both sides say, y_t = Σ_k c_k
    (y_{t-k} + y_{t+k}), where the decay then begins earlier: a blow, too, leaves another motion than was before.
    """
    start, remarks = decay_start(record), []
    for _ in range(START.most_spikes):
        at = round((start - record.start_time) / record.sample_time) - 1
        repaired = record.outputs.copy()
        wrong = [j for j, row in enumerate(repaired) if _repair(row, at)]
        if not wrong:
            break
        other = replace(record, outputs=repaired)
        earlier = decay_start(other)
        if earlier > start - START.order * record.sample_time:
            break
        names = ", ".join(repr(record.output_names[j]) for j in wrong)
        remarks.append(
            f"output {names} leaps at {record.time[at]:.6g} s for one sample, replaced by what its neighbours say"
        )
        record, start = other, earlier
    return record, start, tuple(remarks)


def _repair(row: np.ndarray, at: int) -> bool:
    """Replace a sample that its neighbours do not expect, in place; whether it was."""
    k, near = START.neighbours, START.about
    if at < START.order or at + START.order >= row.size:
        return False
    part, centre = row[max(at - near, 0) : at + near + 1], min(at, near) - k
    windows = np.lib.stride_tricks.sliding_window_view(part - part.mean(), 2 * k + 1)
    both = windows[:, :k] + windows[:, :k:-1]
    others = np.abs(np.arange(len(windows)) - centre) > k
    c = np.linalg.lstsq(both[others], windows[others, k], rcond=None)[0]
    error = windows[:, k] - both @ c
    if np.abs(error[centre]) <= START.leaps * error[others].std():
        return False
    row[at] -= error[centre]
    return True


def _scaled(record: Record) -> tuple[np.ndarray, float]:
    """Strongest combinations of the outputs about where they end, (n_signals, n_samples), and the variance that
    rounding to the sensors' steps leaves in them."""
    outputs = record.outputs[:: -(-record.n_outputs // START.most_sensors)]
    end = np.median(outputs[:, -max(record.n_samples // 10, 1) :], axis=1, keepdims=True)
    # Differences weigh sensors by how they move, not by how they drift.
    size = np.array([np.linalg.norm(np.diff(row)) for row in outputs]) / np.sqrt(max(record.n_samples - 1, 1))
    moving = size > 0
    if not moving.any():
        return np.zeros((1, record.n_samples)), 0.0
    scaled = outputs[moving] - end[moving]
    scaled /= size[moving, None]
    steps = [np.diff(np.unique(row)).min(initial=np.inf) for row in scaled]
    if len(scaled) > START.most_signals:
        _, directions = np.linalg.eigh(scaled @ scaled.T)
        scaled = directions[:, -START.most_signals :].T @ scaled
    return scaled, float(np.mean(np.square(steps)) / 12.0)


def _breaks(y: np.ndarray, rounding: float) -> tuple[np.ndarray, np.ndarray]:
    """Squared prediction error over its level (n_samples,), and which samples break the rule."""
    m, n = y.shape
    order, block = START.order, START.block
    forget, forget_level = (np.exp(-block / (k * order)) for k in (START.memory, START.level_memory))
    energy = np.r_[np.cumsum((y**2).sum(axis=0)[::-1])[::-1], 0.0]
    ridge = np.sqrt(max(rounding, 1e-24 * energy[0] / n)) * np.eye(order, order + 1)
    factor = np.zeros((0, order + 1))
    ratio, level, weight = np.zeros(n), 0.0, 0.0
    for t in range(n - order, 0, -block):
        at = np.arange(max(t - block, 0), t)
        after = y[:, at[:, None] + np.arange(1, order + 1)].reshape(-1, order)
        here = y[:, at].reshape(-1)
        if n - t >= 3 * order:
            # Rounding enters as a ridge, and as the least level.
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
    rises = energy[after] - energy[after + width] > START.rise * (energy[after - width] - energy[after])
    return ratio, (ratio > START.alone) | ((ratio > START.rising) & rises)


def _triangular(rows: np.ndarray) -> np.ndarray:
    """R of an orthogonal factorisation, (at most order + 1, order + 1); straight from LAPACK, for it is called so
    often."""
    factored = dgeqrf(rows)[0][: START.order + 1]
    return np.asarray(factored * UPPER[: len(factored)])


def _dying_away(ratio: np.ndarray, broken: np.ndarray) -> np.ndarray:
    """Breaks and the lesser ones that follow them closely."""
    broken, last = broken.copy(), -START.near - 1
    for t in np.flatnonzero(ratio > START.beside).tolist():
        if broken[t] or t - last <= START.near:
            broken[t], last = True, t
    return broken


@dataclass(frozen=True, eq=False)
class Drift:
    """Drift slower than any mode, or the settling of sensors that pass no constant.

    Attributes:
        record: without it; constants stay.
        size: (n_outputs,) from its lowest to its highest, in the unit of each output; 0 where there is none.
        time_constant: s, of what settles exponentially, as an accelerometer with a high-pass does; None of a drift.
    """

    record: Record = field(repr=False)
    size: np.ndarray
    time_constant: float | None = None

    @property
    def words(self) -> str:
        """What it is."""
        if self.time_constant is None:
            return "a drift"
        return f"settling (time constant {self.time_constant:.3g} s)"


def without_drift(record: Record, poles: np.ndarray, *, most: int = HIGHEST_DEGREE) -> Drift:
    """A record less a polynomial in time, fitted beside its modes: y_j = Re Σ a_jr e^{λ_r t} + Σ_k p_jk P_k(t).

    The degree is the least, of those that oscillate no faster than the slowest mode, by Schwarz's criterion; and
    nothing is taken where noise alone would show as much in one record of a thousand. One decay e^{-t/τ} of all outputs
    takes the place of a polynomial where it is likelier.

    Args:
        record: free decay.
        poles: (n_modes,) of its modes, rad/s; may be empty.
        most: highest degree.
    """
    n, m, dt = record.n_samples, record.n_outputs, record.sample_time
    highest = int(min(most, np.abs(poles).min(initial=np.inf) * n * dt / (2.0 * np.pi), (n - 4) // 4))
    nothing = Drift(record, frozen(np.zeros(m)))
    if highest < 1:
        return nothing

    def beside(slow: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """R and Q^T y of a constant, the modes and what is slow."""

        def columns(at: np.ndarray) -> np.ndarray:
            decay = np.exp(np.outer(dt * at, poles))
            return np.hstack([np.ones((at.size, 1)), decay.real, decay.imag, slow(at)])

        return _factored(columns, record.outputs)

    fixed = 1 + 2 * poles.size
    power = (record.outputs**2).sum(axis=1)
    a_number = np.log(n * m)

    def gain(taken: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Twice the logarithm of the likelihood ratio by what further columns take of each output, (n_tried, m)."""
        before = power - (along[:fixed] ** 2).sum(axis=0)
        before, after = (np.maximum(left, 1e-26 * power + 1e-300) for left in (before, before - taken))
        return np.asarray(n * np.log(before / after).sum(axis=1))

    # Columns beyond constant and modes add one degree after the other.
    r, along = beside(lambda at: _polynomials(at, n, highest)[:, 1:])
    ratio = gain(np.vstack([np.zeros(m), along[fixed:] ** 2]).cumsum(axis=0), along)
    degree = int(np.argmax(ratio - a_number * m * np.arange(highest + 1)))
    likely = degree > 0 and ratio[degree] >= chi2.isf(FALSE_ALARM / highest, m * degree)

    rates = np.geomspace(2.0, START.fastest * n, START.rates) / (n * dt)
    for _ in range(START.rounds):
        decays, tried = beside(_decays(dt * rates))
        own = decays[fixed:, fixed:]
        each = (own.T @ tried[fixed:]) ** 2 / np.maximum((own**2).sum(axis=0), 1e-300)[:, None]
        settles = gain(each, tried)
        best = int(np.argmax(settles))
        found = rates[best], settles[best]
        rates = np.geomspace(rates[max(best - 1, 0)], rates[min(best + 1, rates.size - 1)], START.rates)
    rate, settling = found
    paid = settling - a_number * (m + 1)
    unless = ratio[degree] - a_number * m * degree if likely else 0.0
    if paid > unless and settling > chi2.isf(FALSE_ALARM / START.rates, m + 1):
        settled = _decays(dt * rate)
        return _less(record, fixed, *beside(settled), settled, 1.0 / float(rate))
    if not likely:
        return nothing
    kept = fixed + degree
    return _less(record, fixed, r[:kept, :kept], along[:kept], lambda at: _polynomials(at, n, degree)[:, 1:])


def _decays(rates: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Columns (n_at, n_rates) at some samples, of rates a sample."""
    return lambda at: np.asarray(np.exp(-np.outer(at, rates)))


def _less(
    record: Record,
    fixed: int,
    r: np.ndarray,
    along: np.ndarray,
    slow: Callable[[np.ndarray], np.ndarray],
    time_constant: float | None = None,
) -> Drift:
    """A record less what is slow in it, of its factored columns."""
    weights = np.linalg.solve(r, along)[fixed:]
    m = record.n_outputs
    outputs, lowest, topmost = record.outputs.copy(), np.full(m, np.inf), np.full(m, -np.inf)
    for part in _parts(record.n_samples):
        drift = (slow(np.arange(part.start, part.stop)) @ weights).T
        outputs[:, part] -= drift
        lowest, topmost = (np.minimum(lowest, drift.min(axis=1)), np.maximum(topmost, drift.max(axis=1)))
    return Drift(replace(record, outputs=outputs), frozen(topmost - lowest), time_constant)


def without_polynomial(outputs: np.ndarray) -> np.ndarray:
    """(n_outputs, n_samples) less the polynomial of `HIGHEST_DEGREE` in time that fits each best."""
    n = outputs.shape[1]
    degree = min(HIGHEST_DEGREE, n - 1)
    r, along = _factored(lambda at: _polynomials(at, n, degree), outputs)
    weights, about = np.linalg.solve(r, along), outputs.copy()
    for part in _parts(n):
        about[:, part] -= (_polynomials(np.arange(part.start, part.stop), n, degree) @ weights).T
    return about


def _polynomials(at: np.ndarray, n: int, degree: int) -> np.ndarray:
    """Legendre polynomials over n samples, at some of them, (n_at, degree + 1)."""
    return np.asarray(legvander(-1.0 + 2.0 * at / max(n - 1, 1), degree))


def _parts(n: int) -> Iterator[slice]:
    for first in range(0, n, PART):
        yield slice(first, min(first + PART, n))


def _factored(columns: Callable[[np.ndarray], np.ndarray], outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R and Q^T y of columns over time, part by part, as the columns of a long record would fill the memory."""
    r = np.zeros((0, 0))
    for part in _parts(outputs.shape[1]):
        rows = np.hstack([columns(np.arange(part.start, part.stop)), outputs[:, part].T])
        r = np.asarray(np.linalg.qr(np.vstack([r.reshape(-1, rows.shape[1]), rows]), mode="r"))
    k = r.shape[1] - len(outputs)
    return r[:k, :k], r[:k, k:]
