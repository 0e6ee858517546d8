"""Truth: a chain of three masses under white forces, stepped with the exact covariance of each step (Van Loan 1978)."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from workbench.identification.ambient import correlation_functions, identify_ambient
from workbench.identification.output_only.whittle import SpectralMode, Spectrum, initial_mode, posed
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


def test_correlations_are_those_of_the_closed_form():
    """R(τ) = C e^{A^T τ} with A C + C A^T + B B^T = 0; white noise of the sensors is in lag 0 alone."""
    from scipy.linalg import solve_continuous_lyapunov

    covariance = solve_continuous_lyapunov(A, -np.diag(np.r_[np.zeros(N), np.ones(N)]))
    record = driven(1, n_samples=60_000, noise=0.3)
    [decay] = correlation_functions(record, longest=4.0, references=["y2"])
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


def test_a_spectrum_all_but_singular_at_one_line_is_not_likely():
    """Of one line only one direction is seen, so that a mode that cancels the rest there would win without end."""
    rng = np.random.default_rng(0)
    spectrum = Spectrum(rng.standard_normal((2, 300)) + 1j * rng.standard_normal((2, 300)), 0.01, 0.5, 1.0)
    mode = SpectralMode(-0.05 + 1.5j, np.array([1.0, 0.0]), np.array([-1.0, 0.0]))
    likelihood, [mode] = posed(spectrum, [mode], [], [mode])
    background = np.array([2.0 * np.eye(2), np.zeros((2, 2))])
    deepest = -mode.spectrum(likelihood.z, likelihood.dt)[:, 0, 0].real.min()
    for left, likely in ((1.0, True), (1e-9, False)):
        cancelling = replace(mode, excitation=mode.excitation * (2.0 - left) / deepest)
        assert np.linalg.eigvalsh(likelihood.whole([cancelling], background)).min() == pytest.approx(left, rel=1e-5)
        assert np.isfinite(likelihood.cost(((cancelling,), background))) == likely


def test_too_short_a_record_is_refused():
    with pytest.raises(ValueError, match="measure longer"):
        correlation_functions(driven(2, n_samples=1000), longest=5.0)
    with pytest.raises(ValueError, match="no output 'y9'"):
        correlation_functions(driven(2, n_samples=4000), references=["y9"])


def test_a_spectrum_is_the_transform_of_its_correlations():
    z = np.exp(1j * np.linspace(0.05, 3.0, 40))
    mode = SpectralMode(-0.2 + 0.9j, np.array([1.0, 0.5 - 0.2j]), np.array([0.3 + 0.1j, -0.2j]))
    k = np.arange(1, 400)
    correlations = np.real(np.outer(mode.shape, mode.excitation)[:, :, None] * np.exp(0.5 * mode.pole * k))
    half = np.einsum("ijk,kl->lij", correlations, z[None] ** -k[:, None].astype(float))
    assert np.allclose(mode.spectrum(z, 0.5), half + half.conj().swapaxes(1, 2), atol=1e-12)


def test_the_slope_of_the_likelihood_is_its_difference():
    """Every unknown of two modes and a background that slopes, moved by a little either way."""
    rng = np.random.default_rng(0)
    spectrum = Spectrum(rng.standard_normal((2, 300)) + 1j * rng.standard_normal((2, 300)), 0.01, 0.5, 1.0)
    shapes = rng.standard_normal((2, 2)) + 0.1j * rng.standard_normal((2, 2))
    modes = [
        initial_mode(spectrum, pole, shape) for pole, shape in zip((-0.06 + 1.2j, -0.09 + 1.6j), shapes, strict=True)
    ]
    likelihood, modes = posed(spectrum, modes, [], modes)
    state = modes, likelihood.start(modes)
    _, slope = likelihood.normal_equations(state)
    for a, step in enumerate(1e-6 * np.eye(slope.size)):
        above, below = (likelihood.cost(likelihood.moved(state, way * step)[0]) for way in (1.0, -1.0))
        assert slope[a] == pytest.approx((below - above) / 2e-6, rel=1e-4, abs=1e-4)


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
