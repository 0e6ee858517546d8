"""Whether a record is a free decay, by its level and by how well a few decaying modes explain it."""

from dataclasses import dataclass, replace

import numpy as np

from workbench.identification.free_decay.ibrahim import stacked_delays
from workbench.identification.free_decay.preparation import decay_start
from workbench.identification.signal.projection import project
from workbench.records.record import Record


@dataclass(frozen=True)
class DecayingSettings:
    """Constants of the test for a free decay."""

    decayed: float = 0.1  # rms of the last tenth over the largest of any tenth, below which a record has decayed
    falling: int = 6  # tenths of decreasing level: by chance in 1 of 720 stationary records
    # Share of the energy that decaying modes leave of a short free decay, at most: 0.05 where noise is a tenth of the
    # motion. Of 28 random vibrations of one to five decay times they leave 0.14 to 0.96, as accelerations; as
    # displacements, one of one decay time may leave less.
    left: float = 0.05
    modes: int = 8  # of that fit
    instants: int = 600  # of that fit: fewer than the samples alias frequencies, and leave decays as they are
    signals: int = 8  # of that fit, evenly spaced among the outputs


DECAYING = DecayingSettings()


def decays(record: Record) -> bool:
    """Whether the outputs are a free decay: at rest in the end, falling all the time, or explained by decaying modes.

    The level of a short decay need not fall from tenth to tenth, as these hold few periods.
    """
    about = record.outputs - record.outputs[:, -max(record.n_samples // 10, 1) :].mean(axis=1, keepdims=True)
    tenths = [float((part**2).mean()) for part in np.array_split(about, 10, axis=1) if part.size]
    falling = tenths[int(np.argmax(tenths)) :]
    if tenths[-1] < DECAYING.decayed**2 * max(tenths):
        return True
    return (len(falling) >= DECAYING.falling and bool(np.all(np.diff(falling) < 0))) or _explained(record)


def _explained(record: Record) -> bool:
    """Whether the record falls from the start of a decay on, and decaying modes leave little of it."""
    after = record.between(decay_start(record))
    stride = -(-after.n_samples // DECAYING.instants)
    sensors = slice(None, None, -(-after.n_outputs // DECAYING.signals))
    outputs = after.outputs[sensors, ::stride]
    outputs = outputs - outputs.mean(axis=1, keepdims=True)
    energy = [float((part**2).sum()) for part in np.array_split(outputs, 2, axis=1)]
    if not energy[1] < energy[0]:
        return False
    part = replace(
        after,
        outputs=outputs,
        inputs=np.zeros((0, 0)),
        input_channels=(),
        output_channels=after.output_channels[sensors],
        sample_time=stride * after.sample_time,
    )
    try:
        poles = stacked_delays(part, n_modes=DECAYING.modes).poles
    except ValueError:  # too short
        return False
    left = project(part, poles[poles.real < 0], True).residual
    return float((left**2).sum()) < DECAYING.left * float((outputs**2).sum())
