"""Pictures of how accurate an identification is: errors beside the bound, peers beside one another."""

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
    """Worst-mode errors of every method on every structure, a panel a level; scores as `identification_peers`."""
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
    figure.legend(handles=handles, loc="outside upper left", ncols=4)
    return figure


def plot_bands(bands: Bands, exact: Modes | None = None, positions: Sequence[float] = ()) -> Figure:
    """Each eigenfunction with its confidence band; below, the band about the curve and, where known, the error."""
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


def size_and_errors(rows: Sequence[Mapping[str, Any]], errors: np.ndarray) -> Figure:
    """What a record costs to identify by its length, and errors (2, n_modes) of ω and ζ of the longest over the bound.

    Args:
        rows: with samples, processor_seconds, seconds, found, count, as `identification_size`.
        errors: in standard errors of the Cramér-Rao bound.
    """
    figure, (left, right) = new_figure(1, 2, width=10.5, height=4.2)
    samples = np.array([row["samples"] for row in rows])
    spent = np.array([row["processor_seconds"] for row in rows])
    left.loglog(samples, spent, "o-", label="processor time, both cores together")
    left.loglog(samples, spent[-1] * samples / samples[-1], "--", color=GREY, label="in proportion to the samples")
    left.axhline(30.0, color=COLOURS[1], lw=1.2)
    left.annotate("limit at full size: 30 s", (samples[0], 30.0), (0, 4), textcoords="offset points", color=COLOURS[1])
    for row in rows:
        text, at = f"{row['found']} of {row['count']} modes", (row["samples"], row["processor_seconds"])
        left.annotate(text, at, (-4, 7), textcoords="offset points", ha="right", fontsize=8.5)
    left.set_xticks(samples, [f"{n:,}" for n in samples])
    left.set_yticks([1, 3, 10, 30], ["1", "3", "10", "30"])
    left.minorticks_off()
    left.set(xlim=(0.3 * samples.min(), 1.4 * samples.max()), ylim=(0.25 * spent.min(), 60.0))
    left.set(xlabel=f"samples of {rows[-1]['sensors']} sensors", ylabel="time to identify [s]")
    left.legend(loc="lower right")
    edges, x = np.linspace(-4.0, 4.0, 17), np.linspace(-4.0, 4.0, 201)
    right.hist(errors.T, edges, density=True, label=("frequency", "damping"), color=COLOURS[:2], alpha=0.8)
    normal = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    right.plot(x, normal, color=GREY, lw=3, alpha=0.7, label="a method that attains the bound")
    right.set(xlabel="error of a mode / Cramér-Rao standard deviation [-]", ylabel="density")
    right.set_ylim(top=1.35 * right.get_ylim()[1])  # room for the legend
    right.legend(loc="upper left")
    return figure


def records_errors(errors: Mapping[str, np.ndarray], summary: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Errors of every figure by the kind of record, beside those of a method that attains the bound.

    Args:
        errors: by kind (n_figures,), in standard errors of the bound.
        summary: by kind, with over_bound and inside, as `identification_records`.
    """
    figure, ax = new_figure(1, 1, width=10.5, height=5.4)
    rng, x = np.random.default_rng(0), np.linspace(-4.0, 4.0, 201)
    bell = 0.36 * np.exp(-0.5 * x**2)
    for row, (kind, apart) in enumerate(errors.items()):
        totals, spread = summary[kind], np.clip(apart, -4.0, 4.0)
        ax.fill_between(x, row - bell, row + bell, color=GREY, alpha=0.25, lw=0)
        at = row + rng.uniform(-0.3, 0.3, spread.size) * np.exp(-0.5 * spread**2)
        ax.plot(spread, at, "o", ms=3, color=COLOURS[0], alpha=0.6, mew=0)
        least = "bound" if totals["bound"] == "Cramér-Rao" else "estimated error"
        text = (
            f"rms error / {least} = {totals['over_bound']:.2f}\n{100 * totals['inside']:.0f} % in their 95 % intervals"
        )
        ax.text(4.15, row, text, va="center", fontsize=8.5)
    ax.set_yticks(range(len(errors)), list(errors))
    ax.set(ylim=(len(errors) - 0.5, -0.5), xlim=(-4.0, 6.2))
    ax.set_xticks(range(-4, 5, 2))
    ax.set_xlabel(
        "error of a frequency or damping ratio / standard error (Cramér-Rao bound; of unknown forces, estimated)"
    )
    handles = [
        Line2D([], [], marker="o", lw=0, color=COLOURS[0], ms=4, label="one estimate"),
        Line2D([], [], color=GREY, alpha=0.4, lw=8, label="what a method that attains the bound would show"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=2)
    return figure
