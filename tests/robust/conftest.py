"""A hinged beam with two actuators, read by displacement and velocity sensors."""

import pytest

from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor


@pytest.fixture(scope="session")
def rig(hinged_beam):
    places = (0.3, 0.7, 1.1, 1.6)
    sensors = [Sensor(f"d{i + 1}", x, noise_std=1e-5) for i, x in enumerate(places)]
    sensors += [Sensor(f"v{i + 1}", x, "velocity", noise_std=1e-4) for i, x in enumerate(places)]
    return Rig(hinged_beam.modes(6), (Actuator("F1", 0.45), Actuator("F2", 1.2)), tuple(sensors), structure=hinged_beam)
