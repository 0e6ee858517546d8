"""One way to draw any result: `plot(result)`."""

from collections.abc import Sequence
from functools import singledispatch

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from workbench.design.estimation.modal_filter import ModalFilter
from workbench.design.loop.closed_loop import Response
from workbench.design.placement.controlled_modes import ControlledModeCount
from workbench.design.placement.sensor_placement import SensorPlacement
from workbench.design.placement.task import Placement
from workbench.design.spillover.explain import Explanation
from workbench.design.spillover.spillover import Spillover
from workbench.draw.accuracy import plot_bands
from workbench.draw.design import plot_controlled_mode_count, plot_motion, plot_spillover_paths, plot_work
from workbench.draw.gap import plot_where
from workbench.draw.robust import plot_prediction, plot_redesign
from workbench.draw.sensors import plot_sensor_placement
from workbench.draw.spectra import plot_distortion, plot_transfer
from workbench.draw.style import COLOURS, GREY, envelope, few_ticks, in_units, new_figure
from workbench.draw.surface import (
    plot_point_modes,
    plot_scattered_modes,
    plot_surface_bands,
    plot_surface_modes,
    plot_surface_motion,
)
from workbench.gap.report.verdict import Verdict
from workbench.identification.shapes.bands import Bands
from workbench.identification.signal.distortion import Distortion
from workbench.identification.signal.modal_estimates import ModalEstimates, Refined
from workbench.records.record import Record
from workbench.records.transfer_functions import TransferFunctions
from workbench.robust.prediction import Prediction
from workbench.robust.redesign import Redesign
from workbench.structure.domain import NamedPoints, Rectangle, listed
from workbench.structure.modes import Modes, SampledModes
from workbench.structure.printed import place_text

MOST_PANELS = 12
MOST_INSTANTS = 5


@singledispatch
def plot(result: object) -> Figure:
    """A figure of a result: `Record`, `TransferFunctions`, `Modes`, `SampledModes`, estimates of modes, `Refined`,
    `Bands`, `Response`, `Spillover`, `Explanation`, `ControlledModeCount`, `Placement`, `SensorPlacement`,
    `ModalFilter`, `Distortion`, `Verdict`, `Redesign` or `Prediction`.

    Raises:
        TypeError: a type that has no figure.
    """
    known = ", ".join(sorted(t.__name__ for t in plot.registry if t is not object))
    raise TypeError(f"{type(result).__name__} has no figure; these have one: {known}")


@plot.register
def _(result: Record) -> Figure:
    rows = [*zip(result.input_channels, result.inputs), *zip(result.output_channels, result.outputs)][:MOST_PANELS]
    figure, axes = new_figure(len(rows), 1, width=9, height=0.8 + 1.3 * len(rows), sharex=True, squeeze=False)
    for i, (ax, (channel, values)) in enumerate(zip(axes[:, 0], rows)):
        colour = COLOURS[1] if i < result.n_inputs else COLOURS[0]
        at = envelope(values)
        ax.plot(result.start_time + result.sample_time * at, values[at], color=colour, linewidth=0.9)
        ax.set_ylabel(in_units(channel.name, channel.unit), fontsize=8)
    axes[0, 0].set_title(result.name)
    axes[-1, 0].set_xlabel("time [s]")
    return figure


@plot.register
def _(result: TransferFunctions) -> Figure:
    return plot_transfer(result)


@plot.register
def _(result: Modes) -> Figure:
    if isinstance(result.domain, Rectangle):
        return plot_surface_modes(result, count=MOST_PANELS)
    if isinstance(result.domain, NamedPoints):
        return plot_point_modes(result, count=MOST_PANELS)
    x = np.linspace(0.0, result.length, 401)
    shapes = result.phi(x)[:, :MOST_PANELS]
    figure, axes = _panels(shapes.shape[1])
    for r, ax in enumerate(axes):
        ax.axhline(0.0, color=GREY, linewidth=0.6)
        ax.plot(x, shapes[:, r])
        ax.set_title(_named(r, result.frequencies_hz[r], result.zeta[r]), fontsize=10)
        ax.set_xlabel("x [m]")
    axes[0].set_ylabel("φ(x) [1/√kg]")
    return figure


@plot.register
def _(result: SampledModes) -> Figure:
    if result.on_plate:
        return plot_scattered_modes(result, count=MOST_PANELS)
    shapes = result.shapes[:, :MOST_PANELS]
    figure, axes = _panels(shapes.shape[1])
    placed = result.on_interval
    x = result.positions if placed else np.arange(1, result.n_outputs + 1)
    for r, ax in enumerate(axes):
        ax.axhline(0.0, color=GREY, linewidth=0.6)
        ax.plot(x, shapes[:, r].real, "o-", label="real")
        ax.plot(x, shapes[:, r].imag, ".", color=COLOURS[1], label="imaginary")
        ax.set_title(_named(r, result.frequencies_hz[r], result.zeta[r]), fontsize=10)
        ax.set_xlabel("x [m]" if placed else "sensor")
    axes[0].legend(fontsize=8)
    return figure


@plot.register
def _(result: Refined) -> Figure:
    figure, axes = new_figure(2, 1, width=9, height=5, sharex=True)
    modes = np.arange(1, result.modes.n_modes + 1)
    relative = result.omega_std / result.modes.omega, result.zeta_std / np.maximum(np.abs(result.modes.zeta), 1e-300)
    for ax, values, title in zip(axes, relative, ("frequency", "damping ratio")):
        ax.semilogy(modes, values, "o-")
        ax.set_title(f"standard error of the {title}, relative")
    axes[1].set(xlabel="mode", xticks=few_ticks(modes))
    return figure


plot.register(Explanation, plot_spillover_paths)
plot.register(Verdict, plot_where)
plot.register(Redesign, plot_redesign)
plot.register(Prediction, plot_prediction)
plot.register(SensorPlacement, plot_sensor_placement)
plot.register(ModalEstimates, lambda result: plot(result.modes))
plot.register(Bands, lambda result: plot_surface_bands(result) if result.x.ndim == 2 else plot_bands(result))
plot.register(Spillover, lambda result: plot_work({"this design": result}))
plot.register(
    ControlledModeCount, lambda result: plot_controlled_mode_count({"energy left of this disturbance": result})
)
plot.register(Distortion, lambda result: plot_distortion([result]))


@plot.register
def _(result: Response) -> Figure:
    domain = result.modes.domain
    if isinstance(domain, Rectangle):
        instants = np.linspace(result.time[0], result.time[-1], MOST_INSTANTS)
        return plot_surface_motion({"displacement": result}, instants.tolist())
    if isinstance(domain, NamedPoints):
        return _point_motion(result, domain.grid())
    return plot_motion({"displacement": result}, np.linspace(0.0, domain.length, 201))


@plot.register
def _(result: Placement) -> Figure:
    figure, ax = new_figure(width=9, height=3.5)
    numbers = len(result.positions) + 1 + np.arange(result.by_mode.size)
    ax.bar(numbers, result.by_mode)
    where = "; ".join(place_text(place) for place in listed(result.positions))
    ax.set(xlabel="residual mode", ylabel="spillover work, W_r [J]", xticks=few_ticks(numbers))
    ax.set_title(f"actuators at {where}: W_R = {result.residual_work:.3g}, effort {result.effort:.3g}")
    return figure


@plot.register
def _(result: ModalFilter) -> Figure:
    figure, ax = new_figure(width=9, height=4)
    along = result.positions.ndim == 1
    where = result.positions if along else 1 + np.arange(len(result.positions))
    for r, weights in enumerate(result.displacement):
        ax.plot(where, weights, "o-" if along else "o", label=f"mode {r + 1}")
    ax.set(xlabel="x of the sensor" if along else "sensor", ylabel="weight of its displacement", title="modal filter")
    ax.legend(ncols=2)
    return figure


def _point_motion(result: Response, names: Sequence[str]) -> Figure:
    """Displacement over time of the points of largest motion, one panel per point, with a common scale."""
    moved = result.displacement(list(names))
    most = np.sort(np.argsort(-np.abs(moved).max(axis=1), kind="stable")[:MOST_PANELS])
    figure, axes = new_figure(
        len(most), 1, width=9, height=0.8 + 1.0 * len(most), sharex=True, sharey=True, squeeze=False
    )
    for ax, i in zip(axes[:, 0], most):
        ax.plot(result.time, moved[i], linewidth=0.9)
        ax.set_ylabel(names[i])
    fewer = f" of the {len(most)} points of {len(names)} that move most" if len(most) < len(names) else ""
    axes[0, 0].set_title(f"displacement [m]{fewer}")
    axes[-1, 0].set_xlabel("time [s]")
    return figure


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    columns = min(count, 3)
    rows = -(-count // columns)
    figure, axes = new_figure(rows, columns, width=10, height=0.6 + 2.1 * rows, squeeze=False, sharex=True)
    for ax in axes.flat[count:]:
        ax.set_visible(False)
    return figure, list(axes.flat[:count])


def _named(r: int, frequency_hz: float, zeta: float) -> str:
    return f"mode {r + 1}: {frequency_hz:.4g} Hz, ζ = {100 * zeta:.2g} %"
