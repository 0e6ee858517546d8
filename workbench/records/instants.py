"""The even sampling of a record from its instants, which may be written rounded, jitter, or be uneven."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from workbench.records.limits import RecordFileError
from workbench.records.units import time_factor, time_unit

UNIFORM = 1e-3  # of the time step
PART = 2**20  # steps checked together
# Steps within half of the median are resampled; a longer one may be a missing sample, whose step is twice the median.
MOST_UNEQUAL = 0.5
# Greatest distance of instants from even ones, of a step, peak to peak, at which the instants alone may be uneven:
# a missing one of at least so many makes more.
JITTER, FEWEST_JITTERED = 0.75, 16
FINEST_ROUNDING = 10  # decimals of a second
SLACK = 2.0**-23  # of the record's length: instants that were in single precision before
MOST_SLACK = 0.1  # of the rounding
FEWEST_ODD = 3  # least number of unequal steps if instants were rounded
MOST_DIGITS = 15  # of a rate
REMARKED, REFUSED = 1e-4, 1e-2  # relative widths of the allowed rates that are remarked, and refused
LATEST = 1e11  # s since 1970, in the year 5138: larger numbers count a smaller unit
# The signals' predictor that tells whether the instants or the samples are uneven.
ORDER, LONGEST_PART, MOST_SIGNALS = 32, 2**15, 8


@dataclass(frozen=True, eq=False)
class Sampling:
    """The sampling of a record, at equal steps."""

    start: float  # s
    step: float  # s
    times: np.ndarray | None = None  # (n_samples,) unequal instants, from which the signals are to be resampled
    remarks: tuple[str, ...] = ()  # on assumptions and changes


def in_seconds(name: str, values: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """A column of instants in s, and remarks.

    Without a unit in the name they are taken as s; where their size tells that they count ms, us or ns since 1970, as
    these, from the first on.
    """
    factor = time_factor(name) or 1.0
    for unit, smaller in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        if values.size and LATEST < factor * values[0] <= LATEST / smaller:
            counted = f"{name} from {values[0]:.0f} on: taken as {unit} since 1970, and counted from the first"
            return (values - values[0]) * smaller, (counted,)
    assumed = () if time_unit(name) else (f"{name} states no unit: taken as s",)
    return (values if factor == 1.0 else factor * values), assumed


def even_sampling(
    path: Path, time: np.ndarray, signals: Sequence[np.ndarray], stated_hz: float | None, row_of: Callable[[int], int]
) -> Sampling:
    """Start and step of sample instants, which may be rounded, or jitter, or be uneven.

    Args:
        path: of the file, for messages.
        time: (n_samples,) instants, s.
        signals: (n_samples,) each, at these instants.
        stated_hz: the rate where the user states it, which rounded instants may leave open.
        row_of: the number of a sample's row in the file.

    Raises:
        RecordFileError: samples that are missing, or rounding that leaves the rate open to 1 %.
    """
    start, n_samples = float(time[0]), time.size
    with np.errstate(over="ignore", invalid="ignore"):
        mean = float((time[-1] - time[0]) / (n_samples - 1))
        if 0 < mean < np.inf and _is_steady(time, mean):
            return Sampling(start, mean)
        steps = np.diff(time)
        median = float(np.median(steps))
        even = np.abs(steps - median) <= UNIFORM * abs(median)
    if 0 < median < np.inf and even.all():
        return Sampling(start, mean)
    shortest, longest = float(steps.min()), float(steps.max())
    if 0 < mean < np.inf:
        rounded = _rounded(path, time, steps, stated_hz)
        if rounded is not None:
            return rounded
        unequal = f"unequal time steps, {shortest:g} to {longest:g} s"
        resampled = Sampling(start, mean, time, (f"{unequal}: resampled every {mean:g} s by cubic splines",))
        if n_samples >= FEWEST_JITTERED and _steps_within(time, JITTER * mean) is not None:
            step, first = np.polyfit(np.arange(n_samples), time, 1)
            if _share_of(signals, (time - first) / step - np.arange(n_samples)) > 0.5:
                return resampled
            remark = f"{unequal}, but the signals have less noise at equal ones: taken as evenly sampled"
            return Sampling(float(first), float(step), remarks=(f"{remark} at {1 / step:.6g} Hz",))
        if np.abs(steps - median).max() <= MOST_UNEQUAL * median and shortest > 0:
            return resampled
    with np.errstate(over="ignore", invalid="ignore"):  # times near the largest number, whose differences are infinite
        relative = np.nan_to_num(steps / median if median else steps, posinf=1e300, neginf=-1e300)
    row = int(np.argmax(np.abs(relative - 1.0)))
    raise RecordFileError(f"{path} is not uniformly sampled: {_cause_and_remedy(time, steps, row, row_of)}")


def _cause_and_remedy(time: np.ndarray, steps: np.ndarray, worst: int, row_of: Callable[[int], int]) -> str:
    """What is wrong with instants, of which the `worst` step is the oddest, and the way out."""
    if not steps.any():
        return f"all its instants are equal, {time[0]:g} s; write the instants of its samples, or leave the column out"
    if (steps < 0).all():
        return f"its instants decrease, from {time[0]:g} to {time[-1]:g} s; sort the rows by time"
    if (steps < 0).any():
        row, count = int(np.argmax(steps < 0)), int((steps < 0).sum())
        remedy = "sort the rows by time" + (", or cut the record there if another begins" if count == 1 else "")
        where = f"row {row_of(row + 1)} is {-steps[row]:g} s before the one above"
        return f"its instants are out of order: {where}; {remedy}"
    median = float(np.median(steps))
    if steps[worst] == 0:
        count = int((steps == 0).sum())
        remedy = "remove the doubled row" + (f", and {count - 1} more like it" if count > 1 else "")
        return f"row {row_of(worst + 1)} has the instant of the one before, {time[worst]:g} s; {remedy}"
    return (
        f"row {row_of(worst + 1)} comes {steps[worst]:g} s after the one before, the others {median:g} s; fill the gap,"
        " or cut the record there"
    )


def _is_steady(time: np.ndarray, step: float) -> bool:
    """Whether all steps are near one value, and so near their median; checked in parts, without copying the record."""
    parts = (time[first : first + PART + 1] for first in range(0, time.size - 1, PART))
    return all((np.abs(np.diff(part) - step) <= 0.4 * UNIFORM * step).all() for part in parts)


def _rounded(path: Path, time: np.ndarray, steps: np.ndarray, stated_hz: float | None) -> Sampling | None:
    """The sampling of equal steps whose instants were rounded to a power of ten; None for other instants."""
    rounding = next((r for r in (10.0**-d for d in range(FINEST_ROUNDING)) if _are_multiples(time, r)), None)
    if rounding is None:
        return None
    # one or two unequal steps are missing samples, not rounding, unless most instants are equal
    (usual, often), *_ = Counter(np.round(steps / rounding).tolist()).most_common(1)
    if usual != 0 and steps.size - often < FEWEST_ODD:
        return None
    within = _steps_within(time, rounding + min(SLACK * np.ptp(time), MOST_SLACK * rounding))
    if within is None:
        return None
    low, high = 1.0 / within[1], 1.0 / within[0] if within[0] > 0 else np.inf
    stated = stated_hz if stated_hz is not None and low <= stated_hz <= high else None
    width = high / low - 1.0
    span = f"rates from {low:.7g} to {high:.7g} Hz" if high < np.inf else f"any rate above {low:.7g} Hz"
    allowed = f"times rounded to {rounding:g} s allow {span}"
    if width > REFUSED and stated is None:
        raise RecordFileError(f"{path}: {allowed}, which is too uncertain; state the rate by sample_rate_hz")
    rate = _roundest(low, high) if stated is None else stated
    remark = f"{allowed}: taken as evenly sampled at {rate:.7g} Hz"
    if width > REMARKED and stated is None:
        remark += f"; frequencies and rates of decay are uncertain by as much, {100 * width:.2g} %:"
        remark += " state the rate by `sample_rate_hz` if you know it"
    residual = time - np.arange(time.size) / rate
    return Sampling(float(residual.max() + residual.min()) / 2, 1.0 / rate, remarks=(remark,))


def _are_multiples(time: np.ndarray, unit: float) -> bool:
    scaled = time / unit
    return bool(np.abs(scaled - np.round(scaled)).max() <= 1e-9 * max(np.abs(scaled).max(), 1.0))


def _steps_within(time: np.ndarray, width: float) -> tuple[float, float] | None:
    """Least and greatest step >= 0 of even instants from which `time` differs by `width` peak to peak; None if none.

    The difference is convex in the step and piecewise linear, so that Newton's method from outside ends at each bound.
    """
    index, least = np.arange(time.size), 1e-9 * width + 8 * np.spacing(np.abs(time).max())
    bounds = []
    for side in (-1.0, 1.0):
        step, excess = float(time[-1] - time[0] + side * width) / (time.size - 1), np.inf
        while excess > least:
            residual = time - step * index
            high, low = int(residual.argmax()), int(residual.argmin())
            excess = float(residual[high] - residual[low]) - width
            if excess > least:
                if side * (low - high) <= 0:  # beyond the least difference
                    return None
                step += excess / (high - low)
        bounds.append(step)
    return max(bounds[0], 0.0), bounds[1]


def _roundest(low: float, high: float) -> float:
    """The number from low to high that has the fewest digits, or whose inverse has fewer: the nearest to the middle."""
    middle = (low + high) / 2
    for digits in range(1, MOST_DIGITS):
        for rate in (float(f"{middle:.{digits}g}"), 1.0 / float(f"{1.0 / middle:.{digits}g}")):
            if low <= rate <= high:
                return rate
    return middle


def _share_of(signals: Sequence[np.ndarray], offsets: np.ndarray) -> float:
    """The share s of the offsets of the instants from even ones, in steps, that the samples follow.

    Samples y_i = u(i + s d_i) are u(i) + s d_i u'(i). What a linear predictor leaves of y is compared with what it
    leaves of d u', for s by least squares: 1 where the samples are uneven, 0 where the written instants alone are. Less
    noise after resampling than before would not tell, as splines smooth.
    """
    from scipy.interpolate import CubicSpline

    both = squares = 0.0
    for row in signals[:: -(-len(signals) // MOST_SIGNALS)]:
        first = max(min(int(np.abs(row - row.mean()).argmax()), row.size - LONGEST_PART), 0)
        part = slice(first, first + LONGEST_PART)
        y, d = row[part] - row[part].mean(), offsets[part]
        if y.size < 4 * ORDER or not np.ptp(y):
            continue
        moved = d * CubicSpline(np.arange(y.size), y)(np.arange(y.size), 1)
        windows, moved_windows = (np.lib.stride_tricks.sliding_window_view(x, ORDER + 1) for x in (y, moved))
        predictor = np.linalg.lstsq(windows[:, :-1], windows[:, -1], rcond=None)[0]
        left, left_moved = (w[:, -1] - w[:, :-1] @ predictor for w in (windows, moved_windows))
        scale = float(left @ left) or 1.0
        both, squares = both + float(left @ left_moved) / scale, squares + float(left_moved @ left_moved) / scale
    return both / squares if squares else 1.0
