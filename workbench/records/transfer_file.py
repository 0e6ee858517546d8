"""Measured transfer functions, in memory or in a MAT file, as impulse responses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from workbench.records.confined import load_confined
from workbench.records.limits import RecordFileError
from workbench.records.record import Channel, Record


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


def impulse_record(
    transfer: ArrayLike, *, sample_rate_hz: float, channels: tuple[Channel, ...], name: str = "impulse responses"
) -> Record:
    """The impulse responses of transfer functions on a grid from zero to half the sample rate.

    h = irfft(H) · rate: the response to a unit impulse (N s), in the outputs' unit per N s.

    Args:
        transfer: (n_outputs, n_frequencies) complex, per unit input, first column at 0 Hz, last at Nyquist.
        sample_rate_hz: of the time signals behind it.
        channels: one an output.

    Raises:
        ValueError: shapes that do not fit, or non-finite values (channel and line named).
    """
    transfer = np.atleast_2d(np.asarray(transfer, complex))
    if transfer.shape[0] != len(channels) or transfer.shape[1] < 3:
        raise ValueError(
            f"transfer functions must have shape ({len(channels)} outputs, n_frequencies); got {transfer.shape}."
            " Is frequency the last axis?"
        )
    for channel, row in zip(channels, transfer, strict=True):
        bad = ~np.isfinite(row)
        if bad.any():
            raise ValueError(f"{name}, channel {channel.name!r}: line {int(np.argmax(bad))} is not a number")
    n_samples = 2 * (transfer.shape[1] - 1)
    return Record(
        sample_time=1.0 / sample_rate_hz,
        outputs=np.fft.irfft(transfer, n=n_samples, axis=1) * sample_rate_hz,
        output_channels=channels,
        name=name,
    )
