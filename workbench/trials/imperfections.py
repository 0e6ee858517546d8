"""Imperfections: small errors of a real test that are not effects of the catalogue, in classes and sizes."""

from dataclasses import dataclass, replace

import numpy as np

from workbench.structure.domain import NamedPoints, Where, centred_at, middle, reach
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
MIMICS: dict[str, frozenset[str]] = {
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
MIMICS["mixed"] = frozenset().union(*(MIMICS[name] for name in MIXED))


@dataclass(frozen=True)
class Imperfections:
    """Small errors of a test.

    Attributes:
        stiffness_waves, mass_waves: coefficients of the smooth variation along the structure, see `Alterations`.
        stiffness_factor, damping_factor: of all stiffness, of all damping.
        damping_factors: of each mode's damping ratio.
        noise_ratio: the true standard deviation of the sensors' noise over the stated one.
        noise_memory: correlation of that noise over one sample.
        logging_noise: of each logged input, as a share of its rms.
        delays: of each sensor, in samples.
        interpolated: whether the delays are made by linear interpolation, as when a logger resamples to one clock.
        gains: of each actuator, then of each sensor, relative to the stated ones.
        moved: of each actuator, then of each sensor, (n_coordinates,) m from the stated place.
    """

    stiffness_waves: tuple[float, ...] = ()
    mass_waves: tuple[float, ...] = ()
    stiffness_factor: float = 1.0
    damping_factor: float = 1.0
    damping_factors: tuple[float, ...] = ()
    noise_ratio: float = 1.0
    noise_memory: float = 0.0
    logging_noise: float = 0.0
    delays: tuple[float, ...] = ()
    interpolated: bool = False
    gains: tuple[float, ...] = ()
    moved: tuple[tuple[float, ...], ...] = ()

    def on(self, plant: Plant, sample_time: float) -> Plant:
        """The plant with these imperfections, before any effect is hidden in it."""
        n = len(plant.actuators)
        delays = self.delays or (0.0,) * len(plant.sensors)
        gains = self.gains or (1.0,) * (n + len(plant.sensors))
        moved = self.moved or ((),) * (n + len(plant.sensors))
        actuators = tuple(
            replace(a, gain=a.gain * gain, at=_moved(a.at, by))
            for a, gain, by in zip(plant.actuators, gains[:n], moved[:n], strict=True)
        )
        sensors = tuple(
            replace(
                s,
                noise_std=s.noise_std * self.noise_ratio,
                delay=s.delay + delay * sample_time,
                interpolated=self.interpolated,
                gain=s.gain * gain,
                at=middle(_moved(s.at, by)),
            )
            for s, delay, gain, by in zip(plant.sensors, delays, gains[n:], moved[n:], strict=True)
        )
        altered = replace(
            plant.altered,
            stiffness_factor=plant.altered.stiffness_factor * self.stiffness_factor,
            stiffness_waves=self.stiffness_waves,
            mass_waves=self.mass_waves,
        )
        return replace(
            plant,
            actuators=actuators,
            sensors=sensors,
            altered=altered,
            damping_factor=plant.damping_factor * self.damping_factor,
            damping_factors=self.damping_factors,
            noise_memory=self.noise_memory,
            logging_noise=self.logging_noise,
        )


def draw_imperfections(name: str, size: float, bench: Bench, rng: np.random.Generator) -> Imperfections:
    """Random imperfections of a class.

    Args:
        name: one of `IMPERFECTIONS`.
        size: 1 for those of a careful laboratory; 0 for none.

    Raises:
        ValueError: an unknown class, a negative size.
    """
    if name not in IMPERFECTIONS:
        raise ValueError(f"imperfections must be one of {', '.join(IMPERFECTIONS)}; got {name!r}")
    if not size >= 0:
        raise ValueError(f"the size of imperfections must be 0 or more; got {size}")
    imperfections = Imperfections()
    for part in MIXED if name == "mixed" else (name,):
        imperfections = _with_part(imperfections, part, 0.5 * size if name == "mixed" else size, bench, rng)
    return imperfections


def _with_part(
    imperfections: Imperfections, name: str, size: float, bench: Bench, rng: np.random.Generator
) -> Imperfections:
    if name == "shape":
        spread = rng.uniform(-1.0, 1.0, bench.rig.modes.n_modes) * DAMPING_SPREAD * size
        waves = [_waves(VARIATION * size, rng) for _ in range(2)]
        factors = tuple(map(float, np.exp(spread)))
        return replace(imperfections, stiffness_waves=waves[0], mass_waves=waves[1], damping_factors=factors)
    if name == "offset":
        stiffness, damping = rng.choice([-1.0, 1.0], 2) * rng.uniform(0.5, 1.0, 2) * size
        factors = np.exp(np.array([STIFFNESS_OFFSET * stiffness, DAMPING_OFFSET * damping]))
        return replace(imperfections, stiffness_factor=float(factors[0]), damping_factor=float(factors[1]))
    if name == "noise":
        return replace(imperfections, noise_ratio=NOISE_RATIO**size)
    if name == "coloured":
        return replace(imperfections, noise_memory=NOISE_MEMORY ** (1.0 / size) if size > 0 else 0.0)
    if name == "input":
        return replace(imperfections, logging_noise=LOGGING_NOISE * size)
    if name == "late":
        delays = tuple(map(float, rng.uniform(0.0, LATE * size, len(bench.rig.sensors))))
        return replace(imperfections, delays=delays, interpolated=bool(rng.random() < 0.5))
    if name == "gain":
        ports = len(bench.rig.actuators) + len(bench.rig.sensors)
        return replace(imperfections, gains=tuple(map(float, np.exp(CALIBRATION * size * rng.standard_normal(ports)))))
    if name == "place":
        return replace(imperfections, moved=_off_places(bench, PLACED * size, rng))
    return imperfections


def _moved(where: Where, by: tuple[float, ...]) -> Where:
    """The place, patch or pair of points moved by (n_coordinates,) m; unchanged if empty."""
    if not by:
        return where
    at = np.atleast_1d(np.asarray(middle(where), float)) + by
    return centred_at(where, (float(at[0]), float(at[1])) if len(by) > 1 else float(at[0]))


def _off_places(bench: Bench, size: float, rng: np.random.Generator) -> tuple[tuple[float, ...], ...]:
    """Random errors of place of each actuator and sensor, m, limited to stay on the structure."""
    domain, rig = bench.rig.modes.domain, bench.rig
    stated: list[Where] = [*(a.at for a in rig.actuators), *(s.at for s in rig.sensors)]
    if isinstance(domain, NamedPoints):
        return ()
    drawn = size * domain.size * rng.standard_normal((len(stated), len(domain.coordinates)))
    room = [np.array(reach(domain, where)) - np.asarray(middle(where), float) for where in stated]
    return tuple(tuple(np.clip(by, *ends).tolist()) for by, ends in zip(drawn, room, strict=True))


def _waves(size: float, rng: np.random.Generator) -> tuple[float, ...]:
    """Coefficients of cosines with a standard deviation of `size` along the structure."""
    waves = rng.standard_normal(WAVES) / np.arange(1, WAVES + 1)
    return tuple(map(float, waves * size * np.sqrt(2.0) / np.linalg.norm(waves)))
