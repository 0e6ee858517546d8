"""Simulation of a hidden plant under a digital controller, by the numerical method of the trials."""

from dataclasses import dataclass

import numpy as np

from workbench.design.estimation.digital import DigitalController
from workbench.rig.sensors import MEASURED, Sensor
from workbench.robust.verification import settling
from workbench.trials import motion
from workbench.trials.plant import SolvedPlant, lagged, measured, sensor_noise

RUN_AWAY = 1e6  # times the energy that the impulse gives


@dataclass(frozen=True, eq=False)
class PlantResponse:
    """The response of a plant under a controller.

    Attributes:
        modal_energy: (n_modes, n_samples) energy of each mode.
        work: (n_modes,) work of the actuators in each mode.
        effort: ∫ FᵀF dt.
        peak_force: largest force of any actuator, N.
        bounded: whether the energy stayed below a million times that of the impulse.
        outputs: (n_outputs, n_samples) readings of the controller's sensors.
    """

    modal_energy: np.ndarray
    work: np.ndarray
    effort: float
    peak_force: float
    bounded: bool
    sample_time: float
    outputs: np.ndarray

    @property
    def energy(self) -> np.ndarray:
        """(n_samples,) energy of all modes."""
        return np.asarray(self.modal_energy.sum(axis=0))

    @property
    def vibration(self) -> float:
        """∫ of the energy of all modes over time; infinite if the motion is not bounded."""
        return float(self.energy.sum() * self.sample_time) if self.bounded else np.inf

    @property
    def stable(self) -> bool:
        """Whether the motion is bounded, and its energy peaks lower in the last quarter than in the first."""
        quarter = max(self.energy.size // 4, 1)
        return self.bounded and bool(self.energy[-quarter:].max() < self.energy[:quarter].max())

    def settling(self, modes: int | None = None) -> float | None:
        """Time after which the energy stays below a hundredth of its peak, s; None if it does not within the test.

        Of the energy of that many modes, lowest first; of all unless given.
        """
        time = settling(self.modal_energy[:modes].sum(axis=0), self.sample_time)
        return time if self.bounded and np.isfinite(time) else None


def control_plant(
    real: SolvedPlant,
    controller: DigitalController,
    *,
    n_samples: int,
    impulse_input: str,
    impulse: float = 1.0,
    rng: np.random.Generator | None = None,
) -> PlantResponse:
    """The response of the plant to an impulse at one of its inputs, under control.

    Args:
        controller: its sensors and actuators are those of the plant of the same names.
        n_samples: length of the test, at the controller's sample time.
        impulse_input: name of the input at which the impulse acts.
        impulse: N s.
        rng: generator of the sensors' noise and of random forces; None for neither.
    """
    plant, dt = real.plant, controller.sample_time
    m, n = real.at_actuators.shape
    system, pieces = real.system, real.pieces(dt)
    inputs = [a.name for a in plant.actuators]
    commanded = [inputs.index(name) for name in controller.actuators]
    noise = np.zeros((len(plant.sensors), n_samples))
    if rng is not None:
        noise = np.array([s.noise_std * sensor_noise(rng, n_samples, plant.noise_memory) for s in plant.sensors])
    reading = _Reading(real, controller, noise)
    held = real.random_forces(n_samples, dt, rng)
    state = motion.at_rest(system, n_samples)
    displacement, velocity = state.y[:n], state.y[n : 2 * n]
    velocity[:] = impulse * real.at_actuators[inputs.index(impulse_input)]
    given = 0.5 * float(velocity @ velocity)
    moved = np.zeros((n_samples, 3, pieces.edges.size, n))
    sums = motion.Sums(squares=np.zeros(m), work=np.zeros(n), peaks=np.zeros(m))
    z, followed = np.zeros(controller.A.shape[0]), np.zeros(len(commanded))
    energy, outputs, bounded = np.zeros((n, n_samples)), np.zeros((len(controller.sensors), n_samples)), True
    for k in range(n_samples):
        energy[:, k] = 0.5 * (velocity**2 + system.omega2 * displacement**2)
        bounded = bool(energy[:, k].sum() < RUN_AWAY * given)
        if not bounded:
            energy, outputs = energy[:, : k + 1], outputs[:, :k]
            break
        outputs[:, k] = reading.at(k, state.y, moved)
        commands = np.zeros(m)
        commands[commanded], followed, z = controller.step(z, followed, outputs[:, k])
        motion.interval(k, state, system, real.drive, pieces, commands, held[k], moved[k], sums)
    return PlantResponse(energy, sums.work, float(sums.squares.sum()), float(sums.peaks.max()), bounded, dt, outputs)


class _Reading:
    """The readings of the controller's sensors, sample by sample; `SolvedPlant.readings` does this for a record."""

    def __init__(self, real: SolvedPlant, controller: DigitalController, noise: np.ndarray):
        names, self.dt, self.noise = [s.name for s in real.plant.sensors], controller.sample_time, noise
        self.read = [names.index(name) for name in controller.sensors]
        self.sensors, self.shapes, self.laws = real.plant.sensors, real.at_sensors, real.plant.reading_laws
        self.starts = np.r_[0.0, real.pieces(self.dt).edges[:-1]]
        self.truth, (self.lagged, self.before) = np.zeros(noise.shape), np.zeros((2, len(names)))

    def at(self, k: int, y: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """The readings at sample k, from the state y there and the motion before it."""
        n = self.shapes.shape[1]
        for j, sensor in enumerate(self.sensors):
            order = MEASURED[sensor.quantity][1]
            late = max(np.round(sensor.delay / self.dt, 12), 0.0)  # in real time a reading is never ahead of the clock
            whole = int(np.ceil(late))
            if order > 1 or k < whole:
                continue
            piece = int(np.argmin(np.abs(self.starts - (whole - late))))
            then = moved[k - whole, order, piece] if whole else y[order * n : (order + 1) * n]
            self.truth[j, k] = self.shapes[j] @ then
        truth = self.truth[:, : k + 1]
        for law in self.laws:
            truth = law(truth, self.dt)
        readings = [self._reading(j, sensor, float(truth[j, -1]), k) for j, sensor in enumerate(self.sensors)]
        return np.array(readings)[self.read]

    def _reading(self, j: int, sensor: Sensor, y: float, k: int) -> float:
        if sensor.time_constant > 0:
            before, self.before[j] = self.before[j], y
            self.lagged[j] = y = lagged(self.lagged[j], before, y, sensor.time_constant, self.dt) if k else y
        y = float(measured(sensor, y, k, self.noise.shape[1], self.noise[j, k]))
        return float(sensor.step * np.round(y / sensor.step)) if sensor.step > 0 else y
