"""Record files that were cut, overwritten, reordered or never a record: the right record or a refusal, nothing else."""

import resource

import h5py
import numpy as np
import pytest
import pyuff
from scipy.io import savemat
from typer.testing import CliRunner

from workbench.cli.app import app
from workbench.records.files import read_record, write_record
from workbench.records.limits import ReadLimits, RecordFileError
from workbench.records.record import Channel, Record
from workbench.study.pages.look import file_report

ENDINGS = (".csv", ".npz", ".mat", ".h5", ".uff")
LONGEST, MOST = 10.0, 2 * 2**20  # s; KiB, as the system counts
FORMATS_OF_OTHERS = (".mat", ".h5", ".uff")  # read in a process of their own


def sample() -> Record:
    rng = np.random.default_rng(2)
    return Record(
        sample_time=0.01,
        outputs=rng.standard_normal((2, 40)),
        output_channels=(Channel("tip", "velocity", at=0.5), Channel("b c", "displacement", at=1.5, noise_std=0.1)),
        inputs=rng.standard_normal((1, 40)),
        input_channels=(Channel("hammer", "force", at=0.7),),
        start_time=0.25,
        name="run",
    )


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut short, overwritten, a stretch repeated, removed or moved, a bit turned, or text put in."""
    a, b = sorted(int(i) for i in rng.integers(0, len(data), 2))
    kind = rng.integers(8)
    if kind == 0:
        return data[:a]
    if kind == 1:
        return data[:a] + rng.bytes(int(rng.integers(1, 9))) + data[a + 4 :]
    if kind == 2:
        return data[:b] + data[a:]
    if kind == 3:
        return data[:a] + data[a + int(rng.integers(1, 40)) :]
    if kind == 4:
        return data[:a] + bytes([data[a] ^ 1 << int(rng.integers(8))]) + data[a + 1 :]
    if kind == 5:
        middle = (a + b) // 2
        return data[:a] + data[middle:b] + data[a:middle] + data[b:]
    if kind == 6:
        return data[:a] + b"\xff" * int(rng.integers(1, 9)) + data[a + 8 :]
    words = (b"nan", b"1e999", b"-", b",,,", b"\x00" * 8, b"{", b"9" * 400, b"\n", "é".encode("latin-1"), b"[" * 5000)
    return data[:a] + words[rng.integers(len(words))] + data[a:]


def same(read: Record, whole: Record, exact: float) -> bool:
    return (
        (read.output_channels, read.input_channels) == (whole.output_channels, whole.input_channels)
        and (read.sample_time, read.start_time, read.name) == (whole.sample_time, whole.start_time, whole.name)
        and np.allclose(read.outputs, whole.outputs, rtol=exact, atol=0)
        and np.allclose(read.inputs, whole.inputs, rtol=exact, atol=0)
    )


def spent() -> float:
    """Processor time of this process and of those it has ended, s: by the clock a busy machine would be to blame."""
    times = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(time.ru_utime + time.ru_stime for time in times)


def peak_kib() -> int:
    return max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", ENDINGS)
def test_what_was_written_comes_back_whole_or_not_at_all(tmp_path, ending, count=None):
    """A file of our own carries a checksum, so no damage may go unseen."""
    whole = sample()
    data = write_record(whole, tmp_path / f"whole{ending}").read_bytes()
    rng = np.random.default_rng([7, ENDINGS.index(ending)])
    path = tmp_path / f"x{ending}"
    for i in range(count or (5 if ending in FORMATS_OF_OTHERS else 40)):
        path.write_bytes(damaged(data, rng))
        start = spent()
        try:
            read = read_record(path)
        except RecordFileError as error:
            assert path.name in str(error) and len(str(error)) < 1000
        else:
            assert same(read, whole, 1e-10 if ending == ".uff" else 0.0), f"damage {i} changed the record unseen"
        assert spent() - start < LONGEST
    assert peak_kib() < MOST


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_thousand_damaged_files(tmp_path, ending):
    test_what_was_written_comes_back_whole_or_not_at_all(tmp_path, ending, count=200)


TIME = 0.5 * np.arange(6)
WAVE = np.array([1.0, -2.0, 3.0, -4.0, 5.0, 6.0])


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("time,a\n0,1\n0.5,2\n1,3\n", {"a": [1, 2, 3]}),
        ("a,time\n1,0\n2,0.5\n", "sample_rate_hz"),
        ("time;a\n0;1\n0.5;2\n", {"a": [1, 2]}),
        ("time;a\n0,0;1,5\n0,5;2,5\n", {"a": [1.5, 2.5]}),
        ("time a\n0 1\n0.5   2\n", {"a": [1, 2]}),
        ("\ufefftime,a\n0,1\n0.5,2\n", {"a": [1, 2]}),
        ("time,a\r\n0,1\r\n0.5,2\r\n", {"a": [1, 2]}),
        ("time,a\r0,1\r0.5,2\r", {"a": [1, 2]}),
        ('time,"a, b"\n0,1\n0.5,2\n', {"a, b": [1, 2]}),
        ("# made by hand\ntime,a\n\n0,1\n# halt\n0.5,2\n", {"a": [1, 2]}),
        ("time,a\ns,m\n0,1\n0.5,2\n", {"a": [1, 2]}),
        ("time,a\ns,x\n0,1\n0.5,2\n", {"a [x]": [1, 2]}),
        ("time,a\nTicks,x\n0,1\n0.5,2\n", "row 2: 'Ticks' below 'time'"),
        ("time,a,b,c\n-,g,left,up\n0,1,1,1\n0.5,2,2,2\n", "row 2: 'g' below 'a'"),
        ("time,a\ns,m\n0,1\n0.5,x\n1,2\n", "channel 'a', row 4: 'x'"),
        ("time,a\ns,m\n0,x\n0.5,1\n1,2\n", "channel 'a', row 3: 'x'"),
        ('time,a\n0.5,999\n1.0,"1,500"\n', "'1,500' is not a number with the decimal mark"),
        ('time,a\n0.5,"1,500"\n1.0,999\n', "row 2 has points and commas"),
        ('time,a\n0,"1,500"\n1,999\n', "'1,500' stands beside numbers without ','"),
        ("time\ta\n0.5\t1,500.25\n1.0\t999\n", "row 2 has points and commas"),
        ("time;a\n0,5;999\n1,0;1.500\n", "'1.500' is not a number with the decimal mark"),
        ("time;a\n0,5;1.500\n1,0;999\n", "row 2 has points and commas"),
        ("time;a\n0;1.500\n1;999\n", "'1.500' stands beside numbers without '.'"),
        ("time;a;time;b\n0;1;0,1;1\n1;2;1,1;2\n", "different sample instants, 'time' and 'time 2'"),
        ("time,a\n0.5,2\n0,1\n1,3\n", "not uniformly sampled"),
        ("time,a\n0,1\n0,1\n0,1\n", "not uniformly sampled"),
        ("time,a\n1,1\n0.5,2\n0,3\n", "not uniformly sampled"),
        ("time,a\n0,1\n1e308,2\n-1e308,3\n", "not uniformly sampled"),
        ("time,1\n0,1\n0.5,2\n", {"1": [1, 2]}),
        ("time,a\n0,1\nnan,2\n1,3\n", "time, row 3"),
        ("time,a\n0,1_5\n1,2\n", "'1_5' is not a number"),
        ("time,a\n0,inf\n1,2\n", "channel 'a', row 2: inf"),
        ("time,a\n0,1e999\n1,2\n", "channel 'a', row 2: inf"),
        ("time,a\n0,\n1,2\n", "'' is not a number"),
        ("time,a\n0,0x10\n1,2\n", "'0x10' is not a number"),
        ("time,a\n0,__import__('os').system('true')\n1,2\n", "not a number"),
        ("time,a\x1b]0;owned\x07\n0,1\n1,2\n", "control characters"),
        ("time,\n0,1\n1,2\n", "not be empty"),
        ("time,a\n", "two"),
        ("time\n0\n1\n", "no signals"),
        ('time,a\n0,"1\n1,2\n', "cannot be read as CSV"),
        ("time,a\n0," + "9" * 500 + "\n1,2\n", "inf"),
        ("time,a\n0," + "x" * 100_000 + "\n1,2\n", r"x{40}\.\.\."),
        ("time," + "a" * 2_000_000 + "\n0,1\n", "more than 1000000 characters"),
        ("time,a\n0,1\n1,2\x00\n", "not a number"),
        ('# record {"channels": ' + "[" * 100_000 + "\ntime,a\n0,1\n1,2\n", "damaged"),
        ("# record {}\ntime,a\n0,1\n1,2\n", "damaged"),
        ('# record {"channels": [], "name": "x"}\ntime,a\n0,1\n1,2\n', {"a": [1, 2]}),
    ],
)
def test_a_table_of_another_program(tmp_path, text, found):
    path = tmp_path / "x.csv"
    path.write_bytes(text.encode())
    if isinstance(found, str):
        with pytest.raises(RecordFileError, match=found) as refused:
            read_record(path)
        assert len(str(refused.value)) < 1000
    else:
        read = read_record(path)
        np.testing.assert_array_equal(read.outputs, list(found.values()))
        assert read.output_names == tuple(found)


def save_hdf5(path, **arrays):
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values


SAVE = {
    ".npz": lambda path, **arrays: np.savez(path, **arrays),
    ".mat": lambda path, **arrays: savemat(path, arrays),
    ".h5": save_hdf5,
}


ARRAYS = [
    ({"t": TIME, "a": WAVE.astype("f4")}, WAVE),
    ({"t": TIME, "a": WAVE.astype("i1")}, WAVE),
    ({"t": TIME[:, None], "a": WAVE[None, :]}, WAVE),
    ({"t": TIME, "a": WAVE, "rate": 2.0, "note": "a text"}, WAVE),
    ({"t": TIME, "a": WAVE.astype(complex)}, "complex"),
    ({"t": TIME, "a": np.ones((3, 2))}, r"shape \(3, 2\)"),
    ({"t": TIME, "a": WAVE[:-1]}, "5 samples"),
    ({"t": TIME, "time": TIME, "a": WAVE}, "two arrays of times"),
    ({"t": TIME, "a": np.where(WAVE == 3, np.nan, WAVE)}, "row 3: nan"),
    ({"t": TIME[::-1], "a": WAVE}, "not uniformly"),
    ({"a": WAVE}, "no sample instants"),
    ({"t": TIME, "record_channel_0": WAVE}, "do not belong together"),
    ({"t": TIME, "record_channel_0": WAVE, "record_header": "{}"}, "damaged"),
    ({"t": np.zeros(0), "a": np.zeros(0)}, "0 samples|no signals|0\\)"),
    ({"t": TIME}, "no signals"),
]
RETYPED = 5  # of them; the rest go through the same lines in every format


@pytest.mark.parametrize(
    ("ending", "arrays", "found"),
    [(".npz", *case) for case in ARRAYS] + [(e, *case) for e in (".mat", ".h5") for case in ARRAYS[1:RETYPED]],
)
def test_arrays_of_another_program(tmp_path, ending, arrays, found):
    path = tmp_path / f"x{ending}"
    SAVE[ending](path, **arrays)
    if isinstance(found, str):
        with pytest.raises(RecordFileError, match=found):
            read_record(path)
    else:
        read = read_record(path)
        np.testing.assert_array_equal(read.outputs, [found])
        assert (read.sample_time, read.output_names) == (0.5, ("a",))


def huge_npz(path):
    np.savez_compressed(path, t=np.zeros(2**25, "i1"), a=np.zeros(2**28, "i1"))


def huge_mat(path):
    savemat(path, {f"a{i}": np.zeros(2**25, "i1") for i in range(2)}, do_compression=True)


def huge_hdf5(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("a", shape=(2**40,), chunks=(2**16,), dtype="f8")


def huge_chunk(path):
    """A hundred numbers, of which one compressed chunk would unpack to 4 GB."""
    with h5py.File(path, "w") as file:
        file.create_dataset("a", shape=(100,), maxshape=(None,), chunks=(500_000_000,), compression="gzip", dtype="f8")


def huge_mat_part(path):
    """A small record beside a compressed cell of 40 million numbers."""
    savemat(path, {"t": TIME, "a": WAVE, "c": np.array([np.zeros(40_000_000, "i1"), 0], object)}, do_compression=True)


def huge_csv(path):
    path.write_bytes(b"time,a\n" + b" " * 40_000_000 + b"\n")


def elsewhere(path):
    (path.parent / "secret.bin").write_bytes(np.arange(8.0).tobytes())
    with h5py.File(path, "w") as file:
        file["t"] = TIME
        file.create_dataset("a", shape=(6,), dtype="f8", external=[(str(path.parent / "secret.bin"), 0, 48)])


def linked(path):
    save_hdf5(path.with_name("other.h5"), a=WAVE)
    with h5py.File(path, "w") as file:
        file["t"] = TIME
        file["a"] = h5py.ExternalLink("other.h5", "a")


@pytest.mark.parametrize(
    ("ending", "make", "words"),
    [
        (".npz", huge_npz, "at most 33554432"),
        (".mat", huge_mat, "at most 33554432|GiB"),
        (".mat", huge_mat_part, None),
        (".h5", huge_hdf5, "at most 33554432"),
        (".h5", huge_chunk, "at most 33554432"),
        (".csv", huge_csv, "1000000 characters"),
        (".h5", elsewhere, "in another file"),
        (".h5", linked, "no signals"),
    ],
)
def test_what_is_huge_or_lies_elsewhere_is_not_read(tmp_path, ending, make, words):
    path = tmp_path / f"x{ending}"
    make(path)
    start = spent()
    if words is None:
        assert read_record(path).n_samples == WAVE.size
    else:
        with pytest.raises(RecordFileError, match=words):
            read_record(path)
    assert spent() - start < LONGEST and peak_kib() < MOST


FILLERS = {"blank": "\n", "spaces": " " * 99 + "\n", "comments": "# " + "x" * 97 + "\n", "short comments": "#\n"}


@pytest.mark.parametrize("filler", FILLERS.values(), ids=FILLERS)
def test_lines_that_hold_nothing_take_no_time(tmp_path, filler):
    """300 MB of them within the limit of 10 s; here a tenth within a tenth."""
    path = tmp_path / "x.csv"
    path.write_text("time,a\n0,1\n" + filler * (30_000_000 // len(filler)) + "0.5,2\n")
    np.testing.assert_array_equal(read_record(path, limits=ReadLimits(seconds=1.0)).outputs, [[1.0, 2.0]])


def test_a_table_of_too_many_rows_is_refused_where_they_are_counted(tmp_path):
    path, limits = tmp_path / "x.csv", ReadLimits(memory=2**22)
    path.write_text("time,a\n" + "0.5,1\n" * 300_000)
    with pytest.raises(RecordFileError, match=f"at most {limits.most_numbers} are read"):
        read_record(path, limits=limits)


@pytest.mark.parametrize("ending", [*(pytest.param(e, marks=pytest.mark.slow) for e in (".npz", ".h5")), ".csv"])
def test_thousands_of_channels_are_seen_in_seconds(tmp_path, ending):
    """Time linear in channels: 9,998 of them, by name, in a few seconds of processor time."""
    rng, path = np.random.default_rng(0), tmp_path / f"x{ending}"
    signals = {f"a{i}": row for i, row in enumerate(rng.standard_normal((9_998 if ending == ".npz" else 2_000, 10)))}
    if ending == ".csv":
        table = np.column_stack([0.1 * np.arange(10), *signals.values()])
        np.savetxt(path, table, delimiter=",", header=",".join(["time", *signals]), comments="", fmt="%.4g")
    else:
        SAVE[ending](path, t=0.1 * np.arange(10), **signals)
    start = spent()
    seen = file_report(read_record(path), path)
    assert spent() - start < LONGEST and peak_kib() < MOST
    assert f"{len(signals)} outputs" in seen.heading and len(seen.rows) == 100


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("import os, signal\ndef load(*_): os.kill(os.getpid(), signal.SIGSEGV)\n", r"crashed on it \(SIGSEGV\)"),
        ("def load(path, limits):\n    while True: pass\n", "did not end within [15] s"),
        ("import numpy\ndef load(path, limits): return {'a': numpy.ones(2**33)}\n", "more than 1 GiB"),
        ("import os\ndef load(path, limits): os._exit(9)\n", "process that reads it failed"),
        ("def load(path, limits): print('noise'); raise KeyError\n", "cannot be read as MAT: KeyError"),
        ("import numpy\ndef load(path, limits): return {'a': numpy.array([{}, 0])}\n", None),
    ],
    ids=["crash", "hang", "memory", "exit", "error", "objects"],
)
def test_a_reader_that_crashes_hangs_or_devours_is_survived(tmp_path, monkeypatch, body, words):
    from workbench.records import confined

    (tmp_path / "hostile_reader.py").write_text(body)
    monkeypatch.setattr(confined, "ROOT", str(tmp_path))
    path, limits = tmp_path / "x.mat", ReadLimits(seconds=1.0)
    path.write_bytes(b"x")
    if words is None:
        assert confined.load_confined("hostile_reader", path, limits) == {}  # no pickles
    else:
        with pytest.raises(RecordFileError, match=words):
            confined.load_confined("hostile_reader", path, limits)


def test_no_file_beside_the_record_runs(tmp_path, monkeypatch):
    """The reader is another Python; one that looked into the working folder first would run what lies there."""
    path = write_record(sample(), tmp_path / "x.mat")
    for name in ("numpy", "json", "scipy", "workbench"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('taken over')")
    monkeypatch.chdir(tmp_path)
    assert same(read_record("x.mat"), sample(), 0.0) and path.exists()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", ENDINGS)
def test_the_command_ends_in_one_line_and_writes_nothing(tmp_path, ending):
    data = write_record(sample(), tmp_path / f"whole{ending}").read_bytes()
    path, found = tmp_path / f"x{ending}", tmp_path / "found.json"
    path.write_bytes(data[: len(data) // 2])
    result = CliRunner().invoke(app, ["identify", str(path), "--json", str(found)])
    assert result.exit_code == 2 and "Traceback" not in result.output, result.output
    assert path.name in result.output and len(result.output.strip().splitlines()) == 1
    assert not found.exists()


def save_58(path, time, values):
    pyuff.UFF(str(path)).write_sets(
        pyuff.prepare_58(binary=1, func_type=1, rsp_node=1, rsp_dir=3, ref_node=1, ref_dir=3, ver_num=0,
                         ord_data_type=4, abscissa_spacing=1, num_pts=values.size, abscissa_min=time[0],
                         abscissa_inc=time[1] - time[0], abscissa_spec_data_type=17, orddenom_spec_data_type=0,
                         z_axis_spec_data_type=0, ordinate_spec_data_type=12, x=time, data=values,
                         return_full_dict=False), mode="add")  # fmt: skip


def test_a_binary_universal_file_is_read_whole_or_not_at_all(tmp_path):
    """Its end stands right behind the last number, or, as some programs write it, on the next line."""
    path = tmp_path / "x.uff"
    save_58(path, TIME, WAVE)
    data = path.read_bytes()
    for written in (data, data.replace(b"    -1\n", b"\n    -1\n").removeprefix(b"\n")):
        path.write_bytes(written)
        np.testing.assert_array_equal(read_record(path).outputs, [WAVE])
    path.write_bytes(data[:-12])
    with pytest.raises(RecordFileError, match="has no end"):
        read_record(path)


@pytest.mark.parametrize("ending", [".csv", ".npz", ".mat", ".h5", ".uff"])
@pytest.mark.parametrize("samples", [2, 3])
def test_a_record_too_short_for_a_mode_is_refused_in_one_line(tmp_path, samples, ending):
    time, values = 0.1 * np.arange(samples), (-1.0) ** np.arange(samples)
    path = tmp_path / f"x{ending}"
    if ending == ".csv":
        np.savetxt(path, np.column_stack([time, values]), delimiter=",", header="time,a", comments="")
    elif ending == ".uff":
        save_58(path, time, values)
    else:
        SAVE[ending](path, t=time, a=values)
    result = CliRunner().invoke(app, ["identify", str(path)])
    assert result.exit_code == 2 and f"has {samples} samples" in result.output, result.output


def test_a_file_cut_short_is_no_shorter_record(tmp_path):
    from nptdms import ChannelObject, TdmsWriter
    from scipy.io import wavfile

    values = np.sin(np.arange(2000) / 7.0)
    wavfile.write(tmp_path / "whole.wav", 1000, values.astype(np.float32))
    with TdmsWriter(tmp_path / "whole.tdms") as file:
        file.write_segment([ChannelObject("group", "a", values, properties={"wf_increment": 1e-3})])
    for whole, share in ((tmp_path / "whole.wav", 0.1), (tmp_path / "whole.tdms", 0.5)):
        assert read_record(whole).n_samples == 2000
        content, cut = whole.read_bytes(), whole.with_stem("cut")
        cut.write_bytes(content[: int(share * len(content))])
        with pytest.raises(RecordFileError, match=r"Reached EOF prematurely|cut short"):
            read_record(cut)


@pytest.mark.parametrize("ending", [".asc", ".dat", ".tsv"])
def test_text_of_instruments_has_many_endings(tmp_path, ending):
    path = tmp_path / f"vibrometer{ending}"
    path.write_text("Time (s)\tVelocity (mm/s)\n" + "\n".join(f"{k / 100:.2f}\t{k % 7}" for k in range(40)))
    record = read_record(path)
    assert record.outputs[0, 6] == pytest.approx(6e-3) and record.output_channels[0].quantity == "velocity"
