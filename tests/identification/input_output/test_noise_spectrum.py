"""Noise that is not white under known inputs, of closed spectrum, on random structures written out mode by mode."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.signal import lfilter

from workbench.identification.driven import identify_driven
from workbench.identification.input_output.noise_spectrum import lines_of, noise_spectrum, samples_of
from workbench.records.record import Channel, Record

DT, OUTPUTS, INPUTS = 0.01, 3, 2


def tailed(rng, tail, n, size=OUTPUTS):
    """y_k = tail y_k-1 + e_k of unit variance, (size, n)."""
    e = np.sqrt(1.0 - tail**2) * rng.standard_normal((size, n + 500))
    return lfilter([1.0], [1.0, -tail], e, axis=1)[:, 500:]


def excitation(rng, kind, n):
    if kind == "noise":
        return rng.standard_normal((INPUTS, n))
    lines = np.exp(2j * np.pi * rng.random((INPUTS, n // 2 + 1)))
    lines[:, 0] = 0.0
    return np.fft.irfft(lines, n) * np.sqrt(n)


def random_modes(rng):
    """Three to six, 3 % apart and more: ω, ζ."""
    n = int(rng.integers(3, 7))
    while True:
        f = np.sort(rng.uniform(1.5, 40.0, n))
        if (np.diff(f) > 0.03 * f[1:]).all():
            return 2 * np.pi * f, 10 ** rng.uniform(np.log10(0.003), np.log10(0.03), n)


def driven(rng, omega, zeta, *, tails, kind="noise", n=1200, level=0.02, draw=None):
    """Velocities under known forces that are held, from a state that is not told, in noise of a tail an output."""
    poles = omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
    seen = rng.standard_normal((OUTPUTS, omega.size)) * omega
    participation, u = rng.standard_normal((omega.size, INPUTS)), excitation(rng, kind, n)
    mu = np.exp(poles * DT)
    modal_responses = [
        lfilter([0.0, (m - 1.0) / p], [1.0, -m], f + 0j) for m, p, f in zip(mu, poles, participation @ u, strict=True)
    ]
    begun = 0.05 * rng.standard_normal((omega.size, 1)) * mu[:, None] ** np.arange(n)
    y = (seen @ (np.array(modal_responses) + begun)).real + 0.1 * rng.standard_normal((OUTPUTS, INPUTS)) @ u
    noisy = rng if draw is None else np.random.default_rng([draw, 1])
    noise = np.vstack([tailed(noisy, tail, n, 1) for tail in tails])
    y = y + level * y.std(axis=1, keepdims=True) * noise
    outputs = tuple(Channel(f"v{j}", "velocity") for j in range(OUTPUTS))
    return Record(DT, y, outputs, u, tuple(Channel(f"f{i}", "force") for i in range(INPUTS)))


def told(found, omega, zeta):
    """How many of the modes told are there, and normalised errors of ω and ζ of these."""
    apart = np.abs(found.modes.omega[:, None] / omega - 1.0)
    r, s = linear_sum_assignment(apart)
    r, s = r[apart[r, s] < 0.02], s[apart[r, s] < 0.02]
    by_omega = (found.modes.omega[r] - omega[s]) / found.omega_std[r]
    return r.size, np.r_[by_omega, (found.modes.zeta[r] - zeta[s]) / found.zeta_std[r]]


def test_the_course_of_noise_is_its_spectrum():
    """S(ω) = (1 - a²) / |1 - a e^{-iωΔt}|², the second record three times as loud; the other output is white."""
    rng = np.random.default_rng(0)
    left = [size * np.vstack([tailed(rng, 0.95, n, 1), tailed(rng, 0.0, n, 1)]).T for size, n in ((1, 4000), (3, 2000))]
    taken = [np.zeros(each.shape) for each in left]
    line_std = noise_spectrum(left, [1e3 * each for each in left], taken, 0, np.array([4000.0, 2000.0]))
    for loud, each in zip((1.0, 3.0), line_std, strict=True):
        omega = np.pi / len(each) * np.arange(len(each))
        exact = loud**2 * (1.0 - 0.95**2) / np.abs(1.0 - 0.95 * np.exp(-1j * omega)) ** 2 / (22.0 / 6.0)
        # Of variance as of an autoregression: 2 p / n at each frequency, and more at the corner.
        assert np.abs(np.log(each[:, 0] ** 2 / exact)).max() < 0.2
        assert np.ptp(each[:, 1]) == 0.0
    white = tailed(rng, 0.0, 1000).T
    assert noise_spectrum([white], [1e3 * white], [0.0 * white], 0, np.array([1000.0])) is None


def test_lines_of_steep_noise_are_independent_and_as_large_as_told():
    """A walk, whose ends are far apart: by a Fourier transform its highest lines would be as large as the jump."""
    noise = tailed(np.random.default_rng(1), 0.998, 500, 4000).T
    lines = lines_of(noise)
    exact = (1.0 - 0.998**2) / np.abs(1.0 - 0.998 * np.exp(-1j * np.pi / 500 * np.arange(500))) ** 2
    assert np.abs(np.log((lines**2).mean(axis=1) / exact))[20:].max() < 0.25
    correlated = np.corrcoef(lines[20:])
    assert np.abs(correlated - np.eye(480)).max() < 0.1
    assert np.allclose(samples_of(lines), noise)


def test_noise_of_a_long_tail_is_no_mode():
    """Taken for white, it holds three modes more, beneath the lowest."""
    omega, zeta = 2 * np.pi * np.array([4.0, 13.0]), np.array([0.01, 0.02])
    found = identify_driven(driven(np.random.default_rng(0), omega, zeta, tails=(0.95, 0.95, 0.0), n=700))
    right, errors = told(found, omega, zeta)
    assert found.modes.n_modes == right == 2
    assert np.abs(errors).max() < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["noise", "multisine"])
@pytest.mark.parametrize("tail", [0.0, 0.8, 0.95])
def test_random_structures_are_told_rightly_in_noise_of_any_tail(tail, kind):
    for seed in range(20):
        rng = np.random.default_rng([seed, 7])
        omega, zeta = random_modes(rng)
        found = identify_driven(driven(rng, omega, zeta, tails=(tail,) * OUTPUTS, kind=kind))
        assert told(found, omega, zeta)[0] == found.modes.n_modes == omega.size


TWO_CLOSE = 2 * np.pi * np.array([1.0, 3.0, 3.2, 20.0]), np.array([0.02, 0.01, 0.015, 0.01])


@pytest.mark.parametrize("tail", [0.8, 0.95])
def test_two_close_modes_in_noise_that_falls_with_frequency_are_two(tail):
    """Half the record did not tell them apart, noise ten times above its median passed for what something does, and
    coloured noise of the outputs for noise of the inputs."""
    omega, zeta = TWO_CLOSE
    found = identify_driven(driven(np.random.default_rng(0), omega, zeta, tails=(tail,) * OUTPUTS, draw=11))
    assert told(found, omega, zeta)[0] == found.modes.n_modes == omega.size and not found.remarks


@pytest.mark.slow
@pytest.mark.parametrize("tail", [0.8, 0.95])
def test_intervals_cover_in_noise_of_any_tail(tail):
    """1600 intervals of 95 %, of four modes over a tail that falls by 19 or 32 dB."""
    omega, zeta = TWO_CLOSE
    errors = []
    for seed in range(200):
        record = driven(np.random.default_rng(0), omega, zeta, tails=(tail,) * OUTPUTS, draw=seed)
        found = identify_driven(record)
        right, each = told(found, omega, zeta)
        assert right == found.modes.n_modes == omega.size
        errors.append(each)
    assert 0.93 < (np.abs(errors) < 1.96).mean() < 0.97
