"""Drift of sensors in driven records: a polynomial of time, or slow modes?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.model_order import Selected
from workbench.identification.signal.searches import FALSE_ALARM
from workbench.records.record import Record


@dataclass(frozen=True)
class DriftSettings:
    """Constants of the search for drift."""

    degree: int = 3
    lines: int = 10  # the lowest of what is left of an output beside a straight line
    stands_out: float = 10.0  # times the median of these, that a straight line explains


DRIFT = DriftSettings()


def may_drift(records: Sequence[Record]) -> bool:
    """Whether an output follows a straight line beyond the slowest of its other motion: then it may drift."""
    for record in records:
        t = np.linspace(-1.0, 1.0, record.n_samples)
        y = record.outputs - record.outputs.mean(axis=1, keepdims=True)
        slope = y @ t / (t @ t)
        lines = np.abs(np.fft.rfft(y - slope[:, None] * t)[:, 1 : DRIFT.lines + 1]) ** 2 * 2.0 / record.n_samples
        if (slope**2 * (t @ t) > DRIFT.stands_out * np.median(lines, axis=1)).any():
            return True
    return False


def beside_drift(
    data: KnownInputs, selected: Callable[[KnownInputs], Selected]
) -> tuple[KnownInputs, Selected | None, tuple[str, ...]]:
    """The records with polynomials of time beside the modes where these are likelier so, and a remark.

    The strongest modes come with them, where they were searched to tell.

    A free body displaced drifts too: its rigid mode explains that by the inputs, and stays.

    Args:
        data: the records.
        selected: the strongest modes of records.
    """
    if not may_drift(data.records):
        return data, None, ()
    other = data.with_drift(DRIFT.degree)
    plain, beside = selected(data), selected(other)
    n_outputs = data.values.shape[1]
    price = float(chi2.isf(FALSE_ALARM, n_outputs * (other.fixed.shape[1] - data.fixed.shape[1])))
    saved = plain.limit * (plain.fit.poles.size - beside.fit.poles.size)
    if other.cost(beside.fit) + price >= data.cost(plain.fit) + saved:
        return data, plain, ()
    drift = other.drift_of(beside.fit)
    k, j = np.unravel_index(int(np.argmax(drift / beside.fit.noise)), drift.shape)
    record = data.records[int(k)]
    in_record = f" in record {record.name!r}" if len(data.records) > 1 else ""
    remark = f"outputs drift, {record.output_names[j]} by {drift[k, j]:.3g}{in_record}: fitted beside the modes"
    return other, beside, (remark,)
