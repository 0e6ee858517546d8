"""Imperfections: small errors of a real test that are not effects of the catalogue, in classes and sizes."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from workbench.rig.rig import Transducer
from workbench.structure.domain import Interval, Location, NamedPoints, Rectangle, centred_at, middle, reach
from workbench.trials.benches import Bench
from workbench.trials.plant import Plant

CLEAN, TRIPLE = "clean", "triple"
IMPERFECTIONS = (CLEAN, "shape", "offset", "noise", "coloured", "input", "late", "gain", "place", "mixed", TRIPLE)
SIZES = (0.5, 1.0, 2.0)
MIXED = ("shape", "offset", "noise", "input", "late")  # each at half the size

# Values at size 1, proportional to the size unless stated otherwise.
VARIATION = 0.02  # standard deviation of stiffness and of mass along the structure
WAVES = 4  # half waves along the structure of the finest variation
DAMPING_SPREAD = 0.3  # largest relative error of each mode's damping ratio
STIFFNESS_OFFSET, DAMPING_OFFSET = 0.015, 0.2  # largest relative error common to all stiffness, to all damping
NOISE_RATIO = 1.0 / 0.6  # the true noise over the stated one, to the power of the size
NOISE_MEMORY = 0.9  # correlation of coloured noise over one sample, to the power of 1 / size
LOGGING_NOISE = 0.01  # of an input's rms
LATE = 0.3  # largest delay of a sensor, in samples
CALIBRATION = 0.01  # standard deviation of the gain of each actuator and each sensor
PLACED = 0.002  # standard deviation of the place of each, in each coordinate, over the extent: 4 mm of 2 m

# Effects that cannot be distinguished from the imperfections of a class.
INDISTINGUISHABLE: dict[str, frozenset[str]] = {
    CLEAN: frozenset(),
    "shape": frozenset({"modulus_error", "modal_damping", "axial_load", "truncated_modes"}),
    "offset": frozenset({"modulus_error", "modal_damping", "stiffness_drift"}),
    "noise": frozenset({"random_disturbance", "sensor_quantisation"}),
    "coloured": frozenset({"random_disturbance", "sensor_quantisation"}),
    "input": frozenset({"random_disturbance"}),
    "late": frozenset({"actuator_delay", "actuator_lag", "sensor_lag", "sensor_delay"}),
    "gain": frozenset({"actuator_gain", "sensor_gain"}),
    "place": frozenset({"actuator_misplacement", "sensor_misplacement"}),
    TRIPLE: frozenset(),
}
INDISTINGUISHABLE["mixed"] = frozenset().union(*(INDISTINGUISHABLE[name] for name in MIXED))


def with_imperfections(plant: Plant, name: str, size: float, bench: Bench, rng: np.random.Generator) -> Plant:
    """The real structure of a bench with random imperfections of a class, before any effect is hidden in it.

    Args:
        plant: the structure equal to the nominal one; it is returned as it is if the class has no imperfections.
        name: one of `IMPERFECTIONS`.
        size: 1 for those of a careful laboratory; 0 for none.

    Raises:
        ValueError: an unknown class, a negative size.
    """
    if name not in IMPERFECTIONS:
        raise ValueError(f"imperfections must be one of {', '.join(IMPERFECTIONS)}; got {name!r}")
    if not size >= 0:
        raise ValueError(f"the size of imperfections must be 0 or more; got {size}")
    for part in MIXED if name == "mixed" else (name,):
        plant = _with_part(plant, part, 0.5 * size if name == "mixed" else size, bench, rng)
    return plant


def _with_part(plant: Plant, name: str, size: float, bench: Bench, rng: np.random.Generator) -> Plant:
    actuators, sensors, domain = plant.actuators, plant.sensors, bench.rig.modes.domain
    transducers: tuple[Transducer, ...] = (*actuators, *sensors)
    n = len(actuators)
    if name == "shape":
        spread = rng.uniform(-1.0, 1.0, bench.rig.modes.n_modes) * DAMPING_SPREAD * size
        stiffness_waves, mass_waves = (_waves(VARIATION * size, rng) for _ in range(2))
        altered = replace(plant.altered, stiffness_waves=stiffness_waves, mass_waves=mass_waves)
        return replace(plant, altered=altered, damping_factors=tuple(np.exp(spread).tolist()))
    if name == "offset":
        stiffness, damping = rng.choice([-1.0, 1.0], 2) * rng.uniform(0.5, 1.0, 2) * size
        altered = replace(plant.altered, stiffness_factor=float(np.exp(STIFFNESS_OFFSET * stiffness)))
        return replace(plant, altered=altered, damping_factor=float(np.exp(DAMPING_OFFSET * damping)))
    if name == "noise":
        return replace(plant, sensors=_each(sensors, noise_std=[s.noise_std * NOISE_RATIO**size for s in sensors]))
    if name == "coloured":
        return replace(plant, noise_memory=NOISE_MEMORY ** (1.0 / size) if size > 0 else 0.0)
    if name == "input":
        return replace(plant, logging_noise=LOGGING_NOISE * size)
    if name == "late":
        late = rng.uniform(0.0, LATE * size, len(sensors)).tolist()
        delays = [s.delay + share * bench.sample_time for s, share in zip(sensors, late, strict=True)]
        interpolated = bool(rng.random() < 0.5)
        return replace(plant, sensors=_each(sensors, delay=delays, interpolated=[interpolated] * len(sensors)))
    if name == "gain":
        errors = np.exp(CALIBRATION * size * rng.standard_normal(len(transducers)))
        gains = [transducer.gain * float(error) for transducer, error in zip(transducers, errors, strict=True)]
        return replace(plant, actuators=_each(actuators, gain=gains[:n]), sensors=_each(sensors, gain=gains[n:]))
    if name == "place" and not isinstance(domain, NamedPoints):
        places = _off_places(domain, [transducer.at for transducer in transducers], PLACED * size, rng)
        read_at = [middle(at) for at in places[n:]]
        return replace(plant, actuators=_each(actuators, at=places[:n]), sensors=_each(sensors, at=read_at))
    return plant


def _each(transducers: Any, **values: list[Any]) -> Any:
    """The actuators or sensors with a value of each field for each of them."""
    rows = (dict(zip(values, row)) for row in zip(*values.values(), strict=True))
    return tuple(replace(transducer, **row) for transducer, row in zip(transducers, rows, strict=True))


def _off_places(
    domain: Interval | Rectangle, stated: Sequence[Location], size: float, rng: np.random.Generator
) -> list[Location]:
    """Places with random errors, m, limited to stay on the structure."""
    drawn = size * domain.size * rng.standard_normal((len(stated), len(domain.coordinates)))
    places: list[Location] = []
    for where, by in zip(stated, drawn, strict=True):
        centre = np.asarray(middle(where), float)
        at = np.atleast_1d(centre) + np.clip(by, *(np.array(reach(domain, where)) - centre))
        places.append(centred_at(where, (float(at[0]), float(at[1])) if at.size > 1 else float(at[0])))
    return places


def _waves(size: float, rng: np.random.Generator) -> tuple[float, ...]:
    """Coefficients of cosines with a standard deviation of `size` along the structure."""
    waves = rng.standard_normal(WAVES) / np.arange(1, WAVES + 1)
    return tuple((waves * size * np.sqrt(2.0) / np.linalg.norm(waves)).tolist())
