"""Modes from measured transfer functions, between whatever lines they were measured.

    H_ji(s) = Σ_r [c_jr l_ri / (s - λ_r) + conjugate] + s^k (D_ji + E_ji / s²)      at s = iω

for outputs that are the k-th time derivative of a displacement: D is what the modes above the band still give, E the
modes below it. Each mode is one shape and one participation of each reference, however many were struck or shaken.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from workbench.identification.driven import pole_covariance
from workbench.identification.ibrahim import normalised_shapes
from workbench.identification.modal_fit import FALSE_ALARM, MOST_DAMPED, errors, tell
from workbench.identification.standard_errors import StandardErrors
from workbench.identification.synthesis import time_derivatives
from workbench.records.record import Channel
from workbench.structure.modes import SampledModes, frozen

MOST_CANDIDATES, RATES, BESIDE, PEAKS_A_RATE = 600, 6, 25, 10


@dataclass(frozen=True, eq=False)
class TransferModes(StandardErrors):
    """Modes of transfer functions.

    Attributes:
        modes: shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ), the Cramér-Rao bound at the estimate.
        shape_std: (n_outputs, n_modes) standard error of the real part of each shape.
        participation: (n_modes, n_references) complex l_r, for c_r the shape as the outputs measure it.
        misfit: (n_outputs,) rms of what is left: in units of the stated noise (1 where it is all there is), or, where
            none was stated, of real and imaginary part each, in the unit of the output.
        evidence: (n_modes,) χ² of each mode in what is left.
        converged: whether the search ended because the step was small.
        fitted: (n_outputs, n_references, n_frequencies) the model at the lines of the band.
        frequencies_hz: (n_frequencies,) those lines.
    """

    modes: SampledModes
    covariance: np.ndarray
    shape_std: np.ndarray = field(repr=False)
    participation: np.ndarray = field(repr=False)
    misfit: np.ndarray
    evidence: np.ndarray
    converged: bool
    fitted: np.ndarray = field(repr=False)
    frequencies_hz: np.ndarray = field(repr=False)


def coherence_noise(transfer: ArrayLike, coherence: ArrayLike, *, averages: int) -> np.ndarray:
    """Standard error of real and imaginary part of transfer functions, |H| ((1 - γ²) / (2 γ² n))^½.

    Args:
        transfer: complex, of any shape.
        coherence: γ², of the same shape, in (0, 1].
        averages: n, independent averages behind both.

    Raises:
        ValueError: a coherence that is none, fewer than two averages.

    Source: Bendat & Piersol, Random Data, 4th ed., section 9.1.
    """
    h, squared = np.asarray(transfer), np.asarray(coherence, float)
    if squared.shape != h.shape or not ((squared > 0) & (squared <= 1)).all() or averages < 2:
        raise ValueError(
            f"coherence must have the shape {h.shape} of the transfer functions, lie in (0, 1], and rest on two"
            f" averages or more; got shape {squared.shape}, {averages} averages"
        )
    return np.abs(h) * np.sqrt((1.0 - squared) / (2.0 * squared * averages))


def identify_transfer(
    transfer: ArrayLike,
    frequencies_hz: ArrayLike,
    *,
    channels: tuple[Channel, ...],
    band_hz: tuple[float, float] | None = None,
    noise_std: ArrayLike | None = None,
    most_modes: int = 40,
    false_alarm: float = FALSE_ALARM,
) -> TransferModes:
    """The modes that measured transfer functions show, as many as there are, each with its standard error.

    Args:
        transfer: (n_outputs, n_frequencies), or (n_outputs, n_references, n_frequencies), complex, outputs per unit
            input; of receptance, mobility or accelerance by the quantity of each channel.
        frequencies_hz: (n_frequencies,) increasing, at any spacing.
        channels: one an output.
        band_hz: lowest and highest line to fit; modes beyond are held by residual terms.
        noise_std: standard error of real and imaginary part, of the shape of `transfer`: from repeated measurements,
            or by `coherence_noise`. Without it, noise is taken to be the same at all lines of an output.
        most_modes: where to stop at the latest.
        false_alarm: chance that noise alone is taken for a mode.

    Raises:
        ValueError: shapes that do not fit, values that are no numbers, a band with too few lines, no mode.
    """
    h, f, noise = _checked(transfer, frequencies_hz, channels, band_hz, noise_std)
    lines = _Lines(h, 2.0 * np.pi * f, time_derivatives(channels), noise)
    told = tell(lines, most_modes=min(most_modes, f.size // 3), false_alarm=false_alarm)
    fit = told.fit
    inside = np.flatnonzero((fit.poles.imag >= lines.omega[0]) & (fit.poles.imag <= lines.omega[-1]))
    n = inside.size
    if n == 0:
        raise ValueError(
            f"no mode rises above the noise between {f[0]:g} and {f[-1]:g} Hz; widen the band or measure with more"
            " averages"
        )
    derivative = time_derivatives(channels)[:, None]
    poles, loads = fit.poles[inside], fit.loads[inside]
    seen = fit.amplitudes[:, inside] / poles**derivative
    shapes, largest, each = normalised_shapes(seen), np.abs(seen).argmax(axis=0), np.arange(n)

    def relative(poles, loads, amplitudes):
        seen = amplitudes[:, inside] / poles[inside] ** derivative
        return (seen / seen[largest, each]).real.ravel()

    std = np.sqrt(np.diag(errors(fit, relative))).reshape(len(channels), n)
    std[largest, each] = 0.0
    both = np.r_[inside, fit.poles.size + inside]
    left = lines.unstacked(fit.residual if lines.weights is None else fit.residual / lines.weights)
    return TransferModes(
        modes=SampledModes(np.abs(poles), -poles.real / np.abs(poles), shapes, _places(channels)),
        covariance=frozen(pole_covariance(fit)[np.ix_(both, both)]),
        shape_std=frozen(std),
        participation=frozen(loads * (0.5 * seen[largest, each] / shapes[largest, each])[:, None], complex),
        misfit=frozen(fit.noise),
        evidence=frozen(told.evidence[inside]),
        converged=fit.converged,
        fitted=frozen(h - left, complex),
        frequencies_hz=frozen(f),
    )


def _places(channels) -> np.ndarray:
    return np.array([np.nan if channel.at is None else channel.at for channel in channels])


def _checked(transfer, frequencies_hz, channels, band_hz, noise_std):
    h, f = np.asarray(transfer, complex), np.asarray(frequencies_hz, float)
    h = h[:, None] if h.ndim == 2 else h
    if h.ndim != 3 or h.shape[0] != len(channels) or h.shape[1] == 0 or f.shape != h.shape[2:]:
        raise ValueError(
            f"transfer functions must have shape ({len(channels)} outputs, [n_references,] {f.size} frequencies); got"
            f" {np.shape(transfer)}. Is frequency the last axis?"
        )
    if not np.isfinite(h).all() or not np.isfinite(f).all() or (np.diff(f) <= 0).any():
        raise ValueError("transfer functions must be finite, at finite frequencies that increase; leave bad lines out")
    noise = None if noise_std is None else np.asarray(noise_std, float).reshape(np.shape(transfer)).reshape(h.shape)
    if noise is not None and not ((noise > 0) & np.isfinite(noise)).all():
        raise ValueError("noise_std must be positive and finite at every line; give lines without noise a floor")
    low, high = (0.0, np.inf) if band_hz is None else band_hz
    keep = (f >= low) & (f <= high) & (f > 0)
    if keep.sum() < 12:
        raise ValueError(f"{int(keep.sum())} lines lie between {low:g} and {high:g} Hz; a fit needs 12 or more")
    return h[:, :, keep], f[keep], None if noise is None else noise[:, :, keep]


class _Lines:
    """Lines of a spectrum as a `modal_fit.Drive`: rows are real, then imaginary parts, reference by reference."""

    def __init__(self, h: np.ndarray, omega: np.ndarray, derivative: np.ndarray, noise: np.ndarray | None) -> None:
        self.omega, (_, self.refs, self.lines) = omega, h.shape
        self.weights = None if noise is None else 1.0 / self._stacked(noise * (1 + 1j))
        self.values = self._stacked(h) * (1.0 if self.weights is None else self.weights)
        s = 1j * omega / omega[-1]
        powers = sorted({int(p) for k in derivative for p in (k, k - 2)})
        self.fixed = self._stacked(np.array([self._of(i, s**p) for i in range(self.refs) for p in powers]))
        self.resolution = float(np.diff(omega).min())
        # A pole may leave the band: one close beyond it is no constant there. It counts among what is left out.
        self.highest = 2.0 * float(omega[-1])
        span = omega[-1] - omega[0]
        self.rates = np.geomspace(0.3 * self.resolution, max(0.03 * span, self.resolution), RATES)
        self.cells = RATES * self.lines

    def _stacked(self, values: np.ndarray) -> np.ndarray:
        rows = values.reshape(values.shape[0], -1).T
        return np.vstack([rows.real, rows.imag])

    def _of(self, reference: int, values: np.ndarray) -> np.ndarray:
        found = np.zeros((self.refs, self.lines), complex)
        found[reference] = values
        return found

    def unstacked(self, rows: np.ndarray) -> np.ndarray:
        real, imaginary = np.split(rows, 2)
        return (real + 1j * imaginary).T.reshape(-1, self.refs, self.lines)

    def answers(self, pole: complex) -> tuple[np.ndarray, np.ndarray]:
        s = 1j * self.omega
        above, below = 1.0 / (s - pole), 1.0 / (s - pole.conjugate())
        pair = (0.5 * (above + below), -0.5j * (above - below))
        real, imaginary = (self._stacked(np.array([self._of(i, x) for i in range(self.refs)])) for x in pair)
        return real, imaginary

    def slopes(self, pole: complex, loads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = 1j * self.omega
        above = loads[:, None] / (s - pole) ** 2
        below = loads.conj()[:, None] / (s - pole.conjugate()) ** 2
        pair = (0.5 * (above + below), -0.5j * (above - below))
        real, imaginary = (self._stacked(x[None])[:, 0] for x in pair)
        return real, imaginary

    def candidates(self, residual: np.ndarray) -> np.ndarray:
        left = self.unstacked(residual if self.weights is None else residual * self.weights).reshape(-1, self.lines)
        weight = 1.0 if self.weights is None else (np.abs(self.unstacked(self.weights)) ** 2).mean(axis=(0, 1)) / 2.0
        power = (np.abs(left) ** 2).sum(axis=0)
        at = np.sort(np.argsort(power)[-MOST_CANDIDATES:])
        found, strength = [], []
        for rate in self.rates:
            x = 1.0 / (1j * (self.omega - self.omega[at, None]) + rate)
            score = (np.abs(left @ x.conj().T) ** 2).sum(axis=0) / (np.abs(x) ** 2 * weight).sum(axis=1)
            score[rate > MOST_DAMPED * self.omega[at]] = 0.0
            best = np.argsort(score)[-PEAKS_A_RATE:]
            found.append(-rate + 1j * self.omega[at[best]])
            strength.append(score[best])
        order = np.argsort(np.concatenate(strength))[::-1]
        beyond = np.r_[0.6 * self.omega[0], 0.9 * self.omega[0], np.array([1.05, 1.2, 1.5]) * self.omega[-1]]
        return np.r_[np.concatenate(found)[order[: 3 * PEAKS_A_RATE]], (-0.01 + 1j) * beyond]

    def colour(self, residual: np.ndarray, pole: complex) -> float:
        power = (np.abs(self.unstacked(residual)) ** 2).mean(axis=(0, 1))
        at = int(np.argmin(np.abs(self.omega - pole.imag)))
        beside = power[max(at - BESIDE, 0) : at + BESIDE + 1]
        # The median of a power of two degrees of freedom and more is at most its mean.
        return max(1.0, float(np.median(beside) / power.mean()))
