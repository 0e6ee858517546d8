"""The motion of a whole structure under modal on-off control: controlled modes switch, residual modes are driven.

Exact between switchings; see `workbench.design.loop.switching` for one mode by itself.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from workbench.design.laws.law import DesignError
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.closed_loop import Response, checked_times
from workbench.design.loop.switching import Stretch, switch, travel
from workbench.rig.actuators import Actuator
from workbench.rig.statespace import input_matrix
from workbench.structure.modes import Modes


@dataclass(frozen=True, eq=False)
class Switched:
    """A response under on-off control.

    Attributes:
        response: modal motion and forces.
        stretches: of each controlled mode, what happened between its switchings.
    """

    response: Response
    stretches: tuple[tuple[Stretch, ...], ...]


def respond_on_off(modes: Modes, law: OnOffLaw, state: np.ndarray, time: ArrayLike) -> Switched:
    """The response from a state (2 n_modes,) at t = 0, exact at each of the times (n_times,), however far apart.

    Raises:
        DesignError: an actuator with a delay, a lag, a dead zone, hysteresis, a bias or a limit that its command meets.
        ValueError: times that do not increase from zero or later.
    """
    time = checked_times(time)
    stretches = switchings(modes, law, state, time[-1])
    return Switched(motion(modes, law, state, time, stretches), stretches)


def switchings(modes: Modes, law: OnOffLaw, state: np.ndarray, final_time: float) -> tuple[tuple[Stretch, ...], ...]:
    """What each controlled mode does between its switchings, up to the final time.

    Raises:
        DesignError: an actuator whose force is not its command times its gain.
    """
    for actuator, most in zip(law.actuators, np.abs(law.spread) @ [relay.force for relay in law.relays], strict=True):
        _check_prompt(actuator, float(most))
    return tuple(
        switch(relay, state[r], state[modes.n_modes + r], final_time)
        for relay, r in zip(law.relays, law.controlled, strict=True)
    )


def _check_prompt(actuator: Actuator, most: float) -> None:
    """Refuse what the closed forms between switchings do not hold; a limit that no command reaches changes nothing."""
    bends = {
        "delay": actuator.delay,
        "time_constant": actuator.time_constant,
        "dead_zone": actuator.dead_zone,
        "hysteresis_share": actuator.hysteresis_share,
        "bias": actuator.bias,
        "rate_limit": actuator.rate_limit if np.isfinite(actuator.rate_limit) else 0.0,
        "limit": actuator.limit if actuator.limit < abs(actuator.gain) * most * (1.0 - 1e-12) else 0.0,
    }
    for name, value in bends.items():
        if value:
            raise DesignError(
                f"actuator {actuator.name} has {name} = {value:g}, which the exact motion of on-off control leaves out:"
                " verify or redesign simulates it once a sample; or leave it out of the actuator"
            )


def motion(
    modes: Modes, law: OnOffLaw, state: np.ndarray, time: np.ndarray, stretches: tuple[tuple[Stretch, ...], ...]
) -> Response:
    """Modal motion and forces at the times (n_times,) from what happens between switchings."""
    n = modes.n_modes
    c = np.diag(modes.damping)
    modal = np.empty((2 * n, time.size))
    force = np.empty((len(law.relays), time.size))
    residual = [r for r in range(n) if r not in law.controlled]
    push = input_matrix(modes, law.actuators)[residual] @ law.spread
    omega, damping = modes.omega[residual, None], c[residual, None]
    position, rate = travel(omega, damping, time, state[residual][:, None], state[n:][residual][:, None], 0.0)
    for j, (relay, r) in enumerate(zip(law.relays, law.controlled, strict=True)):
        driven = np.zeros((2, len(residual), 1))
        for stretch in stretches[j]:
            inside = np.flatnonzero((time >= stretch.start) & (time < stretch.end))
            if stretch is stretches[j][-1]:
                inside = np.flatnonzero(time >= stretch.start)
            tau = time[inside] - stretch.start
            pattern = stretch.steady, stretch.ramp, stretch.fading, relay.slope
            force[j, inside] = pattern[0] + pattern[1] * tau + pattern[2] * np.exp(-relay.slope * tau)
            modal[r, inside], modal[n + r, inside] = travel(
                relay.omega, relay.damping, tau, stretch.displacement, stretch.rate, *pattern
            )
            at = travel(omega, damping, tau, driven[0], driven[1], *pattern)
            position[:, inside] += push[:, [j]] * at[0]
            rate[:, inside] += push[:, [j]] * at[1]
            driven = np.array(travel(omega, damping, stretch.end - stretch.start, driven[0], driven[1], *pattern))
    modal[residual], modal[[n + r for r in residual]] = position, rate
    return Response(time, modal, law.spread @ force, modes)
