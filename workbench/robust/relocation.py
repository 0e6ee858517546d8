"""Optimal places of the actuators on a corrected structure, compared with the present ones."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError
from workbench.design.loop.rig_loop import LoopTest
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import place_actuators
from workbench.design.placement.task import Placement, placement_task
from workbench.records.units import SI, Units
from workbench.robust.compensation import Loop
from workbench.robust.on_rig import settings
from workbench.structure.domain import Between, Interval, position

SPACING, STARTS = 0.05, 4  # of the length; random starts of the search


@dataclass(frozen=True, eq=False)
class Relocation:
    """The present and the optimal placement of the actuators on the corrected structure, for no more effort.

    Attributes:
        present, moved: both placements.
        units: of the places in `sentence`.
    """

    present: Placement
    moved: Placement
    units: Units = SI

    @property
    def gain(self) -> float:
        """Relative reduction of W_R by the optimal placement."""
        return 1.0 - self.moved.residual_work / self.present.residual_work

    @property
    def sentence(self) -> str:
        old, new = (", ".join(f"{x:.4g}" for x in p.positions) for p in (self.present, self.moved))
        m = self.units.length
        return (
            f"Actuators at x = {new} {m} instead of {old} {m} would do {100 * self.gain:.0f} % less work in residual"
            " modes (spillover), for no more effort."
        )

    def to_json(self) -> dict[str, Any]:
        return {
            "present": self.present.positions.tolist(),
            "moved": self.moved.positions.tolist(),
            "residual_work": [self.present.residual_work, self.moved.residual_work],
            "effort": [self.present.effort, self.moved.effort],
        }


def relocated(loop: Loop, test: LoopTest, units: Units = SI) -> Relocation | None:
    """The optimal placement of the law's actuators; None where it is no better than the present one, or not known.

    It is known for IMSC of the lowest modes along an interval, by point forces, after an impulse at one place.
    """
    law, modes, at = loop.law, loop.modes, test.impulse_at
    n = len(law.controlled)
    of_imsc = getattr(law.designed_by, "func", None) is imsc and law.controlled == tuple(range(n)) and n < modes.n_modes
    by_forces = all(isinstance(a.at, float) and a.quantity == "force" for a in law.actuators)
    if not (of_imsc and by_forces and len(law.actuators) == n and isinstance(modes.domain, Interval)):
        return None
    if at is None or isinstance(at, Between):
        return None
    try:
        task = placement_task(modes, n, impulse_at=position(at), weight=settings(law)["weight"], impulse=test.impulse)
        present = task.placed(np.array([position(a.at) for a in law.actuators]), "present places")
        limits = Limits(effort=present.effort, spacing=SPACING * modes.length)
        moved = place_actuators(task, limits, starts=STARTS)
    except DesignError:
        return None
    return Relocation(present, moved, units) if moved.residual_work < present.residual_work else None
