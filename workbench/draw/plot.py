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
from workbench.draw.design import plot_controlled_mode_count, plot_motion, plot_spillover_paths, plot_work
from workbench.draw.gap import plot_where
from workbench.draw.identification import plot_bands, plot_standard_errors
from workbench.draw.placement import plot_placement, plot_sensor_placement
from workbench.draw.robust import plot_prediction, plot_redesign
from workbench.draw.signals import plot_distortion, plot_frf_matrix, plot_record
from workbench.draw.style import COLOURS, GREY, new_figure, panels
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
from workbench.identification.signal.modal_estimates import ModalEstimates, RefinedModes
from workbench.records.frequency_responses import FrequencyResponses
from workbench.records.record import Record
from workbench.robust.prediction import Prediction
from workbench.robust.redesign import Redesign
from workbench.structure.domain import NamedPoints, Rectangle
from workbench.structure.modes import Modes, SampledModes

MOST_PANELS = 12
MOST_INSTANTS = 5


@singledispatch
def plot(result: object) -> Figure:
    """A figure of a result: `Record`, `FrequencyResponses`, `Modes`, `SampledModes`, estimates of modes,
    `RefinedModes`, `Bands`, `Response`, `Spillover`, `Explanation`, `ControlledModeCount`, `Placement`,
    `SensorPlacement`, `ModalFilter`, `Distortion`, `Verdict`, `Redesign` or `Prediction`.

    Raises:
        TypeError: a type that has no figure.
    """
    known = ", ".join(sorted(t.__name__ for t in plot.registry if t is not object))
    raise TypeError(f"{type(result).__name__} has no figure; these have one: {known}")


@plot.register
def _(result: Modes) -> Figure:
    if isinstance(result.domain, Rectangle):
        return plot_surface_modes(result, count=MOST_PANELS)
    if isinstance(result.domain, NamedPoints):
        return plot_point_modes(result, count=MOST_PANELS)
    x = np.linspace(0.0, result.length, 401)
    figure, axes = _panel_per_mode(result, "x [m]")
    for ax, shape in zip(axes, result.phi(x).T):
        ax.plot(x, shape)
    axes[0].set_ylabel("φ(x) [1/√kg]")
    return figure


@plot.register
def _(result: SampledModes) -> Figure:
    if result.on_plate:
        return plot_scattered_modes(result, count=MOST_PANELS)
    x = result.positions if result.on_interval else np.arange(1, result.n_outputs + 1)
    figure, axes = _panel_per_mode(result, "x [m]" if result.on_interval else "sensor")
    for ax, shape in zip(axes, result.shapes.T):
        ax.plot(x, shape.real, "o-", label="real")
        ax.plot(x, shape.imag, ".", color=COLOURS[1], label="imaginary")
    axes[0].legend(fontsize=8)
    return figure


DISTURBANCE = "residual energy after this disturbance"
plot.register(Record, plot_record)
plot.register(FrequencyResponses, plot_frf_matrix)
plot.register(RefinedModes, plot_standard_errors)
plot.register(Placement, plot_placement)
plot.register(Explanation, plot_spillover_paths)
plot.register(Verdict, plot_where)
plot.register(Redesign, plot_redesign)
plot.register(Prediction, plot_prediction)
plot.register(SensorPlacement, plot_sensor_placement)
plot.register(ModalEstimates, lambda result: plot(result.modes))
plot.register(Bands, lambda result: plot_surface_bands(result) if result.x.ndim == 2 else plot_bands(result))
plot.register(Spillover, lambda result: plot_work({"this design": result}))
plot.register(ControlledModeCount, lambda result: plot_controlled_mode_count({DISTURBANCE: result}))
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
def _(result: ModalFilter) -> Figure:
    figure, ax = new_figure(width=9, height=4)
    along = result.positions.ndim == 1
    where = result.positions if along else 1 + np.arange(len(result.positions))
    for r, weights in enumerate(result.displacement):
        ax.plot(where, weights, "o-" if along else "o", label=f"mode {r + 1}")
    ax.set(xlabel="x of the sensor [m]" if along else "sensor", ylabel="coefficient of its displacement [√kg]")
    ax.set_title("modal filter")
    ax.legend(ncols=2)
    return figure


def _panel_per_mode(modes: Modes | SampledModes, label: str) -> tuple[Figure, list[Axes]]:
    """Panels with a line at zero, titled by the frequency and damping ratio of each mode."""
    figure, axes = panels(min(modes.n_modes, MOST_PANELS), 3, width=10, row_height=2.1, margin=0.6, sharex=True)
    for r, ax in enumerate(axes):
        ax.axhline(0.0, color=GREY, linewidth=0.6)
        ax.set_title(f"mode {r + 1}: {modes.frequencies_hz[r]:.4g} Hz, ζ = {100 * modes.zeta[r]:.2g} %", fontsize=10)
        ax.set_xlabel(label)
    return figure, axes


def _point_motion(result: Response, names: Sequence[str]) -> Figure:
    """Displacement over time of the points of largest motion, one panel per point, with a common scale."""
    moved = result.displacement(list(names))
    most = np.sort(np.argsort(-np.abs(moved).max(axis=1), kind="stable")[:MOST_PANELS])
    shared = {"sharex": True, "sharey": True, "squeeze": False}
    figure, axes = new_figure(len(most), 1, width=9, height=0.8 + 1.0 * len(most), **shared)
    for ax, i in zip(axes[:, 0], most):
        ax.plot(result.time, moved[i], linewidth=0.9)
        ax.set_ylabel(names[i])
    fewer = f" of the {len(most)} points of {len(names)} that move most" if len(most) < len(names) else ""
    axes[0, 0].set_title(f"displacement [m]{fewer}")
    axes[-1, 0].set_xlabel("time [s]")
    return figure
