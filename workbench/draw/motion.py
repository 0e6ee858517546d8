"""Motion as plain numbers, for a page to move: shapes along the structure and modal coordinates over time."""

from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np

from workbench.design.loop.closed_loop import Response
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.modes import Modes, SampledModes

N_PLACES = 161
MOST_FRAMES = 600
SHOWN_SECONDS = 12.0


def response_motion(
    responses: Mapping[str, Response], *, actuators: Sequence[Actuator] = (), sensors: Sequence[Sensor] = ()
) -> dict:
    """Responses of one structure, moving on one picture.

    Args:
        responses: by the name under which each is shown; all over the same times and of the same modes' number.
        actuators, sensors: marked at their places.

    Raises:
        ValueError: responses over different times.
    """
    first = next(iter(responses.values()))
    if any(r.time.shape != first.time.shape or (r.time != first.time).any() for r in responses.values()):
        raise ValueError("responses that move together must be over the same times; simulate them on one time axis")
    step = -(-first.time.size // MOST_FRAMES)
    x = np.linspace(0.0, first.modes.length, N_PLACES)
    tracks = [
        {
            "label": name,
            "shapes": _numbers(response.modes.phi(x)),
            "modal": _numbers(response.modal[: response.modes.n_modes, ::step]),
        }
        for name, response in responses.items()
    ]
    return {
        "kind": "response",
        "x": _numbers(x),
        "time": _numbers(first.time[::step]),
        "seconds": SHOWN_SECONDS,
        "tracks": tracks,
        **_places(actuators, sensors),
    }


def mode_motion(
    modes: Mapping[str, Modes | SampledModes],
    *,
    actuators: Sequence[Actuator] = (),
    sensors: Sequence[Sensor] = (),
) -> dict:
    """Mode shapes in motion, one mode at a time; several sets of modes over each other, each scaled to one.

    Sampled modes are shown at their sensors, with the phase that each sensor has.
    """
    tracks: list[dict] = []
    for name, found in modes.items():
        if isinstance(found, SampledModes):
            placed = np.isfinite(found.positions).all()
            x = found.positions if placed else np.arange(1.0, found.positions.size + 1)
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
    return {"kind": "modes", "x": tracks[0]["x"], "tracks": tracks, **_places(actuators, sensors)}


def _places(actuators: Sequence[Actuator], sensors: Sequence[Sensor]) -> dict:
    return {
        "actuators": [{"name": a.name, "at": float(cast(float, a.at))} for a in actuators],
        "sensors": [{"name": s.name, "at": float(cast(float, s.at))} for s in sensors],
    }


def _numbers(values) -> list:
    values = np.asarray(values, float)
    if values.ndim > 1:
        return [_numbers(row) for row in values]
    return [float(f"{v:.5g}") for v in values]
