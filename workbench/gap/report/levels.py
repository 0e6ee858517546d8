"""Whether the residual grows with the level of the inputs."""

from collections.abc import Sequence

import numpy as np

from workbench.gap.localisation.where import WHERE
from workbench.gap.prediction.residuals import lead_of
from workbench.gap.report.budget import block_length
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import predict

STEADY = 0.5  # exponent of the level: residuals of constant size have a smaller one; errors of a linear model have 1
SURE = 2.0  # standard errors of that exponent


def steady_remainder(rig: Rig, records: Sequence[Record], *, settle: float = 0.0) -> str | None:
    """A remark if the residual above the noise is of the same size at all levels of the inputs; else None.

    Its rms is fitted by a power of the level; the standard error of the exponent follows from the scatter over blocks
    of a record.

    Args:
        rig: corrected.
        records: at several levels; those without inputs or with a residual at the noise floor are ignored.
        settle: seconds at the start of each record that are not compared.
    """
    noise = np.array([sensor.noise_std for sensor in rig.sensors])[:, None]
    by_level = []
    for record in records:
        level = np.sqrt(np.mean(record.inputs**2))
        lead = lead_of(record, settle)
        power = (((record.outputs - predict(rig, record))[:, lead:] / noise) ** 2).mean(axis=0)
        if level > 0 and power.mean() > (1.0 + WHERE.clear) ** 2:
            blocks = np.array_split(power, power.size // block_length(rig, record))
            means = np.array([block.mean() for block in blocks])
            scatter = means.std(ddof=1) / np.sqrt(means.size)
            by_level.append((level, power.mean() - 1.0, scatter / (power.mean() - 1.0), record.name))
    by_level.sort()
    if len(by_level) < 2 or by_level[-1][0] < WHERE.louder * by_level[0][0]:
        return None
    levels, powers, scatters = np.array([each[:3] for each in by_level]).T
    weights = 4.0 / scatters**2  # inverse variances of the logarithm of the rms
    x, y = np.log(levels), 0.5 * np.log(powers)
    x, y = x - np.average(x, weights=weights), y - np.average(y, weights=weights)
    spread = (weights * x**2).sum()
    exponent = (weights * x * y).sum() / spread
    if abs(exponent) + SURE / np.sqrt(spread) > STEADY:
        return None
    (low, _, _, quiet), (high, _, _, loud) = by_level[0], by_level[-1]
    rms = np.sqrt(powers)
    return (
        f"The residual does not grow with the inputs: it is {rms[0]:.3g} times the noise in record {quiet!r} and"
        f" {rms[-1]:.3g} times in {loud!r}, whose inputs are {high / low:.2g} times as large. Possible causes are an"
        " excitation that is not measured (measure it, or keep it away), noise that is louder than stated, and a force"
        " of constant size, such as dry friction or play."
    )
