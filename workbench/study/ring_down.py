"""A record as a user has it to refined modes, in one call."""

from workbench.identification.ibrahim import stacked_delays
from workbench.identification.refinement import Refined, refine
from workbench.identification.stabilisation import real_modes, stabilise
from workbench.records.record import Record

MOST_MODES = 20


def modes_of(record: Record, *, n_modes: int | None = None) -> Refined:
    """The refined modes of a free decay; their number found by stabilisation unless given.

    Raises:
        ValueError: too few samples, or nothing in the record that decays freely.
    """
    if n_modes is not None and n_modes < 1:
        raise ValueError(f"at least one mode must be asked for; got {n_modes}")
    if n_modes is None:
        highest = max(2, min(MOST_MODES, record.n_samples // 8))
        start = real_modes(stabilise(record, orders=range(2, highest + 1))).modes
    else:
        start = stacked_delays(record, n_modes=n_modes)
    if start.n_modes == 0:
        raise ValueError(f"record {record.name!r} holds no mode that stays from order to order: is it a free decay?")
    return refine(record, start)
