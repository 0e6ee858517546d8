"""Modes with actuators and sensors as python-control's `StateSpace`."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import control
import numpy as np

from workbench.arrays import Floats
from workbench.rig.actuators import Actuator, mixing
from workbench.rig.rig import Transducer, shape_of, transducer_text
from workbench.rig.sensors import MEASURED, Sensor, crosstalk_between
from workbench.structure.modes import Modes
from workbench.structure.printed import joined_in_words

NONLINEAR = {
    "dead_zone": "a dead zone",
    "limit": "a limit",
    "rate_limit": "a rate limit",
    "hysteresis_share": "hysteresis",
    "bias": "a bias",
    "drift": "a drift",
    "step": "rounding",
}
DELAY_ORDER = 0.7  # order of a delay line per radian of the fastest mode within the delay


def input_matrix(modes: Modes, actuators: Sequence[Actuator]) -> np.ndarray:
    """Modal forces per unit command (n_modes, n_actuators): gain times φ_r at the place, or its slope for a moment.

    An actuator on a support, where it does no work, or with cross-talk, which no design includes, is refused.
    """
    leaking = next((actuator for actuator in actuators if actuator.crosstalk), None)
    if leaking is not None:
        raise ValueError(
            f"actuator {leaking.name} takes a share of the command of {leaking.crosstalk[0][0]}, and a design has no"
            " cross-talk of actuators: leave it out; wb.redesign then undoes it on the commands"
        )
    return _input_matrix(modes, actuators)


def _input_matrix(modes: Modes, actuators: Sequence[Actuator]) -> Floats:
    """The same without cross-talk."""
    columns = []
    for actuator in actuators:
        shape = shape_of(modes, actuator)
        if modes.is_held(actuator.at, int(actuator.quantity == "moment"), direction=actuator.direction):
            raise ValueError(
                f"actuator {actuator.name} is on the support at {modes.domain.text(actuator.at)}, where it moves"
                " no mode; move it inside"
            )
        columns.append(actuator.gain * shape)
    return np.array(columns).reshape(len(columns), modes.n_modes).T


def output_matrix(modes: Modes, sensors: Sequence[Sensor]) -> np.ndarray:
    """Mode shapes (or their slopes) at the sensors, times gain: (n_sensors, n_modes)."""
    rows = [sensor.gain * shape_of(modes, sensor) for sensor in sensors]
    return np.array(rows).reshape(len(rows), modes.n_modes)


def state_space(modes: Modes, actuators: Sequence[Actuator], sensors: Sequence[Sensor]) -> control.StateSpace:
    """The linear model from commands to sensor outputs, states (q_1..q_n, q_1'..q_n'), named signals.

    x' = [0 I; -Ω² -C] x + [0; B] u, and y a displacement, slope, velocity, angular velocity or acceleration. For an
    acceleration D is not zero. Cross-talk is included. Lags of actuators, then of sensors, add one state each after the
    modal ones.

    Raises:
        ValueError: an actuator or sensor that is not linear (dead zone, limit, bias, rounding) or has a delay, and
            cross-talk from a sensor or an actuator that is not among these.
    """
    parts: tuple[Transducer, ...] = (*actuators, *sensors)
    for part in (part for part in parts if not part.has_state_space):
        channel = transducer_text(part)
        if replace(part, delay=0.0).has_state_space:
            raise ValueError(
                f"{channel} has a delay, which no finite StateSpace represents exactly; leave it out and connect an"
                " approximation by control.pade in series, or simulate the rig"
            )
        nonlinear = [what for name, what in NONLINEAR.items() if getattr(part, name, 0.0) not in (0.0, np.inf)]
        raise ValueError(
            f"{channel} has {joined_in_words(nonlinear)}, so it is not linear and the rig has no StateSpace; simulate"
            " it instead"
        )
    a, b, c, d, states = modal_plant(modes, actuators, sensors, with_crosstalk=True)
    n = len(sensors)
    names = {"inputs": signal_names(x.name for x in actuators), "outputs": signal_names(y.name for y in sensors)}
    return control.ss(a, b, c[:n], d[:n], states=signal_names(states), name="rig", **names)


def modal_plant(
    modes: Modes, actuators: Sequence[Actuator], sensors: Sequence[Sensor], *, with_crosstalk: bool = False
) -> tuple[Floats, Floats, Floats, Floats, list[str]]:
    """A, B, C, D and the names of the states, from commands to readings and to the delayed and lagged commands.

    Lags and delays are included, a delay as of `delay_line`; nonlinear imperfections are not, and cross-talk where it
    is asked for: without, that of an actuator raises a `ValueError`. The last n_actuators rows of C and D give the
    delayed and lagged commands, before the gains.
    """
    n, m = modes.n_modes, len(actuators)
    force = _input_matrix(modes, actuators) if with_crosstalk else input_matrix(modes, actuators)
    a, b = modes.state_matrix, np.vstack([np.zeros_like(force), force])

    def read(sensors: Sequence[Sensor]) -> tuple[Floats, Floats]:
        """C and D of the sensors without cross-talk, lags and delays."""
        c, d = np.zeros((len(sensors), 2 * n)), np.zeros((len(sensors), m))
        for j, (sensor, shape) in enumerate(zip(sensors, output_matrix(modes, sensors), strict=True)):
            order = MEASURED[sensor.quantity][1]
            if order < 2:
                c[j, order * n : (order + 1) * n] = shape
            else:
                c[j], d[j] = shape @ a[n:], shape @ force
        return c, d

    c, d = read(sensors)
    if with_crosstalk and any(sensor.crosstalk for sensor in sensors):
        share = np.zeros((len(sensors), len(sensors)))
        for j, i, taken in crosstalk_between(sensors):
            share[j, i] += sensors[j].gain * taken
        more = read([replace(sensor, gain=1.0) for sensor in sensors])
        c, d = c + share @ more[0], d + share @ more[1]
    c, d = np.vstack([c, np.zeros((m, 2 * n))]), np.vstack([d, np.eye(m)])
    states = [f"q{r + 1}" for r in range(n)] + [f"dq{r + 1}" for r in range(n)]
    transducers: list[tuple[int, Transducer]] = [*enumerate(actuators), *enumerate(sensors)]
    for j, part in transducers:
        for what, (pa, pb, pc) in lateness(part, modes):
            size = len(pa)
            if isinstance(part, Actuator):
                a = np.block([[a, b[:, [j]] * pc], [np.zeros((size, len(a))), pa]])
                b, c = np.vstack([b, np.zeros((size, m))]), np.hstack([c, d[:, [j]] * pc])
                b[:, j], d[:, j] = np.r_[np.zeros(len(a) - size), pb], 0.0
            else:
                a = np.block([[a, np.zeros((len(a), size))], [np.outer(pb, c[j]), pa]])
                b, c = np.vstack([b, np.outer(pb, d[j])]), np.hstack([c, np.zeros((len(c), size))])
                c[j], d[j] = np.r_[np.zeros(len(a) - size), pc], 0.0
            states += [f"{part.name}_{what}{i + 1 if size > 1 else ''}" for i in range(size)]
    if any(actuator.crosstalk for actuator in actuators):
        b, d = b @ mixing(actuators), d @ mixing(actuators)
    return a, b, c, d, states


Late = tuple[Floats, Floats, Floats]


def lateness(part: Transducer, modes: Modes) -> list[tuple[str, Late]]:
    """The delay and the lag of an actuator or a sensor as linear systems: ("delay" or "lag", (A, b, c)) of each."""
    systems: list[tuple[str, Late]] = []
    if part.delay > 0:
        systems.append(("delay", delay_line(part.delay, float(modes.omega.max()))))
    if part.time_constant > 0:
        rate = np.array([1.0 / part.time_constant])
        systems.append(("lag", (-rate[:, None], rate, np.ones(1))))
    return systems


def delay_line(delay: float, fastest: float) -> Late:
    """A delay as a linear system (A, b, c), accurate to a millionth up to the fastest frequency, rad/s.

    The Padé approximation of order [N-1/N] in Legendre polynomials, which stay well conditioned (Voelker, Kajić &
    Eliasmith, NeurIPS 32 (2019)).
    """
    order = 6 + int(np.ceil(DELAY_ORDER * delay * fastest))
    i: Floats = np.arange(order, dtype=float)
    odd, sign = (2.0 * i + 1.0) / delay, (-1.0) ** i
    a = -odd[:, None] * np.where(i[:, None] < i, 1.0, np.outer(sign, sign))
    return np.asarray(a), odd * sign, np.ones(order)


def signal_names(names: Iterable[str]) -> list[str]:
    """Names of signals as python-control allows them: a full stop, reserved for subsystems, becomes an underscore."""
    return [name.replace(".", "_") for name in names]
