"""Errors of the nominal model: small ones, with normal priors, beside every effect; figures that differ by record."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
from scipy.linalg import block_diag, expm

from workbench.arrays import Floats
from workbench.gap.effects.effect import Effect, Kind, Parameter
from workbench.gap.effects.structural import (
    AXIAL_LOAD,
    MODULUS_ERROR,
    RESOLUTION,
    buckling_load,
    modes_of,
    solved_once,
    stiffness_name,
)
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig, derivative_of, shape_of
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints, centred_at, middle, reach
from workbench.structure.member import Beam, Structure
from workbench.structure.modes import Modes, PointShapes, Shapes
from workbench.structure.profile import Profile

STIFFNESS, TENSION = "stiffness", "axial load"  # the first stands for all that warmth does to a modulus too
FEW = 9  # cosines that may be as large as one another; of more, those beyond SMOOTH half waves fall off by the square,
SMOOTH = 3  # as those of any function do that has a slope at its ends
PROFILE_UNIT, RATIO_UNIT, DELAY_UNIT = 0.01, 0.1, 0.1  # of free coordinates: relative, of a logarithm, of a sample
PLACE_UNIT = 0.001  # likewise, of the extent
MOST_AHEAD = 0.9  # of a sample: the timing of a sensor is off by no more
JUST_LATE = 1e-3  # of a sample: later, an accelerometer reads what was before a jump
SURE = 1e-9  # of the largest variance of errors, each in units of its own: less is no doubt
LITTLE, STRONG = 0.25, 25.0  # radians by which a coupling of one turns two modes: less is none, more is no small error
WIDEST = 8.0  # prior deviations: bounds, far outside of what a nominal model can be off by
PROFILE_LEAST = 0.02  # what errors of a profile are believed to be before any record


@dataclass(frozen=True)
class NominalPrior:
    """Prior standard deviations of what may be a little off in a nominal model; 0 for what is exact.

    Attributes:
        stiffness, mass: relative, of each cosine along a structure whose profiles are known; of the modal mass else.
        frequency: relative, of each natural frequency by itself.
        coupling: of each two modes by an uneven stiffness, over the root of the product of their own; of a rigid mode
            and an elastic one by an uneven mass, over the modal mass.
        damping: of the logarithm of each damping ratio.
        delay: of each sensor, in samples.
        gain: relative, of each actuator and each sensor, as far as they were calibrated.
        place: of each actuator and each sensor, in each coordinate, as a share of the structure's extent.
        shape: of each mode at each actuator and each sensor, over the rms of that mode at all of them.
        record: of a figure that differs from record to record, about a common value; see `record_to_record`.
        sample_time: s.
        late, early: names of the sensors whose delay is positive, or at most zero: where inputs are held, acceleration
            jumps at each sample, and no small step leads from one side to the other.
        interpolated: whether sensors are late by straight lines between their samples: then nothing jumps.
        waves: cosines of a smooth variation along the structure, the constant among them.
        records, figure: names of the records between which a figure differs, and which.
        by_mode: whether modes are off one by one.
    """

    stiffness: float = 0.0
    mass: float = 0.0
    frequency: float = 0.0
    coupling: float = 0.0
    damping: float = 0.0
    delay: float = 0.0
    gain: float = 0.0
    place: float = 0.0
    shape: float = 0.0
    record: float = 0.0
    sample_time: float = 1.0
    late: tuple[str, ...] = ()
    early: tuple[str, ...] = ()
    interpolated: bool = False
    waves: int = 9
    records: tuple[str, ...] = ()
    figure: str = STIFFNESS
    by_mode: bool = False

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the groups that are uncertain."""
        return tuple(name for name in GROUPS if getattr(self, name) > 0)


GROUPS = ("stiffness", "mass", "frequency", "coupling", "damping", "delay", "gain", "place", "shape", "record")
OUTSIDE = ("delay", "gain", "place", "shape", "record")  # groups that leave the modes as they are


@lru_cache(maxsize=4096)
def group_of(parameter: str) -> str:
    """The group that a parameter of the nominal errors belongs to."""
    return parameter.split("_", 1)[0]


def weight_of(parameter: str, prior: NominalPrior) -> float:
    """Prior standard deviation of a parameter over that of its group."""
    if prior.waves <= FEW or group_of(parameter) not in ("stiffness", "mass"):
        return 1.0
    return min(1.0, (SMOOTH / max(int(parameter.split("_")[1]), 1)) ** 2)


@dataclass(frozen=True, eq=False)
class IdentifiedPrior:
    """Errors of a nominal rig that was itself identified: e = R z, z normal of unit covariance, R Rᵀ that of e.

    Attributes:
        make: errors (n_parameters,) of what was identified -> the rig that has them.
        root: (n_parameters, n_free) R.
    """

    make: Callable[[Floats], Rig]
    root: Floats

    @classmethod
    def of(cls, make: Callable[[Floats], Rig], covariance: Floats) -> "IdentifiedPrior":
        """Of parameters with that covariance (n_parameters, n_parameters), without directions that are all but sure."""
        scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        sizes, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
        kept = sizes > SURE * sizes.max()
        return cls(make, scale[:, None] * directions[:, kept] * np.sqrt(sizes[kept]))

    @classmethod
    def of_modes(cls, rig: Rig) -> "IdentifiedPrior | None":
        """Of frequencies, damping and shapes of identified modes; None where their covariance is not known."""
        modes, n = rig.modes, rig.modes.n_modes
        if modes.covariance is None or not isinstance(modes.domain, NamedPoints):
            return None
        shapes = modes.phi(modes.domain.names)
        blocks = [modes.covariance, *([] if modes.shape_covariance is None else modes.shape_covariance)]

        def make(errors: Floats) -> Rig:
            zeta = np.maximum(modes.zeta + errors[n : 2 * n], 0.0)
            off = errors[2 * n :].reshape(n, -1).T if errors.size > 2 * n else 0.0
            omega = np.maximum(modes.omega + errors[:n], 0.0)
            return replace(rig, modes=replace(modes, omega=omega, damping=zeta, shapes=PointShapes(shapes + off)))

        return cls.of(make, block_diag(*blocks))


def _parameters(rig: Rig, prior: NominalPrior | IdentifiedPrior) -> tuple[Parameter, ...]:
    if isinstance(prior, IdentifiedPrior):
        free = range(1, prior.root.shape[1] + 1)
        return tuple(Parameter(f"identified_{k}", "", -WIDEST, WIDEST, prior_std=1.0) for k in free)
    return tuple(_each(rig, prior))


def _each(rig: Rig, prior: NominalPrior) -> Iterator[Parameter]:
    along = isinstance(rig.structure, Structure)

    def believed(
        name: str, std: float, unit: float, low: float = -np.inf, high: float = np.inf, sensor: str = ""
    ) -> Parameter:
        # a size that is learnt to be smaller than before leaves errors of a profile where they are
        least = PROFILE_LEAST if along and group_of(name) in ("stiffness", "mass") else unit
        reach, unit = WIDEST * max(std, least), unit * weight_of(name, prior)
        prior_std = max(std * weight_of(name, prior) / unit, 1e-6)
        return Parameter(name, "", max(low, -reach), min(high, reach), scale=unit, prior_std=prior_std, sensor=sensor)

    waves = prior.waves if along else 1
    if prior.stiffness and along:
        yield from (believed(f"stiffness_{k}", prior.stiffness, PROFILE_UNIT) for k in range(waves))
    if prior.mass:
        yield from (believed(f"mass_{k}", prior.mass, PROFILE_UNIT) for k in range(waves))
    modes = range(1, rig.modes.n_modes + 1)
    if prior.frequency:
        elastic = (r for r in modes if rig.modes.omega[r - 1] > 0)
        yield from (believed(f"frequency_{r}", prior.frequency, PROFILE_UNIT) for r in elastic)
    if prior.coupling:
        yield from (believed(name, prior.coupling, PROFILE_UNIT) for name, *_ in _couplings(rig.modes.omega.tobytes()))
    if prior.damping:
        yield from (believed(f"damping_{r}", prior.damping, RATIO_UNIT) for r in modes)
    if prior.delay:
        for sensor in rig.sensors:
            low = JUST_LATE if sensor.name in prior.late else -MOST_AHEAD
            high = 0.0 if sensor.name in prior.early else MOST_AHEAD
            yield believed(f"delay_{sensor.name}", prior.delay, DELAY_UNIT, low, high, sensor.name)
    if prior.gain:
        yield from (believed(_gain(actuator), prior.gain, PROFILE_UNIT) for actuator in rig.actuators)
        yield from (believed(_gain(sensor), prior.gain, PROFILE_UNIT, sensor=sensor.name) for sensor in rig.sensors)
    ports: tuple[Actuator | Sensor, ...] = (*rig.actuators, *rig.sensors)
    if prior.place:
        for port in ports:
            own = port.name if isinstance(port, Sensor) else ""
            for name, low, high in zip(_places(rig, port), *_room(rig, port), strict=True):
                yield believed(name, prior.place, PLACE_UNIT, float(low), float(high), own)
    if prior.shape:
        for port in ports:
            own = port.name if isinstance(port, Sensor) else ""
            yield from (believed(n, prior.shape, PROFILE_UNIT, sensor=own) for n in _shapes(port, rig.modes.n_modes))
    if prior.record:
        yield from (believed(f"record_{name}", prior.record, PROFILE_UNIT) for name in prior.records)


def _varied(profile: Profile, amplitudes: np.ndarray, length: float) -> Profile:
    """The profile times exp(Σ a_k cos(k π x / L))."""
    if not amplitudes.any():
        return profile
    waves = np.pi * np.arange(amplitudes.size) / length
    return Profile(
        lambda x: profile.function(x) * np.exp(np.cos(np.multiply.outer(x, waves)) @ amplitudes), profile.breaks
    )


def _numbered(values: dict[str, float], group: str) -> np.ndarray:
    return np.array([value for name, value in values.items() if group_of(name) == group])


def _off_profiles(rig: Rig, prior: NominalPrior, values: dict[str, float]) -> Rig:
    """The rig with the errors of its profiles, or of its modal mass."""
    stiffness, mass = _numbered(values, "stiffness"), _numbered(values, "mass")
    structure, modes = rig.structure, rig.modes
    if not isinstance(structure, Structure):
        if not mass.any():
            return rig
        return replace(rig, modes=replace(modes, shapes=_scaled(modes.shapes, float(np.exp(-0.5 * mass[0])))))
    profiles = {stiffness_name(structure): stiffness, "mass_per_length": mass}
    changed: dict[str, Any] = {
        name: _varied(getattr(structure, name), amplitudes, structure.length)
        for name, amplitudes in profiles.items()
        if amplitudes.any()
    }
    if not changed:
        return rig
    structure = replace(structure, **changed)
    return replace(rig, structure=structure, modes=structure.modes(modes.n_modes, tolerance=RESOLUTION))


_with_profiles = solved_once(_off_profiles)


def _off_structure(rig: Rig, prior: NominalPrior, values: dict[str, float]) -> Rig:
    """The rig with the errors in its structure and modes; only those of the profiles ask for new modes."""
    along = {name: value for name, value in values.items() if group_of(name) in ("stiffness", "mass")}
    if not isinstance(rig.structure, Structure):
        rig = replace(rig, structure=None)  # what follows must change these modes, not solve others anew
    rig = _with_profiles(rig, prior, along)
    if prior.coupling:
        rig = replace(rig, modes=_turned(rig.modes, values))
    structure, modes = rig.structure, rig.modes
    frequency, damping = (_by_mode(values, group, modes.n_modes) for group in ("frequency", "damping"))
    if not (frequency.any() or damping.any()):
        return rig
    stretch, more = np.exp(frequency), np.exp(damping)
    if isinstance(structure, Structure):
        structure = replace(structure, frequency_errors=tuple(frequency.tolist()))
    if structure is not None and isinstance(structure.damping, ModalDamping):
        structure = replace(structure, damping=ModalDamping(modes.zeta * more))
    root = np.sqrt(stretch * more)
    modes = replace(modes, omega=modes.omega * stretch, damping=modes.damping * np.outer(root, root))
    return replace(rig, structure=structure, modes=modes)


@lru_cache(maxsize=64)
def _couplings(frequencies: bytes) -> tuple[tuple[str, int, int, float], ...]:
    """Name of each two modes' coupling, both modes, and the angle by which a coupling of one turns them, rad.

    To first order φ_r gains k_rs / (ω_r² - ω_s²) φ_s and φ_s loses as much of φ_r, with k_rs = e ω_r ω_s. A rigid mode
    no stiffness couples, and mass errors leave it one: with m_rs = -e an elastic φ_s gains e φ_r, and φ_r nothing.
    """
    omega = np.frombuffer(frequencies)
    found = []
    for r, s in combinations(range(omega.size), 2):
        apart = abs(omega[s] ** 2 - omega[r] ** 2)
        if omega[r] > 0:
            angle = omega[r] * omega[s] / max(apart, omega[r] * omega[s] / STRONG)
        else:
            angle = 1.0 if omega[s] > 0 else 0.0
        if angle > LITTLE:
            found.append((f"coupling_{r + 1}_{s + 1}", r, s, float(angle)))
    return tuple(found)


def _turned(modes: Modes, values: dict[str, float]) -> Modes:
    """The modes turned into one another by the errors of their coupling; mass-normalised still."""
    angles = np.zeros((modes.n_modes, modes.n_modes))
    for name, r, s, angle in _couplings(modes.omega.tobytes()):
        angles[r, s] = angle * values.get(name, 0.0)
    if not angles.any():
        return modes
    shapes, turn = modes.shapes, expm(angles - angles.T * (modes.omega > 0))
    return replace(modes, shapes=lambda located, derivative: shapes(located, derivative) @ turn)


def _scaled(shapes: Shapes, factor: float) -> Shapes:
    return lambda located, derivative: factor * shapes(located, derivative)


_solved = solved_once(_off_structure)


def _off(rig: Rig, prior: NominalPrior | IdentifiedPrior, values: dict[str, float]) -> Rig:
    """The rig with the errors in its structure, modes and sensors, and between records."""
    if isinstance(prior, IdentifiedPrior):
        made = prior.make(prior.root @ np.array(list(values.values())))
        modes, kept = made.modes, rig.modes.n_modes
        if modes.n_modes < kept and made.structure is not None:  # modes left out of the nominal rig are there
            modes = modes_of(made.structure, kept)
        return replace(rig, modes=modes, structure=made.structure, actuators=made.actuators)
    rig = _solved(rig, prior, {name: value for name, value in values.items() if group_of(name) not in OUTSIDE})
    rig = differing(rig, prior.figure, deviations_of(values))
    ports: tuple[Actuator | Sensor, ...] = (*rig.actuators, *rig.sensors)
    units = _shape_units(rig.modes, ports) if prior.shape else np.zeros((len(ports), 0))
    off = [_off_port(rig, port, unit, prior, values) for port, unit in zip(ports, units, strict=True)]
    if all(one is other for one, other in zip(ports, off, strict=True)):
        return rig
    n = len(rig.actuators)
    return replace(rig, actuators=tuple(off[:n]), sensors=tuple(off[n:]))


def _off_port(rig: Rig, port: Any, units: Floats, prior: NominalPrior, values: dict[str, float]) -> Any:
    """An actuator or a sensor with the errors of its place, its calibration, its mode shapes (n_modes,), its timing."""
    changes: dict[str, Any] = {}
    if prior.place:
        errors = tuple([values.get(name, 0.0) for name in _places(rig, port)])  # shares of the extent
        if any(errors):
            changes["at"] = _moved(rig.modes.domain, port.at, errors)
    if gain := values.get(_gain(port), 0.0):
        changes["gain"] = port.gain * float(np.exp(gain))
    if units.size:
        own = [values.get(name, 0.0) for name in _shapes(port, units.size)]
        changes["shape_error"] = tuple((units * own).tolist())
    if delay := values.get(f"delay_{port.name}", 0.0) if isinstance(port, Sensor) else 0.0:
        changes["delay"] = port.delay + delay * prior.sample_time
    if prior.interpolated and isinstance(port, Sensor):
        changes["interpolated"] = True
    return _changed(port, tuple(changes.items())) if changes else port


@lru_cache(maxsize=4096)
def _moved(domain: Any, where: Any, errors: tuple[float, ...]) -> Any:
    """A place that is off by shares of the extent, on the structure still: exchanged outputs stand elsewhere."""
    at = np.atleast_1d(np.asarray(middle(where), float)) + np.array(errors) * domain.size
    at = np.clip(at, *reach(domain, where))
    return centred_at(where, tuple(at.tolist()) if at.size > 1 else float(at[0]))


@lru_cache(maxsize=4096)
def _changed(port: Any, changes: tuple[tuple[str, Any], ...]) -> Any:
    """The port with some of its attributes changed; a slope along one error leaves the other ports as they were."""
    return replace(port, **dict(changes))


def _room(rig: Rig, port: Actuator | Sensor) -> Floats:
    """What a port can be off its place by at most, down and up: (2, n_coordinates), shares of the extent."""
    domain = rig.modes.domain
    assert not isinstance(domain, NamedPoints)
    room: Floats = (np.array(reach(domain, port.at)) - np.asarray(middle(port.at), float)) / domain.size
    return room


@lru_cache(maxsize=64)
def _shape_units(modes: Modes, ports: tuple[Actuator | Sensor, ...]) -> Floats:
    """Rms of each mode, its displacement or its slope, at all ports of that kind: (n_ports, n_modes).

    Remembered: not to be written to.
    """
    shapes, kinds = np.array([shape_of(modes, port) for port in ports]), [derivative_of(port) for port in ports]
    rms = {kind: np.sqrt((shapes[np.array(kinds) == kind] ** 2).mean(axis=0)) for kind in set(kinds)}
    return np.array([rms[kind] for kind in kinds])


def _gain(port: Actuator | Sensor) -> str:
    """Name of the error of its gain: an actuator and a sensor may have one name."""
    return f"gain_{_side(port)}_{port.name}"


def _places(rig: Rig, port: Actuator | Sensor) -> list[str]:
    """Names of the errors of its place, one a coordinate; none at named points."""
    domain = rig.modes.domain
    coordinates = () if isinstance(domain, NamedPoints) else domain.coordinates
    return [f"place_{_side(port)}_{port.name}_{name}" for name in coordinates]


@lru_cache(maxsize=1024)
def _shapes(port: Actuator | Sensor, n_modes: int) -> tuple[str, ...]:
    """Names of the errors of the mode shapes there."""
    return tuple(f"shape_{_side(port)}_{port.name}_{r}" for r in range(1, n_modes + 1))


def _side(port: Actuator | Sensor) -> str:
    return "of" if isinstance(port, Actuator) else "at"


def parted(errors: Effect) -> tuple[Effect, Effect | None]:
    """Errors of the nominal model in every record alike, and what differs from record to record; None for nothing."""
    prior = errors.target
    if not isinstance(prior, NominalPrior) or not prior.record:
        return errors, None
    between = {name: value for name, value in errors.values.items() if group_of(name) == "record"}
    alike = {name: value for name, value in errors.values.items() if name not in between}
    others: dict[str, Any] = {group: 0.0 for group in prior.groups if group != "record"}
    return (
        replace(errors, target=replace(prior, record=0.0), values=alike),
        replace(errors, target=replace(prior, **others), values=between),
    )


def deviations_of(values: Mapping[str, float]) -> dict[str, float]:
    """By name of record, what a figure deviates by in it."""
    return {name.split("_", 1)[1]: value for name, value in values.items() if group_of(name) == "record"}


def _by_mode(values: dict[str, float], group: str, n_modes: int) -> Floats:
    """The errors of a group (n_modes,), zero for modes that have none."""
    return np.array([values.get(f"{group}_{r}", 0.0) for r in range(1, n_modes + 1)])


def nominal_errors(rig: Rig, prior: NominalPrior | IdentifiedPrior, start: Mapping[str, float] | None = None) -> Effect:
    """Errors of the nominal model, to be fitted beside effects.

    Args:
        start: errors to start from; all others are zero.
    """
    start = {} if start is None else start
    values = {p.name: float(np.clip(start.get(p.name, 0.0), p.low, p.high)) for p in _parameters(rig, prior)}
    return Effect(NOMINAL_ERRORS, prior, values)


NOMINAL_ERRORS = Kind(
    name="nominal_errors",
    path="structure",
    parameters=_parameters,
    apply=_off,
    starts=lambda evidence, _: [],
    phrase="small errors of the nominal model",
    applied_first=True,
)


@dataclass(frozen=True)
class OfOneRecord:
    """What a figure is in one record, as a change of rig.

    Attributes:
        kind: of the catalogue, with no target and one number.
        name, value: of that number.
    """

    kind: Kind
    name: str
    value: float

    def __call__(self, rig: Rig) -> Rig:
        return self.kind.apply(rig, None, {self.name: self.value})


def figures_of(rig: Rig) -> tuple[str, ...]:
    """Figures of a rig that may differ from record to record."""
    if not rig.modes.omega.any():
        return ()
    return (STIFFNESS, TENSION) if isinstance(rig.structure, Beam) else (STIFFNESS,)


def differing(rig: Rig, figure: str, deviations: Mapping[str, float]) -> Rig:
    """The rig with a figure that differs from record to record.

    Args:
        figure: of `figures_of`.
        deviations: by name of record: of all stiffness, relative; of the axial load, over that which buckles the beam.
    """

    def change(deviation: float) -> OfOneRecord:
        if figure == TENSION:
            return OfOneRecord(AXIAL_LOAD, "tension", deviation * buckling_load(rig))
        return OfOneRecord(MODULUS_ERROR, "factor", 1.0 + deviation)

    changes = tuple((name, change(deviation)) for name, deviation in deviations.items() if deviation)
    return replace(rig, by_record=changes) if changes else rig


def label_of(figure: str) -> str:
    """What a budget calls a figure that differs from record to record."""
    return f"{figure.replace(' ', '_')}_record_to_record"
