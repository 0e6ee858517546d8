"""The closed form of the lines of a response, against a recursion and a transform by SciPy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.fft import dct
from scipy.signal import lfilter

from workbench.identification.input_output.known_inputs import KnownInputs, sources
from workbench.identification.input_output.lines_of_poles import LinesOfPoles
from workbench.identification.input_output.modal_fit import MANY_ROWS, projected, settled
from workbench.records.record import Channel, Record

DT, POLE = 1e-3, -2.0 + 300.0j


def by_recursion(inputs, first, pole, hold):
    """Lines of z of each input and of a unit initial state, (n_excitations, n_lines) complex."""
    (now, following), _ = sources(pole, DT, hold)
    mu = np.exp(pole * DT)
    start = -following * inputs[:, :1].astype(complex)
    z = lfilter([following, now], [1.0, -mu], inputs.astype(complex), axis=1, zi=start)[0]
    z = np.vstack([z, mu ** np.arange(inputs.shape[1])])[:, first:]
    return dct(z.real, norm="ortho") + 1j * dct(z.imag, norm="ortho")


@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("first", [0, 3])
def test_lines_are_those_of_the_recursion(hold, first):
    inputs, step = np.random.default_rng(0).standard_normal((2, 1501)), 1e-4
    lines, l_r, held = LinesOfPoles(inputs, first, DT, False), np.array([1.0, 0.3 - 0.2j, 2.0]), sources(POLE, DT, hold)
    exact = by_recursion(inputs, first, POLE, hold)
    real, imaginary = np.zeros((2, 4, 1501 - first))
    lines.tangents(POLE, held, 1 + np.arange(3), l_r, real, imaginary)
    assert np.abs(real[1:] + 1j * imaginary[1:] - exact).max() < 1e-11 * np.abs(exact).max()
    above, below = (by_recursion(inputs, first, POLE + h, hold) for h in (step, -step))
    # l_r multiplies the response, not its real and imaginary lines apart
    slope = l_r @ ((above - below) / (2.0 * step))
    assert np.abs(real[0] + 1j * imaginary[0] - slope).max() < 1e-6 * np.abs(slope).max()


def long_record(seed=0):
    """Two modes driven by white force, of more rows than are projected by products of columns, and its poles."""
    rng, poles = np.random.default_rng(seed), np.array([-3.0 + 300.0j, -5.0 + 700.0j])
    u = rng.standard_normal((1, MANY_ROWS + 100))
    y = sum(2.0 * np.real(lfilter([0.0, DT], [1.0, -np.exp(p * DT)], u[0].astype(complex))) for p in poles)
    y = y + 0.01 * y.std() * rng.standard_normal(y.size)
    return Record(DT, y[None], (Channel("y", "displacement"),), u, (Channel("u", "force"),)), poles


@pytest.mark.parametrize("coloured", [False, True])
def test_a_long_record_is_projected_as_by_least_squares(coloured):
    record, poles = long_record()
    data = KnownInputs([record], at_rest=False, hold="zero", feedthrough=True)
    n = len(data.values)
    if coloured:
        data = replace(data, line_std=[1.0 + 0.5 * np.sin(np.linspace(0.0, 9.0, n))[:, None]])
    fit = projected(data, poles, np.array([[1.0, 0.1], [0.5 + 0.5j, 1.0]]))
    weight = np.ones((1, 1)) if data.weights is None else data.weights
    excitation = np.vstack([record.inputs, np.zeros((1, n))])
    lines = [
        (by_recursion(excitation[:1], 0, pole, "zero") * l_r[:, None]).sum(axis=0)
        for pole, l_r in zip(poles, fit.participation, strict=True)
    ]
    # (x + i x') (l + i l') of sequences: their lines are linear in them
    phi = np.column_stack([*(z.real for z in lines), *(z.imag for z in lines)])
    direct = np.column_stack([dct(record.inputs[0], norm="ortho"), dct(np.ones(n), norm="ortho")])
    columns, values = weight * np.hstack([phi, direct]), weight[:, 0] * dct(record.outputs[0], norm="ortho")
    exact = np.linalg.lstsq(columns, values, rcond=None)[0]
    np.testing.assert_allclose(fit.coefficients[:, 0], exact, rtol=1e-8, atol=1e-9 * np.abs(exact).max())
    np.testing.assert_allclose(fit.residual[:, 0], values - columns @ exact, atol=1e-8 * np.abs(values).max())


def test_a_settled_fit_of_one_output_is_projected_once_more(monkeypatch):
    """No other output could be weighted against it."""
    record, poles = long_record(1)
    data = KnownInputs([record], at_rest=False, hold="zero", feedthrough=True)
    fit, counted = settled(data, projected(data, poles, np.eye(1, 2, dtype=complex).repeat(2, axis=0))), []
    assert fit.converged and np.abs(fit.poles / poles - 1.0).max() < 1e-3
    monkeypatch.setattr(
        "workbench.identification.input_output.modal_fit.projected",
        lambda *given: counted.append(given) or projected(*given),
    )
    assert np.abs(settled(data, fit).poles - fit.poles).max() < 1e-3
    assert len(counted) == 1


def test_lines_and_samples_give_the_same_fit():
    record, poles = long_record(2)
    data = KnownInputs([record], at_rest=True, hold="zero", feedthrough=True)
    short = replace(record, outputs=record.outputs[:, : MANY_ROWS - 1], inputs=record.inputs[:, : MANY_ROWS - 1])
    samples = KnownInputs([short], at_rest=True, hold="zero", feedthrough=True)
    assert data.rows_are_lines and not samples.rows_are_lines
    for each in (data, samples):
        left = each.as_samples(projected(each, poles, np.ones((2, 1), complex)).residual)[0]
        np.testing.assert_allclose(left.std(), 0.01 * record.outputs.std(), rtol=0.05)
