"""Faults of the test set-up, looked for before any effect: of wiring, of units and of bookkeeping."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from workbench.gap.setup.by_band import asked
from workbench.gap.setup.channels import of_channels, scaled_inputs
from workbench.gap.setup.compared import CLOSED, FELT, Compared
from workbench.gap.setup.corrections import SetupFault, records_alone, without_faults
from workbench.gap.setup.gains import apart, gains_once_corrected, same_gain
from workbench.gap.setup.rates import of_structure, rates
from workbench.gap.setup.repeats import check_names, copied, repeated
from workbench.records.record import Record
from workbench.rig.rig import Rig

Way = Callable[[Compared], list[SetupFault]]

MOST_ROUNDS = 4  # faults that hide one another are found one after the other
OF_CHANNELS = ("exchanged inputs", "exchanged outputs", "sign", "unit")  # kinds that a record may have or not
OF_ONE = ("outputs", "inputs", "exchanged outputs", "exchanged inputs")
WAYS_OF_ONE: tuple[Way, ...] = (partial(of_channels, kinds=OF_ONE), scaled_inputs, rates)  # a record by itself
WAYS: tuple[Way, ...] = (partial(of_channels, kinds=(*OF_ONE, "quantity")), scaled_inputs, rates, of_structure)


def setup_faults(
    rig: Rig, records: Sequence[Record], validation: Sequence[Record] = (), *, settle: float = 0.0
) -> tuple[SetupFault, ...]:
    """The faults of the test set-up that the records show against the nominal rig, in the order to correct them.

    Each record is judged by itself: by each fault of all fit records, then by faults that it alone has.

    Args:
        rig: nominal.
        records: with the rig's inputs and outputs, in its order.
        validation: likewise, kept out of every fit.
        settle: seconds at the start of each record that are not compared.

    Raises:
        ValueError: two records of one name.
    """
    check_names((*records, *validation))
    found = [*repeated(records), *copied(rig, records)]
    (seen_rig, fit), (_, held) = (without_faults(found, rig, these) for these in (records, validation))
    together = Compared.of(seen_rig, fit, settle)
    alone = [*together.each, *(Compared.of(seen_rig, (record,), settle) for record in held)]
    for fault in _by_rounds(together, WAYS):
        if fault.kind in OF_CHANNELS and fault.certain:
            fault = _judged_on(alone, fault)
        found.append(fault)
        alone = [gap.without(fault) for gap in alone]
    for i, gap in enumerate(alone):
        if i == 0 and len(fit) == 1:  # what one fit record has, all have
            continue
        what = "record" if i < len(fit) else "validation record"
        others = [*alone[:i], *alone[i + 1 :]]
        found += [
            _of_one(what, gap.records[0], fault)
            for fault in _by_rounds(gap, WAYS_OF_ONE)
            if fault.certain and fault.closes >= CLOSED and _is_alone(fault, gap, others)
        ]
    return tuple(found)


def _by_rounds(gap: Compared, ways: Sequence[Way]) -> list[SetupFault]:
    """Faults that hide one another, one kind after the other."""
    found: list[SetupFault] = []
    for _ in range(MOST_ROUNDS):
        faults = _best(gap, ways)
        found += faults
        if not any(fault.certain for fault in faults):
            break
        gap = _without_all(gap, faults)
    return found


def _without_all(gap: Compared, faults: Sequence[SetupFault]) -> Compared:
    for fault in faults:
        gap = gap.without(fault)
    return gap


def _best(gap: Compared, ways: Sequence[Way]) -> list[SetupFault]:
    """The faults of the kind that closes most, doubtful ones where none is certain; none where none closes most."""
    # a record at a low level may be sampled wrongly and yet leave no wide gap over all records
    found = [way(gap) for way in (ways if gap.wide.any() else (rates,))]
    doubtful = [fault for faults in found for fault in faults if not fault.certain]
    found = [faults for faults in ([f for f in faults if f.certain] for faults in found) if faults]
    if not found:
        return doubtful
    return found[0] if len(found) == 1 else min(found, key=lambda faults: _remaining(_without_all(gap, faults)))


def _remaining(gap: Compared) -> float:
    """The share of the measured power that remains."""
    return float(np.minimum(gap.before, 1.0).mean())


def _disagreeing(gaps: Sequence[Compared], fault: SetupFault) -> list[Compared]:
    """Those of single records that agree worse with the model by a correction.

    What is silent in a record, or decayed there, says nothing of it.
    """

    def left(gap: Compared) -> float:
        return float(gap.unlike[asked(gap.seen)].sum())

    return [gap for gap in gaps if left(gap.corrected(fault.correction)) > left(gap) + FELT]


def _judged_on(gaps: Sequence[Compared], fault: SetupFault) -> SetupFault:
    """A fault of all fit records, without those records that agree worse with the model by its correction."""
    others = [name for gap in _disagreeing(gaps, fault) for name in gap.names]
    sentence = f"{fault.sentence[:-1]}; not in {', '.join(others)}." if others else fault.sentence
    names = tuple(name for gap in gaps for name in gap.names if name not in others)
    return replace(fault, sentence=sentence, records=names)


def _is_alone(fault: SetupFault, gap: Compared, others: Sequence[Compared]) -> bool:
    """Whether some other record shows that it has not the fault: one of all records was asked for among them all.

    Without a factor of units, that record has the gain that this one has once corrected.
    """
    if fault.kind not in OF_CHANNELS or not others:
        return True
    (own,) = gains_once_corrected(gap, fault)
    return any(apart((own, *other.log_ratios)) <= same_gain(fault) for other in _disagreeing(others, fault))


def _of_one(what: str, record: Record, fault: SetupFault) -> SetupFault:
    """A fault of one record alone: the rig stays as it is."""
    words = fault.sentence
    if fault.kind != "sample rate":  # that names its record
        words = f"In {what} {record.name}, {words[0].lower()}{words[1:]}"
    return replace(fault, sentence=words, records=(record.name,), correction=partial(records_alone, fault.correction))
