"""The constants of the search: all are read, and a study can alter each."""

import importlib.util
import json
import re
from dataclasses import FrozenInstanceError
from pathlib import Path
from time import process_time
from types import SimpleNamespace

import pytest

import workbench
from workbench.gap.search import settings
from workbench.gap.search.search import Search
from workbench.gap.search.settings import JOINT, SEARCH
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

    boundless = [("SEARCH", "likelihood_ratio", "boundless"), ("JOINT", "rounds", "none")]
    assert is_justified()  # twice the log-likelihood: 48, of 30 that it takes
    with pytest.raises(RuntimeError, match="of the case"), ablation.altered(boundless):
        assert not is_justified() and JOINT.rounds == 0
        raise RuntimeError("of the case")
    assert is_justified() and SEARCH == settings.SearchSettings() and JOINT == settings.JointSettings()
    with pytest.raises(FrozenInstanceError):
        SEARCH.likelihood_ratio = 60.0


def test_counts_stay_counts_and_tables_are_altered_whole(ablation):
    assert [ablation.at_extreme(5, extreme) for extreme in ablation.EXTREMES] == [0, 50]
    assert ablation.at_extreme((("mass", 0.02), ("delay", 0.5)), "boundless") == (("mass", 2e4), ("delay", 5e5))


def test_a_case_without_end_is_ended(ablation):
    with pytest.raises(TimeoutError, match="more than 0 s"), ablation.within(0.1):
        while True:
            pass
    with ablation.within(0.1):
        pass  # the timer does not outlive its case
    end = process_time() + 0.2
    while process_time() < end:
        pass


@pytest.mark.slow
def test_a_constant_that_decides_is_told_from_one_that_does_not(ablation, tmp_path, monkeypatch):
    """How many others are shown beside a clear verdict decides nothing; no value screens no effect."""
    data, labels = tmp_path / "cases", tmp_path / "cases-labels.json"
    write_trials(data, labels, 1, 7, kinds=[["cubic_spring"]])
    (case,) = json.loads(labels.read_text(encoding="utf-8"))
    constants = [("ATTRIBUTION", "shown_singles"), ("SCREENING", "max_values")]
    monkeypatch.setattr(ablation, "settings_of_search", lambda: constants)
    monkeypatch.setattr(ablation, "OWN", 0)
    outcome = Outcome("ablation", figures_folder=tmp_path, cache=tmp_path / "cache")
    ablation.study(outcome, tmp_path)
    assert outcome.holds
    assert outcome.tables["verdicts"] == {f"cases/{case}": "explained: cubic_spring"}
    shown, screened = (outcome.tables["settings"][".".join(each)] for each in constants)
    assert shown == {"value": 7}
    assert screened["value"] == 20_000 and screened["at"] == "none"
    assert outcome.tables["change no verdict"] == ["ATTRIBUTION.shown_singles"]
