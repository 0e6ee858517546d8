"""Residual work and effort of coupled LQR by the places of its actuators: its forces depend on them.

W_R = ½ Σ_r |b_rᵀ F(iω_r)|² with F(s) = -K (s - A + B K)⁻¹ x0. Of many designs at once, the stable half (X1, X2, Λ) of
the Hamiltonian's eigenvectors is the closed loop itself: F(t) = -R⁻¹ Bᵀ X2 e^{Λt} X1⁻¹ x0.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, solve_continuous_are, solve_continuous_lyapunov

from workbench.design.laws.law import Law
from workbench.design.placement.peak import largest
from workbench.design.placement.task import Placement
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes, modal_state_matrix

ON_THE_AXIS = 1e-7


def coupled_costs(
    modes: Modes, n_controlled: int, positions: ArrayLike, *, impulse_at: float, weight: float, impulse: float = 1.0
) -> Placement:
    """Residual work and effort of coupled LQR with force actuators at the positions; infinite where it is unstable.

    Args:
        modes: controlled first, then residual; undamped, residual ones at rest at first.
        n_controlled: how many; any number of actuators.
        impulse_at: place of the impulse (N s).
        weight: R of the actuator forces.
    """
    positions = np.sort(np.asarray(positions, float))
    n, m = n_controlled, positions.size
    shapes = modes.phi(positions).T
    omega = modes.omega[:n]
    a = modal_state_matrix(omega**2, np.zeros(n))
    b = np.vstack([np.zeros((n, m)), shapes[:n]])
    start = np.r_[np.zeros(n), impulse * modes.phi(impulse_at)[0, :n]]
    try:
        p = solve_continuous_are(a, b, np.diag(np.r_[omega**2, np.ones(n)]), weight * np.eye(m))
    except (LinAlgError, ValueError):
        return _impossible(positions, modes.n_modes - n)
    gain = b.T @ p / weight
    loop = a - b @ gain
    values, vectors = np.linalg.eig(loop)
    if not values.real.max() < -ON_THE_AXIS * np.abs(values).max():
        return _impossible(positions, modes.n_modes - n)
    held = np.linalg.solve(vectors, start.astype(complex))
    force = -(gain @ vectors) * held @ (1.0 / (1j * modes.omega[None, n:] - values[:, None]))
    by_mode = 0.5 * np.abs(np.einsum("rj,jr->r", shapes[n:], force)) ** 2
    gramian = solve_continuous_lyapunov(loop, -np.outer(start, start))
    return Placement(
        positions=positions,
        law=Law(gain, tuple(range(n)), forces_at(positions), "coupled LQR"),
        residual_work=float(by_mode.sum()),
        by_mode=by_mode,
        effort=float(np.trace(gain @ gramian @ gain.T)),
        peak_force=largest(values, (gain @ vectors) * held, np.inf),
        condition=float(np.linalg.norm(np.linalg.pinv(shapes[:n])) * np.linalg.norm(shapes[:n])),
        status="coupled LQR",
    )


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
    """
    n, count = n_controlled, len(positions)
    shapes = modes.phi(positions.ravel()).reshape(*positions.shape, modes.n_modes)
    omega = modes.omega[:n]
    a = modal_state_matrix(omega**2, np.zeros(n))
    b = np.zeros((count, 2 * n, positions.shape[1]))
    b[:, n:] = shapes[:, :, :n].transpose(0, 2, 1)
    hamiltonian = np.zeros((count, 4 * n, 4 * n))
    hamiltonian[:, : 2 * n, : 2 * n], hamiltonian[:, 2 * n :, 2 * n :] = a, -a.T
    hamiltonian[:, : 2 * n, 2 * n :] = -b @ b.transpose(0, 2, 1) / weight
    hamiltonian[:, 2 * n :, : 2 * n] = -np.diag(np.r_[omega**2, np.ones(n)])
    values, vectors = np.linalg.eig(hamiltonian)
    stable = np.argsort(values.real, axis=1)[:, : 2 * n]
    poles = np.take_along_axis(values, stable, axis=1)
    vectors = np.take_along_axis(vectors, stable[:, None, :], axis=2)
    start = np.r_[np.zeros(n), impulse * modes.phi(impulse_at)[0, :n]].astype(complex)
    works = poles.real.max(axis=1) < -ON_THE_AXIS * omega.max()
    upper = np.where(works[:, None, None], vectors[:, : 2 * n], np.eye(2 * n))
    held = np.linalg.solve(upper, np.broadcast_to(start[:, None], (count, 2 * n, 1)))[:, :, 0]
    amplitudes = -(b.transpose(0, 2, 1) @ vectors[:, 2 * n :]) * held[:, None, :] / weight
    force = amplitudes @ (1.0 / (1j * modes.omega[n:] - poles[:, :, None]))
    work = 0.5 * (np.abs(np.einsum("par,par->pr", shapes[:, :, n:], force)) ** 2).sum(axis=1)
    decay = np.where(works[:, None, None], -(poles.conj()[:, :, None] + poles[:, None, :]), 1.0)
    effort = np.einsum("pak,pkl,pal->p", amplitudes.conj(), 1.0 / decay, amplitudes, optimize=True).real
    return np.where(works, work, np.inf), np.where(works, effort, np.inf)
