"""Two linear modes that overlap in one sensor, or one whose frequency and damping depend on amplitude?

The envelope r and phase θ of the one follow a backbone, smooth and one for each amplitude (Nayfeh & Mook 1979, 2.3),

    r' = -σ(r) r,   θ' = ω(r),   -σ + iω = Σ_k λ_k r^p_k,      y = Re A exp(Σ_k λ_k ∫ r^p_k dt),   r(0) = 1

with powers p of 0, 1, 2 (stiffness and damping that rise or fall), 0, ½, 1 (joints that slip) or -1, 0, 1 (friction):
eight parameters with A, as many as two linear modes have, so that the likelier model is preferred.

Of several records two linear modes have the same poles in all. One mode has a backbone of all, λ_k a_i^p_k in the
record that begins with amplitude a_i; or each record has a pole or a backbone of its own, as clamping, warmth and what
was loaded before differ from test to test. The more parameters are paid for by Schwarz's criterion.

The models are compared in the lines of the transform about the two. There modes elsewhere, found or not, leave but a
polynomial of low degree, as z in Σ_t z^t e^-iωt = (1 - z^n) / (1 - z e^-iω) is far from e^iω. So does what a sum over
every D-th sample of a long record lacks, by Euler's and Maclaurin's formula: terms of the ends, derivatives of the
motion times powers of D.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.fft import fft, rfft

from workbench.arrays import Complexes, Floats
from workbench.identification.signal.projection import project
from workbench.identification.signal.searches import FIT, Once
from workbench.records.record import Record


@dataclass(frozen=True)
class BackboneSettings:
    """Constants of the comparison."""

    steps: int = 150  # of the envelope in time
    faded: float = 7.0  # nepers from which on the backbone stays as it is
    died: float = 60.0  # nepers to which the envelope is followed
    first_tries: int = 20  # evaluations of the fit from each start
    most_tries: int = 40  # and of the best of them
    settled: float = 1e-4  # of the sum of squares: a lesser decrease ends it
    lasts: float = 14.0  # nepers of the slower of two modes, after which a record tells nothing of them: e^-14 is 1e-6
    samples_each: int = 20  # for each mode, that such a record holds at least
    slightly: float = 1e-5  # of the decay rate: step of differences
    largest: float = 1e100  # beyond this a motion diverges
    beyond: float = 10.0  # times the record: what its residual is then taken for
    lines: float = 10.0  # and
    bandwidths: float = 4.0  # about the two, in which they are compared
    smooth: int = 4  # coefficients of the polynomial that modes elsewhere leave there
    few: int = 1000  # samples, of more a motion is taken at every so many
    turns: float = 0.25  # rad from the middle of the band to its end within a step, at most: 1e-8 of a sample is left
    narrow: float = 0.1  # of the frequency, of a band in which the motion's mirror image is such a polynomial too


BACKBONE = BackboneSettings()
POWERS = ((0.0, 1.0, 2.0), (0.0, 0.5, 1.0), (0.0, -1.0, 1.0))


def are_two(records: Sequence[Record], poles: Complexes, r: int, s: int, threshold: float) -> bool:
    """Whether modes r and s are likelier than one on a backbone of each record, or of all.

    Args:
        records: free decay, of one output.
        poles: (n_modes,) of a fit with both, rad/s.
        r, s: which may be one.
        threshold: of twice the logarithm of the likelihood ratio, for a model of no more parameters.
    """
    pair, others = poles[[r, s]], np.delete(poles, [r, s])
    bands = [_Band(record, pair, others) for record in records]
    size = np.array([band.size for band in bands])
    floor = np.array([band.round_off for band in bands])
    both = _left_by_modes(bands, pair)

    def gains(one: Floats) -> Floats:
        return np.asarray(size * np.log((one + floor) / (both + floor)))

    # Of n records two modes have 4 + 4 n parameters; one has 4 n by a pole of each, 8 n by a backbone of each, and
    # 5 + 3 n by one of all.
    price = float(np.log(size.sum())) if len(records) > 1 else 0.0
    own = np.array([_left_by_modes([band], pair[[np.argmax(np.abs(band.amplitudes))]])[0] for band in bands])
    gain = gains(own) - 4.0 * price / len(records)
    enough = both * np.exp((threshold - 4.0 * price * (1.0 - 1.0 / len(records))) / size)
    for i in np.argsort(-gain):
        if gain.sum() <= threshold:
            return False
        own[i] = left_by_backbone(bands[i], pair, enough=float(enough[i]))
        gain[i] = min(gain[i], gains(own)[i] + 4.0 * price * (1.0 - 1.0 / len(records)))
    if gain.sum() <= threshold:
        return False
    if len(records) == 1:
        return True
    common = left_by_common_backbone(bands, np.sqrt(size / (both + floor)), pair)
    return float(gains(common).sum()) > (len(records) - 1) * price


def band_about(pair: Complexes, bin_width: float) -> tuple[float, float]:
    """Centre and half width of the band in which two modes are compared, rad/s."""
    low, high = float(pair.imag.min()), float(pair.imag.max())
    wide = BACKBONE.bandwidths * float(np.abs(pair.real).sum()) + BACKBONE.lines * bin_width
    return 0.5 * (low + high), 0.5 * (high - low) + wide


class _Band:
    """The lines of a record about two modes, for as long as these last; without what is elsewhere.

    Attributes:
        time: (n_times,) s, of the samples at which motions are taken: all, or every `step`-th.
        y: (2 n_lines,) real and imaginary parts of the lines, each of the noise that a sample has.
        amplitudes: (2,) complex, of the two.
        size: degrees of freedom of y.
        round_off: of a sum of squares.
    """

    def __init__(self, record: Record, pair: Complexes, others: Complexes) -> None:
        record = while_it_lasts(record, pair, pair.size + others.size)
        dt = record.sample_time
        half = band_about(pair, 2.0 * np.pi / (record.n_samples * dt))[1]
        self.step = max(int(min(record.n_samples / BACKBONE.few, BACKBONE.turns / (half * dt))), 1)
        if half > BACKBONE.narrow * float(pair.imag.min()):
            self.step = 1
        n = record.n_samples // self.step * self.step
        y, time = record.outputs[0, :n], dt * np.arange(n, dtype=float)
        self.time: Floats = time[:: self.step]
        middle, half = band_about(pair, 2.0 * np.pi / (n * dt))
        first, last = (int(np.ceil((middle + side * half) * n * dt / (2.0 * np.pi))) for side in (-1.0, 1.0))
        self.lines = np.arange(max(first, 1), max(min(last, (n + 1) // 2), 2))
        amplitudes = project(record, np.append(pair, others), True).complex_amplitudes[0]
        self.amplitudes = amplitudes[:2]
        within = np.abs(others.imag - middle) < half + np.abs(others.real)
        elsewhere = (amplitudes[2:][~within] @ np.exp(np.outer(others[~within], time))).real
        beside = np.hstack(self.seen(np.exp(np.outer(others[within], self.time))))
        smooth = np.linspace(-1.0, 1.0, self.lines.size)[:, None] ** np.arange(BACKBONE.smooth)
        beside = np.hstack([beside, np.kron(np.eye(2), smooth)])
        self.beside = np.linalg.qr(beside / np.maximum(np.linalg.norm(beside, axis=0), 1e-300))[0]
        lines = rfft(y - elsewhere)[self.lines] / np.sqrt(0.5 * n)
        self.y = self.apart(np.r_[lines.real, lines.imag])
        self.size = max(self.y.size - beside.shape[1], 1)
        self.round_off = FIT.round_off * float(y @ y) + 1e-300

    def seen(self, motions: np.ndarray) -> tuple[Floats, Floats]:
        """The lines, (2 n_lines, n_motions), of the real and the imaginary parts of motions (n_motions, n_times)."""
        m = self.time.size
        found = fft(motions, axis=1) * np.sqrt(self.step / (0.5 * m))
        one, other = found[:, self.lines % m].T, np.zeros(())
        if self.step == 1:
            other = found[:, -self.lines].conj().T
        real, imaginary = 0.5 * (one + other), -0.5j * (one - other)
        return np.vstack([real.real, real.imag]), np.vstack([imaginary.real, imaginary.imag])

    def apart(self, columns: Floats) -> Floats:
        return np.asarray(columns - self.beside @ (self.beside.T @ columns))

    def left(self, motions: Complexes, slopes: Complexes, which: Sequence[int]) -> tuple[Floats, Floats]:
        """What motions (n_motions, n_times) leave, A projected out (Kaufman 1975), and how that goes with unknowns.

        Args:
            motions: complex, of free amplitudes A.
            slopes: (n_unknowns, n_times) of a motion by each unknown.
            which: motion that each unknown is of.
        """
        if not (np.abs(slopes) < BACKBONE.largest).all():
            return BACKBONE.beyond * np.abs(self.y), np.zeros((self.y.size, len(slopes)))
        real, imaginary = self.seen(np.vstack([motions, slopes]))
        p = len(motions)
        q, r = np.linalg.qr(self.apart(np.hstack([real[:, :p], imaginary[:, :p]])))
        along = q.T @ self.y
        a, b = np.linalg.lstsq(r, along, rcond=1e-12)[0].reshape(2, p)[:, list(which)]
        columns = self.apart(real[:, p:] * a + imaginary[:, p:] * b)
        return self.y - q @ along, -(columns - q @ (q.T @ columns))


def while_it_lasts(record: Record, pair: np.ndarray, n_modes: int) -> Record:
    """The part of a free decay that tells of two of its modes, poles in rad/s."""
    last = BACKBONE.lasts / max(float(-pair.real.max()) * record.sample_time, 1e-300)
    last = max(last, BACKBONE.samples_each * n_modes)
    if last >= record.n_samples - 1:
        return record
    return record.between(record.start_time, record.start_time + int(last) * record.sample_time)


def _least(once: Once, start: Floats, most_tries: int = BACKBONE.most_tries) -> Floats:
    return once.least(start, most_tries, ftol=BACKBONE.settled)


class _Modes:
    """Linear modes of the same poles in all records."""

    def __init__(self, bands: Sequence[_Band], weights: Floats) -> None:
        self.bands, self.weights = bands, weights

    def each(self, unknowns: Floats) -> list[tuple[Floats, Floats]]:
        poles, found = unknowns[: unknowns.size // 2] + 1j * unknowns[unknowns.size // 2 :], []
        for band in self.bands:
            with np.errstate(over="ignore", invalid="ignore"):
                motions = np.exp(np.outer(poles, band.time))
                slopes = band.time * motions
                found.append(band.left(motions, np.vstack([slopes, 1j * slopes]), [*range(poles.size)] * 2))
        return found

    def fitted(self, unknowns: Floats) -> tuple[Floats, Floats]:
        each = self.each(unknowns)
        return (
            np.concatenate([w * left for w, (left, _) in zip(self.weights, each, strict=True)]),
            np.vstack([w * slopes for w, (_, slopes) in zip(self.weights, each, strict=True)]),
        )


def _left_by_modes(bands: Sequence[_Band], poles: Complexes) -> Floats:
    """Sums of squares of each record, (n_records,), that modes near some poles leave where they are likeliest."""
    at = np.r_[poles.real, poles.imag]
    model = _Modes(bands, np.ones(len(bands)))
    if len(bands) > 1:
        left = np.array([float(e @ e) for e, _ in model.each(at)])
        model.weights = np.sqrt([band.size for band in bands] / (left + [band.round_off for band in bands]))
    at = _least(Once(model.fitted), at)
    return np.array([float(left @ left) for left, _ in model.each(at)])


def left_by_backbone(band: _Band, pair: Complexes, *, enough: float = 0.0) -> float:
    """Least sum of squares that one mode on a backbone leaves, in place of two linear ones.

    Args:
        band: about the two.
        pair: (2,) poles of the two, rad/s.
        enough: what need not be gone below.
    """
    tried: list[tuple[float, _Backbone, Floats]] = []
    for powers in POWERS:
        model = _Backbone(band, np.array(powers))
        for start in model.starts(pair):
            at = _least(model.once, start, BACKBONE.first_tries)
            tried.append((float((model.once(at)[0] ** 2).sum()), model, at))
            if tried[-1][0] <= enough:
                return tried[-1][0]
    _, model, at = min(tried, key=lambda each: each[0])
    return float((model.once(_least(model.once, at))[0] ** 2).sum())


def left_by_common_backbone(bands: Sequence[_Band], weights: Floats, pair: Complexes) -> Floats:
    """The same of each of several records, (n_records,), one backbone for all: where their weighted sum is least.

    Args:
        bands: one per record.
        weights: (n_records,) 1 / noise.
        pair: as for one.
    """
    models = [_Common([_Backbone(band, np.array(powers)) for band in bands], weights) for powers in POWERS]
    first = [_least(model.once, model.start(pair), BACKBONE.first_tries) for model in models]
    best = int(np.argmin([(model.once(at)[0] ** 2).sum() for model, at in zip(models, first, strict=True)]))
    return models[best].left(_least(models[best].once, first[best]))


@njit(cache=True, nogil=True)
def _rate(u: float, real: Floats, powers: Floats, faded: float) -> float:
    """u' of u = -ln r."""
    return -float(np.sum(real * np.exp(-min(max(u, -1.0), faded) * powers)))


@njit(cache=True, nogil=True)
def _envelopes(real: Floats, powers: Floats, t: Floats, faded: float, died: float) -> tuple[Floats, Floats]:
    """u = -ln r and u' at the times t, (n_times, n_rows), for each row of Re λ (n_rows, 3)."""
    h, u, rates = t[1], np.zeros((t.size, len(real))), np.zeros((t.size, len(real)))
    for j in range(len(real)):
        row = real[j]
        for k in range(t.size):
            at = u[k, j]
            rates[k, j] = a = _rate(at, row, powers, faded)
            if k + 1 < t.size:
                b = _rate(at + 0.5 * h * a, row, powers, faded)
                c = _rate(at + 0.5 * h * b, row, powers, faded)
                d = _rate(at + h * c, row, powers, faded)
                u[k + 1, j] = min(max(at + h / 6.0 * (a + 2.0 * b + 2.0 * c + d), -1.0), died)
    return u, rates


@njit(cache=True, nogil=True)
def _integrals(u: Floats, rates: Floats, powers: Floats, time: Floats, h: float, faded: float) -> Floats:
    """∫ r^p_k dt at samples, (n_rows, n, 3), of u and u' (n_rows, n_times): cubic between these, as Hermite has it."""
    n_rows, n_times = u.shape
    found = np.empty((n_rows, time.size, powers.size))
    value, slope, until = np.empty(n_times), np.empty(n_times), np.empty(n_times)
    for i in range(n_rows):
        for k in range(powers.size):
            for j in range(n_times):
                value[j] = np.exp(-min(max(u[i, j], -1.0), faded) * powers[k])
                slope[j] = -powers[k] * value[j] * rates[i, j] * h if u[i, j] < faded else 0.0
            until[0] = 0.0
            for j in range(n_times - 1):
                until[j + 1] = until[j] + h * (0.5 * (value[j] + value[j + 1]) + (slope[j] - slope[j + 1]) / 12.0)
            for m in range(time.size):
                j = min(int(time[m] / h), n_times - 2)
                x = time[m] / h - j
                rise = value[j + 1] - value[j]
                square, cube = 3.0 * rise - 2.0 * slope[j] - slope[j + 1], slope[j] + slope[j + 1] - 2.0 * rise
                found[i, m, k] = until[j] + h * x * (
                    value[j] + x * (slope[j] / 2.0 + x * (square / 3.0 + x * cube / 4.0))
                )
    return found


def backbone_integrals(real: np.ndarray, powers: np.ndarray, time: np.ndarray) -> list[Floats]:
    """∫ r^p_k dt from 0 to each time, (n, n_powers), for each row of Re λ (n_rows, n_powers), after Runge and Kutta."""
    t = np.linspace(0.0, time[-1], BACKBONE.steps + 1)
    u, rates = _envelopes(real, powers, t, BACKBONE.faded, BACKBONE.died)
    return list(_integrals(u.T.copy(), rates.T.copy(), powers, time, t[1], BACKBONE.faded))


class _Backbone:
    """The fit of one law of powers; what is linear in the record drops out."""

    def __init__(self, band: _Band, powers: np.ndarray) -> None:
        self.band, self.time, self.powers = band, band.time, powers
        self.once = Once(self.fitted)

    def starts(self, pair: np.ndarray) -> Iterator[Floats]:
        """From what the two look like, z: their own z'/z by |z|; and from the stronger of them."""
        columns, slope, _ = self.alike(pair)
        alike = np.linalg.lstsq(columns, slope, rcond=None)[0]
        for start in (alike, np.array([pair[np.argmax(np.abs(self.band.amplitudes))], 0.0, 0.0])):
            yield np.r_[start.real, start.imag]

    def alike(self, pair: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Columns |z|^p_k z, z' and |z(0)|, of what the two look like; |z| in units of its beginning."""
        each = self.band.amplitudes * np.exp(np.outer(self.time, pair))
        z, slope = each.sum(axis=1), (each * pair).sum(axis=1)
        begun = max(abs(z[0]), 1e-3 * np.abs(z).max())
        by_power = np.maximum(np.abs(z) / begun, np.exp(-BACKBONE.faded))[:, None] ** self.powers
        return z[:, None] * by_power, slope, float(begun)

    def fitted(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is left and its slopes by Re λ and Im λ, (2 n_lines, 6)."""
        real, turn = unknowns[:3], 1j * unknowns[3:]
        step = BACKBONE.slightly * max(abs(real[0]), 1e-3 / self.time[-1])
        held, *moved = backbone_integrals(np.vstack([real, real + step * np.eye(3)]), self.powers, self.time)
        with np.errstate(over="ignore", invalid="ignore"):
            motion = np.exp(held @ (real + turn))
            by_real = [motion * ((h - held) @ (real + turn) / step + h[:, k]) for k, h in enumerate(moved)]
            return self.band.left(motion[None], np.vstack([by_real, 1j * motion * held.T]), [0] * 6)


class _Common:
    """The fit of one law of powers to several records at once: λ, and ln a_i of all but the strongest record."""

    def __init__(self, each: Sequence[_Backbone], weights: Floats) -> None:
        self.each, self.weights, self.powers = each, weights, each[0].powers
        self.once = Once(self.fitted)

    def start(self, pair: np.ndarray) -> Floats:
        """From what the two look like in all of them."""
        columns, slopes, begun = zip(*(one.alike(pair) for one in self.each), strict=True)
        level = np.log(np.maximum(begun, 1e-9 * max(begun) + 1e-300))
        self.free = np.delete(np.arange(level.size), np.argmax(level))
        level -= level.max()
        scaled = [w * c * np.exp(a * self.powers) for w, c, a in zip(self.weights, columns, level, strict=True)]
        known = np.concatenate([w * slope for w, slope in zip(self.weights, slopes, strict=True)])
        start = np.linalg.lstsq(np.vstack(scaled), known, rcond=None)[0]
        return np.concatenate([start.real, start.imag, level[self.free]])

    def left(self, unknowns: Floats) -> Floats:
        """Sum of squares of each record, (n_records,)."""
        return np.array([float(left @ left) for left, *_ in self._parts(unknowns)])

    def fitted(self, unknowns: Floats) -> tuple[Floats, Floats]:
        """What is left of all and its slopes by the unknowns."""
        lefts, columns = [], []
        for i, (w, (left, slopes, own, by)) in enumerate(zip(self.weights, self._parts(unknowns), strict=True)):
            along = slopes @ (np.tile(self.powers, 2) * own)
            lefts.append(w * left)
            columns.append(w * np.column_stack([slopes * by, np.outer(along, self.free == i)]))
        return np.concatenate(lefts), np.vstack(columns)

    def _parts(self, unknowns: Floats) -> Iterator[tuple[Floats, Floats, Floats, Floats]]:
        """Of each record: what is left, its slopes, its own six unknowns and what these are those of all times."""
        level = np.zeros(len(self.each))
        level[self.free] = np.clip(unknowns[6:], -BACKBONE.died, BACKBONE.died)
        for one, a in zip(self.each, level, strict=True):
            by = np.tile(np.exp(a * self.powers), 2)
            yield *one.once(by * unknowns[:6]), by * unknowns[:6], by
