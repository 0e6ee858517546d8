"""The force window: which inputs are blows, and what becomes of the noise that their channels read between them."""

import numpy as np
import pytest
from scipy.signal import chirp, lfilter

from workbench.identification.driven import identify_driven
from workbench.identification.input_output.excitation import force_window
from workbench.records.record import Channel, Record

DT, N = 1e-3, 12_000
HZ, ZETA, RESIDUES = np.array([9.0, 31.0, 84.0]), np.array([0.01, 0.008, 0.012]), np.array([1.0, -0.6, 0.8])
NOISE = 0.3  # N, of a force channel that reads blows of 200 N


def answer(force):
    """Velocity of three modes, with noise of its sensor."""
    omega = 2.0 * np.pi * HZ
    poles = omega * (-ZETA + 1j * np.sqrt(1.0 - ZETA**2))
    each = [
        lfilter([0.0, DT], [1.0, -np.exp(pole * DT)], force.astype(complex)) * a
        for pole, a in zip(poles, RESIDUES, strict=True)
    ]
    read = 2.0 * np.real(np.sum(each, axis=0))
    return read + 1e-3 * read.std() * np.random.default_rng(2).normal(size=N)


def record_of(logged, output):
    return Record(
        sample_time=DT,
        outputs=output[None],
        output_channels=(Channel("v", "velocity"),),
        inputs=logged[None],
        input_channels=(Channel("hammer", "force"),),
    )


@pytest.fixture(scope="module")
def blows():
    force = np.zeros(N)
    for begin in (500, 6000):
        force[begin : begin + 12] = 200.0 * np.sin(np.pi * np.arange(12) / 11.0) ** 2
    return force


@pytest.mark.slow
def test_noise_of_a_force_channel_makes_no_modes(blows):
    logged = blows + NOISE * np.random.default_rng(1).normal(size=N)
    found = identify_driven(record_of(logged, answer(blows)), delays=0.0, seconds=200.0)
    assert found.modes.n_modes == 3
    assert found.modes.frequencies_hz == pytest.approx(HZ, rel=1e-4)
    assert found.modes.zeta == pytest.approx(ZETA, rel=1e-2)
    assert any("zero between impacts, where it reads 0.3 rms" in remark for remark in found.remarks)


def test_blows_stay_whole(blows):
    logged = 5.0 + blows + NOISE * np.random.default_rng(1).normal(size=N)  # and a constant
    (windowed,), remarks = force_window([record_of(logged, answer(blows))])
    assert len(remarks) == 1
    struck = blows > 0.0
    assert windowed.inputs[0][struck] == pytest.approx(logged[struck] - 5.0, abs=0.05)
    assert np.count_nonzero(windowed.inputs[0]) < 4 * struck.sum()


def test_other_excitations_stay_as_they_are():
    rng, time = np.random.default_rng(3), DT * np.arange(N)
    burst = np.where(time < 3.0, rng.normal(size=N), 1e-3 * rng.normal(size=N))
    steps = np.repeat(rng.choice([-1.0, 1.0], N // 20), 20)
    for force in (rng.normal(size=N), burst, steps, chirp(time, 1.0, 12.0, 200.0), np.eye(1, N)[0]):
        record = record_of(force, answer(force))
        assert force_window([record]) == ((record,), ())


def test_a_shaker_that_stays_attached_is_a_force_between_its_blows_too(blows):
    motion = answer(blows)
    logged = blows + 0.4 * motion / motion.std() + 0.1 * np.random.default_rng(4).normal(size=N)
    record = record_of(logged, motion)
    assert force_window([record]) == ((record,), ())
