"""The report of `workbench look` on a measured file: channels, levels, spectra, faults, and the next command."""

import csv
import io
import re
import shlex
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.fft import rfft
from scipy.ndimage import median_filter
from scipy.signal import find_peaks

from workbench.draw.plot import plot
from workbench.draw.signals import SEGMENTS, plot_frf, plot_frf_matrix, plot_spectra, power_spectrum
from workbench.identification.free_decay.preparation import decay_start, decays
from workbench.identification.signal.data_quality import DataFault, data_faults, input_faults
from workbench.records.frequency_responses import FrequencyResponses
from workbench.records.record import Channel, Record
from workbench.structure.printed import counted
from workbench.study.pages.inputs_at_once import responses_to_inputs
from workbench.study.pages.page import PageContent, block

HEADINGS = ("channel", "quantity", "min", "max", "mean", "std", "spectral peaks [Hz]")
FORCES = re.compile(r"force|hammer|shaker|impulse|excit|input|drive|(^|[^a-z])[fu]\d*$", re.IGNORECASE)
MOTIONS = re.compile(r"acc|beschl|vib|disp|veloc|geschw|(^|[^a-z])weg", re.IGNORECASE)
PEAKS = 4  # per channel
PROMINENT, SURROUNDINGS = 20.0, 8  # a peak's power over the median of 1/8 of all lines around the peak
ABOVE = 1e-3  # of the mean power of an input: the power in the last tenth below Nyquist, behind an anti-alias filter
MOST_ROWS = 100  # of the table
QUIET = 1e-4  # rms over the median of its quantity: a sensor of so little, without a peak, may be dead
MOST_FAULTS = 24  # messages per kind of fault; further faults are counted


@dataclass(frozen=True)
class FileReport:
    """The report of a measured file.

    Attributes:
        heading: number of channels and samples, sample rate, length.
        rows: one per channel, under `HEADINGS`.
        remarks: faults of the data and other remarks.
        command: the suggested next command.
    """

    heading: str
    rows: tuple[tuple[str, ...], ...]
    remarks: tuple[str, ...]
    command: str
    page_content: PageContent


# heading, rows, remarks, options of `workbench identify`, and blocks of the page
Parts = tuple[str, list[tuple[str, ...]], Sequence[str], list[str], list[dict[str, Any]]]


def file_report(measured: Record | FrequencyResponses, path: Path) -> FileReport:
    """The report of a record or of FRFs read from `path`."""
    parts = _frfs(measured) if isinstance(measured, FrequencyResponses) else _record(measured)
    heading, rows, remarks, options, blocks = parts
    command = shlex.join(["workbench", "identify", str(path), *options])
    page_content = PageContent(
        title=f"What {path.name} holds",
        lead=heading,
        lines=[*remarks, f"Go on with: {command}"],
        blocks=blocks,
        tables=[("Channels", HEADINGS, rows)],
        made_by=f"workbench look {path}",
    )
    return FileReport(heading, tuple(rows), tuple(remarks), command, page_content)


def _record(record: Record) -> Parts:
    faults = [fault for fault in data_faults(record) if not fault.inputs]
    faulty = {name for fault in faults for name in fault.outputs[-1:] if fault.kind in ("dead", "copied")}
    by_unit = [c.name for c in record.output_channels if c.quantity == "force"]
    doubtful = [name for name in by_unit if MOTIONS.search(name) and not FORCES.search(name)]
    applied = {c.name for c in record.output_channels if c.quantity == "force" or FORCES.search(c.name)} - faulty
    applied -= set(doubtful)
    forces = [] if record.n_inputs else [name for name in record.output_names if name in applied]
    # constant segments are no fault of a force: it may be zero for long, or held from sample to sample
    faults = [fault for fault in faults if fault.outputs[-1] not in forces]
    faulty |= {fault.outputs[-1] for fault in faults if fault.kind == "unstated"}
    kept = [name for name in record.output_names if name not in faulty | set(forces)]
    if forces and kept:
        record = record.with_inputs(forces)
    channels = (*record.input_channels, *record.output_channels)
    shown = [*zip(channels, (*record.inputs, *record.outputs), strict=True)][:MOST_ROWS]
    rows = [_row(channel, row, record.sample_rate_hz) for channel, row in shown]
    heading = (
        f"{counted(record.n_outputs, 'output')} and {counted(record.n_inputs, 'input')}, {record.n_samples} samples at"
        f" {record.sample_rate_hz:.6g} Hz, {record.n_samples * record.sample_time:.6g} s from"
        f" {record.start_time:.6g} s on"
    )
    quiet = _quiet(record.select_outputs(kept)) if kept else []
    remarks = [*record.remarks, *_messages([*faults, *quiet, *input_faults(record)])]
    if doubtful:
        remarks.append(f"{', '.join(doubtful)}: motions by name and forces by unit, so no inputs; does N mean north?")
    if len(channels) > MOST_ROWS:
        remarks.append(f"the first {MOST_ROWS} of {len(channels)} channels are shown")
    unstated = [channel.name for channel, _ in shown if not channel.quantity]
    if unstated:
        remarks.append(f"the file states no quantity for {', '.join(unstated)}: their units are as recorded")
    options, more = _options(record, forces, kept, faulty)
    remarks += more
    moving = record
    if kept or forces:
        moving = record.select_outputs([name for name in record.output_names if name not in faulty])
    driven = moving.n_inputs == 1 and bool(np.ptp(moving.inputs)) and moving.n_samples >= 16 * SEGMENTS
    at_once, why_not = responses_to_inputs([moving]) if moving.n_inputs > 1 and moving.n_outputs else ([], "")
    blocks = [
        block(plot(record), "The signals as recorded."),
        block(plot_spectra(moving), f"Power spectral density, by Welch's method. {why_not}".rstrip()),
        *([block(plot_frf(moving), "Frequency response functions and coherence.")] if driven else []),
        *at_once,
    ]
    return heading, rows, remarks, options, blocks


def _options(
    record: Record, forces: Sequence[str], kept: Sequence[str], faulty: Set[str]
) -> tuple[list[str], list[str]]:
    """The options of `workbench identify` for a record, and remarks on them."""
    options, remarks = [], []
    if forces or record.n_inputs:
        options += ["--inputs", _listed(forces or record.input_names)]
    else:
        free = bool(kept) and decays(record.select_outputs(kept))
        start = decay_start(record.select_outputs(kept)) if free else record.start_time
        if start > record.start_time:
            remarks.append(f"the free decay begins at {start:.6g} s")
        options += [] if free else ["--ambient"]
    if forces:
        remarks.append(f"{', '.join(forces)}: taken as input by name or unit; leave --inputs out if this is wrong")
    if forces and kept and _is_band_limited(record):
        options += ["--input-hold", "band-limited"]
    if faulty and kept:
        options += ["--outputs", _listed(kept)]
    return options, remarks


def _messages(faults: Sequence[DataFault]) -> list[str]:
    """The messages of faults; of each kind at most `MOST_FAULTS`, then the number of the others."""
    messages = []
    for kind in dict.fromkeys(fault.kind for fault in faults):
        each = [fault.message for fault in faults if fault.kind == kind]
        more = f"{len(each) - MOST_FAULTS} more channels are {kind}"
        messages += [*each[:MOST_FAULTS], more] if len(each) > MOST_FAULTS else each
    return messages


def _quiet(record: Record) -> list[DataFault]:
    """Outputs that may be dead: their rms is next to nothing beside those of their quantity, and they have no peak."""
    quantities, rms = np.array([channel.quantity for channel in record.output_channels]), record.outputs.std(axis=1)
    faults = []
    for quantity in np.unique(quantities) if record.n_samples >= 16 * SEGMENTS else ():
        at = np.flatnonzero(quantities == quantity)
        median = float(np.median(rms[at]))
        for j in at[rms[at] < QUIET * median]:
            if not _strongest(*power_spectrum(record.outputs[j], record.sample_rate_hz)):
                name = record.output_names[j]
                message = (
                    f"output {name!r} has {rms[j]:.2g} rms and no spectral peak, beside {median:.3g} rms, the median of"
                    f" the outputs of {quantity or 'unstated'} quantity: the sensor may be dead; check it"
                )
                faults.append(DataFault("quiet", (name,), message))
    return faults


def _frfs(measured: FrequencyResponses) -> Parts:
    lines = measured.frequencies_hz
    rows = []
    for channel, row in zip(measured.output_channels, np.abs(measured.values), strict=True):
        at = ", ".join(f"{f:.5g}" for f in _strongest(lines, row.max(axis=0) ** 2))
        rms = float(np.sqrt((row**2).mean()))
        rows.append((channel.name, "magnitude", *(f"{v:.4g}" for v in (row.min(), row.max(), row.mean(), rms)), at))
    n, m = len(measured.output_channels), len(measured.references)
    heading = (
        f"FRFs of {counted(n, 'output')} and {counted(m, 'input')}, {lines.size} lines from"
        f" {lines[0]:.6g} to {lines[-1]:.6g} Hz"
    )
    return heading, rows, measured.remarks, [], [block(plot_frf_matrix(measured), "Magnitude and phase of the FRFs.")]


def _row(channel: Channel, row: np.ndarray, rate_hz: float) -> tuple[str, ...]:
    quantity = (channel.quantity or "not stated") + (f" [{channel.unit}]" if channel.unit else "")
    numbers = (f"{value:.4g}" for value in (row.min(), row.max(), row.mean(), row.std()))
    peaks = _strongest(*power_spectrum(row, rate_hz)) if row.size >= 16 * SEGMENTS else ()
    return channel.name, quantity, *numbers, ", ".join(f"{f:.4g}" for f in peaks)


def _strongest(lines: np.ndarray, power: np.ndarray) -> Sequence[float]:
    """Frequencies of the highest prominent peaks, in rising order."""
    if lines.size < 3 or not power.max() > 0:
        return []
    about = median_filter(power, size=max(lines.size // SURROUNDINGS, 3), mode="nearest")
    peaks, _ = find_peaks(power)
    peaks = peaks[power[peaks] > PROMINENT * about[peaks]]
    best = peaks[np.argsort(-power[peaks])[:PEAKS]]
    return sorted(float(lines[i]) for i in best)


def _is_band_limited(record: Record) -> bool:
    """Whether the inputs are measured forces without content near the Nyquist frequency.

    No converter holds what a force sensor reads from sample to sample, as it does a command.
    """
    if any(channel.quantity != "force" for channel in record.input_channels):
        return False
    # of the whole record: windows would hide a blow at its beginning
    powers = (np.abs(rfft(row - row.mean())) ** 2 for row in record.inputs)
    return all(power[-(power.size // 10 + 1) :].mean() < ABOVE * power.mean() for power in powers)


def _listed(names: Sequence[str]) -> str:
    """Names for an option, separated by commas; one that holds a comma in double quotes."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(names)
    return text.getvalue()
