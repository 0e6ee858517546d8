"""How many modes to control: the shares add up to what the law leaves, and refusals."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.placement.controlled_modes import controlled_mode_count
from workbench.rig.actuators import Actuator
from workbench.structure.member import Beam


def modes(n=12):
    return Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(n)


def test_what_is_left_is_what_the_motion_shows():
    """Late in the controlled motion, with residual modes at rest at first, their energy is the spillover."""
    found, state = modes(), impulse_state(modes(), 6.3)
    result = controlled_mode_count(found, state, weight=5.0)
    places = [Actuator(f"F{i}", x) for i, x in enumerate((10 / 4, 5.0, 7.5))]
    rest = state.copy()
    rest[3:12] = rest[15:] = 0.0
    late = initial_response(close_loop(found, imsc(found, 3, places, weight=5.0)), [1500.0], rest).energy[:, 0]
    assert result.spillover[2] == pytest.approx(late[3:].sum(), rel=1e-6)
    assert result.uncontrolled[2] == pytest.approx(0.5 * (state[15:] ** 2).sum())


def test_the_least_number_is_recommended():
    found = modes()
    state = np.r_[np.zeros(12), 1.0, 0.5, 0.02 * np.ones(10)]
    result = controlled_mode_count(found, state, weight=20.0, share=0.05)
    assert result.recommended == 2 and result.residual[0] > 0.05 * result.energy.sum()
    assert controlled_mode_count(found, state, weight=20.0, share=1e-9).recommended is None
    # the nodes of mode 13, at which 12 actuators would stand, are not known
    assert np.isnan(controlled_mode_count(found, state, weight=20.0, max_modes=12).effort[11])


def test_refusals():
    with pytest.raises(DesignError, match="gives no mode any energy"):
        controlled_mode_count(modes(), np.zeros(24), weight=1.0)
    damped = replace(modes(), damping=0.01 * np.eye(12))
    with pytest.raises(DesignError, match="chosen without damping"):
        controlled_mode_count(damped, impulse_state(damped, 6.3), weight=1.0)
    with pytest.raises(DesignError, match="no number of modes can be controlled"):
        controlled_mode_count(modes(), impulse_state(modes(), 6.3), weight=1.0, places=lambda n: np.full(n, 0.0))
