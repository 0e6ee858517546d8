"""The linear model against one built by hand, and its frequency response against the modal sum."""

from dataclasses import replace

import control
import numpy as np
import pytest

from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.rig.statespace import input_matrix, state_space
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam

QUANTITIES = {
    "displacement": (0, 0),
    "slope": (1, 0),
    "velocity": (0, 1),
    "angular velocity": (1, 1),
    "acceleration": (0, 2),
}


@pytest.fixture(scope="module")
def modes():
    beam = Beam(
        length=2.0,
        mass_per_length=3.0,
        bending_stiffness=5.0,
        left="hinged",
        right="hinged",
        damping=ModalDamping((0.02, 0.01, 0.03)),
    )
    return beam.modes(3)


def exact_shape(x, derivative):
    """Of the hinged beam: sqrt(2 / (m L)) sin(rπx/L) and its slope."""
    k = np.arange(1, 4) * np.pi / 2.0
    return np.sqrt(2.0 / 6.0) * (np.sin(k * x) if derivative == 0 else k * np.cos(k * x))


def test_matrices_are_those_built_by_hand(modes):
    actuators = [Actuator("F", 0.4, gain=2.0), Actuator("M", 1.3, quantity="moment")]
    model = state_space(modes, actuators, [Sensor("w", 0.7), Sensor("v", 1.1, "velocity", gain=0.5)])
    omega = np.sqrt(5.0 / 3.0) * (np.arange(1, 4) * np.pi / 2.0) ** 2
    c = 2 * np.array([0.02, 0.01, 0.03]) * omega
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    a[3:, :3], a[3:, 3:] = -np.diag(omega**2), -np.diag(c)
    b = np.zeros((6, 2))
    b[3:, 0], b[3:, 1] = 2.0 * exact_shape(0.4, 0), exact_shape(1.3, 1)
    np.testing.assert_allclose(model.A, a, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(model.B, b, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(model.C[0], [*exact_shape(0.7, 0), 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(model.C[1], [0, 0, 0, *(0.5 * exact_shape(1.1, 0))], atol=1e-9)
    assert model.input_labels == ["F", "M"] and model.output_labels == ["w", "v"]
    assert model.state_labels == ["q1", "q2", "q3", "dq1", "dq2", "dq3"]


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("lags", [(0.0, 0.0), (0.3, 0.07)])
def test_frequency_response_is_the_modal_sum(modes, quantity, lags):
    actuator_lag, sensor_lag = lags
    model = state_space(
        modes,
        [Actuator("F", 0.4, time_constant=actuator_lag), Actuator("G", 1.7)],
        [Sensor("y", 0.9, quantity, time_constant=sensor_lag), Sensor("z", 0.2)],
    )
    derivative, order = QUANTITIES[quantity]
    omega = np.sqrt(5.0 / 3.0) * (np.arange(1, 4) * np.pi / 2.0) ** 2
    zeta = np.array([0.02, 0.01, 0.03])
    for w in (0.5, 3.0, 11.0, 40.0):
        s = 1j * w
        modal = exact_shape(0.4, 0) / (s**2 + 2 * zeta * omega * s + omega**2)
        expected = s**order * (exact_shape(0.9, derivative) @ modal) / (1 + actuator_lag * s) / (1 + sensor_lag * s)
        assert control.evalfr(model, s)[0, 0] == pytest.approx(expected, rel=1e-8, abs=1e-12)


def test_an_actuator_on_a_support_is_refused_by_name(modes):
    with pytest.raises(ValueError, match="actuator F is on the support at x = 2"):
        input_matrix(modes, [Actuator("F", 2.0)])
    assert np.abs(input_matrix(modes, [Actuator("M", 2.0, quantity="moment")])).min() > 0.1


@pytest.mark.parametrize(
    ("actuator", "sensor", "said"),
    [
        (Actuator("F", 0.4, limit=1.0, delay=0.1), Sensor("y", 0.9), "actuator F has a limit, so it is not linear"),
        (Actuator("F", 0.4, delay=0.1), Sensor("y", 0.9), "actuator F has a delay, which no finite .* control.pade"),
        (Actuator("F", 0.4), Sensor("y", 0.9, step=0.1, bias=1.0), "sensor y has a bias and rounding, so it is not"),
        (Actuator("F", 0.4), Sensor("y", 0.9, delay=-0.1), "sensor y has a delay, which no finite .* control.pade"),
        (Actuator("F", 0.4), Sensor("y", 0.9, crosstalk=(("x", 0.1),)), "sensor y reads a share of 'x', which is no"),
    ],
)
def test_what_no_finite_linear_model_represents_is_refused(modes, actuator, sensor, said):
    with pytest.raises(ValueError, match=said):
        state_space(modes, [actuator], [sensor])


def test_crosstalk_is_a_matrix_product(modes):
    """A share of the quantity itself is added, before the gain: as the simulation has it, of a dead sensor too."""
    sensors = (
        Sensor("y", 0.9, gain=2.0, crosstalk=(("v", 0.1), ("a", -0.02))),
        Sensor("v", 0.4, "velocity", gain=0.0, crosstalk=(("y", 0.3),)),
        Sensor("a", 1.1, "acceleration", gain=0.5, crosstalk=(("v", 0.2), ("y", 0.7))),
    )
    drive, dt = (Actuator("F", 0.4),), 0.002
    inputs = np.random.default_rng(1).standard_normal((1, 200))
    system = control.c2d(state_space(modes, drive, sensors), dt)
    peer = control.forced_response(system, inputs=inputs, timepts=dt * np.arange(200)).outputs
    mine = simulate(Rig(modes, drive, sensors), inputs, sample_time=dt).outputs
    np.testing.assert_allclose(mine, peer, atol=1e-9 * np.abs(peer).max())
    lagged = state_space(modes, drive, (sensors[0], *(replace(s, time_constant=0.05) for s in sensors[1:])))
    s = 20j
    ratio = lagged(s)[[0, 2], 0] / state_space(modes, drive, sensors)(s)[[0, 2], 0]
    np.testing.assert_allclose(ratio, [1.0, 1.0 / (1.0 + 0.05 * s)], rtol=1e-9)


def test_names_with_a_point_are_such_as_python_control_allows(modes):
    system = state_space(modes, [Actuator("F 1", 0.4)], [Sensor("Acc. A", 0.7, time_constant=0.01)])
    assert system.output_labels == ["Acc_ A"] and system.input_labels == ["F 1"]


def test_crosstalk_of_actuators_mixes_the_commands(modes):
    """Before gains and lags, which differ: as the simulation has it."""
    drive = (
        Actuator("F", 0.4, gain=2.0, time_constant=0.01, crosstalk=(("M", 0.3), ("G", -0.1))),
        Actuator("M", 1.3, quantity="moment", gain=0.5, crosstalk=(("F", 0.2),)),
        Actuator("G", 0.9, time_constant=0.03),
    )
    sensors, dt = (Sensor("y", 0.9), Sensor("a", 1.1, "acceleration")), 0.002
    inputs = np.random.default_rng(1).standard_normal((3, 200))
    system = control.c2d(state_space(modes, drive, sensors), dt)
    peer = control.forced_response(system, inputs=inputs, timepts=dt * np.arange(200)).outputs
    mine = simulate(Rig(modes, drive, sensors), inputs, sample_time=dt).outputs
    np.testing.assert_allclose(mine, peer, atol=1e-9 * np.abs(peer).max())
    with pytest.raises(ValueError, match="F takes a share of the command of 'M', which is no actuator of the rig"):
        state_space(modes, [drive[0]], sensors)
    with pytest.raises(ValueError, match="F takes a share of the command of M, and a design has no cross-talk"):
        input_matrix(modes, drive)
