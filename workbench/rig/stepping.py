"""Time stepping of a rig with nonlinear elements: exact modes, forces linear over a substep, implicit force laws.

Each mode is propagated exactly under a force that is linear over the substep. The only error is that of this
interpolation, of second order in the substep, and stiff modes do not limit the substep. The law of a point element is
solved at the end of the substep (Newton, safeguarded by bisection), so that stiff contacts and friction are stable. A
substep in which friction reverses is divided.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, njit, types  # type: ignore[attr-defined]
from numba.extending import intrinsic

from workbench.arrays import Floats, Integers

LINEAR_SPRING, LINEAR_DAMPER, CUBIC, POWER_SPRING, EVEN_SPRING, POWER_DAMPER = range(6)
CLEARANCE, ONE_SIDED, FRICTION, BOUC_WEN, USER = range(6, 11)
N_PARAMETERS = 3  # of a law, at most
SETTLED = 1e-10  # relative tolerance of a force
FAST = {"reassoc", "contract", "nsz"}  # sums over the modes in any order
# Parts of a substep in which friction reverses, since its force is far from linear there. On a frame, at four substeps
# per sample, this reduces the power of the error to a thirteenth. Stops, whose force has a corner only, do not gain:
# errors at the corner and in contact nearly cancel as long as the substeps are equal.
PARTS = 8
# Arguments of `advance`, described there.
Linear = tuple[Floats, Floats, Floats]
Drives = tuple[Floats, Floats, Floats, Floats]
Elements = tuple[Integers, Floats, Floats]
Along = tuple[float, Floats, Floats, Floats, Floats, Floats]
Moving = tuple[Floats, Floats, Floats]
Points = tuple[Floats, Floats, Floats, Floats]
Work = tuple[Floats, Floats, Floats, Floats, Floats, Floats]
Kept = tuple[Floats, Floats, Floats, Floats]
LANES = 8  # modes per SIMD operation; the number of modes is padded to a multiple, with modes at rest


@intrinsic
def _call(typing: Any, address: Any, w: Any, v: Any, p: Any) -> Any:
    """Call the law(w, v, pointer to parameters) at an address."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        data = context.make_array(signature.args[3])(context, builder, values[3]).data
        law = ir.FunctionType(ir.DoubleType(), [ir.DoubleType(), ir.DoubleType(), data.type])
        return builder.call(builder.inttoptr(values[0], law.as_pointer()), [values[1], values[2], data])

    return types.float64(types.int64, types.float64, types.float64, p), generate


@njit(cache=True, nogil=True)
def user_law(w: float, v: float, p: Floats) -> float:
    """The force of a user-defined law, whose address follows its parameters in `p`."""
    force: float = _call(int(p[p.size - 1]), w, v, p)  # type: ignore[call-arg]
    return force


@njit(cache=True, nogil=True)
def propagators(omega: Floats, c: Floats, h: float, out: Floats) -> None:
    """Fill out (2, 4, n_modes): q and q' after h from (q, q', force at start, force at end), force linear between."""
    for r in range(omega.size):
        w = omega[r]
        half = 0.5 * c[r]
        root = np.sqrt(complex(half * half - w * w, 0.0))
        if abs(root) * h < 1e-7:
            root = complex(1e-7 / h, 0.0)
        l1, l2 = -half + root, -half - root
        spread = l1 - l2
        e1, e2 = np.exp(l1 * h), np.exp(l2 * h)
        out[0, 0, r] = ((l1 * e2 - l2 * e1) / spread).real
        out[0, 1, r] = ((e1 - e2) / spread).real
        out[1, 0, r] = (l1 * l2 * (e2 - e1) / spread).real
        out[1, 1, r] = ((l1 * e1 - l2 * e2) / spread).real
        # p_k = ∫ e^{λ(h-s)} ds and m_k = ∫ e^{λ(h-s)} s/h ds
        p1, m1 = _moments(l1, h, e1)
        p2, m2 = _moments(l2, h, e2)
        out[0, 2, r] = ((p1 - m1 - p2 + m2) / spread).real
        out[0, 3, r] = ((m1 - m2) / spread).real
        out[1, 2, r] = ((l1 * (p1 - m1) - l2 * (p2 - m2)) / spread).real
        out[1, 3, r] = ((l1 * m1 - l2 * m2) / spread).real


@njit(cache=True, nogil=True)
def _moments(pole: complex, h: float, e: complex) -> tuple[complex, complex]:
    z = pole * h
    if abs(z) < 0.05:
        p = h * (1 + z / 2 * (1 + z / 3 * (1 + z / 4 * (1 + z / 5 * (1 + z / 6 * (1 + z / 7))))))
        m = h * (0.5 + z / 6 * (1 + z / 4 * (1 + z / 5 * (1 + z / 6 * (1 + z / 7 * (1 + z / 8))))))
        return p, m
    p = (e - 1.0) / pole
    return p, (p / h - 1.0) / pole


@njit(cache=True, nogil=True)
def yield_update(z: float, dw: float, limit: float) -> tuple[float, float]:
    """Bouc-Wen z after a monotone travel dw, and dz/d(dw): exact, since the law does not depend on the speed."""
    s = 1.0 if dw >= 0 else -1.0
    left = abs(dw)
    z = s * z
    if z < 0.0:
        if left <= -z:
            return s * (z + left), 1.0
        left += z
        z = 0.0
    remaining = (limit - z) * math.exp(-left / limit)
    return s * (limit - remaining), remaining / limit


@njit(cache=True, nogil=True)
def hysteresis(path: Floats, limit: float) -> Floats:
    """Bouc-Wen z (n_samples,) along a path (n_samples,) that is monotone between its samples, from 0."""
    z = np.zeros_like(path)
    for k in range(1, path.size):
        z[k], _ = yield_update(z[k - 1], path[k] - path[k - 1], limit)
    return z


@njit(cache=True, nogil=True)
def ramped(targets: Floats, most: float) -> tuple[Floats, Floats]:
    """Mean over each step, and value at its start, of a signal that follows targets by at most `most` per step."""
    mean, start = np.empty_like(targets), np.empty_like(targets)
    value = 0.0
    for k in range(targets.size):
        start[k] = value
        away = targets[k] - value
        if abs(away) >= most:
            value += math.copysign(most, away)
            mean[k] = 0.5 * (start[k] + value)
        else:
            value = targets[k]
            mean[k] = value - 0.5 * away * abs(away) / most
    return mean, start


@njit(cache=True, nogil=True)
def _power(w: float, p: Floats) -> tuple[float, float]:
    """-F |w / w_r|^e in the direction of w, with (F, w_r, e) = p, and its derivative."""
    level = abs(w) / p[1]
    less = p[0] * level ** (p[2] - 1.0) / p[1]
    return -less * w, -p[2] * less


@njit(cache=True, nogil=True)
def element_force(
    kind: int, parameters: Floats, i: int, w: float, v: float, z: float, w_old: float
) -> tuple[float, float, float]:
    """The force of element i, and its derivatives with respect to w and v."""
    a, b = parameters[i, 0], parameters[i, 1]
    if kind == LINEAR_SPRING:
        return -a * w, -a, 0.0
    if kind == LINEAR_DAMPER:
        return -a * v, 0.0, -a
    if kind == CUBIC:
        return -a * w * w * w, -3.0 * a * w * w, 0.0
    if kind == CLEARANCE:
        if w > b:
            return -a * (w - b), -a, 0.0
        if w < -b:
            return -a * (w + b), -a, 0.0
        return 0.0, 0.0, 0.0
    if kind == ONE_SIDED:
        return (-a * (w - b), -a, 0.0) if w > b else (0.0, 0.0, 0.0)
    if kind == FRICTION:
        level = math.tanh(v / b)
        return -a * level - parameters[i, 2], 0.0, -a / b * (1.0 - level * level)
    if kind == BOUC_WEN:
        pulled, slope = yield_update(z, w - w_old, b)
        return -a * pulled, -a * slope, 0.0
    p = parameters[i]
    if kind == POWER_SPRING:
        force, slope = _power(w, p)
        return force, slope, 0.0
    if kind == EVEN_SPRING:
        force, slope = _power(w, p)
        return (force, slope, 0.0) if w > 0 else (-force, -slope, 0.0)
    if kind == POWER_DAMPER:
        force, slope = _power(v, p)
        return force, 0.0, slope
    force = user_law(w, v, p)
    dw, dv = 1e-6 * abs(w) + 1e-12, 1e-6 * abs(v) + 1e-12
    return force, (user_law(w + dw, v, p) - force) / dw, (user_law(w, v + dv, p) - force) / dv


@njit(cache=True, nogil=True)
def solve_element(
    kind: int,
    parameters: Floats,
    i: int,
    w0: float,
    v0: float,
    aw: float,
    av: float,
    z: float,
    w_old: float,
    start: float,
) -> float:
    """The force f of element i with f = law(w0 + aw f, v0 + av f): Newton, safeguarded by bisection."""
    f = start
    low, high = -math.inf, math.inf
    for _ in range(40):
        value, by_w, by_v = element_force(kind, parameters, i, w0 + aw * f, v0 + av * f, z, w_old)
        g = f - value
        if abs(g) <= _close(f, value):
            break
        if g > 0:
            high = f
        else:
            low = f
        slope = 1.0 - by_w * aw - by_v * av
        f_new = f - g / slope if slope > 0.1 else value
        if not (low < f_new < high):
            if low > -math.inf and high < math.inf:
                f_new = 0.5 * (low + high)
            else:
                f_new = value
        if f_new == f:
            break
        f = f_new
    return f


@njit(cache=True, nogil=True)
def solve_pair(
    kinds: Integers,
    parameters: Floats,
    w_free: Floats,
    v_free: Floats,
    aw: Floats,
    av: Floats,
    z: Floats,
    w_old: Floats,
    f: float,
    g: float,
) -> tuple[float, float, bool]:
    """The forces of two elements by Newton's method from f and g, and whether it converged."""
    for _ in range(6):
        w, v = w_free[0] + aw[0, 0] * f + aw[0, 1] * g, v_free[0] + av[0, 0] * f + av[0, 1] * g
        law_f, f_w, f_v = element_force(kinds[0], parameters, 0, w, v, z[0], w_old[0])
        w, v = w_free[1] + aw[1, 0] * f + aw[1, 1] * g, v_free[1] + av[1, 0] * f + av[1, 1] * g
        law_g, g_w, g_v = element_force(kinds[1], parameters, 1, w, v, z[1], w_old[1])
        off_f, off_g = law_f - f, law_g - g
        if abs(off_f) <= _close(law_f, f) and abs(off_g) <= _close(law_g, g):
            return f, g, True
        ff, fg = 1.0 - f_w * aw[0, 0] - f_v * av[0, 0], -f_w * aw[0, 1] - f_v * av[0, 1]
        gf, gg = -g_w * aw[1, 0] - g_v * av[1, 0], 1.0 - g_w * aw[1, 1] - g_v * av[1, 1]
        determinant = ff * gg - fg * gf
        # ff and gg are at least 1 for laws that resist the motion; others may have several solutions
        if not (ff > 0.1 and gg > 0.1 and determinant > 0.01):
            break
        f += (gg * off_f - fg * off_g) / determinant
        g += (ff * off_g - gf * off_f) / determinant
    return f, g, False


@njit(cache=True, nogil=True)
def _close(one: float, other: float) -> float:
    return SETTLED * (abs(one) + abs(other)) + 1e-300


@njit(cache=True, nogil=True)
def solve_in_turn(
    kinds: Integers,
    parameters: Floats,
    w_free: Floats,
    v_free: Floats,
    aw: Floats,
    av: Floats,
    z: Floats,
    w_old: Floats,
    force: Floats,
) -> None:
    """Solve the forces of all elements in place, one after the other until none changes (Gauss-Seidel)."""
    for _ in range(12):
        largest = 0.0
        for i in range(kinds.size):
            w0, v0 = w_free[i], v_free[i]
            for j in range(kinds.size):
                if j != i:
                    w0 += aw[i, j] * force[j]
                    v0 += av[i, j] * force[j]
            f = solve_element(kinds[i], parameters, i, w0, v0, aw[i, i], av[i, i], z[i], w_old[i], force[i])
            largest = max(largest, abs(f - force[i]) / (abs(f) + 1e-30))
            force[i] = f
        if largest < SETTLED:
            break


@njit(cache=True, nogil=True, fastmath=FAST)
def spread_forces(
    q: Floats,
    v: Floats,
    stretch: float,
    stretching: Floats,
    drag_shapes: Floats,
    drag_weights: Floats,
    push: Floats,
    coupling: Floats,
    out: Floats,
) -> None:
    """Fill the modal forces (n_modes,) of stretching, drag and damping that couples modes; push is a work array."""
    n = q.size
    out[:] = 0.0
    if stretch != 0.0:
        tension = 0.0
        for r in range(n):
            for s in range(n):
                out[r] += stretching[r, s] * q[s]
            tension += q[r] * out[r]
        for r in range(n):
            out[r] *= -stretch * tension
    for g in range(push.size):
        push[g] = 0.0
    for r in range(n if push.size > 0 else 0):
        for g in range(push.size):
            push[g] += drag_shapes[r, g] * v[r]
    for g in range(push.size):
        push[g] *= -drag_weights[g] * abs(push[g])
    for r in range(n if push.size > 0 else 0):
        for g in range(push.size):
            out[r] += drag_shapes[r, g] * push[g]
    if coupling.size > 0:
        for r in range(n):
            for s in range(n):
                out[r] -= coupling[r, s] * v[s]


@njit(cache=True, nogil=True, fastmath=FAST)
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


@njit(cache=True, nogil=True, fastmath=FAST)
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
@njit(cache=True, nogil=True, fastmath=FAST, forceinline=True, _nrt=False)  # type: ignore[call-overload, untyped-decorator]
def _advance_once(
    linear: Linear, drives: Drives, elements: Elements, along: Along, motion: Moving, points: Points, work: Work
) -> None:
    """Advance by one substep, or by a part of one; arguments as of `advance`."""
    e, aw, av = linear
    drive, drive_end, more_q, more_v = drives
    kinds, shapes, parameters = elements
    stretch, stretching, drag_shapes, drag_weights, push, coupling = along
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
        for i in range(n_elements):
            w, u = 0.0, 0.0
            for r in range(n):
                w += shapes[i, r] * (base_q[r] + e[0, 3, r] * spread[r])
                u += shapes[i, r] * (base_v[r] + e[1, 3, r] * spread[r])
            w_free[i], v_free[i] = w, u
        settled = False
        if n_elements == 1:
            point[0] = solve_element(
                kinds[0], parameters, 0, w_free[0], v_free[0], aw[0, 0], av[0, 0], z[0], w_old[0], point[0]
            )
            settled = True
        elif n_elements == 2:
            f, g, settled = solve_pair(kinds, parameters, w_free, v_free, aw, av, z, w_old, point[0], point[1])
            if settled:
                point[0], point[1] = f, g
        if n_elements > 1 and not settled:
            solve_in_turn(kinds, parameters, w_free, v_free, aw, av, z, w_old, point)
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
            spread_forces(q, v, stretch, stretching, drag_shapes, drag_weights, push, coupling, spread)
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
def _rate(shapes: Floats, i: int, v: Floats) -> float:
    """Velocity at element i."""
    rate = 0.0
    for r in range(shapes.shape[1]):
        rate += shapes[i, r] * v[r]
    return rate


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
def _keep(kept: Floats, a: Floats, b: Floats, c: Floats, d: Floats) -> None:
    """Copy four arrays (n,) into `kept` (4, n)."""
    for i in range(a.size):
        kept[0, i], kept[1, i], kept[2, i], kept[3, i] = a[i], b[i], c[i], d[i]


@njit(cache=True, nogil=True, forceinline=True, _nrt=False)  # type: ignore[call-overload, untyped-decorator]
def _put_back(kept: Floats, a: Floats, b: Floats, c: Floats, d: Floats) -> None:
    """Restore four arrays (n,) from `kept` (4, n)."""
    for i in range(a.size):
        a[i], b[i], c[i], d[i] = kept[0, i], kept[1, i], kept[2, i], kept[3, i]


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
        along: distributed elements, see `spread_forces`.
        motion: q, q' and the modal forces of all elements, (n_modes,): updated.
        points: forces, previous forces, displacements and hysteretic displacements, (n_elements,): updated.
        work: free displacements and rates (n_elements,); q, q' and forces (n_modes,); distributed forces (n_modes,),
            which carry over to the next substep.
        kept: copies of motion, points and rates before the substep, and the drives of its parts.
    """
    kinds, shapes, parameters = elements
    start, end, more_q, more_v = drives
    q, v, old = motion
    point, earlier, w, z = points
    spread = work[5]
    modes_kept, points_kept, rates, parts_of = kept
    friction = _has_friction(kinds)
    if friction:
        _keep(modes_kept, q, v, old, spread)
        _keep(points_kept, point, earlier, w, z)
        for i in range(kinds.size):
            rates[0, i] = _rate(shapes, i, v)
    parts, part = 1, 0
    while part < parts:
        # one call for both cases, because every inlined call is compiled again
        whole = parts == 1
        _advance_once(
            linear if whole else finely,
            drives if whole else (parts_of[0], parts_of[1], parts_of[2], parts_of[3]),
            elements,
            along,
            motion,
            points,
            work,
        )
        part += 1
        if friction and whole:
            for i in range(kinds.size):
                rates[1, i] = _rate(shapes, i, v)
            if _friction_reverses(kinds, parameters, rates):
                _put_back(modes_kept, q, v, old, spread)
                _put_back(points_kept, point, earlier, w, z)
                parts, part = PARTS, 0
        if parts > 1:
            for r in range(q.size):
                rise = (end[r] - start[r]) / PARTS
                parts_of[0, r] = start[r] + part * rise
                parts_of[1, r] = parts_of[0, r] + rise
                parts_of[2, r] = more_q[r] if part == PARTS - 1 else 0.0
                parts_of[3, r] = more_v[r] if part == PARTS - 1 else 0.0


@njit(cache=True, nogil=True)
def at_rest(n: int, n_elements: int) -> tuple[Linear, Linear, Drives, Moving, Points, Work, Kept]:
    """Arguments of `advance` for a motion at rest: linear, finely, drives, motion, points, work, kept."""
    linear = np.empty((2, 4, n)), np.zeros((n_elements, n_elements)), np.zeros((n_elements, n_elements))
    finely = np.empty((2, 4, n)), np.zeros((n_elements, n_elements)), np.zeros((n_elements, n_elements))
    motion = np.zeros(n), np.zeros(n), np.zeros(n)
    points = np.zeros(n_elements), np.zeros(n_elements), np.zeros(n_elements), np.zeros(n_elements)
    work = np.zeros(n_elements), np.zeros(n_elements), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    kept = np.zeros((4, n)), np.zeros((4, n_elements)), np.zeros((2, n_elements)), np.zeros((4, n))
    drives = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    return linear, finely, drives, motion, points, work, kept


@njit(cache=True, nogil=True)
def whole_lanes(
    omega: Floats, c: Floats, coupling: Floats, stretching: Floats, drag_shapes: Floats, shapes: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """The arrays padded with modes at rest to a multiple of LANES modes."""
    n = LANES * ((omega.size + LANES - 1) // LANES)
    wide, damping, elements = np.ones(n), np.zeros(n), np.zeros((shapes.shape[0], n))
    for r in range(omega.size):
        wide[r], damping[r] = omega[r], c[r]
        for i in range(shapes.shape[0]):
            elements[i, r] = shapes[i, r]
    return (
        wide,
        damping,
        _widened(coupling, n, n if coupling.size > 0 else 0),
        _widened(stretching, n, n if stretching.size > 0 else 0),
        _widened(drag_shapes, n, drag_shapes.shape[1]),
        elements,
    )


@njit(cache=True, nogil=True)
def _widened(values: Floats, n: int, columns: int) -> Floats:
    wide = np.zeros((n, columns))
    for r in range(values.shape[0]):
        for s in range(values.shape[1]):
            wide[r, s] = values[r, s]
    return wide


@njit(cache=True, nogil=True, fastmath=FAST)
def step_record(
    omega: Floats,
    c: Floats,
    coupling: Floats,
    dt: float,
    n_sub: int,
    rate: float,
    starts: Floats,
    ends: Floats,
    participation: Floats,
    sizes: Floats,
    added: Floats,
    stretch: float,
    stretching: Floats,
    drag_shapes: Floats,
    drag_weights: Floats,
    kinds: Integers,
    shapes: Floats,
    parameters: Floats,
    measured: Floats,
    orders: Integers,
    reading: Floats,
    gain: Floats,
    q_out: Floats,
    v_out: Floats,
    f_out: Floats,
    error_out: Floats,
) -> None:
    """Fill q_out, v_out and the element forces f_out, each (n_modes, n_samples), from rest; or innovations error_out.

    Args:
        omega, c, coupling: frequencies and damping (n_modes,), and coupling by damping (n_modes, n_modes).
        dt, n_sub, rate: sample time, s; substeps; relative change of stiffness per time, 1/s.
        starts, ends: (n_inputs, n_samples * n_sub) forces at the start and the end of each substep.
        participation: (n_modes, n_inputs).
        sizes, added: forces that are not linear: sizes (n_added, n_samples * n_sub), and the correction (n_added, 2,
            n_modes) of q and q' at the end of a substep per unit size.
        stretch, stretching, drag_shapes, drag_weights: distributed elements, see `structure_arrays` of `simulate`.
        kinds, shapes, parameters: point elements.
        measured: (n_sensors, n_samples); if given, the innovations are computed instead of the motion, and correct it.
        orders, reading: order of the time derivative (n_sensors,) and output matrix (n_sensors, n_modes).
        gain: (2, n_modes, n_sensors) of the observer.
    """
    n_modes, n_elements, n_inputs = omega.size, kinds.size, starts.shape[0]
    n_samples = measured.shape[1] if measured.size > 0 else q_out.shape[1]
    omega, c, coupling, stretching, drag_shapes, shapes = whole_lanes(
        omega, c, coupling, stretching, drag_shapes, shapes
    )
    n = LANES * (omega.size // LANES)  # tells the compiler that n is a multiple of LANES
    into, n_sensors = np.zeros((n_inputs, n)), measured.shape[0]
    more = np.zeros((added.shape[0], 2, n))
    seen, held = np.zeros((n_sensors, n)), np.zeros((2, n_sensors, n))
    for r in range(n_modes):
        for j in range(n_inputs):
            into[j, r] = participation[r, j]
        for j in range(added.shape[0]):
            more[j, 0, r], more[j, 1, r] = added[j, 0, r], added[j, 1, r]
        for j in range(n_sensors):
            seen[j, r], held[0, j, r], held[1, j, r] = reading[j, r], gain[0, r, j], gain[1, r, j]
    accelerations = False
    for j in range(n_sensors):
        accelerations |= orders[j] == 2
    h = dt / n_sub
    linear, finely, drives, motion, points, work, kept = at_rest(n, n_elements)
    (drive, drive_end, more_q, more_v), (q, v, old), w_old = drives, motion, points[2]
    accelerated = np.zeros(n)
    elements = kinds, shapes, parameters
    along = stretch, stretching, drag_shapes, drag_weights, np.empty(drag_weights.size), coupling
    for k in range(n_samples):
        if k == 0 or rate != 0.0:
            drifted_propagators(omega, c, h, 1.0 + rate * (k + 0.5) * dt, elements, linear, finely)
        if measured.size == 0:
            for r in range(n_modes):
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
                read = 0.0
                for r in range(n):
                    read += seen[j, r] * moved[r]
                error_out[j, k] = measured[j, k] - read
            for j in range(n_sensors):
                error = error_out[j, k]
                for r in range(n):
                    q[r] += held[0, j, r] * error
                    v[r] += held[1, j, r] * error
            for i in range(n_elements):
                w_old[i] = 0.0
                for r in range(n):
                    w_old[i] += shapes[i, r] * q[r]
        if k == n_samples - 1:
            break
        for sub in range(n_sub):
            for r in range(n):
                drive[r] = 0.0
                drive_end[r] = 0.0
            for j in range(n_inputs):
                first, last = starts[j, k * n_sub + sub], ends[j, k * n_sub + sub]
                for r in range(n):
                    drive[r] += into[j, r] * first
                    drive_end[r] += into[j, r] * last
            for r in range(n if more.shape[0] > 0 else 0):
                more_q[r] = 0.0
                more_v[r] = 0.0
            for j in range(more.shape[0]):
                size = sizes[j, k * n_sub + sub]
                for r in range(n):
                    more_q[r] += more[j, 0, r] * size
                    more_v[r] += more[j, 1, r] * size
            advance(linear, finely, drives, elements, along, motion, points, work, kept)


@cache
def address_of(law: Callable[[float, float, Floats], float]) -> float:
    """Address of the compiled force(w, v, parameters) = `law` in the memory of this process."""
    compiled = njit(nogil=True)(law)

    def call(w: float, v: float, parameters: Any) -> float:
        force: float = compiled(w, v, carray(parameters, (N_PARAMETERS,)))
        return force

    signature = types.float64(types.float64, types.float64, types.CPointer(types.float64))  # type: ignore[no-untyped-call]
    _KEPT.append(cfunc(signature)(call))
    return float(_KEPT[-1].address)  # exact, as addresses are below 2**53


_KEPT: list[Any] = []  # user-defined laws, kept alive as long as this process
