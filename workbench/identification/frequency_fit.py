"""Modes from measured transfer functions, between whatever lines they were measured.

    H_ji(s) = Σ_r [c_jr l_ri / (s - λ_r) + conjugate] + s^k (D_ji + E_ji / s²)      at s = iω

for outputs that are the k-th time derivative of a displacement: D is what the modes above the band still give, E the
modes below it. Each mode is one shape and one participation of each reference, however many were struck or shaken.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag
from scipy.stats import chi2

from workbench.identification.fit_errors import errors, pole_covariance
from workbench.identification.ibrahim import normalised_shapes
from workbench.identification.identified import FALSE_ALARM, MOST_DAMPED
from workbench.identification.line_noise import noise_with_size
from workbench.identification.modal_count import Told, bases_of, tell, weights_of
from workbench.identification.modal_fit import Fit
from workbench.identification.standard_errors import StandardErrors
from workbench.identification.synthesis import TIME_DERIVATIVE, time_derivatives
from workbench.records.record import Channel
from workbench.structure.modes import SampledModes, frozen

# Lines that are fitted together; of the bands of more, how many, and how many beyond their edges; and a mode's own.
MOST_LINES, BAND, BESIDE_BAND, LINES_A_MODE = 1500, 600, 75, 50
MOST_CANDIDATES, RATES, BESIDE, PEAKS_A_RATE = 600, 6, 25, 10
# Modes by which the noise of the lines is first told, how often it is told, and how far off it may be (rms of log).
STRONGEST, REWEIGHTED, ALIKE = 4, 2, 0.2
# Widths beside a mode, and the chance that even noise is taken for uneven.
DETUNED, LOUDER = np.array([-4.0, -3.0, -2.0, 2.0, 3.0, 4.0]), 0.01


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
        full_hz: bands (lowest, highest line) in which the search stopped at the most modes it might take: what it left
            there is no noise, and what it found is not all, or is no modes but points that disagree.
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
    full_hz: tuple[tuple[float, float], ...]
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

    More than 1500 lines are fitted a band after another, each of which looks beyond its edges.

    Args:
        transfer: (n_outputs, n_frequencies), or (n_outputs, n_references, n_frequencies), complex, outputs per unit
            input; of receptance, mobility or accelerance by the quantity of each channel.
        frequencies_hz: (n_frequencies,) increasing, at any spacing.
        channels: one an output; where no quantity is told, the modes beyond the band may look like any motion.
        band_hz: lowest and highest line to fit; modes beyond are held by residual terms.
        noise_std: standard error of real and imaginary part, of the shape of `transfer`: from repeated measurements,
            or by `coherence_noise`. Without it, noise is taken to be the same at all lines of an output, or to go with
            its size in part where neighbouring lines differ so (`line_noise`), and standard errors grow with what is
            left about each mode where that is louder than elsewhere.
        most_modes: of a band, where to stop at the latest.
        false_alarm: chance that noise alone is taken for a mode.

    Raises:
        ValueError: shapes that do not fit, values that are no numbers, a band with too few lines, no mode.
    """
    h, f, noise = _checked(transfer, frequencies_hz, channels, band_hz, noise_std)
    n_bands, each_own = (1, 3) if f.size <= MOST_LINES else (-(-f.size // BAND), LINES_A_MODE)
    found, share = [], f.size / n_bands
    for k in range(n_bands):
        first, last = round(k * share), round((k + 1) * share)
        inside = slice(max(first - BESIDE_BAND, 0), last + BESIDE_BAND)
        edges = f[first] if k else 0.0, f[last] if last < f.size else np.inf
        told = _told(
            h[..., inside],
            2.0 * np.pi * f[inside],
            _residual_powers(channels),
            None if noise is None else noise[..., inside],
            most_modes=min(most_modes, f[inside].size // each_own),
            false_alarm=false_alarm / n_bands,
        )
        found.append(_modes_of(*told, channels, edges, f[first:last]))
    whole = _together(found, channels) if n_bands > 1 else found[0]
    if whole.modes.n_modes == 0:
        raise ValueError(
            f"no mode rises above the noise between {f[0]:g} and {f[-1]:g} Hz; widen the band or measure with more"
            " averages"
        )
    return whole


def _told(h, omega, powers, noise, **how) -> tuple["_Lines", Told]:
    """The modes of a band; where no noise is told, its course along the lines by what the strongest modes leave."""
    lines = _Lines(h, omega, powers, noise)
    if noise is not None:
        return lines, tell(lines, **how)
    told = tell(lines, **how | {"most_modes": min(STRONGEST, how["most_modes"])})
    before: np.ndarray | None = None
    for _ in range(REWEIGHTED):
        guessed = noise_with_size(lines.left(told.fit), lines.fitted(told.fit))
        if guessed is None or (before is not None and _much_as(guessed, before)):
            break
        before = guessed
        lines = _Lines(h, omega, powers, guessed, guessed=True)
        told = tell(lines, **how)
    return (lines, told) if lines.guessed else (lines, tell(lines, **how))


def _much_as(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether noise runs along the lines of each output as another does, but for its size."""
    return bool(np.log(one / other).std(axis=(1, 2)).max() < ALIKE)


def _modes_of(lines: "_Lines", told: Told, channels, edges_hz: tuple[float, float], shown_hz) -> TransferModes:
    """The modes of a band between its edges; the fit at the lines shown."""
    fit = told.fit
    damped_hz = fit.poles.imag / (2.0 * np.pi)
    within = (fit.poles.imag >= lines.omega[0]) & (fit.poles.imag <= lines.omega[-1])
    inside = np.flatnonzero(within & (damped_hz >= edges_hz[0]) & (damped_hz < edges_hz[1]))
    n = inside.size
    derivative = time_derivatives(channels)[:, None]
    poles, loads = fit.poles[inside], fit.loads[inside]
    seen = fit.amplitudes[:, inside] / poles**derivative
    largest, each = np.abs(seen).argmax(axis=0), np.arange(n)

    def relative(poles, loads, amplitudes):
        seen = amplitudes[:, inside] / poles[inside] ** derivative
        return (seen / seen[largest, each]).real.ravel()

    std = np.zeros((len(channels), n))
    covariance = np.zeros((2 * n, 2 * n))
    if n:
        heard = np.tile(lines.louder_near(fit), (len(channels), 1))
        std = np.sqrt(np.diag(errors(fit, relative, heard))).reshape(len(channels), n)
        std[largest, each] = 0.0
        both = np.r_[inside, fit.poles.size + inside]
        covariance = pole_covariance(fit, heard)[np.ix_(both, both)]
    shapes = normalised_shapes(seen) if n else seen
    at = np.searchsorted(lines.omega, 2.0 * np.pi * shown_hz[0])
    return TransferModes(
        modes=SampledModes(np.abs(poles), -poles.real / np.abs(poles), shapes, _places(channels)),
        covariance=frozen(covariance),
        shape_std=frozen(std),
        participation=frozen(loads * (0.5 * seen[largest, each] / shapes[largest, each])[:, None], complex),
        misfit=frozen(lines.misfit(fit)),
        evidence=frozen(told.evidence[inside]),
        converged=fit.converged,
        full_hz=((float(shown_hz[0]), float(shown_hz[-1])),) if told.full else (),
        fitted=frozen(lines.fitted(fit)[..., at : at + shown_hz.size], complex),
        frequencies_hz=frozen(shown_hz),
    )


def _together(found: Sequence[TransferModes], channels) -> TransferModes:
    """The modes of all bands, each fitted in its own."""
    each = [band.modes for band in found]
    n = [modes.n_modes for modes in each]
    covariance = block_diag(*(band.covariance for band in found))
    first = np.concatenate([np.arange(k) + 2 * sum(n[:i]) for i, k in enumerate(n)]).astype(int)
    both = np.r_[first, first + np.repeat(n, n)]
    omega, zeta = (np.concatenate([getattr(modes, name) for modes in each]) for name in ("omega", "zeta"))
    shapes = np.hstack([modes.shapes for modes in each])
    share = np.array([band.frequencies_hz.size for band in found]) / sum(band.frequencies_hz.size for band in found)
    return TransferModes(
        modes=SampledModes(omega, zeta, shapes, _places(channels)),
        covariance=frozen(covariance[np.ix_(both, both)]),
        shape_std=frozen(np.hstack([band.shape_std for band in found])),
        participation=frozen(np.vstack([band.participation for band in found]), complex),
        misfit=frozen(np.sqrt(share @ np.array([band.misfit for band in found]) ** 2)),
        evidence=frozen(np.concatenate([band.evidence for band in found])),
        converged=all(band.converged for band in found),
        full_hz=tuple(full for band in found for full in band.full_hz),
        fitted=frozen(np.concatenate([band.fitted for band in found], axis=-1), complex),
        frequencies_hz=frozen(np.concatenate([band.frequencies_hz for band in found])),
    )


def _residual_powers(channels) -> list[int]:
    """Of s, with what modes above and below the band leave in it."""
    told = {k for k, c in zip(time_derivatives(channels), channels, strict=True) if c.quantity in TIME_DERIVATIVE}
    above = told or {0, 2}
    return sorted({int(power) for k in above for power in (k, k - 2)})


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
    if not np.isfinite(f).all() or (np.diff(f) <= 0).any():
        raise ValueError("transfer functions need finite frequencies that increase; sort them, each once")
    noise = None if noise_std is None else np.asarray(noise_std, float).reshape(np.shape(transfer)).reshape(h.shape)
    if noise is not None and not ((noise > 0) & np.isfinite(noise)).all():
        raise ValueError("noise_std must be positive and finite at every line; give lines without noise a floor")
    low, high = (0.0, np.inf) if band_hz is None else band_hz
    keep = (f >= low) & (f <= high) & (f > 0)
    if keep.sum() < 12:
        raise ValueError(f"{int(keep.sum())} lines lie between {low:g} and {high:g} Hz; a fit needs 12 or more")
    bad = np.argwhere(~np.isfinite(h[:, :, keep]))
    if len(bad):
        j, _, line = bad[0]
        raise ValueError(f"output {channels[j].name!r} is no number at {f[keep][line]:g} Hz; leave that line out")
    return h[:, :, keep], f[keep], None if noise is None else noise[:, :, keep]


class _Lines:
    """Lines of a spectrum as a `modal_fit.Drive`: rows are real, then imaginary parts, reference by reference."""

    def __init__(
        self, h: np.ndarray, omega: np.ndarray, powers: list[int], noise: np.ndarray | None, guessed=False
    ) -> None:
        self.guessed = guessed
        self.omega, (_, self.refs, self.lines) = omega, h.shape
        self.weights = None if noise is None else 1.0 / self._stacked(noise * (1 + 1j))
        self.values = self._stacked(h) * (1.0 if self.weights is None else self.weights)
        s = 1j * omega / omega[-1]
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

    def fitted(self, fit: Fit) -> np.ndarray:
        """The model at the lines, (n_outputs, n_references, n_frequencies)."""
        return self.unstacked((self.values - fit.residual) / (1.0 if self.weights is None else self.weights))

    def left(self, fit: Fit) -> np.ndarray:
        """What the model leaves at the lines, (n_outputs, n_references, n_frequencies)."""
        return self.unstacked(fit.residual / (1.0 if self.weights is None else self.weights))

    def misfit(self, fit: Fit) -> np.ndarray:
        """Rms of what is left of each output, (n_outputs,), in units of the noise where that was told."""
        if not self.guessed:
            return fit.noise
        raw = fit.residual / self.weights
        return fit.noise * np.sqrt((raw**2).sum(axis=0) / (fit.residual**2).sum(axis=0))

    def louder_near(self, fit: Fit) -> np.ndarray:
        """What is left about each mode as the mode hears it, in power, over the mean of all lines, (n_modes,).

        It is heard by swings a few widths beside the mode, each output as much as it shows the mode. 1 where that may
        be noise alike at all lines.
        """
        residual, noise = fit.residual / fit.noise, fit.noise
        found = np.ones(fit.poles.size)
        if self.weights is not None and not self.guessed:
            return found
        bases, weights = bases_of(self, fit), weights_of(self)
        for r, pole in enumerate(fit.poles):
            shown = (np.abs(fit.amplitudes[:, r]) / noise) ** 2
            width = max(abs(pole.real), 0.5 * self.resolution)
            heard = []
            for beside in pole.imag + width * DETUNED:
                if self.omega[0] < beside < self.omega[-1]:
                    columns = np.hstack(self.answers(-width + 1j * beside))
                    power = []
                    for basis, weight, rest in zip(bases, weights, np.split(residual, len(bases), axis=1), strict=True):
                        # of the rest the amplitudes have taken the noise
                        x = weight * columns - basis @ (basis.T @ (weight * columns))
                        power.append((x.T @ rest) ** 2 / (x**2).sum(axis=0)[:, None])
                    heard.append(np.hstack(power))
            if not heard:
                continue
            power = np.mean(heard, axis=(0, 1)) @ shown / shown.sum()
            degrees = np.size(heard) / shown.size * shown.sum() ** 2 / (shown**2).sum()
            found[r] = power if power > chi2.isf(LOUDER, degrees) / degrees else 1.0
        return found

    def colour(self, residual: np.ndarray, pole: complex) -> float:
        power = (np.abs(self.unstacked(residual)) ** 2).mean(axis=(0, 1))
        at = int(np.argmin(np.abs(self.omega - pole.imag)))
        beside = power[max(at - BESIDE, 0) : at + BESIDE + 1]
        # The median of a power of two degrees of freedom and more is at most its mean.
        return max(1.0, float(np.median(beside) / power.mean()))
