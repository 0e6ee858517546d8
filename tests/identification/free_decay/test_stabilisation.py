import numpy as np
import pytest

from workbench.identification.free_decay.ibrahim import stabilise, stable_modes
from workbench.identification.shapes.mode_pairing import pair_modes
from workbench.identification.signal.synthesis import free_decay
from workbench.structure.member import Beam
from workbench.structure.modes import SampledModes


def test_real_modes_stay_and_noise_does_not():
    positions = np.linspace(0.05, 0.95, 8)
    beam = Beam(length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(4)
    truth = SampledModes(beam.omega, np.full(4, 0.01), beam.phi(positions) / [1, 2, 3, 4], positions)
    clean = free_decay(truth, sample_time=0.008, n_samples=800)
    noise = 0.03 * np.sqrt((clean.outputs**2).mean())
    record = free_decay(truth, sample_time=0.008, n_samples=800, noise_std=noise, seed=1)
    found = stable_modes(stabilise(record, orders=range(3, 16), delays=60))
    assert found.modes.n_modes == 4
    assert np.abs(found.modes.omega / truth.omega - 1).max() < 5e-3
    assert (found.presence > 0.9).sum() >= 3


def test_travelling_shapes_are_not_counted():
    shapes = np.array([[1.0, 1.0], [0.5, 1j], [-0.2, -1.0], [0.7, -1j]])
    truth = SampledModes([10.0, 17.0], [0.01, 0.01], shapes, np.linspace(0, 1, 4))
    diagram = stabilise(free_decay(truth, sample_time=0.05, n_samples=400), orders=[2], delays=40)
    assert np.allclose(stable_modes(diagram).modes.omega, [10.0])
    assert stable_modes(diagram, min_phase_collinearity=0.0).modes.n_modes == 2


@pytest.mark.parametrize("orders", [[], [0, 2]])
def test_orders_are_numbers_of_modes(orders):
    record = free_decay(SampledModes([10.0], [0.01], [[1.0]], [0.0]), sample_time=0.05, n_samples=100)
    with pytest.raises(ValueError, match="the lowest of orders is a number of modes, 1 or more; got 0"):
        stabilise(record, orders=orders)


def test_each_measured_mode_is_at_most_one_of_the_model():
    """A mode that only resembles a bending mode is told from the one that is it; a strange frequency, from all."""
    positions = np.linspace(0.0, 1.0, 10)
    model = Beam(length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="free", right="free").modes(6)
    model = model.select(range(2, 6))
    shapes = model.phi(positions)
    twin = shapes[:, 2] + 0.3 * np.sin(17 * positions)
    stranger = shapes[:, 3]
    factor = 250.0
    order = [0, 1, 2]
    measured = SampledModes(
        np.r_[5.0, factor * model.omega[order], factor * 1.05 * model.omega[2], factor * 3.0 * model.omega[3]],
        np.full(6, 0.01),
        np.column_stack([np.linspace(-1, 1, 10), shapes[:, order], twin, stranger]),
        positions,
    )
    told = pair_modes(measured, model)
    assert list(told.matched) == [1, 2, 3]
    assert list(told.model) == [0, 1, 2]
    assert list(told.others) == [0, 4, 5]
    assert np.allclose(told.scaled_hz, measured.frequencies_hz[1:4])
