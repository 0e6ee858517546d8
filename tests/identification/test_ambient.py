"""Truth: a chain of three masses under white forces, stepped with the exact covariance of each step (Van Loan 1978)."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import t as student

from workbench.identification.ambient import ambient_decays, identify_ambient
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


@pytest.mark.parametrize("quantity", ["displacement", "velocity"])
def test_modes_and_shapes_within_their_errors(quantity):
    found = identify_ambient(driven(0, quantity=quantity))
    assert found.modes.n_modes == N
    assert (np.abs(found.modes.omega - OMEGA) < 4 * found.omega_std).all()
    assert (np.abs(found.modes.zeta - ZETA) < 4 * found.zeta_std).all()
    assert (found.omega_std < 0.005 * OMEGA).all()
    assert np.diag(mac(found.modes.shapes, SHAPES)).min() > 0.995


def test_correlations_are_those_of_the_closed_form():
    """R(τ) = C e^{A^T τ} with A C + C A^T + B B^T = 0; white noise of the sensors is in lag 0 alone."""
    from scipy.linalg import solve_continuous_lyapunov

    covariance = solve_continuous_lyapunov(A, -np.diag(np.r_[np.zeros(N), np.ones(N)]))
    record = driven(1, n_samples=60_000, noise=0.3)
    [decay] = ambient_decays(record, longest=4.0, references=["y2"])
    exact = np.array([(expm(A * tau) @ covariance)[N:, N + 1] for tau in decay.time]).T / record.outputs[1].std()
    assert decay.time[0] == record.sample_time
    assert np.abs(decay.outputs - exact).max() < 0.08 * np.abs(exact).max()


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say():
    """480 intervals of 95 %: more than 93 % and less than 98 % hold, by Student's t of the jackknife."""
    apart = []
    for seed in range(80):
        found = identify_ambient(driven(100 + seed), n_modes=N)
        apart.append(np.r_[(found.modes.omega - OMEGA) / found.omega_std, (found.modes.zeta - ZETA) / found.zeta_std])
    assert 0.93 < (np.abs(apart) < student.ppf(0.975, 19)).mean() < 0.98


def test_too_short_a_record_is_refused():
    with pytest.raises(ValueError, match="measure longer"):
        ambient_decays(driven(2, n_samples=1000), longest=5.0)
    with pytest.raises(ValueError, match="no output 'y9'"):
        ambient_decays(driven(2, n_samples=4000), references=["y9"])
