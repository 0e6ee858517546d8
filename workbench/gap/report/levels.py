"""Whether what is left of records grows with their inputs."""

from collections.abc import Sequence

import numpy as np

from workbench.gap.localisation.where import WHERE
from workbench.gap.prediction.residuals import lead_of
from workbench.gap.report.budget import block_length
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import predict

STEADY = 0.5  # power of the level: what is left grows by less, where it is of one size; errors of a model grow by 1
SURE = 2.0  # standard deviations


def steady_remainder(rig: Rig, records: Sequence[Record], *, settle: float = 0.0) -> str | None:
    """A remark where what a rig leaves above the noise is of one size at all levels of the inputs; None elsewhere.

    Its rms is fitted by a power of the level; how sure that power is follows from the scatter of blocks of a record.

    Args:
        rig: with what was found.
        records: at several levels; those without inputs, and with no more than noise left, do not count.
        settle: seconds at the start of each record that do not count.
    """
    noise = np.array([sensor.noise_std for sensor in rig.sensors])[:, None]
    found = []
    for record in records:
        level = np.sqrt(np.mean(record.inputs**2))
        lead = lead_of(record, settle)
        power = (((record.outputs - predict(rig, record))[:, lead:] / noise) ** 2).mean(axis=0)
        if level > 0 and power.mean() > (1.0 + WHERE.clear) ** 2:
            blocks = np.array_split(power, power.size // block_length(rig, record))
            means = np.array([block.mean() for block in blocks])
            scatter = means.std(ddof=1) / np.sqrt(means.size)
            found.append((level, power.mean() - 1.0, scatter / (power.mean() - 1.0), record.name))
    found.sort()
    if len(found) < 2 or found[-1][0] < WHERE.louder * found[0][0]:
        return None
    levels, powers, scatters = np.array([each[:3] for each in found]).T
    weights = 4.0 / scatters**2  # of half the logarithm of a power
    x, y = np.log(levels), 0.5 * np.log(powers)
    x, y = x - np.average(x, weights=weights), y - np.average(y, weights=weights)
    spread = (weights * x**2).sum()
    exponent = (weights * x * y).sum() / spread
    if abs(exponent) + SURE / np.sqrt(spread) > STEADY:
        return None
    (low, _, _, quiet), (high, _, _, loud) = found[0], found[-1]
    sizes = np.sqrt(powers)
    return (
        f"What is left does not grow with the inputs: it is {sizes[0]:.3g} times the noise in record {quiet!r} and"
        f" {sizes[-1]:.3g} times in {loud!r}, whose inputs are {high / low:.2g} times as large. An excitation that is"
        " not measured shows so (measure it, or keep it away), noise that is louder than stated, or a force of one"
        " size, such as dry friction or play."
    )
