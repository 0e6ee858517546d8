"""Faults of sampling rates, damping ratios and natural frequencies, such as a value in another unit.

They are accepted if their correction closes nearly all of the gap: no missing effect changes a sampling rate, or a
damping ratio a hundredfold.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from workbench.gap.prediction.residuals import lead_of
from workbench.gap.setup.comparison import CLOSED, Comparison
from workbench.gap.setup.corrections import Correction, SetupFault, modes_times, rate_times
from workbench.gap.setup.sentences import RATES, TURN, agreeing, subject
from workbench.structure.damping import ModalDamping

PER_CENT_FROM = 0.05  # damping ratio above which per cent may have been meant


def sampling_rates(gap: Comparison) -> list[SetupFault]:
    """Faults of the stated sampling rates of records."""
    rig, records = gap.rig, gap.records
    wrong: dict[float, list[int]] = {}
    for i, (record, own) in enumerate(zip(records, gap.by_record, strict=True)):
        if not own.wide.any():
            continue
        corrected = {factor: replace(record, sample_time=record.sample_time / factor) for factor in RATES}
        shares = {
            factor: own.closes(rig, [other])
            for factor, other in corrected.items()
            if 2 * lead_of(other, gap.settle) < other.n_samples  # otherwise few samples would be left to compare
        }
        best = max(shares, key=lambda factor: shares[factor], default=None)
        if best is not None and shares[best] >= CLOSED:
            wrong.setdefault(best, []).append(i)
    faults = []
    for factor, at in wrong.items():
        names = [records[i].name for i in at]
        times = ", ".join(dict.fromkeys(f"{records[i].sample_time / factor:.6g}" for i in at))
        what = agreeing(f"{subject('record', names)} are sampled at {RATES[factor]} the stated rate", names)
        sentence = f"{what}: state sample_time = {times} s."
        correction = partial(rate_times, factor)
        whole = gap.closes(*correction(rig, records)) if len(at) == len(records) else np.nan
        faults.append(SetupFault("sample rate", sentence, whole, correction, records=tuple(names)))
    return faults


def modal_units(gap: Comparison) -> list[SetupFault]:
    """The fault of the units of the modes that closes most: damping in per cent, frequencies in rad/s or in Hz."""
    rig, records = gap.rig, gap.records
    candidates: list[tuple[str, str, Correction]] = []
    zeta = float(rig.modes.zeta.max(initial=0.0))
    if zeta > PER_CENT_FROM and (rig.structure is None or isinstance(rig.structure.damping, ModalDamping)):
        sentence = (
            f"The damping looks like per cent where a ratio is meant: divide it by 100 (the largest would be"
            f" {zeta / 100:.4g}, not {zeta:.4g})."
        )
        candidates.append(("damping", sentence, partial(modes_times, 1.0, 0.01)))
    if rig.structure is None:
        for factor, words in ((TURN, "Hz where rad/s is"), (1.0 / TURN, "rad/s where Hz is")):
            sentence = f"The natural frequencies look like {words} meant: multiply them by {factor:.6g}."
            candidates.append(("frequency", sentence, partial(modes_times, factor, 1.0)))
    faults = [
        SetupFault(kind, sentence, gap.closes(*correction(rig, records)), correction)
        for kind, sentence, correction in candidates
    ]
    faults = [fault for fault in faults if fault.closes >= CLOSED]
    return sorted(faults, key=lambda fault: -fault.closes)[:1]
