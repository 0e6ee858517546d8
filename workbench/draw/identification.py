"""Figures of identification: modal estimates with their standard errors, and errors of methods beside the bound."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from workbench.arrays import Flags
from workbench.draw.style import COLOURS, GREY, few_ticks, new_figure
from workbench.identification.free_decay.ibrahim import STABILITY, Stabilisation
from workbench.identification.shapes.bands import Bands
from workbench.identification.signal.modal_estimates import RefinedModes
from workbench.structure.modes import Modes, SampledModes, mac

MOST_NUMBERED = 12  # modes of a MAC matrix whose values are written in its cells


def stabilisation_diagram(diagram: Stabilisation, stayed: SampledModes, band_hz: float) -> Figure:
    """Frequencies at each order: dots are poles of modes that stay, in frequency and shape; crosses are others."""
    figure, ax = new_figure(width=9, height=4.5)
    for line, frequency in enumerate(stayed.frequencies_hz):
        ax.axvline(frequency, color=COLOURS[1], alpha=0.5, lw=5, label=None if line else "stable mode")
    points = [
        (hertz, order, stable)
        for order, modes in zip(diagram.orders, diagram.found, strict=True)
        for hertz, stable in zip(modes.frequencies_hz, _stays(modes, stayed), strict=True)
        if hertz < band_hz
    ]
    hertz, orders, stable = np.array(points).reshape(-1, 3).T
    for kind, look in ((stable == 0.0, {"marker": "x", "color": GREY, "label": "pole that is not stable"}),
                       (stable == 1.0, {"marker": "o", "color": COLOURS[0], "label": "stable pole"})):  # fmt: skip
        if kind.any():
            ax.plot(hertz[kind], orders[kind], lw=0, ms=5, zorder=3, **look)
    ax.set(xlabel="frequency [Hz]", ylabel="model order (modes)")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(loc="outside upper right", ncols=3)
    return figure


def _stays(modes: SampledModes, stayed: SampledModes) -> Flags:
    """Which modes agree in frequency and shape with one that stays, and decay, (n_modes,)."""
    if not stayed.n_modes:
        return np.zeros(modes.n_modes, bool)
    near = np.abs(modes.omega[:, None] / stayed.omega - 1.0) <= STABILITY.frequency_tolerance
    alike = mac(modes.shapes, stayed.shapes) >= STABILITY.min_mac
    return np.asarray((near & alike).any(axis=1) & (modes.zeta > 0.0) & (modes.zeta < STABILITY.max_damping))


def plot_standard_errors(refined: RefinedModes) -> Figure:
    """Relative standard errors of the frequency and damping ratio of each mode."""
    figure, axes = new_figure(2, 1, width=9, height=5, sharex=True)
    modes = np.arange(1, refined.modes.n_modes + 1)
    axes[0].semilogy(modes, refined.omega_std / refined.modes.omega, "o-")
    axes[1].semilogy(modes, refined.zeta_std / np.maximum(np.abs(refined.modes.zeta), 1e-300), "o-")
    for ax, title in zip(axes, ("frequency", "damping ratio")):
        ax.set(title=title, ylabel="relative standard error [-]")
    axes[1].set(xlabel="mode", xticks=few_ticks(modes))
    return figure


def plot_deviations(names: Sequence[str], values: ArrayLike, deviations: ArrayLike, label: str) -> Figure:
    """Estimates with bars of ± 2 standard errors."""
    figure, ax = new_figure(width=9, height=3.5)
    at, spread = np.arange(len(names)), 2.0 * np.asarray(deviations)
    ax.vlines(at, np.subtract(values, spread), np.add(values, spread), color=COLOURS[1], label="± 2 standard errors")
    ax.plot(at, values, "o", color=COLOURS[0], label="estimate")
    ax.set_xticks(at, list(names))
    ax.set(ylabel=label)
    ax.legend()
    return figure


def plot_mac(values: np.ndarray) -> Figure:
    """A MAC matrix (n_modes, n_modes), values from 0 to 1, written in the cells where they are those of few modes."""
    side = max(4.8, 0.55 * min(len(values), MOST_NUMBERED))
    figure, ax = new_figure(width=side + 0.7, height=side)
    modes = np.arange(1, len(values) + 1)
    image = ax.imshow(values, cmap="Blues", vmin=0.0, vmax=1.0, origin="lower")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_ticks(modes - 1, [str(mode) for mode in modes])
    ax.set(xlabel="mode", ylabel="mode", title="modal assurance criterion")
    ax.grid(False)
    figure.colorbar(image, ax=ax, label="MAC")
    size = 8 if len(values) <= 8 else 6.5
    for (i, j), value in np.ndenumerate(values) if len(values) <= MOST_NUMBERED else ():
        colour = "#ffffff" if value > 0.5 else "#1a1a1a"  # on the cell, whatever the page
        ax.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=size, color=colour)
    return figure


def plot_bands(bands: Bands, exact: Modes | None = None, positions: Sequence[float] = ()) -> Figure:
    """Each eigenfunction with its confidence band; below, the band and, if `exact` is given, the error of the curve."""
    n, shared = bands.phi.shape[1], {"sharex": True, "squeeze": False, "height_ratios": (2, 3)}
    figure, axes = new_figure(2, n, width=max(5.0, 3.2 * n), height=4.8, **shared)
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
            ax.text(0.99, row - 0.38, f"{missed} missed, {false} spurious{time}", **look, **place)
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
