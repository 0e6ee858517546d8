"""What a compensation takes out is gone: the loop moves as it would without."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import displacement_filter
from workbench.design.estimation.observers import kalman_controller
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError
from workbench.design.laws.on_off import on_off
from workbench.design.loop.rig_loop import LoopTest, run_loop
from workbench.rig.elements import CoulombFriction
from workbench.robust.compensation import compensated
from workbench.robust.on_rig import loop_on_rig, redesigned_for
from workbench.robust.small_motion import crosstalk, loop_poles


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


@pytest.mark.parametrize("steps", [(), ("delay", "friction")], ids=["plain", "delay and friction"])
def test_cross_talk_of_actuators_is_undone(rig, steps):
    """Before delays and lags, which differ, so that the loop moves as without it."""
    law = imsc(rig.modes, 2, rig.actuators, weight=0.02)
    controller = kalman_controller(rig.modes, law, rig.sensors[4:], disturbance=1.0, noise=1e-6)
    test = LoopTest(300, 0.01, impulse_at=0.8)
    late = [{"delay": 0.013, "bias": 0.1}, {"time_constant": 0.02, "gain": 0.7}]
    actuators = tuple(replace(a, **each) for a, each in zip(rig.actuators, late, strict=True))
    clean = replace(rig, actuators=actuators, elements=(CoulombFriction(0.9, 0.02, 0.05),))
    mixed = replace(clean, actuators=(replace(actuators[0], crosstalk=(("F2", 0.3),)), actuators[1]))
    motions, radii = [], []
    for real in (clean, mixed):
        loop = redesigned_for(loop_on_rig(rig, controller, test), real, rig.modes)
        digital = compensated(real, loop, test.sample_time, steps)
        motions.append(run_loop(real, digital, test).response.modal)
        radii.append(loop_poles(real, digital).spectral_radius)
    np.testing.assert_allclose(motions[1], motions[0], atol=1e-9 * np.abs(motions[0]).max())
    assert radii[1] == pytest.approx(radii[0], rel=1e-9)
    undone = run_loop(mixed, compensated(clean, loop, test.sample_time, steps), test).response.modal
    assert np.abs(undone - motions[0]).max() > 0.01 * np.abs(motions[0]).max()


def test_cross_talk_of_relays_is_undone(rig):
    law = on_off(rig.modes, 2, rig.actuators, force=0.2, dead_band=0.01)
    loop = loop_on_rig(rig, law, LoopTest(100, 0.01, impulse_at=0.8))
    first, second = rig.actuators
    mixed = replace(rig, actuators=(first, replace(second, crosstalk=(("F1", 0.4),))))
    test = LoopTest(200, 0.01, impulse_at=0.8)
    clean, leaking = (run_loop(r, compensated(r, loop, 0.01), test).response for r in (rig, mixed))
    np.testing.assert_allclose(leaking.modal, clean.modal, atol=1e-9 * np.abs(clean.modal).max())


def test_cross_talk_without_an_inverse_is_refused(rig):
    law = imsc(rig.modes, 2, rig.actuators, weight=0.02)
    controller = kalman_controller(rig.modes, law, rig.sensors[4:], disturbance=1.0, noise=1e-6)
    loop = loop_on_rig(rig, controller, LoopTest(100, 0.01, impulse_at=0.8))
    (first, second), one = rig.actuators, 1.0
    alike = (replace(first, crosstalk=(("F2", one),)), replace(second, crosstalk=(("F1", one),)))
    with pytest.raises(DesignError, match="cross-talk between F1, F2 makes them act alike"):
        compensated(replace(rig, actuators=alike), loop, 0.01)
