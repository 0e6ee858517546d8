"""Modes of a structure whose mass and stiffness are series, and their sensitivities to every parameter.

    m = m_0 (1 + Σ d_j M_j),   k = k_0 (1 + Σ e_j K_j),   on [a, b]: k (1 - δ)

With G_sr = ∂K_sr - λ_r ∂M_sr, the derivatives of the matrices by a parameter between modes (Fox & Kapoor, AIAA J. 6,
1968),

    ∂λ_r = G_rr,   ∂φ_r = Σ_{s≠r} φ_s G_sr / (λ_r - λ_s) - φ_r ∂M_rr / 2,

summed over every mode of the discrete structure. A shift db of an edge of [a, b] changes k⁺ to k⁻ over db; the moment
is continuous there and the curvature is not, so ∂K_sr = (k⁻ - k⁺) φ_s''⁻ φ_r''⁺. Between that edge and the nodes next
to it the derivative of the shape has a kink, which the sum over modes represents to a few per cent; all else is exact.
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

EXTRA_DEGREES = 4  # margin of the degree of the polynomials
RIGID = 1e-10  # of the eigenvalue of a half wave, below which a mode is a rigid-body mode
ROUND_OFF = 1e-15


@dataclass(frozen=True)
class LocalLoss:
    """A share of the stiffness lost over part of the structure.

    Attributes:
        share: δ of the stiffness there, below 1.
        centre, width: of the part, m; the part is cut off at the ends of the structure.
    """

    share: float
    centre: float
    width: float

    def edges(self, length: float) -> tuple[float, float]:
        """Begin and end of the part within the structure, m."""
        return max(self.centre - 0.5 * self.width, 0.0), min(self.centre + 0.5 * self.width, length)

    def within(self, length: float) -> "LocalLoss":
        """The loss with centre and width of its part within the structure."""
        begin, end = self.edges(length)
        return LocalLoss(self.share, 0.5 * (begin + end), end - begin)

    def of(self, stiffness: Profile, length: float) -> Profile:
        """The stiffness with this loss."""
        return stiffness.scaled(1.0 - self.share, *self.edges(length))


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Elastic modes and their derivatives.

    Attributes:
        omega: (n_modes,) rad/s.
        shapes: (n_sensors, n_modes), mass-normalised.
        omega_by: (n_modes, n_parameters) derivatives of ω.
        shapes_by: (n_sensors, n_modes, n_parameters) derivatives of the shapes.
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
        positions: (n_sensors,) of the sensors, m.
    """

    nominal: Bar | Beam
    mass: Basis
    stiffness: Basis
    positions: np.ndarray
    _meshes: dict[int, "_Mesh"] = field(default_factory=dict, repr=False)

    @property
    def order(self) -> int:
        """Order of the derivative of the shape in the strain energy: 1 for a bar, 2 for a beam."""
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
        # a series of many terms may be negative between the integration points
        if (1.0 + mesh.checked_mass @ d <= 0).any() or (1.0 + mesh.checked_stiffness @ e <= 0).any():
            return None
        remaining = stiffness if loss is None else stiffness * np.where(mesh.inside(loss), 1.0 - loss.share, 1.0)
        m = mesh.fixed_mass + (mesh.values.T * (mesh.weights * mass)) @ mesh.values
        k = mesh.fixed_stiffness + (mesh.strains.T * (mesh.weights * remaining)) @ mesh.strains
        free = mesh.free
        m, k = m[np.ix_(free, free)], k[np.ix_(free, free)]
        # As in `member`: the inverse problem keeps the lowest modes exact, the shift separates rigid-body modes.
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
    """All modes of the discrete structure, of which only the lowest are converged."""

    series: SeriesStructure
    mesh: "_Mesh"
    eigenvalues: np.ndarray
    coefficients: np.ndarray
    intact_stiffness: np.ndarray  # (n_points,) without the loss
    n_rigid: int
    loss: LocalLoss | None

    @property
    def at_sensors(self) -> np.ndarray:
        """All shapes at the sensors, (n_sensors, n_all)."""
        return np.asarray(self.mesh.segments.evaluation(self.series.positions) @ self.coefficients)

    def sensitivity(self, which: np.ndarray) -> Sensitivity:
        """Elastic modes `which` (from 0), and their derivatives by d, e and share, centre and width of a loss."""
        r = self.n_rigid + which
        mesh, loss = self.mesh, self.loss
        shapes, strains = mesh.values @ self.coefficients, mesh.strains @ self.coefficients
        mass_weights = (mesh.weights * mesh.nominal_mass)[:, None] * mesh.mass_terms
        remaining = 1.0 if loss is None else np.where(mesh.inside(loss), 1.0 - loss.share, 1.0)
        stiffness_weights = (mesh.weights * mesh.nominal_stiffness * remaining)[:, None] * mesh.stiffness_terms
        by_mass = [(shapes.T * w) @ shapes[:, r] for w in mass_weights.T]
        by_stiffness = [(strains.T * w) @ strains[:, r] for w in stiffness_weights.T]
        if loss is not None:
            by_stiffness += self._by_loss(strains, r, loss)
        changes = [(g, np.zeros_like(g)) for g in by_stiffness]
        changes = [(-g * self.eigenvalues[r], g) for g in by_mass] + changes
        gaps = self.eigenvalues[r] - self.eigenvalues[:, None]
        diagonal = (r, np.arange(r.size))
        gaps[diagonal] = np.inf
        omega, at_sensors = np.sqrt(self.eigenvalues[r]), self.at_sensors
        omega_by = np.zeros((r.size, len(changes)))
        shapes_by = np.zeros((*at_sensors[:, r].shape, len(changes)))
        for j, (g, mass_change) in enumerate(changes):
            mixed = g / gaps
            mixed[diagonal] = -0.5 * mass_change[diagonal]
            omega_by[:, j] = g[diagonal] / (2.0 * omega)
            shapes_by[..., j] = at_sensors @ mixed
        return Sensitivity(omega, at_sensors[:, r], omega_by, shapes_by)

    def _by_loss(self, strains: np.ndarray, r: np.ndarray, loss: LocalLoss) -> list[np.ndarray]:
        """∂K_sr by share, centre and width."""
        mesh, length = self.mesh, self.series.nominal.length
        weights = mesh.weights * self.intact_stiffness * mesh.inside(loss)
        by_share = -(strains.T * weights) @ strains[:, r]
        begin, end = edges = loss.edges(length)
        beside = np.clip([begin, begin, end, end] + np.array([-1.0, 1.0, -1.0, 1.0]) * 1e-10 * length, 0.0, length)
        strains_at_edges = (mesh.segments.evaluation(beside, self.series.order) @ self.coefficients).reshape(2, 2, -1)
        by_edge = []
        for at, outward, (before, after) in zip(edges, (-1.0, 1.0), strains_at_edges, strict=True):
            # the shift of an edge beyond the end of the structure has no effect
            jump = -outward * loss.share * float(np.interp(at, mesh.x, self.intact_stiffness)) * (0.0 < at < length)
            by_edge.append(0.5 * jump * (np.outer(before, after[r]) + np.outer(after, before[r])))
        return [by_share, by_edge[0] + by_edge[1], 0.5 * (by_edge[1] - by_edge[0])]


@dataclass(frozen=True, eq=False)
class _Mesh:
    """The discretisation: functions and their highest derivatives at Gauss points, and the fixed matrices."""

    segments: Segments
    x: np.ndarray
    weights: np.ndarray
    values: np.ndarray  # (n_points, n_functions)
    strains: np.ndarray
    nominal_mass: np.ndarray
    nominal_stiffness: np.ndarray
    mass_terms: np.ndarray  # (n_points, n_terms)
    stiffness_terms: np.ndarray
    checked_mass: np.ndarray  # (n_places, n_terms) at the places where `member` checks that it is positive
    checked_stiffness: np.ndarray
    fixed_mass: np.ndarray
    fixed_stiffness: np.ndarray
    free: np.ndarray

    def inside(self, loss: LocalLoss) -> np.ndarray:
        """Whether each point lies within the loss, (n_points,)."""
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
        mass_places = checked_places((*m.breaks, *series.mass.breaks), nominal.length)
        stiffness_places = checked_places((*k.breaks, *series.stiffness.breaks, *edges), nominal.length)
        checked = series.mass.functions(mass_places), series.stiffness.functions(stiffness_places)
        return cls(
            segments, x, weights, values, strains, m(x), k(x), *terms, *checked, fixed_mass, fixed_stiffness, free
        )


def _nodes(places: Sequence[float], length: float) -> np.ndarray:
    """The ends and all places between them, without coincident ones."""
    nodes = [0.0]
    for at in sorted(places):
        if nodes[-1] + 1e-6 * length < at < length * (1 - 1e-6):
            nodes.append(float(at))
    return np.array([*nodes, length])


def _fixed(nominal: Bar | Beam, segments: Segments, order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass and stiffness matrices of springs and attachments, and the indices of the unconstrained functions."""
    mass, stiffness = np.zeros((2, segments.n_functions, segments.n_functions))
    fixed = []

    def add(matrix: np.ndarray, at: float, values: Sequence[float]) -> None:
        for derivative, value in enumerate(values[:order]):
            if value:
                row = segments.evaluation(at, derivative)
                matrix += value * row.T @ row

    for node, at, end in ((0, 0.0, nominal.left), (segments.nodes.size - 1, nominal.length, nominal.right)):
        springs = (end.translation, end.rotation)
        fixed += [order * node + derivative for derivative, spring in enumerate(springs[:order]) if spring == HELD]
        add(stiffness, at, [0.0 if spring == HELD else spring for spring in springs])
    for part in nominal.attachments:
        if not isinstance(part, PointDamper):
            add(mass if isinstance(part, PointMass) else stiffness, cast(float, part.at), part.pair)
    return mass, stiffness, np.setdiff1d(np.arange(segments.n_functions), fixed)
