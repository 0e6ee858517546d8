"""Standard errors in noise that is not white, against the scatter of simulated draws."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from workbench.identification.driven import identify_driven
from workbench.identification.free_decay.long_records import identify_long
from workbench.identification.free_decay.order import identify
from workbench.identification.free_decay.refinement import in_coloured_noise, refine
from workbench.identification.signal.projection import noise_near
from workbench.identification.signal.synthesis import free_decay
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes

MODES = SampledModes([8.0, 30.0, 31.0], [0.01, 0.02, 0.012], [[1.0, 0.5, 0.7], [0.3, -0.8, 0.4]], [0.0, 1.0])
CLEAN = free_decay(MODES, sample_time=0.02, n_samples=1200)
REFERENCE = np.abs(MODES.shapes).argmax(axis=0)
DRAWS = 60


def shares_inside(denominator):
    """Share of nominal 95 % intervals that hold the truth, for white noise and as corrected: (2,) each of ω and ζ,
    and of shapes."""
    rng, inside = np.random.default_rng(0), [[], []]
    each = np.arange(3)
    others = np.arange(2) != REFERENCE[:, None]
    shapes = (MODES.shapes / MODES.shapes[REFERENCE, each]).real
    for _ in range(DRAWS):
        noise = lfilter([1.0], denominator, rng.standard_normal((2, 1400)), axis=1)[:, 200:]
        record = replace(CLEAN, outputs=CLEAN.outputs + 0.02 * noise / noise.std())
        white = refine(record, MODES, offset=True)
        for found, kept in zip((white, in_coloured_noise(white, record)), inside, strict=True):
            (low, high), (low_zeta, high_zeta) = found.interval()
            own = (found.modes.shapes / found.modes.shapes[REFERENCE, each]).real
            kept.append(
                [
                    np.mean(
                        [(low < MODES.omega) & (MODES.omega < high), (low_zeta < MODES.zeta) & (MODES.zeta < high_zeta)]
                    ),
                    np.mean((np.abs(own - shapes) < 1.96 * found.shape_std).T[others]),
                ]
            )
    return np.mean(inside, axis=1)


@pytest.mark.parametrize(
    "denominator", [[1.0, -0.95], [1.0, -2 * 0.97 * np.cos(0.62), 0.97**2]], ids=["falling", "a hump at two modes"]
)
def test_intervals_hold_in_coloured_noise(denominator):
    white, corrected = shares_inside(denominator)
    assert (np.abs(corrected - 0.95) < 0.07).all()
    assert np.abs(white - 0.95).max() > 0.05


def test_white_noise_keeps_the_bound():
    kept = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        record = replace(CLEAN, outputs=CLEAN.outputs + 0.02 * rng.standard_normal((2, 1200)))
        found = refine(record, MODES, offset=True)
        kept.append(in_coloured_noise(found, [record]) is found)
    assert all(kept)


def test_the_spectrum_near_a_mode():
    """A random walk's successor, y_k = 0.9 y_k-1 + e_k: S(ω) ∝ 1 / |1 - 0.9 e^{-iωΔt}|²."""
    noise = lfilter([1.0], [1.0, -0.9], np.random.default_rng(3).standard_normal((60_000, 2)), axis=0)
    omega = np.array([0.5, 3.0, 20.0, 100.0])
    factors = noise_near(-0.1 + 1j * omega, noise, noise.std(axis=0), 0.02)
    exact = (1 - 0.9**2) / np.abs(1 - 0.9 * np.exp(-0.02j * omega)) ** 2
    # mean of 15 bins and two outputs, or of more
    assert np.abs(factors.mean(axis=0) / exact - 1).max() < 0.4


def test_noise_that_is_not_white_is_no_mode():
    """Noise that falls by 32 dB along its spectrum."""
    for seed in range(2):
        noise = lfilter([1.0], [1.0, -0.95], np.random.default_rng(seed).standard_normal((2, 1400)), axis=1)[:, 200:]
        found = identify(replace(CLEAN, outputs=CLEAN.outputs + 0.02 * noise / noise.std()))
        assert found.modes.n_modes == 3 and np.abs(found.modes.omega / MODES.omega - 1.0).max() < 0.002


def within(normalised):
    """Whether the squares of normalised errors may be those of unit normals, to one chance in a thousand each way."""
    squares, size = float((normalised**2).sum()), normalised.size
    return chi2.ppf(1e-3, size) < squares < chi2.isf(1e-3, size)


def own_errors(found, truth):
    errors = np.r_[found.modes.omega, found.modes.zeta] - truth
    return errors / np.sqrt(np.diag(found.covariance))


def test_long_records_say_their_errors_in_coloured_noise():
    own = []
    for seed in range(20):
        noise = lfilter([1.0], [1.0, -0.9], np.random.default_rng(seed).standard_normal((2, 1400)), axis=1)[:, 200:]
        record = replace(CLEAN, outputs=CLEAN.outputs + 0.02 * noise / noise.std())
        own.append(own_errors(identify_long([record], max_modes=3).refined, np.r_[MODES.omega, MODES.zeta]))
    own = np.array(own)
    # By mode, so that what is too wide for one does not make good what is too narrow for another.
    assert all(within(own[:, [r, r + 3]]) for r in range(3))


def test_driven_records_say_their_errors_in_coloured_noise():
    """Two modes under a known force; noise that falls by 26 dB: one mode hears ten times what the other does."""
    poles, seen = np.array([-0.15 + 10.0j, -0.5 + 60.0j]), np.array([[1.0, 0.8 + 0.1j], [0.5, -1.0]])
    direct = np.array([0.02, -0.03])
    own, feedthrough = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal(600)
        z = [lfilter([0.0, (m - 1.0) / p], [1.0, -m], u + 0j) for p, m in zip(poles, np.exp(0.02 * poles), strict=True)]
        noise = lfilter([1.0], [1.0, -0.9], rng.standard_normal((2, 800)), axis=1)[:, 200:]
        y = (seen @ np.array(z)).real + np.outer(direct, u) + 0.01 * noise / noise.std()
        channels = (Channel("a", "velocity"), Channel("b", "velocity"))
        record = Record(0.02, y, channels, u[None], (Channel("f", "force"),))
        found = identify_driven(record, max_modes=2)
        own.append(own_errors(found, np.r_[np.abs(poles), -poles.real / np.abs(poles)]))
        feedthrough.append((found.feedthrough[:, 0] - direct) / found.feedthrough_std[:, 0])
    own = np.array(own)
    assert within(own[:, [0, 2]]) and within(own[:, [1, 3]]) and within(np.array(feedthrough))
