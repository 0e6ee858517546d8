"""Outputs sampled by a clock that runs faster or slower than that of the inputs, by a part in some thousands.

Sample k of such outputs is the motion at the time k(1 + ε)Δt, y(k) + ε k dy/dk to first order. The residual, regressed
on this column of the fitted motion beside all columns and tangents of the modes, and beside those of frequencies that
change with time, gives ε, common to all outputs, with its standard error. Outputs resampled to the inputs' clock give
the rest, until ε stays. Beside the changing frequencies ε is zero where the structure changes and the clock is one.

Accelerations under held inputs jump with these and have no interpolation: there no other clock is searched.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from workbench.arrays import scaled_inverse
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit, changes_of, normalised_basis, regressors, row_weights
from workbench.identification.input_output.time_variance import slopes_in_time
from workbench.identification.signal.modal_estimates import time_derivatives
from workbench.identification.signal.searches import TimeLimit
from workbench.records.band_limited import derivative_of, spaced
from workbench.records.record import Record


@dataclass(frozen=True)
class OutputClockSettings:
    """Constants of the search for a clock of the outputs of its own."""

    standard_errors: float = 8.0  # that ε must exceed; 3 where the stiffness falls by 3 % and the clock is one
    # share of the residual that resampling must remove: of 6000 samples with 1 % noise, 0.6 at 10 ppm, 0.98 at 200 ppm
    min_removed_share: float = 0.3
    # largest |ε|: clocks of quartz differ by 0.0002, and beyond this a sample rate is misstated
    max_rate: float = 0.002
    rounds: int = 6  # of resampling; 3 suffice for 500 ppm


OUTPUT_CLOCK = OutputClockSettings()


class OutputClock(NamedTuple):
    """By how much the intervals of the outputs' clock are too long, ε, and its standard error."""

    rate: float
    std: float


def output_clock(data: KnownInputs, fit: Fit) -> OutputClock:
    """The clock of the outputs that the residual of a fit shows, to first order."""
    x = regressors(data, fit.poles, fit.participation)
    in_time = slopes_in_time(data, fit, x)
    weights = row_weights(data)
    motion = data.as_samples((data.values - fit.residual) / weights)
    time = [data.first + np.arange(len(samples)) for samples in motion]
    late = data.rows_of([t[:, None] * derivative_of(y.T).T for t, y in zip(time, motion, strict=True)])
    known = normalised_basis(x) if data.weights is None else None
    size = 2 * fit.poles.size + 1
    normal, right_side = np.zeros((size, size)), np.zeros(size)
    for j, (a, noise, residual) in enumerate(zip(fit.amplitudes, fit.noise, fit.residual.T, strict=True)):
        weight = weights[:, j : j + 1]
        q = normalised_basis(weight * x) if known is None else known
        columns = weight * np.column_stack([changes_of(a, in_time), late[:, j]]) / noise
        columns -= q @ (q.T @ columns)
        normal += columns.T @ columns
        right_side += columns.T @ residual / noise
    inverse = scaled_inverse(normal)
    return OutputClock(float(inverse[-1] @ right_side), float(np.sqrt(inverse[-1, -1])))


def on_inputs_clock(record: Record, rate: float) -> Record:
    """The record with its outputs resampled to the inputs' clock, ε = `rate`, without samples after the last output."""
    n = min(record.n_samples, int((record.n_samples - 1) * (1.0 + rate)) + 1)
    outputs = spaced(record.outputs, 1.0 / (1.0 + rate), n)
    return replace(record, outputs=outputs, inputs=record.inputs[:, :n])


def on_one_clock(
    data: KnownInputs, fit: Fit, fitted: Callable[[KnownInputs], Fit], time_limit: TimeLimit
) -> tuple[KnownInputs, Fit] | None:
    """The data with the outputs resampled to the inputs' clock, and the fit to them; None where both clocks are one.

    From a fit to the records as measured of the modes that are sure; `fitted` finds these in other data.
    """
    jumps = data.hold == "zero" and (time_derivatives(data.records[0].output_channels) == 2).any()
    if jumps or not fit.poles.size:
        return None
    clock, rate, left = output_clock(data, fit), 0.0, 1.0
    if abs(clock.rate) < OUTPUT_CLOCK.standard_errors * clock.std:
        return None
    for _ in range(OUTPUT_CLOCK.rounds):
        rate += (1.0 + rate) * clock.rate
        if abs(rate) > OUTPUT_CLOCK.max_rate or time_limit.spent("search for a clock of the outputs of its own"):
            return None
        on_one = [on_inputs_clock(record, rate) for record in data.records]
        resampled = replace(data, records=on_one, clock=rate, line_std=None)
        other = fitted(resampled)
        if not other.poles.size:
            return None
        clock = output_clock(resampled, other)
        # the least of all rounds: where the frequencies change too, the modes that are sure differ from round to round
        left = min(left, float(np.mean((other.noise / fit.noise) ** 2)))
        if abs(clock.rate) < clock.std:
            return (resampled, other) if left < 1.0 - OUTPUT_CLOCK.min_removed_share else None
    return None


def clock_remarks(data: KnownInputs, fit: Fit) -> tuple[str, ...]:
    """A remark where the outputs were resampled to the inputs' clock."""
    if not data.clock:
        return ()
    rest = output_clock(data, fit)
    rate = (1.0 + data.clock) * (1.0 + rest.rate) - 1.0
    size = f"{1e6 * abs(rate):.1f} ± {1e6 * rest.std:.1g} ppm {'slow' if rate > 0 else 'fast'}"
    return (f"the outputs' clock runs {size} against the inputs': outputs resampled; log both by one clock",)
