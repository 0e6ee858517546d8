"""Random hidden effects: a kind, a place, and a strength at which the gap is detectable.

The draw of a kind returns the parameters of an effect, or a function from a strength near 1 to the parameters.
Truncated modes are drawn with the bench, from whose nominal model they are removed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from workbench.rig.rig import Rig, Transducer
from workbench.rig.sensors import Sensor
from workbench.structure.domain import Between, Interval, Location, NamedPoints, Rectangle, middle
from workbench.structure.member import Beam, Structure
from workbench.structure.supports import HELD
from workbench.trials.benches import Bench, Unsuitable, relative_gap
from workbench.trials.finite_elements import BucklingError
from workbench.trials.hidden import hide
from workbench.trials.laws import POINT_LAWS, PointSizes, Strengths
from workbench.trials.plant import ModalMotion, Plant

DISTINCT = 0.1  # least sine of the angle between the modal force vectors at two named points
COARSE = 0.2  # radians of the highest mode in one step: accurate enough to draw a strength
SMALLEST, LARGEST = 0.02, 1.5  # gap
TRIES = 9


@dataclass(frozen=True, eq=False)
class NominalMotion:
    """A bench with the nominal motion at its middle level, from which strengths are drawn.

    Attributes:
        commands: (n_inputs, n_samples) of the middle level.
        moved: nominal modal motion.
        outputs: (n_outputs, n_samples) nominal readings.
    """

    bench: Bench
    commands: np.ndarray
    moved: ModalMotion
    outputs: np.ndarray

    @classmethod
    def of(cls, bench: Bench, commands: np.ndarray) -> "NominalMotion":
        nominal = bench.plant().solved()
        moved, _ = nominal.move(commands, bench.sample_time, finest=COARSE)
        return cls(bench, commands, moved, nominal.readings(moved, bench.sample_time))

    @property
    def rig(self) -> Rig:
        """The nominal rig."""
        return self.bench.rig

    @property
    def acting(self) -> list[str]:
        """Names of the actuators that follow commands."""
        return [a.name for a in self.rig.actuators if not a.direct]

    def motion_at(self, where: Location) -> tuple[np.ndarray, np.ndarray]:
        """Nominal displacement and velocity at a place, or between two, (n_samples,) each."""
        shape = self.rig.modes.phi_at(where)
        return self.moved[0] @ shape, self.moved[1] @ shape

    def place(self, rng: np.random.Generator, *, between: bool = False) -> Location:
        """A random place whose rms motion is at least a third of the largest.

        With `between`, half of the draws at named points are a pair `Between` two points.
        """
        domain = self.rig.modes.domain
        if isinstance(domain, NamedPoints):
            if domain.positions is not None:
                return self._distinct(rng, between and rng.random() < 0.5)
            grid: Any = np.array(domain.names)
        else:
            grid = domain.grid(24) if isinstance(domain, Rectangle) else np.linspace(0.05, 1.0, 96) * domain.size
        rms = np.sqrt(np.mean((self.rig.modes.phi(grid) @ self.moved[0].T) ** 2, axis=1))
        at = rng.choice(np.asarray(grid)[rms > rms.max() / 3])
        if isinstance(domain, NamedPoints):
            return str(at)
        if isinstance(domain, Rectangle):
            moved = at + rng.uniform(-0.02, 0.02, 2) * domain.length
            x, y = np.clip(moved, 0.0, domain.length)
            return round(float(x), 4), round(float(y), 4)
        return round(float(at) - float(rng.uniform(0.0, 0.01)) * domain.size, 4)

    def _distinct(self, rng: np.random.Generator, between: bool) -> Location:
        """A random named point, or pair of points, whose modal force vector is not nearly parallel to another one.

        A force at a place with a parallel vector (weighted by the modal velocities) and another strength explains the
        records equally well, so that the place of an effect would not be identifiable.
        """
        modes = self.rig.modes
        points = modes.domain
        assert isinstance(points, NamedPoints)
        alone, pairs = list(points.grid()), list(points.pairs())
        index = {name: i for i, name in enumerate(alone)}
        at_points = modes.phi(alone) * np.sqrt(np.mean(self.moved[1] ** 2, axis=0))
        ends = np.array([[index[str(pair.first)], index[str(pair.second)]] for pair in pairs]).reshape(-1, 2)
        felt = np.vstack([at_points, at_points[ends[:, 0]] - at_points[ends[:, 1]]])
        size = np.linalg.norm(felt, axis=1)
        places: list[Location] = [*alone, *pairs]
        wanted = np.arange(size.size) >= len(alone) if between else np.arange(size.size) < len(alone)
        lively = np.flatnonzero(wanted & (size > size[wanted].max() / 3))
        unit = felt / np.maximum(size, 1e-300)[:, None]
        for i in map(int, rng.permutation(lively)):
            cosine = np.abs(unit @ unit[i])
            cosine[i] = 0.0
            if np.sqrt(np.maximum(1.0 - cosine.max() ** 2, 0.0)) > DISTINCT:
                return places[i]
        raise Unsuitable("no two places are distinguishable by their mode shapes")

    def gap(self, plant: Plant, rng: np.random.Generator, reference: Plant | None = None) -> float:
        """Noise-free gap between a plant and the nominal one (or the reference) at the middle level.

        Raises:
            Unsuitable: the response diverges.
        """
        measured = self._readings(plant, rng)
        predicted = self.outputs if reference is None else self._readings(reference, rng)
        gap = relative_gap(measured - predicted, measured)
        if not np.isfinite(gap):
            raise Unsuitable("the response diverges")
        return gap

    def _readings(self, plant: Plant, rng: np.random.Generator) -> np.ndarray:
        solved, own = plant.solved(), np.random.default_rng(rng.integers(2**31))
        moved, _ = solved.move(self.commands, self.bench.sample_time, rng=own, finest=COARSE)
        return solved.readings(moved, self.bench.sample_time)


Numbers = dict[str, Any]
OfStrength = Callable[[float], Numbers]
Draw = Callable[[NominalMotion, np.random.Generator], Numbers | OfStrength]


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _factor(name: str, size: float) -> Draw:
    def draw(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
        sign = _sign(rng)
        return lambda s: {name: float(np.exp(sign * size * s))}

    return draw


def _typical_stiffness(nominal: NominalMotion) -> float:
    """A typical stiffness at a point, N/m: that of the first elastic mode."""
    modes = nominal.rig.modes
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

    def draw(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
        where = nominal.place(rng, between=True)
        w, v = map(_rms, nominal.motion_at(where))
        law = make(PointSizes(_typical_stiffness(nominal), w, v, nominal.bench.level), rng)
        return lambda s: {**_place(where), **law(s)}

    return draw


def _member(nominal: NominalMotion) -> Structure:
    member = nominal.rig.structure
    if not isinstance(member, Structure):
        raise Unsuitable("only a beam or a rod shows this")
    return member


def _beam(nominal: NominalMotion) -> tuple[Beam, float]:
    """The beam, and its bending stiffness at midspan, N m²."""
    member = nominal.rig.structure
    if not isinstance(member, Beam):
        raise Unsuitable("only a beam shows this")
    return member, float(member.bending_stiffness(np.array([0.5 * member.length]))[0])


def _modal_damping(nominal: NominalMotion) -> float:
    """2 ζ ω of the first elastic mode, 1/s."""
    modes = nominal.rig.modes
    return float(2.0 * modes.zeta[0] * modes.omega[modes.omega > 0][0])


def _stiffness_loss(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    length = _member(nominal).length
    width = round(float(rng.uniform(0.05, 0.2)) * length, 4)
    at = round(float(rng.uniform(0.5 * width + 0.02 * length, 0.9 * length - 0.5 * width)), 4)
    return lambda s: {"at": at, "width": width, "loss": 1.0 - float(np.exp(-0.2 * s))}


def _support(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    member, stiffness = _beam(nominal)
    ends = [(0.0, member.left), (member.length, member.right)]
    ends = [(at, end) for at, end in ends if end.translation == HELD]
    at, end = ends[rng.integers(len(ends))]
    typical = stiffness / member.length
    if end.rotation == HELD:
        return lambda s: {"at": at, "rotational_stiffness": 20.0 * typical / s}
    return lambda s: {"at": at, "rotational_stiffness": 0.5 * typical * s}


def _axial(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    (member, stiffness), sign = _beam(nominal), _sign(rng)
    return lambda s: {"tension": sign * 0.2 * s * (stiffness / member.length**2)}


def _stretching(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    modes, (member, stiffness) = nominal.rig.modes, _beam(nominal)
    if not (member.left.translation == HELD and member.right.translation == HELD):
        raise Unsuitable("the midplane stretches only between ends held in translation")
    grid = np.linspace(0.0, 1.0, 101) * modes.length
    slopes = modes.phi(grid, 1) @ nominal.moved[0].T
    size = float(np.mean(slopes**2)) * modes.length
    return lambda s: {"coefficient": s * (stiffness / modes.length**2) / size}


def _drag(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    modes, member = nominal.rig.modes, _member(nominal)
    grid = np.linspace(0.0, 1.0, 101) * modes.length
    speed, damping = _rms(modes.phi(grid) @ nominal.moved[1].T), _modal_damping(nominal)
    mass = float(np.mean(member.mass_per_length(grid[1:-1])))
    return lambda s: {"coefficient": 0.5 * s * mass * damping / speed}


def _damper(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    where, damping = nominal.place(rng, between=True), _modal_damping(nominal)
    shape = float(np.abs(nominal.rig.modes.phi_at(where)).max())
    return lambda s: {**_place(where), "coefficient": s * damping / shape**2}


def _mass(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    at = nominal.place(rng)
    shape = float(np.abs(nominal.rig.modes.phi(at)[0]).max())
    return lambda s: {**_place(at), "mass": 0.01 * s / shape**2}


def _one_or_all(names: Sequence[str], rng: np.random.Generator, every: float = 0.6) -> str:
    """The name of one channel, or "all" with probability `every`."""
    return "all" if rng.random() < every else str(rng.choice(names))


def _drive(
    name: str, number: Callable[[NominalMotion, float], float], every: float = 0.6, signed: bool = False
) -> Draw:
    """The draw of an effect on all actuators or one, with a number that depends on a strength, of either sign."""

    def draw(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
        which = _one_or_all(nominal.acting, rng, every)
        sign = _sign(rng) if signed else 1.0
        return lambda s: {"input": which, name: float(number(nominal, sign * s))}

    return draw


def _rate_limit(nominal: NominalMotion, strength: float) -> float:
    """A rate limit at most twice the 0.9 quantile of the command's rate: above, readings show a delay and no more."""
    rates = np.abs(np.diff(nominal.commands[0])) / nominal.bench.sample_time
    return float(np.quantile(rates, 0.9)) / max(strength, 0.5)


def _late(nominal: NominalMotion, strength: float) -> float:
    """A delay, s, of about half a sample and at least a twentieth: an accelerometer shows any delay as a jump."""
    return max(0.5 * strength, 0.05) * nominal.bench.sample_time


def _hysteresis(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    which = _one_or_all(nominal.acting, rng)
    width = float(rng.uniform(0.3, 1.0)) * _rms(nominal.commands[0])
    return lambda s: {"input": which, "share": float(-np.expm1(-0.3 * s)), "width": width}


def _swapped_inputs(nominal: NominalMotion, rng: np.random.Generator) -> Numbers:
    pair = sorted(str(name) for name in rng.choice(nominal.acting, 2, replace=False))
    return {"input": pair[0], "with": pair[1]}


def _swapped_outputs(nominal: NominalMotion, rng: np.random.Generator) -> Numbers:
    sensors = nominal.rig.sensors
    alike = [(a.name, b.name) for a, b in combinations(sensors, 2) if a.quantity == b.quantity]
    if not alike:
        raise Unsuitable("no two sensors measure the same quantity")
    pair = alike[rng.integers(len(alike))]
    return {"output": pair[0], "with": pair[1]}


def _sensor_crosstalk(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    row, source = rng.choice(len(nominal.rig.sensors), 2, replace=False)
    names, sign = [s.name for s in nominal.rig.sensors], _sign(rng)
    ratio = float(nominal.outputs[row].std() / nominal.outputs[source].std())
    return lambda s: {"output": names[row], "from": names[source], "share": sign * 0.2 * s * ratio}


def _moved(side: str, nominal: NominalMotion, rng: np.random.Generator) -> Numbers:
    """The draw of a misplaced actuator (side "input") or sensor ("output")."""
    rig, domain = nominal.rig, nominal.rig.modes.domain
    transducers: Sequence[Transducer] = rig.sensors if side == "output" else [a for a in rig.actuators if not a.direct]
    transducer = transducers[int(rng.integers(len(transducers)))]
    if isinstance(domain, NamedPoints):
        if domain.positions is None:
            others = [name for name in domain.names if name != transducer.at]
            return {side: transducer.name, "at": str(rng.choice(others))}
        at = nominal.place(rng)
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


def _sensor(nominal: NominalMotion, rng: np.random.Generator) -> tuple[Sensor, np.ndarray]:
    """A random sensor, and its nominal readings."""
    row = int(rng.integers(len(nominal.rig.sensors)))
    return nominal.rig.sensors[row], nominal.outputs[row]


def _reading(name: str, number: Callable[[NominalMotion, np.ndarray, float], float], *, signed: bool = False) -> Draw:
    """The draw of an effect on a sensor, with a number that depends on its readings and a strength, of either sign."""

    def draw(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
        sensor, y = _sensor(nominal, rng)
        sign = _sign(rng) if signed else 1.0
        return lambda s: {"output": sensor.name, name: float(number(nominal, y, sign * s))}

    return draw


def _gain(logarithm: float) -> float:
    """A gain between 1/30 and 30: beyond, a channel in another unit is likelier, and a diagnosis asks for the unit."""
    return float(np.exp(np.clip(logarithm, -np.log(30.0), np.log(30.0))))


def _quantisation(nominal: NominalMotion, rng: np.random.Generator) -> Numbers:
    sensor, y = _sensor(nominal, rng)
    step = float(f"{min(rng.uniform(4.0, 12.0) * sensor.noise_std, 0.3 * y.std()):.3g}")
    if step < 2.0 * sensor.noise_std:
        raise Unsuitable("the noise exceeds the quantisation step")
    return {"output": sensor.name, "step": step}


def _sensor_lag(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    which = _one_or_all([s.name for s in nominal.rig.sensors], rng)
    return lambda s: {"output": which, "time_constant": _late(nominal, s)}


def _periodic_force(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    at = nominal.place(rng)
    frequency, phase = float(rng.uniform(0.1, 1.0)) * nominal.bench.band_hz, float(rng.uniform(-np.pi, np.pi))
    return lambda s: {**_place(at), "frequency": frequency, "amplitude": 0.05 * s * nominal.bench.level, "phase": phase}


def _random_force(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    at, corner = nominal.place(rng), float(rng.uniform(0.6, 2.0)) * nominal.bench.band_hz
    return lambda s: {**_place(at), "rms": 0.1 * s * nominal.bench.level, "corner": corner}


def _drift(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    duration, sign = nominal.commands.shape[1] * nominal.bench.sample_time, _sign(rng)
    return lambda s: {"rate": sign * min(0.02 * s, 0.5) / duration}


def _actuator_crosstalk(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    first, second = rng.choice(nominal.acting, 2, replace=False)
    sign = _sign(rng)
    return lambda s: {"input": str(first), "from": str(second), "share": sign * 0.2 * s}


def _hum(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    (sensor, y), frequency = _sensor(nominal, rng), float(rng.uniform(0.2, 2.0)) * nominal.bench.band_hz
    return lambda s: {"output": sensor.name, "frequency": frequency, "amplitude": 0.3 * s * float(y.std())}


def _spikes(nominal: NominalMotion, rng: np.random.Generator) -> OfStrength:
    (sensor, y), every = _sensor(nominal, rng), int(rng.integers(60, 300))
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


def draw_effect(kind: str, nominal: NominalMotion, rng: np.random.Generator) -> dict[str, Any]:
    """A random effect of a kind, in the case format, with a strength found by iteration for a random gap.

    Raises:
        Unsuitable: the kind is impossible on the bench, or no strength gives a gap between 2 and 150 %.
    """
    drawn = DRAWS[kind](nominal, rng)
    if isinstance(drawn, dict):
        effect = {"kind": kind, **drawn}
        if kind != "sensor_quantisation" and not SMALLEST < _gap(effect, nominal, rng) < LARGEST:
            raise Unsuitable(f"{kind}: the draw shows no gap")
        return effect
    target = float(np.exp(rng.uniform(np.log(0.04), np.log(0.5))))
    strength, last = 1.0, None
    for _ in range(TRIES):
        effect = {"kind": kind, **drawn(strength)}
        gap = _gap(effect, nominal, rng)
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


def _gap(effect: dict[str, Any], nominal: NominalMotion, rng: np.random.Generator) -> float:
    try:
        return nominal.gap(hide(nominal.bench.plant(), [effect]), rng)
    except (Unsuitable, BucklingError):
        return 1e3
