"""Data quality: lost samples; faulty channels, dead, copied, clipped, upsampled or of no stated quantity."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from workbench.records.record import Record, as_records
from workbench.rig.sensors import MEASURED


@dataclass(frozen=True)
class DataSettings:
    """Constants of the checks of a record."""

    fewest_values: int = 4  # that a sensor which moves takes
    # samples piled up at the end of a range: so many, and so many times those of the next value. An oscillation that
    # turns back of itself has at most 1 / (√2 - 1) = 2.4 times as many in its last step as in the one before
    least_piled: int = 8
    piled: float = 6.0
    # likewise of an input, of which a blow has few: sines and pulses that are rounded have more in 3 of a thousand
    least_piled_input: int = 4
    piled_input: float = 4.0
    turning: float = 1e-6  # of a signal's range, by which samples beside a turning point of a sine differ by rounding
    held: float = 0.5  # of an input's samples in the outer half of its range, that repeat: from there on it has levels
    whole: float = 1e-3  # of a step, by which readings that are rounded to it lie off its multiples
    fewest_changes: int = 16  # of an output, from which a rate at which it was held can be read
    slowest: int = 64  # samples between changes: what changes less often rests
    copied: float = 1e-2  # of the innovation, what its past does not predict: signals that differ by less are one
    predictor_order: int = 16  # samples that predict the next
    longest: int = 20_000  # samples in which copies are looked for
    noise_free: float = 1e-9  # innovation over the signal: below, sensors of one mode are alike without being copies
    fewest_equal: int = 4  # samples in a row: of so many a lost message is told from a turning point
    about: int = 32  # samples on either side of them, which show how the output moves
    straight: float = 1e-9  # of the range of an output, by which samples on a straight line lie off it by rounding
    moves: float = 100.0  # resolutions of the output that it moves there from sample to sample
    block: int = 256  # outputs compared with all others at once: all pairs of 10,000 would take 800 MB


DATA = DataSettings()


@dataclass(frozen=True)
class DataFault:
    """Something in a record that would make identification wrong.

    Attributes:
        kind: "dead", "copied", "clipped", "upsampled" or "unstated".
        outputs: names of those that have it; none where an input does.
        message: what, where, why it matters and the way out.
        until: the last time it touches, s; None where it is all through.
        inputs: names of those that have it.
    """

    kind: str
    outputs: tuple[str, ...]
    message: str
    until: float | None = None
    inputs: tuple[str, ...] = ()


def data_faults(record: Record) -> tuple[DataFault, ...]:
    """The faults of a record, empty where there are none.

    dead: an output takes fewer than four values, or is a straight line. copied: two outputs are the same but for scale
    and a constant, so that their noise would count as two. clipped: samples pile up at an end of an output's range.
    upsampled: an output changes at every k-th sample only, because it was sampled at another rate and held, or joined
    by straight lines. unstated: an output has no quantity, and others measure motion. Inputs are looked at by
    `input_faults`.
    """
    dead = list(_dead(record))
    names = {fault.outputs[0] for fault in dead}
    alive = [j for j, name in enumerate(record.output_names) if name not in names]
    found = _copied(record, alive), _clipped(record, alive), _upsampled(record, alive), _unstated(record, alive)
    return (*dead, *(fault for faults in found for fault in faults), *input_faults(record))


def input_faults(record: Record) -> tuple[DataFault, ...]:
    """The faults of inputs, empty where there are none.

    clipped: samples pile up at an end of an input's range that is not zero, where it rests. One that was sent like that
    is right as it is, so that it is said, and not refused.
    """
    found = []
    for channel, row in zip(record.input_channels, record.inputs, strict=True):
        stops = [
            at
            for at in _piled(row).values()
            if at.size
            and row[at[0]]
            and _ends(row, at, DATA.least_piled_input, DATA.piled_input)
            and not _has_levels(row, at)
        ]
        if stops:
            ends, count = " and ".join(f"{row[at[0]]:g}" for at in stops), sum(at.size for at in stops)
            found.append(
                DataFault(
                    "clipped",
                    (),
                    f"input {channel.name!r} is clipped at {ends}, {count} samples: unless it was sent like that, what"
                    " acted beyond is lost, and modes, their masses above all, are wrong; measure with a larger range",
                    inputs=(channel.name,),
                )
            )
    return tuple(found)


def check_data_quality(record: Record) -> None:
    """Refuse a record whose outputs have a fault.

    Raises:
        ValueError: the first of `data_faults` that is one of outputs.
    """
    for fault in data_faults(record):
        if fault.inputs:
            continue
        raise ValueError(f"record {record.name!r}: {fault.message}")


def of_same_sensors(records: Record | Sequence[Record]) -> list[Record]:
    """The records, or the one, as a list.

    Raises:
        ValueError: no records, records that differ in outputs or sample time, and one that is given twice.
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
        if abs(other.sample_time - first.sample_time) > 1e-9 * first.sample_time:
            raise ValueError(
                f"records {first.name!r} and {other.name!r} are sampled every {first.sample_time:g} s and"
                f" {other.sample_time:g} s; resample one of them"
            )
    for i, record in enumerate(records):
        for other in records[:i]:
            alike = other.input_names == record.input_names and np.array_equal(other.outputs, record.outputs)
            if alike and np.array_equal(other.inputs, record.inputs):
                raise ValueError(
                    f"records {other.name!r} and {record.name!r} hold the same measurement, which would count twice:"
                    " give it once"
                )
    return records


def dropouts(record: Record) -> tuple[tuple[str, float, int, str], ...]:
    """Where an output stays at one value or runs straight amid motion, as lost messages of a wireless sensor leave it.

    At an end of its range an output is clipped, and that is another fault.

    Returns:
        name of the output, time of the first such sample in s, number of samples, and what it does there; in order of
        outputs and time.
    """
    found = []
    for name, row in zip(record.output_names, record.outputs, strict=True):
        rounding, ends = DATA.straight * np.ptp(row), (row.min(), row.max())
        resolution, taken, lost = 0.0, np.zeros(row.size, bool), []
        for order, how in ((1, "stays at one value"), (2, "runs straight")):
            moves = np.abs(np.diff(row, order))
            still = np.flatnonzero(moves <= rounding)
            if still.size < DATA.fewest_equal - 1:
                continue
            resolution = resolution or max(np.diff(np.unique(row)).min(initial=np.inf), rounding)
            for run in np.split(still, np.flatnonzero(np.diff(still) > 1) + 1):
                if run.size < DATA.fewest_equal - 1:
                    continue
                first, last = int(run[0]), int(run[-1]) + order
                about = moves[max(first - DATA.about, 0) : first], moves[last : last + DATA.about]
                moving = min(float(np.median(part)) if part.size > 1 else 0.0 for part in about)
                if moving > DATA.moves * resolution and row[first] not in ends and not taken[first : last + 1].any():
                    taken[first : last + 1] = True
                    lost.append((name, float(record.time[first]), last - first + 1, how))
        found += sorted(lost)
    return tuple(found)


def dropout_remark(record: Record, after: str, *, before: float = np.inf) -> tuple[str, ...]:
    """A remark where outputs stay at one value, or run straight, amid motion; empty where none does.

    Args:
        record: looked at.
        after: what follows from it, and the way out.
        before: s, what begins later does not count.
    """
    found = [lost for lost in dropouts(record) if lost[1] < before]
    if not found:
        return ()
    name, at, count, how = found[0]
    more = f" (and {len(found) - 1} more like that)" if len(found) > 1 else ""
    return (
        f"in record {record.name!r} output {name!r} {how} for {count} samples from {at:.6g} s on{more}: lost data?"
        f" {after}",
    )


def steps(record: Record) -> np.ndarray:
    """The step that the readings of each output are whole multiples of, apart from a constant, (n_outputs,); 0 of those
    that have none.

    Rounding to it is noise of a standard deviation of step/√12 at least, as long as the output moves by steps.
    """
    found = np.zeros(record.n_outputs)
    for j, row in enumerate(record.outputs):
        apart = np.diff(np.unique(row))
        step = float(apart.min(initial=np.inf))
        if np.isfinite(step) and np.abs(apart / step - np.round(apart / step)).max() < DATA.whole:
            found[j] = step
    return found


def _dead(record: Record) -> Iterator[DataFault]:
    for name, row in zip(record.output_names, record.outputs, strict=True):
        # most signals move within their first samples, which saves the rest
        few = np.unique(row[:64]).size < DATA.fewest_values and np.unique(row).size
        if few and few < DATA.fewest_values <= record.n_samples:
            what = f"stays at {row[0]:g}" if few == 1 else f"takes {few} values only, {row.min():g} to {row.max():g}"
            yield DataFault("dead", (name,), f"output {name!r} {what}: the sensor is dead or too coarse; leave it out")
        elif (
            few is False
            and record.n_samples > 2
            and (np.abs(row - np.linspace(row[0], row[-1], row.size)).max() < 1e-6 * abs(row[-1] - row[0]))
        ):
            yield DataFault("dead", (name,), f"output {name!r} is a straight line, a clock or a counter; leave it out")


def _copied(record: Record, alive: list[int]) -> Iterator[DataFault]:
    if len(alive) < 2:
        return
    part = record.outputs[alive, : DATA.longest]
    about = part - part.mean(axis=1, keepdims=True)
    size = np.sqrt((about**2).mean(axis=1))
    # A part that is at rest has no copy.
    moving = size > 1e-12 * size.max()
    scaled = about[moving] / size[moving, None]
    names = [record.output_channels[j].name for j, moves in zip(alive, moving, strict=True) if moves]
    copies: set[int] = set()
    for first in range(0, len(scaled), DATA.block):
        alike = scaled[first : first + DATA.block] @ scaled[first:].T / part.shape[1]
        near = np.triu(np.abs(alike) > 1.0 - 1e-6, 1)
        for row in np.flatnonzero(near.any(axis=1)).tolist():
            i, others = first + row, np.flatnonzero(near[row])
            others = others[~np.isin(first + others, list(copies))]
            noise = 0.0 if i in copies or not others.size else _innovation_std(scaled[i])
            # Without noise, sensors of a single mode are the same but for scale.
            if noise <= DATA.noise_free:
                continue
            apart = scaled[i] - np.sign(alike[row, others])[:, None] * scaled[first + others]
            for j in (first + others[np.sqrt((apart**2).mean(axis=1)) < DATA.copied * noise]).tolist():
                copies.add(j)
                yield DataFault(
                    "copied",
                    (names[i], names[j]),
                    f"outputs {names[i]!r} and {names[j]!r} are the same signal, its noise included, which would count"
                    " twice; leave one out",
                )


def _innovation_std(row: np.ndarray) -> float:
    """Standard deviation of the innovation, what the samples before do not predict."""
    k = min(DATA.predictor_order, row.size // 4)
    if k == 0:
        return 0.0
    before = np.lib.stride_tricks.sliding_window_view(row, k)[:-1]
    return float(np.std(row[k:] - before @ np.linalg.lstsq(before, row[k:], rcond=None)[0]))


def _clipped(record: Record, alive: list[int]) -> Iterator[DataFault]:
    for j in alive:
        row, name = record.outputs[j], record.output_channels[j].name
        piled = _piled(row)
        clear = [side for side, at in piled.items() if _ends(row, at, DATA.least_piled, DATA.piled)]
        if clear:
            # Where one end of the range is too near, so may be the other: two equal samples are enough there.
            at, last = piled[clear[0]], float(record.time[max(a[-1] for a in piled.values() if a.size > 1)])
            yield DataFault(
                "clipped",
                (name,),
                f"output {name!r} is clipped {clear[0]} at {row[at[0]]:g}, {at.size} samples; up to {last:g} s motion"
                " beyond the range is lost and would be read as modes; begin later, or measure with a larger range",
                until=last,
            )


def _piled(row: np.ndarray) -> dict[str, np.ndarray]:
    """The samples at each end of a signal's range, less turning points of sines, which are alike on both sides."""
    padded = np.pad(row, 1, constant_values=np.nan)
    before, after = padded[:-2], padded[2:]
    turns = (np.abs(before - after) <= DATA.turning * np.ptp(row)) & (before != row)
    return {name: np.flatnonzero((row == end) & ~turns) for name, end in (("above", row.max()), ("below", row.min()))}


def _ends(row: np.ndarray, at: np.ndarray, least: int, ratio: float) -> bool:
    """Whether the samples `at` an end of a signal's range are so many as where the range is too small for it."""
    return least <= at.size < row.size and at.size > ratio * _beside(row, at)


def _has_levels(row: np.ndarray, at: np.ndarray) -> bool:
    """Whether a signal is a sequence of levels, as it repeats near its end too: of these one is the highest."""
    outer = row[1:] / row[at[0]] > 0.5
    outer &= row[1:] != row[at[0]]
    return not outer.any() or float(np.mean(np.diff(row)[outer] == 0)) > DATA.held


def _beside(row: np.ndarray, at: np.ndarray) -> int:
    """Samples that have the value next to that of the samples `at`."""
    others = row[row != row[at[0]]]
    return int(np.count_nonzero(others == others[np.argmin(np.abs(others - row[at[0]]))]))


def _upsampled(record: Record, alive: list[int]) -> Iterator[DataFault]:
    for j in alive:
        row, name = record.outputs[j], record.output_channels[j].name
        for order, how in ((1, "held"), (2, "joined by straight lines")):
            moves = np.abs(np.diff(row, order))
            changes = np.flatnonzero(moves > 1e-9 * np.abs(row).max())
            every = int(np.gcd.reduce(np.diff(changes))) if changes.size >= DATA.fewest_changes else 1
            # What rests for long and moves again would have its changes far apart.
            if 1 < every <= DATA.slowest and changes.size > 0.5 * (np.ptp(changes) // every):
                yield DataFault(
                    "upsampled",
                    (name,),
                    f"output {name!r} changes at every {every}th sample only: it was sampled at"
                    f" {record.sample_rate_hz / every:g} Hz and {how}, not at {record.sample_rate_hz:g} Hz; leave it"
                    " out, or bring all outputs to that rate",
                )
                break


def _unstated(record: Record, alive: list[int]) -> Iterator[DataFault]:
    channels = [record.output_channels[j] for j in alive]
    moving = [channel for channel in channels if channel.quantity in MEASURED]
    for channel in channels:
        if moving and not channel.quantity:
            yield DataFault(
                "unstated",
                (channel.name,),
                f"output {channel.name!r} states no quantity, and {moving[0].name!r} measures {moving[0].quantity}: it"
                f" would be taken for a displacement; state its unit in the file, as in '{channel.name} [m/s^2]', or"
                " leave it out",
            )
