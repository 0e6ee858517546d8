"""Pictures of identification: records, eigenvalues, eigenfunctions, distributions, stabilisation, structures."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.identification.free_decay.ibrahim import Stabilisation
from workbench.identification.shapes.mode_pairing import ModePairing
from workbench.identification.updating.local_loss import LocatedDamage
from workbench.records.record import Record
from workbench.structure.modes import Modes, SampledModes

SYMBOLS = {"omega": "frequency", "zeta": "damping ratio"}
LABELS = ("published in 1981", "Ibrahim, two delays", "this package, default")
# the complex to real: seen on white and on black alike
REAL = LinearSegmentedColormap.from_list("real", ["#8f979f", COLOURS[0]])
Case = tuple[LocatedDamage, Callable[[np.ndarray], np.ndarray], np.ndarray]


def plot_ring_down(record: Record, *, stretch: float) -> Figure:
    """Every output over time, one above the other, each at its place; the first `stretch` seconds."""
    shown = record.between(record.start_time, record.start_time + stretch)
    figure, ax = new_figure(width=9, height=4.5)
    size = 1.1 * np.abs(shown.outputs).max()
    for j, channel in enumerate(shown.output_channels):
        ax.axhline(j, color=GREY, linewidth=0.4)
        ax.plot(shown.time, j + 0.5 * shown.outputs[j] / size, color=COLOURS[0], linewidth=0.9)
        place = channel.name if channel.at is None else f"x = {channel.at:.3g}"
        ax.text(shown.time[-1], j, f"  {place}", va="center")
    ax.set(xlabel="time [s]", yticks=[], xlim=(shown.time[0], shown.time[-1]))
    first = record.output_channels[0]
    ax.set_title(f"{first.quantity}, one line per sensor, {2.0 * size:.2g} {first.unit} apart".lstrip(", "))
    return figure


def plot_identified(found: Modes, truth: Modes, positions: np.ndarray, *, count: int) -> Figure:
    """Identified eigenfunctions over the true ones, with their values at the sensors."""
    figure, axes = new_figure(-(-count // 3), 3, width=10, height=4.6, sharex=True, sharey=True, squeeze=False)
    x = np.linspace(0.0, truth.length, 301)
    for r, ax in zip(range(count), axes.flat, strict=False):
        sign = np.sign(found.phi(x)[:, r] @ truth.phi(x)[:, r])
        ax.plot(x, truth.phi(x)[:, r], color=GREY, linewidth=4, alpha=0.5, label="true")
        ax.plot(x, sign * found.phi(x)[:, r], color=COLOURS[0], label="identified")
        at_sensors = sign * found.phi(positions)[:, r]
        ax.plot(positions, at_sensors, "o", color=COLOURS[1], markersize=4, label="at the sensors")
        ax.set_title(f"mode {r + 1}: {found.frequencies_hz[r]:.4f} Hz, ζ = {100 * found.zeta[r]:.2f} %", fontsize=10)
    for ax in axes[-1]:
        ax.set_xlabel("x [m]")
    for ax in axes[:, 0]:
        ax.set_ylabel("φ(x) [1/√kg]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def eigenvalue_errors(errors: Mapping[tuple[int, str], Any], sensors: Sequence[int]) -> Figure:
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
    top.set_ylabel(f"φ{mode + 1}(x) [1/√kg]")
    top.legend(ncols=3)
    bottom.plot(x, sign * identified - truth, color=COLOURS[0])
    bottom.set(ylabel="difference [1/√kg]", xlabel="x [m]")
    return figure


def distribution_errors(
    x: np.ndarray, curves: Mapping[tuple[int, int, str], Any], sensors: Sequence[int], *, terms: int
) -> Figure:
    """Errors of mass and stiffness along x; curves[m, terms, what] are (printed, cubic splines, default splines)."""
    figure, axes = new_figure(2, len(sensors), width=11, height=6, sharex=True, sharey=True)
    labels = ("published in 1981", "cubic splines", "this package, default")
    for column, m in enumerate(sensors):
        for row, what in enumerate(("mass", "stiffness")):
            for curve, label, colour in zip(curves[m, terms, what], labels, (GREY, *COLOURS), strict=False):
                axes[row, column].semilogy(x, np.maximum(curve, 1e-8), color=colour, label=label)
            axes[row, column].set_ylim(1e-8, 1e-1)
        axes[0, column].set_title(f"{m} sensors")
        axes[1, column].set_xlabel("x [m]")
    axes[0, 0].set_ylabel("error of m(x) [kg/m]")
    axes[1, 0].set_ylabel("error of EA(x) [N]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
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


def measured_modes(bending: SampledModes, others: SampledModes, pairing: ModePairing, model: Modes) -> Figure:
    """Measured shapes over the model's, one panel per mode; those that are not the model's last, in orange."""
    n = bending.n_modes + others.n_modes
    figure, axes = new_figure(int(np.ceil(n / 4)), 4, width=12, height=2.7 * np.ceil(n / 4), sharex=True, sharey=True)
    x = np.linspace(0.0, model.length, 200)
    at_sensors = model.phi(bending.positions)
    for ax, r in zip(axes.ravel(), range(n), strict=False):
        is_model = r < bending.n_modes
        modes, k = (bending, r) if is_model else (others, r - bending.n_modes)
        values = modes.shapes[:, k] * np.exp(-0.5j * np.angle((modes.shapes[:, k] ** 2).sum()))
        values = values.real / np.abs(values).max()
        if is_model:
            shape = at_sensors[:, pairing.model[k]]
            scale = (values @ shape) / (shape @ shape)
            ax.plot(x, scale * model.phi(x)[:, pairing.model[k]], color=GREY, lw=3, alpha=0.5, label="beam model")
        marker, colour, label = (
            ("o", COLOURS[0], "measured") if is_model else ("s", COLOURS[1], "measured, not bending")
        )
        ax.plot(modes.positions, values, marker, color=colour, label=label)
        what = f"beam {pairing.scaled_hz[k]:.1f} Hz, MAC {pairing.mac[k]:.3f}" if is_model else "not bending"
        ax.set_title(f"{modes.frequencies_hz[k]:.1f} Hz: {what}", fontsize=9.5)
    for ax in axes.ravel()[n:]:
        ax.set_visible(False)
    for ax in np.atleast_2d(axes)[-1]:
        ax.set_xlabel("x / length")
    for ax in np.atleast_2d(axes)[:, 0]:
        ax.set_ylabel("mode shape, largest 1")
    named = {label: line for ax in axes.ravel() for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=len(named))
    return figure


def placement_on_shapes(modes: Modes, placements: Mapping[str, Any], *, n_controlled: int) -> Figure:
    """Where actuators stand on the mode shapes, and what each placement leaves in the residual modes."""
    figure, (left, right) = new_figure(1, 2, width=12, height=4.5, width_ratios=(3, 2))
    x = np.linspace(0.0, modes.length, 300)
    shapes = modes.phi(x)
    for r in range(modes.n_modes):
        controlled = r < n_controlled
        label = {0: "controlled modes", n_controlled: "residual modes"}.get(r)
        left.plot(x, shapes[:, r], color=COLOURS[0] if controlled else GREY, lw=2 if controlled else 0.9, label=label)
    bottom, width = shapes.min(), 0.8 / len(placements)
    for i, (name, placement) in enumerate(placements.items()):
        colour = COLOURS[i + 1]
        level = bottom - 0.35 * (i + 1)
        left.plot(placement.positions, np.full(len(placement.positions), level), "^", color=colour, ms=9)
        label = f"{name}: W_R = {placement.residual_work:.2e}, effort {placement.effort:.3g}"
        number = np.arange(n_controlled + 1, modes.n_modes + 1)
        work = np.maximum(placement.by_mode, 1e-12)
        right.bar(number + (i - 1) * width, work, width, bottom=1e-12, color=colour, label=label)
    left.set(xlabel="x / length", ylabel="mode shape; triangles: actuators")
    left.legend(loc="upper center", ncols=2)
    right.set(yscale="log", ylim=(1e-12, None), xticks=number, xlabel="residual mode", ylabel="spillover work W_r")
    right.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def order_found(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Modes identified, missed and falsely reported over the signal-to-noise ratio; rows as `identification_order`."""
    figure, ax = new_figure(width=8, height=4.2)
    level = np.array([row["level_db"] for row in rows])
    kinds = (
        ([row["found"] for row in rows], "identified", "o", COLOURS[0]),
        ([-(row["count"] - row["found"]) for row in rows], "missed", "x", COLOURS[1]),
        ([-row["false"] for row in rows], "false", "+", COLOURS[3]),
    )
    for values, label, marker, colour in kinds:
        shown = np.array(values) != 0
        ax.plot(level[shown], np.array(values)[shown], marker, color=colour, label=f"{label} ({abs(sum(values))})")
    ax.axhline(0.0, color=GREY, lw=0.8)
    ax.set(xlabel="signal-to-noise ratio [dB]", ylabel="modes of a structure\nerrors below the line")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.legend(ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return figure


def stiffness_found(cases: Mapping[str, Case]) -> Figure:
    """Stiffness along each structure; cases[title] are (what was found, the true stiffness, places of the sensors)."""
    rows = (len(cases) + 1) // 2
    figure, axes = new_figure(rows, 2, width=10.0, height=0.6 + 2.9 * rows, sharex=True, sharey=True, squeeze=False)
    highest = 0.0
    for ax, (title, (found, truth, sensors)) in zip(axes.ravel(), cases.items()):
        length = found.best.structure.length
        x = np.linspace(0.0, length, 801)
        low, high = found.best.stiffness.band(x)
        ax.plot(x, truth(x), color=GREY, lw=4, alpha=0.6, label="true")
        ax.fill_between(x, low, high, color=COLOURS[0], alpha=0.25, lw=0, label="95 % band")
        ax.plot(x, found.best.stiffness(x), color=COLOURS[0], label="identified")
        ax.plot(sensors, np.zeros(sensors.size), "^", color=COLOURS[1], ms=8, clip_on=False, label="sensors")
        ax.set_title(title)
        highest = max(highest, high.max(), truth(x).max())
    axes[0, 0].set_ylim(0.0, 1.05 * highest)
    for ax in axes[-1]:
        ax.set_xlabel("x / length")
    for ax in axes[:, 0]:
        ax.set_ylabel("stiffness / nominal")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=4)
    return figure


def places_found(rows: Sequence[Mapping[str, Any]], *, within: float) -> Figure:
    """Error of the place of each loss over its true place, a colour a level of noise; crosses were not reported."""
    figure, ax = new_figure(width=8.5, height=4.4)
    levels = sorted({row["level_db"] for row in rows}, reverse=True)
    for level, colour in zip(levels, COLOURS, strict=False):
        here = [row for row in rows if row["level_db"] == level]
        for kind, marker in (("beam", "o"), ("bar", "s")):
            own = [row for row in here if row["kind"] == kind and row["found"]]
            places, errors = [row["centre"] for row in own], [max(row["error"], 1e-6) for row in own]
            ax.semilogy(places, errors, marker, color=colour, ms=5.5, mfc="none", label=f"{kind}, {level:g} dB")
        missed = [row for row in here if not row["found"]]
        ax.semilogy([row["centre"] for row in missed], [row["error"] for row in missed], "x", color=colour)
    ax.axhline(within, color=GREY, ls="--")
    ax.text(0.01, within * 1.15, f"{100 * within:g} % of the length", color=GREY, va="bottom")
    ax.set(xlim=(0.0, 1.0), ylim=(1e-6, 1.0))
    ax.set(xlabel="where the stiffness is lost, x / length", ylabel="error of the place / length")
    figure.legend(loc="outside upper right", ncols=len(levels))
    return figure
