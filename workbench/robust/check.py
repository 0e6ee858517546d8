"""Whether a test came out as predicted, and the log of tests that a model has passed."""

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from workbench.arrays import Floats
from workbench.records.record import Record
from workbench.robust.prediction import LEVEL, Prediction
from workbench.structure.modes import frozen
from workbench.structure.printed import Printed

UNLIKELY = 0.01  # share of tests of a true model that come out worse, below which the model does not hold
LEAST_SAMPLES = 40  # of a record: of fewer readings a sensor hardly two lie outside the bands of a true model
COLUMNS = ("checked", "record", "readings", "coverage", "expected_least", "worst_sensor", "worst_coverage", "holds")


@dataclass(frozen=True, eq=False, repr=False)
class PredictionCheck(Printed):
    """How much of a new record lies inside the bands that were predicted.

    Attributes:
        name: of the record.
        sensors: (n_outputs,) names.
        readings: how many were checked.
        coverage: (n_outputs,) share of readings inside the bands over time.
        band_coverage: (n_outputs, n_bands) share of Fourier amplitudes inside theirs, by frequency band.
        bands_hz: (n_bands, 2) Hz.
        expected: (n_draws, n_outputs, 1 + n_bands) the same shares of readings that the model itself gives.
        allowed: rms of what the model leaves unexplained, over that of the readings: of 1 or more, bands about no
            model at all would be as good.
    """

    name: str
    sensors: tuple[str, ...]
    readings: int
    coverage: Floats
    band_coverage: Floats
    bands_hz: Floats
    expected: Floats
    allowed: float = 0.0

    def __post_init__(self) -> None:
        for name in ("coverage", "band_coverage", "bands_hz", "expected"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @property
    def overall(self) -> float:
        """Share of all readings inside the bands over time."""
        return float(self.coverage.mean())

    @property
    def expected_least(self) -> float:
        """Share of the worst sensor, over time, that a test of a true model falls below only once in a hundred."""
        worst = np.sort(self.expected[:, :, 0].min(axis=1))
        return float(worst[int(UNLIKELY * worst.size)])

    @property
    def probability(self) -> float:
        """Share of tests of a true model whose worst sensor, over time or in a band, comes out no better."""
        return min(self._probabilities)

    @property
    def _probabilities(self) -> tuple[float, float]:
        """The same over time alone, and in the bands alone."""
        found = np.column_stack([self.coverage, self.band_coverage])
        over_time = np.mean(self.expected[:, :, 0].min(axis=1) <= found[:, 0].min())
        if found.shape[1] == 1:
            return float(over_time), 1.0
        # bands hold few frequencies: the mean over sensors of each tells more than the least of all
        in_bands = np.mean(self.expected[:, :, 1:].mean(axis=1).min(axis=1) <= found[:, 1:].mean(axis=0).min())
        return float(over_time), float(in_bands)

    @property
    def holds(self) -> bool:
        """Whether the record is one that the model, with its uncertainty, gives; not where that allows for any."""
        return self.probability > UNLIKELY and self.allowed < 1.0

    @property
    def sentence(self) -> str:
        """The check in one sentence."""
        j = int(np.argmin(self.coverage))
        text = (
            f"{100 * self.overall:.3g} % of the readings of {self.name} lie inside the {100 * LEVEL:g} % bands;"
            f" of {self.sensors[j]}, the fewest, {100 * self.coverage[j]:.3g} %, at least"
            f" {100 * self.expected_least:.3g} % expected"
        )
        if self.allowed >= 1.0:
            return (
                f"This is no test of the model: {100 * self.allowed:.3g} % of the readings are allowed for, no less"
                f" than without any model; {text}."
            )
        if self.holds:
            return f"The model holds: {text}."
        return f"The model does not hold: {text}; worst is {' and '.join(self._worst)}."

    @property
    def _worst(self) -> list[str]:
        """What comes out worse than a true model gives, in words: a sensor over time, a frequency band, or both."""
        over_time, in_bands = self._probabilities
        words = []
        if over_time <= UNLIKELY:
            j = int(np.argmin(self.coverage))
            words.append(f"sensor {self.sensors[j]} with {100 * self.coverage[j]:.3g} %")
        if in_bands <= UNLIKELY:
            k = int(np.argmin(self.band_coverage.mean(axis=0)))
            j = int(np.argmin(self.band_coverage[:, k]))
            (low, high), share = self.bands_hz[k], 100 * self.band_coverage[j, k]
            words.append(
                f"the band from {low:.4g} to {high:.4g} Hz, where {share:.3g} % of the amplitudes of {self.sensors[j]}"
                " lie inside"
            )
        return words

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        bands = [f"{low:.3g} to {high:.3g} Hz [%]" for low, high in self.bands_hz]
        rows = [
            (name, f"{100 * share:.3g}", *(f"{100 * s:.3g}" for s in of_band))
            for name, share, of_band in zip(self.sensors, self.coverage, self.band_coverage)
        ]
        return self.sentence, ("sensor", "over time [%]", *bands), rows, ()


def check_length(record: Record) -> None:
    """Refuse a record too short to be a test.

    Raises:
        ValueError: saying how long it must be.
    """
    if record.n_samples < LEAST_SAMPLES:
        raise ValueError(
            f"record {record.name!r} has {record.n_samples} samples, too few to test a model: measure {LEAST_SAMPLES}"
            " or more"
        )


def check_prediction(prediction: Prediction, record: Record) -> PredictionCheck:
    """How much of a record lies inside the bands that were predicted for its inputs.

    Args:
        prediction: of this test.
        record: what was measured, its sensors named as the rig's.

    Raises:
        ValueError: sensors that are missing, a record too short, or another length or sampling rate.
    """
    check_length(record)
    there = {channel.name: row for channel, row in zip(record.output_channels, record.outputs)}
    names = [channel.name for channel in prediction.channels]
    missing = [name for name in names if name not in there]
    if missing:
        raise ValueError(
            f"record {record.name!r} has no output {missing[0]!r}: it has {', '.join(there)}; the prediction is of"
            f" {', '.join(names)}"
        )
    expected = (prediction.time.size, prediction.sample_time)
    if record.n_samples != expected[0] or abs(record.sample_time / expected[1] - 1.0) > 1e-6:
        raise ValueError(
            f"record {record.name!r} has {record.n_samples} samples of {record.sample_time:g} s; the prediction"
            f" {expected[0]} of {expected[1]:g} s. Predict with this record's own inputs"
        )
    outputs = np.array([there[name] for name in names])
    shares = prediction.coverage(outputs)
    return PredictionCheck(
        record.name,
        tuple(names),
        outputs.size,
        shares[:, 0],
        shares[:, 1:],
        prediction.bands_hz,
        prediction.expected,
        prediction.allowed,
    )


def log_test(path: str | Path, check: PredictionCheck) -> Path:
    """Append a check to a log of tests (CSV), whole or not at all: one write, safe beside other writers.

    Raises:
        ValueError: a file that is no such log.
    """
    path = Path(path)
    _check_log(path)
    j = int(np.argmin(check.coverage))
    row = (
        datetime.now(UTC).isoformat(timespec="seconds"),
        check.name,
        check.readings,
        f"{check.overall:.4f}",
        f"{check.expected_least:.4f}",
        check.sensors[j],
        f"{check.coverage[j]:.4f}",
        "yes" if check.holds else "no",
    )
    lines = [row] if path.exists() else [COLUMNS, row]
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    try:
        os.write(handle, "".join(_line(line) for line in lines).encode())
    finally:
        os.close(handle)
    return path


def read_log(path: str | Path) -> list[dict[str, str]]:
    """The tests of a log, first to last: what each column holds; none where there is no such file.

    Raises:
        ValueError: a file that is no such log.
    """
    path = Path(path)
    if not path.exists():
        return []
    _check_log(path)
    with path.open(encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if row["checked"] != "checked"]


def _check_log(path: Path) -> None:
    if path.exists():
        with path.open(encoding="utf-8", errors="replace", newline="") as file:
            if tuple(next(csv.reader(file), ())) != COLUMNS:
                raise ValueError(f"{path} is no log of tests: its first line must be {','.join(COLUMNS)}; move it away")


def _line(values: Sequence[object]) -> str:
    """A line of CSV; a quoted text keeps commas, and no text begins a formula."""
    texts = [" ".join(str(value).split()) for value in values]
    return ",".join(f'"{t.replace(chr(34), chr(34) * 2)}"' if any(c in t for c in ',"') else t for t in texts) + "\n"
