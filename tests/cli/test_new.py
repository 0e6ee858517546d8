"""`workbench new`: templates that are read and run as they are."""

import numpy as np
import pytest

from workbench.cases.case import UNITS, read_case, read_units
from workbench.cases.nominal import ACTING, EDGE, ENDS, MODAL, PLATE, STRUCTURES, read_rig
from workbench.rig.sensors import MEASURED
from workbench.rig.simulate import simulate


def test_a_new_case_is_a_case_once_its_records_are_there(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = run("new", "case", tmp_path / "arm")
    assert made.exit_code == 0 and "workbench diagnose" in made.output
    rig = read_rig(tmp_path / "arm" / "case.toml")
    rng = np.random.default_rng(0)
    for name in ("low", "high", "validate"):
        record = simulate(rig, rng.standard_normal((2, 2000)), sample_time=0.0005)
        signals = {**dict(zip(record.input_names, record.inputs)), **dict(zip(record.output_names, record.outputs))}
        if name == "high":  # any format that holds the same channels will do
            columns = np.column_stack([record.time, *signals.values()])
            file = tmp_path / "arm" / "records" / "high.csv"
            np.savetxt(file, columns, delimiter=",", header=",".join(["t", *signals]), comments="")
            continue
        np.savez(tmp_path / "arm" / "records" / f"{name}.npz", t=record.time, **signals)
    toml = tmp_path / "arm" / "case.toml"
    toml.write_text(toml.read_text(encoding="utf-8").replace("high.npz", "high.csv"), encoding="utf-8")
    case = read_case(tmp_path / "arm")
    assert [len(case.fit), len(case.validation)] == [2, 1]
    assert "diagnose 'your arm'" in run("new", "case", "your arm").output  # as a shell takes it
    again = run("new", "case", tmp_path / "arm")
    assert again.exit_code == 2 and "exists already" in again.output


def test_a_new_study_runs_and_holds(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("new", "study", "tip").exit_code == 0
    ran = run("study", "tip")
    assert ran.exit_code == 0 and "1 of 1 checks hold" in ran.output, ran.output
    assert (tmp_path / "figures" / "tip-modes.png").is_file()
    assert "exists already" in run("new", "study", "tip").output
    assert "the name of a study" in run("new", "study", "../tip").output


def test_a_new_case_names_what_the_format_has(run, tmp_path):
    run("new", "case", tmp_path / "arm")
    text = (tmp_path / "arm" / "case.toml").read_text(encoding="utf-8")
    words = (*STRUCTURES, "plate", "modal", *ENDS["beam"], *ENDS["rod"], *EDGE, *MEASURED, *ACTING[1:])
    assert [word for word in words if f'"{word}"' not in text] == []
    assert all(f"{key} = " in text for key in (*UNITS, *PLATE, "points", *MODAL[1:3])) and "# [units]" in text
    plain = text.replace("# [units]", "[units]").replace('# length = "mm"', 'length = "mm"')
    for key in UNITS[1:]:
        plain = plain.replace(f'# {key} = "', f'{key} = "')
    (tmp_path / "arm" / "case.toml").write_text(plain, encoding="utf-8")
    assert read_units(tmp_path / "arm" / "case.toml").mass == "t"


@pytest.mark.parametrize("what", ["case", "study"])
@pytest.mark.parametrize("name", ["", "  "])
def test_a_name_is_needed(run, tmp_path, monkeypatch, what, name):
    monkeypatch.chdir(tmp_path)
    refused = run("new", what, name)
    assert refused.exit_code == 2 and f"the name of the {what} is empty; give one" in refused.output
    assert list(tmp_path.iterdir()) == []
