"""Where the actuators of coupled LQR should stand: its forces depend on the places, so every place is a new design.

W_R = ½ Σ_r |b_rᵀ F(iω_r)|² with F(s) = -K (s - A + B K)⁻¹ x0, sought without derivatives.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, solve_continuous_are, solve_continuous_lyapunov
from scipy.optimize import minimize

from workbench.design.law import DesignError
from workbench.design.limits import Limits
from workbench.design.peak import largest
from workbench.design.placement_task import Placement
from workbench.structure.modes import Modes

DRAWN = 150


def coupled_figures(
    modes: Modes, n_controlled: int, positions: ArrayLike, *, impulse_at: float, weight: float, impulse: float = 1.0
) -> Placement:
    """What coupled LQR spills and spends with force actuators at the positions; infinite where it cannot be.

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
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(omega**2), np.zeros((n, n))]])
    b = np.vstack([np.zeros((n, m)), shapes[:n]])
    start = np.r_[np.zeros(n), impulse * modes.phi(impulse_at)[0, :n]]
    try:
        p = solve_continuous_are(a, b, np.diag(np.r_[omega**2, np.ones(n)]), weight * np.eye(m))
    except (LinAlgError, ValueError):
        return _impossible(positions, modes.n_modes - n)
    gain = b.T @ p / weight
    loop = a - b @ gain
    values, vectors = np.linalg.eig(loop)
    if not values.real.max() < 0:
        return _impossible(positions, modes.n_modes - n)
    held = np.linalg.solve(vectors, start.astype(complex))
    force = -(gain @ vectors) * held @ (1.0 / (1j * modes.omega[None, n:] - values[:, None]))
    by_mode = 0.5 * np.abs(np.einsum("rj,jr->r", shapes[n:], force)) ** 2
    gramian = solve_continuous_lyapunov(loop, -np.outer(start, start))
    return Placement(
        positions=positions,
        residual_work=float(by_mode.sum()),
        by_mode=by_mode,
        effort=float(np.trace(gain @ gramian @ gain.T)),
        peak_force=largest(values, (gain @ vectors) * held, np.inf),
        condition=float(np.linalg.norm(np.linalg.pinv(shapes[:n])) * np.linalg.norm(shapes[:n])),
        status="coupled LQR",
    )


def _impossible(positions: np.ndarray, n_residual: int) -> Placement:
    inf = np.inf
    return Placement(positions, inf, np.full(n_residual, inf), inf, inf, inf, "no regulator stabilises from here")


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
        modes, n_controlled, impulse_at, weight: as for `coupled_figures`.
        n_actuators: any number.
        limits: to keep to.
        starts: best draws to polish.
        seed: of the draws.

    Raises:
        DesignError: limits that no draw can meet.
    """
    if not 1 <= n_controlled < modes.n_modes:
        raise DesignError(f"{n_controlled} of {modes.n_modes} modes controlled leaves no residual mode to spill into")
    if not weight > 0:
        raise DesignError(f"the control weight R must be positive; got {weight:g}")
    stretches = limits.allowed(modes.length)

    def look(positions: np.ndarray) -> tuple[float, Placement | None]:
        """log W_R and a wall where a limit is broken."""
        at = np.sort(positions)
        standing = all(any(low <= x <= high for low, high in stretches) for x in at)
        if not standing or (np.diff(at) < limits.spacing).any():
            return np.inf, None
        found = coupled_figures(modes, n_controlled, at, impulse_at=impulse_at, weight=weight)
        within = (
            found.effort <= limits.effort
            and found.peak_force <= limits.peak_force
            and found.condition <= limits.condition
        )
        return (np.log(found.residual_work) if within and found.residual_work > 0 else np.inf), found

    rng = np.random.default_rng(seed)
    draws = [modes.length * np.arange(1, n_actuators + 1) / (n_actuators + 1)]
    draws += list(np.sort(rng.uniform(0.01, 0.99, (DRAWN, n_actuators)) * modes.length, axis=1))
    ranked = sorted(((look(x)[0], i) for i, x in enumerate(draws)))
    if not np.isfinite(ranked[0][0]):
        raise DesignError("no place drawn keeps the limits of coupled LQR; raise them or lower the spacing")
    ends = []
    for value, i in ranked[:starts]:
        if np.isfinite(value):
            options = {"maxfev": 250 * n_actuators, "xatol": 1e-6 * modes.length, "fatol": 1e-9}
            ends.append(minimize(lambda x: look(x)[0], draws[i], method="Nelder-Mead", options=options))
    best = min(ends, key=lambda end: end.fun)
    found = coupled_figures(modes, n_controlled, best.x, impulse_at=impulse_at, weight=weight)
    optima = tuple(sorted(((np.sort(e.x), float(np.exp(e.fun))) for e in ends), key=lambda pair: pair[1]))
    return Placement(
        **{name: getattr(found, name) for name in ("positions", "residual_work", "by_mode", "effort", "peak_force")},
        condition=found.condition,
        status=str(best.message),
        local_optima=optima,
    )
