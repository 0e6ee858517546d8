"""Figures of results that the command wrote as JSON."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.identification.free_decay.ibrahim import Stabilisation
from workbench.structure.modes import SampledModes

# from complex to real shapes; both ends are visible on white and on black
REAL = LinearSegmentedColormap.from_list("real", ["#8f979f", COLOURS[0]])


def plot_poles(poles: Mapping[str, np.ndarray]) -> Figure:
    """Closed-loop poles (complex, rad/s) of each law in the upper half plane."""
    figure, ax = new_figure(width=9, height=4.5)
    ax.axvline(0.0, color=GREY, linewidth=0.8)
    for (name, values), colour, marker in zip(poles.items(), COLOURS, "ox+s^v."):
        upper = values[values.imag >= 0]
        ax.plot(upper.real, upper.imag, marker, color=colour, label=name, linestyle="none")
    ax.set(xlabel="real part [rad/s]", ylabel="imaginary part [rad/s]", title="closed-loop poles")
    ax.legend()
    return figure


def plot_deviations(names: Sequence[str], values: Sequence[float], deviations: Sequence[float], label: str) -> Figure:
    """Estimates with bars of ± 2 standard errors."""
    figure, ax = new_figure(width=9, height=3.5)
    at = np.arange(len(values))
    ax.vlines(at, np.subtract(values, 2 * np.asarray(deviations)), np.add(values, 2 * np.asarray(deviations)),
              color=COLOURS[1], label="± 2 standard errors")  # fmt: skip
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


def plot_places(places: Mapping[str, np.ndarray], length: float | None = None) -> Figure:
    """Places (m) of each placement along a structure."""
    figure, ax = new_figure(width=9, height=1.4 + 0.5 * len(places))
    for row, (positions, colour) in enumerate(zip(places.values(), COLOURS)):
        ax.plot(positions, np.full(len(positions), row), "^", color=colour, markersize=9)
    if length is not None:
        ax.set_xlim(-0.02 * length, 1.02 * length)
    ax.set_yticks(range(len(places)), list(places))
    ax.set(xlabel="x [m]", ylim=(len(places) - 0.5, -0.5), title="places of the actuators")
    return figure


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
