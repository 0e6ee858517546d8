"""What records can show: which effects, before any fit, and in which experiment two alternative sets differ soonest."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.gap.effects.catalogue import CATALOGUE, in_words
from workbench.gap.effects.effect import COORDINATES, Effect, Kind, apply_all, can_be
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import Workers
from workbench.gap.search.fit import Fit
from workbench.gap.setup.record_checks import MIN_SAMPLES
from workbench.records.record import Record
from workbench.renamed import Renamed
from workbench.rig.rig import Rig
from workbench.structure.domain import Between, Location, same_place

INDISTINGUISHABLE = 0.995  # correlation of two responses
DETECTABLE = 25.0  # of chi-squared: five standard deviations
THINNING = 3  # every third value of the residual is used
SUBSTEPS = 2  # of a sample: detectability needs no more
DECADES = (1e2, 1e-2, 1e4, 1e-4)  # factors on a strength, tried one after the other

LEVELS = (0.3, 1.0, 3.0)  # factors on the input of a record
PERIODS = 3.0  # of the first elastic mode: shortest experiment, since a structure takes time to respond
LONGEST = 1e3  # times the length of the record: a difference that takes longer to show is a rounding error


@dataclass(frozen=True, eq=False)
class Detectability:
    """Which effects the records can show and which they can distinguish, before any fit.

    Attributes:
        strengths: change of the residual by an effect, in standard deviations, by its label; at the first strength that
            is detectable, or at the one with the largest change.
        undetectable: labels of effects that are detectable at no strength.
        indistinguishable: pairs of labels whose responses are the same up to a factor, with their correlation.
    """

    strengths: dict[str, float]
    undetectable: tuple[str, ...]
    indistinguishable: tuple[tuple[str, str, float], ...]

    invisible, alike = Renamed("undetectable"), Renamed("indistinguishable")


def detectability(reconstruction: ForceReconstruction, *, catalogue: tuple[Kind, ...] = CATALOGUE) -> Detectability:
    """The detectability of each kind of effect, from simulations at a strength that the records show."""
    rig, data = reconstruction.rig, reconstruction.data.stepped(SUBSTEPS)
    base = data.residual(rig)
    labels, responses, strengths = [], [], {}
    candidates = [(k, target) for k in catalogue if k.found_in != "residual" for target in k.targets(rig)]
    found = reconstruction.workers.map(lambda each: _first_detectable(*each, reconstruction, data, base), candidates)
    for effect, change in found:
        if effect is None:
            continue
        size = float(np.linalg.norm(change))
        strengths[effect.label] = size * float(np.sqrt(THINNING))
        if size**2 * THINNING > DETECTABLE:
            labels.append(effect.label)
            responses.append((change / size).astype(np.float32))
    correlation = np.abs(np.array(responses) @ np.array(responses).T) if responses else np.zeros((0, 0))
    same = [
        (labels[i], labels[j], float(correlation[i, j]))
        for i, j in combinations(range(len(labels)), 2)
        if correlation[i, j] > INDISTINGUISHABLE and labels[i].split("[")[0] != labels[j].split("[")[0]
    ]
    return Detectability(
        strengths=strengths,
        undetectable=tuple(label for label, size in strengths.items() if size**2 <= DETECTABLE),
        indistinguishable=tuple(sorted(same, key=lambda pair: -pair[2])),
    )


def _first_detectable(
    kind: Kind, target: Any, reconstruction: ForceReconstruction, data: FitData, base: Floats
) -> tuple[Effect | None, Floats]:
    """An effect at the first detectable strength, or at that of largest change; and its change (n,) of the residual."""
    best, change, most = None, np.zeros(0), -1.0
    for effect in _at_strengths(kind, target, reconstruction):
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                moved = (data.residual(effect.apply(reconstruction.rig)) - base)[::THINNING]
                chi_squared = float(moved @ moved) * THINNING
            except (ValueError, np.linalg.LinAlgError):
                continue
        if np.isfinite(chi_squared) and chi_squared > most:
            best, change, most = effect, moved, chi_squared
        if most > DETECTABLE:
            break
    return best, change


def _at_strengths(kind: Kind, target: Any, reconstruction: ForceReconstruction) -> Iterator[Effect]:
    """An effect at the start values of a search, and with each parameter of the first and last changed by decades.

    Start values follow from the unmodelled force. If there is none they are arbitrary: their place may be at a support,
    where no effect shows. So the place of largest motion is tried last.
    """
    starts = [Effect(kind, target, dict(values)) for values in kind.starts(reconstruction, target)]
    if starts:
        yield starts[0]
        yield from _by_decades(starts[0], reconstruction.rig)
        yield from starts[1:]
        yield from _by_decades(starts[-1], reconstruction.rig)
        if starts[0].at is not None:
            moved = starts[0].moved_to(_place_of_largest_motion(reconstruction))
            yield moved
            yield from _by_decades(moved, reconstruction.rig)


def _place_of_largest_motion(reconstruction: ForceReconstruction) -> Location:
    """The place with the largest displacement, among those where a force is searched for."""
    power = sum(motion.displacement @ motion.displacement.T for motion in reconstruction.motions)
    places = [where for where in reconstruction.places if not isinstance(where, Between)]
    shapes = reconstruction.rig.modes.phi(places)
    largest: Location = same_place(places[int(np.argmax(np.sum((shapes @ power) * shapes, axis=1)))])
    return largest


def _by_decades(effect: Effect, rig: Rig) -> Iterator[Effect]:
    """The effect with one parameter, but no coordinate, multiplied by each factor of `DECADES`."""
    for factor in DECADES:
        for parameter in effect.parameters(rig):
            if parameter.name not in COORDINATES:
                moved = float(np.clip(effect.values[parameter.name] * factor, parameter.low, parameter.high))
                yield replace(effect, values={**effect.values, parameter.name: moved})


@dataclass(frozen=True)
class Experiment:
    """A proposed measurement.

    Attributes:
        like: name of the record whose input it repeats.
        inputs: names of the inputs that are driven; the others are zero.
        level: factor on that record's input.
        seconds: length at which the alternatives differ by five standard deviations, at least 16 samples and three
            periods of the first elastic mode; inf if that takes over a thousand times the length of the record.
        alternatives: labels of the two explanations it separates.
        time: name of the unit of time.
    """

    like: str
    inputs: tuple[str, ...]
    level: float
    seconds: float
    alternatives: tuple[str, str]
    time: str = "s"

    rivals = Renamed("alternatives")

    @property
    def sentence(self) -> str:
        one, other = map(in_words, self.alternatives)
        if not np.isfinite(self.seconds):
            return f"No experiment on this rig separates {one} from {other}."
        return (
            f"To separate {one} from {other}: drive {' and '.join(self.inputs)} as in record"
            f" {self.like} at {self.level:g} times its level, for {self.seconds:.3g} {self.time}."
        )


def next_experiment(rig: Rig, best: Fit, alternative: Fit, data: FitData, workers: Workers) -> Experiment:
    """The experiment, among variations of the records, that distinguishes two fits in the shortest time.

    Both corrected rigs are simulated for each variation. The part of their difference that small changes of either
    one's parameters could cancel is projected out; the rest, in units of the noise, grows with time.
    """
    names = (best.named, alternative.named)
    elastic = rig.modes.frequencies_hz[rig.modes.frequencies_hz > 0]

    def experiment(choice: tuple[Record, tuple[str, ...], float]) -> Experiment:
        record, inputs, level = choice
        factors = level * np.array([name in inputs for name in record.input_names])
        varied = replace(record, inputs=record.inputs * factors[:, None])
        rate = _separation(rig, best, alternative, replace(data, records=(varied,)))
        if not rate * LONGEST * record.n_samples * record.sample_time > DETECTABLE:
            return Experiment("", (), 1.0, np.inf, names)
        seconds = max(DETECTABLE / rate, MIN_SAMPLES * record.sample_time, *PERIODS / elastic[:1])
        return Experiment(record.name, inputs, level, float(seconds), names)

    choices = []
    for record in data.records:
        driven = tuple(name for name, row in zip(record.input_names, record.inputs, strict=True) if np.any(row))
        alone = [(name,) for name in driven] if len(driven) > 1 else []
        choices += [(record, inputs, level) for inputs in (driven, *alone) for level in LEVELS]
    return min(workers.map(experiment, choices), key=lambda each: each.seconds)


def _separation(rig: Rig, best: Fit, alternative: Fit, trial: FitData) -> float:
    """Squared difference of two fits over the noise variance, per second, with their tangent spaces projected out."""
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            first, first_slopes = _response(rig, best.effects, trial)
            second, second_slopes = _response(rig, alternative.effects, trial)
        except (ValueError, np.linalg.LinAlgError):
            return 0.0
    difference, slopes = first - second, [*first_slopes, *second_slopes]
    if not np.isfinite([difference, *slopes]).all():
        return 0.0
    if slopes:
        basis, singular, _ = np.linalg.svd(np.column_stack(slopes), full_matrices=False)
        basis = basis[:, singular > 1e-9 * singular.max()]
        difference = difference - basis @ (basis.T @ difference)
    record = trial.records[0]
    return float(difference @ difference) / (record.n_samples * record.sample_time)


def _response(rig: Rig, effects: tuple[Effect, ...], trial: FitData) -> tuple[np.ndarray, list[np.ndarray]]:
    """Residual (n,) with the effects, and its derivatives (n,) with respect to each of their parameters."""
    centre = trial.residual(apply_all(rig, effects))
    slopes = []
    for i, effect in enumerate(effects):
        if effect.kind.applied_first:  # nominal errors are held fixed
            continue
        for name, value in ((p.name, effect.values[p.name]) for p in effect.parameters(rig)):
            size = 1e-4 * max(abs(value), 1e-6)
            ahead, behind = (
                (*effects[:i], replace(effect, values={**effect.values, name: value + step}), *effects[i + 1 :])
                for step in (size, -size)
            )
            # backwards from the end of the structure, or from another limit
            changed, step = (ahead, size) if can_be(rig, ahead) else (behind, -size)
            slopes.append((trial.residual(apply_all(rig, changed)) - centre) / step)
    return centre, slopes
