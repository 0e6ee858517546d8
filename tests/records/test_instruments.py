"""Files as instruments write them: any layout of text, units, time stamps and uneven times, TDMS and WAV."""

import itertools

import h5py
import numpy as np
import pytest
import pyuff
from nptdms import ChannelObject, TdmsWriter
from scipy.io import wavfile

from workbench.records import csv_file, limits
from workbench.records.files import read_measured, read_record
from workbench.records.limits import ReadLimits, RecordFileError
from workbench.records.units import LIKELY, split_unit, unit_named

G = 9.80665  # m/s^2, by definition


def read(tmp_path, text, encoding="utf-8", ending=".csv", **options):
    path = tmp_path / f"x{ending}"
    path.write_bytes(text.encode(encoding))
    return read_record(path, **options)


@pytest.mark.parametrize(
    ("text", "encoding", "step", "channels", "values"),
    [
        pytest.param(
            "LabVIEW Measurement\t\nWriter_Version\t2\n***End_of_Header***\t\nChannels\t2\n\n"
            "X_Value\tAcc (g)\tHammer (kN)\n0,000\t1,5\t2\n0,001\t2,5\t3\n0,002\t1\t1\n",
            "utf-8", 0.001, {"Acc": ("acceleration", "m/s^2"), "Hammer": ("force", "N")},
            [[1.5 * G, 2.5 * G, G], [2e3, 3e3, 1e3]], id="header of several lines, tabs, decimal commas",
        ),
        pytest.param(
            "Time (ms);Acc;Weg\nms;mm/s²;µm\n0;1000;1\n1;2000;2\n2;3;3\n", "utf-8", 0.001,
            {"Acc": ("acceleration", "m/s^2"), "Weg": ("displacement", "m")}, [[1, 2, 0.003], [1e-6, 2e-6, 3e-6]],
            id="a line of units",
        ),
        pytest.param(
            "Zeit;Weg [µm]\n0,0;1,0\n0,5;2,0\n1,0;3,5\n", "latin-1", 0.5, {"Weg": ("displacement", "m")},
            [[1e-6, 2e-6, 3.5e-6]], id="latin-1",
        ),
        pytest.param("time\ta [g]\n0\t1\n1\t2\n", "utf-16", 1.0, {"a": ("acceleration", "m/s^2")}, [[G, 2 * G]],
                     id="utf-16"),
        pytest.param("% by a program\n time   a  b\n  0.0  1 2\n  0.1  3 4\n", "utf-8", 0.1,
                     {"a": ("", ""), "b": ("", "")}, [[1, 3], [2, 4]], id="spaces"),
        pytest.param('"Time (s)","Acc, z (g)"\n"0","1"\n"1","2"\n', "utf-8", 1.0,
                     {"Acc, z": ("acceleration", "m/s^2")}, [[G, 2 * G]], id="quotes"),
        pytest.param("t;a;\n0;1;\n1;2;\n", "utf-8", 1.0, {"a": ("", "")}, [[1, 2]], id="a delimiter behind each row"),
        pytest.param("Date;Time;a [mV]\n01.05.2024;23:59:59,5;1\n02.05.2024;00:00:00,0;2\n02.05.2024;00:00:00,5;4\n",
                     "utf-8", 0.5, {"a": ("voltage", "V")}, [[0.001, 0.002, 0.004]], id="dates and times of day"),
        pytest.param("timestamp,a\n2024-05-01T12:00:00.00,1\n2024-05-01T12:00:00.01,2\n", "utf-8", 0.01,
                     {"a": ("", "")}, [[1, 2]], id="ISO 8601"),
        pytest.param("time a\n23:59:59.50 1\n0:00:00.00 2\n00:00:00.50 3\n", "utf-8", 0.5, {"a": ("", "")},
                     [[1, 2, 3]], id="past midnight"),
        pytest.param("X_Dimension\tTime\t\n***End_of_Header***\t\t\nX_Value\tAcc\tComment\n0.0\t1\n0.5\t2\n", "utf-8",
                     0.5, {"Acc": ("", "")}, [[1, 2]], id="LabVIEW's column of comments, of which there are none"),
        pytest.param("Sensor,S 1,S 2\nPlace,tip,tip\nTime [s],Acc [g],Acc [g]\n0,1,2\n1,3,4\n", "utf-8", 1.0,
                     {"S 1 tip Acc": ("acceleration", "m/s^2"), "S 2 tip Acc": ("acceleration", "m/s^2")},
                     [[G, 3 * G], [2 * G, 4 * G]], id="names that differ in the lines above"),
        pytest.param('"Time","Acc"\n"0,0","1,5"\n"0,5","2,5"\n', "utf-8", 0.5, {"Acc": ("", "")}, [[1.5, 2.5]],
                     id="decimal commas in quotes between commas"),
        pytest.param("Zeit [s];a\n0;0\n0,5;1,5\n1;2,5\n", "utf-8", 0.5, {"a": ("", "")}, [[0, 1.5, 2.5]],
                     id="decimal commas that begin below whole numbers"),
        pytest.param('t,a\n0,5\n"0,5","1,5"\n', "utf-8", 0.5, {"a": ("", "")}, [[5, 1.5]],
                     id="decimal commas in quotes that begin below whole numbers"),
        pytest.param("t\ta\n0\t0\n1,953\t1\n3,906\t2\n", "utf-8", 1.953, {"a": ("", "")}, [[0, 1, 2]],
                     id="three decimals that separate no thousands"),
        pytest.param("ms;m/s²;mm/s²\nTime;A1;A2\n0;1;1000\n1;2;2000\n", "utf-8", 1e-3,
                     {"A1": ("acceleration", "m/s^2"), "A2": ("acceleration", "m/s^2")}, [[1, 2], [1, 2]],
                     id="a line of units above the names"),
        pytest.param("Time;A1;A2\nms;m/s²;mm/s²\n-;left;right\n0;1;1000\n1;2;2000\n", "utf-8", 1e-3,
                     {"A1": ("acceleration", "m/s^2"), "A2": ("acceleration", "m/s^2")}, [[1, 2], [1, 2]],
                     id="a line of units between the names and a text"),
        pytest.param("Time;Acc;Speed\ns;m/s²;rpm\n0;1;3\n1;2;4\n", "utf-8", 1.0,
                     {"Acc": ("acceleration", "m/s^2"), "Speed [rpm]": ("", "")}, [[1, 2], [3, 4]],
                     id="a unit that is not known among the others"),
        pytest.param("Time;A1\n-;left\n0;1\n1;2\n", "utf-8", 1.0, {"A1": ("", "")}, [[1, 2]],
                     id="a line of text below the names"),
        pytest.param("Date\t2024-03-04\nTime\t12:03:04\nPoint\tA\nt [s]\tB\n0\t1\n1\t2\n", "utf-8", 1.0,
                     {"B": ("", "")}, [[1, 2]], id="a time of day above the names"),
        pytest.param("Zeit  1 - Standardmessrate\tCH 1\nms\tmm\n0\t1\n1\t2\n", "latin-1", 1e-3,
                     {"CH 1": ("displacement", "m")}, [[1e-3, 2e-3]], id="catman's time"),
        pytest.param("Time [s];a [g];Time [s];b [g]\n0;1;0;2\n1;3;1;4\n", "utf-8", 1.0,
                     {"a": ("acceleration", "m/s^2"), "b": ("acceleration", "m/s^2")}, [[G, 3 * G], [2 * G, 4 * G]],
                     id="the same time beside each channel"),
        pytest.param("Sample,Time (us),V (mm/s)\n1,0,1\n2,500,3\n3,1000,2\n", "utf-8", 5e-4,
                     {"Sample": ("", ""), "V": ("velocity", "m/s")}, [[1, 2, 3], [1e-3, 3e-3, 2e-3]],
                     id="time behind the numbers of the samples"),
        pytest.param("Time,1,2\n0,1,2\n0.5,3,4\n", "utf-8", 0.5, {"1": ("", ""), "2": ("", "")}, [[1, 3], [2, 4]],
                     id="channels by their numbers"),
        pytest.param("x-axis,1,2\nsecond,Volt,Volt\n-1E+0,1,2\n0,3,4\n", "utf-8", 1.0,
                     {"1": ("voltage", "V"), "2": ("voltage", "V")}, [[1, 3], [2, 4]],
                     id="channels by their numbers above their units"),
        pytest.param(",t,a\n0,1,1\n1,2,2\n2,3,5\n", "utf-8", 1.0, {"a": ("", "")}, [[1, 2, 5]],
                     id="an index without a name"),
        pytest.param(" t a\n 0.0D+00 1.5D+00\n 1.0D-01 -2.5D-1\n", "utf-8", 0.1, {"a": ("", "")}, [[1.5, -0.25]],
                     id="exponents of Fortran"),
        pytest.param("t,a\n05/03/2024 11:59:59.50 PM,1\n05/04/2024 12:00:00.00 AM,2\n05/04/2024 12:00:00.5 AM,3\n",
                     "utf-8", 0.5, {"a": ("", "")}, [[1, 2, 3]], id="twelve hours"),
        pytest.param("t;a\n03/05/2024 23:59:59,5;1\n04/05/2024 00:00:00,0;2\n", "utf-8", 0.5, {"a": ("", "")},
                     [[1, 2]], id="days before months"),
        pytest.param("t,a\n2024-10-27T02:59:59.5+02:00,1\n2024-10-27T02:00:00.0+01:00,2\n", "utf-8", 0.5,
                     {"a": ("", "")}, [[1, 2]], id="the end of summer time"),
        pytest.param("time [s]\ta [g]\n0\t1\n1\t2\n", "utf-16-le", 1.0, {"a": ("acceleration", "m/s^2")},
                     [[G, 2 * G]], id="utf-16 without a mark"),
        pytest.param("Zeit;a\nSekunden;g\n0;1\n1;2\n", "utf-8", 1.0, {"a": ("acceleration", "m/s^2")}, [[G, 2 * G]],
                     id="seconds in German"),
    ],
)  # fmt: skip
def test_a_table_in_any_layout(tmp_path, text, encoding, step, channels, values):
    record = read(tmp_path, text, encoding)
    assert record.sample_time == pytest.approx(step, rel=1e-9)
    assert {c.name: (c.quantity, c.unit) for c in record.output_channels} == channels
    np.testing.assert_allclose(record.outputs, values, rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,marker,a\n" + "".join(f"{k},,1\n" for k in range(1200)), "in row 2 a field is empty; leave that column"),
        ("t,a\n" + "".join(f"{k},x{k}\n" for k in range(1200)), "in row 2 'x0' is no number"),
        (",t,a\n0,1,1\n5,2,2\n", "its first column has no name"),
        ("t,a\n03/05/2024 11:00:00,1\n04/05/2024 11:00:01,2\n", "do not say which number is the month"),
        ("t;a\n0,5;1,5\n1,5;-24\u202f603,5\n", "'-24.u202f603,5' is not a number .* without thousands separators"),
    ],
)
def test_the_cause_is_said_where_a_table_cannot_be_read(tmp_path, text, words):
    with pytest.raises(RecordFileError, match=words):
        read(tmp_path, text)


@pytest.mark.parametrize("dated", [False, True])
def test_times_of_day_pass_many_midnights_in_many_blocks(tmp_path, monkeypatch, dated):
    monkeypatch.setattr(csv_file, "BLOCK", 100)
    hours = range(0, 24 * 5, 3)
    stamps = [f"{f'0{h // 24 + 1}/05/2024 ' if dated else ''}{h % 24:02d}:00:00" for h in hours]
    record = read(tmp_path, "time,a\n" + "".join(f"{stamp},1\n" for stamp in stamps))
    assert record.sample_time == pytest.approx(3 * 3600.0) and record.n_samples == len(hours)


LABVIEW = (
    "LabVIEW Measurement\t\nSeparator\tTab\nX_Columns\t{}\n***End_of_Header***\t\n\t\nChannels\t2\t\t\n"
    "Date\t2024/03/04\t2024/03/04\t\nY_Unit_Label\tg\tmm\t\nX_Dimension\t{}\t{}\t\nX0\t0.5E+0\t{}\t\n"
    "Delta_X\t0.250\t0.250\t\n***End_of_Header***\t\t\t\n"
)


@pytest.mark.parametrize(
    ("columns", "table"),
    [
        ("One", "X_Value\tA\tB\tComment\n0.50\t1\t3\n0.75\t2\t4\n"),
        ("One", "X_Value\tA\tB\tComment\n0.50\t1\t3\tsegment 1\n0.75\t2\t4\n"),
        ("One", "X_Value\tA\tB\tComment\n0.50\t1\t3\n0.75\t2\t4\t2.5\n"),
        ("No", "X_Value\tA\tB\tComment\n\t1\t3\tsegment 1\n\t2\t4\n"),
        ("No, without tabs behind the lines", "X_Value\tA\tB\n\t1\t3\n\t2\t4\n"),
        ("Multi", "X_Value\tA\tX_Value\tB\tComment\n0.50\t1\t0.50\t3\n0.75\t2\t0.75\t4\n"),
    ],
)
def test_labview_text(tmp_path, columns, table):
    """As its format is specified: the unit of each channel in the header, texts in a column of their own, and
    instants beside the first channel, beside each, or as a start and a step in the header alone."""
    columns, bare, _ = columns.partition(", without")
    header = LABVIEW.format(columns, "Time", "Time", 0.5)
    record = read(tmp_path, (header.replace("\t\n", "\n") if bare else header) + table, ending=".lvm")
    assert (record.sample_time, record.start_time) == (0.25, 0.5)
    assert [(c.name, c.unit) for c in record.output_channels] == [("A", "m/s^2"), ("B", "m")]
    np.testing.assert_allclose(record.outputs, [[G, 2 * G], [3e-3, 4e-3]], rtol=1e-12)


@pytest.mark.parametrize(
    ("over", "start", "words"), [("Frequency", 0.5, "X_Dimension is Frequency"), ("Time", 0.6, "differ in X0")]
)
def test_labview_text_that_is_no_record(tmp_path, over, start, words):
    with pytest.raises(RecordFileError, match=words):
        text = LABVIEW.format("No", over, over, start) + "X_Value\tA\tB\tComment\n\t1\t3\n\t2\t4\n"
        read(tmp_path, text, ending=".lvm")


def test_labview_text_of_several_segments(tmp_path):
    """One record is read, not several with a pause between them: the message says how LabVIEW writes one."""
    segment = LABVIEW.partition("***End_of_Header***\t\n\t\n")[2]
    table = "X_Value\tA\tB\tComment\n0.50\t1\t3\n0.75\t2\t4\n\n"
    text = LABVIEW.format("One", "Time", "Time", 0.5) + table + segment.format("Time", "Time", 1.0) + table
    with pytest.raises(RecordFileError, match=r"row 17: the header of a further segment; .*'One header only'"):
        read(tmp_path, text, ending=".lvm")


def test_what_was_changed_is_remarked(tmp_path):
    record = read(tmp_path, "t [s],a [g],b [m],c [counts],d (left)\n0,1,1,1,1\n1,2,2,2,2\n")
    assert record.remarks[0] == "a: g taken as 9.80665 m/s^2"
    assert record.remarks[1].startswith("c: in counts") and len(record.remarks) == 2
    assert record.output_names == ("a", "b", "c", "d (left)")
    assert record.select_outputs(["a"]).remarks == record.remarks


def test_an_input_is_named_with_its_unit_or_without(tmp_path):
    text = "t,F [kN],a\n0,1,1\n1,2,2\n"
    for name in ("F", "F [kN]"):
        record = read(tmp_path, text, inputs=(name,))
        assert record.input_names == ("F",) and record.inputs.tolist() == [[1e3, 2e3]]


def test_uneven_steps_are_resampled(tmp_path):
    """Against the function itself at the new instants."""
    steps = 0.01 * (1.0 + 0.2 * np.random.default_rng(0).uniform(-1.0, 1.0, 400))
    times = np.cumsum(steps)
    record = read(tmp_path, "t [s],a\n" + "".join(f"{t!r},{float(np.sin(3 * t))!r}\n" for t in map(float, times)))
    np.testing.assert_allclose(record.outputs[0], np.sin(3 * record.time), atol=1e-7)
    assert record.time[[0, -1]] == pytest.approx(times[[0, -1]]) and "resampled" in record.remarks[0]


def test_rounded_times_are_no_uneven_ones(tmp_path):
    """1,024 Hz, written in milliseconds: the signal stays as it is."""
    record = read(tmp_path, "t [s],a\n" + "".join(f"{k / 1024:.3f},{k % 7}\n" for k in range(2000)))
    assert record.sample_rate_hz == pytest.approx(1024.0, rel=1e-4)
    np.testing.assert_array_equal(record.outputs[0], np.arange(2000) % 7)
    assert "rounded" in record.remarks[0]


@pytest.mark.parametrize("times", [[0, 1, 2, 4, 5, 6], [0, 1, 2, 3, 9, 10], [0, 1, 2, 2, 3, 4]])
def test_a_missing_or_doubled_sample_is_not_filled(tmp_path, times):
    with pytest.raises(RecordFileError, match="not uniformly sampled"):
        read(tmp_path, "t,a\n" + "".join(f"{t},1\n" for t in [*times, *range(11, 40)]))


@pytest.mark.parametrize(
    ("written", "si"),
    [("g", G), ("m/s²", 1), ("mm/s**2", 1e-3), ("µm", 1e-6), ("lbf", 4.4482216152605), ("in/s", 0.0254),
     ("deg", np.pi / 180), ("N·m", 1), ("m s^-2", 1), ("kHz", 1e3), ("ft/s", 0.3048), ("ft/s²", 0.3048),
     ("mil/s", 2.54e-5), ("km/h", 1 / 3.6)],
)  # fmt: skip
def test_units_by_their_definitions(written, si):
    assert unit_named(written).factor == pytest.approx(si, rel=1e-15)


def test_brackets_without_a_unit_belong_to_the_name():
    assert split_unit("x (left)") == ("x (left)", "")
    assert split_unit("Acc / g") == ("Acc", "g")


def test_a_unit_that_is_not_known_is_said_by_name(tmp_path):
    record = read(tmp_path, "t [s],a [m/s^2],b [furlong/s^2],c (left),d [1]\n0,1,1,1,1\n1,2,2,2,2\n")
    [remark] = record.remarks
    assert remark == "b [furlong/s^2]: as recorded, as furlong/s^2 is no known unit"
    assert all(unit_named(name) for name in LIKELY.split(", "))
    known = read(tmp_path, "t [s],b [ft/s^2]\n0,1\n1,2\n")
    assert known.remarks == ("b: ft/s^2 taken as 0.3048 m/s^2",) and known.outputs[0, 0] == pytest.approx(0.3048)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "b [furlong/s^2] [m/s^2]",
            r"states two units, furlong/s\^2 and m/s\^2: leave the one that its numbers are in",
        ),
        ("b [ft/s^2] [m/s^2]", r"states two units, ft/s\^2 and m/s\^2"),
        ("b (ft/min) [mm/s]", "states two units, ft/min and mm/s"),
        ("b (mm) [m]", "states two units, mm and m"),
        ("b (left) [g]", ""),
        ("b [0] [g]", ""),
        ("b (N) [g]", ""),
        ("b (A/D) [g]", ""),
        ("b (m/s²) [m/s^2]", ""),
    ],
)
def test_a_column_with_two_units_is_refused(tmp_path, name, words):
    text = f"t [s],a,{name}\n0,1,1\n1,2,2\n"
    if not words:
        assert read(tmp_path, text).output_channels[1].quantity == "acceleration"
        return
    with pytest.raises(RecordFileError, match=words):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("t,m1,m2,m1", "columns 2 and 4 are both called 'm1'; give them names that differ"),
        ("t,m1,m1 ,m3", "columns 2 and 3 are called 'm1' and 'm1 ', alike but for blanks; give them names that differ"),
    ],
)
def test_sensors_of_one_name_are_named_with_their_columns(tmp_path, header, words):
    with pytest.raises(RecordFileError, match=words):
        read(tmp_path, f"{header}\n0,1,1,1\n1,2,2,2\n")


def test_samples_that_are_not_there_matter_where_their_channel_is_asked_for(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("t [s],F,a,b,c\n" + "".join(f"{k},{k % 3},{k % 5},nan,{k % 7}\n" for k in range(20)))
    with pytest.raises(
        RecordFileError, match="'b', row 2: nan is not a number; delete the column, or fill the samples"
    ):
        read_record(path)
    kept = read_measured(path, inputs=("F",), outputs=("c", "a"))
    assert (kept.input_names, kept.output_names) == (("F",), ("c", "a")) and kept.outputs[0].max() == 6.0
    with pytest.raises(RecordFileError, match="'b', row 2: nan"):
        read_measured(path, inputs=("F",), outputs=("a", "b"))
    with pytest.raises(RecordFileError, match="has no output 'd'; it has a, b, c"):
        read_measured(path, inputs=("F",), outputs=("d",))
    path.write_text("t [s],a,b\n0,1,\n1,2,1\n2,3,1\n".replace("0,1,", "0,1,3", 1).replace("1,2,1", "1,2,"))
    with pytest.raises(RecordFileError, match="'b', row 3: '' is not a number; delete the column, or fill the samples"):
        read_record(path)


def test_labview_channels(tmp_path):
    properties = {"wf_increment": 0.01, "wf_start_offset": 0.5, "unit_string": "g"}
    with TdmsWriter(tmp_path / "x.tdms") as file:
        file.write_segment([ChannelObject("run", "acc", np.arange(5.0), properties=properties)])
    record = read_record(tmp_path / "x.tdms")
    assert (record.sample_time, record.start_time) == pytest.approx((0.01, 0.5))
    assert record.output_channels[0].unit == "m/s^2"
    np.testing.assert_allclose(record.outputs[0], G * np.arange(5.0))


def test_labview_channels_that_start_apart_are_no_record(tmp_path):
    def write(*starts):
        with TdmsWriter(tmp_path / "x.tdms") as file:
            properties = ({"wf_increment": 0.01, "wf_start_time": np.datetime64(start, "us")} for start in starts)
            file.write_segment([ChannelObject("run", f"a{i}", np.arange(5.0), p) for i, p in enumerate(properties)])
        return read_record(tmp_path / "x.tdms")

    assert write("2024-03-04T12:00:00", "2024-03-04T12:00:00.00005").n_outputs == 2
    with pytest.raises(RecordFileError, match="channel 'a1' starts 1 s after 'a0'"):
        write("2024-03-04T12:00:00", "2024-03-04T12:00:01")


def test_units_beside_hdf5_data(tmp_path):
    """As attributes: of signals they are remarked, of their instants and of a rate applied."""
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for name, values, unit in (("time", [0, 1, 2], "ms"), ("a", [1, 2, 3], b"g"), ("b", [1, 2, 3], "rpm")):
            file[name] = values
            file[name].attrs["units"] = unit
    record = read_record(tmp_path / "x.h5")
    assert record.sample_rate_hz == pytest.approx(1000.0)
    assert record.remarks == ("a: g taken as 9.80665 m/s^2", "b [rpm]: as recorded, as rpm is no known unit")
    assert [(c.name, c.unit) for c in record.output_channels] == [("a", "m/s^2"), ("b [rpm]", "")]
    np.testing.assert_allclose(record.outputs, [[G, 2 * G, 3 * G], [1, 2, 3]])
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["fs"], file["a"] = 2.0, [1.0, 2.0, 3.0]
        file["fs"].attrs["unit"] = "kHz"
    assert read_record(tmp_path / "x.h5").sample_rate_hz == 2000.0


UNIVERSAL = {"binary": 0, "func_type": 1, "rsp_node": 1, "rsp_dir": 3, "ref_node": 2, "ref_dir": 3, "num_pts": 4,
             "abscissa_spacing": 1, "abscissa_min": 0.0, "abscissa_inc": 0.5, "x": 0.5 * np.arange(4.0),
             "data": np.arange(4.0), "ordinate_spec_data_type": 12, "abscissa_spec_data_type": 17,
             "orddenom_spec_data_type": 13}  # fmt: skip
MILLIMETRES = {"type": 164, "units_code": 5, "units_description": "mm", "temp_mode": 1, "length": 1000.0,
               "force": 1000.0, "temp": 1.0, "temp_offset": 273.15}  # fmt: skip


def universal(path, *sets, system=None):
    file = pyuff.UFF(str(path))
    if system:
        file.write_sets(system, "overwrite")
    for i, changed in enumerate(sets):
        how = "add" if system or i else "overwrite"
        file.write_sets(pyuff.prepare_58(**(UNIVERSAL | changed), return_full_dict=False), how)
    return read_measured(path)


@pytest.mark.parametrize(
    ("axes", "system", "scale", "step", "remark"),
    [
        ({"ordinate_axis_units_lab": "g"}, None, G, 0.5, "g taken as 9.80665 m/s^2"),
        ({"ordinate_axis_units_lab": "mm/s^2"}, None, 1e-3, 0.5, "mm/s^2 taken as 0.001 m/s^2"),
        ({"ordinate_axis_units_lab": "m/s^2", "abscissa_axis_units_lab": "ms"}, None, 1.0, 5e-4, None),
        ({}, None, 1.0, 0.5, None),
        ({}, MILLIMETRES, 1e-3, 0.5, "mm/s^2 taken as 0.001 m/s^2"),
        ({"ordinate_axis_units_lab": "m/s^2"}, MILLIMETRES, 1.0, 0.5, None),
    ],
)
def test_units_of_universal_files(tmp_path, axes, system, scale, step, remark):
    record = universal(tmp_path / "x.uff", axes, system=system)
    np.testing.assert_allclose(record.outputs, [scale * np.arange(4.0)])
    assert record.sample_time == pytest.approx(step)
    assert record.remarks == ((f"node 1 direction 3: {remark}",) if remark else ())
    assert [(c.name, c.quantity, c.unit) for c in record.output_channels] == [
        ("node 1 direction 3", "acceleration", "m/s^2")
    ]


@pytest.mark.parametrize("labels", [("g", "kN"), ("g/kN", "NONE")])
def test_units_of_universal_frfs(tmp_path, labels):
    spectrum = np.arange(4.0) + 1j
    axes = {"func_type": 4, "data": spectrum, "abscissa_spec_data_type": 18, "ordinate_axis_units_lab": labels[0],
            "orddenom_axis_units_lab": labels[1], "abscissa_axis_units_lab": "kHz"}  # fmt: skip
    found = universal(tmp_path / "x.uff", axes)
    np.testing.assert_allclose(found.values[0, 0], G / 1e3 * spectrum)
    np.testing.assert_allclose(found.frequencies_hz, 500.0 * np.arange(4))
    said = "node 1 direction 3: g taken as 9.80665 m/s^2", "node 2 direction 3: kN taken as 1000 N"
    assert found.remarks == found.select_outputs(("node 1 direction 3",)).remarks == said


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ({"func_type": 2, "abscissa_spec_data_type": 18}, "no FRF, but auto spectrum"),
        ({"func_type": 9, "abscissa_spec_data_type": 18}, "no FRF, but power spectral density"),
        ({"func_type": 6, "abscissa_spec_data_type": 18}, "no FRF, but coherence"),
        ({"func_type": 0, "abscissa_spec_data_type": 18}, "no signal over time"),
        ({"ordinate_axis_units_lab": "N"}, "acceleration by its type and force by its unit"),
    ],
)
def test_universal_files_that_are_no_record(tmp_path, axes, words):
    with pytest.raises(RecordFileError, match=words):
        universal(tmp_path / "x.uff", axes)


def test_channels_of_one_node_are_called_by_their_own_text(tmp_path):
    alike = {"rsp_node": 0, "rsp_dir": 0, "ordinate_axis_units_lab": "g"}
    record = universal(tmp_path / "x.uff", alike | {"id1": "tip"}, alike | {"id1": "root"})
    assert record.output_names == ("tip", "root") and record.remarks == ("tip, root: g taken as 9.80665 m/s^2",)
    apart = universal(tmp_path / "y.uff", {"id1": "tip"}, {"id1": "root", "rsp_node": 5})
    assert apart.output_names == ("node 1 direction 3", "node 5 direction 3")
    with pytest.raises(RecordFileError, match="its own node and direction, or its own text in ID line 1"):
        universal(tmp_path / "z.uff", alike | {"id1": "tip"}, alike | {"id1": "tip"})


def test_spectra_beside_signals_are_left_out(tmp_path):
    record = universal(tmp_path / "x.uff", {"func_type": 6, "abscissa_spec_data_type": 18}, {})
    assert record.output_names == ("node 1 direction 3",) and record.sample_time == 0.5


def test_sound_files(tmp_path):
    wavfile.write(tmp_path / "x.wav", 8000, np.array([[0, 16384], [-32768, 8192]], np.int16))
    record = read_record(tmp_path / "x.wav")
    assert record.sample_rate_hz == 8000.0
    np.testing.assert_array_equal(record.outputs, [[0.0, -1.0], [0.5, 0.25]])


def test_limits_are_the_callers(tmp_path):
    text = "t,a\n" + "".join(f"{k},1\n" for k in range(1000))
    assert read(tmp_path, text, limits=ReadLimits(memory=2000 * 32)).n_samples == 1000
    with pytest.raises(RecordFileError, match="holds 2000 numbers; at most 1999"):
        read(tmp_path, text, limits=ReadLimits(memory=1999 * 32))
    with pytest.raises(RecordFileError, match="more than 1e-06 s to read"):
        read(tmp_path, text, limits=ReadLimits(seconds=1e-6))
    with pytest.raises(ValueError, match="memory must be positive"):
        ReadLimits(memory=0.0)


@pytest.mark.parametrize(("each", "blocks"), [(0.05, None), (0.3, 8), (0.11, 80)])
def test_a_file_that_would_take_too_long_is_refused_before_the_time_is_up(tmp_path, monkeypatch, each, blocks):
    """Of a hundred blocks, each of so many seconds, of which ten are allowed."""
    clock = itertools.count(0.0, each)
    monkeypatch.setattr(limits.time, "process_time", lambda: next(clock))
    monkeypatch.setattr(csv_file, "BLOCK", 1000)
    text = "t,a\n" + "".join(f"{k:07d},1\n" for k in range(10_000))
    if blocks is None:
        assert read(tmp_path, text).n_samples == 10_000
        return
    with pytest.raises(RecordFileError, match="more than 10 s to read"):
        read(tmp_path, text)
    assert next(clock) <= (blocks + 2) * each


def test_a_file_that_would_hold_too_many_numbers_is_refused_before_they_are_read(tmp_path, monkeypatch):
    """Of 20,000 numbers 17,000 are allowed: known from half of the file on."""
    monkeypatch.setattr(csv_file, "BLOCK", 1000)
    read_so_far, numbers = [], csv_file._numbers

    def counted(*args):
        read_so_far.append(numbers(*args))
        return read_so_far[-1]

    monkeypatch.setattr(csv_file, "_numbers", counted)
    text = "t,a\n" + "".join(f"{k:07d},1\n" for k in range(10_000))
    with pytest.raises(RecordFileError, match="at most 17000 are read"):
        read(tmp_path, text, limits=ReadLimits(memory=17_000 * 32))
    assert sum(map(np.size, read_so_far)) < 0.8 * 20_000
    assert read(tmp_path, text, limits=ReadLimits(memory=20_000 * 32)).n_samples == 10_000
