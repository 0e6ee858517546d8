"""Misfit of measured and predicted signals, in frequency bands of one mode each."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from workbench.arrays import Complexes, Flags, Floats, Integers
from workbench.records.record import Record

LEAST_POWER = 1e-2  # of a channel's power: a band with less holds noise and leakage, and is not compared
LARGEST_LOG_RATIO = 3.0  # bound of |log amplitude ratio|, so that one band that an effect changes does not dominate
FADE = 0.25  # of a record: its end is faded out over it; its beginning, from rest, holds the response to a hammer


@dataclass(frozen=True, eq=False)
class Spectra:
    """Spectra of the signals of several records, with the bands of the modes.

    Attributes:
        lines: (n_signals, n_lines) of each record.
        edges: (n_modes + 1,) of each record: the line at which each mode's band starts, and at which the last ends.
    """

    lines: list[Complexes]
    edges: list[Integers]

    @staticmethod
    def of_signals(signals: Sequence[Floats], records: Sequence[Record], frequencies_hz: Floats) -> "Spectra":
        """Spectra of signals, (n_signals, n_samples) a record; bands end halfway between two natural frequencies."""
        # every line is compared in some band; `localisation.where` shares a gap among modes, and takes geometric means
        edges_hz = np.r_[0.0, (frequencies_hz[1:] + frequencies_hz[:-1]) / 2.0, np.inf]
        lines, edges = [], []
        for signal, record in zip(signals, records, strict=True):
            n = signal.shape[1]
            fade = np.minimum(1.0, np.arange(n, 0, -1) / (FADE * n))
            lines.append(np.fft.rfft((signal - signal.mean(axis=1, keepdims=True)) * np.sin(0.5 * np.pi * fade) ** 2))
            edges.append(np.asarray(np.searchsorted(np.fft.rfftfreq(n, record.sample_time), edges_hz)))
        return Spectra(lines, edges)

    def with_lines(self, lines: list[Complexes]) -> "Spectra":
        """Spectra of other signals of the same records."""
        return Spectra(lines, self.edges)

    def select(self, at: Sequence[int]) -> "Spectra":
        """Spectra of some of the signals, in this order."""
        return self.with_lines([lines[list(at)] for lines in self.lines])

    @cached_property
    def power(self) -> Floats:
        """Power (n_records, n_signals, n_modes) of each signal in each band."""
        return self.cross_power(self)

    def cross_power(self, other: "Spectra") -> Floats:
        """Real part of the cross-power (n_records, n_signals, n_modes) of each signal and its counterpart, by band."""
        in_bands = []
        for one, two, edges in zip(self.lines, other.lines, self.edges, strict=True):
            up_to = np.cumsum((one * two.conj()).real, axis=1)
            in_bands.append(np.diff(np.hstack([np.zeros((len(up_to), 1)), up_to])[:, edges], axis=1))
        return np.array(in_bands)


def compared_bands(measured: Spectra) -> Flags:
    """Whether each band (n_records, n_signals, n_modes) holds enough of its signal to be compared."""
    return np.asarray(measured.power > LEAST_POWER * measured.power.sum(axis=2, keepdims=True))


def band_misfit(measured: Spectra, predicted: Spectra, factor: float = 1.0) -> Floats:
    """|log amplitude ratio| + 1 - correlation (n_records, n_signals, n_modes), with the prediction scaled by `factor`.

    A missing effect shifts resonances and changes the amplitudes of some bands, up or down; a fault of the set-up
    changes all bands alike.
    """
    tiny = 1e-300
    with np.errstate(over="ignore", invalid="ignore"):
        of_y, of_p, both = measured.power, predicted.power, measured.cross_power(predicted)
        ratio = 0.5 * (np.log(np.maximum(of_y, tiny)) - np.log(np.maximum(of_p * factor**2, tiny)))
        correlation = np.sign(factor) * both / np.sqrt(np.maximum(of_y * of_p, tiny))
        misfit = np.minimum(np.abs(ratio), LARGEST_LOG_RATIO) + 1.0 - correlation
        return np.asarray(np.nan_to_num(misfit, nan=LARGEST_LOG_RATIO + 1.0))


def log_ratios(measured: Spectra, predicted: Spectra) -> Floats:
    """Log of measured over predicted amplitude (n_records, n_signals, n_modes); NaN in bands that are not compared."""
    with np.errstate(over="ignore", invalid="ignore"):
        of_y, of_p = (np.log(np.maximum(each.power, 1e-300)) for each in (measured, predicted))
        ratio = 0.5 * (of_y - of_p)
    return np.where(compared_bands(measured) & np.isfinite(ratio), ratio, np.nan)
