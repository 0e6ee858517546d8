"""Figure of the distortion that periodic excitation shows before any model."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.identification.signal.distortion import Distortion

MOST_PANELS = 4  # outputs
BEYOND = 4.0  # times the highest line excited, up to which distortion is shown


def plot_distortion(distortions: Sequence[Distortion]) -> Figure:
    """Excited lines, odd and even lines that are not, and noise, a column a record and a row an output."""
    rows = distortions[0].channels[:MOST_PANELS]
    figure, axes = new_figure(
        len(rows),
        len(distortions),
        width=10,
        height=1.0 + 2.3 * len(rows),
        sharex=True,
        sharey="row",
        squeeze=False,
    )
    for column, found in zip(axes.T, distortions, strict=True):
        shown = found.frequencies_hz < BEYOND * found.frequencies_hz[found.excited].max()
        lines = (
            ("excited", found.excited, COLOURS[0]),
            ("odd", found.odd, COLOURS[1]),
            ("even", found.even, COLOURS[2]),
        )
        for j, ax in enumerate(column[: len(rows)]):
            for label, kind, colour in lines:
                chosen = shown & kind
                at, size = found.frequencies_hz[chosen], found.amplitudes[j, chosen]
                if at.size:
                    label = label if kind is found.excited else f"{label}, not excited"
                    ax.semilogy(at, size, ".", color=colour, markersize=3, label=label)
            ax.semilogy(found.frequencies_hz[shown], found.noise[j, shown], color=GREY, linewidth=0.8, label="noise")
        column[0].set_title(found.name)
        column[-1].set_xlabel("frequency [Hz]")
    for ax, channel in zip(axes[:, 0], rows, strict=True):
        ax.set_ylabel(channel.name + (f"\n[{channel.unit} rms]" if channel.unit else ""))
    lowest = min(float(np.median(found.noise[found.noise > 0])) for found in distortions if (found.noise > 0).any())
    for ax in axes.flat:
        ax.set_ylim(bottom=max(ax.get_ylim()[0], 0.05 * lowest))
    axes[0, -1].legend(fontsize=8, markerscale=3)
    return figure
