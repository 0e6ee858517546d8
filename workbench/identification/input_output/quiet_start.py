"""Whether records begin at rest: as quiet before the first force as in the quietest part after it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.records.record import Record


@dataclass(frozen=True)
class QuietSettings:
    """Constants of the test for records that begin at rest."""

    fewest: int = 500  # samples before the first force, as before the trigger of an impact test
    # standard errors of the variance of white noise, by which that of the outputs there may exceed the least of all
    # parts as long after it, which of fifty parts is two below the mean
    louder: float = 4.0


QUIET = QuietSettings()


def begin_at_rest(records: Sequence[Record]) -> bool:
    """Whether no record has an initial motion: one that ended before the first force, too, would be loud before it."""
    return all(map(_begins_at_rest, records))


def _begins_at_rest(record: Record) -> bool:
    driven = record.inputs.any(axis=0)
    n = int(np.argmax(driven)) if driven.any() else 0
    if n < QUIET.fewest or record.n_samples < 2 * n:
        return False
    parts = record.outputs[:, : record.n_samples // n * n].reshape(record.n_outputs, -1, n)
    first, *others = parts.var(axis=2).T
    return bool((first <= (1.0 + QUIET.louder * np.sqrt(2.0 / n)) * np.min(others, axis=0)).all())
