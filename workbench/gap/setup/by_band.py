"""How unlike measured and predicted signals are, in bands of one mode each."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from workbench.arrays import Complexes, Flags, Floats, Integers
from workbench.records.record import Record

OF_CHANNEL = 1e-2  # of a channel's power: a band with less is not asked; noise and leakage fill it
MOST = 3.0  # of a ratio's natural logarithm that counts: beyond it, one bent band would speak for many
END = 0.25  # of a record over which its end is faded out; its beginning, from rest, holds the response to a hammer


@dataclass(frozen=True, eq=False)
class Spectra:
    """Signals of some records by frequency line, beside the bands that the lines lie in.

    Attributes:
        of: (n_signals, n_lines) a record.
        ends: (n_modes + 1,) a record, the lines at which the band of each mode begins, and the last ends.
    """

    of: list[Complexes]
    ends: list[Integers]

    @staticmethod
    def read(signals: Sequence[Floats], records: Sequence[Record], frequencies_hz: Floats) -> "Spectra":
        """Of signals, (n_signals, n_samples) a record; a band ends halfway between two natural frequencies."""
        # every line is compared in some band; `localisation.where` shares a gap among modes, and takes geometric means
        edges = np.r_[0.0, (frequencies_hz[1:] + frequencies_hz[:-1]) / 2.0, np.inf]
        of, ends = [], []
        for signal, record in zip(signals, records, strict=True):
            n = signal.shape[1]
            fade = np.minimum(1.0, np.arange(n, 0, -1) / (END * n))
            of.append(np.fft.rfft((signal - signal.mean(axis=1, keepdims=True)) * np.sin(0.5 * np.pi * fade) ** 2))
            ends.append(np.asarray(np.searchsorted(np.fft.rfftfreq(n, record.sample_time), edges)))
        return Spectra(of, ends)

    def like(self, of: list[Complexes]) -> "Spectra":
        """Other signals of the same records."""
        return Spectra(of, self.ends)

    def rows(self, at: Sequence[int]) -> "Spectra":
        """Some of the signals, in that order."""
        return self.like([of[list(at)] for of in self.of])

    @cached_property
    def power(self) -> Floats:
        """(n_records, n_signals, n_modes) of each signal."""
        return self.shared(self)

    def shared(self, other: "Spectra") -> Floats:
        """(n_records, n_signals, n_modes) what each signal has in common with its like: of itself, its power."""
        in_bands = []
        for one, two, ends in zip(self.of, other.of, self.ends, strict=True):
            up_to = np.cumsum((one * two.conj()).real, axis=1)
            in_bands.append(np.diff(np.hstack([np.zeros((len(up_to), 1)), up_to])[:, ends], axis=1))
        return np.array(in_bands)


def asked(measured: Spectra) -> Flags:
    """(n_records, n_signals, n_modes) the bands that hold enough of a signal to be compared."""
    return np.asarray(measured.power > OF_CHANNEL * measured.power.sum(axis=2, keepdims=True))


def unlike(measured: Spectra, predicted: Spectra, factor: float = 1.0) -> Floats:
    """(n_records, n_signals, n_modes) |log of the ratio of amplitudes| + 1 - correlation, with a factor's prediction.

    A missing effect moves resonances and bends amplitudes by band, either way; a fault moves all bands alike.
    """
    tiny = 1e-300
    with np.errstate(over="ignore", invalid="ignore"):
        of_y, of_p, both = measured.power, predicted.power, measured.shared(predicted)
        ratio = 0.5 * (np.log(np.maximum(of_y, tiny)) - np.log(np.maximum(of_p * factor**2, tiny)))
        alike = np.sign(factor) * both / np.sqrt(np.maximum(of_y * of_p, tiny))
        return np.asarray(np.nan_to_num(np.minimum(np.abs(ratio), MOST) + 1.0 - alike, nan=MOST + 1.0))


def log_ratios(measured: Spectra, predicted: Spectra) -> Floats:
    """(n_records, n_signals, n_modes) logarithm of measured by predicted amplitude; nan in bands that are not asked."""
    with np.errstate(over="ignore", invalid="ignore"):
        of_y, of_p = (np.log(np.maximum(each.power, 1e-300)) for each in (measured, predicted))
        ratio = 0.5 * (of_y - of_p)
    return np.where(asked(measured) & np.isfinite(ratio), ratio, np.nan)
