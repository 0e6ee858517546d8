"""What a file may hold, how long it may take to read, and the error that every reader and writer raises."""

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

COPIES = 4  # of a record, at most, in memory while it is read
BYTES_PER_NUMBER = 8
MOST_BYTES = 2**30
MOST_CHANNELS = 10_000
TELLING = 0.1  # of the time, from which on what is read tells how long the rest will take
SPARE = 0.3  # by which what is read may mislead about all: rows grow longer with the digits of their times
LONGEST = 200  # of a message that is passed on, characters


class RecordFileError(ValueError):
    """A file that holds no usable record; the message names file, channel and row."""


def unreadable(path: Path, error: Exception) -> RecordFileError:
    """What a reader's failure says of a file: its first line, shortened, and nothing that a terminal would obey."""
    text = next(iter(str(error).splitlines()), "") or type(error).__name__
    shown = "".join(c if c.isprintable() else "?" for c in text[:LONGEST]) + ("..." if len(text) > LONGEST else "")
    return RecordFileError(f"{path} cannot be read as {path.suffix[1:].upper()}: {shown}")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Read another's file inside this: whatever a reader fails by becomes a `RecordFileError`."""
    try:
        yield
    except RecordFileError:
        raise
    except Exception as error:  # every reader of another's file has its own ways to fail
        raise unreadable(path, error) from error


@dataclass(frozen=True)
class Limits:
    """What reading a file may take.

    Attributes:
        memory: bytes; the record itself may have a quarter of them.
        seconds: of processor time.
    """

    memory: float = 2.0**30
    seconds: float = 10.0

    def __post_init__(self) -> None:
        for name in ("memory", "seconds"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"the limit of {name} must be positive; got {getattr(self, name)}")

    @classmethod
    def of_gib(cls, memory: float) -> "Limits":
        """Limits of memory in GiB, the time as ever."""
        return cls(memory=memory * 2.0**30)

    @property
    def most_numbers(self) -> int:
        """Numbers that a record may have."""
        return int(self.memory / (COPIES * BYTES_PER_NUMBER))


DEFAULT = Limits()


class Deadline:
    """The end of the time that a file may take, counted from the making of this."""

    def __init__(self, path: Path, limits: Limits) -> None:
        self._path, self._seconds = path, limits.seconds
        self._begun = time.process_time()

    def check(self, share: float = 1.0) -> None:
        """Refuse to go on after the end, or where it will come before the file's, as what is read of it tells.

        Args:
            share: of the file that is read.

        Raises:
            RecordFileError: the time is up, or will be.
        """
        spent = time.process_time() - self._begun
        telling = spent > TELLING * self._seconds
        if spent > self._seconds or (telling and spent / share > self._seconds * _allowed(share)):
            raise RecordFileError(
                f"{self._path} takes more than {self._seconds:g} s to read: cut the record, take fewer channels, or"
                " write it as HDF5 or NPZ"
            )


def _allowed(share: float) -> float:
    """Times a limit that a whole file may seem to take, of which a share is read."""
    return 1.0 + SPARE * (1.0 - share)


def check_file(path: Path) -> None:
    """Refuse a file that is not there, is empty, or is too large to read.

    Raises:
        RecordFileError: no file, no bytes, or more than `MOST_BYTES`.
    """
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


def check_arrays(path: Path, arrays: Iterable[np.ndarray], limits: Limits = DEFAULT) -> None:
    """Refuse arrays that are too many or too large.

    Raises:
        RecordFileError: more than `MOST_CHANNELS` arrays, or more numbers in all than the memory allows.
    """
    sizes = [np.size(values) for values in arrays]
    check_counts(path, len(sizes), sum(sizes), limits)


def check_counts(path: Path, n_channels: int, n_numbers: int, limits: Limits = DEFAULT, share: float = 1.0) -> None:
    """Refuse what would hold too many channels or numbers, before it is read.

    Args:
        path: of the file.
        n_channels: of all of it.
        n_numbers: in the share of it that is read.
        limits: see `Limits`.
        share: of the file; the rest is taken to be alike.

    Raises:
        RecordFileError: more than `MOST_CHANNELS`, or more numbers than the memory allows.
    """
    if n_channels > MOST_CHANNELS:
        raise RecordFileError(f"{path} holds {n_channels} channels; at most {MOST_CHANNELS} are read")
    if n_numbers > limits.most_numbers * share * _allowed(share):
        some = f"{n_numbers}" if share == 1.0 else f"about {n_numbers / share:.3g}"
        raise RecordFileError(
            f"{path} holds {some} numbers; at most {limits.most_numbers} are read within"
            f" {limits.memory / 2**30:g} GiB: cut the record, take fewer channels, or allow more memory"
        )
