"""Costs and efforts of small, fast structures against closed forms: micromechanics as well as bridges."""

import numpy as np
import pytest

from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc, imsc_poles, riccati_gains
from workbench.design.loop.closed_loop import impulse_state
from workbench.design.placement.coupled_placement import coupled_batch, coupled_costs
from workbench.design.placement.task import placement_task
from workbench.design.spillover.spillover import distributed_cost, effort, modal_cost
from workbench.rig.actuators import Actuator
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam

RATIO = 0.0005
LENGTHS = pytest.mark.parametrize("length", [1.0, 1e-2, 1e-4])  # of silicon, f_1 from 16 Hz to 160 kHz


def cantilever(length, damping=RATIO):
    h, width = length / 100, length / 10
    member = Beam(
        length=length, mass_per_length=2330.0 * h * width, bending_stiffness=160e9 * width * h**3 / 12,
        left="clamped", right="free", damping=ModalDamping(damping),
    )  # fmt: skip
    modes = member.modes(4)
    return modes, [Actuator("a", 0.4 * length), Actuator("b", 0.95 * length)], impulse_state(modes, 0.7 * length)


@LENGTHS
def test_the_least_modal_cost_is_that_of_distributed_control(length):
    modes, actuators, state = cantilever(length)
    found = modal_cost(modes, imsc(modes, 2, actuators, weight=1.0), state, 1.0)
    assert found == pytest.approx(distributed_cost(modes, 2, state, 1.0), rel=1e-9)


@LENGTHS
def test_the_effort_of_velocity_feedback_is_its_closed_form(length):
    modes, actuators, state = cantilever(length)
    omega, b, start = modes.omega[0], modes.phi(actuators[1].at)[0, 0], state[4]
    law = imsc_poles(modes, 1, actuators[1:], poles=[omega * (-0.05 + 1j * np.sqrt(1 - 0.05**2))])
    # q'' + 2 ζ_wanted ω q' + ω² q = 0 loses q'(0)² / 2 = 2 ζ_wanted ω ∫ q'² dt
    gain = 2 * (0.05 - RATIO) * omega
    assert effort(modes, law, state) == pytest.approx((gain / b) ** 2 * start**2 / (4 * 0.05 * omega), rel=1e-9)


@LENGTHS
def test_the_modal_efforts_of_a_placement_are_their_closed_form(length):
    modes, _, state = cantilever(length)
    task = placement_task(modes, 2, impulse_at=0.7 * length, weight=1.0)
    omega, start = modes.omega[:2], state[4:6]
    g1, g2 = riccati_gains(omega, 1.0, 2 * RATIO * omega)
    rate = g2 + 2 * RATIO * omega
    # of q'' + rate q' + (ω² + g1) q = 0: ∫ q'² = q'(0)² / 2 rate, ∫ q² as much over ω² + g1
    known = start**2 / (2 * rate) * (g2**2 + g1**2 / (omega**2 + g1))
    np.testing.assert_allclose(np.diag(task.force_gramian), known, rtol=1e-9)


@LENGTHS
def test_the_effort_of_coupled_lqr_is_the_sum_over_its_poles(length):
    modes, actuators, state = cantilever(length, 0.0)
    places, options = np.array([a.at for a in actuators]), {"impulse_at": 0.7 * length, "weight": 1.0}
    one = coupled_costs(modes, 2, places, **options)
    work, spent = coupled_batch(modes, 2, places[None], **options)
    assert [one.effort, one.residual_work] == pytest.approx([spent[0], work[0]], rel=1e-6)
    regulator = coupled_lqr(modes, 2, actuators, weight=1.0)
    assert effort(modes, regulator, state) == pytest.approx(spent[0], rel=1e-6)
