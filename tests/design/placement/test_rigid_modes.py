"""A beam that hangs free: its rigid modes are brought to rest wherever they are, and every figure stays finite."""

import control
import numpy as np
import pytest

from workbench.design.estimation.observers import kalman_controller, luenberger_controller
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc, riccati_gains
from workbench.design.laws.law import DesignError
from workbench.design.loop.closed_loop import impulse_state
from workbench.design.placement.certificate import certify
from workbench.design.placement.coupled_placement import coupled_batch, coupled_costs, place_coupled
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import place_actuators, placement_task
from workbench.design.spillover.spillover import distributed_cost, effort, modal_cost, spillover
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.member import Beam

AT, PLACES = 6.3, (0.5, 4.4, 6.8)


@pytest.fixture(scope="module")
def modes():
    return Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="free", right="free").modes(8)


@pytest.fixture(scope="module")
def task(modes):
    return placement_task(modes, 3, impulse_at=AT, weight=20.0)


def after_an_impulse(modes, law):
    """By python-control: W_R, effort and peak force, of three controlled modes that the impulse moves alone."""
    n, index = modes.n_modes, list(law.controlled)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(modes.omega**2), np.zeros((n, n))]])
    b = np.vstack([np.zeros((n, len(law.actuators))), modes.phi([actuator.at for actuator in law.actuators]).T])
    gain = np.zeros((len(law.actuators), 2 * n))
    gain[:, [*index, *(n + r for r in index)]] = law.gain
    loop = control.ss(a - b @ gain, b, gain, 0)
    start = np.r_[np.zeros(n), np.where(np.isin(np.arange(n), index), modes.phi(AT)[0], 0.0)]
    response = control.initial_response(loop, np.linspace(0.0, 150.0, 60_001), start)
    q, rate = np.split(np.asarray(response.states)[:, -1], 2)
    energies = 0.5 * (rate**2 + modes.omega**2 * q**2)
    forces = np.asarray(response.outputs)
    return np.delete(energies, index).sum(), np.trapezoid((forces**2).sum(axis=0), response.time), np.abs(forces).max()


def test_one_rigid_mode_takes_the_momentum_of_the_impulse(modes):
    """F = -g2 v e^{-g2 t} / φ1, so that the other rigid mode gains ½ (φ2 v / φ1)²."""
    x, (_, g2) = 6.0, riccati_gains(0.0, 20.0)
    at, v = modes.phi(x)[0], modes.phi(AT)[0, 0]
    found = placement_task(modes, 1, impulse_at=AT, weight=20.0).placed([x], "")
    assert found.peak_force == pytest.approx(abs(g2 * v / at[0]), rel=2e-6)
    assert found.effort == pytest.approx(g2 * v**2 / at[0] ** 2 / 2.0, rel=1e-12)
    assert found.residual_work_by_mode[0] == pytest.approx(0.5 * (at[1] * v / at[0]) ** 2, rel=1e-12)


def test_figures_are_those_of_the_motion(modes, task):
    found = task.placed(PLACES, "")
    work, spent, peak = after_an_impulse(modes, found.law)
    assert found.residual_work == pytest.approx(work, rel=1e-4)
    assert found.effort == pytest.approx(spent, rel=1e-4)
    assert found.peak_force == pytest.approx(peak, rel=1e-5)
    state = impulse_state(modes, AT)
    state[8 + 3 :] = 0.0
    np.testing.assert_allclose(
        spillover(modes, found.law, state).residual_work_by_mode, found.residual_work_by_mode, rtol=1e-9
    )
    assert effort(modes, found.law, state) == pytest.approx(found.effort, rel=1e-9)
    assert modal_cost(modes, found.law, state, 20.0) == pytest.approx(distributed_cost(modes, 3, state, 20.0), rel=1e-9)


def test_limits_on_effort_and_force_are_kept_and_the_optimum_is_proven(modes, task):
    even = task.placed([2.5, 5.0, 7.5], "")
    limits = Limits(effort=1.2 * even.effort, peak_force=1.2 * even.peak_force, spacing=0.5)
    best = place_actuators(task, limits)
    assert limits.satisfied_by(best) and best.residual_work < even.residual_work
    assert after_an_impulse(modes, best.law)[2] <= limits.peak_force * (1.0 + 1e-5)
    assert certify(task, limits, placement=best, gap=0.05).complete


def test_coupled_lqr_is_the_limit_of_a_vanishing_weight_on_where_the_structure_rests(modes):
    actuators = [Actuator(f"F{i + 1}", x) for i, x in enumerate(PLACES)]
    law = coupled_lqr(modes, 3, actuators, weight=10.0)
    a = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.diag(modes.omega[:3] ** 2), np.zeros((3, 3))]])
    b = np.vstack([np.zeros((3, 3)), modes.phi(PLACES).T[:3]])
    costs = np.diag(np.r_[modes.omega[:3] ** 2 + [1e-12, 1e-12, 0.0], np.ones(3)])
    np.testing.assert_allclose(law.gain, control.lqr(a, b, costs, 10.0 * np.eye(3))[0], atol=1e-5)
    found = coupled_costs(modes, 3, PLACES, impulse_at=AT, weight=10.0)
    np.testing.assert_allclose(found.law.gain, law.gain, atol=1e-9)
    work, spent, peak = after_an_impulse(modes, law)
    assert (found.residual_work, found.effort) == pytest.approx((work, spent), rel=1e-4)
    assert found.peak_force == pytest.approx(peak, rel=1e-5)
    many = coupled_batch(modes, 3, np.array([PLACES]), impulse_at=AT, weight=10.0)
    np.testing.assert_allclose(np.ravel(many), [found.residual_work, found.effort], rtol=1e-8)
    limits = Limits(effort=2.0 * found.effort, spacing=0.5)
    best = place_coupled(modes, 3, 3, impulse_at=AT, weight=10.0, limits=limits, starts=1)
    assert best.residual_work < found.residual_work and best.effort <= limits.effort


def test_rigid_modes_take_as_many_displacements_and_actuators(modes):
    law = imsc(modes, 2, [Actuator("a", 0.4), Actuator("b", 1.1)], weight=1.0)
    pair = [Sensor("y", 0.75), Sensor("v", 1.2, "velocity")]
    design = (
        lambda sensors: luenberger_controller(modes, law, sensors, poles=[-1 + 3j, -2 + 6j]),
        lambda sensors: kalman_controller(modes, law, sensors, disturbance=1e-4, noise=1e-8),
    )
    for one in design:
        with pytest.raises(
            DesignError, match=r"2 rigid-body modes need as many independent displacement sensors; there are 1"
        ):
            one(pair)
        assert one([pair[0], Sensor("y2", 1.2)]).A.shape == (4, 4)
    with pytest.raises(DesignError, match="2 rigid-body modes are controlled, and 1 actuator cannot control them"):
        place_coupled(modes, 3, 1, impulse_at=0.6, weight=0.5, limits=Limits(effort=5.0, spacing=0.1))
