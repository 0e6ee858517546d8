"""Modes with standard errors: intervals of a level that exists."""

import numpy as np
import pytest

from workbench.identification.free_decay.refinement import cramer_rao_bound
from workbench.identification.signal.synthesis import free_decay
from workbench.structure.modes import SampledModes

MODES = SampledModes([20.0, 50.0], [0.01, 0.02], [[1.0, 0.4], [0.6, -1.0]], [0.5, 1.5])


def test_an_interval_has_a_level_between_0_and_1():
    found = cramer_rao_bound(MODES, free_decay(MODES, sample_time=0.01, n_samples=300), noise_std=0.1)
    (low, high), _ = found.interval(0.6826894921370859)
    np.testing.assert_allclose((high - low) / 2, found.omega_std, rtol=1e-9)
    for level in (95, 1.0, -0.5, np.nan):
        with pytest.raises(ValueError, match="level of a confidence interval or band lies between 0 and 1; got"):
            found.interval(level)
