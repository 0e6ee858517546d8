"""Modes of a rectangular plate by Bogner-Fox-Schmit finite elements, independent of `Plate.modes`.

The displacement is a product of Hermite cubics along x and along y, so that the matrices of a plate are sums of
Kronecker products of those of two beams (Bogner, Fox & Schmit, AFFDL-TR-66-80 (1966) 397).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csc_array, diags_array, kron
from scipy.sparse.linalg import eigsh
from skfem import Basis, BilinearForm, ElementLineHermite, MeshLine
from skfem.helpers import d, dd

from workbench.arrays import Floats
from workbench.structure.domain import Patch, gauss_between
from workbench.structure.plate import Plate
from workbench.structure.supports import HELD
from workbench.trials.finite_elements import AS_NOMINAL, Alterations, BucklingError, ElementModes, waves

ELEMENTS = 60  # along the longer side
CROWDED = 0.7  # grading of the mesh towards the edges, for the singular corner of a clamped and a free edge; below 1
ROUNDED = 0.05  # of the shift: a smaller ω² is rounding of the matrix of thousands of elements
# of the coordinate t in an element: for value and slope at its left node, then at its right one
CUBICS = [
    np.polynomial.Polynomial(c)
    for c in ((1.0, 0.0, -3.0, 2.0), (0.0, 1.0, -2.0, 1.0), (0.0, 0.0, 3.0, -2.0), (0.0, 0.0, -1.0, 1.0))
]


def plate_modes(
    plate: Plate, places: Sequence[Any], n_modes: int, *, altered: Alterations = AS_NOMINAL
) -> ElementModes:
    """The lowest modes of an altered plate, K v = ω² M v.

    Args:
        places: pairs (x, y) of the shapes, or `Patch`es of ∮ ∂φ/∂n ds, that are returned, m.

    Raises:
        ValueError: a plate with varying properties, tension or attachments; alterations that only a member can have.
        BucklingError: the plate buckles.
    """
    constant = plate.mass_per_area.is_constant and plate.bending_stiffness.is_constant
    if not constant or any(plate.tension) or plate.attachments:
        raise ValueError("trials need plates of uniform mass and stiffness, without tension and attachments")
    if altered.losses or altered.tension:
        raise ValueError("trials have no local loss and no tension of a plate")
    rigidity, nu = altered.stiffness_factor * float(plate.bending_stiffness(0.0, 0.0)), plate.poisson_ratio
    spacing = max(plate.length) / ELEMENTS
    x, y = (_Cubics.over(side, max(round(side / spacing), 8)) for side in plate.length)
    bent, heavy = (
        _Cubics.over(plate.length[0], x.nodes.size - 1, c) for c in (altered.stiffness_waves, altered.mass_waves)
    )
    twisted = 2.0 * (1.0 - nu) * kron(bent.slopes, y.slopes)
    across = nu * (kron(bent.mixed, y.mixed.T) + kron(bent.mixed.T, y.mixed))
    stiffness = rigidity * (kron(bent.bending, y.products) + kron(bent.products, y.bending) + across + twisted)
    mass = float(plate.mass_per_area(0.0, 0.0)) * kron(heavy.products, y.products)
    free = []
    for along, sides in ((x, ("left", "right")), (y, ("bottom", "top"))):
        held: list[int] = []
        for end, side in enumerate(sides):
            for dof, value in zip(along.end(end), (plate.edges[side].translation, plate.edges[side].rotation)):
                if value == HELD:
                    held.append(dof)
                elif value:
                    spring = diags_array(value * (np.arange(along.size) == dof).astype(float))
                    stiffness = stiffness + (kron(spring, y.products) if along is x else kron(x.products, spring))
        free.append(np.setdiff1d(np.arange(along.size), held))
    stiffness, mass = csc_array(stiffness), csc_array(mass)
    for at, value in altered.springs:
        stiffness = stiffness + value * _square(_row(x, y, at))
    for at, value in altered.masses:
        mass = mass + value * _square(_row(x, y, at))
    kept = (free[0][:, None] * y.size + free[1]).ravel()
    stiffness, mass = stiffness[:, kept][kept].tocsc(), mass[:, kept][kept].tocsc()
    # the shift makes the pencil definite with rigid-body modes, and is far below the first elastic eigenvalue
    a, b = plate.length
    shift = -1e-3 * rigidity / float(plate.mass_per_area(0.0, 0.0)) * (np.pi / max(a, b)) ** 4
    values, vectors = eigsh(stiffness, k=n_modes, M=mass, sigma=shift, which="LM", v0=np.ones(kept.size))
    order = np.argsort(values)
    omega2 = np.where(np.abs(values[order]) < ROUNDED * abs(shift), 0.0, values[order])
    if (omega2 < 0).any():
        raise BucklingError("the altered plate is unstable: it buckles; draw a weaker spring")
    full = np.zeros((x.size * y.size, n_modes))
    full[kept] = vectors[:, order] / np.sqrt(np.sum(vectors * (mass @ vectors), axis=0))[order]
    shapes = np.array([_row(x, y, at) @ full for at in places]).reshape(-1, n_modes)
    return ElementModes(np.sqrt(omega2), shapes, np.zeros((n_modes, n_modes)))


@dataclass(frozen=True, eq=False)
class _Cubics:
    """Hermite cubics along a side, and the integrals of their products.

    Attributes:
        nodes: (n_nodes,) m.
        values, slopes_at: (n_nodes,) the degrees of freedom of value and slope at each node.
        products, slopes, bending: (size, size) ∫ g φ_i φ_j, ∫ g φ_i' φ_j' and ∫ g φ_i'' φ_j''.
        mixed: (size, size) ∫ g φ_i φ_j''.
    """

    nodes: Floats
    values: np.ndarray
    slopes_at: np.ndarray
    products: csc_array
    slopes: csc_array
    bending: csc_array
    mixed: csc_array

    @classmethod
    def over(cls, length: float, elements: int, weight: Sequence[float] = ()) -> "_Cubics":
        """Cubics over the length of a side, with the weight g of `waves`."""
        share = np.linspace(0.0, 1.0, elements + 1)
        nodes = length * (share - CROWDED / (2.0 * np.pi) * np.sin(2.0 * np.pi * share))
        basis = Basis(MeshLine(nodes), ElementLineHermite(), intorder=8)
        forms = (
            lambda u, v, w: waves(weight, w.x[0] / length) * u * v,
            lambda u, v, w: waves(weight, w.x[0] / length) * d(u)[0] * d(v)[0],
            lambda u, v, w: waves(weight, w.x[0] / length) * dd(u)[0, 0] * dd(v)[0, 0],
            lambda u, v, w: waves(weight, w.x[0] / length) * dd(u)[0, 0] * v,
        )
        matrices = [csc_array(BilinearForm(form).assemble(basis)) for form in forms]
        return cls(nodes, basis.nodal_dofs[0], basis.nodal_dofs[1], *matrices)

    @property
    def size(self) -> int:
        return 2 * self.nodes.size

    def end(self, which: int) -> tuple[int, int]:
        """Degrees of freedom of value and slope at the first end (0) or the second (1)."""
        return int(self.values[-which]), int(self.slopes_at[-which])

    def at(self, x: float, derivative: int = 0) -> Floats:
        """(size,) values of the cubics, or of their derivatives, at x."""
        i = int(np.clip(np.searchsorted(self.nodes, x) - 1, 0, self.nodes.size - 2))
        h = self.nodes[i + 1] - self.nodes[i]
        t = (x - self.nodes[i]) / h
        row = np.zeros(self.size)
        dofs = (self.values[i], self.slopes_at[i], self.values[i + 1], self.slopes_at[i + 1])
        for dof, cubic, size in zip(dofs, CUBICS, (1.0, h, 1.0, h)):
            row[dof] = size * cubic.deriv(derivative)(t) / h**derivative
        return row

    def integral(self, start: float, stop: float) -> Floats:
        """(size,) ∫ φ_i from start to stop."""
        inside = self.nodes[(self.nodes > start) & (self.nodes < stop)]
        row = np.zeros(self.size)
        for place, weight in zip(*gauss_between(np.r_[start, inside, stop], 4)):
            row += weight * self.at(place)
        return row


def _row(x: _Cubics, y: _Cubics, at: Any) -> Floats:
    """(n_dofs,) coefficients of the displacement at (x, y), or of ∮ ∂w/∂n ds of a patch, in all degrees of freedom."""
    if isinstance(at, Patch):
        left, right = at.x - 0.5 * at.width, at.x + 0.5 * at.width
        bottom, top = at.y - 0.5 * at.height, at.y + 0.5 * at.height
        across_x = np.kron(x.at(right, 1) - x.at(left, 1), y.integral(bottom, top))
        return np.asarray(across_x + np.kron(x.integral(left, right), y.at(top, 1) - y.at(bottom, 1)))
    return np.asarray(np.kron(x.at(at[0]), y.at(at[1])))


def _square(row: Floats) -> csc_array:
    """The sparse matrix r rᵀ of a row r."""
    column = csc_array(row[:, None])
    return column @ column.T
