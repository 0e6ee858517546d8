from dataclasses import replace

import numpy as np
import pytest

from workbench.identification.free_decay.ibrahim import stacked_delays, two_delays
from workbench.identification.signal.synthesis import free_decay, impulse_response_modes
from workbench.structure.damping import ProportionalDamping
from workbench.structure.member import Bar
from workbench.structure.modes import SampledModes, mac


@pytest.fixture(scope="module")
def bar_modes():
    """Twenty modes of the bar of section 4.4."""
    return Bar(
        length=1.0,
        mass_per_length=lambda x: 2 * (1 - x),
        axial_stiffness=lambda x: 2 * (1 - x),
        left="fixed",
        right="free",
        damping=ProportionalDamping(stiffness=0.002, mass=0.1),
    ).modes(20)


def ring_down(modes, m, **options):
    return free_decay(impulse_response_modes(modes, at=0.63, positions=np.arange(1, m + 1) / m), **options)


def test_decay_agrees_with_control(bar_modes):
    """The ring-down is the impulse response of the state-space model by python-control."""
    import control

    from workbench.rig.actuators import Actuator
    from workbench.rig.sensors import Sensor
    from workbench.rig.statespace import state_space

    plant = state_space(bar_modes, [Actuator("F", 0.63)], [Sensor("a", 0.5), Sensor("b", 1.0, "velocity")])
    time = 0.01 * np.arange(200)
    reference = control.impulse_response(plant, time).outputs[:, 0]
    decay = impulse_response_modes(bar_modes, at=0.63, positions=[0.5, 1.0])
    displacement = free_decay(decay, sample_time=0.01, n_samples=200).outputs[0]
    velocity = free_decay(decay, sample_time=0.01, n_samples=200, quantity="velocity").outputs[1]
    assert np.abs(displacement - reference[0]).max() < 1e-9 * np.abs(reference[0]).max()
    assert np.abs(velocity - reference[1]).max() < 1e-9 * np.abs(reference[1]).max()


def test_two_delays_exact_with_as_many_sensors_as_modes(bar_modes):
    few = bar_modes.select(range(8))
    found = two_delays(ring_down(few, 8, sample_time=0.01, n_samples=500), spacing=3)
    assert np.abs(found.omega / few.omega - 1).max() < 1e-9
    assert np.abs(found.zeta / few.zeta - 1).max() < 1e-7
    assert (np.diag(mac(found.shapes, few.phi(found.positions))) > 1 - 1e-9).all()


@pytest.mark.parametrize("quantity", ["displacement", "velocity", "acceleration"])
def test_six_sensors_find_twenty_modes(bar_modes, quantity):
    record = ring_down(bar_modes, 6, sample_time=0.01, n_samples=800, quantity=quantity)
    found = stacked_delays(record, n_modes=20, delays=60)
    assert found.n_modes == 20
    assert np.abs(found.omega / bar_modes.omega - 1).max() < 1e-10
    assert np.abs(found.zeta / bar_modes.zeta - 1).max() < 1e-9
    truth = bar_modes.phi(found.positions)
    truth = truth / np.abs(truth).max(axis=0)
    assert np.minimum(np.abs(found.shapes - truth), np.abs(found.shapes + truth)).max() < 1e-8


def test_shapes_of_mixed_sensors_are_of_displacement(bar_modes):
    few = bar_modes.select(range(3))
    records = [ring_down(few, 4, sample_time=0.02, n_samples=400, quantity=q) for q in ("displacement", "acceleration")]
    mixed = replace(
        records[0],
        outputs=np.vstack([records[0].outputs[:2], records[1].outputs[2:]]),
        output_channels=records[0].output_channels[:2] + records[1].output_channels[2:],
    )
    shapes = stacked_delays(mixed, n_modes=3).shapes
    alone = stacked_delays(records[0], n_modes=3).shapes
    assert np.abs(shapes - alone).max() < 1e-7


def test_several_records_together():
    modes = SampledModes([10.0, 23.0], [0.01, 0.02], [[1.0, 0.0], [0.5, 0.0]], [0.0, 1.0])
    other = SampledModes([10.0, 23.0], [0.01, 0.02], [[0.0, 1.0], [0.0, -0.3]], [0.0, 1.0])
    records = [free_decay(m, sample_time=0.02, n_samples=n) for m, n in ((modes, 150), (other, 300))]
    found = stacked_delays(records, n_modes=2)
    assert np.allclose(found.omega, [10, 23], rtol=1e-9)
    assert np.allclose(found.zeta, [0.01, 0.02], rtol=1e-7)


@pytest.mark.parametrize("branch", [0, 1, 2, 3])
def test_frequency_beyond_the_sample_rate_is_a_question_of_branch(branch):
    """Aliases of one record: each branch k of (3.23) gives the frequency between k and k + 1 times Nyquist."""
    dt = 0.1
    omega = (branch + 0.4) * np.pi / dt
    modes = SampledModes([omega], [0.002], [[1.0], [0.3 - 0.1j]], [0.0, 1.0])
    found = stacked_delays(free_decay(modes, sample_time=dt, n_samples=120, aliases=True), n_modes=1, branch=branch)
    assert found.omega[0] == pytest.approx(omega, rel=1e-10)
    assert found.zeta[0] == pytest.approx(0.002, rel=1e-8)
    assert mac(found.shapes, modes.shapes)[0, 0] > 1 - 1e-12


def test_stacked_delays_hold_where_two_fail(bar_modes):
    """At 20 dB the two-delay form loses the modes; 60 delays keep frequencies to 1e-3 and damping to 15 %."""
    zeta = np.full(6, 0.005)
    few = SampledModes(bar_modes.omega[:6], zeta, bar_modes.phi(np.arange(1, 7) / 6)[:, :6], np.arange(1, 7) / 6)
    clean = free_decay(few, sample_time=0.05, n_samples=1000)
    noise = 0.1 * np.sqrt((clean.outputs**2).mean())
    record = free_decay(few, sample_time=0.05, n_samples=1000, noise_std=noise, seed=5)
    found = stacked_delays(record, n_modes=6, delays=60)
    assert np.abs(found.omega / few.omega - 1).max() < 1e-3
    assert np.abs(found.zeta / zeta - 1).max() < 0.15
    old = two_delays(record, columns=990)
    assert old.n_modes < 6 or np.abs(old.zeta / zeta - 1).max() > 1.0


def test_refusals(bar_modes):
    record = ring_down(bar_modes, 6, sample_time=0.01, n_samples=30)
    with pytest.raises(ValueError, match="measure longer"):
        two_delays(record)
    with pytest.raises(ValueError, match="Measure longer or ask for fewer"):
        stacked_delays(record, n_modes=20)
    for n_modes in (0, -1):
        with pytest.raises(ValueError, match=f"n_modes is a number of modes, 1 or more; got {n_modes}"):
            stacked_delays(record, n_modes=n_modes)
    for instants in ({"first": -3}, {"spacing": 0}):
        with pytest.raises(ValueError, match="the first instant is sample 0 or later"):
            two_delays(record, columns=12, **instants)
    short = replace(record.between(0.1, 0.29), name="short")
    with pytest.raises(ValueError, match="record 'short' has 20 samples and 25 delays were taken"):
        stacked_delays([record, short], n_modes=2, delays=25)
    with pytest.raises(ValueError, match="same outputs"):
        stacked_delays([record, record.select_outputs(["y1"])], n_modes=1)


def test_a_mode_beyond_half_the_sample_rate_is_named():
    modes = SampledModes(omega=[3.0, 40.0], zeta=[0.01, 0.01], shapes=np.ones((1, 2)), positions=[0.0])
    with pytest.raises(ValueError, match=r"mode 2 at .* Hz lies beyond half the sample rate"):
        free_decay(modes, sample_time=0.1, n_samples=100)
