import numpy as np
import pytest

from workbench.identification.free_decay.ibrahim import stacked_delays
from workbench.identification.signal.aliases import aliases
from workbench.identification.signal.synthesis import free_decay
from workbench.structure.modes import SampledModes


@pytest.mark.parametrize("true_hz", [13.0, 63.0, 137.0, 188.0])
def test_the_true_frequency_is_among_the_candidates_and_another_rate_decides(true_hz):
    """A mode on each of the first four branches at 100 Hz, sampled without a filter."""
    truth = SampledModes([2 * np.pi * true_hz], [0.004], [[1.0], [0.6]], [0.0, 1.0])
    branch = int(true_hz // 50)

    def sampled(rate):
        record = free_decay(truth, sample_time=1 / rate, n_samples=200, aliases=True)
        return record, aliases(stacked_delays(record, n_modes=1), sample_rate_hz=rate)

    record, found = sampled(100.0)
    assert found.frequencies_hz[branch, 0] == pytest.approx(true_hz, rel=1e-9)
    assert found.zeta[branch, 0] == pytest.approx(0.004, rel=1e-6)
    taken = stacked_delays(record, n_modes=1, branch=branch)
    assert taken.frequencies_hz == pytest.approx(found.frequencies_hz[branch], rel=1e-9)
    other = sampled(found.deciding_rate_hz(0))[1]
    apart = np.abs(found.frequencies_hz - other.frequencies_hz.T)
    first = np.unravel_index(apart.argmin(), apart.shape)[0]
    assert found.frequencies_hz[first, 0] == pytest.approx(true_hz, rel=1e-6)
    # every other candidate of the first record is missed by all of the second
    assert np.delete(apart, first, axis=0).min() > 0.5


def test_candidates_all_give_the_same_samples():
    modes = SampledModes([2 * np.pi * 13.0], [0.02], [[1.0]], [0.0])
    found = aliases(modes, sample_rate_hz=100.0, n_branches=5)
    for k, f, zeta in zip(found.branches, found.frequencies_hz[:, 0], found.zeta[:, 0]):
        omega = 2 * np.pi * f
        mu = np.exp((-zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)) / 100.0)
        expected = np.exp(modes.poles[0] / 100.0)
        assert mu == pytest.approx(expected if k % 2 == 0 else expected.conj(), rel=1e-9)


def test_modes_beyond_half_the_rate_are_refused():
    modes = SampledModes([2 * np.pi * 60.0], [0.02], [[1.0]], [0.0])
    with pytest.raises(ValueError, match="beyond half the sample rate, 50 Hz"):
        aliases(modes, sample_rate_hz=100.0)
