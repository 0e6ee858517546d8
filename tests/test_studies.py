"""Every study runs, what it checks holds, and its committed results say the same."""

import ast
import json
import os
from pathlib import Path

import pytest

from workbench.study.catalogue import describe, run_study
from workbench.study.runs.outcome import OWN, Outcome

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("WORKBENCH_SHARED", ROOT.parent / "shared"))
DATA = {"ruler": SHARED / "measured/ruler/ruler.mat", "blind_trials": SHARED / "gap-trials/blind"}
DATA["arm_change"] = SHARED / "measured/arm-change"
DATA["identification_peers"] = DATA["ruler"]
DATA["silverbox"] = SHARED / "measured/silverbox/SNLS80mV.mat"
DATA["emps"] = SHARED / "measured/emps"
DATA["f16"] = SHARED / "measured/f16"
LONG = {
    "blind_trials",
    "imperfect_trials",
    "ideal_trials",
    "false_alarms",
    "many_cases",
    "design_scaling",
    "placement_front",
}
LONG |= {"local_loss", "identification_order", "identification_peers", "identification_coverage", "identification_size"}
LONG |= {"identification_records", "diagnosis_speed", "silverbox", "patch_pairs", "emps", "f16", "frame_gap"}
LONG |= {"placement", "ruler", "robustness_to_identification", "arm_change", "identification_ambient_peers"}
LONG |= {"bench_trials", "closing_the_loop", "compensation", "imsc_vs_coupled", "plate_control", "bar_identification"}
LONG |= {"ablation", "beam_control", "spillover_explained"}
STUDIES = [
    pytest.param(path, id=path.stem, marks=[pytest.mark.slow] if path.stem in LONG else [])
    for path in sorted((ROOT / "studies").glob("*.py"))
]
# Names that others read these results by.
TABLES = {
    "bar_identification": ("table_4_1", "table_4_1_default", "tables_4_2_4_3"),
    "modal_filter": ("table_5_1",),
    "beam_control": ("W_r",),
}
# Figures that must come out, whatever a study checks of itself.
TRUE = {
    "ruler": {
        "bending_hz": pytest.approx([39.4, 108.8, 212.0, 352.6, 517.9, 729.0], rel=0.01),
        "other_hz": pytest.approx([6.7, 551.0], rel=0.02),
    }
}


@pytest.mark.parametrize("path", sorted((ROOT / "studies").glob("*.py")), ids=lambda path: path.stem)
def test_no_table_takes_the_name_of_an_entry_of_the_results(path):
    calls = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))
    named = {
        call.args[0].value
        for call in calls
        if isinstance(call.func, ast.Attribute) and call.func.attr == "table" and isinstance(call.args[0], ast.Constant)
    }
    assert not named & set(OWN)


@pytest.mark.parametrize("path", STUDIES)
def test_a_study_holds_when_run_anew(path, tmp_path):
    found = describe(path)
    data = DATA.get(found.name)
    data = data if found.needs_data or (data and data.exists()) else None
    if found.needs_data and (data is None or not data.exists()):
        pytest.skip(f"{found.needs_data} is not here; set WORKBENCH_SHARED")
    copy = tmp_path / "studies" / path.name
    copy.parent.mkdir()
    copy.write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    outcome = Outcome(found.name, title=found.question, figures_folder=tmp_path / "figures")
    result, page = run_study(describe(copy), data, outcome, tmp_path)
    assert outcome.checks or found.name in LONG, "a study checks what it claims"
    assert not [check for check in outcome.checks if not check["holds"]]
    written = json.loads(result.read_text(encoding="utf-8"))
    assert all(name in written for name in TABLES.get(found.name, ()))
    assert all(written[name] == true for name, true in TRUE.get(found.name, {}).items())
    assert (outcome.figures or found.name in LONG) and all(path.stat().st_size > 5000 for _, path, _ in outcome.figures)
    assert found.question in page.read_text(encoding="utf-8").replace("&#39;", "'")


@pytest.mark.parametrize("path", STUDIES)
def test_committed_results_hold(path):
    results = json.loads((ROOT / "studies/results" / f"{path.stem}.json").read_text(encoding="utf-8"))
    assert all(check["holds"] for check in results.get("checks", ()))
