"""Sensors: quantity, place and imperfections."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workbench.renamed import Renamed
from workbench.structure.domain import Place, same_place
from workbench.structure.printed import Constructed

# quantity: (derivative along x, derivative in time)
MEASURED = {
    "displacement": (0, 0),
    "slope": (1, 0),
    "velocity": (0, 1),
    "angular velocity": (1, 1),
    "acceleration": (0, 2),
}


@dataclass(frozen=True, repr=False)
class Sensor(Constructed):
    """A sensor at a point.

    The measured quantity passes cross-talk, delay, lag, gain, bias and drift, noise, clipping and rounding, in that
    order.

    Attributes:
        name: of the output.
        at: place on the structure: x (m), (x, y), or the name of a point.
        quantity: "displacement", "slope", "velocity", "angular velocity" or "acceleration".
        noise_std: standard deviation of white noise.
        gain: reading per measured quantity.
        bias: constant offset.
        drift: offset gained linearly over a record, from 0 at its first sample.
        crosstalk: (name, share) of other sensors whose quantities are added.
        delay: s; negative, by less than a sample, where the sensor's clock is ahead of that of the inputs.
        interpolated: whether the delay is by linear interpolation between samples, as where a logger resamples
            channels to one clock; else the motion is read at the delayed time.
        time_constant: of a first-order lag, s.
        limit: largest |reading|.
        step: readings are rounded to multiples of this; 0 for none.
        direction: of the displacement, or the axis of the slope, where the structure has more than one at a place.
        shape_error: (n_modes,) error of each mode shape, or of its slope, at this place; empty for none.
    """

    name: str
    at: Place
    quantity: str = "displacement"
    noise_std: float = 0.0
    gain: float = 1.0
    bias: float = 0.0
    drift: float = 0.0
    time_constant: float = 0.0
    limit: float = np.inf
    step: float = 0.0
    delay: float = 0.0
    crosstalk: tuple[tuple[str, float], ...] = ()
    direction: str | None = None
    shape_error: tuple[float, ...] = ()
    interpolated: bool = False

    linear = Renamed("has_state_space")

    def __post_init__(self) -> None:
        object.__setattr__(self, "at", same_place(self.at))
        if self.quantity not in MEASURED:
            raise ValueError(f"sensor {self.name}: quantity is one of {', '.join(MEASURED)}; got {self.quantity!r}")
        if not np.isfinite(self.delay):
            raise ValueError(f"sensor {self.name}: delay must be finite; got {self.delay}")
        for quantity in ("noise_std", "time_constant", "step"):
            if not (np.isfinite(getattr(self, quantity)) and getattr(self, quantity) >= 0):
                raise ValueError(f"sensor {self.name}: {quantity} must be 0 or more; got {getattr(self, quantity)}")
        if not self.limit > 0:
            raise ValueError(f"sensor {self.name}: limit must be positive; got {self.limit}")

    @property
    def has_state_space(self) -> bool:
        """Whether the reading is linear in the measured quantities with finitely many states, so without a delay."""
        return bool(np.isinf(self.limit) and not (self.bias or self.drift or self.step or self.delay))


def crosstalk_between(sensors: Sequence[Sensor]) -> list[tuple[int, int, float]]:
    """Cross-talk of sensors, (index, index of the other, share); an unknown name is refused by a `ValueError`."""
    names = [sensor.name for sensor in sensors]
    for sensor in sensors:
        for name, _ in sensor.crosstalk:
            if name not in names:
                raise ValueError(f"sensor {sensor.name} reads a share of {name!r}, which is no sensor of the rig")
    return [(j, names.index(name), share) for j, sensor in enumerate(sensors) for name, share in sensor.crosstalk]


def linear_sensor(sensor: Sensor) -> Sensor:
    """The sensor with its gain, delay, lag and cross-talk alone, and its noise."""
    return replace(sensor, bias=0.0, drift=0.0, limit=np.inf, step=0.0)
