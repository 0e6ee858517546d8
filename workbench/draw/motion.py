"""Motion as plain numbers, for a page to move: shapes along a structure, over a plate or of a frame, and over time."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import minimum_spanning_tree

from workbench.design.loop.closed_loop import Response
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.domain import ROTATIONS, TRANSLATIONS, Between, Domain, Interval, NamedPoints, Rectangle
from workbench.structure.modes import Modes, SampledModes

N_PLACES = 161
MOST_FRAMES = 600
SHOWN_SECONDS = 12.0
PER_SIDE = 19  # lines of a plate's net along the longer side
MOST_NODES = 400  # of a frame, that are drawn
ALONG = "x [m]"
SWAY = 0.15  # of the structure's size: the largest motion as drawn


def response_motion(
    responses: Mapping[str, Response],
    *,
    actuators: Sequence[Actuator] = (),
    sensors: Sequence[Sensor] = (),
    colours: Mapping[str, str] | None = None,
    length: str = "m",
) -> dict[str, Any]:
    """Responses of one structure, moving on one picture: over each other along a beam, side by side as nets.

    Args:
        responses: by the name under which each is shown; all over the same times and of the same modes' number.
        actuators, sensors: marked at their places.
        colours: of responses by name; None for the first of several in grey.
        length: the unit of x.

    Raises:
        ValueError: responses over different times, or at named points without positions.
    """
    first = next(iter(responses.values()))
    if any(r.time.shape != first.time.shape or (r.time != first.time).any() for r in responses.values()):
        raise ValueError("responses that move together must be over the same times; simulate them on one time axis")
    step = -(-first.time.size // MOST_FRAMES)
    tracks: list[dict[str, Any]] = [
        {
            "label": name,
            "modal": _numbers(response.modal[: response.modes.n_modes, ::step]),
            "colour": (colours or {}).get(name),
        }
        for name, response in responses.items()
    ]
    shown = {"kind": "response", "time": _numbers(first.time[::step]), "seconds": SHOWN_SECONDS, "tracks": tracks}
    if not isinstance(first.modes.domain, Interval):
        spots = _net(first.modes.domain)
        moves = [spots.moves(response.modes) for response in responses.values()]
        largest = max(
            float(np.abs(moved @ response.modal[: response.modes.n_modes, ::step]).max())
            for moved, response in zip(moves, responses.values(), strict=True)
        )
        for track, moved in zip(tracks, moves, strict=True):
            scaled = moved * SWAY * np.ptp(spots.rest, axis=0).max() / max(largest, 1e-300)
            track["moves"] = _numbers(np.moveaxis(scaled, 2, 0))
        return shown | _on_net(spots, actuators, sensors)
    x = np.linspace(0.0, first.modes.length, N_PLACES)
    for track, response in zip(tracks, responses.values(), strict=True):
        track["shapes"] = _numbers(response.modes.phi(x))
    return shown | {"x": _numbers(x), "label": f"x [{length}]", **_places(actuators, sensors)}


def mode_motion(
    modes: Mapping[str, Modes | SampledModes], *, actuators: Sequence[Actuator] = (), sensors: Sequence[Sensor] = ()
) -> dict[str, Any]:
    """Mode shapes in motion, one mode at a time; several sets of modes over each other, each scaled to one.

    Sampled modes are shown at their sensors, with the phase that each sensor has; on a plate neighbours are joined. A
    plate is a net of lines and a frame its nodes, neighbours joined, as both are seen from above the front; a plane
    frame from the front.

    Raises:
        ValueError: modes at named points without positions.
    """
    first = next(iter(modes.values()))
    if isinstance(first, SampledModes) and first.on_plate:
        return _net_motion(scattered_net(first.positions), modes, actuators, sensors)
    if isinstance(first, Modes) and not isinstance(first.domain, Interval):
        return _net_motion(_net(first.domain), modes, actuators, sensors)
    tracks: list[dict[str, Any]] = []
    for name, found in modes.items():
        if isinstance(found, SampledModes):
            x = found.positions if found.on_interval else np.arange(1.0, found.n_outputs + 1)
            shapes = found.shapes
        else:
            x = np.linspace(0.0, found.length, N_PLACES)
            shapes = found.phi(x).astype(complex)
        order = np.argsort(x)
        shapes = shapes[order] / np.maximum(np.abs(shapes).max(axis=0), 1e-300)
        # two sets of modes move together, whatever the sign of each
        if tracks and isinstance(found, Modes) and tracks[0]["x"] == _numbers(x):
            n = min(shapes.shape[1], len(tracks[0]["real"][0]))
            aligned = np.sign(np.sum(shapes[:, :n].real * np.array(tracks[0]["real"])[:, :n], axis=0))
            shapes[:, :n] *= np.where(aligned < 0, -1.0, 1.0)
        tracks.append(
            {
                "label": name,
                "x": _numbers(x[order]),
                "sampled": isinstance(found, SampledModes),
                "real": _numbers(shapes.real),
                "imaginary": _numbers(shapes.imag),
                "frequencies_hz": _numbers(found.frequencies_hz),
                "damping": _numbers(found.zeta),
            }
        )
    label = "sensor" if isinstance(first, SampledModes) and not first.on_interval else ALONG
    return {"kind": "modes", "x": tracks[0]["x"], "label": label, "tracks": tracks, **_places(actuators, sensors)}


def _net_motion(
    spots: "Net", modes: Mapping[str, Modes | SampledModes], actuators: Sequence[Actuator], sensors: Sequence[Sensor]
) -> dict[str, Any]:
    size = np.ptp(spots.rest, axis=0).max()
    tracks: list[dict[str, Any]] = []
    for name, found in modes.items():
        moves = spots.moves(found)
        moves = moves * SWAY * size / np.maximum(np.abs(moves).max(axis=(0, 1)), 1e-300)
        if tracks:  # two sets of modes move together, whatever the sign of each
            n = min(moves.shape[2], len(tracks[0]["moves"]))
            other = np.moveaxis(np.array(tracks[0]["moves"])[:n], 0, 2)
            moves[:, :, :n] *= np.where((moves[:, :, :n].real * other).sum(axis=(0, 1)) < 0, -1.0, 1.0)
        moves = np.moveaxis(moves, 2, 0)
        tracks.append(
            {
                "label": name,
                "moves": _numbers(moves.real),
                **({"imaginary": _numbers(moves.imag)} if np.iscomplexobj(moves) else {}),
                "frequencies_hz": _numbers(found.frequencies_hz),
                "damping": _numbers(found.zeta),
            }
        )
    return {"kind": "modes", "tracks": tracks, **_on_net(spots, actuators, sensors)}


def _on_net(spots: "Net", actuators: Sequence[Actuator], sensors: Sequence[Sensor]) -> dict[str, Any]:
    """A net at rest, and the places marked on it."""
    marked = {
        key: [
            {"name": part.name, "at": _numbers(spots.at(part.at))} for part in parts if not isinstance(part.at, Between)
        ]
        for key, parts in (("actuators", actuators), ("sensors", sensors))
    }
    return {"net": {"rest": _numbers(spots.rest), "lines": spots.lines}, **marked}


@dataclass(frozen=True, eq=False)
class Net:
    """Spots of a structure as a page shows them.

    Attributes:
        rest: (n_spots, 2) at rest, m, as they are seen.
        lines: pairs of spots that are joined.
        moves: modes -> (n_spots, 2, n_modes) displacements as they are seen, complex where sensors differ in phase.
        at: place -> (2,) where it, or the middle of a patch, is seen.
    """

    rest: np.ndarray
    lines: list[list[int]]
    moves: Callable[[Any], np.ndarray]
    at: Callable[[Any], np.ndarray]


def _seen(at: np.ndarray) -> np.ndarray:
    """(..., 3) as (..., 2): x to the right, z up, y away from the eye."""
    return np.asarray(np.stack([at[..., 0] + 0.4 * at[..., 1], at[..., 2] + 0.45 * at[..., 1]], axis=-1))


def _upwards(shapes: np.ndarray) -> np.ndarray:
    """(n_spots, 2, n_modes) of displacements (n_spots, n_modes) that are seen as upwards."""
    return np.stack([np.zeros_like(shapes), shapes], axis=1)


def _net(domain: Domain) -> Net:
    return _plate_net(domain) if isinstance(domain, Rectangle) else frame_net(domain)


def _plate_net(domain: Rectangle) -> Net:
    sides = domain.length
    n, m = (max(round(PER_SIDE * side / max(sides)), 6) for side in sides)
    x, y = (np.linspace(0.0, side, count) for side, count in zip(sides, (n, m), strict=True))
    places = np.column_stack([np.repeat(x, m), np.tile(y, n)])
    lines = [[i * m + j, i * m + j + 1] for i in range(n) for j in range(m - 1)]
    lines += [[i * m + j, i * m + j + m] for i in range(n - 1) for j in range(m)]
    flat = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

    return Net(
        _seen(places @ flat),
        lines,
        lambda modes: _upwards(modes.phi(places)),
        lambda place: _seen(np.asarray(place)[:2] @ flat),
    )


def scattered_net(places: np.ndarray) -> Net:
    """Sensors on a plate, at places (n_sensors, 2), neighbours joined; what they read moves up, each with its phase."""
    at = np.column_stack([places, np.zeros(len(places))])
    return Net(_seen(at), _neighbours(at), lambda modes: _upwards(modes.shapes), lambda place: _seen(np.r_[place, 0.0]))


def frame_net(domain: Domain) -> Net:
    """A frame as its nodes, neighbours joined, seen from above the front; a plane one from the front.

    Raises:
        ValueError: named points without positions.
    """
    if not isinstance(domain, NamedPoints) or domain.positions is None:
        raise ValueError("shapes at named points are drawn where their positions are known; give positions")
    names = list(dict.fromkeys(domain.nodes))
    names = names[:: -(-len(names) // MOST_NODES)]
    nodes = {node: i for i, node in enumerate(names)}
    first = {node: i for i, node in reversed(list(enumerate(domain.nodes)))}
    at = domain.positions[[first[node] for node in names]]
    planar = np.ptp(at[:, 2]) == 0 and "z" not in domain.directions
    see = (lambda at: at[..., :2]) if planar else _seen

    def moves(modes: Modes) -> np.ndarray:
        shapes = modes.phi(list(domain.names))
        found = np.zeros((len(nodes), modes.n_modes, 3))
        for node, direction, shape in zip(domain.nodes, domain.directions, shapes, strict=True):
            if node in nodes and direction not in ROTATIONS:  # of what moves in no known direction, up
                found[nodes[node], :, TRANSLATIONS.index(direction) if direction else 1 if planar else 2] = shape
        return np.moveaxis(see(found), 2, 1)

    def spot(place: Any) -> np.ndarray:
        index = domain.nodes.index(place) if place in domain.nodes else domain.locate(place)[0]
        return see(np.asarray(domain.positions)[index])

    return Net(see(at), _neighbours(at), moves, spot)


def _neighbours(at: np.ndarray) -> list[list[int]]:
    """Pairs of points that no other point is nearer to both of (the relative neighbourhood graph; Toussaint 1980).

    None is twice as far apart as what joins all points takes: the feet of a portal are not joined.
    """
    distance = np.linalg.norm(at[:, None] - at, axis=2)
    longest = 2.0 * minimum_spanning_tree(distance).max()
    pairs = []
    for i in range(len(at)):
        between = (np.maximum(distance[i], distance) < distance[i][:, None] * (1.0 - 1e-9)).any(axis=1)
        pairs += [[i, int(j)] for j in np.flatnonzero(~between & (distance[i] < longest)) if j > i]
    return pairs


def _places(actuators: Sequence[Actuator], sensors: Sequence[Sensor]) -> dict[str, Any]:
    return {
        "actuators": [{"name": a.name, "at": float(cast(float, a.at))} for a in actuators],
        "sensors": [{"name": s.name, "at": float(cast(float, s.at))} for s in sensors],
    }


def _numbers(values: ArrayLike) -> list[Any]:
    values = np.asarray(values, float)
    if values.ndim > 1:
        return [_numbers(row) for row in values]
    return [float(f"{v:.5g}") for v in values]
