"""Simulation of a rig from rest: in closed form where it is linear, by time stepping of exact modes elsewhere."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial, reduce

import numpy as np
from scipy.signal import lfilter

from workbench.arrays import Complexes, Floats, Integers
from workbench.records.band_limited import finer
from workbench.records.record import Record
from workbench.rig import elements, stepping
from workbench.rig.between_samples import BetweenSamples, Step
from workbench.rig.driving import (
    Signals,
    actuator_force,
    drives,
    is_cacheable,
    motion_correction,
    sinusoid_on_substeps,
)
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
BAND_STEPS = 32  # linear steps of a band-limited input per sample interval: an error of 0.05 % at 0.4 of the rate
KEPT = 8  # rigs in the cache of arrays that all records share
NOTHING, NO_GAIN, NO_ORDERS = np.zeros((0, 0)), np.zeros((2, 0, 0)), np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Motion:
    """Modal motion of a rig at the sample instants.

    Attributes:
        displacement, velocity: (n_modes, n_samples) of the modal coordinates.
        forces: (n_modes, n_samples) modal forces without those of stiffness and damping.
        stiffness: (n_modes, 1) of each mode, or (n_modes, n_samples) where it changes.
        damping: (n_modes, n_modes).
        steps: of the forces within each interval.
        held: (n_modes, n_samples) the part of the forces that is constant over each interval but for the steps.
        finer: (factor, function) that recomputes the motion with `factor` times as many samples, where forces change
            within an interval in another way; None where not needed.
        delayed: function of a delay, s, that recomputes the motion so much later, at the same instants; None where
            there is none.
    """

    displacement: Floats
    velocity: Floats
    forces: Floats
    stiffness: Floats
    damping: Floats
    steps: tuple[Step, ...] = ()
    held: Floats | float = 0.0
    finer: "tuple[int, Callable[[], Motion]] | None" = None
    delayed: "Callable[[float], Motion] | None" = None

    def between_samples(self, sample_time: float) -> BetweenSamples:
        """The motion at any time; cached, since sensors of many delays may read one motion."""
        if "_between_samples" not in self.__dict__:
            q, v, forces = self.displacement, self.velocity, self.forces
            system = self.stiffness, self.damping, sample_time
            computed = BetweenSamples.of(q, v, forces, *system, steps=self.steps, held=self.held)
            object.__setattr__(self, "_between_samples", computed)
        cached: BetweenSamples = self.__dict__["_between_samples"]
        return cached

    @cached_property
    def acceleration(self) -> Floats:
        """Modal accelerations (n_modes, n_samples)."""
        return self.forces - self.stiffness * self.displacement - self.damping @ self.velocity

    def after(self, lead: int) -> "Motion":
        """The motion without its first `lead` samples."""
        if lead == 0:
            return self
        stiffness = self.stiffness[:, lead:] if self.stiffness.shape[1] > 1 else self.stiffness
        q, v, forces = (array[:, lead:] for array in (self.displacement, self.velocity, self.forces))
        steps = tuple(replace(step, forces=step.forces[:, lead:]) for step in self.steps)
        held = self.held[:, lead:] if isinstance(self.held, np.ndarray) else self.held
        later = Motion(q, v, forces, stiffness, self.damping, steps, held)
        if self.finer is not None:
            times, _ = self.finer
            later = replace(later, finer=(times, lambda: self.finely.after(times * lead)))
        delayed = self.delayed
        return later if delayed is None else replace(later, delayed=lambda delay: delayed(delay).after(lead))

    @cached_property
    def finely(self) -> "Motion":
        """The motion with more samples, by `finer`; itself where that is None. Cached for many delayed sensors."""
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
    """The simulated record of a rig, from rest, without noise.

    Args:
        rig: the rig.
        inputs: (n_actuators, n_samples) commands.
        sample_time: s.
        substeps: per sample interval, where the rig is not linear.
        name: of the record.
        input_hold: "zero" for inputs held over each sample interval, "first" for linear interpolation between samples,
            "band-limited" for inputs without content above the Nyquist frequency: these are interpolated to finer
            steps (the substeps where the rig is not linear) and linear over those.

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
    """Noise-free readings (n_sensors, n_samples) of a rig under the inputs of a record; see `simulate`."""
    rig = rig.in_record(record.name)
    simulated = simulate(
        rig, record.inputs, sample_time=record.sample_time, substeps=substeps, input_hold=record.input_hold
    )
    return simulated.outputs


def move(rig: Rig, inputs: np.ndarray, *, sample_time: float, substeps: int = 8, input_hold: str = "zero") -> Motion:
    """Modal motion from rest; see `simulate`."""
    if is_stepped(rig):
        return _move_in_steps(rig, inputs, sample_time, substeps, input_hold)
    if input_hold == "band-limited":
        return _move_band_limited(rig, inputs, sample_time)
    return _move_exactly(rig, inputs, sample_time, input_hold)


def is_stepped(rig: Rig) -> bool:
    """Whether the motion has no closed form and needs time stepping."""
    if rig.stiffness_rate != 0 or _is_rate_limited(rig):
        return True
    return any(not isinstance(e, elements.PeriodicForce | elements.RandomForce) for e in rig.elements)


def _is_rate_limited(rig: Rig) -> bool:
    return any(np.isfinite(actuator.rate_limit) for actuator in rig.actuators)


def steps_exactly(rig: Rig) -> bool:
    """Whether steps of a whole sample are exact: no element, delay or lag, and proportional damping."""
    late = any(actuator.delay or actuator.time_constant for actuator in rig.actuators)
    return rig.modes.proportional and not (late or rig.elements or rig.stiffness_rate)


def read(rig: Rig, motion: Motion, *, sample_time: float) -> np.ndarray:
    """Noise-free readings (n_sensors, n_samples) of a motion, clipped, and with the mean effect of rounding."""
    outputs = np.empty((len(rig.sensors), motion.displacement.shape[1]))
    for order, here, shapes in _shapes_at_sensors(rig):
        delays = np.array([0.0 if rig.sensors[j].interpolated else rig.sensors[j].delay for j in here])
        if not delays.all():
            outputs[here] = shapes @ getattr(motion, QUANTITIES[order])
        delayed = np.flatnonzero(delays)
        if order == 2 and motion.delayed is not None:
            for delay in set(delays[delayed]):
                late = np.flatnonzero(delays == delay)
                outputs[np.array(here)[late]] = shapes[late] @ motion.delayed(delay).acceleration
        elif delayed.size:
            factor, fine = 1, motion
            if motion.finer is not None and (order == 2 or _is_rate_limited(rig)):
                factor, fine = motion.finer[0], motion.finely
            between = fine.between_samples(sample_time / factor)
            outputs[np.array(here)[delayed]] = between.delayed(order, shapes[delayed], delays[delayed])[:, ::factor]
    for j, sensor in enumerate(rig.sensors):
        if sensor.delay and sensor.interpolated:
            samples = np.arange(outputs.shape[1])
            outputs[j] = np.interp(samples - sensor.delay / sample_time, samples, outputs[j])
    for row, added in _crosstalk(rig, outputs):
        outputs[row] += added
    for j, sensor in enumerate(rig.sensors):
        outputs[j] = sensor_reading(sensor, outputs[j], sample_time)
    return outputs


def _crosstalk(rig: Rig, truths: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Cross-talk: (row of the sensor, added series (n_samples,)) for measured quantities (n_sensors, n_samples)."""
    rows = {sensor.name: j for j, sensor in enumerate(rig.sensors)}
    crosstalk = []
    for sensor in rig.sensors:
        for name, share in sensor.crosstalk:
            if name not in rows:
                raise ValueError(f"sensor {sensor.name} reads a share of {name!r}, which is no sensor of the rig")
            crosstalk.append((rows[sensor.name], share * truths[rows[name]]))
    return crosstalk


def sensor_reading(sensor: Sensor, truth: np.ndarray, sample_time: float) -> np.ndarray:
    """A sensor's mean reading (n_samples,) of a measured quantity: lag, gain, bias and drift, clipping, rounding."""
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
    """Participation factors (n_modes, n_actuators) without the actuators' gains, which belong to the drive.

    The array is cached and must not be changed.
    """
    shapes = np.empty((rig.modes.n_modes, len(rig.actuators)))
    kinds = [(a.kind, a.direction, isinstance(a.at, Between | Patch)) for a in rig.actuators]
    for kind, direction, extended in set(kinds):
        group = [j for j, other in enumerate(kinds) if other == (kind, direction, extended)]
        at, derivative = [rig.actuators[j].at for j in group], 1 if kind == "moment" else 0
        try:
            if extended:
                each = [rig.modes.phi_at(where, derivative, direction=direction) for where in at]
                shapes[:, group] = np.array(each).T
            else:
                shapes[:, group] = rig.modes.phi(at, derivative, direction=direction).T
        except PlaceError:
            _ = [shape_of(rig.modes, rig.actuators[j]) for j in group]  # raises with the name of the actuator
            raise
    for j, actuator in enumerate(rig.actuators):
        if actuator.shape_error:
            shapes[:, j] += shape_error_of(actuator, rig.modes.n_modes)
    return shapes


def _move_band_limited(rig: Rig, inputs: Floats, sample_time: float) -> Motion:
    """Motion under inputs that are linear between many points of each sample interval."""
    fine = _on_band_steps(Signals(inputs)) if is_cacheable(inputs, BAND_STEPS) else finer(inputs, BAND_STEPS)
    h = sample_time / BAND_STEPS

    @lru_cache(maxsize=KEPT)
    def delayed(delay: float) -> Motion:
        """The motion under inputs so much later; a negative delay takes whole samples from after the last one."""
        ahead = max(int(np.ceil(-delay / sample_time)), 0)
        extended = np.pad(fine, ((0, 0), (0, ahead * BAND_STEPS)), mode="edge")
        later = delay + ahead * sample_time
        return _move_exactly(rig, extended, h, "first", every=BAND_STEPS, later=later).after(ahead)

    motion = _move_exactly(rig, fine, h, "first", every=BAND_STEPS)
    return replace(
        motion,
        finer=(BAND_STEPS, lambda: _move_exactly(rig, fine, h, "first")),
        delayed=None if rig.elements else delayed,
    )


@lru_cache(maxsize=KEPT)
def _on_band_steps(inputs: Signals) -> Floats:
    return finer(inputs.values, BAND_STEPS)


def _move_exactly(
    rig: Rig, inputs: np.ndarray, sample_time: float, input_hold: str, *, every: int = 1, later: float = 0.0
) -> Motion:
    """Motion of a linear rig, at every so many samples; `later` is a further delay of the inputs, s.

    With held inputs, at every sample.
    """
    modes, participation = rig.modes, participation_of(rig)
    system = _poles(modes)
    responses: list[Complexes] = []
    acting = np.zeros((inputs.shape[0], inputs.shape[1] // every))
    response_to = held_response if input_hold == "zero" else partial(straight_response, every=every)
    for delay, lag in {(a.delay, a.time_constant) for a in rig.actuators}:
        group = [j for j, a in enumerate(rig.actuators) if (a.delay, a.time_constant) == (delay, lag)]
        forces = np.array([actuator_force(rig.actuators[j], inputs[j]) for j in group])
        share, at_samples = response_to(
            system, forces, participation[:, group], sample_time, delay=delay + later, time_constant=lag
        )
        responses.append(share)
        acting[group] = at_samples
    n_samples, sample_time = acting.shape[1], sample_time * every
    steps = _steps_within(rig, inputs, acting, participation, sample_time) if input_hold == "zero" else ()
    bias = np.array([actuator.bias for actuator in rig.actuators])
    if bias.any():
        constant = np.outer(bias, np.ones(n_samples))
        share, at_samples = held_response(system, constant, participation, sample_time, delay=later)
        responses.append(share)
        acting += at_samples
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
    """Steps of the modal forces within each sample interval, of held inputs that are delayed or lagged.

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
    # coupling by damping is among the forces on the modes, so that the diagonal alone remains
    bias = np.array([actuator.bias for actuator in rig.actuators]).reshape(-1, 1)
    acting = at_samples[: len(rig.actuators)] - bias
    steps = _steps_within(rig, inputs, acting, participation, sample_time) if input_hold == "zero" else ()
    n_inputs = len(rig.actuators)
    held = participation[:, :n_inputs] @ at_samples[:n_inputs] if input_hold == "zero" else 0.0
    damping = np.diag(np.diag(modes.damping))
    stepped = Motion(q, v, participation @ at_samples + f, stiffness, damping, steps, held)
    if substeps == 1 or not (rig.elements or input_hold == "band-limited" or _is_rate_limited(rig)):
        return stepped
    return replace(stepped, finer=(substeps, lambda: _move_finely(rig, inputs, sample_time, substeps, input_hold)))


def _move_finely(rig: Rig, inputs: Floats, sample_time: float, substeps: int, input_hold: str) -> Motion:
    """The motion of `_move_in_steps` with every substep as a sample."""
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
    """Innovations (n_sensors, n_samples): errors of one-step-ahead predictions by an observer of the rig.

    The observer keeps the motion near the measured one, from which that of a stiff contact, say, diverges within a few
    periods. The innovations are therefore smooth functions of the parameters of the rig.

    Args:
        rig: its sensors may have gain, bias and drift; lag, clipping and rounding are not included.
        inputs: (n_actuators, n_samples) commands.
        outputs: (n_sensors, n_samples) measured.
        gain: (2, n_modes, n_sensors) of the observer, from innovations to displacements and velocities of the modes.
        sample_time: s.
        substeps: per sample interval.
        input_hold: as of `simulate`.
    """
    errors = np.empty_like(outputs)
    _step(rig, inputs, outputs, gain, sample_time, substeps, input_hold, (NOTHING, NOTHING, NOTHING), errors)
    return errors


@lru_cache(maxsize=KEPT)
def reading_of(rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Output matrix (n_sensors, n_modes) of the sensors, and the order (n_sensors,) of their time derivative.

    The arrays are cached and must not be changed.
    """
    rows, orders = np.zeros((len(rig.sensors), rig.modes.n_modes)), np.zeros(len(rig.sensors), np.int64)
    for order, here, shapes in _shapes_at_sensors(rig):
        rows[here], orders[here] = shapes, order
    return np.array([sensor.gain for sensor in rig.sensors])[:, None] * rows, orders


@lru_cache(maxsize=KEPT)
def _shapes_at_sensors(rig: Rig) -> list[tuple[int, list[int], np.ndarray]]:
    """Sensors grouped by quantity and direction: order of the time derivative, sensors, shapes (n_here, n_modes)."""
    groups, measured = [], [(*MEASURED[sensor.quantity], sensor.direction) for sensor in rig.sensors]
    for derivative, order, direction in set(measured):
        here = [j for j, kind in enumerate(measured) if kind == (derivative, order, direction)]
        try:
            shapes = rig.modes.phi([rig.sensors[j].at for j in here], derivative, direction=direction)
        except PlaceError:
            _ = [shape_of(rig.modes, rig.sensors[j]) for j in here]  # raises with the name of the sensor
            raise
        if any(rig.sensors[j].shape_error for j in here):
            shapes = shapes + [shape_error_of(rig.sensors[j], rig.modes.n_modes) for j in here]
        groups.append((order, here, shapes))
    return groups


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
    """Step a rig through a record: fill modal displacements, velocities and element forces, or the innovations.

    Returns:
        Participation (n_modes, n_forces) of the forces of actuators and sinusoids, and these forces at the samples
        (n_forces, n_samples).
    """
    modes = rig.modes
    n_samples = inputs.shape[1]
    driving = drives(rig.actuators, inputs, sample_time, substeps, input_hold)
    driven, starts, ends, at_samples = driving.driven, driving.starts, driving.ends, driving.at_samples
    participation, (damping, coupling, distributed) = participation_of(rig), structure_arrays(rig)
    h = sample_time / substeps
    corrections = {c: motion_correction(c, modes.omega, damping, h) for c in {course for _, course in driving.courses}}
    added = [corrections[course] * participation[:, j] for j, course in driving.courses]
    for element in rig.elements:
        if isinstance(element, elements.PeriodicForce):
            start, end, now = sinusoid_on_substeps(element, n_samples, sample_time, substeps)
            driven, starts, ends = np.append(driven, True), np.vstack([starts, start]), np.vstack([ends, end])
            at_samples = np.vstack([at_samples, now])
            participation = np.column_stack([participation, modes.phi_at(element.at)])
    measured, reading, orders = outputs, NOTHING, NO_ORDERS
    if outputs.size:
        reading, orders = reading_of(rig)
        measured = _without_feedthrough(rig, outputs, reading, orders, participation, at_samples)
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
        *distributed,
        *_laws(rig),
        measured,
        orders,
        reading,
        gain,
        *motion,
        errors,
    )
    return participation, at_samples


def _without_feedthrough(
    rig: Rig, outputs: Floats, reading: Floats, orders: Integers, participation: Floats, at_samples: Floats
) -> Floats:
    """Outputs (n_sensors, n_samples) without biases, drifts, and the feedthrough of forces to accelerations."""
    measured = outputs.copy()
    for j, sensor in enumerate(rig.sensors):
        if sensor.bias or sensor.drift:
            measured[j] -= sensor.bias + sensor.drift * np.linspace(0.0, 1.0, outputs.shape[1])
    here = np.flatnonzero(orders == 2)
    if here.size and at_samples.size:
        measured[here] -= reading[here] @ (participation @ at_samples)
    return measured


@lru_cache(maxsize=KEPT)
def structure_arrays(rig: Rig) -> tuple[Floats, Floats, tuple[float, Floats, Floats, Floats]]:
    """Damping and distributed elements as arrays for the compiled steppers.

    All have one type and memory layout, since numba compiles a stepper again for any other; absent parts are empty
    arrays. The arrays are cached and must not be changed.

    Returns:
        Damping (n_modes,), its coupling (n_modes, n_modes), and of the distributed elements: coefficient of stretching,
        ∫ φ_r' φ_s' dx, shapes (n_modes, n_points) at quadrature points for drag, and its coefficient times the weights.
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
    """Kinds (n_elements,), shapes (n_elements, n_modes) and parameters (n_elements, n_parameters) of point elements."""
    user_defined = any(isinstance(e, elements.UserLaw) for e in points)
    parameters = np.zeros((len(points), stepping.N_PARAMETERS + user_defined))
    for row, element in zip(parameters, points, strict=True):
        row[: len(element.parameters)] = element.parameters
        if isinstance(element, elements.UserLaw):
            row[-1] = stepping.address_of(element.law)
    shapes = np.array([rig.modes.phi_at(e.at) for e in points]).reshape(len(points), rig.modes.n_modes)
    return np.array([LAWS[type(e)] for e in points], np.int64), np.ascontiguousarray(shapes), parameters


def along(rig: Rig, derivative: int) -> tuple[Floats, Floats]:
    """Shapes and quadrature weights at Gauss points along the structure, for products of up to four shapes."""
    points, weights = rig.modes.domain.quadrature(max(3 * rig.modes.n_modes + 12, 30))
    return rig.modes.phi(points, derivative), weights


def stretching_of(rig: Rig) -> Floats:
    """∫ φ_r' φ_s' dx, (n_modes, n_modes)."""
    slopes, weights = along(rig, 1)
    return slopes.T @ (weights[:, None] * slopes)


def _lagged(truth: np.ndarray, time_constant: float, sample_time: float) -> np.ndarray:
    """A first-order lag of a signal that is linear between samples, in steady state at its first value."""
    ratio = sample_time / time_constant
    fade = np.exp(-ratio)
    new = 1.0 - (1.0 - fade) / ratio
    old = (1.0 - fade) / ratio - fade
    return np.asarray(lfilter([new, old], [1.0, -fade], truth, zi=[(1.0 - new) * truth[0]])[0])


def _mean_rounded(y: np.ndarray, step: float, noise_std: float) -> np.ndarray:
    """The mean of a rounded noisy reading, by the Fourier series of the rounding error."""
    sigma = noise_std / step
    if sigma < 0.05:
        return step * np.round(y / step)
    error = np.zeros_like(y)
    for m in range(1, 12):
        weight = np.exp(-2.0 * (np.pi * m * sigma) ** 2)
        if weight < 1e-12:
            break
        error += (-1.0) ** m / (np.pi * m) * weight * np.sin(2.0 * np.pi * m * y / step)
    return y + step * error
