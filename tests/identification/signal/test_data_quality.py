import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from workbench.identification.free_decay.order import identify
from workbench.identification.signal import data_quality
from workbench.identification.signal.data_quality import check_data_quality, data_faults, of_same_sensors, steps
from workbench.identification.signal.synthesis import free_decay
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes

ROOT = Path(__file__).resolve().parents[3]
ARM = Path(os.environ.get("WORKBENCH_SHARED", ROOT.parent / "shared")) / "measured" / "arm-ringdown"


@pytest.fixture(scope="module")
def sound():
    shapes = np.random.default_rng(3).standard_normal((4, 3))
    modes = SampledModes([19.0, 57.0, 88.0], [0.01, 0.006, 0.02], shapes, np.linspace(0, 1, 4))
    return free_decay(modes, sample_time=0.01, n_samples=800, noise_std=0.003, seed=1)


def with_row(record, j, row):
    outputs = record.outputs.copy()
    outputs[j] = row
    return replace(record, outputs=outputs)


def only(record):
    [found] = data_faults(record)
    return found


def test_a_sound_record_has_none(sound):
    assert data_faults(sound) == ()
    check_data_quality(sound)


def test_single_mode_without_noise_is_no_copy():
    modes = SampledModes([19.0], [0.01], [[1.0], [0.5], [-0.7]], np.linspace(0, 1, 3))
    assert data_faults(free_decay(modes, sample_time=0.01, n_samples=800)) == ()


@pytest.mark.parametrize("steps", [2, 5, 30, 300])
@pytest.mark.parametrize("omega", [0.31, 3.0, 57.0])
@pytest.mark.parametrize("zeta", [0.0002, 0.01])
def test_rounding_is_neither_clipping_nor_another_rate(steps, omega, zeta):
    modes = SampledModes([omega], [zeta], [[float(steps)]], [0.0])
    clean = free_decay(modes, sample_time=0.01, n_samples=4000)
    assert data_faults(replace(clean, outputs=np.round(clean.outputs))) == ()


def test_dead_sensor(sound):
    found = only(with_row(sound, 2, 5.0))
    assert (found.kind, found.outputs) == ("dead", ("y3",)) and "'y3' stays at 5" in found.message


def test_counter_is_no_sensor(sound):
    assert "clock or a counter" in only(with_row(sound, 2, np.arange(800.0))).message


@pytest.mark.parametrize("scale", [1.0, -2.5])
def test_copied_sensor(sound, scale):
    found = only(with_row(sound, 3, scale * sound.outputs[1] + 0.2))
    assert (found.kind, found.outputs) == ("copied", ("y2", "y4"))


def test_clipped_sensor_and_when_it_ends(sound):
    limit = 0.6 * np.abs(sound.outputs[1]).max()
    found = only(with_row(sound, 1, np.clip(sound.outputs[1], -limit, limit)))
    last = sound.time[np.abs(sound.outputs[1]) > limit][-1]
    assert (found.kind, found.outputs) == ("clipped", ("y2",)) and abs(found.until - last) < 0.2
    assert f"{limit:g}" in found.message and "begin later" in found.message


def test_sensor_of_another_rate(sound):
    slow, time = sound.outputs[0, ::4], sound.time
    held = only(with_row(sound, 0, np.repeat(slow, 4)))
    joined = only(with_row(sound, 0, np.interp(time, time[::4], slow)))
    for found in (held, joined):
        assert (found.kind, found.outputs) == (
            "upsampled",
            ("y1",),
        ) and "once in 4 samples only: it was sampled at 25 Hz" in found.message
    assert "held" in held.message and "straight lines" in joined.message


def test_an_output_of_no_quantity_among_accelerations(sound):
    channels = sound.output_channels[:2] + (Channel("y3"),) + sound.output_channels[3:]
    found = only(replace(sound, output_channels=channels))
    assert (found.kind, found.outputs) == ("unstated", ("y3",)) and "'y3 [m/s^2]'" in found.message
    assert data_faults(replace(sound, output_channels=tuple(Channel(c.name) for c in channels))) == ()
    with pytest.raises(ValueError, match="'y3' states no quantity, and 'y1' measures displacement"):
        check_data_quality(replace(sound, output_channels=channels))


def test_an_output_of_an_unknown_unit_among_accelerations(sound):
    channels = (*sound.output_channels[:3], Channel("y4 [furlong/s^2]"))
    found = only(replace(sound, output_channels=channels))
    assert found.kind == "unstated" and "states the unit furlong/s^2, which is not known" in found.message
    assert "known unit, one of m/s^2, " in found.message and "[m/s^2]'" not in found.message


def driven(sound, force):
    return replace(sound, inputs=force[None], input_channels=(Channel("F", "force"),))


BLOWS = np.zeros(800)
BLOWS[100:108] = 50.0 * np.sin(np.pi * np.arange(8) / 8)
BLOWS[500:508] = 60.0 * np.sin(np.pi * np.arange(8) / 8)
NOISE = np.random.default_rng(0).standard_normal(800)


@pytest.mark.parametrize(
    ("force", "said"),
    [
        (np.clip(NOISE, -1.2, 1.2), "clipped at 1.2 and -1.2"),
        (np.minimum(NOISE, 1.2), "clipped at 1.2,"),
        (np.round(50 * np.clip(NOISE, -1.2, 1.2)), "clipped at 60 and -60"),
        (np.minimum(BLOWS, 35.0), "clipped at 35, 10 samples"),
        (np.minimum(BLOWS, 35.0) + 0.01 * np.abs(NOISE) * (BLOWS < 35.0), "clipped at 35, 10 samples"),
    ],
)
def test_a_clipped_input_is_said_and_not_refused(sound, force, said):
    [found] = data_faults(driven(sound, force))
    assert (found.kind, found.outputs, found.inputs) == ("clipped", (), ("F",)) and said in found.message
    check_data_quality(driven(sound, force))


@pytest.mark.parametrize(
    "force",
    [
        NOISE, np.round(20 * NOISE), BLOWS, np.round(BLOWS), np.sign(NOISE), np.repeat(np.sign(NOISE[:100]), 8),
        np.repeat(np.append(NOISE[:40], 3.0), 20)[:800], np.r_[0.0, np.ones(799)], np.zeros(800),
        np.sin(2.0 * np.pi * 0.013 * np.arange(800)), np.round(30 * np.sin(2.0 * np.pi * 0.013 * np.arange(800))),
        np.maximum(np.sin(2.0 * np.pi * 0.013 * np.arange(800)), 0.0),
        2.5 * np.sin(2.0 * np.pi * np.cumsum(np.repeat(np.arange(4.0, 12.0), 100)) / 200.0),
    ],
)  # fmt: skip
def test_inputs_as_they_are_sent_are_not_clipped(sound, force):
    """Noise, blows, switched levels, held levels, a step, nothing, sines, half sines from rest; some rounded."""
    assert data_faults(driven(sound, force)) == ()


def test_identify_refuses_what_ails(sound):
    with pytest.raises(ValueError, match="'y3' stays at 5"):
        identify(with_row(sound, 2, 5.0))
    with pytest.raises(ValueError, match="same signal"):
        identify(with_row(sound, 3, sound.outputs[0]))


def test_measured_arm_ails_in_nothing():
    if not ARM.is_dir():
        pytest.skip(f"measured records are not at {ARM}")
    for path in sorted(ARM.glob("*.txt")):
        table = np.loadtxt(path)
        assert data_faults(Record(0.002, table[:, -1][None], (Channel("a"),))) == ()


def test_a_record_given_twice_is_refused(sound):
    """Its errors would be too small by the root of two."""
    with pytest.raises(ValueError, match="'one' and 'again' hold the same measurement"):
        identify([replace(sound, name="one"), replace(sound, name="again")])


def test_records_of_one_name_and_other_sensors_are_refused(sound):
    """Their outputs have no common shapes: accelerations grow with the square of the frequency."""
    again = replace(sound, outputs=sound.outputs[:, ::-1])
    assert len(of_same_sensors([sound, again])) == 2
    channels = sound.output_channels
    placed = replace(again, output_channels=tuple(replace(c, at=None if c is channels[3] else c.at) for c in channels))
    assert len(of_same_sensors([sound, placed])) == 2
    for change, words in (
        (
            {"quantity": "acceleration", "unit": ""},
            "'y2' measures displacement at 0.3333 in 'free decay' and acceleration",
        ),
        ({"at": 0.5}, "'y2' measures displacement at 0.3333 in 'free decay' and displacement at 0.5 in"),
    ):
        other = (channels[0], replace(channels[1], **change), *channels[2:])
        with pytest.raises(ValueError, match=words):
            of_same_sensors([sound, replace(again, output_channels=other)])


def test_two_measurements_on_one_large_offset_are_two(sound):
    """As of accelerometers that measure gravity too: the motion counts, not the offset."""
    offset = 1e6 * sound.outputs.std()
    up, down = (replace(sound, name=str(sign), outputs=offset + sign * sound.outputs) for sign in (1, -1))
    assert of_same_sensors([up, down]) == [up, down]


def test_a_measurement_given_again_in_other_units_or_digits_is_refused(sound):
    """Read back from six digits, or from numbers in g, it differs in the last ones."""
    digits = np.vectorize(lambda value: float(f"{value:.6g}"))
    again = replace(sound, name="again", outputs=digits(sound.outputs / 9.80665) * 9.80665)
    with pytest.raises(ValueError, match="hold the same measurement, which would count twice: give it once"):
        of_same_sensors([sound, again])
    with pytest.raises(ValueError, match="hold the same measurement"):
        of_same_sensors([sound.between(stop=0.5 * sound.time[-1]), again])
    noise = 1e-4 * sound.outputs.std() * np.random.default_rng(0).standard_normal(sound.outputs.shape)
    assert len(of_same_sensors([sound, replace(sound, outputs=sound.outputs + noise)])) == 2


def test_the_step_of_a_rounded_output_is_read_from_it(sound):
    rounded = with_row(sound, 1, 0.3 + 0.02 * np.round(sound.outputs[1] / 0.02))
    np.testing.assert_allclose(steps(rounded), [0.0, 0.02, 0.0, 0.0], rtol=1e-9)


def test_copies_of_one_signal_are_compared_with_it_at_once(monkeypatch):
    """What the past of a signal predicts is asked once, not once for each of its copies."""
    signals, asked = np.random.default_rng(0).standard_normal((3, 400)), []
    innovation = data_quality._innovation_std
    monkeypatch.setattr(data_quality, "_innovation_std", lambda row: asked.append(row) or innovation(row))
    rows = np.vstack([signals] * 20) * np.linspace(-2.0, 3.0, 60)[:, None]
    faults = data_faults(Record(0.01, rows, tuple(Channel(f"y{j}", "displacement") for j in range(60))))
    assert [fault.outputs for fault in faults] == [(f"y{i}", f"y{j}") for i in range(3) for j in range(i + 3, 60, 3)]
    assert len(asked) == 3
