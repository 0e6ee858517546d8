import control
import numpy as np
import pytest
from scipy.signal import lfilter

from workbench.identification.driven import identify_driven
from workbench.identification.input_output import changing_response, time_variance
from workbench.identification.input_output.changing_response import _simulated
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import projected
from workbench.identification.signal.searches import TimeLimit
from workbench.records.record import Channel, Record


@pytest.mark.parametrize("many", [1, 40])
def test_an_undriven_mode_moves_as_its_frequency_goes_evenly_with_time(many):
    """λ + a + b s, s from (0 - m)/w to (1 - m)/w over the record: e to its integral over time."""
    n, dt, middle, width = 4001, 1e-3, 0.2, 0.3
    pole, a, b = -1.0 + 100.0j, 0.2 - 0.5j, -0.1 + 2.0j
    start, drive = np.array([2.0 + 0.0j]), np.zeros((n - 1, 1), complex)
    law = np.array([a, b]), np.array([1.0]), True, np.exp(pole * dt)
    z = _simulated(start, drive, *law, 2.0, 1e-3, 1e3, dt, middle, width, 16.0, 0, many, 1e-12, False)[:, 0]
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
    law = np.zeros(2, complex), np.array([1.0]), False, step
    z = _simulated(np.zeros(1, complex), drive, *law, 5.0, 1e-3, 1e3, dt, 0.2, 0.3, 16.0, 30, 40, 1e-12, False)[:, 0]
    np.testing.assert_allclose(z, exact, rtol=0, atol=1e-12 * np.abs(exact).max())


def test_between_impacts_a_mode_comes_to_rest():
    """It decays to nothing within a third of the record, and is followed again from the second impact on."""
    n, dt, pole = 3000, 1e-3, -60.0 + 400.0j
    drive = np.zeros((n - 1, 1), complex)
    drive[[10, 2000], 0] = 1.0, 2.0
    law = np.array([3.0j, 5.0]), np.array([1.0]), False, np.exp(pole * dt)
    z = _simulated(np.zeros(1, complex), drive, *law, 2.0, 1e-3, 1e3, dt, 0.2, 0.3, 16.0, n - 1, 1, 1e-12, False)[:, 0]
    followed = _simulated(np.zeros(1, complex), drive, *law, 2.0, 1e-3, 1e3, dt, 0.2, 0.3, 16.0, n - 1, 1, 0.0, False)
    assert not z[600:2000].any() and followed[600:2000].all()
    np.testing.assert_allclose(z, followed[:, 0], rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize(("by_time", "powers"), [(True, (1.0, 2.0)), (False, (0.5, 1.0)), (False, (-1.0, 1.0, 2.0))])
@pytest.mark.parametrize("driven", [1999, 300])
def test_the_derivatives_of_a_motion_are_its_differences(by_time, powers, driven):
    """By each coefficient of the rate, then by the factor of a further drive, real parts first."""
    rng, n, dt, pole = np.random.default_rng(1), 2000, 1e-3, -2.0 + 200.0j
    drives, start = np.zeros((n - 1, 2), complex), np.array([1.0 + 0.5j, 0.3])
    drives[:driven] = rng.standard_normal((driven, 2))
    change = 2.0 * np.array([0.1 + 0.2j, 0.1 - 0.3j, 0.02 + 0.05j, 0.01j][: 1 + len(powers)])

    def motion(unknowns, slopes=False):
        drive, at_first = drives.copy(), start.copy()
        drive[:, 0] += unknowns[-1] * drives[:, 1]
        at_first[0] += unknowns[-1] * start[1]
        law = unknowns[:-1], np.array(powers), by_time, np.exp(pole * dt)
        return _simulated(at_first, drive, *law, 20.0, 1e-3, 1e3, dt, 0.5, 0.3, 16.0, driven, 7, 1e-12, slopes)

    at = np.r_[change, 0.2 + 0.1j]
    exact, steps = motion(at, slopes=True), 1e-6 * np.eye(at.size)
    np.testing.assert_array_equal(exact[:, :1], motion(at))
    each = [motion(at + unit * step) - motion(at - unit * step) for unit in (1.0, 1j) for step in steps]
    differences = np.hstack(each) / 2e-6
    error = np.linalg.norm(exact[:, 1:] - differences, axis=0) / np.linalg.norm(differences, axis=0)
    assert error.max() < 1e-6


def test_two_linear_modes_are_no_changing_one_after_a_step_of_the_law_of_time(monkeypatch):
    """No law of one mode fits two that are 3 % apart; where that of time leaves far too much, no other is tried."""
    n, dt, omega, zeta = 4000, 0.01, 2.0 * np.pi * np.array([9.0, 9.27]), np.array([0.006, 0.012])
    rng = np.random.default_rng(5)
    poles = -zeta * omega + 1j * omega * np.sqrt(1.0 - zeta**2)
    plant = control.ss(np.kron(np.diag(poles.real), np.eye(2)) + np.kron(np.diag(poles.imag), [[0, 1], [-1, 0]]),
                       [[1.0], [0.0], [1.0], [0.0]], [[1.0, 0.0, 1.0, 0.0]], 0.0)  # fmt: skip
    force = rng.standard_normal((1, n))
    outputs = control.forced_response(control.sample_system(plant, dt), inputs=force).outputs.reshape(1, -1)
    outputs = outputs + 1e-3 * outputs.std() * rng.standard_normal(outputs.shape)
    with_slopes: list[bool] = []
    monkeypatch.setattr(
        changing_response, "_simulated", lambda *law: (with_slopes.append(law[-1]), _simulated(*law))[1]
    )
    record = Record(
        sample_time=dt,
        inputs=force,
        outputs=outputs,
        input_channels=(Channel("F"),),
        output_channels=(Channel("d", "displacement"),),
    )
    modes = identify_driven(record).modes
    np.testing.assert_allclose(modes.omega, omega, rtol=1e-3)
    # the law of time, its start with its derivatives and one step without; once, although the noise spectrum is
    # estimated again
    assert with_slopes == [True, False]


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_two_modes_that_the_blow_hardly_excites_are_no_changing_one(seed):
    """One mode of a law of amplitude has as many unknowns as the two, and was a little less likely."""
    rng, n, dt, force = np.random.default_rng(seed), 8000, 1e-4, np.zeros(8000)
    force[1000:1012] = np.sin(np.pi * np.arange(12) / 12) ** 2
    hz = np.array([187.1, 199.2, 217.1, 2823.4, 2833.6])
    zeta, size = np.array([0.0104, 0.0196, 0.0183, 0.0076, 0.018]), np.array([-0.8, 0.3, -0.65, 0.79, -0.61])
    poles = np.exp(2.0 * np.pi * hz * (-zeta + 1j * np.sqrt(1.0 - zeta**2)) * dt)
    outputs = np.zeros(n)
    for pole, a in zip(poles, size, strict=True):
        outputs += a * lfilter([1.0, -2.0, 1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], force)
    outputs += 0.003 * outputs.std() * rng.standard_normal(n)
    record = Record(dt, outputs[None], (Channel("a", "acceleration"),), force[None], (Channel("F", "force"),))
    np.testing.assert_allclose(identify_driven(record).modes.frequencies_hz, hz, rtol=1e-3)


@pytest.mark.parametrize(("apart", "compared"), [(1.1, True), (1.2, False)])
def test_modes_far_apart_are_not_compared_with_a_changing_one(monkeypatch, apart, compared):
    """A mode changes by 15 % at most, however wide the two are."""
    rng, omega = np.random.default_rng(2), 2.0 * np.pi * np.array([9.0, 9.0 * apart])
    record = Record(0.01, rng.standard_normal((1, 2000)), (Channel("d", "displacement"),),
                    rng.standard_normal((1, 2000)), (Channel("F"),))  # fmt: skip
    data = KnownInputs([record], at_rest=True, hold="zero", feedthrough=True)
    fit = projected(data, (-0.05 + 1j) * omega, np.ones((2, 1), complex))
    tried: list[np.ndarray] = []
    monkeypatch.setattr(time_variance, "in_place_of", lambda data, fit, cluster, *options: tried.append(cluster))
    assert time_variance.beside_changing(data, fit, 20.0, TimeLimit(), []) is None
    assert bool(tried) == compared
