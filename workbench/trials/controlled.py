"""Simulation of a hidden plant under a digital controller, by the numerical method of the trials."""

from dataclasses import dataclass

import numpy as np

from workbench.design.estimation.digital import DigitalController
from workbench.rig.sensors import MEASURED, Sensor
from workbench.robust.verification import settling
from workbench.trials import motion
from workbench.trials.plant import FINEST, SolvedPlant, sensor_noise

RUN_AWAY = 1e6  # times the energy that the impulse gives


@dataclass(frozen=True, eq=False)
class Controlled:
    """The response of a plant under a controller.

    Attributes:
        modal_energy: (n_modes, n_samples) energy of each mode.
        work: (n_modes,) work of the actuators in each mode.
        effort: ∫ FᵀF dt.
        peak_force: largest force of any actuator, N.
        bounded: whether the energy stayed below a million times that of the impulse.
        sample_time: s.
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

        Args:
            modes: number of modes whose energy is summed, lowest first; all unless given.
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
    finest: float = FINEST,
) -> Controlled:
    """The response of the plant to an impulse at one of its inputs, under control.

    Args:
        real: the plant.
        controller: its sensors and actuators are those of the plant of the same names.
        n_samples: length of the test, at the controller's sample time.
        impulse_input: name of the input at which the impulse acts.
        impulse: N s.
        rng: generator of the sensors' noise and of random forces; None for neither.
        finest: radians of the highest mode in one step.
    """
    plant, n, dt = real.plant, real.plant.n_modes, controller.sample_time
    system, drive, edges, steps = real.system(dt, finest)
    m = len(plant.actuators)
    inputs = [a.name for a in plant.actuators]
    commanded = [inputs.index(name) for name in controller.actuators]
    reading = _Reading(real, controller, n_samples, edges, rng)
    held = real.random_forces(n_samples, dt, rng)
    size = 2 * n + m + system[3][0].shape[0]
    y, work = np.zeros(size), np.zeros((5, size))
    y[n : 2 * n] = impulse * real.at_actuators[inputs.index(impulse_input)]
    omega2 = system[0][0]
    given = 0.5 * float(y[n : 2 * n] @ y[n : 2 * n])
    pieces = np.zeros((n_samples, 3, edges.size, n))
    aims, now = np.zeros((m, n_samples)), np.zeros(m)
    earlier, hysteresis = np.zeros(m), np.zeros(m)
    headed_for = (np.zeros(m), np.zeros(m), np.zeros(1))
    sums = (np.zeros(m), np.zeros(m), np.zeros(n), np.zeros(m))
    z, followed = np.zeros(controller.a.shape[0]), np.zeros(len(commanded))
    energy, outputs = np.zeros((n, n_samples)), np.zeros((len(controller.sensors), n_samples))
    most = np.ascontiguousarray(drive[1][:, 3])
    for k in range(n_samples):
        energy[:, k] = 0.5 * (y[n : 2 * n] ** 2 + omega2 * y[:n] ** 2)
        if not energy[:, k].sum() < RUN_AWAY * given:
            effort, most_force = float(sums[1].sum()), float(sums[3].max())
            return Controlled(energy[:, : k + 1], sums[2], effort, most_force, False, dt, outputs[:, :k])
        outputs[:, k] = reading.at(k, y, pieces)
        command, followed, z = controller.step(z, followed, outputs[:, k])
        commands = np.zeros(m)
        commands[commanded] = command
        motion.aim(commands, drive, earlier, hysteresis, now)
        aims[:, k] = now
        motion.interval(k, y, system, most, aims, headed_for, held[k], dt, edges, steps, work, pieces[k], sums)
    return Controlled(energy, sums[2], float(sums[1].sum()), float(sums[3].max()), True, dt, outputs)


class _Reading:
    """The readings of the controller's sensors, sample by sample; `SolvedPlant.readings` does this for a record."""

    def __init__(
        self,
        real: SolvedPlant,
        controller: DigitalController,
        n_samples: int,
        edges: np.ndarray,
        rng: np.random.Generator | None,
    ):
        plant = real.plant
        names = [s.name for s in plant.sensors]
        self.read = [names.index(name) for name in controller.sensors]
        self.sensors, self.shapes, self.laws = plant.sensors, real.at_sensors, plant.reading_laws
        self.dt, self.n_samples, self.starts = controller.sample_time, n_samples, np.r_[0.0, edges[:-1]]
        self.truth = np.zeros((len(names), n_samples))
        self.lagged = np.zeros(len(names))
        self.before = np.zeros(len(names))
        self.noise = np.zeros((len(names), n_samples))
        if rng is not None:
            for row, sensor in zip(self.noise, plant.sensors, strict=True):
                row[:] = sensor.noise_std * sensor_noise(rng, n_samples, plant.noise_memory)

    def at(self, k: int, y: np.ndarray, pieces: np.ndarray) -> np.ndarray:
        n = self.shapes.shape[1]
        for j, sensor in enumerate(self.sensors):
            order = MEASURED[sensor.quantity][1]
            late = np.round(sensor.delay / self.dt, 12)
            if order > 1:
                continue
            if late <= 0:  # in real time a reading cannot be ahead of the clock
                self.truth[j, k] = self.shapes[j] @ y[order * n : (order + 1) * n]
                continue
            whole = int(np.ceil(late))
            if k >= whole:
                piece = int(np.argmin(np.abs(self.starts - (whole - late))))
                self.truth[j, k] = self.shapes[j] @ pieces[k - whole, order, piece]
        truth = self.truth[:, : k + 1]
        for law in self.laws:
            truth = law(truth, self.dt)
        out = np.empty(len(self.sensors))
        for j, sensor in enumerate(self.sensors):
            out[j] = self._one(j, sensor, float(truth[j, -1]), k)
        return out[self.read]

    def _one(self, j: int, sensor: Sensor, true: float, k: int) -> float:
        y = true
        if sensor.time_constant > 0:
            if k == 0:
                self.lagged[j] = y
            else:
                slope = (y - self.before[j]) / self.dt
                behind = self.lagged[j] - self.before[j] + slope * sensor.time_constant
                self.lagged[j] = y - slope * sensor.time_constant + behind * np.exp(-self.dt / sensor.time_constant)
            self.before[j], y = y, self.lagged[j]
        y = sensor.gain * y + sensor.bias + sensor.drift * k / (self.n_samples - 1) + self.noise[j, k]
        y = float(np.clip(y, -sensor.limit, sensor.limit))
        return float(sensor.step * np.round(y / sensor.step)) if sensor.step > 0 else y
