"""Maximum likelihood modes of a spectrum: outputs under unknown forces, each mode in its own band.

Transforms of a long record are independent from line to line, normal, of covariance S(ω_k) (Whittle, 1953), and S is
the transform of R(k) = Re Σ φ_r c_r^T e^{λ_r k Δt}, k > 0,

    S = Z + Z^H + B,   Z = ½ Σ_r [φ_r c_r^T g(μ_r) + conjugates of φ_r, c_r, μ_r],   g(μ) = μ / (z - μ)

with z = e^{iωΔt}, μ = e^{λΔt}, exact for sampled signals. B, Hermitian and linear over a band, is the noise of the
sensors and what forces and modes elsewhere add there; forces need be white no further than a band is wide. So

    L = -Σ_k (ln det S_k + tr S_k^-1 P_k),     F_ab = Σ_k tr(S_k^-1 ∂_a S_k S_k^-1 ∂_b S_k)

of the bands' own unknowns, P_k the products of the transforms; F^-1 is the Cramér-Rao bound.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal.windows import tukey

from workbench.identification.signal.budget import Budget
from workbench.identification.signal.least_squares import minimise

# Share of the record that is tapered at its ends, so that strong modes do not leak into weak ones.
TAPERED = 0.1
# Half-widths, and lines, by which a band reaches beyond its modes; averages to a half-width, and to a band at most.
REACH, LEAST_LINES, PARTS, MOST_PARTS = 20.0, 40, 6, 400
# Modes so many half-widths apart, both taken together, are fitted together.
TOGETHER = 10.0
# Of the polynomial in frequency of the noise B.
DEGREE = 1
# Scoring steps, sweeps over all bands, and the decrease of -L below which a step is negligible.
MOST_STEPS, MOST_SWEEPS, NEGLIGIBLE = 40, 3, 1e-2
# Least eigenvalue of the scaled information; what lies below is as uncertain as can be.
LEAST_IDENTIFIABLE = 1e-10
# Lines of the narrowest half-width: one narrower would fit single lines, and the likelihood would have no bound.
NARROWEST = 3.0
# Least share of the mean over a few lines that S keeps in each direction: singular at one line it would have no bound.
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
class SpectralMode:
    """A mode in a spectrum: pole, shape φ and excitation c, (n_directions,) complex each."""

    pole: complex
    shape: np.ndarray
    excitation: np.ndarray

    @property
    def height(self) -> float:
        """Of its peak, relative."""
        return float(np.linalg.norm(self.shape) * np.linalg.norm(self.excitation) / abs(self.pole.real))

    def spectrum(self, z: np.ndarray, dt: float) -> np.ndarray:
        """Its contribution to S at z, (n_lines, n_directions, n_directions)."""
        mu = np.exp(self.pole * dt)
        a = 0.5 * np.outer(self.shape, self.excitation)
        half = a * _resonance(mu, z)[:, None, None] + a.conj() * _resonance(mu.conj(), z)[:, None, None]
        return np.asarray(half + _adjoint(half))


@dataclass(frozen=True, eq=False)
class Band:
    """Modes fitted together.

    Attributes:
        modes: the modes.
        covariance: (2 n, 2 n) of Re λ, then Im λ.
        cost: -L at the end.
        converged: whether the search ended because the step was small.
    """

    modes: tuple[SpectralMode, ...]
    covariance: np.ndarray
    cost: float
    converged: bool


def fit_bands(
    spectrum: Spectrum, modes: Sequence[SpectralMode], budget: Budget | None = None
) -> list[tuple[list[int], Band]]:
    """The maximum likelihood modes near those given: bands, each with the indices of its modes.

    The contribution of a mode to other bands is that of the last fit of its own, until no pole moves any more.
    """
    found, groups = list(modes), bands(spectrum, [mode.pole for mode in modes])
    for sweep in range(MOST_SWEEPS):
        before = np.array([mode.pole for mode in found])
        fitted = []
        for group in groups:
            others = [mode for r, mode in enumerate(found) if r not in group]
            band = fit_band(spectrum, [found[r] for r in group], others, budget=budget)
            fitted.append((group, band))
            for r, mode in zip(group, band.modes, strict=True):
                found[r] = mode
        std = np.sqrt(np.concatenate([np.diag(band.covariance).reshape(2, -1).sum(axis=0) for _, band in fitted]))
        moved = np.abs(np.array([mode.pole for mode in found]) - before)[np.concatenate(groups).astype(int)]
        if len(groups) == 1 or (sweep and (moved < 0.05 * std).all()):
            break
    return fitted


def bands(spectrum: Spectrum, poles: Sequence[complex]) -> list[list[int]]:
    """Indices of the modes that are fitted together, one list a band."""
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


def initial_mode(spectrum: Spectrum, pole: complex, shape: np.ndarray) -> SpectralMode:
    """A mode of known pole and shape, as strong as its peak."""
    dt = spectrum.sample_time
    width = max(abs(pole.real), 1.1 * NARROWEST * spectrum.spacing)
    lines = _lines(spectrum, pole.imag - width, pole.imag + width)
    power = (np.abs(shape.conj() @ spectrum.values[:, lines]) ** 2).mean() / np.linalg.norm(shape) ** 4
    return SpectralMode(-width + 1j * pole.imag, shape.astype(complex), power * width * dt * shape.conj())


def fit_band(
    spectrum: Spectrum,
    modes: Sequence[SpectralMode],
    others: Sequence[SpectralMode],
    about: Sequence[SpectralMode] | None = None,
    most_steps: int = MOST_STEPS,
    budget: Budget | None = None,
) -> Band:
    """The modes of one band, the contribution of the others held, by Fisher scoring; the band `about` some modes."""
    likelihood, modes = posed(spectrum, modes, others, modes if about is None else about)
    start = modes, likelihood.start(modes)
    found = minimise(likelihood, start, most_steps=most_steps, budget=budget)
    modes, background = found.state
    fisher, _ = likelihood.normal_equations((modes, background))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fisher), 1e-300))
    values, vectors = np.linalg.eigh(fisher * np.outer(scale, scale))
    # What the record does not determine is as uncertain as can be, not certain.
    whole = (vectors / np.maximum(values, LEAST_IDENTIFIABLE)) @ vectors.T * np.outer(scale, scale)
    at = likelihood.size * np.arange(len(modes))
    both = np.r_[at, at + 1].astype(int)
    return Band(tuple(modes), whole[np.ix_(both, both)], found.cost, found.converged)


def posed(
    spectrum: Spectrum, modes: Sequence[SpectralMode], others: Sequence[SpectralMode], about: Sequence[SpectralMode]
) -> tuple["BandLikelihood", tuple[SpectralMode, ...]]:
    """The likelihood of a band, and its modes with the largest entry of each shape 1, which is held."""
    held = [int(np.argmax(np.abs(mode.shape))) for mode in modes]
    each = zip(modes, [mode.shape[k] for mode, k in zip(modes, held, strict=True)], strict=True)
    scaled = tuple(replace(mode, shape=mode.shape / by, excitation=mode.excitation * by) for mode, by in each)
    return BandLikelihood(spectrum, others, about, held), scaled


State = tuple[tuple[SpectralMode, ...], np.ndarray]  # modes and background


class BandLikelihood:
    """One band: unknowns are, mode by mode, Re λ, Im λ, φ but its largest entry, c, and then B."""

    def __init__(
        self, spectrum: Spectrum, others: Sequence[SpectralMode], about: Sequence[SpectralMode], held: list[int]
    ) -> None:
        self.z, power, counts, mean = _averaged(spectrum, about)
        self.least = LEAST_OF_MEAN * mean
        self.power, self.counts, self.held = power, counts / spectrum.loss, held
        self.dt, self.narrowest = spectrum.sample_time, NARROWEST * spectrum.spacing
        self.fixed = sum((mode.spectrum(self.z, self.dt) for mode in others), np.zeros_like(power))
        self.p = power.shape[1]
        self.size = 4 * self.p
        self.hermitian = _hermitian_basis(self.p)
        # Where the band begins and ends it is -1 and 1.
        self.across = np.vstack([np.linspace(-1.0, 1.0, self.z.size) ** k for k in range(DEGREE + 1)])

    def start(self, modes: Sequence[SpectralMode]) -> np.ndarray:
        """A background that leaves S positive."""
        quiet = np.ones(self.z.size, bool)
        omega = np.angle(self.z) / self.dt
        for mode in modes:
            quiet &= np.abs(omega - mode.pole.imag) > 0.5 * REACH * abs(mode.pole.real)
        quiet = quiet if quiet.sum() >= 2 * self.p else np.ones(self.z.size, bool)
        level = np.linalg.eigvalsh(self.power[quiet].mean(axis=0))
        floor = np.zeros((DEGREE + 1, self.p, self.p), complex)
        floor[0] = max(level[0], 1e-6 * level[-1]) * np.eye(self.p)
        whole = self.whole(modes, floor) - self.least
        floor[0] += max(0.0, 1.1 * float((-np.linalg.eigvalsh(whole)[:, 0]).max()) + level[0]) * np.eye(self.p)
        return floor

    def whole(self, modes: Sequence[SpectralMode], background: np.ndarray) -> np.ndarray:
        level = np.einsum("dij,dk->kij", background, self.across)
        return sum((mode.spectrum(self.z, self.dt) for mode in modes), self.fixed + level)

    def cost(self, state: State) -> float:
        modes, background = state
        if any(-s.pole.real < self.narrowest or not 0 < s.pole.imag * self.dt < np.pi for s in modes):
            return np.inf
        s = self.whole(modes, background)
        try:
            root = np.linalg.cholesky(s)
            np.linalg.cholesky(s - self.least)
        except np.linalg.LinAlgError:
            return np.inf
        logs = 2.0 * np.log(np.einsum("kii->ki", root).real).sum(axis=1)
        return float(self.counts @ (logs + np.einsum("kij,kji->k", np.linalg.inv(s), self.power).real))

    def normal_equations(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Fisher information and slope of L."""
        modes, background = state
        inverse = np.linalg.inv(self.whole(modes, background))
        changes = np.concatenate([self._changes(s, k) for s, k in zip(modes, self.held, strict=True)] + [self._levels])
        x = inverse @ changes
        over = inverse @ self.power - np.eye(self.p)
        slope = np.einsum("akij,kji,k->a", x, over, self.counts).real
        flat = x.reshape(len(x), -1)
        turned = (self.counts[:, None, None] * x.swapaxes(-1, -2)).reshape(len(x), -1)
        return (flat @ turned.T).real, slope

    @property
    def _levels(self) -> np.ndarray:
        return np.asarray(
            np.einsum("aij,dk->dakij", self.hermitian, self.across).reshape(-1, self.z.size, self.p, self.p)
        )

    def _changes(self, mode: SpectralMode, k: int) -> np.ndarray:
        """∂S by each unknown of a mode, (n_unknowns, n_lines, n_directions, n_directions)."""
        mu = np.exp(mode.pole * self.dt)
        here, mirrored = (_resonance(m, self.z) for m in (mu, mu.conj()))
        slope, mirrored_slope = (self.dt * m * self.z / (self.z - m) ** 2 for m in (mu, mu.conj()))
        unit = np.eye(self.p)
        a = 0.5 * np.outer(mode.shape, mode.excitation)
        shapes = [0.5 * np.outer(unit[j], mode.excitation) for j in range(self.p) if j != k]
        excitations = [0.5 * np.outer(mode.shape, unit[j]) for j in range(self.p)]
        found = []
        for matrices, f, g in (([a], slope, mirrored_slope), ([*shapes, *excitations], here, mirrored)):
            for matrix in matrices:
                up, down = matrix * f[:, None, None], matrix.conj() * g[:, None, None]
                found += [up + down, 1j * (up - down)]
        half = np.array(found)
        return np.asarray(half + _adjoint(half))

    def moved(self, state: State, step: np.ndarray) -> tuple[State, np.ndarray]:
        modes, background = state
        each = step[: self.size * len(modes)].reshape(len(modes), self.size)
        found = []
        for mode, own, k in zip(modes, each, self.held, strict=True):
            change = own[0::2] + 1j * own[1::2]
            shape = mode.shape + np.insert(change[1 : self.p], k, 0.0)
            found.append(SpectralMode(mode.pole + change[0], shape, mode.excitation + change[self.p :]))
        level = np.tensordot(step[each.size :].reshape(DEGREE + 1, -1), self.hermitian, 1)
        return (tuple(found), background + level), step

    def negligible(self, decrease: float, cost: float) -> bool:
        return decrease < NEGLIGIBLE


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


def _averaged(
    spectrum: Spectrum, modes: Sequence[SpectralMode]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """z, products of the transforms, how many lines each stands for, and their mean over a few lines about, over the
    band of some modes."""
    centre, width = np.array([[s.pole.imag, abs(s.pole.real)] for s in modes]).T
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
