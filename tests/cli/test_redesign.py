"""`workbench redesign`: from a case and its verdict to a controller, a page and JSON."""

import json
import re
from runpy import run_path

import numpy as np
import pytest

from workbench.cases.case import Case
from workbench.cases.writing import write_case
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.robust.posterior import UncertainRig


@pytest.fixture(scope="module")
def case(tmp_path_factory, hinged_beam):
    """A case whose actuators are late, and its verdict as the diagnosis writes it."""
    sensors = [Sensor(f"d{i}", x, noise_std=1e-5) for i, x in enumerate((0.3, 0.7, 1.1, 1.6))]
    rig = Rig(hinged_beam.modes(5), (Actuator("F1", 0.45), Actuator("F2", 1.2)), tuple(sensors), structure=hinged_beam)
    late = Effect(kind_named("actuator_delay"), "all", {"delay": 0.04})
    inputs = np.random.default_rng(0).normal(size=(2, 400))
    folder = tmp_path_factory.mktemp("case") / "late"
    write_case(Case("late", rig, (simulate(late.apply(rig), inputs, sample_time=0.01, name="low"),), ()), folder)
    verdict = folder.parent / "verdict.json"
    verdict.write_text(json.dumps({"posterior": UncertainRig(rig, (late,), np.array([[1e-4]])).to_json()}))
    return folder, verdict


@pytest.mark.slow
def test_a_late_actuator_is_made_up_for_and_shown(run, case, tmp_path):
    folder, verdict = case
    page, told, code = tmp_path / "p.html", tmp_path / "r.json", tmp_path / "anew.py"
    options = ("--verdict", verdict, "--damping", 0.3, "--draws", 6, "--page", page, "--json", told, "--to", code)
    done = run("redesign", folder, *options)
    assert done.exit_code == 0, done.output
    assert "stable on 6 of 6 Monte Carlo draws" in done.output and "F1: delay 40 ms" in done.output
    assert "the range of 6 draws, not of 95 %, which need 40 draws or more" in " ".join(done.output.split())
    assert re.search(r"test: an impulse of \S+ N s at x = \S+, which moves the structure as far", done.output)
    assert "in the new controller" in done.output and "  loss: vibration and effort above those with" in done.output
    found = json.loads(told.read_text())
    assert found["safe"] and found["redesigned"]["stable"] == 6
    assert found["steps"][-1]["loss"] < 0.5 * found["steps"][0]["loss"]
    assert "controller" in done.output and "the redesigned one" in done.output
    text = code.read_text(encoding="utf-8")
    assert "d0: displacement at x = 0.3, m" in text and "command of F1, 4 samples ago" in text
    step = run_path(str(code))["Controller"]()
    commands = np.array([step.step(readings) for readings in np.eye(4)])
    assert commands.shape == (4, 2) and np.abs(commands).max() > 0
    html = page.read_text(encoding="utf-8")
    assert found["sentence"].split(";")[0] in html and "Under the inputs of the measured record “low”" in html


@pytest.mark.slow
def test_what_is_redesigned_is_what_was_exported(run, case, tmp_path):
    folder, verdict = case
    options = ("--law", "poles", "--controlled-modes", 2, "--damping", 0.15, "--estimator", "luenberger")
    code, told = tmp_path / "before.py", tmp_path / "kept.py"
    done = run("export", folder, *options, "--rate-hz", 100, "--to", code)
    assert done.exit_code == 0, done.output
    # where nothing may be dearer and nothing is lost, the present one is kept and written
    none = json.loads(verdict.read_text())
    none["posterior"] |= {"effects": [], "covariance": []}
    (tmp_path / "none.json").write_text(json.dumps(none))
    quick = ("--verdict", tmp_path / "none.json", "--draws", 1, "--max-work-increase", 0, "--max-cost-increase", 0)
    done = run("redesign", folder, *options, *quick, "--page", tmp_path / "p.html", "--to", told)
    assert "the present one, which is kept" in done.output, done.output
    first, second = (run_path(str(path))["Controller"]() for path in (code, told))
    for readings in np.random.default_rng(0).standard_normal((200, 4)):
        np.testing.assert_allclose(second.step(readings), first.step(readings), rtol=1e-12)


def test_what_is_no_verdict_or_no_law_is_named(run, case, tmp_path):
    folder, verdict = case
    plain = tmp_path / "plain.json"
    plain.write_text('{"effects": []}')
    refused = run("redesign", folder, "--verdict", plain)
    assert refused.exit_code == 2 and "workbench diagnose CASE --json verdict.json" in refused.output
    none = run("redesign", folder, "--verdict", tmp_path / "none.json")
    assert none.exit_code == 2 and "workbench diagnose CASE --json none.json" in none.output
    assert "there is no such file" in none.output and "not a verdict" not in none.output
    told = json.loads(verdict.read_text())
    told["posterior"]["nominal"]["frequencies_hz"][1] *= 1.001
    plain.write_text(json.dumps(told))
    other = run("redesign", folder, "--verdict", plain)
    assert other.exit_code == 2 and "the verdict is of another rig: its frequencies hz are" in other.output
    unknown = run("redesign", folder, "--verdict", verdict, "--law", "magic")
    assert unknown.exit_code == 2 and "the laws are imsc, coupled, poles, on-off" in unknown.output
    slow = run("redesign", folder, "--verdict", verdict, "--rate-hz", 5)
    assert slow.exit_code == 2 and "too slow for mode 2" in slow.output


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda told: told.pop("effects"), "it has no 'effects'; diagnose the case again"),
        (lambda told: told["effects"][0].update(values={}), "needs a number 'delay'; got None"),
        (lambda told: told["effects"][0].update(values={"delay": "x"}), "needs a number 'delay'; got 'x'"),
        (lambda told: told["effects"][0].update(target="F9"), "acts on 'F9', which the rig does not have"),
        (lambda told: told.update(covariance=[[1.0, 2.0], [3.0]]), "covariance must be 1 by 1 finite numbers"),
        (lambda told: told.update(covariance=[[float("nan")]]), "covariance must be 1 by 1 finite numbers"),
        (lambda told: told.update(unexplained=None), "it is damaged; diagnose the case again"),
    ],
)
def test_a_damaged_verdict_is_named(run, case, tmp_path, change, said):
    folder, verdict = case
    told = json.loads(verdict.read_text())
    change(told["posterior"])
    (tmp_path / "v.json").write_text(json.dumps(told))
    refused = run("redesign", folder, "--verdict", tmp_path / "v.json")
    assert refused.exit_code == 2 and said in " ".join(refused.output.split())


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--rate-hz", 0, "above 0 Hz"),
        ("--rate-hz", "nan", "above 0 Hz"),
        ("--draws", 0, "greater than or equal"),
        ("--draws", 10**9, "less than or equal to 10000"),
        ("--seed", -1, "greater than or equal"),
        ("--criterion", "fast", "cost or settling; got 'fast'"),
        ("--impulse-at", 9.0, "lies outside the structure"),
        ("--impulse-at", "F9", "or name an input: F1, F2"),
        ("--impulse-at", 0, "excites none of the controlled modes"),
        ("--controlled-modes", 7, "controlled modes is 1 to 5, those of the model; got 7"),
        ("--to", "anew.m", ".c, .py or .mat"),
        ("--to", "no/anew.c", "make it first"),
        ("--page", ".", "is a folder; name a file in it"),
    ],
)
def test_what_cannot_be_is_refused_before_any_work(run, case, option, value, said):
    folder, verdict = case
    refused = run("redesign", folder, "--verdict", verdict, option, value)
    assert refused.exit_code == 2 and said in refused.output
