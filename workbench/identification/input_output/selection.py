"""The modes of records with known inputs, beside a drift of the sensors: the strongest first, and all in the noise that
they leave."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.stats import chi2

from workbench.arrays import Floats
from workbench.identification.input_output.fit_errors import statistic_of_each
from workbench.identification.input_output.held_out import without_unpredictive
from workbench.identification.input_output.input_noise import input_noise, with_white_noise
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit, only, projected, settled
from workbench.identification.input_output.model_order import (
    SelectedModes,
    SelectionOptions,
    fit_of_poles,
    is_about_distorted,
    select_modes,
    sure_modes,
)
from workbench.identification.input_output.noise_spectrum import alike
from workbench.identification.input_output.output_clock import on_one_clock
from workbench.identification.input_output.subspace_poles import subspace_poles
from workbench.identification.input_output.time_variance import beside_changing
from workbench.identification.signal.searches import FALSE_ALARM, SELECTION, TimeLimit
from workbench.records.record import Record


@dataclass(frozen=True)
class DrivenSelectionSettings:
    """Constants of the selection of modes of records with known inputs."""

    first_modes: int = 8  # modes for the first estimate of the noise
    noise_rounds: int = 4  # alternations between noise and modes
    decorrelation_rounds: int = 2  # selections of modes in combinations of outputs whose noise is uncorrelated
    spare_states: int = 20  # of a subspace model beyond two per mode: these fit noise
    drift_share: float = 0.2  # of the time left, for the modes without drift, and then for those beside it
    drift_degree: int = 3  # of the polynomials of time that represent the drift of a sensor
    drift_lines: int = 10  # the lowest of each output after removal of a straight line
    min_drift_ratio: float = 10.0  # times the median of these that the energy of the straight line exceeds


DRIVEN_SELECTION = DrivenSelectionSettings()


def select(
    data: KnownInputs, options: SelectionOptions, strongest: SelectedModes | None = None
) -> tuple[KnownInputs, SelectedModes]:
    """The data, weighted by their noise, and the modes, the strongest first; where noise of the outputs is correlated,
    in combinations without."""
    time_limit = options.time_limit
    start = subspace_start(data, options) if strongest is None else strongest.fit
    start = sure_modes(data, start, options, times=1.0)  # once for all searches from there
    sure = sure_modes(data, start, options)
    on_one = on_one_clock(
        data, sure, lambda other: sure_modes(other, subspace_start(other, options), options), time_limit
    )
    if on_one is not None:
        (data, sure), strongest = on_one, None
        start = sure
    noise = None if time_limit.spent("search for noise of the inputs") else input_noise(data, sure)
    if noise is not None:
        (data, start), strongest = with_white_noise(data, sure, noise, options), None
    if strongest is None:
        share = replace(options, time_limit=time_limit.share(SELECTION.search_share))
        strongest = select_strongest(data, share, start)
    data = data.with_distorted(strongest.distorted)
    uncorrelated = data.apart(strongest.fit)
    if uncorrelated is None:
        return _select_weighted(data, strongest, options)
    # Correlated noise makes peaks in all outputs. Modes not found yet add to its estimate, hence the repetition.
    for _ in range(DRIVEN_SELECTION.decorrelation_rounds):
        again = select_strongest(uncorrelated, options, strongest.fit)
        uncorrelated, selected = _select_weighted(uncorrelated, again, options)
        further = uncorrelated.apart(selected.fit)
        if further is None or time_limit.spent("search in outputs of uncorrelated noise"):
            break
        uncorrelated, strongest = further, selected
    data = replace(data, line_std=None, beside=uncorrelated.beside, changing=uncorrelated.changing)
    fit = settled(data, projected(data, selected.fit.poles, selected.fit.participation), time_limit=time_limit)
    return reweighted(data, selected, fit, time_limit)


def reweighted(
    data: KnownInputs, selected: SelectedModes, fit: Fit, time_limit: TimeLimit
) -> tuple[KnownInputs, SelectedModes]:
    """The data weighted by the noise spectrum of a fit, and the modes refitted to them, by rising frequency."""
    data = replace(data, line_std=data.noise_spectrum(fit))
    return data, selected.refitted(settled(data, only(data, fit, np.argsort(np.abs(fit.poles))), time_limit=time_limit))


def subspace_start(data: KnownInputs, options: SelectionOptions) -> Fit:
    """The significant modes of a subspace model, at most `max_modes`."""
    poles = subspace_poles(data.records, data.whole, 2 * options.max_modes + DRIVEN_SELECTION.spare_states)
    poles = np.append(poles[~is_about_distorted(data, poles)], data.free)
    fit = fit_of_poles(data, poles, options.false_alarm)
    if fit.poles.size <= options.max_modes:
        return fit
    return only(data, fit, np.argsort(statistic_of_each(fit))[-options.max_modes :])


def select_strongest(data: KnownInputs, options: SelectionOptions, start: Fit | None = None) -> SelectedModes:
    """The modes of `start`, or else of a subspace model, and further ones up to `DRIVEN_SELECTION.first_modes`.

    As long as all are sure, as many more are searched: strong modes left out would be taken for noise.
    """
    fit = subspace_start(data, options) if start is None else start
    few, is_tested = _few_of(options, fit.poles.size), False
    while True:
        found = select_modes(data, few, fit, is_tested=is_tested)
        selected = only_predictive(data, found, options.time_limit)
        fit, is_tested = selected.fit, selected.fit is found.fit
        if fit.poles.size < few.max_modes or few.max_modes == options.max_modes:
            return selected
        # beside the residual about each: noise of the inputs leaves peaks at the modes far above white noise
        if sure_modes(data, fit, options).poles.size < fit.poles.size:
            return selected
        few = _few_of(options, few.max_modes + DRIVEN_SELECTION.first_modes)


def _few_of(options: SelectionOptions, fewest: int) -> SelectionOptions:
    """The options with at most `DRIVEN_SELECTION.first_modes` modes, or `fewest` where these are more."""
    return replace(options, max_modes=min(max(DRIVEN_SELECTION.first_modes, fewest), options.max_modes))


def only_predictive(data: KnownInputs, selected: SelectedModes, time_limit: TimeLimit) -> SelectedModes:
    """The selected modes without those that make the prediction of held-out data worse.

    These are marked as distorted: no further mode is searched near them.
    """
    fit, distorted = without_unpredictive(data, selected.fit, selected.statistic, time_limit)
    return replace(selected.refitted(fit), distorted=(*data.distorted, *distorted))


def _select_weighted(
    data: KnownInputs, strongest: SelectedModes, options: SelectionOptions
) -> tuple[KnownInputs, SelectedModes]:
    """The modes of outputs of uncorrelated noise, weighted by the spectrum of the residual.

    Coloured noise may be taken for modes. A false mode fits noise at its lines, so that the noise there is
    underestimated and the mode appears significant. The noise is therefore estimated again without all doubtful modes;
    they stay if modes and noise together are less likely without them.
    """
    time_limit, check = options.time_limit, "check of doubtful modes"
    data, selected = _alternate_with_noise(data, strongest, _few_of(options, strongest.fit.poles.size), options)
    doubtful = (selected.statistic < SELECTION.weak_ratio * selected.limit) | ~_are_oscillatory(data, selected)
    if data.line_std is None or not doubtful.any() or time_limit.spent(check):
        return data, selected
    sure = settled(data, only(data, selected.fit, ~doubtful), time_limit=time_limit)
    other = replace(data, line_std=data.noise_spectrum(sure))
    other, fewer = _alternate_with_noise(other, select_modes(other, options, sure), options, options)
    if time_limit.spent(check):
        return data, selected
    threshold = selected.limit * (selected.fit.poles.size - fewer.fit.poles.size)
    less_oscillatory = (~_are_oscillatory(data, selected)).sum() > (~_are_oscillatory(other, fewer)).sum()
    as_likely = other.cost(fewer.fit) - data.cost(selected.fit) <= threshold
    return (other, fewer) if less_oscillatory or as_likely else (data, selected)


def _are_oscillatory(data: KnownInputs, selected: SelectedModes) -> np.ndarray:
    """Whether each mode oscillates within a record and does not grow, (n_modes,); others may be coloured noise."""
    poles, span = selected.fit.poles, 2.0 * np.pi / data.resolution
    return np.asarray((np.abs(poles) > data.resolution) & (poles.real * span < SELECTION.max_growth))


def _alternate_with_noise(
    data: KnownInputs, selected: SelectedModes, first_options: SelectionOptions, options: SelectionOptions
) -> tuple[KnownInputs, SelectedModes]:
    """Modes and noise spectrum, estimated alternately until both settle.

    From modes selected by `first_options`; the selections that follow have `options`.
    """
    time_limit, estimation = options.time_limit, "estimation of the noise spectrum"
    linear: list[np.ndarray] = []
    for _ in range(DRIVEN_SELECTION.noise_rounds):
        data, selected = _with_changing(data, selected, first_options, linear)
        line_std = data.noise_spectrum(selected.fit)
        may_be_more = selected.full and first_options.max_modes < options.max_modes
        if (alike(line_std, data.line_std) and not may_be_more) or time_limit.spent(estimation):
            break
        weighted = replace(data.with_distorted(selected.distorted), line_std=line_std)
        reselected = only_predictive(weighted, select_modes(weighted, options, selected.fit), time_limit)
        # A search that the time limit ended early does not replace the one before.
        if time_limit.spent(estimation) and reselected.fit.poles.size < selected.fit.poles.size:
            break
        data, selected, first_options = weighted, reselected, options
    return data, selected


def _with_changing(
    data: KnownInputs, selected: SelectedModes, options: SelectionOptions, linear: list[np.ndarray]
) -> tuple[KnownInputs, SelectedModes]:
    """The data with the columns of changing modes, and the modes, as long as these are likelier than close modes.

    For `linear` see `changing_response.in_place_of`.
    """
    # With one input and output both models were compared before.
    compared = data.values.shape[1] * data.n_inputs == 1
    for _ in range(DRIVEN_SELECTION.noise_rounds):
        changing = beside_changing(data, selected.fit, selected.limit, options.time_limit, linear)
        if changing is None:
            break
        beside, fewer = changing[0], select_modes(changing[0], options, changing[1])
        allowed = selected.limit * max(selected.fit.poles.size - fewer.fit.poles.size, 0) if compared else 0.0
        if beside.cost(fewer.fit) >= data.cost(selected.fit) + allowed:
            break
        data, selected = beside, fewer
    return data, selected


def beside_drift(
    data: KnownInputs, options: SelectionOptions
) -> tuple[KnownInputs, SelectedModes | None, tuple[str, ...]]:
    """The records with polynomials of time where these are likelier, the strongest modes if searched, and a remark.

    A displaced free body drifts too: its rigid body mode explains that by the inputs, and stays.
    """
    if not _may_drift(data.records):
        return data, None, ()
    drifting = replace(data, drift=DRIVEN_SELECTION.drift_degree)
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
    time_limit = options.time_limit.aside(DRIVEN_SELECTION.drift_share)
    return select_strongest(data, replace(options, time_limit=time_limit)), bool(time_limit.unfinished)


def _range_of_drift(data: KnownInputs, fit: Fit) -> Floats:
    """Range of the fitted polynomial of each output over each record, (n_records, n_outputs)."""
    n_records, n_terms = len(data.records), data.drift + 1
    first = 2 * fit.poles.size + data.fixed.shape[1] - n_terms * n_records
    terms = fit.coefficients[first:].reshape(n_records, n_terms, -1)
    powers = legvander(np.linspace(-1.0, 1.0, 50), data.drift)
    return np.asarray(np.ptp(np.einsum("td,kdj->ktj", powers[:, 1:], terms[:, 1:]), axis=1))


def _may_drift(records: Sequence[Record]) -> bool:
    """Whether the straight line in an output exceeds its lowest frequency lines."""
    for record in records:
        t = np.linspace(-1.0, 1.0, record.n_samples)
        y = record.outputs - record.outputs.mean(axis=1, keepdims=True)
        slope = y @ t / (t @ t)
        lines = np.fft.rfft(y - slope[:, None] * t)[:, 1 : DRIVEN_SELECTION.drift_lines + 1]
        energy = np.abs(lines) ** 2 * 2.0 / record.n_samples
        if (slope**2 * (t @ t) > DRIVEN_SELECTION.min_drift_ratio * np.median(energy, axis=1)).any():
            return True
    return False
