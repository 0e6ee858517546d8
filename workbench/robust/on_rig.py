"""A design on a rig: its law and estimator on the rig's actuators and sensors, and their redesign for another rig."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np
from scipy.optimize import linear_sum_assignment

from workbench.design.estimation.controller import Controller
from workbench.design.estimation.digital import sampled
from workbench.design.estimation.observers import kalman_controller
from workbench.design.laws.coupled import controlled_plant
from workbench.design.laws.imsc import imsc, pole_gains
from workbench.design.laws.law import DesignError, Law, separation
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.rig_loop import LoopTest, P, named
from workbench.design.placement.task import PlacementTask
from workbench.rig.actuators import Actuator, without_crosstalk
from workbench.rig.rig import Rig
from workbench.rig.sensors import MEASURED, Sensor
from workbench.rig.statespace import output_matrix
from workbench.robust.compensation import Loop, without_faults
from workbench.robust.impulse import impulse_speeds
from workbench.robust.small_motion import loop_poles
from workbench.structure.modes import Modes, mac

Design = Law | OnOffLaw | Controller | PlacementTask

SAME_PLACE = 0.01  # of the size of the structure: largest distance of two places that count as the same
SPEEDS = tuple(10.0**k for k in np.arange(8.0, -2.1, -0.5))  # of the default Kalman filter: noise over the stated
ENOUGH, BETTER = 0.8, 1.02  # sufficient share of the designed damping; least factor by which a faster filter is better


def law_of(design: Law | OnOffLaw | Controller) -> Law | OnOffLaw:
    """The law of a design, linear or on-off."""
    return design.law if isinstance(design, Controller) else design


def controlled_by(design: Design) -> tuple[int, ...]:
    """The controlled modes of a design, zero-based."""
    if not isinstance(design, Design):
        raise TypeError(
            f"the controller in use is a law, a controller or a placement task; got {type(design).__name__}: make one"
            " by imsc, coupled_lqr, coupled_poles or on_off, with an estimator by luenberger_controller or"
            " kalman_controller"
        )
    return tuple(range(design.n_controlled)) if isinstance(design, PlacementTask) else law_of(design).controlled


def loop_on_rig(rig: Rig, design: Design, test: LoopTest) -> Loop:
    """A design on the sensors and actuators of a rig, matched by places and names; a law alone gets a Kalman filter."""
    if isinstance(design, PlacementTask):
        actuators = without_crosstalk([a for a in rig.actuators if not a.direct])
        design = imsc(rig.modes, design.n_controlled, actuators, weight=design.weight)
    law = law_of(design)
    if law.designed_by is None:
        raise DesignError(
            f"{law.name} was given by its gain, so its design cannot be repeated for another structure: make it by"
            " imsc, imsc_poles, coupled_lqr, coupled_poles or on_off"
        )
    law = replace(law, actuators=without_crosstalk([_same_actuator(rig, a) for a in law.actuators]))
    if isinstance(design, Controller):
        if design.designed_by is None:
            raise DesignError(
                f"{design.name} does not say how its estimator was designed: make it by luenberger_controller,"
                " kalman_controller or filtered(law, hermite_filter(...))"
            )
        sensors = tuple(_same_sensor(rig, s) for s in design.sensors)
        return Loop(rig.modes, law, replace(design, law=_linear(law), sensors=sensors))
    return Loop(rig.modes, law, default_estimator(rig, _linear(law), test))


def _linear(law: Law | OnOffLaw) -> Law:
    """The law; of an on-off law, a linear one of zero gain with its modes and actuators."""
    if isinstance(law, Law):
        return law
    return Law(np.zeros((len(law.actuators), 2 * len(law.controlled))), law.controlled, law.actuators, law.name)


def default_estimator(rig: Rig, law: Law, test: LoopTest) -> Controller:
    """A Kalman filter on all sensors of displacement and velocity, as fast as the loop of all modes permits.

    The intensity of the readings' noise is σ² T times a factor. The intensity of the modal forces excites each mode
    within the test to the speed that the impulse gives it. The factor is chosen for the most damping of the controlled
    modes in the loop of the nominal rig, with stable residual modes.
    """
    sensors = without_faults([s for s in rig.sensors if MEASURED[s.quantity][1] < 2])
    if not sensors:
        raise DesignError(
            "no sensor of the rig reads displacement or velocity, and observers here do not use accelerations; add such"
            " a sensor"
        )
    index = list(law.controlled)
    speed = impulse_speeds(rig.modes, index, test.impulse, test.impulse_at, rig.actuators[0])
    disturbance = speed**2 / (test.n_samples * test.sample_time)
    shapes = np.abs(output_matrix(rig.modes, sensors)[:, index])
    rates = np.array([MEASURED[s.quantity][1] for s in sensors])[:, None]
    signal = (shapes * speed / np.maximum(rig.modes.omega[index], 1e-9) ** (1 - rates)).max(axis=1)
    noise = np.maximum([s.noise_std for s in sensors], 1e-6 * signal) ** 2 * test.sample_time
    damping = _design_damping(rig.modes, law)
    best, least = None, -np.inf
    for factor in SPEEDS:
        try:
            controller = kalman_controller(rig.modes, law, sensors, disturbance=disturbance, noise=factor * noise)
        except DesignError:
            continue
        loop = loop_poles(rig, sampled(controller, test.sample_time))
        # beyond a sufficient share of the designed damping the slower filter is preferred, as the more robust one
        achieved = float(np.minimum(loop.damping[index] / damping, ENOUGH).mean())
        if loop.spectral_radius < 1.0 and achieved > least * BETTER:
            best, least = controller, achieved
    if best is None:
        raise DesignError(
            f"no Kalman filter on {', '.join(s.name for s in sensors)} leaves the loop of all modes stable; pass"
            " a controller, increase R, or control fewer modes"
        )
    return best


def _design_damping(modes: Modes, law: Law) -> np.ndarray:
    """Damping ratios (n_controlled,) of a law on exact modal coordinates; open-loop ratios for zero gain."""
    a, b = controlled_plant(modes, law.controlled, law.actuators)
    poles = np.linalg.eigvals(a - b @ law.gain)
    poles = poles[poles.imag >= 0]
    ratios = -poles.real / np.maximum(np.abs(poles), 1e-300)
    order = np.argsort(np.abs(poles))[: law.n_controlled]
    return np.maximum(np.resize(ratios[order], law.n_controlled), 1e-6)


def _same_actuator(rig: Rig, wanted: Actuator) -> Actuator:
    """The rig's actuator of the same kind at the same place, by preference of the same name."""
    near = _near(rig, rig.actuators, wanted)
    # an actuator of the same name at another place does not do: the gains are for their places
    match = next((a for a in near if a.name == wanted.name), next((a for a in near if not a.direct), None))
    if match is not None:
        return match
    text = rig.modes.domain.text
    names = ", ".join(f"{a.name} ({a.quantity}) at {text(a.at)}" for a in rig.actuators)
    raise DesignError(
        f"the law drives {wanted.name} ({wanted.quantity}) at {text(wanted.at)}, where the rig has no actuator: it has"
        f" {names}; design the law for these"
    )


def _same_sensor(rig: Rig, wanted: Sensor) -> Sensor:
    """The rig's sensor of the same quantity at the same place, by preference of the same name."""
    near = _near(rig, rig.sensors, wanted)
    if near:
        return next((s for s in near if s.name == wanted.name), near[0])
    text = rig.modes.domain.text
    names = ", ".join(f"{s.name} ({s.quantity} at {text(s.at)})" for s in rig.sensors)
    raise DesignError(
        f"the controller reads {wanted.quantity} at {text(wanted.at)}, where the rig has no such sensor: it has"
        f" {names}; design the estimator for these"
    )


def _near(rig: Rig, parts: Sequence[P], wanted: P) -> list[P]:
    """The parts of the same quantity at the same place."""
    return [x for x in parts if x.quantity == wanted.quantity and separation(rig.modes, x, wanted) < SAME_PLACE]


def redesigned_for(loop: Loop, rig: Rig, modes: Modes, removed: Sequence[str] = ()) -> Loop:
    """The loop with its law and estimator redesigned, with the same settings, for the modes of another rig.

    Poles of a law scale with the natural frequencies, p ω / ω_old: they are given for damping, and to keep a mode at
    the frequency of the other rig would take far more force.

    Args:
        loop: designed before.
        rig: has the actuators and sensors of the loop, by name.
        modes: of the rig, linearised about its motion.
        removed: names of sensors not to be read.
    """
    controlled = paired(loop.modes, modes, loop.law.controlled)
    actuators = without_crosstalk([named(rig.actuators, one.name) for one in loop.law.actuators])
    assert loop.law.designed_by is not None and loop.controller.designed_by is not None
    if isinstance(loop.law, OnOffLaw):
        modes = replace(modes, damping=np.diag(np.diag(modes.damping)))
    design: Any = loop.law.designed_by
    if "poles" in settings(loop.law):
        old, new = loop.modes.omega[list(loop.law.controlled)], modes.omega[list(controlled)]
        scale = np.where((old > 0) & (new > 0), new / np.where(old > 0, old, 1.0), 1.0)
        design = partial(design, poles=scale * np.asarray(settings(loop.law)["poles"]))
    law = design(modes, controlled=controlled, actuators=actuators)
    sensors = without_faults([named(rig.sensors, one.name) for one in loop.controller.sensors])
    return Loop(modes, law, _redesigned_estimator(loop.controller, modes, _linear(law), sensors, removed))


def tuned(loop: Loop, rig: Rig, *, weight: float = 1.0, noise: float = 1.0) -> Loop | None:
    """The loop redesigned with multiples of its settings; None where its design has no such setting.

    For a law by poles, which has no weight, the gain changes by 1/√weight, as for a lightly damped regulator.

    Args:
        loop: designed before.
        rig: has the actuators and sensors of the loop, by name.
        weight: factor of the law's control weight.
        noise: factor of the noise intensity of a Kalman filter.
    """
    law, controller = cast(Any, loop.law), cast(Any, loop.controller)
    if weight != 1.0:
        if "weight" in settings(law):
            changed = {"weight": weight * np.asarray(settings(law)["weight"])}
        elif "poles" in settings(law):
            changed = {"poles": _poles_of_gain(np.asarray(settings(law)["poles"]), loop, 1.0 / np.sqrt(weight))}
        else:
            return None
        law = replace(law, designed_by=partial(law.designed_by, **changed))
    if noise != 1.0:
        if "noise" not in settings(controller):
            return None
        design = partial(controller.designed_by, noise=noise * np.asarray(settings(controller)["noise"]))
        controller = replace(controller, designed_by=design)
    return redesigned_for(Loop(loop.modes, law, controller), rig, loop.modes)


def settings(part: Law | OnOffLaw | Controller) -> Mapping[str, Any]:
    """The settings by which a law or an estimator was designed, as {"weight": R}; empty where not known."""
    return getattr(part.designed_by, "keywords", {})


def _poles_of_gain(poles: np.ndarray, loop: Loop, gain: float) -> np.ndarray:
    """The poles (n_controlled,) for `gain` times the modal gains that assign `poles`.

    They are the roots of s² + (c + gain g2) s + ω² + gain g1, with g1 and g2 of `pole_gains`.
    """
    index = list(loop.law.controlled)
    omega, c = loop.modes.omega[index], np.diag(loop.modes.damping)[index]
    g1, g2 = pole_gains(omega, poles, c)
    half, square = 0.5 * (c + gain * g2), omega**2 + gain * g1
    if (square <= half**2).any():
        raise DesignError(f"{gain:.3g} times the gain leaves a mode that does not oscillate")
    return -half + 1j * np.sqrt(square - half**2)


def _redesigned_estimator(
    old: Controller, modes: Modes, law: Law, sensors: Sequence[Sensor], removed: Sequence[str]
) -> Controller:
    """The controller with its estimator redesigned for other modes, a law and sensors without the removed ones."""
    kept = [i for i, s in enumerate(sensors) if s.name not in removed]
    design: Any = old.designed_by
    noise = np.asarray(settings(old).get("noise", 0.0))
    if removed and noise.ndim:
        design = partial(design, noise=noise[kept] if noise.ndim == 1 else noise[np.ix_(kept, kept)])
    new: Controller = design(modes, law, [sensors[i] for i in kept])
    # a modal filter places its own sensors; those of the rig are at the same places
    return replace(new, sensors=tuple(sensors)) if new.static else new


def paired(nominal: Modes, modes: Modes, controlled: Sequence[int]) -> tuple[int, ...]:
    """Indices of the modes of a changed structure that pair with the controlled ones, by MAC; increasing."""
    if len(controlled) > modes.n_modes:
        raise DesignError(f"{len(controlled)} modes are controlled; the corrected rig has {modes.n_modes}")
    grid = nominal.domain.grid(8 * nominal.n_modes + 9)
    assurance = mac(nominal.phi(grid)[:, list(controlled)], modes.phi(grid))
    _, pairs = linear_sum_assignment(-assurance)
    return tuple(sorted(int(r) for r in pairs))
