"""A loop is stable exactly when it does not grow of itself; what cannot be verified is refused by name."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.design.estimation.digital import sampled
from workbench.design.estimation.observers import kalman_controller
from workbench.design.laws.imsc import imsc
from workbench.design.loop.rig_loop import LoopTest, run_loop
from workbench.rig.actuators import Actuator
from workbench.rig.elements import LinearSpring, PeriodicForce
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.robust.impulse import impulse_test
from workbench.robust.plain_law import plain_law
from workbench.robust.posterior import UncertainRig
from workbench.robust.verification import verify
from workbench.structure.domain import NamedPoints, Patch
from workbench.structure.modes import Modes, PointShapes
from workbench.structure.plate import Plate


def test_what_no_loop_can_be_made_of_is_refused(rig):
    law = imsc(rig.modes, 2, rig.actuators, weight=0.05)
    controller = sampled(kalman_controller(rig.modes, law, rig.sensors, disturbance=1.0, noise=1e-2), 0.01)
    certain, test = UncertainRig(rig, (), np.zeros((0, 0))), LoopTest(50, 0.01, impulse_at=0.8)
    for wrong, match in (
        ((rig, controller, test), "on an UncertainRig, or on rigs drawn from it; got Rig"),
        (((), controller, test), "on an UncertainRig"),
        ((certain, law, test), "must be a DigitalController; got Law"),
        ((certain, controller, None), "the test must be a LoopTest; got NoneType: make one by LoopTest"),
    ):
        with pytest.raises(TypeError, match=match):
            verify(*wrong)
    for draws in (2.5, 0, np.nan, np.inf):
        with pytest.raises(ValueError, match="draws, the number of realisations of the uncertain rig, is a whole"):
            verify(certain, controller, test, draws=draws)
    assert verify(certain, controller, test, draws=2.0).n_draws == 2
    for given, match in (
        ({"draws": "2"}, "1 or more; got '2'"),
        ({"draws": None}, "1 or more; got None"),
        ({"draws": True}, "1 or more; got True"),
        ({"seed": "x"}, "seed is a whole number, 0 or more; got 'x'"),
        ({"controlled": 2}, r"controlled is a sequence of modes, counted from zero, such as \(0, 1\); got 2"),
        ({"controlled": ("a",)}, "a mode counted from zero, is a whole number"),
        ({"margin_rig": controller}, "margin_rig must be a Rig, for the small-gain margin; got DigitalController"),
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
    controller = sampled(kalman_controller(rig.modes, law, rig.sensors, disturbance=1.0, noise=1e-4), 0.01)
    held = replace(
        rig,
        actuators=tuple(replace(a, limit=0.2) for a in rig.actuators),
        elements=(LinearSpring(0.8, -1.5 * rig.modes.omega[0] ** 2),),
    )
    n, shaker = 600, (Actuator("shaker", 0.83, direct=True),)
    noise = np.random.default_rng(0).standard_normal((1, n))
    for scale, stays in ((1e-4, True), (0.5, True), (2.0, False)):
        test = LoopTest(n, 0.01, forces=scale * noise, exciters=shaker)
        assert verify([held], controller, test).stable.all() is np.bool_(stays)
    ramp = np.linspace(0.0, 1.0, n)[None]
    at_resonance = np.sin(rig.modes.omega[3] * 0.01 * np.arange(n))[None]
    for force in (ramp, ramp**4, np.full((1, n), 0.5), at_resonance, noise):
        assert verify([rig], controller, LoopTest(n, 0.01, forces=force, exciters=shaker)).stable.all()
    hummed = replace(rig, elements=(PeriodicForce(0.83, rig.modes.omega[3] / (2 * np.pi), 1.0, 0.0),))
    assert verify([hummed], controller, LoopTest(n, 0.01)).stable.all()


def patched_plate():
    plate = Plate(
        length=(1.0, 0.8), mass_per_area=5.0, bending_stiffness=60.0, poisson_ratio=0.3, edges="simply supported"
    )
    patches = [Actuator(f"P{i}", Patch(x, 0.3, 0.1, 0.1), quantity="moment") for i, x in enumerate((0.25, 0.6))]
    return plate.modes(4), patches, [(0.25, 0.3), (0.6, 0.3)]


def frame_of_two_nodes():
    """Its first actuator by node and direction, as a case gives it; both drive x."""
    names, nodes, directions = ("ax", "ay", "bx", "by"), ("a", "a", "b", "b"), ("x", "y") * 2
    shapes = np.array([[0.6, 0.5, 0.3], [0.1, 0.2, 0.6], [0.7, -0.6, 0.1], [0.2, 0.3, -0.5]])
    modes = Modes(np.array([10.0, 25.0, 60.0]), 0.01, PointShapes(shapes), NamedPoints(names, None, directions, nodes))
    return modes, [Actuator("A", "a", direction="x"), Actuator("B", "bx")], ["ax", "bx"]


@pytest.mark.parametrize("structure", [patched_plate, frame_of_two_nodes])
@pytest.mark.parametrize("kind", ["poles", "on-off"])
def test_patches_and_directions_are_controlled_and_their_stroke_is_that_of_the_place(structure, kind):
    modes, actuators, places = structure()
    sensors = [Sensor(f"y{i}", at, noise_std=1e-6) for i, at in enumerate(places)]
    rig = Rig(modes, tuple(actuators), tuple(sensors))
    law = plain_law(kind, rig, 2, damping=0.05)
    dt = 0.05 / modes.omega[-1]
    test = impulse_test(rig, (0, 1), dt)
    if kind == "on-off":
        assert all(relay.force > 0 for relay in law.relays)
        return
    controller = sampled(kalman_controller(modes, law, sensors, disturbance=1.0, noise=1e-8), dt)
    found = verify([rig], controller, test)
    run = run_loop(rig, controller, test)
    moved = modes.phi(places) @ run.response.modal[: modes.n_modes]
    assert found.stroke[0] == pytest.approx(np.abs(moved).max(), rel=1e-12)
