"""Measured transfer functions as impulse responses."""

import numpy as np
from numpy.typing import ArrayLike

from workbench.records.record import Channel, Record


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
