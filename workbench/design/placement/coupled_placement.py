"""Where the actuators of coupled LQR should stand: its forces depend on the places, so every place is a new design.

W_R = ½ Σ_r |b_rᵀ F(iω_r)|² with F(s) = -K (s - A + B K)⁻¹ x0. Of many designs at once, the stable half (X1, X2, Λ) of
the Hamiltonian's eigenvectors is the closed loop itself: F(t) = -R⁻¹ Bᵀ X2 e^{Λt} X1⁻¹ x0.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, solve_continuous_are
from scipy.optimize import OptimizeResult, minimize

from workbench.arrays import Floats, Integers
from workbench.design.laws.law import DesignError, Law, weighed_states
from workbench.design.laws.moments import settled_moments
from workbench.design.loop.peak import largest
from workbench.design.placement.limits import Limits
from workbench.design.placement.task import Placement, check_uncoupled
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes, modal_state_matrix
from workbench.structure.printed import counted
from workbench.threads import one_blas_thread

DRAWN, LOOKED_AT = 2_000, 300
ON_THE_AXIS = 1e-7  # of the largest |pole|: nearer, a loop does not count as stable


@one_blas_thread
def place_coupled(
    modes: Modes,
    n_controlled: int,
    n_actuators: int,
    *,
    impulse_at: float,
    weight: float,
    limits: Limits,
    starts: int = 5,
    seed: int = 0,
) -> Placement:
    """Places of least W_R for coupled LQR under limits: the best of many draws, each polished by Nelder and Mead.

    Args:
        modes, n_controlled, impulse_at, weight: as for `coupled_costs`.
        n_actuators: any number.
        limits: to keep to.
        starts: best draws to polish.
        seed: of the draws.

    Raises:
        DesignError: fewer actuators than rigid modes controlled, or limits that no draw can meet.
    """
    if not 1 <= n_controlled < modes.n_modes:
        raise DesignError(f"{n_controlled} of {modes.n_modes} modes controlled leaves no residual mode to spill into")
    if not weight > 0:
        raise DesignError(f"the control weight R must be positive; got {weight:g}")
    rigid = int((modes.omega[:n_controlled] == 0).sum())
    if n_actuators < rigid:
        raise DesignError(
            f"{rigid} rigid-body modes are controlled, and {counted(n_actuators, 'actuator')} cannot move them one by"
            " one, wherever placed; place as many actuators"
        )
    stretches = limits.intervals(n_actuators, modes.length)

    def look(positions: np.ndarray) -> tuple[float, Placement | None]:
        """log W_R and a wall where a limit is broken."""
        at = np.sort(positions)
        standing = all(any(low <= x <= high for low, high in stretches) for x in at)
        if not standing or (np.diff(at) < limits.spacing).any():
            return np.inf, None
        found = coupled_costs(modes, n_controlled, at, impulse_at=impulse_at, weight=weight)
        within = (
            found.effort <= limits.effort
            and found.peak_force <= limits.peak_force
            and found.condition <= limits.condition
        )
        return (np.log(found.residual_work) if within and found.residual_work > 0 else np.inf), found

    rng = np.random.default_rng(seed)
    draws = [modes.length * np.arange(1, n_actuators + 1) / (n_actuators + 1)]
    draws += list(np.sort(rng.uniform(0.01, 0.99, (DRAWN, n_actuators)) * modes.length, axis=1))
    work, effort = coupled_batch(modes, n_controlled, np.array(draws), impulse_at=impulse_at, weight=weight)
    ends: list[OptimizeResult] = []
    for i in np.argsort(np.where(effort <= limits.effort, work, np.inf))[:LOOKED_AT]:
        if len(ends) < starts and effort[i] <= limits.effort and np.isfinite(look(draws[i])[0]):
            options = {"maxfev": 250 * n_actuators, "xatol": 1e-6 * modes.length, "fatol": 1e-9}
            ends.append(minimize(lambda x: look(x)[0], draws[i], method="Nelder-Mead", options=options))
    if not ends:
        lower = " or lower the spacing" * (limits.spacing > 0)
        raise DesignError(f"no place drawn keeps the limits of coupled LQR; raise them{lower}")
    best = min(ends, key=lambda end: end.fun)
    found = coupled_costs(modes, n_controlled, best.x, impulse_at=impulse_at, weight=weight)
    optima = tuple(sorted(((np.sort(e.x), float(np.exp(e.fun))) for e in ends), key=lambda pair: pair[1]))
    return replace(found, status=str(best.message), local_optima=optima)


def coupled_costs(
    modes: Modes, n_controlled: int, positions: ArrayLike, *, impulse_at: float, weight: float, impulse: float = 1.0
) -> Placement:
    """Residual work and effort of coupled LQR with force actuators at the positions; infinite where it is unstable.

    Effort and peak force are those of the law, the modes' own damping included; W_R is the work on residual modes as if
    these had none.

    Args:
        modes: controlled first, then residual, which are at rest at first.
        n_controlled: how many; any number of actuators.
        impulse_at: place of the impulse (N s).
        weight: R of the actuator forces.

    Raises:
        DesignError: damping that couples the modes.
    """
    positions = np.sort(np.asarray(positions, float))
    n, m = n_controlled, positions.size
    shapes = modes.phi(positions).T
    states, a, scale = _weighed(modes, n)
    b = np.vstack([np.zeros((n, m)), shapes[:n]])[states]
    start = np.r_[np.zeros(n), impulse * modes.phi(impulse_at)[0, :n]][states]
    try:
        p = solve_continuous_are(a, b, np.eye(len(a)), weight * np.eye(m))
    except (LinAlgError, ValueError):
        return _impossible(positions, modes.n_modes - n)
    gain, whole = b.T @ p / weight, np.zeros((m, 2 * n))
    whole[:, states] = gain * scale
    loop = a - b @ gain
    values, vectors = np.linalg.eig(loop)
    if not values.real.max() < -ON_THE_AXIS * np.abs(values).max():
        return _impossible(positions, modes.n_modes - n)
    held = np.linalg.solve(vectors, start.astype(complex))
    force = -(gain @ vectors) * held @ (1.0 / (1j * modes.omega[None, n:] - values[:, None]))
    by_mode = 0.5 * np.abs(np.einsum("rj,jr->r", shapes[n:], force)) ** 2
    gramian = settled_moments(loop, start)
    return Placement(
        positions=positions,
        law=Law(whole, tuple(range(n)), forces_at(positions), "coupled LQR"),
        residual_work=float(by_mode.sum()),
        by_mode=by_mode,
        effort=float(np.trace(gain @ gramian @ gain.T)),
        peak_force=largest(values, (gain @ vectors) * held, np.inf),
        condition=float(np.linalg.norm(np.linalg.pinv(shapes[:n])) * np.linalg.norm(shapes[:n])),
        status="coupled LQR",
    )


def _weighed(modes: Modes, n: int) -> tuple[Integers, Floats, Floats]:
    """The states whose motion costs anything, A of ω q and q' of these, and what takes the states to them.

    Their squares are the cost, and they are of like size at any frequency. A rigid mode's displacement costs nothing.
    """
    check_uncoupled(modes)
    omega = modes.omega[:n]
    states, scale = weighed_states(omega), np.r_[omega, np.ones(n)]
    a = modal_state_matrix(omega**2, modes.damping[:n, :n])[np.ix_(states, states)]
    return states, a * scale[states, None] / scale[states], scale[states]


def forces_at(positions: np.ndarray) -> tuple[Actuator, ...]:
    """Point forces F1, F2, ... at the places (n_actuators,), m."""
    return tuple(Actuator(f"F{i + 1}", float(x)) for i, x in enumerate(positions))


def _impossible(positions: np.ndarray, n_residual: int) -> Placement:
    inf = np.inf
    return Placement(positions, None, inf, np.full(n_residual, inf), inf, inf, inf, "no regulator stabilises from here")


def coupled_batch(
    modes: Modes, n_controlled: int, positions: np.ndarray, *, impulse_at: float, weight: float, impulse: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """W_R and effort (n_placements,) of coupled LQR at many placements (n_placements, n_actuators).

    Infinite where no regulator stabilises.

    Raises:
        DesignError: damping that couples the modes.
    """
    n, count = n_controlled, len(positions)
    shapes = modes.phi(positions.ravel()).reshape(*positions.shape, modes.n_modes)
    states, a, _ = _weighed(modes, n)
    size = len(states)
    b = np.zeros((count, size, positions.shape[1]))
    b[:, size - n :] = shapes[:, :, :n].transpose(0, 2, 1)
    hamiltonian = np.zeros((count, 2 * size, 2 * size))
    hamiltonian[:, :size, :size], hamiltonian[:, size:, size:] = a, -a.T
    hamiltonian[:, :size, size:] = -b @ b.transpose(0, 2, 1) / weight
    hamiltonian[:, size:, :size] = -np.eye(size)
    values, vectors = np.linalg.eig(hamiltonian)
    stable = np.argsort(values.real, axis=1)[:, :size]
    poles = np.take_along_axis(values, stable, axis=1)
    vectors = np.take_along_axis(vectors, stable[:, None, :], axis=2)
    start = np.r_[np.zeros(n), impulse * modes.phi(impulse_at)[0, :n]][states].astype(complex)
    works = poles.real.max(axis=1) < -ON_THE_AXIS * modes.omega[n - 1]
    upper = np.where(works[:, None, None], vectors[:, :size], np.eye(size))
    held = np.linalg.solve(upper, np.broadcast_to(start[:, None], (count, size, 1)))[:, :, 0]
    amplitudes = -(b.transpose(0, 2, 1) @ vectors[:, size:]) * held[:, None, :] / weight
    force = amplitudes @ (1.0 / (1j * modes.omega[n:] - poles[:, :, None]))
    work = 0.5 * (np.abs(np.einsum("par,par->pr", shapes[:, :, n:], force)) ** 2).sum(axis=1)
    decay = np.where(works[:, None, None], -(poles.conj()[:, :, None] + poles[:, None, :]), 1.0)
    effort = np.einsum("pak,pkl,pal->p", amplitudes.conj(), 1.0 / decay, amplitudes, optimize=True).real
    return np.where(works, work, np.inf), np.where(works, effort, np.inf)
