"""Stepping of a rig with nonlinear elements: exact modes, forces linear over each substep, laws solved implicitly.

Each mode is propagated exactly under a force that varies linearly over the substep, so the only error is that of this
interpolation, of second order in the substep, and stiff modes cost nothing. The law of a point element is solved at
the end of the substep (Newton, safeguarded by bisection), so stiff contacts and friction stay stable.
"""

import math
from types import FunctionType

import numpy as np
from numba import njit

LINEAR_SPRING, LINEAR_DAMPER, CUBIC, CLEARANCE, ONE_SIDED, FRICTION, BOUC_WEN, USER = range(8)


@njit(cache=True, nogil=True)
def user_law(w, v, p):
    """Stands for the law of the user's own, until `make_stepper` puts one in its place."""
    return 0.0


@njit(cache=True, nogil=True)
def propagators(omega, c, h, out):
    """Fill out (n_modes, 2, 4): q and q' after h from (q, q', force at start, force at end), force linear between."""
    for r in range(omega.size):
        w = omega[r]
        half = 0.5 * c[r]
        root = np.sqrt(complex(half * half - w * w, 0.0))
        if abs(root) * h < 1e-7:
            root = complex(1e-7 / h, 0.0)
        l1, l2 = -half + root, -half - root
        spread = l1 - l2
        e1, e2 = np.exp(l1 * h), np.exp(l2 * h)
        out[r, 0, 0] = ((l1 * e2 - l2 * e1) / spread).real
        out[r, 0, 1] = ((e1 - e2) / spread).real
        out[r, 1, 0] = (l1 * l2 * (e2 - e1) / spread).real
        out[r, 1, 1] = ((l1 * e1 - l2 * e2) / spread).real
        # p_k = ∫ e^{λ(h-s)} ds and m_k = ∫ e^{λ(h-s)} s/h ds
        p1, m1 = _moments(l1, h, e1)
        p2, m2 = _moments(l2, h, e2)
        out[r, 0, 2] = ((p1 - m1 - p2 + m2) / spread).real
        out[r, 0, 3] = ((m1 - m2) / spread).real
        out[r, 1, 2] = ((l1 * (p1 - m1) - l2 * (p2 - m2)) / spread).real
        out[r, 1, 3] = ((l1 * m1 - l2 * m2) / spread).real


@njit(cache=True, nogil=True)
def _moments(pole, h, e):
    z = pole * h
    if abs(z) < 0.05:
        p = h * (1 + z / 2 * (1 + z / 3 * (1 + z / 4 * (1 + z / 5 * (1 + z / 6 * (1 + z / 7))))))
        m = h * (0.5 + z / 6 * (1 + z / 4 * (1 + z / 5 * (1 + z / 6 * (1 + z / 7 * (1 + z / 8))))))
        return p, m
    p = (e - 1.0) / pole
    return p, (p / h - 1.0) / pole


@njit(cache=True, nogil=True)
def _yield_update(z, dw, limit):
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
def element_force(kind, p, w, v, z, w_old):
    """The force of an element, and its derivatives with respect to w and v."""
    if kind == LINEAR_SPRING:
        return -p[0] * w, -p[0], 0.0
    if kind == LINEAR_DAMPER:
        return -p[0] * v, 0.0, -p[0]
    if kind == CUBIC:
        return -p[0] * w * w * w, -3.0 * p[0] * w * w, 0.0
    if kind == CLEARANCE:
        if w > p[1]:
            return -p[0] * (w - p[1]), -p[0], 0.0
        if w < -p[1]:
            return -p[0] * (w + p[1]), -p[0], 0.0
        return 0.0, 0.0, 0.0
    if kind == ONE_SIDED:
        return (-p[0] * (w - p[1]), -p[0], 0.0) if w > p[1] else (0.0, 0.0, 0.0)
    if kind == FRICTION:
        level = math.tanh(v / p[1])
        return -p[0] * level, 0.0, -p[0] / p[1] * (1.0 - level * level)
    if kind == BOUC_WEN:
        pulled, slope = _yield_update(z, w - w_old, p[1])
        return -p[0] * pulled, -p[0] * slope, 0.0
    force = user_law(w, v, p)
    dw, dv = 1e-6 * abs(w) + 1e-12, 1e-6 * abs(v) + 1e-12
    return force, (user_law(w + dw, v, p) - force) / dw, (user_law(w, v + dv, p) - force) / dv


@njit(cache=True, nogil=True)
def solve_element(kind, p, w0, v0, aw, av, z, w_old, start):
    """The force f with f = law(w0 + aw f, v0 + av f)."""
    f = start
    low, high = -math.inf, math.inf
    for _ in range(40):
        value, by_w, by_v = element_force(kind, p, w0 + aw * f, v0 + av * f, z, w_old)
        g = f - value
        if abs(g) <= 1e-10 * (abs(f) + abs(value)) + 1e-300:
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
def step_record(
    omega,
    c,
    coupling,
    dt,
    n_sub,
    rate,
    forces,
    participation,
    stretch,
    stretching,
    drag_shapes,
    drag_weights,
    kinds,
    shapes,
    parameters,
    q_out,
    v_out,
    f_out,
):
    """Fill q_out, v_out and the element forces f_out, each (n_modes, n_samples), from rest.

    forces (n_inputs, n_samples * n_sub) held over each substep; participation (n_modes, n_inputs);
    stretching (n_modes, n_modes); drag_shapes (n_points, n_modes); shapes (n_elements, n_modes).
    """
    n, n_samples, n_elements = omega.size, q_out.shape[1], kinds.size
    h = dt / n_sub
    e = np.empty((n, 2, 4))
    propagators(omega, c, h, e)
    q, v, base_q, base_v = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    old, new, spread = np.zeros(n), np.zeros(n), np.zeros(n)
    spread_old, drive = np.zeros(n), np.zeros(n)
    point, w_old, z = np.zeros(n_elements), np.zeros(n_elements), np.zeros(n_elements)
    w_free, v_free = np.zeros(n_elements), np.zeros(n_elements)
    aw, av = np.zeros((n_elements, n_elements)), np.zeros((n_elements, n_elements))
    distributed = stretch != 0.0 or drag_weights.size > 0 or coupling.size > 0
    changed = np.empty(n)
    for k in range(n_samples):
        if rate != 0.0:
            scale = math.sqrt(max(1.0 + rate * (k + 0.5) * dt, 1e-6))
            for r in range(n):
                changed[r] = omega[r] * scale
            propagators(changed, c, h, e)
        if k == 0 or rate != 0.0:
            for i in range(n_elements):
                for j in range(n_elements):
                    aw[i, j] = 0.0
                    av[i, j] = 0.0
                    for r in range(n):
                        aw[i, j] += shapes[i, r] * e[r, 0, 3] * shapes[j, r]
                        av[i, j] += shapes[i, r] * e[r, 1, 3] * shapes[j, r]
        for r in range(n):
            q_out[r, k] = q[r]
            v_out[r, k] = v[r]
            f_out[r, k] = old[r]
        if k == n_samples - 1:
            break
        for sub in range(n_sub):
            for r in range(n):
                total = 0.0
                for j in range(participation.shape[1]):
                    total += participation[r, j] * forces[j, k * n_sub + sub]
                drive[r] = total
                base_q[r] = e[r, 0, 0] * q[r] + e[r, 0, 1] * v[r] + e[r, 0, 2] * old[r]
                base_v[r] = e[r, 1, 0] * q[r] + e[r, 1, 1] * v[r] + e[r, 1, 2] * old[r]
                base_q[r] += (e[r, 0, 2] + e[r, 0, 3]) * total
                base_v[r] += (e[r, 1, 2] + e[r, 1, 3]) * total
            passes = 2 if distributed else 1
            for sweep in range(passes):
                if n_elements == 1:
                    w0, v0 = 0.0, 0.0
                    for r in range(n):
                        w0 += shapes[0, r] * (base_q[r] + e[r, 0, 3] * spread[r])
                        v0 += shapes[0, r] * (base_v[r] + e[r, 1, 3] * spread[r])
                    point[0] = solve_element(
                        kinds[0], parameters[0], w0, v0, aw[0, 0], av[0, 0], z[0], w_old[0], point[0]
                    )
                else:
                    for i in range(n_elements):
                        w0, v0 = 0.0, 0.0
                        for r in range(n):
                            w0 += shapes[i, r] * (base_q[r] + e[r, 0, 3] * spread[r])
                            v0 += shapes[i, r] * (base_v[r] + e[r, 1, 3] * spread[r])
                        w_free[i], v_free[i] = w0, v0
                    for _ in range(12 if n_elements > 1 else 0):
                        largest = 0.0
                        for i in range(n_elements):
                            w0, v0 = w_free[i], v_free[i]
                            for j in range(n_elements):
                                if j != i:
                                    w0 += aw[i, j] * point[j]
                                    v0 += av[i, j] * point[j]
                            f = solve_element(
                                kinds[i], parameters[i], w0, v0, aw[i, i], av[i, i], z[i], w_old[i], point[i]
                            )
                            largest = max(largest, abs(f - point[i]) / (abs(f) + 1e-30))
                            point[i] = f
                        if largest < 1e-10:
                            break
                for r in range(n):
                    total = spread[r]
                    for i in range(n_elements):
                        total += shapes[i, r] * point[i]
                    new[r] = total
                if distributed and sweep < passes - 1:
                    # the forces that depend on the whole shape, from the motion just predicted
                    for r in range(n):
                        q[r] = base_q[r] + e[r, 0, 3] * new[r]
                        v[r] = base_v[r] + e[r, 1, 3] * new[r]
                        if sweep == 0:
                            spread_old[r] = 0.0
                    if stretch != 0.0:
                        tension = 0.0
                        for r in range(n):
                            changed_r = 0.0
                            for s in range(n):
                                changed_r += stretching[r, s] * q[s]
                            spread_old[r] = changed_r
                            tension += q[r] * changed_r
                        for r in range(n):
                            spread_old[r] *= -stretch * tension
                    for g in range(drag_weights.size):
                        speed = 0.0
                        for r in range(n):
                            speed += drag_shapes[g, r] * v[r]
                        push = -drag_weights[g] * abs(speed) * speed
                        for r in range(n):
                            spread_old[r] += drag_shapes[g, r] * push
                    if coupling.size > 0:
                        for r in range(n):
                            for s in range(n):
                                spread_old[r] -= coupling[r, s] * v[s]
                    for r in range(n):
                        spread[r] = spread_old[r]
            for r in range(n):
                q[r] = base_q[r] + e[r, 0, 3] * new[r]
                v[r] = base_v[r] + e[r, 1, 3] * new[r]
                old[r] = new[r]
            for i in range(n_elements):
                w = 0.0
                for r in range(n):
                    w += shapes[i, r] * q[r]
                if kinds[i] == BOUC_WEN:
                    z[i], _ = _yield_update(z[i], w - w_old[i], parameters[i, 1])
                w_old[i] = w


def make_stepper(law):
    """`step_record` with force(w, v, parameters) = `law` for the elements of kind USER, compiled for it."""
    scope = dict(globals(), user_law=njit(nogil=True)(law))
    for name in ("element_force", "solve_element", "step_record"):
        scope[name] = njit(nogil=True)(FunctionType(globals()[name].py_func.__code__, scope, name))
    return scope["step_record"]
