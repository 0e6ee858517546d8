"""Figures of measured signals: over time, spectra, frequency response functions, distortion."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.signal import coherence, csd, welch

from workbench.arrays import Floats
from workbench.draw.style import COLOURS, GREY, envelope, in_units, new_figure
from workbench.identification.signal.distortion import Distortion
from workbench.identification.signal.frequency_responses import FrfEstimate
from workbench.records.frequency_responses import FrequencyResponses
from workbench.records.record import Channel, Record
from workbench.records.units import SI, Units

SEGMENT_SAMPLES = 4096  # at most
SHOWN = 1e-12  # least power that is drawn, over the largest
OUTPUTS_SHOWN = 4  # of a record, in a figure of its distortion
DISTORTION_LIMIT = 4.0  # highest frequency of a figure of distortion, over the highest excited line
SEGMENTS_IN_MEMORY = 256  # at once
SEGMENTS = 4  # of a record, at least
MOST_PANELS = 12
MOST_INPUTS = 6  # whose responses are drawn in one panel
MEASURED = 0.4  # opacity of measured responses under those of modes
# of the lines of one panel: the colours repeat after seven
DASHES = [*["-"] * len(COLOURS), *["--"] * (MOST_PANELS - len(COLOURS))]


def power_spectrum(values: np.ndarray, rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies, Hz, and power spectral density, (n_lines,) each, of a signal without its mean, by Welch's method.

    The segments have 4,096 samples, or a quarter of the signal, and overlap by half.
    """
    segment = _segment(values.size)
    step = segment - segment // 2
    n_segments, mean = (values.size - segment // 2) // step, values.mean()
    power = np.zeros(segment // 2 + 1)
    # in groups of segments: all segments of a long record take several times its memory
    for first in range(0, n_segments, SEGMENTS_IN_MEMORY):
        count = min(SEGMENTS_IN_MEMORY, n_segments - first)
        part = values[first * step : (first + count - 1) * step + segment] - mean
        lines, each = welch(part, rate_hz, nperseg=segment)
        power += count / n_segments * each
    return lines, power


def _segment(n_samples: int) -> int:
    return min(SEGMENT_SAMPLES, max(n_samples // SEGMENTS, 1))


def plot_record(record: Record) -> Figure:
    """Each signal over time, inputs first."""
    figure, panels = _panel_per_signal(record, height=1.3)
    for ax, channel, values, colour in panels:
        at = envelope(values)
        ax.plot(record.start_time + record.sample_time * at, values[at], color=colour, linewidth=0.9)
        ax.set_ylabel(in_units(channel.name, channel.unit), fontsize=8)
    panels[0][0].set_title(record.name)
    panels[-1][0].set_xlabel("time [s]")
    return figure


def plot_spectra(record: Record) -> Figure:
    """Power spectral density of each signal, inputs first, by Welch's method."""
    figure, panels = _panel_per_signal(record, height=1.6)
    for ax, channel, values, colour in panels:
        lines, power = power_spectrum(values, record.sample_rate_hz)
        if power[1:].max(initial=0.0) > 0:
            ax.semilogy(lines[1:], power[1:], color=colour, linewidth=0.9)
            ax.set_ylim(bottom=max(ax.get_ylim()[0], SHOWN * power[1:].max()))
        ax.set_ylabel(in_units(channel.name, f"({channel.unit})^2/Hz" if channel.unit else "1/Hz"), fontsize=8)
    panels[0][0].set_title("power spectral density")
    panels[-1][0].set_xlabel("frequency [Hz]")
    return figure


def _panel_per_signal(record: Record, *, height: float) -> tuple[Figure, list[tuple[Axes, Channel, Floats, str]]]:
    """A figure, and the axes, channel, samples and colour of each signal, inputs first."""
    channels, values = (*record.input_channels, *record.output_channels), (*record.inputs, *record.outputs)
    colours = [COLOURS[1]] * record.n_inputs + [COLOURS[0]] * record.n_outputs
    signals = [*zip(channels, values, colours)][:MOST_PANELS]
    figure, axes = new_figure(len(signals), 1, width=9, height=0.8 + height * len(signals), sharex=True, squeeze=False)
    return figure, [(ax, *signal) for ax, signal in zip(axes[:, 0], signals)]


def plot_frf_matrix(measured: FrequencyResponses, fitted: FrequencyResponses | None = None) -> Figure:
    """Magnitude and phase of each output's FRFs, all inputs in one panel; those of a fitted model are dashed."""
    channels = measured.output_channels[:MOST_PANELS]
    figure, axes = new_figure(len(channels), 2, width=10, height=0.8 + 1.6 * len(channels), sharex=True, squeeze=False)
    styles = [(measured, 0.9, "-", ""), *([(fitted, 1.2, "--", ", fitted")] if fitted else [])]
    for k, (drawn, width, dashes, suffix) in enumerate(styles):
        for (size, angle), values in zip(axes, drawn.values):
            for i, (reference, row) in enumerate(zip(drawn.references, values, strict=True)):
                how = {"color": COLOURS[(2 * i + k) % len(COLOURS)], "linewidth": width, "linestyle": dashes}
                seen = np.where(np.abs(row) > 0, row, np.nan)
                size.semilogy(drawn.frequencies_hz, np.abs(seen), label=f"{reference}{suffix}", **how)
                angle.plot(drawn.frequencies_hz, np.degrees(np.angle(seen)), **how)
    for (size, angle), channel in zip(axes, channels, strict=True):
        size.set_ylabel(in_units(f"|{channel.name}|", f"{channel.unit} per input" if channel.unit else ""), fontsize=8)
        angle.set(ylabel="phase [°]", ylim=(-190.0, 190.0), yticks=(-180, -90, 0, 90, 180))
    if fitted or len(measured.references) > 1:
        axes[0, 0].legend(fontsize=8)
    axes[0, 0].set_title("FRFs: magnitude")
    axes[0, 1].set_title("phase")
    for ax in axes[-1]:
        ax.set_xlabel("frequency [Hz]")
    return figure


def frequency_response(record: Record) -> FrequencyResponses:
    """The response of each output to the single input, H1 = S_uy / S_uu, by Welch's method; NaN where S_uu is small.

    Raises:
        ValueError: a record with no input, or several.
    """
    if record.n_inputs != 1:
        raise ValueError(f"a frequency response by H1 needs one input; record {record.name!r} has {record.n_inputs}")
    rate, segment = record.sample_rate_hz, _segment(record.n_samples)
    u = record.inputs[0] - record.inputs[0].mean()
    lines, power = welch(u, rate, nperseg=segment)
    values = np.full((record.n_outputs, 1, lines.size), complex(np.nan, np.nan))
    for response, row in zip(values[:, 0], record.outputs, strict=True):
        cross = csd(u, row - row.mean(), rate, nperseg=segment)[1]
        np.divide(cross, power, out=response, where=power > SHOWN * power.max())
    return FrequencyResponses(values[..., 1:], lines[1:], record.output_channels, record.input_names, name=record.name)


def plot_coherence(record: Record) -> Figure:
    """Coherence of each output with the single input."""
    figure, ax = new_figure(width=9, height=2.4)
    _coherence(ax, record)
    ax.legend(ncols=4, fontsize=8)
    return figure


def _coherence(ax: Axes, record: Record) -> None:
    rate, segment = record.sample_rate_hz, _segment(record.n_samples)
    u = record.inputs[0] - record.inputs[0].mean()
    for (channel, row), dashes in zip(zip(record.output_channels, record.outputs, strict=True), DASHES, strict=False):
        lines, found = coherence(u, row - row.mean(), rate, nperseg=segment)
        ax.plot(lines[1:], found[1:], linewidth=0.9, linestyle=dashes, label=channel.name)
    ax.set(xlabel="frequency [Hz]", ylabel="coherence [-]", ylim=(0.0, 1.05))


def plot_frf(record: Record) -> Figure:
    """Frequency response of each output to the single input, H1 = S_uy / S_uu, and its coherence."""
    found = frequency_response(record)
    figure, axes = new_figure(2, 1, width=9, height=5.5, sharex=True, height_ratios=(3, 1))
    for channel, row, dashes in zip(found.output_channels, found.values[:, 0], DASHES, strict=False):
        axes[0].semilogy(found.frequencies_hz, np.abs(row), linewidth=0.9, linestyle=dashes, label=channel.name)
    _coherence(axes[1], record)
    (force,), units = record.input_channels, {channel.unit for channel in record.output_channels}
    label = in_units(f"|output / {force.name}|", _per_input(units.pop() if len(units) == 1 else "", [force.unit]))
    axes[0].set(ylabel=label, title="frequency response (H1)")
    axes[0].legend(ncols=4, fontsize=8)
    return figure


def plot_frf_of_inputs(found: FrfEstimate, fitted: FrequencyResponses | None = None) -> Figure:
    """Frequency responses to several inputs, a panel per output and a line per input, and the multiple coherence.

    Those of the identified modes, at any frequencies, are dashed.
    """
    measured, same = found.frf, len(set(found.units)) == 1
    named = [name if same or not unit else f"{name} [{unit}]" for name, unit in zip(measured.references, found.units)]
    channels, n = measured.output_channels, len(measured.output_channels)
    figure, axes = new_figure(n + 1, 1, width=9, height=2.0 + 2.1 * n, sharex=True, height_ratios=[3] * n + [2])
    for j, (ax, channel) in enumerate(zip(axes, channels)):
        for name, row, colour in zip(named[:MOST_INPUTS], measured.values[j], COLOURS):
            faint = {"alpha": MEASURED, "linewidth": 1.2} if fitted is not None else {"linewidth": 0.9}
            ax.semilogy(measured.frequencies_hz, _nonzero(row), color=colour, label=name, **faint)
        for name, colour in zip(measured.references[:MOST_INPUTS] if fitted is not None else (), COLOURS):
            if fitted is not None and name in fitted.references:
                row = fitted.values[fitted.output_names.index(channel.name), fitted.references.index(name)]
                look = {"color": colour, "linestyle": "--", "linewidth": 1.4}
                ax.semilogy(fitted.frequencies_hz, _nonzero(row), label=f"{name}, modes", **look)
        drawn = _nonzero(measured.values[j, :MOST_INPUTS])
        if np.isfinite(drawn).any():  # single lines of noise, and zeros of a model, may be far lower
            highest = [np.nanmax(drawn), _peak(fitted, channel.name)]
            ax.set_ylim(0.3 * np.nanquantile(drawn, 0.005), 3.0 * np.nanmax(highest))
        ax.set_ylabel(in_units(f"|{channel.name} / input|", _per_input(channel.unit, found.units)))
    colours = COLOURS[3:] + COLOURS[:3]  # of outputs: those above are of inputs
    for channel, row, colour in zip(channels, found.coherence, colours):
        axes[-1].plot(measured.frequencies_hz, row, linewidth=0.9, color=colour, label=channel.name)
    axes[-1].set(xlabel="frequency [Hz]", ylabel="coherence [-]", ylim=(0.0, 1.05))
    axes[0].set_title("frequency responses (H1), to each input")
    axes[-1].set_title("multiple coherence of each output")
    for ax in (axes[0], axes[-1]):
        ax.legend(ncols=6, fontsize=8)
    return figure


def _nonzero(row: np.ndarray) -> Floats:
    """Magnitudes, NaN for zeros, which a logarithmic axis cannot show."""
    return np.where(np.abs(row) > 0, np.abs(row), np.nan)


def _peak(fitted: FrequencyResponses | None, output: str) -> float:
    """The largest magnitude to an output; NaN without any."""
    return np.nan if fitted is None else float(np.abs(fitted.values[fitted.output_names.index(output)]).max())


def _per_input(unit: str, of_inputs: Sequence[str]) -> str:
    """The unit of an output over that of inputs; "" where one is unknown."""
    if not unit or "" in of_inputs:
        return ""
    top, over = (f"({part})" if "/" in part or " " in part else part for part in (unit, of_inputs[0]))
    return f"{top}/{over}" if len(set(of_inputs)) == 1 else f"{unit} per unit of input"


def plot_distortion(distortions: Sequence[Distortion], units: Units = SI) -> Figure:
    """Excited lines, odd and even lines that are not excited, and noise; a column per record, a row per output."""
    rows = distortions[0].channels[:OUTPUTS_SHOWN]
    shared = {"sharex": True, "sharey": "row", "squeeze": False}
    figure, axes = new_figure(len(rows), len(distortions), width=10, height=1.0 + 2.3 * len(rows), **shared)
    for column, found in zip(axes.T, distortions, strict=True):
        shown = found.frequencies_hz < DISTORTION_LIMIT * found.frequencies_hz[found.excited].max()
        lines = {"excited": found.excited, "odd, not excited": found.odd, "even, not excited": found.even}
        for j, ax in enumerate(column):
            for (label, kind), colour in zip(lines.items(), COLOURS, strict=False):
                at, size = found.frequencies_hz[shown & kind], found.amplitudes[j, shown & kind]
                if at.size:
                    ax.semilogy(at, size, ".", color=colour, markersize=3, label=label)
            ax.semilogy(found.frequencies_hz[shown], found.noise[j, shown], color=GREY, linewidth=0.8, label="noise")
        column[0].set_title(found.name)
        column[-1].set_xlabel(f"frequency [{units.named('Hz')}]")
    for ax, channel in zip(axes[:, 0], rows, strict=True):
        ax.set_ylabel(in_units(channel.name, channel.unit and f"{channel.unit} rms"))
    lowest = min(float(np.median(found.noise[found.noise > 0])) for found in distortions if (found.noise > 0).any())
    for ax in axes.flat:
        ax.set_ylim(bottom=max(ax.get_ylim()[0], 0.05 * lowest))
    axes[0, -1].legend(fontsize=8, markerscale=3)
    return figure
