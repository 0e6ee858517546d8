"""A sensor on a clock of its own is named by the phase of its part of every shape."""

import numpy as np
import pytest

from workbench.identification.ring_down import ring_down
from workbench.identification.signal.clocks import far_from_real
from workbench.identification.signal.synthesis import free_decay
from workbench.structure.modes import SampledModes

MODES = SampledModes(
    [344.0, 653.0, 885.0], [0.01] * 3, [[0.6, 0.9, 0.5], [0.9, 0.2, -0.9], [0.6, -0.9, 0.5]], np.arange(3.0)
)


def late(seconds, sensor=1, shapes=MODES.shapes):
    """The modes as sensors record them, one of which is late."""
    turned = shapes.astype(complex)
    turned[sensor] *= np.exp(-MODES.poles * seconds)
    return SampledModes(MODES.omega, MODES.zeta, turned, MODES.positions)


def notes(modes):
    record = free_decay(modes, sample_time=0.002, n_samples=1500, noise_std=0.003, seed=1)
    return [note for note in ring_down(record, start=0.0).notes if "relative to" in note or "complex" in note]


@pytest.mark.parametrize(("seconds", "said"), [(0.006, "6 ms late"), (-0.0021, "2.1 ms early")])
def test_the_late_sensor_is_named(seconds, said):
    (note,) = notes(late(seconds))
    assert note.startswith(f"output 'y2' is {said} relative to the others")


def test_shapes_that_no_clock_explains_are_said_to_be_complex():
    (note,) = notes(
        late(0.0, shapes=MODES.shapes * np.exp(1j * np.array([[0.0, 0.4, 0.1], [0.9, 0.0, 0.2], [0.1, 0.8, 0.9]])))
    )
    assert note.startswith("modes 1, 2") and "the shape is complex" in note


def test_real_shapes_are_not_remarked():
    assert not notes(MODES)


def test_what_the_nearest_real_shape_leaves():
    """Entries 1 and i: any phase leaves half of the energy. Entries 1 and e^{iε}: ε / 2 of the size."""
    modes = SampledModes([1.0, 2.0], [0.01] * 2, [[1.0, 1.0], [1j, np.exp(0.02j)]], [0.0, 1.0])
    np.testing.assert_allclose(far_from_real(modes), [np.sqrt(0.5), 0.01], rtol=1e-3)
