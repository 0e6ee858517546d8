"""A law and its estimator as a digital controller that compensates delays, lags and nonlinearities of the rig.

With X = (x, a) the controlled modes and the forces of lagging actuators, and v the commands that they can follow,

    X' = A X + Σ_j b_j v_j(t - τ_j),      a_j' = (v_j(t - τ_j) - a_j) / λ_j

is solved exactly between samples. The estimate at a sample is predicted ahead by each actuator's delay and half a
sample, with the delayed commands (a Smith predictor), and a lag is inverted: v = w + λ w', w = -K x. Delays and lags of
sensors enter by their readings of each mode at its frequency, H_j(iω_r) (c_q + iω_r c_v). Commands are sent through the
inverse of the actuators' cross-talk.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from workbench.arrays import Floats
from workbench.design.estimation.controller import Controller
from workbench.design.estimation.digital import (
    DigitalController,
    FrictionFeedforward,
    Relays,
    modal_states,
    zero_order_hold,
)
from workbench.design.estimation.observers import observed_plant
from workbench.design.export.sampled_loop import MOST_PAST, held, held_over, past_commands
from workbench.design.laws.law import DesignError, Law
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.rig_loop import driven, named
from workbench.rig.actuators import Actuator, mixing
from workbench.rig.elements import CoulombFriction
from workbench.rig.rig import Rig
from workbench.rig.sensors import MEASURED, Sensor
from workbench.robust.small_motion import crosstalk, lag_response, late_output
from workbench.structure.modes import Modes

STEPS = ("sensors", "delay", "dead zone", "saturation", "friction")  # compensations, in this order
MIXED_ALIKE = 1e6  # condition number of the cross-talk above which it counts as singular
SLOWEST = 4.0  # least samples per period of a controlled mode


class Loop(NamedTuple):
    """A law with its estimator on the modes that it was designed for.

    Attributes:
        modes: of the structure.
        law: linear, or on-off.
        controller: has the estimator; its own law has zero gain for on-off control.
    """

    modes: Modes
    law: Law | OnOffLaw
    controller: Controller


@dataclass(frozen=True, eq=False)
class _Model:
    """The controlled modes with lagging actuators: X' = a X + b v, v delayed by `delays`.

    Attributes:
        a, b: (n_x, n_x) and (n_x, n_actuators).
        n: number of modal states, the first of X.
        delays, lags: (n_actuators,) s.
        hold: half a sample, by which a command that is held acts late, s; 0 where delays are not compensated.
        sample_time: s.
    """

    a: np.ndarray
    b: np.ndarray
    n: int
    delays: np.ndarray
    lags: np.ndarray
    hold: float
    sample_time: float


def check_rate(modes: Modes, controlled: Sequence[int], sample_time: float) -> None:
    """Refuse a sample time that is not positive or too long for the controlled modes, and modes that the rig lacks."""
    if max(controlled) >= modes.n_modes:
        raise DesignError(
            f"the controller controls mode {max(controlled) + 1}, and the rig has {modes.n_modes} modes: design it for"
            " the modes of this rig, or give the rig more modes"
        )
    if not 0 < sample_time < np.inf:
        raise DesignError(f"sample_time must be above 0; got {sample_time:g} s")
    r = max(controlled, key=lambda i: modes.omega[i])
    per_period = 2.0 * np.pi / modes.omega[r] / sample_time if modes.omega[r] > 0 else np.inf
    if per_period < SLOWEST:
        raise DesignError(
            f"{1 / sample_time:g} samples per second are too slow for mode {r + 1} at {modes.frequencies_hz[r]:.4g} Hz:"
            f" sample at {SLOWEST * modes.frequencies_hz[r]:.4g} Hz or faster, or leave the mode out"
        )


def compensated(rig: Rig, loop: Loop, sample_time: float, steps: Sequence[str] = STEPS) -> DigitalController:
    """The digital controller of a law and its estimator on a rig, with the given compensations.

    Args:
        rig: corrected; its actuators and sensors have the names of the law's and the estimator's. Cross-talk of its
            actuators is always undone, as their gain is in the law.
        loop: designed for the rig.
        sample_time: s.
        steps: of `STEPS`; "sensors" corrects gain, offset and cross-talk, and includes delays and lags in the model.
    """
    check_rate(loop.modes, loop.law.controlled, sample_time)
    actuators = driven(rig, [a.name for a in loop.law.actuators])
    sensors = [named(rig.sensors, s.name) for s in loop.controller.sensors]
    own, forced, reads = observed_plant(loop.modes, loop.controller.law, loop.controller.sensors)
    model = _model(own, forced, actuators, sample_time, "delay" in steps)
    estimator = loop.controller.L
    if estimator is None:
        raise DesignError(
            "the controller does not name its estimator; make it by luenberger_controller, kalman_controller or"
            " filtered"
        )
    output = _output(loop, reads, sensors, model.hold, "sensors" in steps)
    a, b, c, d, e = _matrices(model, loop, estimator, output)
    gain, dead_zone = _values(actuators, "gain"), _values(actuators, "dead_zone")
    parts: dict[str, Any] = {}
    if "dead zone" in steps:
        parts |= {"dead_zone": dead_zone / np.abs(gain), "bias": _values(actuators, "bias") / gain}
        dead_zone = np.zeros(len(actuators))
    if "saturation" in steps:
        parts["limit"] = (_values(actuators, "limit") + dead_zone) / np.abs(gain)
        parts["rate"] = _values(actuators, "rate_limit") * sample_time / np.abs(gain)
    if "sensors" in steps:
        parts |= {"offset": _values(sensors, "bias"), "scale": 1.0 / _values(sensors, "gain")}
        uncoupling = np.linalg.inv(crosstalk(sensors))
        b, d, estimator = b @ uncoupling, d @ uncoupling, estimator @ uncoupling
    if isinstance(loop.law, OnOffLaw):
        relays = loop.law.relays
        parts["relays"] = Relays(loop.law.allocation, _values(relays, "force"), _values(relays, "dead_band"))
    if "friction" in steps:
        parts["friction"] = _friction(rig, loop, forced, estimator, len(a))
    if any(x.crosstalk for x in actuators):
        c, d, e, parts = _through_crosstalk(actuators, c, d, e, parts)
    names = tuple(s.name for s in sensors), tuple(x.name for x in actuators)
    parts |= {"name": loop.controller.name, "states": _states(model, loop, names[1])}
    return DigitalController(sample_time, *names, a, b, c, d, e, **parts)


def _through_crosstalk(
    actuators: Sequence[Actuator], c: Floats, d: Floats, e: Floats, parts: dict[str, Any]
) -> tuple[Floats, Floats, Floats, dict[str, Any]]:
    """C, D, E and other parts of a digital controller that sends its commands through the inverse of the cross-talk.

    Limits and dead zones stay those of each actuator's own command.
    """
    mix = mixing(actuators)
    if np.linalg.cond(mix) > MIXED_ALIKE:
        raise DesignError(
            f"the cross-talk between {', '.join(x.name for x in actuators)} makes them act alike, so it cannot be"
            " undone: control with fewer of them"
        )
    undone, parts = np.linalg.inv(mix), dict(parts)
    if "relays" in parts:
        parts["relays"] = replace(parts["relays"], allocation=undone @ parts["relays"].allocation)
    else:
        c, d = undone @ c, undone @ d
    if "bias" in parts:
        parts["bias"] = undone @ parts["bias"]
    if parts.get("friction") is not None:
        parts["friction"] = replace(parts["friction"], gain=undone @ parts["friction"].gain)
    return c, d, e @ mix, parts


def _values(parts: Sequence[object], name: str) -> np.ndarray:
    """An attribute of each part (n_parts,)."""
    return np.array([getattr(part, name) for part in parts])


def _states(model: _Model, loop: Loop, actuators: Sequence[str]) -> tuple[str, ...]:
    """The states in words: estimates of the modes, lagged commands, and delayed commands."""
    own = ["always zero"] * model.n if loop.controller.static else modal_states(loop.law.controlled)
    lagging = [f"command of {actuators[int(j)]} after its lag" for j in np.flatnonzero(model.lags)]
    past = [
        f"command of {name}, {k + 1} {'sample' if k == 0 else 'samples'} ago"
        for name, count in zip(actuators, past_commands(model.delays, model.sample_time), strict=True)
        for k in range(count)
    ]
    return (*own, *lagging, *past)


def _model(a: Floats, b: Floats, actuators: Sequence[Actuator], sample_time: float, compensate: bool) -> _Model:
    """The model of the controlled modes, with delays and lags of the actuators where these are compensated."""
    delays, lags = (compensate * _values(actuators, name) for name in ("delay", "time_constant"))
    if (delays > MOST_PAST * sample_time).any():
        latest = max(actuators, key=lambda x: x.delay)
        raise DesignError(
            f"the delay of {latest.name}, {1e3 * latest.delay:.3g} ms, is {latest.delay / sample_time:,.0f} samples at"
            f" {1 / sample_time:g} Hz, more than the {MOST_PAST} of a predictor: sample at"
            f" {MOST_PAST / latest.delay:.4g} Hz or slower"
        )
    lagging = np.flatnonzero(lags)
    n, n_x = len(a), len(a) + lagging.size
    augmented, into = np.zeros((n_x, n_x)), np.zeros((n_x, len(actuators)))
    augmented[:n, :n], into[:n] = a, b
    for i, j in enumerate(lagging):
        augmented[:n, n + i], into[:n, j] = b[:, j], 0.0
        augmented[n + i, n + i], into[n + i, j] = -1.0 / lags[j], 1.0 / lags[j]
    return _Model(augmented, into, n, delays, lags, 0.5 * sample_time if compensate else 0.0, sample_time)


def _matrices(model: _Model, loop: Loop, estimator: Floats, output: Floats) -> tuple[np.ndarray, ...]:
    """A, B, C, D, E of the `DigitalController`: states X̂, then the delayed commands, newest first."""
    static, n, (n_x, n_u), n_y = loop.controller.static, model.n, model.b.shape, estimator.shape[1]
    observer = model.a.copy()
    if not static:
        observer[:n, :n] -= estimator @ output
    a, e = held(observer, model.b, model.sample_time, model.delays)
    size = len(a)
    b = np.zeros((size, n_y))
    # X at a sample from the states, and of a modal filter from the readings
    by_state, by_reading = np.eye(n_x, size), np.zeros((n_x, n_y))
    if static:
        by_state[:n], by_reading[:n] = 0.0, output
        a[:n], e[:n] = 0.0, 0.0
    else:
        correction = np.vstack([estimator, np.zeros((n_x - n, n_y))])
        b[:n_x] = zero_order_hold(observer, correction, model.sample_time)[1]

    def predicted(horizon: float) -> tuple[Floats, Floats, Floats]:
        """X̂ at a horizon from X̂ now (n_x, n_x), from the states, and from the commands to be sent."""
        step, past, now = held_over(model.a, model.b, model.sample_time, model.delays, horizon)
        rows = step @ by_state
        rows[:, n_x:] += past
        return step, rows, now

    feedback = _feedback(model, loop)
    if isinstance(loop.law, OnOffLaw):
        step, rows, _ = predicted(float(model.delays.max()) + model.hold)
        return a, b, feedback @ rows, feedback @ step @ by_reading, e
    c, d, algebraic = np.zeros((n_u, size)), np.zeros((n_u, n_y)), np.eye(n_u)
    for j, k in enumerate(feedback):
        step, rows, now = predicted(model.delays[j] + model.hold)
        c[j], d[j] = k @ rows, k @ step @ by_reading
        algebraic[j] -= k @ now  # the command to be sent acts within the horizon that it depends on
    inverse = np.linalg.inv(algebraic)
    return a, b, inverse @ c, inverse @ d, e


def _feedback(model: _Model, loop: Loop) -> np.ndarray:
    """G of v = G X: -K x with lags inverted; for on-off control s = q' + λ q of each relay."""
    n, law = model.n, loop.law
    if isinstance(law, OnOffLaw):
        half = n // 2
        rows = np.zeros((len(law.relays), len(model.a)))
        rows[:, :half], rows[:, half:n] = np.diag([r.slope for r in law.relays]), np.eye(half)
        return rows
    gain = np.pad(law.gain, ((0, 0), (0, len(model.a) - n)))
    return np.asarray(-(gain + model.lags[:, None] * (gain @ model.a)))


def _output(loop: Loop, reads: Floats, sensors: Sequence[Sensor], hold: float, recalibrated: bool) -> Floats:
    """C (n_channels, n) from x to the readings, with delays and lags of the sensors at each mode's frequency.

    For a modal filter its estimator (n, n_channels) with the inverse of delays and lags at each mode's frequency.

    Args:
        loop, sensors: of the rig.
        reads: C of the faultless sensors.
        hold: delay of the command by its hold, s, which an observer models as one of the sensors.
        recalibrated: whether delays and lags of the sensors are compensated.
    """
    omega = loop.modes.omega[list(loop.law.controlled)]
    delays, lags = (recalibrated * _values(sensors, name) for name in ("delay", "time_constant"))
    if not loop.controller.static:
        return late_output(reads, omega, delays + hold, lags)
    q, v = np.split(np.array(loop.controller.L), 2)
    inverse = 1.0 / lag_response(omega, delays, lags).T  # (n, n_channels)
    # the part in quadrature of a displacement adds to q' / ω, and that of a velocity to -ω q
    safe = np.maximum(omega, 1e-12)[:, None]
    orders = np.array([MEASURED[s.quantity][1] for s in sensors])
    of_q, of_v = np.where(orders == 0, q, 0.0), np.where(orders == 1, v, 0.0)
    re, im = inverse.real, inverse.imag
    return np.vstack([of_q * re + of_v * im / safe, of_v * re - of_q * im * safe])


def _friction(rig: Rig, loop: Loop, forced: Floats, estimator: Floats, n_states: int) -> FrictionFeedforward | None:
    """Feed-forward commands that cancel the rig's Coulomb friction in the controlled modes; None without friction.

    Args:
        rig, loop: as of `compensated`.
        forced: B of the controlled modes.
        estimator: from readings without cross-talk where that is compensated.
        n_states: of the digital controller.
    """
    frictions = [element for element in rig.elements if isinstance(element, CoulombFriction)]
    if not frictions or isinstance(loop.law, OnOffLaw):
        return None
    index = list(loop.law.controlled)
    n, shapes = len(index), np.array([loop.modes.phi_at(f.at)[index] for f in frictions])
    of_state, of_reading = np.zeros((len(frictions), n_states)), np.zeros((len(frictions), estimator.shape[1]))
    if loop.controller.static:
        of_reading = shapes @ estimator[n:]
    else:
        of_state[:, n : 2 * n] = shapes
    gain = np.linalg.pinv(forced[n:]) @ shapes.T
    force, smoothing = (_values(frictions, name) for name in ("force", "smoothing_speed"))
    return FrictionFeedforward(gain, of_state, of_reading, force, smoothing)


def without_faults(sensors: Sequence[Sensor]) -> tuple[Sensor, ...]:
    """The sensors with unit gain and no other fault but noise, for the design of an estimator."""
    return tuple(
        replace(s, gain=1.0, bias=0.0, drift=0.0, delay=0.0, time_constant=0.0, crosstalk=(), limit=np.inf, step=0.0)
        for s in sensors
    )
