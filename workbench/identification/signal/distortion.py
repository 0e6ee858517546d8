"""Nonlinear distortion and noise from periodic excitation, without a model; detection of the period.

A linear structure responds at the excited lines only. The mean over periods at the other lines is distortion: where
only odd multiples of 1/T are excited, an even nonlinearity shows at even multiples, an odd one at odd multiples. The
scatter between periods is noise. Pintelon & Schoukens, System Identification: A Frequency Domain Approach, 2nd ed.,
Wiley 2012, section 4.3.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from workbench.records.record import Channel, Record
from workbench.structure.modes import frozen


@dataclass(frozen=True)
class PeriodicSettings:
    """Constants of the detection of a period and its lines."""

    min_line_ratio: float = 0.05  # amplitude of an excited line, relative to the largest line of the inputs
    transient_periods: int = 1  # at the start, that are left out
    min_autocorrelation: float = 0.9  # of the inputs at a period; that of other lags is far lower
    # that lags before the period fall below; that of a slow drift does not
    low_autocorrelation: float = 0.5
    min_period_samples: int = 8


PERIODIC = PeriodicSettings()


@dataclass(frozen=True, eq=False)
class Distortion:
    """Fourier lines of the mean period of a record, and their noise."""

    name: str  # of the record
    frequencies_hz: np.ndarray  # (n_lines,) multiples k / T of the frequency of the period
    excited: np.ndarray  # (n_lines,) whether the inputs have that line
    amplitudes: np.ndarray  # (n_outputs, n_lines) rms of each line, in the unit of the output
    noise: np.ndarray  # (n_outputs, n_lines) standard error of each, from the scatter between periods
    channels: tuple[Channel, ...]  # of the outputs
    n_periods: int  # number of periods averaged
    input_rms: float  # of all inputs together
    input_amplitudes: np.ndarray  # (n_lines,) rms of each line of all inputs together

    @property
    def even(self) -> np.ndarray:
        """(n_lines,) whether a line is an even multiple that is not excited."""
        return np.asarray(~self.excited & (np.arange(self.excited.size) % 2 == 1))

    @property
    def odd(self) -> np.ndarray:
        """(n_lines,) whether a line is an odd multiple that is not excited."""
        return np.asarray(~self.excited & (np.arange(self.excited.size) % 2 == 0))

    @property
    def parity_resolved(self) -> bool:
        """Whether only odd lines are excited: even lines then show an even nonlinearity."""
        return not self.excited[1::2].any()

    @property
    def rms(self) -> Mapping[str, np.ndarray]:
        """Rms of each output (n_outputs,) on excited, odd and even lines, and of the noise of one period."""
        kinds = {"excited": self.excited, "odd": self.odd, "even": self.even}
        values = {kind: np.sqrt((self.amplitudes[:, lines] ** 2).sum(axis=1)) for kind, lines in kinds.items()}
        return values | {"noise": np.sqrt(self.n_periods * (self.noise**2).sum(axis=1))}


def distortion_of(record: Record) -> Distortion:
    """Distortion and noise of a record of three or more periods of its inputs, without the transient first period.

    Raises:
        ValueError: inputs that do not repeat, or too few periods.
    """
    period = period_of(record.inputs)
    if period is None:
        raise ValueError(f"record {record.name!r}: its inputs do not repeat, so no line is free of them")
    n_periods = record.n_samples // period - PERIODIC.transient_periods
    if n_periods < 2:
        raise ValueError(
            f"record {record.name!r} has {n_periods + PERIODIC.transient_periods} periods; noise needs three or more"
        )
    whole = slice(PERIODIC.transient_periods * period, (PERIODIC.transient_periods + n_periods) * period)

    def lines_of(signals: np.ndarray) -> np.ndarray:
        """Fourier lines (n_signals, n_periods, n_lines) complex, their moduli rms."""
        periods = signals[:, whole].reshape(signals.shape[0], n_periods, period)
        return np.asarray(np.sqrt(2.0) / period * np.fft.rfft(periods, axis=2)[:, :, 1 : (period + 1) // 2])

    inputs, outputs = lines_of(record.inputs).mean(axis=1), lines_of(record.outputs)
    size = np.sqrt((np.abs(inputs) ** 2).sum(axis=0))
    mean = outputs.mean(axis=1)
    scatter = (np.abs(outputs - mean[:, None]) ** 2).sum(axis=1) / (n_periods - 1)
    return Distortion(
        name=record.name,
        frequencies_hz=frozen(np.arange(1, size.size + 1) / (period * record.sample_time)),
        excited=frozen(size > PERIODIC.min_line_ratio * size.max(), bool),
        amplitudes=frozen(np.abs(mean)),
        noise=frozen(np.sqrt(scatter / n_periods)),
        channels=record.output_channels,
        n_periods=n_periods,
        input_rms=float(np.sqrt((record.inputs**2).mean())),
        input_amplitudes=frozen(size),
    )


def period_of(inputs: np.ndarray) -> int | None:
    """Period of the inputs in samples: the lag L of the first peak of their autocorrelation above 0.9.

        ρ(L) = Σ_k u(k)·u(k + L) / √(Σ_k |u(k)|² Σ_k |u(k + L)|²)      over k = 0 ... n - L - 1, u less its mean

    Args:
        inputs: (n_inputs, n_samples); at least two periods long.

    Returns:
        The period, or None where the inputs do not repeat.
    """
    n = np.shape(inputs)[1]
    most = n // 2
    if most < 2 * PERIODIC.min_period_samples:
        return None
    u = np.asarray(inputs, float)
    u = (u - u.mean(axis=1, keepdims=True))[np.ptp(u, axis=1) > 0]
    if not len(u):
        return None
    spectrum = np.fft.rfft(u, 2 * n, axis=1)
    product = np.fft.irfft((np.abs(spectrum) ** 2).sum(axis=0))[: most + 2]
    sums = np.r_[0.0, np.cumsum((u**2).sum(axis=0))]
    lags = np.arange(most + 2)
    scale = np.sqrt(sums[n - lags] * (sums[n] - sums[lags]))
    autocorrelation = product / np.where(scale > 0, scale, np.inf)
    low = np.flatnonzero(autocorrelation[:most] < PERIODIC.low_autocorrelation)
    if low.size == 0:
        return None
    start = max(int(low[0]), PERIODIC.min_period_samples)
    before, at, after = (autocorrelation[start + shift : most + 1 + shift] for shift in (-1, 0, 1))
    peaks = start + np.flatnonzero((at > PERIODIC.min_autocorrelation) & (at >= before) & (at >= after))
    return int(peaks[0]) if peaks.size else None
