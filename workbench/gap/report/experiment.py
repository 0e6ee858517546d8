"""The next experiment: the one that would distinguish two rival explanations in the shortest time."""

from dataclasses import dataclass, replace

import numpy as np

from workbench.gap.effects.catalogue import in_words
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import Workers
from workbench.gap.report.record_checks import LEAST_SAMPLES
from workbench.gap.search.fit import Fit
from workbench.records.record import Record
from workbench.rig.rig import Rig

LEVELS = (0.3, 1.0, 3.0)  # factors on the input of a record
SEPARATED = 25.0  # squared difference over the noise variance: five standard deviations
PERIODS = 3.0  # of the first elastic mode: shortest experiment, since a structure takes time to respond
LONGEST = 1e3  # times the length of the record: a difference that takes longer to show is a rounding error


@dataclass(frozen=True)
class Experiment:
    """A proposed measurement.

    Attributes:
        like: name of the record whose input it repeats.
        inputs: names of the inputs that are driven; the others are zero.
        level: factor on that record's input.
        seconds: length at which the rivals differ by five standard deviations, at least 16 samples and three periods of
            the first elastic mode; inf if that takes over a thousand times the length of the record.
        rivals: labels of the two explanations it separates.
        time: name of the unit of time.
    """

    like: str
    inputs: tuple[str, ...]
    level: float
    seconds: float
    rivals: tuple[str, str]
    time: str = "s"

    @property
    def sentence(self) -> str:
        """The proposal in a sentence."""
        one, other = map(in_words, self.rivals)
        if not np.isfinite(self.seconds):
            return f"No experiment on this rig separates {one} from {other}."
        return (
            f"To separate {one} from {other}: drive {' and '.join(self.inputs)} as in record"
            f" {self.like} at {self.level:g} times its level, for {self.seconds:.3g} {self.time}."
        )


def next_experiment(rig: Rig, best: Fit, rival: Fit, data: FitData, workers: Workers) -> Experiment:
    """The experiment, among variations of the records, that distinguishes two fits in the shortest time.

    Both corrected rigs are simulated for each variation. The part of their difference that small changes of either
    one's parameters could cancel is projected out; the rest, in units of the noise, grows with time.
    """
    names = (best.named, rival.named)

    def experiment(record: Record, inputs: tuple[str, ...], level: float) -> Experiment:
        rate = _separation(rig, best, rival, replace(data, records=(_varied(record, inputs, level),)))
        separates = rate * LONGEST * record.n_samples * record.sample_time > SEPARATED
        seconds = max(SEPARATED / rate, _shortest(rig, record.sample_time)) if separates else np.inf
        return Experiment(record.name, inputs, level, seconds, names)

    choices = [(record, inputs, level) for record in data.records for inputs in _choices(record) for level in LEVELS]
    tried = workers.map(lambda choice: experiment(*choice), choices)
    soonest = min(tried, key=lambda each: each.seconds)
    return soonest if np.isfinite(soonest.seconds) else Experiment("", (), 1.0, np.inf, names)


def _shortest(rig: Rig, sample_time: float) -> float:
    """Length in seconds of the shortest experiment."""
    elastic = rig.modes.frequencies_hz[rig.modes.frequencies_hz > 0]
    return float(max([LEAST_SAMPLES * sample_time, *PERIODS / elastic[:1]]))


def _choices(record: Record) -> list[tuple[str, ...]]:
    """The sets of inputs to drive: all that a record drives, and each of them alone if there are several."""
    driven = [name for name, row in zip(record.input_names, record.inputs, strict=True) if np.any(row)]
    return [tuple(driven)] + ([(name,) for name in driven] if len(driven) > 1 else [])


def _varied(record: Record, inputs: tuple[str, ...], level: float) -> Record:
    """The record with some of its inputs multiplied by `level` and the others zero."""
    keep = np.array([name in inputs for name in record.input_names])
    return replace(record, inputs=record.inputs * (level * keep[:, None]))


def _separation(rig: Rig, best: Fit, rival: Fit, trial: FitData) -> float:
    """Squared difference of two fits over the noise variance, per second, with their tangent spaces projected out."""
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            first, first_slopes = _response(rig, best.effects, trial)
            second, second_slopes = _response(rig, rival.effects, trial)
        except (ValueError, np.linalg.LinAlgError):
            return 0.0
    difference = first - second
    slopes = [*first_slopes, *second_slopes]
    tangent = np.column_stack(slopes) if slopes else np.zeros((difference.size, 0))
    if not (np.isfinite(difference).all() and np.isfinite(tangent).all()):
        return 0.0
    if tangent.shape[1]:
        basis, singular, _ = np.linalg.svd(tangent, full_matrices=False)
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
        for parameter in effect.parameters(rig):
            step = 1e-4 * max(abs(effect.values[parameter.name]), 1e-6)
            values = dict(effect.values)
            values[parameter.name] += step
            changed = (*effects[:i], replace(effect, values=values), *effects[i + 1 :])
            slopes.append((trial.residual(apply_all(rig, changed)) - centre) / step)
    return centre, slopes
