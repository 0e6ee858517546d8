"""What a search claims."""

from typing import NamedTuple

from workbench.gap.disturbance import RandomForceFit
from workbench.gap.fit import Fit


class Decision(NamedTuple):
    """What is claimed; see `Attribution` for its parts."""

    outcome: str
    best: Fit
    random: RandomForceFit | None = None
    rivals: tuple[tuple[Fit, float], ...] = ()
