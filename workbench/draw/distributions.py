"""Pictures of mass and stiffness found along a structure, and of losses placed."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.identification.updating.local_loss import LocatedDamage

Case = tuple[LocatedDamage, Callable[[np.ndarray], np.ndarray], np.ndarray]


def stiffness_found(cases: Mapping[str, Case]) -> Figure:
    """Stiffness along each structure; cases[title] are (what was found, the true stiffness, places of the sensors)."""
    rows = (len(cases) + 1) // 2
    figure, axes = new_figure(rows, 2, width=10.0, height=0.6 + 2.9 * rows, sharex=True, sharey=True, squeeze=False)
    highest = 0.0
    for ax, (title, (found, truth, sensors)) in zip(axes.ravel(), cases.items()):
        length = found.best.structure.length
        x = np.linspace(0.0, length, 801)
        low, high = found.best.stiffness.band(x)
        ax.plot(x, truth(x), color=GREY, lw=4, alpha=0.6, label="true")
        ax.fill_between(x, low, high, color=COLOURS[0], alpha=0.25, lw=0, label="95 % band")
        ax.plot(x, found.best.stiffness(x), color=COLOURS[0], label="identified")
        ax.plot(sensors, np.zeros(sensors.size), "^", color=COLOURS[1], ms=8, clip_on=False, label="sensors")
        ax.set_title(title)
        highest = max(highest, high.max(), truth(x).max())
    axes[0, 0].set_ylim(0.0, 1.05 * highest)
    for ax in axes[-1]:
        ax.set_xlabel("x / length")
    for ax in axes[:, 0]:
        ax.set_ylabel("stiffness / nominal")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=4)
    return figure


def places_found(rows: Sequence[Mapping[str, Any]], *, within: float) -> Figure:
    """Error of the place of each loss over its true place, a colour a level of noise; crosses were not reported."""
    figure, ax = new_figure(width=8.5, height=4.4)
    levels = sorted({row["level_db"] for row in rows}, reverse=True)
    for level, colour in zip(levels, COLOURS, strict=False):
        here = [row for row in rows if row["level_db"] == level]
        for kind, marker in (("beam", "o"), ("bar", "s")):
            own = [row for row in here if row["kind"] == kind and row["found"]]
            places, errors = [row["centre"] for row in own], [max(row["error"], 1e-6) for row in own]
            ax.semilogy(places, errors, marker, color=colour, ms=5.5, mfc="none", label=f"{kind}, {level:g} dB")
        missed = [row for row in here if not row["found"]]
        ax.semilogy([row["centre"] for row in missed], [row["error"] for row in missed], "x", color=colour)
    ax.axhline(within, color=GREY, ls="--")
    ax.text(0.01, within * 1.15, f"{100 * within:g} % of the length", color=GREY, va="bottom")
    ax.set_ylim(1e-6, 1.0)
    ax.set_xlim(0.0, 1.0)
    ax.set_xlabel("where the stiffness is lost, x / length")
    ax.set_ylabel("error of the place / length")
    figure.legend(loc="outside upper right", ncols=len(levels))
    return figure
