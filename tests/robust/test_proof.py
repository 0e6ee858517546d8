"""What cannot be verified is refused by name."""

import numpy as np
import pytest

from workbench.design.estimation.digital import sampled
from workbench.design.estimation.observers import kalman
from workbench.design.laws.imsc import imsc
from workbench.design.loop.rig_loop import LoopTest
from workbench.robust.posterior import UncertainRig
from workbench.robust.proof import verify


def test_what_no_loop_can_be_made_of_is_refused(rig):
    law = imsc(rig.modes, 2, rig.actuators, weight=0.05)
    controller = sampled(kalman(rig.modes, law, rig.sensors, disturbance=1.0, noise=1e-2), 0.01)
    certain, test = UncertainRig(rig, (), np.zeros((0, 0))), LoopTest(50, 0.01, impulse_at=0.8)
    for wrong, match in (
        ((rig, controller, test), "on an UncertainRig, or on rigs drawn from it; got Rig"),
        (((), controller, test), "on an UncertainRig"),
        ((certain, law, test), "sampled controller; got Law"),
        ((certain, controller, None), "the test that each loop is put through; got NoneType"),
    ):
        with pytest.raises(TypeError, match=match):
            verify(*wrong)
    for draws in (2.5, 0):
        with pytest.raises(ValueError, match="whole number of draws"):
            verify(certain, controller, test, draws=draws)
    assert verify(certain, controller, test, draws=2.0).n_draws == 2
