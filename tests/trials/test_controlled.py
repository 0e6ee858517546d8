"""A plant of finite elements under a digital controller, against the rig of exact modes under the same."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from workbench.design.estimation.digital import sampled
from workbench.design.estimation.observers import kalman_controller
from workbench.design.laws.imsc import imsc
from workbench.design.loop.rig_loop import LoopTest, run_loop
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.trials.controlled import PlantResponse, control_plant
from workbench.trials.plant import Plant

DT = 0.01
DRIVES = {
    "plain": {},
    "late and slow": {"delay": 1.3 * DT, "time_constant": 0.02},
}


@pytest.mark.parametrize("drive", DRIVES)
def test_two_numerical_routes_agree_on_a_controlled_structure(hinged_beam, drive):
    sensors = (Sensor("d1", 0.3, delay=0.4 * DT), Sensor("d2", 0.9, gain=1.1), Sensor("v1", 1.4, "velocity", bias=0.02))
    inputs = (Actuator("F1", 0.45), Actuator("F2", 1.2), Actuator("hammer", 0.8, direct=True))
    rig = Rig(
        hinged_beam.modes(4),
        inputs,
        tuple(replace(s, delay=0.0, gain=1.0, bias=0.0) for s in sensors),
        structure=hinged_beam,
    )
    law = imsc(rig.modes, 2, inputs[:2], weight=0.05)
    controller = sampled(kalman_controller(rig.modes, law, rig.sensors, disturbance=1.0, noise=1e-3), DT)
    real = replace(rig, sensors=sensors, actuators=(*(replace(a, **DRIVES[drive]) for a in inputs[:2]), inputs[2]))
    expected = run_loop(real, controller, LoopTest(300, DT, impulse_at=0.8), substeps=20)
    plant = Plant(rig, real.actuators, sensors, 4).solved()
    found = control_plant(plant, controller, n_samples=300, impulse_input="hammer")
    energy = expected.response.energy.sum(axis=0)
    assert found.bounded and found.stable
    assert found.energy == pytest.approx(energy, abs=5e-3 * energy.max())
    assert found.modal_energy == pytest.approx(expected.response.energy, abs=5e-3 * energy.max())
    # the rig's work is by the mean force over each sample, which a late or slow force is not
    off = 1e-2 if "late" not in drive else 5e-2
    assert found.work == pytest.approx(expected.work, abs=off * np.abs(expected.work).max())
    if drive == "plain":
        assert found.peak_force == pytest.approx(np.abs(expected.response.forces).max(), rel=0.05)
        assert found.effort == pytest.approx(expected.effort, rel=0.02)


@pytest.mark.parametrize("modes", [1, 2, None])
def test_a_loop_settles_when_its_energy_stays_below_a_hundredth_of_its_peak(modes):
    # the second mode holds little and decays slowly: it is what is left in the end
    def energies(time):
        return np.array([np.exp(-2.0 * time), 0.05 * np.exp(-0.5 * time)])

    run = PlantResponse(energies(DT * np.arange(1000)), np.zeros(2), 0.0, 0.0, True, DT, np.zeros((1, 1000)))
    peak = energies(0.0)[:modes].sum()
    settled = brentq(lambda time: energies(time)[:modes].sum() - 0.01 * peak, 0.0, 10.0)
    assert settled <= run.settling(modes) <= settled + 1.01 * DT


def test_a_loop_that_still_swings_when_the_test_ends_has_no_settling_time():
    energy = np.ones((1, 100))
    assert PlantResponse(energy, np.zeros(1), 0.0, 0.0, True, DT, np.zeros((1, 100))).settling() is None
