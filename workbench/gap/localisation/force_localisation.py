"""The place of an unmodelled force along the structure, with its uncertainty, before any law is guessed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from workbench.arrays import Floats
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.localisation.force_lines import Lines, lines_of, screened
from workbench.structure.domain import Between, Interval, NamedPoints, Rectangle
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class LocalisationSettings:
    """Constants of the localisation of one force."""

    valleys: int = 3  # of the misfit that are gone into
    rounds: int = 3  # in each: where the force is, which lines it stands out in
    beside: float = 0.95  # of the spacing of places: how far about a valley it is refined
    resolved: float = 1e-3  # of the spacing of places: to how much
    pairs_shown: int = 12  # of named points
    two_sigma: float = 4.0  # rise of the misfit
    noise: float = 0.1  # of the noise, left by what may be one force
    all_but: float = 1e-5  # of the gap, likewise
    chance: float = 3.0  # deviations of a sum of squares
    edge: float = 1e-4  # of the length: a place stays so far inside
    near: float = 0.02  # of a rectangle's size: the first simplex about a peak
    tolerance: float = 1e-2  # of the misfit, in squared deviations
    evaluations: int = 60  # of the simplex
    curved_over: float = 0.1  # of that simplex: half of the stretch over which the misfit's curvature is taken
    bisections: int = 6  # of the distance at which the misfit has risen


LOCALISATION = LocalisationSettings()


@dataclass(frozen=True, eq=False)
class ForceLocation:
    """How likely one force, of any law, is at each place, and where it is likeliest.

    Attributes:
        places: (n_places,) on the structure.
        profile: (n_places,) log-likelihood there, less that of the likeliest place.
        at: the likeliest place.
        at_std: a quarter of the way between where the misfit is two deviations higher, m, more by what is left
            beyond the noise; on a rectangle along the longer axis of the region; 0 for named places.
        share: of the gap's power above the noise, what one force there accounts for.
        holds: whether one force leaves nothing but noise, or next to nothing of the gap; None where nothing shows it:
            no gap, one sensor, or records too short.
    """

    places: Sequence[Any]
    profile: np.ndarray
    at: Any
    at_std: float
    share: float
    holds: bool | None


@one_blas_thread
def locate_force(evidence: Evidence) -> ForceLocation:
    """Where one force, of any law, would make the simulation agree with the test.

    One sensor locates nothing: a force anywhere accounts for all that it reads. Sensors that lag are left out.
    """
    evidence = evidence.without([sensor.name for sensor in evidence.rig.sensors if sensor.time_constant > 0])
    domain, guess, places = evidence.domain, evidence.peaks[0], evidence.places
    if len(evidence.rig.sensors) < 2:
        unsure = 0.0 if isinstance(domain, NamedPoints) else domain.size / np.sqrt(12.0)
        return ForceLocation(places, np.zeros(len(places)), guess, unsure, 0.0, None)
    lines = lines_of(evidence.rig, evidence.model, evidence.residuals, evidence.data.counted[0].sample_time)
    search = _Search(evidence, lines)
    informative = search.informative(guess)
    at: Any
    if isinstance(domain, Interval):
        profile = search.along(informative, places)
        at = min(
            evidence.workers.map(search.refined, _valleys(np.asarray(places, float), profile)),
            key=search.unweighted_misfit,
        )
        informative = search.informative(at)
        profile, std = search.along(informative, places), search.deviation(informative, at)
    elif isinstance(domain, Rectangle):
        at, std = min(map(search.refined_over, evidence.peaks), key=lambda each: search.unweighted_misfit(each[0]))
        informative = search.informative(at)
        profile = search.screened(informative, places)
    else:
        places = _shown(places, evidence.profile)
        profile = search.along(informative, places)
        at, std = places[int(np.argmin(profile))], 0.0
    lowest = min(search.misfit(informative, at), profile.min())
    std *= np.sqrt(max(search.left(at), 0.0) + 1.0)
    return ForceLocation(places, -0.5 * (profile - lowest), at, std, *search.of_one_force(at))


def _shown(places: Sequence[Any], profile: np.ndarray) -> list[Any]:
    """All named points, and the likeliest pairs of them."""
    ranked = [places[i] for i in np.argsort(-profile, kind="stable") if isinstance(places[i], Between)]
    return [*(where for where in places if not isinstance(where, Between)), *ranked[: LOCALISATION.pairs_shown]]


def _valleys(places: np.ndarray, misfit: np.ndarray) -> np.ndarray:
    """The places of the deepest valleys."""
    padded = np.r_[np.inf, misfit, np.inf]
    bottoms = np.flatnonzero((misfit <= padded[:-2]) & (misfit <= padded[2:]))
    return places[bottoms[np.argsort(misfit[bottoms])][: LOCALISATION.valleys]]


@dataclass(frozen=True, eq=False)
class _Search:
    evidence: Evidence
    lines: list[Lines]

    def shape(self, where: Any) -> np.ndarray:
        return self.evidence.rig.modes.phi_at(where)

    def informative(self, where: Any) -> list[Lines]:
        """The lines weighted by the share of a force somewhere in them."""
        shape = self.shape(where)
        return [each.weighted(each.force_share(shape)) for each in self.lines]

    def misfit(self, lines: list[Lines], where: Any) -> float:
        shape = self.shape(where)
        return sum(each.misfit(shape) for each in lines)

    @property
    def freedom(self) -> int:
        return sum(each.freedom for each in self.lines)

    def left(self, at: Any) -> float:
        """What a force there leaves beyond the noise, per value, in units of the noise."""
        return self.misfit(self.lines, at) / max(self.freedom, 1) - 1.0

    def of_one_force(self, at: Any) -> tuple[float, bool | None]:
        """Share of the gap's power that a force there accounts for, and whether it is all of it."""
        values = 2 * sum(each.left.size for each in self.lines)
        gap = sum(each.power for each in self.lines) - values
        if self.freedom == 0 or gap < LOCALISATION.chance * np.sqrt(2.0 * values):
            return 0.0, None
        left, chance = self.left(at), LOCALISATION.chance * np.sqrt(2.0 / self.freedom)
        share = float(np.clip(1.0 - left * self.freedom / gap, 0.0, 1.0))
        return share, bool(left < LOCALISATION.noise + chance or share > 1.0 - LOCALISATION.all_but)

    def along(self, lines: list[Lines], places: Sequence[Any]) -> np.ndarray:
        """The misfit at each of the places."""
        return np.array(self.evidence.workers.map(lambda x: self.misfit(lines, x), places))

    def screened(self, lines: list[Lines], places: Sequence[Any]) -> np.ndarray:
        """About the misfit at each of many places: the ends of the records are left out."""
        shapes = np.array([self.shape(where) for where in places])
        misfits: Floats = np.sum([screened(each, shapes) for each in lines], axis=0)
        return misfits

    def refined_over(self, top: tuple[float, float]) -> tuple[tuple[float, float], float]:
        """The bottom of a valley over a rectangle, and one standard deviation along its longer axis, m."""
        rectangle, informative = self.evidence.domain, self.informative(top)
        assert isinstance(rectangle, Rectangle)
        extent = np.array(rectangle.length)

        def misfit(xy: np.ndarray) -> float:
            inside = np.clip(xy, LOCALISATION.edge * extent, (1.0 - LOCALISATION.edge) * extent)
            return self.misfit(informative, (float(inside[0]), float(inside[1])))

        reach = LOCALISATION.near * rectangle.size
        simplex = np.array(top) + reach * np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
        options = {
            "initial_simplex": simplex,
            "xatol": LOCALISATION.resolved * reach,
            "fatol": LOCALISATION.tolerance,
            "maxfev": LOCALISATION.evaluations,
        }
        found = minimize(misfit, top, method="Nelder-Mead", options=options)
        at = np.clip(found.x, LOCALISATION.edge * extent, (1.0 - LOCALISATION.edge) * extent)
        step = LOCALISATION.curved_over * reach
        rises = [misfit(at + h) + misfit(at - h) - 2.0 * found.fun for h in step * np.array([(1, 0), (0, 1)])]
        flattest = max(min(rises), 1e-12)  # of |r|², twice the logarithm of a likelihood ratio
        return (float(at[0]), float(at[1])), float(min(step * np.sqrt(2.0 / flattest), rectangle.size))

    def refined(self, top: float) -> float:
        """The bottom of a valley."""
        at, informative = float(top), self.informative(top)
        spacing = self.evidence.places[1] - self.evidence.places[0]
        for _ in range(LOCALISATION.rounds):
            found = minimize_scalar(
                lambda x, lines: self.misfit(lines, x),
                bounds=self._inside(at - LOCALISATION.beside * spacing, at + LOCALISATION.beside * spacing),
                args=(informative,),
                method="bounded",
                options={"xatol": LOCALISATION.resolved * spacing},
            )
            moved, at = abs(found.x - at), float(found.x)
            informative = self.informative(at)
            if moved < LOCALISATION.resolved * spacing:
                break
        return at

    def unweighted_misfit(self, at: Any) -> float:
        """The misfit of a valley by all lines alike: weights of its own would favour it."""
        return self.misfit(self.lines, at)

    def deviation(self, lines: list[Lines], at: float) -> float:
        """Half of one standard deviation either way, from where the misfit is two higher."""
        lowest = self.misfit(lines, at)
        return sum(self._rises(lines, at, side, lowest + LOCALISATION.two_sigma) for side in (-1.0, 1.0)) / 4.0

    def _rises(self, lines: list[Lines], at: float, side: float, level: float) -> float:
        """How far on one side the misfit comes to a level."""
        length = self.evidence.domain.size
        inside, outside = 0.0, 1e-5 * length
        while outside < length and 0 < at + side * outside < length:
            if self.misfit(lines, at + side * outside) > level:
                break
            inside, outside = outside, 2.0 * outside
        for _ in range(LOCALISATION.bisections):
            middle = 0.5 * (inside + outside)
            beyond = not 0 < at + side * middle < length or self.misfit(lines, at + side * middle) > level
            inside, outside = (inside, middle) if beyond else (middle, outside)
        return outside

    def _inside(self, low: float, high: float) -> tuple[float, float]:
        length = self.evidence.domain.size
        edge = LOCALISATION.edge * length
        return max(low, edge), min(high, length - edge)
