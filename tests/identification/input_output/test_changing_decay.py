"""A mode whose rate follows a polynomial of time, in place of three linear ones."""

import numpy as np

from workbench.identification.input_output.changing_decay import beside_changing
from workbench.identification.input_output.model_order import SelectionOptions, select_modes
from workbench.identification.input_output.spectral_lines import Lines
from workbench.identification.signal.searches import TimeLimit


def test_a_rate_of_third_degree_in_time_is_one_mode():
    """Its law had the coefficients of that of second degree, so that another was taken, of 14 % less scatter."""
    dt, pole = 1e-3, -2.0 + 2j * np.pi * 40.0
    t = dt * np.arange(4000)
    f, h = np.fft.rfftfreq(t.size, dt), dt * np.fft.rfft(np.imag(np.exp(pole * t + 2.4j * t**3 - 0.96j * t**4)))
    about = (f > 30.0) & (f < 50.0)
    noise = np.random.default_rng(0).standard_normal((2, np.count_nonzero(about)))
    h = h[about] + 1e-3 * np.abs(h[about]).max() * (noise[0] + 1j * noise[1])
    lines = Lines(h[None, None], 2.0 * np.pi * f[about], [0, -2], None)
    linear = select_modes(lines, SelectionOptions(3)).fit
    assert linear.poles.size == 3
    changing, one = beside_changing(lines, linear, 0.0, TimeLimit())
    assert one.poles.size == 1
    # 7.2 t² - 3.84 t³, weighted by the power e^-4t, whose moments are E t^k = k! / 4^k
    true = np.sqrt(
        51.84 * 24 / 4**4 - 55.296 * 120 / 4**5 + 14.7456 * 720 / 4**6 - (7.2 * 2 / 4**2 - 3.84 * 6 / 4**3) ** 2
    )
    ((_, scatter),) = changing.changing
    np.testing.assert_allclose(scatter, true, rtol=0.05)
