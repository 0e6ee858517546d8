"""Where studies are found, and where what they make goes."""

import pytest

from workbench.study import catalogue
from workbench.study.catalogue import find_study, list_studies, output_root, run_study
from workbench.study.runs.outcome import Outcome

SCRIPT = '"""Is one one?"""\n\n\ndef study(outcome, data=None):\n    outcome.check("one", 1.0, 1.0)\n'


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_study_of_ones_own_stands_beside_the_built_in_ones(elsewhere):
    (elsewhere / "studies").mkdir()
    (elsewhere / "studies" / "mine.py").write_text(SCRIPT)
    names = [entry.name for entry in list_studies()]
    assert "mine" in names and "beam_control" in names and names == sorted(names)
    assert [entry.name for entry in list_studies(here_first=True)] == ["mine"]
    assert output_root(find_study("mine")) == elsewhere


def test_a_built_in_study_writes_into_the_current_folder(elsewhere):
    found = find_study("beam_control")
    assert output_root(found) == elsewhere and output_root(found) != found.path.parent.parent


def test_a_script_from_elsewhere_leaves_its_own_folder_as_it_is(elsewhere, tmp_path_factory):
    away = tmp_path_factory.mktemp("away") / "studies"
    away.mkdir()
    (away / "one.py").write_text(SCRIPT)
    found = find_study(str(away / "one.py"))
    outcome = Outcome(name=found.name, title=found.question, figures_folder=elsewhere / "figures")
    result, page = run_study(found, None, outcome, output_root(found))
    assert result == elsewhere / "out" / "results" / "one.json" and page == elsewhere / "out" / "one.html"
    assert [path.name for path in away.iterdir() if path.suffix] == ["one.py"]


def test_studies_beside_an_installed_package_are_found(elsewhere, monkeypatch):
    """`pip install --target` puts what wheels call data beside the package."""
    (elsewhere / "workbench" / "study").mkdir(parents=True)
    beside = elsewhere / "share" / "workbench" / "studies"
    beside.mkdir(parents=True)
    (beside / "came.py").write_text(SCRIPT)
    monkeypatch.setattr(catalogue, "__file__", str(elsewhere / "workbench" / "study" / "catalogue.py"))
    assert [*catalogue.study_scripts()] == ["came"]
