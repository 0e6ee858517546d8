"""Case folders that were cut, re-typed, reordered or made to do harm: the case that they tell, or a refusal."""

import math
import resource
import shutil
import time as clock
import tomllib

import numpy as np
import pytest
from typer.testing import CliRunner

from workbench.cases.case import Case, CaseError, read_case
from workbench.cases.writing import write_case
from workbench.cli.app import app
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam

LONGEST, MOST = 10.0, 2 * 2**20  # s; KiB, as the system counts


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A uniform hinged beam, whose frequencies are known in closed form."""
    beam = Beam(length=2.0, mass_per_length=1.5, bending_stiffness=3.0, left="hinged", right="hinged",
                damping=ModalDamping(0.01))  # fmt: skip
    actuators = (Actuator("F1", 0.7), Actuator("tap", 1.1, direct=True))
    sensors = (Sensor("d1", 0.5, noise_std=1e-4), Sensor("a1", 1.2, "acceleration", noise_std=1e-2))
    rig = Rig(beam.modes(5, tolerance=1e-9), actuators, sensors, structure=beam)
    inputs = np.random.default_rng(1).standard_normal((2, 200))
    records = [simulate(rig, inputs, sample_time=0.02, name=name) for name in ("one", "kept")]
    folder = tmp_path_factory.mktemp("cases") / "whole"
    write_case(Case("a beam", rig, (records[0],), (records[1],)), folder)
    return folder


# --- damage

WORDS = (
    "", "x", 0, -1, 1, 7, -2.5, 0.0, 1e-300, 1e300, math.inf, -math.inf, math.nan, True, False, 10**400, 1e6, [], {},
    [1.0, math.nan], {"x": [0.0, 2.0], "value": [1.0, 2.0]}, {"x": [2.0, 0.0], "value": [1.0, 2.0]},
    {"x": [0.0], "value": []}, {"x": [0.0, 0.0, 2.0], "value": [1.0, -1.0, 2.0]}, "../../etc/passwd", "/etc/passwd",
    "records", ".", "a" * 100_000, "\x1b]0;owned\x07", "a\x00b", "[red]", "__import__('os')", "é" * 50, "hinged",
    "clamped", "free", "beam", "rod", "modal", "d1", "records/one.npz", "fit", "validate", 2**63,
)  # fmt: skip


def places(table, path=()):
    """Where a table can be changed."""
    if path:
        yield path
    items = table.items() if isinstance(table, dict) else enumerate(table) if isinstance(table, list) else ()
    for key, value in items:
        yield from places(value, (*path, key))


def changed(table: dict, rng: np.random.Generator) -> dict:
    """A value swapped for another, a key taken out, misspelt or added, entries repeated or reordered."""
    found = list(places(table))
    *way, last = found[rng.integers(len(found))]
    holder = table
    for key in way:
        holder = holder[key]
    kind = rng.integers(6)
    if kind == 0:
        del holder[last]
    elif kind == 1 and isinstance(holder, dict):
        holder[last + "_"] = holder.pop(last)
    elif kind == 2 and isinstance(holder, list):
        holder.append(holder[last])
    elif kind == 3 and isinstance(holder, list):
        holder.reverse()
    elif kind == 4 and isinstance(holder, dict):
        holder["tensoin"] = 3.0
    else:
        holder[last] = WORDS[rng.integers(len(WORDS))]
    return table


def as_toml(value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + "".join(c if c.isprintable() and c not in '"\\' else f"\\u{ord(c):04x}" for c in value) + '"'
    if isinstance(value, dict):
        return "{" + ", ".join(f"{as_toml(key)} = {as_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_toml, value)) + "]"
    return repr(value)


def spoilt_arrays(arrays: dict, rng: np.random.Generator) -> dict:
    """Arrays of a record, re-typed, cut, reordered, renamed or made huge."""
    name = list(arrays)[rng.integers(len(arrays))]
    values = arrays[name]
    kinds = [
        lambda: values[:-1],
        lambda: values[:3],
        lambda: np.zeros(0),
        lambda: np.float64(1.0),
        lambda: values[:, None],
        lambda: values.reshape(2, -1),
        lambda: values[::-1],
        lambda: values.astype(complex),
        lambda: values.astype("f4"),
        lambda: (100 * values).astype("i4"),
        lambda: values > 0,
        lambda: values.astype(str),
        lambda: np.array([{}] * values.size, dtype=object),
        lambda: np.array([(v, 1) for v in values], dtype=[("a", "f8"), ("b", "i4")]),
        lambda: np.where(np.arange(values.size) == 17, np.nan, values),
        lambda: np.where(np.arange(values.size) == 17, np.inf, values),
        lambda: np.full(values.shape, 1e300),
        lambda: np.zeros(values.size),
        lambda: values.astype(">f8"),
        lambda: values.astype("longdouble"),
        lambda: np.zeros(2**27, "i1"),
        lambda: values.astype("M8[s]"),
    ]
    kind = rng.integers(len(kinds) + 3)
    if kind < len(kinds):
        return arrays | {name: kinds[kind]()}
    spoilt = {key: item for key, item in arrays.items() if key != name}
    return [spoilt, spoilt | {f"{name}\x1b": values}, arrays | {"more": values}][kind - len(kinds)]


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    a, b = sorted(int(i) for i in rng.integers(0, len(data), 2))
    words = (b"\x00", b"\xff\xfe", b"[" * 50_000, b"\n[structure]\n", b'"""', b"9" * 6000, b"= nan\n", b"#", b"1e999")
    choices = [
        data[:a],
        data[:a] + data[b:],
        data[:b] + data[a:],
        data[:a] + words[rng.integers(len(words))] + data[a:],
    ]
    return choices[rng.integers(len(choices))]


def damage(folder, rng: np.random.Generator) -> str:
    """Damage a case folder in one of its ways, and say how."""
    kind = ("table", "table", "text", "arrays", "bytes", "folder")[rng.integers(6)]
    toml, record = folder / "case.toml", folder / "records/one.npz"
    if kind == "table":
        toml.write_text(
            "\n".join(f"{k} = {as_toml(v)}" for k, v in changed(tomllib.loads(toml.read_text()), rng).items())
        )
    elif kind == "text":
        toml.write_bytes(cut(toml.read_bytes(), rng))
    elif kind == "arrays":
        with np.load(record) as archive:
            arrays = dict(archive)
        np.savez_compressed(record, **spoilt_arrays(arrays, rng))
    elif kind == "bytes":
        record.write_bytes(cut(record.read_bytes(), rng))
    else:
        path = (toml, record)[rng.integers(2)]
        path.unlink()
        [lambda: None, path.mkdir, lambda: path.symlink_to("/dev/zero"), lambda: path.symlink_to(path)][
            rng.integers(4)
        ]()
    return kind


def check_told(case: Case, folder) -> None:
    """An accepted case is what its files say, read here by the standard library and numpy alone."""
    table = tomllib.loads((folder / "case.toml").read_text(encoding="utf-8"))
    told, rig = table["structure"], case.rig
    known = {"kind", "length", "mass_per_length", "bending_stiffness", "axial_stiffness", "left", "right",
             "damping_ratio", "modes", "tension"}  # fmt: skip
    assert set(told) <= known
    assert rig.structure.length == told["length"] and rig.modes.n_modes == told["modes"]
    numbers = [told[key] for key in ("mass_per_length", "length")] + [told.get("bending_stiffness")]
    if told["kind"] == "beam" and told["left"] == told["right"] == "hinged" and "tension" not in told:
        if all(isinstance(number, int | float) for number in numbers):
            mass, length, stiffness = map(float, numbers)
            n = np.arange(1, told["modes"] + 1)
            np.testing.assert_allclose(
                rig.modes.omega, (n * np.pi / length) ** 2 * np.sqrt(stiffness / mass), rtol=1e-8
            )
    np.testing.assert_allclose(
        np.diag(rig.modes.damping), 2 * told["damping_ratio"] * rig.modes.omega, rtol=1e-9, atol=1e-300
    )
    for part, entry in zip(rig.actuators, table["input"], strict=True):
        assert (part.name, part.at, part.direct) == (entry["name"], entry["at"], entry["kind"] == "hammer")
    for part, entry in zip(rig.sensors, table["output"], strict=True):
        assert (part.name, part.at, part.quantity) == (entry["name"], entry["at"], entry["quantity"])
        assert part.noise_std == entry.get("noise_std", 0.0)
    for use, records in (("fit", case.fit), ("validate", case.validation)):
        entries = [entry for entry in table["record"] if entry["use"] == use]
        for record, entry in zip(records, entries, strict=True):
            with np.load(folder / entry["file"]) as arrays:
                assert set(arrays) == {"t", *record.input_names, *record.output_names}
                for names, rows in ((record.input_names, record.inputs), (record.output_names, record.outputs)):
                    for name, row in zip(names, rows, strict=True):
                        np.testing.assert_array_equal(row, arrays[name].astype(float))
            assert (record.name, record.sample_time) == (entry["name"], entry["sample_time"])


@pytest.mark.filterwarnings("ignore")
def test_a_damaged_case_is_what_it_tells_or_refused(whole, tmp_path, count=120, seed=3):
    rng = np.random.default_rng(seed)
    refused = 0
    for i in range(count):
        folder = tmp_path / f"case-{i}"
        shutil.copytree(whole, folder)
        kind = damage(folder, rng)
        start = clock.process_time()
        try:
            case = read_case(folder)
        except CaseError as error:
            refused += 1
            text = str(error)
            assert folder.name in text and len(text) < 1000 and text.isprintable(), (i, kind, text[:500])
        else:
            check_told(case, folder)
        assert clock.process_time() - start < LONGEST, (i, kind)
        shutil.rmtree(folder)
    assert count / 4 < refused < count
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < MOST


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_thousand_damaged_cases(whole, tmp_path):
    test_a_damaged_case_is_what_it_tells_or_refused(whole, tmp_path, count=1000, seed=4)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("length = 2.0", "length = 2.0\ntensoin = 5.0", "no key 'tensoin'; did you mean 'tension'"),
        ("noise_std = 0.0001", "noise_std = 0.0001\ngain = 2.0", "no key 'gain'"),
        ("length = 2.0", "length = 1" + "0" * 400, "length must be a number"),
        ("length = 2.0", "length = 1" + "0" * 5000, "TOML"),
        ("length = 2.0", "length = " + "[" * 100_000, "TOML"),
        ("[structure]", "[units]\nlength = 0.0\n\n[structure]", r"case\.toml: \[units\]: mass is missing"),
        ('name = "d1"', 'name = "d1 [mm]"', "'d1 \\[mm\\]' of an input or output ends in a unit, mm"),
        ('name = "tap"', r'name = "tap\u001b[2J"', "printable"),
        ('file = "records/one.npz"', r'file = "records/one\u0000.npz"', "printable"),
    ],
)
def test_what_would_be_read_wrong_is_refused(whole, tmp_path, old, new, words):
    folder = tmp_path / "case"
    shutil.copytree(whole, folder)
    text = (folder / "case.toml").read_text()
    assert old in text
    (folder / "case.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(CaseError, match=words):
        read_case(folder)


@pytest.mark.parametrize("where", ["case.toml", "records/one.npz", "records/kept.npz"])
def test_the_command_ends_in_one_line_and_writes_nothing(whole, tmp_path, where):
    folder, found, page = tmp_path / "case", tmp_path / "found.json", tmp_path / "page.html"
    shutil.copytree(whole, folder)
    data = (folder / where).read_bytes()
    (folder / where).write_bytes(data[: len(data) // 2])
    result = CliRunner().invoke(app, ["diagnose", str(folder), "--json", str(found), "--page", str(page)])
    assert result.exit_code == 2, result.output
    assert folder.name in result.output and len(result.output.strip().splitlines()) == 1
    assert not found.exists() and not page.exists()


@pytest.mark.filterwarnings("ignore")
def test_a_design_on_a_damaged_structure_is_one_or_a_refusal(whole, tmp_path, count=6, seed=5):
    rng = np.random.default_rng(seed)
    path, found = tmp_path / "rig.toml", tmp_path / "found.json"
    for _ in range(count):
        table = changed(tomllib.loads((whole / "case.toml").read_text()), rng)
        path.write_text("\n".join(f"{key} = {as_toml(value)}" for key, value in table.items()))
        found.unlink(missing_ok=True)
        start = clock.process_time()
        result = CliRunner().invoke(app, ["design", str(path), "--controlled-modes", "1", "--json", str(found)])
        assert clock.process_time() - start < LONGEST, table
        assert result.exit_code in (0, 2) and "Traceback" not in result.output, result.output[-1000:]
        assert found.exists() == (result.exit_code == 0)
        if found.exists():
            assert "NaN" not in found.read_text() and "Infinity" not in found.read_text()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < MOST


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_designs_on_many_damaged_structures(whole, tmp_path):
    test_a_design_on_a_damaged_structure_is_one_or_a_refusal(whole, tmp_path, count=200, seed=6)
