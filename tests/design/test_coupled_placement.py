"""Places for coupled LQR: figures against the law itself, and an optimum that no grid beats."""

import numpy as np
import pytest

from workbench.design.closed_loop import close_loop, impulse_state, respond
from workbench.design.coupled import coupled_lqr
from workbench.design.coupled_placement import coupled_figures, place_coupled
from workbench.design.law import DesignError
from workbench.design.placement import Limits
from workbench.design.spillover import effort, spillover
from workbench.rig.actuators import Actuator
from workbench.structure.member import Beam


@pytest.fixture(scope="module")
def modes():
    return Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(9)


def test_figures_are_those_of_the_law(modes):
    places = [1.3, 2.6, 5.2]
    law = coupled_lqr(modes, 4, [Actuator(f"F{i}", x) for i, x in enumerate(places)], weight=10.0)
    state = impulse_state(modes, 6.3)
    state[13:] = 0.0
    found = coupled_figures(modes, 4, places, impulse_at=6.3, weight=10.0)
    np.testing.assert_allclose(found.by_mode, spillover(modes, law, state).residual_work, rtol=1e-7)
    assert found.effort == pytest.approx(effort(modes, law, state), rel=1e-8)
    forces = respond(close_loop(modes, law), state, np.linspace(0.0, 40.0, 8001)).forces
    assert found.peak_force == pytest.approx(np.abs(forces).max(), rel=1e-2)


def test_no_grid_beats_the_optimum(modes):
    best = place_coupled(modes, 2, 2, impulse_at=6.3, weight=10.0, limits=Limits(spacing=0.5, effort=0.5), starts=4)
    assert best.effort <= 0.5 and np.diff(best.positions)[0] >= 0.5
    grid = np.linspace(0.5, 9.5, 19)
    for i, x in enumerate(grid):
        for y in grid[i + 1 :]:
            found = coupled_figures(modes, 2, [x, y], impulse_at=6.3, weight=10.0)
            assert found.effort > 0.5 or found.residual_work >= best.residual_work


def test_refusals(modes):
    with pytest.raises(DesignError, match="no residual mode"):
        place_coupled(modes, 9, 2, impulse_at=6.3, weight=10.0, limits=Limits())
    with pytest.raises(DesignError, match="keeps the limits"):
        place_coupled(modes, 2, 2, impulse_at=6.3, weight=10.0, limits=Limits(effort=1e-6))
    assert coupled_figures(modes, 2, [5.0], impulse_at=6.3, weight=10.0).residual_work == np.inf
