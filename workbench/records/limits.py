"""Limits of the size of a file and of the time to read it, and the error of all readers and writers."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf
from pathlib import Path

COPIES = 4  # of a record, at most, in memory while it is read
BYTES_PER_NUMBER = 8
MOST_BYTES = 2**30
MOST_CHANNELS = 10_000
EXTRAPOLATED = 0.1  # of the time limit, after which the remaining time is extrapolated
SPARE = 0.3  # tolerance of extrapolations, as rows grow longer with the digits of their times
LONGEST = 200  # characters of a reader's message that is passed on
# of a reader that did not see what is wrong; their messages speak of its code, not of the file
READER_FAULTS = (ArithmeticError, AssertionError, AttributeError, LookupError, NameError, TypeError)


class RecordFileError(ValueError):
    """A file that holds no usable record; the message names file, channel and row."""


def unreadable(path: Path, error: Exception) -> RecordFileError:
    """The error for a reader's exception: the first line of its message, shortened, without control characters."""
    text = next(iter(str(error).splitlines()), "") or type(error).__name__
    shown = "".join(c if c.isprintable() else "?" for c in text[:LONGEST]) + ("..." if len(text) > LONGEST else "")
    if isinstance(error, READER_FAULTS):
        shown = f"{type(error).__name__} in its reader ({shown}): it is damaged, or of a kind that is not read"
    return RecordFileError(f"{path} cannot be read as {path.suffix[1:].upper()}: {shown}")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """A context in which every exception of a reader becomes a `RecordFileError`."""
    try:
        yield
    except RecordFileError:
        raise
    except Exception as error:  # readers raise exceptions of many kinds
        raise unreadable(path, error) from error


@dataclass(frozen=True)
class ReadLimits:
    """Limits of memory and time for reading a file.

    Attributes:
        memory: bytes; the record itself may have a quarter.
        seconds: of processor time.
    """

    memory: float = 2.0**30
    seconds: float = 10.0

    def __post_init__(self) -> None:
        for name in ("memory", "seconds"):
            if not 0 < getattr(self, name) < inf:
                raise ValueError(f"the limit of {name} must be positive; got {getattr(self, name)}")

    @classmethod
    def of_gib(cls, memory: float) -> "ReadLimits":
        """Limits with a memory in GiB and the default time."""
        return cls(memory=memory * 2.0**30)

    @property
    def most_numbers(self) -> int:
        """Largest size of a record, in numbers."""
        return int(self.memory / (COPIES * BYTES_PER_NUMBER))


DEFAULT = ReadLimits()


class Deadline:
    """The time limit of reading a file, from the creation of this object."""

    def __init__(self, path: Path, limits: ReadLimits) -> None:
        self._path, self._seconds = path, limits.seconds
        self._begun = time.process_time()

    def check(self, share: float = 1.0) -> None:
        """Refuse, by a `RecordFileError`, to go on beyond the limit, or where the share read so far foretells that."""
        spent = time.process_time() - self._begun
        extrapolates = spent > EXTRAPOLATED * self._seconds
        if spent > self._seconds or (extrapolates and spent / share > self._seconds * _allowed(share)):
            raise RecordFileError(
                f"{self._path} takes more than {self._seconds:g} s to read: cut the record, take fewer channels, or"
                " write it as HDF5 or NPZ"
            )


def _allowed(share: float) -> float:
    """Factor of a limit for values extrapolated from a share of a file."""
    return 1.0 + SPARE * (1.0 - share)


def check_file(path: Path) -> None:
    """Refuse a file that does not exist, is empty, or has more than `MOST_BYTES`, by a `RecordFileError`."""
    if not path.is_file():
        raise RecordFileError(f"{path}: there is no such file")
    size = path.stat().st_size
    if size == 0:
        raise RecordFileError(f"{path} is empty")
    if size > MOST_BYTES:
        raise RecordFileError(
            f"{path} has {size / 2**30:.3g} GiB; at most {MOST_BYTES / 2**30:g} GiB are read: cut the record or take"
            " fewer channels"
        )


def check_counts(path: Path, n_channels: int, n_numbers: int, limits: ReadLimits = DEFAULT, share: float = 1.0) -> None:
    """Refuse, by a `RecordFileError`, more channels than `MOST_CHANNELS` or more numbers than the memory allows.

    The numbers are those of a share of the file, from which the rest is extrapolated.
    """
    if n_channels > MOST_CHANNELS:
        raise RecordFileError(f"{path} holds {n_channels} channels; at most {MOST_CHANNELS} are read")
    if n_numbers > limits.most_numbers * share * _allowed(share):
        some = f"{n_numbers}" if share == 1.0 else f"about {n_numbers / share:.3g}"
        raise RecordFileError(
            f"{path} holds {some} numbers; at most {limits.most_numbers} are read within"
            f" {limits.memory / 2**30:g} GiB: cut the record, take fewer channels, or allow more memory"
        )
