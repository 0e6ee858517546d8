import numpy as np
import pytest

from workbench.identification import refinement
from workbench.identification.band import Band, divided, spectrum
from workbench.identification.refinement import bound, project
from workbench.identification.synthesis import free_decay
from workbench.identification.wide import identify_in_bands, told_in_bands
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes


def modes(hz, zeta, sensors, seed=0):
    rng = np.random.default_rng(seed)
    shapes = rng.standard_normal((sensors, len(hz))) * np.exp(1j * rng.uniform(0, 6, len(hz)))
    return SampledModes(2 * np.pi * np.asarray(hz), zeta, shapes, np.linspace(0, 1, sensors))


@pytest.fixture(scope="module")
def truth():
    """Six modes of a sample a second, two of them 0.5 % apart, and one on the edge of two bands of 4000 samples."""
    return modes([257 / 4000, 0.1, 0.1005, 0.21, 0.30, 0.44], [0.004, 0.002, 0.001, 0.003, 0.008, 0.002], 5)


def test_a_band_holds_the_transform_of_a_free_decay_with_no_leakage(truth):
    record = free_decay(truth, sample_time=1.0, n_samples=999)
    bins = spectrum(record)[:, 100:300]
    band = Band(np.hstack([bins.real, bins.imag]), 100, 999, 1.0)
    coefficients = np.hstack([truth.shapes.real, -truth.shapes.imag]).T
    phi, t_phi = band.columns(truth.poles)
    assert np.allclose(phi @ coefficients, band.outputs.T, rtol=0, atol=1e-11 * np.abs(band.outputs).max())
    # tΦ is the derivative of Φ by the pole: by σ, -tΦ
    step = 1e-7
    moved = band.columns(truth.poles - step)[0]
    assert np.allclose((phi - moved) / step, t_phi, rtol=0, atol=1e-4 * np.abs(t_phi).max())


def test_projection_by_parts_is_the_same(truth, monkeypatch):
    record = free_decay(truth, sample_time=1.0, n_samples=2000, noise_std=0.1)
    whole = project(record, truth.poles, True)
    monkeypatch.setattr(refinement, "LARGEST_FACTORED", 1)
    monkeypatch.setattr(refinement, "PART", 700)
    parts = project(record, truth.poles, True)
    for name in ("residual", "coefficients", "gram", "slopes", "spread", "tilt"):
        exact = getattr(whole, name)
        assert np.allclose(getattr(parts, name), exact, rtol=0, atol=1e-10 * np.abs(exact).max()), name


@pytest.mark.parametrize("n", [700, 5442, 100_001])
def test_bands_cover_the_spectrum_once(n):
    edges = list(divided(n))
    assert edges[0][1] == 1 and edges[-1][2] == (n - 1) // 2
    assert all(before[2] == after[1] for before, after in zip(edges, edges[1:]))
    assert all(first <= core < end <= last for first, core, end, last in edges)


def test_the_modes_that_are_there_and_no_others_at_the_bound(truth):
    record = free_decay(truth, sample_time=1.0, n_samples=4000, noise_std=0.03, seed=1)
    found, limit = identify_in_bands(record), bound(truth, record, noise_std=0.03)
    assert found.modes.n_modes == truth.n_modes
    assert (np.abs(found.modes.omega - truth.omega) < 4 * limit.omega_std).all()
    assert np.allclose(found.omega_std, limit.omega_std, rtol=0.15)


def test_noise_alone_is_refused():
    noise = np.random.default_rng(0).standard_normal((3, 2000))
    record = Record(0.01, noise, tuple(Channel(f"y{i}") for i in range(3)))
    with pytest.raises(ValueError, match="holds no mode that rises above its noise"):
        identify_in_bands(record)


@pytest.mark.slow
def test_forty_modes_of_forty_sensors():
    rng = np.random.default_rng(7)
    hz = np.sort(rng.choice(np.linspace(0.01, 0.44, 120), 40, replace=False))
    truth = modes(hz, np.exp(rng.uniform(np.log(0.0005), np.log(0.01), 40)), 40)
    record = free_decay(truth, sample_time=1.0, n_samples=30_000, noise_std=0.05, seed=2)
    poles, limit = told_in_bands(record), bound(truth, record, noise_std=0.05)
    away = np.abs(np.abs(poles)[:, None] - truth.omega) / limit.omega_std
    assert poles.size == 40
    assert away.min(axis=0).max() < 5
