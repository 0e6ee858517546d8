"""Figures of a prediction: its bands by sensor, over time and by frequency, with the test where it was made."""

import numpy as np
from matplotlib.figure import Figure

from workbench.draw.style import COLOURS, new_figure, plain_ticks
from workbench.records.record import Record
from workbench.robust.prediction import LEVEL, Prediction, amplitudes

MOST_SENSORS = 8
BAND, TEST = COLOURS[0], COLOURS[1]


def plot_prediction(prediction: Prediction, measured: Record | None = None) -> Figure:
    """A row a sensor: readings over time on the left, amplitudes of their Fourier transform on the right.

    Args:
        prediction: with its bands.
        measured: the test, drawn over them.
    """
    shown = min(len(prediction.channels), MOST_SENSORS)
    figure, axes = new_figure(shown, 2, width=11, height=0.9 + 1.9 * shown, sharex="col", squeeze=False)
    rows = {} if measured is None else {c.name: row for c, row in zip(measured.output_channels, measured.outputs)}
    f = prediction.frequencies_hz[1:]
    for j, (left, right) in enumerate(axes):
        channel = prediction.channels[j]
        band = {"color": BAND, "alpha": 0.3, "linewidth": 0, "label": f"{100 * LEVEL:g} % band"}
        left.fill_between(prediction.time, prediction.lower[j], prediction.upper[j], **band)
        left.plot(prediction.time, prediction.median[j], color=BAND, linewidth=0.8, label="predicted")
        left.set_ylabel(channel.name + (f"\n[{channel.unit}]" if channel.unit else ""))
        low, high = prediction.spectrum_lower[j, 1:], prediction.spectrum_upper[j, 1:]
        least = 1e-3 * high[high > 0].min() if (high > 0).any() else 1e-300
        right.fill_between(f, np.maximum(low, least), np.maximum(high, least), **band)
        right.loglog(f, np.maximum(prediction.spectrum_median[j, 1:], least), color=BAND, linewidth=0.8)
        if channel.name in rows:
            left.plot(prediction.time, rows[channel.name], color=TEST, linewidth=0.8, label="measured")
            right.loglog(f, np.maximum(amplitudes(rows[channel.name][None])[0, 1:], least), color=TEST, linewidth=0.8)
    axes[0, 0].set_title("readings")
    axes[0, 1].set_title("amplitude by frequency")
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("frequency [Hz]")
    axes[0, 0].legend(fontsize=8, ncols=3)
    return plain_ticks(figure)
