"""A record: uniformly sampled input and output signals with names and places."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from workbench.renamed import Renamed
from workbench.structure.domain import Location, place_array, same_place
from workbench.structure.modes import frozen
from workbench.structure.printed import Constructed, Printed, counted, place_text

if TYPE_CHECKING:
    import control  # takes seconds to import: most who read a record never need it

# course of an input between samples: zero-order hold, first-order hold, or band-limited
HOLDS = ("zero", "first", "band-limited")
QUANTITIES = {
    "displacement": "m",
    "slope": "rad",
    "velocity": "m/s",
    "angular velocity": "rad/s",
    "acceleration": "m/s^2",
    "force": "N",
    "moment": "N m",
    "voltage": "V",
    "": "",
}
SAME = 1e-5  # rms difference of one measurement written twice, to six digits or more, over its rms


@dataclass(frozen=True, repr=False)
class Channel(Constructed):
    """One signal of a record.

    Attributes:
        name: unique among the inputs, and among the outputs, of a record.
        quantity: what is measured, one of `QUANTITIES` or another word.
        unit: as written on the axis; by default that of the quantity.
        at: place on the structure: x (m), (x, y), or the name of a point; None where unknown or meaningless.
        noise_std: standard deviation of the sensor's white noise, in `unit`; None where unknown.
    """

    name: str
    quantity: str = ""
    unit: str = ""
    at: Location | None = None
    noise_std: float | None = None

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("a channel needs a name")
        if self.noise_std is not None and not self.noise_std >= 0:
            raise ValueError(f"channel {self.name!r}: noise_std must be 0 or more; got {self.noise_std}")
        object.__setattr__(self, "unit", self.unit or QUANTITIES.get(self.quantity, ""))
        object.__setattr__(self, "at", None if self.at is None else same_place(self.at))

    def _derived(self) -> tuple[str, ...]:
        return ("unit",) if self.unit == QUANTITIES.get(self.quantity) else ()


@dataclass(frozen=True, eq=False, repr=False)
class Record(Printed):
    """Sampled signals with time last, as in python-control.

    Attributes:
        sample_time: seconds between samples.
        outputs: (n_outputs, n_samples) measured signals.
        output_channels: one `Channel` per row of `outputs`.
        inputs: (n_inputs, n_samples) input signals; may have no rows.
        input_channels: one `Channel` per row of `inputs`.
        input_hold: "zero" where inputs are held over each sample interval, as by a D/A converter; "band-limited" where
            they have no content above the Nyquist frequency, as forces measured after an anti-alias filter; "first"
            where they are linear from sample to sample, as forces slow compared with the sample rate nearly are.
        start_time: time of the first sample, s.
        name: in messages and plots.
        remarks: on changes made on reading the file: units, time steps.

    Raises:
        ValueError: shapes that do not fit, repeated names, empty or non-finite signals (channel and sample named).
    """

    sample_time: float
    outputs: np.ndarray
    output_channels: tuple[Channel, ...]
    inputs: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    input_channels: tuple[Channel, ...] = ()
    input_hold: str = "zero"
    start_time: float = 0.0
    name: str = "record"
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        outputs = frozen(np.atleast_2d(self.outputs))
        inputs = np.asarray(self.inputs, float)
        inputs = frozen(np.zeros((0, outputs.shape[1])) if inputs.size == 0 else np.atleast_2d(inputs))
        object.__setattr__(self, "outputs", outputs)
        object.__setattr__(self, "inputs", inputs)
        object.__setattr__(self, "output_channels", tuple(self.output_channels))
        object.__setattr__(self, "input_channels", tuple(self.input_channels))
        if not (np.isfinite(self.sample_time) and self.sample_time > 0):
            raise ValueError(f"record {self.name!r}: the sample time must be positive; got {self.sample_time}")
        if self.input_hold not in HOLDS:
            raise ValueError(
                f"record {self.name!r}: input_hold is zero (held), first (linear between samples) or band-limited"
                f" (as after an anti-alias filter); got {self.input_hold!r}"
            )
        if outputs.shape[1] == 0:
            raise ValueError(f"record {self.name!r} is empty: it holds no samples")
        if inputs.shape[1] != outputs.shape[1]:
            raise ValueError(
                f"record {self.name!r}: inputs and outputs must have as many samples, time last; got"
                f" {inputs.shape[1]} and {outputs.shape[1]}"
            )
        sides = ("input", inputs, self.input_channels), ("output", outputs, self.output_channels)
        for kind, values, channels in sides:
            if values.shape[0] != len(channels):
                raise ValueError(
                    f"record {self.name!r}: {kind}s must have shape ({len(channels)} channels, n_samples);"
                    f" got {values.shape}. Is time the last axis?"
                )
            names = [c.name for c in channels]
            if len(set(names)) != len(names):
                raise ValueError(f"record {self.name!r}: {kind} names must differ; got {names}")
            for channel, row in zip(channels, values, strict=True):
                bad = ~np.isfinite(row)
                if bad.any():
                    raise ValueError(
                        f"record {self.name!r}, channel {channel.name!r}: sample {int(np.argmax(bad))} is"
                        f" {row[bad][0]}; repair or cut it out before use"
                    )

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        rows = [
            (c.name, kind, c.quantity, c.unit, place_text(c.at), f"{row.std():.3g}", f"{np.abs(row).max():.3g}")
            for kind, c, row in self.signals()
        ]
        line = (
            f"record {self.name!r}, {counted(self.n_inputs, 'input')} and {counted(self.n_outputs, 'output')},"
            f" {self.n_samples} samples at {self.sample_rate_hz:.6g} Hz, {self.n_samples * self.sample_time:.4g} s"
        )
        return line, ("channel", "", "quantity", "unit", "at", "std", "peak"), rows, self.remarks

    def signals(self) -> Iterator[tuple[str, Channel, np.ndarray]]:
        """Kind ("input" or "output"), channel and samples (n_samples,) of each input, then of each output."""
        sides = ("input", self.input_channels, self.inputs), ("output", self.output_channels, self.outputs)
        for kind, channels, rows in sides:
            for channel, row in zip(channels, rows, strict=True):
                yield kind, channel, row

    @property
    def n_samples(self) -> int:
        return int(self.outputs.shape[1])

    @property
    def n_outputs(self) -> int:
        return len(self.outputs)

    @property
    def n_inputs(self) -> int:
        return len(self.inputs)

    @property
    def time(self) -> np.ndarray:
        """Sample instants (n_samples,), s."""
        return self.start_time + self.sample_time * np.arange(self.n_samples)

    @property
    def sample_rate_hz(self) -> float:
        return 1.0 / self.sample_time

    @property
    def positions(self) -> np.ndarray:
        """Places of the outputs: (n_outputs,) or (n_outputs, 2) m, nan where unknown, or (n_outputs,) names."""
        return place_array([c.at for c in self.output_channels])

    @property
    def output_names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.output_channels)

    @property
    def input_names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.input_channels)

    def repeats(self, other: "Record") -> bool:
        """Whether both hold one measurement, as far as the shorter goes, to the digits that a file may have of it."""
        if (self.n_outputs, self.n_inputs) != (other.n_outputs, other.n_inputs):
            return False
        n = min(self.n_samples, other.n_samples)
        rows, others = (np.concatenate([r.outputs[:, :n], r.inputs[:, :n]]) for r in (self, other))
        size = rows.std(axis=1)
        alike = np.sqrt(((rows - others) ** 2).mean(axis=1)) <= SAME * size
        return bool(alike.all() and size[: self.n_outputs].any())

    def between(self, start: float | None = None, stop: float | None = None) -> "Record":
        """The samples with start <= time <= stop (s); the time axis is kept."""
        time, slack = self.time, 1e-9 * self.sample_time
        low, high = -np.inf if start is None else start - slack, np.inf if stop is None else stop + slack
        inside = np.flatnonzero((time >= low) & (time <= high))
        if inside.size == 0:
            wanted = [f"{word} {at:g} s" for word, at in (("from", start), ("to", stop)) if at is not None]
            span = f"from {time[0]:g} to {time[-1]:g} s"
            raise ValueError(f"record {self.name!r} runs {span}: it has no sample {' '.join(wanted)}")
        if inside.size == self.n_samples:
            return self
        kept, first = slice(inside[0], inside[-1] + 1), float(time[inside[0]])
        return replace(self, outputs=self.outputs[:, kept], inputs=self.inputs[:, kept], start_time=first)

    only = Renamed("select_outputs")

    def select_outputs(self, outputs: Sequence[str]) -> "Record":
        """The record with only the named outputs, in that order."""
        if tuple(outputs) == self.output_names:
            return self
        rows = rows_of(f"record {self.name!r}", self.output_names, outputs)
        return replace(self, outputs=self.outputs[rows], output_channels=tuple(self.output_channels[r] for r in rows))

    def with_inputs(self, names: Sequence[str]) -> "Record":
        """The record with the named signals as inputs and all others as outputs, each in the order they had.

        Without others, they are the outputs too. An unknown name is a ValueError.
        """
        channels, rows = (*self.input_channels, *self.output_channels), (*self.inputs, *self.outputs)
        there = [channel.name for channel in channels]
        for name in names:
            if name not in there:
                needed = f"no signal {name!r} to take as an input"
                raise ValueError(f"record {self.name!r} has {needed}; it has {', '.join(there)}")
        into = [i for i, name in enumerate(there) if name in names]
        out = [i for i in range(len(there)) if i not in into] or into
        return replace(
            self,
            inputs=np.array([rows[i] for i in into]),
            input_channels=tuple(channels[i] for i in into),
            outputs=np.array([rows[i] for i in out]),
            output_channels=tuple(channels[i] for i in out),
        )

    def to_control(self) -> "control.TimeResponseData":
        """The same signals as python-control's `TimeResponseData`."""
        import control

        return control.TimeResponseData(
            self.time,
            self.outputs,
            inputs=self.inputs if self.n_inputs else None,
            issiso=False,
            output_labels=list(self.output_names),
            input_labels=list(self.input_names) or None,
            title=self.name,
        )

    @classmethod
    def from_control(cls, response: "control.TimeResponseData", *, name: str = "record") -> "Record":
        """A record from python-control's `TimeResponseData` (one trace, uniform time).

        Raises:
            ValueError: several traces, or times that are not uniform.
        """
        steps = np.diff(response.time)
        if steps.size == 0 or np.ptp(steps) > 1e-6 * abs(steps.mean()):
            raise ValueError(f"response {name!r} is not uniformly sampled; resample it first")
        outputs = np.asarray(response.y)
        inputs = np.zeros((0, *outputs.shape[1:])) if response.u is None else np.asarray(response.u)
        if outputs.ndim == 3:
            if outputs.shape[1] != 1:
                raise ValueError(f"response {name!r} holds {outputs.shape[1]} traces; take one of them")
            outputs, inputs = outputs[:, 0], inputs[:, 0]
        labels = response.output_labels or [f"y[{i}]" for i in range(len(outputs))]
        input_labels = response.input_labels or [f"u[{i}]" for i in range(len(inputs))]
        return cls(
            sample_time=float(steps.mean()),
            outputs=outputs,
            output_channels=tuple(Channel(label) for label in labels),
            inputs=inputs,
            input_channels=tuple(Channel(label) for label in input_labels),
            start_time=float(response.time[0]),
            name=name,
        )


def rows_of(owner: str, outputs: Sequence[str], names: Sequence[str]) -> list[int]:
    """The rows of named outputs, in the order of the names; a name that `owner` (in words) does not have is refused."""
    row_of = {name: row for row, name in enumerate(outputs)}
    for name in names:
        if name not in row_of:
            raise ValueError(f"{owner} has no output {name!r}; it has {', '.join(outputs)}")
    return [row_of[name] for name in names]


def as_records(records: Record | Iterable[Record]) -> list[Record]:
    """One record or several as a list."""
    return [records] if isinstance(records, Record) else list(records)
