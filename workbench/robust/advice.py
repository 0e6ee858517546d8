"""A redesign: the present and the redesigned controller on the same draws, and the advice which to use."""

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from workbench.design.estimation.digital import DigitalController
from workbench.design.export.export import write_controller
from workbench.design.export.source import command_words, reading_words
from workbench.design.loop.rig_loop import LoopRun, LoopTest, named
from workbench.records.units import SI, Units
from workbench.renamed import Renamed
from workbench.robust.compensation import Loop
from workbench.robust.posterior import UncertainRig
from workbench.robust.relocation import Relocation
from workbench.robust.steps import GAINED, Step
from workbench.robust.verification import Verification, interval

MAX_COST_INCREASE = 0.01  # of the present cost: default of `max_cost_increase`
AS_MUCH = "as much"


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
            modes where actuators and sensors are ideal; "settling": J = t + ρ ∫ FᵀF dt with t the settling time of
            the controlled modes, at most that of the test, and ρ such that both terms are equal there.
        max_cost_increase, max_work_increase: allowed relative increase of the cost J and of the work W over those of
            the present controller.
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
    max_cost_increase: float = MAX_COST_INCREASE
    max_work_increase: float = np.inf
    relocation: Relocation | None = None
    notes: tuple[str, ...] = ()
    units: Units = SI

    pays, aim = Renamed("improves"), Renamed("criterion")
    more_cost, more_work = Renamed("max_cost_increase"), Renamed("max_work_increase")
    left_undamped = Renamed("spillover_warning")
    promise, figures = Renamed("guarantee"), Renamed("comparison")
    proof, present_proof = Renamed("verification"), Renamed("present_verification")
    possible = Renamed("uncertain_rig")

    @property
    def _both(self) -> tuple[Verification, Verification]:
        return self.present_verification, self.verification

    @cached_property
    def improves(self) -> bool:
        """Whether the redesigned controller is better than the present one, on the same draws.

        It is if it is stable on more draws. On as many, it must cost less or settle sooner, and exceed neither the
        allowed cost nor the allowed work: by the means of log J and log W, W = Σ_r |W_r|, over draws stable with both.
        """
        old, new = self._both
        if new.n_stable != old.n_stable:
            return new.n_stable > old.n_stable
        return self._better and not self._more

    @property
    def _better(self) -> bool:
        """Whether the redesigned controller costs less than the present one, or settles sooner."""
        return self._over[0] < 1.0 or self._sooner_by > 0.0

    @property
    def _sooner_by(self) -> float:
        """Share of the settling time that the redesigned controller saves, in the median of the draws."""
        old, new = self._medians(self._settling)
        if not np.isfinite(old):
            return float(np.isfinite(new))
        return 1.0 - new / old if old else 0.0

    @property
    def _settling(self) -> str:
        """The settling time that counts: of the controlled modes with criterion "settling", else of all."""
        return "settling" if self.criterion == "cost" else "controlled_settling"

    def _medians(self, name: str) -> tuple[float, float]:
        """A quantity in the median of the draws, with the present and with the redesigned controller."""
        old, new = (float(interval(getattr(one, name))[0]) for one in self._both)
        return old, new

    @property
    def _more(self) -> str:
        """Cost and work above what is allowed, in words; empty for none."""
        cost, work = (over - 1.0 for over in self._over)
        what = "vibration" if self.criterion == "cost" else "time"
        texts = []
        if cost > self.max_cost_increase:
            texts.append(f"its cost J ({what} and effort) is {_percent(cost)} higher: {_allowing('cost', cost)}")
        if work > self.max_work_increase:
            texts.append(f"its work W is {_percent(work)} higher: {_allowing('work', work)}")
        return ", and ".join(texts)

    @cached_property
    def _over(self) -> tuple[float, float]:
        """J and W over those of the present controller: geometric means over draws stable with both; inf for none."""
        both = self.present_verification.stable & self.verification.stable
        if not both.any():
            return np.inf, np.inf
        old, new = ((self._cost(one)[both], one.all_work[both]) for one in self._both)
        with np.errstate(divide="ignore", invalid="ignore"):  # the work may be zero
            cost, work = (float(np.exp(np.log(after / before).mean())) for before, after in zip(old, new))
        return cost, work

    def _cost(self, verification: Verification) -> np.ndarray:
        """J of each draw (n_draws,); inf where it is not stable."""
        settles = np.minimum(verification.controlled_settling, self.test.time[-1])
        cost = 2.0 * verification.vibration if self.criterion == "cost" else np.array(settles)
        if self.weight:  # with weight 0, of relays, an infinite effort would give nan
            cost = cost + self.weight * verification.effort
        return np.asarray(np.where(verification.stable, cost, np.inf))

    @property
    def controller(self) -> DigitalController:
        """The controller to use: the redesigned one where it is better, else the present one."""
        return self.redesigned if self.improves else self.present

    @property
    def _used(self) -> Verification:
        return self._both[self.improves]

    @property
    def mode(self) -> int:
        """The controlled mode (zero-based) whose damping is changed most."""
        old, new = (np.median(one.damping[:, list(self.controlled)], axis=0) for one in self._both)
        return self.controlled[int(np.argmax(np.abs(new - old)))]

    @property
    def sentence(self) -> str:
        """The redesign in one sentence."""
        kept = "" if self.improves and not self._no_controller else self._reason_to_keep
        return " ".join(part for part in (self.comparison, kept, self.guarantee) if part)

    @property
    def comparison(self) -> str:
        """Damping or settling time, effort and stability of both controllers, in one sentence."""
        old, new = self._both
        unstable = old.n_draws - old.n_stable
        if old.share_stable < 0.5:
            text = f"the present controller is unstable on {unstable:,} of {old.n_draws:,} draws; redesigned, it "
            text += self._behaviour(new, "95 %: ")
        else:
            work = self._times("work", "all_work")
            text = f"the present controller {self._behaviour(old, '95 %: ')}"
            text += f", unstable on {unstable} draws" if unstable else ""
            text += f"; redesigned: {self._behaviour(new, '', named=False)}, {self._times('effort')}"
            text += "" if work.startswith(AS_MUCH) else f" and {work}"
        text = f"On the corrected model {text}; stable on {_stable(new)} Monte Carlo draws."
        return f"{text} {self.spillover_warning}".rstrip()

    @property
    def _reason_to_keep(self) -> str:
        """Why to keep the present controller."""
        old, new = self._both
        if self._no_controller:
            return self._no_controller
        if new.n_stable < old.n_stable:
            why = "it is stable on more draws of the model"
        elif self._better and np.isfinite(self._over).all():
            why = f"the new one {self._difference}, but {self._more}"
        else:
            why = "the new one costs no less and settles no sooner"
        return f"Keep the present controller: {why}."

    @property
    def _no_controller(self) -> str:
        """The advice to use neither controller; empty where one is stable on half of the draws or more."""
        old, new = self._both
        if max(old.share_stable, new.share_stable) >= 0.5:
            return ""
        return (
            f"Use neither controller: the present one is stable on {_stable(old)} draws of the model, the redesigned"
            f" on {new.n_stable:,}; increase R, make the estimator slower, control fewer modes, or read more sensors."
        )

    def _behaviour(self, verification: Verification, lead: str, *, named: bool = True) -> str:
        """Damping of the mode that is changed most; of on-off control, which has no poles, the settling time."""
        if self.redesigned.relays is not None:
            middle, low, high = interval(getattr(verification, self._settling))
            if not np.isfinite(high):
                return self._settles(middle)
            ends = "" if f"{low:.3g}" == f"{high:.3g}" else f" ({lead}{low:.3g} to {high:.3g})"
            return f"{'settles in ' * named}{middle:.3g} {self.units.time}{ends}"
        ratios = _ratios(verification.damping[:, self.mode], lead)
        return f"keeps mode {self.mode + 1} at {ratios} damping" if named else ratios

    @property
    def advice(self) -> str:
        """The advice which controller to use, and why."""
        if not self.improves or self._no_controller:
            return self._reason_to_keep
        old, new = self._both
        if new.n_stable != old.n_stable:
            return f"Use the redesigned controller: it {self._difference}."
        if max(1.0 - self._over[0], self._sooner_by) < GAINED:
            return f"The controllers are equivalent: the redesigned {self._difference} (medians of the draws)."
        forces = self._medians("peak_force")
        at_first, now = (f"{force:.3g} {self.units.force}" for force in forces)
        forced = f", with at most {now} instead of {at_first}" if np.isfinite(forces).all() and now != at_first else ""
        of_draw = self._cost if self._over[0] < 1.0 else attrgetter(self._settling)
        before, after = (of_draw(one)[old.stable & new.stable] for one in self._both)
        sure = f"it does better on {int((after < before).sum()):,} of {new.n_draws:,} draws"
        return f"Use the redesigned controller: it {self._difference}{forced} (medians); {sure}."

    @property
    def _difference(self) -> str:
        """The difference of the redesigned controller from the present one, in words."""
        old, new = self._both
        if new.n_stable != old.n_stable:
            return f"is stable on {_stable(new)} draws, the present one on {old.n_stable:,}"
        before, after = self._medians(self._settling)
        if self.criterion == "settling":
            own, old_time = self._settles(after, " the controlled modes"), self._settles(before, " them")
            settles, effort = f"{own} where the present one {old_time}", self._times("effort")
            return f"{settles}, for {effort}" if self._sooner_by > 0.0 else f"takes {effort} and {settles}"
        less = 1.0 - self._over[0]
        if self._sooner_by > 0.0 and self._sooner_by >= less:  # state the larger of the two gains
            return f"{self._settles(after)} where the present one {self._settles(before)}"
        parts = f"{self._times('vibration')} and {self._times('effort')}"
        return f"{'lowers' if less > 0 else 'raises'} the cost J by {_percent(abs(less))}, with {parts}"

    def _settles(self, time: float, what: str = "") -> str:
        """A settling time in words."""
        if not np.isfinite(time):
            return f"does not settle{what} within the test"
        return f"settles{what} in {time:.3g} {self.units.time}"

    def _times(self, what: str, name: str = "") -> str:
        """The ratio of the medians of a quantity, as text: "as much effort", or "1.2 times the effort"."""
        old, new = self._medians(name or what)
        if old == 0.0:
            return f"{AS_MUCH if new == 0.0 else 'nonzero instead of zero'} {what}"
        times = f"{new / old:.2g}"
        return f"{AS_MUCH if times == '1' else f'{times} times the'} {what}"

    @property
    def spillover_warning(self) -> str:
        """A warning where spillover takes more than half of the damping of a residual mode; empty for none."""
        ratios = np.median(self._used.damping, axis=0)
        own = self.loop.modes.zeta[: ratios.size]
        r = int(np.argmin(ratios))
        if r in self.controlled or ratios[r] >= 0.5 * own[r] or self._used.share_stable < 0.5:
            return ""
        return (
            f"Spillover lowers the damping ratio of residual mode {r + 1} from {100.0 * own[r]:.2g} to"
            f" {100.0 * ratios[r]:.2g} %: specify less damping, or control that mode too."
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
        below = "the unexplained share stays below this margin at every frequency"
        sure = f"guaranteed if {below}" if margin > share else "not guaranteed"
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


def _stable(verification: Verification) -> str:
    return f"{verification.n_stable:,} of {verification.n_draws:,}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def _allowing(name: str, increase: float) -> str:
    return f"allow it by max_{name}_increase = {np.ceil(100.0 * increase) / 100.0:g}"


def _ratios(values: np.ndarray, lead: str) -> str:
    """Median and 95 % interval in per cent as text, with two or three digits; the median alone where the ends agree."""
    middle, low, high = (100.0 * v for v in interval(values))
    digits = next((n for n in (2, 3) if _rounded(low, n) != _rounded(high, n)), 0)
    if not digits:
        return f"{_rounded(middle, 3)} %"
    return f"{_rounded(middle, digits)} % ({lead}{_rounded(low, digits)} to {_rounded(high, digits)})"


def _rounded(value: float, digits: int) -> str:
    whole = len(f"{abs(value):.0f}") if abs(value) >= 1 else 0
    return f"{value:.{max(digits - whole, 0)}f}" if whole else f"{value:.{digits}g}"
