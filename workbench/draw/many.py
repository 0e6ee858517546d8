"""Figures of many cases."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from workbench.draw.style import new_figure


def plot_cases(rows: Sequence[dict[str, Any]], *, x: str, y: str, by: str) -> Figure:
    """One quantity over another, a line for each value of a third; y is logarithmic where all of it is positive."""
    values = sorted({row[by] for row in rows})
    figure, ax = new_figure(width=9, height=4.5)
    for value, colour in zip(values, colormaps["viridis"](np.linspace(0.0, 0.9, len(values)))):
        line = sorted((row[x], row[y]) for row in rows if row[by] == value and row[y] is not None)
        ax.plot(*np.array(line).T, color=colour, label=f"{by} {value:.3g}")
    scale = "log" if all(row[y] is None or row[y] > 0 for row in rows) else "linear"
    ax.set(xlabel=x, ylabel=y, yscale=scale)
    ax.legend(ncols=1, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure
