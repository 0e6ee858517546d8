import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from workbench.identification.free_decay.order import identify
from workbench.identification.free_decay.preparation import without_drift
from workbench.identification.free_decay.refinement import cramer_rao_bound
from workbench.identification.ring_down import remarks
from workbench.identification.signal.synthesis import free_decay
from workbench.structure.modes import SampledModes

MODES = SampledModes([8.0, 30.0], [0.01, 0.02], [[1.0, 0.5], [0.3, -0.8]], [0.0, 1.0])


def decay(noise=0.01, seed=0):
    return free_decay(MODES, sample_time=0.02, n_samples=1000, noise_std=noise, seed=seed)


def test_relaxing_sensor_is_put_right_without_harm_to_the_modes():
    sound = decay()
    drift = np.outer([30.0, 0.0], np.exp(-sound.time / 7.0))
    found = without_drift(replace(sound, outputs=sound.outputs + drift + 2.0), MODES.poles)
    assert found.size[0] == pytest.approx(np.ptp(drift[0]), rel=0.02) and found.size[1] < 0.1
    modes = identify(found.record).modes
    error = np.abs(modes.poles - MODES.poles)
    assert (error < 4.0 * cramer_rao_bound(MODES, sound, noise_std=0.01).omega_std).all()


def test_what_does_not_drift_is_left_alone():
    """A degree that helps by chance would be taken in a few of a thousand records."""
    taken = 0
    for seed in range(60):
        record = decay(noise=0.1, seed=seed)
        found = without_drift(record, MODES.poles)
        taken += found.record is not record
    assert taken == 0


def test_remarks_name_what_is_no_mode_of_the_structure():
    record = decay(noise=0.003)
    time, hum = record.time, 0.1 * np.cos(2 * np.pi * 7.0 * record.time)
    overtone = 0.02 * np.exp(-2 * 0.08 * time) * np.cos(16.0 * time)
    found = identify(replace(record, outputs=record.outputs + np.outer([1.0, 0.4], hum) + np.outer([1, 0.3], overtone)))
    said = dict(zip(np.round(found.modes.omega, 1), remarks(found.refined, record), strict=True))
    assert said == {8.0: "", 16.0: "2 × mode 1: its harmonic?", 30.0: "", 44.0: "does not decay within the record"}


def test_drift_of_a_long_record_takes_little_memory():
    """A record of 4 MB; all columns at once would be twenty times that."""
    record = free_decay(MODES, sample_time=0.0005, n_samples=250_000, noise_std=0.01)
    tilted = replace(record, outputs=record.outputs + np.linspace(0.0, 5.0, record.n_samples))
    tracemalloc.start()
    found = without_drift(tilted, MODES.poles)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.size == pytest.approx([5.0, 5.0], rel=1e-3)
    assert peak < 20e6 + 3.0 * record.outputs.nbytes
