"""Before a fit: do the records fit the model, which effects could they show, and which could they not tell apart?"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.effect import Effect, Kind
from workbench.gap.effects.environment import RANDOM_DISTURBANCE
from workbench.gap.evidence import Evidence
from workbench.gap.prediction import FitData
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import simulate

ALIKE = 0.995
SEEN = 25.0  # of chi-squared: five standard deviations
TURNED = -0.95
STUCK = 0.5
THINNING = 3


class RecordsError(ValueError):
    """Records that cannot be of the rig they came with."""


@dataclass(frozen=True, eq=False)
class Readiness:
    """What the records could tell, before anything is fitted.

    Attributes:
        strengths: label of an effect -> how far it would move the residual, in standard deviations, at the strength
            where a search would start.
        invisible: labels of effects that these records cannot show at that strength.
        alike: pairs of labels whose responses are the same up to a factor, with their correlation.
    """

    strengths: dict[str, float]
    invisible: tuple[str, ...]
    alike: tuple[tuple[str, str, float], ...]


def check_records(rig: Rig, records: Sequence[Record]) -> None:
    """Refuse records whose channels cannot be what the rig says they are.

    Raises:
        RecordsError: a sensor that reads with the wrong sign, a saturated or flat channel, a record shorter than a
            period of the first mode, inputs that are all at rest.
    """
    elastic = rig.modes.omega[rig.modes.omega > 0]
    _check_not_stuck(rig, records)
    signs = []
    for record in records:
        if elastic.size and record.n_samples * record.sample_time < 2 * np.pi / elastic[0]:
            raise RecordsError(
                f"record {record.name!r} lasts {record.n_samples * record.sample_time:g} s, less than a period of the"
                f" first mode ({2 * np.pi / elastic[0]:g} s); take a longer record"
            )
        if record.n_inputs and not np.any(record.inputs):
            continue
        predicted = simulate(rig, record.inputs, sample_time=record.sample_time).outputs
        row = []
        for sensor, measured, expected in zip(rig.sensors, record.outputs, predicted, strict=True):
            if np.ptp(measured) == 0:
                raise RecordsError(f"record {record.name!r}: output {sensor.name!r} is flat; is the sensor alive?")
            row.append(np.corrcoef(measured, expected)[0, 1] if np.ptp(expected) > 0 else 0.0)
        signs.append(row)
    if not signs:
        raise RecordsError("every input of every record is at rest; there is nothing to compare")
    turned = np.flatnonzero((np.array(signs) < TURNED).all(axis=0))
    if turned.size and turned.size < len(rig.sensors):
        name = rig.sensors[turned[0]].name
        raise RecordsError(
            f"output {name!r} reads with the wrong sign: its correlation with the model is"
            f" {np.array(signs)[:, turned[0]].mean():.2f} in every record; turn it round"
        )


def _check_not_stuck(rig: Rig, records: Sequence[Record]) -> None:
    """A sensor that clips in some records is an effect to be named; one that clips most of the time shows nothing."""
    for j, sensor in enumerate(rig.sensors):
        top = max(float(np.abs(record.outputs[j]).max()) for record in records)
        stuck = [np.abs(record.outputs[j]) >= top * (1 - 1e-9) for record in records]
        share = np.concatenate(stuck).mean()
        if top > 0 and share > STUCK:
            raise RecordsError(
                f"record {records[int(np.argmax([s.mean() for s in stuck]))].name!r}: output {sensor.name!r} stands at"
                f" ±{top:g} for {100 * share:.0f} % of all its samples: it is saturated; lower the level or the gain"
            )


def readiness(rig: Rig, data: FitData, *, catalogue: tuple[Kind, ...] = CATALOGUE) -> Readiness:
    """Simulate each effect once, at a strength where a search would start, and compare the responses."""
    evidence = Evidence.of(rig, data, 20)
    base = data.residual(rig)
    labels, signatures, strengths = [], [], {}
    for kind in catalogue:
        if kind is RANDOM_DISTURBANCE:
            continue
        for target in kind.targets(rig):
            values = next(iter(kind.starts(evidence, target)), None)
            if values is None:
                continue
            effect = Effect(kind, target, dict(values))
            with np.errstate(over="ignore", invalid="ignore"):
                try:
                    change = (data.residual(effect.apply(rig)) - base)[::THINNING]
                except (ValueError, np.linalg.LinAlgError):
                    continue
                size = float(np.linalg.norm(change))
            if not np.isfinite(size):
                continue
            strengths[effect.label] = size * float(np.sqrt(THINNING))
            if size**2 * THINNING > SEEN:
                labels.append(effect.label)
                signatures.append((change / size).astype(np.float32))
    correlation = np.abs(np.array(signatures) @ np.array(signatures).T) if signatures else np.zeros((0, 0))
    alike = [
        (labels[i], labels[j], float(correlation[i, j]))
        for i in range(len(labels))
        for j in range(i + 1, len(labels))
        if correlation[i, j] > ALIKE and labels[i].split("[")[0] != labels[j].split("[")[0]
    ]
    return Readiness(
        strengths=strengths,
        invisible=tuple(label for label, size in strengths.items() if size**2 <= SEEN),
        alike=tuple(sorted(alike, key=lambda pair: -pair[2])),
    )
