"""Figures of blind trials."""

from collections import Counter

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from workbench.draw.style import COLOURS, new_figure
from workbench.gap.effects.effect import label_in_words
from workbench.trials.scoring import Statistics

FAMILY = {"single": "one effect", "pair": "two effects", "none": "nothing", "unknown": "outside the catalogue"}
BOTH = FAMILY["pair"]  # the row of all pairs
MOST_ROWS = 24  # of a column


def plot_confusion(statistics: Statistics) -> Figure:
    """A row per true effect: the share of its cases that are named correctly, their number, and what else is named.

    All pairs have one row.
    """
    rows = _rows(statistics)
    names = sorted(rows, key=_order)
    columns = 1 + (len(names) > MOST_ROWS)
    each = -(-len(names) // columns)
    options = {"width": 7.0 + 4.0 * (columns - 1), "height": 1.5 + 0.24 * each, "squeeze": False}
    figure, axes = new_figure(1, columns, **options)
    for ax, first in zip(axes[0], range(0, len(names), each)):
        _table(ax, names[first : first + each], rows, each)
    total = sum(of for _, of in statistics.shares.values())
    shares = [f"{FAMILY[family]} {right} of {of}" for family, (right, of) in statistics.shares.items()]
    figure.suptitle(f"{total} blind cases, named correctly: {', '.join(shares)}", x=0.01, ha="left", fontsize=11)
    return figure


def _table(ax: Axes, names: list[str], rows: dict[str, Counter[str]], height: int) -> None:
    for i, name in enumerate(names):
        named, of = rows[name][name], rows[name].total()
        share = 100.0 * named / of
        ax.barh(i, share, color=COLOURS[0], height=0.64)
        ax.barh(i, 100.0 - share, left=share, color=COLOURS[1], height=0.64)
        ax.annotate(f"{named} / {of}", (100.0, i), (5, 0), textcoords="offset points", va="center", fontsize=8)
        others = [f"{_plain(other)} {count}" for other, count in rows[name].items() if other != name]
        if others:
            ax.text(2.0, i, f"named instead: {', '.join(others)}", va="center", color="white", fontsize=8)
    ax.set_yticks(np.arange(len(names)), [_plain(name) for name in names], fontsize=8)
    ax.set(xlim=(0.0, 100.0), ylim=(height - 0.4, -0.6), xlabel="share named correctly [%]; named / cases")
    ax.grid(False)


def _rows(statistics: Statistics) -> dict[str, Counter[str]]:
    """Numbers of cases by true effect and by what is named."""
    rows: dict[str, Counter[str]] = {}
    for (hidden, named), count in statistics.counts.items():
        pair = " + " in hidden
        rows.setdefault(BOTH if pair else hidden, Counter())[BOTH if pair and named == hidden else named] += count
    return rows


def _order(name: str) -> tuple[int, str]:
    return ({"none": 1, BOTH: 2, "unknown": 3}.get(name, 0), _plain(name).lower())


def _plain(name: str) -> str:
    """The words of an effect, or of several."""
    if name == BOTH:
        return name
    return " + ".join(FAMILY.get(part, label_in_words(part)) for part in name.split(" + "))
