"""Figures of a sensor placement: positions, and the contribution of each mode to the error of the modal filter."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator

from workbench.design.placement.sensor_placement import SensorPlacement
from workbench.draw.motion import frame_net
from workbench.draw.style import COLOURS, GREY, new_figure, plain_ticks
from workbench.draw.surface import draw_moved, draw_nodal_lines
from workbench.structure.domain import NamedPoints, Rectangle
from workbench.structure.printed import counted

SHOWN_ERROR = 1e-5  # least error that is drawn, over the largest error of a mode
FEW = 1e2  # ratio of largest to least error below which the axis has ticks at 2 and 5 too
N_PLACES = 401
BELOW: Any = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.14)}
OTHERS = tuple(colour for i, colour in enumerate(COLOURS) if i not in (1, 4))  # without those of sensors and spillover
SENSOR: Any = {
    "color": "none",
    "marker": "o",
    "markerfacecolor": COLOURS[1],
    "markeredgecolor": "black",
    "markersize": 10,
    "zorder": 3,
    "clip_on": False,
}


def plot_sensor_placement(placement: SensorPlacement) -> Figure:
    """Sensors on the structure, and the error of the filter's modal coordinates by mode.

    A member is drawn with the shapes of the controlled modes, a plate with the nodal lines of the lowest residual mode,
    and named points displaced in that mode. Points without positions are not drawn.
    """
    domain = placement.modes.domain
    if isinstance(domain, NamedPoints) and domain.positions is None:
        figure, right = new_figure(width=7, height=4.2)
    else:
        figure, (left, right) = new_figure(1, 2, width=11, height=4.2)
        if isinstance(domain, NamedPoints):
            _at_points(left, placement)
        elif isinstance(domain, Rectangle):
            draw_nodal_lines(left, placement.modes, _lowest_residual(placement)[0])
            left.plot(*placement.positions.T, **SENSOR)
            left.set(xticks=(0.0, domain.length[0]), yticks=(0.0, domain.length[1]), xlabel="x [m]", ylabel="y [m]")
            left.set_title(f"nodal lines of {_lowest_residual(placement)[1]}", fontsize=10)
            _legend(left, Line2D([], [], color="black", linewidth=1.4, label="nodal line: at rest"))
        else:
            _along(left, placement)
    _errors(right, placement)
    even = f", at even places {100 * placement.even_error:.2g} %" if np.isfinite(placement.even_error) else ""
    found = f"error of the modal coordinates {100 * placement.error:.2g} %"
    figure.suptitle(f"{counted(len(placement.positions), 'sensor')} placed: {found}{even}", x=0.01, ha="left")
    return plain_ticks(figure)


def _lowest_residual(placement: SensorPlacement) -> tuple[int, str]:
    """The index and title of the lowest residual mode, or of the last mode if all are controlled."""
    modes = placement.modes
    left = [r for r in range(modes.n_modes) if r not in placement.controlled]
    shown = left[0] if left else modes.n_modes - 1
    return shown, f"mode {shown + 1}, {modes.frequencies_hz[shown]:.3g} Hz" + ", the lowest residual mode" * bool(left)


def _along(ax: Axes, placement: SensorPlacement) -> None:
    modes = placement.modes
    x = np.linspace(0.0, modes.length, N_PLACES)
    shapes = modes.phi(x)
    for i, r in enumerate(placement.controlled):
        ax.plot(x, shapes[:, r] / np.abs(shapes[:, r]).max(), color=OTHERS[i % len(OTHERS)], label=f"mode {r + 1}")
    ax.axhline(0.0, color=GREY, linewidth=2.5)
    ax.plot(placement.positions, np.zeros(len(placement.positions)), **SENSOR)
    ax.set(xlabel="x [m]", ylabel="mode shape over its largest value [-]", xlim=(0.0, modes.length))
    ax.set_title("sensors and the controlled modes", fontsize=10)
    _legend(ax, *ax.get_lines()[: len(placement.controlled)])


def _at_points(ax: Axes, placement: SensorPlacement) -> None:
    shown, called = _lowest_residual(placement)
    net = frame_net(placement.modes.domain)
    draw_moved(ax, net, net.moves(placement.modes)[:, :, shown])
    names: dict[tuple[float, ...], list[str]] = {}
    for name in placement.places:
        names.setdefault(tuple(net.at(name)), []).append(str(name))
    for at, here in names.items():
        ax.plot(*at, **SENSOR)
        ax.annotate(", ".join(here), (at[0], at[1]), (-9, 5), textcoords="offset points", ha="right")
    ax.set_title(f"moved in {called}", fontsize=10)
    states = (GREY, "at rest"), (COLOURS[0], "moved")
    _legend(ax, *(Line2D([], [], color=colour, marker="o", label=state) for colour, state in states))


def _legend(ax: Axes, *handles: Line2D) -> None:
    handles = (Line2D([], [], **SENSOR, label="sensor"), *handles)
    ax.legend(handles=handles, fontsize=9, ncols=3, **BELOW)


def _errors(ax: Axes, placement: SensorPlacement) -> None:
    errors = 100.0 * np.sqrt(placement.by_mode)
    controlled = np.isin(np.arange(errors.size), placement.controlled)
    for which, colour, label in (
        (controlled, COLOURS[0], "controlled: estimation error"),
        (~controlled, COLOURS[4], "residual: observation spillover"),
    ):
        ax.bar(1 + np.flatnonzero(which), errors[which], color=colour, label=label)
    most = max(errors.max(), 1e-12)
    ax.set(yscale="log", ylim=(max(SHOWN_ERROR * most, 0.3 * errors.min()), 3.0 * most))
    ax.set(xlabel="mode", ylabel="error of the modal coordinates [%]")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if most < FEW * errors.min() else (1.0,)))
    ax.set_title("error that each mode adds", fontsize=10)
    ax.legend(fontsize=9, ncols=2, columnspacing=1.0, **BELOW)
