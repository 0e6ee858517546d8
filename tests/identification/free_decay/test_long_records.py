from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from workbench.identification.free_decay import order
from workbench.identification.free_decay.long_records import identify_long
from workbench.identification.free_decay.order import identify
from workbench.identification.free_decay.refinement import cramer_rao_bound
from workbench.identification.signal.searches import TimeLimit
from workbench.identification.signal.synthesis import free_decay
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes
from workbench.threads import one_blas_thread


def modes(hz, zeta, sensors, size=1.0, seed=0):
    rng = np.random.default_rng(seed)
    shapes = size * rng.standard_normal((sensors, len(hz))) * np.exp(1j * rng.uniform(0, 6, len(hz)))
    return SampledModes(2 * np.pi * np.asarray(hz), zeta, shapes, np.linspace(0, 1, sensors))


@pytest.fixture(scope="module")
def truth():
    """Seven modes: two half a half-width apart, and one a thousandth as large within the band of another."""
    hz = [0.02, 0.1, 0.10005, 0.21, 0.2104, 0.30, 0.44]
    return modes(hz, [0.004, 0.001, 0.001, 0.003, 0.001, 0.008, 0.0002], 6, [1, 1, 1, 1, 0.003, 1, 1])


@pytest.fixture(scope="module")
def record(truth):
    return free_decay(truth, sample_time=1.0, n_samples=12_000, noise_std=1e-4, seed=1)


def test_the_modes_that_are_there_and_no_others_at_the_bound(truth, record):
    found, limit = identify_long([record], max_modes=99), cramer_rao_bound(truth, record, noise_std=1e-4)
    assert found.modes.n_modes == truth.n_modes
    assert (np.abs(found.modes.omega - truth.omega) < 4 * limit.omega_std).all()
    assert (np.abs(found.modes.zeta - truth.zeta) < 4 * limit.zeta_std).all()
    assert np.allclose(found.refined.omega_std, limit.omega_std, rtol=0.05)
    assert np.allclose(found.refined.noise_std, 1e-4, rtol=0.05)
    assert found.refined.converged and (found.statistic > found.threshold).all()


def test_the_same_as_one_mode_at_a_time(record):
    short = replace(record, outputs=record.outputs[:, :3000])
    one, many = identify(short), identify_long([short], max_modes=99)
    assert many.modes.n_modes == one.modes.n_modes
    assert (np.abs(many.modes.omega - one.modes.omega) < 0.05 * one.refined.omega_std).all()
    assert np.allclose(many.statistic, one.statistic, rtol=0.02)


def test_a_record_without_noise(truth):
    clean = free_decay(truth, sample_time=1.0, n_samples=12_000)
    found = identify_long([clean], max_modes=99)
    assert np.allclose(found.modes.omega, truth.omega, rtol=1e-8)


@pytest.mark.slow
def test_records_together_tell_more(truth):
    noise = 3e-3
    pair = [free_decay(truth, sample_time=1.0, n_samples=n, noise_std=noise, seed=n) for n in (8000, 6000)]
    both, one = (identify_long(some, max_modes=99) for some in (pair, pair[:1]))
    assert both.modes.n_modes >= one.modes.n_modes >= 6
    near = np.abs(both.modes.omega[:, None] - one.modes.omega).argmin(axis=0)
    assert (both.refined.omega_std[near] < one.refined.omega_std).all()


def test_a_long_record_takes_this_road_by_itself(record, monkeypatch):
    part = replace(record, outputs=record.outputs[:, :4000])
    monkeypatch.setattr(order, "ORDER", replace(order.ORDER, long_record_values=part.outputs.size - 1))
    directly = one_blas_thread(identify_long)([part], max_modes=99)
    assert np.array_equal(identify(part).modes.omega, directly.modes.omega)
    assert identify(part, max_modes=2).modes.n_modes == 2


def test_noise_alone_is_refused():
    noise = np.random.default_rng(0).standard_normal((3, 100_000))
    with pytest.raises(ValueError, match="holds no mode that rises above its noise"):
        identify(Record(0.01, noise, tuple(Channel(f"y{i}") for i in range(3))))


def test_a_sensor_of_its_own_noise_and_unit(truth, record):
    rng = np.random.default_rng(3)
    outputs = record.outputs.copy()
    outputs[2] = 1e6 * (outputs[2] + 0.1 * rng.standard_normal(record.n_samples)) + 5e6
    found = identify_long([replace(record, outputs=outputs)], max_modes=99)
    assert found.modes.n_modes == truth.n_modes
    assert found.refined.noise_std[2] == pytest.approx(1e5, rel=0.05)


def test_noise_that_is_not_white_holds_no_modes(truth, record):
    white = np.random.default_rng(5).standard_normal(record.outputs.shape)
    coloured = lfilter([3e-4], [1.0, -0.9], white, axis=1)
    outputs = record.outputs + coloured
    found = identify_long([replace(record, outputs=outputs)], max_modes=99)
    away = np.abs(found.modes.omega[:, None] - truth.omega)
    assert (away.min(axis=1) < 1e-4 * found.modes.omega).all()
    assert found.modes.n_modes >= 6


@pytest.mark.slow
def test_a_mode_at_half_the_sample_rate_keeps_no_other_from_being_fitted():
    truth = modes([0.1, 0.1003, 0.2, 0.3, 0.49995], [0.002, 0.002, 0.004, 0.001, 0.01], 6)
    record = free_decay(truth, sample_time=1.0, n_samples=5000, noise_std=0.01, seed=1)
    found, limit = identify_long([record], max_modes=99).modes, cramer_rao_bound(truth, record, noise_std=0.01)
    assert found.n_modes == 5
    assert (np.abs(found.omega - truth.omega)[:4] < 4 * limit.omega_std[:4]).all()


def test_the_first_modes_are_worth_the_wait(truth, record):
    """They were said not to be there where the time had gone before the search began."""
    found = identify_long([record], max_modes=99, time_limit=TimeLimit(1e-9))
    assert found is not None and found.remarks
    strongest = [0, 1, 3, 5, 6]
    assert all(np.abs(found.modes.omega / omega - 1.0).min() < 0.01 for omega in truth.omega[strongest][:2])
