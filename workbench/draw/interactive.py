"""A figure as plain numbers, from which a page draws an interactive one."""

import base64
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cbook import GrouperView
from matplotlib.collections import LineCollection, PathCollection, PolyCollection, QuadMesh
from matplotlib.colors import to_hex, to_rgba
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle
from matplotlib.text import Annotation, Text
from matplotlib.ticker import FixedLocator, LogLocator, MaxNLocator, NullLocator
from numpy.typing import ArrayLike

from workbench.arrays import Floats
from workbench.draw.style import MOST_POINTS, envelope
from workbench.structure.printed import all_rounded

MOST_CELLS = (160, 320)
DASHES = {"-": "", "--": "6 4", ":": "2 3", "-.": "7 3 2 3"}
POINTS = 4.0 / 3.0  # CSS pixels in a point
BARE = {"None", "none", "", " "}


class Undescribed(TypeError):
    """A figure with an artist that has no plain description."""


def drawable(figure: Figure) -> dict[str, Any]:
    """The description of a figure as {"figure"}, or {"picture"} (PNG in base64) if it has none."""
    try:
        return {"figure": described(figure)}
    except Undescribed:
        buffer = BytesIO()
        figure.savefig(buffer, format="png")
        return {"picture": base64.b64encode(buffer.getvalue()).decode()}


def described(figure: Figure) -> dict[str, Any]:
    """The panels of a figure and the marks in each, as lists, numbers and texts.

    Raises:
        Undescribed: an artist has no plain description.
    """
    figure.draw_without_rendering()
    axes = [ax for ax in figure.axes if ax.get_visible() and not hasattr(ax, "_colorbar")]
    width, height = figure.get_size_inches() * 96
    positions = [ax.get_subplotspec() for ax in axes]
    return {
        "columns": max((position.get_gridspec().ncols for position in positions if position is not None), default=1),
        "width": round(width),
        "panels": [_panel(ax, axes, height) for ax in axes],
        "legend": bool(figure.legends),
    }


def _panel(ax: Axes, axes: list[Axes], height: float) -> dict[str, Any]:
    equal = ax.get_aspect() == 1.0
    return {
        **({"equal": True} if equal else {}),  # lengths along both axes to one scale
        "title": _text(ax.get_title("left") or ax.get_title()),
        "height": round(ax.get_position().height * height),
        "x": _axis(ax, ax.xaxis, ax.get_shared_x_axes(), axes),
        "y": _axis(ax, ax.yaxis, ax.get_shared_y_axes(), axes),
        "legend": ax.get_legend() is not None,
        **({"square": True} if ax.images and equal else {}),
        "marks": [mark for artist in _artists(ax) for mark in _described(ax, artist)],
    }


def _axis(ax: Axes, axis: Axis, shared: "GrouperView[Axes]", axes: list[Axes]) -> dict[str, Any]:
    if axis.get_scale() not in ("linear", "log"):
        raise Undescribed(f"an axis with scale {axis.get_scale()!r}")
    found = {
        "label": _text(axis.get_label().get_text()),
        "limits": [float(v) for v in axis.get_view_interval()],
        "log": axis.get_scale() == "log",
        "group": min(axes.index(other) for other in shared.get_siblings(ax) if other in axes),
    }
    if not isinstance(axis.get_major_locator(), MaxNLocator | LogLocator):
        if not isinstance(axis.get_major_locator(), FixedLocator | NullLocator) and not axis.have_units():
            raise Undescribed(f"ticks by {type(axis.get_major_locator()).__name__}")
        names = [label.get_text() for label in axis.get_ticklabels()]
        found["ticks"] = [[float(at), _text(name)] for at, name in zip(axis.get_ticklocs(), names)]
    return found


def _artists(ax: Axes) -> list[Artist | BarContainer]:
    bars = [c for c in ax.containers if isinstance(c, BarContainer) and c.patches]
    of_bars = {id(patch) for c in bars for patch in c.patches}
    alone = [a for a in (*ax.collections, *ax.images, *ax.patches, *ax.lines, *ax.texts) if a.get_visible()]
    marks: list[Artist | BarContainer] = [*bars, *(a for a in alone if id(a) not in of_bars)]
    return sorted(marks, key=lambda mark: (mark.patches[0] if isinstance(mark, BarContainer) else mark).get_zorder())


def _described(ax: Axes, artist: Artist | BarContainer) -> list[dict[str, Any]]:
    if isinstance(artist, BarContainer):
        boxes = [_box(ax, patch) for patch in artist.patches]
        colours = [to_hex(patch.get_facecolor()) for patch in artist.patches]
        return [{"kind": "bars", "boxes": boxes, "colours": colours, "label": _label(artist)}]
    for kind, describe in KINDS.items():
        if isinstance(artist, kind):
            return describe(ax, artist)
    raise Undescribed(f"a {type(artist).__name__}")


def _line(ax: Axes, line: Line2D) -> list[dict[str, Any]]:
    style = {"colour": to_hex(line.get_color()), "label": _label(line), "alpha": _alpha(line)}
    style |= {"width": round(line.get_linewidth() * POINTS, 2), "dash": DASHES.get(str(line.get_linestyle()), "")}
    for transform, axis, values in (
        (ax.get_xaxis_transform(), "x", line.get_xdata()),
        (ax.get_yaxis_transform(), "y", line.get_ydata()),
    ):
        if line.get_transform() is transform:
            return [{"kind": "rule", "axis": axis, "at": float(np.atleast_1d(values)[0]), **style}]
    if line.get_transform() is not ax.transData:
        raise Undescribed("a line that is not in the axes' coordinates")
    x, y = np.asarray(line.get_xdata(orig=False), float), np.asarray(line.get_ydata(orig=False), float)
    if x.size == 0:
        return []
    if line.get_linestyle() in BARE:
        style["width"] = 0
    marker = str(line.get_marker())
    if marker not in BARE:
        style |= {"marker": marker, "size": round(line.get_markersize() * POINTS * (0.5 if marker == "." else 1.0), 2)}
        fill = line.get_markerfacecolor()
        style |= {"hollow": isinstance(fill, str) and fill in BARE}
    return [{"kind": "line", **_thinned(x, y), **style}]


def _thinned(x: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """At most MOST_POINTS points of a line: for rising x, the minimum and maximum of each segment."""
    if x.size > MOST_POINTS:
        keep = envelope(y) if (np.diff(x) >= 0).all() else np.arange(0, x.size, -(-x.size // MOST_POINTS))
        x, y = x[keep], y[keep]
    return {"x": all_rounded(x), "y": all_rounded(y)}


def _box(ax: Axes, patch: Rectangle) -> list[float | None]:
    x0, y0 = patch.get_xy()
    x1, y1 = x0 + patch.get_width(), y0 + patch.get_height()
    if patch.get_data_transform() == ax.get_xaxis_transform():
        return [*all_rounded([x0, x1]), None, None]
    if patch.get_data_transform() == ax.get_yaxis_transform():
        return [None, None, *all_rounded([y0, y1])]
    return [*all_rounded([x0, x1, y0, y1])]


def _rectangle(ax: Axes, patch: Rectangle) -> list[dict[str, Any]]:
    face = to_rgba(patch.get_facecolor())
    look: dict[str, Any] = {"colours": [to_hex(face)], "alpha": float(face[3])}
    if face[3] == 0:
        look = {"colours": ["none"], "edge": to_hex(patch.get_edgecolor())}
    return [{"kind": "bars", "boxes": [_box(ax, patch)], "label": _label(patch), **look}]


def _points(ax: Axes, points: PathCollection) -> list[dict[str, Any]]:
    x, y = np.asarray(np.ma.filled(points.get_offsets(), np.nan), float).T
    faces = np.atleast_2d(points.get_facecolor())
    colours = [to_hex(c) for c in (faces if len(faces) else np.atleast_2d(points.get_edgecolor()))]
    look = {"colour": colours[0], **({"colours": colours} if len(colours) > 1 else {}), "alpha": _alpha(points)}
    look |= {"width": 0, "marker": "o", "size": round(float(np.sqrt(np.mean(points.get_sizes()))) * POINTS, 2)}
    return [{"kind": "line", "x": all_rounded(x), "y": all_rounded(y), "label": _label(points), **look}]


def _areas(ax: Axes, artist: PolyCollection | Polygon) -> list[dict[str, Any]]:
    faces = np.atleast_2d(artist.get_facecolor())
    if len(faces) == 0:
        raise Undescribed("areas without a colour")
    paths = [artist.get_xy()] if isinstance(artist, Polygon) else [path.vertices for path in artist.get_paths()]
    look = {"colour": to_hex(faces[0]), "alpha": float(faces[0][3]), "label": _label(artist)}
    return [{"kind": "area", **dict(zip("xy", map(all_rounded, np.asarray(path).T))), **look} for path in paths]


def _segments(ax: Axes, lines: LineCollection) -> list[dict[str, Any]]:
    gap = np.full((1, 2), np.nan)
    x, y = np.concatenate([part for segment in lines.get_segments() for part in (np.asarray(segment), gap)]).T
    look = {"colour": to_hex(np.atleast_2d(lines.get_color())[0]), "dash": "", "alpha": _alpha(lines)}
    look |= {"width": round(float(np.mean(lines.get_linewidth())) * POINTS, 2)}
    return [{"kind": "line", "x": all_rounded(x), "y": all_rounded(y), "label": _label(lines), **look}]


def _mesh(ax: Axes, mesh: QuadMesh) -> list[dict[str, Any]]:
    corners = np.asarray(mesh.get_coordinates(), float)
    x, y = corners[0, :, 0], corners[:, 0, 1]
    if not (np.allclose(corners[..., 0], x) and np.allclose(corners[..., 1].T, y)):
        raise Undescribed("a mesh that is not a rectangular grid")
    values = np.ma.filled(np.ma.asarray(mesh.get_array()).astype(float), np.nan)
    return [_field(mesh, values.reshape(values.shape[-2:]), (x[0], x[-1]), (y[0], y[-1]))]


def _image(ax: Axes, image: AxesImage) -> list[dict[str, Any]]:
    values = np.ma.filled(np.ma.asarray(image.get_array()).astype(float), np.nan)
    if values.ndim != 2:
        raise Undescribed("a colour image")
    left, right, bottom, top = image.get_extent()
    return [_field(image, values if image.origin == "lower" else values[::-1], (left, right), (bottom, top))]


def _field(artist: QuadMesh | AxesImage, values: Floats, x: ArrayLike, y: ArrayLike) -> dict[str, Any]:
    """Values over a grid in 255 steps of the colour map; 255 means not finite."""
    every = [max(1, -(-n // most)) for n, most in zip(values.shape, MOST_CELLS)]
    values = values[:: every[0], :: every[1]]
    low, high = (float(v) for v in artist.get_clim())
    shares = np.clip((values - low) / ((high - low) or 1.0), 0.0, 1.0)
    steps = np.where(np.isfinite(values), np.round(254 * np.nan_to_num(shares)), 255).astype(np.uint8)
    bar = artist.colorbar
    return {
        "kind": "field",
        "x": all_rounded(x),
        "y": all_rounded(y),
        "shape": list(steps.shape),
        "values": base64.b64encode(steps.tobytes()).decode(),
        "limits": [low, high],
        "colours": [to_hex(c) for c in artist.cmap(np.linspace(0.0, 1.0, 33))],
        "label": _text(bar.ax.get_ylabel() or bar.ax.get_xlabel()) if bar else "",
    }


def _words(ax: Axes, text: Text) -> list[dict[str, Any]]:
    if not text.get_text().strip():
        return []
    shift, at = (0.0, 0.0), text.get_position()
    transform: Any = text.get_transform()
    if isinstance(text, Annotation):
        at = text.xy
        if text.anncoords == "offset points":
            shift, transform = text.get_position(), text.xycoords
        elif text.anncoords != "data":
            raise Undescribed("an annotation that is not placed relative to its point")
    x, y = float(ax.convert_xunits(at[0])), float(ax.convert_yunits(at[1]))
    if transform in ("axes fraction", ax.transAxes):
        frame = "axes"
    elif transform in ("data", ax.transData) or isinstance(text, Annotation):
        frame = "data"
    else:
        raise Undescribed("a text that is not in the axes' coordinates")
    return [{"kind": "text", "x": x, "y": y, "frame": frame, "text": _text(text.get_text()),
             "shift": [shift[0] * POINTS, -shift[1] * POINTS], "colour": to_hex(text.get_color()),
             "across": text.get_horizontalalignment(), "up": text.get_verticalalignment(),
             "size": round(float(text.get_fontsize()) * POINTS, 1)}]  # fmt: skip


KINDS: dict[type, Callable[[Axes, Any], list[dict[str, Any]]]] = {
    Line2D: _line,
    Rectangle: _rectangle,
    Polygon: _areas,
    PathCollection: _points,
    LineCollection: _segments,
    PolyCollection: _areas,
    QuadMesh: _mesh,
    AxesImage: _image,
    Text: _words,
}


def _alpha(artist: Artist) -> float:
    alpha = artist.get_alpha()
    return 1.0 if alpha is None else float(alpha)


def _label(artist: Artist | BarContainer) -> str:
    label = str(artist.get_label() or "")
    return "" if label.startswith("_") else _text(label)


def _text(text: str) -> str:
    return text.replace("$", "").replace("\\mathdefault", "").strip()
