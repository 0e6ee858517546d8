"""How often does the diagnosis name what hides beside the small errors of a real test, in blind trials?"""

from pathlib import Path

from workbench.draw.trials import plot_imperfections, plot_reliability
from workbench.trials.hold import hold_one, processor_times
from workbench.trials.imperfections import IMPERFECTIONS, SIZES
from workbench.trials.make import draw_imperfect_kinds
from workbench.trials.scoring import NONE, reliability, tally_imperfect

CASES, SEED = 300, 20360101
FEW = 10  # claims: a share of fewer is chance


def study(outcome, data: Path | None = None) -> None:
    drawn = draw_imperfect_kinds(CASES, SEED)
    cases = [{**draw._asdict(), "kinds": list(draw.kinds), "seed": SEED + i} for i, draw in enumerate(drawn)]
    found = outcome.run(cases, hold_one)
    # a bench on which the effect would not show beside those imperfections is no trial
    held = [result for result in found if result.error is None]
    unsuited = [result for result in found if result.error is not None and "no case with" in str(result.error)]
    scores = [result["score"] for result in held]
    for result in found:
        if result.error is not None:
            outcome.say(f"seed {result['seed']}: {result.error}")
        elif not result["score"]["named"]:
            score = result["score"]
            outcome.say(
                f"seed {result['seed']}, {score['class']}: true {score['hidden']}, diagnosed {score['diagnosed']}"
            )
    outcome.table("scores", {result["seed"]: result["score"] for result in held})
    by_class = {name: tally_imperfect(s for s in scores if s["class"] == name) for name in IMPERFECTIONS}
    by_size = {size: tally_imperfect(s for s in scores if s["size"] == size) for size in SIZES}
    outcome.table("by class", by_class)
    outcome.table("by size", by_size)
    outcome.table("processor time, s", processor_times(held))

    whole = tally_imperfect(scores)
    quiet = sum(score["hidden"] == NONE for score in scores)
    outcome.check(f"trials of {CASES} that ended in an error", len(found) - len(held) - len(unsuited), 0)
    outcome.check("share named", whole["named"], 0.9, at_least=True)
    outcome.check("share with a wrong name", whole["wrong"], 0.02)
    outcome.check(f"false alarms in {quiet} cases that hide nothing", whole["false_alarms"], 0)
    outcome.check("share of places within 3 % of the length", whole["placed"], 0.9, at_least=True)
    outcome.check("share of numbers within their 95 % interval", whole["covered"], 0.9, at_least=True)
    outcome.check("share of budgets right to 0.05", whole["honest"], 0.9, at_least=True)
    points = reliability(scores)
    outcome.table("reliability", [point._asdict() for point in points])
    off = max((abs(p.right - p.probability) for p in points if p.claims >= FEW), default=0.0)
    outcome.check(f"reliability: distance from the diagonal of {FEW} claims or more", off, 0.1)
    outcome.figure("named", plot_imperfections(scores), "Share named correctly, by class and size of the small errors.")
    outcome.figure(
        "reliability", plot_reliability(points), "Share of claims that are right, by the probability stated."
    )
