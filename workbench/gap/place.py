"""The place of a missing force along the structure, with its uncertainty, before any law is guessed."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from workbench.gap.effects.structural import known_places
from workbench.gap.evidence import Evidence
from workbench.gap.missing_force import ForceFilter, log_likelihoods, wandering_force_filter

LEVELS = (1e-2, 1e-1, 1.0)  # rms of a missing force over that of the inputs
MEMORIES = (10.0, 1000.0)  # its correlation time, in samples
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
    sizes = [(share * evidence.force_rms, memory) for share in LEVELS for memory in MEMORIES]
    tried = [(_likelihood(evidence, x, size), size) for x in evidence.peaks[:2] for size in sizes]
    size = max(tried)[1]
    places = evidence.places
    profile = np.array([_likelihood(evidence, x, size) for x in places])
    best = int(np.argmax(profile))
    if known_places(evidence.rig) is not None:
        return Placed(places, profile, float(places[best]), 0.0, float(profile[best]))
    spacing = places[1] - places[0]
    refined = minimize_scalar(
        lambda x: -_likelihood(evidence, x, size),
        bounds=(places[best] - (1.0 - STEP) * spacing, places[best] + (1.0 - STEP) * spacing),
        method="bounded",
        options={"xatol": 2e-3 * spacing},
    )
    return Placed(places, profile, float(refined.x), _deviation(evidence, refined.x, size, spacing), -refined.fun)


def _deviation(evidence: Evidence, at: float, size: tuple[float, float], spacing: float) -> float:
    """From the curvature of the log-likelihood and the scatter of its slope from one stretch of time to the next."""
    step = STEP * spacing
    left, middle, right = (_by_stretch(evidence, x, size) for x in (at - step, at, at + step))
    curvature = -(left - 2.0 * middle + right).sum() / step**2
    slopes = (right - left) / (2.0 * step)
    if not curvature > 0:
        return spacing
    return float(np.sqrt(np.sum((slopes - slopes.mean()) ** 2)) / curvature)


def _likelihood(evidence: Evidence, at: float, size: tuple[float, float]) -> float:
    return float(_by_stretch(evidence, at, size).sum())


def _by_stretch(evidence: Evidence, at: float, size: tuple[float, float]) -> np.ndarray:
    """Log-likelihood of a force at a place, by stretches of `TOGETHER` samples of every record."""
    kalman = _filter(evidence, at, *size)
    pieces = []
    for residual in evidence.residuals:
        by_sample = log_likelihoods(kalman, residual)
        pieces.append(np.add.reduceat(by_sample, np.arange(0, by_sample.size, TOGETHER)))
    return np.concatenate(pieces)


def _filter(evidence: Evidence, at: float, rms: float, memory: float) -> ForceFilter:
    modes, sample_time = evidence.rig.modes, evidence.data.counted[0].sample_time
    return wandering_force_filter(modes, evidence.model, modes.phi(at)[0], rms, memory * sample_time, sample_time)
