"""The number of modes to control, by the energy that remains: that of uncontrolled modes and spillover.

Control of the lowest n modes leaves the disturbance's energy Σ_{r>n} E_r in the others (5.27) and adds the spillover
W_R (5.43). Their sum is the mean over the phase of the residual modes when control starts; at a given phase it differs
by Σ_r Re(conj(q_r' + iω_r q_r) b_rᵀ F(iω_r)).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from workbench.arrays import Floats
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError
from workbench.design.placement.placement import nodes_of_mode
from workbench.design.spillover.spillover import effort, spillover
from workbench.renamed import Renamed, former_arguments
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes, freeze


@dataclass(frozen=True, eq=False)
class ControlledModeCount:
    """The remaining energy of a disturbance when the lowest n modes are controlled.

    Attributes:
        counts: (n_counts,) n; spillover and effort are nan where the actuators of that n cannot be placed.
        energy: (n_modes,) E_r given to each mode by the disturbance, J.
        uncontrolled: (n_counts,) Σ_{r>n} E_r, J.
        spillover: (n_counts,) W_R, J, residual modes at rest when control starts.
        effort: (n_counts,) ∫ FᵀF dt.
        recommended: least n whose remaining energy is within the given share; None where there is none.
        least: n of the least remaining energy.
    """

    counts: np.ndarray
    energy: Floats
    uncontrolled: Floats
    spillover: Floats
    effort: Floats
    recommended: int | None
    least: int

    def __post_init__(self) -> None:
        freeze(self, "energy", "uncontrolled", "spillover", "effort")
        freeze(self, "counts", dtype=int)

    @property
    def residual(self) -> Floats:
        """Mean remaining energy (n_counts,), J: of the uncontrolled modes, plus spillover."""
        return self.uncontrolled + self.spillover

    untouched, spilled, left = Renamed("uncontrolled"), Renamed("spillover"), Renamed("residual")


@former_arguments(most="max_modes")
def controlled_mode_count(
    modes: Modes,
    state: np.ndarray,
    *,
    weight: ArrayLike,
    share: float = 0.05,
    max_modes: int | None = None,
    places: Callable[[int], ArrayLike] | None = None,
) -> ControlledModeCount:
    """The number of modes that IMSC should control.

    Args:
        modes: undamped; enough that the disturbance gives little energy to higher ones.
        state: (2 n_modes,) just after the disturbance, or root mean squares for a random one.
        weight: R of IMSC.
        share: of the disturbance's energy that may remain.
        max_modes: largest n tried; by default half the modes.
        places: of n actuators, m; by default the nodes of mode n+1.

    Raises:
        DesignError: modes with damping, a disturbance that gives no energy, or no n whose actuators can be placed.
    """
    n_modes = modes.n_modes
    if modes.damping.any():
        raise DesignError(
            "the number of controlled modes is chosen without damping, which would take energy from every mode; give"
            " replace(modes, damping=np.zeros_like(modes.damping))"
        )
    energy = 0.5 * (state[n_modes:] ** 2 + (modes.omega * state[:n_modes]) ** 2)
    if not energy.sum() > 0:
        raise DesignError("the disturbance gives no mode any energy, so there is nothing to control")
    counts = np.arange(1, (n_modes // 2 if max_modes is None else max_modes) + 1)
    residual_work, efforts = np.full(counts.size, np.nan), np.full(counts.size, np.nan)
    for i, n in enumerate(counts):
        try:
            at = np.asarray(nodes_of_mode(modes, int(n)) if places is None else places(int(n)), float)
            law = imsc(modes, int(n), [Actuator(f"F{j + 1}", float(x)) for j, x in enumerate(at)], weight=weight)
        except (DesignError, ValueError):
            continue
        start = state.copy()
        start[n:n_modes] = start[n_modes + n :] = 0.0
        residual_work[i], efforts[i] = spillover(modes, law, start).residual_work, effort(modes, law, start)
    uncontrolled = energy.sum() - np.cumsum(energy)[: counts.size]
    remaining = uncontrolled + residual_work
    if not np.isfinite(remaining).any():
        raise DesignError("no number of modes can be controlled from these places; give others")
    sufficient = counts[remaining <= share * energy.sum()]
    recommended = int(sufficient[0]) if sufficient.size else None
    least = int(counts[np.nanargmin(remaining)])
    return ControlledModeCount(counts, energy, uncontrolled, residual_work, efforts, recommended, least)
