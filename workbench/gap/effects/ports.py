"""Effects on the way in and on the way out: actuators and sensors."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from workbench.gap.effects.effect import ALL, Kind, Parameter, place_of, place_parameters, place_values
from workbench.records.record import QUANTITIES
from workbench.rig.rig import Rig
from workbench.structure.domain import Interval, NamedPoints

OF_THE_SENSOR = "unit of the sensor"

# --- targets and changes


def each_actuator(rig: Rig) -> tuple[str, ...]:
    """Names of the inputs that go through an actuator; a hammer does not."""
    return tuple(a.name for a in rig.actuators if not a.direct)


def actuators_or_all(rig: Rig) -> tuple[str, ...]:
    """Every actuator alone, and all of them together where there are several."""
    names = each_actuator(rig)
    return ((ALL, *names) if len(names) > 1 else names) if names else ()


def each_sensor(rig: Rig) -> tuple[str, ...]:
    return tuple(s.name for s in rig.sensors)


def sensors_or_all(rig: Rig) -> tuple[str, ...]:
    names = each_sensor(rig)
    return (ALL, *names) if len(names) > 1 else names


def _change_actuators(rig: Rig, target: str, **changes) -> Rig:
    changed = tuple(
        replace(a, **changes) if (a.name == target or (target == ALL and not a.direct)) else a for a in rig.actuators
    )
    return replace(rig, actuators=changed)


def _change_sensors(rig: Rig, target: str, **changes) -> Rig:
    return replace(rig, sensors=tuple(replace(s, **changes) if target in (s.name, ALL) else s for s in rig.sensors))


def _commands(evidence, target: str) -> np.ndarray:
    """All commands to the target that are not at rest, joined."""
    names = each_actuator(evidence.rig) if target == ALL else (target,)
    rows = [
        row
        for record in evidence.data.records
        for channel, row in zip(record.input_channels, record.inputs, strict=True)
        if channel.name in names
    ]
    values = np.abs(np.concatenate(rows))
    values = values[values > 0]
    return values if values.size else np.ones(1)


def _sample_time(evidence) -> float:
    return evidence.data.records[0].sample_time


def _actuator(
    name: str, field: str, unit: str, phrase: str, *, targets, starts, low, high, log=True, **options
) -> Kind:
    """A kind that sets one figure of an actuator."""
    attribute = {"gain": "gain", "time_constant": "time_constant", "delay": "delay", "limit": "limit"}.get(
        field, "dead_zone"
    )
    return Kind(
        name=name,
        path="actuator",
        parameters=lambda rig, _: (Parameter(field, unit, low, high, logarithmic=log, scale=0.1),),
        apply=lambda rig, target, v: _change_actuators(rig, target, **{attribute: v[field]}),
        starts=starts,
        targets=targets,
        phrase=phrase,
        **options,
    )


ACTUATOR_GAIN = _actuator(
    "actuator_gain",
    "gain",
    "",
    "a wrong actuator gain",
    targets=each_actuator,
    low=-20.0,
    high=20.0,
    log=False,
    starts=lambda evidence, _: [{"gain": 0.9}],
)

ACTUATOR_LAG = _actuator(
    "actuator_lag",
    "time_constant",
    "s",
    "a lag of the actuators",
    targets=actuators_or_all,
    low=1e-6,
    high=1e4,
    starts=lambda evidence, _: [{"time_constant": s * _sample_time(evidence)} for s in (0.1, 0.4, 1.2, 4.0, 12.0)],
)

ACTUATOR_DELAY = _actuator(
    "actuator_delay",
    "delay",
    "s",
    "a delay of the actuators",
    targets=actuators_or_all,
    low=1e-9,
    high=1e4,
    starts=lambda evidence, _: [
        {"delay": s * _sample_time(evidence)} for s in (0.1, 0.4, 0.8, 1.3, 1.8, 2.5, 3.5, 5.0, 8.0, 12.0)
    ],
)

ACTUATOR_SATURATION = _actuator(
    "actuator_saturation",
    "limit",
    "N",
    "saturation of the actuators",
    targets=actuators_or_all,
    low=1e-12,
    high=1e12,
    nonlinear=True,
    starts=lambda evidence, target: [
        {"limit": float(q)} for q in np.quantile(_commands(evidence, target), (0.5, 0.65, 0.8, 0.9, 0.96, 0.99))
    ],
)

ACTUATOR_DEAD_ZONE = _actuator(
    "actuator_dead_zone",
    "width",
    "N",
    "a dead zone of the actuators",
    targets=actuators_or_all,
    low=1e-12,
    high=1e12,
    nonlinear=True,
    starts=lambda evidence, target: [
        {"width": float(q)} for q in np.quantile(_commands(evidence, target), (0.03, 0.08, 0.15, 0.3, 0.5, 0.7))
    ],
)


def _position_starts(evidence, _):
    domain = evidence.rig.modes.domain
    if isinstance(domain, Interval):
        return [{"at": float(x)} for x in domain.length * np.linspace(0.015, 0.985, 41)]
    return [place_values(where) for where in domain.grid(9)]


def _movable(targets: Callable[[Rig], tuple]) -> Callable[[Rig], tuple]:
    """Targets that may stand elsewhere; where shapes are known at the inputs and outputs alone, none may."""

    def where_there_is_room(rig: Rig) -> tuple:
        domain = rig.modes.domain
        crowded = isinstance(domain, NamedPoints) and len(domain.names) <= len(rig.actuators) + len(rig.sensors)
        return () if crowded else targets(rig)

    return where_there_is_room


ACTUATOR_MISPLACEMENT = Kind(
    name="actuator_misplacement",
    path="actuator",
    parameters=lambda rig, _: place_parameters(rig),
    apply=lambda rig, target, v: _change_actuators(rig, target, at=place_of(v)),
    starts=_position_starts,
    targets=_movable(each_actuator),
    phrase="an actuator that stands elsewhere",
)

SENSOR_MISPLACEMENT = Kind(
    name="sensor_misplacement",
    path="sensor",
    parameters=lambda rig, _: place_parameters(rig),
    apply=lambda rig, target, v: _change_sensors(rig, target, at=place_of(v)),
    starts=_position_starts,
    targets=_movable(each_sensor),
    phrase="a sensor that stands elsewhere",
)


# --- sensors


def _size(evidence, target: str) -> float:
    """Largest root mean square of an output among the records, in its unit."""
    j = each_sensor(evidence.rig).index(target)
    return float(max(np.sqrt(np.mean(record.outputs[j] ** 2)) for record in evidence.data.records))


def _sensor(name: str, field: str, phrase: str, starts: Callable, unit: str = "", **options) -> Kind:
    """A kind that sets one figure of a sensor."""
    attribute = {"drift_over_record": "drift"}.get(field, field)
    log = options.pop("log", False)
    low, high = options.pop("low", -1e12), options.pop("high", 1e12)

    def parameters(rig: Rig, target) -> tuple[Parameter, ...]:
        noise = max((s.noise_std for s in rig.sensors if target in (s.name, ALL)), default=1.0)
        scale = 0.1 if field == "gain" else max(noise, 1e-300)
        quantity = next((s.quantity for s in rig.sensors if target in (s.name, ALL)), "")
        shown = QUANTITIES.get(quantity, "") if unit == OF_THE_SENSOR else unit
        return (Parameter(field, shown, low, high, logarithmic=log, scale=scale),)

    return Kind(
        name=name,
        path="sensor",
        parameters=parameters,
        apply=lambda rig, target, v: _change_sensors(rig, target, **{attribute: v[field]}),
        starts=starts,
        targets=options.pop("targets", each_sensor),
        phrase=phrase,
        **options,
    )


SENSOR_GAIN = _sensor(
    "sensor_gain", "gain", "a wrong sensor gain", lambda evidence, _: [{"gain": 0.9}], low=-20.0, high=20.0
)


def _mean_residual(evidence, target: str) -> float:
    j = each_sensor(evidence.rig).index(target)
    return float(np.mean(np.concatenate([r[j] for r in evidence.residuals])))


SENSOR_BIAS = _sensor(
    "sensor_bias",
    "bias",
    "a sensor bias",
    lambda evidence, target: [{"bias": _mean_residual(evidence, target)}],
    OF_THE_SENSOR,
)

SENSOR_DRIFT = _sensor(
    "sensor_drift",
    "drift_over_record",
    "a sensor drift",
    lambda evidence, target: [{"drift_over_record": 2.0 * _mean_residual(evidence, target)}],
    OF_THE_SENSOR,
)

SENSOR_LAG = _sensor(
    "sensor_lag",
    "time_constant",
    "a lag of the sensors",
    lambda evidence, _: [{"time_constant": s * _sample_time(evidence)} for s in (0.1, 0.4, 1.2, 4.0, 12.0)],
    "s",
    log=True,
    low=1e-6,
    high=1e4,
    targets=sensors_or_all,
)


def clipped_level(evidence, target: str) -> float | None:
    """The level that a sensor's readings stop at: its largest magnitude, where it is met again and again."""
    j = each_sensor(evidence.rig).index(target)
    readings = np.abs(np.concatenate([record.outputs[j] for record in evidence.data.records]))
    top = readings.max()
    return float(top) if np.sum(readings >= top * (1 - 1e-6)) >= 3 and top > 0 else None


def rounding_step(evidence, target: str) -> float | None:
    """The step that all of a sensor's readings are multiples of, or None."""
    j = each_sensor(evidence.rig).index(target)
    return step_of(np.concatenate([record.outputs[j] for record in evidence.data.records]))


def step_of(readings: np.ndarray) -> float | None:
    """The step of which all readings are multiples, where there are far fewer levels than readings."""
    levels = np.unique(readings)
    if levels.size < 3 or levels.size > 0.5 * readings.size:
        return None
    slack = 4e-7 * max(np.abs(levels).max(), 1e-300)
    gaps = np.diff(levels)
    gaps = gaps[gaps > slack]
    if gaps.size == 0:
        return None
    step = float(np.median(gaps[gaps <= 1.5 * gaps.min()]))
    if step < 4 * slack:
        return None
    step = float(np.dot(np.round(levels / step), levels) / max(np.sum(np.round(levels / step) ** 2), 1.0))
    inside = levels[np.abs(levels) < 0.999 * np.abs(levels).max()]
    return step if np.abs(inside - step * np.round(inside / step)).max() < 0.05 * step else None


def _clipping_starts(evidence, target):
    level = clipped_level(evidence, target)
    return [{"limit": level}] if level is not None else []


SENSOR_CLIPPING = _sensor(
    "sensor_clipping",
    "limit",
    "clipping of a sensor",
    _clipping_starts,
    OF_THE_SENSOR,
    log=True,
    low=1e-300,
    nonlinear=True,
)


def _rounding_starts(evidence, target):
    step = rounding_step(evidence, target)
    return [{"step": step}] if step is not None else []


SENSOR_QUANTISATION = _sensor(
    "sensor_quantisation",
    "step",
    "rounding of a sensor",
    _rounding_starts,
    OF_THE_SENSOR,
    log=True,
    low=1e-300,
    nonlinear=True,
)

KINDS = (
    ACTUATOR_GAIN,
    ACTUATOR_LAG,
    ACTUATOR_DELAY,
    ACTUATOR_SATURATION,
    ACTUATOR_DEAD_ZONE,
    ACTUATOR_MISPLACEMENT,
    SENSOR_GAIN,
    SENSOR_BIAS,
    SENSOR_DRIFT,
    SENSOR_LAG,
    SENSOR_MISPLACEMENT,
    SENSOR_CLIPPING,
    SENSOR_QUANTISATION,
)
