"""Localisation of the gap between simulation and test: place, records, modes, bands, times, sensors and levels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from workbench.arrays import Flags, Floats
from workbench.gap.effects.effect import Effect
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.localisation.force_lines import Lines, screened
from workbench.identification.signal.distortion import distortion_of, period_of
from workbench.records.record import Record
from workbench.renamed import Renamed
from workbench.rig.linear import held_response, modal_motion, modal_poles, straight_response
from workbench.rig.rig import Rig, participation_of
from workbench.structure.domain import Between, Interval, NamedPoints, Rectangle
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class LocalisationSettings:
    """Constants of the localisation of one force."""

    valleys: int = 3  # local minima of the misfit that are refined
    rounds: int = 3  # alternations between the place and the weights of the lines
    beside: float = 0.95  # of the grid spacing: range about a minimum in which it is refined
    resolved: float = 1e-3  # of the grid spacing: tolerance of the refinement
    pairs_shown: int = 12  # of named points
    two_sigma: float = 4.0  # rise of the misfit at two standard errors
    noise: float = 0.1  # of the noise power: largest excess of the residual given one force
    all_but: float = 1e-5  # of the gap, likewise
    chance: float = 3.0  # standard deviations of a sum of squares
    edge: float = 1e-4  # of the length: least distance of a place from the ends
    near: float = 0.02  # of a rectangle's size: first simplex about a peak
    tolerance: float = 1e-2  # of the misfit, in units of the noise variance
    evaluations: int = 60  # of the simplex search
    curved_over: float = 0.1  # of that simplex: step of the second difference of the misfit
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
def locate_force(evidence: Evidence) -> ForceLocation:
    """Locate the one force, of any law, that best explains the gap.

    One sensor locates nothing, since a force anywhere explains its readings. Sensors with a lag are left out.
    """
    evidence = evidence.without([sensor.name for sensor in evidence.rig.sensors if sensor.time_constant > 0])
    domain, guess, places = evidence.domain, evidence.peaks[0], evidence.places
    if len(evidence.rig.sensors) < 2:
        std = 0.0 if isinstance(domain, NamedPoints) else domain.size / np.sqrt(12.0)
        return ForceLocation(places, np.zeros(len(places)), guess, std, 0.0, None)
    search = _Search(evidence, evidence.lines)
    informative = search.informative(guess)
    at: Any
    if isinstance(domain, Interval):
        profile = search.along(informative, places)
        at = min(
            evidence.workers.map(search.refined, _minima(np.asarray(places, float), profile)),
            key=search.unweighted_misfit,
        )
        informative = search.informative(at)
        profile, std = search.along(informative, places), search.deviation(informative, at)
    elif isinstance(domain, Rectangle):
        at, std = min(map(search.refined_over, evidence.peaks), key=lambda each: search.unweighted_misfit(each[0]))
        informative = search.informative(at)
        profile = search.screened(informative, places)
    else:
        places = _points_and_best_pairs(places, evidence.profile)
        profile = search.along(informative, places)
        at, std = places[int(np.argmin(profile))], 0.0
    lowest = min(search.misfit(informative, at), profile.min())
    std *= np.sqrt(max(search.left(at), 0.0) + 1.0)
    return ForceLocation(places, -0.5 * (profile - lowest), at, std, *search.of_one_force(at))


def _points_and_best_pairs(places: Sequence[Any], profile: np.ndarray) -> list[Any]:
    """All named points, and the likeliest pairs."""
    ranked = [places[i] for i in np.argsort(-profile, kind="stable") if isinstance(places[i], Between)]
    return [*(where for where in places if not isinstance(where, Between)), *ranked[: LOCALISATION.pairs_shown]]


def _minima(places: np.ndarray, misfit: np.ndarray) -> np.ndarray:
    """The places of the deepest local minima."""
    padded = np.r_[np.inf, misfit, np.inf]
    bottoms = np.flatnonzero((misfit <= padded[:-2]) & (misfit <= padded[2:]))
    return places[bottoms[np.argsort(misfit[bottoms])][: LOCALISATION.valleys]]


@dataclass(frozen=True, eq=False)
class _Search:
    """The misfit of one force as a function of its place.

    Attributes:
        evidence: of the nominal rig.
        lines: spectral lines of every record.
    """

    evidence: Evidence
    lines: list[Lines]

    def shape(self, where: Any) -> np.ndarray:
        """Mode shapes at a place (n_modes,)."""
        return self.evidence.rig.modes.phi_at(where)

    def informative(self, where: Any) -> list[Lines]:
        """The lines, weighted by the share of their power that is due to a force at a place."""
        shape = self.shape(where)
        return [each.weighted(each.force_share(shape)) for each in self.lines]

    def misfit(self, lines: list[Lines], where: Any) -> float:
        """Residual sum of squares given one force at a place."""
        shape = self.shape(where)
        return sum(each.misfit(shape) for each in lines)

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of the residual given one force."""
        return sum(each.degrees_of_freedom for each in self.lines)

    def left(self, at: Any) -> float:
        """Residual power above the noise given a force at a place, in units of the noise power."""
        return self.misfit(self.lines, at) / max(self.degrees_of_freedom, 1) - 1.0

    def of_one_force(self, at: Any) -> tuple[float, bool | None]:
        """Share of the gap's power that a force at a place explains, and whether that is all of it."""
        values = 2 * sum(each.left.size for each in self.lines)
        gap = sum(each.power for each in self.lines) - values
        if self.degrees_of_freedom == 0 or gap < LOCALISATION.chance * np.sqrt(2.0 * values):
            return 0.0, None
        left, chance = self.left(at), LOCALISATION.chance * np.sqrt(2.0 / self.degrees_of_freedom)
        share = float(np.clip(1.0 - left * self.degrees_of_freedom / gap, 0.0, 1.0))
        return share, bool(left < LOCALISATION.noise + chance or share > 1.0 - LOCALISATION.all_but)

    def along(self, lines: list[Lines], places: Sequence[Any]) -> np.ndarray:
        """The misfit at each of the places."""
        return np.array(self.evidence.workers.map(lambda x: self.misfit(lines, x), places))

    def screened(self, lines: list[Lines], places: Sequence[Any]) -> np.ndarray:
        """The approximate misfit at each of many places, without transients."""
        shapes = np.array([self.shape(where) for where in places])
        misfits: Floats = np.sum([screened(each, shapes) for each in lines], axis=0)
        return misfits

    def refined_over(self, top: tuple[float, float]) -> tuple[tuple[float, float], float]:
        """The local minimum of the misfit on a rectangle, and its standard error along the longer axis, m."""
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
        curvatures = [misfit(at + h) + misfit(at - h) - 2.0 * found.fun for h in step * np.array([(1, 0), (0, 1)])]
        flattest = max(min(curvatures), 1e-12)  # of |r|², twice the log-likelihood ratio
        return (float(at[0]), float(at[1])), float(min(step * np.sqrt(2.0 / flattest), rectangle.size))

    def refined(self, top: float) -> float:
        """The local minimum of the misfit along an interval."""
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
        """The misfit at a place with equal weights, for comparing minima: each one's own weights would favour it."""
        return self.misfit(self.lines, at)

    def deviation(self, lines: list[Lines], at: float) -> float:
        """Standard error of a place, m: a quarter of the interval in which the misfit rises by less than 4."""
        lowest = self.misfit(lines, at)
        return sum(self._distance_to(lines, at, side, lowest + LOCALISATION.two_sigma) for side in (-1.0, 1.0)) / 4.0

    def _distance_to(self, lines: list[Lines], at: float, side: float, level: float) -> float:
        """Distance on one side at which the misfit reaches a level, m."""
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
        """Bounds moved inside the structure."""
        length = self.evidence.domain.size
        edge = LOCALISATION.edge * length
        return max(low, edge), min(high, length - edge)


@dataclass(frozen=True)
class WhereSettings:
    """Constants of the breakdown of the gap."""

    mode_share: float = 0.05  # of the gap: modes with more are named
    one_sensor: float = 0.97  # of the gap: with more in one sensor, that sensor alone disagrees
    octaves: int = 8  # below half the sample rate
    clear: float = 0.1  # of the noise: a gap above it by less does not count
    # of the frequency of a mode: resonators about it. The response of lightly damped modes is longer than any segment
    # of a record, so that coherence by averaged spectra would miss most of it; a change of a mode's frequency, damping
    # or gain lies nearly in the span of resonators close to the mode
    spread: tuple[float, ...] = (0.85, 0.93, 0.97, 0.99, 1.0, 1.01, 1.03, 1.07, 1.15)
    most_modes: int = 6  # that have resonators
    rigid: float = 0.5  # of the frequency of the first elastic mode: the end of the band of rigid modes
    above: float = 1.15  # of the frequency of the last mode: the end of its band
    louder: float = 2.0  # ratio of levels or gaps: smaller ones say nothing of a dependence on amplitude
    linear: float = 0.9  # of the gap's power: if a linear model explains more, the gap is linear
    silent: float = 1e-3  # of the largest line of the inputs: lines below it are not excited
    distorted: float = 10.0  # power of the gap on lines not excited over that of noise: more is distortion
    hum: int = 3  # strongest of these lines in each octave that do not count, as they may be mains hum
    periods: int = 3  # last periods of a record that are used; the first of them only for the drift


WHERE = WhereSettings()
RIDGES = np.logspace(-9, -1, 9)  # ridge parameters, of the largest eigenvalue, for cross-validation


@dataclass(frozen=True, eq=False)
class Where:
    """Breakdown of the gap of the nominal model.

    Shares are of the squared residual above the noise, each sensor scaled by its own standard deviation, over the
    records whose gap is clearly above the noise, or over all records if there are none.

    Attributes:
        path: "actuator", "structure", "sensor", "environment", or "none".
        modes: one-based numbers of the modes with at least a twentieth of the gap around their frequencies; rigid
            modes share one band, so all or none of them.
        amplitude_dependent: whether the gap changes with level; None if the records do not show it.
        mode_shares: (n_modes,) share of the gap in the band around each natural frequency; rigid modes have equal parts
            of the band below half the first elastic frequency.
        share_above: of the gap, above the band of the last mode.
        band_edges_hz: (n_bands + 1,) octaves down from half the sample rate, the lowest open to zero.
        band_shares: (n_bands,) share of the gap in each.
        sensor_shares: (n_outputs,).
        time_shares: (n_records, 8) of each record's gap, by eighths of its length.
        record_gaps: (n_records,) gap as the case format defines it.
        record_floors: (n_records,) the same of the noise alone.
        input_levels: (n_records,) root mean square of the inputs.
        linear_share: of the gap's power that one linear model of the inputs explains.
        distortions: (n_records, 2) power of the gap on odd and on even lines that periodic inputs do not excite, over
            that of noise and transients; zero if inputs are not periodic.
        place: of an unmodelled force of any law: `at` and `at_std`, m; and whether it is one force.
    """

    path: str
    modes: tuple[int, ...]
    amplitude_dependent: bool | None
    mode_shares: np.ndarray
    share_above: float
    band_edges_hz: np.ndarray
    band_shares: np.ndarray
    sensor_shares: np.ndarray
    time_shares: np.ndarray
    record_names: tuple[str, ...]
    record_gaps: np.ndarray
    record_floors: np.ndarray
    input_levels: np.ndarray
    linear_share: float
    distortions: np.ndarray
    place: ForceLocation

    @property
    def is_distorted(self) -> bool:
        """Whether periodic inputs show a nonlinearity, before any law is assumed."""
        return bool(self.distortions.max() > WHERE.distorted)

    @property
    def at(self) -> Any:
        return self.place.at

    @property
    def at_std(self) -> float:
        return self.place.at_std

    @property
    def beyond_noise(self) -> float:
        """The largest gap of a record that is clearly above its noise, the noise subtracted, over the signal."""
        clear = _is_clear(self.record_gaps, self.record_floors)
        power = np.where(clear, self.record_gaps**2 - self.record_floors**2, 0.0)
        return float(np.sqrt(power.max()))


def _is_clear(gaps: Floats, floors: Floats) -> Flags:
    """Whether the gap of each record (n_records,) is clearly above its noise."""
    return np.asarray(gaps > (1.0 + WHERE.clear) * floors)


def locate(evidence: Evidence, effects: Sequence[Effect], place: ForceLocation) -> Where:
    """Break down the gap on the fit records.

    Args:
        evidence: of the nominal rig.
        effects: that explain the gap, if known; they give the path.
        place: of an unmodelled force, located without faulty sensors.
    """
    data = evidence.data
    scaled = [
        r / record.outputs.std(axis=1, keepdims=True)
        for record, r in zip(data.counted, evidence.residuals, strict=True)
    ]
    floors = [(data.noise / record.outputs.std(axis=1)) ** 2 for record in data.counted]
    excess = np.array([(s**2).mean(axis=1) - f for s, f in zip(scaled, floors, strict=True)])
    gaps = np.array([np.sqrt((s**2).mean()) for s in scaled])
    noise = np.array([np.sqrt(floor.mean()) for floor in floors])
    clear = _is_clear(gaps, noise)
    with_gap = np.flatnonzero(clear if clear.any() else ~clear)  # noise alone, scaled by itself, would count as a gap
    by_sensor = np.maximum(excess[with_gap], 0.0).sum(axis=0)
    seen = [(data.counted[i], scaled[i]) for i in with_gap]
    frequencies = evidence.rig.modes.frequencies_hz
    mode_shares, above = _by_mode(frequencies, seen, data.noise)
    in_band = np.where(frequencies > 0, mode_shares, mode_shares[frequencies == 0].sum())
    octaves = np.r_[0.0, 0.5 / data.counted[0].sample_time * 2.0 ** np.arange(1 - WHERE.octaves, 1)]
    levels = np.array([np.sqrt(np.mean(record.inputs**2)) for record in data.counted])
    share = linear_share(
        evidence.rig, [data.counted[i] for i in with_gap], [evidence.residuals[i] for i in with_gap], mode_shares
    )
    each = zip(data.counted, evidence.residuals, strict=True)
    distortions = np.array([_distortion(evidence.rig, record, residual) for record, residual in each])
    return Where(
        path=_path(evidence, excess, by_sensor, effects),
        modes=tuple(int(r) + 1 for r in np.flatnonzero(in_band > WHERE.mode_share)),
        amplitude_dependent=_amplitude_dependent(effects, gaps, noise, levels, share, distortions),
        mode_shares=mode_shares,
        share_above=above,
        band_edges_hz=octaves,
        band_shares=_shares_between(octaves, seen, data.noise),
        sensor_shares=by_sensor / max(by_sensor.sum(), 1e-300),
        time_shares=np.array([_shares_of_eighths(s) for s in scaled]),
        record_names=tuple(record.name for record in data.counted),
        record_gaps=gaps,
        record_floors=noise,
        input_levels=levels,
        linear_share=share,
        distortions=distortions,
        place=place,
    )


def _by_mode(frequencies: Floats, scaled: Sequence[tuple[Record, Floats]], noise: Floats) -> tuple[Floats, float]:
    """Share of the residuals' power in the band of each mode (n_modes,), and above that of the last.

    Rigid modes share one band in equal parts.
    """
    elastic = frequencies[frequencies > 0]
    first = WHERE.rigid * elastic[:1] * (elastic.size < frequencies.size)  # zero: an empty band
    # geometric means, as the width of a peak is proportional to its frequency; `setup.comparison`, which compares whole
    # signals, takes arithmetic means
    edges = np.r_[0.0, first, np.sqrt(elastic[1:] * elastic[:-1]), WHERE.above * elastic[-1:], np.inf]
    rigid, *others = _shares_between(edges, scaled, noise)
    above = others.pop() if others else 0.0  # with only rigid modes, there is one band
    n_rigid = frequencies.size - len(others)
    return np.r_[np.full(n_rigid, rigid / max(n_rigid, 1)), others], float(above)


def _shares_between(edges: np.ndarray, scaled: Sequence[tuple[Record, Floats]], noise: Floats) -> np.ndarray:
    """Share of the residuals' power above the noise between each edge (Hz) and the next."""
    power = np.zeros(edges.size - 1)
    for record, s in scaled:
        spectrum = (np.abs(np.fft.rfft(s, axis=1)) ** 2).sum(axis=0) / s.shape[1]
        grid = np.fft.rfftfreq(s.shape[1], record.sample_time)
        band = np.clip(np.searchsorted(edges, grid, side="right") - 1, 0, power.size - 1)
        floor = ((noise / record.outputs.std(axis=1)) ** 2).sum()
        power += np.bincount(band, spectrum - floor, power.size)
    power = np.maximum(power, 0.0)
    return power / max(float(power.sum()), 1e-300)


def _shares_of_eighths(scaled: Floats) -> Floats:
    """Share of the power in each eighth of a record (8,)."""
    power: Floats = np.array([(piece**2).sum() for piece in np.array_split(scaled, 8, axis=1)])
    return power / max(float(power.sum()), 1e-300)


def _path(evidence: Evidence, excess: np.ndarray, power: np.ndarray, effects: Sequence[Effect]) -> str:
    """Path of the first effect, or a guess from the sensors and inputs that show the gap."""
    paths = [effect.kind.path for effect in effects]
    if paths:
        return paths[0]
    left = np.concatenate([(r / evidence.data.noise[:, None]).ravel() for r in evidence.residuals])
    if power.sum() <= 0 or evidence.data.by_channel(left).mean() < 1.03:
        return "none"
    if of_one_sensor(power):
        return "sensor"
    direct = {a.name for a in evidence.rig.actuators if a.direct}
    for record, row in zip(evidence.data.counted, excess, strict=True):
        active = {n for n, values in zip(record.input_names, record.inputs, strict=True) if np.any(values)}
        if active and active <= direct:
            floor = ((evidence.data.noise / record.outputs.std(axis=1)) ** 2).mean()
            return "structure" if row.mean() > 0.1 * floor else "actuator"
    return "structure"


def of_one_sensor(excess: np.ndarray) -> bool:
    """Whether one sensor alone disagrees, given the power above the noise of each (n_outputs,)."""
    return bool(excess.max() > WHERE.one_sensor * excess.sum())


def _amplitude_dependent(
    effects: Sequence[Effect], gaps: Floats, floors: Floats, levels: Floats, linear: float, distortions: Floats
) -> bool | None:
    """Whether the gap changes with level; None if that is not established."""
    if effects:
        return any(effect.kind.nonlinear for effect in effects)
    above = np.sqrt(np.maximum(gaps**2 - floors**2, 0.0))
    sizes = above + floors
    grows = sizes.max() > WHERE.louder * sizes.min() and above.max() > WHERE.louder * floors.max()
    if grows or distortions.max() > WHERE.distorted:
        return True
    is_linear = linear > WHERE.linear and levels.max() > WHERE.louder * levels.min()
    return False if is_linear else None


def _distortion(rig: Rig, record: Record, residual: Floats) -> Floats:
    """Power of the gap on odd and on even lines that periodic inputs do not excite, over that of noise and transients.

    A transient that decays by exp(-a) a period appears on all lines; its mean over two periods is 1 / tanh(a / 2) times
    half their difference. A drift of a sensor is subtracted first.
    """
    period = period_of(record.inputs)
    if period is None or record.n_samples < WHERE.periods * period:
        return np.zeros(2)
    last = slice(record.n_samples - WHERE.periods * period, None)
    means = residual[:, last].reshape(residual.shape[0], WHERE.periods, period).mean(axis=2)
    drift = (means[:, -1] - means[:, -2])[:, None] / period * np.arange(WHERE.periods * period)
    try:
        found = distortion_of(replace(record, inputs=record.inputs[:, last], outputs=residual[:, last] - drift))
    except ValueError:  # these few periods do not repeat well enough
        return np.zeros(2)
    free = found.input_amplitudes < WHERE.silent * found.input_amplitudes.max()
    octave = np.floor(np.log2(np.arange(1, free.size + 1)))  # noise of other bands may be far louder
    decay = float((rig.modes.zeta * rig.modes.omega).min()) * period * record.sample_time
    settled = np.tanh(0.5 * decay) ** 2
    most = np.zeros(2)
    for i, lines in enumerate((found.odd & free, found.even & free)):
        for each in range(int(octave[-1]) + 1):
            chosen = lines & (octave == each)
            if chosen.sum() > WHERE.hum:
                power = np.sort(found.amplitudes[:, chosen] ** 2, axis=1)[:, : -WHERE.hum].sum(axis=1)
                noise = np.maximum((found.noise[:, chosen] ** 2).sum(axis=1), 1e-300)
                most[i] = max(most[i], settled * float((power / noise).max()))
    return most


def linear_share(rig: Rig, records: Sequence[Record], residuals: Sequence[np.ndarray], shares: np.ndarray) -> float:
    """Share of the residuals' power that one linear model of the inputs explains in all records (cross-validated).

    Ridge regression on resonators is trained on all records but one and validated on that one, each in turn: without
    validation, resonators would fit any narrow-band residual, which has few degrees of freedom. A single record is
    halved.

    Args:
        rig: nominal.
        records: with their inputs.
        residuals: (n_outputs, n_samples) a record, measured minus predicted.
        shares: (n_modes,) of the gap around each mode; only the modes with the largest shares are used.
    """
    chosen = [int(r) for r in np.argsort(-shares)[: WHERE.most_modes] if shares[r] > 0]
    sizes = np.sqrt(np.mean([record.outputs.var(axis=1) for record in records], axis=0))[:, None]
    pieces = []
    for record, residual in zip(records, residuals, strict=True):
        # regressors and residual are divided by the level, so that every record has equal weight in the same model
        level = np.sqrt(np.mean((record.outputs / sizes) ** 2))
        pieces.append((_regressors(rig, chosen, record) / level, residual / sizes / level))
    if len(pieces) == 1:
        half = pieces[0][0].shape[1] // 2
        pieces = [(x[:, part], y[:, part]) for x, y in pieces for part in (slice(half), slice(half, None))]
    scale = np.sqrt(sum((x**2).sum(axis=1) for x, _ in pieces))
    pieces = [(x[scale > 0] / scale[scale > 0, None], y) for x, y in pieces]
    normal, right = [x @ x.T for x, _ in pieces], [x @ y.T for x, y in pieces]
    left = np.zeros(RIDGES.size)
    for (x, y), own_normal, own_right in zip(pieces, normal, right, strict=True):
        strengths, axes = np.linalg.eigh(sum(normal) - own_normal)
        if not (strengths > 0).any():  # no other record has inputs to train on
            left += float((y**2).sum())
            continue
        target, shown = axes.T @ (sum(right) - own_right), axes.T @ x
        for i, ridge in enumerate(RIDGES * strengths[-1]):
            weights = target / (np.maximum(strengths, 0.0) + ridge)[:, None]
            left[i] += min(float(((y - weights.T @ shown) ** 2).sum()), float((y**2).sum()))
    return float(np.clip(1.0 - left.min() / sum(float((y**2).sum()) for _, y in pieces), 0.0, 1.0))


def _regressors(rig: Rig, chosen: Sequence[int], record: Record) -> np.ndarray:
    """Regressors (n_regressors, n_samples) of a linear model of the gap.

    The response of each mode to each input alone, for changed participation factors; and of resonators of neighbouring
    frequencies to the modal force, for a changed frequency or damping.
    """
    if not chosen:
        return record.inputs
    slowest = 2.0 * np.pi / (record.n_samples * record.sample_time)
    alone, acting = np.eye(len(rig.actuators)), participation_of(rig)
    omega = np.maximum(rig.modes.omega[chosen], slowest)[:, None] * np.r_[np.ones(len(alone)), WHERE.spread]
    damping = np.maximum(np.diag(rig.modes.damping)[chosen, None], 1e-3 * omega)
    driven = np.array([row for r in chosen for row in (*alone, *[acting[r]] * len(WHERE.spread))])
    resonators = modal_poles(omega.ravel(), np.diag(damping.ravel()))
    response_to = held_response if record.input_hold == "zero" else straight_response
    response, _ = response_to(resonators, record.inputs, driven, record.sample_time)
    return np.concatenate([record.inputs, *modal_motion(resonators, response)])
