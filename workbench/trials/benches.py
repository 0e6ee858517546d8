"""Benches of blind trials: nominal rigs, and the experiments done on them."""

from dataclasses import dataclass, replace

import numpy as np

from workbench.cases.case import Case
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Bar, Beam, Structure
from workbench.trials.plant import ModalMotion, Plant, SolvedPlant, coloured_noise

SAMPLES = 2000
LEVELS = {"low": 0.25, "high": 1.0, "mid": 0.625}
STRIKE = 6.25  # of a hammer, in rms of the high level


@dataclass(frozen=True, eq=False)
class Bench:
    """A nominal rig and how it is tested.

    Attributes:
        rig: nominal, its sensors with their noise.
        sample_time: s.
        band_hz: excitation reaches up to here.
        level: rms of the high level, N.
        snr_db: of each sensor in the low record of the nominal structure; None where the noise was given.
        feedback: of the closed loop, N s/m; None for no such record.
    """

    rig: Rig
    sample_time: float
    band_hz: float
    level: float
    snr_db: float | None
    feedback: float | None


def draw_bench(rng: np.random.Generator) -> Bench:
    """A beam or a rod at random, with its actuators, a hammer, sensors, levels and noise."""
    draw = (_long_beam, _tapered_beam, _ruler, _tapered_rod)[rng.integers(4)]
    structure, sensors = draw(rng)
    length = structure.length
    n_actuators = int(rng.integers(2, 5))
    places = (np.arange(1, n_actuators + 1) + rng.uniform(-0.3, 0.3, n_actuators)) * length / (n_actuators + 1)
    places = np.round(places, 3)
    strike = round(float(rng.uniform(0.35, 0.9)) * length, 3)
    while np.abs(places - strike).min() < 0.03 * length:
        strike = round(float(rng.uniform(0.35, 0.9)) * length, 3)
    actuators = [Actuator(f"F{i + 1}", float(x)) for i, x in enumerate(places)]
    actuators.append(Actuator("hammer", strike, direct=True))
    modes = structure.modes(int(rng.integers(12, 17)), tolerance=1e-9)
    rig = Rig(modes, tuple(actuators), sensors, structure=structure)
    return _suited(rig, rng)


def bench_of(case: Case) -> Bench:
    """The bench that a case was tested on: its rig and noise, and from its records to fit the sample time, the band
    that holds 95 % of the loudest actuator's power, and the level of the loudest record.

    Raises:
        ValueError: records in which no actuator acts.
    """
    rows = [j for j, a in enumerate(case.rig.actuators) if not a.direct]
    if not rows:
        raise ValueError("every input of the case is a hammer; a trial needs an actuator to command")
    level = {record: np.sqrt(np.mean(record.inputs[rows] ** 2, axis=1)).max() for record in case.fit}
    loudest = max(level, key=lambda record: level[record])
    if not level[loudest] > 0:
        raise ValueError("no actuator acts in any record to fit; a trial takes its level and band from there")
    row = rows[int(np.argmax(np.mean(loudest.inputs[rows] ** 2, axis=1)))]
    power = np.cumsum(np.abs(np.fft.rfft(loudest.inputs[row] - loudest.inputs[row].mean())) ** 2)
    frequency = np.fft.rfftfreq(loudest.n_samples, loudest.sample_time)
    band = float(frequency[np.searchsorted(power, 0.95 * power[-1])])
    return Bench(case.rig, loudest.sample_time, band, float(level[loudest]), None, None)


def _suited(rig: Rig, rng: np.random.Generator) -> Bench:
    """A bench with sample time, band, level and noise that suit a rig."""
    top = min(int(rng.integers(3, 6)), rig.modes.n_modes) - 1
    band = 1.1 * float(rig.modes.omega[top]) / (2.0 * np.pi)
    snr_db = float(rng.choice([30.0, 40.0, 50.0]))
    bench = Bench(rig, float(f"{0.095 / band:.2g}"), band, 1.0, snr_db, None)
    plant = Plant.of(rig).solved()
    commands = multisine(bench, rng)
    moved, _ = plant.move(commands, bench.sample_time)
    widest = np.sqrt(np.mean((plant.at_actuators @ moved[0].T) ** 2, axis=1)).max()
    level = float(f"{rig.modes.length * np.exp(rng.uniform(np.log(0.001), np.log(0.02))) / widest:.2g}")
    fastest = np.sqrt(np.mean((plant.at_actuators @ moved[1].T) ** 2, axis=1)).max()
    low = plant.readings(moved, bench.sample_time).std(axis=1) * level * LEVELS["low"]
    noise = [float(f"{10 ** (-snr_db / 20) * value:.6g}") for value in low]
    sensors = tuple(replace(s, noise_std=n) for s, n in zip(rig.sensors, noise, strict=True))
    feedback = float(rng.uniform(0.2, 0.6)) / fastest if rng.random() < 0.6 else None
    return replace(bench, rig=replace(rig, sensors=sensors), level=level, feedback=feedback)


def multisine(bench: Bench, rng: np.random.Generator) -> np.ndarray:
    """Commands (n_inputs, n_samples) of unit rms: equal lines of random phase from 0.04 of the band up to it."""
    lines = np.arange(1, SAMPLES // 2)
    frequency = lines / (SAMPLES * bench.sample_time)
    lines = lines[(frequency >= 0.04 * bench.band_hz) & (frequency <= bench.band_hz)]
    commands = np.zeros((len(bench.rig.actuators), SAMPLES))
    for j, actuator in enumerate(bench.rig.actuators):
        if not actuator.direct:
            phases = rng.uniform(0.0, 2.0 * np.pi, lines.size)
            wave = np.sin(2.0 * np.pi * np.outer(lines, np.arange(SAMPLES)) / SAMPLES + phases[:, None]).sum(axis=0)
            commands[j] = wave / np.sqrt(np.mean(wave**2))
    return commands


def _random(bench: Bench, rng: np.random.Generator) -> np.ndarray:
    commands = np.zeros((len(bench.rig.actuators), SAMPLES))
    for j, actuator in enumerate(bench.rig.actuators):
        if not actuator.direct:
            commands[j] = coloured_noise(rng, SAMPLES, bench.sample_time, 0.9 * bench.band_hz)
    return commands


def _strike(bench: Bench, commands: np.ndarray, sample: int, share: float = 1.0) -> np.ndarray:
    commands = commands.copy()
    for j, actuator in enumerate(bench.rig.actuators):
        if actuator.direct:
            commands[j, sample : sample + 2] = share * STRIKE * bench.level
    return commands


def experiments(bench: Bench, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The inputs of every record by name, (n_inputs, n_samples); of `closed_loop` what is added to the feedback."""
    tests = {name: share * bench.level * multisine(bench, rng) for name, share in LEVELS.items()}
    still = np.zeros_like(tests["low"])
    if any(a.direct for a in bench.rig.actuators):
        tests["hammer"] = _strike(bench, still, 20)
    tests["validate"] = _strike(bench, 0.75 * bench.level * _random(bench, rng), SAMPLES * 5 // 8)
    if bench.feedback is not None:
        tests["closed_loop"] = _strike(bench, 0.5 * bench.level * _random(bench, rng), SAMPLES // 3, 0.5)
    return tests


def tested(
    plant: SolvedPlant, bench: Bench, name: str, commands: np.ndarray, rng: np.random.Generator | None = None
) -> tuple[ModalMotion, np.ndarray]:
    """The motion of a plant in one of the experiments, and the commands that were sent."""
    feedback = (bench.feedback or 0.0) if name == "closed_loop" else 0.0
    return plant.move(commands, bench.sample_time, feedback=feedback, rng=rng)


# --- families of rigs


def _sensors(rng: np.random.Generator, places: np.ndarray, quantities: str) -> tuple[Sensor, ...]:
    """d1, d2, ..., v1, ...: a letter of `quantities` a place."""
    words = {"d": "displacement", "v": "velocity", "a": "acceleration"}
    return tuple(
        Sensor(f"{q}{quantities[: i + 1].count(q)}", round(float(x), 4), words[q])
        for i, (x, q) in enumerate(zip(places, quantities, strict=True))
    )


def _around(value: float, rng: np.random.Generator) -> float:
    return round(value * float(rng.uniform(0.7, 1.3)), 2)


def _damping(rng: np.random.Generator) -> ModalDamping:
    return ModalDamping(round(float(rng.uniform(0.003, 0.01)), 4))


def _long_beam(rng: np.random.Generator) -> tuple[Structure, tuple[Sensor, ...]]:
    n = int(rng.integers(4, 7))
    places = np.tile(np.arange(1, n + 1) * 10.0 / (n + 1), 2)
    beam = Beam(
        length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged", damping=_damping(rng)
    )
    return beam, _sensors(rng, places, "d" * n + "v" * n)


def _tapered_beam(rng: np.random.Generator) -> tuple[Structure, tuple[Sensor, ...]]:
    n = int(rng.integers(5, 9))
    ends = (["clamped", "hinged"], ["clamped", "clamped"], ["hinged", "clamped"])[rng.integers(3)]
    beam = Beam(
        length=10.0,
        mass_per_length=([0.0, 10.0], [_around(1.5, rng), _around(0.75, rng)]),
        bending_stiffness=([0.0, 10.0], [_around(2.0, rng), _around(0.75, rng)]),
        left=ends[0],
        right=ends[1],
        damping=_damping(rng),
    )
    return beam, _sensors(rng, np.arange(1, n + 1) * 10.0 / (n + 1), "d" * (n // 2) + "v" * (n - n // 2))


def _ruler(rng: np.random.Generator) -> tuple[Structure, tuple[Sensor, ...]]:
    n = int(rng.integers(4, 7))
    beam = Beam(
        length=0.8,
        mass_per_length=round(float(rng.uniform(0.2, 0.6)), 3),
        bending_stiffness=round(float(rng.uniform(5.0, 20.0)), 2),
        left="clamped",
        right="free",
        damping=_damping(rng),
    )
    places = np.r_[np.arange(1, n + 1) * 0.8 / n, 0.8]
    return beam, _sensors(rng, places, "a" * n + "v")


def _tapered_rod(rng: np.random.Generator) -> tuple[Structure, tuple[Sensor, ...]]:
    n = int(rng.integers(5, 8))
    end = round(float(rng.choice([0.0, 0.5, 1.0])), 1)
    rod = Bar(
        length=1.0,
        mass_per_length=([0.0, 1.0], [2.0, end]),
        axial_stiffness=([0.0, 1.0], [2.0, end]),
        left="fixed",
        right="free",
        damping=_damping(rng),
    )
    return rod, _sensors(rng, np.arange(1, n + 1) / n, "d" * n)
