"""The period of an excitation: known by construction, or none."""

import numpy as np
import pytest

from workbench.identification.signal.periodicity import period_of

RNG = np.random.default_rng(3)


@pytest.mark.parametrize("period", [50, 137, 512])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_repeated_sequence_has_its_period(period, noise):
    one = np.cumsum(RNG.normal(size=(2, period)), axis=1)
    inputs = np.tile(one - one.mean(axis=1, keepdims=True), 4)[:, : round(3.4 * period)]
    assert abs(period_of(inputs + noise * inputs.std() * RNG.normal(size=inputs.shape)) - period) <= 1


def test_noise_a_drift_rest_and_one_period_have_none():
    assert period_of(RNG.normal(size=(1, 4000))) is None
    assert period_of(np.linspace(0.0, 1.0, 500)[None]) is None
    assert period_of(np.zeros((2, 300))) is None
    assert period_of(np.tile(RNG.normal(size=(1, 300)), 2)[:, :450]) is None
