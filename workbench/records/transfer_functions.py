"""Transfer functions: named, placed spectra of outputs per unit input."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.records.record import Channel
from workbench.structure.modes import frozen
from workbench.structure.printed import Printed, counted, place_text


@dataclass(frozen=True, eq=False, repr=False)
class TransferFunctions(Printed):
    """Measured transfer functions, frequency last.

    Attributes:
        values: (n_outputs, n_references, n_frequencies) complex, outputs per unit input.
        frequencies_hz: (n_frequencies,) increasing, at any spacing.
        output_channels: one `Channel` an output.
        references: one name an input, whether it was struck or shaken.
        name: how messages call it.

    Raises:
        ValueError: shapes that do not fit, repeated names, frequencies that do not increase.
    """

    values: np.ndarray
    frequencies_hz: np.ndarray
    output_channels: tuple[Channel, ...]
    references: tuple[str, ...] = ("input",)
    name: str = "transfer functions"

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", frozen(self.values, complex))
        object.__setattr__(self, "frequencies_hz", frozen(self.frequencies_hz))
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
        rows = [
            (c.name, c.quantity, c.unit, place_text(c.at), f"{np.abs(values).max():.3g}")
            for c, values in zip(self.output_channels, self.values, strict=True)
        ]
        f = self.frequencies_hz
        pairs = f"{counted(len(self.output_channels), 'output')} by {counted(len(self.references), 'reference')}"
        span = f"{f.min(initial=np.inf):.4g} to {f.max(initial=0.0):.4g} Hz"
        line = f"{self.name}: {pairs}, {f.size} lines, {span}"
        return line, ("output", "quantity", "unit", "at", "peak"), rows, ()

    @property
    def output_names(self) -> tuple[str, ...]:
        return tuple(channel.name for channel in self.output_channels)

    def only(self, outputs: tuple[str, ...]) -> "TransferFunctions":
        """These outputs alone, in this order.

        Raises:
            ValueError: an output that is not there.
        """
        for name in outputs:
            if name not in self.output_names:
                raise ValueError(f"{self.name} has no output {name!r}; it has {', '.join(self.output_names)}")
        rows = [self.output_names.index(name) for name in outputs]
        channels = tuple(self.output_channels[row] for row in rows)
        return TransferFunctions(self.values[rows], self.frequencies_hz, channels, self.references, self.name)
