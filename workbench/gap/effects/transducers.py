"""Kinds of effects of actuators and sensors."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations, permutations
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.gap.effects.effect import (
    ALL,
    Effect,
    Kind,
    Parameter,
    Parameters,
    Reconstruction,
    Scales,
    Starts,
    place_of,
    place_parameters,
    place_values,
    positive,
)
from workbench.records.record import QUANTITIES
from workbench.rig.actuators import linear_actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import linear_sensor
from workbench.rig.simulate import simulate_record
from workbench.structure.domain import Interval, Location, NamedPoints, centred_at, reach

# of a residual's mean square: cross-talk is tried where another channel explains more of it
LEAST_CROSSTALK = 0.05
# of a command's mean square: cross-talk from another that differs by less from a multiple of it is a gain
LEAST_OWN = 0.01
SLOW_ENTRY = 0.1  # of the rms step between samples: a reading that reaches its top in a larger step is cut off there
# stay at the top, in units of the time to stop at the deceleration before it: three times as long as up and back
LONG_STAY = 6.0
TURNING_SAMPLES = 2  # longest stay of a motion that reverses slowly

Apply = Callable[[Rig, Any, dict[str, Any]], Rig]
Targets = Callable[[Rig], tuple[str, ...]]

# --- targets and changes


def each_actuator(rig: Rig) -> tuple[str, ...]:
    """Names of the inputs that go through an actuator; a hammer does not."""
    return tuple(a.name for a in rig.actuators if not a.direct)


def each_input(rig: Rig) -> tuple[str, ...]:
    return tuple(a.name for a in rig.actuators)


def each_sensor(rig: Rig) -> tuple[str, ...]:
    return tuple(s.name for s in rig.sensors)


def or_all(each: Targets) -> Targets:
    """Every target alone, and all of them together if there are several."""
    return lambda rig: (ALL, *each(rig)) if len(each(rig)) > 1 else each(rig)


def _change_actuators(rig: Rig, target: str, **changes: Any) -> Rig:
    names = each_actuator(rig) if target == ALL else (target,)
    return replace(rig, actuators=tuple(replace(a, **changes) if a.name in names else a for a in rig.actuators))


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
        at = ordered.index(exchange)
        names = dict(zip(exchange.target, exchange.target[::-1], strict=True))
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


def _set(side: str, parameter: str, attribute: str | None = None) -> Apply:
    """Sets an attribute of actuators or sensors, of the name of the parameter unless given, to that parameter."""
    change = _change_actuators if side == "actuators" else _change_sensors
    return lambda rig, target, v: change(rig, target, **{attribute or parameter: v[parameter]})


def _time(name: str, low: float) -> Parameters:
    """A time, s, of at least `low` times the time scale of the rig."""
    return lambda rig, _: (positive(name, "s", Scales.of(rig).time, low, 1e4, neutral=0.0),)


def _force(name: str, neutral: float | None = None) -> Parameters:
    """The magnitude of a force, N."""
    return lambda rig, _: (positive(name, "N", Scales.of(rig).force, neutral=neutral),)


def _reading(name: str, *, is_positive: bool = False) -> Parameters:
    """A parameter in the unit of the target's readings, dimensionless if these are of several quantities."""

    def parameters(rig: Rig, target: str) -> tuple[Parameter, ...]:
        sensors = [s for s in rig.sensors if target in (s.name, ALL)]
        unit = QUANTITIES.get(sensors[0].quantity, "") if len({s.quantity for s in sensors}) == 1 else ""
        if is_positive:
            return (Parameter(name, unit, 1e-300, 1e12, logarithmic=True),)
        return (Parameter(name, unit, -1e12, 1e12, scale=max(sensors[0].noise_std, 1e-300)),)

    return parameters


ACTUATOR_GAIN = Kind(
    name="actuator_gain",
    path="actuator",
    parameters=lambda rig, _: (Parameter("gain", "", -20.0, 20.0, scale=0.1, neutral=1.0),),
    apply=lambda rig, target, v: _with_gain(rig, "actuators", target, v["gain"]),
    starts=lambda reconstruction, _: [{"gain": 0.9}],
    targets=each_actuator,
    signed=True,
    phrase="an actuator gain error",
)

ACTUATOR_LAG = Kind(
    name="actuator_lag",
    path="actuator",
    parameters=_time("time_constant", 1e-6),
    apply=_set("actuators", "time_constant"),
    starts=_in_samples("time_constant", 0.1, 0.4, 1.2, 4.0, 12.0),
    targets=or_all(each_actuator),
    phrase="a lag of the actuators",
)

ACTUATOR_DELAY = Kind(
    name="actuator_delay",
    path="actuator",
    parameters=_time("delay", 1e-9),
    apply=_set("actuators", "delay"),
    starts=_in_samples("delay", 0.1, 0.4, 0.8, 1.3, 1.8, 2.5, 3.5, 5.0, 8.0, 12.0),
    targets=or_all(each_actuator),
    phrase="a delay of the actuators",
)

ACTUATOR_SATURATION = Kind(
    name="actuator_saturation",
    path="actuator",
    parameters=_force("limit"),
    apply=_set("actuators", "limit"),
    starts=_quantiles("limit", 0.5, 0.65, 0.8, 0.9, 0.96, 0.99),
    targets=or_all(each_actuator),
    nonlinear=True,
    phrase="saturation of the actuators",
)

ACTUATOR_DEAD_ZONE = Kind(
    name="actuator_dead_zone",
    path="actuator",
    parameters=_force("width", neutral=0.0),
    apply=_set("actuators", "width", "dead_zone"),
    starts=_quantiles("width", 0.03, 0.08, 0.15, 0.3, 0.5, 0.7),
    targets=or_all(each_actuator),
    nonlinear=True,
    phrase="a dead zone of the actuators",
)


def _bias_parameters(rig: Rig, _: object) -> tuple[Parameter, ...]:
    force = Scales.of(rig).force
    return (Parameter("force", "N", -1e6 * force, 1e6 * force, scale=1e-3 * force, neutral=0.0),)


ACTUATOR_BIAS = Kind(
    name="actuator_bias",
    path="actuator",
    parameters=_bias_parameters,
    apply=_set("actuators", "force", "bias"),
    starts=lambda force, target: [{"force": 0.1 * float(np.sqrt(np.mean(_commands(force, target) ** 2)))}],
    targets=each_actuator,
    signed=True,
    phrase="a constant force of an actuator",
)


ACTUATOR_RATE_LIMIT = Kind(
    name="actuator_rate_limit",
    path="actuator",
    parameters=lambda rig, _: (Parameter("rate", "N/s", 1e-300, 1e300, logarithmic=True),),
    apply=_set("actuators", "rate", "rate_limit"),
    starts=_quantiles("rate", 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, of_rates=True),
    targets=or_all(each_actuator),
    nonlinear=True,
    phrase="a rate limit of the actuators",
)


def _hysteresis_starts(reconstruction: Reconstruction, target: str) -> list[dict[str, float]]:
    widths = np.quantile(_commands(reconstruction, target), (0.2, 0.5, 0.8))
    return [{"share": share, "width": float(width)} for width in widths for share in (0.1, 0.4)]


ACTUATOR_HYSTERESIS = Kind(
    name="actuator_hysteresis",
    path="actuator",
    parameters=lambda rig, _: (
        Parameter("share", "", 1e-4, 1.0, scale=0.1, neutral=0.0),
        Parameter("width", "N", 1e-300, 1e300, logarithmic=True),
    ),
    apply=lambda rig, name, v: _change_actuators(rig, name, hysteresis_share=v["share"], hysteresis_width=v["width"]),
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
    """Linear response (n_sensors, n_samples) of each record per share of the second input's command in the first."""
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
    noise = np.array([*_noise(reconstruction.rig).values()])[:, None]
    change = np.concatenate([(y / noise).ravel() for y in _responses_to_share(reconstruction, pair)])
    return _share_start(np.concatenate([(y / noise).ravel() for y in reconstruction.residuals]), change)


def _with_share(rig: Rig, pair: tuple[str, str], share: float) -> Rig:
    """The rig with a share of the second input's command added to that of the first."""
    taken = next(a.crosstalk for a in rig.actuators if a.name == pair[0])
    return _change_actuators(rig, pair[0], crosstalk=(*taken, (pair[1], share)))


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


def _movable(targets: Targets) -> Targets:
    """Targets that may be misplaced: none if the mode shapes are known at the inputs and outputs only."""

    def movable(rig: Rig) -> tuple[str, ...]:
        domain = rig.modes.domain
        points_alone = isinstance(domain, NamedPoints) and len(domain.names) <= len(rig.actuators) + len(rig.sensors)
        return () if points_alone else targets(rig)

    return movable


def _nominal_place(rig: Rig, target: str) -> Location:
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


SENSOR_GAIN = Kind(
    name="sensor_gain",
    path="sensor",
    parameters=lambda rig, _: (Parameter("gain", "", -100.0, 100.0, scale=0.1, neutral=1.0),),
    apply=lambda rig, target, v: _with_gain(rig, "sensors", target, v["gain"]),
    starts=lambda reconstruction, _: [{"gain": 0.9}],
    targets=each_sensor,
    signed=True,
    phrase="a sensor gain error",
)


def _residual(reconstruction: Reconstruction, name: str) -> np.ndarray:
    """Residual (n_samples,) of a sensor over all records, joined."""
    j = each_sensor(reconstruction.rig).index(name)
    return np.concatenate([residual[j] for residual in reconstruction.residuals])


SENSOR_BIAS = Kind(
    name="sensor_bias",
    path="sensor",
    parameters=_reading("bias"),
    apply=_set("sensors", "bias"),
    starts=lambda reconstruction, target: [{"bias": float(np.mean(_residual(reconstruction, target)))}],
    targets=each_sensor,
    signed=True,
    phrase="a sensor bias",
)

SENSOR_DRIFT = Kind(
    name="sensor_drift",
    path="sensor",
    parameters=_reading("drift_over_record"),
    apply=_set("sensors", "drift_over_record", "drift"),
    starts=lambda force, target: [{"drift_over_record": 2.0 * float(np.mean(_residual(force, target)))}],
    targets=each_sensor,
    signed=True,
    phrase="a sensor drift",
)

SENSOR_LAG = Kind(
    name="sensor_lag",
    path="sensor",
    parameters=_time("time_constant", 1e-6),
    apply=_set("sensors", "time_constant"),
    starts=_in_samples("time_constant", 0.1, 0.4, 1.2, 4.0, 12.0),
    targets=or_all(each_sensor),
    phrase="a lag of the sensors",
)

SENSOR_DELAY = Kind(
    name="sensor_delay",
    path="sensor",
    parameters=_time("delay", 1e-9),
    apply=_set("sensors", "delay"),
    starts=_in_samples("delay", 0.1, 0.4, 0.8, 1.3, 2.5, 5.0),
    targets=each_sensor,
    phrase="a delay of a sensor",
)


def _predicted(reconstruction: Reconstruction, name: str) -> np.ndarray:
    """Prediction (n_samples,) of a sensor's readings over all records, joined."""
    j = each_sensor(reconstruction.rig).index(name)
    records = zip(reconstruction.data.counted, reconstruction.residuals, strict=True)
    return np.concatenate([record.outputs[j] - residual[j] for record, residual in records])


def _crosstalk_starts(reconstruction: Reconstruction, pair: tuple[str, str]) -> list[dict[str, float]]:
    """Share of the second sensor's prediction in the residual of the first, if that explains enough of it."""
    return _share_start(_residual(reconstruction, pair[0]), _predicted(reconstruction, pair[1]))


def _share_start(residual: Floats, response: Floats) -> list[dict[str, float]]:
    """The least-squares share of a response in a residual, if it explains enough of it."""
    power = float(response @ response)
    share = float(residual @ response) / power if power > 0 else 0.0
    return [{"share": share}] if share**2 * power > LEAST_CROSSTALK * float(residual @ residual) else []


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
        error = _predicted(reconstruction, name) + residual - _predicted(reconstruction, other)
        own += float(residual @ residual) / noise[name] ** 2
        crossed += float(np.sum(error**2)) / noise[name] ** 2
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
    """Whether readings (n_samples,) come to rest, or reverse, where they are `at_top` instead of being cut off there.

    A motion that comes to rest slows down first, and stays longer than its deceleration would have taken it up and
    back. A motion that a controller repeats reverses at the same top and hardly stays there.
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


SENSOR_CLIPPING = Kind(
    name="sensor_clipping",
    path="sensor",
    parameters=_reading("limit", is_positive=True),
    apply=_set("sensors", "limit"),
    starts=_read("limit", clipped_level),
    targets=each_sensor,
    nonlinear=True,
    found_in="readings",
    phrase="clipping of a sensor",
)

SENSOR_QUANTISATION = Kind(
    name="sensor_quantisation",
    path="sensor",
    parameters=_reading("step", is_positive=True),
    apply=_set("sensors", "step"),
    starts=_read("step", lambda rows: step_of(np.concatenate(rows))),
    targets=each_sensor,
    nonlinear=True,
    found_in="readings",
    unpredictable="Quantisation leaves an unpredictable error of step/√12 rms.",
    phrase="quantisation of a sensor",
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
