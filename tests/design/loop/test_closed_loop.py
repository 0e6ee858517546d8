"""The closed loop of all modes as python-control's model, and what its poles say of its stability."""

import control
import numpy as np

from workbench.design.estimation.observers import kalman_controller
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.loop.closed_loop import close_with, initial_response
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.rig.statespace import input_matrix, output_matrix
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam


def hinged():
    return Beam(
        length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged",
        damping=ModalDamping(0.01),
    ).modes(4)  # fmt: skip


def observed(modes):
    law = coupled_lqr(modes, 2, [Actuator("F1", 3.0), Actuator("F2", 4.4)], weight=1.0)
    return kalman_controller(modes, law, [Sensor("y", 6.1), Sensor("v", 2.2, "velocity")], disturbance=1.0, noise=0.1)


def test_the_loop_is_a_state_space_from_modal_forces_to_motion_and_actuator_forces():
    """With the dynamic stiffness Z(s) of the modes, Z q = f + B u and u = C(s) R (q, s q)."""
    modes = hinged()
    controller = observed(modes)
    loop = close_with(modes, controller).state_space()
    assert loop.input_labels == ["f1", "f2", "f3", "f4"] and loop.output_labels[-3:] == ["dq4", "F1", "F2"]
    rows, b = output_matrix(modes, controller.sensors), input_matrix(modes, controller.law.actuators)
    for s in (0.3j, 1.7j, 0.2 + 0.9j):
        dynamic = s**2 * np.eye(4) + s * modes.damping + np.diag(modes.omega**2)
        forces = controller.state_space()(s) @ (rows * np.array([[1.0], [s]]))  # per modal displacement
        q = np.linalg.inv(dynamic - b @ forces)
        np.testing.assert_allclose(loop(s), np.vstack([q, s * q, forces @ q]), atol=1e-10)


def test_its_free_response_is_that_of_python_control():
    modes = hinged()
    loop, time, state = close_with(modes, observed(modes)), np.linspace(0.0, 20.0, 101), np.arange(8.0) - 3.0
    peer = control.initial_response(loop.state_space(), time, loop.start(state)).outputs
    mine = initial_response(loop, time, state)
    np.testing.assert_allclose(peer, np.vstack([mine.modal, mine.forces]), atol=1e-9)
