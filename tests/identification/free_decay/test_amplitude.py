import numpy as np
import pytest
from scipy.integrate import solve_ivp

from workbench.identification.free_decay.assumptions import amplitude_dependence
from workbench.identification.free_decay.ibrahim import stacked_delays
from workbench.identification.free_decay.refinement import refine
from workbench.identification.signal.searches import TimeLimit
from workbench.identification.signal.synthesis import free_decay
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes


def test_linear_record_is_silent():
    shapes = np.random.default_rng(1).standard_normal((3, 3))
    truth = SampledModes([9.0, 21.0, 40.0], [0.01, 0.006, 0.015], shapes, np.linspace(0, 1, 3))
    for seed in range(25):
        record = free_decay(truth, sample_time=0.02, n_samples=900, noise_std=0.003, seed=seed)
        found = amplitude_dependence(record, refine(record, truth))
        assert not found.depends.any()
        # The first stretch holds less than three cycles of the slowest mode.
        assert np.isfinite(found.omega[:2, 1:]).all() and np.isfinite(found.omega[1:3, 0]).all()
        assert (np.nanmax(np.abs(found.omega - truth.omega) / found.omega_std)) < 5


@pytest.mark.slow
def test_duffing_oscillator_follows_its_backbone():
    """ω(A) = ω0 (1 + 3 κ A² / (8 ω0²)) for x'' + 2 ζ ω0 x' + ω0² x + κ x³ = 0 (Nayfeh & Mook 1979, 2.3)."""
    omega, zeta, kappa = 10.0, 0.004, 6.0
    time = 0.02 * np.arange(4000)
    motion = solve_ivp(lambda t, y: [y[1], -2 * zeta * omega * y[1] - omega**2 * y[0] - kappa * y[0] ** 3],
                      (0.0, time[-1]), [1.0, 0.0], t_eval=time, rtol=1e-9, atol=1e-12)  # fmt: skip
    noise = 1e-3 * np.random.default_rng(0).standard_normal(4000)
    record = Record(0.02, (motion.y[0] + noise)[None], (Channel("x", "displacement"),))
    found = amplitude_dependence(record, refine(record, stacked_delays(record, n_modes=1)))
    assert found.depends.all()
    backbone = omega * (1.0 + 3.0 * kappa * found.amplitude[:, 0] ** 2 / (8.0 * omega**2))
    shift = backbone.max() - backbone.min()
    assert shift > 0.1 and np.abs(found.omega[:, 0] - backbone).max() < 0.1 * shift


def test_one_stretch_compares_nothing():
    truth = SampledModes([9.0], [0.01], [[1.0]], [0.0])
    record = free_decay(truth, sample_time=0.02, n_samples=300, noise_std=0.02)
    with pytest.raises(ValueError, match="two segments or more"):
        amplitude_dependence(record, refine(record, truth), segments=1)


def test_the_comparison_ends_with_the_time():
    truth = SampledModes([9.0], [0.01], [[1.0]], [0.0])
    record = free_decay(truth, sample_time=0.02, n_samples=900, noise_std=0.003)
    time_limit = TimeLimit(1e-6)
    found = amplitude_dependence(record, refine(record, truth), time_limit=time_limit)
    assert np.isnan(found.omega).all() and not found.depends.any()
    assert "comparison of modes by amplitude" in time_limit.remarks[0]


def test_a_pole_that_wanders_off_gives_no_mode_the_figures_of_another():
    """A linear structure, one sensor of which reads next to nothing for six samples in the third stretch."""
    time, omega = 0.002 * np.arange(1500), np.array([344.2714, 653.3213, 885.0571])
    amplitudes = np.array([[36.9, 73.9, 47.5], [52.6, 23.9, -89.2], [38.0, -65.1, 32.8]])
    motion = amplitudes @ (np.exp(-0.01 * np.outer(omega, time)) * np.sin(np.outer(omega, time)))
    motion += np.random.default_rng(0).standard_normal(motion.shape) * 3e-3 * motion.std(axis=1, keepdims=True)
    motion[1, 300:306] = [0.0, 0.1, 0.0, 0.1, 0.0, 0.1]
    record = Record(0.002, motion, tuple(Channel(f"y{i}", "acceleration") for i in range(3)))
    found = amplitude_dependence(record, refine(record, SampledModes(omega, [0.01] * 3, np.eye(3), np.arange(3))))
    seen = np.isfinite(found.omega)
    assert seen[:2].all() and np.abs(found.omega / omega - 1.0)[seen].max() < 0.01
