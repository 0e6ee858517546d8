"""Truth: a chain of three masses under white forces, stepped with the exact covariance of each step (Van Loan 1978)."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.signal import lfilter

from workbench.identification.ambient import correlation_functions, identify_ambient
from workbench.identification.output_only.subspace import SUBSPACE, Model
from workbench.records.record import Channel, Record
from workbench.structure.modes import mac

N, STIFFNESS = 3, 25.0 * (2.0 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1))
DAMPING = 0.1 * np.eye(N) + 2e-3 * STIFFNESS
A = np.block([[np.zeros((N, N)), np.eye(N)], [-STIFFNESS, -DAMPING]])
OMEGA_SQUARED, SHAPES = np.linalg.eigh(STIFFNESS)
OMEGA = np.sqrt(OMEGA_SQUARED)
ZETA = 0.5 * (0.1 / OMEGA + 2e-3 * OMEGA)


def driven(seed, *, n_samples=12_000, sample_time=0.05, quantity="velocity", noise=0.05):
    step = expm(A * sample_time)
    push = np.diag(np.r_[np.zeros(N), np.ones(N)])
    both = expm(np.block([[-A, push], [np.zeros_like(A), A.T]]) * sample_time)
    spread = step @ both[: 2 * N, 2 * N :]
    rng = np.random.default_rng(seed)
    kicks = np.linalg.cholesky(0.5 * (spread + spread.T)) @ rng.standard_normal((2 * N, n_samples + 500))
    states = np.zeros((2 * N, n_samples + 501))
    for k in range(n_samples + 500):
        states[:, k + 1] = step @ states[:, k] + kicks[:, k]
    y = states[N:, 501:] if quantity == "velocity" else states[:N, 501:]
    y = y + noise * y.std() * rng.standard_normal(y.shape)
    return Record(sample_time, y, tuple(Channel(f"y{i + 1}", quantity) for i in range(N)), name="driven")


def test_modes_and_shapes_within_their_errors():
    found = identify_ambient(driven(0, quantity="displacement"))
    assert found.modes.n_modes == N
    assert (np.abs(found.modes.omega - OMEGA) < 4 * found.omega_std).all()
    assert (np.abs(found.modes.zeta - ZETA) < 4 * found.zeta_std).all()
    assert (found.omega_std < 0.005 * OMEGA).all()
    assert np.diag(mac(found.modes.shapes, SHAPES)).min() > 0.995


def test_an_order_without_poles_in_a_part_of_the_record_is_no_error():
    """Without one of its blocks, this record has no pole that oscillates at a low order."""
    assert identify_ambient(driven(111)).modes.n_modes == N


def test_correlations_are_those_of_the_closed_form():
    """R(τ) = C e^{A^T τ} with A C + C A^T + B B^T = 0; white noise of the sensors is in lag 0 alone."""
    covariance = solve_continuous_lyapunov(A, -np.diag(np.r_[np.zeros(N), np.ones(N)]))
    record = driven(1, n_samples=60_000, noise=0.3)
    [decay] = correlation_functions(record, max_lag=4.0, references=["y2"])
    exact = np.array([(expm(A * tau) @ covariance)[N:, N + 1] for tau in decay.time]).T / record.outputs[1].std()
    assert decay.time[0] == record.sample_time
    assert np.abs(decay.outputs - exact).max() < 0.08 * np.abs(exact).max()


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say():
    """1200 intervals of 95 %: more than 93 % and less than 97 % hold."""
    apart = []
    for seed in range(200):
        found = identify_ambient(driven(100 + seed))
        assert found.modes.n_modes == N
        apart.append(np.r_[(found.modes.omega - OMEGA) / found.omega_std, (found.modes.zeta - ZETA) / found.zeta_std])
    assert 0.93 < (np.abs(apart) < 1.96).mean() < 0.97


def test_exact_covariances_give_exact_poles():
    """R(k) = C e^{A kΔt} P C^T with A P + P A^T + B B^T = 0, of the chain's velocities."""
    covariance, step = solve_continuous_lyapunov(A, -np.diag(np.r_[np.zeros(N), np.ones(N)])), expm(A * 0.3)
    lags = np.array([(np.linalg.matrix_power(step, k) @ covariance)[N:, N:] for k in range(2 * SUBSPACE.past + 1)])
    log_mu, shapes, _ = Model(lags).poles(2 * N)
    order = np.argsort(log_mu.imag)
    exact = OMEGA * (-ZETA + 1j * np.sqrt(1.0 - ZETA**2))
    assert np.abs(log_mu[order] / 0.3 - exact).max() < 1e-5
    assert np.diag(mac(shapes[:, order], SHAPES)).min() > 1.0 - 1e-9


def test_two_close_modes_under_one_force_are_two():
    """2.5 % apart and 1 % damped, of three modes that one force drives, seen by four sensors 20 dB above the noise."""
    omega, zeta, dt = np.array([0.11, 0.9, 0.9225]), np.array([0.02, 0.01, 0.01]), 1.0
    rng = np.random.default_rng(3)
    force = rng.standard_normal(26_000)
    poles = omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
    modes = np.array([lfilter([1.0], [1.0, -np.exp(p * dt)], force + 0j).imag[2000:] for p in poles])
    modes = modes / modes.std(axis=1, keepdims=True)
    y = rng.standard_normal((4, 3)) @ modes
    y = y + 0.1 * y.std() * rng.standard_normal(y.shape)
    found = identify_ambient(Record(dt, y, tuple(Channel(f"a{j}", "acceleration") for j in range(4))))
    assert found.modes.n_modes == 3
    assert (np.abs(found.modes.omega - omega) < 4 * found.omega_std).all()
    assert (np.abs(found.modes.zeta - zeta) < 4 * found.zeta_std).all()


def test_the_number_of_modes_can_be_given():
    record = driven(4, n_samples=6000)
    assert identify_ambient(record, n_modes=2).modes.n_modes == 2
    with pytest.raises(ValueError, match="not 30"):
        identify_ambient(record, n_modes=30)


def test_noise_alone_holds_no_mode():
    noise = np.random.default_rng(5).standard_normal((3, 8000))
    with pytest.raises(ValueError, match="no mode that rises above its noise"):
        identify_ambient(Record(0.01, noise, tuple(Channel(f"y{j}", "acceleration") for j in range(3))))


def test_too_short_a_record_is_refused():
    with pytest.raises(ValueError, match="measure longer"):
        correlation_functions(driven(2, n_samples=1000), max_lag=5.0)
    with pytest.raises(ValueError, match="no output 'y9'"):
        correlation_functions(driven(2, n_samples=4000), references=["y9"])


def test_errors_are_little_above_the_closed_form():
    """One mode, one sensor, no noise: S ∝ 1/(σ² + δ²), so that F = T/2π ∫ (∂ ln S)² dδ = T/σ, for ω_d as for σ.

    That what drives it may have to do with what else is there, a background that slopes, a taper and a band that ends
    cost up to half of it.
    """
    omega, zeta, dt, n = 6.0, 0.02, 0.1, 20_000
    pole = omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
    force = np.random.default_rng(0).standard_normal(n + 2000)
    mode = lfilter([1.0], [1.0, -np.exp(pole * dt)], force + 0j)[2000:].imag
    found = identify_ambient(Record(dt, mode[None], (Channel("y", "displacement"),)))
    least = np.sqrt(zeta * omega / (n * dt))
    assert found.modes.n_modes == 1
    assert 1.0 < found.omega_std[0] / least < 1.5 and 1.0 < found.zeta_std[0] * omega / least < 1.5
    assert abs(found.modes.omega[0] - omega) < 3.0 * least and abs(found.modes.zeta[0] - zeta) < 3.0 * least / omega


def test_a_weak_mode_beside_strong_ones_is_found():
    """Its accelerations have a thousandth of the power of those of the others, and a tenth of it is noise."""
    omega, zeta = np.array([2.0, 12.0, 31.0]), np.array([0.015, 0.015, 0.015])
    rng, n, dt = np.random.default_rng(0), 30_000, 0.05
    poles = omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
    modes = [lfilter([1.0], [1.0, -np.exp(p * dt)], rng.standard_normal(n) + 0j) for p in poles]
    y = np.array([[0.06, 1.0, 0.8], [0.05, -0.6, 0.9], [0.03, 0.5, -1.0]]) @ np.imag(modes)
    y = y + 0.01 * y.std() * rng.standard_normal(y.shape)
    found = identify_ambient(Record(dt, y, tuple(Channel(f"a{j}", "acceleration") for j in range(3))))
    assert found.modes.n_modes == 3
    assert (np.abs(found.modes.omega - omega) < 4 * found.omega_std).all()
    assert (np.abs(found.modes.zeta - zeta) < 4 * found.zeta_std).all()


def test_a_record_too_short_for_any_correlation_is_told_how_long_it_must_be():
    record = Record(0.01, np.array([[1.0, 2.0]]), (Channel("a", "acceleration"),))
    with pytest.raises(ValueError, match="has 2 samples; modes of random vibration take at least 640: measure longer"):
        identify_ambient(record)
