"""Effects fitted beside errors of the nominal model, or noise of the inputs, of sizes that the records tell."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workbench.arrays import Floats, scaled_inverse
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import JUST_LATE, NominalPrior, group_of, nominal_errors, weight_of
from workbench.gap.prediction.noise import (
    LEAST_LOGGED,
    are_coloured,
    is_noise_alone,
    likeliest_share,
    logging_noise,
    noise_found,
)
from workbench.gap.prediction.residuals import FitData
from workbench.gap.search.fit import Chord, Fit, fit, parameters_of
from workbench.gap.search.search import Search
from workbench.gap.search.settings import INPUTS, JOINT, SELECTION
from workbench.rig.rig import Rig


def are_plausible(errors: Effect, *, damping: bool = True) -> bool:
    """Whether a careful laboratory could have a nominal model with these errors; those of damping where they count."""
    return not [group for group in too_large(errors) if damping or group != "damping"]


def too_large(errors: Effect) -> list[str]:
    """The groups of errors that are larger than in a careful laboratory."""
    return [group for group, size in _widest(errors.target) if size_of(errors, group) >= JOINT.plausible * size]


def size_of(errors: Effect, group: str) -> float:
    """Rms of a group of errors, as large as they are, not as is believed of a careful model."""
    values, spread = _drawn(errors, group)
    return float(np.sqrt(np.mean(values**2 + spread**2))) if values.size else 0.0


def _widest(prior: NominalPrior) -> list[tuple[str, float]]:
    """Largest standard deviation believed of each group; of modes that are off one by one, damping is a guess."""
    return [(g, JOINT.guessed if g == "damping" and prior.by_mode else size) for g, size in JOINT.widest]


@dataclass(frozen=True, eq=False)
class Step:
    """Effects beside nominal errors, fitted together.

    Attributes:
        fit: of both, the errors last.
        sensor_noise: (n_outputs,) mean square of each sensor's noise as found, over that of the stated noise.
        logged: noise of the logged inputs, as a share of their rms.
        noise_power: (n_records, n_outputs) mean square of both, over that of the stated noise of the sensors.
        others: sets that it was chosen from, fitted to all records too.
    """

    fit: Fit
    sensor_noise: np.ndarray
    logged: float
    noise_power: np.ndarray
    others: "tuple[Step, ...]" = ()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Without the errors."""
        return self.fit.effects[:-1]

    @property
    def errors(self) -> Effect:
        """Of the nominal model."""
        return self.fit.effects[-1]

    @property
    def is_plausible(self) -> bool:
        """Whether a careful laboratory could have a nominal model with these errors."""
        return are_plausible(self.errors)

    def description(self, noise_power: np.ndarray, *, of_errors_alone: bool = False) -> float:
        """Description length, nats, of what is left above that noise and of the errors."""
        left = 0.0
        if not of_errors_alone:
            left = JOINT.decisive * np.log1p(self.excess(noise_power) / float(noise_power.mean()))
        for group, small in JOINT.small:
            count = sum(group_of(name) == group for name in self.errors.values)
            left += count * np.log(max(size_of(self.errors, group), small) / small)
        return float(left)

    def excess(self, noise_power: np.ndarray) -> float:
        """Mean square left above that noise, in units of the stated one."""
        return float(np.maximum(self.fit.cost_by_channel - noise_power, 0.0).mean())


def fit_jointly(
    search: Search,
    effects: Sequence[Effect],
    errors: Effect,
    *,
    rounds: int | None = None,
    known: np.ndarray | None = None,
    to_the_end: bool = False,
) -> Step:
    """Effects and nominal errors fitted together, the sizes of the errors learnt from the records.

    The likeliest sizes follow MacKay, Neural Computation 4 (1992) 415: s² = Σ a² / Σ (1 - v / s²) over the errors a of
    a group and their posterior variances v. What is left counts as noise meanwhile, so that errors do not bend to an
    effect that is not there yet.

    Args:
        search: with its records.
        effects: with values to start from.
        errors: of the nominal model, likewise.
        rounds: of sizes; as the settings have it unless given.
        known: (n_values, n_errors) sensitivities to the errors on the two most telling records, in units of the stated
            noise, where they are at hand: then the fit is of these records alone.
        to_the_end: until no step lowers the cost, by fine steps of time where a law needs them.
    """
    rounds = JOINT.rounds if rounds is None else rounds
    whole, before = search.data.finely(SELECTION.fine) if to_the_end else search.data, np.inf
    if to_the_end:
        errors = replace(errors, target=replace(errors.target, waves=JOINT.last_waves))
    if known is None:
        errors = opened(search, errors)
    i, counted, chord = 0, 0, Chord(known)
    while counted < rounds and i < JOINT.most_rounds:
        # the two most telling records lead the way
        quickly = known is not None or (i == 0 and not to_the_end)
        data = search.quick.stepped(whole.substeps) if quickly else whole
        level = _level(search.rig, (*effects, errors), data)
        if level > (1.0 - (JOINT.last_settled if to_the_end else JOINT.settled)) * before:
            break
        falls = level < JOINT.falling * before
        counted += not falls or not np.isfinite(before)
        # far from where the slopes were taken, as exact as can be, or taken at once
        if known is None and (falls or to_the_end or len(errors.values) < JOINT.few):
            chord = Chord()
        before = level if known is not None or not quickly else np.inf
        i += 1
        found = fit(
            search.rig,
            (*effects, errors),
            data.tempered(level),
            iterations=JOINT.last_iterations if to_the_end else JOINT.iterations,
            tolerance=JOINT.last_tolerance if to_the_end else JOINT.tolerance,
            workers=search.workers,
            chord=chord,
        )
        *effects, errors = found.effects
        errors = _sized(errors, _next_sizes(errors))
    if to_the_end:
        return measured(search, replace(found, effects=(*effects, errors)), whole.substeps)
    moving = measured(search, replace(found, effects=(*effects, _closed(errors))), whole.substeps)
    # of what is far from noise the sizes say little
    near = moving.excess(moving.noise_power) < JOINT.near * float(moving.noise_power.mean())
    resting = _at_rest(search, found, whole, chord) if known is None and near else found
    if resting is found:
        return moving
    *effects, errors = resting.effects
    rested = measured(search, replace(resting, effects=(*effects, _closed(errors))), whole.substeps)
    # errors that come to rest far off bend to what no error of the model is
    return min((rested, moving), key=lambda step: step.description(rested.noise_power))


def _at_rest(search: Search, found: Fit, data: FitData, chord: Chord) -> Fit:
    """The fit with the sizes of errors where they come to rest, which the records may be slow to lead to.

    Where they hardly tell errors apart, the cost does not change on the way.

    Args:
        search: with its records.
        found: effects and errors.
        data: all records.
        chord: slopes of them along the errors.
    """
    for _ in range(JOINT.rests):
        errors = found.effects[-1]
        sizes = _likeliest_sizes(search, found)
        changes = [abs(np.log(size / getattr(errors.target, group))) for group, size in sizes.items()]
        if max(changes, default=0.0) < JOINT.sized:
            break
        effects = (*found.effects[:-1], _sized(errors, sizes))
        found = fit(
            search.rig,
            effects,
            data.tempered(_level(search.rig, effects, data)),
            iterations=JOINT.iterations,
            tolerance=JOINT.tolerance,
            workers=search.workers,
            chord=Chord() if len(effects[-1].values) < JOINT.few else chord,
            damping=JOINT.undamped,
        )
    return found


def _level(rig: Rig, effects: Sequence[Effect], data: FitData) -> float:
    """Mean square of what effects and errors leave, in units of the noise; no less than that."""
    left = data.residual(apply_all(rig, effects))
    with np.errstate(over="ignore"):  # of a motion that runs away
        return max(float(left @ left) / left.size, 1.0)


def _sized(errors: Effect, sizes: dict[str, float]) -> Effect:
    """The errors with prior deviations of those sizes."""
    return replace(errors, target=replace(errors.target, **sizes))


def measured(search: Search, found: Fit, substeps: int | None = None) -> Step:
    """Effects and errors, the errors last, as they leave the records of a search, by its substeps unless others are."""
    whole, rig = search.data.stepped(substeps or search.data.substeps), apply_all(search.rig, found.effects)
    if whole.whiteners:
        by_channel = whole.by_channel(whole.residual(rig))
        of_noise = np.ones_like(by_channel)
        step = replace(found, cost=float(by_channel.mean()), cost_by_channel=by_channel)
        return Step(step, of_noise[0], search.logged, of_noise)
    residuals = whole.differences(rig)
    with np.errstate(over="ignore", invalid="ignore"):  # of a motion that runs away
        by_channel = np.array([((r / whole.noise[:, None]) ** 2).mean(axis=1) for r in residuals])
        coloured = are_coloured(residuals)
        credible = np.inf if is_noise_alone(residuals, whole.counted, coloured) else _credible(whole, coloured)
        sensor_noise = np.minimum(noise_found(residuals, coloured) / whole.noise, credible) ** 2
    step = replace(found, cost=float(by_channel.mean()), cost_by_channel=by_channel)
    per_unit = search.logging_noise
    logged = logging_noise(by_channel, sensor_noise, per_unit)
    return Step(step, sensor_noise, logged, sensor_noise + logged**2 * per_unit)


def _credible(data: FitData, coloured: np.ndarray) -> Floats:
    """How many times the noise of each sensor (n_outputs,) that of the data may turn out to be."""
    guessed = np.array([name in data.guessed for name in data.records[0].output_names])
    return np.where(guessed & coloured, JOINT.credible_guess, JOINT.credible)


def _next_sizes(errors: Effect) -> dict[str, float]:
    """Prior deviations as large as the records make the errors of each group, one step nearer to the likeliest."""
    prior = errors.target
    return {g: _size(_drawn(errors, g), getattr(prior, g), widest) for g, widest in _widest(prior) if g in prior.groups}


def _size(drawn: Floats, size: float, widest: float) -> float:
    """The next size of errors, drawn (2, n_errors) with their posterior standard deviations, after MacKay."""
    values, spread = drawn
    known = np.clip(1.0 - (spread / size) ** 2, 0.0, 1.0).sum()
    return float(np.clip(np.sqrt((values**2).sum() / max(known, 1e-3)), JOINT.narrowest * widest, widest))


def _likeliest_sizes(search: Search, found: Fit) -> dict[str, float]:
    """The sizes where `_next_sizes` comes to rest, errors and effects going with them to first order.

    Simulations are not asked again: where the records hardly tell errors apart, the cost does not change on the way.
    """
    errors, prior = found.effects[-1], found.effects[-1].target
    each = [parameter for _, parameter in parameters_of(search.rig, found.effects)]
    mine = np.arange(len(each) - len(errors.values), len(each))
    names, free = [each[j].name for j in mine], np.array([each[j].to_free(errors.values[each[j].name]) for j in mine])
    groups = np.array([group_of(name) for name in names])
    sizes = {group: float(getattr(prior, group)) for group in prior.groups}
    unit = np.array([each[j].prior_std for j in mine], float) / [sizes[g] for g in groups]
    widest = dict(_widest(prior))

    def precision() -> Floats:
        of_each: Floats = np.zeros(len(each))
        of_each[mine] = 1.0 / (unit * [sizes[g] for g in groups]) ** 2
        return of_each

    assert found.normal is not None
    was = precision()
    for _ in range(JOINT.likeliest):
        now, before = precision(), dict(sizes)
        inverse = scaled_inverse(found.normal + np.diag(now - was))
        moved = inverse[mine][:, mine] @ ((was - now)[mine] * free)
        drawn = np.array([free + moved, np.sqrt(np.maximum(np.diag(inverse)[mine], 0.0))]) / unit
        for group in sizes:
            sizes[group] = _size(drawn[:, groups == group], sizes[group], widest[group])
        if all(abs(np.log(sizes[g] / before[g])) < 0.1 * JOINT.sized for g in sizes):
            break
    return sizes


def _drawn(errors: Effect, group: str) -> Floats:
    """The errors (2, n_errors) of a group and their standard deviations, each over its weight."""
    names = [name for name in errors.values if group_of(name) == group]
    weights = [weight_of(name, errors.target) for name in names]
    each = [[found.get(name, 0.0) for name in names] for found in (errors.values, errors.deviations)]
    drawn: Floats = np.array(each).reshape(2, len(names)) / np.array(weights)
    return drawn


def _closed(errors: Effect) -> Effect:
    """The errors without the groups that were learnt to be none: what is not there costs no time."""
    none = [g for g, widest in _widest(errors.target) if getattr(errors.target, g) <= 1.01 * JOINT.narrowest * widest]
    none = [group for group in none if group != "delay" or not errors.target.late]
    kept = {name: value for name, value in errors.values.items() if group_of(name) not in none}
    deviations = {name: errors.deviations[name] for name in kept if name in errors.deviations}
    target = replace(errors.target, **dict.fromkeys(none, 0.0))
    return replace(errors, target=target, values=kept, deviations=deviations)


def opened(search: Search, errors: Effect) -> Effect:
    """The errors with all groups, those that were closed at none and with the sizes they had before any record."""
    before = search.prior
    closed = {g: getattr(before, g) for g, _ in JOINT.widest if not getattr(errors.target, g)}
    return nominal_errors(search.rig, replace(errors.target, **closed), errors.values)


def with_all_errors(search: Search, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects, errors beside them with all groups: a model that is a little off may be so in all.

    Those that were closed at none are open at as good as none, for intervals to allow for.
    """
    return tuple(_with_all(search, e) if isinstance(e.target, NominalPrior) else e for e in effects)


def _with_all(search: Search, errors: Effect) -> Effect:
    """The errors as they are, with a value of every group."""
    groups = replace(search, by_mode=errors.target.by_mode).prior.groups
    closed = {g: JOINT.narrowest * size for g, size in JOINT.widest if g in set(groups) - set(errors.target.groups)}
    return nominal_errors(search.rig, replace(errors.target, waves=JOINT.last_waves, **closed), errors.values)


def surely_late(errors: Effect) -> Effect:
    """The errors with the sides of accelerometers open, but for those that are later than a gap makes them seem."""
    late = tuple(name for name in errors.target.late if errors.values[f"delay_{name}"] > JOINT.surely_late)
    return replace(errors, target=replace(errors.target, late=late, early=()))


def on_their_sides(search: Search, errors: Effect, effects: Sequence[Effect] = ()) -> Effect:
    """The errors with each accelerometer on that side of the jumps at the samples which the records show it to read.

    Those that are known to be late stay so. Predictions one sample ahead tell: what a wrong frequency does to whole
    records looks like any delay.
    """
    known = errors.target.late
    jumping = tuple(s.name for s in search.rig.sensors if s.quantity == "acceleration" and s.name not in known)
    if not jumping or not errors.target.delay or errors.target.interpolated:
        return errors
    none = {**errors.values, **{f"delay_{name}": 0.0 for name in jumping}}

    def left(delay: float) -> np.ndarray:
        tried = nominal_errors(search.rig, replace(errors.target, late=known, early=()), none)
        tried = replace(tried, values={**tried.values, **{f"delay_{name}": delay for name in jumping}})
        return search.ahead.residual(apply_all(search.rig, (*effects, tried)))

    # where motion is quick between samples, what a sensor reads a while before a jump is not what it reads at once
    delays = np.array([*(-delay for delay in JOINT.delays), 0.0, JUST_LATE, *JOINT.delays])
    residuals = {float(delay): left(float(delay)) for delay in delays}
    before, at, after = left(-JUST_LATE), residuals[0.0], residuals[JUST_LATE]
    with np.errstate(invalid="ignore"):  # of a motion that runs away nothing is late
        step, smooth = (search.ahead.by_channel(b - a).sum(axis=0) for a, b in ((at, after), (before, at)))
    powers = np.array([search.ahead.by_channel(residual).sum(axis=0) for residual in residuals.values()])
    rows = [j for j, s in enumerate(search.rig.sensors) if s.name in jumping and step[j] > JOINT.jump * smooth[j]]
    sided = {search.rig.sensors[j].name: float(delays[powers[:, j].argmin()]) for j in rows}
    late = (*known, *(name for name, delay in sided.items() if delay > 0))
    early = tuple(name for name, delay in sided.items() if delay <= 0)
    starts = {**errors.values, **{f"delay_{name}": delay for name, delay in sided.items()}}
    return nominal_errors(search.rig, replace(errors.target, late=late, early=early), starts)


def beside_inputs(search: Search, fitted: Fit, sensor_noise: np.ndarray) -> Search | None:
    """The search beside noise of the logged inputs as a set shows it; None where that is not what the set leaves.

    What most records would have louder than any logger's noise is none: a law that is missing grows with the level too.

    Args:
        search: without that noise.
        fitted: the set, errors of the nominal model among it.
        sensor_noise: (n_outputs,) mean square of each sensor's noise as found without it, over that of the stated one.
    """
    rig = apply_all(search.rig, fitted.effects)
    left, found = search.data.differences(rig), search.with_noise(np.sqrt(sensor_noise) * search.data.noise)
    # what is left is loud with noise of the inputs, so the stated noise of the sensors may be the better
    shares = [likeliest_share(rig, s.data, left) for s in (search, found)]
    (share, _, is_beyond), louder = min(zip(shares, (search, found), strict=True), key=lambda each: each[0].loss)
    if share < LEAST_LOGGED or is_beyond:
        return None
    beside = louder.beside_inputs(rig, share)
    white = measured(beside, fitted).fit
    if INPUTS.white < white.cost < INPUTS.bent * fitted.cost:
        fitted = white = fit_jointly(beside, fitted.effects[:-1], fitted.effects[-1]).fit
        rig = apply_all(search.rig, fitted.effects)
        left = search.data.differences(rig)
    if white.cost > INPUTS.white:
        return None
    for _ in range(INPUTS.rounds):  # each sensor's noise by the power of its innovations
        louder = louder.with_noise(louder.data.noise * np.sqrt(white.cost_by_channel.mean(axis=0)))
        beside = louder.beside_inputs(rig, likeliest_share(rig, louder.data, left).share)
        white = measured(beside, fitted).fit
    return beside


def likeliest_loss(search: Search, rig: Rig) -> float:
    """Minus the log-likelihood of what a rig leaves, beside as much noise of the logged inputs as is likeliest."""
    return likeliest_share(rig, search.data, search.data.differences(rig)).loss
