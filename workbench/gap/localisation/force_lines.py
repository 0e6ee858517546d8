"""One force at a point, of any law: what it leaves of a residual, line by line of the spectrum.

At a line of frequency ω the residual of a record is

    r = h(x) g + T d + noise        h(x) = Φ_s (Ω² - ω² + iω C)⁻¹ φ(x),  T = Φ_s (z - A)⁻¹ z,  z = e^{iωΔt}

with g, the force there, any number at all; d is the state at the start of the record less that at its end, one for all
lines. What no g accounts for is noise where x is right. A line counts by how far the force stands out of the noise in
it, with weights that do not depend on x: a wrong idea of the force's spectrum then costs precision, and biases nothing.

Projections on one unknown source: Stoica & Nehorai, IEEE Trans. Acoust. Speech Signal Process. 37 (1989) 720.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from workbench.gap.localisation.receptance import Receptances, real_product, receptances_of
from workbench.gap.prediction.unmodelled_force import SampledModel
from workbench.rig.rig import Rig

TOP = 0.9  # of half the sample rate: above, what is folded down is no longer small
MOST_LINES = 8192  # of a record: of a longer one every so many, which costs precision alone
WIDTH = 75  # lines over which the spectrum of the force is taken to be flat
CHANCE = 2.0  # deviations by which noise may pass for a force in them
COUNTING = 0.02  # weight below which a line is left out
SCREENED = 300  # lines, the strongest, where many places are compared
ROUNDS = 4  # of the spectrum of the force, each weighted by the one before


@dataclass(frozen=True, eq=False)
class Lines:
    """A record's residual at the lines of its spectrum, in units of the noise, and what it is made of.

    Attributes:
        receptances: of the rig, to forces and to states at the ends.
        left: (n_lines, n_sensors) the residual; its noise has unit variance.
        weights: (n_lines,).
    """

    receptances: Receptances
    left: np.ndarray
    weights: np.ndarray

    @cached_property
    def _products(self) -> tuple[np.ndarray, np.ndarray]:
        return self.receptances.products(self.left, self.weights)

    @property
    def freedom(self) -> int:
        """Values that stay noise once a force, of any law, and the ends are accounted for."""
        n_lines, n_sensors = self.left.shape
        return int(max(2 * n_lines * (n_sensors - 1) - self._products[1].size, 0))

    @cached_property
    def power(self) -> float:
        """Sum of squares of the residual."""
        return float(2.0 * self.weights @ np.sum(np.abs(self.left) ** 2, axis=1))

    def weighted(self, weights: np.ndarray) -> "Lines":
        """The lines by other weights (n_lines,), without those that count for nothing."""
        kept = weights > COUNTING
        return Lines(self.receptances.on(kept), self.left[kept], weights[kept])

    def misfit(self, shape: np.ndarray) -> float:
        """Sum of squares that a force leaves where the modes have that shape (n_modes,)."""
        u, a, _ = self._along(shape)
        root = np.sqrt(self.weights)
        a = a * root
        end, along = self._end(u * root[:, None], a)
        return self.power - 2.0 * float(np.sum(np.abs(a) ** 2)) - float(along @ end)

    def force_share(self, shape: np.ndarray) -> np.ndarray:
        """Share (n_lines,) of a force there in what is read along it: the weight of each line."""
        u, a, power = self._along(shape)
        share, sure = np.ones_like(power), np.ones_like(power)
        for _ in range(ROUNDS):
            root = np.sqrt(share)
            end, _ = self._end(u * root[:, None], a * root)
            read = (np.abs(a - u @ end) ** 2 - 1.0) / power
            chance = CHANCE * np.sqrt(_smooth((sure / power) ** 2))
            spectrum = np.maximum(_smooth(sure * read) - chance, 0.0) / _smooth(sure)
            share = spectrum * power / (1.0 + spectrum * power)
            # a force far above the noise has all of a line, but for rounding
            sure = (power * np.maximum(1.0 - share, np.finfo(float).eps)) ** 2
        return share

    def _end(self, u: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The ends by what a force leaves of the record, given the tail and the residual along it; and their pull."""
        own, along = self._products
        along = along - real_product(u, a)
        return np.linalg.lstsq(own - real_product(u, u), along, rcond=1e-12)[0], along

    def _along(self, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The tail and the residual along the reading of a force, and that reading's power."""
        h = self.receptances.to_force(shape)
        power = np.maximum(np.sum(np.abs(h) ** 2, axis=1), 1e-300)
        h = (h / np.sqrt(power)[:, None]).conj()
        return self.receptances.along(h), np.sum(h * self.left, axis=1), power


def screened(lines: Lines, shapes: np.ndarray) -> np.ndarray:
    """About what a force leaves where the modes have each of many shapes (n_places, n_modes).

    The ends of the record are left out, and lines where little is read.
    """
    strong = np.argsort(-lines.weights * np.sum(np.abs(lines.left) ** 2, axis=1))[:SCREENED]
    power = lines.power
    lines = Lines(lines.receptances.on(strong), lines.left[strong], lines.weights[strong])
    to_force = np.moveaxis(np.array([lines.receptances.to_force(mode) for mode in np.eye(shapes.shape[1])]), 0, 2)
    left = np.full(len(shapes), power)
    for h, r, weight in zip(to_force, lines.left, lines.weights, strict=True):
        seen = h @ shapes.T
        left -= 2.0 * weight * np.abs(r.conj() @ seen) ** 2 / np.maximum(np.sum(np.abs(seen) ** 2, axis=0), 1e-300)
    return left


def _smooth(values: np.ndarray) -> np.ndarray:
    width = min(WIDTH, values.size)
    return np.convolve(np.pad(values, (width // 2, width - 1 - width // 2), mode="edge"), np.ones(width), mode="valid")


def lines_of(rig: Rig, model: SampledModel, residuals: Sequence[np.ndarray], sample_time: float) -> list[Lines]:
    """The lines of every record.

    Args:
        rig: nominal.
        model: its sampled form, with the variance of each sensor's noise.
        residuals: (n_sensors, n_samples) a record, in the sensors' units.
        sample_time: s.
    """
    noise = np.sqrt(model.noise_variance)
    made: dict[int, tuple[np.ndarray, Receptances]] = {}
    lines = []
    for residual in residuals:
        n = residual.shape[1]
        if n not in made:
            top = max(int(0.5 * TOP * n), 2)
            taken = np.arange(1, top, 1 + top // MOST_LINES)
            made[n] = taken, receptances_of(rig, model, 2.0 * np.pi * taken / (n * sample_time), n, sample_time)
        taken, receptances = made[n]
        left = np.fft.rfft(residual, axis=1)[:, taken].T / noise
        lines.append(Lines(receptances, left / np.sqrt(n), np.ones(taken.size)))
    return lines
