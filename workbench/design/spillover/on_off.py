"""Modal on-off control of a whole structure: each controlled mode switched by itself, the residual ones driven along.

Meirovitch, VanLandingham & Öz (1977), reference [77] of the dissertation: f_r = -k_r sgn(s_r) outside a dead band of
s_r = q_r' + λ_r q_r, and F = B⁺ f on the actuators.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from workbench.design.estimation.closed_loop import Response
from workbench.design.laws.law import DesignError, controlled_indices, participation
from workbench.design.laws.switching import Relay, Stretch, switch, travel
from workbench.design.spillover.spillover import Spillover
from workbench.rig.actuators import Actuator
from workbench.rig.statespace import input_matrix
from workbench.structure.modes import Modes, frozen

GAUSS_POINTS = 12


@dataclass(frozen=True, eq=False)
class OnOffLaw:
    """A relay on every controlled mode.

    Attributes:
        relays: one a controlled mode.
        spread: (n_actuators, n_controlled) B⁺, from modal forces to actuator forces.
        controlled: (n_controlled,) zero-based indices.
        actuators: that the law drives.
        name: for tables and plots.
    """

    relays: tuple[Relay, ...]
    spread: np.ndarray
    controlled: tuple[int, ...]
    actuators: tuple[Actuator, ...]
    name: str = "on-off"

    def __post_init__(self) -> None:
        object.__setattr__(self, "spread", frozen(self.spread))


@dataclass(frozen=True, eq=False)
class Switched:
    """A response under on-off control.

    Attributes:
        response: modal motion and forces.
        stretches: of each controlled mode, what happened between its switchings.
    """

    response: Response
    stretches: tuple[tuple[Stretch, ...], ...]


def on_off(
    modes: Modes,
    controlled: int | Sequence[int],
    actuators: Sequence[Actuator],
    *,
    force: ArrayLike,
    dead_band: ArrayLike,
    slope: ArrayLike = 0.0,
) -> OnOffLaw:
    """Modal on-off control with a dead band.

    Args:
        modes, controlled, actuators: as for `imsc`.
        force: k, modal force, scalar or (n_controlled,), positive.
        dead_band: d of s = q' + λ q, likewise, not negative. Undamped modes are left with at most ½ d² of energy
            where λ = 0.
        slope: λ, 1/s, likewise, not negative.

    Raises:
        DesignError: damping that couples the modes, or figures out of range.
    """
    index = controlled_indices(modes, controlled)
    if not modes.proportional:
        raise DesignError(
            "damping couples the modes, so they cannot be switched one by one; neglect its coupling terms"
        )
    n = len(index)
    values = []
    for name, value, least in (
        ("force", force, "positive"),
        ("dead_band", dead_band, "0 or more"),
        ("slope", slope, "0 or more"),
    ):
        value = np.broadcast_to(np.asarray(value, float), n)
        if not np.isfinite(value).all() or (value < 0).any() or (least == "positive" and not value.all()):
            raise DesignError(f"on-off {name} must be {least}; got {value.min():g}")
        values.append(value)
    c = np.diag(modes.damping)
    relays = tuple(
        Relay(float(modes.omega[r]), float(c[r]), float(k), float(d), float(s))
        for r, k, d, s in zip(index, *values, strict=True)
    )
    return OnOffLaw(relays, np.linalg.pinv(participation(modes, index, actuators)), index, tuple(actuators))


def respond_on_off(modes: Modes, law: OnOffLaw, state: np.ndarray, time: ArrayLike) -> Switched:
    """The response from a state (2 n_modes,) at t = 0, exact at each of the times (n_times,), however far apart.

    Raises:
        ValueError: times that do not increase from zero or later.
    """
    time = np.asarray(time, float)
    if time.ndim != 1 or time.size == 0 or (np.diff(time) <= 0).any() or time[0] < 0:
        raise ValueError("times must increase, from zero or later")
    stretches = _switchings(modes, law, state, time[-1])
    return Switched(_response(modes, law, state, time, stretches), stretches)


def on_off_work(modes: Modes, law: OnOffLaw, state: np.ndarray, final_time: float) -> Spillover:
    """Work of the actuators in every mode up to a finite time, ∫ f_r q_r' dt, piece by piece between switchings."""
    stretches = _switchings(modes, law, state, final_time)
    events = np.unique(np.r_[0.0, [s.end for mode in stretches for s in mode], final_time])
    pieces = np.maximum(1, np.ceil(np.diff(events) * modes.omega.max())).astype(int)
    edges = np.concatenate(
        [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(events[:-1], events[1:], pieces)] + [[final_time]]
    )
    points, weights = np.polynomial.legendre.leggauss(GAUSS_POINTS)
    width = 0.5 * np.diff(edges)[:, None]
    at = (edges[:-1, None] + width * (1 + points)).ravel()
    response = _response(modes, law, state, at, stretches)
    power = (input_matrix(modes, law.actuators) @ response.forces) * response.modal[modes.n_modes :]
    return Spillover(power @ (width * weights).ravel(), law.controlled, final_time)


def _switchings(modes: Modes, law: OnOffLaw, state: np.ndarray, final_time: float):
    return tuple(
        switch(relay, state[r], state[modes.n_modes + r], final_time)
        for relay, r in zip(law.relays, law.controlled, strict=True)
    )


def _response(modes: Modes, law: OnOffLaw, state, time, stretches) -> Response:
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
