"""The steps of a redesign: compensations, tuning, and removal of faulty sensors, each kept where it helps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from workbench.design.estimation.digital import DigitalController
from workbench.design.laws.law import DesignError
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.rig_loop import LoopRun, LoopTest, named, run_loop
from workbench.records.units import Units
from workbench.rig.actuators import Actuator
from workbench.rig.elements import CoulombFriction
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.robust.compensation import STEPS, Loop, compensated, without_faults
from workbench.robust.on_rig import redesigned_for, settings, tuned
from workbench.robust.small_motion import loop_poles
from workbench.robust.verification import settling

DIVERGENT = 1e3  # loss above which the motion is called divergent
LOSS = "performance loss: summed relative excess of vibration and effort over ideal actuators and sensors"
LEAST_SHOWN = 1e-4  # loss below which its size is not stated
GAINED = 0.005  # least reduction of the loss by a step; least change of the cost for a change of the controller
# factors of the control weight, and of the noise of the Kalman filter, that are tried
WEIGHTS = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25)  # weight, where actuators saturate
SLOWER = (1.0, 2.0, 5.0, 10.0)  # noise, with these
SOFTER = (1.0, 3.0, 10.0, 30.0, 100.0)  # weight, where the law is unstable as designed
SLOWEST = tuple(10.0**k for k in np.arange(0.0, 9.1, 0.5))  # noise, with these
SPEEDS = (1e-3, 1e-2, 0.1, 10.0, 100.0)  # noise, with the law unchanged
# what a step compensates in an actuator: in words, and by its attribute
COMPENSATED = {
    "delay": (("delay", "delay"), ("lag", "time_constant")),
    "dead zone": (("dead zone", "dead_zone"), ("bias", "bias")),
    "saturation": (("limit", "limit"), ("rate", "rate_limit")),
}


@dataclass(frozen=True)
class Step:
    """One step from the present controller to the redesigned one.

    Attributes:
        name: such as "delay".
        what: in words, with the compensated values.
        vibration, effort, work: ∫ of the energy of all modes, ∫ FᵀF dt and W = Σ_r |W_r|, on the corrected rig under
            test, with this step and those kept before.
        excess: relative excess over the redesigned law with ideal actuators and sensors: of the vibration of
            controlled modes, of that of residual modes (over that of all modes), and of the effort. Each is 0 or more,
            so that a gain in one cannot offset a loss in another.
        loss: sum of the three.
        cost: J / J₀ - 1, J₀ of the same ideal loop; see `Redesign.criterion`. Below zero the loop is better.
        kept: whether the step reduces the loss or the cost enough to be kept.
    """

    name: str
    what: str
    vibration: float
    effort: float
    work: float
    excess: tuple[float, float, float]
    loss: float
    cost: float
    kept: bool = True

    @property
    def diverges(self) -> bool:
        """Whether the motion grows so far that the loss is not stated in per cent."""
        return not self.loss < DIVERGENT

    @property
    def in_new_controller(self) -> str:
        """Whether the new controller has the step, as text; empty for the present controller."""
        return "" if self.name == "present" else "yes" if self.kept else "no"

    @property
    def lost(self) -> str:
        """The loss in words."""
        if 0.0 < self.loss < LEAST_SHOWN:
            return f"below {100.0 * LEAST_SHOWN:g} %"
        return "diverges" if self.diverges else f"{100.0 * self.loss:.3g} %"


class Search:
    """The search for the redesigned controller on a corrected rig under test.

    Attributes:
        loop, controller: law and estimator, and their digital controller, with the steps kept so far.
        steps: from the present controller on.
        weight: ρ of the cost J.
        criterion: see `Redesign`; "cost" where the test is too short for a settling time.
    """

    def __init__(
        self, rig: Rig, loop: Loop, test: LoopTest, present: DigitalController, criterion: str, units: Units
    ) -> None:
        self._rig, self._test, self._units = rig, test, units
        perfect = replace(rig, actuators=tuple(map(_perfect, rig.actuators)), sensors=without_faults(rig.sensors))
        self.loop, softened = _stabilised(perfect, loop, test)
        self._controlled = self.loop.law.controlled
        self._ideal = run_loop(perfect, compensated(perfect, self.loop, test.sample_time, ()), test)
        settles = _settling(self._ideal, self._controlled)
        self.criterion = "cost" if settles >= test.time[-1] else criterion
        if isinstance(self.loop.law, OnOffLaw):  # the forces of relays are given, so that their effort does not count
            self.weight = 0.0
        elif self.criterion == "settling":
            self.weight = settles / max(self._ideal.effort, 1e-300)
        else:
            self.weight = force_weight(self._ideal, self._controlled)
        self._least = max(self._cost(self._ideal), 1e-300)
        self._kept: list[str] = []
        self.controller = self._compensated(self.loop)
        designed = f"{self.loop.controller.name}, designed for the corrected rig{softened}"
        self._now = self._tried("law and estimator", designed, self.controller)
        self.steps = [self._tried("present", f"{present.name}, unchanged", present), self._now]

    def run(self) -> None:
        """Take the steps in turn: compensations, tuning, and sensors that are not read."""
        for name in STEPS:
            what = _losses(self._rig, self.loop, name, self._units)
            if what and self._offer(name, what, self._compensated(self.loop, name), self.loop):
                self._kept.append(name)
        self._tune()
        self._leave_out_sensors()

    def _compensated(self, loop: Loop, *more: str) -> DigitalController:
        """The controller of a loop with the compensations kept, and with more of them."""
        return compensated(self._rig, loop, self._test.sample_time, (*self._kept, *more))

    def _cost(self, run: LoopRun) -> float:
        """J of a run, see `Redesign.criterion`; inf where the motion diverges."""
        if not run.bounded:
            return np.inf
        first = _settling(run, self._controlled) if self.criterion == "settling" else 2.0 * _vibration(run)
        return self.weight * run.effort + first

    def _tried(self, name: str, what: str, controller: DigitalController) -> Step:
        run = run_loop(self._rig, controller, self._test)
        excess, cost = _excess(run, self._ideal, self._controlled), float(self._cost(run) / self._least - 1.0)
        effort, work = (run.effort, float(np.abs(run.work).sum())) if run.bounded else (np.inf, np.inf)
        return Step(name, what, _vibration(run), effort, work, excess, sum(excess), cost)

    def _offer(self, name: str, what: str, controller: DigitalController, loop: Loop) -> bool:
        """Whether a step reduces the loss enough to be kept."""
        step, now = self._tried(name, what, controller), self._now.loss
        helps = step.loss < now - GAINED or (name in STEPS and not np.isfinite(now))
        self.steps.append(replace(step, kept=helps))
        if helps:
            self._now, self.controller, self.loop = step, controller, loop
        return helps

    def _tune(self) -> None:
        """Try multiples of the settings of law and estimator."""
        designed = self.loop
        # with limited forces the effort is low: more gain reduces vibration, and a slower filter keeps residual modes,
        # which a limited force cannot follow, out of the commands
        if any(np.isfinite(named(self._rig.actuators, a.name).limit) for a in designed.law.actuators):
            for noise, weight in product(SLOWER, WEIGHTS):
                self._tune_once("gain", designed, weight, noise)
        designed = self.loop
        for noise in SPEEDS:
            self._tune_once("estimator", designed, 1.0, noise)

    def _tune_once(self, name: str, loop: Loop, weight: float, noise: float) -> None:
        other = _retuned(self._rig, loop, weight, noise)
        if other is None:
            return
        trial = self._compensated(other)
        step, now = self._tried(name, _tuning(loop, weight, noise), trial), self._now
        if name == "gain":
            helps = step.loss < now.loss - GAINED
        else:  # no part of the excess may be larger than both before this step and with the present controller
            allowed = np.maximum(now.excess, self.steps[0].excess)
            helps = step.cost < now.cost - GAINED and step.loss <= now.loss and bool((step.excess <= allowed).all())
        if helps and loop_poles(self._rig, trial, other.modes).spectral_radius < 1.0:
            self.steps = [*(s for s in self.steps if s.name != name), step]
            self._now, self.controller, self.loop = step, trial, other

    def _leave_out_sensors(self) -> None:
        full = self.loop
        removed: list[str] = []
        for name in _faulty(self._rig, full):
            try:
                fewer = redesigned_for(full, self._rig, full.modes, (*removed, name))
                trial = self._compensated(fewer)
            except DesignError:
                continue  # the modes are unobservable without this sensor
            if self._offer(f"without {name}", f"{name} is not read", trial, fewer):
                removed.append(name)


def _stabilised(rig: Rig, loop: Loop, test: LoopTest) -> tuple[Loop, str]:
    """The loop, detuned if it is unstable on a rig as designed, and the detuning in words.

    The first weight with a stable loop is taken, with the noise of least vibration; the loop as designed where none is
    stable.
    """

    def vibration(one: Loop) -> float:
        controller = compensated(rig, one, test.sample_time, ())
        unstable = loop_poles(rig, controller, loop.modes).spectral_radius >= 1.0
        return np.inf if unstable else _vibration(run_loop(rig, controller, test))

    if np.isfinite(vibration(loop)):
        return loop, ""
    for weight in SOFTER:
        trials = [(vibration(one), one, noise) for noise in SLOWEST if (one := _retuned(rig, loop, weight, noise))]
        least, best, noise = min(trials, key=lambda trial: trial[0], default=(np.inf, loop, 1.0))
        if np.isfinite(least):
            return best, f", {_tuning(loop, weight, noise)}: otherwise unstable"
    return loop, ""


def _retuned(rig: Rig, loop: Loop, weight: float, noise: float) -> Loop | None:
    """The loop with multiples of its settings; None where there is no such setting, or no design with it."""
    try:
        return tuned(loop, rig, weight=weight, noise=noise)
    except DesignError:
        return None


def weighted(loop: Loop) -> bool:
    """Whether the law minimises a cost that weights its forces."""
    return "weight" in settings(loop.law)


def _tuning(loop: Loop, weight: float, noise: float) -> str:
    """The changed settings of a law and its Kalman filter, in words."""
    of_law = ("weight", weight) if weighted(loop) else ("gain", 1.0 / np.sqrt(weight))
    return " and ".join(f"{what} × {by:.3g}" for what, by in (of_law, ("measurement noise", noise)) if by != 1)


def _faulty(rig: Rig, loop: Loop) -> list[str]:
    """Names of faulty sensors that an observer may leave out; none for a modal filter, which needs all its sensors."""
    if loop.controller.static or len(loop.controller.sensors) < 2:
        return []
    read = [named(rig.sensors, one.name) for one in loop.controller.sensors]
    return [s.name for s, faultless in zip(read, without_faults(read), strict=True) if s != faultless]


def _perfect(a: Actuator) -> Actuator:
    """The actuator with its gain, without delay, lag, limits and other imperfections."""
    unlimited = replace(a, limit=np.inf, rate_limit=np.inf, dead_zone=0.0, hysteresis_share=0.0)
    return replace(unlimited, delay=0.0, time_constant=0.0, bias=0.0)


def force_weight(run: LoopRun, controlled: Sequence[int]) -> float:
    """ρ of the cost 2 ∫ energy dt + ρ ∫ FᵀF dt for which both terms are equal over the controlled modes.

    The run is that of the reference loop, with ideal actuators and sensors.
    """
    return 2.0 * _vibration(run, controlled) / max(run.effort, 1e-300)


def _excess(run: LoopRun, ideal: LoopRun, controlled: Sequence[int]) -> tuple[float, float, float]:
    """Relative excess of a loop over an ideal one, see `Step.excess`."""
    if not run.bounded:
        return np.inf, np.inf, np.inf
    (total, part), (ideal_total, ideal_part) = ((_vibration(r), _vibration(r, controlled)) for r in (run, ideal))
    of_controlled = part / max(ideal_part, 1e-300) - 1.0
    of_residual = ((total - part) - (ideal_total - ideal_part)) / max(ideal_total, 1e-300)
    return max(of_controlled, 0.0), max(of_residual, 0.0), max(run.effort / max(ideal.effort, 1e-300) - 1.0, 0.0)


def _vibration(run: LoopRun, modes: Sequence[int] | None = None) -> float:
    """∫ of the energy of some modes, by default of all, over time; inf where the motion diverges."""
    if not run.bounded:
        return np.inf
    time, energy = run.response.time, run.response.energy
    return float((energy if modes is None else energy[list(modes)]).sum() * (time[1] - time[0]))


def _settling(run: LoopRun, controlled: Sequence[int]) -> float:
    """Settling time of the controlled modes, at most that of the test, s; inf where the motion diverges."""
    if not run.bounded:
        return np.inf
    time, energy = run.response.time, run.response.energy[list(controlled)].sum(axis=0)
    return min(settling(energy, float(time[1] - time[0])), float(time[-1]))


def _losses(rig: Rig, loop: Loop, step: str, units: Units) -> str:
    """What a step compensates, in words; empty where there is nothing."""
    if step == "friction":
        frictions = [e for e in rig.elements if isinstance(e, CoulombFriction)]
        return "; ".join(f"{e.force:.3g} {units.force} at {rig.modes.domain.text(e.at)}" for e in frictions)
    if step == "sensors":
        sensors = [named(rig.sensors, one.name) for one in loop.controller.sensors]
        lost = [(s.name, _faults(s, units)) for s in sensors]
    else:
        actuators = [named(rig.actuators, one.name) for one in loop.law.actuators]
        lost = [(a.name, _imperfections(a, step, units)) for a in actuators]
    return "; ".join(f"{name}: {', '.join(texts)}" for name, texts in lost if texts)


def _imperfections(actuator: Actuator, step: str, units: Units) -> list[str]:
    """What a step compensates in an actuator."""
    values = [(what, getattr(actuator, name)) for what, name in COMPENSATED[step]]
    known = [(what, value) for what, value in values if value and np.isfinite(value)]  # an infinite limit is none
    if step == "delay":
        return [f"{what} {_short(value, units)}" for what, value in known]
    return [f"{what} {value:.3g} {units.force}{f'/{units.time}' * (what == 'rate')}" for what, value in known]


def _faults(sensor: Sensor, units: Units) -> list[str]:
    """What the step "sensors" compensates in a sensor."""
    off, late = abs(sensor.gain - 1.0), sensor.delay + sensor.time_constant
    faults = (
        (f"gain {sensor.gain:.3g}" if off >= 0.005 else f"gain off by {100 * off:.2g} %", off),
        (f"offset {sensor.bias:.3g}", sensor.bias),
        (f"late by {_short(late, units)}", sensor.delay > 0 or sensor.time_constant),
        ("cross-talk", sensor.crosstalk),
    )
    return [words for words, there in faults if there]


def _short(time: float, units: Units) -> str:
    """A short time as text: in ms, or in a time unit other than s."""
    return f"{1e3 * time:.3g} ms" if units.time == "s" else f"{time:.3g} {units.time}"
