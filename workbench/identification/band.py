"""A band of a record's spectrum, in which its free decay is fitted as exactly as in time.

The discrete Fourier transform of N samples of e^{λt} is, at θ_k = 2πk/N and with μ = e^{λΔt}, in closed form

    g(λ, k) = (1 - μ^N) / (1 - μ e^{-iθ_k}),

no leakage left out, and that of white noise is white. So least squares over some of the bins is maximum likelihood of
those bins, and a band of them is all that a mode in its middle needs: what it leaves outside falls with the cube of
the distance. Scaled by (2/N)^½, real and imaginary parts carry the noise of the samples.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from workbench.records.record import Record

# Width of a band's core: a share of its frequency, so that damped modes fit in, between so many bins.
SHARE, LEAST, MOST = 0.1, 256, 2048
GUARD = 0.25


@dataclass(frozen=True, eq=False)
class Band:
    """Bins of the spectrum of signals, read as samples by what fits them.

    Attributes:
        outputs: (n_outputs, 2 n_bins) real parts of the bins, then imaginary parts.
        first: number of the first bin.
        whole: samples of the record behind it, N.
        sample_time: of that record, s.
    """

    outputs: np.ndarray
    first: int
    whole: int
    sample_time: float

    @property
    def n_samples(self) -> int:
        return self.outputs.shape[1]

    @property
    def n_outputs(self) -> int:
        return self.outputs.shape[0]

    @property
    def bin_width(self) -> float:
        """rad/s from bin to bin."""
        return 2.0 * np.pi / (self.whole * self.sample_time)

    @property
    def bins(self) -> np.ndarray:
        return self.first + np.arange(self.n_samples // 2)

    def columns(self, poles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Φ and tΦ of Re e^{λt} and Im e^{λt}, (2 n_bins, 2 n_modes) each."""
        turn = np.exp(-2j * np.pi * self.bins / self.whole)[:, None]
        above, t_above = self._transformed(poles, turn)
        below, t_below = self._transformed(poles.conj(), turn)
        phi = np.hstack([0.5 * (above + below), -0.5j * (above - below)])
        t_phi = np.hstack([0.5 * (t_above + t_below), -0.5j * (t_above - t_below)])
        return np.vstack([phi.real, phi.imag]), np.vstack([t_phi.real, t_phi.imag])

    def _transformed(self, poles: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mu, last = np.exp(poles * self.sample_time), np.exp(poles * self.sample_time * self.whole)
        w = mu * turn
        # An undamped mode on a bin would divide zero by zero: it is moved by less than anything can tell.
        rest = np.where(np.abs(1.0 - w) < 1e-14, 1e-14, 1.0 - w)
        g = (1.0 - last) / rest
        slope = (w * g - self.whole * last) / rest
        scale = np.sqrt(2.0 / self.whole)
        return scale * g, scale * self.sample_time * slope

    def power(self, residual: np.ndarray) -> np.ndarray:
        """|.|² of each bin, (n_bins, n_outputs), of what a fit left, (2 n_bins, n_outputs)."""
        real, imaginary = np.split(residual, 2)
        return real**2 + imaginary**2


def spectrum(record: Record) -> np.ndarray:
    """Transform of all outputs, (n_outputs, n_samples // 2 + 1), scaled so that noise keeps its standard deviation."""
    scale = np.sqrt(2.0 / record.n_samples)
    found = np.empty((record.n_outputs, record.n_samples // 2 + 1), complex)
    for row, output in zip(found, record.outputs):
        row[:] = scale * np.fft.rfft(output)
    return found


def divided(n_samples: int) -> Iterator[tuple[int, int, int, int]]:
    """Bands of a record as bins: from, core from, core to, to; the cores follow one another without a gap."""
    top = (n_samples - 1) // 2
    start = 1
    while start < top:
        width = int(np.clip(SHARE * start, LEAST, MOST))
        stop = start + width if start + 1.5 * width < top else top
        guard = max(int(GUARD * width), LEAST // 4)
        yield max(1, start - guard), start, stop, min(top, stop + guard)
        start = stop
