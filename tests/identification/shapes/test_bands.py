from dataclasses import replace

import numpy as np
import pytest

from workbench.identification.free_decay.ibrahim import stacked_delays
from workbench.identification.free_decay.refinement import refine
from workbench.identification.shapes.bands import eigenfunction_bands
from workbench.identification.shapes.eigenfunctions import BoundaryConditions, eigenfunctions
from workbench.identification.signal.synthesis import free_decay, impulse_response_modes
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.structure.supports import End, PointMass

LENGTH = 2.0
HINGED = BoundaryConditions.of("beam", length=LENGTH, left="hinged", right="hinged")
X = np.linspace(0.0, LENGTH, 41)


@pytest.fixture(scope="module")
def beam():
    modes = Beam(length=LENGTH, mass_per_length=1.5, bending_stiffness=1.0, left="hinged", right="hinged").modes(2)
    return replace(modes, damping=np.full(2, 0.01))


def refined(beam, seed, level=0.02):
    decay = impulse_response_modes(beam, at=0.63, positions=np.linspace(0.2, 1.8, 8))
    clean = free_decay(decay, sample_time=0.05, n_samples=300)
    noise = level * np.sqrt((clean.outputs**2).mean())
    record = free_decay(decay, sample_time=0.05, n_samples=300, noise_std=noise, seed=seed)
    return refine(record, stacked_delays(record, n_modes=2, delays=40))


def test_the_curve_is_that_of_eigenfunctions(beam):
    found = refined(beam, 0)
    bands = eigenfunction_bands(found, X, length=LENGTH, mass_per_length=1.5, ends=HINGED)
    drawn = eigenfunctions(found.modes, length=LENGTH, mass_per_length=1.5, ends=HINGED)
    assert np.allclose(bands.phi, drawn.phi(X), rtol=1e-9, atol=1e-9)
    assert (bands.std[[0, -1]] < 1e-6 * bands.std.max()).all()  # the hinges hold the ends
    assert (bands.width > 1.96).all()


@pytest.mark.slow
def test_bands_hold_the_true_curve_as_often_as_they_say(beam):
    truth, inside, whole, predicted = beam.phi(X), [], [], []
    for seed in range(100):
        bands = eigenfunction_bands(refined(beam, seed), X, length=LENGTH, mass_per_length=1.5, ends=HINGED)
        sign = np.sign((bands.phi * truth).sum(axis=0))
        error = np.abs(sign * bands.phi - truth)[1:-1] / bands.std[1:-1]
        inside.append(error < 1.96)
        whole.append((error < bands.width).all(axis=0))
        predicted.append(bands.interpolation_std.max(axis=0) == 0)
    assert np.mean(predicted) > 0.9  # a smooth beam and sensors enough: nothing is said to be missed
    # 200 curves: a share of 0.95 strays by 0.015 (one sigma); points of a curve go together
    assert 0.92 < np.mean(inside) < 0.98
    assert 0.91 < np.mean(whole) < 0.99


def test_bands_hold_what_a_spline_misses_of_springs_and_a_mass():
    """Sensors too far apart for the higher modes: bands of noise alone hold a tenth of the truth and less."""
    part = PointMass(at=1.3, mass=0.25)
    structure = Beam(
        length=LENGTH, mass_per_length=1.5, bending_stiffness=30.0, left=End(3e4, 50.0), right=End(2e4),
        damping=ModalDamping(0.008), attachments=(part,),
    )  # fmt: skip
    modes = structure.modes(6)
    truth, inside = modes.phi(X), []
    decay = impulse_response_modes(modes, at=0.77, positions=np.linspace(0.05, 1.95, 10))
    window = {"sample_time": 0.4 / modes.frequencies_hz[-1], "n_samples": 600, "quantity": "acceleration"}
    level = np.sqrt((free_decay(decay, **window).outputs ** 2).mean())
    for seed in range(5):
        found = refine(free_decay(decay, noise_std=0.01 * level, seed=seed, **window), decay)
        bands = eigenfunction_bands(found, X, length=LENGTH, mass_per_length=1.5, point_masses=[part])
        error = np.abs(bands.phi * np.sign((bands.phi * truth).sum(axis=0)) - truth)
        noise = np.sqrt(bands.std**2 - bands.interpolation_std**2)
        inside.append([(error < 1.96 * told).mean(axis=0) for told in (bands.std, noise)])
    share, by_noise = np.mean(inside, axis=0)
    assert share.min() > 0.8 and share.mean() > 0.9
    assert by_noise[3:].max() < 0.3


def test_one_sensor_between_hinges_has_a_wide_band(beam):
    """The ends alone predict it, by zero: its own value is the error by which they miss the curve elsewhere."""
    one = beam.select([0])
    decay = impulse_response_modes(one, at=0.63, positions=[0.8])
    record = free_decay(decay, sample_time=0.05, n_samples=300, noise_std=1e-4)
    bands = eigenfunction_bands(refine(record, decay), X, length=LENGTH, mass_per_length=1.5, ends=HINGED)
    low, high = bands.whole
    truth = np.abs(one.phi(X))
    assert ((truth >= low - 1e-9) & (truth <= high + 1e-9)).all() and bands.std.max() > 0.1 * truth.max()


def test_refusals(beam):
    found = refined(beam, 0)
    with pytest.raises(ValueError, match="between 0 and 1"):
        eigenfunction_bands(found, X, length=LENGTH, level=95)
    with pytest.raises(ValueError, match="outside the structure"):
        eigenfunction_bands(found, [3.0], length=LENGTH)
    with pytest.raises(ValueError, match="8 sensors are too few to cross-validate a spline of degree 7"):
        eigenfunction_bands(found, X, length=LENGTH, degree=7)
