"""Identified modes that may be something else: a drift, a hum, an overtone."""

from collections.abc import Sequence

import numpy as np

from workbench.identification.free_decay.refined import Refined
from workbench.records.record import Record

SURE = 3.0
HIGHEST_OVERTONE = 9
# Amplitude of an overtone, relative to its base, at most.
OVERTONE_AT_MOST = 0.03
WITHIN = 2e-3


def remarks(refined: Refined, records: Record | Sequence[Record]) -> tuple[str, ...]:
    """One remark a mode, empty where there is none.

    Slower than the record is long: a drift. A damping ratio not three standard errors above zero: a hum, if it goes on
    to the end, or, three below zero, a growth. A whole multiple of the frequency of a mode thirty times as strong:
    perhaps only the distortion of that one (a mode may stand there too: those of a hinged beam do).
    """
    modes, found = refined.modes, []
    size = np.abs(np.stack(refined.amplitudes) / refined.noise[:, :, None]).max(axis=(0, 1))
    records = [records] if isinstance(records, Record) else records
    span = max(record.n_samples * record.sample_time for record in records)
    for r in range(modes.n_modes):
        f, zeta, doubt = modes.frequencies_hz[r], modes.zeta[r], SURE * refined.zeta_std[r]
        base, times = _base(modes.frequencies_hz, size, r)
        if f * span < 1.0:
            found.append("slower than the record is long: a drift?")
        elif zeta < -doubt:
            found.append("grows")
        elif base is not None:
            found.append(f"{times} x mode {base + 1}: its overtone?")
        elif zeta < doubt:
            goes_on = zeta * modes.omega[r] * span < 1.0
            found.append("does not decay: a hum?" if goes_on else "damping no larger than its error")
        else:
            found.append("")
    return tuple(found)


def _base(frequencies: np.ndarray, size: np.ndarray, r: int) -> tuple[int | None, int]:
    """The mode of which r may be an overtone, and which."""
    for base in np.argsort(-size):
        times = round(frequencies[r] / frequencies[base])
        near = abs(frequencies[r] / frequencies[base] - times) < WITHIN * times
        if 2 <= times <= HIGHEST_OVERTONE and near and size[r] < OVERTONE_AT_MOST * size[base]:
            return int(base), times
    return None, 0
