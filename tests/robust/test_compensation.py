"""What a compensation takes out is gone: the loop moves as it would without."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import displacement_filter
from workbench.design.estimation.observers import kalman_controller
from workbench.design.laws.imsc import imsc
from workbench.design.loop.rig_loop import LoopTest, run_loop
from workbench.rig.elements import CoulombFriction
from workbench.robust.compensation import compensated
from workbench.robust.on_rig import loop_on_rig
from workbench.robust.small_motion import crosstalk


@pytest.mark.parametrize(("sample_time", "left"), [(0.01, 0.1), (0.001, 0.012)])
def test_friction_is_opposed_so_that_the_controlled_modes_move_as_without_it(rig, sample_time, left):
    """Exact but for the sampling, where no residual mode moves at the friction."""
    rig = replace(rig, modes=rig.modes.select(slice(2)), structure=None)
    test = LoopTest(round(6.0 / sample_time), sample_time, impulse_at=0.8)
    law = imsc(rig.modes, 2, rig.actuators, weight=0.02)
    loop = loop_on_rig(rig, kalman_controller(rig.modes, law, rig.sensors[4:], disturbance=1.0, noise=1e-6), test)
    rough = replace(rig, elements=(CoulombFriction(0.9, 0.2, 0.05),))

    def moved(on, *steps):
        return run_loop(on, compensated(rough, loop, sample_time, steps), test).response.modal[:2]

    smooth = moved(rig)
    as_it_is, opposed = (np.abs(motion - smooth).max() for motion in (moved(rough), moved(rough, "friction")))
    assert as_it_is > 0.05 * np.abs(smooth).max()
    assert opposed < left * as_it_is


def test_the_speed_at_a_friction_is_read_without_cross_talk(rig):
    """Of a modal filter, which estimates it from the readings alone."""
    rig = replace(rig, elements=(CoulombFriction(0.9, 0.2, 0.05),))
    law = imsc(rig.modes, 2, rig.actuators, weight=0.02)
    places = sorted({sensor.at for sensor in rig.sensors})
    through = filtered(law, displacement_filter(rig.modes.select(range(2)), places, 1.0))
    loop = loop_on_rig(rig, through, LoopTest(100, 0.01, impulse_at=0.8))
    mixed = tuple(replace(s, crosstalk=(("v1", 0.2),)) if s.name == "v2" else s for s in rig.sensors)
    clean, corrected = (
        compensated(replace(rig, sensors=sensors), loop, 0.01, ("sensors", "friction")).friction
        for sensors in (rig.sensors, mixed)
    )
    np.testing.assert_allclose(corrected.of_reading @ crosstalk(mixed), clean.of_reading, atol=1e-15)
