"""Inputs as behind an anti-alias filter. Truth: sums of sinusoids, whose steady response is in closed form."""

import numpy as np
import pytest

from workbench.identification.driven import identify_driven
from workbench.identification.rig_from import rig_from
from workbench.records.band_limited import finer, later
from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.elements import CubicSpring
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes

RATE, N = 512.0, 2048
F, ZETA = np.array([67.0, 127.0, 185.0]), np.array([0.01, 0.008, 0.012])  # to 0.36 of the sample rate
SHAPES = np.array([[0.8, 1.1, 0.6], [1.0, -0.3, -0.9], [0.5, -0.9, 0.7]])
MODES = Modes(2 * np.pi * F, ZETA, PointShapes(SHAPES), NamedPoints(("a", "b", "c")))


def driven(hold="band-limited", delay=0.0, highest=0.42, fraction=0.01, seed=0, n=N):
    """Accelerations under a steady multisine that ends, as behind a filter, below half of the sample rate."""
    rng = np.random.default_rng(seed)
    f = np.fft.rfftfreq(n, 1 / RATE)
    force = np.where((f > 2.0) & (f < highest * RATE), np.exp(2j * np.pi * rng.random(f.size)), 0.0) * n
    s, omega = 2j * np.pi * f, 2 * np.pi * F[:, None]
    modal = s**2 / (s**2 + 2 * ZETA[:, None] * omega * s + omega**2) * np.exp(-s * delay)
    y = np.fft.irfft(SHAPES @ (SHAPES[0][:, None] * modal * force), n)
    y += fraction * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    outputs = tuple(Channel(f"y{j}", "acceleration") for j in range(3))
    return Record(1 / RATE, y, outputs, np.fft.irfft(force, n), (Channel("f", "force"),), input_hold=hold)


@pytest.mark.parametrize("delay", [0.0, 5.3])
def test_masses_and_delays_of_a_band_limited_force_are_right(delay):
    found = identify_driven(driven(delay=delay / RATE))
    assert not [remark for remark in found.remarks if "late" not in remark]
    assert np.allclose(found.delays * RATE, delay, atol=0.01)
    assert np.allclose(found.modes.frequencies_hz, F, rtol=1e-4)
    masses = rig_from(found, driving_point=("f", "y0")).modes.phi(np.array(["y0"]))[0] ** 2 / SHAPES[0] ** 2
    assert np.allclose(masses, 1.0, atol=0.005)


def test_the_response_of_the_model_is_that_of_the_records():
    record = driven()
    found = identify_driven(record)
    left = record.outputs - found.response(record.inputs, record=0)
    assert (left.std(axis=1) < 0.0115 * record.outputs.std(axis=1)).all()


def test_inputs_taken_for_held_are_remarked():
    remarks = identify_driven(driven("zero")).remarks
    assert any("give input_hold='band-limited'" in remark for remark in remarks)


def test_straight_inputs_taken_for_band_limited_are_remarked():
    rig = Rig(MODES, (Actuator("f", "a"),), tuple(Sensor(f"y{p}", p, "acceleration") for p in "abc"))
    noise = np.random.default_rng(1).standard_normal((1, 1000))
    record = simulate(rig, noise, sample_time=1 / RATE, input_hold="first")
    y = record.outputs + 0.01 * record.outputs.std() * np.random.default_rng(2).standard_normal(record.outputs.shape)
    straight = Record(1 / RATE, y, record.output_channels, noise, record.input_channels, input_hold="first")
    assert not [remark for remark in identify_driven(straight).remarks if "input_hold" in remark]
    remarks = identify_driven(straight, input_hold="band-limited", max_modes=6).remarks
    assert any("give input_hold='first'" in remark for remark in remarks)


def test_interpolation_is_that_of_sinusoids():
    k, t = np.arange(400), np.arange(1600) / 4

    def signal(time):
        return np.sin(0.8 * time) + np.cos(2.3 * time + 0.4)

    inside = slice(200, -200)
    assert np.abs(finer(signal(k)[None], 4)[0] - signal(t))[inside].max() < 5e-3
    assert np.allclose(finer(signal(k)[None], 4)[0, ::4], signal(k))
    assert np.abs(later(signal(k)[None], np.array([1.3]))[0] - signal(k - 1.3))[50:-50].max() < 5e-3


@pytest.mark.parametrize("elements", [(), (CubicSpring("a", 1e-9),)])
def test_a_rig_moves_as_the_sum_of_sinusoids(elements):
    """So weak a spring leaves only the steps; 64 of them are as exact as the closed form."""
    record = driven(fraction=0.0, n=4096)
    rig = Rig(MODES, (Actuator("f", "a"),), tuple(Sensor(f"y{p}", p, "acceleration") for p in "abc"), elements)
    found = simulate(rig, record.inputs, sample_time=1 / RATE, input_hold="band-limited", substeps=64).outputs
    steady = slice(2000, -100)  # what the start from rest leaves has decayed
    error = (found - record.outputs)[:, steady]
    assert error.std() < 2e-3 * record.outputs.std()


def test_no_more_modes_than_asked_for():
    assert identify_driven(driven(), max_modes=2).modes.n_modes == 2
