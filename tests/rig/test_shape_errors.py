"""Mode shapes that are off at an actuator or a sensor are those of modes that have them there."""

from dataclasses import replace

import control
import numpy as np
import pytest

from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.rig.statespace import state_space
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes

SHAPES = np.array([[1.0, 0.3], [0.6, -0.8], [0.2, 0.9]])
ERROR = np.array([[0.02, -0.05], [0.0, 0.0], [-0.03, 0.04]])


def modes(shapes):
    return Modes(
        omega=[10.0, 31.0], damping=[0.02, 0.01], shapes=PointShapes(shapes), domain=NamedPoints(("p", "q", "r"))
    )


def rigs():
    """One with errors at its transducers, and one of modes that have them."""
    force, read = Actuator("F", "p", shape_error=tuple(ERROR[0])), Sensor("a", "r", "acceleration")
    late = replace(read, shape_error=tuple(ERROR[2]), delay=0.013, gain=2.0)
    return (
        Rig(modes(SHAPES), (force,), (late, Sensor("d", "q"))),
        Rig(modes(SHAPES + ERROR), (Actuator("F", "p"),), (replace(late, shape_error=()), Sensor("d", "q"))),
    )


def test_simulated():
    inputs = np.random.default_rng(0).normal(size=(1, 300))
    off, other = (simulate(rig, inputs, sample_time=0.02).outputs for rig in rigs())
    np.testing.assert_allclose(off, other, rtol=1e-12, atol=1e-12 * np.abs(other).max())
    straight = simulate(replace(rigs()[0], modes=modes(SHAPES + ERROR)), inputs, sample_time=0.02).outputs
    assert np.abs(straight - other).max() > 0.01 * np.abs(other).max()


def test_in_state_space():
    off, other = (state_space(r.modes, r.actuators, [replace(s, delay=0.0) for s in r.sensors]) for r in rigs())
    points = [0.3j, 9.0j, 40.0j]
    np.testing.assert_allclose(control.evalfr(off, points[1]), control.evalfr(other, points[1]), rtol=1e-12)
    assert np.allclose(off(points), other(points), rtol=1e-12)


@pytest.mark.parametrize("known", [1, 3])
def test_modes_beyond_those_whose_error_is_known_have_none(known):
    rig = rigs()[0]
    sensor = replace(rig.sensors[0], shape_error=(0.1,) * known)
    rows = state_space(rig.modes, rig.actuators, [replace(sensor, delay=0.0, quantity="displacement")]).C[0, :2]
    np.testing.assert_allclose(rows, 2.0 * (SHAPES[2] + [0.1, 0.1 if known > 1 else 0.0]))
