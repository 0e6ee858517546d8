"""Noise of the logged inputs: how loud it is, and what makes it white."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import toeplitz

from workbench.gap.prediction.noise import (
    LOGGED,
    input_filters,
    likeliest_share,
    logging_noise_power,
    loudest_logging_noise,
    noise_of_inputs,
    shows_input_noise,
)
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import log_likelihood, whiten
from workbench.rig.actuators import Actuator
from workbench.rig.elements import CubicSpring
from workbench.rig.rig import shape_of
from workbench.rig.simulate import simulate, simulate_record

NOISE = 1e-5
SHARE = 0.005


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig(n_modes=3, actuators=(Actuator("F", 0.45), Actuator("G", 1.3)))


@pytest.fixture(scope="module")
def logged(rig, record_of):
    """Records of two levels whose inputs were logged with noise, the second input at rest in one of them."""
    rng, records = np.random.default_rng(3), []
    for name, level, at_rest in (("low", 0.2, True), ("high", 1.0, False)):
        sent = level * np.repeat(rng.normal(size=(2, 400)), 5, axis=1)
        sent[1] *= not at_rest
        record = record_of(rig, sent, rng, name=name)
        rms = sent.std(axis=1, keepdims=True)
        records.append(replace(record, inputs=sent + SHARE * rms * rng.normal(size=sent.shape)))
    return FitData(tuple(records), np.full(4, NOISE))


def test_how_loud_it_is(rig, logged):
    assert likeliest_share(rig, logged, logged.differences(rig)).share == pytest.approx(SHARE, rel=0.05)


def test_none_is_told_from_some(rig, record_of):
    rng = np.random.default_rng(4)
    quiet = FitData((record_of(rig, rng.normal(size=(2, 1000)), rng, name="quiet"),), np.full(4, NOISE))
    assert likeliest_share(rig, quiet, quiet.differences(rig)).share < 0.1 * LOGGED.max_share


def test_records_show_it_under_sensor_noise_of_five_times_its_response(rig, logged, record_of):
    """It adds 4 % to the mean square, but all of that at the modes."""
    rng = np.random.default_rng(7)
    for data, is_there in ((logged, True), (FitData(tuple(_quiet(rig, logged, rng, record_of)), logged.noise), False)):
        loud = 5.0 * np.sqrt((np.concatenate(logged.differences(rig), axis=1) ** 2).mean(axis=1))
        noisy = [replace(r, outputs=r.outputs + loud[:, None] * rng.normal(size=r.outputs.shape)) for r in data.records]
        under = FitData(tuple(noisy), loud)
        cost = (under.residual(rig) ** 2).mean()
        assert 0.97 < cost < 1.08
        assert shows_input_noise(rig, under, under.differences(rig), SHARE) == is_there


def _quiet(rig, logged, rng, record_of):
    return [record_of(rig, record.inputs, rng, name=record.name) for record in logged.records]


def test_a_law_of_the_structure_is_no_such_noise(rig, logged, record_of):
    """It leaves more than any logger's noise would, in most records; that noise itself does not."""
    stiffened = replace(rig, elements=(CubicSpring(1.0, 2e9),))
    rng, hold = np.random.default_rng(6), np.ones(5)
    levels = {"low": 0.3, "high": 1.0}
    sent = {name: level * np.kron(rng.normal(size=(2, 400)), hold) for name, level in levels.items()}
    records = tuple(record_of(stiffened, inputs, rng, name=name) for name, inputs in sent.items())
    hidden = FitData(records, np.full(4, NOISE))
    assert likeliest_share(rig, hidden, hidden.differences(rig)).is_beyond
    assert not likeliest_share(rig, logged, logged.differences(rig)).is_beyond


def test_its_power_is_that_of_draws(rig, logged):
    """Of 200 draws of a record; the loudest of twelve is louder than their mean."""
    rng = np.random.default_rng(5)
    expected, loudest = logging_noise_power(rig, logged), loudest_logging_noise(rig, logged)
    for i, record in enumerate(logged.counted):
        answers = (simulate_record(rig, replace(record, inputs=noise_of_inputs(record, rng))) for _ in range(200))
        powers = np.array([((answer / NOISE) ** 2).mean(axis=1) for answer in answers])
        error = powers.std(axis=0) / np.sqrt(len(powers))
        assert (np.abs(powers.mean(axis=0) - expected[i]) < 4.0 * error).all() and (error < 0.1 * expected[i]).all()
        assert loudest[i].mean() > expected[i].mean()


def test_what_it_leaves_is_white_through_the_filter(rig, logged):
    filters = input_filters(rig, logged, SHARE)
    plain = [(r / NOISE) ** 2 for r in logged.differences(rig)]
    assert np.mean(plain[1]) > 100.0
    for record, left in zip(logged.records, logged.differences(rig), strict=True):
        white = whiten(filters[record.name], left)
        assert np.mean(white**2) == pytest.approx(1.0, abs=0.06)
        later = np.mean(white[:, 1:] * white[:, :-1], axis=1)
        assert np.abs(later).max() < 5.0 / np.sqrt(white.shape[1])
        between = np.cov(white) - np.eye(4)
        assert np.abs(between).max() < 5.0 / np.sqrt(white.shape[1])


def test_the_likelihood_is_that_of_the_whole_covariance(rig, logged):
    """Beside the Gaussian density with the covariance written out from the impulse responses."""
    n = 250
    record = logged.records[1].between(0.0, (n - 1) * 0.01)
    left = logged.differences(rig)[1][:, :n]
    covariance = NOISE**2 * np.eye(4 * n)
    for i, rms in enumerate(np.sqrt((logged.records[1].inputs ** 2).mean(axis=1))):
        impulse = np.zeros((2, n))
        impulse[i, 0] = 1.0
        response = simulate(rig, impulse, sample_time=record.sample_time).outputs
        rows = np.vstack([toeplitz(row, np.zeros(n)) for row in response])
        covariance += (SHARE * rms) ** 2 * rows @ rows.T
    stacked = left.ravel()
    dense = -0.5 * (stacked @ np.linalg.solve(covariance, stacked) + np.linalg.slogdet(covariance)[1])
    filters = input_filters(rig, logged, SHARE)
    # the filter starts from its steady state, the record from rest
    assert log_likelihood(filters["high"], [left]) == pytest.approx(dense, rel=2e-3)


def test_input_noise_of_a_channel_acts_through_its_cross_talk(rig, logged):
    """As if the actuator that it leaks from acted at both places: its shape is the sum."""
    first, second = rig.actuators
    shape = shape_of(rig.modes, first)
    leaking = replace(rig, actuators=(replace(first, crosstalk=((second.name, 0.3),)), second))
    by_shape = replace(rig, actuators=(first, replace(second, shape_error=tuple(0.3 * shape))))
    mine, peer, without = (input_filters(r, logged, SHARE)["high"] for r in (leaking, by_shape, rig))
    np.testing.assert_allclose(mine.innovation, peer.innovation, rtol=1e-9)
    assert np.abs(mine.innovation - without.innovation).max() > 1e-3 * np.abs(without.innovation).max()
