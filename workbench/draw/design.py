"""Figures of control design: motion, work by mode, poles, spillover paths."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from workbench.design.loop.closed_loop import Response
from workbench.design.placement.controlled_modes import ControlledModeCount
from workbench.design.spillover.explain import Explanation
from workbench.design.spillover.spillover import Spillover
from workbench.draw.style import COLOURS, GREY, MOST_TICKS, few_ticks, grouped_bars, new_figure, prefixed
from workbench.records.units import SI, Units

SHOWN_SHARE = 1e-5
MOST_INSTANTS = 700  # drawn over time, about the number of pixel columns


def plot_motion(responses: Mapping[str, Response], x: np.ndarray) -> Figure:
    """Displacement over place and time as colour, one panel per response, with a common scale."""
    figure, axes = new_figure(len(responses), 1, width=9, height=2.1 * len(responses), sharex=True, squeeze=False)
    steps = [-(-response.time.size // MOST_INSTANTS) for response in responses.values()]
    fields = [response.displacement(x)[:, ::step] for response, step in zip(responses.values(), steps)]
    limit = max(np.abs(field).max() for field in fields)
    look = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit, "shading": "gouraud", "rasterized": True}
    for ax, (name, response), field, step in zip(axes[:, 0], responses.items(), fields, steps, strict=True):
        image = ax.pcolormesh(response.time[::step], x, field, **look)
        ax.set(ylabel="x [m]", title=name)
        ax.grid(False)
    axes[-1, 0].set_xlabel("time [s]")
    figure.colorbar(image, ax=axes[:, 0], label="displacement [m]")
    return figure


def plot_work_linear(works: Mapping[str, np.ndarray], *, first: int, units: Units = SI) -> Figure:
    """Work in each residual mode on a linear scale, a group of bars per mode.

    Args:
        works: (n_residual,) J, by the name of the design.
        first: zero-based index of the first residual mode.
    """
    figure, ax = new_figure(width=9, height=4)
    shifts, width = grouped_bars(len(works))
    factor, unit = prefixed(max(float(work.max(initial=0.0)) for work in works.values()), units.named("J"))
    for shift, (name, work) in zip(shifts, works.items(), strict=True):
        numbers = first + 1 + np.arange(work.size)
        ax.bar(numbers + shift, factor * work, width, label=f"{name}: W_R = {factor * work.sum():.3g} {unit}")
    ax.set(xticks=few_ticks(numbers), xlabel="residual mode", ylabel=f"spillover work in the mode, W_r [{unit}]")
    ax.set_title("spillover work by residual mode")
    ax.legend()
    return figure


def plot_work(spillovers: dict[str, Spillover]) -> Figure:
    """Work in each residual mode, one colour of bars per design, on a logarithmic scale; negative if energy is lost."""
    first = next(iter(spillovers.values()))
    if not first.residual_modes:
        return _without_residual_modes()
    figure, ax = new_figure(1, 1, width=9, height=4)
    modes = np.array(first.residual_modes) + 1
    shifts, width = grouped_bars(len(spillovers))
    total = max(float(np.abs(work.residual_work_by_mode).sum()) for work in spillovers.values()) or 1.0
    least, lowest = SHOWN_SHARE * total, min(float(work.residual_work_by_mode.min()) for work in spillovers.values())
    signed = lowest <= -least  # a residual mode in motion may lose energy
    for shift, (name, work) in zip(shifts, spillovers.items(), strict=True):
        at, small = modes + shift, np.abs(work.residual_work_by_mode) < least
        values = np.where(small, 0.0 if signed else 0.1 * least, work.residual_work_by_mode)
        bars = ax.bar(at, values, width, label=f"{name}: W_R = {work.residual_work:.3g} J")
        for x in at[small] if modes.size <= MOST_TICKS else ():
            ax.text(x, 1.3 * least, "≈ 0", ha="center", color=bars.patches[0].get_facecolor())
    if signed:
        ax.set_yscale("symlog", linthresh=10.0 ** np.ceil(np.log10(least)))
        ax.axhline(0.0, color=GREY, linewidth=0.8)
    else:
        ax.set_yscale("log")
    ax.set(xlabel="residual mode", ylabel="spillover work W_r [J]", xticks=few_ticks(modes))
    # room above the bars for the legend
    ax.set_ylim(3.0 * lowest if signed else least, 10.0 ** (1.0 + 0.35 * len(spillovers)) * total)
    ax.set_title("control spillover: work of the actuators on each residual mode")
    ax.legend(loc="upper right")
    return figure


def _without_residual_modes() -> Figure:
    figure, ax = new_figure(width=9, height=1.5)
    ax.axis("off")
    ax.text(0.5, 0.5, "every mode is controlled: no mode is residual, and there is no spillover", ha="center")
    return figure


def plot_poles(poles: Mapping[str, np.ndarray]) -> Figure:
    """Closed-loop poles (complex, rad/s) of each law in the upper half plane."""
    figure, ax = new_figure(width=9, height=4.5)
    ax.axvline(0.0, color=GREY, linewidth=0.8)
    for i, ((name, values), colour, marker) in enumerate(zip(poles.items(), COLOURS, "ox+s^vD")):
        upper = values[values.imag >= 0]
        # hollow, and each smaller than the one before: equal poles of several laws are all seen
        look = {"color": colour, "linestyle": "none", "fillstyle": "none", "markersize": 11.0 - 1.1 * i}
        ax.plot(upper.real, upper.imag, marker, label=name, **look)
    ax.set(xlabel="real part [rad/s]", ylabel="imaginary part [rad/s]", title="closed-loop poles")
    ax.legend()
    return figure


def plot_spillover_paths(explained: Explanation) -> Figure:
    """Growth of each residual mode in the full closed loop, and the share of each path from sensor to actuator."""
    if not explained.shifts:
        return _without_residual_modes()
    figure, axes = new_figure(1, 2, width=11, height=4.5, width_ratios=[1, 1.2])
    by_mode = sorted(explained.shifts, key=lambda shift: shift.mode)
    numbers, growth = [shift.mode + 1 for shift in by_mode], [shift.closed_pole.real for shift in by_mode]
    axes[0].bar(numbers, growth, color=[COLOURS[1] if g > 0 else COLOURS[0] for g in growth])
    before = [shift.pole.real for shift in by_mode]
    axes[0].plot(numbers, before, "_", color=COLOURS[6], markersize=16, mew=2, label="uncontrolled")
    axes[0].axhline(0.0, color=GREY, linewidth=0.8)
    axes[0].set(xlabel="residual mode", ylabel="growth rate Re λ [1/s]", xticks=few_ticks(numbers))
    axes[0].set_title("real part of residual poles (above 0: unstable)")
    axes[0].legend()
    worst = explained.shifts[0]
    labels = [*(p.text for p in worst.paths), "all paths"]
    shifts = np.array([p.shift.real for p in worst.paths] + [worst.shift.real])
    rows = np.arange(len(labels))[::-1]
    axes[1].barh(rows, shifts, color=[COLOURS[1] if s > 0 else COLOURS[0] for s in shifts])
    axes[1].axvline(0.0, color=GREY, linewidth=0.8)
    axes[1].set_yticks(rows, labels)
    axes[1].set(xlabel="contribution to Re λ [1/s]", title=f"which path shifts mode {worst.mode + 1}")
    return figure


def plot_controlled_mode_count(found: dict[str, ControlledModeCount], share: float | None = None) -> Figure:
    """Remaining energy of each disturbance with n controlled modes: in the residual modes, and by spillover."""
    figure, axes = new_figure(1, len(found), width=11, height=4.5, sharey=True, squeeze=False)
    for ax, (name, result) in zip(axes[0], found.items(), strict=True):
        uncontrolled, spilled = result.uncontrolled / result.energy.sum(), result.spillover / result.energy.sum()
        ax.bar(result.counts, uncontrolled, color=COLOURS[0], label="in residual modes")
        ax.bar(result.counts, spilled, bottom=uncontrolled, color=COLOURS[1], label="spillover")
        if share is not None:
            ax.axhline(share, color=GREY, linestyle="--", label=f"{share:.0%} limit")
        if result.recommended:
            label = f"recommended: {result.recommended} modes"
            ax.axvline(result.recommended, color=COLOURS[2], linewidth=6, alpha=0.35, label=label)
        ax.set(xlabel="controlled modes, n", xticks=result.counts, title=name)
        ax.legend()
    axes[0, 0].set_ylabel("remaining share of the disturbance's energy [-]")
    return figure
