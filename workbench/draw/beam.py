"""Figures of the whole way: what was measured, what was found, what control then does."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from workbench.design.loop.closed_loop import Response
from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.records.record import Record
from workbench.structure.modes import Modes

MOST_INSTANTS = 700  # more than a picture has columns for


def plot_ring_down(record: Record, *, stretch: float) -> Figure:
    """Every output over time, one above the other, each at its place; the first `stretch` seconds."""
    shown = record.between(record.start_time, record.start_time + stretch)
    figure, ax = new_figure(width=9, height=4.5)
    size = 1.1 * np.abs(shown.outputs).max()
    for j, channel in enumerate(shown.output_channels):
        ax.axhline(j, color=GREY, linewidth=0.4)
        ax.plot(shown.time, j + 0.5 * shown.outputs[j] / size, color=COLOURS[0], linewidth=0.9)
        place = channel.name if channel.at is None else f"x = {channel.at:.3g}"
        ax.text(shown.time[-1], j, f"  {place}", va="center")
    ax.set(xlabel="time [s]", yticks=[], xlim=(shown.time[0], shown.time[-1]))
    ax.set_title("measured ring-down, one line a sensor")
    return figure


def plot_identified(found: Modes, truth: Modes, positions: np.ndarray, *, count: int) -> Figure:
    """Identified eigenfunctions over the true ones, with their values at the sensors."""
    figure, axes = new_figure(-(-count // 3), 3, width=10, height=4.6, sharex=True, sharey=True, squeeze=False)
    x = np.linspace(0.0, truth.length, 301)
    for r, ax in zip(range(count), axes.flat, strict=False):
        sign = np.sign(found.phi(x)[:, r] @ truth.phi(x)[:, r])
        ax.plot(x, truth.phi(x)[:, r], color=GREY, linewidth=4, alpha=0.5, label="true")
        ax.plot(x, sign * found.phi(x)[:, r], color=COLOURS[0], label="identified")
        at_sensors = sign * found.phi(positions)[:, r]
        ax.plot(positions, at_sensors, "o", color=COLOURS[1], markersize=4, label="at the sensors")
        ax.set_title(f"mode {r + 1}: {found.frequencies_hz[r]:.4f} Hz, ζ = {100 * found.zeta[r]:.2f} %", fontsize=10)
    for ax in axes[-1]:
        ax.set_xlabel("x")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def plot_two_works(works: Mapping[str, np.ndarray], *, first: int) -> Figure:
    """Work put into each residual mode, a group of bars a mode; `first` is the zero-based index of the first one."""
    figure, ax = new_figure(width=9, height=4)
    width = 0.8 / len(works)
    for i, (name, work) in enumerate(works.items()):
        numbers = first + 1 + np.arange(work.size)
        ax.bar(numbers + (i - 0.5 * (len(works) - 1)) * width, work, width, label=f"{name}: W_R = {work.sum():.2e}")
    ax.set(xticks=numbers, xlabel="residual mode", ylabel="spillover work in the mode, W_r")
    ax.set_title("spillover work by residual mode")
    ax.legend()
    return figure


def plot_motion(responses: Mapping[str, Response], x: np.ndarray) -> Figure:
    """Displacement over place and time as colour, one panel a response, all on one scale."""
    figure, axes = new_figure(len(responses), 1, width=9, height=2.1 * len(responses), sharex=True, squeeze=False)
    steps = {name: -(-response.time.size // MOST_INSTANTS) for name, response in responses.items()}
    fields = {name: response.displacement(x)[:, :: steps[name]] for name, response in responses.items()}
    limit = max(np.abs(field).max() for field in fields.values())
    for ax, (name, field) in zip(axes[:, 0], fields.items(), strict=True):
        time = responses[name].time[:: steps[name]]
        image = ax.pcolormesh(
            time, x, field, cmap="RdBu_r", vmin=-limit, vmax=limit, shading="gouraud", rasterized=True
        )
        ax.set(ylabel="x", title=name)
        ax.grid(False)
    axes[-1, 0].set_xlabel("time [s]")
    figure.colorbar(image, ax=axes[:, 0], label="displacement")
    return figure
