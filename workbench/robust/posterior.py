"""A corrected rig with its uncertainty, and rigs drawn from it: the posterior of a diagnosis."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from workbench.arguments import whole
from workbench.arrays import Floats
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.effect import COORDINATES, Effect, Kind, Parameter, apply_all, names_in
from workbench.gap.effects.nominal import NOMINAL_ERRORS, IdentifiedPrior, NominalPrior
from workbench.gap.effects.nonlinear import BEYOND
from workbench.gap.report.verdict import Verdict
from workbench.gap.search.fit import Fit, parameters_of
from workbench.renamed import Renamed
from workbench.rig.rig import Rig
from workbench.structure.domain import Between
from workbench.structure.modes import frozen
from workbench.threads import one_blas_thread

# Largest standard deviations in free coordinates for which a fit counts as linear: a factor e, a tenth of the extent.
# A parameter that the records hardly determine has a larger one, which is clipped.
WIDEST, WIDEST_PLACE = 1.0, 10.0
LIKELY = 0.01  # probability above which an alternative set is drawn too
MOST_TRIES = 20  # draws until one is a feasible rig
EXPLAINED = ("none", "explained")  # outcomes without an unexplained gap
LATER = ("places_of_inputs", "places_of_outputs", "quantities_of_outputs", "damping_rates")  # not in early verdicts
WHAT_DRAWS = "draws, the number of realisations of the uncertain rig,"


@dataclass(frozen=True, eq=False)
class UncertainRig:
    """A corrected rig with its uncertainty: sets of effects, with the joint covariance of their parameters.

    Attributes:
        nominal: the rig without any effect.
        effects: the central estimate.
        covariance: (n_parameters, n_parameters) of the free coordinates of all parameters, effect by effect.
        unexplained: root mean square of the residual without noise, over that of the readings: a relative error |Δ| of
            the model's output, y_real = (1 + Δ) y.
        outcome: of the diagnosis.
        alternatives: other sets of effects that the records do not exclude, each with its probability.
    """

    nominal: Rig
    effects: tuple[Effect, ...]
    covariance: np.ndarray
    unexplained: float = 0.0
    outcome: str = "explained"
    alternatives: tuple[tuple["UncertainRig", float], ...] = ()

    rivals = Renamed("alternatives")

    def __post_init__(self) -> None:
        object.__setattr__(self, "effects", tuple(self.effects))
        object.__setattr__(self, "covariance", frozen(self.covariance))
        n = len(self._parameters)
        if self.covariance.shape != (n, n):
            raise ValueError(
                f"UncertainRig.covariance must have one row per parameter of the effects, shape ({n}, {n}); got"
                f" {self.covariance.shape}"
            )
        if not (np.isfinite(self.unexplained) and self.unexplained >= 0):
            raise ValueError(f"UncertainRig.unexplained must be 0 or more; got {self.unexplained}")

    @classmethod
    def of(cls, verdict: Verdict) -> "UncertainRig":
        """The corrected rig of a verdict, with the covariance of its effects and the alternatives not excluded.

        Raises:
            TypeError: not a verdict.
        """
        if not isinstance(verdict, Verdict):
            raise TypeError(
                f"the uncertainty of a rig comes from the verdict of diagnose; got {type(verdict).__name__}. A rig that"
                " is known for certain is UncertainRig(rig, (), np.zeros((0, 0))), from workbench.robust.posterior"
            )
        nominal, best = verdict.nominal, verdict.attribution.best
        likely = [(fit, p) for fit, p in verdict.attribution.alternatives if p > LIKELY]
        alternatives = [(cls(nominal, fit.effects, _covariance(nominal, fit)), p) for fit, p in likely]
        found = best.effects, _covariance(nominal, best), _unexplained(verdict), verdict.outcome
        return cls(nominal, *found, tuple(alternatives))

    @cached_property
    def rig(self) -> Rig:
        """The corrected rig at the central estimate."""
        return apply_all(self.nominal, self.effects)

    @property
    def explained(self) -> bool:
        """Whether the effects explain the gap, so that the draws cover the real structure."""
        return self.outcome in EXPLAINED

    @cached_property
    def _parameters(self) -> list[tuple[int, Parameter]]:
        return parameters_of(self.nominal, self.effects)

    @one_blas_thread
    def draws(self, n: int, seed: int | np.random.Generator = 0) -> tuple[Rig, ...]:
        """Rigs (n,) drawn from the posterior, alternative sets in proportion to their probability.

        Draws are normal in the free coordinates of the fit, within the bounds of each parameter. An infeasible rig,
        such as a buckled beam, is drawn again.

        Args:
            n: number of rigs.
            seed: of the draws, or a generator.

        Raises:
            TypeError: n is no number.
            ValueError: n is not a whole number of 1 or more, or hardly any draw is feasible.
        """
        n = whole(n, WHAT_DRAWS, least=1)
        rng = np.random.default_rng(seed)
        sets = [self, *(alternative for alternative, _ in self.alternatives)]
        shares = np.array([p for _, p in self.alternatives])
        shares = np.r_[max(1.0 - shares.sum(), 0.0), shares]
        chosen = rng.choice(len(sets), n, p=shares / shares.sum())
        return tuple(sets[i]._drawn(rng) for i in chosen)

    def _drawn(self, rng: np.random.Generator) -> Rig:
        """One feasible rig drawn from this set of effects."""
        for _ in range(MOST_TRIES):
            effects = self._at(self._root @ rng.standard_normal(self._root.shape[1]))
            try:
                return apply_all(self.nominal, effects)
            except (ValueError, np.linalg.LinAlgError):
                continue
        raise ValueError(
            f"none of {MOST_TRIES} draws of {' and '.join(e.label for e in self.effects)} is a feasible rig: the"
            " records hardly determine the sizes of these effects; measure more records before a redesign"
        )

    @cached_property
    def _root(self) -> np.ndarray:
        """R with R Rᵀ the covariance, rows scaled down to the largest deviations, `WIDEST`."""
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        deviations = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        widest = [
            WIDEST_PLACE if p.name in COORDINATES else WIDEST if p.logarithmic else np.inf for _, p in self._parameters
        ]
        return np.asarray(root * np.minimum(1.0, widest / deviations)[:, None])

    def _at(self, offsets: np.ndarray) -> tuple[Effect, ...]:
        """The effects with their free coordinates moved by (n_parameters,) offsets."""
        values = [dict(effect.values) for effect in self.effects]
        for (i, parameter), offset in zip(self._parameters, offsets, strict=True):
            free = parameter.to_free(values[i][parameter.name]) + offset
            values[i][parameter.name] = parameter.from_free(float(free))
        return tuple(replace(effect, values=v) for effect, v in zip(self.effects, values, strict=True))

    def to_json(self) -> dict[str, Any]:
        """A JSON object from which `from_json` restores the uncertain rig, given its nominal rig."""
        return {
            "nominal": _nominal_json(self.nominal),
            "effects": [_effect_json(effect) for effect in self.effects],
            "covariance": self.covariance.tolist(),
            "unexplained": self.unexplained,
            "outcome": self.outcome,
            "alternatives": [[each.to_json(), probability] for each, probability in self.alternatives],
        }

    @classmethod
    def from_json(
        cls, nominal: Rig, written: Mapping[str, Any], *, catalogue: Sequence[Kind] = CATALOGUE
    ) -> "UncertainRig":
        """The uncertain rig that `to_json` wrote, for its nominal rig.

        Args:
            nominal: of the case.
            written: by `to_json`.
            catalogue: kinds of the effects, with any user-defined ones.

        Raises:
            ValueError: another nominal rig, an effect of an unknown kind, of a channel that the rig does not have or
                without its numbers, or a covariance of another size.
        """
        kinds = {kind.name: kind for kind in (*catalogue, *BEYOND, NOMINAL_ERRORS)}
        unknown = [entry["kind"] for entry in written["effects"] if entry["kind"] not in kinds]
        if unknown:
            raise ValueError(f"no effect is called {unknown[0]!r}; give a catalogue that contains it")
        for what, own in _nominal_json(nominal).items():
            stated = written["nominal"].get(what, own) if what in LATER else written["nominal"][what]
            if not _equal(stated, own):
                raise ValueError(
                    f"the verdict is of another rig: its {what.replace('_', ' ')} are {_listed(stated)}, and here"
                    f" {_listed(own)}; diagnose this case again"
                )
        effects = tuple(_effect(nominal, kinds[entry["kind"]], entry) for entry in written["effects"])
        n = len(parameters_of(nominal, effects))
        covariance = _covariance_read(written["covariance"], n)
        sets = written["alternatives"]
        alternatives = tuple((cls.from_json(nominal, each, catalogue=catalogue), p) for each, p in sets)
        return cls(nominal, effects, covariance, written["unexplained"], written["outcome"], alternatives)


def _nominal_json(rig: Rig) -> dict[str, list[Any]]:
    """The properties by which a nominal rig is recognised."""
    text = rig.modes.domain.text
    return {
        "inputs": [a.name for a in rig.actuators],
        "outputs": [s.name for s in rig.sensors],
        "places_of_inputs": [text(a.at) for a in rig.actuators],
        "places_of_outputs": [text(s.at) for s in rig.sensors],
        "quantities_of_outputs": [s.quantity for s in rig.sensors],
        "frequencies_hz": rig.modes.frequencies_hz.tolist(),
        "damping_rates": np.diag(rig.modes.damping).tolist(),
    }


def _equal(stated: Sequence[Any], own: Sequence[Any]) -> bool:
    if own and isinstance(own[0], float):
        return len(stated) == len(own) and bool(np.allclose(stated, own, rtol=1e-6))
    return list(stated) == list(own)


def _listed(values: Sequence[Any]) -> str:
    return ", ".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in values)


def _covariance(nominal: Rig, fit: Fit) -> np.ndarray:
    """The joint covariance of a fit's free coordinates; diagonal where only standard deviations are known."""
    parameters = parameters_of(nominal, fit.effects)
    if fit.covariance is not None and fit.covariance.shape == (len(parameters),) * 2:
        return fit.covariance
    variances = []
    for i, parameter in parameters:
        effect, name = fit.effects[i], parameter.name
        slope, deviation = parameter.slope(effect.values[name]), effect.std.get(name, 0.0)
        variances.append((deviation / slope) ** 2 if slope and np.isfinite(deviation) else 0.0)
    return np.diag(variances)


def _unexplained(verdict: Verdict) -> float:
    """RMS of the residual without noise over that of the readings; see `UncertainRig.unexplained`."""
    shrinkage, budget = verdict.shrinkage, verdict.budget
    if verdict.outcome in EXPLAINED:
        gaps = verdict.where.record_gaps if shrinkage is None else list(shrinkage.before.values())
        return float(np.sqrt(budget.unexplained * np.mean(np.square(gaps))))
    if shrinkage is not None:
        noise = max(budget.noise_ratio, 1.0)
        excess = [shrinkage.after[name] ** 2 - (noise * floor) ** 2 for name, floor in shrinkage.floor.items()]
        return float(np.sqrt(max(float(np.mean(excess)), 0.0)))
    data, best = verdict.attribution.search.data, verdict.attribution.best
    scales = np.array([record.outputs.std(axis=1) for record in data.counted])
    beyond = np.maximum(best.cost_by_channel - (verdict.attribution.noise / data.noise) ** 2, 0.0)
    return float(np.sqrt(np.mean(beyond * (data.noise / scales) ** 2)))


def _effect_json(effect: Effect) -> dict[str, Any]:
    target = effect.target
    if isinstance(target, NominalPrior):
        target = {"prior": asdict(target)}
    elif isinstance(target, IdentifiedPrior):
        target = {"identified": target.root.tolist()}
    values = {n: {"between": list(v)} if isinstance(v, Between) else v for n, v in effect.values.items()}
    return {"kind": effect.kind.name, "target": target, "values": values, "deviations": dict(effect.std)}


def _effect(nominal: Rig, kind: Kind, written: Mapping[str, Any]) -> Effect:
    target = written["target"]
    if isinstance(target, Mapping) and "identified" in target:
        target = _identified(nominal, np.array(target["identified"], float))
    elif isinstance(target, Mapping):
        prior: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in target["prior"].items()}
        target = NominalPrior(**prior)
    elif isinstance(target, list):
        target = tuple(target)
    values = {n: Between(*v["between"]) if isinstance(v, Mapping) else v for n, v in written["values"].items()}
    effect = Effect(kind, target, values, dict(written["deviations"]))
    _check_effect(nominal, effect)
    return effect


def _check_effect(nominal: Rig, effect: Effect) -> None:
    """Refuse an effect on a target that the rig does not have, or without a value of a parameter."""
    known = {"all", *(name for target in effect.kind.targets(nominal) for name in names_in(target))}
    unknown = [name for name in names_in(effect.target) if name not in known]
    if unknown:
        raise ValueError(f"{effect.kind.name} acts on {unknown[0]!r}, which the rig does not have; diagnose it again")
    for parameter in effect.parameters(nominal):
        value = effect.values.get(parameter.name)
        if not isinstance(value, int | float) or not np.isfinite(value):
            raise ValueError(f"{effect.label} needs a number {parameter.name!r}; got {value!r}: diagnose it again")


def _covariance_read(written: Any, n: int) -> np.ndarray:
    """The covariance (n, n) of a written verdict, checked to be finite."""
    try:
        covariance = np.array(written, float) if n else np.zeros((0, 0))
    except ValueError:
        covariance = np.array(np.nan)
    if covariance.shape != (n, n) or not np.isfinite(covariance).all():
        raise ValueError(f"the covariance must be {n} by {n} finite numbers, one row per parameter; diagnose it again")
    return covariance


def _identified(nominal: Rig, root: Floats) -> IdentifiedPrior:
    """The prior of errors of identified modes, with the root of their covariance from a written verdict."""
    prior = IdentifiedPrior.of_modes(nominal)
    if prior is None or prior.root.shape[0] != root.shape[0]:
        raise ValueError(
            "the verdict has errors of identified modes, so its rig must have the covariance of its modes; give the rig"
            " as rig_from makes it"
        )
    return replace(prior, root=root)
