"""Work by mode: closed form, exact finite time, energy balance, and the modal filters behind it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm, solve_continuous_lyapunov

from workbench.design.estimation.modal_filter import displacement_filter, hermite_filter
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError, Law
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.spillover.spillover import effort, energy_gained, finite_spillover, quadratic_cost, spillover
from workbench.rig.actuators import Actuator
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.structure.plate import Plate

EDGES = {"left": "clamped", "right": "free", "bottom": "simply supported", "top": "free"}


def modes(n=9, **options):
    return Beam(
        length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged", **options
    ).modes(n)


def law(places=(1.5, 3.5, 6.5, 8.5), design=imsc, **options):
    return design(modes(**options), 4, [Actuator(f"F{i + 1}", x) for i, x in enumerate(places)], weight=20.0)


@pytest.mark.parametrize("design", [imsc, coupled_lqr])
@pytest.mark.parametrize("moving", [False, True])
def test_the_limit_is_the_limit_of_finite_times(design, moving):
    state = impulse_state(modes(), 6.3)
    if not moving:
        state[13:] = 0.0
    chosen = law(design=design)
    limit = spillover(modes(), chosen, state)
    late = finite_spillover(close_loop(modes(), chosen), state, 3000.0)
    np.testing.assert_allclose(late.work_by_mode, limit.work_by_mode, atol=1e-11)
    assert limit.total == pytest.approx(limit.controlled_work + limit.residual_work)


@pytest.mark.parametrize("filtered", [False, True])
def test_work_in_equals_energy_gained(filtered):
    state, chosen = impulse_state(modes(), 6.3), law()
    filter_ = hermite_filter(modes(4), np.linspace(0, 10, 6), 1.0) if filtered else None
    loop = close_loop(modes(), chosen, filter_)
    for final in (0.3, 7.0, 60.0):
        gained = energy_gained(loop, state, final)
        np.testing.assert_allclose(
            finite_spillover(loop, state, final).work_by_mode, gained, atol=1e-9 * np.abs(gained).max()
        )


def test_work_with_damping_against_quadrature():
    damped = modes(6, damping=ModalDamping(0.02))
    chosen = imsc(damped, 4, [Actuator(f"F{i}", x) for i, x in enumerate((2.0, 4.0, 6.0, 8.5))], weight=20.0)
    loop, state = close_loop(damped, chosen), impulse_state(damped, 6.3)
    b = damped.phi([2.0, 4.0, 6.0, 8.5]).T

    def power(t):
        x = initial_response(loop, [t], state).modal[:, 0]
        return (b @ (loop.feedback @ x)) * x[6:]

    work = quad_vec(power, 0.0, 12.0, epsabs=1e-11)[0]
    np.testing.assert_allclose(finite_spillover(loop, state, 12.0).work_by_mode, work, atol=1e-9)


def test_the_limit_needs_undamped_modes():
    damped = modes(damping=ModalDamping(0.01))
    with pytest.raises(DesignError, match="finite_spillover"):
        spillover(damped, law(damping=ModalDamping(0.01)), impulse_state(damped, 6.3))


def test_effort_and_cost_against_the_response():
    state, chosen = impulse_state(modes(), 6.3), law()
    time = np.linspace(0.0, 400.0, 40001)
    response = initial_response(close_loop(modes(), chosen), time, state)
    power = (response.forces**2).sum(axis=0)
    assert effort(modes(), chosen, state) == pytest.approx(np.trapezoid(power, time), rel=1e-4)
    q, v = response.modal[:4], response.modal[9:13]
    running = (v**2 + (modes().omega[:4, None] * q) ** 2).sum(axis=0) + 20.0 * power
    assert quadratic_cost(modes(), chosen, state, 20.0) == pytest.approx(np.trapezoid(running, time), rel=1e-4)


def test_lqr_is_cheapest_on_its_own_yardstick():
    state = impulse_state(modes(), 6.3)
    imsc_cost = quadratic_cost(modes(), law(), state, 20.0)
    assert quadratic_cost(modes(), law(design=coupled_lqr), state, 20.0) <= imsc_cost * (1 + 1e-9)


def test_filter_weights_converge_with_the_fourth_power():
    errors = []
    for k in (9, 17, 33):
        seen = hermite_filter(modes(4), np.linspace(0, 10, k), 1.0).response_to(modes(4))
        errors.append(np.abs(seen - np.eye(4)).max())
    slopes = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (slopes > 3.7).all() and errors[-1] < 1e-4


def test_filter_with_uneven_sensors_and_uneven_mass():
    beam = Beam(length=4.0, mass_per_length=lambda x: 2 - 0.3 * x, bending_stiffness=1.0, left="clamped", right="free")
    found = beam.modes(3)
    uneven = 4 * np.sort(np.r_[0, 1, np.random.default_rng(0).uniform(0, 1, 30)])
    seen = hermite_filter(found, uneven, lambda x: 2 - 0.3 * x).response_to(found)
    assert np.abs(seen - np.eye(3)).max() < 1e-3
    alone = displacement_filter(found, np.linspace(0.1, 4.0, 16), lambda x: 2 - 0.3 * x).response_to(found)
    assert np.abs(alone - np.eye(3)).max() < 1e-3


def test_filter_refuses_sensors_out_of_order():
    with pytest.raises(ValueError, match="increasing"):
        hermite_filter(modes(2), [0.0, 5.0, 3.0], 1.0)


def test_a_loop_through_sensors_that_cannot_see_a_mode_names_it():
    found = modes(2)
    filter_ = displacement_filter(found, [5.0], 1.0)
    assert abs(filter_.response_to(found)[1, 1]) < 1e-12
    law = imsc(found, 2, [Actuator("a", 2.0), Actuator("b", 3.0)], weight=1.0)
    with pytest.raises(ValueError, match="mode 2 is unobservable"):
        close_loop(found, law, filter_)


def test_work_on_a_plate_against_quadrature_of_the_closed_loop():
    plate = Plate(length=(1.2, 0.8), mass_per_area=7.8, bending_stiffness=18.3, poisson_ratio=0.3, edges=EDGES)
    panel, struck = plate.modes(6), (0.83, 0.31)
    places = np.array([(0.33, 0.22), (0.87, 0.55), (0.58, 0.43)])
    chosen = imsc(panel, 3, [Actuator(f"F{i}", tuple(at)) for i, at in enumerate(places)], weight=1e-2)
    loop, state = close_loop(panel, chosen), impulse_state(panel, struck)
    plant = np.block([[np.zeros((6, 6)), np.eye(6)], [-np.diag(panel.omega**2), np.zeros((6, 6))]])
    fed = np.vstack([np.zeros((6, 3)), panel.phi(places).T]) @ loop.feedback

    def power(t):  # the motion by scipy's matrix exponential, apart from what computes the work
        x = expm((plant + fed) * t) @ state
        return (fed @ x)[9:] * x[9:]

    work = quad_vec(power, 0.0, 3.0, epsabs=0.0, epsrel=1e-11)[0]
    np.testing.assert_allclose(finite_spillover(loop, state, 3.0).work_by_mode[3:], work, rtol=1e-8)


GYROSCOPIC = np.array([[0.0, 0.3, 0.0], [-0.3, 0.0, 0.2], [0.0, -0.2, 0.0]])
LOCAL = 0.2 * np.outer([0.6, 0.9, 0.5], [0.6, 0.9, 0.5]) + 0.01 * np.eye(3)


@pytest.mark.parametrize("damping", [0.1 * GYROSCOPIC + 0.02 * np.eye(3), LOCAL], ids=["gyroscopic", "local damper"])
def test_effort_and_cost_count_what_damping_between_modes_brings(damping):
    """Against the Lyapunov equation of the whole plant."""
    coupled = replace(modes(3), damping=damping)
    actuators = [Actuator("F1", 2.0), Actuator("F2", 4.5)]
    chosen, state = imsc(coupled, 2, actuators, weight=20.0), np.array([0, 0, 0, 1.0, 0.5, 0.3])
    b = np.vstack([np.zeros((3, 2)), coupled.phi([2.0, 4.5]).T])
    gain = np.zeros((2, 6))
    gain[:, [0, 1, 3, 4]] = chosen.gain
    a = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.diag(coupled.omega**2), -damping]])
    gramian = solve_continuous_lyapunov(a - b @ gain, -np.outer(state, state))
    weighed = np.diag([*coupled.omega[:2] ** 2, 0.0, 1.0, 1.0, 0.0]) + 20.0 * gain.T @ gain
    assert effort(coupled, chosen, state) == pytest.approx(np.trace(gain @ gramian @ gain.T), rel=1e-9)
    assert quadratic_cost(coupled, chosen, state, 20.0) == pytest.approx(np.trace(weighed @ gramian), rel=1e-9)


def test_gyroscopic_modes_are_refused_where_work_stays_in_no_mode():
    spun = replace(modes(3), damping=GYROSCOPIC)
    chosen = imsc(spun, 2, [Actuator("F1", 2.0), Actuator("F2", 4.5)], weight=20.0)
    with pytest.raises(DesignError, match="no longer the energy left in a mode"):
        spillover(spun, chosen, impulse_state(spun, 6.3))


def test_a_law_that_settles_nothing_costs_without_end():
    idle = Law(np.zeros((1, 4)), (0, 1), (Actuator("F", 2.0),))
    assert quadratic_cost(modes(3), idle, impulse_state(modes(3), 6.3), 1.0) == np.inf
