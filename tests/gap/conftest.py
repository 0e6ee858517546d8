"""A hinged beam with four sensors, and records of what it does when something else is there too."""

import numpy as np
import pytest

from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam

NOISE = 1e-5


@pytest.fixture(scope="session")
def hinged_rig():
    """The rig as so many modes and actuators make it."""

    def make(n_modes: int = 6, actuators: tuple[Actuator, ...] = (Actuator("F", 0.45),)) -> Rig:
        beam = Beam(
            length=2.0,
            mass_per_length=1.0,
            bending_stiffness=4.0,
            left="hinged",
            right="hinged",
            damping=ModalDamping(0.01),
        )
        sensors = tuple(Sensor(f"d{i + 1}", x, noise_std=NOISE) for i, x in enumerate((0.3, 0.7, 1.1, 1.6)))
        return Rig(beam.modes(n_modes), actuators, sensors, structure=beam)

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
