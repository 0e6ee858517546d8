"""The error that every reader and writer of files raises."""

from pathlib import Path

LONGEST = 200


class RecordFileError(ValueError):
    """A file that holds no usable record; the message names file, channel and row."""


def unreadable(path: Path, error: Exception) -> RecordFileError:
    """What a reader's failure says of a file: its first line, shortened, and nothing that a terminal would obey."""
    text = next(iter(str(error).splitlines()), "") or type(error).__name__
    shown = "".join(c if c.isprintable() else "?" for c in text[:LONGEST]) + ("..." if len(text) > LONGEST else "")
    return RecordFileError(f"{path} cannot be read as {path.suffix[1:].upper()}: {shown}")
