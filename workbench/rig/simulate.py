"""Simulation of a rig from rest: exact where it is linear, stepped with exact modes where it is not."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce

import numpy as np
from scipy.signal import lfilter

from workbench.arrays import Complexes, Floats, Integers
from workbench.records.band_limited import finer
from workbench.records.record import Record
from workbench.rig import elements, stepping
from workbench.rig.between_samples import BetweenSamples, Step
from workbench.rig.driving import actuator_force, beyond_straight, drives, sinusoid_on_substeps
from workbench.rig.linear import (
    ModalPoles,
    held_response,
    modal_motion,
    modal_poles,
    shifted,
    sinusoid_response,
    straight_response,
    whole_samples,
)
from workbench.rig.rig import Rig, shape_error_of, shape_of
from workbench.rig.sensors import MEASURED, Sensor
from workbench.structure.domain import Between, Patch, PlaceError
from workbench.structure.modes import Modes

LAWS: dict[type[elements.PointElement], int] = {
    elements.LinearSpring: stepping.LINEAR_SPRING,
    elements.LinearDamper: stepping.LINEAR_DAMPER,
    elements.CubicSpring: stepping.CUBIC,
    elements.PowerSpring: stepping.POWER_SPRING,
    elements.EvenSpring: stepping.EVEN_SPRING,
    elements.PowerDamper: stepping.POWER_DAMPER,
    elements.Clearance: stepping.CLEARANCE,
    elements.OneSidedStop: stepping.ONE_SIDED,
    elements.CoulombFriction: stepping.FRICTION,
    elements.BoucWen: stepping.BOUC_WEN,
    elements.UserLaw: stepping.USER,
}
QUANTITIES = ("displacement", "velocity", "acceleration")  # by derivative in time
BAND_STEPS = 32  # of each sample interval, over which a band-limited input runs straight: 0.05 % at 0.4 of the rate
KEPT = 8  # rigs of which what all records share is remembered
NOTHING, NO_GAIN, NO_ORDERS = np.zeros((0, 0)), np.zeros((2, 0, 0)), np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Motion:
    """Modal motion of a rig at the sample instants.

    Attributes:
        displacement, velocity: (n_modes, n_samples) of the modal coordinates.
        forces: (n_modes, n_samples) on them beside those of stiffness and damping.
        stiffness: (n_modes, 1) of each mode, or (n_modes, n_samples) where it changes.
        damping: (n_modes, n_modes).
        steps: by which forces change within each interval.
        held: (n_modes, n_samples) of the forces, what stays as it is from sample to sample but for these.
        finer: what moves again, with so many times as many samples, where forces change within an interval otherwise.
    """

    displacement: Floats
    velocity: Floats
    forces: Floats
    stiffness: Floats
    damping: Floats
    steps: tuple[Step, ...] = ()
    held: Floats | float = 0.0
    finer: "tuple[int, Callable[[], Motion]] | None" = None

    def between_samples(self, sample_time: float) -> BetweenSamples:
        """The motion at any time, s; computed once, since sensors of many delays may read one motion."""
        if "_between_samples" not in self.__dict__:
            q, v, forces = self.displacement, self.velocity, self.forces
            figures = self.stiffness, self.damping, sample_time
            found = BetweenSamples.of(q, v, forces, *figures, steps=self.steps, held=self.held)
            object.__setattr__(self, "_between_samples", found)
        known: BetweenSamples = self.__dict__["_between_samples"]
        return known

    @cached_property
    def acceleration(self) -> Floats:
        """(n_modes, n_samples) of the modal coordinates."""
        return self.forces - self.stiffness * self.displacement - self.damping @ self.velocity

    def after(self, lead: int) -> "Motion":
        """The motion without its first `lead` samples."""
        if lead == 0:
            return self
        stiffness = self.stiffness[:, lead:] if self.stiffness.shape[1] > 1 else self.stiffness
        q, v, forces = (array[:, lead:] for array in (self.displacement, self.velocity, self.forces))
        steps = tuple(replace(step, forces=step.forces[:, lead:]) for step in self.steps)
        held = self.held[:, lead:] if isinstance(self.held, np.ndarray) else self.held
        later = Motion(q, v, forces, stiffness, self.damping, steps, held, self.finer)
        if self.finer is None:
            return later
        times, _ = self.finer
        return replace(later, finer=(times, lambda: self.finely.after(times * lead)))

    def every(self, times: int) -> "Motion":
        """One of so many samples of a motion under forces that run straight between its own."""
        stiffness = self.stiffness[:, ::times] if self.stiffness.shape[1] > 1 else self.stiffness
        q, v, forces = (array[:, ::times] for array in (self.displacement, self.velocity, self.forces))
        return Motion(q, v, forces, stiffness, self.damping, finer=(times, lambda: self))

    @cached_property
    def finely(self) -> "Motion":
        """The same motion with more samples, where there is one; of many sensors that are late, and asked for once."""
        return self if self.finer is None else self.finer[1]()


def simulate(
    rig: Rig,
    inputs: np.ndarray,
    *,
    sample_time: float,
    substeps: int = 8,
    name: str = "simulated",
    input_hold: str = "zero",
) -> Record:
    """The record that the rig gives from rest, without noise.

    Args:
        inputs: (n_actuators, n_samples) commands.
        sample_time: s.
        substeps: of each sample interval, where the rig is not linear.
        name: of the record.
        input_hold: "zero" for inputs held over each sample interval, "first" for straight lines between the samples,
            "band-limited" for inputs that hold nothing beyond half of the sample rate: these run straight over finer
            steps, the substeps where the rig is not linear.

    Raises:
        ValueError: inputs that do not fit the actuators.
    """
    inputs = np.atleast_2d(np.asarray(inputs, float))
    if inputs.shape[0] != len(rig.actuators):
        raise ValueError(
            f"inputs must have shape ({len(rig.actuators)} actuators, n_samples); got {inputs.shape}. Is time last?"
        )
    motion = move(rig, inputs, sample_time=sample_time, substeps=substeps, input_hold=input_hold)
    outputs = read(rig, motion, sample_time=sample_time)
    return rig.record(inputs, outputs, sample_time=sample_time, name=name, input_hold=input_hold)


def predict(rig: Rig, record: Record, *, substeps: int = 8) -> np.ndarray:
    """What a rig's sensors read (n_sensors, n_samples) under the inputs of a record, noise apart; see `simulate`."""
    rig = rig.in_record(record.name)
    found = simulate(
        rig, record.inputs, sample_time=record.sample_time, substeps=substeps, input_hold=record.input_hold
    )
    return found.outputs


def move(rig: Rig, inputs: np.ndarray, *, sample_time: float, substeps: int = 8, input_hold: str = "zero") -> Motion:
    """Modal motion from rest; see `simulate`."""
    if is_stepped(rig):
        return _move_in_steps(rig, inputs, sample_time, substeps, input_hold)
    if input_hold == "band-limited":
        finely = _move_exactly(rig, finer(inputs, BAND_STEPS), sample_time / BAND_STEPS, "first")
        return finely.every(BAND_STEPS)
    return _move_exactly(rig, inputs, sample_time, input_hold)


def is_stepped(rig: Rig) -> bool:
    """Whether the motion has no closed form and is stepped through time."""
    if rig.stiffness_rate != 0 or _is_rate_limited(rig):
        return True
    return any(not isinstance(e, elements.PeriodicForce | elements.RandomForce) for e in rig.elements)


def _is_rate_limited(rig: Rig) -> bool:
    return any(np.isfinite(actuator.rate_limit) for actuator in rig.actuators)


def steps_exactly(rig: Rig) -> bool:
    """Whether steps of a whole sample are exact: no law, delay, lag or sinusoid, and no damping between the modes."""
    late = any(actuator.delay or actuator.time_constant for actuator in rig.actuators)
    return rig.modes.proportional and not (late or rig.elements or rig.stiffness_rate)


def read(rig: Rig, motion: Motion, *, sample_time: float) -> np.ndarray:
    """What the sensors read of a motion, noise apart: (n_sensors, n_samples); clipped and rounded in the mean."""
    outputs = np.empty((len(rig.sensors), motion.displacement.shape[1]))
    for order, here, shapes in _shapes_at_sensors(rig):
        delays = np.array([0.0 if rig.sensors[j].interpolated else rig.sensors[j].delay for j in here])
        if not delays.all():
            outputs[here] = shapes @ getattr(motion, QUANTITIES[order])
        if delays.any():
            behind = np.flatnonzero(delays)
            every, moved = 1, motion
            if motion.finer is not None and (order == 2 or _is_rate_limited(rig)):
                every, moved = motion.finer[0], motion.finely
            late = moved.between_samples(sample_time / every)
            outputs[np.array(here)[behind]] = late.earlier(order, shapes[behind], delays[behind])[:, ::every]
    for j, sensor in enumerate(rig.sensors):
        if sensor.delay and sensor.interpolated:
            samples = np.arange(outputs.shape[1])
            outputs[j] = np.interp(samples - sensor.delay / sample_time, samples, outputs[j])
    for row, leak in _leaks(rig, outputs):
        outputs[row] += leak
    for j, sensor in enumerate(rig.sensors):
        outputs[j] = sensor_reading(sensor, outputs[j], sample_time)
    return outputs


def _leaks(rig: Rig, truths: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """What each sensor reads of others' truths (n_sensors, n_samples): its row, and that series."""
    rows = {sensor.name: j for j, sensor in enumerate(rig.sensors)}
    leaks = []
    for sensor in rig.sensors:
        for name, share in sensor.crosstalk:
            if name not in rows:
                raise ValueError(f"sensor {sensor.name} reads a share of {name!r}, which is no sensor of the rig")
            leaks.append((rows[sensor.name], share * truths[rows[name]]))
    return leaks


def sensor_reading(sensor: Sensor, truth: np.ndarray, sample_time: float) -> np.ndarray:
    """A sensor's mean reading (n_samples,) of the truth: lag, gain, bias and drift, clipping, rounding."""
    y = truth
    if sensor.time_constant > 0:
        y = _lagged(y, sensor.time_constant, sample_time)
    if sensor.gain != 1:
        y = sensor.gain * y
    if sensor.bias or sensor.drift:
        y = y + sensor.bias + sensor.drift * np.linspace(0.0, 1.0, y.size)
    if np.isfinite(sensor.limit):
        y = np.clip(y, -sensor.limit, sensor.limit)
    if sensor.step > 0:
        y = _mean_rounded(y, sensor.step, sensor.noise_std)
    return y


@lru_cache(maxsize=KEPT)
def participation_of(rig: Rig) -> np.ndarray:
    """(n_modes, n_actuators), the actuators' gains left out: those belong to the path before the structure.

    Remembered: not to be written to.
    """
    shapes = np.empty((rig.modes.n_modes, len(rig.actuators)))
    kinds = [(a.kind, a.direction, isinstance(a.at, Between | Patch)) for a in rig.actuators]
    for kind, direction, apart in set(kinds):
        group = [j for j, other in enumerate(kinds) if other == (kind, direction, apart)]
        at, derivative = [rig.actuators[j].at for j in group], 1 if kind == "moment" else 0
        try:
            if apart:
                each = [rig.modes.phi_at(where, derivative, direction=direction) for where in at]
                shapes[:, group] = np.array(each).T
            else:
                shapes[:, group] = rig.modes.phi(at, derivative, direction=direction).T
        except PlaceError:
            _ = [shape_of(rig.modes, rig.actuators[j]) for j in group]  # says which actuator it is
            raise
    for j, actuator in enumerate(rig.actuators):
        if actuator.shape_error:
            shapes[:, j] += shape_error_of(actuator, rig.modes.n_modes)
    return shapes


def _move_exactly(rig: Rig, inputs: np.ndarray, sample_time: float, input_hold: str) -> Motion:
    modes, participation = rig.modes, participation_of(rig)
    system = _poles(modes)
    n_samples = inputs.shape[1]
    responses: list[Complexes] = []
    acting = np.zeros_like(inputs)
    response_to = held_response if input_hold == "zero" else straight_response
    for delay, lag in {(a.delay, a.time_constant) for a in rig.actuators}:
        group = [j for j, a in enumerate(rig.actuators) if (a.delay, a.time_constant) == (delay, lag)]
        forces = np.array([actuator_force(rig.actuators[j], inputs[j]) for j in group])
        share, at_samples = response_to(
            system, forces, participation[:, group], sample_time, delay=delay, time_constant=lag
        )
        responses.append(share)
        acting[group] = at_samples
    steps = _steps_within(rig, inputs, acting, participation, sample_time) if input_hold == "zero" else ()
    bias = np.array([actuator.bias for actuator in rig.actuators])
    if bias.any():
        constant = np.outer(bias, np.ones(n_samples))
        responses.append(held_response(system, constant, participation, sample_time)[0])
        acting += constant
    on_modes = participation @ acting
    held = on_modes if input_hold == "zero" else 0.0
    time = sample_time * np.arange(n_samples)
    for element in rig.elements:
        if not isinstance(element, elements.PeriodicForce):
            continue
        shape = modes.phi_at(element.at)
        omega, phasor = 2 * np.pi * element.frequency_hz, element.amplitude * np.exp(1j * element.phase)
        responses.append(sinusoid_response(system, shape, omega, phasor, sample_time, n_samples))
        on_modes = on_modes + np.outer(shape, (phasor * np.exp(1j * omega * time)).imag)
    if not responses:
        responses.append(np.zeros((system.poles.size, n_samples), complex))
    q, v = modal_motion(system, reduce(np.add, responses))
    return Motion(q, v, on_modes, modes.omega[:, None] ** 2, modes.damping, steps, held)


@lru_cache(maxsize=KEPT)
def _poles(modes: Modes) -> ModalPoles:
    return modal_poles(modes.omega, modes.damping)


def _steps_within(
    rig: Rig, inputs: Floats, acting: Floats, participation: Floats, sample_time: float
) -> tuple[Step, ...]:
    """How held inputs that are delayed or lagged change the forces on the modes within each sample interval.

    Args:
        acting: (n_actuators, n_samples) forces at the samples, without bias.
    """
    steps: dict[tuple[float, float], Floats] = {}
    for j, actuator in enumerate(rig.actuators):
        shift, late = whole_samples(actuator.delay, sample_time)
        lag = actuator.time_constant
        if not (late or lag) or np.isfinite(actuator.rate_limit):
            continue
        force = actuator_force(actuator, inputs[j])
        older, newer = shifted(force, shift + 1), shifted(force, shift)
        for begins, change in ((0.0, older - acting[j]), (late, newer - older)) if lag else ((late, newer - older),):
            steps[begins, lag] = steps.get((begins, lag), 0.0) + np.outer(participation[:, j], change)
    return tuple(Step(late, lag, forces) for (late, lag), forces in steps.items())


def _move_in_steps(rig: Rig, inputs: np.ndarray, sample_time: float, substeps: int, input_hold: str) -> Motion:
    modes = rig.modes
    q, v, f = motion = tuple(np.zeros((modes.n_modes, inputs.shape[1])) for _ in range(3))
    unmeasured = NOTHING, NO_GAIN
    participation, at_samples = _step(rig, inputs, *unmeasured, sample_time, substeps, input_hold, motion, NOTHING)
    scale = 1.0 + rig.stiffness_rate * sample_time * np.arange(inputs.shape[1])
    stiffness = modes.omega[:, None] ** 2 * (scale if rig.stiffness_rate else 1.0)
    # the forces on the modes hold what couples them; only each mode's own damping is left
    bias = np.array([[actuator.bias] for actuator in rig.actuators])
    acting = at_samples[: len(rig.actuators)] - bias
    steps = _steps_within(rig, inputs, acting, participation, sample_time) if input_hold == "zero" else ()
    n_inputs = len(rig.actuators)
    held = participation[:, :n_inputs] @ at_samples[:n_inputs] if input_hold == "zero" else 0.0
    damping = np.diag(np.diag(modes.damping))
    found = Motion(q, v, participation @ at_samples + f, stiffness, damping, steps, held)
    if substeps == 1 or not (rig.elements or input_hold == "band-limited" or _is_rate_limited(rig)):
        return found
    return replace(found, finer=(substeps, lambda: _move_finely(rig, inputs, sample_time, substeps, input_hold)))


def _move_finely(rig: Rig, inputs: Floats, sample_time: float, substeps: int, input_hold: str) -> Motion:
    """The same motion with every substep a sample."""
    if input_hold == "zero":
        finely = np.repeat(inputs, substeps, axis=1)
    elif input_hold == "band-limited":
        finely, input_hold = finer(inputs, substeps), "first"
    else:
        time = np.arange(inputs.shape[1] * substeps) / substeps
        finely = np.array([np.interp(time, np.arange(inputs.shape[1]), row) for row in inputs])
    return _move_in_steps(rig, finely, sample_time / substeps, 1, input_hold)


def prediction_errors(
    rig: Rig,
    inputs: np.ndarray,
    outputs: np.ndarray,
    gain: np.ndarray,
    *,
    sample_time: float,
    substeps: int = 8,
    input_hold: str = "zero",
) -> np.ndarray:
    """Errors (n_sensors, n_samples) of predictions one sample ahead, by a rig that every sample corrects.

    A motion that runs away from the measured one within a few periods, as that of a stiff contact a little out of place
    does, is kept near it: the errors then go smoothly with every number of the rig.

    Args:
        rig: its sensors may have gain, bias and drift; lag, clipping and rounding are not seen.
        inputs: (n_actuators, n_samples) commands.
        outputs: (n_sensors, n_samples) measured.
        gain: (2, n_modes, n_sensors) by which an error moves the displacements and velocities of the modes.
        sample_time: s.
        substeps: of each sample interval.
        input_hold: as of `simulate`.
    """
    errors = np.empty_like(outputs)
    _step(rig, inputs, outputs, gain, sample_time, substeps, input_hold, (NOTHING, NOTHING, NOTHING), errors)
    return errors


@lru_cache(maxsize=KEPT)
def reading_of(rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """What the sensors read of the modes (n_sensors, n_modes), of which derivative in time (n_sensors,).

    Remembered: not to be written to.
    """
    rows, orders = np.zeros((len(rig.sensors), rig.modes.n_modes)), np.zeros(len(rig.sensors), np.int64)
    for order, here, shapes in _shapes_at_sensors(rig):
        rows[here], orders[here] = shapes, order
    return np.array([sensor.gain for sensor in rig.sensors])[:, None] * rows, orders


@lru_cache(maxsize=KEPT)
def _shapes_at_sensors(rig: Rig) -> list[tuple[int, list[int], np.ndarray]]:
    """Order in time, sensors and shapes (n_here, n_modes), of sensors of a kind at a time."""
    found, measured = [], [(*MEASURED[sensor.quantity], sensor.direction) for sensor in rig.sensors]
    for derivative, order, direction in set(measured):
        here = [j for j, kind in enumerate(measured) if kind == (derivative, order, direction)]
        try:
            shapes = rig.modes.phi([rig.sensors[j].at for j in here], derivative, direction=direction)
        except PlaceError:
            _ = [shape_of(rig.modes, rig.sensors[j]) for j in here]  # says which sensor it is
            raise
        if any(rig.sensors[j].shape_error for j in here):
            shapes = shapes + [shape_error_of(rig.sensors[j], rig.modes.n_modes) for j in here]
        found.append((order, here, shapes))
    return found


def _step(
    rig: Rig,
    inputs: np.ndarray,
    outputs: np.ndarray,
    gain: np.ndarray,
    sample_time: float,
    substeps: int,
    input_hold: str,
    motion: tuple[np.ndarray, ...],
    errors: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill displacements and velocities of the modes and the forces of what touches them, or the outputs' errors.

    Returns:
        Participations (n_modes, n_forces) of all other forces, and these at the sample instants (n_forces, n_samples).
    """
    modes = rig.modes
    n_samples = inputs.shape[1]
    driving = drives(rig.actuators, inputs, sample_time, substeps, input_hold)
    driven, starts, ends, at_samples = driving.driven, driving.starts, driving.ends, driving.at_samples
    participation, (damping, coupling, spread) = participation_of(rig), structure_arrays(rig)
    h = sample_time / substeps
    beyond = {c: beyond_straight(c, modes.omega, damping, h) for c in {course for _, course in driving.courses}}
    added = [beyond[course] * participation[:, j] for j, course in driving.courses]
    for element in rig.elements:
        if isinstance(element, elements.PeriodicForce):
            start, end, now = sinusoid_on_substeps(element, n_samples, sample_time, substeps)
            driven, starts, ends = np.append(driven, True), np.vstack([starts, start]), np.vstack([ends, end])
            at_samples = np.vstack([at_samples, now])
            participation = np.column_stack([participation, modes.phi_at(element.at)])
    known, reading, orders = outputs, NOTHING, NO_ORDERS
    if outputs.size:
        reading, orders = reading_of(rig)
        known = _left_to_motion(rig, outputs, reading, orders, participation, at_samples)
    step: Callable[..., None] = stepping.step_record
    step(
        modes.omega,
        damping,
        coupling,
        sample_time,
        substeps,
        rig.stiffness_rate,
        starts,
        ends,
        np.ascontiguousarray(participation[:, driven]),
        driving.sizes,
        np.array(added).reshape(len(added), 2, modes.n_modes),
        *spread,
        *_laws(rig),
        known,
        orders,
        reading,
        gain,
        *motion,
        errors,
    )
    return participation, at_samples


def _left_to_motion(
    rig: Rig, outputs: Floats, reading: Floats, orders: Integers, participation: Floats, at_samples: Floats
) -> Floats:
    """Outputs (n_sensors, n_samples) without biases, drifts, and the accelerations under the actuators' own forces."""
    known = outputs.copy()
    for j, sensor in enumerate(rig.sensors):
        if sensor.bias or sensor.drift:
            known[j] -= sensor.bias + sensor.drift * np.linspace(0.0, 1.0, outputs.shape[1])
    here = np.flatnonzero(orders == 2)
    if here.size and at_samples.size:
        known[here] -= reading[here] @ (participation @ at_samples)
    return known


@lru_cache(maxsize=KEPT)
def structure_arrays(rig: Rig) -> tuple[Floats, Floats, tuple[float, Floats, Floats, Floats]]:
    """What acts all along, or couples the modes, as a stepper takes it: nothing is an array of no numbers.

    One type and one layout of every argument: a stepper is compiled anew for any other. Remembered: not to be written
    to.

    Returns:
        Damping (n_modes,) and its coupling of modes; and of what acts all along, the coefficient of stretching and
        ∫ φ_r' φ_s' dx, shapes (n_modes, n_points) where the air drags, and the coefficient times each point's weight.
    """
    damping = np.diag(rig.modes.damping).copy()
    coupling = rig.modes.damping - np.diag(damping)
    stretch = float(sum(e.coefficient for e in rig.elements if isinstance(e, elements.MidplaneStretching)))
    drag = float(sum(e.coefficient for e in rig.elements if isinstance(e, elements.AirDrag)))
    shapes, weights = along(rig, 0) if drag else (np.zeros((0, rig.modes.n_modes)), np.zeros(0))
    stretching = np.ascontiguousarray(stretching_of(rig)) if stretch else np.zeros((0, 0))
    coupling = np.ascontiguousarray(coupling) if coupling.any() else np.zeros((0, 0))
    return damping, coupling, (stretch, stretching, np.ascontiguousarray(shapes.T), drag * weights)


@lru_cache(maxsize=KEPT)
def _laws(rig: Rig) -> tuple[Integers, Floats, Floats]:
    return law_arrays(rig, [e for e in rig.elements if isinstance(e, elements.PointElement)])


def law_arrays(rig: Rig, points: Sequence[elements.PointElement]) -> tuple[Integers, Floats, Floats]:
    """Kinds (n_elements,), shapes (n_elements, n_modes) and parameters of elements at points, a row each."""
    of_the_users_own = any(isinstance(e, elements.UserLaw) for e in points)
    parameters = np.zeros((len(points), stepping.N_PARAMETERS + of_the_users_own))
    for row, element in zip(parameters, points, strict=True):
        row[: len(element.parameters)] = element.parameters
        if isinstance(element, elements.UserLaw):
            row[-1] = stepping.address_of(element.law)
    shapes = np.array([rig.modes.phi_at(e.at) for e in points]).reshape(len(points), rig.modes.n_modes)
    return np.array([LAWS[type(e)] for e in points], np.int64), np.ascontiguousarray(shapes), parameters


def along(rig: Rig, derivative: int) -> tuple[Floats, Floats]:
    """Shapes and weights at Gauss points along the structure, fine enough for products of four of its shapes."""
    points, weights = rig.modes.domain.quadrature(max(3 * rig.modes.n_modes + 12, 30))
    return rig.modes.phi(points, derivative), weights


def stretching_of(rig: Rig) -> Floats:
    """∫ φ_r' φ_s' dx, (n_modes, n_modes)."""
    slopes, weights = along(rig, 1)
    return slopes.T @ (weights[:, None] * slopes)


def _lagged(truth: np.ndarray, time_constant: float, sample_time: float) -> np.ndarray:
    """A first-order lag of a signal that is linear between samples, settled at its first value."""
    ratio = sample_time / time_constant
    fade = np.exp(-ratio)
    new = 1.0 - (1.0 - fade) / ratio
    old = (1.0 - fade) / ratio - fade
    return np.asarray(lfilter([new, old], [1.0, -fade], truth, zi=[(1.0 - new) * truth[0]])[0])


def _mean_rounded(y: np.ndarray, step: float, noise_std: float) -> np.ndarray:
    """The mean of a rounded noisy reading, by the Fourier series of the rounding error."""
    spread = noise_std / step
    if spread < 0.05:
        return step * np.round(y / step)
    error = np.zeros_like(y)
    for m in range(1, 12):
        weight = np.exp(-2.0 * (np.pi * m * spread) ** 2)
        if weight < 1e-12:
            break
        error += (-1.0) ** m / (np.pi * m) * weight * np.sin(2.0 * np.pi * m * y / step)
    return y + step * error
