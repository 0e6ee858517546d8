"""Modal filters over a rectangle: thin-plate splines through sensors that stand anywhere on it."""

from collections.abc import Sequence
from functools import partial
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RBFInterpolator

from workbench.arrays import Floats
from workbench.design.estimation.modal_filter import ModalFilter, anew, displacement_filter, point_filter
from workbench.structure.domain import NamedPoints, Rectangle
from workbench.structure.member import Structure
from workbench.structure.modes import Modes
from workbench.structure.plate import Membrane, Plate
from workbench.structure.profile import FieldLike, ProfileLike, as_field

READINGS = 3  # not on one line: what a plane through them needs
PER_SIDE = 24  # readings of zero along a held edge of the longer side
SAME = 1e-6  # of the diagonal: nearer, a sensor stands at a place of the rim
QUADRATURE = 500  # modes that the rule would serve: the spline is rougher than they are at its sensors


def surface_filter(modes: Modes, places: ArrayLike, mass_per_area: FieldLike) -> ModalFilter:
    """The filter of displacements at scattered places: q_r = ∫∫ m φ_r w dA, w a thin-plate spline through the readings.

    The spline bends least of all surfaces through the readings (Duchon 1977). Along an edge that holds the displacement
    its zero is read too.

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
        raise ValueError(f"two of the {len(at)} sensors stand at one place; move one")
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
    spread: Floats = (modes.phi(points) * density[:, None]).T @ splines(points)[:, : len(at)]
    again = partial(anew, surface_filter, places=at, mass_per_area=mass_per_area)
    return ModalFilter(at, spread, np.zeros((modes.n_modes, 0)), again)


def filter_on(
    structure: Structure | Plate | Membrane | None, modes: Modes, filtered: Sequence[int], places: ArrayLike
) -> ModalFilter:
    """The filter of displacements of a structure's own kind: along it, over it, or at its named points.

    Args:
        structure: whose mass a filter along or over it needs; None at named points.
        modes: of the structure, all that are known.
        filtered: indices of the modes to be filtered, from 0.
        places: of the sensors, in any order.

    Raises:
        ValueError: no structure where one is needed, or sensors that make no filter.
    """
    mass: ProfileLike | FieldLike | None = None
    if isinstance(structure, Plate | Membrane):
        mass = structure.mass_per_area
    elif structure is not None:
        mass = structure.mass_per_length
    return filter_of_mass(mass, modes, filtered, places)


def filter_of_mass(
    mass: ProfileLike | FieldLike | None, modes: Modes, filtered: Sequence[int], places: ArrayLike
) -> ModalFilter:
    """The filter of displacements that `filter_on` gives, of modes whose mass is known and not the whole structure.

    Args:
        mass: kg/m along a structure, kg/m² over a surface; not needed at named points.
        modes, filtered, places: as in `filter_on`.

    Raises:
        ValueError: no mass where it is needed, or sensors that make no filter.
    """
    if isinstance(modes.domain, NamedPoints):
        return point_filter(modes, [str(name) for name in np.ravel(np.asarray(places, object))], filtered)
    if mass is None:
        raise ValueError("a modal filter needs the structure between the sensors, for its mass; describe it")
    own = modes.select(list(filtered))
    if isinstance(modes.domain, Rectangle):
        return surface_filter(own, places, cast(FieldLike, mass))
    return displacement_filter(own, np.sort(np.asarray(places, float)), cast(ProfileLike, mass))


def _held(modes: Modes, domain: Rectangle, at: np.ndarray) -> Floats:
    """Places along the rim (n_places, 2) that no mode moves and where no sensor stands, m."""
    (a, b), spacing = domain.length, max(domain.length) / PER_SIDE
    x, y = (np.linspace(0.0, side, max(round(side / spacing), 4) + 1) for side in (a, b))
    along = [(each, edge) for edge in (0.0, b) for each in x] + [(edge, each) for edge in (0.0, a) for each in y[1:-1]]
    rim = np.array(along)
    rim = rim[modes.are_still(rim)]
    distance = np.linalg.norm(rim[:, None] - at, axis=2).min(axis=1, initial=np.inf)
    apart: Floats = rim[distance > SAME * domain.size]
    return apart
