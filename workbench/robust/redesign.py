"""Redesign of a controller for a diagnosed structure, step by step, with Monte Carlo verification."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from workbench.arguments import number, whole
from workbench.design.estimation.digital import DigitalController, sampled
from workbench.design.laws.law import DesignError
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.rig_loop import LoopTest, run_loop
from workbench.gap.report.verdict import Verdict
from workbench.records.units import SI, Units
from workbench.renamed import former_arguments
from workbench.rig.actuators import without_crosstalk
from workbench.rig.rig import Rig
from workbench.robust.advice import MAX_COST_INCREASE, Redesign
from workbench.robust.compensation import Loop, check_rate, compensated
from workbench.robust.impulse import impulse_test
from workbench.robust.on_rig import Design, controlled_by, loop_on_rig, redesigned_for
from workbench.robust.posterior import WHAT_DRAWS, UncertainRig
from workbench.robust.prediction import LEAST_DRAWS
from workbench.robust.relocation import relocated
from workbench.robust.small_motion import modes_in_motion
from workbench.robust.steps import Search, Step, force_weight, weighted
from workbench.robust.verification import check_test, drawn_with_errors, verify
from workbench.structure.domain import Location
from workbench.threads import one_blas_thread

__all__ = ["CRITERIA", "Redesign", "Step", "force_weight", "redesign"]

CRITERIA = ("cost", "settling")


@former_arguments(aim="criterion", report="progress", more_cost="max_cost_increase", more_work="max_work_increase")
@one_blas_thread
def redesign(
    verdict: Verdict | UncertainRig,
    design: Design,
    *,
    sample_time: float | None = None,
    impulse_at: Location | None = None,
    test: LoopTest | None = None,
    draws: int = 200,
    seed: int = 0,
    placement: bool = True,
    criterion: str | None = None,
    max_cost_increase: float = MAX_COST_INCREASE,
    max_work_increase: float = np.inf,
    units: Units | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Redesign:
    """A controller of the same kind, redesigned for the corrected rig; both are verified on the same draws.

    Law and estimator are redesigned with the same settings for the modes of the corrected rig, in which each nonlinear
    element at a point is replaced by its equivalent spring and damper in the motion under test. Delays, dead zones,
    saturation, sensor faults and friction are then compensated one by one; a step is kept where it reduces the loss.

    Args:
        verdict: of the diagnosis, or the corrected rig with its uncertainty.
        design: in use: a `Controller` from `luenberger_controller`, `kalman_controller` or a modal filter; a law,
            which gets a Kalman filter on the rig's sensors; or a `PlacementTask`, whose IMSC law gets the rig's
            actuators.
        sample_time: of the controller, s; by default that of the records.
        impulse_at: place of the test's impulse; by default that of the hammer, or of the first actuator.
        test: instead of the impulse.
        draws: number of draws of the uncertain rig on which both are verified.
        seed: of the draws and of the sensors' noise.
        placement: whether to optimise the places of the actuators too.
        criterion: "cost" or "settling", see `Redesign`; by default "cost" for a law that minimises a cost, and
            "settling" for a law by poles or on-off control.
        max_cost_increase: relative increase of the cost that is allowed where the redesigned controller settles sooner.
        max_work_increase: relative increase of the work W = Σ_r |W_r| that is allowed; by default any.
        units: of the results; by default those of the verdict.
        progress: called with (text, share done).

    Raises:
        DesignError: a controller that does not fit the rig, a rate too slow for the modes, an impulse that excites none
            of them, or modes that cannot be controlled on the corrected rig.
        TypeError: no verdict, no design, no test, or an argument that is no number.
        ValueError: an impulse outside the structure, no draws, an unknown criterion, or a share below zero.
    """
    _check_wanted(criterion, max_cost_increase, max_work_increase)
    draws, seed = whole(draws, WHAT_DRAWS, least=1), whole(seed, "seed")
    if test is not None:
        check_test(test)
    uncertain = verdict if isinstance(verdict, UncertainRig) else UncertainRig.of(verdict)
    nominal, corrected = uncertain.nominal, uncertain.rig
    units = units or (verdict.units if isinstance(verdict, Verdict) else SI)
    records = () if isinstance(verdict, UncertainRig) else verdict.attribution.search.data.records
    known = sample_time, test and test.sample_time, records[0].sample_time if records else None
    first = next((time for time in known if time is not None), None)
    if first is None:
        raise DesignError("the sample time of the controller is not known; give sample_time, in s")
    sample_time = number(first, "sample_time", "s")
    controlled = controlled_by(design)
    check_rate(nominal.modes, controlled, sample_time)
    progress("the present controller", 0.05)
    if test is None:
        level = np.max([np.abs(r.outputs).max(axis=1) for r in records], axis=0) if records else None
        test = impulse_test(nominal, controlled, sample_time, impulse_at, level=level, seed=seed)
    loop = loop_on_rig(nominal, design, test)
    present = _present(nominal, loop, sample_time)
    before = run_loop(corrected, present, test)
    progress("designing for the corrected rig", 0.15)
    modes = modes_in_motion(corrected, run_loop(corrected, _silent(present), test))
    for _ in range(2):  # again, as the equivalent stiffness of elements changes in the smaller motion
        new_loop = redesigned_for(loop, corrected, modes)
        wanted = criterion or ("cost" if weighted(new_loop) else "settling")
        search = Search(corrected, new_loop, test, present, wanted, units)
        search.run()
        after = run_loop(corrected, search.controller, test)
        if not corrected.elements or not after.bounded:
            break
        modes = modes_in_motion(corrected, after)
    controlled = search.loop.law.controlled
    progress("verification on the draws", 0.4)
    rigs = drawn_with_errors(uncertain, draws, seed)
    old = verify(rigs, present, test, controlled=controlled, margin_rig=corrected)
    progress("verification on the draws", 0.65)
    new = verify(rigs, search.controller, test, controlled=controlled, margin_rig=corrected)
    progress("placement of actuators", 0.9)
    moved = relocated(search.loop, test, units) if placement else None
    progress("done", 1.0)
    return Redesign(
        uncertain_rig=uncertain,
        present=present,
        redesigned=search.controller,
        loop=search.loop,
        controlled=controlled,
        steps=tuple(search.steps),
        test=test,
        before=before,
        after=after,
        present_verification=old,
        verification=new,
        weight=search.weight,
        criterion=search.criterion,
        max_cost_increase=max_cost_increase,
        max_work_increase=max_work_increase,
        relocation=moved,
        notes=_notes(uncertain, corrected, draws, as_wanted=search.criterion == wanted),
        units=units,
    )


def _check_wanted(criterion: str | None, max_cost_increase: float, max_work_increase: float) -> None:
    """Refuse an unknown criterion, or a share that is none."""
    if criterion not in (None, *CRITERIA):
        raise ValueError(f"the criterion is {' or '.join(CRITERIA)}; got {criterion!r}")
    for name, share in (("max_cost_increase", max_cost_increase), ("max_work_increase", max_work_increase)):
        if not number(share, name) >= 0:
            raise ValueError(
                f"{name} is the relative increase allowed over the present controller, 0 or more; got {share:g}"
            )


def _present(rig: Rig, loop: Loop, sample_time: float) -> DigitalController:
    """The controller in use, designed for the nominal rig, without compensation."""
    if isinstance(loop.law, OnOffLaw):
        return compensated(replace(rig, actuators=without_crosstalk(rig.actuators)), loop, sample_time, ())
    return sampled(loop.controller, sample_time)


def _silent(controller: DigitalController) -> DigitalController:
    """A controller of the same sensors and actuators that commands nothing."""
    n_y, n_u = len(controller.sensors), len(controller.actuators)
    a, b, c, d, e = (np.zeros(shape) for shape in ((0, 0), (0, n_y), (n_u, 0), (n_u, n_y), (0, n_u)))
    return DigitalController(controller.sample_time, controller.sensors, controller.actuators, a, b, c, d, e)


def _notes(uncertain: UncertainRig, rig: Rig, draws: int, *, as_wanted: bool) -> tuple[str, ...]:
    """Remarks on the criterion, where it is not the wanted one, hysteresis, alternative sets, and few draws."""
    notes = []
    if not as_wanted:
        notes.append(
            "Even with ideal actuators and sensors the controlled modes do not settle within the test, so the"
            " controllers are judged by vibration and effort; give a longer test to judge them by settling."
        )
    if any(a.crosstalk for a in rig.actuators):
        notes.append(
            "The cross-talk between actuators is undone on the commands, but for the part that a limit or a dead zone"
            " of an actuator takes."
        )
    if any(a.hysteresis_share for a in rig.actuators):
        notes.append("The hysteresis of an actuator is in the verification, but is not compensated.")
    if uncertain.alternatives:
        share = sum(p for _, p in uncertain.alternatives)
        notes.append(f"{100 * share:.0f} % of the draws are of other sets of effects that the records do not exclude.")
    if draws < LEAST_DRAWS:
        notes.append(
            f"The intervals are the range of {draws} draws, not of 95 %, which need {LEAST_DRAWS} draws or more."
        )
    return tuple(notes)
