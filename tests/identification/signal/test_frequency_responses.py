"""Frequency responses to several inputs at once: those of a state-space model, and inputs that cannot be told apart."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cheby2, cont2discrete, lfilter, ss2tf

from workbench.identification.signal.frequency_responses import frequency_responses, loudest
from workbench.records.record import Channel, Record

RATE = 100.0
A = np.array([[0.0, 1.0, 0.0, 0.0], [-3600.0, -12.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -22500.0, -30.0]])
B = np.array([[0.0, 0.0], [1.0, 0.5], [0.0, 0.0], [-0.4, 1.0]])
C = np.array([[1.0, 0.0, 1.0, 0.0], [1.0, 0.0, -2.0, 0.0], [0.3, 0.0, 0.2, 0.0]])
INPUTS = (Channel("F1", "force"), Channel("F2", "force"))
OUTPUTS = tuple(Channel(f"y{j + 1}", "displacement") for j in range(3))


def discrete():
    return cont2discrete((A, B, C, np.zeros((3, 2))), 1.0 / RATE)


def record(inputs, noise=0.0, seed=9):
    """The response of two modes at 9.5 and 23.9 Hz to inputs that are held from sample to sample."""
    a, b, c, d, _ = discrete()
    y = np.zeros((3, inputs.shape[1]))
    for i, u in enumerate(inputs):
        numerators, denominator = ss2tf(a, b, c, d, input=i)
        y += np.array([lfilter(numerator, denominator, u) for numerator in numerators])
    y += noise * y.std() * np.random.default_rng(seed).standard_normal(y.shape)
    channels = tuple(Channel(f"F{i + 1}", "force") for i in range(len(inputs)))
    return Record(1.0 / RATE, y, OUTPUTS, inputs, channels)


def exact(hertz):
    """C (z I - A)⁻¹ B of the model held from sample to sample, (3, 2, n_lines)."""
    a, b, c, _, _ = discrete()
    z = np.exp(2j * np.pi * hertz / RATE)
    return np.array([c @ np.linalg.solve(one * np.eye(4) - a, b) for one in z]).transpose(1, 2, 0)


def test_the_responses_to_two_independent_inputs_are_those_of_the_model():
    u = np.random.default_rng(0).standard_normal((2, 400_000)) * np.array([[1.0], [3.0]])
    found = frequency_responses([record(u)])
    truth = exact(found.frf.frequencies_hz)
    assert np.abs(found.frf.values - truth).max() < 0.03 * np.abs(truth).max()
    assert found.coherence.min() > 0.99 and found.units == ("N", "N") and not found.silent


def test_partly_correlated_inputs_are_told_apart_where_h1_of_each_alone_would_mix_them():
    v = np.random.default_rng(1).standard_normal((2, 400_000))
    found = frequency_responses([record(np.array([v[0], 0.7 * v[0] + 0.7 * v[1]]))])
    truth = exact(found.frf.frequencies_hz)
    assert np.abs(found.frf.values - truth).max() < 0.05 * np.abs(truth).max()


def test_the_multiple_coherence_is_the_share_of_power_that_the_inputs_explain():
    """Truth: white noise of known power beside a response of known spectrum."""
    u, level = np.random.default_rng(2).standard_normal((2, 400_000)), 0.3
    clean = record(u)
    found = frequency_responses([record(u, noise=level)])
    explained = (np.abs(exact(found.frf.frequencies_hz)) ** 2).sum(axis=1)  # of inputs of unit variance
    share = explained / (explained + level**2 * clean.outputs.std() ** 2)
    assert np.abs(found.coherence - share).mean() < 0.02
    assert found.coherence.min() >= 0.0 and found.coherence.max() <= 1.0


@pytest.mark.parametrize("together", [lambda a, b: np.array([a, 2.0 * a]), lambda a, b: np.array([a, a + 0.1 * b])])
def test_correlated_inputs_are_named_with_their_coherence(together):
    u = together(*np.random.default_rng(3).standard_normal((2, 20_000)))
    with pytest.raises(ValueError, match=r"the inputs F1 and F2 are correlated, with a coherence of (1\.000|0\.99\d)"):
        frequency_responses([record(u)])


def test_an_input_that_is_the_sum_of_two_others_is_named():
    a, b = np.random.default_rng(4).standard_normal((2, 20_000))
    inputs = np.array([a, b, a + b])
    base = record(inputs[:2])
    channels = (*INPUTS, Channel("F3", "force"))
    with pytest.raises(ValueError, match=r"the input F\d follows from the others, with a multiple coherence of 1\.000"):
        frequency_responses([replace(base, inputs=inputs, input_channels=channels)])


def test_two_records_of_one_shaker_each_give_the_responses_to_both():
    u = np.random.default_rng(5).standard_normal((2, 100_000))
    first, second = (record(np.where(np.arange(2)[:, None] == i, u, 0.0)) for i in range(2))
    truth = exact((found := frequency_responses([first, second])).frf.frequencies_hz)
    assert np.abs(found.frf.values - truth).max() < 0.05 * np.abs(truth).max()
    alone = frequency_responses([first])
    assert alone.silent == ("F2",) and alone.frf.references == ("F1",)
    with pytest.raises(ValueError, match="every input is constant"):
        frequency_responses([replace(first, inputs=np.zeros((2, 100_000)))])


def test_a_record_too_short_to_average_is_refused():
    with pytest.raises(ValueError, match="100 samples are too few to average spectra of 2 inputs: 128 are needed"):
        frequency_responses([record(np.random.default_rng(6).standard_normal((2, 100)))])


def test_the_loudest_outputs_come_first_each_beside_those_of_its_quantity():
    rows = np.array([1.0, 3.0, 2.0, 500.0])[:, None] * np.random.default_rng(7).standard_normal(1000)
    channels = (*OUTPUTS, Channel("a", "acceleration"))
    assert loudest(Record(0.01, rows, channels), 3) == ("y2", "a", "y3")


def test_lines_that_the_inputs_hardly_excite_show_no_response_to_noise():
    """Inputs up to 20 Hz, and noise of the sensors at all frequencies."""
    numerator, denominator = cheby2(10, 70.0, 0.5)
    u = lfilter(numerator, denominator, np.random.default_rng(4).standard_normal((2, 100_000)))
    found = frequency_responses([record(u, noise=0.05)])
    hertz, shown = found.frf.frequencies_hz, np.isfinite(found.frf.values).all(axis=(0, 1))
    assert shown[hertz < 12.0].all() and not shown[hertz > 26.0].any()
    assert np.isnan(found.coherence[:, hertz > 26.0]).all()
    assert np.isfinite(frequency_responses([record(u)]).frf.values).all(), "without noise all are coherent"
