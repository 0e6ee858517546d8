"""Modal filters: constant weights from sensor readings to modal coordinates.

Along a structure, dissertation sections 5.3-5.4: q_r = ∫ m φ_r w dx (5.4) with w interpolated between the sensors.
Attached masses add M φ_r w and J φ_r' w' at their places, since the modes are orthogonal only with them. At named
points w is the displacement of least strain energy. Over a rectangle w is a thin-plate spline through sensors at any
places.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline, RBFInterpolator, make_interp_spline

from workbench.arrays import Floats
from workbench.renamed import Renamed
from workbench.structure.domain import NamedPoints, Place, Rectangle, gauss_between, position, same_place
from workbench.structure.member import Structure
from workbench.structure.modes import Modes, freeze
from workbench.structure.plate import Membrane, Plate
from workbench.structure.printed import Printed, counted, place_text
from workbench.structure.profile import FieldLike, Profile, ProfileLike, as_field, as_profile

GAUSS_POINTS = 24
INDISTINCT = 1e-6  # of the largest singular value of the shapes at the sensors: below, they amplify noise by a million
RIGID = 1e-4  # of the slowest elastic frequency: that of a rigid mode here, at which it costs almost no energy
READINGS = 3  # not on one line, to determine a plane
PER_SIDE = 24  # zero displacements along a held edge of the longer side
SAME = 1e-6  # of the diagonal: a sensor nearer to a place on the edge replaces the zero there
QUADRATURE = 500  # order of the rule, in modes: the spline is less smooth than the modes are


@dataclass(frozen=True, eq=False, repr=False)
class ModalFilter(Printed):
    """Weights that turn readings into modal coordinates; velocities use the same weights.

    Attributes:
        positions: (n_sensors,) m, increasing; on a plate (n_sensors, 2) m; at named points (n_sensors,) names.
        displacement: (n_modes, n_sensors) weights of the displacements (or velocities).
        slope: (n_modes, n_sensors) weights of the slopes (or angular velocities); no columns where none are read.
        designed_by: repeats the design with the same settings, from modes and the indices of the filtered ones.
    """

    positions: np.ndarray
    displacement: Floats
    slope: Floats
    designed_by: Callable[[Modes, Sequence[int]], "ModalFilter"] | None = None

    def __post_init__(self) -> None:
        freeze(self, "positions", dtype=None)
        freeze(self, "displacement", "slope")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        n_modes, n_sensors = self.displacement.shape
        read = "displacements and slopes" if self.slope.size else "displacements"
        line = f"modal filter of {counted(n_modes, 'mode')} through {read} of {counted(n_sensors, 'sensor')}"
        headings = ("sensor", "place", *(f"q{r + 1}" for r in range(n_modes)))
        rows = [
            (str(i + 1), place_text(place), *(f"{weight:.4g}" for weight in self.displacement[:, i]))
            for i, place in enumerate(self.places)
        ]
        return line, headings, rows, ()

    @property
    def places(self) -> list[Place]:
        """The positions as floats, pairs of floats, or names."""
        return [same_place(at) for at in self.positions]

    def __call__(self, displacement: ArrayLike, slope: ArrayLike | None = None) -> Floats:
        """Modal coordinates (n_modes, ...) from readings (n_sensors, ...), time last."""
        modal = np.asarray(self.displacement @ np.asarray(displacement, float))
        return modal if slope is None or not self.slope.size else modal + self.slope @ np.asarray(slope, float)

    seen = Renamed("response_to")

    def response_to(self, modes: Modes) -> Floats:
        """The filter's modal coordinates for a unit of each mode, (n_filtered, n_modes); ideally the identity.

        The columns of other than the filtered modes are observation spillover.
        """
        matrix = self.displacement @ modes.phi(self.positions)
        return matrix if self.slope.size == 0 else matrix + self.slope @ modes.phi(self.positions, 1)


def hermite_filter(modes: Modes, positions: ArrayLike, mass_per_length: ProfileLike) -> ModalFilter:
    """The filter of displacements and slopes: Hermite cubics between neighbouring sensors (5.50)-(5.53).

    Args:
        modes: to be filtered, n_modes of them.
        positions: (n_sensors,) increasing, m; the integral runs from the first sensor to the last.
        mass_per_length: kg/m.

    Raises:
        ValueError: fewer than two sensors, or positions that do not increase.
    """
    x = _checked(positions, 2)
    unit, zero = np.eye(x.size), np.zeros((x.size, x.size))
    displacement, slope = (
        _weights(modes, as_profile(mass_per_length), x, CubicHermiteSpline(x, *values))
        for values in ((unit, zero), (zero, unit))
    )
    again = partial(_redesigned, hermite_filter, positions=x, mass_per_length=mass_per_length)
    return ModalFilter(x, displacement, slope, again)


def displacement_filter(
    modes: Modes, positions: ArrayLike, mass_per_length: ProfileLike, *, degree: int = 5
) -> ModalFilter:
    """The filter of displacements alone: a spline of odd degree through the sensors and the held ends.

    A held end without a sensor counts as a reading of zero.

    Args:
        modes, positions, mass_per_length: as for `hermite_filter`; one sensor is enough where an end is held.
        degree: of the spline; lowered where there are too few sensors.

    Raises:
        ValueError: fewer than two readings, or positions that do not increase.
    """
    x = _checked(positions, 1)
    held = [at for at, derivative in modes.essential if derivative == 0 and np.abs(x - at).min() > 1e-9 * modes.length]
    nodes = np.sort(np.r_[x, held])
    if nodes.size < 2:
        raise ValueError("a displacement filter needs at least two readings; add a sensor")
    degree = min(degree, nodes.size - 1)
    degree -= 1 - degree % 2
    splines = make_interp_spline(nodes, np.eye(nodes.size), k=degree)
    weights = _weights(modes, as_profile(mass_per_length), np.unique(np.r_[0.0, splines.t, modes.length]), splines)
    again = partial(_redesigned, displacement_filter, positions=x, mass_per_length=mass_per_length, degree=degree)
    return ModalFilter(x, weights[:, np.isin(nodes, x)], np.zeros((modes.n_modes, 0)), again)


def point_filter(modes: Modes, points: Sequence[str], filtered: Sequence[int]) -> ModalFilter:
    """The filter of displacements at named points: w of least strain energy through the readings.

    Minimise ½ Σ ω_k² η_k² over all modes k under Φ η = y, Φ (n_sensors, n_modes) the shapes at the sensors, and take
    q_r = η_r. This is the counterpart of a spline for a structure known at points alone. With as many sensors as modes
    or more it is the least-squares fit.

    Args:
        modes: all known modes, at named points.
        points: of the sensors.
        filtered: indices of the modes to be filtered, from 0.

    Raises:
        ValueError: two sensors at one point, fewer sensors than filtered modes, modes that the sensors cannot
            distinguish, or an index without a mode.
    """
    names, index = list(points), list(filtered)
    modes.select(index)  # refuses an index without a mode
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"two of the {len(names)} sensors are at point {twice}; move one")
    if len(names) < len(index):
        raise ValueError(
            f"a filter of {len(index)} modes at named points needs at least as many sensors; got {len(names)}: add"
            " sensors, or filter fewer modes"
        )
    shapes = modes.phi(names)
    _, singular_values, right = np.linalg.svd(shapes[:, index], full_matrices=False)
    if singular_values[-1] < INDISTINCT * singular_values[0]:
        mixed = [str(index[i] + 1) for i in np.flatnonzero(np.abs(right[-1]) > 0.5 * np.abs(right[-1]).max())]
        raise ValueError(
            f"the sensors at {', '.join(names)} cannot distinguish filtered mode(s) {', '.join(mixed)} from rest or"
            " from each other; move or add a sensor"
        )
    slowest = modes.omega[modes.omega > 0].min(initial=np.inf)
    compliance = 1.0 / np.maximum(modes.omega, RIGID * slowest if np.isfinite(slowest) else 1.0)
    weights: Floats = (compliance[:, None] * np.linalg.pinv(shapes * compliance))[index]
    again = partial(filter_of_mass, None, places=names)
    return ModalFilter(np.array(names, object), weights, np.zeros((len(index), 0)), again)


def _redesigned(
    design: Callable[..., ModalFilter], modes: Modes, filtered: Sequence[int], **settings: Any
) -> ModalFilter:
    """A filter by interpolation, redesigned for other modes, of which it needs the filtered ones alone."""
    return design(modes.select(list(filtered)), **settings)


def _weights(modes: Modes, mass: Profile, nodes: np.ndarray, splines: Callable[[ArrayLike, int], Floats]) -> Floats:
    """∫ m φ_r w dx with the terms of attached masses, (n_modes, n_readings), for w of a unit of each reading.

    Args:
        nodes: bounds of the pieces of the integral, m.
        splines: (x, derivative) → w and its derivatives (n_points, n_readings).
    """
    at, lengths = gauss_between(nodes, GAUSS_POINTS)
    weights: Floats = (modes.phi(at) * (mass(at) * lengths)[:, None]).T @ splines(at, 0)
    for part in modes.masses:
        for derivative, value in enumerate(part.pair):
            if value:
                x = position(part.at)
                weights = weights + value * np.outer(modes.phi(x, derivative), splines(x, derivative))
    return weights


def _checked(positions: ArrayLike, least: int) -> np.ndarray:
    x = np.asarray(positions, float)
    if x.ndim != 1 or x.size < least or not (np.diff(x) > 0).all():
        raise ValueError(f"at least {least} sensor positions, increasing, are needed; got {x}")
    return x


def surface_filter(modes: Modes, places: ArrayLike, mass_per_area: FieldLike) -> ModalFilter:
    """The filter of displacements at scattered places: q_r = ∫∫ m φ_r w dA, w a thin-plate spline through the readings.

    The spline has the least bending energy of all surfaces through the readings (Duchon 1977). Held edges count as
    readings of zero.

    Args:
        modes: to be filtered, n_modes of them, over a rectangle.
        places: (n_sensors, 2) m, all different.
        mass_per_area: kg/m², a number or a function of (x, y).

    Raises:
        ValueError: two sensors at one place, fewer of them than modes, or fewer readings than a surface needs.
    """
    domain = modes.domain
    if not isinstance(domain, Rectangle):
        raise ValueError(f"a filter by thin-plate splines is for a plate or a membrane; these modes are of {domain}")
    at = domain.locate(places)
    if len(np.unique(at, axis=0)) < len(at):
        raise ValueError(f"two of the {len(at)} sensors are at one place; move one")
    if len(at) < modes.n_modes:
        raise ValueError(
            f"a filter of {modes.n_modes} modes on a plate needs at least as many sensors; got {len(at)}: add sensors,"
            " or filter fewer modes"
        )
    nodes = np.vstack([at, _held(modes, domain, at)])
    if np.linalg.matrix_rank(np.column_stack([np.ones(len(nodes)), nodes / domain.length])) < READINGS:
        raise ValueError(
            f"a filter on a plate needs at least {READINGS} readings that are not on one line; got {len(nodes)}: add"
            " sensors"
        )
    points, weights = domain.quadrature(QUADRATURE)
    density = weights * as_field(mass_per_area)(points[:, 0], points[:, 1])
    splines = RBFInterpolator(nodes, np.eye(len(nodes)), kernel="thin_plate_spline", degree=1)
    filter_weights: Floats = (modes.phi(points) * density[:, None]).T @ splines(points)
    for part in modes.masses:
        filter_weights = filter_weights + part.mass * modes.phi(part.at).T @ splines(domain.locate(part.at))
    again = partial(filter_of_mass, mass_per_area, places=at)
    return ModalFilter(at, filter_weights[:, : len(at)], np.zeros((modes.n_modes, 0)), again)


def filter_on(
    structure: Structure | Plate | Membrane | None, modes: Modes, filtered: Sequence[int], places: ArrayLike
) -> ModalFilter:
    """The displacement filter that fits a structure, which may be None at named points: see `filter_of_mass`."""
    if isinstance(structure, Plate | Membrane):
        return filter_of_mass(structure.mass_per_area, modes, filtered, places)
    return filter_of_mass(None if structure is None else structure.mass_per_length, modes, filtered, places)


def filter_of_mass(
    mass: ProfileLike | FieldLike | None, modes: Modes, filtered: Sequence[int], places: ArrayLike
) -> ModalFilter:
    """The displacement filter along a structure, over it, or at its named points.

    Args:
        mass: kg/m along a structure, kg/m² over a surface; not needed at named points.
        modes: of the structure, all that are known.
        filtered: indices of the modes to be filtered, from 0.
        places: of the sensors, in any order.

    Raises:
        ValueError: no mass where it is needed, or sensors that make no filter.
    """
    if isinstance(modes.domain, NamedPoints):
        return point_filter(modes, [str(name) for name in np.ravel(np.asarray(places, object))], filtered)
    if mass is None:
        raise ValueError("a modal filter needs the mass of the structure between the sensors; describe the structure")
    own = modes.select(list(filtered))
    if isinstance(modes.domain, Rectangle):
        return surface_filter(own, places, cast(FieldLike, mass))
    return displacement_filter(own, np.sort(np.asarray(places, float)), cast(ProfileLike, mass))


def _held(modes: Modes, domain: Rectangle, at: np.ndarray) -> Floats:
    """Places along the held edges (n_places, 2) where no sensor stands, m."""
    (a, b), spacing = domain.length, max(domain.length) / PER_SIDE
    x, y = (np.linspace(0.0, side, max(round(side / spacing), 4) + 1) for side in (a, b))
    edges = [(each, edge) for edge in (0.0, b) for each in x] + [(edge, each) for edge in (0.0, a) for each in y[1:-1]]
    rim = np.array(edges)
    rim = rim[modes.are_held(rim)]
    distance = np.linalg.norm(rim[:, None] - at, axis=2).min(axis=1, initial=np.inf)
    return np.asarray(rim[distance > SAME * domain.size])
