"""Motion of a real structure by the classical Runge-Kutta method in many small steps, independent of `simulate`.

Steps end where a delayed command changes, so that forces are smooth within each. The state consists of modal
coordinates and velocities, actuator lags, and hysteretic variables of laws at points.
"""

import numpy as np
from numba import njit

from workbench.arrays import Floats
from workbench.trials.laws import BOUC_WEN, law_force

HYSTERESIS_STEPS = 200  # of a command's change over one sample

# As `integrate` describes it: structure, actuators, tones, laws, air drag.
System = tuple[
    tuple[Floats, Floats, Floats, float, float],
    tuple[Floats, Floats, Floats, Floats],
    tuple[Floats, Floats],
    tuple[Floats, Floats],
    tuple[float, Floats],
]


@njit(cache=True)
def headed(target: float, before: float, rate: float, time: float) -> float:
    """The rate-limited output of an actuator, a time after the target changed, from its output before."""
    if np.isinf(rate):
        return target
    most = rate * time
    return before + min(max(target - before, -most), most)


@njit(cache=True)
def hysteretic(z: float, change: float, width: float) -> float:
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
def _rates(t: float, y: Floats, dy: Floats, system: System, drive: tuple[Floats, Floats, float], held: Floats) -> None:
    """Fill dy = dy/dt under the actuator forces and the modal forces held over the interval.

    drive: targets (m,) of the actuators, their outputs at the last change of target (m,), and the time of that, s.
    """
    structure, (lags, shapes, rates, biases), (tones, tone_shapes), (laws, law_shapes), (drag, field) = system
    targets, before, begun = drive
    omega2, damping, gram, stretching, rate = structure
    m, n = shapes.shape
    factor = 1.0 + rate * t
    for i in range(n):
        dy[i] = y[n + i]
        dy[n + i] = -factor * omega2[i] * y[i] - damping[i] * y[n + i] + held[i]
    for j in range(m):
        force = headed(targets[j], before[j], rates[j], t - begun)
        if lags[j] > 0.0:
            dy[2 * n + j] = (force - y[2 * n + j]) / lags[j]
            force = y[2 * n + j]
        force += biases[j]
        if force != 0.0:
            for i in range(n):
                dy[n + i] += shapes[j, i] * force
    for j in range(tones.shape[0]):
        force = tones[j, 0] * np.sin(tones[j, 1] * t + tones[j, 2])
        for i in range(n):
            dy[n + i] += tone_shapes[j, i] * force
    for j in range(laws.shape[0]):
        w = 0.0
        v = 0.0
        for i in range(n):
            w += law_shapes[j, i] * y[i]
            v += law_shapes[j, i] * y[n + i]
        z = y[2 * n + m + j]
        dy[2 * n + m + j] = v - (abs(v) * z + v * abs(z)) / (2.0 * laws[j, 2]) if laws[j, 0] == BOUC_WEN else 0.0
        force = law_force(int(laws[j, 0]), laws[j, 1:], w, v, z)
        for i in range(n):
            dy[n + i] += law_shapes[j, i] * force
    if stretching > 0.0:
        pull = gram @ y[:n]
        tension = stretching * np.dot(pull, y[:n])
        for i in range(n):
            dy[n + i] -= tension * pull[i]
    if drag > 0.0:
        for k in range(field.shape[0]):
            v = 0.0
            for i in range(n):
                v += field[k, i] * y[n + i]
            force = -drag * field[k, n] * abs(v) * v
            for i in range(n):
                dy[n + i] += field[k, i] * force


@njit(cache=True)
def aim(commands: Floats, drive: tuple[Floats, Floats], earlier: Floats, z: Floats, aims: Floats) -> None:
    """Fill `aims` (m,), the actuators' targets for the commands (m,) of a sample; earlier, z: state of hysteresis."""
    mix, table = drive
    m = commands.size
    for j in range(m):
        u = 0.0
        for i in range(m):
            u += mix[j, i] * commands[i]
        u += table[j, 4] * u * abs(u)
        if table[j, 5] > 0.0:
            z[j] = hysteretic(z[j], u - earlier[j], table[j, 6])
            earlier[j] = u
            u = (1.0 - table[j, 5]) * u + table[j, 5] * z[j]
        u *= table[j, 0]
        u = np.sign(u) * max(abs(u) - table[j, 1], 0.0)
        aims[j] = min(max(u, -table[j, 2]), table[j, 2])


@njit(cache=True)
def interval(
    k: int,
    y: Floats,
    system: System,
    delays: Floats,
    aims: Floats,
    headed_for: tuple[Floats, Floats, Floats],
    held: Floats,
    dt: float,
    edges: Floats,
    steps: Floats,
    work: Floats,
    out: Floats,
    forces: tuple[Floats, Floats, Floats, Floats],
) -> None:
    """Step y over a sample interval, and fill `out` with the motion at the start of each of its pieces.

    Args:
        k: the sample.
        y: (size,) state, in place.
        system: see `integrate`.
        delays: (m,) s.
        aims: (m, n_samples) targets of the actuators, by sample.
        headed_for: targets (m,), forces before them (m,), and the time of the last change (1,), in place.
        held: (n,) unmeasured modal forces.
        dt: sample time, s.
        edges, steps: see `integrate`.
        work: (5, size) work space.
        out: (3, n_edges, n) displacement, velocity and acceleration at the start of each piece.
        forces: integrals of the actuators' forces (m,), of their squares (m,), of their work by mode (n,), and the
            largest force (m,), in place; empty arrays to omit them.
    """
    targets, before, begun = headed_for
    trial, k1, k2, k3, k4 = work[0], work[1], work[2], work[3], work[4]
    n, size, m = held.size, y.size, targets.size
    lags, shapes, rates, biases = system[1]
    start = 0.0
    for piece in range(edges.size):
        middle = k + 0.5 * (start + edges[piece])
        now = (k + start) * dt
        for j in range(m):
            before[j] = headed(targets[j], before[j], rates[j], now - begun[0])
            index = int(np.floor(middle - delays[j] / dt))
            targets[j] = aims[j, index] if index >= 0 else 0.0
        begun[0] = now
        h = (edges[piece] - start) * dt / steps[piece]
        for step in range(steps[piece]):
            t = (k + start) * dt + step * h
            _rates(t, y, k1, system, (targets, before, begun[0]), held)
            if step == 0:
                for i in range(n):
                    out[0, piece, i], out[1, piece, i], out[2, piece, i] = y[i], y[n + i], k1[n + i]
            for i in range(size):
                trial[i] = y[i] + 0.5 * h * k1[i]
            _rates(t + 0.5 * h, trial, k2, system, (targets, before, begun[0]), held)
            for i in range(size):
                trial[i] = y[i] + 0.5 * h * k2[i]
            _rates(t + 0.5 * h, trial, k3, system, (targets, before, begun[0]), held)
            for i in range(size):
                trial[i] = y[i] + h * k3[i]
            _rates(t + h, trial, k4, system, (targets, before, begun[0]), held)
            if forces[0].size > 0:
                for j in range(m):
                    # by the midpoint rule
                    force = headed(targets[j], before[j], rates[j], t + 0.5 * h - begun[0])
                    if lags[j] > 0.0:
                        force = y[2 * n + j] + 0.5 * h * k2[2 * n + j]
                    force += biases[j]
                    forces[0][j] += h * force
                    forces[1][j] += h * force * force
                    forces[3][j] = max(forces[3][j], abs(force))
                    for i in range(n):
                        forces[2][i] += force * shapes[j, i] * h * (y[n + i] + 0.5 * h * k2[n + i])
            for i in range(size):
                y[i] += h * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]) / 6.0
        start = edges[piece]


@njit(cache=True)
def integrate(
    system: System,
    drive: tuple[Floats, Floats],
    commands: Floats,
    feedback: Floats,
    held: Floats,
    sample_time: float,
    edges: Floats,
    steps: Floats,
) -> Floats:
    """Modal motion at the samples, from rest.

    Args:
        system: the structure (omega2 (n,), damping (n,), gram (n, n), stretching, stiffness rate); the actuators
            (lags (m,), shapes (m, n), rate limits (m,), biases (m,)); tones (n_tones, 3) of amplitude, rad/s, phase,
            and shapes; laws (n_laws, 4) of code and parameters, and shapes; air drag: coefficient, and shapes and
            weights (n_points, n + 1).
        drive: mix (m, m), the share of every command in that of each actuator, and a table (m, 7): gain, dead zone,
            limit, delay, curvature (u + curvature u |u| of the command, before the gain), share and width of
            hysteresis.
        commands: (m, n_samples); the feedback is subtracted, in place.
        feedback: (m, n) gain from modal velocities to commands, at each sample.
        held: (n_samples, n) unmeasured modal forces, constant over each interval.
        sample_time: s.
        edges: fractions of a sample interval at which its pieces end, the last one 1.
        steps: number of steps in each piece.

    Returns:
        (3, n_edges, n_samples, n) displacement, velocity and acceleration at the start of each piece of a sample
        interval; the first is at the sample.
    """
    dt = sample_time
    m, n_samples = commands.shape
    n = held.shape[1]
    size = 2 * n + m + system[3][0].shape[0]
    y, work = np.zeros(size), np.zeros((5, size))
    out = np.zeros((3, edges.size, n_samples, n))
    aims = np.zeros((m, n_samples))
    now, earlier, z = np.zeros(m), np.zeros(m), np.zeros(m)
    headed_for, none = (np.zeros(m), np.zeros(m), np.zeros(1)), (np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))
    for k in range(n_samples):
        for j in range(m):
            for i in range(n):
                commands[j, k] -= feedback[j, i] * y[n + i]
        aim(commands[:, k], drive, earlier, z, now)
        for j in range(m):
            aims[j, k] = now[j]
        interval(k, y, system, drive[1][:, 3], aims, headed_for, held[k], dt, edges, steps, work, out[:, :, k], none)
    return out
