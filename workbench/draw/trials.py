"""Figures of blind trials."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.gap.effects.effect import label_in_words
from workbench.structure.printed import counted
from workbench.trials.imperfections import CLEAN, TRIPLE
from workbench.trials.scoring import Reliability, Tally

_FAMILY = {
    "single": "one effect:",
    "pair": "two effects:",
    "none": "nothing hidden:",
    "unknown": "outside the catalogue:",
}
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
BOTH, OTHER, ALWAYS_RIGHT = "both effects", "another two", "always right"
MANY = 12  # kinds that are shown one by one; of more, those that were always named have one row together


def plot_confusion(tally: Tally) -> Figure:
    """True against diagnosed effects, one square a case or more; on the diagonal, the correct answers."""
    counts = _gathered(tally)
    rows = sorted({hidden for hidden, _ in counts}, key=_order)
    columns = rows + sorted({named for _, named in counts} - set(rows), key=_order)
    figure, ax = new_figure(width=max(8.0, 3.6 + 0.27 * len(columns)), height=2.6 + 0.24 * len(rows))
    for (hidden, named), count in counts.items():
        x, y, right = columns.index(named), rows.index(hidden), hidden == named
        ax.add_patch(Rectangle((x - 0.46, y - 0.44), 0.92, 0.88, color=COLOURS[0 if right else 1], linewidth=0))
        ax.text(x, y, str(count), ha="center", va="center", color="white", fontsize=8)
    ax.plot([-0.5, len(rows) - 0.5], [-0.5, len(rows) - 0.5], color=GREY, linewidth=0.6, zorder=0)
    ax.set_xticks(range(len(columns)), [_plain(c) for c in columns], rotation=90, fontsize=8)
    ax.set_yticks(range(len(rows)), ["two effects" if r == BOTH else _plain(r) for r in rows], fontsize=8)
    ax.set(
        xlim=(-0.6, len(columns) - 0.4), ylim=(len(rows) - 0.4, -0.6), xlabel="diagnosed effect", ylabel="true effect"
    )
    total = sum(of for _, of in tally.shares.values())
    each = [f"{_FAMILY[family]} {right} of {of}" for family, (right, of) in tally.shares.items()]
    words = "\n".join("; ".join(each[i : i + 2]) for i in range(0, len(each), 2))
    ax.set_title(f"{total} blind cases; number of each, blue correct, orange wrong\n{words}")
    return figure


def plot_times(seconds: Mapping[str, Sequence[float]], limits: Mapping[str, float]) -> Figure:
    """How long each diagnosis took, a dot per case, and how long it may take, by family of cases."""
    figure, ax = new_figure(width=9, height=1.2 + 0.7 * len(seconds))
    for y, (family, times) in enumerate(seconds.items()):
        ax.plot(times, [y] * len(times), "o", color=COLOURS[0], alpha=0.6, label="a case" if y == 0 else None)
        ends, label = [y - 0.35, y + 0.35], "limit" if y == 0 else None
        ax.plot([limits[family]] * 2, ends, color=COLOURS[1], linewidth=2, label=label)
    ax.set_yticks(range(len(seconds)), [_FAMILY[family].rstrip(":") for family in seconds])
    ax.set(xlim=(0, None), ylim=(len(seconds) - 0.5, -0.5), xlabel="wall-clock time on two cores [s]")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    return figure


def plot_imperfections(scores: Sequence[Mapping[str, Any]]) -> Figure:
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


def plot_reliability(points: Sequence[Reliability]) -> Figure:
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


def _gathered(tally: Tally) -> dict[tuple[str, str], int]:
    """Counts with all pairs in one row and two columns, and of many kinds those always named in one."""
    gathered: dict[tuple[str, str], int] = {}

    def add(hidden: str, named: str, count: int) -> None:
        gathered[hidden, named] = gathered.get((hidden, named), 0) + count

    singles = {hidden for hidden, _ in tally.counts if " + " not in hidden} - {"none", "unknown"}
    mixed_up = {name for pair in tally.counts if pair[0] != pair[1] for name in pair}
    sure = singles - mixed_up if len(singles) > MANY else set()
    for (hidden, named), count in tally.counts.items():
        if " + " in hidden:
            add(BOTH, BOTH if named == hidden else OTHER if " + " in named else named, count)
        elif hidden in sure:
            add(ALWAYS_RIGHT, ALWAYS_RIGHT, count)
        else:
            add(hidden, OTHER if " + " in named else named, count)
    return gathered


def _order(name: str) -> tuple[int, str]:
    return ({ALWAYS_RIGHT: 1, "none": 2, BOTH: 3, OTHER: 4, "unknown": 5}.get(name, 0), name)


def _plain(name: str) -> str:
    plain = {"none": "nothing", "unknown": "outside the catalogue", ALWAYS_RIGHT: "one effect, always named"}
    return plain.get(name, label_in_words(name))
