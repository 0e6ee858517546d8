"""A record as it really comes: before the decay, drifting, clipped, or no decay at all."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from workbench.identification.ring_down import _check_undriven, by_remark, ring_down
from workbench.identification.signal.data_quality import dropouts
from workbench.identification.signal.harmonics import near_mains
from workbench.identification.signal.synthesis import free_decay
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes

ROOT = Path(__file__).resolve().parents[2]
ARM = Path(os.environ.get("WORKBENCH_SHARED", ROOT.parent / "shared")) / "measured" / "arm-ringdown"
MODES = SampledModes([8.0, 30.0], [0.01, 0.02], [[1.0, 0.5], [0.3, -0.8]], [0.0, 1.0])
RNG = np.random.default_rng(4)


def decay(n=1000, noise=0.005, seed=3):
    return free_decay(MODES, sample_time=0.02, n_samples=n, noise_std=noise, quantity="velocity", seed=seed)


def found_within_errors(told):
    omega = told.refined.modes.omega
    return omega.shape == (2,) and (np.abs(omega - MODES.omega) < 4 * told.refined.omega_std).all()


@pytest.mark.parametrize("of", ["output", "record"])
def test_a_clock_that_runs_fast_is_told_from_twice_as_many_modes(of):
    """By 0.1 %, of one output or of one of two records: every frequency is 1.001 times that of the others."""
    shapes = np.array([[1.0, 0.5, -0.7], [0.3, -0.8, 0.6], [0.7, 0.9, 0.4]])

    def at_rate(rate, seed):
        modes = SampledModes(rate * np.array([8.0, 17.0, 30.0]), [0.003] * 3, shapes, np.arange(3.0))
        return free_decay(modes, sample_time=0.02, n_samples=4000, noise_std=0.001, seed=seed)

    right, fast = at_rate(1.0, 1), at_rate(1.001, 2)
    mixed = [replace(right, outputs=np.vstack([right.outputs[:2], fast.outputs[2:]]))]
    told = ring_down(mixed if of == "output" else [right, fast])
    assert told.modes.n_modes == 6
    assert any("pairs whose frequencies all differ by 0.1 %" in note for note in told.notes)


def test_two_modes_of_one_frequency_have_no_one_shape_in_several_decays():
    """Modes (1, 2) and (2, 1) of a hinged square plate, sin iπx sin jπy, struck at three places; (1, 1) is one."""
    x, y = np.array([[0.2, 0.15], [0.35, 0.6], [0.7, 0.25], [0.6, 0.8]]).T
    one, two, three = (np.sin(i * np.pi * x) * np.sin(j * np.pi * y) for i, j in ((1, 1), (1, 2), (2, 1)))
    records = []
    for seed, (a, b) in enumerate(((1.0, 0.2), (-0.1, 1.0), (0.7, -0.6))):
        shapes = np.column_stack([one, a * two + b * three])
        modes = SampledModes([8.0, 20.0], [0.01, 0.01], shapes, np.arange(4.0))  # as i² + j²
        records.append(free_decay(modes, sample_time=0.02, n_samples=1000, noise_std=0.005, seed=seed))
    told = [note for note in ring_down(records).notes if "the shape differs between the records for" in note]
    assert len(told) == 1 and "records for mode 2 (3.183 Hz, " in told[0] and "mode 1" not in told[0]
    assert not any("the shape differs" in note for note in ring_down(records[:1]).notes)


def test_quiet_before_the_blow_and_a_drift_all_along():
    after = decay()
    outputs = np.hstack([0.005 * RNG.standard_normal((2, 300)), after.outputs])
    outputs = outputs + [[1.0], [-0.5]] * np.exp(-0.02 * np.arange(1300) / 9.0)
    told = ring_down(replace(after, outputs=outputs))
    assert told.records[0].start_time == pytest.approx(6.0, abs=0.05)
    assert found_within_errors(told) and told.remarks == ("", "")
    assert "free decay from" in told.notes[0] and told.notes[1].startswith("settling (time constant 9.0")


@pytest.mark.parametrize(("n", "limit"), [(1000, 5.0), (190, 10.0)])
def test_clipped_part_is_left_out(n, limit):
    """In a long record clipping breaks the rule of free decay; a short one cannot tell that rule."""
    record = decay(n=n, noise=0.01)
    outputs = record.outputs.copy()
    outputs[0] = np.clip(outputs[0], -limit, limit)
    told = ring_down(replace(record, outputs=outputs))
    last = record.time[np.abs(record.outputs[0]) > limit][-1]
    assert last - 0.1 < told.records[0].start_time < last + 0.5 and found_within_errors(told)
    if n == 190:
        begins = f"used from {told.records[0].start_time:g} s on"
        assert told.notes == (f"output 'y1' is clipped: {begins}",)
    with pytest.raises(ValueError, match="begin later, or measure with a larger range"):
        ring_down(replace(record, outputs=outputs), start=0.0)


def test_growth_is_refused():
    record = decay()
    with pytest.raises(ValueError, match=r"grows: its strongest mode, 4\.775"):
        ring_down(replace(record, outputs=record.outputs[:, ::-1]))


def test_noise_is_refused():
    noise = Record(0.01, RNG.standard_normal((3, 800)), tuple(Channel(f"y{i}") for i in range(3)))
    with pytest.raises(ValueError, match="no mode that rises above its noise"):
        ring_down(noise)


@pytest.mark.parametrize("seed", range(4))
def test_driven_record_is_refused(seed):
    n, pole, rng = 20_000, np.exp((-0.24 + 8.0j) * 0.02), np.random.default_rng(seed)
    force = rng.standard_normal(n)
    motion = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], force)
    driven = Record(0.02, np.vstack([motion, 0.5 * motion + 0.3 * force]), (Channel("a"), Channel("b")))
    with pytest.raises(ValueError, match="not correlated over its length"):
        ring_down(driven, start=0.0)


def test_many_modes_that_hardly_decay_are_not_taken_for_driven():
    omega = np.sort(RNG.uniform(5.0, 140.0, 20))
    modes = SampledModes(omega, np.full(20, 1e-5), RNG.standard_normal((3, 20)), np.arange(3.0))
    _check_undriven(free_decay(modes, sample_time=0.02, n_samples=2000, noise_std=0.5))


@pytest.mark.parametrize("n", [1, 2, 3, 5, 6])
def test_a_record_of_few_samples_asks_for_more_without_a_warning(n, recwarn):
    with pytest.raises(ValueError, match=f"has {n} samples; a mode needs 7: measure longer"):
        ring_down(decay(n, noise=0.0))
    assert not recwarn.list


def test_number_of_modes_as_asked():
    assert ring_down(decay(), n_modes=1).refined.modes.n_modes == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seen"),
    [("hold_and_release_1", (2.5, 18.0, 53.0, 107.0, 178.5)), ("ping_mid_beam_hard", (2.5, 18.0, 53.0, 107.0, 178.5))],
)
def test_modes_of_the_measured_arm(name, seen):
    """Those seen by eye in its spectra; the second record drifts by more than the modes motion."""
    if not ARM.is_dir():
        pytest.skip(f"measured records are not at {ARM}")
    table = np.loadtxt(ARM / f"{name}.txt")
    told = ring_down(Record(0.002, table[:, -1][None], (Channel("a", "acceleration"),)))
    sure = told.refined.modes.frequencies_hz[[not remark for remark in told.remarks]]
    for frequency in seen:
        assert np.abs(sure / frequency - 1.0).min() < 0.02


def test_records_together_each_from_its_own_start():
    quiet = 0.005 * RNG.standard_normal((2, 300))
    first = decay()
    second = replace(first, outputs=np.hstack([quiet, decay(n=900, seed=5).outputs]), name="second")
    told = ring_down([first, second])
    assert [round(record.start_time) for record in told.records] == [0, 6]
    assert found_within_errors(told) and told.notes[0].startswith("second: free decay from 6")
    assert (told.refined.omega_std < ring_down(first).refined.omega_std).all()


@pytest.mark.slow
def test_swept_record_is_remarked():
    """A sweep lets mode after mode ring, and goes on."""
    time, pole = 0.02 * np.arange(1000), np.exp((-0.24 + 12.0j) * 0.02)
    force = np.sin(2 * np.pi * (0.5 + 0.5 * time) * time)
    motion = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], force)
    outputs = motion + 0.01 * motion.std() * RNG.standard_normal(1000)
    told = ring_down(Record(0.02, outputs[None], (Channel("a"),)), start=0.0)
    assert any("of the motion, is not white" in note for note in told.notes)


@pytest.mark.slow
def test_short_random_response_is_refused_or_remarked():
    n, pole = 1000, np.exp((-0.24 + 8.0j) * 0.02)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        motion = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.standard_normal((2, n)), axis=1)
        record = Record(0.02, motion + 0.02 * motion.std() * rng.standard_normal((2, n)), (Channel("a"), Channel("b")))
        try:
            told = ring_down(record, start=0.0)
        except ValueError as error:
            assert "no free decay" in str(error) or "is it a free decay" in str(error) or "grows" in str(error)
        else:
            driven = ("it is driven, or depends strongly on amplitude", "harmonic excitation?")
            assert any(words in note for note in told.notes for words in driven), told.notes


def test_a_tone_is_remarked():
    record = decay()
    tone = 10.0 * np.sin(13.0 * record.time) * [[1.0], [-0.5]]
    told = ring_down(replace(record, outputs=record.outputs + tone))
    assert "does not decay within the record" in told.notes[0]
    assert told.remarks == ("", "does not decay within the record", "")


@pytest.mark.parametrize(("hertz", "told"), [(50.4, True), (50.7, False), (59.5, True), (149.6, True), (2.07, False)])
def test_mains_hum_is_asked_about_near_multiples_of_its_frequency(hertz, told):
    assert near_mains(hertz) == told


def test_modes_of_the_same_remark_share_a_line():
    assert by_remark(["", "grows", "hardly oscillates: a drift?", "grows"]) == [
        "modes 2 and 4: grows",
        "mode 3: hardly oscillates: a drift?",
    ]


def test_proportional_damping_is_told():
    omega = np.array([4.0, 9.0, 15.0, 26.0])
    shapes = np.random.default_rng(0).standard_normal((5, 4))
    modes = SampledModes(omega, 0.5 * (0.002 * omega + 0.1 / omega), shapes, np.linspace(0, 1, 5))
    fit = ring_down(free_decay(modes, sample_time=0.05, n_samples=600, noise_std=0.02, seed=1)).proportional
    error = np.array([fit.damping.stiffness - 0.002, fit.damping.mass - 0.1])
    assert fit.probability > 0.01 and (np.abs(error) < 3.5 * fit.standard_errors).all()


def test_the_first_swing_of_heavily_damped_modes_is_no_settling():
    """The same modes are found as without a search for drifts."""
    omega, zeta = np.array([295.7, 553.3, 772.9, 913.5]), np.array([0.2, 0.15, 0.2, 0.1])
    shapes = np.array(
        [[0.36, -0.58, 0.57, -0.36], [0.58, -0.36, -0.36, 0.6], [0.6, 0.36, -0.38, -0.6], [0.37, 0.6, 0.6, 0.36]]
    )
    time, decay = 0.0005 * np.arange(2000), np.sqrt(1.0 - zeta**2) * omega
    each = (shapes[0] / decay)[:, None] * np.exp(-np.outer(zeta * omega, time)) * np.sin(np.outer(decay, time))
    motion = shapes @ each
    noise = np.random.default_rng(0).standard_normal(motion.shape) * 1e-3 * motion.std(axis=1, keepdims=True)
    channels = tuple(Channel(f"y{i}", "displacement") for i in range(4))
    found = ring_down(Record(0.0005, motion + noise, channels))
    assert not [note for note in found.notes if "settling" in note]
    np.testing.assert_allclose(found.modes.omega, omega, rtol=1e-3)
    np.testing.assert_allclose(found.modes.zeta, zeta, rtol=5e-3)


@pytest.mark.parametrize("which", [[1], [0, 1]])
def test_lost_samples_are_named_and_are_no_dependence_on_amplitude(which):
    record = decay(noise=0.001)
    outputs = record.outputs.copy()
    outputs[which, 300:306] = outputs[which, 299:300]
    told = ring_down(replace(record, outputs=outputs), start=0.0)
    assert any("'y2' stays" in note or "'y1' stays" in note for note in told.notes)
    assert any("for 7 samples from 5.98 s on" in note for note in told.notes) and not told.by_amplitude.depends.any()
    assert not [note for note in ring_down(record).notes if "stays" in note]


@pytest.mark.parametrize("level", [0.0, 0.1])
def test_a_decay_that_forces_drive_throughout_is_remarked(level):
    """One mode, struck and shaken by white noise: of the answer to that, parts look like modes without damping."""
    pole = np.exp(2.0 * np.pi * 0.1 * (-0.01 + 1j))
    force = level * np.random.default_rng(5).standard_normal(4000)
    force[0] += 10.0
    moves = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], force)
    moves += 1e-3 * np.random.default_rng(6).standard_normal(4000)
    told = ring_down(Record(0.02, moves[None], (Channel("a", "displacement"),)))
    assert any("cluster about mode" in note and "drive this decay throughout" in note for note in told.notes) == (
        level > 0
    )


def test_lone_wrong_samples_are_replaced_and_named():
    """As the record without them, to half a standard error."""
    record = decay()
    outputs = record.outputs.copy()
    outputs[0, 300] += outputs[0].std()
    outputs[1, 420] -= outputs[1].std()
    told, plain = ring_down(replace(record, outputs=outputs)), ring_down(record)
    assert told.notes == tuple(
        f"output {name!r} has a spike of one sample at {at:g} s, replaced by interpolation"
        for name, at in (("y2", 420 * 0.02), ("y1", 300 * 0.02))
    )
    assert told.records[0].n_samples == record.n_samples and not plain.notes
    assert (np.abs(told.modes.omega - plain.modes.omega) < 0.5 * plain.omega_std).all()


@pytest.mark.parametrize("straight", [False, True])
def test_lost_samples_that_end_the_search_for_the_start_are_named(straight):
    record = decay(noise=0.001)
    outputs = record.outputs.copy()
    last = outputs[1, 360] if straight else outputs[1, 299]
    outputs[1, 299:361] = np.linspace(outputs[1, 299], last, 62)
    told = ring_down(replace(record, outputs=outputs))
    how = "is linear in time for 62" if straight else "stays at one value for 62"
    assert any(f"'y2' {how} samples from 5.98 s on: lost data? Only what follows" in note for note in told.notes)
    assert found_within_errors(told)


def test_a_coarse_sensor_loses_no_samples():
    """Rounded to a hundredth of the motion, an output repeats itself where it turns back and where it ends."""
    record = decay(noise=0.002)
    assert dropouts(replace(record, outputs=np.round(record.outputs, 2))) == ()
