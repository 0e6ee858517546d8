"""Case files made up from the grammar of `docs/reference/case-format.md`: the case that they tell, or a refusal."""

import re
import resource
import shutil
import tomllib
import zipfile
from pathlib import Path
from time import process_time

import numpy as np
import pytest
from scipy.linalg import eigh
from threadpoolctl import threadpool_info, threadpool_limits
from typer.testing import CliRunner

from workbench.cases.case import Case, CaseError, read_case
from workbench.cases.nominal import read_rig
from workbench.cases.writing import write_case
from workbench.cli.app import app
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig, shape_of
from workbench.rig.sensors import Sensor
from workbench.structure import surface_ritz
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Bar

LONGEST, MOST = 10.0, 2 * 2**20  # s; KiB, as the system counts
SAMPLES, STEP = 64, 0.25  # of a record, s
NAMES = ("F1", "w2", "a b", "é", "[red]", "file", "b/c", "x.y", "a (left)")
CLASHES = ("t", "F1", "w2", "", "f1", " F1", "record_header", "a\\u0000b", "all", "T", "time", "1", "a [g]", "F / kN")
WRONG_TYPES = ('""', '"1"', "true", "[]", "{}", "[[[1.0]]]", "[" * 30 + "]" * 30, '[1.0, "x"]', "2024-05-01",
               "12:00:00", "[{}]", "{x = 1.0}", "[true]", "[nan]", "{x = [0.0], value = [1.0, 2.0]}", "'''\n'''",
               )  # fmt: skip
ABSURD = ("1e300", "-1e300", "1e-300", "5e-324", "-0.0", "inf", "-inf", "nan", "1e400", "9" * 400, "0x7fffffffffffffff",
          "[" + "1.0, " * 5000 + "]", '"' + "x" * 5000 + '"', "[" * 5000, "1e154", "-1e-160")  # fmt: skip
BOUNDS = {
    "modes": ("0", "1", "200", "201", "-1", "2.0", "6.5"),
    "poisson_ratio": ("0.0", "0.5", "-1.0", "0.4999999", "1.0"),
    "damping_ratio": ("0.0", "1.0", "1e-9", "2.0", "-0.01"),
    "damping_ratios": ("[0.0, 0.0, 0.0]", "[1.0, 1.0, 1.0]", "[0.01]", "[0.01, 0.01, 0.01, 0.01]", "0.01"),
    "natural_frequencies_hz": ("[0.0, 0.0, 0.0]", "[1.0, 1.0, 1.0]", "[3.0, 2.0, 1.0]", "[-1.0, 2.0, 3.0]", "[1.0]"),
    "rigid_damping": ("[0.0]", "[-1.0]", "[1.0, 1.0]", "0.1"),
    "tension": ("0.0", "-4.0", "-1e4", "1e9"),
    "at": ("0.0", "1.0", "-1e-12", "[0.0, 0.0]", "[1.0, 0.7]", "[2.0, 0.1]", "1.0000001", "[0.5]", "[0.1, 0.1, 0.1]"),
    "patch": ("0.0", "-0.1", "5.0", "1e-12", "[0.1]", "[0.0, 0.1]", "[3.0, 3.0]", "[0.1, 0.1]"),
    "length": ("0.0", "-1.0", "1e-9", "1e9", "[1.0]", "[1.0, 0.7, 0.2]", "[1.0, 0.0]", "[1.0, 1e-6]"),
    "sample_time": ("0.0", "-0.25", "0.2499", "0.253", "0.25000001", "1"),
    "file": ('"."', '""', '"../case.toml"', '"/dev/zero"', '"case.toml"', '"records"', '"records/none.npz"', '"a.xyz"'),
    "points": ('"."', '"../points.csv"', '"case.toml"', '"none.csv"', '"/dev/zero"'),
    "use": ('"Fit"', '"validation"', '"both"'),
    "input_hold": ('"second"', '"zero "', '"Zero"'),
    "shape": ("[0.0, 0.0, 0.0]", "[1.0]", "[1e200, 1e200, 1e200]", "[1.0, 1.0, 1.0, 1.0]"),
    "noise_std": ("0.0", "-1.0", "1e-200", "1e200"),
    "edges": ('"free"', '{left = "free"}', '{left = "hinged", right = "free", top = "free", bottom = "free"}'),
}  # fmt: skip
PROFILES = ("mass_per_length", "bending_stiffness", "axial_stiffness")
# x and values: ends, and places between them, where a profile vanishes or jumps; places out of order, twice or outside
VANISHING = (("0, 1", "1, 0"), ("0, 1", "0, 1"), ("0, 0.5, 1", "0, 1, 0"), ("0, 0.5, 1", "1, 0, 1"),
             ("0, 1", "1, 1e-12"), ("0.5", "1"), ("0, 0.5, 0.5, 1", "1, 1, 9, 9"), ("1, 0", "1, 2"),
             ("0, 5", "1, 0"), ("-1, 1", "0, 1"),
             ("0, 1e-9, 1", "0, 1, 1"), ("0, 1", "0, 0"), ("0, 1", "1e-200, 1e200"))  # fmt: skip


def any_of(rng, choices):
    return choices[int(rng.integers(len(choices)))]


def some(rng, **entries):
    """Each of the optional entries in half of the files."""
    return {key: value for key, value in entries.items() if rng.random() < 0.5}


def profile(rng, low, high):
    a, b = rng.uniform(low, high, 2)
    return any_of(rng, (f"{a:.4f}", f"{{x = [0.0, 1.0], value = [{a:.4f}, {b:.4f}]}}"))


def member(rng):
    kind = any_of(rng, ("beam", "rod", "bar"))
    ends = ("hinged", "clamped", "free", "sliding") if kind == "beam" else ("fixed", "free")
    stiffness = "bending_stiffness" if kind == "beam" else "axial_stiffness"
    table = {
        "kind": f'"{kind}"',
        "length": "1.0",
        "mass_per_length": profile(rng, 0.5, 2.0),
        stiffness: profile(rng, 1.0, 20.0),
        "left": f'"{any_of(rng, ends)}"',
        "right": f'"{any_of(rng, ends)}"',
        "damping_ratio": "0.01",
        "modes": str(rng.integers(1, 7)),
    }
    measured = ("displacement", "velocity", "acceleration", *(("slope", "angular velocity") if kind == "beam" else ()))

    def place(key, quantity):
        patch = (
            {"patch": "0.1"} if key == "input" and kind == "beam" and quantity is None and rng.random() < 0.3 else {}
        )
        return {"at": f"{rng.uniform(0.1, 0.9):.4f}", **patch}

    moments = some(rng, quantity='"moment"') if kind == "beam" else {}
    return table | (some(rng, tension="1.0") if kind == "beam" else {}), measured, moments, place


def plate(rng):
    edges = ("simply supported", "clamped", "guided", "free")
    sides = ", ".join(f'{side} = "{any_of(rng, edges)}"' for side in ("left", "right", "bottom", "top"))
    table = {
        "kind": '"plate"',
        "length": "[1.0, 0.7]",
        "mass_per_area": "2.0",
        "bending_stiffness": "5.0",
        "poisson_ratio": "0.3",
        "edges": f"{{{sides}}}",
        "damping_ratio": "0.01",
        "modes": str(rng.integers(1, 5)),
    }

    def place(key, quantity):
        axis = (
            {"axis": any_of(rng, ('"x"', '"y"'))} if quantity in ('"moment"', '"slope"', '"angular velocity"') else {}
        )
        return {"at": f"[{rng.uniform(0.2, 0.8):.4f}, {rng.uniform(0.2, 0.5):.4f}]", **axis}

    measured = ("displacement", "velocity", "acceleration", "slope", "angular velocity")
    return table, measured, some(rng, quantity='"moment"'), place


TURNING = ('"moment"', '"slope"', '"angular velocity"')


def modal(rng):
    """Plain modal data, those at the points of a table, or a single degree of freedom."""
    measured = ("displacement", "velocity", "acceleration")
    if rng.random() < 0.2:
        table = {"kind": '"modal"', "mass": "2.0", "damping": "0.1", "stiffness": "30.0"}
        return table, measured, {}, lambda key, quantity: {}
    rigid = rng.random() < 0.3
    table = {
        "kind": '"modal"',
        "natural_frequencies_hz": "[0.0, 1.0, 1.7]" if rigid else "[0.5, 1.0, 1.7]",
        "damping_ratios": "[0.01, 0.02, 0.01]",
        **(some(rng, rigid_damping="[0.1]") if rigid else {}),
    }
    if rng.random() < 0.5:

        def place(key, quantity):
            turned = {"point": '"n2"', "axis": '"x"'}, {"point": '"r1"'}
            return any_of(
                rng, turned if quantity in TURNING else ({"point": '"n1z"'}, {"point": '"n2"', "direction": '"z"'})
            )

        more = ("slope", "angular velocity")
        return table | {"points": '"points.csv"'}, (*measured, *more), some(rng, quantity='"moment"'), place
    return table, measured, {}, lambda key, quantity: {"shape": "[1.0, 0.5, -0.7]"}


def points(rng):
    """The table of points, now and then with a cell or a column that does not belong."""
    rows = [["name", "node", "x", "y", "z", "direction", "mode_1", "mode_2", "mode_3"]]
    rows += [[f"n{i}z", f"n{i}", f"{i}", "0", "0", "z", "1.0", f"0.{i}", f"-0.{i}"] for i in range(1, 5)]
    rows += [[f"r{i}", f"n{i}", f"{i}", "0", "0", "rx", "0.5", f"0.{i}", f"0.{i}"] for i in range(1, 3)]
    if rng is not None and rng.random() < 0.2:
        row, column = int(rng.integers(7)), int(rng.integers(9))
        rows[row][column] = any_of(rng, ("", "nan", "1e999", "x", "n1z", "rx", "1,5", "\x1b[2J", '"', "1e300"))
    return "\n".join(map(",".join, rows))


def sections(rng):
    """Headers and entries of a case that is right, and the names of its channels."""
    table, measured, acting, place = any_of(rng, (member, member, member, modal, modal, plate))(rng)
    n_inputs, n_outputs = (int(n) for n in rng.integers(1, 3, 2))
    names = [NAMES[i] for i in rng.permutation(len(NAMES))[: n_inputs + n_outputs]]
    top = some(rng, title='"made up"', input_hold=any_of(rng, ('"zero"', '"first"', '"band-limited"')))
    found = [["", top], ["[structure]", table]]
    if rng.random() < 0.2:
        found.append(["[units]", {"length": '"mm"', "mass": '"t"', "time": '"s"', "force": '"N"'}])
    for name in names[:n_inputs]:
        entries = {"name": f'"{name}"', "kind": any_of(rng, ('"actuator"', '"hammer"'))}
        entries |= acting if entries["kind"] == '"actuator"' else {}
        found.append(["[[input]]", entries | place("input", entries.get("quantity"))])
        if "patch" in found[-1][1]:
            found[-1][1]["kind"] = '"actuator"'
    for name in names[n_inputs:]:
        entries = {"name": f'"{name}"', "quantity": f'"{any_of(rng, measured)}"', **some(rng, noise_std="0.01")}
        found.append(["[[output]]", entries | place("output", entries["quantity"])])
    for i, use in enumerate(("fit", "validate", "fit")[: int(rng.integers(1, 4))]):
        ending = any_of(rng, ("npz", "npz", "csv"))
        entries = {"name": f'"r{i}"', "file": f'"r{i}.{ending}"', "sample_time": f"{STEP}", "use": f'"{use}"'}
        found.append(["[[record]]", entries | some(rng, input_hold='"zero"')])
    return found, names


def spoil(found, rng):
    """One entry or table of a case made wrong, or odd."""
    at = int(rng.integers(len(found)))
    header, entries = found[at]
    whole = int(rng.integers(12))
    if whole == 0:
        del found[at]
    elif whole == 1:
        found.append([header, dict(entries)])
    elif whole == 2:
        found[at][0] = any_of(rng, (f"[{header}]", header.strip("[]"), "[structure.more]", "[[structure]]", "[x]"))
    if whole < 3 or not entries:
        return
    key = any_of(rng, list(entries))
    kind = int(rng.integers(9))
    if kind == 0:
        del entries[key]
    elif kind == 1:
        entries[key] += f"\n{key} = {entries[key]}"
    elif kind == 2:
        entries[any_of(rng, (key[:-1], key + "_", f'"{key} "', f"{key}.more", key.upper()))] = entries.pop(key)
    elif kind == 3:
        other = any_of(rng, found)[1]
        other[key] = entries[key]
    elif kind == 4:
        entries[key] = any_of(rng, WRONG_TYPES)
    elif kind == 5:
        entries[key] = any_of(rng, ABSURD)
    elif kind == 6:
        plain = entries[key].strip('"')
        entries[key] = any_of(
            rng, (f'"{plain} mm"', f'"{plain} %"', f"{plain}e3", f"{plain}e-6", f"{plain} mm", f"-{plain}")
        )
    elif "name" in entries and rng.random() < 0.5:
        entries["name"] = f'"{any_of(rng, CLASHES)}"'
    elif any(name in entries for name in PROFILES) and rng.random() < 0.5:
        x, value = any_of(rng, VANISHING)
        entries[any_of(rng, [n for n in PROFILES if n in entries])] = f"{{x = [{x}], value = [{value}]}}"
    else:
        key = any_of(rng, [name for name in entries if name in BOUNDS] or [key])
        entries[key] = any_of(rng, BOUNDS.get(key, ('"x"', "0", "-1")))


def written(found, rng):
    """The text of a case, the keys bare or in quotes, tables dotted or with headers."""
    lines = []
    for header, entries in found:
        dotted = header == "[structure]" and rng.random() < 0.1 and not any("\n" in value for value in entries.values())
        lines += [] if dotted else [header]
        for key, value in entries.items():
            shown = f'"{key}"' if key.isidentifier() and rng.random() < 0.1 else key
            lines.append(f"{'structure.' if dotted else ''}{shown} = {value}")
    return any_of(rng, ("\n", "\n", "\r\n")).join(lines)


def record(path, names, rng):
    signals = {"t": STEP * np.arange(SAMPLES)} | {name: rng.standard_normal(SAMPLES) for name in names}
    if path.suffix == ".npz":
        with zipfile.ZipFile(path, "w") as archive:
            for name, values in signals.items():
                with archive.open(f"{name}.npy", "w") as file:
                    np.lib.format.write_array(file, values)
    else:
        rows = [[*signals], *np.column_stack([*signals.values()]).astype(str).tolist()]
        path.write_text("\n".join(map(",".join, rows)))


def make(folder, rng, wrongs):
    """A case folder with so many entries spoilt; returns the name of its first input."""
    folder.mkdir()
    found, names = sections(rng)
    for header, entries in found:
        if header == "[[record]]":
            record(folder / entries["file"].strip('"'), names, rng)
    (folder / "points.csv").write_text(points(rng) if wrongs else points(None))
    for _ in range(wrongs):
        spoil(found, rng)
    (folder / "case.toml").write_text(written(found, rng), newline="")
    return names[0]


def check_told(case, folder):
    """An accepted case has the channels, modes and records that tomllib finds in its file; written again, the same."""
    table = tomllib.loads((folder / "case.toml").read_text())
    transducers = [*table["input"], *table["output"]]
    assert [transducer.name for transducer in (*case.rig.actuators, *case.rig.sensors)] == [
        transducer["name"] for transducer in transducers
    ]
    structure, omega = table["structure"], case.rig.modes.omega
    n_modes = structure.get("modes", len(structure.get("natural_frequencies_hz", [1])))
    assert omega.shape == (n_modes,) and np.isfinite(omega).all() and np.isfinite(case.rig.modes.damping).all()
    for use, records in (("fit", case.fit), ("validate", case.validation)):
        entries = [entry for entry in table["record"] if entry["use"] == use]
        assert [(r.name, r.sample_time) for r in records] == [(e["name"], e["sample_time"]) for e in entries]
    again = read_case(write_case(case, folder / "again").parent)
    np.testing.assert_allclose(again.rig.modes.omega, omega, rtol=1e-9)
    np.testing.assert_array_equal(again.fit[0].outputs, case.fit[0].outputs)
    for transducers in ("actuators", "sensors"):
        moved = [
            [shape_of(rig.modes, transducer) for transducer in getattr(rig, transducers)]
            for rig in (case.rig, again.rig)
        ]
        np.testing.assert_allclose(*moved, rtol=1e-6, atol=1e-9)


@pytest.mark.filterwarnings("ignore")
def test_a_case_of_the_grammar_is_what_it_tells_or_refused(tmp_path, count=48):
    refused = 0
    for seed in range(count):
        rng = np.random.default_rng([8, seed])
        wrongs, folder = any_of(rng, (0, 1, 1, 2)), tmp_path / f"case-{seed}"
        first = make(folder, rng, wrongs)
        start = process_time()
        try:
            case = read_case(folder)
        except CaseError as error:
            refused += 1
            text = str(error)
            assert wrongs and folder.name in text and len(text) < 1000 and text.isprintable(), (seed, text[:500])
        else:
            check_told(case, folder)
        if seed % 4 == 0:
            result = CliRunner().invoke(app, ["design", str(folder), "--controlled-modes", "1", "--impulse-at", first])
            assert result.exit_code in (0, 2) and "Traceback" not in result.output, (seed, result.output[-1000:])
        assert process_time() - start < 2 * LONGEST, seed
        shutil.rmtree(folder)
    assert count / 4 < refused < count
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < MOST


def test_the_grammar_has_every_documented_key():
    """Of the tables of the page, up to the part on what a diagnosis writes."""
    page = (Path(__file__).parents[2] / "docs" / "reference" / "case-format.md").read_text(encoding="utf-8")
    cells = [line.split("|")[1] for line in page.split("## The gap")[0].splitlines() if line.startswith("| `")]
    documented = {key for cell in cells for key in re.findall(r"`(\w+)`", cell)}
    rng = np.random.default_rng(0)
    drawn = {key for _ in range(200) for _, entries in sections(rng)[0] for key in entries}
    assert len(documented) >= 30 and documented <= drawn


@pytest.mark.slow
def test_many_cases_of_the_grammar(tmp_path):
    test_a_case_of_the_grammar_is_what_it_tells_or_refused(tmp_path, count=1600)


def test_a_plate_whose_corners_are_clamped_and_free_is_read_on_one_thread(tmp_path, monkeypatch):
    """Its strips are beams between clamps, of which E becomes up to E/(1 - ν²): ω between theirs, βa = 4.7300."""
    threads = set()

    def counted(*args, **options):
        threads.update(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas")
        return eigh(*args, **options)

    monkeypatch.setattr(surface_ritz, "eigh", counted)
    (tmp_path / "case.toml").write_text(
        '[structure]\nkind = "plate"\nlength = [1.0, 0.7]\nmass_per_area = 2.0\nbending_stiffness = 5.0\n'
        'poisson_ratio = 0.3\nedges = {left = "clamped", right = "clamped", bottom = "free", top = "free"}\n'
        'damping_ratio = 0.01\nmodes = 4\n[[input]]\nname = "F"\nkind = "actuator"\nat = [0.3, 0.4]\n'
        '[[output]]\nname = "w"\nquantity = "displacement"\nat = [0.6, 0.3]\n'
    )
    with threadpool_limits(2, user_api="blas"):
        omega = read_rig(tmp_path / "case.toml").modes.omega
    stiff = 4.7300407**2 * np.sqrt(5.0 / 2.0)
    assert np.sqrt(1.0 - 0.3**2) * stiff < omega[0] < stiff and threads == {1}


def test_names_and_jumps_that_are_read_are_written(tmp_path):
    """Names of arguments of `savez`, names that would be paths, and points twice at one place."""
    mass, stiffness = ([0.0, 0.4, 0.4, 1.0], [1.0, 1.0, 3.0, 2.0]), ([0.0, 0.7, 0.7, 1.0], [4.0, 5.0, 1.0, 1.0])
    bar = Bar(length=1.0, mass_per_length=mass, axial_stiffness=stiffness, left="fixed", right="free",
              damping=ModalDamping(0.01))  # fmt: skip
    rig = Rig(bar.modes(3), (Actuator("file", 0.3),), (Sensor("allow_pickle", 0.5),), structure=bar)
    records = [
        rig.record(*np.random.default_rng(i).standard_normal((2, 1, 60)), sample_time=0.1, name=name)
        for i, name in enumerate(("a/b", "a%2Fb", "../../c"))
    ]
    case = read_case(write_case(Case("x", rig, tuple(records), ()), tmp_path / "case").parent)
    np.testing.assert_allclose(case.rig.modes.omega, rig.modes.omega, rtol=1e-8)
    for read, record in zip(case.fit, records, strict=True):
        assert read.name == record.name
        np.testing.assert_array_equal(read.outputs, record.outputs)
    assert [path.name for path in tmp_path.iterdir()] == ["case"]
