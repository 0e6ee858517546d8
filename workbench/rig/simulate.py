"""Simulation of a rig from rest: in closed form where it is linear, by time stepping of exact modes elsewhere."""

from dataclasses import replace
from functools import lru_cache, partial, reduce

import numpy as np

from workbench.arrays import Complexes, Floats
from workbench.records.band_limited import finer
from workbench.records.record import Record
from workbench.rig.actuators import mixed
from workbench.rig.driving import actuator_force, drives, motion_correction, on_finer_steps, sinusoid_on_substeps
from workbench.rig.elements import PeriodicForce, RandomForce
from workbench.rig.lanes import on_lanes
from workbench.rig.linear import (
    ModalPoles,
    first_order_hold_response,
    held_response,
    modal_motion,
    modal_poles,
    shifted,
    sinusoid_response,
    whole_samples,
)
from workbench.rig.motion import Motion, Step
from workbench.rig.readings import read, reading_of
from workbench.rig.rig import KEPT, Rig, participation_of
from workbench.rig.stepping import Forces, Observer, law_arrays, step_record, structure_arrays
from workbench.structure.modes import Modes

BAND_STEPS = 32  # linear steps of a band-limited input per sample interval: an error of 0.05 % at 0.4 of the rate
NOTHING = np.zeros((0, 0))
NO_OBSERVER: Observer = NOTHING, np.zeros(0, np.int64), NOTHING, np.zeros((2, 0, 0))


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
    return rig.record(inputs, read(rig, motion), sample_time=sample_time, name=name, input_hold=input_hold)


def simulate_record(rig: Rig, record: Record, *, substeps: int = 8) -> np.ndarray:
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
    if rig.stiffness_rate != 0 or rig.is_rate_limited:
        return True
    return any(not isinstance(e, PeriodicForce | RandomForce) for e in rig.elements)


def steps_exactly(rig: Rig) -> bool:
    """Whether steps of a whole sample are exact: no element, delay or lag, and proportional damping."""
    late = any(actuator.delay or actuator.time_constant for actuator in rig.actuators)
    return rig.modes.proportional and not (late or rig.elements or rig.stiffness_rate)


def _move_band_limited(rig: Rig, inputs: Floats, sample_time: float) -> Motion:
    """Motion under inputs that are linear between many points of each sample interval."""
    fine, h = on_finer_steps(inputs, BAND_STEPS), sample_time / BAND_STEPS

    @lru_cache(maxsize=KEPT)
    def delayed(delay: float) -> Motion:
        """The motion under inputs so much later; a negative delay takes whole samples from after the last one."""
        ahead = max(int(np.ceil(-delay / sample_time)), 0)
        extended = np.pad(fine, ((0, 0), (0, ahead * BAND_STEPS)), mode="edge")
        later = delay + ahead * sample_time
        return _move_exactly(rig, extended, h, "first", every=BAND_STEPS, later=later).after(ahead)

    return replace(
        _move_exactly(rig, fine, h, "first", every=BAND_STEPS),
        finer=lambda: _move_exactly(rig, fine, h, "first"),
        delayed=None if rig.elements else delayed,
    )


def _move_exactly(
    rig: Rig, inputs: np.ndarray, sample_time: float, input_hold: str, *, every: int = 1, later: float = 0.0
) -> Motion:
    """Motion of a linear rig, at every so many samples; `later` is a further delay of the inputs, s.

    With held inputs, at every sample.
    """
    modes, participation = rig.modes, participation_of(rig)
    system, inputs = _poles(modes), mixed(rig.actuators, inputs)
    responses: list[Complexes] = []
    acting = np.zeros((inputs.shape[0], inputs.shape[1] // every))
    response_to = held_response if input_hold == "zero" else partial(first_order_hold_response, every=every)
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
        if not isinstance(element, PeriodicForce):
            continue
        shape = modes.phi_at(element.at)
        omega, phasor = 2 * np.pi * element.frequency_hz, element.amplitude * np.exp(1j * element.phase)
        responses.append(sinusoid_response(system, shape, omega, phasor, sample_time, n_samples))
        on_modes = on_modes + np.outer(shape, (phasor * np.exp(1j * omega * time)).imag)
    if not responses:
        responses.append(np.zeros((system.poles.size, n_samples), complex))
    q, v = modal_motion(system, reduce(np.add, responses))
    return Motion(q, v, on_modes, modes.omega[:, None] ** 2, modes.damping, sample_time, steps, held)


@lru_cache(maxsize=KEPT)
def _poles(modes: Modes) -> ModalPoles:
    return modal_poles(modes.omega, modes.damping)


def _steps_within(
    rig: Rig, inputs: Floats, acting: Floats, participation: Floats, sample_time: float
) -> tuple[Step, ...]:
    """Steps of the modal forces within each sample interval, of held inputs that are delayed or lagged.

    `inputs` are commands with cross-talk, `acting` the forces at the samples without bias, (n_actuators, n_samples).
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


def _move_in_steps(rig: Rig, inputs: Floats, sample_time: float, substeps: int, input_hold: str) -> Motion:
    modes, (n_inputs, n_samples) = rig.modes, inputs.shape
    participation, at_samples, forces = _forces(rig, inputs, sample_time, substeps, input_hold)
    q, v, of_elements = (np.zeros((modes.n_modes, n_samples)) for _ in range(3))
    out = q, v, of_elements, NOTHING
    step_record(structure_arrays(rig), law_arrays(rig), forces, sample_time, substeps, NO_OBSERVER, out)
    scale = 1.0 + rig.stiffness_rate * sample_time * np.arange(n_samples)
    stiffness = modes.omega[:, None] ** 2 * (scale if rig.stiffness_rate else 1.0)
    # coupling by damping is among the forces on the modes, so that the diagonal alone remains
    damping, on_modes = np.diag(np.diag(modes.damping)), participation @ at_samples + of_elements
    steps: tuple[Step, ...] = ()
    held: Floats | float = 0.0
    if input_hold == "zero":
        acting, bias = at_samples[:n_inputs], np.array([actuator.bias for actuator in rig.actuators])
        taken = mixed(rig.actuators, inputs)
        steps = _steps_within(rig, taken, acting - bias[:, None], participation, sample_time)
        held = participation[:, :n_inputs] @ acting
    recomputed = None
    if substeps > 1 and (rig.elements or input_hold == "band-limited" or rig.is_rate_limited):
        recomputed = partial(_move_finely, rig, inputs, sample_time, substeps, input_hold)
    return Motion(q, v, on_modes, stiffness, damping, sample_time, steps, held, recomputed)


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
        inputs, outputs: commands (n_actuators, n_samples) and measured readings (n_sensors, n_samples).
        gain: (2, n_modes, n_sensors) of the observer, from innovations to displacements and velocities of the modes.
        sample_time, substeps, input_hold: as of `simulate`.
    """
    participation, at_samples, forces = _forces(rig, inputs, sample_time, substeps, input_hold)
    reading, orders = reading_of(rig)
    measured, errors = outputs.copy(), np.empty_like(outputs)
    for j, sensor in enumerate(rig.sensors):
        if sensor.bias or sensor.drift:
            measured[j] -= sensor.bias + sensor.drift * np.linspace(0.0, 1.0, outputs.shape[1])
    accelerometers = np.flatnonzero(orders == 2)
    if accelerometers.size and at_samples.size:  # the forces' feedthrough
        measured[accelerometers] -= reading[accelerometers] @ (participation @ at_samples)
    observer = measured, orders, on_lanes(reading), on_lanes(gain.transpose(0, 2, 1))
    out = NOTHING, NOTHING, NOTHING, errors
    step_record(structure_arrays(rig), law_arrays(rig), forces, sample_time, substeps, observer, out)
    return errors


def _forces(
    rig: Rig, inputs: Floats, sample_time: float, substeps: int, input_hold: str
) -> tuple[Floats, Floats, Forces]:
    """Participation (n_modes, n_forces) of actuators and sinusoids, their forces at samples and for `step_record`."""
    modes, h, participation = rig.modes, sample_time / substeps, participation_of(rig)
    drive = drives(inputs, substeps, rig.actuators, sample_time, input_hold)
    driven, starts, ends, at_samples, waveforms, sizes = drive
    damping = np.diag(modes.damping).copy()
    corrections = {c: motion_correction(c, modes.omega, damping, h) for c in {waveform for _, waveform in waveforms}}
    added = [corrections[waveform] * participation[:, j] for j, waveform in waveforms]
    for element in rig.elements:
        if isinstance(element, PeriodicForce):
            start, end, now = sinusoid_on_substeps(element, inputs.shape[1], sample_time, substeps)
            driven, starts, ends = np.append(driven, True), np.vstack([starts, start]), np.vstack([ends, end])
            at_samples = np.vstack([at_samples, now])
            participation = np.column_stack([participation, modes.phi_at(element.at)])
    corrected = on_lanes(np.array(added).reshape(len(added), 2, modes.n_modes))
    return participation, at_samples, (on_lanes(participation[:, driven].T), starts, ends, corrected, sizes)
