"""Validation of a model by a new record: the coverage of its prediction bands, and a log of such tests."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path

import numpy as np

from workbench.arrays import Floats
from workbench.records.record import Record
from workbench.records.units import SI, Units
from workbench.robust.prediction import Prediction
from workbench.robust.verification import LEVEL
from workbench.structure.modes import freeze
from workbench.structure.printed import Printed

UNLIKELY = 0.01  # significance level of either test, over time and in bands: a true model fails one in at most 2 %
LEAST_SAMPLES = 40  # of a record: of fewer samples, less than two of a sensor lie outside the bands of a true model
COLUMNS = ("checked", "record", "readings", "coverage", "expected_least", "worst_sensor", "worst_coverage", "holds")


@dataclass(frozen=True, eq=False, repr=False)
class PredictionCheck(Printed):
    """The coverage of prediction bands by a new record, beside that expected of a true model.

    Attributes:
        name: of the record.
        sensors: (n_outputs,) names.
        readings: number of readings checked.
        coverage: (n_outputs,) share of readings inside the bands over time.
        band_coverage: (n_outputs, n_bands) share of Fourier amplitudes inside their bands, by frequency band.
        bands_hz: (n_bands, 2) Hz.
        expected: (n_draws, n_outputs, 1 + n_bands) the same shares of readings simulated by the model.
        allowed: rms of the model's unexplained residual over that of the readings; bands with 1 or more are no test
            of the model.
        units: of the frequencies.
    """

    name: str
    sensors: tuple[str, ...]
    readings: int
    coverage: Floats
    band_coverage: Floats
    bands_hz: Floats
    expected: Floats
    allowed: float = 0.0
    units: Units = SI

    def __post_init__(self) -> None:
        freeze(self, "coverage", "band_coverage", "bands_hz", "expected")

    @property
    def overall(self) -> float:
        """Share of all readings inside the bands over time."""
        return float(self.coverage.mean())

    @property
    def expected_least(self) -> float:
        """The one per cent quantile of the worst sensor's coverage over time, for a true model."""
        return _least(_worst_shares(self.expected)[0])

    @property
    def expected_least_in_bands(self) -> float:
        """The one per cent quantile of the worst band's coverage, mean of the sensors, for a true model; 1 without."""
        return _least(_worst_shares(self.expected)[1])

    @property
    def _probabilities(self) -> tuple[float, float]:
        """p-values over time (worst sensor) and in the frequency bands (worst band, mean of the sensors)."""
        own = _worst_shares(np.column_stack([self.coverage, self.band_coverage]))
        over_time, in_bands = (float(np.mean(e <= o)) for e, o in zip(_worst_shares(self.expected), own))
        return over_time, in_bands

    @property
    def probability(self) -> float:
        """The smaller of the p-values over time and in the frequency bands: two tests, each at the level UNLIKELY."""
        return min(self._probabilities)

    @property
    def holds(self) -> bool:
        """Whether the record agrees with the model and its uncertainty, where the bands are a test of the model."""
        return self.probability > UNLIKELY and self.allowed < 1.0

    @property
    def sentence(self) -> str:
        """The check in one sentence."""
        j = int(np.argmin(self.coverage))
        text = (
            f"over time {100 * self.overall:.3g} % of the readings of {self.name} lie inside the {100 * LEVEL:g} %"
            f" bands; of {self.sensors[j]}, the fewest, {100 * self.coverage[j]:.3g} %, at least"
            f" {100 * self.expected_least:.3g} % expected"
        )
        if self.allowed >= 1.0:
            return (
                f"This record does not test the model: the bands allow for an error of {100 * self.allowed:.3g} % of"
                f" the readings; {text}."
            )
        if self.holds:
            return f"The record is consistent with the model: {text}."
        return f"The record is not consistent with the model: {text}; worst is {' and '.join(self._worst)}."

    @property
    def _worst(self) -> list[str]:
        """The sensor, the frequency band, or both, whose coverage is too low, in words."""
        over_time, in_bands = self._probabilities
        words = []
        if over_time <= UNLIKELY:
            j = int(np.argmin(self.coverage))
            words.append(f"sensor {self.sensors[j]} with {100 * self.coverage[j]:.3g} %")
        if in_bands <= UNLIKELY:
            k = self._worst_band
            j = int(np.argmin(self.band_coverage[:, k]))
            (low, high), shares = self.bands_hz[k], 100 * self.band_coverage[:, k]
            words.append(
                f"the band from {low:.4g} to {high:.4g} {self._hertz}, where {shares.mean():.3g} % of the amplitudes"
                f" lie inside ({shares[j]:.3g} % of {self.sensors[j]}), at least"
                f" {100 * self.expected_least_in_bands:.3g} % expected"
            )
        return words

    @property
    def _hertz(self) -> str:
        return self.units.named("Hz")

    @property
    def _worst_band(self) -> int:
        return int(np.argmin(self.band_coverage.mean(axis=0)))

    @property
    def decisive(self) -> tuple[str, float, float]:
        """What decides: the worst sensor over time, or the worst band; its coverage and the least expected."""
        over_time, in_bands = self._probabilities
        if in_bands < over_time and in_bands <= UNLIKELY:
            k = self._worst_band
            low, high = self.bands_hz[k]
            share = float(self.band_coverage[:, k].mean())
            return f"all, {low:.4g} to {high:.4g} {self._hertz}", share, self.expected_least_in_bands
        j = int(np.argmin(self.coverage))
        return self.sensors[j], float(self.coverage[j]), self.expected_least

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        bands = [f"{low:.3g} to {high:.3g} {self._hertz} [%]" for low, high in self.bands_hz]
        rows = [
            (name, f"{100 * share:.3g}", *(f"{100 * s:.3g}" for s in of_band))
            for name, share, of_band in zip(self.sensors, self.coverage, self.band_coverage)
        ]
        means = [self.overall, *self.band_coverage.mean(axis=0)]
        least = [self.expected_least, *[self.expected_least_in_bands] * len(bands)]
        rows.append(("mean", *(f"{100 * share:.3g}" for share in means)))
        rows.append(
            (
                "expected at least (time: each sensor; bands: mean of sensors)",
                *(f"≥ {100 * share:.3g}" for share in least),
            )
        )
        return self.sentence, ("sensor", "over time [%]", *bands), rows, ()


def _worst_shares(shares: Floats) -> tuple[Floats, Floats]:
    """Of coverages (..., n_outputs, 1 + n_bands) the worst sensor's over time, and the worst band's, each (...,).

    A band holds few lines, so that the mean over sensors has more power than the worst sensor. Without bands it is 1.
    """
    return shares[..., 0].min(axis=-1), shares[..., 1:].mean(axis=-2).min(axis=-1, initial=1.0)


def _least(shares: Floats) -> float:
    """The one per cent quantile of the shares (n_draws,) of a true model: fewer are unlikely."""
    return float(np.sort(shares)[int(UNLIKELY * shares.size)])


def check_length(record: Record) -> None:
    """Refuse a record too short to be a test."""
    if record.n_samples < LEAST_SAMPLES:
        raise ValueError(
            f"record {record.name!r} has {record.n_samples} samples, too few to test a model: measure {LEAST_SAMPLES}"
            " or more"
        )


def check_prediction(prediction: Prediction, record: Record) -> PredictionCheck:
    """The coverage of the prediction bands by a measured record.

    Args:
        prediction: for the inputs of the record.
        record: measured, its sensors named as the rig's.

    Raises:
        ValueError: missing sensors, a record too short, or another length or sampling rate.
    """
    check_length(record)
    measured = {channel.name: row for channel, row in zip(record.output_channels, record.outputs)}
    names = [channel.name for channel in prediction.channels]
    missing = [name for name in names if name not in measured]
    if missing:
        raise ValueError(
            f"record {record.name!r} has no output {missing[0]!r}: it has {', '.join(measured)}; the prediction is of"
            f" {', '.join(names)}"
        )
    n_samples, sample_time, time = prediction.time.size, prediction.sample_time, prediction.units.time
    if record.n_samples != n_samples or abs(record.sample_time / sample_time - 1.0) > 1e-6:
        raise ValueError(
            f"record {record.name!r} has {record.n_samples} samples of {record.sample_time:g} {time}; the prediction"
            f" {n_samples} of {sample_time:g} {time}. Predict with this record's own inputs"
        )
    outputs = np.array([measured[name] for name in names])
    shares = prediction.coverage(outputs)
    of_model = prediction.bands_hz, prediction.expected, prediction.allowed, prediction.units
    return PredictionCheck(record.name, tuple(names), outputs.size, shares[:, 0], shares[:, 1:], *of_model)


def log_test(path: str | Path, check: PredictionCheck) -> Path:
    """Append a check to a log of tests (CSV), by one write, so that concurrent writers do not mix lines.

    Raises:
        ValueError: a file that is no log of tests.
    """
    path = Path(path)
    _check_log(path)
    worst, share, least = check.decisive
    row = (
        datetime.now(UTC).isoformat(timespec="seconds"),
        check.name,
        check.readings,
        f"{check.overall:.4f}",
        f"{least:.4f}",
        worst,
        f"{share:.4f}",
        "yes" if check.holds else "no",
    )
    lines = [row] if path.exists() else [COLUMNS, row]
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows([" ".join(str(value).split()) for value in line] for line in lines)
    with path.open("ab", buffering=0) as file:
        file.write(text.getvalue().encode())
    return path


def read_log(path: str | Path) -> list[dict[str, str]]:
    """The rows of a log of tests, {column: text}, oldest first; empty where the file does not exist.

    Raises:
        ValueError: a file that is no log of tests.
    """
    path = Path(path)
    if not path.exists():
        return []
    _check_log(path)
    with path.open(encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if row["checked"] != "checked"]


def _check_log(path: Path) -> None:
    if not path.exists():
        return
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        if tuple(next(csv.reader(file), ())) != COLUMNS:
            raise ValueError(
                f"{path} is no log of tests: its first line must be {','.join(COLUMNS)}; choose another file"
            )
