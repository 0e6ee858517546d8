"""Faults of the records themselves: repeated, started in motion, with channels that are copied, stuck or clipped."""

from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import combinations, product

import numpy as np

from workbench.arrays import Floats
from workbench.gap.setup.comparison import simulated_by
from workbench.gap.setup.corrections import SetupFault, without_output, without_record
from workbench.identification.signal import data_quality
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import simulate_record
from workbench.structure.printed import joined_in_words

# a first reading farther than each of these from zero, from the mean and from the prediction shows motion
NOISE_MULTIPLE = 10.0  # standard deviations of the noise
SIGNAL_SHARE = 0.3  # standard deviations of the readings
JUMP_MULTIPLE = 2.0  # times the first reading that the rig predicts from rest, which a wrong rig misjudges
MAX_RUN_SHARE, MAX_RUN = 0.02, 20  # share of a record, and samples: longer runs of equal readings are not by chance
MIN_MOTION_SHARE = 0.1  # of its standard deviation over the record: a working sensor moves by more meanwhile


def check_names(records: Sequence[Record]) -> None:
    """Refuse records with the same name, since results are stated by it.

    Raises:
        ValueError: for the first such name.
    """
    for name, count in Counter(record.name for record in records).items():
        if count > 1:
            raise ValueError(
                f"{count} records are called {name!r}, and results are by record: give each a name of its own, such as"
                " replace(record, name=...)"
            )


def check_disjoint(records: Sequence[Record], validation: Sequence[Record]) -> None:
    """Refuse validation records that repeat a record to be fitted.

    Raises:
        ValueError: for the first such pair.
    """
    for held_out, record in product(validation, records):
        if held_out.repeats(record):
            raise ValueError(
                f"validation record {held_out.name!r} repeats the fit record {record.name!r}, so it validates nothing;"
                " keep another record for validation, or none"
            )


def repeated(records: Sequence[Record]) -> list[SetupFault]:
    """Faults of records that hold the same samples as another; the later one is left out."""
    faults: list[SetupFault] = []
    repeats: set[int] = set()
    for i, j in combinations(range(len(records)), 2):
        if not {i, j} & repeats and records[i].repeats(records[j]):
            repeats.add(j)
            first, second = records[i].name, records[j].name
            sentence = f"The records {first} and {second} hold the same samples: leave {second} out."
            faults.append(SetupFault("repeated record", sentence, np.nan, partial(without_record, second)))
    return faults


def copied_channels(rig: Rig, records: Sequence[Record]) -> list[SetupFault]:
    """Faults of outputs that copy another: the noise of two sensors differs, so equal samples are of one.

    The output that agrees less with the model is the copy.
    """
    faults: list[SetupFault] = []
    copies: set[int] = set()
    for i, j in combinations(range(len(rig.sensors)), 2):
        one, other = rig.sensors[i], rig.sensors[j]
        may_agree = (one.at, one.quantity) == (other.at, other.quantity) and not one.noise_std + other.noise_std
        same = all(np.array_equal(r.outputs[i], r.outputs[j]) for r in records)
        if not same or may_agree or {i, j} & copies or not any(np.ptp(r.outputs[i]) for r in records):
            continue
        errors = [(record.outputs - simulated_by(rig, record))[[i, j]] for record in records]
        error_i, error_j = np.sum([(error**2).mean(axis=1) for error in errors], axis=0)
        copy = j if error_i <= error_j else i
        copies.add(copy)
        kept, copied = rig.sensors[i + j - copy].name, rig.sensors[copy].name
        sentence = (
            f"The outputs {one.name} and {other.name} hold the same samples, and the model agrees better with {kept}:"
            f" measure {copied} again, or leave it out."
        )
        faults.append(SetupFault("copied channel", sentence, np.nan, partial(without_output, copied)))
    return faults


def data_faults(rig: Rig, records: Sequence[Record], *, transient: float = 0.0) -> tuple[str, ...]:
    """One sentence for each record that starts in motion or is clipped and each stuck channel, with the correction.

    With a transient (s), which is not compared, a record may start in motion.
    """
    found = []
    for record in records:
        found += [*([] if transient else _in_motion(rig, record)), *_stuck(record), *_clipped(record)]
    return tuple(found)


def _in_motion(rig: Rig, record: Record) -> list[str]:
    """A sentence if a first reading shows that the record starts in motion; empty if none does.

    A bias and a constant load leave the first reading at the mean. An acceleration jumps with the first force: the rig
    predicts that jump up to errors of gains and masses, and a late sensor reads zero instead.
    """
    from_rest = simulate_record(rig, record)[:, 0]
    for sensor, y, jump in zip(rig.sensors, record.outputs, from_rest, strict=True):
        first = float(y[0])
        off = min(abs(first), abs(first - float(y.mean())), abs(first - float(jump)))
        if abs(float(jump)) < sensor.noise_std:
            jump = 0.0
        least = max(NOISE_MULTIPLE * sensor.noise_std, SIGNAL_SHARE * float(y.std()), JUMP_MULTIPLE * abs(float(jump)))
        if off > least:
            return [
                f"Record {record.name!r} does not start from rest ({sensor.name} reads {first:.3g}, where at rest it"
                f" would read {jump:.3g}): cut it where nothing moves, or set `transient` to a few decay times of the"
                " slowest mode, which are then not compared."
            ]
    return []


def _stuck(record: Record) -> list[str]:
    """A sentence for each channel whose reading stays the same for long while others move."""
    names = [channel.name for channel in record.output_channels]
    deviations = record.outputs.std(axis=1)
    found = []
    for j, y in enumerate(record.outputs):
        begin, end = _longest_run(y)
        others = [i for i in range(len(names)) if i != j]
        alive = [record.outputs[i, begin:end].std() > MIN_MOTION_SHARE * deviations[i] for i in others]
        clipped = abs(y[begin]) > 0.999 * np.abs(y).max()
        quantised = np.count_nonzero(y == y[begin]) > end - begin  # the same reading occurs elsewhere too
        if end - begin > max(MAX_RUN_SHARE * y.size, MAX_RUN) and any(alive) and not (clipped or quantised):
            seconds = record.start_time + record.sample_time * np.array([begin, end])
            found.append(
                f"Record {record.name!r}: {names[j]} reads {y[begin]:.4g} without change from {seconds[0]:.4g} s to"
                f" {seconds[1]:.4g} s while others move: leave that channel out, or cut the record."
            )
    return found


def _clipped(record: Record) -> list[str]:
    """A sentence on the outputs that are clipped; empty if none is."""
    each = [f.message.partition(";")[0] for f in data_quality.data_faults(record) if f.kind == "clipped" and f.outputs]
    beyond = "the motion beyond is lost: lower the level, or measure with a larger range."
    return [f"Record {record.name!r}: {joined_in_words(each)}; {beyond}"] if each else []


def _longest_run(y: Floats) -> tuple[int, int]:
    """First sample of the longest run of equal readings, and the first after it."""
    changes = np.flatnonzero(np.r_[True, np.diff(y) != 0, True])
    longest = int(np.argmax(np.diff(changes)))
    return int(changes[longest]), int(changes[longest + 1])
