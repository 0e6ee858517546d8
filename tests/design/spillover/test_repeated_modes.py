"""Repeated modes have no shapes of their own: what a law does must not depend on the basis that is taken of them."""

import numpy as np
import pytest

from workbench.design.laws.coupled import coupled_lqr
from workbench.design.loop.closed_loop import impulse_state
from workbench.design.spillover.spillover import effort, spillover
from workbench.rig.actuators import Actuator

ACTUATORS = tuple(Actuator(f"F{i}", place) for i, place in enumerate([(0.31, 0.22), (0.63, 0.71), (0.82, 0.37)]))


@pytest.mark.parametrize("angle", [0.4, np.pi / 4, 1.3])
def test_any_basis_of_a_repeated_pair_gives_one_spillover_of_a_coupled_law(turned_modes, angle):
    found = []
    for modes in (turned_modes(0.0), turned_modes(angle)):
        law = coupled_lqr(modes, 3, ACTUATORS, weight=1e-4)
        state = impulse_state(modes, (0.42, 0.27)) * np.tile(np.arange(6) < 3, 2)
        found.append((spillover(modes, law, state).residual_work_by_mode, effort(modes, law, state)))
    (works, forces), (turned_works, turned_forces) = found
    # modes 5 and 6 are repeated too; both stay as they are
    np.testing.assert_allclose(turned_works, works, rtol=1e-9)
    assert turned_forces == pytest.approx(forces, rel=1e-9)
