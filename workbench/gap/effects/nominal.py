"""Nominal errors: small errors of the nominal model with normal priors; parameters that vary from record to record."""

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
)
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig, Transducer, derivative_of, shape_of
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints, centred_at, middle, reach
from workbench.structure.member import Beam, Structure
from workbench.structure.modes import Modes, PointShapes
from workbench.structure.profile import Profile

STIFFNESS, TENSION = "stiffness", "axial load"  # the first includes the effect of temperature on a modulus
EQUAL_WAVES = 9  # cosines up to which all have the same prior; with more, it falls with the square of the wave number
HALF_WAVES = 3  # beyond so many half waves, as the series of any function with a slope at its ends does
# units of free coordinates: of a logarithm, of a sample, of the extent; and of other groups, relative
UNITS, RELATIVE_UNIT = {"damping": 0.1, "delay": 0.1, "place": 0.001}, 0.01
LARGEST_DELAY = 0.9  # of a sample: bound of a sensor's delay or lead
JUST_LATE = 1e-3  # of a sample: an accelerometer that is later reads the value before a jump
NEGLIGIBLE = 1e-9  # of the largest variance of identified errors, normalised: directions below it are left out
SMALLEST_ANGLE = 0.25  # radians by which a unit coupling rotates two modes: couplings below it are left out
LARGEST_ANGLE = 25.0  # likewise: bound for close modes
BOUND = 8.0  # prior standard deviations: bounds of an error
PROFILE_STD = 0.02  # prior standard deviation of errors of a profile before any record


@dataclass(frozen=True)
class NominalPrior:
    """Prior standard deviations of the errors of a nominal model, by group; 0 for no error.

    Attributes:
        stiffness, mass: relative, of each cosine along a structure of known profiles; otherwise of the modal mass.
        frequency: relative, of each natural frequency.
        coupling: of each two modes by non-uniform stiffness, over the geometric mean of their modal stiffnesses; of a
            rigid and an elastic mode by non-uniform mass, over the modal mass.
        damping: of the logarithm of each damping ratio.
        delay: of each sensor, in samples.
        gain: relative, of each actuator and each sensor.
        place: of each actuator and each sensor, in each coordinate, over the structure's extent.
        shape: of each mode at each actuator and each sensor, over the rms of that mode at all of them.
        record: of a parameter that varies from record to record, about its mean; see `record_to_record`.
        sample_time: s.
        late, early: names of the sensors whose delay is positive, or at most zero: with held inputs, acceleration jumps
            at each sample, and no small step leads from one side to the other.
        interpolated: whether delays are linear interpolations between samples, which have no jumps.
        points: named points of effects, where the mode shapes have errors as at the transducers.
        waves: number of cosines of a smooth variation along the structure, the constant included.
        records, parameter: names of the records between which a parameter varies, and its name.
        by_mode: whether errors are those of each mode.
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
    points: tuple[str, ...] = ()
    waves: int = 9
    records: tuple[str, ...] = ()
    parameter: str = STIFFNESS
    by_mode: bool = False

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the groups that are uncertain."""
        return tuple(name for name in GROUPS if getattr(self, name) > 0)


GROUPS = ("stiffness", "mass", "frequency", "coupling", "damping", "delay", "gain", "place", "shape", "record")
OUTSIDE = ("delay", "gain", "place", "shape", "record")  # groups that do not change the modes


@lru_cache(maxsize=4096)
def group_of(parameter: str) -> str:
    return parameter.split("_", 1)[0]


def in_group(values: Mapping[str, float], *groups: str) -> dict[str, float]:
    """The values of nominal errors of some groups, by parameter name."""
    return {name: value for name, value in values.items() if group_of(name) in groups}


def weight_of(parameter: str, prior: NominalPrior) -> float:
    """Ratio of the prior standard deviation of a parameter to that of its group."""
    if prior.waves <= EQUAL_WAVES or group_of(parameter) not in ("stiffness", "mass"):
        return 1.0
    return min(1.0, (HALF_WAVES / max(int(parameter.split("_")[1]), 1)) ** 2)


@dataclass(frozen=True, eq=False)
class IdentifiedPrior:
    """Errors of a nominal rig that was itself identified: e = R z, z normal of unit covariance, R Rᵀ that of e.

    Attributes:
        make: errors (n_parameters,) of the identified parameters -> the rig with them.
        root: (n_parameters, n_free) R.
    """

    make: Callable[[Floats], Rig]
    root: Floats

    @classmethod
    def of(cls, make: Callable[[Floats], Rig], covariance: Floats) -> "IdentifiedPrior":
        """The prior of a covariance (n_parameters, n_parameters), without directions of negligible variance."""
        scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        sizes, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
        kept = sizes > NEGLIGIBLE * sizes.max()
        return cls(make, scale[:, None] * directions[:, kept] * np.sqrt(sizes[kept]))

    @classmethod
    def of_modes(cls, rig: Rig) -> "IdentifiedPrior | None":
        """The prior of frequencies, damping and shapes of identified modes; None if their covariance is not known."""
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
        return tuple(Parameter(f"identified_{k}", "", -BOUND, BOUND, prior_std=1.0) for k in free)
    return tuple(_each_parameter(rig, prior))


def _each_parameter(rig: Rig, prior: NominalPrior) -> Iterator[Parameter]:
    along = isinstance(rig.structure, Structure)

    def with_prior(name: str, low: float = -np.inf, high: float = np.inf, sensor: str = "") -> Parameter:
        group, weight = group_of(name), weight_of(name, prior)
        std, unit = getattr(prior, group), UNITS.get(group, RELATIVE_UNIT)
        # bounds do not shrink with an estimated prior, so that errors of a profile keep their values
        least = PROFILE_STD if along and group in ("stiffness", "mass") else unit
        reach, unit = BOUND * max(std, least), unit * weight
        prior_std = max(std * weight / unit, 1e-6)
        return Parameter(name, "", max(low, -reach), min(high, reach), scale=unit, prior_std=prior_std, sensor=sensor)

    waves, modes = prior.waves if along else 1, range(1, rig.modes.n_modes + 1)
    names = {
        "stiffness": [f"stiffness_{k}" for k in range(waves if along else 0)],
        "mass": [f"mass_{k}" for k in range(waves)],
        "frequency": [f"frequency_{r}" for r in modes if rig.modes.omega[r - 1] > 0],
        "coupling": [name for name, *_ in _couplings(rig.modes.omega.tobytes())] if prior.coupling else [],
        "damping": [f"damping_{r}" for r in modes],
    }
    yield from (with_prior(name) for group in names if getattr(prior, group) for name in names[group])
    if prior.delay:
        for sensor in rig.sensors:
            low = JUST_LATE if sensor.name in prior.late else -LARGEST_DELAY
            high = 0.0 if sensor.name in prior.early else LARGEST_DELAY
            yield with_prior(f"delay_{sensor.name}", low, high, sensor.name)
    # a transducer, and the sensor that alone reads its errors
    transducers: list[tuple[Transducer, str]] = [(actuator, "") for actuator in rig.actuators]
    transducers += [(sensor, sensor.name) for sensor in rig.sensors]
    if prior.gain:
        yield from (with_prior(_gain_name(transducer), sensor=own) for transducer, own in transducers)
    if prior.place:
        for transducer, own in transducers:
            for name, low, high in zip(_place_names(rig, transducer), *_place_bounds(rig, transducer), strict=True):
                yield with_prior(name, float(low), float(high), own)
    if prior.shape:
        for at, own in (*transducers, *((point, "") for point in prior.points)):
            yield from (with_prior(name, sensor=own) for name in _shape_names(at, rig.modes.n_modes))
    if prior.record:
        yield from (with_prior(f"record_{name}") for name in prior.records)


def _with_variation(profile: Profile, amplitudes: np.ndarray, length: float) -> Profile:
    """The profile times exp(Σ a_k cos(k π x / L))."""
    if not amplitudes.any():
        return profile
    waves = np.pi * np.arange(amplitudes.size) / length
    return Profile(
        lambda x: profile.function(x) * np.exp(np.cos(np.multiply.outer(x, waves)) @ amplitudes), profile.breaks
    )


@solved_once
def _with_profile_errors(rig: Rig, prior: NominalPrior, values: dict[str, float]) -> Rig:
    """The rig with errors of its profiles, or of its modal mass."""
    stiffness, mass = (np.array(list(in_group(values, group).values())) for group in ("stiffness", "mass"))
    structure, modes = rig.structure, rig.modes
    if not isinstance(structure, Structure):
        if not mass.any():
            return rig
        shapes, factor = modes.shapes, float(np.exp(-0.5 * mass[0]))
        return replace(rig, modes=replace(modes, shapes=lambda at, derivative: factor * shapes(at, derivative)))
    profiles = {structure.stiffness_name: stiffness, "mass_per_length": mass}
    changed: dict[str, Any] = {
        name: _with_variation(getattr(structure, name), amplitudes, structure.length)
        for name, amplitudes in profiles.items()
        if amplitudes.any()
    }
    if not changed:
        return rig
    structure = replace(structure, **changed)
    return replace(rig, structure=structure, modes=structure.modes(modes.n_modes, tolerance=RESOLUTION))


@solved_once
def _with_structural_errors(rig: Rig, prior: NominalPrior, values: dict[str, float]) -> Rig:
    """The rig with errors of its structure and modes; only those of profiles require new modes."""
    along = in_group(values, "stiffness", "mass")
    if not isinstance(rig.structure, Structure):
        rig = replace(rig, structure=None)  # later effects must change these modes, not solve the structure again
    rig = _with_profile_errors(rig, prior, along)
    if prior.coupling:
        rig = replace(rig, modes=_with_couplings(rig.modes, values))
    structure, modes = rig.structure, rig.modes
    frequency, damping = (_values_by_mode(values, group, modes.n_modes) for group in ("frequency", "damping"))
    if not (frequency.any() or damping.any()):
        return rig
    scale, more = np.exp(frequency), np.exp(damping)
    if isinstance(structure, Structure):
        structure = replace(structure, frequency_errors=tuple(frequency.tolist()))
    if structure is not None and isinstance(structure.damping, ModalDamping):
        structure = replace(structure, damping=ModalDamping(modes.zeta * more))
    root = np.sqrt(scale * more)
    modes = replace(modes, omega=modes.omega * scale, damping=modes.damping * np.outer(root, root))
    return replace(rig, structure=structure, modes=modes)


@lru_cache(maxsize=64)
def _couplings(frequencies: bytes) -> tuple[tuple[str, int, int, float], ...]:
    """Name of the coupling of each two modes, their indices, and the angle by which a unit coupling rotates them, rad.

    To first order φ_r gains k_rs / (ω_r² - ω_s²) φ_s and φ_s loses as much of φ_r, with k_rs = e ω_r ω_s. Stiffness
    does not couple a rigid mode, and mass errors leave it rigid: with m_rs = -e an elastic φ_s gains e φ_r.
    """
    omega = np.frombuffer(frequencies)
    found = []
    for r, s in combinations(range(omega.size), 2):
        apart = abs(omega[s] ** 2 - omega[r] ** 2)
        if omega[r] > 0:
            angle = omega[r] * omega[s] / max(apart, omega[r] * omega[s] / LARGEST_ANGLE)
        else:
            angle = 1.0 if omega[s] > 0 else 0.0
        if angle > SMALLEST_ANGLE:
            found.append((f"coupling_{r + 1}_{s + 1}", r, s, float(angle)))
    return tuple(found)


def _with_couplings(modes: Modes, values: dict[str, float]) -> Modes:
    """The modes rotated by the errors of their coupling, still mass-normalised."""
    angles = np.zeros((modes.n_modes, modes.n_modes))
    for name, r, s, angle in _couplings(modes.omega.tobytes()):
        angles[r, s] = angle * values.get(name, 0.0)
    if not angles.any():
        return modes
    shapes, rotation = modes.shapes, expm(angles - angles.T * (modes.omega > 0))
    return replace(modes, shapes=lambda located, derivative: shapes(located, derivative) @ rotation)


def _with_errors(rig: Rig, prior: NominalPrior | IdentifiedPrior, values: dict[str, float]) -> Rig:
    """The rig with all nominal errors: of its structure, modes, transducers and between records."""
    if isinstance(prior, IdentifiedPrior):
        made = prior.make(prior.root @ np.array(list(values.values())))
        modes, kept = made.modes, rig.modes.n_modes
        if modes.n_modes < kept and made.structure is not None:  # an effect has added modes to the rig
            modes = modes_of(made.structure, kept)
        return replace(rig, modes=modes, structure=made.structure, actuators=made.actuators)
    inside = {name: value for name, value in values.items() if group_of(name) not in OUTSIDE}
    rig = _with_structural_errors(rig, prior, inside)
    rig = differing(rig, prior.parameter, deviations_of(values))
    transducers: tuple[Transducer, ...] = (*rig.actuators, *rig.sensors)
    units = _shape_units(rig.modes, transducers) if prior.shape else np.zeros((len(transducers), 0))
    if prior.shape and prior.points:
        rig = replace(rig, modes=_modes_with_errors(rig.modes, transducers, prior.points, values))
    each = zip(transducers, units, strict=True)
    off = [_transducer_with_errors(rig, transducer, unit, prior, values) for transducer, unit in each]
    if all(one is other for one, other in zip(transducers, off, strict=True)):
        return rig
    n = len(rig.actuators)
    return replace(rig, actuators=tuple(off[:n]), sensors=tuple(off[n:]))


def _modes_with_errors(
    modes: Modes, transducers: tuple[Transducer, ...], points: tuple[str, ...], values: dict[str, float]
) -> Modes:
    """The modes with errors of their shapes at named points, in units of the rms of each mode at the transducers."""
    errors = np.array([[values.get(name, 0.0) for name in _shape_names(point, modes.n_modes)] for point in points])
    if not errors.any():
        return modes
    assert isinstance(modes.domain, NamedPoints)
    rows = np.zeros((len(modes.domain.names), modes.n_modes))
    rows[modes.domain.locate(points)] = errors * _shape_units(modes, transducers).max(axis=0)
    shapes = modes.shapes
    return replace(modes, shapes=lambda located, derivative: shapes(located, derivative) + rows[located])


def _transducer_with_errors(
    rig: Rig, transducer: Any, units: Floats, prior: NominalPrior, values: dict[str, float]
) -> Any:
    """An actuator or a sensor with errors of its place, gain, shapes and timing; units: (n_modes,) of the shapes."""
    changes: dict[str, Any] = {}
    if prior.place:
        errors = tuple([values.get(name, 0.0) for name in _place_names(rig, transducer)])  # shares of the extent
        if any(errors):
            changes["at"] = _shifted(rig.modes.domain, transducer.at, errors)
    if gain := values.get(_gain_name(transducer), 0.0):
        changes["gain"] = transducer.gain * float(np.exp(gain))
    if units.size:
        own = [values.get(name, 0.0) for name in _shape_names(transducer, units.size)]
        changes["shape_error"] = tuple((units * own).tolist())
    if delay := values.get(f"delay_{transducer.name}", 0.0) if isinstance(transducer, Sensor) else 0.0:
        changes["delay"] = transducer.delay + delay * prior.sample_time
    if prior.interpolated and isinstance(transducer, Sensor):
        changes["interpolated"] = True
    return _changed(transducer, tuple(changes.items())) if changes else transducer


@lru_cache(maxsize=4096)
def _shifted(domain: Any, where: Any, errors: tuple[float, ...]) -> Any:
    """A place shifted by shares of the extent, within the structure, since exchanged outputs have other bounds."""
    at = np.atleast_1d(np.asarray(middle(where), float)) + np.array(errors) * domain.size
    at = np.clip(at, *reach(domain, where))
    return centred_at(where, tuple(at.tolist()) if at.size > 1 else float(at[0]))


@lru_cache(maxsize=4096)
def _changed(transducer: Any, changes: tuple[tuple[str, Any], ...]) -> Any:
    """The transducer with some attributes changed; cached, as a sensitivity changes one error at a time."""
    return replace(transducer, **dict(changes))


def _place_bounds(rig: Rig, transducer: Transducer) -> Floats:
    """Lower and upper bounds (2, n_coordinates) of the error of a transducer's place, as shares of the extent."""
    domain = rig.modes.domain
    assert not isinstance(domain, NamedPoints)
    ends = np.array(reach(domain, transducer.at))
    return np.asarray((ends - np.asarray(middle(transducer.at), float)) / domain.size)


@lru_cache(maxsize=64)
def _shape_units(modes: Modes, transducers: tuple[Transducer, ...]) -> Floats:
    """Rms of each mode's displacement or slope over all transducers of the same kind: (n_transducers, n_modes).

    Cached: not to be written to.
    """
    shapes = np.array([shape_of(modes, transducer) for transducer in transducers])
    kinds = [derivative_of(transducer) for transducer in transducers]
    rms = {kind: np.sqrt((shapes[np.array(kinds) == kind] ** 2).mean(axis=0)) for kind in set(kinds)}
    return np.array([rms[kind] for kind in kinds])


def _gain_name(transducer: Transducer) -> str:
    """Name of the gain error of a transducer; an actuator and a sensor may have the same name."""
    return f"gain_{_side(transducer)}_{transducer.name}"


def _place_names(rig: Rig, transducer: Transducer) -> list[str]:
    """Names of the errors of its place, one a coordinate; none at named points."""
    domain = rig.modes.domain
    coordinates = () if isinstance(domain, NamedPoints) else domain.coordinates
    return [f"place_{_side(transducer)}_{transducer.name}_{name}" for name in coordinates]


@lru_cache(maxsize=1024)
def _shape_names(at: Transducer | str, n_modes: int) -> tuple[str, ...]:
    """Names of the errors of the mode shapes at a transducer, or at a named point."""
    where = f"in_{at}" if isinstance(at, str) else f"{_side(at)}_{at.name}"
    return tuple(f"shape_{where}_{r}" for r in range(1, n_modes + 1))


def _side(transducer: Transducer) -> str:
    """Part of the name of a transducer's errors: of an actuator, or at a sensor."""
    return "of" if isinstance(transducer, Actuator) else "at"


def parted(errors: Effect) -> tuple[Effect, Effect | None]:
    """The nominal errors common to all records, and those that vary from record to record (None if there are none)."""
    prior = errors.target
    if not isinstance(prior, NominalPrior) or not prior.record:
        return errors, None
    between = in_group(errors.values, "record")
    alike = {name: value for name, value in errors.values.items() if name not in between}
    others: dict[str, Any] = dict.fromkeys(set(prior.groups) - {"record"}, 0.0)
    return (
        replace(errors, target=replace(prior, record=0.0), values=alike),
        replace(errors, target=replace(prior, **others), values=between),
    )


def deviations_of(values: Mapping[str, float]) -> dict[str, float]:
    """Deviation of the varying parameter in each record, by name."""
    return {name.split("_", 1)[1]: value for name, value in in_group(values, "record").items()}


def _values_by_mode(values: dict[str, float], group: str, n_modes: int) -> Floats:
    """The errors of a group (n_modes,), zero for modes that have none."""
    return np.array([values.get(f"{group}_{r}", 0.0) for r in range(1, n_modes + 1)])


def nominal_errors(rig: Rig, prior: NominalPrior | IdentifiedPrior, start: Mapping[str, float] | None = None) -> Effect:
    """Nominal errors as an effect, to be fitted jointly with others; start: values by name, all others zero."""
    values = {p.name: float(np.clip((start or {}).get(p.name, 0.0), p.low, p.high)) for p in _parameters(rig, prior)}
    return Effect(NOMINAL_ERRORS, prior, values)


NOMINAL_ERRORS = Kind(
    name="nominal_errors",
    path="structure",
    parameters=_parameters,
    apply=_with_errors,
    starts=lambda reconstruction, _: [],
    phrase="small errors of the nominal model",
    applied_first=True,
)


@dataclass(frozen=True)
class OfOneRecord:
    """The change of a rig by a parameter that varies from record to record, in one record.

    Attributes:
        kind: of the catalogue, with no target and one parameter.
        name, value: of that parameter.
    """

    kind: Kind
    name: str
    value: float

    def __call__(self, rig: Rig) -> Rig:
        return self.kind.apply(rig, None, {self.name: self.value})


def varying_parameters(rig: Rig) -> tuple[str, ...]:
    """Names of the parameters of a rig that may vary from record to record."""
    if not rig.modes.omega.any():
        return ()
    return (STIFFNESS, TENSION) if isinstance(rig.structure, Beam) else (STIFFNESS,)


def differing(rig: Rig, parameter: str, deviations: Mapping[str, float]) -> Rig:
    """The rig with a parameter, of `varying_parameters`, that varies from record to record.

    deviations: by name of record: relative for the stiffness, over the buckling load for the axial load.
    """

    def change(deviation: float) -> OfOneRecord:
        if parameter == TENSION:
            return OfOneRecord(AXIAL_LOAD, "tension", deviation * buckling_load(rig))
        return OfOneRecord(MODULUS_ERROR, "factor", 1.0 + deviation)

    changes = tuple((name, change(deviation)) for name, deviation in deviations.items() if deviation)
    return replace(rig, by_record=changes) if changes else rig


def label_of(parameter: str) -> str:
    """Label in the budget of a parameter that varies from record to record."""
    return f"{parameter.replace(' ', '_')}_record_to_record"
