"""A hinged beam with four sensors, and records of what it does when something else is there too."""

import numpy as np
import pytest

from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate

NOISE = 1e-5


@pytest.fixture(scope="session")
def hinged_rig(hinged_beam):
    """The rig as so many modes and actuators make it."""

    def make(n_modes: int = 6, actuators: tuple[Actuator, ...] = (Actuator("F", 0.45),)) -> Rig:
        sensors = tuple(Sensor(f"d{i + 1}", x, noise_std=NOISE) for i, x in enumerate((0.3, 0.7, 1.1, 1.6)))
        return Rig(hinged_beam.modes(n_modes), actuators, sensors, structure=hinged_beam)

    return make


@pytest.fixture(scope="session")
def record_of():
    """What the sensors of a rig read, with noise drawn from rng; other arguments are `simulate`'s."""

    def make(real: Rig, inputs: np.ndarray, rng: np.random.Generator, *, name: str = "", **how) -> Record:
        clean = simulate(real, inputs, sample_time=0.01, **how).outputs
        return Record(
            sample_time=0.01,
            outputs=clean + NOISE * rng.normal(size=clean.shape),
            output_channels=tuple(Channel(s.name, s.quantity, at=s.at, noise_std=s.noise_std) for s in real.sensors),
            inputs=inputs,
            input_channels=tuple(Channel(a.name, "force", at=a.at) for a in real.actuators),
            name=name,
        )

    return make
