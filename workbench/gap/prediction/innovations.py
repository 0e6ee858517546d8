"""Innovations: a rig, with all its laws, predicts one sample ahead, and every sample of a record corrects it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import expm

from workbench.arrays import Floats
from workbench.gap.prediction.unmodelled_force import driven, force_filter, sampled_model
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import KEPT, Motion, move, prediction_errors, read, reading_of
from workbench.structure.domain import Interval, Where
from workbench.structure.modes import Modes

LOOSE = 0.01  # of the inputs: random forces, by which an observer corrects a rig's motion
DOUBLINGS = 12  # of the samples over which a corrected motion is seen to die away: eight are enough for most
RUN_AWAY = 1e100  # squared norm of a power, whose square is a number still


@dataclass(frozen=True, eq=False)
class Observer:
    """A steady-state Kalman filter of a rig's modes, under random forces on all of them.

    Attributes:
        gain: (2, n_modes, n_outputs) of their displacements and velocities.
        whitening: (n_outputs, n_outputs) to errors of unit covariance.
        sensors: that it is made for.
    """

    gain: np.ndarray
    whitening: np.ndarray
    sensors: tuple[Sensor, ...]

    @classmethod
    def of(
        cls,
        rig: Rig,
        noise: np.ndarray,
        force: float,
        sample_time: float,
        *,
        at: Where | None = None,
        rms: float = 0.0,
        loose: float = LOOSE,
    ) -> "Observer":
        """For sensors of that noise (n_outputs,), and inputs of that rms, N; and a random force at a place, N.

        Args:
            loose: how far the rig may go its own way: random forces on it, as a share of the inputs, the less the more.
        """
        modes, n = rig.modes, rig.modes.n_modes
        domain = modes.domain
        along = (np.arange(50) + 0.5) / 50 * domain.length if isinstance(domain, Interval) else domain.grid(12)
        forces = loose * force * np.sqrt(np.mean(modes.phi(along) ** 2, axis=0))
        shape = np.zeros(n) if at is None else modes.phi_at(at)
        patterns, variances = np.column_stack([np.eye(n), shape]), np.r_[forces**2, rms**2]
        model = sampled_model(modes, _at_once(rig).sensors, noise, sample_time)
        found = force_filter(model, patterns, variances)
        # what an error says of the forces until the next sample is put into the state at this one
        gain = np.linalg.solve(model.transition, found.gain[: 2 * n])
        whitening = np.linalg.inv(np.linalg.cholesky(found.innovation))
        return cls(gain.reshape(2, n, -1).copy(), whitening, rig.sensors)

    def errors(self, rig: Rig, record: Record, substeps: int, motion: Callable[[], Motion] | None = None) -> np.ndarray:
        """Errors (n_outputs, n_samples) of a rig whose predictions are stepped through time, of unit covariance.

        What sensors lose by delay, lag or clipping is not observed: it is made up for as the whole record has it.

        Args:
            rig: with its laws.
            record: of its inputs and outputs.
            substeps: of a sample.
            motion: of the whole record, by these substeps, where it may be at hand.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # the motion of a rig that was tried may run away
            errors: Floats = self.whitening @ self._one_step_errors(rig, record, substeps, motion)
        return errors

    def left(self, rig: Rig, record: Record, substeps: int) -> np.ndarray:
        """What a rig leaves of a whole record (n_outputs, n_samples) whose laws act on the motion that was measured.

        The laws then make no more of what else is missing than they really did: what is left is the structure's linear
        answer to it. That of a rig without laws is measured less predicted.
        """
        errors = self._one_step_errors(rig, record, substeps)
        model = sampled_model(rig.modes, _at_once(rig).sensors, np.ones(len(rig.sensors)), record.sample_time)
        gain = self._gain_for(rig, record.sample_time).reshape(-1, errors.shape[0])
        # every correction goes on to be a motion
        return errors + model.output @ driven(model.transition, model.transition @ gain @ errors)[:, :-1]

    def _one_step_errors(
        self, rig: Rig, record: Record, substeps: int, motion: Callable[[], Motion] | None = None
    ) -> np.ndarray:
        """Errors one sample ahead, in the sensors' units."""
        slow, measured, dt = _unrounded(rig), record.outputs, record.sample_time
        quick = _at_once(slow)
        if quick is not slow:
            if motion is None:
                moved = move(rig, record.inputs, sample_time=dt, substeps=substeps, input_hold=record.input_hold)
            else:
                moved = motion()
            measured = measured + read(quick, moved, sample_time=dt) - read(slow, moved, sample_time=dt)
        gain = self._gain_for(rig, dt)
        hold = record.input_hold
        return prediction_errors(
            quick, record.inputs, measured, gain, sample_time=dt, substeps=substeps, input_hold=hold
        )

    def errors_of_linear(self, rig: Rig, left: np.ndarray, sample_time: float, substeps: int) -> np.ndarray:
        """What the errors of a linear rig over a whole record leave of themselves when every sample sets it right.

        Args:
            rig: with its predictions in closed form.
            left: (n_outputs, n_samples) measured less predicted.
            sample_time: s.
            substeps: of a sample, where damping couples the modes.
        """
        bare = _bare(rig)
        gain, no_inputs = self._gain_for(rig, sample_time), np.zeros((0, left.shape[1]))
        substeps = 1 if rig.modes.proportional else substeps
        errors = prediction_errors(bare, no_inputs, left, gain, sample_time=sample_time, substeps=substeps)
        white: Floats = self.whitening @ errors
        return white

    @lru_cache(maxsize=KEPT)  # noqa: B019  an observer is a few arrays
    def _gain_for(self, rig: Rig, sample_time: float) -> np.ndarray:
        """The gain, with none for modes that are more than it knows of.

        A sensor that stands elsewhere may make the correction of a rig run away: then it corrects none.
        """
        gain = np.zeros((2, rig.modes.n_modes, self.whitening.shape[0]))
        known = min(rig.modes.n_modes, self.gain.shape[1])
        gain[:, :known] = self.gain[:, :known]
        moved = [j for j, each in enumerate(zip(rig.sensors, self.sensors, strict=True)) if not _alike(*each)]
        if moved and _runs_away(rig, gain, sample_time):
            gain[:, :, moved] = 0.0
            if _runs_away(rig, gain, sample_time):
                gain[:] = 0.0
        return gain


@lru_cache(maxsize=KEPT)
def _bare(rig: Rig) -> Rig:
    """The rig with nothing but its structure, and sensors that read as they should."""
    sensors = tuple(Sensor(s.name, s.at, s.quantity, gain=s.gain, direction=s.direction) for s in rig.sensors)
    return replace(rig, actuators=(), elements=(), sensors=sensors)


def _alike(one: Sensor, other: Sensor) -> bool:
    """Whether two sensors measure the same quantity at the same place."""
    return (one.at, one.quantity, one.direction) == (other.at, other.quantity, other.direction)


def _runs_away(rig: Rig, gain: Floats, sample_time: float) -> bool:
    """Whether the modes grow when every sample corrects them: an eigenvalue of (I - K C) A is beyond 1."""
    step = _step_of(rig.modes, sample_time)
    rows, orders = reading_of(rig)
    n = rig.modes.n_modes
    derivatives = np.vstack([np.eye(2 * n), rig.modes.state_matrix[n:]]).reshape(3, n, 2 * n)
    output = np.einsum("jr,jrs->js", rows, derivatives[orders])
    return _grows(step - gain.reshape(2 * n, -1) @ (output @ step))


def _grows(step: Floats) -> bool:
    """Whether a motion may grow, step after step: an eigenvalue is beyond 1."""
    power = step
    for _ in range(DOUBLINGS):  # none is where the norm of a power is not, which is quicker to see
        power = power @ power
        size = float(np.einsum("ij,ij->", power, power))
        if size < 1.0:
            return False
        if size > RUN_AWAY:
            break
    return bool(np.abs(np.linalg.eigvals(step)).max() > 1.0)


@lru_cache(maxsize=4)
def _step_of(modes: Modes, sample_time: float) -> Floats:
    """The free motion of modes over a sample, (2 n_modes, 2 n_modes)."""
    step: Floats = expm(modes.state_matrix * sample_time)
    return step


@lru_cache(maxsize=KEPT)
def _unrounded(rig: Rig) -> Rig:
    """The rig itself where no sensor rounds."""
    if not any(sensor.step for sensor in rig.sensors):
        return rig
    return replace(rig, sensors=tuple(replace(s, step=0.0) if s.step else s for s in rig.sensors))


@lru_cache(maxsize=KEPT)
def _at_once(rig: Rig) -> Rig:
    """The rig itself where no sensor is late, lags or clips."""
    if not any(
        sensor.crosstalk or sensor.delay or sensor.time_constant or np.isfinite(sensor.limit) for sensor in rig.sensors
    ):
        return rig
    sensors = tuple(replace(sensor, crosstalk=(), delay=0.0, time_constant=0.0, limit=np.inf) for sensor in rig.sensors)
    return replace(rig, sensors=sensors)
