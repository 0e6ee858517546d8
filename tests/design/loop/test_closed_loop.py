"""The closed loop of all modes as python-control's model, and what its poles say of its stability."""

import control
import numpy as np
import pytest

from workbench.design.estimation.observers import kalman_controller
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc, imsc_poles
from workbench.design.loop.closed_loop import close_loop, close_with, initial_response
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


def free(**options):
    return Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="free", right="free", **options).modes(4)


def displacement_after(loop, time):
    """Largest modal displacement at a late time, from rates alone."""
    n = loop.modes.n_modes
    return np.abs(initial_response(loop, [time], np.r_[np.zeros(n), np.ones(n)]).modal[:n]).max()


def test_a_rigid_body_mode_without_control_drifts():
    modes = free()
    assert (modes.omega[:2] == 0).all()
    held = imsc_poles(modes, [0, 2], [Actuator("F1", 1.0), Actuator("F2", 4.1)], poles=[-0.1 + 0.1j, -0.2 + 0.5j])
    loop = close_loop(modes, held)
    assert loop.stability == "unstable: a rigid-body mode drifts" and not loop.stable and not loop.unstable_poles.size
    assert displacement_after(loop, 2e5) == pytest.approx(2.0 * displacement_after(loop, 1e5), rel=1e-3)


@pytest.mark.parametrize("ratio", [0.0, 0.01])
def test_a_rigid_body_mode_whose_rate_is_fed_back_keeps_its_displacement(ratio):
    """A single pole at zero: the law that minimises energies acts on the rate alone."""
    modes = free(damping=ModalDamping(ratio))
    loop = close_loop(modes, imsc(modes, 2, [Actuator("F1", 1.0), Actuator("F2", 7.3)], weight=1.0))
    assert loop.stability == "marginally stable" and not loop.stable and not loop.unstable_poles.size
    assert displacement_after(loop, 2e5) < 2.0 * displacement_after(loop, 1e5) < 100.0


@pytest.mark.parametrize(("ratio", "word"), [(0.0, "marginally stable"), (0.01, "stable")])
def test_an_undamped_residual_mode_is_marginally_stable(ratio, word):
    modes = Beam(
        length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged",
        damping=ModalDamping(ratio),
    ).modes(4)  # fmt: skip
    loop = close_loop(modes, imsc(modes, 2, [Actuator("F1", 3.0), Actuator("F2", 4.4)], weight=1.0))
    assert loop.stability == word and loop.stable is (word == "stable") and not loop.unstable_poles.size


def test_a_loop_destabilised_has_unstable_poles():
    modes = hinged()
    law = imsc_poles(modes, [0], [Actuator("F1", 3.0)], poles=[-0.1 + 0.1j])
    backwards = close_loop(modes, type(law)(-5.0 * law.gain, law.controlled, law.actuators))
    assert backwards.stability == "unstable" and (backwards.unstable_poles.real > 0.01).all()
    assert backwards.unstable_poles.size


@pytest.mark.parametrize("quantity", ["displacement", "velocity"])
def test_a_rigid_body_mode_that_an_observer_of_others_reads(quantity):
    """Through displacements the controller acts on the rigid-body modes; velocities leave one pole of each at zero."""
    modes = free(damping=ModalDamping(0.01))
    law = coupled_lqr(modes, [2], [Actuator("F1", 0.0)], weight=1.0)
    loop = close_with(modes, kalman_controller(modes, law, [Sensor("y", 0.0, quantity)], disturbance=1.0, noise=0.1))
    growth = np.linalg.norm(np.linalg.matrix_power(control.c2d(loop.state_space(), 10.0).A, 4000), 2)
    assert loop.stability.startswith("unstable") == (growth > 1e4)
