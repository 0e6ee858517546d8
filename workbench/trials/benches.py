"""Benches of blind trials: nominal rigs, their experiments, and their nominal motion."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from workbench.arrays import Floats
from workbench.cases.case import Case
from workbench.rig.rig import Rig
from workbench.structure.member import Structure
from workbench.trials.finite_elements import Frame
from workbench.trials.plant import ModalMotion, Plant, SolvedPlant, coloured_noise
from workbench.trials.rigs import MEMBERS, draw_rig

SAMPLES = 2000
LEVELS = {"low": 0.25, "high": 1.0, "mid": 0.625}
STRIKE = 6.25  # force of a hammer, over the rms of the high level


@dataclass(frozen=True, eq=False)
class Bench:
    """A nominal rig and the settings of its tests.

    Attributes:
        rig: the nominal rig, with the noise of its sensors.
        sample_time: s.
        band_hz: upper frequency of the excitation.
        level: rms of the high level, N.
        snr_db: signal-to-noise ratio of each sensor in the low record of the nominal structure; None for given noise.
        feedback: gain of the closed-loop record, N s/m; None for no such record.
        frame: makes the matrices behind the modes at named points; None for a member, a plate or plain modal data.
    """

    rig: Rig
    sample_time: float
    band_hz: float
    level: float
    snr_db: float | None
    feedback: float | None
    frame: Frame | None = None

    def plant(self) -> Plant:
        """The real structure, equal to the nominal rig."""
        return Plant.of(self.rig, self.frame)


def draw_bench(rng: np.random.Generator, structure: str = MEMBERS) -> Bench:
    """A random structure with actuators, a hammer, sensors, levels and noise; a member may have a closed-loop record.

    Args:
        structure: "members" for a beam or a rod, "plates", or "frames", whose rig has only modes at named points.
    """
    rig, frame = draw_rig(rng, structure)
    top = min(int(rng.integers(3, 6)), rig.modes.n_modes) - 1
    band = 1.1 * float(rig.modes.omega[top]) / (2.0 * np.pi)
    snr_db = float(rng.choice([30.0, 40.0, 50.0]))
    bench = Bench(rig, float(f"{0.095 / band:.2g}"), band, 1.0, snr_db, None, frame)
    plant = bench.plant().solved()
    commands = multisine(bench, rng)
    moved, _ = plant.move(commands, bench.sample_time)
    widest, fastest = (np.sqrt(np.mean((plant.at_actuators @ m.T) ** 2, axis=1)).max() for m in moved[:2])
    level = float(f"{rig.modes.domain.size * np.exp(rng.uniform(np.log(0.001), np.log(0.02))) / widest:.2g}")
    low = plant.readings(moved, bench.sample_time).std(axis=1) * level * LEVELS["low"]
    noise = [float(f"{10 ** (-snr_db / 20) * value:.6g}") for value in low]
    sensors = tuple(replace(s, noise_std=n) for s, n in zip(rig.sensors, noise, strict=True))
    closed = isinstance(rig.structure, Structure) and rng.random() < 0.6
    feedback = float(rng.uniform(0.2, 0.6)) / fastest if closed else None
    return replace(bench, rig=replace(rig, sensors=sensors), level=level, feedback=feedback)


def bench_of(case: Case) -> Bench:
    """The bench of a case: its rig with noise; sample time and level of the record to fit with the largest input rms.

    The band of the bench contains 95 % of the power of the largest input of this record.

    Raises:
        ValueError: no actuator acts in the records.
    """
    rows = [j for j, a in enumerate(case.rig.actuators) if not a.direct]
    if not rows:
        raise ValueError("every input of the case is a measured force (hammer); a trial needs an actuator to command")
    strongest = max(case.fit, key=lambda record: np.mean(record.inputs[rows] ** 2, axis=1).max())
    squares = np.mean(strongest.inputs[rows] ** 2, axis=1)
    if not squares.max() > 0:
        raise ValueError("no actuator acts in any record to fit; a trial takes its level and band from there")
    signal = strongest.inputs[rows[int(np.argmax(squares))]]
    power = np.cumsum(np.abs(np.fft.rfft(signal - signal.mean())) ** 2)
    frequency = np.fft.rfftfreq(strongest.n_samples, strongest.sample_time)
    band = float(frequency[np.searchsorted(power, 0.95 * power[-1])])
    return Bench(case.rig, strongest.sample_time, band, float(np.sqrt(squares.max())), None, None)


def multisine(bench: Bench, rng: np.random.Generator) -> np.ndarray:
    """Multisine commands (n_inputs, n_samples) of unit rms: equal lines of random phase over 0.04 to 1 of the band."""
    lines = np.arange(1, SAMPLES // 2)
    frequency = lines / (SAMPLES * bench.sample_time)
    lines = lines[(frequency >= 0.04 * bench.band_hz) & (frequency <= bench.band_hz)]

    def wave() -> Floats:
        phases = rng.uniform(0.0, 2.0 * np.pi, lines.size)
        angles = 2.0 * np.pi * np.outer(lines, np.arange(SAMPLES)) / SAMPLES + phases[:, None]
        values: Floats = np.sin(angles).sum(axis=0)
        return values / float(np.sqrt(np.mean(values**2)))

    return _commands(bench, wave)


def _commands(bench: Bench, wave: Callable[[], Floats]) -> np.ndarray:
    """Commands (n_inputs, n_samples) with a wave (n_samples,) for each actuator, and hammers at rest."""
    return np.array([np.zeros(SAMPLES) if actuator.direct else wave() for actuator in bench.rig.actuators])


def _strike(bench: Bench, commands: np.ndarray, sample: int, share: float = 1.0) -> np.ndarray:
    commands = commands.copy()
    commands[[actuator.direct for actuator in bench.rig.actuators], sample : sample + 2] = share * STRIKE * bench.level
    return commands


def experiments(bench: Bench, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The commands (n_inputs, n_samples) of every record by name; those of `closed_loop` are added to the feedback."""

    def noise() -> Floats:
        return coloured_noise(rng, SAMPLES, bench.sample_time, 0.9 * bench.band_hz)

    tests = {name: share * bench.level * multisine(bench, rng) for name, share in LEVELS.items()}
    still = np.zeros_like(tests["low"])
    if any(a.direct for a in bench.rig.actuators):
        tests["hammer"] = _strike(bench, still, 20)
    tests["validate"] = _strike(bench, 0.75 * bench.level * _commands(bench, noise), SAMPLES * 5 // 8)
    if bench.feedback is not None:
        tests["closed_loop"] = _strike(bench, 0.5 * bench.level * _commands(bench, noise), SAMPLES // 3, 0.5)
    return tests


def tested(
    plant: SolvedPlant, bench: Bench, name: str, commands: np.ndarray, rng: np.random.Generator
) -> tuple[ModalMotion, np.ndarray]:
    """The motion of a plant in one of the experiments, and the commands sent to its actuators."""
    feedback = (bench.feedback or 0.0) if name == "closed_loop" else 0.0
    return plant.move(commands, bench.sample_time, feedback=feedback, rng=rng)


class Unsuitable(ValueError):
    """A kind that is impossible on a bench, or a draw without a detectable gap."""


def relative_gap(difference: np.ndarray, measured: np.ndarray) -> float:
    """The rms of a difference (n_outputs, n_samples or 1) over the standard deviation of each measured output."""
    scale = measured.std(axis=1, keepdims=True)
    return float(np.sqrt(np.mean((difference / np.where(scale > 0, scale, 1.0)) ** 2)))
