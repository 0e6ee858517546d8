"""Several laws on one yardstick: what the comparison says of each is what each says of itself."""

import numpy as np
import pytest

from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.spillover.comparison import compare
from workbench.rig.actuators import Actuator


def test_crowded_actuators_cost_the_coupled_regulator_less(hinged_modes):
    modes = hinged_modes(9)
    actuators = [Actuator(f"F{i}", x) for i, x in enumerate((1.3, 2.6, 3.9, 5.2))]
    state = impulse_state(modes, 6.3)
    state[13:] = 0.0
    laws = imsc(modes, 4, actuators, weight=20.0), coupled_lqr(modes, 4, actuators, weight=10.0)
    independent, coupled = compare(modes, laws, state, weight=10.0, final_time=600.0)

    assert coupled.cost < independent.cost and coupled.effort < independent.effort
    assert independent.work.residual_work == pytest.approx(
        [8.418221e-3, 1.258416e-1, 4.698541e-2, 6.875917e-3, 3.450264e-2], rel=1e-5
    )
    assert independent.most_excited == 5
    fine = initial_response(close_loop(modes, laws[0]), state, np.linspace(0.0, 100.0, 100001))
    assert independent.peak_force == pytest.approx(np.abs(fine.forces).max(), rel=2e-2)
