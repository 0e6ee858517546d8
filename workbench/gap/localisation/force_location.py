"""The place of one unmodelled force, of any law, and whether one force explains the gap."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from workbench.arrays import Floats
from workbench.gap.localisation.force_lines import Lines
from workbench.gap.localisation.force_reconstruction import RECONSTRUCTION, ForceReconstruction, minima
from workbench.renamed import Renamed
from workbench.structure.domain import Between, Interval, NamedPoints, Rectangle
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class LocalisationSettings:
    """Constants of the localisation of one force."""

    refined_minima: int = 3  # of the misfit, local
    rounds: int = 3  # alternations between the place and the weights of the lines
    place_tolerance: float = 1e-3  # of the grid spacing, at the refinement
    pairs_shown: int = 12  # of named points
    two_sigma_rise: float = 4.0  # of the misfit, at two standard errors
    max_excess: float = 0.1  # of the noise power: of the residual given one force
    unexplained_share: float = 1e-5  # of the gap, likewise
    noise_deviations: float = 3.0  # of a sum of squares of noise
    edge_distance: float = 1e-4  # of the length: least distance of a place from the ends
    simplex_size: float = 0.02  # of a rectangle's size: first simplex about a peak
    misfit_tolerance: float = 1e-2  # of the misfit, in units of the noise variance
    max_evaluations: int = 60  # of the simplex search
    curvature_step: float = 0.1  # of that simplex: step of the second difference of the misfit
    bisections: int = 6  # of the distance at which the misfit has risen


LOCALISATION = LocalisationSettings()


@dataclass(frozen=True, eq=False)
class ForceLocation:
    """Likelihood of one force of any law at each place, and the likeliest place.

    Attributes:
        places: (n_places,) on the structure.
        profile: (n_places,) log-likelihood, relative to that of the likeliest place.
        at: the likeliest place.
        at_std: standard error of the place, m, from a quarter of the 2-sigma interval, inflated by the residual above
            the noise; on a rectangle along the longer axis of the region; 0 for named places.
        share: of the gap's power above the noise that one force there explains.
        is_single_force: whether one force reduces the gap to noise, or to a negligible share; None if that cannot be
            tested: no gap, one sensor, or records too short.
    """

    places: Sequence[Any]
    profile: np.ndarray
    at: Any
    at_std: float
    share: float
    is_single_force: bool | None

    holds = Renamed("is_single_force")


@one_blas_thread
def locate_force(reconstruction: ForceReconstruction) -> ForceLocation:
    """Locate the one force, of any law, that best explains the gap.

    One sensor locates nothing, since a force anywhere explains its readings. Sensors with a lag are left out.
    """
    reconstruction = reconstruction.without([s.name for s in reconstruction.rig.sensors if s.time_constant > 0])
    domain, places = reconstruction.domain, reconstruction.places
    at: Any = reconstruction.peaks[0]
    if len(reconstruction.rig.sensors) < 2:
        std = 0.0 if isinstance(domain, NamedPoints) else domain.size / np.sqrt(12.0)
        return ForceLocation(places, np.zeros(len(places)), at, std, 0.0, None)
    informative = reconstruction.informative(at)
    if isinstance(domain, Interval):
        valleys = places[minima(reconstruction.misfits(places, informative))[: LOCALISATION.refined_minima]]
        # minima are compared by equal weights: each one's own would favour it
        at = min(reconstruction.workers.map(partial(_refined, reconstruction), valleys), key=reconstruction.misfit)
        informative = reconstruction.informative(at)
        profile, std = reconstruction.misfits(places, informative), _deviation(reconstruction, informative, at)
    elif isinstance(domain, Rectangle):
        refined = [_refined_over(reconstruction, domain, peak) for peak in reconstruction.peaks]
        at, std = min(refined, key=lambda each: reconstruction.misfit(each[0]))
        informative = reconstruction.informative(at)
        profile = reconstruction.screened(places, informative)
    else:
        ranked = [places[i] for i in np.argsort(-reconstruction.profile, kind="stable")]
        pairs = [where for where in ranked if isinstance(where, Between)][: LOCALISATION.pairs_shown]
        places = [*(where for where in places if not isinstance(where, Between)), *pairs]
        profile = reconstruction.misfits(places, informative)
        at, std = places[int(np.argmin(profile))], 0.0
    lowest = min(reconstruction.misfit(at, informative), profile.min())
    degrees_of_freedom = sum(each.degrees_of_freedom for each in reconstruction.lines)
    left = reconstruction.misfit(at) / max(degrees_of_freedom, 1) - 1.0
    std *= np.sqrt(max(left, 0.0) + 1.0)
    explained = _explained(reconstruction, degrees_of_freedom, left)
    return ForceLocation(places, -0.5 * (profile - lowest), at, std, *explained)


def _explained(reconstruction: ForceReconstruction, degrees_of_freedom: int, left: float) -> tuple[float, bool | None]:
    """Share of the gap's power that one force explains, and whether that is all of it; None if it cannot be tested.

    left: power of the residual given the force, above the noise, in units of the noise power.
    """
    values = 2 * sum(each.left.size for each in reconstruction.lines)
    gap = sum(each.power for each in reconstruction.lines) - values
    if degrees_of_freedom == 0 or gap < LOCALISATION.noise_deviations * np.sqrt(2.0 * values):
        return 0.0, None
    chance = LOCALISATION.noise_deviations * np.sqrt(2.0 / degrees_of_freedom)
    share = float(np.clip(1.0 - left * degrees_of_freedom / gap, 0.0, 1.0))
    return share, bool(left < LOCALISATION.max_excess + chance or share > 1.0 - LOCALISATION.unexplained_share)


def _refined_over(
    reconstruction: ForceReconstruction, rectangle: Rectangle, top: tuple[float, float]
) -> tuple[tuple[float, float], float]:
    """The local minimum of the misfit on a rectangle, and its standard error along the longer axis, m."""
    informative, extent = reconstruction.informative(top), np.array(rectangle.length)

    def inside(xy: Floats) -> tuple[float, float]:
        x, y = np.clip(xy, LOCALISATION.edge_distance * extent, (1.0 - LOCALISATION.edge_distance) * extent)
        return float(x), float(y)

    def misfit(xy: Floats) -> float:
        return reconstruction.misfit(inside(xy), informative)

    reach = LOCALISATION.simplex_size * rectangle.size
    options = {
        "initial_simplex": np.array(top) + reach * np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]),
        "xatol": LOCALISATION.place_tolerance * reach,
        "fatol": LOCALISATION.misfit_tolerance,
        "maxfev": LOCALISATION.max_evaluations,
    }
    found = minimize(misfit, top, method="Nelder-Mead", options=options)
    at, step = inside(found.x), LOCALISATION.curvature_step * reach
    curvatures = [misfit(at + h) + misfit(at - h) - 2.0 * found.fun for h in step * np.array([(1, 0), (0, 1)])]
    flattest = max(min(curvatures), 1e-12)  # of |r|², twice the log-likelihood ratio
    return at, float(min(step * np.sqrt(2.0 / flattest), rectangle.size))


def _refined(reconstruction: ForceReconstruction, top: float) -> float:
    """The local minimum of the misfit along an interval."""
    at, informative = float(top), reconstruction.informative(top)
    length, spacing = reconstruction.domain.size, reconstruction.places[1] - reconstruction.places[0]
    edge, beside = LOCALISATION.edge_distance * length, RECONSTRUCTION.refinement_range * spacing
    for _ in range(LOCALISATION.rounds):
        how: Any = {"method": "bounded", "bounds": (max(at - beside, edge), min(at + beside, length - edge))}
        tolerance = {"xatol": LOCALISATION.place_tolerance * spacing}
        found = minimize_scalar(reconstruction.misfit, args=(informative,), options=tolerance, **how)
        moved, at = abs(found.x - at), float(found.x)
        informative = reconstruction.informative(at)
        if moved < LOCALISATION.place_tolerance * spacing:
            break
    return at


def _deviation(reconstruction: ForceReconstruction, lines: Sequence[Lines], at: float) -> float:
    """Standard error of a place along an interval, m: a quarter of that in which the misfit rises by less than 4."""
    length, level = reconstruction.domain.size, reconstruction.misfit(at, lines) + LOCALISATION.two_sigma_rise

    def is_outside(x: float) -> bool:
        return not 0 < x < length or reconstruction.misfit(x, lines) > level

    def distance(side: float) -> float:
        inside, outside = 0.0, 1e-5 * length
        while outside < length and not is_outside(at + side * outside):
            inside, outside = outside, 2.0 * outside
        for _ in range(LOCALISATION.bisections):
            middle = 0.5 * (inside + outside)
            inside, outside = (inside, middle) if is_outside(at + side * middle) else (middle, outside)
        return outside

    return (distance(-1.0) + distance(1.0)) / 4.0
