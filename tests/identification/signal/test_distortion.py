"""Distortion of static laws under multisines: known in closed form by their products of lines."""

import numpy as np
import pytest

from workbench.identification.signal.distortion import distortion_of, period_of
from workbench.records.record import Channel, Record

PERIOD, PERIODS, NOISE = 400, 6, 1e-3
RNG = np.random.default_rng(3)


def record(law, lines, noise=NOISE):
    rng = np.random.default_rng(5)
    t = 2 * np.pi * np.arange(PERIOD) / PERIOD
    u = np.tile(sum(np.cos(k * t + 2 * np.pi * rng.random()) for k in lines), PERIODS)
    y = law(u) + noise * rng.normal(size=u.size)
    return Record(0.01, y[None], (Channel("y"),), u[None], (Channel("u"),), name="multisine")


def test_an_odd_law_shows_on_odd_lines_and_an_even_law_on_even_ones():
    lines = (3, 7, 9, 15)
    for law, loud, quiet in ((lambda u: u + 0.1 * u**3, "odd", "even"), (lambda u: u + 0.1 * u**2, "even", "odd")):
        found = distortion_of(record(law, lines))
        assert found.parity_resolved and list(np.flatnonzero(found.excited) + 1) == list(lines)
        assert found.rms[loud][0] > 0.1 and found.rms[quiet][0] < 3 * NOISE
    linear = distortion_of(record(lambda u: u, lines)).rms
    assert linear["excited"][0] == pytest.approx(np.sqrt(len(lines) / 2), rel=1e-3)
    assert max(linear["odd"][0], linear["even"][0]) < 3 * NOISE


def test_the_power_on_even_lines_is_that_of_the_square():
    found = distortion_of(record(lambda u: u + 0.1 * u**2, (5,), noise=0.0))
    assert found.rms["even"][0] == pytest.approx(0.1 * 0.5 / np.sqrt(2), rel=1e-9)  # 0.1 cos² = 0.05 (1 + cos 2x)
    assert found.amplitudes[0, 1] == pytest.approx(0.05 / np.sqrt(2), rel=1e-9)


def test_noise_is_found_and_what_does_not_repeat_is_refused():
    found = distortion_of(record(lambda u: u, (3, 8)))
    assert found.rms["noise"][0] == pytest.approx(NOISE, rel=0.1) and not found.parity_resolved
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(1, 500))
    with pytest.raises(ValueError, match="do not repeat"):
        distortion_of(Record(0.01, noise, (Channel("y"),), noise, (Channel("u"),)))


@pytest.mark.parametrize("period", [50, 137, 512])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_repeated_sequence_has_its_period(period, noise):
    one = np.cumsum(RNG.normal(size=(2, period)), axis=1)
    inputs = np.tile(one - one.mean(axis=1, keepdims=True), 4)[:, : round(3.4 * period)]
    assert abs(period_of(inputs + noise * inputs.std() * RNG.normal(size=inputs.shape)) - period) <= 1


def test_a_sequence_about_a_constant_has_its_period():
    """A preload of a shaker, or a pulse train, beside an input that is at rest."""
    one = np.cos(2 * np.pi * np.arange(100) * 3 / 100) + np.cos(2 * np.pi * np.arange(100) * 7 / 100)
    assert period_of(np.stack([np.tile(one, 4) + 5.0, np.full(400, 7.0)])) == 100
    assert period_of(np.tile(one > 1.0, 4)[None]) == 100
    assert period_of(np.tile(one, 2)[None]) == 100


def test_a_sine_of_less_than_two_periods_has_none():
    assert period_of(np.sin(2 * np.pi * np.arange(400) / 205)[None]) is None


def test_noise_a_drift_rest_and_one_period_have_none():
    assert period_of(np.full((1, 300), 0.1)) is None
    assert period_of(RNG.normal(size=(1, 4000))) is None
    assert period_of(np.linspace(0.0, 1.0, 500)[None]) is None
    assert period_of(np.zeros((2, 300))) is None
    assert period_of(np.tile(RNG.normal(size=(1, 300)), 2)[:, :450]) is None
