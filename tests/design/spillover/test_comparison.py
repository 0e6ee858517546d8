"""Several laws on one yardstick: what the comparison says of each is what each says of itself."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response, peak_force
from workbench.design.spillover.performance import compare
from workbench.rig.actuators import Actuator


def test_crowded_actuators_cost_the_coupled_regulator_less(hinged_modes):
    modes = hinged_modes(9)
    actuators = [Actuator(f"F{i}", x) for i, x in enumerate((1.3, 2.6, 3.9, 5.2))]
    state = impulse_state(modes, 6.3)
    state[13:] = 0.0
    laws = imsc(modes, 4, actuators, weight=20.0), coupled_lqr(modes, 4, actuators, weight=10.0)
    independent, coupled = compare(modes, laws, state, weight=10.0, final_time=600.0)

    assert coupled.cost < independent.cost and coupled.effort < independent.effort
    assert independent.work.residual_work_by_mode == pytest.approx(
        [8.418221e-3, 1.258416e-1, 4.698541e-2, 6.875917e-3, 3.450264e-2], rel=1e-5
    )
    assert independent.most_excited == 5
    fine = initial_response(close_loop(modes, laws[0]), np.linspace(0.0, 100.0, 100001), state)
    assert independent.peak_force == pytest.approx(np.abs(fine.forces).max(), rel=1e-5)
    assert independent.stability == coupled.stability == "marginally stable"  # undamped residual modes


@pytest.mark.parametrize("final_time", [1.5, 1e5])
def test_the_peak_force_is_that_of_the_oscillator_however_long_the_time(hinged_modes, final_time):
    """s² + 2 σ s + p² after an impulse: F = -K x of q = v/ω_d e^{-σt} sin ω_d t, greatest where its slope is zero."""
    modes = hinged_modes(3)
    law = imsc(modes, 1, [Actuator("F", 4.0)], weight=20.0)
    state = impulse_state(modes, 6.3)
    (found,) = compare(modes, [law], state, weight=20.0, final_time=final_time)
    a = np.array([[0.0, 1.0], [-(modes.omega[0] ** 2), 0.0]]) - np.outer([0.0, modes.phi(4.0)[0, 0]], law.gain)
    time = np.linspace(0.0, min(final_time, 200.0), 200_001)
    sigma, p = -0.5 * a[1, 1], np.sqrt(-a[1, 0])
    damped, v = np.sqrt(p**2 - sigma**2), state[3]
    q = v / damped * np.exp(-sigma * time) * np.sin(damped * time)
    rate = v * np.exp(-sigma * time) * (np.cos(damped * time) - sigma / damped * np.sin(damped * time))
    assert found.peak_force == pytest.approx(np.abs(law.gain @ [q, rate]).max(), rel=2e-6)


def test_the_peak_force_counts_what_a_damper_between_modes_brings(hinged_modes):
    """Damping that couples the modes: the residual ones move the controlled, and the force with them."""
    modes = replace(hinged_modes(2), damping=np.array([[0.02, 0.05], [0.05, 0.2]]))
    loop = close_loop(modes, coupled_lqr(modes, 1, [Actuator("F", 4.0)], weight=20.0))
    state = np.array([0.0, 0.0, 0.0, 1.0])  # the residual mode alone
    fine = initial_response(loop, np.linspace(0.0, 100.0, 100_001), state).forces
    assert np.abs(fine).max() > 1e-3 and peak_force(loop, state, np.inf) == pytest.approx(np.abs(fine).max(), rel=1e-5)
