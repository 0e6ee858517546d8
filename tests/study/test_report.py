"""A report of any file that the command wrote, and of none that only looks like one."""

import json

import numpy as np
import pytest

from workbench.cases.case import Case
from workbench.cases.writing import write_case
from workbench.records.units import Units
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.study.pages.page import write_page
from workbench.study.report import case_page_content, page_content_about, page_content_in
from workbench.study.runs.cases import StudyError

VERDICT = {
    "case": "arm", "outcome": "explained", "sentence": "A spring explains it.", "best_fit": [], "notes": ["a note"],
    "effects": [{"kind": "ground_spring", "parameters": {"stiffness": 2.0}, "parameters_std": {"stiffness": 0.1},
                 "parameters_unit": {"stiffness": "N/m"}, "at": 3.1234, "at_std": 0.02}],
    "alternatives": [{"kind": "point_mass", "probability": 0.01}], "next_experiment": "Strike it.",
    "gap": {"before": {"r": 0.5}, "after": {"r": 0.02}, "floor": {"r": 0.01}},
}  # fmt: skip
IDENTIFIED = {
    "sensors": ["a", "b"], "positions": [1.0, 2.0], "frequencies_hz": [3.0], "frequencies_std_hz": [0.1],
    "damping_ratios": [0.01], "damping_std": [0.001], "shapes_real": [[1.0], [0.5]], "shapes_imag": [[0.0], [0.1]],
}  # fmt: skip
DESIGNED = {
    "weight": 2.0, "controlled": [1],
    "laws": [{"law": "IMSC", "cost": 1.0, "effort": 2.0, "peak_force": 3.0, "work": [-1.0, 0.25, 0.5],
              "poles_real": [-1.0, -1.0], "poles_imag": [2.0, -2.0]}],
}  # fmt: skip
STUDIED = {
    "front": [{"x": 1.0, "y": "<b>"}, {"x": 2.0, "z": [1, 2]}],
    "checks": [{"name": "c", "value": 0.5, "limit": 1.0, "holds": True, "at_least": False}], "found": ["a line"],
}  # fmt: skip
PLACED = {
    "length": 10.0, "controlled": [1, 2], "lower_bound": 0.2,
    "placements": [{"positions": [2.0, 6.0], "residual_work": 0.25, "by_mode": [0.1, 0.15], "effort": 1.0,
                    "peak_force": 0.5, "condition": 2.0, "status": "Solve_Succeeded"}],
}  # fmt: skip
KINDS = {"placed": PLACED, "verdict": VERDICT, "identified": IDENTIFIED, "designed": DESIGNED, "studied": STUDIED}


def written(tmp_path, content, name="file.json"):
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_verdict_makes_a_page(tmp_path):
    shown = page_content_in(written(tmp_path, VERDICT))
    assert shown.title == "Diagnosis of arm" and shown.lead == "A spring explains it."
    assert shown.lines == ["a note", "Strike it."]
    assert (
        shown.tables[0][2] == [["ground spring", "stiffness", "2.00 N/m", "0.10 N/m", "3.123 ± 0.020", ""]]
        and shown.standing == "good"
    )
    assert shown.tables[1][2] == [["r", 50.0, 2.0, 1.0, ""]] and len(shown.tables[1][1]) == 5
    boxes = [mark["boxes"][0][3] for mark in shown.blocks[0]["figure"]["panels"][0]["marks"]]
    assert boxes == [0.5, 0.02, 0.01]


def test_a_page_says_where_effects_are_and_what_the_rest_is(tmp_path):
    pair = {"kind": "point_mass", "parameters": {"mass": 0.123456}, "at": [0.63, 0.7], "at_std": [0.011, 0.0]}
    named = {"kind": "ground_spring", "parameters": {"stiffness": 2.0}, "at": "P1", "at_std": 0.0}
    gap = {"before": {"r": 0.01527}, "after": {"r": 0.01504}, "floor": {"r": 0.01015}, "input_noise": {"r": 0.0111}}
    effects, gaps, _ = page_content_in(written(tmp_path, {**VERDICT, "effects": [pair, named], "gap": gap})).tables
    assert effects[2][0][2:] == ["0.1235", "", "(0.630 ± 0.011, 0.7)", ""]
    assert effects[2][1][2:] == ["2", "", "P1", ""]
    assert gaps[1][1:3] == ["before [%]", "after [%]"] and gaps[1][4] == "reduction of the rms [%]"
    assert gaps[2] == [["r", 1.527, 1.504, 1.015, "", "noise of the logged inputs, which no model predicts"]]
    quieter = {**gap, "input_noise": {"r": 0.005}}
    assert len(page_content_in(written(tmp_path, {**VERDICT, "gap": quieter})).tables[1][1]) == 5


def test_identified_modes_swing(tmp_path):
    [moving, damping] = page_content_in(written(tmp_path, IDENTIFIED)).blocks
    [track] = moving["motion"]["tracks"]
    assert track["x"] == [1.0, 2.0] and track["frequencies_hz"] == [3.0] and "figure" in damping
    assert track["imaginary"] == [[0.0], [0.1]]


def test_identified_modes_are_shown_to_the_digits_of_their_errors_and_damping_in_per_cent(tmp_path):
    """The file holds ratios."""
    two = {**IDENTIFIED, "frequencies_hz": [3.00123, 9.0], "frequencies_std_hz": [0.012, 0.0],
           "damping_ratios": [0.0040128, 0.02], "damping_std": [1.4e-5, 2e-5],
           "shapes_real": [[1.0, 1.0], [0.5, -0.5]], "shapes_imag": [[0.0, 0.0], [0.1, 0.0]]}  # fmt: skip
    shown = page_content_in(written(tmp_path, two))
    [(_, heads, rows)] = shown.tables
    assert heads == ("mode", "frequency [Hz]", "std [Hz]", "damping [%]", "std [%]")
    assert rows == [[1, "3.001", "0.012", "0.4013", "0.0014"], [2, "9", "0", "2.0000", "0.0020"]]
    [track] = shown.blocks[0]["motion"]["tracks"]
    assert track["frequencies_hz"] == [3.001, 9.0] and track["damping"] == [0.004013, 0.02]
    caption, panel = shown.blocks[1]["caption"], shown.blocks[1]["figure"]["panels"][0]
    assert panel["y"]["label"] == "damping [%]"
    assert caption.endswith("The bars are shorter than the dots: no standard error is above 0.35 % of its value.")
    seen = page_content_in(written(tmp_path, {**two, "damping_std": [1e-3, 1e-3]})).blocks[1]["caption"]
    assert seen == "Damping of each mode, ± 2 standard errors."


def test_a_case_is_shown_in_its_units(tmp_path, hinged_beam):
    rig = Rig(hinged_beam.modes(2), (Actuator("F1", 0.45),), (Sensor("d1", 0.3),), structure=hinged_beam)
    record = rig.record(np.ones((1, 100)), np.sin(np.arange(100.0))[None], sample_time=0.1, name="low")
    case = Case("in ms", rig, (record,), (), units=Units("mm", "kg", "ms", "kN"))
    shown = case_page_content(write_case(case, tmp_path / "in ms").parent)
    heads = [heads for _, heads, _ in shown.tables]
    assert "sample rate [1/ms]" in heads[0] and heads[1] == ("mode", "frequency [1/ms]", "damping ratio")
    assert shown.blocks[-1]["figure"]["panels"][-1]["x"]["label"] == "time [ms]"


@pytest.mark.parametrize("counted_from", [1, 0])
def test_a_design_shows_what_it_spills(tmp_path, counted_from):
    """Modes are counted from one; a file written before they were is read too."""
    shown = page_content_in(written(tmp_path, {**DESIGNED, "controlled": [counted_from]}))
    heads = ("law", "cost", "effort [N² s]", "peak force [N]", "W_R [J]", "loop")
    assert shown.tables == [("Laws", heads, [["IMSC", 1.0, 2.0, 3.0, 0.75, "stable"]])]
    [bars] = [m for m in shown.blocks[0]["figure"]["panels"][0]["marks"] if m["kind"] == "bars"]
    assert [box[3] for box in bars["boxes"]] == [0.25, 0.5]


def test_a_design_says_which_loops_are_unstable(tmp_path):
    sensed = [{"design": name, "margin": margin, "stable": margin > 0, "robustness": None}
              for name, margin in (("IMSC, filter", 0.1), ("IMSC, observer", -0.2))]  # fmt: skip
    shown = page_content_in(written(tmp_path, {**DESIGNED, "through_sensors": sensed}))
    assert shown.lead.startswith("Unstable on the full plant: IMSC, observer.") and shown.standing == "part"
    page = write_page(tmp_path / "p.html", shown).read_text(encoding="utf-8")
    assert '<p class="lead part">' in page
    assert [row[-1] for row in shown.tables[1][2]] == ["stable", "unstable"]
    sensed[1] |= {
        "limited_by": "mode 5: +0.2 1/s",
        "path": "sensor at 6 to F2",
        "poles_real": [0.2],
        "poles_imag": [3.0],
    }
    shown = page_content_in(written(tmp_path, {**DESIGNED, "through_sensors": sensed}))
    _, heads, rows = shown.tables[1]
    assert heads[3:] == ("limiting residual mode, Re λ", "path") and rows[1][3:] == [
        "mode 5: +0.2 1/s",
        "sensor at 6 to F2",
    ]
    [marks] = [p["marks"] for p in shown.blocks[2]["figure"]["panels"]]
    assert [(m["x"], m["y"]) for m in marks if m["kind"] == "line"] == [([0.2], [3.0])]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("stable", "stable"), "Every closed loop is stable on the full plant."),
        (("stable", "marginally stable"), "Every closed loop has no pole right of the imaginary axis; undamped modes"),
        (
            ("unstable: a rigid-body mode drifts", "stable"),
            "Unstable on the full plant: first. The other 2 loops are st",
        ),
        (
            ("unstable", "marginally stable"),
            "Unstable on the full plant: first. The other 2 loops have no pole right of",
        ),
    ],
)
def test_what_is_said_of_the_stability_of_all_loops_is_true(tmp_path, words, said):
    sensed = [{"design": name, "decay_rate": 0.0, "stable": True, "robustness": None, "stability": word}
              for name, word in zip(("first", "second"), words, strict=True)]  # fmt: skip
    shown = page_content_in(written(tmp_path, {**DESIGNED, "through_sensors": sensed}))
    assert shown.lead.startswith(said) and [row[2] for row in shown.tables[1][2]] == list(words)


def test_a_placement_shows_where_and_how_surely(tmp_path):
    shown = page_content_in(written(tmp_path, PLACED))
    assert shown.lead.startswith("Actuators at 2 m and 6 m leave spillover work W_R = 0.25 J. ")
    assert shown.lead.endswith("No placement within the limits has W_R below 0.2 J.")
    [places] = [m for m in shown.blocks[0]["figure"]["panels"][0]["marks"] if m["kind"] == "line"]
    assert places["x"] == [2.0, 6.0]
    assert shown.standing == "good" and shown.tables[0][2][0][0] == "best found"
    limits = {"effort": 2.0, "forbidden": [[2.5, 3.0]]}
    zoned = {**PLACED, "impulse_at": 6.3, "limits": limits, "certified": False}
    shown = page_content_in(written(tmp_path, zoned))
    assert shown.standing == "" and shown.lines[:2] == [
        "Unit impulse at 6.3 m.",
        "Forbidden zone: 2.5 m to 3 m.",
    ]
    marks = shown.blocks[0]["figure"]["panels"][0]["marks"]
    assert [m["boxes"] for m in marks if m["kind"] == "bars"] == [[[2.5, 3.0, None, None]]]
    assert [m["x"] for m in marks if m["kind"] == "line"] == [[2.0, 6.0], [6.3]]


@pytest.mark.parametrize(
    ("positions", "where", "n_figures"),
    [([[30.0, 20.0], [80.0, 60.0]], "(30, 20) mm and (80, 60) mm", 2), (["N4", "J"], "N4 and J", 1)],
)
def test_a_placement_on_a_plate_and_at_named_points_in_other_units(tmp_path, positions, where, n_figures):
    units = {"length": "mm", "mass": "t", "time": "s", "force": "N"}
    placements = [{**PLACED["placements"][0], "positions": positions}]
    placed = {**PLACED, "placements": placements, "length": [100.0, 80.0], "units": units}
    shown = page_content_in(written(tmp_path, placed))
    assert shown.lead.startswith(f"Actuators at {where} leave spillover work W_R = 0.25 N mm.")
    assert len(shown.blocks) == n_figures and "W_R [N mm]" in shown.tables[0][1]
    if n_figures == 2:
        axes = shown.blocks[0]["figure"]["panels"][0]
        assert "x [mm]" in str(axes) and "y [mm]" in str(axes) and axes["equal"]


def test_one_sensor_has_no_shape_and_remarks_are_kept(tmp_path):
    one = {**IDENTIFIED, "positions": [None], "shapes_real": [[1.0]], "shapes_imag": [[0.0]]}
    shown = page_content_in(written(tmp_path, {**one, "heading": "1 sensor", "lines": ["mode 1: mains hum?"]}))
    assert shown.lead == "1 mode at 3 Hz; 1 sensor" and shown.lines == ["mode 1: mains hum?"]
    assert all("motion" not in one for one in shown.blocks)


def test_whole_numbers_of_a_design_make_a_page(tmp_path):
    law = {"law": "a", "cost": 1, "effort": 1, "peak_force": 1, "work": [1, 2], "poles_real": [-1], "poles_imag": [1]}
    page = write_page(tmp_path / "p.html", page_content_in(written(tmp_path, {"laws": [law]})))
    assert "W_R" in page.read_text(encoding="utf-8")


def test_results_of_a_study_and_any_rows_become_tables(tmp_path):
    shown = page_content_in(written(tmp_path, STUDIED))
    assert shown.tables[0] == ("front", ("x", "y", "z"), [["1", "<b>", ""], ["2", "", "1, 2"]])
    assert shown.tables[1][2] == [["c", 0.5, "≤ 1", True]] and shown.lines == ["a line"]
    rows = page_content_in(written(tmp_path, [{"a": 1}], "rows.json"))
    assert rows.title == "rows" and rows.tables == [("rows", ("a",), [["1"]])]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "cannot be read as JSON"),
        ("[" * 100_000, "cannot be read as JSON"),
        ('{"a": NaN}', "NaN is not a JSON number"),
        ('{"a": 1e400}', "1e400 is not a JSON number"),
        ("3", "holds a int"),
        ("{}", "no rows of named numbers"),
        ('{"format": "page 9"}', "has the format 'page 9'"),
        ('{"format": "workbench page 1"}', "its title is missing"),
        ('{"sentence": 3}', "looks like a verdict, but is damaged"),
        ('{"laws": [{}]}', "looks like a comparison of control laws, but is damaged"),
        ('{"laws": 3}', "looks like a comparison"),
        ('{"shapes_real": [[1, 2], [3]]}', "looks like the modes of a record"),
        ('{"checks": "no"}', "looks like the results of a study"),
    ],
)
def test_what_is_something_else_is_refused(tmp_path, content, words):
    with pytest.raises(StudyError, match=words):
        page_content_in(written(tmp_path, content))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "fault",
    [None, "text", [], *(pytest.param(f, marks=pytest.mark.slow) for f in (3, -1.5, {}, [None], [[]], [{}], True))],
)
def test_no_wrong_part_ends_in_anything_but_a_story_or_a_refusal(tmp_path, kind, fault):
    for name in KINDS[kind]:
        try:
            shown = page_content_in(written(tmp_path, {**KINDS[kind], name: fault}))
        except StudyError:
            continue
        assert all(isinstance(line, str) for line in (shown.title, shown.lead, *shown.lines))
        assert all(len(row) == len(heads) for _, heads, rows in shown.tables for row in rows)


def test_a_study_that_has_not_run_says_so(tmp_path, monkeypatch):
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies/some.py").write_text('"""Why?"""\ndef study(outcome, data=None): ...\n')
    monkeypatch.chdir(tmp_path)
    with pytest.raises(StudyError, match="study some has no page here yet; run it: workbench study some"):
        page_content_about("some")
    with pytest.raises(StudyError, match="no study is called 'other'"):
        page_content_about("other")
