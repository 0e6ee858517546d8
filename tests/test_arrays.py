"""Inverses of normal equations: variances are none below zero, whatever rounding does."""

import numpy as np
import pytest

from workbench.arrays import scaled_inverse


@pytest.mark.parametrize("seed", range(10))
def test_variances_of_collinear_unknowns_are_not_negative(seed):
    """The last are sums of others, and normal equations a difference: what it leaves of theirs has either sign."""
    rng = np.random.default_rng(seed)
    slopes = rng.standard_normal((50, 8))
    slopes = np.hstack([slopes, slopes @ rng.standard_normal((8, 4))])
    large = 1e3 * slopes.T @ slopes
    found = scaled_inverse((large + slopes.T @ slopes) - large)
    assert (np.diag(found) >= 0.0).all()
    assert (np.linalg.eigvalsh(found) > -1e-9 * np.abs(found).max()).all()


def test_of_unknowns_that_are_told_apart_it_is_the_inverse():
    slopes = np.random.default_rng(0).standard_normal((50, 8)) * 10.0 ** np.arange(-4, 4)
    normal = slopes.T @ slopes
    np.testing.assert_allclose(scaled_inverse(normal) @ normal, np.eye(8), atol=1e-6)
