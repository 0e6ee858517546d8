import numpy as np
import pytest

from workbench.identification.free_decay.assumptions import proportional_fit
from workbench.identification.free_decay.ibrahim import stacked_delays
from workbench.identification.free_decay.refinement import refine
from workbench.identification.signal.synthesis import free_decay
from workbench.structure.modes import SampledModes

OMEGA = np.array([4.0, 9.0, 15.0, 26.0])
G1, G2 = 0.002, 0.1


def identified(zeta):
    shapes = np.random.default_rng(0).standard_normal((5, 4))
    truth = SampledModes(OMEGA, zeta, shapes, np.linspace(0, 1, 5))
    record = free_decay(truth, sample_time=0.05, n_samples=600, noise_std=0.02, seed=1)
    return refine(record, stacked_delays(record, n_modes=4, delays=60))


def test_constants_found_within_their_errors():
    fit = proportional_fit(identified(0.5 * (G1 * OMEGA + G2 / OMEGA)))
    error = np.array([fit.damping.stiffness - G1, fit.damping.mass - G2])
    assert (np.abs(error) < 3.5 * fit.standard_errors).all()
    assert (fit.standard_errors < [0.1 * G1, 0.1 * G2]).all()
    assert fit.probability > 0.01


def test_other_damping_is_recognised():
    fit = proportional_fit(identified(np.array([0.01, 0.03, 0.005, 0.02])))
    assert fit.probability < 1e-6
    assert np.abs(fit.standardised_residuals).max() > 10


def test_one_mode_is_not_enough():
    truth = SampledModes([4.0], [0.01], [[1.0], [0.5]], [0.0, 1.0])
    record = free_decay(truth, sample_time=0.1, n_samples=100, noise_std=0.01)
    with pytest.raises(ValueError, match="at least two modes"):
        proportional_fit(refine(record, truth))
