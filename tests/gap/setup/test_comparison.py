"""Misfit of signals by band, against closed forms."""

from types import SimpleNamespace

import numpy as np
import pytest

from workbench.gap.setup.comparison import MAX_LOG_RATIO, Spectra, band_misfit, compared_bands

F = np.array([2.0, 6.0, 11.0])  # Hz: bands end at 4 and 8.5
T = np.arange(4000) * 0.01


def read(*signals):
    return Spectra.of_signals([np.array(signals)], [SimpleNamespace(sample_time=0.01)], F)


def tone(frequency, phase=0.0):
    """A sine that no leakage takes from its band."""
    return np.sin(2.0 * np.pi * frequency * T + phase)


def test_a_factor_is_its_logarithm_and_a_turned_sign_two():
    rng = np.random.default_rng(4)
    y = rng.standard_normal(T.size)
    assert band_misfit(read(y), read(y)) == pytest.approx(np.zeros((1, 1, 3)), abs=1e-9)
    assert band_misfit(read(5.0 * y), read(y)) == pytest.approx(np.full((1, 1, 3), np.log(5.0)))
    assert band_misfit(read(-y), read(y)) == pytest.approx(np.full((1, 1, 3), 2.0))
    assert band_misfit(read(-5.0 * y), read(y), -5.0) == pytest.approx(np.zeros((1, 1, 3)), abs=1e-9)
    assert band_misfit(read(1e6 * y), read(y)) == pytest.approx(np.full((1, 1, 3), MAX_LOG_RATIO))


def test_a_phase_is_one_less_its_cosine_in_its_own_band():
    measured, predicted = tone(2.0) + tone(6.0, 1.0), tone(2.0) + tone(6.0)
    misfit = band_misfit(read(measured), read(predicted))
    assert misfit[0, 0, :2] == pytest.approx([0.0, 1.0 - np.cos(1.0)], abs=2e-3)


def test_bands_with_little_of_a_signal_are_not_compared():
    assert compared_bands(read(tone(2.0) + 0.2 * tone(6.0) + 0.02 * tone(11.0))).tolist() == [[[True, True, False]]]


def test_a_prediction_of_nothing_or_beyond_all_numbers_is_like_nothing():
    y = tone(2.0)
    assert (band_misfit(read(y), read(0.0 * y)) >= MAX_LOG_RATIO).all()
    assert (band_misfit(read(y), read(1e200 * y)) >= MAX_LOG_RATIO).all()
