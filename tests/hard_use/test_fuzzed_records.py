"""Files made up from the grammar of each format, a record, FRFs, or a refusal in one line.

Case folders have theirs in `test_fuzzed_cases.py`: 300 inputs in all, 10,000 where slow tests are asked for.
"""

import struct
from functools import partial
from importlib import import_module

import h5py
import numpy as np
import pytest
from nptdms import ChannelObject, GroupObject, RootObject, TdmsWriter
from scipy.io import savemat

from workbench.records.files import read_measured, write_record
from workbench.records.frequency_responses import FrequencyResponses
from workbench.records.limits import DEFAULT, RecordFileError, unreadable
from workbench.records.record import Channel, Record

KINDS = (".csv", ".npz", ".mat", ".h5", ".uff", ".tdms", ".wav")
READERS = ("mat_file", "hdf5_file", "uff_file", "tdms_file", "wav_file")  # each in a process of its own
NAMES = ("t", "time", "Time (ms)", "a", "a [g]", "F (kN)", "acc real", "acc imag", "frequency [hz]", "f", "freq", "fs",
         "omega", "positions", "frf_header", "record_header", "record_channel_0", "npts", "b c", "x / mm",
         "µ", "1")  # fmt: skip
CELLS = ("", "nan", "inf", "-", "1,5", "1.5", "1e999", "0x1", "1_0", '"', "abc", "12:00:00", "2024-05-01T12:00:00", "é",
         "[" * 50, "# x", "1 2", "-0", ".", "1e5", "٣")  # fmt: skip
HEADERS = ("{}", "[]", "null", "1", '"x"', '{"channels": null}', '{"channels": [1]}', '{"channels": [{"kind": 1}]}',
           '{"outputs": 1, "references": null}', '{"outputs": [], "references": []}', '{"outputs": [{"name": 3}]}',
           '{"channels": [{"kind": "output", "name": "a", "at": [], "noise_std": "x", "quantity": 1}]}',
           "[" * 20_000)  # fmt: skip


def any_of(rng, choices):
    return choices[int(rng.integers(len(choices)))]


def table(rng: np.random.Generator) -> bytes:
    """Preamble, names, perhaps units, rows; now and then a cell, a row or a line end that does not belong."""
    n_columns, n_rows = (int(n) for n in rng.integers(1, 6, 2) * (1, any_of(rng, (1, 5, 20))))
    between = any_of(rng, (",", ";", "\t", " ", ", "))
    comma = rng.random() < 0.2
    lines = [any_of(rng, ("# made by hand", "Header", "", "Rate;1000", f"# record {any_of(rng, HEADERS)}"))
             for _ in range(int(rng.integers(0, 4)))]  # fmt: skip
    names = [any_of(rng, NAMES) if rng.random() < 0.3 else f"c{i}" for i in range(n_columns)]
    if rng.random() < 0.7:
        names[0] = any_of(rng, NAMES[:3])
    lines.append(between.join(names))
    if rng.random() < 0.3:
        lines.append(between.join(any_of(rng, ("s", "g", "mm/s²", "", "[?]", "counts")) for _ in names))
    uneven = any_of(rng, ((1.0,), (1.0,), (1.0, 1.1), (1.0, 0.0, 5.0)))
    steps = np.cumsum(0.1 * rng.choice(uneven, n_rows))
    for step in steps:
        row = [f"{step:.3f}", *(f"{x:.4g}" for x in rng.standard_normal(n_columns - 1))]
        row = [cell.replace(".", ",") if comma else cell for cell in row]
        if rng.random() < 0.05:
            row[int(rng.integers(n_columns))] = any_of(rng, CELLS)
        if rng.random() < 0.02:
            row = row[1:]
        lines.append(between.join(row))
    text = any_of(rng, ("\n", "\r\n", "\n\n")).join(lines)
    return text.encode(any_of(rng, ("utf-8", "utf-8", "latin-1", "utf-16")), "replace")


def array(rng: np.random.Generator) -> np.ndarray:
    """Of any shape, size and type: numbers, complex ones, truths, texts."""
    shape = any_of(rng, ((), (0,), (1,), (2,), (3,), (7,), (1, 7), (7, 1), (2, 7), (7, 2, 1), (2, 2, 7)))
    kind = any_of(rng, ("f8", "f8", "f8", "f4", "i4", "u1", "c16", "?", "U5"))
    if kind == "U5":
        return np.array(any_of(rng, HEADERS))
    values = rng.standard_normal(shape) * 10.0 ** rng.integers(-3, 4)
    values = np.where(rng.random(shape) < 0.02, any_of(rng, (np.nan, np.inf, 0.0)), values)
    return (values + 1j * values).astype(kind) if kind == "c16" else np.nan_to_num(values).astype(kind)


def arrays(rng: np.random.Generator) -> dict[str, np.ndarray]:
    held = {any_of(rng, NAMES): array(rng) for _ in range(int(rng.integers(0, 5)))}
    if rng.random() < 0.6:
        n = any_of(rng, (1, 2, 7))
        held |= {"t": 0.1 * np.arange(n), "a": rng.standard_normal(n)}
    if rng.random() < 0.3:
        held |= {"f": np.arange(7.0), "h": rng.standard_normal((2, 7)) * 1j}
    return held


def universal(rng: np.random.Generator, whole: bytes) -> bytes:
    """The lines of a universal file with some of their fields exchanged, doubled or left out."""
    lines = whole.decode().splitlines()
    for _ in range(int(rng.integers(1, 4))):
        row = int(rng.integers(len(lines)))
        words = lines[row].split(" ")
        words[int(rng.integers(len(words)))] = any_of(rng, ("", "0", "-1", "58", "4", "99999999", "1e400", "x", "nan"))
        lines[row] = any_of(
            rng, (" ".join(words), lines[row][: len(lines[row]) // 2], lines[int(rng.integers(row + 1))])
        )
    return "\n".join(lines).encode()


def segments(path, rng: np.random.Generator) -> np.ndarray | None:
    """A TDMS file of one to three segments; its signals, or None where its types and properties may be anything."""
    steps = (1, 0.0, -0.1, np.nan, np.inf, 1e-300, "0.1", "x", True, np.float32(0.1), np.datetime64("2024-05-01"))
    starts = (np.datetime64("2024-05-01T12:00:00.25", "us"), np.datetime64("1601-01-01", "us"), "today", 1.0)
    odd = {"wf_increment": steps, "wf_start_offset": (0.0, 1e300, "x", -5), "wf_start_time": starts,
           "unit_string": ("g", "", "\x1b[2J", "?", 3.0), "NI_Number_Of_Scales": (1, 99, "x", -1),
           "NI_Scale[0]_Scale_Type": ("Linear", "Polynomial", "Table", "Strain", "")}  # fmt: skip
    usual, parts = rng.random() < 0.5, []
    names = ("a", "b c", "é") if usual else rng.permutation(NAMES).tolist()
    kinds = ("f8", "f4", "i1", "u2", "i4", "u8", "?") if usual else ("f8", "f4", "i4", "u8", "c16", "M8[us]", "U5")
    groups = ("g",) if usual else ("g", "g/h", "'", "")
    drawn = [(any_of(rng, groups), name, any_of(rng, kinds)) for name in names[: int(rng.integers(1, 4))]]
    with TdmsWriter(path) as file:
        for _ in range(any_of(rng, (1, 1, 2, 3))):
            n, channels = any_of(rng, (2, 9) if usual else (0, 1, 2, 9)), []
            parts.append({})
            for group, name, kind in drawn:
                size = n if usual or rng.random() < 0.8 else 7
                values = (100 * rng.random(size)).astype("i8" if kind[0] == "M" else kind).astype(kind)
                chosen = {
                    key: any_of(rng, choices) for key, choices in odd.items() if not usual and rng.random() < 0.15
                }
                properties = {"wf_increment": 0.1} | chosen
                channels.append(ChannelObject(group, name, list(values) if kind[0] == "U" else values, properties))
                parts[-1][name] = values
            front = [RootObject({"name": any_of(rng, ("x", 1.0))}), GroupObject("g", {"x": "\n" * 9})]
            file.write_segment([*(front if rng.random() < 0.3 else ()), *channels])
            if not usual and rng.random() < 0.5:
                drawn = [(group, name, any_of(rng, kinds)) for group, name, _ in drawn]
    return np.array([np.concatenate([part[name] for part in parts]) for _, name, _ in drawn], float) if usual else None


LEAD_IN = struct.Struct(
    "<4sIIQQ"
)  # of a TDMS segment: tag, what it holds, version, its length, that of its description
LIES = (0, 1, 2, 3, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 2**63 - 1, 2**64 - 1)


def lying(data: bytes, rng: np.random.Generator) -> bytes:
    """TDMS segments out of order, twice, cut off, or with sizes, counts and types that are not true."""
    starts = [i for i in range(len(data)) if data[i : i + 4] == b"TDSm"]
    parts = [data[a:b] for a, b in zip(starts, [*starts[1:], len(data)])]
    at, kind = int(rng.integers(len(parts))), int(rng.integers(6))
    part = parts[at]
    if kind == 0:
        tag, *fields = LEAD_IN.unpack(part[: LEAD_IN.size])
        which = int(rng.integers(4))
        size = 32 if which < 2 else 64
        fields[which] = any_of(rng, (*LIES, *(fields[which] + d for d in (-8, -1, 1, 8)))) % 2**size
        part = LEAD_IN.pack(tag, *fields) + part[LEAD_IN.size :]
    elif kind in (1, 2):  # a count, a length or a type within the description
        size = any_of(rng, (4, 8))
        place = int(rng.integers(LEAD_IN.size, max(len(part) - size, LEAD_IN.size + 1)))
        part = part[:place] + (any_of(rng, LIES) % 2 ** (8 * size)).to_bytes(size, "little") + part[place + size :]
    elif kind == 3:
        part = part[: int(rng.integers(len(part)))]
    elif kind == 4:
        part = part + part
    else:
        part = part[: LEAD_IN.size] if rng.random() < 0.5 else b""
    return b"".join([*parts[:at], part, *parts[at + 1 :]])


def chunk(name: bytes, body: bytes, size: int | None = None) -> bytes:
    return name + struct.pack("<I", len(body) if size is None else size) + body + b"\0" * (len(body) % 2)


def sound(rng: np.random.Generator, lies: int) -> tuple[bytes, np.ndarray]:
    """A WAV file of 8, 16, 24 or 32 bits or of floats, and its numbers; so many of its sizes or fields are not true."""
    bits, form = any_of(rng, ((8, 1), (16, 1), (24, 1), (32, 1), (64, 1), (32, 3), (64, 3)))
    channels, n = int(rng.integers(1, 4)), any_of(rng, (2, 9, 40))
    if form == 3:
        values = rng.standard_normal((n, channels)).astype(f"f{bits // 8}")
        body = values.tobytes()
    else:
        values = rng.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1, (n, channels), dtype="i8")
        stored = values + 128 if bits == 8 else values  # 8 bits are without sign
        body = b"".join(int(v).to_bytes(bits // 8, "little", signed=bits > 8) for v in stored.ravel())
        values = values / 2.0 ** (bits - 1)
    told = {
        "form": form,
        "channels": channels,
        "rate": any_of(rng, (100, 48_000)),
        "bytes": None,
        "block": None,
        "bits": bits,
    }
    sizes = dict.fromkeys(("fmt", "data", "riff"))
    order, tail, tag = ["fmt", "data"], slice(None), b"RIFF"
    for _ in range(lies):
        kind = int(rng.integers(7))
        if kind == 0:
            told |= {any_of(rng, ("channels", "block", "bits")): any_of(rng, (0, 1, 3, 7, 12, 48, 0xFFFF))}
        elif kind == 1:
            told |= {any_of(rng, ("rate", "bytes")): any_of(rng, (0, 1, 0x7FFFFFFF, 0xFFFFFFFF))}
        elif kind == 2:
            told["form"] = any_of(rng, (0, 1, 2, 3, 6, 0x11, 0x55, 0xFFFE, 0xFFFF))
        elif kind == 3:
            sizes[any_of(rng, list(sizes))] = any_of(
                rng, (0, 1, 15, 17, 40, len(body) - 1, len(body) + 1, 0x7FFFFFFF, 0xFFFFFFFF)
            )
        elif kind == 4:
            orders = (
                "data fmt",
                "fmt",
                "data",
                "",
                "fmt data data",
                "fmt fmt data",
                "fmt odd data LIST",
                "fmt zero data",
            )
            order = any_of(rng, orders).split()
        elif kind == 5:
            tail = slice(int(rng.integers(0, 60 + len(body))))
        else:
            tag = any_of(rng, (b"RIFX", b"RF64", b"FORM", b"\0\0\0\0"))
    block = told["channels"] * told["bits"] // 8 % 2**16 if told["block"] is None else told["block"]
    rate = told["rate"] * block % 2**32 if told["bytes"] is None else told["bytes"]
    head = struct.pack("<HHIIHH", told["form"], told["channels"], told["rate"], rate, block, told["bits"])
    made = {
        "fmt": chunk(b"fmt ", head, sizes["fmt"]),
        "data": chunk(b"data", body, sizes["data"]),
        "LIST": chunk(b"LIST", b"INFOISFT\x05\0\0\0x\x1b[2"),
        "odd": chunk(b"\xff\n\0 ", b"x", any_of(rng, (1, 0, 0xFFFFFFFF))),
        "zero": bytes(16),
    }
    rest = b"WAVE" + b"".join(made[name] for name in order)
    return chunk(tag, rest, sizes["riff"])[tail], values.T


def make(path, rng: np.random.Generator) -> np.ndarray | None:
    """A file of the kind that its ending says; returns its signals where it is a record for certain."""
    told = None
    if path.suffix == ".csv":
        path.write_bytes(table(rng))
    elif path.suffix == ".uff":
        channels = (Channel("tip", "velocity", at=0.5), Channel("b", "displacement"))
        write_record(Record(0.01, rng.standard_normal((2, 9)), channels), path)
        path.write_bytes(universal(rng, path.read_bytes()))
    elif path.suffix == ".tdms":
        told = segments(path, rng)
        if rng.random() < 0.5:
            path.write_bytes(lying(path.read_bytes(), rng))
            told = None
    elif path.suffix == ".wav":
        lies = any_of(rng, (0, 1, 1, 2))
        data, values = sound(rng, lies)
        path.write_bytes(data)
        told = None if lies else values
    elif path.suffix == ".npz":
        np.savez(path, **arrays(rng))
    elif path.suffix == ".mat":
        savemat(
            path, {f"v{i}" if not name.isidentifier() else name: v for i, (name, v) in enumerate(arrays(rng).items())}
        )
    else:
        with h5py.File(path, "w") as file:
            for name, values in arrays(rng).items():
                file[name.replace("/", "|")] = str(values) if values.dtype.kind == "U" else values
            if rng.random() < 0.3:
                file.attrs["record_header"] = any_of(rng, HEADERS)
    return told


def in_this_process(module, path, limits=DEFAULT):
    """What a reader of its own process does, without the process: these files are odd, not made to crash it."""
    try:
        found = {name: np.asarray(v) for name, v in import_module(module).load(path, limits).items()}
    except Exception as error:
        raise (error if isinstance(error, RecordFileError) else unreadable(path, error)) from error
    return {name: values for name, values in found.items() if values.dtype.kind in "fiubcU"}


def tried(path, rng: np.random.Generator, told: np.ndarray | None) -> bool:
    """Whether the file could be read; a refusal is one short line that names it, and never of what is a record."""
    options = {"sample_rate_hz": 100.0} if told is None and rng.random() < 0.3 else {}
    inputs = ("a",) if told is None and rng.random() < 0.2 else ()
    try:
        found = read_measured(path, inputs=inputs, **options)
    except RecordFileError as error:
        assert path.name in str(error) and len(str(error)) < 1000 and "\n" not in str(error)
        assert told is None, str(error)
        return False
    assert isinstance(found, Record | FrequencyResponses) and len(repr(found)) < 1000
    assert not isinstance(found, Record) or (np.isfinite(found.outputs).all() and found.n_samples >= 2)
    if told is not None:
        np.testing.assert_array_equal(np.vstack([found.inputs, found.outputs]), told)
    return True


@pytest.fixture
def here(monkeypatch):
    """What is read in a process of its own is read in this one."""
    for name in READERS:
        module = f"workbench.records.{name}"
        monkeypatch.setattr(f"{module}.arrays", partial(in_this_process, module))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", KINDS)
def test_whatever_is_in_a_file_it_is_read_or_refused(tmp_path, here, ending, count=36):
    read = 0
    for seed in range(count):
        rng = np.random.default_rng([KINDS.index(ending), seed])
        path = tmp_path / f"x{seed}{ending}"
        told = make(path, rng)
        read += tried(path, rng, told)
        path.unlink()
    # what this program wrote carries a checksum, so of its universal files none that is changed is read
    assert read < count and (read > 0 or ending == ".uff")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", KINDS)
def test_many_files(tmp_path, here, ending):
    test_whatever_is_in_a_file_it_is_read_or_refused(tmp_path, here, ending, count=1200)


@pytest.mark.parametrize("header", HEADERS)
def test_a_header_of_the_wrong_type_is_refused(tmp_path, header):
    path = tmp_path / "x.npz"
    np.savez(path, f=np.arange(7.0), h=1j * np.ones((2, 7)), frf_header=np.array(header))
    with pytest.raises(RecordFileError):
        read_measured(path)
    np.savez(path, t=np.arange(7.0), record_channel_0=np.ones(7), record_header=np.array(header))
    with pytest.raises(RecordFileError):
        read_measured(path)


def test_places_of_frfs_that_are_no_numbers_are_refused(tmp_path):
    path = tmp_path / "x.npz"
    np.savez(path, f=np.arange(7.0), h=1j * np.ones((1, 7)), at=np.array(["at the tip"]))
    with pytest.raises(RecordFileError, match="no numbers, 'at the tip'"):
        read_measured(path)


def labview(path, *parts, **properties):
    with TdmsWriter(path) as file:
        for part in parts:
            file.write_segment([ChannelObject("g", name, values, properties) for name, values in part.items()])
    return path.read_bytes()


def test_labview_files_that_their_reader_would_shorten_or_not_scale_are_refused(tmp_path, here):
    path, values = tmp_path / "x.tdms", np.arange(9.0)
    labview(path, {"a": values}, wf_increment=0.1, **{"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "Odd"})
    with pytest.raises(RecordFileError, match="Unsupported scale type: Odd"):
        read_measured(path)
    whole = labview(path, {"a": values}, {"a": values}, wf_increment=0.1)
    assert read_measured(path).n_samples == 18
    second = whole.rindex(b"TDSm")
    for kept in range(second + 1, len(whole)):
        path.write_bytes(whole[:kept])
        with pytest.raises(RecordFileError, match="ends within its last segment"):
            read_measured(path)
    path.write_bytes(b"time,a\n0,1\n1,2\n" * 9)
    with pytest.raises(RecordFileError, match="does not start with b'TDSm'"):
        read_measured(path)


def test_labview_channels_that_would_take_the_place_of_others_are_refused(tmp_path, here):
    path, values = tmp_path / "x.tdms", np.arange(9.0)
    labview(path, {"a [g]": values}, wf_increment=0.1)
    with TdmsWriter(path, mode="a") as file:
        file.write_segment([ChannelObject("g", "a", values, {"wf_increment": 0.1, "unit_string": "g"})])
    with pytest.raises(RecordFileError, match=r"two channels 'a \[g\]'"):
        read_measured(path)
    labview(path, {"t": values, "a": values}, wf_increment=0.1)
    with pytest.raises(RecordFileError, match="channel 't' beside the sample instants"):
        read_measured(path)


def test_what_a_reader_stumbles_over_is_told_in_words(tmp_path, here):
    path = tmp_path / "x.wav"
    path.write_bytes(
        chunk(b"RIFF", b"WAVE" + chunk(b"fmt ", struct.pack("<HHIIHH", 1, 0, 100, 0, 0, 16)) + chunk(b"data", b"x"))
    )
    with pytest.raises(RecordFileError, match=r"ZeroDivisionError in its reader \(.*\): it is damaged, or of a kind"):
        read_measured(path)
