"""Faults of the records themselves, which no effect explains: reported with a verdict."""

from collections.abc import Sequence

import numpy as np

from workbench.arrays import Floats
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import predict

AT_REST = 10.0  # standard deviations of the noise, by which a first reading may be off zero and off its mean
IN_MOTION = 0.3  # of the reading's own deviation: likewise
UNSURE = 2.0  # of what the rig reads first from rest: by so much a wrong rig may be off it
LONG, SHORTEST = 0.02, 20  # of a record, and samples: as long, equal readings are no chance
MOVES = 0.1  # of its own deviation: what a sensor moves by meanwhile that is alive


def data_faults(rig: Rig, records: Sequence[Record], *, settle: float = 0.0) -> tuple[str, ...]:
    """Records that begin in motion, and channels that are stuck for a while: a sentence each, with the correction.

    Args:
        rig: nominal.
        records: with the rig's inputs and outputs, in its order.
        settle: seconds at the start of each record that are not compared.
    """
    found = []
    for record in records:
        found += [] if settle else _in_motion(rig, record)
        found += _stuck(record)
    return tuple(found)


def _in_motion(rig: Rig, record: Record) -> list[str]:
    """A first reading that is no bias, no load that comes to stay, and not how accelerations jump with the first force.

    Of that jump the rig knows the size but for errors of gains and masses, and a late sensor does not read it yet.
    """
    at_rest = predict(rig, record)[:, 0]
    for sensor, y, jump in zip(rig.sensors, record.outputs, at_rest, strict=True):
        first = float(y[0])
        off = min(abs(first), abs(first - float(y.mean())), abs(first - float(jump)))
        if abs(float(jump)) < sensor.noise_std:
            jump = 0.0
        if off > max(AT_REST * sensor.noise_std, IN_MOTION * float(y.std()), UNSURE * abs(float(jump))):
            return [
                f"Record {record.name!r} does not start from rest ({sensor.name} reads {first:.3g}, where at rest it"
                f" would read {jump:.3g}): cut it where nothing moves, or give `settle`, a few decay times of the"
                " slowest mode, which are not counted then."
            ]
    return []


def _stuck(record: Record) -> list[str]:
    names = [channel.name for channel in record.output_channels]
    deviations = record.outputs.std(axis=1)
    found = []
    for j, y in enumerate(record.outputs):
        begin, end = _longest_run(y)
        others = [i for i in range(len(names)) if i != j]
        alive = [record.outputs[i, begin:end].std() > MOVES * deviations[i] for i in others]
        at_end = abs(y[begin]) > 0.999 * np.abs(y).max()  # that is clipping
        rounded = np.count_nonzero(y == y[begin]) > end - begin
        if end - begin > max(LONG * y.size, SHORTEST) and any(alive) and not (at_end or rounded):
            seconds = record.start_time + record.sample_time * np.array([begin, end])
            found.append(
                f"Record {record.name!r}: {names[j]} reads {y[begin]:.4g} without change from {seconds[0]:.4g} s to"
                f" {seconds[1]:.4g} s while others move: leave that channel out, or cut the record."
            )
    return found


def _longest_run(y: Floats) -> tuple[int, int]:
    """Where the longest stretch of equal readings begins and ends."""
    changes = np.flatnonzero(np.r_[True, np.diff(y) != 0, True])
    longest = int(np.argmax(np.diff(changes)))
    return int(changes[longest]), int(changes[longest + 1])
