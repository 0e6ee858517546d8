"""Simulation of a rig under a digital controller, with all imperfections of actuators, sensors and elements."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from workbench.arguments import number, whole
from workbench.design.estimation.controller import check_readable
from workbench.design.estimation.digital import DigitalController
from workbench.design.loop.closed_loop import Response
from workbench.design.loop.loop_steps import ControllerArrays, loop_record
from workbench.renamed import former_fields
from workbench.rig.actuators import Actuator, mixing
from workbench.rig.elements import PeriodicForce, RandomForce
from workbench.rig.rig import Rig, participation_of, shape_of
from workbench.rig.sensors import MEASURED, Sensor
from workbench.rig.stepping import law_arrays, structure_arrays
from workbench.structure.domain import Location
from workbench.structure.modes import freeze
from workbench.threads import cores

SUBSTEPS = 4

P = TypeVar("P", Actuator, Sensor)
K = TypeVar("K")


@former_fields(ports="exciters")
@dataclass(frozen=True, eq=False)
class LoopTest:
    """The excitation of a loop from rest: an impulse, forces held over each sample, or both.

    Attributes:
        n_samples: of the test.
        sample_time: s.
        impulse_at: the place of an impulse at t = 0; None for none.
        impulse: N s.
        forces: (n_forces, n_samples) N.
        exciters: (n_forces,) actuators whose place, kind and direction say how the forces act; the rest is not used.
        seed: of the sensors' noise and of random disturbances; None for neither.
    """

    n_samples: int
    sample_time: float
    impulse_at: Location | None = None
    impulse: float = 1.0
    forces: np.ndarray | None = None
    exciters: tuple[Actuator, ...] = ()
    seed: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_samples", whole(self.n_samples, "LoopTest.n_samples"))
        if self.n_samples < 2 or not number(self.sample_time, "LoopTest.sample_time", "s") > 0:
            raise ValueError(
                f"a test needs 2 samples or more, a positive time apart; got {self.n_samples}, {self.sample_time:g} s"
            )
        if self.forces is None:
            return
        if np.shape(self.forces) != (len(self.exciters), self.n_samples):
            raise ValueError(
                f"LoopTest.forces must have shape ({len(self.exciters)} exciters, {self.n_samples} samples); got"
                f" {np.shape(self.forces)}. Is time last?"
            )
        freeze(self, "forces")

    @property
    def time(self) -> np.ndarray:
        return self.sample_time * np.arange(self.n_samples)


@former_fields(into="participation")
@dataclass(frozen=True, eq=False)
class LoopRun:
    """The response of a rig under a controller.

    Attributes:
        response: modal motion, and the mean of the actuators' forces over each sample.
        commands: (n_actuators, n_samples).
        elements: (3, n_elements, n_samples) displacement, rate and force of each element at a point.
        bounded: whether the motion stayed finite to the end; the response ends before the sample at which it diverged.
        participation: (n_modes, n_actuators) modal forces per force.
    """

    response: Response
    commands: np.ndarray
    elements: np.ndarray
    bounded: bool
    participation: np.ndarray

    def __post_init__(self) -> None:
        freeze(self, "commands", "elements", "participation")

    @property
    def work(self) -> np.ndarray:
        """W_r = ∫ b_rᵀ F q_r' dt (n_modes,), by the mean force over each sample; exact for forces held over it."""
        n = self.response.modes.n_modes
        modal = self.participation @ self.response.forces[:, :-1]
        return np.asarray((modal * np.diff(self.response.modal[:n], axis=1)).sum(axis=1))

    @property
    def effort(self) -> float:
        """∫ FᵀF dt."""
        time = self.response.time
        return float((self.response.forces**2).sum() * (time[1] - time[0]))


def run_loop(
    rig: Rig, controller: DigitalController, test: LoopTest, *, substeps: int = SUBSTEPS, free: int = 0
) -> LoopRun:
    """The response of a rig under a controller.

    Args:
        rig: has the sensors and actuators that the controller names.
        controller: of the test's sample time.
        test: the excitation.
        substeps: per sample.
        free: samples after the test without noise, forces of the test, or disturbances of the rig.

    Raises:
        ValueError: sensors or actuators that the rig does not have, another sample time, an accelerometer, or
            cross-talk into an actuator that the controller does not drive.
    """
    check_fits(rig, controller, test)
    modes, n = rig.modes, rig.modes.n_modes
    sensors = [named(rig.sensors, name) for name in controller.sensors]
    actuators = driven(rig, controller.actuators)
    participation = participation_of(Rig(modes, tuple(actuators), ()))
    rng = None if test.seed is None else np.random.default_rng(test.seed)
    noise = np.zeros((len(sensors), test.n_samples))
    if rng is not None:
        noise += np.array([s.noise_std for s in sensors])[:, None] * rng.standard_normal(noise.shape)
    forces, at = _disturbances(rig, test, rng)
    noise, forces = (np.pad(acting, ((0, 0), (0, free))) for acting in (noise, forces))
    n_samples = test.n_samples + free
    start = np.zeros((2, n))
    if test.impulse_at is not None:
        start[1] = test.impulse * modes.phi_at(test.impulse_at)
    laws = law_arrays(rig)
    rows = (n, n, len(actuators), len(actuators), *[laws[0].size] * 3)
    out = tuple(np.zeros((size, n_samples)) for size in rows)
    bounded = loop_record(
        structure_arrays(rig),
        laws,
        np.array([_drive(a) for a in actuators]).reshape(-1, 9),
        mixing(actuators) if any(a.crosstalk for a in actuators) else np.zeros((0, 0)),
        np.ascontiguousarray(participation),
        np.array([_sense(s, test.n_samples) for s in sensors]).reshape(-1, 7),
        _output_matrices(rig, sensors),
        noise,
        _arrays(controller),
        start,
        forces,
        at,
        float(test.sample_time),
        substeps,
        out,
    )
    q, v, f, u, *elements = out
    time = test.sample_time * np.arange(n_samples, dtype=float)
    response = Response(time, np.vstack([q, v]), f, modes)
    return LoopRun(response, u, np.array(elements), bool(bounded), participation)


def run_loops(rigs: Sequence[Rig], controller: DigitalController, test: LoopTest) -> list[LoopRun]:
    """The responses of many rigs, each with its own noise, computed on all cores."""
    return of_loops(rigs, controller, test, lambda _rig, _test, run: run)


def of_loops(
    rigs: Sequence[Rig], controller: DigitalController, test: LoopTest, kept: Callable[[Rig, LoopTest, LoopRun], K]
) -> list[K]:
    """`kept(rig, test, run)` of each of many rigs, computed on all cores; the runs themselves would fill the memory."""
    tests = [test if test.seed is None else replace(test, seed=test.seed + i) for i in range(len(rigs))]
    with ThreadPoolExecutor(cores()) as pool:
        return list(pool.map(lambda rig, one: kept(rig, one, run_loop(rig, controller, one)), rigs, tests))


def check_fits(rig: Rig, controller: DigitalController, test: LoopTest) -> None:
    """Refuse a controller that does not fit a rig or a test, or one that reads an accelerometer."""
    for kind in ("sensor", "actuator"):
        there = {part.name for part in getattr(rig, f"{kind}s")}
        missing = [name for name in getattr(controller, f"{kind}s") if name not in there]
        if missing:
            raise ValueError(
                f"the controller names {kind} {missing[0]!r}, which the rig does not have: it has"
                f" {', '.join(sorted(there)) or 'none'}; use the rig's names of {kind}s in the controller"
            )
    if abs(controller.sample_time / test.sample_time - 1.0) > 1e-9:
        raise ValueError(
            f"the controller has a sample time of {controller.sample_time:g} s and the test of {test.sample_time:g} s;"
            " give both the same"
        )
    check_readable([named(rig.sensors, name) for name in controller.sensors])


def named(parts: Sequence[P], name: str) -> P:
    """The first of the actuators or sensors with a name."""
    return next(part for part in parts if part.name == name)


def driven(rig: Rig, names: Sequence[str]) -> list[Actuator]:
    """The actuators of a rig that a controller drives; cross-talk from others, which have no command, is left out.

    Another actuator that takes a share of the command of one of them is refused.
    """
    for actuator in rig.actuators:
        taken = [name for name, _ in actuator.crosstalk if name in names]
        if taken and actuator.name not in names:
            raise ValueError(
                f"actuator {actuator.name} takes a share of the command of {taken[0]}, and the controller does not"
                f" drive it: let the controller drive {actuator.name} too"
            )
    actuators = [named(rig.actuators, name) for name in names]
    return [
        replace(a, crosstalk=tuple(each for each in a.crosstalk if each[0] in names)) if a.crosstalk else a
        for a in actuators
    ]


def _drive(a: Actuator) -> list[float]:
    dynamics = (a.delay, a.time_constant, a.bias, a.rate_limit)
    return [a.gain, a.dead_zone, a.limit, *dynamics, a.hysteresis_share, a.hysteresis_width]


def _sense(s: Sensor, n_samples: int) -> list[float]:
    # a negative delay, of a sensor ahead of the inputs' clock, is not causal in a loop
    return [s.gain, s.bias, s.drift / (n_samples - 1), max(s.delay, 0.0), s.time_constant, s.limit, s.step]


def _output_matrices(rig: Rig, sensors: Sequence[Sensor]) -> np.ndarray:
    """(2, n_sensors, n_modes) from displacements and from rates to each sensor, without gain, with cross-talk."""
    matrices = np.zeros((2, len(sensors), rig.modes.n_modes))
    for j, sensor in enumerate(sensors):
        for source, share in ((sensor, 1.0), *((named(rig.sensors, n), part) for n, part in sensor.crosstalk)):
            order = MEASURED[source.quantity][1]
            if order < 2:
                matrices[order, j] += share * shape_of(rig.modes, source)
    return matrices


def _disturbances(rig: Rig, test: LoopTest, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
    """Forces (n_forces, n_samples) of the test and the rig's elements, and their participation (n_modes, n_forces)."""
    rows = [] if test.forces is None else list(test.forces)
    columns = list(participation_of(Rig(rig.modes, test.exciters, ())).T) if test.exciters else []
    middle = test.time + 0.5 * test.sample_time
    for element in rig.elements:
        if isinstance(element, PeriodicForce):
            rows.append(element.amplitude * np.sin(2 * np.pi * element.frequency_hz * middle + element.phase))
            columns.append(rig.modes.phi_at(element.at))
        elif isinstance(element, RandomForce) and rng is not None:
            rows.append(element.rms * rng.standard_normal(test.n_samples))
            columns.append(rig.modes.phi_at(element.at))
    n = rig.modes.n_modes
    return np.array(rows).reshape(-1, test.n_samples), np.ascontiguousarray(np.array(columns).reshape(-1, n).T)


def _arrays(one: DigitalController) -> ControllerArrays:
    n, n_sensors, n_actuators = one.A.shape[0], len(one.sensors), len(one.actuators)
    relays, friction = one.relays, one.friction
    switching = (np.zeros((n_actuators, 0)), np.zeros(0), np.zeros(0))
    forward = (np.zeros((n_actuators, 0)), np.zeros((0, n)), np.zeros((0, n_sensors)), np.zeros(0), np.ones(0))
    if relays is not None:
        switching = (relays.allocation, relays.force, relays.dead_band)
    if friction is not None:
        forward = (friction.gain, friction.of_state, friction.of_reading, friction.force, friction.smoothing)
    matrices, bounds = (one.A, one.B, one.C, one.D, one.E), (one.limit, one.rate, one.dead_zone, one.bias)
    groups = (matrices, (one.offset, one.scale, *bounds), switching, forward)
    return tuple(tuple(np.array(x, float, order="C") for x in group) for group in groups)
