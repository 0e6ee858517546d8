"""Figures of the accuracy of identification: errors of several methods beside the bound, confidence bands."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.identification.shapes.bands import Bands
from workbench.structure.modes import Modes


def peers_errors(
    every: Mapping[float, Mapping[str, Sequence[Mapping[str, Any]]]], efficient: Mapping[float, float]
) -> Figure:
    """Worst-mode errors of every method on every structure, one panel per noise level.

    Args:
        every: level -> method -> scores of the study `identification_peers`.
        efficient: level -> median of an efficient method.
    """
    figure, axes = new_figure(1, len(every), width=12.5, height=5.2, sharex=True, sharey=True)
    rng = np.random.default_rng(0)
    for ax, (level, by_name) in zip(np.atleast_1d(axes), every.items()):
        ours = sum(s["seconds"] for s in next(iter(by_name.values())))
        for row, scores in enumerate(by_name.values()):
            worst = np.array([s["worst"] for s in scores])
            whole = np.array([not s["missed"] for s in scores])
            at = row + rng.uniform(-0.18, 0.18, worst.size)
            colour = COLOURS[row % len(COLOURS)]
            shown = worst > 0
            for kind, face in ((whole, colour), (~whole, "none")):
                dots = kind & shown
                ax.plot(worst[dots], at[dots], "o", ms=4.5, mfc=face, mec=colour, alpha=0.75, lw=0)
            middle = float(np.median(np.where(whole, worst, np.inf)))
            if np.isfinite(middle):
                ax.plot([middle, middle], [row - 0.22, row + 0.3], color="black", lw=2.2)
            missed, false = (sum(s[what] for s in scores) for what in ("missed", "false"))
            ratio = sum(s["seconds"] for s in scores) / ours
            time = "" if row == 0 else f", {ratio:.2g} × time of this package"
            look = {"fontsize": 8.5, "color": GREY if missed + false == 0 else "black"}
            place = {"ha": "right", "va": "center", "transform": ax.get_yaxis_transform()}
            ax.text(0.99, row - 0.38, f"{missed} missed, {false} false{time}", **look, **place)
        ax.axvline(efficient[level], color=GREY, lw=3, alpha=0.5, zorder=0)
        ax.set(xscale="log", xlabel="error of the worst mode\n/ Cramér-Rao standard deviation [-]")
        ax.set_title(f"signal-to-noise ratio {level} dB")
        ax.set_yticks(range(len(by_name)), list(by_name))
        ax.set_ylim(len(by_name) - 0.5, -0.6)
    handles = [
        Line2D([], [], marker="o", lw=0, color=GREY, label="a structure, all its modes found"),
        Line2D([], [], marker="o", lw=0, color=GREY, mfc="none", label="one with modes missed"),
        Line2D([], [], color="black", lw=2.2, label="median (a missed mode counts as infinite error)"),
        Line2D([], [], color=GREY, lw=3, alpha=0.5, label="median of a method that attains the bound"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=2)
    return figure


def plot_bands(bands: Bands, exact: Modes | None = None, positions: Sequence[float] = ()) -> Figure:
    """Each eigenfunction with its confidence band; below, the band and, if `exact` is given, the error of the curve."""
    n = bands.phi.shape[1]
    figure, axes = new_figure(
        2, n, width=max(5.0, 3.2 * n), height=4.8, sharex=True, squeeze=False, height_ratios=(2, 3)
    )
    low, high = bands.whole
    for r in range(n):
        top, bottom = axes[:, r]
        top.plot(bands.x, bands.phi[:, r], color=COLOURS[0])
        top.set_title(f"mode {r + 1}")
        for edges, alpha, label in (
            ((low[:, r], high[:, r]), 0.25, f"simultaneous {bands.level:.0%} band"),
            (tuple(edge[:, r] for edge in bands.pointwise), 0.35, f"pointwise {bands.level:.0%} band"),
        ):
            bottom.fill_between(
                bands.x, edges[0] - bands.phi[:, r], edges[1] - bands.phi[:, r], color=COLOURS[0], alpha=alpha, lw=0,
                label=label,
            )  # fmt: skip
        if exact is not None:
            truth = exact.phi(bands.x)[:, r]
            sign = np.sign(truth @ bands.phi[:, r])
            bottom.plot(bands.x, sign * truth - bands.phi[:, r], color=COLOURS[1], label="exact")
        if len(positions):
            bottom.plot(positions, np.zeros(len(positions)), "|", color=GREY, ms=9, label="sensors")
        bottom.set_xlabel("x [m]")
    axes[0, 0].set_ylabel("identified φ [1/√kg]")
    axes[1, 0].set_ylabel("deviation from it [1/√kg]")
    figure.legend(*axes[1, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return figure
