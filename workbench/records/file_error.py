"""The error that every reader and writer of files raises."""


class RecordFileError(ValueError):
    """A file that holds no usable record; the message names file, channel and row."""
