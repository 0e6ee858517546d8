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
        label = f"{name}: stable on {verification.share_stable:.0%}"
        left.semilogy(time, middle, color=colour, linewidth=1.2, label=label)
    left.axhline(SETTLED, color=GREY, linewidth=0.8)
    left.annotate("settling threshold", (time[-1], SETTLED), (0, 3), textcoords="offset points", fontsize=8, ha="right")
    left.set(xlabel=f"time [{result.units.time}]", ylabel="modal energy / peak energy [-]", ylim=(1e-6, 3.0))
    left.set_title(f"{result.verification.n_draws} draws of the uncertain model: median and 95 % interval")
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
    """The loss after each step, relative to ideal actuators and sensors."""
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
    """Two rows per sensor: readings over time and amplitudes of their Fourier transform; both less the prediction.

    The lower row shows the band about zero, which may be far narrower than the readings. A measured record is drawn on
    top, around the reading farthest outside its band.
    """
    shown = min(len(prediction.channels), MOST_SENSORS)
    figure, axes = new_figure(2 * shown, 2, width=11, height=1.2 + 3.2 * shown, sharex="col", squeeze=False)
    rows = {} if measured is None else {c.name: row for c, row in zip(measured.output_channels, measured.outputs)}
    piece = _around_worst(prediction, rows)
    time, f = prediction.time[piece], prediction.frequencies_hz[1:]
    band = {"color": BAND, "alpha": 0.3, "linewidth": 0, "label": f"{100 * LEVEL:g} % band"}
    line, test = {"color": BAND, "linewidth": 0.9, "label": "predicted"}, {"color": TEST, "linewidth": 0.9}
    for j, channel in enumerate(prediction.channels[:shown]):
        reading = rows.get(channel.name)
        readings = [y[j, piece] for y in (prediction.median, prediction.lower, prediction.upper)]
        spectra = prediction.spectrum_median, prediction.spectrum_lower, prediction.spectrum_upper
        sizes = [spectrum[j, 1:] for spectrum in spectra]
        least = 1e-3 * sizes[2][sizes[2] > 0].min() if (sizes[2] > 0).any() else 1e-300
        seen = (None, None) if reading is None else (reading[piece], amplitudes(reading[None])[0, 1:])
        columns = (time, readings, seen[0], -np.inf, channel.name), (f, sizes, seen[1], least, f"|{channel.name}|")
        difference = f"{100 * LEVEL:g} % band about the prediction" if reading is None else "measured − predicted"
        for (ax, below), (x, (middle, low, high), found, floor, name) in zip(axes[2 * j : 2 * j + 2].T, columns):
            ax.fill_between(x, np.maximum(low, floor), np.maximum(high, floor), **band)
            ax.plot(x, np.maximum(middle, floor), **line)
            below.fill_between(x, low - middle, high - middle, **band)
            if found is not None:
                ax.plot(x, np.maximum(found, floor), label="measured", **test)
                below.plot(x, found - middle, label="measured", **test)
            ax.set_ylabel(in_units(name, channel.unit))
            below.axhline(0.0, color=BAND, linewidth=0.9)
            below.set(ylabel=in_units("difference", channel.unit), title=f"{name}: {difference}")
        axes[2 * j, 1].set(xscale="log", yscale="log")
    whole = time.size == prediction.time.size
    axes[0, 0].set_title("readings over time" if whole else "readings near the one farthest outside its band")
    axes[0, 1].set_title("amplitude spectrum of the whole record")
    axes[-1, 0].set_xlabel(f"time [{prediction.units.time}]")
    axes[-1, 1].set_xlabel(f"frequency [{prediction.units.named('Hz')}]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3, fontsize=8)
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
