"""What records measure beside what a rig predicts, as it is and once a fault of the set-up is corrected."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from workbench.arrays import Flags, Floats
from workbench.gap.prediction.residuals import lead_of
from workbench.gap.setup.by_band import Spectra, log_ratios, unlike
from workbench.gap.setup.corrections import Correction, SetupFault, without_faults
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import is_stepped, predict

# root mean square per standard deviation of a channel from which it may be connected wrongly: a turned sign leaves 2,
# an exchange about 1.4, a factor of 2π at least 0.84
WIDE_GAP = 0.3
LEFT = 0.15  # share of a channel's measured power that may remain beyond the noise: a prediction of nothing leaves all
NOISY = 0.5  # share of noise in a channel's measured power from which it shows no fault
CLOSED = 0.9  # share of the closable power that a correction must take away, on the channels that it concerns
FELT = 0.2  # change of unlikeness in a band from which a correction is felt there
MOST_CHANNELS = 12  # inputs that are simulated one by one, and pairs of them: beyond, only neighbours are


@dataclass(frozen=True, eq=False)
class Compared:
    """Measured beside predicted, by output; power is in units of the noise where that is larger than a thousandth."""

    rig: Rig
    records: Sequence[Record]
    predicted: Sequence[Floats]
    measured: list[np.ndarray]
    noise: np.ndarray
    scale: np.ndarray
    settle: float
    kept: dict[Correction, "Compared"] = field(default_factory=dict)

    @staticmethod
    def of(rig: Rig, records: Sequence[Record], settle: float, predicted: Sequence[Floats] | None = None) -> "Compared":
        measured = [record.outputs[:, lead_of(record, settle) :] for record in records]
        if predicted is None:
            predicted = _counted(measured, [predicted_by(rig, record) for record in records])
        power = sum((y**2).sum(axis=1) for y in measured) / sum(y.shape[1] for y in measured)
        scale = np.where(power > 0, power, 1.0)
        noise = np.array([s.noise_std for s in rig.sensors]) ** 2 / scale
        return Compared(rig, records, predicted, measured, noise, scale, settle)

    def corrected(self, correction: Correction) -> "Compared":
        """The corrected rig beside the corrected records; kept, for the next question is of the same."""
        if correction not in self.kept:
            self.kept[correction] = Compared.of(*correction(self.rig, self.records), self.settle)
        return self.kept[correction]

    def without(self, fault: SetupFault) -> "Compared":
        """The rig without a fault that is certain beside the records without it, where they show it."""
        if not fault.certain:
            return self
        if not fault.records or set(self.names) <= set(fault.records):
            return self.corrected(fault.correction)
        return Compared.of(*without_faults([fault], self.rig, self.records), self.settle)

    @cached_property
    def each(self) -> list["Compared"]:
        """Of each record by itself."""
        pairs = zip(self.records, self.predicted, strict=True)
        return [Compared.of(self.rig, (record,), self.settle, (predicted,)) for record, predicted in pairs]

    @cached_property
    def by_input(self) -> list[list[Floats]]:
        """What a linear rig reads of each of several inputs alone; empty where they are too many."""
        m = len(self.rig.actuators)
        if not 1 < m <= MOST_CHANNELS or is_stepped(self.rig):
            return []
        alone = [[replace(r, inputs=r.inputs * (np.arange(m) == p)[:, None]) for r in self.records] for p in range(m)]
        return [self.predict(self.rig, records) for records in alone]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the records."""
        return tuple(record.name for record in self.records)

    @cached_property
    def before(self) -> Floats:
        """(n_outputs,) power that the rig leaves as it is."""
        return self.power(self.predicted)

    @property
    def wide(self) -> Flags:
        """(n_outputs,) where that is too much for an effect; a channel that never moves shows no connection."""
        moves = np.any([np.ptp(y, axis=1) > 0 for y in self.measured], axis=0)
        return np.asarray(moves & (self.before > np.maximum(WIDE_GAP**2, 4.0 * self.noise)))

    @cached_property
    def seen(self) -> Spectra:
        """Of what is measured."""
        return self.read(self.measured)

    @cached_property
    def spectra(self) -> Spectra:
        """Of what is predicted."""
        return self.read(self.predicted)

    @cached_property
    def unlike(self) -> Floats:
        """(n_records, n_outputs, n_modes) how unlike measured and predicted signals are."""
        return unlike(self.seen, self.spectra)

    @cached_property
    def log_ratios(self) -> Floats:
        """(n_records, n_outputs, n_modes) logarithms of measured by predicted amplitude; nan where none is asked."""
        return log_ratios(self.seen, self.spectra)

    @property
    def n_samples(self) -> int:
        """That are compared, of one output over all records."""
        return sum(y.shape[1] for y in self.measured)

    def read(self, signals: Sequence[Floats]) -> Spectra:
        """Of the outputs, at the samples that are compared."""
        return Spectra.read(signals, self.records, self.rig.modes.frequencies_hz)

    def with_rows(self, at: Sequence[int], left: Floats) -> Floats:
        """How unlike the signals are where some outputs are as said."""
        whole = self.unlike.copy()
        whole[:, list(at)] = left
        return whole

    @cached_property
    def gains(self) -> Floats:
        """(n_outputs,) what multiplies each prediction best."""
        over = sum((p**2).sum(axis=1) for p in self.predicted)
        along = sum((y * p).sum(axis=1) for y, p in zip(self.measured, self.predicted, strict=True))
        return np.asarray(np.divide(along, over, out=np.ones_like(over), where=over > 0))

    def predict(self, rig: Rig, records: Sequence[Record]) -> list[Floats]:
        """What another rig reads on other records, (n_outputs, n_samples) each, at the samples that are compared."""
        return _counted(self.measured, [predicted_by(rig, record) for record in records])

    def power(self, predicted: Sequence[Floats]) -> Floats:
        """(n_outputs,) mean square of what is left, as a share of the mean square measured."""
        with np.errstate(over="ignore", invalid="ignore"):
            left = sum(((y - p) ** 2).sum(axis=1) for y, p in zip(self.measured, predicted, strict=True))
        return np.asarray(np.nan_to_num(left / self.n_samples / self.scale, nan=np.inf))

    def closed(self, after: np.ndarray) -> np.ndarray:
        """(n_outputs,) share of the power beyond the noise that is gone; 0 where much of the signal is still missed,
        or noise is most of it."""
        left = np.maximum(after - self.noise, 0.0)
        return np.where(
            (left > LEFT) | (self.noise > NOISY), 0.0, 1.0 - left / np.maximum(self.before - self.noise, 1e-300)
        )

    def closes(self, rig: Rig, records: Sequence[Record]) -> float:
        """The share that another rig and other records close, in the median of the channels with a wide gap."""
        after = self.power(self.predict(rig, records))
        return float(np.median(self.closed(after)[self.wide]))


def _counted(measured: Sequence[Floats], predicted: Sequence[Floats]) -> list[Floats]:
    """The end of each prediction that is as long as what is compared of its record."""
    return [p[:, p.shape[1] - y.shape[1] :] for y, p in zip(measured, predicted, strict=True)]


def predicted_by(rig: Rig, record: Record) -> Floats:
    """`predict`, of what grows beyond all numbers too."""
    with np.errstate(over="ignore", invalid="ignore"):
        return predict(rig, record)
