"""Figures of plates, membranes and frames: shapes with their nodal lines, and motion at some instants."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch as Swatch
from matplotlib.ticker import MaxNLocator

from workbench.design.loop.closed_loop import Response
from workbench.draw.motion import SWAY, Wireframe, frame_wireframe, sensor_wireframe
from workbench.draw.style import COLOURS, GREY, new_figure, panels, prefixed
from workbench.identification.shapes.bands import Bands
from workbench.renamed import former_arguments
from workbench.structure.domain import Rectangle
from workbench.structure.modes import Modes, SampledModes

PER_SIDE = 121  # grid points of a drawn shape along the longer side
LEVELS = 12  # of colour on each side of zero
COLUMNS = 4
HELD = 1e-6  # of a shape's largest value: an edge with less is held
RED, BLUE = "#b2182b", "#2166ac"  # ends of the colour map, up and down
DOT: Any = {"color": "none", "marker": "o", "markeredgecolor": "black", "markerfacecolor": "none", "markersize": 7}


def plot_surface_modes(
    modes: Modes, *, count: int | None = None, places: np.ndarray | None = None, values: np.ndarray | None = None
) -> Figure:
    """Shapes over a rectangle, a panel per mode: red up, blue down, nodal lines black, held edges thick.

    Args:
        count: number of modes, lowest first; all unless given.
        places: (n_places, 2) of sensors, m, drawn as circles.
        values: (n_places, n_modes) identified at the sensors, the fill colours of the circles.
    """
    count = min(count or modes.n_modes, modes.n_modes)
    x, y, fields = _over(modes, np.eye(modes.n_modes)[:, :count])
    columns = min(COLUMNS, count)
    row_height = 2.7 * min(y[-1] / x[-1], 1.6) + 0.45
    figure, axes = panels(count, columns, width=2.7 * columns, row_height=row_height, margin=0.9)
    for r, ax in enumerate(axes):
        _bare(ax, modes)
        limit = np.abs(fields[r]).max()
        _coloured(ax, x, y, fields[r], limit)
        _nodal_lines(ax, x, y, fields[r], 1.2)
        if places is not None and values is not None:
            dots: Any = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit, "edgecolors": "black"}
            ax.scatter(places[:, 0], places[:, 1], s=46, c=values[:, r], linewidths=0.9, **dots)
        elif places is not None:
            ax.plot(*places.T, **DOT)
        for along in _held_edges(x, y, fields):
            ax.plot(*along, color=COLOURS[6], linewidth=4, solid_capstyle="butt", clip_on=False)
        ax.set_title(f"mode {r + 1}: {modes.frequencies_hz[r]:.4g} Hz", fontsize=10)
    ticks = {"xticks": (0.0, x[-1]), "yticks": (0.0, y[-1])}
    axes[columns * ((count - 1) // columns)].set(**ticks, xlabel="x [m]", ylabel="y [m]")
    handles: list[Artist] = [Swatch(facecolor=RED, label="up"), Swatch(facecolor=BLUE, label="down")]
    handles.append(Line2D([], [], color="black", linewidth=1.2, label="nodal line: at rest"))
    if _held_edges(x, y, fields):
        handles.append(Line2D([], [], color=COLOURS[6], linewidth=4, label="supported edge"))
    if places is not None:
        label = "sensor" if values is None else "sensor (fill: identified value)"
        handles.append(Line2D([], [], **DOT, label=label))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9)
    return figure


def plot_surface_bands(bands: Bands) -> Figure:
    """Each eigenfunction over a rectangle; below, its standard error relative to its largest value.

    Raises:
        ValueError: all places are on one line.
    """
    x, y = bands.x.T
    if np.linalg.matrix_rank(np.column_stack([x - x.mean(), y - y.mean()])) < 2:
        raise ValueError("bands over a rectangle need places that are not all on one line: give a grid")
    n = bands.phi.shape[1]
    height = 2 * (2.5 * min(np.ptp(y) / np.ptp(x), 1.6) + 0.8)
    figure, grid = new_figure(2, n, width=max(4.0, 2.9 * n), height=height, squeeze=False)
    for r, (top, bottom) in enumerate(grid.T):
        largest = np.abs(bands.phi[:, r]).max()
        top.tricontourf(x, y, bands.phi[:, r], levels=largest * np.linspace(-1.0, 1.0, 2 * LEVELS + 1), cmap="RdBu_r")
        top.set_title(f"mode {r + 1}", fontsize=10)
        share = bottom.tricontourf(x, y, 100.0 * bands.std[:, r] / largest, levels=LEVELS, cmap="Purples")
        figure.colorbar(share, ax=bottom, location="bottom", shrink=0.9, ticks=MaxNLocator(4))
        for ax in (top, bottom):
            ax.set(aspect="equal", xticks=[], yticks=[])
    grid[0, 0].set_ylabel("identified φ(x, y)\n[1/√kg]")
    grid[1, 0].set_ylabel("standard error\n[% of the largest]")
    return figure


@former_arguments(struck="impulse_at")
def plot_surface_motion(
    responses: Mapping[str, Response],
    times: Sequence[float],
    *,
    actuators: np.ndarray | None = None,
    impulse_at: tuple[float, float] | None = None,
) -> Figure:
    """Displacement of a plate at some instants, one row per response, with a common colour scale.

    Args:
        times: s; the nearest instants of each response are drawn.
        actuators: (n_actuators, 2) places, m, marked by crosses.
        impulse_at: place of the impulse, m, marked by a star.
    """
    first, (rows, columns) = next(iter(responses.values())), (len(responses), len(times))
    figure, grid = new_figure(rows, columns, width=2.6 * columns, height=2.1 * rows + 0.3, squeeze=False)
    drawn = []
    for response in responses.values():
        nearest = [int(np.argmin(np.abs(response.time - t))) for t in times]
        modal = response.modal[: response.modes.n_modes, nearest]
        drawn.append((response.time[nearest], *_over(response.modes, modal)))
    limit = max(float(np.abs(fields).max()) for *_, fields in drawn) or 1.0  # 1 if all are at rest
    factor, unit = prefixed(limit, "m")
    limit *= factor
    for row, name, (instants, x, y, fields) in zip(grid, responses, drawn):
        for ax, time, field in zip(row, instants, fields):
            image = _coloured(ax, x, y, factor * field, limit)
            if actuators is not None:
                ax.plot(*actuators.T, "x", color="black", markersize=6, label="actuator")
            if impulse_at is not None:
                ax.plot(*impulse_at, "*", color=COLOURS[4], markeredgecolor="black", markersize=11, label="impulse")
            ax.set_title(f"{time:.3g} s" if time == 0 or time >= 0.1 else f"{1000.0 * time:.3g} ms", fontsize=10)
        row[0].set_ylabel(name, fontsize=11)
    for ax in grid.flat:
        _bare(ax, first.modes)
    grid[-1, 0].set(xticks=[0.0, x[-1]], yticks=[0.0, y[-1]], xlabel="x [m]")
    # between the numbers of its axis, whose label is the name of the response
    look: Any = {"rotation": 90, "ha": "right", "va": "center", "transform": grid[-1, 0].transAxes}
    grid[-1, 0].text(-0.04, 0.5, "y [m]", **look)
    ticks = [tick for tick in MaxNLocator(5).tick_values(-limit, limit) if abs(tick) <= limit]
    figure.colorbar(image, ax=grid, label=f"displacement [{unit}]", shrink=0.8, ticks=ticks)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=9)
    return figure


def plot_point_modes(modes: Modes, *, count: int | None = None) -> Figure:
    """Shapes at named points, a panel per mode: the structure at rest grey, displaced blue, neighbouring nodes joined.

    A plane structure is seen from the front, any other in an oblique view: x to the right, z up, y away. Of `count`
    modes, the lowest; all unless given.

    Raises:
        ValueError: modes of another domain, or points without positions.
    """
    return _wireframe_panels(frame_wireframe(modes.domain), modes, min(count or modes.n_modes, modes.n_modes))


def plot_scattered_modes(modes: SampledModes, *, count: int) -> Figure:
    """Shapes at sensors on a plate, a panel per mode, at the phase of largest motion."""
    phase = np.exp(-0.5j * np.angle(np.sum(modes.shapes**2, axis=0)))
    at_phase = replace(modes, shapes=modes.shapes * phase)
    return _wireframe_panels(sensor_wireframe(modes.positions), at_phase, min(count, modes.n_modes))


def _wireframe_panels(wireframe: Wireframe, modes: Modes | SampledModes, count: int) -> Figure:
    moves = wireframe.moves(modes).real
    figure, axes = panels(count, COLUMNS, width=2.8 * min(COLUMNS, count), row_height=2.8, margin=0.4)
    for r, ax in enumerate(axes):
        draw_moved(ax, wireframe, moves[:, :, r])
        ax.set_title(f"mode {r + 1}: {modes.frequencies_hz[r]:.4g} Hz", fontsize=10)
    figure.legend(handles=rest_and_moved(), loc="outside lower center", ncols=2, fontsize=9)
    return figure


def rest_and_moved() -> list[Line2D]:
    """Legend handles of a wireframe at rest and displaced."""
    states = (GREY, "at rest"), (COLOURS[0], "moved")
    return [Line2D([], [], color=colour, marker="o", label=state) for colour, state in states]


def draw_nodal_lines(ax: Axes, modes: Modes, mode: int) -> None:
    """Draw a plate from above, with the shape of one mode (an index) in grey and its nodal lines in black."""
    x, y, fields = _over(modes, np.eye(modes.n_modes)[:, mode : mode + 1])
    ax.contourf(x, y, fields[0].T, levels=2 * LEVELS, cmap="Greys", alpha=0.35)
    _nodal_lines(ax, x, y, fields[0], 1.4)
    _bare(ax, modes)


def draw_moved(ax: Axes, wireframe: Wireframe, moves: np.ndarray) -> None:
    """Draw a wireframe at rest in grey, and displaced by `moves` (n_nodes, 2), scaled to be visible, in blue."""
    far = SWAY * np.ptp(wireframe.rest, axis=0).max() / (np.abs(moves).max() or 1.0)
    for at, colour in ((wireframe.rest, GREY), (wireframe.rest + far * moves, COLOURS[0])):
        for ends in wireframe.lines:
            ax.plot(*at[ends].T, color=colour, linewidth=1.6)
        ax.plot(*at.T, "o", color=colour, markersize=3)
    ax.set_aspect("equal")
    ax.axis("off")


def _nodal_lines(ax: Axes, x: np.ndarray, y: np.ndarray, field: np.ndarray, width: float) -> None:
    """Draw the zero lines of a field, without held edges, along which it is zero but for rounding."""
    nothing = HELD * np.abs(field).max()
    i, j = (
        slice(int(np.abs(first).max() < nothing), -1 if np.abs(last).max() < nothing else None)
        for first, last in ((field[0], field[-1]), (field[:, 0], field[:, -1]))
    )
    ax.contour(x[i], y[j], field[i, j].T, levels=[0.0], colors="black", linewidths=width)


def _held_edges(x: np.ndarray, y: np.ndarray, fields: np.ndarray) -> list[tuple[tuple[float, ...], tuple[float, ...]]]:
    """The edges along which all fields are zero, each by its ends: (x, x), (y, y)."""
    nothing, (a, b) = HELD * np.abs(fields).max(), (x[-1], y[-1])
    along = fields[:, 0], fields[:, -1], fields[:, :, 0], fields[:, :, -1]
    edges = ((0.0, 0.0), (0.0, b)), ((a, a), (0.0, b)), ((0.0, a), (0.0, 0.0)), ((0.0, a), (b, b))
    return [ends for values, ends in zip(along, edges) if np.abs(values).max() < nothing]


def _over(modes: Modes, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates x, y and fields (n_columns, n_x, n_y) of modal coordinates (n_modes, n_columns)."""
    if not isinstance(modes.domain, Rectangle):
        raise ValueError("surface plots need modes of a rectangle; these have another domain")
    sides = modes.domain.length
    x, y = (np.linspace(0.0, side, max(round(PER_SIDE * side / max(sides)), 16)) for side in sides)
    places = np.column_stack([np.repeat(x, y.size), np.tile(y, x.size)])
    fields = (modes.phi(places) @ columns).T.reshape(-1, x.size, y.size)
    return x, y, fields


def _coloured(ax: Axes, x: np.ndarray, y: np.ndarray, field: np.ndarray, limit: float) -> QuadContourSet:
    levels = limit * np.linspace(-1.0, 1.0, 2 * LEVELS + 1)
    return ax.contourf(x, y, field.T, levels=levels, cmap="RdBu_r", extend="both")


def _bare(ax: Axes, modes: Modes) -> None:
    """Axes of equal scale, with the edges of the plate as frame."""
    assert isinstance(modes.domain, Rectangle)
    a, b = modes.domain.length
    ax.set(aspect="equal", xlim=(0.0, a), ylim=(0.0, b), xticks=[], yticks=[])
    ax.grid(False)
    for spine in ax.spines.values():
        spine.set_visible(True)
