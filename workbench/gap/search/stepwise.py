"""Effects added one after the other, each beside a nominal model that is a little wrong everywhere."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.limiting_cases import simpler_sets
from workbench.gap.effects.nominal import NominalPrior, group_of, nominal_errors
from workbench.gap.effects.structural import MODAL_DAMPING, MODULUS_ERROR
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.prediction.noise import logging_noise, noise_found
from workbench.gap.search.fit import Fit, fit
from workbench.gap.search.outcome import Decision
from workbench.gap.search.pursuit import FINE, one_more
from workbench.gap.search.search import Search, spread_over_kinds
from workbench.rig.simulate import is_stepped
from workbench.structure.member import Structure


@dataclass(frozen=True)
class StepwiseSettings:
    """Constants of the stepwise selection.

    Attributes:
        widest: largest standard deviation that is believed of each group of nominal errors; relative, but for damping
            (of its logarithm) and delay (of a sample). Laboratories keep within them; larger ones are effects.
        narrowest: smallest, as a share of the widest: what is learnt to be none stays differentiable.
        rounds: of learning the sizes, at most.
        settled: share of what is left that the next round must be likely to take away.
        iterations: of the fit in each round.
        candidates: effects fitted on whole records at each step.
        most: effects of a set; no case of the format hides more than three.
        excess: share of what the last step leaves above the noise that a further effect must take away. On practice
            cases the right one takes over 0.9, the best wrong one under 0.1.
        ahead: share of the cost one sample ahead that the best candidate must take away to be tried at all.
        simpler: share by which a set may leave more above the noise and still be taken for being simpler.
        needless: likewise, for a set with one effect less.
        explained: share of the nominal gap's power above the noise that an explanation may leave.
        in_part: likewise, for effects that are named although something else is there.
        no_gap: share of the noise power above it that is no gap: a tenth of the noise by amplitude is 0.2 of its power.
        damping, stiffness: common to all modes or all along, logarithm, from which on it is an effect of its own.
    """

    widest: tuple[tuple[str, float], ...] = (
        ("stiffness", 0.03),
        ("mass", 0.03),
        ("frequency", 0.01),
        ("damping", 0.4),
        ("delay", 0.5),
    )
    narrowest: float = 1e-3
    rounds: int = 6
    settled: float = 0.02
    iterations: int = 3
    candidates: int = 4
    most: int = 4
    excess: float = 0.5
    ahead: float = 0.005
    simpler: float = 0.05
    needless: float = 0.3
    explained: float = 0.01
    in_part: float = 0.2
    no_gap: float = 0.15
    damping: float = 0.5
    stiffness: float = 0.05


SETTINGS = StepwiseSettings()


@dataclass(frozen=True, eq=False)
class Step:
    """Effects beside nominal errors, fitted together.

    Attributes:
        fit: of both, the errors last.
        sensor_noise: (n_outputs,) mean square of each sensor's noise as found, over that of the stated noise.
        logged: noise of the logged inputs, as a share of their rms.
        noise_power: (n_records, n_outputs) mean square of both, over that of the stated noise of the sensors.
    """

    fit: Fit
    sensor_noise: np.ndarray
    logged: float
    noise_power: np.ndarray

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Without the errors."""
        return self.fit.effects[:-1]

    @property
    def errors(self) -> Effect:
        """Of the nominal model."""
        return self.fit.effects[-1]

    def excess(self, noise_power: np.ndarray) -> float:
        """Mean square left above that noise, in units of the stated one."""
        return float(np.maximum(self.fit.cost_by_channel - noise_power, 0.0).mean())


def fit_jointly(
    search: Search, effects: Sequence[Effect], errors: Effect, *, rounds: int = SETTINGS.rounds, finely: bool = False
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
        finely: by fine steps of time, where a law needs them.
    """
    data = search.data.stepped(FINE if finely else 4)
    before = np.inf
    for _ in range(rounds):
        left = data.residual(apply_all(search.rig, (*effects, errors)))
        level = max(float(left @ left) / left.size, 1.0)
        if level > (1.0 - SETTINGS.settled) * before:
            break
        before = level
        tempered = data.with_noise(data.noise * np.sqrt(level))
        found = fit(
            search.rig,
            (*effects, errors),
            tempered,
            iterations=SETTINGS.iterations,
            tolerance=1e-4,
            workers=search.workers,
        )
        *effects, errors = found.effects
        errors = _resized(errors)
    residuals = [
        record.outputs - predicted
        for record, predicted in zip(
            data.counted, data.predictions(apply_all(search.rig, (*effects, errors))), strict=True
        )
    ]
    by_channel = np.array([((r / data.noise[:, None]) ** 2).mean(axis=1) for r in residuals])
    step = replace(found, effects=(*effects, errors), cost=float(by_channel.mean()), cost_by_channel=by_channel)
    sensor_noise = (noise_found(residuals) / data.noise) ** 2
    per_unit = search.logging_noise
    logged = logging_noise(by_channel, sensor_noise, per_unit)
    return Step(step, sensor_noise, logged, sensor_noise + logged**2 * per_unit)


def _resized(errors: Effect) -> Effect:
    """The errors with prior deviations as large as the records make them."""
    prior = errors.target
    assert isinstance(prior, NominalPrior)
    sizes = {}
    for group, widest in SETTINGS.widest:
        if group not in prior.groups:
            continue
        names = [name for name in errors.values if group_of(name) == group]
        values = np.array([errors.values[name] for name in names])
        spread = np.array([errors.deviations[name] for name in names])
        known = np.clip(1.0 - (spread / getattr(prior, group)) ** 2, 0.0, 1.0).sum()
        size = np.sqrt((values**2).sum() / max(known, 1e-3))
        sizes[group] = float(np.clip(size, SETTINGS.narrowest * widest, widest))
    return replace(errors, target=replace(prior, **sizes))


def prior_of(search: Search) -> NominalPrior:
    """What a nominal model may be off by before any record is seen."""
    structured = isinstance(search.rig.structure, Structure)
    return NominalPrior(
        stiffness=0.02 if structured else 0.0,
        mass=0.02,
        frequency=0.0 if structured else 0.005,
        damping=0.2,
        delay=0.1,
        sample_time=search.data.records[0].sample_time,
    )


class Stepwise:
    """Stepwise selection of effects beside nominal errors, with going back.

    Attributes:
        search: what it works on.
        steps: the sets found, each with one effect more or one less than the last.
    """

    def __init__(self, search: Search):
        self.search = search
        search.report("small errors of the nominal model", 0.4)
        self.steps = [fit_jointly(search, (), nominal_errors(search.rig, prior_of(search)))]

    @property
    def last(self) -> Step:
        return self.steps[-1]

    def run(self) -> None:
        """Add effects as long as each takes most of what is left above the noise."""
        while len(self.last.effects) < SETTINGS.most and not self.explains(self.last):
            step = self._with_one_more(self.last)
            if step is None:
                break
            self.steps.append(step)
            self.steps.append(self._without_needless(step))
        self.steps.append(self._promoted(self.last))
        if any(is_stepped(apply_all(self.search.rig, (e,))) for e in self.last.effects):
            self.steps.append(fit_jointly(self.search, self.last.effects, self.last.errors, rounds=1, finely=True))

    def explains(self, step: Step) -> bool:
        """Whether next to nothing is left but noise."""
        excess = step.excess(step.noise_power)
        return excess < SETTINGS.no_gap * step.noise_power.mean()

    @property
    def unexplained(self) -> float:
        """Share of the nominal gap's power above the noise that the last set leaves."""
        return self.last.excess(self.last.noise_power) / self._gap

    @property
    def _gap(self) -> float:
        return max(float(np.maximum(self.search.nominal - self.last.noise_power, 0.0).mean()), 1e-12)

    def decision(self) -> Decision:
        """What the effects of the last set explain."""
        effects, left = self.last.effects, self.unexplained
        noise = np.sqrt(self.last.sensor_noise) * self.search.data.noise
        enough = self.explains(self.last) or left < SETTINGS.explained
        if enough or (len(effects) > 1 and left < SETTINGS.in_part):
            return Decision("explained" if effects else "none", self.last.fit, noise=noise)
        return Decision("part" if left < 0.5 else "unknown", self.last.fit, noise=noise)

    def _with_one_more(self, step: Step) -> Step | None:
        """The best set with one more effect, where it takes most of what is left."""
        search = self.search
        search.report("another effect beside small errors of the model", 0.5 + 0.1 * len(step.effects))
        beside = search.beside(step.errors)
        rig = apply_all(search.rig, (*step.effects, step.errors))
        left = beside.ahead.residual(rig)
        ahead = one_more(beside, step.effects, Evidence.of(rig, search.data, workers=search.workers))
        if not ahead or ahead[0].cost > (1.0 - SETTINGS.ahead) * (left @ left) / left.size:
            return None
        chosen = spread_over_kinds(ahead, 1)[: SETTINGS.candidates]
        tried = self._fitted([candidate.effects for candidate in chosen], step)
        best = self._simplest(min(tried, key=lambda s: s.fit.cost), tried)
        noise = np.minimum(best.noise_power, step.noise_power)
        return best if best.excess(noise) < (1.0 - SETTINGS.excess) * step.excess(noise) else None

    def _fitted(self, sets: Sequence[tuple[Effect, ...]], step: Step) -> list[Step]:
        return self.search.workers.map(
            lambda effects: fit_jointly(self.search, effects, step.errors, rounds=2), list(sets)
        )

    def _simplest(self, best: Step, tried: Sequence[Step]) -> Step:
        """The best, or a set that it comes to at bounds of its parameters, where that leaves hardly more."""
        keys = {step.fit.key for step in tried}
        fresh = [e for e in simpler_sets(best.effects, self.search.rig) if _key(e, best) not in keys]
        enough = (1.0 + SETTINGS.simpler) * max(best.excess(best.noise_power), SETTINGS.simpler)
        fewer = [
            step
            for step in (*tried, *self._fitted(fresh, best))
            if step.fit.n_parameters < best.fit.n_parameters and step.excess(best.noise_power) < enough
        ]
        return min(fewer, key=lambda s: (s.fit.n_parameters, s.fit.cost)) if fewer else best

    def _without_needless(self, step: Step) -> Step:
        """The set without effects that a later one has made needless."""
        if len(step.effects) < 2:
            return step
        fewer = self._fitted(list(_each_left_out(step.effects)), step)
        best = min(fewer, key=lambda s: s.fit.cost)
        enough = (1.0 + SETTINGS.needless) * max(step.excess(step.noise_power), SETTINGS.simpler)
        return self._without_needless(best) if best.excess(step.noise_power) < enough else step

    def _promoted(self, step: Step) -> Step:
        """The set with errors too large to be small, and common to all, as effects of their own."""
        values = step.errors.values
        damping = float(np.mean([v for n, v in values.items() if group_of(n) == "damping"] or [0.0]))
        stiffness = values.get("stiffness_0", 0.0) - values.get("mass_0", 0.0)
        named = {effect.kind for effect in step.effects}
        added, reset = [], dict(values)
        if abs(damping) > SETTINGS.damping and MODAL_DAMPING not in named:
            added.append(Effect(MODAL_DAMPING, None, {"factor": float(np.exp(damping))}))
            reset.update({n: v - damping for n, v in values.items() if group_of(n) == "damping"})
        if abs(stiffness) > SETTINGS.stiffness and MODULUS_ERROR not in named:
            added.append(Effect(MODULUS_ERROR, None, {"factor": float(np.exp(stiffness))}))
            reset.update({"stiffness_0": 0.0, "mass_0": 0.0})
        if not added:
            return step
        return fit_jointly(self.search, (*step.effects, *added), replace(step.errors, values=reset), rounds=2)


def _key(effects: Sequence[Effect], step: Step) -> tuple[str, ...]:
    return tuple(sorted(effect.label for effect in (*effects, step.errors)))


def _each_left_out(effects: tuple[Effect, ...]) -> Iterator[tuple[Effect, ...]]:
    for effect in effects:
        yield tuple(other for other in effects if other is not effect)
