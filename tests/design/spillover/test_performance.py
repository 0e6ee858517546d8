"""One motion judged: its figures against python-control's simulation of the same loop."""

import control
import numpy as np
import pytest
from scipy.integrate import simpson

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import displacement_filter
from workbench.design.estimation.observers import kalman_controller
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError
from workbench.design.laws.on_off import on_off
from workbench.design.loop.closed_loop import close_loop, close_with, impulse_state
from workbench.design.loop.on_off_response import respond_on_off
from workbench.design.spillover.performance import on_off_performance, performance
from workbench.design.spillover.spillover import effort, quadratic_cost
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam

MODES = Beam(
    length=10.0,
    mass_per_length=1.0,
    bending_stiffness=1.0,
    left="clamped",
    right="hinged",
    damping=ModalDamping(0.01),
).modes(6)
ACTUATORS = [Actuator(f"F{i + 1}", x) for i, x in enumerate((3.0, 6.0))]
LAW = imsc(MODES, 2, ACTUATORS, weight=100.0)
STATE = np.r_[np.zeros(6), impulse_state(MODES, 6.3)[6:8], np.zeros(4)]


def test_figures_of_a_loop_with_an_observer_are_those_of_its_motion():
    sensors = [Sensor("a", 2.2), Sensor("b", 7.1)]
    controller = kalman_controller(MODES, LAW, sensors, disturbance=1.0, noise=0.1)
    told = performance(close_with(MODES, controller), STATE, weight=3.0, final_time=40.0)
    shapes = MODES.phi([a.at for a in ACTUATORS]).T
    seen = np.hstack([MODES.phi([s.at for s in sensors]), np.zeros((2, 6))])
    plant = np.block([[np.zeros((6, 6)), np.eye(6)], [-np.diag(MODES.omega**2), -MODES.damping]])
    push = np.vstack([np.zeros((6, 2)), shapes])
    loop = np.block([[plant, push @ controller.C], [controller.B @ seen, controller.A]])
    time = np.linspace(0.0, 40.0, 40_001)
    start = np.r_[STATE, np.zeros(4)]
    motion = control.initial_response(control.ss(loop, np.zeros((16, 1)), np.eye(16), 0), time, start).outputs
    forces = controller.C @ motion[12:]
    energy = (MODES.omega[:2, None] * motion[:2]) ** 2 + motion[6:8] ** 2
    spent = simpson((forces**2).sum(axis=0), x=time)
    assert told.effort == pytest.approx(spent, rel=1e-6)
    assert told.cost == pytest.approx(simpson(energy.sum(axis=0), x=time) + 3.0 * spent, rel=1e-6)
    assert told.spillover == pytest.approx(
        simpson(((shapes @ forces)[2:] * motion[8:12]).sum(axis=0), x=time), rel=1e-5
    )
    assert told.decay_rate == pytest.approx(-np.linalg.eigvals(loop).real.max())


def test_in_the_long_run_the_figures_are_those_of_the_lyapunov_equation():
    told = performance(close_loop(MODES, LAW), STATE, weight=3.0, final_time=2000.0)
    assert told.cost == pytest.approx(quadratic_cost(MODES, LAW, STATE, 3.0))
    assert told.effort == pytest.approx(effort(MODES, LAW, STATE))


def test_a_loop_that_is_unstable_has_no_figures():
    strong = coupled_lqr(MODES, 2, ACTUATORS, weight=1e-4)
    told = performance(
        close_with(MODES, filtered(strong, displacement_filter(MODES.select([0, 1]), [9.0], 1.0))),
        STATE,
        weight=1.0,
        final_time=10.0,
    )
    assert told.decay_rate < 0 and np.isinf([told.cost, told.effort, told.spillover]).all()
    with pytest.raises(DesignError, match="final time must be positive and finite; got inf"):
        performance(close_loop(MODES, LAW), STATE, weight=1.0, final_time=np.inf)


def test_effort_of_a_relay_is_that_of_its_segments_over_a_long_time():
    relay = on_off(MODES, 1, ACTUATORS[:1], force=0.002, dead_band=0.01)
    told = on_off_performance(MODES, relay, STATE, weight=3.0, final_time=4000.0)
    (segments,) = respond_on_off(MODES, relay, STATE, [0.0, 4000.0]).segments
    each = [(s.end - s.start, s.steady, s.ramp) for s in segments]
    squared = sum(force**2 * t + force * ramp * t**2 + ramp**2 * t**3 / 3.0 for t, force, ramp in each)
    assert len(segments) > 20 and not any(s.fading for s in segments)
    assert told.effort == pytest.approx(squared / MODES.phi(3.0)[0, 0] ** 2, rel=1e-9)


def test_an_idle_relay_leaves_the_energy_of_free_decay():
    relay = on_off(MODES, 2, ACTUATORS, force=1.0, dead_band=1e3)
    told = on_off_performance(MODES, relay, STATE, weight=3.0, final_time=40.0)
    time = np.linspace(0.0, 40.0, 40_001)
    plant = np.block([[np.zeros((6, 6)), np.eye(6)], [-np.diag(MODES.omega**2), -MODES.damping]])
    motion = control.initial_response(control.ss(plant, np.zeros((12, 1)), np.eye(12), 0), time, STATE).outputs
    energy = ((MODES.omega[:2, None] * motion[:2]) ** 2 + motion[6:8] ** 2).sum(axis=0)
    assert told.cost == pytest.approx(simpson(energy, x=time), rel=1e-6)
    assert told.effort == 0.0 and told.spillover == 0.0
