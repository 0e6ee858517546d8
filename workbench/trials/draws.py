"""Random hidden effects: a kind, a place, and a strength at which the gap is detectable.

The draw of a kind returns the parameters of an effect, or a function from a strength near 1 to the parameters.
Truncated modes are drawn with the bench, from whose nominal model they are removed.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from workbench.rig.rig import Transducer
from workbench.rig.sensors import Sensor
from workbench.structure.domain import Between, Interval, Location, NamedPoints, Rectangle, middle
from workbench.structure.member import Beam, Structure
from workbench.structure.supports import HELD
from workbench.trials.benches import Scene, Unsuitable
from workbench.trials.finite_elements import BucklingError
from workbench.trials.hidden import hide
from workbench.trials.laws import POINT_LAWS, PointSizes, Strengths

Numbers = dict[str, Any]
OfStrength = Callable[[float], Numbers]
Draw = Callable[[Scene, np.random.Generator], Numbers | OfStrength]


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _factor(name: str, size: float) -> Draw:
    def draw(scene: Scene, rng: np.random.Generator) -> OfStrength:
        sign = _sign(rng)
        return lambda s: {name: float(np.exp(sign * size * s))}

    return draw


def _typical_stiffness(scene: Scene) -> float:
    """A typical stiffness at a point, N/m: that of the first elastic mode."""
    modes = scene.rig.modes
    first = int(np.argmax(modes.omega > 0))
    domain = modes.domain
    places = np.linspace(0.0, 1.0, 41) * domain.size if isinstance(domain, Interval) else domain.grid(24)
    shape = modes.phi(places)[:, first]
    return float(modes.omega[first] ** 2 / np.max(shape**2))


def _place(where: Location) -> Numbers:
    """A place in the case format."""
    if isinstance(where, Between):
        return {"between": list(where)}
    return {"at": list(where) if isinstance(where, tuple) else where}


def _at_point(make: Callable[[PointSizes, np.random.Generator], Strengths]) -> Draw:
    """The draw of an effect at a point, or between two, from the typical sizes there."""

    def draw(scene: Scene, rng: np.random.Generator) -> OfStrength:
        where = scene.place(rng, between=True)
        w, v = map(_rms, scene.motion_at(where))
        law = make(PointSizes(_typical_stiffness(scene), w, v, scene.bench.level), rng)
        return lambda s: {**_place(where), **law(s)}

    return draw


def _member(scene: Scene) -> Structure:
    member = scene.rig.structure
    if not isinstance(member, Structure):
        raise Unsuitable("only a beam or a rod shows this")
    return member


def _beam(scene: Scene) -> tuple[Beam, float]:
    """The beam, and its bending stiffness at midspan, N m²."""
    member = scene.rig.structure
    if not isinstance(member, Beam):
        raise Unsuitable("only a beam shows this")
    return member, float(member.bending_stiffness(np.array([0.5 * member.length]))[0])


def _modal_damping(scene: Scene) -> float:
    """2 ζ ω of the first elastic mode, 1/s."""
    modes = scene.rig.modes
    return float(2.0 * modes.zeta[0] * modes.omega[modes.omega > 0][0])


def _stiffness_loss(scene: Scene, rng: np.random.Generator) -> OfStrength:
    length = _member(scene).length
    width = round(float(rng.uniform(0.05, 0.2)) * length, 4)
    at = round(float(rng.uniform(0.5 * width + 0.02 * length, 0.9 * length - 0.5 * width)), 4)
    return lambda s: {"at": at, "width": width, "loss": 1.0 - float(np.exp(-0.2 * s))}


def _support(scene: Scene, rng: np.random.Generator) -> OfStrength:
    member, stiffness = _beam(scene)
    ends = [(0.0, member.left), (member.length, member.right)]
    ends = [(at, end) for at, end in ends if end.translation == HELD]
    at, end = ends[rng.integers(len(ends))]
    typical = stiffness / member.length
    if end.rotation == HELD:
        return lambda s: {"at": at, "rotational_stiffness": 20.0 * typical / s}
    return lambda s: {"at": at, "rotational_stiffness": 0.5 * typical * s}


def _axial(scene: Scene, rng: np.random.Generator) -> OfStrength:
    (member, stiffness), sign = _beam(scene), _sign(rng)
    return lambda s: {"tension": sign * 0.2 * s * (stiffness / member.length**2)}


def _stretching(scene: Scene, rng: np.random.Generator) -> OfStrength:
    modes, (member, stiffness) = scene.rig.modes, _beam(scene)
    if not (member.left.translation == HELD and member.right.translation == HELD):
        raise Unsuitable("the midplane stretches only between ends held in translation")
    grid = np.linspace(0.0, 1.0, 101) * modes.length
    slopes = modes.phi(grid, 1) @ scene.moved[0].T
    size = float(np.mean(slopes**2)) * modes.length
    return lambda s: {"coefficient": s * (stiffness / modes.length**2) / size}


def _drag(scene: Scene, rng: np.random.Generator) -> OfStrength:
    modes, member = scene.rig.modes, _member(scene)
    grid = np.linspace(0.0, 1.0, 101) * modes.length
    speed, damping = _rms(modes.phi(grid) @ scene.moved[1].T), _modal_damping(scene)
    mass = float(np.mean(member.mass_per_length(grid[1:-1])))
    return lambda s: {"coefficient": 0.5 * s * mass * damping / speed}


def _damper(scene: Scene, rng: np.random.Generator) -> OfStrength:
    where, damping = scene.place(rng, between=True), _modal_damping(scene)
    shape = float(np.abs(scene.rig.modes.phi_at(where)).max())
    return lambda s: {**_place(where), "coefficient": s * damping / shape**2}


def _mass(scene: Scene, rng: np.random.Generator) -> OfStrength:
    at = scene.place(rng)
    shape = float(np.abs(scene.rig.modes.phi(at)[0]).max())
    return lambda s: {**_place(at), "mass": 0.01 * s / shape**2}


def _one_or_all(names: Sequence[str], rng: np.random.Generator, every: float = 0.6) -> str:
    """The name of one channel, or "all" with probability `every`."""
    return "all" if rng.random() < every else str(rng.choice(names))


def _drive(name: str, number: Callable[[Scene, float], float], *, every: float = 0.6, signed: bool = False) -> Draw:
    """The draw of an effect on all actuators or one, with a number that depends on a strength, of either sign."""

    def draw(scene: Scene, rng: np.random.Generator) -> OfStrength:
        which = _one_or_all(scene.acting, rng, every)
        sign = _sign(rng) if signed else 1.0
        return lambda s: {"input": which, name: float(number(scene, sign * s))}

    return draw


def _rate_limit(scene: Scene, strength: float) -> float:
    """A rate limit at most twice the 0.9 quantile of the command's rate: above, readings show a delay and no more."""
    rates = np.abs(np.diff(scene.commands[0])) / scene.bench.sample_time
    return float(np.quantile(rates, 0.9)) / max(strength, 0.5)


def _late(scene: Scene, strength: float) -> float:
    """A delay, s, of about half a sample and at least a twentieth: an accelerometer shows any delay as a jump."""
    return max(0.5 * strength, 0.05) * scene.bench.sample_time


def _hysteresis(scene: Scene, rng: np.random.Generator) -> OfStrength:
    which = _one_or_all(scene.acting, rng)
    width = float(rng.uniform(0.3, 1.0)) * _rms(scene.commands[0])
    return lambda s: {"input": which, "share": float(-np.expm1(-0.3 * s)), "width": width}


def _swapped_inputs(scene: Scene, rng: np.random.Generator) -> Numbers:
    pair = sorted(str(name) for name in rng.choice(scene.acting, 2, replace=False))
    return {"input": pair[0], "with": pair[1]}


def _swapped_outputs(scene: Scene, rng: np.random.Generator) -> Numbers:
    sensors = scene.rig.sensors
    alike = [(a.name, b.name) for a, b in combinations(sensors, 2) if a.quantity == b.quantity]
    if not alike:
        raise Unsuitable("no two sensors measure the same quantity")
    pair = alike[rng.integers(len(alike))]
    return {"output": pair[0], "with": pair[1]}


def _sensor_crosstalk(scene: Scene, rng: np.random.Generator) -> OfStrength:
    row, source = rng.choice(len(scene.rig.sensors), 2, replace=False)
    names, sign = [s.name for s in scene.rig.sensors], _sign(rng)
    ratio = float(scene.outputs[row].std() / scene.outputs[source].std())
    return lambda s: {"output": names[row], "from": names[source], "share": sign * 0.2 * s * ratio}


def _moved(side: str, scene: Scene, rng: np.random.Generator) -> Numbers:
    """The draw of a misplaced actuator (side "input") or sensor ("output")."""
    rig, domain = scene.rig, scene.rig.modes.domain
    transducers: Sequence[Transducer] = rig.sensors if side == "output" else [a for a in rig.actuators if not a.direct]
    transducer = transducers[int(rng.integers(len(transducers)))]
    if isinstance(domain, NamedPoints):
        if domain.positions is None:
            return {
                side: transducer.name,
                "at": str(rng.choice([name for name in domain.names if name != transducer.at])),
            }
        at = scene.place(rng)
        if at == transducer.at:
            raise Unsuitable("the actuator or sensor would stay at its place")
        return {side: transducer.name, "at": at}
    lengths, stated = np.atleast_1d(domain.length), np.atleast_1d(np.asarray(middle(transducer.at), float))
    if isinstance(domain, Rectangle):
        angle = float(rng.uniform(0.0, 2.0 * np.pi))
        direction = np.array([np.cos(angle), np.sin(angle)])
    else:
        direction = np.array([_sign(rng)])
    step = direction * float(rng.uniform(0.03, 0.25)) * domain.size
    for moved in (stated + step, stated - step):
        if ((0.02 * lengths < moved) & (moved < lengths)).all():
            place = np.round(moved, 4).tolist()
            return {side: transducer.name, "at": place if isinstance(domain, Rectangle) else place[0]}
    raise Unsuitable("the actuator or sensor would leave the structure")


def _sensor(scene: Scene, rng: np.random.Generator) -> tuple[Sensor, np.ndarray]:
    """A random sensor, and its nominal readings."""
    row = int(rng.integers(len(scene.rig.sensors)))
    return scene.rig.sensors[row], scene.outputs[row]


def _reading(name: str, number: Callable[[Scene, np.ndarray, float], float], *, signed: bool = False) -> Draw:
    """The draw of an effect on a sensor, with a number that depends on its readings and a strength, of either sign."""

    def draw(scene: Scene, rng: np.random.Generator) -> OfStrength:
        sensor, y = _sensor(scene, rng)
        sign = _sign(rng) if signed else 1.0
        return lambda s: {"output": sensor.name, name: float(number(scene, y, sign * s))}

    return draw


def _gain(logarithm: float) -> float:
    """A gain between 1/30 and 30: beyond, a channel in another unit is likelier, and a diagnosis asks for the unit."""
    return float(np.exp(np.clip(logarithm, -np.log(30.0), np.log(30.0))))


def _quantisation(scene: Scene, rng: np.random.Generator) -> Numbers:
    sensor, y = _sensor(scene, rng)
    step = float(f"{min(rng.uniform(4.0, 12.0) * sensor.noise_std, 0.3 * y.std()):.3g}")
    if step < 2.0 * sensor.noise_std:
        raise Unsuitable("the noise exceeds the quantisation step")
    return {"output": sensor.name, "step": step}


def _sensor_lag(scene: Scene, rng: np.random.Generator) -> OfStrength:
    which = _one_or_all([s.name for s in scene.rig.sensors], rng)
    return lambda s: {"output": which, "time_constant": _late(scene, s)}


def _periodic_force(scene: Scene, rng: np.random.Generator) -> OfStrength:
    at = scene.place(rng)
    frequency, phase = float(rng.uniform(0.1, 1.0)) * scene.bench.band_hz, float(rng.uniform(-np.pi, np.pi))
    return lambda s: {**_place(at), "frequency": frequency, "amplitude": 0.05 * s * scene.bench.level, "phase": phase}


def _random_force(scene: Scene, rng: np.random.Generator) -> OfStrength:
    at, corner = scene.place(rng), float(rng.uniform(0.6, 2.0)) * scene.bench.band_hz
    return lambda s: {**_place(at), "rms": 0.1 * s * scene.bench.level, "corner": corner}


def _drift(scene: Scene, rng: np.random.Generator) -> OfStrength:
    duration, sign = scene.commands.shape[1] * scene.bench.sample_time, _sign(rng)
    return lambda s: {"rate": sign * min(0.02 * s, 0.5) / duration}


def _actuator_crosstalk(scene: Scene, rng: np.random.Generator) -> OfStrength:
    first, second = rng.choice(scene.acting, 2, replace=False)
    sign = _sign(rng)
    return lambda s: {"input": str(first), "from": str(second), "share": sign * 0.2 * s}


def _hum(scene: Scene, rng: np.random.Generator) -> OfStrength:
    (sensor, y), frequency = _sensor(scene, rng), float(rng.uniform(0.2, 2.0)) * scene.bench.band_hz
    return lambda s: {"output": sensor.name, "frequency": frequency, "amplitude": 0.3 * s * float(y.std())}


def _spikes(scene: Scene, rng: np.random.Generator) -> OfStrength:
    (sensor, y), every = _sensor(scene, rng), int(rng.integers(60, 300))
    return lambda s: {"output": sensor.name, "every": every, "amplitude": 2.0 * s * float(y.std())}


DRAWS: dict[str, Draw] = {
    "modulus_error": _factor("factor", 0.02),
    "point_mass": _mass,
    "local_stiffness_loss": _stiffness_loss,
    "support_rotation": _support,
    "axial_load": _axial,
    "ground_spring": _at_point(lambda p, rng: lambda s: {"stiffness": 0.05 * s * p.stiffness}),
    **{name: _at_point(law.draw) for name, law in POINT_LAWS.items() if law.draw is not None},
    "modal_damping": _factor("factor", 0.3),
    "point_damper": _damper,
    "air_drag": _drag,
    "midplane_stretching": _stretching,
    "actuator_gain": _drive("gain", lambda c, x: _gain(0.2 * x), every=0.0, signed=True),
    "actuator_lag": _drive("time_constant", _late),
    "actuator_delay": _drive("delay", _late),
    "actuator_saturation": _drive("limit", lambda c, x: np.abs(c.commands).max() * np.exp(-0.5 * x)),
    "actuator_dead_zone": _drive("width", lambda c, x: 0.1 * x * _rms(c.commands[0])),
    "actuator_misplacement": partial(_moved, "input"),
    "actuator_hysteresis": _hysteresis,
    "actuator_bias": _drive("force", lambda c, x: 0.1 * x * c.bench.level, every=0.0, signed=True),
    "actuator_rate_limit": _drive("rate", _rate_limit),
    "swapped_inputs": _swapped_inputs,
    "sensor_gain": _reading("gain", lambda c, y, x: _gain(0.3 * x), signed=True),
    "sensor_bias": _reading("bias", lambda c, y, x: 0.3 * x * y.std(), signed=True),
    "sensor_drift": _reading("drift_over_record", lambda c, y, x: 0.5 * x * y.std(), signed=True),
    "sensor_lag": _sensor_lag,
    "sensor_misplacement": partial(_moved, "output"),
    "sensor_delay": _reading("delay", lambda c, y, x: _late(c, x)),
    "sensor_crosstalk": _sensor_crosstalk,
    "swapped_outputs": _swapped_outputs,
    "sensor_clipping": _reading("limit", lambda c, y, x: np.abs(y).max() * np.exp(-0.4 * x)),
    "sensor_quantisation": _quantisation,
    "periodic_disturbance": _periodic_force,
    "random_disturbance": _random_force,
    "stiffness_drift": _drift,
    "actuator_crosstalk": _actuator_crosstalk,
    "bent_command": lambda c, rng: lambda s: {"curvature": 0.2 * s / _rms(c.commands[0])},
    "bent_reading": _reading("curvature", lambda c, y, x: 0.2 * x / y.std(), signed=True),
    "hum": _hum,
    "spikes": _spikes,
}

SMALLEST, LARGEST = 0.02, 1.5  # gap
TRIES = 9


def draw_effect(kind: str, scene: Scene, rng: np.random.Generator) -> dict[str, Any]:
    """A random effect of a kind, in the case format, with a strength found by iteration for a random gap.

    Raises:
        Unsuitable: the kind is impossible on the bench, or no strength gives a gap between 2 and 150 %.
    """
    drawn = DRAWS[kind](scene, rng)
    if isinstance(drawn, dict):
        effect = {"kind": kind, **drawn}
        if kind != "sensor_quantisation" and not SMALLEST < _gap(effect, scene, rng) < LARGEST:
            raise Unsuitable(f"{kind}: the draw shows no gap")
        return effect
    target = float(np.exp(rng.uniform(np.log(0.04), np.log(0.5))))
    strength, last = 1.0, None
    for _ in range(TRIES):
        effect = {"kind": kind, **drawn(strength)}
        gap = _gap(effect, scene, rng)
        if 0.6 < gap / target < 1.7:
            return effect
        power = 1.0
        if last is not None and strength != last[0] and gap > 0 and last[1] > 0:
            power = float(np.clip(np.log(gap / last[1]) / np.log(strength / last[0]), 0.3, 3.0))
        last = (strength, gap)
        strength *= float(np.clip((target / max(gap, 1e-12)) ** (1.0 / power), 0.02, 50.0))
    if SMALLEST < gap < LARGEST:
        return effect
    raise Unsuitable(f"{kind}: no strength gives a detectable gap; the last was {gap:.2g}")


def _gap(effect: dict[str, Any], scene: Scene, rng: np.random.Generator) -> float:
    try:
        return scene.gap(hide(scene.bench.plant(), [effect]), rng)
    except (Unsuitable, BucklingError):
        return 1e3
