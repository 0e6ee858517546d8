"""Spectra of measured signals."""

import numpy as np
import pytest
from scipy.signal import lfilter, welch

from workbench.draw.plot import plot
from workbench.draw.signals import plot_frf, plot_frf_matrix, plot_frf_of_inputs, power_spectrum
from workbench.identification.signal.frequency_responses import frequency_responses
from workbench.records.frequency_responses import FrequencyResponses
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


def test_lines_of_the_same_colour_differ_by_their_dashes():
    rng = np.random.default_rng(0)
    channels = tuple(Channel(f"y{j}") for j in range(9))
    record = Record(0.01, rng.standard_normal((9, 500)), channels, rng.standard_normal((1, 500)), (Channel("F"),))
    for ax in plot_frf(record).axes:
        assert len({(line.get_color(), line.get_linestyle()) for line in ax.lines}) == 9


def test_frfs_are_drawn_by_magnitude_and_phase_with_what_was_fitted():
    """Of one mode: 1 / c ω in size and -90° at its frequency."""
    lines, omega, zeta = np.linspace(1.0, 40.0, 391), 2.0 * np.pi * 20.0, 0.02
    h = 1.0 / (omega**2 - (2.0 * np.pi * lines) ** 2 + 4j * np.pi * zeta * omega * lines)
    measured = FrequencyResponses(h[None, None], lines, (Channel("y", "displacement", "m"),))
    fitted = FrequencyResponses(2.0 * h[None, None, 90:], lines[90:], measured.output_channels)
    for figure in (plot(measured), plot_frf_matrix(measured, fitted)):
        magnitude, phase = figure.axes
        assert magnitude.get_yscale() == "log" and phase.get_xlabel() == "frequency [Hz]"
        assert magnitude.get_ylabel() == "|y|\n[m per input]"
        at = np.argmin(np.abs(lines - 20.0))
        assert magnitude.lines[0].get_ydata()[at] == pytest.approx(1.0 / (2.0 * zeta * omega**2))
        assert phase.lines[0].get_ydata()[at] == pytest.approx(-90.0)
    model = magnitude.lines[1]
    assert model.get_linestyle() == "--" and model.get_label() == "input, fitted"
    np.testing.assert_allclose(model.get_data(), [lines[90:], 2.0 * np.abs(h[90:])])


@pytest.mark.parametrize("n", [1, 3, 100, 16385, 1_100_003])
def test_spectrum_by_parts_is_that_of_the_whole(n):
    signal = 3.0 + np.random.default_rng(n).standard_normal(n)
    lines, power = power_spectrum(signal, 100.0)
    whole = welch(signal - signal.mean(), 100.0, nperseg=min(4096, max(n // 4, 1)))
    np.testing.assert_array_equal(lines, whole[0])
    np.testing.assert_allclose(power, whole[1], rtol=1e-12, atol=1e-15)


def test_responses_to_several_inputs_have_a_panel_per_output_and_a_line_per_input():
    """Truth: each output is the sum of the inputs, through gains."""
    rng, gains = np.random.default_rng(0), np.array([[2.0, -5.0], [0.5, 10.0], [4.0, 1.0]])
    u = rng.standard_normal((2, 20_000))
    channels = tuple(Channel(f"y{j}", "acceleration") for j in range(3))
    found = frequency_responses([Record(0.01, gains @ u, channels, u, (Channel("F", "force"), Channel("G", "force")))])
    lines = np.linspace(0.1, 49.0, 200)
    fitted = FrequencyResponses(np.repeat(gains[..., None], 200, axis=2), lines, channels, ("F", "G"))
    *panels, coherence = plot_frf_of_inputs(found, fitted).axes
    assert len(panels) == 3 and panels[0].get_ylabel() == "|y0 / input|\n[(m/s²)/N]"
    for panel, row in zip(panels, np.abs(gains), strict=True):
        assert [line.get_linestyle() for line in panel.lines] == ["-", "-", "--", "--"]
        for line, gain in zip(panel.lines, [*row, *row], strict=True):
            np.testing.assert_allclose(line.get_ydata(), gain, rtol=1e-6)
    assert coherence.get_xlabel() == "frequency [Hz]" and len(coherence.lines) == 3
    assert all(line.get_ydata().min() > 0.999999 for line in coherence.lines)


def test_inputs_of_different_units_have_theirs_in_the_legend():
    u = np.random.default_rng(0).standard_normal((2, 20_000))
    inputs = (Channel("F", "force"), Channel("M", "moment"))
    found = frequency_responses([Record(0.01, u[:1], (Channel("y", "displacement"),), u, inputs)])
    panel = plot_frf_of_inputs(found).axes[0]
    assert panel.get_ylabel() == "|y / input|\n[m per unit of input]"
    assert [line.get_label() for line in panel.lines] == ["F [N]", "M [N m]"]
