"""One mode under an on-off force with a dead band, event by event and exact between events.

    q'' + c q' + ω² q = f,   f = -k where s > d,  0 where |s| < d,  +k where s < -d,   s = q' + λ q

Where the force drives s back into the dead band and without it s leaves again, the mode slides along the edge s = ±d
under the mean force that keeps s' = 0 (Filippov 1988). Every piece of the motion has a closed form.
"""

import cmath
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from workbench.arrays import Floats
from workbench.design.laws.on_off import Relay

TOUCH = 1e-13  # of the largest |s|: an extremum of s no further past an edge than this touches it without crossing
MOST_EVENTS = 1_000_000


@dataclass(frozen=True)
class Segment:
    """Motion between two events.

    Attributes:
        start, end: s.
        displacement, rate: q and q' at the start.
        steady, ramp, fading: of the modal force f(τ) = steady + ramp τ + fading e^{-λτ}, τ from the start.
        sliding: along an edge of the dead band.
    """

    start: float
    end: float
    displacement: float
    rate: float
    steady: float
    ramp: float = 0.0
    fading: float = 0.0
    sliding: bool = False


def switch(relay: Relay, displacement: float, rate: float, final_time: float) -> tuple[Segment, ...]:
    """The motion from (q, q') at t = 0 up to the final time, as segments between switchings."""
    return tuple(_segments(relay, float(displacement), float(rate), float(final_time)))


def _segments(relay: Relay, q: float, v: float, final: float) -> Iterator[Segment]:
    d, k, slope = relay.dead_band, relay.force, relay.slope
    s, time, edge = v + slope * q, 0.0, None
    if abs(abs(s) - d) <= TOUCH * max(abs(v) + abs(slope * q), d):
        edge = d if s >= 0 else -d
    sign = 0 if abs(s) < d else int(np.sign(s))
    for _ in range(MOST_EVENTS):
        if edge is not None:
            low, high = (-k, k) if d == 0 else (0.0, k) if edge > 0 else (-k, 0.0)
            pull = _pull(relay, q, edge)
            if low < pull < high:
                duration, pull = _slide(relay, q, edge, low, high)
                end = min(time + duration, final)
                yield _sliding(relay, time, end, q, v, edge)
                if end >= final:
                    return
                q = _slid(relay, q, edge, duration)
                v, time = edge - slope * q, end
            sign = 1 if pull >= k else -1 if pull <= -k else 0
            # s' points from the edge into the dead band: the force is off there
            sign = 0 if sign * edge < 0 else sign
        force = -k * sign
        levels = (-d, d) if sign == 0 else (sign * d,)
        duration, reached = _crossing(relay, q, v, force, levels, edge, final - time)
        end = final if reached is None else time + duration
        yield Segment(time, end, q, v, force)
        if reached is None:
            return
        q = float(travel(relay.omega, relay.damping, duration, q, v, force)[0])
        v, time, edge = reached - slope * q, end, reached
    raise RuntimeError(f"more than {MOST_EVENTS} switchings before {final:g} s")


def _crossing(
    relay: Relay, q: float, v: float, force: float, levels: Sequence[float], edge: float | None, horizon: float
) -> tuple[float, float | None]:
    """The time of the first crossing of one of the levels by s, and the level; (inf, None) if none before the horizon.

    s' obeys the free equation of the mode, so its zeros are known and s is monotone between them.
    """
    slope, omega, c = relay.slope, relay.omega, relay.damping
    acceleration = force - c * v - omega**2 * q
    jerk = -c * acceleration - omega**2 * v
    s0 = v + slope * q
    touch = TOUCH * max(abs(v) + abs(slope * q), relay.dead_band)

    def s(time: float) -> float:
        position, rate = travel(omega, c, time, q, v, force)
        return float(rate + slope * position)

    left, value = 0.0, s0 if edge is None else edge
    for right in _extrema(omega, c, acceleration + slope * v, jerk + slope * acceleration, horizon):
        after = s(right)
        for level in levels:
            if abs(value - level) > touch and abs(after - level) > touch and (value < level) != (after < level):
                root = brentq(lambda t, level=level: s(t) - level, left, right, xtol=1e-300, rtol=1e-15, maxiter=200)
                return root, level
        left, value = right, after
    return np.inf, None


def _extrema(omega: float, c: float, w: float, dw: float, horizon: float) -> Iterator[float]:
    """Extrema of s up to the horizon, then the horizon: zeros of w = s', w'' + c w' + ω² w = 0 from (w, dw).

    The extrema of an oscillation do not grow, so the first few show whether s crosses a level at all.
    """
    sigma = 0.5 * c
    zeros: list[float] = []
    if omega > sigma:
        damped = np.sqrt(omega**2 - sigma**2)
        angle = np.arctan2(-(dw + sigma * w) / damped, w)
        first = ((0.5 * np.pi - angle) % np.pi) / damped
        zeros = [first + i * np.pi / damped for i in range(4)]
        horizon = min(horizon, zeros[-1])
    else:
        r = np.sqrt(sigma**2 - omega**2)
        if r * horizon < 1e-8:
            if w + 0.0 != 0 and dw + sigma * w != 0:
                zeros = [-w / (dw + sigma * w)]
        else:
            a, b = 0.5 * (w + (dw + sigma * w) / r), 0.5 * (w - (dw + sigma * w) / r)
            if a * b < 0:
                zeros = [0.5 * np.log(-b / a) / r]
    yield from (t for t in zeros if 0 < t < horizon)
    yield horizon


def _slid(relay: Relay, q: float, edge: float, time: float) -> float:
    """q after sliding along s = edge for a time: q' = edge - λ q."""
    slope = relay.slope
    return q + (edge - slope * q) * (-np.expm1(-slope * time) / slope if slope > 0 else time)


def _pull(relay: Relay, q: float, edge: float) -> float:
    """s' on the edge with the force off: minus the mean force of sliding."""
    return -(relay.omega**2) * q + (relay.slope - relay.damping) * (edge - relay.slope * q)


def _slide(relay: Relay, q: float, edge: float, low: float, high: float) -> tuple[float, float]:
    """The duration of sliding along an edge, inf where it does not end, and the pull (low or high) at its end."""
    slope, drift = relay.slope, edge - relay.slope * q
    start = _pull(relay, q, edge)
    change = -(relay.omega**2) - slope * (slope - relay.damping)  # of the pull with q
    best, reached = np.inf, low
    for bound in (low, high):
        if change * drift == 0 or (bound - start) / (change * drift) <= 0:
            continue
        ratio = (bound - start) / (change * drift)  # ∫ e^{-λτ} dτ needed
        if slope > 0 and slope * ratio >= 1:
            continue
        time = -np.log1p(-slope * ratio) / slope if slope > 0 else ratio
        if time < best:
            best, reached = time, bound
    return best, reached


def _sliding(relay: Relay, start: float, end: float, q: float, v: float, edge: float) -> Segment:
    slope = relay.slope
    if slope == 0:
        return Segment(start, end, q, v, -_pull(relay, q, edge), relay.omega**2 * edge, 0.0, True)
    settled = -_pull(relay, edge / slope, edge)
    return Segment(start, end, q, v, settled, 0.0, -_pull(relay, q, edge) - settled, True)


def kernels(omega: ArrayLike, c: ArrayLike, time: ArrayLike) -> tuple[Any, Any, Any, Any]:
    """h, h', ∫h and ∫∫h of q'' + c q' + ω² q = δ(t), from rest; arrays broadcast."""
    if np.ndim(omega) == 0 and np.ndim(time) == 0:
        return _kernels(float(omega), float(c), float(time))  # type: ignore[arg-type]
    omega, c, time = np.broadcast_arrays(np.asarray(omega, float), np.asarray(c, float), np.asarray(time, float))
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = 0.5 * c
        r = np.sqrt(sigma**2 - omega**2 + 0j)
        slow, fast = np.exp((r - sigma) * time), np.exp((-r - sigma) * time)
        near = np.abs(r * time) < 1e-5
        h = np.where(near, time * np.exp(-sigma * time), ((slow - fast) / (2 * r)).real)
        dh = 0.5 * (slow + fast).real - sigma * h
        square = omega**2
        once = np.where(square > 0, (1 - dh - c * h) / square, np.where(c > 0, (time - h) / c, 0.5 * time**2))
        half = np.sin(0.5 * omega * time)
        once = np.where((c == 0) & (square > 0), 2 * half**2 / square, once)
        twice = np.where(
            square > 0, (time - h - c * once) / square, np.where(c > 0, (0.5 * time**2 - once) / c, time**3 / 6)
        )
    return h, dh, once, twice


def _kernels(omega: float, c: float, time: float) -> tuple[float, float, float, float]:
    """`kernels` of scalars, without the overhead of arrays."""
    sigma = 0.5 * c
    r = cmath.sqrt(sigma**2 - omega**2)
    slow, fast = cmath.exp((r - sigma) * time), cmath.exp((-r - sigma) * time)
    h = time * np.exp(-sigma * time) if abs(r * time) < 1e-5 else ((slow - fast) / (2 * r)).real
    dh = 0.5 * (slow + fast).real - sigma * h
    if omega > 0:
        once = 2 * np.sin(0.5 * omega * time) ** 2 / omega**2 if c == 0 else (1 - dh - c * h) / omega**2
        twice = (time - h - c * once) / omega**2
    elif c > 0:
        once = (time - h) / c
        twice = (0.5 * time**2 - once) / c
    else:
        once, twice = 0.5 * time**2, time**3 / 6
    return h, dh, once, twice


def travel(
    omega: float | Floats,
    c: float | Floats,
    time: float | Floats,
    q: float | Floats,
    v: float | Floats,
    steady: float | Floats,
    ramp: float | Floats = 0.0,
    fading: float | Floats = 0.0,
    slope: float | Floats = 0.0,
) -> tuple[Any, Any]:
    """(q, q') after `time` under f(τ) = steady + ramp τ + fading e^{-λτ}; arrays broadcast."""
    h, dh, once, twice = kernels(omega, c, time)
    position = q * (dh + c * h) + v * h + steady * once + ramp * twice
    rate = v * dh - q * omega**2 * h + steady * h + ramp * once
    if np.any(fading):
        # at a pole of an overdamped mode the fraction is 0/0: λ is shifted by 1e-7 of itself
        slope = np.where(slope**2 - c * slope + omega**2 == 0, (1 + 1e-7) * slope, slope)
        fade = np.exp(-slope * time)
        share = fading / (slope**2 - c * slope + omega**2)
        position = position + share * (fade - (dh + c * h) + slope * h)
        rate = rate + share * (-slope * fade + slope * dh + omega**2 * h)
    return position, rate
