"""Long records of many modes, told band by band at a cost that grows with the samples and no faster.

A mode is settled by the bins about its frequency, so each band of the spectrum is told by itself as in `order`, seen
only along the directions of the sensors that stand out of its noise. Modes of a band's core are kept. In a second
round what the modes outside a band leave in it is taken away first, and all poles are refined together at the end.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.fft import next_fast_len

from workbench.identification.band import Band, divided, spectrum
from workbench.identification.order import FALSE_ALARM, LEAST_APART, MOST_DAMPED, Told, unshaped
from workbench.identification.refinement import Refined, refine, search
from workbench.records.record import Record

ROUNDS = 2
TOGETHER = 2


def identify_in_bands(record: Record, *, false_alarm: float = FALSE_ALARM) -> Refined:
    """The modes that a long free decay holds, as many as there are, each with its standard error.

    What `identify` says of a short record, at a cost linear in the samples. The poles are refined together on the
    whole record: look at `converged`. Where many modes crowd within a few hundred bins some are missed and the search
    does not settle; then measure longer, or take `identify`.

    Args:
        record: free decay in white noise; each output may hold a constant.
        false_alarm: chance that noise alone is taken for a mode.

    Raises:
        ValueError: no mode rises above the noise.
    """
    poles = told_in_bands(record, false_alarm=false_alarm)
    if poles.size == 0:
        raise ValueError(
            f"record {record.name!r} holds no mode that rises above its noise: is it a free decay? Cut it to the decay,"
            " measure longer or strike harder"
        )
    return refine(record, unshaped(poles, record), offset=True)


def told_in_bands(record: Record, *, false_alarm: float = FALSE_ALARM, rounds: int = ROUNDS) -> np.ndarray:
    """Poles of the modes that a long free decay holds, (n_modes,), by rising frequency.

    Args:
        record: free decay in white noise; each output may hold a constant.
        false_alarm: chance that noise alone is taken for a mode.
        rounds: over all bands; from the second on they are told without what the modes outside leave in them.
    """
    bins = spectrum(record)
    noise = np.sqrt(np.median(np.abs(bins[:, 1:]) ** 2, axis=1) / (2.0 * np.log(2.0)))
    noise = np.maximum(noise, 1e-12 * noise.max() + 1e-300)
    bins /= noise[:, None]
    edges = list(divided(record.n_samples))
    poles, amplitudes = np.zeros(0, complex), np.zeros((record.n_outputs, 0), complex)
    for _ in range(rounds):
        tasks = [(record, bins, edge, poles, amplitudes, false_alarm, len(edges)) for edge in edges]
        with ThreadPoolExecutor(2) as pool:
            parts = list(pool.map(lambda task: _core(*task), tasks))
        poles = _joined(parts, record)
        if poles.size == 0:
            break
        # What one band's modes leave in another is settled by a step or two of all together.
        poles, (fit,), *_ = search([record], poles, 1.0 / noise, True, TOGETHER)
        amplitudes = fit.complex_amplitudes / noise[:, None]
    return poles[np.argsort(np.abs(poles))]


def _core(record, bins, edge, poles, amplitudes, false_alarm, n_bands) -> np.ndarray:
    """Poles of one band's core, those known outside taken away and those known inside to start from."""
    first, core, end, last = edge
    width = 2.0 * np.pi / (record.n_samples * record.sample_time)
    inside = (poles.imag >= first * width) & (poles.imag < last * width)
    band = _band(record, bins, first, last)
    if (~inside).any():
        outside = poles[~inside]
        band = _less(band, outside, amplitudes[:, ~inside])
    seen = _standing_out(band)
    if seen.n_outputs == 0:
        return np.zeros(0, complex)
    told = Told([seen], [BandGrid(seen)], false_alarm / n_bands)
    told.poles = poles[inside]
    told.prune()
    for _ in range(3):
        if not (told.grow(200) and told.prune()):
            break
    here = (told.poles.imag >= (core - 0.5) * width) & (told.poles.imag < (end + 0.5) * width)
    return told.poles[here]


def _joined(parts: Sequence[np.ndarray], record: Record) -> np.ndarray:
    """The poles of all bands; one that stands on the edge of two is told by both and counts once."""
    bin_width = 2.0 * np.pi / (record.n_samples * record.sample_time)
    joined = np.zeros(0, complex)
    for poles in parts:
        twice = np.abs(poles[:, None] - joined) < bin_width
        joined = np.append(joined, poles[~twice.any(axis=1)])
    return joined


def _band(record: Record, bins: np.ndarray, first: int, last: int) -> Band:
    part = bins[:, first:last]
    return Band(np.hstack([part.real, part.imag]), first, record.n_samples, record.sample_time)


def _less(band: Band, poles: np.ndarray, amplitudes: np.ndarray) -> Band:
    """The band without modes of complex amplitudes a = α - iβ, (n_outputs, n_modes)."""
    model = np.hstack([amplitudes.real, -amplitudes.imag]) @ band.columns(poles)[0].T
    return Band(band.outputs - model, band.first, band.whole, band.sample_time)


def _standing_out(band: Band) -> Band:
    """The band along the directions of its sensors whose strength noise does not reach.

    Singular values of noise end at √rows + √columns (Marchenko & Pastur); the median of the band sets its level.
    """
    gram = band.outputs @ band.outputs.T
    strength, directions = np.linalg.eigh(gram)
    level = np.median(strength) / max(band.n_samples, 1)
    edge = level * (np.sqrt(band.n_samples) + np.sqrt(band.n_outputs)) ** 2
    keep = strength > 1.05 * edge
    if band.n_outputs < 16:
        keep[:] = True
    return Band(directions[:, keep].T @ band.outputs, band.first, band.whole, band.sample_time)


class BandGrid:
    """Swings e^{λt} to compare a band with, every half bin: rates of decay by frequencies, (n_rates, n_frequencies).

    A band away from frequency zero tells a swing from its conjugate, so that one complex column stands for both.
    """

    offset = False

    def __init__(self, band: Band) -> None:
        self.band, self.nothing = band, band.outputs.T
        self.bin_width, k = band.bin_width, band.bins
        self.lowest = k[0] * self.bin_width
        self.size = next_fast_len(2 * k.size)
        span = band.whole * band.sample_time
        fastest = 0.25 * k.size * self.bin_width
        self.rates = np.r_[
            0.0, np.geomspace(1.0 / span, max(fastest, 2.0 / span), max(int(np.log(fastest * span)) + 1, 2))
        ]
        omega = self.bin_width * (k[0] + 0.5 * np.arange(2 * k.size - 1))
        self.poles = -self.rates[:, None] + 1j * omega
        self.allowed = self.rates[:, None] < MOST_DAMPED * omega
        self.n_cells = int(self.allowed.sum())
        kernels = [self._kernels(rate) for rate in self.rates]
        self.kernels = [[np.fft.fft(h).conj() for h in pair] for pair in kernels]
        ones = np.fft.fft(np.ones(k.size), self.size)
        self.whole = [
            self._woven([np.fft.ifft(ones * np.fft.fft(np.abs(h) ** 2).conj())[: k.size].real for h in pair])
            for pair in kernels
        ]

    def _kernels(self, rate: float) -> list[np.ndarray]:
        """g(λ, k) by the distance of k from the swing's own bin, wrapped; for swings on a bin and between two."""
        n, size = self.band.bins.size, self.size
        distance = np.r_[np.arange(n), np.full(size - 2 * n + 1, n), np.arange(-n + 1, 0)].astype(float)
        decay, whole = rate * self.band.sample_time, self.band.whole
        found = []
        for half in (0.0, 0.5):
            last = np.exp(-decay * whole) * (1.0 if half == 0.0 else -1.0)
            rest = 1.0 - np.exp(-decay - 2j * np.pi * (distance - half) / whole)
            on = np.abs(rest) < 1e-14
            g = np.where(on, whole, (1.0 - last) / np.where(on, 1.0, rest))
            found.append(np.sqrt(2.0 / whole) * g)
        return found

    @staticmethod
    def _woven(pair: Sequence[np.ndarray]) -> np.ndarray:
        """Values on bins and between them, by rising frequency; beyond the last bin there is none."""
        return np.stack(pair, axis=-1).reshape(*pair[0].shape[:-1], -1)[..., :-1]

    def _along(self, transform: np.ndarray, r: int) -> np.ndarray:
        """Inner products of rows, given by their transforms, with every swing of one rate."""
        n = self.band.bins.size
        return self._woven([np.fft.ifft(transform * kernel, axis=-1)[..., :n] for kernel in self.kernels[r]])

    def power(self, residual: np.ndarray) -> np.ndarray:
        return self.band.power(residual)

    def near(self, pole: complex, bins: float) -> np.ndarray:
        """Frequencies within so many bins, or half as many rates of decay, of a pole's."""
        return np.abs(self.poles[0].imag - pole.imag) < bins * max(self.bin_width, 0.5 * abs(pole.real))

    def strengths(self, residual: np.ndarray, weights: np.ndarray, poles: np.ndarray) -> np.ndarray:
        """χ² of each swing, (n_rates, n_frequencies); 0 where it cannot be told from the modes there already."""
        real, imaginary = np.split(residual * weights, 2)
        left = np.fft.fft((real + 1j * imaginary).T, self.size)
        basis = None
        if poles.size:
            phi = self.band.columns(poles)[0]
            above = phi[:, : poles.size] + 1j * phi[:, poles.size :]
            n = self.band.bins.size
            # (Φ_c + iΦ_s) holds g(λ) as its complex bins
            q = np.linalg.qr(above[:n] + 1j * above[n:])[0]
            basis = np.fft.fft(q.T, self.size)
        found = np.zeros(self.poles.shape)
        for r in range(self.rates.size):
            own = (np.abs(self._along(left, r)) ** 2).sum(axis=0)
            apart = self.whole[r]
            if basis is not None:
                apart = apart - (np.abs(self._along(basis, r)) ** 2).sum(axis=0)
            good = self.allowed[r] & (apart > LEAST_APART * self.whole[r])
            found[r] = np.where(good, own / np.where(good, apart, 1.0), 0.0)
        return found
