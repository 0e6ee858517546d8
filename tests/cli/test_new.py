"""`workbench new`: templates that are read and run as they are."""

import numpy as np

from workbench.cases.case import read_case
from workbench.cases.nominal import read_rig
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
