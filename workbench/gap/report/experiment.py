"""What to measure next: the experiment that would separate two rival explanations best."""

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

LEVELS = (0.3, 1.0, 3.0)
SEPARATED = 25.0
PERIODS = 3.0  # of the first elastic mode: the shortest experiment, which a structure needs to answer
LONGEST = 1e3  # times the length of the record: what would take longer is seen in rounding, not in a measurement


@dataclass(frozen=True)
class Experiment:
    """A proposed measurement.

    Attributes:
        like: name of the record whose input it repeats.
        inputs: names of the inputs that are driven; the others rest.
        level: factor on that record's input.
        seconds: length at which the rivals differ by five standard deviations, no shorter than a record must be and
            than three periods of the first elastic mode; inf where they never would, or would in a thousand times the
            length of the record.
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
    """The experiment among variations of the records that separates two fits in the shortest time.

    For each variation both corrected rigs are simulated, and what small changes of either one's parameters could make
    up for is projected out; what is left of their difference, in units of the noise, grows with time.
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
    """Seconds that an experiment lasts at least."""
    elastic = rig.modes.frequencies_hz[rig.modes.frequencies_hz > 0]
    return float(max([LEAST_SAMPLES * sample_time, *PERIODS / elastic[:1]]))


def _choices(record: Record) -> list[tuple[str, ...]]:
    """All inputs that a record drives, and where they are several each alone."""
    driven = [name for name, row in zip(record.input_names, record.inputs, strict=True) if np.any(row)]
    return [tuple(driven)] + ([(name,) for name in driven] if len(driven) > 1 else [])


def _varied(record: Record, inputs: tuple[str, ...], level: float) -> Record:
    keep = np.array([name in inputs for name in record.input_names])
    return replace(record, inputs=record.inputs * (level * keep[:, None]))


def _separation(rig: Rig, best: Fit, rival: Fit, trial: FitData) -> float:
    """Squared difference left between the two, per second."""
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            first, of_first = _response(rig, best.effects, trial)
            second, of_second = _response(rig, rival.effects, trial)
        except (ValueError, np.linalg.LinAlgError):
            return 0.0
    difference = first - second
    tangent = np.column_stack([*of_first, *of_second]) if of_first or of_second else np.zeros((difference.size, 0))
    if not (np.isfinite(difference).all() and np.isfinite(tangent).all()):
        return 0.0
    if tangent.shape[1]:
        basis, sizes, _ = np.linalg.svd(tangent, full_matrices=False)
        basis = basis[:, sizes > 1e-9 * sizes.max()]
        difference = difference - basis @ (basis.T @ difference)
    record = trial.records[0]
    return float(difference @ difference) / (record.n_samples * record.sample_time)


def _response(rig: Rig, effects: tuple[Effect, ...], trial: FitData) -> tuple[np.ndarray, list[np.ndarray]]:
    """The residual under the effects, and its derivative by each of their parameters."""
    centre = trial.residual(apply_all(rig, effects))
    slopes = []
    for i, effect in enumerate(effects):
        for parameter in (
            () if effect.kind.applied_first else effect.parameters(rig)
        ):  # errors of the model stay as they are
            step = 1e-4 * max(abs(effect.values[parameter.name]), 1e-6)
            moved = dict(effect.values)
            moved[parameter.name] += step
            changed = (*effects[:i], replace(effect, values=moved), *effects[i + 1 :])
            slopes.append((trial.residual(apply_all(rig, changed)) - centre) / step)
    return centre, slopes
