"""Case folders: read, written, refused."""

import os
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyuff

from workbench.cases.case import Case, CaseError, files_of, read_case, read_units
from workbench.cases.nominal import read_rig
from workbench.cases.writing import write_case
from workbench.records.files import read_record
from workbench.records.limits import RecordFileError
from workbench.records.record import Channel, Record
from workbench.records.units import Units
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Bar, Beam
from workbench.structure.supports import PointMass

CHECKOUT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("WORKBENCH_SHARED", CHECKOUT.parent / "shared")) / "gap-trials"


@pytest.fixture
def case() -> Case:
    beam = Beam(
        length=2.0,
        mass_per_length=([0.0, 0.5, 2.0], [1.5, 1.0, 1.0]),
        bending_stiffness=3.0,
        left="clamped",
        right="hinged",
        damping=ModalDamping(0.01),
    )
    actuators = (Actuator("F1", 0.7), Actuator("tap", 1.1, direct=True))
    sensors = (Sensor("d1", 0.5, noise_std=1e-4), Sensor("a1", 1.2, "acceleration", noise_std=1e-2))
    rig = Rig(beam.modes(5, tolerance=1e-9), actuators, sensors, structure=beam)
    inputs = np.random.default_rng(1).standard_normal((2, 200))
    record = simulate(rig, inputs, sample_time=0.02, name="one")
    return Case("a beam", rig, (record,), (replace(record, name="kept"),))


@pytest.fixture
def folder(case, tmp_path) -> Path:
    write_case(case, tmp_path / "case")
    return tmp_path / "case"


@pytest.mark.parametrize("word", ["rod", "bar"])
def test_a_rod_is_a_bar(word, tmp_path):
    rod = Bar(
        length=2.0, mass_per_length=1.0, axial_stiffness=4.0, left="fixed", right="free", damping=ModalDamping(0.01)
    )
    rig = Rig(rod.modes(3), (Actuator("F1", 0.7),), (Sensor("d1", 0.5, noise_std=1e-4),), structure=rod)
    record = simulate(rig, np.random.default_rng(1).standard_normal((1, 300)), sample_time=0.02, name="one")
    write_case(Case("a rod", rig, (record,), ()), tmp_path / "case")
    file = tmp_path / "case" / "case.toml"
    file.write_text(file.read_text().replace('kind = "rod"', f'kind = "{word}"'))
    assert f'"{word}"' in file.read_text()
    # a fixed-free bar: (2 r - 1) π / 2 · c / L
    np.testing.assert_allclose(read_case(file.parent).rig.modes.omega, np.array([1, 3, 5]) * np.pi / 2, rtol=1e-9)


def test_what_is_written_is_read_back(case, folder):
    read = read_case(folder)
    np.testing.assert_allclose(read.rig.modes.omega, case.rig.modes.omega, rtol=1e-9)
    np.testing.assert_allclose(read.rig.modes.damping, case.rig.modes.damping, rtol=1e-9, atol=1e-12)
    assert [(a.name, a.at, a.direct) for a in read.rig.actuators] == [("F1", 0.7, False), ("tap", 1.1, True)]
    assert [(s.name, s.at, s.quantity, s.noise_std) for s in read.rig.sensors] == [
        ("d1", 0.5, "displacement", 1e-4),
        ("a1", 1.2, "acceleration", 1e-2),
    ]
    assert [r.name for r in read.fit] == ["one"] and [r.name for r in read.validation] == ["kept"]
    np.testing.assert_array_equal(read.fit[0].outputs, case.fit[0].outputs)
    np.testing.assert_array_equal(read.fit[0].inputs, case.fit[0].inputs)
    assert read.fit[0].sample_time == 0.02


def test_results_that_lie_in_a_case_folder_are_not_its_files(folder):
    (folder / "verdict.json").write_text("{}")
    assert [file.relative_to(folder).as_posix() for file in files_of(folder)] == ["records/one.npz", "records/kept.npz"]


def test_what_the_format_cannot_say_is_refused(case, tmp_path):
    smooth = replace(case.rig.structure, mass_per_length=lambda x: 1.0 + x**2)
    loaded = replace(case.rig.structure, attachments=(PointMass(1.0, 0.1),))
    off = replace(case.rig.structure, frequency_errors=(0.01,))
    faulty = (
        (smooth, "not linear between"),
        (loaded, "attachments"),
        (off, "frequency_errors"),
        (None, "no structure"),
    )
    for structure, word in faulty:
        with pytest.raises(ValueError, match=word):
            write_case(replace(case, rig=replace(case.rig, structure=structure)), tmp_path / "out")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('kind = "beam"', 'kind = "shell"', "beam, rod, plate or modal; got 'shell'$"),
        ('kind = "beam"', 'kind = "baem"', r"got 'baem'; did you mean 'beam'\?$"),
        ('kind = "beam"', "kind = 3", "got 3$"),
        ("length = 2.0", "length = -2.0", "length"),
        (
            'left = "clamped"',
            'left = "pinned"',
            "left is one of hinged, clamped, free, sliding; got 'pinned', which is 'hinged' here$",
        ),
        ('left = "clamped"', 'left = "Fixed"', "got 'Fixed', which is 'clamped' here$"),
        ('left = "clamped"', 'left = "simply-supported"', "got 'simply-supported', which is 'hinged' here$"),
        ('left = "clamped"', 'left = "clampd"', r"got 'clampd'; did you mean 'clamped'\?$"),
        ('left = "clamped"', 'left = "xyz"', "got 'xyz'$"),
        ('right = "hinged"', 'right = "pinned"', r"\[structure\]: right is one of hinged"),
        ("[[input]]", "[input]", r"write \[\[input\]\], with two brackets, for each input"),
        ("modes = 5", "modes = 5.5", "whole number"),
        ("at = 0.7", "at = 7.0", "at = 7 m is outside the structure, which runs 0 to 2 m$"),
        ('quantity = "acceleration"', 'quantity = "volts"', "quantity is one of"),
        ('quantity = "acceleration"', 'quantity = "accelaration"', r"did you mean 'acceleration'\?$"),
        ("noise_std = 0.0001", "noise_std = 0.0", "noise_std must be positive"),
        ('name = "a1"', 'name = "d1"', "names must differ"),
        ('name = "a1"', 'name = "a2"', "channel 'a2' of case.toml is missing"),
        (
            "sample_time = 0.02",
            "sample_time = 0.03",
            "sample_time = 0.03 s, but t steps by 0.02: write sample_time = 0.02$",
        ),
        ('use = "fit"', 'use = "test"', "fit or validate"),
        ('use = "fit"', 'use = "validate"', 'no record has use = "fit"'),
        ("records/one.npz", "../elsewhere.npz", "outside the case folder"),
        ("records/one.npz", "records/two.npz", "there is no file"),
        ("[structure]", "[structure", "TOML"),
    ],
)
def test_a_faulty_case_toml_is_refused_by_name(folder, old, new, words):
    path = folder / "case.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(CaseError, match=words):
        read_case(folder)


def _spoiled(folder: Path, **changes) -> None:
    file = folder / "records/one.npz"
    arrays = dict(np.load(file))
    for name, change in changes.items():
        arrays[name] = change(arrays.get(name))
        if arrays[name] is None:
            del arrays[name]
    np.savez(file, **arrays)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"d1": lambda y: None}, "channel 'd1' of case.toml is missing"),
        ({"extra": lambda y: np.zeros(200)}, "channel 'extra' is not named"),
        ({"t": lambda t: None}, "array t"),
        ({"d1": lambda y: np.where(np.arange(200) == 17, np.nan, y)}, "'d1', sample 17 is nan"),
        ({"F1": lambda y: y[:-1]}, r"shape \(199,\)"),
        ({"d1": lambda y: y.astype(complex)}, "real numbers"),
        ({"d1": lambda y: np.full(200, 3.0)}, "flat"),
        ({"t": lambda t: t[::-1]}, "must rise"),
    ],
)
def test_a_faulty_record_is_refused_by_channel(folder, changes, words):
    _spoiled(folder, **changes)
    with pytest.raises(CaseError, match=words):
        read_case(folder)


def test_a_record_shorter_than_a_period_is_refused(case, tmp_path):
    short = case.fit[0].between(stop=0.4)
    assert 0.4 < 2.0 * np.pi / case.rig.modes.omega[0]
    write_case(replace(case, fit=(short,)), tmp_path / "short")
    with pytest.raises(CaseError, match="less than a period"):
        read_case(tmp_path / "short")


def test_what_is_not_a_case_folder_is_refused(tmp_path, folder):
    with pytest.raises(CaseError, match="not a folder"):
        read_case(tmp_path / "nowhere")
    with pytest.raises(CaseError, match=r"has no case\.toml"):
        read_case(tmp_path)
    (folder / "records/one.npz").write_bytes(b"not an archive")
    with pytest.raises(CaseError, match="NPZ"):
        read_case(folder)


MODAL = """
[structure]
kind = "modal"
{structure}
[[input]]
name = "F"
kind = "actuator"
shape = {at_input}
[[output]]
name = "y"
quantity = "displacement"
shape = {at_output}
noise_std = 1e-3
[[record]]
name = "r"
file = "r.npz"
sample_time = 0.1
use = "fit"
"""


def _modal_case(folder: Path, **parts: str) -> Path:
    (folder / "case.toml").write_text(MODAL.format(**parts), encoding="utf-8")
    rng = np.random.default_rng(0)
    np.savez(folder / "r.npz", t=0.1 * np.arange(300), F=rng.standard_normal(300), y=rng.standard_normal(300))
    return folder


def test_plain_modal_data_answer_as_the_modal_sum_says(tmp_path):
    rig = read_case(
        _modal_case(
            tmp_path,
            structure="natural_frequencies_hz = [0.5, 1.5]\ndamping_ratios = [0.02, 0.03]",
            at_input="[1.0, -2.0]",
            at_output="[0.5, 0.25]",
        )
    ).rig
    impulse = np.zeros((1, 400))
    impulse[0, 0] = 1.0
    y = simulate(rig, impulse, sample_time=1e-3).outputs[0]
    t = 1e-3 * np.arange(400) - 0.5e-3
    omega, zeta = 2.0 * np.pi * np.array([0.5, 1.5]), np.array([0.02, 0.03])
    damped = omega * np.sqrt(1.0 - zeta**2)
    waves = np.exp(-np.outer(t, zeta * omega)) * np.sin(np.outer(t, damped)) / damped
    np.testing.assert_allclose(y[1:], (1e-3 * waves @ [0.5, -0.5])[1:], atol=1e-9)


def test_a_single_degree_of_freedom_yields_by_force_over_stiffness(tmp_path):
    structure = "mass = 2.0\ndamping = 4.0\nstiffness = 8.0"
    rig = read_case(_modal_case(tmp_path, structure=structure, at_input="[1.0]", at_output="[1.0]")).rig
    y = simulate(rig, np.full((1, 400), 3.0), sample_time=0.1).outputs[0]
    assert y[-1] == pytest.approx(3.0 / 8.0, rel=1e-9)
    assert rig.modes.omega[0] == pytest.approx(2.0) and rig.modes.zeta[0] == pytest.approx(4.0 / (2 * 2.0 * 2.0))


def test_modal_shapes_of_the_wrong_length_are_refused(tmp_path):
    with pytest.raises(CaseError, match="list of 2 numbers"):
        read_case(
            _modal_case(
                tmp_path,
                structure="natural_frequencies_hz = [0.5, 1.5]\ndamping_ratios = [0.02, 0.03]",
                at_input="[1.0]",
                at_output="[0.5, 0.25]",
            )
        )


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"the shared gap trials are not at {SHARED}")
def test_all_shared_cases_load():
    folders = sorted(SHARED.glob("*/case-*"))
    assert len(folders) >= 14
    for folder in folders:
        case = read_case(folder)
        table = tomllib.loads((folder / "case.toml").read_text(encoding="utf-8"))
        assert len(case.fit) + len(case.validation) == len(table["record"])
        structure = table["structure"]
        assert case.rig.modes.n_modes == structure.get("modes", len(structure.get("natural_frequencies_hz", ())))
        assert all(isinstance(r, Record) and isinstance(r.output_channels[0], Channel) for r in case.fit)


@pytest.mark.parametrize("heads", [["d1", "a1"], ["d1 [mm]", "a1 [mm/s2]"], ["d1 [m]", "a1 [g]"]])
def test_units_that_a_file_states_become_those_of_the_case(case, tmp_path, heads):
    folder = write_case(replace(case, units=Units("mm", "t", "s", "N")), tmp_path / "in mm").parent
    known = read_case(folder).fit[0]
    file = folder / tomllib.loads((folder / "case.toml").read_text())["record"][0]["file"]
    stated = known.outputs / ([[1000.0], [9806.65]] if "[g]" in heads[1] else 1.0)
    table = np.vstack([known.time, known.inputs, stated]).T
    header = ",".join(["t", *known.input_names, *heads])
    np.savetxt(file.with_suffix(".csv"), table, "%.17g", ",", header=header, comments="")
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(text.replace(file.name, file.with_suffix(".csv").name))
    read = read_case(folder).fit[0]
    np.testing.assert_allclose(read.outputs, known.outputs, rtol=1e-12)
    assert [c.unit for c in read.output_channels] == ["mm", "mm/s^2"]


@pytest.mark.parametrize(
    ("heads", "words"),
    [
        (["d1", "a1 [mm/s]"], r"channel 'a1' is in m/s by its header, .* and in m/s\^2 by case.toml: correct one"),
        (["d1 [N]", "a1"], "channel 'd1' is in N by its header, .* and in m by case.toml: correct one of them"),
    ],
)
def test_a_file_whose_units_are_of_another_quantity_is_refused(case, tmp_path, heads, words):
    folder = write_case(case, tmp_path / "case").parent
    known = read_case(folder).fit[0]
    file = folder / tomllib.loads((folder / "case.toml").read_text())["record"][0]["file"]
    header = ",".join(["t", *known.input_names, *heads])
    table = np.vstack([known.time, known.inputs, known.outputs]).T
    np.savetxt(file.with_suffix(".csv"), table, "%.17g", ",", header=header, comments="")
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(text.replace(file.name, file.with_suffix(".csv").name))
    with pytest.raises(CaseError, match=words):
        read_case(folder)


def _measured_by_others(folder: Path, *, channels: str) -> Record:
    """Makes the first record of a case a universal file whose channels are nodes; the record as it was."""
    known = read_case(folder).fit[0]
    file = folder / tomllib.loads((folder / "case.toml").read_text())["record"][0]["file"]
    nodes = zip((12, 12, 14, 13), (12, 8, 13, 13), (*known.inputs, *known.outputs)[::-1], strict=True)
    common = {"binary": 1, "func_type": 1, "ref_node": 0, "ref_dir": 0, "num_pts": known.n_samples, "x": known.time,
              "abscissa_spacing": 1, "abscissa_min": 0.0, "abscissa_inc": known.sample_time,
              "abscissa_spec_data_type": 17, "orddenom_spec_data_type": 0}  # fmt: skip
    uff = pyuff.UFF(str(file.with_suffix(".uff")))
    for number, (node, quantity, data) in enumerate(nodes, start=1):
        entry = {"rsp_node": node, "rsp_dir": number, "ordinate_spec_data_type": quantity, "data": data}
        uff.write_sets(pyuff.prepare_58(**(common | entry), return_full_dict=False), "add")
    text = (folder / "case.toml").read_text()
    named = text.replace(file.name, file.with_suffix(".uff").name, 1)
    (folder / "case.toml").write_text(channels + named if channels.startswith("channels") else named + channels)
    return known


CHANNELS = """[channels]
"node 12 direction 1" = "a1"
"node 12 direction 2" = "d1"
"node 14 direction 3" = "tap"
"node 13 direction 4" = "F1"
"""


def test_a_channel_of_another_name_is_the_one_that_the_case_says(folder):
    known = _measured_by_others(folder, channels=CHANNELS)
    read = read_case(folder)
    assert Path(tomllib.loads((folder / "case.toml").read_text())["record"][1]["file"]).suffix == ".npz"
    np.testing.assert_allclose(read.fit[0].outputs, known.outputs, rtol=1e-12)
    np.testing.assert_allclose(read.fit[0].inputs, known.inputs, rtol=1e-12)
    assert read.validation[0].output_names == read.fit[0].output_names == ("d1", "a1")


@pytest.mark.parametrize(
    ("channels", "words"),
    [
        ("", r"channel 'F1' of case.toml is missing; .*where 'node 12 direction 1' is that channel, say so in \[chan"),
        (CHANNELS.replace('"d1"', '"a1"'), "two channels are 'a1' by .channels. of case.toml"),
        (CHANNELS.replace('"d1"', '"d2"'), r"\[channels\]: node 12 direction 2 is one of F1, tap, d1, a1; got 'd2'"),
        (CHANNELS.replace('"node 12 direction 2"', '"a1"'), r"\[channels\]: a1 is the name of an input, an output or"),
        ("channels = 3\n", r"\[channels\] must be a table of .*; got 3"),
    ],
)
def test_channels_that_are_not_those_of_the_case_are_refused(folder, channels, words):
    _measured_by_others(folder, channels=channels)
    with pytest.raises(CaseError, match=words):
        read_case(folder)


@pytest.mark.parametrize(
    ("units", "ratio"),
    [
        (("mm", "kg", "s", "N"), "0.001 N"),
        (("m", "kg", "ms", "N"), "1e+06 N"),
        (("in", "slug", "s", "lbf"), "0.0833333 lbf"),
    ],
)
def test_units_whose_force_is_not_that_of_the_others_are_refused(case, tmp_path, units, ratio):
    folder = write_case(replace(case, units=Units(*units)), tmp_path / "case").parent
    with pytest.raises(CaseError, match="must be consistent: a force of 1 .* is " + re.escape(ratio)):
        read_case(folder)
    assert Units("mm", "t", "s", "N").consistency == pytest.approx(1.0)
    assert Units("ft", "slug", "s", "lbf").consistency == pytest.approx(1.0)
    assert Units("mm", "kg", "ms", "kN").consistency == pytest.approx(1.0)


def test_sample_instants_in_milliseconds_are_told_how_to_be_named(folder):
    _spoiled(folder, t=lambda t: 1000.0 * t)
    with pytest.raises(CaseError, match=r"if it is in ms, name it 't \[ms\]'"):
        read_case(folder)


def test_instants_that_are_not_even_name_the_extremes_of_their_steps(folder):
    _spoiled(folder, t=lambda t: np.where(np.arange(t.size) < 100, t, t + 0.02))
    with pytest.raises(CaseError, match=r"t must rise by sample_time = 0.02 .* steps from 0.02 to 0.04$"):
        read_case(folder)


def test_a_place_outside_is_refused_in_the_unit_of_the_case(case, tmp_path):
    path = write_case(replace(case, units=Units("mm", "t", "s", "N")), tmp_path / "case")
    path.write_text(path.read_text().replace("at = 0.7", "at = 7.0"))
    with pytest.raises(CaseError, match=r"at = 7 mm is outside the structure, which runs 0 to 2 mm$"):
        read_case(path.parent)


@pytest.mark.parametrize("word", ["clamped", "hinged", "pinned"])
def test_an_end_of_a_rod_that_is_held_is_fixed(word, tmp_path):
    rod = Bar(length=1.0, mass_per_length=1.0, axial_stiffness=2.0, left="fixed", right="free")
    rig = Rig(rod.modes(3), (Actuator("F1", 0.7),), (Sensor("d1", 0.5, noise_std=1e-4),), structure=rod)
    record = simulate(rig, np.random.default_rng(1).standard_normal((1, 200)), sample_time=0.02, name="one")
    path = write_case(Case("a rod", rig, (record,), (replace(record, name="kept"),)), tmp_path / "case")
    path.write_text(path.read_text().replace('left = "fixed"', f'left = "{word}"'))
    with pytest.raises(CaseError, match=f"left is one of fixed, free; got '{word}', which is 'fixed' here$"):
        read_case(path.parent)


def test_units_of_a_file_that_nobody_can_tell_in_those_of_the_case_are_refused(tmp_path):
    (tmp_path / "r.csv").write_text("t,y [mm]\n" + "".join(f"{0.1 * i:.1f},{i}\n" for i in range(20)))
    assert read_record(tmp_path / "r.csv", units=Units("in", "t", "s", "N")).outputs[0, -1] == pytest.approx(19 / 25.4)
    with pytest.raises(RecordFileError, match=r"'Elle' of \[units\] is not known in m: name one of m, cm, mm"):
        read_record(tmp_path / "r.csv", units=Units("Elle", "t", "s", "N"))


def test_inputs_are_held_or_run_straight_as_the_case_says(case, tmp_path):
    folder = write_case(replace(case, fit=(replace(case.fit[0], input_hold="first"),)), tmp_path / "case").parent
    read = read_case(folder)
    assert [read.fit[0].input_hold, read.validation[0].input_hold] == ["first", "zero"]
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text('input_hold = "first"\n' + text)
    assert read_case(folder).validation[0].input_hold == "first"
    (folder / "case.toml").write_text('input_hold = "second"\n' + text)
    with pytest.raises(CaseError, match=r"zero \(constant between samples\), first"):
        read_case(folder)


@pytest.mark.parametrize(
    ("units", "words"),
    [
        (("milimeter", "kg", "s", "N"), r"\[units\]: length = 'milimeter' is not known; name one of m, cm, mm, "),
        (("m", "stone", "s", "N"), "mass = 'stone' is not known; name one of kg, g, "),
        (("m", "kg", "N", "N"), "time = 'N' is not known; name one of s, "),
        (("m", "kg", "s", "Newton"), "force = 'Newton' is not known; name one of N, mN, "),
    ],
)
def test_names_of_units_that_are_not_known_are_refused(tmp_path, units, words):
    """By whatever reads a case.toml: a misspelt name would otherwise leave the set unchecked."""
    text = "".join(f"{key} = {name!r}\n" for key, name in zip(("length", "mass", "time", "force"), units))
    (tmp_path / "case.toml").write_text("[units]\n" + text)
    with pytest.raises(CaseError, match=words):
        read_units(tmp_path / "case.toml")


def test_one_bracket_in_place_of_two_is_told(tmp_path):
    for text in ("[input]\nname = 'F'\n", "[input]\nname = 'F'\n[input]\nname = 'G'\n"):
        (tmp_path / "rig.toml").write_text(text)
        with pytest.raises(CaseError, match=r"write \[\[input\]\], with two brackets, for each input"):
            read_rig(tmp_path / "rig.toml")


def test_units_are_named_all_four_or_none(case, tmp_path):
    millimetres, milliseconds = Units("mm", "t", "s", "N"), Units("mm", "kg", "ms", "kN")
    write_case(replace(case, units=millimetres), tmp_path / "in mm")
    read = read_case(tmp_path / "in mm")
    assert "sample rate [Hz]" in str(read) and "sample rate [1/ms]" in str(replace(case, units=milliseconds))
    assert read.units == millimetres and [c.unit for c in read.fit[0].output_channels] == ["mm", "mm/s^2"]
    file = tmp_path / "in mm" / "case.toml"
    file.write_text(file.read_text().replace('force = "N"\n', ""))
    with pytest.raises(CaseError, match=r"\[units\]: force is missing; name all of length, mass, time, force"):
        read_case(tmp_path / "in mm")
    write_case(case, tmp_path / "in m")
    assert read_case(tmp_path / "in m").units == Units() and "[units]" not in (tmp_path / "in m/case.toml").read_text()
    microns = Units("µm", "pg", "µs", "nN")
    told = ["N s^2/m^2", "N/m", "1/m", "Hz", "rad", "kg", "N/m^3", ""]
    named = ["nN µs^2/µm^2", "nN/µm", "1/µm", "1/µs", "rad", "pg", "nN/µm^3", ""]
    assert [microns.named(unit) for unit in told] == named
    assert [Units().named(unit) for unit in told] == told
