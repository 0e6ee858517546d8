"""Files made up from the grammar of each format, a record, transfer functions, or a refusal in one line.

Case folders have theirs in `test_damaged_cases.py`.
"""

from functools import partial
from importlib import import_module

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from workbench.records.files import read_measured, write_record
from workbench.records.limits import DEFAULT, RecordFileError, unreadable
from workbench.records.record import Channel, Record
from workbench.records.transfer_functions import TransferFunctions

KINDS = (".csv", ".npz", ".mat", ".h5", ".uff")
NAMES = ("t", "time", "Time (ms)", "a", "a [g]", "F (kN)", "acc real", "acc imag", "frequency [hz]", "f", "freq", "fs",
         "omega", "positions", "transfer_header", "record_header", "record_channel_0", "npts", "b c", "x / mm",
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


def make(path, rng: np.random.Generator) -> None:
    """A file of the kind that its ending says."""
    if path.suffix == ".csv":
        path.write_bytes(table(rng))
    elif path.suffix == ".uff":
        channels = (Channel("tip", "velocity", at=0.5), Channel("b", "displacement"))
        write_record(Record(0.01, rng.standard_normal((2, 9)), channels), path)
        path.write_bytes(universal(rng, path.read_bytes()))
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


def in_this_process(module, path, limits=DEFAULT):
    """What a reader of its own process does, without the process: these files are odd, not made to crash it."""
    try:
        found = {name: np.asarray(v) for name, v in import_module(module).load(path, limits).items()}
    except Exception as error:
        raise (error if isinstance(error, RecordFileError) else unreadable(path, error)) from error
    return {name: values for name, values in found.items() if values.dtype.kind in "fiubcU"}


def tried(path, rng: np.random.Generator) -> bool:
    """Whether the file could be read; a refusal is one short line that names it."""
    options = {"sample_rate_hz": 100.0} if rng.random() < 0.3 else {}
    inputs = ("a",) if rng.random() < 0.2 else ()
    try:
        found = read_measured(path, inputs=inputs, **options)
    except RecordFileError as error:
        assert path.name in str(error) and len(str(error)) < 1000 and "\n" not in str(error)
        return False
    assert isinstance(found, Record | TransferFunctions) and len(repr(found)) < 1000
    assert not isinstance(found, Record) or (np.isfinite(found.outputs).all() and found.n_samples >= 2)
    return True


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", KINDS)
def test_whatever_is_in_a_file_it_is_read_or_refused(tmp_path, monkeypatch, ending, count=60):
    for name in ("mat_file", "hdf5_file", "uff_file"):
        module = f"workbench.records.{name}"
        monkeypatch.setattr(f"{module}.arrays", partial(in_this_process, module))
    read = 0
    for seed in range(count):
        rng = np.random.default_rng([KINDS.index(ending), seed])
        path = tmp_path / f"x{seed}{ending}"
        make(path, rng)
        read += tried(path, rng)
        path.unlink()
    # what this program wrote carries a checksum, so of its universal files none that is changed is read
    assert read < count and (read > 0 or ending == ".uff")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", KINDS)
def test_ten_thousand_files(tmp_path, monkeypatch, ending):
    test_whatever_is_in_a_file_it_is_read_or_refused(tmp_path, monkeypatch, ending, count=2000)


@pytest.mark.parametrize("header", HEADERS)
def test_a_header_of_the_wrong_type_is_refused(tmp_path, header):
    path = tmp_path / "x.npz"
    np.savez(path, f=np.arange(7.0), h=1j * np.ones((2, 7)), transfer_header=np.array(header))
    with pytest.raises(RecordFileError):
        read_measured(path)
    np.savez(path, t=np.arange(7.0), record_channel_0=np.ones(7), record_header=np.array(header))
    with pytest.raises(RecordFileError):
        read_measured(path)


def test_places_of_transfer_functions_that_are_no_numbers_are_refused(tmp_path):
    path = tmp_path / "x.npz"
    np.savez(path, f=np.arange(7.0), h=1j * np.ones((1, 7)), at=np.array(["at the tip"]))
    with pytest.raises(RecordFileError, match="no numbers, 'at the tip'"):
        read_measured(path)
