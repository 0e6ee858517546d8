"""Figures of what the command wrote as JSON."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from workbench.draw.style import COLOURS, GREY, new_figure


def plot_poles(poles: Mapping[str, np.ndarray]) -> Figure:
    """Closed-loop poles (complex, rad/s) of each law, the upper half plane."""
    figure, ax = new_figure(width=9, height=4.5)
    ax.axvline(0.0, color=GREY, linewidth=0.8)
    for (name, values), colour, marker in zip(poles.items(), COLOURS, "ox+s^v."):
        upper = values[values.imag >= 0]
        ax.plot(upper.real, upper.imag, marker, color=colour, label=name, linestyle="none")
    ax.set(xlabel="real part [rad/s]", ylabel="imaginary part [rad/s]", title="closed-loop poles")
    ax.legend()
    return figure


def plot_deviations(names: Sequence[str], values: Sequence[float], deviations: Sequence[float], label: str) -> Figure:
    """Figures, each with a bar of two standard deviations either way."""
    figure, ax = new_figure(width=9, height=3.5)
    at = np.arange(len(values))
    ax.vlines(at, np.subtract(values, 2 * np.asarray(deviations)), np.add(values, 2 * np.asarray(deviations)),
              color=COLOURS[1], label="± 2 standard deviations")  # fmt: skip
    ax.plot(at, values, "o", color=COLOURS[0], label="found")
    ax.set_xticks(at, list(names))
    ax.set(ylabel=label)
    ax.legend()
    return figure
