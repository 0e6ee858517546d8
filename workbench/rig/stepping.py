"""Time stepping of a rig with nonlinear elements: exact modes, forces linear over a substep, implicit force laws.

Each mode is propagated exactly under a force that is linear over the substep. The only error is that of this
interpolation, of second order in the substep, and stiff modes do not limit the substep. The law of a point element is
solved at the end of the substep (Newton, safeguarded by bisection), so that stiff contacts and friction are stable. A
substep in which friction reverses is divided.
"""

import math
from functools import lru_cache

import numpy as np
from numba import njit

from workbench.arrays import Floats, Integers
from workbench.rig.elements import AirDrag, MidplaneStretching, PointElement, UserLaw
from workbench.rig.force_laws import BOUC_WEN, FRICTION, LAWS, N_PARAMETERS, compiled_law, solve_laws, yield_update
from workbench.rig.lanes import LANES, on_lanes, row_times
from workbench.rig.linear import propagators
from workbench.rig.rig import KEPT, Rig

# Parts of a substep in which friction reverses, since its force is far from linear there. On a frame, at four substeps
# per sample, this reduces the power of the error to a thirteenth. Stops, whose force has a corner only, do not gain:
# errors at the corner and in contact nearly cancel as long as the substeps are equal.
PARTS = 8
# Described in `structure_arrays` and `law_arrays`.
Structure = tuple[Floats, Floats, Floats, float, float, Floats, Floats, Floats]
Elements = tuple[Integers, Floats, Floats]
# Described in `step_record`.
Forces = tuple[Floats, Floats, Floats, Floats, Floats]
Observer = tuple[Floats, Integers, Floats, Floats]
Out = tuple[Floats, Floats, Floats, Floats]
# Described in `advance`.
Linear = tuple[Floats, Floats, Floats]
Drives = tuple[Floats, Floats, Floats, Floats]
Along = tuple[float, Floats, Floats, Floats, Floats, Floats]
Moving = tuple[Floats, Floats, Floats]
Points = tuple[Floats, Floats, Floats, Floats]
Work = tuple[Floats, Floats, Floats, Floats, Floats, Floats]
Kept = tuple[Points, Points, Floats, Drives]


@lru_cache(maxsize=KEPT)
def structure_arrays(rig: Rig) -> Structure:
    """The structure and its distributed elements as arrays for the steppers, n and n_points multiples of LANES.

    All have one type and memory layout, since numba compiles a stepper again for any other; absent parts are empty
    arrays. The arrays are cached and must not be changed.

    Returns:
        Frequencies (n,), damping (n,), its coupling (n, n), relative change of the stiffness per time, 1/s; and of the
        distributed elements: coefficient of stretching, ∫ φ_r' φ_s' dx (n, n), shapes (n, n_points) at quadrature
        points for drag, and its coefficient times the weights (n_points,).
    """
    modes, nothing = rig.modes, np.zeros((0, 0))
    own = np.diag(modes.damping)
    coupling = modes.damping - np.diag(own)
    stretch, drag = (
        float(sum(e.coefficient for e in rig.elements if isinstance(e, kind))) for kind in (MidplaneStretching, AirDrag)
    )
    shapes, weights = _along(rig, 0) if drag else (np.zeros((0, modes.n_modes)), np.zeros(0))
    stretching = nothing
    if stretch:
        slopes, widths = _along(rig, 1)
        stretching = on_lanes(slopes.T @ (widths[:, None] * slopes), 2)
    return (
        on_lanes(modes.omega),
        on_lanes(own),
        on_lanes(coupling, 2) if coupling.any() else nothing,
        float(rig.stiffness_rate),
        stretch,
        stretching,
        np.ascontiguousarray(on_lanes(shapes, 2).T),
        on_lanes(drag * weights),
    )


def _along(rig: Rig, derivative: int) -> tuple[Floats, Floats]:
    """Shapes and quadrature weights at Gauss points along the structure, for products of up to four shapes."""
    points, weights = rig.modes.domain.quadrature(max(3 * rig.modes.n_modes + 12, 30))
    return rig.modes.phi(points, derivative), weights


@lru_cache(maxsize=KEPT)
def law_arrays(rig: Rig) -> Elements:
    """Kinds (n_elements,), shapes (n_elements, n) and parameters (n_elements, n_parameters) of the elements at points.

    The arrays are cached and must not be changed.
    """
    points = [e for e in rig.elements if isinstance(e, PointElement)]
    user_defined = any(isinstance(e, UserLaw) for e in points)
    parameters = np.zeros((len(points), N_PARAMETERS + user_defined))
    for row, element in zip(parameters, points, strict=True):
        row[: len(element.parameters)] = element.parameters
        if isinstance(element, UserLaw):
            row[-1] = compiled_law(element.law).address  # exact, as addresses are below 2**53
    shapes = np.array([rig.modes.phi_at(e.at) for e in points]).reshape(len(points), rig.modes.n_modes)
    return np.array([LAWS[type(e)] for e in points], np.int64), on_lanes(shapes), parameters


@njit(cache=True, nogil=True)
def distributed_forces(q: Floats, v: Floats, along: Along, out: Floats) -> None:
    """Fill the modal forces (n_modes,) of stretching, drag and damping that couples modes.

    `along` holds their arrays, see `structure_arrays`, with a work array (n_points,) before the coupling.
    """
    stretch, stretching, drag_shapes, drag_weights, push, coupling = along
    n = q.size
    out[:] = 0.0
    if stretch != 0.0:
        tension = 0.0
        for s in range(n):
            for r in range(n):
                out[r] += stretching[s, r] * q[s]  # symmetric
        for r in range(n):
            tension += q[r] * out[r]
        for r in range(n):
            out[r] *= -stretch * tension
    if push.size > 0:
        push[:] = 0.0
        for r in range(n):
            for g in range(push.size):
                push[g] += drag_shapes[r, g] * v[r]
        for g in range(push.size):
            push[g] *= -drag_weights[g] * abs(push[g])
        for r in range(n):
            out[r] += row_times(drag_shapes, r, push)
    if coupling.size > 0:
        for r in range(n):
            out[r] -= row_times(coupling, r, v)


@njit(cache=True, nogil=True)
def _compliances(omega: Floats, c: Floats, h: float, shapes: Floats, linear: Linear) -> None:
    """Fill the propagators (2, 4, n_modes) over a substep, and the compliances between elements.

    The compliances, two of (n_elements, n_elements), are displacement and velocity of element i at the end of a substep
    due to a force of element j that rises from zero to one over it.
    """
    e, aw, av = linear
    propagators(omega, c, h, e)
    for i in range(shapes.shape[0]):
        for j in range(shapes.shape[0]):
            aw[i, j] = 0.0
            av[i, j] = 0.0
            for r in range(omega.size):
                aw[i, j] += shapes[i, r] * e[0, 3, r] * shapes[j, r]
                av[i, j] += shapes[i, r] * e[1, 3, r] * shapes[j, r]


@njit(cache=True, nogil=True, forceinline=True, _nrt=False)  # type: ignore[call-overload, untyped-decorator]
def _has_friction(kinds: Integers) -> bool:
    """Whether an element is Coulomb friction."""
    for i in range(kinds.size):
        if kinds[i] == FRICTION:
            return True
    return False


@njit(cache=True, nogil=True)
def drifted_propagators(
    omega: Floats, c: Floats, h: float, factor: float, elements: Elements, linear: Linear, finely: Linear
) -> None:
    """Fill `linear` for a substep at `factor` times the stiffness, and `finely` for its parts if there is friction."""
    kinds, shapes, _ = elements
    drifted = omega * math.sqrt(max(factor, 1e-6))
    _compliances(drifted, c, h, shapes, linear)
    if _has_friction(kinds):
        _compliances(drifted, c, h / PARTS, shapes, finely)


# Inlined and without reference counting, since either would cost as much as the work of a substep.
@njit(cache=True, nogil=True, forceinline=True, _nrt=False)  # type: ignore[call-overload, untyped-decorator]
def _advance_once(
    linear: Linear, drives: Drives, elements: Elements, along: Along, motion: Moving, points: Points, work: Work
) -> None:
    """Advance by one substep, or by a part of one; arguments as of `advance`."""
    e, aw, av = linear
    drive, drive_end, more_q, more_v = drives
    kinds, shapes, parameters = elements
    stretch, _, _, drag_weights, _, coupling = along
    q, v, old = motion
    point, earlier, w_old, z = points
    w_free, v_free, base_q, base_v, new, spread = work
    n, n_elements = LANES * (q.size // LANES), kinds.size
    distributed = stretch != 0.0 or drag_weights.size > 0 or coupling.size > 0
    for r in range(n):
        start, end = old[r] + drive[r], drive_end[r]
        base_q[r] = more_q[r] + e[0, 0, r] * q[r] + e[0, 1, r] * v[r] + e[0, 2, r] * start + e[0, 3, r] * end
        base_v[r] = more_v[r] + e[1, 0, r] * q[r] + e[1, 1, r] * v[r] + e[1, 2, r] * start + e[1, 3, r] * end
    if n_elements == 0 and not distributed:
        for r in range(n):
            q[r] = base_q[r]
            v[r] = base_v[r]
        return
    for i in range(n_elements):
        guess = 2.0 * point[i] - earlier[i]
        earlier[i], point[i] = point[i], guess
    for sweep in range(2 if distributed else 1):
        for r in range(n):  # without the forces of the point elements
            q[r] = base_q[r] + e[0, 3, r] * spread[r]
            v[r] = base_v[r] + e[1, 3, r] * spread[r]
        for i in range(n_elements):
            w_free[i], v_free[i] = row_times(shapes, i, q), row_times(shapes, i, v)
        if n_elements > 0:
            solve_laws((kinds, parameters), w_free, v_free, aw, av, z, w_old, point)
        for r in range(n):
            new[r] = spread[r]
        for i in range(n_elements):
            force = point[i]
            for r in range(n):
                new[r] += shapes[i, r] * force
        for r in range(n):
            q[r] = base_q[r] + e[0, 3, r] * new[r]
            v[r] = base_v[r] + e[1, 3, r] * new[r]
        if distributed and sweep == 0:
            # distributed forces, from the predicted motion
            distributed_forces(q, v, along, spread)
    for r in range(n):
        old[r] = new[r]
    for i in range(n_elements):
        w = w_free[i]
        for j in range(n_elements):
            w += aw[i, j] * point[j]
        if kinds[i] == BOUC_WEN:
            z[i], _ = yield_update(z[i], w - w_old[i], parameters[i, 1])
        w_old[i] = w


@njit(cache=True, nogil=True, forceinline=True, _nrt=False)  # type: ignore[call-overload, untyped-decorator]
def _friction_reverses(kinds: Integers, parameters: Floats, rates: Floats) -> bool:
    """Whether a friction force reverses between two rates (2, n_elements): they pass its smoothing speed."""
    for i in range(kinds.size):
        if kinds[i] == FRICTION:
            smooth, before, after = parameters[i, 1], rates[0, i], rates[1, i]
            if (before > smooth) != (after > smooth) or (before < -smooth) != (after < -smooth):
                return True
    return False


@njit(cache=True, nogil=True, forceinline=True, _nrt=False)  # type: ignore[call-overload, untyped-decorator]
def _copy(arrays: Points, into: Points) -> None:
    """Copy four arrays of one length into four others."""
    a, b, c, d = arrays
    e, f, g, h = into
    for i in range(a.size):
        e[i], f[i], g[i], h[i] = a[i], b[i], c[i], d[i]


@njit(cache=True, nogil=True, forceinline=True, _nrt=False)  # type: ignore[call-overload, untyped-decorator]
def advance(
    linear: Linear,
    finely: Linear,
    drives: Drives,
    elements: Elements,
    along: Along,
    motion: Moving,
    points: Points,
    work: Work,
    kept: Kept,
) -> None:
    """Advance the modes, a multiple of LANES, and the elements of a rig by a substep, in place.

    Args:
        linear, finely: propagators and compliances of a substep, and of one of PARTS parts for where friction reverses,
            see `drifted_propagators`.
        drives: modal forces (n_modes,) at the start and the end of the substep; and corrections of q and q' at the end
            for forces that are not linear.
        elements: kinds (n_elements,), shapes (n_elements, n_modes) and parameters (n_elements, 3) of point elements.
        along: distributed elements, see `distributed_forces`.
        motion: q, q' and the modal forces of all elements, (n_modes,): updated.
        points: forces, previous forces, displacements and hysteretic displacements, (n_elements,): updated.
        work: free displacements and rates (n_elements,); q, q' and forces (n_modes,); distributed forces (n_modes,),
            which carry over to the next substep.
        kept: copies of motion, points and rates before the substep, and the drives of its parts.
    """
    kinds, shapes, parameters = elements
    start, end, more_q, more_v = drives
    v, moving = motion[1], (motion[0], motion[1], motion[2], work[5])
    moving_kept, points_kept, rates, of_part = kept
    friction = _has_friction(kinds)
    if friction:
        _copy(moving, moving_kept)
        _copy(points, points_kept)
        for i in range(kinds.size):
            rates[0, i] = row_times(shapes, i, v)
    parts, part = 1, 0
    while part < parts:
        # one call for both cases, because every inlined call is compiled again
        whole = parts == 1
        coefficients, forces = (linear, drives) if whole else (finely, of_part)
        _advance_once(coefficients, forces, elements, along, motion, points, work)
        part += 1
        if friction and whole:
            for i in range(kinds.size):
                rates[1, i] = row_times(shapes, i, v)
            if _friction_reverses(kinds, parameters, rates):
                _copy(moving_kept, moving)
                _copy(points_kept, points)
                parts, part = PARTS, 0
        if parts > 1:
            for r in range(v.size):
                rise = (end[r] - start[r]) / PARTS
                of_part[0][r] = start[r] + part * rise
                of_part[1][r] = of_part[0][r] + rise
                of_part[2][r] = more_q[r] if part == PARTS - 1 else 0.0
                of_part[3][r] = more_v[r] if part == PARTS - 1 else 0.0


@njit(cache=True, nogil=True)
def at_rest(n: int, n_elements: int) -> tuple[Linear, Linear, Drives, Moving, Points, Work, Kept]:
    """Arguments of `advance` for a motion at rest: linear, finely, drives, motion, points, work, kept."""
    linear = np.empty((2, 4, n)), np.zeros((n_elements, n_elements)), np.zeros((n_elements, n_elements))
    finely = np.empty((2, 4, n)), np.zeros((n_elements, n_elements)), np.zeros((n_elements, n_elements))
    motion = np.zeros(n), np.zeros(n), np.zeros(n)
    points = np.zeros(n_elements), np.zeros(n_elements), np.zeros(n_elements), np.zeros(n_elements)
    work = np.zeros(n_elements), np.zeros(n_elements), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    drives = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    moving = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    of_points = np.zeros(n_elements), np.zeros(n_elements), np.zeros(n_elements), np.zeros(n_elements)
    of_part = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    kept = moving, of_points, np.zeros((2, n_elements)), of_part
    return linear, finely, drives, motion, points, work, kept


@njit(cache=True, nogil=True)
def step_record(
    structure: Structure, elements: Elements, forces: Forces, dt: float, n_sub: int, observer: Observer, out: Out
) -> None:
    """Fill the motion of a rig from rest, or the innovations of an observer, which correct the motion.

    Args:
        structure, elements: see `structure_arrays` and `law_arrays`; n is the number of modes with those at rest.
        forces: participation (n_inputs, n), and forces (n_inputs, n_samples * n_sub) at the start and the end of each
            substep; of forces that are not linear, the correction (n_added, 2, n) of q and q' at the end of a substep
            per unit size, and sizes (n_added, n_samples * n_sub).
        dt: sample time, s.
        n_sub: substeps of a sample.
        observer: outputs (n_sensors, n_samples), order of their time derivative (n_sensors,), output matrix
            (n_sensors, n) and gain (2, n_sensors, n); empty arrays for none.
        out: displacements, velocities and element forces of the modes, (n_modes, n_samples), without an observer;
            innovations (n_sensors, n_samples) with one.
    """
    participation, starts, ends, added, sizes = forces
    measured, orders, reading, gain = observer
    q_out, v_out, f_out, error_out = out
    omega, c, coupling, rate, stretch, stretching, drag_shapes, drag_weights = structure
    kinds, shapes, _ = elements
    n_samples = measured.shape[1] if measured.size > 0 else q_out.shape[1]
    n = LANES * (omega.size // LANES)  # tells the compiler that n is a multiple of LANES
    n_elements, n_inputs, n_sensors = kinds.size, starts.shape[0], measured.shape[0]
    accelerations = False
    for j in range(n_sensors):
        accelerations |= orders[j] == 2
    h = dt / n_sub
    linear, finely, drives, motion, points, work, kept = at_rest(n, n_elements)
    (drive, drive_end, more_q, more_v), (q, v, old), w_old = drives, motion, points[2]
    accelerated = np.zeros(n)
    along = stretch, stretching, drag_shapes, drag_weights, np.empty(drag_weights.size), coupling
    for k in range(n_samples):
        if k == 0 or rate != 0.0:
            drifted_propagators(omega, c, h, 1.0 + rate * (k + 0.5) * dt, elements, linear, finely)
        if measured.size == 0:
            for r in range(q_out.shape[0]):
                q_out[r, k] = q[r]
                v_out[r, k] = v[r]
                f_out[r, k] = old[r]
        else:
            if accelerations:
                stiffer = 1.0 + rate * k * dt
                for r in range(n):
                    accelerated[r] = old[r] - stiffer * omega[r] ** 2 * q[r] - c[r] * v[r]
            for j in range(n_sensors):
                moved = q if orders[j] == 0 else v if orders[j] == 1 else accelerated
                error_out[j, k] = measured[j, k] - row_times(reading, j, moved)
            for j in range(n_sensors):
                error = error_out[j, k]
                for r in range(n):
                    q[r] += gain[0, j, r] * error
                    v[r] += gain[1, j, r] * error
            for i in range(n_elements):
                w_old[i] = row_times(shapes, i, q)
        if k == n_samples - 1:
            break
        for sub in range(n_sub):
            drive[:] = 0.0
            drive_end[:] = 0.0
            for j in range(n_inputs):
                first, last = starts[j, k * n_sub + sub], ends[j, k * n_sub + sub]
                for r in range(n):
                    drive[r] += participation[j, r] * first
                    drive_end[r] += participation[j, r] * last
            more_q[:] = 0.0
            more_v[:] = 0.0
            for j in range(added.shape[0]):
                size = sizes[j, k * n_sub + sub]
                for r in range(n):
                    more_q[r] += added[j, 0, r] * size
                    more_v[r] += added[j, 1, r] * size
            advance(linear, finely, drives, elements, along, motion, points, work, kept)
