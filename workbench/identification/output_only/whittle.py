"""Most likely modes of a spectrum: outputs that unknown forces drive, each mode in its own band.

Transforms of a long record are independent from line to line, normal, of covariance S(ω_k) (Whittle, 1953), and S is
the transform of R(k) = Re Σ φ_r c_r^T e^{λ_r k Δt}, k > 0,

    S = Z + Z^H + B,   Z = ½ Σ_r [φ_r c_r^T g(μ_r) + conjugates of φ_r, c_r, μ_r],   g(μ) = μ / (z - μ)

with z = e^{iωΔt}, μ = e^{λΔt}, nothing left out between samples. B, Hermitian, is the same over a band: noise of the
sensors, and what forces and modes elsewhere leave there; forces need be white no further than a band is wide. So

    L = -Σ_k (ln det S_k + tr S_k^-1 P_k),     F_ab = Σ_k tr(S_k^-1 ∂_a S_k S_k^-1 ∂_b S_k)

of the bands' own unknowns, P_k the products of the transforms; F^-1 is the Cramér-Rao bound.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal.windows import tukey

# A taper at both ends keeps strong modes from leaking into far weak ones.
TAPERED = 0.1
# A band reaches so many half-widths, and lines, beyond its modes, and is averaged to so many parts of a half-width.
REACH, LEAST_LINES, PARTS, MOST_PARTS = 20.0, 40, 6, 400
# Modes so many half-widths apart, both taken together, are fitted together.
TOGETHER = 10.0
DEGREE = 1
MOST_STEPS, MOST_SWEEPS, SETTLED = 40, 3, 1e-2
LEAST_TOLD = 1e-10
# A mode narrower than so many lines would answer single ones, and no record is too unlikely for that.
NARROWEST = 3.0
# Nor for a spectrum that is singular at a line, across what is seen there: the mean of a few lines keeps it from that.
LEAST_OF_MEAN = 0.05


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Transforms of the outputs along some directions.

    Attributes:
        values: (n_directions, n_lines) complex, of lines 1 to n_lines.
        spacing: between lines, rad/s.
        sample_time: s.
        loss: variance that the taper costs, over what there would be without.
    """

    values: np.ndarray
    spacing: float
    sample_time: float
    loss: float

    @classmethod
    def of(cls, outputs: np.ndarray, sample_time: float) -> "Spectrum":
        """Of outputs (n_outputs, n_samples)."""
        n = outputs.shape[1]
        taper = tukey(n, TAPERED)
        about = outputs - outputs.mean(axis=1, keepdims=True)
        values = np.fft.rfft(about * taper / np.sqrt((taper**2).sum()), axis=1)[:, 1:]
        loss = n * (taper**4).sum() / (taper**2).sum() ** 2
        return cls(values, 2.0 * np.pi / (n * sample_time), sample_time, float(loss))

    def along(self, directions: np.ndarray) -> "Spectrum":
        """Seen along (n_outputs, n_directions)."""
        return replace(self, values=directions.T @ self.values)


@dataclass(frozen=True, eq=False)
class Swing:
    """A mode as a spectrum holds it: pole, shape φ and drive c, (n_directions,) complex each."""

    pole: complex
    shape: np.ndarray
    drive: np.ndarray

    @property
    def height(self) -> float:
        """Of its peak, over what a whole sample time would give."""
        return float(np.linalg.norm(self.shape) * np.linalg.norm(self.drive) / abs(self.pole.real))

    def spectrum(self, z: np.ndarray, dt: float) -> np.ndarray:
        """What it gives S at z, (n_lines, n_directions, n_directions)."""
        mu = np.exp(self.pole * dt)
        a = 0.5 * np.outer(self.shape, self.drive)
        half = a * _resonance(mu, z)[:, None, None] + a.conj() * _resonance(mu.conj(), z)[:, None, None]
        return half + _adjoint(half)


@dataclass(frozen=True, eq=False)
class Band:
    """Modes fitted together.

    Attributes:
        swings: the modes.
        covariance: (2 n, 2 n) of Re λ, then Im λ.
        cost: -L at the end.
        converged: whether the search ended because the step was small.
    """

    swings: tuple[Swing, ...]
    covariance: np.ndarray
    cost: float
    converged: bool


def fit_bands(spectrum: Spectrum, swings: Sequence[Swing]) -> list[tuple[list[int], Band]]:
    """The most likely modes near those given: bands, each with the indices of its modes.

    What a mode gives to other bands is taken from the last fit of its own, until no pole moves any more.
    """
    found, groups = list(swings), bands(spectrum, [swing.pole for swing in swings])
    for sweep in range(MOST_SWEEPS):
        before = np.array([swing.pole for swing in found])
        fitted = []
        for group in groups:
            others = [swing for r, swing in enumerate(found) if r not in group]
            band = fit_band(spectrum, [found[r] for r in group], others)
            fitted.append((group, band))
            for r, swing in zip(group, band.swings, strict=True):
                found[r] = swing
        std = np.sqrt(np.concatenate([np.diag(band.covariance).reshape(2, -1).sum(axis=0) for _, band in fitted]))
        moved = np.abs(np.array([swing.pole for swing in found]) - before)[np.concatenate(groups).astype(int)]
        if len(groups) == 1 or (sweep and (moved < 0.05 * std).all()):
            break
    return fitted


def bands(spectrum: Spectrum, poles: Sequence[complex]) -> list[list[int]]:
    """Indices of the modes that cannot be told one without the other."""
    groups: list[list[int]] = []
    for r in np.argsort(np.imag(poles)):
        if groups and any(
            poles[r].imag - poles[s].imag < TOGETHER * (abs(poles[r].real) + abs(poles[s].real)) + 2 * spectrum.spacing
            for s in groups[-1]
        ):
            groups[-1].append(int(r))
        else:
            groups.append([int(r)])
    return groups


def started(spectrum: Spectrum, pole: complex, shape: np.ndarray) -> Swing:
    """A mode of known pole and shape, as strong as its peak."""
    dt = spectrum.sample_time
    width = max(abs(pole.real), 1.1 * NARROWEST * spectrum.spacing)
    lines = _lines(spectrum, pole.imag - width, pole.imag + width)
    power = (np.abs(shape.conj() @ spectrum.values[:, lines]) ** 2).mean() / np.linalg.norm(shape) ** 4
    return Swing(-width + 1j * pole.imag, shape.astype(complex), power * width * dt * shape.conj())


def fit_band(
    spectrum: Spectrum,
    swings: Sequence[Swing],
    others: Sequence[Swing],
    about: Sequence[Swing] | None = None,
    most_steps: int = MOST_STEPS,
) -> Band:
    """The modes of one band, what the others give it held, by Fisher scoring; the band `about` some modes, or these."""
    task, swings = posed(spectrum, swings, others, swings if about is None else about)
    background = task.start(swings)
    cost, damping, settled = task.cost(swings, background), 1e-3, False
    for _ in range(most_steps):
        fisher, slope = task.scores(swings, background)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(fisher), 1e-300))
        matrix, steep, one = fisher * np.outer(scale, scale), scale * slope, np.eye(slope.size)
        settled = steep @ np.linalg.solve(matrix + LEAST_TOLD * one, steep) < SETTLED
        there = np.inf
        while not settled and there > cost and damping < 1e6:
            trial = task.moved(swings, background, scale * np.linalg.solve(matrix + damping * one, steep))
            there = task.cost(*trial)
            damping *= 8.0
        if there > cost:
            break
        (swings, background), cost, damping = trial, there, max(damping / 80.0, 1e-9)
    fisher, _ = task.scores(swings, background)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fisher), 1e-300))
    values, vectors = np.linalg.eigh(fisher * np.outer(scale, scale))
    # What cannot be told is as uncertain as can be, not certain.
    whole = (vectors / np.maximum(values, LEAST_TOLD)) @ vectors.T * np.outer(scale, scale)
    at = task.size * np.arange(len(swings))
    both = np.r_[at, at + 1].astype(int)
    return Band(tuple(swings), whole[np.ix_(both, both)], cost, bool(settled))


def posed(
    spectrum: Spectrum, swings: Sequence[Swing], others: Sequence[Swing], about: Sequence[Swing]
) -> tuple["Task", tuple[Swing, ...]]:
    """The likelihood of a band, and its modes with the largest entry of each shape 1, which is held."""
    held = [int(np.argmax(np.abs(swing.shape))) for swing in swings]
    each = zip(swings, [swing.shape[k] for swing, k in zip(swings, held, strict=True)], strict=True)
    scaled = tuple(replace(swing, shape=swing.shape / by, drive=swing.drive * by) for swing, by in each)
    return Task(spectrum, others, about, held), scaled


class Task:
    """One band: unknowns are, mode by mode, Re λ, Im λ, φ but its largest entry, c, and then B."""

    def __init__(self, spectrum: Spectrum, others: Sequence[Swing], about: Sequence[Swing], held: list[int]) -> None:
        self.z, power, counts, mean = _averaged(spectrum, about)
        self.least = LEAST_OF_MEAN * mean
        self.power, self.counts, self.held = power, counts / spectrum.loss, held
        self.dt, self.narrowest = spectrum.sample_time, NARROWEST * spectrum.spacing
        self.fixed = sum((swing.spectrum(self.z, self.dt) for swing in others), np.zeros_like(power))
        self.p = power.shape[1]
        self.size = 4 * self.p
        self.hermitian = _hermitian_basis(self.p)
        # Where the band begins and ends it is -1 and 1.
        self.across = np.vstack([np.linspace(-1.0, 1.0, self.z.size) ** k for k in range(DEGREE + 1)])

    def start(self, swings: Sequence[Swing]) -> np.ndarray:
        """A background that leaves S positive."""
        quiet = np.ones(self.z.size, bool)
        omega = np.angle(self.z) / self.dt
        for swing in swings:
            quiet &= np.abs(omega - swing.pole.imag) > 0.5 * REACH * abs(swing.pole.real)
        quiet = quiet if quiet.sum() >= 2 * self.p else np.ones(self.z.size, bool)
        level = np.linalg.eigvalsh(self.power[quiet].mean(axis=0))
        floor = np.zeros((DEGREE + 1, self.p, self.p), complex)
        floor[0] = max(level[0], 1e-6 * level[-1]) * np.eye(self.p)
        whole = self.whole(swings, floor) - self.least
        floor[0] += max(0.0, 1.1 * float((-np.linalg.eigvalsh(whole)[:, 0]).max()) + level[0]) * np.eye(self.p)
        return floor

    def whole(self, swings: Sequence[Swing], background: np.ndarray) -> np.ndarray:
        level = np.einsum("dij,dk->kij", background, self.across)
        return sum((swing.spectrum(self.z, self.dt) for swing in swings), self.fixed + level)

    def cost(self, swings: Sequence[Swing], background: np.ndarray) -> float:
        if any(-s.pole.real < self.narrowest or not 0 < s.pole.imag * self.dt < np.pi for s in swings):
            return np.inf
        s = self.whole(swings, background)
        try:
            root = np.linalg.cholesky(s)
            np.linalg.cholesky(s - self.least)
        except np.linalg.LinAlgError:
            return np.inf
        logs = 2.0 * np.log(np.einsum("kii->ki", root).real).sum(axis=1)
        return float(self.counts @ (logs + np.einsum("kij,kji->k", np.linalg.inv(s), self.power).real))

    def scores(self, swings: Sequence[Swing], background: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fisher's information and the slope of L."""
        inverse = np.linalg.inv(self.whole(swings, background))
        changes = np.concatenate([self._changes(s, k) for s, k in zip(swings, self.held, strict=True)] + [self._levels])
        x = inverse @ changes
        over = inverse @ self.power - np.eye(self.p)
        slope = np.einsum("akij,kji,k->a", x, over, self.counts).real
        flat = x.reshape(len(x), -1)
        turned = (self.counts[:, None, None] * x.swapaxes(-1, -2)).reshape(len(x), -1)
        return (flat @ turned.T).real, slope

    @property
    def _levels(self) -> np.ndarray:
        return np.einsum("aij,dk->dakij", self.hermitian, self.across).reshape(-1, self.z.size, self.p, self.p)

    def _changes(self, swing: Swing, k: int) -> np.ndarray:
        """∂S by each unknown of a mode, (n_unknowns, n_lines, n_directions, n_directions)."""
        mu = np.exp(swing.pole * self.dt)
        here, mirrored = (_resonance(m, self.z) for m in (mu, mu.conj()))
        slope, mirrored_slope = (self.dt * m * self.z / (self.z - m) ** 2 for m in (mu, mu.conj()))
        unit = np.eye(self.p)
        a = 0.5 * np.outer(swing.shape, swing.drive)
        shapes = [0.5 * np.outer(unit[j], swing.drive) for j in range(self.p) if j != k]
        drives = [0.5 * np.outer(swing.shape, unit[j]) for j in range(self.p)]
        found = []
        for matrices, f, g in (([a], slope, mirrored_slope), ([*shapes, *drives], here, mirrored)):
            for matrix in matrices:
                up, down = matrix * f[:, None, None], matrix.conj() * g[:, None, None]
                found += [up + down, 1j * (up - down)]
        half = np.array(found)
        return half + _adjoint(half)

    def moved(self, swings: Sequence[Swing], background: np.ndarray, move: np.ndarray):
        each = move[: self.size * len(swings)].reshape(len(swings), self.size)
        found = []
        for swing, step, k in zip(swings, each, self.held, strict=True):
            step = step[0::2] + 1j * step[1::2]
            shape = swing.shape + np.insert(step[1 : self.p], k, 0.0)
            found.append(Swing(swing.pole + step[0], shape, swing.drive + step[self.p :]))
        return tuple(found), background + np.tensordot(move[each.size :].reshape(DEGREE + 1, -1), self.hermitian, 1)


def _resonance(mu: complex, z: np.ndarray) -> np.ndarray:
    return mu / (z - mu)


def _adjoint(matrices: np.ndarray) -> np.ndarray:
    return matrices.conj().swapaxes(-1, -2)


def _hermitian_basis(p: int) -> np.ndarray:
    found = []
    for i in range(p):
        for j in range(i + 1):
            e = np.zeros((p, p), complex)
            e[i, j] = e[j, i] = 1.0
            found.append(e)
            if i != j:
                found.append(1j * (np.tril(e) - np.triu(e)))
    return np.array(found)


def _lines(spectrum: Spectrum, low: float, high: float) -> slice:
    """Lines within, rad/s, and one at least."""
    n = spectrum.values.shape[1]
    first = int(np.clip(np.ceil(low / spectrum.spacing) - 1, 0, n - 1))
    return slice(first, max(first + 1, min(int(np.floor(high / spectrum.spacing)), n)))


def _averaged(spectrum: Spectrum, swings: Sequence[Swing]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """z, products of the transforms, how many lines each stands for, and their mean over a few lines about, over the
    band of some modes."""
    centre, width = np.array([[s.pole.imag, abs(s.pole.real)] for s in swings]).T
    reach = np.maximum(np.minimum(REACH * width, 0.5 * centre), LEAST_LINES * spectrum.spacing)
    band = _lines(spectrum, max((centre - reach).min(), 2.5 * spectrum.spacing), (centre + reach).max())
    values = spectrum.values[:, band]
    size = max(1, int(width.min() / PARTS / spectrum.spacing), values.shape[1] // MOST_PARTS)
    edges = np.arange(0, values.shape[1], size)
    counts = np.diff(np.r_[edges, values.shape[1]])
    products = np.einsum("ik,jk->kij", values, values.conj())
    power = np.add.reduceat(products, edges, axis=0) / counts[:, None, None]
    about = max(size, 2 * len(values) + 1)
    mean = uniform_filter1d(products, about, axis=0, mode="nearest")[edges + (counts - 1) // 2]
    omega = spectrum.spacing * (1 + band.start + edges + 0.5 * (counts - 1))
    return np.exp(1j * omega * spectrum.sample_time), power, counts.astype(float), mean
