"""The domain of a structure, its set of places: an interval, a rectangle, or named points.

A place is a float (m, along an interval), a pair (x, y) of floats (m, on a rectangle) or a name (of a point). The place
of an element between two, which acts on the displacement of the first minus that of the second, is
`Between(first, second)`. The place of a patch on a plate, which acts along its edges, is `Patch(x, y, width, height)`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache, cached_property, lru_cache
from itertools import combinations
from typing import Any, ClassVar, NamedTuple

import numpy as np

from workbench.arrays import Floats

SLACK = 1e-9  # of the extent: tolerance of places outside

Place = float | tuple[float, float] | str


class Between(NamedTuple):
    """A pair of places, for an element on the displacement of the first minus that of the second."""

    first: Place
    second: Place


class Patch(NamedTuple):
    """A rectangular patch of a plate, m: its middle (x, y), its width along x and its height along y."""

    x: float
    y: float
    width: float
    height: float


Location = Place | Between | Patch
Derivative = int | tuple[int, int]


class PlaceError(ValueError):
    """A place that a structure does not have, or a direction that it does not have there."""


def position(place: Location) -> float:
    """A place as a position along an interval, m; a pair, a name, or two places raise a `PlaceError`."""
    if isinstance(place, tuple | str):
        raise PlaceError(f"a place along an interval is a position x in m; got {place!r}")
    return float(place)


@dataclass(frozen=True)
class Interval:
    """Places along a bar or beam: x from 0 to `length`, m.

    Raises:
        ValueError: a length that is not positive.
    """

    length: float
    coordinates: ClassVar[tuple[str, ...]] = ("at",)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.length) and self.length > 0):
            raise ValueError(f"the length of a structure must be positive; got {self.length}")

    def __str__(self) -> str:
        return f"0 to {self.length:g} m"

    @property
    def size(self) -> float:
        """The length, m."""
        return self.length

    def locate(self, places: Any) -> np.ndarray:
        """Positions (n_places,), m.

        Raises:
            PlaceError: a place outside, or one that is no position.
        """
        x = np.atleast_1d(_numbers(places))
        if x.ndim != 1:
            raise PlaceError(f"a place along an interval is a position x in m; got {places!r}")
        slack = SLACK * self.length
        outside = (x < -slack) | (x > self.length + slack) | ~np.isfinite(x)
        if outside.any():
            raise PlaceError(
                f"x = {x[outside][0]:g} lies outside the structure, which runs from 0 to {self.length:g}; give a place"
                " on it"
            )
        return np.asarray(np.clip(x, 0.0, self.length))

    def slope(self, places: Any, derivative: Derivative, direction: str | None) -> tuple[Any, Derivative, float]:
        """Places, order of the derivative along x, and sign, of a displacement (derivative 0), slope (1) and so on."""
        if direction not in (None, "w"):
            raise PlaceError(f"along an interval there is one direction, so none is named; got {direction!r}")
        return places, derivative, 1.0

    def grid(self, n: int) -> tuple[float, ...]:
        """Uniform places (n - 1,) inside, m, `n` spacings from end to end."""
        return tuple((self.length * np.arange(1, n) / n).tolist())

    def quadrature(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Legendre points (n,), m, and weights (n,), m: ∫ f dx = Σ w f."""
        return gauss_between(np.array([0.0, self.length]), n)

    def separation(self, one: Location, other: Location) -> float:
        """Distance between two places over the length."""
        return abs(float(one) - float(other)) / self.length  # type: ignore[arg-type]

    def text(self, place: Location, digits: int = 3) -> str:
        """Text of a place, such as "x = 3.4"."""
        if isinstance(place, Between):
            return f"between {self.text(place.first, digits)} and {self.text(place.second, digits)}"
        return f"x = {_rounded(place, digits)}"  # type: ignore[arg-type]


@dataclass(frozen=True)
class Rectangle:
    """Places on a plate or membrane: (x, y), x from 0 to `length[0]` and y from 0 to `length[1]`, m.

    The displacement w is normal to it. A slope is the rotation about an axis, right-handed: ∂w/∂y about x, -∂w/∂x
    about y.

    Raises:
        ValueError: lengths that are not positive.
    """

    length: tuple[float, float]
    coordinates: ClassVar[tuple[str, ...]] = ("x", "y")

    def __post_init__(self) -> None:
        a, b = self.length
        object.__setattr__(self, "length", (float(a), float(b)))
        if not (np.isfinite(self.length).all() and min(self.length) > 0):
            raise ValueError(f"the lengths of a rectangle must be positive; got {self.length}")

    def __str__(self) -> str:
        return f"{self.length[0]:g} m by {self.length[1]:g} m"

    @property
    def size(self) -> float:
        """The diagonal, m."""
        return float(np.hypot(*self.length))

    def locate(self, places: Any) -> np.ndarray:
        """Positions (n_places, 2), m.

        Raises:
            PlaceError: a place outside, or one that is no pair.
        """
        xy = np.atleast_2d(_numbers(places))
        if xy.ndim != 2 or xy.shape[1] != 2:
            raise PlaceError(f"a place on a rectangle is a pair (x, y) in m; got {places!r}")
        extent = np.array(self.length)
        slack = SLACK * extent
        outside = ((xy < -slack) | (xy > extent + slack) | ~np.isfinite(xy)).any(axis=1)
        if outside.any():
            x, y = xy[outside][0]
            a, b = self.length
            raise PlaceError(
                f"(x, y) = ({x:g}, {y:g}) lies outside the structure, 0 to {a:g} by 0 to {b:g}; give a place on it"
            )
        return np.asarray(np.clip(xy, 0.0, extent))

    def slope(self, places: Any, derivative: Derivative, direction: str | None) -> tuple[Any, Derivative, float]:
        """Places, orders of the derivatives along x and y, and sign, of a displacement or a slope about an axis.

        A derivative (i, j) is returned unchanged.
        """
        if isinstance(derivative, tuple):
            return places, derivative, 1.0
        if derivative not in (0, 1):
            raise PlaceError(f"a derivative on a plate is 0, 1, or a pair of orders along x and y; got {derivative}")
        if derivative == 0 and direction in (None, "w", "z"):
            return places, (0, 0), 1.0
        if derivative == 1 and direction in ("x", "y"):
            return (places, (0, 1), 1.0) if direction == "x" else (places, (1, 0), -1.0)
        if derivative == 1:
            raise PlaceError(f"a slope or moment on a plate is about an axis: direction 'x' or 'y'; got {direction!r}")
        raise PlaceError(f"a plate moves along its normal, direction 'z' or none; got {direction!r}")

    def around(
        self, patches: Any, direction: str | None, n: int
    ) -> Iterator[tuple[np.ndarray, tuple[int, int], Floats]]:
        """Quadrature of ∮ ∂w/∂n ds along the edges of patches, for each pair of opposite edges.

        Args:
            patches: (n_patches, 4) middle, width and height, m.
            direction: "y" for the two edges across x, whose moments act about y, "x" for the two across y; None for
                all four.
            n: Gauss-Legendre points per edge.

        Yields:
            Points (n_patches, 2 n, 2), orders (i, j) of the derivative normal to the edges, and weights
            (n_patches, 2 n), m, negative where the outward normal points in the negative direction.

        Raises:
            PlaceError: a patch that reaches outside, or another axis.
        """
        if direction not in (None, "x", "y"):
            raise PlaceError(f"the moments of a patch act about axis 'x' or 'y', or both (None); got {direction!r}")
        found = np.asarray(patches, float).reshape(-1, 4)
        middle, half = found[:, :2], 0.5 * found[:, 2:]
        outside = (
            (half <= 0) | (middle - half < -SLACK * self.size) | (middle + half > np.array(self.length) * (1 + SLACK))
        )
        wrong = outside.any(axis=1) | ~np.isfinite(found).all(axis=1)
        if wrong.any():
            x, y, width, height = found[np.argmax(wrong)]
            raise PlaceError(
                f"a patch of {width:g} m by {height:g} m at (x, y) = ({x:g}, {y:g}) does not lie on the structure, 0 to"
                f" {self.length[0]:g} by 0 to {self.length[1]:g}; move its middle, or make it smaller"
            )
        points, weights = _gauss(n)
        for across, axis in ((0, "y"), (1, "x")):
            if direction not in (None, axis):
                continue
            along = middle[:, 1 - across, None] + half[:, 1 - across, None] * points
            edges = [np.broadcast_to(middle[:, across, None] + s * half[:, across, None], along.shape) for s in (1, -1)]
            pairs = [(edge, along) if across == 0 else (along, edge) for edge in edges]
            at = np.concatenate([np.stack(pair, axis=-1) for pair in pairs], axis=1)
            weight = half[:, 1 - across, None] * weights
            yield at, ((1, 0), (0, 1))[across], np.concatenate([weight, -weight], axis=1)

    def grid(self, n: int) -> tuple[tuple[float, float], ...]:
        """Uniform places inside, `n` spacings along the longer side and about the same spacing along the other."""
        spacing = max(self.length) / n
        along = [np.arange(1, m) * side / m for side in self.length for m in [max(round(side / spacing), 2)]]
        return tuple((float(x), float(y)) for x in along[0] for y in along[1])

    def quadrature(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Legendre points (n_points, 2), m, and weights (n_points,), m²: ∫∫ f dx dy = Σ w f.

        The same number of modes has fewer waves along each side than along an interval: 8 + 2 √n points per side
        integrate as many modes as n points along an interval.
        """
        points, weights = _gauss(8 + round(2.0 * np.sqrt(n)))
        a, b = self.length
        x, y = np.meshgrid(0.5 * a * (points + 1.0), 0.5 * b * (points + 1.0), indexing="ij")
        return np.column_stack([x.ravel(), y.ravel()]), 0.25 * a * b * np.outer(weights, weights).ravel()

    def separation(self, one: Location, other: Location) -> float:
        """Distance between two places over the diagonal."""
        return float(np.hypot(one[0] - other[0], one[1] - other[1])) / self.size  # type: ignore

    def text(self, place: Location, digits: int = 3) -> str:
        """Text of a place, such as "(x, y) = (0.63, 0.72)"."""
        if isinstance(place, Between):
            return f"between {self.text(place.first, digits)} and {self.text(place.second, digits)}"
        if isinstance(place, Patch):
            sides = (_rounded(side, digits) for side in (place.width, place.height))
            return f"a patch of {' m by '.join(sides)} m at {self.text((place.x, place.y), digits)}"
        (x, y), *_ = self.locate(place)
        return f"(x, y) = ({_rounded(x, digits)}, {_rounded(y, digits)})"


TRANSLATIONS, ROTATIONS = ("x", "y", "z"), ("rx", "ry", "rz")


@dataclass(frozen=True, eq=False, repr=False)
class NamedPoints:
    """Named degrees of freedom of nodes: of a finite-element model, or of the sensors of a test bench.

    Attributes:
        names: (n_points,) all different.
        positions: (n_points, 3), m; None where not known.
        directions: (n_points,) of "x", "y", "z", "rx", "ry", "rz", or "" where not known.
        nodes: (n_points,) the node of each point; by default each point is its own node.

    Raises:
        ValueError: no names or two equal ones, positions or directions that do not fit the names.
    """

    names: tuple[str, ...]
    positions: np.ndarray | None = None
    directions: tuple[str, ...] = ()
    nodes: tuple[str, ...] = ()
    coordinates: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        names = tuple(self.names)
        n = len(names)
        if n == 0 or len(set(names)) < n:
            twice = next((name for name in names if names.count(name) > 1), None)
            raise ValueError(f"named points need names, all different; got {'none' if n == 0 else f'{twice!r} twice'}")
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "directions", tuple(self.directions) or ("",) * n)
        object.__setattr__(self, "nodes", tuple(map(str, self.nodes)) or names)
        for direction in self.directions:
            if direction not in ("", *TRANSLATIONS, *ROTATIONS):
                raise ValueError(f"a direction is one of x, y, z, rx, ry, rz; got {direction!r}")
        if len(self.directions) != n or len(self.nodes) != n:
            raise ValueError(
                f"{n} named points need as many directions and nodes; got {len(self.directions)} and {len(self.nodes)}"
            )
        if self.positions is not None:
            positions = np.array(self.positions, float)
            if positions.shape != (n, 3) or not np.isfinite(positions).all():
                raise ValueError(f"positions of {n} named points must be finite, ({n}, 3); got {positions.shape}")
            positions.flags.writeable = False
            object.__setattr__(self, "positions", positions)

    @cached_property
    def _index(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    @cached_property
    def _of_nodes(self) -> dict[str, dict[str, str]]:
        """The points of each node, {node: {direction: name}}."""
        points: dict[str, dict[str, str]] = {}
        for name, node, direction in zip(self.names, self.nodes, self.directions, strict=True):
            points.setdefault(node, {})[direction] = name
        return points

    @cached_property
    def size(self) -> float:
        """The diagonal of the bounding box of all points, m.

        Raises:
            PlaceError: positions are not known.
        """
        if self.positions is None:
            raise PlaceError("the positions of the named points are not known, so there is no distance; give positions")
        return float(np.linalg.norm(np.ptp(self.positions, axis=0)))

    def __str__(self) -> str:
        return f"{len(self.names)} named points"

    def __repr__(self) -> str:
        first = ", ".join(self.names[:4]) + (", ..." if len(self.names) > 4 else "")
        return f"<NamedPoints: {len(self.names)} points, {first}>"

    def locate(self, places: Any) -> np.ndarray:
        """Indices (n_places,) of named points.

        Raises:
            PlaceError: a name that no point has.
        """
        names = _as_list(places)
        indices = [self._index.get(name, -1) if isinstance(name, str) else -1 for name in names]
        if -1 in indices:
            name = names[indices.index(-1)]
            meant = "".join(f"; did you mean {match!r}?" for match in get_close_matches(str(name), self.names, n=1))
            raise PlaceError(f"there is no point {name!r}; {self._known(name)}: give one of these{meant}")
        return np.array(indices, int)

    def _known(self, name: Any) -> str:
        """The points of the node that a name begins with, as text; all points where there is no such node."""
        node = max((m for m in self.nodes if str(name).startswith(m)), key=len, default=None)
        points = [n for n, m in zip(self.names, self.nodes, strict=True) if m == node]
        if node is None or points == [node]:  # the node of a single point has no further names
            return f"the points are {_some(self.names)}"
        return f"node {node!r} has {_some(points)}"

    def slope(self, places: Any, derivative: Derivative, direction: str | None) -> tuple[Any, Derivative, float]:
        """Names of the points of the same nodes in a direction (for a slope, the rotation), derivative 0, and sign."""
        if derivative not in (0, 1):
            raise PlaceError(f"named points have displacements and rotations, no derivative of order {derivative}")
        names = _as_list(places)
        if direction is not None:
            wanted = direction if derivative == 0 or direction.startswith("r") else f"r{direction}"
            return [self.of_node(name, wanted) for name in names], 0, 1.0
        if derivative == 1:
            for i, name in zip(self.locate(names), names, strict=True):
                if self.directions[i] not in ROTATIONS:
                    raise PlaceError(
                        f"named points have no slopes; {name!r} is no rotation: give a point of direction rx, ry or rz"
                    )
        return names, 0, 1.0

    def of_node(self, name: str, direction: str) -> str:
        """The point of a node in a direction, by the node's name or that of any of its points.

        Raises:
            PlaceError: a node or direction that is not known.
        """
        node = self.nodes[self._index[name]] if name in self._index else name
        if node not in self._of_nodes:
            self.locate(name)  # raises with the names of the points
        points = self._of_nodes[node]
        if direction not in points:
            raise PlaceError(
                f"point {name!r} has no direction {direction!r}; it has"
                f" {', '.join(d or 'one without a name' for d in points)}: give one of these, or another node"
            )
        return points[direction]

    def translations(self, name: str) -> tuple[str, ...]:
        """The displacements of the same node, in which an attached mass moves."""
        node = self.nodes[int(self.locate(name)[0])]
        each = zip(self.names, self.nodes, self.directions, strict=True)
        return tuple(n for n, m, direction in each if m == node and direction not in ROTATIONS) or (name,)

    def grid(self, n: int = 0) -> tuple[str, ...]:
        """The points that are displacements."""
        return tuple(x for x, d in zip(self.names, self.directions, strict=True) if d not in ROTATIONS) or self.names

    def rotations(self) -> tuple[str, ...]:
        """The points that are rotations; all of them where none is known to be one."""
        return tuple(x for x, d in zip(self.names, self.directions, strict=True) if d in ROTATIONS) or self.names

    def pairs(self) -> Iterator[Between]:
        """Every pair of points with the same direction, of different nodes."""
        each = list(zip(self.grid(), self.locate(self.grid()), strict=True))
        for (one, i), (other, j) in combinations(each, 2):
            if self.directions[i] == self.directions[j] and self.nodes[i] != self.nodes[j]:
                yield Between(one, other)

    def quadrature(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Not available at named points: raises a `PlaceError`."""
        raise PlaceError("named points have no shapes between them to integrate; describe the structure as a member")

    def separation(self, one: Location, other: Location) -> float:
        """0 for the same place and 1 for another, as named points have no common coordinate."""
        first, second = (frozenset(place) if isinstance(place, Between) else place for place in (one, other))
        return float(first != second)

    def text(self, place: Location, digits: int = 3) -> str:
        """Text of a place: its name; `digits` is not used."""
        if isinstance(place, Between):
            return f"between {place.first} and {place.second}"
        return str(place)


Domain = Interval | Rectangle | NamedPoints


@lru_cache(maxsize=1024)  # a search makes a rig for every prediction, mostly with the same transducers
def check_place(domain: Domain, where: Location, derivative: int = 0, direction: str | None = None) -> None:
    """Refuse a place, a pair of places or a patch, or a direction, that a domain does not have, by a `PlaceError`."""
    if isinstance(where, Patch):
        if not isinstance(domain, Rectangle):
            raise PlaceError(f"a patch is placed on a plate; these modes are of {domain}")
        next(domain.around([where], direction, 1))
        return
    for place in where if isinstance(where, Between) else (where,):
        at = position(place) if isinstance(domain, Interval) else place
        domain.locate(domain.slope(at, derivative, direction)[0])


def as_domain(domain: Domain | float) -> Domain:
    """The domain itself, or the interval of that length, m."""
    return domain if isinstance(domain, Interval | Rectangle | NamedPoints) else Interval(float(domain))


def same_place(place: Any) -> Any:
    """A place in its hashable form: a float, a pair of floats, a name, `Between` two, or a `Patch`."""
    if isinstance(place, str) or type(place) is float:
        return place
    if isinstance(place, Between):
        return Between(same_place(place.first), same_place(place.second))
    if isinstance(place, Patch):
        return Patch(*map(float, place))
    values = _numbers(place)
    if values.shape in ((), (1,)):
        return float(values.reshape(()))
    if values.shape == (2,):
        return (float(values[0]), float(values[1]))
    raise PlaceError(f"a place is a position x, a pair (x, y), or the name of a point; got {place!r}")


def place_array(places: Sequence[Location | None]) -> np.ndarray:
    """Places of one kind as an array: (n_places,) m, (n_places, 2) m, or (n_places,) names.

    An unknown place is nan, or None among names; all are nan where places are of several kinds.
    """
    known = [place for place in places if place is not None]
    if known and all(isinstance(place, str) for place in known):
        return np.array(places, object)
    pairs = [isinstance(place, tuple) and not isinstance(place, Between | Patch) for place in known]
    if known and all(pairs):
        return np.array([(np.nan, np.nan) if place is None else place for place in places], float)
    numbers = all(isinstance(place, int | float) for place in known)
    return np.array([np.nan if place is None or not numbers else place for place in places], float)


def listed(places: np.ndarray) -> list[Place]:
    """An array of places as a list: floats, pairs of floats, or names."""
    return [tuple(place) if isinstance(place, list) else place for place in places.tolist()]


def middle(where: Location) -> Place:
    """The middle of a patch or of the interval between two positions along an interval; a single place itself."""
    if isinstance(where, Patch):
        return (where.x, where.y)
    if isinstance(where, Between):
        return 0.5 * (position(where.first) + position(where.second))
    return where


def centred_at(where: Location, at: Place) -> Location:
    """The patch, or the interval between two positions, moved to have its middle at `at`; else `at` itself."""
    if isinstance(where, Patch):
        x, y = at  # type: ignore[misc, str-unpack]
        return Patch(x, y, where.width, where.height)  # type: ignore[arg-type]
    if isinstance(where, Between) and not isinstance(where.first, str | tuple):
        half, x = 0.5 * (position(where.first) - position(where.second)), position(at)
        return Between(x + half, x - half)
    return at


def reach(domain: Interval | Rectangle, where: Location) -> tuple[np.ndarray, np.ndarray]:
    """Range of the middle of a place, patch or pair of positions within the domain: from and to (n_coordinates,), m."""
    half = np.zeros(len(domain.coordinates))
    if isinstance(where, Patch):
        half = 0.5 * np.array([where.width, where.height])
    elif isinstance(where, Between) and isinstance(domain, Interval):
        half = np.array([0.5 * abs(position(where.first) - position(where.second))])
    return half, np.atleast_1d(domain.length) - half


def _numbers(places: Any) -> Floats:
    """Places as an array of numbers; an empty array of three axes where they are none."""
    try:
        return np.asarray(places, float)
    except (TypeError, ValueError):
        return np.zeros((0, 0, 0))


def _rounded(value: float, digits: int) -> str:
    """Text of a value to a number of digits, without an exponent: 1341, not 1.34e+03."""
    return f"{value:.{max(digits, len(f'{abs(value):.0f}'))}g}"


def _as_list(names: Any) -> list[Any]:
    return [names] if isinstance(names, str) else list(np.atleast_1d(np.asarray(names, object)))


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")


def gauss_between(nodes: np.ndarray, n: int) -> tuple[Floats, Floats]:
    """Gauss-Legendre points and weights, n on each interval between increasing nodes, exact to degree 2 n - 1."""
    points, weights = _gauss(n)
    halves = 0.5 * np.diff(nodes)[:, None]
    return (nodes[:-1, None] + halves * (points + 1.0)).ravel(), (halves * weights).ravel()


_gauss = cache(np.polynomial.legendre.leggauss)
