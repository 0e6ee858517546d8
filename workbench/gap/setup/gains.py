"""Whether a gain is a factor of units, or another one that is near it by chance."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations

import numpy as np

from workbench.arrays import Floats
from workbench.gap.setup.compared import FELT, Compared
from workbench.gap.setup.corrections import SetupFault
from workbench.gap.setup.words import FACTORS, TURN, G, perhaps

NEAR = 0.15  # relative error of a gain that still is that factor: the least ratio of two of them is 1.56
SAME = 0.1  # of a factor's logarithm that gains may differ by from record to record: of 2π by a factor 1.2
GAIN_TAKES = 0.5  # share of what a factor leaves beyond the noise that a gain near it takes away: it is no unit then
CALIBRATED = 1e-3  # relative: a gain nearer to a factor is that factor (9.81 for 9.80665 is 3.4e-4)
GAIN_CHI2 = 25.0  # and five standard deviations of the gain, in noise that is white
MAY_BE_GAIN = (G, 1.0 / G, TURN, 1.0 / TURN)  # the other factors are further from one than errors of calibration


def factor_near(gain: float) -> float | None:
    """The factor of `FACTORS` that a gain is near to; None for any other."""
    near = [factor for factor in FACTORS if gain * factor > 0 and abs(gain / factor - 1.0) < NEAR]
    return min(near, key=lambda factor: abs(gain / factor - 1.0), default=None)


def is_gain(gain: float, factor: float, left: float, freely: float, noise: float, n_samples: int) -> bool:
    """Whether a gain is near a factor of units by chance: it differs beyond its error, and explains far more.

    Args:
        left, freely, noise: sums of squares that the factor leaves, that the gain leaves, and of the noise.
    """
    if factor not in MAY_BE_GAIN or abs(gain / factor - 1.0) < CALIBRATED:
        return False
    taken = left - freely
    return bool(taken > GAIN_TAKES * (left - noise) and taken * n_samples > GAIN_CHI2 * freely)


def in_doubt_by_record(gap: Compared, fault: SetupFault) -> SetupFault:
    """A fault; in doubt where the records that it brings nearer to the model differ in gain.

    A factor of units is the same in all; what an amplifier that saturates leaves is another one at each level.
    """
    if not fault.certain:
        return fault
    nearer = []
    for was, gains in zip(gap.log_ratios, gains_once_corrected(gap, fault), strict=True):
        felt = np.isfinite(gains)
        if felt.any() and np.median(np.abs(gains[felt])) < np.median(np.abs(was[felt])):
            nearer.append(gains)
    if apart(nearer) <= same_gain(fault):
        return fault
    but = f"from record to record the gain differs by a factor {np.exp(apart(nearer)):.2g}"
    what = perhaps(fault.sentence.split(": multiply")[0])
    return replace(fault, certain=False, sentence=f"{what}; but {but}, as where an amplifier saturates.")


def gains_once_corrected(gap: Compared, fault: SetupFault) -> Floats:
    """(n_records, n_outputs, n_modes) logarithms of the gains that a correction leaves; nan where it is not felt."""
    after = gap.corrected(fault.correction).log_ratios
    return np.where(np.abs(after - gap.log_ratios) > FELT, after, np.nan)


def apart(gains: Iterable[Floats]) -> float:
    """By how much the logarithms of the gains of two records differ, in the median of the bands that both show."""
    differences = [both[np.isfinite(both)] for both in (one - other for one, other in combinations(gains, 2))]
    return max((float(abs(np.median(both))) for both in differences if both.size), default=0.0)


def same_gain(fault: SetupFault) -> float:
    """By how much they may differ: no limit where the fault is none of units."""
    return SAME * abs(np.log(fault.factor)) if fault.factor != 1.0 else np.inf
