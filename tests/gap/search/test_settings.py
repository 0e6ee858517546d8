"""The constants of the search: all are read, and a study can alter each."""

import importlib.util
import json
import re
from dataclasses import FrozenInstanceError
from pathlib import Path
from types import SimpleNamespace

import pytest

import workbench
from workbench.gap.search import settings
from workbench.gap.search.search import Search
from workbench.gap.search.settings import SEARCH
from workbench.study.runs.outcome import Outcome
from workbench.trials.hold import write_trials

ROOT = Path(workbench.__file__).parents[1]


@pytest.fixture(scope="module")
def ablation():
    spec = importlib.util.spec_from_file_location("ablation", ROOT / "studies/ablation.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_constant_is_read(ablation):
    """One that no step reads is none."""
    steps = [path for path in (ROOT / "workbench/gap/search").glob("*.py") if path.name != "settings.py"]
    read = set(re.findall(r"\b([A-Z]+)\.([a-z_]+)\b", "\n".join(path.read_text(encoding="utf-8") for path in steps)))
    there = set(ablation.settings_of_search())
    assert len(there) > 100
    assert not there - read


def test_a_constant_is_altered_for_a_case_and_no_longer(ablation):
    def is_justified():
        return Search.is_justified(SimpleNamespace(data=SimpleNamespace(n_values=8000)), 0.006, 0)

    assert is_justified()  # twice the log-likelihood: 48, of 30 that it takes
    with pytest.raises(RuntimeError, match="of the case"), ablation.altered("SEARCH", "sure", 2.0):
        assert not is_justified()
        raise RuntimeError("of the case")
    assert is_justified() and SEARCH == settings.SearchSettings()
    with pytest.raises(FrozenInstanceError):
        SEARCH.sure = 60.0


def test_counts_stay_counts_and_tables_are_altered_whole(ablation):
    assert [ablation.scaled(5, factor) for factor in (0.5, 2.0)] == [2, 10]
    assert ablation.scaled(1, 0.5) == 1
    assert ablation.scaled((("mass", 0.02), ("delay", 0.5)), 2.0) == (("mass", 0.04), ("delay", 1.0))


@pytest.mark.slow
def test_a_constant_that_decides_is_told_from_one_that_does_not(ablation, tmp_path, monkeypatch):
    """How many others are shown beside a clear verdict decides nothing; one value screens no effect."""
    data, labels = tmp_path / "cases", tmp_path / "cases-labels.json"
    write_trials(data, labels, 1, 7, kinds=[["cubic_spring"]])
    (case,) = json.loads(labels.read_text(encoding="utf-8"))
    monkeypatch.setattr(
        ablation, "settings_of_search", lambda: [("ATTRIBUTION", "shown"), ("SCREENING", "most_values")]
    )
    monkeypatch.setattr(ablation, "FACTORS", {"half": 1e-9, "twice": 2.0})
    outcome = Outcome("ablation", figures_folder=tmp_path, cache=tmp_path / "cache")
    ablation.study(outcome, data)
    assert outcome.holds
    assert outcome.tables["verdicts"] == {case: "explained: cubic_spring"}
    assert outcome.tables["settings"] == {
        "ATTRIBUTION.shown": {"value": 7},
        "SCREENING.most_values": {"value": 20_000, "half": {case: "part: unknown (wrong)"}},
    }
    assert outcome.tables["change no verdict"] == ["ATTRIBUTION.shown"]
