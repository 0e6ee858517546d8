"""Performance of a design on the full plant: cost, effort, spillover and stability margin."""

from dataclasses import dataclass

import numpy as np

from workbench.design.laws.law import DesignError
from workbench.design.laws.moments import second_moments
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.closed_loop import ClosedLoop
from workbench.design.spillover.spillover import check_final_time, on_off_motion
from workbench.renamed import Renamed
from workbench.rig.statespace import input_matrix
from workbench.structure.modes import Modes


@dataclass(frozen=True)
class Performance:
    """Performance of a design up to the final time; cost, effort and W_R are infinite where the loop is unstable.

    Attributes:
        cost: ∫ (Σ q_r'² + ω_r² q_r² + R FᵀF) dt, Σ over the controlled modes, by their true coordinates.
        effort: ∫ FᵀF dt.
        spillover: W_R, work in the residual modes.
        margin: distance of the rightmost pole from the axis, 1/s; nan for on-off control, which has no poles.
    """

    cost: float
    effort: float
    spillover: float
    margin: float

    spilled = Renamed("spillover")


def performance(loop: ClosedLoop, state: np.ndarray, *, weight: float, final_time: float) -> Performance:
    """The performance of a linear loop, exact: integrals of quadratic forms of the state by one matrix exponential.

    Args:
        loop: from `close_loop` or `close_with`.
        state: (2 n_modes,) at t = 0; an observer starts from zero.
        weight: R of the actuator forces.
        final_time: s.
    """
    _check_weight(weight)
    check_final_time(final_time)
    modes, n = loop.modes, loop.modes.n_modes
    margin = loop.margin
    if not loop.stable:
        return Performance(np.inf, np.inf, np.inf, margin)
    moments = second_moments(loop.matrix, loop.start(state), final_time)
    own = list(loop.law.controlled)
    energy = modes.omega[own] ** 2 @ np.diag(moments)[own] + np.diag(moments)[[n + r for r in own]].sum()
    effort = float(np.trace(loop.feedback @ moments @ loop.feedback.T))
    rest = [r for r in range(n) if r not in own]
    push = input_matrix(modes, loop.law.actuators)[rest] @ loop.feedback
    spillover = float(sum(row @ moments[:, n + r] for row, r in zip(push, rest)))
    return Performance(float(energy) + weight * effort, effort, spillover, margin)


def on_off_performance(
    modes: Modes, law: OnOffLaw, state: np.ndarray, *, weight: float, final_time: float
) -> Performance:
    """The performance of on-off control, from its exact motion, integrated from switching to switching.

    Raises:
        DesignError: an actuator that `respond_on_off` refuses.
    """
    _check_weight(weight)
    check_final_time(final_time)
    response, instants = on_off_motion(modes, law, state, final_time)
    effort = float((response.forces**2).sum(axis=0) @ instants)
    energy = float(2.0 * response.energy[list(law.controlled)].sum(axis=0) @ instants)
    rest = [r for r in range(modes.n_modes) if r not in law.controlled]
    power = (input_matrix(modes, law.actuators)[rest] @ response.forces) * response.modal[modes.n_modes :][rest]
    return Performance(energy + weight * effort, effort, float((power @ instants).sum()), np.nan)


def _check_weight(weight: float) -> None:
    if not weight > 0:
        raise DesignError(f"the control weight R must be positive; got {weight:g}")
