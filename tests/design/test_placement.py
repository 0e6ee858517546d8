"""Placement: exact derivatives, limits kept, global by a scan; and the trap that limits are for."""

import numpy as np
import pytest

from workbench.design.closed_loop import impulse_state
from workbench.design.law import DesignError
from workbench.design.placement import law_at, nodes_of_mode, place, placement_task, scan, symbolic_work
from workbench.design.spillover import effort, spillover
from workbench.structure.member import Beam


@pytest.fixture(scope="module")
def task():
    modes = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(9)
    return placement_task(modes, 4, impulse_at=6.3, weight=20.0)


def test_the_task_agrees_with_the_law(task):
    places = (1.5, 3.5, 6.5, 8.5)
    law = law_at(task, places, weight=20.0)
    state = impulse_state(task.modes, 6.3)
    state[13:] = 0.0
    total, by_mode, spent, _ = task.evaluate(places)
    np.testing.assert_allclose(by_mode, spillover(task.modes, law, state).residual_work, rtol=1e-9)
    assert total == pytest.approx(by_mode.sum()) and spent == pytest.approx(effort(task.modes, law, state), rel=1e-9)


def test_casadi_agrees_in_value_and_derivative(task):
    import casadi as ca

    function = symbolic_work(task)
    x = np.array([1.7, 3.6, 6.4, 8.2])
    total, _, spent, _ = task.evaluate(x)
    assert float(function(x)[0]) == pytest.approx(total, rel=1e-9)
    assert float(function(x)[1]) == pytest.approx(spent, rel=1e-9)
    z = ca.MX.sym("z", 4)
    exact = np.ravel(ca.Function("g", [z], [ca.gradient(function(z)[0], z)])(x))
    for i in range(4):
        step = np.eye(4)[i] * 1e-4
        slope = (task.evaluate(x + step)[0] - task.evaluate(x - step)[0]) / 2e-4
        assert exact[i] == pytest.approx(slope, rel=1e-5)


def test_nodes_of_mode_five(task):
    np.testing.assert_allclose(nodes_of_mode(task.modes, 4), [2, 4, 6, 8], atol=1e-9)


def test_the_optimum_keeps_its_limits_and_beats_a_full_grid(task):
    limit = 1.5 * task.evaluate([2, 4, 6, 8])[2]
    best = place(task, effort_limit=limit, spacing=0.5, starts=4)
    assert best.effort <= limit * (1 + 1e-6) and (np.diff(best.positions) >= 0.5 - 1e-6).all()
    on_grid, tried = scan(task, effort_limit=limit, spacing=0.5, n_places=30)
    assert tried > 10000 and best.residual_work <= on_grid.residual_work
    assert best.residual_work < 0.5 * task.evaluate([2, 4, 6, 8])[0]


def test_without_a_limit_the_outer_actuators_run_onto_the_supports(task):
    free = place(task, effort_limit=1e9, spacing=0.1, starts=4)
    assert free.positions[0] < 0.1 and free.positions[-1] > 9.9
    assert free.residual_work == pytest.approx(5.3e-4, rel=0.1)
    assert free.effort > 10 * task.evaluate([2, 4, 6, 8])[2]


def test_limits_that_conflict_are_named(task):
    with pytest.raises(DesignError, match="the structure has 10"):
        place(task, effort_limit=1.0, spacing=4.0)
    with pytest.raises(DesignError, match="effort limit"):
        place(task, effort_limit=1e-3, spacing=0.5, starts=1)
    with pytest.raises(DesignError, match="no residual mode"):
        placement_task(task.modes, 9, impulse_at=6.3, weight=20.0)


def test_a_heavy_structure_is_placed_like_a_light_one(task):
    """The test of a singular B once was not relative, so every placement on a heavy structure was thrown out."""
    heavy = Beam(length=10.0, mass_per_length=1e8, bending_stiffness=1e8, left="hinged", right="hinged").modes(9)
    twin = placement_task(heavy, 4, impulse_at=6.3, weight=20.0, impulse=1e8)
    limits = [1.5 * t.evaluate([2, 4, 6, 8])[2] for t in (task, twin)]
    light, same = (scan(t, effort_limit=e, spacing=0.5, n_places=16)[0] for t, e in zip((task, twin), limits))
    np.testing.assert_allclose(same.positions, light.positions, atol=1e-12)
    assert same.residual_work == pytest.approx(1e8 * light.residual_work, rel=1e-6)
