"""Transfer functions in a MAT file, read as impulse responses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from workbench.records.confined import load_confined
from workbench.records.file_error import RecordFileError
from workbench.records.record import Channel, Record
from workbench.records.transfer import impulse_record


def read_transfer(
    path: str | Path,
    *,
    positions: Sequence[float],
    quantity: str,
    matrix: str = "yspec",
    sample_rate: str = "freq",
) -> Record:
    """Impulse responses from the transfer functions of a MAT file, one column a point.

    Args:
        path: of the file.
        positions: (n_points,) of the columns, m.
        quantity: measured, per N of force.
        matrix: name of the (n_frequencies, n_points) complex array, first row at 0 Hz, last at Nyquist.
        sample_rate: name of the sample rate behind it, Hz.

    Raises:
        RecordFileError: a file that cannot be read, lacks an array, or has another number of columns.
    """
    path = Path(path)
    if not path.is_file():
        raise RecordFileError(f"{path}: there is no such file")
    arrays = load_confined("workbench.records.mat_file", path)
    for name in (matrix, sample_rate):
        if name not in arrays:
            raise RecordFileError(f"{path} holds no array {name!r}; name the right one by `matrix` or `sample_rate`")
    transfer, rate = arrays[matrix], np.ravel(arrays[sample_rate])
    if transfer.ndim != 2 or transfer.shape[1] != len(positions) or transfer.dtype.kind not in "fiuc":
        raise RecordFileError(
            f"{path}, {matrix}: {len(positions)} positions need (n_frequencies, {len(positions)}) columns; got"
            f" {transfer.shape}"
        )
    if rate.size != 1 or rate.dtype.kind not in "fiu" or not 0 < rate[0] < np.inf:
        raise RecordFileError(f"{path}, {sample_rate}: the sample rate is one positive number; got {rate[:3]}")
    channels = tuple(Channel(f"point {i + 1}", quantity, at=float(x)) for i, x in enumerate(positions))
    return impulse_record(transfer.T, sample_rate_hz=float(rate[0]), channels=channels, name=path.stem)
