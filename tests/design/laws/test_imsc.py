"""Closed-form laws against python-control, and the refusals of a design that cannot be."""

from dataclasses import replace

import control
import numpy as np
import pytest

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import hermite_filter
from workbench.design.estimation.observers import kalman_controller, luenberger_controller
from workbench.design.export.export import export
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc, imsc_poles, pole_gains, riccati_gains, riccati_matrices
from workbench.design.laws.law import DesignError, Law
from workbench.design.laws.on_off import on_off
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.spillover.explain import explain_spillover
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.structure.plate import Plate


def modes(n=9, **options):
    return Beam(
        length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged", **options
    ).modes(n)


def actuators(*places):
    return [Actuator(f"F{i + 1}", x) for i, x in enumerate(places)]


def relay():
    return on_off(modes(), 1, actuators(2.0), force=1.0, dead_band=0.1)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_riccati_closed_form_over_five_decades(damping):
    for omega in np.geomspace(1e-2, 1e3, 11):
        for weight in np.geomspace(1e-3, 1e2, 11):
            p = riccati_matrices(np.array([omega]), weight, damping)[0]
            a, b = np.array([[0, 1], [-(omega**2), -damping]]), np.array([[0.0], [1.0]])
            q = np.diag([omega**2, 1.0])
            terms = (a.T @ p, p @ a, -p @ b @ b.T @ p / weight, q)
            size = np.max([np.abs(t) for t in terms], axis=0)
            assert (np.abs(sum(terms))[size > 0] <= 1e-12 * size[size > 0]).all()


def test_gains_equal_lqr_mode_by_mode():
    for omega in np.geomspace(1e-2, 1e2, 9):
        for weight in np.geomspace(1e-2, 1e2, 5):
            a, q = np.array([[0, 1], [-(omega**2), -0.1]]), np.diag([omega**2, 1.0])
            peer = control.lqr(a, [[0.0], [1.0]], q, [[weight]])[0][0]
            mine = np.ravel(riccati_gains(omega, weight, 0.1))
            np.testing.assert_allclose(mine, peer, rtol=1e-8, atol=1e-8 * np.abs(peer).max())


def test_poles_are_where_they_were_asked():
    wanted = np.array([-0.3 + 0.9j, -0.5 + 1.5j])
    law = imsc_poles(modes(2), 2, actuators(3.0, 6.0), poles=wanted)
    poles = close_loop(modes(2), law).poles
    np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(np.r_[wanted, wanted.conj()]), atol=1e-9)


def test_imsc_is_coupled_lqr_where_b_is_orthogonal():
    places = actuators(2.0, 4.0, 6.0, 8.0)
    np.testing.assert_allclose(
        imsc(modes(), 4, places, weight=20.0).gain, coupled_lqr(modes(), 4, places, weight=10.0).gain, atol=1e-8
    )


def test_damped_modes_are_designed_with_their_damping():
    damped = modes(4, damping=ModalDamping(0.05))
    law = imsc(damped, 4, actuators(2.0, 4.0, 6.0, 8.0), weight=20.0)
    b = damped.phi([2.0, 4.0, 6.0, 8.0]).T
    a = np.block([[np.zeros((4, 4)), np.eye(4)], [-np.diag(damped.omega**2), -damped.damping]])
    peer = control.lqr(
        a, np.vstack([np.zeros((4, 4)), np.eye(4)]), np.diag([*damped.omega**2, 1, 1, 1, 1]), 20 * np.eye(4)
    )[0]
    np.testing.assert_allclose(b @ law.gain, peer, atol=1e-8)


def test_response_against_python_control():
    law = imsc(modes(), 4, actuators(1.5, 3.5, 6.5, 8.5), weight=20.0)
    loop, state, time = close_loop(modes(), law), impulse_state(modes(), 6.3), np.linspace(0, 40, 81)
    system = control.ss(loop.matrix, np.zeros((18, 1)), np.eye(18), np.zeros((18, 1)))
    peer = control.initial_response(system, time, state).outputs
    assert np.abs(initial_response(loop, time, state).modal - peer).max() < 1e-9


def test_response_at_uneven_times_is_the_same_response():
    law = imsc(modes(), 4, actuators(2.0, 4.0, 6.0, 8.0), weight=20.0)
    loop, state = close_loop(modes(), law), impulse_state(modes(), 6.3)
    even, uneven = (
        initial_response(loop, [0.0, 1.0, 2.0, 3.0], state),
        initial_response(loop, [0.0, 0.7, 2.0, 3.0], state),
    )
    np.testing.assert_allclose(even.modal[:, 2:], uneven.modal[:, 2:], atol=1e-12)
    many = np.linspace(2.0, 40.0, 317)
    many, some = initial_response(loop, many, state), initial_response(loop, many[[0, 3, 90, 316]], state)
    np.testing.assert_allclose(many.modal[:, [0, 3, 90, 316]], some.modal, atol=1e-12)
    assert not many.modal.flags.writeable and state.flags.writeable


def test_a_state_of_another_size_starts_no_response():
    loop = close_loop(modes(), imsc(modes(), 2, actuators(2.0, 4.0), weight=1.0))
    for state in (np.zeros(3), np.full(18, np.nan)):
        with pytest.raises(ValueError, match=r"the state must be finite, \(18,\) of the modes; got"):
            initial_response(loop, [0.0, 1.0], state)


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda: imsc(modes(), 2, actuators(2.0, 2.0), weight=1.0), "F1 and F2 are both at x = 2"),
        (lambda: imsc(modes(), 1, actuators(0.0), weight=1.0), "is on the support"),
        (lambda: imsc(modes(), 3, actuators(2.0, 4.0), weight=1.0), "3 controlled modes need as many actuators"),
        (lambda: imsc(modes(), 2, actuators(5.0, 1.0), weight=-1.0), "weight R must be positive"),
        (lambda: imsc_poles(modes(), 1, actuators(2.0), poles=[0.1 + 1j]), "not stable"),
        (lambda: pole_gains([1.0, 2.0], [-1.0]), "one pole per mode"),
        (lambda: imsc(modes(), [1], actuators(5.0), weight=1.0), "mode 2 is uncontrollable"),
        (lambda: imsc(modes(), [11], actuators(5.0), weight=1.0), "not distinct modes"),
        (lambda: coupled_lqr(modes(), 2, actuators(2.0, 3.0), weight=[1.0, -1.0]), "positive definite"),
        (lambda: coupled_lqr(modes(), 2, actuators(2.0, 3.0), weight=np.nan), "positive definite"),
        (lambda: coupled_lqr(modes(), 2, actuators(2.0, 3.0), weight=[[1, 0.5], [0, 1]]), "symmetric"),
        (lambda: imsc(modes(), np.int64(11), actuators(2.0), weight=1.0), "controlled modes is 1 to 9, .*; got 11"),
        (lambda: imsc_poles(modes(), 1, actuators(2.0), poles=[np.nan]), "nan.* is not stable"),
        (
            lambda: on_off(modes(), 2, actuators(2.0, 3.0), force=[1, 2, 3], dead_band=0.1),
            "force is one .*mode, 2; got 3",
        ),
        (
            lambda: kalman_controller(modes(), relay(), [Sensor("y", 3.0)], disturbance=1, noise=1),
            "on-off, which has no gain",
        ),
        (
            lambda: luenberger_controller(modes(), relay(), [Sensor("y", 3.0)], poles=[-1 + 1j]),
            "on-off, which has no gain",
        ),
        (lambda: filtered(relay(), hermite_filter(modes(1), [1.0, 8.0], 1.0)), "on-off, which has no gain"),
        (lambda: close_loop(modes(), relay()), "on-off, which has no gain"),
        (lambda: explain_spillover(modes(), relay()), "on-off, which has no gain"),
        (lambda: close_loop(modes(1), imsc(modes(), 2, actuators(2.0, 3.0), weight=1.0)), "mode 2 .*has 1 mode;"),
        (lambda: export(modes(), relay(), sample_rate_hz=100.0), "switches.*redesign"),
    ],
)
def test_designs_that_cannot_be_are_refused(act, words):
    with pytest.raises(ValueError, match=words):
        act()


def test_errors_of_design_have_one_type():
    with pytest.raises(DesignError):
        imsc(modes(), 3, actuators(2.0), weight=1.0)


@pytest.mark.parametrize("places", [(2.0, 2.0), (2.0, 8.0)])
def test_a_regulator_takes_actuators_that_act_alike(places):
    """Two at one place share the force of one; of two that are symmetric modes 1 and 3 know no difference either."""
    alone = coupled_lqr(modes(), [0, 2], actuators(2.0), weight=2.0)
    both = coupled_lqr(modes(), [0, 2], actuators(*places), weight=4.0)
    np.testing.assert_allclose(both.gain, 0.5 * np.vstack([alone.gain, alone.gain]), rtol=1e-6, atol=1e-8)
    assert imsc(modes(), 1, actuators(*places), weight=1.0).gain == pytest.approx(
        0.5 * np.vstack([imsc(modes(), 1, actuators(2.0), weight=1.0).gain] * 2)
    )


def test_units_of_a_command_decide_no_design():
    alike = actuators(2.0, 4.5)
    small = [alike[0], replace(alike[1], gain=1e-9)]
    for one, other in (
        (coupled_lqr(modes(), 2, alike, weight=1.0), coupled_lqr(modes(), 2, small, weight=[1.0, 1e-18])),
        (imsc(modes(), 2, alike, weight=1.0), imsc(modes(), 2, small, weight=1.0)),
    ):
        np.testing.assert_allclose(other.gain * [[1.0], [1e-9]], one.gain, rtol=1e-6, atol=1e-9)
    # a place is no matter of units: beside the support an actuator hardly acts on any mode
    with pytest.raises(DesignError, match="singular"):
        imsc(modes(), 2, actuators(1e-5, 1e-4), weight=1.0)


@pytest.mark.parametrize("count", [1, 2])
def test_two_modes_of_one_frequency_take_two_places(count):
    edges = dict.fromkeys(("left", "right", "bottom", "top"), "simply supported")
    plate = Plate(length=(1.0, 1.0), mass_per_area=1.0, bending_stiffness=1.0, poisson_ratio=0.3, edges=edges).modes(3)
    with pytest.raises(DesignError, match="cannot all be stabilised"):
        coupled_lqr(plate, 3, [Actuator(f"F{i}", (0.3, 0.2)) for i in range(count)], weight=1.0)


@pytest.mark.parametrize("gain", [1e-12, 1.0])
def test_a_mode_nobody_moves_is_told_whatever_the_units(gain):
    weak = [Actuator("F1", 5.0, gain=gain), Actuator("F2", 3.0, gain=gain)]
    assert imsc(modes(), 2, weak, weight=1.0).gain.shape == (2, 4)
    with pytest.raises(DesignError, match="mode 2 is uncontrollable"):
        imsc(modes(), [1], weak[:1], weight=1.0)


@pytest.mark.parametrize(
    ("gain", "controlled", "words"),
    [
        (np.ones((2, 4)), (-1, 0), "a mode counted from zero, is a whole number, 0 or more; got -1"),
        (np.ones((2, 4)), (0, 1.5), "is a whole number, 0 or more; got 1.5"),
        (np.ones((2, 4)), (0, 0), r"one mode or more, each once; got \[0, 0\]"),
        (np.ones((2, 0)), (), r"one mode or more, each once; got \[\]"),
        (np.full((2, 4), np.nan), (0, 1), "Law.gain must be finite; got nan"),
    ],
)
def test_a_law_by_hand_that_cannot_be_is_refused(gain, controlled, words):
    with pytest.raises(ValueError, match=words):
        Law(gain, controlled, (Actuator("a", 2.5), Actuator("b", 7.2)))


def test_a_closed_loop_cannot_be_written_to():
    loop = close_loop(modes(4), imsc(modes(4), 2, (Actuator("a", 2.5), Actuator("b", 7.2)), weight=1.0))
    for array in (loop.matrix, loop.feedback):
        with pytest.raises(ValueError, match="read-only"):
            array *= 0.5


def test_poles_are_those_asked_for_where_damping_couples_the_modes():
    coupled = np.array([[0.02, 0.3], [-0.3, 0.05]])  # a damper and a spinning part
    two = replace(modes(2), damping=coupled)
    asked = np.array([-0.05 + 0.1j, -0.1 + 0.5j])
    found = close_loop(two, imsc_poles(two, 2, actuators(2.0, 4.0), poles=asked)).poles
    np.testing.assert_allclose(np.sort_complex(found[found.imag > 0]), np.sort_complex(asked), atol=1e-9)
