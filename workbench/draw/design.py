"""Figures of control design: motion, work by mode, placements."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.closed_loop import Response
from workbench.design.loop.on_off_response import Switched
from workbench.design.placement.controlled_modes import ControlledModeCount
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import Placement
from workbench.design.placement.task import PlacementTask, extent
from workbench.design.placement.velocity_feedback import FeedbackPlacement
from workbench.design.spillover.explain import Explanation
from workbench.design.spillover.spillover import Spillover
from workbench.draw.style import COLOURS, GREY, MOST_TICKS, few_ticks, new_figure
from workbench.records.units import SI, Units
from workbench.structure.printed import place_text

SHOWN_SHARE = 1e-5
MOST_INSTANTS = 700  # more than a picture has columns for


def plot_displacements(
    responses: dict[str, Response], positions: dict[str, Sequence[float]], times: Sequence[float], x: np.ndarray
) -> Figure:
    """The structure's displacement at several times, one column per design, one row per time; actuators marked."""
    figure, axes = new_figure(
        len(times), len(responses), width=10, height=1.55 * len(times), sharex=True, sharey=True, squeeze=False
    )
    for column, (name, response) in enumerate(responses.items()):
        motion = response.displacement(x)
        for row, time in enumerate(times):
            ax = axes[row, column]
            k = int(np.argmin(np.abs(response.time - time)))
            ax.plot(x, motion[:, k], color=COLOURS[0])
            ax.axhline(0.0, color=GREY, linewidth=0.8)
            where = positions[name]
            ax.plot(where, np.zeros(len(where)), "x", color=COLOURS[1], markersize=7, mew=2, label="actuator")
            if column == 0:
                ax.set_ylabel(f"w [m] at\nt = {time:g} s")
        axes[0, column].set_title(f"actuators at {name}")
        axes[-1, column].set_xlabel("x [m]")
    axes[0, 0].legend(loc="upper right", fontsize=8)
    return figure


def plot_motion(responses: Mapping[str, Response], x: np.ndarray) -> Figure:
    """Displacement over place and time as colour, one panel a response, all on one scale."""
    figure, axes = new_figure(len(responses), 1, width=9, height=2.1 * len(responses), sharex=True, squeeze=False)
    steps = {name: -(-response.time.size // MOST_INSTANTS) for name, response in responses.items()}
    fields = {name: response.displacement(x)[:, :: steps[name]] for name, response in responses.items()}
    limit = max(np.abs(field).max() for field in fields.values())
    for ax, (name, field) in zip(axes[:, 0], fields.items(), strict=True):
        time = responses[name].time[:: steps[name]]
        image = ax.pcolormesh(
            time, x, field, cmap="RdBu_r", vmin=-limit, vmax=limit, shading="gouraud", rasterized=True
        )
        ax.set(ylabel="x [m]", title=name)
        ax.grid(False)
    axes[-1, 0].set_xlabel("time [s]")
    figure.colorbar(image, ax=axes[:, 0], label="displacement [m]")
    return figure


def plot_two_works(works: Mapping[str, np.ndarray], *, first: int) -> Figure:
    """Work put into each residual mode, a group of bars per mode; `first` is the zero-based index of the first one."""
    figure, ax = new_figure(width=9, height=4)
    width = 0.8 / len(works)
    for i, (name, work) in enumerate(works.items()):
        numbers = first + 1 + np.arange(work.size)
        ax.bar(numbers + (i - 0.5 * (len(works) - 1)) * width, work, width, label=f"{name}: W_R = {work.sum():.3g} J")
    ax.set(xticks=few_ticks(numbers), xlabel="residual mode", ylabel="spillover work in the mode, W_r [J]")
    ax.set_title("spillover work by residual mode")
    ax.legend()
    return figure


def plot_work(spillovers: dict[str, Spillover]) -> Figure:
    """Work in each residual mode, one group of bars per design, on a logarithmic scale; below zero what it loses."""
    first = next(iter(spillovers.values()))
    if not first.residual:
        return _without_residual_modes()
    figure, ax = new_figure(1, 1, width=9, height=4)
    modes = np.array(first.residual) + 1
    width = 0.8 / len(spillovers)
    total = max(float(np.abs(work.residual_work).sum()) for work in spillovers.values()) or 1.0
    least, lowest = SHOWN_SHARE * total, min(float(work.residual_work.min()) for work in spillovers.values())
    signed = lowest <= -least  # a residual mode that moves already may lose energy
    for i, (name, work) in enumerate(spillovers.items()):
        at, small = modes + (i - 0.5 * (len(spillovers) - 1)) * width, np.abs(work.residual_work) < least
        values = np.where(small, 0.0 if signed else 0.1 * least, work.residual_work)
        bars = ax.bar(at, values, width, label=f"{name}: W_R = {work.residual_total:.3g} J")
        for x in at[small] if modes.size <= MOST_TICKS else ():
            ax.text(x, 1.3 * least, "≈ 0", ha="center", color=bars.patches[0].get_facecolor())
    if signed:
        ax.set_yscale("symlog", linthresh=10.0 ** np.ceil(np.log10(least)))
        ax.axhline(0.0, color=GREY, linewidth=0.8)
    else:
        ax.set_yscale("log")
    ax.set(xlabel="residual mode", ylabel="spillover work W_r [J]", xticks=few_ticks(modes))
    # room above the bars for the legend
    ax.set_ylim(3.0 * lowest if signed else least, 10.0 ** (1.0 + 0.35 * len(spillovers)) * total)
    ax.set_title("control spillover: energy that control leaves in the residual modes")
    ax.legend(loc="upper right")
    return figure


def _without_residual_modes() -> Figure:
    figure, ax = new_figure(width=9, height=1.5)
    ax.axis("off")
    ax.text(0.5, 0.5, "every mode is controlled: no mode is residual, and nothing spills over", ha="center")
    return figure


def plot_member_placement(
    task: PlacementTask,
    placements: Mapping[str, Placement],
    *,
    limits: Limits | None = None,
    impulse_at: float | None = None,
    units: Units = SI,
) -> Figure:
    """Actuators along a structure over mode n + 1, the lowest residual one, and the work in each residual mode beside.

    Args:
        placements: by name, drawn in its colour, each on a line of its own.
        limits: of which the forbidden zones are hatched.
        impulse_at: where the impulse acts, m, marked by a star.
        units: by which the axes are told.
    """
    n, modes = task.n_controlled, task.modes
    figure, (left, right) = new_figure(1, 2, width=11, height=3.8)
    x = np.linspace(0.0, modes.length, 201)
    shape = modes.phi(x)[:, n]
    left.plot(x, shape / np.abs(shape).max(), color=GREY, label=f"mode {n + 1}, the lowest residual one")
    left.axhline(0.0, color=GREY, linewidth=0.8)
    for i, (low, high) in enumerate(limits.forbidden if limits is not None else ()):
        left.axvspan(low, high, facecolor="white", edgecolor=GREY, hatch="////", label="forbidden" if i == 0 else None)
    numbers, width = n + 1 + np.arange(modes.n_modes - n), 0.8 / len(placements)
    for i, (name, placement) in enumerate(placements.items()):
        label = f"{name}: W_R = {placement.residual_work:.2g}"
        height = np.full(n, -1.25 - 0.2 * i)
        half = 0.5 * extent(task.actuator)
        left.errorbar(placement.positions, height, xerr=half, fmt="o", color=COLOURS[i], markersize=8, label=label)
        right.bar(numbers + width * (i - 0.5 * (len(placements) - 1)), placement.by_mode, width, color=COLOURS[i])
    if impulse_at is not None:
        left.plot(impulse_at, 1.2, "*", color=COLOURS[4], markeredgecolor="black", markersize=14, label="impulse")
    left.set(xlabel=units.named("x [m]"), yticks=[], title="where the actuators stand")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), fontsize=9, ncols=2)
    most = max(float(placement.by_mode.max()) for placement in placements.values())
    right.set(xlabel="residual mode", ylabel=units.named("spillover work, W_r [J]"), xticks=few_ticks(numbers))
    right.set(yscale="log", ylim=(SHOWN_SHARE * most, 3.0 * most))
    return figure


def plot_effort_front(placements: Sequence[Placement], marked: dict[str, Placement]) -> Figure:
    """Spillover against effort along the front of placements, with named ones marked; the places below."""
    figure, axes = new_figure(2, 1, width=9, height=7, height_ratios=[3, 2])
    effort = [p.effort for p in placements]
    work = [p.residual_work for p in placements]
    axes[0].plot(effort, work, "o-", color=COLOURS[0], label="least W_R at each effort")
    for (name, p), colour in zip(marked.items(), COLOURS[1:], strict=False):
        axes[0].plot(p.effort, p.residual_work, "s", color=colour, markersize=9, label=name)
    axes[0].set(xscale="log", yscale="log", xlabel="effort ∫ FᵀF dt [N² s]", ylabel="spillover work W_R [J]")
    axes[0].set_title("spillover against effort")
    axes[0].legend()
    for p in placements:
        axes[1].plot(p.positions, np.full(p.positions.size, p.effort), "o", color=COLOURS[0], markersize=4)
    for (_, p), colour in zip(marked.items(), COLOURS[1:], strict=False):
        axes[1].plot(p.positions, np.full(p.positions.size, p.effort), "s", color=colour)
    axes[1].set(yscale="log", xlabel="places of the actuators, x [m]", ylabel="effort [N² s]")
    return figure


def plot_filter_errors(counts: Sequence[int], errors: np.ndarray) -> Figure:
    """Error of each modal coordinate against the number of sensors."""
    figure, ax = new_figure(1, 1, width=9, height=4)
    for r in range(errors.shape[1]):
        ax.semilogy(counts, np.maximum(errors[:, r], 1e-7), "o-", label=f"mode {r + 1}", color=COLOURS[r % 7])
    ax.set(
        xlabel="number of sensors (displacement and slope each)",
        ylabel="error of the modal coordinate, |q̂ - q| [m √kg]",
    )
    ax.set_title("error of modal filters against the number of sensors")
    ax.legend(ncols=2)
    return figure


def plot_comparison(rows: Sequence[dict[str, Any]], title: str) -> Figure:
    """Cost, effort and spillover of several designs as ratios to the first, on a logarithmic scale."""
    figure, ax = new_figure(1, 1, width=9, height=4)
    keys = ("cost", "effort", "W_R")
    width = 0.8 / len(rows)
    ratios = np.array([[row[key] / rows[0][key] for key in keys] for row in rows])
    least = 10.0 ** np.floor(np.log10(ratios.min()) - 0.3)
    for i, row in enumerate(rows):
        at = np.arange(len(keys)) + (i - 0.5 * (len(rows) - 1)) * width
        # bars stand on the bottom of the picture: on a logarithmic scale there is no zero to stand on
        bars = ax.bar(at, ratios[i] - least, width, bottom=least, label=row["law"])
        ax.bar_label(bars, [f"{ratio:.3g}" for ratio in ratios[i]], padding=2)
    ax.set(yscale="log", ylim=(least, 4.0 * ratios.max()), ylabel=f"ratio to {rows[0]['law']} (less is better)")
    ax.set_xticks(np.arange(len(keys)), ["quadratic cost", "actuator effort", "spillover W_R"])
    ax.axhline(1.0, color=GREY, linewidth=0.8)
    ax.set_title(title)
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def plot_designs(rows: Sequence[dict[str, Any]], figures: dict[str, str], title: str) -> Figure:
    """Designs in rows, one panel a figure of merit, one mark an estimator; infinite values are at the edge.

    Args:
        rows: dicts with "law", "state" and every figure.
        figures: heading of each by its key; a key that ends in "share" is drawn from 0 to 1, the others on a log scale.
    """
    laws, states = (list(dict.fromkeys(row[key] for row in rows)) for key in ("law", "state"))
    figure, axes = new_figure(1, len(figures), width=12, height=1.4 + 0.75 * len(laws), sharey=True)
    for ax, (key, heading) in zip(axes, figures.items(), strict=True):
        most = max(row[key] for row in rows if row[key] is not None and np.isfinite(row[key]))
        for i, state in enumerate(states):
            own = [row for row in rows if row["state"] == state and row[key] is not None]
            at = np.array([laws.index(row["law"]) + 0.16 * (i - 0.5 * (len(states) - 1)) for row in own])
            values = np.array([row[key] for row in own], float)
            endless = np.isinf(values)
            values[endless] = 6.0 * most
            ax.plot(values, at, "o^sv"[i % 4], color=COLOURS[i], markersize=7, label=state)
            for x, y in zip(values[endless], at[endless]):
                ax.annotate("unstable  ", (x, y), ha="right", va="center", fontsize=8, color=COLOURS[i])
        if key.endswith("share"):
            ax.set(xlim=(-0.05, 1.05))
        else:
            ax.set(xscale="log")
            ax.xaxis.set_minor_formatter(NullFormatter())
        ax.set_xlabel(heading)
        for y in np.arange(len(laws) - 1) + 0.5:
            ax.axhline(y, color=GREY, linewidth=0.6)
    axes[0].set_yticks(range(len(laws)), laws)
    axes[0].set_ylim(len(laws) - 0.5, -0.5)
    axes[0].grid(axis="y", visible=False)
    figure.suptitle(title, x=0.01, ha="left", fontsize=12)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(states))
    return figure


def plot_spillover_paths(explained: Explanation) -> Figure:
    """Growth of each residual mode in the full closed loop, and the share of each path from sensor to actuator."""
    if not explained.shifts:
        return _without_residual_modes()
    figure, axes = new_figure(1, 2, width=11, height=4.5, width_ratios=[1, 1.2])
    moved = sorted(explained.shifts, key=lambda m: m.mode)
    numbers = [m.mode + 1 for m in moved]
    growth = np.array([m.closed_pole.real for m in moved])
    axes[0].bar(numbers, growth, color=[COLOURS[1] if g > 0 else COLOURS[0] for g in growth])
    before = [m.pole.real for m in moved]
    axes[0].plot(numbers, before, "_", color=COLOURS[6], markersize=16, mew=2, label="uncontrolled")
    axes[0].axhline(0.0, color=GREY, linewidth=0.8)
    axes[0].set(xlabel="residual mode", ylabel="growth rate Re λ [1/s]", xticks=few_ticks(numbers))
    axes[0].set_title("real part of residual poles (above 0: unstable)")
    axes[0].legend()
    worst = explained.shifts[0]
    labels = [f"sensor at {place_text(p.sensor_at)} → {p.actuator}" for p in worst.paths] + ["all paths"]
    shifts = np.array([p.shift.real for p in worst.paths] + [worst.shift.real])
    rows = np.arange(len(labels))[::-1]
    axes[1].barh(rows, shifts, color=[COLOURS[1] if s > 0 else COLOURS[0] for s in shifts])
    axes[1].axvline(0.0, color=GREY, linewidth=0.8)
    axes[1].set_yticks(rows, labels)
    axes[1].set(xlabel="contribution to Re λ [1/s]", title=f"which path shifts mode {worst.mode + 1}")
    return figure


def plot_sensor_counts(margins: dict[str, np.ndarray], counts: dict[str, int | None]) -> Figure:
    """Stability margin of the full plant against the number of sensors, one line an estimator."""
    figure, ax = new_figure(width=9, height=4.5)
    for (name, values), colour, mark in zip(margins.items(), COLOURS, "osD", strict=False):
        numbers = np.arange(1, len(values) + 1)
        there = np.isfinite(values)
        count = counts[name]
        label = f"{name}: stable from {count} sensors on" if count else f"{name}: unstable up to {len(values)}"
        ax.plot(numbers[there], values[there], mark + "-", color=colour, label=label, markersize=4)
    ax.axhline(0.0, color=GREY, linewidth=1.0)
    largest = max(v[np.isfinite(v)].max() for v in margins.values())
    ax.set_yscale("symlog", linthresh=max(largest, 1e-6))
    ax.set(xlabel="number of sensors, evenly spaced", ylabel="stability margin [1/s]; below zero unstable")
    ax.set_title("observation spillover: stability margin against the number of sensors")
    ax.legend()
    return figure


def plot_controlled_mode_count(found: dict[str, ControlledModeCount], share: float | None = None) -> Figure:
    """Energy left of each disturbance when the lowest n modes are controlled: in the others, and by spillover."""
    figure, axes = new_figure(1, len(found), width=11, height=4.5, sharey=True, squeeze=False)
    for ax, (name, result) in zip(axes[0], found.items(), strict=True):
        uncontrolled, spilled = result.uncontrolled / result.energy.sum(), result.spillover / result.energy.sum()
        ax.bar(result.counts, uncontrolled, color=COLOURS[0], label="in residual modes")
        ax.bar(result.counts, spilled, bottom=uncontrolled, color=COLOURS[1], label="spillover")
        if share is not None:
            ax.axhline(share, color=GREY, linestyle="--", label=f"{share:.0%} may be left")
        if result.recommended:
            label = f"recommended: {result.recommended} modes"
            ax.axvline(result.recommended, color=COLOURS[2], linewidth=6, alpha=0.35, label=label)
        ax.set(xlabel="controlled modes, n", xticks=result.counts, title=name)
        ax.legend()
    axes[0, 0].set_ylabel("share of the disturbance's energy left")
    return figure


def plot_placement_fronts(fronts: dict[str, Sequence[Placement]], rule: dict[str, Placement]) -> Figure:
    """Least spillover against effort for each disturbance, the rule of the nodes beside it, and the places taken."""
    figure, axes = new_figure(2, len(fronts), width=11, height=7, sharex=True, sharey="row", squeeze=False)
    for (name, front), (above, below) in zip(fronts.items(), axes.T, strict=True):
        effort = [p.effort for p in front]
        above.plot(effort, [p.residual_work for p in front], "o-", color=COLOURS[0], label="optimum at each effort")
        above.plot(
            rule[name].effort,
            rule[name].residual_work,
            "s",
            color=COLOURS[1],
            markersize=9,
            label="nodes of the next mode",
        )
        below.plot(effort, np.array([p.positions for p in front]), "o-", color=COLOURS[0], markersize=4)
        below.plot(np.full(rule[name].positions.size, rule[name].effort), rule[name].positions, "s", color=COLOURS[1])
        alone = np.ptp(effort) < 1e-3 * effort[0]
        above.set_title(f"{name}: one placement is best at any effort" if alone else name)
        above.set_ylim(bottom=0.0)
        above.legend()
        below.set(xlabel="effort ∫ FᵀF dt [N² s]")
    axes[0, 0].set_ylabel("spillover work W_R [J]")
    axes[1, 0].set_ylabel("places of the actuators [m]")
    return figure


def plot_scaling(times: dict[str, dict[int, float]], slopes: dict[str, float]) -> Figure:
    """Time to design against the number of modes, one line per method, each with its slope on the log-log scale."""
    figure, ax = new_figure(width=9, height=5)
    for (name, series), colour, mark in zip(times.items(), COLOURS, "osD^v", strict=False):
        label = f"{name}: slope {slopes[name]:.1f}"
        ax.loglog(list(series), list(series.values()), mark + "-", color=colour, label=label)
    ax.set(xlabel="number of modes", ylabel="time to design [s]", title="time to design: independent modes and coupled")
    ax.legend()
    return figure


def plot_robustness(scales: Sequence[float], shares: dict[str, Any], spreads: dict[str, Any]) -> Figure:
    """Share of perturbed models that stay stable, and median W_R with its 90 % interval, by the size of the errors."""
    figure, axes = new_figure(2, 1, width=9, height=7, sharex=True)
    for (name, values), colour, mark in zip(shares.items(), COLOURS, "osD^", strict=False):
        axes[0].semilogx(scales, values, mark + "-", color=colour, label=name)
        low, middle, high = np.array(spreads[name]).T
        axes[1].loglog(scales, middle, mark + "-", color=colour)
        axes[1].fill_between(scales, low, high, color=colour, alpha=0.15)
    axes[0].set(ylabel="share of perturbed models that stay stable", ylim=(-0.03, 1.05))
    axes[0].set_title("robustness to the errors of identification, and to larger ones")
    axes[0].legend(loc="lower left")
    axes[1].set(
        xlabel="errors, as multiples of the identified standard errors", ylabel="W_R [J], median and 90 % interval"
    )
    return figure


def plot_drift(rows: Sequence[dict[str, Any]]) -> Figure:
    """Frequencies identified in the loop over the nominal, and excess cost of the old law, as the stiffness drifts."""
    figure, axes = new_figure(1, 2, width=11, height=4.3)
    drift = [100 * (row["stiffness"] - 1) for row in rows]
    first = np.array(rows[0]["omega"])
    for r in range(first.size):
        axes[0].plot(drift, [row["omega"][r] / first[r] for row in rows], color=GREY, label="true" if r == 0 else None)
        found = [row["found"][r] / first[r] for row in rows]
        axes[0].plot(drift, found, "osD"[r % 3], color=COLOURS[r], label=f"mode {r + 1}, identified in the loop")
    axes[0].set(xlabel="drift of the stiffness [%]", ylabel="frequency / nominal frequency [-]")
    axes[0].legend()
    for key, label, mark in (
        ("cost_of_the_old_law", "nominal law", "o-"),
        ("cost_of_the_new_law", "redesigned law", "s-"),
    ):
        axes[1].plot(drift, [1e6 * row[key] for row in rows], mark, label=label)
    axes[1].set(xlabel="drift of the stiffness [%]", ylabel="cost above the least, parts per million")
    axes[1].legend()
    return figure


def plot_switching(law: OnOffLaw, switched: Switched) -> Figure:
    """The first controlled mode under on-off control: its path in the phase plane, and the force over time."""
    relay, stretches = law.relays[0], switched.stretches[0]
    response, r = switched.response, law.controlled[0]
    q, v = response.modal[r], response.modal[response.modes.n_modes + r]
    figure, axes = new_figure(1, 2, width=11, height=4.5)
    axes[0].plot(q, v, color=COLOURS[0], linewidth=1.0, label="motion")
    for stretch in stretches:
        if stretch.sliding:
            inside = (response.time >= stretch.start) & (response.time <= stretch.end)
            axes[0].plot(q[inside], v[inside], color=COLOURS[1], linewidth=3.5, label="sliding mode")
    reach = np.array([q.min(), q.max()])
    edges = [edge - relay.slope * reach for edge in (-relay.dead_band, relay.dead_band)]
    axes[0].fill_between(reach, *edges, color=GREY, alpha=0.25, label="dead band: no force")
    switches = np.array([(s.displacement, s.rate) for s in stretches[1:]]).reshape(-1, 2)
    axes[0].plot(*switches.T, ".", color=COLOURS[6], markersize=5, label="switches")
    handles, labels = axes[0].get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    axes[0].legend(once.values(), once.keys(), loc="lower left")
    axes[0].set(xlabel=f"q{r + 1} [m √kg]", ylabel=f"dq{r + 1}/dt [m √kg/s]", title=f"mode {r + 1} in the phase plane")
    pushes = np.zeros(response.time.size)
    for s in stretches:
        tau = response.time - s.start
        inside = (tau >= 0) & (response.time <= s.end)
        pushes[inside] = s.steady + s.ramp * tau[inside] + s.fading * np.exp(-relay.slope * tau[inside])
    axes[1].plot(response.time, pushes, color=COLOURS[0])
    axes[1].set(xlabel="time [s]", ylabel="modal force [N/√kg]", title="modal force (its mean in the sliding mode)")
    return figure


def plot_feedback_index(places: np.ndarray, index: np.ndarray, found: dict[int, FeedbackPlacement]) -> Figure:
    """Energy integral of one collocated pair by the place of its middle, and the best places of several pairs."""
    figure, axes = new_figure(2, 1, width=9, height=5.5, sharex=True, height_ratios=[3, 1.3])
    axes[0].plot(places, index, color=COLOURS[0], label="one pair")
    axes[1].set(xlabel="middle of the patch, x [m]", ylabel="pairs", yticks=list(found), ylim=(0.4, max(found) + 0.6))
    for (count, best), colour in zip(found.items(), COLOURS[1:], strict=False):
        axes[0].axhline(best.index, color=colour, linestyle="--", label=f"best of {count}: E = {best.index:.4f}")
        axes[1].plot(best.positions, np.full(best.positions.size, count), "s", color=colour, markersize=9)
    axes[0].set(ylabel="energy integral E [J s]", title="direct velocity feedback by collocated piezo pairs")
    axes[0].legend()
    return figure
