"""Records survive every format, and damaged files are named."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from workbench.records.files import FORMATS, READ_ONLY, RecordFileError, read_record, write_record
from workbench.records.record import Channel, Record
from workbench.structure.domain import Between, Patch


def sample() -> Record:
    rng = np.random.default_rng(1)
    return Record(
        sample_time=0.002,
        outputs=rng.standard_normal((2, 50)),
        output_channels=(
            Channel("tip", "displacement", at=1.25, noise_std=1e-3),
            Channel("root strain", "strain", "1", at=0.0),
        ),
        inputs=rng.standard_normal((1, 50)),
        input_channels=(Channel("hammer", "force", at=0.5),),
        input_hold="first",
        start_time=0.1,
        name="a run",
    )


@pytest.mark.parametrize("ending", sorted(set(FORMATS) - set(READ_ONLY)))
def test_a_record_comes_back_as_it_went(tmp_path, ending):
    record = sample()
    back = read_record(write_record(record, tmp_path / f"run{ending}"))
    exact = 1e-10 if ending in (".uff", ".unv") else 0.0
    np.testing.assert_allclose(back.outputs, record.outputs, rtol=exact, atol=0)
    np.testing.assert_allclose(back.inputs, record.inputs, rtol=exact, atol=0)
    assert back.output_channels == record.output_channels
    assert back.input_channels == record.input_channels
    for what in ("sample_time", "start_time", "name", "input_hold"):
        assert getattr(back, what) == getattr(record, what)


@pytest.mark.parametrize("ending", [".csv", ".uff", ".npz"])
def test_a_record_of_one_sample_is_not_written(tmp_path, ending):
    """What was written could not be read; UFF failed within its writer."""
    with pytest.raises(RecordFileError, match="'x' has one sample"):
        write_record(Record(1.0, [[1.0]], (Channel("a"),), name="x"), tmp_path / f"run{ending}")


@pytest.mark.parametrize("ending", [".csv", ".uff"])
@pytest.mark.parametrize(("start", "step"), [(123.4567, 1e-3), (-5.0, 0.01), (1.7e9, 1e-6)])
def test_a_record_that_starts_late_comes_back(tmp_path, ending, start, step):
    """UFF rounds the start to six digits, and floats the instants of a microsecond since 1970; both were refused."""
    record = replace(sample(), start_time=start, sample_time=step)
    back = read_record(write_record(record, tmp_path / f"run{ending}"))
    assert (back.start_time, back.sample_time) == (start, step)


@pytest.mark.parametrize("ending", [".csv", ".uff", ".npz"])
def test_places_between_two_and_patches_come_back(tmp_path, ending):
    """They were written as bare numbers, and read as a pair (x, y) or not at all."""
    places = (Between(0.2, 0.5), Between("tip", "root"), Between((0.1, 0.2), (0.3, 0.4)), Patch(0.3, 0.4, 0.1, 0.2))
    channels = tuple(Channel(f"u{i}", "force", at=at) for i, at in enumerate((*places, (0.2, 0.5), "tip", None)))
    record = replace(sample(), inputs=np.ones((len(channels), 50)), input_channels=channels)
    assert read_record(write_record(record, tmp_path / f"run{ending}")).input_channels == channels


def test_the_hold_of_inputs_is_kept_and_can_be_given(tmp_path):
    record = replace(sample(), input_hold="zero")
    path = write_record(record, tmp_path / "run.csv")
    assert read_record(path).input_hold == "zero"
    assert read_record(path, input_hold="first").input_hold == "first"
    with pytest.raises(ValueError, match="input_hold is zero"):
        read_record(path, input_hold="second")


def test_files_from_before_holds_were_written_are_read(tmp_path):
    """Line by line as `write_record` wrote it then."""
    path = tmp_path / "run.csv"
    path.write_text(
        '# record {"name": "x", "sample_time": 0.5, "start_time": 0.0, "channels": [{"kind": "output", "name": "a",'
        ' "quantity": "", "unit": "", "at": null, "noise_std": null}], "crc32": 80559312}\n'
        "time,output:a\n0.0,1.0\n0.5,2.0\n"
    )
    assert read_record(path).input_hold == "zero"


def test_a_plain_csv_of_another_program(tmp_path):
    path = tmp_path / "plain.csv"
    path.write_text("time,v,theta\n0.0,1,2\n0.5,3,4\n1.0,5,6\n")
    record = read_record(path, inputs=("v",))
    assert record.input_names == ("v",) and record.output_names == ("theta",)
    np.testing.assert_array_equal(record.outputs, [[2, 4, 6]])
    assert record.sample_time == 0.5


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("time,a\n0,1\n1,x\n", "channel 'a', row 3"),
        ("time,a\n0,1\n1,nan\n2,2\n", "channel 'a', row 3"),
        ("time,a\n0,1\n1,2,3\n", "row 3 has 3 fields"),
        ("time,a\n0,1\n1,2\n5,3\n", "not uniformly sampled"),
        ("0,1\n1,2\n", "header"),
        ("a,a\n1,2\n3,4\n", "columns 1 and 2 are both called 'a'"),
        ("a,b\n1,2\n3,4\n", "sample_rate_hz"),
    ],
)
def test_a_damaged_csv_is_named(tmp_path, text, words):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(RecordFileError, match=words) as caught:
        read_record(path)
    assert "bad.csv" in str(caught.value)


@pytest.mark.parametrize("ending", [".npz", ".mat", ".h5", ".uff"])
def test_a_file_that_is_something_else_is_refused(tmp_path, ending):
    path = tmp_path / f"bad{ending}"
    path.write_bytes(b"this is not a record" * 10)
    with pytest.raises(RecordFileError):
        read_record(path)


def test_channels_of_unequal_length_are_named(tmp_path):
    np.savez(tmp_path / "x.npz", t=np.arange(5.0), a=np.arange(5.0), b=np.arange(4.0))
    with pytest.raises(RecordFileError, match="'b' has 4 samples"):
        read_record(tmp_path / "x.npz")


def matlab_7_3(path, structs):
    """A file as MATLAB writes structs with -v7.3: a group each, rows as columns."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, fields in structs.items():
            group = file.create_group(name)
            group.attrs["MATLAB_class"] = np.bytes_("struct")
            for field, values in fields.items():
                group.create_dataset(field, data=np.asarray(values).T).attrs["MATLAB_class"] = np.bytes_("double")
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


@pytest.mark.parametrize("write", [savemat, matlab_7_3])
def test_the_fields_of_one_struct_are_signals(write, tmp_path):
    t = 0.01 * np.arange(50.0)
    fields = {"t": t[:, None], "a1": np.sin(t)[:, None], "a2": np.cos(t)[:, None]}
    write(tmp_path / "one.mat", {"meas": fields})
    read = read_record(tmp_path / "one.mat")
    assert read.output_names == ("a1", "a2") and read.sample_time == pytest.approx(0.01)
    np.testing.assert_allclose(read.outputs, [np.sin(t), np.cos(t)])
    write(tmp_path / "two.mat", {"meas": fields, "other": fields})
    with pytest.raises(RecordFileError, match=r"no signals but in structs: meas with .*a1.*; other with .*'-struct'"):
        read_record(tmp_path / "two.mat")


@pytest.mark.parametrize("ending", [".npz", ".mat"])
def test_arrays_of_several_rows_are_as_many_signals(tmp_path, ending):
    """As benchmarks come: one array of accelerations, one of force, and the sample rate as `Fs`."""
    rng, path = np.random.default_rng(0), tmp_path / f"x{ending}"
    force, moved = rng.standard_normal((1, 40)), rng.standard_normal((3, 40))
    for values in (moved, moved.T):
        held = {"Force": force, "Acceleration": values, "Fs": np.array([[400.0]])}
        np.savez(path, **held) if ending == ".npz" else savemat(path, held)
        read = read_record(path, inputs=("Force",))
        assert read.sample_rate_hz == pytest.approx(400.0)
        assert read.output_names == ("Acceleration 1", "Acceleration 2", "Acceleration 3")
        np.testing.assert_array_equal(read.outputs, moved)
        np.testing.assert_array_equal(read.inputs, force)


@pytest.mark.parametrize("shape", [(5, 5), (5, 4, 3), (3, 2)])
def test_an_array_whose_time_axis_is_unknown_is_refused(tmp_path, shape):
    np.savez(tmp_path / "x.npz", t=np.arange(5.0), a=np.ones(shape))
    with pytest.raises(RecordFileError, match="rows of samples are needed"):
        read_record(tmp_path / "x.npz")


def test_a_pickle_is_never_opened(tmp_path):
    np.savez(tmp_path / "x.npz", t=np.arange(3.0), a=np.array([{}, [], 1], dtype=object))
    with pytest.raises(RecordFileError):
        read_record(tmp_path / "x.npz")


def test_python_control_round_trip():
    record = sample()
    back = Record.from_control(record.to_control())
    np.testing.assert_array_equal(back.outputs, record.outputs)
    np.testing.assert_array_equal(back.inputs, record.inputs)
    assert back.output_names == record.output_names


def test_signals_named_as_inputs_become_inputs():
    values = np.arange(12.0).reshape(4, 3)
    u, v, a, b = (Channel(name) for name in "uvab")
    record = Record(0.1, values[2:], (a, b), values[:2], (u, v), input_hold="first")
    found = record.with_inputs(["b", "u"])
    assert (found.input_names, found.output_names, found.input_hold) == (("u", "b"), ("v", "a"), "first")
    np.testing.assert_array_equal(np.vstack([found.inputs, found.outputs]), values[[0, 3, 1, 2]])
    alone = record.with_inputs("uvab")
    assert alone.input_names == alone.output_names == tuple("uvab")
    with pytest.raises(ValueError, match="no signal 'c' to take as an input; it has u, v, a, b"):
        record.with_inputs(["c"])


def test_a_record_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="channel 'a': sample 1 is nan"):
        Record(sample_time=0.1, outputs=[[1.0, np.nan]], output_channels=(Channel("a"),))
    with pytest.raises(ValueError, match="time the last axis"):
        Record(sample_time=0.1, outputs=np.zeros((50, 2)), output_channels=(Channel("a"), Channel("b")))
