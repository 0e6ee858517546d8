"""Sample rates, damping ratios and natural frequencies in another unit than they are meant in.

They are believed where nearly all of the gap goes: no missing effect changes a sample rate, or a damping ratio a
hundredfold.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from workbench.gap.prediction.residuals import lead_of
from workbench.gap.setup.compared import CLOSED, Compared
from workbench.gap.setup.corrections import Correction, SetupFault, modes_times, rate_times
from workbench.gap.setup.words import RATES, TURN, named, one
from workbench.structure.damping import ModalDamping

PER_CENT_FROM = 0.05  # damping ratio above which a structure is asked whether per cent was meant


def rates(gap: Compared) -> list[SetupFault]:
    """Records sampled at another rate than they are said to be."""
    rig, records = gap.rig, gap.records
    wrong: dict[float, list[int]] = {}
    for i, (record, own) in enumerate(zip(records, gap.each, strict=True)):
        if not own.wide.any():
            continue
        others = {factor: replace(record, sample_time=record.sample_time / factor) for factor in RATES}
        shares = {
            factor: own.closes(rig, [other])
            for factor, other in others.items()
            if 2 * lead_of(other, gap.settle) < other.n_samples  # else next to nothing would be left to compare
        }
        best = max(shares, key=lambda factor: shares[factor], default=None)
        if best is not None and shares[best] >= CLOSED:
            wrong.setdefault(best, []).append(i)
    faults = []
    for factor, at in wrong.items():
        names = [records[i].name for i in at]
        times = ", ".join(dict.fromkeys(f"{records[i].sample_time / factor:.6g}" for i in at))
        what = one(f"{named('record', names)} are sampled at {RATES[factor]} the stated rate", names)
        sentence = f"{what}: state sample_time = {times} s."
        correction = partial(rate_times, factor)
        whole = gap.closes(*correction(rig, records)) if len(at) == len(records) else np.nan
        faults.append(SetupFault("sample rate", sentence, whole, correction, records=tuple(names)))
    return faults


def of_structure(gap: Compared) -> list[SetupFault]:
    """Damping in per cent, frequencies in rad/s for Hz and the other way about."""
    rig, records = gap.rig, gap.records
    tries: list[tuple[str, str, Correction]] = []
    zeta = float(rig.modes.zeta.max(initial=0.0))
    if zeta > PER_CENT_FROM and (rig.structure is None or isinstance(rig.structure.damping, ModalDamping)):
        sentence = (
            f"The damping looks like per cent where a ratio is meant: divide it by 100 (the largest would be"
            f" {zeta / 100:.4g}, not {zeta:.4g})."
        )
        tries.append(("damping", sentence, partial(modes_times, 1.0, 0.01)))
    if rig.structure is None:
        for factor, words in ((TURN, "Hz where rad/s is"), (1.0 / TURN, "rad/s where Hz is")):
            sentence = f"The natural frequencies look like {words} meant: multiply them by {factor:.6g}."
            tries.append(("frequency", sentence, partial(modes_times, factor, 1.0)))
    found = [
        SetupFault(kind, sentence, gap.closes(*correction(rig, records)), correction)
        for kind, sentence, correction in tries
    ]
    found = [fault for fault in found if fault.closes >= CLOSED]
    return sorted(found, key=lambda fault: -fault.closes)[:1]
