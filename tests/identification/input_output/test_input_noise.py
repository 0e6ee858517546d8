"""Noise of logged inputs, by structures simulated with scipy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt

from workbench.identification.driven import identify_driven
from workbench.records.record import Channel, Record

DT, N = 1.0 / 400.0, 2048


def record_of(seed, *, band_limited=False, blows=False, input_noise=0.01):
    """A structure of 3 to 6 modes under 1 or 2 random forces, or blows, held between samples, logged with noise."""
    rng = np.random.default_rng(seed)
    n_inputs, n_outputs, n_modes = 1 + seed % 2, 2 + seed // 2 % 2, 3 + seed % 4
    f = np.cumsum(rng.uniform(0.6, 1.6, n_modes))
    omega, zeta = 2 * np.pi * f / f[-1] * rng.uniform(60.0, 80.0), rng.uniform(0.004, 0.02, n_modes)
    shapes, forces = (
        np.sign(x) * np.maximum(np.abs(x), 0.3)
        for x in (rng.normal(size=(n_outputs, n_modes)), rng.normal(size=(n_modes, n_inputs)))
    )
    u = rng.normal(size=(n_inputs, N))
    if band_limited:
        u = sosfilt(butter(6, 100.0, fs=1 / DT, output="sos"), u, axis=1)
    if blows:
        u = np.zeros((n_inputs, N))
        for k in range(3 * n_inputs):
            at = int((k + 0.1) * N / (3 * n_inputs))
            u[k % n_inputs, at : at + 6] = np.hanning(8)[1:-1] * rng.uniform(0.8, 1.2)
    y = np.zeros((n_outputs, N))
    for w, z, c, b in zip(omega, zeta, shapes.T, forces, strict=True):
        pole = -z * w + 1j * w * np.sqrt(1 - z**2)
        q = lfilter([0.0, (np.exp(pole * DT) - 1) / pole], [1.0, -np.exp(pole * DT)], (b @ u).astype(complex))
        y += np.outer(c, w**2 * np.imag(q) / pole.imag)
    y += rng.choice([0.003, 0.01]) * y.std(axis=1, keepdims=True) * rng.normal(size=y.shape)
    logged = u + input_noise * np.sqrt((u**2).mean(axis=1, keepdims=True)) * rng.normal(size=u.shape)
    outputs = tuple(Channel(f"y{j}", "displacement") for j in range(n_outputs))
    return Record(DT, y, outputs, logged, tuple(Channel(f"u{i}", "force") for i in range(n_inputs))), omega, zeta


def scores(found, omega, zeta):
    """Errors of frequencies and damping ratios over their standard errors."""
    modes = found.modes
    return np.r_[(modes.omega - omega) / found.omega_std, (modes.zeta - zeta) / found.zeta_std]


def errors_of(seeds, remark, **excitation):
    """The scores of all seeds, each with its modes, no other, and one remark."""
    errors = []
    for seed in seeds:
        record, omega, zeta = record_of(seed, **excitation)
        found = identify_driven(record)
        assert found.modes.n_modes == omega.size
        assert len(found.remarks) == 1 and remark in found.remarks[0]
        errors.append(scores(found, omega, zeta))
    return np.concatenate(errors)


@pytest.mark.parametrize("band_limited", [True, False])
@pytest.mark.parametrize("seeds", [(0, 4, 8), pytest.param(range(9, 40), marks=pytest.mark.slow)], ids=["few", "many"])
def test_intervals_hold_without_false_modes(seeds, band_limited):
    errors = errors_of(seeds, "standard errors allow for it", band_limited=band_limited)
    inside = (np.abs(errors) < 1.96).mean()
    assert inside >= 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / errors.size)
    assert np.sqrt((errors**2).mean()) > 0.6  # nor are they too wide


def test_its_peaks_at_modes_are_no_strong_modes():
    """Above white noise they pass for more modes than are searched at first."""
    record, omega, _ = record_of(23)
    assert identify_driven(record, seconds=None).modes.n_modes == omega.size


def test_the_noise_is_found_as_large_as_it_is():
    record, _, _ = record_of(4, band_limited=False)
    remark = next(r for r in identify_driven(record).remarks if "inputs contain measurement noise" in r)
    assert float(remark.split("u0 ")[1].split(" rms")[0]) == pytest.approx(0.01, rel=0.15)


def test_it_is_told_from_coloured_noise_of_the_outputs_beside_it():
    """Where that was taken for white, the level was 30 % too large."""
    record, omega, zeta = record_of(2, input_noise=0.02)
    noise = lfilter([1.0], [1.0, -0.95], np.random.default_rng(2).normal(size=record.outputs.shape), axis=1)
    outputs = record.outputs + 0.003 * record.outputs.std(axis=1, keepdims=True) * noise
    found = identify_driven(replace(record, outputs=outputs))
    assert found.modes.n_modes == omega.size
    assert np.abs(scores(found, omega, zeta)).max() < 3.5
    assert float(found.remarks[0].split("u0 ")[1].split(" rms")[0]) == pytest.approx(0.02, rel=0.15)


def test_exact_inputs_have_no_such_remark():
    record, omega, zeta = record_of(4, band_limited=False, input_noise=0.0)
    found = identify_driven(record)
    assert found.remarks == ()
    assert np.abs(scores(found, omega, zeta)).max() < 3.5


def test_intervals_allow_for_noise_within_blows():
    errors = errors_of((0, 4, 8, 12), "force window", blows=True)
    assert (np.abs(errors) < 1.96).mean() >= 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / errors.size)
