"""A loop is stable exactly when it does not grow of itself; what cannot be verified is refused by name."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.design.estimation.digital import sampled
from workbench.design.estimation.observers import kalman
from workbench.design.laws.imsc import imsc
from workbench.design.loop.rig_loop import LoopTest
from workbench.rig.actuators import Actuator
from workbench.rig.elements import LinearSpring, PeriodicForce
from workbench.robust.posterior import UncertainRig
from workbench.robust.verification import verify


def test_what_no_loop_can_be_made_of_is_refused(rig):
    law = imsc(rig.modes, 2, rig.actuators, weight=0.05)
    controller = sampled(kalman(rig.modes, law, rig.sensors, disturbance=1.0, noise=1e-2), 0.01)
    certain, test = UncertainRig(rig, (), np.zeros((0, 0))), LoopTest(50, 0.01, impulse_at=0.8)
    for wrong, match in (
        ((rig, controller, test), "on an UncertainRig, or on rigs drawn from it; got Rig"),
        (((), controller, test), "on an UncertainRig"),
        ((certain, law, test), "must be a sampled one; got Law"),
        ((certain, controller, None), "the test must be a LoopTest; got NoneType: make one by LoopTest"),
    ):
        with pytest.raises(TypeError, match=match):
            verify(*wrong)
    for draws in (2.5, 0, np.nan, np.inf):
        with pytest.raises(ValueError, match="draws, by which the uncertainty is sampled, is a whole"):
            verify(certain, controller, test, draws=draws)
    assert verify(certain, controller, test, draws=2.0).n_draws == 2
    for given, match in (
        ({"draws": "2"}, "1 or more; got '2'"),
        ({"draws": None}, "1 or more; got None"),
        ({"draws": True}, "1 or more; got True"),
        ({"seed": "x"}, "seed is a whole number, 0 or more; got 'x'"),
        ({"controlled": 2}, r"controlled is a sequence of modes, counted from zero, such as \(0, 1\); got 2"),
        ({"controlled": ("a",)}, "a mode counted from zero, is a whole number"),
        ({"margin_rig": controller}, "margin_rig is the rig whose small-gain margin is stated; got DigitalController"),
    ):
        with pytest.raises(TypeError, match=match):
            verify(certain, controller, test, **given)
    for given, match in (
        ({"seed": -1}, "seed is a whole number, 0 or more; got -1"),
        ({"controlled": (-1,)}, "a mode counted from zero, is a whole number, 0 or more; got -1"),
        ({"controlled": (0, 9)}, "controlled are modes 0 to 5 of the rigs, counted from zero; got 9"),
    ):
        with pytest.raises(ValueError, match=match):
            verify(certain, controller, test, **given)
    with pytest.raises(ValueError, match=r"LoopTest.n_samples is a whole number, 0 or more; got 50.5"):
        LoopTest(50.5, 0.01)
    with pytest.raises(TypeError, match=r"LoopTest.sample_time is a number in s; got '0.01'"):
        LoopTest(50, "0.01")


def test_forces_neither_hide_growth_nor_pass_for_it(rig):
    """A spring below zero that limited forces hold near rest alone; and a stable loop under forces of many kinds."""
    law = imsc(rig.modes, 2, rig.actuators, weight=0.01)
    controller = sampled(kalman(rig.modes, law, rig.sensors, disturbance=1.0, noise=1e-4), 0.01)
    held = replace(
        rig,
        actuators=tuple(replace(a, limit=0.2) for a in rig.actuators),
        elements=(LinearSpring(0.8, -1.5 * rig.modes.omega[0] ** 2),),
    )
    n, port = 600, (Actuator("shaker", 0.83, direct=True),)
    noise = np.random.default_rng(0).standard_normal((1, n))
    for scale, stays in ((1e-4, True), (0.5, True), (2.0, False)):
        test = LoopTest(n, 0.01, forces=scale * noise, ports=port)
        assert verify([held], controller, test).stable.all() is np.bool_(stays)
    ramp = np.linspace(0.0, 1.0, n)[None]
    at_resonance = np.sin(rig.modes.omega[3] * 0.01 * np.arange(n))[None]
    for force in (ramp, ramp**4, np.full((1, n), 0.5), at_resonance, noise):
        assert verify([rig], controller, LoopTest(n, 0.01, forces=force, ports=port)).stable.all()
    hummed = replace(rig, elements=(PeriodicForce(0.83, rig.modes.omega[3] / (2 * np.pi), 1.0, 0.0),))
    assert verify([hummed], controller, LoopTest(n, 0.01)).stable.all()
