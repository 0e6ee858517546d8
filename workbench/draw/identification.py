"""Pictures of identification: eigenvalues, eigenfunctions, distributions, stabilisation, a measured structure."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.structure.modes import Modes

SYMBOLS = {"omega": "frequency", "zeta": "damping ratio"}
LABELS = ("printed in 1981", "two delays, as in 1981", "stacked delays")


def eigenvalue_errors(errors: Mapping, sensors: Sequence[int]) -> Figure:
    """Relative errors mode by mode, a column a number of sensors; errors[m, "omega" or "zeta"] are three arrays."""
    figure, axes = new_figure(2, len(sensors), width=11, height=6, sharex=True, sharey=True)
    for column, m in enumerate(sensors):
        for row, what in enumerate(SYMBOLS):
            ax = axes[row, column]
            for values, label, marker, colour in zip(errors[m, what], LABELS, "xos", (GREY, *COLOURS), strict=False):
                number = np.arange(1, values.size + 1)
                ax.semilogy(number, np.maximum(values, 1e-16), marker, ms=5, color=colour, label=label)
            ax.set_ylim(1e-16, 10)
            if column == 0:
                ax.set_ylabel(f"relative error of\n{SYMBOLS[what]}")
        axes[0, column].set_title(f"{m} sensors")
        axes[1, column].set_xlabel("mode")
        axes[1, column].set_xticks([1, 5, 10, 15, 20])
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure


def eigenfunction(found: Modes, exact: Modes, *, mode: int, positions: np.ndarray) -> Figure:
    """One identified eigenfunction over the exact one, with its values at the sensors and the difference below."""
    figure, (top, bottom) = new_figure(2, 1, width=8, height=5.5, sharex=True, height_ratios=(3, 1))
    x = np.linspace(0.0, exact.length, 400)
    truth, identified = exact.phi(x)[:, mode], found.phi(x)[:, mode]
    sign = np.sign(truth @ identified)
    top.plot(x, truth, color=GREY, lw=4, alpha=0.6, label="exact")
    top.plot(x, sign * identified, color=COLOURS[0], label="identified")
    top.plot(positions, sign * found.phi(positions)[:, mode], "o", color=COLOURS[1], label="at the sensors")
    top.set_ylabel(f"φ{mode + 1}(x), mass-normalised")
    top.legend(ncols=3)
    bottom.plot(x, sign * identified - truth, color=COLOURS[0])
    bottom.set_ylabel("difference")
    bottom.set_xlabel("x")
    return figure


def distribution_errors(x: np.ndarray, curves: Mapping, sensors: Sequence[int], *, terms: int) -> Figure:
    """Errors of mass and stiffness along x; curves[m, terms, what] are (printed, cubic splines, default splines)."""
    figure, axes = new_figure(2, len(sensors), width=11, height=6, sharex=True, sharey=True)
    labels = ("printed in 1981", "cubic splines", "default splines")
    for column, m in enumerate(sensors):
        for row, what in enumerate(("mass", "stiffness")):
            for curve, label, colour in zip(curves[m, terms, what], labels, (GREY, *COLOURS), strict=False):
                axes[row, column].semilogy(x, np.maximum(curve, 1e-8), color=colour, label=label)
            axes[row, column].set_ylim(1e-8, 1e-1)
        axes[0, column].set_title(f"{m} sensors")
        axes[1, column].set_xlabel("x")
    axes[0, 0].set_ylabel("error of m(x)")
    axes[1, 0].set_ylabel("error of EA(x)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure
