"""Redesign of a controller for a diagnosed structure, step by step, with Monte Carlo verification."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from workbench.arguments import number, whole
from workbench.design.estimation.digital import DigitalController, sampled
from workbench.design.export.export import write_controller
from workbench.design.export.source import command_words, reading_words
from workbench.design.laws.law import DesignError
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.rig_loop import LoopRun, LoopTest, named, run_loop
from workbench.gap.report.verdict import Verdict
from workbench.records.units import SI, Units
from workbench.renamed import Renamed, former_arguments
from workbench.rig.actuators import Actuator
from workbench.rig.elements import CoulombFriction
from workbench.rig.rig import Rig
from workbench.robust.compensation import STEPS, Loop, check_rate, compensated, without_faults
from workbench.robust.on_rig import Design, controlled_by, impulse_test, loop_on_rig, redesigned_for, tuned
from workbench.robust.posterior import WHAT_DRAWS, UncertainRig
from workbench.robust.relocation import Relocation, relocated
from workbench.robust.small_motion import loop_poles, modes_in_motion
from workbench.robust.verification import Verification, check_test, drawn_with_errors, interval, settling, verify
from workbench.structure.domain import Where
from workbench.threads import one_blas_thread

Report = Callable[[str, float], None]

AWAY = 1e3  # loss above which the motion is called divergent
LEAST_SHOWN = 1e-4  # loss below which its size is not stated
GAINED = 0.005  # least reduction of the loss by a step; least change of the cost for a change of the controller
# factors of the control weight, and of the noise of the Kalman filter, that are tried
WEIGHTS = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25)  # weight, where actuators saturate
SLOWER = (1.0, 2.0, 5.0, 10.0)  # noise, with these
SOFTER = (1.0, 3.0, 10.0, 30.0, 100.0)  # weight, where the law is unstable as designed
SLOWEST = tuple(10.0**k for k in np.arange(0.0, 9.1, 0.5))  # noise, with these
SPEEDS = (1e-3, 1e-2, 0.1, 10.0, 100.0)  # noise, for the law as designed
MORE_COST = 0.01  # of the present cost: default of `more_cost`
AS_MUCH = "as much"
CRITERIA = ("cost", "settling")


@dataclass(frozen=True)
class Step:
    """One step from the present controller to the redesigned one.

    Attributes:
        name: such as "delay".
        what: in words, with the compensated values.
        vibration, effort, work: ∫ of the energy of all modes, ∫ FᵀF dt and W = Σ_r |W_r|, on the corrected rig under
            test, with this step and those kept before.
        excess: relative excess over the redesigned law with perfect actuators and sensors: of the vibration of
            controlled modes, of that of residual modes (over that of all modes), and of the effort. Each is 0 or more,
            so that a gain in one cannot offset a loss in another.
        loss: sum of the three.
        cost: J / J₀ - 1, J₀ of the same perfect loop; see `Redesign.criterion`. Below zero the loop is better.
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
    kept: bool

    @property
    def diverges(self) -> bool:
        """Whether the motion grows so far that the loss is not stated in per cent."""
        return not self.loss < AWAY

    @property
    def lost(self) -> str:
        """The loss in words."""
        if 0.0 < self.loss < LEAST_SHOWN:
            return f"below {100.0 * LEAST_SHOWN:g} %"
        return "diverges" if self.diverges else f"{100.0 * self.loss:.3g} %"


@dataclass(frozen=True, eq=False)
class Redesign:
    """A controller redesigned for the structure that a diagnosis found.

    Attributes:
        uncertain_rig: the corrected rig with its uncertainty.
        present, redesigned: the digital controllers.
        loop: law and estimator of the redesigned one, on the corrected rig linearised about the motion under test.
        controlled: zero-based modes of the corrected rig.
        steps: from the present controller to the redesigned one.
        test: the excitation.
        before, after: response of the corrected rig under test with the present and with the redesigned controller.
        present_verification, verification: of both, on the same draws.
        weight: ρ of the cost J; 0 for on-off control.
        criterion: "cost": J = 2 ∫ energy dt + ρ ∫ FᵀF dt, with ρ such that both terms are equal over the controlled
            modes where actuators and sensors are perfect; "settling": J = t + ρ ∫ FᵀF dt with t the settling time of
            the controlled modes, at most that of the test, and ρ such that both terms are equal there.
        more_cost, more_work: relative increase of the cost J and of the work W that the redesigned controller is
            allowed over the present one.
        relocation: better places of the actuators on the corrected structure; None where not known.
        notes: warnings and remarks.
        units: of results, and of signals in a file of the controller.
    """

    uncertain_rig: UncertainRig
    present: DigitalController
    redesigned: DigitalController
    loop: Loop
    controlled: tuple[int, ...]
    steps: tuple[Step, ...]
    test: LoopTest
    before: LoopRun
    after: LoopRun
    present_verification: Verification
    verification: Verification
    weight: float
    criterion: str = "cost"
    more_cost: float = MORE_COST
    more_work: float = np.inf
    relocation: Relocation | None = None
    notes: tuple[str, ...] = ()
    units: Units = SI

    pays, aim = Renamed("improves"), Renamed("criterion")
    promise, figures = Renamed("guarantee"), Renamed("comparison")
    proof, present_proof = Renamed("verification"), Renamed("present_verification")
    possible = Renamed("uncertain_rig")

    @cached_property
    def improves(self) -> bool:
        """Whether the redesigned controller is better than the present one, on the same draws.

        It is if it is stable on more draws. On as many, it must cost less or settle sooner, and exceed neither the
        allowed cost nor the allowed work: by the means of log J and log W, W = Σ_r |W_r|, over draws stable with both.
        """
        old, new = self.present_verification, self.verification
        if new.stable.sum() != old.stable.sum():
            return bool(new.stable.sum() > old.stable.sum())
        return self._better and not self._more

    @property
    def _better(self) -> bool:
        """Whether the redesigned controller costs less than the present one, or settles sooner."""
        return self._over[0] < 1.0 or self._sooner

    @property
    def _better_on(self) -> int:
        """Number of draws on which the redesigned controller is better, by cost if it costs less in the mean."""
        of_draw = self._cost if self._over[0] < 1.0 else self._settling
        new, old = (of_draw(p)[self._both] for p in (self.verification, self.present_verification))
        return int((new < old).sum())

    @property
    def _sooner(self) -> bool:
        """Whether the redesigned controller settles sooner, in the median of the draws."""
        return interval(self._settling(self.verification))[0] < interval(self._settling(self.present_verification))[0]

    @property
    def _sooner_by(self) -> float:
        """Share of the settling time that the redesigned controller saves, in the median of the draws."""
        new, old = (
            interval(self._settling(verification))[0] for verification in (self.verification, self.present_verification)
        )
        if not np.isfinite(old):
            return float(np.isfinite(new))
        return 1.0 - new / old if old else 0.0

    def _settling(self, verification: Verification) -> np.ndarray:
        """Settling time of each draw (n_draws,), s: of the controlled modes with criterion "settling", else of all."""
        return verification.settling if self.criterion == "cost" else verification.controlled_settling

    @property
    def _more(self) -> str:
        """Cost and work above what is allowed, in words; empty for none."""
        cost = f"costs {{}} more, {'vibration' if self.criterion == 'cost' else 'time'} and effort taken together"
        texts = cost, "takes {} more work"
        over = zip(texts, np.array(self._over) - 1.0, ("cost", "work"), (self.more_cost, self.more_work))
        return ", and ".join(
            f"{what.format(_percent(more))}: more_{name} = {np.ceil(100.0 * more) / 100.0:g} allows it"
            for what, more, name, allowed in over
            if more > allowed
        )

    @cached_property
    def _over(self) -> tuple[float, float]:
        """J and W over those of the present controller: geometric means over draws stable with both; inf for none."""
        old, new, both = self.present_verification, self.verification, self._both
        if not both.any():
            return np.inf, np.inf
        costs = (self._cost(p)[both] for p in (new, old))
        works = (p.all_work[both] for p in (new, old))
        with np.errstate(divide="ignore", invalid="ignore"):  # the work may be zero
            cost, work = (float(np.exp(np.log(a / b).mean())) for a, b in (costs, works))
        return cost, work

    def _cost(self, verification: Verification) -> np.ndarray:
        """J of each draw (n_draws,); inf where it is not stable."""
        settles = np.minimum(verification.controlled_settling, self.test.time[-1])
        cost = 2.0 * verification.vibration if self.criterion == "cost" else np.array(settles)
        if self.weight:  # with weight 0, of relays, an infinite effort would give nan
            cost = cost + self.weight * verification.effort
        return np.asarray(np.where(verification.stable, cost, np.inf))

    @property
    def _both(self) -> np.ndarray:
        """Draws (n_draws,) that are stable with both controllers."""
        return np.asarray(self.present_verification.stable & self.verification.stable)

    @property
    def controller(self) -> DigitalController:
        """The controller to use: the redesigned one where it is better, else the present one."""
        return self.redesigned if self.improves else self.present

    @property
    def _used(self) -> Verification:
        return self.verification if self.improves else self.present_verification

    @property
    def mode(self) -> int:
        """The controlled mode (zero-based) whose damping is changed most."""
        old, new = (
            np.median(p.damping[:, list(self.controlled)], axis=0)
            for p in (self.present_verification, self.verification)
        )
        return self.controlled[int(np.argmax(np.abs(new - old)))]

    @property
    def sentence(self) -> str:
        """The redesign in one sentence."""
        kept = "" if self.improves and not self._no_controller else self._reason_to_keep
        return " ".join(part for part in (self.comparison, kept, self.guarantee) if part)

    @property
    def comparison(self) -> str:
        """Damping or settling time, effort and stability of both controllers, in one sentence."""
        old, new = self.present_verification, self.verification
        unstable = old.n_draws - int(old.stable.sum())
        effort, work = _times(new.effort, old.effort), _times(new.all_work, old.all_work)
        if old.share_stable < 0.5:
            text = f"the present controller is unstable on {_of(unstable, old.n_draws)} samples; redesigned, it "
            text += self._behaviour(new, "95 %: ")
        else:
            text = f"the present controller {self._behaviour(old, '95 %: ')}"
            text += f", unstable on {unstable} samples" if unstable else ""
            text += f"; redesigned: {self._behaviour(new, '', named=False)}, {effort} effort"
            text += "" if work == AS_MUCH else f" and {work} work"
        text = (
            f"On the corrected model {text}; stable on {_of(int(new.stable.sum()), new.n_draws)} Monte Carlo samples."
        )
        return f"{text} {self.left_undamped}".rstrip()

    @property
    def _reason_to_keep(self) -> str:
        """Why to keep the present controller."""
        old, new = self.present_verification, self.verification
        if self._no_controller:
            return self._no_controller
        if new.stable.sum() < old.stable.sum():
            why = "it is stable on more samples of the model"
        elif self._better and np.isfinite(self._over).all():
            why = f"the new one {self._difference}, but {self._more}"
        else:
            why = "the new one costs no less and settles no sooner"
        return f"Keep the present controller: {why}."

    @property
    def _no_controller(self) -> str:
        """The advice to use neither controller; empty where one is stable on half of the draws or more."""
        old, new = self.present_verification, self.verification
        if max(old.share_stable, new.share_stable) >= 0.5:
            return ""
        return (
            f"Use neither controller: the present one is stable on {_of(int(old.stable.sum()), old.n_draws)} samples of"
            f" the model, the redesigned on {int(new.stable.sum()):,}; increase R, make the estimator slower, control"
            " fewer modes, or read more sensors."
        )

    def _behaviour(self, verification: Verification, lead: str, *, named: bool = True) -> str:
        """Damping of the mode that is changed most; of on-off control, which has no poles, the settling time."""
        if self.redesigned.relays is not None:
            middle, low, high = interval(self._settling(verification))
            if not np.isfinite(high):
                return self._settles(verification)
            ends = "the same in all samples" if f"{low:.3g}" == f"{high:.3g}" else f"{lead}{low:.3g} to {high:.3g}"
            return f"{'settles in ' * named}{middle:.3g} {self.units.time} ({ends})"
        ratios = _ratios(verification.damping[:, self.mode], lead)
        return f"keeps mode {self.mode + 1} at {ratios} damping" if named else ratios

    @property
    def advice(self) -> str:
        """The advice which controller to use, and why."""
        if not self.improves or self._no_controller:
            return self._reason_to_keep
        difference = self._difference
        if self.present_verification.stable.sum() != self.verification.stable.sum():
            return f"Use the redesigned controller: it {difference}."
        if max(1.0 - self._over[0], self._sooner_by) < GAINED:
            return f"Either controller does: the redesigned {difference} (medians of the samples of the model)."
        forces = [
            interval(verification.peak_force)[0] for verification in (self.verification, self.present_verification)
        ]
        after, before = (f"{force:.3g} {self.units.force}" for force in forces)
        forced = f", with at most {after} instead of {before}" if np.isfinite(forces).all() and after != before else ""
        sure = f"it does better on {_of(self._better_on, self.verification.n_draws)} samples"
        return f"Use the redesigned controller: it {difference}{forced} (medians); {sure}."

    @property
    def _difference(self) -> str:
        """The difference of the redesigned controller from the present one, in words."""
        old, new = self.present_verification, self.verification
        if new.stable.sum() != old.stable.sum():
            stable = _of(int(new.stable.sum()), new.n_draws)
            return f"is stable on {stable} samples, the present one on {int(old.stable.sum()):,}"
        if self.criterion == "settling":
            settles, effort = self._settles(new, " the controlled modes"), f"{_times(new.effort, old.effort)} effort"
            settles += f" where the present one {self._settles(old, ' them')}"
            return f"{settles}, for {effort}" if self._sooner else f"takes {effort} and {settles}"
        less = 1.0 - self._over[0]
        if self._sooner and self._sooner_by >= less:  # state the larger of the two gains
            return f"{self._settles(new)} where the present one {self._settles(old)}"
        parts = (_times(getattr(new, part), getattr(old, part)) + f" {part}" for part in ("vibration", "effort"))
        return f"{'lowers' if less > 0 else 'raises'} the cost J by {_percent(abs(less))}, with {' and '.join(parts)}"

    def _settles(self, verification: Verification, what: str = "") -> str:
        """The settling time in the median of the draws, in words."""
        time = interval(self._settling(verification))[0]
        if not np.isfinite(time):
            return f"does not settle{what} within the test"
        return f"settles{what} in {time:.3g} {self.units.time}"

    @property
    def left_undamped(self) -> str:
        """A warning of the residual mode that keeps less than half of its open-loop damping; empty for none."""
        ratios = np.median(self._used.damping, axis=0)
        own = self.loop.modes.zeta[: ratios.size]
        r = int(np.argmin(ratios))
        if r in self.controlled or ratios[r] >= 0.5 * own[r] or self._used.share_stable < 0.5:
            return ""
        return (
            f"Mode {r + 1}, which is not controlled, keeps {100.0 * ratios[r]:.2g} % damping of {100.0 * own[r]:.2g} %:"
            " ask for less damping, or control it too."
        )

    @property
    def safe(self) -> bool:
        """Whether the controller to use is stable on every draw, with a small-gain margin above what is unexplained."""
        margin = self._used.small_gain_margin
        holds = margin > self.uncertain_rig.unexplained or np.isnan(margin)
        return bool(self._used.stable.all() and (self.uncertain_rig.explained or holds))

    @property
    def guarantee(self) -> str:
        """The stability guarantee by the small-gain margin where the gap is unexplained; empty otherwise."""
        if self.uncertain_rig.explained:
            return ""
        share, margin = self.uncertain_rig.unexplained, self._used.small_gain_margin
        error = f"{_percent(share)} of the output is unexplained in the mean over frequencies"
        if np.isnan(margin):
            return f"No stability guarantee: {error}, and on-off control has no small-gain margin."
        bears = f"the small-gain margin is {_percent(min(margin, 9.99))}"
        # the share is a mean over frequencies, and the bound must hold at each
        sure = "guaranteed if the share exceeds that at no frequency" if margin > share else "not guaranteed"
        return f"No effect explains the gap: {error}; {bears}, so stability is {sure}."

    def __repr__(self) -> str:
        return f"<Redesign: {self.sentence}>"

    def export(self, path: str | Path) -> tuple[Path, ...]:
        """Write the controller to use to NAME.c and NAME.h, NAME.py or NAME.mat, and return the paths.

        Args:
            path: the suffix selects the format; NAME is also the name of the functions in C.

        Raises:
            ValueError: another suffix, or a name that is no identifier in C or Python.
        """
        rig, used, units = self.uncertain_rig.rig, self.controller, self.units
        return write_controller(
            replace(used, states=tuple(map(units.named, used.states))),
            path,
            readings=reading_words(rig.modes.domain, [named(rig.sensors, name) for name in used.sensors], units),
            commands=command_words(rig.modes.domain, [named(rig.actuators, name) for name in used.actuators], units),
        )

    def to_json(self) -> dict[str, Any]:
        """The redesign as plain numbers."""
        moved = self.relocation
        return {
            "sentence": self.sentence,
            "safe": self.safe,
            "improves": self.improves,
            "criterion": self.criterion,
            "controlled": [r + 1 for r in self.controlled],
            "steps": [asdict(s) for s in self.steps],
            "present": self.present_verification.to_json(),
            "redesigned": self.verification.to_json(),
            "unexplained": self.uncertain_rig.unexplained,
            "placement": None if moved is None else moved.to_json(),
            "notes": list(self.notes),
        }


@former_arguments(aim="criterion", report="progress")
@one_blas_thread
def redesign(
    verdict: Verdict | UncertainRig,
    design: Design,
    *,
    sample_time: float | None = None,
    impulse_at: Where | None = None,
    test: LoopTest | None = None,
    draws: int = 200,
    seed: int = 0,
    placement: bool = True,
    criterion: str | None = None,
    more_cost: float = MORE_COST,
    more_work: float = np.inf,
    units: Units | None = None,
    progress: Report = lambda text, share: None,
) -> Redesign:
    """A controller of the same kind, redesigned for the corrected rig; both are verified on the same draws.

    Law and estimator are redesigned with the same settings for the modes of the corrected rig, in which each nonlinear
    element at a point is replaced by its equivalent spring and damper in the motion under test. Delays, dead zones,
    saturation, sensor faults and friction are then compensated one by one; a step is kept where it reduces the loss.

    Args:
        verdict: of the diagnosis, or the corrected rig with its uncertainty.
        design: in use: a `Controller` from `luenberger`, `kalman` or a modal filter; a law, which gets a Kalman filter
            on the rig's sensors; or a `PlacementTask`, whose IMSC law gets the rig's actuators.
        sample_time: of the controller, s; by default that of the records.
        impulse_at: place of the test's impulse; by default that of the hammer, or of the first actuator.
        test: instead of the impulse.
        draws: samples of the uncertain rig on which both are verified.
        seed: of the draws and of the sensors' noise.
        placement: whether to optimise the places of the actuators too.
        criterion: "cost" or "settling", see `Redesign`; by default "cost" for a law that minimises a cost, and
            "settling" for a law by poles or on-off control.
        more_cost: relative increase of the cost that is allowed where the redesigned controller settles sooner.
        more_work: relative increase of the work W = Σ_r |W_r| that is allowed; by default any.
        units: of the results; by default those of the verdict.
        progress: called with (text, share done).

    Raises:
        DesignError: a controller that does not fit the rig, a rate too slow for the modes, an impulse that moves none
            of them, or modes that cannot be controlled on the corrected rig.
        TypeError: no verdict, no design, no test, or an argument that is no number.
        ValueError: an impulse outside the structure, no draws, an unknown criterion, or a share below zero.
    """
    if criterion not in (None, *CRITERIA):
        raise ValueError(f"the criterion is {' or '.join(CRITERIA)}; got {criterion!r}")
    for name, share in (("more_cost", more_cost), ("more_work", more_work)):
        if not number(share, name) >= 0:
            raise ValueError(
                f"{name} is the relative increase allowed over the present controller, 0 or more; got {share:g}"
            )
    draws, seed = whole(draws, WHAT_DRAWS, least=1), whole(seed, "seed")
    if test is not None:
        check_test(test)
    uncertain = verdict if isinstance(verdict, UncertainRig) else UncertainRig.of(verdict)
    nominal, corrected = uncertain.nominal, uncertain.rig
    units = units or (verdict.units if isinstance(verdict, Verdict) else SI)
    if test is not None:
        sample_time = test.sample_time if sample_time is None else sample_time
    if sample_time is not None:
        sample_time = number(sample_time, "sample_time", "s")
    else:
        if isinstance(verdict, UncertainRig):
            raise DesignError("the sample time of the controller is not known; give sample_time, in s")
        sample_time = verdict.attribution.search.data.records[0].sample_time
    check_rate(nominal.modes, controlled_by(design), sample_time)
    progress("the present controller", 0.05)
    level = _level(verdict)
    test = test or impulse_test(nominal, controlled_by(design), sample_time, impulse_at, level=level, seed=seed)
    loop = loop_on_rig(nominal, design, test)
    present = _present(nominal, loop, sample_time)
    before = run_loop(corrected, present, test)
    progress("designing for the corrected rig", 0.15)
    quiet = _silent(present)
    modes = modes_in_motion(corrected, run_loop(corrected, quiet, test))
    steps: tuple[Step, ...]
    for _ in range(2):  # again, as the equivalent stiffness of elements changes in the smaller motion
        new_loop = redesigned_for(loop, corrected, modes)
        wanted = criterion or ("cost" if _weighted(new_loop) else "settling")
        redesigned, steps, new_loop, weight, judged = _compensated(corrected, new_loop, test, present, wanted, units)
        after = run_loop(corrected, redesigned, test)
        if not corrected.elements or not after.bounded:
            break
        modes = modes_in_motion(corrected, after)
    progress("verification on the samples", 0.4)
    rigs = drawn_with_errors(uncertain, draws, seed)
    old = verify(rigs, present, test, controlled=new_loop.law.controlled, margin_rig=corrected)
    progress("verification on the samples", 0.65)
    new = verify(rigs, redesigned, test, controlled=new_loop.law.controlled, margin_rig=corrected)
    progress("placement of actuators", 0.9)
    moved = relocated(new_loop, test, units) if placement else None
    progress("done", 1.0)
    return Redesign(
        uncertain, present, redesigned, new_loop, new_loop.law.controlled, steps, test, before, after, old, new,
        weight, judged, more_cost, more_work, moved, _notes(uncertain, corrected, judged == wanted), units,
    )  # fmt: skip


def _level(verdict: Verdict | UncertainRig) -> np.ndarray | None:
    """The largest reading of each sensor in the records (n_outputs,)."""
    if isinstance(verdict, UncertainRig):
        return None
    level: np.ndarray = np.max([np.abs(r.outputs).max(axis=1) for r in verdict.attribution.search.data.records], axis=0)
    return level


def _present(rig: Rig, loop: Loop, sample_time: float) -> DigitalController:
    """The controller in use, designed for the nominal rig, without compensation."""
    if isinstance(loop.law, OnOffLaw):
        return compensated(rig, loop, sample_time, ())
    return sampled(loop.controller, sample_time)


def _silent(controller: DigitalController) -> DigitalController:
    """The controller with its commands set to zero."""
    zero: dict[str, Any] = {"c": np.zeros_like(controller.c), "d": np.zeros_like(controller.d), "friction": None}
    n_u = len(controller.actuators)
    if controller.relays is not None:
        zero |= {
            "c": np.zeros((n_u, controller.a.shape[0])),
            "d": np.zeros((n_u, len(controller.sensors))),
            "relays": None,
        }
    return replace(controller, **zero, dead_zone=np.zeros(n_u), bias=np.zeros(n_u))


def _compensated(
    rig: Rig, loop: Loop, test: LoopTest, present: DigitalController, criterion: str, units: Units
) -> tuple[DigitalController, tuple[Step, ...], Loop, float, str]:
    """The redesigned controller: compensations, tuning and removal of faulty sensors, each kept where it helps.

    Returns:
        The controller, the steps, its loop, ρ of the cost, and the criterion, see `Redesign`.
    """
    perfect = replace(
        rig,
        actuators=tuple(_perfect(a) for a in rig.actuators),
        sensors=without_faults(rig.sensors),
        elements=rig.elements,
    )
    loop, softened = _stabilised(perfect, loop, test)
    ideal = run_loop(perfect, compensated(perfect, loop, test.sample_time, ()), test)
    settles, controlled = _settling(ideal, loop.law.controlled), loop.law.controlled
    if settles >= test.time[-1]:  # the test is too short for a settling time
        criterion = "cost"
    # the forces of relays are given, so that their effort does not count
    weight = settles / max(ideal.effort, 1e-300) if criterion == "settling" else force_weight(ideal, controlled)
    weight = 0.0 if isinstance(loop.law, OnOffLaw) else weight

    def costing(run: LoopRun) -> float:
        if not run.bounded:
            return np.inf
        return weight * run.effort + (_settling(run, controlled) if criterion == "settling" else 2.0 * _vibration(run))

    optimum = max(costing(ideal), 1e-300)

    def tried(name: str, what: str, controller: DigitalController) -> Step:
        run = run_loop(rig, controller, test)
        vibration, effort = _vibration(run), run.effort if run.bounded else np.inf
        cost = costing(run) / optimum - 1.0
        excess = _excess(run, ideal, loop.law.controlled)
        work = float(np.abs(run.work).sum()) if run.bounded else np.inf
        return Step(name, what, vibration, effort, work, excess, sum(excess), float(cost), True)

    kept: list[str] = []
    best = compensated(rig, loop, test.sample_time, ())
    steps = [
        tried("present", f"{present.name}, unchanged", present),
        tried("law and estimator", f"{loop.controller.name}, designed for the corrected rig{softened}", best),
    ]
    now, chosen = steps[-1], loop
    for name in STEPS:
        what = _losses(rig, loop, name, units)
        if not what:
            continue
        trial = compensated(rig, loop, test.sample_time, (*kept, name))
        step = tried(name, what, trial)
        helps = step.loss < now.loss - GAINED or not np.isfinite(now.loss)
        steps.append(replace(step, kept=helps))
        if helps:
            kept.append(name)
            best, now = trial, step
    # with limited forces the effort is low: more gain reduces vibration, and a slower filter keeps residual modes,
    # which a limited force cannot follow, out of the commands
    bounded = any(np.isfinite(named(rig.actuators, a.name).limit) for a in loop.law.actuators)
    gains = [("gain", weight, noise) for noise in SLOWER for weight in WEIGHTS] if bounded else []
    for name, weight_by, noise_by in (*gains, *(("estimator", 1.0, noise) for noise in SPEEDS)):
        try:
            other = tuned(chosen if name == "estimator" else loop, rig, weight=weight_by, noise=noise_by)
        except DesignError:
            continue  # no design with these settings
        if other is None:
            continue
        trial = compensated(rig, other, test.sample_time, kept)
        step = tried(name, _tuning(loop, weight_by, noise_by), trial)
        if name == "gain":
            helps = step.loss < now.loss - GAINED
        else:  # no part of the excess may be larger than both before this step and with the present controller
            allowed = np.maximum(now.excess, steps[0].excess)
            helps = step.cost < now.cost - GAINED and step.loss <= now.loss and bool((step.excess <= allowed).all())
        if helps and loop_poles(rig, trial, loop.modes).spectral_radius < 1.0:
            steps = [*(s for s in steps if s.name != name), step]
            best, now, chosen = trial, step, other
    loop = chosen
    removed: list[str] = []
    for name in _faulty(rig, loop):
        try:
            fewer = redesigned_for(loop, rig, loop.modes, (*removed, name))
            trial = compensated(rig, fewer, test.sample_time, kept)
        except DesignError:
            continue  # the modes are unobservable without this sensor
        step = tried(f"without {name}", f"{name} is not read", trial)
        helps = step.loss < now.loss - GAINED
        steps.append(replace(step, kept=helps))
        if helps:
            removed.append(name)
            best, now = trial, step
    last = redesigned_for(loop, rig, loop.modes, removed) if removed else loop
    return best, tuple(steps), last, weight, criterion


def _stabilised(rig: Rig, loop: Loop, test: LoopTest) -> tuple[Loop, str]:
    """The loop, detuned if it is unstable on a rig as designed, and the detuning in words.

    The first weight with a stable loop is taken, with the noise of least vibration; the loop as designed where none is
    stable.
    """

    def vibration(one: Loop | None) -> float:
        if one is None:
            return np.inf
        controller = compensated(rig, one, test.sample_time, ())
        unstable = loop_poles(rig, controller, loop.modes).spectral_radius >= 1.0
        return np.inf if unstable else _vibration(run_loop(rig, controller, test))

    def designed(weight: float, noise: float) -> Loop | None:
        try:
            return tuned(loop, rig, weight=weight, noise=noise)
        except DesignError:
            return None  # no design with these settings

    if np.isfinite(vibration(loop)):
        return loop, ""
    for weight in SOFTER:
        trials = [(vibration(one), one, noise) for noise in SLOWEST if (one := designed(weight, noise)) is not None]
        least, best, noise = min(trials, key=lambda trial: trial[0], default=(np.inf, None, 1.0))
        if best is not None and np.isfinite(least):
            return best, f", {_tuning(loop, weight, noise)}: otherwise unstable"
    return loop, ""


def _weighted(loop: Loop) -> bool:
    """Whether the law minimises a cost that weights its forces."""
    return "weight" in getattr(loop.law.designed_by, "keywords", {})


def _tuning(loop: Loop, weight: float, noise: float) -> str:
    """The changed settings of a law and its Kalman filter, in words."""
    of_law = ("weight", weight) if _weighted(loop) else ("gain", 1.0 / np.sqrt(weight))
    return " and ".join(f"{what} × {by:.3g}" for what, by in (of_law, ("measurement noise", noise)) if by != 1)


def _faulty(rig: Rig, loop: Loop) -> list[str]:
    """Names of faulty sensors that an observer may leave out; none for a modal filter, which needs all its sensors."""
    if loop.controller.state.size == 0 or len(loop.controller.sensors) < 2:
        return []
    read = [named(rig.sensors, one.name) for one in loop.controller.sensors]
    return [s.name for s, faultless in zip(read, without_faults(read), strict=True) if s != faultless]


def _perfect(actuator: Actuator) -> Actuator:
    """The actuator with its gain, without delay, lag, limits and other imperfections."""
    at = {"kind": actuator.kind, "direction": actuator.direction, "direct": actuator.direct}
    return Actuator(actuator.name, actuator.at, gain=actuator.gain, **at)  # type: ignore[arg-type]


def force_weight(run: LoopRun, controlled: Sequence[int]) -> float:
    """ρ of the cost 2 ∫ energy dt + ρ ∫ FᵀF dt for which both terms are equal over the controlled modes.

    Args:
        run: of the reference loop, with perfect actuators and sensors.
        controlled: zero-based modes.
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
    words, force = [], units.force
    for a in (named(rig.actuators, one.name) for one in loop.law.actuators):
        lost = []
        if step == "delay":
            parts = ("delay", a.delay), ("lag", a.time_constant)
            lost = [f"{what} {_short(value, units)}" for what, value in parts if value]
        elif step == "dead zone":
            parts = ("dead zone", a.dead_zone), ("bias", a.bias)
            lost = [f"{what} {value:.3g} {force}" for what, value in parts if value]
        elif step == "saturation":
            limits = ("limit", a.limit, force), ("rate", a.rate_limit, f"{force}/{units.time}")
            lost = [f"{what} {value:.3g} {unit}" for what, value, unit in limits if np.isfinite(value)]
        if lost:
            words.append(f"{a.name}: {', '.join(lost)}")
    if step == "sensors":
        for s in (named(rig.sensors, one.name) for one in loop.controller.sensors):
            faults = [
                *([_gain(s.gain)] if s.gain != 1 else []),
                *([f"offset {s.bias:.3g}"] if s.bias else []),
                *([f"late by {_short(s.delay + s.time_constant, units)}"] if s.delay > 0 or s.time_constant else []),
                *(["cross-talk"] if s.crosstalk else []),
            ]
            if faults:
                words.append(f"{s.name}: {', '.join(faults)}")
    if step == "friction":
        words += [
            f"{e.force:.3g} {force} at {rig.modes.domain.text(e.at)}"
            for e in rig.elements
            if isinstance(e, CoulombFriction)
        ]
    return "; ".join(words)


def _short(time: float, units: Units) -> str:
    """A short time as text: in ms, or in a time unit other than s."""
    return f"{1e3 * time:.3g} ms" if units.time == "s" else f"{time:.3g} {units.time}"


def _gain(gain: float) -> str:
    """A gain as text; one near 1 by its error."""
    return f"gain {gain:.3g}" if abs(gain - 1.0) >= 0.005 else f"gain off by {_percent(abs(gain - 1.0))}"


def _notes(uncertain: UncertainRig, rig: Rig, as_wanted: bool) -> tuple[str, ...]:
    """Remarks on the criterion, where it is not the wanted one, on hysteresis, and on alternative sets of effects."""
    notes = []
    if not as_wanted:
        notes.append(
            "Even with perfect actuators and sensors the controlled modes do not settle within the test, so the"
            " controllers are judged by vibration and effort; give a longer test to judge them by settling."
        )
    if any(a.hysteresis_share for a in rig.actuators):
        notes.append("The hysteresis of an actuator is in the verification, but is not compensated.")
    if uncertain.alternatives:
        share = sum(p for _, p in uncertain.alternatives)
        notes.append(f"{100 * share:.0f} % of the draws are of other sets of effects that the records do not exclude.")
    return tuple(notes)


def _times(after: np.ndarray, before: np.ndarray) -> str:
    """Ratio of two medians of draws (n_draws,), as text before a noun: "as much", or "1.2 times the"."""
    new, old = interval(after)[0], interval(before)[0]
    if old == 0.0:
        return AS_MUCH if new == 0.0 else "nonzero instead of zero"
    times = f"{new / old:.2g}"
    return AS_MUCH if times == "1" else f"{times} times the"


def _of(part: int, whole: int) -> str:
    return f"{part:,} of {whole:,}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def _ratios(values: np.ndarray, lead: str = "") -> str:
    """Median and 95 % interval in per cent as text, with two to four digits until the ends differ."""
    middle, low, high = (100.0 * v for v in interval(values))
    digits = next((n for n in (2, 3, 4) if _rounded(low, n) != _rounded(high, n)), 0)
    if not digits:
        return f"{_rounded(middle, 3)} % (the same in all samples)"
    return f"{_rounded(middle, digits)} % ({lead}{_rounded(low, digits)} to {_rounded(high, digits)})"


def _rounded(value: float, digits: int) -> str:
    whole = len(f"{abs(value):.0f}") if abs(value) >= 1 else 0
    return f"{value:.{max(digits - whole, 0)}f}" if whole else f"{value:.{digits}g}"
