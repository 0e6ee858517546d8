"""Figures of identification: modal estimates with their standard errors, and errors of methods beside the bound."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from workbench.draw.style import COLOURS, GREY, few_ticks, new_figure
from workbench.identification.free_decay.ibrahim import Stabilisation
from workbench.identification.shapes.bands import Bands
from workbench.identification.signal.modal_estimates import Refined
from workbench.structure.modes import Modes, SampledModes

# from complex to real shapes; both ends are visible on white and on black
REAL = LinearSegmentedColormap.from_list("real", ["#8f979f", COLOURS[0]])


def stabilisation_diagram(diagram: Stabilisation, stayed: SampledModes, band_hz: float) -> Figure:
    """Frequencies at each order; blue dots have real shapes (phase collinearity near 1), grey ones complex shapes."""
    figure, ax = new_figure(width=9, height=4.5)
    look: Any = {"cmap": REAL, "vmin": 0, "vmax": 1, "s": 22, "edgecolors": GREY, "linewidths": 0.4, "zorder": 3}
    for line, frequency in enumerate(stayed.frequencies_hz):
        ax.axvline(frequency, color=COLOURS[1], alpha=0.5, lw=5, label=None if line else "stable")
    for order, modes in zip(diagram.orders, diagram.found, strict=True):
        keep = modes.frequencies_hz < band_hz
        at, collinearity = np.full(keep.sum(), order), modes.phase_collinearity[keep]
        dots = ax.scatter(modes.frequencies_hz[keep], at, c=collinearity, **look)
    figure.colorbar(dots, ax=ax, label="phase collinearity of the shape")
    ax.set(xlabel="frequency [Hz]", ylabel="model order (modes)")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    if stayed.n_modes:
        figure.legend(loc="outside upper right")
    return figure


def plot_standard_errors(refined: Refined) -> Figure:
    """Relative standard errors of the frequency and damping ratio of each mode."""
    figure, axes = new_figure(2, 1, width=9, height=5, sharex=True)
    modes = np.arange(1, refined.modes.n_modes + 1)
    relative = (
        refined.omega_std / refined.modes.omega,
        refined.zeta_std / np.maximum(np.abs(refined.modes.zeta), 1e-300),
    )
    for ax, values, title in zip(axes, relative, ("frequency", "damping ratio")):
        ax.semilogy(modes, values, "o-")
        ax.set(title=title, ylabel="relative standard error")
    axes[1].set(xlabel="mode", xticks=few_ticks(modes))
    return figure


def plot_deviations(names: Sequence[str], values: Sequence[float], deviations: Sequence[float], label: str) -> Figure:
    """Estimates with bars of ± 2 standard errors."""
    figure, ax = new_figure(width=9, height=3.5)
    at, spread = np.arange(len(values)), 2 * np.asarray(deviations)
    ax.vlines(at, np.subtract(values, spread), np.add(values, spread), color=COLOURS[1], label="± 2 standard errors")
    ax.plot(at, values, "o", color=COLOURS[0], label="estimate")
    ax.set_xticks(at, list(names))
    ax.set(ylabel=label)
    ax.legend()
    return figure


def plot_mac(values: np.ndarray) -> Figure:
    """A MAC matrix (n_modes, n_modes), with values from 0 to 1."""
    figure, ax = new_figure(width=5.5, height=4.8)
    modes = np.arange(1, len(values) + 1)
    image = ax.imshow(values, cmap="Blues", vmin=0.0, vmax=1.0, origin="lower")
    ax.set_xticks(modes - 1, [str(mode) for mode in modes])
    ax.set_yticks(modes - 1, [str(mode) for mode in modes])
    ax.set(xlabel="mode", ylabel="mode", title="modal assurance criterion")
    ax.grid(False)
    figure.colorbar(image, ax=ax, label="MAC")
    return figure


def plot_bands(bands: Bands, exact: Modes | None = None, positions: Sequence[float] = ()) -> Figure:
    """Each eigenfunction with its confidence band; below, the band and, if `exact` is given, the error of the curve."""
    n = bands.phi.shape[1]
    figure, axes = new_figure(
        2, n, width=max(5.0, 3.2 * n), height=4.8, sharex=True, squeeze=False, height_ratios=(2, 3)
    )
    for r, (top, bottom) in enumerate(axes.T):
        phi = bands.phi[:, r]
        top.plot(bands.x, phi, color=COLOURS[0])
        top.set_title(f"mode {r + 1}")
        for (low, high), alpha, kind in ((bands.whole, 0.25, "simultaneous"), (bands.pointwise, 0.35, "pointwise")):
            look = {"color": COLOURS[0], "alpha": alpha, "lw": 0, "label": f"{kind} {bands.level:.0%} band"}
            bottom.fill_between(bands.x, low[:, r] - phi, high[:, r] - phi, **look)
        if exact is not None:
            truth = exact.phi(bands.x)[:, r]
            bottom.plot(bands.x, np.sign(truth @ phi) * truth - phi, color=COLOURS[1], label="exact")
        if len(positions):
            bottom.plot(positions, np.zeros(len(positions)), "|", color=GREY, ms=9, label="sensors")
        bottom.set_xlabel("x [m]")
    axes[0, 0].set_ylabel("identified φ [1/√kg]")
    axes[1, 0].set_ylabel("deviation from it [1/√kg]")
    figure.legend(*axes[1, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return figure


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
