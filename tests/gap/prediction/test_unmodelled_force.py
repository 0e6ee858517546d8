"""Filter and smoother of an unmodelled force, beside Gaussian distributions of all samples at once."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.stats import multivariate_normal

from workbench.gap.prediction.unmodelled_force import (
    colour_of,
    driven,
    force_filter,
    innovations,
    log_likelihood,
    sampled_model,
    smoothed_covariance,
    smoothed_states,
    whiten,
)
from workbench.rig.simulate import simulate

DT, SAMPLES = 0.01, 40
NOISE = np.array([1e-4, 3e-4, 2e-4, 1e-4])


@pytest.fixture(scope="module")
def kalman(hinged_rig):
    rig = hinged_rig(n_modes=3)
    model = sampled_model(rig.modes, rig.sensors, NOISE, DT)
    return force_filter(model, rig.modes.phi(0.9).T, np.array([0.04]), colour_of(0.7, 1))


@pytest.fixture(scope="module")
def joint(kalman):
    """Covariances of all states, and of all states with all readings, of a process that has gone on for ever."""
    size, m = kalman.a.shape[0], kalman.h.shape[0]
    powers = [np.eye(size)]
    for _ in range(SAMPLES):
        powers.append(kalman.a @ powers[-1])
    q = np.zeros((size, size))
    q[-1, -1] = 0.04
    own = [kalman.covariance]
    for _ in range(SAMPLES - 1):
        own.append(kalman.a @ own[-1] @ kalman.a.T + q)
    states = np.zeros((SAMPLES, size, SAMPLES, size))
    for i in range(SAMPLES):
        for j in range(i + 1):
            states[i, :, j] = powers[i - j] @ own[j]
            states[j, :, i] = states[i, :, j].T
    with_readings = np.einsum("iajb,mb->iajm", states, kalman.h)
    readings = np.einsum("lb,ibjm->iljm", kalman.h, with_readings).reshape(SAMPLES * m, SAMPLES * m)
    return with_readings.reshape(SAMPLES * size, SAMPLES * m), readings + np.kron(np.eye(SAMPLES), np.diag(NOISE**2))


@pytest.fixture(scope="module")
def residual(joint):
    rng = np.random.default_rng(0)
    return rng.multivariate_normal(np.zeros(len(joint[1])), joint[1]).reshape(SAMPLES, -1).T


def test_the_covariance_is_that_of_the_riccati_equation(kalman):
    q = np.zeros_like(kalman.a)
    q[-1, -1] = 0.04
    expected = solve_discrete_are(kalman.a.T, kalman.h.T, q, np.diag(NOISE**2))
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((kalman.covariance - expected) / size).max() < 1e-6


def test_the_likelihood_is_that_of_all_samples_at_once(kalman, joint, residual):
    density = multivariate_normal(cov=joint[1], allow_singular=True).logpdf(residual.T.ravel())
    constants = -0.5 * residual.size * np.log(2.0 * np.pi)
    assert log_likelihood(kalman, [residual, residual]) == pytest.approx(2.0 * (density - constants), rel=1e-6)


def test_innovations_are_what_was_not_foretold(kalman, residual):
    state, expected = np.zeros(len(kalman.a)), np.empty_like(residual)
    for k in range(SAMPLES):
        expected[:, k] = residual[:, k] - kalman.h @ state
        state = kalman.a @ state + kalman.gain @ expected[:, k]
    assert np.allclose(innovations(kalman, residual), expected, rtol=0.0, atol=1e-10 * np.abs(residual).max())
    white = whiten(kalman, residual)
    assert np.sum(white**2) == pytest.approx(np.sum(expected * np.linalg.solve(kalman.innovation, expected)))


def test_what_runs_away_is_likely_nowhere_and_ends_nothing(kalman, residual):
    astray = residual.copy()
    astray[1, 7] = np.inf
    with np.errstate(invalid="ignore"):
        assert log_likelihood(kalman, [astray]) == -np.inf
        assert not np.isfinite(whiten(kalman, astray)).all()


def test_readings_beyond_all_measure_are_likely_nowhere_and_end_nothing(hinged_rig, residual):
    """What a late sensor reads of a mode that decays within a sample, as the model counts it back."""
    rig = hinged_rig(n_modes=3)
    modes = replace(rig.modes, damping=rig.modes.damping + np.diag([0.0, 0.0, 4e3]))
    late = tuple(replace(sensor, delay=0.9 * DT) for sensor in rig.sensors)
    lost = force_filter(sampled_model(modes, late, NOISE, DT), modes.phi(0.9).T, np.array([150.0]))
    assert np.linalg.eigvalsh(lost.innovation)[0] < 0.0  # rounding left no covariance of it
    assert log_likelihood(lost, [residual]) == -np.inf


def test_the_smoother_tells_the_mean_of_all_states_given_all_readings(kalman, joint, residual):
    mean = (joint[0] @ np.linalg.solve(joint[1], residual.T.ravel())).reshape(SAMPLES, -1).T
    found = smoothed_states(kalman, residual)
    assert (np.abs(found - mean).max(axis=1) < 1e-5 * np.abs(mean).max(axis=1)).all()


def test_the_smoothers_covariance_is_that_of_all_states_given_all_readings(kalman, joint):
    size, middle = len(kalman.a), SAMPLES // 2
    there = slice(middle * size, (middle + 1) * size)
    own = kalman.covariance  # of what is not known before the first reading, and then of all that drives it
    for _ in range(middle):
        own = kalman.a @ own @ kalman.a.T + np.diag([*np.zeros(size - 1), 0.04])
    expected = own - joint[0][there] @ np.linalg.solve(joint[1], joint[0][there].T)
    found, expected = np.diag(smoothed_covariance(kalman)), np.diag(expected)
    assert found[-1] == pytest.approx(expected[-1], rel=0.01)
    assert (found < 1.001 * expected).all()  # the modes ring longer than these readings, and more tell more


@pytest.mark.parametrize("stages", [1, 2])
def test_sensors_that_are_late_or_early_read_the_forces_of_their_interval(hinged_rig, stages):
    rig = hinged_rig(n_modes=3)
    delays = (0.3 * DT, -0.4 * DT, 0.8 * DT, 0.0)
    rig = replace(rig, sensors=tuple(replace(s, delay=d) for s, d in zip(rig.sensors, delays, strict=True)))
    at = rig.actuators[0].at
    force = np.random.default_rng(3).normal(size=(1, SAMPLES))
    expected = simulate(replace(rig, actuators=rig.actuators[:1]), force, sample_time=DT).outputs
    kalman = force_filter(
        sampled_model(rig.modes, rig.sensors, NOISE, DT), rig.modes.phi(at).T, np.ones(1), colour_of(0.0, stages)
    )
    n, state, read = 2 * rig.modes.n_modes, np.zeros(len(kalman.a)), []
    for k in range(SAMPLES):
        state[n] = force[0, k]
        read.append(kalman.h @ state)
        state = kalman.a @ state
    found = np.array(read).T[:, :-1]
    assert np.abs(found - expected[:, :-1]).max() < 1e-9 * np.abs(expected).max()


def test_states_are_driven_from_rest():
    rng = np.random.default_rng(1)
    a, drive = 0.3 * rng.normal(size=(5, 5)), rng.normal(size=(5, 30))
    x = driven(a, drive)
    assert x.shape == (5, 31) and not x[:, 0].any()
    assert np.allclose(x[:, 1:], a @ x[:, :-1] + drive, rtol=1e-12, atol=1e-12)
