"""Faults of the test set-up, detected before any effect is tried: of wiring, of units and of bookkeeping."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from workbench.gap.effects.effect import Effect
from workbench.gap.effects.transducers import SWAPPED_INPUTS, SWAPPED_OUTPUTS
from workbench.gap.setup.channels import (
    channel_faults,
    largest_difference,
    log_gains_after,
    output_in_other_unit,
    scaled_inputs,
    tolerated_difference,
)
from workbench.gap.setup.comparison import MIN_CLOSED_SHARE, MIN_MISFIT_CHANGE, Comparison, compared_bands
from workbench.gap.setup.corrections import SetupFault, records_alone, without_faults
from workbench.gap.setup.records import check_names, copied_channels, repeated
from workbench.gap.setup.sampling import late_records, modal_units, sampling_rates
from workbench.records.record import Record
from workbench.rig.rig import Rig

Detector = Callable[[Comparison], list[SetupFault]]

MAX_ROUNDS = 4  # faults that mask one another are detected one after the other
BY_RECORD = ("exchanged inputs", "exchanged outputs", "sign", "unit")  # kinds of faults that some records may not have
CANDIDATES = ("outputs", "inputs", "exchanged outputs", "exchanged inputs")  # of channels, that one record may have
OF_ONE_RECORD: tuple[Detector, ...] = (partial(channel_faults, kinds=CANDIDATES), scaled_inputs, sampling_rates)
DETECTORS: tuple[Detector, ...] = (
    partial(channel_faults, kinds=(*CANDIDATES, "quantity")),
    output_in_other_unit,
    scaled_inputs,
    sampling_rates,
    modal_units,
)


def setup_faults(
    rig: Rig, records: Sequence[Record], validation: Sequence[Record] = (), *, transient: float = 0.0
) -> tuple[SetupFault, ...]:
    """The faults of the test set-up that the records show, in the order in which they are to be corrected.

    Faults are detected in all fit records together, and each is kept for the records that agree with it; then each
    record is tested for faults of its own.

    All records have the rig's inputs and outputs, in its order; the first `transient` seconds are not compared.

    Raises:
        ValueError: two records of one name.
    """
    check_names((*records, *validation))
    found = [*repeated(records), *copied_channels(rig, records)]
    (corrected, fit), (_, held_out) = (without_faults(found, rig, these) for these in (records, validation))
    together = Comparison.of(corrected, fit, transient)
    alone = [*together.by_record, *(Comparison.of(corrected, (record,), transient) for record in held_out)]
    late = late_records(alone)
    if late:
        together, alone = _without_all(together, late), [_without_all(gap, late) for gap in alone]
    found += late
    of_all = _in_rounds(together, DETECTORS)
    for fault in of_all:
        if fault.kind in BY_RECORD and fault.certain:
            fault = _for_agreeing_records(alone, fault)
        found.append(fault)
        alone = [gap.without(fault) for gap in alone]
    if of_all and not late:  # a fault of the channels may have masked it
        found += late_records(alone)
    for i, gap in enumerate(alone):
        if i == 0 and len(fit) == 1:  # a single fit record was tested above
            continue
        what = "record" if i < len(fit) else "validation record"
        others = [*alone[:i], *alone[i + 1 :]]
        found += [
            _for_one_record(what, gap.records[0], fault)
            for fault in _in_rounds(gap, OF_ONE_RECORD)
            if fault.certain and fault.closes >= MIN_CLOSED_SHARE and _is_of_one_record(fault, gap, others)
        ]
    return tuple(found)


def exchanges(faults: Iterable[SetupFault], records: Sequence[Record]) -> tuple[Effect, ...]:
    """The exchanges of two channels that all of these records surely have, as effects."""
    names = {record.name for record in records}
    kinds = {"exchanged inputs": SWAPPED_INPUTS, "exchanged outputs": SWAPPED_OUTPUTS}
    of_all = (f for f in faults if f.pair and f.certain and names <= set(f.records or names))
    return tuple(Effect(kinds[fault.kind], fault.pair, {}) for fault in of_all)


def _in_rounds(gap: Comparison, detectors: Sequence[Detector]) -> list[SetupFault]:
    """All faults, in rounds: those of one kind are corrected before the next round, since they may mask others."""
    found: list[SetupFault] = []
    for _ in range(MAX_ROUNDS):
        faults = _best(gap, detectors)
        found += faults
        if not any(fault.certain for fault in faults):
            break
        gap = _without_all(gap, faults)
    return found


def _without_all(gap: Comparison, faults: Sequence[SetupFault]) -> Comparison:
    """The comparison after all faults that are certain are corrected."""
    for fault in faults:
        gap = gap.without(fault)
    return gap


def _best(gap: Comparison, detectors: Sequence[Detector]) -> list[SetupFault]:
    """Certain faults of the detector whose correction leaves the least residual; if there are none, those in doubt."""
    # a record at a low level may have a wrong sampling rate and yet add little to the gap of all records
    detected = [detector(gap) for detector in (detectors if gap.wide.any() else (sampling_rates,))]
    certain = [faults for faults in ([f for f in faults if f.certain] for faults in detected) if faults]
    if not certain:
        return [fault for faults in detected for fault in faults]
    if len(certain) == 1:
        return certain[0]
    # by residual power as a share of the power measured, the mean over outputs
    return min(certain, key=lambda faults: float(np.minimum(_without_all(gap, faults).before, 1.0).mean()))


def _worsened(gaps: Sequence[Comparison], fault: SetupFault) -> list[Comparison]:
    """The comparisons of single records in which a correction increases the misfit.

    Channels without signal in a record do not count.
    """

    def misfit(gap: Comparison) -> float:
        return float(gap.misfit[compared_bands(gap.measured_spectra)].sum())

    return [gap for gap in gaps if misfit(gap.corrected(fault.correction)) > misfit(gap) + MIN_MISFIT_CHANGE]


def _for_agreeing_records(gaps: Sequence[Comparison], fault: SetupFault) -> SetupFault:
    """The fault without those records in which its correction increases the misfit."""
    others = [name for gap in _worsened(gaps, fault) for name in gap.record_names]
    sentence = f"{fault.sentence[:-1]}, except in {', '.join(others)}." if others else fault.sentence
    names = tuple(name for gap in gaps for name in gap.record_names if name not in others)
    return replace(fault, sentence=sentence, records=names)


def _is_of_one_record(fault: SetupFault, gap: Comparison, others: Sequence[Comparison]) -> bool:
    """Whether another record shows that it does not have the fault; a fault of all records was tested on them jointly.

    The gain of that record must agree with the gain of this one after the correction.
    """
    if fault.kind not in BY_RECORD or not others:
        return True
    (own,) = log_gains_after(gap, fault)
    tolerated = tolerated_difference(fault)
    return any(largest_difference((own, *other.log_ratios)) <= tolerated for other in _worsened(others, fault))


def _for_one_record(what: str, record: Record, fault: SetupFault) -> SetupFault:
    """The fault of one record only, with the rig unchanged."""
    sentence = fault.sentence
    if fault.kind != "sample rate":  # such a sentence names its record
        sentence = f"In {what} {record.name}, {sentence[0].lower()}{sentence[1:]}"
    own = partial(records_alone, fault.correction)
    return replace(fault, sentence=sentence, records=(record.name,), correction=own)
