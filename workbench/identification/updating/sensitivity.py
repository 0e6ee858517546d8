"""Modes of a structure whose mass and stiffness are series, and how they move with every parameter.

    m = m_0 (1 + Σ d_j M_j),   k = k_0 (1 + Σ e_j K_j),   on [a, b]: k (1 - δ)

With G_sr = ∂K_sr - λ_r ∂M_sr, what a parameter changes in the modes themselves (Fox & Kapoor, AIAA J. 6, 1968),

    ∂λ_r = G_rr,   ∂φ_r = Σ_{s≠r} φ_s G_sr / (λ_r - λ_s) - φ_r ∂M_rr / 2,

summed over every mode of the discrete structure. An edge of [a, b] that moves by db turns k⁺ into k⁻ over db; the
moment is continuous there and the curvature is not, so ∂K_sr = (k⁻ - k⁺) φ_s''⁻ φ_r''⁺. The shape between that edge and
the nodes next to it has a kink that travels, which the sum follows to a few parts in a hundred; all else is exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from scipy.linalg import eigh

from workbench.identification.updating.distributions import Basis
from workbench.structure.member import Bar, Beam, checked_places
from workbench.structure.polynomials import Segments
from workbench.structure.profile import Profile
from workbench.structure.supports import HELD, PointDamper, PointMass

EXTRA_DEGREES = 4
RIGID = 1e-10  # of the eigenvalue of a half wave
ROUND_OFF = 1e-15


@dataclass(frozen=True)
class LocalLoss:
    """A share of the stiffness lost over part of the structure.

    Attributes:
        share: δ of the stiffness there, below 1.
        centre, width: of the part, m; what of it lies outside the structure does not count.
    """

    share: float
    centre: float
    width: float

    def edges(self, length: float) -> tuple[float, float]:
        """Where it begins and ends, m."""
        return max(self.centre - 0.5 * self.width, 0.0), min(self.centre + 0.5 * self.width, length)

    def within(self, length: float) -> "LocalLoss":
        """The part of it that lies on the structure."""
        begin, end = self.edges(length)
        return LocalLoss(self.share, 0.5 * (begin + end), end - begin)

    def of(self, stiffness: Profile, length: float) -> Profile:
        """A stiffness with this loss."""
        return stiffness.scaled(1.0 - self.share, *self.edges(length))


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Elastic modes and their derivatives.

    Attributes:
        omega: (n_modes,) rad/s.
        shapes: (n_sensors, n_modes), mass-normalised.
        omega_by: (n_modes, n_parameters).
        shapes_by: (n_sensors, n_modes, n_parameters).
    """

    omega: np.ndarray
    shapes: np.ndarray
    omega_by: np.ndarray
    shapes_by: np.ndarray


@dataclass(frozen=True, eq=False)
class SeriesStructure:
    """A nominal structure with series for the relative changes of its mass and stiffness.

    Attributes:
        nominal: ends, attachments, m_0 and k_0.
        mass, stiffness: M_j and K_j.
        positions: (n_sensors,) where shapes are wanted, m.
    """

    nominal: Bar | Beam
    mass: Basis
    stiffness: Basis
    positions: np.ndarray
    _meshes: dict[int, "_Mesh"] = field(default_factory=dict, repr=False)

    @property
    def order(self) -> int:
        """Of the derivative that the stiffness resists: 1 for a bar, 2 for a beam."""
        return 2 if isinstance(self.nominal, Beam) else 1

    @property
    def nominal_stiffness(self) -> Profile:
        """k_0."""
        return self.nominal.bending_stiffness if isinstance(self.nominal, Beam) else self.nominal.axial_stiffness

    def solve(
        self, d: np.ndarray, e: np.ndarray, *, n_modes: int, loss: LocalLoss | None = None
    ) -> "SolvedSeries | None":
        """The modes with these coefficients, the lowest `n_modes` resolved; None if mass or stiffness is negative."""
        mesh = self._mesh(n_modes, loss)
        mass = mesh.nominal_mass * (1.0 + mesh.mass_terms @ d)
        stiffness = mesh.nominal_stiffness * (1.0 + mesh.stiffness_terms @ e)
        if (mass <= 0).any() or (stiffness <= 0).any() or (loss is not None and loss.share >= 1):
            return None
        # a series of many terms may dip between the points of integration
        if (1.0 + mesh.checked_mass @ d <= 0).any() or (1.0 + mesh.checked_stiffness @ e <= 0).any():
            return None
        left = stiffness if loss is None else stiffness * np.where(mesh.inside(loss), 1.0 - loss.share, 1.0)
        m = mesh.fixed_mass + (mesh.values.T * (mesh.weights * mass)) @ mesh.values
        k = mesh.fixed_stiffness + (mesh.strains.T * (mesh.weights * left)) @ mesh.strains
        free = mesh.free
        m, k = m[np.ix_(free, free)], k[np.ix_(free, free)]
        # As in `member`: the inverse problem keeps the lowest modes exact, the shift keeps rigid-body modes apart.
        shift = np.mean(stiffness) / np.mean(mass) * (np.pi / self.nominal.length) ** (2 * self.order)
        nu, vectors = eigh(m, k + shift * m)
        lowest = np.flatnonzero(nu > ROUND_OFF * nu[-1])[::-1]
        nu, vectors = nu[lowest], vectors[:, lowest]
        eigenvalues = 1.0 / nu - shift
        coefficients = np.zeros((mesh.values.shape[1], nu.size))
        coefficients[free] = vectors / np.sqrt(nu)
        n_rigid = int((eigenvalues < RIGID * shift).sum())
        return SolvedSeries(self, mesh, np.maximum(eigenvalues, 0.0), coefficients, stiffness, n_rigid, loss)

    def _mesh(self, n_modes: int, loss: LocalLoss | None) -> "_Mesh":
        if loss is not None:
            return _Mesh.of(self, n_modes, loss.edges(self.nominal.length))
        if n_modes not in self._meshes:
            self._meshes[n_modes] = _Mesh.of(self, n_modes, ())
        return self._meshes[n_modes]


@dataclass(frozen=True, eq=False)
class SolvedSeries:
    """Every mode of the discrete structure; only the lowest are those of the true one."""

    series: SeriesStructure
    mesh: "_Mesh"
    eigenvalues: np.ndarray
    coefficients: np.ndarray
    whole: np.ndarray  # stiffness at the points before any loss
    n_rigid: int
    loss: LocalLoss | None

    @property
    def at_sensors(self) -> np.ndarray:
        """All shapes, (n_sensors, n_all)."""
        return np.asarray(self.mesh.segments.evaluation(self.series.positions) @ self.coefficients)

    def sensitivity(self, which: np.ndarray) -> Sensitivity:
        """Elastic modes `which` (from 0); parameters d, e and, with a loss, its share, centre and width."""
        r = self.n_rigid + which
        mesh, loss = self.mesh, self.loss
        shapes, strains = mesh.values @ self.coefficients, mesh.strains @ self.coefficients
        mass_weights = (mesh.weights * mesh.nominal_mass)[:, None] * mesh.mass_terms
        left = 1.0 if loss is None else np.where(mesh.inside(loss), 1.0 - loss.share, 1.0)
        stiffness_weights = (mesh.weights * mesh.nominal_stiffness * left)[:, None] * mesh.stiffness_terms
        by_mass = [(shapes.T * w) @ shapes[:, r] for w in mass_weights.T]
        by_stiffness = [(strains.T * w) @ strains[:, r] for w in stiffness_weights.T]
        if loss is not None:
            by_stiffness += self._by_loss(strains, r, loss)
        changes = [(g, np.zeros_like(g)) for g in by_stiffness]
        changes = [(-g * self.eigenvalues[r], g) for g in by_mass] + changes
        gaps = self.eigenvalues[r] - self.eigenvalues[:, None]
        own = (r, np.arange(r.size))
        gaps[own] = np.inf
        omega, at_sensors = np.sqrt(self.eigenvalues[r]), self.at_sensors
        omega_by, shapes_by = [], []
        for g, mass in changes:
            mixed = g / gaps
            mixed[own] = -0.5 * mass[own]
            omega_by.append(g[own] / (2.0 * omega))
            shapes_by.append(at_sensors @ mixed)
        return Sensitivity(omega, at_sensors[:, r], np.stack(omega_by, -1), np.stack(shapes_by, -1))

    def _by_loss(self, strains: np.ndarray, r: np.ndarray, loss: LocalLoss) -> list[np.ndarray]:
        """∂K_sr by share, centre and width."""
        mesh, length = self.mesh, self.series.nominal.length
        weights = mesh.weights * self.whole * mesh.inside(loss)
        by_share = -(strains.T * weights) @ strains[:, r]
        begin, end = edges = loss.edges(length)
        beside = np.clip([begin, begin, end, end] + np.array([-1.0, 1.0, -1.0, 1.0]) * 1e-10 * length, 0.0, length)
        at_edges = (mesh.segments.evaluation(beside, self.series.order) @ self.coefficients).reshape(2, 2, -1)
        moved = []
        for at, outward, (before, after) in zip(edges, (-1.0, 1.0), at_edges, strict=True):
            # an edge beyond the end of the structure may move without effect
            jump = -outward * loss.share * float(np.interp(at, mesh.x, self.whole)) * (0.0 < at < length)
            moved.append(0.5 * jump * (np.outer(before, after[r]) + np.outer(after, before[r])))
        return [by_share, moved[0] + moved[1], 0.5 * (moved[1] - moved[0])]


@dataclass(frozen=True, eq=False)
class _Mesh:
    """Functions and their highest derivatives at the points of a Gauss rule, and what does not change."""

    segments: Segments
    x: np.ndarray
    weights: np.ndarray
    values: np.ndarray  # (n_points, n_functions)
    strains: np.ndarray
    nominal_mass: np.ndarray
    nominal_stiffness: np.ndarray
    mass_terms: np.ndarray  # (n_points, n_terms)
    stiffness_terms: np.ndarray
    checked_mass: np.ndarray  # (n_places, n_terms) where a finished structure is checked
    checked_stiffness: np.ndarray
    fixed_mass: np.ndarray
    fixed_stiffness: np.ndarray
    free: np.ndarray

    def inside(self, loss: LocalLoss) -> np.ndarray:
        """Which points the loss covers."""
        begin, end = loss.edges(self.segments.nodes[-1])
        return (self.x > begin) & (self.x < end)

    @classmethod
    def of(cls, series: SeriesStructure, n_modes: int, edges: tuple[float, ...]) -> "_Mesh":
        nominal, order = series.nominal, series.order
        m, k = nominal.mass_per_length, series.nominal_stiffness
        places = [*m.breaks, *k.breaks, *series.mass.breaks, *series.stiffness.breaks]
        nodes = _nodes([*places, *edges, *(cast(float, part.at) for part in nominal.attachments)], nominal.length)
        degree = int(np.ceil(1.7 * n_modes * np.diff(nodes).max() / nominal.length)) + 12 + EXTRA_DEGREES
        segments = Segments(nodes, (degree,) * (nodes.size - 1), order - 1)
        x, weights, (values, slopes, strains) = segments.tables((0, 1, order))
        fixed_mass, fixed_stiffness, free = _fixed(nominal, segments, order)
        if isinstance(nominal, Beam) and nominal.tension:
            fixed_stiffness += nominal.tension * (slopes.T * weights) @ slopes
        terms = series.mass.functions(x), series.stiffness.functions(x)
        of_mass = checked_places((*m.breaks, *series.mass.breaks), nominal.length)
        of_stiffness = checked_places((*k.breaks, *series.stiffness.breaks, *edges), nominal.length)
        checked = series.mass.functions(of_mass), series.stiffness.functions(of_stiffness)
        return cls(
            segments, x, weights, values, strains, m(x), k(x), *terms, *checked, fixed_mass, fixed_stiffness, free
        )


def _nodes(places: Sequence[float], length: float) -> np.ndarray:
    """The ends and all places between them, none within a sliver of another."""
    nodes = [0.0]
    for at in sorted(places):
        if nodes[-1] + 1e-6 * length < at < length * (1 - 1e-6):
            nodes.append(float(at))
    return np.array([*nodes, length])


def _fixed(nominal: Bar | Beam, segments: Segments, order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass and stiffness of what is attached, and the functions that the ends leave free."""
    mass, stiffness = np.zeros((2, segments.n_functions, segments.n_functions))
    held = []

    def add(matrix: np.ndarray, at: float, values: Sequence[float]) -> None:
        for derivative, value in enumerate(values[:order]):
            if value:
                row = segments.evaluation(at, derivative)
                matrix += value * row.T @ row

    for node, at, end in ((0, 0.0, nominal.left), (segments.nodes.size - 1, nominal.length, nominal.right)):
        springs = (end.translation, end.rotation)
        held += [order * node + derivative for derivative, spring in enumerate(springs[:order]) if spring == HELD]
        add(stiffness, at, [0.0 if spring == HELD else spring for spring in springs])
    for part in nominal.attachments:
        if not isinstance(part, PointDamper):
            add(mass if isinstance(part, PointMass) else stiffness, cast(float, part.at), part.pair)
    return mass, stiffness, np.setdiff1d(np.arange(segments.n_functions), held)
