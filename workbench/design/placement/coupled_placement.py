"""Placement of actuators for coupled LQR, whose forces depend on the places, so that every placement is a new design.

W_R = ½ Σ_r |b_rᵀ F(iω_r)|² with F(s) = -K (s - A + B K)⁻¹ x0. Many designs are computed at once from the stable
eigenvectors and eigenvalues (X1, X2, Λ) of the Hamiltonian: F(t) = -R⁻¹ Bᵀ X2 e^{Λt} X1⁻¹ x0.
"""

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, solve_continuous_are
from scipy.optimize import OptimizeResult, minimize

from workbench.arrays import Floats, Integers
from workbench.design.laws.law import DesignError, Law, weighed_states
from workbench.design.loop.peak import largest
from workbench.design.placement.limits import BOUNDED, Limits
from workbench.design.placement.places import free_places, least_distances
from workbench.design.placement.task import Placement, check_residual, check_uncoupled
from workbench.design.spillover.performance import check_weight
from workbench.design.spillover.spillover import settled_moments
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes, modal_state_matrix
from workbench.structure.printed import counted
from workbench.threads import one_blas_thread

DRAWN, LOOKED_AT = 2_000, 300  # random placements, and how many of the best are tried as starts
SCANNED = 2_000  # placements of a scan computed at once
ON_THE_AXIS = 1e-7  # of the largest |pole|: a loop whose poles are nearer to the axis does not count as stable


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
    """Places of least W_R for coupled LQR under limits, by Nelder-Mead searches from the best of random placements.

    Args:
        modes, n_controlled, impulse_at, weight: as for `coupled_costs`.
        n_actuators: any number.
        limits: of the placement.
        starts: number of searches.
        seed: of the random placements.

    Raises:
        DesignError: fewer actuators than rigid modes controlled, or limits that no random placement meets.
    """
    check_residual(modes, n_controlled)
    check_weight(weight)
    rigid = int((modes.omega[:n_controlled] == 0).sum())
    if n_actuators < rigid:
        raise DesignError(
            f"{rigid} rigid-body modes are controlled, and {counted(n_actuators, 'actuator')} cannot control them"
            f" independently; place at least {rigid} actuators"
        )
    intervals = limits.intervals(n_actuators, modes.length)

    def objective(positions: np.ndarray) -> float:
        """log W_R; inf where a limit is exceeded."""
        at = np.sort(positions)
        allowed = all(any(low <= x <= high for low, high in intervals) for x in at)
        if not allowed or (np.diff(at) < limits.spacing).any():
            return np.inf
        placement = coupled_costs(modes, n_controlled, at, impulse_at=impulse_at, weight=weight)
        within = all(getattr(placement, name) <= getattr(limits, name) for name in BOUNDED)
        return float(np.log(placement.residual_work)) if within and placement.residual_work > 0 else np.inf

    rng = np.random.default_rng(seed)
    draws = [modes.length * np.arange(1, n_actuators + 1) / (n_actuators + 1)]
    draws += list(np.sort(rng.uniform(0.01, 0.99, (DRAWN, n_actuators)) * modes.length, axis=1))
    work, effort = coupled_batch(modes, n_controlled, np.array(draws), impulse_at=impulse_at, weight=weight)
    ends: list[OptimizeResult] = []
    for i in np.argsort(np.where(effort <= limits.effort, work, np.inf))[:LOOKED_AT]:
        if len(ends) < starts and effort[i] <= limits.effort and np.isfinite(objective(draws[i])):
            options = {"maxfev": 250 * n_actuators, "xatol": 1e-6 * modes.length, "fatol": 1e-9}
            ends.append(minimize(objective, draws[i], method="Nelder-Mead", options=options))
    if not ends:
        lower = " or lower the spacing" * (limits.spacing > 0)
        raise DesignError(f"no random placement meets the limits with coupled LQR; raise the limits{lower}")
    best = min(ends, key=lambda end: end.fun)
    placement = coupled_costs(modes, n_controlled, best.x, impulse_at=impulse_at, weight=weight)
    optima = tuple(sorted(((np.sort(e.x), float(np.exp(e.fun))) for e in ends), key=lambda pair: pair[1]))
    return replace(placement, status=str(best.message), local_optima=optima)


def coupled_costs(
    modes: Modes, n_controlled: int, positions: ArrayLike, *, impulse_at: float, weight: float
) -> Placement:
    """The placement of coupled LQR with force actuators at the positions, and its costs; infinite where it is unstable.

    Effort and peak force include the damping of the controlled modes; W_R is that of undamped residual modes.

    Args:
        modes: controlled first, then residual, at rest initially.
        n_controlled: number of controlled modes.
        positions: (n_actuators,) m; any number.
        impulse_at: place of the impulse of 1 N s.
        weight: R of the actuator forces.
    """
    positions = np.sort(np.asarray(positions, float))
    n, m = n_controlled, positions.size
    shapes = modes.phi(positions).T
    states, a, scale = _scaled_states(modes, n)
    b = np.vstack([np.zeros((n, m)), shapes[:n]])[states]
    start = np.r_[np.zeros(n), modes.phi(impulse_at)[0, :n]][states]
    try:
        p = solve_continuous_are(a, b, np.eye(len(a)), weight * np.eye(m))
    except (LinAlgError, ValueError):
        return _infeasible(positions, modes.n_modes - n)
    gain, full_gain = b.T @ p / weight, np.zeros((m, 2 * n))
    full_gain[:, states] = gain * scale
    loop = a - b @ gain
    values, vectors = np.linalg.eig(loop)
    if not values.real.max() < -ON_THE_AXIS * np.abs(values).max():
        return _infeasible(positions, modes.n_modes - n)
    coefficients = np.linalg.solve(vectors, start.astype(complex))
    force = -(gain @ vectors) * coefficients @ (1.0 / (1j * modes.omega[None, n:] - values[:, None]))
    by_mode = 0.5 * np.abs(np.einsum("rj,jr->r", shapes[n:], force)) ** 2
    gramian = settled_moments(loop, start)
    actuators = tuple(Actuator(f"F{i + 1}", float(x)) for i, x in enumerate(positions))
    return Placement(
        positions=positions,
        law=Law(full_gain, tuple(range(n)), actuators, "coupled LQR"),
        residual_work=float(by_mode.sum()),
        residual_work_by_mode=by_mode,
        effort=float(np.trace(gain @ gramian @ gain.T)),
        peak_force=largest(values, (gain @ vectors) * coefficients, np.inf),
        condition=float(np.linalg.norm(np.linalg.pinv(shapes[:n])) * np.linalg.norm(shapes[:n])),
        status="coupled LQR",
    )


def _scaled_states(modes: Modes, n: int) -> tuple[Integers, Floats, Floats]:
    """Indices of the states that cost anything, A of the scaled states ω q and q', and the scale of each.

    The squares of the scaled states are the cost. The displacement of a rigid mode costs nothing and is left out.
    """
    check_uncoupled(modes)
    omega = modes.omega[:n]
    states, scale = weighed_states(omega), np.r_[omega, np.ones(n)]
    a = modal_state_matrix(omega**2, modes.damping[:n, :n])[np.ix_(states, states)]
    return states, a * scale[states, None] / scale[states], scale[states]


def _infeasible(positions: np.ndarray, n_residual: int) -> Placement:
    inf = np.inf
    return Placement(positions, None, inf, np.full(n_residual, inf), inf, inf, inf, "no regulator stabilises from here")


def coupled_batch(
    modes: Modes, n_controlled: int, positions: np.ndarray, *, impulse_at: float, weight: float
) -> tuple[np.ndarray, np.ndarray]:
    """W_R and effort (n_placements,) of coupled LQR at many placements (n_placements, n_actuators), m.

    Both are infinite where no regulator stabilises.
    """
    n, count = n_controlled, len(positions)
    shapes = modes.phi(positions.ravel()).reshape(*positions.shape, modes.n_modes)
    states, a, _ = _scaled_states(modes, n)
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
    start = np.r_[np.zeros(n), modes.phi(impulse_at)[0, :n]][states].astype(complex)
    stabilised = poles.real.max(axis=1) < -ON_THE_AXIS * modes.omega[n - 1]
    upper = np.where(stabilised[:, None, None], vectors[:, :size], np.eye(size))
    coefficients = np.linalg.solve(upper, np.broadcast_to(start[:, None], (count, size, 1)))[:, :, 0]
    amplitudes = -(b.transpose(0, 2, 1) @ vectors[:, size:]) * coefficients[:, None, :] / weight
    force = amplitudes @ (1.0 / (1j * modes.omega[n:] - poles[:, :, None]))
    work = 0.5 * (np.abs(np.einsum("par,par->pr", shapes[:, :, n:], force)) ** 2).sum(axis=1)
    decay = np.where(stabilised[:, None, None], -(poles.conj()[:, :, None] + poles[:, None, :]), 1.0)
    effort = np.einsum("pak,pkl,pal->p", amplitudes.conj(), 1.0 / decay, amplitudes, optimize=True).real
    return np.where(stabilised, work, np.inf), np.where(stabilised, effort, np.inf)


@dataclass(frozen=True, eq=False)
class CoupledScan:
    """All placements on a grid.

    Attributes:
        best: of those that meet the limits.
        tried: number of placements.
        lower_bound: of W_R anywhere if √W_R and √effort change no faster between the grid's placements than from one
            to the next; an estimate, not a proof.
    """

    best: Placement
    tried: int
    lower_bound: float


@one_blas_thread
def scan_coupled(
    modes: Modes,
    n_controlled: int,
    n_actuators: int,
    *,
    impulse_at: float,
    weight: float,
    limits: Limits,
    n_places: int = 60,
) -> CoupledScan:
    """The best of all placements on a uniform grid over the length for coupled LQR.

    Args:
        modes, n_controlled, n_actuators, impulse_at, weight, limits: as for `place_coupled`.
        n_places: of the grid; the number of placements grows as n_places to the power n_actuators.

    Raises:
        DesignError: limits that no placement on the grid meets.
    """
    length, settings = modes.length, {"impulse_at": impulse_at, "weight": weight}
    intervals = limits.intervals(n_actuators, length)
    step = length / n_places
    grid = step * (0.5 + np.arange(n_places))
    index = np.array(list(combinations_with_replacement(range(n_places), n_actuators)))
    parts = np.array_split(index, max(1, len(index) // SCANNED))
    costs = [coupled_batch(modes, n_controlled, grid[part], **settings) for part in parts]
    work, effort = (np.concatenate(each) for each in zip(*costs))
    at = grid[index]
    gaps = least_distances(at)
    allowed = free_places(modes.domain, grid, intervals)[index].all(axis=1) & (gaps >= limits.spacing)
    rated = np.where(allowed & (effort <= limits.effort), work, np.inf)
    by_work = (i for i in np.argsort(rated) if np.isfinite(rated[i]))
    placements = (coupled_costs(modes, n_controlled, at[i], **settings) for i in by_work)
    best = next(filter(limits.satisfied_by, placements), None)
    if best is None:
        raise DesignError(f"none of {allowed.sum()} placements on the grid meets the limits; raise them")
    widened = [(low - step / 2, high + step / 2) for low, high in intervals]
    near = free_places(modes.domain, grid, widened)[index].all(axis=1)
    near &= gaps + step >= limits.spacing
    near &= _least(index, np.sqrt(effort), n_places) <= np.sqrt(limits.effort)
    bound = np.maximum(_least(index, np.sqrt(work), n_places), 0.0)[near].min() ** 2
    return CoupledScan(best, int(allowed.sum()), float(min(bound, best.residual_work)))


def _least(index: Integers, values: Floats, n_places: int) -> Floats:
    """Extrapolated lower bound of each value half-way to its neighbours, all actuators moved at once."""
    field = np.full((n_places,) * index.shape[1], np.nan)
    field[tuple(index.T)] = np.where(np.isfinite(values), values, np.nan)
    fall = np.zeros(field.shape)
    for axis in range(field.ndim):
        change = np.nan_to_num(np.abs(np.diff(field, axis=axis, prepend=np.nan, append=np.nan)))
        fall += 0.5 * np.maximum(np.delete(change, 0, axis), np.delete(change, -1, axis))
    return np.asarray(values - fall[tuple(index.T)])
