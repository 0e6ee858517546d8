"""A design on a rig: its law and estimator by the rig's own actuators and sensors, and designed anew for another."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from workbench.design.estimation.controller import Controller
from workbench.design.estimation.digital import sampled
from workbench.design.estimation.observers import kalman
from workbench.design.laws.coupled import controlled_plant
from workbench.design.laws.imsc import imsc, pole_gains
from workbench.design.laws.law import DesignError, Law, separation
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.rig_loop import LoopTest, named
from workbench.design.placement.task import PlacementTask
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import MEASURED, Sensor
from workbench.rig.statespace import output_matrix
from workbench.robust.compensation import Loop, check_rate, without
from workbench.robust.plain_law import struck_by
from workbench.robust.small_motion import loop_poles
from workbench.structure.domain import Between, Domain, NamedPoints, Patch, Where
from workbench.structure.modes import Modes, mac

Design = Law | OnOffLaw | Controller | PlacementTask

PERIODS = 25  # of the lowest controlled mode: the length of a test
MOST_SAMPLES = 6000
UNMOVED, GRID = 1e-9, 33  # of the largest displacement of a mode: what does not move; points where it is looked for
SAME_PLACE = 0.01  # of the size of the structure: farther apart, two places are not the same
SPEEDS = tuple(10.0**k for k in np.arange(8.0, -2.1, -0.5))  # of the default Kalman filter: noise over what is stated
ENOUGH, BETTER = 0.8, 1.02  # of the damping designed for; a faster filter must give so much more


def law_of(design: Law | OnOffLaw | Controller) -> Law | OnOffLaw:
    """The law of a design, on-off control among them."""
    return design.law if isinstance(design, Controller) else design


def controlled_by(design: Design) -> tuple[int, ...]:
    """The controlled modes of a design, zero-based.

    Raises:
        TypeError: no design.
    """
    if not isinstance(design, Design):
        raise TypeError(
            f"the controller in use is a law, a controller or a placement task; got {type(design).__name__}: make one"
            " by imsc, coupled_lqr, coupled_poles or on_off, with an estimator by luenberger or kalman"
        )
    return tuple(range(design.n_controlled)) if isinstance(design, PlacementTask) else law_of(design).controlled


def impulse_test(
    rig: Rig,
    controlled: Sequence[int],
    sample_time: float,
    impulse_at: Where | None = None,
    *,
    level: np.ndarray | None = None,
    seed: int | None = 0,
) -> LoopTest:
    """An impulse, and the free motion after it for 25 periods of the lowest controlled mode.

    Args:
        rig: nominal.
        controlled: zero-based modes.
        sample_time: s.
        impulse_at: the place; unless given, that of a hammer or of the first actuator, or where that moves none of the
            controlled modes, as at a clamp that a motor turns, the place that moves all of them most.
        level: (n_outputs,) readings that the nominal rig without control then peaks at, in the median of the sensors;
            None for a unit impulse.
        seed: of the noise.

    Raises:
        DesignError: rigid modes alone, a sample time too long for the modes, or a place where none of them moves.
        ValueError: a place that the structure does not have.
    """
    check_rate(rig.modes, controlled, sample_time)
    omega = rig.modes.omega[list(controlled)]
    omega = omega[omega > 0]
    if not omega.size:
        raise DesignError("the controlled modes are all rigid, so they have no period: give a test of your own")
    impulse_at = _impulse_place(rig, controlled, impulse_at)
    shape = rig.modes.phi_at(impulse_at)
    n_samples = int(min(max(PERIODS * 2.0 * np.pi / omega.min() / sample_time, 64), MOST_SAMPLES))
    test = LoopTest(n_samples, sample_time, impulse_at, seed=seed)
    if level is None:
        return test
    damped = np.exp(-0.5 * np.diag(rig.modes.damping)[:, None] * test.time)
    omega = np.maximum(rig.modes.omega, 1e-9)[:, None]
    motion = (
        damped * np.sin(omega * test.time) * (shape[:, None] / omega),
        damped * np.cos(omega * test.time) * shape[:, None],
    )
    peaks = []
    for sensor, reached in zip(rig.sensors, level, strict=True):
        derivative, order = MEASURED[sensor.quantity]
        if order < 2:
            row = sensor.gain * rig.modes.phi_at(sensor.at, derivative, direction=sensor.direction)
            peaks.append(reached / max(np.abs(row @ motion[order]).max(), 1e-300))
    return replace(test, impulse=float(np.median(peaks)) if peaks else 1.0)


def _impulse_place(rig: Rig, controlled: Sequence[int], given: Where | None) -> Where:
    """Where an impulse moves the controlled modes: the place given, or one that suits."""
    places = rig.modes.domain.grid(GRID)
    shapes = np.abs(rig.modes.phi(places))
    at = given
    if at is None:
        at = _place_of(rig.modes.domain, next((a for a in rig.actuators if a.direct), rig.actuators[0]))
    turns = isinstance(at, Patch)  # it has moments along its edges, and no displacement
    if not turns and np.abs(rig.modes.phi_at(at)[list(controlled)]).max() > UNMOVED * shapes.max():
        return at
    if given is not None:
        raise DesignError(
            f"an impulse at {rig.modes.domain.text(at)} moves none of the controlled modes, so it tests no"
            " controller; strike elsewhere"
        )
    moved = shapes[:, list(controlled)]
    most: Where = places[int((moved / np.maximum(moved.max(axis=0), 1e-300)).min(axis=1).argmax())]
    return most


def _place_of(domain: Domain, port: Actuator) -> Where:
    """Its place; of a node and a direction the point that moves so."""
    if not isinstance(domain, NamedPoints) or port.direction is None:
        return port.at
    places = port.at if isinstance(port.at, Between) else (port.at,)
    names, _, _ = domain.slope(list(places), int(port.kind == "moment"), port.direction)
    return Between(*names) if isinstance(port.at, Between) else names[0]


def fitted(rig: Rig, design: Design, test: LoopTest) -> Loop:
    """A design on the sensors and actuators of a rig, by their places and names; a law alone reads a Kalman filter.

    Raises:
        DesignError: a sensor or an actuator that the rig does not have, or a gain given by hand.
    """
    if isinstance(design, PlacementTask):
        actuators = [a for a in rig.actuators if not a.direct]
        design = imsc(rig.modes, design.n_controlled, actuators, weight=design.weight)
    law = law_of(design)
    if law.designed_by is None:
        raise DesignError(
            f"{law.name} was given by its gain, which no other structure can be designed from: make it by imsc,"
            " imsc_poles, coupled_lqr, coupled_poles or on_off"
        )
    law = replace(law, actuators=tuple(_same_actuator(rig, a) for a in law.actuators))
    linear = law if isinstance(law, Law) else _without_gain(law)
    if isinstance(design, Controller):
        if design.designed_by is None:
            raise DesignError(
                f"{design.name} does not say how its estimator was designed: make it by luenberger, kalman or"
                " filtered(law, hermite_filter(...))"
            )
        return Loop(rig.modes, law, replace(design, law=linear, sensors=_same_sensors(rig, design.sensors)))
    return Loop(rig.modes, law, default_estimator(rig, linear, test))


def _without_gain(law: OnOffLaw) -> Law:
    return Law(np.zeros((len(law.actuators), 2 * len(law.controlled))), law.controlled, law.actuators, law.name)


def default_estimator(rig: Rig, law: Law, test: LoopTest) -> Controller:
    """A Kalman filter on all sensors of motion and rate, as fast as the loop of all modes bears.

    The intensity of the readings' noise is σ² T, and the modal forces are those that excite each mode within the test
    to the speed that the impulse gives it, by a factor that leaves the loop of the nominal rig with the most damping of
    its controlled modes, residual ones stable.
    """
    sensors = without([s for s in rig.sensors if MEASURED[s.quantity][1] < 2])
    if not sensors:
        raise DesignError(
            "no sensor of the rig reads displacement or velocity, and the observers here do not read accelerations; add"
            " one that does"
        )
    index = list(law.controlled)
    at = test.impulse_at
    shape = struck_by(rig.modes, rig.actuators[0]) if at is None else rig.modes.phi_at(at)
    speed = np.abs(test.impulse * shape[index])
    speed = np.maximum(speed, 0.1 * speed.max())
    push = speed**2 / (test.n_samples * test.sample_time)
    shapes = np.abs(output_matrix(rig.modes, sensors)[:, index])
    rates = np.array([MEASURED[s.quantity][1] for s in sensors])[:, None]
    signal = (shapes * speed / np.maximum(rig.modes.omega[index], 1e-9) ** (1 - rates)).max(axis=1)
    noise = np.maximum([s.noise_std for s in sensors], 1e-6 * signal) ** 2 * test.sample_time
    damping = _design_damping(rig.modes, law)
    best, least = None, -np.inf
    for factor in SPEEDS:
        try:
            controller = kalman(rig.modes, law, sensors, disturbance=push, noise=factor * noise)
        except DesignError:
            continue
        found = loop_poles(rig, sampled(controller, test.sample_time))
        # fast enough for the damping that the law was designed for is enough; the slower one is the more robust
        reached = float(np.minimum(found.damping[index] / damping, ENOUGH).mean())
        if found.spectral_radius < 1.0 and reached > least * BETTER:
            best, least = controller, reached
    if best is None:
        raise DesignError(
            f"no Kalman filter on {', '.join(s.name for s in sensors)} leaves the loop of all modes stable; pass"
            " a controller, increase R, or control fewer modes"
        )
    return best


def _design_damping(modes: Modes, law: Law) -> np.ndarray:
    """Damping ratios (n_controlled,) with exact modal coordinates fed back; those without control for a law of none."""
    a, b = controlled_plant(modes, law.controlled, law.actuators)
    poles = np.linalg.eigvals(a - b @ law.gain)
    poles = poles[poles.imag >= 0]
    ratios = -poles.real / np.maximum(np.abs(poles), 1e-300)
    order = np.argsort(np.abs(poles))[: law.n_controlled]
    return np.maximum(np.resize(ratios[order], law.n_controlled), 1e-6)


def _same_actuator(rig: Rig, wanted: Actuator) -> Actuator:
    there = [a for a in rig.actuators if a.kind == wanted.kind and separation(rig.modes, a, wanted) < SAME_PLACE]
    # the name alone says nothing where the place is another: gains for one place mean another law at the other
    found = next((a for a in there if a.name == wanted.name), next((a for a in there if not a.direct), None))
    if found is not None:
        return replace(found)
    names = ", ".join(f"{a.name} ({a.kind}) at {rig.modes.domain.text(a.at)}" for a in rig.actuators)
    raise DesignError(
        f"the law drives {wanted.name} ({wanted.kind}) at {rig.modes.domain.text(wanted.at)}, where the rig has no"
        f" actuator: it has {names}; design the law for these"
    )


def _same_sensors(rig: Rig, wanted: Sequence[Sensor]) -> tuple[Sensor, ...]:
    found = []
    for one in wanted:
        alike = [s for s in rig.sensors if s.quantity == one.quantity and separation(rig.modes, s, one) < SAME_PLACE]
        if not alike:
            names = ", ".join(f"{s.name} ({s.quantity} at {rig.modes.domain.text(s.at)})" for s in rig.sensors)
            raise DesignError(
                f"the controller reads {one.quantity} at {rig.modes.domain.text(one.at)}, where the rig has no such"
                f" sensor: it has {names}; design the estimator for these"
            )
        found.append(next((s for s in alike if s.name == one.name), alike[0]))
    return tuple(found)


def designed_anew(loop: Loop, rig: Rig, modes: Modes, removed: Sequence[str] = ()) -> Loop:
    """The same law and estimator, designed with their settings for the modes of another rig.

    Poles of a law move with the natural frequencies, p ω / ω_old: they ask for damping, and holding a mode at the
    frequency that another rig had would take far more force than damping it.

    Args:
        loop: as it is.
        rig: whose actuators and sensors are taken, by name.
        modes: of the rig in its motion.
        removed: sensors that are not to be read.

    Raises:
        DesignError: modes that cannot be controlled or seen on that rig.
    """
    controlled = paired(loop.modes, modes, loop.law.controlled)
    actuators = [named(rig.actuators, old.name) for old in loop.law.actuators]
    assert loop.law.designed_by is not None and loop.controller.designed_by is not None
    if isinstance(loop.law, OnOffLaw):
        modes = replace(modes, damping=np.diag(np.diag(modes.damping)))
    law = _moved_along(loop, modes, controlled)(modes, controlled=controlled, actuators=actuators)
    linear = law if isinstance(law, Law) else _without_gain(law)
    sensors = [named(rig.sensors, old.name) for old in loop.controller.sensors]
    controller = _estimated(loop.controller, modes, linear, without(sensors), removed)
    return Loop(modes, law, controller)


def tuned(loop: Loop, rig: Rig, *, weight: float = 1.0, noise: float = 1.0) -> Loop | None:
    """The loop designed for multiples of its settings; None where its design has no such setting.

    A law by poles has no weight: it feeds back 1/√weight times as much, as a regulator of light damping does.

    Args:
        loop: as it is.
        rig: whose actuators and sensors are taken, by name.
        weight: of the law's forces, over its own.
        noise: of the readings of a Kalman filter, over its own.

    Raises:
        DesignError: nothing can be designed with them.
    """
    parts: dict[str, Any] = {}
    for name, setting, factor in (("law", "weight", weight), ("controller", "noise", noise)):
        part: Any = getattr(loop, name)
        keywords = getattr(part.designed_by, "keywords", {})
        if factor == 1.0:
            continue
        if setting in keywords:
            changed = {setting: factor * np.asarray(keywords[setting])}
        elif name == "law" and "poles" in keywords:
            changed = {"poles": _moved(np.asarray(keywords["poles"]), loop, 1.0 / np.sqrt(factor))}
        else:
            return None
        parts[name] = replace(part, designed_by=partial(part.designed_by.func, **{**keywords, **changed}))
    return designed_anew(loop._replace(**parts), rig, loop.modes)


def _moved_along(loop: Loop, modes: Modes, controlled: Sequence[int]) -> Any:
    """The design of the loop's law, its poles, where it has some, over the natural frequencies of other modes."""
    design: Any = loop.law.designed_by
    poles = getattr(design, "keywords", {}).get("poles")
    if poles is None:
        return design
    old, new = loop.modes.omega[list(loop.law.controlled)], modes.omega[list(controlled)]
    scale = np.where((old > 0) & (new > 0), new / np.where(old > 0, old, 1.0), 1.0)
    return partial(design.func, **{**design.keywords, "poles": scale * np.asarray(poles)})


def _moved(poles: np.ndarray, loop: Loop, gain: float) -> np.ndarray:
    """The poles (n_controlled,) where each mode is fed back `gain` times what puts them at `poles`.

    s² + (c + gain g2) s + ω² + gain g1, with g1 and g2 of `pole_gains`.
    """
    index = list(loop.law.controlled)
    omega, c = loop.modes.omega[index], np.diag(loop.modes.damping)[index]
    g1, g2 = pole_gains(omega, poles, c)
    half, square = 0.5 * (c + gain * g2), omega**2 + gain * g1
    if (square <= half**2).any():
        raise DesignError(f"{gain:.3g} times the gain leaves a mode that does not oscillate")
    return -half + 1j * np.sqrt(square - half**2)


def _estimated(
    old: Controller, modes: Modes, law: Law, sensors: Sequence[Sensor], removed: Sequence[str]
) -> Controller:
    assert old.designed_by is not None
    kept = [i for i, s in enumerate(sensors) if s.name not in removed]
    design: Any = old.designed_by
    anew: Controller
    if removed and np.ndim(noise := getattr(design, "keywords", {}).get("noise", 0.0)):
        chosen = np.asarray(noise)[kept] if np.ndim(noise) == 1 else np.asarray(noise)[np.ix_(kept, kept)]
        anew = design.func(modes, law, [sensors[i] for i in kept], **{**design.keywords, "noise": chosen})
    else:
        anew = design(modes, law, [sensors[i] for i in kept])
    if anew.state.size == 0:  # a filter's own sensors stand where the rig's do
        anew = replace(anew, sensors=tuple(sensors))
    return anew


def paired(nominal: Modes, modes: Modes, controlled: Sequence[int]) -> tuple[int, ...]:
    """Which modes of a changed structure are the controlled ones, by their shapes; increasing.

    Raises:
        DesignError: more modes controlled than there are.
    """
    if len(controlled) > modes.n_modes:
        raise DesignError(f"{len(controlled)} modes are controlled; the corrected rig shows {modes.n_modes}")
    grid = nominal.domain.grid(8 * nominal.n_modes + 9)
    alike = mac(nominal.phi(grid)[:, list(controlled)], modes.phi(grid))
    _, found = linear_sum_assignment(-alike)
    return tuple(sorted(int(r) for r in found))
