"""A random disturbance follows nothing that the rig does; a force that pulls harder the nearer it is does."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, lfilter, lsim

from workbench.gap.prediction.random_force import (
    MAX_TONAL_SHARE,
    _power,
    fit_random_force,
    followed,
    lost_between_samples,
    tonal,
)
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import colour_of
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor

N = 2000


@pytest.fixture(scope="module")
def record():
    """Inputs, and a lightly damped motion (displacement, velocity) that they cause."""
    inputs = np.random.default_rng(0).normal(size=(2, N))
    pole = 0.998 * np.exp(0.2j)
    w = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], inputs.sum(axis=0))
    return inputs, np.array([w, np.gradient(w)]) / w.std()


@pytest.mark.parametrize("memory", [0.0, 0.9, 0.99])
def test_a_constant_and_a_tone_can_be_predicted_and_a_random_force_cannot(memory):
    force = lfilter([1.0], [1.0, -memory], np.random.default_rng(2).normal(size=N))
    wave = np.sin(0.3 * np.arange(N) + 0.4)
    assert tonal(force, 0.01) < MAX_TONAL_SHARE
    assert tonal(1e-3 * force / force.std() - 1.0, 0.01) == pytest.approx(1.0, abs=1e-5)
    assert tonal(wave + 2.0, 0.01) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("cycles", [0.05, 0.2, 0.3])
def test_a_held_force_does_less_than_a_continuous_one(cycles):
    fine, n = 40, 800
    time = np.arange(n * fine) / fine  # samples
    wave = np.sin(2.0 * np.pi * cycles * time)
    held = np.repeat(wave[::fine], fine)
    oscillator = ([1.0], [1.0, 0.05, (2.0 * np.pi * cycles) ** 2])
    powers = [np.mean(lsim(oscillator, force, time)[1][n * fine // 2 :] ** 2) for force in (held, wave)]
    assert 1.0 - lost_between_samples([wave[::fine]]) == pytest.approx(powers[0] / powers[1], rel=0.01)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("memory", [0.5, 0.99, 0.9995])
def test_the_power_of_a_force_of_equal_poles_is_its_closed_form(memory):
    """Σ C(k + n - 1, n - 1)² x^k, x = memory², over which a linear solution loses all digits near 1."""
    x = memory**2
    numerators = ([1.0], [1.0, 1.0], [1.0, 4.0, 1.0], [1.0, 9.0, 9.0, 1.0])
    for stages, numerator in enumerate(numerators, start=1):
        exact = np.polyval(numerator, x) / (1.0 - x) ** (2 * stages - 1)
        assert _power(colour_of(memory, stages)) == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize("memory", [0.0, 0.9, 0.99])
def test_what_follows_nothing(record, memory):
    force = lfilter([1.0], [1.0, -memory], np.random.default_rng(1).normal(size=N))
    assert followed(force, *record) < 0.1


@pytest.mark.parametrize("law", [lambda w, v: 1.0 / (6.0 - w) ** 2, lambda w, v: -v * np.abs(v), lambda w, v: w**3])
def test_what_follows_the_motion(record, law):
    inputs, motion = record
    force = law(*np.clip(motion, -4.0, 4.0))
    noise = 0.5 * force.std() * np.random.default_rng(2).normal(size=N)
    assert followed(force + noise, inputs, motion) > 0.5


def test_what_follows_the_inputs_without_delay(record):
    inputs, motion = record
    assert followed(inputs[0] + 0.1 * motion[0], inputs, np.zeros_like(motion)) > 0.5


@pytest.mark.parametrize("stages", [1, 2, 3])
@pytest.mark.parametrize("memory", [0.0, 0.6, 0.95])
def test_power_of_a_colour(stages, memory):
    impulse = lfilter([1.0], np.poly([memory] * stages), np.eye(1, N)[0])
    assert _power(colour_of(memory, stages)) == pytest.approx((impulse**2).sum(), rel=1e-9)


@pytest.mark.parametrize("stages", [1, 2, 3, 4])
@pytest.mark.parametrize("memory", [0.5, 0.9])
def test_a_flat_colour_has_the_poles_of_a_butterworth_filter(stages, memory):
    poles = np.exp(butter(stages, -np.log(memory), analog=True, output="zpk")[1])
    colour = colour_of(memory, stages, flat=True)
    found = np.linalg.eigvals(colour)
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(poles), abs=1e-9)
    impulse = lfilter([1.0], np.poly(poles), np.eye(1, N)[0])
    assert _power(colour) == pytest.approx((impulse**2).sum(), rel=1e-9)


@pytest.mark.parametrize("start", [1.97, 2.0])
def test_a_random_force_at_a_free_tip_is_fitted_from_the_tip_too(hinged_beam, record_of, start):
    beam, rng = replace(hinged_beam, left="clamped", right="free"), np.random.default_rng(5)
    sensors = tuple(Sensor(f"d{x}", x, noise_std=1e-5) for x in (0.7, 1.6))
    rig = Rig(beam.modes(2), (Actuator("F", 0.45),), sensors, structure=beam)
    real = replace(rig, actuators=(*rig.actuators, Actuator("hidden", 2.0)))
    inputs = np.array([[1.0], [0.2]]) * rng.normal(size=(2, 1000))
    both = record_of(real, inputs, rng, name="both")
    record = replace(both, inputs=inputs[:1], input_channels=both.input_channels[:1])
    data = FitData((record,), np.full(2, 1e-5))
    found = fit_random_force(rig, data, data.differences(rig), [start], 1.0)
    assert found.rms == pytest.approx(0.2, rel=0.15) and found.at == pytest.approx(2.0, abs=0.01)
    assert 0.0 < found.at_std[0] < 0.01
