"""Time stepping of a rig under a digital controller: readings, commands and motion, sample by sample.

The structure is stepped as in `workbench.rig.stepping`; actuators and sensors are modelled as in `simulate`.
"""

import math

import numpy as np
from numba import njit

from workbench.arrays import Floats
from workbench.design.estimation.digital import ONSET
from workbench.rig.force_laws import yield_update
from workbench.rig.lanes import LANES, row_times
from workbench.rig.stepping import Elements, Structure, advance, at_rest, drifted_propagators

ControllerArrays = tuple[tuple[Floats, ...], ...]  # described in `_commands`

RUN_AWAY = 1e100  # modal displacement, in any unit, above which the loop has diverged


@njit(cache=True, nogil=True)
def _static_force(u: float, drive: Floats, j: int, z: Floats, before: Floats) -> float:
    """The static force of actuator j for a command u: hysteresis (state z), gain, dead zone, saturation."""
    if drive[j, 7] > 0.0:
        z[j], _ = yield_update(z[j], u - before[j], drive[j, 8])
        before[j] = u
        u = (1.0 - drive[j, 7]) * u + drive[j, 7] * z[j]
    f = drive[j, 0] * u
    f = math.copysign(max(abs(f) - drive[j, 1], 0.0), f)
    limit: float = drive[j, 2]
    return min(max(f, -limit), limit)


@njit(cache=True, nogil=True)
def _row(of_state: Floats, of_reading: Floats, i: int, z: Floats, y: Floats) -> float:
    """Row i of C z + D y."""
    s = 0.0
    for m in range(z.size):
        s += of_state[i, m] * z[m]
    for m in range(y.size):
        s += of_reading[i, m] * y[m]
    return s


@njit(cache=True, nogil=True)
def _commands(
    controller: ControllerArrays, k: int, reading: Floats, z: Floats, z_next: Floats, v: Floats, command: Floats
) -> None:
    """One step of a `DigitalController` at sample k: fill its commands, v and next state z."""
    (a, b, c, d, e), (offset, scale, limit, rate, dead_zone, bias), relays, friction = controller
    allocation, on_force, dead_band = relays
    friction_gain, c_speed, d_speed, friction_force, smoothing = friction
    nu = limit.size
    y = scale * (reading - offset)
    w = np.zeros(nu)
    for i in range(c.shape[0]):
        s = _row(c, d, i, z, y)
        if on_force.size > 0:
            if abs(s) > dead_band[i]:
                for j in range(nu):
                    w[j] -= allocation[j, i] * math.copysign(on_force[i], s)
        else:
            w[i] = s
    for i in range(friction_force.size):
        speed = _row(c_speed, d_speed, i, z, y)
        for j in range(nu):
            w[j] += friction_gain[j, i] * friction_force[i] * math.tanh(speed / smoothing[i])
    for j in range(nu):
        held = min(max(w[j], -limit[j]), limit[j])
        held = min(max(held, v[j] - rate[j]), v[j] + rate[j])
        v[j] = held
        onset = min(max(held / (ONSET * dead_zone[j]), -1.0), 1.0) if dead_zone[j] > 0.0 else 0.0
        command[j, k] = held + dead_zone[j] * onset - bias[j]
    for i in range(z.size):
        z_next[i] = _row(a, b, i, z, y)
        for m in range(nu):
            z_next[i] += e[i, m] * v[m]
    for i in range(z.size):
        z[i] = z_next[i]


@njit(cache=True, nogil=True)
def loop_record(
    structure: Structure,
    elements: Elements,
    drive: Floats,
    mix: Floats,
    participation: Floats,
    sense: Floats,
    seen: Floats,
    noise: Floats,
    controller: ControllerArrays,
    start: Floats,
    disturbance: Floats,
    at: Floats,
    dt: float,
    n_sub: int,
    out: tuple[Floats, ...],
) -> bool:
    """Fill the motion of a closed loop from an initial state; False where it diverges.

    Args:
        structure, elements: see `structure_arrays` and `law_arrays`.
        drive: (n_actuators, 9) gain, dead zone, limit, delay, time constant, bias, rate limit, share and width of
            hysteresis.
        mix: (n_actuators, n_actuators) command that each actuator takes per command sent, its cross-talk; (0, 0) for
            none.
        participation: (n, n_actuators) modal forces per force.
        sense: (n_sensors, 7) gain, bias, drift per sample, delay, time constant, limit, step.
        seen: (2, n_sensors, n) output matrices of displacements and of velocities, with cross-talk.
        noise: (n_sensors, n_samples).
        controller: see `_commands`.
        start: (2, n) displacements and rates.
        disturbance: (n_forces, n_samples) held over each sample; at: (n, n_forces).
        dt: s; n_sub: substeps per sample.
        out: displacements and rates (n, n_samples), forces and commands (n_actuators, n_samples), and displacement,
            rate and force of each element (n_elements, n_samples).
    """
    omega, damping, coupling, stiffening, stretch, stretching, drag_shapes, drag_weights = structure
    kinds, shapes, _ = elements
    q_out, v_out, f_out, u_out, ew, ev, ef = out
    n_modes, n_el, nu, ny = participation.shape[0], kinds.size, drive.shape[0], sense.shape[0]
    n_samples, h = noise.shape[1], dt / n_sub
    n_dis = disturbance.shape[0]
    linear, finely, drives, motion, points, work, kept = at_rest(LANES * (omega.size // LANES), n_el)
    (modal, _, none, _), (q, v, _), (point, _, w_old, _) = drives, motion, points
    for r in range(n_modes):
        q[r], v[r] = start[0, r], start[1, r]
    along = stretch, stretching, drag_shapes, drag_weights, np.empty(drag_weights.size), coupling
    fine = n_samples * n_sub
    held = np.zeros((nu, fine))
    target, ramp, acting, hyst, before = np.zeros(nu), np.zeros(nu), np.zeros(nu), np.zeros(nu), np.zeros(nu)
    truth, unlagged, reading = np.zeros((ny, fine + 1)), np.zeros(ny), np.zeros(ny)  # truth: after the sensor's lag
    nz = controller[0][0].shape[0]
    z, z_next, followed = np.zeros(nz), np.zeros(nz), np.zeros(nu)
    for j in range(ny):
        for r in range(n_modes):
            truth[j, 0] += seen[0, j, r] * q[r] + seen[1, j, r] * v[r]
        unlagged[j] = truth[j, 0]
    for i in range(n_el):
        w_old[i] = row_times(shapes, i, q)
    for k in range(n_samples):
        if k == 0 or stiffening != 0.0:
            drifted_propagators(omega, damping, h, 1.0 + stiffening * (k + 0.5) * dt, elements, linear, finely)
        # --- read
        for j in range(ny):
            y = truth[j, k * n_sub]
            if sense[j, 3] > 0.0:
                back = k * n_sub - sense[j, 3] / h
                whole = math.floor(back)
                part = back - whole
                y = (1.0 - part) * truth[j, whole] + part * truth[j, whole + 1] if whole >= 0 else 0.0
            y = sense[j, 0] * y + sense[j, 1] + sense[j, 2] * k + noise[j, k]
            y = min(max(y, -sense[j, 5]), sense[j, 5])
            reading[j] = sense[j, 6] * np.round(y / sense[j, 6]) if sense[j, 6] > 0.0 else y
        # --- command
        _commands(controller, k, reading, z, z_next, followed, u_out)
        for r in range(n_modes):
            q_out[r, k] = q[r]
            v_out[r, k] = v[r]
            if not abs(q[r]) <= RUN_AWAY:
                return False
        for i in range(n_el):
            ew[i, k], ev[i, k], ef[i, k] = w_old[i], row_times(shapes, i, v), point[i]
        # --- act and move
        for j in range(nu):
            f_out[j, k] = 0.0
            taken = u_out[j, k]
            if mix.size > 0:
                taken = 0.0
                for m in range(nu):
                    taken += mix[j, m] * u_out[m, k]
            target[j] = _static_force(taken, drive, j, hyst, before)
        for sub in range(n_sub):
            now = k * n_sub + sub
            for r in range(n_modes):
                modal[r] = 0.0
            for j in range(n_dis):
                for r in range(n_modes):
                    modal[r] += at[r, j] * disturbance[j, k]
            for j in range(nu):
                held[j, now] = target[j]
                if drive[j, 6] < math.inf:
                    most = drive[j, 6] * h
                    step = min(max(target[j] - ramp[j], -most), most)
                    ramp[j] += step
                    held[j, now] = ramp[j] - 0.5 * step
                force = held[j, now]
                if drive[j, 3] > 0.0:
                    late = drive[j, 3] / h
                    shift = math.floor(late + 1e-9)
                    part = max(late - shift, 0.0)
                    newer = held[j, now - shift] if now >= shift else 0.0
                    older = held[j, now - shift - 1] if now >= shift + 1 else 0.0
                    force = part * older + (1.0 - part) * newer
                if drive[j, 4] > 0.0:
                    fade = math.exp(-h / drive[j, 4])
                    left = acting[j] - force
                    acting[j] = force + left * fade
                    force += left * (1.0 - fade) * drive[j, 4] / h
                force += drive[j, 5]
                f_out[j, k] += force / n_sub
                for r in range(n_modes):
                    modal[r] += participation[r, j] * force
            advance(linear, finely, (modal, modal, none, none), elements, along, motion, points, work, kept)
            for j in range(ny):
                y = 0.0
                for r in range(n_modes):
                    y += seen[0, j, r] * q[r] + seen[1, j, r] * v[r]
                truth[j, now + 1] = y
                if sense[j, 4] > 0.0:
                    ratio = h / sense[j, 4]
                    fade = math.exp(-ratio)
                    share = (1.0 - fade) / ratio
                    truth[j, now + 1] = fade * truth[j, now] + (1.0 - share) * y + (share - fade) * unlagged[j]
                    unlagged[j] = y
    return True
