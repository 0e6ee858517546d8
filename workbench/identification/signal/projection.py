"""The projection of a record on given poles, amplitudes free, its residual, and the noise that this is.

y_j = Φ c_j + r_j, Φ = [e^{-σt} cos ω_d t, e^{-σt} sin ω_d t] and, where asked for, a column of ones. All derivatives of
Φ by the poles lie in the span of tΦ. In a long record the matrices ΦᵀΦ, ΦᵀtΦ, (tΦ)ᵀtΦ are sums of powers

    S_k(w) = Σ_{i<N} i^k w^i,     w = μ_r μ_s and μ_r μ_s*,   μ = e^{λΔt},

which doubling gives in log N steps, and an exponential is left out where it has decayed below round-off.

Whitening: the residual of an output is modelled as y_k = Σ_i a_i y_k-i + e_k (Yule & Walker), and the record filtered
by 1 - Σ_i a_i z^-i. A free decay stays a free decay of the same poles.

Where outputs share noise of correlation C, combinations C^-½ y / s whose noise is independent are filtered instead: the
same holds of them.

Variance: residuals of one day have one noise, and short records know it better together. Bartlett's statistic tests
that (Proc. R. Soc. A 160, 1937): with ν_i degrees of freedom behind the variance v_i of record i, and v of all,

    B = (ν ln v - Σ ν_i ln v_i) / (1 + (Σ 1/ν_i - 1/ν) / (3 (n_records - 1))),     chi-square of n_records - 1.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.fft import rfft
from scipy.linalg import cho_factor, cho_solve, qr, solve_toeplitz, solve_triangular
from scipy.signal import lfilter
from scipy.stats import chi2

from workbench.arrays import Complexes, Floats
from workbench.records.record import Record


@dataclass(frozen=True)
class ProjectionSettings:
    """Constants of projections and of what is said of their noise."""

    largest_factored: int = 300_000  # samples by modes up to which Φ is factored, block by block
    longest_factored: int = 20_000  # samples, likewise: beyond, normal equations take less time
    many: int = 1_000_000  # samples of a transform whose tables are not kept
    part: int = 8192  # samples of a part of a longer record, whole blocks
    block: int = 256  # samples of a block of a part
    died_away: float = 41.0  # nepers: e^-41 is below the last digit of 1
    summed: float = 1e-14  # round-off of squares that are a difference of sums over the record, as a share of these
    split: float = 0.05  # chance that records of one noise are each given their own, which costs little
    false_alarm: float = 1e-3  # chance that white noise is taken for coloured
    least_bins: int = 6  # over which a spectrum is averaged
    own: float = 1e-3  # share of an output's noise, at least, that no other output has
    band: int = 32  # lines in which the correlation of noise is taken
    harmless: float = 1.2  # variance of the combination that shares most, over that of an output: less alters nothing
    at_once: int = 2**21  # products of outputs, in all bands, that are held at once: 16 MB
    of_median: float = 0.25  # samples that the median over bands is worth, of the mean without a window
    order: int = 12  # of the autoregressive model of coloured noise
    samples_each: int = 40  # for each of its coefficients; for each output, where noise that they share is asked for
    rounding: float = 1e-9  # residual of records without noise, relative
    spectra_alike: float = 0.1  # rms of log ratios below which two spectra are the same
    most_taken: float = 0.9  # leverage at most: a line that the fit took whole says nothing of its noise


PROJECTION = ProjectionSettings()


def pole_blocks(a: np.ndarray, b: np.ndarray, gram: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[Floats, Floats]:
    """Gauss-Newton matrix (2 n, 2 n) and right-hand side (2 n,) of complex unknowns, real parts first.

    Of readings Re Σ (a - ib) z whose tangents ∂z, real and imaginary parts, are known projected:

    Args:
        a, b: (n, n_outputs) cosine and sine amplitudes, in units of the noise.
        gram: (2 n, 2 n) of the tangents among themselves.
        x, y: (n, n_outputs) of their real and imaginary parts with the residual, in units of the noise.
    """
    n = len(a)
    aa, ab, bb = a @ a.T, a @ b.T, b @ b.T
    (cc, cs), (sc, ss) = gram.reshape(2, n, 2, n).transpose(0, 2, 1, 3)
    cross = ab * cc - aa * cs + bb * sc - ab.T * ss
    upper, lower = aa * cc + ab * cs + ab.T * sc + bb * ss, bb * cc - ab.T * cs - ab * sc + aa * ss
    return np.block([[upper, cross], [cross.T, lower]]), np.r_[(a * x + b * y).sum(axis=1), (b * x - a * y).sum(axis=1)]


@dataclass(frozen=True, eq=False)
class Projection:
    """A record projected on the columns Φ of given poles."""

    record: Record = field(repr=False)
    poles: np.ndarray
    squares: np.ndarray  # sum of those of the residual, (n_outputs,)
    round_off: float  # of these squares, as a share of those of the record
    coefficients: np.ndarray  # (n_columns, n_outputs)
    gram: np.ndarray  # G = (tΦ)^T (I - Φ Φ^+) tΦ
    slopes: np.ndarray  # (tΦ)^T residual, (2 n_modes, n_outputs)
    spread: np.ndarray  # (Φ^T Φ)^-1
    tilt: np.ndarray  # Φ^+ tΦ, (n_columns, 2 n_modes)

    @cached_property
    def residual(self) -> np.ndarray:
        """(n_samples, n_outputs); of a long record computed only on demand."""
        left = self.record.outputs.T - _Exponentials(self.record, self.poles).motion(self.complex_amplitudes)
        if len(self.coefficients) > 2 * self.poles.size:
            left -= self.coefficients[-1]
        return left

    @property
    def complex_amplitudes(self) -> np.ndarray:
        """a_jr = α - iβ of α cos + β sin, (n_outputs, n_modes)."""
        n = self.gram.shape[0] // 2
        return (self.coefficients[:n] - 1j * self.coefficients[n : 2 * n]).T


def project(record: Record, poles: np.ndarray, offset: bool) -> Projection:
    """Least squares of every output on the damped exponentials of `poles`, and on a constant with `offset`.

    Raises:
        numpy.linalg.LinAlgError: two of them cannot be distinguished.
    """
    n = record.n_samples
    if n > PROJECTION.longest_factored or n * poles.size > PROJECTION.largest_factored:
        return _project_by_parts(record, poles, offset)
    rows = _Rows(record, poles)
    columns = np.hstack([rows.phi, rows.level[:, None]]) if offset else rows.phi
    q, r = qr(columns, mode="economic", check_finite=False)
    qy = q.T @ rows.y
    fitted = q @ qy
    q_t = q.T @ rows.t_phi
    rest = rows.t_phi - q @ q_t
    inverse = solve_triangular(r, np.eye(r.shape[0]))
    residual = record.outputs.T - rows.over_time(fitted)
    squares, gram, slopes = (residual**2).sum(axis=0), rest.T @ rest, rows.t_phi.T @ (rows.y - fitted)
    fit = Projection(record, poles, squares, 0.0, inverse @ qy, gram, slopes, inverse @ inverse.T, inverse @ q_t)
    fit.__dict__["residual"] = residual
    return fit


class _Rows:
    """Φ, tΦ, a constant and y in fewer rows, of the same products: of each block of the record, its part along Q.

    The exponentials of a block from T on are e^{λT} e^{λτ}: in all blocks they lie in the span of one table,
    [e^{λτ}, τ e^{λτ}, 1] = Q R. What of y is across Q has no product with any column.

    Attributes:
        phi, t_phi: (n_rows, 2 n_modes).
        level: (n_rows,) of the constant.
        y: (n_rows, n_outputs).
    """

    def __init__(self, record: Record, poles: np.ndarray) -> None:
        n, k, dt, y = record.n_samples, poles.size, record.sample_time, record.outputs
        # The table of a block and what is left of all blocks then take as long to factor.
        self.blocks = max(int(np.sqrt(2.0 * n / (4 * k + 1))), 1)
        size = n // self.blocks
        self.whole = size * self.blocks
        tau, begin = dt * np.arange(size), dt * size * np.arange(self.blocks)
        near = _columns(_exponentials(size, dt, poles))
        table = np.hstack([near, tau[:, None] * near, np.ones((size, 1))])
        self.q, r = qr(table, mode="economic", check_finite=False)
        # Samples after the last whole block are rows as they are.
        last = dt * np.arange(self.whole, n)
        far = np.exp(np.outer(begin, poles))[:, None]
        once = far * (r[:, :k] + 1j * r[:, k : 2 * k])
        tilted = begin[:, None, None] * once + far * (r[:, 2 * k : 3 * k] + 1j * r[:, 3 * k : 4 * k])
        ends = np.exp(np.outer(last, poles))
        self.phi = _columns(np.vstack([once.reshape(self.blocks * len(r), k), ends]))
        self.t_phi = _columns(np.vstack([tilted.reshape(self.blocks * len(r), k), last[:, None] * ends]))
        self.level = np.r_[np.tile(r[:, -1], self.blocks), np.ones(last.size)]
        along = y[:, : self.whole].reshape(len(y), self.blocks, size) @ self.q
        self.y = np.vstack([along.reshape(len(y), -1).T, y[:, self.whole :].T])

    def over_time(self, rows: Floats) -> Floats:
        """The samples (n_samples, n_outputs) of combinations of the columns, given in these rows."""
        m, inside = rows.shape[1], self.blocks * self.q.shape[1]
        blocks = rows[:inside].T.reshape(m, self.blocks, -1) @ self.q.T
        return np.vstack([blocks.reshape(m, -1).T, rows[inside:]])


def power_sums(w: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Σ_{i<n} i^k w^i for k = 0, 1, 2, each of the shape of w; |w| ≤ 1 or little more."""
    sums = [np.zeros(w.shape, complex) for _ in range(3)]
    power, length = np.ones(w.shape, complex), 0
    # The sums over 2L samples are those over L, and the same again L samples later.
    for bit in bin(n)[2:]:
        s0, s1, s2 = sums
        sums = [s0 + power * s0, s1 + power * (s1 + length * s0), s2 + power * (s2 + length * (2.0 * s1 + length * s0))]
        power, length = power * power, 2 * length
        if bit == "1":
            sums = [total + float(length) ** k * power for k, total in enumerate(sums)]
            power, length = power * w, length + 1
    return sums[0], sums[1], sums[2]


def _exponentials(n: int, sample_time: float, poles: np.ndarray) -> np.ndarray:
    """e^{λt} at n samples, (n, n_modes): each a product of two from tables of √n, as a product costs a twentieth."""
    fine = int(np.ceil(np.sqrt(n)))
    near = np.exp(np.outer(sample_time * np.arange(fine), poles))
    far = np.exp(np.outer(sample_time * np.arange(0, n, fine), poles))
    return (far[:, None] * near).reshape(len(far) * fine, poles.size)[:n]


def _columns(exponentials: np.ndarray) -> np.ndarray:
    return np.hstack([exponentials.real, exponentials.imag])


def _grams(poles: np.ndarray, record: Record, offset: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ΦᵀΦ with the constant, Φᵀ tΦ likewise, and (tΦ)ᵀ tΦ."""
    mu, n, dt = np.exp(poles * record.sample_time), record.n_samples, record.sample_time
    same, turned = power_sums(np.outer(mu, mu), n), power_sums(np.outer(mu, mu.conj()), n)
    grams = []
    for k, (q, p) in enumerate(zip(same, turned, strict=True)):
        blocks = [[(p + q).real, (q - p).imag], [(q + p).imag, (p - q).real]]
        grams.append(0.5 * dt**k * np.block(blocks))
    if not offset:
        return grams[0], grams[1], grams[2]
    s0, s1, _ = power_sums(mu, n)
    level, rising = np.r_[s0.real, s0.imag], dt * np.r_[s1.real, s1.imag]
    whole = np.block([[grams[0], level[:, None]], [level[None], np.array([[float(n)]])]])
    return whole, np.vstack([grams[1], rising]), grams[2]


def _project_by_parts(record: Record, poles: np.ndarray, offset: bool) -> Projection:
    """The same from normal equations, where Φ would fill the memory, part after part of the record.

    They square the condition number, which long records of many modes can afford: their length separates the modes.
    """
    whole, tilted, doubly = _grams(poles, record, offset)
    seen, t_seen = _Exponentials(record, poles).sums()
    if offset:
        seen = np.vstack([seen, record.outputs.sum(axis=1)])
    power = np.einsum("jt,jt->j", record.outputs, record.outputs)
    scale = 1.0 / np.sqrt(np.diag(whole))
    factor = cho_factor(whole * np.outer(scale, scale))

    def solve(right: np.ndarray) -> np.ndarray:
        return np.asarray(scale[:, None] * cho_solve(factor, scale[:, None] * right))

    coefficients, tilt = solve(seen), solve(tilted)
    squares = np.maximum(power - (coefficients * seen).sum(axis=0), 0.0)
    slopes = t_seen - tilted.T @ coefficients
    gram, spread = doubly - tilted.T @ tilt, solve(np.eye(len(whole)))
    if (np.diag(gram) < 0.0).any():  # sums of squares: no digit of them is left
        raise np.linalg.LinAlgError("exponentials that are alike to round-off")
    return Projection(record, poles, squares, PROJECTION.summed, coefficients, gram, slopes, spread, tilt)


class _Exponentials:
    """e^{λt} of a record without those that have decayed: of the sample τ of a block from T on, e^{λT} e^{λτ}.

    Sums over the samples are thus products of the outputs, a row a block, with one table of e^{λτ}.
    """

    def __init__(self, record: Record, poles: np.ndarray) -> None:
        self.record, self.dt = record, record.sample_time
        # The slowest to die away first: those alive in a part are then the first few.
        self.order = np.argsort(-poles.real)
        self.slow = poles[self.order]
        self.lives = PROJECTION.died_away / np.maximum(-self.slow.real, 1e-300)
        self.tau = self.dt * np.arange(PROJECTION.block)
        self.near = np.exp(np.outer(self.tau, self.slow))

    def _parts(self) -> Iterator[tuple[slice, Floats, Complexes]]:
        """Samples, where their blocks begin, s, and e^{λT} there of the exponentials left, (n_blocks, n_left)."""
        n = self.record.n_samples
        for first in range(0, n, PROJECTION.part):
            part = slice(first, min(first + PROJECTION.part, n))
            alive = int(np.searchsorted(-self.lives, -first * self.dt, side="right"))
            if not alive:
                return
            begin: Floats = self.dt * np.arange(first, part.stop, PROJECTION.block, dtype=float)
            yield part, begin, np.exp(np.outer(begin, self.slow[:alive]))

    def sums(self) -> tuple[Floats, Floats]:
        """Φᵀy and (tΦ)ᵀy, (2 n_modes, n_outputs) each."""
        found = np.zeros((2, self.order.size, self.record.n_outputs), complex)
        for part, begin, far in self._parts():
            y = self.record.outputs[:, part]
            y = np.pad(y, ((0, 0), (0, begin.size * self.tau.size - y.shape[1]))).reshape(-1, self.tau.size)
            near = self.near[:, : far.shape[1]]
            both = np.hstack([near, self.tau[:, None] * near])
            inner = (y @ both.view(float)).view(complex).reshape(-1, begin.size, 2, far.shape[1])
            level, rising = inner[:, :, 0], inner[:, :, 1] + begin[:, None] * inner[:, :, 0]
            for total, each in zip(found, (level, rising), strict=True):
                total[self.order[: far.shape[1]]] += np.einsum("jbr,br->rj", each, far)
        return np.concatenate([found[0].real, found[0].imag]), np.concatenate([found[1].real, found[1].imag])

    def motion(self, amplitudes: Complexes) -> Floats:
        """Re Σ_r a_jr e^{λ_r t} of amplitudes (n_outputs, n_modes), (n_samples, n_outputs)."""
        found = np.zeros((self.record.n_samples, len(amplitudes)))
        for part, _, far in self._parts():
            alive = far.shape[1]
            turned = (amplitudes[:, None, self.order[:alive]] * far).reshape(-1, alive)
            near = self.near[:, :alive]
            moved = turned.real @ near.real.T - turned.imag @ near.imag.T
            found[part] = moved.reshape(len(amplitudes), -1)[:, : part.stop - part.start].T
        return found


def whitened(records: Sequence[Record], poles: np.ndarray) -> list[Record] | None:
    """The records behind filters that whiten the residual of `poles`; None where it may be white.

    Where outputs share a part of their noise, as what shakes the whole bench, combinations of them that do not come
    first: noise of two outputs counts twice else, and its peaks for modes. Each then has a filter of its own.

    Args:
        records: free decays, of the same outputs.
        poles: (n_modes,) of their modes, rad/s.
    """
    left = [project(record, poles, True).residual.T for record in records]
    order = min(PROJECTION.order, sum(each.shape[1] for each in left) // PROJECTION.samples_each)
    squares = sum((each**2).sum(axis=1) for each in left)
    whole = sum((record.outputs**2).sum(axis=1) for record in records)
    if order == 0 or (squares < PROJECTION.rounding**2 * whole).any():
        return None
    apart = independent(records, left)
    if apart is not None:
        records, left = apart
    powers = [np.abs(np.fft.rfft(each, axis=1)[:, 1:].T) ** 2 for each in left]
    if all(white(power, poles.size).all() for power in powers):
        return None if apart is None else list(records)
    filters = []
    for rows in zip(*left, strict=True):
        # Records of one spectrum may differ in variance.
        row = [each * np.sqrt(each.size) / max(float(np.linalg.norm(each)), 1e-300) for each in rows]
        lags = [sum(float(each[k:] @ each[: each.size - k]) for each in row) for k in range(order + 1)]
        filters.append(np.r_[1.0, -solve_toeplitz(lags[:-1], lags[1:])] if lags[0] > 0 else np.r_[1.0, np.zeros(order)])
    return [
        replace(
            record,
            outputs=np.array([lfilter(b, [1.0], row)[order:] for b, row in zip(filters, record.outputs, strict=True)]),
            inputs=record.inputs[:, order:],
            start_time=record.start_time + order * record.sample_time,
        )
        for record in records
    ]


def correlation(left: Sequence[np.ndarray]) -> Floats | None:
    """Of the noise of outputs, over all records, (n_outputs, n_outputs); None where they may share none.

    Args:
        left: (n_outputs, n_samples) a record.
    """
    if len(left[0]) == 1:
        return None
    return correlation_of_lines([_lines_of(each) for each in left])


def _lines_of(signals: np.ndarray) -> Complexes:
    """Lines of signals, but for the first, by Hann's window: modes not found yet leak far into other bands without it.

    One signal after the other: the windows of all of them would be as much again.
    """
    n_signals, n_samples = signals.shape
    lines, window = np.empty((n_signals, n_samples // 2), complex), np.hanning(n_samples)
    for row, signal in zip(lines, signals, strict=True):
        row[:] = rfft(signal * window)[1:]
    return lines


def correlation_of_lines(left: Sequence[np.ndarray]) -> Floats | None:
    """The same of lines of frequency, (n_outputs, n_lines) complex a record.

    The median over bands, so that modes not found yet do not count for noise. Bartlett's test of sphericity
    (Proc. Camb. Phil. Soc. 47, 1951): -(N - (2 m + 5)/6) ln det C is chi-square of m (m - 1)/2, of N values of m.
    """
    m, size = len(left[0]), 2 * sum(each.shape[1] for each in left)
    if m == 1 or min(each.shape[1] for each in left) < PROJECTION.band or size < PROJECTION.samples_each * m:
        return None
    values, vectors = np.linalg.eigh(_median_correlation(left))
    shared: Floats = (vectors * np.maximum(values, PROJECTION.own)) @ vectors.T
    shared /= np.sqrt(np.outer(np.diag(shared), np.diag(shared)))
    lost = -(PROJECTION.of_median * size - (2 * m + 5) / 6.0) * np.linalg.slogdet(shared)[1]
    none = lost < chi2.isf(PROJECTION.false_alarm, m * (m - 1) // 2) or values[-1] < PROJECTION.harmless
    return None if none else shared


def _median_correlation(left: Sequence[np.ndarray]) -> Floats:
    """The median over bands of the correlation of lines (n_outputs, n_lines) a record; the lower triangle of it."""
    m, band = len(left[0]), 2 * PROJECTION.band
    # real and imaginary parts beside each other: the real part of a product with a conjugate is their scalar product
    bands = [np.ascontiguousarray(each).view(float) for each in left]
    bands = [each[:, : each.shape[1] // band * band].reshape(m, -1, band).transpose(1, 0, 2) for each in bands]
    own = [np.sqrt(np.einsum("bjk,bjk->bj", each, each)) + 1e-150 for each in bands]
    median, n_bands = np.zeros((m, m)), sum(map(len, bands))
    some = max(PROJECTION.at_once // (n_bands * m), 1)  # a few outputs beside all, in all bands
    for start in range(0, m, some):
        rows, columns = slice(start, min(start + some, m)), slice(0, min(start + some, m))
        each = zip(bands, own, strict=True)
        products = [
            np.matmul(b[:, rows], b[:, columns].transpose(0, 2, 1)) / (o[:, rows, None] * o[:, None, columns])
            for b, o in each
        ]
        median[rows, columns] = np.median(np.concatenate(products), axis=0, overwrite_input=True)
    return median


def disturbed(shared: Floats | None, amplitudes: np.ndarray) -> Floats:
    """Variance of what noise of that correlation does to each mode over that of noise which outputs do not share:
    a^H C a / a^H a, (n_modes,).

    Args:
        shared: C (n_outputs, n_outputs); None where they share none.
        amplitudes: a (n_outputs, n_modes), over the noise of each output.
    """
    if shared is None:
        return np.ones(amplitudes.shape[1])
    ratio: Floats = (amplitudes.conj() * (shared @ amplitudes)).sum(axis=0).real / (np.abs(amplitudes) ** 2).sum(axis=0)
    return ratio


def mixing_of(shared: Floats | None) -> Floats | None:
    """Combinations (n_outputs, n_outputs) of outputs, over their noise, that make it independent; None where it is."""
    return None if shared is None else np.linalg.inv(np.linalg.cholesky(shared))


def independent(records: Sequence[Record], left: Sequence[np.ndarray]) -> tuple[list[Record], list[Floats]] | None:
    """Records of combinations of the outputs whose noise is independent and of unit variance, and what is left of them.

    A free decay stays a free decay of the same poles.

    Args:
        records: of the same outputs.
        left: (n_outputs, n_samples) noise of each.

    Returns:
        None where the outputs may share no noise as they are.
    """
    apart = mixing_of(correlation(left))
    if apart is None:
        return None
    mixing = [apart / np.sqrt((each**2).mean(axis=1)) for each in left]
    mixed = [replace(record, outputs=m @ record.outputs) for record, m in zip(records, mixing, strict=True)]
    return mixed, [m @ each for m, each in zip(mixing, left, strict=True)]


def noise_near(poles: np.ndarray, residual: np.ndarray, noise: np.ndarray, sample_time: float) -> np.ndarray:
    """κ, the noise about each mode over its mean, (n_outputs, n_modes); 1 for an output whose noise may be white.

    Args:
        poles: (n_modes,) of the modes taken out, rad/s.
        residual: (n_samples, n_outputs).
        noise: (n_outputs,) its standard deviation.
        sample_time: s.
    """
    n, m = residual.shape
    bin_width = 2.0 * np.pi / (n * sample_time)
    widths = np.maximum(np.abs(poles.real), PROJECTION.least_bins * bin_width)
    # Each mode took the noise of one bin.
    taken = _bandwidth_weight(np.subtract.outer(poles.imag, poles.imag) / widths).sum(axis=0)
    factors = np.ones((m, poles.size))
    for j in range(m):
        power = power_of(residual[:, j])[1:]
        power /= n * float(noise[j]) ** 2
        if white(power[:, None], poles.size, among=m)[0]:
            continue
        for r, (pole, width) in enumerate(zip(poles, widths)):
            weight = _bandwidth_weight((bin_width * np.arange(1, power.size + 1) - pole.imag) / width)
            factors[j, r] = weight @ power / max(float(weight.sum()) - taken[r], 1.0)
    return factors


def power_of(row: np.ndarray, size: int | None = None) -> np.ndarray:
    """|·|² of the transform of a row, padded to a length; in the row's precision."""
    spectrum = rfft(row, size)
    forget_transforms(row.size)
    power: np.ndarray = spectrum.real**2
    power += spectrum.imag**2
    return power


def forget_transforms(n: int) -> None:
    """After one of n samples, where they are many: the tables of the last sixteen, each as large as the signal, are
    kept otherwise."""
    if n > PROJECTION.many:
        for size in range(1, 17):
            for kind in (np.float32, np.float64):
                rfft(np.ones(size, kind))


def noise_along(signals: np.ndarray, residual: np.ndarray, n_modes: int) -> np.ndarray:
    """κ, noise over its mean along each signal, (n_signals, n_outputs); 1 where it may be white.

    Args:
        signals: (n_samples, n_signals).
        residual: (n_samples, n_outputs) of a fit, over its standard deviation.
        n_modes: taken out of it.
    """
    columns = residual / np.sqrt(len(residual)), signals
    power, weight = (np.abs(np.fft.rfft(each, axis=0)[1:]) ** 2 for each in columns)
    whole = weight.sum(axis=0)
    along = (weight / np.where(whole > 0, whole, 1.0)).T @ power
    # A constant is disturbed by noise about zero frequency.
    along[whole <= 1e-20 * len(signals)] = power[: 2 * PROJECTION.least_bins].mean(axis=0)
    return np.where(white(power, n_modes), 1.0, along)


def _bandwidth_weight(away: np.ndarray) -> np.ndarray:
    """Power of t e^{λt}, over that at its own frequency."""
    return (1.0 + away**2) ** -2.0


def white(power: np.ndarray, n_modes: int, *, among: int | None = None) -> np.ndarray:
    """Outputs (n_outputs,) whose spectrum may be flat: its sum runs along a straight line (Bartlett; Kolmogorov).

    Args:
        power: (n_bins, n_outputs).
        n_modes: taken out of it.
        among: how many outputs are asked about in all; these unless given.
    """
    bins, m = power.shape
    whole = power.sum(axis=0)
    summed = np.cumsum(power, axis=0) / np.where(whole > 0, whole, 1.0)
    apart = np.abs(summed - np.arange(1, bins + 1)[:, None] / bins).max(axis=0)
    # The bins that the modes took are not coloured noise.
    least = np.sqrt(0.5 * np.log(2.0 * (among or m) / PROJECTION.false_alarm) / bins) + (n_modes + 1) / bins
    return np.asarray(apart < least)


def variances(squares: np.ndarray, free: np.ndarray, apart: np.ndarray | None = None) -> np.ndarray:
    """Variance of the noise, (n_records, n_outputs).

    Args:
        squares: (n_records, n_outputs) sums of squares of the residual, positive.
        free: (n_records,) or (n_records, n_outputs) degrees of freedom, at least 1.
        apart: (n_outputs,) whose records differ; by `differ` unless given.
    """
    free = _each(free, squares)
    apart = differ(squares, free) if apart is None else apart
    return np.asarray(np.where(apart, squares / free, squares.sum(axis=0) / free.sum(axis=0)))


def differ(squares: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Outputs (n_outputs,) whose noise is not the same in all records."""
    n, free = len(squares), _each(free, squares)
    if n == 1:
        return np.zeros(squares.shape[1], bool)
    whole = free.sum(axis=0)
    apart = whole * np.log(squares.sum(axis=0) / whole) - (free * np.log(squares / free)).sum(axis=0)
    corrected = apart / (1.0 + ((1.0 / free).sum(axis=0) - 1.0 / whole) / (3.0 * (n - 1)))
    return np.asarray(corrected > chi2.isf(PROJECTION.split, n - 1))


def _each(free: np.ndarray, squares: np.ndarray) -> np.ndarray:
    return np.broadcast_to(free[:, None] if free.ndim == 1 else free, squares.shape)
