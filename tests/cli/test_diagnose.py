"""`workbench diagnose`: faults of wiring are said before any search, and corrected where that is asked for."""

import json
from dataclasses import replace
from shutil import copy

import numpy as np
import pytest

from workbench.cases.case import Case
from workbench.cases.writing import write_case
from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import kind_named
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.trials.make import make_trial


@pytest.fixture(scope="module")
def nothing_hidden():
    return make_trial(2)[0]


def write_exchanged(case, folder):
    """The case with its first two inputs exchanged."""
    order = np.arange(len(case.rig.actuators))
    order[:2] = 1, 0

    def wired(records):
        return tuple(replace(record, inputs=record.inputs[order]) for record in records)

    return write_case(replace(case, fit=wired(case.fit[:2]), validation=wired(case.validation[:1])), folder)


@pytest.mark.slow
def test_exchanged_inputs_stop_a_diagnosis_and_are_corrected_on_request(run, tmp_path, monkeypatch, nothing_hidden):
    write_exchanged(nothing_hidden, tmp_path / "crossed")
    stopped = run("diagnose", tmp_path / "crossed", "--page", tmp_path / "p.html")
    assert stopped.exit_code == 2 and "The inputs F1 and F2 are exchanged: swap them." in stopped.output
    assert "--correct" in stopped.output and not (tmp_path / "p.html").exists()
    seen, real = [], nothing_hidden

    def search(rig, records, *, validation, **options):
        seen.extend([*records, *validation])
        raise ValueError("the search has begun")

    monkeypatch.setattr("workbench.gap.diagnose_case.diagnose", search)
    for option, order in (("--correct", [0, 1]), ("--uncorrected", [1, 0])):
        seen.clear()
        assert "the search has begun" in run("diagnose", tmp_path / "crossed", option).output
        for record, exact in zip(seen, (*real.fit[:2], *real.validation[:1]), strict=True):
            np.testing.assert_array_equal(record.inputs[:2], exact.inputs[order])


def test_a_page_that_cannot_be_written_is_refused_before_the_search(run, tmp_path, nothing_hidden):
    write_case(nothing_hidden, tmp_path / "plain")
    refused = run("diagnose", tmp_path / "plain", "--page", tmp_path)
    assert refused.exit_code == 2 and "is a folder; name a file in it" in " ".join(refused.output.split())


def test_a_former_name_of_an_option_is_taken_for_the_new_one(run):
    assert "--mend is now --correct" in run("diagnose", "no-case", "--mend").output


def test_what_was_corrected_is_stated_in_the_verdict_and_on_the_page(run, tmp_path):
    """Two outputs of records that begin in motion are exchanged; with --transient that is seen and corrected too."""
    beam = Beam(
        length=2.0, mass_per_length=1.0, bending_stiffness=20.0, left="hinged", right="hinged",
        damping=ModalDamping(0.3),
    )  # fmt: skip
    sensors = [Sensor(f"y{i}", 0.4 * i, noise_std=1e-6) for i in (1, 2)]
    rig = Rig(beam.modes(3), [Actuator("F", 0.5)], sensors, structure=beam)
    rng, records = np.random.default_rng(1), []
    for name in ("low", "check"):
        clean = simulate(rig, rng.normal(size=(1, 1200)), sample_time=0.01, name=name).between(2.0)
        outputs = clean.outputs + 1e-6 * rng.normal(size=clean.outputs.shape)
        records.append(replace(clean, outputs=outputs[::-1], start_time=0.0))
    write_case(Case("crossed", rig, (records[0],), (records[1],)), tmp_path / "crossed")
    verdict, page = tmp_path / "v.json", tmp_path / "p.html"
    options = ("--transient", "6", "--workers", "1", "--json", verdict, "--page", page)
    assert "The outputs y1 and y2 are exchanged" in run("diagnose", tmp_path / "crossed", *options).output
    assert not page.exists()
    told = run("diagnose", tmp_path / "crossed", *options, "--correct")
    note = "Corrected before the diagnosis: The outputs y1 and y2 are exchanged: swap them."
    assert told.exit_code == 0 and note in json.loads(verdict.read_text())["notes"]
    assert note in page.read_text()
    assert json.loads(verdict.read_text())["outcome"] == "none"


def test_a_page_names_options_and_ends_its_list_with_what_could_be_detected(run, tmp_path, monkeypatch):
    beam = Beam(
        length=2.0, mass_per_length=1.0, bending_stiffness=20.0, left="hinged", right="hinged",
        damping=ModalDamping(0.3),
    )  # fmt: skip
    rig = Rig(beam.modes(3), [Actuator("F", 0.5)], [Sensor("y1", 0.4, noise_std=1e-6)], structure=beam)
    rng = np.random.default_rng(1)
    record = simulate(rig, rng.normal(size=(1, 600)), sample_time=0.01, name="low")
    record = replace(record, outputs=record.outputs + 1e-6 * rng.normal(size=record.outputs.shape))
    write_case(Case("plain", rig, (record,), ()), tmp_path / "plain")
    found = diagnose(rig, record, catalogue=(kind_named("actuator_gain"),), workers=1)
    note = "The search reached its limit of time, `seconds` 15; a larger one lets it continue."
    told = replace(found, notes=(note,))
    monkeypatch.setattr("workbench.gap.diagnose_case.diagnose_case", lambda case, **options: told)
    verdict, page = tmp_path / "v.json", tmp_path / "p.html"
    printed = run("diagnose", tmp_path / "plain", "--json", verdict, "--page", page)
    assert printed.exit_code == 0 and "limit of time, --seconds 15; a" in printed.output
    assert json.loads(verdict.read_text())["notes"] == [note]
    first, *_, last = json.loads((tmp_path / "p.page.json").read_text())["lines"]
    assert first == note.replace("`seconds`", "--seconds")
    assert last.startswith("Detectability, before any fit: these records can show")


def test_a_validation_record_that_repeats_a_fit_record_is_refused(run, tmp_path, nothing_hidden):
    case = nothing_hidden
    write_case(replace(case, fit=case.fit[:1], validation=(replace(case.fit[0], name="again"),)), tmp_path / "same")
    refused = run("diagnose", tmp_path / "same")
    assert refused.exit_code == 2 and "repeats the fit record" in refused.output


def test_a_nominal_model_is_learnt_from_a_record_at_low_level(run, tmp_path, monkeypatch, nothing_hidden):
    rng, seen, settled, real = np.random.default_rng(0), [], [], nothing_hidden
    dt = real.fit[0].sample_time
    rig = replace(real.rig, modes=real.rig.modes.select(range(2)), actuators=real.rig.actuators[:1], structure=None)
    for name, level in (("low", 1.0), ("high", 10.0)):
        clean = simulate(rig, level * rng.standard_normal((1, 3000)), sample_time=dt)
        outputs = clean.outputs + 1e-3 * clean.outputs.std(axis=1, keepdims=True) * rng.standard_normal((5, 3000))
        columns = np.column_stack([clean.time, clean.inputs.T, outputs.T])
        header = ",".join(["t", "F1", *clean.output_names])
        np.savetxt(tmp_path / f"{name}.csv", columns, delimiter=",", header=header, comments="")

    def search(rig, records, **options):
        seen.extend([rig, *records])
        settled.append(options["transient"])
        raise ValueError("the search has begun")

    monkeypatch.setattr("workbench.gap.diagnose_case.diagnose", search)
    options = ("--nominal", tmp_path / "low.csv", "--records", tmp_path / "high.csv", "--inputs", "F1")
    assert "--quantity" in run("diagnose", *options).output
    begun = run("diagnose", *options, "--quantity", "displacement")
    assert "the search has begun" in begun.output
    (warning,) = (line for line in begun.stderr.splitlines() if "have no scale" in line)
    assert warning.startswith("workbench: warning: no output is at the place of an input")
    assert "give --driving-point INPUT,OUTPUT" in warning and "modal_masses" not in warning
    copy(tmp_path / "low.csv", tmp_path / "again.csv")
    for option, file in (("--records", "low.csv"), ("--records", "again.csv"), ("--validation", "low.csv")):
        refused = run("diagnose", *options, "--quantity", "displacement", option, tmp_path / file)
        assert refused.exit_code == 2 and "holds the same measurement as --nominal" in " ".join(refused.stderr.split())
    found, high = seen
    np.testing.assert_allclose(found.modes.omega, rig.modes.omega, rtol=1e-3)
    predicted = simulate(found, high.inputs, sample_time=dt).outputs
    assert np.std(predicted - high.outputs) < 0.05 * np.std(high.outputs)
    assert "not both" in run("diagnose", tmp_path, *options).output
    options = (*options, "--quantity", "displacement", "--driving-point")
    assert "INPUT,OUTPUT" in run("diagnose", *options, "F1").output
    assert "driving_point is (input, output)" in run("diagnose", *options, "F1,nowhere").output
    assert "the search has begun" in run("diagnose", *options, f"F1,{real.rig.sensors[0].name}").output
    options = (*options, f"F1,{real.rig.sensors[0].name}", "--transient", "0.5")
    assert "the search has begun" in run("diagnose", *options).output and settled == [0.0, 0.0, 0.5]
    days = [tmp_path / day / "sweep.csv" for day in ("monday", "tuesday")]
    for file in days:
        file.parent.mkdir()
        copy(tmp_path / "high.csv", file)
    seen.clear()
    options = ("--nominal", tmp_path / "low.csv", "--inputs", "F1", "--quantity", "displacement", "--uncorrected")
    run("diagnose", *options, *(part for file in days for part in ("--records", file)))
    assert [record.name for record in seen[1:]] == ["monday/sweep", "tuesday/sweep"]
    assert "give each record once" in run("diagnose", *options, "--records", days[0], "--records", days[0]).output
