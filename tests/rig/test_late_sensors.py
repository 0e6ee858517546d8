"""A late sensor reads what a prompt one read before, between samples too."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.rig.actuators import Actuator
from workbench.rig.elements import CoulombFriction, CubicSpring
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate

FINE = 10


@pytest.fixture(scope="module")
def rig(hinged_beam):
    sensors = [Sensor(quantity, 0.7, quantity) for quantity in ("displacement", "velocity", "acceleration")]
    return Rig(hinged_beam.modes(4), [Actuator("F", 0.45)], sensors)


@pytest.mark.parametrize("elements", [(), (CubicSpring(1.1, 50.0),)], ids=["linear", "cubic"])
@pytest.mark.parametrize(
    "drive",
    [{}, {"delay": 0.35}, {"delay": 1.85}, {"time_constant": 0.4}, {"delay": 0.35, "time_constant": 0.4}],
    ids=lambda drive: " and ".join(drive) or "at once",
)
@pytest.mark.parametrize("share", [-0.4, 0.3, 0.5, 0.9, 1.4])
def test_a_late_sensor_reads_the_motion_between_samples(rig, elements, drive, share):
    """Truth: the same motion on a grid ten times as fine. The fourth mode has eight samples a period.

    Held inputs that a drive delays, or lags behind, are steps of the acceleration within a sample interval.
    """
    dt = 2 * np.pi / rig.modes.omega[3] / 8.0
    rng = np.random.default_rng(1)
    inputs = rng.standard_normal((1, 200))
    drive = {name: share * dt for name, share in drive.items()}
    rig = replace(rig, elements=elements, actuators=(replace(rig.actuators[0], **drive),))
    fine = simulate(rig, np.repeat(inputs, FINE, axis=1), sample_time=dt / FINE, substeps=8).outputs
    late = replace(rig, sensors=tuple(replace(s, delay=share * dt) for s in rig.sensors))
    read = simulate(late, inputs, sample_time=dt, substeps=80).outputs
    back = round(share * FINE)
    if back < 0:
        expected = np.array([y[-back::FINE] for y in fine])
    else:
        expected = np.array([np.r_[np.zeros(back), y][: y.size][::FINE] for y in fine])
    error = np.abs(read - expected)[:, 2:].max(axis=1) / np.abs(expected).max(axis=1)
    assert (error < (2e-3, 2e-3, 1e-2)).all(), error


@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("samples", [-3, 7])
def test_a_rate_limited_force_is_read_between_samples(rig, samples, hold):
    """Truth: the same motion on a grid ten times as fine; its ramps begin and end within the sample intervals."""
    dt = 2 * np.pi / rig.modes.omega[3] / 8.0
    inputs = np.random.default_rng(1).standard_normal((1, 200))
    rig = replace(rig, actuators=(replace(rig.actuators[0], rate_limit=1.7 / dt),))
    time = np.arange(inputs.size * FINE) / FINE
    often = inputs.repeat(FINE, axis=1) if hold == "zero" else np.interp(time, np.arange(inputs.size), inputs[0])[None]
    fine = simulate(rig, often, sample_time=dt / FINE, substeps=8, input_hold=hold).outputs
    late = replace(rig, sensors=tuple(replace(s, delay=samples * dt / FINE) for s in rig.sensors))
    read = simulate(late, inputs, sample_time=dt, substeps=80, input_hold=hold).outputs
    expected = np.roll(fine, samples, axis=1)[:, ::FINE]
    error = np.abs(read - expected)[:, 2:-1].max(axis=1) / np.abs(expected).max(axis=1)
    assert (error < 1e-3).all(), error


@pytest.mark.parametrize("samples", [-3, 2])
def test_a_late_accelerometer_reads_friction_that_turns_between_samples(rig, samples):
    """Where the friction acts, by friction that all but jumps: straight lines between its samples are 20 % off."""
    dt = 2 * np.pi / rig.modes.omega[3] / 8.0
    inputs = np.random.default_rng(1).standard_normal((1, 200))
    rig = replace(rig, elements=(CoulombFriction(0.7, 0.2, 1e-3),))
    fine = simulate(rig, inputs.repeat(FINE, axis=1), sample_time=dt / FINE, substeps=8).outputs[2]
    late = replace(rig, sensors=tuple(replace(s, delay=samples * dt / FINE) for s in rig.sensors))
    expected = np.roll(fine, samples)[::FINE][2:-1]
    for substeps, within in ((4, 0.05), (80, 1e-3)):
        read = simulate(late, inputs, sample_time=dt, substeps=substeps).outputs[2, 2:-1]
        assert (read - expected).std() < within * expected.std()


@pytest.mark.parametrize("share", [-1e-6, 1e-6])
def test_a_sensor_hardly_late_reads_what_a_prompt_one_does(rig, share):
    """Beside friction that turns within the sample; before it, the force of an actuator held at the last sample."""
    inputs = np.random.default_rng(2).standard_normal((1, 200)).repeat(4, axis=1)
    rubbing = replace(rig, elements=(CoulombFriction(0.7, 0.2, 1e-3),))
    late = replace(rubbing, sensors=tuple(replace(s, delay=share * 0.002) for s in rig.sensors))
    read, prompt = (simulate(r, inputs, sample_time=0.002).outputs for r in (late, rubbing))
    error = np.abs(read - prompt)
    if share > 0:
        error[2, ::4] = 0.0  # held inputs jump there
    assert (error.max(axis=1) < 1e-4 * np.abs(prompt).max(axis=1)).all()


def test_a_sensor_late_by_whole_samples_is_shifted(rig):
    inputs = np.random.default_rng(2).standard_normal((1, 100))
    late = replace(rig, sensors=tuple(replace(s, delay=0.02) for s in rig.sensors))
    read, prompt = (simulate(r, inputs, sample_time=0.01).outputs for r in (late, rig))
    np.testing.assert_allclose(read[:, 2:], prompt[:, :-2], atol=1e-12 * np.abs(prompt).max())


@pytest.mark.parametrize("share", [-0.4, 0.3, 2.6])
def test_a_logger_s_channel_is_late_by_straight_lines_between_its_samples(rig, share):
    """Truth: a weighted sum of the two samples about the time that is read."""
    dt = 2 * np.pi / rig.modes.omega[3] / 8.0
    inputs = np.random.default_rng(1).standard_normal((1, 200))
    prompt = simulate(rig, inputs, sample_time=dt).outputs
    logged = replace(rig, sensors=tuple(replace(s, delay=share * dt, interpolated=True) for s in rig.sensors))
    back = int(np.ceil(share))
    within = back - share  # of a sample, after the earlier of the two
    at = np.arange(back + 1, inputs.size - 2)
    expected = (1.0 - within) * prompt[:, at - back] + within * prompt[:, at - back + 1]
    np.testing.assert_allclose(simulate(logged, inputs, sample_time=dt).outputs[:, at], expected, rtol=1e-9, atol=1e-12)
