"""The style of all figures: plain axes, and colours that colour-blind readers can distinguish."""

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

matplotlib.use("Agg")

# Okabe & Ito's palette, in the order of use
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
GREY = "#8a8a8a"
MODEL_COLOURS = {"nominal": COLOURS[1], "corrected": COLOURS[0], "best fit": COLOURS[0]}  # of models, in all figures
MOST_POINTS = 4000  # of a drawn curve; a screen resolves no more
PLAIN_LEAST, PLAIN_DECADES = 1e-4, 1e6  # least value and widest range of a logarithmic axis with plain numbers
LEAST_PLAIN = 1e-3  # largest value of an axis below which its unit takes a prefix
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
PREFIXED, PREFIXES = ("m", "J"), {-3: "m", -6: "µ", -9: "n", -12: "p"}
MOST_TICKS = 20  # numbers along an axis
FEWER_NUMBERS = 2.9  # ratio of an axis's limits above which ticks at 1, 2, 3, 5 and 7 suffice: at least two are inside

SETTINGS: Any = {
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=COLOURS),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "figure.dpi": 110,
    "font.size": 10,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "savefig.dpi": 130,
}


matplotlib.rcParams.update(SETTINGS)


def new_figure(
    rows: int = 1, cols: int = 1, *, width: float = 9.0, height: float = 4.5, **options: Any
) -> tuple[Figure, Any]:
    """A figure and the axes of `Figure.subplots`: one, or an array."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, cols, **options)


def panels(
    count: int, columns: int, *, width: float, row_height: float, margin: float, **options: Any
) -> tuple[Figure, list[Axes]]:
    """A figure with `count` axes in rows of `columns` at most; its height is that of the rows and a margin."""
    columns = min(columns, count)
    rows = -(-count // columns)
    figure, grid = new_figure(rows, columns, width=width, height=margin + row_height * rows, squeeze=False, **options)
    for ax in grid.flat[count:]:
        ax.set_visible(False)
    return figure, list(grid.flat[:count])


def grouped_bars(count: int) -> tuple[np.ndarray, float]:
    """Shifts (count,) of the bars in a group, and the width of each; the groups are 1 apart."""
    width = 0.8 / count
    return (np.arange(count) - 0.5 * (count - 1)) * width, width


def in_units(name: str, unit: str) -> str:
    """The label of an axis: a name, and its unit below."""
    return f"{name}\n[{unit.replace('^2', '²').replace('^3', '³')}]" if unit else name


def prefixed(largest: float, unit: str) -> tuple[float, str]:
    """A unit for values up to `largest`, and the factor to it: 1e6 and µm for 2e-5 m, so that no axis has an offset.

    A unit that takes no prefix, such as N mm, has a power of ten before it.
    """
    if not 0.0 < largest < LEAST_PLAIN:
        return 1.0, unit
    power = 3 * int(np.floor(np.log10(largest) / 3.0))
    if unit in PREFIXED and power in PREFIXES:
        return 10.0**-power, f"{PREFIXES[power]}{unit}"
    return 10.0**-power, f"10{str(power).translate(RAISED)} {unit}"


def few_ticks(numbers: Sequence[int] | np.ndarray) -> np.ndarray:
    """The numbers of modes for the ticks of an axis: all, or every nth."""
    return np.asarray(numbers)[:: -(-len(numbers) // MOST_TICKS)]


def plain_ticks(figure: Figure) -> Figure:
    """The figure with plain numbers, such as 0.1 and 20, on logarithmic axes of few decades."""
    for ax in figure.axes:
        for axis in (ax.xaxis, ax.yaxis):
            low, high = sorted(axis.get_view_interval())
            if axis.get_scale() != "log" or not low > 0:
                continue
            if high / low < PLAIN_DECADES and low >= PLAIN_LEAST and high <= 1.0 / PLAIN_LEAST:
                axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(_plain_minor(high / low) if high / low < 10 else NullFormatter())
    return figure


def _plain_minor(extent: float) -> FuncFormatter:
    """The formatter of ticks between decades: few, but with those of the decades at least two."""
    shown = "123456789" if extent <= FEWER_NUMBERS else "2357"  # first digits; all such as 0.14 and 0.16
    return FuncFormatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in shown else "")


def envelope(y: np.ndarray) -> np.ndarray:
    """Indices of the samples of a signal (n_samples,) to draw: all, or the extrema of each of 2,000 segments."""
    if y.size <= MOST_POINTS:
        return np.arange(y.size)
    edges = np.linspace(0, y.size, MOST_POINTS // 2 + 1).astype(int)
    pieces = ((a, np.nan_to_num(y[a:b])) for a, b in zip(edges, edges[1:]))
    return np.unique([a + i for a, piece in pieces for i in (piece.argmin(), piece.argmax())])
