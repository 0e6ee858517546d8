"""Data quality: lost or wrong samples; channels that are dead, copied, clipped, upsampled or of no stated quantity."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Floats
from workbench.records.record import Record, as_records
from workbench.records.units import LIKELY, unknown_unit
from workbench.rig.sensors import MEASURED
from workbench.structure.printed import place_text


@dataclass(frozen=True)
class DataSettings:
    """Constants of the checks of a record."""

    min_values: int = 4  # distinct ones of a working sensor
    # A clipped signal has at least so many samples at the end of its range, and so many times those at the next value.
    # A rounded oscillation has at most 1 / (√2 - 1) = 2.4 times as many in its last step as in the one before.
    min_clipped_samples: int = 8
    min_clipped_ratio: float = 6.0
    # Likewise for inputs, whose impacts are short: rounded sines and pulses have more in 3 of a thousand.
    min_input_samples: int = 4
    min_input_ratio: float = 4.0
    turning_tolerance: float = 1e-6  # rounding between the neighbours of a sine's turning point, over the range
    max_repeated_share: float = 0.5  # of samples in the outer half of an input's range, above which it has levels
    step_tolerance: float = 1e-3  # deviation of rounded readings from multiples of the step, in steps
    min_changes: int = 16  # of an output, to detect the rate at which it was held
    max_hold_samples: int = 64  # an output that changes less often is at rest
    copy_tolerance: float = 1e-2  # difference between copies, relative to the standard deviation of the innovation
    predictor_order: int = 16  # samples that predict the next
    max_compared_samples: int = 20_000  # to detect copies
    noise_free_ratio: float = 1e-9  # innovation over the signal below which sensors of a single mode may be alike
    min_dropout_samples: int = 4  # consecutive equal ones; a turning point has fewer
    motion_samples: int = 32  # on either side of a dropout, which show the motion there
    line_tolerance: float = 1e-9  # rounding deviation of samples from a straight line, relative to the output's range
    min_motion_ratio: float = 100.0  # from sample to sample there, in resolutions of the output
    batch_size: int = 256  # outputs compared with all others at once: all pairs of 10,000 would take 800 MB
    n_parts: int = 50  # into which a record is divided, in the search for a burst of the residual
    min_part_samples: int = 10
    burst_parts: int = 3  # consecutive parts that hold the burst
    min_burst_share: float = 0.3  # of the residual energy, where noise has 0.06
    min_burst_ratio: float = 2.5  # of that share to the one expected from the motion


DATA = DataSettings()


@dataclass(frozen=True)
class DataFault:
    """A fault of a channel that would falsify an identification.

    Attributes:
        kind: "dead", "copied", "clipped", "upsampled" or "unstated".
        outputs: names of the faulty outputs; empty where an input is faulty.
        message: what, where, why it matters and the way out.
        until: time of the last faulty sample, s; None where the whole record is faulty.
        inputs: names of the faulty inputs.
    """

    kind: str
    outputs: tuple[str, ...]
    message: str
    until: float | None = None
    inputs: tuple[str, ...] = ()


def data_faults(record: Record) -> tuple[DataFault, ...]:
    """The faults of a record, empty where there are none.

    dead: an output takes fewer than four values, or is a straight line. copied: two outputs are the same up to scale
    and a constant, so that their noise would count twice. clipped: samples pile up at an end of an output's range.
    upsampled: an output was sampled at a lower rate and held, or interpolated linearly, so that it changes at every
    k-th sample only. unstated: an output has no quantity, while others measure motion. Faults of inputs are those of
    `input_faults`.
    """
    dead = list(_dead(record))
    names = {fault.outputs[0] for fault in dead}
    alive = [j for j, name in enumerate(record.output_names) if name not in names]
    of_outputs = (fault for test in (_copied, _clipped, _upsampled, _unstated) for fault in test(record, alive))
    return (*dead, *of_outputs, *input_faults(record))


def input_faults(record: Record) -> tuple[DataFault, ...]:
    """The faults of inputs, empty where there are none.

    clipped: samples pile up at an end of an input's range other than zero, its value at rest. A command may be limited
    on purpose, so that this is a remark and no error.
    """
    faults = []
    for channel, row in zip(record.input_channels, record.inputs, strict=True):
        piled = [a for a in _piled(row).values() if _piles_up(row, a, DATA.min_input_samples, DATA.min_input_ratio)]
        stops = [at for at in piled if row[at[0]] and not _has_levels(row, at)]
        if stops:
            ends, count = " and ".join(f"{row[at[0]]:g}" for at in stops), sum(at.size for at in stops)
            message = (
                f"input {channel.name!r} is clipped at {ends}, {count} samples: unless it was sent like that, the input"
                " beyond is lost, and modes, their masses above all, are wrong; measure with a larger range"
            )
            faults.append(DataFault("clipped", (), message, inputs=(channel.name,)))
    return tuple(faults)


def check_data_quality(record: Record) -> None:
    """Refuse a record whose outputs have a fault.

    Raises:
        ValueError: the first of `data_faults` that is one of outputs.
    """
    for fault in data_faults(record):
        if not fault.inputs:
            raise ValueError(f"record {record.name!r}: {fault.message}")


def check_outputs_move(records: Sequence[Record]) -> None:
    """Refuse an output that is constant in every record, of the same outputs, by a ValueError that names it."""
    for name, *rows in zip(records[0].output_names, *(record.outputs for record in records), strict=True):
        if not any(np.ptp(row) for row in rows):
            raise ValueError(f"output {name!r} stays at {rows[0][0]:g}: the sensor is dead; leave it out")


def of_same_sensors(records: Record | Sequence[Record]) -> list[Record]:
    """The records, or the one, as a list.

    Raises:
        ValueError: no records; records that differ in sample time or outputs, their quantities and places; one that is
            given twice.
    """
    records = as_records(records)
    if not records:
        raise ValueError("identification needs at least one record")
    first = records[0]
    for other in records[1:]:
        if other.output_names != first.output_names:
            raise ValueError(
                f"records identified together must have the same outputs; {first.name!r} has"
                f" {', '.join(first.output_names)} and {other.name!r} has {', '.join(other.output_names)}"
            )
        for one, another in zip(first.output_channels, other.output_channels, strict=True):
            places = place_text(one.at), place_text(another.at)
            if one.quantity != another.quantity or (all(places) and places[0] != places[1]):
                here, there = (
                    (channel.quantity or "no quantity") + (f" at {place}" if place else "")
                    for channel, place in zip((one, another), places, strict=True)
                )
                raise ValueError(
                    f"records identified together must have the same outputs; {one.name!r} measures {here} in"
                    f" {first.name!r} and {there} in {other.name!r}"
                )
        if abs(other.sample_time - first.sample_time) > 1e-9 * first.sample_time:
            raise ValueError(
                f"records {first.name!r} and {other.name!r} are sampled every {first.sample_time:g} s and"
                f" {other.sample_time:g} s; resample one of them"
            )
    for i, record in enumerate(records):
        for other in records[:i]:
            if other.input_names == record.input_names and record.repeats(other):
                raise ValueError(
                    f"records {other.name!r} and {record.name!r} hold the same measurement, which would count twice:"
                    " give it once"
                )
    return records


def dropouts(record: Record) -> tuple[tuple[str, float, int, str], ...]:
    """Dropouts: where an output is constant or linear in time amid motion, as after lost messages of a wireless sensor.

    A constant output at an end of its range is clipped instead.

    Returns:
        for each, sorted by output and time: name of the output, time of the first sample in s, number of samples, and
        "stays at one value" or "is linear in time".
    """
    result = []
    for name, row in zip(record.output_names, record.outputs, strict=True):
        rounding, ends = DATA.line_tolerance * np.ptp(row), (row.min(), row.max())
        resolution, taken, lost = 0.0, np.zeros(row.size, bool), []
        for order, how in ((1, "stays at one value"), (2, "is linear in time")):
            moves = np.abs(np.diff(row, order))
            still = np.flatnonzero(moves <= rounding)
            if still.size < DATA.min_dropout_samples - 1:
                continue
            resolution = resolution or max(np.diff(np.unique(row)).min(initial=np.inf), rounding)
            for run in np.split(still, np.flatnonzero(np.diff(still) > 1) + 1):
                if run.size < DATA.min_dropout_samples - 1:
                    continue
                first, last = int(run[0]), int(run[-1]) + order
                about = moves[max(first - DATA.motion_samples, 0) : first], moves[last : last + DATA.motion_samples]
                moving = min(float(np.median(part)) if part.size > 1 else 0.0 for part in about)
                moved = moving > DATA.min_motion_ratio * resolution
                if moved and row[first] not in ends and not taken[first : last + 1].any():
                    taken[first : last + 1] = True
                    lost.append((name, float(record.time[first]), last - first + 1, how))
        result += sorted(lost)
    return tuple(result)


def dropout_remark(record: Record, after: str, *, before: float = np.inf) -> tuple[str, ...]:
    """A remark on the dropouts of a record that begin before a time, s; empty where there are none.

    Its second sentence, `after`, is the consequence, and the way out.
    """
    early = [dropout for dropout in dropouts(record) if dropout[1] < before]
    if not early:
        return ()
    name, at, count, how = early[0]
    more = f" (and {len(early) - 1} more)" if len(early) > 1 else ""
    return (
        f"in record {record.name!r} output {name!r} {how} for {count} samples from {at:.6g} s on{more}: lost data?"
        f" {after}",
    )


def burst_remarks(records: Sequence[Record], residuals: Sequence[Floats], noise: Floats) -> tuple[str, ...]:
    """A remark on each record whose outputs lost samples, or most of whose residual lies within a short part.

    Where samples are lost, the state of the structure jumps, and the residual decays as its modes do. The residual of a
    nonlinear structure grows with its motion, up to the cube; that is no burst. Residuals (n_samples, n_outputs) are
    aligned with the last samples of each record, and have standard deviations `noise` (n_outputs,).
    """
    remarks: list[str] = []
    for record, residual in zip(records, residuals, strict=True):
        lost = dropout_remark(record, "Modes and changes are wrong by it; leave it out, or cut the record")
        remarks += lost or _burst(record, residual, noise)
    return tuple(remarks)


def _burst(record: Record, residual: Floats, noise: Floats) -> tuple[str, ...]:
    motion = record.outputs[:, -len(residual) :].T
    noise_free = noise < DATA.noise_free_ratio * motion.std(axis=0)
    if len(residual) < DATA.n_parts * DATA.min_part_samples or noise_free.all():
        return ()
    residual = residual / noise
    motion = (motion - motion.mean(axis=0)) / np.maximum(motion.std(axis=0), 1e-300)
    shares, moving = (np.array([np.vdot(p, p) for p in np.array_split(x, DATA.n_parts)]) for x in (residual, motion))
    together = np.ones(DATA.burst_parts)
    # noise in proportion to the motion, and cubic distortion
    expected = [np.convolve(moving**k / max((moving**k).sum(), 1e-300), together, "valid") for k in (1, 3)]
    shares = np.convolve(shares / max(shares.sum(), 1e-300), together, "valid")
    first = int(np.argmax(shares))
    least = max(DATA.min_burst_share, DATA.min_burst_ratio * max(each[first] for each in expected))
    # after an impact the motion itself is a burst
    if shares[first] < least or expected[0].max() > DATA.min_burst_share:
        return ()
    edges = np.array_split(record.time[-len(residual) :], DATA.n_parts)
    begins, ends = edges[first][0], edges[first + DATA.burst_parts - 1][-1]
    return (
        f"in record {record.name!r} {100 * shares[first]:.0f} % of the residual energy lies from {begins:.4g} to"
        f" {ends:.4g} s: lost or wrong samples, or an unmeasured impact? It may look like noise of the inputs, or like"
        " modes that change; leave that part out",
    )


def steps(record: Record) -> np.ndarray:
    """Quantisation step of each output, (n_outputs,); 0 where its readings, less a constant, are no multiples of one.

    Rounding is noise of a standard deviation of step/√12 at least, as long as the output moves by steps.
    """
    result = np.zeros(record.n_outputs)
    for j, row in enumerate(record.outputs):
        differences = np.diff(np.unique(row))
        step = float(differences.min(initial=np.inf))
        if np.isfinite(step) and np.abs(differences / step - np.round(differences / step)).max() < DATA.step_tolerance:
            result[j] = step
    return result


def _dead(record: Record) -> Iterator[DataFault]:
    for name, row in zip(record.output_names, record.outputs, strict=True):
        n_values = np.unique(row[:64]).size
        if n_values < DATA.min_values:  # most signals move within their first samples; the rest is not searched then
            n_values = np.unique(row).size
        if n_values >= DATA.min_values:
            if np.abs(row - np.linspace(row[0], row[-1], row.size)).max() < 1e-6 * abs(row[-1] - row[0]):
                message = f"output {name!r} is a straight line, a clock or a counter; leave it out"
                yield DataFault("dead", (name,), message)
        elif row.size >= DATA.min_values:
            several = f"takes {n_values} values only, {row.min():g} to {row.max():g}"
            what = several if n_values > 1 else f"stays at {row[0]:g}"
            yield DataFault("dead", (name,), f"output {name!r} {what}: the sensor is dead or too coarse; leave it out")


def _copied(record: Record, alive: list[int]) -> Iterator[DataFault]:
    if len(alive) < 2:
        return
    part = record.outputs[alive, : DATA.max_compared_samples]
    about = part - part.mean(axis=1, keepdims=True)
    size = np.sqrt((about**2).mean(axis=1))
    # Outputs that are at rest here are not compared.
    moving = size > 1e-12 * size.max()
    scaled = about[moving] / size[moving, None]
    names = [record.output_channels[j].name for j, moves in zip(alive, moving, strict=True) if moves]
    copies: set[int] = set()
    for first in range(0, len(scaled), DATA.batch_size):
        alike = scaled[first : first + DATA.batch_size] @ scaled[first:].T / part.shape[1]
        near = np.triu(np.abs(alike) > 1.0 - 1e-6, 1)
        for row in np.flatnonzero(near.any(axis=1)).tolist():
            i, others = first + row, np.flatnonzero(near[row])
            others = others[~np.isin(first + others, list(copies))]
            noise = 0.0 if i in copies or not others.size else _innovation_std(scaled[i])
            # Without noise, sensors of a single mode are the same up to scale.
            if noise <= DATA.noise_free_ratio:
                continue
            difference = scaled[i] - np.sign(alike[row, others])[:, None] * scaled[first + others]
            for j in (first + others[np.sqrt((difference**2).mean(axis=1)) < DATA.copy_tolerance * noise]).tolist():
                copies.add(j)
                message = (
                    f"outputs {names[i]!r} and {names[j]!r} are the same signal, its noise included, which would count"
                    " twice; leave one out"
                )
                yield DataFault("copied", (names[i], names[j]), message)


def _innovation_std(row: np.ndarray) -> float:
    """Standard deviation of the innovation of a signal: its linear prediction error from the samples before."""
    k = min(DATA.predictor_order, row.size // 4)
    if k == 0:
        return 0.0
    before = np.lib.stride_tricks.sliding_window_view(row, k)[:-1]
    return float(np.std(row[k:] - before @ np.linalg.lstsq(before, row[k:], rcond=None)[0]))


def _clipped(record: Record, alive: list[int]) -> Iterator[DataFault]:
    for j in alive:
        row, name = record.outputs[j], record.output_channels[j].name
        piled = _piled(row)
        limits = DATA.min_clipped_samples, DATA.min_clipped_ratio
        clear = [side for side, at in piled.items() if _piles_up(row, at, *limits)]
        if clear:
            # Where one end of the range is too small, so may be the other: two equal samples are enough there.
            at, last = piled[clear[0]], float(record.time[max(a[-1] for a in piled.values() if a.size > 1)])
            message = (
                f"output {name!r} is clipped {clear[0]} at {row[at[0]]:g}, {at.size} samples; up to {last:g} s motion"
                " beyond the range is lost and would be read as modes; begin later, or measure with a larger range"
            )
            yield DataFault("clipped", (name,), message, until=last)


def _piled(row: np.ndarray) -> dict[str, np.ndarray]:
    """Indices of samples at either end of a signal's range, without turning points of sines (equal on both sides)."""
    padded = np.pad(row, 1, constant_values=np.nan)
    before, after = padded[:-2], padded[2:]
    turns = (np.abs(before - after) <= DATA.turning_tolerance * np.ptp(row)) & (before != row)
    return {name: np.flatnonzero((row == end) & ~turns) for name, end in (("above", row.max()), ("below", row.min()))}


def _piles_up(row: np.ndarray, at: np.ndarray, least: int, ratio: float) -> bool:
    """Whether the samples `at` an end of a signal's range are many enough for clipping, and for those at the next."""
    if not least <= at.size < row.size:
        return False
    others = row[row != row[at[0]]]
    nearest = others[np.argmin(np.abs(others - row[at[0]]))]
    return bool(at.size > ratio * np.count_nonzero(others == nearest))


def _has_levels(row: np.ndarray, at: np.ndarray) -> bool:
    """Whether a signal is a sequence of constant levels, the highest of them at `at`: it repeats elsewhere too."""
    outer = row[1:] / row[at[0]] > 0.5
    outer &= row[1:] != row[at[0]]
    return not outer.any() or float(np.mean(np.diff(row)[outer] == 0)) > DATA.max_repeated_share


def _upsampled(record: Record, alive: list[int]) -> Iterator[DataFault]:
    for j in alive:
        row, name = record.outputs[j], record.output_channels[j].name
        for order, how in ((1, "held"), (2, "joined by straight lines")):
            moves = np.abs(np.diff(row, order))
            changes = np.flatnonzero(moves > 1e-9 * np.abs(row).max())
            every = int(np.gcd.reduce(np.diff(changes))) if changes.size >= DATA.min_changes else 1
            # An output that rests for long has changes that are far apart too, but few.
            if 1 < every <= DATA.max_hold_samples and changes.size > 0.5 * (np.ptp(changes) // every):
                message = (
                    f"output {name!r} changes once in {every} samples only: it was sampled at"
                    f" {record.sample_rate_hz / every:g} Hz and {how}, not at {record.sample_rate_hz:g} Hz; leave it"
                    " out, or bring all outputs to that rate"
                )
                yield DataFault("upsampled", (name,), message)
                break


def _unstated(record: Record, alive: list[int]) -> Iterator[DataFault]:
    channels = [record.output_channels[j] for j in alive]
    moving = [channel for channel in channels if channel.quantity in MEASURED]
    for channel in channels:
        if moving and not channel.quantity:
            stated, remedy = "states no quantity", f"state its unit in the file, as in '{channel.name} [m/s^2]'"
            if unit := unknown_unit(channel.name):
                stated = f"states the unit {unit}, which is not known"
                remedy = f"write its numbers in a known unit, one of {LIKELY}"
            message = (
                f"output {channel.name!r} {stated}, and {moving[0].name!r} measures {moving[0].quantity}: it would be"
                f" taken for a displacement; {remedy}, or leave it out"
            )
            yield DataFault("unstated", (channel.name,), message)
