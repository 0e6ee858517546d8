"""What a search claims."""

from typing import NamedTuple

import numpy as np

from workbench.gap.prediction.random_force import RandomForceFit
from workbench.gap.search.fit import Fit
from workbench.gap.search.search import Search


class Decision(NamedTuple):
    """What is claimed; see `Attribution` for its parts.

    Attributes:
        beside: the search that it was found in, where that was beside noise of the logged inputs.
    """

    outcome: str
    best: Fit
    random: RandomForceFit | None = None
    rivals: tuple[tuple[Fit, float], ...] = ()
    noise: np.ndarray | None = None
    beside: Search | None = None


def unexplained(start: Fit, best: Fit, rivals: tuple[tuple[Fit, float], ...]) -> Decision:
    """What is said where no set reaches the noise floor: in part, or not at all.

    Args:
        start: what is there with no effect.
        best: the nearest set.
        rivals: others, with their probabilities.
    """
    closed = 1.0 - np.sqrt(max(best.cost - 1.0, 0.0) / max(start.cost - 1.0, 1e-12))
    return Decision("part" if closed > 0.5 else "unknown", best, rivals=rivals)
