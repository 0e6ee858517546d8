"""How often does the diagnosis name what hides beside the small errors of a real test, in blind trials?"""

from pathlib import Path

import numpy as np

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.structure.printed import counted
from workbench.trials.hold import draw_imperfect_kinds, hold_one, processor_times
from workbench.trials.imperfections import CLEAN, IMPERFECTIONS, SIZES, TRIPLE
from workbench.trials.scoring import NONE, imperfect_statistics, reliability

CASES, SEED = 300, 20420777
FEW = 10  # claims: a share of fewer is chance


_ERRORS = {
    "clean": "no test errors",
    "shape": "mass, stiffness, damping vary",
    "offset": "stiffness and damping off uniformly",
    "noise": "noise above the stated",
    "coloured": "coloured noise",
    "input": "noise of logged inputs",
    "late": "delays of sensors",
    "gain": "errors of calibration",
    "place": "positions of sensors and actuators off",
    "mixed": "several of these",
    "triple": "no test errors, three effects",
}


def plot_imperfections(scores):
    """How many trials of `score_imperfect` were named correctly, by class and size of the small errors beside them."""
    classes, sizes = list(dict.fromkeys(s["class"] for s in scores)), sorted({s["size"] for s in scores})
    figure, ax = new_figure(width=9, height=1.6 + 0.45 * len(classes))
    for row, name in enumerate(classes):
        own = [s for s in scores if s["class"] == name]
        bars = [(own, 0.0, GREY)]
        if name not in (CLEAN, TRIPLE):
            apart = 0.27 * (np.arange(len(sizes)) - (len(sizes) - 1) / 2)
            by_size = [[s for s in own if s["size"] == size] for size in sizes]
            bars = list(zip(by_size, apart, COLOURS, strict=False))
        for there, offset, colour in bars:
            if there:
                named = sum(s["named"] for s in there)
                ax.barh(row + offset, 100 * named / len(there), 0.24, color=colour)
                ax.text(101, row + offset, f"{named} of {len(there)}", va="center", fontsize=7)
    for column, size in enumerate(sizes):
        ax.barh(0, 0, color=COLOURS[column], label=f"{size:g} ×")
    ax.set_yticks(range(len(classes)), [_ERRORS[name] for name in classes])
    ax.set(xlim=(0, 112), ylim=(len(classes) - 0.4, -0.6), xlabel="correct verdicts [%]")
    ax.set_ylabel("class of test error")
    title = "errors, relative to those of a careful test"
    ax.legend(title=title, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(sizes), fontsize=8)
    return figure


def plot_reliability(points):
    """Reliability diagram: the share of verdicts that are right against the probability that they state."""
    figure, ax = new_figure(width=5.5, height=5)
    ax.fill_between([0, 1], [-0.1, 0.9], [0.1, 1.1], color=GREY, alpha=0.25, linewidth=0, label="within 0.1")
    ax.plot([0, 1], [0, 1], color=GREY, linewidth=1)
    # two binomial standard deviations of a share of so few
    bars = [2 * (max(p.right * (1 - p.right), 0.25 / p.claims) / p.claims) ** 0.5 for p in points]
    x, y = [p.probability for p in points], [p.right for p in points]
    ax.errorbar(x, y, bars, fmt="o", color=COLOURS[0], capsize=3, label="± 2 standard deviations")
    for point in points:
        beside = (8, 4) if point.probability < 0.7 else (-60, -12)
        count = counted(point.claims, "claim")
        ax.annotate(count, (point.probability, point.right), beside, textcoords="offset points")
    ax.set(
        xlim=(-0.03, 1.03), ylim=(-0.03, 1.03), aspect="equal", xlabel="stated probability", ylabel="observed frequency"
    )
    ax.legend(loc="lower right", fontsize=8)
    return figure


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
    by_class = {name: imperfect_statistics(s for s in scores if s["class"] == name) for name in IMPERFECTIONS}
    by_size = {size: imperfect_statistics(s for s in scores if s["size"] == size) for size in SIZES}
    outcome.table("by class", by_class)
    outcome.table("by size", by_size)
    outcome.table("processor time, s", processor_times(held))

    whole = imperfect_statistics(scores)
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
