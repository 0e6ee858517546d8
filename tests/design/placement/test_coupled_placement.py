"""Places for coupled LQR: figures against the law itself, and an optimum that no grid beats."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.law import DesignError
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.placement.coupled_placement import coupled_batch, coupled_costs, place_coupled, scan_coupled
from workbench.design.placement.limits import Limits
from workbench.design.placement.task import placement_task
from workbench.design.spillover.spillover import effort, spillover
from workbench.rig.actuators import Actuator


@pytest.fixture(scope="module")
def modes(hinged_modes):
    return hinged_modes(9)


def test_figures_are_those_of_the_law(modes):
    places = [1.3, 2.6, 5.2]
    law = coupled_lqr(modes, 4, [Actuator(f"F{i}", x) for i, x in enumerate(places)], weight=10.0)
    state = impulse_state(modes, 6.3)
    state[13:] = 0.0
    found = coupled_costs(modes, 4, places, impulse_at=6.3, weight=10.0)
    np.testing.assert_allclose(
        found.residual_work_by_mode, spillover(modes, law, state).residual_work_by_mode, rtol=1e-7
    )
    assert found.effort == pytest.approx(effort(modes, law, state), rel=1e-8)
    forces = initial_response(close_loop(modes, law), np.linspace(0.0, 40.0, 8001), state).forces
    assert found.peak_force == pytest.approx(np.abs(forces).max(), rel=1e-2)


def test_many_at_once_are_each_by_itself(modes):
    places = np.sort(np.random.default_rng(0).uniform(0.2, 9.8, (8, 3)), axis=1)
    work, spent = coupled_batch(modes, 4, places, impulse_at=6.3, weight=10.0)
    each = [coupled_costs(modes, 4, x, impulse_at=6.3, weight=10.0) for x in places]
    np.testing.assert_allclose(work, [found.residual_work for found in each], rtol=1e-9)
    np.testing.assert_allclose(spent, [found.effort for found in each], rtol=1e-9)
    assert coupled_batch(modes, 2, np.array([[5.0]]), impulse_at=6.3, weight=10.0)[0] == np.inf


@pytest.mark.slow
def test_no_grid_beats_the_optimum(modes):
    limits = Limits(spacing=0.5, effort=0.5, forbidden=((2.0, 2.4),))
    best = place_coupled(modes, 2, 2, impulse_at=6.3, weight=10.0, limits=limits, starts=4)
    assert best.effort <= 0.5 and np.diff(best.positions)[0] >= 0.5
    coarse, fine = (scan_coupled(modes, 2, 2, impulse_at=6.3, weight=10.0, limits=limits, n_places=k) for k in (25, 75))
    assert coarse.tried < fine.tried
    assert coarse.lower_bound <= fine.lower_bound <= best.residual_work <= fine.best.residual_work
    assert not ((fine.best.positions > 2.0) & (fine.best.positions < 2.4)).any()


def test_refusals(modes):
    with pytest.raises(DesignError, match="no residual mode"):
        place_coupled(modes, 9, 2, impulse_at=6.3, weight=10.0, limits=Limits())
    with pytest.raises(DesignError, match="meets the limits"):
        place_coupled(modes, 2, 2, impulse_at=6.3, weight=10.0, limits=Limits(effort=1e-6))
    with pytest.raises(DesignError, match="on the grid"):
        scan_coupled(modes, 2, 2, impulse_at=6.3, weight=10.0, limits=Limits(effort=1e-6), n_places=9)
    assert coupled_costs(modes, 2, [5.0], impulse_at=6.3, weight=10.0).residual_work == np.inf


def test_the_damping_of_the_modes_is_in_law_and_effort(modes):
    damped = replace(modes, damping=np.diag(0.2 * modes.omega))
    state = impulse_state(damped, 6.3)
    state[13:] = 0.0
    found = coupled_costs(damped, 4, [1.3, 2.6, 5.2], impulse_at=6.3, weight=10.0)
    law = coupled_lqr(damped, 4, found.law.actuators, weight=10.0)
    np.testing.assert_allclose(found.law.gain, law.gain, atol=1e-9 * np.abs(law.gain).max())
    assert found.effort == pytest.approx(effort(damped, law, state), rel=1e-8)
    work, spent = coupled_batch(damped, 4, np.array([[1.3, 2.6, 5.2]]), impulse_at=6.3, weight=10.0)
    assert (work[0], spent[0]) == pytest.approx((found.residual_work, found.effort), rel=1e-9)


@pytest.mark.parametrize("place", [coupled_costs, lambda modes, n, at, **asked: placement_task(modes, n, **asked)])
def test_damping_that_couples_the_modes_is_refused(modes, place):
    coupled = replace(modes, damping=0.1 * np.ones((9, 9)))
    with pytest.raises(DesignError, match="damping couples the modes"):
        place(coupled, 2, [1.3, 2.6], impulse_at=6.3, weight=10.0)
