"""Spectra of measured signals."""

import numpy as np
import pytest
from scipy.signal import lfilter

from workbench.draw.spectra import plot_frf
from workbench.records.record import Channel, Record


def test_the_frequency_response_is_that_of_the_filter_between_input_and_output():
    rng, rate = np.random.default_rng(0), 200.0
    u = rng.standard_normal(200_000)
    a = [1.0, -1.6, 0.81]
    record = Record(1 / rate, lfilter([1.0], a, u)[None], (Channel("y"),), u[None], (Channel("F"),))
    response, coherence = plot_frf(record).axes
    lines, found = response.lines[0].get_data()
    z = np.exp(-2j * np.pi * lines / rate)
    np.testing.assert_allclose(found, 1.0 / np.abs(np.polyval(a[::-1], z)), rtol=0.02)
    assert coherence.lines[0].get_ydata().min() > 0.99
    with pytest.raises(ValueError, match="needs one input; record 'record' has 0"):
        plot_frf(Record(1 / rate, u[None], (Channel("y"),)))
