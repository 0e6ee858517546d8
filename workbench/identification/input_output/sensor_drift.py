"""Drift of sensors in driven records: a test of polynomials of time against slow modes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.stats import chi2

from workbench.arrays import Floats
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit
from workbench.identification.input_output.model_order import SelectedModes, SelectionOptions
from workbench.identification.input_output.selection import select_strongest
from workbench.identification.signal.searches import FALSE_ALARM
from workbench.records.record import Record


@dataclass(frozen=True)
class DriftSettings:
    """Constants of the test for drift."""

    share: float = 0.2  # of the time left, for the modes without drift, and then for those beside it
    degree: int = 3  # of the polynomials of time
    lines: int = 10  # the lowest of each output after removal of a straight line
    stands_out: float = 10.0  # times the median of these that the energy of the straight line exceeds


DRIFT = DriftSettings()


def _may_drift(records: Sequence[Record]) -> bool:
    """Whether the straight line in an output exceeds its lowest frequency lines."""
    for record in records:
        t = np.linspace(-1.0, 1.0, record.n_samples)
        y = record.outputs - record.outputs.mean(axis=1, keepdims=True)
        slope = y @ t / (t @ t)
        lines = np.abs(np.fft.rfft(y - slope[:, None] * t)[:, 1 : DRIFT.lines + 1]) ** 2 * 2.0 / record.n_samples
        if (slope**2 * (t @ t) > DRIFT.stands_out * np.median(lines, axis=1)).any():
            return True
    return False


def beside_drift(
    data: KnownInputs, options: SelectionOptions
) -> tuple[KnownInputs, SelectedModes | None, tuple[str, ...]]:
    """The records with polynomials of time where these are likelier, the strongest modes if searched, and a remark.

    A displaced free body drifts too: its rigid body mode explains that by the inputs, and stays.
    """
    if not _may_drift(data.records):
        return data, None, ()
    drifting = replace(data, drift=DRIFT.degree)
    (without, one_ended), (beside, other_ended) = (_strongest(trial, options) for trial in (data, drifting))
    ended = one_ended or other_ended
    threshold = float(chi2.isf(FALSE_ALARM, data.values.shape[1] * (drifting.fixed.shape[1] - data.fixed.shape[1])))
    threshold_of_modes = without.limit * (without.fit.poles.size - beside.fit.poles.size)
    if drifting.cost(beside.fit) + threshold >= data.cost(without.fit) + threshold_of_modes:
        return data, None if ended else without, ()
    drift = _range_of_drift(drifting, beside.fit)
    k, j = np.unravel_index(int(np.argmax(drift / beside.fit.noise)), drift.shape)
    record = data.records[int(k)]
    in_record = f" in record {record.name!r}" if len(data.records) > 1 else ""
    remark = f"outputs drift, {record.output_names[j]} by {drift[k, j]:.3g}{in_record}: fitted beside the modes"
    return drifting, None if ended else beside, (remark,)


def _strongest(data: KnownInputs, options: SelectionOptions) -> tuple[SelectedModes, bool]:
    """The strongest modes, and whether the time for their search was up."""
    time_limit = options.time_limit.aside(DRIFT.share)
    return select_strongest(data, replace(options, time_limit=time_limit)), bool(time_limit.unfinished)


def _range_of_drift(data: KnownInputs, fit: Fit) -> Floats:
    """Range of the fitted polynomial of each output over each record, (n_records, n_outputs)."""
    n_records, n_terms = len(data.records), data.drift + 1
    first = 2 * fit.poles.size + data.fixed.shape[1] - n_terms * n_records
    terms = fit.coefficients[first:].reshape(n_records, n_terms, -1)
    powers = legvander(np.linspace(-1.0, 1.0, 50), data.drift)
    return np.asarray(np.ptp(np.einsum("td,kdj->ktj", powers[:, 1:], terms[:, 1:]), axis=1))
