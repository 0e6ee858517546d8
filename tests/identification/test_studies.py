"""The studies of this room, run: every check in them holds."""

import importlib.util
import os
from pathlib import Path

import pytest

from workbench.study.outcome import Outcome

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("WORKBENCH_SHARED", ROOT.parent / "shared"))
RULER = SHARED / "measured" / "ruler" / "ruler.mat"


def run(name, folder, data=None):
    spec = importlib.util.spec_from_file_location(name, ROOT / "studies" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    outcome = Outcome(name, figures_folder=folder)
    module.study(outcome, data)
    return outcome


def failed(outcome):
    return [check for check in outcome.checks if not check["holds"]]


@pytest.mark.skipif(not RULER.is_file(), reason="the measured ruler is not at hand; set WORKBENCH_SHARED")
def test_ruler(tmp_path):
    outcome = run("ruler", tmp_path, RULER)
    assert not failed(outcome)
    assert outcome.tables["bending_hz"] == pytest.approx([39.4, 108.8, 212.0, 352.6, 517.9, 729.0], rel=0.01)
    assert min(outcome.tables["mac"][:5]) >= 0.95
    assert outcome.tables["other_hz"] == pytest.approx([6.7, 551.0], rel=0.02)
