"""Free decays are told from random vibration."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from workbench.identification.free_decay.preparation import decays
from workbench.records.record import Channel, Record

RATE = 500.0


@pytest.mark.parametrize("n_samples", [1000, 4000])
@pytest.mark.parametrize("seed", range(3))
def test_random_vibration_does_not_decay(n_samples, seed):
    """White noise through two modes, in closed form by SciPy; accelerations of one to five decay times of the lower."""
    rng, rows = np.random.default_rng(seed), []
    force = rng.standard_normal(n_samples + 4000)
    for omega, zeta in ((75.4, 0.008), (472.5, 0.006)):
        b, a, _ = cont2discrete(([1.0, 0.0, 0.0], [1.0, 2.0 * zeta * omega, omega**2]), 1.0 / RATE)
        rows.append(lfilter(b[0], a, force)[4000:])
    mixed = np.array([[1.0, 0.8], [2.0, -1.0]]) @ rows
    assert not decays(Record(1.0 / RATE, mixed, (Channel("a"), Channel("b"))))
