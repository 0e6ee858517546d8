"""Motion of a real structure by the classical Runge-Kutta method in many small steps, independent of `simulate`.

Steps end where a delayed command changes, so that forces are smooth within each.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from workbench.arrays import Floats
from workbench.trials.laws import BOUC_WEN, law_force

HYSTERESIS_STEPS = 200  # of a command's change over one sample


class System(NamedTuple):
    """A structure of n modes with its m actuators and all that acts on it; SI units."""

    omega2: Floats  # (n,)
    damping: Floats  # (n,) 2 ζ ω
    gram: Floats  # (n, n) ∫ φ_r' φ_s' dx
    stretching: float
    stiffness_rate: float
    lags: Floats  # (m,) and so are the next two
    rate_limits: Floats
    biases: Floats
    at_actuators: Floats  # (m, n) shapes
    tones: Floats  # (n_tones, 3) amplitude, rad/s, phase
    at_tones: Floats  # (n_tones, n) shapes
    laws: Floats  # (n_laws, 4) code and parameters of `law_force`
    at_laws: Floats  # (n_laws, n) shapes
    drag: float
    field: Floats  # (n_points, n + 1) shapes and weights of a quadrature over the structure


class Drive(NamedTuple):
    """From commands to what the m actuators aim at, in this order; (m,) each but `mix`."""

    mix: Floats  # (m, m) share of every command in that of each actuator
    curvature: Floats  # of u + curvature u |u|
    share: Floats  # of hysteresis
    width: Floats
    gain: Floats
    dead_zone: Floats
    limit: Floats
    delays: Floats  # s


class Pieces(NamedTuple):
    """The pieces of each sample interval, within which the targets of the actuators are constant."""

    sample_time: float
    edges: Floats  # (n_pieces,) fractions of the interval at which they end, the last one 1
    steps: Floats  # (n_pieces,) number of steps in each


class State(NamedTuple):
    """The state of a system under way, changed in place."""

    y: Floats  # modal coordinates (n,) and velocities (n,), actuator lags (m,), hysteretic variables of laws (n_laws,)
    aims: Floats  # (m, n_samples)
    targets: Floats  # (m,)
    before: Floats  # (m,) forces of the actuators when the targets last changed
    begun: Floats  # (1,) the time of that, s
    earlier: Floats  # (m,) commands, and the next the hysteretic variables that follow them
    z: Floats
    work: Floats  # (5, size of y) work space


class Sums(NamedTuple):
    """Integrals over the motion: of squared forces (m,), of work by mode (n,); and the largest forces (m,)."""

    squares: Floats
    work: Floats
    peaks: Floats


@njit(cache=True)
def at_rest(system: System, n_samples: int) -> State:
    """The state of a system at rest, for a motion over so many samples."""
    m, n = system.at_actuators.shape
    size = 2 * n + m + system.laws.shape[0]
    targets, before, earlier, z = np.zeros((4, m))
    return State(
        np.zeros(size), np.zeros((m, n_samples)), targets, before, np.zeros(1), earlier, z, np.zeros((5, size))
    )


@njit(cache=True)
def _headed(target: float, before: float, rate: float, time: float) -> float:
    """The rate-limited output of an actuator, a time after the target changed, from its output before."""
    if np.isinf(rate):
        return target
    most = rate * time
    return before + min(max(target - before, -most), most)


@njit(cache=True)
def _hysteretic(z: float, change: float, width: float) -> float:
    """z after a command has changed, z' = u' - (|u'| z + u' |z|) / (2 width), in small steps of the command."""
    h = change / HYSTERESIS_STEPS
    for _ in range(HYSTERESIS_STEPS):
        k1 = _hysteretic_rate(z, h, width)
        k2 = _hysteretic_rate(z + 0.5 * k1, h, width)
        k3 = _hysteretic_rate(z + 0.5 * k2, h, width)
        k4 = _hysteretic_rate(z + k3, h, width)
        z += (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0
    return z


@njit(cache=True)
def _hysteretic_rate(z: float, change: float, width: float) -> float:
    return change - (abs(change) * z + change * abs(z)) / (2.0 * width)


@njit(cache=True)
def _rates(t: float, y: Floats, dy: Floats, system: System, state: State, held: Floats) -> None:
    """Fill dy = dy/dt under the actuators' forces and the modal forces held over the interval."""
    m, n = system.at_actuators.shape
    factor = 1.0 + system.stiffness_rate * t
    for i in range(n):
        dy[i] = y[n + i]
        dy[n + i] = -factor * system.omega2[i] * y[i] - system.damping[i] * y[n + i] + held[i]
    for j in range(m):
        force = _headed(state.targets[j], state.before[j], system.rate_limits[j], t - state.begun[0])
        if system.lags[j] > 0.0:
            dy[2 * n + j] = (force - y[2 * n + j]) / system.lags[j]
            force = y[2 * n + j]
        force += system.biases[j]
        if force != 0.0:
            for i in range(n):
                dy[n + i] += system.at_actuators[j, i] * force
    for j in range(system.tones.shape[0]):
        force = system.tones[j, 0] * np.sin(system.tones[j, 1] * t + system.tones[j, 2])
        for i in range(n):
            dy[n + i] += system.at_tones[j, i] * force
    for j in range(system.laws.shape[0]):
        law, shape = system.laws[j], system.at_laws[j]
        w = 0.0
        v = 0.0
        for i in range(n):
            w += shape[i] * y[i]
            v += shape[i] * y[n + i]
        z = y[2 * n + m + j]
        dy[2 * n + m + j] = v - (abs(v) * z + v * abs(z)) / (2.0 * law[2]) if law[0] == BOUC_WEN else 0.0
        force = law_force(int(law[0]), law[1:], w, v, z)
        for i in range(n):
            dy[n + i] += shape[i] * force
    if system.stretching > 0.0:
        pull = system.gram @ y[:n]
        tension = system.stretching * np.dot(pull, y[:n])
        for i in range(n):
            dy[n + i] -= tension * pull[i]
    if system.drag > 0.0:
        for k in range(system.field.shape[0]):
            v = 0.0
            for i in range(n):
                v += system.field[k, i] * y[n + i]
            force = -system.drag * system.field[k, n] * abs(v) * v
            for i in range(n):
                dy[n + i] += system.field[k, i] * force


@njit(cache=True)
def _aim(k: int, state: State, drive: Drive, commands: Floats) -> None:
    """Set what the actuators aim at from sample k on."""
    m = commands.size
    for j in range(m):
        u = 0.0
        for i in range(m):
            u += drive.mix[j, i] * commands[i]
        u += drive.curvature[j] * u * abs(u)
        if drive.share[j] > 0.0:
            state.z[j] = _hysteretic(state.z[j], u - state.earlier[j], drive.width[j])
            state.earlier[j] = u
            u = (1.0 - drive.share[j]) * u + drive.share[j] * state.z[j]
        u *= drive.gain[j]
        u = np.sign(u) * max(abs(u) - drive.dead_zone[j], 0.0)
        state.aims[j, k] = min(max(u, -drive.limit[j]), drive.limit[j])


@njit(cache=True)
def interval(
    k: int,
    state: State,
    system: System,
    drive: Drive,
    pieces: Pieces,
    commands: Floats,
    held: Floats,
    out: Floats,
    sums: Sums,
) -> None:
    """Step the state over the interval from sample k on, and fill `out` with the motion at the start of its pieces.

    Args:
        commands: (m,) at the sample.
        held: (n,) unmeasured modal forces.
        out: (3, n_pieces, n) displacement, velocity and acceleration.
        sums: increased by those of the interval; empty arrays to omit them.
    """
    _aim(k, state, drive, commands)
    y, targets, before = state.y, state.targets, state.before
    trial, k1, k2, k3, k4 = state.work[0], state.work[1], state.work[2], state.work[3], state.work[4]
    n, size, m = held.size, y.size, targets.size
    lags, rates, dt = system.lags, system.rate_limits, pieces.sample_time
    start = 0.0
    for piece in range(pieces.edges.size):
        end = pieces.edges[piece]
        middle = k + 0.5 * (start + end)
        now = (k + start) * dt
        for j in range(m):
            before[j] = _headed(targets[j], before[j], rates[j], now - state.begun[0])
            index = int(np.floor(middle - drive.delays[j] / dt))
            targets[j] = state.aims[j, index] if index >= 0 else 0.0
        state.begun[0] = now
        h = (end - start) * dt / pieces.steps[piece]
        for step in range(pieces.steps[piece]):
            t = (k + start) * dt + step * h
            _rates(t, y, k1, system, state, held)
            if step == 0:
                for i in range(n):
                    out[0, piece, i], out[1, piece, i], out[2, piece, i] = y[i], y[n + i], k1[n + i]
            for i in range(size):
                trial[i] = y[i] + 0.5 * h * k1[i]
            _rates(t + 0.5 * h, trial, k2, system, state, held)
            for i in range(size):
                trial[i] = y[i] + 0.5 * h * k2[i]
            _rates(t + 0.5 * h, trial, k3, system, state, held)
            for i in range(size):
                trial[i] = y[i] + h * k3[i]
            _rates(t + h, trial, k4, system, state, held)
            if sums.squares.size > 0:
                for j in range(m):
                    # by the midpoint rule
                    force = _headed(targets[j], before[j], rates[j], t + 0.5 * h - state.begun[0])
                    if lags[j] > 0.0:
                        force = y[2 * n + j] + 0.5 * h * k2[2 * n + j]
                    force += system.biases[j]
                    sums.squares[j] += h * force * force
                    sums.peaks[j] = max(sums.peaks[j], abs(force))
                    for i in range(n):
                        sums.work[i] += force * system.at_actuators[j, i] * h * (y[n + i] + 0.5 * h * k2[n + i])
            for i in range(size):
                y[i] += h * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]) / 6.0
        start = end


@njit(cache=True)
def integrate(system: System, drive: Drive, pieces: Pieces, commands: Floats, feedback: Floats, held: Floats) -> Floats:
    """Modal motion at the samples, from rest.

    Args:
        commands: (m, n_samples); the feedback is subtracted, in place.
        feedback: (m, n) gain from modal velocities to commands, at each sample.
        held: (n_samples, n) unmeasured modal forces, constant over each interval.

    Returns:
        (3, n_pieces, n_samples, n) displacement, velocity and acceleration at the start of each piece of a sample
        interval; the first is at the sample.
    """
    (m, n_samples), n = commands.shape, held.shape[1]
    state = at_rest(system, n_samples)
    none = Sums(np.zeros(0), np.zeros(0), np.zeros(0))
    out = np.zeros((3, pieces.edges.size, n_samples, n))
    for k in range(n_samples):
        for j in range(m):
            for i in range(n):
                commands[j, k] -= feedback[j, i] * state.y[n + i]
        interval(k, state, system, drive, pieces, commands[:, k], held[k], out[:, :, k], none)
    return out
