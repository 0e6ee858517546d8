"""Figures of an uncertain rig: predicted responses, and controllers on its draws."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from workbench.arrays import Floats
from workbench.draw.style import COLOURS, GREY, in_units, new_figure, plain_ticks
from workbench.records.record import Record
from workbench.robust.prediction import Prediction, amplitudes
from workbench.robust.redesign import Redesign
from workbench.robust.steps import LOSS
from workbench.robust.verification import LEVEL, SETTLED, interval

OLD, NEW = COLOURS[1], COLOURS[0]
MOST_SENSORS = 8
STRETCH = 400  # samples drawn over time; more would fill a solid area
BAND, TEST = COLOURS[0], COLOURS[1]


def plot_redesign(result: Redesign) -> Figure:
    """Energy over the test with its 95 % band over the draws, and the damping of each controlled mode."""
    figure, (left, right) = new_figure(1, 2, width=10, height=4.2, width_ratios=(2, 1))
    time = result.test.time
    both = (("present", result.present_verification, OLD), ("redesigned", result.verification, NEW))
    # after an impulse both start at the same energy; a diverging one is clipped at the top
    top = min(float(p.energy[0].max()) for _, p, _ in both)
    for name, verification, colour in both:
        middle, low, high = np.clip(verification.energy / max(top, 1e-300), 1e-9, 1e3)
        left.fill_between(time, low, high, color=colour, alpha=0.25, linewidth=0)
        left.semilogy(
            time, middle, color=colour, linewidth=1.2, label=f"{name}: stable on {verification.share_stable:.0%}"
        )
    left.axhline(SETTLED, color=GREY, linewidth=0.8)
    left.annotate("settling threshold", (time[-1], SETTLED), (0, 3), textcoords="offset points", fontsize=8, ha="right")
    left.set(xlabel=f"time [{result.units.time}]", ylabel="modal energy over its peak", ylim=(1e-6, 3.0))
    left.set_title(f"{result.verification.n_draws} samples of the uncertain model: median and 95 % interval")
    left.legend(fontsize=8)
    rows = np.arange(len(result.controlled))
    for shift, (name, verification, colour) in zip((-0.12, 0.12), both, strict=True):
        ratios = 100.0 * np.array([interval(verification.damping[:, r]) for r in result.controlled])
        right.plot(ratios[:, 0], rows + shift, "o", color=colour, label=name)
        for y, (_, low, high) in zip(rows + shift, ratios, strict=True):
            right.plot([low, high], [y, y], color=colour, linewidth=2)
    right.axvline(0.0, color=GREY, linewidth=0.8)
    right.set_yticks(rows, [f"mode {r + 1}" for r in result.controlled])
    right.set(xlabel="closed-loop damping ratio [%]", ylim=(len(rows) - 0.5, -0.5), title="median and 95 % interval")
    right.legend(fontsize=8)
    return figure


def plot_steps(result: Redesign) -> Figure:
    """The loss after each step, relative to perfect actuators and sensors."""
    figure, ax = new_figure(width=9, height=1.2 + 0.45 * len(result.steps))
    names = [step.name + ("" if step.kept else " (left out)") for step in result.steps]
    most = max((s.loss for s in result.steps if not s.diverges), default=1.0)
    losses = [100.0 * min(step.loss, 3.0 * max(most, 0.1)) for step in result.steps]
    colours = [OLD if step.name == "present" else NEW if step.kept else GREY for step in result.steps]
    ax.barh(range(len(names)), losses, color=colours)
    for i, step in enumerate(result.steps):
        ax.annotate(step.lost, (losses[i], i), (4, 0), textcoords="offset points", va="center", fontsize=8)
    ax.set_yticks(range(len(names)), names)
    ax.set(ylim=(len(names) - 0.5, -0.5), xlim=(0, 1.25 * max(*losses, 1e-6)))
    ax.set_xlabel(f"{LOSS} [%]")
    return figure


def plot_prediction(prediction: Prediction, measured: Record | None = None) -> Figure:
    """A row per sensor: readings over time on the left, amplitudes of their Fourier transform on the right.

    Args:
        prediction: with its bands.
        measured: the record of the test, drawn beneath the bands, around the reading farthest outside.
    """
    shown = min(len(prediction.channels), MOST_SENSORS)
    figure, axes = new_figure(shown, 2, width=11, height=0.9 + 1.9 * shown, sharex="col", squeeze=False)
    rows = {} if measured is None else {c.name: row for c, row in zip(measured.output_channels, measured.outputs)}
    piece = _around_worst(prediction, rows)
    time = prediction.time[piece]
    f = prediction.frequencies_hz[1:]
    for j, (left, right) in enumerate(axes):
        channel = prediction.channels[j]
        band = {"color": BAND, "alpha": 0.3, "linewidth": 0, "label": f"{100 * LEVEL:g} % band"}
        left.fill_between(time, prediction.lower[j, piece], prediction.upper[j, piece], **band)
        left.plot(time, prediction.median[j, piece], color=BAND, linewidth=0.8, label="predicted")
        left.set_ylabel(in_units(channel.name, channel.unit))
        low, high = prediction.spectrum_lower[j, 1:], prediction.spectrum_upper[j, 1:]
        right.set_ylabel(in_units(f"|{channel.name}|", channel.unit))
        least = 1e-3 * high[high > 0].min() if (high > 0).any() else 1e-300
        right.fill_between(f, np.maximum(low, least), np.maximum(high, least), **band)
        right.loglog(f, np.maximum(prediction.spectrum_median[j, 1:], least), color=BAND, linewidth=0.8)
        if channel.name in rows:
            test = {"color": TEST, "linewidth": 0.8, "zorder": 0.5}  # beneath the band
            left.plot(time, rows[channel.name][piece], label="measured", **test)
            right.loglog(f, np.maximum(amplitudes(rows[channel.name][None])[0, 1:], least), **test)
    axes[0, 0].set_title("outputs")
    axes[0, 1].set_title("amplitude spectrum")
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("frequency [Hz]")
    axes[0, 0].legend(fontsize=8, ncols=3)
    return plain_ticks(figure)


def _around_worst(prediction: Prediction, rows: Mapping[str, Floats]) -> slice:
    """The samples around the reading farthest outside its band, over the band's width; all samples without readings."""
    worst = np.full(prediction.time.size, -np.inf)
    for channel, low, high in zip(prediction.channels, prediction.lower, prediction.upper):
        if channel.name in rows:
            y = rows[channel.name]
            worst = np.maximum(worst, np.maximum(low - y, y - high) / max(float(np.mean(high - low)), 1e-300))
    if not rows or worst.size <= STRETCH:
        return slice(None)
    first = int(np.clip(worst.argmax() - STRETCH // 2, 0, worst.size - STRETCH))
    return slice(first, first + STRETCH)
