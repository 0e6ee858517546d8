"""The number of modes to control: what the disturbance gives each, and the residual work of controlling n of them.

Controlling the lowest n leaves Σ_{r>n} E_r of the disturbance where it is (5.27 is what control takes out) and adds
the spillover W_R (5.43). A number of modes is judged by what is left, of both together.
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
from workbench.renamed import Renamed
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes, freeze


@dataclass(frozen=True, eq=False)
class ControlledModeCount:
    """What is left of a disturbance when the lowest n modes are controlled.

    Attributes:
        counts: (n_counts,) n; nan elsewhere where the actuators of that n cannot be placed.
        energy: (n_modes,) that the disturbance gives each mode, J.
        uncontrolled: (n_counts,) Σ_{r>n} E_r, J.
        spillover: (n_counts,) W_R, J, residual modes at rest when control starts.
        effort: (n_counts,) ∫ FᵀF dt.
        recommended: least n that leaves no more than the share asked for; None where none does.
        least: n that leaves least.
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
        """Energy of the modes that are not controlled and spillover work together, (n_counts,), J."""
        return self.uncontrolled + self.spillover

    untouched, spilled, left = Renamed("uncontrolled"), Renamed("spillover"), Renamed("residual")


def controlled_mode_count(
    modes: Modes,
    state: np.ndarray,
    *,
    weight: ArrayLike,
    share: float = 0.05,
    most: int | None = None,
    places: Callable[[int], ArrayLike] | None = None,
) -> ControlledModeCount:
    """The number of modes in need of control.

    Args:
        modes: undamped, enough that the disturbance gives little to those beyond.
        state: (2 n_modes,) just after the disturbance, or the square roots of mean squares for a random one.
        weight: R of IMSC.
        share: of the disturbance's energy that may be left.
        most: largest n tried; half the modes unless given.
        places: of n actuators; the nodes of mode n+1 unless given.

    Raises:
        DesignError: modes with damping, a disturbance that gives no energy, or no n whose actuators can be placed.
    """
    n_modes = modes.n_modes
    if modes.damping.any():
        raise DesignError(
            "modes to count have no damping, which would take energy from all of them; give"
            " replace(modes, damping=np.zeros_like(modes.damping))"
        )
    energy = 0.5 * (state[n_modes:] ** 2 + (modes.omega * state[:n_modes]) ** 2)
    if not energy.sum() > 0:
        raise DesignError("the disturbance gives no mode any energy, so there is nothing to control")
    counts = np.arange(1, (n_modes // 2 if most is None else most) + 1)
    spilled, spent = np.full(counts.size, np.nan), np.full(counts.size, np.nan)
    for i, n in enumerate(counts):
        try:
            at = np.asarray(nodes_of_mode(modes, int(n)) if places is None else places(int(n)), float)
            law = imsc(modes, int(n), [Actuator(f"F{j + 1}", float(x)) for j, x in enumerate(at)], weight=weight)
        except (DesignError, ValueError):
            continue
        rest = state.copy()
        rest[n:n_modes] = rest[n_modes + n :] = 0.0
        spilled[i], spent[i] = spillover(modes, law, rest).residual_total, effort(modes, law, rest)
    uncontrolled = energy.sum() - np.cumsum(energy)[: counts.size]
    left = uncontrolled + spilled
    if not np.isfinite(left).any():
        raise DesignError("no number of modes can be controlled from these places; give others")
    enough = counts[left <= share * energy.sum()]
    return ControlledModeCount(
        counts,
        energy,
        uncontrolled,
        spilled,
        spent,
        int(enough[0]) if enough.size else None,
        int(counts[np.nanargmin(left)]),
    )
