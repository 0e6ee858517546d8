"""Results of design print as a line and a short table."""

import numpy as np

from workbench.design.estimation.observers import kalman_controller
from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import place_actuators, placement_task
from workbench.design.spillover.spillover import spillover
from workbench.rig.actuators import Actuator, piezo_patch
from workbench.rig.sensors import Sensor
from workbench.structure.member import Beam

MODES = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(5)
LAW = imsc(MODES, 2, [Actuator("F1", 3.0), Actuator("F2", 6.5)], weight=20.0)


def test_a_law_prints_its_gains_by_actuator():
    lines = str(LAW).splitlines()
    assert lines[0] == "IMSC, u = -K x: modes 1, 2 by 2 actuators"
    assert lines[1].split() == ["actuator", "position", "[m]", "q1", "q2", "q1'", "q2'"]
    assert lines[2].split()[:2] == ["F1", "3"]
    np.testing.assert_allclose([float(k) for k in lines[3].split()[2:]], LAW.gain[1], rtol=1e-3)
    assert repr(LAW) == f"<Law: {lines[0]}>" and "<th>q1&#x27;</th>" in LAW._repr_html_()


def test_a_law_of_patches_prints_both_ends():
    patched = imsc(MODES, 1, [piezo_patch("P1", 5.0, length=1.0)], weight=20.0)
    assert "5.5, 4.5" in str(patched) and "by 1 actuator\n" in str(patched)


def test_spillover_prints_the_work_in_every_mode():
    state = impulse_state(MODES, 6.3)
    state[7:] = 0.0
    found = spillover(MODES, LAW, state)
    lines = str(found).splitlines()
    assert lines[0].endswith(f"W_C = {found.controlled_work:.4g} J, W_R = {found.residual_work:.4g} J")
    assert lines[1].split() == ["mode", "W_r", "[J]"] and len(lines) == 2 + 5
    assert lines[-1].split() == ["5", "residual", f"{found.work_by_mode[4]:.4g}"]


def test_a_placement_prints_its_places_and_what_they_cost():
    task = placement_task(MODES, 2, impulse_at=6.3, weight=20.0)
    best = place_actuators(task, Limits(effort=1.0, spacing=0.5), starts=1)
    text = str(best)
    assert f"W_R = {best.residual_work:.4g} J, effort {best.effort:.4g} N² s" in text
    assert f"peak force {best.peak_force:.4g} N;" in text and "search: converged" in text
    assert "places: even" in str(task.placed([3.0, 6.5], "even")) and f"{best.positions[0]:.4g}" in text
    assert len(repr(best)) < 120


def test_a_loop_prints_its_poles_and_a_response_its_energies():
    sensors = [Sensor("y1", 2.0, "velocity")]
    loop = close_loop(MODES, kalman_controller(MODES, LAW, sensors, disturbance=1.0, noise=1e-3))
    lines = str(loop).splitlines()
    assert lines[0] == f"closed loop of 5 modes and 4 further states: {loop.stability_text}"
    assert "frequency [Hz]  damping ratio [%]" in lines[1]
    seen = np.array([line.split() for line in lines[2:]], float)
    pairs = loop.poles[loop.poles.imag >= 0]
    np.testing.assert_allclose(seen[:, 0], np.sort(np.abs(pairs)) / (2.0 * np.pi), rtol=1e-3)
    assert len(repr(loop)) < 120
    response = initial_response(loop, np.linspace(0.0, 2.0, 11), impulse_state(MODES, 6.3))
    lines = str(response).splitlines()
    assert lines[0] == "response of 5 modes with 2 actuators over 2 s, 11 instants"
    assert lines[2].split()[2] == f"{response.energy[0, 0]:.4g}" and len(lines) == 2 + 5 + 1
    assert len(repr(response)) < 120
