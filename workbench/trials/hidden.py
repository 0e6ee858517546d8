"""Hidden effects: changes of a plant by the effects of a label."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.structure.domain import Between, centred_at
from workbench.trials.laws import POINT_LAWS, PointLaw
from workbench.trials.plant import Plant

NONE, UNKNOWN = "none", "unknown"  # kinds of a label: no hidden effect, or one outside every catalogue
Hide = Callable[[Plant, dict[str, Any]], Plant]


def place_of(effect: dict[str, Any]) -> Any:
    """The place of an effect of a label: `Between` two points, a place, or None."""
    if "between" in effect:
        return Between(*effect["between"])
    at = effect.get("at")
    return tuple(at) if isinstance(at, list) else at


def _altered(plant: Plant, **changes: Any) -> Plant:
    return replace(plant, altered=replace(plant.altered, **changes))


def _law(law: PointLaw, plant: Plant, e: dict[str, Any]) -> Plant:
    return replace(plant, laws=(*plant.laws, (law.code, place_of(e), tuple(e[name] for name in law.parameters))))


def _with_transducers(plant: Plant, side: str, name: str, **changes: Any) -> Plant:
    """The plant with one actuator or sensor changed, or all of them (except hammers) for the name "all"."""
    transducers: Any = tuple(
        replace(t, **changes) if t.name == name or (name == "all" and not getattr(t, "direct", False)) else t
        for t in getattr(plant, side)
    )
    return replace(plant, **{side: transducers})


def _transducer(side: str, key: str, **fields: str) -> Hide:
    """A change of fields of an actuator or sensor, each to the parameter of this name."""
    return lambda plant, e: _with_transducers(plant, side, e[key], **{f: e[name] for f, name in fields.items()})


_actuator, _sensor = partial(_transducer, "actuators", "input"), partial(_transducer, "sensors", "output")


def _support(plant: Plant, e: dict[str, Any]) -> Plant:
    left, right = plant.altered.rotational_stiffness
    ends = (e["rotational_stiffness"], right) if e["at"] == 0 else (left, e["rotational_stiffness"])
    return _altered(plant, rotational_stiffness=ends)


def _moved(side: str, key: str, plant: Plant, e: dict[str, Any]) -> Plant:
    """The plant with one actuator or sensor moved; a patch keeps its size."""
    (stood,) = (transducer.at for transducer in getattr(plant, side) if transducer.name == e[key])
    return _with_transducers(plant, side, e[key], at=centred_at(stood, place_of(e)))


def _swapped(side: str, key: str, plant: Plant, e: dict[str, Any]) -> Plant:
    """The plant with the cables of two actuators or sensors swapped; a channel keeps its name, noise and rounding."""
    by_name = {transducer.name: transducer for transducer in getattr(plant, side)}
    pair = {e[key]: by_name[e["with"]], e["with"]: by_name[e[key]]}
    kept = ("name", "noise_std", "step") if side == "sensors" else ("name",)
    transducers: Any = tuple(
        replace(pair[name], **{field: getattr(transducer, field) for field in kept}) if name in pair else transducer
        for name, transducer in by_name.items()
    )
    return replace(plant, **{side: transducers})


def _actuator_crosstalk(plant: Plant, e: dict[str, Any]) -> Plant:
    names = [a.name for a in plant.actuators]
    mix = np.eye(len(names))
    mix[names.index(e["input"]), names.index(e["from"])] = e["share"]
    return replace(plant, mix=mix)


def _bent_command(plant: Plant, e: dict[str, Any]) -> Plant:
    acting = np.array([not a.direct for a in plant.actuators], float)
    return replace(plant, curvature=e["curvature"] * acting)


def _reading(law: Callable[[dict[str, Floats], float, dict[str, Any]], Floats]) -> Hide:
    """An addition to the readings of a sensor: (readings by sensor, sample time, effect) -> (n_samples,)."""

    def hide(plant: Plant, e: dict[str, Any]) -> Plant:
        names = [sensor.name for sensor in plant.sensors]

        def read(y: np.ndarray, sample_time: float) -> np.ndarray:
            y = y.copy()
            y[names.index(e["output"])] += law(dict(zip(names, y, strict=True)), sample_time, e)
            return y

        return replace(plant, reading_laws=(*plant.reading_laws, read))

    return hide


def _hum(y: dict[str, Floats], sample_time: float, e: dict[str, Any]) -> Floats:
    wave: Floats = np.sin(2.0 * np.pi * e["frequency"] * sample_time * np.arange(y[e["output"]].size))
    return float(e["amplitude"]) * wave


def _spikes(y: dict[str, Floats], sample_time: float, e: dict[str, Any]) -> Floats:
    spikes = np.zeros_like(y[e["output"]])
    spikes[e["every"] // 2 :: e["every"]] = e["amplitude"]
    return spikes


HIDE: dict[str, Hide] = {
    "modulus_error": lambda p, e: _altered(p, stiffness_factor=p.altered.stiffness_factor * e["factor"]),
    "point_mass": lambda p, e: _altered(p, masses=(*p.altered.masses, (place_of(e), e["mass"]))),
    "local_stiffness_loss": lambda p, e: _altered(p, losses=(*p.altered.losses, (e["at"], e["width"], e["loss"]))),
    "support_rotation": _support,
    "axial_load": lambda p, e: _altered(p, tension=e["tension"]),
    "ground_spring": lambda p, e: _altered(p, springs=(*p.altered.springs, (place_of(e), e["stiffness"]))),
    "truncated_modes": lambda p, e: replace(p, n_modes=e["needed"]),
    "modal_damping": lambda p, e: replace(p, damping_factor=p.damping_factor * e["factor"]),
    **{name: partial(_law, law) for name, law in POINT_LAWS.items() if not law.outside},
    "air_drag": lambda p, e: replace(p, drag=e["coefficient"]),
    "midplane_stretching": lambda p, e: replace(p, stretching=e["coefficient"]),
    "actuator_gain": _actuator(gain="gain"),
    "actuator_lag": _actuator(time_constant="time_constant"),
    "actuator_delay": _actuator(delay="delay"),
    "actuator_saturation": _actuator(limit="limit"),
    "actuator_dead_zone": _actuator(dead_zone="width"),
    "actuator_misplacement": partial(_moved, "actuators", "input"),
    "actuator_hysteresis": _actuator(hysteresis_share="share", hysteresis_width="width"),
    "actuator_bias": _actuator(bias="force"),
    "actuator_rate_limit": _actuator(rate_limit="rate"),
    "swapped_inputs": partial(_swapped, "actuators", "input"),
    "sensor_gain": _sensor(gain="gain"),
    "sensor_bias": _sensor(bias="bias"),
    "sensor_drift": _sensor(drift="drift_over_record"),
    "sensor_lag": _sensor(time_constant="time_constant"),
    "sensor_misplacement": partial(_moved, "sensors", "output"),
    "sensor_delay": _sensor(delay="delay"),
    "sensor_crosstalk": lambda p, e: replace(p, crosstalk=(*p.crosstalk, (e["output"], e["from"], e["share"]))),
    "swapped_outputs": partial(_swapped, "sensors", "output"),
    "sensor_clipping": _sensor(limit="limit"),
    "sensor_quantisation": _sensor(step="step"),
    "periodic_disturbance": lambda p, e: replace(
        p, tones=(*p.tones, (place_of(e), e["amplitude"], e["frequency"], e["phase"]))
    ),
    "random_disturbance": lambda p, e: replace(p, noises=(*p.noises, (place_of(e), e["rms"], e["corner"]))),
    "stiffness_drift": lambda p, e: replace(p, stiffness_rate=e["rate"]),
    "actuator_crosstalk": _actuator_crosstalk,
}

# Kinds outside every catalogue of the diagnosis: the right verdict on them is "unknown".
OUTSIDE: dict[str, Hide] = {
    **{name: partial(_law, law) for name, law in POINT_LAWS.items() if law.outside},
    "bent_command": _bent_command,
    "bent_reading": _reading(lambda y, sample_time, e: e["curvature"] * y[e["output"]] ** 2),
    "hum": _reading(_hum),
    "spikes": _reading(_spikes),
}


def hide(plant: Plant, effects: list[dict[str, Any]]) -> Plant:
    """The plant with these effects of the case format (inputs and outputs by name)."""
    for effect in effects:
        plant = (HIDE | OUTSIDE)[effect["kind"]](plant, effect)
    return plant
