"""Maximum-likelihood fit of a random disturbance force, which no simulation can predict, to the residuals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from workbench.arrays import Floats
from workbench.gap.effects.environment import tone
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import (
    ForceFilter,
    SampledModel,
    accumulated,
    colour_of,
    force_filter,
    log_likelihood,
    sampled_model,
    smoothed_covariance,
    smoothed_states,
    whiten,
)
from workbench.rig.rig import Rig
from workbench.structure.domain import Location, NamedPoints, same_place


@dataclass(frozen=True)
class RandomForceSettings:
    """Constants of the fit of a random force."""

    rms_ratios: tuple[float, ...] = (3e-3, 3e-2, 3e-1)  # start values of its rms, over a typical force
    max_memory: float = 0.9995  # pole, a sample: beyond, the force is a drift
    place_step: float = 0.03  # of the extent: first step of the simplex along each coordinate of the place
    log_rms_step: float = 0.5  # likewise, along the logarithm of its rms
    logit_step: float = 0.7  # likewise, along the logit of its memory
    simplex_tolerance: float = 1e-4  # in these coordinates
    loss_tolerance: float = 0.1  # of twice the log-likelihood
    max_evaluations: int = 160
    # shaping filters, likeliest first, that are fitted to two records before the best is to all
    fitted_filters: int = 3
    curvature_step: float = 2e-3  # of the extent: step of the second difference of the likelihood
    # one random force of the surroundings: largest spread of its rms between records, relative; largest deviation of
    # the mean square of the whitened residual from 1, which is 0.10 at the truth of a trial with two laws, as these act
    # on the measured motion; largest share of the force that inputs and motion predict
    max_rms_spread: float = 0.15
    whiteness_tolerance: float = 0.15
    max_predicted_share: float = 0.1


RANDOM_FORCE = RandomForceSettings()
# Memory, stages and flatness (see `colour_of`) of the shaping filters; a fit starts from the likeliest.
COLOURS = (
    *((memory, 1, False) for memory in (0.0, 0.6, 0.9)),
    *((memory, 2, False) for memory in (0.5, 0.8, 0.95)),
    *((memory, 3, False) for memory in (0.6, 0.85)),
    *((memory, stages, True) for stages in (2, 4) for memory in (0.1, 0.4, 0.7, 0.9)),
)
MAX_TONAL_SHARE = 0.7  # largest share of the force's power in its mean and one sinusoid


@dataclass(frozen=True, eq=False)
class RandomForceFit:
    """A random force at x with the same strength and colour in every record.

    Attributes:
        at: where it acts.
        rms: of the process, N; extrapolated above the frequencies at which the structure responds.
        at_std: standard error of each coordinate of the place, m; empty for a named point.
        colour: (n_stages, n_stages) of the force; see `colour_of`.
        cost: minus twice the log-likelihood per value, on the scale where a residual of pure sensor noise costs 1.
        chi2_by_record: (n_records,) mean squares of the whitened residual.
        left: mean square residual of whole records given the smoothed force, in units of the noise.
        rms_by_record: (n_records,) of the smoothed force, N: the part that the records show.
        hidden_rms: of the part that they do not show, N.
        between: share of power by which the rms is uncertain, since the model holds the force over each sample.
        follows: largest share of the force that the inputs and the motion of its record predict.
        tonal: smallest share of the force's power, of all records, in its mean and one sinusoid.
    """

    at: Location
    rms: float
    at_std: tuple[float, ...]
    colour: Floats
    cost: float
    chi2_by_record: np.ndarray
    left: float
    rms_by_record: np.ndarray
    hidden_rms: float
    between: float
    follows: float
    tonal: float

    @property
    def acting_rms(self) -> tuple[float, float]:
        """Rms of the force over all records, N, and its standard error.

        The standard error combines the scatter between records with two unknowns: the part that they do not show, of
        which the process may have none or twice as much, and whether the force varies between samples.
        """
        seen, hidden = self.rms_by_record**2, self.hidden_rms**2
        power = seen.mean() + hidden
        scatter = float(seen.std(ddof=1)) if seen.size > 1 else float(seen[0])
        guessed = np.hypot(hidden, self.between * power) / np.sqrt(3.0)  # of uniform distributions
        rms = float(np.sqrt(power))
        return rms, float(np.hypot(scatter / np.sqrt(seen.size), guessed)) / (2.0 * rms)

    @property
    def holds(self) -> bool:
        """Whether the whitened residual is white and the force is random: see `is_steady`."""
        return self.is_steady and bool(np.abs(self.chi2_by_record - 1.0).max() < RANDOM_FORCE.whiteness_tolerance)

    @property
    def is_steady(self) -> bool:
        """Whether the force is equally strong in every record, unrelated to inputs and motion, and no constant or tone.

        A force that fails could be predicted. The whiteness of the residual is not tested.
        """
        spread = np.ptp(self.rms_by_record) / self.rms_by_record.mean()
        steady = spread < RANDOM_FORCE.max_rms_spread
        return bool(steady and self.follows < RANDOM_FORCE.max_predicted_share and self.tonal < MAX_TONAL_SHARE)


def fit_random_force(
    rig: Rig, data: FitData, residuals: Sequence[np.ndarray], places: Sequence[Location], size: float
) -> RandomForceFit:
    """Maximum-likelihood estimate of place, strength and colour, from the best of a grid.

    residuals: (n_outputs, n_samples) a record, in the sensors' units; places: to start from, for named points all
    candidates; size: a typical force, N.
    """
    model = sampled_model(rig.modes, rig.sensors, data.noise, data.counted[0].sample_time)
    residuals, domain = list(residuals), rig.modes.domain
    quick = residuals[:2]
    extent = np.zeros(0) if isinstance(domain, NamedPoints) else np.atleast_1d(domain.length)
    d = extent.size  # coordinates of a place that can be fitted

    def memory_at(point: np.ndarray) -> float:
        return float(1.0 / (1.0 + np.exp(-point[d + 1])))

    def force_at(point: np.ndarray, family: tuple[Location, int, bool]) -> tuple[Location, float, Floats]:
        """Place, rms (N) and colour of the force."""
        start, stages, flat = family
        at = start if d == 0 else same_place(point[:d] * extent)
        return at, float(np.exp(point[d])), colour_of(memory_at(point), stages, flat=flat)

    def loss(point: np.ndarray, family: tuple[Location, int, bool], records: list[np.ndarray]) -> float:
        is_inside = ((point[:d] >= 0.0) & (point[:d] <= 1.0)).all()
        if not is_inside or memory_at(point) > RANDOM_FORCE.max_memory:
            return 1e300
        value = -2.0 * log_likelihood(_filter(model, rig, *force_at(point, family)), records)
        return value if np.isfinite(value) else 1e300

    grid = [
        (np.r_[within, np.log(size * share), np.log((memory + 1e-3) / (1.0 - memory))], (where, stages, flat))
        for where in places
        for within in [np.atleast_1d(np.asarray(where)) / extent if d else extent]
        for share in RANDOM_FORCE.rms_ratios
        for memory, stages, flat in COLOURS
    ]
    place, log_size, logit_of_memory = RANDOM_FORCE.place_step, RANDOM_FORCE.log_rms_step, RANDOM_FORCE.logit_step
    steps = np.vstack([np.zeros(d + 2), np.diag(np.r_[np.full(d, place), log_size, logit_of_memory])])

    def refined(start: np.ndarray, family: tuple[Location, int, bool], records: list[np.ndarray], most: int) -> Any:
        inwards = np.r_[np.where(start[:d] + place > 1.0, -1.0, 1.0), 1.0, 1.0]
        options = {
            "initial_simplex": start + inwards * steps,
            "xatol": RANDOM_FORCE.simplex_tolerance,
            "fatol": RANDOM_FORCE.loss_tolerance,
            "maxfev": most,
        }
        return minimize(loss, start, args=(family, records), method="Nelder-Mead", options=options)

    likely: dict[tuple[int, bool], tuple[np.ndarray, tuple[Location, int, bool]]] = {}
    for start, family in sorted(grid, key=lambda each: loss(each[0], each[1], quick)):
        likely.setdefault(family[1:], (start, family))
    half_evaluations = RANDOM_FORCE.max_evaluations // 2
    refined_quick = [
        (refined(first, family, quick, half_evaluations), family)
        for first, family in list(likely.values())[: RANDOM_FORCE.fitted_filters]
    ]
    nearest, family = min(refined_quick, key=lambda each: float(each[0].fun))
    found = refined(nearest.x, family, residuals, RANDOM_FORCE.max_evaluations)
    at, rms, colour = force_at(found.x, family)
    kalman = _filter(model, rig, at, rms, colour)
    n_values = sum(r.size for r in residuals)
    noise_part = sum(r.shape[1] for r in residuals) * np.sum(np.log(data.noise**2))
    both = [(r, smoothed_states(kalman, r)) for r in residuals]
    force = 2 * rig.modes.n_modes
    forces = [x[force] for _, x in both]
    return RandomForceFit(
        at=at,
        rms=rms,
        at_std=tuple(
            _curvature_std(lambda p: loss(p, family, residuals), found.x, i, RANDOM_FORCE.curvature_step)
            * float(extent[i])
            for i in range(d)
        ),
        colour=colour,
        cost=float((found.fun - noise_part) / n_values),
        chi2_by_record=np.array([np.mean(whiten(kalman, r) ** 2) for r in residuals]),
        left=float(np.sum([(((r - kalman.h @ x) / data.noise[:, None]) ** 2).sum() for r, x in both])) / n_values,
        rms_by_record=np.array([np.sqrt(np.mean(f**2)) for f in forces]),
        hidden_rms=float(np.sqrt(max(smoothed_covariance(kalman)[force, force], 0.0))),
        between=lost_between_samples(forces),
        follows=max(
            followed(force, record.inputs, rig.modes.phi_at(at) @ np.array([m.displacement, m.velocity]))
            for force, record, m in zip(forces, data.counted, data.motions(rig), strict=True)
        ),
        tonal=min(tonal(force, data.counted[0].sample_time) for force in forces),
    )


def lost_between_samples(forces: Sequence[np.ndarray]) -> float:
    """Share of the power of forces (n_samples,) that is lost by a hold over each sample.

    A force held over each sample acts as a continuous one times the sinc of the hold at every frequency.
    """
    powers = [np.abs(np.fft.rfft(force)) ** 2 for force in forces]
    kept = [float(power @ np.sinc(np.fft.rfftfreq(f.size)) ** 2) for power, f in zip(powers, forces, strict=True)]
    return 1.0 - sum(kept) / max(float(sum(power.sum() for power in powers)), 1e-300)


def tonal(force: np.ndarray, sample_time: float) -> float:
    """Share of a force's power in its mean and its strongest sinusoid."""
    mean = float(force.mean())
    _, amplitude, _ = tone(force, sample_time)
    return float(min((mean**2 + 0.5 * amplitude**2) / max(float(force @ force) / force.size, 1e-300), 1.0))


def model_filter(model: SampledModel, rig: Rig, found: RandomForceFit) -> ForceFilter:
    """The filter of a fitted random force."""
    return _filter(model, rig, found.at, found.rms, found.colour)


def _filter(model: SampledModel, rig: Rig, at: Location, rms: float, colour: Floats) -> ForceFilter:
    """The Kalman filter for a random force of a place, an rms (N) and a colour."""
    variance = np.array([rms**2 / _power(colour)])
    return force_filter(model, rig.modes.phi_at(at)[:, None], variance, colour)


def _power(colour: Floats) -> float:
    """Variance of a coloured force per variance of the white noise that drives its shaping filter."""
    drive = np.zeros_like(colour)
    drive[-1, -1] = 1.0
    return float(accumulated(colour, drive)[0, 0])


def followed(force: np.ndarray, inputs: np.ndarray, motion: np.ndarray) -> float:
    """Share of a force's power that linear regression on inputs and motion explains, less what chance would.

    Several lags of each input are regressors; motion: (2, n_samples) displacement and velocity at the force, simulated
    without it, as the measured motion always correlates with the force.
    """
    active = [row for row in inputs if np.any(row)]
    if not active:
        return 0.0
    w, v = motion
    lags = [np.roll(row, lag) for row in active for lag in (0, 1, 2, 4, 8, 16)]
    followed = np.array([*lags, w, v, w**2, w**3, v * np.abs(v)])[:, 16:]
    followed = (followed / np.linalg.norm(followed, axis=1, keepdims=True).clip(1e-300)).T
    target = force[16:] - force[16:].mean()
    fitted = followed @ np.linalg.lstsq(followed, target, rcond=None)[0]
    return float(max(fitted @ fitted / (target @ target) - 3.0 * followed.shape[1] / target.size, 0.0))


def _curvature_std(loss: Callable[[np.ndarray], float], point: np.ndarray, j: int, step: float) -> float:
    """Standard error of a coordinate from the curvature of `loss`, minus twice the log-likelihood; 0 if not convex.

    At an edge, where the coordinate is 0 or 1, the curvature is that beside it.
    """
    behind, centre, ahead = np.array([point] * 3)
    centre[j] = np.clip(point[j], step, 1.0 - step)
    behind[j], ahead[j] = centre[j] - step, centre[j] + step
    curvature = (loss(ahead) - 2.0 * loss(centre) + loss(behind)) / step**2
    return float(np.sqrt(2.0 / curvature)) if 0 < curvature < 1e300 else 0.0
