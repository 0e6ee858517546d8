"""A law and its estimator as a digital controller that makes up for what the corrected rig loses on the way.

With X = (x, a) the controlled modes and the forces of lagging actuators, and v the commands that are followed,

    X' = A X + Σ_j b_j v_j(t - τ_j),      a_j' = (v_j(t - τ_j) - a_j) / λ_j

is known exactly between samples. The estimate at a sample is moved ahead by each actuator's delay and half a sample,
by the commands on their way (a predictor after Smith), and a lag is inverted on the way: v = w + λ w', w = -K x. Late
and slow sensors are distinguished by what they read of each mode at its frequency, H_j(iω_r) (c_q + iω_r c_v).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

from workbench.arrays import Floats
from workbench.design.estimation.controller import Controller
from workbench.design.estimation.digital import DigitalController, FrictionForward, Relays, modal_states
from workbench.design.estimation.observers import observed_plant
from workbench.design.laws.law import DesignError, Law
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.rig_loop import named
from workbench.rig.actuators import Actuator
from workbench.rig.elements import CoulombFriction
from workbench.rig.rig import Rig
from workbench.rig.sensors import MEASURED, Sensor
from workbench.structure.modes import Modes

STEPS = ("sensors", "delay", "dead zone", "saturation", "friction")  # what can be compensated, in this order
SLOWEST = 4.0  # samples in a period of a controlled mode, at least
LONGEST = 500  # samples of delay that a predictor holds in its states


class Loop(NamedTuple):
    """A law with its estimator on the modes that it was designed for.

    Attributes:
        modes: of the structure.
        law: of modal states, or on-off.
        controller: whose estimator gives the state; for on-off control its law has no gain.
    """

    modes: Modes
    law: Law | OnOffLaw
    controller: Controller


@dataclass(frozen=True, eq=False)
class _Model:
    """The controlled modes with lagging actuators: X' = a X + b v, v late by `delays`.

    Attributes:
        a: (n_x, n_x); b: (n_x, n_actuators).
        n: states of the modes among them.
        delays, lags: (n_actuators,) s.
        sample_time: s.
        late: (n_actuators,) samples that a command is remembered.
    """

    a: np.ndarray
    b: np.ndarray
    n: int
    delays: np.ndarray
    lags: np.ndarray
    sample_time: float

    @property
    def late(self) -> np.ndarray:
        # an estimate moved ahead by a delay and half a sample looks back no farther than the delay
        return np.ceil(np.round(self.delays / self.sample_time, 9)).astype(int)

    def moved(self, a: np.ndarray, horizon: float) -> tuple[np.ndarray, list[dict[int, np.ndarray]]]:
        """e^{a h}, and by each actuator {samples ago: (n_x,)} what its commands add over h; 0 is the one to be sent."""
        added: list[dict[int, np.ndarray]] = []
        for j, delay in enumerate(self.delays):
            edges = {0.0, horizon}
            whole, step = self.late[j], self.sample_time
            edges |= {e for k in range(-whole, 2) if 0.0 < (e := delay + k * step) < horizon}
            times = sorted(edges)
            by_age: dict[int, np.ndarray] = {}
            for start, end in zip(times, times[1:]):
                age = -int(np.floor(round((0.5 * (start + end) - delay) / step, 9)))
                share = _held(a, self.b[:, j], end - start)
                by_age[max(age, 0)] = by_age.get(max(age, 0), 0.0) + expm(a * (horizon - end)) @ share
            added.append(by_age)
        return expm(a * horizon), added


def _held(a: np.ndarray, b: np.ndarray, span: float) -> np.ndarray:
    """∫_0^span e^{a s} ds b."""
    b = b.reshape(len(a), -1)
    block = np.zeros((len(a) + b.shape[1],) * 2)
    block[: len(a), : len(a)], block[: len(a), len(a) :] = a, b
    moved = expm(block * span)[: len(a), len(a) :]
    return np.asarray(moved[:, 0] if moved.shape[1] == 1 else moved)


def check_rate(modes: Modes, controlled: Sequence[int], sample_time: float) -> None:
    """Refuse a rate that is none, or too slow for the controlled modes, and modes that are not there.

    Raises:
        DesignError: naming the mode and the rate that it needs.
    """
    if max(controlled) >= modes.n_modes:
        raise DesignError(
            f"the controller controls mode {max(controlled) + 1}, and the rig has {modes.n_modes}: design it for the"
            " modes of this rig, or give the rig more"
        )
    if not 0 < sample_time < np.inf:
        raise DesignError(f"a controller runs once every sample_time seconds, above 0; got {sample_time:g}")
    r = max(controlled, key=lambda i: modes.omega[i])
    per_period = 2.0 * np.pi / modes.omega[r] / sample_time if modes.omega[r] > 0 else np.inf
    if per_period < SLOWEST:
        raise DesignError(
            f"{1 / sample_time:g} samples per second are too slow for mode {r + 1} at {modes.frequencies_hz[r]:.4g} Hz:"
            f" sample at {SLOWEST * modes.frequencies_hz[r]:.4g} Hz or faster, or leave the mode out"
        )


def compensated(rig: Rig, loop: Loop, sample_time: float, steps: Sequence[str] = STEPS) -> DigitalController:
    """The digital controller of a law and its estimator on a rig, with the compensations that are asked for.

    Args:
        rig: corrected; its actuators and sensors have the names of the law's and the estimator's.
        loop: designed for it.
        sample_time: s.
        steps: of `STEPS`; "sensors" takes out gain, offset and cross-talk, and allows for late and slow ones.

    Raises:
        DesignError: a rate too slow for the modes, or too fast for an actuator's delay.
    """
    check_rate(loop.modes, loop.law.controlled, sample_time)
    actuators = [named(rig.actuators, a.name) for a in loop.law.actuators]
    sensors = [named(rig.sensors, s.name) for s in loop.controller.sensors]
    aware = "delay" in steps
    model = _model(loop, actuators, sample_time, aware)
    a, b, c, d, e = _matrices(model, loop, sensors, aware, "sensors" in steps)
    gains = np.array([x.gain for x in actuators])
    parts: dict[str, Any] = {}
    if "dead zone" in steps:
        parts["dead_zone"] = np.array([x.dead_zone for x in actuators]) / np.abs(gains)
        parts["bias"] = np.array([x.bias for x in actuators]) / gains
    if "saturation" in steps:
        dead = np.array([0.0 if "dead zone" in steps else x.dead_zone for x in actuators])
        parts["limit"] = (np.array([x.limit for x in actuators]) + dead) / np.abs(gains)
        parts["rate"] = np.array([x.rate_limit for x in actuators]) * sample_time / np.abs(gains)
    if "sensors" in steps:
        parts["offset"] = np.array([s.bias for s in sensors])
        parts["scale"] = np.array([1.0 / s.gain for s in sensors])
        apart = np.linalg.inv(_crosstalk(sensors))
        b, d = b @ apart, d @ apart
    if isinstance(loop.law, OnOffLaw):
        force, band = (np.array([getattr(r, name) for r in loop.law.relays]) for name in ("force", "dead_band"))
        parts["relays"] = Relays(loop.law.spread, force, band)
    if "friction" in steps:
        parts["friction"] = _friction(rig, loop, model, a, b, d)
    names = tuple(s.name for s in sensors), tuple(x.name for x in actuators)
    parts |= {"name": loop.controller.name, "states": _states(model, loop, names[1])}
    return DigitalController(sample_time, *names, a, b, c, d, e, **parts)


def _states(model: _Model, loop: Loop, actuators: Sequence[str]) -> tuple[str, ...]:
    """What each state is: estimates of the modes, commands behind their lags, and commands on their way."""
    filters = loop.controller.state.size == 0  # it reads the modes anew at each sample
    own = ["always zero"] * model.n if filters else modal_states(loop.law.controlled)
    lagging = [f"command of {actuators[int(j)]} behind its lag" for j in np.flatnonzero(model.lags)]
    past = [
        f"command of {name}, {k + 1} {'sample' if k == 0 else 'samples'} ago"
        for name, late in zip(actuators, model.late, strict=True)
        for k in range(late)
    ]
    return (*own, *lagging, *past)


def _model(loop: Loop, actuators: Sequence[Actuator], sample_time: float, aware: bool) -> _Model:
    a, b, _ = observed_plant(loop.modes, loop.controller.law, loop.controller.sensors)
    lags = np.array([x.time_constant if aware else 0.0 for x in actuators])
    delays = np.array([x.delay if aware else 0.0 for x in actuators])
    if (delays > LONGEST * sample_time).any():
        latest = max(actuators, key=lambda x: x.delay)
        raise DesignError(
            f"the delay of {latest.name}, {1e3 * latest.delay:.3g} ms, is {latest.delay / sample_time:,.0f} samples at"
            f" {1 / sample_time:g} Hz, of which a predictor holds {LONGEST}: sample at {LONGEST / latest.delay:.4g} Hz"
            " or slower"
        )
    slow = np.flatnonzero(lags)
    n, n_x = len(a), len(a) + slow.size
    wide, into = np.zeros((n_x, n_x)), np.zeros((n_x, len(actuators)))
    wide[:n, :n], into[:n] = a, b
    for i, j in enumerate(slow):
        wide[:n, n + i], into[:n, j] = b[:, j], 0.0
        wide[n + i, n + i], into[n + i, j] = -1.0 / lags[j], 1.0 / lags[j]
    return _Model(wide, into, n, delays, lags, sample_time)


def _matrices(
    model: _Model, loop: Loop, sensors: Sequence[Sensor], aware: bool, recalibrated: bool
) -> tuple[np.ndarray, ...]:
    """A, B, C, D, E of the `DigitalController`: states X̂, then the commands still on their way, newest first."""
    n_x, n, n_y, n_u = len(model.a), model.n, len(sensors), model.b.shape[1]
    late = model.late
    starts = n_x + np.r_[0, np.cumsum(late)[:-1]].astype(int)
    size = n_x + int(late.sum())
    estimator = loop.controller.estimator
    if estimator is None:
        raise DesignError("the controller does not name its estimator; make it by luenberger, kalman or filtered")
    filters = loop.controller.state.size == 0
    turned = _as_read(loop, sensors, 0.5 * model.sample_time if aware and not filters else 0.0, aware, recalibrated)
    a, b, e = np.zeros((size, size)), np.zeros((size, n_y)), np.zeros((size, n_u))
    # what is known of X at a sample: the states themselves, or those of the filter by the readings
    known, by_reading = np.eye(n_x, size), np.zeros((n_x, n_y))
    moving = model.a.copy()
    if filters:
        known[:n] = 0.0
        by_reading[:n] = turned
    else:
        moving[:n, :n] -= estimator @ turned
        correction = np.zeros((n_x, n_y))
        correction[:n] = estimator
        b[:n_x] = _held(moving, correction, model.sample_time).reshape(n_x, n_y)
    step, added = model.moved(moving, model.sample_time)
    a[:n_x, :n_x] = step
    if filters:
        a[:n] = 0.0
    for j, by_age in enumerate(added):
        for age, share in by_age.items():
            column = share.copy()
            if filters:
                column[:n] = 0.0
            if age == 0:
                e[:n_x, j] += column
            else:
                a[:n_x, starts[j] + age - 1] += column
        for k in range(late[j]):
            if k == 0:
                e[starts[j], j] = 1.0
            else:
                a[starts[j] + k, starts[j] + k - 1] = 1.0
    wanted = _wanted(model, loop)
    if isinstance(loop.law, OnOffLaw):
        horizon = float(model.delays.max()) + 0.5 * model.sample_time if aware else 0.0
        ahead, _ = _ahead(model, horizon, size, starts, known, n_u)
        return a, b, wanted @ ahead, wanted @ expm(model.a * horizon) @ by_reading, e
    rows, direct, now = np.zeros((n_u, size)), np.zeros((n_u, n_y)), np.zeros((n_u, n_u))
    for j in range(n_u):
        horizon = model.delays[j] + 0.5 * model.sample_time if aware else 0.0
        ahead, by_now = _ahead(model, horizon, size, starts, known, n_u)
        rows[j] = wanted[j] @ ahead
        direct[j] = wanted[j] @ expm(model.a * horizon) @ by_reading
        now[j] = wanted[j] @ by_now
    closed = np.linalg.inv(np.eye(n_u) - now)  # the command to be sent acts within its own horizon
    return a, b, closed @ rows, closed @ direct, e


def _ahead(
    model: _Model, horizon: float, size: int, starts: np.ndarray, known: np.ndarray, n_u: int
) -> tuple[np.ndarray, np.ndarray]:
    """X̂ at a horizon after the sample, by states (n_x, size), and by the commands to be sent (n_x, n_actuators)."""
    step, added = model.moved(model.a, horizon) if horizon > 0 else (np.eye(len(model.a)), [{} for _ in range(n_u)])
    rows, now = step @ known, np.zeros((len(model.a), n_u))
    for j, by_age in enumerate(added):
        for age, share in by_age.items():
            if age == 0:
                now[:, j] += share
            else:
                rows[:, starts[j] + age - 1] += share
    return rows, now


def _wanted(model: _Model, loop: Loop) -> np.ndarray:
    """v = wanted X: -K x with lags inverted; for on-off control s = q' + λ q of each relay."""
    n, law = model.n, loop.law
    if isinstance(law, OnOffLaw):
        half = n // 2
        rows = np.zeros((len(law.relays), len(model.a)))
        rows[:, :half], rows[:, half:n] = np.diag([r.slope for r in law.relays]), np.eye(half)
        return rows
    gain = np.zeros((law.gain.shape[0], len(model.a)))
    gain[:, :n] = law.gain
    wanted: Floats = -(gain + model.lags[:, None] * (gain @ model.a))
    return wanted


def _as_read(loop: Loop, sensors: Sequence[Sensor], held: float, aware: bool, recalibrated: bool) -> np.ndarray:
    """What the sensors read of x, (n_channels, n), late and slow ones as they are at each mode's frequency.

    For a filter its estimator (n, n_channels), turned back by what each channel is late.
    """
    _, _, c = observed_plant(loop.modes, loop.controller.law, loop.controller.sensors)
    omega = loop.modes.omega[list(loop.law.controlled)]
    n = omega.size
    delays = np.array([s.delay if recalibrated else 0.0 for s in sensors]) + held
    lags = np.array([s.time_constant if recalibrated else 0.0 for s in sensors])
    h = np.exp(-1j * np.outer(delays, omega)) / (1.0 + 1j * np.outer(lags, omega))
    if loop.controller.state.size == 0:
        estimator = np.array(loop.controller.estimator)
        back = 1.0 / h.T  # (n, n_channels)
        q, v = estimator[:n], estimator[n:]
        # a reading y of q alone stands for q; its part in quadrature belongs to q' / ω, and that of q' to -ω q
        safe = np.maximum(omega, 1e-12)[:, None]
        orders = np.array([MEASURED[s.quantity][1] for s in sensors])
        of_q, of_v = np.where(orders == 0, q, 0.0), np.where(orders == 1, v, 0.0)
        return np.vstack([of_q * back.real + of_v * back.imag / safe, of_v * back.real - of_q * back.imag * safe])
    c_q, c_v = c[:, :n], c[:, n:]
    safe = np.where(omega > 0, omega, 1.0)
    # y = Re(H (c_q + iω c_v) (q - i q'/ω))
    return np.hstack([c_q * h.real - c_v * omega * h.imag, c_v * h.real + c_q * h.imag / safe])


def _crosstalk(sensors: Sequence[Sensor]) -> np.ndarray:
    """M of readings = M truths, among the channels that the controller reads."""
    names = [s.name for s in sensors]
    mixed = np.eye(len(sensors))
    for j, sensor in enumerate(sensors):
        for name, share in sensor.crosstalk:
            if name in names:
                mixed[j, names.index(name)] += share
    return mixed


def _friction(rig: Rig, loop: Loop, model: _Model, a: Floats, b: Floats, d: Floats) -> FrictionForward | None:
    """Commands that oppose the friction of the rig on the controlled modes."""
    found = [element for element in rig.elements if isinstance(element, CoulombFriction)]
    if not found or isinstance(loop.law, OnOffLaw):
        return None
    index = list(loop.law.controlled)
    shapes = np.array([loop.modes.phi_at(f.at)[index] for f in found])
    n, into = len(index), _into(loop)
    of_state = np.zeros((len(found), len(a)))
    of_reading = np.zeros((len(found), b.shape[1]))
    if loop.controller.state.size:
        of_state[:, n : 2 * n] = shapes
    else:
        of_reading = shapes @ np.array(loop.controller.estimator)[n:]
    push = np.linalg.pinv(into) @ shapes.T
    return FrictionForward(
        push, of_state, of_reading, np.array([f.force for f in found]), np.array([f.smoothing_speed for f in found])
    )


def _into(loop: Loop) -> np.ndarray:
    _, b, _ = observed_plant(loop.modes, loop.controller.law, loop.controller.sensors)
    return b[len(b) // 2 :]


def without(sensors: Sequence[Sensor]) -> tuple[Sensor, ...]:
    """The sensors without the faults that a step takes out: what the estimator is designed for."""
    return tuple(
        replace(s, gain=1.0, bias=0.0, drift=0.0, delay=0.0, time_constant=0.0, crosstalk=(), limit=np.inf, step=0.0)
        for s in sensors
    )
