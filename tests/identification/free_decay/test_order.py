from dataclasses import replace

import numpy as np
import pytest

from workbench.identification.free_decay.order import _FreeDecay, _Grid, identify
from workbench.identification.free_decay.refinement import cramer_rao_bound, in_coloured_noise, refine
from workbench.identification.signal.searches import TimeLimit
from workbench.identification.signal.synthesis import free_decay, impulse_response_modes
from workbench.records.record import Channel, Record
from workbench.structure.damping import ProportionalDamping
from workbench.structure.member import Bar
from workbench.structure.modes import SampledModes, mac


def taper(x):
    return 2.0 * (1.0 - x)


@pytest.fixture(scope="module")
def truth():
    """Five modes, two of them 2 % apart and one of a hundredth of the largest amplitude, at five sensors."""
    shapes = np.random.default_rng(3).standard_normal((5, 5)) * [1.0, 0.3, 0.3, 0.01, 0.1]
    omega = 2 * np.pi * np.array([3.0, 9.0, 9.18, 14.0, 20.0])
    return SampledModes(omega, [0.01, 0.006, 0.01, 0.005, 0.04], shapes, np.linspace(0, 1, 5))


@pytest.mark.parametrize("noise", [0.0, 1e-4, 0.01])
def test_the_modes_that_are_there_and_no_others(truth, noise):
    record = free_decay(truth, sample_time=0.01, n_samples=800, noise_std=noise, seed=1)
    found = identify(record)
    assert found.modes.n_modes == 5
    std = cramer_rao_bound(truth, record, noise_std=noise or 1e-9).omega_std
    assert (np.abs(found.modes.omega - truth.omega) < 4 * std).all()
    assert (found.statistic > found.threshold).all()


def test_without_noise_every_mode_comes_in_and_nothing_else_is_tried():
    """The bar of section 4.4 from six sensors: a pole that seems to split another on its way bars no other."""
    bar = Bar(length=1.0, mass_per_length=taper, axial_stiffness=taper, left="fixed", right="free",
              damping=ProportionalDamping(stiffness=0.002, mass=0.1))  # fmt: skip
    exact = bar.modes(20)
    decay = impulse_response_modes(exact, at=0.63, positions=np.arange(1, 7) / 6)
    found = identify(free_decay(decay, sample_time=0.01, n_samples=1500, quantity="acceleration"))
    assert np.abs(found.modes.omega / exact.omega - 1.0).max() < 1e-11
    assert found.noise_modes.n_modes == 0


def test_a_mode_beneath_the_noise_is_left_out(truth):
    record = free_decay(truth, sample_time=0.01, n_samples=800, noise_std=0.2, seed=1)
    assert 3 not in np.abs(identify(record).modes.omega[:, None] / truth.omega - 1).argmin(axis=1)


def test_noise_alone_is_refused():
    channels = tuple(Channel(f"y{i}") for i in range(4))
    noise = Record(0.01, np.random.default_rng(0).standard_normal((4, 600)), channels)
    with pytest.raises(ValueError, match="holds no mode that rises above its noise"):
        identify(noise)


def test_bound_is_what_refinement_reports(truth):
    record = free_decay(truth, sample_time=0.01, n_samples=800, noise_std=1e-4, seed=2)
    known = cramer_rao_bound(truth, record, noise_std=1e-4)
    assert np.allclose(refine(record, truth).omega_std, known.omega_std, rtol=0.1)


def test_records_of_unequal_length_together_tell_more(truth):
    first = free_decay(truth, sample_time=0.01, n_samples=800, noise_std=0.01, seed=3)
    second = free_decay(truth, sample_time=0.01, n_samples=500, noise_std=0.01, seed=4)
    alone, both = identify(first), identify([first, second])
    assert both.modes.n_modes == truth.n_modes
    assert (both.refined.omega_std < alone.refined.omega_std).all()


def test_a_mode_that_shifts_as_it_decays_is_no_crowd_of_modes():
    """1 % higher where strong, as a hardening spring has it, rounded to counts: its side lines are no modes."""
    time = 0.002 * np.arange(2000)
    envelope = 50.0 * np.exp(-1.2 * time)
    strong = envelope * np.cos(2 * np.pi * np.cumsum(18.0 * (1 + 4e-6 * envelope**2)) * 0.002)
    other = 30.0 * np.exp(-2.0 * time) * np.cos(2 * np.pi * 52.0 * time + 0.4)
    found = identify(Record(0.002, np.round(strong + other), (Channel("a", "acceleration"),))).modes
    for frequency in (18.0, 52.0):
        assert np.abs(found.frequencies_hz - frequency).min() < 0.01 * frequency
    assert found.n_modes <= 6


def test_crowded_modes_at_two_sensors_are_two():
    """Shapes of two sensors agree to 0.95 in one pair of modes of twenty, by chance; these do, and are far apart."""
    shapes = np.array([[1.0, 0.9j, 0.5], [0.6, 0.75j, -0.8]])
    truth = SampledModes(2 * np.pi * np.array([4.0, 4.08, 9.0]), [0.012, 0.014, 0.015], shapes, [0.0, 1.0])
    assert 0.95 < mac(truth.shapes, truth.shapes)[0, 1] < 0.99
    record = free_decay(truth, sample_time=0.02, n_samples=1000, noise_std=0.002, seed=0)
    found, limit = identify(record).modes, cramer_rao_bound(truth, record, noise_std=0.002)
    assert found.n_modes == 3
    assert (np.abs(found.omega - truth.omega) < 4 * limit.omega_std).all()


def shaken(n_samples, seed, share=0.9):
    """Four modes at four sensors in noise of which most is common to all; the second mode moves all alike."""
    rng = np.random.default_rng(seed)
    shapes = rng.standard_normal((4, 4))
    shapes[:, 1] = 1.0 + 0.1 * rng.standard_normal(4)
    omega = 2 * np.pi * np.array([11.7, 38.2, 92.9, 181.4])
    modes = SampledModes(omega, [0.006, 0.004, 0.005, 0.003], shapes, np.linspace(0, 1, 4))
    quiet = free_decay(modes, sample_time=1e-3, n_samples=n_samples)
    common, own = rng.standard_normal(n_samples), rng.standard_normal((4, n_samples))
    noise = 3e-3 * np.abs(quiet.outputs).max() * (np.sqrt(share) * common + np.sqrt(1.0 - share) * own)
    return modes, replace(quiet, outputs=quiet.outputs + noise)


@pytest.mark.parametrize(
    ("n_samples", "seed"),
    [(4096, 2), (40_000, 2), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((4096, 5), (40_000, 4)))],
)
def test_noise_that_sensors_share_is_no_mode(n_samples, seed):
    modes, record = shaken(n_samples, seed)
    found = identify(record)
    np.testing.assert_allclose(found.modes.omega, modes.omega, rtol=1e-3)


def test_standard_errors_hold_in_noise_that_sensors_share():
    """Of the mode that moves all sensors as that noise does: by each sensor's noise alone they were half as large."""
    off = []
    for seed in range(40):
        modes, record = shaken(1024, seed)
        found = in_coloured_noise(refine(record, modes, offset=True), record)
        off.append((found.modes.omega[1] - modes.omega[1]) / found.omega_std[1])
        off.append((found.modes.zeta[1] - modes.zeta[1]) / found.zeta_std[1])
    assert 0.75 < np.sqrt(np.mean(np.square(off))) < 1.25


def test_candidates_of_fast_decay_are_compared_exactly_and_at_no_more_frequencies_than_they_resolve():
    """χ² of a damped exponential beside a mode, against least squares; steps of a quarter of its rate at most."""
    n, dt, time = 3000, 0.01, 0.01 * np.arange(3000)
    rng, pole = np.random.default_rng(0), -0.5 + 60.0j
    record = Record(dt, rng.standard_normal((2, n)), tuple(Channel(c, "velocity") for c in "ab"))
    grid = _Grid(record, n)
    columns = np.column_stack([part(np.exp(pole * time)) for part in (np.real, np.imag)])
    left = record.outputs.T - columns @ np.linalg.lstsq(columns, record.outputs.T, rcond=None)[0]
    strengths = grid.strengths(left, np.ones(2), np.array([pole]))
    for k, cells in enumerate(grid.cells):
        at = cells[np.argmin(np.abs(grid.omega[cells] - 61.5 - 2.0 * grid.rates[k]))]
        trial = np.exp((-grid.rates[k] + 1j * grid.omega[at]) * time)
        both = np.linalg.qr(np.column_stack([columns, trial.real, trial.imag]))[0]
        assert strengths[k, at] == pytest.approx(float(((both.T @ left) ** 2).sum()), rel=1e-6)
        assert np.diff(grid.omega[cells]).max() <= max(grid.rates[k] / 4.0, 1.01 * np.diff(grid.omega).max())
    assert sum(map(len, grid.cells)) < 0.7 * grid.n_cells


def search_of(poles, amplitudes):
    """The selection of one sensor's modes, and its models of some of them, fitted."""
    time = 0.02 * np.arange(1500)
    outputs = (np.array(amplitudes) @ np.exp(np.outer(poles, time))).real
    outputs = outputs + 0.01 * np.random.default_rng(0).standard_normal(time.size)
    record = Record(0.02, outputs[None], (Channel("a", "velocity"),))
    problem = _FreeDecay([record], 0.001, [record], TimeLimit(), [])
    return problem, lambda *which: problem.settled(replace(problem.nothing, poles=np.array(poles)[list(which)]))


def test_a_mode_is_not_blamed_for_a_pair_elsewhere(monkeypatch):
    """Two modes in one sensor may come to look like one when a third, far off, has entered."""
    problem, of = search_of([-0.2 + 20.0j, -0.2 + 20.4j, -0.3 + 60.0j], [1.0, 0.8, 0.1])
    monkeypatch.setattr(problem, "_distinct", lambda poles, r, s: poles.size == 2)
    assert not problem.splits(of(0, 1), of(0, 1, 2))
    assert problem.splits(of(0, 2), of(0, 2, 1))


def test_what_would_split_a_mode_again_waits_for_modes_elsewhere():
    poles = [-0.2 + 20.0j, -0.2 + 20.4j, -0.6 + 60.0j]
    problem, of = search_of(poles, [1.0, 0.8, 0.23])
    first = problem.strongest(of(0), [])
    assert first.imag == pytest.approx(20.4, abs=0.1)
    assert problem.strongest(of(0), [(first, 0.0)]).imag == pytest.approx(60.0, abs=0.5)
    problem, of = search_of(poles[:2], [1.0, 0.8])
    assert problem.strongest(of(0), [(first, 0.0)]).imag < 25.0


@pytest.mark.parametrize("seed", [0, 1])
def test_modes_that_drift_in_time_are_all_found(seed):
    """Frequencies fall by 0.5 % over the record; what the strongest leaves is no noise to whiten the others by."""
    time, omega = 0.002 * np.arange(3000), np.array([344.2714, 653.3213, 885.0571])
    amplitudes = np.array([[18.5, 37.0, 23.8], [26.3, 12.0, -44.7], [19.0, -32.6, 16.4]])
    phase = np.outer(omega, time - 0.005 * time**2 / (2.0 * time[-1]))
    motion = amplitudes @ (np.exp(-0.003 * np.outer(omega, time)) * np.sin(phase))
    noise = np.random.default_rng(seed).standard_normal(motion.shape) * 1e-3 * motion.std(axis=1, keepdims=True)
    channels = tuple(Channel(f"y{i}", "acceleration") for i in range(3))
    found = identify(Record(0.002, motion + noise, channels)).modes.omega
    assert all((np.abs(found / true - 1.0) < 0.005).any() for true in omega), found


@pytest.mark.parametrize("seed", [1, 4])
def test_rounding_makes_no_modes(seed):
    """Eight bits: what rounding adds goes with the motion, and made 35 and 20 modes of three."""
    rng = np.random.default_rng(seed)
    omega, zeta = 2.0 * np.pi * np.sort(rng.uniform(2.0, 60.0, 3)), rng.uniform(0.003, 0.02, 3)
    modes = SampledModes(omega, zeta, rng.standard_normal((3, 3)), np.linspace(0.0, 1.0, 3))
    clean = free_decay(modes, sample_time=0.005, n_samples=1500, quantity="acceleration")
    step = np.abs(clean.outputs).max(axis=1, keepdims=True) / 128.0
    found = identify(replace(clean, outputs=step * np.round(clean.outputs / step)))
    assert found.modes.n_modes == 3 and (np.abs(found.modes.omega - omega) < 3.5 * found.omega_std).all()
    assert not [remark for remark in found.remarks if "depends on amplitude" in remark]
