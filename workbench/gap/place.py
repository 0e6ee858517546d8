"""The place of a missing force along the structure, with its uncertainty, before any law is guessed."""

from dataclasses import dataclass

import numpy as np

from workbench.gap.effects.structural import known_places
from workbench.gap.evidence import Evidence
from workbench.gap.missing_force import log_likelihoods

STEP = 0.05  # of the spacing of places: of differences along the structure
TOGETHER = 100  # samples whose scores are taken for one: the filter is not quite that of the force


@dataclass(frozen=True, eq=False)
class Placed:
    """How likely one force is at each place, and where it is likeliest.

    Attributes:
        places: (n_places,) m.
        profile: (n_places,) log-likelihood there.
        at: the likeliest place, m.
        at_std: its standard deviation, m: of a fit whose noise is not what it takes it for (White, Econometrica 50
            (1982) 1).
        log_likelihood: there.
    """

    places: np.ndarray
    profile: np.ndarray
    at: float
    at_std: float
    log_likelihood: float


def placed(evidence: Evidence) -> Placed:
    """Where one force, of any law, would make the simulation agree with the test."""
    at = evidence.peaks[0]
    height = float(_by_stretch(evidence, at).sum())
    return Placed(evidence.places, evidence.profile, at, _deviation(evidence, at), height)


def _deviation(evidence: Evidence, at: float) -> float:
    """From the curvature of the log-likelihood and the scatter of its slope from one stretch of time to the next."""
    if known_places(evidence.rig) is not None:
        return 0.0
    spacing = evidence.places[1] - evidence.places[0]
    step = STEP * spacing
    left, middle, right = (_by_stretch(evidence, x) for x in (at - step, at, at + step))
    curvature = -(left - 2.0 * middle + right).sum() / step**2
    slopes = (right - left) / (2.0 * step)
    if not curvature > 0:
        return spacing
    return float(np.sqrt(np.sum((slopes - slopes.mean()) ** 2)) / curvature)


def _by_stretch(evidence: Evidence, at: float) -> np.ndarray:
    """Log-likelihood of a force at a place, by stretches of `TOGETHER` samples of every record."""
    kalman = evidence.filter_at(at, *evidence.size)
    pieces = []
    for residual in evidence.residuals:
        by_sample = log_likelihoods(kalman, residual)
        pieces.append(np.add.reduceat(by_sample, np.arange(0, by_sample.size, TOGETHER)))
    return np.concatenate(pieces)
