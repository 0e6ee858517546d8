import numpy as np
import pytest

from workbench.identification.input_output.changing_response import _simulated


@pytest.mark.parametrize("many", [1, 40])
def test_an_undriven_mode_moves_as_its_frequency_goes_evenly_with_time(many):
    """λ + a + b s, s from (0 - m)/w to (1 - m)/w over the record: e to its integral over time."""
    n, dt, middle, width = 4001, 1e-3, 0.2, 0.3
    pole, a, b = -1.0 + 100.0j, 0.2 - 0.5j, -0.1 + 2.0j
    start, drive = np.array([2.0 + 0.0j]), np.zeros((n - 1, 1), complex)
    law = np.array([[a, b]]), np.array([1.0]), True, np.exp(pole * dt)
    z = _simulated(start, drive, *law, 2.0, 1e-3, 1e3, dt, middle, width, 16.0, 0, many)[:, 0]
    share = np.linspace(0.0, 1.0, n)
    along = share * (n - 1) * dt
    exact = 2.0 * np.exp((pole + a) * along + b * along * (0.5 * share - middle) / width)
    np.testing.assert_allclose(z, exact, rtol=1e-9)


def test_what_drives_a_mode_at_first_is_followed_sample_by_sample():
    """With no change the mode is the constant one, z' = λ z + u, as its recursion gives it."""
    rng, n, dt, pole = np.random.default_rng(0), 500, 1e-3, -1.0 + 100.0j
    drive = np.zeros((n - 1, 1), complex)
    drive[:30, 0] = rng.standard_normal(30)
    step, exact = np.exp(pole * dt), np.zeros(n, complex)
    for k in range(n - 1):
        exact[k + 1] = step * exact[k] + drive[k, 0]
    law = np.zeros((1, 2), complex), np.array([1.0]), False, step
    z = _simulated(np.zeros(1, complex), drive, *law, 5.0, 1e-3, 1e3, dt, 0.2, 0.3, 16.0, 30, 40)[:, 0]
    np.testing.assert_allclose(z, exact, rtol=0, atol=1e-12 * np.abs(exact).max())
