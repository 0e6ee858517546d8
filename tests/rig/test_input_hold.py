"""Inputs that run straight from sample to sample, against python-control and very fine steps."""

from dataclasses import replace

import control
import numpy as np
import pytest

from workbench.records.band_limited import finer
from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.elements import CubicSpring
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import BAND_STEPS, prediction_errors, simulate
from workbench.rig.statespace import state_space
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes

DT, SAMPLES, FINE = 0.04, 120, 400
TIME = DT * np.arange(SAMPLES)


def rig(*, damping=(0.02, 0.01, 0.03), omega=(0.0, 9.0, 31.0), elements=(), **actuator):
    """Five samples a period of the fastest mode, the slowest rigid."""
    shapes = PointShapes(np.array([[1.0, 0.7, -0.4], [0.8, -1.1, 0.9]]))
    modes = Modes(omega=omega, damping=np.diag([0.3, *2 * np.array(damping[1:]) * omega[1:]]), shapes=shapes,
                  domain=NamedPoints(("F", "y")))  # fmt: skip
    sensors = tuple(Sensor(q, "y", q) for q in ("displacement", "velocity", "acceleration"))
    return Rig(modes, (Actuator("F", "F", **actuator),), sensors, elements)


def command(seed=1):
    return np.random.default_rng(seed).normal(size=(1, SAMPLES))


def on_fine_steps(rig, u, force):
    """Held over steps so fine that it is all but straight; `force` is what the actuator makes of it there."""
    fine = np.arange(SAMPLES * FINE) * DT / FINE + 0.5 * DT / FINE
    straight = np.interp(fine, TIME, u[0])
    bare = replace(rig, actuators=(Actuator("F", "F"),))
    return simulate(bare, force(straight)[None], sample_time=DT / FINE, substeps=1).outputs[:, ::FINE]


def test_it_is_python_controls_first_order_hold():
    model, u = rig(), command()
    system = state_space(model.modes, model.actuators, model.sensors)
    expected = control.forced_response(system, TIME, u).outputs
    np.testing.assert_allclose(simulate(model, u, sample_time=DT, input_hold="first").outputs, expected, atol=1e-10)
    held = simulate(model, u, sample_time=DT).outputs
    assert np.abs(held - expected).std() > 0.05 * expected.std()


@pytest.mark.parametrize("delay", [0.0, 2 * DT, 1.3 * DT])
@pytest.mark.parametrize("lag", [0.0, 0.05])
def test_delay_and_lag_act_on_the_straight_input(delay, lag):
    u, h = command(), DT / FINE

    def force(straight):
        late = np.r_[np.zeros(round(delay / h)), straight][: straight.size]
        if lag == 0:
            return late
        lagged, fade = np.zeros_like(late), np.exp(-h / lag)
        for k in range(1, late.size):
            lagged[k] = fade * lagged[k - 1] + (1 - fade) * late[k - 1]
        return lagged

    model = rig(delay=delay, time_constant=lag)
    found = simulate(model, u, sample_time=DT, input_hold="first").outputs
    expected = on_fine_steps(model, u, force)
    np.testing.assert_allclose(found[:2], expected[:2], atol=2e-3 * np.abs(expected[:2]).max())


@pytest.mark.parametrize("late", [0.0, 0.25, 1.5, -0.75])
def test_band_limited_inputs_are_a_first_order_hold_of_many_steps(late):
    """Of the inputs interpolated by Fourier series; also for readings between the samples, with a constant force."""
    u = np.array(command())
    u.setflags(write=False)
    steps = round(late * BAND_STEPS)
    model = rig(bias=0.3)
    fine = finer(u, BAND_STEPS) + 0.3
    instants = DT / BAND_STEPS * np.arange(fine.shape[1])
    system = state_space(model.modes, rig().actuators, model.sensors)
    whole = control.forced_response(system, instants, fine).outputs
    at = BAND_STEPS * np.arange(SAMPLES) - steps
    inside = (at >= 0) & (at < fine.shape[1])
    expected = whole[2, at[inside]]
    sensors = tuple(replace(s, delay=late * DT) if s.name == "acceleration" else s for s in model.sensors)
    found = simulate(replace(model, sensors=sensors), u, sample_time=DT, input_hold="band-limited").outputs
    np.testing.assert_allclose(found[2, inside], expected, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose(found[:2], whole[:2, ::BAND_STEPS], atol=1e-8 * np.abs(whole).max())


SLOW = {"delay": 1.3 * DT, "time_constant": 0.05, "bias": 0.2}


@pytest.mark.parametrize(("transducers", "within"), [({}, 1e-9), (SLOW, 2e-2), ({"rate_limit": 30.0}, 6e-2)])
def test_steps_follow_the_closed_form_and_converge(transducers, within):
    u, spring = command(), (CubicSpring("y", 1e-12),)  # so weak that only the way to the result differs
    found = [
        simulate(rig(elements=spring, **transducers), u, sample_time=DT, input_hold="first", substeps=n).outputs
        for n in (4, 8, 64)
    ]
    exact = (
        found[-1]
        if "rate_limit" in transducers
        else simulate(rig(**transducers), u, sample_time=DT, input_hold="first").outputs
    )
    error = [np.abs(each[:2] - exact[:2]).max() / np.abs(exact[:2]).max() for each in found]
    assert error[0] < within and error[1] <= max(0.5 * error[0], 1e-9)


def test_a_filter_predicts_its_own_motion():
    model, u = rig(), command()
    outputs = simulate(model, u, sample_time=DT, input_hold="first").outputs
    gain = np.zeros((2, 3, 3))
    gain[0, :, 0] = gain[1, :, 1] = 0.05 * model.modes.phi_at("y")  # stable: pulled towards what is measured
    errors = prediction_errors(model, u, outputs, gain, sample_time=DT, substeps=1, input_hold="first")
    assert np.abs(errors).max() < 1e-9 * np.abs(outputs).max()


def test_a_record_says_how_its_inputs_run():
    record = Record(DT, np.zeros((1, 9)), (Channel("y"),), np.ones((1, 9)), (Channel("u"),), input_hold="first")
    assert record.between(0.1).input_hold == record.select_outputs(["y"]).input_hold == "first"
    with pytest.raises(ValueError, match=r"zero \(held\), first"):
        replace(record, input_hold="second")
