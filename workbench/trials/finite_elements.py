"""Modes of an altered member, of altered matrices and of altered modal data.

Those of a member are computed with Hermite and quadratic elements of scikit-fem, independently of `Structure.modes`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import eigh
from scipy.sparse import csr_matrix, sparray
from scipy.sparse.linalg import eigsh
from skfem import Basis, BilinearForm, ElementLineHermite, ElementLineP2, Functional, MeshLine
from skfem.helpers import d, dd

from workbench.arrays import Floats
from workbench.structure.domain import Between, Domain, Location, NamedPoints, position
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.member import Bar, Beam, Structure
from workbench.structure.modes import Modes, freeze
from workbench.structure.supports import HELD

ELEMENTS = 240
# of the length of a beam: elements shorter than this spoil the modes by rounding (shapes by 0.3 % at 1e-5)
APART = 1e-4
NEGLIGIBLE = 1e-9  # likewise of a bar, whose elements may be as short as they like


class BucklingError(ValueError):
    """An altered structure that buckles."""


@dataclass(frozen=True)
class Alterations:
    """Differences of a real structure from the nominal one.

    Attributes:
        stiffness_factor: of EI, EA, D or the stiffness matrix, uniform.
        losses: (at, width, loss) of local losses of stiffness.
        masses: (at, mass), kg.
        springs: (at, stiffness) to ground, or between two named points, N/m.
        rotational_stiffness: (left, right), N m/rad, instead of the nominal ones; None for the nominal one.
        tension: N, added to the nominal one.
        stiffness_waves, mass_waves: (c_1, c_2, ...) of a smooth variation, 1 + Σ c_k cos(k π x / L) times nominal:
            along a member, along x of a plate, over the height of a frame.
    """

    stiffness_factor: float = 1.0
    losses: tuple[tuple[float, float, float], ...] = ()
    masses: tuple[tuple[Any, float], ...] = ()
    springs: tuple[tuple[Any, float], ...] = ()
    rotational_stiffness: tuple[float | None, float | None] = (None, None)
    tension: float = 0.0
    stiffness_waves: tuple[float, ...] = ()
    mass_waves: tuple[float, ...] = ()


AS_NOMINAL = Alterations()
Frame = Callable[..., FiniteElements]  # stiffness_waves=, mass_waves= -> the matrices of a frame with this variation


@dataclass(frozen=True, eq=False)
class ElementModes:
    """Modes with their shapes at given places.

    Attributes:
        omega: (n_modes,) rad/s.
        shapes: (n_places, n_modes), mass-normalised.
        gram: (n_modes, n_modes) ∫ φ_r' φ_s' dx.
    """

    omega: np.ndarray
    shapes: np.ndarray
    gram: np.ndarray

    def __post_init__(self) -> None:
        freeze(self, "omega", "shapes", "gram")


def element_modes(
    member: Structure, places: np.ndarray, n_modes: int, *, altered: Alterations = AS_NOMINAL
) -> ElementModes:
    """The lowest modes of an altered member, K v = ω² M v, with a node at every place.

    Args:
        places: (n_places,) of the shapes returned, m.

    Raises:
        BucklingError: the member buckles.
    """
    beam = isinstance(member, Beam)
    special = [*places, *(a for a, _ in (*altered.masses, *altered.springs))]
    special += [at + side * width / 2 for at, width, _ in altered.losses for side in (-1, 1)]
    breaks = [*member.mass_per_length.breaks, *member.stiffness.breaks]
    special += [*breaks, *(part.at for part in member.attachments)]
    nodes = _nodes(np.array(special, float), member.length, APART if beam else NEGLIGIBLE)
    basis = Basis(MeshLine(nodes), ElementLineHermite() if beam else ElementLineP2(), intorder=8)
    strain, mass, slopes, strain_energy = _matrices(basis, member, altered)
    beside = (member.tension + altered.tension if isinstance(member, Beam) else 0.0) * slopes.tolil()
    held = _hold_ends(beside, basis, member, altered)
    displacement = basis.nodal_dofs[0]
    for at, value in (*altered.masses, *_attached(member, "mass")):
        mass[displacement[_node(nodes, at)], displacement[_node(nodes, at)]] += value
    for at, value in (*altered.springs, *_attached(member, "stiffness")):
        beside[displacement[_node(nodes, at)], displacement[_node(nodes, at)]] += value
    free = np.setdiff1d(np.arange(basis.N), held)
    stiffness, mass = csr_matrix(strain + beside)[free][:, free].tocsc(), csr_matrix(mass)[free][:, free].tocsc()
    # the shift makes the pencil definite with rigid-body modes, and is far below the first elastic eigenvalue
    shift = -1e-3 * _typical_frequency(member) ** 2
    values, vectors = eigsh(stiffness, k=n_modes, M=mass, sigma=shift, which="LM", v0=np.ones(free.size))
    order = np.argsort(values)
    full = np.zeros((basis.N, n_modes))
    full[free] = vectors[:, order]
    full /= np.sqrt(np.einsum("ir,ir->r", full[free], mass @ full[free]))
    # With hundreds of elements, rounding of the stiffness matrix is as large as the lowest ω²; the strain energy of
    # each shape is accurate.
    energy = [strain_energy.assemble(basis, shape=basis.interpolate(shape)) for shape in full.T]
    values = np.array(energy) + np.einsum("ir,ir->r", full, beside @ full)
    omega2 = np.where(np.abs(values) < 1e-6 * abs(shift), 0.0, values)
    if (omega2 < 0).any():
        raise BucklingError("the altered member is unstable: it buckles; draw a weaker compression")
    nearest = np.array([_node(nodes, x) for x in places], int)
    at_places = full[displacement[nearest]]
    if beam:
        at_places = at_places + (places - nodes[nearest])[:, None] * full[basis.nodal_dofs[1][nearest]]
    return ElementModes(np.sqrt(omega2), at_places, full.T @ (slopes @ full))


def matrix_modes(
    frame: FiniteElements, places: Sequence[Location], n_modes: int, *, altered: Alterations = AS_NOMINAL
) -> ElementModes:
    """The lowest modes of altered matrices, K v = ω² M v, all degrees of freedom at once.

    Args:
        places: names of points, or pairs `Between` two of them.

    Raises:
        ValueError: alterations that only a member can have.
    """
    points = frame.nodes
    rows = np.eye(len(points.names))

    def row(where: Location) -> Floats:
        first, *second = points.locate(list(where) if isinstance(where, Between) else where)
        return np.asarray(rows[first] - rows[second].sum(axis=0))

    return _dense_modes(frame.stiffness.toarray(), frame.mass.toarray(), points, row, places, n_modes, altered)


def modal_modes(nominal: Modes, places: Sequence[Location], *, altered: Alterations = AS_NOMINAL) -> ElementModes:
    """The modes of altered modal data, in the basis of the nominal modes.

    (Ω² f + Σ k φ φᵀ) v = ω² (I + Σ m φ φᵀ) v; a mass acts in every direction of its node.

    Raises:
        ValueError: alterations that only a member can have.
    """
    stiffness, mass = np.diag(nominal.omega**2), np.eye(nominal.n_modes)
    return _dense_modes(stiffness, mass, nominal.domain, nominal.phi_at, places, nominal.n_modes, altered)


def _dense_modes(
    stiffness: Floats,
    mass: Floats,
    domain: Domain,
    row: Callable[[Location], Floats],
    places: Sequence[Location],
    n_modes: int,
    altered: Alterations,
) -> ElementModes:
    """The lowest modes of altered matrices; `row` has the coefficients of a displacement in all degrees of freedom."""
    of_a_member = (altered.losses, altered.tension, altered.stiffness_waves, altered.mass_waves)
    if any(of_a_member) or altered.rotational_stiffness != (None, None):
        raise ValueError("named points have no local stiffness, tension or rotation; describe a beam or a rod")
    stiffness = altered.stiffness_factor * stiffness
    for at, value in altered.springs:
        stiffness += value * np.outer(row(at), row(at))
    for at, value in altered.masses:
        for name in domain.translations(at) if isinstance(domain, NamedPoints) else (at,):
            mass += value * np.outer(row(name), row(name))
    lowest = (0, n_modes - 1) if n_modes < len(mass) else None
    values, vectors = eigh(stiffness, mass, subset_by_index=lowest)
    shapes = np.array([row(at) for at in places]).reshape(-1, len(mass)) @ vectors
    return ElementModes(np.sqrt(np.maximum(values, 0.0)), shapes, np.zeros((n_modes, n_modes)))


def _nodes(special: np.ndarray, length: float, apart: float) -> np.ndarray:
    """Evenly spaced nodes and the special ones; an even node near a special one is dropped, to avoid tiny elements.

    Special places that are closer than a share `apart` of the length share a node.
    """
    special = np.unique(np.r_[0.0, special[(special > 0) & (special < length)], length])
    special = special[np.r_[True, np.diff(special) > apart * length]]
    special[-1] = length
    even = np.linspace(0.0, length, ELEMENTS + 1)
    distance = np.abs(even[:, None] - special[None, :]).min(axis=1)
    return np.sort(np.r_[special, even[distance > 0.3 * length / ELEMENTS]])


def _node(nodes: np.ndarray, at: float) -> int:
    return int(np.argmin(np.abs(nodes - at)))


def _matrices(basis: Basis, member: Structure, altered: Alterations) -> tuple[sparray, sparray, sparray, Functional]:
    """The matrices of strain, mass and slopes, and the functional of twice the strain energy of a shape."""
    profile = member.stiffness

    def rigidity(x: Floats) -> Floats:
        values: Floats = altered.stiffness_factor * profile(x) * waves(altered.stiffness_waves, x / member.length)
        for at, width, loss in altered.losses:
            values = values * np.where(np.abs(x - at) < width / 2, 1.0 - loss, 1.0)
        return values

    def strain(u: Any) -> Any:
        return d(u)[0] if isinstance(member, Bar) else dd(u)[0, 0]

    def density(x: Floats) -> Floats:
        return np.asarray(member.mass_per_length(x) * waves(altered.mass_waves, x / member.length))

    forms = (
        lambda u, v, w: rigidity(w.x[0]) * strain(u) * strain(v),
        lambda u, v, w: density(w.x[0]) * u * v,
        lambda u, v, w: d(u)[0] * d(v)[0],
    )
    stiffness, mass, slopes = (BilinearForm(form).assemble(basis) for form in forms)
    return stiffness, mass.tolil(), slopes, Functional(lambda w: rigidity(w.x[0]) * strain(w["shape"]) ** 2)


def waves(coefficients: Sequence[float], share: np.ndarray) -> np.ndarray:
    """1 + Σ c_k cos(k π x / L), at shares x / L of the length."""
    return sum((c * np.cos((k + 1) * np.pi * share) for k, c in enumerate(coefficients)), np.ones_like(share))


def _hold_ends(stiffness: sparray, basis: Basis, member: Structure, altered: Alterations) -> list[int]:
    """Add the springs of the ends to the stiffness, in place, and return the held degrees of freedom."""
    held = []
    for end, rotation, node in zip((member.left, member.right), altered.rotational_stiffness, (0, -1), strict=True):
        rules = [(basis.nodal_dofs[0][node], end.translation)]
        if isinstance(member, Beam):
            rules.append((basis.nodal_dofs[1][node], end.rotation if rotation is None else rotation))
        for dof, value in rules:
            if value == HELD:
                held.append(dof)
            else:
                stiffness[dof, dof] += value
    return held


def _attached(member: Structure, name: str) -> list[tuple[float, float]]:
    return [(position(part.at), getattr(part, name)) for part in member.attachments if hasattr(part, name)]


def _typical_frequency(member: Structure) -> float:
    """A frequency of the order of the first elastic one, rad/s."""
    x = np.linspace(0.05, 0.95, 19) * member.length
    ratio = member.stiffness(x).mean() / member.mass_per_length(x).mean()
    return float(np.sqrt(ratio) * (np.pi / member.length) ** member.strain_order)
