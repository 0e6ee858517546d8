"""The real structure of a blind trial: a nominal rig and all differences from it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.special import ndtr

from workbench.arrays import Floats
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import MEASURED, Sensor
from workbench.structure.domain import Location
from workbench.structure.member import Structure
from workbench.structure.plate import Plate
from workbench.trials import motion
from workbench.trials.finite_elements import Alterations, ElementModes, Frame, element_modes, matrix_modes, modal_modes
from workbench.trials.plate_elements import plate_modes

FINEST = 0.05  # radians of the highest mode in one step
DRAG_POINTS = 48


@dataclass(frozen=True, eq=False)
class Plant:
    """A real structure.

    Attributes:
        nominal: the nominal rig.
        actuators, sensors, n_modes: the real ones, in the nominal order.
        frame: makes the matrices behind nominal modes at named points; None for a member, a plate or modal data.
        altered: differences of the structure from the nominal one.
        damping_factor: of every damping ratio.
        damping_factors: of the damping ratios of the lowest modes; 1 for higher modes.
        laws: (code, at, parameters) of forces at points, with the codes of `laws`.
        drag, stretching, stiffness_rate: N s²/m³, N/m, 1/s.
        tones: (at, amplitude, frequency in Hz, phase) of unmeasured forces.
        noises: (at, rms, corner in Hz) of unmeasured random forces.
        mix: (n_inputs, n_inputs) share of every command in that of each actuator; None for the identity.
        curvature: (n_inputs,) of u + curvature u |u|; None for none.
        crosstalk: (output, other output, share of what the other measures), before the output's delay.
        reading_laws: readings (n_outputs, n_samples), sample time -> readings, before gain and bias.
        noise_memory: lag-one correlation of a sensor's noise; 0 for white noise.
        logging_noise: standard deviation of the noise of each logged input, over the input's rms in a record.
    """

    nominal: Rig
    actuators: tuple[Actuator, ...]
    sensors: tuple[Sensor, ...]
    n_modes: int
    frame: Frame | None = None
    altered: Alterations = field(default_factory=Alterations)
    damping_factor: float = 1.0
    damping_factors: tuple[float, ...] = ()
    laws: tuple[tuple[int, Location, tuple[float, ...]], ...] = ()
    drag: float = 0.0
    stretching: float = 0.0
    stiffness_rate: float = 0.0
    tones: tuple[tuple[Location, float, float, float], ...] = ()
    noises: tuple[tuple[Location, float, float], ...] = ()
    mix: np.ndarray | None = None
    curvature: np.ndarray | None = None
    crosstalk: tuple[tuple[str, str, float], ...] = ()
    reading_laws: tuple[Callable[[np.ndarray, float], np.ndarray], ...] = ()
    noise_memory: float = 0.0
    logging_noise: float = 0.0

    @classmethod
    def of(cls, nominal: Rig, frame: Frame | None = None) -> "Plant":
        """The real structure equal to the nominal rig."""
        return cls(nominal, nominal.actuators, nominal.sensors, nominal.modes.n_modes, frame)

    def solved(self) -> "SolvedPlant":
        """The plant with its modes computed."""
        domain = self.nominal.modes.domain
        field_places, weights = domain.quadrature(DRAG_POINTS) if self.drag else (np.zeros(0), np.zeros(0))
        groups: list[list[Any] | np.ndarray] = [
            [a.at for a in self.actuators],
            [s.at for s in self.sensors],
            [at for _, at, _ in self.laws],
            [tone[0] for tone in self.tones],
            [noise[0] for noise in self.noises],
            field_places,
        ]
        modes = self._modes([x for group in groups for x in group])
        shapes = np.split(modes.shapes, np.cumsum([len(group) for group in groups])[:-1])
        at_actuators, at_sensors, at_laws, at_tones, at_noises, field = map(np.ascontiguousarray, shapes)

        def each(name: str) -> Floats:
            return np.array([getattr(a, name) for a in self.actuators], float)

        system = motion.System(
            omega2=modes.omega**2,
            damping=2.0 * self._damping_ratios() * modes.omega,
            gram=modes.gram,
            stretching=float(self.stretching),
            stiffness_rate=float(self.stiffness_rate),
            lags=each("time_constant"),
            rate_limits=each("rate_limit"),
            biases=each("bias"),
            at_actuators=at_actuators,
            tones=np.array([[a, 2.0 * np.pi * f, p] for _, a, f, p in self.tones]).reshape(-1, 3),
            at_tones=at_tones,
            laws=np.array([[code, *p, *[1.0] * (3 - len(p))] for code, _, p in self.laws]).reshape(-1, 4),
            at_laws=at_laws,
            drag=float(self.drag),
            field=np.ascontiguousarray(np.c_[field, weights]),
        )
        drive = motion.Drive(
            mix=np.eye(len(self.actuators)) if self.mix is None else self.mix,
            curvature=np.zeros(len(self.actuators)) if self.curvature is None else self.curvature,
            share=each("hysteresis_share"),
            width=each("hysteresis_width"),
            gain=each("gain"),
            dead_zone=each("dead_zone"),
            limit=each("limit"),
            delays=each("delay"),
        )
        return SolvedPlant(self, modes, system, drive, at_actuators, at_sensors, at_noises)

    def _modes(self, places: list[Any]) -> ElementModes:
        structure = self.nominal.structure
        if isinstance(structure, Structure):
            return element_modes(structure, np.array(places, float), self.n_modes, altered=self.altered)
        if isinstance(structure, Plate):
            return plate_modes(structure, places, self.n_modes, altered=self.altered)
        if self.frame is not None:
            frame = self.frame(stiffness_waves=self.altered.stiffness_waves, mass_waves=self.altered.mass_waves)
            altered = replace(self.altered, stiffness_waves=(), mass_waves=())
            return matrix_modes(frame, places, self.n_modes, altered=altered)
        return modal_modes(self.nominal.modes, places, altered=self.altered)

    def _damping_ratios(self) -> Floats:
        """The damping ratio of each mode; modes above the nominal ones have the last nominal ratio."""
        zeta, factors = self.nominal.modes.zeta, np.ones(self.n_modes)
        known = self.damping_factors[: self.n_modes]
        factors[: len(known)] = known
        padded: Floats = zeta[np.minimum(np.arange(self.n_modes), zeta.size - 1)]
        return self.damping_factor * factors * padded


class ModalMotion(NamedTuple):
    """Modal displacement, velocity and acceleration at the samples, each (n_samples, n_modes), and between them.

    Attributes:
        starts: (n_pieces,) fractions of a sample interval.
        pieces: (3, n_pieces, n_samples, n_modes) the motion at these.
    """

    displacement: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    starts: np.ndarray
    pieces: np.ndarray


@dataclass(frozen=True, eq=False)
class SolvedPlant:
    """A plant with its modes, as `motion` integrates it; shapes are (n_places, n_modes)."""

    plant: Plant
    modes: ElementModes
    system: motion.System
    drive: motion.Drive
    at_actuators: np.ndarray
    at_sensors: np.ndarray
    at_noises: np.ndarray

    def move(
        self,
        commands: np.ndarray,
        sample_time: float,
        *,
        feedback: float = 0.0,
        rng: np.random.Generator | None = None,
        finest: float = FINEST,
    ) -> tuple[ModalMotion, np.ndarray]:
        """The modal motion, and the commands sent to the actuators.

        Args:
            commands: (n_inputs, n_samples), added to those of the feedback.
            sample_time: s.
            feedback: gain of the negative feedback of the velocity at each actuator, N s/m.
            rng: generator of the random forces; None for no random forces.
            finest: radians of the highest mode in one step.
        """
        pieces = self.pieces(sample_time, finest)
        held = self.random_forces(commands.shape[1], sample_time, rng)
        acting = np.array([not a.direct for a in self.plant.actuators], float)
        sent = np.array(commands, float, order="C")
        feedbacks = feedback * acting[:, None] * self.at_actuators
        moved = motion.integrate(self.system, self.drive, pieces, sent, feedbacks, held)
        return ModalMotion(moved[0, 0], moved[1, 0], moved[2, 0], np.r_[0.0, pieces.edges[:-1]], moved), sent

    def random_forces(self, n_samples: int, sample_time: float, rng: np.random.Generator | None) -> np.ndarray:
        """Unmeasured random modal forces (n_samples, n_modes), constant over each sample; zero without `rng`."""
        held = np.zeros((n_samples, self.plant.n_modes))
        if rng is not None:
            for (_, rms, corner), shape in zip(self.plant.noises, self.at_noises, strict=True):
                held += np.outer(rms * coloured_noise(rng, n_samples, sample_time, corner), shape)
        return held

    def pieces(self, sample_time: float, finest: float = FINEST) -> motion.Pieces:
        """The pieces of a sample interval, which end where a command arrives or a late sensor reads."""
        plant = self.plant
        late = [a.delay / sample_time for a in plant.actuators] + [-s.delay / sample_time for s in plant.sensors]
        ends = np.unique(np.round([*(delay % 1.0 for delay in late), 1.0], 12))
        edges = ends[ends > 0]
        turns = max(self.modes.omega[-1] * sample_time / finest, 8.0)
        steps = np.ceil(turns * np.diff(np.r_[0.0, edges])).astype(np.int64)
        return motion.Pieces(float(sample_time), edges, steps)

    def truth(self, moved: ModalMotion, sample_time: float) -> np.ndarray:
        """The readings (n_outputs, n_samples) of perfect sensors, each with its delay and then shares of others."""
        sensors, names = self.plant.sensors, [sensor.name for sensor in self.plant.sensors]
        y = [self._true(j, sensor, moved, sample_time) for j, sensor in enumerate(sensors)]
        for output, source, share in self.plant.crosstalk:
            j, i = names.index(output), names.index(source)
            as_late = replace(sensors[i], delay=sensors[j].delay, interpolated=sensors[j].interpolated)
            y[j] = y[j] + share * self._true(i, as_late, moved, sample_time)
        return np.array(y)

    def _true(self, j: int, sensor: Sensor, moved: ModalMotion, sample_time: float) -> np.ndarray:
        """The reading (n_samples,) of a perfect sensor, at the place of the j-th, with its delay."""
        order, shape = MEASURED[sensor.quantity][1], self.at_sensors[j]
        if sensor.delay == 0:
            return np.asarray(moved[order] @ shape)
        if sensor.interpolated:
            whole, share = divmod(sensor.delay / sample_time, 1.0)
            each = moved[order] @ shape
            older = np.r_[np.full(int(whole) + 1, each[0]), each]
            return np.asarray((1.0 - share) * older[1 : each.size + 1] + share * older[: each.size])
        back = np.round(-sensor.delay / sample_time, 12)
        read = moved.pieces[order, int(np.argmin(np.abs(moved.starts - back % 1.0)))] @ shape
        return np.asarray(np.r_[np.zeros(-int(np.floor(back))), read][: read.size])

    def readings(self, moved: ModalMotion, sample_time: float, rng: np.random.Generator | None = None) -> np.ndarray:
        """The readings (n_outputs, n_samples) of the sensors; without `rng` their mean over the noise."""
        y = self.truth(moved, sample_time)
        for law in self.plant.reading_laws:
            y = law(y, sample_time)
        rows = []
        for sensor, row in zip(self.plant.sensors, y, strict=True):
            noise = 0.0 if rng is None else sensor.noise_std * sensor_noise(rng, row.size, self.plant.noise_memory)
            row = measured(sensor, _lag(row, sensor.time_constant, sample_time), np.arange(row.size), row.size, noise)
            if sensor.step > 0 and rng is None and sensor.noise_std > 0:
                row = _mean_rounded(row, sensor.step, sensor.noise_std)
            elif sensor.step > 0:
                row = sensor.step * np.round(row / sensor.step)
            rows.append(row)
        return np.array(rows)


def coloured_noise(rng: np.random.Generator, n_samples: int, sample_time: float, corner_hz: float) -> Floats:
    """Gaussian noise (n_samples,) of unit rms, white up to a corner frequency, with a steep roll-off above it."""
    spectrum = np.fft.rfft(rng.standard_normal(2 * n_samples))
    frequency = np.fft.rfftfreq(2 * n_samples, sample_time)
    noise: Floats = np.fft.irfft(spectrum / np.sqrt(1.0 + (frequency / corner_hz) ** 8), 2 * n_samples)[:n_samples]
    return noise / float(np.sqrt(np.mean(noise**2)))


def sensor_noise(rng: np.random.Generator, n_samples: int, memory: float) -> np.ndarray:
    """Gaussian noise of unit standard deviation, e_k = memory e_{k-1} + sqrt(1 - memory²) white, e_0 white."""
    white = rng.standard_normal(n_samples)
    if memory == 0:
        return white
    later, _ = lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], white[1:], zi=[memory * white[0]])
    return np.asarray(np.r_[white[0], later])


def lagged(out: float, before: float, now: float, time_constant: float, sample_time: float) -> Any:
    """The output of a first-order lag a sample after `out`, as its input goes evenly from `before` to `now`."""
    slope = (now - before) / sample_time
    behind = out - before + slope * time_constant
    return now - slope * time_constant + behind * np.exp(-sample_time / time_constant)


def _lag(y: np.ndarray, time_constant: float, sample_time: float) -> np.ndarray:
    """First-order lag of a signal that is linear between samples, initially settled at its first value."""
    if time_constant == 0:
        return y
    out = y.copy()
    for k in range(1, y.size):
        out[k] = lagged(out[k - 1], y[k - 1], y[k], time_constant, sample_time)
    return out


def measured(sensor: Sensor, y: Any, k: Any, n_samples: int, noise: Any) -> Any:
    """The unrounded readings of a sensor at the samples k of a record, from its lagged input y there, and its noise."""
    drifted = sensor.gain * y + sensor.bias + sensor.drift * k / (n_samples - 1)
    return np.clip(drifted + noise, -sensor.limit, sensor.limit)


def _mean_rounded(y: Floats, step: float, noise_std: float) -> Floats:
    """The mean of step round((y + noise) / step): a sum of the probabilities that noise crosses each half step."""
    nearest = np.round(y / step)
    reach = np.arange(int(np.ceil(8.0 * noise_std / step)) + 1)[:, None] + 0.5
    above: Floats = ndtr((y - (nearest + reach) * step) / noise_std).sum(axis=0)
    below: Floats = ndtr(((nearest - reach) * step - y) / noise_std).sum(axis=0)
    return step * (nearest + above - below)
