"""What is measured may differ from sensor to sensor; the modes do not."""

import numpy as np
import pytest

from workbench.identification.free_decay.order import identify
from workbench.identification.signal.synthesis import free_decay
from workbench.records.record import Record
from workbench.structure.modes import SampledModes, mac

QUANTITIES = ("displacement", "velocity", "acceleration")
MODES = SampledModes(
    [12.0, 31.0, 58.0], [0.01, 0.005, 0.02], np.random.default_rng(5).standard_normal((3, 3)), np.linspace(0, 1, 3)
)


def record_of(quantities, outputs, seed=0):
    """One output a quantity, each with noise of a hundredth of its own size."""
    rows, channels = [], []
    for j, quantity in zip(outputs, quantities, strict=True):
        clean = free_decay(MODES, sample_time=0.02, n_samples=600, quantity=quantity)
        noise = np.random.default_rng([seed, j]).standard_normal(600)
        rows.append(clean.outputs[j] + 0.01 * clean.outputs[j].std() * noise)
        channels.append(clean.output_channels[j])
    return Record(0.02, np.array(rows), tuple(channels))


def test_shapes_are_of_displacement_whatever_each_sensor_measures():
    found = identify(record_of(QUANTITIES, range(3)))
    assert found.modes.n_modes == 3
    assert (np.abs(found.modes.omega - MODES.omega) < 4 * found.refined.omega_std).all()
    assert np.diag(mac(found.modes.shapes, MODES.shapes)).min() > 0.9999
    largest, each = np.abs(found.modes.shapes).argmax(axis=0), np.arange(3)
    measured, exact = (shapes / shapes[largest, each] for shapes in (found.modes.shapes, MODES.shapes))
    assert (np.abs((measured - exact).real) <= 4 * found.refined.shape_std + 1e-12).all()


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_one_output_is_enough_for_frequencies_and_damping(quantity):
    found = identify(record_of([quantity], [0]))
    assert found.modes.n_modes == 3
    assert (np.abs(found.modes.omega - MODES.omega) < 4 * found.refined.omega_std).all()
    assert (np.abs(found.modes.zeta - MODES.zeta) < 4 * found.refined.zeta_std).all()
