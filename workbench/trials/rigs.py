"""Random nominal rigs of blind trials: beams and rods, plates, and frames known at named points."""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints, Place
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.member import Bar, Beam, Structure
from workbench.structure.modes import Modes, PointShapes
from workbench.structure.plate import Plate
from workbench.trials.finite_elements import Frame
from workbench.trials.plane_frame import Section, plane_frame

MEMBERS, PLATES, FRAMES = STRUCTURES = ("members", "plates", "frames")
SPACING = 0.13  # least distance between inputs and outputs of a plate, over the diagonal
MARGIN = 0.08  # least distance from the edges, over the side
STEEL = {"youngs_modulus": 2.1e11, "density": 7850.0}  # Pa, kg/m³
PARTS = 6  # elements of a column or a floor; every other node is a named point


def draw_rig(rng: np.random.Generator, structure: str) -> tuple[Rig, Frame | None]:
    """A random nominal rig with noise-free sensors, and for a frame the function of its matrices."""
    if structure not in STRUCTURES:
        raise ValueError(f"trials are made on {', '.join(STRUCTURES)}; got {structure!r}")
    if structure == FRAMES:
        return _frame(rng)
    return _member(rng) if structure == MEMBERS else _plate(rng), None


def _inputs(places: Sequence[Place], hammer: Place) -> tuple[Actuator, ...]:
    actuators = [Actuator(f"F{i + 1}", at) for i, at in enumerate(places)]
    return (*actuators, Actuator("hammer", hammer, direct=True))


def _accelerometers_first(places: Sequence[Place], n: int) -> tuple[Sensor, ...]:
    """n accelerometers a1, a2, ..., then velocity sensors with the next numbers."""
    return tuple(
        Sensor(f"a{i + 1}", at, "acceleration") if i < n else Sensor(f"v{i + 1}", at, "velocity")
        for i, at in enumerate(places)
    )


# --- beams and rods


def _member(rng: np.random.Generator) -> Rig:
    draw = (_long_beam, _tapered_beam, _ruler, _tapered_rod)[rng.integers(4)]
    structure, sensors = draw(rng)
    length = structure.length
    n = int(rng.integers(2, 5))
    places = np.round((np.arange(1, n + 1) + rng.uniform(-0.3, 0.3, n)) * length / (n + 1), 3)
    strike = float(places[0])  # until another place is drawn
    while np.abs(places - strike).min() < 0.03 * length:
        strike = round(float(rng.uniform(0.35, 0.9)) * length, 3)
    modes = structure.modes(int(rng.integers(12, 17)), tolerance=1e-9)
    return Rig(modes, _inputs(places.tolist(), strike), sensors, structure=structure)


def _sensors(places: np.ndarray, quantities: str) -> tuple[Sensor, ...]:
    """Sensors d1, d2, ..., v1, ..., one at each place; the letters of `quantities` are their quantities."""
    words = {"d": "displacement", "v": "velocity", "a": "acceleration"}
    return tuple(
        Sensor(f"{q}{quantities[: i + 1].count(q)}", round(float(x), 4), words[q])
        for i, (x, q) in enumerate(zip(places, quantities, strict=True))
    )


def _around(value: float, rng: np.random.Generator) -> float:
    return round(value * float(rng.uniform(0.7, 1.3)), 2)


def _damping(rng: np.random.Generator) -> ModalDamping:
    return ModalDamping(round(float(rng.uniform(0.003, 0.01)), 4))


def _long_beam(rng: np.random.Generator) -> tuple[Structure, tuple[Sensor, ...]]:
    n = int(rng.integers(4, 7))
    places = np.tile(np.arange(1, n + 1) * 10.0 / (n + 1), 2)
    beam = Beam(
        length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged", damping=_damping(rng)
    )
    return beam, _sensors(places, "d" * n + "v" * n)


def _tapered_beam(rng: np.random.Generator) -> tuple[Structure, tuple[Sensor, ...]]:
    n = int(rng.integers(5, 9))
    ends = (["clamped", "hinged"], ["clamped", "clamped"], ["hinged", "clamped"])[rng.integers(3)]
    beam = Beam(
        length=10.0,
        mass_per_length=([0.0, 10.0], [_around(1.5, rng), _around(0.75, rng)]),
        bending_stiffness=([0.0, 10.0], [_around(2.0, rng), _around(0.75, rng)]),
        left=ends[0],
        right=ends[1],
        damping=_damping(rng),
    )
    return beam, _sensors(np.arange(1, n + 1) * 10.0 / (n + 1), "d" * (n // 2) + "v" * (n - n // 2))


def _ruler(rng: np.random.Generator) -> tuple[Structure, tuple[Sensor, ...]]:
    n = int(rng.integers(4, 7))
    beam = Beam(
        length=0.8,
        mass_per_length=round(float(rng.uniform(0.2, 0.6)), 3),
        bending_stiffness=round(float(rng.uniform(5.0, 20.0)), 2),
        left="clamped",
        right="free",
        damping=_damping(rng),
    )
    places = np.r_[np.arange(1, n + 1) * 0.8 / n, 0.8]
    return beam, _sensors(places, "a" * n + "v")


def _tapered_rod(rng: np.random.Generator) -> tuple[Structure, tuple[Sensor, ...]]:
    n = int(rng.integers(5, 8))
    end = round(float(rng.choice([0.0, 0.5, 1.0])), 1)
    rod = Bar(
        length=1.0,
        mass_per_length=([0.0, 1.0], [2.0, end]),
        axial_stiffness=([0.0, 1.0], [2.0, end]),
        left="fixed",
        right="free",
        damping=_damping(rng),
    )
    return rod, _sensors(np.arange(1, n + 1) / n, "d" * n)


# --- plates

EDGES = (
    {"left": "simply supported", "right": "simply supported", "bottom": "simply supported", "top": "simply supported"},
    {"left": "clamped", "right": "clamped", "bottom": "clamped", "top": "clamped"},
    {"left": "clamped", "right": "simply supported", "bottom": "simply supported", "top": "clamped"},
    {"left": "simply supported", "right": "simply supported", "bottom": "free", "top": "free"},
    {"left": "clamped", "right": "free", "bottom": "free", "top": "free"},
)


def _plate(rng: np.random.Generator) -> Rig:
    a = round(float(rng.uniform(0.9, 1.4)), 2)
    length = (a, round(float(rng.uniform(0.6, 0.9)) * a, 2))
    plate = Plate(
        length=length,
        edges=EDGES[max(int(rng.integers(-3, len(EDGES))), 0)],  # half of them simply supported on all edges
        mass_per_area=round(float(rng.uniform(5.0, 12.0)), 2),
        bending_stiffness=round(float(rng.uniform(80.0, 300.0)), 1),
        poisson_ratio=round(float(rng.uniform(0.28, 0.34)), 2),
        damping=_damping(rng),
    )
    n_actuators, n_sensors = int(rng.integers(2, 4)), int(rng.integers(6, 9))
    places = _scattered(rng, length, n_actuators + 1 + n_sensors)
    *driven, hammer = places[: n_actuators + 1]
    sensors = _accelerometers_first(places[n_actuators + 1 :], (n_sensors + 1) // 2)
    return Rig(plate.modes(int(rng.integers(14, 17))), _inputs(driven, hammer), sensors, structure=plate)


def _scattered(rng: np.random.Generator, length: tuple[float, float], n: int) -> list[tuple[float, float]]:
    """n random places on a rectangle, with a least distance between them and from the edges."""
    places: list[tuple[float, float]] = []
    while len(places) < n:
        x, y = np.round(rng.uniform(MARGIN, 1.0 - MARGIN, 2) * length, 3).tolist()
        if all(np.hypot(x - p, y - q) > SPACING * np.hypot(*length) for p, q in places):
            places.append((x, y))
    return places


# --- frames


def _frame(rng: np.random.Generator) -> tuple[Rig, Frame]:
    """A portal frame of two or three storeys, clamped at its feet."""
    storeys = int(rng.integers(2, 4))
    width, height = (round(float(x), 2) for x in rng.uniform(0.3, 0.5, 2))
    column = Section.of_strip(0.03, float(rng.uniform(0.003, 0.005)), **STEEL)
    floor = Section.of_strip(0.03, float(rng.uniform(0.005, 0.008)), **STEEL)
    nodes: dict[str, tuple[float, float]] = {"L0": (0.0, 0.0), "R0": (width, 0.0)}
    strips: list[tuple[str, str, Section]] = []
    shown = []
    for k in range(1, storeys + 1):
        for side, x in (("L", 0.0), ("R", width)):
            foot = f"{side}0" if k == 1 else f"{side}{k - 1}.{PARTS}"
            inner = [f"{side}{k}.{i}" for i in range(1, PARTS + 1)]
            nodes |= {node: (x, (k - 1 + (i + 1) / PARTS) * height) for i, node in enumerate(inner)}
            strips += [(*ends, column) for ends in pairwise([foot, *inner])]
            shown += inner[1::2]
        inner = [f"F{k}.{i}" for i in range(1, PARTS)]
        nodes |= {node: ((i + 1) / PARTS * width, k * height) for i, node in enumerate(inner)}
        strips += [(*ends, floor) for ends in pairwise([f"L{k}.{PARTS}", *inner, f"R{k}.{PARTS}"])]
        shown += inner[1::2]
    frame = partial(plane_frame, nodes, strips, fixed=("L0", "R0"), damping=_damping(rng))
    modes = _at_points(frame(), shown, int(rng.integers(14, 17)))
    across = [f"{node}.{'y' if node[0] == 'F' else 'x'}" for node in shown]
    n_actuators, n_sensors = int(rng.integers(2, 4)), int(rng.integers(7, 10))
    *driven, hammer = (str(name) for name in rng.choice(across, n_actuators + 1, replace=False))
    read = [str(name) for name in rng.choice(across, n_sensors, replace=False)]
    return Rig(modes, _inputs(driven, hammer), _accelerometers_first(read, n_sensors - 2)), frame


def _at_points(frame: FiniteElements, nodes: Sequence[str], n_modes: int) -> Modes:
    """Modes of a frame with shapes at some of its nodes only, along x and y."""
    every = frame.modes(n_modes)
    names = tuple(f"{node}.{direction}" for node in nodes for direction in "xy")
    positions = frame.nodes.positions
    assert positions is not None, "the nodes of a frame have positions"
    points = NamedPoints(
        names,
        positions[frame.nodes.locate(list(names))],
        ("x", "y") * len(nodes),
        tuple(node for node in nodes for _ in "xy"),
    )
    return Modes(omega=every.omega, damping=every.damping, shapes=PointShapes(every.phi(list(names))), domain=points)
