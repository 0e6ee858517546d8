"""Comparison of records with the simulations of a rig, in frequency bands of one mode each."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from workbench.arrays import Complexes, Flags, Floats, Integers
from workbench.gap.prediction.residuals import lead_of
from workbench.gap.setup.corrections import Correction, SetupFault, without_faults
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import is_stepped, simulate_record

MIN_POWER_SHARE = 1e-2  # of a channel's power: a band with less holds noise and leakage, and is not compared
MAX_LOG_RATIO = 3.0  # bound of |log amplitude ratio|, so that one band that an effect changes does not dominate
# of a record: its end is faded out over it; its beginning, from rest, holds the response to a hammer
FADED_SHARE = 0.25
# rms residual, in standard deviations of the channel, from which it may be connected wrongly: a wrong sign leaves 2, an
# exchange about 1.4, a factor of 2π at least 0.84
MIN_RESIDUAL = 0.3
# share of a channel's measured power that may remain beyond the noise: zero simulations leave all
MAX_RESIDUAL_SHARE = 0.15
MAX_NOISE_SHARE = 0.5  # share of noise in a channel's measured power from which it shows no fault
MIN_CLOSED_SHARE = 0.9  # share of the closable power that a correction must remove, on the channels that it concerns
MIN_MISFIT_CHANGE = 0.2  # change of the misfit from which a correction affects a band
MAX_INPUTS = 12  # inputs that are simulated one by one, and exchanged in pairs; beyond, only neighbours are


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
        # every line is compared in some band; `localisation.breakdown` shares a gap among modes, by geometric means
        edges_hz = np.r_[0.0, (frequencies_hz[1:] + frequencies_hz[:-1]) / 2.0, np.inf]
        lines, edges = [], []
        for signal, record in zip(signals, records, strict=True):
            n = signal.shape[1]
            fade = np.minimum(1.0, np.arange(n, 0, -1) / (FADED_SHARE * n))
            lines.append(np.fft.rfft((signal - signal.mean(axis=1, keepdims=True)) * np.sin(0.5 * np.pi * fade) ** 2))
            edges.append(np.asarray(np.searchsorted(np.fft.rfftfreq(n, record.sample_time), edges_hz)))
        return Spectra(lines, edges)

    def with_lines(self, lines: list[Complexes]) -> "Spectra":
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
    return np.asarray(measured.power > MIN_POWER_SHARE * measured.power.sum(axis=2, keepdims=True))


def band_misfit(measured: Spectra, simulated: Spectra, factor: float = 1.0) -> Floats:
    """|log amplitude ratio| + 1 - correlation (n_records, n_signals, n_modes), with the simulation scaled by `factor`.

    A missing effect shifts resonances and changes the amplitudes of some bands, up or down; a fault of the set-up
    changes all bands alike.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        of_y, of_p, both = measured.power, simulated.power, measured.cross_power(simulated)
        ratio = 0.5 * (np.log(np.maximum(of_y, 1e-300)) - np.log(np.maximum(of_p * factor**2, 1e-300)))
        correlation = np.sign(factor) * both / np.sqrt(np.maximum(of_y * of_p, 1e-300))
        misfit = np.minimum(np.abs(ratio), MAX_LOG_RATIO) + 1.0 - correlation
        return np.asarray(np.nan_to_num(misfit, nan=MAX_LOG_RATIO + 1.0))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured and simulated outputs of records, after the transient.

    Attributes:
        rig: that is simulated.
        records: that are compared.
        simulated, measured: (n_outputs, n_samples) of each record.
        noise: (n_outputs,) noise power, as a share of the power measured.
        scale: (n_outputs,) mean square measured, in squared units of the output; 1 where it is zero.
        transient: seconds at the start of each record that are not compared.
        cache: comparisons after corrections.
    """

    rig: Rig
    records: Sequence[Record]
    simulated: Sequence[Floats]
    measured: list[np.ndarray]
    noise: np.ndarray
    scale: np.ndarray
    transient: float
    cache: dict[Correction, "Comparison"] = field(default_factory=dict)

    @staticmethod
    def of(
        rig: Rig, records: Sequence[Record], transient: float, simulated: Sequence[Floats] | None = None
    ) -> "Comparison":
        """The comparison of a rig with records; simulated: the simulations, if they are known."""
        measured = [record.outputs[:, lead_of(record, transient) :] for record in records]
        if simulated is None:
            simulated = _simulated(rig, records, measured)
        power = sum((y**2).sum(axis=1) for y in measured) / sum(y.shape[1] for y in measured)
        scale = np.where(power > 0, power, 1.0)
        noise = np.array([s.noise_std for s in rig.sensors]) ** 2 / scale
        return Comparison(rig, records, simulated, measured, noise, scale, transient)

    def corrected(self, correction: Correction) -> "Comparison":
        """The corrected rig and the corrected records, compared; cached, since the same one is needed again."""
        if correction not in self.cache:
            self.cache[correction] = Comparison.of(*correction(self.rig, self.records), self.transient)
        return self.cache[correction]

    def without(self, fault: SetupFault) -> "Comparison":
        """The comparison after a fault is corrected in rig and records, if it is certain."""
        if not fault.certain:
            return self
        if not fault.records or set(self.record_names) <= set(fault.records):
            return self.corrected(fault.correction)
        return Comparison.of(*without_faults([fault], self.rig, self.records), self.transient)

    @cached_property
    def by_record(self) -> list["Comparison"]:
        pairs = zip(self.records, self.simulated, strict=True)
        return [Comparison.of(self.rig, (record,), self.transient, (simulated,)) for record, simulated in pairs]

    @cached_property
    def by_input(self) -> list[list[Floats]]:
        """Predictions of a linear rig for each input alone; empty for one input, too many, or a nonlinear rig."""
        m = len(self.rig.actuators)
        if not 1 < m <= MAX_INPUTS or is_stepped(self.rig):
            return []
        alone = [[replace(r, inputs=r.inputs * (np.arange(m) == p)[:, None]) for r in self.records] for p in range(m)]
        return [self.simulated_with(self.rig, records) for records in alone]

    @property
    def record_names(self) -> tuple[str, ...]:
        return tuple(record.name for record in self.records)

    @cached_property
    def before(self) -> Floats:
        """Residual power (n_outputs,) of the rig without any correction, as a share of the power measured."""
        return self.residual_power(self.simulated)

    @property
    def wide(self) -> Flags:
        """Whether the residual of each output (n_outputs,) is too large for an effect; False for a constant channel."""
        moves = np.any([np.ptp(y, axis=1) > 0 for y in self.measured], axis=0)
        return np.asarray(moves & (self.before > np.maximum(MIN_RESIDUAL**2, 4.0 * self.noise)))

    @cached_property
    def measured_spectra(self) -> Spectra:
        return self.spectra_of(self.measured)

    @cached_property
    def simulated_spectra(self) -> Spectra:
        return self.spectra_of(self.simulated)

    @cached_property
    def misfit(self) -> Floats:
        """Misfit (n_records, n_outputs, n_modes) of each output in each band; see `band_misfit`."""
        return band_misfit(self.measured_spectra, self.simulated_spectra)

    @cached_property
    def log_ratios(self) -> Floats:
        """Log of measured over simulated amplitude (n_records, n_outputs, n_modes); NaN in bands not compared."""
        with np.errstate(over="ignore", invalid="ignore"):
            of_y, of_p = (np.log(np.maximum(s.power, 1e-300)) for s in (self.measured_spectra, self.simulated_spectra))
            ratio = 0.5 * (of_y - of_p)
        return np.where(compared_bands(self.measured_spectra) & np.isfinite(ratio), ratio, np.nan)

    @property
    def n_samples(self) -> int:
        """Number of samples that are compared, of one output over all records."""
        return sum(y.shape[1] for y in self.measured)

    def spectra_of(self, signals: Sequence[Floats]) -> Spectra:
        """Spectra of signals, (n_signals, n_samples) a record, at the samples that are compared."""
        return Spectra.of_signals(signals, self.records, self.rig.modes.frequencies_hz)

    def misfit_with(self, at: Sequence[int], misfit: Floats) -> Floats:
        """Misfit (n_records, n_outputs, n_modes) with that of the outputs `at` replaced."""
        whole = self.misfit.copy()
        whole[:, list(at)] = misfit
        return whole

    @cached_property
    def gains(self) -> Floats:
        """Factors (n_outputs,) by which the simulations fit the measured outputs best, by least squares."""
        over = sum((p**2).sum(axis=1) for p in self.simulated)
        along = sum((y * p).sum(axis=1) for y, p in zip(self.measured, self.simulated, strict=True))
        return np.asarray(np.divide(along, over, out=np.ones_like(over), where=over > 0))

    def simulated_with(self, rig: Rig, records: Sequence[Record]) -> list[Floats]:
        """Readings (n_outputs, n_samples) of another rig for other records, at the samples that are compared."""
        return _simulated(rig, records, self.measured)

    def residual_power(self, simulated: Sequence[Floats]) -> Floats:
        """Mean square residual (n_outputs,) of simulations, as a share of the mean square measured."""
        with np.errstate(over="ignore", invalid="ignore"):
            left = sum(((y - p) ** 2).sum(axis=1) for y, p in zip(self.measured, simulated, strict=True))
        return np.asarray(np.nan_to_num(left / self.n_samples / self.scale, nan=np.inf))

    def closed(self, after: np.ndarray) -> np.ndarray:
        """Share (n_outputs,) of the residual power beyond the noise that is removed.

        It counts as 0 if much of the signal remains, or if most of the signal is noise. after: (n_outputs,) residual
        power after a correction.
        """
        left = np.maximum(after - self.noise, 0.0)
        closed = 1.0 - left / np.maximum(self.before - self.noise, 1e-300)
        return np.where((left > MAX_RESIDUAL_SHARE) | (self.noise > MAX_NOISE_SHARE), 0.0, closed)

    def closes(self, rig: Rig, records: Sequence[Record]) -> float:
        """The share that a corrected rig and records close: the median over channels with a wide gap."""
        after = self.residual_power(self.simulated_with(rig, records))
        return float(np.median(self.closed(after)[self.wide]))


def _simulated(rig: Rig, records: Sequence[Record], measured: Sequence[Floats]) -> list[Floats]:
    """The last samples of the simulation of each record, as many as are measured after the transient."""
    return [simulated_by(rig, r)[:, r.n_samples - y.shape[1] :] for r, y in zip(records, measured, strict=True)]


def simulated_by(rig: Rig, record: Record) -> Floats:
    """Readings (n_outputs, n_samples) of a rig, as `simulate_record`, without warnings if it diverges."""
    with np.errstate(over="ignore", invalid="ignore"):
        return simulate_record(rig, record)
