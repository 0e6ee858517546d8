import tracemalloc

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from workbench.identification.free_decay.ibrahim import stacked_delays
from workbench.identification.free_decay.refinement import cramer_rao_bound, modal_amplitudes, refine
from workbench.identification.signal.synthesis import free_decay, impulse_response_modes
from workbench.structure.member import Beam
from workbench.structure.modes import SampledModes

DT, N = 0.01, 500


@pytest.fixture(scope="module")
def truth():
    """Four modes, two of them 3 % apart, with complex shapes at five sensors."""
    rng = np.random.default_rng(3)
    shapes = rng.standard_normal((5, 4)) * np.exp(1j * rng.uniform(0, 2, 4)) + 0.1j * rng.standard_normal((5, 4))
    omega = 2 * np.pi * np.array([3.0, 9.0, 9.27, 20.0])
    return SampledModes(omega, [0.01, 0.006, 0.012, 0.02], shapes, np.linspace(0, 1, 5))


def noisy(truth, seed, fraction=0.1):
    clean = free_decay(truth, sample_time=DT, n_samples=N)
    std = fraction * np.sqrt((clean.outputs**2).mean())
    return free_decay(truth, sample_time=DT, n_samples=N, noise_std=std, seed=seed), std


def test_noise_free_is_exact(truth):
    record = free_decay(truth, sample_time=DT, n_samples=N)
    rough = SampledModes(truth.omega * (1 + 1e-3), truth.zeta * 1.3, truth.shapes, truth.positions)
    refined = refine(record, rough)
    assert refined.converged
    assert np.abs(refined.modes.omega / truth.omega - 1).max() < 1e-12
    assert np.abs(refined.modes.zeta / truth.zeta - 1).max() < 1e-9
    assert np.allclose(refined.amplitudes[0], truth.shapes, rtol=1e-8, atol=1e-8)


def test_covariance_is_the_cramer_rao_bound_by_brute_force(truth):
    """The Fisher information of all unknowns at once, by finite differences of the signal itself."""
    record, std = noisy(truth, 0, 1e-3)
    n, m = truth.n_modes, truth.positions.size
    time = DT * np.arange(N)

    def signal(unknowns):
        omega, zeta = unknowns[:n], unknowns[n : 2 * n]
        a = unknowns[2 * n :].reshape(2, m, n)
        poles = -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)
        return ((a[0] + 1j * a[1]) @ np.exp(np.outer(poles, time))).real.ravel()

    at = np.concatenate([truth.omega, truth.zeta, truth.shapes.real.ravel(), truth.shapes.imag.ravel()])
    jacobian = approx_fprime(at, signal, 1e-6 * np.maximum(np.abs(at), 0.01))
    bound = std**2 * np.linalg.inv(jacobian.T @ jacobian)[: 2 * n, : 2 * n]
    refined = refine(record, stacked_delays(record, n_modes=n))
    expected = np.sqrt(np.diag(bound))
    # the noise is itself estimated, from each sensor's own residual
    assert np.allclose(refined.omega_std, expected[:n], rtol=0.08)
    assert np.allclose(refined.zeta_std, expected[n:], rtol=0.08)
    correlation = bound / np.outer(expected, expected)
    own = refined.covariance / np.sqrt(np.outer(np.diag(refined.covariance), np.diag(refined.covariance)))
    assert np.abs(own - correlation).max() < 0.08


def coverage(truth, draws):
    """Normalised errors of frequency and damping, and of shapes relative to their largest entry."""
    figures, shapes = [], []
    for seed in range(draws):
        record, _ = noisy(truth, seed)
        refined = refine(record, stacked_delays(record, n_modes=truth.n_modes, delays=60))
        assert refined.converged
        figures.append(
            np.r_[
                (refined.modes.omega - truth.omega) / refined.omega_std,
                (refined.modes.zeta - truth.zeta) / refined.zeta_std,
            ]
        )
        k, columns = np.abs(refined.modes.shapes).argmax(axis=0), np.arange(truth.n_modes)
        error = (refined.modes.shapes / refined.modes.shapes[k, columns] - truth.shapes / truth.shapes[k, columns]).real
        std = refined.shape_std
        shapes.append((error[std > 0] / std[std > 0]).ravel())
    return np.array(figures), np.concatenate(shapes)


@pytest.mark.slow
def test_errors_are_as_large_as_they_are_said_to_be(truth):
    figures, shapes = coverage(truth, 60)
    # 480 normalised errors of unit variance: their mean square strays from 1 by 0.065 (one sigma)
    assert 0.8 < (figures**2).mean() < 1.2
    assert 0.8 < (shapes**2).mean() < 1.2


@pytest.mark.slow
def test_intervals_cover(truth):
    """Nominal 95 % intervals hold the truth in 93 to 97 % of 500 draws, and the error is within 1.1 of the bound."""
    figures, shapes = coverage(truth, 500)
    assert 0.93 < (np.abs(figures) < 1.96).mean() < 0.97
    assert 0.93 < (np.abs(shapes) < 1.96).mean() < 0.97
    assert np.sqrt((figures**2).mean(axis=0)).max() < 1.1


def test_several_records_share_poles(truth):
    """Two records halve the variance."""
    first, second = noisy(truth, 1)[0], noisy(truth, 2)[0]
    start = stacked_delays(first, n_modes=4, delays=60)
    one, both = refine(first, start), refine([first, second], start)
    assert np.allclose(both.omega_std / one.omega_std, np.sqrt(0.5), rtol=0.15)
    assert len(both.amplitudes) == 2


def test_noisy_sensor_is_weighted_down(truth):
    from dataclasses import replace

    record, std = noisy(truth, 4)
    spoilt = np.array(record.outputs)
    spoilt[0] += 30 * std * np.random.default_rng(0).standard_normal(N)
    spoilt = replace(record, outputs=spoilt)
    start = stacked_delays(record, n_modes=4, delays=60)
    with_it, without = refine(spoilt, start), refine(record.select_outputs(record.output_names[1:]), start)
    assert with_it.noise_std[0] == pytest.approx(30 * std, rel=0.15)
    assert np.allclose(with_it.omega_std, without.omega_std, rtol=0.1)


def test_offset(truth):
    from dataclasses import replace

    record, std = noisy(truth, 6, 1e-3)
    shifted = replace(record, outputs=record.outputs + 0.5)
    start = stacked_delays(record, n_modes=4, delays=60)
    refined = refine(shifted, start, offset=True)
    assert np.abs((refined.modes.omega - truth.omega) / refined.omega_std).max() < 4
    assert np.allclose(refined.noise_std, std, rtol=0.15)


def test_amplitudes_at_the_blow():
    """From a record that starts late, the amplitudes at the time of the blow, whatever the sensors measure."""
    modes = Beam(length=2.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(3)
    from dataclasses import replace

    modes = replace(modes, damping=np.full(3, 0.01))
    decay = impulse_response_modes(modes, at=0.63, positions=[0.3, 0.9, 1.4])
    record = free_decay(decay, sample_time=0.02, n_samples=600, quantity="acceleration", start_time=0.7)
    found = modal_amplitudes(record, stacked_delays(record, n_modes=3))
    assert np.allclose(found.shapes, decay.shapes, rtol=1e-7, atol=1e-9)


def test_refusals(truth):
    record = free_decay(truth, sample_time=DT, n_samples=8)
    with pytest.raises(ValueError, match="measure longer"):
        refine(record, truth)
    with pytest.raises(ValueError, match="no mode to refine"):
        refine(record, truth.select([]))
    for noise in (0.0, -1.0, [0.1] * (record.n_outputs + 1)):
        with pytest.raises(ValueError, match="noise_std is positive, one for all outputs or one each"):
            cramer_rao_bound(truth, record, noise_std=noise)


def test_the_covariance_of_a_shape_of_many_outputs_is_made_where_it_is_asked_for():
    m = 1500
    modes = SampledModes([20.0], [0.01], np.linspace(-1.0, 1.0, m)[:, None], np.linspace(0.0, 1.0, m))
    record = free_decay(modes, sample_time=0.05, n_samples=40, noise_std=0.01)
    tracemalloc.start()
    found = cramer_rao_bound(modes, record, noise_std=0.01)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 0.5 * found.shape_covariance.nbytes
    np.testing.assert_allclose(found.shape_std[:, 0], np.sqrt(np.diag(found.shape_covariance[0])), rtol=1e-12)
