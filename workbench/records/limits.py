"""How much a file may hold."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from workbench.records.file_error import RecordFileError

MOST_NUMBERS = 2**25  # a quarter of a gibibyte; each of the few copies that reading makes is as large
MOST_BYTES = 2**30
MOST_CHANNELS = 10_000
MOST_MEMORY = 3 * 2**29  # bytes of address space for a reader in a process of its own


def check_size(path: Path) -> None:
    """Refuse a file too large to read.

    Raises:
        RecordFileError: more than `MOST_BYTES`.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise RecordFileError(
            f"{path} has {size / 2**30:.3g} GiB; at most {MOST_BYTES / 2**30:g} GiB are read: cut the record or take"
            " fewer channels"
        )


def check_arrays(path: Path, arrays: Iterable[np.ndarray]) -> None:
    """Refuse arrays that are too many or too large.

    Raises:
        RecordFileError: more than `MOST_CHANNELS` arrays, or `MOST_NUMBERS` numbers in all.
    """
    sizes = [np.size(values) for values in arrays]
    check_counts(path, len(sizes), sum(sizes))


def check_counts(path: Path, n_channels: int, n_numbers: int) -> None:
    """Refuse what would hold too many channels or numbers, before it is read.

    Raises:
        RecordFileError: more than `MOST_CHANNELS` or `MOST_NUMBERS`.
    """
    if n_channels > MOST_CHANNELS:
        raise RecordFileError(f"{path} holds {n_channels} channels; at most {MOST_CHANNELS} are read")
    if n_numbers > MOST_NUMBERS:
        raise RecordFileError(
            f"{path} holds {n_numbers} numbers; at most {MOST_NUMBERS} are read: cut the record or take fewer channels"
        )
