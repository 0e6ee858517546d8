"""Innovations: errors of one-step-ahead predictions by a rig with all its laws, corrected at every sample."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.linalg import expm

from workbench.arrays import Floats
from workbench.gap.prediction.unmodelled_force import driven, force_filter, sampled_model
from workbench.records.record import Record
from workbench.rig.motion import Motion
from workbench.rig.readings import read, reading_of
from workbench.rig.rig import KEPT, Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import move, prediction_errors
from workbench.structure.domain import Interval, Location
from workbench.structure.modes import Modes

PROCESS_NOISE = 0.01  # of the inputs' rms: process noise forces that set the observer gain
SQUARINGS = 12  # squarings of the transition matrix in the test of stability: eight are enough for most
MAX_SQUARED_NORM = 1e100  # squared norm of a matrix power that can be squared once more without overflow


@dataclass(frozen=True, eq=False)
class Observer:
    """A steady-state Kalman filter of a rig's modes, with random forces on all of them.

    Attributes:
        gains: (2, n_modes, n_outputs) of their displacements and velocities, by sample time.
        whitening: (n_outputs, n_outputs) matrix that gives innovations unit covariance, by sample time.
        sensors: that it is designed for.
    """

    gains: Mapping[float, Floats]
    whitening: Mapping[float, Floats]
    sensors: tuple[Sensor, ...]

    @classmethod
    def of(
        cls,
        rig: Rig,
        noise: np.ndarray,
        force: float,
        sample_times: Iterable[float],
        *,
        at: Location | None = None,
        rms: float = 0.0,
        process_noise: float = PROCESS_NOISE,
    ) -> "Observer":
        """The observer of a rig with sensors of noise standard deviations `noise` (n_outputs,).

        force: rms of the inputs, N; at, rms: place and rms, N, of a further random force; process_noise: rms of the
        forces that act as process noise, over that of the inputs: the less, the lower the gain.
        """
        modes, n = rig.modes, rig.modes.n_modes
        domain = modes.domain
        along = (np.arange(50) + 0.5) / 50 * domain.length if isinstance(domain, Interval) else domain.grid(12)
        forces = process_noise * force * np.sqrt(np.mean(modes.phi(along) ** 2, axis=0))
        shape = np.zeros(n) if at is None else modes.phi_at(at)
        patterns, variances = np.column_stack([np.eye(n), shape]), np.r_[forces**2, rms**2]
        gains, whitening = {}, {}
        for dt in sample_times:
            model = sampled_model(modes, _instantaneous(rig).sensors, noise, dt)
            found = force_filter(model, patterns, variances)
            # from the predictor form to a correction of the state at this sample
            gains[dt] = np.linalg.solve(model.transition, found.gain[: 2 * n]).reshape(2, n, -1).copy()
            whitening[dt] = np.linalg.inv(np.linalg.cholesky(found.innovation))
        return cls(gains, whitening, rig.sensors)

    def innovations(
        self, rig: Rig, record: Record, substeps: int, motion: Callable[[], Motion] | None = None
    ) -> np.ndarray:
        """Innovations of unit covariance (n_outputs, n_samples) of a rig that is integrated in time.

        The effect of delay, lag and clipping of sensors is taken from a simulation of the whole record; motion: returns
        it with these substeps, if it may be cached.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # the simulation may diverge
            errors = self._innovations(rig, record, substeps, motion)
            return np.asarray(self.whitening[record.sample_time] @ errors)

    def residual_on_measured_motion(self, rig: Rig, record: Record, substeps: int) -> np.ndarray:
        """Residual (n_outputs, n_samples) of a whole record with nonlinear laws acting on the measured motion.

        The laws then do not distort the response to an unmodelled force: the residual is the structure's linear
        response to it. For a rig without laws, it is measured minus predicted.
        """
        errors = self._innovations(rig, record, substeps)
        model = sampled_model(rig.modes, _instantaneous(rig).sensors, np.ones(len(rig.sensors)), record.sample_time)
        gain = self._gain_for(rig, record.sample_time).reshape(-1, errors.shape[0])
        # the response to all corrections is added back
        return errors + model.output @ driven(model.transition, model.transition @ gain @ errors)[:, :-1]

    def _innovations(
        self, rig: Rig, record: Record, substeps: int, motion: Callable[[], Motion] | None = None
    ) -> np.ndarray:
        """Innovations (n_outputs, n_samples), in the sensors' units."""
        unquantised, measured, dt = _without_quantisation(rig), record.outputs, record.sample_time
        how: Any = {"sample_time": dt, "substeps": substeps, "input_hold": record.input_hold}
        instantaneous = _instantaneous(unquantised)
        if instantaneous is not unquantised:
            moved = move(rig, record.inputs, **how) if motion is None else motion()
            measured = measured + read(instantaneous, moved) - read(unquantised, moved)
        return prediction_errors(instantaneous, record.inputs, measured, self._gain_for(rig, dt), **how)

    def innovations_of_linear(self, rig: Rig, left: np.ndarray, sample_time: float, substeps: int) -> np.ndarray:
        """Innovations of unit covariance (n_outputs, n_samples) of a linear rig, from its residual of a whole record.

        substeps: of a sample, if damping couples the modes.
        """
        bare = _structure_only(rig)
        gain, no_inputs = self._gain_for(rig, sample_time), np.zeros((0, left.shape[1]))
        substeps = 1 if rig.modes.proportional else substeps
        errors = prediction_errors(bare, no_inputs, left, gain, sample_time=sample_time, substeps=substeps)
        return np.asarray(self.whitening[sample_time] @ errors)

    @lru_cache(maxsize=KEPT)  # noqa: B019  an observer is a few arrays
    def _gain_for(self, rig: Rig, sample_time: float) -> np.ndarray:
        """The gain (2, n_modes, n_outputs) for a rig; zero for modes that the observer was not designed for.

        Where relocated sensors make the observer unstable, their gain is zero, and if need be the whole gain.
        """
        designed = self.gains[sample_time]
        gain = np.zeros((2, rig.modes.n_modes, designed.shape[2]))
        known = min(rig.modes.n_modes, designed.shape[1])
        gain[:, :known] = designed[:, :known]
        reads = [[(s.at, s.quantity, s.direction) for s in sensors] for sensors in (rig.sensors, self.sensors)]
        moved = [j for j, (now, then) in enumerate(zip(*reads, strict=True)) if now != then]
        if moved and _is_unstable(rig, gain, sample_time):
            gain[:, :, moved] = 0.0
            if _is_unstable(rig, gain, sample_time):
                gain[:] = 0.0
        return gain


@lru_cache(maxsize=KEPT)
def _structure_only(rig: Rig) -> Rig:
    """The rig with only its structure and ideal sensors."""
    sensors = tuple(Sensor(s.name, s.at, s.quantity, gain=s.gain, direction=s.direction) for s in rig.sensors)
    return replace(rig, actuators=(), elements=(), sensors=sensors)


def _is_unstable(rig: Rig, gain: Floats, sample_time: float) -> bool:
    """Whether the observer of a rig is unstable: an eigenvalue of (I - K C) A is beyond 1."""
    step = _transition(rig.modes, sample_time)
    rows, orders = reading_of(rig)
    n = rig.modes.n_modes
    derivatives = np.vstack([np.eye(2 * n), rig.modes.state_matrix[n:]]).reshape(3, n, 2 * n)
    output = np.einsum("jr,jrs->js", rows, derivatives[orders])
    return _is_growing(step - gain.reshape(2 * n, -1) @ (output @ step))


def _is_growing(step: Floats) -> bool:
    """Whether a transition matrix has an eigenvalue beyond 1."""
    power = step
    for _ in range(SQUARINGS):  # a power of norm below 1 proves stability, and is cheaper than eigenvalues
        power = power @ power
        size = float(np.einsum("ij,ij->", power, power))
        if size < 1.0:
            return False
        if size > MAX_SQUARED_NORM:
            break
    return bool(np.abs(np.linalg.eigvals(step)).max() > 1.0)


@lru_cache(maxsize=4)
def _transition(modes: Modes, sample_time: float) -> Floats:
    """Transition matrix of the modes over a sample, (2 n_modes, 2 n_modes)."""
    return np.asarray(expm(modes.state_matrix * sample_time))


@lru_cache(maxsize=KEPT)
def _without_quantisation(rig: Rig) -> Rig:
    """The rig without quantisation of sensors; the same object if there is none."""
    if not any(sensor.step for sensor in rig.sensors):
        return rig
    return replace(rig, sensors=tuple(replace(s, step=0.0) if s.step else s for s in rig.sensors))


@lru_cache(maxsize=KEPT)
def _instantaneous(rig: Rig) -> Rig:
    """The rig without delay, lag, crosstalk and clipping of sensors; the same object if there is none."""
    if not any(
        sensor.crosstalk or sensor.delay or sensor.time_constant or np.isfinite(sensor.limit) for sensor in rig.sensors
    ):
        return rig
    sensors = tuple(replace(sensor, crosstalk=(), delay=0.0, time_constant=0.0, limit=np.inf) for sensor in rig.sensors)
    return replace(rig, sensors=sensors)
