"""A plane frame of beam elements, as matrices."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Floats
from workbench.structure.damping import Damping
from workbench.structure.domain import NamedPoints
from workbench.structure.finite_elements import FiniteElements
from workbench.trials.finite_elements import waves

DIRECTIONS = ("x", "y", "rz")


@dataclass(frozen=True)
class Section:
    """The cross-section of a strip: axial stiffness EA (N), bending stiffness EI (N m²), mass per length (kg/m)."""

    axial: float
    bending: float
    mass: float

    @classmethod
    def of_strip(cls, width: float, thickness: float, *, youngs_modulus: float, density: float) -> "Section":
        """A rectangular section; lengths in m, modulus in Pa, density in kg/m³."""
        area = width * thickness
        return cls(youngs_modulus * area, youngs_modulus * area * thickness**2 / 12, density * area)


def plane_frame(
    nodes: Mapping[str, tuple[float, float]],
    strips: Iterable[tuple[str, str, Section]],
    *,
    fixed: Collection[str],
    damping: Damping,
    stiffness_waves: Sequence[float] = (),
    mass_waves: Sequence[float] = (),
) -> FiniteElements:
    """The matrices of a frame in the plane (x, y), each strip one beam element; node N has points N.x, N.y and N.rz.

    Args:
        nodes: (x, y) of each, m.
        strips: the two nodes of each, and its section.
        fixed: nodes clamped to the ground; they have no points.
        stiffness_waves, mass_waves: of a smooth variation over the height, see `waves`.
    """
    upright = any(y for _, y in nodes.values())  # a flat structure varies along its length
    along = {node: place[upright] for node, place in nodes.items()}
    size = max(along.values())
    free = [node for node in nodes if node not in fixed]
    index = {node: 3 * i for i, node in enumerate([*free, *fixed])}
    mass, stiffness = np.zeros((2, 3 * len(index), 3 * len(index)))
    for one, other, section in strips:
        rows = np.r_[index[one] + np.arange(3), index[other] + np.arange(3)]
        m, k = beam_element(np.array(nodes[one]), np.array(nodes[other]), section)
        middle = np.array(0.5 * (along[one] + along[other]) / size)
        mass[np.ix_(rows, rows)] += waves(mass_waves, middle) * m
        stiffness[np.ix_(rows, rows)] += waves(stiffness_waves, middle) * k
    n = 3 * len(free)
    points = NamedPoints(
        tuple(f"{node}.{direction}" for node in free for direction in DIRECTIONS),
        np.repeat([(*nodes[node], 0.0) for node in free], 3, axis=0),
        DIRECTIONS * len(free),
        tuple(node for node in free for _ in DIRECTIONS),
    )
    return FiniteElements(mass[:n, :n], stiffness[:n, :n], nodes=points, damping=damping)


def beam_element(one: Floats, other: Floats, section: Section) -> tuple[Floats, Floats]:
    """Consistent mass and stiffness (6, 6) between two nodes (2,), m; Przemieniecki (1968), sections 5.6 and 11.3."""
    along = other - one
    n = float(np.linalg.norm(along))
    c, s = along / n
    turn = np.kron(np.eye(2), [[c, s, 0], [-s, c, 0], [0, 0, 1]])
    k, m = np.zeros((6, 6)), np.zeros((6, 6))
    axial, bent = np.ix_([0, 3], [0, 3]), np.ix_([1, 2, 4, 5], [1, 2, 4, 5])
    k[axial] = section.axial / n * np.array([[1, -1], [-1, 1]])
    upper = [[12, 6 * n, -12, 6 * n], [6 * n, 4 * n**2, -6 * n, 2 * n**2]]
    lower = [[-12, -6 * n, 12, -6 * n], [6 * n, 2 * n**2, -6 * n, 4 * n**2]]
    k[bent] = section.bending / n**3 * np.array(upper + lower)
    m[axial] = section.mass * n / 6 * np.array([[2, 1], [1, 2]])
    upper = [[156, 22 * n, 54, -13 * n], [22 * n, 4 * n**2, 13 * n, -3 * n**2]]
    lower = [[54, 13 * n, 156, -22 * n], [-13 * n, -3 * n**2, -22 * n, 4 * n**2]]
    m[bent] = section.mass * n / 420 * np.array(upper + lower)
    return turn.T @ m @ turn, turn.T @ k @ turn
