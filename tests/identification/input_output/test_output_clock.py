"""Outputs sampled by a clock of their own, in closed form: the response of a pole to a held force at any instant."""

import re

import numpy as np
import pytest
from scipy.signal import lfilter

from workbench.identification.driven import identify_driven
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import projected, settled
from workbench.identification.input_output.output_clock import on_one_clock, output_clock
from workbench.identification.signal.searches import TimeLimit
from workbench.records.band_limited import derivative_of, spaced
from workbench.records.record import Channel, Record

DT, N = 1e-3, 4000
F, ZETA = np.array([22.0, 61.0, 140.0]), np.array([0.004, 0.006, 0.005])


def record_of(ppm=0.0, n_outputs=1, falling=0.0):
    """Displacements under a random force, 1 % noise; sample k lies at k(1 + ppm 1e-6) samples of the force."""
    rng = np.random.default_rng(3)
    u, y, shapes = rng.normal(size=N), np.zeros((n_outputs, N - 10)), rng.choice([-1.0, 1.0], (n_outputs, 3))
    at = np.arange(N - 10) * (1.0 + 1e-6 * ppm)
    before = np.floor(at).astype(int)
    for f, zeta, shape in zip(F, ZETA, shapes.T, strict=True):
        omega = 2.0 * np.pi * f * (1.0 - falling * np.arange(N) / N)
        pole = omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
        held, decay = (np.exp(pole * DT) - 1.0) / pole * u, np.exp(pole * DT)
        if falling:
            z = np.zeros(N, complex)
            for k in range(N - 1):
                z[k + 1] = decay[k] * z[k] + held[k]
        else:
            z = lfilter([0.0, 1.0], [1.0, -decay[0]], held)
        late = np.exp(pole[before] * (at - before) * DT)
        y += np.outer(shape, (omega[0] * (late * z[before] + (late - 1.0) / pole[before] * u[before])).imag)
    y += 0.01 * y.std(axis=1, keepdims=True) * rng.normal(size=y.shape)
    outputs = tuple(Channel(f"y{j}", "displacement") for j in range(n_outputs))
    return Record(DT, y, outputs, u[None, : N - 10], (Channel("u", "force"),))


@pytest.mark.parametrize(("ppm", "n_outputs"), [(200.0, 1), (-500.0, 1), (100.0, 3)])
def test_outputs_of_another_clock_are_resampled(ppm, n_outputs):
    found = identify_driven(record_of(ppm, n_outputs))
    assert found.modes.n_modes == 3
    assert (np.abs(found.modes.frequencies_hz - F) < 4.0 * found.omega_std / (2.0 * np.pi)).all()
    assert (np.abs(found.modes.zeta - ZETA) < 4.0 * found.zeta_std).all()
    (remark,) = found.remarks
    size, deviation, way = re.match(r"the outputs' clock runs (\S+) ± (\S+) ppm (\w+) against", remark).groups()
    assert abs(float(size) - abs(ppm)) < 4.0 * float(deviation)
    assert float(deviation) < 1.0
    assert way == ("slow" if ppm > 0 else "fast")


def test_one_clock_has_no_remark():
    assert identify_driven(record_of()).remarks == ()


@pytest.mark.parametrize("falling", [0.0005, 0.005])
def test_frequencies_that_fall_are_no_clock(falling):
    data = KnownInputs([record_of(falling=falling)], at_rest=False, hold="zero", feedthrough=True)
    poles = 2.0 * np.pi * F * (-ZETA + 1j)
    fit = settled(data, projected(data, poles, np.tile([1.0 + 0j, 0.0], (3, 1))))
    clock = output_clock(data, fit)
    assert abs(clock.rate) < 4.0 * clock.std < 2e-5
    assert on_one_clock(data, fit, None, TimeLimit()) is None


def test_frequencies_that_fall_beside_another_clock():
    remarks = identify_driven(record_of(200.0, falling=0.001)).remarks
    assert any("clock runs" in remark for remark in remarks)
    assert any("change within the record" in remark for remark in remarks)


def test_spaced_and_derivative_are_those_of_a_sine():
    k, spacing = np.arange(2000), 1.0003
    omega = np.array([[0.2], [1.1]])
    inside = slice(300, 1600)  # the continuation beyond both ends is not the sine
    np.testing.assert_allclose(
        spaced(np.sin(omega * k), spacing, 2000)[:, inside], np.sin(omega * spacing * k)[:, inside], atol=1e-3
    )
    np.testing.assert_allclose(
        derivative_of(np.sin(omega * k))[:, inside], (omega * np.cos(omega * k))[:, inside], atol=1e-3
    )
