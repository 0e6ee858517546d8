"""A hinged beam with two actuators, read by displacement and velocity sensors."""

import pytest

from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam


@pytest.fixture(scope="session")
def rig():
    beam = Beam(
        length=2.0,
        mass_per_length=1.0,
        bending_stiffness=4.0,
        left="hinged",
        right="hinged",
        damping=ModalDamping(0.01),
    )
    places = (0.3, 0.7, 1.1, 1.6)
    sensors = [Sensor(f"d{i + 1}", x, noise_std=1e-5) for i, x in enumerate(places)]
    sensors += [Sensor(f"v{i + 1}", x, "velocity", noise_std=1e-4) for i, x in enumerate(places)]
    return Rig(beam.modes(6), (Actuator("F1", 0.45), Actuator("F2", 1.2)), tuple(sensors), structure=beam)
