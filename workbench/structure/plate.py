"""Rectangular plates and membranes, and their modes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from workbench.structure.damping import Damping, ModalDamping, ViscousDamping
from workbench.structure.domain import Rectangle
from workbench.structure.modes import Modes
from workbench.structure.printed import Printed
from workbench.structure.profile import Field, FieldLike, as_field
from workbench.structure.supports import (
    HELD,
    SIDES,
    Attachment,
    Edge,
    PointDamper,
    PointMass,
    PointSpring,
    as_edges,
    masses_among,
    support_text,
)
from workbench.structure.surface_basis import EdgeSpring, PointTerm, Square, SurfaceProblem
from workbench.structure.surface_ritz import solve

SAMPLES = 41  # per side, at which a field is checked to be positive
FIELD_UNITS = {"mass_per_area": "kg/m²", "bending_stiffness": "N m", "tension": "N/m"}
SAME_POINT = 1e-6  # of a side: attachments nearer to one another are at one point


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class _Surface(Printed):
    length: tuple[float, float]
    mass_per_area: Field
    edges: Mapping[str, Edge] = field(default_factory=dict)
    damping: Damping = field(default_factory=ModalDamping)

    _edges: ClassVar[tuple[str, ...]]  # names of possible edges

    @property
    def domain(self) -> Rectangle:
        """The rectangle of the surface."""
        return Rectangle(self.length)

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        sides = np.multiply.outer([0.0, 0.5, 1.0], self.length)
        quantities = {name: value for name, value in vars(self).items() if isinstance(value, Field)}
        rows = [
            (f"{name.replace('_', ' ')} [{FIELD_UNITS[name]}]", *(f"{v:.4g}" for v in quantity(*sides.T)))
            for name, quantity in quantities.items()
        ]
        edges = {side: support_text(edge, self._edges) for side, edge in self.edges.items()}
        alike = len(set(edges.values())) == 1
        around = f"all edges {edges['left']}" if alike else ", ".join(f"{side} {edge}" for side, edge in edges.items())
        line = f"{type(self).__name__.lower()}, {self.length[0]:g} by {self.length[1]:g} m, {around}"
        headings = ("", *(f"at {x:.4g}, {y:.4g} m" for x, y in sides))
        return line, headings, rows, tuple(map(str, getattr(self, "attachments", ())))

    def _prepare(self, *names: str) -> None:
        """Check the length, the edges and the fields of these names."""
        object.__setattr__(self, "length", Rectangle(self.length).length)
        object.__setattr__(self, "edges", as_edges(self.edges, allowed=self._edges))
        share = (np.arange(SAMPLES) + 0.5) / SAMPLES
        x, y = share[:, None] * self.length[0], share[None, :] * self.length[1]
        for name in names:
            value = as_field(getattr(self, name))
            object.__setattr__(self, name, value)
            values = value(x, y)
            if not (np.isfinite(values) & (values > 0)).all():
                i, j = np.argwhere(~(np.isfinite(values) & (values > 0)))[0]
                raise ValueError(
                    f"{name} must be positive and finite everywhere; it is {values[i, j]:g} at (x, y) ="
                    f" ({x[i, 0]:g}, {y[0, j]:g})"
                )

    def _edge_springs(self, derivatives: int) -> tuple[EdgeSpring, ...]:
        springs = []
        for i, side in enumerate(SIDES):
            at = 0.0 if i % 2 == 0 else self.length[i // 2]
            pair = (self.edges[side].translation, self.edges[side].rotation)[:derivatives]
            springs += [EdgeSpring(i // 2, at, d, stiffness) for d, stiffness in enumerate(pair) if stiffness]
        return tuple(springs)

    def _mean(self, quantity: Field) -> float:
        share = np.linspace(0.05, 0.95, 19)
        return float(quantity(share[:, None] * self.length[0], share[None, :] * self.length[1]).mean())

    def _solved(self, problem: SurfaceProblem, n_modes: int, tolerance: float, beyond: int = 0) -> Modes:
        found = solve(problem, n_modes, tolerance=tolerance, beyond=beyond)
        if isinstance(self.damping, ViscousDamping):
            damping = found.products(as_field(self.damping.coefficient_per_length))  # type: ignore[arg-type]
        else:
            damping = self.damping.matrix(found.omega)
        return Modes(omega=found.omega, damping=damping, shapes=found.shapes, domain=self.domain)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Plate(_Surface):
    """A thin rectangular plate in bending (Kirchhoff), of strain energy

    ½ ∫ D [w_xx² + w_yy² + 2 ν w_xx w_yy + 2 (1 - ν) w_xy²] + N_x w_x² + N_y w_y² + 2 N_xy w_x w_y dA;
    Leissa, Vibration of Plates, NASA SP-160 (1969).

    Attributes:
        length: (a, b) along x and y, m.
        mass_per_area: m in kg/m²; a number, a function of (x, y), or a `Field`.
        bending_stiffness: D = E h³ / (12 (1 - ν²)) in N m, likewise.
        poisson_ratio: ν.
        edges: "simply supported", "clamped", "free", "guided" or an `Edge(translation, rotation)`: one for all, or a
            mapping of left (x = 0), right, bottom (y = 0) and top.
        attachments: `PointMass`, `PointSpring`, `PointDamper` at (x, y); without rotary inertia and rotational
            stiffness, since the rotation of a Kirchhoff plate under a point moment is infinite.
        damping: `ModalDamping`, `ProportionalDamping` or `ViscousDamping` (a coefficient per area, N s/m³).
        tension: in-plane N/m, positive in tension: one number for both directions, (N_x, N_y) or (N_x, N_y, N_xy).

    Raises:
        ValueError: a field that is not positive, an edge of unknown name, an attachment outside, a Poisson's ratio
            out of range.
    """

    bending_stiffness: Field
    poisson_ratio: float
    attachments: tuple[Attachment, ...] = ()
    tension: tuple[float, float, float] = (0.0, 0.0, 0.0)

    _edges = ("simply supported", "clamped", "free", "guided")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line, *table = super()._printed()
        pulled = f", tension {', '.join(f'{pull:g}' for pull in self.tension)} N/m" if any(self.tension) else ""
        return f"{line}, Poisson's ratio {self.poisson_ratio:g}{pulled}", *table  # type: ignore[return-value]

    if TYPE_CHECKING:  # the arguments may have short forms, which become `Field`, `Edge` and a triple

        def __init__(
            self,
            *,
            length: tuple[float, float],
            mass_per_area: FieldLike,
            bending_stiffness: FieldLike,
            poisson_ratio: float,
            edges: str | Edge | Mapping[str, str | Edge],
            attachments: Sequence[Attachment] = (),
            damping: Damping = ...,
            tension: float | Sequence[float] = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        self._prepare("mass_per_area", "bending_stiffness")
        check_poisson_ratio(self.poisson_ratio)
        tension = np.atleast_1d(np.asarray(self.tension, float))
        if tension.size > 3 or not np.isfinite(tension).all():
            raise ValueError(f"tension is one number, (N_x, N_y) or (N_x, N_y, N_xy) in N/m; got {self.tension}")
        normal = np.r_[tension, tension] if tension.size == 1 else tension
        object.__setattr__(self, "tension", tuple(np.r_[normal, np.zeros(3)][:3].tolist()))
        object.__setattr__(self, "attachments", tuple(self.attachments))
        for part in self.attachments:
            self.domain.locate([part.at])
            if part.pair[1]:
                raise ValueError(
                    f"{part}: the rotation of a thin plate under a point moment is infinite, so"
                    f" {fields(part)[-1].name} has no meaning there; distribute it over two points or more"
                )
            if isinstance(part, PointMass) and part.mass < 0:
                raise ValueError(f"{part}: a mass cannot be negative; leave it out or lower mass_per_area")

    @classmethod
    def of_thickness(
        cls,
        *,
        length: tuple[float, float],
        thickness: FieldLike,
        density: float,
        youngs_modulus: float,
        poisson_ratio: float,
        edges: str | Edge | Mapping[str, str | Edge],
        attachments: Sequence[Attachment] = (),
        damping: Damping | None = None,
        tension: float | Sequence[float] = 0.0,
    ) -> "Plate":
        """The plate of a thickness h (m) and a material: m = ρ h, D = E h³ / (12 (1 - ν²)); kg/m³ and Pa."""
        h = as_field(thickness)
        factor = youngs_modulus / (12.0 * (1.0 - poisson_ratio**2))
        return cls(
            length=length,
            mass_per_area=h.mapped(lambda values: density * values),
            bending_stiffness=h.mapped(lambda values: factor * values**3),
            poisson_ratio=poisson_ratio,
            edges=edges,
            attachments=attachments,
            damping=damping or ModalDamping(),
            tension=tension,
        )

    def modes(self, n_modes: int, *, tolerance: float = 1e-6, beyond: int = 0) -> Modes:
        """The lowest `n_modes` modes, mass-normalised, with frequencies to a relative `tolerance`.

        In closed form where all edges are simply supported and mass, stiffness and tension constant; else by the
        Rayleigh-Ritz method, refined until the frequencies converge (`surface_ritz.solve`).

        Args:
            n_modes: number of modes.
            tolerance: relative, of the frequencies.
            beyond: largest number of further modes, returned without the tolerance.

        Raises:
            ValueError: the tolerance cannot be reached (with the accuracy that is reached), or buckling.
        """
        if n_modes < 1:
            raise ValueError(f"the number of modes must be at least 1; got {n_modes}")
        loaded = any(isinstance(part, PointMass | PointSpring) for part in self.attachments)
        if self.is_navier and not loaded and not isinstance(self.damping, ViscousDamping):
            return self._with_dampers(self._closed_form(n_modes + beyond))
        return self._with_dampers(self._solved(self.ritz_problem(), n_modes, tolerance, beyond))

    @property
    def is_navier(self) -> bool:
        """Whether the plate without attachments has modes in closed form: constant, simply supported on all edges."""
        simple = all(edge == Edge(HELD, 0.0) for edge in self.edges.values()) and not self.tension[2]
        return simple and self.mass_per_area.is_constant and self.bending_stiffness.is_constant

    def ritz_problem(self) -> SurfaceProblem:
        """The eigenvalue problem that `surface_ritz` solves."""
        nu, rigidity, (nx, ny, nxy) = self.poisson_ratio, self.bending_stiffness, self.tension
        squares = [*bending_squares(rigidity, nu)]
        principal, directions = np.linalg.eigh([[nx, nxy], [nxy, ny]])
        for value, (c, s) in zip(principal, directions.T):
            if value:
                squares.append(Square(Field.constant(value), ((c, 1, 0), (s, 0, 1))))
        a, b = self.length
        return SurfaceProblem(
            length=self.length,
            continuity=1,
            mass=self.mass_per_area,
            squares=tuple(squares),
            edges=self._edge_springs(2),
            points=self._point_terms(),
            breaks=_breaks(self.mass_per_area, self.bending_stiffness),
            corners=self._singular_corners(),
            scale=self._mean(self.bending_stiffness) / self._mean(self.mass_per_area) * (np.pi**2 / (a * b)) ** 2,
        )

    def _point_terms(self) -> tuple[PointTerm, ...]:
        """Masses and springs, summed at each point; those on a held edge are left out."""
        terms: list[PointTerm] = []
        for part in self.attachments:
            if isinstance(part, PointDamper) or self._is_held(part.at):
                continue
            mass = part.mass if isinstance(part, PointMass) else 0.0
            spring = part.stiffness if isinstance(part, PointSpring) else 0.0
            x, y = self.domain.locate([part.at])[0]
            near = [t for t in terms if np.allclose(t.at, (x, y), rtol=0.0, atol=SAME_POINT * min(self.length))]
            for term in near:
                terms.remove(term)
                mass, spring, (x, y) = mass + term.mass, spring + term.stiffness, term.at
            terms.append(PointTerm((float(x), float(y)), mass, spring))
        return tuple(terms)

    def _is_held(self, at: object) -> bool:
        x, y = self.domain.locate([at])[0]
        away = dict(zip(SIDES, (x, self.length[0] - x, y, self.length[1] - y)))
        slack = SAME_POINT * min(self.length)
        return any(away[side] < slack and edge.translation == HELD for side, edge in self.edges.items())

    def _singular_corners(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Coordinates of the corners where a clamped edge meets a free or an elastic one.

        At other corners of 90° the solution is smooth, or nearly so: it can be continued by reflection beyond a simply
        supported or guided edge.
        """
        corners: tuple[set[float], set[float]] = set(), set()
        for i, vertical in enumerate(SIDES[:2]):
            for j, horizontal in enumerate(SIDES[2:]):
                pair = [self.edges[vertical], self.edges[horizontal]]
                clamped = [edge.translation == HELD and edge.rotation == HELD for edge in pair]
                free = [edge.translation != HELD and edge.rotation != HELD for edge in pair]
                if any(clamped) and any(free):
                    corners[0].add(i * self.length[0])
                    corners[1].add(j * self.length[1])
        return tuple(sorted(corners[0])), tuple(sorted(corners[1]))

    def _closed_form(self, n_modes: int) -> Modes:
        """Modes of the simply supported plate, sin(i π x / a) sin(j π y / b) (Navier)."""
        (a, b), (nx, ny, _) = self.length, self.tension
        m, d = self._mean(self.mass_per_area), self._mean(self.bending_stiffness)
        numbers = np.array([4, 4])  # of half waves along x and y, increased until they include all of the lowest modes
        while True:
            i, j = np.meshgrid(*(np.arange(1, n + 1) for n in numbers), indexing="ij")
            kx, ky = np.pi / a * i, np.pi / b * j
            values = (d * (kx**2 + ky**2) ** 2 + nx * kx**2 + ny * ky**2) / m
            highest = np.sort(values, axis=None)[min(n_modes, values.size) - 1]
            short = np.array([values[-1].min() <= highest, values[:, -1].min() <= highest])
            if values.size >= n_modes and not short.any():
                break
            numbers = numbers + numbers * (short | (values.size < n_modes))
        kx, ky, values = kx.ravel(), ky.ravel(), values.ravel()
        if values.min() <= 0:
            raise ValueError(
                f"a tension of {self.tension} N/m compresses the plate beyond buckling; lower its magnitude"
            )
        # repeated modes in the order of their slopes along x, as in `surface_ritz`
        order = np.lexsort((kx, np.round(values / values.min(), 9)))[:n_modes]
        kx, ky = kx[order], ky[order]
        size = 2.0 / np.sqrt(m * a * b)

        def shapes(places: np.ndarray, derivatives: tuple[int, int]) -> np.ndarray:
            along_x = kx ** derivatives[0] * np.sin(np.outer(places[:, 0], kx) + 0.5 * np.pi * derivatives[0])
            along_y = ky ** derivatives[1] * np.sin(np.outer(places[:, 1], ky) + 0.5 * np.pi * derivatives[1])
            return np.asarray(size * along_x * along_y)

        omega = np.sqrt(values[order])
        return Modes(omega=omega, damping=self.damping.matrix(omega), shapes=shapes, domain=self.domain)  # type: ignore

    def _with_dampers(self, modes: Modes) -> Modes:
        damping = modes.damping
        for part in self.attachments:
            if isinstance(part, PointDamper):
                row = modes.phi(part.at)[0]
                damping = damping + part.coefficient * np.outer(row, row)
        return replace(modes, damping=damping, masses=masses_among(self.attachments))


def check_poisson_ratio(value: float) -> None:
    """Refuse, by a `ValueError`, a Poisson's ratio that no isotropic material has, outside -1 to 0.5."""
    if not -1.0 < value < 0.5 + 1e-12:
        raise ValueError(f"Poisson's ratio lies between -1 and 0.5; got {value}")


def bending_squares(rigidity: Field, poisson_ratio: float) -> tuple[Square, ...]:
    """The strain energy of bending as a sum of squares, which does not cancel."""
    nu = poisson_ratio
    return (
        Square(lambda x, y: 0.5 * (1.0 + nu) * rigidity(x, y), ((1.0, 2, 0), (1.0, 0, 2))),
        Square(lambda x, y: 0.5 * (1.0 - nu) * rigidity(x, y), ((1.0, 2, 0), (-1.0, 0, 2))),
        Square(lambda x, y: 2.0 * (1.0 - nu) * rigidity(x, y), ((1.0, 1, 1),)),
    )


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Membrane(_Surface):
    """A rectangular membrane: ω² m w = -∇·(T ∇w).

    Attributes:
        length: (a, b) along x and y, m.
        mass_per_area: kg/m²; a number, a function of (x, y), or a `Field`.
        tension: T in N/m, likewise.
        edges: "fixed", "free" or an `Edge(translation)`: one for all, or a mapping of left, right, bottom and top.
        damping: `ModalDamping`, `ProportionalDamping` or `ViscousDamping` (a coefficient per area, N s/m³).

    Masses and springs at points are not supported: the displacement of a membrane under a point force is infinite.

    Raises:
        ValueError: a field that is not positive, an edge of unknown name.
    """

    tension: Field

    _edges = ("fixed", "free")

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            length: tuple[float, float],
            mass_per_area: FieldLike,
            tension: FieldLike,
            edges: str | Edge | Mapping[str, str | Edge] = ...,
            damping: Damping = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "edges", self.edges or "fixed")
        self._prepare("mass_per_area", "tension")

    def modes(self, n_modes: int, *, tolerance: float = 1e-6) -> Modes:
        """The lowest `n_modes` modes, mass-normalised, with frequencies to a relative `tolerance`.

        Raises:
            ValueError: the tolerance cannot be reached (with the accuracy that is reached).
        """
        if n_modes < 1:
            raise ValueError(f"the number of modes must be at least 1; got {n_modes}")
        a, b = self.length
        problem = SurfaceProblem(
            length=self.length,
            continuity=0,
            mass=self.mass_per_area,
            squares=(Square(self.tension, ((1.0, 1, 0),)), Square(self.tension, ((1.0, 0, 1),))),
            edges=self._edge_springs(1),
            points=(),
            breaks=_breaks(self.mass_per_area, self.tension),
            corners=((), ()),
            scale=self._mean(self.tension) / self._mean(self.mass_per_area) * np.pi**2 / (a * b),
        )
        return self._solved(problem, n_modes, tolerance)


def _breaks(*fields: Field) -> tuple[tuple[float, ...], tuple[float, ...]]:
    along_x = sorted({x for each in fields for x in each.x_breaks})
    return tuple(along_x), tuple(sorted({y for each in fields for y in each.y_breaks}))
