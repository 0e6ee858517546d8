import numpy as np
import pytest

from workbench.identification.free_decay.refinement import refine
from workbench.identification.signal import projection
from workbench.identification.signal.projection import power_sums, project
from workbench.identification.signal.synthesis import free_decay
from workbench.structure.modes import SampledModes


@pytest.fixture(scope="module")
def truth():
    """A mode that dies within a part, one that outlasts the record, two 0.5 % apart, one that does not decay."""
    shapes = np.random.default_rng(0).standard_normal((5, 5)) * np.exp(1j * np.arange(5))
    omega = 2 * np.pi * np.array([0.02, 0.1, 0.1005, 0.21, 0.44])
    return SampledModes(omega, [0.004, 0.002, 0.001, 0.0, 0.02], shapes, np.linspace(0, 1, 5))


@pytest.mark.parametrize("n", [1, 2, 1000, 1023])
def test_sums_of_powers(n):
    w = np.array([0.99 + 0.1j, 1.0, 0.5, np.exp(1e-9j), -0.999, 1.0001j])
    i = np.arange(n)
    for k, found in enumerate(power_sums(w, n)):
        terms = i**k * w[:, None] ** i
        assert np.allclose(found, terms.sum(axis=1), rtol=0, atol=1e-12 * np.abs(terms).sum(axis=1).max())


@pytest.mark.parametrize("offset", [True, False])
def test_projection_by_parts_is_the_same(truth, monkeypatch, offset):
    record = free_decay(truth, sample_time=0.5, n_samples=3000, noise_std=0.1)
    whole = project(record, truth.poles, offset)
    monkeypatch.setattr(projection, "LARGEST_FACTORED", 1)
    monkeypatch.setattr(projection, "PART", 700)
    parts = project(record, truth.poles, offset)
    for name in ("residual", "squares", "coefficients", "gram", "slopes", "spread", "tilt"):
        exact = getattr(whole, name)
        assert np.allclose(getattr(parts, name), exact, rtol=0, atol=1e-10 * np.abs(exact).max()), name


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_refined_by_parts_is_the_same(truth, monkeypatch, noise):
    record = free_decay(truth, sample_time=0.5, n_samples=3000, noise_std=noise)
    start = SampledModes(truth.omega * (1 + 1e-4), truth.zeta + 1e-4, truth.shapes, truth.positions)
    whole = refine(record, start, offset=True)
    monkeypatch.setattr(projection, "LARGEST_FACTORED", 1)
    parts = refine(record, start, offset=True)
    assert whole.converged and parts.converged
    allowed = 0.01 * whole.omega_std + 1e-12
    assert (np.abs(parts.modes.omega - whole.modes.omega) < allowed).all()
    assert (np.abs(parts.modes.zeta - whole.modes.zeta) < 0.01 * whole.zeta_std + 1e-11).all()
    if noise:
        assert np.allclose(parts.covariance, whole.covariance, rtol=0.01, atol=1e-5 * np.abs(whole.covariance).max())
