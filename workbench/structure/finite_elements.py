"""Finite-element models given by matrices, M ẍ + C ẋ + K x = f, with a named point for each degree of freedom."""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import index
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, eigh
from scipy.sparse import coo_array, csc_array, sparray, spmatrix
from scipy.sparse.linalg import ArpackError, LinearOperator, SuperLU, eigsh, splu

from workbench.arrays import Floats
from workbench.structure.damping import Damping, ModalDamping, ViscousDamping
from workbench.structure.domain import ROTATIONS, Between, Location, NamedPoints
from workbench.structure.modes import Modes
from workbench.structure.printed import Printed, counted
from workbench.structure.supports import Attachment, PointDamper, PointMass, PointSpring

SYMMETRIC = 1e-9  # of the largest entry: tolerated asymmetry, by rounding in the program that wrote the matrix
SINGULAR = 1e-12  # smallest pivot of K over the largest: below it the structure can move as a rigid body
MASSLESS = 1e-12  # of the largest ν = 1 / (ω² - σ): below it a motion has no mass
SHIFT = 1e-11  # of the highest ω², by which K is shifted where it is singular
ROUNDING = 64.0 * np.finfo(float).eps  # of φᵀ |K| φ: a smaller ω² cannot be distinguished from zero

MATRICES = {PointMass: "mass", PointSpring: "stiffness", PointDamper: "damping"}  # to which an attachment is added

Matrix: TypeAlias = sparray | spmatrix | np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class FiniteElements(Printed):
    """A finite-element model of a structure, given by its matrices.

    Attributes:
        mass, stiffness: M (kg, kg m²) and K (N/m, N m/rad), (n, n) symmetric, sparse or not, supports eliminated.
        nodes: the degrees of freedom in the order of the matrices, as `NamedPoints`; or coordinates (n_nodes, 3), m,
            for which every node has all `directions` in turn, and points are named 1x, 1y, ..., 2x, ...
        damping: C (n, n), or `ModalDamping` or `ProportionalDamping`.
        directions: of each node, where coordinates are given.

    Raises:
        ValueError: matrices that are not symmetric, of other sizes than the nodes, or not positive.
    """

    mass: csc_array
    stiffness: csc_array
    nodes: NamedPoints
    damping: csc_array | Damping

    def __init__(
        self,
        mass: Matrix,
        stiffness: Matrix,
        *,
        nodes: NamedPoints | ArrayLike,
        damping: Matrix | Damping | None = None,
        directions: Sequence[str] = ("x", "y", "z"),
    ) -> None:
        points = nodes if isinstance(nodes, NamedPoints) else _points(nodes, tuple(directions))
        n = len(points.names)
        object.__setattr__(self, "nodes", points)
        object.__setattr__(self, "mass", _symmetric("mass", mass, n))
        object.__setattr__(self, "stiffness", _symmetric("stiffness", stiffness, n))
        if isinstance(damping, ViscousDamping):
            raise ValueError("damping per length does not apply to a model given by matrices; give a damping matrix C")
        if damping is None or isinstance(damping, Damping):
            object.__setattr__(self, "damping", damping or ModalDamping())
        else:
            object.__setattr__(self, "damping", _symmetric("damping", damping, n))
        if (self.mass.diagonal() < 0).any():
            i = int(np.argmin(self.mass.diagonal()))
            raise ValueError(
                f"the mass matrix is not positive semidefinite: point {points.names[i]!r} has {self.mass[i, i]:.3g} kg"
            )

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        n, nodes = len(self.nodes.names), len(set(self.nodes.nodes))
        damping = "a damping matrix" if isinstance(self.damping, csc_array) else repr(self.damping)
        return f"finite elements, {n} degrees of freedom at {counted(nodes, 'node')}, {damping}", (), (), ()

    @property
    def domain(self) -> NamedPoints:
        """The places of the structure: its degrees of freedom."""
        return self.nodes

    def modes(self, n_modes: int) -> Modes:
        """The lowest `n_modes` modes, mass-normalised, by shift-invert Lanczos (ARPACK); all of them by LAPACK.

        Raises:
            ValueError: more modes than degrees of freedom that have mass, or matrices that are not positive
                semidefinite.
        """
        n, n_modes = len(self.nodes.names), index(n_modes)
        if not 1 <= n_modes <= n:
            raise ValueError(f"{n} degrees of freedom have 1 to {n} modes; got {n_modes}")
        if _negative_pivots(self.mass):
            raise ValueError("the mass matrix is not positive semidefinite: a motion has negative kinetic energy")
        shapes = self._lowest_shapes(n_modes)
        sizes = np.sum(shapes * (self.mass @ shapes), axis=0)
        if (sizes <= 0).any():
            raise ValueError("the mass matrix is not positive semidefinite: a mode has no kinetic energy")
        shapes = shapes / np.sqrt(sizes)
        values = np.sum(shapes * (self.stiffness @ shapes), axis=0)
        floor = ROUNDING * np.sum(np.abs(shapes) * (abs(self.stiffness) @ np.abs(shapes)), axis=0)
        if (values < -floor).any():
            raise ValueError(
                f"the stiffness matrix is not positive semidefinite: an eigenvalue ω² is {values.min():.3g};"
                " is its sign right, and are all elements stable?"
            )
        values = np.where(values < floor, 0.0, values)
        order = np.argsort(values, kind="stable")
        shapes, omega = shapes[:, order], np.sqrt(values[order])
        first = (np.abs(shapes) > 1e-6 * np.abs(shapes).max(axis=0)).argmax(axis=0)
        shapes = np.ascontiguousarray(shapes * np.where(shapes[first, np.arange(n_modes)] < 0, -1.0, 1.0))
        shapes.flags.writeable = False
        if isinstance(self.damping, csc_array):
            damping = shapes.T @ (self.damping @ shapes)
        else:
            damping = self.damping.matrix(omega)  # type: ignore[union-attr]
        return Modes(omega=omega, damping=damping, shapes=lambda index, _: shapes[index], domain=self.nodes)

    def _lowest_shapes(self, n_modes: int) -> Floats:
        """The lowest shapes (n, n_modes), in any order and scale."""
        n = len(self.nodes.names)
        shift, factor = self._shifted_factor()
        if n_modes == n:
            try:
                return np.asarray(eigh(self.stiffness.toarray(), self.mass.toarray())[1])
            except LinAlgError as error:
                raise ValueError(
                    "some degrees of freedom have no mass, so there are fewer modes; ask for fewer"
                ) from error
        inverse = LinearOperator((n, n), matvec=factor.solve, dtype=float)
        start = np.random.default_rng(0).standard_normal(n)
        try:
            return np.asarray(eigsh(self.stiffness, k=n_modes, M=self.mass, sigma=shift, OPinv=inverse, v0=start)[1])
        except ArpackError:  # hardly more degrees of freedom with mass than modes
            return self._massive_shapes(n_modes, shift)

    def _massive_shapes(self, n_modes: int, shift: float) -> Floats:
        """The lowest shapes (n, n_modes) by LAPACK, M φ = ν (K - σ M) φ, with ν = 0 for massless motions."""
        stiffness = (self.stiffness - shift * self.mass).toarray()
        values, shapes = eigh(self.mass.toarray(), stiffness)
        massive = int((values > MASSLESS * values[-1]).sum())
        if massive < n_modes:
            raise ValueError(
                f"{massive} motions of {len(values)} degrees of freedom have mass, so there are no {n_modes} modes; ask"
                f" for at most {massive}, or give the others mass"
            )
        return np.asarray(shapes[:, ::-1][:, :n_modes])

    def attached(self, parts: Sequence[Attachment]) -> "FiniteElements":
        """The model with masses, springs and dampers at its points, or between two of them, added to its matrices.

        A mass moves in every direction of its node; a spring or damper acts in the direction of its point. Rotary
        inertia and rotational springs and dampers act at a point that is a rotation.

        Raises:
            ValueError: a point that is not there, a mass between two points, dampers where no damping matrix is given.
        """
        n = len(self.nodes.names)
        added: dict[str, list[tuple[np.ndarray, float]]] = {"mass": [], "stiffness": [], "damping": []}
        for part in parts:
            kind, places = MATRICES[type(part)], [part.at]
            if isinstance(part, PointMass):
                if isinstance(part.at, Between):
                    raise ValueError(f"{part}: a mass is attached to one point; give it at each of the two")
                places = [*self.nodes.translations(str(part.at))]
            linear, rotational = part.pair
            added[kind] += [(self._row(at), linear) for at in places]
            if rotational:
                added[kind].append((self._rotation(part), rotational))
        damping: Any = self.damping
        if added["damping"]:
            if not isinstance(damping, csc_array):
                raise ValueError(
                    "dampers are added to a damping matrix, and this structure has modal damping; give damping=C, or"
                    " attach the dampers to its modes: attach(model.modes(n), parts), which is exact for them"
                )
            damping = damping + _outer_sum(added["damping"], n)
        return FiniteElements(
            self.mass + _outer_sum(added["mass"], n),
            self.stiffness + _outer_sum(added["stiffness"], n),
            nodes=self.nodes,
            damping=damping,
        )

    def _row(self, where: Location) -> np.ndarray:
        """(k, 2) degrees of freedom and factors of the elongation of an attachment."""
        if isinstance(where, Between):
            first, second = self.nodes.locate(list(where))
            return np.array([(first, 1.0), (second, -1.0)])
        return np.array([(self.nodes.locate(where)[0], 1.0)])

    def _rotation(self, part: Attachment) -> np.ndarray:
        if isinstance(part.at, Between) or self.nodes.directions[self.nodes.locate(part.at)[0]] not in ROTATIONS:
            raise ValueError(f"{part}: give it at a point that is a rotation: rx, ry or rz of the node")
        return self._row(part.at)

    def _shifted_factor(self) -> tuple[float, SuperLU]:
        """A shift σ ≤ 0 and the factors of K - σ M; σ = 0 unless the structure has rigid-body modes."""
        try:
            factor = _factor(self.stiffness)
            pivots = factor.U.diagonal()
            if np.abs(pivots).min() > SINGULAR * np.abs(pivots).max():
                negative = _negative(factor)
                if negative:
                    raise ValueError(
                        f"the stiffness matrix is not positive semidefinite: {negative} of its eigenvalues are"
                        " negative; is its sign right, and are all elements stable?"
                    )
                return 0.0, factor
        except RuntimeError:  # a pivot of exactly zero
            pass
        mass, stiffness = self.mass.diagonal(), self.stiffness.diagonal()
        massive = mass > 0
        # without any stiffness, all modes are rigid and any shift will do
        shift = -SHIFT * float((stiffness[massive] / mass[massive]).max(initial=0.0)) or -1.0
        try:
            return shift, _factor((self.stiffness - shift * self.mass).tocsc())
        except RuntimeError as error:
            loose = np.flatnonzero(~massive & (stiffness == 0))
            what = f"point {self.nodes.names[loose[0]]!r}" if loose.size else "a motion"
            raise ValueError(f"{what} has neither mass nor stiffness, so it has no mode; leave it out") from error


def _factor(matrix: csc_array) -> SuperLU:
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _negative(factor: SuperLU) -> int:
    """Number of negative eigenvalues of a factored symmetric matrix, by Sylvester's law of inertia."""
    return int((factor.U.diagonal() < 0).sum()) if (factor.perm_r == factor.perm_c).all() else 0


def _negative_pivots(matrix: csc_array) -> int:
    """Number of negative eigenvalues of a mass matrix without its massless degrees of freedom."""
    massive = np.flatnonzero(matrix.diagonal() > 0)
    try:
        return _negative(_factor(matrix[:, massive][massive].tocsc()))
    except RuntimeError:  # singular, which a mass matrix may be
        return 0


def _symmetric(name: str, matrix: Matrix, n: int) -> csc_array:
    if np.shape(matrix) != (n, n):
        ratio = "; a damping ratio is given as ModalDamping(ratio)" if name == "damping" else ""
        raise ValueError(
            f"the {name} matrix has shape {np.shape(matrix)}; {n} degrees of freedom need ({n}, {n}){ratio}"
        )
    found = csc_array(matrix)
    if np.iscomplexobj(found.data) and found.data.imag.any():
        raise ValueError(
            f"the {name} matrix is complex: give its real part; a loss factor η of the whole structure is, near a"
            " resonance, damping=ModalDamping(η / 2)"
        )
    found = csc_array(found.real, dtype=float)
    if not np.isfinite(found.data).all():
        raise ValueError(f"the {name} matrix holds numbers that are not finite")
    largest = float(np.abs(found.data).max(initial=0.0))
    skew = (found - found.T).tocoo()
    if skew.nnz and np.abs(skew.data).max() > SYMMETRIC * largest:
        i = int(np.abs(skew.data).argmax())
        row, column = skew.coords[0][i], skew.coords[1][i]
        raise ValueError(
            f"the {name} matrix is not symmetric: entries ({row}, {column}) and ({column}, {row}) differ by"
            f" {abs(skew.data[i]):.3g}; give the whole matrix, not one triangle"
        )
    return csc_array((found + found.T) * 0.5)


def _outer_sum(parts: list[tuple[np.ndarray, float]], n: int) -> csc_array:
    """Σ value r rᵀ of sparse rows r."""
    entries = [(int(i), int(j), value * a * b) for row, value in parts for i, a in row for j, b in row]
    rows, columns, values = zip((0, 0, 0.0), *entries)
    return csc_array(coo_array((values, (rows, columns)), shape=(n, n)))


def _points(coordinates: ArrayLike, directions: tuple[str, ...]) -> NamedPoints:
    given = np.asarray(coordinates)
    if given.ndim != 2 or given.shape[1] != 3 or given.dtype.kind not in "fiu":
        raise ValueError(
            "nodes are coordinates (n_nodes, 3), m, or NamedPoints, which take names; got an array"
            f" {given.shape} of {given.dtype}"
        )
    positions = given.astype(float)
    nodes = [str(i + 1) for i in range(positions.shape[0])]
    return NamedPoints(
        tuple(node + direction for node in nodes for direction in directions),
        np.repeat(positions, len(directions), axis=0),
        directions * len(nodes),
        tuple(node for node in nodes for _ in directions),
    )
