"""`workbench predict` and `workbench check`: bands of a test to come, and a log of tests."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from workbench.cases.case import Case, read_case
from workbench.cases.writing import write_case
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect
from workbench.records.files import write_record
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.robust.posterior import UncertainRig

NOISE = 1e-4


@pytest.fixture
def case(tmp_path, monkeypatch, hinged_beam):
    """A case whose actuator is late, its verdict, and two tests that came later: one like it, one that is not."""
    monkeypatch.chdir(tmp_path)
    sensors = [Sensor(f"d{i}", x, noise_std=NOISE) for i, x in enumerate((0.3, 1.1))]
    rig = Rig(hinged_beam.modes(4), (Actuator("F1", 0.45),), tuple(sensors), structure=hinged_beam)
    late = Effect(kind_named("actuator_delay"), "all", {"delay": 0.02})
    rng = np.random.default_rng(0)

    def test_of(real, name):
        record = simulate(real, 0.1 * rng.normal(size=(1, 300)), sample_time=0.01, name=name)
        return replace(record, outputs=record.outputs + NOISE * rng.normal(size=record.outputs.shape))

    write_case(Case("late", rig, (test_of(late.apply(rig), "low"),), ()), tmp_path / "late")
    posterior = UncertainRig(rig, (late,), np.array([[1e-4]])).to_json()
    told = {"posterior": posterior, "noise": {"found": [NOISE, NOISE]}}
    (tmp_path / "verdict.json").write_text(json.dumps(told))
    write_record(test_of(late.apply(rig), "friday"), tmp_path / "friday.csv")
    write_record(test_of(rig, "monday"), tmp_path / "monday.csv")
    return tmp_path


def test_a_planned_test_is_predicted_from_its_inputs_alone(run, case):
    t = 0.01 * np.arange(200)
    np.savetxt(case / "plan.csv", np.column_stack([t, np.sin(20 * t)]), delimiter=",", header="t,F1", comments="")
    done = run("predict", "late", "plan.csv", "--verdict", "verdict.json", "--draws", 40, "--json", "told.json")
    assert done.exit_code == 0, done.output
    told = json.loads((case / "told.json").read_text())
    low, high = np.array(told["lower"]), np.array(told["upper"])
    assert low.shape == (2, 200) and (low < high).all() and told["sensors"] == ["d0", "d1"]
    assert "95 % bands from 40 draws" in (case / "out" / "late-prediction.html").read_text()


def test_a_prediction_is_told_in_the_units_of_the_case(run, case):
    file = case / "late" / "case.toml"
    file.write_text(file.read_text() + '[units]\nlength = "mm"\nmass = "kg"\ntime = "s"\nforce = "mN"\n')
    rows = np.column_stack([0.01 * np.arange(200), np.ones(200)])
    rms = []
    for name, heading, values in (("plain", "F1", rows), ("stated", "F1 [N]", rows * [1.0, 1e-3])):
        np.savetxt(case / f"{name}.csv", values, delimiter=",", header=f"t,{heading}", comments="")
        done = run("predict", "late", f"{name}.csv", "--verdict", "verdict.json", "--draws", 40)
        assert done.exit_code == 0, done.output
        rms.append(next(line.split()[1:] for line in done.output.splitlines() if line.strip().startswith("d0")))
    assert rms[0] == rms[1] and rms[0][0] == "mm"


@pytest.mark.parametrize(("header", "channel"), [("t,F1 [mm]", "F1"), ("t,F1,d0 [N]", "d0")])
@pytest.mark.parametrize("command", ["predict", "check"])
def test_a_column_of_another_quantity_is_refused(run, case, command, header, channel):
    rows = np.ones((200, header.count(",") + 1))
    rows[:, 0] = 0.01 * np.arange(200)
    np.savetxt(case / "odd.csv", rows, delimiter=",", header=header, comments="")
    done = run(command, "late", "odd.csv", "--verdict", "verdict.json", "--draws", 40)
    assert done.exit_code == 2 and not (case / "late" / "tests.csv").exists()
    assert f"odd.csv: channel '{channel}' is in " in done.stderr and "by case.toml: correct one of them" in done.stderr


@pytest.mark.slow
def test_tests_are_checked_and_logged_beside_the_case(run, case):
    for name, holds in (("friday", True), ("monday", False)):
        options = ("--verdict", "verdict.json", "--draws", 60, "--json", "told.json")
        done = run("check", "late", f"{name}.csv", *options)
        assert done.exit_code == 0, done.output
        assert json.loads((case / "told.json").read_text())["holds"] is holds
    assert "validated on 1 of 2 tests" in done.output
    assert "validated on 1 of 2 tests" in run("check", "late", f"{name}.csv", *options).output, "one record is one test"
    with (case / "late" / "tests.csv").open(newline="") as file:
        assert [row["holds"] for row in csv.DictReader(file)] == ["yes", "no", "no"]
    assert "The record is not consistent with the model" in (case / "out" / "late-check.html").read_text()


def test_a_fitted_record_is_no_test_in_other_digits_or_cut_short_either(run, case):
    low = read_case(case / "late").fit[0]
    digits = np.vectorize(lambda value: float(f"{value:.7g}"))
    cut = replace(low, outputs=digits(low.outputs[:, :250]), inputs=digits(low.inputs[:, :250]))
    write_record(cut, case / "again.csv")
    done = run("check", "late", "again.csv", "--verdict", "verdict.json", "--draws", 40)
    assert done.exit_code == 2 and "record 'low' was fitted, so it is no test" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("check", "late", "low"), "was fitted, so it is no test"),
        (("predict", "late", "nothing.csv"), "neither a file nor a record of the case, which are low"),
        (("check", "late", "friday.csv", "--log", "friday.csv"), "friday.csv is no log of tests"),
        (("check", "late", "friday.csv", "--log", "no/tests.csv"), "there is no folder no; make it first"),
        (("check", "late", "friday.csv", "--page", "late"), "late is a folder; name a file in it"),
        (("predict", "late", "friday.csv", "--page", "friday.csv/a.html"), "friday.csv is a file, not a folder"),
        (("predict", "late", "friday.csv", "--draws", "3"), "need 40 draws or more"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(run, case, arguments, said):
    done = run(*arguments, "--verdict", "verdict.json")
    assert done.exit_code == 2
    assert said in done.stderr and len(done.stderr.strip().splitlines()) == 1
    assert not (case / "late" / "tests.csv").exists()


@pytest.mark.slow
def test_a_verdict_that_is_made_on_the_way_is_kept(run, case):
    done = run("check", "late", "friday.csv", "--draws", 40)
    assert done.exit_code == 0, done.output
    kept = json.loads((case / "out" / "late-verdict.json").read_text())
    assert [e["kind"] for e in kept["posterior"]["effects"]] == ["actuator_delay"]
    assert "give --verdict out/late-verdict.json to the next command to skip the diagnosis" in " ".join(
        done.stderr.split()
    )
    again = run("check", "late", "friday.csv", "--draws", 40, "--verdict", "out/late-verdict.json")
    assert again.exit_code == 0 and again.output.split(":")[0] == done.stdout.split(":")[0]


def test_what_is_wired_wrongly_is_said_before_it_is_diagnosed(run, case):
    read = read_case(case / "late")
    turned = tuple(replace(r, outputs=r.outputs * np.array([[1.0], [-1.0]])) for r in read.fit)
    write_case(replace(read, fit=turned), case / "turned")
    refused = run("predict", case / "turned", "friday.csv")
    assert refused.exit_code == 2
    assert "d1 has the wrong sign: multiply by -1; correct the case" in refused.stderr and not (case / "out").exists()
