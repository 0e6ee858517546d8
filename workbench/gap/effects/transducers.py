"""Kinds of effects of actuators and sensors."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, permutations
from typing import Any

import numpy as np

from workbench.gap.effects.effect import (
    ALL,
    Effect,
    Kind,
    Parameter,
    Reconstruction,
    Scales,
    place_of,
    place_parameters,
    place_values,
)
from workbench.records.record import QUANTITIES
from workbench.rig.actuators import linear_actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import linear_sensor
from workbench.rig.simulate import simulate_record
from workbench.structure.domain import Interval, Location, NamedPoints, centred_at, reach

SENSOR_UNIT = "unit of the sensor"
# of a residual's mean square: cross-talk is tried where another channel explains more of it
LEAST_CROSSTALK = 0.05
# of a command's mean square: cross-talk from another that differs by less from a multiple of it is a gain
LEAST_OWN = 0.01
Starts = Callable[[Reconstruction, Any], Iterable[dict[str, Any]]]

SLOW_ENTRY = 0.1  # of the rms step between samples: a reading that reaches its top in a larger step is cut off there
# stay at the top, in units of the time to stop at the deceleration before it: three times as long as up and back
LONG_STAY = 6.0
TURNING_SAMPLES = 2  # longest stay of a motion that reverses slowly

# --- targets and changes


def each_actuator(rig: Rig) -> tuple[str, ...]:
    """Names of the inputs that go through an actuator; a hammer does not."""
    return tuple(a.name for a in rig.actuators if not a.direct)


def each_input(rig: Rig) -> tuple[str, ...]:
    return tuple(a.name for a in rig.actuators)


def each_sensor(rig: Rig) -> tuple[str, ...]:
    return tuple(s.name for s in rig.sensors)


def or_all(each: Callable[[Rig], tuple[str, ...]]) -> Callable[[Rig], tuple[str, ...]]:
    """Every target alone, and all of them together if there are several."""
    return lambda rig: (ALL, *each(rig)) if len(each(rig)) > 1 else each(rig)


def _change_actuators(rig: Rig, target: str, **changes: Any) -> Rig:
    changed = tuple(
        replace(a, **changes) if (a.name == target or (target == ALL and not a.direct)) else a for a in rig.actuators
    )
    return replace(rig, actuators=changed)


def _change_sensors(rig: Rig, target: str, **changes: Any) -> Rig:
    return replace(rig, sensors=tuple(replace(s, **changes) if target in (s.name, ALL) else s for s in rig.sensors))


def _with_gain(rig: Rig, side: str, target: str, gain: float) -> Rig:
    """The rig with the gain of one actuator or sensor multiplied: nominal errors may have changed it already."""
    transducers: Any = tuple(replace(p, gain=gain * p.gain) if p.name == target else p for p in getattr(rig, side))
    return replace(rig, **{side: transducers})


def _swapped(rig: Rig, side: str, pair: tuple[str, str]) -> Rig:
    """The rig with two actuators or sensors exchanged; each channel keeps its name, its noise and its quantisation.

    It also keeps the commands of other channels that it takes a share of.
    """
    by_name = {transducer.name: transducer for transducer in getattr(rig, side)}
    exchanged = {pair[0]: by_name[pair[1]], pair[1]: by_name[pair[0]]}
    kept = ("name", "noise_std", "step") if side == "sensors" else ("name", "crosstalk")
    transducers: Any = tuple(
        replace(exchanged.get(name, transducer), **{field: getattr(transducer, field) for field in kept})
        for name, transducer in by_name.items()
    )
    return replace(rig, **{side: transducers})


def exchanged_last(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """An equivalent sequence of effects in which exchanges come last, followed only by errors of the nominal model.

    An effect after an exchange names a channel; an effect before it names an actuator or sensor by its place. A gain of
    channel F2 after F1 and F2 are exchanged equals a gain of actuator F1 before it.
    """
    ordered = list(effects)
    for exchange in [e for e in effects if e.kind in (SWAPPED_INPUTS, SWAPPED_OUTPUTS)]:
        at, (one, other) = ordered.index(exchange), exchange.target
        names = {one: other, other: one}
        later = [e for e in ordered[at + 1 :] if e.kind.path == exchange.kind.path and not e.kind.applied_first]
        if any(isinstance(e.target, tuple) for e in later):  # such an effect may involve both channels, so it stays
            continue
        moved = [  # quantisation is of the channel, not of the sensor on its wire
            replace(e, target=names.get(e.target, e.target)) if e in later and e.kind is not SENSOR_QUANTISATION else e
            for e in ordered[at + 1 :]
        ]
        errors = sum(e.kind.applied_first for e in moved)
        ordered[at:] = [*moved[: len(moved) - errors], exchange, *moved[len(moved) - errors :]]
    return tuple(ordered)


def _commands(reconstruction: Reconstruction, target: str, *, changes: bool = False) -> np.ndarray:
    """Magnitudes (n,) of all non-zero commands to the target in all records, or of their changes between samples."""
    names = each_actuator(reconstruction.rig) if target == ALL else (target,)
    rows = [
        np.diff(row) if changes else row
        for record in reconstruction.data.records
        for channel, row in zip(record.input_channels, record.inputs, strict=True)
        if channel.name in names
    ]
    values = np.abs(np.concatenate(rows))
    values = values[values > 0]
    return values if values.size else np.ones(1)


def _quantiles(name: str, *shares: float, of_rates: bool = False) -> Starts:
    """Starts at quantiles of the command, or of its rate of change."""

    def starts(reconstruction: Reconstruction, target: str) -> list[dict[str, float]]:
        values = _commands(reconstruction, target, changes=of_rates)
        if of_rates:
            values = values / reconstruction.data.records[0].sample_time
        return [{name: float(q)} for q in np.quantile(values, shares)]

    return starts


def _in_samples(name: str, *times: float) -> Starts:
    """Starts at times in samples."""
    return lambda reconstruction, _: [{name: n * reconstruction.data.records[0].sample_time} for n in times]


def _time_scale(rig: Rig) -> float:
    return Scales.of(rig).time


def _force_scale(rig: Rig) -> float:
    return Scales.of(rig).force


def _one_parameter_kind(
    path: str,
    name: str,
    field: str,
    unit: str,
    phrase: str,
    *,
    starts: Starts,
    targets: Callable[[Rig], tuple[str, ...]],
    low: float = -1e12,
    high: float = 1e12,
    log: bool = False,
    attribute: str | None = None,
    neutral: float | None = None,
    size: Callable[[Rig], float] = lambda rig: 1.0,
    apply: Callable[[Rig, Any, dict[str, Any]], Rig] | None = None,
    **options: Any,
) -> Kind:
    """A kind with one parameter, which sets an attribute of an actuator or a sensor.

    Args:
        path: "actuator" or "sensor".
        name: of the kind.
        field: name of the parameter.
        unit: of the parameter.
        phrase: name of the kind in a sentence.
        starts: start values for a search.
        targets: actuators or sensors that it applies to.
        low, high: bounds, in units of `size`.
        log: whether the parameter is fitted on a logarithmic scale.
        attribute: that it sets; None for the one named `field`.
        neutral: value at which it changes nothing.
        size: scale of the bounds, from the rig.
        apply: used instead of setting the attribute.
        options: further fields of `Kind`.
    """
    attribute = attribute or field
    change = _change_actuators if path == "actuator" else _change_sensors

    def parameters(rig: Rig, target: str) -> tuple[Parameter, ...]:
        shown, scale = unit, 0.1
        if unit == SENSOR_UNIT:
            sensors = [s for s in rig.sensors if target in (s.name, "all")]
            is_one_quantity = len({s.quantity for s in sensors}) == 1
            shown = QUANTITIES.get(sensors[0].quantity, "") if is_one_quantity else ""
            scale = max(sensors[0].noise_std, 1e-300)
        bounds = low * size(rig), high * size(rig)
        return (Parameter(field, shown, *bounds, logarithmic=log, scale=scale, neutral=neutral),)

    return Kind(
        name=name,
        path=path,
        parameters=parameters,
        apply=apply or (lambda rig, target, v: change(rig, target, **{attribute: v[field]})),
        starts=starts,
        targets=targets,
        phrase=phrase,
        **options,
    )


_actuator = partial(_one_parameter_kind, "actuator", log=True)
_sensor = partial(_one_parameter_kind, "sensor", targets=each_sensor)

ACTUATOR_GAIN = _actuator(
    "actuator_gain",
    "gain",
    "",
    "a wrong actuator gain",
    neutral=1.0,
    targets=each_actuator,
    apply=lambda rig, target, v: _with_gain(rig, "actuators", target, v["gain"]),
    low=-20.0,
    high=20.0,
    log=False,
    starts=lambda reconstruction, _: [{"gain": 0.9}],
    signed=True,
)

ACTUATOR_LAG = _actuator(
    "actuator_lag",
    "time_constant",
    "s",
    "a lag of the actuators",
    neutral=0.0,
    targets=or_all(each_actuator),
    low=1e-6,
    high=1e4,
    size=_time_scale,
    starts=_in_samples("time_constant", 0.1, 0.4, 1.2, 4.0, 12.0),
)

ACTUATOR_DELAY = _actuator(
    "actuator_delay",
    "delay",
    "s",
    "a delay of the actuators",
    neutral=0.0,
    targets=or_all(each_actuator),
    low=1e-9,
    high=1e4,
    size=_time_scale,
    starts=_in_samples("delay", 0.1, 0.4, 0.8, 1.3, 1.8, 2.5, 3.5, 5.0, 8.0, 12.0),
)

ACTUATOR_SATURATION = _actuator(
    "actuator_saturation",
    "limit",
    "N",
    "saturation of the actuators",
    targets=or_all(each_actuator),
    low=1e-12,
    high=1e12,
    size=_force_scale,
    nonlinear=True,
    starts=_quantiles("limit", 0.5, 0.65, 0.8, 0.9, 0.96, 0.99),
)

ACTUATOR_DEAD_ZONE = _actuator(
    "actuator_dead_zone",
    "width",
    "N",
    "a dead zone of the actuators",
    attribute="dead_zone",
    neutral=0.0,
    targets=or_all(each_actuator),
    low=1e-12,
    high=1e12,
    size=_force_scale,
    nonlinear=True,
    starts=_quantiles("width", 0.03, 0.08, 0.15, 0.3, 0.5, 0.7),
)


ACTUATOR_BIAS = Kind(
    name="actuator_bias",
    path="actuator",
    parameters=lambda rig, _: (
        Parameter(
            "force", "N", -1e6 * _force_scale(rig), 1e6 * _force_scale(rig), scale=1e-3 * _force_scale(rig), neutral=0.0
        ),
    ),
    apply=lambda rig, target, v: _change_actuators(rig, target, bias=v["force"]),
    starts=lambda reconstruction, target: [
        {"force": 0.1 * float(np.sqrt(np.mean(_commands(reconstruction, target) ** 2)))}
    ],
    targets=each_actuator,
    signed=True,
    phrase="a constant force of an actuator",
)


ACTUATOR_RATE_LIMIT = _actuator(
    "actuator_rate_limit",
    "rate",
    "N/s",
    "a rate limit of the actuators",
    attribute="rate_limit",
    targets=or_all(each_actuator),
    low=1e-300,
    high=1e300,
    nonlinear=True,
    starts=_quantiles("rate", 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, of_rates=True),
)


def _hysteresis_starts(reconstruction: Reconstruction, target: str) -> Iterator[dict[str, float]]:
    for width in np.quantile(_commands(reconstruction, target), (0.2, 0.5, 0.8)):
        for share in (0.1, 0.4):
            yield {"share": share, "width": float(width)}


ACTUATOR_HYSTERESIS = Kind(
    name="actuator_hysteresis",
    path="actuator",
    parameters=lambda rig, _: (
        Parameter("share", "", 1e-4, 1.0, scale=0.1, neutral=0.0),
        Parameter("width", "N", 1e-300, 1e300, logarithmic=True),
    ),
    apply=lambda rig, target, v: _change_actuators(
        rig, target, hysteresis_share=v["share"], hysteresis_width=v["width"]
    ),
    starts=_hysteresis_starts,
    targets=or_all(each_actuator),
    nonlinear=True,
    simpler=lambda effect, _: (  # at zero width
        (Effect(ACTUATOR_GAIN, effect.target, {"gain": 1.0 - effect.values["share"]}),) if effect.target != ALL else ()
    ),
    phrase="hysteresis of the actuators",
)

SWAPPED_INPUTS = Kind(
    name="swapped_inputs",
    path="actuator",
    parameters=lambda rig, _: (),
    apply=lambda rig, pair, _: _swapped(rig, "actuators", pair),
    starts=lambda reconstruction, _: [{}],
    targets=lambda rig: tuple(combinations(each_input(rig), 2)),
    phrase="an exchange of two inputs",
)


def _responses_to_share(reconstruction: Reconstruction, pair: tuple[str, str]) -> list[np.ndarray]:
    """Readings (n_sensors, n_samples) of each record per share of the second input's command in the first.

    Laws at points and limits of the channels are left out.
    """
    found = []
    for record, residual in zip(reconstruction.data.records, reconstruction.residuals, strict=True):
        rig = reconstruction.rig.in_record(record.name)
        linear = replace(
            rig,
            actuators=tuple(linear_actuator(a) for a in rig.actuators),
            sensors=tuple(linear_sensor(s) for s in rig.sensors),
            elements=(),
            stiffness_rate=0.0,
        )
        to, source = (each_input(rig).index(name) for name in pair)
        inputs = np.zeros_like(record.inputs)
        inputs[to] = record.inputs[source]
        found.append(simulate_record(linear, replace(record, inputs=inputs))[:, -residual.shape[1] :])
    return found


def _actuator_crosstalk_starts(reconstruction: Reconstruction, pair: tuple[str, str]) -> list[dict[str, float]]:
    """Share of the second input's command, acting where the first does, if that explains enough of the residuals.

    None where the commands are proportional: cross-talk is then a gain.
    """
    rows = [each_input(reconstruction.rig).index(name) for name in pair]
    own, source = np.concatenate([record.inputs[rows] for record in reconstruction.data.records], axis=1)
    size = float(own @ own)
    alike = float(own @ source) ** 2 > (1.0 - LEAST_OWN) * size * float(source @ source)
    if not source.any() or (size > 0 and alike):
        return []
    noise = np.array(list(_noise(reconstruction.rig).values()))[:, None]
    change = np.concatenate([(y / noise).ravel() for y in _responses_to_share(reconstruction, pair)])
    residual = np.concatenate([(y / noise).ravel() for y in reconstruction.residuals])
    power = float(change @ change)
    share = float(residual @ change) / power if power > 0 else 0.0
    return [{"share": share}] if share**2 * power > LEAST_CROSSTALK * float(residual @ residual) else []


def _with_share(rig: Rig, pair: tuple[str, str], share: float) -> Rig:
    """The rig with a share of the second input's command added to that of the first."""
    name, source = pair
    return replace(
        rig,
        actuators=tuple(
            replace(a, crosstalk=(*a.crosstalk, (source, share))) if a.name == name else a for a in rig.actuators
        ),
    )


ACTUATOR_CROSSTALK = Kind(
    name="actuator_crosstalk",
    path="actuator",
    parameters=lambda rig, _: (Parameter("share", "", -1e3, 1e3, scale=0.1, neutral=0.0),),
    apply=lambda rig, pair, v: _with_share(rig, pair, v["share"]),
    starts=_actuator_crosstalk_starts,
    targets=lambda rig: tuple(permutations(each_actuator(rig), 2)),
    signed=True,
    second_channel="from",
    conjunction=" from ",
    phrase="cross-talk between actuators",
)


def _position_starts(reconstruction: Reconstruction, _: object) -> list[dict[str, Any]]:
    domain = reconstruction.rig.modes.domain
    if isinstance(domain, Interval):
        return [{"at": float(x)} for x in domain.length * np.linspace(0.015, 0.985, 41)]
    return [place_values(where) for where in domain.grid(9)]


def _movable(targets: Callable[[Rig], tuple[str, ...]]) -> Callable[[Rig], tuple[str, ...]]:
    """Targets that may be misplaced: none if the mode shapes are known at the inputs and outputs only."""

    def movable(rig: Rig) -> tuple[str, ...]:
        domain = rig.modes.domain
        points_alone = isinstance(domain, NamedPoints) and len(domain.names) <= len(rig.actuators) + len(rig.sensors)
        return () if points_alone else targets(rig)

    return movable


def _nominal_place(rig: Rig, target: str) -> Location:
    """Place of an actuator in the nominal rig."""
    return next(a.at for a in rig.actuators if a.name == target)


def _actuator_place_parameters(rig: Rig, target: str) -> tuple[Parameter, ...]:
    """Coordinates of the centre of an actuator, bounded so that all of it stays on the structure."""
    domain = rig.modes.domain
    if isinstance(domain, NamedPoints):
        return place_parameters(rig)
    ends = zip(place_parameters(rig), *reach(domain, _nominal_place(rig, target)), strict=True)
    return tuple(replace(p, low=float(low), high=float(high)) for p, low, high in ends)


def _actuator_starts(reconstruction: Reconstruction, target: str) -> list[dict[str, Any]]:
    bounds = {p.name: p for p in _actuator_place_parameters(reconstruction.rig, target)}
    starts = _position_starts(reconstruction, target)
    return [v for v in starts if all(p.low <= v[name] <= p.high for name, p in bounds.items())]


ACTUATOR_MISPLACEMENT = Kind(
    name="actuator_misplacement",
    path="actuator",
    parameters=_actuator_place_parameters,
    apply=lambda rig, target, v: _change_actuators(
        rig, target, at=centred_at(_nominal_place(rig, target), place_of(v))
    ),
    starts=_actuator_starts,
    targets=_movable(each_actuator),
    phrase="a misplaced actuator",
)

SENSOR_MISPLACEMENT = Kind(
    name="sensor_misplacement",
    path="sensor",
    parameters=lambda rig, _: place_parameters(rig),
    apply=lambda rig, target, v: _change_sensors(rig, target, at=place_of(v)),
    starts=_position_starts,
    targets=_movable(each_sensor),
    phrase="a misplaced sensor",
)


# --- sensors


SENSOR_GAIN = _sensor(
    "sensor_gain",
    "gain",
    "",
    "a wrong sensor gain",
    starts=lambda reconstruction, _: [{"gain": 0.9}],
    apply=lambda rig, target, v: _with_gain(rig, "sensors", target, v["gain"]),
    low=-100.0,
    high=100.0,
    signed=True,
    neutral=1.0,
)


def _residual(reconstruction: Reconstruction, name: str) -> np.ndarray:
    """Residual (n_samples,) of a sensor over all records, joined."""
    j = each_sensor(reconstruction.rig).index(name)
    return np.concatenate([residual[j] for residual in reconstruction.residuals])


SENSOR_BIAS = _sensor(
    "sensor_bias",
    "bias",
    SENSOR_UNIT,
    "a sensor bias",
    starts=lambda reconstruction, target: [{"bias": float(np.mean(_residual(reconstruction, target)))}],
    signed=True,
)

SENSOR_DRIFT = _sensor(
    "sensor_drift",
    "drift_over_record",
    SENSOR_UNIT,
    "a sensor drift",
    starts=lambda reconstruction, target: [
        {"drift_over_record": 2.0 * float(np.mean(_residual(reconstruction, target)))}
    ],
    attribute="drift",
    signed=True,
)

SENSOR_LAG = _sensor(
    "sensor_lag",
    "time_constant",
    "s",
    "a lag of the sensors",
    starts=_in_samples("time_constant", 0.1, 0.4, 1.2, 4.0, 12.0),
    log=True,
    low=1e-6,
    high=1e4,
    size=_time_scale,
    neutral=0.0,
    targets=or_all(each_sensor),
)


SENSOR_DELAY = _sensor(
    "sensor_delay",
    "delay",
    "s",
    "a delay of a sensor",
    starts=_in_samples("delay", 0.1, 0.4, 0.8, 1.3, 2.5, 5.0),
    log=True,
    low=1e-9,
    high=1e4,
    size=_time_scale,
    neutral=0.0,
)


def _predicted(reconstruction: Reconstruction, name: str) -> np.ndarray:
    """Prediction (n_samples,) of a sensor's readings over all records, joined."""
    j = each_sensor(reconstruction.rig).index(name)
    records = zip(reconstruction.data.counted, reconstruction.residuals, strict=True)
    return np.concatenate([record.outputs[j] - residual[j] for record, residual in records])


def _crosstalk_starts(reconstruction: Reconstruction, pair: tuple[str, str]) -> list[dict[str, float]]:
    """Share of the second sensor's prediction in the residual of the first, if that explains enough of it."""
    residual, source = _residual(reconstruction, pair[0]), _predicted(reconstruction, pair[1])
    size = float(source @ source)
    share = float(residual @ source) / size if size > 0 else 0.0
    return [{"share": share}] if share**2 * size > LEAST_CROSSTALK * float(residual @ residual) else []


def _noise(rig: Rig) -> dict[str, float]:
    """Standard deviation of the noise of each sensor by name, none of them zero."""
    return {sensor.name: max(sensor.noise_std, 1e-300) for sensor in rig.sensors}


def _share_parameters(rig: Rig, pair: tuple[str, str]) -> tuple[Parameter, ...]:
    noise = _noise(rig)
    ratio = noise[pair[0]] / noise[pair[1]]
    return (Parameter("share", "", -1e3 * ratio, 1e3 * ratio, scale=0.1 * ratio, neutral=0.0),)


SENSOR_CROSSTALK = Kind(
    name="sensor_crosstalk",
    path="sensor",
    parameters=_share_parameters,
    apply=lambda rig, pair, v: _change_sensors(rig, pair[0], crosstalk=((pair[1], v["share"]),)),
    starts=_crosstalk_starts,
    targets=lambda rig: tuple(permutations(each_sensor(rig), 2)),
    signed=True,
    second_channel="from",
    conjunction=" from ",
    phrase="cross-talk between sensors",
)


def _swapped_output_starts(reconstruction: Reconstruction, pair: tuple[str, str]) -> list[dict[str, float]]:
    """One start if the readings of the two sensors agree better with the predictions of each other; else none."""
    noise, own, crossed = _noise(reconstruction.rig), 0.0, 0.0
    for name, other in (pair, pair[::-1]):
        residual = _residual(reconstruction, name)
        measured = _predicted(reconstruction, name) + residual
        own += float(residual @ residual) / noise[name] ** 2
        crossed += float(np.sum((measured - _predicted(reconstruction, other)) ** 2)) / noise[name] ** 2
    return [{}] if crossed < own else []


SWAPPED_OUTPUTS = Kind(
    name="swapped_outputs",
    path="sensor",
    parameters=lambda rig, _: (),
    apply=lambda rig, pair, _: _swapped(rig, "sensors", pair),
    starts=_swapped_output_starts,
    targets=lambda rig: tuple(combinations(each_sensor(rig), 2)),
    phrase="an exchange of two outputs",
)


def clipped_level(rows: list[np.ndarray]) -> float | None:
    """The level at which a sensor clips: its largest magnitude, if readings are cut off there; else None."""
    top = max(float(np.abs(row).max()) for row in rows)
    at_top = [np.abs(row) >= top * (1 - 1e-6) for row in rows]
    if not top > 0 or sum(int(flags.sum()) for flags in at_top) < 3:
        return None
    return None if _comes_to_rest(rows, at_top) else top


def _comes_to_rest(rows: list[np.ndarray], at_top: list[np.ndarray]) -> bool:
    """Whether readings come to rest, or reverse, at their top instead of being cut off there.

    A motion that comes to rest slows down first, and stays longer than its deceleration would have taken it up and
    back. A motion that a controller repeats reverses at the same top and hardly stays there.

    Args:
        rows: readings (n_samples,) of each record.
        at_top: (n_samples,) of each record, whether the reading is at its top.
    """
    entering, at_rest = [], []
    for row, flags in zip(rows, at_top, strict=True):
        ends = np.flatnonzero(np.diff(np.r_[False, flags, False]))
        for first, last in zip(ends[::2], ends[1::2], strict=True):
            if first >= 3:
                before, step, into = np.abs(np.diff(row[first - 3 : first + 1]))
                entering.append(into)
                stayed = last - first
                at_rest.append(stayed <= TURNING_SAMPLES or stayed * abs(before - step) > LONG_STAY * step)
    typical = np.sqrt(np.mean(np.concatenate([np.diff(row) for row in rows]) ** 2))
    return bool(entering) and float(np.median(entering)) < SLOW_ENTRY * typical and float(np.mean(at_rest)) > 0.5


def step_of(readings: np.ndarray) -> float | None:
    """The quantisation step of which all readings (n_samples,) are multiples; None if there is none."""
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


def _read(name: str, measure: Callable[[list[np.ndarray]], float | None]) -> Starts:
    """One start, a parameter that a sensor's readings (n_samples,) of all records show; none if they do not."""

    def starts(reconstruction: Reconstruction, target: str) -> list[dict[str, float]]:
        j = each_sensor(reconstruction.rig).index(target)
        value = measure([record.outputs[j] for record in reconstruction.data.records])
        return [] if value is None else [{name: value}]

    return starts


SENSOR_CLIPPING = _sensor(
    "sensor_clipping",
    "limit",
    SENSOR_UNIT,
    "clipping of a sensor",
    starts=_read("limit", clipped_level),
    log=True,
    low=1e-300,
    nonlinear=True,
    found_in="readings",
)


SENSOR_QUANTISATION = _sensor(
    "sensor_quantisation",
    "step",
    SENSOR_UNIT,
    "rounding of a sensor",
    starts=_read("step", lambda rows: step_of(np.concatenate(rows))),
    log=True,
    low=1e-300,
    nonlinear=True,
    found_in="readings",
    unpredictable="Quantisation leaves an unpredictable error of step/√12 rms.",
)

KINDS = (
    ACTUATOR_GAIN,
    ACTUATOR_LAG,
    ACTUATOR_DELAY,
    ACTUATOR_SATURATION,
    ACTUATOR_DEAD_ZONE,
    ACTUATOR_MISPLACEMENT,
    ACTUATOR_HYSTERESIS,
    ACTUATOR_BIAS,
    ACTUATOR_RATE_LIMIT,
    SWAPPED_INPUTS,
    ACTUATOR_CROSSTALK,
    SENSOR_GAIN,
    SENSOR_BIAS,
    SENSOR_DRIFT,
    SENSOR_LAG,
    SENSOR_MISPLACEMENT,
    SENSOR_DELAY,
    SENSOR_CROSSTALK,
    SWAPPED_OUTPUTS,
    SENSOR_CLIPPING,
    SENSOR_QUANTISATION,
)
