"""Decimation of records, after a low-pass filter."""

from dataclasses import replace

import numpy as np
from scipy.signal import firwin, oaconvolve

from workbench.arguments import whole
from workbench.records.record import Record

HALF_WIDTH = 10


def decimate(record: Record, factor: int) -> Record:
    """Every `factor`-th sample after a low-pass filter at 0.8 of the new Nyquist frequency.

    The filter is causal, so that a free decay remains one: amplitudes and phases of its modes change equally at all
    sensors. The initial transient of the filter is cut off.

    Args:
        record: free decay or any other.
        factor: 1 or more.

    Raises:
        ValueError: a record shorter than the filter, or a factor that is no whole number of 1 or more.
    """
    if whole(factor, "the factor of a decimation", least=1) == 1:
        return record
    taps = firwin(2 * HALF_WIDTH * factor + 1, 0.8 / factor)
    if record.n_samples < 2 * taps.size:
        raise ValueError(
            f"record {record.name!r} has {record.n_samples} samples; decimation by {factor} needs {2 * taps.size}:"
            " take a smaller factor"
        )

    def reduced(signals: np.ndarray) -> np.ndarray:
        filtered: np.ndarray = oaconvolve(signals, taps[None], axes=1)
        return filtered[:, taps.size : record.n_samples : factor]

    return replace(
        record,
        sample_time=factor * record.sample_time,
        outputs=reduced(record.outputs),
        inputs=reduced(record.inputs) if record.n_inputs else np.zeros((0, 0)),
        # the filter delays by half its length
        start_time=record.start_time + (taps.size - (taps.size - 1) / 2) * record.sample_time,
    )
