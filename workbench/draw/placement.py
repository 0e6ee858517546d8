"""Figures of placements: actuators and sensors on the structure, with the contribution of each mode."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle as Bar
from matplotlib.ticker import LogLocator, MaxNLocator

from workbench.design.placement.limits import Limits
from workbench.design.placement.sensor_placement import SensorPlacement
from workbench.design.placement.task import Placement, PlacementTask, extent
from workbench.draw.motion import frame_wireframe
from workbench.draw.style import COLOURS, GREY, MOST_TICKS, few_ticks, grouped_bars, new_figure, plain_ticks
from workbench.draw.surface import draw_moved, draw_nodal_lines, rest_and_moved
from workbench.records.units import SI, Units
from workbench.renamed import former_arguments
from workbench.structure.domain import NamedPoints, Patch, Place, Rectangle, listed
from workbench.structure.printed import counted, place_text

SHOWN_SHARE = 1e-5  # least work that is drawn along a member, over the largest in one mode
SHOWN_WORK = 1e-8  # the same on a plate
SHOWN_ERROR = 1e-5  # least error that is drawn, over the largest error of a mode
FEW = 1e2  # ratio of largest to least error below which the axis has ticks at 2 and 5 too
N_PLACES = 401
CORNERS = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])  # of a rectangle, anticlockwise
BELOW: Any = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.14)}
OTHERS = tuple(colour for i, colour in enumerate(COLOURS) if i not in (1, 4))  # without those of sensors and spillover
IMPULSE: Any = {"color": COLOURS[4], "label": "impulse", "ls": "none", "marker": "*", "mec": "black", "ms": 14}
SENSOR: Any = dict(color="none", marker="o", mfc=COLOURS[1], mec="black", ms=10, zorder=3, clip_on=False)


def plot_placement(placement: Placement, *, units: Units = SI) -> Figure:
    """Spillover work in each residual mode with actuators at given places."""
    figure, ax = new_figure(width=9, height=3.5)
    numbers = len(placement.positions) + 1 + np.arange(placement.residual_work_by_mode.size)
    ax.bar(numbers, placement.residual_work_by_mode)
    where = "; ".join(place_text(place) for place in listed(placement.positions))
    where += "" if placement.positions.dtype.kind == "U" else f" {units.named('m')}"
    ax.set(xlabel="residual mode", ylabel=units.named("spillover work, W_r [J]"), xticks=few_ticks(numbers))
    work, spent = f"{placement.residual_work:.3g}", f"{placement.effort:.3g}"
    ax.set_title(f"actuators at {where}: W_R = {units.named(f'{work} J')}, effort {units.named(f'{spent} N² s')}")
    return figure


def plot_places(
    places: Mapping[str, np.ndarray],
    length: float | Sequence[float] | None = None,
    *,
    forbidden: Sequence[tuple[Place, Place]] = (),
    impulse_at: Place | None = None,
    units: Units = SI,
) -> Figure:
    """Places of each placement along a structure, (n_actuators,), or on a plate, (n_actuators, 2), to scale.

    Args:
        places: by the name of the placement, m.
        length: of the structure, or both sides of the plate, m; None leaves the outline out.
        forbidden: zones without actuators, m.
        impulse_at: place of the impulse, m, marked by a star.
    """
    zone: Any = {"facecolor": GREY, "alpha": 0.3, "linewidth": 0}
    if next(iter(places.values())).ndim == 2:
        figure, ax = new_figure(width=6, height=5)
        for i, (corner, opposite) in enumerate(np.array(forbidden, float).reshape(-1, 2, 2)):
            box = corner + 0.5 * (1.0 + CORNERS) * (opposite - corner)
            ax.fill(*box.T, **zone, label="forbidden" if i == 0 else None)
        for (name, positions), marker in zip(places.items(), "osD^v"):
            ax.plot(*positions.T, marker, label=name, markersize=9, clip_on=False, zorder=3)
        if impulse_at is not None:
            ax.plot(*np.array(impulse_at, float), **IMPULSE, zorder=3)
        if length is not None:
            outline = 0.5 * (1.0 + CORNERS[[0, 1, 2, 3, 0]]) * np.array(length)
            ax.plot(*outline.T, color=GREY, linewidth=1.0)
        ax.set(xlabel=units.named("x [m]"), ylabel=units.named("y [m]"), title="actuator positions")
        ax.set_aspect("equal")
        ax.legend(**BELOW)
        return figure
    rows = [*places, *["impulse"] * (impulse_at is not None)]
    figure, ax = new_figure(width=9, height=1.4 + 0.5 * len(rows))
    for i, (low, high) in enumerate(forbidden):
        ax.axvspan(low, high, **zone, label="forbidden" if i == 0 else None)
    for row, (positions, colour) in enumerate(zip(places.values(), COLOURS)):
        ax.plot(positions, np.full(len(positions), row), "^", color=colour, markersize=9)
    if impulse_at is not None:
        ax.plot(impulse_at, len(places), **{**IMPULSE, "label": None})
    if length is not None:
        ax.set_xlim(np.array((-0.02, 1.02)) * length)
    if forbidden:
        ax.legend(loc="upper right")
    ax.set_yticks(range(len(rows)), rows)
    ax.set(xlabel=units.named("x [m]"), ylim=(len(rows) - 0.5, -0.5), title="actuator positions")
    return figure


def plot_member_placement(
    task: PlacementTask,
    placements: Mapping[str, Placement],
    *,
    limits: Limits | None = None,
    impulse_at: float | None = None,
    units: Units = SI,
) -> Figure:
    """Actuators along a structure with mode n + 1, the lowest residual one, and the work in each residual mode.

    Args:
        placements: by name, each in its own colour and row.
        limits: forbidden zones are hatched.
        impulse_at: place of the impulse, m, marked by a star.
    """
    n, modes = task.n_controlled, task.modes
    figure, (left, right) = new_figure(1, 2, width=11, height=3.8)
    x = np.linspace(0.0, modes.length, 201)
    shape = modes.phi(x)[:, n]
    left.plot(x, shape / np.abs(shape).max(), color=GREY, label=f"mode {n + 1}, the lowest residual one")
    left.axhline(0.0, color=GREY, linewidth=0.8)
    for i, (low, high) in enumerate(limits.forbidden if limits is not None else ()):
        left.axvspan(low, high, facecolor="white", edgecolor=GREY, hatch="////", label="forbidden" if i == 0 else None)
    half = 0.5 * extent(task.actuator)
    for i, (name, placement) in enumerate(placements.items()):
        look = {"fmt": "o", "color": COLOURS[i], "markersize": 8, "label": _with_work(name, placement, units)}
        left.errorbar(placement.positions, np.full(n, -1.25 - 0.2 * i), xerr=half, **look)
    if impulse_at is not None:
        left.plot(impulse_at, 1.2, **IMPULSE)
    left.set(xlabel=units.named("x [m]"), yticks=[], title="positions of the actuators")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), fontsize=9, ncols=2)
    _draw_works(right, task, placements, units)
    return figure


@former_arguments(struck="impulse_at")
def plot_surface_placement(
    task: PlacementTask,
    placements: Mapping[str, Placement],
    *,
    limits: Limits | None = None,
    impulse_at: tuple[float, float] | None = None,
    units: Units = SI,
) -> Figure:
    """Actuators on a plate with the nodal lines of mode n + 1, and the work in each residual mode.

    Piezo patches are drawn to scale.

    Args:
        placements: by name, each in its own colour.
        limits: forbidden zones are hatched.
        impulse_at: place of the impulse, m, marked by a star.
    """
    n, modes = task.n_controlled, task.modes
    assert isinstance(modes.domain, Rectangle)
    figure, (left, right) = new_figure(1, 2, width=11, height=4.2)
    draw_nodal_lines(left, modes, n)
    for i, ((x0, y0), (x1, y1)) in enumerate(limits.forbidden if limits is not None else ()):  # type: ignore[misc, str-unpack]
        look = {"facecolor": "white", "edgecolor": GREY, "hatch": "////", "zorder": 2}
        left.fill([x0, x1, x1, x0], [y0, y0, y1, y1], **look, label="forbidden" if i == 0 else None)
    for i, (name, placement) in enumerate(placements.items()):
        look = {"color": COLOURS[i], "markersize": 10, "zorder": 3, "clip_on": False}
        left.plot(*placement.positions.T, "o", label=_with_work(name, placement, units), **look)
        if isinstance(task.actuator.at, Patch):
            half = 0.5 * np.array(task.actuator.at[2:])
            for middle in placement.positions:
                left.fill(*(middle + half * CORNERS).T, facecolor=COLOURS[i], edgecolor=COLOURS[i], alpha=0.3, zorder=2)
    if impulse_at is not None:
        left.plot(*impulse_at, **IMPULSE, zorder=3)
    (a, b), lines = modes.domain.length, f"nodal lines of mode {n + 1}, {modes.frequencies_hz[n]:.3g} Hz"
    left.set_title(f"{units.named(str(modes.domain))}\n{lines}, the lowest residual mode", fontsize=10)
    # anchored at the top, else the layout leaves no room for the title above the axes
    labels = {"xlabel": units.named("x [m]"), "ylabel": units.named("y [m]")}
    left.set(anchor="N", xticks=(0.0, a), yticks=(0.0, b), **labels)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower left", fontsize=9, ncols=4)
    _draw_works(right, task, placements, units)
    return figure


def _with_work(name: str, placement: Placement, units: Units) -> str:
    return f"{name}: W_R = {placement.residual_work:.2g} {units.named('J')}"


def _draw_works(ax: Axes, task: PlacementTask, placements: Mapping[str, Placement], units: Units) -> None:
    """Draw the work in each residual mode, a bar per placement; bars below the logarithmic axis are marked by ≈ 0."""
    numbers = np.arange(task.n_controlled, task.modes.n_modes) + 1
    shifts, width = grouped_bars(len(placements))
    for i, placement in enumerate(placements.values()):
        ax.bar(numbers + shifts[i], placement.residual_work_by_mode, width, color=COLOURS[i])
    ax.set(xlabel="residual mode", ylabel=units.named("spillover work, W_r [J]"), xticks=few_ticks(numbers))
    ax.set_yscale("log")
    work = np.concatenate([placement.residual_work_by_mode for placement in placements.values()])
    bottom = SHOWN_SHARE * work.max()
    if isinstance(task.modes.domain, Rectangle):  # a mode with all actuators at its nodes has no work but rounding
        bottom = max(SHOWN_WORK * work.max(), 0.3 * work.min())
    ax.set_ylim(bottom, 3.0 * work.max())
    for bar in ax.patches if numbers.size <= MOST_TICKS else ():
        if isinstance(bar, Bar) and bar.get_height() < bottom:
            at = (bar.get_x() + 0.5 * bar.get_width(), 1.2 * bottom)
            ax.text(*at, "≈ 0", ha="center", fontsize=8, color=bar.get_facecolor())


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
            mode, title = _lowest_residual(placement)
            draw_nodal_lines(left, placement.modes, mode)
            left.plot(*placement.positions.T, **SENSOR)
            left.set(xticks=(0.0, domain.length[0]), yticks=(0.0, domain.length[1]), xlabel="x [m]", ylabel="y [m]")
            left.set_title(f"nodal lines of {title}", fontsize=10)
            _legend(left, Line2D([], [], color="black", linewidth=1.4, label="nodal line: at rest"))
        else:
            _along(left, placement)
    _errors(right, placement)
    found = f"error of the modal coordinates {100 * placement.error:.2g} %"
    if np.isfinite(placement.evenly_spaced_error):
        found += f", evenly spaced {100 * placement.evenly_spaced_error:.2g} %"
    figure.suptitle(f"{counted(len(placement.positions), 'sensor')} placed: {found}", x=0.01, ha="left")
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
    wireframe = frame_wireframe(placement.modes.domain)
    draw_moved(ax, wireframe, wireframe.moves(placement.modes)[:, :, shown])
    names: dict[tuple[float, ...], list[str]] = {}
    for name in placement.places:
        names.setdefault(tuple(wireframe.at(name)), []).append(str(name))
    for at, here in names.items():
        ax.plot(*at, **SENSOR)
        ax.annotate(", ".join(here), (at[0], at[1]), (-9, 5), textcoords="offset points", ha="right")
    ax.set_title(f"deflected in {called}", fontsize=10)
    _legend(ax, *rest_and_moved())


def _legend(ax: Axes, *handles: Line2D) -> None:
    handles = (Line2D([], [], **SENSOR, label="sensor"), *handles)
    ax.legend(handles=handles, fontsize=9, ncols=3, **BELOW)


def _errors(ax: Axes, placement: SensorPlacement) -> None:
    errors = 100.0 * np.sqrt(placement.by_mode)
    controlled = np.isin(np.arange(errors.size), placement.controlled)
    labels = "controlled: estimation error", "residual: observation spillover"
    for which, colour, label in zip((controlled, ~controlled), (COLOURS[0], COLOURS[4]), labels):
        ax.bar(1 + np.flatnonzero(which), errors[which], color=colour, label=label)
    most = max(errors.max(), 1e-12)
    ax.set(yscale="log", ylim=(max(SHOWN_ERROR * most, 0.3 * errors.min()), 3.0 * most))
    ax.set(xlabel="mode", ylabel="error of the modal coordinates [%]")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if most < FEW * errors.min() else (1.0,)))
    ax.set_title("contribution of each mode to the error", fontsize=10)
    ax.legend(fontsize=9, ncols=2, columnspacing=1.0, **BELOW)
