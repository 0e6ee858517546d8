"""A digital controller: once per sample, from readings to commands, with compensation of actuators and sensors.

    y = scale (reading - offset)
    w = C z + D y + friction feed-forward,          on-off: w = -allocation relay(C z + D y)
    v = w within ± limit, and within ± rate of the previous v
    command = v + dead zone in the direction of v - bias
    z ← A z + B y + E v

v is the command that the actuator can follow: an observer driven by v instead of w does not wind up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import control
import numpy as np
from scipy.signal import cont2discrete

from workbench.arguments import number
from workbench.arrays import Floats
from workbench.design.estimation.controller import Controller
from workbench.renamed import former_fields
from workbench.rig.statespace import signal_names
from workbench.structure.modes import freeze, frozen

ONSET = 0.01  # of a dead zone: |v| over which its inverse rises from zero, so that the command does not jump


@dataclass(frozen=True, eq=False)
class Relays:
    """On-off forces: w = -allocation k sgn(s) outside the dead band of s.

    Attributes:
        allocation: (n_actuators, n_relays).
        force: (n_relays,) k.
        dead_band: (n_relays,).
    """

    allocation: np.ndarray
    force: np.ndarray
    dead_band: np.ndarray


@dataclass(frozen=True, eq=False)
class FrictionFeedforward:
    """Commands that oppose friction: gain · force tanh(speed / smoothing), the speed estimated as C z + D y.

    Attributes:
        gain: (n_actuators, n_frictions) command per force of friction.
        of_state: (n_frictions, n_states) C.
        of_reading: (n_frictions, n_sensors) D.
        force: (n_frictions,) N.
        smoothing: (n_frictions,) m/s.
    """

    gain: np.ndarray
    of_state: np.ndarray
    of_reading: np.ndarray
    force: np.ndarray
    smoothing: np.ndarray


@former_fields(**{letter.lower(): letter for letter in "ABCDE"})
@dataclass(frozen=True, eq=False)
class DigitalController:
    """A controller that runs once a sample.

    Attributes:
        sample_time: s.
        sensors: (n_sensors,) names of the channels that it reads.
        actuators: (n_actuators,) names of those that it commands.
        A, B, C, D, E: (n_states, n_states), (n_states, n_sensors), (n_outputs, n_states), (n_outputs, n_sensors) and
            (n_states, n_actuators); n_outputs is n_actuators, or the number of relays.
        offset, scale: (n_sensors,) y = scale (reading - offset).
        limit, rate, dead_zone, bias: (n_actuators,) in units of the command; the rate per sample.
        relays: of on-off control.
        friction: fed forward.
        name: for tables and plots.
        states: (n_states,) what each state is, in words; may be empty.
    """

    sample_time: float
    sensors: tuple[str, ...]
    actuators: tuple[str, ...]
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    E: np.ndarray
    offset: np.ndarray = field(default_factory=lambda: np.zeros(0))
    scale: np.ndarray = field(default_factory=lambda: np.zeros(0))
    limit: np.ndarray = field(default_factory=lambda: np.zeros(0))
    rate: np.ndarray = field(default_factory=lambda: np.zeros(0))
    dead_zone: np.ndarray = field(default_factory=lambda: np.zeros(0))
    bias: np.ndarray = field(default_factory=lambda: np.zeros(0))
    relays: Relays | None = None
    friction: FrictionFeedforward | None = None
    name: str = "controller"
    states: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n_sensors, n_actuators = len(self.sensors), len(self.actuators)
        rest = {"offset": 0.0, "scale": 1.0, "limit": np.inf, "rate": np.inf, "dead_zone": 0.0, "bias": 0.0}
        for name, neutral in rest.items():
            size = n_sensors if name in ("offset", "scale") else n_actuators
            value = getattr(self, name)
            object.__setattr__(self, name, frozen(value if np.size(value) else np.full(size, neutral)))
        freeze(self, *"ABCDE")
        n = self.A.shape[0]
        n_outputs = n_actuators if self.relays is None else self.relays.force.size
        if len(self.states) not in (0, n):
            raise ValueError(f"DigitalController.states must name all {n} states, or none; got {len(self.states)}")
        expected = {"A": (n, n), "B": (n, n_sensors), "C": (n_outputs, n), "D": (n_outputs, n_sensors)}
        for name, shape in (expected | {"E": (n, n_actuators)}).items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"DigitalController.{name} must have shape {shape}; got {getattr(self, name).shape}")

    def step(self, z: np.ndarray, before: np.ndarray, reading: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The commands and v (n_actuators,) at a sample, and the next state z (n_states,).

        Args:
            z: (n_states,), zero at the start.
            before: (n_actuators,) v of the previous sample, zero at the start.
            reading: (n_sensors,).
        """
        y = self.scale * (reading - self.offset)
        w = self.C @ z + self.D @ y
        if self.relays is not None:
            sign = np.where(np.abs(w) > self.relays.dead_band, np.sign(w), 0.0)
            w = -self.relays.allocation @ (self.relays.force * sign)
        if self.friction is not None:
            speed = self.friction.of_state @ z + self.friction.of_reading @ y
            w = w + self.friction.gain @ (self.friction.force * np.tanh(speed / self.friction.smoothing))
        v = np.clip(np.clip(w, -self.limit, self.limit), before - self.rate, before + self.rate)
        command = v + self.dead_zone * np.clip(v / self.onset, -1.0, 1.0) - self.bias
        return command, v, self.A @ z + self.B @ y + self.E @ v

    @property
    def onset(self) -> np.ndarray:
        """(n_actuators,) |v| from which the dead zone is compensated in full; 1 where there is no dead zone."""
        return np.asarray(np.where(self.dead_zone > 0, ONSET * self.dead_zone, 1.0))

    @property
    def linear(self) -> bool:
        """Whether commands are a linear function of readings."""
        bounded = np.isfinite(self.limit).any() or np.isfinite(self.rate).any() or self.dead_zone.any()
        return not (bounded or self.bias.any() or self.offset.any() or self.relays or self.friction)

    def state_space(self) -> control.StateSpace:
        """The linear part as python-control's discrete `StateSpace` from readings to commands, without limits.

        Raises:
            ValueError: on-off control, which has no linear part.
        """
        if self.relays is not None:
            raise ValueError(f"{self.name} switches, so it has no StateSpace; simulate it instead")
        a, b = self.A + self.E @ self.C, (self.B + self.E @ self.D) * self.scale
        names = {"inputs": signal_names(self.sensors), "outputs": signal_names(self.actuators)}
        return control.ss(a, b, self.C, self.D * self.scale, self.sample_time, **names)


def modal_states(modes: Sequence[int]) -> tuple[str, ...]:
    """The states of an observer of these modes (zero-based), in words: displacements, then rates."""
    kinds = (("displacement", "kg^0.5 m"), ("rate", "kg^0.5 m/s"))
    return tuple(f"estimated {kind} of mode {r + 1}, {unit}" for kind, unit in kinds for r in modes)


def sampled(controller: Controller, sample_time: float) -> DigitalController:
    """A continuous controller discretised, each reading held until the next sample (zero-order hold).

    z' = A z + B y becomes z ← e^{A T} z + ∫ e^{A t} dt B y.

    Args:
        controller: a law through a modal filter, or on an observer.
        sample_time: T, s.

    Raises:
        TypeError: no controller, or a sample time that is no number.
        ValueError: a sample time that is not above zero.
    """
    if not isinstance(controller, Controller):
        raise TypeError(
            f"the controller must be a law on an estimator; got {type(controller).__name__}: make one by"
            " kalman_controller, luenberger_controller or filtered; a DigitalController is sampled already,"
            " write_controller writes it"
        )
    if not 0 < number(sample_time, "sample_time", "s") < np.inf:
        raise ValueError(f"sample_time must be above 0; got {sample_time:g} s")
    a, b = zero_order_hold(controller.A, controller.B, sample_time)
    names = tuple(s.name for s in controller.sensors), tuple(a.name for a in controller.law.actuators)
    c, d, e = controller.C, controller.D, np.zeros(controller.C.T.shape)
    states = () if controller.static else modal_states(controller.law.controlled)
    return DigitalController(sample_time, *names, a, b, c, d, e, name=controller.name, states=states)


def zero_order_hold(a: Floats, b: Floats, span: float) -> tuple[Floats, Floats]:
    """e^{A t} and ∫_0^t e^{A s} ds B over a span t (s), for an input that is held."""
    transition, into, *_ = cont2discrete((a, b, np.eye(len(a)), np.zeros(b.shape)), span)
    return transition, into
