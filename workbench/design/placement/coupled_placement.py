"""Where the actuators of coupled LQR should stand: its forces depend on the places, so every place is a new design."""

from dataclasses import replace

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from workbench.design.laws.law import DesignError
from workbench.design.placement.coupled_spillover import coupled_batch, coupled_costs
from workbench.design.placement.limits import Limits
from workbench.design.placement.task import Placement
from workbench.structure.modes import Modes
from workbench.threads import one_blas_thread

DRAWN, LOOKED_AT = 2_000, 300


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
        DesignError: limits that no draw can meet.
    """
    if not 1 <= n_controlled < modes.n_modes:
        raise DesignError(f"{n_controlled} of {modes.n_modes} modes controlled leaves no residual mode to spill into")
    if not weight > 0:
        raise DesignError(f"the control weight R must be positive; got {weight:g}")
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
        raise DesignError("no place drawn keeps the limits of coupled LQR; raise them or lower the spacing")
    best = min(ends, key=lambda end: end.fun)
    found = coupled_costs(modes, n_controlled, best.x, impulse_at=impulse_at, weight=weight)
    optima = tuple(sorted(((np.sort(e.x), float(np.exp(e.fun))) for e in ends), key=lambda pair: pair[1]))
    return replace(found, status=str(best.message), local_optima=optima)
