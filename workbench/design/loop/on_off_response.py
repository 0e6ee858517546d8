"""The motion of all modes under modal on-off control, exact between switchings.

Controlled modes switch one by one (see `workbench.design.loop.switching`) and drive the residual modes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from workbench.design.laws.law import DesignError
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.closed_loop import Response, checked_times
from workbench.design.loop.switching import Segment, switch, travel
from workbench.renamed import Renamed
from workbench.rig.actuators import Actuator
from workbench.rig.statespace import input_matrix
from workbench.structure.modes import Modes


@dataclass(frozen=True, eq=False)
class OnOffResponse:
    """A response under on-off control.

    Attributes:
        response: modal motion and forces.
        segments: of each controlled mode, its motion between switchings.
    """

    response: Response
    segments: tuple[tuple[Segment, ...], ...]
    stretches = Renamed("segments")


def respond_on_off(modes: Modes, law: OnOffLaw, state: np.ndarray, time: ArrayLike) -> OnOffResponse:
    """The response from a state (2 n_modes,) at t = 0, exact at each of the times (n_times,), however far apart.

    Raises:
        DesignError: an actuator with a delay, lag, dead zone, hysteresis, bias or rate limit, or one that saturates.
        ValueError: times that do not increase from zero or later.
    """
    time = checked_times(time)
    segments = switchings(modes, law, state, time[-1])
    return OnOffResponse(motion(modes, law, state, time, segments), segments)


def switchings(modes: Modes, law: OnOffLaw, state: np.ndarray, final_time: float) -> tuple[tuple[Segment, ...], ...]:
    """The motion of each controlled mode between its switchings, up to the final time.

    An actuator whose force is not its command times its gain is refused.
    """
    largest = np.abs(law.allocation) @ [relay.force for relay in law.relays]
    for actuator, most in zip(law.actuators, largest, strict=True):
        _check_proportional(actuator, float(most))
    return tuple(
        switch(relay, state[r], state[modes.n_modes + r], final_time)
        for relay, r in zip(law.relays, law.controlled, strict=True)
    )


def _check_proportional(actuator: Actuator, largest: float) -> None:
    """Refuse an actuator whose force is not its gain times its command, for commands up to the largest."""
    names = ("delay", "time_constant", "dead_zone", "hysteresis_share", "bias")
    refused = [name for name in names if getattr(actuator, name)]
    refused += ["rate_limit"] * bool(np.isfinite(actuator.rate_limit))
    refused += ["limit"] * bool(actuator.limit < abs(actuator.gain) * largest * (1.0 - 1e-12))
    if refused:
        raise DesignError(
            f"actuator {actuator.name} has {refused[0]} = {getattr(actuator, refused[0]):g}, which the exact motion of"
            " on-off control cannot include: simulate it by verify or redesign, or leave it out of the actuator"
        )


def motion(
    modes: Modes, law: OnOffLaw, state: np.ndarray, time: np.ndarray, segments: tuple[tuple[Segment, ...], ...]
) -> Response:
    """Modal motion and forces at the times (n_times,), from the motion between switchings."""
    n = modes.n_modes
    c = np.diag(modes.damping)
    modal = np.empty((2 * n, time.size))
    force = np.empty((len(law.relays), time.size))
    residual = [r for r in range(n) if r not in law.controlled]
    coupling = input_matrix(modes, law.actuators)[residual] @ law.allocation
    omega, damping = modes.omega[residual, None], c[residual, None]
    position, rate = travel(omega, damping, time, state[residual][:, None], state[n:][residual][:, None], 0.0)
    for j, (relay, r) in enumerate(zip(law.relays, law.controlled, strict=True)):
        driven = np.zeros((2, len(residual), 1))
        for segment in segments[j]:
            last = segment is segments[j][-1]
            inside = np.flatnonzero((time >= segment.start) & ((time < segment.end) | last))
            tau = time[inside] - segment.start
            course = segment.steady, segment.ramp, segment.fading, relay.slope
            force[j, inside] = course[0] + course[1] * tau + course[2] * np.exp(-relay.slope * tau)
            modal[r, inside], modal[n + r, inside] = travel(
                relay.omega, relay.damping, tau, segment.displacement, segment.rate, *course
            )
            at = travel(omega, damping, tau, driven[0], driven[1], *course)
            position[:, inside] += coupling[:, [j]] * at[0]
            rate[:, inside] += coupling[:, [j]] * at[1]
            driven = np.array(travel(omega, damping, segment.end - segment.start, driven[0], driven[1], *course))
    modal[residual], modal[[n + r for r in residual]] = position, rate
    return Response(time, modal, law.allocation @ force, modes)
