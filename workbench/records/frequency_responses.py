"""Measured frequency response functions (FRFs), and their impulse responses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from workbench.records.confined import load_confined
from workbench.records.limits import RecordFileError, check_file
from workbench.records.record import Channel, Record, rows_of
from workbench.renamed import Renamed, former_arguments
from workbench.structure.modes import freeze
from workbench.structure.printed import Printed, counted, place_text


@dataclass(frozen=True, eq=False, repr=False)
class FrequencyResponses(Printed):
    """Measured FRFs, frequency last.

    Attributes:
        values: (n_outputs, n_references, n_frequencies) complex, outputs per unit input.
        frequencies_hz: (n_frequencies,) increasing, at any spacing.
        output_channels: one `Channel` per output.
        references: one name per input.
        name: in messages.
        remarks: on changes made on reading the file: units.

    Raises:
        ValueError: shapes that do not fit, repeated names, frequencies that do not increase.
    """

    values: np.ndarray
    frequencies_hz: np.ndarray
    output_channels: tuple[Channel, ...]
    references: tuple[str, ...] = ("input",)
    name: str = "FRFs"
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "values", dtype=complex)
        freeze(self, "frequencies_hz")
        shape = (len(self.output_channels), len(self.references), self.frequencies_hz.size)
        if self.values.shape != shape:
            raise ValueError(
                f"{self.name}: values must have shape {shape} for (n_outputs, n_references, n_frequencies); got"
                f" {self.values.shape}. Is frequency the last axis?"
            )
        if not np.isfinite(self.frequencies_hz).all() or (np.diff(self.frequencies_hz) <= 0).any():
            raise ValueError(f"{self.name}: frequencies must increase from line to line; sort them, each once")
        for kind, names in (("output", self.output_names), ("reference", self.references)):
            if len(set(names)) < len(names):
                raise ValueError(f"{self.name}: {kind} names must differ; got {names}")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        each = zip(self.output_channels, self.values, strict=True)
        rows = [(c.name, c.quantity, c.unit, place_text(c.at), f"{np.abs(values).max():.3g}") for c, values in each]
        f = self.frequencies_hz
        pairs = f"{counted(len(self.output_channels), 'output')} by {counted(len(self.references), 'reference')}"
        line = f"{self.name}: {pairs}, {f.size} lines, {f.min(initial=np.inf):.4g} to {f.max(initial=0.0):.4g} Hz"
        return line, ("output", "quantity", "unit", "at", "peak"), rows, self.remarks

    @property
    def output_names(self) -> tuple[str, ...]:
        return tuple(channel.name for channel in self.output_channels)

    only = Renamed("select_outputs")

    def select_outputs(self, outputs: tuple[str, ...]) -> "FrequencyResponses":
        """The FRFs to some outputs, in that order; an unknown one is a ValueError."""
        rows = rows_of(self.name, self.output_names, outputs)
        channels = tuple(self.output_channels[row] for row in rows)
        return replace(self, values=self.values[rows], output_channels=channels)


def read_frf(
    path: str | Path, *, positions: Sequence[float], quantity: str, matrix: str = "yspec", sample_rate: str = "freq"
) -> Record:
    """Impulse responses from the FRFs of a MAT file, one column per point.

    Args:
        path: of the file.
        positions: (n_points,) of the columns, m.
        quantity: measured, per N of force.
        matrix: name of the (n_frequencies, n_points) complex array, first row at 0 Hz, last at Nyquist.
        sample_rate: name of the array with the sample rate, Hz.

    Raises:
        RecordFileError: a file that cannot be read, lacks an array, or has another number of columns.
    """
    path = Path(path)
    check_file(path)
    arrays = load_confined("workbench.records.mat_file", path)
    for name in (matrix, sample_rate):
        if name not in arrays:
            raise RecordFileError(f"{path} holds no array {name!r}; name the right one by `matrix` or `sample_rate`")
    frf, rate = arrays[matrix], np.ravel(arrays[sample_rate])
    if frf.ndim != 2 or frf.shape[1] != len(positions) or frf.dtype.kind not in "fiuc":
        raise RecordFileError(
            f"{path}, {matrix}: {len(positions)} positions need (n_frequencies, {len(positions)}) columns; got"
            f" {frf.shape}"
        )
    if rate.size != 1 or rate.dtype.kind not in "fiu" or not 0 < rate[0] < np.inf:
        raise RecordFileError(f"{path}, {sample_rate}: the sample rate is one positive number; got {rate[:3]}")
    channels = tuple(Channel(f"point {i + 1}", quantity, at=float(x)) for i, x in enumerate(positions))
    return impulse_record(frf.T, sample_rate_hz=float(rate[0]), channels=channels, name=path.stem)


@former_arguments(transfer="frf")
def impulse_record(
    frf: ArrayLike, *, sample_rate_hz: float, channels: tuple[Channel, ...], name: str = "impulse responses"
) -> Record:
    """The impulse responses of FRFs on a grid from zero to half the sample rate.

    h = irfft(H) · rate: the response to a unit impulse (N s), in the outputs' unit per N s.

    Args:
        frf: (n_outputs, n_frequencies) complex, per unit input, first column at 0 Hz, last at Nyquist.
        sample_rate_hz: of the time signals.
        channels: one per output.
        name: of the record.

    Raises:
        ValueError: shapes that do not fit, or non-finite values (channel and line named).
    """
    frf = np.atleast_2d(np.asarray(frf, complex))
    if frf.shape[0] != len(channels) or frf.shape[1] < 3:
        wanted = f"({len(channels)} outputs, n_frequencies)"
        raise ValueError(f"FRFs must have shape {wanted}; got {frf.shape}. Is frequency the last axis?")
    for channel, row in zip(channels, frf, strict=True):
        bad = ~np.isfinite(row)
        if bad.any():
            raise ValueError(f"{name}, channel {channel.name!r}: line {int(np.argmax(bad))} is not a number")
    outputs = np.fft.irfft(frf, n=2 * (frf.shape[1] - 1), axis=1) * sample_rate_hz
    return Record(sample_time=1.0 / sample_rate_hz, outputs=outputs, output_channels=channels, name=name)
