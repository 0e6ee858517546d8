"""A record as a user has it to refined modes, in one call."""

import numpy as np

from workbench.identification.ibrahim import stacked_delays
from workbench.identification.refinement import Refined, refine
from workbench.identification.stabilisation import real_modes, stabilise
from workbench.records.record import Record

MOST_MODES = 20


def modes_of(record: Record, *, n_modes: int | None = None) -> Refined:
    """The refined modes of a free decay.

    Unless their number is given, those that stay in a stabilisation diagram are refined, and of these the ones kept
    without which the record is less likely.

    Raises:
        ValueError: too few samples, or nothing in the record that decays freely.
    """
    if n_modes is not None:
        if n_modes < 1:
            raise ValueError(f"at least one mode must be asked for; got {n_modes}")
        return refine(record, stacked_delays(record, n_modes=n_modes))
    highest = max(2, min(MOST_MODES, record.n_samples // 8))
    start = real_modes(stabilise(record, orders=range(2, highest + 1))).modes
    if start.n_modes == 0:
        raise ValueError(f"record {record.name!r} holds no mode that stays from order to order: is it a free decay?")
    return _without_noise_modes(record, refine(record, start))


def _without_noise_modes(record: Record, found: Refined) -> Refined:
    """Leave out the weakest mode as long as the record is as likely without it.

    Each mode is 2 n_outputs + 2 numbers; by Schwarz's criterion (Annals of Statistics 6 (1978) 461) it must raise
    twice the log likelihood by that many times the logarithm of the number of readings.
    """
    n, m = record.n_samples, record.n_outputs
    price = (2 * m + 2) * np.log(n * m)
    while found.modes.n_modes > 1:
        strength = (np.abs(found.amplitudes[0]) / found.noise_std[:, None]).max(axis=0)
        weakest = int(np.argmin(strength))
        others = [r for r in range(found.modes.n_modes) if r != weakest]
        without = refine(record, found.modes.select(others))
        if 2.0 * n * np.log(without.noise_std / found.noise_std).sum() > price:
            return found
        found = without
    return found
