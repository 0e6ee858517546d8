"""A controller redesigned for what a diagnosis found, step by step, and proved on what remains unknown."""

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
from workbench.robust.compensation import STEPS, Loop, check_rate, compensated, without
from workbench.robust.on_rig import Design, controlled_by, designed_anew, fitted, impulse_test, tuned
from workbench.robust.posterior import WHAT_DRAWS, UncertainRig
from workbench.robust.relocation import Relocation, relocated
from workbench.robust.small_motion import loop_poles, modes_in_motion
from workbench.robust.verification import Verification, check_test, drawn_with_errors, interval, settling, verify
from workbench.structure.domain import Where
from workbench.threads import one_blas_thread

Report = Callable[[str, float], None]

AWAY = 1e3  # a loss from which on the motion is said to diverge
LEAST_SHOWN = 1e-4  # a loss below which its size says nothing
GAINED = 0.005  # of the loss: what a step must take away; of the cost: less is no reason to change the controller
WEIGHTS = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25)  # of the forces of a law whose actuators saturate, over its own
SLOWER = (1.0, 2.0, 5.0, 10.0)  # of the readings of its Kalman filter: noise over its own
SOFTER = (1.0, 3.0, 10.0, 30.0, 100.0)  # of the forces of a law that is unstable as it is designed: weight over its own
SLOWEST = tuple(10.0**k for k in np.arange(0.0, 9.1, 0.5))  # of the readings of its Kalman filter: noise over its own
SPEEDS = (1e-3, 1e-2, 0.1, 10.0, 100.0)  # of the readings of a Kalman filter: noise over its own
MORE_COST = 0.01  # of the present one's: what counts as no more
AS_MUCH = "as much"
CRITERIA = ("cost", "settling")  # what a law can be for


@dataclass(frozen=True)
class Step:
    """One step from the present controller to the redesigned one.

    Attributes:
        name: such as "delay".
        what: in words, with the numbers that it takes out.
        vibration, effort, work: ∫ of the energy of all modes, ∫ FᵀF dt and W = Σ_r |W_r|, on the corrected rig under
            test.
        excess: what it takes more than the redesigned law with perfect actuators and sensors, with this step and those
            kept before: of the vibration of controlled modes, of that of residual modes (over that of all modes), and
            of the effort, as shares; none is below zero, so that a gain in one makes up for no loss in another.
        loss: their sum.
        cost: J / J₀ - 1, J₀ that of the same perfect loop; see `Redesign.criterion`. Below zero the loop does better.
        kept: whether it paid.
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
        """Whether the motion grows so far that a loss in per cent says nothing."""
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
        present, redesigned: the controllers, once a sample.
        loop: law and estimator of the redesigned one, on the corrected rig in the motion under test.
        controlled: zero-based modes of the corrected rig.
        steps: from one to the other.
        test: what the loops were put through.
        before, after: the present and the redesigned controller on the corrected rig under test.
        present_verification, verification: both on the same draws.
        weight: ρ of the cost J; 0 for on-off control.
        criterion: what the law is for. "cost": J = 2 ∫ energy dt + ρ ∫ FᵀF dt, with ρ such that both terms are equal
            over the controlled modes where actuators and sensors are perfect; "settling": J = t + ρ ∫ FᵀF dt with t the
            settling time of the controlled modes, at most that of the test, and ρ such that both are equal there.
        more_cost, more_work: shares by which the redesigned controller may cost more, J, and do more work, W, than the
            present one.
        relocation: where the actuators should stand for the corrected structure; None where that is not known.
        notes: what else a reader should know.
        units: by which numbers are told, and signals in a file of the controller.
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
        """Whether the redesigned controller does better than the present one, draw by draw.

        It is stable on more of the draws; or on as many, and on those that both keep stable it costs less or settles
        sooner, and neither costs nor works more than is allowed: by the means of log J and log W, W = Σ_r |W_r|.
        """
        old, new = self.present_verification, self.verification
        if new.stable.sum() != old.stable.sum():
            return bool(new.stable.sum() > old.stable.sum())
        return self._better and not self._more

    @property
    def _better(self) -> bool:
        """Whether it costs less than the present controller, or settles sooner."""
        return self._over[0] < 1.0 or self._sooner

    @property
    def _better_on(self) -> int:
        """Draws that both keep stable on which it does better, by what `_better` finds in the mean."""
        of_draw = self._cost if self._over[0] < 1.0 else self._settling
        new, old = (of_draw(p)[self._both] for p in (self.verification, self.present_verification))
        return int((new < old).sum())

    @property
    def _sooner(self) -> bool:
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
        """Settling time of each draw (n_draws,), s: of the controlled modes where the law is for it."""
        return verification.settling if self.criterion == "cost" else verification.controlled_settling

    @property
    def _more(self) -> str:
        """What it takes more than is allowed, in words; empty for nothing."""
        together = f"costs {{}} more, {'vibration' if self.criterion == 'cost' else 'time'} and effort taken together"
        said = together, "takes {} more work"
        over = zip(said, np.array(self._over) - 1.0, ("cost", "work"), (self.more_cost, self.more_work))
        return ", and ".join(
            f"{what.format(_percent(more))}: more_{name} = {np.ceil(100.0 * more) / 100.0:g} allows it"
            for what, more, name, allowed in over
            if more > allowed
        )

    @cached_property
    def _over(self) -> tuple[float, float]:
        """J and W over those of the present controller: means of the draws that both keep stable; inf for none."""
        old, new, both = self.present_verification, self.verification, self._both
        if not both.any():
            return np.inf, np.inf
        costs = (self._cost(p)[both] for p in (new, old))
        works = (p.all_work[both] for p in (new, old))
        with np.errstate(divide="ignore", invalid="ignore"):  # a controller that does nothing does no work
            cost, work = (float(np.exp(np.log(a / b).mean())) for a, b in (costs, works))
        return cost, work

    def _cost(self, verification: Verification) -> np.ndarray:
        """J of each draw (n_draws,); inf where it is not stable."""
        settles = np.minimum(verification.controlled_settling, self.test.time[-1])
        cost = 2.0 * verification.vibration if self.criterion == "cost" else np.array(settles)
        if self.weight:  # relays have none, and an effort may be infinite
            cost = cost + self.weight * verification.effort
        return np.asarray(np.where(verification.stable, cost, np.inf))

    @property
    def _both(self) -> np.ndarray:
        return np.asarray(self.present_verification.stable & self.verification.stable)

    @property
    def controller(self) -> DigitalController:
        """The one to use: the redesigned where it helps, else the present one."""
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
        kept = "" if self.improves and not self._neither else self._kept
        return " ".join(part for part in (self.comparison, kept, self.guarantee) if part)

    @property
    def comparison(self) -> str:
        """What both controllers do on the real structure, in one sentence."""
        old, new = self.present_verification, self.verification
        unstable = old.n_draws - int(old.stable.sum())
        effort, work = _times(new.effort, old.effort), _times(new.all_work, old.all_work)
        if old.share_stable < 0.5:
            text = f"the present controller is unstable on {_of(unstable, old.n_draws)} samples; redesigned, it "
            text += self._does(new, "95 %: ")
        else:
            text = f"the present controller {self._does(old, '95 %: ')}"
            text += f", unstable on {unstable} samples" if unstable else ""
            text += f"; redesigned: {self._does(new, '', named=False)}, {effort} effort"
            text += "" if work == AS_MUCH else f" and {work} work"
        text = (
            f"On the corrected model {text}; stable on {_of(int(new.stable.sum()), new.n_draws)} Monte Carlo samples."
        )
        return f"{text} {self.left_undamped}".rstrip()

    @property
    def _kept(self) -> str:
        """Why the present controller stays."""
        old, new = self.present_verification, self.verification
        if self._neither:
            return self._neither
        if new.stable.sum() < old.stable.sum():
            why = "it is stable on more samples of the model"
        elif self._better and np.isfinite(self._over).all():
            why = f"the new one {self._difference}, but {self._more}"
        else:
            why = "the new one costs no less and settles no sooner"
        return f"Keep the present controller: {why}."

    @property
    def _neither(self) -> str:
        """That no controller is to be used, and what can be done; empty where one is stable on most of the draws."""
        old, new = self.present_verification, self.verification
        if max(old.share_stable, new.share_stable) >= 0.5:
            return ""
        return (
            f"Use neither controller: the present one is stable on {_of(int(old.stable.sum()), old.n_draws)} samples of"
            f" the model, the redesigned on {int(new.stable.sum()):,}; increase R, make the estimator slower, control"
            " fewer modes, or read more sensors."
        )

    def _does(self, verification: Verification, lead: str, *, named: bool = True) -> str:
        """What a controller does to the mode that is changed most; on-off control, which adds no pole, by settling."""
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
        """Which controller to use, and what it does after the test."""
        if not self.improves or self._neither:
            return self._kept
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
        """What the redesigned controller does better than the present one, in words."""
        old, new = self.present_verification, self.verification
        if new.stable.sum() != old.stable.sum():
            stable = _of(int(new.stable.sum()), new.n_draws)
            return f"is stable on {stable} samples, the present one on {int(old.stable.sum()):,}"
        if self.criterion == "settling":
            settles, effort = self._settles(new, " the controlled modes"), f"{_times(new.effort, old.effort)} effort"
            settles += f" where the present one {self._settles(old, ' them')}"
            return f"{settles}, for {effort}" if self._sooner else f"takes {effort} and {settles}"
        less = 1.0 - self._over[0]
        if self._sooner and self._sooner_by >= less:  # of the two gains the larger one is the reason
            return f"{self._settles(new)} where the present one {self._settles(old)}"
        parts = (_times(getattr(new, part), getattr(old, part)) + f" {part}" for part in ("vibration", "effort"))
        return f"{'lowers' if less > 0 else 'raises'} the cost J by {_percent(abs(less))}, with {' and '.join(parts)}"

    def _settles(self, verification: Verification, what: str = "") -> str:
        """How soon it settles, in the median of the draws, in words."""
        time = interval(self._settling(verification))[0]
        if not np.isfinite(time):
            return f"does not settle{what} within the test"
        return f"settles{what} in {time:.3g} {self.units.time}"

    @property
    def left_undamped(self) -> str:
        """Which residual mode the controller to use leaves with less than half of its own damping; empty for none."""
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
        """Whether the controller to use is stable on every draw, and bears an error as large as is unexplained."""
        margin = self._used.small_gain_margin
        holds = margin > self.uncertain_rig.unexplained or np.isnan(margin)
        return bool(self._used.stable.all() and (self.uncertain_rig.explained or holds))

    @property
    def guarantee(self) -> str:
        """What stability is guaranteed where the gap is not explained; empty where it is."""
        if self.uncertain_rig.explained:
            return ""
        share, margin = self.uncertain_rig.unexplained, self._used.small_gain_margin
        error = f"{_percent(share)} of the output is unexplained in the mean over frequencies"
        if np.isnan(margin):
            return f"No stability guarantee: {error}, and on-off control has no small-gain margin."
        bears = f"the small-gain margin is {_percent(min(margin, 9.99))}"
        # the share is a mean over frequencies, and the bound is of each of them
        sure = "guaranteed if the share exceeds that at no frequency" if margin > share else "not guaranteed"
        return f"No effect explains the gap: {error}; {bears}, so stability is {sure}."

    def __repr__(self) -> str:
        return f"<Redesign: {self.sentence}>"

    def export(self, path: str | Path) -> tuple[Path, ...]:
        """The files written of the controller to use: NAME.c and NAME.h, NAME.py or NAME.mat.

        Args:
            path: its ending names the kind; its name that of the functions in C.

        Raises:
            ValueError: an ending of another kind, or a name that C or Python cannot have.
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
    """A controller of the same kind, redesigned for the corrected rig, and both verified on the same samples of it.

    The law and the estimator are designed with the settings that they have, on the modes of the corrected rig, with
    each element at a point as the spring and damper that it is worth in the motion under test. Then every loss on the
    way is made up for by a step of its own, which is kept where it lowers the vibration.

    Args:
        verdict: of the diagnosis, or the corrected rig with its uncertainty.
        design: in use: a `Controller` from `luenberger`, `kalman` or a modal filter; a law, which then reads a Kalman
            filter on the rig's sensors; or a `PlacementTask`, whose IMSC law the rig's actuators then take.
        sample_time: s, of the controller; that of the records unless given.
        impulse_at: where the test strikes; at the hammer, or the first actuator, unless given.
        test: in place of the impulse.
        draws: samples of the uncertain rig on which both are verified.
        seed: of the draws and of the sensors' noise.
        placement: whether to look where the actuators should stand instead.
        criterion: what it is judged by, "cost" or "settling", see `Redesign`; unless given "cost" for a law that
            minimises it, and "settling" for one by poles or on-off.
        more_cost: share by which the redesigned controller may cost more than the present one where it settles sooner.
        more_work: share by which it may do more work, W = Σ_r |W_r|: as much as it takes, unless given.
        units: by which results are told; those of the verdict unless given.
        progress: called with (what, share done).

    Raises:
        DesignError: a controller that does not fit the rig, a rate too slow for the modes, an impulse that moves none
            of them, or modes that cannot be controlled on the corrected rig.
        TypeError: no verdict, no design, no test, or no number where one is asked for.
        ValueError: an impulse outside the structure, no draws, an unknown criterion, or a share below zero.
    """
    if criterion not in (None, *CRITERIA):
        raise ValueError(f"a controller is judged by {' or '.join(CRITERIA)}; got {criterion!r}")
    for name, share in (("more_cost", more_cost), ("more_work", more_work)):
        if not number(share, name) >= 0:
            raise ValueError(f"{name} is a share of that of the present controller, 0 or more; got {share:g}")
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
            raise DesignError("how often does the controller run? give sample_time, in s")
        sample_time = verdict.attribution.search.data.records[0].sample_time
    check_rate(nominal.modes, controlled_by(design), sample_time)
    progress("the present controller", 0.05)
    level = _level(verdict)
    test = test or impulse_test(nominal, controlled_by(design), sample_time, impulse_at, level=level, seed=seed)
    loop = fitted(nominal, design, test)
    present = _present(nominal, loop, sample_time)
    before = run_loop(corrected, present, test)
    progress("designing for the corrected rig", 0.15)
    quiet = _silent(present)
    modes = modes_in_motion(corrected, run_loop(corrected, quiet, test))
    steps: tuple[Step, ...]
    for _ in range(2):  # elements are worth another stiffness in the smaller motion of the redesigned loop
        anew = designed_anew(loop, corrected, modes)
        wanted = criterion or ("cost" if _weighted(anew) else "settling")
        redesigned, steps, anew, weight, judged = _compensated(corrected, anew, test, present, wanted, units)
        after = run_loop(corrected, redesigned, test)
        if not corrected.elements or not after.bounded:
            break
        modes = modes_in_motion(corrected, after)
    progress("verification on the samples", 0.4)
    rigs = drawn_with_errors(uncertain, draws, seed)
    old = verify(rigs, present, test, controlled=anew.law.controlled, margin_rig=corrected)
    progress("verification on the samples", 0.65)
    new = verify(rigs, redesigned, test, controlled=anew.law.controlled, margin_rig=corrected)
    progress("where actuators should stand", 0.9)
    moved = relocated(anew, test, units) if placement else None
    progress("done", 1.0)
    return Redesign(
        uncertain, present, redesigned, anew, anew.law.controlled, steps, test, before, after, old, new, weight,
        judged, more_cost, more_work, moved, _notes(uncertain, corrected, judged == wanted), units,
    )  # fmt: skip


def _level(verdict: Verdict | UncertainRig) -> np.ndarray | None:
    """The largest reading of each sensor in the records (n_outputs,)."""
    if isinstance(verdict, UncertainRig):
        return None
    level: np.ndarray = np.max([np.abs(r.outputs).max(axis=1) for r in verdict.attribution.search.data.records], axis=0)
    return level


def _present(rig: Rig, loop: Loop, sample_time: float) -> DigitalController:
    """The controller in use, as it is: designed for the nominal rig, and nothing made up for."""
    if isinstance(loop.law, OnOffLaw):
        return compensated(rig, loop, sample_time, ())
    return sampled(loop.controller, sample_time)


def _silent(controller: DigitalController) -> DigitalController:
    """A controller that commands nothing."""
    nothing: dict[str, Any] = {"c": np.zeros_like(controller.c), "d": np.zeros_like(controller.d), "friction": None}
    n_u = len(controller.actuators)
    if controller.relays is not None:
        nothing |= {
            "c": np.zeros((n_u, controller.a.shape[0])),
            "d": np.zeros((n_u, len(controller.sensors))),
            "relays": None,
        }
    return replace(controller, **nothing, dead_zone=np.zeros(n_u), bias=np.zeros(n_u))


def _compensated(
    rig: Rig, loop: Loop, test: LoopTest, present: DigitalController, criterion: str, units: Units
) -> tuple[DigitalController, tuple[Step, ...], Loop, float, str]:
    """The redesigned controller: compensations one after the other, each kept where it helps; then sensors left out.

    The last that are returned are ρ of the cost and what the law is judged by, see `Redesign`.
    """
    perfect = replace(
        rig, actuators=tuple(_perfect(a) for a in rig.actuators), sensors=without(rig.sensors), elements=rig.elements
    )
    loop, softened = _stabilised(perfect, loop, test)
    ideal = run_loop(perfect, compensated(perfect, loop, test.sample_time, ()), test)
    settles, controlled = _settling(ideal, loop.law.controlled), loop.law.controlled
    if settles >= test.time[-1]:  # a test too short to show how soon it settles judges by vibration
        criterion = "cost"
    # relays have forces of a given size, which nothing is traded for: they are judged by what they gain alone
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
        tried("present", f"{present.name}, as it is", present),
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
    # a limit holds the effort down: more gain wins vibration back for it, and a slower filter keeps residual modes,
    # which the readings carry and a limited force cannot follow, out of the commands
    bounded = any(np.isfinite(named(rig.actuators, a.name).limit) for a in loop.law.actuators)
    gains = [("gain", weight, noise) for noise in SLOWER for weight in WEIGHTS] if bounded else []
    for name, weight_by, noise_by in (*gains, *(("estimator", 1.0, noise) for noise in SPEEDS)):
        try:
            other = tuned(chosen if name == "estimator" else loop, rig, weight=weight_by, noise=noise_by)
        except DesignError:
            continue  # none is that fast
        if other is None:
            continue
        trial = compensated(rig, other, test.sample_time, kept)
        step = tried(name, _tuning(loop, weight_by, noise_by), trial)
        if name == "gain":
            helps = step.loss < now.loss - GAINED
        else:  # no trade: no part may be worse than under the present controller and before
            bearable = np.maximum(now.excess, steps[0].excess)
            helps = step.cost < now.cost - GAINED and step.loss <= now.loss and bool((step.excess <= bearable).all())
        if helps and loop_poles(rig, trial, loop.modes).spectral_radius < 1.0:
            steps = [*(s for s in steps if s.name != name), step]
            best, now, chosen = trial, step, other
    loop = chosen
    removed: list[str] = []
    for name in _faulty(rig, loop):
        try:
            fewer = designed_anew(loop, rig, loop.modes, (*removed, name))
            trial = compensated(rig, fewer, test.sample_time, kept)
        except DesignError:
            continue  # the others cannot do without it
        step = tried(f"without {name}", f"{name} is not read", trial)
        helps = step.loss < now.loss - GAINED
        steps.append(replace(step, kept=helps))
        if helps:
            removed.append(name)
            best, now = trial, step
    last = designed_anew(loop, rig, loop.modes, removed) if removed else loop
    return best, tuple(steps), last, weight, criterion


def _stabilised(rig: Rig, loop: Loop, test: LoopTest) -> tuple[Loop, str]:
    """The loop, and in words by what it is slower or softer than designed where only so it is stable on a rig.

    Of the tunings that are, the one under which all modes vibrate least; the loop as it is where none is.
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
            return None  # none is that slow

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
    """By what a law and its filter were tuned, in words."""
    of_law = ("weight", weight) if _weighted(loop) else ("gain", 1.0 / np.sqrt(weight))
    return " and ".join(f"{what} × {by:.3g}" for what, by in (of_law, ("measurement noise", noise)) if by != 1)


def _faulty(rig: Rig, loop: Loop) -> list[str]:
    """Sensors with a fault, which an observer may do without; a filter needs them all."""
    if loop.controller.state.size == 0 or len(loop.controller.sensors) < 2:
        return []
    read = [named(rig.sensors, one.name) for one in loop.controller.sensors]
    return [s.name for s, clean in zip(read, without(read), strict=True) if s != clean]


def _perfect(actuator: Actuator) -> Actuator:
    """The actuator with its gain and nothing lost on the way."""
    at = {"kind": actuator.kind, "direction": actuator.direction, "direct": actuator.direct}
    return Actuator(actuator.name, actuator.at, gain=actuator.gain, **at)  # type: ignore[arg-type]


def force_weight(run: LoopRun, controlled: Sequence[int]) -> float:
    """ρ of the cost 2 ∫ energy dt + ρ ∫ FᵀF dt whose terms are equal over the controlled modes, as in the optimum.

    Args:
        run: of the loop that is taken for the optimum.
        controlled: zero-based modes.
    """
    return 2.0 * _vibration(run, controlled) / max(run.effort, 1e-300)


def _excess(run: LoopRun, ideal: LoopRun, controlled: Sequence[int]) -> tuple[float, float, float]:
    """What a loop takes more than an ideal one, see `Step`."""
    if not run.bounded:
        return np.inf, np.inf, np.inf
    (found, part), (wanted, ideal_part) = ((_vibration(r), _vibration(r, controlled)) for r in (run, ideal))
    controls = part / max(ideal_part, 1e-300) - 1.0
    spills = ((found - part) - (wanted - ideal_part)) / max(wanted, 1e-300)
    return max(controls, 0.0), max(spills, 0.0), max(run.effort / max(ideal.effort, 1e-300) - 1.0, 0.0)


def _vibration(run: LoopRun, modes: Sequence[int] | None = None) -> float:
    """∫ of the energy of some modes, or of all, over time; inf where the motion runs away."""
    if not run.bounded:
        return np.inf
    time, energy = run.response.time, run.response.energy
    return float((energy if modes is None else energy[list(modes)]).sum() * (time[1] - time[0]))


def _settling(run: LoopRun, controlled: Sequence[int]) -> float:
    """Settling time of the controlled modes, at most that of the test, s; inf where the motion runs away."""
    if not run.bounded:
        return np.inf
    time, energy = run.response.time, run.response.energy[list(controlled)].sum(axis=0)
    return min(settling(energy, float(time[1] - time[0])), float(time[-1]))


def _losses(rig: Rig, loop: Loop, step: str, units: Units) -> str:
    """What a step takes out, in words; empty where there is nothing."""
    words, newton = [], units.force
    for a in (named(rig.actuators, one.name) for one in loop.law.actuators):
        lost = []
        if step == "delay":
            parts = ("delay", a.delay), ("lag", a.time_constant)
            lost = [f"{what} {_short(value, units)}" for what, value in parts if value]
        elif step == "dead zone":
            parts = ("dead zone", a.dead_zone), ("bias", a.bias)
            lost = [f"{what} {value:.3g} {newton}" for what, value in parts if value]
        elif step == "saturation":
            limits = ("limit", a.limit, newton), ("rate", a.rate_limit, f"{newton}/{units.time}")
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
            f"{e.force:.3g} {newton} at {rig.modes.domain.text(e.at)}"
            for e in rig.elements
            if isinstance(e, CoulombFriction)
        ]
    return "; ".join(words)


def _short(time: float, units: Units) -> str:
    """A short time in words."""
    return f"{1e3 * time:.3g} ms" if units.time == "s" else f"{time:.3g} {units.time}"


def _gain(gain: float) -> str:
    """A gain in words, one near 1 by what it is off."""
    return f"gain {gain:.3g}" if abs(gain - 1.0) >= 0.005 else f"gain off by {_percent(abs(gain - 1.0))}"


def _notes(uncertain: UncertainRig, rig: Rig, aimed: bool) -> tuple[str, ...]:
    notes = []
    if not aimed:
        notes.append(
            "Even with perfect actuators and sensors the controlled modes do not settle within the test, so the"
            " controllers are judged by vibration and effort; give a longer test to judge them by settling."
        )
    if any(a.hysteresis_share for a in rig.actuators):
        notes.append("The hysteresis of an actuator is in the verification, but is not compensated.")
    if uncertain.alternatives:
        share = sum(p for _, p in uncertain.alternatives)
        notes.append(f"{100 * share:.0f} % of the draws are other sets of effects that the records do not exclude.")
    return tuple(notes)


def _times(after: np.ndarray, before: np.ndarray) -> str:
    """Median of draws (n_draws,) over another, in words that go before what is meant."""
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
    """Median and 95 % interval in per cent; digits until its ends differ, two to four."""
    middle, low, high = (100.0 * v for v in interval(values))
    digits = next((n for n in (2, 3, 4) if _rounded(low, n) != _rounded(high, n)), 0)
    if not digits:
        return f"{_rounded(middle, 3)} % (the same in all samples)"
    return f"{_rounded(middle, digits)} % ({lead}{_rounded(low, digits)} to {_rounded(high, digits)})"


def _rounded(value: float, digits: int) -> str:
    whole = len(f"{abs(value):.0f}") if abs(value) >= 1 else 0
    return f"{value:.{max(digits - whole, 0)}f}" if whole else f"{value:.{digits}g}"
