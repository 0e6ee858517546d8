"""Whether a gain is a factor of units, or an error of calibration that is near one by chance."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations

import numpy as np

from workbench.arrays import Floats
from workbench.gap.setup.comparison import AFFECTED, Comparison
from workbench.gap.setup.corrections import SetupFault
from workbench.gap.setup.sentences import FACTORS, TURN, G, with_may

NEAR = 0.15  # largest relative difference of a gain from a factor near it: the smallest ratio of two factors is 1.56
# of a factor's logarithm: largest difference of the log gains of two records (2π: a factor 1.2 between them)
SAME_GAIN = 0.1
# an error of calibration removes a larger share of the residual power beyond the noise that the factor leaves
GAIN_SHARE = 0.5
GAIN_CHI2 = 25.0  # and differs from the factor by five standard errors, in white noise
CALIBRATED = 1e-3  # relative: a gain closer to a factor is that factor (9.81 for 9.80665 is 3.4e-4)
AMBIGUOUS = (
    G,
    1.0 / G,
    TURN,
    1.0 / TURN,
)  # factors that a wrong calibration may reach; the others are too far from one


def factor_near(gain: float) -> float | None:
    """The factor of `FACTORS` nearest to a gain; None if none is near."""
    near = [factor for factor in FACTORS if gain * factor > 0 and abs(gain / factor - 1.0) < NEAR]
    return min(near, key=lambda factor: abs(gain / factor - 1.0), default=None)


def is_calibration_error(
    gain: float, factor: float, with_factor: float, with_gain: float, noise: float, n_samples: int
) -> bool:
    """Whether a gain is near a factor of units by chance: it differs significantly, and explains far more.

    Args:
        gain: estimated by least squares.
        factor: of units.
        with_factor, with_gain: sums of squared residuals with the factor and with the gain.
        noise: sum of squares of the noise.
        n_samples: number of samples in each sum.
    """
    if factor not in AMBIGUOUS or abs(gain / factor - 1.0) < CALIBRATED:
        return False
    removed = with_factor - with_gain
    return bool(removed > GAIN_SHARE * (with_factor - noise) and removed * n_samples > GAIN_CHI2 * with_gain)


def with_doubt_by_record(gap: Comparison, fault: SetupFault) -> SetupFault:
    """The fault, marked as in doubt if the gains of the records that its correction improves differ.

    A factor of units is the same in all records; the gain of an amplifier that saturates depends on the level.
    """
    if not fault.certain:
        return fault
    improved = []
    for was, gains in zip(gap.log_ratios, log_gains_after(gap, fault), strict=True):
        at = np.isfinite(gains)
        if at.any() and np.median(np.abs(gains[at])) < np.median(np.abs(was[at])):
            improved.append(gains)
    difference = largest_difference(improved)
    if difference <= tolerated_difference(fault):
        return fault
    but = f"from record to record the gain differs by a factor {np.exp(difference):.2g}"
    what = with_may(fault.sentence.split(": multiply")[0])
    return replace(fault, certain=False, sentence=f"{what}; but {but}, as where an amplifier saturates.")


def log_gains_after(gap: Comparison, fault: SetupFault) -> Floats:
    """Log gains (n_records, n_outputs, n_modes) after a correction; NaN in bands that it does not affect."""
    after = gap.corrected(fault.correction).log_ratios
    return np.where(np.abs(after - gap.log_ratios) > AFFECTED, after, np.nan)


def largest_difference(log_gains: Iterable[Floats]) -> float:
    """Largest difference of the log gains of two records, each the median over the bands that both have."""
    differences = [both[np.isfinite(both)] for both in (one - other for one, other in combinations(log_gains, 2))]
    return max((float(abs(np.median(both))) for both in differences if both.size), default=0.0)


def tolerated_difference(fault: SetupFault) -> float:
    """Difference of the log gains of two records that a fault allows; infinite if it is not one of units."""
    return SAME_GAIN * abs(np.log(fault.factor)) if fault.factor != 1.0 else np.inf
