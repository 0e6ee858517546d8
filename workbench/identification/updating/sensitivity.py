"""Modes of a structure whose mass and stiffness are series, and their sensitivities to every parameter.

    m = m_0 (1 + Σ d_j M_j),   k = k_0 (1 + Σ e_j K_j),   on [a, b]: k (1 - δ)

With G_sr = ∂K_sr - λ_r ∂M_sr, the derivatives of the matrices by a parameter between modes (Fox & Kapoor, AIAA J. 6,
1968),

    ∂λ_r = G_rr,   ∂φ_r = Σ_{s≠r} φ_s G_sr / (λ_r - λ_s) - φ_r ∂M_rr / 2,

summed over every mode of the discrete structure. A shift db of an edge of [a, b] changes k⁺ to k⁻ over db; the moment
is continuous there and the curvature is not, so ∂K_sr = (k⁻ - k⁺) φ_s''⁻ φ_r''⁺. Between that edge and the nodes next
to it the derivative of the shape has a kink, which the sum over modes represents to a few per cent; all else is exact.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import eigh

from workbench.identification.updating.distributions import Basis
from workbench.structure.domain import position
from workbench.structure.member import Bar, Beam, checked_places, segment_ends
from workbench.structure.polynomials import Segments
from workbench.structure.profile import Profile

EXTRA_DEGREES = 4  # margin of the degree of the polynomials
RIGID = 1e-10  # of the eigenvalue of a half wave, below which a mode is a rigid-body mode
ROUND_OFF = 1e-15
APART = 1e-6  # least distance of nodes over the length


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
        n_modes: number of the lowest modes that are resolved.
    """

    nominal: Bar | Beam
    mass: Basis
    stiffness: Basis
    positions: np.ndarray
    n_modes: int

    @property
    def order(self) -> int:
        """Order of the derivative of the shape in the strain energy: 1 for a bar, 2 for a beam."""
        return 2 if isinstance(self.nominal, Beam) else 1

    @property
    def nominal_stiffness(self) -> Profile:
        """k_0."""
        return self.nominal.bending_stiffness if isinstance(self.nominal, Beam) else self.nominal.axial_stiffness

    def solve(self, d: np.ndarray, e: np.ndarray, loss: LocalLoss | None = None) -> "SolvedSeries | None":
        """The modes with these coefficients; None if mass or stiffness is negative."""
        length = self.nominal.length
        mesh = self._intact_mesh if loss is None else _Mesh.of(self, loss.edges(length))
        mass = mesh.nominal_mass * (1.0 + mesh.mass_terms @ d)
        stiffness = mesh.nominal_stiffness * (1.0 + mesh.stiffness_terms @ e)
        # a series of many terms may be negative between the integration points
        positive = mass, stiffness, 1.0 + mesh.checked_mass @ d, 1.0 + mesh.checked_stiffness @ e
        if any((values <= 0).any() for values in positive) or (loss is not None and loss.share >= 1):
            return None
        m = mesh.fixed_mass + (mesh.values.T * (mesh.weights * mass)) @ mesh.values
        k = mesh.fixed_stiffness + (mesh.strains.T * (mesh.weights * (stiffness * mesh.left_by(loss)))) @ mesh.strains
        free = mesh.free
        m, k = m[np.ix_(free, free)], k[np.ix_(free, free)]
        # As in `member`: the inverse problem keeps the lowest modes exact, the shift separates rigid-body modes.
        shift = np.mean(stiffness) / np.mean(mass) * (np.pi / length) ** (2 * self.order)
        nu, vectors = eigh(m, k + shift * m)
        lowest = np.flatnonzero(nu > ROUND_OFF * nu[-1])[::-1]
        nu, vectors = nu[lowest], vectors[:, lowest]
        eigenvalues = 1.0 / nu - shift
        coefficients = np.zeros((mesh.values.shape[1], nu.size))
        coefficients[free] = vectors / np.sqrt(nu)
        n_rigid = int((eigenvalues < RIGID * shift).sum())
        return SolvedSeries(self, mesh, np.maximum(eigenvalues, 0.0), coefficients, stiffness, n_rigid, loss)

    @cached_property
    def _intact_mesh(self) -> "_Mesh":
        return _Mesh.of(self, ())


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
        mesh, diagonal = self.mesh, (r, np.arange(r.size))
        shapes, strains = mesh.values @ self.coefficients, mesh.strains @ self.coefficients
        mass_weights = (mesh.weights * mesh.nominal_mass)[:, None] * mesh.mass_terms
        intact = mesh.weights * mesh.nominal_stiffness * mesh.left_by(self.loss)
        by_mass = [(shapes.T * w) @ shapes[:, r] for w in mass_weights.T]
        by_stiffness = [(strains.T * w) @ strains[:, r] for w in (intact[:, None] * mesh.stiffness_terms).T]
        if self.loss is not None:
            by_stiffness += self._by_loss(strains, r, self.loss)
        # G_sr and ∂M_rr
        changes = [(-change * self.eigenvalues[r], change[diagonal]) for change in by_mass]
        changes += [(change, np.zeros(r.size)) for change in by_stiffness]
        gaps = self.eigenvalues[r] - self.eigenvalues[:, None]
        gaps[diagonal] = np.inf
        omega, at_sensors = np.sqrt(self.eigenvalues[r]), self.at_sensors
        omega_by = np.zeros((r.size, len(changes)))
        shapes_by = np.zeros((*at_sensors[:, r].shape, len(changes)))
        for j, (g, mass_change) in enumerate(changes):
            mixed = g / gaps
            mixed[diagonal] = -0.5 * mass_change
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
    fixed_mass: np.ndarray  # of attachments
    fixed_stiffness: np.ndarray  # of springs and of the tension
    free: np.ndarray  # indices of the functions that the ends do not hold

    @classmethod
    def of(cls, series: SeriesStructure, edges: tuple[float, ...]) -> "_Mesh":
        """The mesh with nodes at all places where something jumps, and at the edges of a loss."""
        nominal, order, length = series.nominal, series.order, series.nominal.length
        m, k = nominal.mass_per_length, series.nominal_stiffness
        of_mass, of_stiffness = (*m.breaks, *series.mass.breaks), (*k.breaks, *series.stiffness.breaks, *edges)
        at_parts = (position(part.at) for part in nominal.attachments)
        nodes = segment_ends((*of_mass, *of_stiffness, *at_parts), length, APART)
        degree = int(np.ceil(1.7 * series.n_modes * np.diff(nodes).max() / length)) + 12 + EXTRA_DEGREES
        segments = Segments(nodes, (degree,) * (nodes.size - 1), order - 1)
        x, weights, (values, slopes, strains) = segments.tables((0, 1, order))
        fixed_mass, fixed_stiffness = np.zeros((2, segments.n_functions, segments.n_functions))
        for mass, row in nominal.point_masses(segments):
            fixed_mass += mass * row.T @ row
        held, _, springs = nominal.restraints(segments)
        for spring, row in springs:
            fixed_stiffness += spring * row.T @ row
        if isinstance(nominal, Beam) and nominal.tension:
            fixed_stiffness += nominal.tension * (slopes.T * weights) @ slopes
        return cls(
            segments=segments,
            x=x,
            weights=weights,
            values=values,
            strains=strains,
            nominal_mass=m(x),
            nominal_stiffness=k(x),
            mass_terms=series.mass.functions(x),
            stiffness_terms=series.stiffness.functions(x),
            checked_mass=series.mass.functions(checked_places(of_mass, length)),
            checked_stiffness=series.stiffness.functions(checked_places(of_stiffness, length)),
            fixed_mass=fixed_mass,
            fixed_stiffness=fixed_stiffness,
            free=np.setdiff1d(np.arange(segments.n_functions), held),
        )

    def inside(self, loss: LocalLoss) -> np.ndarray:
        """Whether each point lies within the loss, (n_points,)."""
        begin, end = loss.edges(self.segments.nodes[-1])
        return (self.x > begin) & (self.x < end)

    def left_by(self, loss: LocalLoss | None) -> np.ndarray | float:
        """Share of the stiffness that a loss leaves at each point, (n_points,)."""
        return 1.0 if loss is None else np.where(self.inside(loss), 1.0 - loss.share, 1.0)
