"""Least squares projection of a free decay on the exponentials of given poles, and the noise of its residual.

y_j = Φ c_j + r_j, Φ = [e^{-σt} cos ω_d t, e^{-σt} sin ω_d t] and, optionally, a column of ones. All derivatives of Φ by
the poles lie in the span of tΦ. In a long record the matrices ΦᵀΦ, ΦᵀtΦ, (tΦ)ᵀtΦ are sums of powers

    S_k(w) = Σ_{i<N} i^k w^i,     w = μ_r μ_s and μ_r μ_s*,   μ = e^{λΔt},

computed by doubling in log N steps. An exponential is left out where it has decayed below round-off.

Whitening: the residual of an output is modelled as the autoregression y_k = Σ_i a_i y_k-i + e_k (Yule & Walker), and
the record is filtered by 1 - Σ_i a_i z^-i. A free decay stays a free decay of the same poles.

Where the noise of the outputs has the correlation matrix C, the combinations C^-½ y / s, whose noise is uncorrelated,
are filtered instead. They are free decays of the same poles too.

Variance: if the noise of all records has one variance, short records estimate it better together. Bartlett's statistic
tests this (Proc. R. Soc. A 160, 1937): with ν_i degrees of freedom of the variance v_i of record i, and v of all,

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
    """Constants of projections and of the statistics of their noise."""

    max_factored: int = 300_000  # n_samples × n_modes up to which Φ is factored, block by block
    max_factored_samples: int = 20_000  # likewise; above, normal equations take less time
    max_cached_samples: int = 1_000_000  # of a transform, above which its cached tables are dropped
    part_samples: int = 8192  # of a part of a long record, a multiple of the block
    block_samples: int = 256
    max_nepers: float = 41.0  # after which an exponential is left out: e^-41 is below the last digit of 1
    sum_round_off: float = 1e-14  # relative, of a sum of squares that is a difference of sums over the record
    # that records of equal noise are given separate variances, which costs little
    split_probability: float = 0.05
    false_alarm: float = 1e-3  # probability that white noise is taken for coloured
    min_half_bins: int = 6  # half width of the average of a spectrum
    min_independent_share: float = 1e-3  # of an output's noise, uncorrelated with that of all others
    band_lines: int = 32  # in which the correlation of noise is estimated
    max_eigenvalue: float = 1.2  # of the correlation matrix, up to which correlation is neglected
    max_products: int = 2**21  # of outputs, in all bands, that are held in memory at once: 16 MB
    median_efficiency: float = 0.25  # of the median over windowed bands, relative to the mean without a window
    max_ar_order: int = 12  # of the autoregressive model of coloured noise
    samples_per_parameter: int = 40  # of that model, and per output for a correlation matrix, at least
    noise_free_ratio: float = 1e-9  # relative residual of records without noise
    spectrum_tolerance: float = 0.1  # rms of log ratios below which two spectra are the same
    max_leverage: float = 0.9  # of a line that is used for the noise spectrum


PROJECTION = ProjectionSettings()


def pole_blocks(a: np.ndarray, b: np.ndarray, gram: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[Floats, Floats]:
    """Gauss-Newton matrix (2 n, 2 n) and right-hand side (2 n,) for the real, then imaginary parts of n poles.

    Outputs are Re Σ (a - ib) z, a and b (n, n_outputs) in units of the noise. `gram` (2 n, 2 n) is the Gram matrix of
    the real, then imaginary parts of the tangents ∂z projected orthogonally to the columns of the fit; x and y
    (n, n_outputs) are products of these with the residual, in units of the noise.
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
    squares: np.ndarray  # sum of squares of the residual, (n_outputs,)
    round_off: float  # of `squares`, relative to the sum of squares of the record
    coefficients: np.ndarray  # (n_columns, n_outputs)
    gram: np.ndarray  # G = (tΦ)^T (I - Φ Φ^+) tΦ
    slopes: np.ndarray  # (tΦ)^T residual, (2 n_modes, n_outputs)
    spread: np.ndarray  # (Φ^T Φ)^-1
    tilt: np.ndarray  # Φ^+ tΦ, (n_columns, 2 n_modes)

    @cached_property
    def residual(self) -> np.ndarray:
        """Residual (n_samples, n_outputs); for a long record it is computed on demand."""
        residual = self.record.outputs.T - _Exponentials(self.record, self.poles).motion(self.complex_amplitudes)
        if len(self.coefficients) > 2 * self.poles.size:
            residual -= self.coefficients[-1]
        return residual

    @property
    def complex_amplitudes(self) -> np.ndarray:
        """Amplitudes a_jr = α - iβ of α cos + β sin, (n_outputs, n_modes)."""
        n = self.gram.shape[0] // 2
        return (self.coefficients[:n] - 1j * self.coefficients[n : 2 * n]).T


def project(record: Record, poles: np.ndarray, offset: bool) -> Projection:
    """Least squares fit of the damped exponentials of `poles`, and a constant with `offset`, to every output.

    Raises:
        numpy.linalg.LinAlgError: exponentials that cannot be distinguished.
    """
    n = record.n_samples
    if n > PROJECTION.max_factored_samples or n * poles.size > PROJECTION.max_factored:
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
    """Φ, tΦ (n_rows, 2 n_modes), the constant `level` and y (n_rows, n_outputs), in fewer rows of equal inner products.

    The exponentials of a block that begins at T are e^{λT} e^{λτ}: in every block they lie in the span of one table,
    [e^{λτ}, τ e^{λτ}, 1] = Q R. Each block is represented by its coordinates along Q; the part of y orthogonal to Q is
    orthogonal to every column.
    """

    def __init__(self, record: Record, poles: np.ndarray) -> None:
        n, k, dt, y = record.n_samples, poles.size, record.sample_time, record.outputs
        # With so many blocks the table and the compressed rows take about the same time to factor.
        self.blocks = max(int(np.sqrt(2.0 * n / (4 * k + 1))), 1)
        size = n // self.blocks
        self.whole = size * self.blocks
        tau, begin = dt * np.arange(size), dt * size * np.arange(self.blocks)
        near = _columns(_exponentials(size, dt, poles))
        table = np.hstack([near, tau[:, None] * near, np.ones((size, 1))])
        self.q, r = qr(table, mode="economic", check_finite=False)
        # Samples after the last whole block are kept as rows.
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
        """Samples (n_samples, n_outputs) of combinations of the columns, from compressed rows (n_rows, n_outputs)."""
        m, inside = rows.shape[1], self.blocks * self.q.shape[1]
        blocks = rows[:inside].T.reshape(m, self.blocks, -1) @ self.q.T
        return np.vstack([blocks.reshape(m, -1).T, rows[inside:]])


def power_sums(w: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sums Σ_{i<n} i^k w^i for k = 0, 1, 2, each of the shape of w; |w| ≤ 1 or little more."""
    sums = [np.zeros(w.shape, complex) for _ in range(3)]
    power, length = np.ones(w.shape, complex), 0
    # The sums over 2L samples are those over the first L and, from the same sums, over the next L.
    for bit in bin(n)[2:]:
        s0, s1, s2 = sums
        sums = [s0 + power * s0, s1 + power * (s1 + length * s0), s2 + power * (s2 + length * (2.0 * s1 + length * s0))]
        power, length = power * power, 2 * length
        if bit == "1":
            sums = [total + float(length) ** k * power for k, total in enumerate(sums)]
            power, length = power * w, length + 1
    s0, s1, s2 = sums
    return s0, s1, s2


def _exponentials(n: int, sample_time: float, poles: np.ndarray) -> np.ndarray:
    """e^{λt} at n samples, (n, n_modes), as products of two tables of √n: a product takes a twentieth of the time."""
    fine = int(np.ceil(np.sqrt(n)))
    near = np.exp(np.outer(sample_time * np.arange(fine), poles))
    far = np.exp(np.outer(sample_time * np.arange(0, n, fine), poles))
    return (far[:, None] * near).reshape(len(far) * fine, poles.size)[:n]


def _columns(exponentials: np.ndarray) -> np.ndarray:
    return np.hstack([exponentials.real, exponentials.imag])


def _grams(poles: np.ndarray, record: Record, offset: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The matrices ΦᵀΦ and ΦᵀtΦ, with `offset` including the constant in Φ, and (tΦ)ᵀtΦ."""
    mu, n, dt = np.exp(poles * record.sample_time), record.n_samples, record.sample_time
    same, turned = power_sums(np.outer(mu, mu), n), power_sums(np.outer(mu, mu.conj()), n)
    whole, tilted, doubly = (
        0.5 * dt**k * np.block([[(p + q).real, (q - p).imag], [(q + p).imag, (p - q).real]])
        for k, (q, p) in enumerate(zip(same, turned, strict=True))
    )
    if offset:
        s0, s1, _ = power_sums(mu, n)
        level, rising = np.r_[s0.real, s0.imag], dt * np.r_[s1.real, s1.imag]
        whole = np.block([[whole, level[:, None]], [level[None], np.array([[float(n)]])]])
        tilted = np.vstack([tilted, rising])
    return whole, tilted, doubly


def _project_by_parts(record: Record, poles: np.ndarray, offset: bool) -> Projection:
    """The projection from normal equations, part by part of the record, where Φ would fill the memory.

    Normal equations square the condition number. Long records can afford that: their length separates the modes.
    """
    whole, tilted, doubly = _grams(poles, record, offset)
    phi_y, t_phi_y = _Exponentials(record, poles).sums()
    if offset:
        phi_y = np.vstack([phi_y, record.outputs.sum(axis=1)])
    power = np.einsum("jt,jt->j", record.outputs, record.outputs)
    scale = 1.0 / np.sqrt(np.diag(whole))
    factor = cho_factor(whole * np.outer(scale, scale))

    def solve(right: np.ndarray) -> np.ndarray:
        return np.asarray(scale[:, None] * cho_solve(factor, scale[:, None] * right))

    coefficients, tilt = solve(phi_y), solve(tilted)
    squares = np.maximum(power - (coefficients * phi_y).sum(axis=0), 0.0)
    slopes = t_phi_y - tilted.T @ coefficients
    gram, spread = doubly - tilted.T @ tilt, solve(np.eye(len(whole)))
    if (np.diag(gram) < 0.0).any():  # sums of squares that are round-off only
        raise np.linalg.LinAlgError("exponentials that are alike to round-off")
    return Projection(record, poles, squares, PROJECTION.sum_round_off, coefficients, gram, slopes, spread, tilt)


class _Exponentials:
    """e^{λt} of a record, factored as e^{λT} e^{λτ} for the sample τ of a block that begins at T.

    Sums over samples are products of the outputs, one row per block, with one table of e^{λτ}. Exponentials that have
    decayed below round-off are left out.
    """

    def __init__(self, record: Record, poles: np.ndarray) -> None:
        self.record, self.dt = record, record.sample_time
        # Sorted by decay rate, the exponentials that remain in a part are the first few.
        self.order = np.argsort(-poles.real)
        self.sorted_poles = poles[self.order]
        self.lifetimes = PROJECTION.max_nepers / np.maximum(-self.sorted_poles.real, 1e-300)
        self.tau = self.dt * np.arange(PROJECTION.block_samples)
        self.near = np.exp(np.outer(self.tau, self.sorted_poles))

    def _parts(self) -> Iterator[tuple[slice, Floats, Complexes]]:
        """Parts of the record: samples, start times T of their blocks, s, and e^{λT} of the exponentials that have not
        decayed, (n_blocks, n_left)."""
        n = self.record.n_samples
        for first in range(0, n, PROJECTION.part_samples):
            part = slice(first, min(first + PROJECTION.part_samples, n))
            n_left = int(np.searchsorted(-self.lifetimes, -first * self.dt, side="right"))
            if not n_left:
                return
            begin: Floats = self.dt * np.arange(first, part.stop, PROJECTION.block_samples, dtype=float)
            yield part, begin, np.exp(np.outer(begin, self.sorted_poles[:n_left]))

    def sums(self) -> tuple[Floats, Floats]:
        """The products Φᵀy and (tΦ)ᵀy, (2 n_modes, n_outputs) each."""
        totals = np.zeros((2, self.order.size, self.record.n_outputs), complex)
        for part, begin, far in self._parts():
            y = self.record.outputs[:, part]
            y = np.pad(y, ((0, 0), (0, begin.size * self.tau.size - y.shape[1]))).reshape(-1, self.tau.size)
            near = self.near[:, : far.shape[1]]
            both = np.hstack([near, self.tau[:, None] * near])
            inner = (y @ both.view(float)).view(complex).reshape(-1, begin.size, 2, far.shape[1])
            level, rising = inner[:, :, 0], inner[:, :, 1] + begin[:, None] * inner[:, :, 0]
            for total, each in zip(totals, (level, rising), strict=True):
                total[self.order[: far.shape[1]]] += np.einsum("jbr,br->rj", each, far)
        phi_y, t_phi_y = (np.concatenate([total.real, total.imag]) for total in totals)
        return phi_y, t_phi_y

    def motion(self, amplitudes: Complexes) -> Floats:
        """The motion Re Σ_r a_jr e^{λ_r t} of amplitudes (n_outputs, n_modes), (n_samples, n_outputs)."""
        samples = np.zeros((self.record.n_samples, len(amplitudes)))
        for part, _, far in self._parts():
            n_left = far.shape[1]
            rotated = (amplitudes[:, None, self.order[:n_left]] * far).reshape(-1, n_left)
            near = self.near[:, :n_left]
            moved = rotated.real @ near.real.T - rotated.imag @ near.imag.T
            samples[part] = moved.reshape(len(amplitudes), -1)[:, : part.stop - part.start].T
        return samples


def whitened(records: Sequence[Record], poles: np.ndarray) -> list[Record] | None:
    """The free decays filtered so that the residual of `poles`, rad/s, becomes white; None where it may be white.

    Correlated noise, such as vibration of the whole bench, would count once per output, and its peaks would be taken
    for modes. Outputs are therefore first replaced by combinations of uncorrelated noise, each with its own filter.
    """
    residuals = [project(record, poles, True).residual.T for record in records]
    order = min(PROJECTION.max_ar_order, sum(each.shape[1] for each in residuals) // PROJECTION.samples_per_parameter)
    squares = sum((each**2).sum(axis=1) for each in residuals)
    energy = sum((record.outputs**2).sum(axis=1) for record in records)
    if order == 0 or (squares < PROJECTION.noise_free_ratio**2 * energy).any():
        return None
    uncorrelated = independent(records, residuals)
    if uncorrelated is not None:
        records, residuals = uncorrelated
    powers = [np.abs(np.fft.rfft(each, axis=1)[:, 1:].T) ** 2 for each in residuals]
    if all(white(power, poles.size).all() for power in powers):
        return None if uncorrelated is None else list(records)
    filters = []
    for rows in zip(*residuals, strict=True):
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


def correlation(residuals: Sequence[np.ndarray]) -> Floats | None:
    """Correlation matrix of the noise of outputs, (n_outputs, n_outputs), from residuals (n_outputs, n_samples) of each
    record; None if not significant."""
    return None if len(residuals[0]) == 1 else correlation_of_lines([_lines_of(each) for each in residuals])


def _lines_of(signals: np.ndarray) -> Complexes:
    """Fourier lines of signals, without the mean; Hann's window keeps modes not found yet from leaking far.

    Signals are transformed one by one to save memory.
    """
    n_signals, n_samples = signals.shape
    lines, window = np.empty((n_signals, n_samples // 2), complex), np.hanning(n_samples)
    for row, signal in zip(lines, signals, strict=True):
        row[:] = rfft(signal * window)[1:]
    return lines


def correlation_of_lines(lines: Sequence[np.ndarray]) -> Floats | None:
    """`correlation` from Fourier lines of the residual of each record, (n_outputs, n_lines).

    It is the median over bands, so that modes not found yet do not count as noise. Bartlett's test of sphericity
    (Proc. Camb. Phil. Soc. 47, 1951): for N values of m outputs -(N - (2 m + 5)/6) ln det C is chi-square with
    m (m - 1)/2 degrees of freedom.
    """
    m, size = len(lines[0]), 2 * sum(each.shape[1] for each in lines)
    n_lines = min(each.shape[1] for each in lines)
    if m == 1 or n_lines < PROJECTION.band_lines or size < PROJECTION.samples_per_parameter * m:
        return None
    values, vectors = np.linalg.eigh(_median_correlation(lines))
    matrix: Floats = (vectors * np.maximum(values, PROJECTION.min_independent_share)) @ vectors.T
    matrix /= np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
    statistic = -(PROJECTION.median_efficiency * size - (2 * m + 5) / 6.0) * np.linalg.slogdet(matrix)[1]
    none = statistic < chi2.isf(PROJECTION.false_alarm, m * (m - 1) // 2) or values[-1] < PROJECTION.max_eigenvalue
    return None if none else matrix


def _median_correlation(lines: Sequence[np.ndarray]) -> Floats:
    """Median over bands of the correlation of lines (n_outputs, n_lines) of each record; its lower triangle only."""
    m, band = len(lines[0]), 2 * PROJECTION.band_lines
    # Real and imaginary parts alternate: the real part of a product with a conjugate is their scalar product.
    bands = [np.ascontiguousarray(each).view(float) for each in lines]
    bands = [each[:, : each.shape[1] // band * band].reshape(m, -1, band).transpose(1, 0, 2) for each in bands]
    norms = [np.sqrt(np.einsum("bjk,bjk->bj", each, each)) + 1e-150 for each in bands]
    median, n_bands = np.zeros((m, m)), sum(map(len, bands))
    some = max(PROJECTION.max_products // (n_bands * m), 1)  # so many rows of the matrix at a time
    for start in range(0, m, some):
        rows, columns = slice(start, min(start + some, m)), slice(0, min(start + some, m))
        each = zip(bands, norms, strict=True)
        products = [
            np.matmul(b[:, rows], b[:, columns].transpose(0, 2, 1)) / (o[:, rows, None] * o[:, None, columns])
            for b, o in each
        ]
        median[rows, columns] = np.median(np.concatenate(products), axis=0, overwrite_input=True)
    return median


def disturbed(shared: Floats | None, amplitudes: np.ndarray) -> Floats:
    """Variance of each mode in correlated noise over that in uncorrelated noise, a^H C a / a^H a, (n_modes,).

    From the correlation matrix C, None where noise is uncorrelated, and a (n_outputs, n_modes) over the noise.
    """
    if shared is None:
        return np.ones(amplitudes.shape[1])
    ratio: Floats = (amplitudes.conj() * (shared @ amplitudes)).sum(axis=0).real / (np.abs(amplitudes) ** 2).sum(axis=0)
    return ratio


def mixing_of(shared: Floats | None) -> Floats | None:
    """Combinations (n_outputs, n_outputs) of outputs, over their noise, in which it is uncorrelated; None if it is.

    From its correlation matrix, or None.
    """
    return None if shared is None else np.linalg.inv(np.linalg.cholesky(shared))


def independent(records: Sequence[Record], residuals: Sequence[np.ndarray]) -> tuple[list[Record], list[Floats]] | None:
    """Records of combinations of the outputs whose noise is uncorrelated and of unit variance, and their residuals
    (n_outputs, n_samples); None where correlation of the noise is not significant.

    A free decay stays a free decay of the same poles.
    """
    whitening = mixing_of(correlation(residuals))
    if whitening is None:
        return None
    mixing = [whitening / np.sqrt((each**2).mean(axis=1)) for each in residuals]
    mixed = [replace(record, outputs=m @ record.outputs) for record, m in zip(records, mixing, strict=True)]
    return mixed, [m @ each for m, each in zip(mixing, residuals, strict=True)]


def noise_near(poles: np.ndarray, residual: np.ndarray, noise: np.ndarray, sample_time: float) -> np.ndarray:
    """Ratio κ of the noise power about each mode to its mean, (n_outputs, n_modes); 1 where the noise may be white.

    From poles, rad/s, and the residual (n_samples, n_outputs) of standard deviation `noise` (n_outputs,).
    """
    n, m = residual.shape
    bin_width = 2.0 * np.pi / (n * sample_time)
    widths = np.maximum(np.abs(poles.real), PROJECTION.min_half_bins * bin_width)
    # The fit of a mode removes the noise of one bin.
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


def local_noise_ratio(power: Floats, nearest: int, half_width: int) -> float:
    """Noise power about a line over its mean, by the median of the lines near it; 1 at least, and where none is near.

    The median of a power with two or more degrees of freedom is at most its mean. The line `nearest` may lie outside.
    """
    around = power[max(nearest - half_width, 0) : nearest + half_width + 1]
    return max(1.0, float(np.median(around) / power.mean())) if around.size else 1.0


def power_of(row: np.ndarray, size: int | None = None) -> np.ndarray:
    """Power spectrum |·|² of a signal, zero-padded to `size`, in the precision of the signal."""
    spectrum = rfft(row, size)
    forget_transforms(row.size)
    power: np.ndarray = spectrum.real**2
    power += spectrum.imag**2
    return power


def forget_transforms(n: int) -> None:
    """Empty SciPy's cache of transform tables after long transforms, of n samples.

    It keeps the tables of the last sixteen lengths, each as large as its signal; short transforms replace them.
    """
    if n > PROJECTION.max_cached_samples:
        for size in range(1, 17):
            for kind in (np.float32, np.float64):
                rfft(np.ones(size, kind))


def noise_along(signals: np.ndarray, residual: np.ndarray, n_modes: int) -> np.ndarray:
    """Ratio κ of the noise power in the spectrum of each signal to its mean, (n_signals, n_outputs); 1 where the noise
    may be white.

    From signals (n_samples, n_signals) and the residual (n_samples, n_outputs) of a fit, over its standard deviation.
    """
    columns = residual / np.sqrt(len(residual)), signals
    power, weight = (np.abs(np.fft.rfft(each, axis=0)[1:]) ** 2 for each in columns)
    total = weight.sum(axis=0)
    ratio = (weight / np.where(total > 0, total, 1.0)).T @ power
    # A constant is disturbed by noise about zero frequency.
    ratio[total <= 1e-20 * len(signals)] = power[: 2 * PROJECTION.min_half_bins].mean(axis=0)
    return np.where(white(power, n_modes), 1.0, ratio)


def _bandwidth_weight(distance: np.ndarray) -> np.ndarray:
    """Power spectrum of t e^{λt} relative to its peak, at distances in half bandwidths."""
    return (1.0 + distance**2) ** -2.0


def white(power: np.ndarray, n_modes: int, *, among: int | None = None) -> np.ndarray:
    """Which outputs may have white noise, (n_outputs,): test of the cumulative periodogram (Bartlett; Kolmogorov).

    From the periodogram (n_bins, n_outputs) of the residual; `among` is the number of outputs tested in all.
    """
    bins, m = power.shape
    total = power.sum(axis=0)
    cumulative = np.cumsum(power, axis=0) / np.where(total > 0, total, 1.0)
    deviation = np.abs(cumulative - np.arange(1, bins + 1)[:, None] / bins).max(axis=0)
    # The fit removes about one bin per mode, which does not make the noise coloured.
    threshold = np.sqrt(0.5 * np.log(2.0 * (among or m) / PROJECTION.false_alarm) / bins) + (n_modes + 1) / bins
    return np.asarray(deviation < threshold)


def variances(squares: np.ndarray, free: np.ndarray, apart: np.ndarray | None = None) -> np.ndarray:
    """Variance of the noise, (n_records, n_outputs), pooled over the records where they do not differ.

    Args:
        squares: (n_records, n_outputs) sums of squares of the residual, positive.
        free: (n_records,) or (n_records, n_outputs) degrees of freedom, at least 1.
        apart: (n_outputs,) whether records differ in variance; by `differ` unless given.
    """
    free = _per_output(free, squares)
    apart = differ(squares, free) if apart is None else apart
    return np.asarray(np.where(apart, squares / free, squares.sum(axis=0) / free.sum(axis=0)))


def differ(squares: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Which outputs differ in noise variance between records, (n_outputs,), by Bartlett's test; see `variances`."""
    n, free = len(squares), _per_output(free, squares)
    if n == 1:
        return np.zeros(squares.shape[1], bool)
    total = free.sum(axis=0)
    statistic = total * np.log(squares.sum(axis=0) / total) - (free * np.log(squares / free)).sum(axis=0)
    corrected = statistic / (1.0 + ((1.0 / free).sum(axis=0) - 1.0 / total) / (3.0 * (n - 1)))
    return np.asarray(corrected > chi2.isf(PROJECTION.split_probability, n - 1))


def _per_output(free: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Degrees of freedom of each output in each record, (n_records, n_outputs)."""
    return np.broadcast_to(free[:, None] if free.ndim == 1 else free, squares.shape)
