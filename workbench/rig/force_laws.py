"""Force laws of elements at points, compiled, and their solution at the end of a substep."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, njit, types  # type: ignore[attr-defined]
from numba.extending import intrinsic

from workbench.arrays import Floats, Integers
from workbench.rig import elements

LINEAR_SPRING, LINEAR_DAMPER, CUBIC, POWER_SPRING, EVEN_SPRING, POWER_DAMPER = range(6)
CLEARANCE, ONE_SIDED, FRICTION, BOUC_WEN, USER = range(6, 11)
LAWS: dict[type[elements.PointElement], int] = {
    elements.LinearSpring: LINEAR_SPRING,
    elements.LinearDamper: LINEAR_DAMPER,
    elements.CubicSpring: CUBIC,
    elements.PowerSpring: POWER_SPRING,
    elements.EvenSpring: EVEN_SPRING,
    elements.PowerDamper: POWER_DAMPER,
    elements.Clearance: CLEARANCE,
    elements.OneSidedStop: ONE_SIDED,
    elements.CoulombFriction: FRICTION,
    elements.BoucWen: BOUC_WEN,
    elements.UserLaw: USER,
}
Laws = tuple[Integers, Floats]  # kinds (n_elements,) and parameters (n_elements, n_parameters)
N_PARAMETERS = 3  # of a law, at most
SETTLED = 1e-10  # relative tolerance of a force


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
def _solve_one(
    laws: Laws, i: int, w0: float, v0: float, aw: float, av: float, z: float, w_old: float, start: float
) -> float:
    """The force f of element i with f = law(w0 + aw f, v0 + av f): Newton, safeguarded by bisection."""
    kinds, parameters = laws
    f, low, high = start, -math.inf, math.inf
    for _ in range(40):
        value, by_w, by_v = element_force(kinds[i], parameters, i, w0 + aw * f, v0 + av * f, z, w_old)
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
            f_new = 0.5 * (low + high) if low > -math.inf and high < math.inf else value
        if f_new == f:
            break
        f = f_new
    return f


@njit(cache=True, nogil=True)
def _solve_pair(
    laws: Laws, w_free: Floats, v_free: Floats, aw: Floats, av: Floats, z: Floats, w_old: Floats, force: Floats
) -> bool:
    """Solve the forces of two elements in place by Newton's method; False, with the guess, where it diverges."""
    kinds, parameters = laws
    f, g = force[0], force[1]
    for _ in range(6):
        w, v = w_free[0] + aw[0, 0] * f + aw[0, 1] * g, v_free[0] + av[0, 0] * f + av[0, 1] * g
        law_f, f_w, f_v = element_force(kinds[0], parameters, 0, w, v, z[0], w_old[0])
        w, v = w_free[1] + aw[1, 0] * f + aw[1, 1] * g, v_free[1] + av[1, 0] * f + av[1, 1] * g
        law_g, g_w, g_v = element_force(kinds[1], parameters, 1, w, v, z[1], w_old[1])
        off_f, off_g = law_f - f, law_g - g
        if abs(off_f) <= _close(law_f, f) and abs(off_g) <= _close(law_g, g):
            force[0], force[1] = f, g
            return True
        ff, fg = 1.0 - f_w * aw[0, 0] - f_v * av[0, 0], -f_w * aw[0, 1] - f_v * av[0, 1]
        gf, gg = -g_w * aw[1, 0] - g_v * av[1, 0], 1.0 - g_w * aw[1, 1] - g_v * av[1, 1]
        determinant = ff * gg - fg * gf
        # ff and gg are at least 1 for laws that resist the motion; others may have several solutions
        if not (ff > 0.1 and gg > 0.1 and determinant > 0.01):
            break
        f += (gg * off_f - fg * off_g) / determinant
        g += (ff * off_g - gf * off_f) / determinant
    return False


@njit(cache=True, nogil=True)
def _close(one: float, other: float) -> float:
    return SETTLED * (abs(one) + abs(other)) + 1e-300


@njit(cache=True, nogil=True)
def solve_laws(
    laws: Laws, w_free: Floats, v_free: Floats, aw: Floats, av: Floats, z: Floats, w_old: Floats, force: Floats
) -> None:
    """Solve force = law(w_free + aw force, v_free + av force) for the forces (n_elements,), in place from a guess.

    Args:
        laws: see `law_arrays`.
        w_free, v_free: (n_elements,) displacements and velocities without these forces.
        aw, av: (n_elements, n_elements) displacements and velocities per unit force.
        z, w_old: (n_elements,) hysteretic displacements, and displacements, at the start of the substep.
        force: (n_elements,) the guess, and the solution.
    """
    n = force.size
    if n == 1:
        force[0] = _solve_one(laws, 0, w_free[0], v_free[0], aw[0, 0], av[0, 0], z[0], w_old[0], force[0])
        return
    if n == 2 and _solve_pair(laws, w_free, v_free, aw, av, z, w_old, force):
        return
    for _ in range(12):  # one after the other until none changes (Gauss-Seidel)
        largest = 0.0
        for i in range(n):
            w0, v0 = w_free[i], v_free[i]
            for j in range(n):
                if j != i:
                    w0 += aw[i, j] * force[j]
                    v0 += av[i, j] * force[j]
            f = _solve_one(laws, i, w0, v0, aw[i, i], av[i, i], z[i], w_old[i], force[i])
            largest = max(largest, abs(f - force[i]) / (abs(f) + 1e-30))
            force[i] = f
        if largest < SETTLED:
            break


@cache  # kept alive as long as this process
def compiled_law(law: Callable[[float, float, Floats], float]) -> Any:
    """A user-defined force(w, v, parameters) as a compiled function, at its `address` in the memory of this process."""
    compiled = njit(nogil=True)(law)

    def call(w: float, v: float, parameters: Any) -> float:
        force: float = compiled(w, v, carray(parameters, (N_PARAMETERS,)))
        return force

    signature = types.float64(types.float64, types.float64, types.CPointer(types.float64))  # type: ignore[no-untyped-call]
    return cfunc(signature)(call)
