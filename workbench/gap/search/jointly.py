"""Effects and errors of the nominal model fitted together, the sizes of the errors learnt from the records."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import JUST_LATE, NominalPrior, group_of, nominal_errors, weight_of
from workbench.gap.prediction.logged_inputs import logging_noise
from workbench.gap.prediction.noise import noise_found
from workbench.gap.search.fit import Fit, fit
from workbench.gap.search.pursuit import FINE
from workbench.gap.search.search import Search


@dataclass(frozen=True)
class JointSettings:
    """Constants of fits beside errors of the nominal model.

    Attributes:
        widest: largest standard deviation that is believed of each group of nominal errors; relative, but for damping
            (of its logarithm) and delay (of a sample). Laboratories keep within them; larger ones are effects.
        plausible: share of the widest that errors of a careful laboratory keep within; where they are larger, an effect
            that makes them smaller is named although they leave little.
        small: standard deviations below which smaller ones save nothing.
        decisive: description length, nats, of a factor e in the power that is left above the noise.
        last_waves: cosines of a variation in the last fit, so that intervals allow for what fewer cannot follow.
        narrowest: smallest, as a share of the widest: what is learnt to be none stays differentiable.
        rounds, most_rounds: of learning the sizes, at most; those that a fall of the cost went before do not count as
            such, but are not without end.
        falling: share of what was left that a round leaves where the cost falls.
        settled, last_settled: share of what is left that a round must have taken away for another; in the last fit.
        iterations, tolerance: of the fit in each round.
        last_iterations, last_tolerance: of the last fit, which intervals are taken from.
        credible: times the stated noise that noise found may be; more is a gap.
        surely_late: of a sample: an accelerometer that is later stays on its side of the jumps when an effect is added;
            what was seen of the others may have been the gap.
        delays: of a sample: what accelerometers are tried to be late or early by, to see which side of jumps they read.
        jump: times the power of the change over the span before a sample that the change after it has at a jump.
    """

    widest: tuple[tuple[str, float], ...] = (
        ("stiffness", 0.015),
        ("mass", 0.015),
        ("frequency", 0.01),
        ("damping", 0.25),
        ("delay", 0.5),
        ("record", 0.02),
    )
    plausible: float = 0.95
    small: tuple[tuple[str, float], ...] = (
        ("stiffness", 0.004),
        ("mass", 0.004),
        ("frequency", 0.001),
        ("damping", 0.1),
        ("delay", 0.1),
        ("record", 0.001),
    )
    decisive: float = 300.0
    last_waves: int = 13
    narrowest: float = 1e-3
    rounds: int = 4
    most_rounds: int = 12
    falling: float = 0.3
    settled: float = 0.02
    last_settled: float = 1e-3
    iterations: int = 4
    tolerance: float = 1e-4
    last_iterations: int = 6
    last_tolerance: float = 1e-7
    credible: float = 3.0
    surely_late: float = 0.05
    delays: tuple[float, ...] = (0.1, 0.25, 0.5)
    jump: float = 10.0


SETTINGS = JointSettings()


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
        return all(
            getattr(self.errors.target, group) < SETTINGS.plausible * widest for group, widest in SETTINGS.widest
        )

    def description(self, noise_power: np.ndarray, *, of_errors_alone: bool = False) -> float:
        """Description length, nats, of what is left above that noise and of the errors."""
        left = 0.0
        if not of_errors_alone:
            left = SETTINGS.decisive * np.log1p(self.excess(noise_power) / float(noise_power.mean()))
        for group, small in SETTINGS.small:
            size = getattr(self.errors.target, group)
            count = sum(group_of(name) == group for name in self.errors.values)
            left += count * np.log(max(size, small) / small)
        return float(left)

    def excess(self, noise_power: np.ndarray) -> float:
        """Mean square left above that noise, in units of the stated one."""
        return float(np.maximum(self.fit.cost_by_channel - noise_power, 0.0).mean())


def fit_jointly(
    search: Search,
    effects: Sequence[Effect],
    errors: Effect,
    *,
    rounds: int = SETTINGS.rounds,
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
        rounds: of sizes.
        known: (n_values, n_errors) sensitivities to the errors on the two most telling records, in units of the stated
            noise, where they are at hand: then the fit is of these records alone.
        to_the_end: until no step lowers the cost, by fine steps of time where a law needs them.
    """
    substeps = FINE if to_the_end else 4
    if to_the_end:
        errors = replace(errors, target=replace(errors.target, waves=SETTINGS.last_waves))
    if known is None:
        errors = opened(search, errors)
    whole, before = search.data.stepped(substeps), np.inf
    i = counted = 0
    while counted < rounds and i < SETTINGS.most_rounds:
        # the two most telling records lead the way
        quickly = known is not None or (i == 0 and not to_the_end)
        data = search.quick.stepped(substeps) if quickly else whole
        left = data.residual(apply_all(search.rig, (*effects, errors)))
        level = max(float(left @ left) / left.size, 1.0)
        if level > (1.0 - (SETTINGS.last_settled if to_the_end else SETTINGS.settled)) * before:
            break
        counted += level > SETTINGS.falling * before or not np.isfinite(before)
        before = level if known is not None or not quickly else np.inf
        i += 1
        tempered = data.tempered(level)
        found = fit(
            search.rig,
            (*effects, errors),
            tempered,
            iterations=SETTINGS.last_iterations if to_the_end else SETTINGS.iterations,
            tolerance=SETTINGS.last_tolerance if to_the_end else SETTINGS.tolerance,
            workers=search.workers,
            known=None if known is None else known / np.sqrt(level),
            chord=True,
        )
        *effects, errors = found.effects
        errors = _resized(errors)
    return measured(search, replace(found, effects=(*effects, errors if to_the_end else _closed(errors))), substeps)


def measured(search: Search, found: Fit, substeps: int = 4) -> Step:
    """Effects and errors, the errors last, as they leave the records of a search."""
    whole, rig = search.data.stepped(substeps), apply_all(search.rig, found.effects)
    if search.logged:
        by_channel = whole.by_channel(whole.residual(rig))
        of_noise = np.ones_like(by_channel)
        step = replace(found, cost=float(by_channel.mean()), cost_by_channel=by_channel)
        return Step(step, of_noise[0], search.logged, of_noise)
    residuals = whole.differences(rig)
    with np.errstate(over="ignore", invalid="ignore"):  # of a motion that runs away
        by_channel = np.array([((r / whole.noise[:, None]) ** 2).mean(axis=1) for r in residuals])
        sensor_noise = np.minimum(noise_found(residuals) / whole.noise, SETTINGS.credible) ** 2
    step = replace(found, cost=float(by_channel.mean()), cost_by_channel=by_channel)
    per_unit = search.logging_noise
    logged = logging_noise(by_channel, sensor_noise, per_unit)
    return Step(step, sensor_noise, logged, sensor_noise + logged**2 * per_unit)


def _resized(errors: Effect) -> Effect:
    """The errors with prior deviations as large as the records make them."""
    prior = errors.target
    assert isinstance(prior, NominalPrior)
    sizes: dict[str, Any] = {}
    for group, widest in SETTINGS.widest:
        if group not in prior.groups:
            continue
        names = [name for name in errors.values if group_of(name) == group]
        weights = np.array([weight_of(name, prior) for name in names])
        values = np.array([errors.values[name] for name in names]) / weights
        spread = np.array([errors.deviations[name] for name in names]) / weights
        known = np.clip(1.0 - (spread / getattr(prior, group)) ** 2, 0.0, 1.0).sum()
        size = np.sqrt((values**2).sum() / max(known, 1e-3))
        sizes[group] = float(np.clip(size, SETTINGS.narrowest * widest, widest))
    return replace(errors, target=replace(prior, **sizes))


def _closed(errors: Effect) -> Effect:
    """The errors without the groups that were learnt to be none: what is not there costs no time."""
    none = [g for g, widest in SETTINGS.widest if getattr(errors.target, g) <= 1.01 * SETTINGS.narrowest * widest]
    none = [group for group in none if group != "delay" or not errors.target.late]
    kept = {name: value for name, value in errors.values.items() if group_of(name) not in none}
    deviations = {name: errors.deviations[name] for name in kept if name in errors.deviations}
    target = replace(errors.target, **dict.fromkeys(none, 0.0))
    return replace(errors, target=target, values=kept, deviations=deviations)


def opened(search: Search, errors: Effect) -> Effect:
    """The errors with all groups, those that were closed at none and with the sizes they had before any record."""
    before = search.prior
    closed = {g: getattr(before, g) for g, _ in SETTINGS.widest if not getattr(errors.target, g)}
    return nominal_errors(search.rig, replace(errors.target, **closed), errors.values)


def surely_late(errors: Effect) -> Effect:
    """The errors with the sides of accelerometers open, but for those that are later than a gap makes them seem."""
    late = tuple(name for name in errors.target.late if errors.values[f"delay_{name}"] > SETTINGS.surely_late)
    return replace(errors, target=replace(errors.target, late=late, early=()))


def on_their_sides(search: Search, errors: Effect, effects: Sequence[Effect] = ()) -> Effect:
    """The errors with each accelerometer on that side of the jumps at the samples which the records show it to read.

    Those that are known to be late stay so. Predictions one sample ahead tell: what a wrong frequency does to whole
    records looks like any delay.
    """
    known = errors.target.late
    jumping = tuple(s.name for s in search.rig.sensors if s.quantity == "acceleration" and s.name not in known)
    if not jumping or not errors.target.delay:
        return errors
    none = {**errors.values, **{f"delay_{name}": 0.0 for name in jumping}}

    def left(delay: float) -> np.ndarray:
        tried = nominal_errors(search.rig, replace(errors.target, late=known, early=()), none)
        tried = replace(tried, values={**tried.values, **{f"delay_{name}": delay for name in jumping}})
        return search.ahead.residual(apply_all(search.rig, (*effects, tried)))

    # where motion is quick between samples, what a sensor reads a while before a jump is not what it reads at once
    delays = np.array([*(-delay for delay in SETTINGS.delays), 0.0, JUST_LATE, *SETTINGS.delays])
    residuals = {float(delay): left(float(delay)) for delay in delays}
    before, at, after = left(-JUST_LATE), residuals[0.0], residuals[JUST_LATE]
    step, smooth = (search.ahead.by_channel(b - a).sum(axis=0) for a, b in ((at, after), (before, at)))
    powers = np.array([search.ahead.by_channel(residual).sum(axis=0) for residual in residuals.values()])
    rows = [j for j, s in enumerate(search.rig.sensors) if s.name in jumping and step[j] > SETTINGS.jump * smooth[j]]
    sided = {search.rig.sensors[j].name: float(delays[powers[:, j].argmin()]) for j in rows}
    late = (*known, *(name for name, delay in sided.items() if delay > 0))
    early = tuple(name for name, delay in sided.items() if delay <= 0)
    starts = {**errors.values, **{f"delay_{name}": delay for name, delay in sided.items()}}
    return nominal_errors(search.rig, replace(errors.target, late=late, early=early), starts)
