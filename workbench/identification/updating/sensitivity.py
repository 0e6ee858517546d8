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

DEGREES = 1.7, 16  # of the polynomials, for each half wave and beyond
RIGID = 1e-10  # of the eigenvalue of a half wave, below which a mode is a rigid-body mode
ROUND_OFF = 1e-15
APART = 1e-6  # least distance of nodes over the length


@dataclass(frozen=True)
class LocalLoss:
    """A share of the stiffness lost over part of the structure, which is cut off at the ends."""

    share: float  # δ of the stiffness there, below 1
    centre: float  # of the part, m
    width: float  # of the part, m

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
    """Elastic modes and their derivatives."""

    omega: np.ndarray  # (n_modes,) rad/s
    shapes: np.ndarray  # (n_sensors, n_modes), mass-normalised
    omega_by: np.ndarray  # (n_modes, n_parameters)
    shapes_by: np.ndarray  # (n_sensors, n_modes, n_parameters)


@dataclass(frozen=True, eq=False)
class SeriesStructure:
    """A nominal structure with series for the relative changes of its mass and stiffness."""

    nominal: Bar | Beam  # ends, attachments, m_0 and k_0
    mass: Basis  # M_j
    stiffness: Basis  # K_j
    positions: np.ndarray  # (n_sensors,) of the sensors, m
    n_modes: int  # number of the lowest modes that are resolved

    @property
    def bases(self) -> tuple[Basis, Basis]:
        return self.mass, self.stiffness

    @property
    def nominal_profiles(self) -> tuple[Profile, Profile]:
        return self.nominal.mass_per_length, self.nominal.stiffness

    def solve(self, d: np.ndarray, e: np.ndarray, loss: LocalLoss | None = None) -> "SolvedSeries | None":
        """The modes with these coefficients; None if mass or stiffness is negative."""
        length = self.nominal.length
        mesh = self._intact_mesh if loss is None else _Mesh(self, loss.edges(length))
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
        shift = np.mean(stiffness) / np.mean(mass) * (np.pi / length) ** (2 * self.nominal.strain_order)
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
        return _Mesh(self, ())


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

    @cached_property
    def at_sensors(self) -> np.ndarray:
        """All shapes at the sensors, (n_sensors, n_all)."""
        return np.asarray(self.mesh.segments.evaluation(self.series.positions) @ self.coefficients)

    def modes(self, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies (n_modes,), rad/s, and shapes at the sensors (n_sensors, n_modes) of elastic modes, from 0."""
        return np.sqrt(self.eigenvalues[self.n_rigid + which]), self.at_sensors[:, self.n_rigid + which]

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
        omega, at_sensors = self.modes(which)
        omega_by, shapes_by = np.zeros((r.size, len(changes))), np.zeros((*at_sensors.shape, len(changes)))
        for j, (g, mass_change) in enumerate(changes):
            mixed = g / gaps
            mixed[diagonal] = -0.5 * mass_change
            omega_by[:, j] = g[diagonal] / (2.0 * omega)
            shapes_by[..., j] = self.at_sensors @ mixed
        return Sensitivity(omega, at_sensors, omega_by, shapes_by)

    def _by_loss(self, strains: np.ndarray, r: np.ndarray, loss: LocalLoss) -> list[np.ndarray]:
        """∂K_sr by share, centre and width."""
        mesh, length = self.mesh, self.series.nominal.length
        weights = mesh.weights * self.intact_stiffness * mesh.inside(loss)
        by_share = -(strains.T * weights) @ strains[:, r]
        begin, end = edges = loss.edges(length)
        beside = np.clip([begin, begin, end, end] + np.array([-1.0, 1.0, -1.0, 1.0]) * 1e-10 * length, 0.0, length)
        order = self.series.nominal.strain_order
        strains_at_edges = (mesh.segments.evaluation(beside, order) @ self.coefficients).reshape(2, 2, -1)
        by_edge = []
        for at, outward, (before, after) in zip(edges, (-1.0, 1.0), strains_at_edges, strict=True):
            # the shift of an edge beyond the end of the structure has no effect
            jump = -outward * loss.share * float(np.interp(at, mesh.x, self.intact_stiffness)) * (0.0 < at < length)
            by_edge.append(0.5 * jump * (np.outer(before, after[r]) + np.outer(after, before[r])))
        return [by_share, by_edge[0] + by_edge[1], 0.5 * (by_edge[1] - by_edge[0])]


class _Mesh:
    """The discretisation, with nodes at all places where something jumps, and at the edges of a loss.

    At the Gauss points x, with weights (n_points,), it holds the functions and their highest derivatives, values and
    strains (n_points, n_functions), m_0 and k_0 (n_points,), and the terms M_j and K_j (n_points, n_terms), these also
    where `member` checks that mass and stiffness are positive; besides, the fixed matrices of attachments, springs and
    tension, and the free functions, which the ends do not hold.
    """

    def __init__(self, series: SeriesStructure, edges: tuple[float, ...]) -> None:
        nominal, order, length = series.nominal, series.nominal.strain_order, series.nominal.length
        m, k = series.nominal_profiles
        of_mass, of_stiffness = (*m.breaks, *series.mass.breaks), (*k.breaks, *series.stiffness.breaks, *edges)
        at_parts = (position(part.at) for part in nominal.attachments)
        nodes = segment_ends((*of_mass, *of_stiffness, *at_parts), length, APART)
        degree = int(np.ceil(DEGREES[0] * series.n_modes * np.diff(nodes).max() / length)) + DEGREES[1]
        self.segments = Segments(nodes, (degree,) * (nodes.size - 1), order - 1)
        self.x, self.weights, (self.values, slopes, self.strains) = self.segments.tables((0, 1, order))
        self.nominal_mass, self.nominal_stiffness = m(self.x), k(self.x)
        self.mass_terms, self.stiffness_terms = series.mass.functions(self.x), series.stiffness.functions(self.x)
        self.checked_mass = series.mass.functions(checked_places(of_mass, length))
        self.checked_stiffness = series.stiffness.functions(checked_places(of_stiffness, length))
        n = self.segments.n_functions
        self.fixed_mass, self.fixed_stiffness = np.zeros((n, n)), np.zeros((n, n))
        for mass, row in nominal.point_masses(self.segments):
            self.fixed_mass += mass * row.T @ row
        held, _, springs = nominal.restraints(self.segments)
        for spring, row in springs:
            self.fixed_stiffness += spring * row.T @ row
        if isinstance(nominal, Beam) and nominal.tension:
            self.fixed_stiffness += nominal.tension * (slopes.T * self.weights) @ slopes
        self.free = np.setdiff1d(np.arange(n), held)

    def inside(self, loss: LocalLoss) -> np.ndarray:
        """Whether each point lies within the loss, (n_points,)."""
        begin, end = loss.edges(self.segments.nodes[-1])
        return (self.x > begin) & (self.x < end)

    def left_by(self, loss: LocalLoss | None) -> np.ndarray | float:
        """Share of the stiffness that a loss leaves at each point, (n_points,)."""
        return 1.0 if loss is None else np.where(self.inside(loss), 1.0 - loss.share, 1.0)
