"""Figures of a diagnosis."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import NullLocator

from workbench.arrays import Floats
from workbench.draw.style import COLOURS, GREY, MODEL_COLOURS, RAISED, few_ticks, in_units, new_figure, plain_ticks
from workbench.gap.effects.effect import apply_all, label_in_words
from workbench.gap.effects.nonlinear import any_beyond
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.report.budget import Budget
from workbench.gap.report.verdict import Verdict
from workbench.records.record import Record
from workbench.records.units import Units
from workbench.rig.actuators import Actuator, force_unit
from workbench.rig.rig import Rig
from workbench.rig.simulate import simulate_record
from workbench.structure.domain import Between, Location, NamedPoints, Rectangle
from workbench.structure.printed import joined_in_words

MOST_BARS, FEW_BARS = 16, 6  # named points that are shown; sensors whose names fit horizontally
YELLOW = "#F0E442"  # of the same palette; a second grey is not to be told from the first on a dark page
SHOWN = 0.005  # least share of the gap that is drawn
BELOW = "log-likelihood below its maximum [-]"
STUB = 0.4  # of `ALIKE`, where the bars of named points begin
ALIKE = 0.1  # difference of log-likelihoods up to which places are drawn as equally likely
MAP_LEVELS = 13


def plot_responses(rigs: Mapping[str, Rig], records: Sequence[Record], *, time_unit: str = "s") -> Figure:
    """Measured and simulated responses by record, at the sensor and in the segment of the first rig's largest error."""
    records = list(records)[-3:]
    figure, axes = new_figure(len(records), 1, width=10, height=2.6 * len(records), squeeze=False)
    for ax, record in zip(axes[:, 0], records, strict=True):
        outputs = {name: simulate_record(rig, record) for name, rig in rigs.items()}
        spread = ((record.outputs - next(iter(outputs.values()))) / record.outputs.std(axis=1, keepdims=True)) ** 2
        j = int(spread.mean(axis=1).argmax())
        width = min(record.n_samples, 300)
        smooth = np.convolve(spread[j], np.ones(width), mode="valid")
        piece = slice(int(smooth.argmax()), int(smooth.argmax()) + width)
        channel, time = record.output_channels[j], record.time[piece]
        ax.plot(time, record.outputs[j, piece], color=COLOURS[6], label="measured", linewidth=5.0, alpha=0.35)
        for (name, values), other, style in zip(outputs.items(), (COLOURS[1], COLOURS[0]), ("--", "-")):
            colour = MODEL_COLOURS.get(name, other)
            ax.plot(time, values[j, piece], color=colour, label=name, linestyle=style, linewidth=1.4)
        ax.set(title=f"record {record.name}, sensor {channel.name}", ylabel=in_units(channel.quantity, channel.unit))
    axes[-1, 0].set_xlabel(f"time [{time_unit}]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure


def plot_gaps(gap: Mapping[str, Mapping[str, float]]) -> Figure:
    """The gap of each record before and after, beside the noise floor, the least gap of any model."""
    records = list(gap["before"])
    figure, ax = new_figure(width=9, height=3.5)
    for i, (name, colour) in enumerate(zip(("before", "after", "floor"), (COLOURS[1], COLOURS[0], GREY))):
        values = [gap[name].get(record) or np.nan for record in records]
        ax.bar(np.arange(len(records)) + 0.27 * (i - 1), values, 0.27, color=colour, label=name)
    ax.set_xticks(np.arange(len(records)), records)
    ax.set_xlim(-1.0, max(len(records), 3) - 0.5)
    ax.set(yscale="log", xlabel="record", ylabel="rms error / rms signal [-]", title="gap on the validation records")
    ax.legend()
    return figure


def plot_budget(budget: Budget) -> Figure:
    """The gap of each record, one bar split by cause; above 100 % if effects enlarge the gap."""
    causes = [label_in_words(label) for label in budget.effects]
    causes += ["errors of the nominal model", "unexplained", "noise of the logged inputs", "noise"]
    colours = [*(COLOURS[i % 5] for i in range(len(budget.effects))), COLOURS[5], COLOURS[6], YELLOW, GREY]
    records = list(budget.by_record)
    logged = np.array([budget.input_noise.get(record, 0.0) for record in records])
    *shares, nominal, unexplained, noise = np.array([*budget.by_record.values()], float).T
    shares += [nominal - logged, unexplained, logged, noise]
    figure, ax = new_figure(width=9, height=1.6 + 0.5 * len(records))
    left = np.zeros(len(records))
    for cause, colour, part in zip(causes, colours, shares, strict=True):
        share = 100.0 * np.maximum(part, 0.0)
        if share.max() > 0.05:
            ax.barh(records, share, left=left, color=colour, label=cause, height=0.6)
        left += share
    if left.max() > 100.0 * (1.0 + SHOWN):
        ax.axvline(100.0, color=GREY, linestyle="--", label="gap of the nominal model")
    ax.set(xlim=(0, max(100.0, left.max())), xlabel="share of the gap's power [%]")
    ax.set_title("what causes the gap of each record")
    ax.invert_yaxis()
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.35), ncols=3)
    return figure


def plot_where(verdict: Verdict) -> Figure:
    """The gap by mode, band, sensor, level and time, and the likelihood of each place of a force."""
    where = verdict.where
    figure, axes = new_figure(3, 2, width=10, height=9.2)
    (by_mode, by_octave), (by_sensor, by_level), (by_time, by_place) = axes
    _plot_modes(by_mode, verdict)
    tops = [f"{top:.3g}" if top < 1000.0 else f"{top:.0f}" for top in where.band_edges_hz[1:]]
    by_octave.bar(tops, 100 * where.band_shares, color=COLOURS[0])
    by_octave.set(title="by octave", ylabel="share of the gap's power [%]")
    by_octave.set_xlabel(verdict.units.named("upper edge of the band [Hz]"))
    names = [s.name for s in verdict.nominal.sensors]
    by_sensor.bar(names, 100 * where.sensor_shares, color=COLOURS[2])
    by_sensor.set(title="by sensor", ylabel="share of the gap's power [%]")
    by_sensor.tick_params(axis="x", rotation=90 if len(names) > FEW_BARS else 0)
    order = np.argsort(where.input_levels)
    by_level.plot(where.input_levels[order], where.record_gaps[order], "o-", color=COLOURS[1])
    by_level.margins(0.15)
    for i in order:
        at = (where.input_levels[i], where.record_gaps[i])
        by_level.annotate(where.record_names[i], at, (0, 6), textcoords="offset points", ha="center", fontsize=8)
    by_level.set(title="by record and level", ylabel="gap (rms error / rms signal) [-]")
    by_level.set_xlabel(f"rms of the inputs [{units_of_inputs(verdict.nominal.actuators, verdict.units)}]")
    by_level.set(xscale="log", yscale="log")
    by_time.imshow(100 * where.time_shares, aspect="auto", cmap="Blues", vmin=0.0, extent=(0, 8, len(order), 0))
    by_time.set(title="by time: darker is more of the record's gap", xlabel="eighth of the record")
    by_time.set_xticks(np.arange(8) + 0.5, np.arange(1, 9))
    by_time.set_yticks(np.arange(len(order)) + 0.5, where.record_names)
    by_time.grid(False)
    plain_ticks(figure)
    _plot_places(by_place, verdict)
    return figure


def units_of_inputs(actuators: Sequence[Actuator], units: Units) -> str:
    """The units of all commands, such as N and N m; "unit of the command" where an actuator has a gain."""
    named = [units.named(force_unit(a)) if a.gain == 1 else "unit of the command" for a in actuators]
    return joined_in_words([*dict.fromkeys(named)])


def _plot_modes(ax: Axes, verdict: Verdict) -> None:
    """Shares of the gap by mode; rigid modes, all of frequency zero, have one bar."""
    where, frequencies = verdict.where, verdict.nominal.modes.frequencies_hz
    rigid = int((frequencies == 0).sum())
    numbers = np.arange(rigid, frequencies.size) + 1
    shares = {str(r): share for r, share in zip(numbers, where.mode_shares[rigid:], strict=True)}
    if rigid:
        shares = {f"rigid, 1 to {rigid}" if rigid > 1 else "rigid, 1": float(where.mode_shares[:rigid].sum()), **shares}
    if where.share_above > SHOWN:
        shares["above"] = where.share_above
    bars = ax.bar(range(len(shares)), 100.0 * np.array([*shares.values()]), color=COLOURS[0])
    if where.share_above > SHOWN:
        bars[-1].set_color(GREY)
    shown = few_ticks(np.arange(len(shares)))
    ax.set_xticks(shown, [[*shares][i] for i in shown])
    ax.set(title="by mode: the band around each frequency", xlabel="mode", ylabel="share of the gap's power [%]")


def _plot_places(ax: Axes, verdict: Verdict) -> None:
    """By how much each place of one unmodelled force is less likely: a curve, a map, or bars at named points."""
    place = verdict.where.place
    if place.is_single_force is None:
        ax.set_axis_off()
        ax.text(0.5, 0.5, "no place of a force can be identified", ha="center", va="center", transform=ax.transAxes)
        return
    several = "no single point force explains all; best fit of one"
    ax.set(title="place of one unmodelled force" if place.is_single_force else several)
    domain = verdict.nominal.modes.domain
    if isinstance(domain, Rectangle):
        return _map(ax, verdict, domain)
    if isinstance(domain, NamedPoints):
        return _rank(ax, verdict)
    below, most = _below(place.profile)
    ax.plot(place.places, below, color=COLOURS[3])
    ax.axvline(place.at, color=GREY, linestyle=":", label="most likely position")
    acting, called = _acting(verdict)
    for i, at in enumerate(acting):
        ax.axvline(at, color=COLOURS[0], label="" if i else f"{called} effect")
    ax.set(xlabel=f"x [{verdict.units.length}]", ylabel=BELOW, yscale="log", ylim=(1.5 * most, ALIKE / 1.3))
    ax.set_yticks(*_decades(most))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.legend()


def _rank(ax: Axes, verdict: Verdict) -> None:
    """The likeliest named points with their difference in log-likelihood; places of named effects are marked."""
    place, separation = verdict.where.place, verdict.nominal.modes.domain.separation
    shown = [place.places[i] for i in np.argsort(-place.profile, kind="stable")[:MOST_BARS]]
    below, most = _below(place.profile)
    below = np.sort(below)[:MOST_BARS]
    acting, called = _acting(verdict)
    is_acting = [any(separation(at, other) == 0 for other in acting) for at in shown]
    colours = [COLOURS[0] if named else COLOURS[3] for named in is_acting]
    # from below the least difference that is drawn: the bars of points that fit alike are short, but seen
    ax.barh(range(len(shown)), below - STUB * ALIKE, left=STUB * ALIKE, height=0.6, color=colours)
    names = [_in_words(at) + f" ({called})" * named for at, named in zip(shown, is_acting, strict=True)]
    ax.set_yticks(range(len(shown)), names, fontsize=8)
    ax.invert_yaxis()
    ax.set(xscale="log", xlim=(STUB * ALIKE, 1.5 * most), xlabel=BELOW)
    ax.set_xticks(*_decades(most))
    ax.xaxis.set_minor_locator(NullLocator())
    for i in np.flatnonzero(below <= ALIKE):
        text = "equally likely" if i else "most likely"
        ax.annotate(text, (ALIKE, i), (6, 0), textcoords="offset points", va="center", fontsize=8)
    unseen = [_in_words(at) for at in acting if all(separation(at, other) > 0 for other in shown)]
    if unseen:
        label = f"{called}, not among these: {', '.join(unseen)}"
        ax.text(1.4 * most, 0, label, ha="right", va="center", fontsize=8)


def _acting(verdict: Verdict) -> tuple[list[Any], str]:
    """The places of the verdict's effects, and whether they are "named" or "best-fitting"."""
    acting = [e.at for e in verdict.effects if e.at is not None and e.kind.path in ("structure", "environment")]
    return acting, "named" if verdict.outcome == "explained" else "best-fitting"


def _map(ax: Axes, verdict: Verdict, domain: Rectangle) -> None:
    """The same over a rectangle, the likeliest place, and the places of named effects."""
    place = verdict.where.place
    x, y = np.array(place.places).T
    below, most = _below(place.profile)
    levels = np.geomspace(ALIKE, most, MAP_LEVELS)
    shades = ax.tricontourf(x, y, below, levels=levels, norm=LogNorm(ALIKE, most), cmap="Blues_r")
    bar = ax.figure.colorbar(shades, ax=ax, label=BELOW)
    bar.ax.invert_yaxis()
    bar.minorticks_off()
    ticks, labels = _decades(most)
    bar.set_ticks(list(ticks), labels=labels)
    acting, called = _acting(verdict)
    look: Any = {"clip_on": False, "zorder": 3, "path_effects": [withStroke(linewidth=4.5, foreground="white")]}
    ax.plot(*place.at, "+", color=COLOURS[6], markersize=9, markeredgewidth=2, label="most likely position", **look)
    look |= {"fillstyle": "none", "markersize": 14, "markeredgewidth": 2}  # around the likeliest, if it is there
    for i, at in enumerate(acting):
        ax.plot(*at, "o", color=COLOURS[1], label="" if i else f"{called} effect", **look)
    ax.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.2))
    a, b = domain.length
    m = verdict.units.length
    ax.set(xlabel=f"x [{m}]", ylabel=f"y [{m}]", xlim=(0.0, a), ylim=(0.0, b), aspect="equal")


def _below(profile: Floats) -> tuple[Floats, float]:
    """By how much each log-likelihood is below the largest, `ALIKE` or more; and the most of them, 10 or more."""
    below = np.maximum(profile.max() - profile, ALIKE)
    return below, max(float(below.max()), 10.0)


def _decades(most: float) -> tuple[Floats, list[str]]:
    """Powers of ten from `ALIKE` to `most`, seven or fewer, and their labels."""
    last = int(np.floor(np.log10(most)))
    ticks = np.asarray(ALIKE * 10.0 ** np.arange(0, last + 2, 1 + last // 6), float)
    numbers = [f"{tick:g}" if tick < 1e5 else f"10{str(round(np.log10(tick))).translate(RAISED)}" for tick in ticks]
    return ticks, [f"≤ {numbers[0]}", *numbers[1:]]


def _in_words(where: Location) -> str:
    return " to ".join(map(str, where)) if isinstance(where, Between) else str(where)


def plot_unmodelled_force(verdict: Verdict, *, length: str | None = None, force: str | None = None) -> Figure:
    """The unmodelled force at its place, with all other effects in the model, over displacement and velocity.

    Args:
        length, force: names of units; those of the verdict unless given.
    """
    units = verdict.units
    length, force = length or units.length, force or units.force
    reconstruction = verdict.attribution.reconstruction
    chosen = [e for e in verdict.effects if e.at is not None and e.kind.path == "structure"]
    beside = [e for e in verdict.effects if chosen and e is not chosen[0]]
    if beside:
        reconstruction = ForceReconstruction.of(apply_all(verdict.nominal, beside), verdict.attribution.search.data)
    place = reconstruction.place(chosen[0].at if chosen else verdict.where.at)
    figure, axes = new_figure(1, 2, width=10, height=3.8, sharey=True)
    there = verdict.nominal.modes.domain.text(place.at)
    there = there if isinstance(place.at, Between) else f"at {there}"
    step = max(1, place.force.size // 4000)
    for ax, name, unit in zip(axes, ("displacement", "velocity"), (length, f"{length}/{units.time}"), strict=True):
        series = getattr(place, name)
        ax.plot(series[::step], place.force[::step], ".", color=COLOURS[0], markersize=3, alpha=0.6)
        ax.set_xlabel(f"{name} {there} [{unit}]")
        law = chosen[0].kind.force_laws.get(name) if chosen else None
        if law is not None:  # it depends on this variable alone; beneath the points, which it would otherwise hide
            explains = verdict.outcome == "explained" or any_beyond(verdict.effects)
            label = "fitted law" if explains else "best-fitting law: it does not explain the gap"
            grid = np.linspace(series.min(), series.max(), 400)
            look = {"color": COLOURS[1], "linewidth": 5.0, "alpha": 0.6, "zorder": 1, "label": label}
            ax.plot(grid, law(chosen[0].values, grid), **look)
            ax.legend()
    axes[0].set(ylabel=f"unmodelled force [{force}]", title="unmodelled force, without an assumed law")
    return figure


def plot_single_effects(verdict: Verdict) -> Figure:
    """The residual of each effect alone, and of a law beyond the catalogue if one explains the gap.

    Where channels are exchanged, of each effect with that exchange.
    """
    best = verdict.attribution.best
    beyond = [best] if any_beyond(best.effects) else []
    singles = [*beyond, *verdict.attribution.singles[:8]]
    figure, ax = new_figure(1, 1, width=10, height=0.42 * len(singles) + 1.6)
    labels = [" + ".join(map(label_in_words, fit.labels)) for fit in singles]
    costs = [max(fit.cost, 1e-3) for fit in singles]
    chosen = {effect.label for effect in verdict.effects} if beyond or verdict.outcome == "explained" else set()
    colours = [COLOURS[0] if set(fit.labels) <= chosen and chosen else GREY for fit in singles]
    ax.barh(labels[::-1], costs[::-1], color=colours[::-1])
    ax.axvline(1.0, color=COLOURS[2], label="noise floor")
    ax.axvline(verdict.attribution.nominal_cost, color=COLOURS[1], linestyle="--", label="nominal")
    title = f"best fit of each effect {verdict.attribution.fitted_with}"
    ax.set(xscale="log", xlabel="mean square residual / noise power [-]", title=title)
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    return figure
