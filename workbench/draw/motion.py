"""Motion as plain numbers, from which a page draws an animation: mode shapes and responses of any structure."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import minimum_spanning_tree

from workbench.design.loop.closed_loop import Response
from workbench.draw.style import MODEL_COLOURS
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.domain import ROTATIONS, TRANSLATIONS, Between, Domain, Interval, NamedPoints, Rectangle
from workbench.structure.modes import Modes, SampledModes

N_PLACES = 161
MOST_FRAMES = 600
SHOWN_SECONDS = 12.0
PER_SIDE = 19  # grid lines of a plate along the longer side
MOST_NODES = 400  # drawn of a frame
ALONG = "x [m]"
SWAY = 0.15  # largest drawn motion, over the size of the structure


def response_motion(
    responses: Mapping[str, Response],
    *,
    actuators: Sequence[Actuator] = (),
    sensors: Sequence[Sensor] = (),
    colours: Mapping[str, str] | None = None,
    length: str = "m",
    time: str = "s",
) -> dict[str, Any]:
    """An animation of responses of one structure, superposed along a beam, side by side for plates and frames.

    Args:
        responses: by the displayed name; all with the same time axis and number of modes.
        colours: of responses by name; None for the first of several in grey.
        length, time: the units of x and of the time axis.

    Raises:
        ValueError: different time axes, or named points without positions.
    """
    first = next(iter(responses.values()))
    if not all(np.array_equal(r.time, first.time) for r in responses.values()):
        raise ValueError("responses in one animation must have the same time axis; simulate them with one")
    step = -(-first.time.size // MOST_FRAMES)
    modal = [response.modal[: response.modes.n_modes, ::step] for response in responses.values()]
    tracks: list[dict[str, Any]] = [
        {"label": name, "modal": _numbers(q), "colour": (colours or {}).get(name)}
        for name, q in zip(responses, modal, strict=True)
    ]
    instants = {"time": _numbers(first.time[::step]), "unit": time}
    shown = {"kind": "response", **instants, "seconds": SHOWN_SECONDS, "tracks": tracks}
    if isinstance(first.modes.domain, Interval):
        x = np.linspace(0.0, first.modes.length, N_PLACES)
        for track, response in zip(tracks, responses.values(), strict=True):
            track["shapes"] = _numbers(response.modes.phi(x))
        return shown | {"x": _numbers(x), "label": f"x [{length}]", **_marked(actuators, sensors, float)}
    wireframe = _wireframe(first.modes.domain)
    moves = [wireframe.moves(response.modes) for response in responses.values()]
    largest = max(float(np.abs(moved @ q).max()) for moved, q in zip(moves, modal, strict=True))
    for track, moved in zip(tracks, moves, strict=True):
        scaled = moved * SWAY * np.ptp(wireframe.rest, axis=0).max() / max(largest, 1e-300)
        track["moves"] = _numbers(np.moveaxis(scaled, 2, 0))
    return shown | _on_wireframe(wireframe, actuators, sensors)


def mode_motion(
    modes: Mapping[str, Modes | SampledModes],
    *,
    actuators: Sequence[Actuator] = (),
    sensors: Sequence[Sensor] = (),
    std: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    frequency: str = "Hz",
) -> dict[str, Any]:
    """An animation of mode shapes, one mode at a time; several sets of modes are superposed, each scaled to one.

    Sampled modes are shown at their sensors, with phase. A plate is drawn as a grid of lines, a frame or the sensors on
    a plate as nodes with lines between neighbours, in an oblique view; a plane frame is seen from the front.

    Args:
        modes: by the displayed name.
        std: standard errors (n_modes,) of the frequencies, Hz, and of the damping ratios of a set of modes; both are
            displayed to the second digit of their error.
        frequency: the unit of the frequencies.

    Raises:
        ValueError: modes at named points without positions.
    """
    first = next(iter(modes.values()))
    if isinstance(first, SampledModes) and first.on_plate:
        shown = _modes_on_wireframe(sensor_wireframe(first.positions), modes, actuators, sensors)
    elif isinstance(first, Modes) and not isinstance(first.domain, Interval):
        shown = _modes_on_wireframe(_wireframe(first.domain), modes, actuators, sensors)
    else:
        shown = _modes_along(modes, actuators, sensors)
    for track in shown["tracks"]:
        for key, errors in zip(("frequencies_hz", "damping"), (std or {}).get(track["label"], ()), strict=False):
            track[key] = [_to_error(*pair) for pair in zip(track[key], np.asarray(errors).tolist(), strict=True)]
    return shown | {"unit": frequency}


def _to_error(value: float, error: float) -> float:
    """A value to the second digit of its error."""
    return round(value, 1 - int(np.floor(np.log10(error)))) if 0.0 < error < np.inf else value


def _modes_along(
    modes: Mapping[str, Modes | SampledModes], actuators: Sequence[Actuator], sensors: Sequence[Sensor]
) -> dict[str, Any]:
    """Mode shapes along a line, or over the numbers of the sensors."""
    tracks: list[dict[str, Any]] = []
    for name, found in modes.items():
        if isinstance(found, SampledModes):
            x, shapes = found.positions if found.on_interval else np.arange(1.0, found.n_outputs + 1), found.shapes
        else:
            x = np.linspace(0.0, found.length, N_PLACES)
            shapes = found.phi(x).astype(complex)
        order = np.argsort(x)
        shapes = shapes[order] / np.maximum(np.abs(shapes).max(axis=0), 1e-300)
        if tracks and isinstance(found, Modes) and tracks[0]["x"] == _numbers(x):
            shapes = _aligned(shapes, np.array(tracks[0]["real"]))
        places = {"x": _numbers(x[order]), "sampled": isinstance(found, SampledModes)}
        tracks.append(_track(name, found, **places, real=_numbers(shapes.real), imaginary=_numbers(shapes.imag)))
    first = next(iter(modes.values()))
    label = "sensor" if isinstance(first, SampledModes) and not first.on_interval else ALONG
    along = {"kind": "modes", "x": tracks[0]["x"], "label": label, "tracks": tracks}
    return along | _marked(actuators, sensors, float)


def _modes_on_wireframe(
    wireframe: "Wireframe",
    modes: Mapping[str, Modes | SampledModes],
    actuators: Sequence[Actuator],
    sensors: Sequence[Sensor],
) -> dict[str, Any]:
    tracks: list[dict[str, Any]] = []
    for name, found in modes.items():
        moves = wireframe.moves(found)
        size = np.ptp(wireframe.rest, axis=0).max()
        moves = moves * SWAY * size / np.maximum(np.abs(moves).max(axis=(0, 1)), 1e-300)
        if tracks:
            moves = _aligned(moves, np.moveaxis(np.array(tracks[0]["moves"]), 0, 2))
        moves = np.moveaxis(moves, 2, 0)
        phase = {"imaginary": _numbers(moves.imag)} if np.iscomplexobj(moves) else {}
        tracks.append(_track(name, found, moves=_numbers(moves.real), **phase))
    return {"kind": "modes", "tracks": tracks, **_on_wireframe(wireframe, actuators, sensors)}


def _track(name: str, modes: Modes | SampledModes, **shapes: Any) -> dict[str, Any]:
    numbers = {"frequencies_hz": _numbers(modes.frequencies_hz), "damping": _numbers(modes.zeta)}
    return {"label": name, "colour": MODEL_COLOURS.get(name), **shapes, **numbers}


def _aligned(shapes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Shapes (..., n_modes), each with the sign that agrees with the other of its number, if there is one."""
    n = min(shapes.shape[-1], others.shape[-1])
    agreement = (shapes[..., :n].real * others[..., :n]).sum(axis=tuple(range(shapes.ndim - 1)))
    signs = np.ones(shapes.shape[-1])
    signs[:n] = np.where(agreement < 0, -1.0, 1.0)
    return shapes * signs


def _on_wireframe(wireframe: "Wireframe", actuators: Sequence[Actuator], sensors: Sequence[Sensor]) -> dict[str, Any]:
    """A wireframe at rest, and the places of actuators and sensors."""
    rest = {"net": {"rest": _numbers(wireframe.rest), "lines": wireframe.lines}}
    return rest | _marked(actuators, sensors, lambda place: _numbers(wireframe.at(place)))


def _marked(
    actuators: Sequence[Actuator], sensors: Sequence[Sensor], at: Callable[[Any], float | list[float]]
) -> dict[str, Any]:
    """Actuators and sensors by name, at their drawn places; those between two places are not drawn."""
    return {
        key: [{"name": part.name, "at": at(part.at)} for part in parts if not isinstance(part.at, Between)]
        for key, parts in (("actuators", actuators), ("sensors", sensors))
    }


@dataclass(frozen=True, eq=False)
class Wireframe:
    """Nodes of a structure in a plane projection.

    Attributes:
        rest: (n_nodes, 2) projected positions at rest, m.
        lines: pairs of nodes joined by a line.
        moves: modes -> (n_nodes, 2, n_modes) projected displacements, complex for sampled modes.
        at: place -> (2,) projected position of a place, or of the centre of a patch.
    """

    rest: np.ndarray
    lines: list[list[int]]
    moves: Callable[[Any], np.ndarray]
    at: Callable[[Any], np.ndarray]


def _projected(at: np.ndarray) -> np.ndarray:
    """Oblique projection of points (..., 3) to (..., 2): x to the right, z up, y away from the viewer."""
    return np.asarray(np.stack([at[..., 0] + 0.4 * at[..., 1], at[..., 2] + 0.45 * at[..., 1]], axis=-1))


def _wireframe(domain: Domain) -> Wireframe:
    return _plate_wireframe(domain) if isinstance(domain, Rectangle) else frame_wireframe(domain)


def _plate_wireframe(domain: Rectangle) -> Wireframe:
    sides = domain.length
    n, m = (max(round(PER_SIDE * side / max(sides)), 6) for side in sides)
    x, y = (np.linspace(0.0, side, count) for side, count in zip(sides, (n, m), strict=True))
    places = np.column_stack([np.repeat(x, m), np.tile(y, n)])
    lines = [[i * m + j, i * m + j + 1] for i in range(n) for j in range(m - 1)]
    lines += [[i * m + j, i * m + j + m] for i in range(n - 1) for j in range(m)]
    return _flat_wireframe(places, lines, lambda modes: modes.phi(places))


def sensor_wireframe(places: np.ndarray) -> Wireframe:
    """The wireframe of sensors on a plate, at places (n_sensors, 2), neighbours joined; readings are drawn upwards."""
    return _flat_wireframe(places, _neighbours(places), lambda modes: modes.shapes)


def _flat_wireframe(places: np.ndarray, lines: list[list[int]], shapes: Callable[[Any], np.ndarray]) -> Wireframe:
    """The wireframe of places (n_nodes, 2) in the plane z = 0, whose transverse shapes are drawn upwards."""

    def upwards(modes: Modes | SampledModes) -> np.ndarray:
        transverse = shapes(modes)
        return np.stack([np.zeros_like(transverse), transverse], axis=1)

    def at(place: Any) -> np.ndarray:
        return _projected(np.r_[np.asarray(place)[:2], 0.0])

    return Wireframe(_projected(np.column_stack([places, np.zeros(len(places))])), lines, upwards, at)


def frame_wireframe(domain: Domain) -> Wireframe:
    """The wireframe of a frame, neighbouring nodes joined, in an oblique view; a plane frame is seen from the front.

    Raises:
        ValueError: named points without positions.
    """
    if not isinstance(domain, NamedPoints) or domain.positions is None:
        raise ValueError("shapes at named points cannot be drawn without positions; give positions")
    names = list(dict.fromkeys(domain.nodes))
    names = names[:: -(-len(names) // MOST_NODES)]
    nodes = {node: i for i, node in enumerate(names)}
    at = domain.positions[[domain.nodes.index(node) for node in names]]
    planar = np.ptp(at[:, 2]) == 0 and "z" not in domain.directions
    see = (lambda at: at[..., :2]) if planar else _projected

    def moves(modes: Modes) -> np.ndarray:
        shapes = modes.phi(list(domain.names))
        found = np.zeros((len(nodes), modes.n_modes, 3))
        for node, direction, shape in zip(domain.nodes, domain.directions, shapes, strict=True):
            if node in nodes and direction not in ROTATIONS:  # a motion of unknown direction is drawn upwards
                found[nodes[node], :, TRANSLATIONS.index(direction) if direction else 1 if planar else 2] = shape
        return np.moveaxis(see(found), 2, 1)

    def spot(place: Any) -> np.ndarray:
        index = domain.nodes.index(place) if place in domain.nodes else domain.locate(place)[0]
        return see(np.asarray(domain.positions)[index])

    return Wireframe(see(at), _neighbours(at), moves, spot)


def _neighbours(at: np.ndarray) -> list[list[int]]:
    """Pairs of neighbours: no third point is nearer to both (relative neighbourhood graph; Toussaint 1980).

    Pairs at twice the longest edge of the minimum spanning tree or more are excluded, such as the feet of a portal.
    """
    distance = np.linalg.norm(at[:, None] - at, axis=2)
    longest = 2.0 * minimum_spanning_tree(distance).max()
    pairs = []
    for i in range(len(at)):
        between = (np.maximum(distance[i], distance) < distance[i][:, None] * (1.0 - 1e-9)).any(axis=1)
        pairs += [[i, int(j)] for j in np.flatnonzero(~between & (distance[i] < longest)) if j > i]
    return pairs


def _numbers(values: ArrayLike) -> list[Any]:
    values = np.asarray(values, float)
    if values.ndim > 1:
        return [_numbers(row) for row in values]
    return [float(f"{v:.5g}") for v in values]
