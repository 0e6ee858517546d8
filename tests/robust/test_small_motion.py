"""The loop of small motion, against the simulated one and python-control."""

from dataclasses import replace
from itertools import product

import control
import numpy as np
import pytest

from workbench.design.estimation.digital import sampled
from workbench.design.estimation.observers import kalman_controller
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError
from workbench.design.loop.rig_loop import LoopTest, run_loop
from workbench.rig.elements import CubicSpring, LinearDamper, LinearSpring
from workbench.rig.statespace import state_space
from workbench.robust.small_motion import loop_poles, modes_in_motion, small_gain_margin
from workbench.structure.modification import attach
from workbench.structure.supports import PointDamper, PointSpring

DT = 0.01


@pytest.fixture(scope="module")
def controller(rig):
    law = imsc(rig.modes, 2, rig.actuators, weight=0.05)
    return sampled(kalman_controller(rig.modes, law, rig.sensors, disturbance=1.0, noise=1e-2), DT)


def test_the_slowest_pole_is_that_of_the_simulated_motion(rig, controller):
    """Late, slow, scaled: the last swings of the motion fade as the largest pole says."""
    late = tuple(replace(a, delay=1.5 * DT, time_constant=0.02, gain=0.9) for a in rig.actuators)
    real = replace(rig, actuators=late)
    run = run_loop(real, controller, LoopTest(4000, DT, impulse_at=0.8))
    energy = run.response.energy.sum(axis=0)
    fading = (energy[3500:].mean() / energy[3000:3500].mean()) ** (1.0 / 1000.0)
    assert fading == pytest.approx(loop_poles(real, controller).spectral_radius, abs=2e-6)


def test_poles_without_control_are_those_of_the_modes(rig, controller):
    silent = replace(controller, C=0.0 * controller.C, E=0.0 * controller.E)
    assert loop_poles(rig, silent).damping == pytest.approx(rig.modes.zeta, rel=1e-6)


def test_a_delay_that_a_predictor_makes_up_for_has_loop_poles_too(rig, controller):
    """One limit for both: compensation took 500 samples, the poles of its loop 400."""
    first, *others = rig.actuators
    late = replace(rig, actuators=(replace(first, delay=450 * DT), *others))
    assert loop_poles(late, controller).poles.size == 2 * rig.modes.n_modes + len(controller.A) + 450
    with pytest.raises(DesignError, match="501 samples, more than 500"):
        loop_poles(replace(rig, actuators=(replace(first, delay=501 * DT), *others)), controller)


def test_an_element_is_worth_the_spring_and_damper_that_it_is(rig, controller):
    touched = replace(rig, elements=(LinearSpring(0.9, 30.0), LinearDamper(1.4, 0.3)))
    found = modes_in_motion(touched, run_loop(touched, controller, LoopTest(600, DT, impulse_at=0.8)))
    expected = attach(rig.modes, (PointSpring(0.9, 30.0), PointDamper(1.4, 0.3)))
    assert found.omega == pytest.approx(expected.omega, rel=1e-3)
    assert found.damping == pytest.approx(expected.damping, abs=2e-3 * expected.damping.max())


def test_an_element_that_feeds_the_motion_takes_damping_away(rig, controller):
    fed = replace(rig, elements=(LinearSpring(0.9, -8.0), LinearDamper(0.9, -0.02)))
    silent = replace(controller, C=0.0 * controller.C, E=0.0 * controller.E)
    found = modes_in_motion(fed, run_loop(fed, silent, LoopTest(600, DT, impulse_at=0.8)))
    expected = attach(rig.modes, (PointSpring(0.9, -8.0), PointDamper(0.9, -0.02)))
    assert found.omega == pytest.approx(expected.omega, rel=1e-3)
    assert found.damping == pytest.approx(expected.damping, abs=2e-3 * expected.damping.max())


def test_a_cubic_spring_is_worth_what_harmonic_balance_says(rig, controller):
    """k_eq = 3/4 k a² at an amplitude a; least squares over a decay weighs it by a⁴ over a²."""
    one = replace(rig, modes=rig.modes.select([0]), elements=(CubicSpring(1.0, 400.0),))
    silent = replace(controller, C=0.0 * controller.C, E=0.0 * controller.E)
    run = run_loop(one, silent, LoopTest(4000, DT, impulse_at=1.0, impulse=0.2))
    motion = modes_in_motion(one, run)
    amplitude = 0.2 * one.modes.phi_at(1.0)[0] ** 2 / one.modes.omega[0]
    # amplitudes fade as e^{-ζωt}: the mean of a⁴ over that of a² is half the first a²
    expected = one.modes.omega[0] ** 2 + 0.75 * 400.0 * 0.5 * amplitude**2 * one.modes.phi_at(1.0)[0] ** 2
    assert motion.omega[0] ** 2 == pytest.approx(expected, rel=0.03)


def test_with_one_sensor_the_margin_is_that_of_the_complementary_sensitivity(rig):
    law = imsc(rig.modes, 1, rig.actuators[:1], weight=0.5)
    controller = sampled(kalman_controller(rig.modes, law, rig.sensors[:1], disturbance=1.0, noise=1e-2), DT)
    plant = control.c2d(state_space(rig.modes, rig.actuators[:1], rig.sensors[:1]), DT)
    loop = plant * controller.state_space()
    grid = np.linspace(2.0, 12.0, 4001)
    open_loop = loop(np.exp(1j * grid * DT))
    complementary = np.abs(open_loop / (1.0 - open_loop))
    margin, frequency = small_gain_margin(rig, controller)
    assert margin == pytest.approx(1.0 / complementary.max(), rel=1e-5)
    assert frequency == pytest.approx(grid[np.argmax(complementary)] / (2 * np.pi), rel=1e-2)


def test_errors_within_the_margin_leave_the_loop_stable(rig, controller):
    margin, _ = small_gain_margin(rig, controller)
    assert 0.02 < margin < 1.0
    for signs in product((-1.0, 1.0), repeat=len(rig.sensors)):
        off = tuple(replace(s, gain=1.0 + 0.999 * margin * g) for s, g in zip(rig.sensors, signs, strict=True))
        assert loop_poles(replace(rig, sensors=off), controller).spectral_radius < 1.0


def test_what_is_unstable_bears_nothing_and_no_feedback_bears_all(rig, controller):
    assert small_gain_margin(rig, replace(controller, C=-40.0 * controller.C))[0] == 0.0
    assert small_gain_margin(rig, replace(controller, C=0.0 * controller.C, B=0.0 * controller.B))[0] == np.inf


def test_a_mode_above_half_the_rate_has_its_own_damping(rig, controller):
    """Without control, sampled at nearly its frequency: the pole in the z plane is that of a slow motion too."""
    period = 2.0 * np.pi / (1.02 * rig.modes.omega[-1])
    silent = replace(controller, sample_time=period, C=0.0 * controller.C, E=0.0 * controller.E)
    assert loop_poles(rig, silent).damping == pytest.approx(rig.modes.zeta, rel=1e-6)
